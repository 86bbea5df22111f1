"""`srf simulate`: records of one slider over time, under a program of drive and load or as in an experiment."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import Session, SrfCommand
from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
from srfcli.cli.options import LAW_CHOICES, PATH, OutputOptions, SystemOptions, options_with_effects, output_options, value_option
from srfcli.core.errors import SrfError
from srfcli.core.units import convert, parse_quantity, split_quantity
from srfcli.motion import STEP_RISE
from srfcli.results.provenance import Provenance, sidecar, sidecar_path

if TYPE_CHECKING:
    from srfcli.data.noise import FrictionField
    from srfcli.data.values import ModelChoice
    from srfcli.motion.imposed import Load
    from srfcli.results.simulation import SimulationResult, Work

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
    from srfcli.tasks.simulate import simulate_work

    _check(given, experiment, output)
    warn_uncompiled("a simulation takes up to 34 times as long")
    spread, field = parse_spread(given["start_values"]), read_field(given)
    if experiment is None:
        work = _new_record(system, given, field, spread)
    else:
        work = _runs_again(system, experiment, given, field, spread)
    if field is not None:
        amplitude = {"value": field.amplitude, "unit": "1", "origin": "flag"}
        length = {"value": field.length, "unit": "um", "origin": "default" if given["field_length"] is None else "flag"}
        parameters = {**work.parameters, "field_amplitude": amplitude, "field_length": length}
        work = dataclasses.replace(work, parameters=parameters)
    with Progress("simulate", total=len(work.jobs)) as progress:
        found = simulate_work(work, rtol=given["rtol"], progress=lambda name, done: progress.advance(int(done), note=name))
    timings, table = {"simulate": progress.seconds}, found.table
    folder, seed = given["folder"], given["seed"]
    if folder is not None and output.out is None and output.format == "text":
        table = dataclasses.replace(table, columns=(), rows=())  # the records are in the folder
    emit(table, output, figure=found.plot, laws=work.model.laws, inputs=work.inputs, seed=seed, timings=timings)
    if folder is not None:
        _write(found, folder, seed, output, timings)
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


def _runs_again(system: SystemOptions, path: Path, given: Mapping[str, Any], field: FrictionField | None, spread: float) -> Work:
    """Return the runs of the experiment at `path`; srf.toml and the environment do not choose its laws, flags do."""
    from srfcli.codegen.slider import check_effects
    from srfcli.data.experiment import read_experiment
    from srfcli.tasks.simulate import runs_again

    registry = system.registry()
    experiment = read_experiment(path, registry=registry, format=given["reader"])
    if system.chosen["loading"].origin == "flag" and system.chosen["loading"].value != "vertical":
        raise SrfError("the runs of an experiment are loaded from above", "Leave out --loading inclined.")
    laws = {k: s.value for k, s in system.chosen.items() if s.origin == "flag" and k != "loading"}
    if system.effects:
        laws["effects"] = (*experiment.choice.effects, *_placed(system.effects))
        check_effects(registry, laws["effects"])
    work = runs_again(
        experiment, registry, laws=laws,
        parameters=system.flags, names=given["runs"], field=field, spread=spread,
        **{key: given[key] for key in ("start", "noise", "lag1", "quantum", "seed", "folder")},
    )  # fmt: skip
    return dataclasses.replace(work, meta={**work.meta, "rtol": given["rtol"]})


# A new record: drive, load and sampling from the options.

LAW_FILES = (".toml", ".py")


def _new_record(system: SystemOptions, given: Mapping[str, Any], field: FrictionField | None, spread: float) -> Work:
    """Return the one record that the options describe; raises SrfError for what cannot be simulated or written."""
    from srfcli.data.imposed import read_load
    from srfcli.motion.imposed import ConstantLoad, Drive, LoadSteps
    from srfcli.tasks import simulate as task

    slider = system.slider(True, **{name: given[name] for name in ("V", "W0", "eps")})
    values, folder = slider.resolved.values, given["folder"]
    observables = task.check_observables([n.strip() for n in (given["observable"] or "elongation").split(",")])
    if field is not None and system.chosen["loading"].value != "vertical":
        raise SrfError("a random friction field is for a slider loaded from above", "Leave out --field or --loading inclined.")
    if folder is not None and system.chosen["loading"].value != "vertical":
        raise SrfError("an experiment folder cannot say that the spring is inclined", "Leave out --out-dir or --loading.")
    load: Load = ConstantLoad(values["W0"])
    begin, length = 0.0, None
    found: tuple[str, ...] = ()
    if given["load_file"] is not None:
        load, times, notices = read_load(given["load_file"], registry=system.registry(), format=given["reader"])
        begin, length, found = float(times[0]), float(times[-1] - times[0]), tuple(map(str, notices))
    elif given["load"] is not None:
        steps = parse_pieces(given["load"], "N", option="--load", example="2:5, 0.2:5->7, 4:7")
        load = LoadSteps.sequence(steps, rise=parse_quantity(given["load_rise"], "s", name="--load-rise"))
        length = load.edges[-1]
    pieces = _drive_pieces(given, values["V"], length)
    durations = [duration for duration, _, _ in pieces]
    f = values["f"] if values["eps"] else None
    if given["rate"] is None:
        rates = (task.usual_rate(sum(durations), f),) * len(pieces)
    else:
        rates = parse_rates(given["rate"], len(pieces))
    work = task.record_of(
        slider,
        t=task.sample_times(durations, rates, begin),
        drive=Drive.sequence(pieces, start=begin),
        load=load,
        onset=None if given["onset"] is None else parse_quantity(given["onset"], "s", name="--onset"),
        start=given["start"],
        observables=observables,
        on=None if field is None else (system.model(tables=task.FIELD_TABLE), field),
    )
    gauges = task.read_gauges(observables, **{key: given[key] for key in ("noise", "lag1", "quantum", "seed")})
    choice, made = _laws(system), None
    if folder is not None:
        made = task.new_experiment(slider, choice, folder, free=given["free"], spread=spread, seed=given["seed"])
    files = [name for name in (choice.law, choice.ageing, choice.interface, *choice.effects) if name.endswith(LAW_FILES)]
    program = {"V": given["drive"], "W0": given["load"] or given["load_file"]}
    system.say_defaults(slider.resolved, [name for name, text in program.items() if text is None])
    loaded = None if given["load"] is None else length
    modulation, described = work.jobs[0].modulation, slider.described()
    for name, text in program.items():
        if text is not None:
            described[name] = {"value": str(text), "unit": "s:um/s" if name == "V" else "s:N", "origin": "flag"}
    return dataclasses.replace(
        work,
        parameters=described,
        gauges=gauges,
        experiment=made,
        remarks=tuple(f"the experiment names the file {name}" for name in files),
        inputs=() if given["load_file"] is None else (given["load_file"],),
        notes=(*found, *work.notes, *_sampling_notes(rates, f, loaded, sum(durations))),
        meta={"rate_Hz": sorted(set(rates)), "rtol": given["rtol"], "onset": modulation and modulation[2], **work.meta},
    )


def _drive_pieces(given: Mapping[str, Any], V: float, length: float | None) -> tuple[Piece, ...]:
    """Return the pieces of --drive, or one of constant velocity: as long as --for, the load's `length` (s), or 40 um."""
    from srfcli.tasks.simulate import LARGEST_VELOCITY

    if given["drive"] is not None:
        pieces = parse_pieces(given["drive"], "um/s", option="--drive", example="0.5:12, 4:8")
        for number, (_, first, last) in enumerate(pieces, 1):
            fastest = max(first, last, key=abs)
            if abs(fastest) > LARGEST_VELOCITY:
                raise SrfError(f"--drive: piece {number} drives at {fastest:g} um/s", f"Stay within {LARGEST_VELOCITY:g} um/s.")
        return pieces
    if given["duration"] is not None:
        length = parse_quantity(given["duration"], "s", name="--for")
        if not 0 < length <= LONGEST_TIME:
            raise SrfError(f"--for {length:g} s is not a length of time", "Write --for 4.")
    return ((float(f"{TRAVEL / V:.3g}") if length is None else length, V, V),)


def _sampling_notes(rates: Sequence[float], f: float | None, loaded: float | None, driven: float) -> tuple[str, ...]:
    """Return notes on a modulation that is sampled coarsely, and a --load that does not last (s) as long as the drive."""
    notes = []
    if f and min(rates) < 8 * f:
        notes.append(
            f"sampled {min(rates) / f:.2g} times a period of the modulation: from fewer than 8 the load is not read back"
        )
    if loaded is not None and loaded < driven * (1 - 1e-9):
        notes.append(f"--load ends at {loaded:g} s of {driven:g} s; its last value holds on")
    elif loaded is not None and loaded > driven * (1 + 1e-9):
        notes.append(f"--load goes on to {loaded:g} s, the drive ends at {driven:g} s; the rest is not simulated")
    return tuple(notes)


def _laws(system: SystemOptions) -> ModelChoice:
    """Return the laws by name, a file by its whole path: one relative to here means nothing in an experiment's folder."""
    from srfcli.data.values import ModelChoice

    names = {key: setting.value for key, setting in system.chosen.items() if key != "loading"}
    names |= dict(zip(LAW_CHOICES, _placed([names[key] for key in LAW_CHOICES]), strict=True))
    return ModelChoice(**names, effects=_placed(system.effects))


def _placed(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of laws, a file's as its whole path."""
    return tuple(str(Path(name).resolve()) if name.endswith(LAW_FILES) else name for name in names)


# Reading of options: pieces of drive and load, sampling rates, start values, the random friction field.

TRAVEL = 40.0  # um of driving where no duration is given
LONGEST_TIME = 1e12  # s
FIELD_LENGTH = 10.0  # um, the correlation length where only a size is given

Piece = tuple[float, float, float]  # duration (s), and the values between which a quantity runs straight


def parse_pieces(text: str, unit: str, *, option: str, example: str) -> tuple[Piece, ...]:
    """Return the pieces of '0.5:12, 4:8' or '1:5->7', values in `unit` unless one is written.

    Raises SrfError that names the option and the piece.
    """
    parts = [part.strip() for part in text.split(",")]
    if not any(parts):
        raise SrfError(f"{option} is empty", f"Write {option} '{example}'.")
    pieces = []
    for number, part in enumerate(parts, 1):
        where = f"{option}: piece {number}, {part!r},"
        duration_text, _, values_text = part.partition(":")
        ends = [end.strip() for end in values_text.split("->")]
        if part.count(":") != 1 or not duration_text.strip() or not all(ends) or len(ends) > 2:
            hint = f"Write pieces with commas between them: {option} '{example}'."
            raise SrfError(f"{where} is not DURATION:VALUE or DURATION:FROM->TO", hint)
        duration = parse_quantity(duration_text, "s", name=f"{option}: the duration of piece {number}")
        if not 0 < duration <= LONGEST_TIME:
            raise SrfError(f"{where} lasts {duration:g} s", f"Give each piece a duration above 0, up to {LONGEST_TIME:g} s.")
        split = [split_quantity(end, name=f"{option}: the value of piece {number}", example=f"5 {unit}") for end in ends]
        written = next((u for _, u in reversed(split) if u), unit)
        values = [convert(v, u or written, unit, name=f"{option}: piece {number}") for v, u in split]
        pieces.append((duration, values[0], values[-1]))
    return tuple(pieces)


def parse_rates(text: str, pieces: int) -> tuple[float, ...]:
    """Return the samples per second in each of so many pieces: one for all, or one for each."""
    rates = tuple(parse_quantity(part, "Hz", name="--rate") for part in text.split(","))
    if not all(0 < rate <= 1e9 for rate in rates):
        raise SrfError(f"--rate {text}: a rate lies between 0 and 1e9 Hz", "Write --rate 1000.")
    if len(rates) not in (1, pieces):
        raise SrfError(
            f"--rate {text} gives {len(rates)} rates for {pieces} piece{'s' if pieces != 1 else ''} of the drive",
            "Give one rate, or one for each piece: --rate 100,1,1000.",
        )
    return rates * pieces if len(rates) == 1 else rates


def parse_spread(text: str) -> float:
    """Return by how much, relatively, written start values may be off: 0 for 'true', 0.1 for 'perturb:10%'."""
    if text == "true":
        return 0.0
    kind, colon, size = text.partition(":")
    if kind != "perturb" or not colon:
        raise SrfError(f"--start-values {text!r} is neither true nor perturb:SIZE", "Write --start-values perturb:10%.")
    share = size.strip().removesuffix("%")
    spread = parse_quantity(share, "1", name="--start-values perturb") / (100.0 if share != size.strip() else 1.0)
    if not 0 <= spread < 1:
        raise SrfError(f"--start-values {text}: the size is not between 0 and 100 %", "Write perturb:10%.")
    return spread


def read_field(given: Mapping[str, Any]) -> FrictionField | None:
    """Return the random field that --field, --field-length and --seed describe; None without one."""
    if given["field"] is None:
        if given["field_length"] is not None:
            raise SrfError("--field-length is given without a field", "Give the size: --field 3e-4.")
        return None
    from srfcli.data.noise import FrictionField

    size = parse_quantity(given["field"], "1", name="--field")
    length = parse_quantity(given["field_length"] or str(FIELD_LENGTH), "um", name="--field-length")
    field = FrictionField(size, length, given["seed"])
    return field if field.amplitude else None
