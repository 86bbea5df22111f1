"""Points of a stability boundary where something changes; which way a Neimark-Sacker bifurcation opens.

They are folds and cusps of the curve, resonances, and zeros of a caller's function.
Between two neighbouring points of a polished branch a test function of opposite signs is brought to zero (Brent's method);
each trial is corrected onto the boundary on the hyperplane across the chord, which joins the points in parameters and state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from srfcli.codegen.model import COMPLEX_STEP, Array, ComplexArray, GeneratedModel
from srfcli.core.errors import Status
from srfcli.numerics.boundary import BoundaryPoint, bifurcation_kind, left_vector, pick_multiplier, upper_half, weights_backwards
from srfcli.numerics.collocation import (
    Condensed,
    Discretisation,
    by_mesh,
    condense,
    gauss,
    join,
    mesh_error,
    running_products,
    stage_parameters,
)
from srfcli.numerics.continuation import Branch, CurvePoint, correct, metric
from srfcli.numerics.orbit import interpolate
from srfcli.numerics.plane import Plane, polyline_heights

EXACT = 1e-9  # a correction so small leaves the tangent as it is
CHORD_TOLERANCE = 1e-8  # of the chord: where the search for a zero ends
MEETING = 0.05  # of Re(rho) from +1 or -1: a Neimark-Sacker boundary that ends so near ends in a strong resonance
CUSPED = 1e-3  # of the tangent in the plane beside a cusp: what is left of it at the cusp
RESONANCES = {"1:3": 2 * np.pi / 3, "1:4": np.pi / 2}
STRONG_RESONANCES = {"fold": "1:1", "pd": "1:2"}  # where a pair of multipliers meets on the real axis

Test = Callable[[CurvePoint], float]


@dataclass(frozen=True)
class SpecialPoint:
    """A located point: `what` is `fold` (with `axis`, the parameter that turns round), `cusp`, `1:1` to `1:4`, or the caller's.

    `place` counts along the branch, 3.5 between its points 3 and 4; `error` is the estimated relative error of the parameters.
    """

    what: str
    axis: str
    place: float
    p: Array
    rho: complex
    error: float
    status: Status

    @property
    def theta(self) -> float:
        """Return the angle of the critical multiplier over one forcing period, in [0, pi]."""
        return float(abs(np.angle(self.rho)))


def special_points(model: GeneratedModel, plane: Plane, branch: Branch) -> list[SpecialPoint]:
    """Return the folds in either parameter, the cusps and the resonances 1:1 to 1:4 of a branch, in their order along it.

    1:1 and 1:2 are where a Neimark-Sacker boundary goes over into one of multipliers at +1 or -1, or ends; the error of an end
    is the distance over which the multiplier was extrapolated. Cusps are looked for where a multiplier is +1: the folds of two
    pairs of periodic states meet in them, and the other boundaries have none in general.
    """
    found = [*_turns(model, plane, branch), *_resonances(model, plane, branch), *_strong(model, plane, branch)]
    found += _strong_ends(model, branch)
    return sorted(found, key=lambda s: s.place)


def crossings_at(
    model: GeneratedModel, plane: Plane, branches: Sequence[Branch], values: Array, *, folds: bool = True
) -> list[list[float]]:
    """Return for each value of the plane's x parameter the values of y, rising, at which a boundary is crossed there.

    Without `folds` those where a multiplier is +1 are left out.
    """
    lines = [plane.coordinates(model, b.p) for b in branches]
    for line, branch in zip(lines, branches, strict=True):
        line[[not folds and pt.kind == "fold" for pt in branch.points]] = np.nan
    return [plane.y.value(heights).tolist() for heights in polyline_heights(lines, plane.x.unit(values))]


def _turns(model: GeneratedModel, plane: Plane, branch: Branch) -> Iterator[SpecialPoint]:
    """Yield the cusps, and the points at which one of the two parameters turns round."""
    q = plane.coordinates(model, branch.p)
    steps = np.diff(q, axis=0)
    back = steps[:-1] * steps[1:] < 0  # (steps - 1, 2)
    for k in np.nonzero(back.any(axis=1))[0]:
        between = int(k), int(k) + 2
        turned = (steps[k] * steps[k + 1]).sum() < 0 and branch.points[k + 1].kind == "fold"
        cusp = _cusp(model, plane, branch, between, steps[k] / np.linalg.norm(steps[k])) if turned else None
        if cusp is not None:
            yield cusp
            continue
        for axis in np.nonzero(back[k])[0]:

            def turning(point: CurvePoint, axis: int = int(axis)) -> float:
                return float(point.tangent_q[axis] / np.linalg.norm(point.tangent_q))

            yield locate(model, plane, branch, between, turning, what="fold", axis=plane.names[axis])


def _cusp(model: GeneratedModel, plane: Plane, branch: Branch, between: tuple[int, int], forward: Array) -> SpecialPoint | None:
    """Return the cusp between two points of a branch, where the tangent has no part in the plane, or None."""
    left: dict[float, float] = {}  # of the tangent's length in the plane, by its part along `forward`

    def along(point: CurvePoint) -> float:
        part = float(point.tangent_q @ forward)
        left[part] = float(np.linalg.norm(point.tangent_q))
        return part

    found = locate(model, plane, branch, between, along, what="cusp")
    return found if left and left[min(left, key=abs)] < CUSPED * max(left.values()) else None


def _resonances(model: GeneratedModel, plane: Plane, branch: Branch) -> Iterator[SpecialPoint]:
    """Yield where the multiplier of a Neimark-Sacker boundary is a third or fourth root of one."""
    points = branch.points
    for name, angle in RESONANCES.items():
        for k, (a, b) in enumerate(pairwise(points)):
            if a.kind == b.kind == "ns" and (a.theta - angle) * (b.theta - angle) < 0:

                def off(point: CurvePoint, angle: float = angle) -> float:
                    return float(abs(np.angle(point.rho))) - angle

                yield locate(model, plane, branch, (k, k + 1), off, what=name)


def _strong(model: GeneratedModel, plane: Plane, branch: Branch) -> Iterator[SpecialPoint]:
    """Yield where a Neimark-Sacker boundary goes over into a fold or period-doubling one."""
    for k, (a, b) in enumerate(pairwise(branch.points)):
        kinds = {a.kind, b.kind}
        if len(kinds) == 2 and "ns" in kinds:

            def side(point: CurvePoint) -> float:
                return 1.0 if bifurcation_kind(point.rho) == "ns" else -1.0

            what = STRONG_RESONANCES[next(iter(kinds - {"ns"}))]
            yield locate(model, plane, branch, (k, k + 1), side, what=what)


def _strong_ends(model: GeneratedModel, branch: Branch) -> Iterator[SpecialPoint]:
    """Yield where a Neimark-Sacker boundary ends as its multipliers meet: Re(rho), smooth there, extrapolated to +1 or -1."""
    points = branch.points
    for (near, before), place, end in (
        ((points[0], points[1]), 0.0, branch.start),
        ((points[-1], points[-2]), float(len(points) - 1), branch.end),
    ):
        goal = 1.0 if near.rho.real > 0 else -1.0
        left, gone = goal - near.rho.real, near.rho.real - before.rho.real
        meets = near.kind == before.kind == "ns" and abs(left) < MEETING and left * gone > 0
        if end in (Status.LEFT_WINDOW, Status.CLOSED) or not meets:
            continue
        share = left / gone
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where((near.p > 0) & (before.p > 0), near.p / before.p, 1.0)
        p = np.where(ratio != 1.0, near.p * ratio**share, near.p + share * (near.p - before.p))
        error = float(np.abs(np.log(ratio) * share).max()) + near.error
        status = Status.OK if share < 3 else Status.NO_CONVERGENCE
        yield SpecialPoint("1:1" if goal > 0 else "1:2", "", place, p, complex(goal), error, status)


def locate(
    model: GeneratedModel, plane: Plane, branch: Branch, between: tuple[int, int], test: Test, *, what: str, axis: str = ""
) -> SpecialPoint:
    """Return the zero of `test` between two points of a branch; where it is not met, the nearest point with its status."""
    from scipy.optimize import brentq

    chord = _Chord.between(model, plane, branch.points[between[0]], branch.points[between[1]])
    met: list[tuple[float, CurvePoint, float]] = []
    best: tuple[float, CurvePoint, float] | None

    def along(s: float) -> float:
        point = chord.corrected(model, plane, s)
        if point is None:
            raise ValueError("the curve was lost")
        met.append((s, point, test(point)))
        return met[-1][2]

    status = Status.OK
    try:
        zero = brentq(along, 0.0, 1.0, xtol=CHORD_TOLERANCE)
        best = min(met, key=lambda m: abs(m[0] - zero))
    except ValueError:  # or its ends are of one sign
        status, best = Status.NO_CONVERGENCE, min(met, key=lambda m: abs(m[2]), default=None)
    if best is None:  # the branch's own point next to it
        near = branch.points[between[0]]
        return SpecialPoint(what, axis, float(between[0]), near.p, near.rho, np.inf, status)
    s, point, _ = best
    place = between[0] + s * (between[1] - between[0])
    error = float(mesh_error(model, point.orbit)) + (0.0 if status is Status.OK else 1.0)
    return SpecialPoint(what, axis, place, point.p, point.rho, error, status)


@dataclass
class _Chord:
    """The hyperplanes across the chord between two points of a branch, and what was found on them: (share, q, orbit, rho)."""

    q: Array
    across: Array
    found: list[tuple[float, Array, Discretisation, complex]]

    @staticmethod
    def between(model: GeneratedModel, plane: Plane, a: BoundaryPoint, b: BoundaryPoint) -> _Chord:
        """Return the chord from `a` to `b`, its ends on the finer mesh of the two."""
        edges = max((e.orbit.edges for e in (a, b)), key=len)
        ends = [interpolate(e.orbit.part(0), edges) for e in (a, b)]
        q = [plane.coordinates(model, e.p) for e in (a, b)]
        across = metric(model, a.p, 0.5 * (ends[0].x[0] + ends[1].x[0]), ends[1].x[0] - ends[0].x[0])
        return _Chord(q[1] - q[0], across, [(0.0, q[0], ends[0], a.rho), (1.0, q[1], ends[1], b.rho)])

    def corrected(self, model: GeneratedModel, plane: Plane, s: float) -> CurvePoint | None:
        """Return the boundary point on the hyperplane a share `s` along the chord, or None; first guess from those beside it."""
        k = next((k for k, known in enumerate(self.found) if known[0] > s), len(self.found) - 1)
        (s0, q0, a, rho0), (s1, q1, b, rho1) = self.found[k - 1], self.found[k]
        w = (s - s0) / (s1 - s0)
        rho = rho0 if w < 0.5 else rho1
        point = correct(model, plane, (1 - w) * q0 + w * q1, (1 - w) * a + w * b, rho, self.q, self.across, tol=1e-6)
        if point is not None and point.correction > EXACT:  # the tangent is that of the place a correction starts at
            point = correct(model, plane, point.q, point.orbit, point.rho, self.q, self.across, tol=1e-6)
        if point is None:
            return None
        if point.tangent_q @ self.q + point.tangent_orbit.x[0] @ self.across < 0:
            point.tangent_q = -point.tangent_q  # so that a test function of the tangent is continuous
        if s0 < s < s1:
            self.found.insert(k, (s, point.q, point.orbit, point.rho))
        return point


# The normal form of a Neimark-Sacker bifurcation, for the map over one forcing period: its first Lyapunov coefficient d.
#
# On the critical manifold the period map is z -> rho z + c z |z|^2 (Kuznetsov, Elements of Applied Bifurcation Theory, sec. 5.4),
# so that ln|z| grows by g + d |z|^2 a period, d = Re(c/rho): a stable torus of amplitude sqrt(-g/d) beyond the boundary if d < 0,
# an unstable one before it if d > 0. Second and third derivatives of the map are variational equations of higher order along
# the orbit, solved on its own mesh; those of the field are generated second derivatives, and their complex step.

REAL_MULTIPLIER = 1e-6  # a multiplier nearer to the real axis has no normal form of this kind
CRITICALITY = "criticality"
POINTS_TOGETHER = 16  # points whose derivatives fit the cache


def normal_form(model: GeneratedModel, p: Array, orbit: Discretisation, rho: Array) -> tuple[Array, ComplexArray]:
    """Return the first Lyapunov coefficient d (...,) per forcing period and the critical eigenvectors at tau = 0 (..., n).

    `p` is (n_parameters, ...), `rho` the critical multipliers at points of a boundary; both results are NaN where they are
    real. The eigenvectors are in the unit of z: the disturbance of ln v, 2 Re(z q(tau)), has mean |q|^2 = 1 over the period. At
    the resonance 1:3 the coefficient has a pole; at 1:4 it does not tell the whole story.
    """
    c, rho = condense(model, p, orbit), np.asarray(rho, dtype=complex)
    M, identity = c.monodromy, np.eye(orbit.x.shape[-1])
    values, vectors = np.linalg.eig(M)
    chosen = pick_multiplier(values.astype(complex), upper_half(rho))[..., None]
    mu = np.take_along_axis(values, chosen, -1)[..., 0].astype(complex)
    right = np.take_along_axis(vectors, chosen[..., None], -1)[..., 0].astype(complex)
    real = np.abs(mu.imag) < REAL_MULTIPLIER * np.abs(mu)
    wave = _carried(c, right)
    size = np.sqrt((orbit.weights * np.abs(wave[..., model.states.index("ln_v")]) ** 2).sum(axis=(-1, -2)))
    q, wave = right / size[..., None], wave / size[..., None, None, None]
    along = wave.real, wave.imag
    nearby = orbit.stages + 1j * COMPLEX_STEP * np.stack(along)  # (2, ..., N, m, n)
    tau, ps = orbit.phases, stage_parameters(p)
    slopes = model.cycle_jacobian(tau, nearby, ps).imag / COMPLEX_STEP
    F2 = slopes[0] + 1j * slopes[1]  # its product with a is the field's second derivative F2(a, wave)
    sources = [np.einsum("...ij,...j->...i", F2, a) for a in (wave.conj(), wave)]
    forced = []
    for (own, end), s in zip(_forced(c, sources), (1.0, (mu * mu)[..., None, None]), strict=True):
        matrix = np.where(real[..., None, None], identity, s * identity - M)
        forced.append(own + _carried(c, np.linalg.solve(matrix, end[..., None])[..., 0]))
    mean, double = forced
    weights = weights_backwards(c, left_vector(M, mu, q))
    source = 2 * np.einsum("...ij,...j->...i", F2, mean) + np.einsum("...ij,...j->...i", F2.conj(), double)
    # F3(wave, wave, conj(wave)) times the weights: F3(r, r, c) + F3(s, s, c) for c = r and i s
    third = np.zeros_like(wave)
    for part, unit in ((weights.real, 1.0), (weights.imag, 1j)):
        for a in along:
            gradient = model.cycle_bilinear(tau, nearby, ps, part, a).imag / COMPLEX_STEP
            third += unit * a * (gradient[0] + 1j * gradient[1])
    total = (weights * source + third).sum(axis=(-1, -2, -3))
    return np.where(real, np.nan, (0.5 * total / mu).real), np.where(real[..., None], np.nan, q)


def _carried(c: Condensed, start: ComplexArray) -> ComplexArray:
    """Return the solution of the variational equation from `start` (..., n) at tau = 0, at the Gauss points (..., N, m, n)."""
    n = start.shape[-1]
    mesh = c.prefix[..., :-1, :n, :n] @ start[..., None, :, None]
    return np.asarray((c.local[..., :n] @ mesh[..., None, :, :])[..., 0])


def _forced(c: Condensed, sources: Sequence[ComplexArray]) -> list[tuple[ComplexArray, ComplexArray]]:
    """Return the solutions of y' = J y + source from y(0) = 0 at the Gauss points (..., N, m, n), and at tau = 1 (..., n)."""
    *batch, m, n = sources[0].shape
    parts = [part.reshape(*batch, m * n) for source in sources for part in (source.real, source.imag)]
    alone = np.linalg.solve(c.block, np.stack(parts, axis=-1))
    found = []
    for k in range(len(sources)):
        own = (alone[..., 2 * k] + 1j * alone[..., 2 * k + 1]).reshape(*batch, m, n)
        maps = np.zeros((*batch, n + 1, n + 1), complex)
        maps[..., :n, :n], maps[..., n, n] = c.maps[..., :n, :n], 1.0
        maps[..., :n, n] = np.einsum("m,...mn->...n", gauss().step, own)
        y = running_products(maps)[..., :n, n]
        found.append((own + (c.local[..., :n] @ y[..., :-1, None, :, None])[..., 0], y[..., -1, :]))
    return found


def branch_coefficients(model: GeneratedModel, branch: Branch) -> Array:
    """Return the first Lyapunov coefficient at every point of a branch, NaN where the critical multiplier is real."""
    d, points = np.empty(len(branch.points)), branch.points
    for index in by_mesh([pt.orbit for pt in points], POINTS_TOGETHER):
        p = np.stack([points[i].p for i in index], axis=1)
        rho = np.array([points[i].rho for i in index])
        d[index] = normal_form(model, p, join([points[i].orbit for i in index]), rho)[0]
    return d


def criticality_points(model: GeneratedModel, plane: Plane, branch: Branch, coefficients: Array) -> Iterator[SpecialPoint]:
    """Yield where d changes sign along a branch, between its points and not through the pole at 1:3."""
    pole = RESONANCES["1:3"]
    for k, ((a, da), (b, db)) in enumerate(pairwise(zip(branch.points, coefficients, strict=True))):
        if not da * db < 0 or (a.theta - pole) * (b.theta - pole) <= 0:
            continue

        def coefficient(point: CurvePoint) -> float:
            return float(normal_form(model, point.p, point.orbit, np.asarray(point.rho))[0])

        yield locate(model, plane, branch, (k, k + 1), coefficient, what=CRITICALITY)
