"""`simulate`: records of one slider over time, under a drive and a load of one's own or as the runs of an experiment."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from srfcli.codegen.model import Array, GeneratedModel, open_model
from srfcli.codegen.slider import SlidingSystem, check_effects, declared
from srfcli.codegen.splines import appended
from srfcli.core.errors import SrfError, Status, as_pairs, did_you_mean, explained, worst
from srfcli.core.settings import Parameter, check_value, require_parameter
from srfcli.core.units import convert, find_unit, from_base, parse_quantity, split_quantity, tidy, to_base
from srfcli.data.description import MOST_OBSERVABLES
from srfcli.data.experiment import read_experiment
from srfcli.data.imposed import read_load
from srfcli.data.noise import FrictionField, check_gauge, generator
from srfcli.data.values import BOUND_FACTOR, OBSERVABLES, OTHER_OBSERVABLES, Experiment, FitParameter, ModelChoice, Run
from srfcli.data.writing import stiffness_text
from srfcli.inference.prediction import effect_inputs, modulation_of
from srfcli.laws.law_file import RESERVED
from srfcli.laws.registry import Registry
from srfcli.motion import STEP_RISE
from srfcli.motion import simulate as integrate
from srfcli.motion.imposed import ConstantLoad, Drive, Load, LoadSteps, ModulatedLoad, Modulation, SampledLoad
from srfcli.results.simulation import Gauge, Job, Record, SimulationResult, Work, measure, observe

LARGEST_VELOCITY = 1e9  # um/s


@explained
def simulate(
    system: SlidingSystem,
    *,
    t: ArrayLike,
    drive: Drive | Sequence[tuple[float, float]] | None = None,
    load: Load | Sequence[tuple[float, float]] | None = None,
    onset: float | None = None,
    start: ArrayLike | str = "steady",
    observable: str | Sequence[str] = "elongation",
    rtol: float = 1e-8,
) -> SimulationResult:
    """Return what a slider does under a program of driving velocity and load.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`; with eps above 0 the load is modulated at f.
    t : array (n,)
        Times of the samples in s, rising.
    drive : Drive or sequence of (time, velocity), optional
        Driving velocity in um/s, from each time (s) on; the system's V if left out. 0 is a hold.
    load : Load or sequence of (duration, load), optional
        Normal load in N for each duration (s), steps rounded over 0.02 s; the system's W0 if left out.
    onset : float, optional
        When the modulation begins to rise, in s; at the first sample if left out.
    start : array (n_states,), number or str
        State at the first sample, as the model orders it; 'steady' for steady sliding at the first velocity, 10 for steady
        sliding at 10 um/s, or values such as 'v=1e-3, phi=100 s' in place of those of steady sliding.
    observable : {'elongation', 'force', 'friction'} or sequence of str
        What the apparatus records, in um, N or 1; of several, others or 'slip' (um) and 'contact_area' (1) after the first.
    rtol : float
        Local relative error of integration, from 1e-13 to 1e-2.

    Returns
    -------
    SimulationResult
        Where integration stopped early its status says so, and what was reached is kept.

    Raises
    ------
    SrfError
        For times that do not rise, a drive that begins at rest without `start`, or a load that is not above 0.

    References
    ----------
    Hairer and Wanner (1996), Solving Ordinary Differential Equations II: Radau IIA of order 5.

    Examples
    --------
    >>> import numpy as np
    >>> import srfcli as srf
    >>> run = srf.simulate(srf.system(W0=5), t=np.linspace(0, 2, 201), drive=[(0, 10), (1, 20)])
    >>> float(run.records[0].trace.mu[-1].round(3))
    0.431
    """
    try:
        times = np.asarray(t, float)
    except (TypeError, ValueError):
        times = np.zeros(0)
    if times.ndim != 1 or times.size < 2 or not (np.diff(times) > 0).all():
        raise SrfError("t is no rising list of times", "Like numpy.linspace(0, 4, 4001), in s.")
    observables = check_observables([observable] if isinstance(observable, str) else list(observable))
    if not 1e-13 <= rtol <= 1e-2:
        raise SrfError(f"rtol = {rtol:g} is out of range", "Choose it between 1e-13 and 1e-2, as 1e-8.")
    if drive is None:
        drive = Drive.constant(system.resolved.values["V"])
    elif not isinstance(drive, Drive):
        drive = Drive.steps(as_pairs(drive, "drive", "times in s and velocities in um/s: [(0, 10), (2, 20)]"))
    if load is not None and not isinstance(load, Load):
        pieces = as_pairs(load, "load", "durations in s and loads in N: [(2, 5), (2, 7)]")
        load = LoadSteps.sequence([(length, W, W) for length, W in pieces], start=float(times[0]), rise=STEP_RISE)
    work = record_of(system, t=times, drive=drive, load=load, onset=onset, start=start, observables=observables)
    return simulate_work(work, rtol=rtol)


def simulate_work(
    work: Work, *, rtol: float = 1e-8, progress: Callable[[str, bool], None] = lambda name, done: None
) -> SimulationResult:
    """Return the records of prepared work; `progress` is told the name of each, before and after it was simulated."""
    records: list[Record] = []
    try:
        for job in work.jobs:
            progress(job.name, False)
            trace = integrate.simulate(
                work.model, job.p, drive=job.drive, load=job.load, t=job.t, start=job.start, tables=job.tables, rtol=rtol
            )
            shown = {name: observe(work.model, job, trace, name) for name in (job.observable, *job.beside)}
            read = {name: measure(work, job, trace, values, name) for name, values in shown.items()}
            others = tuple(values if (y := read[name]) is None else y for name, values in shown.items())[1:]
            records.append(Record(job, trace, shown[job.observable], read[job.observable], others))
            if trace.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            progress(job.name, True)
    except KeyboardInterrupt:
        return SimulationResult(work, tuple(records), Status.INTERRUPTED)
    return SimulationResult(work, tuple(records), worst([r.trace.status for r in records]))


def check_observables(names: Sequence[str]) -> list[str]:
    """Return the names of observables, which must be known; the first is one of the spring."""
    for number, name in enumerate(names):
        if name not in OBSERVABLES | OTHER_OBSERVABLES:
            raise SrfError(f"unknown observable {name!r}", did_you_mean(name, OBSERVABLES | OTHER_OBSERVABLES))
        if number == 0 and name in OTHER_OBSERVABLES:
            raise SrfError(f"{name} needs an elongation, a force or a friction before it", f"As force,{name}.")
        if name in names[:number]:
            raise SrfError(f"the observable {name!r} is named twice", "Name each once.")
    if not 1 <= len(names) <= MOST_OBSERVABLES:
        raise SrfError(f"{len(names)} observables", f"Name one to {MOST_OBSERVABLES}.")
    return list(names)


# A new record: one slider under a drive and a load.

STEEPEST = 1.875  # slope of a modulation's rise at its middle, over that of a straight line
FINE = 20_000  # times at which a load is looked at for a modulation
REFERENCE_PARAMETERS = ("V0",)  # the velocity that mu0 refers to: not identifiable beside mu0


def record_of(
    system: SlidingSystem,
    *,
    t: Array,
    drive: Drive | None = None,
    load: Load | None = None,
    onset: float | None = None,
    start: ArrayLike | str | None = "steady",
    observables: Sequence[str] = ("elongation",),
    on: tuple[GeneratedModel, FrictionField] | None = None,
) -> Work:
    """Return one record of a slider, to be simulated; arguments are those of `simulate`.

    `on` is the model with FIELD_TABLE and the random field that it slides on.
    """
    model, values, begin = system.motion, system.resolved.values, float(t[0])
    replaced = [name for name, given in (("V", drive), ("W0", load)) if given is not None]
    drive, load = drive or Drive.constant(values["V"]), load or ConstantLoad(values["W0"])
    if "angle" in values and any(drive.at(s) != drive.at(begin) for s in (*(b for b in drive.breaks if b < t[-1]), float(t[-1]))):
        raise SrfError(
            "under an inclined spring W0 is the load in steady sliding at V, and the drive changes its velocity",
            "Drive at one velocity, or leave out `loading`.",
        )
    modulation = None
    if values["eps"]:
        if onset is not None and not onset >= begin:
            raise SrfError(
                f"`onset` {onset:g} s lies before the record, which begins at {begin:g} s",
                "Sliding is steady before the first sample: the modulation begins with it or later.",
            )
        modulation = values["f"], values["eps"], begin if onset is None else onset
        shape = Modulation(1.0, modulation[1], modulation[0], modulation[2])
        load = replace(shape, W0=load.W0) if isinstance(load, ConstantLoad) else ModulatedLoad(load, shape)
    elif onset is not None:
        raise SrfError("`onset` is given and nothing is modulated", "Give the amplitude, too: `eps` 0.09.")
    load.check(begin, float(t[-1]))
    asked: dict[str, float] = {}
    if "begin" in model.names:  # by effects
        asked = {"begin": begin, "weighed": float(observables[0] != "elongation"), **_as_effects_ask(load, t)}
    p = model.vector({**values, **asked})
    model.check_changing_load(p)
    state = start_state(model, p, start, drive=drive, load=load.rest(begin), begin=begin)
    job = Job("simulated", p, drive, load, t, state, observables[0], modulation, beside=tuple(observables[1:]))
    work = Work(model, (job,), system.described(without=replaced))
    return work if on is None else on_field(work, *on, start=start)


def _as_effects_ask(load: Load, t: Array) -> dict[str, float]:
    """Return a load's modulation as effects ask for it: switched on as (1 + tanh((t - onset0)/rise0))/2, as steeply as it rises.

    That of a measured load is found at its own times, that of another one between the first and last of t.
    """
    shape = load if isinstance(load, Modulation) else load.shape if isinstance(load, ModulatedLoad) else None
    if shape is None or not shape.eps:
        fine = np.linspace(t[0], t[-1], max(t.size, FINE))
        return modulation_of(load, load.times if isinstance(load, SampledLoad) else fine)
    known = {"f": shape.f, "eps": shape.eps, "psi": shape.phase, "modulated": 1.0}
    if not math.isfinite(shape.onset):
        return known
    rise = shape.full - shape.onset
    return known | {"onset0": shape.onset + rise / 2, "rise0": rise / (2 * STEEPEST)}


def start_state(
    model: GeneratedModel, p: Array, start: ArrayLike | str | None, *, drive: Drive, load: float, begin: float
) -> Array | None:
    """Return the state (n,) that `start` of `simulate` means, None for steady sliding at the drive's first velocity.

    `load` (N) is the load at rest at the time `begin` (s). Raises SrfError where the drive does not move at first.
    """
    q = np.array(p, dtype=float)
    q[model.index("W0")] = load
    first = drive.at(begin)
    if start is None or (isinstance(start, str) and start.strip().lower() == "steady"):
        if first <= 0:
            moving = next((v for v in drive.velocities if v > 0), 10.0)
            raise SrfError(
                f"the drive begins at {first:g} um/s: there is no steady sliding to start from",
                f"Say what went before: `start` {moving:g} for steady sliding at {moving:g} um/s, "
                "or begin `drive` with a piece that moves.",
            )
        return None
    if isinstance(start, numbers.Real):
        start = repr(float(start))
    if not isinstance(start, str):
        try:
            return np.asarray(start, float)
        except (TypeError, ValueError):
            raise SrfError(f"`start` {start!r} is no state", "Like 10, for steady sliding at 10 um/s.") from None
    if "=" not in start:
        try:
            V = parse_quantity(start, "um/s", name="`start`")
        except SrfError as error:
            raise SrfError(f"`start` {start!r} is neither steady, nor a velocity, nor values", error.hint) from error
        if not 1e-12 <= V <= LARGEST_VELOCITY:
            raise SrfError(f"`start` {start}: sliding is steady from 1e-12 to {LARGEST_VELOCITY:g} um/s", "Write `start` 10.")
        q[model.index("V")] = V
        return np.asarray(model.steady(q), dtype=float)
    q[model.index("V")] = next((v for v in (first, *drive.velocities) if v > 0), 10.0)
    return _with_values(model, np.array(model.steady(q), dtype=float), start)


def _with_values(model: GeneratedModel, x: Array, text: str) -> Array:
    plain = [name.removeprefix("ln_") for name in model.states]
    for part in text.split(","):
        name, _, value = (word.strip() for word in part.partition("="))
        if name not in plain:
            raise SrfError(f"`start`: {name!r} is no state of {model.title}", did_you_mean(name, plain))
        unit = {"u": "um", "z": "um/s", "v": "um/s"}.get(name, "s")
        number, i = parse_quantity(value, unit, name=f"`start`: {name}"), plain.index(name)
        if model.logarithmic[i] and not number > 0:
            raise SrfError(f"`start`: {name} = {number:g} {unit} is not above 0", f"Write `start` {name}=1e-6.")
        x[i] = math.log(number) if model.logarithmic[i] else number
    return x


def new_experiment(
    system: SlidingSystem, choice: ModelChoice, folder: Path, *, free: str | None, spread: float, seed: int
) -> Experiment:
    """Return the experiment that a record of this slider is written as, the record still to come.

    `free` names the parameters that a fit is to find, the law's but V0 if left out; `spread` is as in `perturbed`.
    """
    parts, values = system.resolved.parameters, system.resolved.values
    laws = [p.name for p in parts if p.name not in RESERVED]
    known = [*laws, *(p.name for p in parts if p.name in ("K", "M"))]
    if free is None:
        chosen = [name for name in laws if name not in REFERENCE_PARAMETERS]
    else:
        chosen = [name.strip() for name in free.split(",") if name.strip()]
    for name in chosen:
        if name not in known:
            raise SrfError(f"`free`: {name!r} is no parameter of {system.title}", did_you_mean(name, known))
    parameters = [
        FitParameter(p.name, values[p.name], *bounds(p, values[p.name]), fixed=p.name not in chosen, unit=p.unit)
        for p in parts
        if p.name not in RESERVED or p.name in chosen
    ]
    mass = values.get("M") if choice.inertia else None
    listed = perturbed(parameters, spread, seed)
    return Experiment(folder, f"simulated with {system.title}", choice, mass, stiffness_text(values["K"]), listed, (), ())


def bounds(parameter: Parameter, value: float) -> tuple[float, float]:
    """Return the bounds of a fit around `value` (um, s, N): a factor of five, within the parameter's own."""
    lower, upper = (to_base(b, parameter.unit) for b in (parameter.lower, parameter.upper))
    if value > 0:
        return max(lower, float(f"{value / BOUND_FACTOR:.3g}")), min(upper, float(f"{value * BOUND_FACTOR:.3g}"))
    reach = BOUND_FACTOR * max(abs(value), 1.0)
    return (lower if math.isfinite(lower) else value - reach), (upper if math.isfinite(upper) else value + reach)


def perturbed(parameters: Sequence[FitParameter], spread: float, seed: int) -> tuple[FitParameter, ...]:
    """Return the free parameters off by a factor drawn evenly from 1 - spread to 1 + spread, within their bounds."""
    rng = generator(seed, "start values")
    moved = []
    for p in parameters:
        factor = 1.0 + spread * rng.uniform(-1.0, 1.0)  # drawn for fixed ones, too: what is free changes no other value
        value = p.value if p.fixed or not spread else min(max(p.value * factor, p.lower), p.upper)
        moved.append(replace(p, value=value))
    return tuple(moved)


# A new record as it is told: programs of drive and load, sampling, gauges and the random friction field as text.

LAW_FILES = (".toml", ".py")
TRAVEL = 40.0  # um of driving where no duration is given
LONGEST_TIME = 1e12  # s
FIELD_LENGTH = 10.0  # um, the correlation length where only a size is given

Piece = tuple[float, float, float]  # duration (s), and the values between which a quantity runs straight


@dataclass(frozen=True, kw_only=True)
class Recorder:
    """How records are begun, read and written, as the options of `srf simulate` tell it; its methods raise SrfError.

    `noise`, `lag1` and `quantum` are those of the gauges, `field` and `field_length` those of the track. With `folder` the
    records are written as an experiment, which has `start_values`.
    """

    reader: str | None
    start: str
    noise: str | None
    lag1: float
    quantum: str | None
    field: str | None
    field_length: str | None
    seed: int
    folder: Path | None
    start_values: str
    rtol: float

    def gauges(self, observables: Sequence[str]) -> dict[str, Gauge]:
        """Return the gauge of each observable; sizes are as '0.01,0.2', in the observables' units unless one is written."""
        sizes = []
        for name, text in (("noise", self.noise), ("quantum", self.quantum)):
            texts = ["0"] * len(observables) if text is None else text.split(",")
            if len(texts) != len(observables):
                raise SrfError(
                    f"`{name}` {text}: found {len(texts)}, expected one for each of {', '.join(observables)}",
                    f"Write `{name}` {','.join(['0.01'] * len(observables))}.",
                )
            units = [(OBSERVABLES | OTHER_OBSERVABLES)[observable] for observable in observables]
            sizes.append([parse_quantity(text, unit, name=f"`{name}`") for text, unit in zip(texts, units, strict=True)])
        silent = any(sizes[0])  # a gauge without noise beside others; of none, a colour is told
        gauges = [Gauge(n, self.lag1 if n or not silent else 0.0, q, self.seed) for n, q in zip(*sizes, strict=True)]
        for gauge in gauges:
            check_gauge(**asdict(gauge))
        return dict(zip(observables, gauges, strict=True))

    def spread(self) -> float:
        """Return by how much, relatively, written start values may be off: 0 for 'true', 0.1 for 'perturb:10%'."""
        text = self.start_values
        if text == "true":
            return 0.0
        kind, colon, size = text.partition(":")
        if kind != "perturb" or not colon:
            raise SrfError(f"`start_values` {text!r} is neither true nor perturb:SIZE", "Write `start_values` perturb:10%.")
        share = size.strip().removesuffix("%")
        spread = parse_quantity(share, "1", name="`start_values` perturb") / (100.0 if share != size.strip() else 1.0)
        if not 0 <= spread < 1:
            raise SrfError(f"`start_values` {text}: the size is not between 0 and 100 %", "Write perturb:10%.")
        return spread

    def track(self) -> tuple[FrictionField, dict[str, dict[str, Any]]] | None:
        """Return the random field, and its size and length as {value, unit, origin}; None without one."""
        if self.field is None:
            if self.field_length is not None:
                raise SrfError("`field_length` is given without a field", "Give the size: `field` 3e-4.")
            return None
        amplitude = parse_quantity(self.field, "1", name="`field`")
        length = parse_quantity(self.field_length or str(FIELD_LENGTH), "um", name="`field_length`")
        field = FrictionField(amplitude, length, self.seed)
        described = {
            "field_amplitude": {"value": amplitude, "unit": "1", "origin": "flag"},
            "field_length": {"value": length, "unit": "um", "origin": "default" if self.field_length is None else "flag"},
        }
        return (field, described) if amplitude else None


def record_as_told(
    system: SlidingSystem,
    how: Recorder,
    *,
    drive: str | None,
    load: str | None,
    load_rise: str,
    load_file: Path | None,
    duration: str | None,
    rate: str | None,
    onset: str | None,
    observable: str | None,
    free: str | None,
) -> Work:
    """Return one record of a slider, to be simulated, as the options of `srf simulate` tell it.

    Raises SrfError for what cannot be simulated, or written as an experiment.
    """
    values, opener = system.resolved.values, system.opener
    spread, track = how.spread(), how.track()
    observables = check_observables([name.strip() for name in (observable or "elongation").split(",")])
    if opener.names["loading"] != "vertical":
        if track is not None:
            raise SrfError("a friction field is for a slider loaded from above", "Leave out `field` or `loading` inclined.")
        if how.folder is not None:
            raise SrfError("an experiment folder cannot say that the spring is inclined", "Leave out `folder` or `loading`.")
    imposed: Load = ConstantLoad(values["W0"])
    begin, length, notes = 0.0, None, list[str]()
    if load_file is not None:
        imposed, times, notices = read_load(load_file, registry=opener.registry, format=how.reader)
        begin, length, notes = float(times[0]), float(times[-1] - times[0]), list(map(str, notices))
    elif load is not None:
        steps = read_pieces(load, "N", name="load", example="2:5, 0.2:5->7, 4:7")
        imposed = LoadSteps.sequence(steps, rise=parse_quantity(load_rise, "s", name="`load_rise`"))
        length = imposed.edges[-1]
    pieces = _drive_pieces(drive, duration, values["V"], length)
    durations = [piece[0] for piece in pieces]
    f, whole = values["f"] if values["eps"] else None, sum(durations)
    rates = (usual_rate(whole, f),) * len(pieces) if rate is None else read_rates(rate, len(pieces))
    on = None
    if track is not None:
        on = open_model(opener.registry, **opener.names, effects=opener.effects, tables=FIELD_TABLE), track[0]
    work = record_of(
        system,
        t=sample_times(durations, rates, begin),
        drive=Drive.sequence(pieces, start=begin),
        load=imposed,
        onset=None if onset is None else parse_quantity(onset, "s", name="`onset`"),
        start=how.start,
        observables=observables,
        on=on,
    )
    law, ageing, interface = _placed([opener.names[key] for key in ("law", "ageing", "interface")])
    choice = ModelChoice(law, ageing, interface, opener.names["inertia"], _placed(opener.effects))
    described, modulation = system.described(), work.jobs[0].modulation
    for name, text, unit in (("V", drive, "s:um/s"), ("W0", load or load_file, "s:N")):
        if text is not None:
            described[name] = {"value": str(text), "unit": unit, "origin": "flag"}
    made = None if how.folder is None else new_experiment(system, choice, how.folder, free=free, spread=spread, seed=how.seed)
    files = [name for name in (choice.law, choice.ageing, choice.interface, *choice.effects) if name.endswith(LAW_FILES)]
    return replace(
        work,
        parameters=described | (track[1] if track else {}),
        gauges=how.gauges(observables),
        experiment=made,
        remarks=tuple(f"the experiment names the file {name}" for name in files),
        inputs=() if load_file is None else (load_file,),
        notes=(*notes, *work.notes, *_sampling_notes(rates, f, None if load is None else length, whole)),
        meta={"rate_Hz": sorted(set(rates)), "rtol": how.rtol, "onset": modulation and modulation[2], **work.meta},
    )


def _placed(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of laws, a file's as its whole path: one relative to here means nothing in an experiment's folder."""
    return tuple(str(Path(name).resolve()) if name.endswith(LAW_FILES) else name for name in names)


def _drive_pieces(drive: str | None, duration: str | None, V: float, length: float | None) -> tuple[Piece, ...]:
    """Return the pieces of a drive, or one of constant V: as long as `duration`, the load's `length` (s), or 40 um."""
    if drive is not None:
        pieces = read_pieces(drive, "um/s", name="drive", example="0.5:12, 4:8")
        for number, (_, first, last) in enumerate(pieces, 1):
            fastest = max(first, last, key=abs)
            if abs(fastest) > LARGEST_VELOCITY:
                raise SrfError(f"`drive`: piece {number} drives at {fastest:g} um/s", f"Stay within {LARGEST_VELOCITY:g} um/s.")
        return pieces
    if duration is not None:
        length = parse_quantity(duration, "s", name="`duration`")
        if not 0 < length <= LONGEST_TIME:
            raise SrfError(f"`duration` {length:g} s is not a length of time", "Write `duration` 4.")
    return ((float(f"{TRAVEL / V:.3g}") if length is None else length, V, V),)


def _sampling_notes(rates: Sequence[float], f: float | None, loaded: float | None, driven: float) -> Iterator[str]:
    """Yield notes on a modulation that is sampled coarsely, and a load that does not last (s) as long as the drive."""
    if f and min(rates) < 8 * f:
        yield f"sampled {min(rates) / f:.2g} times a period of the modulation: from fewer than 8 the load is not read back"
    if loaded is not None and loaded < driven * (1 - 1e-9):
        yield f"--load ends at {loaded:g} s of {driven:g} s; its last value holds on"
    elif loaded is not None and loaded > driven * (1 + 1e-9):
        yield f"--load goes on to {loaded:g} s, the drive ends at {driven:g} s; the rest is not simulated"


def read_pieces(text: str, unit: str, *, name: str, example: str) -> tuple[Piece, ...]:
    """Return the pieces of '0.5:12, 4:8' or '1:5->7', values in `unit` unless one is written.

    Raises SrfError that names the argument and the piece.
    """
    parts = [part.strip() for part in text.split(",")]
    if not any(parts):
        raise SrfError(f"`{name}` is empty", f"Write `{name}` '{example}'.")
    pieces = []
    for number, part in enumerate(parts, 1):
        where = f"`{name}`: piece {number}, {part!r},"
        duration_text, _, values_text = part.partition(":")
        ends = [end.strip() for end in values_text.split("->")]
        if part.count(":") != 1 or not duration_text.strip() or not all(ends) or len(ends) > 2:
            hint = f"Write pieces with commas between them: `{name}` '{example}'."
            raise SrfError(f"{where} is not DURATION:VALUE or DURATION:FROM->TO", hint)
        duration = parse_quantity(duration_text, "s", name=f"`{name}`: the duration of piece {number}")
        if not 0 < duration <= LONGEST_TIME:
            raise SrfError(f"{where} lasts {duration:g} s", f"Give each piece a duration above 0, up to {LONGEST_TIME:g} s.")
        split = [split_quantity(end, name=f"`{name}`: the value of piece {number}", example=f"5 {unit}") for end in ends]
        written = next((u for _, u in reversed(split) if u), unit)
        values = [convert(v, u or written, unit, name=f"`{name}`: piece {number}") for v, u in split]
        pieces.append((duration, values[0], values[-1]))
    return tuple(pieces)


def read_rates(text: str, pieces: int) -> tuple[float, ...]:
    """Return the samples per second in each of so many pieces: one for all, or one for each."""
    rates = tuple(parse_quantity(part, "Hz", name="`rate`") for part in text.split(","))
    if not all(0 < rate <= 1e9 for rate in rates):
        raise SrfError(f"`rate` {text}: a rate lies between 0 and 1e9 Hz", "Write `rate` 1000.")
    if len(rates) not in (1, pieces):
        raise SrfError(
            f"`rate` {text} gives {len(rates)} rates for {pieces} piece{'s' if pieces != 1 else ''} of the drive",
            "Give one rate, or one for each piece: `rate` 100,1,1000.",
        )
    return rates * pieces if len(rates) == 1 else rates


# How a new record is sampled, where no times are given.

MOST_SAMPLES = 10_000_000
FEW_SAMPLES, MANY_SAMPLES, USUAL_RATE = 1000, 100_000, 1000.0  # see `usual_rate`


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


def sample_times(durations: Sequence[float], rates: Sequence[float], start: float) -> Array:
    """Return the times (s) of the samples, the first at `start`, the last at or just before the end of the last piece.

    Each piece lasts its duration (s) and has its rate (Hz). Raises SrfError where samples are fewer than two or more than ten
    million.
    """
    total = sum(duration * rate for duration, rate in zip(durations, rates, strict=True))
    if total > MOST_SAMPLES:
        size = f"{total:.3g} samples, {total * 64 / 1e9:.2g} GB"
        raise SrfError(f"`rate` asks for {size}; {MOST_SAMPLES:.0e} is the limit", "Lower `rate`, or split the record.")
    if total < 1:
        raise SrfError(
            f"`rate` gives only one sample in {sum(durations):g} s",
            f"Raise it: `rate` {_round_rate(10 / sum(durations), up=True):g}.",
        )
    edges = list(accumulate(durations, initial=start))
    blocks = []
    for (a, b), rate in zip(pairwise(edges), rates, strict=True):
        steps = np.arange(math.floor((b - a) * rate * (1 + 1e-12)) + 1)
        times = a + steps / rate
        blocks.append(times[times < b - 1e-9 / rate] if b != edges[-1] else np.minimum(times, b))
    digits = 15 - math.ceil(math.log10(max(abs(edges[0]), abs(edges[-1]))))  # 0.507, not 0.5070000000000001
    return np.unique(np.round(np.concatenate(blocks), min(12, max(digits, 0))))


# The runs of an experiment: as they were driven, loaded and sampled, with any parameters and laws.

IMPOSED = ("V", "W0", "eps", "f")
OF_THE_APPARATUS = ("K", "M")


def runs_again(
    source: Path,
    registry: Registry,
    how: Recorder,
    *,
    laws: Mapping[str, Any],
    effects: Sequence[str],
    parameters: Mapping[str, str],
    runs: Sequence[str],
) -> Work:
    """Return the runs of the experiment at `source`, to be simulated with its own laws and values but for those given.

    `laws` are fields of its ModelChoice, `effects` are added to its own, `parameters` are values as text; `runs` are names of
    runs, all where there are none.
    """
    spread, track = how.spread(), how.track()
    experiment = read_experiment(source, registry=registry, format=how.reader)
    if laws.get("loading", "vertical") != "vertical":
        raise SrfError("the runs of an experiment are loaded from above", "Leave out `loading` inclined.")
    experiment.check_recorded("to simulate")
    choice = replace(experiment.choice, **{k: v for k, v in laws.items() if k != "loading"}).plus(_placed(effects))
    if effects:
        check_effects(registry, choice.effects)
    model = open_model(registry, **asdict(choice), stability=False)
    values = _values(model, parameters, stress=experiment.stress)
    chosen = experiment.named(runs)
    observables = list(dict.fromkeys(tuple(s.observable for s in run.signals) for run in chosen))
    if len(observables) > 1 and (how.noise or how.quantum):
        raise SrfError(
            f"the runs record {' and '.join(map(', '.join, sorted(observables)))}: one `noise` has no unit for all",
            "Choose runs that record the same, with `runs`.",
        )
    jobs = tuple(_job(model, experiment, run, values, how.start) for run in chosen)
    unknown = [run.name for run in chosen if run.initial == "free"]
    begun = f"initial state of {', '.join(unknown)} not known: begun in steady sliding" if unknown else None
    scaled = None if "K" in values else experiment.rescaled()
    notes = tuple(note for note in (begun, scaled) if note)
    inputs = (experiment.path, *(run.file for run in chosen))
    made = None if how.folder is None else _experiment_again(experiment, model, choice, values, how.folder, spread, how.seed)
    dropped = [p.name for p in experiment.parameters if p.name not in model.names]
    remarks = (f"not written, as {choice.law} has no such parameter: {', '.join(dropped)}",) if dropped else ()
    described = _described(model, experiment, values) | (track[1] if track else {})
    work = Work(model, jobs, described, how.gauges(observables[0]), made, remarks, inputs, notes, {"title": experiment.title})
    if track is not None:
        work = on_field(work, open_model(registry, **asdict(choice), tables=FIELD_TABLE), track[0], start=how.start)
    return replace(work, meta={**work.meta, "rtol": how.rtol})


def _values(model: GeneratedModel, parameters: Mapping[str, str], *, stress: bool) -> dict[str, float]:
    """Return the parameters that are set, in um, s, N; where stresses were recorded, a stiffness is one over a length."""
    values = {}
    unit = split_quantity(parameters["K"], name="K")[1] if stress and "K" in parameters else ""
    if unit and find_unit(unit).powers == find_unit("N/um").powers:
        raise SrfError(f"`K` {parameters['K']} is a force over a length, and the recordings are stresses", "Give it in MPa/mm.")
    for name, text in parameters.items():
        if name in IMPOSED:
            raise SrfError(f"{name} is what the runs impose", "An experiment says itself how it is driven and loaded.")
        parameter = require_parameter(name, declared(model), where=model.title)
        values[name] = to_base(check_value(parameter, text), parameter.unit)
    return values


def _listed(experiment: Experiment) -> dict[str, float]:
    """Return the values of [parameters] and the mass; stiffness and mass are the apparatus', whatever a fit starts from."""
    mass = {"M": experiment.mass} if experiment.mass else {}
    return {p.name: p.value for p in experiment.parameters if p.name not in OF_THE_APPARATUS} | mass


def _job(model: GeneratedModel, experiment: Experiment, run: Run, values: Mapping[str, float], start: ArrayLike | str) -> Job:
    begin = float(run.t[0])
    asked = effect_inputs(run) if "begin" in model.names else {}  # by effects
    found = _listed(experiment) | {"K": run.stiffness} | asked | dict(values) | experiment.elsewhere(run)
    p = model.vector({name: value for name, value in found.items() if name in model.names})
    model.check_changing_load(p)
    try:
        state = start_state(model, p, start, drive=run.drive, load=run.first_load, begin=begin)
    except SrfError as error:
        raise SrfError(f"run {run.name!r}: {error.message}", error.hint) from error
    beside = tuple(signal.observable for signal in run.others)
    return Job(run.name, p, run.drive, run.load, run.t, state, run.observable, run.modulation, run, beside=beside)


def _described(model: GeneratedModel, experiment: Experiment, values: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Return name -> {value, unit, origin} of what does not change from run to run."""
    listed, described = _listed(experiment), {}
    for p in declared(model):
        if p.name in IMPOSED:
            continue
        origin = "flag" if p.name in values else "experiment" if p.name in listed else "law default"
        value = values.get(p.name, listed.get(p.name))
        shown: Any = p.default if value is None else tidy(from_base(value, p.unit))
        if p.name == "K" and origin != "flag":
            shown, origin = experiment.stiffness_text, "experiment"
        described[p.name] = {"value": shown, "unit": p.unit, "origin": origin}
    return described


def _experiment_again(
    experiment: Experiment,
    model: GeneratedModel,
    choice: ModelChoice,
    values: Mapping[str, float],
    folder: Path,
    spread: float,
    seed: int,
) -> Experiment:
    """Return the experiment as it is written, its start values those of the simulation, or off them; its runs are to come."""
    listed = [p for p in experiment.parameters if p.name in model.names]
    for k, p in enumerate(listed):
        if p.name in values:
            value, unit = values[p.name], "N/um" if p.name == "K" else p.unit  # the unit of the stiffness that is written, too
            listed[k] = replace(p, value=value, lower=min(p.lower, value), upper=max(p.upper, value), unit=unit)
    known = {*(p.name for p in listed), *OF_THE_APPARATUS}
    added = [p for p in model.parameters if p.name in values and p.name not in known]
    listed += [FitParameter(p.name, values[p.name], *bounds(p, values[p.name]), fixed=True, unit=p.unit) for p in added]
    return replace(
        experiment, path=folder, title=f"{experiment.title} (simulated)".strip(), choice=choice,
        mass=(values.get("M", experiment.mass) if choice.inertia else None),
        stiffness_text=stiffness_text(values["K"]) if "K" in values else experiment.stiffness_text,
        parameters=perturbed(listed, spread, seed), runs=(), notices=(),
    )  # fmt: skip


# The random friction field along slip, and records simulated with it.

FIELD_TABLE = (("mu", "slip"),)  # a table over slip is added to the friction coefficient
LARGEST_FIELD = 0.5  # of mu0: above it the friction coefficient may become negative


def on_field(work: Work, model: GeneratedModel, field: FrictionField, *, start: ArrayLike | str | None) -> Work:
    """Return work with its model replaced by `model`, the same with FIELD_TABLE, each job on the part of the track it covers.

    Positions are slip from where the run begins; runs that begin at the same place find the same track there. `start` is as in
    `simulate`. Raises SrfError for a field that the friction coefficient does not allow.
    """
    jobs = []
    for job in work.jobs:
        begin, place = float(job.t[0]), job.run.start if job.run is not None else 0.0
        p = model.vector(dict(zip(work.model.names, job.p.tolist(), strict=True)) | {"start": place, "begin": begin})
        mu0 = p[model.index("mu0")] if "mu0" in model.names else math.inf
        if not field.amplitude <= LARGEST_FIELD * mu0:
            raise SrfError(
                f"a field of {field.amplitude:g} is more than half of mu0 = {mu0:g}",
                "It is the standard deviation of mu0 along the track, such as 3e-4.",
            )
        table = field.spline(place, place + _reach(work.model, job))
        state = start_state(model, appended(p, [table]), start, drive=job.drive, load=job.load.rest(begin), begin=begin)
        jobs.append(replace(job, p=p, start=state, tables=(table,)))
    told = f"track: mu0 varies by {field.amplitude:g} (standard deviation) over {field.length:g} um"
    meta = {**work.meta, "track": {"amplitude": field.amplitude, "length_um": field.length}}  # as in the result of `srf fit`
    return replace(work, model=model, jobs=tuple(jobs), notes=(*work.notes, told), meta=meta)


def _reach(model: GeneratedModel, job: Job) -> float:
    """Return how far (um) the slider may slip: what is driven, what the spring holds at first, and what it swings beyond."""
    begin, end = float(job.t[0]), float(job.t[-1])
    times = np.unique([*job.t.tolist(), *(b for b in job.drive.breaks if begin < b < end)])
    driven = np.cumsum(job.drive(0.5 * (times[1:] + times[:-1])) * np.diff(times))  # V is linear in between
    held = 0.0
    if job.start is not None and "u" in model.states:
        held = abs(float(job.start[model.states.index("u")]))
    # a spring that friction holds is drawn by less than 1.5 W/K, and swings back by less than it was drawn
    drawn = 3.0 * float(job.load(job.t)[0].max()) / float(job.p[model.index("K")])
    return max(float(driven.max()), 0.0) + 2 * held + drawn
