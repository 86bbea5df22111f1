"""Figures of what was found: how far parameters had been bent, a missing force, a stability diagram."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.output.plots import (
    COLOURS,
    DASHES,
    DOTTED,
    _decade_ticks,
    _gaps,
    house_style,
    load_matplotlib,
    name_text,
    new_figure,
)
from srfcli.output.recordings import _settle, _thinned
from srfcli.output.report_runs import AFTER, BEFORE, NARROW
from srfcli.output.report_text import finite

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PIECES = 40  # in which a force is averaged along a quantity of state
STATES = (("v", "slip velocity v  [µm/s]", True), ("phi", "age φ  [s]", True), ("W", "load W  [N]", False))
WIDE = 10.0  # ratio from which a quantity has a logarithmic axis


def parameters_figure(parameters: Sequence[Mapping[str, Any]], *, narrow: bool = False) -> Figure | None:
    """Return how far each parameter of the baseline had been bent, in its own standard errors; None where none is known."""
    rows = [p for p in parameters if finite(p.get("shift_sigma"))][::-1]
    if not rows:
        return None
    shifts = [float(p["shift_sigma"]) for p in rows]
    size = max(abs(s) for s in shifts)
    with house_style():
        figure, (axis,) = new_figure(size=(NARROW if narrow else 6.6, 0.32 * len(rows) + 1.0))
        axis.axvspan(-2, 2, color="#DDDDDD", linewidth=0)
        axis.axvline(0, color="#777777", linewidth=0.8)
        for k, shift in enumerate(shifts):
            axis.plot([0, shift], [k, k], color=BEFORE, linewidth=1.6)
            axis.plot(shift, k, "o", color=BEFORE, markersize=5)
        axis.set_yticks(range(len(rows)), [name_text(str(p["name"]), narrow=narrow) for p in rows])
        axis.set_ylim(-0.6, len(rows) - 0.4)
        if size > 30:
            axis.set_xscale("symlog", linthresh=3.0)
            ticks = [t for t in (-1000, -100, -30, -10, -3, 0, 3, 10, 30, 100, 1000) if abs(t) < 2 * size]
            axis.set_xticks(ticks, [f"{t}".replace("-", "−") for t in ticks])
            axis.set_xticks([], minor=True)
            axis.set_xlim(
                *(1.6 * (end if abs(end) > 3.0 else 3.0 * side) for end, side in ((min(shifts), -1), (max(shifts), 1)))
            )
        axis.set_xlabel("baseline less augmented model  [standard errors]")
        axis.grid(axis="y", visible=False)
        _settle(figure)
        return figure


def force_figure(name: str, force: Mapping[str, Any], *, unit: str = "N", narrow: bool = False) -> Figure:
    """Return a run's missing force (n,) over time with its band, above the load and the slip velocity where they are known."""
    t = np.asarray(force["t"], dtype=float)
    imposed = [(k, label) for k, label in (("v", "v\n[µm/s]"), ("W", "W\n[N]")) if force.get(k) is not None]
    with house_style():
        figure, axes = new_figure(1 + len(imposed), size=(NARROW if narrow else 9.0, 2.6 + 1.0 * len(imposed)))
        values, band = np.asarray(force["force"], dtype=float), force.get("band")
        if band is not None:
            low, high = _limits(values, np.asarray(band, dtype=float))
            axes[0].fill_between(t, low, high, color=AFTER, alpha=0.22, linewidth=0, label="95 % band")
        axes[0].plot(*_thinned(t, values), color=AFTER, linewidth=1.2, label="missing force")
        axes[0].axhline(0, color="#777777", linewidth=0.8)
        axes[0].set_title(name_text(name, narrow=narrow), pad=22 if narrow else None)
        axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.99), ncols=2, fontsize=8.5, borderaxespad=0.0)
        axes[0].set_ylabel(f"missing force\n[{unit}]" if unit != "1" else "missing friction\ncoefficient")
        for axis, (key, label) in zip(axes[1:], imposed, strict=True):
            known = np.asarray(force[key], dtype=float)
            axis.plot(*_thinned(t, known), color="#555555", linewidth=0.8)
            axis.set_ylabel(label)
            if key == "v" and known.min() > 0 and known.max() > WIDE * known.min():
                axis.set_yscale("log")
                _decade_ticks(axis)
        axes[-1].set_xlabel("t  [s]")
        axes[-1].set_xlim(t[0] - 0.01 * np.ptp(t), t[-1] + 0.01 * np.ptp(t))
        figure.align_ylabels(axes)
        _settle(figure)
        return figure


def _limits(values: Any, band: Any) -> tuple[Any, Any]:
    """Return lower and upper limit from a band given as a half width (n,), or as limits (2, n) or (n, 2)."""
    if band.ndim < 2:
        return values - band, values + band
    return (band[0], band[1]) if band.shape[0] == 2 else (band[:, 0], band[:, 1])


def force_by_state(forces: Mapping[str, Mapping[str, Any]], *, unit: str = "N", narrow: bool = False) -> Figure | None:
    """Return the missing force of all runs against slip velocity, age and load, averaged in pieces; None without a state."""
    load_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [s for s in STATES if any(f.get(s[0]) is not None and np.ptp(f[s[0]]) > 0 for f in forces.values())]
    if not shown:
        return None
    with house_style():
        lines = len(shown) if narrow else 1
        figure = Figure(figsize=(NARROW if narrow else 3.2 * len(shown) + 0.4, 0.5 + 2.6 * lines))
        FigureCanvasAgg(figure)
        axes = figure.subplots(lines, len(shown) // lines, sharey=True, squeeze=False).ravel()
        for axis, (key, label, wide) in zip(axes, shown, strict=True):
            spans = [np.asarray(f[key], dtype=float) for f in forces.values() if f.get(key) is not None]
            low, high = min(float(s.min()) for s in spans), max(float(s.max()) for s in spans)
            log = wide and low > 0 and high > WIDE * low
            for index, (name, force) in enumerate(forces.items()):
                if force.get(key) is not None:
                    _by_state(axis, np.asarray(force[key], dtype=float), np.asarray(force["force"], dtype=float), log,
                              name_text(name, narrow=narrow), index)  # fmt: skip
            axis.axhline(0, color="#777777", linewidth=0.8)
            axis.set_xlabel(label)
            if log:
                axis.set_xscale("log")
                _decade_ticks(axis)
        axes[0].set_ylabel(f"missing force  [{unit}]" if unit != "1" else "missing friction coefficient")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8.5)
        _settle(figure)
        return figure


def _by_state(axis: Axes, x: Any, y: Any, log: bool, label: str, index: int) -> None:
    """Draw samples faintly and their averages along the quantity of state."""
    colour = COLOURS[index % len(COLOURS)]
    every = max(x.size // 1500, 1)
    axis.plot(x[::every], y[::every], ".", color=colour, markersize=1.2, alpha=0.25, rasterized=True)
    scale = np.log(x) if log else x
    edges = np.linspace(scale.min(), scale.max(), PIECES + 1)
    place = np.clip(np.digitize(scale, edges) - 1, 0, PIECES - 1)
    count = np.bincount(place, minlength=PIECES)
    kept = count >= max(3, x.size // 2000)
    middle = 0.5 * (edges[1:] + edges[:-1])[kept]
    mean = np.bincount(place, weights=y, minlength=PIECES)[kept] / count[kept]
    axis.plot(np.exp(middle) if log else middle, mean, color=colour, linestyle=DASHES[index % len(DASHES)], label=label)


def diagram_figure(diagram: Mapping[str, Any], *, narrow: bool = False) -> Figure | None:
    """Return the stability boundary W0 (N) against V (um/s) of baseline and augmented model; keys V, W0_baseline, W0_augmented.

    `V_augmented` where the second has velocities of its own, `W0_hopf` under constant load, None or NaN for gaps.
    """
    curves = [("W0_baseline", "baseline", BEFORE, "-"), ("W0_augmented", "augmented model", AFTER, (0, (5, 1.5)))]
    curves += [("W0_hopf_baseline", "baseline, constant load", BEFORE, DOTTED)]
    curves += [("W0_hopf_augmented", "augmented model, constant load", AFTER, DOTTED)]
    drawn = [c for c in curves if diagram.get(c[0]) is not None and np.isfinite(_gaps(diagram[c[0]])).any()]
    if not drawn or diagram.get("V") is None:
        return None
    with house_style():
        figure, (axis,) = new_figure(size=(NARROW, 4.6) if narrow else (6.4, 4.2))
        for key, label, colour, dash in drawn:
            own = diagram.get(key.replace("W0", "V"))
            V = diagram["V"] if own is None else own
            axis.plot(_gaps(V), _gaps(diagram[key]), color=colour, linestyle=dash, label=label)
        axis.set_xscale("log")
        marks = [(float(V), float(W)) for V, W in diagram.get("marks") or () if V > 0 and W > 0]
        if marks:
            axis.plot(
                *zip(*marks, strict=True), "+", color="#000000", markersize=9, markeredgewidth=1.6, linestyle="none",
                label="your runs", zorder=5, clip_on=False,
            )  # fmt: skip
        axis.margins(x=0.0 if not marks else 0.02)
        heights = np.concatenate([*(_gaps(diagram[c[0]]) for c in drawn), [W for _, W in marks]])
        if np.nanmax(heights) > WIDE * np.nanmin(heights) > 0:
            axis.set_yscale("log")
        axis.set_xlabel("V  [µm/s]")
        axis.set_ylabel(f"critical load W$_0$  [{diagram.get('load_unit', 'N')}]")
        legend = axis.legend(
            loc="best", handlelength=2.8, title="sliding is steady below the first boundary", alignment="left"
        )
        legend.get_title().set_color("#555555")
        _decade_ticks(axis)
        _settle(figure)
        return figure
