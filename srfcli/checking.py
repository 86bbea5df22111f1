"""What checks of laws and of effects share: outcomes, and the numbers of formulas."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy
from scipy.special import lambertw

from srfcli.dimensions import parse_unit
from srfcli.errors import SrfError
from srfcli.expression import expm1, log1p
from srfcli.laws import Parameter

STEP = 1e-30  # complex step: no difference is taken, so it may be this small
Values = Mapping[str, Any]


def _lambertw(value: Any) -> Any:
    found = lambertw(value)  # complex also where the argument is real
    return found if np.iscomplexobj(value) else found.real


NUMPY: dict[Any, Callable[[Any], Any]] = {
    sympy.exp: np.exp,
    sympy.log: np.log,
    log1p: np.log1p,
    expm1: np.expm1,
    sympy.sin: np.sin,
    sympy.cos: np.cos,
    sympy.sinh: np.sinh,
    sympy.cosh: np.cosh,
    sympy.tanh: np.tanh,
    sympy.asinh: np.arcsinh,
    sympy.atan: np.arctan,
    sympy.LambertW: _lambertw,
}


@dataclass(frozen=True)
class Outcome:
    """The outcome of one check: `verdict` is ok, FAIL or skipped, `text` says what was found or why it was skipped."""

    check: str
    verdict: str
    text: str


class Skipped(Exception):
    """A check that does not apply; the text says why."""


def run_checks(steps: Sequence[tuple[str, Callable[[], str]]]) -> list[Outcome]:
    """Return the outcome of each named check, a function that returns what it found and raises SrfError or Skipped."""
    outcomes = []
    for name, step in steps:
        try:
            with np.errstate(all="ignore"):  # a formula outside its range shows as nan, and is reported as such
                outcomes.append(Outcome(name, "ok", step()))
        except Skipped as reason:
            outcomes.append(Outcome(name, "skipped", str(reason)))
        except SrfError as error:
            text = error.message + (f". {error.hint}" if error.hint else "")
            outcomes.append(Outcome(name, "FAIL", text))
        except (ArithmeticError, ValueError, TypeError) as error:  # numbers of a formula far outside floating point
            outcomes.append(Outcome(name, "FAIL", f"the formula cannot be computed: {error}"))
    return outcomes


def evaluate(expr: sympy.Expr, values: Values) -> Any:
    """Return the number of a formula at `values`, walking its tree: independent of sympy's derivatives and printers."""
    if expr.is_Symbol:
        return values[expr.name]
    if expr.is_Rational:
        return int(expr.p) / int(expr.q)
    if isinstance(expr, sympy.NumberSymbol):
        return float(expr)
    arguments = [evaluate(a, values) for a in expr.args]
    if isinstance(expr, sympy.Add):
        return sum(arguments[1:], start=arguments[0])
    if isinstance(expr, sympy.Mul):
        product = arguments[0]
        for factor in arguments[1:]:
            product = product * factor
        return product
    if isinstance(expr, sympy.Pow):
        return np.power(arguments[0], arguments[1])
    return NUMPY[expr.func](arguments[0])


def reference_values(parameters: Iterable[Parameter]) -> dict[str, float]:
    """Return the defaults of parameters in um, s, N."""
    return {p.name: p.default * parse_unit(p.unit).factor for p in parameters}
