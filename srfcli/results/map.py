"""Stability over a plane of two parameters, with every boundary and its special points; laws side by side."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import Status
from srfcli.core.units import describe, find_unit
from srfcli.numerics.compare import EXPERIMENT, LawStudy, Match, Observables, Window, changed_areas, contrast
from srfcli.numerics.continuation import Boundary, crossing_numbers
from srfcli.numerics.map import STABILITY_KINDS, StabilityMap, per_slip
from srfcli.numerics.map_boundaries import map_notes, unexplained
from srfcli.numerics.plane import MapAxis
from srfcli.numerics.special_points import SpecialPoint, crossings_at
from srfcli.results import plots
from srfcli.results.stability import boundary_columns, boundary_row
from srfcli.results.tables import STATUS, Column, Result, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.codegen.slider import SlidingSystem

PLACE = ("eps", "V", "K_over_W0", "W0")  # where a point lies; parameters along other axes stand after these
GROWTH = {
    "growth_per_slip": ("1", "real part of the leading Floquet exponent times D0/V; stable where negative"),
    "growth_rate": ("1/s", "real part of the leading Floquet exponent; stable where negative"),
}


@dataclass(frozen=True, repr=False, eq=False)
class MapResult(Result):
    """The stability of the forced sliding state over a plane of two parameters.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    found : StabilityMap
        The leading multiplier and the kind of stability, (nx, ny), with the mesh at each point.
    curves : Boundary
        The boundaries, component after component.
    special : tuple of list of SpecialPoint
        Folds, resonances and changes of criticality on each component.
    cubic : tuple of array
        The cubic coefficient of the normal form at each point of each component; NaN where it was not asked for.
    followed : bool
        Whether boundaries were followed at all.
    """

    system: SlidingSystem
    found: StabilityMap = field(repr=False)
    curves: Boundary = field(repr=False)
    special: tuple[list[SpecialPoint], ...] = field(repr=False)
    cubic: tuple[Array, ...] = field(repr=False)
    followed: bool = True

    @cached_property
    def _summary(self) -> tuple[tuple[str, ...], dict[str, Any], Status]:
        """Return the notes, what JSON holds beside the rows, and the status of the whole."""
        model, found, boundary = self.system.model, self.found, self.curves
        count = found.kind.size
        share = {name: float((found.kind == k).sum() / count) for k, name in enumerate(STABILITY_KINDS)}
        meta: dict[str, Any] = {"share": share, "suspect_cells": len(found.suspect), "points_added": len(found.extra_at)}
        status = Status.NO_CONVERGENCE if found.lost else Status.OK
        if not found.finished:
            left = "interrupted: what was not reached is unresolved, and no boundary was followed"
            return (left, *map_notes(found)), meta, Status.INTERRUPTED
        without = int((~model.has_rates(found.points(model))).sum()) if found.lost else 0
        reason = [f"{Status.NO_VALUE.value} at {without} points: {Status.NO_VALUE.advice}"] if without else []
        if not self.followed:
            return (*reason, *map_notes(found)), meta, status
        values = found.points(model)[model.index(found.grid.x.moved), :, 0]
        met = [len(crossings) for crossings in crossings_at(model, boundary.plane, boundary.branches, values)]
        odd = unexplained(model, found, boundary)
        meta |= {"crossings": met, "unexplained_points": len(odd)}
        number = len(boundary.branches)
        lines = ", ".join(f"{n} on {lines}" for n, lines in sorted(Counter(met).items()))
        notes = [
            f"{number} component{'' if number == 1 else 's'}; stable at {share['stable']:.1%} of the points",
            f"boundaries met by the {len(met)} lines of constant {found.grid.x.name}: {lines}",
        ]
        if len(odd):
            notes.append(f"the curves do not account for the stability of {len(odd)} of {count} points: one is missing there")
            status = Status.NO_CONVERGENCE
        else:
            notes.append(f"the curves account for the stability of all {count} points")
        bad = sum(not s.status.ok for marks in self.special for s in marks)
        if bad:
            notes.append(f"{bad} special points could not be located; their rows say so")
        stopped = boundary.status is Status.INTERRUPTED  # counts before what else went wrong
        return (*notes, *reason, *boundary.notes), meta, boundary.status if stopped or status.ok else status

    @cached_property
    def _common(self) -> dict[str, Any]:
        """Return what the tables of the map and of its boundaries share."""
        notes, _, status = self._summary
        described = self.system.described(without=(self.found.grid.x.moved, self.found.grid.y.moved))
        return {"title": self.system.model.title, "notes": notes, "parameters": described, "status": status.value}

    @property
    def _names(self) -> list[tuple[str, str]]:
        """Return each axis as the name of a column, and its unit."""
        grid = self.found.grid
        return [(column_name(a), axis_unit(self.system.model, a)) for a in (grid.x, grid.y)]

    def _coordinates(self, p: Array) -> list[float]:
        """Return where parameters (n_parameters,) lie on the two axes, in the units that are shown."""
        model, grid = self.system.model, self.found.grid
        return [shown(model, a, float(a.quantity(model, p))) for a in (grid.x, grid.y)]

    @cached_property
    def table(self) -> Table:
        """Return a row for each point of the grid; `meta` has components and special points."""
        model, found, grid = self.system.model, self.found, self.found.grid
        p, declared, shape = found.points(model), {q.name: q for q in model.parameters}, found.kind.shape
        place = {n: np.broadcast_to(p[model.index(n)], shape) for n in ("eps", "V", "W0")}
        place["K_over_W0"] = np.broadcast_to(p[model.index("K")] / p[model.index("W0")], shape)
        for axis, along in ((grid.x, np.s_[:, None]), (grid.y, np.s_[None, :])):
            values = np.array([shown(model, axis, v) for v in axis.samples()])
            place[column_name(axis)] = np.broadcast_to(values[along], shape)
        extra = [a for a in (grid.x, grid.y) if column_name(a) not in PLACE]
        growth = "growth_per_slip" if "D0" in model.names else "growth_rate"
        kinds = "stable; ns, pd, fold: unstable by a multiplier off the real axis, negative, positive; unresolved"
        columns = (
            Column("eps", "1", "modulation amplitude"),
            Column("type", "", kinds),
            Column("V", "um/s", "driving velocity"),
            Column("K_over_W0", "1/um", "stiffness over mean load", ".10g"),
            Column("W0", "N", "mean load", ".10g"),
            *(Column(column_name(a), axis_unit(model, a), "" if a.held else declared[a.moved].about, ".10g") for a in extra),
            Column("theta", "rad", "angle of the leading multiplier over one forcing period"),
            Column(growth, *GROWTH[growth]),
            Column("growth_per_period", "1", "ln of the leading multiplier's modulus over one forcing period"),
            Column("intervals", "1", "of the mesh"),
        )
        cells = place | {
            "type": np.array(STABILITY_KINDS)[found.kind],
            "theta": np.abs(np.angle(found.leading)),
            "intervals": found.mesh,
        }
        cells |= {growth: found.growth * per_slip(model, p), "growth_per_period": found.growth}
        rows = list(zip(*(cells[c.name].ravel().tolist() for c in columns), strict=True))
        meta = self._summary[1] | {"components": self.components.records(), "special": self.special_points.records()}
        return Table("srf.map/2", columns, rows, meta=meta, **self._common)

    @cached_property
    def components(self) -> Table:
        """Return a row for each connected boundary."""
        model, grid, rows = self.system.model, self.found.grid, []
        for k, (branch, marks) in enumerate(zip(self.curves.branches, self.special, strict=True), 1):
            p = np.stack([pt.p for pt in branch.points], axis=1)
            spans = [shown(model, axis, f(axis.quantity(model, p))) for axis in (grid.x, grid.y) for f in (np.min, np.max)]
            kinds = "+".join(sorted({pt.kind for pt in branch.points}))
            folds = Counter(s.axis for s in marks if s.what == "fold")
            others = ", ".join(sorted({s.what for s in marks} - {"fold"})) or None
            worst = max(pt.error for pt in branch.points)
            turned = [folds.get(axis.moved, 0) for axis in (grid.x, grid.y)]
            rows.append((k, len(branch.points), kinds, *spans, *turned, others, branch.start.value, branch.end.value, worst))
        columns = (
            Column("component", "1", "number of the connected curve"),
            Column("points", "1", "on the curve"),
            Column("type", "", "ns, pd or fold: a multiplier off the real axis, at -1, at +1"),
            *(Column(f"{n}_{end}", u) for n, u in self._names for end in ("min", "max")),
            *(Column(f"folds_{n}", "1", f"how often {n} turns round along the curve") for n, _ in self._names),
            Column("special_points", "", "resonances and other special points on it, folds aside"),
            Column("start", "", "why the curve begins where it does"),
            Column("end", "", "why it ends; closed: an island"),
            Column("error", "1", "largest estimated relative error of its points", ".2g"),
        )
        return Table("srf.map.components/1", columns, rows, **self._common)

    @cached_property
    def special_points(self) -> Table:
        """Return a row for each fold, resonance and other special point."""
        axes = {a.moved: column_name(a) for a in (self.found.grid.y, self.found.grid.x)}
        rows = []
        for k, marks in enumerate(self.special, 1):
            for s in marks:
                what = f"fold in {axes[s.axis]}" if s.what == "fold" else s.what
                rows.append((k, what, *self._coordinates(s.p), s.theta, s.error, s.status.value))
        columns = (
            Column("component", "1", "number of the connected curve"),
            Column("point", "", "fold: a parameter turns round; 1:k: resonance"),
            *(Column(n, u, "", ".10g") for n, u in self._names),
            Column("theta", "rad", "angle of the critical multiplier over one forcing period"),
            Column("error", "1", "estimated relative error", ".2g"),
            Column("status", "", STATUS),
        )
        return Table("srf.map.special/1", columns, rows, "special points")

    @cached_property
    def boundary(self) -> Table:
        """Return a row for each polished point of the boundaries, with the cubic coefficient of the normal form."""
        model, boundary = self.system.model, self.curves
        extra = tuple(a.name for a in (boundary.plane.x, boundary.plane.y) if a.name not in ("V", "W0", "eps"))
        branches = zip(boundary.branches, crossing_numbers(model, boundary), self.cubic, strict=True)
        rows = [
            (*boundary_row(model, q, k, number, extra), float(d))
            for k, (branch, numbers, cubic) in enumerate(branches, 1)
            for q, number, d in zip(branch.points, numbers, cubic, strict=True)
        ]
        about = "cubic coefficient of the normal form, a period; supercritical where negative, subcritical where positive"
        columns = (*boundary_columns(model, extra), Column("cubic", "1", about))
        return Table("srf.map.boundary/1", columns, rows, **{**self._common, "notes": ()})

    def to_xarray(self) -> Any:
        """Return growth and type of stability over the grid as an xarray.Dataset of two dimensions, named as the axes."""
        grid, table = self.found.grid, self.table
        cells = zip(*table.rows, strict=True)
        fields = {c.name: np.array(v).reshape(grid.x.count, grid.y.count) for c, v in zip(table.columns, cells, strict=True)}
        x, y = column_name(grid.x), column_name(grid.y)
        coords = {x: fields.pop(x)[:, 0], y: fields.pop(y)[0]}
        return table.dataset({name: ((x, y), values) for name, values in fields.items()}, coords=coords)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the map: growth as colour, boundaries as lines, special points as marks.

        The stable side is hatched as well as shaded, so that it is told apart in print without colour.
        """
        model, grid, p = self.system.model, self.found.grid, self.found.points(self.system.model)
        known = np.isfinite(self.found.leading)
        growth = np.ma.masked_invalid(np.where(known, self.found.growth * per_slip(model, p), np.nan))
        x, y = (np.array([shown(model, axis, v) for v in axis.samples()]) for axis in (grid.x, grid.y))
        with plots.house_style():
            own = ax is None
            figure, (ax,) = plots.new_figure(size=(6.8, 4.8)) if ax is None else (cast("Figure", ax.figure), [ax])
            ax.grid(False)
            ax.set_xscale("log" if grid.x.log else "linear")
            ax.set_yscale("log" if grid.y.log else "linear")
            mesh = _draw_shades(ax, x, y, growth)
            ax.set_facecolor("#BBBBBB")
            bar = figure.colorbar(mesh, ax=ax, extend="both", pad=0.02)
            bar.set_label("leading exponent × D$_0$/V" if "D0" in model.names else "leading exponent  [1/s]")
            _hatch_stable(ax, x, y, growth)
            _draw_boundaries(ax, self)
            _draw_marks(ax, self)
            if not known.all():
                i, j = np.nonzero(~known)
                ax.plot(x[i], y[j], "x", color="#D00000", markersize=3, label="unresolved")
            xlabel, ylabel = (plots.axis_label(axis.name, axis_unit(model, axis)) for axis in (grid.x, grid.y))
            ax.set(xlabel=xlabel, ylabel=ylabel, xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
            if own:
                _legend(figure, ax)
                plots.heading(figure, self._figure_title)
            else:
                ax.set_title(self.table.title)
            plots.decade_ticks(ax)
            return figure


def ratio_powers(model: GeneratedModel, held: str, moved: str) -> tuple[int, ...]:
    """Return the powers of (um, s, N, rad) of the ratio of two parameters."""
    top, bottom = (find_unit(model.unit(n)).powers for n in (held, moved))
    return tuple(a - b for a, b in zip(top, bottom, strict=True))


def axis_unit(model: GeneratedModel, axis: MapAxis) -> str:
    """Return the unit in which an axis is shown: the parameter's declared one, um, s, N for a ratio."""
    return describe(ratio_powers(model, axis.held, axis.moved)) if axis.held else model.unit(axis.moved)


def shown(model: GeneratedModel, axis: MapAxis, value: float) -> float:
    """Return a quantity in the unit it is shown in."""
    return float(value) if axis.held else model.declared(axis.moved, float(value))


def column_name(axis: MapAxis) -> str:
    """Return an axis' name as a column: V, K_over_W0."""
    return f"{axis.held}_over_{axis.moved}" if axis.held else axis.moved


# Figures of stability maps: growth as colour, boundaries as lines, special points as marks.

SHADES = "PuOr_r"  # purple and orange: told apart in all common forms of colour blindness, and in grey by the curves
MARKS = {"fold": "^", "cusp": "*", "1:1": "o", "1:2": "D", "1:3": "v", "1:4": "s"}
HATCH = "#5A4A7A"
LOOKS: dict[str, dict[str, Any]] = {
    "": {"label": "boundary", "color": "black", "linewidth": 1.6},
    "subcritical": {"label": "subcritical", "color": "white", "linewidth": 0.9, "linestyle": (0, (2, 1.5))},
    "fold": {"label": "state ends (fold)", "color": "black", "linewidth": 1.6, "linestyle": (0, (4, 1.5))},
}
CRITICALITY_MARK = ("P", "criticality changes")


def _draw_shades(ax: Axes, x: Array, y: Array, growth: Any) -> Any:
    """Draw growth as colour, white at 0, its scale logarithmic but for a thirtieth of it."""
    from matplotlib.colors import SymLogNorm

    size = float(np.percentile(np.abs(growth.compressed()), 98)) if growth.count() else 1.0
    norm = SymLogNorm(linthresh=max(size / 30, 1e-12), vmin=-size, vmax=size, base=10)
    return ax.pcolormesh(x, y, growth.T, norm=norm, cmap=SHADES, shading="nearest", rasterized=True)


def _legend(figure: Figure, ax: Axes) -> None:
    """Set the legend below the figure, where it covers nothing."""
    from matplotlib.legend_handler import HandlerTuple
    from matplotlib.patches import Patch

    stable = Patch(facecolor="#B2ABD2", edgecolor=HATCH, hatch="....", linewidth=0.0, label="stable")
    drawn, names = ax.get_legend_handles_labels()
    handles: list[Any] = [stable, *drawn]
    if "subcritical" in names:  # white on black in the figure, and so in the legend
        handles[1 + names.index("subcritical")] = (drawn[names.index("boundary")], drawn[names.index("subcritical")])
    plots.names_below(figure, handles, ["stable", *names], handlelength=2.0, handler_map={tuple: HandlerTuple(ndivide=1)})


def _hatch_stable(ax: Axes, x: Array, y: Array, growth: Any) -> None:
    """Hatch where growth is negative, lightly enough to leave the shade visible."""
    if growth.count() and (growth < 0).any():
        drawn = ax.contourf(x, y, growth.T, levels=[2 * float(growth.min()), 0.0], colors="none", hatches=["...."])
        drawn.set_edgecolor(HATCH)
        drawn.set_linewidth(0.0)


def _draw_boundaries(ax: Axes, found: MapResult) -> None:
    """Draw the curves, solid, white on black where the bifurcation is subcritical, dashed where states end in a fold."""
    named: set[str] = set()
    for branch, cubic in zip(found.curves.branches, found.cubic, strict=True):
        places = np.array([found._coordinates(q.p) for q in branch.points])
        fold = np.array([q.kind == "fold" for q in branch.points])
        masks = {"": ~fold, "subcritical": ~fold & (cubic > 0), "fold": fold}
        for look, style in LOOKS.items():
            mine = masks[look]
            if not mine.any():
                continue
            x, y = places[:, 0], np.where(mine, places[:, 1], np.nan)
            if branch.end is Status.CLOSED:  # a closed curve ends where it begins
                x, y = (np.append(values, values[0]) for values in (x, y))
            ax.plot(x, y, **{**style, "label": None if look in named else style["label"]})
            named.add(look)


def _draw_marks(ax: Axes, found: MapResult) -> None:
    """Mark the special points, one kind of mark for each, each named once."""
    from matplotlib.patheffects import withStroke

    places: dict[str, list[list[float]]] = {}
    for point in (s for points in found.special for s in points if s.status.ok):
        places.setdefault(str(point.what), []).append(found._coordinates(point.p))
    for what, mine in places.items():
        marker, label = (MARKS[what], what) if what in MARKS else CRITICALITY_MARK
        ax.plot(
            *zip(*mine, strict=True), linestyle="none", marker=marker, markersize=6.5 if marker == "P" else 5.5, label=label,
            markerfacecolor="none",  # one mark does not hide another
            markeredgecolor="black", path_effects=[withStroke(linewidth=2.4, foreground="white")],
        )  # fmt: skip


# Laws side by side: a row for each law and amplitude, a sentence for each pair, their boundaries over each other.

COMPARISON_COLUMNS = (
    Column("law", "", "friction law, ageing law, or both"),
    Column("eps", "1", "modulation amplitude"),
    Column("reentrance_eps", "1", "smallest amplitude at which a line of constant V meets more than one boundary", ".4g"),
    Column("reentrance_end", "1", "amplitude from which none does any more, nothing if that is beyond the largest", ".4g"),
    Column("destabilised", "1", "share of the window, in ln V and ln K/W0, stable at a smaller amplitude, unstable at this one"),
    Column("stabilised", "1", "share of the window unstable without modulation, stable at this amplitude"),
    Column("folds_V", "1", "how often V turns round along the boundaries"),
    Column("components", "1", "connected boundaries in the window"),
    Column("V_fold", "um/s", "highest velocity at which a boundary turns back to lower ones"),
    Column("miss", "1", "what matching left, relative", ".2g"),
    Column("status", "", STATUS),
)


@dataclass(frozen=True, repr=False, eq=False)
class ComparisonResult(Result):
    """The stability diagrams of several laws, each brought to the first one's observables at one low velocity.

    Attributes
    ----------
    names : tuple of str
        What the laws are called here; the first is the reference.
    systems : tuple of SlidingSystem
        The laws with their parameters before matching.
    goal : Observables
        Friction, slope, critical load and period of the reference.
    matches : tuple of Match
        The parameters of each law (um, s, N), which of them were adjusted, and what matching left.
    studies : Mapping[int, LawStudy]
        Critical loads and boundaries of each law that could be matched, by its number.
    amplitudes, wanted : tuple of float
        Amplitudes that were computed, and those of the table.
    window : Window
        Velocities (um/s) and loads (N) that were looked at.
    """

    names: tuple[str, ...]
    systems: tuple[SlidingSystem, ...]
    goal: Observables = field(repr=False)
    matches: tuple[Match, ...] = field(repr=False)
    studies: Mapping[int, LawStudy] = field(repr=False)
    amplitudes: tuple[float, ...]
    wanted: tuple[float, ...]
    window: Window = field(repr=False)

    @property
    def _models(self) -> list[GeneratedModel]:
        return [s.model for s in self.systems]

    def _adjusted(self, k: int) -> dict[str, float]:
        """Return the parameters that were adjusted of law `k`, in their declared units."""
        model, m = self._models[k], self.matches[k]
        return {n: model.declared(n, float(m.p[model.index(n)])) for n in m.adjusted}

    @cached_property
    def table(self) -> Table:
        """Return a row for each law and amplitude; the notes say what was matched, and where an experiment tells laws apart."""
        goal, window = self.goal, self.window
        rows, worst = self._rows()
        pairs, said = self._contrasts()
        notes = (
            f"reference {self.names[0]} at {goal.V:g} um/s: friction {goal.friction:.6g}, slope -d mu/d ln V {goal.slope:.6g}, "
            f"critical load {goal.W0:.6g} N, period {2 * math.pi / goal.Omega:.6g} s",
            *(self._matched(k) for k, m in enumerate(self.matches) if m.adjusted),
            f"looked at V from {window.V[0]:g} to {window.V[1]:g} um/s and W0 from {window.W0[0]:.4g} to {window.W0[1]:.4g} N, "
            f"{window.columns} x {window.rows} points a map",
            *said,
        )
        observed = {"V": goal.V, "friction": goal.friction, "slope": goal.slope, "W0": goal.W0, "Omega": goal.Omega}
        adjusted = {name: self._adjusted(k) for k, name in enumerate(self.names)}
        meta = {"pairs": pairs, "adjusted": adjusted, "observables": observed}
        described = self.systems[0].described(without=("V", "W0", "eps"))
        title = f"{len(self.names)} laws"
        return Table("srf.compare/2", COMPARISON_COLUMNS, rows, title, notes, described, meta, worst.value)

    def _rows(self) -> tuple[list[tuple[Any, ...]], Status]:
        """Return a row under COMPARISON_COLUMNS for each law and wanted amplitude, and the first status that is not ok."""
        rows: list[tuple[Any, ...]] = []
        statuses = []
        for k, (name, m) in enumerate(zip(self.names, self.matches, strict=True)):
            if k not in self.studies:
                rows.append((name, None, *(None,) * 7, m.miss, m.status.value))
                statuses.append(m.status)
                continue
            study = self.studies[k]
            begins, ends = (b[1] if math.isfinite(b[1]) else None for b in (study.onset, study.end))
            for eps in self.wanted:
                i = self.amplitudes.index(eps)
                shape = (study.folds[i], len(study.curves[i]), highest_fold(study, i))
                areas = changed_areas(study.crossings[: i + 1], self.window)
                rows.append((name, eps, begins, ends, *areas, *shape, m.miss, study.status[i].value))
                statuses.append(study.status[i])
        return rows, next((s for s in statuses if not s.ok), Status.OK)

    def _matched(self, k: int) -> str:
        """Return how well law `k` was matched, and with which parameters."""
        name, m = self.names[k], self.matches[k]
        values = ", ".join(f"{n} = {value:.6g}" for n, value in self._adjusted(k).items())
        if m.status.ok:
            return f"{name} matched with {values}"
        return f"{name} could not be matched: {m.miss:.2g} is left with {values}"

    def _contrasts(self) -> tuple[list[dict[str, Any]], list[str]]:
        """Return for each pair of laws where their critical loads differ most, as data and as a sentence."""
        pairs, said = [], []
        for a, b in itertools.combinations(sorted(self.studies), 2):
            laws = [self.names[a], self.names[b]]
            best = contrast(self.studies[a], self.studies[b], self.amplitudes, self.window)
            if best is None:
                said.append(f"{' and '.join(laws)}: no velocity at which both have a critical load in the window")
                continue
            K = [float(self.matches[k].p[self._models[k].index("K")]) for k in (a, b)]
            ratios = [k / w for k, w in zip(K, best.W0, strict=True)]
            times = best.difference / EXPERIMENT
            told = (
                f"{times:.1f} times the {EXPERIMENT:.0%} of the paper's critical loads"
                if best.seen
                else f"not to be told apart by an experiment good to {EXPERIMENT:.0%}"
            )
            apart = f"a factor of {1 + best.difference:.3g}" if best.difference > 1 else f"{best.difference:.1%}"
            said.append(
                f"{' and '.join(laws)} differ most at V = {best.V:.3g} um/s, eps = {best.eps:.3g}: W0c = {best.W0[0]:.4g} "
                f"and {best.W0[1]:.4g} N (K/W0 = {ratios[0]:.4g} and {ratios[1]:.4g} /um), {apart}, {told}"
            )
            where = {"eps": best.eps, "V": best.V, "W0": list(best.W0), "K_over_W0": ratios}
            pairs.append({"laws": laws, **where, "difference": best.difference, "seen": bool(best.seen)})
        return pairs, said

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the boundaries at the largest amplitude over each other, each law named with its matched parameters."""
        models, studies = self._models, self.studies
        first, K = studies[min(studies)].crossings[0][:, 0], float(self.matches[0].p[models[0].index("K")])
        labels = []
        for k, (name, model) in enumerate(zip(self.names, models, strict=True)):
            told = ", ".join(plots.valued(n, value, model.unit(n)) for n, value in self._adjusted(k).items())
            labels.append(f"{plots.name_text(name)}, matched with {told}" if told else plots.name_text(name))
        branches = [
            {"eps": k, "label": labels[k], "V": curve[:, 0].tolist(), "K_over_W0": (K / curve[:, 1]).tolist()}
            for k, study in sorted(studies.items())
            for curve in study.curves[-1]
        ]
        hopf = {"V": self.window.velocities().tolist(), "K_over_W0": (K / first).tolist()}
        how = "matched at low velocity" if any(m.adjusted for m in self.matches) else "as given"
        title = f"{len(self.names)} laws, {how}, ε = {self.amplitudes[-1]:g}; {self.names[0]} with"
        return plots.stability_diagram(branches, hopf=hopf, title=plots.titled(title, self.table.parameters), ax=ax)


def highest_fold(study: LawStudy, i: int) -> float | None:
    """Return the highest velocity at which a boundary that came from lower ones turns back, None where none does."""
    tops = [
        float(v)
        for curve in study.curves[i]
        for before, v, after in zip(curve[:-2, 0], curve[1:-1, 0], curve[2:, 0], strict=True)
        if before < v > after
    ]
    return max(tops, default=None)
