"""What each printed equation of the paper should say, derived from the model: the law, the interface and Newton's equation.

Symbols as in data/paper.toml: x_1 is x', x_3 is x''', coswt is cos(omega t).
"""

from __future__ import annotations

from collections.abc import Callable

import sympy as sp

from srfcli.closed_limits import closed_limits, in_law_parameters
from srfcli.derive import characteristic_polynomial, paper_coefficients
from srfcli.equations import equations_of
from srfcli.expression import symbol
from srfcli.system import System, state_rate

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
    limits = closed_limits(system)
    assert limits is not None and limits.limit_load is not None and limits.omega_squared is not None
    load = limits.limit_load.subs(Omega**2, limits.omega_squared)
    return sp.factor(sp.solve(sp.Eq(W0, load), K)[0] * D0 / W0)


def critical_frequency(system: System) -> sp.Expr:
    """Return D0 Omega_c/V."""
    V, D0 = _s("V D0")
    limits = closed_limits(system)
    assert limits is not None and limits.omega_squared is not None
    return sp.sqrt(sp.cancel(limits.omega_squared * D0**2 / V**2))


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
    limits = closed_limits(system)
    assert limits is not None and limits.load is not None and limits.omega_squared is not None
    c = paper_coefficients(characteristic_polynomial(system))
    ratio = c[4] * limits.omega_squared**2 / c[0]
    return in_law_parameters(system, ratio)
