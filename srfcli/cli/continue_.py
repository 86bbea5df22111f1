"""`srf continue`: stability boundaries under modulation, followed through folds, all components in a window."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import click

from srfcli.cli.base import SrfCommand
from srfcli.cli.options import (
    OutputOptions,
    Range,
    SystemOptions,
    output_options,
    over_option,
    parse_over,
    stability_options,
    values_option,
)
from srfcli.core.settings import Parameter

if TYPE_CHECKING:
    from srfcli.codegen.model import GeneratedModel

EXAMPLES = """
srf continue --eps 0.18 --plot boundary.svg
srf continue --eps 0.18 --eps 0.13 --over V=1:100 --csv
srf continue --V 7 --over eps=0.01:0.4 --over W0=4:100
srf continue --eps 0.09 --law log-log --ageing dieterich+linker-dieterich
"""
AMPLITUDE = Parameter("eps", 0.0, "1", 0.0, 0.999999, "relative modulation amplitudes, a boundary for each")


@click.command("continue", cls=SrfCommand, epilog=EXAMPLES)
@stability_options
@values_option(AMPLITUDE)
@click.option("--V", "V", metavar="VALUE", help="Driving velocity in um/s, where it is not an axis.")
@click.option("--W0", "W0", metavar="VALUE", help="Mean normal load in N, where it is not an axis.")
@over_option(help="The plane: NAME=LOW:HIGH once (against W0) or twice; V=1:100 unless given.")
@click.option(
    "--scan-lines",
    type=click.IntRange(2, 10_000),
    default=10,
    show_default=True,
    help="Lines on which components are looked for.",
)
@click.option(
    "--samples",
    type=click.IntRange(8, 100_000),
    default=64,
    show_default=True,
    help="Points looked at first, on each line.",
)
@click.option("--step", type=float, default=0.035, show_default=True, help="Longest step, as a share of the window.")
@click.option(
    "--max-steps", type=click.IntRange(1, 1_000_000), default=3000, show_default=True, help="Longest curve, each way."
)
@click.option("--tol", type=float, help="Relative error of each point; 1e-6 unless set.")
@click.option(
    "--max-mesh", type=click.IntRange(64, 8192), default=512, show_default=True, help="Intervals of the finest mesh."
)
@output_options
def command(
    system: SystemOptions,
    eps: tuple[float, ...] | None,
    V: str | None,
    W0: str | None,
    over: tuple[Range, ...],
    scan_lines: int,
    samples: int,
    step: float,
    max_steps: int,
    tol: float | None,
    max_mesh: int,
    output: OutputOptions,
) -> None:
    """The stability boundary of the forced sliding state in a plane of two parameters.

    Components are looked for on lines across the window, each is followed by pseudo-arclength continuation through its
    folds, and every point is polished until its error is met. Ctrl-C keeps what is done.
    """
    from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
    from srfcli.core.errors import SrfError
    from srfcli.numerics.continuation import AtlasSettings, StepSettings
    from srfcli.tasks.stability import continue_boundary

    if not 1e-4 <= step <= 0.5:
        raise SrfError(
            f"--step {step:g} is not a share of the window", "Choose it between 0.0001 and 0.5; 0.035 is usual."
        )
    spanned = {r.name for r in over} or {"V"}
    if len(spanned) < 2:
        spanned.add("W0")
    for name, value in (("V", V), ("W0", W0)):
        if value is not None and name in spanned:
            raise SrfError(
                f"{name} is an axis and has a value too", f"Leave out --{name}, or take {name} out of --over."
            )
    slider = system.slider(V=V, W0=W0)
    model = slider.model
    settings = AtlasSettings(
        scan_lines, samples, tol=system.tolerance(tol).value, max_mesh=max_mesh,
        steps=StepSettings(largest=step, max_steps=max_steps),
    )  # fmt: skip
    if len(over) > 2:
        raise SrfError(f"--over is given {len(over)} times", "A plane has two axes: --over V=1:100 --over W0=4:400.")
    ranges = [_axis(model, r) for r in over or (parse_over("V=1:100"),)]
    with Progress("continue") as progress:
        growing = continue_boundary(
            slider, eps=eps, over={r.name: (r.lo, r.hi) for r in ranges},
            log=[r.name for r in ranges if r.spacing == "log"], settings=settings,
            progress=lambda said: progress.advance(0, note=said),
        )  # fmt: skip
        warn_uncompiled("boundaries take about three times as long")
        system.say_defaults(slider.resolved, {"V", "W0"} - spanned)
        begun = time.perf_counter()
        *_, found = growing
    timings = {"solve": time.perf_counter() - begun}
    emit(found.table, output, laws=model.laws, timings=timings, figure=found.plot)
    finish(found.status)


def _axis(model: GeneratedModel, given: Range) -> Range:
    from srfcli.core.errors import SrfError

    fitted = given.fitted(model.parameters, where=model.title)
    if fitted.values:
        raise SrfError(
            f"--over {given.name} lists values", f"An axis runs from a low to a high end: --over {given.name}=1:100."
        )
    return fitted
