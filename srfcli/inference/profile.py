"""Intervals by the profile likelihood: where one parameter, the others refitted, makes a fit worse by a given deviance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

CHI2_95 = 3.841458820694124  # of chi-squared with one degree of freedom, 95 %
OPEN_INTERVAL = 8.0  # half-widths that the standard error wants: an interval that has not ended there is open
REFITS = 12  # of one end at most; the secant needs three or four
PROFILE_TOLERANCE = 0.01  # in the root of the deviance, which is 1.96 at the end: half a per cent of the interval
LIKELIER = 0.05  # in log likelihood, above the fit: a refit is a likelier maximum then, and no rest of convergence
# times 1.96 standard errors: an interval cut there misses the value on that side in 10 of 100 cases, not in 2.5
MAX_INTERVAL_RATIO = 1.5


@dataclass(frozen=True)
class Interval:
    """A 95 % interval of one parameter, in um, s, N; None where the likelihood does not end it before a bound.

    `likelier` are the parameters of the likeliest refit where that is likelier than the fit, by `gain` in log likelihood.
    """

    name: str
    low: float | None
    high: float | None
    evaluations: int
    gain: float = 0.0
    likelier: Mapping[str, float] | None = None


class Refits:
    """The refits of one parameter's profile: the likeliest of those that are likelier than the fit."""

    def __init__(self) -> None:
        self.gain, self.likelier = 0.0, None  # type: float, Mapping[str, float] | None

    def record(self, deviance: float, values: Mapping[str, float]) -> float:
        """Return a refit's deviance, when it was looked at."""
        if -0.5 * deviance > max(self.gain, LIKELIER):
            self.gain, self.likelier = -0.5 * deviance, values
        return deviance


def quadratic(deviances: Sequence[float]) -> bool:
    """Return whether deviances at 1.96 standard errors either side are what these say, within MAX_INTERVAL_RATIO squared."""
    return CHI2_95 / MAX_INTERVAL_RATIO**2 < min(deviances) <= max(deviances) < CHI2_95 * MAX_INTERVAL_RATIO**2


def interval_end(deviance: Callable[[float], float], error: float, room: float) -> float | None:
    """Return how far from its estimate a parameter's deviance reaches CHI2_95; None where it does not within `room`.

    `deviance` is twice the loss in log likelihood at a distance, the others refitted; `error` is the standard error, with which
    the search begins. The root of the deviance is nearly linear in the distance: secant, within the bracket.
    """
    wanted = float(np.sqrt(CHI2_95))
    if not (np.isfinite(error) and error > 0):
        return None
    farthest = min(room, OPEN_INTERVAL * wanted * error)
    inside, outside, here, step = 0.0, np.inf, (0.0, -wanted), min(wanted * error, farthest)
    for _ in range(REFITS):
        cost, before = deviance(step), here
        here = (step, float(np.sign(cost) * np.sqrt(abs(cost))) - wanted)
        if abs(here[1]) < PROFILE_TOLERANCE:
            break
        if here[1] > 0:
            outside = step
        elif step < farthest:
            inside = step
        else:
            return None
        steepness = (here[1] - before[1]) / (here[0] - before[0])
        step = here[0] - here[1] / steepness if steepness > 0 else np.inf
        if np.isinf(outside):
            step = min(step, 2 * inside, farthest)
        elif not inside < step < outside:
            step = 0.5 * (inside + outside)
    return step
