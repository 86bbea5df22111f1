"""The runs of an experiment for `srf simulate`: as they were driven, loaded and sampled, with any parameters and laws."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli.cli.options import Session, SystemOptions
from srfcli.cli.programs import start_state
from srfcli.cli.simulate_own import bounds, parse_spread, perturbed
from srfcli.cli.simulate_track import TABLES, on_track, read_track, track_parameters, track_told
from srfcli.errors import SrfError, did_you_mean
from srfcli.results.simulation import UNITS, Job, Record, Work, read_gauge, simulated_run

if TYPE_CHECKING:
    from srfcli.model import GeneratedModel
    from srfcli.recording.values import Experiment, FitParameter, ModelChoice, Run
    from srfcli.registry import Registry

IMPOSED = ("V", "W0", "eps", "f")


def repeated_runs(system: SystemOptions, path: Path, given: Mapping[str, Any]) -> Work:
    """Return the runs of the experiment at `path`, to be simulated with its own values but for what flags set."""
    from srfcli.recording.experiment import read_experiment

    registry = system.registry()
    experiment = read_experiment(path, registry=registry, format=given["reader"])
    choice = _choice(system, experiment.choice)
    model = _open(registry, choice)
    flags = _flags(system, model)
    runs = _chosen(experiment, given["runs"])
    observables = sorted({run.observable for run in runs})
    if len(observables) > 1 and (given["noise"] or given["quantum"]):
        raise SrfError(
            f"the runs record {' and '.join(observables)}: one --noise has no unit for all",
            "Choose runs that record the same, with --run.",
        )
    gauge = read_gauge(given, UNITS[runs[0].observable])
    spread = parse_spread(given["start_values"])
    jobs, mover = tuple(_job(model, experiment, run, flags, given["start"]) for run in runs), model
    if (track := read_track(given)) is not None:
        mover = _open(registry, choice, tables=TABLES)
        jobs = tuple(on_track(model, mover, job, track, start=given["start"]) for job in jobs)

    def made(records: Sequence[Record]) -> Experiment:
        again = tuple(simulated_run(mover, r, quantum=gauge.quantum) for r in records)
        return _written(
            experiment, model, choice, flags, perturb=(spread, gauge.seed), runs=again, folder=given["folder"]
        )

    described = _described(model, experiment, flags) | track_parameters(track, given)
    noted, told = track_told(track)
    inputs = (_description_file(path), *(run.file for run in runs))
    free = [run.name for run in runs if run.initial == "free"]
    notes = (f"initial state of {', '.join(free)} not known: begun in steady sliding",) if free else ()
    meta = {"title": experiment.title, "rtol": given["rtol"], **told}
    return Work(mover, jobs, gauge, described, made, inputs, (*notes, *noted), meta)


def _choice(system: SystemOptions, choice: ModelChoice) -> ModelChoice:
    """Return the laws: the experiment's, but for those that a flag names; srf.toml and the environment do not count here."""
    if system.loading.origin == "flag" and system.loading.value != "vertical":
        raise SrfError("the runs of an experiment are loaded from above", "Leave out --loading inclined.")
    named = {key: getattr(system, key) for key in ("law", "ageing", "interface", "inertia")}
    return dataclasses.replace(choice, **{k: s.value for k, s in named.items() if s.origin == "flag"})


def _open(registry: Registry, choice: ModelChoice, *, tables: Sequence[tuple[str, str]] = ()) -> GeneratedModel:
    from srfcli.model import open_model

    return open_model(
        registry,
        law=choice.law,
        ageing=choice.ageing,
        interface=choice.interface,
        inertia=choice.inertia,
        effects=choice.effects,
        tables=tables,
    )


def _flags(system: SystemOptions, model: GeneratedModel) -> dict[str, float]:
    """Return the parameters that --set, --K and --M give, in um, s, N."""
    from srfcli.settings import check_value, require_parameter
    from srfcli.units import to_base

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
    p = model.vector(values)
    model.check_changing_load(p)
    try:
        state = start_state(model, p, start, drive=run.drive, load=run.load.rest(begin), begin=begin)
    except SrfError as error:
        raise SrfError(f"run {run.name!r}: {error.message}", error.hint) from error
    ripple = run.modulation[0] if run.modulation else None
    return Job(run.name, p, run.drive, run.load, run.t, state, run.observable, ripple, run.modulation, run)


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


def _described(model: GeneratedModel, experiment: Experiment, flags: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Return name -> {value, unit, origin} of what does not change from run to run."""
    from srfcli.units import from_base, tidy

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
    from srfcli.recording.values import FitParameter
    from srfcli.recording.writing import stiffness_text

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


def _description_file(path: Path) -> Path:
    return path / "experiment.toml" if path.is_dir() else path
