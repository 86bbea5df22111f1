"""The search for what is missing: hypotheses fitted in full, in the order of what their scores promise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from srfcli.diagnosis.adequacy import Adequacy, gauge_noise, judge_residuals
from srfcli.diagnosis.candidates import Excluded, Hypothesis, applicable, own_parameters
from srfcli.diagnosis.score import Score, scores
from srfcli.inference import fit as fitting
from srfcli.inference.fit import Problem, Stage, first_level
from srfcli.inference.latent import STEPS, LatentFit, Tracks, evenness, fit_latent
from srfcli.inference.noise import Noise
from srfcli.laws import Effect
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Experiment
from srfcli.registry import Registry

WORTH = 12.0  # gain in log likelihood that an effect must bring: 300 columns are looked at, and noise is never quite as assumed
CLOSE = 6.0  # hypotheses within so much of the best may be it
RIVAL, RIVAL_SHARE = (
    30.0,
    0.05,
)  # short of the best score's gain: where the best leaves noise alone, less is not refitted
NEAR = 2.5  # residual over noise within which slopes at the fit tell where a better one is
HALFWAY = 1.25  # the same within which a rough track may be what is left
FOLLOWED, SHORTEST = 2.0, 60  # chi-squared per degree of freedom of a stage that still follows, samples that make a run
SHAKES = (1.5, 0.67)  # times its size: other starts of an effect
ASTRAY = 3.0  # times the chi-squared of where it came from: a start from which a fit had better grow anew
LOST = 0.3  # of a record's standard deviation: residual beyond which nothing is linear
ALIKE = 0.9  # likeness of two signals below which one does not stand in for the other
MOST_EVALUATIONS = 1500  # of the recordings by a model with slopes, in all
FIRST, SINGLES, PAIRS = 2, 8, 3  # refitted in full, at each stage


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


@dataclass
class Search:
    """One diagnosis on its way: what was tried, and how well it did."""

    registry: Registry
    experiment: Experiment
    progress: Callable[[str], None] = lambda text: None
    effects: Sequence[str] | None = None
    trend: str | None = None
    tried: dict[tuple[str, bool], Refit] = field(default_factory=dict)
    scored: dict[tuple[str, bool], list[Score]] = field(default_factory=dict)
    excluded: list[Excluded] = field(default_factory=list)
    stages: dict[str, list[Stage]] = field(default_factory=dict)
    noise: dict[str, Noise] = field(default_factory=dict)
    evaluations: int = 0

    def run(self) -> list[Refit]:
        """Return everything that was fitted, best evidence first."""
        candidates, self.excluded = applicable(self.registry, self.experiment, self.effects)
        self.look(candidates)
        self.rebase()
        return self.ranked()

    def rebase(self) -> None:
        """Fit what the best hypothesis is made of, and the baseline, from where the best one stands.

        A simpler hypothesis that had lost its way in a false minimum is to be judged at its own best.
        """
        for _ in range(3):
            best = self.best()
            if not best.hypothesis.effects:
                return
            effects = best.hypothesis.effects
            simpler = [Hypothesis(tuple(e for e in effects if e is not left)) for left in effects]
            for hypothesis in {h.name: h for h in (*simpler, Hypothesis())}.values():
                self.again(hypothesis, best)
            if self.best() is best:
                return

    def again(self, hypothesis: Hypothesis, best: Refit) -> None:
        """Fit a hypothesis from the parameters of a larger one."""
        problem = hypothesis.problem(
            self.registry, self.experiment, rough=best.rough, at=best.fit.values, trend=self.trend
        )
        tracks = best.fit.point.tracks if best.rough else Tracks((), {})
        fitted = fit_latent(
            problem, problem.start, self.noise, tracks=tracks, roughness=best.fit.point.roughness if best.rough else None,
            known_noise=True, steps=15,
        )  # fmt: skip
        self.keep(hypothesis, fitted, rough=best.rough)

    def look(self, candidates: Sequence[Effect]) -> None:
        """Fit hypotheses until one leaves noise alone, or what is worth trying has been tried."""
        baseline = self.baseline()
        first = self.score(baseline, candidates)
        if baseline.adequacy.fine and not (first and first[0].gain > WORTH):
            return
        near = baseline.adequacy.rms_over_noise < NEAR
        self.widen(baseline, candidates, FIRST if near else SINGLES, rough=False)
        if (
            self.settled(candidates)
            or (near and self.on_a_rough_track(baseline, candidates))
            or (not near and self.shaken(candidates))
            or self.roughened(candidates)
        ):
            return
        if self.shaken(candidates):
            return
        for refit in self.ranked()[:2]:
            if len(refit.hypothesis.effects) == 1:
                self.widen(refit, candidates, PAIRS, rough=refit.rough)
                if self.best().adequacy.fine:
                    break
        self.roughened(candidates)

    def on_a_rough_track(self, baseline: Refit, candidates: Sequence[Effect]) -> bool:
        """Return whether a rough track, alone or with an effect, accounts for what the baseline leaves."""
        rough = self.refit(Hypothesis(), baseline, {}, rough=True)
        if rough.adequacy.fine:
            self.widen(rough, candidates, PAIRS, rough=True)
            if self.settled(candidates):
                return True
        self.widen(baseline, candidates, SINGLES, rough=False)
        if self.settled(candidates) or self.shaken(candidates):
            return True
        self.widen(rough, candidates, PAIRS, rough=True)
        return self.settled(candidates)

    def shaken(self, candidates: Sequence[Effect]) -> bool:
        """Return whether one of the best leaves noise alone once it starts from a larger or smaller effect.

        Stick-slip has false minima, in which cycles are right on average and each is a little off.
        """
        for refit in self.ranked()[:3]:
            effects = refit.hypothesis.effects
            if len(effects) != 1 or not effects[0].sizes or refit.rough or refit.adequacy.rms_over_noise > HALFWAY:
                continue
            problem, neutral = refit.fit.problem, dict(effects[0].neutral)
            for factor in SHAKES:
                theta = refit.fit.point.theta.copy()
                for long, p in own_parameters(effects[0], problem.model).items():
                    if p.name in neutral and long in problem.names:
                        i = problem.names.index(long)
                        theta[i] = neutral[p.name] + factor * (theta[i] - neutral[p.name])
                theta = np.clip(theta, problem.lower, problem.upper)
                fitted = fit_latent(problem, theta, self.noise, tracks=Tracks((), {}), known_noise=True)
                if self.keep(refit.hypothesis, fitted, rough=False).adequacy.fine:
                    return self.settled(candidates)
        return False

    def roughened(self, candidates: Sequence[Effect]) -> bool:
        """Return whether the best so far leaves noise alone once its track may be rough."""
        best = self.best()
        if (
            not best.adequacy.fine
            and not best.rough
            and best.hypothesis.effects
            and best.adequacy.rms_over_noise < NEAR
        ):
            self.refit(best.hypothesis, best, {}, rough=True)
        return self.settled(candidates)

    def settled(self, candidates: Sequence[Effect]) -> bool:
        """Return whether the best so far leaves noise alone, and nothing promises more; what does promise is tried."""
        for _ in range(2):
            best = self.best()
            if not best.adequacy.fine:
                return False
            if len(best.hypothesis.effects) > 1:
                return True
            before = best.name
            self.widen(best, candidates, 2, rough=best.rough)
            if self.best().name == before:
                return True
        return self.best().adequacy.fine

    def baseline(self) -> Refit:
        """Return the baseline's fit, from the file's own start values."""
        problem = Hypothesis().problem(self.registry, self.experiment, rough=False, trend=self.trend)
        self.progress("baseline")
        theta = self.grown(Hypothesis(), problem)
        residuals = {r.name: r.observed - problem.predicted(r, theta, slopes=False).y for r in problem.runs}
        self.noise = gauge_noise(problem.runs, residuals)
        steps = 2 if self.lost(Hypothesis()) else STEPS
        return self.keep(
            Hypothesis(), fit_latent(problem, theta, self.noise, known_noise=True, steps=steps), rough=False
        )

    def grown(self, hypothesis: Hypothesis, problem: Problem) -> Array:
        """Return the parameters of a fit with growing horizons from the problem's start, and remember its stages."""
        noise = self.noise or {r.name: Noise(first_level(r)) for r in problem.runs}
        growing = fitting.Search(problem, lambda text: self.progress(f"{hypothesis.name}, {text}"), rough=True)
        theta, _ = growing.grow(np.clip(problem.start, problem.lower, problem.upper), noise)
        self.stages[hypothesis.name] = growing.stages
        self.evaluations += growing.evaluations
        return theta

    def lost(self, hypothesis: Hypothesis) -> bool:
        """Return whether a growing fit had to give a hypothesis up."""
        stages = self.stages.get(hypothesis.name)
        return stages is not None and len(stages) > 0 and stages[-1].reduced > fitting.HOPELESS

    def partly(self, refit: Refit) -> LatentFit:
        """Return a fit of the beginnings of all runs, as far as a hypothesis follows them: beyond, slopes mean nothing."""
        stages = self.stages.get(refit.name, [])
        good = [s for s in stages if s.reduced < FOLLOWED] or stages[:1]
        if not good:
            return refit.fit
        stage, problem = (
            good[-1],
            refit.hypothesis.problem(self.registry, self.experiment, rough=False, trend=self.trend),
        )
        runs = []
        for run in problem.runs:
            r = run.observed - problem.predicted(run, stage.theta, slopes=False).y
            far = ~(np.abs(r) < max(LOST * float(np.std(run.observed)), 8 * self.noise[run.name].level))
            n = int(np.argmax(far)) if far.any() else run.t.size
            if n >= SHORTEST:
                runs.append(replace(run, t=run.t[:n], observed=run.observed[:n], used=run.used[:n]))
        if not runs:
            return refit.fit
        self.progress(
            f"{refit.name}: scores on {100 * sum(r.t.size for r in runs) // sum(r.t.size for r in problem.runs)} % of the samples"
        )
        cut = replace(problem, runs=tuple(runs), experiment=replace(problem.experiment, runs=tuple(runs)))
        return fit_latent(cut, stage.theta, self.noise, known_noise=True)

    def keep(self, hypothesis: Hypothesis, fitted: LatentFit, *, rough: bool) -> Refit:
        """Return a fit judged, and remember it."""
        self.evaluations += fitted.evaluations
        runs = fitted.problem.runs
        residuals = {r.name: r.observed - fitted.point.predictions[r.name].y for r in runs}
        adequacy = replace(
            judge_residuals(runs, residuals, self.noise, freedom=spent(fitted)), p_tracks=evenness(fitted.point)
        )
        n = sum(int(r.used.sum()) for r in runs)
        cost = 0.5 * np.log(n) * (len(fitted.problem.names) - len(self.base_names())) + (4.0 if rough else 0.0)
        cost += 3.0 * len(hypothesis.effects)  # there are some twenty to choose from
        found = Refit(hypothesis, fitted, adequacy, fitted.log_likelihood - float(cost), rough)
        known = self.tried.get((hypothesis.name, rough))
        if known is None or found.evidence > known.evidence:
            self.tried[hypothesis.name, rough] = found
        self.progress(f"{hypothesis.name}{' on a rough track' if rough else ''}: log evidence {found.evidence:.1f}, "
                      f"rms over noise {adequacy.rms_over_noise:.3f}")  # fmt: skip
        return self.tried[hypothesis.name, rough]

    def base_names(self) -> tuple[str, ...]:
        """Return the baseline's free parameters."""
        return Hypothesis().problem(self.registry, self.experiment, rough=False, trend=self.trend).names

    def score(self, refit: Refit, candidates: Sequence[Effect]) -> list[Score]:
        """Return the scores of everything that a refit does not have yet."""
        key = (refit.name, refit.rough)
        if key not in self.scored:
            present = refit.hypothesis.effects
            reported = {e.reported for e in present}
            left = [e for e in candidates if e.reported not in reported and not (e.settings and present)]
            near = refit.rough or refit.adequacy.rms_over_noise < NEAR
            around = refit.fit if near else self.partly(refit)
            self.scored[key] = scores(self.registry, around.problem.experiment, around, left, present=present)
        return self.scored[key]

    def widen(self, refit: Refit, candidates: Sequence[Effect], most: int, *, rough: bool) -> None:
        """Refit the hypotheses that add one effect to a refit's own, those that promise most first."""
        least = WORTH if refit.adequacy.fine else WORTH / 2
        scored = self.score(refit, candidates)
        promising = [s for s in scored if s.gain > least][:most]
        if not refit.adequacy.fine:  # a mass or an interface that is not there has no first order worth the name
            built = [s for s in scored if s.effect.settings]
            promising = [*built, *(s for s in promising if not s.effect.settings)]
        for score in promising:
            if self.evaluations > MOST_EVALUATIONS:
                self.progress("the search ends here: its budget is spent")
                break
            if not self.rivals(score, promising, refit):
                continue
            hypothesis = Hypothesis((*refit.hypothesis.effects, score.effect))
            if any(
                set(t.hypothesis.effects) == set(hypothesis.effects) and r == rough for (_, r), t in self.tried.items()
            ):
                continue
            found = self.refit(hypothesis, refit, score.values, rough=rough)
            halfway = not found.adequacy.fine and found.adequacy.rms_over_noise < HALFWAY
            if not rough and halfway and self.best() is found:
                self.refit(hypothesis, found, {}, rough=True)

    def rivals(self, score: Score, others: Sequence[Score], refit: Refit) -> bool:
        """Return whether an effect may do as well as the best so far: always where that leaves more than noise."""
        best = self.best()
        if (
            not best.adequacy.fine
            or best.name == refit.name
            or len(best.hypothesis.effects) != len(refit.hypothesis.effects) + 1
        ):
            return True
        found = next((s for s in others if s.effect == best.hypothesis.effects[-1]), None)
        if found is None or found is score:
            return True
        alike = abs(float(found.direction @ score.direction))
        return alike > ALIKE and found.gain - score.gain < RIVAL + RIVAL_SHARE * found.gain

    def refit(self, hypothesis: Hypothesis, start: Refit, added: Mapping[str, float], *, rough: bool) -> Refit:
        """Fit a hypothesis from another one's parameters and from what a score expects of the added effect."""
        problem = hypothesis.problem(self.registry, self.experiment, rough=rough, trend=self.trend)
        at, own = dict(start.fit.values), {}
        if hypothesis.effects and hypothesis.effects != start.hypothesis.effects:
            for long, p in own_parameters(hypothesis.effects[-1], problem.model).items():
                if p.name in added:
                    own[long] = added[p.name]
        near = rough or start.adequacy.rms_over_noise < NEAR
        problem = hypothesis.problem(
            self.registry, self.experiment, rough=rough, at=at | own if near else own, trend=self.trend
        )
        theta, squares = self.shortened(hypothesis, problem) if near else (problem.start, np.inf)
        if not near or (not rough and squares > ASTRAY * start.fit.point.chi2):
            file_start = hypothesis.problem(self.registry, self.experiment, rough=rough, at=own, trend=self.trend)
            near, theta = False, self.grown(hypothesis, file_start)
        tracks = start.fit.point.tracks if rough and start.rough else None if rough else Tracks((), {})
        roughness = start.fit.point.roughness if rough else None
        steps = 2 if not near and self.lost(hypothesis) else STEPS
        fitted = fit_latent(
            problem, theta, self.noise, tracks=tracks, roughness=roughness, known_noise=True, steps=steps
        )
        return self.keep(hypothesis, fitted, rough=rough)

    def shortened(self, hypothesis: Hypothesis, problem: Problem) -> tuple[Array, float]:
        """Return the problem's start, the last effect's size cut where the whole of it leads astray, and chi-squared there."""
        if not hypothesis.effects or not hypothesis.effects[-1].sizes:
            return problem.start, 0.0
        effect = hypothesis.effects[-1]
        neutral = dict(effect.neutral)
        places = [(problem.names.index(long), neutral[p.name]) for long, p in own_parameters(effect, problem.model).items()
                  if p.name in neutral and long in problem.names]  # fmt: skip
        best = (problem.start, np.inf)
        for share in (1.0, 0.3, 0.0):
            theta = problem.start.copy()
            for i, value in places:
                theta[i] = value + share * (theta[i] - value)
            theta = np.clip(theta, problem.lower, problem.upper)
            squares = 0.0
            for run in problem.runs:
                r = (run.observed - problem.predicted(run, theta, slopes=False).y)[run.used] / self.noise[
                    run.name
                ].level
                squares += float(np.sum(np.where(np.isfinite(r), r, 1e6) ** 2))
            if squares < best[1]:
                best = (theta, squares)
        return best

    def ranked(self) -> list[Refit]:
        """Return everything that was fitted, best evidence first; of the two forms of a hypothesis the better one."""
        best: dict[str, Refit] = {}
        for refit in self.tried.values():
            if refit.name not in best or refit.evidence > best[refit.name].evidence:
                best[refit.name] = refit
        return sorted(best.values(), key=lambda r: -r.evidence)

    def best(self) -> Refit:
        """Return the refit with the best evidence."""
        return self.ranked()[0]


def spent(fitted: LatentFit) -> dict[str, float]:
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
