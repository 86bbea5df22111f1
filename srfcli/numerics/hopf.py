"""Linear stability of steady sliding under constant load: critical loads, frequencies, and which way the Hopf bifurcation opens.

All roots in W0 of the Hurwitz determinant are found (as polynomial roots where it is a polynomial in W0, else on a scan), those
that belong to a pair of imaginary roots are polished on the exact characteristic polynomial, and crossing is checked. Under
a small load a mass on its spring swings all but undamped, and the determinant is below its rounding: what vanishes there is no
root.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from srfcli.codegen.model import COMPLEX_STEP, Array, GeneratedModel
from srfcli.core.errors import Status

WORST_RESIDUAL = 1e-9
WORST_ROUNDING = 0.1  # part of its load by which rounding may move a root: so near, the slope there stands for the polynomial
DEGENERATE = 1e-12  # of a Lyapunov coefficient, below which it is rounding: as of the classical laws without mass and compliance
SCANNED_LOADS = np.geomspace(1e-9, 1e9, 1801)  # times K * 1 um: loads at which a non-polynomial determinant is looked at


@dataclass(frozen=True)
class HopfPoint:
    """A Hopf bifurcation of steady sliding; loads in N, frequencies in rad/s.

    `crossing_rate` is d Re(s)/dW0 at the root: positive where stability is lost as W0 rises. `lyapunov` is the real part of
    the cubic normal-form coefficient over Omega, for an eigenvector whose ln v component is 1: with z' = s z + c |z|^2 z,
    delta ln v = 2 Re z, so that a negative one is a direct bifurcation. `leading` says that all other roots are stable.
    """

    W0: float
    Omega: float
    crossing_rate: float
    lyapunov: float
    leading: bool
    residual: float

    @property
    def criticality(self) -> str:
        """Return supercritical (stick-slip grows from zero amplitude), subcritical, or degenerate at third order; "" of NaN."""
        if abs(self.lyapunov) < DEGENERATE:
            return "degenerate"
        return "supercritical" if self.lyapunov < 0 else "subcritical" if self.lyapunov > 0 else ""


def hopf_points(model: GeneratedModel, p: Array) -> list[HopfPoint]:
    """Return every Hopf bifurcation in W0 at the parameters `p` (n_parameters,), by rising load; W0 in `p` is not used."""
    points: list[HopfPoint] = []
    for W0 in _candidates(model, p):
        point = _polish(model, p, W0)
        if point is not None and not any(abs(point.W0 / q.W0 - 1) < 1e-9 for q in points):
            points.append(point)
    return sorted(points, key=lambda q: q.W0)


def critical_point(model: GeneratedModel, p: Array) -> tuple[HopfPoint | None, Status]:
    """Return the lowest load at which steady sliding loses stability, or None and the status that says why."""
    for point in hopf_points(model, p):
        if point.leading and point.crossing_rate > 0:
            return point, Status.OK
    return None, Status.NO_HOPF


def weakening(model: GeneratedModel, p: Array) -> float:
    """Return -d mu_ss / d ln V, positive for velocity weakening."""
    V = model.index("V")
    q = p.astype(complex)
    q[V] *= 1 + 1j * COMPLEX_STEP
    with np.errstate(all="ignore"):
        return float(-model.steady_friction(q).imag / COMPLEX_STEP)


def steady_is_stable(model: GeneratedModel, p: Array, W0: float) -> bool | None:
    """Return whether all roots of the characteristic polynomial at load `W0` decay; None where it overflows."""
    with np.errstate(all="ignore"):
        coefficients = np.asarray(model.characteristic(_with_load(model, p, W0)))
    if not np.isfinite(coefficients).all():
        return None
    return bool((np.roots(coefficients[::-1]).real < 0).all())


def closed_forms(model: GeneratedModel, p: Array) -> dict[str, float]:
    """Return the generated closed forms at `p`, where the system has them and they are positive.

    `K_over_W0_rigid` and `Omega_rigid` for kappa to infinity, `K_over_W0_quasistatic` with M to 0 besides (paper's eqs.).
    """
    K, found = float(p[model.index("K")]), {}
    for name, key in (("limit_load", "K_over_W0_rigid"), ("quasistatic_load", "K_over_W0_quasistatic")):
        if name in model.namespace:
            with np.errstate(all="ignore"):
                load = float(model.namespace[name](p))
            if np.isfinite(load) and load > 0:
                found[key] = K / load
    if "closed_frequency" in model.namespace and weakening(model, p) > 0:
        found["Omega_rigid"] = float(model.closed_frequency(p))
    return found


def _with_load(model: GeneratedModel, p: Array, W0: Array | complex | float) -> list[Array | complex | float]:
    q: list[Array | complex | float] = list(p)
    q[model.index("W0")] = W0
    return q


def _candidates(model: GeneratedModel, p: Array) -> list[float]:
    """Return the positive loads at which the last Hurwitz determinant but one vanishes."""
    if model.namespace["HOPF_DEGREE"] >= 0:
        coefficients = np.trim_zeros(np.asarray(model.hurwitz_in_load(p))[::-1], "f")
        if not np.isfinite(coefficients).all() or coefficients.size < 2:
            return []
        roots = np.roots(coefficients)
        real = roots[np.abs(roots.imag) <= 1e-6 * np.abs(roots)].real  # a double root splits by sqrt(rounding)
        return [float(r) for r in real if r > 0]
    loads = SCANNED_LOADS * p[model.index("K")]

    def last_but_one(W0: Array) -> Array:
        with np.errstate(all="ignore"):  # rates may have a pole
            return _hurwitz(model.characteristic(_with_load(model, p, W0)))

    values = last_but_one(loads)
    (i,) = np.nonzero(np.isfinite(values[:-1]) & np.isfinite(values[1:]) & (values[:-1] * values[1:] <= 0))
    a, b = loads[i], loads[i + 1]
    for _ in range(60 if i.size else 0):  # bisection, in all intervals at once: where it rounds there are hundreds
        middle = np.sqrt(a * b)
        above = last_but_one(middle) * values[i] > 0
        a, b = np.where(above, middle, a), np.where(above, b, middle)
    return np.sqrt(a * b).tolist()


def _hurwitz(a: Array) -> Array:
    """Return the Hurwitz determinant of order n-1 of sum a_k s^k for coefficients (..., n+1), scaled to order 1."""
    n = a.shape[-1] - 1
    scale = np.abs(a[..., :1] / a[..., -1:]) ** (1.0 / n)  # roots of order one
    b = a / a[..., -1:] / scale ** np.arange(n, -1, -1)
    i, j = np.indices((n - 1, n - 1))
    k = n - (2 * (j + 1) - (i + 1))
    return np.linalg.det(np.where((k >= 0) & (k <= n), b[..., np.clip(k, 0, n)], 0.0))


def _polish(model: GeneratedModel, p: Array, W0: float) -> HopfPoint | None:
    """Return the Hopf point next to the load `W0` by Newton's method on P(i Omega; W0) = 0, or None where the roots are real."""
    with np.errstate(all="ignore"):
        coefficients = np.asarray(model.characteristic(_with_load(model, p, W0)))
    if not np.isfinite(coefficients).all():  # a pole
        return None
    roots = np.roots(coefficients[::-1])
    pairs = roots[roots.imag > 1e-9 * np.abs(roots)]
    if not pairs.size:
        return None
    nearest = pairs[np.argmin(np.abs(pairs.real / pairs.imag))]
    Omega, residual = float(nearest.imag), np.inf
    if abs(nearest.real) > 1e-2 * Omega:
        return None
    for _ in range(30):
        value, by_s, by_load = characteristic_slopes(model, p, W0, 1j * Omega)
        matrix = by_frequency_and_load(by_s, by_load)
        if abs(np.linalg.det(matrix)) == 0:
            return None
        step = np.linalg.solve(matrix, [-value.real, -value.imag])
        Omega, W0 = Omega + float(step[0]), W0 + float(step[1])
        if W0 <= 0 or Omega <= 0:
            return None
        moved = max(abs(step[0]) / Omega, abs(step[1]) / W0)
        stalled = moved >= residual
        residual = min(residual, moved)
        if moved < 4e-16 or stalled:  # rounding reached
            break
    if residual > WORST_RESIDUAL:
        return None  # not a root: rounding in the determinant
    _, by_s, by_load = characteristic_slopes(model, p, W0, 1j * Omega)
    if not _rounding(model, p, W0, Omega, by_frequency_and_load(by_s, by_load)) < WORST_ROUNDING:
        return None  # rounding in the polynomial itself
    roots = np.roots(np.asarray(model.characteristic(_with_load(model, p, W0)))[::-1])
    others = roots[np.abs(np.abs(roots.imag) - Omega) + np.abs(roots.real) > 1e-5 * Omega]
    return HopfPoint(
        W0=W0,
        Omega=Omega,
        crossing_rate=float(-(by_load / by_s).real),
        lyapunov=lyapunov_coefficient(model, model.with_values(p, W0=W0), Omega),
        leading=bool(np.all(others.real < 0)),
        residual=float(residual),
    )


def characteristic_slopes(
    model: GeneratedModel, p: Array, W0: float, s: complex, name: str = "W0"
) -> tuple[complex, complex, complex]:
    """Return the characteristic polynomial at load `W0` and s, and its derivatives by s and by parameter `name`."""
    q = np.array(_with_load(model, p, W0), dtype=complex)
    h = COMPLEX_STEP * (abs(q[model.index(name)]) or 1.0)
    q[model.index(name)] += 1j * h
    a = np.asarray(model.characteristic(q))
    powers = s ** np.arange(a.shape[-1])
    k = np.arange(1, a.shape[-1])
    return complex(a.real @ powers), complex((k * a.real[1:]) @ powers[:-1]), complex((a.imag / h) @ powers)


def by_frequency_and_load(by_s: complex, by_load: complex) -> Array:
    """Return the derivatives (2, 2) of the real and the imaginary part of P(i Omega; W0) by Omega and W0."""
    return np.array([[(1j * by_s).real, by_load.real], [(1j * by_s).imag, by_load.imag]])


def _rounding(model: GeneratedModel, p: Array, W0: float, Omega: float, matrix: Array) -> float:
    """Return by what part of itself rounding may move the load `W0` of a root i Omega, to first order; `matrix` is P's there.

    A coefficient a_k is a sum of products of parameters. Where every factor of every product is rounded, it changes by up to
    eps sum_j |p_j da_k/dp_j| (complex steps); where the terms of P are powers and are added up, by up to n eps |a_k|.
    """
    if abs(np.linalg.det(matrix)) == 0:
        return math.inf
    q = np.asarray(_with_load(model, p, W0), dtype=float)
    with np.errstate(all="ignore"):  # a power of 0 has no slope by its exponent, and needs none
        moved = np.asarray(model.characteristic(q[:, None] + 1j * np.diag(COMPLEX_STEP * np.abs(q))))  # (n_parameters, n+1)
    n = moved.shape[-1] - 1
    errors = np.nansum(np.abs(moved.imag), axis=0) / COMPLEX_STEP + n * np.abs(model.characteristic(q))
    errors = np.finfo(float).eps * errors * Omega ** np.arange(n + 1)
    real, imaginary = errors[0::2].sum(), errors[1::2].sum()
    return float(np.abs(np.linalg.inv(matrix)[1]) @ [real, imaginary] / W0)


def rest_state(model: GeneratedModel, p: Array) -> tuple[Array, Array]:
    """Return steady sliding and the Jacobian of the rates there, (n,) and (n, n), under constant load."""
    x = model.steady(p)
    V, W0 = p[model.index("V")], p[model.index("W0")]
    return x, model.rates_jacobian(x, V, W0, 0.0, p)


def lyapunov_coefficient(model: GeneratedModel, p: Array, Omega: float) -> float:
    """Return Re(c)/Omega of the normal form z' = i Omega z + c |z|^2 z at a Hopf point (Kuznetsov, eq. 5.62).

    z is scaled so that the perturbation of ln v is 2 Re z. NaN where the Jacobian overflows.
    """
    with np.errstate(all="ignore"):
        x, A = rest_state(model, p)
    if not np.isfinite(A).all():
        return math.nan
    n = x.shape[-1]
    values, vectors = np.linalg.eig(A)
    k = int(np.argmin(np.abs(values - 1j * Omega)))
    q = vectors[:, k] / vectors[model.states.index("ln_v"), k]
    left = np.linalg.inv(vectors)[k] * vectors[model.states.index("ln_v"), k]  # left . q = 1
    identity = np.eye(n)

    def B(a: Array, b: Array) -> Array:
        return model.second(x, p, a, b)

    bar = q.conj()
    cubic = model.third(x, p, q, q, bar)
    mean = np.linalg.solve(A.astype(complex), B(q, bar))
    double = np.linalg.solve(2j * Omega * identity - A, B(q, q))
    c = 0.5 * left @ (cubic - 2 * B(q, mean) + B(bar, double))
    return float(c.real / Omega)
