"""The imposed normal load: constant, modulated, or any other; um, s, N."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise

import numpy as np

from srfcli.errors import SrfError
from srfcli.numerics.collocation import Array

LoadPiece = Callable[[float], tuple[float, float]]
PIECES = 16  # polynomials per period of a modulation: degree 7 then errs by 4e-13 of its amplitude
DEGREE = 7


class Load(abc.ABC):
    """The imposed normal load and its rate, smooth between `breaks`; no step is longer than `longest_step` seconds."""

    breaks: tuple[float, ...] = ()
    longest_step: float = math.inf

    @abc.abstractmethod
    def piece(self, t: float) -> LoadPiece:
        """Return W and dW/dt as a function of one time, valid on the smooth piece that holds at `t`."""

    @abc.abstractmethod
    def rest(self, t: float) -> float:
        """Return the load under which sliding at time `t` is steady when nothing is modulated."""

    def check(self, start: float, end: float) -> None:  # noqa: B027
        """Raise SrfError where the load is not known on all of [start, end]."""

    @abc.abstractmethod
    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        """Return W on [start, end] as polynomials, to 1e-11 of W: knots (k + 1,) and coefficients (k, degree + 1).

        On [knots[i], knots[i + 1]] W is the sum of coefficients[i, j] (t - knots[i])^j; every break inside is a knot.
        """

    def __call__(self, t: Array) -> tuple[Array, Array]:
        """Return W and dW/dt at the times `t`, as arrays."""
        bounds = np.array(self.breaks, dtype=float)
        t = np.asarray(t, dtype=float)
        piece = np.searchsorted(bounds, t, side="right")
        out = np.empty((2, t.size))
        for k in np.unique(piece):
            members = np.nonzero(piece == k)[0]
            function = self.piece(float(t[members[0]]))
            out[:, members] = np.array([function(s) for s in t[members].tolist()]).T
        return out[0], out[1]


@dataclass(frozen=True)
class ConstantLoad(Load):
    """A load that does not change."""

    W0: float

    def __post_init__(self) -> None:
        _check_positive("W0", self.W0)

    def piece(self, t: float) -> LoadPiece:
        W0 = self.W0
        return lambda s: (W0, 0.0)

    def rest(self, t: float) -> float:
        return self.W0

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        _check_interval(start, end)
        return np.array([start, end]), np.array([[self.W0]])

    def __call__(self, t: Array) -> tuple[Array, Array]:
        return np.full(np.size(t), self.W0), np.zeros(np.size(t))


@dataclass(frozen=True)
class Modulation(Load):
    """W = W0 (1 + eps s(t) cos(2 pi f t + phase)), where s rises smoothly from 0 to 1 over `rise` seconds from `onset` on.

    Without `onset` the modulation has always been there. The switch-on has two continuous derivatives: a jump of the load
    would move the slider across an interface whose stiffness does not follow the load.
    """

    W0: float
    eps: float
    f: float
    onset: float = -math.inf
    rise: float | None = None  # five periods
    phase: float = 0.0

    def __post_init__(self) -> None:
        _check_positive("W0", self.W0)
        _check_positive("f", self.f)
        if not 0 <= self.eps < 1:
            raise SrfError(f"eps = {self.eps:g} lifts the slider off", "give 0 <= eps < 1")
        if self.rise is not None:
            _check_positive("rise", self.rise)

    @property
    def full(self) -> float:
        """Return the time from which the modulation has its full amplitude."""
        return self.onset + (5 / self.f if self.rise is None else self.rise)

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        return (self.onset, self.full) if math.isfinite(self.onset) else ()

    @property
    def longest_step(self) -> float:  # type: ignore[override]
        return 0.25 / self.f if self.eps else math.inf  # a longer one could jump over whole periods of a quiet start

    def piece(self, t: float) -> LoadPiece:
        W0, omega, phase, cos, sin = self.W0, 2 * math.pi * self.f, self.phase, math.cos, math.sin
        amplitude, onset = self.eps * self.W0, self.onset
        if t < onset or not self.eps:
            return lambda s: (W0, 0.0)

        def whole(s: float) -> tuple[float, float]:
            angle = omega * s + phase
            return W0 + amplitude * cos(angle), -amplitude * omega * sin(angle)

        if t >= self.full:
            return whole
        length = self.full - onset

        def rising(s: float) -> tuple[float, float]:
            r = (s - onset) / length
            share, rate = r * r * r * (10 - 15 * r + 6 * r * r), 30 * r * r * (1 - r) * (1 - r) / length
            W, W_dot = whole(s)
            return W0 + share * (W - W0), share * W_dot + rate * (W - W0)

        return rising

    def rest(self, t: float) -> float:
        return self.W0

    def _on_piece(self, t: Array, at: float) -> Array:
        """Return W at many times by the formula that holds at `at`: a record has tens of thousands of knots."""
        if at < self.onset or not self.eps:
            return np.full(t.shape, self.W0)
        wave = self.eps * self.W0 * np.cos(2 * math.pi * self.f * t + self.phase)
        if at < self.full:
            r = (t - self.onset) / (self.full - self.onset)
            wave *= r * r * r * (10 - 15 * r + 6 * r * r)
        return self.W0 + wave

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        _check_interval(start, end)
        inside = [b for b in self.breaks if start < b < end]
        knots, rows = [np.array([start])], []
        for a, b in pairwise([start, *inside, end]):
            edges = np.array([a, b])
            middle = 0.5 * (a + b)
            if self.eps and middle >= self.onset:
                length = 1 / self.f if middle >= self.full else min(1 / self.f, self.full - self.onset)
                edges = np.linspace(a, b, math.ceil((b - a) * PIECES / length) + 1)
            rows.append(fit_polynomials(partial(self._on_piece, at=middle), edges))
            knots.append(edges[1:])
        return np.concatenate(knots), np.concatenate(rows)


def fit_polynomials(function: Callable[[Array], Array], edges: Array) -> Array:
    """Return the polynomials of degree 7 through W at the Chebyshev-Lobatto points of each interval, (k, 8), lowest first.

    They meet at the edges, and are written in the time since the interval's start.
    """
    shares, to_powers = _interpolation()
    widths = np.diff(edges)
    times = edges[:-1, None] + widths[:, None] * shares
    times[:, -1] = edges[1:]
    values = function(times)
    offset = values[:, :1]
    powers = (values - offset) @ to_powers
    powers[:, 0] += offset[:, 0]
    return powers / widths[:, None] ** np.arange(DEGREE + 1)


@cache
def _interpolation() -> tuple[Array, Array]:
    """Return the points in [0, 1], rising, and the matrix that turns values there into coefficients of powers."""
    shares = 0.5 - 0.5 * np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)
    series = np.linalg.inv(np.polynomial.chebyshev.chebvander(2 * shares - 1, DEGREE))
    to_powers = np.array([_shifted_chebyshev(j) for j in range(DEGREE + 1)])  # row j: T_j(2 r - 1) in powers of r
    return shares, (series.T @ to_powers)


def _shifted_chebyshev(degree: int) -> Array:
    basis = np.polynomial.chebyshev.Chebyshev.basis(degree, domain=[0.0, 1.0])
    powers = basis.convert(kind=np.polynomial.Polynomial, domain=[-1.0, 1.0], window=[-1.0, 1.0]).coef
    return np.pad(np.round(powers), (0, DEGREE + 1 - powers.size))  # whole numbers


def _check_interval(start: float, end: float) -> None:
    if not (math.isfinite(start) and math.isfinite(end) and start < end):
        raise SrfError(f"a load is asked for from {start:g} to {end:g} s", "give two finite times that rise")


def _check_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise SrfError(f"{name} = {value:g} is not a positive number")
