"""`srf fit`: parameters from recordings, or from a table of critical loads."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import Session, SrfCommand
from srfcli.cli.emit import Progress, emit, finish, render
from srfcli.cli.options import (
    PATH,
    OutputOptions,
    Spread,
    SystemOptions,
    listed,
    options_with_effects,
    output_options,
    parse_ends,
    reader_option,
    vary_options,
    worker_options,
)
from srfcli.core.errors import SrfError, Status
from srfcli.core.files import check_target, write_atomic
from srfcli.core.settings import Parameter

if TYPE_CHECKING:
    from srfcli.results.fit import CampaignResult

EXAMPLES = """
srf fit EXPERIMENT                                  a folder with experiment.toml, or that file
srf fit EXPERIMENT --profile --starts 5 --json
srf fit EXPERIMENT --trend slip --free A,B,D0
srf fit EXPERIMENT --vary mu0,D0                    each run has its own; how they scatter, and whether they do
srf fit EXPERIMENT --sample 4000 --draws draws.nc    the posterior; the draws for ArviZ
srf fit EXPERIMENT --track smooth                   no random friction field, whatever the recording says
srf fit A B C --table out.csv --workers 3           a campaign: each by itself, a row each
srf fit THRESHOLDS.csv --free A,B,D0,Vsat,lambda    critical loads: V, eps, W0c, sigma
"""
USUAL_STEPS = 30  # of a fit: five of six experiments of one to seven runs took 24 to 29, the other 63


@click.command("fit", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("sources", metavar="EXPERIMENT...|THRESHOLDS.csv", nargs=-1, required=True, type=PATH)
@click.option(
    "--table", "place", metavar="FILE.csv", help="Fit each experiment by itself, and write a row for each to this file."
)
@click.option("--free", multiple=True, metavar="NAMES", help="Parameters to fit; else those that the experiment leaves free.")
@click.option("--starts", type=click.IntRange(1, 1000), default=1, help="Starting points: the file's values, then others.")
@click.option("--profile", is_flag=True, help="Profile-likelihood intervals.")
@vary_options
@click.option(
    "--prior/--no-prior",
    default=True,
    help="Whether values that vary between five groups or more have a Gaussian prior, its mean and scatter estimated.",
)
@click.option(
    "--track",
    type=click.Choice(["smooth", "rough", "shared"]),
    help="Random friction field along slip: none, one for each run, or one for all; unless given, the likeliest.",
)
@click.option("--sample", type=click.IntRange(100, 1_000_000), metavar="N", help="Draw N points of the posterior (emcee).")
@click.option("--draws", metavar="FILE.nc", help="Keep the draws of --sample as ArviZ's netCDF.")
@click.option("--seed", default=0, help="Seed of further starts and of the sampler.")
@reader_option
@click.option("--bounds", multiple=True, metavar="NAME=LO:HI", help="THRESHOLDS.csv only: bounds of a parameter.")
@click.option(
    "--method",
    multiple=True,
    metavar="[powell|least-squares]",
    help="THRESHOLDS.csv only: minimiser of the cost; repeatable.  [default: both]",
)
@click.option("--tol", type=float, help="THRESHOLDS.csv only: relative error of a load; 1e-6 unless set.")
@click.option(
    "--max-evaluations", type=click.IntRange(1), help="THRESHOLDS.csv only: most evaluations of the cost, for each minimiser."
)
@worker_options
@options_with_effects
@output_options
def command(
    sources: tuple[Path, ...], place: str | None, spread: Spread, system: SystemOptions, output: OutputOptions, **options: Any
) -> None:
    """Fit the model of an experiment to its recordings and critical loads, all together, by maximum likelihood.

    The gauge's noise, its level and colour, and a random friction field along slip are estimated with the parameters and count
    in their errors. Several experiments, or --table, are a campaign: each is fitted by itself and has a row. A CSV file is taken
    for a table of critical loads, which the paper's procedure fits. The options that choose a system (--law, --ageing,
    --interface, --loading, --inertia, --K, --M, --f, --angle, --set, --effect) are for such a table alone: an experiment states
    its own system.
    """
    campaign, source = place is not None or len(sources) > 1, sources[0]
    if not campaign:
        _refuse(("workers", "cluster", "resume"), "several experiments")
    if source.suffix.lower() == ".csv" and not campaign:
        from srfcli.data.draft import looks_like_recording

        if looks_like_recording(source, registry=system.registry()):
            raise SrfError(
                f"{source}: a recording, and no experiment yet", f"`srf new {source}` writes the experiment.toml to fit."
            )
        meant = ("starts", "trend", "vary", "by", "prior", "track", "sample", "draws", "reader")
        _refuse(meant, "recordings")
        _fit_thresholds(source, system, output, **options)
        return
    _refuse(("bounds", "method", "tol", "max_evaluations"), "critical loads")
    laws = [name for name, setting in system.chosen.items() if setting.origin == "flag"]
    for name in (*laws, *(["effect"] if system.effects else [])):
        raise SrfError(f"--{name} is given, and an experiment names its own", "Change [model] in experiment.toml.")
    for name in system.flags:
        raise SrfError(f"{name} is set, and an experiment has its own values", "Change it in experiment.toml.")
    if campaign:
        _fit_campaign(sources, place, spread, system, output, **options)
        return
    _fit_recordings(source, system, output, **options)


def _refuse(names: tuple[str, ...], purpose: str) -> None:
    """Raise where an option is given that has no meaning for this kind of source."""
    context = click.get_current_context()
    for name in names:
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            flag = "format" if name == "reader" else name.replace("_", "-")
            raise SrfError(f"--{flag} is for fits of {purpose}", "Leave it out here.")


def _fit_recordings(source: Path, system: SystemOptions, output: OutputOptions, **options: Any) -> None:
    from srfcli.inference.posterior import to_arviz
    from srfcli.results.fit import ADVICE
    from srfcli.tasks.recordings import fit, read_experiment

    registry = system.registry()
    experiment = read_experiment(source, format=options["reader"], registry=registry)
    free = listed(options["free"]) or None
    kept = _draws_file(options["draws"], options["sample"], output)
    done = FitShare(options["starts"])
    with Progress("fit") as progress:

        def report(stage: str, text: str, share: float | None) -> None:
            progress.stage(stage)
            progress.advance(note=text, share=done.after(text) if stage == "fit" else share)

        found = fit(
            experiment, free=free, vary=listed(options["vary"]), registry=registry, progress=report,
            **{k: options[k] for k in ("trend", "by", "prior", "track", "starts", "profile", "sample", "seed")},
        )  # fmt: skip
    for run in experiment.runs:
        for notice in run.notices:
            Session.current().detail(f"{run.name}: {notice}")
    more = [t for t in (found.varied, found.runs, found.tables, found.loads, found.draws) if t is not None]
    emit(
        found.table, output, more=more, laws=found.found.problem.model.laws,
        inputs=[experiment.path, *experiment.files], seed=options["seed"],
        timings={"fit": progress.seconds}, figure=found.plot,
    )  # fmt: skip
    if found.posterior is not None and kept is not None:
        to_arviz(found.posterior).to_netcdf(str(kept))
        Session.current().say(f"Wrote {kept}")
    finish(found.status, advice=ADVICE.get(found.status))


def _fit_campaign(
    sources: Sequence[Path], place: str | None, spread: Spread, system: SystemOptions, output: OutputOptions, **options: Any
) -> None:
    """Fit each experiment by itself, a row each; the table is written anew whenever one is done."""
    from srfcli.tasks.recordings import fit_campaign

    _refuse(("profile", "sample", "draws"), "one experiment")
    target = None if place is None else Path(place).expanduser()
    if target is not None:
        if target.suffix.lower() != ".csv":
            raise SrfError(f"--table {place} is no .csv file", f"End it in .csv: --table {target.with_suffix('.csv')}")
        check_target(target, force=output.force or spread.resume is not None, what="--table")
    free = listed(options["free"]) or None
    with Progress("fit", total=len(sources)) as progress:

        def done(so_far: CampaignResult) -> None:
            progress.advance(note=f"{len(so_far.rows)} of {len(sources)} experiments")
            if target is not None:
                write_atomic(target, render(so_far.table, "csv").encode("utf-8"))

        found = fit_campaign(
            sources, reader=options["reader"], plugins=system.plugins, run=spread.run, done=done,
            options={
                "free": free, "vary": listed(options["vary"]),
                **{k: options[k] for k in ("trend", "by", "prior", "track", "starts", "seed")},
            },
        )  # fmt: skip
    emit(
        found.table, output, seed=options["seed"], timings={"fit": progress.seconds}, figure=found.plot,
        inputs=[p for p in (s / "experiment.toml" if s.is_dir() else s for s in sources) if p.is_file()],
    )  # fmt: skip
    if target is not None and found.rows:
        write_atomic(target, render(found.table, "csv").encode("utf-8"))  # all that is done, wherever it was interrupted
        Session.current().say(f"Wrote {target}")
    failed = [str(row["experiment"]) for row in found.rows if row["status"] == "failed"]
    advice = {
        Status.INTERRUPTED: "the rows that were done are kept. With --resume DIR the next run goes on from there.",
        Status.NO_CONVERGENCE: f"{len(failed)} of {len(sources)} experiments have no fit ({', '.join(failed[:5])}); see `reason`."
        if failed
        else "of some experiments the likelihood's maximum was not reached; see `status`.",
    }
    finish(found.worst, advice=advice.get(found.worst))


class FitShare:
    """Estimates the share of a fit that is done, from 0 to 1, from the steps that each start reports.

    A start is expected to take USUAL_STEPS steps, or 4/3 of those it has made where that is more.
    """

    def __init__(self, starts: int = 1) -> None:
        self.starts, self.number, self.steps = starts, 1, 0

    def after(self, text: str) -> float:
        """Return the share that is done after this step; the text `start 2 of 5: ...` begins the second start."""
        told = re.match(r"start (\d+) of", text)
        if told and int(told[1]) != self.number:
            self.number, self.steps = int(told[1]), 0
        self.steps += 1
        return (self.number - 1 + self.steps / max(USUAL_STEPS, 4 / 3 * self.steps)) / self.starts


def _draws_file(name: str | None, count: int | None, output: OutputOptions) -> Path | None:
    """Return the file of the draws; raises SrfError, before the fit, where it could not be written."""
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


# A table of critical loads: both methods side by side, with cost against evaluations.


def _fit_thresholds(source: Path, system: SystemOptions, output: OutputOptions, **options: Any) -> None:
    from srfcli.codegen.slider import SlidingSystem
    from srfcli.data.thresholds import read_thresholds
    from srfcli.inference.free_parameters import GIVEN, with_transmission
    from srfcli.tasks.recordings import fit_thresholds

    table, opener = read_thresholds(source), system.opener()
    parameters = with_transmission(opener.model.parameters)
    given = next((name for name in GIVEN if name in system.flags), None)
    if given:
        raise SrfError(f"{given} is set, and {source.name} gives it", f"Leave --set {given} out.")
    slider = SlidingSystem(system.resolve(parameters), opener, opener.model.title)
    bounds = dict(_bounds(text, parameters) for text in options["bounds"])
    with Progress("fit") as progress:
        found = fit_thresholds(
            table, slider, free=listed(options["free"]), bounds=bounds, methods=options["method"],
            tol=system.tolerance(options["tol"]).value, max_evaluations=options["max_evaluations"], profile=options["profile"],
            progress=lambda text: progress.advance(note=text),
        )  # fmt: skip
    methods = found.found.methods
    emit(
        found.table, output, more=[found.methods, found.trace, found.loads], laws=opener.model.laws, inputs=[source],
        timings={m.method: m.cpu for m in methods}, figure=found.plot,
    )  # fmt: skip
    for m in methods:
        Session.current().say(f"{m.method}: {m.evaluations} evaluations, {m.cpu:.1f} s of CPU")
    finish(found.status)


def _bounds(text: str, parameters: Sequence[Parameter]) -> tuple[str, tuple[float, float]]:
    """Return name and bounds in the declared unit that NAME=LOW:HIGH states; raises SrfError that shows the form."""
    name, _, ends = text.partition("=")
    found = parse_ends(name, ends)
    if found is None:
        raise SrfError(f"--bounds {text!r} is not NAME=LOW:HIGH, low below high", "Write --bounds Vsat=100:1000.")
    fitted = found.fitted(parameters)
    return found.name, (fitted.lo, fitted.hi)
