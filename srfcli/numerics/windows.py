"""Where critical loads are looked for when the user names no window: everywhere that a crossing can be.

Around the critical load without modulation lines are sampled closely. From there they are followed outwards, a decade of load
at a time, until the growth rate has settled: towards high loads it tends to a constant (friction weakens with velocity) or falls
as 1/W0 (it strengthens), towards low loads to a constant or proportionally to W0 (the slider swings on its spring). What has
settled on a quadratic in 1/W0, or in W0, with no zero ahead crosses no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array, mesh_error
from srfcli.numerics.hopf import critical_point
from srfcli.numerics.scan import ROUGHEST, LineScan, scan_line

BELOW, ABOVE = 0.4, 40.0  # times the critical load at eps = 0
STRENGTHENING = (1.0, 400.0)  # um K: where steady sliding is stable at every load
DECADE = 10.0
PER_DECADE = 40  # loads looked at first in each further decade
INTERVALS = {-1: 32, 1: 64}  # below and above: on a coarser mesh stiff multipliers resonate with the intervals at high loads
OVERLAP = 3  # samples that neighbouring pieces share: a crossing at their seam is in one of them
FARTHEST = 4  # decades followed beyond either end
UNEVEN = 0.02  # of the growth rate: what a settled one may differ from its quadratic
MARGIN = 2.0  # of a window beyond the outermost crossing


@dataclass(frozen=True)
class Reach:
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
        reach = follow_outwards(model, base, ends[0], ends[1], resolution=1e-2)
        certain &= reach.settled
        for scan in (*reach.below, *reach.above):
            for i in scan.brackets():
                lowest, highest = min(lowest, scan.values[i] / MARGIN), max(highest, scan.values[i + 1] * MARGIN)
    return LoadWindow(float(lowest), float(highest), float(np.log(highest / lowest) / np.log(hi / lo)), certain)


def follow_outwards(
    model: GeneratedModel, base: Array, low: LineScan, high: LineScan, *, resolution: float = 1e-3
) -> Reach:
    """Return what lies below the scan `low` and above `high`, both along W0 at `base`, until the growth rate settles."""
    below, settled_below = _follow(model, base, low, -1, resolution)
    above, settled_above = _follow(model, base, high, 1, resolution)
    return Reach(below, above, settled_below, settled_above)


def _follow(
    model: GeneratedModel, base: Array, last: LineScan, direction: int, resolution: float
) -> tuple[tuple[LineScan, ...], bool]:
    scans: list[LineScan] = []
    settled = _settled(model, last, direction)
    while not settled and len(scans) < FARTHEST and not (scans and 2 * last.lost.size > last.values.size):
        edge = last.values[OVERLAP - 1] if direction < 0 else last.values[-OVERLAP]
        loads = (edge / DECADE, edge) if direction < 0 else (edge, edge * DECADE)
        last = _piece(model, base, loads, direction, resolution)
        scans.append(last)
        settled = _settled(model, last, direction)
    return tuple(scans), settled


def _piece(
    model: GeneratedModel, base: Array, loads: tuple[float, float], direction: int, resolution: float
) -> LineScan:
    values = np.geomspace(*loads, PER_DECADE)
    return scan_line(model, base, "W0", values, intervals=INTERVALS[direction], resolution=resolution)


def _settled(model: GeneratedModel, scan: LineScan, direction: int) -> bool:
    """Return whether the last decade of a scan in a direction shows that nothing crosses further out."""
    end = scan.values[0] if direction < 0 else scan.values[-1]
    outer = scan.values <= end * DECADE * 1.001 if direction < 0 else scan.values * DECADE * 1.001 >= end
    g, h = scan.g[outer], (scan.values[outer] / end) ** -direction  # 1 at the end, 0 infinitely far out
    if not np.isfinite(g).all() or np.ptp(np.sign(g)) or mesh_error(model, scan.orbit)[outer].max() > ROUGHEST:
        return False
    return bool(_quiet(g, h))


def _quiet(g: Array, h: Array) -> bool:
    """Return whether g is a quadratic in h, to UNEVEN, that has no zero between h = 0 and 1."""
    powers = h[:, None] ** np.arange(3) / np.abs(g)[:, None]
    coefficients = np.linalg.lstsq(powers, np.sign(g), rcond=None)[0]
    if np.abs(powers @ coefficients - np.sign(g)).max() > UNEVEN:
        return False
    ahead = np.array([0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
    values = ahead[:, None] ** np.arange(3) @ coefficients
    return bool((values * g[0] > 0).all())
