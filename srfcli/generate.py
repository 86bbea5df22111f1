"""Sympy expressions to one readable NumPy module: original names, shared subexpressions, the same text every time."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import sympy as sp
from sympy.printing.numpy import NumPyPrinter

from srfcli.closed_limits import closed_limits, in_law_parameters
from srfcli.derive import Linearisation, linearise
from srfcli.expression import symbol
from srfcli.system import Equations, System, tidy

FUNCTIONS = ("arcsinh", "arctan", "cos", "cosh", "exp", "expm1", "log", "log1p", "pi", "sin", "sinh", "sqrt", "tan", "tanh")


class _Printer(NumPyPrinter):
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

    def _print_Pi(self, expr: sp.Expr) -> str:
        return "pi"


def python_name(name: str) -> str:
    """Return `name` as it is written in generated code: `lambda` becomes `lambda_`."""
    import keyword

    return f"{name}_" if keyword.iskeyword(name) else name


class _Writer:
    """Collects functions of (head, x, p) and writes each with its own common subexpressions."""

    def __init__(self, system: System, equations: Equations) -> None:
        self.system, self.equations = system, equations
        self.parameters = [p.name for p in system.parameters]
        self.printer = _Printer()
        self.parts: list[str] = []

    def function(
        self,
        name: str,
        doc: str,
        outputs: Sequence[tuple[str, sp.Expr]],
        *,
        head: Sequence[str] = (),
        tail: Sequence[str] = (),
        vectors: Sequence[str] = (),
        shape: str = "",
        state: bool = True,
        dtype: str | None = None,
    ) -> None:
        """Write one function; `outputs` are (index text, expression), index '' returns the expression itself."""
        outputs = [(i, e) for i, e in outputs if e != 0 or i in ("", "0")]
        shared, reduced = sp.cse([e for _, e in outputs], symbols=sp.numbered_symbols("_"), order="canonical")
        used = {str(s) for e in [*(e for _, e in shared), *reduced] for s in e.free_symbols}
        arguments = [*head, *(["x"] if state else []), *tail, "p", *(f"_{w}" for w in vectors)]  # a law may have a parameter c
        lines = [f"def {name}({', '.join(arguments)}):", f'    """{doc}"""']
        lines += [f"    {line}" for line in self._unpack(used - set(tail), vectors, state)]
        lines += [f"    {s} = {self.text(e)}" for s, e in shared]
        like = [*head, *(["x[..., 0]"] if state else []), *tail, *(f"_{w}[..., 0]" for w in vectors)]
        like += [] if state else ["*p"]
        if len(outputs) == 1 and outputs[0][0] == "":
            lines.append(f"    return _empty(({', '.join(like)},), ()) + {self.printer.parenthesize(self._renamed(reduced[0]), 40)}")
        else:
            lines.append(f"    out = _empty(({', '.join(like)},), {shape})")
            lines += [f"    out[..., {i}] = {self.text(e)}" for (i, _), e in zip(outputs, reduced, strict=True)]
            lines.append("    return out")
        self.parts.append("\n".join(lines))

    def text(self, expression: sp.Expr) -> str:
        return self.printer.doprint(self._renamed(expression))

    @staticmethod
    def _renamed(expression: sp.Expr) -> sp.Expr:
        renamed = {s: sp.Symbol(python_name(s.name)) for s in expression.free_symbols if python_name(s.name) != s.name}
        return expression.xreplace(renamed)

    def _unpack(self, used: set[str], vectors: Sequence[str], state: bool) -> Iterable[str]:
        for i, name in enumerate(self.parameters):
            if name in used:
                yield f"{python_name(name)} = p[{i}]"
        if state:
            for i, (s, log) in enumerate(zip(self.equations.unknowns, self.equations.logarithmic, strict=True)):
                if str(s) in used:
                    yield f"{s} = exp(x[..., {i}])" if log else f"{s} = x[..., {i}]"
        for vector in vectors:
            for i in range(len(self.equations.unknowns)):
                if f"_{vector}{i}" in used:
                    yield f"_{vector}{i} = _{vector}[..., {i}]"


def generate(system: System) -> str:
    """Return the source of the module that computes everything numerical about `system`."""
    eq = system.equations
    linear = linearise(system)
    writer = _Writer(system, eq)
    _write_statics(writer, eq, linear)
    _write_closed(writer, system)
    _write_rates(writer, eq)
    _write_cycle(writer, eq)
    body = "\n\n\n".join(writer.parts)
    names = [f for f in FUNCTIONS if re.search(rf"\b{f}\b", body)]
    return _HEAD.format(
        title=system.title,
        names=", ".join(names),
        helpers="".join(h for name, h in _HELPERS.items() if f"{name}(" in body),
        states=_tuple(eq.names),
        logarithmic=repr(tuple(bool(b) for b in eq.logarithmic)),
        parameters="\n".join(f"    {_parameter(p)}," for p in system.parameters),
        elastic=system.elastic,
        inertia=system.inertia,
        polynomial=linear.polynomial_degree,
        forms=textwrap.indent("\n".join(f'"{k}": {v!r},' for k, v in linear.names.items()), "    "),
    ) + body + "\n\n\n" + _tables(writer.parameters)


def _parameter(p: Any) -> str:
    bounds = [repr(float(b)).replace("inf", 'float("inf")') for b in (p.lower, p.upper)]
    return f"({p.name!r}, {float(p.default)!r}, {p.unit!r}, {bounds[0]}, {bounds[1]}, {p.about!r})"


def _tuple(names: Sequence[str]) -> str:
    return "(" + ", ".join(f'"{n}"' for n in names) + ",)"


def _tables(parameters: Sequence[str]) -> str:
    rows = "\n".join(f'    "{n}": cycle_d_{python_name(n)},' for n in parameters)
    bilinear = "\n".join(f'    "{n}": cycle_bilinear_d_{python_name(n)},' for n in parameters)
    return f"CYCLE_PARAMETER = {{\n{rows}\n}}\n\nCYCLE_BILINEAR_PARAMETER = {{\n{bilinear}\n}}\n"


def _write_statics(writer: _Writer, eq: Equations, linear: Linearisation) -> None:
    n = len(eq.unknowns)
    steady = [(str(i), sp.log(e) if log else e) for i, (e, log) in enumerate(zip(eq.steady, eq.logarithmic, strict=True))]
    writer.function("steady", "Steady sliding at V under W0.", steady, shape=f"({n},)", state=False)
    at_rest = dict(zip(eq.unknowns, eq.steady, strict=True)) | {symbol("W"): symbol("W0")}
    writer.function("steady_friction", "Friction coefficient in steady sliding at V.", [("", eq.mu.subs(at_rest))], state=False)
    slopes = [("0", linear.mu_v), *((str(i + 1), e) for i, e in enumerate(linear.mu_phi))]
    writer.function("slopes", "d mu/d ln v, then d mu/d ln phi for each state, in steady sliding.", slopes,
                    shape=f"({len(slopes)},)", state=False)
    writer.function("characteristic", "Real coefficients a_0..a_n of the characteristic polynomial in s.",
                    [(str(i), e) for i, e in enumerate(linear.characteristic)], shape=f"({len(linear.characteristic)},)", state=False)
    if linear.hurwitz is not None:
        writer.function("hurwitz_in_load", "Coefficients, lowest first, of the last Hurwitz determinant but one in W0.",
                        [(str(i), e) for i, e in enumerate(linear.hurwitz)], shape=f"({len(linear.hurwitz)},)", state=False)


def _write_closed(writer: _Writer, system: System) -> None:
    """Write the critical load and frequency that have a closed form; the functions that have none are left out."""
    limits = closed_limits(system)
    if limits is None:
        return
    ratio = sp.Function("positive_ratio")
    omega = None if limits.omega_squared is None else sp.sqrt(ratio(*sp.fraction(limits.omega_squared, exact=True)))
    outputs = [
        ("closed_frequency", "Omega_c in rad/s, exact; nan where friction strengthens.", omega),
        ("closed_load", "Critical W0 in N, exact for any kappa and M; nan where there is none.", limits.load),
        ("limit_load", "Critical W0 in N for kappa to infinity; nan where there is none.", limits.limit_load),
        ("quasistatic_load", "Critical W0 in N for kappa to infinity without inertia.", limits.quasistatic_load),
    ]
    Omega_squared = symbol("Omega_c") ** 2
    for name, doc, value in outputs:
        if value is None or (value.has(symbol("Omega_c")) and limits.omega_squared is None):
            continue
        if name != "closed_frequency":
            if limits.omega_squared is not None:
                value = value.subs(Omega_squared, limits.omega_squared)
            value = ratio(*sp.fraction(value, exact=True))  # exact: exp(-V/Vc) stays above
        writer.function(name, doc, [("", in_law_parameters(system, value))], state=False)


def numpy_text(expression: sp.Expr) -> str:
    """Return `expression` as generated code writes it."""
    return _Printer().doprint(_Writer._renamed(expression))


def _write_rates(writer: _Writer, eq: Equations) -> None:
    """Write what a simulator needs (any drive and load) and the multilinear forms of the normal form at rest."""
    n = range(len(eq.unknowns))
    rates = eq.rates
    inputs = ("V", "W", "W_dot")
    shape, square = f"({len(n)},)", f"({len(n)}, {len(n)})"
    writer.function("rates", "dx/dt under drive V, imposed load W and its rate W_dot.",
                    [(str(i), e) for i, e in enumerate(rates)], tail=inputs, shape=shape)
    writer.function("rates_jacobian", "d(rates)/dx.",
                    [(f"{i}, {j}", tidy(eq.derivative(rates[i], j))) for i in n for j in n], tail=inputs, shape=square)
    writer.function("friction", "Friction coefficient.", [("", eq.mu)], tail=inputs)
    writer.function("elongation", "Spring elongation u.", [("", eq.spring)], tail=inputs)
    at_rest = {symbol("W"): symbol("W0"), symbol("W_dot"): sp.S.Zero}
    calm = [e.subs(at_rest) for e in rates]
    a, b, c = ([sp.Symbol(f"_{k}{i}") for i in n] for k in "abc")
    first = [_directional(eq, e, a) for e in calm]
    second = [_directional(eq, e, b) for e in first]
    third = [_directional(eq, e, c) for e in second]
    writer.function("second", "Second derivative of the rates at constant load, in the directions a, b.",
                    [(str(i), e) for i, e in enumerate(second)], vectors=("a", "b"), shape=shape)
    writer.function("third", "Third derivative of the rates at constant load, in the directions a, b, c.",
                    [(str(i), e) for i, e in enumerate(third)], vectors=("a", "b", "c"), shape=shape)


def _directional(eq: Equations, expression: sp.Expr, direction: Sequence[sp.Symbol]) -> sp.Expr:
    return sum((eq.derivative(expression, j) * d for j, d in enumerate(direction)), sp.S.Zero)


def _write_cycle(writer: _Writer, eq: Equations) -> None:
    """Write the field over one forcing period, tau = f t in [0, 1], and what continuation differentiates."""
    n = range(len(eq.unknowns))
    phase, f, eps, W0 = sp.Symbol("tau"), symbol("f"), symbol("eps"), symbol("W0")
    angle = 2 * sp.pi * phase
    load = {symbol("W"): W0 * (1 + eps * sp.cos(angle)), symbol("W_dot"): -2 * sp.pi * f * W0 * eps * sp.sin(angle)}
    field = [e.subs(load) / f for e in eq.rates]
    shape, square = f"({len(n)},)", f"({len(n)}, {len(n)})"
    jacobian = [[tidy(eq.derivative(e, j)) for j in n] for e in field]
    head = ("tau",)
    writer.function("cycle", "dx/dtau over one forcing period, W = W0 (1 + eps cos 2 pi tau).",
                    [(str(i), e) for i, e in enumerate(field)], head=head, shape=shape)
    writer.function("cycle_jacobian", "d(cycle)/dx.",
                    [(f"{i}, {j}", jacobian[i][j]) for i in n for j in n], head=head, shape=square)
    writer.function("cycle_friction", "Friction coefficient.", [("", eq.mu.subs(load))], head=head)
    writer.function("cycle_load", "Normal load W.", [("", eq.load.subs(load))], head=head)
    writer.function("cycle_elongation", "Spring elongation u.", [("", eq.spring.subs(load))], head=head)
    w, a = ([sp.Symbol(f"_{k}{i}") for i in n] for k in "wa")
    form = sum((w[i] * jacobian[i][j] * a[j] for i in n for j in n), sp.S.Zero)
    writer.function("cycle_bilinear", "Gradient over x of w . (d(cycle)/dx) a.",
                    [(str(k), eq.derivative(form, k)) for k in n], head=head, vectors=("w", "a"), shape=shape)
    for name in writer.parameters:
        q = symbol(name)
        writer.function(f"cycle_d_{python_name(name)}", f"d(cycle)/d({name}).",
                        [(str(i), sp.diff(e, q)) for i, e in enumerate(field)], head=head, shape=shape)
        writer.function(f"cycle_bilinear_d_{python_name(name)}", f"d/d({name}) of w . (d(cycle)/dx) a.",
                        [("", sp.diff(form, q))], head=head, vectors=("w", "a"))


_LAMBERTW = '''

def lambertw(x):
    """Principal branch, real where its argument is real."""
    from scipy.special import lambertw as complex_lambertw

    value = complex_lambertw(x)
    return value if iscomplexobj(x) else value.real
'''

_RATIO = '''

def positive_ratio(above, below):
    """above/below where that is positive, else nan."""
    from numpy import nan, where

    ratio = above/where(below == 0, nan, below)
    return where(ratio > 0, ratio, nan)
'''

_HELPERS = {"lambertw": _LAMBERTW, "positive_ratio": _RATIO}

_HEAD = '''"""Generated by srf from {title}.

Arrays of any leading shape, real or complex; x[..., i] are the STATES, p[i] the PARAMETERS, units um, s, N.
"""

from numpy import iscomplexobj, result_type, zeros, broadcast_shapes, shape
from numpy import {names}

STATES = {states}
LOGARITHMIC = {logarithmic}
ELASTIC = {elastic}
INERTIA = {inertia}
HOPF_DEGREE = {polynomial}
PARAMETERS = (
{parameters}
)
NAMES = {{
{forms}
}}


def _empty(like, trailing):
    """Zeros of the shape that the arguments share, with `trailing` axes added."""
    shapes = [shape(a) for a in like]
    common = shapes[0] if shapes.count(shapes[0]) == len(shapes) else broadcast_shapes(*shapes)
    return zeros(common + trailing, dtype=result_type(float, *like))
{helpers}

'''
