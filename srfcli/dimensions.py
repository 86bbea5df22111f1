"""Dimensions over um, s and N: enough to see whether a law adds a length to a time."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

from srfcli.errors import SrfError, did_you_mean

if TYPE_CHECKING:
    import sympy

Dimension = tuple[Fraction, Fraction, Fraction]  # powers of um, s, N
NONE: Dimension = (Fraction(0), Fraction(0), Fraction(0))


@dataclass(frozen=True)
class Unit:
    """A unit as declared: `factor` turns a number in it into um, s, N (and radians); `dimension` holds the powers."""

    factor: float
    dimension: Dimension


def _unit(factor: float, um: int = 0, s: int = 0, newton: int = 0) -> Unit:
    return Unit(factor, (Fraction(um), Fraction(s), Fraction(newton)))


UNITS = {
    "1": _unit(1.0),
    "rad": _unit(1.0),
    "deg": _unit(math.pi / 180),
    "nm": _unit(1e-3, um=1),
    "um": _unit(1.0, um=1),
    "mm": _unit(1e3, um=1),
    "m": _unit(1e6, um=1),
    "ms": _unit(1e-3, s=1),
    "s": _unit(1.0, s=1),
    "Hz": _unit(1.0, s=-1),
    "N": _unit(1.0, newton=1),
    "mN": _unit(1e-3, newton=1),
    "kN": _unit(1e3, newton=1),
    "Pa": _unit(1e-12, um=-2, newton=1),
    "kPa": _unit(1e-9, um=-2, newton=1),
    "MPa": _unit(1e-6, um=-2, newton=1),
    "kg": _unit(1e-6, um=-1, s=2, newton=1),  # 1 kg = 1 N s^2/m
    "g": _unit(1e-9, um=-1, s=2, newton=1),
}
SYMBOL_UNITS = {
    "v": "um/s",
    "phi": "s",
    "mu": "1",
    "mu_dot": "1/s",
    "W": "N",
    "W_dot": "N/s",
    "F_dot_over_W": "1/s",
}
QUANTITY_UNITS = {"mu": "1", "rate": "1", "term": "1", "kappa": "N/um"}

_FACTOR = re.compile(r"([A-Za-z]+|1)(?:(?:\^|\*\*)(-?\d))?", re.ASCII)


def parse_unit(text: str) -> Unit:
    """Return the unit written as `um/s`, `1/um`, `N*s**2/um` or `N/um^2`; raises `SrfError` on anything else."""
    if len(text) > 200:
        raise SrfError(f"{len(text)} characters are no unit", "Write it as um/s, 1/um or N/um^2.")
    factor, dimension = 1.0, NONE
    parts = re.split(r"([*/])", text.strip().replace("**", "^").replace("µ", "u").replace("μ", "u"))
    for index in range(0, len(parts), 2):
        word = parts[index].strip()
        match = _FACTOR.fullmatch(word)
        if match is None or match[1] not in UNITS:
            raise SrfError(f"unknown unit {text!r}", did_you_mean(match[1] if match else word, UNITS))
        power = int(match[2] or 1) * (-1 if index and parts[index - 1] == "/" else 1)
        unit = UNITS[match[1]]
        factor *= unit.factor**power
        dimension = multiply(dimension, unit.dimension, Fraction(power))
        if not 1e-100 < factor < 1e100:
            raise SrfError(f"{text!r} is no unit of use", "Write it as um/s, 1/um or N/um^2.")
    return Unit(factor, dimension)


def multiply(left: Dimension, right: Dimension, power: Fraction = Fraction(1)) -> Dimension:
    """Return the dimension of left * right**power."""
    return (left[0] + right[0] * power, left[1] + right[1] * power, left[2] + right[2] * power)


def describe(dimension: Dimension) -> str:
    """Return a dimension as text, `um/s`, `1` for none."""
    names = ("um", "s", "N")
    over = [n + (f"^{d}" if d != 1 else "") for n, d in zip(names, dimension, strict=True) if d > 0]
    under = [n + (f"^{-d}" if d != -1 else "") for n, d in zip(names, dimension, strict=True) if d < 0]
    return "/".join(["*".join(over) or "1", *under])


def dimension_of(expr: sympy.Expr, units: dict[str, Dimension]) -> Dimension:
    """Return the dimension of a formula whose symbols have `units`; raises `SrfError` where it adds unlike things."""
    import sympy

    if expr.is_Symbol:
        return units[expr.name]
    if expr.is_number:
        return NONE
    if isinstance(expr, sympy.Add):
        found = [(term, dimension_of(term, units)) for term in expr.args]
        for term, dimension in found[1:]:
            if dimension != found[0][1]:
                first = f"{found[0][0]} [{describe(found[0][1])}]"
                raise SrfError(f"{first} and {term} [{describe(dimension)}] are added")
        return found[0][1]
    if isinstance(expr, sympy.Mul):
        product = NONE
        for term in expr.args:
            product = multiply(product, dimension_of(term, units))
        return product
    if isinstance(expr, sympy.Pow) and expr.exp.is_Rational:
        return multiply(NONE, dimension_of(expr.base, units), Fraction(int(expr.exp.p), int(expr.exp.q)))
    for argument in expr.args:  # functions, and powers with an exponent that varies
        dimension = dimension_of(argument, units)
        if dimension != NONE:
            name = "a power" if isinstance(expr, sympy.Pow) else expr.func.__name__
            raise SrfError(f"{name} is taken of {argument}, which has the unit {describe(dimension)}, not 1")
    return NONE
