"""`srf floquet`: one forced periodic state in full."""

from __future__ import annotations

import time

import click

from srfcli.cli.base import SrfCommand
from srfcli.cli.options import OutputOptions, SystemOptions, output_options, stability_options

EXAMPLES = """
srf floquet --V 8 --W0 9 --eps 0.09
srf floquet --V 50 --W0 15 --eps 0.18 --plot orbit.svg
srf floquet --V 8 --W0 9 --eps 0.09 --json --tol 1e-9
"""


@click.command("floquet", cls=SrfCommand, epilog=EXAMPLES)
@stability_options
@click.option("--V", "V", metavar="VALUE", help="Driving velocity, in um/s.")
@click.option("--W0", "W0", metavar="VALUE", help="Mean normal load, in N.")
@click.option("--eps", "eps", metavar="VALUE", help="Relative amplitude of the load modulation.")
@click.option("--tol", type=float, help="Error of the multipliers; 1e-6 unless set.")
@click.option(
    "--max-mesh", type=click.IntRange(32, 65536), default=1024, show_default=True, help="Intervals of the finest mesh."
)
@click.option(
    "--harmonics", type=click.IntRange(1, 200), default=5, show_default=True, help="Harmonics of u and mu to list."
)
@click.option("--fail-on", type=click.Choice(["unstable", "stable"]), help="Exit with 4 when the state is so.")
@output_options
def command(
    system: SystemOptions,
    V: str | None,
    W0: str | None,
    eps: str | None,
    tol: float | None,
    max_mesh: int,
    harmonics: int,
    fail_on: str | None,
    output: OutputOptions,
) -> int:
    """The forced periodic state at one V, W0 and eps: multipliers, mean friction, harmonics.

    The mesh is doubled until the estimated error of the multipliers is below --tol. The state is stable where all
    multipliers lie inside the unit circle; the mean friction is set beside that of steady sliding at eps = 0.
    """
    from srfcli.cli.base import EXIT_CONDITION, EXIT_OK
    from srfcli.cli.emit import emit, finish
    from srfcli.tasks.stability import floquet

    slider = system.slider(V=V, W0=W0, eps=eps)
    system.say_defaults(slider.resolved, ("V", "W0", "eps"))
    tolerance, begun = system.tolerance(tol).value, time.perf_counter()
    found = floquet(slider, tol=tolerance, max_mesh=max_mesh, harmonics=harmonics)
    timings = {"solve": time.perf_counter() - begun}
    emit(found.table, output, laws=slider.model.laws, timings=timings, figure=found.plot)
    if not found.status.ok:
        finish(found.status)
    return EXIT_CONDITION if fail_on == ("stable" if found.stable else "unstable") else EXIT_OK
