"""The paper's printed equations and claims, held against what the model gives.

Symbols as in symbolic/paper.toml: x_1 is x', x_3 is x''', coswt is cos(omega t).
"""

from __future__ import annotations

import functools
import importlib.resources
import math
from collections.abc import Callable
from dataclasses import dataclass

import sympy as sp
import tomli

from srfcli.core.units import to_base
from srfcli.laws.expression import parse_expression, symbol
from srfcli.laws.registry import bundled_registry
from srfcli.symbolic.derive import characteristic_polynomial, closed_limits, in_law_parameters, paper_coefficients
from srfcli.symbolic.equations import equations_of
from srfcli.symbolic.system import System, build_system, state_rate

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
    return tomli.loads(importlib.resources.files("srfcli").joinpath("symbolic/paper.toml").read_text(encoding="utf-8"))


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
    return Finding("equation", _t(entry, "label"), int(str(entry["line"])), verdict, texts[0], texts[1], _t(entry, "note"))


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
    exact, *_, squared = _closed(system)
    values, Omega_squared = _defaults(system, **given), symbol("Omega_c") ** 2
    load = in_law_parameters(system, exact.subs(Omega_squared, squared))
    values[symbol("W0")] = float(load.subs(values))
    return complex(in_law_parameters(system, expression.subs(Omega_squared, squared)).subs(values))


def _closed(system: System) -> tuple[sp.Expr, sp.Expr, sp.Expr, sp.Expr]:
    """Return load, limit_load, quasistatic_load and omega_squared of the closed forms, all of which the paper's system has."""
    forms = closed_limits(system)
    assert forms is not None
    return forms.load, forms.limit_load, forms.quasistatic_load, forms.omega_squared


def _number(system: System, expression: sp.Expr, **given: float) -> float:
    return _at_onset(system, expression, **given).real


def _both_ends(system: System, expression: sp.Expr) -> tuple[float, ...]:
    return tuple(_number(system, expression, V=v) for v in VELOCITIES)


def _finite_stiffness(system: System) -> tuple[str, str]:
    load, limit_load, *_ = _closed(system)
    off = sp.cancel(limit_load / load) - 1
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
    _, limit_load, quasistatic_load, _ = _closed(system)
    off = quasistatic_load / limit_load - 1
    at = {v: _number(system, off, V=v) for v in (10.0, 50.0, 100.0)}
    text = ", ".join(f"{100 * x:.1f} % at {v:g} um/s" for v, x in at.items())
    return ("holds" if at[10.0] < REPEATABILITY else "fails"), f"without inertia W0c is too large by {text}"


def _perturbation_parameter(system: System) -> tuple[str, str]:
    value = float((symbol("mu0") * 0.1 / symbol("A")).subs(_defaults(system)))
    return ("holds" if value > 1 else "fails"), f"mu0 eps_eff/A = {value:.2f}"


def _frequency_real(system: System) -> tuple[str, str]:
    squares = _both_ends(system, _closed(system)[3])
    c = paper_coefficients(characteristic_polynomial(system))
    Omega = symbol("Omega")
    polynomial = sum((x * Omega**k for k, x in enumerate(c)), sp.S.Zero)
    rest = [_at_onset(system, polynomial.subs(Omega, math.sqrt(q)), V=v) for q, v in zip(squares, VELOCITIES, strict=True)]
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


# What each printed equation of the paper should say, derived from the model: the law, the interface and Newton's equation.

Form = Callable[[System], sp.Expr]


def _s(names: str) -> tuple[sp.Symbol, ...]:
    return tuple(symbol(n) for n in names.split())


def slip_velocity(system: System) -> sp.Expr:
    """Return v = x_pl' from kappa (x - x_pl) = K (V t - x) - M x'', the interface having no mass."""
    t, V, K, M, kappa, x_1, x_3 = _s("t V K M kappa x_1 x_3")
    x = sp.Function("x")(t)
    balance = kappa * (x - sp.Symbol("xpl")) - (K * (V * t - x) - M * x.diff(t, 2))
    plastic = sp.solve(balance, sp.Symbol("xpl"))[0]
    velocity = sp.expand(plastic.diff(t))
    return velocity.subs(x.diff(t, 3), x_3).subs(x.diff(t), x_1)


def eta(system: System) -> sp.Expr:
    """Return by how much delta x' counts in delta v."""
    return slip_velocity(system).coeff(symbol("x_1"))


def _slip_perturbation(system: System) -> sp.Expr:
    """Return delta v in delta x' and delta x''', named x_1 and x_3 like those of x: what is free of them drops out."""
    v = slip_velocity(system)
    return sum((sp.diff(v, d) * d for d in _s("x_1 x_3")), sp.S.Zero)


def _z_rate(system: System) -> sp.Expr:
    load, W0, eps, coswt = _s("W W0 eps coswt")
    equations = equations_of(system)
    return equations.rates[equations.names.index("z")].subs(load, W0 * (1 + eps * coswt))


def _steady_age(system: System) -> sp.Expr:
    equations = equations_of(system)
    return equations.steady[equations.names.index("ln_phi")]


def _force(system: System) -> sp.Expr:
    """Return M x'' = M z' with the friction force carried by the interface, kappa (x - x_pl)."""
    M, load, u, V, t, x, kappa, xpl = _s("M W u V t x kappa xpl")
    spring = sp.expand(M * equations_of(system).rates[1] + load * system.friction.mu)
    return spring.subs(u, V * t - x) - kappa * (x - xpl)


def _slider_force(system: System) -> sp.Expr:
    M, load, u, V, t, x, W0, mu = _s("M W u V t x W0 mu")
    return sp.expand(M * equations_of(system).rates[1] + load * system.friction.mu).subs(u, V * t - x) - W0 * mu


def _linear_force(system: System) -> sp.Expr:
    """Return -K delta x - W0 delta mu."""
    K, W0, V, mu_v, mu_phi, delta_x, delta_phi = _s("K W0 V mu_v mu_phi delta_x delta_phi")
    return -K * delta_x - W0 * (mu_v * _slip_perturbation(system) / V + mu_phi * delta_phi / _steady_age(system))


def _linear_age(system: System) -> sp.Expr:
    """Return delta phi' = g_v delta v + g_phi delta phi at steady sliding."""
    v, phi, V, delta_phi = _s("v phi V delta_phi")
    rate, at = state_rate(system, system.friction.states[0]), [(phi, _steady_age(system)), (v, V)]
    return sp.diff(rate, v).subs(at) * _slip_perturbation(system) + sp.diff(rate, phi).subs(at) * delta_phi


def _steady_position(system: System) -> sp.Expr:
    """Return x at x'' = 0: K (V t - x) = F."""
    x, F, W0, mu = _s("x F W0 mu")
    return sp.solve(_slider_force(system).subs(W0 * mu, F), x)[0]


def _coefficient(k: int) -> Form:
    return lambda system: paper_coefficients(characteristic_polynomial(system))[k]


def critical_stiffness(system: System) -> sp.Expr:
    """Return K D0/W0c for kappa to infinity."""
    K, W0, D0, Omega = _s("K W0 D0 Omega_c")
    _, limit_load, _, squared = _closed(system)
    load = limit_load.subs(Omega**2, squared)
    return sp.factor(sp.solve(sp.Eq(W0, load), K)[0] * D0 / W0)


def critical_frequency(system: System) -> sp.Expr:
    """Return D0 Omega_c/V."""
    V, D0 = _s("V D0")
    return sp.sqrt(sp.cancel(_closed(system)[3] * D0**2 / V**2))


def _weakening(system: System) -> sp.Expr:
    V = symbol("V")
    steady = system.friction.mu.subs(symbol("phi"), _steady_age(system)).subs(symbol("v"), V)
    return sp.cancel(-V * sp.diff(steady, V))


def _estimate(system: System) -> sp.Expr:
    """Return C4 Omega^4/C0 at Omega = V/D0 for W0 = kappa D0."""
    V, D0, W0, kappa = _s("V D0 W0 kappa")
    c = paper_coefficients(characteristic_polynomial(system))
    return sp.cancel((c[4] * (V / D0) ** 4 / c[0]).subs(W0, kappa * D0))


FORMS: dict[str, Form] = {
    "friction": lambda system: system.friction.mu,
    "ageing": lambda system: state_rate(system, system.friction.states[0]),
    "stiffness": lambda system: system.interface.kappa,
    "force": _force,
    "interface_force": lambda system: symbol("W") * system.friction.mu,
    "u_rate": lambda system: equations_of(system).rates[0],
    "z_rate": _z_rate,
    "v_rate": lambda system: symbol("v") * equations_of(system).rates[2],
    "phi_rate": lambda system: symbol("phi") * equations_of(system).rates[3],
    "steady_age": _steady_age,
    "slip_velocity": slip_velocity,
    "eta": eta,
    "slider_force": _slider_force,
    "steady_position": _steady_position,
    "linear_force": _linear_force,
    "linear_age": _linear_age,
    **{f"C{k}": _coefficient(k) for k in range(5)},
    "critical_stiffness": critical_stiffness,
    "critical_frequency": critical_frequency,
    "weakening": _weakening,
    "estimate": _estimate,
}


def exact_estimate(system: System) -> sp.Expr:
    """Return C4 Omega_c^4/C0 at the exact Omega_c and W0c, in the law's parameters."""
    c = paper_coefficients(characteristic_polynomial(system))
    return in_law_parameters(system, c[4] * _closed(system)[3] ** 2 / c[0])
