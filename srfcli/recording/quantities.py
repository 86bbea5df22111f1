"""Numbers and units as an experiment's author writes them, to um, s, N."""

from __future__ import annotations

import math
import re

from srfcli.dimensions import UNITS, Dimension, Unit, describe, multiply
from srfcli.errors import SrfError, did_you_mean
from srfcli.units import LONGEST, find_unit, split_quantity, tidy

_SAME = {"": "1", "-": "1", "micron": "um", "microns": "um", "micrometer": "um", "sec": "s", "secs": "s", "second": "s"}
_SAME |= {"seconds": "s", "dimensionless": "1", "none": "1", "hz": "Hz", "newton": "N", "newtons": "N", "kgs": "kg"}
_SCALED = {"us": ("s", 1e-6), "min": ("s", 60.0), "h": ("s", 3600.0), "cm": ("um", 1e4), "GPa": ("Pa", 1e9)}
_KNOWN = {**UNITS, **{name: Unit(UNITS[of].factor * by, UNITS[of].dimension) for name, (of, by) in _SCALED.items()}}
_KNOWN["%"] = Unit(0.01, UNITS["1"].dimension)
_FACTOR = re.compile(r"([A-Za-z%]+|1)(?:\^(-?\d))?", re.ASCII)
SQUARE_MILLIMETRE = 1e6  # um^2: a stress is taken as the force on this area


def unit_factor(text: str, base: str) -> float:
    """Return what a number in the unit `text` is multiplied by to be in `base`; raises SrfError for another dimension.

    A stress counts as the force on 1 mm^2, so that 1 MPa is 1 N.
    """
    found, wanted = _find(text), _KNOWN[base] if base in _KNOWN else _find(base)
    if found.dimension == wanted.dimension:
        return tidy(found.factor / wanted.factor)
    stress, force = UNITS["MPa"], UNITS["N"]
    if found.dimension == stress.dimension and wanted.dimension == force.dimension:
        return tidy(found.factor / wanted.factor * SQUARE_MILLIMETRE)
    if found.dimension == force.dimension and wanted.dimension == stress.dimension:
        return tidy(found.factor / wanted.factor / SQUARE_MILLIMETRE)
    raise SrfError(
        f"{text!r} measures {describe(found.dimension)}, not {describe(wanted.dimension)}",
        f"Give a unit of the dimension of {base!r}.",
    )


def parse_quantity(text: str, base: str, *, name: str) -> float:
    """Return the number that `text` states, in `base`; a bare number is in that unit."""
    number, written = split_quantity(text, name=name, example=f"0.5 {base}" if base != "1" else "0.5")
    value = number * unit_factor(written, base) if written else number
    if not math.isfinite(value):
        raise SrfError(f"{name} = {text!r} is too large", "Write a finite number, as in 1e-3.")
    return value


def same_dimension(text: str, base: str) -> bool:
    """Return whether the unit `text` measures what `base` does; raises SrfError for no unit at all."""
    return _find(text).dimension == _find(base).dimension


def _find(text: str) -> Unit:
    if len(text) > LONGEST:
        raise SrfError(f"{len(text)} characters are no unit", "Write a unit as in N/um, um/s.")
    spelled = text.strip().replace("**", "^").replace("µ", "u").replace("μ", "u")
    spelled = _SAME.get(spelled.lower(), spelled)
    factor, dimension = 1.0, UNITS["1"].dimension
    parts = re.split(r"\s*([*/])\s*", spelled)
    for index in range(0, len(parts), 2):
        word = _SAME.get(parts[index].lower(), parts[index]) if parts[index] else "?"
        match = _FACTOR.fullmatch(word)
        if match is None or match[1] not in _KNOWN:
            return _foreign(text, match[1] if match else word)
        power = int(match[2] or 1) * (-1 if index and parts[index - 1] == "/" else 1)
        unit = _KNOWN[match[1]]
        factor *= unit.factor**power
        dimension = multiply(dimension, unit.dimension, UNITS["1"].dimension[0] + power)
        if not 1e-100 < factor < 1e100:
            raise SrfError(f"{text!r} is no unit of use", "Write a unit as in N/um, um/s.")
    return Unit(factor, dimension)


def _foreign(text: str, word: str) -> Unit:
    """Return a unit that only the units library knows."""
    try:
        unit = find_unit(text)
    except SrfError as error:
        raise SrfError(f"unknown unit {text!r}", did_you_mean(word, _KNOWN)) from error
    um, s, newton, _ = unit.powers
    zero = UNITS["1"].dimension[0]
    dimension: Dimension = (zero + um, zero + s, zero + newton)
    return Unit(unit.factor, dimension)
