"""What a search has tried, and how well it did: every fit judged, with the evidence for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from srfcli.diagnosis.adequacy import judge_residuals
from srfcli.diagnosis.candidates import Hypothesis
from srfcli.diagnosis.follower import Follower
from srfcli.diagnosis.refits import Refit, freedom_spent
from srfcli.inference.fit import Problem
from srfcli.inference.latent import LatentFit, evenness
from srfcli.inference.noise import Noise
from srfcli.recording.values import Experiment
from srfcli.registry import Registry

CHOICE, SECOND = 3.0, 6.0  # cost of an effect, as there are some twenty to choose from, and more of each further one
ROUGH = 4.0  # cost of a rough track
MOST_EVALUATIONS = 1200  # of the recordings by a model with slopes, in all
ROUGH_COSTS = 3  # of these, one with the slopes by a track


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

    def __post_init__(self) -> None:
        self.follower = Follower(self.registry, self.experiment, self.trend)

    def problem(self, hypothesis: Hypothesis, at: Mapping[str, float] | None = None, *, rough: bool = False) -> Problem:
        """Return the fit of a hypothesis from the values in `at`, integrated as exactly as the noise asks for."""
        found = hypothesis.problem(self.registry, self.experiment, rough=rough, at=at, trend=self.trend)
        return replace(found, rtol=self.follower.rtol)

    def base_names(self) -> tuple[str, ...]:
        """Return the baseline's free parameters."""
        return self.problem(Hypothesis()).names

    def keep(self, hypothesis: Hypothesis, fitted: LatentFit, *, rough: bool) -> Refit:
        """Return a fit judged, and remember it."""
        self.evaluations += fitted.evaluations * (ROUGH_COSTS if rough else 1)
        runs = fitted.problem.runs
        residuals = {r.name: r.observed - fitted.point.predictions[r.name].y for r in runs}
        adequacy = replace(
            judge_residuals(runs, residuals, self.noise, freedom=freedom_spent(fitted)), p_tracks=evenness(fitted.point)
        )
        n = sum(int(r.used.sum()) for r in runs)
        cost = 0.5 * np.log(n) * (len(fitted.problem.names) - len(self.base_names())) + (ROUGH if rough else 0.0)
        more = len(hypothesis.effects)
        cost += CHOICE * more + SECOND * max(more - 1, 0)
        found = Refit(hypothesis, fitted, adequacy, fitted.log_likelihood - float(cost), rough)
        known = self.tried.get((hypothesis.name, rough))
        if known is None or found.evidence > known.evidence:
            self.tried[hypothesis.name, rough] = found
        self.progress(f"{hypothesis.name}{' on a rough track' if rough else ''}: log evidence {found.evidence:.1f}, "
                      f"rms over noise {adequacy.rms_over_noise:.3f}")  # fmt: skip
        return self.tried[hypothesis.name, rough]

    def untried(self, hypothesis: Hypothesis, *, rough: bool) -> bool:
        """Return whether a hypothesis was not fitted yet and the budget leaves room for it."""
        if self.spent():
            self.progress(f"{hypothesis.name} is not tried: the search's budget is spent")
            return False
        return not any(set(t.hypothesis.effects) == set(hypothesis.effects) and r == rough
                       for (_, r), t in self.tried.items())  # fmt: skip

    def spent(self) -> bool:
        """Return whether the search's budget is used up."""
        return self.evaluations + self.follower.evaluations > MOST_EVALUATIONS

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
