"""Numbers and units as an experiment's author writes them, to um, s, N."""

from __future__ import annotations

import math

from srfcli.errors import SrfError
from srfcli.units import factor_between, find_unit, split_quantity

NAMES = ("um", "s", "N", "rad")


def unit_factor(text: str, base: str) -> float:
    """Return what a number in the unit `text` is multiplied by to be in `base`; raises SrfError for another dimension.

    A stress counts as the force on 1 mm^2, so that 1 MPa is 1 N.
    """
    found, wanted = find_unit(text), find_unit(base)
    factor = factor_between(found, wanted)
    if factor is None:
        raise SrfError(
            f"{text!r} measures {_described(found.powers)}, not {_described(wanted.powers)}",
            f"Give a unit of the dimension of {base!r}.",
        )
    return factor


def parse_quantity(text: str, base: str, *, name: str) -> float:
    """Return the number that `text` states, in `base`; a bare number is in that unit."""
    number, written = split_quantity(text, name=name, example=f"0.5 {base}" if base != "1" else "0.5")
    value = number * unit_factor(written, base) if written else number
    if not math.isfinite(value):
        raise SrfError(f"{name} = {text!r} is too large", "Write a finite number, as in 1e-3.")
    return value


def same_dimension(text: str, base: str) -> bool:
    """Return whether the unit `text` measures what `base` does; raises SrfError for no unit at all."""
    return factor_between(find_unit(text), find_unit(base)) is not None


def _described(powers: tuple[int, ...]) -> str:
    over = [n + (f"^{p}" if p != 1 else "") for n, p in zip(NAMES, powers, strict=True) if p > 0]
    under = [n + (f"^{-p}" if p != -1 else "") for n, p in zip(NAMES, powers, strict=True) if p < 0]
    return "/".join(["*".join(over) or "1", *under])
