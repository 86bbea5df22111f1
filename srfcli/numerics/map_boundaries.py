"""The boundary components of a map, and curves of folds where a forced periodic state ends.

Every sign change of a map is accounted for by a curve that passes through it, or by a new curve that starts there. Every stable
state that ends beside a point without one is accounted for by a curve of folds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import Status
from srfcli.numerics.boundary import BoundaryPoint, along, bifurcation_kind, polish
from srfcli.numerics.collocation import stack
from srfcli.numerics.continuation import (
    Boundary,
    ContinuationSettings,
    Curve,
    CurvePoint,
    Progress,
    correct,
    polish_curve,
    trace,
    with_tangent,
)
from srfcli.numerics.critical import locate_crossings, scan_line
from srfcli.numerics.map import Discontinuity, Seed, StabilityMap
from srfcli.numerics.orbit import scales, solve_orbits, steady_guess
from srfcli.numerics.plane import Axis, Plane, meets
from srfcli.numerics.special_points import crossings_at

DENSE = 12  # points of the cubic between two points of a curve, on which seeds are looked for
CURVE_REACH = 1e-3  # of the window: seeds and curves are compared to this
RETRIES = 3  # of a curve that jumped from one side of a tongue to the other
UPRIGHT = 0.05  # of the tangent: where less points along x the slope at fixed x is not to be relied on
MISSED_POINTS = 24  # stable points in a row beside one without an orbit at which no fold is met: orbits were missed
SEED_MARGIN = 0.5  # of a seed's length by which its boundary point may lie outside


@dataclass
class _Traced:
    """The dense polyline (D, 2) of a curve in unit coordinates, with normals (D, 2) to its unstable side.

    `fold` (D,) marks where states end: there neither side is the unstable one.
    """

    line: Array
    unstable: Array
    fold: Array


def find_boundaries(
    model: GeneratedModel,
    found: StabilityMap,
    settings: ContinuationSettings | None = None,
    *,
    progress: Progress = lambda text: None,
) -> Iterator[Boundary]:
    """Yield the boundaries of a map as they grow; the last yielded are complete and say so in their notes.

    A KeyboardInterrupt ends the search: what was followed until then is yielded, with status INTERRUPTED.
    """
    settings = settings or ContinuationSettings()
    boundary = Boundary(found.grid.plane(model))
    waiting = sorted(found.seeds, key=lambda s: (float(np.ptp(s.ends, axis=0).max()), -s.axis))[::-1]
    discontinuities = list(found.discontinuities)
    traced: list[_Traced] = []
    missed: list[Seed] = []
    endless, sifted = 0, False
    try:
        while waiting or discontinuities:
            if waiting:
                seed = waiting.pop(0)
                start = starting_point(model, boundary.plane, seed, settings)
                missed += [seed] if start is None else []
            elif not sifted:
                progress(f"{len(discontinuities)} places where a state may end")
                discontinuities, sifted = not_continued(model, boundary.plane, discontinuities), True
                continue
            else:
                end = continued_end(model, boundary.plane, discontinuities.pop(len(discontinuities) // 2))
                if end is None:
                    continue
                start = fold_at(model, boundary.plane, end)
                endless = 0 if start is not None else endless + 1
                discontinuities = discontinuities if endless < MISSED_POINTS else []
            if start is None or any(_same_place(t, start) for t in traced):
                continue  # met again from a seed that the map's mesh misplaced
            progress(f"boundary {len(traced) + 1}")
            curve = follow_curve(model, boundary.plane, start, settings, progress)
            if len(curve.points) > 1:
                traced.append(_dense(curve))
                boundary = boundary.with_branches(polish_curve(model, boundary.plane, curve, settings))
                waiting = [s for s in waiting if not passes(traced[-1], s)]
                discontinuities = [b for b in discontinuities if not ends_state(traced[-1], b)]
            if curve.end is Status.INTERRUPTED:
                raise KeyboardInterrupt
            yield boundary
    except KeyboardInterrupt:
        boundary = replace(boundary, status=Status.INTERRUPTED)
    lost = sum(not any(passes(t, seed) for t in traced) for seed in missed)
    notes = map_notes(found)
    if lost:
        notes.append(f"{lost} sign changes of the map could not be polished to a point of a boundary")
    if any(pt.kind == "fold" for b in boundary.branches for pt in b.points):
        notes.append("at a boundary of type fold a forced state ends: beyond it the map shows another one, where it finds any")
    yield boundary.concluded(notes, lost)


def map_notes(found: StabilityMap) -> list[str]:
    """Return what was looked at, and below which size nothing is claimed."""
    x, y, (dx, dy) = found.grid.x, found.grid.y, found.spacing()
    fine = 2**found.settings.depth
    notes = [
        f"looked at {x.count} x {y.count} points of ({x.name}, {y.name}), no farther apart than {dx:.2g} and {dy:.2g} of "
        f"their values, and in cells where a boundary could hide down to 1/{fine} of that ({len(found.extra_at)} points "
        f"more); nothing is claimed of features below that, or smaller than a cell whose corners and their neighbours do "
        f"not show them"
    ]
    if found.lost:
        places = "1 point" if found.lost == 1 else f"{found.lost} points"
        notes.append(f"no forced periodic state was found at {places}; boundaries beside them may be missing")
    if len(found.suspect):
        notes.append(f"in {len(found.suspect)} cells a boundary could still hide below the finest spacing: unresolved there")
    return notes


def starting_point(model: GeneratedModel, plane: Plane, seed: Seed, settings: ContinuationSettings) -> CurvePoint | None:
    """Return the boundary point of a seed, ready to be followed, or None where Newton's method leads elsewhere."""
    axis = (plane.x, plane.y)[seed.axis]
    tol = settings.steps.mesh_error
    direction = along(axis.name, 1, log=axis.log, unit=1.0 if axis.log else axis.span)
    points = polish(model, seed.p[:, None], seed.orbit, np.array([seed.rho]), direction, tol=tol, max_mesh=settings.max_mesh)
    usable = [pt for pt in points if _inside(model, plane, pt, seed)]
    if not usable and axis.log:
        usable = [pt for pt in _searched(model, axis, seed, settings) if _inside(model, plane, pt, seed)]
    if not usable:
        return None
    return with_tangent(model, plane, usable[0], 1 - seed.axis)


def _inside(model: GeneratedModel, plane: Plane, point: BoundaryPoint, seed: Seed) -> bool:
    """Return whether `point` is the boundary between the seed's ends."""
    if point.status is Status.NO_CONVERGENCE or not point.others < 1 or (point.slope > 0) != seed.rising:
        return False
    low, high = seed.ends[:, seed.axis]
    margin = SEED_MARGIN * (high - low) + CURVE_REACH
    return bool(low - margin <= plane.coordinates(model, point.p)[seed.axis] <= high + margin)


def _searched(model: GeneratedModel, axis: Axis, seed: Seed, settings: ContinuationSettings) -> list[BoundaryPoint]:
    """Return the crossings on the seed's line that a scan on twice its mesh shows."""
    low, high = axis.value(seed.ends[:, seed.axis]).tolist()
    margin = (high / low) ** 0.5
    values = np.geomspace(low / margin, high * margin, 9)
    scan = scan_line(model, seed.p, axis.name, values, intervals=2 * seed.orbit.intervals, resolution=settings.resolution)
    return locate_crossings(model, seed.p, scan, tol=settings.steps.mesh_error, max_mesh=settings.max_mesh, depth=2)


def follow_curve(
    model: GeneratedModel, plane: Plane, start: CurvePoint, settings: ContinuationSettings, progress: Progress
) -> Curve:
    """Return the curve through `start`, both ways; after a KeyboardInterrupt as far as it was followed.

    A step across a narrow tongue lands on its other side, where the curve's unstable side is the other one: it is then followed
    again with shorter steps.
    """
    steps = settings.steps
    for _ in range(RETRIES + 1):
        curve = trace(model, plane, start, steps, progress)
        if curve.end is Status.INTERRUPTED or _in_one_piece(curve):
            break
        steps = replace(
            steps, first=steps.first / 3, largest=steps.largest / 3, turn=steps.turn / 1.5, correction=steps.correction / 4
        )
    return curve


def _in_one_piece(curve: Curve) -> bool:
    """Return whether the curve has its unstable side on one side throughout, and is closed at both ends or at none."""
    if (curve.start is Status.CLOSED) != (curve.end is Status.CLOSED):
        return False
    side = unstable_side(curve)
    return bool((side > 0).all() or (side < 0).all())


def unstable_side(curve: Curve) -> Array:
    """Return, as a sign, on which side of its tangent sliding is unstable, for the points that tell.

    Those are where the curve is not upright and no other multiplier is unstable: beyond a strong resonance the side changes.
    Where a multiplier is +1 there is no such side: the state ends.
    """
    t = np.array([pt.tangent_q for pt in curve.points])
    slope = np.array([pt.slope_y for pt in curve.points])
    others = np.array([pt.others for pt in curve.points])
    clear = (np.abs(t[:, 0]) > UPRIGHT * np.linalg.norm(t, axis=1)) & np.isfinite(slope) & (others < 1) & ~_fold(curve)
    forward = np.sign((t[:-1] * np.diff(curve.q, axis=0)).sum(axis=1))
    forward = np.concatenate([forward, forward[-1:]]) if len(forward) else np.ones(1)
    return np.asarray(np.sign(slope * t[:, 0] * forward)[clear])


def _fold(curve: Curve) -> Array:
    """Return which points of a curve have a multiplier +1."""
    return np.array([bifurcation_kind(pt.rho) == "fold" for pt in curve.points])


def _dense(curve: Curve) -> _Traced:
    """Return the cubics through the points and tangents of a curve, each sampled DENSE times."""
    from scipy.interpolate import CubicHermiteSpline

    q = curve.q
    t = np.array([pt.tangent_q for pt in curve.points])
    unit = t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
    steps = np.diff(q, axis=0)
    chord = np.maximum(np.linalg.norm(steps, axis=1), 1e-12)
    reached = np.concatenate([[0.0], np.cumsum(chord)])
    sign = np.sign((unit[:-1] * steps).sum())  # a curve that was traced backwards has tangents against its order
    places = np.append(reached[:-1, None] + chord[:, None] * np.arange(DENSE) / DENSE, reached[-1])
    line = CubicHermiteSpline(reached, q, sign * unit)(places)
    along_line = np.gradient(line, axis=0)
    left = np.stack([-along_line[:, 1], along_line[:, 0]], axis=1)
    side = unstable_side(curve)  # the same all along
    fold = _fold(curve)
    dense = np.append(np.repeat(fold[:-1], DENSE), fold[-1:])
    return _Traced(line, left * (np.sign(side.sum()) if side.size else 1.0), dense)


def passes(traced: _Traced, seed: Seed) -> bool:
    """Return whether a curve passes through a seed in the seed's direction; folds through one with a multiplier beyond +1."""
    index, near = _met(traced, seed.ends, seed.axis)
    rising = traced.unstable[index, seed.axis] > 0
    alike = np.where(traced.fold[index], bifurcation_kind(seed.rho) == "fold", rising == seed.rising)
    return bool((near & alike).any())


def ends_state(traced: _Traced, discontinuity: Discontinuity) -> bool:
    """Return whether a curve of folds passes between a discontinuity's ends."""
    index, near = _met(traced, discontinuity.ends, discontinuity.axis)
    return bool((near & traced.fold[index]).any())


def _met(traced: _Traced, ends: Array, axis: int) -> tuple[Array, Array]:
    """Return the parts of a curve that meet the line along `axis` through `ends`, and whether they do between these."""
    index, _, height = meets(traced.line, ends[0, 1 - axis], axis)
    low, high = ends[:, axis].min(), ends[:, axis].max()
    reach = 0.25 * (high - low) + CURVE_REACH
    return index, (height >= low - reach) & (height <= high + reach)


def _same_place(traced: _Traced, point: CurvePoint) -> bool:
    """Return whether `point` lies on a traced curve, crossed the same way."""
    a, d = traced.line[:-1], np.diff(traced.line, axis=0)
    away = point.q - a
    share = np.clip((away * d).sum(axis=1) / np.maximum((d * d).sum(axis=1), 1e-300), 0, 1)
    distance = np.linalg.norm(away - share[:, None] * d, axis=1)
    k = int(np.argmin(distance))
    if traced.fold[k]:
        return bool(distance[k] < 0.3 * CURVE_REACH and bifurcation_kind(point.rho) == "fold")
    t = point.tangent_q
    normal = np.array([-t[1], t[0]]) * np.sign(point.slope_y * t[0])
    reach = 0.3 if normal @ traced.unstable[k] > 0 else 0.03  # beside a fold in x the slope's sign is rounding
    return bool(distance[k] < reach * CURVE_REACH)


def unexplained(model: GeneratedModel, found: StabilityMap, boundary: Boundary) -> Array:
    """Return the grid points (count, 2) whose stability is not what the number of boundaries below them says.

    Points beside a boundary, within 2 REACH of the window, are not judged. Folds do not count: a state ends there, and is stable
    on both sides of where two exist. None left over: the curves account for the map.
    """
    p = found.points(model)
    unit = boundary.plane.coordinates(model, p)  # (nx, ny, 2)
    flipped = bool(unit[0, -1, 1] < unit[0, 0, 1])
    values = p[model.index(boundary.plane.x.name), :, 0]
    left = []
    for i, heights in enumerate(crossings_at(model, boundary.plane, boundary.branches, values, folds=False)):
        edges = boundary.plane.y.unit(heights)
        order = np.arange(unit.shape[1])[:: -1 if flipped else 1]
        y, g = unit[i, order, 1], found.growth[i, order]
        clear = np.isfinite(g)
        if edges.size:
            clear &= np.abs(y[:, None] - edges).min(axis=1) > 2 * CURVE_REACH
        odd = (np.searchsorted(edges, y) % 2 == 1) != (g > 0)
        judged = np.nonzero(clear)[0]
        if judged.size and odd[judged].mean() > 0.5:  # unstable at the low end
            odd = ~odd
        left += [(i, int(order[k])) for k in judged[odd[judged]]]
    return np.array(left, dtype=int).reshape(-1, 2)


# Folds of the forced periodic state. A map shows them only indirectly: a stable state ends, and its neighbour has none.

FINEST_STEP = 2.0**-12  # of the way to the neighbour: where the halving of steps ends
SAME_STATE = 0.5  # in logarithms, or V, or um: a larger step of the state is not taken for the same state
MEETS = 0.8  # of the leading multiplier, from where the fold itself is solved for
PATH_STEPS = (3, 8)  # of equal length, in which most states reach their neighbour; those that do not in the first try the next
FOLD_REACH = 0.01  # of the window: a fold farther from where the state was last found is another


def not_continued(
    model: GeneratedModel, plane: Plane, discontinuities: Sequence[Discontinuity], steps: Sequence[int] = PATH_STEPS
) -> list[Discontinuity]:
    """Return the discontinuities whose stable state is not met at their neighbour after a few equal steps.

    Each step starts from the state before with the change of steady sliding, and the change of what remained over the last step.
    """
    left: list[Discontinuity] = []
    by_mesh: dict[int, list[Discontinuity]] = {}
    for discontinuity in discontinuities:
        by_mesh.setdefault(len(discontinuity.orbit.edges), []).append(discontinuity)
    for group in by_mesh.values():
        ends, orbit = np.stack([b.ends for b in group]), stack([b.orbit for b in group])
        before = plane.point(model, ends[:, 0])
        going, change = np.ones(len(group), bool), orbit.unchanged()
        for share in np.arange(1, steps[0] + 1) / steps[0]:
            p = plane.point(model, ends[:, 0] + share * (ends[:, 1] - ends[:, 0]))
            shift = steady_guess(model, p, orbit.edges) - steady_guess(model, before, orbit.edges)
            guess = orbit + shift + change
            found = solve_orbits(model, p, guess, tol=1e-7, max_iterations=10)
            off = (np.abs(found.orbit.x - guess.x) / scales(model, p)[:, None, :]).max(axis=(-1, -2))
            with np.errstate(invalid="ignore"):
                going &= found.converged & (off < SAME_STATE) & (np.abs(found.multipliers[:, 0]) < 1)
            change, orbit, before = found.orbit - orbit - shift, found.orbit, p
        left += [discontinuity for discontinuity, reached in zip(group, going, strict=True) if not reached]
    return not_continued(model, plane, left, steps[1:]) if left and steps[1:] else left


def continued_end(model: GeneratedModel, plane: Plane, discontinuity: Discontinuity) -> Discontinuity | None:
    """Return the discontinuity where the stable state, followed towards the neighbour, ends; None where it is stable there.

    The steps are halved where Newton's method fails, or finds another state or an unstable one, and grow where it hardly moves.
    """
    here, way = discontinuity.ends[0], discontinuity.ends[1] - discontinuity.ends[0]
    share, step, orbit, rho = 0.0, 0.5, discontinuity.orbit, discontinuity.rho
    p, slope = plane.point(model, here), orbit.unchanged()
    while step > FINEST_STEP:
        ahead = min(share + step, 1.0)
        q = plane.point(model, here + ahead * way)
        reach = ahead - share
        shift = steady_guess(model, q, orbit.edges) - steady_guess(model, p, orbit.edges)
        guess = orbit + shift + reach * slope
        found = solve_orbits(model, q[:, None], guess.part(None), max_iterations=10)
        off = float((np.abs(found.orbit.x[0] - guess.x) / scales(model, q)).max())
        leading = complex(found.multipliers[0, 0])
        if not found.converged[0] or off > SAME_STATE or not abs(leading) < 1:
            step /= 2
            continue
        slope = (1 / reach) * (found.orbit.part(0) - orbit - shift)
        share, rho, p, step = ahead, leading, q, 2 * step if off < SAME_STATE / 4 else step
        orbit = found.orbit.part(0)
        if share == 1.0:
            return None
    return Discontinuity(np.array([here + share * way, discontinuity.ends[1]]), discontinuity.axis, rho, orbit)


def fold_at(model: GeneratedModel, plane: Plane, end: Discontinuity) -> CurvePoint | None:
    """Return the fold at which a stable state ends, ready to be followed; None where its leading multiplier is not near +1."""
    if end.rho.real < MEETS or bifurcation_kind(end.rho) != "fold":
        return None
    here = end.ends[0]
    start = correct(model, plane, here, end.orbit, end.rho, np.eye(2)[1 - end.axis], max_iterations=20)
    if start is None or bifurcation_kind(start.rho) != "fold" or not start.others < 1:
        return None
    return start if np.abs(start.q - here).max() < FOLD_REACH else None
