"""`srf linear`: stability of steady sliding under constant load."""

from __future__ import annotations

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
)

EXAMPLES = """
srf linear                                             V from 1 to 100 um/s
srf linear --over V=1:300:40 --plot hopf.svg
srf linear --law log-log --over D0=0.2:2:20 --set V=10
srf linear --over V=1,10,100 --csv
srf linear --loading inclined --ageing dieterich+linker-dieterich --over angle=-30:30:13:lin
"""


@click.command("linear", cls=SrfCommand, epilog=EXAMPLES)
@stability_options
@over_option(help="Values to run over, V=1:100:60 unless given; repeat for a grid of two parameters.")
@click.option(
    "--all-roots", is_flag=True, help="List every Hopf point, also where stability returns or other roots are unstable."
)
@output_options
def command(system: SystemOptions, over: tuple[Range, ...], all_roots: bool, output: OutputOptions) -> None:
    """Critical load, K/W0 and frequency of steady sliding under constant load.

    From the exact characteristic polynomial: all its Hopf points, with the direction of crossing checked and the first
    Lyapunov coefficient (direct: stick-slip grows from nothing; inverted: it starts with a jump). Beside them stand the
    closed forms for a rigid interface, and for a rigid interface without inertia.
    """
    from srfcli.cli.emit import emit
    from srfcli.tasks.stability import linear

    slider = system.slider()
    ranges = [r.fitted(slider.model.parameters, where=slider.model.title) for r in over or (parse_over("V=1:100:60"),)]
    found = linear(slider, over={r.name: r.points() for r in ranges}, all_roots=all_roots)
    emit(found.table, output, laws=slider.model.laws, figure=found.plot)
