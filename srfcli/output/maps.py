"""Figures of stability maps: growth as colour, boundaries as lines, special points as marks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

from srfcli.output.plots import (
    COLOURS,
    DASHES,
    Values,
    _decade_ticks,
    heading,
    house_style,
    names_below,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
CRITICALITY = ("P", "criticality changes")


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
        _decade_ticks(ax)
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
        marker, label = MARKS.get(what, CRITICALITY)
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
    from matplotlib.ticker import MultipleLocator

    measured = [label for label in parts if "[" in label]  # what has a unit has an axis of its own
    with house_style():
        figure, axes = new_figure(2 + len(measured), size=(6.0, 5.2 + 1.5 * len(measured)))
        above, below, own = axes[0], axes[-1], dict(zip(measured, axes[1:], strict=False))
        for k, (label, values) in enumerate(parts.items()):
            look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "linestyle": DASHES[k % len(DASHES)]}
            own.get(label, above).plot(list(x), np.abs(values), label=label, **look)
            below.plot(list(x), np.degrees(np.unwrap(np.angle(values))), label=label.partition("  [")[0], **look)
        for label, axis in own.items():
            axis.set_ylabel(f"gain of {label}")
        for axis in axes[:-1]:
            axis.set_yscale("log")
        below.set_xscale("log" if logx else "linear")
        above.set_ylabel("gain for ε = 1")
        below.set_ylabel("phase  [deg]")
        below.yaxis.set_major_locator(MultipleLocator(90))
        below.set_xlabel(xlabel)
        heading(figure, title)
        names_below(figure, *below.get_legend_handles_labels())
        below.margins(x=0.0)
        figure.align_ylabels(axes)
        _decade_ticks(below)
        return figure
