"""Fits on a rough track by horizons that grow: cycles of stick-slip are brought into step one after another.

A track moves the phase of every cycle that follows, so that a fit of whole recordings from parameters a few per cent off ends
in a false minimum. Over a tenth of them it does not, and what that tells of parameters and track brings the next into reach.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srfcli.inference.fit import Problem
from srfcli.inference.latent import Latent, LatentFit, Point, attained, fit_latent
from srfcli.inference.noise import Noise
from srfcli.inference.tracks import USUAL, Roughness, Tracks
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Run

SHARES = (0.1, 0.2, 0.3, 0.4, 0.55, 0.7, 0.85)  # of the recordings, before all of them
TIED = 0.05  # relative standard deviation of parameters about their start: a short horizon determines few of them
STEPS, SETTLED = 10, 2.0  # at each horizon, and the gain in twice the log posterior that ends them
FOLLOWED = 2.25  # chi-squared per sample beyond which a horizon is not followed, and longer ones are in vain
SHORTEST = 20  # samples of a recording


@dataclass(frozen=True)
class Grown:
    """The fit over the longest horizon that was followed, `share` of the recordings; `left` over noise there, rms.

    `rank` orders fits: minus twice the log posterior per sample, plus a hundred times the share that was not followed.
    """

    fit: LatentFit
    share: float
    left: float
    rank: float
    evaluations: int


class Tied(Latent):
    """The posterior in which some parameters are known beforehand: they lie within TIED of where they start."""

    def __init__(self, problem: Problem, centre: Array, tied: Sequence[str]) -> None:
        super().__init__(problem)
        self.centre = centre
        self.precision = np.array([TIED**-2 if n in tied else 0.0 for n in problem.names]) / self.scale**2

    def at(self, theta: Array, tracks: Tracks, noise: Mapping[str, Noise], roughness: Roughness) -> Point:
        """Return everything at these parameters and tracks, the prior of the parameters included."""
        point, n, off = super().at(theta, tracks, noise, roughness), theta.size, theta - self.centre
        N, g = point.N.copy(), point.g.copy()
        N[range(n), range(n)] += self.precision * self.scale**2
        g[:n] -= self.precision * self.scale * off
        return replace(point, N=N, g=g, chi2=point.chi2 + float(self.precision @ off**2))


def grow(
    problem: Problem, tracks: Tracks, noise: Mapping[str, Noise], *, tied: Sequence[str], followed: float = FOLLOWED
) -> Grown:
    """Return the fit from the problem's start by horizons that grow, those named in `tied` held near where they start.

    They grow while less than `followed` is left, chi-squared per sample. The roughness is USUAL: it is estimated when all is
    followed, by `whole`.
    """
    theta, evaluations, rank = problem.start, 0, np.inf
    cut, reached = problem, 0.0
    for share in SHARES:
        shorter = replace(problem, runs=tuple(_until(run, share) for run in problem.runs))
        latent = Tied(shorter, problem.start, tied)
        trial = latent.minimise(latent.at(theta, tracks, noise, USUAL), noise, steps=STEPS, settled=SETTLED)
        evaluations += max(round(share * latent.evaluations), 1)
        beyond = trial.chi2 > followed * latent.samples
        if not beyond or not reached:  # the first horizon is the least that there is
            cut, theta, tracks, reached = shorter, trial.theta, trial.tracks, share
            rank = trial.penalised / latent.samples + 100 * (1 - share)
        if beyond:
            break
    plain = Latent(cut)
    place = plain.at(theta, tracks, noise, USUAL)
    left = float(np.sqrt(place.chi2 / plain.samples))
    return Grown(LatentFit(cut, place, dict(noise), attained(place), evaluations), reached, left, rank, evaluations)


def whole(problem: Problem, grown: Grown, noise: Mapping[str, Noise]) -> LatentFit:
    """Return the fit of all of the recordings from one that was grown, roughness estimated and nothing tied."""
    point = grown.fit.point
    return fit_latent(problem, point.theta, noise, tracks=point.tracks, roughness=USUAL, known_noise=True)


def _until(run: Run, share: float) -> Run:
    k = min(max(round(share * run.t.size), SHORTEST), run.t.size)
    return replace(run, t=run.t[:k], observed=run.observed[:k], used=run.used[:k])
