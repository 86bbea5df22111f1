"""Nested sampling, a Gaussian-process discrepancy and sparse regression on sealed cases, in one table with the diagnosis.

    pip install dynesty pysindy        # nothing else in this project needs them
    python benchmarks/rivals.py TRIAL[:CASES] ... --kept FOLDER

TRIAL is a folder of `srf prove`, unsealed; of it the first CASES are taken, all if left out. Answers are kept case by case, and a
later run goes on there. The truths are opened when every case is answered.

The first two compare models that run freely: without a random field. They have the candidates, bounds and priors of the
diagnosis, and begin where it fits the baseline while held, as sparse regression does. Every effect is scored at first order, in
all runs and in one alone. The MAX_EXTENSIONS with the largest gain, what is built in (a mass, an interface, a gauge that lags)
and the other ageing laws get NEAR_STEPS of Fisher scoring; the FOLLOWED likeliest are maximised. The best, if its log evidence is
DECISIVE above that of the baseline, is extended by a second effect in the same way. Of all runs every so-many-th reading is
taken, READINGS at most together. After LIMIT s of CPU for its fits the best so far is a rival's answer. That names a model if its
log evidence is DECISIVE above that of the baseline (Kass and Raftery 1995: 150 to 1).

**Nested sampling** (dynesty): gauge noise is white, of a free level. For the best by Laplace's method, and others within WITHIN
of it, SAMPLED at most, evidence is sampled, in SAMPLING s of CPU; for the others it is Laplace's. Points are drawn from a normal
density about the maximum, of STRETCH times its standard errors, and the likelihood is multiplied by prior over density, which
leaves the evidence as it is (posterior repartitioning: Chen, Feroz and Hobson 2023). A parameter at its bound stays there. As
correlated readings tell less, the log likelihood is divided by the sum of the correlations of the noise that calm stretches of
the recordings show. `unknown`: a posterior predictive check. The mean square of what a draw leaves of the held-out runs is held
against that of noise as their calm stretches show it; refused is p < CHANCE with a root above MARGIN.

**Gaussian-process discrepancy** (Kennedy and O'Hagan 2001): each run has a Matern 3/2 process of time beside white noise.
Amplitude and length are free, and the same in all that is sampled at one rate. An oscillation of quality 1/2 is this process, so
likelihood and derivatives are those of the state-space fit with one. Amplitudes may be WIDER, lengths LONGER times as large as
those of gauge noise there. Evidence is Laplace's. `unknown`: process and white noise together are above LARGEST times the noise
that calm stretches show, rms over all runs.

Sparse regression is `sparse_regression.py`. It reads elongations and two friction laws with one ageing law; other cases it is not
asked. CPU seconds are one thread's, the fit of the baseline among them.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
import sparse_regression
from common import Report
from marked import marked
from sparse_regression import fitted_baseline

from srfcli.codegen.model import Array
from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.data.gauge import GaugeNoise, find_noise
from srfcli.data.values import Run
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.diagnosis.search import MAX_EFFECTS, SEARCH_TOLERANCE, STRUCTURAL_SPAN, ModelSearch
from srfcli.inference.state_space import PRUNING_DEFICIT, Likelihood, Maximum, StateSpaceFit, log_evidence, maximise
from srfcli.laws.registry import Registry, load_registry
from srfcli.validation.blind import Answer, failed, read_answers, write_answers
from srfcli.validation.cases import unseal
from srfcli.validation.marks import GradedAnswer, rate

READINGS = 4000  # of all runs
RTOL = 3e-2  # of the filter; 1e-4 where nothing puts the motion right
LIMIT = 25.0  # s of CPU for the fits of one rival
NEAR_STEPS, FOLLOWED = 2, 3  # steps of scoring of every candidate; how many of them are then maximised
SHARES = (1.0, 0.3)  # of the sizes that scores expect, from which a model is fitted: the likeliest
SIZES = 6  # of what is built in
DECISIVE = 5.0
WITHIN, SAMPLED = 8.0, 3
LIVE, STRETCH, ENOUGH = 40, 1.5, 0.5  # live points; of the standard errors; log evidence that may still be missing
CALLS, SAMPLING = 2000, 8.0  # likelihoods of one model; s of CPU for all
DRAWS = 8
CHANCE, MARGIN = 0.01, 1.2
LARGEST = 1.5
DISCREPANCY = ("oscillation",)
WIDER, LONGER = 100.0, 10.0
LOST = "the baseline cannot be followed"
SLOWNESS = (0.3, 0.03, 0.003)  # times the spacing of the samples: frequencies of the process that are tried first


Starts = Callable[[Likelihood], Sequence[Mapping[str, float]]]  # of a model, from its likelihood


@dataclass(frozen=True)
class Model:
    """A model that was fitted, and its log evidence by Laplace's method, the prior of its effects included."""

    hypothesis: Hypothesis
    fit: StateSpaceFit
    evidence: float


class Comparison:
    """The models of one rival on one case; gauge noise has coloured `processes`, log likelihoods are divided by `temper`."""

    def __init__(self, registry: Registry, folder: Path, start: Mapping[str, float], processes: Sequence[str]) -> None:
        whole = read_experiment(folder, registry=registry, holdout=False)
        every = -(-sum(run.t.size for run in whole.runs) // READINGS)
        experiment = replace(whole, runs=tuple(run.thinned(every) for run in whole.runs))
        self.search = ModelSearch(registry, experiment)
        self.search.budget = LIMIT
        self.start, self.processes = dict(start), tuple(processes)
        self.noises = {run.name: noise_of(run) for run in whole.runs}
        alike = [repeated(self.noises[run.name], run) for run in experiment.runs]
        self.temper = 1.0 if processes else float(np.median(alike))
        self.models: dict[str, Model] = {}

    def likelihood(self, hypothesis: Hypothesis) -> Likelihood:
        """Return the likelihood of a model that runs freely; SrfError where an effect cannot be joined."""
        problem = self.search._problem(hypothesis, self.start)
        own = Likelihood(problem, smooth=True, processes=self.processes, rtol=RTOL)
        for i, name in enumerate(own.names):
            own.lower[i] -= math.log(LONGER) if name.startswith("gauge_frequency") else 0.0
            own.upper[i] += math.log(WIDER) if name.startswith("gauge_colour") else 0.0
        return own

    def maximised(self, own: Likelihood, x: Array, **how: Any) -> Maximum:
        """Return the maximum from x; the process keeps its quality, which makes it a Matern 3/2."""
        held = [n for n in own.names if n.startswith("gauge_quality")]
        return maximise(own, x, fixed=held, progress=self.search.progress, **how)

    def likeliest(self, own: Likelihood, starts: Sequence[Mapping[str, float]]) -> Array | None:
        """Return the likeliest of several starts, in coordinates; None where the recordings can be followed from none."""
        points = [own.at(own.coordinates(values), slopes=False) for values in starts]
        best = max(points, key=lambda p: p.log_likelihood)
        return best.x if np.isfinite(best.log_likelihood) else None

    def keep(self, hypothesis: Hypothesis, own: Likelihood, found: Maximum) -> None:
        """Keep a model and its evidence."""
        if np.isfinite(found.point.log_likelihood) and np.isfinite(found.covariance).all():
            fit = StateSpaceFit(own, found)
            evidence = self.laplace(fit, hypothesis) + self.search._prior(hypothesis)
            if hypothesis.name not in self.models or evidence > self.models[hypothesis.name].evidence:
                self.models[hypothesis.name] = Model(hypothesis, fit, evidence)

    def laplace(self, fit: StateSpaceFit, hypothesis: Hypothesis) -> float:
        """Return the log evidence of a fit by Laplace's method."""
        point, t = fit.maximum.point, self.temper
        flat = replace(point, log_likelihood=point.log_likelihood / t, score=point.score / t, information=point.information / t)
        maximum = replace(fit.maximum, point=flat, covariance=fit.maximum.covariance * t)
        return log_evidence(StateSpaceFit(fit.likelihood, maximum), hypothesis.priors(fit.likelihood.problem.model))

    def run(self) -> None:
        """Fit the baseline, what may be missing, and that with a second effect, until the budget is spent."""
        with self.search.within_budget():
            base = self.likelihood(Hypothesis())
            x = self.likeliest(base, self._first_starts(base))
            if x is None:
                return
            found = self.maximised(base, x, steps=NEAR_STEPS, widths=())
            self.keep(Hypothesis(), base, found)
            found = self.maximised(base, found.point.x, close=SEARCH_TOLERANCE)
            self.keep(Hypothesis(), base, found)
            self._extend(self.models[Hypothesis().name])
            enough = self.models[Hypothesis().name].evidence + DECISIVE
            if self.best.evidence > enough and len(self.best.hypothesis.effects) < MAX_EFFECTS:
                self._extend(self.best)

    def _first_starts(self, own: Likelihood) -> list[dict[str, float]]:
        """Return where the baseline is fitted from: as it was fitted while held, with the process at several frequencies."""
        starts: list[dict[str, float]] = []
        plain = own.values(own.start)
        for wide in (1.0, 10.0, 100.0):
            level = {n: wide * v for n, v in plain.items() if n.startswith("gauge_colour" if self.processes else "gauge_white")}
            for slow in SLOWNESS if self.processes else (1.0,):
                pace = {n: v * slow / 0.1 for n, v in plain.items() if n.startswith("gauge_frequency")}
                starts.append({**self.start, **level, **pace})
        return starts

    @property
    def best(self) -> Model:
        """Return the model with the largest evidence by Laplace's method."""
        return max(self.models.values(), key=lambda m: m.evidence)

    def _extend(self, model: Model) -> None:
        """Fit what a model may lack: effects by their scores, what is built in, and of the baseline other ageing laws."""
        moved: list[tuple[float, Hypothesis, Likelihood, Maximum]] = []
        for hypothesis, starts in self._candidates(model):
            if hypothesis.name in self.models:
                continue
            try:
                own = self.likelihood(hypothesis)
            except SrfError:  # it cannot be joined
                continue
            x = self.likeliest(own, starts(own))
            if x is not None:
                found = self.maximised(own, x, steps=NEAR_STEPS, close=1.0, widths=())
                self.keep(hypothesis, own, found)
                moved.append((found.expected / self.temper + self.search._prior(hypothesis), hypothesis, own, found))
        for expected, hypothesis, own, found in sorted(moved, key=lambda m: -m[0])[:FOLLOWED]:
            if expected > self.best.evidence - PRUNING_DEFICIT:
                self.keep(hypothesis, own, self.maximised(own, found.point.x, steps=15, close=SEARCH_TOLERANCE, widths=()))

    def _candidates(self, model: Model) -> list[tuple[Hypothesis, Starts]]:
        """Return the models with one part more than this one, and from where each is fitted, the most promising first."""
        search, hypothesis, values = self.search, model.hypothesis, model.fit.values
        node = search._waypoint(hypothesis, model.fit)
        found: list[tuple[Hypothesis, Starts]] = []
        for move in search._extensions(node, node, search._gains(search._scores(node)), 0.0):
            starts = [search._values_at_share(move, share, shifts) for shifts in (move.shifts, {}) for share in SHARES]
            found.append((move.hypothesis, partial(listed, starts)))
        if not hypothesis.effects and not hypothesis.ageing:
            stated, *modifiers = search.experiment.choice.ageing.split("+")
            laws = [Hypothesis((), "+".join([law, *modifiers])) for law in search.laws if law != stated]
            found += [(law, partial(listed, [values])) for law in laws]
        built = [e for e in search._absent_effects(node) if e.settings or e.observed]
        return found + [(Hypothesis((*hypothesis.effects, e), hypothesis.ageing), partial(sizes_of, model)) for e in built]

    def contenders(self) -> list[Model]:
        """Return the models within WITHIN of the best, best first."""
        every = sorted(self.models.values(), key=lambda m: -m.evidence)
        return [m for m in every if m.evidence > every[0].evidence - WITHIN][:SAMPLED]


def listed(starts: Sequence[Mapping[str, float]], own: Likelihood) -> Sequence[Mapping[str, float]]:
    """Return start values that depend on no likelihood."""
    return starts


def sizes_of(model: Model, own: Likelihood) -> Sequence[Mapping[str, float]]:
    """Return a model's values beside several sizes of what another likelihood has built in."""
    new = next(n for n in own.problem.names if n not in model.fit.likelihood.problem.names)
    low, high = (own.values(edge)[new] for edge in (own.lower, own.upper))
    return [{**model.fit.values, new: size} for size in np.geomspace(max(low, high / STRUCTURAL_SPAN), high, SIZES).tolist()]


def noise_of(run: Run) -> GaugeNoise:
    """Return the gauge noise that calm stretches of a recording show."""
    spacing = float(np.median(np.diff(run.t)))
    cycles = run.modulation[0] * spacing if run.modulation else None
    return find_noise([run.observed[run.used]], spacing, quantum=run.quantum, cycles=cycles)


def correlations(noise: GaugeNoise, run: Run) -> Array:
    """Return the correlations of noise from one reading to each later one."""
    lags = float(np.median(np.diff(run.t))) * np.arange(run.t.size)
    covariance = noise.covariance(lags)
    return np.asarray(covariance[1:] / max(covariance[0], 1e-300))


def repeated(noise: GaugeNoise, run: Run) -> float:
    """Return how many readings of a run count as one, with noise correlated as it is."""
    return 1 + 2 * max(float(np.sum(correlations(noise, run))), 0.0)


def sampled(comparison: Comparison, model: Model, calls: int) -> tuple[float, float, list[dict[str, float]]]:
    """Return log evidence by nested sampling, its standard error, and values drawn from the posterior."""
    from dynesty import NestedSampler
    from scipy.special import ndtri

    own, maximum, t = model.fit.likelihood, model.fit.maximum, comparison.temper
    free = np.flatnonzero(np.diag(maximum.covariance) > 0)
    covariance = t * maximum.covariance[np.ix_(free, free)]
    d = np.sqrt(np.diag(covariance))
    root = STRETCH * d[:, None] * np.linalg.cholesky(covariance / np.outer(d, d) + 1e-9 * np.eye(d.size))
    volume = float(np.sum(np.log(np.diag(root)))) + 0.5 * free.size * math.log(2 * math.pi)
    flat, sizes = -np.log(own.upper - own.lower), model.hypothesis.priors(own.problem.model)
    cauchy = {
        own.names.index(n): s for n, s in sizes.items() if n in own.names and s[1] > 0 and not own.logarithmic[own.names.index(n)]
    }

    def x_of(z: Array) -> Array:
        x = maximum.point.x.copy()
        x[free] += root @ z
        return x

    def log_posterior(z: Array) -> float:
        """Return the log likelihood times prior over the density from which z is drawn."""
        x = x_of(z)
        if (x < own.lower).any() or (x > own.upper).any():
            return -1e30
        found = own.at(x, slopes=False, like=maximum.point).log_likelihood
        prior = flat.copy()
        for i, (centre, scale) in cauchy.items():
            prior[i] = -math.log(math.pi * scale * (1 + ((x[i] - centre) / scale) ** 2))
        return found / t + float(np.sum(prior[free])) + 0.5 * float(z @ z) + volume if np.isfinite(found) else -1e30

    sampler = NestedSampler(
        log_posterior, ndtri, free.size, nlive=LIVE, bound="none", sample="unif", rstate=np.random.default_rng(1)
    )
    sampler.run_nested(dlogz=ENOUGH, maxcall=calls, print_progress=False)
    results = sampler.results
    drawn = results.samples_equal(rstate=np.random.default_rng(2))
    some = drawn[np.random.default_rng(3).choice(len(drawn), DRAWS)]
    log_prior = comparison.search._prior(model.hypothesis)
    return float(results.logz[-1]) + log_prior, float(results.logzerr[-1]), [own.values(x_of(z)) for z in some]


def predictive_check(model: Model, held: Sequence[Run], draws: Sequence[Mapping[str, float]]) -> tuple[float, float]:
    """Return p of the held-out runs by a posterior predictive check, and the rms of what they leave over that of noise."""
    ratios, chances = [], []
    noises = [noise_of(run) for run in held]
    for values in draws:
        square, spread, count = 0.0, 0.0, 0
        for run, noise in zip(held, noises, strict=True):
            left = model.fit.likelihood.held_out(run, dict(values)).found.nu[run.used]
            own = float(np.mean(left**2)) / noise.total**2 if np.isfinite(left).all() else 1e6
            square += own * left.size
            spread += 2 * left.size * (1 + 2 * float(np.sum(correlations(noise, run) ** 2)))
            count += left.size
        chances.append(0.5 * math.erfc((square - count) / math.sqrt(2 * spread)))
        ratios.append(math.sqrt(square / count))
    return float(np.mean(chances)), float(np.median(ratios))


def nested(registry: Registry, folder: Path, start: dict[str, float]) -> Answer:
    """Return what nested sampling says of a case."""
    comparison = Comparison(registry, folder, start, ())
    comparison.run()
    if not comparison.models:
        return Answer(folder.name, "unknown", confidence={"unknown": 1.0}, failure=LOST)
    base = comparison.models[Hypothesis().name]
    evidence, told, draws = {n: m.evidence for n, m in comparison.models.items()}, {}, {}
    begun, contenders = time.process_time(), comparison.contenders()
    for number, model in enumerate(contenders):
        left = SAMPLING - (time.process_time() - begun)
        if left <= 0:
            break
        each = timed(model)
        calls = int(min(CALLS, left / each if number else max(left / each, 4 * LIVE)))
        if calls > 2 * LIVE:
            evidence[model.hypothesis.name], error, draws[model.hypothesis.name] = sampled(comparison, model, calls)
            told[model.hypothesis.name] = (evidence[model.hypothesis.name] - model.evidence, error, calls)
    best = comparison.models[max(evidence, key=lambda n: evidence[n])]
    if evidence[best.hypothesis.name] < evidence[base.hypothesis.name] + DECISIVE:
        best = base
    held = [run for run in read_experiment(folder, registry=registry).runs if run.holdout]
    p, ratio = predictive_check(best, held, draws.get(best.hypothesis.name, [best.fit.values])) if held else (1.0, 1.0)
    note = f"temper {comparison.temper:.1f}, p {p:.2g}, held-out rms {ratio:.2f} of noise; " + "; ".join(
        f"{n}: sampled less Laplace {off:.1f}, error {error:.2f}" for n, (off, error, _) in told.items()
    )
    return concluded(folder, comparison, best, evidence, {"chance": p, "ratio": ratio}, note)


def timed(model: Model) -> float:
    """Return the s of CPU of one likelihood."""
    begun = time.process_time()
    model.fit.likelihood.at(model.fit.maximum.point.x, slopes=False)
    return max(time.process_time() - begun, 1e-4)


def discrepancy(registry: Registry, folder: Path, start: dict[str, float]) -> Answer:
    """Return what a Gaussian-process discrepancy says of a case."""
    comparison = Comparison(registry, folder, start, DISCREPANCY)
    comparison.run()
    if not comparison.models:
        return Answer(folder.name, "unknown", confidence={"unknown": 1.0}, failure=LOST)
    base, best = comparison.models[Hypothesis().name], comparison.best
    best = best if best.evidence > base.evidence + DECISIVE else base
    own, values, fitted, shown = best.fit.likelihood, best.fit.values, 0.0, 0.0
    for run in own.problem.runs:
        for names in own.gauges(run, 0):
            fitted += values[names["gauge_white"]] ** 2 + values[names["gauge_colour1"]] ** 2
            shown += comparison.noises[run.name].total ** 2
    ratio = math.sqrt(fitted / shown)
    note = f"process and noise {ratio:.2f} of what calm stretches show"
    evidence = {n: m.evidence for n, m in comparison.models.items()}
    return concluded(folder, comparison, best, evidence, {"ratio": ratio}, note)


def concluded(
    folder: Path, comparison: Comparison, best: Model, evidence: Mapping[str, float], left: dict[str, float | None], note: str
) -> Answer:
    """Return the answer that names the best model, and what is left beside it, which `gated` judges."""
    effects = tuple(sorted(best.hypothesis.reported))
    run = next((e.run for e in best.hypothesis.effects if e.run), "")
    tried = {
        n: {"evidence": round(evidence[n], 3), "log_likelihood": round(m.fit.log_likelihood, 3)}
        for n, m in sorted(comparison.models.items(), key=lambda item: -evidence[item[0]])
    }
    cut = "; cut short" if comparison.search.cut_short else ""
    verdict, said = ("identified", "+".join(effects)) if effects else ("none", "none")
    return Answer(folder.name, verdict, effects, {said: 1.0}, fit=left, tried=tried, failure=note + cut, run=run)


def gated(answer: Answer) -> Answer:
    """Return an answer as `unknown` where too much is left beside the best model."""
    left = {name: value or 0.0 for name, value in answer.fit.items()}
    lost = left["chance"] < CHANCE and left["ratio"] > MARGIN if "chance" in left else left.get("ratio", 0.0) > LARGEST
    return replace(answer, verdict="unknown", effects=(), confidence={"unknown": 1.0}, run="") if lost else answer


RIVALS: dict[str, Callable[[Registry, Path, dict[str, float]], Answer]] = {"nested": nested, "discrepancy": discrepancy}
SPARSE, UNREAD = "sparse", "a law, or an observable, that sparse regression does not read"
TITLES = {"srf": "srf diagnose", "nested": "nested sampling", "discrepancy": "Gaussian process", SPARSE: "sparse regression"}


def readable(registry: Registry, folder: Path) -> bool:
    """Return whether sparse regression knows the stated law and what the gauge shows."""
    experiment = read_experiment(folder, registry=registry, holdout=False)
    known = experiment.choice.law in ("srf-vsat", "dieterich-ruina") and experiment.choice.ageing == "dieterich"
    return known and all(run.observable == "elongation" and not run.others for run in experiment.runs)


def answer_case(registry: Registry, rival: str, folder: Path, kept: Path) -> Answer:
    """Return what a rival says of a case; what it cannot answer has failed."""
    try:
        if rival == SPARSE:
            return (
                sparse_regression.answer_case(registry, folder, kept)
                if readable(registry, folder)
                else failed(folder.name, UNREAD)
            )
        start, fitting = fitted_baseline(registry, folder, kept)
        begun = time.process_time()
        found = RIVALS[rival](registry, folder, start)
        return replace(found, cpu=fitting + time.process_time() - begun)
    except (ArithmeticError, LookupError, ValueError, SrfError, np.linalg.LinAlgError) as error:
        return failed(folder.name, f"{type(error).__name__}: {error}")


def answered(trial: Path, cases: int | None, kept: Path) -> dict[str, dict[str, Answer]]:
    """Return the answers of all rivals to the first cases of a trial; those that are kept are not sought again."""
    registry, folders = load_registry(), sorted(p for p in (trial / "bank").iterdir() if p.is_dir())[:cases]
    own = kept / str(json.loads((trial / "trial.json").read_text(encoding="utf-8"))["seed"])
    own.mkdir(parents=True, exist_ok=True)
    names = (*RIVALS, SPARSE)
    found = {rival: read_answers(own / f"answers-{rival}.jsonl") for rival in names}
    for folder in folders:
        for rival in names:
            if folder.name not in found[rival]:
                answer = found[rival][folder.name] = answer_case(registry, rival, folder, own)
                write_answers(own / f"answers-{rival}.jsonl", found[rival].values())
                print(folder.name, rival, answer.said or answer.verdict, f"{answer.cpu:.1f} s;", answer.failure, flush=True)
    return {rival: {f.name: found[rival][f.name] for f in folders} for rival in names}


def ungated(answer: Answer) -> Answer:
    """Return what a rival would say if it never said unknown."""
    effects = tuple(answer.parameters)  # of sparse regression
    return (
        replace(answer, verdict="identified" if effects else "none", effects=effects) if answer.verdict == "unknown" else answer
    )


def told(hits: int, count: int, interval: tuple[float | None, float | None]) -> str:
    """Return a share with its interval, in percent."""
    low, high = interval
    return f"{hits} of {count}" + (f" ({100 * low:.0f} to {100 * high:.0f})" if low is not None and high is not None else "")


def column(marks: Sequence[GradedAnswer]) -> list[str]:
    """Return one column of the table."""

    def share(chosen: Sequence[GradedAnswer], flag: Callable[[GradedAnswer], bool]) -> str:
        found = rate(flag(m) for m in chosen)
        return told(found.hits, found.count, found.interval)

    named = [m for m in marks if m.answer.verdict == "identified"]
    kinds = {kind: [m for m in marks if m.kind == kind] for kind in ("none", "single", "pair", "ageing", "one-run", "outside")}
    times = sorted(m.answer.cpu for m in marks)
    return [
        share(marks, lambda m: m.right),
        share([m for m in marks if not m.rough], lambda m: m.right),
        share([m for m in marks if m.rough], lambda m: m.right),
        share(kinds["none"], lambda m: m.alarm),
        share(named, lambda m: m.wrong_name),
        share(kinds["outside"], lambda m: m.answer.verdict == "unknown"),
        share([m for m in marks if m.kind != "outside"], lambda m: m.answer.verdict == "unknown"),
        *(share(kinds[kind], lambda m: m.right) for kind in ("single", "pair", "ageing", "one-run")),
        f"{np.median(times):.0f}; {times[-1]:.0f}",
    ]


ROWS = (
    "right", "right, no friction field", "right, a friction field", "false alarms, nothing concealed", "wrong, of all names",
    "unknown recognised", "unknown, where it is not", "one effect, right", "pairs, right", "ageing laws, right",
    "one run alone, right", "CPU in s: median; longest",
)  # fmt: skip


def main() -> None:
    """Answer the cases of all trials, mark the answers, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trials", nargs="+", help="TRIAL or TRIAL:CASES")
    parser.add_argument("--kept", type=Path, required=True, help="folder of the answers")
    parser.add_argument("--note", help="what to say of the cases at the head of the results")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    chosen = [(Path(name), int(cases) if cases else None) for name, _, cases in (t.partition(":") for t in asked.trials)]
    answers = [answered(trial, cases, asked.kept) for trial, cases in chosen]
    report = Report("rivals", __doc__ or "")
    report.say(f"# dynesty {version('dynesty')}, pysindy {version('pysindy')}")
    marks: dict[str, dict[tuple[int, str], GradedAnswer]] = {name: {} for name in TITLES}
    free: dict[str, dict[tuple[int, str], GradedAnswer]] = {name: {} for name in TITLES}
    for (trial, _), found in zip(chosen, answers, strict=True):  # only now
        truths, known = unseal(trial / "bank", trial / "truths.json"), trial / "known.jsonl"
        seed = json.loads((trial / "trial.json").read_text(encoding="utf-8"))["seed"]
        theirs = {name: a for name, a in read_answers(trial / "answers.jsonl").items() if name in found[SPARSE]}
        for rival, own in {"srf": theirs, **found}.items():
            some = [own[name] for name in sorted(own) if own[name].failure != UNREAD]
            marks[rival] |= {(seed, m.case): m for m in marked(truths, list(map(gated, some)), known)}
            free[rival] |= {(seed, m.case): m for m in marked(truths, list(map(ungated, some)), known)}
        report.say(f"# wide bank of seed {seed}: {len(found[SPARSE])} cases, {len(theirs)} of them answered by srf diagnose")
    report.say("# the former search cannot be run on these banks: former-search.md has what it found on its own")
    if asked.note:
        report.say(f"# {asked.note}")
    both = [key for key in marks["nested"] if key in marks["srf"]]
    read = [key for key in both if key in marks[SPARSE]]
    three = [name for name in TITLES if name != SPARSE]
    tables = (
        (f"{', '.join(TITLES[n] for n in three)} have answered", three, marks, both),
        ("the rivals have answered", list(RIVALS), marks, list(marks["nested"])),
        ("sparse regression reads", list(TITLES), marks, read),
        ("these have answered, were unknown never said", list(RIVALS), free, both),
        ("sparse regression reads, were unknown never said", [*RIVALS, SPARSE], free, read),
    )
    for what, who, of, keys in (t for t in tables if t[3] and (t[0] == tables[0][0] or t[3] != both or t[2] is free)):
        report.say(f"\n{len(keys)} cases that {what}; in brackets Wilson's intervals of 95 %, in percent")
        columns = [column([of[name][key] for key in keys]) for name in who]
        report.table(("", *(TITLES[n] for n in who)), [(row, *(c[i] for c in columns)) for i, row in enumerate(ROWS)])
    report.say("\ncases; * what is right")
    rows = []
    for key, first in marks["nested"].items():
        row = [marks[name].get(key) for name in TITLES]
        said = (f"{m.answer.said or m.answer.verdict}{' *' if m.right else ''}" if m else "-" for m in row)
        rows.append((first.case, "+".join(first.hidden) or first.kind, "rough" if first.rough else "smooth", *said))
    report.table(("case", "concealed", "track", *TITLES.values()), rows)


if __name__ == "__main__":
    main()
