"""Hypotheses fitted while the slider is held to the recording first, then free: where they start from hardly matters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srfcli.diagnosis.adequacy import quietest
from srfcli.diagnosis.candidates import Hypothesis, neutral_values, own_parameters
from srfcli.inference import fit as fitting
from srfcli.inference.fit import Problem, first_level
from srfcli.inference.follow import between_slips, hold_to, slip_length, weaker
from srfcli.inference.latent import LatentFit, fit_latent
from srfcli.inference.noise import Noise
from srfcli.inference.prediction import RTOL, Hold
from srfcli.inference.tracks import Tracks
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Experiment
from srfcli.registry import Registry

LOOSE = 2.0  # slip lengths over which a second spring holds that leaves most of a misfit to be seen
PULLS = (
    (LOOSE,),
    (1.0, LOOSE),
    (0.5, 1.0, LOOSE),
)  # the same, and ever softer ones; the next way is tried where one leads nowhere
CLEAR = 1.05  # chi-squared per degree of freedom under a hold that is noise
NEARLY = 1.6  # the same of a model that may be right: what is lost when it is set free is worth finding
LOOSE_ONLY = (LOOSE,)  # the one that a refit starts under
COARSE, FEW = 1e-2, 12  # tolerance of chi-squared while held, and evaluations
ROUND = 1e-4  # relative tolerance of the integrator while held
FAIR = 1e-5  # the same of a free fit, where the noise asks for no more
QUIET = 1e-3  # noise over a record's standard deviation beyond which it asks for no more
SAME = 0.01  # relative difference of chi-squared within which two ways led to the same minimum
FOLLOWED = 4.0  # chi-squared per degree of freedom of a model that follows the recording when free
HOPELESS = 30.0  # the same of one that does not: its minimum need not be known exactly


@dataclass(frozen=True)
class Followed:
    """Parameters (k,) with their `reduced` chi-squared when the spring is free, and those under the last hold with theirs."""

    problem: Problem
    theta: Array
    reduced: float
    place: Array
    held: float

    @property
    def lost(self) -> bool:
        """Return whether the model does not follow the recording at all."""
        return not self.reduced < HOPELESS


class Follower:
    """Fits hypotheses to one experiment under a hold that grows softer."""

    def __init__(self, registry: Registry, experiment: Experiment, trend: str | None) -> None:
        self.registry, self.experiment, self.trend, self.rtol = registry, experiment, trend, RTOL
        problem = self.problem(Hypothesis(), {})
        self.unit = slip_length(problem.model, experiment)
        self.strong = hold_to(experiment, problem.runs, self.unit)
        self.evaluations = 0
        self.between = tuple(between_slips(run) for run in problem.runs)
        still = min(first_level(r) / max(float(np.std(r.observed)), 1e-300) for r in problem.runs)
        self.rtol = FAIR if still > QUIET else RTOL

    def problem(self, hypothesis: Hypothesis, at: Mapping[str, float], length: float | None = None) -> Problem:
        """Return the fit of a hypothesis held over so many slip lengths, or free."""
        held = self.hold(length) if length is not None else None
        found = hypothesis.problem(
            self.registry, self.experiment, rough=False, at=dict(at), trend=self.trend, hold=held
        )
        return replace(found, rtol=self.rtol) if held is None else replace(found, rtol=ROUND, runs=self.between)

    def hold(self, length: float) -> Hold:
        """Return the second spring over so many slip lengths."""
        return weaker(self.strong, self.experiment.runs, length * self.unit)

    def follow(
        self, hypothesis: Hypothesis, at: Mapping[str, float], noise: Mapping[str, Noise],
        ways: Sequence[Sequence[float]] = PULLS,
    ) -> Followed:  # fmt: skip
        """Return the free fit from where the best of the ways of softening the hold leads, from the values in `at`."""
        theta, reduced = self.led(hypothesis, at, noise, ways[0])
        for way in ways[1:]:
            if reduced < CLEAR:
                break
            found = self.led(hypothesis, at, noise, way)
            agreed = same(found[1], reduced)
            theta, reduced = min((theta, reduced), found, key=lambda f: f[1])
            if agreed:
                break
        return self.released(hypothesis, theta, reduced, noise)

    def led(
        self, hypothesis: Hypothesis, at: Mapping[str, float], noise: Mapping[str, Noise], way: Sequence[float]
    ) -> tuple[Array, float]:
        """Return the parameters that a hold over ever more slip lengths leads to, and chi-squared per degree of freedom."""
        theta, reduced = self.problem(hypothesis, at).start, np.inf
        for length in way:
            theta, reduced = self.descend(self.problem(hypothesis, at, length), theta, noise, COARSE)
        return theta, reduced

    def released(self, hypothesis: Hypothesis, place: Array, held: float, noise: Mapping[str, Noise]) -> Followed:
        """Return the free fit from parameters while held, and their chi-squared there."""
        free = self.problem(hypothesis, {})
        theta, reduced = self.descend(free, place, noise, 1e-4)
        if not reduced < FOLLOWED and held < NEARLY:
            theta, reduced = min((theta, reduced), self.grow(free, place, noise), key=lambda f: f[1])
        return Followed(free, theta, reduced, place, held)

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

    def grow(self, problem: Problem, theta: Array, noise: Mapping[str, Noise]) -> tuple[Array, float]:
        """Return where horizons that grow lead, and chi-squared per degree of freedom there."""
        search = fitting.Search(problem, lambda text: None)
        theta, _ = search.grow(np.clip(theta, problem.lower, problem.upper), noise)
        self.evaluations += search.evaluations
        return theta, search.reduced

    def smallest(self, found: Followed) -> dict[str, Array]:
        """Return what a free fit leaves (n,) by run, or the recording itself, whichever has less noise about a slow trend."""
        out = {}
        for run in found.problem.runs:
            residual = run.observed - found.problem.predicted(run, found.theta, slopes=False).y
            out[run.name] = min(residual, run.observed, key=lambda r: quietest(run, r))
        return out

    def around(self, hypothesis: Hypothesis, values: Mapping[str, float], noise: Mapping[str, Noise]) -> LatentFit:
        """Return the fit of a hypothesis under a loose hold, around which everything is nearly linear."""
        problem = self.problem(hypothesis, values, LOOSE)
        return fit_latent(problem, problem.start, noise, tracks=Tracks((), {}), known_noise=True, steps=FEW)


def same(one: float, other: float) -> bool:
    """Return whether two values of chi-squared are those of one minimum."""
    return abs(one - other) < SAME * min(one, other)


def shortened(hypothesis: Hypothesis, problem: Problem, noise: Mapping[str, Noise]) -> tuple[Array, float]:
    """Return the problem's start, the last effect's size cut where the whole of it leads astray, and chi-squared there."""
    if not hypothesis.effects or not hypothesis.effects[-1].sizes:
        return problem.start, 0.0
    effect = hypothesis.effects[-1]
    neutral = neutral_values(effect)
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
            squares += float(np.sum(np.clip(np.nan_to_num(r, nan=1e6), -1e6, 1e6) ** 2))
        if squares < best[1]:
            best = (theta, squares)
    return best
