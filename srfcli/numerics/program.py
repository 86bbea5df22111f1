"""What the experimenter imposes: the driving velocity V(t) and the normal load W(t), piece by smooth piece; um, s, N."""

from __future__ import annotations

import abc
import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.errors import SrfError
from srfcli.numerics.collocation import Array

LoadPiece = Callable[[float], tuple[float, float]]


@dataclass(frozen=True)
class Drive:
    """Velocity of the spring's far end: from `times[i]` on it is velocities[i] + accelerations[i] (t - times[i]).

    The first piece also holds before times[0]. Jumps of V are allowed, V may be zero or negative.
    """

    times: tuple[float, ...]
    velocities: tuple[float, ...]
    accelerations: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.times) == len(self.velocities) == len(self.accelerations) >= 1:
            raise SrfError("a drive needs as many times as velocities and accelerations, and at least one")
        if not all(map(math.isfinite, (*self.times, *self.velocities, *self.accelerations))):
            raise SrfError("a drive's times, velocities and accelerations must be finite")
        if any(b <= a for a, b in zip(self.times, self.times[1:], strict=False)):
            raise SrfError("the times of a drive must rise", "give each change of velocity its own, later time")

    @classmethod
    def constant(cls, V: float) -> Drive:
        """Return one velocity for all times."""
        return cls((0.0,), (float(V),), (0.0,))

    @classmethod
    def steps(cls, changes: Sequence[tuple[float, float]]) -> Drive:
        """Return a velocity that jumps to V at t, for each (t, V); the first holds before its time too."""
        times, velocities = zip(*changes, strict=True)
        return cls(tuple(map(float, times)), tuple(map(float, velocities)), (0.0,) * len(times))

    @classmethod
    def ramps(cls, points: Sequence[tuple[float, float]]) -> Drive:
        """Return straight lines through (t, V), constant before the first point and after the last."""
        t, V = (np.array(column, dtype=float) for column in zip(*points, strict=True))
        if (np.diff(t) <= 0).any():
            raise SrfError("the times of a drive must rise", "give a jump as two points a moment apart, or use steps")
        slopes = [*(np.diff(V) / np.diff(t)).tolist(), 0.0]
        before = float(np.nextafter(t[0], -np.inf))
        return cls((before, *t.tolist()), (float(V[0]), *V.tolist()), (0.0, *slopes))

    @property
    def breaks(self) -> tuple[float, ...]:
        """Return the times at which V or its slope may jump."""
        return self.times[1:]

    def piece(self, t: float) -> tuple[float, float, float]:
        """Return (V, acceleration, reference time) of the piece that holds at `t`."""
        i = max(bisect_right(self.times, t) - 1, 0)
        return self.velocities[i], self.accelerations[i], self.times[i]

    def __call__(self, t: Array) -> Array:
        """Return V at the times `t`."""
        i = np.maximum(np.searchsorted(self.times, t, side="right") - 1, 0)
        times, V, rate = (np.array(a) for a in (self.times, self.velocities, self.accelerations))
        return np.where(rate[i] == 0.0, V[i], V[i] + rate[i] * (np.asarray(t) - times[i]))


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


class SampledLoad(Load):
    """A measured load: the not-a-knot cubic spline through `W` (N) at `times` (s, rising, four or more)."""

    def __init__(self, times: Array, W: Array) -> None:
        from scipy.interpolate import CubicSpline

        t, values = np.asarray(times, dtype=float), np.asarray(W, dtype=float)
        if t.ndim != 1 or t.shape != values.shape or t.size < 4:
            raise SrfError("a sampled load needs four times or more, and as many loads as times")
        if not (np.isfinite(t).all() and np.isfinite(values).all() and (np.diff(t) > 0).all()):
            raise SrfError("a sampled load needs finite loads at rising times", "drop gaps and repeated times first")
        if values.min() <= 0:
            raise SrfError(
                f"the load is {values.min():g} N at t = {t[values.argmin()]:g} s", "the slider must stay in contact"
            )
        self.times, self.W = t, values
        self.longest_step = float(4 * np.median(np.diff(t)))
        self._knots = t.tolist()
        self._cubics = CubicSpline(t, values).c.T.tolist()

    def check(self, start: float, end: float) -> None:
        if start < self._knots[0] or end > self._knots[-1]:
            raise SrfError(
                f"the load is known from {self._knots[0]:g} to {self._knots[-1]:g} s, not over all of {start:g} to {end:g} s",
                "simulate within the times of the load's samples",
            )

    def piece(self, t: float) -> LoadPiece:
        knots, cubics, last = self._knots, self._cubics, len(self._knots) - 2

        def spline(s: float) -> tuple[float, float]:
            i = min(max(bisect_right(knots, s) - 1, 0), last)
            h, (a, b, c, d) = s - knots[i], cubics[i]
            return ((a * h + b) * h + c) * h + d, (3 * a * h + 2 * b) * h + c

        return spline

    def rest(self, t: float) -> float:
        return self.piece(t)(t)[0]


def _check_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise SrfError(f"{name} = {value:g} is not a positive number")
