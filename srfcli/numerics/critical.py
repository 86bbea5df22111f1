"""Every critical value of one parameter on a line: scanned, bracketed, polished, numbered from the low end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array, Discretisation
from srfcli.numerics.polish import BoundaryPoint, along, polish
from srfcli.numerics.scan import LineScan, scan_line
from srfcli.status import Status

SAMPLES = 192
INTERVALS = 16
DEPTH = 4  # rescans of a bracket that Newton's method left


@dataclass(frozen=True)
class CriticalLine:
    """The critical values of `name` in [lo, hi], rising, and the scan that found them.

    `crossings[i]` numbers points[i] from the low end: odd where stability is lost as the parameter rises.
    """

    name: str
    points: tuple[BoundaryPoint, ...]
    crossings: tuple[int, ...]
    scan: LineScan
    notes: tuple[str, ...]


def critical_line(
    model: GeneratedModel,
    base: Array,
    *,
    name: str = "W0",
    lo: float,
    hi: float,
    tol: float = 1e-8,
    samples: int = SAMPLES,
    resolution: float = 1e-3,
    guess: LineScan | None = None,
    max_mesh: int = 512,
) -> CriticalLine:
    """Return every crossing of the stability boundary along `name` in [lo, hi] at the parameters `base` (n_parameters,).

    A pair of crossings closer than the scan's resolution (in ln name) may be missed; the notes say so where it may matter.
    """
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
    points = locate_crossings(model, base, scan, tol=tol, max_mesh=max_mesh)
    first = np.nonzero(np.isfinite(scan.g))[0]
    stable_below = bool(scan.g[first[0]] < 0) if first.size else True
    crossings = tuple(i + (1 if stable_below else 2) for i in range(len(points)))
    return CriticalLine(name, tuple(points), crossings, scan, tuple(_notes(scan, points, crossings)))


def locate_crossings(
    model: GeneratedModel,
    base: Array,
    scan: LineScan,
    *,
    tol: float,
    max_mesh: int = 512,
    brackets: list[int] | None = None,
    depth: int = 0,
) -> list[BoundaryPoint]:
    """Return the polished boundary point of every sign change of a scan, or of those in `brackets`, rising.

    Newton's method may leave its bracket for a neighbour's root, and a coarse mesh may misplace a bracket; such a bracket is
    scanned again, nine samples on twice the mesh, down to DEPTH levels.
    """
    brackets = scan.brackets() if brackets is None else brackets
    found = []
    for i, point in zip(brackets, polish_brackets(model, scan, brackets, tol=tol, max_mesh=max_mesh), strict=True):
        lower, upper = scan.values[i], scan.values[i + 1]
        margin = (upper / lower) ** 0.5
        inside = lower / margin <= point.value(model, scan.name) <= upper * margin
        rising = scan.g[i] < scan.g[i + 1]
        trusted = inside and point.status is not Status.NO_CONVERGENCE and (point.slope > 0) == rising
        if trusted or depth == DEPTH:
            found.append(point)
            continue
        values = np.geomspace(lower / margin, upper * margin, 9)
        again = scan_line(model, base, scan.name, values, intervals=2 * (len(scan.orbit.edges) - 1), resolution=1e-6)
        found += locate_crossings(model, base, again, tol=tol, max_mesh=max_mesh, depth=depth + 1)
    return _distinct(sorted(found, key=lambda q: q.value(model, scan.name)), model, scan.name)


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


def _notes(scan: LineScan, points: list[BoundaryPoint], crossings: tuple[int, ...]) -> list[str]:
    notes = []
    if scan.lost.size:
        notes.append(
            f"no forced periodic state was found at {scan.lost.size} of {len(scan.values)} samples of {scan.name}"
        )
    for point, crossing in zip(points, crossings, strict=True):
        if point.slope and (point.slope > 0) != (crossing % 2 == 1):
            notes.append(
                f"crossing {crossing} has the wrong direction: a crossing closer than {scan.resolution:.1g} was missed"
            )
    return notes
