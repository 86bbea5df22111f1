"""`srf map`: the stability of the forced sliding state over a plane of two parameters, with every boundary on it."""

from __future__ import annotations

import functools
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.map_rows import components_table, crossing_notes, grid_table, map_figure, special_table
from srfcli.cli.options import (
    OutputOptions,
    Range,
    SrfCommand,
    SystemOptions,
    output_options,
    over_option,
    read_output,
    system_options,
)
from srfcli.cli.workers import Spread, worker_options
from srfcli.output.plots import titled
from srfcli.status import Status

if TYPE_CHECKING:
    from srfcli.model import GeneratedModel
    from srfcli.numerics.atlas import Atlas
    from srfcli.numerics.collocation import Array
    from srfcli.numerics.map import StabilityMap
    from srfcli.numerics.mapgrid import MapGrid
    from srfcli.numerics.special import SpecialPoint
    from srfcli.output.tables import Table
    from srfcli.settings import Resolved

EXAMPLES = """
srf map --eps 0.18 --over V=1:100:120 --over K/W0=0.005:0.03:200 --plot map.svg
srf map --eps 0.18 --out map.csv --boundary boundary.csv
srf map --V 7 --over eps=0.01:0.4:80 --over K/W0=0.005:0.03:100
srf map --eps 0.4 --workers 8 --resume parts --out map.csv
"""


@click.command("map", cls=SrfCommand, epilog=EXAMPLES)
@system_options
@click.option("--eps", "eps", metavar="VALUE", help="Relative modulation amplitude, where it is not an axis.")
@click.option("--V", "V", metavar="VALUE", help="Driving velocity in um/s, where it is not an axis.")
@click.option("--W0", "W0", metavar="VALUE", help="Mean normal load in N, where it is not an axis.")
@over_option(
    help="An axis, twice: NAME=LOW:HIGH:POINTS[:log|lin]; NAME may be a ratio, as K/W0, whose second part moves."
)
@click.option("--boundary", metavar="FILE", help="Write the polished points of the boundaries to FILE (.csv or .json).")
@click.option("--boundaries/--no-boundaries", default=True, show_default=True, help="Whether boundaries are followed.")
@click.option(
    "--criticality/--no-criticality",
    default=True,
    show_default=True,
    help="Whether the normal form tells sub- from supercritical.",
)
@click.option(
    "--depth",
    type=click.IntRange(0, 10),
    default=4,
    show_default=True,
    help="How often a cell in which a boundary could hide is halved.",
)
@click.option(
    "--mesh-error",
    type=float,
    default=3e-4,
    show_default=True,
    help="What the map's mesh may shift a boundary by, relatively.",
)
@click.option("--step", type=float, default=0.035, show_default=True, help="Longest step, as a share of the window.")
@click.option("--tol", type=float, help="Relative error of each boundary point; 1e-6 unless set.")
@click.option(
    "--max-mesh", type=click.IntRange(64, 8192), default=512, show_default=True, help="Intervals of the finest mesh."
)
@worker_options
@output_options
def command(
    system: SystemOptions,
    eps: str | None,
    V: str | None,
    W0: str | None,
    over: tuple[Range, ...],
    boundary: str | None,
    boundaries: bool,
    criticality: bool,
    depth: int,
    mesh_error: float,
    step: float,
    tol: float | None,
    max_mesh: int,
    spread: Spread,
    output: OutputOptions,
) -> None:
    """The stability of the forced sliding state over a plane of two parameters.

    The leading Floquet exponent at every point of a grid, refined where a boundary could hide; every sign change is
    followed as a curve, islands included, and polished until its error is met. Text lists the components and their special
    points; CSV and JSON hold the grid.
    """
    from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
    from srfcli.errors import SrfError
    from srfcli.numerics.atlas import AtlasSettings
    from srfcli.numerics.continuation import StepSettings
    from srfcli.numerics.map import compute_map
    from srfcli.numerics.mapgrid import MapSettings

    if not 1e-4 <= step <= 0.5 or not 1e-8 <= mesh_error <= 0.1:
        raise SrfError(
            f"--step {step:g} or --mesh-error {mesh_error:g} is out of range", "--step 0.035 --mesh-error 3e-4"
        )
    if boundary is not None and not boundaries:
        raise SrfError("--boundary needs the boundaries that --no-boundaries leaves out", "Drop one of the two.")
    place = None if boundary is None else _boundary_output(boundary, output)
    model = system.model()
    resolved, grid = _resolved_grid(system, model, over, {"eps": eps, "V": V, "W0": W0})
    settings = AtlasSettings(tol=system.tolerance(tol).value, max_mesh=max_mesh, steps=StepSettings(largest=step))
    warn_uncompiled("a map takes about twice as long")
    begun = time.perf_counter()
    with Progress("map") as progress:

        def tiles(done: int, count: int) -> None:
            progress.total, progress.done = count, done
            progress.advance(0, note="tiles")

        found = compute_map(
            model,
            grid,
            MapSettings(mesh_error=mesh_error, depth=depth),
            run=spread.run,
            progress=tiles,
        )
        progress.total = None
        mapped = time.perf_counter() - begun
        boundaries &= found.finished
        atlas, special, cubic = _boundaries(model, found, settings, (boundaries, criticality), progress)
    timings = {"map": mapped, "boundaries": time.perf_counter() - begun - mapped}
    shown = _tables(model, found, (atlas, special, cubic), boundaries, resolved)
    grid_rows, components, marks, points, status = shown
    text = output.format == "text" and boundaries
    figure = functools.partial(
        map_figure,
        model,
        found,
        atlas,
        special,
        cubic,
        titled(model.title, {k: v for k, v in grid_rows.parameters.items() if k != "eps"}),
    )
    more = (marks,) if text and marks.rows else ()
    emit(components if text else grid_rows, output, more=more, laws=model.laws, timings=timings, figure=figure)
    if place is not None:
        emit(points, place, laws=model.laws, timings=timings)
    finish(status)


def _resolved_grid(
    system: SystemOptions, model: GeneratedModel, over: tuple[Range, ...], given: dict[str, str | None]
) -> tuple[Resolved, MapGrid]:
    """Return the parameters and the grid; raises SrfError where an axis has a value too."""
    from srfcli.cli.map_axes import read_grid
    from srfcli.errors import SrfError

    swept = {name for r in over for name in r.name.split("/")}
    for name, value in given.items():
        if value is not None and name in swept:
            raise SrfError(
                f"{name} is an axis and has a value too", f"Leave out --{name}, or take {name} out of --over."
            )
    resolved = system.resolve(model.parameters, **given)
    return resolved, read_grid(model, model.vector(resolved.values), over)


def _tables(
    model: GeneratedModel,
    found: StabilityMap,
    curves: tuple[Atlas, list[list[SpecialPoint]], list[Array]],
    boundaries: bool,
    resolved: Resolved,
) -> tuple[Table, Table, Table, Table, Status]:
    """Return the grid, the components, the special points and the boundaries' points as tables, and the status of all."""
    atlas, special, cubic = curves
    notes, meta, status = _summary(model, found, atlas, special, boundaries)
    moved = {found.grid.x.moved, found.grid.y.moved}
    described = {k: v for k, v in resolved.described().items() if k not in moved}
    common: dict[str, Any] = {"title": model.title, "notes": notes, "parameters": described, "status": status.value}
    components, marks = components_table(model, found, atlas, special, **common), special_table(model, found, special)
    tables = {"components": _plain(components), "special": _plain(marks)}
    whole = replace(grid_table(model, found, **common), meta={**meta, **tables})
    return whole, components, marks, _points_table(model, atlas, cubic, common), status


def _boundary_output(boundary: str, output: OutputOptions) -> OutputOptions:
    """Return where the boundary's points go, checked now."""
    from srfcli.errors import SrfError

    if boundary == "-" or Path(boundary).suffix.lower() not in (".csv", ".json"):
        raise SrfError(f"--boundary {boundary} ends in neither .csv nor .json", "--boundary boundary.csv")
    place = read_output(out=boundary, force=output.force, provenance=output.provenance)
    if output.out is not None and place.out is not None and output.out.resolve() == place.out.resolve():
        raise SrfError(f"--out and --boundary are the same file, {boundary}", "Give them different names.")
    return place


def _boundaries(
    model: GeneratedModel, found: StabilityMap, settings: Any, wanted: tuple[bool, bool], progress: Any
) -> tuple[Atlas, list[list[SpecialPoint]], list[Array]]:
    """Return the components, the special points of each, and the cubic coefficient at each point (NaN unless wanted)."""
    import numpy as np

    from srfcli.numerics.atlas import Atlas
    from srfcli.numerics.mapcurves import find_boundaries
    from srfcli.numerics.neimark import branch_coefficients, criticality_points
    from srfcli.numerics.special import special_points

    if not wanted[0]:
        return Atlas(found.grid.plane(model), [], [], []), [], []
    *_, atlas = find_boundaries(
        model, found, settings, progress=lambda said: progress.advance(0, note=f"boundaries: {said}")
    )
    special: list[list[SpecialPoint]] = [[] for _ in atlas.branches]
    cubic = [np.full(len(b.points), np.nan) for b in atlas.branches]
    try:
        for k, branch in enumerate(atlas.branches):
            progress.advance(0, note=f"special points of boundary {k + 1}")
            special[k] = special_points(model, atlas.plane, branch)
        for k, branch in enumerate(atlas.branches if wanted[1] else []):
            progress.advance(0, note=f"criticality of boundary {k + 1}")
            cubic[k] = branch_coefficients(model, branch)
            changes = criticality_points(model, atlas.plane, branch, cubic[k])
            special[k] = sorted([*special[k], *changes], key=lambda s: s.place)
    except KeyboardInterrupt:
        atlas.status = Status.INTERRUPTED
        atlas.notes.append("interrupted: special points and criticality are not complete")
    return atlas, special, cubic


def _summary(
    model: GeneratedModel, found: StabilityMap, atlas: Atlas, special: list[list[SpecialPoint]], wanted: bool
) -> tuple[tuple[str, ...], dict[str, Any], Status]:
    """Return the notes, what JSON holds beside the rows, and the status of the whole."""
    from srfcli.numerics.map import KINDS
    from srfcli.numerics.mapcurves import map_notes, unexplained
    from srfcli.numerics.special import crossings_at

    count = found.kind.size
    share = {name: float((found.kind == k).sum() / count) for k, name in enumerate(KINDS)}
    meta: dict[str, Any] = {"share": share, "suspect_cells": len(found.suspect), "points_added": len(found.extra_at)}
    status = Status.NO_CONVERGENCE if found.lost else Status.OK
    if not found.finished:
        left = "interrupted: what was not reached is unresolved, and no boundary was followed"
        return (left, *map_notes(found)), meta, Status.INTERRUPTED
    if not wanted:
        return tuple(map_notes(found)), meta, status
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
    return (*notes, *atlas.notes), meta, atlas.status if stopped or status.ok else status


def _plain(table: Table) -> list[dict[str, Any]]:
    names = [c.name for c in table.columns]
    return [dict(zip(names, row, strict=True)) for row in table.rows]


def _points_table(model: GeneratedModel, atlas: Atlas, cubic: list[Array], common: dict[str, Any]) -> Table:
    """Return the polished points of all components, as `srf continue` lists them, with the cubic coefficient."""
    from srfcli.cli.boundary_rows import COLUMNS, boundary_row
    from srfcli.numerics.atlas import crossing_numbers
    from srfcli.output.tables import Column, Table

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
