"""The parameters of a fit of critical loads in natural coordinates: logarithms where positive, 0 at the start, between bounds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.codegen.model import Array
from srfcli.core.errors import SrfError
from srfcli.core.settings import Parameter, require_parameter
from srfcli.core.units import from_base, to_base

RHO = Parameter(
    "rho", 1.0, "1", 0.0, 10.0, "share of the modulation that reaches the asperities: rho times eps of the table acts"
)
GIVEN = ("V", "eps", "W0")  # the table's own columns
TRUSTED_FACTOR = 10.0  # start values are trusted to this factor unless bounds are given


@dataclass(frozen=True)
class FreeParameter:
    """A parameter to be fitted: where it starts and between which values it is looked for, in base units.

    Its coordinate y is ln(value/start) where `log`, else (value - start)/size.
    """

    parameter: Parameter
    start: float
    lower: float
    upper: float

    @property
    def name(self) -> str:
        """Return the parameter's name."""
        return self.parameter.name

    @property
    def log(self) -> bool:
        """True where the value cannot change sign."""
        return self.lower > 0

    @property
    def size(self) -> float:
        """Return the unit of a coordinate that is not logarithmic."""
        return abs(self.start) or min(1.0, self.upper - self.lower)

    def value(self, y: float) -> float:
        """Return the value at coordinate `y`, in base units."""
        return self.start * math.exp(y) if self.log else self.start + self.size * y

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value in base units."""
        return math.log(value / self.start) if self.log else (value - self.start) / self.size

    def declared(self, value: float) -> float:
        """Return a value in base units in the unit the parameter is declared in."""
        return from_base(value, self.parameter.unit)


@dataclass(frozen=True)
class Scale:
    """All free parameters of a fit, in order."""

    free: tuple[FreeParameter, ...]

    def __iter__(self) -> Iterator[FreeParameter]:
        return iter(self.free)

    def __len__(self) -> int:
        return len(self.free)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the parameters' names."""
        return tuple(q.name for q in self.free)

    def values(self, y: Array) -> Array:
        """Return the values (k,) at coordinates (k,), in base units."""
        return np.array([q.value(float(c)) for q, c in zip(self.free, y, strict=True)])

    def rates(self, y: Array) -> Array:
        """Return d(value)/dy (k,) at coordinates (k,)."""
        return np.array([value if q.log else q.size for q, value in zip(self.free, self.values(y), strict=True)])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Return the lowest and highest coordinates, each (k,)."""
        low = np.array([q.coordinate(q.lower) for q in self.free])
        return low, np.array([q.coordinate(q.upper) for q in self.free])


def with_transmission(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Return a model's parameters and, unless it has one of its own, the paper's rho."""
    return tuple(parameters) if any(p.name == RHO.name for p in parameters) else (*parameters, RHO)


def free_parameters(
    parameters: Sequence[Parameter],
    names: Sequence[str],
    *,
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]] | None = None,
    largest_eps: float = 0.0,
    where: str = "this system",
) -> Scale:
    """Return the scale of a fit of `names` from the values `start`, between `bounds`; both in base units.

    Without bounds of its own a parameter stays within what its law declares and, where that allows no sign, within a
    factor of ten of its start. `largest_eps` is that of the table: rho keeps it below 1. Raises SrfError.
    """
    own = dict(bounds or {})
    if not names:
        known = ", ".join(p.name for p in parameters if p.name not in GIVEN)
        raise SrfError("no parameter is free", f"Name some in `free`, as A,B,D0; known: {known}")
    for name in own:
        require_parameter(name, parameters, where=where)
        if name not in names:
            raise SrfError(f"bounds are given for {name}, which is not free", "Name it in `free`, or leave them out.")
    found = []
    for position, name in enumerate(names):
        if name in GIVEN:
            raise SrfError(f"{name} cannot be fitted", f"The table gives {', '.join(GIVEN)}; free what the law declares.")
        if name in names[:position]:
            raise SrfError(f"{name} is named twice", "Name each free parameter once.")
        parameter = require_parameter(name, parameters, where=where)
        found.append(_free(parameter, start[name], own.get(name), largest_eps))
    return Scale(tuple(found))


def _free(parameter: Parameter, start: float, own: tuple[float, float] | None, largest_eps: float) -> FreeParameter:
    name, unit = parameter.name, parameter.unit
    low, high = sorted(to_base(b, unit) for b in (parameter.lower, parameter.upper))
    if name == RHO.name and largest_eps > 0:
        high = min(high, 0.999 / largest_eps)
    if own is not None:
        low, high = max(low, own[0]), min(high, own[1])
    elif low >= 0 and start > 0:
        low, high = max(low, start / TRUSTED_FACTOR), min(high, start * TRUSTED_FACTOR)
    if not low < high or not low <= start <= high:
        shown = [f"{from_base(v, unit):.6g}" for v in (start, low, high)]
        raise SrfError(
            f"{name} starts at {shown[0]} {unit}, not between its bounds {shown[1]} and {shown[2]}",
            f"Set another start, or other `bounds` of {name}.",
        )
    if own is not None and low == 0 and start > 0:
        low = min(start, high) * 1e-6  # an end at 0 is one that a logarithm never reaches
    return FreeParameter(parameter, start, low, high)
