"""`srf fit`: parameters from recordings, or from a table of critical loads."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from srfcli.cli.options import OutputOptions, Session, SrfCommand, SystemOptions, output_options, system_options
from srfcli.errors import SrfError

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

    from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
    from srfcli.inference.sample import to_arviz
    from srfcli.results.fit import ADVICE
    from srfcli.tasks.fit import fit
    from srfcli.tasks.recordings import read_experiment

    registry = system.registry()
    experiment = read_experiment(source, format=options["reader"], registry=registry)
    free = [n.strip() for text in options["free"] for n in text.split(",") if n.strip()] or None
    kept = _draws_file(options["draws"], options["sample"], output)
    warn_uncompiled("the fit has no random friction field, and takes up to 34 times as long")
    begun, done = time.perf_counter(), FitShare(options["starts"])
    with Progress("fit") as progress:

        def report(stage: str, text: str, share: float | None) -> None:
            progress.stage(stage)
            progress.advance(note=text, share=done.after(text) if stage == "fit" else share)

        found = fit(
            experiment, free=free, trend=options["trend"], track=options["track"], starts=options["starts"],
            profile=options["profile"], sample=options["sample"], seed=options["seed"], registry=registry, progress=report,
        )  # fmt: skip
    for run in experiment.runs:
        for notice in run.notices:
            Session.current().detail(f"{run.name}: {notice}")
    more = [t for t in (found.runs, found.draws) if t is not None]
    emit(
        found.table, output, more=more, laws=found.found.problem.model.laws,
        inputs=[experiment.path, *(r.file for r in experiment.runs)], seed=options["seed"],
        timings={"fit": time.perf_counter() - begun}, figure=found.plot,
    )  # fmt: skip
    if found.posterior is not None and kept is not None:
        to_arviz(found.posterior).to_netcdf(str(kept))
        Session.current().say(f"Wrote {kept}")
    finish(found.status, advice=ADVICE.get(found.status))


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
