"""Boundary points to full precision: Newton's method in one parameter, then meshes doubled until the error is met."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.boundary import BoundaryLinear, linearise_boundary, slope_in_last
from srfcli.numerics.collocation import Array, ComplexArray, Discretisation, expand, join
from srfcli.numerics.orbit import interpolate, scales, step_limit, uniform_mesh
from srfcli.status import Status

CHUNK = 24
LARGEST_STEP = 0.2  # in ln(parameter): more would leave the bracket's neighbourhood
RELIED_ON = 15.0  # halving an interval divides the error by 2^8 in theory; 2^4 is what the estimate relies on


@dataclass(frozen=True)
class Direction:
    """Lines in parameter space: `vectors` (B, k) over the parameters `names`, in the logarithm of those marked `log`."""

    names: tuple[str, ...]
    vectors: Array
    log: tuple[bool, ...]

    def part(self, index: slice | Array) -> Direction:
        """Return the directions of a part of the batch."""
        return Direction(self.names, self.vectors[index], self.log)

    def rates(self, values: Array) -> Array:
        """Return dp/d(distance) (B, k) at parameter `values` (k, B)."""
        return self.vectors * np.where(np.array(self.log)[:, None], values, 1.0).T

    def moved(self, values: Array, distance: Array) -> Array:
        """Return `values` (k, B) moved by `distance` (B,)."""
        shift = self.vectors.T * distance
        return np.where(
            np.array(self.log)[:, None],
            values * np.exp(np.where(np.array(self.log)[:, None], shift, 0)),
            values + shift,
        )


def along(name: str, count: int) -> Direction:
    """Return the direction of ln(name) for `count` points."""
    return Direction((name,), np.ones((count, 1)), (True,))


@dataclass(frozen=True)
class BoundaryPoint:
    """A located point of a stability boundary; `p` in the model's order, `rho` the critical multiplier.

    `name` is the parameter whose rise crosses the boundary; `error` is the estimated relative error of its value, `low` and
    `high` bracket it, `residual` is ln |rho| at the point, `others` the largest modulus among the other multipliers, `slope`
    is d ln|rho| / d ln(name), the other parameters fixed: where positive, stability is lost as `name` rises.
    """

    p: Array
    name: str
    rho: complex
    error: float
    low: float
    high: float
    residual: float
    others: float
    slope: float
    status: Status
    orbit: Discretisation

    @property
    def kind(self) -> str:
        """Return `ns`, `pd` or `fold`: the critical multiplier off the real axis, at -1, at +1."""
        return bifurcation_kind(self.rho)

    @property
    def theta(self) -> float:
        """Return the angle of the critical multiplier over one forcing period, in [0, pi]."""
        return float(abs(np.angle(self.rho)))

    def value(self, model: GeneratedModel, name: str) -> float:
        """Return parameter `name` at this point, in um, s, N."""
        return float(self.p[model.index(name)])


def bifurcation_kind(rho: complex) -> str:
    """Return `ns`, `pd` or `fold` for a multiplier off the real axis, negative, positive."""
    if abs(rho.imag) > 1e-7 * abs(rho):
        return "ns"
    return "pd" if rho.real < 0 else "fold"


@dataclass
class _Polished:
    p: Array
    orbit: Discretisation
    rho: ComplexArray
    growth: Array
    residual: Array
    others: Array
    slope: Array
    moved: Array
    converged: Array


_POINTWISE = ("rho", "growth", "residual", "others", "slope", "moved", "converged")


def polish(
    model: GeneratedModel,
    p: Array,
    orbit: Discretisation,
    target: ComplexArray,
    direction: Direction,
    *,
    tol: float = 1e-8,
    max_mesh: int = 512,
    growth: Array | None = None,
) -> list[BoundaryPoint]:
    """Return boundary points near `p` (n_parameters, B), moved along `direction`, on meshes doubled until `tol` is met.

    `orbit` (B, N, ...) and the multipliers `target` (B,) are the first guess. With the gradients `growth` (B, n+1+k) of
    ln |rho| they are taken for the solution on their own mesh, and what they lack counts as an error of that mesh. A point
    that does not converge, or whose estimated error stays above `tol` on `max_mesh` intervals, says so in its status.
    """
    points: list[BoundaryPoint | None] = [None] * p.shape[1]
    index = np.arange(p.shape[1])
    if growth is not None:
        nothing = np.zeros(p.shape[1])
        coarse = _Polished(p, orbit, target, growth, nothing, nothing, nothing, nothing, np.ones(p.shape[1], bool))
    else:
        coarse = _newton(model, p, orbit, target, direction, None, tol)
    while index.size:
        N = coarse.orbit.x.shape[-2]
        finer = interpolate(coarse.orbit, uniform_mesh(2 * N))
        fine = _newton(model, coarse.p, finer, coarse.rho, direction.part(index), coarse.growth, tol)
        error = np.abs(fine.moved) / RELIED_ON + 1e-12
        converged = coarse.converged & fine.converged
        done = (converged & (error <= tol)) | ~fine.converged | (max_mesh < 4 * N)
        for j in np.nonzero(done)[0]:
            points[index[j]] = _point(
                model, fine, int(j), direction.names[-1], float(error[j]), bool(converged[j]), tol
            )
        keep = np.nonzero(~done)[0]
        index, coarse = index[keep], _select(fine, keep)
    return [q for q in points if q is not None]


def _point(
    model: GeneratedModel, r: _Polished, j: int, name: str, error: float, converged: bool, tol: float
) -> BoundaryPoint:
    value = float(r.p[model.index(name), j])
    status = Status.OK if error <= tol else Status.TOLERANCE
    return BoundaryPoint(
        p=r.p[:, j].copy(),
        name=name,
        rho=complex(r.rho[j]),
        error=error,
        low=value * (1 - error),
        high=value * (1 + error),
        residual=float(r.residual[j]),
        others=float(r.others[j]),
        slope=float(r.slope[j]),
        status=status if converged else Status.NO_CONVERGENCE,
        orbit=r.orbit.part(slice(j, j + 1)),
    )


def _select(r: _Polished, keep: Array) -> _Polished:
    fields = (getattr(r, k)[keep] for k in _POINTWISE)
    return _Polished(r.p[:, keep], r.orbit.part(keep), *fields)


def _newton(
    model: GeneratedModel,
    p: Array,
    orbit: Discretisation,
    target: ComplexArray,
    direction: Direction,
    growth: Array | None,
    tol: float,
) -> _Polished:
    parts = []
    for a in range(0, p.shape[1], CHUNK):
        cut = slice(a, a + CHUNK)
        known = None if growth is None else growth[cut]
        parts.append(_newton_chunk(model, p[:, cut], orbit.part(cut), target[cut], direction.part(cut), known, tol))
    if len(parts) == 1:
        return parts[0]
    fields = (np.concatenate([getattr(q, k) for q in parts]) for k in _POINTWISE)
    return _Polished(np.concatenate([q.p for q in parts], axis=1), join([q.orbit for q in parts]), *fields)


def _newton_chunk(
    model: GeneratedModel,
    p: Array,
    orbit: Discretisation,
    target: ComplexArray,
    direction: Direction,
    growth: Array | None,
    tol: float,
    *,
    max_iterations: int = 14,
) -> _Polished:
    """Solve {periodicity, ln |rho| = 0} in (orbit, distance along `direction`) for a batch on one mesh.

    Known gradients `growth` make chord steps, which are kept up while they gain a factor of ten each.
    """
    B, n = p.shape[1], orbit.x.shape[-1]
    rows = [model.index(name) for name in direction.names]
    r = _Polished(
        p.copy(),
        Discretisation(orbit.x.copy(), orbit.stages.copy(), orbit.edges),
        target.astype(complex).copy(),
        np.full((B, n + 1 + len(rows)), np.nan) if growth is None else growth.copy(),
        np.full(B, np.inf),
        np.full(B, np.nan),
        np.full(B, np.nan),
        np.zeros(B),
        np.zeros(B, bool),
    )
    active, before, chord = np.arange(B), np.full(B, np.inf), growth is not None
    for _ in range(max_iterations):
        if not active.size:
            break
        part, q, line = r.orbit.part(active), r.p[:, active], direction.part(active)
        unit = line.rates(q[rows])  # dp/d(distance), (B, k)
        with np.errstate(all="ignore"):
            try:
                known = r.growth[active] if chord else None
                linear = linearise_boundary(model, q, part, direction.names, r.rho[active], known)
            except np.linalg.LinAlgError:
                break
            matrix, right = _bordered(linear, unit, n, chord)
            finite: Any = np.isfinite(matrix).all(axis=(-1, -2)) & np.isfinite(right).all(axis=-1)
            matrix[~finite] = np.eye(n + 1)
            step = np.linalg.solve(matrix, np.where(finite[:, None], right, 0.0)[..., None])[..., 0]
            dq = np.clip(step[:, n], -LARGEST_STEP, LARGEST_STEP)
            dx, dstages = expand(linear.condensed, step[:, :n], dq[:, None] * unit)
            limit = step_limit(model, dx, dstages)
            change = np.abs(dx / scales(model, q)[:, None, :]).max(axis=(-1, -2))
        r.rho[active], r.growth[active] = linear.rho, linear.growth
        r.others[active] = _largest_other(linear.multipliers, linear.rho)
        usable: Any = finite & np.isfinite(dx).all(axis=(-1, -2)) & np.isfinite(dstages).all(axis=(-1, -2, -3))
        limit = np.where(usable, limit, 0.0)
        dq = np.where(usable, limit * dq, 0.0)
        r.moved[active] += dq
        r.p[np.asarray(rows)[:, None], active] = line.moved(q[rows], dq)
        r.orbit.x[active] += np.where(usable[:, None, None], limit[:, None, None] * dx, 0.0)
        r.orbit.stages[active] += np.where(usable[:, None, None, None], limit[:, None, None, None] * dstages, 0.0)
        size = np.maximum(0.1 * change, np.abs(dq))
        gain = np.where(np.isfinite(before[active]), size / before[active], 0.1)
        left = size * np.clip(gain, size, 1.0) if chord else size * size  # what the step just made leaves behind
        done = usable & (left < 0.01 * tol) & (size < 1e-3)
        r.residual[active] = np.where(done, left, np.abs(linear.g))
        if done.any():
            r.slope[active] = slope_in_last(linear) * q[rows[-1]]
        r.converged[active[done]] = True
        before[active] = size
        if chord and np.any(usable & ~done & (gain > 0.1)):
            chord = False
        active = active[usable & ~done]
    return r


def _bordered(linear: BoundaryLinear, unit: Array, n: int, chord: bool) -> tuple[Array, Array]:
    """Return Newton's matrix (B, n+1, n+1) and right side for dx_0 and the distance along `unit` (B, k)."""
    B = unit.shape[0]
    matrix = np.empty((B, n + 1, n + 1))
    matrix[:, :n, :n] = linear.periodic[..., :n]
    matrix[:, :n, n] = np.einsum("bik,bk->bi", linear.periodic[..., n + 1 :], unit)
    matrix[:, n, :n] = linear.growth[..., :n]
    matrix[:, n, n] = np.einsum("bk,bk->b", linear.growth[..., n + 1 :], unit)
    right = -np.concatenate(
        [linear.periodic[..., n], (linear.g + (0 if chord else linear.growth[..., n]))[:, None]], axis=-1
    )
    return matrix, right


def _largest_other(multipliers: ComplexArray, rho: ComplexArray) -> Array:
    """Return the largest modulus among the multipliers other than `rho` and its conjugate."""
    pair = np.minimum(np.abs(multipliers - rho[:, None]), np.abs(multipliers - rho.conj()[:, None]))
    return np.where(pair < 1e-9 * np.abs(rho)[:, None], 0.0, np.abs(multipliers)).max(axis=-1)
