"""A window in the plane of two parameters, mapped to the unit square in which arclength is measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array


@dataclass(frozen=True)
class Axis:
    """A parameter from `lo` to `hi` (um, s, N), on a logarithmic scale where `log`."""

    name: str
    lo: float
    hi: float
    log: bool = True

    @property
    def span(self) -> float:
        """Return the length of the axis, in ln(value) where logarithmic."""
        return float(np.log(self.hi / self.lo)) if self.log else self.hi - self.lo

    def unit(self, value: Array | float) -> Array | float:
        """Return `value` as a coordinate that is 0 at `lo` and 1 at `hi`."""
        return (
            np.log(np.asarray(value) / self.lo) / self.span if self.log else (np.asarray(value) - self.lo) / self.span
        )

    def value(self, unit: Array | float) -> Array | float:
        """Return the parameter at a unit coordinate."""
        unit = np.asarray(unit)
        inside = self.lo * np.exp(unit * self.span) if self.log else self.lo + unit * self.span
        return np.where(unit == 1.0, self.hi, inside)  # the window's edge exactly

    def rate(self, value: Array | float) -> Array | float:
        """Return d(value)/d(unit coordinate)."""
        return np.asarray(value) * self.span if self.log else self.span

    def samples(self, count: int) -> Array:
        """Return `count` values, evenly spaced on the axis' scale, both ends among them."""
        values = np.asarray(self.value(np.linspace(0.0, 1.0, count)))
        values[0], values[-1] = self.lo, self.hi
        return values


@dataclass(frozen=True)
class Plane:
    """Two axes and the fixed parameters `base` (n_parameters,); stability is followed across y along x."""

    base: Array
    x: Axis
    y: Axis

    @property
    def names(self) -> tuple[str, str]:
        """Return the names of the two parameters."""
        return self.x.name, self.y.name

    def coordinates(self, model: GeneratedModel, p: Array) -> Array:
        """Return the unit coordinates (..., 2) of parameter points `p` (n_parameters, ...)."""
        return np.stack([np.asarray(a.unit(p[model.index(a.name)])) for a in (self.x, self.y)], axis=-1)

    def point(self, model: GeneratedModel, q: Array) -> Array:
        """Return the parameters (n_parameters,) at unit coordinates q (2,)."""
        p = self.base.copy()
        p[model.index(self.x.name)], p[model.index(self.y.name)] = self.x.value(q[0]), self.y.value(q[1])
        return p

    def rates(self, model: GeneratedModel, p: Array) -> Array:
        """Return dp/dq of the two parameters at `p` (n_parameters,), as (2,)."""
        return np.array([float(a.rate(p[model.index(a.name)])) for a in (self.x, self.y)])
