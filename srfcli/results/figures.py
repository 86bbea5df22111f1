"""Figures of maps, of recordings, of records over time and of fits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

from srfcli.results.plots import (
    COLOURS,
    DASHES,
    NAME_OFFSET,
    NO_LAYOUT,
    QUANTITY,
    Values,
    bare_figure,
    curve_style,
    decade_ticks,
    heading,
    house_style,
    name_text,
    names_below,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.data.thresholds import Thresholds

# Figures of stability maps: growth as colour, boundaries as lines, special points as marks.

SHADES = "PuOr_r"  # purple and orange: told apart in all common forms of colour blindness, and in grey by the curves
MARKS = {
    "fold": ("^", "fold"),
    "cusp": ("*", "cusp"),
    "1:1": ("o", "1:1"),
    "1:2": ("D", "1:2"),
    "1:3": ("v", "1:3"),
    "1:4": ("s", "1:4"),
}
HATCH = "#5A4A7A"
LOOKS: dict[str, dict[str, Any]] = {
    "": {"label": "boundary", "color": "black", "linewidth": 1.6},
    "subcritical": {"label": "subcritical", "color": "white", "linewidth": 0.9, "linestyle": (0, (2, 1.5))},
    "fold": {"label": "state ends (fold)", "color": "black", "linewidth": 1.6, "linestyle": (0, (4, 1.5))},
}
CRITICALITY_MARK = ("P", "criticality changes")


def stability_map(
    x: Values,
    y: Values,
    growth: Any,
    *,
    branches: Sequence[tuple[Values, Values, Sequence[str]]] = (),
    special: Sequence[Mapping[str, Any]] = (),
    unresolved: tuple[Values, Values] = ((), ()),
    xlabel: str,
    ylabel: str,
    colour_label: str,
    logx: bool = True,
    logy: bool = False,
    title: str = "",
    ax: Axes | None = None,
) -> Figure:
    """Return a map of `growth` (nx, ny), negative where stable, over axes `x` (nx,) and `y` (ny,), both rising.

    `branches` are curves (x, y, at each point `subcritical`, `fold` or nothing); `special` points
    {what, x, y}; `unresolved` the places of points without an orbit. The stable side is hatched as well as shaded, so that it
    is told apart in print without colour.
    """
    import numpy as np

    values = np.ma.masked_invalid(np.asarray(growth, float))
    with house_style():
        own = ax is None
        figure, (ax,) = new_figure(size=(6.8, 4.8)) if ax is None else (cast("Figure", ax.figure), [ax])
        ax.grid(False)
        ax.set_xscale("log" if logx else "linear")
        ax.set_yscale("log" if logy else "linear")
        mesh = _draw_shades(ax, x, y, values)
        ax.set_facecolor("#BBBBBB")
        bar = figure.colorbar(mesh, ax=ax, extend="both", pad=0.02)
        bar.set_label(colour_label)
        _hatch_stable(ax, x, y, values)
        _draw_boundaries(ax, branches)
        _draw_marks(ax, special)
        if len(unresolved[0]):
            ax.plot(list(unresolved[0]), list(unresolved[1]), "x", color="#D00000", markersize=3, label="unresolved")
        ax.set(xlabel=xlabel, ylabel=ylabel, xlim=_ends(x), ylim=_ends(y))
        if own:
            _legend(figure, ax)
            heading(figure, title)
        else:
            ax.set_title(title.split("\n")[0])
        decade_ticks(ax)
        return figure


def _draw_shades(ax: Axes, x: Values, y: Values, values: Any) -> Any:
    """Draw growth as colour, white at 0, its scale logarithmic but for a thirtieth of it."""
    import numpy as np
    from matplotlib.colors import SymLogNorm

    size = float(np.percentile(np.abs(values.compressed()), 98)) if values.count() else 1.0
    return ax.pcolormesh(
        np.asarray(list(x), float),
        np.asarray(list(y), float),
        values.T,
        norm=SymLogNorm(linthresh=max(size / 30, 1e-12), vmin=-size, vmax=size, base=10),
        cmap=SHADES,
        shading="nearest",
        rasterized=True,
    )


def _legend(figure: Figure, ax: Axes) -> None:
    """Set the legend below the figure, where it covers nothing."""
    from matplotlib.legend_handler import HandlerTuple
    from matplotlib.patches import Patch

    stable = Patch(facecolor="#B2ABD2", edgecolor=HATCH, hatch="....", linewidth=0.0, label="stable")
    drawn, names = ax.get_legend_handles_labels()
    handles: list[Any] = [stable, *drawn]
    if "subcritical" in names:  # white on black in the figure, and so in the legend
        handles[1 + names.index("subcritical")] = (drawn[names.index("boundary")], drawn[names.index("subcritical")])
    names_below(figure, handles, ["stable", *names], handlelength=2.0, handler_map={tuple: HandlerTuple(ndivide=1)})


def _ends(values: Values) -> tuple[float, float]:
    listed = [float(v) for v in values]
    return listed[0], listed[-1]


def _hatch_stable(ax: Axes, x: Values, y: Values, growth: Any) -> None:
    """Hatch where growth is negative, lightly enough to leave the shade visible."""
    if growth.count() == 0 or not (growth < 0).any():
        return
    low = float(growth.min())
    if low < 0:
        drawn = ax.contourf(list(x), list(y), growth.T, levels=[2 * low, 0.0], colors="none", hatches=["...."])
        drawn.set_edgecolor(HATCH)
        drawn.set_linewidth(0.0)


def _draw_boundaries(ax: Axes, branches: Sequence[tuple[Values, Values, Sequence[str]]]) -> None:
    """Draw the curves, solid, white on black where the bifurcation is subcritical, dashed where states end in a fold."""
    named: set[str] = set()
    for x, y, looks in branches:
        for look, style in LOOKS.items():
            mine = [s == look or (look == "" and s == "subcritical") for s in looks]
            if not any(mine):
                continue
            gaps = [float(v) if m else float("nan") for v, m in zip(y, mine, strict=True)]
            ax.plot(list(x), gaps, **{**style, "label": None if look in named else style["label"]})
            named.add(look)


def _draw_marks(ax: Axes, special: Sequence[Mapping[str, Any]]) -> None:
    """Mark the special points, one kind of mark for each, each named once."""
    from matplotlib.patheffects import withStroke

    for what in dict.fromkeys(str(s["what"]) for s in special):
        marker, label = MARKS.get(what, CRITICALITY_MARK)
        mine = [s for s in special if str(s["what"]) == what]
        ax.plot(
            [s["x"] for s in mine],
            [s["y"] for s in mine],
            linestyle="none",
            marker=marker,
            markersize=6.5 if marker == "P" else 5.5,
            markerfacecolor="none",  # one mark does not hide another
            markeredgecolor="black",
            path_effects=[withStroke(linewidth=2.4, foreground="white")],
            label=label,
        )


def gains(x: Values, parts: Mapping[str, Any], *, xlabel: str, logx: bool, title: str = "") -> Figure:
    """Return gain and phase of complex transfer functions `parts`, {label: values}, over one x; `[unit]` in a label: an axis."""
    import numpy as np
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    measured = [label for label in parts if "[" in label]  # what has a unit has an axis of its own
    with house_style():
        figure, axes = new_figure(2 + len(measured), size=(6.0, 5.2 + 1.5 * len(measured)))
        above, below, own = axes[0], axes[-1], dict(zip(measured, axes[1:], strict=False))
        for k, (label, values) in enumerate(parts.items()):
            look = curve_style(k)
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
        heading(figure, title)
        names_below(figure, *below.get_legend_handles_labels())
        figure.align_ylabels(axes)
        for axis in axes:
            axis.margins(x=0.0)
        for axis in axes:
            decade_ticks(axis)
        return figure


# Figures of recordings: each run with what was observed and what was imposed, and the samples that are not compared.

RECORD_COLUMNS = 1500  # columns in which a long record is drawn by its extremes
# consecutive samples from which a band is drawn; most single ones that are marked with crosses
STRETCH, CROSSES = 20, 100
DECADES = 30.0  # ratio of velocities from which their axis is logarithmic
UNUSED = "#D55E00"


def recordings(runs: Sequence[Mapping[str, Any]], *, title: str = "") -> Figure:
    """Return a panel for each run: observable, driving velocity and load over time.

    A run is {name, t, observed, label, used, V, W, holdout, gaps}: arrays (n,), `label` the observable with its unit, `gaps`
    pairs of times. Samples that are not used are marked, gaps are shaded.
    """
    columns = 1 if len(runs) < 4 else 2
    rows = math.ceil(len(runs) / columns)
    with house_style():
        figure = bare_figure((6.4 * columns, 3.3 * rows + 0.4))
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
    """Fix the layout at rounded positions: the last digits of the layout solver differ from run to run."""
    from matplotlib import rc_context

    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
    with rc_context(NO_LAYOUT):
        figure.set_layout_engine(None)  # a placeholder, which "none" leaves, has every file drawn twice
    for axis in figure.axes:
        left, bottom, width, height = (round(float(x), 5) for x in axis.get_position().bounds)
        axis.set_position((left, bottom, width, height))


def _panel(axes: list[Axes], run: Mapping[str, Any]) -> None:
    import numpy as np

    t = np.asarray(run["t"])
    labels = (run["label"], "V\n[µm/s]", f"W\n[{run.get('load_unit', 'N')}]")
    for axis, key, label, quantity in zip(axes, ("observed", "V", "W"), labels, "uvW", strict=True):
        axis.plot(*envelope(t, np.asarray(run[key])), color=QUANTITY[quantity], linewidth=0.8)
        axis.set_ylabel(label)
        axis.margins(x=0.01, y=0.08)
        for begin, end in run.get("gaps", ()):
            axis.axvspan(begin, end, color="#BBBBBB", alpha=0.5, linewidth=0)
    proposed = run.get("proposed")
    if proposed is not None:
        _proposed(axes[0], t, np.asarray(run["observed"]), np.asarray(proposed))
    for axis in axes:
        axis.ticklabel_format(axis="y", useOffset=False)
    _imposed(axes[1], np.asarray(run["V"]), wide=True)
    _imposed(axes[2], np.asarray(run["W"]), wide=False)
    marked = _mark_unused(axes[0], t, np.asarray(run["observed"]), ~np.asarray(run["used"]))
    axes[0].set_title(f"{name_text(run['name'])}{' (held out)' if run.get('holdout') else ''}{marked}")
    axes[2].set_xlabel("time  [s]")
    for axis in axes[:2]:
        axis.tick_params(labelbottom=False)


def _proposed(axis: Axes, t: Any, observed: Any, proposed: Any) -> None:
    """Draw the record as corrected, where proposed corrections change it: spikes as rings, a shifted level dashed."""
    import numpy as np

    from srfcli.data.noise import WIDEST_SPIKE
    from srfcli.motion.imposed import runs_of

    lone, moved = np.zeros(t.size, bool), np.zeros(t.size, bool)
    for first, last in runs_of(proposed != observed):
        (lone if last - first < WIDEST_SPIKE else moved)[first : last + 1] = True
    style: dict[str, Any] = {"color": COLOURS[1], "zorder": 3}
    if lone.any():
        axis.plot(t[lone], observed[lone], "o", markersize=5, markerfacecolor="none", label="spike, proposed", **style)
    if moved.any():
        axis.plot(*envelope(t[moved], proposed[moved]), "--", linewidth=0.8, label="level moved back, proposed", **style)
    axis.legend(loc="best", fontsize="small")


def _imposed(axis: Axes, values: Any, *, wide: bool) -> None:
    """Set the scale of an imposed quantity: wide for a constant, logarithmic for velocities over decades."""
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

    from srfcli.motion.imposed import runs_of

    if not bad.any():
        return ""
    total = int(bad.sum())
    for first, last in runs_of(bad):
        if last - first + 1 >= STRETCH:
            axis.axvspan(t[first], t[last], color=UNUSED, alpha=0.25, linewidth=0)
            bad[first : last + 1] = False
    single = np.flatnonzero(bad)
    if single.size > CROSSES:
        axis.plot(t[single], np.zeros(single.size), "|", color=UNUSED, markersize=6, transform=axis.get_xaxis_transform())
    else:
        axis.plot(t[single], x[single], "x", color=UNUSED, markersize=5, linestyle="none")
    return f": {total} sample{'s' if total > 1 else ''} not compared"


# Figures of records over time: friction, elongation, velocities and load, simulated and recorded.

RECORDED = "#8A8A8A"
LABELS = {"elongation": "u  [µm]", "force": "force  [N]", "friction": "friction"}


def traces(records: Sequence[Mapping[str, Any]], *, title: str = "") -> Figure:
    """Return records over time (s): one as panels above each other, several one to a row.

    A record is {name, t, observed, observable, mu, v, V, W} in um, s, N; `observed` is the simulated observable: elongation,
    force or friction. A recording under `recorded` or a gauge's readings under `measured` are drawn behind it. Velocities are on
    a logarithmic axis, on which a drive that stands still has no place.
    """
    with house_style():
        return _one(records[0], title) if len(records) == 1 else _several(records, title)


def _one(record: Mapping[str, Any], title: str) -> Figure:
    friction = record["observable"] == "friction"
    figure, axes = _grid(3 if friction else 4, 1, size=(6.4, 1.55 * (3 if friction else 4) + 0.7))
    column = [row[0] for row in axes]
    _observable(column[0], record)
    if not friction:
        _line(column[1], record["t"], record["mu"], QUANTITY["mu"])
        column[1].set_ylabel("µ")
    _velocities(column[-2], record)
    _load(column[-1], record)
    column[-1].set_xlabel("time  [s]")
    heading(figure, title)
    _names(figure, column)
    figure.align_ylabels(column)
    return figure


def _several(records: Sequence[Mapping[str, Any]], title: str) -> Figure:
    figure, axes = _grid(len(records), 3, size=(11.0, 1.7 * len(records) + 0.8))
    for row, record in zip(axes, records, strict=True):
        _observable(row[0], record)
        _velocities(row[1], record)
        _load(row[2], record)
        row[0].set_title(name_text(record["name"]))
    for ax in axes[-1]:
        ax.set_xlabel("time  [s]")
    for column in zip(*axes, strict=True):
        figure.align_ylabels(column)
    heading(figure, title)
    _names(figure, [ax for row in axes for ax in row])
    return figure


def _names(figure: Figure, axes: Sequence[Axes]) -> None:
    """Name every kind of curve once, below the panels."""
    found: dict[str, Any] = {}
    for ax in axes:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(name, handle)
    names_below(figure, list(found.values()), list(found))


def _grid(rows: int, columns: int, *, size: tuple[float, float]) -> tuple[Figure, list[list[Axes]]]:
    figure = bare_figure(size)
    made = figure.subplots(rows, columns, sharex=("row" if columns > 1 else "col"), squeeze=False)
    return figure, [list(row) for row in made]


def _observable(ax: Axes, record: Mapping[str, Any]) -> None:
    beside = [name for name in ("recorded", "measured") if record.get(name) is not None]
    for name in beside:
        _line(ax, record["t"], record[name], RECORDED, label=name, width=2.2)
    _line(ax, record["t"], record["observed"], QUANTITY["u"], label="simulated" if beside else None)
    ax.set_ylabel(LABELS[record["observable"]])


def _velocities(ax: Axes, record: Mapping[str, Any]) -> None:
    import numpy as np

    v, V = (np.where(np.asarray(record[k], float) > 0, record[k], np.nan) for k in ("v", "V"))
    _line(ax, record["t"], v, QUANTITY["v"], label="slip velocity v")
    _line(ax, record["t"], V, QUANTITY["V"], label="driving velocity V", dash=DASHES[1], width=1.1)
    ax.set_yscale("log")
    ax.set_ylabel("velocity  [µm/s]")
    low, high = np.nanmin(v, initial=np.inf), np.nanmax(v, initial=-np.inf)
    if high < 1.02 * low:
        ax.set_ylim(low / 2, high * 2)  # steady sliding is a level line, not the noise of integration
    decade_ticks(ax)


def _load(ax: Axes, record: Mapping[str, Any]) -> None:
    import numpy as np

    W = np.asarray(record["W"], float)
    _line(ax, record["t"], W, QUANTITY["W"])
    if np.ptp(W) < 1e-6 * W.max():
        ax.set_ylim(0.9 * W.min(), 1.1 * W.max())
    ax.set_ylabel("W  [N]")


def _line(ax: Axes, t: Values, y: Values, colour: str, *, label: str | None = None, dash: Any = "-", width: float = 1.4) -> None:
    import numpy as np

    x, values = envelope(np.asarray(t, float), np.asarray(y, float))
    ax.plot(x, values, color=colour, label=label, linestyle=dash, linewidth=width)
    ax.margins(x=0.0, y=0.08)
    if ax.get_yscale() == "linear":
        ax.ticklabel_format(axis="y", useOffset=False)


def envelope(t: Any, y: Any) -> tuple[Any, Any]:
    """Return a curve (t, y) reduced to the minimum and maximum of each bin, in their order; NaN gaps are kept.

    Records of up to four points a bin are returned unchanged.
    """
    import numpy as np

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


# A fit as a figure: each run's recording and prediction above its residual, in units of the noise.

FitRow = tuple[str, bool, str, Any, Any, Any, float]


def draw_loads(ax: Axes, table: Thresholds, computed: Mapping[str, Values]) -> None:
    """Draw measured critical loads, with their errors, and computed ones (n,) over V, by name; all but the first are thin."""
    import numpy as np

    mark: dict[str, Any] = {"fmt": "o", "markersize": 5, "markerfacecolor": "none"}
    for index, eps in enumerate(np.unique(table.eps)):
        style = curve_style(index)
        here = np.flatnonzero(table.eps == eps)
        here = here[np.argsort(table.V[here], kind="stable")]
        ax.errorbar(table.V[here], table.W0c[here], yerr=table.sigma[here], color=style["color"], **mark)
        for number, (name, loads) in enumerate(computed.items()):
            thin: dict[str, Any] = {"linewidth": 0.6} if number else {}
            ax.plot(table.V[here], np.asarray(loads)[here], label=f"{name}, ε = {eps:g}", **style, **thin)
    ax.errorbar([], [], yerr=[], color="#555555", label="measured, ± σ", **mark)
    ax.set(xscale="log", yscale="log", xlabel="V  [µm/s]", ylabel="critical W$_0$  [N]")
    decade_ticks(ax)
    ax.legend(loc="best", fontsize=NAME_OFFSET, handlelength=2.8)


def fit_figure(
    rows: Sequence[FitRow], *, title: str = "", found: str = "", tables: Sequence[tuple[str, bool, Thresholds, Values]] = ()
) -> Figure:
    """Return a figure of two panels for each observable of a run.

    A row is (name, held out, quantity with its unit, t in s, recorded, predicted, noise level).

    `title` names the laws, `found` the parameters with their errors. Each of the `tables` of critical loads has a panel: name,
    held out, measured, and computed loads (n,).
    """
    with house_style():
        columns = 2 if len(rows) + len(tables) > 1 else 1
        lines = -(-(len(rows) + len(tables)) // columns)
        figure = bare_figure((6.0 * columns if columns == 1 else 5.2 * columns, 2.9 * lines + 0.9))
        grid = figure.add_gridspec(lines, columns)
        handles: list[Any] = []
        for place, (name, holdout, label, t, recorded, predicted, noise) in enumerate(rows):
            cell = grid[place // columns, place % columns].subgridspec(2, 1, height_ratios=(2, 1), hspace=0.05)
            above = figure.add_subplot(cell[0])
            below = figure.add_subplot(cell[1], sharex=above)
            dots = above.plot(t, recorded, ".", color="#999999", markersize=3.0, label="recorded", rasterized=True)
            line = above.plot(t, predicted, color=COLOURS[0], linewidth=0.9, label="model")
            handles = handles or [*dots, *line]
            above.set_title(name_text(name) + (" (held out)" if holdout else ""))
            above.set_ylabel(label)
            above.ticklabel_format(axis="y", useOffset=False)
            above.tick_params(labelbottom=False)
            off = (recorded - predicted) / noise if noise else recorded - predicted
            below.plot(t, off, ".", color=COLOURS[1], markersize=2.0, rasterized=True)
            for level in (-2.0, 2.0) if noise else ():
                below.axhline(level, color="#000000", linewidth=0.7, linestyle=(0, (1, 1.5)))
            below.set_ylabel("residual\n/ noise" if noise else "residual")
            below.set_xlabel("time  [s]")
            above.margins(x=0.01)
            figure.align_ylabels([above, below])
        for place, (name, holdout, table, loads) in enumerate(tables, len(rows)):
            ax = figure.add_subplot(grid[place // columns, place % columns])
            draw_loads(ax, table, {"fit": loads})
            ax.set_title(name_text(name) + (" (held out)" if holdout else ""))
        names_below(figure, handles, [h.get_label() for h in handles], markerscale=3)
        heading(figure, "\n".join(t for t in (title, found) if t))
        return figure
