"""`srf critical`: every critical load at given velocities and modulation amplitudes."""

from __future__ import annotations

import time

import click

from srfcli.cli.base import SrfCommand
from srfcli.cli.options import (
    OutputOptions,
    Range,
    SystemOptions,
    output_options,
    parse_over,
    stability_options,
    values_option,
)
from srfcli.core.settings import Parameter

EXAMPLES = """
srf critical --eps 0.13 --V 1,7,25
srf critical --eps 0,0.045,0.09 --V 1,2,5,10,20,50 --csv
srf critical --eps 0.4 --V 40 --window 4:500
"""
VELOCITY = Parameter("V", 10.0, "um/s", 1e-12, 1e9, "driving velocities")
AMPLITUDE = Parameter("eps", 0.0, "1", 0.0, 0.999999, "relative modulation amplitudes")


@click.command("critical", cls=SrfCommand, epilog=EXAMPLES)
@stability_options
@values_option(VELOCITY)
@values_option(AMPLITUDE)
@click.option(
    "--window",
    metavar="LOW:HIGH",
    help="Loads to look between, in N; else all at which a crossing can be.",
)
@click.option("--tol", type=float, help="Relative error of a critical load.", default=1e-8, show_default=True)
@click.option(
    "--samples",
    type=click.IntRange(8, 100_000),
    default=192,
    show_default=True,
    help="Loads looked at first, on each line.",
)
@click.option(
    "--resolution",
    type=float,
    default=1e-3,
    show_default=True,
    help="Finest spacing in ln W0 where a pair of crossings could hide.",
)
@click.option(
    "--max-mesh", type=click.IntRange(32, 8192), default=512, show_default=True, help="Intervals of the finest mesh."
)
@output_options
def command(
    system: SystemOptions,
    V: tuple[float, ...] | None,
    eps: tuple[float, ...] | None,
    window: str | None,
    tol: float,
    samples: int,
    resolution: float,
    max_mesh: int,
    output: OutputOptions,
) -> None:
    """Every critical load at the given velocities, numbered from low W0.

    The growth rate is sampled along W0, refined where a pair of crossings could hide, and each sign change is polished on
    meshes that are doubled until the error is met. Odd crossings lose stability as W0 rises, even ones regain it.
    """
    from srfcli.cli.emit import Progress, emit, finish
    from srfcli.tasks.stability import critical

    slider = system.slider()
    limits = None if window is None else _window(window).fitted(slider.model.parameters, where=slider.model.title)
    begun = time.perf_counter()
    with Progress("critical", total=len(V or (None,)) * len(eps or (None,))) as progress:
        found = critical(
            slider, V=V, eps=eps, window=None if limits is None else (limits.lo, limits.hi), tol=tol, samples=samples,
            resolution=resolution, max_mesh=max_mesh, progress=lambda place: progress.advance(note=place),
        )  # fmt: skip
    timings = {"solve": time.perf_counter() - begun}
    emit(found.table, output, laws=slider.model.laws, timings=timings, figure=found.plot)
    finish(found.status)


def _window(text: str) -> Range:
    """Return the loads that LOW:HIGH spans, with or without a unit; raises SrfError that shows the form."""
    from srfcli.core.errors import SrfError

    try:
        found = parse_over(f"W0={text}") if text.count(":") == 1 else None
    except SrfError:
        found = None
    if found is None or not found.lo > 0:
        raise SrfError(f"--window {text!r} is not LOW:HIGH, two rising loads above 0", "Write --window 4:500.")
    return found
