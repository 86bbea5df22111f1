"""A hypothesis, fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.diagnosis.adequacy import Adequacy, judge_residuals
from srfcli.diagnosis.candidates import Hypothesis
from srfcli.inference.latent import LatentFit
from srfcli.inference.noise import Noise
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Run

DEARER = 0.004  # of chi-squared per degree of freedom while held, what a further effect has to take away
HALFWAY = 1.25  # residual over noise within which a rough track may be what is left
ASTRAY = 3.0  # times the chi-squared of where it came from: a start from which a fit had better be led
PAIRS, ROUGHENED = 3, 2  # how many are fitted with a second effect, at each stage, and on rough tracks
NEAR = 2.5  # residual over noise within which slopes at the fit tell where a better one is


@dataclass(frozen=True)
class Refit:
    """A hypothesis, fitted: its evidence is the log likelihood, tracks integrated out, less what its parameters cost."""

    hypothesis: Hypothesis
    fit: LatentFit
    adequacy: Adequacy
    evidence: float
    rough: bool

    @property
    def name(self) -> str:
        """Return the hypothesis' name."""
        return self.hypothesis.name

    @property
    def halfway(self) -> bool:
        """Return whether it leaves more than noise, and no more than a rough track may be."""
        return not self.adequacy.fine and self.adequacy.rms_over_noise < HALFWAY


@dataclass(frozen=True)
class Entry:
    """A hypothesis while held: parameters (k,), also by name, chi-squared per degree of freedom."""

    hypothesis: Hypothesis
    theta: Array
    values: dict[str, float]
    reduced: float

    @property
    def single(self) -> bool:
        """Return whether it adds one effect."""
        return len(self.hypothesis.effects) == 1

    @property
    def rank(self) -> float:
        """Return what it leaves, and what its effects cost."""
        return self.reduced + DEARER * len(self.hypothesis.effects)


def residuals_of(fitted: LatentFit) -> dict[str, Array]:
    """Return what a fit leaves (n,) of each run."""
    return {r.name: r.observed - fitted.point.predictions[r.name].y for r in fitted.problem.runs}


def judge_fit(fitted: LatentFit, noise: Mapping[str, Noise], runs: Sequence[Run] | None = None) -> Adequacy:
    """Return whether noise is all that a fit leaves, of all its runs or of some."""
    every = fitted.problem.runs if runs is None else runs
    return judge_residuals(every, residuals_of(fitted), noise, freedom=freedom_spent(fitted))


def freedom_spent(fitted: LatentFit) -> dict[str, float]:
    """Return how many parameters' worth of freedom each run's residual has lost, to the track above all."""
    point, n = fitted.point, fitted.point.theta.size
    out = {r.name: n / max(len(fitted.problem.runs), 1) for r in fitted.problem.runs}
    if not point.tracks.splines or not point.roughness.amplitude:
        return out
    L = point.tracks.root(point.roughness)
    M = L.T @ point.N[n:, n:] @ L
    share = np.diag(np.linalg.solve(M + np.eye(M.shape[0]), M))
    at = 0
    weights = []
    for spline in point.tracks.splines:
        weights.append(float(share[at : at + spline.numbers.size].sum()))
        at += spline.numbers.size
    users: dict[int, list[str]] = {}
    for name, i in point.tracks.of.items():
        users.setdefault(i, []).append(name)
    for i, names in users.items():
        for name in names:
            out[name] += weights[i] / len(names)
    return out
