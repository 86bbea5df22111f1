"""What a user types, in the unit they type it in, to um, s, N; angles to radians.

The units of the shipped laws need no library; any other is looked up in pint, which is imported on that occasion.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from srfcli.errors import SrfError


@dataclass(frozen=True)
class Unit:
    """A unit as a factor to the base units and its powers of (um, s, N, rad)."""

    factor: float
    powers: tuple[int, int, int, int]


_TABLE = {
    "1": Unit(1.0, (0, 0, 0, 0)),
    "um": Unit(1.0, (1, 0, 0, 0)),
    "s": Unit(1.0, (0, 1, 0, 0)),
    "N": Unit(1.0, (0, 0, 1, 0)),
    "N/um": Unit(1.0, (-1, 0, 1, 0)),
    "um/s": Unit(1.0, (1, -1, 0, 0)),
    "s/um": Unit(1.0, (-1, 1, 0, 0)),
    "1/um": Unit(1.0, (-1, 0, 0, 0)),
    "1/s": Unit(1.0, (0, -1, 0, 0)),
    "Hz": Unit(1.0, (0, -1, 0, 0)),
    "kg": Unit(1e-6, (-1, 2, 1, 0)),  # 1 kg = 1 N s^2/m
    "rad": Unit(1.0, (0, 0, 0, 1)),
    "deg": Unit(math.pi / 180.0, (0, 0, 0, 1)),
}

LONGEST = 200  # characters of a number with its unit
_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
# A product of names with one-digit powers: pint never sees a tower of powers that it would have to work out.
_FACTOR = r"(?:1|[A-Za-zµ°Ωθ%_]+(?:(?:\^|\*\*)-?[1-9])?)"
_UNIT = re.compile(rf"{_FACTOR}(?:\s*[*/ ]\s*{_FACTOR})*")


def to_base(value: float, unit: str) -> float:
    """Return `value`, given in `unit`, in um, s, N and radians."""
    return value * find_unit(unit).factor


def from_base(value: float, unit: str) -> float:
    """Return `value`, given in um, s, N and radians, in `unit`."""
    return value / find_unit(unit).factor


def parse_quantity(text: str, unit: str, *, name: str) -> float:
    """Return the number that `text` states, in `unit`; a bare number is in that unit. `name` is for the error.

    `parse_quantity("210 N/mm", "N/um", name="K")` is 0.21. Raises SrfError for no finite number or a wrong unit.
    """
    number, written = split_quantity(text, name=name, example=f"0.5 {unit}" if unit != "1" else "0.5")
    return convert(number, written, unit, name=name) if written else number


def split_quantity(text: str, *, name: str, example: str = "0.5") -> tuple[float, str]:
    """Return the number and the unit that `text` states; the unit is "" for a bare number."""
    if len(text) > LONGEST:
        raise SrfError(f"{name}: {len(text)} characters are no number", f"Write it as in {name}='{example}'.")
    match = _NUMBER.fullmatch(text)
    if not match:
        raise SrfError(
            f"{name} = {text!r} is not a number", f"Write a number and, if you like, its unit: {name}='{example}'."
        )
    if re.match(r",\d", match[2]):
        raise SrfError(
            f"{name} = {text!r}: a decimal comma is not understood", f"Write a point: {text.replace(',', '.')}."
        )
    number = float(match[1])
    if not math.isfinite(number):
        raise SrfError(f"{name} = {text!r} is too large to be a number", "Write a finite number, as in 1e-3.")
    return number, match[2]


def convert(number: float, written: str, unit: str, *, name: str) -> float:
    """Return `number`, given in `written`, in `unit`; raises SrfError if the two do not measure the same thing."""
    if written == unit:
        return number
    where = f"{name} = {number:g} {written}"
    source, target = find_unit(written, where=where), find_unit(unit)
    if source.powers != target.powers:
        expected = "a plain number" if unit == "1" else f"{unit}, or a unit of the same dimension"
        raise SrfError(f"{where}: {written!r} is the wrong unit", f"Write {name} in {expected}.")
    return number * tidy(source.factor / target.factor)  # N/mm -> N/um is 1e-3, not 0.0010000000000000002


def tidy(value: float) -> float:
    """Return the number of twelve digits that `value` misses by rounding alone, else `value` itself."""
    round_number = float(f"{value:.12g}")
    return round_number if math.isclose(value, round_number, rel_tol=1e-14) else value


def find_unit(text: str, *, where: str = "") -> Unit:
    """Return the unit that `text` names; raises SrfError, beginning with `where`, if there is none."""
    if len(text) > LONGEST:
        raise SrfError(f"{where}: {len(text)} characters are no unit".lstrip(": "), "Write a unit as in N/um, um/s.")
    spelled = text.strip().replace("μ", "µ").replace("µm", "um")
    if spelled in _TABLE:
        return _TABLE[spelled]
    prefix = f"{where}: " if where else ""
    if not _UNIT.fullmatch(spelled):
        raise SrfError(f"{prefix}{text!r} is not a unit", "Write a unit as in N/um, um/s or kg*m/s^2.")
    return _from_pint(spelled, prefix)


def _from_pint(text: str, prefix: str) -> Unit:
    registry = _pint_registry(text, prefix)
    try:
        quantity = registry.Quantity(1.0, registry.Unit(text)).to_base_units()
        powers = {name: float(power) for name, power in quantity.unit_items()}
        factor = float(quantity.magnitude)
    except Exception as error:  # pint raises its own, tokenizer and arithmetic errors for a bad unit
        hint = f"Known without a library: {', '.join(_TABLE)}; otherwise any unit that pint knows."
        raise SrfError(f"{prefix}unknown unit {text!r}", hint) from error
    mass, metre = powers.pop("kilogram", 0.0), powers.pop("meter", 0.0)
    second, radian = powers.pop("second", 0.0), powers.pop("radian", 0.0)
    exponents = (metre - mass, second + 2 * mass, mass, radian)  # kg = 1e-6 N s^2/um
    if powers or any(not p.is_integer() for p in exponents):
        raise SrfError(
            f"{prefix}{text!r} is not a mechanical unit", "Write it in um, s, N, kg, deg or products of these."
        )
    um, s, newton, rad = (int(p) for p in exponents)
    if not 1e-100 < factor < 1e100 or abs(um) + abs(mass) > 20:
        raise SrfError(f"{prefix}{text!r} is no unit of use", "Write it in um, s, N, kg or products of these.")
    return Unit(factor * 1e6 ** (um + mass) / 1e6**mass, (um, s, newton, rad))


def _pint_registry(text: str, prefix: str) -> Any:
    global _REGISTRY
    if _REGISTRY is None:
        try:
            import pint
        except ImportError as error:
            hint = f'Write it in {", ".join(_TABLE)}, or install pint: pip install "srfcli[units]"'
            raise SrfError(f"{prefix}the unit {text!r} needs pint, which is not installed", hint) from error
        _REGISTRY = pint.UnitRegistry()
    return _REGISTRY


_REGISTRY: Any = None
