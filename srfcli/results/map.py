"""Stability over a plane of two parameters: the leading exponent on a grid, and every boundary with its special points."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import Status
from srfcli.results.base import Result, load_xarray
from srfcli.results.boundary import COLUMNS, boundary_row
from srfcli.results.tables import Column, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.codegen.model import Array, GeneratedModel
    from srfcli.codegen.slider import SlidingSystem
    from srfcli.numerics.continuation import Atlas, Branch
    from srfcli.numerics.map import StabilityMap
    from srfcli.numerics.plane import MapAxis
    from srfcli.numerics.special_points import SpecialPoint

BASE_UNITS = ("um", "s", "N", "rad")


@dataclass(frozen=True, repr=False, eq=False)
class MapResult(Result):
    """The stability of the forced sliding state over a plane of two parameters.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    found : StabilityMap
        The leading multiplier and the kind of stability, (nx, ny), with the mesh at each point.
    atlas : Atlas
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
    atlas: Atlas = field(repr=False)
    special: tuple[list[SpecialPoint], ...] = field(repr=False)
    cubic: tuple[Array, ...] = field(repr=False)
    followed: bool = True

    @cached_property
    def _common(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return what all tables share, and what JSON holds beside the rows."""
        grid, model = self.found.grid, self.system.model
        notes, meta, status = _summary(model, self.found, self.atlas, list(self.special), self.followed)
        described = self.system.described(without=(grid.x.moved, grid.y.moved))
        return {"title": model.title, "notes": notes, "parameters": described, "status": status.value}, meta

    @cached_property
    def table(self) -> Table:
        """Return a row for each point of the grid; `meta` has components and special points."""
        common, meta = self._common
        tables = {"components": _plain(self.components), "special": _plain(self.special_points)}
        return replace(grid_table(self.system.model, self.found, **common), meta={**meta, **tables})

    @cached_property
    def components(self) -> Table:
        """Return a row for each connected boundary."""
        return components_table(self.system.model, self.found, self.atlas, list(self.special), **self._common[0])

    @cached_property
    def special_points(self) -> Table:
        """Return a row for each fold, resonance and other special point."""
        return special_table(self.system.model, self.found, list(self.special))

    @cached_property
    def boundary(self) -> Table:
        """Return a row for each polished point of the boundaries, with the cubic coefficient of the normal form."""
        return _points_table(self.system.model, self.atlas, list(self.cubic), self._common[0])

    def to_xarray(self) -> Any:
        """Return growth and kind over the grid as an xarray.Dataset of two dimensions, named as the axes.

        Raises
        ------
        SrfError
            Where xarray is not installed.
        """
        xarray, grid, table = load_xarray(), self.found.grid, self.table
        names = [c.name for c in table.columns]
        shape = (grid.x.count, grid.y.count)
        columns = dict(zip(names, zip(*table.rows, strict=True), strict=True))
        import numpy as np

        x, y = (np.array(columns[n]).reshape(shape) for n in names[:2])
        made = xarray.Dataset(
            {n: (tuple(names[:2]), np.array(columns[n]).reshape(shape)) for n in names[2:]},
            coords={names[0]: x[:, 0], names[1]: y[0]},
        )
        for column in table.columns:
            made[column.name].attrs = {"units": column.unit, "long_name": column.about}
        made.attrs = {"title": table.title, "status": table.status}
        return made

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the map: growth as colour, boundaries as lines, special points as marks."""
        import numpy as np

        from srfcli.numerics.map import per_slip
        from srfcli.results.figures import stability_map
        from srfcli.results.plots import titled

        model, found, grid = self.system.model, self.found, self.found.grid
        p = found.points(model)
        xs = [shown(model, grid.x, v) for v in grid.x.samples()]
        ys = [shown(model, grid.y, v) for v in grid.y.samples()]
        growth = np.where(np.isfinite(found.leading), found.growth * per_slip(model, p), np.nan)
        lost = np.argwhere(~np.isfinite(found.leading))
        marks = [
            {"what": s.what, **dict(zip("xy", _coordinates(model, grid, s.p), strict=True))}
            for points in self.special
            for s in points
            if s.status.ok
        ]
        return stability_map(
            xs,
            ys,
            growth,
            branches=[_curve(model, grid, b, d) for b, d in zip(self.atlas.branches, self.cubic, strict=True)],
            special=marks,
            unresolved=([xs[i] for i, _ in lost], [ys[j] for _, j in lost]),
            xlabel=label(model, grid.x),
            ylabel=label(model, grid.y),
            colour_label="leading exponent × D$_0$/V" if "D0" in model.names else "leading exponent  [1/s]",
            logx=grid.x.log,
            logy=grid.y.log,
            title=titled(self.table.title, self.table.parameters),
            ax=ax,
        )


def _summary(
    model: GeneratedModel, found: StabilityMap, atlas: Atlas, special: list[list[SpecialPoint]], wanted: bool
) -> tuple[tuple[str, ...], dict[str, Any], Status]:
    """Return the notes, what JSON holds beside the rows, and the status of the whole."""
    from srfcli.numerics.map import KINDS
    from srfcli.numerics.map_boundaries import map_notes, unexplained
    from srfcli.numerics.special_points import crossings_at

    count = found.kind.size
    share = {name: float((found.kind == k).sum() / count) for k, name in enumerate(KINDS)}
    meta: dict[str, Any] = {"share": share, "suspect_cells": len(found.suspect), "points_added": len(found.extra_at)}
    status = Status.NO_CONVERGENCE if found.lost else Status.OK
    if not found.finished:
        left = "interrupted: what was not reached is unresolved, and no boundary was followed"
        return (left, *map_notes(found)), meta, Status.INTERRUPTED
    without = int((~model.has_rates(found.points(model))).sum()) if found.lost else 0
    reason = [f"{Status.NO_VALUE.value} at {without} points: {Status.NO_VALUE.advice}"] if without else []
    if not wanted:
        return (*reason, *map_notes(found)), meta, status
    values = found.points(model)[model.index(found.grid.x.moved), :, 0]
    met = crossings_at(model, atlas.plane, atlas.branches, values)
    odd = unexplained(model, found, atlas)
    meta |= {"crossings": [len(c) for c in met], "unexplained_points": len(odd)}
    number = len(atlas.branches)
    notes = [f"{number} component{'' if number == 1 else 's'}; stable at {share['stable']:.1%} of the points"]
    notes.append(crossing_notes([len(c) for c in met], found.grid.x.name))
    if len(odd):
        notes.append(
            f"the curves do not account for the stability of {len(odd)} of {count} points: one is missing there"
        )
        status = Status.NO_CONVERGENCE
    else:
        notes.append(f"the curves account for the stability of all {count} points")
    bad = sum(not s.status.ok for marks in special for s in marks)
    if bad:
        notes.append(f"{bad} special points could not be located; their rows say so")
    stopped = atlas.status is Status.INTERRUPTED  # counts before what else went wrong
    return (*notes, *reason, *atlas.notes), meta, atlas.status if stopped or status.ok else status


def _plain(table: Table) -> list[dict[str, Any]]:
    names = [c.name for c in table.columns]
    return [dict(zip(names, row, strict=True)) for row in table.rows]


def _points_table(model: GeneratedModel, atlas: Atlas, cubic: list[Array], common: dict[str, Any]) -> Table:
    """Return the polished points of all components, as `srf continue` lists them, with the cubic coefficient."""
    from srfcli.numerics.continuation import crossing_numbers

    extra = tuple(a.name for a in (atlas.plane.x, atlas.plane.y) if a.name not in ("V", "W0", "eps"))
    declared = {q.name: q for q in model.parameters}
    rows = [
        (*boundary_row(model, q, k, number, extra), float(d))
        for k, (branch, numbers) in enumerate(zip(atlas.branches, crossing_numbers(model, atlas), strict=True), 1)
        for q, number, d in zip(branch.points, numbers, cubic[k - 1], strict=True)
    ]
    about = "cubic coefficient of the normal form, a period; supercritical where negative, subcritical where positive"
    columns = (*COLUMNS, *(Column(n, declared[n].unit, declared[n].about) for n in extra), Column("cubic", "1", about))
    return Table("srf.map.boundary/1", columns, rows, **{**common, "notes": ()})


def growth_column(model: GeneratedModel) -> Column:
    """Return the column of the leading exponent."""
    if "D0" in model.names:
        return Column(
            "growth_per_slip", "1", "real part of the leading Floquet exponent times D0/V; stable where negative"
        )
    return Column("growth", "1/s", "real part of the leading Floquet exponent; stable where negative")


def grid_table(model: GeneratedModel, found: StabilityMap, **common: Any) -> Table:
    """Return the map as one row for each grid point."""
    import numpy as np

    from srfcli.numerics.map import KINDS, per_slip

    grid, p = found.grid, found.points(model)
    growth, kind = found.growth, found.kind
    scaled, theta = growth * per_slip(model, p), np.abs(np.angle(found.leading))
    xs = [shown(model, grid.x, v) for v in grid.x.samples()]
    ys = [shown(model, grid.y, v) for v in grid.y.samples()]
    rows = [
        (x, y, float(scaled[i, j]), float(growth[i, j]), float(theta[i, j]), KINDS[kind[i, j]], int(found.mesh[i, j]))
        for i, x in enumerate(xs)
        for j, y in enumerate(ys)
    ]
    columns = (
        Column(column_name(grid.x), axis_unit(model, grid.x), "", ".10g"),
        Column(column_name(grid.y), axis_unit(model, grid.y), "", ".10g"),
        growth_column(model),
        Column("growth_per_period", "1", "ln of the leading multiplier's modulus over one forcing period"),
        Column("theta", "rad", "angle of the leading multiplier over one forcing period"),
        Column(
            "kind",
            "",
            "stable; ns, pd, fold: unstable by a multiplier off the real axis, negative, positive; unresolved",
        ),
        Column("intervals", "1", "of the mesh"),
    )
    return Table("srf.map/1", columns, rows, **common)


def components_table(
    model: GeneratedModel, found: StabilityMap, atlas: Atlas, special: list[list[SpecialPoint]], **common: Any
) -> Table:
    """Return one row for each boundary component."""
    import numpy as np

    grid = found.grid
    rows = []
    for k, (branch, marks) in enumerate(zip(atlas.branches, special, strict=True), 1):
        p = np.stack([pt.p for pt in branch.points], axis=1)
        spans = [shown(model, axis, f(axis.quantity(model, p))) for axis in (grid.x, grid.y) for f in (np.min, np.max)]
        kinds = "+".join(sorted({pt.kind for pt in branch.points}))
        folds = Counter(s.axis for s in marks if s.what == "fold")
        others = ", ".join(sorted({s.what for s in marks} - {"fold"})) or None
        worst = max(pt.error for pt in branch.points)
        turned = [folds.get(axis.moved, 0) for axis in (grid.x, grid.y)]
        rows.append(
            (k, len(branch.points), kinds, *spans, *turned, others, branch.start.value, branch.end.value, worst)
        )
    names = [(column_name(a), axis_unit(model, a)) for a in (grid.x, grid.y)]
    columns = (
        Column("component", "1", "number of the connected curve"),
        Column("points"),
        Column("type", "", "ns, pd or fold: a multiplier off the real axis, at -1, at +1"),
        *(Column(f"{n}_{end}", u) for n, u in names for end in ("min", "max")),
        *(Column(f"folds_{n}", "1", f"how often {n} turns round along the curve") for n, _ in names),
        Column("other", "", "resonances and other special points on it"),
        Column("start", "", "why the curve begins where it does"),
        Column("end", "", "why it ends; closed: an island"),
        Column("error", "1", "largest estimated relative error of its points", ".2g"),
    )
    return Table("srf.map.components/1", columns, rows, **common)


def special_table(model: GeneratedModel, found: StabilityMap, special: list[list[SpecialPoint]]) -> Table:
    """Return one row for each fold, resonance and other special point."""
    grid = found.grid
    names = [(column_name(a), axis_unit(model, a)) for a in (grid.x, grid.y)]
    rows = [
        (
            k,
            f"fold in {_axis_name(grid, s.axis)}" if s.what == "fold" else s.what,
            *(shown(model, a, float(a.quantity(model, s.p))) for a in (grid.x, grid.y)),
            s.theta,
            s.error,
            s.status.value,
        )
        for k, marks in enumerate(special, 1)
        for s in marks
    ]
    columns = (
        Column("component"),
        Column("point", "", "fold: a parameter turns round; 1:k: resonance"),
        *(Column(n, u, "", ".10g") for n, u in names),
        Column("theta", "rad", "angle of the critical multiplier over one forcing period"),
        Column("error", "1", "estimated relative error", ".2g"),
        Column("status", ""),
    )
    return Table("srf.map.special/1", columns, rows, "special points")


def _axis_name(grid: Any, moved: str) -> str:
    return next(column_name(a) for a in (grid.x, grid.y) if a.moved == moved)


def crossing_notes(counts: list[int], name: str) -> str:
    """Return how many boundaries vertical lines meet, as a sentence."""
    seen = sorted(Counter(counts).items())
    said = ", ".join(f"{n} on {lines}" for n, lines in seen)
    return f"boundaries met by the {len(counts)} lines of constant {name}: {said}"


def _coordinates(model: GeneratedModel, grid: Any, p: Array) -> list[float]:
    return [shown(model, a, float(a.quantity(model, p))) for a in (grid.x, grid.y)]


def _curve(
    model: GeneratedModel, grid: Any, branch: Branch, cubic: Array
) -> tuple[list[float], list[float], list[str]]:
    """Return a branch's coordinates and what it is at each; a closed one ends where it begins."""
    points = [_coordinates(model, grid, pt.p) for pt in branch.points]
    if branch.end is Status.CLOSED:
        points.append(points[0])
    looks = [
        "fold" if pt.kind == "fold" else "subcritical" if d > 0 else ""
        for pt, d in zip(branch.points, cubic, strict=True)
    ]
    return [q[0] for q in points], [q[1] for q in points], looks + looks[: len(points) - len(looks)]


def ratio_powers(model: GeneratedModel, held: str, moved: str) -> tuple[int, ...]:
    """Return the powers of (um, s, N, rad) of the ratio of two parameters."""
    from srfcli.core.units import find_unit

    top, bottom = (find_unit(model.parameters[model.index(n)].unit).powers for n in (held, moved))
    return tuple(a - b for a, b in zip(top, bottom, strict=True))


def unit_text(powers: tuple[int, ...]) -> str:
    """Return powers of the base units as a unit: 1/um, N s/um^2, 1."""

    def side(sign: int) -> str:
        parts = [
            name if abs(p) == 1 else f"{name}^{abs(p)}"
            for name, p in zip(BASE_UNITS, powers, strict=True)
            if p * sign > 0
        ]
        return " ".join(parts)

    top, bottom = side(1), side(-1)
    return f"{top or '1'}/{bottom}" if bottom else top or "1"


def axis_unit(model: GeneratedModel, axis: MapAxis) -> str:
    """Return the unit in which an axis is shown: the parameter's declared one, um, s, N for a ratio."""
    return (
        unit_text(ratio_powers(model, axis.held, axis.moved))
        if axis.held
        else model.parameters[model.index(axis.moved)].unit
    )


def shown(model: GeneratedModel, axis: MapAxis, value: float) -> float:
    """Return a quantity in the unit it is shown in."""
    return float(value) if axis.held else model.declared(axis.moved, float(value))


def column_name(axis: MapAxis) -> str:
    """Return an axis' name as a column: V, K_over_W0."""
    return f"{axis.held}_over_{axis.moved}" if axis.held else axis.moved


def label(model: GeneratedModel, axis: MapAxis) -> str:
    """Return an axis' label with its unit."""
    from srfcli.results.plots import axis_label, symbol_text

    if not axis.held:
        return axis_label(axis.moved, axis_unit(model, axis))
    ratio = f"{symbol_text(axis.held)}/{symbol_text(axis.moved)}"
    unit = axis_unit(model, axis)
    return ratio if unit in ("", "1") else f"{ratio}  [{unit.replace('um', 'µm')}]"
