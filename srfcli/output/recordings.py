"""Figures of recordings: each run with what was observed and what was imposed, and the samples that are not compared."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from srfcli.output.plots import QUANTITY, heading, house_style, load_matplotlib, name_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS = 1500  # columns in which a long record is drawn by its extremes
STRETCH, CROSSES = 20, 100  # samples in a row that make a band; single ones that are crossed each
DECADES = 30.0  # ratio of velocities from which their axis is logarithmic
UNUSED = "#D55E00"


def recordings(runs: Sequence[Mapping[str, Any]], *, title: str = "") -> Figure:
    """Return a panel for each run: observable, driving velocity and load over time.

    A run is {name, t, observed, label, used, V, W, holdout, gaps}: arrays (n,), `label` the observable with its unit, `gaps`
    pairs of times. Samples that are not used are marked, gaps are shaded.
    """
    load_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = 1 if len(runs) < 4 else 2
    rows = math.ceil(len(runs) / columns)
    with house_style():
        figure = Figure(figsize=(6.4 * columns, 3.3 * rows + 0.4))
        FigureCanvasAgg(figure)
        outer = figure.add_gridspec(rows, columns)
        for k, run in enumerate(runs):
            inner = outer[k // columns, k % columns].subgridspec(3, 1, height_ratios=(3, 1, 1), hspace=0.06)
            axes = [figure.add_subplot(inner[0])]
            axes += [figure.add_subplot(inner[i], sharex=axes[0]) for i in (1, 2)]
            _panel(axes, run)
            figure.align_ylabels(axes)
        if title:
            heading(figure, name_text(title, wide=True))
        _settle(figure)
        return figure


def _settle(figure: Figure) -> None:
    """Lay the panels out once and for all, at rounded places: the solver's last digits differ from time to time."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axis in figure.axes:
        left, bottom, width, height = (round(float(x), 5) for x in axis.get_position().bounds)
        axis.set_position((left, bottom, width, height))


def _panel(axes: list[Axes], run: Mapping[str, Any]) -> None:
    import numpy as np

    t = np.asarray(run["t"])
    labels = (run["label"], "V\n[µm/s]", f"W\n[{run.get('load_unit', 'N')}]")
    for axis, key, label, quantity in zip(axes, ("observed", "V", "W"), labels, "uvW", strict=True):
        axis.plot(*_thinned(t, np.asarray(run[key])), color=QUANTITY[quantity], linewidth=0.8)
        axis.set_ylabel(label)
        axis.margins(x=0.01, y=0.08)
        for begin, end in run.get("gaps", ()):
            axis.axvspan(begin, end, color="#BBBBBB", alpha=0.5, linewidth=0)
    for axis in axes:
        axis.ticklabel_format(axis="y", useOffset=False)
    _imposed(axes[1], np.asarray(run["V"]), wide=True)
    _imposed(axes[2], np.asarray(run["W"]), wide=False)
    marked = _mark_unused(axes[0], t, np.asarray(run["observed"]), ~np.asarray(run["used"]))
    axes[0].set_title(f"{name_text(run['name'])}{' (held out)' if run.get('holdout') else ''}{marked}")
    axes[2].set_xlabel("time  [s]")
    for axis in axes[:2]:
        axis.tick_params(labelbottom=False)


def _imposed(axis: Axes, values: Any, *, wide: bool) -> None:
    """Give a constant an axis that its rounding does not fill, and velocities over decades a logarithmic one."""
    import numpy as np

    size = float(np.abs(values).max())
    if np.ptp(values) <= 1e-6 * size:
        middle = float(values[0])
        axis.set_ylim(middle - 0.5 * abs(middle) - 1e-9, middle + 0.5 * abs(middle) + 1e-9)
        axis.locator_params(axis="y", nbins=3)
    elif wide and values.min() > 0 and size > DECADES * values.min():
        axis.set_yscale("log")
    elif wide and size > DECADES * float(np.median(np.abs(values))) > 0:  # with a stop or a move back among them
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
    import numpy as np

    if not bad.any():
        return ""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(np.int8))).reshape(-1, 2)
    long = edges[:, 1] - edges[:, 0] >= STRETCH
    for a, b in edges[long].tolist():
        axis.axvspan(t[a], t[b - 1], color=UNUSED, alpha=0.25, linewidth=0)
        bad[a:b] = False
    single = np.flatnonzero(bad)
    if single.size > CROSSES:
        axis.plot(
            t[single], np.zeros(single.size), "|", color=UNUSED, markersize=6, transform=axis.get_xaxis_transform()
        )
    else:
        axis.plot(t[single], x[single], "x", color=UNUSED, markersize=5, linestyle="none")
    total = int((edges[:, 1] - edges[:, 0]).sum())
    return f": {total} sample{'s' if total > 1 else ''} not compared"


def _thinned(t: Any, x: Any) -> tuple[Any, Any]:
    """Return the record, or where it is long, its smallest and largest value in each of many columns, in order of time."""
    import numpy as np

    if t.size <= 4 * BINS:
        return t, x
    edges = np.unique(np.searchsorted(t, np.linspace(t[0], t[-1], BINS + 1)[:-1]))
    low, high = np.minimum.reduceat(x, edges), np.maximum.reduceat(x, edges)
    return np.repeat(t[edges], 2), np.column_stack([low, high]).ravel()
