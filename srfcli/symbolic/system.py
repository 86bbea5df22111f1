"""A friction law, an ageing law, an interface, a loading and inertia or none, joined into first-order equations.

Units are um, s, N; mass is N s^2/um. The spring elongation is u = V t - x, z = x', v is the slip velocity of the interface.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeVar

import sympy as sp

from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.settings import Parameter
from srfcli.core.units import dimension
from srfcli.laws.expression import symbol
from srfcli.laws.values import (
    REFERENCE_VELOCITY,
    AgeingLaw,
    AgeingModifier,
    Effect,
    ExtraState,
    FrictionLaw,
    Interface,
    Law,
    State,
)

if TYPE_CHECKING:
    from srfcli.laws.registry import Registry

L = TypeVar("L", bound=Law)

POSITIVE = 1e-6  # what is above 0 is at least that, as in law files

APPARATUS = (
    Parameter("V", 10.0, "um/s", 1e-12, 1e9, "driving velocity"),
    Parameter("W0", 10.0, "N", 1e-9, 1e12, "mean normal load"),
    Parameter("eps", 0.0, "1", 0.0, 0.999999, "relative amplitude of the load modulation that reaches the asperities"),
    Parameter("f", 120.0, "Hz", 1e-6, 1e9, "frequency of the load modulation"),
    Parameter("K", 0.21, "N/um", 1e-12, 1e12, "stiffness of the loading spring along the track"),
)
MASS = Parameter("M", 2.37, "kg", 1e-12, 1e12, "mass of the slider")
ANGLE = Parameter("angle", 15.0, "deg", -60.0, 60.0, "inclination of the spring: W gains K (u - u_ss) tan(angle)")
RUN_SYMBOLS = (  # of one run: what an effect may ask of the recording
    Parameter("start", 0.0, "um", about="where on the track the run begins"),
    Parameter("begin", 0.0, "s", about="the clock at the run's first sample"),
    Parameter("psi", 0.0, "1", about="phase of the load modulation at clock 0"),
    Parameter("modulated", 0.0, "1", about="1 where the load is modulated"),
    Parameter("rise0", 0.02, "s", about="time scale of the switch-on of the modulation"),
    Parameter("onset0", -1e6, "s", about="when half of the load modulation was switched on"),
    Parameter("weighed", 0.0, "1", about="1 where the spring's force is recorded, 0 where its elongation is"),
)
_ALONG = sp.sqrt(3) * symbol("v") / symbol("field_length")  # slip rate in the units of a Matern covariance
RANDOM_FIELD = Effect(  # correlation (1 + r) exp(-r), r = sqrt(3) d/length (Matern 3/2): two states, driven by white noise
    "random-field",
    about="friction that no law explains: a stationary Gaussian process along slip",
    cites=("J. Hartikainen and S. Sarkka, IEEE MLSP 2010",),
    parameters=(
        Parameter("field_amplitude", 1e-3, "1", 0.0, 1.0, "standard deviation of the random friction field"),
        Parameter("field_length", 5.0, "um", 1e-6, 1e6, "correlation length of the random friction field"),
        Parameter("field_noise", 0.0, "1", about="the white noise that drives the field, over its standard deviation"),
        Parameter("field_start", 0.0, "1", about="the field where the run begins, over its amplitude"),
        Parameter("field_slope_start", 0.0, "1", about="its slope there times length/sqrt(3), over its amplitude"),
    ),
    changes=(("mu", symbol("mu") + symbol("field")),),
    states=(
        ExtraState("field", symbol("field_slope") * _ALONG,
                   symbol("field_amplitude") * symbol("field_start")),
        ExtraState("field_slope",
                   -(symbol("field") + 2 * symbol("field_slope")) * _ALONG
                   + 2 * symbol("field_amplitude") * symbol("field_noise") * sp.sqrt(_ALONG),
                   symbol("field_amplitude") * symbol("field_slope_start")),
    ),
    neutral=(("field_amplitude", 0.0),),
)  # fmt: skip
EFFECT_INPUTS = ("slip", "stage", "time", "theta", "envelope", "u", "gauge", "kappa", "force", "rate", "V")
PASSING = {"slip": "slip", "stage": "the stage's position", "time": "time"}  # what an effect may name that never comes back
LOADINGS = ("vertical", "inclined")


@dataclass(frozen=True)
class System:
    """One slider: which laws rule it, how it is loaded, and whether its mass matters."""

    friction: FrictionLaw
    ageing: AgeingLaw
    modifiers: tuple[AgeingModifier, ...] = ()
    interface: Interface = field(default_factory=lambda: Interface("rigid"))
    loading: str = "vertical"
    inertia: bool = True
    effects: tuple[Effect, ...] = ()
    tables: tuple[tuple[str, str], ...] = ()  # (mu, force or V, an unknown): a function of it, given by numbers, is added

    @property
    def laws(self) -> tuple[Law, ...]:
        """Return every law that takes part."""
        return (self.friction, self.ageing, *self.modifiers, self.interface, *self.effects)

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
        if self.effects or self.tables:
            own += RUN_SYMBOLS
        seen = {p.name for p in own}
        for law in self.laws:
            for parameter in in_a_model(law):
                if parameter.name not in seen:
                    own.append(parameter)
                    seen.add(parameter.name)
        if "V0" not in seen and any(symbol("V0") in f.free_symbols for effect in self.effects for f in formulas(effect)):
            own.append(REFERENCE_VELOCITY)
        return tuple(own)

    @property
    def extra_states(self) -> tuple[ExtraState, ...]:
        """Return the unknowns that effects bring along."""
        return tuple(state for effect in self.effects for state in effect.states)

    @property
    def states(self) -> tuple[str, ...]:
        """Return the names of the first-order system's unknowns, in order; those of effects come after these."""
        mechanical = ("u", "z") if self.elastic else ("u",)
        return (*(mechanical if self.inertia else ()), "ln_v", *(f"ln_{s.name}" for s in self.friction.states))

    @property
    def title(self) -> str:
        """Return one line that names the system."""
        ageing = "+".join([self.ageing.name, *(m.name for m in self.modifiers)])
        inertia = f"inertia {'on' if self.inertia else 'off'}"
        return ", ".join(
            [self.friction.name, ageing, self.interface.name, self.loading, inertia, *(e.name for e in self.effects)]
        )


def build_system(
    registry: Registry,
    *,
    law: str = "srf-vsat",
    ageing: str = "dieterich",
    interface: str = "elastic",
    loading: str = "vertical",
    inertia: bool = True,
    effects: Sequence[str] = (),
    tables: Sequence[tuple[str, str]] = (),
    random_field: bool = False,
    stability: bool = False,
) -> System:
    """Return the system that these registered names describe; `ageing` may carry modifiers, `dieterich+linker-dieterich`.

    With `random_field` a random friction field along slip adds to mu, as RANDOM_FIELD says. With `stability` effects that
    critical loads do not depend on are left out.
    """
    every = [_of(Effect, registry.get("effect", name)) for name in effects]
    added = tuple(e for e in apart(every) if not (stability and without_part(e)))
    if random_field:
        added = (*added, RANDOM_FIELD)
    for effect in added:
        chosen = dict(effect.settings)
        interface, inertia = str(chosen.get("interface", interface)), bool(chosen.get("inertia", inertia))
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
        effects=added,
        tables=tuple((slot, argument) for slot, argument in tables),
    )
    _check_symbols(system)
    return system


def without_part(effect: Effect) -> str:
    """Return why critical loads do not depend on an effect: as a clause that follows its name, or nothing where they do."""
    if effect.observed or (effect.changes and all(slot == "gauge" for slot, _ in effect.changes)):
        return "changes what the gauge shows, not how the slider moves"
    used = {str(s) for f in formulas(effect) for s in f.free_symbols}
    along = next((name for name in PASSING if name in used), "")
    return f"changes with {PASSING[along]}, so that no sliding is steady" if along else ""


def with_effects(system: System, effects: Sequence[Effect]) -> System:
    """Return the system with these effects, which have no settings; SrfError where one names what the system does not have."""
    joined = replace(system, effects=apart(effects))
    _check_symbols(joined)
    return joined


def formulas(effect: Effect) -> list[sp.Expr]:
    """Return what an effect changes, and the rates and steady values of the states that it brings."""
    return [*(f for _, f in effect.changes), *(f for x in effect.states for f in (x.rate, x.steady))]


def in_a_model(law: Law) -> tuple[Parameter, ...]:
    """Return a law's parameters as a model has them: bounds that follow a recording bound a search, and leave the sign alone."""
    if not isinstance(law, Effect):
        return law.parameters
    sought = {name for name, which, _ in law.scaled if which != "default"}
    return tuple(
        replace(p, lower=-math.inf if p.lower < 0 else min(p.lower, POSITIVE), upper=math.inf) if p.name in sought else p
        for p in law.parameters
    )


def apart(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects with parameters of one name told apart by their effects: drive_ripple_amplitude."""
    count = Counter(p.name for e in effects for p in e.parameters)
    return tuple(_renamed(e, {n: f"{e.name.replace('-', '_')}_{n}" for n in own if count[n] > 1}) for e, own in
                 ((e, [p.name for p in e.parameters]) for e in effects))  # fmt: skip


def _renamed(effect: Effect, names: Mapping[str, str]) -> Effect:
    if not names:
        return effect
    swap = {symbol(a): symbol(b) for a, b in names.items()}
    return replace(
        effect,
        parameters=tuple(replace(p, name=names.get(p.name, p.name)) for p in effect.parameters),
        changes=tuple((slot, f.xreplace({k: v for k, v in swap.items() if str(k) != slot})) for slot, f in effect.changes),
        states=tuple(replace(s, rate=s.rate.xreplace(swap), steady=s.steady.xreplace(swap)) for s in effect.states),
        neutral=tuple((names.get(n, n), v) for n, v in effect.neutral),
        scans=tuple((names.get(n, n), v) for n, v in effect.scans),
        scaled=tuple((names.get(n, n), which, formula) for n, which, formula in effect.scaled),
        fixed=tuple(names.get(n, n) for n in effect.fixed),
    )


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
    _check_apart(system)
    for effect in system.effects:
        lacking = sorted({str(s) for f in formulas(effect) for s in f.free_symbols} - declared - inputs - {*EFFECT_INPUTS})
        lacking = [name for name in lacking if name not in {x.name for e in system.effects for x in e.states}]
        if lacking:
            raise SrfError(
                f"effect '{effect.name}' uses '{lacking[0]}', which {system.friction.name} and {system.ageing.name} lack",
                "the effect does not apply to this law",
            )
    if system.effects:
        inputs |= {*EFFECT_INPUTS, *(x.name for x in system.extra_states)}
    missing = sorted(used - declared - inputs)
    if missing:
        raise SrfError(
            f"'{missing[0]}' is used by {system.ageing.name} or {system.friction.name} and declared by neither",
            f"declare it under [parameters] of the law, or combine with a law that has it; known: {', '.join(sorted(declared))}",
        )


def _check_apart(system: System) -> None:
    """Raise where one symbol would mean two things: in two laws with unlike units, or in a law and an effect."""
    first: dict[str, tuple[Parameter, str]] = {}
    for law in system.laws:
        for parameter in () if isinstance(law, Effect) else law.parameters:
            other, whose = first.setdefault(parameter.name, (parameter, law.name))
            if dimension(parameter.unit) != dimension(other.unit):
                raise SrfError(
                    f"'{other.name}' is in {other.unit} in {whose} and in {parameter.unit} in {law.name}",
                    "they are two parameters: give one of them another name",
                )
    own = {p.name for law in system.laws if not isinstance(law, Effect) for p in law.parameters}
    own |= {state.name for state in system.friction.states}
    for effect in system.effects:
        brought = [*(() if effect.settings else (p.name for p in effect.parameters)), *(s.name for s in effect.states)]
        twice = [name for name in brought if name in own]
        if twice:
            raise SrfError(
                f"effect '{effect.name}' brings '{twice[0]}', which a law of {system.friction.name} and {system.ageing.name} has",
                "the law has this physics already; or give the effect's parameter another name",
            )
        own |= {s.name for s in effect.states}


def state_rate(system: System, state: State) -> sp.Expr:
    """Return d(state)/dt with the ageing law's phi, D0 and B replaced by this state's own."""
    rate = system.ageing.rate + sum((m.term for m in system.modifiers), sp.S.Zero)
    for effect in system.effects:
        for slot, formula in effect.changes:
            if slot == "rate":
                rate = formula.xreplace({symbol("rate"): rate})
    own = {symbol("phi"): symbol(state.name), symbol("D0"): symbol(state.length), symbol("B"): symbol(state.weight)}
    return rate.subs(own, simultaneous=True)
