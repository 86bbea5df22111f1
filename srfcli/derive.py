"""Steady state, linear stability and the dispersion relation of any system, in the paper's form and normalisation.

With perturbations proportional to exp(i Omega t) the paper writes C_4 Omega^4 + ... + C_0 = 0, C_0 = K V/D0
(Cochard, Bureau and Baumberger, appendix). Here the same determinant is built for any law, interface and loading.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import sympy as sp

from srfcli.expression import symbol
from srfcli.system import System, settle, shield, state_rate, steady_states


@dataclass(frozen=True)
class Linearisation:
    """The characteristic polynomial sum a_k s^k about steady sliding; C_k = i^k a_k with s = i Omega.

    `characteristic` is in the law's own parameters, `symbolic` in mu_v, mu_phi, kappa, eta and the apparatus'.
    `hurwitz` lists the coefficients in W0, lowest first, of the Hurwitz determinant that vanishes at a Hopf bifurcation,
    or is None where that is no polynomial in W0.
    """

    symbolic: tuple[sp.Expr, ...]
    characteristic: tuple[sp.Expr, ...]
    mu_v: sp.Expr
    mu_phi: tuple[sp.Expr, ...]
    hurwitz: tuple[sp.Expr, ...] | None
    names: dict[str, str] = field(default_factory=dict)

    @property
    def polynomial_degree(self) -> int:
        """Return the degree in W0 of the Hurwitz determinant, -1 where it is not a polynomial."""
        return -1 if self.hurwitz is None else len(self.hurwitz) - 1


def slope_symbols(system: System) -> tuple[sp.Symbol, tuple[sp.Symbol, ...]]:
    """Return the symbols mu_v and mu_phi (one for each state) of the paper."""
    phis = tuple(symbol(f"mu_{s.name}") for s in system.friction.states)
    return symbol("mu_v"), phis


def linearise(system: System) -> Linearisation:
    """Return the linear stability problem of `system` about steady sliding at V under W0."""
    v, V = symbol("v"), symbol("V")
    steady = dict(zip([symbol(s.name) for s in system.friction.states], steady_states(system), strict=True))
    mu = system.friction.mu

    def at_rest(expression: sp.Expr) -> sp.Expr:
        return expression.subs(steady).subs(v, V)

    mu_v = settle(at_rest(v * sp.diff(mu, v)))
    mu_phi = tuple(settle(at_rest(p * sp.diff(mu, p))) for p in steady)
    symbolic = characteristic_polynomial(system)
    m_v, m_phi = slope_symbols(system)
    W, kappa, mu0 = symbol("W"), symbol("kappa"), symbol("mu_ss")
    law = system.interface.kappa
    meaning: list[tuple[sp.Expr, sp.Expr]] = [(m_v, mu_v), *zip(m_phi, mu_phi, strict=True), (mu0, at_rest(mu))]
    if law is not None:
        meaning.append((symbol("kappa_W"), sp.diff(law, W).subs(W, symbol("W0"))))
        meaning.append((kappa, law.subs(W, symbol("W0"))))
    characteristic = tuple(e.subs(meaning) for e in symbolic)
    hurwitz = _hurwitz_in_load(symbolic, meaning[-2:] if law is not None else [])
    if hurwitz is not None:
        hurwitz = tuple(e.subs(meaning) for e in hurwitz)
    names = {"mu_v": str(mu_v), **{str(s): str(e) for s, e in zip(m_phi, mu_phi, strict=True)}}
    return Linearisation(symbolic, characteristic, mu_v, mu_phi, hurwitz, names)


def characteristic_polynomial(system: System) -> tuple[sp.Expr, ...]:
    """Return a_0..a_n of the characteristic polynomial in s, in mu_v, mu_phi, kappa and the apparatus' symbols.

    Rows: force balance, slip relation, one ageing law a state; columns: position x, ln v, ln phi of each state.
    Normalised so that a_0 = K V/D0 for the paper's system: the determinant over -V.
    """
    s, v, V, K, W0 = sp.Symbol("s"), symbol("v"), symbol("V"), symbol("K"), symbol("W0")
    m_v, m_phi = slope_symbols(system)
    n = len(m_phi)
    mass = symbol("M") if system.inertia else sp.S.Zero
    mu_ss, kappa, kappa_W = symbol("mu_ss"), symbol("kappa"), symbol("kappa_W")
    tangent = sp.tan(symbol("angle")) if system.loading == "inclined" else sp.S.Zero
    unit = sp.eye(n + 2)
    d_x, d_v = unit.row(0), unit.row(1)
    d_phi = [unit.row(2 + i) for i in range(n)]
    d_mu = m_v * d_v + sum((m * d for m, d in zip(m_phi, d_phi, strict=True)), sp.zeros(1, n + 2))
    d_load = -tangent * K * d_x
    rows = [(mass * s**2 + K) * d_x + W0 * d_mu + mu_ss * d_load]
    slip = s * d_x - V * d_v
    if system.elastic:  # d(W mu/kappa)/dt
        slip -= s * (W0 / kappa * d_mu + mu_ss * (1 / kappa - W0 * kappa_W / kappa**2) * d_load)
    rows.append(slip)
    still = {symbol(k): sp.S.Zero for k in ("mu_dot", "W_dot", "F_dot_over_W")}
    steady = steady_states(system)
    for i, state in enumerate(system.friction.states):
        phi = symbol(state.name)
        rate = state_rate(system, state) / phi
        at = [(phi, steady[i]), (v, V), (symbol("mu"), mu_ss), (symbol("W"), W0)]

        def slope(name: str, rate: sp.Expr = rate, at: list[tuple[sp.Expr, sp.Expr]] = at) -> sp.Expr:
            d = sp.diff(rate, symbol(name)).subs(still)
            return settle(d.subs(at))

        d_rate = V * slope("v") * d_v + steady[i].subs(v, V) * slope(state.name) * d_phi[i] + slope("mu") * d_mu
        d_rate += slope("W") * d_load + slope("mu_dot") * s * d_mu + slope("W_dot") * s * d_load
        d_rate += slope("F_dot_over_W") * s * (d_mu + mu_ss / W0 * d_load)
        rows.append(s * d_phi[i] - d_rate)
    matrix, back = shield(sp.Matrix.vstack(*rows))
    coefficients = sp.Poly(sp.expand(matrix.det(method="berkowitz") / -V), s).all_coeffs()[::-1]
    return tuple(sp.factor_terms(sp.simplify(c)).xreplace(back) for c in coefficients)


def paper_coefficients(symbolic: tuple[sp.Expr, ...]) -> tuple[sp.Expr, ...]:
    """Return C_0..C_n of the dispersion relation in Omega: C_k = i^k a_k."""
    return tuple(sp.I**k * a for k, a in enumerate(symbolic))


def hurwitz_determinant(a: tuple[sp.Expr, ...]) -> sp.Expr:
    """Return the Hurwitz determinant of order n-1 of sum a_k s^k: zero where a pair of roots sums to zero."""
    n = len(a) - 1

    def coefficient(k: int) -> sp.Expr:
        return a[n - k] if 0 <= k <= n else sp.S.Zero

    return sp.Matrix(n - 1, n - 1, lambda i, j: coefficient(2 * (j + 1) - (i + 1))).det(method="berkowitz")


def _hurwitz_in_load(symbolic: tuple[sp.Expr, ...], meaning: list[tuple[sp.Expr, sp.Expr]]) -> tuple[sp.Expr, ...] | None:
    """Return the coefficients in W0 of the numerator of the Hurwitz determinant, lowest first, or None."""
    W0 = symbol("W0")
    shielded, back = shield(sp.Matrix([a.subs(meaning) for a in symbolic]))
    numerator = sp.numer(sp.together(hurwitz_determinant(tuple(shielded))))
    try:
        polynomial = sp.Poly(sp.expand(numerator), W0)
    except sp.PolynomialError:
        return None
    if any(W0 in c.free_symbols for c in polynomial.all_coeffs()):
        return None
    return tuple(c.xreplace(back) for c in polynomial.all_coeffs()[::-1])
