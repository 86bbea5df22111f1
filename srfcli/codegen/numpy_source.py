"""Sympy expressions to one readable NumPy module: steps, shared subexpressions, the same text every time.

A derivative of a long formula written out grows out of hand (a minute to derive, megabytes to print); step by step it stays
a small multiple of the steps.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import sympy as sp

from srfcli.core.settings import Parameter
from srfcli.laws.expression import NUMPY_FUNCTIONS, NumPyText, python_name, renamed, symbol
from srfcli.symbolic.derive import Linearisation, closed_limits, in_law_parameters, linearise
from srfcli.symbolic.equations import Equations, equations_of, lut, lut1, partial_derivative, tidy
from srfcli.symbolic.system import RANDOM_FIELD, RUN_SYMBOLS, System

# Formulas in steps: named intermediate values, then outputs in them; derivatives are taken step by step.

LONG = 140  # operations: up to it formulas are kept whole, where common subexpressions read better

Step = tuple[sp.Symbol, sp.Expr]


@dataclass(frozen=True)
class Staged:
    """Outputs in terms of inputs and steps; each step is in terms of inputs and earlier steps."""

    outputs: tuple[sp.Expr, ...]
    steps: tuple[Step, ...] = ()
    names: Iterator[sp.Symbol] = field(default_factory=lambda: sp.numbered_symbols("_s"), compare=False, repr=False)

    def substituted(self, values: Mapping[sp.Expr, sp.Expr]) -> Staged:
        """Return the same with inputs replaced; the steps keep their names."""
        steps = tuple((s, e.xreplace(values)) for s, e in self.steps)
        return Staged(tuple(e.xreplace(values) for e in self.outputs), steps, self.names)

    def with_outputs(self, outputs: Sequence[sp.Expr]) -> Staged:
        """Return other outputs of the same steps."""
        return Staged(tuple(outputs), self.steps, self.names)

    def derivative(self, direction: Mapping[sp.Symbol, sp.Expr]) -> Staged:
        """Return the outputs' derivatives as the inputs change in `direction`: a rate for each input that does."""
        rates = dict(direction)
        added: list[Step] = []
        for step, formula in self.steps:
            rate = _total(formula, rates)
            if rate != 0:
                name = next(self.names)
                added.append((name, rate))
                rates[step] = name
        return Staged(tuple(_total(e, rates) for e in self.outputs), (*self.steps, *added), self.names)

    def needed(self) -> tuple[Step, ...]:
        """Return the steps that the outputs depend on, in order."""
        used = set().union(*(e.free_symbols for e in self.outputs))
        kept = []
        for step, formula in reversed(self.steps):
            if step in used:
                kept.append((step, formula))
                used |= formula.free_symbols
        return tuple(reversed(kept))


def staged(outputs: Sequence[sp.Expr]) -> Staged:
    """Return these formulas, whole where they are short, else cut at their common subexpressions."""
    if sum(sp.count_ops(e) for e in outputs) <= LONG:
        return Staged(tuple(outputs))
    names = sp.numbered_symbols("_s")
    steps, reduced = sp.cse(list(outputs), symbols=names, order="canonical")
    return Staged(tuple(reduced), tuple(steps), names)


def joined(parts: Sequence[Staged]) -> Staged:
    """Return the outputs of all `parts`, which have grown from one, and their steps, each once."""
    steps = dict(itertools.chain.from_iterable(p.steps for p in parts))
    return Staged(tuple(itertools.chain.from_iterable(p.outputs for p in parts)), tuple(steps.items()), parts[0].names)


def side_by_side(columns: Sequence[Staged]) -> Staged:
    """Return the entries of a matrix with these columns, which have grown from one, row by row."""
    rows = zip(*(column.outputs for column in columns), strict=True)
    return joined(columns).with_outputs(list(itertools.chain.from_iterable(rows)))


def _total(formula: sp.Expr, rates: Mapping[sp.Symbol, sp.Expr]) -> sp.Expr:
    moving = sorted(formula.free_symbols & rates.keys(), key=str)
    return sp.Add(*(partial_derivative(formula, s) * rates[s] for s in moving))


# Sympy expressions to one readable NumPy module: original names, shared subexpressions, the same text every time.


class Writer:
    """Collects functions of (head, x, p) and writes each with its own common subexpressions."""

    def __init__(self, system: System, equations: Equations) -> None:
        self.system, self.equations = system, equations
        self.declared = system.parameters
        self.printer = NumPyText()
        self.parts: list[str] = []
        self.texts: dict[sp.Expr, str] = {}

    @property
    def parameters(self) -> list[str]:
        """Return the parameters' names, in the order of p."""
        return [p.name for p in self.declared]

    def function(
        self,
        name: str,
        doc: str,
        outputs: Sequence[tuple[str, sp.Expr]],
        *,
        steps: Sequence[Step] = (),
        head: Sequence[str] = (),
        tail: Sequence[str] = (),
        vectors: Sequence[str] = (),
        shape: str = "",
        state: bool = True,
    ) -> None:
        """Write one function; `outputs` are (index text, expression), index '' returns the expression itself."""
        outputs = [(i, e) for i, e in outputs if e != 0 or i in ("", "0")]
        if steps:
            kept = Staged(tuple(e for _, e in outputs), tuple(steps))
            shared, reduced = list(kept.needed()), list(kept.outputs)
        else:
            shared, reduced = sp.cse([e for _, e in outputs], symbols=sp.numbered_symbols("_"), order="canonical")
        used = {str(s) for e in [*(e for _, e in shared), *reduced] for s in e.free_symbols}
        # with an underscore: a law may have a parameter c
        arguments = [*head, *(["x"] if state else []), *tail, "p", *(f"_{w}" for w in vectors)]
        lines = [f"def {name}({', '.join(arguments)}):", f'    """{doc}"""']
        lines += [f"    {line}" for line in self._unpack(used - set(tail), vectors, state)]
        lines += [f"    {s} = {self.text(e)}" for s, e in shared]
        like = [*head, *(["x[..., 0]"] if state else []), *tail, *(f"_{w}[..., 0]" for w in vectors)]
        like += [] if state else ["*p[: len(PARAMETERS)]"]
        if len(outputs) == 1 and outputs[0][0] == "":
            value = self.printer.parenthesize(renamed(reduced[0]), 40)
            lines.append(f"    return _empty(({', '.join(like)},), ()) + {value}")
        else:
            lines.append(f"    out = _empty(({', '.join(like)},), {shape})")
            lines += [f"    out[..., {i}] = {self.text(e)}" for (i, _), e in zip(outputs, reduced, strict=True)]
            lines.append("    return out")
        self.parts.append("\n".join(lines))

    def scalar(self, name: str, doc: str, formula: sp.Expr, **more: Any) -> None:
        """Write a function of one number."""
        self.function(name, doc, [("", formula)], **more)

    def vector(self, name: str, doc: str, formulas: Staged | Sequence[sp.Expr], **more: Any) -> None:
        """Write a function of one output for each formula."""
        outputs, steps = (formulas.outputs, formulas.steps) if isinstance(formulas, Staged) else (formulas, ())
        indexed = [(str(i), e) for i, e in enumerate(outputs)]
        self.function(name, doc, indexed, steps=steps, shape=f"({len(indexed)},)", **more)

    def matrix(self, name: str, doc: str, formulas: Staged, columns: int, **more: Any) -> None:
        """Write a function of a matrix of outputs, given row by row."""
        indexed = [(f"{k // columns}, {k % columns}", e) for k, e in enumerate(formulas.outputs)]
        rows = len(indexed) // columns
        self.function(name, doc, indexed, steps=formulas.steps, shape=f"({rows}, {columns})", **more)

    def text(self, expression: sp.Expr) -> str:
        if expression not in self.texts:  # the functions of one module share most of their steps
            self.texts[expression] = self.printer.doprint(renamed(expression))
        return self.texts[expression]

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
    """Return the source of the module that computes everything numerical about `system`; its effects all have a part there."""
    eq = equations_of(system, cyclic=bool(system.effects))
    still = _at_constant_load(eq) if system.effects else eq
    writer = Writer(system, still)
    if system.effects:
        writer.declared = tuple(p for p in system.parameters if p not in RUN_SYMBOLS)
        _write_statics_by_rates(writer, still)
        polynomial, forms = -1, {}
    else:
        linear = linearise(system)
        _write_statics(writer, eq, linear)
        _write_closed(writer, system)
        polynomial, forms = -1 if linear.hurwitz is None else len(linear.hurwitz) - 1, linear.names
    _write_rates(writer, still)
    _write_cycle(writer, eq)
    facts = {"ELASTIC": system.elastic, "INERTIA": system.inertia, "HOPF_DEGREE": polynomial}
    meanings = "\n".join(f'    "{k}": {v!r},' for k, v in forms.items())
    text = _module(writer, eq, _STATICS, facts, more=f"NAMES = {{\n{meanings}\n}}\n")
    return f"{text}\n\n\n{_tables(writer.parameters)}"


def _module(
    writer: Writer, eq: Equations, about: str, facts: Mapping[str, object], *, imports: str = "", more: str = "", last: str = ""
) -> str:
    """Return the text of a module: its constants `facts`, then `more`, the functions of `writer` behind `last`."""
    body = "\n\n\n".join(writer.parts)
    states = "(" + ", ".join(f'"{name}"' for name in eq.names) + ",)"
    constants = {"STATES": states, "LOGARITHMIC": tuple(map(bool, eq.logarithmic)), **facts}
    head = _HEAD.format(
        title=writer.system.title,
        about=about,
        names=", ".join(f for f in NUMPY_FUNCTIONS if re.search(rf"\b{f}\b", body)),
        imports=imports,
        constants="\n".join(f"{name} = {value}" for name, value in constants.items()),
        parameters="\n".join(f"    {_parameter(p)}," for p in writer.declared),
        more=more,
    )
    helpers = "".join(text for name, text in HELPERS.items() if f"{name}(" in body)
    return f"{head}{_EMPTY}{helpers}{last}\n\n{body}"


def _at_constant_load(eq: Equations) -> Equations:
    """Return the equations of effects without what they say of a modulation."""
    none = {symbol(n): sp.S.Zero for n in ("time", "begin", "envelope", "modulated", "eps", "weighed")}
    rates, steady = (tuple(e.subs(none) for e in formulas) for formulas in (eq.rates, eq.steady))
    return replace(eq, rates=rates, steady=steady, **{n: getattr(eq, n).subs(none) for n in ("spring", "load", "mu")})


def _parameter(p: Parameter) -> str:
    bounds = [repr(float(b)).replace("inf", 'float("inf")') for b in (p.lower, p.upper)]
    return f"({p.name!r}, {float(p.default)!r}, {p.unit!r}, {bounds[0]}, {bounds[1]}, {p.about!r})"


def _tables(parameters: Sequence[str]) -> str:
    rows = "\n".join(f'    "{n}": cycle_d_{python_name(n)},' for n in parameters)
    bilinear = "\n".join(f'    "{n}": cycle_bilinear_d_{python_name(n)},' for n in parameters)
    return f"CYCLE_PARAMETER = {{\n{rows}\n}}\n\nCYCLE_BILINEAR_PARAMETER = {{\n{bilinear}\n}}\n"


def _write_steady(writer: Writer, eq: Equations) -> None:
    steady = [sp.log(e) if log else e for e, log in zip(eq.steady, eq.logarithmic, strict=True)]
    writer.vector("steady", "Steady sliding at V under W0.", steady, state=False)


def _write_statics(writer: Writer, eq: Equations, linear: Linearisation) -> None:
    _write_steady(writer, eq)
    at_rest = dict(zip(eq.unknowns, eq.steady, strict=True)) | {symbol("W"): symbol("W0")}
    doc = "Friction coefficient in steady sliding at V."
    writer.scalar("steady_friction", doc, eq.mu.subs(at_rest), state=False)
    doc = "Real coefficients a_0..a_n of the characteristic polynomial in s."
    writer.vector("characteristic", doc, linear.characteristic, state=False)
    if linear.hurwitz is not None:
        doc = "Coefficients, lowest first, of the last Hurwitz determinant but one in W0."
        writer.vector("hurwitz_in_load", doc, linear.hurwitz, state=False)


def _write_statics_by_rates(writer: Writer, eq: Equations) -> None:
    """Write steady sliding and its linear stability with effects: the polynomial is that of the rates' Jacobian."""
    _write_steady(writer, eq)
    at_rest = dict(zip(eq.unknowns, eq.steady, strict=True)) | {symbol("W"): symbol("W0"), symbol("W_dot"): sp.S.Zero}
    mu = eq.mu.subs(symbol("W"), eq.load)
    doc = "Friction coefficient in steady sliding at V."
    writer.scalar("steady_friction", doc, mu.subs(at_rest), state=False)
    writer.parts.append(_CHARACTERISTIC.format(V=writer.parameters.index("V"), W0=writer.parameters.index("W0")))


def _write_closed(writer: Writer, system: System) -> None:
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
        writer.scalar(name, doc, in_law_parameters(system, value), state=False)


def rates_functions(writer: Writer, eq: Equations) -> Staged:
    """Write the rates under any drive and load, their derivatives, friction and elongation; return the rates."""
    rates, inputs = staged(eq.rates), ("V", "W", "W_dot")
    doc = "dx/dt under drive V, imposed load W and its rate W_dot."
    writer.vector("rates", doc, rates, tail=inputs)
    writer.matrix("rates_jacobian", "d(rates)/dx.", _jacobian(eq, rates), len(eq.unknowns), tail=inputs)
    _write_rates_by_parameters(writer, rates, inputs)
    writer.scalar("friction", "Friction coefficient.", eq.mu, tail=inputs)
    writer.scalar("elongation", "Spring elongation u.", eq.spring, tail=inputs)
    if eq.load != symbol("W"):
        writer.scalar("load", "Normal load on the asperities.", eq.load, tail=inputs)
    return rates


def _write_rates(writer: Writer, eq: Equations) -> None:
    """Write what a simulator needs (any drive and load) and the multilinear forms of the normal form at rest."""
    rates = rates_functions(writer, eq)
    calm = rates.substituted({symbol("W"): symbol("W0"), symbol("W_dot"): sp.S.Zero})
    a, b, c = ([sp.Symbol(f"_{k}{i}") for i in range(len(eq.unknowns))] for k in "abc")
    second = calm.derivative(_direction(eq, a)).derivative(_direction(eq, b))
    doc = "Second derivative of the rates at constant load, in the directions a, b."
    writer.vector("second", doc, second, vectors=("a", "b"))
    third = second.derivative(_direction(eq, c))
    doc = "Third derivative of the rates at constant load, in the directions a, b, c."
    writer.vector("third", doc, third, vectors=("a", "b", "c"))


def _write_rates_by_parameters(writer: Writer, rates: Staged, inputs: Sequence[str]) -> None:
    """Write d(rates)/dp, a column for each parameter, as a fit's sensitivity equations need it."""
    columns = [rates.derivative({symbol(name): sp.S.One}) for name in writer.parameters]
    doc = "d(rates)/dp, a column for each of PARAMETERS."
    writer.matrix("rates_parameters", doc, side_by_side(columns), len(columns), tail=inputs)


def _direction(eq: Equations, by: Sequence[sp.Expr]) -> dict[sp.Symbol, sp.Expr]:
    """Return the rate of each symbol in the formulas as the unknowns change by `by`: v, not ln v, stands in the formulas."""
    return {s: s * d if log else d for s, log, d in zip(eq.unknowns, eq.logarithmic, by, strict=True)}


def _gradient(eq: Equations, formulas: Staged) -> list[Staged]:
    """Return the derivatives by each unknown."""
    n = len(eq.unknowns)
    return [formulas.derivative({k: v for k, v in _direction(eq, sp.eye(n).row(j)).items() if v != 0}) for j in range(n)]


def _jacobian(eq: Equations, formulas: Staged) -> Staged:
    """Return the Jacobian, row by row."""
    whole = side_by_side(_gradient(eq, formulas))
    return whole if whole.steps else whole.with_outputs([tidy(e) for e in whole.outputs])


def _write_cycle(writer: Writer, eq: Equations) -> None:
    """Write the field over one forcing period, tau = f t in [0, 1], and what continuation differentiates."""
    n = range(len(eq.unknowns))
    phase, f, eps, W0 = sp.Symbol("tau"), symbol("f"), symbol("eps"), symbol("W0")
    angle = 2 * sp.pi * phase
    load = {symbol("W"): W0 * (1 + eps * sp.cos(angle)), symbol("W_dot"): -2 * sp.pi * f * W0 * eps * sp.sin(angle)}
    mu = eq.mu
    if writer.system.effects:
        load |= {symbol("time"): phase / f, symbol("envelope"): sp.S.One, symbol("modulated"): sp.S.One}
        mu = mu.subs(symbol("W"), eq.load)
    field = staged(eq.rates).substituted(load)
    field = field.with_outputs([e / f for e in field.outputs])
    jacobian, head = _jacobian(eq, field), ("tau",)
    writer.vector("cycle", "dx/dtau over one forcing period, W = W0 (1 + eps cos 2 pi tau).", field, head=head)
    writer.matrix("cycle_jacobian", "d(cycle)/dx.", jacobian, len(n), head=head)
    writer.scalar("cycle_friction", "Friction coefficient.", mu.subs(load), head=head)
    writer.scalar("cycle_load", "Normal load W.", eq.load.subs(load), head=head)
    writer.scalar("cycle_elongation", "Spring elongation u.", eq.spring.subs(load), head=head)
    if eq.drive != symbol("V"):
        writer.scalar("cycle_drive", "Velocity at which the spring is pulled.", eq.drive.subs(load), head=head)
    w, a = ([sp.Symbol(f"_{k}{i}") for i in n] for k in "wa")
    entries = {(i, j): jacobian.outputs[len(n) * i + j] for i in n for j in n}
    form = jacobian.with_outputs([sum((w[i] * entries[i, j] * a[j] for i in n for j in n), sp.S.Zero)])
    doc, pair = "Gradient over x of w . (d(cycle)/dx) a.", ("w", "a")
    writer.vector("cycle_bilinear", doc, joined(_gradient(eq, form)), head=head, vectors=pair)
    for name in writer.parameters:
        by = {symbol(name): sp.S.One}
        writer.vector(f"cycle_d_{python_name(name)}", f"d(cycle)/d({name}).", field.derivative(by), head=head)
        slope, doc = form.derivative(by), f"d/d({name}) of w . (d(cycle)/dx) a."
        own = f"cycle_bilinear_d_{python_name(name)}"
        writer.scalar(own, doc, slope.outputs[0], steps=slope.steps, head=head, vectors=pair)


_CHARACTERISTIC = '''def characteristic(p):
    """Real coefficients a_0..a_n of the characteristic polynomial in s."""
    return principal_minors(rates_jacobian(steady(p), p[{V}], p[{W0}], 0.0, p))'''

_MINORS = '''

def principal_minors(matrix):
    """Coefficients, lowest first, of det(s - matrix): sums of principal minors, in which nothing large cancels."""
    from itertools import combinations

    from numpy.linalg import det

    n = matrix.shape[-1]
    out = zeros((*matrix.shape[:-2], n + 1), dtype=matrix.dtype)
    out[..., n] = 1.0
    for k in range(1, n + 1):
        for rows in combinations(range(n), k):
            out[..., n - k] += (-1) ** k * det(matrix[..., rows, :][..., rows])
    return out
'''

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

HELPERS = {"lambertw": _LAMBERTW, "positive_ratio": _RATIO, "principal_minors": _MINORS}

_EMPTY = '''

def _empty(like, trailing):
    """Zeros of the shape that the arguments share, with `trailing` axes added."""
    arrays = [a if hasattr(a, "dtype") else asarray(a) for a in like]
    shapes = {a.shape for a in arrays}
    common = shapes.pop() if len(shapes) == 1 else broadcast_shapes(*shapes)
    return zeros(common + trailing, dtype=result_type(float, *{a.dtype for a in arrays}))
'''

_HEAD = '''"""Generated by srf from {title}.

{about}
"""

from numpy import asarray, iscomplexobj, result_type, zeros, broadcast_shapes
from numpy import {names}
{imports}
{constants}
PARAMETERS = (
{parameters}
)
{more}'''

_STATICS = "Arrays of any leading shape, real or complex; x[..., i] are the STATES, p[i] the PARAMETERS, units um, s, N."
_MOTION = """Motion only. Arrays of any leading shape; x[..., i] are the STATES, p[i] the PARAMETERS, the numbers of tables \
after them."""


# The part of a generated module that motion in time needs, for systems with effects and tables; no stability analysis.


def generate_motion(system: System) -> str:
    """Return the source of a module with steady state, rates and their derivatives by state, parameters and tables."""
    eq = equations_of(system)
    writer = Writer(system, eq)
    _write_steady(writer, eq)
    rates = rates_functions(writer, eq)
    unknown = {s: name for s, name in zip(eq.unknowns, eq.names, strict=True) if str(s) == name}
    inputs = ("V", "W", "W_dot")
    writer.scalar("reading", "What the gauge shows of the elongation.", eq.reading, tail=inputs)
    writer.scalar("stiffness", "Stiffness of the spring.", eq.stiffness, tail=inputs)
    if RANDOM_FIELD in system.effects:
        _write_filter(writer, eq, rates)
    if system.tables:
        _write_tables(writer, system)
    facts = {"TABLES": system.tables, "OBSERVED": repr(unknown.get(eq.reading, ""))}
    imports, last = "", ""
    if system.tables:
        imports = "from srfcli.codegen.splines import tables_after\n"
        last = "\nlut, lut1, lut2 = tables_after(len(PARAMETERS))\n"
    return _module(writer, eq, _MOTION, facts, imports=imports, last=last) + "\n"


def _write_filter(writer: Writer, eq: Equations, rates: Staged) -> None:
    """Write what a Kalman filter asks for besides: where the field's white noise enters, and what a reading's gradient is."""
    inputs = ("V", "W", "W_dot")
    gain = rates.derivative({symbol("field_noise"): sp.S.One})
    writer.vector("field_gain", "d(rates)/d(field_noise).", gain, tail=inputs)
    formulas = {"reading": eq.reading}
    if eq.shown != eq.reading:  # an effect of the gauge
        formulas["spring"] = eq.shown
        writer.scalar("spring", "What a gauge without this effect shows of the elongation.", eq.shown, tail=inputs)
    for name, formula in formulas.items():
        gradient = [eq.derivative(formula, j) for j in range(len(eq.unknowns))]
        writer.vector(f"{name}_gradient", f"d({name})/dx.", gradient, tail=inputs)


def _write_tables(writer: Writer, system: System) -> None:
    """Write what each table is a function of, and the slopes of the rates by its value and its first derivative."""
    eq, inputs = equations_of(system), ("V", "W", "W_dot")
    names = [symbol(argument) for _, argument in system.tables]
    writer.vector("table_arguments", "What each table is a function of.", names, tail=inputs)
    stand_ins = {}
    for i, s in enumerate(names):
        stand_ins[lut(sp.Integer(i), s)] = sp.Symbol(f"T{i}")
        stand_ins[lut1(sp.Integer(i), s)] = sp.Symbol(f"T{i}d")
    back = {v: k for k, v in stand_ins.items()}
    rates = staged([e.xreplace(stand_ins) for e in eq.rates])
    columns = []
    for i in range(len(names)):
        columns += [rates.derivative({sp.Symbol(f"T{i}"): sp.S.One}), rates.derivative({sp.Symbol(f"T{i}d"): sp.S.One})]
    doc = "d(rates)/d(value of table i) in column 2 i, by its slope in column 2 i + 1."
    writer.matrix("rates_tables", doc, side_by_side(columns).substituted(back), len(columns), tail=inputs)
