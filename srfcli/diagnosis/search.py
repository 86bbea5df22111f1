"""The search for what is missing: hypotheses fitted in full, in the order of what their scores promise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from srfcli.diagnosis.candidates import Excluded, Hypothesis, applicable, built_beside, own_parameters
from srfcli.diagnosis.columns import along_table
from srfcli.diagnosis.contest import contest, unseen
from srfcli.diagnosis.doubts import second_thoughts
from srfcli.diagnosis.elsewhere import elsewhere, resized
from srfcli.diagnosis.follower import LOOSE_ONLY, Followed, shortened
from srfcli.diagnosis.horizons import by_horizons
from srfcli.diagnosis.ledger import Ledger
from srfcli.diagnosis.refits import ASTRAY, HALFWAY, NEAR, PAIRS, Entry, Refit
from srfcli.diagnosis.score import Score, pair_scores, scores
from srfcli.inference.latent import STEPS, LatentFit, fit_latent
from srfcli.inference.tracks import Tracks, tracks_for
from srfcli.laws import Effect

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
        steps = 2 if best.lost else STEPS
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
