"""Tables of coefficients that follow a model's parameters: cubic splines with evenly spaced knots, as generated code calls them.

Behind the parameters in `p` stand, for each table, the place of its coefficients in `p`, its first knot, the spacing and how many
coefficients it has, then the coefficients. A table of n covers n - 3 intervals; beyond them it is constant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Spline:
    """A function of one unknown: `first` knot, `spacing`, and its coefficients (n,), n - 3 of which are intervals."""

    first: float
    spacing: float
    coefficients: Array

    @classmethod
    def over(cls, low: float, high: float, spacing: float) -> Spline:
        """Return a function that vanishes, with knots no further apart than `spacing` from `low` to `high`."""
        intervals = max(int(np.ceil((high - low) / spacing)), 1)
        return cls(low, (high - low) / intervals, np.zeros(intervals + 3))

    @property
    def last(self) -> float:
        """Return where the last interval ends."""
        return self.first + self.spacing * (self.coefficients.size - 3)

    @property
    def nodes(self) -> Array:
        """Return the centre of each coefficient's basis function (n,)."""
        return np.asarray(self.first + self.spacing * (np.arange(self.coefficients.size) - 1.0))

    def with_coefficients(self, coefficients: Array) -> Spline:
        """Return the same knots with other coefficients."""
        return Spline(self.first, self.spacing, np.asarray(coefficients, dtype=float))


def appended(p: Array, tables: Sequence[Spline]) -> Array:
    """Return p (n_parameters,) followed by the tables."""
    place, heads, found = p.size + 4 * len(tables), [], []
    for table in tables:
        heads.append([place, table.first, table.spacing, table.coefficients.size])
        found.append(table.coefficients)
        place += table.coefficients.size
    return np.concatenate([p, np.ravel(heads), *found]) if tables else p


def tables_after(n: int) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """Return lut, lut1 and lut2 of a model with n parameters: functions of (p, table, x), value, slope and second derivative."""
    return tuple(partial(_evaluated, n, order) for order in range(3))  # type: ignore[return-value]


def _evaluated(n: int, order: int, p: Any, i: int, x: Any) -> Any:
    """Return a derivative of table i at x, a number or an array, real or complex; 0 without coefficients."""
    if len(p) <= n or p[n + 4 * i + 3] < 4:
        return 0.0 * x
    place, first, spacing, count = (float(np.real(value)) for value in p[n + 4 * i : n + 4 * i + 4])
    real = np.real(x)
    r = np.clip((real - first) / spacing, 0.0, count - 3.0)
    known = np.where(np.isnan(r), 0.0, r)  # a motion that was lost: its value is NaN, its cell is any
    cell = np.minimum(known.astype(int) if np.ndim(r) else int(known), int(count) - 4)
    share = (x - first) / spacing - cell
    low, high = (real <= first), (real >= first + spacing * (count - 3))
    share = np.where(low, 0.0, np.where(high, 1.0, share))
    total: Any = 0.0
    numbers, at = (np.asarray(p) if np.ndim(x) else p), int(place) + cell  # a list at one x: a long one is never copied
    for k, w in enumerate(_WEIGHTS[order](share)):
        total = total + w * numbers[at + k]
    total = total / spacing**order
    if order:
        total = np.where(low | high, 0.0, total)
    return total if np.ndim(x) else total[()]


def _value(f: Any) -> tuple[Any, ...]:
    g = 1 - f
    b0, b1, b3 = g * g * g / 6, (4 - 6 * f * f + 3 * f * f * f) / 6, f * f * f / 6
    return b0, b1, 1 - b0 - b1 - b3, b3


def _slope(f: Any) -> tuple[Any, ...]:
    d0, d1, d3 = -0.5 * (1 - f) ** 2, -2 * f + 1.5 * f * f, 0.5 * f * f
    return d0, d1, -d0 - d1 - d3, d3


_WEIGHTS = (_value, _slope, lambda f: (1 - f, 3 * f - 2, 1 - 3 * f, f))
