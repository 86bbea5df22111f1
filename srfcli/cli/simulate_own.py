"""A record of one's own for `srf simulate`: drive, load and sampling from the options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli.cli.options import Session, SystemOptions
from srfcli.cli.programs import (
    LONGEST,
    TRAVEL,
    Piece,
    build_drive,
    edges_of,
    parse_pieces,
    parse_rates,
    sample_times,
    start_state,
    usual_rate,
)
from srfcli.cli.simulate_track import TABLES, on_track, read_track, track_parameters, track_told
from srfcli.errors import SrfError, did_you_mean
from srfcli.results.simulation import UNITS, Job, Record, Work, read_gauge, simulated_run
from srfcli.units import parse_quantity

if TYPE_CHECKING:
    from srfcli.laws import Parameter
    from srfcli.model import GeneratedModel
    from srfcli.numerics.program import Load
    from srfcli.recording.track import RoughTrack
    from srfcli.recording.values import Experiment, FitParameter
    from srfcli.settings import Resolved

DRIVE_EXAMPLE, LOAD_EXAMPLE = "0.5:12, 4:8", "2:5, 0.2:5->7, 4:7"
APPARATUS = ("V", "W0", "eps", "f", "K", "M", "angle")
REFERENCE = ("V0",)  # a velocity that mu0 refers to: no record tells the two apart
FACTOR = 5.0  # bounds of a fit lie so far from a value
NAME = "simulated"


def own_record(system: SystemOptions, given: Mapping[str, Any]) -> Work:
    """Return the one record that the options describe; raises SrfError for what cannot be simulated or written."""
    model = system.model()
    resolved = system.resolve(model.parameters, **{name: given[name] for name in ("V", "W0", "eps")})
    values, observable = resolved.values, given["observable"] or "elongation"
    p = model.vector(values)
    model.check_changing_load(p)
    recorded, begin, span, found = _recorded_load(system, given["load_file"], given["reader"])
    pieces = _drive_pieces(given, values["V"], span)
    f = values["f"] if values["eps"] else None
    rates = _rates(given["rate"], pieces, f)
    t = sample_times(pieces, rates, begin)
    drive = build_drive(pieces, begin)
    base = recorded or _base_load(given, values["W0"], begin)
    load, modulation = _modulated(base, given["onset"], values, begin)
    load.check(float(t[0]), float(t[-1]))
    start = start_state(model, p, given["start"], drive=drive, load=load.rest(begin), begin=begin)
    job, mover = Job(NAME, p, drive, load, t, start, observable, f, modulation), model
    if (track := _track(system, given)) is not None:
        mover = system.model(tables=TABLES)
        job = on_track(model, mover, job, track, start=given["start"])
    gauge = read_gauge(given, UNITS[observable])
    described = _described(resolved, given) | track_parameters(track, given)
    noted, told = track_told(track)
    chosen = _free(model, given["free"])
    spread = parse_spread(given["start_values"])
    if given["folder"] is not None and system.loading.value != "vertical":
        raise SrfError(
            "an experiment folder cannot say that the spring is inclined", "Leave out --out-dir or --loading."
        )

    def experiment(records: Sequence[Record]) -> Experiment:
        runs = tuple(simulated_run(mover, r, quantum=gauge.quantum) for r in records)
        fitted = fit_parameters(model, values, chosen)
        return _experiment(system, model, given["folder"], values, perturbed(fitted, spread, gauge.seed), runs)

    inputs = () if given["load_file"] is None else (given["load_file"],)
    notes = (*found, *noted, *_sampling_notes(rates, f, given, pieces))
    meta = {"rate_Hz": sorted(set(rates)), "rtol": given["rtol"], "onset": modulation and modulation[2], **told}
    taken = {"V": given["drive"], "W0": given["load"] or given["load_file"]}
    system.say_defaults(resolved, [name for name, program in taken.items() if program is None])
    return Work(mover, (job,), gauge, described, experiment, inputs, notes, meta)


def _track(system: SystemOptions, given: Mapping[str, Any]) -> RoughTrack | None:
    track = read_track(given)
    if track is not None and system.loading.value != "vertical":
        raise SrfError(
            "a rough track is for a slider loaded from above", "Leave out --roughness or --loading inclined."
        )
    return track


def _drive_pieces(given: Mapping[str, Any], V: float, span: float | None) -> tuple[Piece, ...]:
    """Return the pieces of --drive, or one of constant velocity: as long as --for, the recorded load or --load, or 40 um."""
    if given["drive"] is not None:
        return parse_pieces(given["drive"], "um/s", option="--drive", example=DRIVE_EXAMPLE)
    if given["duration"] is not None:
        duration = parse_quantity(given["duration"], "s", name="--for")
        if not 0 < duration <= LONGEST:
            raise SrfError(f"--for {duration:g} s is not a length of time", "Write --for 4.")
    elif span is not None:
        duration = span
    elif given["load"] is not None:
        pieces = parse_pieces(given["load"], "N", option="--load", example=LOAD_EXAMPLE)
        duration = edges_of(pieces, 0.0)[-1]
    else:
        duration = float(f"{TRAVEL / V:.3g}")
    return (Piece(duration, V, V),)


def _recorded_load(
    system: SystemOptions, path: Path | None, reader: str | None
) -> tuple[Load | None, float, float | None, tuple[str, ...]]:
    """Return the load of --load-file, its first time, how long it is known, and what was found in it."""
    if path is None:
        return None, 0.0, None, ()
    from srfcli.recording.loadfile import read_load

    load, t, notices = read_load(path, registry=system.registry(), format=reader)
    return load, float(t[0]), float(t[-1] - t[0]), tuple(map(str, notices))


def _rates(text: str | None, pieces: Sequence[Piece], f: float | None) -> tuple[float, ...]:
    if text is not None:
        return parse_rates(text, len(pieces))
    return (usual_rate(sum(p.duration for p in pieces), f),) * len(pieces)


def _sampling_notes(
    rates: Sequence[float], f: float | None, given: Mapping[str, Any], pieces: Sequence[Piece]
) -> tuple[str, ...]:
    notes = []
    if f and min(rates) < 8 * f:
        notes.append(
            f"sampled {min(rates) / f:.2g} times a period of the modulation: from fewer than 8 the load is not read back"
        )
    if given["load"] is not None:
        length = edges_of(parse_pieces(given["load"], "N", option="--load", example=LOAD_EXAMPLE), 0.0)[-1]
        total = edges_of(pieces, 0.0)[-1]
        if length < total * (1 - 1e-9):
            notes.append(f"--load ends at {length:g} s of {total:g} s; its last value holds on")
        elif length > total * (1 + 1e-9):
            notes.append(f"--load goes on to {length:g} s, the drive ends at {total:g} s; the rest is not simulated")
    return tuple(notes)


def _base_load(given: Mapping[str, Any], W0: float, begin: float) -> Load:
    from srfcli.numerics.loads import LoadSteps
    from srfcli.numerics.program import ConstantLoad

    if given["load"] is None:
        return ConstantLoad(W0)
    pieces = parse_pieces(given["load"], "N", option="--load", example=LOAD_EXAMPLE)
    rise = parse_quantity(given["load_rise"], "s", name="--load-rise")
    return LoadSteps.sequence([(p.duration, p.first, p.last) for p in pieces], start=begin, rise=rise)


def _modulated(
    base: Load, onset: str | None, values: Mapping[str, float], begin: float
) -> tuple[Load, tuple[float, float, float] | None]:
    """Return the load with its modulation, if there is one, and that as (frequency, relative amplitude, onset)."""
    from srfcli.numerics.loads import ModulatedLoad
    from srfcli.numerics.program import ConstantLoad, Modulation

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


def _described(resolved: Resolved, given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
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
    from srfcli.recording.values import FitParameter

    listed = [p for p in model.parameters if p.name not in APPARATUS or p.name in free]
    return tuple(
        FitParameter(p.name, values[p.name], *bounds(p, values[p.name]), fixed=p.name not in free, unit=p.unit)
        for p in listed
    )


def bounds(parameter: Parameter, value: float) -> tuple[float, float]:
    """Return the bounds of a fit around `value` (um, s, N), within the parameter's own."""
    import math

    from srfcli.units import to_base

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
    import dataclasses

    from srfcli.recording.synthetic import generator

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
    from srfcli.recording.values import Experiment, ModelChoice
    from srfcli.recording.writing import stiffness_text

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
