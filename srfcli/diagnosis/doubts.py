"""What is asked once something leaves noise alone: what else does, from where the best stands, and on the other kind of track."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from srfcli.diagnosis.candidates import Hypothesis
from srfcli.diagnosis.columns import along_table
from srfcli.diagnosis.elsewhere import elsewhere, resized
from srfcli.diagnosis.follower import LOOSE_ONLY
from srfcli.diagnosis.refits import ASTRAY, HALFWAY, NEAR, PAIRS, ROUGHENED, Refit
from srfcli.inference.latent import fit_latent
from srfcli.laws import Effect

if TYPE_CHECKING:
    from srfcli.diagnosis.search import Search


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
