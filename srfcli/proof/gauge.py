"""What a gauge makes of the true elongation: play, coloured noise, quanta."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from srfcli.proof.draw import Gauge

Array = np.ndarray


def read_gauge(u: Array, gauge: Gauge, rng: np.random.Generator, *, backlash: float = 0.0) -> Array:
    """Return the readings (n,) in um of the elongations u (n,): those of a first-order autoregressive noise, then rounded."""
    shown = play(u, backlash) if backlash else u
    draws = rng.standard_normal(u.size)
    draws[1:] *= np.sqrt(1 - gauge.lag1**2)  # the first is as wide as all that follow
    noise = gauge.sigma * lfilter([1.0], [1.0, -gauge.lag1], draws)
    return np.asarray(np.round((shown + noise) / gauge.quantum) * gauge.quantum)


def play(u: Array, half: float) -> Array:
    """Return what a pointer with play shows: it stays until u is more than `half` um away, and then is dragged along."""
    shown, at = np.empty_like(u), float(u[0])
    for k, value in enumerate(u.tolist()):
        at = min(max(at, value - half), value + half)
        shown[k] = at
    return shown
