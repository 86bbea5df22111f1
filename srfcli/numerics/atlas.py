"""All components of a stability boundary in a window: looked for on lines, followed by continuation, polished together.

A curve followed from one point misses what closes on itself, so every sign change on a set of lines is accounted for: by a
branch that passes through it, or by a new branch that starts there. What closes between two lines is not looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array, Discretisation
from srfcli.numerics.continuation import Curve, CurvePoint, StepSettings, correct, metric, trace
from srfcli.numerics.critical import INTERVALS, locate_crossings
from srfcli.numerics.plane import Plane
from srfcli.numerics.polish import BoundaryPoint, Direction, polish
from srfcli.numerics.scan import LineScan, scan_line
from srfcli.status import Status


@dataclass(frozen=True)
class AtlasSettings:
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


@dataclass
class Atlas:
    """The components found in a window; `notes` say what was looked at and what was not."""

    plane: Plane
    branches: list[Branch]
    scans: list[LineScan]
    notes: list[str]
    status: Status = Status.OK


SAME = 1e-3  # of the window's height
Progress = Callable[[str], None]


def find_components(
    model: GeneratedModel,
    plane: Plane,
    settings: AtlasSettings | None = None,
    *,
    progress: Progress = lambda text: None,
) -> Iterator[Atlas]:
    """Yield the atlas as it grows, after each component; the last one yielded is complete and says so in its notes.

    A KeyboardInterrupt ends the search: what was followed until then is polished and yielded, with status INTERRUPTED.
    """
    settings = settings or AtlasSettings()
    atlas = Atlas(plane, [], [], [])
    curves: list[Curve] = []
    missed = 0
    try:
        for scan in _scan_lines(model, plane, settings, progress):
            atlas.scans.append(scan)
            for bracket in _unclaimed(model, plane, scan, curves):
                start = _starting_point(model, plane, scan, bracket, settings)
                if start is None:
                    missed += 1
                    continue
                if any(
                    abs(h - start.q[1]) < SAME and up == (start.slope_y > 0) for h, up in _heights(curves, start.q[0])
                ):
                    continue  # a curve that was followed already, met again from a bracket that the scan's mesh misplaced
                curve = _follow(model, plane, start, settings, lambda n: progress(_said(curves, n)))
                if len(curve.points) > 1:
                    curves.append(curve)
                    atlas.branches.extend(polish_curve(model, plane, curve, settings))
                if curve.end is Status.INTERRUPTED:
                    raise KeyboardInterrupt
                yield atlas
    except KeyboardInterrupt:
        atlas.status = Status.INTERRUPTED
    atlas.notes = _notes(atlas, settings, missed)
    if atlas.status is Status.OK and (missed or not all(pt.status.ok for b in atlas.branches for pt in b.points)):
        atlas.status = Status.NO_CONVERGENCE
    ends = {end for b in atlas.branches for end in (b.start, b.end)}
    if atlas.status is Status.OK:
        atlas.status = next((e for e in (Status.STEP_TOO_SMALL, Status.MAX_STEPS) if e in ends), Status.OK)
    yield atlas


def _said(curves: list[Curve], points: int) -> str:
    return f"component {len(curves) + 1}: {points} points"


def _follow(
    model: GeneratedModel, plane: Plane, start: CurvePoint, settings: AtlasSettings, count: Callable[[int], None]
) -> Curve:
    """Return the curve through `start`, both ways; after a KeyboardInterrupt as far as it was followed."""
    curve = Curve([start], Status.INTERRUPTED, Status.INTERRUPTED)
    try:
        for curve in trace(model, plane, start, settings.steps):
            count(len(curve.points))
    except KeyboardInterrupt:
        curve.end = Status.INTERRUPTED
    return curve


def _scan_lines(model: GeneratedModel, plane: Plane, settings: AtlasSettings, progress: Progress) -> Iterator[LineScan]:
    """Yield a scan along y at each of the lines, each with the one before as its first guess."""
    values = plane.y.samples(settings.samples)
    guess: Discretisation | None = None
    for i, x in enumerate(plane.x.samples(max(2, settings.lines))):
        progress(f"line {i + 1} of {settings.lines}")
        base = plane.base.copy()
        base[model.index(plane.x.name)] = x
        scan = scan_line(
            model,
            base,
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
    x = float(np.asarray(plane.x.unit(scan.p[model.index(plane.x.name), 0])))
    y = np.asarray(plane.y.unit(scan.values))
    for i in scan.brackets():
        reach = 0.5 * (y[i + 1] - y[i]) + 2e-3
        if not any(
            y[i] - reach <= c <= y[i + 1] + reach and up == (scan.g[i] < scan.g[i + 1]) for c, up in _heights(curves, x)
        ):
            yield i


def _heights(curves: list[Curve], x: float) -> list[tuple[float, bool]]:
    """Return where the traced curves meet the line at unit coordinate `x`, and whether stability is lost there as y rises."""
    found = []
    for curve in curves:
        q = curve.q
        for k in range(len(q) - 1):
            a, b = q[k], q[k + 1]
            if min(a[0], b[0]) - 1e-9 <= x <= max(a[0], b[0]) + 1e-9 and a[0] != b[0]:
                share = np.clip((x - a[0]) / (b[0] - a[0]), 0.0, 1.0)
                nearest = curve.points[k if share < 0.5 else k + 1]
                found.append((float(a[1] + share * (b[1] - a[1])), nearest.slope_y > 0))
    return found


def _starting_point(
    model: GeneratedModel, plane: Plane, scan: LineScan, bracket: int, settings: AtlasSettings
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
    single = Discretisation(point.orbit.x[0], point.orbit.stages[0], point.orbit.edges)
    q = plane.coordinates(model, point.p)
    return correct(model, plane, q, single, point.rho, np.array([1.0, 0.0]), np.zeros(single.x.shape[-1]))


def polish_curve(model: GeneratedModel, plane: Plane, curve: Curve, settings: AtlasSettings) -> list[Branch]:
    """Return the stability boundary along a traced curve, polished; parts where another multiplier is unstable are left out.

    Each point moves across the curve's tangent in parameters and state together, so that folds and cusps are as good as any
    other point; end points on the window's edge move along the edge.
    """
    pts = curve.points
    direction = _across(model, plane, pts)
    polished: list[BoundaryPoint | None] = [None] * len(pts)
    meshes = np.array([len(pt.orbit.edges) for pt in pts])
    for edges in sorted(set(meshes.tolist())):  # np.unique imports numpy.ma
        index = np.nonzero(meshes == edges)[0]
        group = [pts[i] for i in index]
        found = polish(
            model,
            np.stack([pt.p for pt in group], axis=1),
            Discretisation(
                np.stack([pt.orbit.x for pt in group]),
                np.stack([pt.orbit.stages for pt in group]),
                group[0].orbit.edges,
            ),
            np.array([pt.rho for pt in group]),
            direction.part(index),
            tol=settings.tol,
            max_mesh=settings.max_mesh,
            growth=np.stack([pt.growth for pt in group]),
        )
        for i, located in zip(index, found, strict=True):
            polished[i] = located
    branches, part = [], []
    for point in polished:
        if point is not None and point.others < 1.0:
            part.append(point)
        elif part:
            branches.append(part)
            part = []
    branches.append(part)
    whole = len(branches) == 1
    return [
        Branch(
            tuple(b),
            curve.start if whole or i == 0 else Status.OK,
            curve.end if whole or i == len(branches) - 1 else Status.OK,
        )
        for i, b in enumerate(branches)
        if len(b) > 1
    ]


def _across(model: GeneratedModel, plane: Plane, points: Sequence[CurvePoint]) -> Direction:
    """Return the hyperplanes across a curve's tangents at its points, along the edge for those on the window's edge."""
    axes = (plane.x, plane.y)
    length = np.array(
        [1.0 if a.log else a.span for a in axes]
    )  # of a unit distance: in ln(parameter), or of the window
    unit = np.array([1 / a.span if a.log else 1.0 for a in axes])
    rows = []
    for point in points:
        along_x, along_q = metric(model, point.p, point.orbit.x[0], point.tangent_orbit.x[0]), point.tangent_q
        edge = np.nonzero(np.minimum(np.abs(point.q), np.abs(point.q - 1)) < 1e-9)[0]
        if edge.size:
            along_x, along_q = np.zeros_like(along_x), np.eye(2)[edge[0]]
        rows.append(np.concatenate([along_x, along_q * unit]))
    vectors = np.broadcast_to(np.diag(length), (len(points), 2, 2))
    return Direction(plane.names, vectors, (plane.x.log, plane.y.log), np.array(rows)[:, None, :])


def _notes(atlas: Atlas, settings: AtlasSettings, missed: int) -> list[str]:
    plane = atlas.plane
    lost = sum(len(s.lost) for s in atlas.scans)
    finest = max((s.resolution for s in atlas.scans), default=settings.resolution)
    notes = [
        f"looked at {settings.lines} lines of constant {plane.x.name} from {plane.x.lo:g} to {plane.x.hi:g}, along "
        f"{plane.y.name} from {plane.y.lo:.4g} to {plane.y.hi:.4g}, down to a spacing of {finest:.1g} in ln {plane.y.name}; "
        f"a component that closes between two lines, or a narrower tongue, is not looked for (--scan-lines for more)"
    ]
    if lost:
        notes.append(
            f"no forced periodic state was found at {lost} samples of the scan; boundaries beside them may be missing"
        )
    if missed:
        notes.append(f"{missed} sign changes on the lines could not be polished to a point of a boundary")
    return notes


def crossing_numbers(model: GeneratedModel, atlas: Atlas) -> list[list[int | None]]:
    """Return, for every point of every branch, its number among the crossings at its x, counted from low y.

    Odd numbers are those where stability is lost as y rises (the paper's footnote). Counted on the polylines of all branches
    and corrected to the parity that the point's own slope shows; None where there is no such slope: where the curve turns round,
    and where a multiplier is +1.
    """
    plane = atlas.plane
    lines = [plane.coordinates(model, np.stack([pt.p for pt in b.points], axis=1)) for b in atlas.branches]
    lowest = [bool(s.g[np.isfinite(s.g)][0] < 0) if np.isfinite(s.g).any() else True for s in atlas.scans]
    first = 1 if all(lowest) or not lowest else 2
    numbers: list[list[int | None]] = []
    for b, (branch, own) in enumerate(zip(atlas.branches, lines, strict=True)):
        row: list[int | None] = []
        for i, point in enumerate(branch.points):
            below = sum(_crossings_below(q, own[i], skip=i if k == b else None) for k, q in enumerate(lines))
            number = first + below
            losing = point.slope > 0
            if (number % 2 == 1) != losing:
                number += 1 if _nearest_from_below(lines, b, i) else -1
            told = np.isfinite(point.slope) and point.slope != 0 and point.kind != "fold"
            row.append(max(number, 1) if told else None)
        numbers.append(row)
    return numbers


def _crossings_below(q: Array, at: Array, *, skip: int | None) -> int:
    """Return how often the polyline `q` passes x = at[0] below y = at[1]; segments touching point `skip` do not count."""
    a, b = q[:-1], q[1:]
    passes = (a[:, 0] <= at[0]) != (b[:, 0] <= at[0])
    with np.errstate(divide="ignore", invalid="ignore"):
        y = a[:, 1] + (at[0] - a[:, 0]) / (b[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    count = passes & (y < at[1])
    if skip is not None:
        count[max(skip - 1, 0) : skip + 1] = False
    return int(count.sum())


def _nearest_from_below(lines: list[Array], b: int, i: int) -> bool:
    """Return whether the other side of a fold next to point i of branch b lies below it, so that it was not counted."""
    q = lines[b]
    window = q[max(i - 2, 0) : i + 3]
    return bool(np.mean(window[:, 1]) < q[i, 1])
