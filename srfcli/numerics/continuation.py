"""Pseudo-arclength continuation of a stability boundary in a plane of two parameters.

The unknowns are the state at tau = 0 and the two unit coordinates q; a step predicts along the tangent (with the curvature
that the last two tangents show), and corrects on the hyperplane through the prediction. The first correction is a full Newton
step with the exact gradient; those after it reuse the gradient's row, which leaves an error far below the final polish.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.boundary import BoundaryLinear, linearise_boundary, slope_in_last
from srfcli.numerics.collocation import Array, Discretisation, mesh_error, respond, wanted_mesh
from srfcli.numerics.orbit import interpolate, scales, uniform_mesh
from srfcli.numerics.plane import Plane
from srfcli.status import Status

STALE = 0.3  # of the step's length: a larger correction spoils the tangent
ORBIT_WEIGHT = 0.05  # of the orbit's change in the arclength: regular where the curve has a cusp in the plane


@dataclass(frozen=True)
class StepSettings:
    """How far and how carefully a curve is followed; lengths are in the window's unit square."""

    first: float = 0.01
    largest: float = 0.035
    smallest: float = 1e-5
    turn: float = 0.25  # radians between successive tangents
    correction: float = 2e-3  # first Newton correction aimed at: a single step then suffices
    tol: float = 1e-5
    max_steps: int = 3000
    mesh_error: float = 2e-4  # on the mesh that is followed; beyond it the mesh is refined on the way
    max_mesh: int = 512


@dataclass
class CurvePoint:
    """A corrected point: unit coordinates `q`, parameters, orbit, critical multiplier, and the tangent in (orbit, q).

    `slope_y` is d ln|rho|/dy at fixed x: where positive, stability is lost as y rises.
    """

    q: Array
    p: Array
    orbit: Discretisation
    rho: complex
    others: float
    tangent_q: Array
    tangent_orbit: Discretisation
    growth: Array
    slope_y: float = 0.0
    step: float = 0.0
    correction: float = 0.0


@dataclass
class Curve:
    """One branch: its points in order and why each end stopped."""

    points: list[CurvePoint]
    start: Status
    end: Status

    @property
    def q(self) -> Array:
        """Return the unit coordinates of the points, (count, 2)."""
        return np.array([pt.q for pt in self.points])


def correct(
    model: GeneratedModel,
    plane: Plane,
    q: Array,
    orbit: Discretisation,
    rho: complex,
    normal_q: Array,
    normal_x: Array,
    *,
    orientation: CurvePoint | None = None,
    tol: float = 1e-5,
    reach: float = np.inf,
    max_iterations: int = 8,
) -> CurvePoint | None:
    """Return the boundary point on the hyperplane through (orbit, q) with normal (normal_x, normal_q), or None.

    `normal_x` (n,) weighs the state at tau = 0 and may be zero: with normal_q a unit vector the point lies on that grid line.
    `reach` is the length of the step that led here: a correction that is not small against it makes the tangent stale, and
    the linearisation is taken anew.
    """
    n = orbit.x.shape[-1]
    q, orbit = q.copy(), Discretisation(orbit.x.copy(), orbit.stages.copy(), orbit.edges)
    growth: Array | None = None  # kept between iterations where it is still good: a chord step
    previous = first = np.inf
    for iteration in range(max_iterations):
        p = plane.point(model, q)
        with np.errstate(all="ignore"):
            try:
                linear = linearise_boundary(model, p, orbit, plane.names, np.asarray(rho), growth)
                matrix = _matrix(model, plane, p, linear, normal_q, normal_x)
                right = np.zeros((n + 2, 2))
                right[:n, 0] = -linear.periodic[:, n]
                right[n, 0] = -(linear.g + (linear.growth[n] if growth is None else 0.0))
                right[n + 1, 1] = 1.0
                solution = np.linalg.solve(matrix, right)
            except np.linalg.LinAlgError:
                return None
            if not np.isfinite(solution).all():
                return None
            rate = plane.rates(model, p)
            head = np.zeros((n + 3, 2))
            head[:n], head[n, 0], head[n + 1 :] = solution[:n], 1.0, solution[n:] * rate[:, None]
            dxs, dall = respond(linear.condensed, head)
            dx, dstages = dxs[..., 0], dall[..., 0]
        change = max(float(np.abs(solution[n:, 0]).max()), 0.1 * float((np.abs(dx) / scales(model, p)).max()))
        if iteration and change > 0.7 * previous:
            return None
        previous = change
        first = change if iteration == 0 else first
        if change > 0.5:
            return None
        if growth is None:
            tangent_full = solution[:, 1]
            tangent_orbit = Discretisation(dxs[..., 1], dall[..., 1], orbit.edges)
            growth, slope_y = linear.growth, float(slope_in_last(linear))
        small = change < min(np.sqrt(tol), STALE * reach)
        q = q + solution[n:, 0]
        orbit.x += dx
        orbit.stages += dstages
        rho = complex(linear.rho)
        if change < tol or small:  # a full Newton step leaves an error of order change^2
            moduli = np.abs(linear.multipliers)
            pair = np.minimum(np.abs(linear.multipliers - rho), np.abs(linear.multipliers - np.conj(rho))) < 1e-9
            others = float(np.where(pair, 0.0, moduli).max())
            point = CurvePoint(
                q,
                plane.point(model, q),
                orbit,
                rho,
                others,
                tangent_full[n:],
                tangent_orbit,
                growth,
                slope_y,
                correction=first,
            )
            return _normalised(model, point, orientation)
        growth = None if change > STALE * reach or change > 0.05 else growth
    return None


def _matrix(
    model: GeneratedModel, plane: Plane, p: Array, linear: BoundaryLinear, normal_q: Array, normal_x: Array
) -> Array:
    n = normal_x.shape[0]
    matrix = np.empty((n + 2, n + 2))
    rate = plane.rates(model, p)
    matrix[:n, :n] = linear.periodic[:, :n]
    matrix[:n, n:] = linear.periodic[:, n + 1 :] * rate
    matrix[n, :n] = linear.growth[:n]
    matrix[n, n:] = linear.growth[n + 1 :] * rate
    matrix[n + 1, :n], matrix[n + 1, n:] = normal_x, normal_q
    return matrix


def state_size(model: GeneratedModel, p: Array, x: Array) -> Array:
    """Return the scale of the state at tau = 0, `x` (n,), in the arclength at parameters `p`, (n,)."""
    return np.maximum(scales(model, p), np.where(np.array(model.logarithmic), 1.0, np.abs(x)))


def metric(model: GeneratedModel, p: Array, x: Array, change: Array) -> Array:
    """Return the row (n,) whose product with changes of the state `x` (n,) at tau = 0 is their arclength along `change`."""
    return change * (ORBIT_WEIGHT / state_size(model, p, x)) ** 2


def _normalised(model: GeneratedModel, point: CurvePoint, orientation: CurvePoint | None) -> CurvePoint:
    """Return `point` with a tangent of unit length that continues that of `orientation`."""
    size = state_size(model, point.p, point.orbit.x[0])
    along_x = point.tangent_orbit.x[0] / size * ORBIT_WEIGHT
    length = float(np.sqrt(point.tangent_q @ point.tangent_q + along_x @ along_x))
    if orientation is not None:
        before = orientation.tangent_orbit.x[0] / size * ORBIT_WEIGHT
        if point.tangent_q @ orientation.tangent_q + along_x @ before < 0:
            length = -length
    t = point.tangent_orbit
    scaled = Discretisation(t.x / length, t.stages / length, t.edges)
    return replace(point, tangent_q=point.tangent_q / length, tangent_orbit=scaled)


def predict(a: CurvePoint, b: CurvePoint | None, ds: float) -> tuple[Array, Discretisation]:
    """Return the prediction a distance `ds` beyond `a`, with the curvature between `b` and `a` where `b` is the point before."""
    q = a.q + ds * a.tangent_q
    x = a.orbit.x + ds * a.tangent_orbit.x
    stages = a.orbit.stages + ds * a.tangent_orbit.stages
    if b is not None and a.step > 0:
        half = 0.5 * ds * ds / a.step
        q = q + half * (a.tangent_q - b.tangent_q)
        x += half * (a.tangent_orbit.x - b.tangent_orbit.x)
        stages += half * (a.tangent_orbit.stages - b.tangent_orbit.stages)
    return q, Discretisation(x, stages, a.orbit.edges)


def follow(
    model: GeneratedModel, plane: Plane, start: CurvePoint, settings: StepSettings, *, forward: bool = True
) -> Iterator[CurvePoint | Status]:
    """Yield the points beyond `start` one by one, then the status that ended the curve."""
    current, before = (start if forward else reversed_tangent(start)), None
    ds, first = settings.first, current
    for count in range(settings.max_steps):
        q, orbit = predict(current, before, ds)
        point = correct(
            model,
            plane,
            q,
            orbit,
            current.rho,
            current.tangent_q,
            metric(model, current.p, current.orbit.x[0], current.tangent_orbit.x[0]),
            orientation=current,
            tol=settings.tol,
            reach=ds,
        )
        turned = np.inf if point is None else _angle(model, current, point)
        if point is None or turned > 2 * settings.turn or abs(np.angle(point.rho / current.rho)) > 0.5:
            ds *= 0.4
            if ds < settings.smallest:
                yield Status.STEP_TOO_SMALL
                return
            continue
        point.step = ds
        leaving = _edge_crossed(current.q, point.q)
        if leaving is not None:
            landed = _land(model, plane, current, before, leaving)
            if landed is None and ds > settings.smallest:
                ds *= 0.4
                continue
            if landed is not None:
                landed.step = ds
                yield landed
            yield Status.LEFT_WINDOW
            return
        yield point
        if count > 3 and np.linalg.norm(point.q - first.q) < 0.75 * ds and point.tangent_q @ first.tangent_q > 0:
            yield Status.CLOSED
            return
        before, current = current, point
        if mesh_error(model, point.orbit) > settings.mesh_error:
            finer = refined(model, plane, point, settings)
            before, current = (None, finer) if finer is not None else (before, current)
        wanted = min(settings.correction, 0.7 * STALE * ds)
        growth = min(0.6 * settings.turn / max(turned, 1e-9), (wanted / max(point.correction, 1e-9)) ** (1 / 3))
        ds = min(settings.largest, ds * float(np.clip(growth, 0.5, 1.6)))
    yield Status.MAX_STEPS


def refined(model: GeneratedModel, plane: Plane, point: CurvePoint, settings: StepSettings) -> CurvePoint | None:
    """Return `point` on a mesh whose error is half of what the settings allow, or None where it does not converge there."""
    N = len(point.orbit.edges) - 1
    mesh = wanted_mesh(mesh_error(model, point.orbit), N, settings.mesh_error, settings.max_mesh)
    if mesh <= N:
        return None
    edges = uniform_mesh(int(mesh))
    seen = replace(point, tangent_orbit=interpolate(point.tangent_orbit, edges))
    normal_x = metric(model, point.p, point.orbit.x[0], point.tangent_orbit.x[0])
    start = interpolate(point.orbit, edges)
    return correct(
        model, plane, point.q, start, point.rho, point.tangent_q, normal_x, orientation=seen, reach=point.step
    )


def _angle(model: GeneratedModel, a: CurvePoint, b: CurvePoint) -> float:
    """Return the angle between the tangents of two points in parameters and state together: small where a cusp is passed."""
    size = state_size(model, a.p, a.orbit.x[0])
    u, v = (np.append(pt.tangent_q, ORBIT_WEIGHT * pt.tangent_orbit.x[0] / size) for pt in (a, b))
    return float(np.arccos(np.clip(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)), -1.0, 1.0)))


def _edge_crossed(a: Array, b: Array) -> tuple[int, float] | None:
    """Return (axis, coordinate) of the window's edge that the segment from a to b leaves through first, or None."""
    best: tuple[float, int, float] | None = None
    for axis in (0, 1):
        for edge in (0.0, 1.0):
            outside = b[axis] < edge - 1e-12 if edge == 0.0 else b[axis] > edge + 1e-12
            if outside and b[axis] != a[axis]:
                t = (edge - a[axis]) / (b[axis] - a[axis])
                if best is None or t < best[0]:
                    best = (t, axis, edge)
    return None if best is None else (best[1], best[2])


def _land(
    model: GeneratedModel, plane: Plane, current: CurvePoint, before: CurvePoint | None, edge: tuple[int, float]
) -> CurvePoint | None:
    """Return the boundary point on the window's edge next to `current`, or None."""
    axis, coordinate = edge
    gap = coordinate - current.q[axis]
    if abs(gap) < 1e-12:
        return None
    ds = gap / current.tangent_q[axis] if current.tangent_q[axis] else np.inf
    if not 0 < ds < 0.2:
        return None
    q, orbit = predict(current, before, ds)
    q[axis] = coordinate
    normal_x = np.zeros(orbit.x.shape[-1])
    return correct(model, plane, q, orbit, current.rho, np.eye(2)[axis], normal_x, orientation=current)


def reversed_tangent(point: CurvePoint) -> CurvePoint:
    """Return `point` with its tangent turned round."""
    t = point.tangent_orbit
    return replace(point, tangent_q=-point.tangent_q, tangent_orbit=Discretisation(-t.x, -t.stages, t.edges))


def trace(
    model: GeneratedModel, plane: Plane, start: CurvePoint, settings: StepSettings | None = None
) -> Iterator[Curve]:
    """Yield the growing curve through `start` after each point, both ways; the last one yielded is complete."""
    settings = settings or StepSettings()
    curve = Curve([start], Status.INTERRUPTED, Status.INTERRUPTED)
    for item in follow(model, plane, start, settings):
        if isinstance(item, Status):
            curve.end = item
        else:
            curve.points.append(item)
        yield curve
    if curve.end is Status.CLOSED:
        curve.start = Status.CLOSED
        return
    for item in follow(model, plane, start, settings, forward=False):
        if isinstance(item, Status):
            curve.start = item
        else:
            curve.points.insert(0, reversed_tangent(item))
        yield curve
