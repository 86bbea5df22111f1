"""Where a fit is far off: which effect, added to it, brings it back to the recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from srfcli.diagnosis.candidates import Hypothesis
from srfcli.diagnosis.elsewhere import elsewhere
from srfcli.diagnosis.follower import LOOSE_ONLY, PULLS, same
from srfcli.diagnosis.refits import Entry, Refit
from srfcli.inference.latent import STEPS, Tracks, fit_latent

if TYPE_CHECKING:
    from srfcli.diagnosis.search import Search

CLEAR = 1.5  # chi-squared per degree of freedom under a pull that is nearly noise
WORSE = 1.25  # times the free chi-squared of the best: under a pull, too much to do better freely
AGAIN = 4  # led again from other places and by stronger pulls: a minimum of one that does well already may be false
RELEASED = 2  # fitted freely although their fit under the pull is no good


def contest(
    search: Search, refit: Refit, entrants: Sequence[tuple[Hypothesis, dict[str, float]]], *, again: int = AGAIN
) -> list[Refit]:
    """Return the best of hypotheses that add effects to one that is far off: by their fits under a pull, then free.

    With what is missing, little is left under the pull already. `entrants` come with what is expected of the added parameters;
    the foremost `again` are led again.
    """
    around, waiting, found = search.pulled(refit).values, [], []
    for hypothesis, own in entrants:
        if not search.untried(hypothesis, rough=False):
            continue
        waiting.append(_entry(search, hypothesis, around | own, own, LOOSE_ONLY))
        if waiting[-1].reduced < CLEAR:
            found.append(elsewhere(search, _released(search, waiting.pop())))
            if found[-1].adequacy.fine:
                return found
    waiting.sort(key=lambda e: e.reduced)
    left = []
    for i, entry in enumerate(waiting):
        single = len(entry.hypothesis.effects) == 1
        best = _led_again(search, entry, around) if single and (i < again or _built(entry)) else entry
        if best.reduced >= CLEAR:
            left.append(best)
            continue
        found.append(elsewhere(search, _released(search, best)))
        if found[-1].adequacy.fine:
            return found
    for best in sorted(left, key=lambda e: e.reduced)[:RELEASED]:
        if not found or best.reduced < WORSE * min(r.adequacy.rms_over_noise for r in found) ** 2:
            found.append(elsewhere(search, _released(search, best)))
            if found[-1].adequacy.fine:
                break
    return found


def _led_again(search: Search, entry: Entry, around: dict[str, float]) -> Entry:
    """Return the best that other starts and stronger pulls lead a hypothesis to, until little is left or two agree."""
    best = entry
    for at, way in ((entry.own, PULLS[0]), (around | entry.own, PULLS[1]), (entry.own, PULLS[1])):
        if best.reduced < CLEAR or search.spent():
            break
        found = _entry(search, entry.hypothesis, at, entry.own, way)
        agreed = same(found.reduced, best.reduced) and not _built(entry)
        best = min(best, found, key=lambda e: e.reduced)
        if agreed:
            break
    return best


def _built(entry: Entry) -> bool:
    """Return whether the last effect is built into the model: what it does there is seen at no first order."""
    return bool(entry.hypothesis.effects[-1].settings)


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
    led = search.follower.released(hypothesis, entry.theta, entry.reduced, search.noise)
    search.followed[hypothesis.name] = led
    problem = search.problem(hypothesis)
    steps = 2 if led.lost else STEPS
    fitted = fit_latent(problem, led.theta, search.noise, tracks=Tracks((), {}), known_noise=True, steps=steps)
    return search.keep(hypothesis, fitted, rough=False)
