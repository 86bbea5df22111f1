"""A friction law, an ageing law, an interface, a loading and inertia or none, joined into first-order equations.

Units are um, s, N; mass is N s^2/um. The spring elongation is u = V t - x, z = x', v is the slip velocity of the interface.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, TypeVar

import sympy as sp

from srfcli.errors import SrfError, did_you_mean
from srfcli.expression import symbol
from srfcli.laws import AgeingLaw, AgeingModifier, FrictionLaw, Interface, Law, Parameter, State

if TYPE_CHECKING:
    from srfcli.registry import Registry

L = TypeVar("L", bound=Law)

APPARATUS = (
    Parameter("V", 10.0, "um/s", 1e-12, 1e9, "driving velocity"),
    Parameter("W0", 10.0, "N", 1e-9, 1e12, "mean normal load"),
    Parameter("eps", 0.0, "1", 0.0, 0.999999, "relative amplitude of the load modulation that reaches the asperities"),
    Parameter("f", 120.0, "Hz", 1e-6, 1e9, "frequency of the load modulation"),
    Parameter("K", 0.21, "N/um", 1e-12, 1e12, "stiffness of the loading spring along the track"),
)
MASS = Parameter("M", 2.37, "kg", 1e-12, 1e12, "mass of the slider")
ANGLE = Parameter("angle", 15.0, "deg", -60.0, 60.0, "inclination of the spring: W gains K (u - u_ss) tan(angle)")
LOADINGS = ("vertical", "inclined")
MAX_CANCEL = 80  # operations: beyond it a common denominator takes a minute to find and shortens nothing


@dataclass(frozen=True)
class System:
    """One slider: which laws rule it, how it is loaded, and whether its mass matters."""

    friction: FrictionLaw
    ageing: AgeingLaw
    modifiers: tuple[AgeingModifier, ...] = ()
    interface: Interface = field(default_factory=lambda: Interface("rigid"))
    loading: str = "vertical"
    inertia: bool = True

    @property
    def laws(self) -> tuple[Law, ...]:
        """Return every law that takes part."""
        return (self.friction, self.ageing, *self.modifiers, self.interface)

    @property
    def elastic(self) -> bool:
        """True where the interface has a finite shear stiffness."""
        return self.interface.kappa is not None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Return the apparatus' parameters, then the laws', each name once."""
        own = [*APPARATUS]
        if self.inertia:
            own.append(MASS)
        if self.loading == "inclined":
            own.append(ANGLE)
        seen = {p.name for p in own}
        for law in self.laws:
            for parameter in law.parameters:
                if parameter.name not in seen:
                    own.append(parameter)
                    seen.add(parameter.name)
        return tuple(own)

    @property
    def states(self) -> tuple[str, ...]:
        """Return the names of the first-order system's unknowns, in order."""
        mechanical = ("u", "z") if self.elastic else ("u",)
        return (*(mechanical if self.inertia else ()), "ln_v", *(f"ln_{s.name}" for s in self.friction.states))

    @property
    def title(self) -> str:
        """Return one line that names the system."""
        ageing = "+".join([self.ageing.name, *(m.name for m in self.modifiers)])
        return f"{self.friction.name}, {ageing}, {self.interface.name}, {self.loading}, inertia {'on' if self.inertia else 'off'}"

    @cached_property
    def equations(self) -> Equations:
        """Return the first-order equations of this system."""
        return build_equations(self)


@dataclass(frozen=True)
class Equations:
    """x' = rates(x, t): `unknowns` are the symbols that stand in the formulas (v, not ln v), `logarithmic` says which.

    `load` is W as a function of the imposed load `W` and its rate `W_dot`; `spring` is the elongation u, an unknown or a formula.
    """

    names: tuple[str, ...]
    unknowns: tuple[sp.Symbol, ...]
    logarithmic: tuple[bool, ...]
    rates: tuple[sp.Expr, ...]
    spring: sp.Expr
    load: sp.Expr
    mu: sp.Expr
    steady: tuple[sp.Expr, ...]

    def derivative(self, expression: sp.Expr, index: int) -> sp.Expr:
        """Return d(expression)/d(unknown), by the logarithm where the unknown is logarithmic."""
        s = self.unknowns[index]
        d = sp.diff(expression, s)
        return s * d if self.logarithmic[index] else d


def build_system(
    registry: Registry,
    *,
    law: str = "srf-vsat",
    ageing: str = "dieterich",
    interface: str = "elastic",
    loading: str = "vertical",
    inertia: bool = True,
) -> System:
    """Return the system that these registered names describe; `ageing` may carry modifiers, `dieterich+linker-dieterich`."""
    if loading not in LOADINGS:
        raise SrfError(f"unknown loading '{loading}'", did_you_mean(loading, LOADINGS))
    ageing_law, modifiers = registry.ageing(ageing)
    system = System(
        friction=_of(FrictionLaw, registry.get("friction", law)),
        ageing=ageing_law,
        modifiers=modifiers,
        interface=_of(Interface, registry.get("interface", interface)),
        loading=loading,
        inertia=inertia,
    )
    _check_symbols(system)
    return system


def _of(kind: type[L], law: Law) -> L:
    """Return `law`, which a registry lists under `kind`; anything else in its place is an error of the plugin."""
    if not isinstance(law, kind):
        raise SrfError(f"'{law.name}' is not a {kind.__name__}", f"its source, {law.source}, declares another kind")
    return law


def _check_symbols(system: System) -> None:
    """Raise where a law uses a parameter that nothing in the system declares."""
    declared = {p.name for p in system.parameters}
    rates = [state_rate(system, s) for s in system.friction.states]
    used = {str(s) for e in (system.friction.mu, *rates, system.interface.kappa or sp.S.Zero) for s in e.free_symbols}
    inputs = {"v", "W", "mu", "mu_dot", "W_dot", "F_dot_over_W", *(s.name for s in system.friction.states)}
    missing = sorted(used - declared - inputs)
    if missing:
        raise SrfError(
            f"'{missing[0]}' is used by {system.ageing.name} or {system.friction.name} and declared by neither",
            f"declare it under [parameters] of the law, or combine with a law that has it; known: {', '.join(sorted(declared))}",
        )


def state_rate(system: System, state: State) -> sp.Expr:
    """Return d(state)/dt with the ageing law's phi, D0 and B replaced by this state's own."""
    rate = system.ageing.rate + sum((m.term for m in system.modifiers), sp.S.Zero)
    own = {symbol("phi"): symbol(state.name), symbol("D0"): symbol(state.length), symbol("B"): symbol(state.weight)}
    return rate.subs(own, simultaneous=True)


@lru_cache(maxsize=32)
def steady_states(system: System) -> tuple[sp.Expr, ...]:
    """Return each state variable in steady sliding at velocity v, as a formula in v.

    Raises SrfError where no closed form is found; laws with phi = y D0/v, y a constant or a Lambert function, have one.
    """
    v = symbol("v")
    still = {symbol(n): sp.S.Zero for n in ("mu_dot", "W_dot", "F_dot_over_W")}
    found = []
    for state in system.friction.states:
        rate = state_rate(system, state).subs(still)
        length, phi = symbol(state.length), symbol(state.name)
        y = sp.Symbol("y", positive=True)
        reduced = sp.expand_log(sp.simplify(rate.subs(phi, y * length / v)), force=True)
        found.append(_steady_root(reduced, y, system.ageing.name) * length / v)
    return tuple(found)


def _steady_root(reduced: sp.Expr, y: sp.Symbol, name: str) -> sp.Expr:
    for guess in (sp.S.One, sp.S(2)):
        if sp.simplify(reduced.subs(y, guess)) == 0:
            return guess
    try:
        roots = [r for r in sp.solve(reduced, y) if not r.has(sp.I)]
    except NotImplementedError:
        roots = []
    if not roots:
        raise SrfError(
            f"no closed form for the steady state of ageing law '{name}' was found",
            "write the rate in terms of v*phi/D0 so that it vanishes at a constant, as 1 - v*phi/D0 does",
        )
    return roots[0]


def build_equations(system: System) -> Equations:
    """Return x' = f(x, t) of `system`, solved for the derivatives.

    The slip relation d(W mu/kappa)/dt = z - v, the force balance and the ageing laws are linear in the unknown derivatives
    as long as each law is linear in mu_dot, W_dot and F_dot_over_W; otherwise SrfError.
    """
    s = symbol
    v, V, K, M, W0 = s("v"), s("V"), s("K"), s("M"), s("W0")
    u, z, W_imposed, W_imposed_dot = s("u"), s("z"), s("W"), s("W_dot")
    states = system.friction.states
    phis = [s(state.name) for state in states]
    steady = steady_states(system)
    mu_law = system.friction.mu
    mu_ss = mu_law.subs(dict(zip(phis, steady, strict=True))).subs(v, V)

    d_ln_v, mu_dot, W_rate, x_rate = sp.symbols("d_ln_v mu_dot_ W_rate_ x_rate_")
    d_ln_phi = sp.symbols(f"d_ln_phi0:{len(states)}")
    mu, load = sp.Symbol("mu_"), sp.Symbol("load_")
    m_v, m_phi = sp.Symbol("mu_v_"), sp.symbols(f"mu_phi0:{len(states)}")
    slip, slip_w = sp.Symbol("S_"), sp.Symbol("S_W_")
    tangent = sp.tan(s("angle")) if system.loading == "inclined" else sp.S.Zero

    u_rate = V - (z if system.elastic else v) if system.inertia else V - (x_rate if system.elastic else v)
    balance = [
        mu_dot - m_v * d_ln_v - sum(a * b for a, b in zip(m_phi, d_ln_phi, strict=True)),
        W_rate - W_imposed_dot - tangent * K * u_rate,
    ]
    stand_ins = {
        s("mu"): mu,
        s("mu_dot"): mu_dot,
        s("W"): load,
        s("W_dot"): W_rate,
        s("F_dot_over_W"): mu_dot + mu * W_rate / load,
    }
    for state, rate in zip(states, d_ln_phi, strict=True):
        balance.append(s(state.name) * rate - state_rate(system, state).subs(stand_ins, simultaneous=True))
    wanted = [d_ln_v, mu_dot, W_rate, *d_ln_phi]
    if system.elastic:
        balance.append(slip * mu_dot + mu * slip_w * W_rate - ((z if system.inertia else x_rate) - v))
    if system.inertia and not system.elastic:
        balance.append(M * v * d_ln_v - (K * u - load * mu))
    if not system.inertia:
        balance.append(K * u_rate - load * mu_dot - mu * W_rate)
        if system.elastic:
            wanted.append(x_rate)
    solution = _solve_linear(balance, wanted, system)

    W_total = W_imposed
    if system.loading == "inclined":
        shift = tangent * W0 * mu_ss
        W_total = (
            W_imposed + tangent * K * u - shift if system.inertia else (W_imposed - shift) / (1 - tangent * mu_law)
        )
    kappa = system.interface.kappa
    S = sp.simplify(s("W") / kappa) if kappa is not None else sp.S.Zero
    meaning = [
        (slip, S.subs(s("W"), load)),
        (slip_w, sp.diff(S, s("W")).subs(s("W"), load)),
        (m_v, tidy(v * sp.diff(mu_law, v))),
        *((m, tidy(p * sp.diff(mu_law, p))) for m, p in zip(m_phi, phis, strict=True)),
        (mu, mu_law),
        (load, W_total),
    ]
    z_rate = (K * u - load * mu) / M
    rates = [solution[r].subs(meaning) for r in (d_ln_v, *d_ln_phi)]
    names, unknowns, first = list(system.states), [v, *phis], []
    if system.inertia:
        first = [u_rate, z_rate.subs(meaning)] if system.elastic else [u_rate]
        unknowns = [u, z, *unknowns] if system.elastic else [u, *unknowns]
    spring = u if system.inertia else W_total * mu_law / K
    at_drive = [e.subs(v, V) for e in (v, *steady)]
    resting = [W0 * mu_ss / K, V][: len(unknowns) - len(at_drive)]
    return Equations(
        names=tuple(names),
        unknowns=tuple(unknowns),
        logarithmic=tuple(n.startswith("ln_") for n in names),
        rates=tuple([*first, *rates]),
        spring=spring,
        load=W_total,
        mu=mu_law,
        steady=tuple([*resting, *at_drive]),
    )


def _solve_linear(balance: list[sp.Expr], wanted: list[sp.Symbol], system: System) -> dict[sp.Symbol, sp.Expr]:
    try:
        matrix, right = sp.linear_eq_to_matrix(balance, wanted)
    except sp.solvers.solveset.NonlinearError as error:
        raise SrfError(
            f"ageing law '{system.ageing.name}' is not linear in mu_dot, W_dot or F_dot_over_W",
            "write the coupling to the rates of friction and load as a factor times mu_dot, W_dot or F_dot_over_W",
        ) from error
    solved = matrix.LUsolve(right) if matrix.shape[0] == matrix.shape[1] else None
    if solved is None:
        raise SrfError(
            f"the equations of {system.title} do not determine the motion", "check the laws with `srf law check`"
        )
    return dict(zip(wanted, [tidy(e) for e in solved], strict=True))


def tidy(expression: sp.Expr) -> sp.Expr:
    """Return the shortest of a few equal forms of `expression`."""
    forms = [expression, sp.factor_terms(expression)]
    if sp.count_ops(expression) <= MAX_CANCEL:
        shielded, back = shield(expression)
        forms.append(sp.cancel(shielded).xreplace(back))
    return min(forms, key=lambda e: (sp.count_ops(e), str(e)))


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
