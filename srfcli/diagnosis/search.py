"""The search for what a model lacks, over state-space fits: one queue, one score, one budget.

A model is the baseline with a set of effects, or with another ageing law. Each model that was fitted says, at first order, what
each effect could still explain; the model that promises most is fitted next. The score of a model is its log marginal likelihood
by Laplace's method, with flat priors within the bounds of its parameters and a prior on the number of effects. The search ends
when the best model passes its tests and nothing that is left promises to come close, or when the budget is spent.
Best-first search: Pearl, Heuristics, 1984; Laplace's method: Kass and Raftery, JASA 90 (1995).
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from srfcli.core.errors import SrfError, Status
from srfcli.core.units import find_unit, from_base, split_quantity, to_base
from srfcli.data.values import Experiment
from srfcli.diagnosis.hypotheses import Excluded, Hypothesis, applicable, neutral_values, own_parameters
from srfcli.diagnosis.scores import Remainder, Score, Scores
from srfcli.diagnosis.sensitivities import along_table
from srfcli.inference.fit import Problem
from srfcli.inference.noise import stretches, white_level
from srfcli.inference.state_space import (
    NEEDED,
    Filtered,
    Likelihood,
    StateSpaceFit,
    as_fit,
    correlated,
    fit_state_space,
    maximise,
    typical_friction,
)
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect

WORTH = 12.0  # gain in log likelihood that an effect must bring: 300 columns are looked at, each at p = 1e-6
CLOSE = 6.0  # log evidence within which two models may both be it: a Bayes factor of 400
LARGEST = 2  # effects of a model
SINGLES, PAIRS = 5, 3  # promises of each model that are followed
DEVIATION = 4.5  # standard deviations at which a test of what a fit leaves fails: a dozen tests, five runs
PLAUSIBLE = (
    3e-3  # amplitude of a random friction field over mu beyond which it is not the track's: ten times a polished one
)
NEAR = 0.5  # standard errors from its maximum to which a model is fitted: 0.1 in log likelihood
COARSE = 1e-3  # tolerance of the integration: 0.02 in log likelihood
LOST = 3.0  # standard errors from its maximum at which a fit is none
LOUD = 1.15  # gauge noise over that which differences of the recording show, beyond which it holds something else
BUDGET = 150.0  # s of CPU
SHARES = (1.0, 0.5, 0.2, 0.05)  # of the expected sizes, from which a model is fitted: the likeliest
ASTRAY = 1000.0  # in log likelihood below its parent, from where a model is not fitted
BUILT = 16  # sizes of what is built in, a mass or an interface, that are tried
FAR = 2.5  # by what factor a size that is built in is changed, at most, where the model fails a test
AGAIN = 6  # of them, about the best, whose other parameters are fitted too where the model fails a test
HINT = 4.0  # gain in log likelihood from which an effect is fitted where what is random may have taken it up: p = 0.005
FOLLOWED = (
    0.3  # least amplitude of the field from which an extended model is fitted, over that from which a baseline is
)
TEMPER = 3.0  # by which log evidence is divided before it becomes a stated confidence, until a bank says better
LACKING = 40.0  # in log evidence, what a model that fails a test loses in the stated confidence
UNEXPLAINED = 0.03  # least share of the confidence that something is missing that is not registered
HELD = 1.2  # rms of the innovations of held-out runs beyond which a model does not predict them


@dataclass(frozen=True)
class Model:
    """The baseline with some effects, or with the ageing law `ageing` instead of its own."""

    effects: tuple[Effect, ...] = ()
    ageing: str = ""

    @property
    def reported(self) -> tuple[str, ...]:
        """Return the names under which a verdict has what was added."""
        return (*((self.ageing,) if self.ageing else ()), *(e.reported for e in self.effects))

    @property
    def name(self) -> str:
        """Return these names joined, or none."""
        return "+".join(sorted(self.reported)) or "none"


@dataclass(frozen=True)
class Fitted:
    """A model fitted: log evidence, what speaks against it (nothing where it passes), what it leaves, what effects promise.

    The evidence holds what a field that all runs share gains beyond CLOSE, unless an effect says what all runs share along slip.
    """

    model: Model
    fit: StateSpaceFit
    evidence: float
    against: tuple[str, ...]
    remainder: Remainder = field(repr=False)
    scores: Scores | None = field(default=None, repr=False)

    @property
    def fine(self) -> bool:
        """Return whether the model passes every test of what a fit leaves."""
        return not self.against

    @property
    def promised(self) -> Sequence[Score]:
        """Return the scores of the effects that it lacks, largest first."""
        return self.scores.singles if self.scores else ()


@dataclass(order=True)
class _Move:
    """A model to be fitted: what its evidence is expected to be, negative, as a heap gives the smallest first."""

    expected: float
    number: int
    model: Model = field(compare=False)
    values: dict[str, float] = field(compare=False)
    sizes: tuple[dict[str, float], ...] = field(compare=False)
    least: float = field(compare=False, default=-np.inf)  # log likelihood from which it is worth a fit
    fresh: int = field(compare=False, default=0)  # how many of the last effects are at sizes that are only expected
    again: bool = field(compare=False, default=False)  # fitted before, from other sizes


class ModelSearch:
    """One diagnosis on its way; `experiment` holds no held-out runs."""

    def __init__(
        self,
        registry: Registry,
        experiment: Experiment,
        progress: Callable[[str], None] = lambda text: None,
        effects: Sequence[str] | None = None,
        trend: str | None = None,
        *,
        budget: float = BUDGET,
        threads: int = 1,
    ) -> None:
        self.registry, self.experiment, self.progress, self.trend = registry, experiment, progress, trend
        self.candidates, self.excluded = applicable(registry, experiment, effects)
        self.budget, self.threads, self.begun = budget, threads, time.process_time()
        self.fitted: dict[str, Fitted] = {}
        self.queue: list[_Move] = []
        self.count = 0
        self.processes = 0

    # ------------------------------------------------------------------ models and their fits

    def fit(self, move: _Move | None) -> Fitted:
        """Return a model fitted from where its parent stands, and judged; the baseline from the file's own start values."""
        model = move.model if move else Model()
        hypothesis, experiment = Hypothesis(model.effects), self._experiment(model)
        values = self._started(move, experiment) if move else {}
        problem = hypothesis.problem(
            self.registry, experiment, rough=False, at=values, trend=self.trend, random_field=True
        )
        found = fit_state_space(
            problem, start=values if move else None, processes=self.processes if move else None, close=NEAR,
            rtol=COARSE, threads=self.threads, progress=self.progress,
        )  # fmt: skip
        self.processes = found.likelihood.processes
        return self._judged(model, found)

    def _started(self, move: _Move, experiment: Experiment) -> dict[str, float]:
        """Return where a model is fitted from: the sizes that its scores expect, or a part of them where that is likelier."""
        hypothesis = Hypothesis(move.model.effects)
        own = hypothesis.model(self.registry, experiment, rough=False, random_field=True)
        best: tuple[float, dict[str, float]] = (-np.inf, {})
        for share in SHARES:
            values = dict(move.values)
            for number, (effect, sizes) in enumerate(zip(move.model.effects, move.sizes, strict=True)):
                part = share if number >= len(move.sizes) - move.fresh else 1.0
                longs = {p.name: long for long, p in own_parameters(effect, own).items()}
                neutral = neutral_values(effect)
                for name, value in sizes.items():
                    still = neutral.get(
                        name, move.values.get("K", experiment.runs[0].stiffness) if name == "K" else None
                    )
                    values[longs.get(name, name)] = value if still is None else still + part * (value - still)
            problem = hypothesis.problem(
                self.registry, experiment, rough=False, at=values, trend=self.trend, random_field=True
            )
            values = _followable(values, problem)
            likelihood = Likelihood(problem, processes=self.processes, threads=self.threads, rtol=COARSE)
            found = likelihood.at(likelihood.coordinates(values), slopes=False).log_likelihood
            if found > best[0]:
                best = found, values
            elif np.isfinite(best[0]):
                break
        if not best[0] > move.least:
            raise SrfError("no size of it follows the recordings from where its parent stands")
        return best[1]

    def _judged(self, model: Model, found: StateSpaceFit) -> Fitted:
        remainder = Remainder(found)
        evidence = log_evidence(found) + self._prior(model)
        if not any((shape := along_table(e)) and shape.argument == "slip" for e in model.effects):
            evidence += max(remainder.shared.gain - CLOSE, 0.0)  # a track is a function of slip or a random one
        return Fitted(model, found, evidence, tuple(shortcomings(found)), remainder)

    def _prior(self, model: Model) -> float:
        """Return the log prior of a model: each effect is one of those that there are, and halves its share."""
        return -len(model.reported) * float(np.log(2 * max(len(self.candidates), 1)))

    def _experiment(self, model: Model) -> Experiment:
        if not model.ageing:
            return self.experiment
        return replace(self.experiment, choice=replace(self.experiment.choice, ageing=model.ageing))

    # ------------------------------------------------------------------ the search

    def run(self) -> Fitted:
        """Return the best model; `ranked` has all that were fitted."""
        self.progress("baseline")
        base = self._record(self.fit(None))
        base = self._expand(base)
        self._search()
        for further in (self._together, self._swap):  # dearer, or less likely
            if not self.best().fine and not self.spent:
                further(base)
                self._search()
        self._eliminate()
        return self.best()

    @property
    def share(self) -> float:
        """Return the share of the budget that is used, from 0 to 1."""
        return min((time.process_time() - self.begun) / self.budget, 1.0)

    @property
    def spent(self) -> bool:
        """Return whether the budget is used up."""
        return time.process_time() - self.begun > self.budget

    def _search(self) -> None:
        while self.queue and not self.spent:
            move = heapq.heappop(self.queue)
            best = self.best()
            if -move.expected < best.evidence + (-CLOSE if best.fine else CLOSE):
                break  # nothing that is left comes close, or would mend what is wrong
            if move.model.name in self.fitted and self.fitted[move.model.name].evidence > -move.expected - WORTH:
                continue
            self.progress(f"{move.model.name}: expected log evidence {-move.expected:.1f}, best {best.evidence:.1f}")
            try:
                found = self._record(self.fit(move))
            except SrfError as error:
                self.excluded.append(Excluded(move.model.name, error.message))
                continue
            if found is self.best() and not found.fine and not move.again:
                again = self._again(found)
                if again:
                    heapq.heappush(self.queue, again)
                    continue
            if found is self.best() and len(found.model.effects) < LARGEST:
                self._expand(found)

    def _expand(self, node: Fitted) -> Fitted:
        """Push what a fitted model promises: one more effect, two at once, something built in, another ageing law."""
        present = node.model.effects
        names = {e.reported for e in present}
        there = {p.name for p in node.fit.likelihood.problem.model.parameters}
        joining = [e for e in self.candidates if e.reported not in names and there.issuperset(e.needs)]
        self.progress(f"{node.model.name}: scores")
        scores = Scores(self.registry, self._experiment(node.model), node.remainder, present, joining)
        self.excluded += scores.excluded
        node = replace(node, scores=scores)
        self.fitted[node.model.name] = node
        one = -float(np.log(2 * len(self.candidates))) - 3.0  # prior and Occam's factor of an effect
        least = WORTH if node.fine else WORTH / 2
        if node.fine and not node.model.reported and (not node.fit.smooth or node.fit.likelihood.processes):
            least = HINT
        for score in [s for s in scores.singles if s.gain > least][:SINGLES]:
            model = Model((*present, score.effect), node.model.ageing)
            self._push(node.evidence + score.gain + one, model, node, (*self._sizes(node), score.values))
        if not node.fine:
            for effect in (e for e in joining if e.settings or e.observed):
                self._build(node, effect, one)
        return node

    def _sizes(self, node: Fitted, values: Mapping[str, float] | None = None) -> tuple[dict[str, float], ...]:
        """Return the values of a model's effects, those fitted if left out, by the effects' own names."""
        model, values = node.fit.likelihood.problem.model, values or node.fit.values
        return tuple(
            {p.name: values[long] for long, p in own_parameters(e, model).items() if long in values}
            | {n: values[n] for n in e.frees if n in values}
            for e in node.model.effects
        )

    def _push(self, expected: float, model: Model, parent: Fitted, sizes: tuple[dict[str, float], ...]) -> None:
        self.count += 1
        fresh = len(model.effects) - len(parent.model.effects)
        least = parent.fit.log_likelihood - ASTRAY
        heapq.heappush(self.queue, _Move(-expected, self.count, model, dict(parent.fit.values), sizes, least, fresh))

    def _likelihood(self, model: Model, node: Fitted, name: str) -> Likelihood | None:
        """Return the likelihood of a model beside a fitted one; what cannot be joined is left out, with the reason."""
        try:
            problem = Hypothesis(model.effects).problem(
                self.registry,
                self._experiment(model),
                rough=False,
                at=node.fit.values,
                trend=self.trend,
                random_field=True,
            )
        except SrfError as error:
            self.excluded.append(Excluded(name, error.message))
            return None
        return Likelihood(problem, processes=self.processes, threads=self.threads, rtol=COARSE)

    def _build(self, node: Fitted, effect: Effect, one: float) -> None:
        """Push an effect whose model has other unknowns: from the likeliest of a few sizes, after a few steps from there."""
        model = Model((*node.model.effects, effect), node.model.ageing)
        likelihood = self._likelihood(model, node, effect.reported)
        if likelihood is None:
            return
        problem = likelihood.problem
        own = [n for n in problem.names if n not in node.fit.likelihood.problem.names]
        place = likelihood.names.index(own[0])
        x = likelihood.coordinates(_followable(node.fit.values, problem))
        low, high = (likelihood.values(edge)[own[0]] for edge in (likelihood.lower, likelihood.upper))
        trials = []
        for size in np.geomspace(max(low, 1e-3 * high), high, BUILT):
            y = x.copy()
            y[place] = np.log(size) if likelihood.logarithmic[place] else size
            trials.append((likelihood.at(y, slopes=False).log_likelihood, y))
        best, x = max(trials, key=lambda t: t[0])
        if np.isfinite(best):
            found = maximise(likelihood, x, steps=4, close=1.0, progress=self.progress)
            values = found.point.values
            self.count += 1
            expected = found.point.log_likelihood - node.fit.log_likelihood + node.evidence + one
            sizes = (*self._sizes(node), {own[0]: values[own[0]]})
            heapq.heappush(self.queue, _Move(-expected, self.count, model, dict(values), sizes))

    def _again(self, node: Fitted) -> _Move | None:
        """Return a model that fails a test from another size of what is built in, where that is likelier: a false maximum."""
        built = [p.name for e in node.model.effects if e.settings for p in e.parameters]
        likelihood = node.fit.likelihood
        name = next((n for n in likelihood.problem.names if n in built), None)
        if name is None:
            return None
        trials = []
        for ratio in np.geomspace(1 / FAR, FAR, AGAIN):
            values = _followable(node.fit.values, likelihood.problem)
            y = likelihood.coordinates({**values, name: values[name] * ratio})
            trials.append(maximise(likelihood, y, held=[name], steps=3, close=1.0, progress=self.progress))
        likeliest = max(trials, key=lambda f: f.point.log_likelihood)
        found = maximise(likelihood, likeliest.point.x, steps=4, close=1.0, progress=self.progress)
        gain = found.point.log_likelihood - node.fit.log_likelihood
        if gain < NEEDED:
            return None
        self.count += 1
        values = dict(found.point.values)
        expected = node.evidence + gain + WORTH
        return _Move(-expected, self.count, node.model, values, self._sizes(node, values), again=True)

    def _together(self, node: Fitted) -> None:
        """Push the pairs of effects that promise more together than the best alone."""
        if node.scores is None or not node.promised:
            return
        one = -float(np.log(2 * len(self.candidates))) - 3.0
        for pair in node.scores.pairs(PAIRS):
            if pair.gain > node.promised[0].gain + WORTH:
                self._push(node.evidence + pair.gain + 2 * one, Model(pair.effects), node, pair.values)

    def _swap(self, node: Fitted) -> None:
        """Push the other registered ageing laws, each after a few steps from where the model stands."""
        stated, *modifiers = self.experiment.choice.ageing.split("+")
        for entry in self.registry.entries("ageing"):
            if entry.name == stated:
                continue
            model = Model((), "+".join([entry.name, *modifiers]))
            likelihood = self._likelihood(model, node, entry.name)
            if likelihood is None:
                continue
            x = likelihood.coordinates(_followable(node.fit.values, likelihood.problem))
            found = maximise(likelihood, x, steps=3, close=1.0, progress=self.progress)
            if found.status is Status.INTEGRATION:
                continue
            self.count += 1
            expected = found.point.log_likelihood - node.fit.log_likelihood + node.evidence
            heapq.heappush(self.queue, _Move(-expected, self.count, model, dict(found.point.values), ()))

    def _eliminate(self) -> None:
        """Refit the parts of the best model, and of those that come close, alone from its parameters (backward elimination)."""
        top = self.best().evidence
        close = [f for f in self.ranked() if top - f.evidence < CLOSE and len(f.model.effects) > 1]
        for node in close:
            for effect, own in zip(node.model.effects, self._sizes(node), strict=True):
                part = Model((effect,), node.model.ageing)
                known = self.fitted.get(part.name)
                if known is not None and known.fine and known.evidence > top - CLOSE:
                    continue
                if any(n not in self._stated for n in effect.needs):
                    continue  # it is nothing without the other
                try:
                    self._record(self.fit(_Move(0.0, 0, part, dict(node.fit.values), (own,))))
                except SrfError as error:
                    self.excluded.append(Excluded(part.name, error.message))

    @cached_property
    def _stated(self) -> frozenset[str]:
        """Return the parameters of the baseline's model."""
        model = Hypothesis().model(self.registry, self.experiment, rough=False, random_field=True)
        return frozenset(model.names)

    def _record(self, found: Fitted, *, anew: bool = False) -> Fitted:
        name = found.model.name
        known = self.fitted.get(name)
        text = f"log evidence {found.evidence:.1f}" + (f", but {found.against[0]}" if found.against else "")
        self.progress(f"{name}: {text}")
        if known is None or anew or found.evidence > known.evidence:
            self.fitted[name] = found
        return self.fitted[name]

    def ranked(self) -> list[Fitted]:
        """Return everything that was fitted, best evidence first."""
        return sorted(self.fitted.values(), key=lambda f: -f.evidence)

    def best(self) -> Fitted:
        """Return the model with the best evidence."""
        return self.ranked()[0]


def _followable(values: Mapping[str, float], problem: Problem) -> dict[str, float]:
    """Return start values under a field wide enough for the filter to stay with the recordings."""
    own = Likelihood(problem)
    start = own.values(own.start)
    found = dict(values)
    if not found.get("field_amplitude"):
        found["field_length"] = start["field_length"]
    found["field_amplitude"] = max(found.get("field_amplitude", 0.0), FOLLOWED * start["field_amplitude"])
    return found


def log_evidence(found: StateSpaceFit) -> float:
    """Return the log marginal likelihood by Laplace's method, priors flat within the bounds."""
    likelihood, covariance = found.likelihood, found.maximum.covariance
    free = np.diag(covariance) > 0
    if not free.any() or not np.isfinite(found.log_likelihood):
        return found.log_likelihood
    width = (likelihood.upper - likelihood.lower)[free]
    d = np.sqrt(np.diag(covariance)[free])
    _, logdet = np.linalg.slogdet(covariance[np.ix_(free, free)] / np.outer(d, d))
    occam = np.minimum(0.5 * np.log(2 * np.pi) + np.log(d / width), 0.0)  # a prior is never narrower than the posterior
    return float(found.log_likelihood + 0.5 * logdet + np.sum(occam))


def shortcomings(found: StateSpaceFit) -> list[str]:
    """Return what speaks against a fit: sentences, the worst first; none where it passes every test."""
    point, values = found.maximum.point, found.values
    if not np.isfinite(point.log_likelihood) or found.maximum.away > LOST:
        return ["the fit did not converge"]
    tests: list[tuple[float, str]] = []
    for f in point.runs:
        white = f.white
        n = white.size
        off = abs(float(np.sum(white**2)) - n) / np.sqrt(2 * n)
        tests.append((off / DEVIATION, f"innovations of {f.run.name} have an rms of {np.sqrt(np.mean(white**2)):.3f}"))
        for piece in np.array_split(white, max(min(20, n // 50), 1)):
            m = piece.size
            loud = (float(np.sum(np.clip(piece, -6, 6) ** 2)) - m) / np.sqrt(2 * m)
            shifted = abs(float(np.sum(piece))) / np.sqrt(m)
            tests.append((max(loud, shifted) / (DEVIATION + 1.0), f"a stretch of {f.run.name} is off"))
        if not found.smooth and "field_amplitude" in f.names:
            k = f.names.index("field_amplitude")
            information = float(f.information[k, k])
            if information > 0:
                off = abs(float(f.score[k])) / np.sqrt(information)
                tests.append((off / DEVIATION, f"the field is of another amplitude in {f.run.name}"))
    tests.append((correlated(point) / DEVIATION, "innovations are correlated"))
    if not found.smooth:
        friction = max(float(np.median([typical_friction(f.run) for f in point.runs])), 1e-6)
        share = values["field_amplitude"] / friction / PLAUSIBLE
        tests.append((share, f"the field's amplitude is {values['field_amplitude']:.2g}"))
    levels: dict[str, list[float]] = {}
    for f in point.runs:
        name = found.likelihood.gauge(f.run)["gauge_white"]
        levels.setdefault(name, []).append(white_level(f.run.observed, stretches(f.run.t, f.run.used)))
    for name, seen in levels.items():
        quantum = max(f.run.quantum for f in point.runs) / np.sqrt(12)
        ratio = float(np.hypot(values[name], quantum)) / max(min(seen), 1e-300)
        tests.append((ratio / LOUD, f"the gauge's noise is {ratio:.2f} times what the recording shows"))
    return [text for size, text in sorted(tests, reverse=True) if size > 1.0]


@dataclass(frozen=True)
class Held:
    """One held-out run filtered under the baseline and under the best model."""

    baseline: Filtered
    augmented: Filtered

    @property
    def gain(self) -> float:
        """Return what the best model gains in log likelihood."""
        return self.augmented.log_likelihood - self.baseline.log_likelihood


@dataclass(frozen=True)
class Verdict:
    """What is said, and what it rests on: `close` are the models that may be it, best first."""

    verdict: str
    best: Fitted
    baseline: Fitted
    ranked: tuple[Fitted, ...]
    close: tuple[Fitted, ...]
    confidence: dict[str, float]
    held: tuple[Held, ...]
    excluded: tuple[Excluded, ...]
    reasons: tuple[str, ...]
    ungated: str

    @property
    def shown(self) -> Fitted:
        """Return the model that the answer calls augmented: the baseline itself where nothing is to be added."""
        return self.baseline if self.verdict in ("none", "inconclusive") else self.best

    def brought(self) -> dict[str, dict[str, Any]]:
        """Return the parameters that the shown model adds to the baseline's, in declared units; a stiffness as a ratio too."""
        fitted, problem = as_fit(self.shown.fit), self.shown.fit.likelihood.problem
        units, own = {q.name: q.unit for q in problem.experiment.parameters}, self.baseline.fit.likelihood.problem.names
        found: dict[str, dict[str, Any]] = {}
        for name in (n for n in problem.names if n not in own and n in units):
            unit = units[name]
            value, error = (from_base(v, unit) for v in (fitted.values[name], fitted.stderr[name]))
            found[name] = {"value": value, "stderr": error, "unit": unit}
        if "K" in found:
            number, unit = split_quantity(problem.experiment.stiffness_text, name="stiffness")
            stated = from_base(number * find_unit(unit).factor, found["K"]["unit"])
            found["ratio"] = {k: found["K"][k] / stated for k in ("value", "stderr")} | {"unit": "1"}
        return found

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the names that the verdict carries."""
        if self.verdict == "identified":
            return self.best.model.reported
        if self.verdict == "ambiguous":
            return tuple(dict.fromkeys(n for f in self.close for n in f.model.reported))
        return ()


def conclude(search: ModelSearch, whole: Experiment) -> Verdict:
    """Return the verdict on a finished search; `whole` is the experiment with its held-out runs, opened only now."""
    ranked = tuple(search.ranked())
    baseline, best = search.fitted[Model().name], ranked[0]
    close = tuple(f for f in ranked if f.fine and best.evidence - f.evidence < CLOSE)
    close = tuple(f for f in close if not any(set(o.model.reported) < set(f.model.reported) for o in close))
    best = close[0] if close else best
    held = tuple(
        Held(*(f.fit.likelihood.filtered(run, f.fit.values) for f in (baseline, best)))
        for run in whole.runs
        if run.holdout
    )
    found, reasons = _said(search, best, baseline, close)
    ungated = found
    if found != "unknown" and held:
        white = np.concatenate([h.augmented.white for h in held])
        rms = float(np.sqrt(np.mean(white**2)))
        if not all(h.augmented.whole for h in held) or not rms < HELD:
            found, reason = "unknown", f"held-out runs are not predicted: innovations have an rms of {rms:.3f}"
            reasons.append(reason)
        elif best is not baseline and sum(h.gain for h in held) < 0:
            found = "unknown"
            reasons.append(f"held-out runs are predicted worse than by the baseline: {sum(h.gain for h in held):+.1f}")
    return Verdict(
        found,
        best,
        baseline,
        ranked,
        close,
        _confidence(ranked, found),
        held,
        tuple(search.excluded),
        tuple(reasons),
        ungated,
    )


def _said(search: ModelSearch, best: Fitted, baseline: Fitted, close: Sequence[Fitted]) -> tuple[str, list[str]]:
    if not best.fine:
        return "unknown", [f"{best.model.name}: {reason}" for reason in best.against]
    reasons = [f"{best.model.name}: nothing is left that a test finds"]
    if any(not f.model.reported for f in close):
        seen = [s for s in baseline.promised if s.detectable < interesting(s)]
        if 2 * len(seen) >= len(baseline.promised):
            return "none", [*reasons, "the baseline explains the recordings"]
        return "inconclusive", [
            *reasons,
            "nothing is needed, and most effects of interesting size could not have been seen",
        ]
    if len({frozenset(f.model.reported) for f in close}) > 1:
        return "ambiguous", [*reasons, "several models do equally well: " + ", ".join(f.model.name for f in close)]
    return "identified", reasons


def interesting(score: Score) -> float:
    """Return the size of an effect that matters, in um, s, N: what its plugin gives as default, from its neutral value."""
    if not score.effect.sizes:
        return float("inf") if "K" not in score.effect.frees else 0.1 * abs(score.values["K"])
    p = next(p for p in score.effect.parameters if p.name == score.effect.sizes[0])
    return abs(to_base(p.default, p.unit) - neutral_values(score.effect)[p.name])


def _confidence(ranked: Sequence[Fitted], verdict: str) -> dict[str, float]:
    """Return the stated confidence in each model, by evidence, and in `unknown`."""
    weights = {f.model.name: f.evidence - (0.0 if f.fine else LACKING) for f in ranked}
    nothing = max(weights.values()) + (LACKING if verdict == "unknown" else TEMPER * np.log(UNEXPLAINED))
    weights["unknown"] = nothing
    top = max(weights.values())
    share = {name: float(np.exp(max((w - top) / TEMPER, -60.0))) for name, w in weights.items()}
    total = sum(share.values())
    return dict(sorted(((n, v / total) for n, v in share.items()), key=lambda item: -item[1]))
