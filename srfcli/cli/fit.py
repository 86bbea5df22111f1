"""`srf fit`: parameters from recordings, or from a table of critical loads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.options import OutputOptions, Session, SrfCommand, SystemOptions, output_options, system_options
from srfcli.errors import SrfError

if TYPE_CHECKING:
    from collections.abc import Callable

    from srfcli.inference.fit import Fit, Problem
    from srfcli.inference.profile import Interval

EXAMPLES = """
srf fit EXPERIMENT                                  a folder with experiment.toml, or that file
srf fit EXPERIMENT --profile --starts 5 --json
srf fit EXPERIMENT --trend slip --free A,B,D0
srf fit EXPERIMENT --track smooth                   no random friction field, whatever the recording says
srf fit THRESHOLDS.csv --free A,B,D0,Vsat,lambda    critical loads: V, eps, W0c, sigma
"""


@click.command("fit", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("source", metavar="EXPERIMENT|THRESHOLDS.csv", type=click.Path(path_type=Path))
@click.option(
    "--free", multiple=True, metavar="NAMES", help="Parameters to fit; else those that the experiment leaves free."
)
@click.option(
    "--starts", type=click.IntRange(1, 1000), default=1, show_default=True, help="Starting points to fit from."
)
@click.option("--profile", is_flag=True, help="Profile-likelihood intervals.")
@click.option("--trend", type=click.Choice(["slip", "time"]), help="Let each run's observable drift with slip or time.")
@click.option(
    "--track",
    type=click.Choice(["smooth", "rough", "shared"]),
    help="Random friction field along slip: none, one for each run, one for all; else the recording decides.",
)
@click.option(
    "--sample", type=click.IntRange(100, 1_000_000), metavar="N", help="Draw N points of the posterior (emcee)."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of further starts and of the sampler.")
@click.option("--format", "reader", metavar="READER", help="Read every data file by this reader.")
@click.option(
    "--bounds", multiple=True, metavar="NAME=LO:HI", help="Bounds of a parameter, for a table of critical loads."
)
@click.option("--method", multiple=True, help="Minimiser of the critical loads' cost; both unless named.")
@click.option("--tol", type=float, help="Relative error of a critical load.")
@click.option(
    "--max-evaluations", type=click.IntRange(1), help="Of the cost over the critical loads, for each minimiser."
)
@system_options
@output_options
def command(source: Path, system: SystemOptions, output: OutputOptions, **options: Any) -> None:
    """Fit the model of an experiment to its recordings, all runs together, by maximum likelihood.

    The gauge's noise, its level and colour, and a random friction field along slip are estimated with the parameters and count
    in their errors. A CSV file is taken for a table of critical loads, which the paper's procedure fits: the laws are then those
    of the options below.
    """
    if source.suffix.lower() == ".csv":
        from srfcli.cli.fit_thresholds import fit_thresholds
        from srfcli.recording.draft import looks_like_recording

        if looks_like_recording(source, registry=system.registry()):
            raise SrfError(
                f"{source}: a recording, and no experiment yet",
                f"`srf new {source}` writes the experiment.toml to fit.",
            )
        _refuse(options, ("starts", "profile", "trend", "track", "sample", "reader"), "recordings")
        fit_thresholds(
            source, system=system, output=output, free=options["free"], bounds=options["bounds"],
            methods=options["method"], tol=options["tol"], max_evaluations=options["max_evaluations"],
        )  # fmt: skip
        return
    _refuse(options, ("bounds", "method", "tol", "max_evaluations"), "critical loads")
    for name in ("law", "ageing", "interface", "loading", "inertia"):
        if getattr(system, name).origin == "flag":
            raise SrfError(f"--{name} is given, and an experiment names its own", "Change [model] in experiment.toml.")
    if system.flags:
        name = next(iter(system.flags))
        raise SrfError(f"{name} is set, and an experiment has its own values", "Change it in experiment.toml.")
    _fit_recordings(
        source, system, output, **{k: v for k, v in options.items() if k not in ("bounds", "method", "tol")}
    )


def _refuse(options: dict[str, Any], names: tuple[str, ...], purpose: str) -> None:
    """Raise where an option is given that has no meaning for this kind of source."""
    context = click.get_current_context()
    for name in names:
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            flag = "format" if name == "reader" else name.replace("_", "-")
            raise SrfError(f"--{flag} is for fits of {purpose}", "Leave it out here.")


def _fit_recordings(source: Path, system: SystemOptions, output: OutputOptions, **options: Any) -> None:
    import time
    from dataclasses import asdict, replace

    from srfcli.cli.emit import Progress, emit, finish
    from srfcli.cli.fit_tables import parameter_table, run_table
    from srfcli.inference.profile import profile
    from srfcli.inference.recordings import fit_recordings
    from srfcli.recording.experiment import read_experiment
    from srfcli.status import Status

    registry = system.registry()
    experiment = read_experiment(source, registry=registry, format=options["reader"])
    free = [n.strip() for text in options["free"] for n in text.split(",") if n.strip()] or None
    asked = options["profile"] or options["sample"]
    if options["track"] == "shared" and asked:
        raise SrfError("--track shared does not go with --profile or --sample", "Leave it out, or name --track rough.")
    begun = time.perf_counter()
    intervals: list[Interval] = []
    draws = None
    with Progress("fit") as progress:

        def report(text: str) -> None:
            progress.advance(note=text)

        found = fit_recordings(
            registry, experiment, free=free, trend=options["trend"], track=options["track"], ask_shared=not asked,
            starts=options["starts"], seed=options["seed"], progress=report,
        )  # fmt: skip
        problem, fit, status = found.problem, found.fit, found.status
        try:
            if options["profile"] and status is not Status.INTERRUPTED:
                for name in problem.names:
                    intervals.append(profile(problem, fit, name, rough=found.state_space, progress=report))
            if options["sample"] and status is not Status.INTERRUPTED:
                from srfcli.inference.sample import sample

                draws = sample(
                    problem, fit, options["sample"], rough=found.state_space, seed=options["seed"], progress=report
                )
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
    for run in experiment.runs:
        for notice in run.notices:
            Session.current().detail(f"{run.name}: {notice}")
    runs = run_table(fit, experiment)
    table = parameter_table(problem, fit, intervals, found.starts, draws, runs, status)
    if found.track is not None:
        table = replace(
            table, notes=(*table.notes, str(found.track)), meta={**table.meta, "track": asdict(found.track)}
        )
    if status is Status.INTERRUPTED and options["starts"] > 1:
        note = f"interrupted: {len(found.starts)} of {options['starts']} starts were done"
        table = replace(table, notes=(*table.notes, note))
    emit(
        table, output, more=[runs], laws=problem.model.laws, inputs=[experiment.path, *(r.file for r in experiment.runs)],
        seed=options["seed"], timings={"fit": time.perf_counter() - begun}, figure=_figure(problem, fit),
    )  # fmt: skip
    finish(status)


def _figure(problem: Problem, fit: Fit) -> Callable[[], Any]:
    def draw() -> Any:
        from srfcli.output.fits import fit_figure

        runs = {r.name: r for r in problem.experiment.runs}
        rows = [(f.name, f.holdout, runs[f.name].t, runs[f.name].observed, f.prediction.y, f.white) for f in fit.runs]
        one = next(iter(runs.values()))
        return fit_figure(rows, quantity=one.quantity, unit=one.unit)

    return draw
