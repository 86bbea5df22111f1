"""Normal loads composed of pieces: steps, holds and ramps with rounded corners, and a modulation on top of any load."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from srfcli.errors import SrfError
from srfcli.numerics.collocation import Array
from srfcli.numerics.load import Load, LoadPiece, Modulation

DEGREE = 6  # of a rounded ramp: the integral of the fifth-degree step
NEAR = 1e-4  # corners closer than this share of the rise are one: W is then off by 1e-11 of the step


@dataclass(frozen=True)
class LoadSteps(Load):
    """Straight pieces of load, joined smoothly: piece i runs from `first[i]` to `last[i]` (N) over edges[i] to edges[i + 1] (s).

    Jumps and corners are rounded over the `rise` seconds after each edge by the same quintic step, so that W has two
    continuous derivatives and never leaves the range of the pieces: an elastic interface cannot follow a jump of the load.
    Before the first edge and after the last the load is constant. A ramp is thereby late by half the rise.
    """

    edges: tuple[float, ...]
    first: tuple[float, ...]
    last: tuple[float, ...]
    rise: float

    def __post_init__(self) -> None:
        if not len(self.edges) - 1 == len(self.first) == len(self.last) >= 1:
            raise SrfError("a load of pieces needs a first and a last value for each, and one edge more")
        if not all(map(math.isfinite, self.edges)) or any(b <= a for a, b in pairwise(self.edges)):
            raise SrfError("the edges of a load of pieces must rise", "give each piece a duration above 0")
        if not all(math.isfinite(W) and W > 0 for W in (*self.first, *self.last)):
            low = min((*self.first, *self.last))
            raise SrfError(f"a load of {low:g} N lifts the slider off", "give loads above 0")
        if not (math.isfinite(self.rise) and self.rise > 0):
            raise SrfError(
                f"a rise of {self.rise:g} s is not a positive time", "20 ms is long beside the slider's bounce"
            )

    @classmethod
    def sequence(cls, pieces: Sequence[tuple[float, float, float]], *, start: float = 0.0, rise: float) -> LoadSteps:
        """Return the load of pieces (duration in s, first and last load in N), one after another from `start` on."""
        durations, first, last = (tuple(map(float, column)) for column in zip(*pieces, strict=True))
        edges = start + np.concatenate(([0.0], np.cumsum(durations)))
        return cls(tuple(edges.tolist()), first, last, float(rise))

    @cached_property
    def corners(self) -> tuple[tuple[float, float, float], ...]:
        """Return (time, jump of W, jump of dW/dt) for each edge where there is one."""
        rates = [
            (b - a) / (t1 - t0) for a, b, (t0, t1) in zip(self.first, self.last, pairwise(self.edges), strict=True)
        ]
        before = zip((self.first[0], *self.last), (0.0, *rates), strict=True)
        after = zip((*self.first, self.last[-1]), (*rates, 0.0), strict=True)
        found = [(t, W1 - W0, s1 - s0) for t, (W0, s0), (W1, s1) in zip(self.edges, before, after, strict=True)]
        return tuple(corner for corner in found if corner[1] or corner[2])

    @cached_property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        times = sorted({t + shift for t, _, _ in self.corners for shift in (0.0, self.rise)})
        kept: list[float] = []
        for t in times:
            if not kept or t - kept[-1] > NEAR * self.rise:
                kept.append(t)
        return tuple(kept)

    def piece(self, t: float) -> LoadPiece:
        i = bisect_right(self.breaks, t)
        knot = self.breaks[i - 1] if i else t
        a, b, c, d, e, f, g = self._expanded(knot, self._inside(i)).tolist()

        def polynomial(s: float) -> tuple[float, float]:
            h = s - knot
            W = a + h * (b + h * (c + h * (d + h * (e + h * (f + h * g)))))
            return W, b + h * (2 * c + h * (3 * d + h * (4 * e + h * (5 * f + h * 6 * g))))

        return polynomial

    def rest(self, t: float) -> float:
        return self.piece(t)(t)[0]

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        """Return knots (k + 1,) and coefficients (k, 7), lowest power first in t - knots[i]: W on [start, end], exactly."""
        inner = [b for b in self.breaks if start < b < end]
        knots = np.array([start, *inner, end])
        rows = [self._expanded(a, 0.5 * (a + b)) for a, b in pairwise(knots.tolist())]
        return knots, np.array(rows)

    def _inside(self, i: int) -> float:
        """Return a time inside the smooth piece number `i`, which ends at breaks[i]."""
        breaks = self.breaks
        if not breaks:
            return 0.0
        if i == 0:
            return breaks[0] - 1.0
        return breaks[-1] + 1.0 if i == len(breaks) else 0.5 * (breaks[i - 1] + breaks[i])

    def _expanded(self, knot: float, inside: float) -> Array:
        """Return the coefficients about `knot` of the polynomial that holds at `inside`, (7,)."""
        powers = self.rise ** -np.arange(DEGREE + 1.0)
        total = np.zeros(DEGREE + 1)
        total[0] = self.first[0]
        for t, jump, bend in self.corners:
            share, x = (inside - t) / self.rise, (knot - t) / self.rise
            if share <= 0:
                continue
            if share < 1:
                total += (jump * _shifted(_STEP, x) + bend * self.rise * _shifted(_RAMP, x)) * powers
            else:
                total[0] += jump + bend * (knot - t - 0.5 * self.rise)
                total[1] += bend
        return total


_STEP = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0, 0.0])  # from 0 to 1 on [0, 1], two derivatives vanish at both ends
_RAMP = np.array([0.0, 0.0, 0.0, 0.0, 2.5, -3.0, 1.0])  # its integral, which ends at 1/2


@dataclass(frozen=True)
class ModulatedLoad(Load):
    """A load times 1 + eps s(t) cos(2 pi f t + phase): `shape` is a Modulation of unit load, relative to `base` at each time."""

    base: Load
    shape: Modulation

    def __post_init__(self) -> None:
        if self.shape.W0 != 1.0:
            raise SrfError(f"the shape of a modulation has W0 = 1, not {self.shape.W0:g}", "Modulation(1.0, eps, f)")

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        return tuple(sorted({*self.base.breaks, *self.shape.breaks}))

    @property
    def longest_step(self) -> float:  # type: ignore[override]
        return min(self.base.longest_step, self.shape.longest_step)

    def check(self, start: float, end: float) -> None:
        self.base.check(start, end)

    def piece(self, t: float) -> LoadPiece:
        base, shape = self.base.piece(t), self.shape.piece(t)

        def product(s: float) -> tuple[float, float]:
            (W, W_dot), (m, m_dot) = base(s), shape(s)
            return W * m, W_dot * m + W * m_dot

        return product

    def rest(self, t: float) -> float:
        return self.base.rest(t)

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        """Return knots (k + 1,) and coefficients (k, degree + 1) of the product of both factors' polynomials."""
        factors = (self.base.polynomials(start, end), self.shape.polynomials(start, end))
        knots = np.unique(np.concatenate([factors[0][0], factors[1][0]]))
        left, right = (_about(knots[:-1], 0.5 * (knots[:-1] + knots[1:]), *factor) for factor in factors)
        product = np.zeros((left.shape[0], left.shape[1] + right.shape[1] - 1))
        for j in range(right.shape[1]):
            product[:, j : j + left.shape[1]] += left * right[:, j : j + 1]
        return knots, product


def _about(places: Array, inside: Array, knots: Array, coefficients: Array) -> Array:
    """Return, about each of `places`, the coefficients of the piece that holds at `inside`; (places, degree + 1)."""
    i = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(coefficients) - 1)
    return _shifted(coefficients[i], places - knots[i])


def _shifted(coefficients: Array, by: Array | float) -> Array:
    """Return the coefficients, lowest power first along the last axis, of p(x + by)."""
    out = coefficients.copy()
    n = out.shape[-1]
    for k in range(n - 1):  # Horner's scheme, once per power
        for j in range(n - 2, k - 1, -1):
            out[..., j] += by * out[..., j + 1]
    return out
