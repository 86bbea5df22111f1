"""Where a fit is far off: which effects, added to it, bring it back to the recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from srfcli.diagnosis.candidates import Hypothesis, built_beside
from srfcli.diagnosis.doubts import doubt, wandering
from srfcli.diagnosis.elsewhere import elsewhere, resized
from srfcli.diagnosis.follower import CLEAR, LOOSE_ONLY
from srfcli.diagnosis.refits import Entry, Refit
from srfcli.diagnosis.score import scores
from srfcli.inference.latent import STEPS, fit_latent
from srfcli.inference.tracks import Tracks
from srfcli.laws import Effect

if TYPE_CHECKING:
    from srfcli.diagnosis.search import Search

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
        refit = found[entry.hypothesis.name] = resized(search, _released(search, entry))
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


def _released(search: Search, entry: Entry) -> Refit:
    """Fit a hypothesis freely from parameters while held."""
    hypothesis = entry.hypothesis
    led = search.follower.released(hypothesis, entry.theta, entry.reduced, search.noise)
    search.followed[hypothesis.name] = led
    problem = search.problem(hypothesis)
    steps = 2 if led.lost else STEPS
    fitted = fit_latent(problem, led.theta, search.noise, tracks=Tracks((), {}), known_noise=True, steps=steps)
    return search.keep(hypothesis, fitted, rough=False)
