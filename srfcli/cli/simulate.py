"""`srf simulate`: records of one slider over time, under a program of drive and load or as in an experiment."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import Session, SrfCommand
from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
from srfcli.cli.options import PATH, OutputOptions, SystemOptions, options_with_effects, output_options, value_option
from srfcli.core.errors import SrfError
from srfcli.motion import STEP_RISE
from srfcli.results.provenance import Provenance, sidecar, sidecar_path

if TYPE_CHECKING:
    from srfcli.results.simulation import SimulationResult

EXAMPLES = """
srf simulate --V 8 --W0 9 --eps 0.09 --for 4 --rate 1000 --out run.csv
srf simulate --W0 5 --drive '1:10, 100:0, 5:10' --plot slide-hold-slide.svg
srf simulate --V 8 --load '2:5, 0.2:5->7, 4:7' --csv
srf simulate --drive '0.5:12, 4:8' --W0 9 --eps 0.09 --onset 2 --noise 0.02 --lag1 0.8 --quantum 0.005 --out-dir made
srf simulate EXPERIMENT --run onset --plot onset.svg
srf simulate EXPERIMENT --set lambda=0.5 --out-dir predicted
srf simulate EXPERIMENT --field 3e-4 --field-length 10 --seed 1 --out-dir made
"""
OWN_RECORD = {  # options that describe a new record; they exclude EXPERIMENT, which has its own
    "V": "--V", "W0": "--W0", "eps": "--eps", "drive": "--drive", "load": "--load", "load_file": "--load-file",
    "onset": "--onset", "duration": "--for", "rate": "--rate", "observable": "--observe", "free": "--free",
}  # fmt: skip
PROGRAM = ("load_rise", *(n for n in OWN_RECORD if n not in ("V", "W0", "eps")))  # those that are no parameters of the slider
EXCLUSIVE = (("V", "drive"), ("duration", "drive"), ("W0", "load"), ("W0", "load_file"), ("load", "load_file"))


@click.command("simulate", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("experiment", required=False, type=click.Path(exists=True, path_type=Path))
@value_option("V", "Constant driving velocity, in um/s.")
@value_option("W0", "Constant normal load, in N.")
@value_option("eps", "Relative amplitude of a modulation at --f, on top of any load.")
@click.option("--for", "duration", metavar="TIME", help="Length of the record, in s.  [default: 40 um of driving]")
@click.option(
    "--drive", metavar="PIECES", help="Driving velocity as DURATION:VELOCITY, ... in s and um/s; 0 is a hold, 5->20 a ramp."
)
@click.option("--load", metavar="PIECES", help="Normal load as DURATION:LOAD, ... in s and N; 5->7 is a ramp.")
@click.option(
    "--load-rise", metavar="TIME", default=f"{STEP_RISE:g} s", help="Time over which steps and corners of --load are rounded."
)
@click.option(
    "--load-file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="A recorded load: a file with columns time and normal_load.",
)
@click.option("--format", "reader", metavar="READER", help="Read --load-file, or the runs' files, by this reader.")
@click.option("--onset", metavar="TIME", help="When the modulation begins to rise.  [default: at the first sample]")
@click.option("--rate", metavar="HZ", help="Samples per second, or one rate for each piece of --drive.")
@click.option(
    "--start",
    metavar="STATE",
    default="steady",
    help="Steady sliding at the first velocity, at another (--start 10), or values: --start 'v=1e-3, phi=100 s'.",
)
@click.option("--rtol", default=1e-8, help="Local relative error of integration.")
@click.option("--run", "runs", multiple=True, metavar="NAME", help="Only this run of EXPERIMENT; may be repeated.")
@click.option(
    "--observe",
    "observable",
    metavar="NAMES",
    help="What the apparatus records: elongation, force or friction, and besides it another, slip or contact_area, "
    "as force,slip.  [default: elongation]",
)
@click.option(
    "--noise",
    metavar="SIZE",
    help="Standard deviation of the gauge's noise, in the observable's unit; of several one for each, as 0.01,0.2.",
)
@click.option("--lag1", default=0.0, show_default=False, help="Correlation of the noise from sample to sample, as 0.8.")
@click.option("--quantum", metavar="SIZE", help="Step to which readings are rounded.")
@click.option("--field", metavar="SIZE", help="Amplitude of a random friction field along slip, in units of mu0, as 3e-4.")
@click.option("--field-length", metavar="UM", help="Correlation length of that field, in um.  [default: 10 um]")
@click.option("--seed", type=click.IntRange(0), default=0, help="Seed of all that is random.")
@click.option(
    "--out-dir", "folder", type=PATH, metavar="DIR", help="Write the records as an experiment folder, whole or not at all."
)
@click.option(
    "--start-values",
    default="true",
    metavar="true|perturb:10%",
    help="Start values written to DIR: the true ones, or off by up to so much.",
)
@click.option("--free", metavar="NAMES", help="Parameters that DIR leaves to a fit.  [default: the law's, not V0]")
@options_with_effects
@output_options
def command(system: SystemOptions, experiment: Path | None, output: OutputOptions, **given: Any) -> None:
    """Time traces of a slider: through steady sliding, stick-slip, holds and re-sliding.

    Drive and load are programs of pieces, or those of the runs of EXPERIMENT, a folder or its experiment.toml. Errors are
    controlled; slip velocities may fall to 1e-12 um/s and below. The records can be written as a new experiment, with noise.
    """
    from srfcli.tasks import simulate as task

    _check(given, experiment, output)
    warn_uncompiled("a simulation takes up to 34 times as long")
    how = task.Recorder(**{f.name: given[f.name] for f in dataclasses.fields(task.Recorder)})
    if experiment is None:
        slider = system.slider(True, **{name: given[name] for name in ("V", "W0", "eps")})
        work = task.record_as_told(slider, how, **{name: given[name] for name in PROGRAM})
        told = {"V": given["drive"], "W0": given["load"] or given["load_file"]}
        system.say_defaults(slider.resolved, [name for name, text in told.items() if text is None])
    else:  # srf.toml and the environment do not choose the laws of an experiment, flags do
        laws = {name: setting.value for name, setting in system.chosen.items() if setting.origin == "flag"}
        chosen = {"laws": laws, "effects": system.effects, "parameters": system.flags, "runs": given["runs"]}
        work = task.runs_again(experiment, system.registry(), how, **chosen)
    with Progress("simulate", total=len(work.jobs)) as progress:
        found = task.simulate_work(work, rtol=how.rtol, progress=lambda name, done: progress.advance(int(done), note=name))
    timings, table = {"simulate": progress.seconds}, found.table
    if how.folder is not None and output.out is None and output.format == "text":
        table = dataclasses.replace(table, columns=(), rows=())  # the records are in the folder
    emit(table, output, figure=found.plot, laws=work.model.laws, inputs=work.inputs, seed=how.seed, timings=timings)
    if how.folder is not None:
        _write(found, how.folder, how.seed, output, timings)
    finish(found.status)


def _check(given: dict[str, Any], experiment: Path | None, output: OutputOptions) -> None:
    """Raise SrfError for options that contradict each other, before anything is computed."""
    if not 1e-13 <= given["rtol"] <= 1e-2:
        raise SrfError(f"--rtol {given['rtol']:g} is out of range", "Choose it between 1e-13 and 1e-2: --rtol 1e-8.")
    for name, option in OWN_RECORD.items():
        if experiment is not None and given[name] is not None:
            hint = "Its runs say how they are driven, loaded and sampled."
            raise SrfError(f"{option} does not go with an experiment", hint)
    if experiment is None and given["runs"]:
        raise SrfError("--run chooses among the runs of an experiment, and none is given", "srf simulate DIR --run NAME")
    if given["reader"] is not None and experiment is None and given["load_file"] is None:
        raise SrfError("--format names the reader of a file, and none is read", "Give --load-file FILE or an experiment.")
    for one, other in EXCLUSIVE:
        if given[one] is not None and given[other] is not None:
            hint = f"Leave out {OWN_RECORD[one]} or {OWN_RECORD[other]}."
            raise SrfError(f"{OWN_RECORD[one]} and {OWN_RECORD[other]} exclude each other", hint)
    if (folder := given["folder"]) is None:
        for name, option, unset in (("start_values", "--start-values", "true"), ("free", "--free", None)):
            if given[name] != unset:
                raise SrfError(f"{option} is about an experiment that is written", "Name its folder: --out-dir DIR.")
        return
    from srfcli.data.writing import check_folder

    source = experiment and (experiment if experiment.is_dir() else experiment.parent)
    if source and folder.resolve() == source.resolve():
        raise SrfError(f"--out-dir {folder} is the experiment itself", "Recordings are never replaced; name another folder.")
    check_folder(folder, force=output.force)


def _write(found: SimulationResult, folder: Path, seed: int, output: OutputOptions, timings: dict[str, float]) -> None:
    """Write the experiment folder and its sidecar; an unfinished one is not written, as nothing in it would say so."""
    from srfcli.data.writing import DESCRIPTION, write_experiment

    session, work = Session.current(), found.work
    if not found.status.ok:
        session.say(f"Not written: {folder}, as its records are not complete")
        return
    for note in work.remarks:
        session.say(f"Note: {note}")
    made = Provenance(session.arguments, work.parameters, work.model.laws, work.inputs, seed, timings)
    place = folder / DESCRIPTION
    beside = (lambda content: sidecar(place, content, made)) if output.provenance else None
    files = write_experiment(found.experiment, folder, force=output.force, sidecar=beside)
    if output.provenance:
        session.detail(f"Wrote {sidecar_path(place)}")
    session.say(f"Wrote {folder} ({len(files) - 1} run{'s' if len(files) != 2 else ''})")
