"""The search for what a model lacks, over state-space fits: one queue, one score, one budget.

A model is the baseline with a set of effects, or with another ageing law. Each model that was fitted says, at first order, what
each effect could still explain; the model with the largest expected evidence is fitted next. The score of a model is its log
marginal likelihood by Laplace's method, with flat priors within the bounds of its parameters, Cauchy priors about the typical
sizes of its effects, and a prior on their number. The search ends when the best model passes its tests and no other is expected
to come close, or when the budget is spent.
Best-first search: Pearl, Heuristics, 1984; Laplace's method: Kass and Raftery, JASA 90 (1995).
"""

from __future__ import annotations

import contextlib
import heapq
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from typing import Any, ClassVar

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError, Status
from srfcli.data.groups import GAUGE_NOISE
from srfcli.data.values import Experiment, Run
from srfcli.diagnosis.goodness_of_fit import (
    CORRELATED_INNOVATIONS,
    failed_tests,
    gauge_noise_tests,
    noise_is_implausible,
    relative_field_amplitude,
    uneven_noise,
)
from srfcli.diagnosis.hypotheses import Excluded, Hypothesis, applicable, neutral_values, own_parameters, profile_function
from srfcli.diagnosis.scores import ResidualProjection, Score, Scores, can_act_in_one_run
from srfcli.inference.fit import Problem
from srfcli.inference.state_space import (
    EARLY_STOP_DEFICIT,
    FIELD,
    MANY_READINGS,
    MAX_LOG_STEP,
    NOT_CONVERGED,
    PRUNING_DEFICIT,
    SIGNIFICANT_GAIN,
    TRIAL_STEPS,
    Likelihood,
    Maximum,
    Predictive,
    StateSpaceFit,
    fit_state_space,
    likeliest_along_ridges,
    likeliest_end,
    log_evidence,
    mass_at_bounds,
    maximise,
    processes_in,
    relaxations_without_model,
    scan_narrow,
    thinned,
    wide_starts,
    with_less_colour,
)
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect

MIN_SCORE_GAIN = 12.0  # gain in log likelihood that an effect must bring: 300 columns are looked at, each at p = 1e-6
LOG_BAYES_MARGIN = 6.0  # log evidence within which two models may both be it: a Bayes factor of 400
MAX_EFFECTS = 2  # effects of a model
MAX_EXTENSIONS = 5  # extensions of each model that are fitted
SEARCH_TOLERANCE = 0.5  # standard errors from its maximum to which a model is fitted: 0.1 in log likelihood
SEARCH_RTOL = 1e-3  # tolerance of the integration: 0.02 in log likelihood
BUDGET = 300.0  # s of CPU, or more
# times what the baseline took, if that is more: two effects, each fitted twice, and what they leave to be scored
BASELINE_MULTIPLES = 5.0
SIZE_SHARES = (1.0, 0.5, 0.2, 0.05)  # of the expected sizes, from which a model is fitted: the likeliest
# sizes of what is built in, a mass or an interface, that are tried; the largest over the least
STRUCTURAL_SIZES, STRUCTURAL_SPAN = 16, 1e3
MIN_RESTARTS = 3  # models that are fitted from the file's start values although none has a plausible field: the likeliest
# of the widest field that a track may have, from where effects are scored without it too: a polished track's
WIDE_FIELD_SHARE = 0.33
SCREENING_STEPS = 3  # of scoring that tell at first whether a model may be it
MIN_START_FIELD = 0.1  # least amplitude of the field from which an extended model is fitted, over that from which a baseline is


@dataclass(frozen=True)
class Fitted:
    """A model fitted: log evidence, what speaks against it (nothing where it passes), what it leaves, the scores of effects.

    `separate_field_evidence` is the log evidence where each run has a field of its own; of it `mass_at_bounds` comes from
    parameters at a bound. `shared` is what a field that all runs share gains beyond SIGNIFICANT_GAIN at first order, None where
    an effect says what all runs share along slip; `shared_field_gain` is the gain that counts. `evidence_bound` is what the model
    has at most by what it extends.
    """

    hypothesis: Hypothesis
    fit: StateSpaceFit
    separate_field_evidence: float
    mass_at_bounds: float
    against: tuple[str, ...]
    projection: ResidualProjection = field(repr=False)
    shared: float | None = None
    shared_field_gain: float = 0.0
    evidence_bound: float = np.inf
    scores: Scores | None = field(default=None, repr=False)

    @property
    def name(self) -> str:
        """Return the hypothesis' name."""
        return self.hypothesis.name

    @property
    def evidence(self) -> float:
        """Return the log evidence, with what a field that all runs share is granted, within its bound."""
        return min(self.separate_field_evidence + self.shared_field_gain, self.evidence_bound)

    def extends(self, other: Fitted) -> bool:
        """Return whether it is another fitted model with more effects, under the same kinds of field and gauge noise."""
        own, its = self.fit.likelihood, other.fit.likelihood
        nested = self.hypothesis.ageing == other.hypothesis.ageing and {*other.hypothesis.effects} < {*self.hypothesis.effects}
        return nested and own.smooth == its.smooth and own.processes == its.processes and {*its.names} < {*own.names}

    @property
    def passes(self) -> bool:
        """Return whether the model passes every test of what a fit leaves."""
        return not self.against

    @property
    def random(self) -> bool:
        """Return whether the model has a random field or coloured noise, which may have taken up a part of what is missing."""
        return not self.fit.smooth or bool(self.fit.likelihood.processes)

    def predictive(self, run: Run) -> Predictive:
        """Return how well a run that was not fitted is predicted, with priors as in the log evidence."""
        return self.fit.predictive(run, self.hypothesis.priors(self.fit.likelihood.problem.model))

    @property
    def attainable(self) -> float:
        """Return the evidence without what parameters at a bound cost: with an effect more they need not stand there."""
        return self.evidence - self.mass_at_bounds

    @property
    def singles(self) -> Sequence[Score]:
        """Return the scores of the effects that it lacks, largest first."""
        return self.scores.singles if self.scores else ()


_Step = tuple[Callable[[Fitted], Any], Fitted]  # what the search does with a model that is the best, or with the baseline


@dataclass(order=True)
class _Move:
    """A model to be fitted: what its evidence is expected to be, negative, as a heap gives the smallest first."""

    expected: float
    number: int
    hypothesis: Hypothesis = field(compare=False)
    values: dict[str, float] = field(compare=False)
    sizes: tuple[dict[str, float], ...] = field(compare=False)
    least: float = field(compare=False, default=-np.inf)  # log likelihood from which it is worth a fit
    fresh: int = field(compare=False, default=0)  # how many of the last effects are at sizes that are only expected
    shifts: Mapping[str, float] = field(compare=False, default_factory=dict)  # of other parameters that go with that
    origin: StateSpaceFit | None = field(compare=False, default=None)  # whose parameters it begins with, as they are
    # log evidence that was reached on the way to what is expected
    initial_evidence: float = field(compare=False, default=-np.inf)
    gain: float = field(compare=False, default=np.inf)  # of its last effect, at first order
    gains: Mapping[tuple[str, str], float] = field(compare=False, default_factory=dict)  # without field, of all: by name and run


@dataclass(frozen=True)
class _Trial:
    """A model begun from the start values of the file: its likelihood with the baseline's colour and without, where it got."""

    hypothesis: Hypothesis
    beside: Likelihood
    own: Likelihood
    found: Maximum
    starts: Iterator[Array]


class _BudgetSpent(Exception):
    """The budget is used up."""


class ModelSearch:
    """One diagnosis on its way; `experiment` holds no held-out runs.

    Of long recordings every so-many-th reading is searched, and what comes close is then fitted to all.
    `options` of every fit and what scores are taken from, `projection`, are what an ablation changes.
    """

    options: ClassVar[Mapping[str, Any]] = {}
    projection = ResidualProjection

    def __init__(
        self,
        registry: Registry,
        experiment: Experiment,
        progress: Callable[[str], None] = lambda text: None,
        effects: Sequence[str] | None = None,
        trend: str | None = None,
    ) -> None:
        self.registry, self.whole, self._report = registry, experiment, progress
        self.trend = trend or experiment.trend  # of every fit
        self.experiment = experiment = replace(experiment, runs=thinned(experiment.runs, self.options.get("many", MANY_READINGS)))
        self.candidates, self.excluded = applicable(registry, experiment, effects)
        every = [effect for e in registry.entries("effect") if isinstance(effect := registry.load(e), Effect)]
        self.on_request = [e.name for e in every if effects is None and e.on_request]
        self.laws = [e.name for e in registry.entries("ageing") if effects is None or e.name in effects]
        self.budget, self.begun, self.cut_short = BUDGET, time.process_time(), False
        self._budgeted = False  # whether what is done now ends with the budget
        self.fitted: dict[str, Fitted] = {}
        self.queue: list[_Move] = []
        self.count = 0
        self._expected: dict[str, float] = {}  # the most that was expected of each effect beside the baseline
        self._taken: set[tuple[Callable[[Fitted], Any], str]] = set()  # steps, and of which model
        self._trials: dict[str, _Trial | None] = {}  # models that were begun from the start values of the file
        self._finished: set[str] = set()  # models that were fitted from the start values of the file
        self._tried: dict[str, tuple[bool, Array]] = {}  # each other ageing law: whether to its maximum, and from where, last

    def progress(self, text: str) -> None:
        """Tell what is done; where the budget is spent, end what is bounded by it."""
        self._report(text)
        if self._budgeted and self.spent:
            raise _BudgetSpent

    @contextlib.contextmanager
    def within_budget(self) -> Iterator[None]:
        """Do what follows until it is done or the budget is spent, as `cut_short` then says; what was fitted is kept."""
        self._budgeted = True
        try:
            yield
        except _BudgetSpent:
            self.cut_short = True
        finally:
            self._budgeted = False

    # ------------------------------------------------------------------ models and their fits

    def fit(self, move: _Move | None) -> Fitted:
        """Return a model fitted from where its parent stands, and judged; the baseline from the file's own start values."""
        hypothesis = move.hypothesis if move else Hypothesis()
        options = {"processes": _colour_processes(move.values) if move else None, **self.options}
        if move:
            options["least"] = self.best().evidence - EARLY_STOP_DEFICIT

        def fitted(values: dict[str, float] | None) -> StateSpaceFit:
            return self._state_space(self._problem(hypothesis, values or {}), start=values, beside=False, **options)

        if move and not self.experiment.runs:  # without a field a parent that is far off leads to the crossings next to its own
            stated = {q.name: q.value for q in self.experiment.parameters}
            found = fitted(self._start_values(replace(move, values=stated, shifts={})))
            if failed_tests(found):
                found = max(found, fitted(self._start_values(move)), key=lambda f: f.log_likelihood)
        elif move and move.origin:
            found = self._fit_without_widening(move, move.origin.smooth, move.origin.likelihood.processes)
        else:
            found = fitted(self._start_values(move) if move else None)
            if move and options["processes"] is None:  # its score was taken without field and colour
                found = max(found, self._fit_without_widening(move, True, ()), key=lambda f: f.criterion)
        if move and "processes" not in self.options:
            found = with_less_colour(found, SEARCH_TOLERANCE, self.progress)
        judged = self._assessed(hypothesis, found)
        if move is None and judged.passes:  # else it is not what is reported
            judged = self._assessed(hypothesis, likeliest_along_ridges(found, SEARCH_TOLERANCE, self.progress))
        return judged

    def _fit_without_widening(self, move: _Move, smooth: bool, processes: Sequence[str]) -> StateSpaceFit:
        """Return a fit that begins where a move says, under no wider field, without one if `smooth`, with colour as given."""
        likelihood, x = self._initial_point(move, smooth, processes)
        begun = maximise(likelihood, x, steps=TRIAL_STEPS, close=1.0, progress=self.progress)
        if not begun.expected > self.best().evidence - EARLY_STOP_DEFICIT:
            return StateSpaceFit(likelihood, begun)
        return self._state_space(likelihood.problem, part=StateSpaceFit(likelihood, begun))

    def _initial_point(self, move: _Move, smooth: bool, processes: Sequence[str]) -> tuple[Likelihood, Array]:
        """Return the likelihood of a move's model, without a field if `smooth`, with colour as given, and where it begins."""
        values = self._values_at_share(move, 1.0, move.shifts)
        problem = self._problem(move.hypothesis, values)
        likelihood = Likelihood(problem, smooth=smooth, processes=processes, rtol=SEARCH_RTOL)
        return likelihood, likelihood.coordinates(values)

    def _state_space(self, problem: Problem, **choice: Any) -> StateSpaceFit:
        """Return a fit with the options of every fit, and with a `choice` of others."""
        choice = {"cautious": True, **choice, **self.options}
        return fit_state_space(problem, close=SEARCH_TOLERANCE, rtol=SEARCH_RTOL, progress=self.progress, **choice)

    def _problem(self, hypothesis: Hypothesis, at: Mapping[str, float]) -> Problem:
        return hypothesis.problem(self.registry, self.experiment, at=at, trend=self.trend)

    def _start_values(self, move: _Move) -> dict[str, float]:
        """Return where a model is fitted from: the sizes that its scores expect, or a part of them where that is likelier.

        With the other parameters moved as the scores say, or as they were.
        """
        best: tuple[float, dict[str, float]] = (-np.inf, {})
        for shifts in (move.shifts, {}) if move.shifts else ({},):
            last = -np.inf
            for share in SIZE_SHARES:
                values = self._values_at_share(move, share, shifts)
                problem = self._problem(move.hypothesis, values)
                values = _with_wide_field(values, problem)
                likelihood = Likelihood(problem, processes=_colour_processes(move.values) or (), rtol=SEARCH_RTOL)
                found = likelihood.at(likelihood.coordinates(values), slopes=False).log_likelihood
                if found > best[0]:
                    best = found, values
                if np.isfinite(last) and found <= last:
                    break
                last = found
        if not best[0] > move.least:
            raise SrfError("no size of it follows the recordings from where its parent stands")
        return best[1]

    def _values_at_share(self, move: _Move, share: float, shifts: Mapping[str, float]) -> dict[str, float]:
        """Return the parameters of a model where `share` of what its scores expect has been gone."""
        model, values = move.hypothesis.model(self.registry, self.experiment), dict(move.values)
        for name, shift in shifts.items():  # relative ones as powers: what is positive stays so
            value = values[name]
            power = np.clip(share * shift / value, -MAX_LOG_STEP, MAX_LOG_STEP) if value > 0 else 0.0
            values[name] = value * float(np.exp(power)) if value > 0 else value + share * shift
        for number, (effect, sizes) in enumerate(zip(move.hypothesis.effects, move.sizes, strict=True)):
            part = share if number >= len(move.sizes) - move.fresh else 1.0
            longs = {p.name: long for long, p in own_parameters(effect, model).items()}
            neutral = neutral_values(effect)
            for name, value in sizes.items():
                still = neutral.get(name, move.values.get("K", self.experiment.runs[0].stiffness) if name == "K" else None)
                values[longs.get(name, name)] = value if still is None else still + part * (value - still)
        return values

    def _assessed(self, hypothesis: Hypothesis, found: StateSpaceFit) -> Fitted:
        if found.maximum.status is Status.INTEGRATION:
            name = "the model" if hypothesis == Hypothesis() else hypothesis.name
            raise SrfError(
                f"{name} cannot be followed along the recordings",
                "Give start values, or bounds, between which it slides as the recordings do.",
            )
        projection = self.projection(found)
        sizes = hypothesis.priors(found.likelihood.problem.model)
        by_slip = any((shape := profile_function(e)) and shape.argument == "slip" for e in hypothesis.effects)
        random = not by_slip and found.maximum.away < NOT_CONVERGED  # a track is a function of slip or a random one
        return Fitted(
            hypothesis, found, log_evidence(found, sizes) + self._prior(hypothesis), mass_at_bounds(found, sizes),
            tuple(failed_tests(found)), projection, max(projection.shared.gain - SIGNIFICANT_GAIN, 0.0) if random else None,
        )  # fmt: skip

    def _waypoint(self, hypothesis: Hypothesis, found: StateSpaceFit) -> Fitted:
        """Return a model where scoring has passed, which is scored and no more."""
        return Fitted(hypothesis, found, found.log_likelihood, 0.0, ("as it is passed",), self.projection(found))

    def _prior(self, hypothesis: Hypothesis) -> float:
        """Return the log prior of a model: each effect is one of those that there are, and halves its share.

        One that acts in one run alone is in any of them.
        """
        each = float(np.log(2 * max(len(self.candidates), 1)))
        return -len(hypothesis.reported) * each - sum(self._log_run_count for e in hypothesis.effects if e.run)

    @property
    def _effect_log_penalty(self) -> float:
        """Return what an effect more is expected to cost in log evidence: its prior, and Occam's factor."""
        return -float(np.log(2 * max(len(self.candidates), 1))) - 3.0

    @property
    def _log_run_count(self) -> float:
        """Return by how much less likely an effect is in one run alone than in all, in the logarithm."""
        return float(np.log(max(len(self.experiment.runs), 1)))

    # ------------------------------------------------------------------ the search

    def run(self) -> Fitted:
        """Return the best model; `ranked` has all that were fitted.

        First-order scores and fits from one start mislead. So where no other model is expected to come close, the further steps
        are done for the best, one at a time, and the search goes on with what that brings.
        """
        self.progress("baseline")
        base = self._record(self.fit(None))
        self.budget = max(BUDGET, BASELINE_MULTIPLES * (time.process_time() - self.begun))
        with self.within_budget():
            base = self._expand(self._with_own_noise(base))
            # field or noise make up for what is missing: without them it shows, or it is another law
            if noise_is_implausible(base.fit):
                self._take_step(self._expand_without_field, base)
                self._take_step(self._refit_likeliest, base)
                # what is likelier where it begins, else what is expected
                if not self._explained and self._queue_is_promising(base):
                    move = max(self.queue, key=lambda m: (max(self._initial_evidence(m, base), base.evidence), -m.expected))
                    self._fit_next(self._removed_from_queue(move))
                self._between_runs()
                if self.best().name == base.name or not self.best().passes:
                    self._take_step(self._refit_from_start_values, base)
            elif not base.passes:
                self._try_ageing_laws(self.best())
            self._search_by_steps(self._steps)
        if self.best().passes:
            self._search_by_steps(self._simplifying)
        if self.baseline.scores is None:  # from the best model's parameters it came to another maximum
            self._expand(self.baseline)
        best = self.best()
        self.cut_short |= self.spent and (not best.passes or self._queue_is_promising(best) or self._expandable(best))
        if self.experiment.runs is not self.whole.runs:
            self._fit_all()
        return self.best()

    def _search_by_steps(self, steps: Callable[[], Sequence[_Step]]) -> None:
        """Search, and take the first step that was not taken yet for its model, until none is left."""
        while True:
            self._search()
            step, node = next(((s, f) for s, f in steps() if (s, f.name) not in self._taken), (None, None))
            if step is not None and node is not None:
                self._take_step(step, node)
            elif not self._fall_back():
                return

    def _fall_back(self) -> bool:
        """Where no model passes, expand the next best, or fit what is expected below the best; return whether there was any."""
        other = next(filter(self._expandable, self.ranked()), None)
        if self.best().passes or self.spent or (other is None and not self.queue):
            return False
        if other:
            self._expand(other)
        else:
            self._fit_next(heapq.heappop(self.queue))
        return True

    def _take_step(self, step: Callable[[Fitted], Any], node: Fitted) -> None:
        step(node)
        self._taken.add((step, node.name))

    def _first_untaken(self, node: Fitted, *steps: Callable[[Fitted], Any]) -> Callable[[Fitted], Any] | None:
        """Return the first of several steps that was not taken yet for a model; None where all were."""
        return next((step for step in steps if (step, node.name) not in self._taken), None)

    def _steps(self) -> list[_Step]:
        """Return the steps to be taken, in turn, for the model that is the best now, or for the baseline."""
        best, base = self.best(), self.baseline
        if best.passes:  # other laws are tried near it alone, unless field or noise are there to make up for a law
            masked = noise_is_implausible(base.fit) and best.random and not best.hypothesis.ageing
            steps: list[_Step] = [(self._refit_from_start_values, base)] if masked else []
            steps += [(self._try_rivals, best), (self._try_ageing_laws, best), (self._expand_without_field, base)]
        else:
            steps = [(self._refit_from_start_values, base)]
            steps += [(self._try_ageing_laws, best)] if best.hypothesis.ageing else []
            steps += [(self._expand_without_field, f) for f in (base, best)]
        return [*steps, *self._simplifying()]

    def _simplifying(self) -> list[_Step]:
        """Return the steps that lead from the model that is the best now to others that are as simple, or simpler."""
        return [(step, self.best()) for step in (self._in_all_runs, self._in_one_run, self._eliminate)]

    def _fit_all(self) -> None:
        """Fit the baseline, the best and what passes and comes close to it to all readings; the others were not."""
        best = self.best()
        close = [f for f in self.ranked() if f is best or (f.passes and best.evidence - f.evidence < LOG_BAYES_MARGIN)][
            :MAX_EXTENSIONS
        ]
        parts = {f.name: f for f in (*close, self.baseline)}
        self.experiment, fitted = self.whole, {}
        processes: Sequence[str] | None = None
        for node in parts.values():
            self.progress(f"{node.name}: all readings")
            found = self._state_space(self._problem(node.hypothesis, node.fit.values), part=node.fit, processes=processes)
            judged = self._assessed(node.hypothesis, found)
            if processes is None:  # more readings show more colour
                judged = self._more_coloured(judged)
            fitted[node.name] = replace(judged, scores=node.scores)
            processes = judged.fit.likelihood.processes
        self.fitted = fitted
        self._credit_shared_field()

    def extend(self, nodes: Sequence[Fitted]) -> None:
        """Search on from models that another search has fitted."""
        for node in nodes:
            self.fitted[node.name] = node
        with self.within_budget():
            for node in nodes:
                self._expand(node)
            self._search()
            self._try_rivals(self.best())
            self._search()
            self._eliminate(self.best())

    @property
    def share(self) -> float:
        """Return the share of the budget that is used, from 0 to 1."""
        return min((time.process_time() - self.begun) / self.budget, 1.0)

    @property
    def spent(self) -> bool:
        """Return whether the budget is used up."""
        return time.process_time() - self.begun > self.budget

    def _queue_is_promising(self, best: Fitted) -> bool:
        """Return whether a model that waits is expected to come close to the best."""
        if not self.queue:
            return False
        if self.experiment.thresholds and not best.passes and self.queue[0].fresh:
            return True  # far off the first order says too little
        return -self.queue[0].expected >= best.evidence - LOG_BAYES_MARGIN

    def _expandable(self, node: Fitted) -> bool:
        """Return whether a fitted model was not asked yet what it lacks, and could have that."""
        return node.scores is None and len(node.hypothesis.effects) < MAX_EFFECTS

    def _search(self) -> None:
        """Fit what comes close to the best model, or would mend it; expand the best once nothing does.

        An effect that was fitted in one run alone, and mends it by halves, is tried in all runs at once, and the reverse.
        """
        while not self.spent:
            self._between_runs()
            best = self.best()
            self.queue = [m for m in self.queue if self._outscores_best(m.gain, m.gains)]
            heapq.heapify(self.queue)
            if self._queue_is_promising(best):
                self._fit_next(heapq.heappop(self.queue))
            elif step := self._first_untaken(best, self._at_other_maxima, self._with_more_colour):
                self._take_step(step, best)
            elif not self._expandable(best):
                break
            elif best.passes or (self._refit_from_start_values, self.baseline.name) in self._taken:
                self._expand(best)
            else:
                self._take_step(self._refit_from_start_values, self.baseline)

    def _between_runs(self) -> None:
        """Fit the best model, while it fails a test, at other maxima, with its effects in all runs and with each in one run."""
        steps = (self._at_other_maxima, self._in_all_runs, self._in_one_run)
        while not (best := self.best()).passes and (step := self._first_untaken(best, *steps)):
            self._take_step(step, best)

    def _fit_next(self, move: _Move) -> None:
        """Fit a model that waited; what cannot be fitted is left out, with the reason."""
        name = move.hypothesis.name
        if name in self.fitted and self.fitted[name].evidence > -move.expected - MIN_SCORE_GAIN:
            return
        self.progress(f"{name}: expected log evidence {-move.expected:.1f}, best {self.best().evidence:.1f}")
        try:
            self._record(self.fit(move))
        except _BudgetSpent:
            heapq.heappush(self.queue, move)
            raise
        except SrfError as error:
            self.excluded.append(Excluded(name, error.message))

    def _removed_from_queue(self, move: _Move) -> _Move:
        """Return a move that waited, which no longer does."""
        self.queue = [other for other in self.queue if other is not move]
        heapq.heapify(self.queue)
        return move

    def _expand(self, node: Fitted) -> Fitted:
        """Push the extensions of a fitted model: one more effect, two at once, something built in, another ageing law."""
        self.progress(f"{node.name}: scores")
        scores = self._scores(node)
        self.excluded += scores.excluded
        node = replace(node, scores=scores)
        self.fitted[node.name] = node
        self._push(
            self._extensions(
                node, node, self._gains(scores), MIN_SCORE_GAIN if node.passes and not node.random else LOG_BAYES_MARGIN
            )
        )
        self._push(
            [m for e in self._absent_effects(node) if (e.settings or e.observed) and (m := self._structural_move(node, e))]
        )
        return node

    def _scores(self, node: Fitted) -> Scores:
        """Return the scores of the effects that a fitted model lacks."""
        experiment = node.fit.likelihood.problem.experiment
        return Scores(self.registry, experiment, node.projection, node.hypothesis.effects, self._absent_effects(node))

    def _absent_effects(self, node: Fitted) -> list[Effect]:
        """Return the effects that a fitted model lacks and could have."""
        names = {e.reported for e in node.hypothesis.effects}
        there = {p.name for p in node.fit.likelihood.problem.model.parameters}
        return [e for e in self.candidates if e.reported not in names and there.issuperset(e.needs)]

    def _gains(self, scores: Scores) -> list[tuple[float, Score]]:
        """Return the effects' gains at first order, in all runs and in one alone."""
        return [(s.gain, s) for s in scores.every] + [(s.gain - self._log_run_count, s) for s in scores.single_run]

    def _extensions(
        self, node: Fitted, at: Fitted, gains: Sequence[tuple[float, Score]], least: float, *, noise: bool = True
    ) -> list[_Move]:
        """Return the extensions of `node` by the effects with the largest gains (m,) at first order from the fit `at`.

        Unless its field and gauge `noise` are kept, they are estimated anew.
        """
        moves = []
        for gain, score in sorted((p for p in gains if p[0] > least), key=lambda p: -p[0])[:MAX_EXTENSIONS]:
            hypothesis = Hypothesis((*node.hypothesis.effects, score.effect), node.hypothesis.ageing)
            sizes = (*self._sizes(at), score.values)
            own = {n: score.shifts[n] for n in at.fit.likelihood.problem.names if score.shifts.get(n)}
            self.count += 1
            values = {n: v for n, v in at.fit.values.items() if noise or not (n in FIELD or n.startswith("gauge_"))}
            least_likely, fresh = at.fit.log_likelihood - PRUNING_DEFICIT, len(hypothesis.effects) - len(at.hypothesis.effects)
            moves.append(_Move(
                -(node.attainable + gain + self._effect_log_penalty), self.count, hypothesis, values, sizes, least_likely, fresh,
                shifts=own, gain=gain,
            ))  # fmt: skip
        return moves

    def _push(self, moves: Sequence[_Move]) -> None:
        for move in moves:
            heapq.heappush(self.queue, move)
            for effect in move.hypothesis.effects if len(move.hypothesis.effects) == 1 else ():
                name = effect.reported
                self._expected[name] = max(-move.expected, self._expected.get(name, -np.inf))

    def _expand_without_field(self, node: Fitted) -> None:
        """Push extensions by scores from a fit without field and colour, where these may have taken up what the model lacks.

        Under a field that no track has, or a colour that no recording shows without a model, the scores of what is
        missing are as low as those of what is not. Beside a best model that passes, only effects with a larger score than one
        of its own.
        """
        best, own = self.best(), node.fit.likelihood
        if len(node.hypothesis.effects) == MAX_EFFECTS or (
            best.passes and best.name != node.name and not best.hypothesis.effects
        ):
            return
        if not (
            noise_is_implausible(node.fit)
            or relative_field_amplitude(node.fit) > WIDE_FIELD_SHARE
            or ("relaxation" in own.processes and not any(map(any, relaxations_without_model(own).values())))
        ):
            return
        smooth = Likelihood(own.problem, smooth=True, rtol=SEARCH_RTOL)
        found = maximise(smooth, smooth.coordinates(node.fit.values), steps=TRIAL_STEPS, close=1.0, progress=self.progress)
        if found.status is Status.INTEGRATION:  # without a field nothing follows the recordings
            return
        plain = self._waypoint(node.hypothesis, StateSpaceFit(smooth, found))
        self.progress(f"{node.name}: scores without field and colour")
        scores = self._scores(plain)
        every = sorted(self._gains(scores), key=lambda p: p[0])  # of variants the one with the largest score
        known = {(score.effect.reported, score.effect.run): gain for gain, score in every}
        for alone in (False, True):  # as many in one run alone as in all
            larger = [
                (gain, score) for gain, score in every if bool(score.effect.run) is alone and self._outscores_best(gain, known)
            ]
            self._push([replace(m, gains=known) for m in self._extensions(node, plain, larger, MIN_SCORE_GAIN, noise=False)])

    def _outscores_best(self, gain: float, gains: Mapping[tuple[str, str], float]) -> bool:
        """Return whether a gain is larger than that of each effect of the best model, of the same scores, where that passes."""
        best = self.best()
        return not best.passes or all(gain > gains.get((e.reported, e.run), -np.inf) for e in best.hypothesis.effects)

    def _sizes(self, node: Fitted, values: Mapping[str, float] | None = None) -> tuple[dict[str, float], ...]:
        """Return the values of a model's effects, those fitted if left out, by the effects' own names."""
        return _sizes_of(node.hypothesis, node.fit.likelihood.problem.model, values or node.fit.values)

    def _likelihood(self, hypothesis: Hypothesis, node: Fitted, name: str) -> Likelihood | None:
        """Return the likelihood of a model beside a fitted one; what cannot be joined is left out, with the reason."""
        try:
            problem = self._problem(hypothesis, node.fit.values)
        except SrfError as error:
            self.excluded.append(Excluded(name, error.message))
            return None
        return Likelihood(problem, processes=node.fit.likelihood.processes, rtol=SEARCH_RTOL)

    def _structural_move(self, node: Fitted, effect: Effect) -> _Move | None:
        """Return an effect whose model has other unknowns: from the likeliest of a few sizes, after a few steps from there."""
        hypothesis = Hypothesis((*node.hypothesis.effects, effect), node.hypothesis.ageing)
        likelihood = self._likelihood(hypothesis, node, effect.reported)
        if likelihood is None:
            return None
        problem = likelihood.problem
        own = [n for n in problem.names if n not in node.fit.likelihood.problem.names]
        place = likelihood.names.index(own[0])
        x = likelihood.coordinates(_with_wide_field(node.fit.values, problem))
        low, high = (likelihood.values(edge)[own[0]] for edge in (likelihood.lower, likelihood.upper))
        trials = []
        for size in np.geomspace(max(low, high / STRUCTURAL_SPAN), high, STRUCTURAL_SIZES):
            y = x.copy()
            y[place] = np.log(size) if likelihood.logarithmic[place] else size
            trials.append((likelihood.at(y, slopes=False, like=node.fit.maximum.point).log_likelihood, y))
        best, x = max(trials, key=lambda t: t[0])
        if not np.isfinite(best):
            return None
        found = maximise(likelihood, x, steps=4, close=1.0, progress=self.progress)
        gain = found.expected - node.fit.log_likelihood
        if not gain > (MIN_SCORE_GAIN if node.passes else 0.0):
            return None
        self.count += 1
        values = dict(found.point.values)
        sizes = (*self._sizes(node), {own[0]: values[own[0]]})
        without, reached = node.attainable + self._effect_log_penalty, found.point.log_likelihood - node.fit.log_likelihood
        return _Move(-(without + gain), self.count, hypothesis, values, sizes, initial_evidence=without + reached)

    def _with_own_noise(self, base: Fitted) -> Fitted:
        """Return the baseline with a gauge noise for each run, as all models have from then on, where runs differ in it.

        That is where one noise is too large for one run and too small for another, evidence rises, and none is louder then than
        its recording shows.
        """
        if GAUGE_NOISE in self.experiment.vary or not uneven_noise(base.fit):
            return base
        experiment, whole = (
            replace(e, vary={**e.vary, GAUGE_NOISE: e.by if e.vary else "run"}) for e in (self.experiment, self.whole)
        )
        problem = base.hypothesis.problem(self.registry, experiment, at=base.fit.values, trend=self.trend)
        start = _with_wide_field(base.fit.values, problem)
        found = self._state_space(problem, start=start, processes=base.fit.likelihood.processes)
        loud = any(size > 1 for size, _ in gauge_noise_tests(found.likelihood, found.maximum.point))
        if loud or log_evidence(found) < log_evidence(base.fit) + LOG_BAYES_MARGIN:
            return base
        self.experiment, self.whole = experiment, whole
        return self._record(self._assessed(base.hypothesis, found))

    def _with_more_colour(self, best: Fitted) -> None:
        """Fit the best model with more coloured noise, where that is all that it lacks: no effect is expected to explain it."""
        coloured = self._more_coloured(best)
        if coloured is not best:
            self._record(coloured)

    def _more_coloured(self, node: Fitted) -> Fitted:
        """Return a model with as much coloured noise as Schwarz's criterion wants, if nothing else speaks against it."""
        if node.against != (CORRELATED_INNOVATIONS,):
            return node
        found = self._state_space(node.fit.likelihood.problem, part=node.fit, cautious=False)
        return self._assessed(node.hypothesis, found)

    def _try_rivals(self, best: Fitted) -> None:
        """Fit what does the same at first order in the place of one effect of the best model, or of its ageing law.

        The parameters of that effect absorb such a one, and the others of the best model do not. An ageing law is as likely at
        the parameters of the best.
        """
        if not best.passes:
            return
        effects, ageing, sizes = best.hypothesis.effects, best.hypothesis.ageing, self._sizes(best)
        model, scores = best.fit.likelihood.problem.model, best.scores
        for i, effect in enumerate(effects):
            scores = scores or self._scores(best)
            others, own = effects[:i] + effects[i + 1 :], sizes[:i] + sizes[i + 1 :]
            without = self._initial_log_likelihood(
                _Move(0.0, 0, Hypothesis(others, ageing), dict(best.fit.values), own, origin=best.fit)
            )
            for score in scores.absorbed_by([*own_parameters(effect, model), *effect.frees]):
                hypothesis = Hypothesis((*others, score.effect), ageing)
                if hypothesis.name not in self.fitted:
                    moves = self._replacements(best, effect, score, hypothesis, own)
                    height, move = max(((self._initial_log_likelihood(m), m) for m in moves), key=lambda found: found[0])
                    if height > without:  # else it does not do the same beyond first order
                        self._fit_move(move)
        for law in self.laws if ageing else []:
            hypothesis = Hypothesis(effects, "+".join([law, *ageing.split("+")[1:]]))
            likelihood = None if hypothesis.name in self.fitted else self._likelihood(hypothesis, best, law)
            if law == self.experiment.choice.ageing.partition("+")[0] or likelihood is None:
                continue
            x = likelihood.coordinates(best.fit.values)
            if likelihood.at(x, slopes=False).log_likelihood > best.fit.log_likelihood - MIN_SCORE_GAIN:
                self._fit_from(best, hypothesis, sizes)

    def _replacements(
        self, node: Fitted, effect: Effect, score: Score, hypothesis: Hypothesis, others: tuple[dict[str, float], ...]
    ) -> Iterator[_Move]:
        """Yield the model of what is scored, of the size that does at first order what an effect of a fitted model does.

        With the parameters of that model, and with these moved as the score says.
        """
        model, fitted = node.fit.likelihood.problem.model, node.fit.values
        names = {p.name: long for long, p in own_parameters(effect, model).items()} | {n: n for n in effect.frees}
        size, *_ = (*effect.sizes, *effect.frees)
        still = neutral_values(effect).get(size, self.experiment.stiffness)
        moved = score.shifts.get(names[size], 0.0)
        ratio = -(fitted[names[size]] - still) / moved if moved else 1.0
        first, *_ = (*score.effect.sizes, *score.effect.frees)
        begun = neutral_values(score.effect).get(first, fitted.get("K", self.experiment.stiffness))
        sizes = (*others, {**score.values, first: begun + ratio * score.size})
        for shifts in ({}, {n: ratio * shift for n, shift in score.shifts.items() if n != names[size]}):
            yield _Move(0.0, 0, hypothesis, dict(fitted), sizes, shifts=shifts, origin=node.fit)

    def _initial_evidence(self, move: _Move, node: Fitted) -> float:
        """Return the log evidence that an extension of a fitted model has where it begins; -inf under another field or noise."""
        kept = node.fit.values.keys() <= move.values.keys()
        gain = self._initial_log_likelihood(replace(move, origin=node.fit)) - node.fit.log_likelihood if kept else -np.inf
        return max(move.initial_evidence, node.attainable + self._effect_log_penalty + gain)

    def _initial_log_likelihood(self, move: _Move) -> float:
        """Return the log likelihood where a move begins, field and noise as in the fit that it comes from."""
        assert move.origin is not None
        try:
            likelihood, x = self._initial_point(move, move.origin.smooth, move.origin.likelihood.processes)
        except SrfError:  # told where it is fitted
            return np.inf
        return likelihood.at(x, slopes=False).log_likelihood

    def _refit_from_start_values(self, base: Fitted) -> None:
        """Fit other ageing laws, and effects if nothing passes, from the file's own start values.

        A field, or noise, may stand for what is missing; the other parameters then end where no step leads to the right model.
        What keeps a field no wider than one may be after a few steps is fitted at once, and the likeliest of the others then;
        none any more once one passes.
        """
        best = self.best()
        if not self.experiment.runs:
            self._try_ageing_laws(best)
            return
        models = self._other_laws(best)
        singles = [Hypothesis((effect,)) for effect in ([] if base.passes or best.passes else self._absent_effects(base))]
        for single in sorted(singles, key=lambda h: -self._expected.get(h.name, -np.inf)):
            known = self.fitted.get(single.name)
            models += [] if known and known.passes else [single]
        highest = self._without_colour(best) if best.name != base.name else -np.inf
        others, highest = self._finish_plausible([m for m in models if m.name not in self._finished], highest)
        if not self._explained:
            for trial in sorted(others, key=lambda t: -t.found.point.log_likelihood)[:MIN_RESTARTS]:
                highest = self._finish_from_start_values(trial, highest)
                if self._explained:
                    return

    def _refit_likeliest(self, base: Fitted) -> None:
        """Fit the effects of which most is expected, and what they lack then, from the file's own start values."""
        likeliest = {m.hypothesis.name: m.hypothesis for m in sorted(self.queue) if -m.expected > base.evidence}
        self._finish_plausible([m for m in list(likeliest.values())[:MIN_RESTARTS] if not any(e.run for e in m.effects)], -np.inf)

    @property
    def _explained(self) -> bool:
        """Return whether a model with an effect, or another law, is the best and passes."""
        return self.best().passes and bool(self.best().hypothesis.reported)

    def _finish_plausible(self, models: Sequence[Hypothesis], highest: float) -> tuple[list[_Trial], float]:
        """Begin models from the start values of the file, and fit those that keep a field no wider than one may be.

        Until one passes. Return the others, and the highest log likelihood that was reached under white noise.
        """
        others = []
        for hypothesis in models:
            trial = self._trial(hypothesis)
            if trial is not None and noise_is_implausible(StateSpaceFit(trial.own, trial.found)):
                others.append(trial)
            elif trial is not None:
                highest = self._finish_from_start_values(trial, highest)
                if self._explained:
                    break
        return others, highest

    def _trial(self, hypothesis: Hypothesis) -> _Trial | None:
        """Return where a few steps lead from the start values of the file; None where these cannot be followed."""
        if hypothesis.name not in self._trials:
            self._trials[hypothesis.name] = self._begun_from_start_values(hypothesis)
        return self._trials[hypothesis.name]

    def _begun_from_start_values(self, hypothesis: Hypothesis) -> _Trial | None:
        """Begin a model from the start values of the file, under a wide field and white gauge noise."""
        name = hypothesis.effects[-1].reported if hypothesis.effects else hypothesis.ageing.partition("+")[0]
        beside = self._likelihood(hypothesis, self.baseline, name)
        if beside is None:
            return None
        own = Likelihood(self._problem(hypothesis, {}), rtol=SEARCH_RTOL)
        starts = wide_starts(own, {}, self.progress)
        start = next(starts, None)
        if start is None:
            return None
        found = maximise(own, start, steps=TRIAL_STEPS, close=1.0, progress=self.progress)
        return _Trial(hypothesis, beside, own, found, starts)

    def _with_a_second(self, trial: _Trial) -> _Trial | None:
        """Return the likeliest model of one effect more, begun from the start values of the file; None if none is far likelier.

        It is scored under white noise: coloured noise, or a field wider than one may be, takes up a part of what is missing.
        """
        fit, hypothesis = StateSpaceFit(trial.own, trial.found), trial.hypothesis
        if (
            len(hypothesis.effects) == MAX_EFFECTS
            or noise_is_implausible(fit)
            or not set(failed_tests(fit)) - {CORRELATED_INNOVATIONS}
        ):
            return None
        self.progress(f"{hypothesis.name}: scores under white noise")
        gains = self._gains(self._scores(self._waypoint(hypothesis, fit)))
        likeliest = [score.effect for gain, score in sorted(gains, key=lambda p: -p[0])[:MIN_RESTARTS] if gain > MIN_SCORE_GAIN]
        pairs = [self._trial(Hypothesis((*hypothesis.effects, effect), hypothesis.ageing)) for effect in likeliest]
        likelier = [p for p in pairs if p and p.found.expected > fit.log_likelihood + MIN_SCORE_GAIN]
        return max(likelier, key=lambda p: p.found.point.log_likelihood, default=None)

    def _finish_from_start_values(self, trial: _Trial, highest: float) -> float:
        """Fit a model begun from the start values of the file where enough is expected of it, and first what it lacks.

        With coloured noise as that of the baseline, too. What is far behind the highest log likelihood under white noise is left.
        That is returned.
        """
        hypothesis, beside, own, found = trial.hypothesis, trial.beside, trial.own, trial.found
        self._finished.add(hypothesis.name)
        if noise_is_implausible(StateSpaceFit(own, found)):  # one wide field may lead where another does not
            ends = (maximise(own, x, steps=TRIAL_STEPS, close=1.0, progress=self.progress) for x in trial.starts)
            found = likeliest_end(own, chain([found], ends)) or found
        places = [near] if hypothesis.ageing and (near := self._maximum_near_parents(hypothesis, beside)) else []
        if found.away > 1.0 and found.point.log_likelihood > highest - PRUNING_DEFICIT:
            found = maximise(own, found.point.x, close=1.0, progress=self.progress)
        if found.point.log_likelihood > highest and (pair := self._with_a_second(replace(trial, found=found))):
            highest = self._finish_from_start_values(pair, highest)
        highest = max(highest, found.point.log_likelihood)
        places.append((own, found))
        if beside.processes and found.point.log_likelihood > highest - PRUNING_DEFICIT:
            noise = {n: v for n, v in self.baseline.fit.values.items() if n.startswith("gauge_")}
            x = beside.coordinates({**found.point.values, **noise})
            places.append((beside, maximise(beside, x, steps=TRIAL_STEPS, close=1.0, widths=(), progress=self.progress)))
        if move := self._move_from(hypothesis, *max(places, key=lambda p: p[1].point.log_likelihood)):
            best = self.best()
            if -move.expected > best.evidence - (LOG_BAYES_MARGIN if best.passes else PRUNING_DEFICIT):
                self._fit_next(move)
            else:
                self._push([move])
        return highest

    def _without_colour(self, node: Fitted) -> float:
        """Return the log likelihood of a fitted model where its gauge noise is white."""
        plain = node.fit.likelihood.beside(node.fit.likelihood.problem, ())
        x = plain.coordinates({n: v for n, v in node.fit.values.items() if not n.startswith("gauge_")})
        found = maximise(plain, x, steps=TRIAL_STEPS, close=1.0, widths=(), progress=self.progress)
        return found.point.log_likelihood

    def _try_ageing_laws(self, best: Fitted) -> None:
        """Push the other ageing laws, each after a few steps from where the baseline or the best model stands.

        The law with the largest expected likelihood is scored further: the right one lies farther off than a step tells. If the
        best model has an effect, or another law than the stated one, each is scored to its maximum: the right one lies far off.
        """
        whole = bool(best.hypothesis.reported)
        reached = []
        for law in self._other_laws(best):
            own = self._likelihood(law, self.baseline, law.ageing.partition("+")[0])
            if own is not None and (near := self._maximum_near_parents(law, own, whole)):
                reached.append((law, *near))
        for number, (hypothesis, likelihood, found) in enumerate(sorted(reached, key=lambda r: -r[2].expected)):
            if number == 0 and found.away > 1.0:
                found = maximise(likelihood, found.point.x, steps=TRIAL_STEPS, close=1.0, widths=(), progress=self.progress)
            self._push([move] if (move := self._move_from(hypothesis, likelihood, found)) else [])

    def _other_laws(self, best: Fitted) -> list[Hypothesis]:
        """Return the ageing laws that neither the baseline nor the best model has."""
        stated, *modifiers = self.experiment.choice.ageing.split("+")
        others = (Hypothesis((), "+".join([name, *modifiers])) for name in self.laws if name != stated)
        return [hypothesis for hypothesis in others if hypothesis != best.hypothesis]

    def _maximum_near_parents(
        self, hypothesis: Hypothesis, likelihood: Likelihood, whole: bool = False
    ) -> tuple[Likelihood, Maximum] | None:
        """Return where scoring takes a law from where the baseline or the best stands, by a few steps or the whole way.

        None if it was begun there already.
        """
        parents = {f.name: f for f in (self.baseline, self.best())}.values()
        starts = [likelihood.coordinates(_with_wide_field(f.fit.values, likelihood.problem)) for f in parents]
        heights = [likelihood.at(x, slopes=False).log_likelihood for x in starts] if len(starts) > 1 else [0.0]
        x = starts[int(np.argmax(heights))]
        how_far, tried = self._tried.get(hypothesis.name, (False, ()))
        if how_far >= whole and np.array_equal(x, tried):
            return None
        self._tried[hypothesis.name] = whole, x
        how: dict[str, Any] = {} if whole else {"steps": SCREENING_STEPS, "widths": ()}
        return likelihood, maximise(likelihood, x, close=1.0, progress=self.progress, **how)

    def _move_from(self, hypothesis: Hypothesis, likelihood: Likelihood, found: Maximum) -> _Move | None:
        """Return a model of one part more, or another law, that goes on from there; None where too little is expected of it."""
        node = self.baseline
        if not found.expected > node.fit.log_likelihood + (MIN_SCORE_GAIN if node.passes else -PRUNING_DEFICIT):
            return None
        self.count += 1
        expected = found.expected - node.fit.log_likelihood + node.attainable + len(hypothesis.effects) * self._effect_log_penalty
        noise_anew = node.fit.likelihood.processes and not likelihood.processes
        values = {n: v for n, v in found.point.values.items() if not (noise_anew and n.startswith("gauge_"))}
        return _Move(-expected, self.count, hypothesis, values, _sizes_of(hypothesis, likelihood.problem.model, values))

    def _at_other_maxima(self, best: Fitted) -> None:
        """Fit the best model anew where a scan of one parameter, or another mass or compliance, leads to a likelier maximum.

        The fit of the baseline began with a scan.
        """
        problem, processes = best.fit.likelihood.problem, best.fit.likelihood.processes
        if not best.hypothesis.reported or not problem.runs:
            return
        likelihood = Likelihood(problem, processes=processes, rtol=SEARCH_RTOL)
        begun = likelihood.at(likelihood.coordinates(best.fit.values))
        found = scan_narrow(likelihood, begun, self.progress) or replace(best.fit.maximum, point=begun)
        for effect in (e for e in best.hypothesis.effects if e.settings):
            sizes = [n for n in (*own_parameters(effect, problem.model), *effect.frees) if n in likelihood.names]
            found = self._at_another_size(likelihood, found, sizes[0]) if sizes else found
        if found.point is not begun:
            fit = self._state_space(problem, part=StateSpaceFit(likelihood, found), processes=processes)
            self._record(self._assessed(best.hypothesis, fit))

    def _at_another_size(self, likelihood: Likelihood, found: Maximum, size: str) -> Maximum:
        """Return the maximum that halving or doubling a size leads to, again and again, as long as each is likelier."""
        place = likelihood.names.index(size)
        for side in (-1, 1):
            x = found.point.x.copy()
            x[place] = np.clip(x[place] + side * np.log(2), likelihood.lower[place], likelihood.upper[place])
            if x[place] == found.point.x[place]:  # it stands at its bound
                continue
            other = maximise(likelihood, x, steps=TRIAL_STEPS, close=1.0, progress=self.progress)
            if other.point.log_likelihood > found.point.log_likelihood + SIGNIFICANT_GAIN:
                return self._at_another_size(likelihood, other, size)
        return found

    def _in_all_runs(self, best: Fitted) -> None:
        """Fit the best model with its effects in all runs: the score of one run may have been misled by what was missing then."""
        whole = Hypothesis(tuple(replace(e, run="") for e in best.hypothesis.effects), best.hypothesis.ageing)
        if whole.name not in self.fitted:
            self._fit_from(best, whole, self._sizes(best))

    def _in_one_run(self, best: Fitted) -> None:
        """Fit the best model with each of its effects in the one run that needs it most, where the others hardly see it.

        Held-out runs then tell whether these have it.
        """
        effects, ageing = best.hypothesis.effects, best.hypothesis.ageing
        for i, effect in enumerate(effects if len(self.experiment.runs) > 1 else ()):
            if effect.run or not can_act_in_one_run(effect):
                continue
            heights = []
            for run in best.fit.likelihood.problem.runs:
                one = Hypothesis((*effects[:i], replace(effect, run=run.name), *effects[i + 1 :]), ageing)
                own = best.fit.likelihood.beside(self._problem(one, best.fit.values))
                heights.append((own.at(own.coordinates(best.fit.values), slopes=False).log_likelihood, run.name, one))
            likeliest, _, one = max(heights, key=lambda h: h[0])
            if likeliest > best.fit.log_likelihood - MIN_SCORE_GAIN and one.name not in self.fitted:
                self._fit_from(best, one, self._sizes(best))

    def _fit_from(self, node: Fitted, hypothesis: Hypothesis, sizes: tuple[dict[str, float], ...]) -> None:
        """Fit a model from the parameters of another that was fitted."""
        self._fit_move(_Move(0.0, 0, hypothesis, dict(node.fit.values), sizes, origin=node.fit))

    def _fit_move(self, move: _Move) -> None:
        """Fit a model where a move says; what cannot be fitted is left out, with the reason."""
        try:
            self._record(self.fit(move))
        except SrfError as error:
            self.excluded.append(Excluded(move.hypothesis.name, error.message))

    def _eliminate(self, best: Fitted) -> None:
        """Refit the best model, and what comes close, with one part less from its parameters (backward elimination).

        Of several parts each is left out, and what the best has of one: a fit from the file may have ended at a lower maximum.
        """
        asked: set[str] = set()
        while node := next((f for f in self.ranked() if f.hypothesis.reported and f.name not in asked), None):
            asked.add(node.name)
            best = self.best()
            effects, ageing, sizes = node.hypothesis.effects, node.hypothesis.ageing, self._sizes(node)
            if node.evidence < best.evidence - LOG_BAYES_MARGIN:
                break
            parts = [(Hypothesis(effects), sizes)] if ageing else []
            for i in range(len(effects)):
                parts.append((Hypothesis(effects[:i] + effects[i + 1 :], ageing), sizes[:i] + sizes[i + 1 :]))
            for part, own in parts:
                known = self.fitted.get(part.name)
                if known is not None and known.passes and known.evidence > best.evidence - LOG_BAYES_MARGIN:
                    continue
                if not part.reported and node is not best:
                    continue
                if any(n not in self._stated for e in part.effects for n in e.needs):
                    continue  # it is nothing without the other
                self._fit_from(node, part, own)

    @cached_property
    def _stated(self) -> frozenset[str]:
        """Return the parameters of the baseline's model."""
        return frozenset(Hypothesis().model(self.registry, self.experiment).names)

    def _record(self, found: Fitted) -> Fitted:
        name = found.name
        known = self.fitted.get(name)
        text = f"log evidence {found.separate_field_evidence:.1f}" + (f", but {found.against[0]}" if found.against else "")
        self.progress(f"{name}: {text}")
        if known is None or found.separate_field_evidence > known.separate_field_evidence:
            same = known is not None and found.separate_field_evidence - known.separate_field_evidence < SIGNIFICANT_GAIN
            self.fitted[name] = replace(found, scores=known.scores) if known is not None and same else found
            self._credit_shared_field()
        return self.fitted[name]

    def _credit_shared_field(self) -> None:
        """Grant all models what the likeliest gains by a field that all runs share: first-order gains do not decide."""
        under = {f.name: f for f in self.fitted.values() if f.shared is not None}
        if under:
            gain = max(under.values(), key=lambda f: f.separate_field_evidence).shared or 0.0
            self.fitted.update(
                {name: replace(f, shared_field_gain=gain) for name, f in under.items() if f.shared_field_gain != gain}
            )
        self._bound_evidence()

    def _bound_evidence(self) -> None:
        """Bound the log evidence of each model by that of what it extends and the gain in log likelihood.

        By Laplace's method it may be higher where the likelihood has kinks, as beside falls: its curvature is not that of a
        normal distribution.
        """
        for f in sorted(self.fitted.values(), key=lambda f: len(f.hypothesis.effects)):
            within = [
                other.attainable - self._prior(other.hypothesis) + f.fit.log_likelihood - other.fit.log_likelihood
                for other in self.fitted.values()
                if f.extends(other)
            ]
            self.fitted[f.name] = replace(f, evidence_bound=self._prior(f.hypothesis) + min(within, default=np.inf))

    def ranked(self) -> list[Fitted]:
        """Return everything that was fitted, best evidence first."""
        return sorted(self.fitted.values(), key=lambda f: -f.evidence)

    @property
    def baseline(self) -> Fitted:
        """Return the baseline; a KeyError until it is fitted."""
        return self.fitted[Hypothesis().name]

    def best(self) -> Fitted:
        """Return the model with the best evidence."""
        return self.ranked()[0]


def _sizes_of(hypothesis: Hypothesis, model: GeneratedModel, values: Mapping[str, float]) -> tuple[dict[str, float], ...]:
    """Return the values of a model's effects, by the effects' own names."""
    return tuple(
        {p.name: values[long] for long, p in own_parameters(e, model).items() if long in values}
        | {n: values[n] for n in e.frees if n in values}
        for e in hypothesis.effects
    )


def _colour_processes(values: Mapping[str, float]) -> list[str] | None:
    """Return the processes of coloured gauge noise of the model that was fitted with these values; None if they have no noise."""
    names = {name.partition("[")[0] for name in values}
    return processes_in(names) if "gauge_white" in names else None


def _with_wide_field(values: Mapping[str, float], problem: Problem) -> dict[str, float]:
    """Return start values under a field wide enough for the filter to stay with the recordings."""
    own = Likelihood(problem)
    start = own.values(own.start)
    found = dict(values)
    if not found.get("field_amplitude"):
        found["field_length"] = start["field_length"]
    found["field_amplitude"] = max(found.get("field_amplitude", 0.0), MIN_START_FIELD * start["field_amplitude"])
    return found
