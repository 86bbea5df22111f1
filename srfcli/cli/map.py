"""`srf map`: the stability of the forced sliding state over a plane of two parameters, with every boundary on it."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from srfcli.cli.base import SrfCommand
from srfcli.cli.options import (
    OutputOptions,
    Range,
    Spread,
    SystemOptions,
    output_options,
    over_option,
    parse_over,
    read_output,
    stability_options,
    worker_options,
)
from srfcli.core.errors import SrfError
from srfcli.results.map import ratio_powers, unit_text

if TYPE_CHECKING:
    from srfcli.codegen.model import Array, GeneratedModel
    from srfcli.codegen.slider import SlidingSystem
    from srfcli.numerics.plane import MapAxis, MapGrid

# `srf map`: the stability of the forced sliding state over a plane of two parameters, with every boundary on it.

EXAMPLES = """
srf map --eps 0.18 --over V=1:100:120 --over K/W0=0.005:0.03:200 --plot map.svg
srf map --eps 0.18 --out map.csv --boundary boundary.csv
srf map --V 7 --over eps=0.01:0.4:80 --over K/W0=0.005:0.03:100
srf map --eps 0.4 --workers 8 --resume parts --out map.csv
"""


@click.command("map", cls=SrfCommand, epilog=EXAMPLES)
@stability_options
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
    from srfcli.core.errors import SrfError
    from srfcli.numerics.continuation import AtlasSettings, StepSettings
    from srfcli.numerics.plane import MapSettings
    from srfcli.tasks import map as task

    if not 1e-4 <= step <= 0.5 or not 1e-8 <= mesh_error <= 0.1:
        raise SrfError(
            f"--step {step:g} or --mesh-error {mesh_error:g} is out of range", "--step 0.035 --mesh-error 3e-4"
        )
    if boundary is not None and not boundaries:
        raise SrfError("--boundary needs the boundaries that --no-boundaries leaves out", "Drop one of the two.")
    place = None if boundary is None else _boundary_output(boundary, output)
    slider, grid = _slider_grid(system, over, {"eps": eps, "V": V, "W0": W0})
    settings = AtlasSettings(tol=system.tolerance(tol).value, max_mesh=max_mesh, steps=StepSettings(largest=step))
    warn_uncompiled("a map takes about three times as long")
    begun, mapped = time.perf_counter(), 0.0
    with Progress("map") as progress:

        def tiles(done: int, count: int) -> None:
            nonlocal mapped
            mapped = time.perf_counter() - begun
            progress.total, progress.done = count, done
            progress.advance(0, note="tiles")

        def then(said: str) -> None:
            progress.total = None
            progress.advance(0, note=said)

        found = task.map(
            slider, x=grid.x, y=grid.y, grid=MapSettings(mesh_error=mesh_error, depth=depth), curves=settings,
            boundaries=boundaries, criticality=criticality, run=spread.run, tiles=tiles, progress=then,
        )  # fmt: skip
    timings = {"map": mapped, "boundaries": time.perf_counter() - begun - mapped}
    text, laws = output.format == "text" and found.followed, slider.model.laws
    more = (found.special_points,) if text and found.special_points.rows else ()
    emit(found.components if text else found.table, output, more=more, laws=laws, timings=timings, figure=found.plot)
    if place is not None:
        emit(found.boundary, place, laws=laws, timings=timings)
    finish(found.status)


def _slider_grid(
    system: SystemOptions, over: tuple[Range, ...], given: dict[str, str | None]
) -> tuple[SlidingSystem, MapGrid]:
    """Return the system and the grid; raises SrfError where an axis has a value too."""
    from srfcli.core.errors import SrfError

    swept = {name for r in over for name in r.name.split("/")}
    for name, value in given.items():
        if value is not None and name in swept:
            raise SrfError(
                f"{name} is an axis and has a value too", f"Leave out --{name}, or take {name} out of --over."
            )
    slider = system.slider(**given)
    slider.model.check_changing_load(slider.vector())
    return slider, read_grid(slider.model, slider.model.vector(slider.resolved.values), over)


def _boundary_output(boundary: str, output: OutputOptions) -> OutputOptions:
    """Return where the boundary's points go, checked now."""
    from srfcli.core.errors import SrfError

    if boundary == "-" or Path(boundary).suffix.lower() not in (".csv", ".json"):
        raise SrfError(f"--boundary {boundary} ends in neither .csv nor .json", "--boundary boundary.csv")
    place = read_output(out=boundary, force=output.force, provenance=output.provenance)
    if output.out is not None and place.out is not None and output.out.resolve() == place.out.resolve():
        raise SrfError(f"--out and --boundary are the same file, {boundary}", "Give them different names.")
    return place


# The axes of a map from the command line: parameters, or ratios of two such as K/W0.

COLUMNS, ROWS = 80, 120  # points of an axis for which none were given


def read_grid(model: GeneratedModel, base: Array, over: tuple[Range, ...]) -> MapGrid:
    """Return the grid that `over` spans; V from 1 to 100 um/s and a window of K/W0 stand in for an axis not given.

    Raises SrfError for more than two axes, for lists of values, and for what is no parameter of the model.
    """
    from srfcli.numerics.plane import MapGrid, check_grid

    if len(over) > 2:
        raise SrfError(
            f"--over is given {len(over)} times", "A map has two axes: --over V=1:100:120 --over K/W0=0.005:0.03:200."
        )
    ranges = over or (replace(parse_over("V=1:100"), n=COLUMNS),)
    axes = [read_axis(model, r) for r in ranges]
    if len(axes) == 1:
        axes.append(_load_axis(model, base, axes[0]))
    grid = MapGrid(base, axes[0], axes[1])
    check_grid(model, grid)
    return grid


def read_axis(model: GeneratedModel, given: Range) -> MapAxis:
    """Return the axis that a range describes, in um, s, N."""
    from srfcli.core.units import to_base
    from srfcli.numerics.plane import MapAxis

    if given.values is not None:
        hint = f"An axis runs from a low to a high end: --over {given.name}=1:100:60."
        raise SrfError(f"--over {given.name} lists values", hint)
    log = given.spacing == "log"
    if "/" not in given.name:
        fitted = given.fitted(model.parameters, where=model.title)
        lo, hi = to_base(fitted.lo, fitted.unit), to_base(fitted.hi, fitted.unit)
        return MapAxis(given.name, lo, hi, given.n, log)
    held, moved = given.name.split("/")
    factor = _ratio_factor(model, given, held, moved)
    return MapAxis(moved, given.lo * factor, given.hi * factor, given.n, log, held)


def _ratio_factor(model: GeneratedModel, given: Range, held: str, moved: str) -> float:
    """Return what a ratio's numbers are multiplied with: they are in um, s, N unless a unit is written."""
    from srfcli.core.units import find_unit

    powers = ratio_powers(model, held, moved)
    if not given.unit:
        return 1.0
    unit = find_unit(given.unit, where=f"--over {given.name}")
    if unit.powers != powers:
        raise SrfError(
            f"--over {given.name}: {given.unit!r} is the wrong unit",
            f"Write it in {unit_text(powers)}, or leave it out.",
        )
    return unit.factor


def _load_axis(model: GeneratedModel, base: Array, x: MapAxis) -> MapAxis:
    """Return K/W0 over the loads at which boundaries are expected along `x`."""
    from srfcli.numerics.critical import found_window
    from srfcli.numerics.plane import MapAxis

    if "W0" in (x.moved, x.held):
        raise SrfError(f"--over {x.name} alone spans no plane", "Add the other axis: --over V=1:100:80.")
    corners = []
    for value in x.samples()[:: max(1, (x.count - 1) // 4)]:
        corner = base.copy()
        corner[model.index(x.moved)] = x.parameter(model, base, value)
        corners.append(corner)
    window = found_window(model, corners)
    lo, hi = window.lo, window.hi
    if "K" in (x.moved, x.held):
        return MapAxis("W0", lo, hi, ROWS)
    K = float(base[model.index("K")])
    return MapAxis("W0", K / hi, K / lo, ROWS, True, "K")
