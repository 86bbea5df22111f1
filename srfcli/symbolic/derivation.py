"""A derivation as sections of named formulas in the paper's letters and normalisation, as text, LaTeX, JSON or NumPy."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import sympy as sp

from srfcli.core.units import to_base
from srfcli.laws.expression import NUMPY_FUNCTIONS, latex, latex_name, numpy_text, pretty, python_name, symbol, text
from srfcli.symbolic.derive import (
    ClosedLimits,
    characteristic_polynomial,
    closed_limits,
    common_ageing,
    friction_slopes,
    in_law_parameters,
    interface_meaning,
    paper_coefficients,
    slope_meaning,
    weakening_first,
)
from srfcli.symbolic.equations import equations_of, steady_states
from srfcli.symbolic.paper import Finding
from srfcli.symbolic.system import System, state_rate

EXTRAS = ("jacobian", "parameters")


@dataclass(frozen=True)
class Formula:
    """`name` = `value`; `latex` is the name in LaTeX."""

    name: str
    latex: str
    value: sp.Expr


@dataclass(frozen=True)
class Section:
    """Formulas that belong together; `notes` are sentences about them."""

    key: str
    title: str
    formulas: tuple[Formula, ...]
    notes: tuple[str, ...] = ()


def derivation(system: System, extras: Sequence[str] = EXTRAS) -> tuple[Section, ...]:
    """Return everything derived for `system`; `extras` chooses among the long sections, jacobian and parameters."""
    sections = [_laws(system), _steady(system), _slopes(system), _equations(system)]
    if "jacobian" in extras:
        sections.append(_jacobian(system))
    if "parameters" in extras:
        sections.append(_parameters(system))
    return (*sections, _dispersion(system), _limits(system))


def _one(name: str, value: sp.Expr, latex: str | None = None) -> Formula:
    return Formula(name, latex_name(name) if latex is None else latex, value)


def _laws(system: System) -> Section:
    formulas = [_one("mu", system.friction.mu)]
    formulas += [_one(f"{s.name}'", state_rate(system, s)) for s in system.friction.states]
    if system.interface.kappa is not None:
        formulas.append(_one("kappa", system.interface.kappa))
    imposed = "W is the imposed load, W0 (1 + eps cos(2 pi f t)), and W_dot its rate"
    if system.loading == "inclined":
        formulas.append(_one("normal load", equations_of(system).load, r"W_{\text{normal}}"))
        imposed += "; in the laws W stands for the normal load"
    return Section("laws", "Laws", tuple(formulas), (imposed,))


def _steady(system: System) -> Section:
    V = symbol("V")
    mu_ss = friction_slopes(system)[2]
    formulas = [_one("v", V)]
    formulas += [_one(s.name, e.subs(symbol("v"), V)) for s, e in zip(system.friction.states, steady_states(system), strict=True)]
    formulas += [_one("mu_ss", mu_ss), _one("u", symbol("W0") * symbol("mu_ss") / symbol("K"))]
    return Section("steady", "Steady sliding at V under W0", tuple(formulas))


def _slopes(system: System) -> Section:
    formulas = [_one(str(m), e) for m, e in slope_meaning(system)[:-1]]
    weakening = _one("-d mu_ss/d ln V", weakening_slope(system), r"-\frac{\partial \mu_{ss}}{\partial \ln V}")
    note = "mu_v = d mu/d ln v and mu_phi = d mu/d ln phi in steady sliding"
    return Section("slopes", "Slopes of friction", (*formulas, weakening), (note,))


def weakening_slope(system: System) -> sp.Expr:
    """Return -d mu_ss/d ln V, positive where steady friction weakens with velocity."""
    V, (mu_v, mu_phi, mu_ss) = symbol("V"), friction_slopes(system)
    slope = -V * sp.diff(mu_ss, V)
    if slope.has(sp.LambertW):
        return slope
    usual = sum(mu_phi, -mu_v)  # where every age is proportional to 1/V
    return usual if sp.simplify(slope - usual) == 0 else sp.simplify(slope)


def _rate_name(name: str) -> tuple[str, str]:
    if name.startswith("ln_"):
        return f"(ln {name[3:]})'", rf"(\ln {latex_name(name[3:])})'"
    return f"{name}'", f"{latex_name(name)}'"


def _equations(system: System) -> Section:
    eq = equations_of(system)
    formulas = tuple(Formula(*_rate_name(n), e) for n, e in zip(eq.names, eq.rates, strict=True))
    unknowns = ", ".join(n.replace("ln_", "ln ") for n in eq.names)
    return Section("equations", f"First-order equations in ({unknowns})", formulas)


def _jacobian(system: System) -> Section:
    eq = equations_of(system)
    formulas = []
    for name, rate in zip(eq.names, eq.rates, strict=True):
        for j, other in enumerate(eq.names):
            if (value := sp.factor_terms(eq.derivative(rate, j))) != 0:
                formulas.append(Formula(*_partial(name, other), value))
    return Section("jacobian", "Jacobian", tuple(formulas), ("derivatives that are not listed are zero",))


def _parameters(system: System) -> Section:
    eq, t = equations_of(system), symbol("t")
    W0, eps, f = symbol("W0"), symbol("eps"), symbol("f")
    load = W0 * (1 + eps * sp.cos(2 * sp.pi * f * t))
    imposed = {symbol("W"): load, symbol("W_dot"): sp.diff(load, t)}
    formulas = []
    for name, rate in zip(eq.names, eq.rates, strict=True):
        driven = rate.subs(imposed)
        for parameter in system.parameters:
            if (value := sp.factor_terms(sp.diff(driven, symbol(parameter.name)))) != 0:
                formulas.append(Formula(*_partial(name, parameter.name), value))
    note = "with the imposed load W0 (1 + eps cos(2 pi f t)); derivatives that are not listed are zero"
    return Section("parameters", "Derivatives by the parameters", tuple(formulas), (note,))


def _partial(name: str, other: str) -> tuple[str, str]:
    text, latex = _rate_name(name)
    below = rf"\ln {latex_name(other[3:])}" if other.startswith("ln_") else latex_name(other)
    return f"d{text}/d{other.replace('ln_', ' ln ')}", rf"\frac{{\partial {latex}}}{{\partial {below}}}"


def _dispersion(system: System) -> Section:
    coefficients = dispersion_coefficients(system)
    formulas = [Formula(f"C{k}", f"C_{{{k}}}", c) for k, c in enumerate(coefficients)]
    notes = [f"perturbations as exp(i Omega t): C0 + C1 Omega + ... + C{len(coefficients) - 1} Omega^{len(coefficients) - 1} = 0"]
    known = dict(interface_meaning(system))
    if known and any(c.has(symbol("eta")) for c in coefficients):
        formulas.append(_one("eta", 1 + symbol("K") / symbol("kappa")))
    if known:
        formulas.append(_one("kappa", known[symbol("kappa")]))
    if known and any(c.has(symbol("kappa_W")) for c in coefficients):
        formulas.append(_one("kappa_W", known[symbol("kappa_W")]))
    return Section("dispersion", "Dispersion relation", tuple(formulas), tuple(notes))


def dispersion_coefficients(system: System) -> tuple[sp.Expr, ...]:
    """Return C_0..C_n of the dispersion relation, arranged as the paper prints them where its symbols suffice."""
    a = characteristic_polynomial(system)
    if len(system.friction.states) == 1 and system.loading == "vertical":
        a = tuple(_as_printed(k, c, system) for k, c in enumerate(a))
    return paper_coefficients(a)


def _as_printed(k: int, a: sp.Expr, system: System) -> sp.Expr:
    """Return a_k with eta for 1 + K/kappa and, for odd k, the paper's common factor in front."""
    K, M, W0, D0, kappa, eta = (symbol(n) for n in ("K", "M", "W0", "D0", "kappa", "eta"))
    expanded = sp.expand(a)
    heavy = sum((term for term in sp.Add.make_args(expanded) if term.has(M)), sp.S.Zero)
    light = expanded - heavy
    if system.elastic and light.has(kappa):
        light = sp.expand(sp.cancel(light.subs(kappa, K / (eta - 1))))
    factor = {1: W0 / D0, 3: M * W0 / (kappa * D0) if system.elastic else sp.S.One}.get(k, sp.S.One)
    inside = sp.expand((light + heavy) / factor)
    if k == 1:
        inside = sp.collect(inside, eta, func=weakening_first)
    return sp.Mul(factor, inside, evaluate=False) if k % 2 and factor != 1 else inside


def _limits(system: System) -> Section:
    found = closed_limits(system)
    if found is None:
        return Section("limits", "Closed forms of the critical load", (), ("none: more than one state variable, or no factor",))
    formulas = list(_limit_formulas(system, found))
    notes = [_validity(system, found)]
    if found.load is not None and found.limit_load is not None and system.elastic:
        notes += _how_far(system, found)
    return Section("limits", "Closed forms of the critical load", tuple(formulas), tuple(notes))


def _limit_formulas(system: System, found: ClosedLimits) -> Iterator[Formula]:
    V, K, D0, W0, Omega = (symbol(n) for n in ("V", "K", "D0", "W0", "Omega_c"))
    omega = found.omega_squared
    if omega is not None:
        yield _one("Omega_c^2", omega, r"\Omega_c^2")
        yield _one("D0 Omega_c/V", _root(omega * D0**2 / V**2), r"\frac{D_0 \Omega_c}{V}")
    if found.load is not None:
        yield _one("W0c", found.load, "W_0^c")
    if found.limit_load is not None:
        yield _one("W0c, kappa to infinity", found.limit_load, r"W_0^c|_{\kappa\to\infty}")
    if found.limit_load is not None and omega is not None:
        load = found.limit_load.subs(Omega**2, omega)
        stiffness = sp.solve(sp.Eq(W0, load), K)
        if len(stiffness) == 1 and not load.has(sp.LambertW):
            name = r"\frac{K D_0}{W_0^c}\Big|_{\kappa\to\infty}"
            yield _one("K D0/W0c, kappa to infinity", _by_weakening(stiffness[0] * D0 / W0), name)
    if found.quasistatic_load is not None:
        text = "W0c, kappa to infinity, no inertia"
        yield _one(text, found.quasistatic_load, r"W_0^c|_{\kappa\to\infty,\, M\to 0}")


def _root(square: sp.Expr) -> sp.Expr:
    return sp.sqrt(square if square.has(sp.LambertW) else sp.cancel(square))


def _by_weakening(ratio: sp.Expr) -> sp.Expr:
    """Return a ratio as mu_phi - mu_v times 1 + an inertial part, as the paper writes it."""
    weakening = symbol("mu_phi") - symbol("mu_v")
    rest = sp.expand(sp.cancel(ratio / weakening))
    return weakening * rest if not rest.has(symbol("mu_phi")) else sp.factor(ratio)


def _validity(system: System, found: ClosedLimits) -> str:
    ageing = "+".join([system.ageing.name, *(m.name for m in system.modifiers)])
    form = "(ln phi)' = -(V/D0) (d ln v + d ln phi)"
    if common_ageing(system):
        return f"exact for any kappa and M where no limit is named: one state, and {ageing} is linearised as {form}"
    return f"{ageing} is not linearised as {form} in this system: the paper's forms do not hold, those listed do"


def _how_far(system: System, found: ClosedLimits) -> list[str]:
    """Return how far the limit is above the exact load: as a formula and at the laws' default parameters."""
    assert found.load is not None and found.limit_load is not None and found.omega_squared is not None
    off = sp.cancel(found.limit_load / found.load) - 1
    values = {symbol(p.name): to_base(p.default, p.unit) for p in system.parameters}
    full = in_law_parameters(system, off.subs(symbol("Omega_c") ** 2, found.omega_squared))
    numbers = []
    for velocity in (1.0, 10.0, 100.0):
        value = complex(full.subs({**values, symbol("V"): velocity})).real
        numbers.append(f"{100 * value:.2g} % at {velocity:g} um/s")
    return [f"the limit kappa to infinity is above the exact load by {', '.join(numbers)} (default parameters)"]


# A derivation written out: text for a reader, LaTeX, a JSON document, or a small NumPy function.

SCHEMA = "srf.derive/1"
PAPER_SCHEMA = "srf.derive-paper/1"


def to_text(system: System, sections: Sequence[Section], *, unicode: bool) -> str:
    """Return the sections as text: one line a formula, or over several lines in Unicode."""
    blocks = [system.title]
    for section in sections:
        lines = [section.title]
        for formula in section.formulas:
            if unicode:
                lines += ["", *("  " + line for line in pretty(formula.name, formula.value).split("\n"))]
            else:
                lines.append(f"  {formula.name} = {text(formula.value)}")
        if unicode and section.notes:
            lines.append("")
        lines += [f"  ({note})" for note in section.notes]
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks) + "\n"


def to_latex(system: System, sections: Sequence[Section]) -> str:
    """Return a LaTeX document that compiles with amsmath."""
    lines = [r"\documentclass{article}", r"\usepackage{amsmath}", r"\allowdisplaybreaks", r"\begin{document}"]
    lines.append(_escaped(system.title) + ".")
    for section in sections:
        lines += ["", rf"\section*{{{_escaped(section.title)}}}"]
        if section.formulas:
            rows = [f"{formula.latex} &= {latex(formula.value)}" for formula in section.formulas]
            lines += [r"\begin{align*}", " \\\\\n".join(rows), r"\end{align*}"]
        lines += [f"({_escaped(note)})" for note in section.notes]
    return "\n".join([*lines, r"\end{document}"]) + "\n"


def _escaped(words: str) -> str:
    table = {"_": r"\_", "%": r"\%", "^": r"\^{}", "&": r"\&", "#": r"\#"}
    return "".join(table.get(c, c) for c in words)


def to_document(system: System, sections: Sequence[Section]) -> dict[str, Any]:
    """Return the sections as plain data: each formula by name, as text and as LaTeX."""
    return {
        "schema": SCHEMA,
        "system": {
            "law": system.friction.name,
            "ageing": "+".join([system.ageing.name, *(m.name for m in system.modifiers)]),
            "interface": system.interface.name,
            "loading": system.loading,
            "inertia": system.inertia,
            "unknowns": list(system.states),
        },
        "sections": [
            {
                "key": section.key,
                "title": section.title,
                "notes": list(section.notes),
                "formulas": [
                    {"name": f.name, "text": text(f.value), "latex_name": f.latex, "latex": latex(f.value)}
                    for f in section.formulas
                ],
            }
            for section in sections
        ],
    }


def to_python(system: System) -> str:
    """Return a NumPy function of the dispersion coefficients C0..Cn that stands by itself; units um, s, N, rad."""
    coefficients = dispersion_coefficients(system)
    meaning = _meaning(system)
    used = {s.name for e in (*coefficients, *(e for _, e in meaning)) for s in e.free_symbols}
    arguments = [p.name for p in system.parameters if p.name in used]
    body = [f"    {python_name(s)} = {numpy_text(e)}" for s, e in meaning if s in used]
    rows = [numpy_text(c) for c in coefficients]
    functions = [f for f in NUMPY_FUNCTIONS if any(re.search(rf"\b{f}\b", line) for line in [*body, *rows])]
    head = [f'"""Dispersion relation of {system.title}: sum C_k Omega^k = 0 with perturbations exp(i Omega t)."""', ""]
    head.append(f"from numpy import {', '.join(['array', *functions])}")
    if any("lambertw(" in line for line in [*body, *rows]):
        head.append("from scipy.special import lambertw")
    signature = ", ".join(python_name(a) for a in arguments)
    code = [f"def dispersion({signature}):", f'    """C0..C{len(coefficients) - 1} in um, s, N; mass in N s^2/um (1e-6 kg)."""']
    code += [*body, "    return array([", *(f"        {line}," for line in rows), "    ])"]
    return "\n".join([*head, "", "", *code]) + "\n"


def _meaning(system: System) -> list[tuple[str, sp.Expr]]:
    """Return the abbreviations of the coefficients and what they stand for, in the order in which they can be computed."""
    pairs = [(str(s), e) for s, e in (*slope_meaning(system), *interface_meaning(system))]
    if system.elastic:
        pairs.append(("eta", 1 + symbol("K") / symbol("kappa")))
    return pairs


def paper_text(findings: Sequence[Finding]) -> str:
    """Return the comparison with the paper as text: the equations, its claims, and its wording apart."""
    equations = [f for f in findings if f.kind == "equation"]
    wrong = sum(f.verdict == "misprint" for f in equations)
    blocks = [f"Printed equations: {len(equations) - wrong} agree, {wrong} misprinted (line numbers of the manuscript's source)"]
    blocks[0] += "\n" + "\n".join(_paper_line(f) for f in equations)
    claims = [f for f in findings if f.kind == "claim"]
    blocks.append("Claims, computed with the optimised parameters of Table I\n" + "\n".join(_paper_line(f) for f in claims))
    words = [f for f in findings if f.kind == "words"]
    blocks.append("In words\n" + "\n".join(_paper_line(f) for f in words))
    blocks.append("x_1 is x', x_3 is x'''; coswt is cos(omega t); K_par is K || kappa")
    return "\n\n".join(blocks) + "\n"


def _paper_line(f: Finding) -> str:
    label = "" if f.kind != "equation" else f"  {f.label}"
    lines = [f"  {f.verdict:8}  line {f.line}{label}: {f.printed}"]
    if f.verdict != "agrees":
        lines.append(f"{'':12}right: {f.right}" if f.kind != "claim" else f"{'':12}found: {f.right}")
    if f.note:
        lines.append(f"{'':12}{f.note}")
    return "\n".join(lines)


def paper_document(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the comparison with the paper as plain data."""
    return {"schema": PAPER_SCHEMA, "findings": [asdict(f) for f in findings]}
