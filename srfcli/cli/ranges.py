"""Ranges and lists of values on the command line: `--over V=1:100:60:log`, `--over V=1,2,5`, `--V 1,7,25`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import click

from srfcli.errors import SrfError
from srfcli.laws import Parameter
from srfcli.settings import check_value, require_parameter
from srfcli.units import convert, parse_quantity, split_quantity, tidy, to_base

DEFAULT_POINTS = 60
MAX_POINTS = 1_000_000
FORM = "Write NAME=LOW:HIGH:POINTS[:log|lin] or NAME=a,b,c, as in V=1:100:60, V=1,2,5 or 'V=1:100 um/s:60'."


@dataclass(frozen=True)
class Range:
    """The values that a parameter runs over: `values` as listed, or `n` from `lo` to `hi`, `spacing` log or lin.

    Numbers are in `unit` if one was written, else in the parameter's declared unit; `fitted` makes it the declared one.
    """

    name: str
    values: tuple[float, ...] | None = None
    lo: float = math.nan
    hi: float = math.nan
    n: int = DEFAULT_POINTS
    spacing: str = "lin"
    unit: str = ""

    def points(self) -> list[float]:
        """Return every value, the ends exactly as given."""
        if self.values is not None:
            return list(self.values)
        steps = self.n - 1
        if self.spacing == "log":
            ratio = math.log(self.hi / self.lo)
            inner = [tidy(self.lo * math.exp(ratio * i / steps)) for i in range(1, steps)]
        else:
            inner = [tidy(self.lo + (self.hi - self.lo) * i / steps) for i in range(1, steps)]
        return [self.lo, *inner, self.hi]

    def fitted(self, parameters: Sequence[Parameter], *, where: str = "this system") -> Range:
        """Return the range in declared units; raises SrfError for an unknown name or a value out of bounds."""
        parameter = require_parameter(self.name, parameters, where=where)

        def fit(number: float) -> float:
            declared = convert(number, self.unit, parameter.unit, name=self.name) if self.unit else number
            return check_value(parameter, declared)

        if self.values is not None:
            return replace(self, values=tuple(map(fit, self.values)), unit=parameter.unit)
        return replace(self, lo=fit(self.lo), hi=fit(self.hi), unit=parameter.unit)

    def base_points(self, parameters: Sequence[Parameter], *, where: str = "this system") -> list[float]:
        """Return every value in um, s, N and radians."""
        fitted = self.fitted(parameters, where=where)
        return [to_base(value, fitted.unit) for value in fitted.points()]


def parse_over(text: str) -> Range:
    """Return the range that NAME=LOW:HIGH[:POINTS[:log|lin]] or NAME=a,b,c describes; one unit holds for all.

    Spacing is logarithmic unless said where the ends are positive and a decade or more apart. Raises SrfError.
    """
    name, equals, body = (part.strip() for part in text.partition("="))
    parts = name.split("/")  # K/W0 is a ratio, for the commands that take one
    if not (equals and body and len(parts) <= 2 and all(part.isidentifier() for part in parts)):
        raise SrfError(f"--over {text!r} is not a range", FORM)
    if ":" not in body:
        values, unit = _numbers(name, body.split(","), text)
        return Range(name, values=values, unit=unit)
    fields = [part.strip() for part in body.split(":")]
    if len(fields) > 4:
        raise SrfError(f"--over {text!r} has {len(fields)} fields between colons, not 2 to 4", FORM)
    (lo, hi), unit = _numbers(name, fields[:2], text)
    if not lo < hi:
        raise SrfError(f"--over {text!r}: its low end {lo:g} is not below its high end {hi:g}", FORM)
    spacing = fields[3] if len(fields) == 4 else "log" if lo > 0 and hi >= 10 * lo else "lin"
    if spacing not in ("log", "lin"):
        raise SrfError(f"--over {text!r}: unknown spacing {spacing!r}", "Known: lin, log")
    if spacing == "log" and lo <= 0:
        raise SrfError(f"--over {text!r}: a logarithmic range cannot reach {lo:g}", "Begin above 0, or end it in :lin.")
    return Range(name, lo=lo, hi=hi, n=_count(fields, text), spacing=spacing, unit=unit)


def _numbers(name: str, parts: Sequence[str], text: str) -> tuple[tuple[float, ...], str]:
    pairs = []
    for part in parts:
        try:
            pairs.append(split_quantity(part, name=name))
        except SrfError as error:
            raise SrfError(f"--over {text!r}: {part.strip()!r} is not a number", FORM) from error
    units = sorted({unit for _, unit in pairs if unit})
    if len(units) > 1:
        hint = "Write the unit once, after the last number."
        raise SrfError(f"--over {text!r} mixes the units {' and '.join(units)}", hint)
    return tuple(number for number, _ in pairs), units[0] if units else ""


def _count(fields: Sequence[str], text: str) -> int:
    if len(fields) < 3:
        return DEFAULT_POINTS
    digits = fields[2]
    if not (digits.isascii() and digits.isdecimal() and len(digits) < 8 and 2 <= int(digits) <= MAX_POINTS):
        hint = f"Write a whole number from 2 to {MAX_POINTS}, as in V=1:100:60."
        raise SrfError(f"--over {text!r}: {digits!r} is not a number of points", hint)
    return int(digits)


def parse_overs(texts: Sequence[str]) -> tuple[Range, ...]:
    """Return the ranges that several --over describe; raises SrfError if two are over the same parameter."""
    ranges = tuple(map(parse_over, texts))
    for index, made in enumerate(ranges):
        if made.name in {r.name for r in ranges[:index]}:
            hint = "Give one range for each parameter, or list values: V=1,2,5."
            raise SrfError(f"--over {made.name} is given twice", hint)
    return ranges


def over_option(*, default: Sequence[str] = (), help: str = "") -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add --over NAME=..., repeatable; the command gets `over`, a tuple of Range, `default` parsed if none is given."""
    text = help or "Values to run over: NAME=LOW:HIGH[:POINTS[:log|lin]] or NAME=a,b,c; repeat for a second parameter."
    return click.option(
        "--over",
        multiple=True,
        default=list(default),
        show_default=", ".join(default) if default else False,
        metavar="NAME=RANGE",
        help=text,
        callback=lambda _context, _parameter, texts: parse_overs(texts),
    )


def values_option(
    parameter: Parameter, *, default: Sequence[float] | None = None, about: str = ""
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add --NAME for a list of values, `--V 1,7,25` or repeated, with or without unit.

    The command gets `NAME`, a tuple of floats in the declared unit, checked against the bounds, or None if neither
    the option nor a `default` was given. Text and unit of the help come from `parameter`.
    """
    unit = "" if parameter.unit == "1" else f", in {parameter.unit}"
    meaning = about or parameter.about or parameter.name
    return click.option(
        f"--{parameter.name}",
        parameter.name,
        multiple=True,
        metavar="VALUES",
        help=f"{meaning[:1].upper()}{meaning[1:]}{unit}; several as a,b,c.",
        callback=lambda _context, _option, texts: parse_values(texts, parameter) if texts else _default(default),
    )


def _default(default: Sequence[float] | None) -> tuple[float, ...] | None:
    return None if default is None else tuple(default)


def parse_values(texts: Sequence[str], parameter: Parameter) -> tuple[float, ...]:
    """Return the numbers in comma-separated `texts`, in the declared unit; the last one's unit holds for its list."""
    found = []
    for text in texts:
        parts = [part.strip() for part in text.split(",")]
        shared = split_quantity(parts[-1], name=parameter.name)[1]
        for part in parts:
            number, own = split_quantity(part, name=parameter.name)
            written = f"{number!r} {own or shared}".strip()
            found.append(check_value(parameter, parse_quantity(written, parameter.unit, name=parameter.name)))
    return tuple(found)
