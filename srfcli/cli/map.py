"""`srf map`: the stability of the forced sliding state over a plane of two parameters, with every boundary on it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

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

if TYPE_CHECKING:
    from srfcli.numerics.mapgrid import MapGrid
    from srfcli.tasks.system import SlidingSystem

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
    from srfcli.numerics.mapgrid import MapSettings
    from srfcli.tasks.map import map_grid

    if not 1e-4 <= step <= 0.5 or not 1e-8 <= mesh_error <= 0.1:
        raise SrfError(
            f"--step {step:g} or --mesh-error {mesh_error:g} is out of range", "--step 0.035 --mesh-error 3e-4"
        )
    if boundary is not None and not boundaries:
        raise SrfError("--boundary needs the boundaries that --no-boundaries leaves out", "Drop one of the two.")
    place = None if boundary is None else _boundary_output(boundary, output)
    slider, grid = _slider_grid(system, over, {"eps": eps, "V": V, "W0": W0})
    settings = AtlasSettings(tol=system.tolerance(tol).value, max_mesh=max_mesh, steps=StepSettings(largest=step))
    warn_uncompiled("a map takes about twice as long")
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

        found = map_grid(
            slider, grid, grid=MapSettings(mesh_error=mesh_error, depth=depth), curves=settings, boundaries=boundaries,
            criticality=criticality, run=spread.run, tiles=tiles, progress=then,
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
    from srfcli.cli.map_axes import read_grid
    from srfcli.errors import SrfError

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
    from srfcli.errors import SrfError

    if boundary == "-" or Path(boundary).suffix.lower() not in (".csv", ".json"):
        raise SrfError(f"--boundary {boundary} ends in neither .csv nor .json", "--boundary boundary.csv")
    place = read_output(out=boundary, force=output.force, provenance=output.provenance)
    if output.out is not None and place.out is not None and output.out.resolve() == place.out.resolve():
        raise SrfError(f"--out and --boundary are the same file, {boundary}", "Give them different names.")
    return place
