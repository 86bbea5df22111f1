"""`srf fit`: parameters from recordings, or from a table of critical loads."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.options import OutputOptions, Session, SrfCommand, SystemOptions, output_options, system_options
from srfcli.errors import SrfError

if TYPE_CHECKING:
    from collections.abc import Callable

    from srfcli.inference.fit import Fit, Problem
    from srfcli.inference.profile import Interval
    from srfcli.inference.sample import Posterior

EXAMPLES = """
srf fit EXPERIMENT                                  a folder with experiment.toml, or that file
srf fit EXPERIMENT --profile --starts 5 --json
srf fit EXPERIMENT --trend slip --free A,B,D0
srf fit EXPERIMENT --sample 4000 --draws draws.nc    the posterior; the draws for ArviZ
srf fit EXPERIMENT --track smooth                   no random friction field, whatever the recording says
srf fit THRESHOLDS.csv --free A,B,D0,Vsat,lambda    critical loads: V, eps, W0c, sigma
"""
USUAL_STEPS = 30  # of a fit; 24 to 29 in five of six experiments of one to seven runs, 63 in the other


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
@click.option("--draws", metavar="FILE.nc", help="Keep the draws of --sample as ArviZ's netCDF.")
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
        _refuse(options, ("starts", "profile", "trend", "track", "sample", "draws", "reader"), "recordings")
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

    from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
    from srfcli.cli.fit_tables import ADVICE, parameter_table, posterior_table, run_table
    from srfcli.inference.profile import profile
    from srfcli.inference.recordings import fit_recordings
    from srfcli.inference.sample import sample, to_arviz
    from srfcli.recording.experiment import read_experiment
    from srfcli.status import Status

    registry = system.registry()
    experiment = read_experiment(source, registry=registry, format=options["reader"])
    free = [n.strip() for text in options["free"] for n in text.split(",") if n.strip()] or None
    asked = options["profile"] or options["sample"]
    if options["track"] == "shared" and asked:
        raise SrfError("--track shared does not go with --profile or --sample", "Leave it out, or name --track rough.")
    kept = _draws_file(options["draws"], options["sample"], output)
    warn_uncompiled("the fit has no random friction field, and takes up to 34 times as long")
    begun, starts = time.perf_counter(), options["starts"]
    intervals: list[Interval] = []
    posterior: Posterior | None = None
    with Progress("fit") as progress:
        done = FitShare(starts)

        def report(text: str) -> None:
            progress.advance(note=text, share=done.after(text))

        found = fit_recordings(
            registry, experiment, free=free, trend=options["trend"], track=options["track"], ask_shared=not asked,
            starts=options["starts"], seed=options["seed"], progress=report,
        )  # fmt: skip
        problem, fit, status = found.problem, found.fit, found.status
        try:
            if options["profile"] and status is not Status.INTERRUPTED:
                with Progress("profile", total=2 * len(problem.names)) as ends:
                    for name in problem.names:
                        intervals.append(
                            profile(
                                problem,
                                fit,
                                name,
                                rough=found.state_space,
                                progress=lambda text: ends.advance(note=text),
                            )
                        )
            if options["sample"] and status is not Status.INTERRUPTED:
                with Progress("sample") as drawn:
                    posterior = sample(
                        problem, fit, options["sample"], rough=found.state_space, seed=options["seed"],
                        progress=lambda text, share: drawn.advance(note=text, share=share),
                    )  # fmt: skip
                status = Status.INTERRUPTED if posterior.interrupted else status
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
    for run in experiment.runs:
        for notice in run.notices:
            Session.current().detail(f"{run.name}: {notice}")
    runs = run_table(fit, experiment)
    table = parameter_table(problem, fit, intervals, found.starts, posterior, runs, status)
    if found.track is not None:
        table = replace(
            table, notes=(*table.notes, str(found.track)), meta={**table.meta, "track": asdict(found.track)}
        )
    if status is Status.INTERRUPTED and found.status is Status.INTERRUPTED and starts > 1:
        note = f"interrupted: {len(found.starts)} of {starts} starts were done"
        table = replace(table, notes=(*table.notes, note))
    more = [runs] if posterior is None else [runs, posterior_table(problem, posterior)]
    emit(
        table, output, more=more, laws=problem.model.laws, inputs=[experiment.path, *(r.file for r in experiment.runs)],
        seed=options["seed"], timings={"fit": time.perf_counter() - begun}, figure=_figure(problem, fit),
    )  # fmt: skip
    if posterior is not None and kept is not None:
        to_arviz(posterior).to_netcdf(str(kept))
        Session.current().say(f"Wrote {kept}")
    finish(status, advice=ADVICE.get(status))


class FitShare:
    """The share of a fit that is done, from 0 to 1, by the steps that were told of each of its starts.

    Most fits take some thirty steps, so that many are expected at first; one that takes more has, at any step, a quarter of its
    own before it.
    """

    def __init__(self, starts: int = 1) -> None:
        self.starts, self.number, self.steps = starts, 1, 0

    def after(self, text: str) -> float:
        """Return the share that is done once this step was told; `start 2 of 5: ...` begins the second."""
        told = re.match(r"start (\d+) of", text)
        if told and int(told[1]) != self.number:
            self.number, self.steps = int(told[1]), 0
        self.steps += 1
        return (self.number - 1 + self.steps / max(USUAL_STEPS, 4 / 3 * self.steps)) / self.starts


def _draws_file(name: str | None, count: int | None, output: OutputOptions) -> Path | None:
    """Return where the draws go; raises SrfError now for what could not be written later."""
    import importlib.util

    from srfcli.output.files import check_target

    if name is None:
        return None
    if count is None:
        raise SrfError("--draws keeps what --sample draws, and nothing is drawn", "Add --sample 4000.")
    place = Path(name).expanduser()
    if place.suffix.lower() != ".nc":
        raise SrfError(f"--draws {name} is no .nc file", f"End it in .nc: --draws {place.with_suffix('.nc')}")
    check_target(place, force=output.force, what="--draws")
    if importlib.util.find_spec("arviz") is None:
        raise SrfError("--draws needs arviz, which is not installed", 'pip install "srfcli[arviz]"')
    return place


def _figure(problem: Problem, fit: Fit) -> Callable[[], Any]:
    def draw() -> Any:
        from srfcli.cli.fit_tables import unit_of
        from srfcli.output.fits import fit_figure
        from srfcli.output.report_text import NARROW, bracketed, unit_text
        from srfcli.units import from_base

        runs = {r.name: r for r in problem.experiment.runs}
        rows = [(f.name, f.holdout, runs[f.name].t, runs[f.name].observed, f.prediction.y, f.white) for f in fit.runs]
        one = next(iter(runs.values()))
        told = []
        for name in fit.names:
            declared = unit_of(problem, name)
            unit, factor = problem.experiment.shown(declared)
            value, error = (from_base(x, declared) * factor for x in (fit.values[name], fit.stderr[name]))
            told.append(f"{name} = {bracketed(value, error)}" + ("" if unit == "1" else f"{NARROW}{unit_text(unit)}"))
        choice = problem.experiment.choice
        title = ", ".join([choice.law, choice.ageing, choice.interface, *choice.effects])
        return fit_figure(rows, quantity=one.quantity, unit=one.unit, title=title, found=", ".join(told))

    return draw
