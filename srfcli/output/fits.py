"""A fit as a figure: each run's recording and prediction above its residual, in units of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from srfcli.output.plots import COLOURS, heading, house_style, name_text, names_below

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FitRow = tuple[str, bool, Any, Any, Any, float]


def fit_figure(rows: Sequence[FitRow], *, quantity: str, unit: str, title: str = "", found: str = "") -> Figure:
    """Return a figure of two panels for each run; a row is (name, held out, t in s, recorded, predicted, noise level).

    `title` names the laws, `found` the parameters with their errors.
    """
    with house_style():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        columns = 2 if len(rows) > 1 else 1
        lines = -(-len(rows) // columns)
        figure = Figure(figsize=(6.0 * columns if columns == 1 else 5.2 * columns, 2.9 * lines + 0.9))
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(lines, columns)
        label = quantity if unit == "1" else f"{quantity}\n[{unit.replace('um', 'µm')}]"
        handles: list[Any] = []
        for place, (name, holdout, t, recorded, predicted, noise) in enumerate(rows):
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
        names_below(figure, handles, [h.get_label() for h in handles], markerscale=3)
        heading(figure, "\n".join(t for t in (title, found) if t))
        return figure
