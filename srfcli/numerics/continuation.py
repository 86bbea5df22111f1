"""Pseudo-arclength continuation of a stability boundary, and all components of one in a window.

The unknowns are the state at tau = 0 and the two unit coordinates q; a step predicts on the cubic through the last two points and
their tangents, and corrects on the hyperplane through the prediction, by Newton steps with the exact gradient. Most points need
but one, which leaves an error far below the final polish. A step is as long as the prediction, the turn of the tangent and the
distance of the curve from its chord allow; meshes grow and shrink on the way.

A curve followed from one point misses what closes on itself, so every sign change on a set of lines is accounted for: by a
branch that passes through it, or by a new branch that starts there. What closes between two lines is not looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import Status
from srfcli.numerics.boundary import BoundaryPoint, Direction, growth_slopes, largest_other, polish, solve_boundary
from srfcli.numerics.collocation import Discretisation, mesh_error
from srfcli.numerics.critical import INTERVALS, LineScan, locate_crossings, scan_line
from srfcli.numerics.orbit import interpolate, scales, uniform_mesh
from srfcli.numerics.plane import Plane, meets, passes

STALE_TANGENT = 0.3  # of the step: a larger correction, in the same norm, spoils the tangent
ORBIT_SHARE = 0.1  # of the orbit's change in that norm
ORDER = 0.3  # power of the share that a correction may grow by, which the step grows by: it goes with the fourth of the step
FEWEST_INTERVALS = 16  # intervals of a mesh that is followed
COARSER = 0.75  # of a mesh: one that suffices with this share of the intervals takes its place
ORBIT_WEIGHT = 0.05  # of the orbit's change in the arclength: regular where the curve has a cusp in the plane

Progress = Callable[[str], None]


@dataclass(frozen=True)
class StepSettings:
    """How far and how carefully a curve is followed; lengths are in the window's unit square."""

    first: float = 0.01
    largest: float = 0.035
    smallest: float = 1e-5
    turn: float = 0.5  # radians between successive tangents, in parameters and state together
    chord: float = 3e-4  # distance of the curve from the chord between two points
    correction: float = 3e-3  # first Newton correction aimed at: a single step then suffices
    tol: float = 2e-5
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
    normal_x: Array | None = None,
    *,
    orientation: CurvePoint | None = None,
    tol: float = 1e-5,
    reach: float = np.inf,
    max_iterations: int = 8,
) -> CurvePoint | None:
    """Return the boundary point on the hyperplane through (orbit, q) with normal (normal_x, normal_q), or None.

    `normal_x` (n,) weighs the state at tau = 0. Without it the hyperplane is a line of the plane: with a unit vector for
    `normal_q` one parameter keeps its value.
    `reach` is the size of the step that led here (`change_size`): a correction that is not small against it makes the tangent
    stale, and the linearisation is taken anew.
    """
    n = orbit.x.shape[-1]
    across = np.concatenate([np.zeros(n) if normal_x is None else normal_x, normal_q])[None, None]
    changes: list[float] = []
    for _ in range(max_iterations):
        p = plane.point(model, q)
        target, rate = np.array([rho]), np.diag(plane.rates(model, p))[None]
        linear = solve_boundary(model, p[:, None], orbit.part(None), plane.names, target, rate, across, columns=2)
        if not (linear.good[0] and np.isfinite(linear.solution).all()):
            return None
        step, tangent = (Discretisation(linear.dx[k, 0], linear.dstages[k, 0], orbit.edges) for k in (0, 1))
        dq, tangent_q = linear.solution[:, 0, n:]
        change = change_size(model, p, dq, step.x)
        if change > 0.5 or (changes and change > 0.7 * changes[-1]):
            return None
        changes.append(change)
        q, orbit, rho = q + dq, orbit + step, complex(linear.rho[0])
        if change < max(tol, min(np.sqrt(tol), STALE_TANGENT * reach)):  # a full Newton step leaves an error of order change^2
            others, slope = float(largest_other(linear.multipliers, linear.rho)[0]), float(growth_slopes(linear)[0, -1])
            found = CurvePoint(q, plane.point(model, q), orbit, rho, others, tangent_q, tangent, slope, correction=changes[0])
            return _normalised(model, found, orientation)
    return None


def change_size(model: GeneratedModel, p: Array, dq: Array, dx: Array) -> float:
    """Return the size of a change of unit coordinates `dq` (2,) and mesh values `dx` (N, n) at parameters `p`."""
    return max(float(np.abs(dq).max()), ORBIT_SHARE * float((np.abs(dx) / scales(model, p)).max()))


def state_size(model: GeneratedModel, p: Array, x: Array) -> Array:
    """Return the scale of the state at tau = 0, `x` (n,), in the arclength at parameters `p`, (n,)."""
    return np.maximum(scales(model, p), np.where(np.array(model.logarithmic), 1.0, np.abs(x)))


def metric(model: GeneratedModel, p: Array, x: Array, change: Array) -> Array:
    """Return the row (n,) whose product with changes of the state `x` (n,) at tau = 0 is their arclength along `change`."""
    return change * (ORBIT_WEIGHT / state_size(model, p, x)) ** 2


def _along_orbit(model: GeneratedModel, point: CurvePoint) -> Array:
    """Return that row along the tangent of a curve at one of its points."""
    return metric(model, point.p, point.orbit.x[0], point.tangent_orbit.x[0])


def _normalised(model: GeneratedModel, point: CurvePoint, orientation: CurvePoint | None) -> CurvePoint:
    """Return `point` with a tangent of unit length that continues that of `orientation`."""
    size = state_size(model, point.p, point.orbit.x[0])
    along_x = point.tangent_orbit.x[0] / size * ORBIT_WEIGHT
    length = float(np.sqrt(point.tangent_q @ point.tangent_q + along_x @ along_x))
    if orientation is not None:
        before = orientation.tangent_orbit.x[0] / size * ORBIT_WEIGHT
        if point.tangent_q @ orientation.tangent_q + along_x @ before < 0:
            length = -length
    return replace(point, tangent_q=point.tangent_q / length, tangent_orbit=(1 / length) * point.tangent_orbit)


def predict(a: CurvePoint, b: CurvePoint | None, ds: float) -> tuple[Array, Discretisation]:
    """Return the prediction a distance `ds` beyond `a`: on the cubic through `a`, the point `b` before it and their tangents."""
    known = b is not None and a.step > 0
    beyond = ds * ds * (ds + a.step) / a.step**2 if known else 0.0
    bent = ds * ds / a.step if known else 0.0
    b = b if b is not None else a

    def ahead(here: Any, tangent: Any, there: Any, other: Any) -> Any:
        moved = here + (ds + bent + beyond) * tangent
        return moved + beyond * other - (bent + 2 * beyond) / a.step * (here - there) if known else moved

    q = ahead(a.q, a.tangent_q, b.q, b.tangent_q)
    return q, ahead(a.orbit, a.tangent_orbit, b.orbit, b.tangent_orbit)


def follow(
    model: GeneratedModel, plane: Plane, start: CurvePoint, settings: StepSettings, *, forward: bool = True
) -> Iterator[CurvePoint | Status]:
    """Yield the points beyond `start` one by one, then the status that ended the curve."""
    start = remeshed(model, plane, start, settings) or start
    current, before = (start if forward else reversed_tangent(start)), None
    ds, first = settings.first, current
    for count in range(settings.max_steps):
        q, orbit = predict(current, before, ds)
        reach = change_size(model, current.p, q - current.q, orbit.x - current.orbit.x)
        across = current.tangent_q, _along_orbit(model, current)
        point = correct(model, plane, q, orbit, current.rho, *across, orientation=current, tol=settings.tol, reach=reach)
        turned, bend = (np.inf, np.inf) if point is None else (_angle(model, current, point), _bend(current, point))
        spoilt = turned > 2 * settings.turn or bend > 2 * settings.chord
        if point is None or spoilt or abs(np.angle(point.rho / current.rho)) > 0.5:
            ds *= 0.4
            if ds < settings.smallest:
                yield Status.STEP_TOO_SMALL
                return
            continue
        point.step = arclength(model, current, point, turned)
        leaving = _edge_crossed(current.q, point.q)
        if leaving is not None:
            landed = _land(model, plane, current, before, leaving)
            if landed is None and ds > settings.smallest:
                ds *= 0.4
                continue
            if landed is not None:
                yield landed
            yield Status.LEFT_WINDOW
            return
        yield point
        if count > 3 and np.linalg.norm(point.q - first.q) < 0.75 * ds and point.tangent_q @ first.tangent_q > 0:
            yield Status.CLOSED
            return
        before, current = current, point
        other = remeshed(model, plane, point, settings)
        if other is not None:
            before, current = _on_mesh(before, other.orbit.edges), replace(other, step=point.step)
        wanted = min(settings.correction, 0.7 * STALE_TANGENT * reach)
        growth = min(
            0.6 * settings.turn / max(turned, 1e-9),
            (wanted / max(point.correction, 1e-9)) ** ORDER,
            (0.6 * settings.chord / max(bend, 1e-9)) ** 0.5,
        )
        ds = min(settings.largest, ds * float(np.clip(growth, 0.5, 1.6)))
    yield Status.MAX_STEPS


def remeshed(model: GeneratedModel, plane: Plane, point: CurvePoint, settings: StepSettings) -> CurvePoint | None:
    """Return `point` on a finer mesh where its own is too coarse, on a coarser one that suffices, None where it may stay."""
    N, error = point.orbit.intervals, float(mesh_error(model, point.orbit))
    # an error goes as N^-8, and half of the settings' is aimed at; a multiple of 4 intervals
    ratio = float(np.clip((2 * np.nan_to_num(error, nan=np.inf) / settings.mesh_error) ** 0.125, 0.25, 4.0))
    mesh = min(max(4 * int(np.ceil(N * ratio / 4)), FEWEST_INTERVALS), max(settings.max_mesh, N))
    if (error <= settings.mesh_error and mesh > COARSER * N) or mesh == N:
        return None
    start, across = _on_mesh(point, uniform_mesh(mesh)), (point.tangent_q, _along_orbit(model, point))
    return correct(model, plane, point.q, start.orbit, point.rho, *across, orientation=start, reach=point.step or np.inf)


def _on_mesh(point: CurvePoint, edges: Array) -> CurvePoint:
    """Return `point` interpolated on another mesh, uncorrected."""
    return replace(point, orbit=interpolate(point.orbit, edges), tangent_orbit=interpolate(point.tangent_orbit, edges))


def arclength(model: GeneratedModel, a: CurvePoint, b: CurvePoint, turned: float) -> float:
    """Return the length of the curve between two points, in parameters and state together, that turns by `turned` (radians)."""
    away = ORBIT_WEIGHT * (b.orbit.x[0] - a.orbit.x[0]) / state_size(model, a.p, a.orbit.x[0])
    return float(np.hypot(np.linalg.norm(b.q - a.q), np.linalg.norm(away))) * (1 + turned**2 / 24)


def _bend(a: CurvePoint, b: CurvePoint) -> float:
    """Return how far the curve strays from the chord between two points, in the plane: the length times the turn, over 8."""
    u, v, chord = a.tangent_q, b.tangent_q, b.q - a.q
    size = np.linalg.norm(u) * np.linalg.norm(v)
    turned = np.arccos(np.clip(u @ v / size, -1.0, 1.0)) if size else 0.0
    return float(np.linalg.norm(chord) * turned / 8)


def _angle(model: GeneratedModel, a: CurvePoint, b: CurvePoint) -> float:
    """Return the angle between the tangents of two points in parameters and state together: small where a cusp is passed."""
    size = state_size(model, a.p, a.orbit.x[0])
    u, v = (np.append(pt.tangent_q, ORBIT_WEIGHT * pt.tangent_orbit.x[0] / size) for pt in (a, b))
    return float(np.arccos(np.clip(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)), -1.0, 1.0)))


def _edge_crossed(a: Array, b: Array) -> tuple[int, float] | None:
    """Return (axis, coordinate) of the window's edge that the segment from a to b leaves through first, or None."""
    shares: dict[tuple[int, float], float] = {}  # of the way to b, at which it does
    for axis in (0, 1):
        for edge, outwards in ((0.0, -1.0), (1.0, 1.0)):
            if outwards * (b[axis] - edge) > 1e-12 and b[axis] != a[axis]:
                shares[axis, edge] = (edge - a[axis]) / (b[axis] - a[axis])
    return min(shares, key=lambda side: shares[side], default=None)


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
    return correct(model, plane, q, orbit, current.rho, np.eye(2)[axis], orientation=current)


def reversed_tangent(point: CurvePoint) -> CurvePoint:
    """Return `point` with its tangent turned round."""
    return replace(point, tangent_q=-point.tangent_q, tangent_orbit=-1.0 * point.tangent_orbit)


def trace(
    model: GeneratedModel,
    plane: Plane,
    start: CurvePoint,
    settings: StepSettings,
    progress: Progress = lambda text: None,
    name: str = "",
) -> Curve:
    """Return the curve through `start`, both ways; after a KeyboardInterrupt as far as it was followed.

    `progress` is told the number of points after each, behind the curve's `name`.
    """
    curve = Curve([start], Status.INTERRUPTED, Status.INTERRUPTED)
    try:
        for forward in (True, False):
            for item in follow(model, plane, start, settings, forward=forward):
                if isinstance(item, CurvePoint):
                    curve.points.insert(len(curve.points) if forward else 0, item if forward else reversed_tangent(item))
                elif forward:
                    curve.end = item
                else:
                    curve.start = item
                progress(f"{name}{len(curve.points)} points")
            if curve.end is Status.CLOSED:
                curve.start = Status.CLOSED
                break
    except KeyboardInterrupt:
        curve.end = Status.INTERRUPTED
    return curve


# All components of a stability boundary in a window: looked for on lines, followed by continuation, polished together.


@dataclass(frozen=True)
class ContinuationSettings:
    """How a window is searched: `lines` of constant x, `samples` along each before refinement, down to `resolution` in ln y."""

    lines: int = 10
    samples: int = 64
    resolution: float = 1e-3
    tol: float = 1e-6
    max_mesh: int = 512
    steps: StepSettings = field(default_factory=StepSettings)


@dataclass(frozen=True)
class Branch:
    """One polished component: points in order along the curve, and why each end stopped."""

    points: tuple[BoundaryPoint, ...]
    start: Status
    end: Status

    @property
    def p(self) -> Array:
        """Return the parameters of the points, (n_parameters, count)."""
        return np.stack([point.p for point in self.points], axis=1)


@dataclass(frozen=True, eq=False)
class Boundary:
    """The components found in a window; `notes` say what was looked at and what was not."""

    plane: Plane
    branches: tuple[Branch, ...] = ()
    scans: tuple[LineScan, ...] = ()
    notes: tuple[str, ...] = ()
    status: Status = Status.OK

    def with_branches(self, branches: Iterable[Branch]) -> Boundary:
        """Return the boundary with these components, too."""
        return replace(self, branches=(*self.branches, *branches))

    def concluded(self, notes: Iterable[str], missed: int) -> Boundary:
        """Return the result of a finished search, which left `missed` sign changes without a boundary point."""
        status = self.status
        if status is Status.OK:
            ends = {end for branch in self.branches for end in (branch.start, branch.end)}
            if missed or not all(point.status.ok for branch in self.branches for point in branch.points):
                status = Status.NO_CONVERGENCE
            else:
                status = next((s for s in (Status.STEP_TOO_SMALL, Status.MAX_STEPS) if s in ends), Status.OK)
        return replace(self, notes=tuple(notes), status=status)


SAME_BOUNDARY = 1e-3  # of the window's height


def find_components(
    model: GeneratedModel, plane: Plane, settings: ContinuationSettings | None = None, *, progress: Progress = lambda text: None
) -> Iterator[Boundary]:
    """Yield the boundary as it grows, after each component; the last one yielded is complete and says so in its notes.

    A KeyboardInterrupt ends the search: what was followed until then is polished and yielded, with status INTERRUPTED.
    """
    settings = settings or ContinuationSettings()
    boundary = Boundary(plane)
    curves: list[Curve] = []
    missed = 0
    try:
        for scan in _scan_lines(model, plane, settings, progress):
            boundary = replace(boundary, scans=(*boundary.scans, scan))
            for bracket in _unclaimed(model, plane, scan, curves):
                start = _starting_point(model, plane, scan, bracket, settings)
                if start is None:
                    missed += 1
                    continue
                if any(
                    abs(h - start.q[1]) < SAME_BOUNDARY and up == (start.slope_y > 0) for h, up in _heights(curves, start.q[0])
                ):
                    continue  # a curve that was followed already, met again from a bracket that the scan's mesh misplaced
                curve = trace(model, plane, start, settings.steps, progress, f"component {len(curves) + 1}: ")
                if len(curve.points) > 1:
                    curves.append(curve)
                    boundary = boundary.with_branches(polish_curve(model, plane, curve, settings))
                if curve.end is Status.INTERRUPTED:
                    raise KeyboardInterrupt
                yield boundary
    except KeyboardInterrupt:
        boundary = replace(boundary, status=Status.INTERRUPTED)
    yield boundary.concluded(_notes(model, boundary, settings, missed), missed)


def _scan_lines(model: GeneratedModel, plane: Plane, settings: ContinuationSettings, progress: Progress) -> Iterator[LineScan]:
    """Yield a scan along y at each of the lines, each with the one before as its first guess."""
    values = plane.y.samples(settings.samples)
    guess: Discretisation | None = None
    for i, x in enumerate(plane.x.samples(max(2, settings.lines))):
        progress(f"line {i + 1} of {settings.lines}")
        scan = scan_line(
            model,
            model.with_values(plane.base, **{plane.x.name: x}),
            plane.y.name,
            values,
            intervals=INTERVALS,
            guess=guess,
            resolution=settings.resolution,
            log=plane.y.log,
        )
        kept = np.searchsorted(scan.values, values)
        guess = scan.orbit.part(np.clip(kept, 0, len(scan.values) - 1))
        if not np.isfinite(scan.g).all():
            guess = None
        yield scan


def _unclaimed(model: GeneratedModel, plane: Plane, scan: LineScan, curves: list[Curve]) -> Iterator[int]:
    """Yield, one by one, the sign changes of `scan` that none of `curves` (which may grow meanwhile) passes through."""
    x = float(plane.x.unit(scan.p[model.index(plane.x.name), 0]))
    y = plane.y.unit(scan.values)
    for i in scan.brackets():
        reach = 0.5 * (y[i + 1] - y[i]) + 2e-3
        if not any(y[i] - reach <= c <= y[i + 1] + reach and up == (scan.g[i] < scan.g[i + 1]) for c, up in _heights(curves, x)):
            yield i


def _heights(curves: list[Curve], x: float) -> list[tuple[float, bool]]:
    """Return where the traced curves meet the line at unit coordinate `x`, and whether stability is lost there as y rises."""
    found = []
    for curve in curves:
        q = curve.q
        for k, share, height in zip(*meets(q, x), strict=True):
            if q[k, 0] != q[k + 1, 0]:
                nearest = curve.points[k if share < 0.5 else k + 1]
                found.append((float(height), nearest.slope_y > 0))
    return found


def _starting_point(
    model: GeneratedModel, plane: Plane, scan: LineScan, bracket: int, settings: ContinuationSettings
) -> CurvePoint | None:
    """Return the boundary point in a sign change of a scan, ready to be followed, or None."""
    base = scan.p[:, bracket]
    tol = settings.steps.mesh_error
    points = locate_crossings(model, base, scan, tol=tol, max_mesh=settings.max_mesh, brackets=[bracket])
    rising = scan.g[bracket] < scan.g[bracket + 1]
    usable = [q for q in points if q.status is not Status.NO_CONVERGENCE and q.others < 1 and (q.slope > 0) == rising]
    if not usable:
        return None
    middle = np.log(scan.values[bracket] * scan.values[bracket + 1]) / 2
    point = min(usable, key=lambda q: abs(np.log(q.value(model, scan.name)) - middle))
    return with_tangent(model, plane, point, 0)


def with_tangent(model: GeneratedModel, plane: Plane, point: BoundaryPoint, axis: int) -> CurvePoint | None:
    """Return a polished point with its tangent, ready to be followed; its parameter on `axis` of the plane stays as it is."""
    q = plane.coordinates(model, point.p)
    return correct(model, plane, q, point.orbit.part(0), point.rho, np.eye(2)[axis])


def polish_curve(model: GeneratedModel, plane: Plane, curve: Curve, settings: ContinuationSettings) -> list[Branch]:
    """Return the stability boundary along a traced curve, polished; parts where another multiplier is unstable are left out.

    Each point moves across the curve's tangent in parameters and state together, so that folds and cusps are as good as any
    other point; end points on the window's edge move along the edge.
    """
    p, rho = np.stack([pt.p for pt in curve.points], axis=1), np.array([pt.rho for pt in curve.points])
    direction, orbits = _across(model, plane, curve.points), [pt.orbit for pt in curve.points]
    parts: list[list[BoundaryPoint]] = [[]]
    for point in polish(model, p, orbits, rho, direction, tol=settings.tol, max_mesh=settings.max_mesh):
        if point.others < 1.0:
            parts[-1].append(point)
        elif parts[-1]:
            parts.append([])
    starts, ends = [Status.OK] * len(parts), [Status.OK] * len(parts)
    starts[0], ends[-1] = curve.start, curve.end
    return [Branch(tuple(b), *stopped) for b, *stopped in zip(parts, starts, ends, strict=True) if len(b) > 1]


def _across(model: GeneratedModel, plane: Plane, points: Sequence[CurvePoint]) -> Direction:
    """Return the hyperplanes across a curve's tangents at its points, along the edge for those on the window's edge."""
    axes = (plane.x, plane.y)
    # of a unit distance: in ln(parameter), or of the window
    length = np.array([1.0 if a.log else a.span for a in axes])
    unit = np.array([1 / a.span if a.log else 1.0 for a in axes])
    rows = []
    for point in points:
        along_x, along_q = _along_orbit(model, point), point.tangent_q
        edge = np.nonzero(np.minimum(np.abs(point.q), np.abs(point.q - 1)) < 1e-9)[0]
        if edge.size:
            along_x, along_q = np.zeros_like(along_x), np.eye(2)[edge[0]]
        rows.append(np.concatenate([along_x, along_q * unit]))
    vectors = np.broadcast_to(np.diag(length), (len(points), 2, 2))
    return Direction(plane.names, vectors, (plane.x.log, plane.y.log), np.array(rows)[:, None, :])


def _notes(model: GeneratedModel, boundary: Boundary, settings: ContinuationSettings, missed: int) -> list[str]:
    plane = boundary.plane
    x, y = ([model.declared(a.name, end) if a.name in model.names else end for end in (a.lo, a.hi)] for a in (plane.x, plane.y))
    lost = sum(len(s.lost) for s in boundary.scans)
    finest = max((s.resolution for s in boundary.scans), default=settings.resolution)
    notes = [
        f"looked at {settings.lines} lines of constant {plane.x.name} from {x[0]:g} to {x[1]:g}, along "
        f"{plane.y.name} from {y[0]:.4g} to {y[1]:.4g}, down to a spacing of {finest:.1g} in ln {plane.y.name}; "
        f"a component that closes between two lines, or a narrower tongue, is not looked for (--scan-lines for more)"
    ]
    if lost:
        notes.append(f"no forced periodic state was found at {lost} samples of the scan; boundaries beside them may be missing")
    if missed:
        notes.append(f"{missed} sign changes on the lines could not be polished to a point of a boundary")
    return notes


def crossing_numbers(model: GeneratedModel, boundary: Boundary) -> list[list[int | None]]:
    """Return, for every point of every branch, its number among the crossings at its x, counted from low y.

    Odd numbers are those where stability is lost as y rises (the paper's footnote). Counted on the polylines of all branches
    and corrected to the parity that the point's own slope shows; None where there is no such slope: where the curve turns round,
    and where a multiplier is +1.
    """
    plane = boundary.plane
    lines = [plane.coordinates(model, b.p) for b in boundary.branches]
    lowest = [bool(s.g[np.isfinite(s.g)][0] < 0) if np.isfinite(s.g).any() else True for s in boundary.scans]
    first = 1 if all(lowest) or not lowest else 2
    numbers: list[list[int | None]] = []
    for branch, own in zip(boundary.branches, lines, strict=True):
        row: list[int | None] = []
        for i, point in enumerate(branch.points):
            x, y = own[i]
            number = first + sum(int((passes(q, x)[1] < y - 1e-12).sum()) for q in lines)  # the point itself is not below
            losing = point.slope > 0
            if (number % 2 == 1) != losing:
                number += 1 if _other_side_below(branch, own, i) else -1
            told = np.isfinite(point.slope) and point.slope != 0 and point.kind != "fold"
            row.append(max(number, 1) if told else None)
        numbers.append(row)
    return numbers


def _other_side_below(branch: Branch, q: Array, i: int) -> bool:
    """Return whether the other side of the fold next to point i of a branch lies below it, where it was not counted."""
    losing = [point.slope > 0 for point in branch.points]
    others = [k for k in range(len(q)) if losing[k] != losing[i]]
    nearest = min(others, key=lambda k: abs(k - i) + float(np.linalg.norm(q[k] - q[i])), default=i)
    return bool(q[nearest, 1] < q[i, 1])
