"""A fit as a figure: each run's recording and prediction above its residual, in units of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from srfcli.output.plots import house_style, name_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FitRow = tuple[str, bool, Any, Any, Any, float]


def fit_figure(rows: Sequence[FitRow], *, quantity: str, unit: str) -> Figure:
    """Return a figure of two panels for each run; a row is (name, held out, t in s, recorded, predicted, noise level)."""
    with house_style():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        columns = 2 if len(rows) > 1 else 1
        lines = -(-len(rows) // columns)
        figure = Figure(figsize=(5.2 * columns, 2.6 * lines), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(lines, columns)
        label = quantity if unit == "1" else f"{quantity} ({unit})"
        for place, (name, holdout, t, recorded, predicted, noise) in enumerate(rows):
            cell = grid[place // columns, place % columns].subgridspec(2, 1, height_ratios=(2, 1), hspace=0.05)
            above, below = figure.add_subplot(cell[0]), figure.add_subplot(cell[1])
            above.plot(t, recorded, ".", color="0.65", markersize=1.5, label="recorded", rasterized=True)
            above.plot(t, predicted, color="C0", linewidth=1.0, label="fitted" if not holdout else "predicted")
            above.set_title(name_text(f"{name} (held out)" if holdout else name), loc="left")
            above.set_ylabel(label)
            above.tick_params(labelbottom=False)
            below.plot(
                t,
                (recorded - predicted) / noise if noise else recorded - predicted,
                ".",
                color="C1",
                markersize=1.5,
                rasterized=True,
            )
            below.axhline(0, color="0.3", linewidth=0.6)
            below.set_ylabel("residual\n/ noise" if noise else "residual")
            below.set_xlabel("time (s)")
            if place == 0:
                above.legend(loc="best", markerscale=4)
        return figure
