"""The paper's printed equations and claims, held against what the model gives: agreements, misprints, and how far claims hold."""

from __future__ import annotations

import functools
import importlib.resources
import math
from collections.abc import Callable
from dataclasses import dataclass

import sympy as sp
import tomli

from srfcli.closed_limits import closed_limits, in_law_parameters
from srfcli.derive import characteristic_polynomial, paper_coefficients
from srfcli.expression import parse_expression, symbol
from srfcli.paper_forms import FORMS, exact_estimate
from srfcli.registry import bundled_registry
from srfcli.system import System, build_system
from srfcli.units import to_base

VELOCITIES = (1.0, 100.0)  # um/s, the paper's range
THRESHOLD = 1e-3
REPEATABILITY = 0.03  # of the measured critical load


@dataclass(frozen=True)
class Finding:
    """One printed statement of the paper, where it stands, whether it holds and what is right.

    `kind` is equation, claim or words; `verdict` agrees or misprint for equations and words, holds, roughly or fails for claims.
    """

    kind: str
    label: str
    line: int
    verdict: str
    printed: str
    right: str
    note: str = ""


@functools.cache
def printed_statements() -> dict[str, list[dict[str, object]]]:
    """Return the transcription: symbols, equations, claims and words."""
    return tomli.loads(importlib.resources.files("srfcli").joinpath("data/paper.toml").read_text(encoding="utf-8"))


def paper_system() -> System:
    """Return the paper's model: its friction and ageing laws, kappa = W/lambda, vertical load, inertia."""
    return build_system(bundled_registry())


def check_paper() -> list[Finding]:
    """Return one finding for each printed equation, claim and wording, in this order."""
    system, data = paper_system(), printed_statements()
    found = [check_equation(system, e) for e in data["equation"]]
    found += sorted((_check_claim(system, c) for c in data["claim"]), key=lambda f: f.line)
    for w in data["words"]:
        texts = _t(w, "printed"), _t(w, "right"), _t(w, "reason")
        found.append(Finding("words", "in words", int(str(w["line"])), "misprint", *texts))
    return found


def _t(entry: dict[str, object], key: str) -> str:
    return str(entry.get(key, ""))


def check_equation(system: System, entry: dict[str, object]) -> Finding:
    """Return whether a printed equation equals the derived one; `right` is the printed one with the fault mended."""
    printed = parse_expression(_t(entry, "printed"), [str(n) for n in printed_statements()["symbols"]])
    factor = sp.I if entry.get("times_i") else sp.S.One
    right = FORMS[_t(entry, "form")](system)
    verdict = "agrees" if _equal(factor * printed, right) else "misprint"
    shown = _t(entry, "printed") if verdict == "agrees" else str(_like(right / factor, printed))
    sign = "i*(" if factor == sp.I else ""
    texts = [f"{_t(entry, 'left')} = {sign}{body}{')' if sign else ''}" for body in (_t(entry, "printed"), shown)]
    return Finding(
        "equation", _t(entry, "label"), int(str(entry["line"])), verdict, texts[0], texts[1], _t(entry, "note")
    )


def _equal(first: sp.Expr, second: sp.Expr) -> bool:
    """Return whether two formulas are one, every symbol being positive and eta = 1 + K/kappa."""
    K, kappa = symbol("K"), symbol("kappa")
    difference = (first - second).subs({symbol("eta"): 1 + K / kappa, symbol("K_par"): K * kappa / (K + kappa)})
    positive = {s: sp.Symbol(s.name, positive=True) for s in difference.free_symbols}
    return sp.simplify(difference.xreplace(positive)) == 0


def _like(right: sp.Expr, printed: sp.Expr) -> sp.Expr:
    """Return `right` sorted by the perturbations, with eta where the printed form has it."""
    perturbations = [symbol(n) for n in ("x_1", "x_3", "delta_x", "delta_phi")]
    if not right.has(*perturbations):
        return sp.factor_terms(right)
    collected = sp.collect(sp.expand(right), perturbations, evaluate=False)
    terms = []
    for unknown, factor in collected.items():
        if printed.has(symbol("eta")):
            in_eta = sp.factor(factor).subs(symbol("K") + symbol("kappa"), symbol("eta") * symbol("kappa"))
            factor = in_eta if in_eta.has(symbol("eta")) else factor
        terms.append(sp.factor(factor) * unknown)
    return sp.Add(*terms)


def _defaults(system: System, **given: float) -> dict[sp.Symbol, float]:
    """Return the optimised column of Table I, in um, s, N, with these values changed."""
    values = {p.name: to_base(p.default, p.unit) for p in system.parameters} | given
    return {symbol(n): v for n, v in values.items()}


def _at_onset(system: System, expression: sp.Expr, **given: float) -> complex:
    """Return `expression` at the exact critical load and frequency, with Table I and `given` for the rest."""
    limits = closed_limits(system)
    assert limits is not None and limits.load is not None and limits.omega_squared is not None
    values, Omega_squared = _defaults(system, **given), symbol("Omega_c") ** 2
    load = in_law_parameters(system, limits.load.subs(Omega_squared, limits.omega_squared))
    values[symbol("W0")] = float(load.subs(values))
    return complex(in_law_parameters(system, expression.subs(Omega_squared, limits.omega_squared)).subs(values))


def _number(system: System, expression: sp.Expr, **given: float) -> float:
    return _at_onset(system, expression, **given).real


def _both_ends(system: System, expression: sp.Expr) -> tuple[float, ...]:
    return tuple(_number(system, expression, V=v) for v in VELOCITIES)


def _finite_stiffness(system: System) -> tuple[str, str]:
    limits = closed_limits(system)
    assert limits is not None and limits.load is not None and limits.limit_load is not None
    off = sp.cancel(limits.limit_load / limits.load) - 1
    low, high = _both_ends(system, off)
    verdict = "holds" if max(low, high) < REPEATABILITY else "fails"
    shift = f"the limit kappa to infinity exceeds the exact W0c by {100 * low:.1f} % at 1 um/s, {100 * high:.1f} % at 100 um/s"
    scatter = f"the measured W0c scatters by {100 * REPEATABILITY:.0f} %"
    return verdict, f"{shift}; Omega_c does not change; {scatter}"


def _strengthening_velocity(system: System) -> tuple[str, str]:
    (at,) = sp.solve(FORMS["weakening"](system), symbol("V"))
    value = float(at.subs(_defaults(system)))
    Vsat = float(symbol("Vsat").subs(_defaults(system)))
    verdict = "holds" if abs(value / Vsat - 1) < 0.01 else "roughly"
    formula = sp.collect(sp.expand(at), symbol("Vsat"))
    return verdict, f"mu_d increases above V = {formula} = {value:.1f} um/s, {value / Vsat:.2f} Vsat"


def _inertia_midrange(system: System) -> tuple[str, str]:
    limits = closed_limits(system)
    assert limits is not None and limits.limit_load is not None and limits.quasistatic_load is not None
    off = limits.quasistatic_load / limits.limit_load - 1
    at = {v: _number(system, off, V=v) for v in (10.0, 50.0, 100.0)}
    text = ", ".join(f"{100 * x:.1f} % at {v:g} um/s" for v, x in at.items())
    return ("holds" if at[10.0] < REPEATABILITY else "fails"), f"without inertia W0c is too large by {text}"


def _perturbation_parameter(system: System) -> tuple[str, str]:
    value = float((symbol("mu0") * 0.1 / symbol("A")).subs(_defaults(system)))
    return ("holds" if value > 1 else "fails"), f"mu0 eps_eff/A = {value:.2f}"


def _frequency_real(system: System) -> tuple[str, str]:
    limits = closed_limits(system)
    assert limits is not None and limits.omega_squared is not None
    squares = _both_ends(system, limits.omega_squared)
    c = paper_coefficients(characteristic_polynomial(system))
    Omega = symbol("Omega")
    polynomial = sum((x * Omega**k for k, x in enumerate(c)), sp.S.Zero)
    rest = [
        _at_onset(system, polynomial.subs(Omega, math.sqrt(q)), V=v) for q, v in zip(squares, VELOCITIES, strict=True)
    ]
    residual = max(map(abs, rest))
    real = min(squares) > 0 and residual < 1e-9
    value = f"Omega_c = {math.sqrt(squares[0]):.4f} rad/s at 1 um/s"
    right = f"with exp(i Omega t) it is real, {value}; i Omega is imaginary, and Omega crosses the real axis"
    return ("fails" if real else "holds"), right


def _length_ratio(system: System) -> tuple[str, str]:
    value = float((symbol("lambda") / symbol("D0")).subs(_defaults(system)))
    return ("roughly" if 0.5 < value < 2 else "fails"), f"lambda/D0 = {value:.2f}"


def _estimate_small(system: System) -> tuple[str, str]:
    V = symbol("V")
    values = _defaults(system)
    values.pop(V)
    # every symbol of the estimate but V; mu_v is A for the paper's law
    printed = in_law_parameters(system, FORMS["estimate"](system)).subs(values)
    exact = exact_estimate(system).subs(values)
    c, c_exact = (float(e.subs(V, VELOCITIES[1])) for e in (printed, exact))
    up_to = max(float(r) for r in sp.Poly(printed - sp.Float(THRESHOLD), V).nroots() if r.is_real)
    up_to_exact = float(sp.nsolve(exact - THRESHOLD, V, up_to))
    simple = f"c = {c:.2g} at 100 um/s, below 1e-3 up to {up_to:.1f} um/s"
    full = f"with the exact Omega_c and lambda/D0 it is {c_exact:.2g}, below 1e-3 up to {up_to_exact:.1f} um/s"
    return ("holds" if c < THRESHOLD else "fails"), f"{simple}; {full}"


def _cubic_term(system: System) -> tuple[str, str]:
    W0, kappa, D0, mu_phi, mu_v = (symbol(n) for n in ("W0", "kappa", "D0", "mu_phi", "mu_v"))
    low, high = _both_ends(system, W0 / (kappa * D0) * (mu_phi - mu_v))
    right = f"C3 changes by {100 * low:.1f} % at 1 um/s, {100 * high:.1f} % at 100 um/s"
    return ("holds" if max(low, high) < REPEATABILITY else "fails"), right


def _eta_small(system: System) -> tuple[str, str]:
    low, high = _both_ends(system, symbol("K") / symbol("kappa"))
    verdict = "holds" if min(low, high) > 3e-3 and max(low, high) < 3e-2 else "fails"
    return verdict, f"K/kappa = {low:.2g} at onset at 1 um/s, {high:.2g} at 100 um/s"


CLAIMS: dict[str, Callable[[System], tuple[str, str]]] = {
    "finite_stiffness": _finite_stiffness,
    "strengthening_velocity": _strengthening_velocity,
    "inertia_midrange": _inertia_midrange,
    "perturbation_parameter": _perturbation_parameter,
    "frequency_real": _frequency_real,
    "length_ratio": _length_ratio,
    "estimate_small": _estimate_small,
    "cubic_term": _cubic_term,
    "eta_small": _eta_small,
}


def _check_claim(system: System, entry: dict[str, object]) -> Finding:
    verdict, right = CLAIMS[_t(entry, "check")](system)
    return Finding("claim", "claim", int(str(entry["line"])), verdict, _t(entry, "printed"), right)
