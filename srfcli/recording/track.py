"""A rough track to simulate on: mu0 wanders along it by a Gaussian random function of slip position, fixed by a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srfcli.errors import SrfError
from srfcli.recording.synthetic import generator
from srfcli.splines import Spline

Array = NDArray[np.float64]

KNOTS = 8  # to a correlation length: halfway between two of them the variance falls short by 4e-4
WIDEST, FINEST = 0.8, 0.01  # um between knots; a fit's are as wide, and contacts are a tenth of a micron or more
MOST = 2_000_000  # knots between position 0 and the far end of a record
ECHO = 32  # knots over which a spline's numbers feel a value: sqrt(3) - 2 to this power is below the last bit


@dataclass(frozen=True)
class RoughTrack:
    """mu0's deviation at slip position x (um): Gaussian, of standard deviation `size` and correlation length `length` (um).

    Values at a distance d are correlated by (1 + r) exp(-r), r = sqrt(3) d/length (Matern, 3/2), as `srf fit --track rough` has
    it. `seed` fixes the function on the whole line: it does not depend on which part of it is asked for.
    """

    size: float
    length: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.size) and self.size >= 0):
            raise SrfError(f"a roughness of {self.size:g} is not a size", "give it as 0 or more, as 3e-4")
        shortest = KNOTS * FINEST
        if not (math.isfinite(self.length) and self.length >= shortest * (1 - 1e-12)):
            raise SrfError(
                f"a roughness length of {self.length:g} um is finer than knots {FINEST:g} um apart can show",
                f"give {shortest:g} um or more",
            )

    @property
    def spacing(self) -> float:
        """Return the distance between knots in um; one of them lies at position 0."""
        return min(self.length / KNOTS, WIDEST)

    def spline(self, low: float, high: float) -> Spline:
        """Return the function on [low, high] (um) as a cubic spline through its values at the knots.

        Raises SrfError where that takes more knots than there is room for.
        """
        h, most = self.spacing, MOST - 2 * ECHO
        if not max(abs(low), abs(high)) < most * h:
            raise SrfError(
                f"a track to position {max(abs(low), abs(high)):g} um, in steps of {h:g} um, has more than {most} knots",
                "shorten the record, or give a longer roughness length",
            )
        first, last = math.floor(low / h), math.ceil(high / h)
        last = max(last, first + 1)
        values = self._values(first - 1 - ECHO, last + 1 + ECHO)
        count = last - first + 3
        # the numbers whose weighted means 1/6, 4/6, 1/6 are the values; summed so that no bit depends on the window
        pole, numbers = math.sqrt(3) - 2, np.zeros(count)
        for j in range(-ECHO, ECHO + 1):
            numbers += math.sqrt(3) * pole ** abs(j) * values[ECHO + j : ECHO + j + count]
        return Spline(first * h, h, self.size * numbers)

    def _values(self, first: int, last: int) -> Array:
        """Return the function of unit size at the knots first, ..., last, where first <= last."""
        root, onwards, backwards = generator(self.seed, "rough track").spawn(3)
        value, slope = root.standard_normal(2)
        right = self._walk(value, value + slope, max(last, 0), onwards)
        left = self._walk(value, value - slope, max(-first, 0), backwards)
        line = np.concatenate([left[::-1], [value], right])
        return np.asarray(line[first + left.size : last + left.size + 1])

    def _walk(self, value: float, state: float, count: int, rng: np.random.Generator) -> Array:
        """Return the next `count` values beside `value`, exactly distributed; `state` is value + length/sqrt(3) slope.

        That sum is a Markov process by itself, of first order, and drives the value as another: two recursions.
        """
        from scipy.signal import lfilter
        from scipy.special import gammainc

        if not count:
            return np.zeros(0)
        a = math.sqrt(3) * self.spacing / self.length
        carry = math.exp(-a)
        # covariance of what a step adds to state and value; incomplete gamma functions, as 1 - exp(-2a)(1 + ...) cancels
        one, two, three = (float(gammainc(k, 2 * a)) for k in (1, 2, 3))
        spread = math.sqrt(2 * one)
        shared, own = two / spread, math.sqrt(three - two * two / (2 * one))
        draws = rng.standard_normal((count, 2))
        states = lfilter([1.0], [1.0, -carry], spread * draws[:, 0], zi=[carry * state])[0]
        pushed = carry * a * np.concatenate([[state], states[:-1]]) + shared * draws[:, 0] + own * draws[:, 1]
        return np.asarray(lfilter([1.0], [1.0, -carry], pushed, zi=[carry * value])[0])
