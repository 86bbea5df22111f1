"""An experiment, read and validated: its model and parameters, its runs, and what is found in the data of each."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from srfcli.codegen.model import Array
from srfcli.core.errors import Notice, SrfError, did_you_mean
from srfcli.core.settings import Parameter
from srfcli.core.toml import Node
from srfcli.core.units import NO_GEOMETRY, Geometry, is_stress, same_dimension, split_quantity, to_base
from srfcli.data.clock import Mask, Place, Sampling, find_sampling, kept_samples, sampling_notices
from srfcli.data.columns import MOST_BYTES, Columns, open_source, read_columns
from srfcli.data.description import Apparatus, Description, RunDescription, ThresholdsDescription, read_description
from srfcli.data.gauge import COLOUR_SAMPLES, GaugeNoise, find_noise
from srfcli.data.groups import BY, GAUGE_NOISE, TRENDS, grouped
from srfcli.data.imposed import ACCIDENTS, LOADS, FoundModulation, check_start, drive_of, find_modulation, load_of
from srfcli.data.noise import WIDEST_SPIKE, observable_jumps, quantisation, saturation, spikes, white_level
from srfcli.data.scales import own_bounds
from srfcli.data.thresholds import read_thresholds
from srfcli.data.values import (
    OBSERVABLES,
    OTHER_OBSERVABLES,
    CriticalLoads,
    Experiment,
    FitParameter,
    ModelChoice,
    Run,
    Signal,
    per_elongation,
)
from srfcli.laws.registry import Registry, chosen_instead
from srfcli.laws.values import Effect
from srfcli.motion.imposed import Load, runs_of


def read_experiment(
    path: Path, *, registry: Registry, format: str | None = None, holdout: bool = True, limit: int = MOST_BYTES
) -> Experiment:
    """Return the experiment in the folder or TOML file `path`, every value checked, in um, s, N.

    `format` names the reader of all data files; `holdout=False` leaves held-out runs out and their files unopened; `limit` is
    how many bytes of needed columns one run may hold. A breach raises SrfError with file, line or column, what was found and
    what was expected; what is odd but can be handled is in the notices.
    """
    described = read_description(Path(path))
    choice, known = read_choice(described.model, described.apparatus, registry)
    parameters, notices = read_parameters(described.parameters, known, choice, described.apparatus.geometry)
    chosen = [run for run in described.runs if holdout or not run.holdout]
    runs = tuple(read_run(run, described, registry=registry, format=format, limit=limit) for run in chosen)
    tables = tuple(_read_table(one) for one in described.thresholds if holdout or not one.holdout)
    notices += tuple(Notice("sigma", t.name, text) for t in tables for text in t.table.notes)
    if choice.effects and (runs or tables):
        from srfcli.symbolic.system import apart  # only for a description that has effects

        own = apart([e for e in (registry.get("effect", name) for name in choice.effects) if isinstance(e, Effect)])
        stated = described.parameters.value if described.parameters is not None else {}
        silent = [p for e in own for p in e.parameters if p.name not in stated and p.name not in e.fixed]
        if silent:
            values = ", ".join(f"{p.name} = {p.default:g}" + (f" {p.unit}" if p.unit != "1" else "") for p in silent)
            what = f"not listed, and so fixed: {values}; list them, as in {silent[0].name} = {{}}, to fit them"
            notices += (Notice("start-value", f"{described.path.name}: [parameters]", what),)
        parameters = own_bounds(parameters, own, runs, stated, tables)
    apparatus, model = described.apparatus, described.model
    found = Experiment(
        described.path, described.title, choice, apparatus.mass, apparatus.text, parameters, runs, notices, apparatus.stated,
        trend=model.read("trend", lambda trend: trend.choice(TRENDS), None), thresholds=tables,
    )  # fmt: skip
    vary = model.read("vary", lambda listed: listed.items("parameters", 'Write vary = ["mu0"].'), [])
    for entry in vary:
        name, _, way = entry.text().partition(":")
        if name not in (free := [*(q.name for q in parameters), GAUGE_NOISE]):
            entry.fail(f"'{name}' is to vary, and is not in [parameters]", did_you_mean(name, free))
        if way and way not in BY:
            entry.fail(f"'{way}' is nothing that {name} may vary with", did_you_mean(way, BY))
    found = grouped(found, [entry.text() for entry in vary], model.read("by", lambda by: by.choice(BY), "run"))
    names = dict.fromkeys([*(run.name for run in described.runs), *(run.name for run in found.runs)])
    for q in found.parameters:
        for i, name in enumerate(q.runs):
            if name not in names and described.parameters is not None:
                at = described.parameters.child(q.name).child("runs").child(i)
                at.fail(f"there is no run '{name}'", did_you_mean(name, names))
    return found


def _read_table(described: ThresholdsDescription) -> CriticalLoads:
    """Return the table of critical loads in a description's file."""
    if not described.file.exists():
        described.node.child("file").fail(f"no file {described.file}", "Its path is relative to the experiment's folder.")
    table = read_thresholds(described.file)
    if described.frequency is None and table.eps.max() > 0:
        line = table.lines[int(np.argmax(table.eps > 0))]
        described.node.fail(
            f"line {line} of {described.file.name} has a modulated load, and its frequency is not said",
            "Write frequency = 120.0, in Hz.",
        )
    return CriticalLoads(described.name, described.file, described.holdout, described.frequency or 1.0, table)


# The model of an experiment and its parameters, checked against the laws.

_IMPOSED = {
    "V": "The drive of each run says it.", **dict.fromkeys(("W0", "eps", "f"), "The load of each run says it."),
    "angle": "Experiments have the load imposed vertically.",
}  # fmt: skip


def read_choice(node: Node, apparatus: Apparatus, registry: Registry) -> tuple[ModelChoice, tuple[Parameter, ...]]:
    """Return the chosen model and all parameters that its laws and the apparatus have, in declared units."""
    node.keys(("law", "ageing", "interface", "inertia", "effects", "vary", "by", "trend"))
    law = node.require("law", 'Name a friction law: law = "srf-vsat"; `srf laws` lists them.')
    ageing = node.require("ageing", 'Name an ageing law: ageing = "dieterich"; `srf laws` lists them.')
    interface, inertia = node.get("interface"), node.get("inertia")
    names = [_place(law.text(), node), "+".join(_place(word, node) for word in ageing.text().split("+"))]
    surface = _place(interface.text(), node) if interface else "elastic"
    parameters: list[Parameter] = []
    with law.blamed():
        parameters += registry.parameters("friction", names[0])
    with ageing.blamed():
        parameters += registry.ageing_parameters(names[1])
    with (interface or node).blamed():
        parameters += registry.parameters("interface", surface)
    moving = apparatus.mass is not None
    if inertia and inertia.boolean() and not moving:
        inertia.fail("inertia without a mass", 'Give [apparatus] mass = "2.37 kg", or inertia = false.')
    heavy = inertia.boolean() if inertia else moving
    parameters.append(Parameter("K", apparatus.stiffness, apparatus.unit, 0.0, math.inf, "stiffness"))
    if heavy and apparatus.mass is not None:
        parameters.append(Parameter("M", apparatus.mass * 1e6, "kg", 0.0, math.inf, "mass"))
    effects = node.get("effects")
    added, own = read_effects(effects, registry) if effects else ((), ())
    return ModelChoice(names[0], names[1], surface, heavy, added), (*parameters, *own)


def read_effects(node: Node, registry: Registry) -> tuple[tuple[str, ...], tuple[Parameter, ...]]:
    """Return the effects that a model has besides its laws, as `open_model` names them, and their parameters."""
    from srfcli.symbolic.system import apart, in_a_model  # only for a description that has effects

    names, found = [], []
    hint = 'Write effects = ["load-transmission"]; `srf laws --kind effect` lists them.'
    for entry in node.items("effects", hint):
        name = _place(entry.text(), node)
        if name in names:
            entry.fail(f"'{name}' is named twice", "Once is enough.")
        with entry.blamed():
            effect = registry.get("effect", name)
        assert isinstance(effect, Effect)
        if instead := chosen_instead(effect, " in [model]", " in [apparatus]"):
            entry.fail(f"'{effect.name}' only replaces what the description says itself", f"Write {', '.join(instead)}.")
        names.append(name)
        found.append(effect)
    return tuple(names), tuple(p for effect in apart(found) for p in in_a_model(effect))


def _place(name: str, node: Node) -> str:
    """Return a law's name; that of a file is relative to the description."""
    word = name.strip()
    if not word.endswith((".toml", ".py")) or Path(word).is_absolute():
        return word
    return str(node.file.parent / word)


def read_parameters(
    node: Node | None, known: tuple[Parameter, ...], choice: ModelChoice, geometry: Geometry = NO_GEOMETRY
) -> tuple[tuple[FitParameter, ...], tuple[Notice, ...]]:
    """Return the listed parameters in um, s, N, and what is odd about them."""
    if node is None:
        return (), ()
    declared = {p.name: p for p in known}
    found, notices = [], []
    for name in node.value:
        entry = node.child(name)
        if name == "M" and name not in declared:
            entry.fail("there is no mass to fit", "Give [apparatus] a mass, and inertia = true.")
        if name not in declared:
            laws = f"{choice.law}, {choice.ageing}, {choice.interface}"
            entry.fail(f"unknown parameter '{name}' of {laws}", _IMPOSED.get(name) or did_you_mean(name, declared))
        parameter = _parameter(entry, declared[name], geometry if name == "K" else NO_GEOMETRY)
        own = to_base(declared[name].default, declared[name].unit)
        if name in ("K", "M") and not math.isclose(parameter.value, own, rel_tol=1e-9):
            what = f"{name} starts from another value than [apparatus] gives; a simulation uses the apparatus"
            notices.append(Notice("start-value", entry.where, what))
        found.append(parameter)
    return tuple(found), tuple(notices)


def _parameter(entry: Node, parameter: Parameter, geometry: Geometry) -> FitParameter:
    entry.table(f"{parameter.name} = {{ value = {parameter.default:g}, lower = ..., upper = ... }}.")
    entry.keys(("value", "lower", "upper", "fixed", "runs", "elsewhere"))
    held = entry.read("fixed", Node.boolean, False)
    numbers = {
        key: _stated(entry.child(key), parameter, geometry) if key in entry.value else default
        for key, default in (("value", parameter.default), ("lower", parameter.lower), ("upper", parameter.upper))
    }
    value, lower, upper = numbers["value"], numbers["lower"], numbers["upper"]
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    for key in ("lower", "upper", "value"):
        if key in entry.value and not parameter.lower <= numbers[key] <= parameter.upper:
            entry.child(key).fail(
                f"{numbers[key]:g}{unit} is outside the bounds of the law's own parameter {parameter.name}",
                f"Choose it from {parameter.lower:g} to {parameter.upper:g}{unit}.",
            )
    if not lower < upper:
        key = "lower" if "lower" in entry.value else "upper"
        entry.child(key).fail(f"lower = {lower:g}{unit} is not below upper = {upper:g}{unit}", "Give two bounds that rise.")
    if not lower <= value <= upper:
        (entry.child("value") if "value" in entry.value else entry).fail(
            f"value = {value:g}{unit} is outside its bounds [{lower:g}, {upper:g}]{unit}", "Change it or the bounds."
        )
    factor = to_base(1.0, parameter.unit)
    runs, elsewhere = _acting(entry, parameter, geometry)
    return FitParameter(
        parameter.name, value * factor, lower * factor, upper * factor, held, parameter.unit, runs, elsewhere * factor
    )


def _acting(entry: Node, parameter: Parameter, geometry: Geometry) -> tuple[tuple[str, ...], float]:
    """Return the runs in which a parameter acts, none for all of them, and what it is in the others, in its declared unit."""
    listed, other = entry.get("runs"), entry.get("elsewhere")
    if listed is None:
        if other is not None:
            other.fail("it acts in all runs", 'Name those where it does: runs = ["slow"], or leave elsewhere out.')
        return (), 0.0
    runs = listed.items("runs", 'Write runs = ["slow"].', fewest=1)
    if parameter.name in ("K", "M"):
        listed.fail(f"{parameter.name} is the apparatus', and no run's own", "Leave runs out.")
    if other is None:
        entry.fail(f"nothing says what {parameter.name} is in the other runs", "Write elsewhere = 0, or what it is there.")
    return tuple(run.text() for run in runs), _stated(other, parameter, geometry)


def _stated(node: Node, parameter: Parameter, geometry: Geometry) -> float:
    """Return a parameter's number in its unit; a stiffness has to be stated as that of the apparatus is."""
    if parameter.name == "K" and isinstance(node.value, str):
        written = split_quantity(node.value, name="K")[1]
        own = "1/um" if parameter.unit == "1/um" else "MPa/um or N/um"
        if written and same_dimension(written, "1/um") != (parameter.unit == "1/um"):
            node.fail(
                f"a stiffness in {written} beside that of [apparatus], which is in {own}",
                "Friction per micron is another thing than stress or force per micron, if loads differ: state both in one.",
            )
    return node.quantity(parameter.unit, geometry)


# One recording, from its description and its file to a run that can be compared with a simulation.


STIFFNESS = "the stiffness"  # among the quantities of a run that count as stresses or as forces


def read_run(run: RunDescription, described: Description, *, registry: Registry, format: str | None, limit: int) -> Run:
    """Return the run in a description's data file; raises SrfError for what cannot be used."""
    try:
        source = open_source(run.file, registry=registry, format=format or run.format)
    except SrfError as error:
        if error.kind == "no file":
            run.node.child("file").fail(error.message, error.hint)
        if error.kind == "unknown name" and not format:
            run.node.child("format").fail(error.message, error.hint)
        raise
    apparatus = described.apparatus
    columns = read_columns(run, source, described.columns, limit=limit, geometry=apparatus.geometry)
    keep, notices = kept_samples(columns.place("time"), columns.remarks.get("time"))
    columns = columns.kept(keep)
    t = columns.seconds
    notices = [*columns.notices, *notices, *sampling_notices(columns.place("time"), find_sampling(t))]
    if not apparatus.per_load and not columns.role(*LOADS) and run.load is None:
        raise SrfError(
            f"{run.node.where}: friction is recorded without a load, and the stiffness is in {apparatus.stated}",
            'Give the run load = "20 MPa", or the stiffness as friction per micron, in 1/um.',
        )
    units = _units(run, columns, apparatus)
    load, weighed = load_of(run, columns, "MPa" if any(units.values()) else "N")  # before the drive, which takes longest
    drive, told, resets = drive_of(run, columns)
    check_start(run, drive, float(t[0]))
    role, *beside = [c.role for c in columns.channels.values() if c.role in OBSERVABLES | OTHER_OBSERVABLES]
    at_start = load.rest(float(t[0]))
    stiffness = apparatus.stiffness * (at_start if apparatus.per_load else 1.0)
    rise = np.abs(drive(t)) * per_elongation(role, stiffness, at_start)
    recorded = {what: stress for what, stress in units.items() if what != STIFFNESS}
    if len(set(recorded.values())) > 1:
        named = ", ".join(f"{what} is a {'stress' if stress else 'force'}" for what, stress in recorded.items())
        raise SrfError(
            f"{run.node.where}: {named}: friction is the ratio of two forces or of two stresses",
            'Say the area of the contact, area = "25 cm^2" under [apparatus] or --area of `srf new`, or correct the unit.',
        )
    if recorded and units.get(STIFFNESS) not in (None, *recorded.values()):
        raise SrfError(
            f"{run.node.where}: the stiffness is in {apparatus.stated}, and {', '.join(recorded)} "
            f"{'is' if len(recorded) == 1 else 'are'} in units of {'stress' if any(recorded.values()) else 'force'}",
            'Say the area of the contact, area = "25 cm^2" under [apparatus] or --area of `srf new`, '
            f"or give the stiffness in {'MPa/mm' if any(recorded.values()) else 'N/um'}.",
        )
    observed, used, quantum, flaws, proposed = clean_observable(
        columns.place(role), columns.arrays[role], rise=rise, load=load, corrections=run.corrections
    )
    others = []  # which are not searched for spikes, resets and saturation
    for name in beside:
        known, filled, odd = _numbers(columns.place(name), columns.arrays[name])
        others.append(Signal(name, filled, known, quantisation(filled[known])))
        flaws += odd
    read = Run(
        name=run.name, file=run.file, holdout=run.holdout, start=run.start, initial=run.initial, t=t, observed=observed,
        observable=role, used=used, drive=drive, load=load, stiffness=stiffness, modulation=run.modulation, quantum=quantum,
        notices=(), stress=any(units.values()), proposed=proposed, others=tuple(others), backward=run.backward,
        segments=run.segments, drive_resets=resets,
    )  # fmt: skip
    notices += [*told, *weighed, *flaws]
    if run.drive is None and columns.role("load_point_velocity") is not None:
        notices += _late_steps(read, columns.place("load_point_velocity").column)
    if run.modulation is None and (recorded_load := columns.role(*LOADS)) is not None:
        notices += _load_steps(read, columns.place(recorded_load).column)
    return replace(read, notices=(*notices, *_odd_friction(read, columns.place(role).column)))


def _odd_friction(run: Run, where: str) -> list[Notice]:
    """Return notices of readings that are all the same, and of friction that surfaces which slide in contact do not have."""
    readings, mu = run.observed[run.used], run.friction[run.used]
    told = [] if np.ptp(readings) else [Notice("constant", where, f"all readings are {readings[0]:g}")]
    friction, half = float(np.median(mu)), 0.5 * float(np.median(np.abs(mu)))
    if min(np.mean(mu > half), np.mean(mu < -half)) > BOTH_WAYS:
        what = "the observable has both signs, and a run slides in one direction: `srf new` writes a run for each stroke"
    elif LEAST_FRICTION < friction < LARGEST_FRICTION:
        return told
    else:
        asked = "are the units of what is observed, of load and stiffness right?"
        if friction < -LEAST_FRICTION:
            asked = 'where the slider is sheared backward, direction = "backward" in the run says so'
        what = f"the friction coefficient is {friction:.3g}: {asked}"
    return [*told, Notice("friction", where, what)]


def _late_steps(run: Run, where: str) -> list[Notice]:
    """Return a notice where a step of the drive may have been up to a sampling interval earlier, and that would show."""
    at = np.searchsorted(run.t, run.drive.times[1:])
    at = at[(at > 0) & (at < run.t.size)]
    late = np.abs(run.drive(run.t[at]) - run.drive(run.t[at - 1])) * (run.t[at] - run.t[at - 1])
    shown = late * per_elongation(run.observable, run.stiffness, run.first_load)
    noise = white_level(run.observed[run.used])
    if not late.size or not shown.max() > LATE * noise > 0:
        return []
    k = int(np.argmax(shown))
    t, interval = run.t[at[k]], run.t[at[k]] - run.t[at[k] - 1]
    what = (
        f"each step of the velocity is taken to be at the sample that has the new one; the one at t = {t:.6g} s may be "
        f"{interval:.3g} s earlier, {late[k]:.3g} um of the load point and {shown[k] / noise:.0f} times the noise"
    )
    return [Notice("drive-steps", where, what)]


def _load_steps(run: Run, where: str) -> list[Notice]:
    """Return a notice where a load steps between two samples, and the drive moves on by more than the noise meanwhile.

    All readings are shifted until the contact is renewed, so that less counts than of a step of the drive.
    """
    W, path = run.load(run.t)[0], np.abs(run.drive(run.t[:-1])) * np.diff(run.t)
    rise = np.pad(np.abs(np.diff(W)), 1)
    alone = (rise[1:-1] > LOAD_STEP * W[:-1]) & (rise[1:-1] > LOAD_STEP_SHARE * (rise[:-2] + rise[1:-1] + rise[2:]))
    if not alone.any():
        return []
    shown = np.where(alone, path * per_elongation(run.observable, run.stiffness, run.first_load), 0.0)
    noise = white_level(run.observed[run.used])
    if not shown.max() > noise > 0:
        return []
    k = int(np.argmax(shown))
    step = f"from {W[k]:.4g} to {W[k + 1]:.4g} {run.load_unit} after t = {run.t[k]:.6g} s"
    what = (
        f"the load is taken to change evenly between samples; as it steps, {step}, the load point moves by {path[k]:.3g} um, "
        f"{shown[k] / noise:.2g} times the noise: a faster step shifts alpha, A and D0"
    )
    return [Notice("load-steps", where, what)]


def _numbers(place: Place, x: Array) -> tuple[Mask, Array, list[Notice]]:
    """Return which readings (n,) are numbers, the readings with the others interpolated, and notices of the others."""
    known = np.isfinite(x)
    if known.sum() < 8:
        raise SrfError(f"{place.column} has {int(known.sum())} numbers in {x.size} samples", "A recording needs 8 or more.")
    notices = place.spots("nan", ~known, f"without a number in '{place.heading}', not compared")
    return known, np.interp(place.t, place.t[known], x[known]), notices


def _units(run: RunDescription, columns: Columns, apparatus: Apparatus) -> dict[str, bool]:
    """Return for each force of the run, by name, whether it counts as a stress; with an area all do."""
    if apparatus.geometry.area:
        return {"all": True}
    found = {f"'{c.heading}'": is_stress(c.unit) for c in columns.channels.values() if c.role in ("force", *LOADS)}
    if run.load is not None and isinstance(text := run.node.child("load").value, str):
        found["load"] = is_stress(split_quantity(text, name="load")[1] or "N")
    if not apparatus.per_load:
        found[STIFFNESS] = is_stress(apparatus.stated)
    return found


# The recorded observable: which of its samples can be compared with a simulation, and what is wrong with the others.

STEADY_LOAD = 1e-3  # relative change of the load between samples below which the load does not make the observable jump
COARSE_STEP = 0.5  # quantisation step over white noise above which there is a notice


def clean_observable(
    place: Place, x: Array, *, rise: Array, load: Load, corrections: Collection[str] = ()
) -> tuple[Array, Mask, float, list[Notice], Array | None]:
    """Return the observable (n,), which samples are to be compared, its quantisation step, what was found, and what is proposed.

    `rise` (n,) is the fastest rise per second that the drive allows. Empty cells and saturated samples are not to be compared.
    With "spike" among the `corrections` spikes are not either; with "reset" level jumps that only a transducer can make are taken
    out, with "small-reset" those that may be something else, and the samples beside them are not compared. What is proposed is
    the observable (n,) with spikes and certain jumps taken out, None where nothing is.
    Raises SrfError where nothing is left.
    """
    t = place.t
    known, filled, notices = _numbers(place, x)
    quantum = quantisation(filled[known])
    clipped = np.zeros(x.size, bool)
    clipped[known] = saturation(filled[known])
    if clipped.any():
        edge = float(filled[np.flatnonzero(clipped)[0]])
        told = f"at the extreme value {edge:.6g} of '{place.heading}': saturated, not compared"
        notices += place.spots("saturation", clipped, told)
    steps, W = np.append(np.diff(t), t[-1] - t[-2]), load(t)[0]
    by_load = np.abs(np.diff(W, append=W[-1])) / W * float(np.median(np.abs(filled)))  # friction follows the load at once
    spiky = spikes(filled, quantum, rise * steps + by_load) & ~clipped
    if spiky.sum() > ACCIDENTS + x.size // 500:  # the tail of the noise, and no accidents
        spiky[:] = False
    left = "not compared" if "spike" in corrections else 'compared as they are; corrections = ["spike"] leaves them out'
    notices += place.spots("spike", spiky, f"standing out in '{place.heading}', {left}")
    calm = np.interp(t, t[~spiky], filled[~spiky])
    jumps = observable_jumps(calm, t, rise, np.abs(np.diff(W, prepend=W[0])) / W < STEADY_LOAD, quantum)
    level, done, beside = calm.copy(), calm.copy(), np.zeros(x.size, bool)  # as proposed, as asked for; beside what is asked for
    for jump in jumps:
        asked = ("reset" if jump.certain else "small-reset") in corrections
        level[jump.at + 1 :] -= jump.size if jump.certain or asked else 0.0
        done[jump.at + 1 :] -= jump.size if asked else 0.0
        beside[jump.at : jump.at + 2] |= asked
    proposed = level if spiky.any() or (level != calm).any() else None
    observed = np.where(spiky, filled + done - calm, done) if (done != calm).any() else filled
    spiky = spiky & ("spike" in corrections)
    white = white_level(calm)
    if quantum > COARSE_STEP * white > 0:
        what = f"steps of {quantum:.4g}, {quantum / white:.2g} times the white noise, which they add to"
        notices.append(Notice("quantisation", place.column, what))
    for jump in jumps:
        name = "reset" if jump.certain else "small-reset"
        why = "faster than the drive moves" + ("" if jump.certain else ", but too little to be sure of a transducer set anew")
        told = f'left as it is; corrections = ["{name}"] moves what follows back by that much'
        if name in corrections:
            told = "what follows is moved back by that much, and the two samples are not compared"
        what = f"'{place.heading}' jumps by {jump.size:.4g}: {why}; {told}"
        notices.append(Notice("reset", place.span(jump.at, jump.at + 1), what))
    used = known & ~clipped & ~spiky & ~beside
    if used.sum() < 8:
        raise SrfError(f"{place.column}: {int(used.sum())} samples can be compared", "8 are needed.")
    return observed, used, quantum, notices, proposed


# The check of a recording: sampling, flaws, noise, and the history of drive and load, as found in the data.

LOAD_STEP, LOAD_STEP_SHARE = 0.01, 0.8  # of the load; of what it changes by with the intervals beside
LATE = 10.0  # times the noise of what is observed, from where it is told that a step of the drive may have been between samples
BOTH_WAYS = 0.1  # share of readings of either sign, from where a run slides to and fro
LEAST_FRICTION, LARGEST_FRICTION = 0.01, 3.0  # that surfaces which slide in contact have
NOTICE_KINDS = (  # as --fail-on takes them; docs/recordings.md says of each what it is
    "gap", "sampling-change", "nan", "repeated-time", "backward-time", "spike", "reset", "saturation", "constant", "quantisation",
    "load-constant", "load-smoothed", "load-steps", "modulation-differs", "drive-differs", "drive-segmented", "drive-fitted",
    "drive-steps", "drive-smoothed", "friction", "unit", "observable", "load", "start-value", "sigma",
)  # fmt: skip


@dataclass(frozen=True)
class LoadHistory:
    """The load over a run: mean, smallest and largest W (N), the largest |d ln W/dt| (1/s), and a modulation if there is one."""

    mean: float
    lowest: float
    highest: float
    rate: float
    modulation: FoundModulation | None


@dataclass(frozen=True)
class RunCheck:
    """What was found in one run; `noises` are the gauge's at each sampling interval, `noise` is that of most samples.

    `friction_noise` is the noise of a sample in units of the friction coefficient. `drive` holds (from s, um/s, um/s^2).
    """

    run: Run
    sampling: Sampling
    noise: GaugeNoise
    noises: tuple[GaugeNoise, ...]
    friction_noise: float
    drive: tuple[tuple[float, float, float], ...]
    slowest: float
    fastest: float
    load: LoadHistory

    def count(self, kind: str) -> int:
        """Return how many notices of a kind the run has."""
        return sum(n.kind == kind for n in self.run.notices)

    @property
    def spikes(self) -> int:
        """Return how many samples of the observable stand out."""
        told = (n.what for n in self.run.notices if n.kind == "spike" and not n.what.endswith("the load is bridged"))
        return sum(int(what.split()[0]) for what in told)  # the notice begins with their number


def check_run(run: Run) -> RunCheck:
    """Return what the data of a run show without a simulation."""
    sampling, (W, W_dot) = run.sampling, run.load(run.t)
    modulation = find_modulation(run.t, W)
    x = np.interp(run.t, run.t[run.used], run.observed[run.used])
    absent = np.zeros(run.t.size, bool)
    for a, b in runs_of(~run.used):
        absent[a : b + 1] = b - a >= WIDEST_SPIKE  # a few are bridged; in a longer bridge nothing is noise
    cut = 1 + np.union1d(np.flatnonzero(np.diff(sampling.at) | np.diff(absent)), sampling.gaps)
    pieces, noises = [*zip(np.split(x, cut), sampling.at[[0, *cut]], absent[[0, *cut]], strict=True)], []
    for k, dt in enumerate(sampling.spacings):
        parts = [piece for piece, at, missing in pieces if at == k and not missing]
        if max(map(len, parts), default=0) < COLOUR_SAMPLES:  # a channel that is slower than the file: bridged after all
            parts = [x[a : b + 1] for a, b in runs_of(sampling.at == k)]
        noises.append(find_noise(parts, dt, quantum=run.quantum, cycles=modulation.frequency * dt if modulation else None))
    noise = noises[int(np.argmax(np.bincount(sampling.at)))]
    load = LoadHistory(float(W.mean()), float(W.min()), float(W.max()), float(np.abs(W_dot / W).max()), modulation)
    friction_noise = float(noise.total * run.friction_factor(load.mean))
    drive, ends = [], []
    for begin, end in pairwise(run.edges):
        V, rate, since = run.drive.piece(begin)
        drive.append((begin, V + rate * (begin - since), rate))
        ends += [V + rate * (begin - since), V + rate * (end - since)]
    return RunCheck(run, sampling, noise, tuple(noises), friction_noise, tuple(drive), min(ends), max(ends), load)
