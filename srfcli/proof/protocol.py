"""What is done to the slider: seven runs, two of them held out, with drives and loads drawn around those of the examples."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

MODULATION_RISE = 0.02  # s, of the tanh that switches a modulation on
STEP_RISE = 0.03  # s, of the tanh of a load step


@dataclass(frozen=True)
class Plan:
    """One run: drive as (s, um/s), mean load W0 (N), sampling interval (s), modulation from `onset` (s), load steps as (s, N)."""

    name: str
    drive: tuple[tuple[float, float], ...]
    W0: float
    interval: float
    holdout: bool = False
    eps: float = 0.0
    f: float = 0.0
    onset: float = 0.0
    steps: tuple[tuple[float, float], ...] = field(default=())

    @property
    def duration(self) -> float:
        return sum(d for d, _ in self.drive)

    @property
    def distance(self) -> float:
        """Return the nominal displacement of the stage in um."""
        return sum(d * v for d, v in self.drive)

    def times(self) -> np.ndarray:
        """Return the sample times in s, without the very end of the drive."""
        return np.arange(round(self.duration / self.interval)) * self.interval

    def load(self) -> Callable[[float], tuple[float, float]]:
        """Return the imposed load and its rate, N and N/s, as a function of time."""
        W0, jumps = self.W0, self.steps
        share, omega, height = self.switched(), 2 * math.pi * self.f, self.eps * self.W0

        def load(t: float) -> tuple[float, float]:
            W, rate = W0, 0.0
            if height:
                s, s_dot = share(t)
                c = math.cos(omega * t)
                W += height * s * c
                rate += height * (s_dot * c - s * omega * math.sin(omega * t))
            for at, jump in jumps:
                h = math.tanh((t - at) / STEP_RISE)
                W += 0.5 * jump * (1 + h)
                rate += 0.5 * jump * (1 - h * h) / STEP_RISE
            return W, rate

        return load

    def switched(self) -> Callable[[float], tuple[float, float]]:
        """Return how much of the modulation is on, 0 to 1, and the rate of that."""
        onset = self.onset

        def share(t: float) -> tuple[float, float]:
            h = math.tanh((t - onset) / MODULATION_RISE)
            return 0.5 * (1 + h), 0.5 * (1 - h * h) / MODULATION_RISE

        return share


def example_protocol() -> tuple[Plan, ...]:
    """Return the seven runs of the worked examples."""
    return (
        Plan("steps", ((2, 5), (1.5, 20), (2, 5), (1, 50), (2, 10)), 5.0, 0.004),
        Plan("stickslip", ((0.5, 12), (5, 8)), 9.0, 0.004),
        Plan("onset", ((0.5, 12), (4, 8)), 9.0, 0.001, eps=0.09, f=120, onset=2),
        Plan("strong", ((2.5, 20),), 7.0, 0.001, eps=0.2, f=120, onset=0.6),
        Plan("loadstep", ((6, 10),), 5.0, 0.002, steps=((2, 1.5), (4, -1.5))),
        Plan("holdout-mod", ((3, 15),), 8.0, 0.001, holdout=True, eps=0.13, f=80, onset=0.8),
        Plan("holdout-shs", ((2, 10), (4, 0.1), (3, 10)), 5.0, 0.004, holdout=True),
    )
