"""Sympy expressions as NumPy source: small powers as products, Python's keywords renamed."""

from __future__ import annotations

import keyword

import sympy as sp
from sympy.printing.numpy import NumPyPrinter

FUNCTIONS = (
    "arcsinh",
    "arctan",
    "cos",
    "cosh",
    "exp",
    "expm1",
    "log",
    "log1p",
    "pi",
    "sin",
    "sinh",
    "sqrt",
    "tan",
    "tanh",
)


class NumPyText(NumPyPrinter):
    """NumPy source with products in place of small integer powers, which NumPy computes by pow()."""

    def __init__(self) -> None:
        super().__init__({"fully_qualified_modules": False, "allow_unknown_functions": True})

    def _print_Pow(self, expr: sp.Pow, rational: bool = False, sqrt: str = "sqrt") -> str:
        base, exponent = expr.as_base_exp()
        if exponent.is_Integer and 2 <= abs(int(exponent)) <= 4:
            inner = self.parenthesize(base, 60)
            product = "*".join([inner] * abs(int(exponent)))
            return f"({product})" if exponent > 0 else f"(1/({product}))"
        if exponent == -1:
            return f"(1/{self.parenthesize(base, 60)})"
        if exponent == sp.S.Half:
            return f"sqrt({self._print(base)})"
        return f"{self.parenthesize(base, 60)}**{self.parenthesize(exponent, 60)}"

    def _print_log1p(self, expr: sp.Expr) -> str:
        return f"log1p({self._print(expr.args[0])})"

    def _print_expm1(self, expr: sp.Expr) -> str:
        return f"expm1({self._print(expr.args[0])})"

    def _print_LambertW(self, expr: sp.Expr) -> str:
        return f"lambertw({self._print(expr.args[0])})"

    def _print_lut(self, expr: sp.Expr) -> str:
        number, argument = expr.args
        return f"{type(expr).__name__}(p, {int(number)}, {self._print(argument)})"

    _print_lut1 = _print_lut2 = _print_lut

    def _print_Pi(self, expr: sp.Expr) -> str:
        return "pi"


def python_name(name: str) -> str:
    """Return `name` as it is written in generated code: `lambda` becomes `lambda_`."""
    return f"{name}_" if keyword.iskeyword(name) else name


def renamed(expression: sp.Expr) -> sp.Expr:
    """Return `expression` with its symbols named as generated code names them."""
    names = {s: sp.Symbol(python_name(s.name)) for s in expression.free_symbols if python_name(s.name) != s.name}
    return expression.xreplace(names)


def numpy_text(expression: sp.Expr) -> str:
    """Return `expression` as generated code writes it."""
    return NumPyText().doprint(renamed(expression))
