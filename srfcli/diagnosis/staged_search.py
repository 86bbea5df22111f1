"""The staged search for what is missing: hypotheses fitted in full, in the order of what their scores promise.

A track moves the phase of every cycle that follows, so that a fit of whole recordings from parameters a few per cent off ends
in a false minimum. Over a tenth of them it does not, and what that tells of parameters and track brings the next into reach.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from srfcli.codegen.model import Array
from srfcli.data.values import Experiment, Run
from srfcli.diagnosis.goodness_of_fit import alike, gauge_noise
from srfcli.diagnosis.hypotheses import (
    ASTRAY,
    HALFWAY,
    NEAR,
    PAIRS,
    ROUGHENED,
    Entry,
    Excluded,
    Hypothesis,
    Refit,
    applicable,
    built_beside,
    judge_fit,
    neutral_values,
    own_parameters,
    residuals_of,
)
from srfcli.diagnosis.nudging import CLEAR, LOOSE_ONLY, PULLS, Followed, Follower, same, shortened
from srfcli.diagnosis.sensitivities import along_table
from srfcli.diagnosis.staged_score import Score, pair_scores, scores
from srfcli.inference.fit import Problem
from srfcli.inference.noise import Noise
from srfcli.inference.random_field import (
    LATENT_STEPS,
    USUAL,
    Latent,
    LatentFit,
    Point,
    Roughness,
    Tracks,
    attained,
    evenness,
    fit_latent,
    tracks_for,
)
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect

# Fits on a rough track by horizons that grow: cycles of stick-slip are brought into step one after another.

SHARES = (0.1, 0.2, 0.3, 0.4, 0.55, 0.7, 0.85)  # of the recordings, before all of them
TIED = 0.05  # relative standard deviation of parameters about their start: a short horizon determines few of them
STEPS, SETTLED = 10, 2.0  # at each horizon, and the gain in twice the log posterior that ends them
FOLLOWED = 2.25  # chi-squared per sample beyond which a horizon is not followed, and longer ones are in vain
SHORTEST = 20  # samples of a recording


@dataclass(frozen=True)
class Grown:
    """The fit over the longest horizon that was followed, `share` of the recordings; `left` over noise there, rms.

    `rank` orders fits: minus twice the log posterior per sample, plus a hundred times the share that was not followed.
    """

    fit: LatentFit
    share: float
    left: float
    rank: float
    evaluations: int


class Tied(Latent):
    """The posterior in which some parameters are known beforehand: they lie within TIED of where they start."""

    def __init__(self, problem: Problem, centre: Array, tied: Sequence[str]) -> None:
        super().__init__(problem)
        self.centre = centre
        self.precision = np.array([TIED**-2 if n in tied else 0.0 for n in problem.names]) / self.scale**2

    def at(self, theta: Array, tracks: Tracks, noise: Mapping[str, Noise], roughness: Roughness) -> Point:
        """Return everything at these parameters and tracks, the prior of the parameters included."""
        point, n, off = super().at(theta, tracks, noise, roughness), theta.size, theta - self.centre
        N, g = point.N.copy(), point.g.copy()
        N[range(n), range(n)] += self.precision * self.scale**2
        g[:n] -= self.precision * self.scale * off
        return replace(point, N=N, g=g, chi2=point.chi2 + float(self.precision @ off**2))


def grow(
    problem: Problem, tracks: Tracks, noise: Mapping[str, Noise], *, tied: Sequence[str], followed: float = FOLLOWED
) -> Grown:
    """Return the fit from the problem's start by horizons that grow, those named in `tied` held near where they start.

    They grow while less than `followed` is left, chi-squared per sample. The roughness is USUAL: it is estimated when all is
    followed, by `whole`.
    """
    theta, evaluations, rank = problem.start, 0, np.inf
    cut, reached = problem, 0.0
    for share in SHARES:
        shorter = replace(problem, runs=tuple(_until(run, share) for run in problem.runs))
        latent = Tied(shorter, problem.start, tied)
        trial = latent.minimise(latent.at(theta, tracks, noise, USUAL), noise, steps=STEPS, settled=SETTLED)
        evaluations += max(round(share * latent.evaluations), 1)
        beyond = trial.chi2 > followed * latent.samples
        if not beyond or not reached:  # the first horizon is the least that there is
            cut, theta, tracks, reached = shorter, trial.theta, trial.tracks, share
            rank = trial.penalised / latent.samples + 100 * (1 - share)
        if beyond:
            break
    plain = Latent(cut)
    place = plain.at(theta, tracks, noise, USUAL)
    left = float(np.sqrt(place.chi2 / plain.samples))
    return Grown(LatentFit(cut, place, dict(noise), attained(place), evaluations), reached, left, rank, evaluations)


def whole(problem: Problem, grown: Grown, noise: Mapping[str, Noise]) -> LatentFit:
    """Return the fit of all of the recordings from one that was grown, roughness estimated and nothing tied."""
    point = grown.fit.point
    return fit_latent(problem, point.theta, noise, tracks=point.tracks, roughness=USUAL, known_noise=True)


def _until(run: Run, share: float) -> Run:
    k = min(max(round(share * run.t.size), SHORTEST), run.t.size)
    return replace(run, t=run.t[:k], observed=run.observed[:k], used=run.used[:k])


# What a search has tried, and how well it did: every fit judged, with the evidence for it.

CHOICE, SECOND = 3.0, 6.0  # cost of an effect, as there are some twenty to choose from, and more of each further one
ROUGH = 4.0  # cost of a rough track
MOST_EVALUATIONS = 1800  # of the recordings by a model with slopes, in all
ROUGH_COSTS = 3  # of these, one with the slopes by a track
LITTLE, LOWER = 1.1, 0.01  # residual over noise from which noise is taken anew, and by how much lower than before
AGAIN = 2  # steps of a fit whose noise has changed


@dataclass
class Ledger:
    """The fits of one diagnosis, in its own words and on its budget."""

    registry: Registry
    experiment: Experiment
    progress: Callable[[str], None] = lambda text: None
    effects: Sequence[str] | None = None
    trend: str | None = None
    tried: dict[tuple[str, bool], Refit] = field(default_factory=dict)
    noise: dict[str, Noise] = field(default_factory=dict)
    evaluations: int = 0
    gauged_at: float = np.inf  # residual over noise of the fit that the noise was taken from

    def __post_init__(self) -> None:
        self.follower = Follower(self.registry, self.experiment, self.trend)

    def problem(self, hypothesis: Hypothesis, at: Mapping[str, float] | None = None, *, rough: bool = False) -> Problem:
        """Return the fit of a hypothesis from the values in `at`, integrated as exactly as the noise asks for."""
        found = hypothesis.problem(self.registry, self.experiment, rough=rough, at=at, trend=self.trend)
        return replace(found, rtol=self.follower.rtol)

    def base_names(self) -> tuple[str, ...]:
        """Return the baseline's free parameters."""
        return self.problem(Hypothesis()).names

    @cached_property
    def _had(self) -> frozenset[str]:
        return frozenset(Hypothesis().model(self.registry, self.experiment, rough=False).names)

    def stands(self, effects: Sequence[Effect]) -> bool:
        """Return whether each of some effects finds what it needs in the baseline, or brought by another of them."""
        there = self._had.union(p.name for e in effects for p in e.parameters)
        return all(there.issuperset(e.needs) for e in effects)

    def joining(self, candidates: Sequence[Effect], present: Sequence[Effect] = ()) -> list[Effect]:
        """Return the effects that can be added to those present: of no variant of one of them, built in alone, standing."""
        reported = {e.reported for e in present}
        return [
            e
            for e in candidates
            if e.reported not in reported and not (e.settings and present) and self.stands((*present, e))
        ]

    def keep(self, hypothesis: Hypothesis, fitted: LatentFit, *, rough: bool) -> Refit:
        """Return a fit judged, and remember it; where it leaves little, noise is known better than before."""
        self.evaluations += fitted.evaluations * (ROUGH_COSTS if rough else 1)
        found = self.judged(hypothesis, fitted, rough=rough)
        known = self.tried.get((hypothesis.name, rough))
        if known is None or found.evidence > known.evidence:
            self.tried[hypothesis.name, rough] = found
        self.progress(f"{hypothesis.name}{' on a rough track' if rough else ''}: log evidence {found.evidence:.1f}, "
                      f"rms over noise {found.adequacy.rms_over_noise:.3f}")  # fmt: skip
        left = found.adequacy.rms_over_noise
        if self.best() is found and left < LITTLE and left < self.gauged_at - LOWER:
            self.gauged_at = left
            self.regauge(found)
        return self.tried[hypothesis.name, rough]

    def judged(self, hypothesis: Hypothesis, fitted: LatentFit, *, rough: bool) -> Refit:
        """Return a fit with what it leaves, judged against the noise, and with its evidence."""
        runs = fitted.problem.runs
        adequacy = replace(judge_fit(fitted, self.noise), p_tracks=evenness(fitted.point))
        n = sum(int(r.used.sum()) for r in runs)
        cost = 0.5 * np.log(n) * (len(fitted.problem.names) - len(self.base_names())) + (ROUGH if rough else 0.0)
        more = len(hypothesis.effects)
        cost += CHOICE * more + SECOND * max(more - 1, 0)
        return Refit(hypothesis, fitted, adequacy, fitted.log_likelihood - float(cost), rough)

    def gauged(self, runs: Sequence[Run], residuals: Mapping[str, Array]) -> dict[str, Noise]:
        """Return the noise of each run, from residuals (n,) by run."""
        return gauge_noise(runs, residuals)

    def regauge(self, found: Refit) -> None:
        """Take the noise from what a fit leaves, and judge everything anew that was judged by a worse one's."""
        noise = self.gauged(found.fit.problem.runs, residuals_of(found.fit))
        if all(alike(noise[name], known) for name, known in self.noise.items()):
            return
        self.noise = noise
        self.progress(f"noise as {found.name} leaves it")
        for key, refit in list(self.tried.items()):
            point = refit.fit.point
            again = fit_latent(
                refit.fit.problem, point.theta, noise, tracks=point.tracks, roughness=point.roughness, known_noise=True,
                steps=AGAIN,
            )  # fmt: skip
            self.evaluations += again.evaluations * (ROUGH_COSTS if refit.rough else 1)
            self.tried[key] = self.judged(refit.hypothesis, again, rough=refit.rough)

    def untried(self, hypothesis: Hypothesis, *, rough: bool, above: float = -np.inf) -> bool:
        """Return whether a hypothesis was not fitted yet, to a log likelihood `above` one, and the budget leaves room for it."""
        if self.spent():
            self.progress(f"{hypothesis.name} is not tried: the search's budget is spent")
            return False
        return not any(set(t.hypothesis.effects) == set(hypothesis.effects) and r == rough and t.fit.log_likelihood > above
                       for (_, r), t in self.tried.items())  # fmt: skip

    @property
    def share(self) -> float:
        """Return the share of the search's budget that is used, from 0 to 1."""
        return min((self.evaluations + self.follower.evaluations) / MOST_EVALUATIONS, 1.0)

    def spent(self) -> bool:
        """Return whether the search's budget is used up."""
        return self.evaluations + self.follower.evaluations > MOST_EVALUATIONS

    def ranked(self) -> list[Refit]:
        """Return everything that was fitted, best evidence first; of the two forms of a hypothesis the better one."""
        best: dict[frozenset[Effect], Refit] = {}
        for refit in self.tried.values():
            effects = frozenset(refit.hypothesis.effects)
            if effects not in best or refit.evidence > best[effects].evidence:
                best[effects] = refit
        return sorted(best.values(), key=lambda r: -r.evidence)

    def best(self) -> Refit:
        """Return the refit with the best evidence."""
        return self.ranked()[0]


# The search for what is missing: hypotheses fitted in full, in the order of what their scores promise.

WORTH = 12.0  # gain in log likelihood that an effect must bring: 300 columns are looked at, and noise is never quite as assumed
CLOSE = 6.0  # hypotheses within so much of the best may be it
RIVAL = 30.0  # short of the best score's gain: where the best leaves noise alone, less is not refitted
RIVAL_SHARE = 0.05  # the same as a part of that gain
HALF = 0.5  # of a misfit, that one effect takes away before two are tried ahead of a rough track
ALIKE = 0.9  # likeness of two signals below which one does not stand in for the other
FAINTER = 0.05  # of the first's score: an effect that promises so little less is not tried
FIRST, SINGLES = 2, 8  # refitted in full, at each stage


@dataclass
class Search(Ledger):
    """One diagnosis on its way: what is fitted next."""

    scored: dict[tuple[str, bool], list[Score]] = field(default_factory=dict)
    stale: set[tuple[str, bool]] = field(default_factory=set)  # scored under a noise that is known better now
    excluded: list[Excluded] = field(default_factory=list)
    followed: dict[str, Followed] = field(default_factory=dict)
    held: dict[str, Entry] = field(default_factory=dict)  # the best fit of each hypothesis while held to the recording
    loose: dict[str, LatentFit] = field(default_factory=dict)
    shook: set[tuple[str, bool]] = field(default_factory=set)
    sized: set[str] = field(default_factory=set)  # tried at other sizes of what is built in
    stood: dict[str, Refit] = field(default_factory=dict)  # where the best was when each was last fitted from there
    begun: dict[tuple[frozenset[Effect], bool], set[tuple[float, ...]]] = field(default_factory=dict)
    raced: bool = False  # whether hypotheses were grown side by side
    shared: bool | None = None  # whether all runs slid on one rough track, once that was asked

    def run(self) -> list[Refit]:
        """Return everything that was fitted, best evidence first."""
        candidates, self.excluded = applicable(self.registry, self.experiment, self.effects)
        self.look(candidates)
        second_thoughts(self, candidates)
        for key in [k for k in self.stale if k[0] == Hypothesis().name]:
            self.score(self.tried[key], candidates)
        return self.ranked()

    def look(self, candidates: Sequence[Effect]) -> None:
        """Fit hypotheses until one leaves noise alone, or what is worth trying has been tried."""
        baseline = self.baseline()
        first = self.score(baseline, candidates)
        if baseline.adequacy.fine and not (first and first[0].gain > WORTH):
            return
        near = baseline.adequacy.rms_over_noise < NEAR
        if near and self.contested(baseline, candidates):
            return
        self.widen(baseline, candidates, FIRST if near else SINGLES, rough=False)
        if (
            self.settled(candidates)
            or (near and self.halved(baseline) and (self.paired(candidates) or self.together(baseline, candidates)))
            or (near and self.on_a_rough_track(baseline, candidates))
            or (not near and self.shaken(candidates))
            or self.paired(candidates)
            or self.together(baseline, candidates)
            or self.roughened(candidates)
            or self.shaken(candidates, rough=True)
        ):
            return
        self.paired(candidates)
        self.roughened(candidates)

    def halved(self, baseline: Refit) -> bool:
        """Return whether the best so far leaves less than half of what the baseline leaves above noise, and is no wave or drift.

        Those do so for any rough track.
        """
        if any(along_table(e) for e in self.best().hypothesis.effects):
            return False
        left, before = (r.adequacy.rms_over_noise**2 - 1 for r in (self.best(), baseline))
        return left < HALF * before

    def paired(self, candidates: Sequence[Effect]) -> bool:
        """Return whether one of the two best single effects leaves noise alone together with another."""
        for first, refit in zip((True, False), self.ranked(), strict=False):
            if len(refit.hypothesis.effects) == 1 and (first or refit.adequacy.rms_over_noise < NEAR):
                self.widen(refit, candidates, PAIRS, rough=refit.rough)
                if self.best().adequacy.fine:
                    return True
        return False

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

    def contested(self, baseline: Refit, candidates: Sequence[Effect]) -> bool:
        """Return whether effects that are chosen while held leave noise alone: a free fit that is near may be false."""
        if baseline.adequacy.rms_over_noise < HALFWAY:
            return False
        around = self.tangent(self.loosely(baseline))
        scored = scores(self.registry, around.problem.experiment, around, self.joining(candidates))
        entrants = [*(s for s in scored[SINGLES:] if unseen(s.effect)), *scored[:SINGLES]]
        contest(self, baseline, self.widened(baseline, entrants), candidates)
        return self.roughened(candidates) if self.best().adequacy.rms_over_noise < HALFWAY else False

    def bared(self, baseline: Refit, candidates: Sequence[Effect]) -> bool:
        """Return whether a baseline that is far off leaves noise alone on a rough track, or effects beside it do.

        While held, a wave or a drift stands in for a rough track, and where nothing leads, the track may be why.
        """
        best = self.best()
        led = best.adequacy.rms_over_noise < NEAR and not any(along_table(e) for e in best.hypothesis.effects)
        if led or (Hypothesis().name, True) in self.tried:
            return False
        return by_horizons(self, baseline, candidates)

    def on_one_track(self, hypothesis: Hypothesis, many: LatentFit) -> Refit:
        """Return a hypothesis on one rough track for all runs, found from where many stand, or on many if that is better."""
        tracks = tracks_for(many.problem.runs, shared=True)
        fitted = fit_latent(
            many.problem, many.point.theta, self.noise, tracks=tracks, roughness=many.point.roughness, known_noise=True
        )
        found = self.keep(hypothesis, fitted, rough=True)
        self.shared = found.fit.point.tracks.shared
        return found

    def shaken(self, candidates: Sequence[Effect], *, rough: bool = False) -> bool:
        """Return whether one of the best leaves noise alone once its effects start from elsewhere; `rough` ones take long."""
        for refit in self.ranked()[:2]:
            if (rough or not refit.rough) and elsewhere(self, refit).adequacy.fine:
                return self.settled(candidates)
        return False

    def roughened(self, candidates: Sequence[Effect]) -> bool:
        """Return whether the best so far leaves noise alone once its track may be rough."""
        best = self.best()
        asked = best.hypothesis.effects and not best.rough and not best.adequacy.fine
        if asked and best.adequacy.rms_over_noise < NEAR:
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
        self.progress("baseline")
        bare, runs = Hypothesis(), [r for r in self.experiment.runs if not r.holdout]
        self.noise = self.gauged(runs, {r.name: r.observed for r in runs})
        best = self.followed[bare.name] = self.follower.follow(bare, {}, self.noise)
        self.progress(f"baseline: rms over noise {best.reduced**0.5:.2f}, held to the recording {best.held**0.5:.2f}")
        self.noise = self.gauged(runs, self.follower.smallest(best))
        steps = 2 if best.lost else LATENT_STEPS
        return self.keep(
            bare, fit_latent(self.problem(bare), best.theta, self.noise, known_noise=True, steps=steps), rough=False
        )

    def regauge(self, found: Refit) -> None:
        """Take the noise from what a fit leaves; what was scored by another is scored anew when it is asked for."""
        before = self.noise
        super().regauge(found)
        if self.noise is not before:
            self.stale.update(self.scored)

    def tangent(self, fitted: LatentFit) -> LatentFit:
        """Return the fit around which scores are of first order, its parameters' slopes among it."""
        return fitted

    def score(self, refit: Refit, candidates: Sequence[Effect]) -> list[Score]:
        """Return the scores of everything that a refit does not have yet."""
        key = (refit.name, refit.rough)
        if key not in self.scored or key in self.stale:
            refit = self.tried[key]
            present = refit.hypothesis.effects
            left = self.joining(candidates, present)
            near = refit.rough or refit.adequacy.rms_over_noise < NEAR
            around = self.tangent(refit.fit if near else self.loosely(refit))
            self.stale.discard(key)
            self.scored[key] = scores(self.registry, around.problem.experiment, around, left, present=present)
        return self.scored[key]

    def widen(self, refit: Refit, candidates: Sequence[Effect], most: int, *, rough: bool) -> None:
        """Refit the hypotheses that add one effect to a refit's own, those that promise most first."""
        least = WORTH if refit.adequacy.fine else WORTH / 2
        scored = self.score(refit, candidates)
        promising = [s for s in scored if s.gain > max(least, FAINTER * scored[0].gain)][:most]
        far = not (rough or refit.adequacy.rms_over_noise < NEAR)
        # a mass or an interface that is not there has no first order worth the name
        if promising or not refit.adequacy.fine:
            built = [s for s in scored if (unseen(s.effect) if far else s.effect.settings)]
            promising = [*built, *(s for s in promising if s not in built)]
        if far:
            contest(self, refit, self.widened(refit, promising), candidates)
            return
        for score, (hypothesis, own) in zip(promising, self.widened(refit, promising), strict=True):
            # what adds to it and is below it lost its way
            above = refit.fit.log_likelihood if refit.rough == rough else -np.inf
            if not self.rivals(score, promising, refit) or not self.untried(hypothesis, rough=rough, above=above):
                continue
            if not self.anew(hypothesis, refit, rough=rough):
                continue
            found = self.refit(hypothesis, refit, own, rough=rough)
            if score.effect.settings:  # tried first; whether it leads is known when others were tried
                resized(self, found)
                continue
            if not rough and self.best() is found:
                found = elsewhere(self, found)
            if not rough and found.halfway and self.best() is found:
                self.refit(hypothesis, found, {}, rough=True)

        for hypothesis in built_beside(refit.hypothesis, candidates) if promising else ():
            if self.untried(hypothesis, rough=rough):
                resized(self, self.refit(hypothesis, refit, {}, rough=rough))

    def anew(self, hypothesis: Hypothesis, start: Refit, *, rough: bool) -> bool:
        """Return whether a hypothesis was not fitted yet from where a smaller one stands, and remember that it is."""
        key, place = (frozenset(hypothesis.effects), rough), tuple(start.fit.values.values())
        seen = self.begun.setdefault(key, set())
        new = place not in seen
        seen.add(place)
        return new

    def widened(self, refit: Refit, added: Sequence[Score]) -> list[tuple[Hypothesis, dict[str, float]]]:
        """Return the hypotheses that add one effect to a refit's own, with what its score expects of its parameters."""
        wider = [Hypothesis((*refit.hypothesis.effects, score.effect)) for score in added]
        return [(h, self.own_values(h, score.values)) for h, score in zip(wider, added, strict=True)]

    def together(self, baseline: Refit, candidates: Sequence[Effect]) -> bool:
        """Return whether two effects leave noise alone, of those that could explain most together."""
        near = baseline.adequacy.rms_over_noise < NEAR
        around = self.tangent(baseline.fit if near else self.loosely(baseline))
        foremost = pair_scores(self.registry, around.problem.experiment, around, self.joining(candidates))[:PAIRS]
        entrants = [(h, self.own_values(h, *p.values)) for p in foremost for h in (Hypothesis(p.effects),)]
        if not near:
            contest(self, baseline, entrants, candidates)
        for hypothesis, own in entrants if near else ():
            if self.untried(hypothesis, rough=False):
                elsewhere(self, self.refit(hypothesis, baseline, own, rough=False))
        return self.best().adequacy.fine

    def own_values(self, hypothesis: Hypothesis, *added: Mapping[str, float]) -> dict[str, float]:
        """Return what scores expect of the last effects' parameters, by their names in the model."""
        if not hypothesis.effects:
            return {}
        model = hypothesis.model(self.registry, self.experiment, rough=False)
        last = zip(hypothesis.effects[-len(added) :], added, strict=True)
        return {
            long: values[p.name]
            for effect, values in last
            for long, p in own_parameters(effect, model).items()
            if p.name in values
        }

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

    def refit(self, hypothesis: Hypothesis, start: Refit, own: Mapping[str, float], *, rough: bool) -> Refit:
        """Fit a hypothesis from another one's parameters and from its own values of those that were added."""
        at = dict(start.fit.values) | dict(own)
        problem = self.problem(hypothesis, at, rough=rough)
        theta, squares = shortened(hypothesis, problem, self.noise)
        if not rough and squares > ASTRAY * start.fit.point.chi2:
            theta = self.follower.follow(hypothesis, at, self.noise, [LOOSE_ONLY]).theta
        if not rough:
            fitted = fit_latent(problem, theta, self.noise, tracks=Tracks((), {}), known_noise=True)
            return self.keep(hypothesis, fitted, rough=False)
        if start.rough:
            fitted = fit_latent(
                problem, theta, self.noise, tracks=start.fit.point.tracks, roughness=start.fit.point.roughness,
                known_noise=True,
            )  # fmt: skip
            return self.keep(hypothesis, fitted, rough=True)
        tracks = tracks_for(problem.runs, shared=bool(self.shared))
        fitted = fit_latent(problem, theta, self.noise, tracks=tracks, known_noise=True)
        found = self.keep(hypothesis, fitted, rough=True)
        return found if self.shared is not None else self.on_one_track(hypothesis, fitted)

    def loosely(self, refit: Refit) -> LatentFit:
        """Return a hypothesis' fit under a loose hold: where it does not follow the recording, slopes mean something there."""
        if refit.name not in self.loose:
            known = self.followed.get(refit.name)
            values = known.problem.named(known.place) if known else refit.fit.values
            self.progress(f"{refit.name}: scores while held to the recording")
            self.loose[refit.name] = self.follower.around(refit.hypothesis, values, self.noise)
            self.evaluations += self.loose[refit.name].evaluations
        return self.loose[refit.name]


# Where a fit is far off: which effects, added to it, bring it back to the recording.

RELEASED = 3  # fitted freely, those that leave least while they are held first
PARTNERS, LEADERS = 4, 2  # effects that are tried beside one that leads, and how many lead
SIZES = (0.5, 0.6, 0.7, 0.35)  # of a built-in effect's parameters, between their bounds on a scale of logarithms
HOPELESS = 4.0  # times what the baseline leaves: other starts would not help


def contest(
    search: Search,
    refit: Refit,
    entrants: Sequence[tuple[Hypothesis, dict[str, float]]],
    candidates: Sequence[Effect] = (),
) -> list[Refit]:
    """Return the best of hypotheses that add effects to one that is far off: by their fits while held, then free.

    With what is missing, little is left under the hold already. `entrants` come with what is expected of the added parameters;
    the foremost are tried with a second effect of the `candidates`, too.
    """
    around, held, found = search.loosely(refit).values, list[Entry](), dict[str, Refit]()

    def free(entry: Entry) -> bool:
        refit = found[entry.hypothesis.name] = resized(search, _release(search, entry))
        if refit.halfway and search.best() is refit:  # beside a false minimum a rough track takes up what is left
            refit = found[entry.hypothesis.name] = elsewhere(search, refit)
        if refit.halfway and search.best() is refit and search.untried(entry.hypothesis, rough=True):
            refit = search.refit(entry.hypothesis, refit, {}, rough=True)
            if not refit.adequacy.fine and wandering(entry.hypothesis):  # it stood in for a part of the track
                doubt(search, candidates)
                return search.best().adequacy.fine
        return refit.adequacy.fine

    for hypothesis, own in entrants:
        if hypothesis.name in search.held or search.spent():
            continue
        held.append(_led(search, _entry(search, hypothesis, around | _expected(hypothesis, own))))
        if held[-1].reduced < CLEAR and free(held[-1]):
            return list(found.values())
    singles = sorted((e for e in held if e.single), key=lambda e: e.rank)
    if singles and singles[0].hypothesis.name not in found and free(singles[0]):  # one effect is asked before two
        return list(found.values())
    if candidates and not refit.hypothesis.effects and search.bared(refit, candidates):
        return list(found.values())
    for leader in singles[: LEADERS if candidates else 0]:
        held += _partnered(search, leader, candidates)
    waiting = [e for e in sorted(held, key=lambda e: e.rank) if e.hypothesis.name not in found]
    for entry in waiting[: RELEASED - len(singles[:1])]:
        if free(entry):
            break
    return list(found.values())


def _partnered(search: Search, leader: Entry, candidates: Sequence[Effect]) -> list[Entry]:
    """Return the fits, while held, of a hypothesis with each of the effects that promise most beside its own."""
    effects = leader.hypothesis.effects
    left = search.joining(candidates, effects)
    around = search.follower.around(leader.hypothesis, leader.values, search.noise)
    search.evaluations += around.evaluations
    scored = scores(search.registry, around.problem.experiment, around, left, present=effects)
    promising = [*scored[:PARTNERS], *(s for s in scored[PARTNERS:] if unseen(s.effect))]
    wider = [(h, search.own_values(h, s.values)) for s in promising for h in (Hypothesis((*effects, s.effect)),)]
    found = []
    for hypothesis, own in [*wider, *((h, {}) for h in built_beside(leader.hypothesis, candidates))]:
        if hypothesis.name not in search.held and not search.spent():
            found.append(_led(search, _entry(search, hypothesis, around.values | _expected(hypothesis, own))))
    return found


def unseen(effect: Effect) -> bool:
    """Return whether nothing is expected of an effect by its score while held: it is built in, or in the gauge that holds."""
    return bool(effect.settings or effect.observed)


def _expected(hypothesis: Hypothesis, own: Mapping[str, float]) -> dict[str, float]:
    """Return what a score expects of the last effect's parameters, nothing where it sees none."""
    return {} if unseen(hypothesis.effects[-1]) else dict(own)


def _led(search: Search, entry: Entry) -> Entry:
    """Return the best that other starts lead a hypothesis to whose last effect is built in: it is seen at no first order.

    They are the file's own values, the effect's parameters at some sizes: the baseline has been bent, and has no such parameter.
    """
    best, known = entry, search.followed.get(Hypothesis().name)
    if not any(e.settings for e in entry.hypothesis.effects) or (
        known is not None and entry.reduced > HOPELESS * known.held
    ):
        return entry
    problem = search.follower.problem(entry.hypothesis, {})
    bare = search.base_names()
    bounds = [(n, a, b) for n, a, b in zip(problem.names, problem.lower, problem.upper, strict=True) if n not in bare]
    for share in SIZES:
        if best.reduced < CLEAR or search.spent():
            break
        at = {name: float(a * (b / a) ** share if a > 0 else a + share * (b - a)) for name, a, b in bounds}
        best = min(best, _entry(search, entry.hypothesis, at), key=lambda e: e.reduced)
    return best


def _entry(search: Search, hypothesis: Hypothesis, at: Mapping[str, float]) -> Entry:
    """Return a hypothesis fitted while held, from the values in `at`."""
    theta, reduced = search.follower.led(hypothesis, at, search.noise, LOOSE_ONLY)
    problem = search.follower.problem(hypothesis, {})
    search.progress(f"{hypothesis.name}: rms over noise {np.sqrt(reduced):.3f}, held to the recording")
    found = Entry(hypothesis, theta, problem.named(theta), reduced)
    known = search.held.get(hypothesis.name)
    if known is None or reduced < known.reduced:
        search.held[hypothesis.name] = found
    return found


def _release(search: Search, entry: Entry) -> Refit:
    """Fit a hypothesis freely from parameters while held."""
    hypothesis = entry.hypothesis
    led = search.follower.released(hypothesis, entry.theta, entry.reduced, search.noise)
    search.followed[hypothesis.name] = led
    problem = search.problem(hypothesis)
    steps = 2 if led.lost else LATENT_STEPS
    fitted = fit_latent(problem, led.theta, search.noise, tracks=Tracks((), {}), known_noise=True, steps=steps)
    return search.keep(hypothesis, fitted, rough=False)


# What is asked once something leaves noise alone: what else does, from where the best stands, and on the other kind of track.


def second_thoughts(search: Search, candidates: Sequence[Effect]) -> None:
    """Fit what else may be it, now that something is best."""
    thoroughly(search)
    alike_on_rough_tracks(search, candidates)
    doubt(search, candidates)
    rebase(search)
    paired_on_smooth_tracks(search, candidates)
    thoroughly(search)


def thoroughly(search: Search) -> None:
    """Fit the best, on a smooth track, from other starts: within some errors of its minimum, too, noise alone may be left.

    What was missed there is a track that is not rough, and sizes that are off.
    """
    smooth = search.tried.get((search.best().name, False))
    if smooth is not None and smooth.adequacy.rms_over_noise < HALFWAY:
        elsewhere(search, resized(search, smooth, thorough=True), thorough=True)


def wandering(hypothesis: Hypothesis) -> list[Effect]:
    """Return those effects that move friction along the track or in the course of time: any rough track does that."""
    return [e for e in hypothesis.effects if along_table(e) and e.changes[0][0] == "mu"]


def doubt(search: Search, candidates: Sequence[Effect]) -> None:
    """Fit, on a rough track, what the best hypothesis is made of: a wave or a drift is easily seen in any rough track."""
    best, search.shared = search.best(), None
    effects = best.hypothesis.effects
    doubtful = wandering(best.hypothesis)
    within = NEAR if doubtful else HALFWAY
    simpler = [tuple(e for e in effects if e is not w) for w in (doubtful or (() if best.rough else effects))]
    for left in filter(search.stands, simpler):
        known = search.tried.get((Hypothesis(left).name, False))
        if known is None or known.adequacy.rms_over_noise > within:
            known = fitted(search, Hypothesis(left), best)
        if known.adequacy.rms_over_noise < within:
            found = search.refit(known.hypothesis, known, {}, rough=True)
            if found.evidence > best.evidence or not best.adequacy.fine:
                search.widen(found, candidates, PAIRS, rough=True)


def alike_on_rough_tracks(search: Search, candidates: Sequence[Effect]) -> None:
    """Fit on rough tracks, where the best is on one, those too that it led on a smooth one by less than it gained."""
    best = search.best()
    if not best.rough or not best.hypothesis.effects:
        return
    smooth = search.tried.get((best.name, False))
    worst = smooth.evidence - (best.evidence - smooth.evidence) if smooth else -np.inf
    others = [r for r in search.ranked() if not r.rough and r.hypothesis.effects and r.evidence > worst]
    for other in [r for r in others if r.adequacy.rms_over_noise < HALFWAY][:ROUGHENED]:
        if search.untried(other.hypothesis, rough=True):
            search.shared = None  # another model asks that anew
            found = search.refit(other.hypothesis, other, {}, rough=True)
            if search.best() is found:
                search.widen(found, candidates, PAIRS, rough=True)


def paired_on_smooth_tracks(search: Search, candidates: Sequence[Effect]) -> None:
    """Fit, where the best is one effect on a rough track, that one with others on a smooth one: a track hides them."""
    best = search.best()
    if best.rough and len(best.hypothesis.effects) == 1:
        smooth = search.tried.get((best.name, False)) or fitted(search, best.hypothesis, best)
        if smooth.adequacy.rms_over_noise < NEAR:
            search.widen(smooth, candidates, PAIRS, rough=False)
    if search.best() is not best:
        rebase(search)


def fitted(search: Search, hypothesis: Hypothesis, best: Refit) -> Refit:
    """Fit a hypothesis on a smooth track from where a larger one stands, once from each."""
    if search.stood.get(hypothesis.name) is best:
        return search.tried[hypothesis.name, False]
    search.stood[hypothesis.name] = best
    problem = search.problem(hypothesis, best.fit.values)
    found = fit_latent(problem, problem.start, search.noise, known_noise=True, steps=15)
    if found.point.chi2 > ASTRAY * best.fit.point.chi2:  # what was left out kept the cycles in step
        led = search.follower.follow(hypothesis, best.fit.values, search.noise, [LOOSE_ONLY])
        found = max(
            found,
            fit_latent(problem, led.theta, search.noise, known_noise=True, steps=15),
            key=lambda f: f.log_likelihood,
        )
    return search.keep(hypothesis, found, rough=False)


def rebase(search: Search) -> None:
    """Fit what the best hypothesis is made of, and the baseline, from where the best one stands.

    A simpler hypothesis that had lost its way in a false minimum is to be judged at its own best.
    """
    for _ in range(3):
        best = search.best()
        if not best.hypothesis.effects:
            return
        effects = best.hypothesis.effects
        simpler = [rest for left in effects if search.stands(rest := tuple(e for e in effects if e is not left))]
        for hypothesis in {h.name: h for h in (*map(Hypothesis, simpler), Hypothesis())}.values():
            again(search, hypothesis, best)
        if search.best() is best:
            return


def again(search: Search, hypothesis: Hypothesis, best: Refit) -> None:
    """Fit a hypothesis from the parameters of a larger one, on a rough track only where a smooth one has little left."""
    known = search.tried.get((hypothesis.name, False))
    far = best.rough and known is not None and known.adequacy.rms_over_noise > NEAR
    if far and fitted(search, hypothesis, best).adequacy.rms_over_noise > NEAR:
        return
    if not best.rough:
        fitted(search, hypothesis, best)
        return
    problem = search.problem(hypothesis, best.fit.values, rough=True)
    found = fit_latent(
        problem, problem.start, search.noise, tracks=best.fit.point.tracks, roughness=best.fit.point.roughness,
        known_noise=True, steps=15,
    )  # fmt: skip
    search.keep(hypothesis, found, rough=True)


# Other starts of a hypothesis: where cycles are right on average and each is a little off, a minimum is false.

SHAKES = (2.0, 0.5)  # times its size: other starts of an effect
RUNGS = (1.5, 0.65, 1.2, 0.8, 2.2, 0.45)  # times a mass: its minima lie a third apart, where oscillation is a cycle off
BETTER = 1.0  # in log likelihood, from where on a place is another one
CLIMBS, BRIEF = 12, 8  # fits of a mass from other sizes, and their steps


def elsewhere(search: Search, refit: Refit, *, thorough: bool = False) -> Refit:
    """Return the best fit of a hypothesis from other starts: the file's own, larger and smaller effects, other wavelengths.

    The file's own come first: without the effect the baseline may have been bent, and its parameters do not find back. One that
    leaves noise alone is left as it is, unless all starts are to be tried: beside a minimum that is fine there may be a better.
    """
    key = (refit.name, refit.rough)
    if (
        key in search.shook
        or (refit.adequacy.fine and not thorough)
        or refit.adequacy.rms_over_noise > NEAR
        or not refit.hypothesis.effects
    ):
        return refit
    search.shook.add(key)
    values = dict(refit.fit.values)
    tries: list[tuple[dict[str, float], Sequence[float]]] = [
        (values | start, LOOSE_ONLY) for start in other_starts(search, refit)
    ]
    if not refit.rough:
        own = [long for e in refit.hypothesis.effects for long in own_parameters(e, refit.fit.problem.model)]
        tries.insert(0, ({long: values[long] for long in own if long in values}, PULLS[-1]))
    seen: list[float] = []
    for at, way in tries:
        if search.spent():
            break
        if refit.rough:
            fitted = fit_by_horizons(search, refit.hypothesis, at, shared=refit.fit.point.tracks.shared)
        else:
            fitted = _smooth(search, refit, at, way, seen)
        if fitted is not None:
            refit = search.keep(refit.hypothesis, fitted, rough=refit.rough)
        if refit.adequacy.fine and not thorough:
            break
    return refit


def resized(search: Search, refit: Refit, *, thorough: bool = False) -> Refit:
    """Return the best fit of a hypothesis with an effect that is built in from other sizes of it, each rung from the best so far.

    With a mass the slider oscillates: a minimum is false where it is a cycle off, and a hold damps that and does not show it.
    """
    built = [e for e in refit.hypothesis.effects if e.settings]
    left = refit.adequacy.fine and not thorough
    if left or refit.name in search.sized or refit.rough or not built:
        return refit
    search.sized.add(refit.name)
    names = [
        n
        for e in built
        for n in (*own_parameters(e, refit.fit.problem.model), *e.frees)
        if refit.fit.values.get(n, 0) > 0
    ]
    rungs = [(name, factor) for name in names for factor in RUNGS]
    at = 0
    for _ in range(CLIMBS):
        done = refit.adequacy.fine and not thorough
        if done or refit.adequacy.rms_over_noise > NEAR or at == len(rungs) or search.spent():
            break
        name, factor = rungs[at]
        values = dict(refit.fit.values)
        problem = search.problem(refit.hypothesis, values | {name: factor * values[name]})
        fitted = fit_latent(problem, problem.start, search.noise, known_noise=True, steps=BRIEF)
        before, refit = refit, search.keep(refit.hypothesis, fitted, rough=False)
        at = 0 if refit.evidence > before.evidence + BETTER else at + 1
    return refit


def other_starts(search: Search, refit: Refit) -> list[dict[str, float]]:
    """Return values of the effects' own parameters: where the residual asks for a wave or a drift, and other sizes."""
    values, model, effects = refit.fit.values, refit.fit.problem.model, refit.hypothesis.effects
    starts: list[dict[str, float]] = []
    for effect in effects:
        neutral, own = neutral_values(effect), own_parameters(effect, model)
        if along_table(effect) and effect.scans and not refit.rough:
            (score,) = scores(search.registry, refit.fit.problem.experiment, refit.fit, [effect], present=effects)
            starts.append({long: score.values[p.name] for long, p in own.items() if p.name in score.values})
        for factor in SHAKES:
            starts.append({long: neutral[p.name] + factor * (values[long] - neutral[p.name])
                           for long, p in own.items() if p.name in neutral and long in values})  # fmt: skip
    return [start for start in starts if start]


def _smooth(
    search: Search, refit: Refit, at: dict[str, float], way: Sequence[float], seen: list[float]
) -> LatentFit | None:
    """Return the fit from where a hold leads, None where it is lost or leads to a place that was `seen`."""
    theta, reduced = search.follower.led(refit.hypothesis, at, search.noise, way)
    if any(same(reduced, known) for known in seen):
        return None
    seen.append(reduced)
    led = search.follower.released(refit.hypothesis, theta, reduced, search.noise)
    if led.lost:
        return None
    return fit_latent(refit.fit.problem, led.theta, search.noise, tracks=Tracks((), {}), known_noise=True)


# Where a baseline is far off, and nothing leads while held: hypotheses on a rough track, by horizons that grow.

FOREMOST = 5  # effects that are grown beside a hypothesis
FAINT = 0.2  # of the first one's score, what another has to promise
STRICT = 1.44  # chi-squared per sample within which they grow: with what is missing noise alone is left
CLEARLY = 60.0  # twice the log posterior by which one leads, so that the next is not asked


@dataclass(frozen=True)
class Entrant:
    """A hypothesis on its way: its fit over the longest horizon that it follows."""

    hypothesis: Hypothesis
    problem: Problem
    grown: Grown

    @property
    def follows(self) -> bool:
        """Return whether it follows the recordings nearly to their end."""
        return self.grown.share == SHARES[-1]


def by_horizons(search: Search, baseline: Refit, candidates: Sequence[Effect]) -> bool:
    """Return whether the baseline on a rough track, or effects beside it, leave noise alone; asked once.

    What is missing stops a horizon from growing, or leaves more there, and is scored where slopes still mean something; where
    none of those that promise most follows, the others are asked. It starts from the file's own values or from where the baseline
    stands while held, whichever follows further. The track is the same for all runs: one for each takes up what is missing as
    well as roughness.
    """
    if search.raced:
        return False
    search.raced, bare = True, Hypothesis()
    starts: tuple[Mapping[str, float], ...] = ({}, search.loosely(baseline).values)
    tries = [(entrant(search, bare, at, shared=True), at) for at in starts]
    alone, values = min(tries, key=lambda found: found[0].grown.rank)
    around = alone.grown.fit
    if alone.follows:
        found = _freed(search, alone)
        if found.adequacy.fine:
            search.widen(found, candidates, PAIRS, rough=True)
            return search.settled(candidates)
        if found.adequacy.rms_over_noise < NEAR:
            around = found.fit
    singles = _beside(search, bare, around, candidates, values)
    if _released(search, singles) or not singles:
        return search.settled(candidates)
    leader = singles[0]
    at = {**values, **leader.grown.fit.values}
    _released(search, _beside(search, leader.hypothesis, leader.grown.fit, candidates, at))
    return search.settled(candidates)


def entrant(
    search: Search, hypothesis: Hypothesis, at: Mapping[str, float], *, shared: bool, followed: float = FOLLOWED
) -> Entrant:
    """Return a hypothesis grown from the values in `at`, on one track for all runs or on one for each."""
    problem = search.problem(hypothesis, at, rough=True)
    grown = grow(
        problem, tracks_for(problem.runs, shared=shared), search.noise, tied=search.base_names(), followed=followed
    )
    search.evaluations += grown.evaluations * ROUGH_COSTS
    search.progress(
        f"{hypothesis.name} on a rough track: follows {100 * grown.share:.0f} % of the recordings, "
        f"rms over noise {grown.left:.3f}"
    )
    return Entrant(hypothesis, problem, grown)


def fit_by_horizons(
    search: Search, hypothesis: Hypothesis, at: Mapping[str, float], *, shared: bool
) -> LatentFit | None:
    """Return the fit of all of the recordings from the values in `at`, None where horizons do not grow to their end."""
    found = entrant(search, hypothesis, at, shared=shared)
    return whole(found.problem, found.grown, search.noise) if found.follows else None


def _beside(
    search: Search, hypothesis: Hypothesis, around: LatentFit, candidates: Sequence[Effect], values: Mapping[str, float]
) -> list[Entrant]:
    """Return the hypotheses that add one effect, grown, the best first: those that promise most, and those that are built in.

    Beside the bare baseline every other one is asked, too, where none of these follows, but for waves and drifts.
    """
    present = hypothesis.effects
    left = search.joining(candidates, present)
    scored = scores(search.registry, around.problem.experiment, around, left, present=present)
    least = FAINT * scored[0].gain if scored and not present else 0.0  # beside a leader scores tell less
    promising = [s for i, s in enumerate(scored) if (i < FOREMOST and s.gain >= least) or s.effect.settings]
    names = {s.effect.name for s in promising}
    others = [s for s in scored if s.effect.name not in names and not along_table(s.effect)]
    found = list[Entrant]()
    for score in [*promising, *(() if present else others)]:
        if score.effect.name not in names and any(e.follows for e in found):
            break
        wider = Hypothesis((*present, score.effect))
        own = search.own_values(wider, score.values) if along_table(score.effect) else {}
        if search.untried(wider, rough=True):
            found.append(entrant(search, wider, {**values, **own}, shared=True, followed=STRICT))
    return sorted(found, key=lambda e: e.grown.rank)


def _released(search: Search, entrants: Sequence[Entrant]) -> bool:
    """Return whether one of those that follow the recordings leaves noise alone, set free: the best, and what is close to it."""
    following = [e for e in entrants if e.follows]
    for e in following[:2]:
        samples = sum(int(r.used.sum()) for r in e.grown.fit.problem.runs)
        if (
            e is not following[0]
            and (e.grown.rank - following[0].grown.rank) * samples > CLEARLY
            and search.best().adequacy.fine
        ):
            break
        _freed(search, e)
    return search.best().adequacy.fine


def _freed(search: Search, found: Entrant) -> Refit:
    """Fit the whole of the recordings from a hypothesis that follows them, and without a track, too: it may not be rough."""
    refit = search.keep(found.hypothesis, whole(found.problem, found.grown, search.noise), rough=True)
    if refit.adequacy.rms_over_noise < NEAR:
        search.shared = True
    smooth = search.problem(found.hypothesis, found.grown.fit.values)
    theta = smooth.start
    if not refit.adequacy.fine:
        theta, _ = search.follower.grow(smooth, theta, search.noise)
    search.keep(found.hypothesis, fit_latent(smooth, theta, search.noise, known_noise=True), rough=False)
    return refit
