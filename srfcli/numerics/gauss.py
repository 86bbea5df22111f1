"""The Gauss-Legendre scheme of collocation, and the bound on a Newton step: what NumPy and compiled code must share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
STAGES = 4
LOG_STEP = 3.0  # a Newton step changes no velocity or age by more than a factor e^3


@dataclass(frozen=True)
class Scheme:
    """Gauss points `nodes` in [0, 1], the inverse of the collocation matrix, and x_1 = x_0 + step . (X - x_0)."""

    nodes: Array
    inverse: Array
    step: Array
    weights: Array


@lru_cache
def gauss(m: int = STAGES) -> Scheme:
    """Return the Gauss-Legendre scheme of `m` stages (order 2m at the mesh points)."""
    points, weights = np.polynomial.legendre.leggauss(m)
    nodes = (points + 1) / 2
    powers = np.arange(1, m + 1)
    vandermonde = nodes[:, None] ** (powers - 1)
    integral = (nodes[:, None] ** powers / powers) @ np.linalg.inv(vandermonde)
    inverse = np.linalg.inv(integral)
    return Scheme(nodes, inverse, (weights / 2) @ inverse, weights / 2)
