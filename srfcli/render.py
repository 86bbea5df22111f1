"""A derivation written out: text for a reader, LaTeX, a JSON document, or a small NumPy function."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import sympy as sp

from srfcli.derivation import Section, dispersion_coefficients
from srfcli.derive import friction_slopes, interface_meaning, slope_symbols
from srfcli.expression import symbol
from srfcli.notation import latex, pretty, text
from srfcli.numpytext import FUNCTIONS, numpy_text, python_name
from srfcli.paper import Finding
from srfcli.system import System

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
    used = _symbols_in([*coefficients, *(e for _, e in meaning)])
    arguments = [p.name for p in system.parameters if p.name in used]
    body = [f"    {python_name(s)} = {numpy_text(e)}" for s, e in meaning if s in used]
    rows = [numpy_text(c) for c in coefficients]
    functions = [f for f in FUNCTIONS if any(re.search(rf"\b{f}\b", line) for line in [*body, *rows])]
    head = [f'"""Dispersion relation of {system.title}: sum C_k Omega^k = 0 with perturbations exp(i Omega t)."""', ""]
    head.append(f"from numpy import {', '.join(['array', *functions])}")
    if any("lambertw(" in line for line in [*body, *rows]):
        head.append("from scipy.special import lambertw")
    signature = ", ".join(python_name(a) for a in arguments)
    code = [
        f"def dispersion({signature}):",
        f'    """C0..C{len(coefficients) - 1} in um, s, N; mass in N s^2/um (1e-6 kg)."""',
    ]
    code += [*body, "    return array([", *(f"        {line}," for line in rows), "    ])"]
    return "\n".join([*head, "", "", *code]) + "\n"


def _meaning(system: System) -> list[tuple[str, sp.Expr]]:
    """Return the abbreviations of the coefficients and what they stand for, in the order in which they can be computed."""
    mu_v, mu_phi, mu_ss = friction_slopes(system)
    m_v, m_phi = slope_symbols(system)
    pairs = [(str(m_v), mu_v), *((str(m), e) for m, e in zip(m_phi, mu_phi, strict=True)), ("mu_ss", mu_ss)]
    pairs += [(str(s), e) for s, e in interface_meaning(system)]
    if system.elastic:
        pairs.append(("eta", 1 + symbol("K") / symbol("kappa")))
    return pairs


def _symbols_in(expressions: Sequence[sp.Expr]) -> set[str]:
    return {s.name for e in expressions for s in e.free_symbols}


def paper_text(findings: Sequence[Finding]) -> str:
    """Return the comparison with the paper as text: the equations, its claims, and its wording apart."""
    equations = [f for f in findings if f.kind == "equation"]
    wrong = sum(f.verdict == "misprint" for f in equations)
    blocks = [
        f"Printed equations: {len(equations) - wrong} agree, {wrong} misprinted (line numbers of the manuscript's source)"
    ]
    blocks[0] += "\n" + "\n".join(_paper_line(f) for f in equations)
    claims = [f for f in findings if f.kind == "claim"]
    blocks.append(
        "Claims, computed with the optimised parameters of Table I\n" + "\n".join(_paper_line(f) for f in claims)
    )
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
    keys = ("kind", "label", "line", "verdict", "printed", "right", "note")
    return {"schema": PAPER_SCHEMA, "findings": [{k: getattr(f, k) for k in keys} for f in findings]}
