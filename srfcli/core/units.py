"""Units: what a user types, what a law declares and what a recording states, in um, s, N and radians.

The usual units, and products and powers of them, need no library; any other is looked up in pint where that is installed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import SrfError, did_you_mean

if TYPE_CHECKING:
    import sympy


@dataclass(frozen=True)
class Unit:
    """A unit as a factor to the base units and its powers of (um, s, N, rad)."""

    factor: float
    powers: tuple[int, int, int, int]


DIMENSIONLESS, LENGTH, TIME, FORCE = (0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0)
STRESS, RATE, MASS, ANGLE = (-2, 0, 1, 0), (0, -1, 0, 0), (-1, 2, 1, 0), (0, 0, 0, 1)
TORQUE, TURNING = (1, 0, 1, 0), (0, -1, 0, 1)
_TABLE = {  # factors to um, s, N, rad
    name: Unit(factor, powers)
    for powers, names in {
        DIMENSIONLESS: {"1": 1.0, "%": 0.01},
        LENGTH: {"nm": 1e-3, "um": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6},
        TIME: {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0},
        RATE: {"Hz": 1.0, "kHz": 1e3},
        FORCE: {"nN": 1e-9, "uN": 1e-6, "mN": 1e-3, "N": 1.0, "kN": 1e3, "MN": 1e6, "gf": 9.80665e-3, "kgf": 9.80665},
        STRESS: {"Pa": 1e-12, "kPa": 1e-9, "MPa": 1e-6, "GPa": 1e-3, "bar": 1e-7, "kbar": 1e-4, "psi": 6894.757293168361e-12},
        MASS: {"g": 1e-9, "kg": 1e-6},  # 1 kg = 1 N s^2/m
        ANGLE: {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0, "rev": 2 * math.pi},
        TORQUE: {"uNm": 1.0, "mNm": 1e3, "Nm": 1e6, "kNm": 1e9},
        TURNING: {"rpm": math.pi / 30.0},
    }.items()
    for name, factor in names.items()
}
_SPELLED = {  # in small letters, as headings of recordings have them
    "": "1", "-": "1", "none": "1", "dimensionless": "1", "micron": "um", "microns": "um", "micrometer": "um",
    "micrometers": "um", "sec": "s", "secs": "s", "second": "s", "seconds": "s", "hz": "Hz", "newton": "N", "newtons": "N",
    "kgs": "kg", "mpa": "MPa", "kpa": "kPa", "gpa": "GPa", "minute": "min", "minutes": "min", "hours": "h", "degree": "deg",
    "degrees": "deg", "°": "deg", "radian": "rad", "radians": "rad", "kn": "kN", "percent": "%",
}  # fmt: skip
SQUARE_MILLIMETRE = 1e6  # um^2: a stress is taken as the force on this area

LONGEST_QUANTITY = 200  # characters of a number with its unit
LONGEST_HEADING = 500  # characters of a heading that are looked through for its unit
_HEADING = re.compile(r"\s*(.*?)\s*(?:\[\s*([^\[\]]*?)\s*\]|\(\s*([^()]*?)\s*\))\s*")
_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
# A product of names with one-digit powers: pint never sees a tower of powers that it would have to work out.
_FACTOR = r"(?:1|[A-Za-zµ°Ωθ%_]+(?:\^-?[1-9])?)"
_UNIT = re.compile(rf"{_FACTOR}(?:\s*[*/ ]\s*{_FACTOR})*")
_PART = re.compile(r"\s*([*/ ]?)\s*([^\s*/^]+)(?:\^(-?\d))?")


def split_heading(heading: str) -> tuple[str, str | None]:
    """Return the name and the unit of `name [unit]` or `name (unit)`; the unit is None for a bare name."""
    match = _HEADING.fullmatch(heading) if len(heading) <= LONGEST_HEADING else None
    if match is None:
        return heading.strip(), None
    return match[1], match[2] if match[2] is not None else match[3]


def to_base(value: float, unit: str) -> float:
    """Return `value`, given in `unit`, in um, s, N and radians."""
    return value * find_unit(unit).factor


def from_base(value: float, unit: str) -> float:
    """Return `value`, given in um, s, N and radians, in `unit`."""
    return value / find_unit(unit).factor


@dataclass(frozen=True)
class Geometry:
    """Of a rig: the radius that an arm or a ring slides on and a layer's thickness in um, the sheared area in mm^2; or None."""

    radius: float | None = None
    thickness: float | None = None
    area: float | None = None


NO_GEOMETRY = Geometry()
GEOMETRY_UNITS = {"radius": "um", "thickness": "um", "area": "mm^2"}


def parse_quantity(text: str, unit: str, *, name: str) -> float:
    """Return the number that `text` states, in `unit`; a bare number is in that unit. `name` is for the error.

    `parse_quantity("210 N/mm", "N/um", name="K")` is 0.21. Raises SrfError for no finite number or a wrong unit.
    """
    number, written = split_quantity(text, name=name, example=f"0.5 {unit}" if unit != "1" else "0.5")
    return convert(number, written, unit, name=name) if written else number


def split_quantity(text: str, *, name: str, example: str = "0.5") -> tuple[float, str]:
    """Return the number and the unit that `text` states; the unit is "" for a bare number."""
    if len(text) > LONGEST_QUANTITY:
        raise SrfError(f"{name}: {len(text)} characters are no number", f"Write it as in {name}='{example}'.")
    match = _NUMBER.fullmatch(text)
    if not match or match[2][:1] in ("-", "+"):  # no unit begins with a sign
        raise SrfError(f"{name} = {text!r} is not a number", f"Write a number and, if you like, its unit: {name}='{example}'.")
    if re.match(r",\d", match[2]):
        raise SrfError(f"{name} = {text!r}: a decimal comma is not understood", f"Write a point: {text.replace(',', '.')}.")
    number = float(match[1])
    if not math.isfinite(number):
        raise SrfError(f"{name} = {text!r} is too large to be a number", "Write a finite number, as in 1e-3.")
    return number, match[2]


def convert(number: float, written: str, unit: str, *, name: str) -> float:
    """Return `number`, given in `written`, in `unit`; raises SrfError if the two do not measure the same thing."""
    where = f"{name} = {number:g} {written}"
    found = number if written == unit else number * unit_factor(written, unit, where=where)
    if not math.isfinite(found):
        raise SrfError(f"{where} is too large", "Write a finite number, as in 1e-3.")
    return found


def unit_factor(written: str, unit: str, geometry: Geometry = NO_GEOMETRY, *, where: str = "") -> float:
    """Return what a number in `written` is multiplied by to be in `unit`; raises SrfError, beginning with `where`.

    A stress counts as the force on 1 mm^2, so that 1 MPa is 1 N and 1 MPa/mm is 1e-3 N/um. With its radius a torque is a force
    and an angle a length, with its thickness a strain is a length and a stress per strain a stiffness, and with its
    area a force is a stress.
    """
    found, wanted = find_unit(written, where=where), find_unit(unit)
    factor = factor_between(found, wanted)
    if factor is not None:
        force = wanted.powers[2] == 1 and found.powers[0] == wanted.powers[0]
        return factor / geometry.area if geometry.area and force else factor
    ratio = found.factor / wanted.factor
    gap = tuple(w - f for w, f in zip(wanted.powers, found.powers, strict=True))
    hint, kind = "Give a plain number." if unit == "1" else f"Give a unit of the dimension of {unit!r}.", ""
    if gap[1:3] == (0, 0):
        turns = {(-1, 0): -1, (1, -1): 1, (-2, 1): -2}.get((gap[0], gap[3]))  # torque; angle; torque over angle
        if found.powers == (0, 0, 1, 0) and wanted.powers == (-1, 0, 1, 0) and not geometry.radius:
            hint = "A stiffness is a force over a length, as in '30 N/mm'."
        elif turns is not None and (found.powers[2], found.powers[3]) != (0, 0):
            if geometry.radius:
                return ratio * geometry.radius**turns / (geometry.area or 1.0 if wanted.powers[2] else 1.0)
            hint = f'A rotary rig needs its radius, from which {unit} follow: [apparatus] radius = "25 mm"'
            kind = "unit"
        elif gap == (1, 0, 0, 0) and (found.powers[2] == 0 or wanted.powers == (-1, 0, 1, 0)):  # a strain for a length
            if geometry.thickness:  # a stress per strain is a stiffness
                return ratio * (SQUARE_MILLIMETRE / geometry.thickness if found.powers[2] else geometry.thickness)
            strain = "stress per strain" if found.powers[2] else "strain"
            hint = f'A {strain} needs the layer\'s thickness, from which {unit} follow: [apparatus] thickness = "4 mm"'
            if found.powers[2]:
                hint = f"A stiffness is '30 MPa/mm', '0.21 N/um' or, of friction over a length, '1e-3 1/um'. {hint}"
            kind = "unit"
    prefix = f"{where}: " if where else ""
    said = f"{prefix}{written!r} measures {describe(found.powers)}, not {describe(wanted.powers)}"
    raise SrfError(said, hint, kind=kind)


def same_dimension(text: str, unit: str) -> bool:
    """Return whether the unit `text` measures what `unit` does; raises SrfError for no unit at all."""
    return factor_between(find_unit(text), find_unit(unit)) is not None


def factor_between(source: Unit, target: Unit) -> float | None:
    """Return what a number in `source` is multiplied by to be in `target`, None where they measure different things."""
    ratio, gap = source.factor / target.factor, source.powers[0] - target.powers[0]
    if source.powers[1:] != target.powers[1:]:
        return None
    if gap == 0:
        return tidy(ratio)  # N/mm -> N/um is 1e-3, not 0.0010000000000000002
    if source.powers[2] == 1 and gap == -2:  # a stress for a force
        return tidy(ratio * SQUARE_MILLIMETRE)
    if source.powers[2] == 1 and gap == 2:
        return tidy(ratio / SQUARE_MILLIMETRE)
    return None


def is_stress(text: str) -> bool:
    """Return whether a unit is one of stress, or of stress per length, and not of force."""
    um, s, newton, _ = find_unit(text).powers
    return newton == 1 and s == 0 and um in (-2, -3)


def tidy(value: float) -> float:
    """Return the number of twelve digits that `value` misses by rounding alone, else `value` itself."""
    round_number = float(f"{value:.12g}")
    return round_number if math.isclose(value, round_number, rel_tol=1e-14) else value


def find_unit(text: str, *, where: str = "", common: bool = False) -> Unit:
    """Return the unit that `text` names, a product of `common` ones only where these are to do; raises SrfError for none.

    The error begins with `where`.
    """
    if len(text) > LONGEST_QUANTITY:
        raise SrfError(f"{where}: {len(text)} characters are no unit".lstrip(": "), "Write a unit as in N/um, um/s.")
    spelled = text.strip().replace("**", "^").replace("μ", "u").replace("µ", "u")
    spelled = _SPELLED.get(spelled.lower(), spelled)
    if spelled in _TABLE:
        return _TABLE[spelled]
    prefix = f"{where}: " if where else ""
    if not _UNIT.fullmatch(spelled):
        raise SrfError(f"{prefix}{text!r} is not a unit", "Write a unit as in N/um, um/s or kg*m/s^2.")
    factor, powers, over = 1.0, [0, 0, 0, 0], 1
    for sign, word, power in _PART.findall(spelled):
        over = -1 if sign == "/" else 1
        known = word if word in _TABLE else _SPELLED.get(word.lower(), word)
        if known not in _TABLE:
            if common:
                raise SrfError(f"{prefix}{text!r} is no common unit", did_you_mean(word, _TABLE), kind="unit")
            return _from_pint(spelled, prefix, word)
        exponent = over * int(power or 1)
        factor *= _TABLE[known].factor ** exponent
        powers = [p + exponent * q for p, q in zip(powers, _TABLE[known].powers, strict=True)]
    if not 1e-100 < factor < 1e100:
        raise SrfError(f"{prefix}{text!r} is no unit of use", "Write a unit as in N/um, um/s.")
    um, s, newton, rad = powers
    return Unit(factor, (um, s, newton, rad))


def _from_pint(text: str, prefix: str, word: str) -> Unit:
    """Return a unit that the table lacks, as pint knows it; `word` is the name in it that is unknown here."""
    try:
        registry = _pint_registry()
    except ImportError as error:
        hint = f'{did_you_mean(word, _TABLE)}, products and powers of these; more with pip install "srfcli[units]"'
        raise SrfError(f"{prefix}unknown unit {text!r}", hint, kind="unit") from error
    try:
        quantity = registry.Quantity(1.0, registry.Unit(text)).to_base_units()
        powers = {name: float(power) for name, power in quantity.unit_items()}
        factor = float(quantity.magnitude)
    except Exception as error:  # pint raises its own, tokenizer and arithmetic errors for a bad unit
        raise SrfError(f"{prefix}unknown unit {text!r}", did_you_mean(word, _TABLE), kind="unit") from error
    mass, metre = powers.pop("kilogram", 0.0), powers.pop("meter", 0.0)
    second, radian = powers.pop("second", 0.0), powers.pop("radian", 0.0)
    exponents = (metre - mass, second + 2 * mass, mass, radian)  # kg = 1e-6 N s^2/um
    if powers or any(not p.is_integer() for p in exponents):
        raise SrfError(f"{prefix}{text!r} is not a mechanical unit", "Write it in um, s, N, kg, deg or products of these.")
    um, s, newton, rad = (int(p) for p in exponents)
    if not 1e-100 < factor < 1e100 or abs(um) + abs(mass) > 20:
        raise SrfError(f"{prefix}{text!r} is no unit of use", "Write it in um, s, N, kg or products of these.")
    return Unit(factor * 1e6 ** (um + mass) / 1e6**mass, (um, s, newton, rad))


@cache
def _pint_registry() -> Any:
    import pint

    return pint.UnitRegistry()


# Dimensions of formulas: enough to see whether a law adds a length to a time.

Dimension = tuple[Fraction, ...]  # powers of um, s, N; an angle is a number
NONE: Dimension = (Fraction(0), Fraction(0), Fraction(0))
SYMBOL_UNITS = {"v": "um/s", "phi": "s", "mu": "1", "mu_dot": "1/s", "W": "N", "W_dot": "N/s", "F_dot_over_W": "1/s"}
QUANTITY_UNITS = {"mu": "1", "rate": "1", "term": "1", "kappa": "N/um"}


def dimension(unit: str) -> Dimension:
    """Return the dimension of a unit in a formula; raises SrfError for no unit."""
    return tuple(map(Fraction, find_unit(unit).powers[:3]))


def describe(powers: Sequence[int | Fraction]) -> str:
    """Return powers of um, s, N and, where they count, rad as text: `um/s`, `1` for none."""
    listed = list(zip(("um", "s", "N", "rad"), powers, strict=False))
    over = [n + (f"^{d}" if d != 1 else "") for n, d in listed if d > 0]
    under = [n + (f"^{-d}" if d != -1 else "") for n, d in listed if d < 0]
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
        factors = [dimension_of(term, units) for term in expr.args]
        return tuple(sum(powers, Fraction(0)) for powers in zip(*factors, strict=True))
    if isinstance(expr, sympy.Pow) and expr.exp.is_Rational:
        return tuple(power * Fraction(int(expr.exp.p), int(expr.exp.q)) for power in dimension_of(expr.base, units))
    for argument in expr.args:  # functions, and powers with an exponent that varies
        dimension = dimension_of(argument, units)
        if dimension != NONE:
            name = "a power" if isinstance(expr, sympy.Pow) else expr.func.__name__
            raise SrfError(f"{name} is taken of {argument}, which has the unit {describe(dimension)}, not 1")
    return NONE
