"""Formulas as text, LaTeX and Python, in the field's letters."""

from __future__ import annotations

import re

import sympy as sp
from sympy.printing.pretty.pretty import PrettyPrinter
from sympy.printing.str import StrPrinter

from srfcli.expression import expm1, log1p

_NAMES = {
    "W_dot": r"\dot{W}",
    "mu_dot": r"\dot{\mu}",
    "F_dot_over_W": r"\dot{F}/W",
    "mu_v": r"\mu_v",
    "mu_phi": r"\mu_\phi",
    "kappa_W": r"\kappa_W",
    "Omega_c": r"\Omega_c",
    "eps": r"\epsilon",
    "angle": r"\theta",
    "phi": r"\phi",
}
_GREEK = (
    "alpha",
    "beta",
    "gamma",
    "delta",
    "epsilon",
    "eta",
    "kappa",
    "lambda",
    "mu",
    "phi",
    "rho",
    "sigma",
    "tau",
    "theta",
)


class _Text(StrPrinter):
    """Sympy's plain text with i for the imaginary unit."""

    def _print_ImaginaryUnit(self, expr: sp.Expr) -> str:
        return "i"


def latex_name(name: str) -> str:
    r"""Return a name in LaTeX: Vsat is V_{sat}, D0 is D_0, mu_phi is \mu_\phi; a final ' stays."""
    bare = name.rstrip("'")
    primes = name[len(bare) :]
    if bare in _NAMES:
        return _NAMES[bare] + primes
    match = re.fullmatch("(" + "|".join(_GREEK) + r"|[A-Za-z])_?([A-Za-z0-9]*)", bare)
    if match is None:
        match = re.fullmatch(r"([A-Za-z])([A-Za-z0-9_]*)", bare)
    if match is None:
        return r"\mathrm{" + bare.replace("_", r"\_") + "}" + primes
    head, tail = match.groups()
    letter = f"\\{head}" if head in _GREEK else head
    tail = tail.replace("_", r"\_")
    if not tail:
        return letter + primes
    return f"{letter}_{{{tail}}}{primes}" if len(tail) > 1 else f"{letter}_{tail}{primes}"


def latex(expression: sp.Expr) -> str:
    """Return a formula in LaTeX."""
    plain = _spelled(expression)
    names = {s: latex_name(s.name) for s in sorted(plain.free_symbols, key=str)}
    return sp.latex(plain, symbol_names=names, ln_notation=True)


def text(expression: sp.Expr) -> str:
    """Return a formula on one line of plain text, i the imaginary unit; the expression language reads it where it is real."""
    return _Text().doprint(expression)


def pretty(name: str, expression: sp.Expr) -> str:
    """Return `name` = formula over several lines in Unicode."""
    form = PrettyPrinter({"use_unicode": True, "wrap_line": False})._print(_spelled(expression))
    head = f"{name} = "
    lines = str(form).split("\n")
    return "\n".join(
        ((head if i == form.baseline else " " * len(head)) + line).rstrip() for i, line in enumerate(lines)
    )


def _spelled(expression: sp.Expr) -> sp.Expr:
    """Return `expression` with log1p and expm1 written out."""
    return expression.replace(log1p, lambda a: sp.log(1 + a)).replace(expm1, lambda a: sp.exp(a) - 1)
