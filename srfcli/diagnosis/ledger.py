"""What a search has tried, and how well it did: every fit judged, with the evidence for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from srfcli.diagnosis.adequacy import alike, gauge_noise
from srfcli.diagnosis.candidates import Hypothesis
from srfcli.diagnosis.follower import Follower
from srfcli.diagnosis.refits import Refit, judge_fit, residuals_of
from srfcli.inference.fit import Problem
from srfcli.inference.latent import LatentFit, evenness, fit_latent
from srfcli.inference.noise import Noise
from srfcli.laws import Effect
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Experiment, Run
from srfcli.registry import Registry

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
