"""A derivation as a reader sees it: sections of named formulas, in the paper's letters and normalisation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import sympy as sp

from srfcli.closed_limits import ClosedLimits, closed_limits, in_law_parameters, weakening_first
from srfcli.derive import characteristic_polynomial, friction_slopes, paper_coefficients, slope_symbols
from srfcli.equations import equations_of, steady_states
from srfcli.expression import symbol
from srfcli.notation import latex_name
from srfcli.system import System, state_rate
from srfcli.units import to_base

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

    def without_zeros(self) -> Section:
        """Return the section without the formulas that are zero."""
        return replace(self, formulas=tuple(f for f in self.formulas if f.value != 0))


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
    formulas += [
        _one(s.name, e.subs(symbol("v"), V)) for s, e in zip(system.friction.states, steady_states(system), strict=True)
    ]
    formulas += [_one("mu_ss", mu_ss), _one("u", symbol("W0") * symbol("mu_ss") / symbol("K"))]
    return Section("steady", "Steady sliding at V under W0", tuple(formulas))


def _slopes(system: System) -> Section:
    mu_v, mu_phi, _ = friction_slopes(system)
    m_v, m_phi = slope_symbols(system)
    formulas = [_one(str(m_v), mu_v), *(_one(str(m), e) for m, e in zip(m_phi, mu_phi, strict=True))]
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
            value = eq.derivative(rate, j)
            text, latex = _partial(name, other)
            formulas.append(Formula(text, latex, sp.factor_terms(value)))
    return Section(
        "jacobian", "Jacobian", tuple(formulas), ("derivatives that are not listed are zero",)
    ).without_zeros()


def _parameters(system: System) -> Section:
    eq, t = equations_of(system), symbol("t")
    W0, eps, f = symbol("W0"), symbol("eps"), symbol("f")
    load = W0 * (1 + eps * sp.cos(2 * sp.pi * f * t))
    imposed = {symbol("W"): load, symbol("W_dot"): sp.diff(load, t)}
    formulas = []
    for name, rate in zip(eq.names, eq.rates, strict=True):
        driven = rate.subs(imposed)
        for parameter in system.parameters:
            text, latex = _partial(name, parameter.name)
            formulas.append(Formula(text, latex, sp.factor_terms(sp.diff(driven, symbol(parameter.name)))))
    note = "with the imposed load W0 (1 + eps cos(2 pi f t)); derivatives that are not listed are zero"
    return Section("parameters", "Derivatives by the parameters", tuple(formulas), (note,)).without_zeros()


def _partial(name: str, other: str) -> tuple[str, str]:
    text, latex = _rate_name(name)
    below = rf"\ln {latex_name(other[3:])}" if other.startswith("ln_") else latex_name(other)
    return f"d{text}/d{other.replace('ln_', ' ln ')}", rf"\frac{{\partial {latex}}}{{\partial {below}}}"


def _dispersion(system: System) -> Section:
    coefficients = dispersion_coefficients(system)
    formulas = [Formula(f"C{k}", f"C_{{{k}}}", c) for k, c in enumerate(coefficients)]
    notes = [
        f"perturbations as exp(i Omega t): C0 + C1 Omega + ... + C{len(coefficients) - 1} Omega^{len(coefficients) - 1} = 0"
    ]
    if system.interface.kappa is not None:
        kappa = system.interface.kappa.subs(symbol("W"), symbol("W0"))
        if any(c.has(symbol("eta")) for c in coefficients):
            formulas.append(_one("eta", 1 + symbol("K") / symbol("kappa")))
        formulas.append(_one("kappa", kappa))
        if any(c.has(symbol("kappa_W")) for c in coefficients):
            formulas.append(
                _one("kappa_W", sp.diff(system.interface.kappa, symbol("W")).subs(symbol("W"), symbol("W0")))
            )
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
        return Section(
            "limits", "Closed forms of the critical load", (), ("none: more than one state variable, or no factor",)
        )
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
    if found.common_ageing:
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
