"""`srf simulate`: records of one slider over time, under a program of drive and load or as in an experiment."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import Session, SrfCommand
from srfcli.cli.options import OutputOptions, SystemOptions, output_options, system_options, value_option
from srfcli.core.errors import SrfError, Status, did_you_mean
from srfcli.core.units import convert, parse_quantity, split_quantity
from srfcli.laws.law_file import APPARATUS
from srfcli.results.simulation import RISE, Gauge, Job, Record, Work, simulated_run

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from srfcli.codegen.model import GeneratedModel
    from srfcli.core.settings import Parameter, Resolved
    from srfcli.data.noise import RoughTrack
    from srfcli.data.values import Experiment, FitParameter, ModelChoice, Run
    from srfcli.motion.imposed import Drive, Load

    Array = NDArray

EXAMPLES = """
srf simulate --V 8 --W0 9 --eps 0.09 --for 4 --rate 1000 --out run.csv
srf simulate --W0 5 --drive '1:10, 100:0, 5:10' --plot slide-hold-slide.svg
srf simulate --V 8 --load '2:5, 0.2:5->7, 4:7' --csv
srf simulate --drive '0.5:12, 4:8' --W0 9 --eps 0.09 --onset 2 --noise 0.02 --lag1 0.8 --quantum 0.005 --out-dir made
srf simulate EXPERIMENT --run onset --plot onset.svg
srf simulate EXPERIMENT --set lambda=0.5 --out-dir predicted
srf simulate EXPERIMENT --roughness 3e-4 --roughness-length 10 --seed 1 --out-dir rough
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
    "--drive",
    metavar="PIECES",
    help="Driving velocity as DURATION:VELOCITY, ... in s and um/s; 0 is a hold, 5->20 a ramp.",
)
@click.option("--load", metavar="PIECES", help="Normal load as DURATION:LOAD, ... in s and N; 5->7 is a ramp.")
@click.option(
    "--load-rise",
    metavar="TIME",
    default=f"{RISE:g} s",
    show_default=True,
    help="Time over which steps and corners of --load are rounded.",
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
    show_default=True,
    help="Steady sliding at the first velocity, at another (--start 10), or values: --start 'v=1e-3, phi=100 s'.",
)
@click.option("--rtol", type=float, default=1e-8, show_default=True, help="Local relative error of integration.")
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
@click.option("--lag1", type=float, default=0.0, help="Correlation of the noise from sample to sample, as 0.8.")
@click.option("--quantum", metavar="SIZE", help="Step to which readings are rounded.")
@click.option("--roughness", metavar="SIZE", help="Standard deviation of a random friction field along slip, as 3e-4.")
@click.option("--roughness-length", metavar="UM", help="Correlation length of that field, in um.  [default: 10 um]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all that is random.")
@click.option(
    "--out-dir",
    "--experiment",
    "folder",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write the records as an experiment folder, whole or not at all.",
)
@click.option(
    "--start-values",
    default="true",
    show_default=True,
    metavar="true|perturb:10%",
    help="Start values written to DIR: the true ones, or off by up to so much.",
)
@click.option("--free", metavar="NAMES", help="Parameters that DIR leaves to a fit.  [default: the law's, not V0]")
@system_options
@output_options
def command(system: SystemOptions, experiment: Path | None, output: OutputOptions, **given: Any) -> None:
    """Time traces of a slider: through steady sliding, stick-slip, holds and re-sliding.

    Drive and load are programs of pieces, or those of the runs of EXPERIMENT, a folder or its experiment.toml. Errors are
    controlled; slip velocities may fall to 1e-12 um/s and below. The records can be written as a new experiment, with noise.
    """
    from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
    from srfcli.tasks.simulate import simulate_work

    _check(given, experiment, output)
    warn_uncompiled("a simulation takes up to 34 times as long")
    work = own_record(system, given) if experiment is None else repeated_runs(system, experiment, given)
    begun = time.perf_counter()
    with Progress("simulate", total=len(work.jobs)) as progress:
        found = simulate_work(
            work, rtol=given["rtol"], progress=lambda name, done: progress.advance(int(done), note=name)
        )
    timings, table = {"simulate": time.perf_counter() - begun}, found.table
    folder = given["folder"]
    if folder is not None and output.out is None and output.format == "text":
        table = dataclasses.replace(table, columns=(), rows=())  # the records are in the folder
    emit(
        table,
        output,
        figure=found.plot,
        laws=work.model.laws,
        inputs=work.inputs,
        seed=work.gauge.seed,
        timings=timings,
    )
    if folder is not None:
        _write(work, found.records, found.status, folder, given, output, timings)
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
        raise SrfError(
            "--run chooses among the runs of an experiment, and none is given", "srf simulate DIR --run NAME"
        )
    if given["reader"] is not None and experiment is None and given["load_file"] is None:
        raise SrfError(
            "--format names the reader of a file, and none is read", "Give --load-file FILE or an experiment."
        )
    for one, other in EXCLUSIVE:
        if given[one] is not None and given[other] is not None:
            hint = f"Leave out {OWN_RECORD[one]} or {OWN_RECORD[other]}."
            raise SrfError(f"{OWN_RECORD[one]} and {OWN_RECORD[other]} exclude each other", hint)
    _check_folder(given, experiment, output)


def _check_folder(given: dict[str, Any], experiment: Path | None, output: OutputOptions) -> None:
    folder = given["folder"]
    if folder is None:
        for name, option, unset in (("start_values", "--start-values", "true"), ("free", "--free", None)):
            if given[name] != unset:
                raise SrfError(f"{option} is about an experiment that is written", "Name its folder: --out-dir DIR.")
        return
    from srfcli.data.writing import check_folder

    source = experiment and (experiment if experiment.is_dir() else experiment.parent)
    if source and folder.resolve() == source.resolve():
        raise SrfError(
            f"--out-dir {folder} is the experiment itself", "Recordings are never replaced; name another folder."
        )
    check_folder(folder, force=output.force)


def _write(
    work: Work,
    records: Sequence[Record],
    status: Status,
    folder: Path,
    given: dict[str, Any],
    output: OutputOptions,
    timings: dict[str, float],
) -> None:
    """Write the experiment folder and its sidecar; an unfinished one is not written, as nothing in it would say so."""
    from srfcli.data.writing import DESCRIPTION, write_experiment
    from srfcli.results.provenance import Provenance, sidecar, sidecar_path

    session = Session.current()
    if not status.ok:
        session.say(f"Not written: {folder}, as its records are not complete")
        return
    made = Provenance(session.arguments, work.parameters, work.model.laws, work.inputs, work.gauge.seed, timings)
    place = folder / DESCRIPTION
    files = write_experiment(
        work.experiment(records),
        folder,
        force=output.force,
        sidecar=(lambda content: sidecar(place, content, made)) if output.provenance else None,
    )
    if output.provenance:
        session.detail(f"Wrote {sidecar_path(place)}")
    session.say(f"Wrote {folder} ({len(files) - 1} run{'s' if len(files) != 2 else ''})")


# A new record: drive, load and sampling from the options.

REFERENCE = ("V0",)  # the velocity that mu0 refers to: not identifiable beside mu0
FACTOR = 5.0  # ratio of the bounds of a fit to the value
NAME = "simulated"


def own_record(system: SystemOptions, given: Mapping[str, Any]) -> Work:
    """Return the one record that the options describe; raises SrfError for what cannot be simulated or written."""
    model = system.model()
    resolved = system.resolve(model.parameters, **{name: given[name] for name in ("V", "W0", "eps")})
    values, (observable, *beside) = resolved.values, _observables(given["observable"])
    p = model.vector(values)
    model.check_changing_load(p)
    recorded, begin, span, found = _recorded_load(system, given["load_file"], given["reader"])
    pieces = _drive_pieces(given, values["V"], span)
    f = values["f"] if values["eps"] else None
    if given["rate"] is None:
        rates = (usual_rate(sum(p.duration for p in pieces), f),) * len(pieces)
    else:
        rates = parse_rates(given["rate"], len(pieces))
    t = sample_times(pieces, rates, begin)
    drive = build_drive(pieces, begin)
    base = recorded or _base_load(given, values["W0"], begin)
    load, modulation = _modulated(base, given["onset"], values, begin)
    load.check(float(t[0]), float(t[-1]))
    start = start_state(model, p, given["start"], drive=drive, load=load.rest(begin), begin=begin)
    job, mover = Job(NAME, p, drive, load, t, start, observable, f, modulation, beside=tuple(beside)), model
    if (track := read_track(given)) is not None:
        if system.loading.value != "vertical":
            raise SrfError(
                "a rough track is for a slider loaded from above", "Leave out --roughness or --loading inclined."
            )
        mover = system.model(tables=TABLES)
        job = on_track(model, mover, job, track, start=given["start"])
    gauge, others = read_gauges(given, [observable, *beside])
    described = _own_parameters(resolved, given) | track_parameters(track, given)
    noted, told = track_notes(track)
    chosen = _free(model, given["free"])
    spread = parse_spread(given["start_values"])
    if given["folder"] is not None and system.loading.value != "vertical":
        raise SrfError(
            "an experiment folder cannot say that the spring is inclined", "Leave out --out-dir or --loading."
        )

    def experiment(records: Sequence[Record]) -> Experiment:
        runs = tuple(simulated_run(mover, r, gauge, others) for r in records)
        fitted = fit_parameters(model, values, chosen)
        return _experiment(system, model, given["folder"], values, perturbed(fitted, spread, gauge.seed), runs)

    inputs = () if given["load_file"] is None else (given["load_file"],)
    notes = (*found, *noted, *_sampling_notes(rates, f, given, pieces))
    meta = {"rate_Hz": sorted(set(rates)), "rtol": given["rtol"], "onset": modulation and modulation[2], **told}
    taken = {"V": given["drive"], "W0": given["load"] or given["load_file"]}
    system.say_defaults(resolved, [name for name, program in taken.items() if program is None])
    return Work(mover, (job,), gauge, described, experiment, inputs, notes, meta, others)


def _observables(text: str | None) -> list[str]:
    from srfcli.tasks.simulate import check_observables

    return check_observables([name.strip() for name in (text or "elongation").split(",")])


def read_gauges(given: Mapping[str, Any], observables: Sequence[str]) -> tuple[Gauge, dict[str, Gauge]]:
    """Return the gauge of the first observable and those of the others, by name, that the options ask for.

    Sizes are in the observable's unit. Raises SrfError for what no gauge does.
    """
    from srfcli.data.noise import check_gauge
    from srfcli.data.values import BESIDE, OBSERVABLES

    sizes: dict[str, list[float]] = {}
    for name in ("noise", "quantum"):
        texts = ["0"] * len(observables) if given[name] is None else given[name].split(",")
        if len(texts) != len(observables):
            raise SrfError(
                f"--{name} {given[name]}: found {len(texts)}, expected one for each of {', '.join(observables)}",
                f"Write --{name} {','.join(['0.01'] * len(observables))}.",
            )
        units = [(OBSERVABLES | BESIDE)[observable] for observable in observables]
        sizes[name] = [parse_quantity(text, unit, name=f"--{name}") for text, unit in zip(texts, units, strict=True)]
    silent = any(sizes["noise"])  # a gauge without noise beside others; of none, a colour is told
    gauges = [
        Gauge(n, given["lag1"] if n or not silent else 0.0, q, given["seed"])
        for n, q in zip(*sizes.values(), strict=True)
    ]
    for gauge in gauges:
        check_gauge(noise=gauge.noise, lag1=gauge.lag1, quantum=gauge.quantum, seed=gauge.seed)
    return gauges[0], dict(zip(observables[1:], gauges[1:], strict=True))


def _drive_pieces(given: Mapping[str, Any], V: float, span: float | None) -> tuple[Piece, ...]:
    """Return the pieces of --drive, or one of constant velocity: as long as --for, the recorded load or --load, or 40 um."""
    if given["drive"] is not None:
        return parse_pieces(given["drive"], "um/s", option="--drive", example="0.5:12, 4:8")
    if given["duration"] is not None:
        duration = parse_quantity(given["duration"], "s", name="--for")
        if not 0 < duration <= LONGEST:
            raise SrfError(f"--for {duration:g} s is not a length of time", "Write --for 4.")
    elif span is not None:
        duration = span
    elif given["load"] is not None:
        duration = edges_of(_load_pieces(given), 0.0)[-1]
    else:
        duration = float(f"{TRAVEL / V:.3g}")
    return (Piece(duration, V, V),)


def _load_pieces(given: Mapping[str, Any]) -> tuple[Piece, ...]:
    return parse_pieces(given["load"], "N", option="--load", example="2:5, 0.2:5->7, 4:7")


def _recorded_load(
    system: SystemOptions, path: Path | None, reader: str | None
) -> tuple[Load | None, float, float | None, tuple[str, ...]]:
    """Return the load of --load-file, its first time, how long it is known, and what was found in it."""
    if path is None:
        return None, 0.0, None, ()
    from srfcli.data.imposed import read_load

    load, t, notices = read_load(path, registry=system.registry(), format=reader)
    return load, float(t[0]), float(t[-1] - t[0]), tuple(map(str, notices))


def _sampling_notes(
    rates: Sequence[float], f: float | None, given: Mapping[str, Any], pieces: Sequence[Piece]
) -> tuple[str, ...]:
    notes = []
    if f and min(rates) < 8 * f:
        notes.append(
            f"sampled {min(rates) / f:.2g} times a period of the modulation: from fewer than 8 the load is not read back"
        )
    if given["load"] is not None:
        length, total = (edges_of(made, 0.0)[-1] for made in (_load_pieces(given), pieces))
        if length < total * (1 - 1e-9):
            notes.append(f"--load ends at {length:g} s of {total:g} s; its last value holds on")
        elif length > total * (1 + 1e-9):
            notes.append(f"--load goes on to {length:g} s, the drive ends at {total:g} s; the rest is not simulated")
    return tuple(notes)


def _base_load(given: Mapping[str, Any], W0: float, begin: float) -> Load:
    from srfcli.motion.imposed import ConstantLoad, LoadSteps

    if given["load"] is None:
        return ConstantLoad(W0)
    pieces = _load_pieces(given)
    rise = parse_quantity(given["load_rise"], "s", name="--load-rise")
    return LoadSteps.sequence([(p.duration, p.first, p.last) for p in pieces], start=begin, rise=rise)


def _modulated(
    base: Load, onset: str | None, values: Mapping[str, float], begin: float
) -> tuple[Load, tuple[float, float, float] | None]:
    """Return the load with its modulation, if there is one, and that as (frequency, relative amplitude, onset)."""
    from srfcli.motion.imposed import ConstantLoad, ModulatedLoad, Modulation

    eps, f = values["eps"], values["f"]
    if not eps:
        if onset is not None:
            raise SrfError("--onset is given and nothing is modulated", "Give the amplitude, too: --eps 0.09.")
        return base, None
    since = begin if onset is None else parse_quantity(onset, "s", name="--onset")
    if since < begin:
        raise SrfError(
            f"--onset {since:g} s lies before the record, which begins at {begin:g} s",
            "Sliding is steady before the first sample: the modulation begins with it or later.",
        )
    if isinstance(base, ConstantLoad):
        return Modulation(base.W0, eps, f, onset=since), (f, eps, since)
    return ModulatedLoad(base, Modulation(1.0, eps, f, onset=since)), (f, eps, since)


def _own_parameters(resolved: Resolved, given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the parameters with their origin, but those in whose place a program stands."""
    replaced = {"V": given["drive"], "W0": given["load"] or given["load_file"]}
    described = resolved.described()
    for name, program in replaced.items():
        if program is not None:
            described[name] = {"value": str(program), "unit": "s:um/s" if name == "V" else "s:N", "origin": "flag"}
    return described


def _free(model: GeneratedModel, names: str | None) -> set[str]:
    """Return which parameters a fit of the written experiment is to find."""
    laws = [p.name for p in model.parameters if p.name not in APPARATUS]
    if names is None:
        return {name for name in laws if name not in REFERENCE}
    chosen = [name.strip() for name in names.split(",") if name.strip()]
    known = [*laws, *(name for name in ("K", "M") if name in model.names)]
    for name in chosen:
        if name not in known:
            raise SrfError(f"--free: {name!r} is no parameter of {model.title}", did_you_mean(name, known))
    return set(chosen)


def fit_parameters(model: GeneratedModel, values: Mapping[str, float], free: set[str]) -> tuple[FitParameter, ...]:
    """Return the laws' parameters at `values` (um, s, N) with bounds a factor of five around them; all but `free` are fixed."""
    from srfcli.data.values import FitParameter

    listed = [p for p in model.parameters if p.name not in APPARATUS or p.name in free]
    return tuple(
        FitParameter(p.name, values[p.name], *bounds(p, values[p.name]), fixed=p.name not in free, unit=p.unit)
        for p in listed
    )


def bounds(parameter: Parameter, value: float) -> tuple[float, float]:
    """Return the bounds of a fit around `value` (um, s, N), within the parameter's own."""
    from srfcli.core.units import to_base

    lower, upper = (to_base(b, parameter.unit) for b in (parameter.lower, parameter.upper))
    if value > 0:
        return max(lower, float(f"{value / FACTOR:.3g}")), min(upper, float(f"{value * FACTOR:.3g}"))
    reach = FACTOR * max(abs(value), 1.0)
    return (lower if math.isfinite(lower) else value - reach), (upper if math.isfinite(upper) else value + reach)


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


def perturbed(parameters: Sequence[FitParameter], spread: float, seed: int) -> tuple[FitParameter, ...]:
    """Return the free parameters off by a factor drawn evenly from 1 - spread to 1 + spread, within their bounds."""
    from srfcli.data.noise import generator

    rng = generator(seed, "start values")
    moved = []
    for p in parameters:
        factor = 1.0 + spread * rng.uniform(-1.0, 1.0)  # drawn for fixed ones, too: what is free changes no other value
        value = p.value if p.fixed or not spread else min(max(p.value * factor, p.lower), p.upper)
        moved.append(dataclasses.replace(p, value=value))
    return tuple(moved)


def _experiment(
    system: SystemOptions,
    model: GeneratedModel,
    folder: Path,
    values: Mapping[str, float],
    parameters: tuple[FitParameter, ...],
    runs: tuple[Any, ...],
) -> Experiment:
    from srfcli.data.values import Experiment, ModelChoice
    from srfcli.data.writing import stiffness_text

    names = {key: getattr(system, key).value for key in ("law", "ageing", "interface", "inertia")}
    for key in ("law", "ageing", "interface"):
        if names[key].endswith((".toml", ".py")):
            names[key] = str(Path(names[key]).resolve())  # a path relative to here means nothing in the folder
            Session.current().say(f"Note: the experiment names the file {names[key]}")
    mass = values.get("M") if names["inertia"] else None
    choice = ModelChoice(names["law"], names["ageing"], names["interface"], names["inertia"])
    return Experiment(
        folder, f"simulated with {model.title}", choice, mass, stiffness_text(values["K"]), parameters, runs, ()
    )


# The runs of an experiment: as they were driven, loaded and sampled, with any parameters and laws.

IMPOSED = ("V", "W0", "eps", "f")


def repeated_runs(system: SystemOptions, path: Path, given: Mapping[str, Any]) -> Work:
    """Return the runs of the experiment at `path`, to be simulated with its own values but for what flags set."""
    from srfcli.codegen.model import open_model
    from srfcli.data.experiment import read_experiment

    registry = system.registry()
    experiment = read_experiment(path, registry=registry, format=given["reader"])
    experiment.check_recorded("to simulate")
    choice = _choice(system, experiment.choice)
    model = open_model(registry, **dataclasses.asdict(choice))
    flags = _flags(system, model)
    runs = _chosen(experiment, given["runs"])
    observables = list(dict.fromkeys(tuple(s.observable for s in run.signals) for run in runs))
    if len(observables) > 1 and (given["noise"] or given["quantum"]):
        raise SrfError(
            f"the runs record {' and '.join(', '.join(names) for names in sorted(observables))}: one --noise has no unit for all",
            "Choose runs that record the same, with --run.",
        )
    gauge, others = read_gauges(given, observables[0])
    spread = parse_spread(given["start_values"])
    jobs, mover = tuple(_job(model, experiment, run, flags, given["start"]) for run in runs), model
    if (track := read_track(given)) is not None:
        mover = open_model(registry, **dataclasses.asdict(choice), tables=TABLES)
        jobs = tuple(on_track(model, mover, job, track, start=given["start"]) for job in jobs)

    def made(records: Sequence[Record]) -> Experiment:
        again = tuple(simulated_run(mover, r, gauge, others) for r in records)
        return _written(
            experiment, model, choice, flags, perturb=(spread, gauge.seed), runs=again, folder=given["folder"]
        )

    described = _run_parameters(model, experiment, flags) | track_parameters(track, given)
    noted, told = track_notes(track)
    inputs = (path / "experiment.toml" if path.is_dir() else path, *(run.file for run in runs))
    free = [run.name for run in runs if run.initial == "free"]
    notes = (f"initial state of {', '.join(free)} not known: begun in steady sliding",) if free else ()
    meta = {"title": experiment.title, "rtol": given["rtol"], **told}
    return Work(mover, jobs, gauge, described, made, inputs, (*notes, *noted), meta, others)


def _choice(system: SystemOptions, choice: ModelChoice) -> ModelChoice:
    """Return the laws: the experiment's, but for those that a flag names; srf.toml and the environment do not count here."""
    if system.loading.origin == "flag" and system.loading.value != "vertical":
        raise SrfError("the runs of an experiment are loaded from above", "Leave out --loading inclined.")
    named = {key: getattr(system, key) for key in ("law", "ageing", "interface", "inertia")}
    return dataclasses.replace(choice, **{k: s.value for k, s in named.items() if s.origin == "flag"})


def _flags(system: SystemOptions, model: GeneratedModel) -> dict[str, float]:
    """Return the parameters that --set, --K and --M give, in um, s, N."""
    from srfcli.core.settings import check_value, require_parameter
    from srfcli.core.units import to_base

    values = {}
    for name, text in system.flags.items():
        if name in IMPOSED:
            raise SrfError(f"{name} is what the runs impose", "An experiment says itself how it is driven and loaded.")
        parameter = require_parameter(name, model.parameters, where=model.title)
        values[name] = to_base(check_value(parameter, text), parameter.unit)
    return values


def _chosen(experiment: Experiment, names: Sequence[str]) -> tuple[Run, ...]:
    known = [run.name for run in experiment.runs]
    for name in names:
        if name not in known:
            raise SrfError(f"--run: no run {name!r} in {experiment.path}", did_you_mean(name, known))
    return tuple(run for run in experiment.runs if not names or run.name in names)


def _job(model: GeneratedModel, experiment: Experiment, run: Run, flags: Mapping[str, float], start: str) -> Job:
    begin = float(run.t[0])
    mass = {"M": experiment.mass} if experiment.mass and "M" in model.names else {}
    values = _values(model, experiment) | {"K": run.stiffness} | mass | _asked_by_effects(model, run) | dict(flags)
    p = model.vector(values | {n: v for n, v in experiment.elsewhere(run).items() if n in model.names})
    model.check_changing_load(p)
    try:
        state = start_state(model, p, start, drive=run.drive, load=run.load.rest(begin), begin=begin)
    except SrfError as error:
        raise SrfError(f"run {run.name!r}: {error.message}", error.hint) from error
    ripple = run.modulation[0] if run.modulation else None
    beside = tuple(signal.observable for signal in run.others)
    return Job(
        run.name, p, run.drive, run.load, run.t, state, run.observable, ripple, run.modulation, run, beside=beside
    )


def _asked_by_effects(model: GeneratedModel, run: Run) -> dict[str, float]:
    """Return where and when the run begins and how its load is modulated, of which effects make use."""
    if "begin" not in model.names:
        return {}
    from srfcli.inference.prediction import of_run

    return of_run(run)


def _values(model: GeneratedModel, experiment: Experiment) -> dict[str, float]:
    """Return what [parameters] gives the laws; stiffness and mass are the apparatus', whatever a fit starts from."""
    listed = {p.name: p.value for p in experiment.parameters}
    return {name: value for name, value in listed.items() if name in model.names and name not in ("K", "M")}


def _run_parameters(
    model: GeneratedModel, experiment: Experiment, flags: Mapping[str, float]
) -> dict[str, dict[str, Any]]:
    """Return name -> {value, unit, origin} of what does not change from run to run."""
    from srfcli.core.units import from_base, tidy

    listed, described = _values(model, experiment), {}
    if experiment.mass and "M" in model.names:
        listed["M"] = experiment.mass
    for p in model.parameters:
        if p.name in IMPOSED:
            continue
        origin = "flag" if p.name in flags else "experiment" if p.name in listed else "law default"
        value = flags.get(p.name, listed.get(p.name))
        shown: Any = p.default if value is None else tidy(from_base(value, p.unit))
        if p.name == "K" and origin != "flag":
            shown, origin = experiment.stiffness_text, "experiment"
        described[p.name] = {"value": shown, "unit": p.unit, "origin": origin}
    return described


def _written(
    experiment: Experiment,
    model: GeneratedModel,
    choice: ModelChoice,
    flags: Mapping[str, float],
    *,
    perturb: tuple[float, int],
    runs: tuple[Run, ...],
    folder: Path,
) -> Experiment:
    """Return the experiment with the simulated runs, its start values those of the simulation, or off them."""
    from srfcli.data.values import FitParameter
    from srfcli.data.writing import stiffness_text

    kept = [p for p in experiment.parameters if p.name in model.names]
    if dropped := [p.name for p in experiment.parameters if p.name not in model.names]:
        Session.current().say(f"Note: not written, as {choice.law} has no such parameter: {', '.join(dropped)}")
    listed = [_moved(p, flags.get(p.name)) for p in kept]
    known = {p.name for p in listed} | {"K", "M"}
    for p in model.parameters:
        if p.name in flags and p.name not in known:
            lower, upper = bounds(p, flags[p.name])
            listed.append(FitParameter(p.name, flags[p.name], lower, upper, fixed=True, unit=p.unit))
    return dataclasses.replace(
        experiment,
        path=folder,
        title=f"{experiment.title} (simulated)".strip(),
        choice=choice,
        mass=(flags.get("M", experiment.mass) if choice.inertia else None),
        stiffness_text=stiffness_text(flags["K"]) if "K" in flags else experiment.stiffness_text,
        parameters=perturbed(listed, *perturb),
        runs=runs,
        notices=(),
    )


def _moved(p: FitParameter, value: float | None) -> FitParameter:
    if value is None:
        return p
    unit = "N/um" if p.name == "K" else p.unit  # the unit of the stiffness that is written, too
    return dataclasses.replace(p, value=value, lower=min(p.lower, value), upper=max(p.upper, value), unit=unit)


# Reading of options: pieces of drive and load, sampling rates, the initial state.

MOST_SAMPLES = 10_000_000
FEW_SAMPLES, MANY_SAMPLES, USUAL_RATE = 1000, 100_000, 1000.0  # of the default of --rate: see `usual_rate`
TRAVEL = 40.0  # um of driving where no duration is given
LARGEST_VELOCITY = 1e9  # um/s
LONGEST = 1e12  # s


@dataclass(frozen=True)
class Piece:
    """A stretch of `duration` seconds over which a quantity runs straight from `first` to `last`."""

    duration: float
    first: float
    last: float


def parse_pieces(text: str, unit: str, *, option: str, example: str) -> tuple[Piece, ...]:
    """Return the pieces of '0.5:12, 4:8' or '1:5->7', values in `unit` unless one is written.

    Raises SrfError that names the option and the piece.
    """
    parts = [part.strip() for part in text.split(",")]
    if not any(parts):
        raise SrfError(f"{option} is empty", f"Write {option} '{example}'.")
    return tuple(_parse_piece(part, i + 1, unit, option, example) for i, part in enumerate(parts))


def _parse_piece(part: str, number: int, unit: str, option: str, example: str) -> Piece:
    where = f"{option}: piece {number}, {part!r},"
    duration_text, colon, values_text = part.partition(":")
    ends = [end.strip() for end in values_text.split("->")]
    if not colon or not duration_text.strip() or not all(ends) or len(ends) > 2:
        raise SrfError(f"{where} is not DURATION:VALUE or DURATION:FROM->TO", f"Write {option} '{example}'.")
    duration = parse_quantity(duration_text, "s", name=f"{option}: the duration of piece {number}")
    if not 0 < duration <= LONGEST:
        raise SrfError(f"{where} lasts {duration:g} s", f"Give each piece a duration above 0, up to {LONGEST:g} s.")
    split = [split_quantity(end, name=f"{option}: the value of piece {number}", example=f"5 {unit}") for end in ends]
    written = next((u for _, u in reversed(split) if u), unit)
    values = [convert(v, u or written, unit, name=f"{option}: piece {number}") for v, u in split]
    return Piece(duration, values[0], values[-1])


def edges_of(pieces: Sequence[Piece], start: float) -> list[float]:
    """Return the times (s) at which the pieces begin, and the time at which the last ends."""
    edges = [start]
    for piece in pieces:
        edges.append(edges[-1] + piece.duration)
    return edges


def build_drive(pieces: Sequence[Piece], start: float) -> Drive:
    """Return the driving velocity that the pieces (s, um/s) make, one after another from `start` on."""
    from srfcli.motion.imposed import Drive

    for number, piece in enumerate(pieces, 1):
        if max(abs(piece.first), abs(piece.last)) > LARGEST_VELOCITY:
            fastest = max(piece.first, piece.last, key=abs)
            raise SrfError(
                f"--drive: piece {number} drives at {fastest:g} um/s", f"Stay within {LARGEST_VELOCITY:g} um/s."
            )
    rates = tuple((p.last - p.first) / p.duration for p in pieces)
    return Drive(tuple(edges_of(pieces, start)[:-1]), tuple(p.first for p in pieces), rates)


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


def usual_rate(duration: float, frequency: float | None) -> float:
    """Return the sampling rate where none is given: 1, 2 or 5 times a power of ten, in Hz.

    1000 Hz, more for a record below a second and to see the modulation ten times a period, less beyond 100,000 samples.
    """
    wanted = max(USUAL_RATE, FEW_SAMPLES / duration, 10 * frequency if frequency else 0.0)
    if wanted * duration > MANY_SAMPLES:
        return _round_rate(MANY_SAMPLES / duration, up=False)
    return _round_rate(wanted, up=True)


def _round_rate(rate: float, *, up: bool) -> float:
    power = math.floor(math.log10(rate))
    steps = [float(f"{m}e{power}") for m in (1, 2, 5, 10)]
    if up:
        return next((s for s in steps if s >= rate * (1 - 1e-12)), steps[-1])
    return next((s for s in reversed(steps) if s <= rate * (1 + 1e-12)), steps[0])


def sample_times(pieces: Sequence[Piece], rates: Sequence[float], start: float) -> Array:
    """Return the times (s) of the samples, the first at `start`, the last at or just before the end of the last piece.

    Raises SrfError where they are fewer than two or more than ten million.
    """
    import numpy as np

    total = sum(p.duration * rate for p, rate in zip(pieces, rates, strict=True))
    if total > MOST_SAMPLES:
        size = f"{total:.3g} samples, {total * 64 / 1e9:.2g} GB"
        raise SrfError(f"--rate asks for {size}; {MOST_SAMPLES:.0e} is the limit", "Lower --rate, or split the record.")
    if total < 1:
        raise SrfError(
            f"--rate gives only one sample in {sum(p.duration for p in pieces):g} s",
            f"Raise it: --rate {_round_rate(10 / sum(p.duration for p in pieces), up=True):g}.",
        )
    edges = edges_of(pieces, start)
    blocks = []
    for a, b, rate in zip(edges[:-1], edges[1:], rates, strict=True):
        steps = np.arange(math.floor((b - a) * rate * (1 + 1e-12)) + 1)
        times = a + steps / rate
        blocks.append(times[times < b - 1e-9 / rate] if b != edges[-1] else np.minimum(times, b))
    digits = 15 - math.ceil(math.log10(max(abs(edges[0]), abs(edges[-1]))))  # 0.507, not 0.5070000000000001
    return np.unique(np.round(np.concatenate(blocks), min(12, max(digits, 0))))


def start_state(model: GeneratedModel, p: Array, text: str, *, drive: Drive, load: float, begin: float) -> Array | None:
    """Return the state (n,) that --start names, None for steady sliding at the drive's first velocity.

    'steady', a velocity at which sliding was steady, or values such as 'v=1e-3, phi=100 s' over those of steady sliding.
    `load` (N) is the load at rest at the time `begin` (s). Raises SrfError where the drive does not move at first.
    """
    import numpy as np

    q = np.array(p, dtype=float)
    q[model.index("W0")] = load
    first = float(drive(np.array([begin]))[0])
    if text.strip().lower() == "steady":
        if first <= 0:
            moving = next((v for v in drive.velocities if v > 0), 10.0)
            raise SrfError(
                f"the drive begins at {first:g} um/s: there is no steady sliding to start from",
                f"Say what went before: --start {moving:g} for steady sliding at {moving:g} um/s, "
                "or begin --drive with a piece that moves.",
            )
        return None
    if "=" not in text:
        q[model.index("V")] = _start_velocity(text)
        return np.asarray(model.steady(q), dtype=float)
    q[model.index("V")] = next((v for v in (first, *drive.velocities) if v > 0), 10.0)
    return _with_values(model, np.array(model.steady(q), dtype=float), text)


def _start_velocity(text: str) -> float:
    try:
        V = parse_quantity(text, "um/s", name="--start")
    except SrfError as error:
        raise SrfError(f"--start {text!r} is neither steady, nor a velocity, nor values", error.hint) from error
    if not 1e-12 <= V <= LARGEST_VELOCITY:
        raise SrfError(
            f"--start {text}: sliding is steady from 1e-12 to {LARGEST_VELOCITY:g} um/s", "Write --start 10."
        )
    return V


def _with_values(model: GeneratedModel, x: Array, text: str) -> Array:
    plain = [name.removeprefix("ln_") for name in model.states]
    for part in text.split(","):
        name, _, value = (word.strip() for word in part.partition("="))
        if name not in plain:
            raise SrfError(f"--start: {name!r} is no state of {model.title}", did_you_mean(name, plain))
        unit = {"u": "um", "z": "um/s", "v": "um/s"}.get(name, "s")
        number, i = parse_quantity(value, unit, name=f"--start: {name}"), plain.index(name)
        if model.logarithmic[i] and not number > 0:
            raise SrfError(f"--start: {name} = {number:g} {unit} is not above 0", f"Write --start {name}=1e-6.")
        x[i] = math.log(number) if model.logarithmic[i] else number
    return x


# The random friction field along slip (--roughness), and records simulated with it.

TABLES = (("mu", "slip"),)  # a table over slip is added to the friction coefficient
LENGTH = 10.0  # um, the correlation length where only a size is given
LARGEST_ROUGHNESS = 0.5  # of mu0: above it the friction coefficient may become negative


def read_track(given: Mapping[str, Any]) -> RoughTrack | None:
    """Return the random field that --roughness, --roughness-length and --seed describe; None without one."""
    if given["roughness"] is None:
        if given["roughness_length"] is not None:
            raise SrfError("--roughness-length is given and the track is smooth", "Give the size: --roughness 3e-4.")
        return None
    from srfcli.data.noise import RoughTrack

    size = parse_quantity(given["roughness"], "1", name="--roughness")
    length = parse_quantity(given["roughness_length"] or str(LENGTH), "um", name="--roughness-length")
    track = RoughTrack(size, length, given["seed"])
    return track if track.size else None


def on_track(plain: GeneratedModel, rough: GeneratedModel, job: Job, track: RoughTrack, *, start: str) -> Job:
    """Return the job of the model `plain` as one of `rough`, the same with TABLES, on the part of the track that it covers.

    Positions are slip from where the run begins; runs that begin at the same place find the same track there. `start` is as
    --start has it. Raises SrfError for a roughness that the friction coefficient does not allow.
    """
    from srfcli.codegen.splines import appended

    begin = float(job.t[0])
    place = job.run.start if job.run is not None else 0.0
    p = rough.vector(dict(zip(plain.names, job.p.tolist(), strict=True)) | {"start": place, "begin": begin})
    load = job.load.rest(begin)
    _check_size(plain, job, track)
    table = track.spline(place, place + _reach(plain, job))
    state = start_state(rough, appended(p, [table]), start, drive=job.drive, load=load, begin=begin)
    return dataclasses.replace(job, p=p, start=state, tables=(table,))


def _check_size(model: GeneratedModel, job: Job, track: RoughTrack) -> None:
    if "mu0" not in model.names:
        return
    mu0 = float(job.p[model.index("mu0")])
    if not track.size <= LARGEST_ROUGHNESS * mu0:
        raise SrfError(
            f"--roughness {track.size:g} is more than half of mu0 = {mu0:g}",
            "It is the standard deviation of mu0 along the track, such as 3e-4.",
        )


def _reach(model: GeneratedModel, job: Job) -> float:
    """Return how far (um) the slider may slip: what is driven, what the spring holds at first, and what it swings beyond."""
    import numpy as np

    begin, end = float(job.t[0]), float(job.t[-1])
    times = np.unique([*job.t.tolist(), *(b for b in job.drive.breaks if begin < b < end)])
    driven = np.cumsum(job.drive(0.5 * (times[1:] + times[:-1])) * np.diff(times))  # V is linear in between
    held = 0.0
    if job.start is not None and "u" in model.states:
        held = abs(float(job.start[model.states.index("u")]))
    # a spring that friction holds is drawn by less than 1.5 W/K, and swings back by less than it was drawn
    drawn = 3.0 * float(job.load(job.t)[0].max()) / float(job.p[model.index("K")])
    return max(float(driven.max()), 0.0) + 2 * held + drawn


def track_parameters(track: RoughTrack | None, given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the field's amplitude and correlation length as described parameters; nothing without a field."""
    if track is None:
        return {}
    origin = "default" if given["roughness_length"] is None else "flag"
    return {
        "roughness": {"value": track.size, "unit": "1", "origin": "flag"},
        "roughness_length": {"value": track.length, "unit": "um", "origin": origin},
    }


def track_notes(track: RoughTrack | None) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the note on the field and its entry in `meta`, as in the result of `srf fit`; nothing without a field."""
    if track is None:
        return (), {}
    note = f"track: mu0 wanders by {track.size:g} (standard deviation) over {track.length:g} um"
    return (note,), {"track": {"amplitude": track.size, "length_um": track.length}}
