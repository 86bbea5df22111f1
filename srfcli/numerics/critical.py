"""Every critical value of one parameter on a line: scanned, bracketed, polished, numbered from the low end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array, Discretisation
from srfcli.numerics.polish import BoundaryPoint, along, polish
from srfcli.numerics.scan import LineScan, scan_line
from srfcli.numerics.windows import Reach, follow_outwards, load_window
from srfcli.status import Status

SAMPLES = 192
INTERVALS = 16
DEPTH = 4  # rescans of a bracket that Newton's method left
JUMP = 0.5  # of the growth rates at a bracket's ends: what stays of them on a quarter of its width where they jump


@dataclass(frozen=True)
class CriticalLine:
    """The critical values of `name` in [lo, hi], rising, and the scan that found them.

    `crossings[i]` numbers points[i] from the low end: odd where stability is lost as the parameter rises. `reach` is what was
    looked at beyond [lo, hi] where no window was given. `status` is not OK where a crossing may be missing.
    """

    name: str
    points: tuple[BoundaryPoint, ...]
    crossings: tuple[int, ...]
    scan: LineScan
    notes: tuple[str, ...]
    status: Status = Status.OK
    reach: Reach | None = None

    @property
    def scans(self) -> tuple[LineScan, ...]:
        """Return all that was looked at, from low values to high."""
        return (self.scan,) if self.reach is None else (*self.reach.below[::-1], self.scan, *self.reach.above)


def critical_line(
    model: GeneratedModel,
    base: Array,
    *,
    name: str = "W0",
    lo: float | None = None,
    hi: float | None = None,
    tol: float = 1e-8,
    samples: int = SAMPLES,
    resolution: float = 1e-3,
    guess: LineScan | None = None,
    max_mesh: int = 512,
) -> CriticalLine:
    """Return every crossing of the stability boundary along `name` in [lo, hi] at the parameters `base` (n_parameters,).

    Without a window the loads W0 are followed to where the growth rate settles (numerics/windows.py). A pair of crossings closer
    than the scan's resolution (in ln name) may be missed; the notes say so where it may matter.
    """
    whole = lo is None or hi is None
    if lo is None or hi is None:
        lo, hi = load_window(model, [base])
    values = np.geomspace(lo, hi, samples) if guess is None else guess.values
    scan = scan_line(
        model,
        base,
        name,
        values,
        intervals=INTERVALS,
        guess=None if guess is None else guess.orbit,
        resolution=resolution,
    )
    reach = follow_outwards(model, base, scan, scan, resolution=resolution) if whole else None
    line = CriticalLine(name, (), (), scan, (), reach=reach)
    found = [locate_crossings(model, base, piece, tol=tol, max_mesh=max_mesh) for piece in line.scans]
    points = _distinct(sorted((q for part in found for q in part), key=lambda q: q.value(model, name)), model, name)
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
    scanned again, nine samples on twice the mesh, down to DEPTH levels; `outer` holds the growth rates' difference across the
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
        if trusted or depth == DEPTH or _jumps(across):
            found.append(point)
            continue
        values = np.geomspace(lower / margin, upper * margin, 9)
        again = scan_line(model, base, scan.name, values, intervals=2 * (len(scan.orbit.edges) - 1), resolution=1e-6)
        found += locate_crossings(model, base, again, tol=tol, max_mesh=max_mesh, depth=depth + 1, outer=across)
    return _distinct(sorted(found, key=lambda q: q.value(model, scan.name)), model, scan.name)


def _jumps(across: tuple[float, ...]) -> bool:
    """Return whether a difference stayed twice though its bracket was narrowed."""
    return len(across) > 2 and across[-1] > JUMP * across[-2] > JUMP**2 * across[-3]


def _distinct(points: list[BoundaryPoint], model: GeneratedModel, name: str) -> list[BoundaryPoint]:
    """Return `points` (rising) with those that neighbouring brackets found twice kept once."""
    kept: list[BoundaryPoint] = []
    for point in points:
        if kept:
            apart = point.value(model, name) / kept[-1].value(model, name) - 1
            reach = max(1e-9, 20 * (point.error + kept[-1].error))
            if apart < reach and (point.slope > 0) == (kept[-1].slope > 0):
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
    p = scan.p[:, left].copy()
    lower, upper = scan.values[left], scan.values[left + 1]
    p[model.index(scan.name)] = lower * (upper / lower) ** share
    blend = share[:, None, None]
    x = (1 - blend) * scan.orbit.x[left] + blend * scan.orbit.x[left + 1]
    stages = (1 - blend[..., None]) * scan.orbit.stages[left] + blend[..., None] * scan.orbit.stages[left + 1]
    target = scan.multipliers[np.where(share < 0.5, left, left + 1), 0]
    target = target.real + 1j * np.abs(target.imag)
    guess = Discretisation(x, stages, scan.orbit.edges)
    return polish(model, p, guess, target, along(scan.name, len(left)), tol=tol, max_mesh=max_mesh)


def _notes(
    model: GeneratedModel, line: CriticalLine, points: list[BoundaryPoint], crossings: tuple[int, ...]
) -> tuple[list[str], Status]:
    """Return what is to be said of the search, and OK where nothing of it puts a crossing in doubt."""
    notes, status = [], Status.OK
    for scan in line.scans:
        if scan.lost.size:
            span = f"between {scan.lost.min():.4g} and {scan.lost.max():.4g}"
            notes.append(
                f"no forced periodic state was found at {scan.lost.size} of {len(scan.values)} samples of {scan.name} {span}"
            )
            status = Status.NO_CONVERGENCE
    expected: bool | None = True  # that stability is lost as the parameter rises; None where it cannot be said
    for point, crossing in zip(points, crossings, strict=True):
        if crossing == crossings[0]:
            expected = crossing % 2 == 1
        if point.status is Status.NO_CONVERGENCE:
            place = f"{line.scan.name} = {point.value(model, line.scan.name):.4g}"
            notes.append(
                f"crossing {crossing} near {place} was not located: where the forced state has several branches they end in folds"
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
    if line.reach is not None and not line.reach.settled:
        low, high = line.scans[0].values[0], line.scans[-1].values[-1]
        ends = [f"below {low:.4g} N"] * (not line.reach.settled_below) + [f"above {high:.4g} N"] * (
            not line.reach.settled_above
        )
        notes.append(f"the growth rate had not settled: there may be crossings {' and '.join(ends)}")
        status = Status.UNSETTLED
    return notes, status
