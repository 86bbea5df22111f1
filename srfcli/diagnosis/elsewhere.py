"""Other starts of a hypothesis: where cycles are right on average and each is a little off, a minimum is false."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from srfcli.diagnosis.candidates import neutral_values, own_parameters
from srfcli.diagnosis.columns import along_table
from srfcli.diagnosis.follower import LOOSE_ONLY, PULLS, same
from srfcli.diagnosis.horizons import fit_by_horizons
from srfcli.diagnosis.refits import NEAR, Refit
from srfcli.diagnosis.score import scores
from srfcli.inference.latent import LatentFit, fit_latent
from srfcli.inference.tracks import Tracks

if TYPE_CHECKING:
    from srfcli.diagnosis.search import Search

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
