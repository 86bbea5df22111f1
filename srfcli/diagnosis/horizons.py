"""Where a baseline is far off, and nothing leads while held: hypotheses on a rough track, by horizons that grow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from srfcli.diagnosis.candidates import Hypothesis
from srfcli.diagnosis.columns import along_table
from srfcli.diagnosis.ledger import ROUGH_COSTS
from srfcli.diagnosis.refits import NEAR, PAIRS, Refit
from srfcli.diagnosis.score import scores
from srfcli.inference.fit import Problem
from srfcli.inference.grow import FOLLOWED, SHARES, Grown, grow, whole
from srfcli.inference.latent import LatentFit, fit_latent
from srfcli.inference.tracks import tracks_for
from srfcli.laws import Effect

if TYPE_CHECKING:
    from srfcli.diagnosis.search import Search

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
