"""What the experimenter imposes: the driving velocity V(t) and the normal load W(t), piece by smooth piece; um, s, N."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.errors import SrfError
from srfcli.numerics.collocation import Array
from srfcli.numerics.load import ConstantLoad, Load, LoadPiece, Modulation
from srfcli.numerics.sampled import SampledLoad

__all__ = ["ConstantLoad", "Drive", "Load", "LoadPiece", "Modulation", "SampledLoad"]


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
