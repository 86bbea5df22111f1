"""Where a fit is far off: which effect, added to it, brings it back to the recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from srfcli.diagnosis.candidates import Hypothesis
from srfcli.diagnosis.elsewhere import elsewhere
from srfcli.diagnosis.follower import LOOSE_ONLY, PULLS
from srfcli.diagnosis.refits import Entry, Refit
from srfcli.diagnosis.score import Score
from srfcli.inference.latent import STEPS, Tracks, fit_latent

if TYPE_CHECKING:
    from srfcli.diagnosis.search import Search

CLEAR = 1.5  # chi-squared per degree of freedom under a pull that is nearly noise
STUCK = 0.8  # share of it that is left after more steps where these still help
WORSE = 1.25  # times the free chi-squared of the best: under a pull, too much to do better freely
HOPELESS = 4.0  # under a pull: what is missing is elsewhere, and only the best is let go, to go on from
RELEASED = 2  # fitted freely although their fit under the pull is no good, besides the best


def contest(search: Search, refit: Refit, promising: Sequence[Score]) -> list[Refit]:
    """Return the best of the hypotheses that add one effect to one that is far off: by their fits under a pull, then free.

    What is missing shows under the pull already: with it, little is left there.
    """
    around, found, waiting = search.pulled(refit).values, [], []
    for score in promising:
        hypothesis = Hypothesis((*refit.hypothesis.effects, score.effect))
        if not search.untried(hypothesis, rough=False):
            continue
        own = search.own_values(hypothesis, score.values)
        waiting.append(_entry(search, hypothesis, around | own, own, LOOSE_ONLY))
        if waiting[-1].reduced < CLEAR:
            found.append(elsewhere(search, _released(search, waiting.pop())))
            if found[-1].adequacy.fine:
                return found
    for first, entry in zip((True, *[False] * RELEASED), sorted(waiting, key=lambda e: e.reduced), strict=False):
        best = _entry(search, entry.hypothesis, entry.values, entry.own, LOOSE_ONLY)
        moves = best.reduced < STUCK * entry.reduced or bool(entry.hypothesis.effects[-1].settings)
        for way in PULLS[: 2 if moves else 1 if first else 0]:
            if best.reduced < CLEAR:
                break
            best = min(best, _entry(search, entry.hypothesis, entry.own, entry.own, way), key=lambda e: e.reduced)
        beaten = found and best.reduced > WORSE * min(r.adequacy.rms_over_noise for r in found) ** 2
        if beaten or (best.reduced > HOPELESS and not first):
            continue
        found.append(elsewhere(search, _released(search, best)))
        if found[-1].adequacy.fine:
            break
    return found


def _entry(
    search: Search, hypothesis: Hypothesis, at: Mapping[str, float], own: Mapping[str, float], way: Sequence[float]
) -> Entry:
    """Return a hypothesis fitted under a pull, from the values in `at`."""
    theta, reduced = search.follower.led(hypothesis, at, search.noise, way)
    problem = search.follower.problem(hypothesis, {})
    search.progress(f"{hypothesis.name}: rms over noise {np.sqrt(reduced):.2f} with the spring drawn")
    return Entry(hypothesis, theta, problem.named(theta), dict(own), reduced)


def _released(search: Search, entry: Entry) -> Refit:
    """Fit a hypothesis freely from parameters under a pull."""
    hypothesis = entry.hypothesis
    led = search.follower.released(hypothesis, entry.theta, search.noise)
    search.followed[hypothesis.name] = led
    problem = search.problem(hypothesis)
    steps = 2 if led.lost else STEPS
    fitted = fit_latent(problem, led.theta, search.noise, tracks=Tracks((), {}), known_noise=True, steps=steps)
    return search.keep(hypothesis, fitted, rough=False)
