"""The atlas of places at which a misfit was looked for: its rows in one form, a figure of them, the foremost in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.output.plots import _decade_ticks, house_style, load_matplotlib, name_text
from srfcli.output.recordings import _settle
from srfcli.output.report_runs import BEFORE
from srfcli.output.report_runs import NARROW as NARROW_FIGURE
from srfcli.output.report_text import NARROW, finite, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS = 3  # of an axis, from which it has a panel of its own
BARS = 12  # in a panel of names
FINEST = 240  # columns in which a spectrum is drawn by its maxima
LEVEL = 0.01  # of the p-value adjusted for all that was looked at
WIDE = 100.0  # ratio from which an axis is logarithmic
APART = ("run", "window")  # axes that the figures of the runs show

# name: what it is in words, its unit
AXES: dict[str, tuple[str, str]] = {
    "run": ("run as a whole", "s"),
    "window": ("time window", "s"),
    "time": ("time", "s"),
    "forcing": ("phase of the forcing", "of a period"),
    "cycle": ("phase of stick-slip", "of a period"),
    "frequency": ("frequency", "Hz"),
    "v": ("slip velocity v", "µm/s"),
    "phi": ("age φ", "s"),
    "W": ("load W", "N"),
    "dlnW/dt": ("rate of the load d ln W/dt", "1/s"),
    "position": ("place on the track", "µm"),
    "slip": ("slip", "µm"),
}
ROUNDING = 1e-9  # of an interval's other end: an end below is zero


@dataclass(frozen=True)
class Spot:
    """One place: an interval `low` to `high` of an axis or, where these are NaN, a `name`; `height` is how far it stands out.

    `height` is minus the decimal logarithm of the unadjusted p-value where that is known, else the size of the statistic.
    """

    axis: str
    run: str
    kind: str
    low: float
    high: float
    name: str
    height: float
    p_value: float | None

    @property
    def sure(self) -> bool:
        """True where noise does not do this, all that was looked at being allowed for."""
        return self.p_value is not None and self.p_value < LEVEL

    @property
    def place(self) -> str:
        """Return the place in words, with its unit."""
        if self.name:
            return self.name
        unit = AXES.get(self.axis, ("", ""))[1]
        tail = f"{NARROW}{unit}" if unit else ""
        if self.axis == "frequency" or self.low == self.high:
            return f"{number(0.5 * (self.low + self.high))}{tail}"
        least = ROUNDING * max(abs(self.low), abs(self.high))
        low, high = (0.0 if abs(end) < least else end for end in (self.low, self.high))
        return f"{number(low)} to {number(high)}{tail}"


def spots(rows: Sequence[Mapping[str, Any]]) -> list[Spot]:
    """Return the rows of the atlas, what stands out most first; a row has low and high, or `bin`: an interval or a name."""
    found = []
    for row in rows:
        log_p, statistic, p = row.get("log_p"), row.get("statistic"), row.get("p_value")
        if not finite(log_p) and not finite(statistic):
            continue
        height = -float(log_p) / math.log(10) if finite(log_p) else abs(float(statistic or 0.0))
        place = row.get("bin") if "low" not in row else [row["low"], row["high"]]
        low, high, name = _place(place)
        found.append(
            Spot(str(row.get("axis", "")), str(row.get("run") or ""), str(row.get("kind", "")), low, high, name, height,
                 float(p) if p is not None and finite(p) else None)
        )  # fmt: skip
    return sorted(found, key=lambda s: -s.height)


def _place(value: Any) -> tuple[float, float, str]:
    if isinstance(value, list | tuple) and len(value) == 2 and all(finite(v) for v in value):
        return float(value[0]), float(value[1]), ""
    return (float(value), float(value), "") if finite(value) else (math.nan, math.nan, str(value))


def axis_text(axis: str) -> str:
    """Return what an axis of the atlas is, in words."""
    return AXES.get(axis, (axis, ""))[0]


def foremost(found: Sequence[Spot], *, each: int = 2, most: int = 12) -> list[Spot]:
    """Return what stands out most, `each` of an axis at most."""
    kept: list[Spot] = []
    for spot in found:
        if sum(k.axis == spot.axis for k in kept) < each and len(kept) < most:
            kept.append(spot)
    return kept


def atlas_figure(rows: Sequence[Mapping[str, Any]], *, narrow: bool = False) -> Figure | None:
    """Return a panel for each axis of the atlas with several bins, but runs and windows in time; None where there is none."""
    load_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    by_axis: dict[str, list[Spot]] = {}
    for spot in spots(rows):
        if spot.axis not in APART and spot.kind != "shape":
            by_axis.setdefault(spot.axis, []).append(spot)
    shown = {k: v for k, v in by_axis.items() if len({(s.low, s.high, s.name) for s in v}) >= BINS}
    if not shown:
        return None
    columns = 1 if narrow else min(3, len(shown))
    lines = math.ceil(len(shown) / columns)
    label = "−log$_{10}$ p" if any(finite(r.get("log_p")) for r in rows) else "|statistic|"
    with house_style():
        figure = Figure(figsize=(NARROW_FIGURE if narrow else 3.5 * columns + 0.2, 2.3 * lines + 0.2))
        FigureCanvasAgg(figure)
        panels = figure.subplots(lines, columns, squeeze=False).ravel().tolist()
        for k, (axis, (name, found)) in enumerate(zip(panels, shown.items(), strict=False)):
            about, unit = AXES.get(name, (name_text(name, narrow=narrow), ""))
            axis.set_title(about + (f"  [{unit}]" if unit else ""), fontsize=9.5)
            if math.isfinite(found[0].low):
                _bins(axis, found)
                axis.set_ylabel(label if k % columns == 0 else "")
            else:
                _names(axis, found, narrow=narrow)
                axis.set_xlabel(label)
        for axis in panels[len(shown) :]:
            axis.set_axis_off()
        _settle(figure)
        return figure


def _bins(axis: Axes, found: Sequence[Spot]) -> None:
    """Draw bins along an axis, each at the largest height of any run and kind: grey what noise may do, the largest darkest."""
    highest: dict[tuple[float, float], Spot] = {}
    for spot in found:  # largest first
        highest.setdefault((spot.low, spot.high), spot)
    bins = list(highest.values())
    positive = min(s.low for s in bins) > 0
    log = positive and max(s.high for s in bins) > WIDE * min(s.high for s in bins)
    if len(bins) > FINEST:
        bins = _columns(bins, log)
    for spot in bins:
        colour, alpha = (BEFORE if spot.sure else "#AAAAAA"), (1.0 if spot is bins[0] else 0.5)
        if spot.high > spot.low:
            axis.bar(spot.low, spot.height, spot.high - spot.low, align="edge", color=colour, alpha=alpha, linewidth=0)
        else:
            axis.vlines(spot.low, 0, spot.height, color=colour, alpha=alpha, linewidth=1.6)
    if log:
        axis.set_xscale("log")
        _decade_ticks(axis)
    axis.margins(x=0.01)
    axis.locator_params(axis="y", nbins=4)


def _columns(bins: Sequence[Spot], log: bool) -> list[Spot]:
    """Return many bins as few columns, each as high as the highest in it, largest first."""
    low, high = min(s.low for s in bins), max(s.high for s in bins)
    edges = np.geomspace(low, high, FINEST + 1) if log else np.linspace(low, high, FINEST + 1)
    highest: dict[int, Spot] = {}
    for spot in bins:
        k = int(np.clip(np.searchsorted(edges, 0.5 * (spot.low + spot.high), side="right") - 1, 0, FINEST - 1))
        highest.setdefault(k, spot)
    return [
        Spot(s.axis, s.run, s.kind, float(edges[k]), float(edges[k + 1]), s.name, s.height, s.p_value)
        for k, s in highest.items()
    ]


def _names(axis: Axes, found: Sequence[Spot], *, narrow: bool) -> None:
    highest: dict[str, Spot] = {}
    for spot in found:
        highest.setdefault(name_text(spot.name, narrow=narrow), spot)
    shown = list(highest.items())[:BARS][::-1]
    colours = [BEFORE if s.sure else "#AAAAAA" for _, s in shown]
    axis.barh([k for k, _ in shown], [s.height for _, s in shown], color=colours)
    axis.tick_params(axis="y", labelsize=8.5)
