"""Figures of records over time: friction, elongation, velocities and load, simulated and recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from srfcli.output.plots import (
    DASHES,
    QUANTITY,
    Values,
    _decade_ticks,
    heading,
    house_style,
    load_matplotlib,
    name_text,
    names_below,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS = 1500  # across a panel; of longer records the least and the largest value of each bin are drawn
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
    load_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
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
    _decade_ticks(ax)


def _load(ax: Axes, record: Mapping[str, Any]) -> None:
    import numpy as np

    W = np.asarray(record["W"], float)
    _line(ax, record["t"], W, QUANTITY["W"])
    if np.ptp(W) < 1e-6 * W.max():
        ax.set_ylim(0.9 * W.min(), 1.1 * W.max())
    ax.set_ylabel("W  [N]")


def _line(
    ax: Axes, t: Values, y: Values, colour: str, *, label: str | None = None, dash: Any = "-", width: float = 1.4
) -> None:
    import numpy as np

    x, values = envelope(np.asarray(t, float), np.asarray(y, float))
    ax.plot(x, values, color=colour, label=label, linestyle=dash, linewidth=width)
    ax.margins(x=0.0, y=0.08)
    if ax.get_yscale() == "linear":
        ax.ticklabel_format(axis="y", useOffset=False)


def envelope(t: Any, y: Any, *, bins: int = BINS) -> tuple[Any, Any]:
    """Return a curve (t, y) of few points that looks the same: the least and the largest value of each bin, in their order.

    Records of up to four points a bin stay as they are.
    """
    import numpy as np

    if t.size <= 4 * bins:
        return t, y
    edges = np.searchsorted(t, np.linspace(t[0], t[-1], bins + 1)[:-1])
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
