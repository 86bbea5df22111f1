"""Which registered effects may be missing in an experiment, and the models that have them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product

import numpy as np
import sympy as sp

from srfcli.codegen.model import Array, GeneratedModel, open_model
from srfcli.core.settings import Parameter
from srfcli.core.units import to_base
from srfcli.data.scales import at_scale, scales_of
from srfcli.data.values import BOUND_FACTOR, Experiment, FitParameter
from srfcli.inference.fit import Problem, fit_problem
from srfcli.inference.prediction import effect_inputs
from srfcli.laws.expression import symbol
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect
from srfcli.symbolic.system import without_part

NEUTRAL_OFFSET = 1e-3  # of the least size of an effect: what it does in a run where it does not act is far below any noise
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
    base = open_model(registry, **asdict(experiment.choice), random_field=bool(experiment.runs), stability=False)
    scales = scales_of(experiment.runs, experiment.parameters, experiment.thresholds)
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
        effect = at_scale(effect, scales)
        reason = _not_observable(effect, experiment)
        if any(n not in base.names for n in effect.needs):
            waiting += [effect] if not reason else []
        elif reason:
            excluded.append(Excluded(effect.reported, reason))
        else:
            found.append(effect)
    brought = {*base.names, *(p.name for e in found if e.settings for p in e.parameters)}
    return [*found, *(e for e in waiting if brought.issuperset(e.needs))], excluded


def _not_observable(effect: Effect, experiment: Experiment) -> str:
    """Return why recordings and critical loads cannot show an effect at all, or nothing."""
    reasons = []
    if experiment.runs:
        loads = [run.load(run.t)[0] for run in experiment.runs]
        spread = max(float(np.ptp(np.log(W))) for W in loads)
        between = float(np.ptp([np.log(W.mean()) for W in loads])) if len(loads) > 1 else 0.0
        modulated = any(effect_inputs(run)["modulated"] for run in experiment.runs)
        if "V" in dict(effect.changes) and any(s.observable == "slip" for run in experiment.runs for s in run.others):
            reasons.append("the slip that is observed is compared with the drive as it is stated")
        else:
            reasons.append(_not_observable_under(effect, spread, between, "" if modulated else "no run has a modulated load"))
    if experiment.thresholds:
        if reason := without_part(effect):
            reasons.append(f"critical loads do not depend on it: it {reason}")
        else:
            W, eps = (np.concatenate([getattr(t.table, name) for t in experiment.thresholds]) for name in ("W0c", "eps"))
            calm = "" if eps.max() > 0 else "the load is constant"
            reasons.append(_not_observable_under(effect, float(eps.max()), float(np.ptp(np.log(W))), calm))
    return reasons[0] if all(reasons) else ""


def _not_observable_under(effect: Effect, spread: float, between: float, unmodulated: str) -> str:
    """Return why an effect cannot be seen where ln W varies by `spread` while sliding, and by `between` from one time to another.

    `unmodulated` is the reason where no load is modulated.
    """
    formulas = {slot: f for slot, f in effect.changes}
    used = {str(s) for f in formulas.values() for s in f.free_symbols}
    calm = {symbol("W"): symbol("W0")} | {symbol(s.name): s.steady for s in effect.states} | UNMODULATED
    still = {symbol("W"): symbol("W0"), symbol("force"): symbol("force")}
    pressed = [f.subs(calm) != still[symbol(slot)] for slot, f in formulas.items() if slot in ("W", "force")]
    if ("W_dot" in used or (pressed and not any(pressed))) and spread < 1e-3:
        return f"the load varies by {100 * spread:.2g} %" if spread > 0 else "the load is constant"
    if "W" in used and not effect.states and max(spread, between) < 1e-3:
        wide = 100 * max(spread, between)
        return f"the loads of all runs lie within {wide:.2g} %" if wide else "the load is constant, the same in all runs"
    if unmodulated and formulas and all(f.subs(UNMODULATED) == symbol(slot) for slot, f in formulas.items()):
        return unmodulated
    return ""


@dataclass(frozen=True)
class Hypothesis:
    """The baseline with some effects, or with the ageing law `ageing` in place of its own; as it is with neither."""

    effects: tuple[Effect, ...] = ()
    ageing: str = ""

    @property
    def reported(self) -> tuple[str, ...]:
        """Return the names under which a verdict has what was added."""
        return (*((self.ageing,) if self.ageing else ()), *(e.reported for e in self.effects))

    @property
    def name(self) -> str:
        """Return these names joined, each with the run in which alone it acts, if it does; or none."""
        return "+".join(sorted([*self.reported[: bool(self.ageing)], *(e.label for e in self.effects)])) or "none"

    def experiment(self, experiment: Experiment) -> Experiment:
        """Return the experiment under the hypothesis' ageing law."""
        if not self.ageing:
            return experiment
        return replace(experiment, choice=replace(experiment.choice, ageing=self.ageing))

    def model(self, registry: Registry, experiment: Experiment, *, stability: bool = False) -> GeneratedModel:
        """Return the model with a random friction field along slip; that of critical loads for `stability` or without runs."""
        choice = self.experiment(experiment).choice.plus(e.name for e in self.effects)
        stability = stability or not experiment.runs
        return open_model(registry, **asdict(choice), random_field=not stability, stability=stability)

    def priors(self, model: GeneratedModel) -> dict[str, tuple[float, float]]:
        """Return the neutral and the typical size of each effect's parameters in a model, by their names there, in um, s, N."""
        found: dict[str, tuple[float, float]] = {}
        for effect in self.effects:
            neutral, typical = neutral_values(effect), typical_sizes(effect)
            longs = {p.name: long for long, p in own_parameters(effect, model).items()}
            found |= {longs[name]: (neutral[name], size) for name, size in typical.items()}
        return found

    def problem(
        self, registry: Registry, experiment: Experiment, *, at: Mapping[str, float] | None = None, trend: str | None = None
    ) -> Problem:
        """Return the fit of baseline and effects together, from the values in `at` where there are some."""
        experiment = self.experiment(experiment)
        model = self.model(registry, experiment)
        added = [q for e in self.effects for q in fit_parameters(e, model, experiment)]
        added += law_parameters(registry, self.ageing, experiment) if self.ageing else []
        at = at or {}
        names = {q.name for q in added}
        kept = [q for q in experiment.parameters if q.name not in names]
        listed = tuple(replace(q, value=float(np.clip(at.get(q.name, q.value), q.lower, q.upper))) for q in (*kept, *added))
        stability = self.model(registry, experiment, stability=True) if experiment.thresholds else None
        listed_in = replace(experiment, parameters=listed)
        problem = fit_problem(model, listed_in, trend=trend, stability=stability)
        start = [at.get(n, s) for n, s in zip(problem.names, problem.start, strict=True)]
        return replace(problem, start=np.clip(np.array(start, dtype=float), problem.lower, problem.upper))


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


def typical_sizes(effect: Effect) -> dict[str, float]:
    """Return the distance of an effect's sizes from their neutral values in its file's defaults, in um, s, N."""
    neutral = neutral_values(effect)
    return {p.name: abs(to_base(p.default, p.unit) - neutral[p.name]) for p in effect.parameters if p.name in neutral}


def law_parameters(registry: Registry, ageing: str, experiment: Experiment) -> list[FitParameter]:
    """Return start values and bounds, in um, s, N, of what an ageing law has that an experiment does not list."""
    law, _ = registry.ageing(ageing)
    listed, found = {q.name for q in experiment.parameters}, []
    for p in law.parameters:
        if p.name not in listed and p.default > 0:
            low, high = max(p.lower, p.default / BOUND_FACTOR), min(p.upper, p.default * BOUND_FACTOR)
            value, low, high = (to_base(x, p.unit) for x in (p.default, low, high))
            found.append(FitParameter(p.name, value, low, high, False, p.unit))
    return found


def fit_parameters(effect: Effect, model: GeneratedModel, experiment: Experiment) -> list[FitParameter]:
    """Return start values and bounds of an effect's parameters in um, s, N: sizes at their neutral values, or just inside.

    An effect of one run alone is neutral in the others. Where neutral lies outside the bounds, as a time constant of zero, which
    formulas divide by, its value there is off neutral by NEUTRAL_OFFSET of the distance to the bound.
    """
    neutral, found = neutral_values(effect), []
    for name, p in own_parameters(effect, model).items():
        low, high = to_base(p.lower, p.unit), to_base(p.upper, p.unit)
        value = float(np.clip(neutral.get(p.name, to_base(p.default, p.unit)), low, high))
        runs = (effect.run,) if effect.run and p.name in neutral else ()
        absent = neutral[p.name] + NEUTRAL_OFFSET * (value - neutral[p.name]) if runs else 0.0
        found.append(FitParameter(name, value, low, high, p.name in effect.fixed, p.unit, runs, absent))
    for name in effect.frees:
        if name == "K":
            value = experiment.stiffness
            found.append(FitParameter("K", value, 0.2 * value, 5 * value, False, experiment.stated_stiffness[1]))
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
            spaced = np.linspace(0.0, np.pi, count, endpoint=False)
        elif "phase" in bounds and low > 0:  # a wave's length: a recording resolves wavenumbers evenly
            spaced = 1 / np.linspace(1 / high, 1 / low, count)
        else:
            spaced = np.geomspace(low, high, count) if low > 0 else np.linspace(max(low, 0.0), high, count)
        axes.append([(name, v) for v in spaced.tolist()])
    return [dict(combination) for combination in product(*axes)]


@dataclass(frozen=True)
class ProfileFunction:
    """An effect of first order that is a function g of one table's argument and of inner parameters."""

    argument: str
    g: Callable[..., Array]
    inner: tuple[str, ...]


def profile_function(effect: Effect) -> ProfileFunction | None:
    """Return the shape of an effect that adds size * g(slip, time or stage) to mu, or multiplies V by 1 + it; None for others."""
    if len(effect.changes) != 1 or len(effect.sizes) != 1 or effect.states or effect.settings:
        return None
    (slot, formula), size = effect.changes[0], effect.sizes[0]
    if slot not in ("mu", "V"):
        return None
    slope = sp.diff(formula, symbol(size)).subs(symbol(size), sp.nsimplify(neutral_values(effect)[size]))
    if slot == "V":
        slope = sp.simplify(slope / symbol("V"))
    inner = [p.name for p in effect.parameters if p.name != size]
    used = {str(s) for s in slope.free_symbols}
    arguments = used - set(inner)
    tables = {"slip", "time"} if slot == "mu" else {"stage"}
    if len(arguments) != 1 or not arguments <= tables:
        return None
    (argument,) = arguments
    return ProfileFunction(argument, sp.lambdify([symbol(argument), *map(symbol, inner)], slope, "numpy"), tuple(inner))
