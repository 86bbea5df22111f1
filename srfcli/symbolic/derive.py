"""Steady state, linear stability, dispersion relation and, where there is one, the closed form of the critical load.

With perturbations proportional to exp(i Omega t) the paper writes C_4 Omega^4 + ... + C_0 = 0, C_0 = K V/D0
(Cochard, Bureau and Baumberger, appendix). Here the same determinant is built for any law, interface and loading.

At a Hopf bifurcation Omega is real: the even coefficients of the characteristic polynomial and the odd ones vanish apart.
The odd part is linear in W0; put into the even part it leaves one factor linear in Omega^2 that is no degenerate W0 = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import sympy as sp

from srfcli.laws.expression import symbol
from srfcli.laws.values import Interface
from srfcli.symbolic.equations import settle, steady_states
from srfcli.symbolic.system import System, state_rate


@dataclass(frozen=True)
class Linearisation:
    """The characteristic polynomial sum a_k s^k about steady sliding; C_k = i^k a_k with s = i Omega.

    `characteristic` is in the law's own parameters.
    `hurwitz` lists the coefficients in W0, lowest first, of the Hurwitz determinant that vanishes at a Hopf bifurcation,
    or is None where that is no polynomial in W0.
    """

    characteristic: tuple[sp.Expr, ...]
    hurwitz: tuple[sp.Expr, ...] | None
    names: dict[str, str] = field(default_factory=dict)


def slope_symbols(system: System) -> tuple[sp.Symbol, tuple[sp.Symbol, ...]]:
    """Return the symbols mu_v and mu_phi (one for each state) of the paper."""
    phis = tuple(symbol(f"mu_{s.name}") for s in system.friction.states)
    return symbol("mu_v"), phis


def linearise(system: System) -> Linearisation:
    """Return the linear stability problem of `system` about steady sliding at V under W0."""
    abbreviated, back = abbreviated_polynomial(system)
    symbolic = tuple(c.xreplace(back) for c in abbreviated)
    meaning = slope_meaning(system)
    stiffness = interface_meaning(system)
    characteristic = tuple(e.subs([*meaning, *stiffness]) for e in symbolic)
    hurwitz = _hurwitz_in_load(abbreviated, stiffness)
    if hurwitz is not None:
        hurwitz = tuple(e.xreplace(back).subs(meaning) for e in hurwitz)
    names = {str(s): str(e) for s, e in meaning[:-1]}
    return Linearisation(characteristic, hurwitz, names)


@lru_cache(maxsize=32)
def friction_slopes(system: System) -> tuple[sp.Expr, tuple[sp.Expr, ...], sp.Expr]:
    """Return mu_v, mu_phi of each state and mu_ss, in steady sliding at V, in the law's own parameters."""
    v, V, mu = symbol("v"), symbol("V"), system.friction.mu
    steady = dict(zip([symbol(s.name) for s in system.friction.states], steady_states(system), strict=True))

    def at_rest(expression: sp.Expr) -> sp.Expr:
        return expression.subs(steady).subs(v, V)

    mu_phi = tuple(settle(at_rest(p * sp.diff(mu, p))) for p in steady)
    return settle(at_rest(v * sp.diff(mu, v))), mu_phi, at_rest(mu)


def slope_meaning(system: System) -> list[tuple[sp.Expr, sp.Expr]]:
    """Return what mu_v, mu_phi of each state and mu_ss are in the law's own parameters, in this order."""
    mu_v, mu_phi, mu_ss = friction_slopes(system)
    m_v, m_phi = slope_symbols(system)
    return [(m_v, mu_v), *zip(m_phi, mu_phi, strict=True), (symbol("mu_ss"), mu_ss)]


def interface_meaning(system: System) -> list[tuple[sp.Expr, sp.Expr]]:
    """Return what kappa_W = d kappa/dW and kappa are at the load W0, in this order; nothing for a rigid interface."""
    law, at_load = system.interface.kappa, (symbol("W"), symbol("W0"))
    if law is None:
        return []
    return [(symbol("kappa_W"), sp.diff(law, symbol("W")).subs(*at_load)), (symbol("kappa"), law.subs(*at_load))]


def characteristic_polynomial(system: System) -> tuple[sp.Expr, ...]:
    """Return a_0..a_n of the characteristic polynomial in s, in mu_v, mu_phi, kappa and the apparatus' symbols.

    Normalised so that a_0 = K V/D0 for the paper's system.
    """
    coefficients, back = abbreviated_polynomial(system)
    return tuple(c.xreplace(back) for c in coefficients)


@lru_cache(maxsize=32)
def abbreviated_polynomial(system: System) -> tuple[tuple[sp.Expr, ...], dict[sp.Symbol, sp.Expr]]:
    """Return a_0..a_n with long slopes of the ageing law as single symbols, and what these stand for.

    Rows: force balance, slip relation, one ageing law a state; columns: position x, ln v, ln phi of each state. The
    determinant is taken over -V.
    """
    s, V, K, W0 = sp.Symbol("s"), symbol("V"), symbol("K"), symbol("W0")
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
    back: dict[sp.Symbol, sp.Expr] = {}
    for i, slopes in enumerate(ageing_slopes(system)):
        g = {name: _abbreviate(e, f"g_{name}{i}", back) for name, e in slopes.items()}
        d_rate = g["v"] * d_v + g["phi"] * d_phi[i] + g["mu"] * d_mu + g["W"] * d_load
        d_rate += g["mu_dot"] * s * d_mu + g["W_dot"] * s * d_load
        d_rate += g["F_dot_over_W"] * s * (d_mu + mu_ss / W0 * d_load)
        rows.append(s * d_phi[i] - d_rate)
    determinant = sp.Matrix.vstack(*rows).det(method="berkowitz") / -V
    coefficients = sp.Poly(sp.expand(determinant), s).all_coeffs()[::-1]
    return tuple(sp.factor_terms(sp.cancel(c)) for c in coefficients), back


def _abbreviate(slope: sp.Expr, name: str, back: dict[sp.Symbol, sp.Expr]) -> sp.Expr:
    """Return `slope`, or a symbol for it where it is transcendental or has roots: algebra would only tear it apart."""
    torn = slope.has(sp.exp, sp.log, sp.LambertW) or any(not p.exp.is_Integer for p in slope.atoms(sp.Pow))
    if not torn or slope.has(symbol("W0")):
        return slope
    for known, value in back.items():
        if value == slope:
            return known
    stand_in = sp.Symbol(name, real=True)
    back[stand_in] = slope
    return stand_in


def ageing_slopes(system: System) -> tuple[dict[str, sp.Expr], ...]:
    """Return for each state what d(ln phi)/dt changes by with ln v, ln phi, mu, W and the rates, in steady sliding."""
    ages = zip(system.friction.states, steady_states(system), strict=True)
    return tuple(_slopes(state_rate(system, state), symbol(state.name), age) for state, age in ages)


@lru_cache(maxsize=32)  # of a rigid interface, and without inertia, they are the same
def _slopes(rate: sp.Expr, phi: sp.Symbol, age: sp.Expr) -> dict[str, sp.Expr]:
    v, V = symbol("v"), symbol("V")
    still = {symbol(k): sp.S.Zero for k in ("mu_dot", "W_dot", "F_dot_over_W")}
    at = [(phi, age), (v, V), (symbol("mu"), symbol("mu_ss")), (symbol("W"), symbol("W0"))]
    names = {"v": v, "phi": phi, **{k: symbol(k) for k in ("mu", "W", "mu_dot", "W_dot", "F_dot_over_W")}}
    slopes = {k: settle(sp.diff(rate / phi, x).subs(still).subs(at)) for k, x in names.items()}
    slopes["v"] = settle(V * slopes["v"])
    slopes["phi"] = settle(age.subs(v, V) * slopes["phi"])
    return slopes


def paper_coefficients(symbolic: tuple[sp.Expr, ...]) -> tuple[sp.Expr, ...]:
    """Return C_0..C_n of the dispersion relation in Omega: C_k = i^k a_k."""
    return tuple(sp.I**k * a for k, a in enumerate(symbolic))


def hurwitz_determinant(a: tuple[sp.Expr, ...]) -> sp.Expr:
    """Return the Hurwitz determinant of order n-1 of sum a_k s^k: zero where a pair of roots sums to zero."""
    n = len(a) - 1

    def coefficient(k: int) -> sp.Expr:
        return a[n - k] if 0 <= k <= n else sp.S.Zero

    return sp.Matrix(n - 1, n - 1, lambda i, j: coefficient(2 * (j + 1) - (i + 1))).det(method="berkowitz")


def _hurwitz_in_load(coefficients: tuple[sp.Expr, ...], stiffness: list[tuple[sp.Expr, sp.Expr]]) -> tuple[sp.Expr, ...] | None:
    """Return the coefficients in W0 of the Hurwitz determinant over a power of W0, lowest first, or None."""
    W0 = symbol("W0")
    fractions = [sp.fraction(sp.cancel(a.subs(stiffness))) for a in coefficients]
    common = sp.S.One
    for _, denominator in fractions:
        common = sp.lcm(common, denominator)
    whole = tuple(sp.cancel(n * common / d) for n, d in fractions)
    if not all(a.is_polynomial(W0) for a in whole):
        return None
    # each coefficient of a power of W0 as one symbol: its inside plays no role here
    parts: dict[sp.Symbol, sp.Expr] = {}
    short = []
    for k, a in enumerate(whole):
        terms = sp.Poly(a, W0).all_coeffs()[::-1]
        names = [sp.Symbol(f"a{k}_{j}") if c != 0 else sp.S.Zero for j, c in enumerate(terms)]
        parts.update({s: sp.factor_terms(c) for s, c in zip(names, terms, strict=True) if c != 0})
        short.append(sum((s * W0**j for j, s in enumerate(names)), sp.S.Zero))
    determinant = sp.Poly(hurwitz_determinant(tuple(short)), W0)
    found = [c.xreplace(parts) for c in determinant.all_coeffs()[::-1]]
    found = [sp.S.Zero if _vanishes(c) else c for c in found]  # else rounding makes roots next to 0 and to infinity
    while found and found[0] == 0:
        found.pop(0)
    while found and found[-1] == 0:
        found.pop()
    return tuple(found) or None


def _vanishes(expression: sp.Expr) -> bool:
    """Return whether a rational function of symbols and function values is zero, by exact arithmetic at an arbitrary point."""
    atoms = sorted(expression.atoms(sp.Function), key=lambda e: (-sp.count_ops(e), str(e)))
    for atom in atoms:
        expression = expression.xreplace({atom: sp.Symbol(f"value_of_{atom}")})
    symbols = sorted(expression.free_symbols, key=str)
    point = {s: sp.Rational(sp.prime(i + 20), sp.prime(2 * i + 51)) for i, s in enumerate(symbols)}
    return bool(sp.cancel(expression.xreplace(point)) == 0)


# Closed forms of the critical load and frequency of one-state systems, by elimination from the dispersion relation.


@dataclass(frozen=True)
class ClosedLimits:
    """W0c and Omega_c^2 in mu_v, mu_phi, mu_ss, the interface's and the apparatus' symbols; None where not closed.

    `load` is exact for any kappa and M and holds the symbol Omega_c where inertia counts; `limit_load` is that for kappa to
    infinity, `quasistatic_load` for kappa to infinity without inertia. Omega_c is the paper's where the ageing law is linearised
    as it is (`common_ageing`). A load counts where it is positive and Omega_c is real.
    """

    omega_squared: sp.Expr | None
    load: sp.Expr | None
    limit_load: sp.Expr | None
    quasistatic_load: sp.Expr | None


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
    return ClosedLimits(None if free is None else free[1], load, limit_load, quasistatic_load)


def in_law_parameters(system: System, expression: sp.Expr) -> sp.Expr:
    """Return `expression` with mu_v, mu_phi, mu_ss and kappa written out for the laws of `system`."""
    return expression.subs([*slope_meaning(system), *interface_meaning(system)])


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
