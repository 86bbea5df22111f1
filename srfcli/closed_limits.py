"""Closed forms of the critical load and frequency of one-state systems, by elimination from the dispersion relation.

At a Hopf bifurcation Omega is real: the even coefficients of the characteristic polynomial and the odd ones vanish apart.
The odd part is linear in W0; put into the even part it leaves one factor linear in Omega^2 that is no degenerate W0 = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import sympy as sp

from srfcli.derive import ageing_slopes, characteristic_polynomial, friction_slopes, interface_meaning, slope_symbols
from srfcli.expression import symbol
from srfcli.laws import Interface
from srfcli.system import System


@dataclass(frozen=True)
class ClosedLimits:
    """W0c and Omega_c^2 in mu_v, mu_phi, mu_ss, the interface's and the apparatus' symbols; `load` None where not closed.

    `limit_load` is kappa to infinity, `quasistatic_load` that without inertia. `common_ageing` says that the ageing law
    is linearised as -(V/D0) (d ln v + d ln phi), for which Omega_c is the paper's. W0c counts where it is positive and
    Omega_c is real.
    """

    omega_squared: sp.Expr
    load: sp.Expr | None
    limit_load: sp.Expr
    quasistatic_load: sp.Expr
    common_ageing: bool


def common_ageing(system: System) -> bool:
    """Return whether every state obeys d(ln phi)'/dt = -(V/length) (d ln v + d ln phi) next to steady sliding at fixed load."""
    V = symbol("V")
    for state, slopes in zip(system.friction.states, ageing_slopes(system), strict=True):
        expected = -V / symbol(state.length)
        if any(sp.simplify(slopes[k] - expected) != 0 for k in ("v", "phi")):
            return False
        if any(slopes[k] != 0 for k in ("mu", "mu_dot", "F_dot_over_W")):
            return False
        if system.loading == "inclined" and any(slopes[k] != 0 for k in ("W", "W_dot")):
            return False
    return True


def closed_limits(system: System) -> ClosedLimits | None:
    """Return the closed forms of `system`, or None: more than one state, or Omega_c and W0c that cannot be told apart.

    Under an inclined spring an ageing law that feels W_dot has none in general, but in the limits.
    """
    if len(system.friction.states) != 1:
        return None
    rigid = replace(system, interface=Interface("rigid"))
    limit = _eliminate(rigid)
    if limit is None:
        return None
    slow = _eliminate(replace(rigid, inertia=False))
    exact = _eliminate(system)
    if exact is None and system.elastic:  # kappa a number of its own: Omega_c may still be closed
        free = _eliminate(system, stiffness=False)
        omega, load = (free[1] if free else limit[1]), None
        if free is None or sp.simplify(free[1] - limit[1]) != 0:
            return None
    elif exact is None:
        return None
    else:
        load, omega = exact
    if slow is None:
        return None
    return ClosedLimits(omega, load, limit[0], slow[0], common_ageing(system))


def closed_critical_load(system: System) -> tuple[sp.Expr, sp.Expr] | None:
    """Return (W0c, Omega_c) for any kappa and M, or None where they are not closed."""
    found = closed_limits(system)
    if found is None or found.load is None:
        return None
    return found.load, sp.sqrt(found.omega_squared)


def in_law_parameters(system: System, expression: sp.Expr) -> sp.Expr:
    """Return `expression` with mu_v, mu_phi, mu_ss and kappa written out for the laws of `system`."""
    mu_v, mu_phi, mu_ss = friction_slopes(system)
    m_v, m_phi = slope_symbols(system)
    meaning = [(m_v, mu_v), *zip(m_phi, mu_phi, strict=True), (symbol("mu_ss"), mu_ss), *interface_meaning(system)]
    return expression.subs(meaning)


def _eliminate(system: System, *, stiffness: bool = True) -> tuple[sp.Expr, sp.Expr] | None:
    """Return (W0c, Omega_c^2), W0c with Omega_c left in as the symbol Omega_c where inertia counts, or None."""
    X, W0, M = sp.Symbol("X"), symbol("W0"), symbol("M")
    a = characteristic_polynomial(system)
    stand_ins: dict[sp.Expr, sp.Symbol] = {}
    meaning = interface_meaning(system) if stiffness else []
    a = tuple(_rational(sp.cancel(e.subs(meaning)), stand_ins) for e in a)
    even = sum(((-X) ** k * c for k, c in enumerate(a[0::2])), sp.S.Zero)
    odd = sum(((-X) ** k * c for k, c in enumerate(a[1::2])), sp.S.Zero)
    numerator = sp.numer(sp.together(odd))
    if not numerator.is_polynomial(W0) or sp.degree(numerator, W0) != 1:
        return None
    slope, offset = sp.Poly(numerator, W0).all_coeffs()
    load = sp.cancel(-offset / slope)
    rest = sp.numer(sp.together(even.subs(W0, load)))
    if not rest.is_polynomial(X):
        return None
    roots = []
    for factor, _ in sp.factor_list(rest, X)[1]:
        if sp.degree(factor, X) == 0 or sp.rem(sp.numer(load), factor, X) == 0:  # W0 = 0: a slider without load
            continue
        if sp.degree(factor, X) != 1:
            return None
        one, zero = sp.Poly(factor, X).all_coeffs()
        roots.append(sp.factor(-zero / one))
    if len(roots) != 1 or roots[0].has(M):
        return None
    back = {s: e for e, s in stand_ins.items()}
    Omega = symbol("Omega_c")
    return _arrange(load.subs(X, Omega**2)).xreplace(back), roots[0].xreplace(back)


def _rational(expression: sp.Expr, stand_ins: dict[sp.Expr, sp.Symbol]) -> sp.Expr:
    """Return `expression` with its transcendental parts as symbols, which `stand_ins` collects."""
    for atom in sorted(expression.atoms(sp.exp, sp.log, sp.LambertW, sp.tan), key=lambda e: (-sp.count_ops(e), str(e))):
        expression = expression.xreplace({atom: stand_ins.setdefault(atom, sp.Symbol(f"part{len(stand_ins)}", real=True))})
    return expression


def _arrange(load: sp.Expr) -> sp.Expr:
    """Return the load as a product of factors, the stiffness left over by inertia written K - M Omega_c^2."""
    factored = sp.factor(load)
    numerator, denominator = sp.fraction(factored)
    if sp.Poly(denominator, *sorted(denominator.free_symbols, key=str)).LC() < 0:
        numerator, denominator = -numerator, -denominator
    signed = sp.Mul(*[_positive_first(f) for f in sp.Mul.make_args(sp.factor(numerator))])
    return signed / denominator


def _positive_first(factor: sp.Expr) -> sp.Expr:
    return factor
