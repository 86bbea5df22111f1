"""Figures of where simulation and recording part: all runs at a glance, and each run with its residual before and after."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from srfcli.output.plots import house_style, load_matplotlib, name_text
from srfcli.output.recordings import _imposed, _settle, _thinned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

OBSERVED, BEFORE, AFTER, GUILTY = "#333333", "#D55E00", "#0072B2", "#E69F00"
BLOCKS, LEAST = 60, 24  # pieces of a run whose residual is judged, samples that make a piece
COLUMNS = 360  # in which a residual is drawn by its extremes
DOTS = 700  # samples that are drawn one by one
CLOSE_UP, FEWEST = 7, 80  # periods of what is missing that a close-up shows, samples at least
MOST, SHORT = 0.6, 0.12  # of the misfit, in a part of the run so short that it deserves a close-up
PEAK = 0.3  # of a residual's power in one line, from which it has a period
FAINT = 2.0  # of the noise's variance: less than that needs no close-up
ZOOM = 0.3  # of a run: a close-up of more would show nothing new
VARIES = 1e-3  # relative variation of a load from which it is worth a panel
LABELS = {"elongation": "elongation  [µm]", "force": "force  [N]", "friction": "friction coefficient"}
NARROW = 4.3  # inches: a figure for a small screen, whose text keeps its size there
GAP = 5.0  # usual steps in time after which a record has a gap
SAME = 1e-9  # of the noise: predictions that differ by less are one


@dataclass(frozen=True)
class Trace:
    """One run as it is drawn: arrays (n,) of the samples that are compared, residuals `before`, `after` over the noise."""

    name: str
    holdout: bool
    label: str
    t: Array = field(repr=False)
    observed: Array = field(repr=False)
    baseline: Array = field(repr=False)
    augmented: Array = field(repr=False)
    noise: float
    V: Array = field(repr=False)
    W: Array = field(repr=False)
    windows: tuple[tuple[float, float], ...]
    load_unit: str = "N"

    @property
    def before(self) -> Array:
        """Return the baseline's residual over the noise."""
        return np.asarray((self.observed - self.baseline) / self.noise)

    @property
    def after(self) -> Array:
        """Return the augmented model's residual over the noise."""
        return np.asarray((self.observed - self.augmented) / self.noise)

    @property
    def same(self) -> bool:
        """True where the augmented model is the baseline."""
        return bool(np.allclose(self.before, self.after, rtol=0.0, atol=SAME))

    def heights(self) -> tuple[float, ...]:
        """Return for each window how far its residual is above noise, from 0 to 1 for the worst."""
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
    t = arrays["t"]
    good = np.asarray(run.get("used", np.ones(t.shape, dtype=bool)), dtype=bool).copy()
    for values in arrays.values():
        good &= np.isfinite(values)
    windows = tuple((float(a), float(b)) for a, b in run.get("windows", ()))
    noise = float(run.get("noise_level") or 0.0)
    kept = {k: values[good] for k, values in arrays.items()}
    return Trace(
        str(run["name"]),
        bool(run.get("holdout")),
        str(run.get("label") or LABELS.get(str(run.get("observable")), "observed  [µm]")),
        **kept,
        noise=noise if noise > 0 else max(float(np.std(kept["observed"])) * 1e-3, 1e-12) if kept["t"].size else 1.0,
        windows=windows,
        load_unit=str(run.get("load_unit") or "N"),
    )


def rms_over_noise(z: Array) -> float:
    """Return the root mean square of a residual that is in units of the noise; NaN of none."""
    return float(np.sqrt(np.mean(z**2))) if z.size else float("nan")


def local_rms(t: Array, z: Array) -> tuple[Array, Array]:
    """Return the borders (k + 1,) of pieces of a run in s and the rms (k,) of the residual in each."""
    pieces = np.array_split(np.arange(t.size), max(min(BLOCKS, t.size // LEAST), 1))
    borders = [t[p[0]] for p in pieces if p.size] + [t[-1]]
    return np.asarray(borders), np.asarray([rms_over_noise(z[p]) for p in pieces if p.size])


def overview(traces: Sequence[Trace], *, narrow: bool = False) -> Figure:
    """Return all runs as strips over their own clocks, dark where the residual exceeds the noise, before and after.

    `narrow` sets the two models below each other, for a small screen.
    """
    load_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    both = not all(x.same for x in traces)
    local = [(x, local_rms(x.t, x.before), local_rms(x.t, x.after)) for x in traces if x.t.size > 1]
    top = max((float(np.max(r)) for _, *two in local for _, r in two), default=1.0)
    with house_style():
        count = 2 if both else 1
        lines = count if narrow else 1
        figure = Figure(figsize=(NARROW if narrow else 9.6, lines * (0.36 * len(local) + 0.7) + 0.8))
        FigureCanvasAgg(figure)
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
        bar.set_label("residual / noise")
        _plain_log(bar.ax.xaxis if narrow else bar.ax.yaxis, max(3.0, top), most=5 if narrow else 8)
        _settle(figure)
        return figure


def _plain_log(axis: Any, top: float, *, most: int) -> None:
    """Write 1, 2, 5, 10 on a logarithmic axis, or 1, 10, 100 where those are more than `most`."""
    from matplotlib.ticker import NullLocator

    places = [m * 10.0**d for d in range(9) for m in (1, 2, 5) if m * 10.0**d <= top * 1.001]
    places = places if len(places) <= most else places[::3]
    axis.set_ticks(places, [f"{p:g}" for p in places])
    axis.set_minor_locator(NullLocator())


def run_figure(one: Trace, *, narrow: bool = False) -> Figure:
    """Return a run: recording and both simulations, the residuals in units of noise, local rms, what was imposed; a close-up.

    `narrow` leaves the close-up out and gives the legend a row of its own, for a small screen.
    """
    load_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    imposed = [k for k in ("V", "W") if np.ptp(getattr(one, k)) > VARIES * float(np.abs(getattr(one, k)).max())]
    piece = None if narrow else close_up(one)
    heights = [3.0, 2.2, 1.1, *[0.75] * len(imposed)]
    with house_style():
        figure = Figure(figsize=(NARROW if narrow else 10.4 if piece else 9.0, 0.72 * sum(heights) + 1.1))
        FigureCanvasAgg(figure)
        widths = (1.75, 1.0) if piece else (1.0,)
        grid = figure.add_gridspec(len(heights), len(widths), height_ratios=heights, width_ratios=widths)
        axes = _column(figure, grid, 0, [slice(i, i + 1) for i in range(len(heights))])
        _shade(axes, one)
        _whole(axes, one, narrow=narrow)
        for axis, key in zip(axes[3:], imposed, strict=True):
            _imposed_panel(axis, one, key, slice(None))
        _end_column(axes)
        if piece:
            last = len(heights) - ("W" in imposed)
            near = _column(figure, grid, 1, (slice(0, 1), slice(1, last), slice(last, None))[: 2 + ("W" in imposed)])
            _near(near, one, piece)
            for axis in near[2:]:
                _imposed_panel(axis, one, "W", piece)
            _end_column(near)
            axes[0].axvspan(one.t[piece][0], one.t[piece][-1], ymin=0.0, ymax=0.03, color="#000000", linewidth=0)
        _settle(figure)
        return figure


def _column(figure: Figure, grid: Any, column: int, rows: Sequence[slice]) -> list[Axes]:
    axes = [figure.add_subplot(grid[rows[0], column])]
    return axes + [figure.add_subplot(grid[place, column], sharex=axes[0]) for place in rows[1:]]


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
            axis.axvspan(a, end, color=GUILTY, alpha=0.06 + 0.26 * height, linewidth=0)
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
    _residual(below, one)
    sets = [(one.before, BEFORE, "-"), (one.after, AFTER, (0, (4, 1.2)))]
    for z, colour, dash in [(one.before, AFTER, "-")] if one.same else sets:
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
    few = t.size <= DOTS
    for a, b in _pieces(t):
        mark = "recorded" if a == 0 else None
        if few:
            axis.plot(t[a:b], one.observed[part][a:b], ".", color=OBSERVED, markersize=2.6, label=mark)
        else:
            axis.plot(*_thinned(t[a:b], one.observed[part][a:b]), color=OBSERVED, linewidth=0.9, alpha=0.75, label=mark)
    drawn = [(one.baseline, BEFORE, "baseline", "-"), (one.augmented, AFTER, "augmented model", (0, (4, 1.2)))]
    if one.same:
        drawn = [(one.baseline, AFTER, "baseline", "-")]
    for values, colour, label, dash in drawn:
        for a, b in _pieces(t):
            shown = label if a == 0 else None
            axis.plot(*_thinned(t[a:b], values[part][a:b]), color=colour, linewidth=1.1, linestyle=dash, label=shown)
    axis.set_ylabel(name_text(one.label))
    axis.ticklabel_format(axis="y", useOffset=False)
    axis.margins(y=0.14)


def _residual(axis: Axes, one: Trace) -> None:
    """Draw both residuals over the whole run as bands between their extremes, and where noise would stay."""
    sets = [(one.before, BEFORE, 0.55), (one.after, AFTER, 0.75)]
    for z, colour, alpha in [(one.before, AFTER, 0.75)] if one.same else sets:
        for a, b in _pieces(one.t):
            if b - a < 4 * COLUMNS:
                axis.plot(one.t[a:b], z[a:b], color=colour, linewidth=0.6, alpha=alpha)
                continue
            edges = np.unique(np.linspace(a, b, COLUMNS + 1).astype(int)[:-1])
            low, high = np.minimum.reduceat(z[:b], edges), np.maximum.reduceat(z[:b], edges)
            axis.fill_between(one.t[edges], low, high, color=colour, alpha=alpha, linewidth=0.3)
    _noise_band(axis)
    axis.set_ylabel("residual\n/ noise")


def _noise_band(axis: Axes) -> None:
    for level in (-2.0, 2.0):
        axis.axhline(level, color="#000000", linewidth=0.7, linestyle=(0, (1, 1.5)))
    axis.margins(y=0.08)


def _imposed_panel(axis: Axes, one: Trace, key: str, part: slice) -> None:
    axis.plot(*_thinned(one.t[part], getattr(one, key)[part]), color="#555555", linewidth=0.8)
    _imposed(axis, getattr(one, key)[part], wide=key == "V")
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
    shown = ((one.after, AFTER, "o"),) if one.same else ((one.before, BEFORE, "o"), (one.after, AFTER, "x"))
    for z, colour, marker in shown:
        axes[1].plot(one.t[part], z[part], color=colour, linewidth=0.7, alpha=0.8)
        if one.t[part].size <= DOTS // 3:
            axes[1].plot(one.t[part], z[part], marker, color=colour, markersize=2.4, linestyle="none")
    _noise_band(axes[1])


def close_up(one: Trace) -> slice | None:
    """Return the samples of a close-up: a short stretch that holds most of the misfit, or some periods of a fast one."""
    n = one.t.size
    if n < 2 * FEWEST:
        return None
    over = np.maximum(_smooth(one.before**2, max(n // 200, 5)) - 1.0, 0.0)
    if float(over.max()) < FAINT or not over.any():
        return None
    sums = np.concatenate([[0.0], np.cumsum(over)])
    ends = np.searchsorted(sums, sums[:-1] + MOST * sums[-1])  # the shortest stretch that holds most of it
    lengths = np.where(ends <= n, ends - np.arange(n), n)
    a = int(np.argmin(lengths))
    size = int(lengths[a])
    if size <= SHORT * n:
        return _around(a + size // 2, max(3 * size, FEWEST), n)
    power = over if one.worst is None else np.where((one.t >= one.worst[0]) & (one.t <= one.worst[1]), over, 0.0)
    middle = int(np.argmax(_smooth(power, FEWEST)))
    near = _around(middle, 1024, n)
    z = one.before[near] - one.before[near].mean()
    spectrum = np.abs(np.fft.rfft(z * np.hanning(z.size))) ** 2
    peak = int(np.argmax(spectrum[1:])) + 1
    length = max(CLOSE_UP * z.size // peak, FEWEST)
    tall = float(spectrum[max(peak - 2, 1) : peak + 3].sum()) > PEAK * float(spectrum[1:].sum())
    return _around(middle, length, n) if tall and float(np.var(z)) > FAINT and length <= ZOOM * n else None


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
    borders = [0, *(np.flatnonzero(steps > GAP * float(np.median(steps))) + 1).tolist(), t.size]
    return [(a, b) for a, b in itertools.pairwise(borders) if b > a]
