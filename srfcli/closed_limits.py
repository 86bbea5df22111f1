"""Closed forms of the critical load and frequency of one-state systems, by elimination from the dispersion relation.

At a Hopf bifurcation Omega is real: the even coefficients of the characteristic polynomial and the odd ones vanish apart.
The odd part is linear in W0; put into the even part it leaves one factor linear in Omega^2 that is no degenerate W0 = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import sympy as sp

from srfcli.derive import abbreviated_polynomial, ageing_slopes, friction_slopes, interface_meaning, slope_symbols
from srfcli.expression import symbol
from srfcli.laws import Interface
from srfcli.system import System


@dataclass(frozen=True)
class ClosedLimits:
    """W0c and Omega_c^2 in mu_v, mu_phi, mu_ss, the interface's and the apparatus' symbols; None where not closed.

    `load` is exact for any kappa and M and holds the symbol Omega_c where inertia counts; `limit_load` is that for kappa to
    infinity, `quasistatic_load` for kappa to infinity without inertia. `common_ageing` says that the ageing law is
    linearised as -(V/D0) (d ln v + d ln phi), for which Omega_c is the paper's. A load counts where it is positive and
    Omega_c is real.
    """

    omega_squared: sp.Expr | None
    load: sp.Expr | None
    limit_load: sp.Expr | None
    quasistatic_load: sp.Expr | None
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


@lru_cache(maxsize=32)
def closed_limits(system: System) -> ClosedLimits | None:
    """Return the closed forms of `system`, or None where there is none: more than one state, say.

    Under an inclined spring an ageing law that feels W_dot has the quasi-static one alone.
    """
    if len(system.friction.states) != 1:
        return None
    rigid = replace(system, interface=Interface("rigid"))
    slow = _eliminate(replace(rigid, inertia=False))
    limit = _eliminate(rigid) if system.inertia else slow
    exact = _eliminate(system) if system.elastic else limit
    free = exact
    if exact is None and system.elastic:  # with kappa as a number of its own Omega_c may still be closed
        free = _eliminate(system, stiffness=False)
    if free is None and limit is None and slow is None:
        return None
    load, limit_load, quasistatic_load = (None if e is None else e[0] for e in (exact, limit, slow))
    return ClosedLimits(None if free is None else free[1], load, limit_load, quasistatic_load, common_ageing(system))


def closed_critical_load(system: System) -> tuple[sp.Expr, sp.Expr] | None:
    """Return (W0c, Omega_c) for any kappa and M, or None where they are not closed."""
    found = closed_limits(system)
    if found is None or found.load is None or found.omega_squared is None:
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
    X, W0 = sp.Symbol("X"), symbol("W0")
    coefficients, back = abbreviated_polynomial(system)
    tangent = sp.Symbol("tangent", real=True)
    back = {**back, tangent: sp.tan(symbol("angle"))}
    meaning = interface_meaning(system) if stiffness else []
    a = [sp.cancel(e.subs(meaning).subs(back[tangent], tangent)) for e in coefficients]
    even = sum(((-X) ** k * c for k, c in enumerate(a[0::2])), sp.S.Zero)
    odd = sp.numer(sp.together(sum(((-X) ** k * c for k, c in enumerate(a[1::2])), sp.S.Zero)))
    if not odd.is_polynomial(W0) or sp.degree(odd, W0) != 1:
        return None
    slope, offset = sp.Poly(odd, W0).all_coeffs()
    load = sp.cancel(-offset / slope)
    rest = sp.numer(sp.together(even.subs(W0, load)))
    if not rest.is_polynomial(X):
        return None
    frequencies = [f for f, _ in sp.factor_list(rest, X)[1] if f.has(X) and not _degenerate(load, f, X)]
    if len(frequencies) != 1 or sp.degree(frequencies[0], X) != 1 or frequencies[0].has(symbol("M")):
        return None
    one, zero = sp.Poly(frequencies[0], X).all_coeffs()
    omega_squared = sp.factor(-zero / one)
    return _arranged(load.subs(X, symbol("Omega_c") ** 2)).xreplace(back), omega_squared.xreplace(back)


def _degenerate(load: sp.Expr, factor: sp.Expr, X: sp.Symbol) -> bool:
    """Return whether `factor` = 0 puts no load, or an infinite one, on the slider."""
    return any(sp.rem(part, factor, X) == 0 for part in sp.fraction(load) if part.has(X))


def _arranged(load: sp.Expr) -> sp.Expr:
    """Return the load as a product of factors that are positive where friction weakens."""
    numerator, denominator = (sp.Mul.make_args(sp.factor(part)) for part in sp.fraction(sp.factor(load)))
    if not all(isinstance(f, sp.Expr) for f in (*numerator, *denominator)):
        return load
    negative = sum(_negative(f) for f in (*numerator, *denominator)) % 2
    above, below = (sp.Mul(*[_grouped(-f if _negative(f) else f) for f in part]) for part in (numerator, denominator))
    return -above / below if negative else above / below


def _negative(factor: sp.Expr) -> bool:
    """Return whether `factor` is negative in a typical state: weakening friction, weak inertia, a short elastic length."""
    small = {"mu_v": "0.01", "mu_phi": "0.02", "mu_ss": "0.3", "tangent": "0.1", "M": "0.001"}
    typical = {s: sp.Rational(small.get(s.name, "1")) for s in factor.free_symbols}
    return bool(factor.subs(typical) < 0)


def _grouped(factor: sp.Expr) -> sp.Expr:
    """Return a sum with what multiplies lambda and K gathered, differences of slopes as mu_phi - mu_v."""
    if not factor.is_Add:
        return factor
    return sp.collect(factor, [symbol("lambda"), symbol("K")], func=weakening_first)


def weakening_first(inside: sp.Expr) -> sp.Expr:
    """Return a factor written as the one that is positive where friction weakens, with a sign in front where need be."""
    inside = sp.factor_terms(inside)
    return sp.Mul(-1, -inside, evaluate=False) if inside.is_Add and _negative(inside) else inside
