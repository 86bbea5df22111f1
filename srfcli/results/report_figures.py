"""Figures of a diagnosis' report: runs and innovations, the residual scan, what was found."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from srfcli.diagnosis.residual_scan import SIGNIFICANT, TIME_AXES
from srfcli.results.figures import draw_loads, envelope, fix_layout, imposed_scale, on_one_axis
from srfcli.results.plots import DOTTED, bare_figure, curve_style, decade_ticks, house_style, name_text, new_figure
from srfcli.results.report_text import finite, number, with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Figures of where the model differs from the recording: all runs at a glance, and each run with its innovations before and after.

Array = NDArray[np.float64]

OBSERVED_COLOUR, BASELINE_COLOUR, AUGMENTED_COLOUR, MISFIT_COLOUR = "#333333", "#D55E00", "#0072B2", "#E69F00"
PIECES, PIECE_SAMPLES = 60, 24  # pieces of a run whose innovations are judged, samples that make a piece
INNOVATION_COLUMNS = 360  # in which innovations are drawn by their extremes
DOTS = 700  # samples that are drawn one by one
CLOSE_UP_PERIODS, CLOSE_UP_SAMPLES = 7, 80  # periods of what is missing that a close-up shows, samples at least
MOST_OF_MISFIT, SHORT_PART = 0.6, 0.12  # of the misfit, in a part of the run so short that it deserves a close-up
PEAK_SHARE = 0.3  # of the innovations' power in one line, from which it has a period
CLOSE_UP_POWER = 2.0  # of the noise's variance: less than that needs no close-up
ZOOM = 0.3  # of a run: a close-up of more would show nothing new
LOAD_PANEL = 1e-3  # relative variation of a load from which it is worth a panel
NARROW_FIGURE = 4.3  # inches: a figure for a small screen, whose text keeps its size there
GAP_STEPS = 5.0  # usual steps in time after which a record has a gap
STEPS_BESIDE = 5  # steps before it, and after, that tell the usual one: a record may change its sampling rate
SAME_PREDICTION = 1e-9  # of the noise: predictions that differ by less are one


@dataclass(frozen=True)
class Trace:
    """One run as it is drawn: arrays (n,) of the samples that are compared, in the units of the recording.

    `before` and `after` are the innovations of baseline and augmented model over their standard deviations, `rms` their root
    mean squares, infinite for a run that a model cannot follow. `friction_field` is that of each model, as the
    smoother estimates it.
    """

    name: str
    holdout: bool
    label: str
    load_unit: str
    t: Array = field(repr=False)
    observed: Array = field(repr=False)
    baseline: Array = field(repr=False)
    augmented: Array = field(repr=False)
    before: Array = field(repr=False)
    after: Array = field(repr=False)
    V: Array = field(repr=False)
    W: Array = field(repr=False)
    windows: tuple[tuple[float, float], ...]
    rms: tuple[float, float]
    friction_field: tuple[Array, Array] | None = field(default=None, repr=False)

    @property
    def same(self) -> bool:
        """True where the augmented model is the baseline."""
        return bool(np.allclose(self.before, self.after, rtol=0.0, atol=SAME_PREDICTION))

    def sides(self, before: Array, after: Array) -> list[tuple[Array, str, Any]]:
        """Return values of baseline and augmented model, the baseline's alone where they are the same, with colour and dashes."""
        if self.same:
            return [(before, AUGMENTED_COLOUR, "-")]
        return [(before, BASELINE_COLOUR, "-"), (after, AUGMENTED_COLOUR, (0, (4, 1.2)))]

    def heights(self) -> tuple[float, ...]:
        """Return for each window how far its innovations are above noise, from 0 to 1 for the worst."""
        over = []
        for a, b in self.windows:
            z = self.before[(self.t >= a) & (self.t <= b)]
            over.append(max(float(np.mean(z**2)) - 1.0, 0.0) if z.size else 0.0)
        most = max(over, default=0.0)
        return tuple(x / most if most > 0 else 1.0 for x in over)

    @property
    def worst(self) -> tuple[float, float] | None:
        """Return the window that is shaded darkest: where a sample is furthest from what the baseline explains."""
        return max(zip(self.heights(), self.windows, strict=True))[1] if self.windows else None


def trace(run: Mapping[str, Any]) -> Trace:
    """Return a run of the material, without the samples that are not compared or at which a model has no value."""
    arrays = {k: np.asarray(run[k], dtype=float) for k in ("t", "observed", "baseline", "augmented", "V", "W")}
    arrays |= {k: np.asarray(z, dtype=float) for k, z in zip(("before", "after"), run["white"], strict=True)}
    field = [np.asarray(x, dtype=float) for x in run["friction"] if x is not None]
    good = np.asarray(run["used"], dtype=bool).copy()
    for values in (*arrays.values(), *field):
        good &= np.isfinite(values)
    before, after = (float(x) if np.isfinite(x) else math.inf for x in run["rms"])
    return Trace(
        str(run["name"]), bool(run["holdout"]), str(run["label"]), str(run["load_unit"]),
        **{k: values[good] for k, values in arrays.items()},
        windows=tuple((float(a), float(b)) for a, b in run["windows"]), rms=(before, after),
        friction_field=(field[0][good], field[1][good]) if len(field) == 2 and any(np.any(x[good]) for x in field) else None,
    )  # fmt: skip


def local_rms(t: Array, z: Array) -> tuple[Array, Array]:
    """Return the borders (k + 1,) of pieces of a run in s and the rms (k,) of the innovations in each."""
    pieces = np.array_split(np.arange(t.size), max(min(PIECES, t.size // PIECE_SAMPLES), 1))
    borders = [t[p[0]] for p in pieces] + [t[-1]]
    return np.asarray(borders), np.asarray([np.sqrt(np.mean(z[p] ** 2)) for p in pieces])


def overview(traces: Sequence[Trace], *, narrow: bool = False) -> Figure:
    """Return all runs as strips over their own clocks, dark where innovations exceed the noise, before and after.

    `narrow` sets the two models below each other, for a small screen.
    """
    both = not all(x.same for x in traces)
    local = [(x, local_rms(x.t, x.before), local_rms(x.t, x.after)) for x in traces if x.t.size > 1]
    top = max((float(np.max(r)) for _, *two in local for _, r in two), default=1.0)
    with house_style():
        from matplotlib.colors import LogNorm

        count = 2 if both else 1
        lines = count if narrow else 1
        figure = bare_figure((NARROW_FIGURE if narrow else 9.6, lines * (0.36 * len(local) + 0.7) + 0.8))
        axes = figure.subplots(lines, count // lines, sharex=True, sharey=True, squeeze=False).ravel()
        for k, (axis, title) in enumerate(zip(axes, ("baseline", "augmented model"), strict=False)):
            for row, (one, *found) in enumerate(local):
                borders, values = found[k]
                shade = axis.pcolormesh(
                    borders,
                    [row - 0.36, row + 0.36],
                    np.maximum(values, 1.0)[None, :],
                    norm=LogNorm(1.0, max(3.0, top)),
                    cmap="YlOrRd",
                    rasterized=True,
                )
                axis.plot([borders[0], borders[-1]], [row + 0.40] * 2, color="#999999", linewidth=0.7)
                if k == 0 and one.worst is not None:
                    axis.plot(one.worst, [row - 0.42] * 2, color="#000000", linewidth=2.0, solid_capstyle="butt")
            axis.set_title(title)
            axis.set_xlabel("t  [s]" if not narrow or axis is axes[-1] else "")
            axis.grid(False)
        held = "\n(held out)" if narrow else " (held out)"
        names = [name_text(x.name, narrow=narrow) + (held if x.holdout else "") for x, *_ in local]
        axes[0].set_yticks(range(len(names)), names)
        axes[0].set_ylim(len(names) - 0.4, -0.6)
        bar = figure.colorbar(
            shade, ax=list(axes), pad=0.02, aspect=30 if narrow else 14, location="bottom" if narrow else "right"
        )
        bar.set_label("innovations / noise")
        _plain_log(bar.ax.xaxis if narrow else bar.ax.yaxis, max(3.0, top), most=5 if narrow else 8)
        fix_layout(figure)
        return figure


def _plain_log(axis: Any, top: float, *, most: int) -> None:
    """Write 1, 2, 5, 10 on a logarithmic axis, or 1, 10, 100 where those are more than `most`."""
    from matplotlib.ticker import NullLocator

    places = [m * 10.0**d for d in range(9) for m in (1, 2, 5) if m * 10.0**d <= top * 1.001]
    places = places if len(places) <= most else places[::3]
    axis.set_ticks(places, [f"{p:g}" for p in places])
    axis.set_minor_locator(NullLocator())


def run_figure(one: Trace, *, narrow: bool = False) -> Figure:
    """Return a run: recording and both models, innovations over noise, local rms, friction field, what was imposed; a close-up.

    `narrow` leaves the close-up out and gives the legend a row of its own, for a small screen.
    """
    imposed = [k for k in ("V", "W") if np.ptp(getattr(one, k)) > LOAD_PANEL * float(np.abs(getattr(one, k)).max())]
    piece = None if narrow else close_up(one)
    friction = one.friction_field is not None
    heights = [3.0, 2.2, 1.1, *[1.3] * friction, *[0.75] * len(imposed)]
    with house_style():
        figure = bare_figure((NARROW_FIGURE if narrow else 10.4 if piece else 9.0, 0.72 * sum(heights) + 1.1))
        widths = (1.75, 1.0) if piece else (1.0,)
        grid = figure.add_gridspec(len(heights), len(widths), height_ratios=heights, width_ratios=widths)
        axes = on_one_axis(figure, [grid[i, 0] for i in range(len(heights))])
        _shade(axes, one)
        _whole(axes, one, narrow=narrow)
        if one.friction_field is not None:
            _friction_field(axes[3], one)
        for axis, key in zip(axes[3 + friction :], imposed, strict=True):
            _imposed_panel(axis, one, key, slice(None))
        _end_column(axes)
        if piece:
            last = len(heights) - ("W" in imposed)
            near = on_one_axis(figure, [grid[0, 1], grid[1:last, 1], *([grid[last:, 1]] if "W" in imposed else [])])
            _near(near, one, piece)
            for axis in near[2:]:
                _imposed_panel(axis, one, "W", piece)
            _end_column(near)
            axes[0].axvspan(one.t[piece][0], one.t[piece][-1], ymin=0.0, ymax=0.03, color="#000000", linewidth=0)
        fix_layout(figure)
        return figure


def _end_column(axes: Sequence[Axes]) -> None:
    for axis in axes[:-1]:
        axis.tick_params(labelbottom=False)
    axes[-1].set_xlabel("t  [s]")
    axes[-1].figure.align_ylabels(axes)


def _shade(axes: Sequence[Axes], one: Trace) -> None:
    """Shade the windows that stand out, the more the worse, and name the worst."""
    step = 2.0 * float(np.median(np.diff(one.t))) if one.t.size > 1 else 0.0
    starts = sorted(a for a, _ in one.windows)
    for (a, b), height in zip(one.windows, one.heights(), strict=True):
        end = next((s for s in starts if 0 < s - b <= step), b)  # no light line between windows that adjoin
        for axis in axes:
            axis.axvspan(a, end, color=MISFIT_COLOUR, alpha=0.06 + 0.26 * height, linewidth=0)
    if one.worst is not None:
        middle = 0.5 * sum(one.worst)
        axes[1].annotate(
            "worst here", (middle, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2), textcoords="offset points",
            ha="center", va="bottom", color="#7A4A00", fontsize=8.5,
        )  # fmt: skip


def _whole(axes: Sequence[Axes], one: Trace, *, narrow: bool = False) -> None:
    """Draw the whole run on the first three axes."""
    title = name_text(one.name, narrow=narrow) + (" (held out)" if one.holdout else "")
    above, below, local = axes[:3]
    _models(above, one, slice(None))
    above.set_title(title, pad=22 if narrow else None)
    above.legend(
        loc="lower left" if narrow else "lower right", bbox_to_anchor=(-0.02 if narrow else 1.0, 0.99), ncols=3, fontsize=8.5,
        handlelength=1.4 if narrow else 2.4, borderaxespad=0.0, columnspacing=1.0,
    )  # fmt: skip
    _innovations(below, one)
    for z, colour, dash in one.sides(one.before, one.after):
        borders, values = local_rms(one.t, z)
        local.stairs(values, borders, baseline=None, color=colour, linestyle=dash, linewidth=1.4)
    local.axhline(1.0, color="#777777", linewidth=0.8)
    local.set_yscale("log")
    low, high = local.get_ylim()
    local.set_ylim(min(low, 0.7), max(high, 2.0))
    _plain_log(local.yaxis, local.get_ylim()[1], most=4)
    local.set_ylabel("local rms\n/ noise")
    margin = 0.01 * float(np.ptp(one.t))
    above.set_xlim(one.t[0] - margin, one.t[-1] + margin)


def _models(axis: Axes, one: Trace, part: slice) -> None:
    """Draw recording and simulations over a part of the run: dots where they are few, lines by extremes where not."""
    t = one.t[part]
    few: dict[str, Any] = {"marker": ".", "linestyle": "none", "markersize": 2.6}
    many: dict[str, Any] = {"linewidth": 0.9, "alpha": 0.75}
    _line(axis, t, one.observed[part], label="recorded", color=OBSERVED_COLOUR, **(few if t.size <= DOTS else many))
    names = ("baseline", "augmented model")
    for label, (values, colour, dash) in zip(names, one.sides(one.baseline, one.augmented), strict=False):
        _line(axis, t, values[part], label=label, color=colour, linewidth=1.1, linestyle=dash)
    axis.set_ylabel(name_text(one.label))
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.margins(y=0.14)


def _innovations(axis: Axes, one: Trace) -> None:
    """Draw the innovations of both over the whole run as bands between their extremes, and where noise would stay."""
    for z, colour, _ in one.sides(one.before, one.after):
        alpha = 0.75 if colour == AUGMENTED_COLOUR else 0.55
        for a, b in _pieces(one.t):
            if b - a < 4 * INNOVATION_COLUMNS:
                axis.plot(one.t[a:b], z[a:b], color=colour, linewidth=0.6, alpha=alpha)
                continue
            edges = np.unique(np.linspace(a, b, INNOVATION_COLUMNS + 1).astype(int)[:-1])
            low, high = np.minimum.reduceat(z[:b], edges), np.maximum.reduceat(z[:b], edges)
            axis.fill_between(one.t[edges], low, high, color=colour, alpha=alpha, linewidth=0.3)
    _noise_band(axis)
    axis.set_ylabel("innovation\n/ noise")


def _friction_field(axis: Axes, one: Trace) -> None:
    """Draw the friction field of each model, in thousandths."""
    assert one.friction_field is not None
    for values, colour, dash in one.sides(*one.friction_field):
        _line(axis, one.t, 1e3 * values, color=colour, linewidth=1.1, linestyle=dash)
    axis.axhline(0.0, color="#777777", linewidth=0.8)
    axis.set_ylabel("friction\nfield\n[10$^{-3}$]")
    axis.margins(y=0.1)


def _line(axis: Axes, t: Array, y: Array, *, label: str | None = None, **style: Any) -> None:
    """Draw a record by its extremes where it is long, without lines over its gaps."""
    for a, b in _pieces(t):
        axis.plot(*envelope(t[a:b], y[a:b]), label=label if a == 0 else None, **style)


def _noise_band(axis: Axes) -> None:
    for level in (-2.0, 2.0):
        axis.axhline(level, color="#000000", linewidth=0.7, linestyle=(0, (1, 1.5)))
    axis.margins(y=0.08)


def _imposed_panel(axis: Axes, one: Trace, key: str, part: slice) -> None:
    axis.plot(*envelope(one.t[part], getattr(one, key)[part]), color="#555555", linewidth=0.8)
    imposed_scale(axis, getattr(one, key)[part], wide=key == "V")
    if axis.get_yscale() == "log":  # decades would fall outside so low a panel
        ends = sorted({float(f"{x:.3g}") for x in (getattr(one, key)[part].min(), getattr(one, key)[part].max())})
        axis.set_yticks(ends, [f"{x:g}" for x in ends])
        axis.set_yticks([], minor=True)
    axis.set_ylabel(f"W\n[{one.load_unit}]" if key == "W" else "V\n[µm/s]")


def _near(axes: Sequence[Axes], one: Trace, part: slice) -> None:
    """Draw the close-up on the first two axes."""
    _models(axes[0], one, part)
    axes[0].set_title("close-up")
    axes[0].margins(x=0.02)
    for (z, colour, _), marker in zip(one.sides(one.before, one.after), "ox", strict=False):
        axes[1].plot(one.t[part], z[part], color=colour, linewidth=0.7, alpha=0.8)
        if one.t[part].size <= DOTS // 3:
            axes[1].plot(one.t[part], z[part], marker, color=colour, markersize=2.4, linestyle="none")
    _noise_band(axes[1])


def close_up(one: Trace) -> slice | None:
    """Return the samples of a close-up: a short stretch that holds most of the misfit, or some periods of a fast one."""
    n = one.t.size
    if n < 2 * CLOSE_UP_SAMPLES:
        return None
    over = np.maximum(_smooth(one.before**2, max(n // 200, 5)) - 1.0, 0.0)
    if float(over.max()) < CLOSE_UP_POWER or not over.any():
        return None
    sums = np.concatenate([[0.0], np.cumsum(over)])
    ends = np.searchsorted(sums, sums[:-1] + MOST_OF_MISFIT * sums[-1])  # the shortest stretch that holds most of it
    lengths = np.where(ends <= n, ends - np.arange(n), n)
    a = int(np.argmin(lengths))
    size = int(lengths[a])
    if size <= SHORT_PART * n:
        return _around(a + size // 2, max(3 * size, CLOSE_UP_SAMPLES), n)
    power = over if one.worst is None else np.where((one.t >= one.worst[0]) & (one.t <= one.worst[1]), over, 0.0)
    middle = int(np.argmax(_smooth(power, CLOSE_UP_SAMPLES)))
    near = _around(middle, 1024, n)
    z = one.before[near] - one.before[near].mean()
    spectrum = np.abs(np.fft.rfft(z * np.hanning(z.size))) ** 2
    peak = int(np.argmax(spectrum[1:])) + 1
    length = max(CLOSE_UP_PERIODS * z.size // peak, CLOSE_UP_SAMPLES)
    tall = float(spectrum[max(peak - 2, 1) : peak + 3].sum()) > PEAK_SHARE * float(spectrum[1:].sum())
    return _around(middle, length, n) if tall and float(np.var(z)) > CLOSE_UP_POWER and length <= ZOOM * n else None


def _smooth(values: Array, size: int) -> Array:
    """Return running means over `size` samples, fewer at the ends."""
    weights = np.convolve(np.ones(values.size), np.ones(size), mode="same")
    return np.asarray(np.convolve(values, np.ones(size), mode="same") / weights)


def _around(middle: int, length: int, n: int) -> slice:
    length = min(length, n)
    start = int(np.clip(middle - length // 2, 0, n - length))
    return slice(start, start + length)


def _pieces(t: Array) -> list[tuple[int, int]]:
    """Return the stretches of a record without gaps, as pairs of indices."""
    if t.size < 2:
        return [(0, t.size)]
    steps = np.diff(t)
    usual = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(steps, STEPS_BESIDE, mode="edge"), STEPS_BESIDE), axis=1)
    longer = np.maximum(
        usual[: steps.size], usual[STEPS_BESIDE + 1 : STEPS_BESIDE + 1 + steps.size]
    )  # of those before, and after
    borders = [0, *(np.flatnonzero(steps > GAP_STEPS * longer) + 1).tolist(), t.size]
    return [(a, b) for a, b in itertools.pairwise(borders) if b > a]


# The residual scan: its rows as `ScanRow`, the foremost of them, and a figure.

PANEL_BINS = 3  # of an axis, from which it has a panel of its own
SPECTRUM_COLUMNS = 240  # columns in which a spectrum is drawn by its maxima
THIN = 0.003  # of an axis: a bin so narrow is a line, as it would hardly be seen as a bar
WIDE_AXIS = 100.0  # ratio from which an axis is logarithmic

# name: what it is in words, its unit; that of a load is the recordings'
AXES: dict[str, tuple[str, str]] = {
    "run": ("run as a whole", "s"),
    "window": ("time window", "s"),
    "time": ("time", "s"),
    "forcing": ("phase of the forcing", "of a period"),
    "cycle": ("phase of stick-slip", "of a period"),
    "frequency": ("frequency", "Hz"),
    "v": ("slip velocity v", "µm/s"),
    "phi": ("age φ", "s"),
    "W": ("load W", ""),
    "dlnW/dt": ("rate of the load d ln W/dt", "1/s"),
    "position": ("place on the track", "µm"),
    "slip": ("slip", "µm"),
}
ZERO_END = 1e-9  # of an interval's other end: an end below is zero


@dataclass(frozen=True)
class ScanRow:
    """One place of the scan: an interval `low` to `high` of an axis, in a run or in all; `height` is -log10 of the p-value.

    `p_value` is adjusted for the number of places, `height` is not.
    """

    axis: str
    run: str
    kind: str
    low: float
    high: float
    height: float
    p_value: float | None
    unit: str = ""

    @property
    def sure(self) -> bool:
        """True where the p-value, adjusted for the number of places, is below SIGNIFICANT."""
        return self.p_value is not None and self.p_value < SIGNIFICANT

    @property
    def place(self) -> str:
        """Return the place in words, with its unit."""
        if self.axis == "frequency" or self.low == self.high:
            return with_unit(number(0.5 * (self.low + self.high)), self.unit)
        least = ZERO_END * max(abs(self.low), abs(self.high))
        low, high = (0.0 if abs(end) < least else end for end in (self.low, self.high))
        return with_unit(f"{number(low)} to {number(high)}", self.unit)


def scan_rows(rows: Sequence[Mapping[str, Any]], load_unit: str) -> list[ScanRow]:
    """Return the rows of the residual scan, the least probable first; `load_unit` is N or MPa."""
    found = [
        ScanRow(str(r["axis"]), str(r["run"] or ""), str(r["kind"]), float(r["low"]), float(r["high"]),
             -float(r["log_p"]) / math.log(10), r["p_value"],
             load_unit if r["axis"] == "W" else AXES.get(str(r["axis"]), ("", ""))[1])
        for r in rows if all(finite(r[k]) for k in ("low", "high", "log_p"))
    ]  # fmt: skip
    return sorted(found, key=lambda s: -s.height)


def axis_text(axis: str) -> str:
    """Return the name of an axis of the residual scan in words."""
    return AXES.get(axis, (axis, ""))[0]


def foremost(found: Sequence[ScanRow], *, each: int = 2, most: int = 12) -> list[ScanRow]:
    """Return what stands out most, `each` of an axis at most."""
    kept: list[ScanRow] = []
    for spot in found:
        if sum(k.axis == spot.axis for k in kept) < each and len(kept) < most:
            kept.append(spot)
    return kept


def scan_figure(rows: Sequence[Mapping[str, Any]], load_unit: str, *, narrow: bool = False) -> Figure | None:
    """Return a panel for each axis of the residual scan with several bins, but runs and times; None where there is none."""
    by_axis: dict[str, list[ScanRow]] = {}
    for spot in scan_rows(rows, load_unit):
        if spot.axis not in TIME_AXES and spot.kind != "shape":  # the figures of the runs show times
            by_axis.setdefault(spot.axis, []).append(spot)
    shown = {k: v for k, v in by_axis.items() if len({(s.low, s.high) for s in v}) >= PANEL_BINS}
    if not shown:
        return None
    columns = 1 if narrow else min(3, len(shown))
    lines = math.ceil(len(shown) / columns)
    with house_style():
        figure = bare_figure((NARROW_FIGURE if narrow else 3.5 * columns + 0.2, 2.3 * lines + 0.2))
        panels = figure.subplots(lines, columns, squeeze=False).ravel().tolist()
        for k, (axis, (name, found)) in enumerate(zip(panels, shown.items(), strict=False)):
            about, unit = AXES.get(name, (name_text(name, narrow=narrow), ""))[0], found[0].unit
            axis.set_title(about + (f"  [{unit}]" if unit else ""), fontsize=9.5)
            _bins(axis, found)
            axis.set_ylabel("−log$_{10}$ p" if k % columns == 0 else "")
        for axis in panels[len(shown) :]:
            axis.set_axis_off()
        fix_layout(figure)
        return figure


def _bins(axis: Axes, found: Sequence[ScanRow]) -> None:
    """Draw bins along an axis, each at the largest height of any run and kind: grey what noise may do, the largest darkest."""
    highest: dict[tuple[float, float], ScanRow] = {}
    for spot in found:  # largest first
        highest.setdefault((spot.low, spot.high), spot)
    bins = list(highest.values())
    positive = min(s.low for s in bins) > 0
    log = positive and max(s.high for s in bins) > WIDE_AXIS * min(s.high for s in bins)
    if len(bins) > SPECTRUM_COLUMNS:
        bins = _columns(bins, log)
    place = np.log if log else np.asarray
    width = float(place(max(s.high for s in bins)) - place(min(s.low for s in bins)))
    for spot in bins:
        colour, alpha = (BASELINE_COLOUR if spot.sure else "#AAAAAA"), (1.0 if spot is bins[0] else 0.5)
        if float(place(spot.high) - place(spot.low)) > THIN * width:
            axis.bar(spot.low, spot.height, spot.high - spot.low, align="edge", color=colour, alpha=alpha, linewidth=0)
        else:
            axis.vlines(spot.low, 0, spot.height, color=colour, alpha=alpha, linewidth=1.6)
    if log:
        axis.set_xscale("log")
        decade_ticks(axis)
    axis.margins(x=0.01)
    axis.locator_params(axis="y", nbins=4)


def _columns(bins: Sequence[ScanRow], log: bool) -> list[ScanRow]:
    """Return many bins as few columns, each as high as the highest in it, largest first."""
    low, high = min(s.low for s in bins), max(s.high for s in bins)
    edges = np.geomspace(low, high, SPECTRUM_COLUMNS + 1) if log else np.linspace(low, high, SPECTRUM_COLUMNS + 1)
    highest: dict[int, ScanRow] = {}
    for spot in bins:
        k = int(np.clip(np.searchsorted(edges, 0.5 * (spot.low + spot.high), side="right") - 1, 0, SPECTRUM_COLUMNS - 1))
        highest.setdefault(k, spot)
    return [replace(s, low=float(edges[k]), high=float(edges[k + 1])) for k, s in highest.items()]


# Figures of what was found: how far parameters are shifted, a missing force, a stability diagram.

FORCE_BINS = 40  # in which a force is averaged along a quantity of state
STATES = (("v", "slip velocity v  [µm/s]", True), ("phi", "age φ  [s]", True), ("W", "load W  [{}]", False))
WIDE_QUANTITY = 10.0  # ratio from which a quantity has a logarithmic axis


def parameters_figure(parameters: Sequence[Mapping[str, Any]], *, narrow: bool = False) -> Figure | None:
    """Return how far each parameter of the baseline is shifted, in its own standard errors; None where none is known."""
    rows = [p for p in parameters if finite(p.get("shift_sigma"))][::-1]
    if not rows:
        return None
    shifts = [float(p["shift_sigma"]) for p in rows]
    size = max(abs(s) for s in shifts)
    with house_style():
        figure, (axis,) = new_figure(size=(NARROW_FIGURE if narrow else 6.6, 0.32 * len(rows) + 1.0))
        axis.axvspan(-2, 2, color="#DDDDDD", linewidth=0)
        axis.axvline(0, color="#777777", linewidth=0.8)
        for k, shift in enumerate(shifts):
            axis.plot([0, shift], [k, k], color=BASELINE_COLOUR, linewidth=1.6)
            axis.plot(shift, k, "o", color=BASELINE_COLOUR, markersize=5)
        axis.set_yticks(range(len(rows)), [name_text(str(p["name"]), narrow=narrow) for p in rows])
        axis.set_ylim(-0.6, len(rows) - 0.4)
        if size > 30:
            axis.set_xscale("symlog", linthresh=3.0)
            ticks = [t for t in (-1000, -100, -30, -10, -3, 0, 3, 10, 30, 100, 1000) if abs(t) < 2 * size]
            axis.set_xticks(ticks, [f"{t}".replace("-", "−") for t in ticks])
            axis.set_xticks([], minor=True)
            axis.set_xlim(*(1.6 * (end if abs(end) > 3.0 else 3.0 * side) for end, side in ((min(shifts), -1), (max(shifts), 1))))
        axis.set_xlabel("baseline less augmented model  [standard errors]")
        axis.grid(axis="y", visible=False)
        fix_layout(figure)
        return figure


def force_figure(name: str, force: Mapping[str, Any], load_unit: str, *, narrow: bool = False) -> Figure:
    """Return a run's missing force over the load (n,), over time with its band (2, n), above slip velocity and load."""
    t = np.asarray(force["t"], dtype=float)
    imposed = (("v", "v\n[µm/s]"), ("W", f"W\n[{load_unit}]"))
    with house_style():
        figure, axes = new_figure(1 + len(imposed), size=(NARROW_FIGURE if narrow else 9.0, 2.6 + 1.0 * len(imposed)))
        low, high = np.asarray(force["band"], dtype=float)
        axes[0].fill_between(t, low, high, color=AUGMENTED_COLOUR, alpha=0.22, linewidth=0, label="95 % band")
        values = np.asarray(force["force"], dtype=float)
        axes[0].plot(*envelope(t, values), color=AUGMENTED_COLOUR, linewidth=1.2, label="missing force")
        axes[0].axhline(0, color="#777777", linewidth=0.8)
        axes[0].set_title(name_text(name, narrow=narrow), pad=22 if narrow else None)
        axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=2, fontsize=8.5, borderaxespad=0.0)
        axes[0].set_ylabel("missing force\n/ load")
        for axis, (key, label) in zip(axes[1:], imposed, strict=True):
            known = np.asarray(force[key], dtype=float)
            axis.plot(*envelope(t, known), color="#555555", linewidth=0.8)
            axis.set_ylabel(label)
            if key == "v" and known.min() > 0 and known.max() > WIDE_QUANTITY * known.min():
                axis.set_yscale("log")
                decade_ticks(axis)
        axes[-1].set_xlabel("t  [s]")
        axes[-1].set_xlim(t[0] - 0.01 * np.ptp(t), t[-1] + 0.01 * np.ptp(t))
        figure.align_ylabels(axes)
        fix_layout(figure)
        return figure


def force_by_state(forces: Mapping[str, Mapping[str, Any]], load_unit: str, *, narrow: bool = False) -> Figure | None:
    """Return the missing force of all runs over slip velocity, age and load, averaged in pieces; None if none varies."""
    shown = [s for s in STATES if any(np.ptp(f[s[0]]) > 0 for f in forces.values())]
    if not shown:
        return None
    with house_style():
        lines = len(shown) if narrow else 1
        figure = bare_figure((NARROW_FIGURE if narrow else 3.2 * len(shown) + 0.4, 0.5 + 2.6 * lines))
        axes = figure.subplots(lines, len(shown) // lines, sharey=True, squeeze=False).ravel()
        for axis, (key, label, wide) in zip(axes, shown, strict=True):
            spans = [np.asarray(f[key], dtype=float) for f in forces.values()]
            low, high = min(float(s.min()) for s in spans), max(float(s.max()) for s in spans)
            log = wide and low > 0 and high > WIDE_QUANTITY * low
            for index, (name, force) in enumerate(forces.items()):
                x, y = (np.asarray(force[k], dtype=float) for k in (key, "force"))
                _by_state(axis, x, y, log, name_text(name, narrow=narrow), index)
            axis.axhline(0, color="#777777", linewidth=0.8)
            axis.set_xlabel(label.format(load_unit))
            if log:
                axis.set_xscale("log")
                decade_ticks(axis)
        axes[0].set_ylabel("missing force / load")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8.5)
        fix_layout(figure)
        return figure


def _by_state(axis: Axes, x: Any, y: Any, log: bool, label: str, index: int) -> None:
    """Draw samples faintly and their averages along the quantity of state."""
    style = curve_style(index)
    every = max(x.size // 1500, 1)
    axis.plot(x[::every], y[::every], ".", color=style["color"], markersize=1.2, alpha=0.25, rasterized=True)
    scale = np.log(x) if log else x
    edges = np.linspace(scale.min(), scale.max(), FORCE_BINS + 1)
    place = np.clip(np.digitize(scale, edges) - 1, 0, FORCE_BINS - 1)
    count = np.bincount(place, minlength=FORCE_BINS)
    kept = count >= max(3, x.size // 2000)
    middle = 0.5 * (edges[1:] + edges[:-1])[kept]
    mean = np.bincount(place, weights=y, minlength=FORCE_BINS)[kept] / count[kept]
    axis.plot(np.exp(middle) if log else middle, mean, **style, label=label)


def loads_figure(one: Mapping[str, Any], *, narrow: bool = False) -> Figure:
    """Return measured critical loads and those of both models over velocity; keys table, baseline, augmented, name."""
    same = np.array_equal(one["baseline"], one["augmented"], equal_nan=True)
    curves = {"model": one["baseline"]} if same else {"augmented model": one["augmented"], "baseline": one["baseline"]}
    with house_style():
        figure, (axis,) = new_figure(size=(NARROW_FIGURE, 5.0) if narrow else (7.4, 5.0))
        draw_loads(axis, one["table"], curves)
        axis.set_title(name_text(str(one["name"])) + (" (held out)" if one["holdout"] else ""))
        return figure


def diagram_figure(diagram: Mapping[str, Any], *, narrow: bool = False) -> Figure | None:
    """Return the stability boundary W0 (N) against V (um/s) of both models, W0_baseline and W0_augmented; None without any.

    They are over V, or velocities of their own, V_baseline and V_augmented; W0_hopf_... is under constant load; NaN is a gap.
    """

    def values(key: str) -> Array:
        return np.asarray(diagram.get(key, ()), dtype=float)

    def alike(quantity: str) -> bool:
        a, b = values(f"{quantity}_baseline"), values(f"{quantity}_augmented")
        return a.shape == b.shape and np.allclose(a, b, rtol=1e-9, atol=0.0, equal_nan=True)

    curves = [
        ("W0_baseline", "baseline", BASELINE_COLOUR, "-"),
        ("W0_augmented", "augmented model", AUGMENTED_COLOUR, (0, (5, 1.5))),
    ]
    curves += [("W0_hopf_baseline", "baseline, constant load", BASELINE_COLOUR, DOTTED)]
    curves += [("W0_hopf_augmented", "augmented model, constant load", AUGMENTED_COLOUR, DOTTED)]
    if all(map(alike, ("V", "W0", "W0_hopf"))):  # nothing was added: one curve would hide the other
        curves = [(key, label.replace("baseline", "the model"), colour, dash) for key, label, colour, dash in curves[::2]]
    drawn = [c for c in curves if np.isfinite(values(c[0])).any()]
    if not drawn:
        return None
    with house_style():
        figure, (axis,) = new_figure(size=(NARROW_FIGURE, 4.6) if narrow else (6.4, 4.2))
        for key, label, colour, dash in drawn:
            own = values(key.replace("W0", "V"))
            axis.plot(own if own.size else values("V"), values(key), color=colour, linestyle=dash, label=label)
        axis.set_xscale("log")
        marks = [(float(V), float(W)) for V, W in diagram.get("marks") or () if V > 0 and W > 0]
        if marks:
            axis.plot(
                *zip(*marks, strict=True), "+", color="#000000", markersize=9, markeredgewidth=1.6, linestyle="none",
                label="your runs", zorder=5, clip_on=False,
            )  # fmt: skip
        axis.margins(x=0.0 if not marks else 0.02)
        heights = np.concatenate([*(values(c[0]) for c in drawn), [W for _, W in marks]])
        if np.nanmax(heights) > WIDE_QUANTITY * np.nanmin(heights) > 0:
            axis.set_yscale("log")
        axis.set_xlabel("V  [µm/s]")
        axis.set_ylabel(f"critical load W$_0$  [{diagram.get('load_unit', 'N')}]")
        legend = axis.legend(loc="best", handlelength=2.8, title="sliding is steady below the first boundary", alignment="left")
        legend.get_title().set_color("#555555")
        decade_ticks(axis)
        fix_layout(figure)
        return figure
