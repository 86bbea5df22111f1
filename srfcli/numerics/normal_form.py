"""Which way a Neimark-Sacker bifurcation opens: the cubic coefficient of its normal form, for the map over one forcing period.

On the critical manifold the period map is z -> rho z + c z |z|^2 (Kuznetsov, Elements of Applied Bifurcation Theory, sec. 5.4),
so that ln|z| grows by g + d |z|^2 a period, d = Re(c/rho): a stable torus of amplitude sqrt(-g/d) beyond the boundary if d < 0,
an unstable one before it if d > 0. Second and third derivatives of the map are variational equations of higher order along
the orbit, solved on its own mesh; those of the field are generated second derivatives, and their complex step.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from srfcli.codegen.model import Array, ComplexArray, GeneratedModel
from srfcli.numerics.boundary import pick_multiplier
from srfcli.numerics.collocation import Condensed, Discretisation, condense_plainly, gauss, running_products
from srfcli.numerics.continuation import Branch, CurvePoint
from srfcli.numerics.plane import Plane
from srfcli.numerics.special_points import RESONANCES, SpecialPoint, locate

STEP = 1e-25  # of a complex step
REAL = 1e-6  # a multiplier nearer to the real axis has no normal form of this kind
CRITICALITY = "criticality"


def cubic_coefficient(model: GeneratedModel, p: Array, orbit: Discretisation, rho: complex) -> float:
    """Return d of the critical multiplier `rho` at a point of a boundary, per forcing period; NaN where it is real.

    `orbit` is one orbit (N, n). The unit of z is such that the disturbance of ln v, 2 Re(z q(tau)), has mean |q|^2 = 1 over
    the period. At the resonance 1:3 the coefficient has a pole; at 1:4 it does not tell the whole story.
    """
    return critical_mode(model, p, orbit, rho)[0]


def critical_mode(model: GeneratedModel, p: Array, orbit: Discretisation, rho: complex) -> tuple[float, ComplexArray]:
    """Return d and the critical eigenvector at tau = 0 (n,), in the unit that d is in."""
    c = condense_plainly(model, p, orbit)
    n = orbit.x.shape[-1]
    values, vectors = np.linalg.eig(c.monodromy)
    k = int(pick_multiplier(values.astype(complex), np.asarray(rho.real + 1j * abs(rho.imag))))
    mu = complex(values[k])
    if abs(mu.imag) < REAL * abs(mu):
        return np.nan, np.full(n, np.nan + 0j)
    wave = _carried(c, vectors[:, k])
    weight = orbit.steps[:, None] * gauss(orbit.stages.shape[-2]).weights
    size = np.sqrt(float((weight * np.abs(wave[..., model.states.index("ln_v")]) ** 2).sum()))
    q, left = vectors[:, k] / size, np.linalg.inv(vectors)[k] * size
    wave = wave / size
    field = _Field(model, p, orbit)
    mean, mean_end = _forced(c, field.second(wave, wave.conj()))
    double, double_end = _forced(c, field.second(wave, wave))
    identity = np.eye(n)
    mean = mean + _carried(c, np.linalg.solve(identity - c.monodromy, mean_end))
    double = double + _carried(c, np.linalg.solve(mu * mu * identity - c.monodromy, double_end))
    source = field.third(wave) + 2 * field.second(mean, wave) + field.second(double, wave.conj())
    _, end = _forced(c, source)
    return float((0.5 * (left @ end) / mu).real), q


class _Field:
    """Second and third derivatives of the cycle's field at the Gauss points of an orbit, in given directions (N, m, n)."""

    def __init__(self, model: GeneratedModel, p: Array, orbit: Discretisation) -> None:
        self.model, self.p, self.tau, self.x = model, p.tolist(), orbit.phases, orbit.stages
        self.unit = np.eye(orbit.x.shape[-1])

    def second(self, a: ComplexArray, b: ComplexArray) -> ComplexArray:
        """Return F2(a, b), (N, m, n)."""
        return self._second(self.x, a, b)

    def _second(self, x: Array, a: Array, b: Array) -> Array:
        gradient = self.model.cycle_bilinear(self.tau, x, self.p, self.unit[:, None, None, :], a)  # (n, N, m, n)
        return np.asarray(np.moveaxis((gradient * b).sum(axis=-1), 0, -1))

    def third(self, a: ComplexArray) -> ComplexArray:
        """Return F3(a, a, conj(a)): with a = r + i s, F3(r,r,r) + F3(s,s,r) + i (F3(r,r,s) + F3(s,s,s))."""
        r, s = a.real, a.imag
        along_r, along_s = (self.x + 1j * STEP * c for c in (r, s))
        real = (self._second(along_r, r, r) + self._second(along_r, s, s)).imag
        imaginary = (self._second(along_s, r, r) + self._second(along_s, s, s)).imag
        return np.asarray((real + 1j * imaginary) / STEP)


def _carried(c: Condensed, start: ComplexArray) -> ComplexArray:
    """Return the solution of the variational equation from `start` (n,) at tau = 0, at the Gauss points (N, m, n)."""
    n = start.shape[0]
    mesh = c.prefix[:-1, :n, :n] @ start
    return np.asarray((c.local[..., :n] @ mesh[:, None, :, None])[..., 0])


def _forced(c: Condensed, source: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the solution of y' = J y + source from y(0) = 0 at the Gauss points (N, m, n), and at tau = 1 (n,)."""
    N, m, n = source.shape
    both = np.stack([source.real, source.imag], axis=-1).reshape(N, m * n, 2)
    alone = np.linalg.solve(c.block, both)
    own = (alone[..., 0] + 1j * alone[..., 1]).reshape(N, m, n)
    gain = np.einsum("m,Nmn->Nn", gauss(m).step, own)
    maps = np.zeros((N, n + 1, n + 1), complex)
    maps[:, :n, :n], maps[:, :n, n], maps[:, n, n] = c.maps[:, :n, :n], gain, 1.0
    y = running_products(maps)[:, :n, n]
    return own + (c.local[..., :n] @ y[:-1, None, :, None])[..., 0], y[-1]


def branch_coefficients(model: GeneratedModel, branch: Branch) -> Array:
    """Return d at every point of a branch, NaN where the critical multiplier is real."""
    return np.array(
        [
            cubic_coefficient(model, pt.p, Discretisation(pt.orbit.x[0], pt.orbit.stages[0], pt.orbit.edges), pt.rho)
            for pt in branch.points
        ]
    )


def criticality_points(
    model: GeneratedModel, plane: Plane, branch: Branch, coefficients: Array
) -> Iterator[SpecialPoint]:
    """Yield where d changes sign along a branch, between its points and not through the pole at 1:3."""
    pole = RESONANCES["1:3"]
    for k, ((a, da), (b, db)) in enumerate(pairwise(zip(branch.points, coefficients, strict=True))):
        if not da * db < 0 or (a.theta - pole) * (b.theta - pole) <= 0:
            continue

        def coefficient(point: CurvePoint) -> float:
            return cubic_coefficient(model, point.p, point.orbit, point.rho)

        yield locate(model, plane, branch, (k, k + 1), coefficient, what=CRITICALITY)
