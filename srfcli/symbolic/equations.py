"""The first-order equations of a system: the laws' rates, the force balance and the slip relation, solved for the derivatives."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import sympy as sp
from sympy.solvers.solveset import NonlinearError

from srfcli.core.errors import SrfError
from srfcli.core.units import to_base
from srfcli.laws.expression import symbol
from srfcli.laws.values import ExtraState
from srfcli.symbolic.system import System, state_rate

AUXILIARY = {"slip": "v", "stage": "V", "time": "1"}  # unknowns that an effect may name, um, um, s, and their rates
CHECKED_VELOCITIES = tuple(10.0**k for k in range(-3, 4))  # um/s, at which steady states are checked
CHECKED_LOAD = 10.0  # N, the same
ROOT_ERROR = 1e-6  # of a root as it is evaluated, relative; roots of a squared equation that are none are off by themselves
MAX_CANCEL = 80  # operations: beyond it a common denominator takes a minute to find and shortens nothing


@dataclass(frozen=True)
class Equations:
    """x' = rates(x, t): `unknowns` are the symbols that stand in the formulas (v, not ln v), `logarithmic` says which.

    `load` is W as a function of the imposed load `W` and its rate `W_dot`; `spring` is the elongation u, an unknown or a formula;
    `reading` is what the gauge shows of it, `shown` the same without what effects make of the gauge, `stiffness` the spring's;
    `drive` is the velocity at which the spring is pulled.
    """

    names: tuple[str, ...]
    unknowns: tuple[sp.Symbol, ...]
    logarithmic: tuple[bool, ...]
    rates: tuple[sp.Expr, ...]
    spring: sp.Expr
    reading: sp.Expr
    shown: sp.Expr
    stiffness: sp.Expr
    drive: sp.Expr
    load: sp.Expr
    mu: sp.Expr
    steady: tuple[sp.Expr, ...]

    def derivative(self, expression: sp.Expr, index: int) -> sp.Expr:
        """Return d(expression)/d(unknown), by the logarithm where the unknown is logarithmic."""
        s = self.unknowns[index]
        d = partial_derivative(expression, s)
        return s * d if self.logarithmic[index] else d


@lru_cache(maxsize=1 << 15)  # a system has some ten thousand
def partial_derivative(formula: sp.Expr, s: sp.Symbol) -> sp.Expr:
    """Return what `sp.diff` returns, but each subexpression is differentiated once, whatever formulas it stands in."""
    if formula == s:
        return sp.S.One
    if not formula.args:
        return sp.S.Zero
    slopes = [(i, d) for i, a in enumerate(formula.args) if (d := partial_derivative(a, s)) != 0]
    if not slopes:
        return sp.S.Zero
    if isinstance(formula, sp.Add):
        return sp.Add(*(d for _, d in slopes))
    if isinstance(formula, sp.Mul):
        return sp.Add(*(sp.Mul(*formula.args[:i], d, *formula.args[i + 1 :]) for i, d in slopes))
    if isinstance(formula, sp.Pow):
        base, exponent = formula.args
        rise = partial_derivative(exponent, s) * sp.log(base)
        return formula * (rise + partial_derivative(base, s) * exponent / base)
    if isinstance(formula, sp.Function) and type(formula)._eval_derivative is sp.Function._eval_derivative:
        return sp.Add(*(formula.fdiff(i + 1) * d for i, d in slopes))
    return sp.diff(formula, s)


class lut(sp.Function):
    """lut(i, x): the i-th table, a cubic spline of x whose numbers follow the parameters."""

    nargs = 2

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Return the slope by x."""
        return lut1(*self.args)


class lut1(sp.Function):
    """The first derivative of a table."""

    nargs = 2

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Return the slope by x."""
        return lut2(*self.args)


class lut2(sp.Function):
    """The second derivative of a table."""

    nargs = 2

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """Return no slope: it is asked for in the Jacobian's column of time alone, which meets a sensitivity that is none."""
        return sp.S.Zero


@lru_cache(maxsize=32)
def steady_states(system: System, load: sp.Expr | None = None) -> tuple[sp.Expr, ...]:
    """Return each state variable in steady sliding at velocity v under `load`, W0 if left out, as a formula in v.

    Raises SrfError where no closed form is found; laws with phi = y D0/v, y a constant or a Lambert function, have one.
    """
    values = {symbol(p.name): to_base(p.default, p.unit) for p in system.parameters}
    load, found = symbol("W0") if load is None else load, []
    for state in system.friction.states:
        age = steady_age_formula(state_rate(system, state), symbol(state.length), symbol(state.name), system.ageing.name, values)
        found.append(age.subs(symbol("W"), load))
    return tuple(found)


def steady_age_formula(rate: sp.Expr, length: sp.Symbol, phi: sp.Symbol, name: str, values: Mapping[sp.Symbol, float]) -> sp.Expr:
    """Return the age at which a rate vanishes at constant load and velocity v, as a formula in v.

    Of several that one which is positive and attracts at these values of the parameters. Raises SrfError where there is none,
    and where no closed form is found.
    """
    return _steady_age(rate, length, phi, name, tuple((s, values[s]) for s in sorted(rate.free_symbols & set(values), key=str)))


@lru_cache(maxsize=32)  # systems that differ in what has no part in a rate have one in common
def _steady_age(
    rate: sp.Expr, length: sp.Symbol, phi: sp.Symbol, name: str, values: tuple[tuple[sp.Symbol, float], ...]
) -> sp.Expr:
    v, y = symbol("v"), sp.Symbol("y", positive=True)
    still = {symbol(n): sp.S.Zero for n in ("mu_dot", "W_dot", "F_dot_over_W")}
    reduced = sp.expand_log(sp.simplify(rate.subs(still).subs(phi, y * length / v)), force=True)
    if reduced.has(symbol("mu")):
        raise SrfError(
            f"the steady state of ageing law '{name}' depends on mu, which depends on it: no closed form",
            "write the rate so that mu stands in a factor that steady sliding does not need, or leave it out",
        )
    repelling = False
    for root in _steady_roots(reduced, y):
        if _attracts(reduced, y, root, dict(values)):
            return _regular(root) * length / v
        repelling = True
    if repelling:
        raise SrfError(
            f"ageing law '{name}' has no steady state that attracts at the default values of its parameters",
            "write a rate that falls through 0 at a positive age",
        )
    raise SrfError(
        f"no closed form for the steady state of ageing law '{name}' was found",
        "write the rate in terms of v*phi/D0 so that it vanishes at a constant, as 1 - v*phi/D0 does",
    )


def _steady_roots(reduced: sp.Expr, y: sp.Symbol) -> Iterator[sp.Expr]:
    """Yield where the reduced rate vanishes, in y = v phi/D0."""
    yield from (guess for guess in (sp.S.One, sp.S(2)) if sp.simplify(reduced.subs(y, guess)) == 0)
    with contextlib.suppress(NotImplementedError, TypeError):  # the latter where sympy compares symbols on its way
        if _may_be_solved(reduced, y):
            found = sp.solve(reduced, y, check=False)  # checked in numbers, in half the time
            yield from (r for r in found if r.is_positive is not False and not r.has(sp.I, sp.nan))


def _regular(root: sp.Expr) -> sp.Expr:
    """Return a root of a quadratic, (-b + sqrt(d))/(2 a), as 2 c/(-b - sqrt(d)) where a may be 0."""
    singular = [p for p in sp.fraction(root)[1].free_symbols if not root.subs(p, 0).is_finite]
    if not singular or len([a for a in root.atoms(sp.Pow) if a.exp == sp.Rational(1, 2)]) != 1:
        return root
    other = 1 / sp.radsimp(1 / root)
    return other if all(other.subs(p, 0).is_finite is not False for p in singular) else root


def _attracts(reduced: sp.Expr, y: sp.Symbol, root: sp.Expr, values: Mapping[sp.Symbol, float]) -> bool:
    """Return whether a root is one, and positive, and the rate falls there at one velocity at least; True if unknown."""
    slope, known = sp.diff(reduced, y), False
    for v in CHECKED_VELOCITIES:
        at = {**values, symbol("v"): v, symbol("W"): CHECKED_LOAD}
        try:
            place = complex(root.subs(at))
            falls, left = (complex(e.subs({**at, y: place if place.imag else place.real})) for e in (slope, reduced))
        except (TypeError, ValueError, ArithmeticError):
            continue
        if not np.isfinite([place, falls, left]).all():
            continue
        known = True
        real = place.real > 0 and abs(place.imag) <= 1e-9 * place.real
        if real and falls.real < 0 and abs(left) <= ROOT_ERROR * abs(falls * place):
            return True
    return not known


def _may_be_solved(reduced: sp.Expr, y: sp.Symbol) -> bool:
    """Return whether reduced = 0 may have a closed form in y; sympy takes many seconds to find that it has none.

    A sum of terms c y^p (ln y)^q may have one if there are two at most, if all p are alike, if all p are numbers and, without a
    logarithm, it is a cubic at most in a power of y or has no other symbol, or if there are three that are a quadratic in a power
    of y or hold one logarithm, for a Lambert function. Of a sum with any other terms it is not known. The roots of a quartic take
    sympy minutes, and have cases that generated code cannot tell apart.
    """
    powers: set[tuple[sp.Expr, sp.Expr]] = set()
    for term in sp.Add.make_args(sp.expand(reduced.as_independent(y, as_Add=False)[1])):
        p = q = sp.S.Zero
        for factor in sp.Mul.make_args(term.as_independent(y, as_Add=False)[1]):
            base, exponent = factor.as_base_exp()
            if base == y:
                p += exponent
            elif base == sp.log(y):
                q += exponent
            elif factor.has(y):
                return True
        powers.add((p, q))
    exponents, logarithms = [p for p, _ in powers], sum(q != 0 for _, q in powers)
    if len(powers) < 3 or len(set(exponents)) == 1:
        return True
    if not logarithms and all(p.is_Rational for p in exponents):
        apart = [p - min(exponents) for p in exponents]
        return max(apart) <= 3 * sp.gcd_list(apart) or reduced.free_symbols == {y}
    if not logarithms and all(p.is_number for p in exponents):
        return True
    quadratic = not logarithms and any(sp.expand(sp.Add(*exponents) - 3 * middle) == 0 for middle in exponents)
    return len(powers) == 3 and (quadratic or logarithms == 1)


@dataclass(frozen=True)
class Parts:
    """What the equations are made of once every effect has had its say; formulas in the symbols of laws and effects."""

    mu: sp.Expr
    kappa: sp.Expr | None
    W: sp.Expr
    force: sp.Expr
    V: sp.Expr
    K: sp.Expr
    gauge: sp.Expr
    plain: sp.Expr  # the gauge before any effect
    shown: tuple[sp.Expr, ...] = ()  # by the gauge, before the effect of each further unknown

    def formulas(self) -> tuple[sp.Expr, ...]:
        """Return all of them."""
        found = (self.mu, self.kappa, self.W, self.force, self.V, self.K, self.gauge)
        return tuple(f for f in found if f is not None)


def parts_of(system: System, *, cyclic: bool = False) -> Parts:
    """Return friction coefficient, contact stiffness, load on the asperities, extra force, stage velocity and so on of `system`.

    Each effect's formula takes the place of what was there before; the tables come last. A gauge that weighs shows the spring's
    force over the stated K. `cyclic` is as `equations_of` has it.
    """
    found = {"mu": system.friction.mu, "W": symbol("W"), "force": sp.S.Zero, "V": symbol("V"), "K": symbol("K")}
    stiffness, shown = symbol("K"), list[sp.Expr]()
    for slot, formula in (change for effect in system.effects for change in effect.changes):
        if slot == "K":
            stiffness = formula.xreplace({symbol("K"): stiffness})
    found["gauge"] = found["plain"] = symbol("u") * (1 + symbol("weighed") * (stiffness / symbol("K") - 1))
    if system.interface.kappa is not None:
        found["kappa"] = system.interface.kappa
    for effect in system.effects:
        shown += [found["gauge"]] * len(effect.states)
        if effect.observed:
            found["gauge"] = symbol(effect.observed)
        for slot, formula in effect.changes:
            if slot == "rate":
                continue
            if slot not in found:
                raise SrfError(f"effect '{effect.name}' changes {slot}, which {system.title} does not have")
            found[slot] = formula.xreplace({symbol(slot): found[slot]})
    for number, (slot, argument) in enumerate(system.tables):
        value = lut(sp.Integer(number), symbol(argument))
        found[slot] = found[slot] * (1 + value) if slot == "V" else found[slot] + value
    parts = {slot: _modulated(f, cyclic=cyclic) for slot, f in found.items()}
    return Parts(**{"kappa": None, **parts}, shown=tuple(_modulated(f, cyclic=cyclic) for f in shown))


def check_slots(system: System, parts: Parts) -> None:
    """Raise SrfError for what cannot be differentiated along the motion: a load or a stiffness that depends on v or the ages."""
    moving = {"v", "mu", *(state.name for state in system.friction.states)}
    refused = {
        "mu": {"V"},
        "kappa": moving | {"V", "gauge"},
        "W": moving | {"V", "gauge"},
        "force": {"V", "gauge"} | (set() if system.inertia else moving),
        "K": moving | {"V", "gauge"} | (set() if system.inertia else {"u"}),
        "gauge": moving | {"V", "W_dot"},
    }
    for slot, names in refused.items():
        formula = getattr(parts, slot)
        found = sorted(names & {str(x) for x in formula.free_symbols}) if formula is not None else []
        if found:
            raise SrfError(f"{slot} of {system.title} depends on {found[0]}", f"{slot} may not hold {', '.join(sorted(names))}")


def _modulated(formula: sp.Expr, *, cyclic: bool) -> sp.Expr:
    """Return a formula with the modulation's angle and envelope written in the clock and in the run's own parameters.

    Where it is `cyclic` the angle is 0 at time 0 and the envelope is left, as it does not change.
    """
    s, t = symbol, symbol("time")
    if cyclic:
        return formula.xreplace({s("theta"): 2 * sp.pi * s("f") * t})
    envelope = (1 + sp.tanh((t - s("onset0")) / s("rise0"))) / 2  # of its switch-on
    return formula.xreplace({s("theta"): 2 * sp.pi * s("f") * t + s("psi"), s("envelope"): envelope})


def _replaced(formula: sp.Expr, meaning: Sequence[tuple[sp.Symbol, sp.Expr]]) -> sp.Expr:
    """Return a formula with each symbol replaced by its meaning, one after the other, in a twentieth of the time of `subs`."""
    for name, value in meaning:
        formula = formula.xreplace({name: value})
    return formula


def auxiliary(system: System, parts: Parts, *, cyclic: bool = False) -> tuple[str, ...]:
    """Return which of slip, stage and time the equations need besides the unknowns of motion."""
    formulas = [*parts.formulas(), *(e.rate for e in system.extra_states)]
    formulas += [f for e in system.effects for slot, f in e.changes if slot == "rate"]
    used = {str(x) for f in formulas for x in _modulated(f, cyclic=cyclic).free_symbols}
    return tuple(a for a in AUXILIARY if a in used)


@lru_cache(maxsize=32)
def equations_of(system: System, *, cyclic: bool = False) -> Equations:
    """Return x' = f(x, t) of `system`, solved for the derivatives.

    The slip relation d(W mu/kappa)/dt = z - v, the force balance and the ageing laws are linear in the unknown derivatives
    as long as each law is linear in mu_dot, W_dot and F_dot_over_W; otherwise SrfError. Where they are `cyclic` the load is
    constant or modulated for ever, time is no unknown, and the formulas hold `time`, `envelope` and `modulated` as they are.
    """
    return _Builder(system, cyclic=cyclic).equations()


class _Builder:
    """The balance of one system with stand-ins for what is long, and their meanings."""

    def __init__(self, system: System, *, cyclic: bool = False) -> None:
        self.system, self.parts, self.cyclic = system, parts_of(system, cyclic=cyclic), cyclic
        check_slots(system, self.parts)
        self.extras = tuple(
            replace(e, rate=e.rate.subs(symbol("gauge"), shown), steady=e.steady.subs(symbol("gauge"), shown))
            for e, shown in zip(system.extra_states, self.parts.shown, strict=True)
        )
        self.aux = auxiliary(system, self.parts, cyclic=cyclic)
        self.phis = [symbol(state.name) for state in system.friction.states]
        self.steady = steady_states(system, self.load_at_rest())
        self.mu, self.load, self.V = sp.Symbol("mu_"), sp.Symbol("load_"), sp.Symbol("V_")
        self.m_v, self.m_W, self.m_t = sp.symbols("mu_v_ mu_W_ mu_t_")
        self.m_phi = sp.symbols(f"mu_phi0:{len(self.phis)}")
        self.slip, self.slip_W, self.slip_t = sp.Symbol("S_"), sp.Symbol("S_W_"), sp.S.Zero
        self.imposed = sp.Symbol("Wi_")
        if self.parts.kappa is not None and {str(x) for x in self.parts.kappa.free_symbols} & {str(n) for n, _ in self.along()}:
            self.slip_t = sp.Symbol("S_t_")
        self.force, self.force_dot, self.W_dot = sp.symbols("F_ F_dot_ We_dot_")
        plain = symbol("K") == self.parts.K
        self.K, self.K_dot = (symbol("K"), sp.S.Zero) if plain else sp.symbols("K_ K_dot_")
        self.tangent = sp.tan(symbol("angle")) if system.loading == "inclined" else sp.S.Zero

    def equations(self) -> Equations:
        system, s, aux = self.system, symbol, self.aux
        solution, u_rate = self.solved()
        meaning = self.meaning()
        mu_ss, K, V = self.mu_ss(), self.K, s("V")
        z_rate = (K * s("u") - self.load * self.mu + self.force) / s("M")
        names, unknowns, rates = list(system.states), [s("v"), *self.phis], []
        if system.inertia:
            rates = [u_rate, z_rate] if system.elastic else [u_rate]
            unknowns = [s("u"), s("z"), *unknowns] if system.elastic else [s("u"), *unknowns]
        rates += [solution[r] for r in (self.d_ln_v, *self.d_ln_phi)]
        spring = s("u") if system.inertia else (self.load * self.mu - self.force) / K
        at_drive = [e.subs(s("v"), V) for e in (s("v"), *self.steady)]
        u_rest = (self.load_at_rest() * mu_ss - self.parts.force) / self.parts.K
        resting = [u_rest, V][: len(unknowns) - len(at_drive)]
        steady = [self.settled(e, u_rest, mu_ss) for e in (*resting, *at_drive)]
        for extra in self.extras:
            self.check_steady(extra)
            names.append(f"ln_{extra.name}" if extra.logarithmic else extra.name)
            unknowns.append(s(extra.name))
            rate = self.extra_rate(extra)
            rates.append(rate / s(extra.name) if extra.logarithmic else rate)
            steady.append(self.settled(extra.steady, u_rest, mu_ss))
        for name in () if self.cyclic else aux:
            names.append(name)
            unknowns.append(s(name))
            rates.append(self.aux_rate(name))
            steady.append(self.settled(s(name), u_rest, mu_ss))
        meaning = [*([] if system.inertia else [(s("u"), spring)]), *meaning]  # it is made of what follows
        filled = [_modulated(_replaced(r, meaning), cyclic=self.cyclic) for r in rates]
        clock = {"time", "envelope"} if self.cyclic else set()
        self.check_known(filled, {*map(str, unknowns), "V", "W", "W_dot", *clock})
        self.check_known(steady, clock)
        reading, shown = self.parts.gauge, self.parts.plain
        if not system.inertia:
            spring, reading, shown = (_replaced(e, meaning) for e in (spring, reading, shown))
        self.check_known([reading, shown], {*map(str, unknowns), "W", *clock})
        return Equations(
            names=tuple(names),
            unknowns=tuple(unknowns),
            logarithmic=tuple(n.startswith("ln_") for n in names),
            rates=tuple(filled),
            spring=spring,
            reading=reading,
            shown=shown,
            stiffness=self.parts.K,
            drive=self.parts.V if system.inertia else self.parts.V.subs(meaning),
            load=self.total_load(),
            mu=self.parts.mu,
            steady=tuple(steady),
        )

    def check_steady(self, extra: ExtraState) -> None:
        """Raise SrfError where an effect's own unknown is not steady under these laws at the value that the effect states."""
        s = symbol
        still: dict[sp.Symbol, sp.Expr] = {s(n): sp.S.Zero for n in ("W_dot", "mu_dot", "F_dot_over_W")}
        still |= {s("W"): s("W0"), **{s(e.name): e.steady for e in self.extras}, **dict(zip(self.phis, self.steady, strict=True))}
        terms = sp.Add.make_args(sp.expand(extra.rate.subs(still).subs(s("W"), s("W0"))))
        values = {s(p.name): to_base(p.default, p.unit) for p in self.system.parameters}
        if {*sum(terms, sp.S.Zero).free_symbols} - {*values, s("v")}:
            return  # it depends on what is known in motion alone
        for v in CHECKED_VELOCITIES:
            at = [float(term.subs({**values, s("v"): v})) for term in terms]
            if abs(sum(at)) > 1e-9 * sum(map(abs, at)):
                raise SrfError(
                    f"'{extra.name}' is not steady at {extra.steady} under the ageing law '{self.system.ageing.name}'",
                    "The effect holds for ageing laws whose age is D0/v in steady sliding, as that of dieterich.",
                )

    def settled(self, formula: sp.Expr, u_rest: sp.Expr, mu_ss: sp.Expr) -> sp.Expr:
        """Return the value of a formula where a run begins: in steady sliding at V under W0, with elongation `u_rest`."""
        s = symbol
        own = {s(e.name): e.steady for e in self.extras}
        at_rest = {s("W"): s("W0"), s("W_dot"): sp.S.Zero, s("slip"): s("start"), s("time"): s("begin"), s("stage"): sp.S.Zero}
        found = formula.subs(own).subs(s("u"), u_rest).subs(own).subs(s("mu"), mu_ss)
        return found.subs(s("v"), s("V")).subs(at_rest)

    def check_known(self, formulas: list[sp.Expr], known: set[str]) -> None:
        """Raise SrfError where a name is left that has no value at this place of the equations."""
        system = self.system
        left = sorted({str(x) for f in formulas for x in f.free_symbols} - known - {p.name for p in system.parameters})
        if left and system.effects:
            raise SrfError(
                f"'{left[0]}' has no value where an effect uses it, in {system.title}",
                "mu_dot and F_dot_over_W are known in a rate alone; u in a rate, in kappa and in an effect's own states",
            )

    def extra_rate(self, extra: ExtraState) -> sp.Expr:
        """Return the rate of an effect's own unknown; W in it is the imposed load, also where W elsewhere is that felt."""
        return extra.rate.subs({symbol("mu"): self.mu, symbol("W"): self.imposed})

    def along(self) -> list[tuple[sp.Symbol, sp.Expr]]:
        """Return the unknowns beside v and the ages that a formula may hold, and their rates."""
        s, system = symbol, self.system
        found = [(s(a), self.aux_rate(a)) for a in self.aux] + [(s(e.name), self.extra_rate(e)) for e in self.extras]
        if system.inertia:
            found.append((s("u"), self.V - (s("z") if system.elastic else s("v"))))
        return found

    def aux_rate(self, name: str) -> sp.Expr:
        return sp.S.One if name == "time" else symbol(AUXILIARY[name])

    def mu_ss(self) -> sp.Expr:
        """Return the friction coefficient in steady sliding at V under the load at rest."""
        s = symbol
        extra = {s(e.name): e.steady for e in self.extras}
        mu = self.parts.mu.subs(extra).subs(dict(zip(self.phis, self.steady, strict=True))).subs(s("v"), s("V"))
        return mu.subs(s("W"), self.load_at_rest())

    def load_at_rest(self) -> sp.Expr:
        """Return the asperities' load in steady sliding; W0 itself where nothing changes it, as under inclined loading."""
        return self.parts.W if self.system.effects else symbol("W0")

    def total_load(self) -> sp.Expr:
        """Return the load on the asperities in the imposed load and the unknowns."""
        s, tangent = symbol, self.tangent
        if self.system.loading != "inclined":
            return self.parts.W
        if self.system.effects:
            raise SrfError("effects are for vertical loading", "leave the effect or the inclination out")
        shift = tangent * s("W0") * self.mu_ss()
        if self.system.inertia:
            return s("W") + tangent * s("K") * s("u") - shift
        return (s("W") - shift) / (1 - tangent * self.system.friction.mu)

    def solved(self) -> tuple[dict[sp.Symbol, sp.Expr], sp.Expr]:
        """Return the unknown derivatives, and u', in stand-ins."""
        system, s = self.system, symbol
        v, M, u, z = s("v"), s("M"), s("u"), s("z")
        self.d_ln_v, mu_dot, W_rate, x_rate = sp.symbols("d_ln_v mu_dot_ W_rate_ x_rate_")
        self.d_ln_phi = sp.symbols(f"d_ln_phi0:{len(self.phis)}")
        mu, load, V = self.mu, self.load, self.V
        u_rate = V - (z if system.elastic else v) if system.inertia else V - (x_rate if system.elastic else v)
        ages = sum(a * b for a, b in zip(self.m_phi, self.d_ln_phi, strict=True))
        balance = [
            mu_dot - self.m_v * self.d_ln_v - ages - self.m_W * W_rate - self.m_t,
            W_rate - self.W_dot - self.tangent * s("K") * u_rate,
        ]
        stand_ins = {
            s("mu"): mu,
            s("mu_dot"): mu_dot,
            s("W"): load,
            s("W_dot"): W_rate,
            s("F_dot_over_W"): mu_dot + mu * W_rate / load,
        }
        for state, rate in zip(system.friction.states, self.d_ln_phi, strict=True):
            balance.append(s(state.name) * rate - state_rate(system, state).subs(stand_ins, simultaneous=True))
        wanted = [self.d_ln_v, mu_dot, W_rate, *self.d_ln_phi]
        if system.elastic:
            stretched = self.slip * mu_dot + mu * self.slip_W * W_rate + mu * self.slip_t
            balance.append(stretched - ((z if system.inertia else x_rate) - v))
        if system.inertia and not system.elastic:
            balance.append(M * v * self.d_ln_v - (self.K * u - load * mu + self.force))
        if not system.inertia:
            moved = self.K * u_rate + self.K_dot * u
            balance.append(moved - load * mu_dot - mu * W_rate + self.force_dot)
            if system.elastic:
                wanted.append(x_rate)
        return solve_linear(balance, wanted, system), u_rate

    def meaning(self) -> list[tuple[sp.Expr, sp.Expr]]:
        """Return what the stand-ins stand for, in an order in which one pass resolves them."""
        s, parts = symbol, self.parts
        kappa, load, mu = parts.kappa, self.load, parts.mu
        S = sp.simplify(s("W") / kappa) if kappa is not None else sp.S.Zero
        W = s("W")
        on_load = (lambda e: e.subs(W, load)) if mu.has(W) or S.has(W) else (lambda e: e)
        explicit, imposed, pushed, stretched, stiffened = (
            sum((sp.diff(part, name) * rate for name, rate in self.along()), sp.S.Zero)
            for part in (mu, parts.W, parts.force, S, parts.K)
        )
        imposed += sp.diff(parts.W, W) * s("W_dot")
        pushed += sp.diff(parts.force, W) * s("W_dot")
        stiffened += sp.diff(parts.K, W) * s("W_dot")
        v = s("v")
        return [
            *([(self.slip_t, on_load(stretched))] if self.slip_t else []),
            (self.slip, on_load(S)),
            (self.slip_W, on_load(sp.diff(S, W))),
            (self.m_v, on_load(tidy(v * sp.diff(mu, v)))),
            *((m, on_load(tidy(p * sp.diff(mu, p)))) for m, p in zip(self.m_phi, self.phis, strict=True)),
            (self.m_W, on_load(sp.diff(mu, W))),
            (self.m_t, on_load(explicit)),
            (self.mu, on_load(mu)),
            (self.force, parts.force),
            (self.force_dot, pushed),
            (self.W_dot, imposed),
            (self.V, parts.V),
            *([(self.K_dot, stiffened), (self.K, parts.K)] if self.K_dot else []),
            (load, self.total_load()),
            (self.imposed, W),
        ]


def solve_linear(balance: list[sp.Expr], wanted: list[sp.Symbol], system: System) -> dict[sp.Symbol, sp.Expr]:
    try:
        matrix, right = sp.linear_eq_to_matrix(balance, wanted)
    except NonlinearError as error:
        raise SrfError(
            f"ageing law '{system.ageing.name}' is not linear in mu_dot, W_dot or F_dot_over_W",
            "write the coupling to the rates of friction and load as a factor times mu_dot, W_dot or F_dot_over_W",
        ) from error
    solved = _eliminated(matrix, right, system)
    if solved is None:
        raise SrfError(f"the equations of {system.title} do not determine the motion", "check the laws with `srf law check`")
    return dict(zip(wanted, [tidy(e) for e in solved], strict=True))


def _eliminated(matrix: sp.Matrix, right: sp.Matrix, system: System) -> list[sp.Expr] | None:
    """Solve a square linear system by elimination, None where it has no one solution.

    The pivot is never a factor that a parameter at 0 makes vanish where another will do: with c = 0 in (c/B) phi F_dot_over_W
    the equations are those without the term, and near 0 no figures are lost. Of the others the one that fills least is taken.
    """
    vanishing = [symbol(p.name) for p in system.parameters if p.lower <= 0 <= p.upper]

    def weak(entry: sp.Expr) -> bool:
        return any(entry.has(x) and entry.subs(x, 0) == 0 for x in vanishing)

    if matrix.shape[0] != matrix.shape[1]:
        return None
    rows = [{j: e for j, e in enumerate(matrix.row(i)) if e != 0} for i in range(matrix.shape[0])]
    values, order = list(right), []
    left = set(range(len(rows)))
    while left:
        used = Counter(j for i in left for j in rows[i])
        entries = [(i, j, e) for i in sorted(left) for j, e in rows[i].items()]
        if not entries or any(not rows[i] for i in left):
            return None
        i, j, pivot = min(
            entries,
            key=lambda x: (
                weak(x[2]), (len(rows[x[0]]) - 1) * (used[x[1]] - 1), not x[2].is_number, sp.count_ops(x[2]), x[0], x[1]
            ),
        )  # fmt: skip
        left.remove(i)
        order.append((i, j, pivot))
        for k in left:
            if (entry := rows[k].pop(j, None)) is None:
                continue
            factor = entry / pivot
            values[k] -= factor * values[i]
            for m, other in rows[i].items():
                if m != j and (new := rows[k].pop(m, sp.S.Zero) - factor * other) and sp.expand(new) != 0:
                    rows[k][m] = new
    found: dict[int, sp.Expr] = {}
    for i, j, pivot in reversed(order):
        found[j] = (values[i] - sum((e * found[m] for m, e in rows[i].items() if m != j), sp.S.Zero)) / pivot
    return [found[j] for j in range(len(rows))]


@lru_cache(maxsize=4096)  # models that differ by an effect have most entries of their Jacobians in common
def tidy(expression: sp.Expr) -> sp.Expr:
    """Return the shortest of a few equal forms of `expression`, of equally short ones the first by its text."""
    if expression.is_Atom:
        return expression
    sizes = {form: sp.count_ops(form) for form in (expression, sp.factor_terms(expression))}
    if sizes[expression] <= MAX_CANCEL:
        shielded, back = shield(expression)
        form = sp.cancel(shielded).xreplace(back)
        sizes[form] = sp.count_ops(form)
    shortest = [form for form, size in sizes.items() if size == min(sizes.values())]
    return min(shortest, key=str) if len(shortest) > 1 else shortest[0]


def settle(expression: sp.Expr) -> sp.Expr:
    """Return `expression` simplified, but for Lambert functions: there sympy trades exp(-v/Vc) for exp(v/Vc), which overflows."""
    return expression if expression.has(sp.LambertW) else sp.simplify(expression)


def shield(expression: sp.Basic) -> tuple[sp.Basic, dict[sp.Symbol, sp.Expr]]:
    """Return `expression` with its transcendental parts replaced by symbols, and what puts them back.

    Algebra on exp(-V/Vc) otherwise turns it into exp(V/Vc), which overflows.
    """
    kinds = (sp.exp, sp.LambertW)
    atoms = sorted(expression.atoms(*kinds), key=lambda e: (-sp.count_ops(e), str(e)))
    back: dict[sp.Symbol, sp.Expr] = {}
    for atom in atoms:  # longest first: an inner one then lives on inside what its outer one puts back
        name = sp.Symbol(f"shield{len(back)}", positive=True)
        replaced = expression.xreplace({atom: name})
        if replaced != expression:
            back[name], expression = atom, replaced
    return expression, back
