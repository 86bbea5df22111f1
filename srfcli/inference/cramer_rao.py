"""How well the runs of an experiment could tell what a varying load may show, before anything has been fitted.

Asked for are alpha (Linker and Dieterich: a change of load changes the age), the interface's lambda, and the exponent n with
which its stiffness grows with the load. Each run is simulated with its own drive and load at the experiment's start values,
alpha = 0 and n = 1; the derivatives of the observable, whitened with the noise that was found, give the Fisher information. An
error is the Cramer-Rao bound with the experiment's free parameters unknown within their bounds, and with them what a laboratory
does not know either: the machine's stiffness, within a factor of two, and a trend of each run with slip. The noise's level and
colour may be unknown, too: of Gaussian noise their information and that of the mean are apart, so that it costs nothing. A fit
of these recordings by this model cannot do better. A random friction field, or start values that are far off, make it worse.

A recorded load that varies no more than its own gauge's noise, or than a load cell drifts, is constant here: such changes are no
known changes of the load.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import Array, GeneratedModel, open_model
from srfcli.core.errors import SrfError, Status
from srfcli.core.units import to_base
from srfcli.data.clock import Mask
from srfcli.data.experiment import RunCheck
from srfcli.data.gauge import COLOUR_SAMPLES, find_noise, of_one_gauge, whiten
from srfcli.data.values import Experiment, ModelChoice
from srfcli.inference.fit import solve_scaled
from srfcli.inference.prediction import predict, run_parameters, run_specific_names, run_specific_start, stiffness_share
from srfcli.laws.registry import Registry
from srfcli.motion.imposed import ConstantLoad, SampledLoad, runs_of

MODIFIER = "linker-dieterich"
SIZES = {"alpha": 0.2, "lambda": 0.1, "n": 0.1}  # that one would want to see: of rock's alpha, of lambda's own value, of n
MAX_MISFIT = 3.0  # rms of simulation minus recording over the recording's own spread, from which it is another motion
STIFFNESS_RANGE = 1.5  # from half to twice the stated stiffness
MAX_SIMULATED_SAMPLES = 20_000  # samples of a run that are simulated
NOISE_BLOCK = 16  # samples of one: the first half tells what the noise is like there, the second half counts
HELD = (2.0, 30.0)  # times its gauge's noise: standard deviation and range of a load that is only held
CELL_DRIFT = 3e-4  # of the load: standard deviation of a load cell's own drift
MOST_NOISE = 0.01  # of the load: what is more is no gauge's noise
UNDETERMINED = 100.0  # an error beyond this tells nothing: alpha and n are of order 1, lambda counts relative to itself


@dataclass(frozen=True)
class CramerRaoBound:
    """Smallest errors of alpha, lambda (relative) and n, by these names, from one run or several: inf where nothing is told.

    What the model does not have is missing. `held` where the load varies no more than its gauge does, and counts as constant.
    `peaks` are the largest changes that SIZES make and nothing else can, over the noise of a sample. `variation` is the range of
    ln W; `misfit` is simulation minus recording over the recording's spread (rms); `status` and `reached` (s) say how far the
    simulation went.
    """

    name: str
    holdout: bool
    variation: float
    errors: Mapping[str, float]
    peaks: Mapping[str, float]
    misfit: float = 0.0
    status: Status = Status.OK
    reached: float = math.inf
    held: bool = False

    @property
    def believed(self) -> bool:
        """Return whether the simulation resembles the recording enough to speak for it."""
        return self.misfit <= MAX_MISFIT


@dataclass(frozen=True)
class Forecast:
    """A bound for each run, one for all that are fitted and believed (None for fewer than two), and what else is unknown."""

    runs: tuple[CramerRaoBound, ...]
    together: CramerRaoBound | None
    free: tuple[str, ...]


@dataclass(frozen=True)
class _BoundProblem:
    """The experiment's model with alpha and n in it, values in um, s, N, and where in it is what.

    `asked` gives the model's parameter for a name of SIZES, `free` those unknown besides, `widths` their ranges.
    """

    model: GeneratedModel
    experiment: Experiment
    values: Mapping[str, float]
    targets: Mapping[str, str]
    free: tuple[str, ...]
    widths: Mapping[str, float]
    trend: str | None

    @property
    def names(self) -> tuple[str, ...]:
        """Return all parameters by which derivatives are taken."""
        return tuple(dict.fromkeys([*self.targets.values(), *self.free]))


def forecast(
    experiment: Experiment,
    checks: Sequence[RunCheck],
    *,
    registry: Registry,
    apparatus: bool = True,
    most: int = MAX_SIMULATED_SAMPLES,
    progress: Callable[[str], None] = lambda text: None,
) -> Forecast:
    """Return what these runs of an experiment could tell at best; raises SrfError where its model cannot be built.

    Stiffness and trends are unknown, too, unless `apparatus` is False: then it is a fit of the experiment's own free parameters.
    Of each run `most` samples are simulated, or fewer; of a longer one evenly chosen blocks stand for the others.
    """
    problem = _bound_problem(experiment, checks, registry, apparatus)
    runs, fitted = [], []
    for check in checks:
        progress(check.run.name)
        parts = [c for c in checks if (c.run.file, c.run.observable) == (check.run.file, check.run.observable)]
        recorded = [pair for c in parts for pair in zip(c.run.sampling.spacings, c.noises, strict=True)]
        noises = of_one_gauge(dict(zip(check.run.sampling.spacings, check.noises, strict=True)), recorded)
        held = is_held(check)
        run = replace(check.run, load=ConstantLoad(check.load.mean)) if held else check.run
        information = _simulated(problem, replace(check, run=run, noises=noises), most)
        errors, peaks = _errors(problem, [information])
        name, holdout = check.run.name, check.run.holdout
        one = CramerRaoBound(
            name, holdout, _variation([check]), errors, peaks, information.misfit, information.status, information.reached, held
        )
        runs.append(one)
        if one.believed and not holdout:
            fitted.append((check, information))
    free = tuple(q.name for q in experiment.parameters if not q.fixed)
    free += ("K",) if "K" in problem.free and "K" not in free else ()
    free += ("a trend of each run",) if problem.trend else ()
    if len(fitted) < 2:
        return Forecast(tuple(runs), None, free)
    errors, peaks = _errors(problem, [information for _, information in fitted])
    together = CramerRaoBound("all fitted runs", False, _variation([check for check, _ in fitted]), errors, peaks)
    return Forecast(tuple(runs), together, free)


def is_held(check: RunCheck) -> bool:
    """Return whether a recorded load is only held: at every sampling rate it varies no more than its gauge's noise or drift.

    Noise is what is left in stretches after a parabola and a modulation: white, coloured, lines of the mains.
    """
    run, mean, modulation = check.run, check.load.mean, check.load.modulation
    if not isinstance(run.load, SampledLoad) or run.modulation is not None:
        return False
    W, raw = run.load(run.t)[0], np.interp(run.t, run.load.times, run.load.W)
    for k, dt in enumerate(run.sampling.spacings):
        parts = [slice(a, b + 1) for a, b in runs_of(run.sampling.at == k)]
        own = np.concatenate([W[part] for part in parts])
        if modulation is None and own.std() <= CELL_DRIFT * mean:
            continue
        if max(part.stop - part.start for part in parts) < COLOUR_SAMPLES:
            return False
        noise = find_noise([raw[part] for part in parts], dt, cycles=modulation.frequency * dt if modulation else None).total
        if not (noise <= MOST_NOISE * mean and own.std() <= HELD[0] * noise and np.ptp(own) <= HELD[1] * noise):
            return False
    return True


def _variation(checks: Sequence[RunCheck]) -> float:
    return math.log(max(c.load.highest for c in checks) / min(c.load.lowest for c in checks))


def _bound_problem(experiment: Experiment, checks: Sequence[RunCheck], registry: Registry, apparatus: bool) -> _BoundProblem:
    choice, listed = experiment.choice, {q.name: q for q in experiment.parameters}
    values, spelled = {}, {}
    if choice.interface == "elastic":  # W/lambda is kappa0 (W/Wref)^n at n = 1
        usual = next(to_base(p.default, p.unit) for p in registry.get("interface", "elastic").parameters if p.name == "lambda")
        length = listed["lambda"].value if "lambda" in listed else usual
        Wref = float(np.mean([c.load.mean for c in checks]))
        choice, spelled = replace(choice, interface="power"), {"lambda": "kappa0"}
        values = {"kappa0": Wref / length, "Wref": Wref, "n": 1.0}
    model = _with_memory(choice, registry)
    asked = {"alpha": "alpha"} if "alpha" in model.names else {}
    if asked and "alpha" not in listed:
        values["alpha"] = 0.0
    elastic = next((n for n in ("lambda", "kappa0") if n in model.names), None)
    asked |= {"lambda": elastic} if elastic else {}
    asked |= {"n": "n"} if choice.interface == "power" else {}
    widths = {spelled.get(q.name, q.name): _width(q.lower, q.upper, q.value) for q in listed.values()}
    if "lambda" in spelled and "lambda" in listed:
        widths["kappa0"] *= values["kappa0"] / listed["lambda"].value  # the same, relative to the value
    free = tuple(spelled.get(q.name, q.name) for q in listed.values() if not q.fixed)
    if apparatus and "K" not in free:
        share = stiffness_share(experiment, checks[0].run)
        free, widths = (*free, "K"), {**widths, "K": STIFFNESS_RANGE * checks[0].run.stiffness / share}
    free = tuple(n for n in free if n in model.names)
    return _BoundProblem(model, experiment, values, asked, free, widths, (experiment.trend or "slip") if apparatus else None)


def _width(lower: float, upper: float, value: float) -> float:
    return upper - lower if math.isfinite(upper - lower) else 100 * max(abs(value), 1e-9)


def _with_memory(choice: ModelChoice, registry: Registry) -> GeneratedModel:
    """Return the model with Linker and Dieterich's term, or without where its laws do not take it."""
    if MODIFIER not in choice.ageing.split("+"):
        try:
            return open_model(registry, **asdict(replace(choice, ageing=f"{choice.ageing}+{MODIFIER}")), stability=False)
        except SrfError:  # the friction law has no B, or another modifier an alpha of its own
            pass
    return open_model(registry, **asdict(choice), stability=False)


@dataclass(frozen=True)
class _RunInformation:
    """What a simulated run tells: Fisher information F (k, k), and the observable's derivatives Z (m, k) over the noise.

    A free initial state is unknown, too, and what it takes away is subtracted from both.
    """

    F: Array
    Z: Array
    misfit: float
    status: Status
    reached: float


def _simulated(problem: _BoundProblem, check: RunCheck, most: int) -> _RunInformation:
    model, run = problem.model, check.run
    chosen, weight = _chosen(run.t.size, most)
    short = replace(run, t=run.t[chosen], observed=run.observed[chosen], used=run.used[chosen])
    values, own = dict(problem.values), run_specific_names(model, short, problem.trend)
    p, ranges = run_parameters(model, problem.experiment, short, values), []
    for name in own:
        values[name], low, high = run_specific_start(model, short, p, name)
        ranges.append(_width(low, high, values[name]))
    found = predict(model, problem.experiment, short, values, by=(*problem.names, *own), trend=problem.trend)
    rate = run.sampling.at[chosen]
    seen = short.used & (short.t <= found.reached) & np.isfinite(found.J).all(axis=1)
    sigma = np.array([noise.total for noise in check.noises])[rate]
    Z, J = found.J[seen] / sigma[seen, None], innovations(check, chosen, found.J, seen, weight=weight)
    F, k = J.T @ J, len(problem.names)
    if own:
        inner = F[k:, k:] + np.diag([12 / w**2 for w in ranges])
        taken = solve_scaled(inner, F[k:, :k])  # a drift with the slip is none where nothing moves
        F, Z = F[:k, :k] - F[:k, k:] @ taken, Z[:, :k] - Z[:, k:] @ taken
    rest = found.y[seen] - short.observed[seen]
    spread = max(float(np.std(short.observed[seen])), 10 * float(sigma.mean())) if seen.any() else 1.0
    misfit = float(np.sqrt(np.mean(rest**2))) / spread if seen.any() else math.inf
    return _RunInformation(F, Z, misfit, found.status, float(found.reached))


def _chosen(size: int, most: int) -> tuple[NDArray[np.int64], float]:
    """Return which samples of a run are simulated, and how many each that counts stands for: all, or blocks of a long one."""
    if size <= most:
        return np.arange(size), 1.0
    first = np.linspace(0, size - NOISE_BLOCK, most // NOISE_BLOCK).astype(int)
    return (first[:, None] + np.arange(NOISE_BLOCK)).ravel(), size / (first.size * NOISE_BLOCK / 2)


def innovations(check: RunCheck, chosen: NDArray[np.int64], J: Array, used: Mask, *, weight: float = 1.0) -> Array:
    """Return what each sample used adds to those before it: derivatives J (n, k), whitened by the noise that was found.

    `chosen` (n,) are the samples' places in the run. Where each stands for `weight` > 1 they are blocks, of which the second half
    counts, so many times.
    """
    at, t = check.run.sampling.at[chosen], check.run.t[chosen]
    begins, counts = np.diff(at, prepend=at[0]) != 0, used
    if weight > 1:
        place = np.arange(chosen.size) % NOISE_BLOCK
        begins, counts = begins | (place == 0), used & (place >= NOISE_BLOCK // 2)
    begins = np.diff(np.cumsum(begins)[used], prepend=-1) > 0  # a beginning that is not used passes to the next sample that is
    white = whiten(check.noises, at[used], begins, t[used], J[used])
    return np.asarray(math.sqrt(weight) * white[counts[used]])


def _errors(problem: _BoundProblem, information: Sequence[_RunInformation]) -> tuple[dict[str, float], dict[str, float]]:
    """Return errors and peaks of all that is asked for, from these runs together."""
    errors, peaks, F = {}, {}, sum((t.F for t in information), np.zeros((len(problem.names),) * 2))
    for asked, column in problem.targets.items():
        at = problem.names.index(column)
        rest = [i for i, n in enumerate(problem.names) if n in problem.free and n != column]
        error, alone = _error(F, at, rest, np.array([problem.widths[problem.names[i]] for i in rest]))
        unit = 1.0
        if asked == "lambda":
            p = run_parameters(problem.model, problem.experiment, problem.experiment.runs[0], problem.values)
            unit = float(p[problem.model.index(column)])
        errors[asked] = error / unit if error / unit < UNDETERMINED else math.inf
        peaks[asked] = SIZES[asked] * unit * max((float(np.abs(t.Z @ alone).max(initial=0.0)) for t in information), default=0.0)
    return errors, peaks


def _error(F: Array, at: int, rest: list[int], widths: Array) -> tuple[float, Array]:
    """Return the smallest error of parameter `at` where those in `rest` are unknown within ranges of these widths (uniform).

    And the direction (k,) in which it moves with what of its effect the others cannot take up.
    """
    scale = widths / math.sqrt(12)
    inner = F[np.ix_(rest, rest)] * np.outer(scale, scale) + np.eye(len(rest))
    taken = np.linalg.solve(inner, F[at, rest] * scale)
    left = float(F[at, at] - (F[at, rest] * scale) @ taken)
    alone = np.zeros(F.shape[0])
    alone[at], alone[rest] = 1.0, -taken * scale
    if not left > 1e-10 * F[at, at]:  # the difference of two sums, to rounding
        return math.inf, np.zeros(F.shape[0])
    return 1 / math.sqrt(left), alone
