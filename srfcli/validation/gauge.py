"""What a gauge makes of what it reads: play, noise of a colour, spikes, quanta; and how far a signal stands out of that noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_banded

SIGMA, QUANTUM, MAX_LAG1 = 0.02, 0.005, 0.85
SPIKE = (0.3, 1.0)  # of the reading: electrical glitches, which nobody takes for readings
Array = np.ndarray


@dataclass(frozen=True)
class Gauge:
    """The noise of a gauge: standard deviation and quantum in the unit that is recorded, correlation of neighbouring samples.

    `pink` is the share of the variance that has a spectrum 1/f, `spikes` how many samples of a run are struck.
    """

    sigma: float = SIGMA
    lag1: float = 0.0
    quantum: float = QUANTUM
    pink: float = 0.0
    spikes: int = 0

    def louder(self, factor: float) -> Gauge:
        """Return the gauge with so many times the noise."""
        return replace(self, sigma=self.sigma * factor)


def read_gauge(u: Array, gauge: Gauge, rng: np.random.Generator) -> Array:
    """Return the readings (n,) of u (n,): with noise that is autoregressive or in part 1/f, with spikes, rounded."""
    draws = rng.standard_normal(u.size)
    draws[1:] *= np.sqrt(1 - gauge.lag1**2)  # the first is as wide as all that follow
    bands = np.array([np.ones(u.size), np.full(u.size, -gauge.lag1)])
    noise = gauge.sigma * solve_banded((1, 0), bands, draws)  # each sample is its own draw and lag1 times the one before
    if gauge.pink:
        gains = _pink_gains(u.size)
        slow = np.fft.irfft(gains * np.fft.rfft(rng.standard_normal(2 * (gains.size - 1))))[: u.size]
        noise = np.sqrt(1 - gauge.pink) * noise + gauge.sigma * np.sqrt(gauge.pink) * slow
    if gauge.spikes:
        struck = rng.choice(np.arange(1, u.size - 1), gauge.spikes, replace=False)
        noise[struck] += u[struck] * rng.uniform(*SPIKE, gauge.spikes) * rng.choice((-1, 1), gauge.spikes)
    return np.asarray(np.round((u + noise) / gauge.quantum) * gauge.quantum)


def play(u: Array, half: float) -> Array:
    """Return what a pointer with play shows: it stays until u is more than `half` um away, and then is dragged along."""
    shown, at = np.empty_like(u), float(u[0])
    for k, value in enumerate(u.tolist()):
        at = min(max(at, value - half), value + half)
        shown[k] = at
    return shown


def _pink_gains(n: int) -> Array:
    """Return the gain at each frequency that makes white noise of a period longer than n samples 1/f noise of variance 1."""
    half = 2 ** int(np.ceil(np.log2(2 * n)))
    gains = np.zeros(half + 1)
    gains[1:] = np.arange(1, half + 1) ** -0.5
    power = 2 * np.sum(gains[1:-1] ** 2) + gains[-1] ** 2
    return gains * np.sqrt(2 * half / power)


def autocovariance(gauge: Gauge, n: int) -> Array:
    """Return the covariance (n,) of two samples by their distance, quanta included as white noise, spikes left out."""
    found = (1 - gauge.pink) * gauge.lag1 ** np.arange(n)
    if gauge.pink:
        found = found + gauge.pink * np.fft.irfft(_pink_gains(n) ** 2)[:n]
    found *= gauge.sigma**2
    found[0] += gauge.quantum**2 / 12
    return np.asarray(found)


def white(x: Array, gauge: Gauge) -> Array:
    """Return a signal (n,) or signals (n, k) in units of white noise of size 1, the gauge's correlation taken out."""
    level = float(np.hypot(gauge.sigma, gauge.quantum / np.sqrt(12)))
    if gauge.pink:
        return _innovations(x, autocovariance(gauge, len(x)))
    out = x / level
    out[1:] = (x[1:] - gauge.lag1 * x[:-1]) / (level * np.sqrt(1 - gauge.lag1**2))
    return np.asarray(out)


def _innovations(x: Array, covariance: Array) -> Array:
    """Return what the best linear prediction of each sample from those before leaves, over its size (Levinson, Durbin)."""
    out = np.empty_like(x, dtype=float)
    weights, spread = np.empty(0), float(covariance[0])  # of the samples before, the latest first
    out[0] = x[0] / np.sqrt(spread)
    for k in range(1, len(x)):
        reflection = float(covariance[k] - weights @ covariance[k - 1 : 0 : -1]) / spread
        weights = np.append(weights - reflection * weights[::-1], reflection)
        spread *= 1 - reflection**2
        out[k] = (x[k] - weights @ x[k - 1 :: -1]) / np.sqrt(spread)
    return out
