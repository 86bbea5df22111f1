"""Hypotheses fitted with the spring drawn to the recording first, then free: where they start from hardly matters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srfcli.diagnosis.candidates import Hypothesis, own_parameters
from srfcli.inference import fit as fitting
from srfcli.inference.fit import Problem, first_level
from srfcli.inference.follow import pull_towards, slip_length, weaker
from srfcli.inference.latent import LatentFit, Tracks, fit_latent
from srfcli.inference.noise import Noise
from srfcli.inference.prediction import RTOL
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Experiment
from srfcli.registry import Registry

LOOSE = 5.0  # slip lengths over which a pull acts that leaves most of a misfit to be seen
PULLS = (
    (2.5, LOOSE),
    (0.6, 1.25, 2.5, LOOSE),
    (0.15, 0.3, 0.6, 1.25, 2.5, LOOSE),
)  # the same, ever weaker; the next way is tried where one leads nowhere
LOOSE_ONLY = (LOOSE,)  # the one pull that a refit starts under
COARSE, FEW = 1e-2, 12  # tolerance of chi-squared under a pull, and evaluations
ROUND = 1e-4  # relative tolerance of the integrator under a pull
FAIR = 1e-5  # the same of a free fit, where the noise asks for no more
QUIET = 1e-3  # noise over a record's standard deviation beyond which it asks for no more
SAME = 0.01  # relative difference of chi-squared within which two ways led to the same minimum
FOLLOWED = 4.0  # chi-squared per degree of freedom of a model that follows the recording without a pull
HOPELESS = 30.0  # the same of one that does not: its minimum need not be known exactly


@dataclass(frozen=True)
class Followed:
    """Parameters (k,) with their `reduced` chi-squared when the spring is free, and those under the last pull with theirs."""

    problem: Problem
    theta: Array
    reduced: float
    pulled: Array
    held: float

    @property
    def lost(self) -> bool:
        """Return whether the model does not follow the recording at all."""
        return not self.reduced < HOPELESS


class Follower:
    """Fits hypotheses to one experiment under pulls that grow weaker."""

    def __init__(self, registry: Registry, experiment: Experiment, trend: str | None) -> None:
        self.registry, self.experiment, self.trend, self.rtol = registry, experiment, trend, RTOL
        problem = self.problem(Hypothesis(), {})
        self.unit = slip_length(problem.model, experiment)
        self.strong = pull_towards(experiment, problem.runs, self.unit)
        self.evaluations = 0
        still = min(first_level(r) / max(float(np.std(r.observed)), 1e-300) for r in problem.runs)
        self.rtol = FAIR if still > QUIET else RTOL

    def problem(self, hypothesis: Hypothesis, at: Mapping[str, float], length: float | None = None) -> Problem:
        """Return the fit of a hypothesis under a pull over so many slip lengths, or free."""
        pull = weaker(self.strong, self.experiment.runs, length * self.unit) if length is not None else None
        found = hypothesis.problem(
            self.registry, self.experiment, rough=False, at=dict(at), trend=self.trend, pull=pull
        )
        return replace(found, rtol=self.rtol if pull is None else ROUND)

    def follow(
        self, hypothesis: Hypothesis, at: Mapping[str, float], noise: Mapping[str, Noise],
        ways: Sequence[Sequence[float]] = PULLS,
    ) -> Followed:  # fmt: skip
        """Return the best free fit that any of the ways of weakening the pull leads to, from the values in `at`."""
        best: Followed | None = None
        for way in ways:
            best = better(best, self.released(hypothesis, *self.led(hypothesis, at, noise, way), noise))
            if best.reduced < FOLLOWED:
                break
        assert best is not None
        return best

    def led(
        self, hypothesis: Hypothesis, at: Mapping[str, float], noise: Mapping[str, Noise], way: Sequence[float]
    ) -> tuple[Array, float]:
        """Return the parameters that a pull over ever more slip lengths leads to, and chi-squared per degree of freedom."""
        theta, reduced = self.problem(hypothesis, at).start, np.inf
        for length in way:
            theta, reduced = self.descend(self.problem(hypothesis, at, length), theta, noise, COARSE)
        return theta, reduced

    def released(self, hypothesis: Hypothesis, pulled: Array, held: float, noise: Mapping[str, Noise]) -> Followed:
        """Return the free fit from parameters under a pull, and their chi-squared there."""
        free = self.problem(hypothesis, {})
        theta, reduced = self.descend(free, pulled, noise, 1e-4)
        return Followed(free, theta, reduced, pulled, held)

    def descend(
        self, problem: Problem, theta: Array, noise: Mapping[str, Noise], tolerance: float
    ) -> tuple[Array, float]:
        """Return where some steps downhill lead, and chi-squared per degree of freedom there."""
        search = fitting.Search(problem, lambda text: None)
        theta, _ = search.descend(
            np.clip(theta, problem.lower, problem.upper), noise, {}, tolerance=tolerance, most=FEW
        )
        self.evaluations += search.evaluations
        return theta, search.reduced

    def smallest(self, found: Followed) -> dict[str, Array]:
        """Return the residuals (n,) by run, free or under a pull, whichever are smaller: they show the noise."""
        tight = self.problem(Hypothesis(), {}, PULLS[0][0])
        out = {}
        for run in found.problem.runs:
            both = [
                run.observed - problem.predicted(run, theta, slopes=False).y
                for problem, theta in ((found.problem, found.theta), (tight, found.pulled))
            ]
            out[run.name] = min(both, key=lambda r: float(np.nan_to_num(np.mean(r[run.used] ** 2), nan=np.inf)))
        return out

    def around(self, hypothesis: Hypothesis, values: Mapping[str, float], noise: Mapping[str, Noise]) -> LatentFit:
        """Return the fit of a hypothesis under a loose pull, around which everything is nearly linear."""
        problem = self.problem(hypothesis, values, LOOSE)
        return fit_latent(problem, problem.start, noise, tracks=Tracks((), {}), known_noise=True, steps=FEW)


def same(one: float, other: float) -> bool:
    """Return whether two values of chi-squared are those of one minimum."""
    return abs(one - other) < SAME * min(one, other)


def better(known: Followed | None, found: Followed) -> Followed:
    """Return the better of two free fits, with the better of the two under a pull, which may be another."""
    if known is None:
        return found
    best, held = min((known, found), key=lambda f: f.reduced), min((known, found), key=lambda f: f.held)
    return replace(best, pulled=held.pulled, held=held.held)


def shortened(hypothesis: Hypothesis, problem: Problem, noise: Mapping[str, Noise]) -> tuple[Array, float]:
    """Return the problem's start, the last effect's size cut where the whole of it leads astray, and chi-squared there."""
    if not hypothesis.effects or not hypothesis.effects[-1].sizes:
        return problem.start, 0.0
    effect = hypothesis.effects[-1]
    neutral = dict(effect.neutral)
    places = [(problem.names.index(long), neutral[p.name]) for long, p in own_parameters(effect, problem.model).items()
              if p.name in neutral and long in problem.names]  # fmt: skip
    best = (problem.start, np.inf)
    for share in (1.0, 0.3, 0.0):
        theta = problem.start.copy()
        for i, value in places:
            theta[i] = value + share * (theta[i] - value)
        theta = np.clip(theta, problem.lower, problem.upper)
        squares = 0.0
        for run in problem.runs:
            r = (run.observed - problem.predicted(run, theta, slopes=False).y)[run.used] / noise[run.name].level
            squares += float(np.sum(np.where(np.isfinite(r), r, 1e6) ** 2))
        if squares < best[1]:
            best = (theta, squares)
    return best
