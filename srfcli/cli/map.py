"""`srf map` and `srf compare`: stability over a plane of two parameters, with every boundary on it; laws side by side."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli import options
from srfcli.cli.base import SrfCommand
from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.settings import Setting, resolve
from srfcli.core.units import describe, find_unit, parse_quantity, to_base

if TYPE_CHECKING:
    from srfcli.codegen.model import Array, GeneratedModel
    from srfcli.codegen.slider import SlidingSystem
    from srfcli.numerics.plane import MapAxis

# `srf map`: the stability of the forced sliding state over a plane of two parameters.

MAP = """
srf map --eps 0.18 --over V=1:100:120 --over K/W0=0.005:0.03:200 --plot map.svg
srf map --eps 0.18 --out map.csv --boundary boundary.csv
srf map --V 7 --over eps=0.01:0.4:80 --over K/W0=0.005:0.03:100
srf map --eps 0.4 --workers 8 --resume parts --out map.csv
"""


@click.command("map", cls=SrfCommand, epilog=MAP)
@options.options_with_effects
@options.value_option("eps", "Relative modulation amplitude, where it is not an axis.")
@options.value_option("V", "Driving velocity in um/s, where it is not an axis.")
@options.value_option("W0", "Mean normal load in N, where it is not an axis.")
@options.over_option(
    help="An axis, twice: NAME=LOW:HIGH:POINTS[:log|lin]; NAME may be a ratio, as K/W0, whose second part moves."
)
@click.option("--boundary", metavar="FILE", help="Write the polished points of the boundaries to FILE (.csv or .json).")
@click.option("--boundaries/--no-boundaries", default=True, help="Whether boundaries are followed.")
@click.option("--criticality/--no-criticality", default=True, help="Whether the normal form tells sub- from supercritical.")
@click.option("--depth", type=click.IntRange(0, 10), default=4, help="Halvings of a cell that may contain a boundary.")
@click.option("--mesh-error", default=3e-4, help="Largest relative shift of a boundary by an orbit's mesh.")
@options.step_option
@click.option("--tol", type=float, help="Relative error of each boundary point; 1e-6 unless set.")
@options.mesh_option(least=64)
@options.worker_options
@options.output_options
def map_(
    system: options.SystemOptions,
    over: tuple[options.Range, ...],
    boundary: str | None,
    boundaries: bool,
    criticality: bool,
    depth: int,
    mesh_error: float,
    step: float,
    tol: float | None,
    max_mesh: int,
    spread: options.Spread,
    output: options.OutputOptions,
    **given: str | None,
) -> None:
    """The stability of the forced sliding state over a plane of two parameters.

    The leading Floquet exponent at every point of a grid, refined where a boundary could hide; every sign change is
    followed as a curve, islands included, and polished until its error is met. Text lists the components and their special
    points; CSV and JSON hold the grid.
    """
    from srfcli.numerics.continuation import ContinuationSettings, StepSettings
    from srfcli.numerics.plane import MapSettings
    from srfcli.tasks import map as task

    if not 1e-4 <= step <= 0.5 or not 1e-8 <= mesh_error <= 0.1:
        raise SrfError(f"--step {step:g} or --mesh-error {mesh_error:g} is out of range", "--step 0.035 --mesh-error 3e-4")
    if boundary is not None and not boundaries:
        raise SrfError("--boundary needs the boundaries that --no-boundaries leaves out", "Drop one of the two.")
    place = None if boundary is None else _boundary_output(boundary, output)
    options.check_axes({name for r in over for name in r.name.split("/")}, given)
    slider = system.slider(**given)
    slider.model.check_changing_load(slider.vector())
    x, y = read_axes(slider.model, slider.vector(), over)
    settings = ContinuationSettings(tol=system.tolerance(tol).value, max_mesh=max_mesh, steps=StepSettings(largest=step))
    warn_uncompiled("a map takes about three times as long")
    mapped = 0.0
    with Progress("map") as progress:

        def tiles(done: int, count: int) -> None:
            nonlocal mapped
            mapped = progress.seconds
            progress.total, progress.done = count, done
            progress.advance(0, note="tiles")

        def then(said: str) -> None:
            progress.total = None
            progress.advance(0, note=said)

        found = task.map(
            slider, x=x, y=y, grid=MapSettings(mesh_error=mesh_error, depth=depth), curves=settings,
            boundaries=boundaries, criticality=criticality, run=spread.run, tiles=tiles, progress=then,
        )  # fmt: skip
    timings = {"map": mapped, "boundaries": progress.seconds - mapped}
    text, laws = output.format == "text" and found.followed, slider.model.laws
    more = (found.special_points,) if text and found.special_points.rows else ()
    emit(found.components if text else found.table, output, more=more, laws=laws, timings=timings, figure=found.plot)
    if place is not None:
        emit(found.boundary, place, laws=laws, timings=timings)
    finish(found.status)


def _boundary_output(boundary: str, output: options.OutputOptions) -> options.OutputOptions:
    """Return where the boundary's points go, checked now."""
    if boundary == "-" or Path(boundary).suffix.lower() not in (".csv", ".json"):
        raise SrfError(f"--boundary {boundary} ends in neither .csv nor .json", "--boundary boundary.csv")
    place = options.read_output(out=boundary, force=output.force, provenance=output.provenance)
    if output.out is not None and place.out is not None and output.out.resolve() == place.out.resolve():
        raise SrfError(f"--out and --boundary are the same file, {boundary}", "Give them different names.")
    return place


# The axes of a map: parameters, or ratios of two such as K/W0.

DEFAULT_COLUMNS, DEFAULT_ROWS = 80, 120  # points of an axis for which none were given


def read_axes(model: GeneratedModel, base: Array, over: tuple[options.Range, ...]) -> tuple[MapAxis, MapAxis]:
    """Return the axes that `over` describes; V from 1 to 100 um/s and a window of K/W0 stand in for an axis not given.

    Raises SrfError for more than two axes, for lists of values, and for what is no parameter of the model.
    """
    if len(over) > 2:
        raise SrfError(f"--over is given {len(over)} times", "A map has two axes: --over V=1:100:120 --over K/W0=0.005:0.03:200.")
    ranges = over or (replace(options.parse_over("V=1:100"), n=DEFAULT_COLUMNS),)
    x, *others = [read_axis(model, r) for r in ranges]
    return x, others[0] if others else _load_axis(model, base, x)


def read_axis(model: GeneratedModel, given: options.Range) -> MapAxis:
    """Return the axis that a range describes, in um, s, N."""
    from srfcli.numerics.plane import MapAxis
    from srfcli.results.map import ratio_powers

    given.check_ends()
    log = given.spacing == "log"
    if "/" not in given.name:
        fitted = given.fitted(model.parameters, where=model.title)
        lo, hi = to_base(fitted.lo, fitted.unit), to_base(fitted.hi, fitted.unit)
        return MapAxis(given.name, lo, hi, given.n, log)
    held, moved = given.name.split("/")
    powers, factor = ratio_powers(model, held, moved), 1.0  # the numbers are in um, s, N unless a unit is written
    if given.unit:
        unit = find_unit(given.unit, where=f"--over {given.name}")
        if unit.powers != powers:
            hint = f"Write it in {describe(powers)}, or leave it out."
            raise SrfError(f"--over {given.name}: {given.unit!r} is the wrong unit", hint)
        factor = unit.factor
    return MapAxis(moved, given.lo * factor, given.hi * factor, given.n, log, held)


def _load_axis(model: GeneratedModel, base: Array, x: MapAxis) -> MapAxis:
    """Return K/W0 over the loads at which boundaries are expected along `x`."""
    from srfcli.numerics.critical import found_window
    from srfcli.numerics.plane import MapAxis

    if "W0" in (x.moved, x.held):
        raise SrfError(f"--over {x.name} alone spans no plane", "Add the other axis: --over V=1:100:80.")
    values = x.parameter(model, base, x.samples()[:: max(1, (x.count - 1) // 4)])
    window = found_window(model, [model.with_values(base, **{x.moved: value}) for value in values])
    lo, hi = window.lo, window.hi
    if "K" in (x.moved, x.held):
        return MapAxis("W0", lo, hi, DEFAULT_ROWS)
    K = float(base[model.index("K")])
    return MapAxis("W0", K / hi, K / lo, DEFAULT_ROWS, True, "K")


# `srf compare`: the stability diagrams of several laws, each brought to the same observables at one low velocity.

COMPARE = """
srf compare --law srf-vsat --law log-log --law bowden-tabor --eps 0.18 --plot laws.svg
srf compare --ageing dieterich --ageing ruina --ageing dieterich+linker-dieterich --eps 0.09,0.18
srf compare --law srf-vsat --law log-log --eps 0.18 --workers 2 --json
"""
COMPARED_OPTIONS: options.Options = {  # those of `system_options`, but that several laws may be named
    "laws": click.option("--law", "laws", multiple=True, metavar="NAME", help="A friction law; repeat for more."),
    "ageings": click.option("--ageing", "ageings", multiple=True, metavar="NAME", help="An ageing law; repeat: all pairs count."),
    "interface": options.SYSTEM_OPTIONS["interface"],
    "loading": options.SYSTEM_OPTIONS["loading"],
    **options.APPARATUS_OPTIONS,
    "assignments": click.option(
        "--set", "assignments", multiple=True, metavar="NAME=VALUE", help="Set a parameter of every law that has it."
    ),
    "plugins": options.SYSTEM_OPTIONS["plugins"],
}


@click.command("compare", cls=SrfCommand, epilog=COMPARE)
@options.add_options(COMPARED_OPTIONS)
@options.values_option(options.AMPLITUDE, default=(0.18,))
@click.option("--at", default="10", metavar="V", help="Velocity (um/s) at which the laws are matched.")
@click.option("--adjust", default="A,B,D0", metavar="A,B,D0", help="Three parameters that are adjusted, beside mu0.")
@click.option("--match/--no-match", "matched", default=True, help="Whether parameters are adjusted at all.")
@options.over_option(help="The window: V=LOW:HIGH[:POINTS] and K/W0=LOW:HIGH[:POINTS], each of which may be left out.")
@options.worker_options
@options.output_options
def compare(
    laws: tuple[str, ...],
    ageings: tuple[str, ...],
    eps: tuple[float, ...],
    at: str,
    adjust: str,
    matched: bool,
    over: tuple[options.Range, ...],
    spread: options.Spread,
    output: options.OutputOptions,
    **system: Any,
) -> None:
    """Laws side by side: where re-entrance begins, what modulation destabilises, and where an experiment discriminates
    between them.

    The first law is the reference. Every other one is brought to its friction, slope, critical load and critical period at one
    low velocity, so that what differs is the law and not its calibration.
    """
    from srfcli.tasks import map as tasks

    sliders = _sliders(laws, ageings, system)
    window = _window(next(iter(sliders.values())).model, over)
    warn_uncompiled("boundaries take about three times as long")
    with Progress("compare") as progress:
        found = tasks.compare(
            sliders, eps=eps, at=parse_quantity(at, "um/s", name="--at"), adjust=adjust.split(","), matched=matched,
            **window, run=spread.run, progress=lambda name, share: progress.advance(note=name, share=share),
        )  # fmt: skip
    every = dict.fromkeys(law for slider in sliders.values() for law in slider.model.laws)
    emit(found.table, output, laws=every, timings={"all": progress.seconds}, figure=found.plot)
    finish(found.status)


def _sliders(laws: tuple[str, ...], ageings: tuple[str, ...], taken: dict[str, Any]) -> dict[str, SlidingSystem]:
    """Return a system for every pair of a friction and an ageing law, by a name that tells them apart.

    An assignment counts for the models that have its parameter, and one must.
    """
    from srfcli.codegen.slider import SlidingSystem

    system = options.read_system(law=None, ageing=None, **taken)
    chosen = [[Setting(name, "flag") for name in laws] or [system.chosen["law"]]]
    chosen.append([Setting(name, "flag") for name in ageings] or [system.chosen["ageing"]])
    pairs = {(law.value, ageing.value): {"law": law, "ageing": ageing} for law, ageing in itertools.product(*chosen)}
    openers = [replace(system, chosen={**system.chosen, **pair}).opener() for pair in pairs.values()]
    known = {n for opener in openers for n in opener.model.names}
    for name in system.flags:
        if name not in known:
            raise SrfError(f"unknown parameter {name!r} in all of these laws", did_you_mean(name, known))
    found = {}
    for (law, ageing), opener in zip(pairs, openers, strict=True):
        name = law if len(set(ageings)) < 2 else ageing if len(set(laws)) < 2 else f"{law}/{ageing}"
        model, own = opener.model, {n: v for n, v in system.flags.items() if n in opener.model.names}
        resolved = resolve(model.parameters, own, toml=system.toml, where=model.title)
        found[name] = SlidingSystem(resolved, opener, model.title)
    return found


def _window(model: GeneratedModel, over: tuple[options.Range, ...]) -> dict[str, Any]:
    """Return the window that --over describes, and how many points it has, as the task takes them."""
    parts: dict[str, Any] = {"points": {}}
    for given in over:
        axis = read_axis(model, given)
        if axis.name not in ("V", "K/W0"):
            raise SrfError(f"--over {axis.name} is not an axis of the comparison", "Its plane is V against K/W0.")
        parts["V" if axis.name == "V" else "K_over_W0"] = (axis.lo, axis.hi)
        if given.n != options.DEFAULT_POINTS:
            parts["points"]["columns" if axis.name == "V" else "rows"] = given.n
    return parts
