"""Which registered effects may be missing in an experiment, and what a hypothesis gave once fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel, open_model
from srfcli.core.settings import Parameter
from srfcli.core.units import split_quantity, to_base
from srfcli.data.values import Experiment, FitParameter, Run
from srfcli.diagnosis.goodness_of_fit import Adequacy, judge_residuals
from srfcli.inference.fit import Problem, fit_problem
from srfcli.inference.noise import Noise
from srfcli.inference.prediction import Hold, of_run
from srfcli.inference.random_field import LatentFit
from srfcli.laws.expression import symbol
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect

# Which registered effects may be missing in an experiment, and the experiments that have them.

TRACK = ("mu", "slip")
UNMODULATED = {symbol(name): 0 for name in ("modulated", "eps", "envelope")}


@dataclass(frozen=True)
class Excluded:
    """An effect that cannot be found in this experiment, and why."""

    effect: str
    reason: str


def applicable(
    registry: Registry, experiment: Experiment, effects: Sequence[str] | None = None
) -> tuple[list[Effect], list[Excluded]]:
    """Return the effects that the baseline lacks and could have, and those that these recordings cannot show.

    Among the former are those that could join it only beside another one that brings what they need.
    """
    base = open_model(registry, **asdict(experiment.choice))
    found, excluded, waiting = [], [], []
    free = {p.name for p in experiment.parameters if not p.fixed}
    present = [registry.get("effect", name) for name in experiment.choice.effects]
    names = {e.name for e in present}
    had = {p.name: e.name for e in present for p in e.parameters}
    for entry in registry.entries("effect"):
        effect = registry.load(entry)
        assert isinstance(effect, Effect)
        if effects is not None and effect.reported not in effects and effect.name not in effects:
            continue
        if effects is None and effect.on_request:
            continue
        if effect.name in names or any(n in base.names for n in effect.lacks):
            continue
        taken = [p.name for p in effect.parameters if p.name in base.names] if not effect.settings else []
        if taken:  # of the law, or of another effect that the baseline has
            if taken[0] in had:
                reason = f"its parameter {taken[0]} has the name of one of {had[taken[0]]}"
                excluded.append(Excluded(effect.reported, reason))
            continue
        if set(effect.frees) & free:
            continue
        reason = _unseen(effect, experiment)
        if any(n not in base.names for n in effect.needs):
            waiting += [effect] if not reason else []
        elif reason:
            excluded.append(Excluded(effect.reported, reason))
        else:
            found.append(effect)
    brought = {*base.names, *(p.name for e in found if e.settings for p in e.parameters)}
    return [*found, *(e for e in waiting if brought.issuperset(e.needs))], excluded


def _unseen(effect: Effect, experiment: Experiment) -> str:
    """Return why these recordings cannot show an effect at all, or nothing."""
    formulas = {slot: f for slot, f in effect.changes}
    used = {str(s) for f in formulas.values() for s in f.free_symbols}
    loads = [run.load(run.t)[0] for run in experiment.runs]
    spread = max(float(np.ptp(np.log(W))) for W in loads)
    between = float(np.ptp([np.log(W.mean()) for W in loads])) if len(loads) > 1 else 0.0
    if ("W_dot" in used or "W" in formulas or "force" in formulas) and spread < 1e-3:
        return f"the load varies by {100 * spread:.2g} %" if spread > 0 else "the load is constant"
    if {"kappa", "W"} & (used | set(formulas)) and "W" in used and max(spread, between) < 1e-3:
        return f"the loads of all runs lie within {100 * max(spread, between):.2g} %"
    calm = not any(of_run(run)["modulated"] for run in experiment.runs)
    if calm and formulas and all(f.subs(UNMODULATED) == symbol(slot) for slot, f in formulas.items()):
        return "no run has a modulated load"
    return ""


@dataclass(frozen=True)
class Hypothesis:
    """Effects that together with the baseline might have made the recording; none of them for the baseline itself."""

    effects: tuple[Effect, ...] = ()

    @property
    def name(self) -> str:
        """Return the effects' names, or none."""
        return "+".join(e.name for e in self.effects) or "none"

    @property
    def reported(self) -> tuple[str, ...]:
        """Return the names under which a verdict has the effects."""
        return tuple(e.reported for e in self.effects)

    def model(
        self, registry: Registry, experiment: Experiment, *, rough: bool, hold: Hold | None = None,
        random_field: bool = False,
    ) -> GeneratedModel:  # fmt: skip
        """Return the model, with a table along the track if it is rough, and one for the recording if that holds."""
        return open_model(
            registry, **asdict(experiment.choice.plus(_key(registry, e) for e in self.effects)),
            tables=((TRACK,) if rough else ()) + ((hold.table,) if hold else ()), random_field=random_field,
        )  # fmt: skip

    def problem(self, registry: Registry, experiment: Experiment, *, rough: bool, at: Mapping[str, float] | None = None,
                trend: str | None = None, hold: Hold | None = None, random_field: bool = False) -> Problem:  # fmt: skip
        """Return the fit of baseline and effects together, from the values in `at` where there are some."""
        model = self.model(registry, experiment, rough=rough, hold=hold, random_field=random_field)
        added = [q for e in self.effects for q in fit_parameters(e, model, experiment)]
        at = at or {}
        names = {q.name for q in added}
        kept = [q for q in experiment.parameters if q.name not in names]
        listed = tuple(
            replace(q, value=float(np.clip(at.get(q.name, q.value), q.lower, q.upper))) for q in (*kept, *added)
        )
        problem = fit_problem(model, replace(experiment, parameters=listed), trend=trend)
        start = [at.get(n, s) for n, s in zip(problem.names, problem.start, strict=True)]
        return replace(problem, start=np.clip(np.array(start, dtype=float), problem.lower, problem.upper), hold=hold)


def built_beside(hypothesis: Hypothesis, candidates: Sequence[Effect]) -> list[Hypothesis]:
    """Return a hypothesis with each effect that is built in, a mass or an interface: beside others it has no score."""
    present = hypothesis.effects
    reported = {e.reported for e in present}
    built = [e for e in candidates if e.settings and e.reported not in reported]
    return [Hypothesis((e, *present)) for e in built] if present else []


def _key(registry: Registry, effect: Effect) -> str:
    """Return what `open_model` knows an effect by."""
    return effect.name


def own_parameters(effect: Effect, model: GeneratedModel) -> dict[str, Parameter]:
    """Return an effect's parameters by the names they have in a model, where two effects may have one of the same name."""
    found = {}
    for p in effect.parameters:
        long = f"{effect.name.replace('-', '_')}_{p.name}"
        found[long if long in model.names else p.name] = p
    return found


def neutral_values(effect: Effect) -> dict[str, float]:
    """Return the values at which an effect's sizes change nothing, in um, s, N."""
    units = {p.name: p.unit for p in effect.parameters}
    return {name: to_base(value, units[name]) for name, value in effect.neutral}


def fit_parameters(effect: Effect, model: GeneratedModel, experiment: Experiment) -> list[FitParameter]:
    """Return start values and bounds of an effect's parameters in um, s, N: sizes at their neutral values, or just inside."""
    neutral, found = neutral_values(effect), []
    for name, p in own_parameters(effect, model).items():
        low, high = to_base(p.lower, p.unit), to_base(p.upper, p.unit)
        value = float(np.clip(neutral.get(p.name, to_base(p.default, p.unit)), low, high))
        found.append(FitParameter(name, value, low, high, False, p.unit))
    for name in effect.frees:
        if name == "K":
            size, unit = split_quantity(experiment.stiffness_text, name="stiffness")
            value = to_base(size, unit)
            found.append(FitParameter("K", value, 0.2 * value, 5 * value, False, unit))
        elif name == "M":
            found.append(FitParameter("M", 1e-6, 1e-9, 1e-4, False, "kg"))
    return found


def inner_grid(effect: Effect) -> list[dict[str, float]]:
    """Return the values, in um, s, N, at which an effect's inner parameters are tried, all combinations."""
    axes = []
    bounds = {p.name: p for p in effect.parameters}
    for name, count in effect.scans:
        p = bounds[name]
        low, high = to_base(p.lower, p.unit), to_base(p.upper, p.unit)
        if name == "phase":
            axes.append([(name, v) for v in np.linspace(0.0, np.pi, count, endpoint=False).tolist()])
        else:
            spaced = np.geomspace(low, high, count) if low > 0 else np.linspace(max(low, 0.0), high, count)
            axes.append([(name, v) for v in spaced.tolist()])
    return [dict(combination) for combination in product(*axes)]


# A hypothesis, fitted.

DEARER = 0.004  # of chi-squared per degree of freedom while held, what a further effect has to take away
HALFWAY = 1.25  # residual over noise within which a rough track may be what is left
ASTRAY = 3.0  # times the chi-squared of where it came from: a start from which a fit had better be led
PAIRS, ROUGHENED = 3, 2  # how many are fitted with a second effect, at each stage, and on rough tracks
NEAR = 2.5  # residual over noise within which slopes at the fit tell where a better one is


@dataclass(frozen=True)
class Refit:
    """A hypothesis, fitted: its evidence is the log likelihood, tracks integrated out, less what its parameters cost."""

    hypothesis: Hypothesis
    fit: LatentFit
    adequacy: Adequacy
    evidence: float
    rough: bool

    @property
    def name(self) -> str:
        """Return the hypothesis' name."""
        return self.hypothesis.name

    @property
    def halfway(self) -> bool:
        """Return whether it leaves more than noise, and no more than a rough track may be."""
        return not self.adequacy.fine and self.adequacy.rms_over_noise < HALFWAY


@dataclass(frozen=True)
class Entry:
    """A hypothesis while held: parameters (k,), also by name, chi-squared per degree of freedom."""

    hypothesis: Hypothesis
    theta: Array
    values: dict[str, float]
    reduced: float

    @property
    def single(self) -> bool:
        """Return whether it adds one effect."""
        return len(self.hypothesis.effects) == 1

    @property
    def rank(self) -> float:
        """Return what it leaves, and what its effects cost."""
        return self.reduced + DEARER * len(self.hypothesis.effects)


def residuals_of(fitted: LatentFit) -> dict[str, Array]:
    """Return what a fit leaves (n,) of each run."""
    return {r.name: r.observed - fitted.point.predictions[r.name].y for r in fitted.problem.runs}


def judge_fit(fitted: LatentFit, noise: Mapping[str, Noise], runs: Sequence[Run] | None = None) -> Adequacy:
    """Return whether noise is all that a fit leaves, of all its runs or of some."""
    every = fitted.problem.runs if runs is None else runs
    return judge_residuals(every, residuals_of(fitted), noise, freedom=freedom_spent(fitted))


def freedom_spent(fitted: LatentFit) -> dict[str, float]:
    """Return how many parameters' worth of freedom each run's residual has lost, to the track above all."""
    point, n = fitted.point, fitted.point.theta.size
    out = {r.name: n / max(len(fitted.problem.runs), 1) for r in fitted.problem.runs}
    if not point.tracks.splines or not point.roughness.amplitude:
        return out
    L = point.tracks.root(point.roughness)
    M = L.T @ point.N[n:, n:] @ L
    share = np.diag(np.linalg.solve(M + np.eye(M.shape[0]), M))
    at = 0
    weights = []
    for spline in point.tracks.splines:
        weights.append(float(share[at : at + spline.numbers.size].sum()))
        at += spline.numbers.size
    users: dict[int, list[str]] = {}
    for name, i in point.tracks.of.items():
        users.setdefault(i, []).append(name)
    for i, names in users.items():
        for name in names:
            out[name] += weights[i] / len(names)
    return out
