"""The runs of the worked examples, two short ones, and their noise, for tests of the generator."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from srfcli.validation.slider import Plan

NOISE = float(np.hypot(0.02, 0.005 / np.sqrt(12)))  # um, of a gauge and its quanta
SHORT = (
    Plan("wave", ((0.5, 20.0),), 7.0, 0.001, eps=0.2, f=110.0, onset=0.25),
    Plan("steps", ((0.8, 20.0), (0.8, 40.0), (1.0, 5.0)), 5.0, 0.004, steps=((1.2, 1.5),)),
)


def rms(x: ArrayLike) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


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
