"""What `srf map` shows: its grid as rows, its components and special points as tables, its figure."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from srfcli.cli.map_axes import axis_unit, column_name, label, shown
from srfcli.output.tables import Column, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srfcli.model import GeneratedModel
    from srfcli.numerics.atlas import Atlas, Branch
    from srfcli.numerics.collocation import Array
    from srfcli.numerics.map import StabilityMap
    from srfcli.numerics.special import SpecialPoint


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


def map_figure(
    model: GeneratedModel,
    found: StabilityMap,
    atlas: Atlas,
    special: list[list[SpecialPoint]],
    cubic: list[Array],
    title: str,
) -> Figure:
    """Return the map with its boundaries; `cubic` are the normal-form coefficients of each branch's points."""
    import numpy as np

    from srfcli.numerics.map import per_slip
    from srfcli.output.maps import stability_map

    grid, p = found.grid, found.points(model)
    xs = [shown(model, grid.x, v) for v in grid.x.samples()]
    ys = [shown(model, grid.y, v) for v in grid.y.samples()]
    growth = np.where(np.isfinite(found.leading), found.growth * per_slip(model, p), np.nan)
    lost = np.argwhere(~np.isfinite(found.leading))
    marks = [
        {"what": s.what, **dict(zip("xy", _coordinates(model, grid, s.p), strict=True))}
        for points in special
        for s in points
        if s.status.ok
    ]
    return stability_map(
        xs,
        ys,
        growth,
        branches=[_curve(model, grid, b, d) for b, d in zip(atlas.branches, cubic, strict=True)],
        special=marks,
        unresolved=([xs[i] for i, _ in lost], [ys[j] for _, j in lost]),
        xlabel=label(model, grid.x),
        ylabel=label(model, grid.y),
        colour_label="leading exponent × D$_0$/V" if "D0" in model.names else "leading exponent  [1/s]",
        logx=grid.x.log,
        logy=grid.y.log,
        title=title if "eps" in (grid.x.moved, grid.y.moved) else f"{title}, ε = {grid.base[model.index('eps')]:g}",
    )


def _coordinates(model: GeneratedModel, grid: Any, p: Array) -> list[float]:
    return [shown(model, a, float(a.quantity(model, p))) for a in (grid.x, grid.y)]


def _curve(
    model: GeneratedModel, grid: Any, branch: Branch, cubic: Array
) -> tuple[list[float], list[float], list[str]]:
    """Return a branch's coordinates and what it is at each; a closed one ends where it begins."""
    from srfcli.status import Status

    points = [_coordinates(model, grid, pt.p) for pt in branch.points]
    if branch.end is Status.CLOSED:
        points.append(points[0])
    looks = [
        "fold" if pt.kind == "fold" else "subcritical" if d > 0 else ""
        for pt, d in zip(branch.points, cubic, strict=True)
    ]
    return [q[0] for q in points], [q[1] for q in points], looks + looks[: len(points) - len(looks)]
