"""From what was fitted to what is said: the models that may be it, the gate of held-out runs, a verdict and its confidence.

`conclude` gathers what a search found; `judge` says what follows from that.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, TypeVar

import numpy as np

from srfcli.codegen.model import Array
from srfcli.core.errors import SrfError, Status
from srfcli.core.units import from_base
from srfcli.data.groups import GAUGE_NOISE
from srfcli.data.values import BETWEEN_SAMPLES, Experiment, told_of_runs
from srfcli.diagnosis.goodness_of_fit import (
    failed_tests,
    gauge_noise_tests,
    noise_ratio_over_limit,
    relative_surprisal,
    uneven_noise,
)
from srfcli.diagnosis.hypotheses import Excluded, Hypothesis, typical_sizes
from srfcli.diagnosis.scores import ResidualProjection, Score, run_specific_values
from srfcli.diagnosis.search import LOG_BAYES_MARGIN, MIN_SCORE_GAIN, SEARCH_RTOL, SEARCH_TOLERANCE, Fitted, ModelSearch
from srfcli.inference.critical_loads import Matched
from srfcli.inference.state_space import SIGNIFICANT_GAIN, Filtered, StateSpaceFit, fit_state_space, log_evidence, maximise

ABSORBED_SHARE = 2e-3  # share of an effect's squared signal below which parameters and field leave nothing of it
EQUIVALENT_CORRELATION = 0.97  # likeness of two effects' projected columns beyond which they are one class
VALIDATION_DEFICIT = 50.0  # in log evidence, by how much a model may be behind and still be asked what it predicts
FAILED_TEST_PENALTY = 40.0  # in log evidence, what a model that fails a test loses in the stated confidence
# by what log evidence is divided in the stated confidence, so that confidences are frequencies (benchmarks/calibration.py)
CALIBRATION_TEMPERATURE = 1.83
# maximum-likelihood probabilities (benchmarks/calibration.py): that something else is missing although a model passed, and that
# what is missing is registered, or nothing is missing, where the verdict is unknown
PROB_UNREGISTERED_IF_PASSED, PROB_REGISTERED_IF_UNKNOWN = 0.09, 0.65
UNKNOWN, IN_ONE_RUN = "unknown", "in one run"  # when a remark is told: under these verdicts, or where an effect acts in one run
BASELINE_REJECTED = ("identified", "ambiguous", UNKNOWN)
ALL_VERDICTS = ("none", "inconclusive", *BASELINE_REJECTED)


@dataclass(frozen=True)
class Model:
    """A fitted model as a verdict sees it: log evidence, what speaks against it, its log likelihood of what is `held_out`.

    `parameters` says how many its system has.
    """

    hypothesis: Hypothesis
    evidence: float
    against: tuple[str, ...] = ()
    held_out: float = 0.0
    innovations: tuple[Array, ...] = field(default=(), repr=False, compare=False)
    parameters: int = 0

    @property
    def name(self) -> str:
        """Return the hypothesis' name."""
        return self.hypothesis.name


ModelT = TypeVar("ModelT", Model, Fitted)


@dataclass(frozen=True)
class PredictiveScore:
    """How the best model predicts what is held out: its gain in log likelihood over the baseline, the rms of `size` residuals.

    `followed` and `loud` are of a run: the latter says whether the model needs more gauge noise than it shows, where no run that
    was fitted has its noise. `excess` is of critical loads: how improbable they are; above 1 it is no chance.
    """

    name: str
    gain: float
    rms: float
    size: int
    followed: bool = True
    loud: str = ""
    excess: float = 0.0


@dataclass(frozen=True)
class Conclusion:
    """What follows from a search: a verdict, the effects that it carries, and why.

    `detectable` is the size, in um, s, N, from which each effect could have been seen; `ungated` the verdict, had held-out runs
    no say; `became` which ageing law another one became, by their names.
    """

    verdict: str
    ungated: str
    effects: tuple[str, ...]
    confidence: dict[str, float]
    not_identifiable: tuple[Excluded, ...]
    detectable: dict[str, float]
    equivalent: tuple[tuple[str, ...], ...]
    reasons: tuple[str, ...]
    became: Mapping[str, str]


@dataclass(frozen=True)
class HeldOutRun:
    """One held-out run filtered under the baseline and under the best model, both as they were fitted to the other runs.

    `reported_baseline` is that of the baseline with the best model's field and gauge noise; `models` are the two.
    """

    baseline: Filtered
    augmented: Filtered
    reported_baseline: Filtered
    models: tuple[Fitted, Fitted] = field(repr=False)

    @property
    def predicted(self) -> PredictiveScore:
        """Return how the best model predicts it, with parameters as uncertain as its fit leaves them."""
        run, white = self.baseline.run, self.augmented.white
        before, after = (f.predictive(run) for f in self.models)
        own, loud = after.fit, ""
        if self.models[1].fit.likelihood.has_own_noise(run):
            loud = next((text for size, text in gauge_noise_tests(own.likelihood, own.maximum.point) if size > 1.0), "")
        gain = after.log_likelihood - before.log_likelihood
        return PredictiveScore(run.name, gain, after.rms, white.size, self.augmented.whole, loud)


@dataclass(frozen=True)
class HeldOutLoads:
    """One held-out table of critical loads beside the baseline's and the best model's, as they were fitted to the rest."""

    baseline: Matched
    augmented: Matched
    predicted: PredictiveScore


@dataclass(frozen=True)
class Diagnosis(Conclusion):
    """Everything that is said and what it rests on; `close` are the models that may be it, `best` the one that is reported.

    `reported_baseline` is the baseline with the best model's field and gauge noise, its own parameters fitted again.
    """

    experiment: Experiment
    best: Fitted
    baseline: Fitted
    reported_baseline: Fitted
    ranked: tuple[Fitted, ...]
    close: tuple[Fitted, ...]
    scores: tuple[Score, ...]
    held: tuple[HeldOutRun, ...] = field(repr=False)
    held_loads: tuple[HeldOutLoads, ...] = field(repr=False)

    @property
    def acts_in(self) -> dict[str, str]:
        """Return the run in which alone an effect acts, by the effect's name, of those identified."""
        named = self.best.hypothesis.effects if self.verdict == "identified" else ()
        return {e.reported: e.run for e in named if e.run}


def conclude(search: ModelSearch, whole: Experiment) -> Diagnosis:
    """Return the verdict on a finished search; `whole` is the experiment with its held-out runs, opened only now."""
    own_noise = GAUGE_NOISE in set(search.whole.vary) - set(whole.vary)
    whole = replace(whole, vary=search.whole.vary) if own_noise else whole
    baseline, ranked = search.baseline, tuple(search.ranked())
    told = held_out_likelihoods(models_for_validation(ranked), whole)
    models = [
        Model(f.hypothesis, f.evidence, f.against, told.get(f.name, 0.0), tuple(r.white for r in f.fit.maximum.point.runs),
              len(f.fit.likelihood.problem.model.parameters))
        for f in ranked
    ]  # fmt: skip
    close = tuple(f for m in competing_models(models)[0] for f in ranked if f.name == m.name)
    best = close[0] if close else ranked[0]
    reported_baseline = baseline_with_noise_of(best, baseline) if best.passes else baseline
    held, held_loads = held_out(baseline, best, whole, reported_baseline), held_out_loads(baseline, best, whole)
    wrong = [] if best.passes else [*uneven_noise(best.fit), *unsteady_start(search, best)]
    remarks = [*((text, (UNKNOWN,)) for text in wrong), *parameter_differing_in_one_run(baseline)]
    remarks += [(text, BASELINE_REJECTED) for text in told_of_runs(search.whole.runs, BETWEEN_SAMPLES)]
    if search.on_request:
        names = ", ".join(search.on_request)
        remarks.append(
            (
                f"not tried, as they are on request only: {names}; --effect NAME tries those named and no others",
                (UNKNOWN, IN_ONE_RUN),
            )
        )
    if whole.runs and not baseline.fit.likelihood.problem.runs:
        remarks.append(("held-out runs are not judged, as no run was fitted that would tell the gauge's noise", ALL_VERDICTS))
    if own_noise:
        said = f"each {whole.vary[GAUGE_NOISE]} was given a gauge noise of its own, as no one noise is that of all"
        remarks.append((said, ALL_VERDICTS))
    for fitted in close or (best,):
        for name in at_bounds(fitted):
            there = "" if name in (q.name for q in whole.parameters) else " of the augmented experiment"
            remarks.append((f"{name} of {fitted.name} stands at its bound; [parameters]{there} can widen it", ALL_VERDICTS))
    judged = judge(
        models, baseline.singles, [h.predicted for h in held if best.passes], [h.predicted for h in held_loads],
        search.excluded, remarks, search.budget if search.cut_short else None,
    )  # fmt: skip
    return Diagnosis(
        **vars(judged), experiment=whole, best=best, baseline=baseline, reported_baseline=reported_baseline, ranked=ranked,
        close=close, scores=tuple(baseline.singles), held=held, held_loads=held_loads,
    )  # fmt: skip


def judge(
    ranked: Sequence[Model],
    scores: Sequence[Score] = (),
    held: Sequence[PredictiveScore] = (),
    loads: Sequence[PredictiveScore] = (),
    excluded: Sequence[Excluded] = (),
    remarks: Sequence[tuple[str, Sequence[str]]] = (),
    ended: float | None = None,
) -> Conclusion:
    """Return what follows from models, best evidence first, scores of the baseline, and how what is held out is predicted.

    `remarks` are sentences, each with the verdicts under which it is told, or IN_ONE_RUN, where what is identified acts in one
    run. `ended` is the budget, in s of CPU, of a search that left models to fit.
    """
    close, joint, became = competing_models(ranked)
    best = close[0] if close else ranked[0]
    ungated, reasons = _verdict_and_reasons(best, close, scores, ended is not None)
    refused = holdout_rejection(held, loads) if ungated != "unknown" else ""
    verdict = "unknown" if refused else ungated
    alone = verdict == "identified" and any(e.run for e in best.hypothesis.effects)
    reasons += [refused] if refused else []
    reasons += [text for text, under in remarks if verdict in under or (alone and IN_ONE_RUN in under)]
    if ended is not None:
        reasons.append(f"the search ended at its budget of {ended:.0f} s of CPU, with models left to fit")
    named = tuple(dict.fromkeys(n for m in close for n in m.hypothesis.reported))
    failed = [e for e in excluded if e.effect not in joint]  # one attempt may fail and another not
    absorbed = [
        Excluded(s.effect.reported, f"the baseline's parameters and field absorb {100 * (1 - s.tolerance):.2f} % of it")
        for s in scores
        # found all the same
        if s.tolerance < ABSORBED_SHARE and s.detectable > relevant_effect_size(s) and s.effect.reported not in named
    ]
    return Conclusion(
        verdict, ungated, {"identified": best.hypothesis.reported, "ambiguous": named}.get(verdict, ()),
        _confidence(ranked, joint, became, verdict), tuple(dict.fromkeys((*failed, *absorbed))),
        {s.effect.reported: s.detectable for s in scores}, _equivalent(scores, close, ranked, joint), tuple(reasons), became,
    )  # fmt: skip


def unsteady_start(search: ModelSearch, best: Fitted) -> list[str]:
    """Return what to try where the baseline explains more than the best model from a start that is no steady sliding."""
    experiment = search.experiment
    if search.spent or all(run.initial == "free" for run in experiment.runs):
        return []
    runs = tuple(replace(run, initial="free") for run in experiment.runs)
    problem = Hypothesis().problem(search.registry, replace(experiment, runs=runs), trend=search.trend)
    found = None
    with contextlib.suppress(SrfError), search.within_budget():
        found = fit_state_space(
            problem, cautious=True, beside=False, close=SEARCH_TOLERANCE, rtol=SEARCH_RTOL, progress=search.progress
        )
    if found is None:
        return []
    gain = log_evidence(found) - best.separate_field_evidence
    then = "" if failed_tests(found) else ", and every test is passed"
    said = f'the baseline with initial = "free", the state at the first sample estimated, gains {gain:.0f} in log evidence{then}'
    return [said] if gain > LOG_BAYES_MARGIN else []


def parameter_differing_in_one_run(baseline: Fitted) -> list[tuple[str, Sequence[str]]]:
    """Return which parameter of the baseline differs in one run, and where it is told.

    Where an effect was found, that is only if it gains more, at first order, than any effect.
    """
    own = next(iter(run_specific_values(baseline.projection)), None)
    if own is None or own.gain < MIN_SCORE_GAIN:
        return []
    gains = [s.gain for s in (*baseline.singles, *(baseline.scores.single_run if baseline.scores else ()))]
    value, unit = baseline.fit.values[own.parameter], baseline.fit.likelihood.problem.unit_of(own.parameter)
    there, here = (f"{from_base(x, unit):.3g}{'' if unit == '1' else ' ' + unit}" for x in (value + own.change, value))
    said = f"{own.parameter} of {own.run} alone, about {there} where the baseline has {here}"
    said = f"{said}, would gain {own.gain:.0f} in log likelihood: --vary {own.parameter}"
    return [(said, (UNKNOWN,) if own.gain < max(gains, default=0.0) else (UNKNOWN, IN_ONE_RUN))]


def models_for_validation(ranked: Sequence[ModelT]) -> list[ModelT]:
    """Return the models that are asked what they say of what is held out: those that pass and are not far behind."""
    least = ranked[0].evidence - (LOG_BAYES_MARGIN if ranked[0].against else VALIDATION_DEFICIT)
    return [m for m in ranked if not m.against and m.evidence > least]


def competing_models(ranked: Sequence[Model]) -> tuple[tuple[Model, ...], dict[str, float], dict[str, str]]:
    """Return the models that pass and may be it, best first, and the log evidence of each model on all runs together.

    That is its evidence on the runs fitted and its likelihood of the runs held out, for those that pass; the others are given
    the same likelihood as the best of these. Of two that come close one that holds the other gives way, and one that
    became the other; of an effect in all runs or in one, that which is worse. The third is which became which, by name.
    """
    passed = models_for_validation(ranked)
    told = {m.name: m.held_out for m in passed}
    if not any(np.isfinite(t) for t in told.values()):  # no model follows what is held out
        told = {}
    passed.sort(key=lambda m: -m.evidence - told.get(m.name, 0.0))
    rest = told.get(passed[0].name, 0.0) if passed else 0.0
    joint = {m.name: m.evidence + told.get(m.name, rest) for m in ranked}
    close = [m for m in passed if joint[passed[0].name] - joint[m.name] < LOG_BAYES_MARGIN]
    names = [set(m.hypothesis.reported) for m in close]
    close = [m for m, own in zip(close, names, strict=True) if not any(n < own for n in names)]
    best: dict[frozenset[str], Model] = {}
    for m in close:
        best.setdefault(frozenset(m.hypothesis.reported), m)
    became = {}
    for m in close:
        laws = [other for other in close if _reduces_to_law(m, other, joint)]
        if laws:
            became[m.name] = min(laws, key=lambda law: law.parameters).name
    return tuple(m for m in best.values() if m.name not in became), joint, became


def held_out_likelihoods(fits: Sequence[Fitted], whole: Experiment) -> dict[str, float]:
    """Return the log likelihood of all that is held out, by each model, its parameters as uncertain as its fit leaves them."""
    told = {}
    for f in fits:
        own = f.fit.likelihood
        told[f.name] = sum(f.predictive(run).log_likelihood for run in whole.runs if run.holdout and own.problem.runs)
        told[f.name] += sum(own.held_out_table(t, f.fit.values).log_likelihood for t in whole.thresholds if t.holdout)
    under = [f for f in fits if f.shared is not None]
    if 0 < len(under) < len(fits):  # what is a function of slip tells a held-out run on the same track, as a field there would
        gain = shared_gain(max(under, key=lambda f: f.separate_field_evidence), whole)
        told |= {f.name: told[f.name] + gain for f in under}
    return told


def shared_gain(fitted: Fitted, whole: Experiment) -> float:
    """Return what held-out runs gain in log likelihood under a model by a field that all runs share, at first order."""
    total, known = 0.0, fitted.fit.likelihood.problem.runs
    for fit in (fitted.predictive(run).fit for run in whole.runs if run.holdout and known):
        if np.isfinite(fit.log_likelihood):
            every = replace(fit, maximum=replace(fit.maximum, point=fit.likelihood.at(fit.maximum.point.x)))
            fit.likelihood.best = None  # derivatives of all readings take much room
            total += max(ResidualProjection(every).shared.gain - SIGNIFICANT_GAIN - (fitted.shared or 0.0), 0.0)
    return total


def _reduces_to_law(model: Model, other: Model, evidence: Mapping[str, float]) -> bool:
    """Return whether a model became what another ageing law is that has fewer parameters: the innovations are the same.

    Either without effects or beside the same ones.
    """
    beside = other.hypothesis.reported[1:]
    if not other.hypothesis.ageing or other is model or (beside and beside != model.hypothesis.reported[1:]):
        return False
    if model.parameters <= other.parameters or evidence[model.name] - evidence[other.name] > SIGNIFICANT_GAIN:
        return False
    whites = zip(model.innovations, other.innovations, strict=True)
    return float(sum(np.sum((a - b) ** 2) for a, b in whites)) < 2 * LOG_BAYES_MARGIN


def baseline_with_noise_of(best: Fitted, baseline: Fitted) -> Fitted:
    """Return the baseline with field and gauge noise of a better model, its own parameters fitted again from those of that one.

    By itself it widens the field until that takes up what is missing, and nothing is left to be seen.
    """
    if best is baseline or not baseline.fit.likelihood.problem.runs:
        return baseline
    problem = baseline.fit.likelihood.problem
    likelihood = best.fit.likelihood.beside(problem)
    fixed = [n for n in likelihood.names if n not in problem.names]
    found = maximise(likelihood, likelihood.coordinates(best.fit.values), fixed=fixed, close=SEARCH_TOLERANCE)
    if found.status is Status.INTEGRATION:
        return baseline
    return replace(baseline, fit=StateSpaceFit(likelihood, found))


def held_out(
    baseline: Fitted, best: Fitted, whole: Experiment, reported_baseline: Fitted | None = None
) -> tuple[HeldOutRun, ...]:
    """Return every held-out run under two fitted models, and under the baseline as it is shown, if that is another."""
    if not baseline.fit.likelihood.problem.runs:
        return ()  # of a gauge that nothing was fitted to
    models = (baseline, best, reported_baseline or baseline)
    runs = (run for run in whole.runs if run.holdout)
    sides = ([f.fit.likelihood.held_out(run, f.fit.values) for f in models] for run in runs)
    return tuple(HeldOutRun(first, last, seen, (baseline, best)) for first, last, seen in sides)


def held_out_loads(baseline: Fitted, best: Fitted, whole: Experiment) -> tuple[HeldOutLoads, ...]:
    """Return every held-out table of critical loads under two fitted models."""
    found = []
    for loads in (t for t in whole.thresholds if t.holdout):
        before, after = (f.fit.likelihood.held_out_table(loads, f.fit.values) for f in (baseline, best))
        spread = np.eye(after.white.size) + after.slopes @ best.fit.covariance @ after.slopes.T
        cost = float(after.white @ np.linalg.solve(spread, after.white))
        gain, size = after.log_likelihood - before.log_likelihood, after.white.size
        rms, excess = float(np.sqrt(after.match.cost / size)), relative_surprisal(cost, size)
        found.append(HeldOutLoads(before, after, PredictiveScore(loads.name, gain, rms, size, excess=excess)))
    return tuple(found)


def _verdict_and_reasons(best: Model, close: Sequence[Model], scores: Sequence[Score], cut_short: bool) -> tuple[str, list[str]]:
    if best.against:
        return "unknown", [f"{best.name}: {reason}" for reason in best.against]
    reasons = [f"{best.name if best.hypothesis.reported else 'the baseline'} passes every test"]
    if not best.hypothesis.reported:
        if cut_short:
            return "inconclusive", [*reasons, "models that may explain more were not fitted"]
        seen = [s for s in scores if s.detectable < relevant_effect_size(s)]
        if 2 * len(seen) >= len(scores):
            return "none", [*reasons, "the baseline explains the recordings"]
        return "inconclusive", [*reasons, "nothing is needed, and most effects of interesting size could not have been seen"]
    if len(close) > 1:
        return "ambiguous", [*reasons, "several models do equally well: " + ", ".join(m.name for m in close)]
    return "identified", reasons


def holdout_rejection(runs: Sequence[PredictiveScore], loads: Sequence[PredictiveScore] = ()) -> str:
    """Return why held-out runs and critical loads refuse the best model; nothing where they do not.

    Were a model true, another one would predict new data better by LOG_BAYES_MARGIN in log likelihood in exp(-LOG_BAYES_MARGIN)
    of cases at most, as the ratio of their likelihoods is one on average.
    """
    for table in loads:
        if table.excess > 1.0:
            return f"held-out critical loads are not predicted: {table.name} has chi2 {table.size * table.rms**2:.1f}"
    more = sum(r.gain for r in runs) + sum(t.gain for t in loads)
    if loads and more < -LOG_BAYES_MARGIN:
        return f"what is held out is predicted worse than by the baseline: log likelihood {more:+.1f}"
    if not runs:
        return ""
    if not all(r.followed for r in runs):
        return "held-out runs cannot be followed"
    if loud := next((f"what is left in {r.name} as noise, {r.loud}" for r in runs if r.loud), ""):
        return f"held-out runs are not predicted: with {loud}"
    worst = max(runs, key=lambda r: noise_ratio_over_limit(r.rms, r.size))
    if not noise_ratio_over_limit(worst.rms, worst.size) < 1.0:
        said = f"innovations of {worst.name} have an rms of {worst.rms:.3f} with the parameters moved as they may"
        return f"held-out runs are not predicted: {said}"
    gain = sum(r.gain for r in runs)
    if gain < -LOG_BAYES_MARGIN:
        return f"held-out runs are predicted worse than by the baseline: log likelihood {gain:+.1f}"
    return ""


def relevant_effect_size(score: Score) -> float:
    """Return the size of an effect that matters, in um, s, N: what its plugin gives as default, from its neutral value."""
    if not score.effect.sizes:
        return float("inf") if "K" not in score.effect.frees else 0.1 * abs(score.values["K"])
    return typical_sizes(score.effect)[score.effect.sizes[0]]


def at_bounds(fitted: Fitted) -> list[str]:
    """Return the model's parameters that stand at a bound, those of field and gauge left out."""
    return fitted.fit.likelihood.at_bounds(fitted.fit.maximum.point.x)


def _equivalent(
    scores: Sequence[Score], close: Sequence[Model], ranked: Sequence[Model], joint: Mapping[str, float]
) -> tuple[tuple[str, ...], ...]:
    """Return the pairs of effects whose signals no parameter change tells apart, and that matter here.

    First-order signals do not count where both were fitted and their log evidence tells them apart.
    """
    names = {n for m in close for n in m.hypothesis.reported}
    fitted = {frozenset(m.hypothesis.reported): joint[m.name] for m in reversed(ranked)}  # the best of each

    def apart(one: str, other: str) -> bool:
        sets = [set(m.hypothesis.reported) for m in close if one in m.hypothesis.reported]
        return any(fitted[frozenset(s)] - fitted.get(frozenset(s - {one} | {other}), np.inf) > LOG_BAYES_MARGIN for s in sets)

    found = []
    for a, b in combinations(scores, 2):
        one, other = a.effect.reported, b.effect.reported
        alike = ({one, other} & names or not names) and abs(float(a.direction @ b.direction)) > EQUIVALENT_CORRELATION
        if alike and not (apart(one, other) or apart(other, one)):
            found.append((one, other))
    return tuple(found)


def _confidence(ranked: Sequence[Model], joint: Mapping[str, float], became: Mapping[str, str], verdict: str) -> dict[str, float]:
    """Return the stated confidence in each model, by tempered evidence, in `unknown`, in what was `missed` where none passes.

    A model that became another law is that law.
    """
    weights = {m.name: joint[m.name] - (FAILED_TEST_PENALTY if m.against else 0.0) for m in ranked}
    top = max(weights.values())
    share = {name: float(np.exp(max((w - top) / CALIBRATION_TEMPERATURE, -60.0))) for name, w in weights.items()}
    total, unknown = sum(share.values()), 1 - PROB_REGISTERED_IF_UNKNOWN if verdict == "unknown" else PROB_UNREGISTERED_IF_PASSED
    for name, law in became.items():
        while law in became:  # each has fewer parameters than the one before
            law = became[law]
        share[law] += share[name]
        share[name] = 0.0
    passed = any(not m.against for m in ranked)  # else none of them is it
    found = {name: (1 - unknown) * v / total if passed else 0.0 for name, v in share.items()}
    found |= {"unknown": unknown} | ({} if passed else {"missed": 1 - unknown})
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def parameters_of(fitted: Fitted) -> dict[str, dict[str, Any]]:
    """Return the free parameters in declared units with standard errors, NaN at a bound; a stiffness over the stated one too."""
    problem, values, k = fitted.fit.likelihood.problem, fitted.fit.values, len(fitted.fit.likelihood.problem.names)
    errors = np.sqrt(np.maximum(np.diag(fitted.fit.covariance)[:k], 0.0))
    errors[[problem.names.index(name) for name in at_bounds(fitted)]] = np.nan
    found: dict[str, dict[str, Any]] = {}
    for name, error in zip(problem.names, errors.tolist(), strict=True):
        unit = problem.unit_of(name)
        found[name] = {"value": from_base(values[name], unit), "stderr": from_base(error, unit), "unit": unit}
    if "K" in found:
        stated = from_base(problem.experiment.stiffness, found["K"]["unit"])
        found["ratio"] = {k: found["K"][k] / stated for k in ("value", "stderr")} | {"unit": "1"}
    return found


def added(fitted: Fitted, baseline: Fitted) -> dict[str, dict[str, Any]]:
    """Return the parameters that a model has and the baseline has not, those of single runs left out."""
    own = {q.name for q in baseline.fit.likelihood.problem.experiment.parameters}
    return {n: v for n, v in parameters_of(fitted).items() if n not in own and "." not in n}
