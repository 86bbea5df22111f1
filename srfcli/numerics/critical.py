"""Every critical value of one parameter on a line: where it is looked for, scanned, bracketed and polished.

Around the critical load without modulation lines are sampled closely. From there they are followed outwards, a decade of load
at a time, until the growth rate has settled: towards high loads it tends to a constant (friction weakens with velocity) or falls
as 1/W0 (it strengthens), towards low loads to a constant or proportionally to W0 (the slider swings on its spring). What has
settled on a quadratic in 1/W0, or in W0, with no zero ahead crosses no more.

g = ln |leading multiplier| over one forcing period. Between two samples a pair of crossings can hide only where |g| is small
against the error of interpolating it, or where the slider's own swing meets a multiple of half the forcing frequency; there
samples are added, down to a stated resolution.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from srfcli.codegen.model import Array, ComplexArray, GeneratedModel
from srfcli.core.errors import Status
from srfcli.motion.imposed import interpolation_error
from srfcli.numerics.boundary import BoundaryPoint, along, pick_multiplier, polish, upper_half
from srfcli.numerics.collocation import Discretisation, join, mesh_error, wanted_mesh
from srfcli.numerics.hopf import critical_point
from srfcli.numerics.orbit import (
    ROUGHEST,
    OrbitBatch,
    between,
    growth,
    interpolate,
    line_orbits,
    neighbours,
    robust_orbits,
    uniform_mesh,
)

SAMPLES = 192
INTERVALS = 16
RESCANS = 4  # rescans of a bracket that Newton's method left
JUMP_SHARE = 0.5  # of the growth rates at a bracket's ends: what stays of them on a quarter of its width where they jump


@dataclass(frozen=True)
class CriticalLine:
    """The critical loads W0 in [lo, hi], rising, and the scan that found them.

    `crossings[i]` numbers points[i] from the low end: odd where stability is lost as the load rises. `outer` is what was
    looked at beyond [lo, hi] where no window was given. `status` is not OK where a crossing may be missing.
    """

    points: tuple[BoundaryPoint, ...]
    crossings: tuple[int, ...]
    scan: LineScan
    notes: tuple[str, ...]
    status: Status = Status.OK
    outer: OuterScans | None = None

    @property
    def scans(self) -> tuple[LineScan, ...]:
        """Return all that was looked at, from low values to high."""
        return (self.scan,) if self.outer is None else (*self.outer.below[::-1], self.scan, *self.outer.above)


def critical_line(
    model: GeneratedModel,
    base: Array,
    *,
    lo: float | None = None,
    hi: float | None = None,
    tol: float = 1e-8,
    samples: int = SAMPLES,
    resolution: float = 1e-3,
    max_mesh: int = 512,
) -> CriticalLine:
    """Return every crossing of the stability boundary along W0 in [lo, hi] at the parameters `base` (n_parameters,).

    Without a window the loads are followed to where the growth rate settles. A pair of crossings closer
    than the scan's resolution (in ln W0) may be missed; the notes say so where it may matter.
    """
    whole = lo is None or hi is None
    if lo is None or hi is None:
        lo, hi = load_window(model, [base])
    scan = scan_line(model, base, "W0", np.geomspace(lo, hi, samples), intervals=INTERVALS, resolution=resolution)
    outer = follow_outwards(model, base, scan, scan, resolution=resolution) if whole else None
    line = CriticalLine((), (), scan, (), outer=outer)
    found = [locate_crossings(model, base, piece, tol=tol, max_mesh=max_mesh) for piece in line.scans]
    points = _distinct([q for part in found for q in part], model, "W0")
    signs = np.concatenate([piece.g for piece in line.scans])
    signs = signs[np.isfinite(signs)]
    stable_below = bool(signs[0] < 0) if signs.size else True
    crossings = tuple(i + (1 if stable_below else 2) for i in range(len(points)))
    notes, status = _notes(model, line, points, crossings)
    return replace(line, points=tuple(points), crossings=crossings, notes=tuple(notes), status=status)


def locate_crossings(
    model: GeneratedModel,
    base: Array,
    scan: LineScan,
    *,
    tol: float,
    max_mesh: int = 512,
    brackets: list[int] | None = None,
    depth: int = 0,
    outer: tuple[float, ...] = (),
) -> list[BoundaryPoint]:
    """Return the polished boundary point of every sign change of a scan, or of those in `brackets`, rising.

    Newton's method may leave its bracket for a neighbour's root, and a coarse mesh may misplace a bracket; such a bracket is
    scanned again, nine samples on twice the mesh, down to RESCANS levels; `outer` holds the growth rates' difference across the
    brackets around this scan. Where that stays twice though the bracket is narrower, the forced state jumps from one branch to
    another, as beyond a fold, and there is no crossing to be located.
    """
    brackets = scan.brackets() if brackets is None else brackets
    found = []
    for i, point in zip(brackets, polish_brackets(model, scan, brackets, tol=tol, max_mesh=max_mesh), strict=True):
        lower, upper = scan.values[i], scan.values[i + 1]
        margin = (upper / lower) ** 0.5
        inside = lower / margin <= point.value(model, scan.name) <= upper * margin
        rising = scan.g[i] < scan.g[i + 1]
        trusted = inside and point.status is not Status.NO_CONVERGENCE and (point.slope > 0) == rising
        across = (*outer, float(abs(scan.g[i + 1] - scan.g[i])))
        if trusted or depth == RESCANS or _jumps(across):
            found.append(point)
            continue
        values = np.geomspace(lower / margin, upper * margin, 9)
        finer = 2 * scan.orbit.intervals
        again = scan_line(model, base, scan.name, values, intervals=finer, resolution=1e-6, tongues=False)
        found += locate_crossings(model, base, again, tol=tol, max_mesh=max_mesh, depth=depth + 1, outer=across)
    return _distinct(found, model, scan.name)


def _jumps(across: tuple[float, ...]) -> bool:
    """Return whether a difference stayed twice though its bracket was narrowed."""
    return len(across) > 2 and across[-1] > JUMP_SHARE * across[-2] > JUMP_SHARE**2 * across[-3]


def _distinct(points: list[BoundaryPoint], model: GeneratedModel, name: str) -> list[BoundaryPoint]:
    """Return `points` by rising values of `name`, those that neighbouring brackets found twice kept once."""
    kept: list[BoundaryPoint] = []
    for point in sorted(points, key=lambda q: q.value(model, name)):
        if kept:
            apart = point.value(model, name) / kept[-1].value(model, name) - 1
            near = max(1e-9, 20 * (point.error + kept[-1].error))
            if apart < near and (point.slope > 0) == (kept[-1].slope > 0):
                continue
        kept.append(point)
    return kept


def polish_brackets(
    model: GeneratedModel, scan: LineScan, brackets: list[int], *, tol: float, max_mesh: int
) -> list[BoundaryPoint]:
    """Return what Newton's method reaches from each of these sign changes of a scan."""
    if not brackets:
        return []
    left = np.array(brackets, dtype=int)
    g0, g1 = scan.g[left], scan.g[left + 1]
    share = g0 / (g0 - g1)
    lower, upper = scan.values[left], scan.values[left + 1]
    p = model.with_values(scan.p[:, left], **{scan.name: lower * (upper / lower) ** share})
    guess = (1 - share) * scan.orbit.part(left) + share * scan.orbit.part(left + 1)
    near = scan.multipliers[np.where(share < 0.5, left, left + 1)]
    unstable = np.where(g0 > 0, left, left + 1)  # on the stable end another multiplier may lead
    chosen = pick_multiplier(near, upper_half(scan.multipliers[unstable, 0]))
    target = upper_half(np.take_along_axis(near, chosen[:, None], axis=-1)[:, 0])
    return polish(model, p, guess, target, along(scan.name, len(left)), tol=tol, max_mesh=max_mesh)


def _notes(
    model: GeneratedModel, line: CriticalLine, points: list[BoundaryPoint], crossings: tuple[int, ...]
) -> tuple[list[str], Status]:
    """Return what is to be said of the search, and OK where nothing of it puts a crossing in doubt."""
    notes, status = [], Status.OK
    for scan in line.scans:
        if scan.lost.size:
            notes.append(
                f"no forced periodic state was found at {scan.lost.size} of {len(scan.values)} samples of W0 between "
                f"{scan.lost.min():.4g} and {scan.lost.max():.4g}"
            )
            status = Status.NO_CONVERGENCE
    expected: bool | None = True  # that stability is lost as the parameter rises; None where it cannot be said
    for point, crossing in zip(points, crossings, strict=True):
        if crossing == crossings[0]:
            expected = crossing % 2 == 1
        if point.status is Status.NO_CONVERGENCE:
            notes.append(
                f"crossing {crossing} near W0 = {point.value(model, 'W0'):.4g} was not located: where the forced state has "
                "several branches they end in folds"
            )
            status, expected = Status.NO_CONVERGENCE, None
            continue
        losing = point.slope > 0 if point.slope else expected
        if expected is not None and losing != expected:
            notes.append(
                f"crossing {crossing} has the wrong direction: a crossing closer than {line.scan.resolution:.1g} was missed"
            )
            status = Status.NO_CONVERGENCE
        expected = None if losing is None else not losing
    if line.outer is not None and not line.outer.settled:
        low, high = line.scans[0].values[0], line.scans[-1].values[-1]
        ends = [f"below {low:.4g} N"] * (not line.outer.settled_below) + [f"above {high:.4g} N"] * (not line.outer.settled_above)
        notes.append(f"the growth rate had not settled: there may be crossings {' and '.join(ends)}")
        status = Status.UNSETTLED
    return notes, status


# Where critical loads are looked for when the user names no window: everywhere that a crossing can be.

BELOW, ABOVE = 0.4, 40.0  # times the critical load at eps = 0
STRENGTHENING = (1.0, 400.0)  # um K: where steady sliding is stable at every load
DECADE = 10.0
PER_DECADE = 40  # loads looked at first in each further decade
# below and above: on a coarser mesh stiff multipliers resonate with the intervals at high loads
WINDOW_INTERVALS = {-1: 32, 1: 64}
OVERLAP = 3  # samples that neighbouring pieces share: a crossing at their seam is in one of them
MOST_DECADES = 4  # decades followed beyond either end
UNSETTLED_SHARE = 0.02  # of the growth rate: what a settled one may differ from its quadratic
NO_LOAD = 1e-6  # of a load: as good as none
WINDOW_MARGIN = 2.0  # of a window beyond the outermost crossing


@dataclass(frozen=True)
class OuterScans:
    """Scans of a line beyond both ends of its window, inner ones first, and whether the growth rate settled in the end."""

    below: tuple[LineScan, ...]
    above: tuple[LineScan, ...]
    settled_below: bool
    settled_above: bool

    @property
    def settled(self) -> bool:
        """Return whether no crossing is left beyond either end."""
        return self.settled_below and self.settled_above


def load_window(model: GeneratedModel, points: Sequence[Array]) -> tuple[float, float]:
    """Return the loads (N) around the critical ones at eps = 0, at these parameters (n_parameters,)."""
    loads = [q.W0 for q in (critical_point(model, p)[0] for p in points) if q is not None]
    if loads:
        return BELOW * min(loads), ABOVE * max(loads)
    K = float(points[0][model.index("K")])
    return STRENGTHENING[0] * K, STRENGTHENING[1] * K


@dataclass(frozen=True)
class LoadWindow:
    """Loads (N) from `lo` to `hi`, `widening` times as long in ln W0 as around eps = 0; `certain` that none cross beyond."""

    lo: float
    hi: float
    widening: float
    certain: bool


def found_window(model: GeneratedModel, points: Sequence[Array]) -> LoadWindow:
    """Return the loads that hold every crossing on the lines through `points`: those of `load_window`, and what lies beyond."""
    lo, hi = load_window(model, points)
    certain, lowest, highest = True, lo, hi
    for base in points:
        ends = [_piece(model, base, loads, d, 1e-2) for d, loads in ((-1, (lo, lo * DECADE)), (1, (hi / DECADE, hi)))]
        outer = follow_outwards(model, base, ends[0], ends[1], resolution=1e-2)
        certain &= outer.settled
        for scan in (*outer.below, *outer.above):
            for i in scan.brackets():
                lowest, highest = min(lowest, scan.values[i] / WINDOW_MARGIN), max(highest, scan.values[i + 1] * WINDOW_MARGIN)
    return LoadWindow(float(lowest), float(highest), float(np.log(highest / lowest) / np.log(hi / lo)), certain)


def follow_outwards(model: GeneratedModel, base: Array, low: LineScan, high: LineScan, *, resolution: float = 1e-3) -> OuterScans:
    """Return scans along W0 at `base` below the scan `low` and above `high`, as far as it takes the growth rate to settle."""
    below, settled_below = _follow(model, base, low, -1, resolution)
    above, settled_above = _follow(model, base, high, 1, resolution)
    return OuterScans(below, above, settled_below, settled_above)


def _follow(
    model: GeneratedModel, base: Array, last: LineScan, direction: int, resolution: float
) -> tuple[tuple[LineScan, ...], bool]:
    scans: list[LineScan] = []
    settled = _settled(model, last, direction)
    while not settled and len(scans) < MOST_DECADES and not (scans and 2 * last.lost.size > last.values.size):
        edge = last.values[OVERLAP - 1] if direction < 0 else last.values[-OVERLAP]
        loads = (edge / DECADE, edge) if direction < 0 else (edge, edge * DECADE)
        last = _piece(model, base, loads, direction, resolution)
        scans.append(last)
        settled = _settled(model, last, direction)
    return tuple(scans), settled


def _piece(model: GeneratedModel, base: Array, loads: tuple[float, float], direction: int, resolution: float) -> LineScan:
    values = np.geomspace(*loads, PER_DECADE)
    return scan_line(model, base, "W0", values, intervals=WINDOW_INTERVALS[direction], resolution=resolution)


def _settled(model: GeneratedModel, scan: LineScan, direction: int) -> bool:
    """Return whether the last decade of a scan in a direction shows that nothing crosses further out."""
    end = scan.values[0] if direction < 0 else scan.values[-1]
    outer = scan.values <= end * DECADE * 1.001 if direction < 0 else scan.values * DECADE * 1.001 >= end
    g, h = scan.g[outer], (scan.values[outer] / end) ** -direction  # 1 at the end, 0 infinitely far out
    if not np.isfinite(g).all() or np.ptp(np.sign(g)) or mesh_error(model, scan.orbit)[outer].max() > ROUGHEST:
        return False
    return bool(_quiet(g, h)) and (direction > 0 or _swing_settled(model, scan))


def _swing_settled(model: GeneratedModel, scan: LineScan) -> bool:
    """Return whether the swing meets no further multiple of pi between the lowest load of a scan and none.

    Towards high loads it meets one after another, of ever higher harmonics of the forcing, which the growth rate shows to fade.
    """
    d, psi, _ = scan.swing[0]
    p = model.with_values(scan.p[:, 0], eps=0.0, **{scan.name: scan.values[0] * NO_LOAD})
    fastest = max(np.linalg.eigvals(model.cycle_jacobian(0.0, model.steady(p), p)), key=lambda value: value.imag)
    ahead = np.floor(np.array([fastest.imag, psi]) / np.pi)
    return bool(ahead[0] == ahead[1] or min(-d, -fastest.real) > DAMPED)


def _quiet(g: Array, h: Array) -> bool:
    """Return whether g is a quadratic in h, to UNSETTLED_SHARE, that has no zero between h = 0 and 1."""
    powers = h[:, None] ** np.arange(3) / np.abs(g)[:, None]
    coefficients = np.linalg.lstsq(powers, np.sign(g), rcond=None)[0]
    if np.abs(powers @ coefficients - np.sign(g)).max() > UNSETTLED_SHARE:
        return False
    ahead = np.array([0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
    values = ahead[:, None] ** np.arange(3) @ coefficients
    return bool((values * g[0] > 0).all())


# The growth rate of a forced periodic state along a line of one parameter, refined where a sign change could hide.

MESH_ERROR = 1e-5  # a hump of g lower than this cannot be told from none
FINEST_MESH = 64


@dataclass
class LineScan:
    """Samples along `name` (rising `values`): multipliers (B, n), `g` (B,), the orbits, and the resolution reached.

    `swing` (B, 3) is the slider's own swing beside the forcing; see `swing_pair`.
    """

    name: str
    p: Array
    values: Array
    multipliers: ComplexArray
    g: Array
    orbit: Discretisation
    swing: Array
    resolution: float

    @property
    def lost(self) -> Array:
        """Return the values at which no orbit was found."""
        return self.values[~np.isfinite(self.g)]

    def brackets(self) -> list[int]:
        """Return the indices i for which g changes sign between values[i] and values[i+1]."""
        left, right = self.g[:-1], self.g[1:]
        return np.nonzero(np.isfinite(left) & np.isfinite(right) & (left * right <= 0) & (left != 0))[0].tolist()


def scan_line(
    model: GeneratedModel,
    base: Array,
    name: str,
    values: Array,
    *,
    intervals: int = 24,
    guess: Discretisation | None = None,
    resolution: float = 1e-3,
    log: bool = True,
    tongues: bool = True,
) -> LineScan:
    """Return the growth rate along parameter `name` through `values` (rising), at the other parameters of `base` (n_parameters,).

    `resolution` is the smallest spacing, in ln(value) where `log`, that halving reaches; `tongues`: whether the places are
    looked at where the slider's swing meets the forcing.
    """
    p = model.with_values(base, **{name: values})
    coordinate = np.log if log else np.asarray
    edges = uniform_mesh(intervals) if guess is None else guess.edges
    batch = _on_sufficient_mesh(model, line_orbits(model, p, coordinate(values), guess, edges))
    scan = _samples(model, name, batch)
    for count in itertools.count():
        position = coordinate(scan.values)
        tongues &= count < SAMPLING_ROUNDS
        close = _suspects(position, scan.g, resolution)
        halves = np.nonzero(close | _rising_inside(position, scan, resolution) if tongues else close)[0]
        left, share = _resonances(position, scan, resolution) if tongues else (halves[:0], np.zeros(0))
        new = ~np.isin(left, halves)
        left, share = np.r_[halves, left[new]], np.r_[np.full(len(halves), 0.5), share[new]]
        if not left.size:
            break
        scan = _with_samples(model, base, scan, left, share, log=log)
    suspects = _suspects(coordinate(scan.values), scan.g, 0.0)
    gaps = np.diff(coordinate(scan.values))
    scan.resolution = float(gaps[suspects].max()) if suspects.any() else float(resolution)
    return scan


def _samples(model: GeneratedModel, name: str, batch: OrbitBatch) -> LineScan:
    """Return orbits along parameter `name` as a scan, its resolution unknown."""
    multipliers, g = growth(batch)
    swing = swing_pair(model, batch.p, batch.orbit, multipliers)
    return LineScan(name, batch.p, batch.p[model.index(name)], multipliers, g, batch.orbit, swing, np.inf)


def _on_sufficient_mesh(model: GeneratedModel, batch: OrbitBatch) -> OrbitBatch:
    """Return the batch on a mesh that shows a growth rate as small as MESH_ERROR, up to FINEST_MESH intervals."""
    N = batch.orbit.intervals
    if batch.converged.all():
        worst = mesh_error(model, batch.orbit).max(keepdims=True)
        mesh = int(wanted_mesh(worst, N, MESH_ERROR, FINEST_MESH)[0])
    else:  # a finer mesh may find what this one could not
        mesh = FINEST_MESH
    if mesh <= N:
        return batch
    edges = uniform_mesh(mesh)
    return robust_orbits(model, batch.p, interpolate(batch.orbit, edges), edges)


def _suspects(position: Array, g: Array, resolution: float) -> Array:
    """Return for each interval whether a pair of crossings could hide in it and it is wider than twice `resolution`.

    It could where the cubic through the interval's ends and their neighbours comes within its error of zero.
    """
    usable = np.isfinite(g)
    error = _cubic_errors(position, g)
    worst = np.maximum(error[:-1], error[1:])
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        nearest = np.minimum(np.minimum(np.abs(g[:-1]), np.abs(g[1:])), _closest_inside(position, g))
        steepness = np.abs(np.diff(g) / np.diff(position))
        around = np.maximum(np.maximum(steepness, np.r_[steepness[:1], steepness[:-1]]), np.r_[steepness[1:], steepness[-1:]])
        close = ~(nearest > worst + MESH_ERROR * around)  # the mesh shifts g by about its slope times that
    same_side = np.sign(g[:-1]) == np.sign(g[1:])
    return usable[:-1] & usable[1:] & close & (np.diff(position) > 2 * resolution) & (same_side | (worst > 0.1))


def _closest_inside(position: Array, g: Array) -> Array:
    """Return how near to zero, on its ends' side, the cubic through four samples comes in each interval; below 0 if across."""
    at = position[:-1, None] + np.diff(position)[:, None] * np.linspace(0.1, 0.9, 9)
    index, weights = neighbours(position, at.ravel(), 4)
    value = (weights * g[index]).sum(axis=-1).reshape(at.shape)
    return (value * np.sign(g[:-1])[:, None]).min(axis=1)


def _cubic_errors(position: Array, g: Array) -> Array:
    """Return for each sample how far it lies from the cubic through its two neighbours on either side, 0 where those lack."""
    if len(g) < 5:
        return np.zeros_like(g)
    return np.pad(np.nan_to_num(interpolation_error(position, g, 2)[0]), 2, mode="edge")


def _with_samples(model: GeneratedModel, base: Array, scan: LineScan, left: Array, share: Array, *, log: bool) -> LineScan:
    """Return `scan` with samples added in the intervals `left` (M,), each at its `share` (M,) of the interval."""
    a, b = scan.values[left], scan.values[left + 1]
    fresh = a * (b / a) ** share if log else a + share * (b - a)
    coordinate, known = np.log if log else np.asarray, np.nonzero(np.isfinite(scan.g))[0]
    guess = between(scan.orbit.part(known), coordinate(scan.values[known]), coordinate(fresh), 4)
    p = model.with_values(base, **{scan.name: fresh})
    added = _samples(model, scan.name, robust_orbits(model, p, guess, scan.orbit.edges))
    order = np.argsort(np.concatenate([scan.values, added.values]))
    values, multipliers, g, swing = (
        np.concatenate([getattr(part, name) for part in (scan, added)])[order] for name in ("values", "multipliers", "g", "swing")
    )
    p, orbit = np.concatenate([scan.p, p], axis=1)[:, order], join([scan.orbit, added.orbit]).part(order)
    return LineScan(scan.name, p, values, multipliers, g, orbit, swing, scan.resolution)


# Where the slider's own swing meets the forcing: tongues that are narrower than the samples' spacing.
#
# A multiplier pair of modulus e^d and angle psi (counted on through all turns) can leave its circle only where psi is a multiple
# of pi. Near one its growth is d + sqrt(delta^2 - (psi - k pi)^2), which needs a half-width delta > |d| to reach zero; and the
# swing that the forcing drives there moves all other multipliers, most at the middle or at |d|/sqrt(3) beside it. With samples
# at these three places the interpolation of g shows what lies between.

FROZEN = 16  # phases at which the Jacobian is looked at
TONGUE_SAMPLES = np.array([-(3**-0.5), 0.0, 3**-0.5])  # of |d|, from a multiple of pi: where samples must be,
CENTRED = 0.25  # and how close, likewise
DAMPED = 1.5  # a swing with |d| above it leaves no tongue that an interval could hide
SAMPLING_ROUNDS = 5  # in which samples are added
HARMONICS = 0.5  # of the mesh's intervals: swings above that many to a period are not resolved


def swing_pair(model: GeneratedModel, p: Array, orbit: Discretisation, multipliers: ComplexArray) -> Array:
    """Return d, psi and the split (B, 3) of the multipliers e^(d +- i psi), or +-e^(d +- split), of the slider's own oscillation.

    psi is 0 where nothing oscillates. The mean over the period of the frozen Jacobian's eigenvalue with the largest imaginary
    part counts the turns; the two multipliers that fit it best, in product and angle, say the rest.
    """
    n, N = multipliers.shape[-1], orbit.x.shape[-2]
    at = np.arange(FROZEN) * N // FROZEN
    with np.errstate(all="ignore"):
        jacobian = model.cycle_jacobian(orbit.edges[at], orbit.x[:, at], p[..., None])
        usable: Any = np.isfinite(multipliers).all(axis=-1) & np.isfinite(jacobian).all(axis=(-1, -2, -3))
        values = np.linalg.eigvals(np.where(usable[:, None, None, None], jacobian, 0.0)).astype(complex)
        fastest = np.argmax(values.imag, axis=-1)[..., None]
        mean = np.take_along_axis(values, fastest, axis=-1)[..., 0].mean(axis=-1)[:, None]
        size, angle = np.log(np.maximum(np.abs(multipliers), 1e-300)), np.abs(np.angle(multipliers))
        one, other = np.triu_indices(n, 1)
        turned = np.abs(angle - np.abs(np.angle(np.exp(1j * mean.imag))))
        off = np.abs(size[:, one] + size[:, other] - 2 * mean.real) + turned[:, one] + turned[:, other]
        pair = np.argmin(np.where(np.isfinite(off), off, np.inf), axis=-1)
    row = np.arange(len(pair))
    a, b = (row, one[pair]), (row, other[pair])
    turns = 2 * np.pi * np.rint(mean.imag[:, 0] / (2 * np.pi))
    psi = np.where(mean.imag[:, 0] > 0, turns + np.where(mean.imag[:, 0] < turns, -angle[a], angle[a]), 0.0)
    found = np.stack([0.5 * (size[a] + size[b]), psi, 0.5 * np.abs(size[a] - size[b])], axis=-1)
    return np.where(usable[:, None], found, np.nan)


def _resonances(position: Array, scan: LineScan, resolution: float) -> tuple[Array, Array]:
    """Return intervals (M,) without a sample where the swing meets a multiple of pi, and where to put one, as shares (M,)."""
    d, psi = scan.swing[:, 0], scan.swing[:, 1]
    low, high = np.fmin(psi[:-1], psi[1:]), np.fmax(psi[:-1], psi[1:])
    damping = np.fmin(-d[:-1], -d[1:])
    most = 2 * np.pi * HARMONICS * scan.orbit.intervals
    with np.errstate(invalid="ignore"):
        usable = (damping > 0) & (damping < DAMPED) & (high < most) & (np.diff(position) > resolution)
    left, share = [], []
    for i in np.nonzero(usable)[0].tolist():
        close = CENTRED * damping[i]
        turns = np.arange(max(1, int(low[i] / np.pi)), int(high[i] / np.pi) + 2)
        places = (np.pi * turns[:, None] + damping[i] * TONGUE_SAMPLES).ravel()
        places = places[(places > low[i] + close) & (places < high[i] - close)]
        if places.size:
            left.append(i)
            share.append((places[places.size // 2] - psi[i]) / (psi[i + 1] - psi[i]))
    return np.array(left, dtype=int), np.array(share)


def _rising_inside(position: Array, scan: LineScan, resolution: float) -> Array:
    """Return for each interval whether a sample at its end lies in a tongue that may reach zero though the sample does not."""
    d, psi, split = scan.swing.T
    with np.errstate(invalid="ignore"):
        hidden = d + split < np.minimum(scan.g - MESH_ERROR, 0.0)  # where it leads g itself shows it
        below = (psi > 1) & (-d < DAMPED) & hidden & (d + np.hypot(split, CENTRED * d) > 0)
    return (below[:-1] | below[1:]) & (np.diff(position) > 2 * resolution) & np.isfinite(scan.g[:-1] + scan.g[1:])
