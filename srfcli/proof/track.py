"""Rough tracks: a friction coefficient that wanders with position, the same for all runs of a case."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

SPACING = 0.1  # correlation lengths between knots


@dataclass(frozen=True)
class Track:
    """The deviation of mu0 along a track: a Gaussian process of standard deviation `size` and correlation length `length` (um).

    `seed` fixes it; its correlation is (1 + r) exp(-r), r = distance/length, that of a rough but differentiable profile.
    """

    size: float = 0.0
    length: float = 10.0
    seed: int = 0

    def profile(self, longest: float) -> Callable[[float], float]:
        """Return mu0's deviation as a function of position (um) from 0 to `longest`; beyond it stays at its last value."""
        if not self.size:
            return lambda x: 0.0
        step = SPACING * self.length
        heights, slopes = self._knots(int(np.ceil(longest / step)) + 2)
        last = len(heights) - 2

        def deviation(x: float) -> float:
            at = x / step
            i = min(max(int(at), 0), last)
            r = min(max(at - i, 0.0), 1.0)
            s = 1.0 - r
            return s * s * ((1 + 2 * r) * heights[i] + r * slopes[i]) + r * r * (
                (3 - 2 * r) * heights[i + 1] - s * slopes[i + 1]
            )

        return deviation

    def _knots(self, count: int) -> tuple[list[float], list[float]]:
        """Return heights and slopes (per step) at the knots, drawn from the process's exact transition (Matern, 3/2).

        Each knot takes the next two numbers of the stream, so that a longer profile begins with the shorter one.
        """
        draws = np.random.default_rng(self.seed).standard_normal((count, 2))
        h = SPACING
        carry = np.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])  # of height and slope, by correlation lengths
        spread = np.linalg.cholesky(np.eye(2) - carry @ carry.T)
        state = draws[0]
        path = [state]
        for pair in draws[1:]:
            state = carry @ state + spread @ pair
            path.append(state)
        values = self.size * np.array(path)
        return values[:, 0].tolist(), (values[:, 1] * h).tolist()


SMOOTH = Track()
