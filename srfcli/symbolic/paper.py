"""Equations and claims that Cochard, Bureau and Baumberger, J. Appl. Mech. 70, 220 (2003), print, against what the model gives.

Lines are those of their manuscript's TeX source. x_1 is x', x_3 is x''' (of x, or of delta x in the linearised equations);
coswt is cos(omega t); K_par is K || kappa.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import sympy as sp

from srfcli.core.units import to_base
from srfcli.laws.expression import parse_expression, symbol
from srfcli.laws.registry import bundled_registry
from srfcli.symbolic.derive import characteristic_polynomial, closed_limits, in_law_parameters, paper_coefficients
from srfcli.symbolic.equations import equations_of
from srfcli.symbolic.system import System, build_system, state_rate

SYMBOLS = (
    "A", "B", "D0", "F", "K", "K_par", "M", "V", "V0", "Vsat", "W", "W0", "coswt", "delta_phi", "delta_x", "eps", "eta", "kappa",
    "lambda", "mu", "mu0", "mu_phi", "mu_v", "phi", "t", "u", "v", "x", "x_1", "x_3", "xpl", "z",
)  # fmt: skip
VELOCITIES = (1.0, 100.0)  # um/s, the paper's range
THRESHOLD = 1e-3
REPEATABILITY = 0.03  # of the measured critical load


@dataclass(frozen=True)
class Equation:
    """A printed equation; `form` derives what it should say, `times_i` marks a factor i that the formula leaves out."""

    label: str
    line: int
    left: str
    printed: str
    form: Callable[[System], sp.Expr]
    note: str = ""
    times_i: bool = False


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


def paper_system() -> System:
    """Return the paper's model: its friction and ageing laws, kappa = W/lambda, vertical load, inertia."""
    return build_system(bundled_registry())


def check_paper() -> list[Finding]:
    """Return one finding for each printed equation, claim and wording, in this order."""
    system = paper_system()
    found = [check_equation(system, e) for e in EQUATIONS]
    for line, printed, check in CLAIMS:
        verdict, right = check(system)
        found.append(Finding("claim", "claim", line, verdict, printed, right))
    return found + [Finding("words", "in words", line, "misprint", *texts) for line, *texts in WORDS]


def check_equation(system: System, equation: Equation) -> Finding:
    """Return whether a printed equation equals the derived one; `right` is the printed one with the fault mended."""
    printed, right = parse_expression(equation.printed, SYMBOLS), equation.form(system)
    factor = sp.I if equation.times_i else sp.S.One
    verdict = "agrees" if _equal(factor * printed, right) else "misprint"
    shown = equation.printed if verdict == "agrees" else str(_like(right / factor, printed))
    before, after = (f"{equation.left} = {f'i*({text})' if equation.times_i else text}" for text in (equation.printed, shown))
    return Finding("equation", equation.label, equation.line, verdict, before, after, equation.note)


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
    (at,) = sp.solve(_weakening(system), symbol("V"))
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
    printed = in_law_parameters(system, _estimate(system)).subs(values)
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


# What each printed equation of the paper should say, derived from the model: the law, the interface and Newton's equation.


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


def _coefficient(k: int) -> Callable[[System], sp.Expr]:
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


def exact_estimate(system: System) -> sp.Expr:
    """Return C4 Omega_c^4/C0 at the exact Omega_c and W0c, in the law's parameters."""
    c = paper_coefficients(characteristic_polynomial(system))
    return in_law_parameters(system, c[4] * _closed(system)[3] ** 2 / c[0])


# What the paper prints: its equations, numerical claims, and slips in words.

EQUATIONS = (
    Equation("eq:frico", 139, "mu(v, phi)", "mu0 + A*log(v/V0) + B*log(1 + Vsat*phi/D0)", lambda system: system.friction.mu),
    Equation("eq:phidot", 146, "d phi/dt", "1 - v*phi/D0", lambda system: state_rate(system, system.friction.states[0])),
    Equation("kappa", 407, "kappa", "W/lambda", lambda system: system.interface.kappa),
    Equation("eq:newt", 412, "M x''", "K*(V*t - x) - kappa*(x - xpl)", _force),
    Equation("eq:newt0", 420, "(W/lambda) (x - xpl)", "W*(mu0 + A*log(v/V0) + B*log(1 + Vsat*phi/D0))",
             lambda system: symbol("W") * system.friction.mu),
    Equation("eq:dotu", 454, "u'", "V - z", lambda system: equations_of(system).rates[0]),
    Equation("eq:dotz", 456, "z'", "K/M*u - W0*(1 + eps*coswt)/M*(mu0 + A*log(v/V0) + B*log(1 + Vsat*phi/D0))", _z_rate),
    Equation("eq:dotv", 460, "v'", "v/(lambda*A)*(z - v - lambda*B*Vsat*(1 - v*phi/D0)/(D0*(1 + Vsat*phi/D0)))",
             lambda system: symbol("v") * equations_of(system).rates[2]),
    Equation("phi' (below eq:dotv)", 463, "phi'", "1 - v*phi/D0", lambda system: symbol("phi") * equations_of(system).rates[3]),
    Equation("steady sliding", 707, "phi", "D0/V", _steady_age),
    Equation("eq:slipv", 726, "v", "x_1 + (M*x_3 - K*(V - x_1))/kappa", slip_velocity),
    Equation("eta", 733, "eta", "(K + kappa)/kappa", eta),
    Equation("eta, by the series stiffness K || kappa", 733, "eta", "K/K_par", eta,
             "with K || kappa = K kappa/(K + kappa), the series stiffness; the parallel one, K + kappa, would not do"),
    Equation("eq:rfd", 738, "M x''", "K*(V*t - x) - W0*mu", _slider_force),
    Equation("steady position", 745, "x", "V*t - F/K", _steady_position),
    Equation("eq:linsystem, first line", 756, "M delta x''",
             "-K*delta_x - W0*((mu_v/V)*(eta*x_1 + M/kappa*x_3) + (mu_phi*V/D0)*delta_phi)", _linear_force),
    Equation("eq:linsystem, second line", 761, "delta phi'", "-eta*x_1/V - M/K*x_3/V - delta_phi*V/D0", _linear_age),
    Equation("eq:coefs, C0", 785, "C0", "K*V/D0", _coefficient(0)),
    Equation("eq:coefs, C1", 786, "C1", "W0/D0*(K*D0/W0 - eta*(mu_phi - mu_v))", _coefficient(1), times_i=True),
    Equation("eq:coefs, C2", 787, "C2", "-(M*V/D0 + eta*mu_v*W0/V)", _coefficient(2)),
    Equation("eq:coefs, C3", 788, "C3", "-M*W0/(kappa*D0)*(kappa*D0/W0 + (mu_v - mu_phi))", _coefficient(3), times_i=True),
    Equation("eq:coefs, C4", 790, "C4", "M*mu_v*W0/(kappa*V)", _coefficient(4)),
    Equation("eq:kcinert", 806, "K D0/W0c", "(mu_phi - mu_v)*(1 + M*V**2/(W0*D0*mu_v))", critical_stiffness),
    Equation("eq:pulsinert", 812, "D0 Omega_c/V", "sqrt((mu_phi - mu_v)/mu_v)", critical_frequency),
    Equation("eq:weakslope", 822, "-d mu_ss/d ln V", "B/(1 + V/Vsat) - A", _weakening),
    Equation("estimate of c", 831, "c", "mu_v*M*V**2/(K*D0**2)", _estimate),
)  # fmt: skip
CLAIMS = (
    (481, "Vsat, above which mu_d(V) increases with increasing V", _strengthening_velocity),
    (487, "at 10 um/s inertial terms can be neglected in eq:kcinert", _inertia_midrange),
    (639, "mu0 eps_eff/A is already larger than 1 for eps_eff = 0.1", _perturbation_parameter),
    (798, "Omega is purely imaginary at the Hopf bifurcation", _frequency_real),
    (833, "W0/(kappa D0) = lambda/D0 is about 1", _length_ratio),
    (834, "c < 1e-3 within the experimental velocity range", _estimate_small),
    (838, "a finite kappa changes C3 by terms of order mu_v, mu_phi, about 1e-2", _cubic_term),
    (843, "eta - 1 = K/kappa is about 1e-2", _eta_small),
    (845, "massless, elastic interface: no practical effect on the critical parameters", _finite_stiffness),
)
WORDS = (  # printed, right, and why
    (504, "(iv) for the determination of lambda", "(v)", "the item before it is (iv) already"),
    (528, "two complex conjugate values of the fundamental matrix",
     "two complex conjugate eigenvalues of the fundamental matrix over one period",
     "multipliers are eigenvalues; a value is not defined"),
    (558, "even ones corresponding to a transition from steading sliding to stick-slip", "from stick-slip to steady sliding",
     "the odd ones are said to be that; as W0 rises, stability is lost and regained by turns"),
    (616, "successive bifurcations from stick-slip to steady sliding then back to steady-sliding", "then back to stick-slip",
     "a stability boundary that is crossed twice returns to where it began"),
    (719, "the elongation of the loading spring is x-Vt", "Vt - x, which is u",
     "the spring pulls with K (Vt - x), printed in eq:slipv and eq:rfd, and steady sliding stretches it by F/K"),
    (730, "the equivalent stiffness of the loading spring in parallel with the interface", "in series with the interface",
     "eta = K/(K || kappa) equals the printed (K + kappa)/kappa for K || kappa = K kappa/(K + kappa), the series stiffness"),
)  # fmt: skip
