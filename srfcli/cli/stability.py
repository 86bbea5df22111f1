"""`srf linear`, `response`, `critical`, `floquet` and `continue`: sliding under a constant and under a modulated load."""

from __future__ import annotations

from typing import Any

import click

from srfcli.cli import options
from srfcli.cli.base import EXIT_CONDITION, EXIT_OK, SrfCommand
from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
from srfcli.cli.options import OutputOptions, Range, SystemOptions, Values
from srfcli.core.errors import SrfError
from srfcli.core.settings import Parameter

# `srf linear`: steady sliding under constant load.

LINEAR = """
srf linear                                             V from 1 to 100 um/s
srf linear --over V=1:300:40 --plot hopf.svg
srf linear --law log-log --over D0=0.2:2:20 --set V=10
srf linear --over V=1,10,100 --csv
srf linear --loading inclined --ageing dieterich+linker-dieterich --over angle=-30:30:13:lin
"""


@click.command("linear", cls=SrfCommand, epilog=LINEAR)
@options.options_with_effects
@options.over_option(help="Values to run over, V=1:100:60 unless given; repeat for a grid of two parameters.")
@click.option(
    "--all-roots", is_flag=True, help="List every Hopf point, also where stability returns or other roots are unstable."
)
@options.output_options
def linear(system: SystemOptions, over: tuple[Range, ...], all_roots: bool, output: OutputOptions) -> None:
    """Critical load, K/W0 and frequency of steady sliding under constant load.

    From the exact characteristic polynomial: all its Hopf points, with the direction of crossing checked and the first
    Lyapunov coefficient (supercritical: stick-slip grows from nothing; subcritical: it starts with a jump). Beside them stand the
    closed forms for a rigid interface, and for a rigid interface without inertia.
    """
    from srfcli.tasks import stability

    slider = system.slider()
    ranges = [r.fitted(slider.model.parameters, where=slider.model.title) for r in over or (options.parse_over("V=1:100:60"),)]
    found = stability.linear(slider, over={r.name: r.points() for r in ranges}, all_roots=all_roots)
    emit(found.table, output, laws=slider.model.laws, figure=found.plot)


# `srf critical`: every critical load at given velocities and modulation amplitudes.

CRITICAL = """
srf critical --eps 0.13 --V 1,7,25
srf critical --eps 0,0.045,0.09 --V 1,2,5,10,20,50 --csv
srf critical --eps 0.4 --V 40 --window 4:500
"""
VELOCITY = Parameter("V", 10.0, "um/s", 1e-12, 1e9, "driving velocities")


@click.command("critical", cls=SrfCommand, epilog=CRITICAL)
@options.options_with_effects
@options.values_option(VELOCITY)
@options.values_option(options.AMPLITUDE)
@click.option(
    "--window", metavar="LOW:HIGH", help="Range of loads to search, in N.  [default: all loads at which a crossing can occur]"
)
@click.option("--tol", type=float, help="Relative error of a critical load.", default=1e-8)
@click.option(
    "--samples", type=click.IntRange(8, 100_000), default=192, help="Loads of a line at which growth is computed first."
)
@click.option("--resolution", default=1e-3, help="Finest spacing in ln W0 where a pair of crossings could hide.")
@options.mesh_option(least=32)
@options.output_options
def critical(system: SystemOptions, V: Values, eps: Values, window: str | None, output: OutputOptions, **search: Any) -> None:
    """Every critical load at the given velocities, numbered from low W0.

    The growth rate is sampled along W0, refined where a pair of crossings could hide, and each sign change is polished on
    finer meshes until the error is met. Odd crossings lose stability as W0 rises, even ones regain it.
    """
    from srfcli.tasks import stability

    slider = system.slider()
    limits = None
    if window is not None:
        ends = options.parse_ends("W0", window)
        if ends is None or not ends.lo > 0:
            raise SrfError(f"--window {window!r} is not LOW:HIGH, two rising loads above 0", "Write --window 4:500.")
        limits = ends.fitted(slider.model.parameters, where=slider.model.title)
    with Progress("critical", total=len(V or (None,)) * len(eps or (None,))) as progress:
        found = stability.critical(
            slider, V=V, eps=eps, window=None if limits is None else (limits.lo, limits.hi), **search,
            progress=lambda place: progress.advance(note=place),
        )  # fmt: skip
    emit(found.table, output, laws=slider.model.laws, timings={"solve": progress.seconds}, figure=found.plot)
    finish(found.status)


# `srf response`: how sliding follows a modulated load.

RESPONSE = """
srf response --V 10 --W0 6 --over f=1:1000:200 --plot response.svg
srf response --V 10 --W0 6 --over f=1:1000:200 --csv
srf response --V 10 --W0 6 --mean --eps 0.05,0.1,0.2 --over f=20:400:30
"""


@click.command("response", cls=SrfCommand, epilog=RESPONSE)
@options.options_with_effects
@options.value_option("V", "Driving velocity in um/s.")
@options.value_option("W0", "Mean normal load in N.")
@options.values_option(options.AMPLITUDE, about="relative modulation amplitudes, for --mean", configured=False)
@options.over_option(
    default=("f=1:1000:200",), help="The frequencies (Hz), or another parameter: NAME=LOW:HIGH[:POINTS[:log|lin]]."
)
@click.option("--mean", is_flag=True, help="The drop of the mean friction at the amplitudes --eps, from the forced states.")
@click.option("--tol", type=float, help="Relative error of the mean friction; 1e-6 unless set.")
@options.output_options
def response(
    system: SystemOptions,
    V: str | None,
    W0: str | None,
    eps: Values,
    over: tuple[Range, ...],
    mean: bool,
    tol: float | None,
    output: OutputOptions,
) -> None:
    """How sliding follows a modulated normal load W0 (1 + eps cos 2 pi f t).

    To first order in eps: gain and phase of friction, position and slip velocity, and where they resonate. With --mean:
    the reduction of the mean friction force by the modulation, at any amplitude.
    """
    from srfcli.tasks import stability

    if mean and not eps:
        raise SrfError("--mean needs amplitudes", "Give some: --mean --eps 0.05,0.1,0.2.")
    if eps and not mean:
        raise SrfError("--eps has no part in the linear response", "Leave it out, or ask for --mean.")
    slider = system.slider(V=V, W0=W0)
    swept = {r.name: r.fitted(slider.model.parameters, where=slider.model.title).points() for r in over}
    options.check_axes(swept, {"V": V, "W0": W0})
    tolerance = system.tolerance(tol).value
    with Progress("response") as progress:
        found = stability.response(slider, over=swept, eps=eps or None, tol=tolerance)
    system.say_defaults(slider.resolved, {"V", "W0"} - swept.keys())
    emit(found.table, output, laws=slider.model.laws, timings={"solve": progress.seconds}, figure=found.plot)
    finish(found.status)


# `srf floquet`: one forced periodic state in full.

FLOQUET = """
srf floquet --V 8 --W0 9 --eps 0.09
srf floquet --V 50 --W0 15 --eps 0.18 --plot orbit.svg
srf floquet --V 8 --W0 9 --eps 0.09 --json --tol 1e-9
"""


@click.command("floquet", cls=SrfCommand, epilog=FLOQUET)
@options.options_with_effects
@options.value_option("V", "Driving velocity, in um/s.")
@options.value_option("W0", "Mean normal load, in N.")
@options.value_option("eps", "Relative amplitude of the load modulation.")
@click.option("--tol", type=float, help="Error of the multipliers; 1e-6 unless set.")
@options.mesh_option(least=32, most=65536, default=1024)
@click.option("--harmonics", type=click.IntRange(1, 200), default=5, help="Harmonics of u and mu to list.")
@click.option("--fail-on", type=click.Choice(["unstable", "stable"]), help="Exit with code 4 if the state is as named.")
@options.output_options
def floquet(
    system: SystemOptions,
    V: str | None,
    W0: str | None,
    eps: str | None,
    tol: float | None,
    fail_on: str | None,
    output: OutputOptions,
    **settings: Any,
) -> int:
    """The forced periodic state at one V, W0 and eps: multipliers, mean friction, harmonics.

    The mesh is doubled until the estimated error of the multipliers is below --tol. The state is stable where all
    multipliers lie inside the unit circle; the mean friction is set beside that of steady sliding at eps = 0.
    """
    from srfcli.tasks import stability

    slider = system.slider(V=V, W0=W0, eps=eps)
    system.say_defaults(slider.resolved, ("V", "W0", "eps"))
    tolerance = system.tolerance(tol).value
    with Progress("floquet") as progress:
        found = stability.floquet(slider, tol=tolerance, **settings)
    emit(found.table, output, laws=slider.model.laws, timings={"solve": progress.seconds}, figure=found.plot)
    if not found.status.ok:
        finish(found.status)
    return EXIT_CONDITION if fail_on == ("stable" if found.stable else "unstable") else EXIT_OK


# `srf continue`: stability boundaries under modulation, followed through folds, all components in a window.

CONTINUE = """
srf continue --eps 0.18 --plot boundary.svg
srf continue --eps 0.18 --eps 0.13 --over V=1:100 --csv
srf continue --V 7 --over eps=0.01:0.4 --over W0=4:100
srf continue --eps 0.09 --law log-log --ageing dieterich+linker-dieterich
"""


@click.command("continue", cls=SrfCommand, epilog=CONTINUE)
@options.options_with_effects
@options.values_option(options.AMPLITUDE, about="relative modulation amplitudes, a boundary for each")
@options.value_option("V", "Driving velocity in um/s, where it is not an axis.")
@options.value_option("W0", "Mean normal load in N, where it is not an axis.")
@options.over_option(help="The plane: NAME=LOW:HIGH once (against W0) or twice; V=1:100 unless given.")
@click.option(
    "--scan-lines", "lines", type=click.IntRange(2, 10_000), default=10, help="Lines on which components are looked for."
)
@click.option(
    "--samples", type=click.IntRange(8, 100_000), default=64, help="Points of a line at which growth is computed first."
)
@options.step_option
@click.option("--max-steps", type=click.IntRange(1, 1_000_000), default=3000, help="Most steps along a curve, in each direction.")
@click.option("--tol", type=float, help="Relative error of each point; 1e-6 unless set.")
@options.mesh_option(least=64)
@options.output_options
def continue_(
    system: SystemOptions,
    eps: Values,
    V: str | None,
    W0: str | None,
    over: tuple[Range, ...],
    step: float,
    max_steps: int,
    tol: float | None,
    output: OutputOptions,
    **search: Any,
) -> None:
    """The stability boundary of the forced sliding state in a plane of two parameters.

    Components are looked for on lines across the window, each is followed by pseudo-arclength continuation through its
    folds, and every point is polished until its error is met. Ctrl-C keeps what is done.
    """
    from srfcli.numerics.continuation import ContinuationSettings, StepSettings
    from srfcli.tasks.stability import continue_boundary

    if not 1e-4 <= step <= 0.5:
        raise SrfError(f"--step {step:g} is not a share of the window", "Choose it between 0.0001 and 0.5; 0.035 is usual.")
    spanned = {r.name for r in over} or {"V"}
    if len(spanned) < 2:
        spanned.add("W0")
    options.check_axes(spanned, {"V": V, "W0": W0})
    slider = system.slider(V=V, W0=W0)
    model = slider.model
    steps = StepSettings(largest=step, max_steps=max_steps)
    settings = ContinuationSettings(tol=system.tolerance(tol).value, steps=steps, **search)
    for given in over:
        given.check_ends()
    ranges = [r.fitted(model.parameters, where=model.title) for r in over or (options.parse_over("V=1:100"),)]
    with Progress("continue") as progress:
        growing = continue_boundary(
            slider, eps=eps, over={r.name: (r.lo, r.hi) for r in ranges},
            log=[r.name for r in ranges if r.spacing == "log"], settings=settings,
            progress=lambda said: progress.advance(0, note=said),
        )  # fmt: skip
        warn_uncompiled("boundaries take about three times as long")
        system.say_defaults(slider.resolved, {"V", "W0"} - spanned)
        *_, found = growing
    emit(found.table, output, laws=model.laws, timings={"solve": progress.seconds}, figure=found.plot)
    finish(found.status)
