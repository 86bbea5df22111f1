"""Figures that several results share: recordings, gains, critical loads, and long curves drawn by their extremes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.results import plots
from srfcli.results.report_text import unit_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.data.experiment import RunCheck
    from srfcli.data.thresholds import Thresholds


def gains(x: plots.Values, parts: Mapping[str, Any], *, xlabel: str, logx: bool, title: str = "") -> Figure:
    """Return gain and phase of complex transfer functions `parts`, {label: values}, over one x; `[unit]` in a label: an axis."""
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    measured = [label for label in parts if "[" in label]  # what has a unit has an axis of its own
    with plots.house_style():
        figure, axes = plots.new_figure(2 + len(measured), size=(6.0, 5.2 + 1.5 * len(measured)))
        above, below, own = axes[0], axes[-1], dict(zip(measured, axes[1:], strict=False))
        for k, (label, values) in enumerate(parts.items()):
            look = plots.curve_style(k)
            own.get(label, above).plot(list(x), np.abs(values), label=label, **look)
            below.plot(list(x), np.degrees(np.unwrap(np.angle(values))), label=label.partition("  [")[0], **look)
        for label, axis in own.items():
            axis.set_ylabel(f"gain of {label}")
        for axis in axes[:-1]:
            axis.set_yscale("log")
        below.set_xscale("log" if logx else "linear")
        above.set_ylabel("gain for ε = 1")
        below.set_ylabel("phase  [deg]")
        span = -np.subtract(*below.get_ylim())
        step = next((s for s in (90, 45, 15, 5) if span >= 2 * s), None)
        below.yaxis.set_major_locator(MaxNLocator(5) if step is None else MultipleLocator(step))
        below.set_xlabel(xlabel)
        plots.heading(figure, title)
        plots.names_below(figure, *below.get_legend_handles_labels())
        figure.align_ylabels(axes)
        for axis in axes:
            axis.margins(x=0.0)
        for axis in axes:
            plots.decade_ticks(axis)
        return figure


# Figures of recordings: each run with what was observed and what was imposed, and the samples that are not compared.

RECORD_COLUMNS = 1500  # columns in which a long record is drawn by its extremes
# consecutive samples from which a band is drawn; most single ones that are marked with crosses
BAND_SAMPLES, CROSSES = 20, 100
LOGARITHMIC_FROM = 30.0  # ratio of velocities from which their axis is logarithmic
UNUSED = "#D55E00"


def recordings(checks: Sequence[RunCheck], *, title: str = "") -> Figure:
    """Return a panel for each run: observable, driving velocity and, where it is known, load over time.

    Samples that are not used are marked, gaps are shaded, proposed corrections drawn.
    """
    columns = 1 if len(checks) < 4 else 2
    rows = math.ceil(len(checks) / columns)
    with plots.house_style():
        figure = plots.bare_figure((6.4 * columns, 3.3 * rows + 0.4))
        outer = figure.add_gridspec(rows, columns)
        for k, check in enumerate(checks):
            axes = stacked(figure, outer[k // columns, k % columns], (3, 1, 1) if check.run.load_known else (3, 1), hspace=0.06)
            _panel(axes, check)
            figure.align_ylabels(axes)
        plots.heading(figure, plots.name_text(title, wide=True))
        fix_layout(figure)
        return figure


def stacked(figure: Figure, cell: Any, heights: Sequence[float], *, hspace: float) -> list[Axes]:
    """Return panels above each other on one x axis, in a cell of a grid."""
    return on_one_axis(figure, list(cell.subgridspec(len(heights), 1, height_ratios=heights, hspace=hspace)))


def on_one_axis(figure: Figure, cells: Sequence[Any]) -> list[Axes]:
    """Return a panel in each cell, all on one x axis."""
    first = figure.add_subplot(cells[0])
    return [first, *(figure.add_subplot(cell, sharex=first) for cell in cells[1:])]


def fix_layout(figure: Figure) -> None:
    """Fix the layout at rounded positions: the last digits of the layout solver differ from run to run."""
    from matplotlib import rc_context

    if not hasattr(figure, "set_layout_engine"):  # a part of somebody's own figure
        return
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
    with rc_context(plots.NO_LAYOUT):
        figure.set_layout_engine(None)  # a placeholder, which "none" leaves, has every file drawn twice
    for axis in figure.axes:
        left, bottom, width, height = (round(float(x), 5) for x in axis.get_position().bounds)
        axis.set_position((left, bottom, width, height))


def _panel(axes: list[Axes], check: RunCheck) -> None:
    run, t = check.run, check.run.t
    V, W = run.drive(t), run.load(t)[0]
    quantity = run.quantity + (f"\n[{unit_text(run.unit)}]" if run.unit != "1" else "")
    panels = [(run.observed, "u", quantity), (V, "v", "V\n[µm/s]"), (W, "W", f"W\n[{run.load_unit}]")]
    for axis, (values, key, label) in zip(axes, panels if run.load_known else panels[:2], strict=True):
        axis.plot(*envelope(t, values), color=plots.QUANTITY[key], linewidth=0.8)
        axis.set_ylabel(label)
        axis.margins(x=0.01, y=0.08)
        for gap in check.sampling.gaps.tolist():
            axis.axvspan(t[gap], t[gap + 1], color="#BBBBBB", alpha=0.5, linewidth=0)
    if run.proposed is not None:
        _proposed(axes[0], t, run.observed, run.proposed)
    for number, at in enumerate(run.drive_resets):
        name = None if number else "displacement moved back, proposed"
        axes[1].axvline(at, color=plots.COLOURS[1], linestyle="--", linewidth=0.8, label=name)
    if run.drive_resets:
        axes[1].legend(loc="best", fontsize="small")
    for axis in axes:
        axis.ticklabel_format(axis="y", useOffset=False)
    imposed_scale(axes[1], V, wide=True)
    if run.load_known:
        imposed_scale(axes[2], W, wide=False)
    marked = _mark_unused(axes[0], t, run.observed, ~run.used)
    axes[0].set_title(f"{plots.name_text(run.name)}{' (held out)' if run.holdout else ''}{marked}")
    axes[-1].set_xlabel("time  [s]")
    for axis in axes[:-1]:
        axis.tick_params(labelbottom=False)


def _proposed(axis: Axes, t: Any, observed: Any, proposed: Any) -> None:
    """Draw the record as corrected, where proposed corrections change it: spikes as rings, a shifted level dashed."""
    from srfcli.data.noise import WIDEST_SPIKE
    from srfcli.motion.imposed import runs_of

    lone, moved = np.zeros(t.size, bool), np.zeros(t.size, bool)
    for first, last in runs_of(proposed != observed):
        (lone if last - first < WIDEST_SPIKE else moved)[first : last + 1] = True
    style: dict[str, Any] = {"color": plots.COLOURS[1], "zorder": 3}
    if lone.any():
        axis.plot(t[lone], observed[lone], "o", markersize=5, markerfacecolor="none", label="spike, proposed", **style)
    if moved.any():
        axis.plot(*envelope(t[moved], proposed[moved]), "--", linewidth=0.8, label="level moved back, proposed", **style)
    axis.legend(loc="best", fontsize="small")


def imposed_scale(axis: Axes, values: Any, *, wide: bool) -> None:
    """Set the scale of an imposed quantity: wide for a constant, logarithmic for velocities over decades."""
    size = float(np.abs(values).max())
    if np.ptp(values) <= 1e-6 * size:
        middle = float(values[0])
        axis.set_ylim(middle - 0.5 * abs(middle) - 1e-9, middle + 0.5 * abs(middle) + 1e-9)
        axis.locator_params(axis="y", nbins=3)
    elif wide and values.min() > 0 and size > LOGARITHMIC_FROM * values.min():
        axis.set_yscale("log")
        if np.floor(np.log10(size)) - np.ceil(np.log10(values.min())) < 2:  # fewer than three decades to label
            ends = [float(values.min()), size]
            axis.set_yticks(ends, [f"{x:.3g}" for x in ends])
        axis.set_yticks([], minor=True)
    elif wide and size > LOGARITHMIC_FROM * float(np.median(np.abs(values))) > 0:  # with a stop or a move back among them
        threshold = float(np.median(np.abs(values)))
        axis.set_yscale("symlog", linthresh=threshold)
        axis.set_ylabel("V symlog\n[µm/s]")
        ends = [float(f"{x:.2g}") for x in (values.min(), values.max()) if abs(x) > 10 * threshold]
        axis.set_yticks([0.0, *ends], [f"{x:.4g}" for x in (0.0, *ends)])
        axis.set_yticks([], minor=True)
    else:
        axis.locator_params(axis="y", nbins=3)


def _mark_unused(axis: Axes, t: Any, x: Any, bad: Any) -> str:
    """Mark what is not compared: stretches as bands, single samples as crosses, many of these as ticks below; say how many."""
    from srfcli.motion.imposed import runs_of

    if not bad.any():
        return ""
    total = int(bad.sum())
    for first, last in runs_of(bad):
        if last - first + 1 >= BAND_SAMPLES:
            axis.axvspan(t[first], t[last], color=UNUSED, alpha=0.25, linewidth=0)
            bad[first : last + 1] = False
    single = np.flatnonzero(bad)
    if single.size > CROSSES:
        axis.plot(t[single], np.zeros(single.size), "|", color=UNUSED, markersize=6, transform=axis.get_xaxis_transform())
    else:
        axis.plot(t[single], x[single], "x", color=UNUSED, markersize=5, linestyle="none")
    return f": {total} sample{'s' if total > 1 else ''} not compared"


def envelope(t: Any, y: Any) -> tuple[Any, Any]:
    """Return a curve (t, y) reduced to the minimum and maximum of each bin, in their order; NaN gaps are kept.

    Records of up to four points a bin are returned unchanged.
    """
    if t.size <= 4 * RECORD_COLUMNS:
        return t, y
    edges = np.searchsorted(t, np.linspace(t[0], t[-1], RECORD_COLUMNS + 1)[:-1])
    keep = {0, t.size - 1}
    for a, b in zip(edges, [*edges[1:], t.size], strict=True):
        part = y[a:b]
        finite = np.nonzero(np.isfinite(part))[0]
        if finite.size:
            keep.update((int(a + finite[part[finite].argmin()]), int(a + finite[part[finite].argmax()])))
        elif b > a:
            keep.add(int(a))  # a gap stays a gap
    order = sorted(keep)
    return t[order], y[order]


def draw_loads(ax: Axes, table: Thresholds, computed: Mapping[str, plots.Values]) -> None:
    """Draw measured critical loads, with their errors, and computed ones (n,) over V, by name; all but the first are thin."""
    mark: dict[str, Any] = {"fmt": "o", "markersize": 5, "markerfacecolor": "none"}
    for index, eps in enumerate(np.unique(table.eps)):
        style = plots.curve_style(index)
        here = np.flatnonzero(table.eps == eps)
        here = here[np.argsort(table.V[here], kind="stable")]
        ax.errorbar(table.V[here], table.W0c[here], yerr=table.sigma[here], color=style["color"], **mark)
        for number, (name, loads) in enumerate(computed.items()):
            thin: dict[str, Any] = {"linewidth": 0.6} if number else {}
            ax.plot(table.V[here], np.asarray(loads)[here], label=f"{name}, ε = {eps:g}", **style, **thin)
    ax.errorbar([], [], yerr=[], color="#555555", label="measured, ± σ", **mark)
    ax.set(xscale="log", yscale="log", xlabel="V  [µm/s]", ylabel="critical W$_0$  [N]")
    plots.decade_ticks(ax)
    ax.legend(loc="best", fontsize=plots.NAME_OFFSET, handlelength=2.8)
