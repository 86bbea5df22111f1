"""What `srf law check` asks of a law or an effect."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import sympy
from scipy.optimize import brentq
from scipy.special import lambertw

from srfcli.codegen.model import COMPLEX_STEP, Array, GeneratedModel, load_source
from srfcli.codegen.numpy_source import generate_motion
from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.settings import Parameter
from srfcli.core.units import QUANTITY_UNITS, SYMBOL_UNITS, Dimension, describe, dimension, dimension_of, to_base
from srfcli.laws.effect_file import summary
from srfcli.laws.expression import expm1, log1p, symbol
from srfcli.laws.law_file import COMMON, FORMULA, formula_of, kind_of
from srfcli.laws.registry import Registry, bundled_registry
from srfcli.laws.values import AgeingLaw, AgeingModifier, Effect, FrictionLaw, Interface, Law, State
from srfcli.symbolic.equations import CHECKED_LOAD, CHECKED_VELOCITIES, steady_age_formula
from srfcli.symbolic.system import System, build_system, formulas, with_effects

# What `srf law check` asks of a law: units, steady state, mu_v > 0, derivatives, worked values.

REFERENCE_LAW = "srf-vsat"  # the friction law whose parameters stand in where an ageing law is checked by itself
CHECKED_LOADS = np.logspace(-1, 3, 9)  # N
DERIVATIVE_RTOL = 1e-9


def check_law(law: Law) -> list[Outcome]:
    """Return the outcome of every check of a law or an effect; the shipped laws are what it is combined with."""
    registry = bundled_registry()
    if isinstance(law, Effect):
        return check_effect(law, registry)
    check = _LawCheck(law, registry)
    steps = [
        ("parameters", check.parameters_used),
        ("units", check.units),
        ("steady state", check.steady_state),
        ("mu_v > 0", check.direct_effect),
        ("derivatives", check.derivatives),
        ("worked values", check.worked_values),
    ]
    first = Outcome("parses", "ok", f"{kind_of(law)} law {law.name}: {FORMULA[kind_of(law)]} = {check.formula}")
    return [first, *run_checks(steps)]


def steady_age(rate: sympy.Expr, v: float, length: float, values: Values) -> float | None:
    """Return the attracting phi > 0 where a rate vanishes at velocity v and constant load, or None if there is none.

    Looked for between exp(-14) and exp(14) times length/v.
    """
    still = {"mu": 0.5, "mu_dot": 0.0, "W": CHECKED_LOAD, "W_dot": 0.0, "F_dot_over_W": 0.0}

    def at(y: Any) -> Any:
        return evaluate(rate, {**values, **still, "v": v, "phi": np.exp(y) * length / v}) + 0.0 * y

    grid = np.linspace(-14.03, 13.97, 113)  # off the round numbers, so that no zero falls on a node
    found = at(grid)
    falls = np.flatnonzero((found[:-1] > 0) & (found[1:] < 0))
    if len(falls) == 0:
        return None
    return float(np.exp(brentq(at, grid[falls[0]], grid[falls[0] + 1], xtol=1e-13)) * length / v)


def _expect(found: Dimension, wanted: Dimension, what: str) -> None:
    """Raise `SrfError` where a formula has another dimension than it should."""
    if found != wanted:
        raise SrfError(f"{what} is in {describe(found)}, expected {describe(wanted)}", "Look at the units under [parameters].")


class _LawCheck:
    """One law; an ageing law or a modifier with the friction parameters that it may name."""

    def __init__(self, law: Law, registry: Registry) -> None:
        self.law, self.registry, self.formula, self.parameters = law, registry, formula_of(law), law.parameters
        self.states = law.states if isinstance(law, FrictionLaw) else ()
        if isinstance(law, AgeingLaw | AgeingModifier):
            reference = registry.get("friction", REFERENCE_LAW).parameters
            self.parameters = (*(p for p in reference if p.name in COMMON), *law.parameters)
        self.values = reference_values(self.parameters)

    def parameters_used(self) -> str:
        """Raise `SrfError` for a parameter that neither the formula nor a state uses."""
        used = {s.name for s in self.formula.free_symbols} if self.formula is not None else set()
        if isinstance(self.law, FrictionLaw):
            used |= {name for state in self.states for name in (state.length, state.weight)} | set(COMMON)
        idle = [p.name for p in self.law.parameters if p.name not in used]
        if idle:
            raise SrfError(f"declared and not used: {', '.join(idle)}", "Remove them or mend the formula.")
        return f"{len(self.law.parameters)}, all used"

    def units(self) -> str:
        """Raise `SrfError` where a formula adds unlike things, takes log of a length or has the wrong dimension."""
        if self.formula is None:
            raise Skipped("a rigid interface has no formula")
        units = {name: dimension(unit) for name, unit in SYMBOL_UNITS.items()}
        units |= {state.name: units["phi"] for state in self.states}
        units |= {p.name: dimension(p.unit) for p in self.parameters}
        for state in self.states:
            _expect(units[state.length], dimension("um"), f"length '{state.length}' of state '{state.name}'")
            _expect(units[state.weight], dimension("1"), f"weight '{state.weight}' of state '{state.name}'")
        quantity = FORMULA[kind_of(self.law)]
        _expect(dimension_of(self.formula, units), dimension(QUANTITY_UNITS[quantity]), quantity)
        return f"{quantity} is in {QUANTITY_UNITS[quantity]}"

    def steady_state(self) -> str:
        """Raise `SrfError` where an age has no steady value, mu is not finite there or kappa is not positive."""
        law, values, found = self.law, self.values, []
        if isinstance(law, Interface):
            if law.kappa is None:
                raise Skipped("a rigid interface has no stiffness")
            for W in CHECKED_LOADS:
                found.append(float(evaluate(law.kappa, {**values, "W": W})))
                if not (np.isfinite(found[-1]) and found[-1] > 0):
                    raise SrfError(f"kappa = {found[-1]:g} N/um at W = {W:g} N", "A stiffness is positive and finite.")
            return f"kappa = {min(found):.6g} to {max(found):.6g} N/um from {CHECKED_LOADS[0]:g} to {CHECKED_LOADS[-1]:g} N"
        velocities = f"from {CHECKED_VELOCITIES[0]:g} to {CHECKED_VELOCITIES[-1]:g} um/s"
        if isinstance(law, FrictionLaw):
            for ageing, v, at in self.steady_sliding():
                if not np.isfinite(mu := evaluate(law.mu, at)):
                    raise SrfError(f"mu = {mu} at v = {v:g} um/s in steady sliding with {ageing}")
            return f"mu is finite {velocities} with {', '.join(e.name for e in self.registry.entries('ageing'))}"
        rate = law.rate if isinstance(law, AgeingLaw) else self.formula + self.registry.ageing("dieterich")[0].rate
        for v in CHECKED_VELOCITIES:
            phi = steady_age(rate, v, values["D0"], values)
            if phi is None:
                raise SrfError(f"phi has no attracting steady value at v = {v:g} um/s", "The rate must fall through 0 at one.")
            found.append(phi * v / values["D0"])
        own = {symbol(name): value for name, value in values.items()}
        closed = steady_age_formula(rate, symbol("D0"), symbol("phi"), law.name, own)
        for v, y in zip(CHECKED_VELOCITIES, found, strict=True):
            phi = y * values["D0"] / v
            exact = float(evaluate(closed, {**values, "v": v, "W": CHECKED_LOAD}))
            if not math.isclose(exact, phi, rel_tol=1e-6):
                raise SrfError(
                    f"phi may settle at {phi:.6g} and at {exact:.6g} s at v = {v:g} um/s",
                    "Steady sliding must be one state: write a rate that falls through 0 once.",
                )
        return f"phi v/D0 = {min(found):.6g} to {max(found):.6g} {velocities}"

    def steady_sliding(self) -> Iterator[tuple[str, float, Values]]:
        """Yield ageing law, v and the values of a friction law's symbols in steady sliding, for each ageing law and velocity."""
        own = self.values
        for entry, v in product(self.registry.entries("ageing"), CHECKED_VELOCITIES):
            ageing, _ = self.registry.ageing(entry.name)
            found = {}
            for state in self.states:
                values = {**own, **reference_values(ageing.parameters), "D0": own[state.length], "B": own[state.weight]}
                missing = sorted({s.name for s in ageing.rate.free_symbols & {symbol(n) for n in COMMON}} - set(values))
                if missing:
                    raise SrfError(f"ageing law '{entry.name}' needs '{missing[0]}', which the friction law lacks")
                phi = steady_age(ageing.rate, v, own[state.length], values)
                if phi is None:
                    raise SrfError(f"state '{state.name}' has no steady value at v = {v:g} um/s with {entry.name}")
                found[state.name] = phi
            yield entry.name, v, {**own, **found, "v": v}

    def direct_effect(self) -> str:
        """Raise `SrfError` where mu does not rise with v at fixed age, at a steady state."""
        if not isinstance(self.law, FrictionLaw):
            raise Skipped("only a friction law has mu")
        slope, found = sympy.diff(self.law.mu, symbol("v")), []
        for ageing, v, at in self.steady_sliding():
            found.append(v * evaluate(slope, at))
            if not found[-1] > 0:
                raise SrfError(
                    f"v mu_v = {found[-1]:.6g} at v = {v:g} um/s in steady sliding with {ageing}",
                    "Without mu_v > 0 the slip velocity is not determined; change the formula or the defaults.",
                )
        return f"v mu_v = {min(found):.6g} to {max(found):.6g} in steady sliding"

    def derivatives(self) -> str:
        """Raise `SrfError` where a first derivative by sympy differs from complex-step differentiation."""
        if self.formula is None:
            raise Skipped("a rigid interface has no formula")
        names, points, worst = sorted(s.name for s in self.formula.free_symbols), self.points(), 0.0
        for name in names:
            derivative = sympy.diff(self.formula, symbol(name))
            exact = np.array([evaluate(derivative, point) for point in points], dtype=float)
            steps = [COMPLEX_STEP * max(1.0, abs(point[name])) for point in points]
            moved = [{**point, name: complex(point[name], h)} for point, h in zip(points, steps, strict=True)]
            stepped = np.array([np.imag(evaluate(self.formula, at)) / h for at, h in zip(moved, steps, strict=True)])
            scale = np.max(np.abs(exact)) or 1.0
            error = float(np.max(np.abs(exact - stepped)) / scale)
            if not error < DERIVATIVE_RTOL:
                raise SrfError(f"d/d{name} = {derivative} differs from the complex step by {error:.2g} of its size")
            worst = max(worst, error)
        return f"by {', '.join(names)}: complex step agrees to {worst:.1e} at {len(points)} points"

    def points(self) -> list[dict[str, float]]:
        """Return points off any steady state at which derivatives are compared."""
        base, points = self.values, []
        length = base.get("D0", 1.0)
        for number, v in enumerate(CHECKED_VELOCITIES):
            stretch = (0.3, 1.7, 0.8)[number % 3]
            point = {**base, "v": v, "mu": 0.4, "mu_dot": 0.02, "W": 3.0 + number, "W_dot": -1.5, "F_dot_over_W": 0.03}
            for state in self.states or (State(),):
                point[state.name] = stretch * base.get(state.length, length) / v
            points.append(point)
        return points

    def worked_values(self) -> str:
        """Raise `SrfError` where a worked value is not met."""
        if self.law.checks and self.formula is None:
            raise SrfError("a rigid interface has no formula to check")
        return worked_values(self.law, {FORMULA[kind_of(self.law)]: self.formula}, self.parameters, self.values)


# What `srf law check` asks of an effect: units, a neutral value at which the model is its baseline, derivatives.

SLOT_UNITS = {
    "mu": "1", "rate": "1", "kappa": "N/um", "W": "N", "force": "N", "V": "um/s", "K": "N/um", "gauge": "um"
}  # fmt: skip
PLACE_UNITS = {"slip": "um", "stage": "um", "time": "s", "theta": "1", "envelope": "1", "u": "um"}
MOVING = {"slip", "stage", "time", "theta", "envelope"}  # an effect of these is steady nowhere
CHECKED_RUN = {"V": 9.0, "W0": 6.0, "eps": 0.1, "f": 110.0, "psi": 0.4, "onset0": 0.5, "rise0": 0.3, "modulated": 1.0}
POINTS = 24
AGREEMENT = 1e-9


def check_effect(effect: Effect, registry: Registry) -> list[Outcome]:
    """Return the outcome of every check of an effect; the shipped laws are the baseline that it is nested in."""
    check = _EffectCheck(effect, registry)
    steps = [
        ("parameters", check.parameters_used),
        ("units", check.units),
        ("baseline", check.baseline_found),
        ("neutral", check.neutral),
        ("acts", check.acts),
        ("steady start", check.steady_start),
        ("derivatives", check.derivatives),
        ("worked values", check.worked_values),
    ]
    return [Outcome("parses", "ok", f"effect {effect.name}: {summary(effect)}"), *run_checks(steps)]


class _EffectCheck:
    """One effect with a baseline that it can be added to."""

    def __init__(self, effect: Effect, registry: Registry) -> None:
        self.effect, self.registry = effect, registry

    # ---- formulas alone

    def parameters_used(self) -> str:
        formulas = [*(f for _, f in self.effect.written or self.effect.changes)]
        formulas += [f for s in self.effect.states for f in (s.rate, s.steady)]
        used = {str(s) for f in formulas for s in f.free_symbols}
        if isinstance(interface := dict(self.effect.settings).get("interface"), str):
            used |= {p.name for p in self.registry.get("interface", interface).parameters}
        constants = {c.name for c in self.effect.constants}
        idle = [n for n in (*(p.name for p in self.effect.parameters), *constants) if n not in used]
        if idle:
            raise SrfError(f"declared and not used: {', '.join(idle)}", "Remove them or mend the formula.")
        sizes = ", ".join(f"{name} = {value:g}" for name, value in self.effect.neutral)
        return f"{len(self.effect.parameters)}, all used" + (f"; the baseline has {sizes}" if sizes else "")

    def units(self) -> str:
        formulas = self.effect.written or self.effect.changes
        if not (formulas or self.effect.states):
            raise Skipped("there is no formula")
        units = {n: dimension(u) for n, u in {**SYMBOL_UNITS, **SLOT_UNITS, **PLACE_UNITS}.items()}
        declared = (*self.base.parameters, *self.system.parameters, *self.effect.parameters, *self.effect.constants)
        units |= {p.name: dimension(p.unit) for p in declared}
        for state in self.effect.states:
            units[state.name] = dimension_of(state.steady, units)
        for state in self.effect.states:
            found = dimension_of(state.rate, units)
            own = units[state.name]
            _expect(found, (own[0], own[1] - 1, own[2]), f"rate of {state.name}")
        for slot, formula in formulas:
            _expect(dimension_of(formula, units), dimension(SLOT_UNITS[slot]), slot)
        if self.effect.observed:
            _expect(units[self.effect.observed], dimension("um"), f"observed '{self.effect.observed}'")
        return ", ".join([*(f"{slot} is in {SLOT_UNITS[slot]}" for slot, _ in formulas),
                          *(f"{s.name} in {describe(units[s.name])}" for s in self.effect.states)])  # fmt: skip

    def worked_values(self) -> str:
        formulas = {**dict(self.effect.changes), **{s.name: s.rate for s in self.effect.states}}
        if not (formulas or self.effect.checks):
            raise Skipped("there is no formula")
        return worked_values(self.effect, formulas, self.effect.parameters, reference_values(self.effect.parameters))

    # ---- with a baseline

    @cached_property
    def base(self) -> System:
        """The first of the shipped systems that has what the effect needs and lacks what it lacks."""
        effect, names = self.effect, self.registry
        own = {p.name for p in effect.parameters}
        laws = sorted((e.name for e in names.entries("friction")), key=lambda n: (n != "srf-vsat", n != "dieterich-ruina"))
        ageing = sorted((e.name for e in names.entries("ageing")), key=lambda n: n != "dieterich")
        surfaces = sorted((e.name for e in names.entries("interface")), key=lambda n: (n != "elastic", n != "rigid"))
        for rate, law, surface, inertia in product(ageing, laws, surfaces, (True, False)):
            system = build_system(names, law=law, ageing=rate, interface=surface, inertia=inertia)
            declared = {p.name for p in system.parameters}
            if set(effect.needs) <= declared and not declared & {*effect.lacks, *(own if not effect.settings else ())}:
                return system
        raise SrfError(
            f"no shipped model has {', '.join(effect.needs) or 'any parameters'} and lacks "
            f"{', '.join([*effect.lacks, *sorted(own)])}",
            "Look at needs and lacks, and at names of parameters that a law has already.",
        )

    @cached_property
    def system(self) -> System:
        chosen = dict(self.effect.settings)
        base = self.base
        if chosen:
            base = build_system(
                self.registry, law=base.friction.name, ageing=base.ageing.name,
                interface=str(chosen.get("interface", base.interface.name)),
                inertia=bool(chosen.get("inertia", base.inertia)),
            )  # fmt: skip
        return with_effects(base, (self.effect,))

    @cached_property
    def model(self) -> GeneratedModel:
        return load_source(generate_motion(self.system))

    @cached_property
    def plain(self) -> GeneratedModel:
        return load_source(generate_motion(self.base))

    def baseline_found(self) -> str:
        missing = [n for n in self.effect.frees if n not in self.model.names]
        if missing:
            raise SrfError(f"frees '{missing[0]}', which the model does not have", f"It has {', '.join(self.model.names)}.")
        added = self.model.states[len(self.plain.states) :] if not self.effect.settings else ()
        return self.base.title + (f"; unknowns added: {', '.join(added)}" if added else "")

    def neutral(self) -> str:
        if self.effect.settings:
            raise Skipped(f"the baseline is another system: {self.base.title}")
        own = len(self.plain.states)
        ours = self.rates(self.model, self.p_neutral)[:, :own]
        worst = _difference(ours, self.rates(self.plain, _vector(self.plain)))
        steady = np.asarray(self.model.steady(self.p_neutral))[:own]
        start = _difference(steady, np.asarray(self.plain.steady(_vector(self.plain))))
        told = ", ".join(f"{n} = {v:g}" for n, v in self.effect.neutral) or "any value"
        if not max(worst, start) < AGREEMENT:
            where, size = ("the rates", worst) if not worst < AGREEMENT else ("steady sliding", start)
            raise SrfError(
                f"at {told} {where} differ from the baseline's by {size:.2g} of their size", "The effect must vanish there."
            )
        return f"at {told} rates and steady sliding are the baseline's{_to(max(worst, start))}"

    def acts(self) -> str:
        """Raise SrfError where nothing changes at the default values."""
        if self.effect.settings or self.effect.frees or self.effect.observed:
            raise Skipped("it is what is fitted or observed that changes")
        if {slot for slot, _ in self.effect.changes} == {"gauge"}:
            return self._shown()
        away, at = (self.rates(self.model, p)[:, : len(self.plain.states)] for p in (_vector(self.model), self.p_neutral))
        moved = _difference(away, at)
        if not np.isfinite(moved):
            raise SrfError("the rates are not finite at the default values", "Look at the formula and the defaults.")
        if moved < 1e-12:
            raise SrfError("at the default values the effect changes nothing", "Give the size a default off its neutral value.")
        return f"at the default values a rate moves by up to {moved:.2g} of the largest"

    def _shown(self) -> str:
        """Return how far the reading moves at the default values; SrfError where it does not, or moves at the neutral ones."""
        x, V, W, W_dot = self.points

        def read(model: GeneratedModel, p: Array) -> Array:
            return np.asarray(model.reading(x[:, : len(model.states)], V, W, W_dot, p))

        plain = read(self.plain, _vector(self.plain))
        if not (off := _difference(read(self.model, self.p_neutral), plain)) < AGREEMENT:
            what = f"at the neutral values the reading differs by {off:.2g} of its size"
            raise SrfError(what, "The formula must be `gauge` alone there.")
        moved = _difference(read(self.model, _vector(self.model)), plain)
        if moved < 1e-12:
            raise SrfError("at the default values the gauge shows what it did", "Give the size a default off its neutral value.")
        return f"at the default values the reading moves by up to {moved:.2g} of the largest"

    def steady_start(self) -> str:
        used = {str(s) for f in formulas(self.effect) for s in f.free_symbols} & MOVING
        if used:
            raise Skipped(f"with {', '.join(sorted(used))} in the formula nothing is steady")
        p = _vector(self.model)
        rates = np.asarray(self.model.rates(np.asarray(self.model.steady(p)), CHECKED_RUN["V"], CHECKED_RUN["W0"], 0.0, p))
        scale = np.max(np.abs(self.rates(self.model, p)), axis=0)
        worst = float(np.max(np.abs(rates) / np.maximum(scale, 1e-300)))
        if not worst < 1e-8:
            name = self.model.states[int(np.argmax(np.abs(rates) / np.maximum(scale, 1e-300)))]
            raise SrfError(
                f"in steady sliding under W0 {name} moves, by {worst:.2g} of its usual rate",
                "A formula of an effect must not lean on W_dot or mu_dot at rest; look at `steady` of its states.",
            )
        return f"nothing moves at V under W0{_to(worst, ' but for', ' of the usual rates')}"

    def derivatives(self) -> str:
        model, p = self.model, _vector(self.model)
        exact = (model.rates_jacobian(*self.points, p), model.rates_parameters(*self.points, p))
        stepped, worst = _stepped(model, *self.points, p), 0.0
        for found, expected, names in zip(exact, stepped, (model.states, model.names), strict=True):
            for j, name in enumerate(names):
                error = _difference(np.asarray(found)[:, :, j], expected[:, :, j])
                if not error < AGREEMENT:
                    raise SrfError(f"d(rates)/d({name}) differs from the complex step by {error:.2g} of its size")
                worst = max(worst, error)
        counted = f"{len(model.states)} unknowns and {len(model.names)} parameters"
        return f"by {counted}: complex step agrees{_to(worst)}"

    # ---- numbers

    @cached_property
    def p_neutral(self) -> Array:
        """The parameters of the model with the effect at its neutral values."""
        units = {p.name: p.unit for p in self.effect.parameters}
        return _vector(self.model, {n: to_base(v, units[n]) for n, v in self.effect.neutral})

    @cached_property
    def points(self) -> tuple[Array, Array, Array, Array]:
        """Random states x (POINTS, n) around steady sliding, and V, W, W_dot; slip, stage and time are anywhere in a run."""
        rng = np.random.default_rng(20)
        x = np.asarray(self.model.steady(_vector(self.model)))
        spread = {"slip": 40.0, "stage": 40.0, "time": 1.5}
        columns = []
        for name, log, at in zip(self.model.states, self.model.logarithmic, x, strict=True):
            r = rng.standard_normal(POINTS)
            at = at if np.isfinite(at) else 1.0
            if name in spread:
                columns.append(spread[name] * rng.uniform(size=POINTS))
            else:
                columns.append(at + 0.5 * r if log else at * (1 + 0.1 * r))
        V, W = 9.0 * np.exp(0.3 * rng.standard_normal(POINTS)), 6.0 * (1 + 0.1 * rng.standard_normal(POINTS))
        return np.column_stack(columns), V, W, 300.0 * rng.standard_normal(POINTS)

    def rates(self, model: GeneratedModel, p: Array) -> Array:
        """Return the rates at the points, of a model with the effect or of one without."""
        x, V, W, W_dot = self.points
        return np.asarray(model.rates(x[:, : len(model.states)], V, W, W_dot, p))


def _vector(model: GeneratedModel, values: Mapping[str, float] | None = None) -> Array:
    """Return the parameters of a model at CHECKED_RUN, some of them at other values."""
    return model.vector({n: v for n, v in CHECKED_RUN.items() if n in model.names} | dict(values or {}))


def _stepped(model: GeneratedModel, x: Array, V: Array, W: Array, W_dot: Array, p: Array) -> tuple[Array, Array]:
    """Return d(rates)/dx (POINTS, n, n) and d(rates)/dp (POINTS, n, parameters) by complex steps; V is what is imposed."""

    def slopes(x: Array, V: Array, p: Array) -> Array:
        return np.asarray(model.rates(x, V, W, W_dot, p)).imag / COMPLEX_STEP

    h, states, drive, values = 1j * COMPLEX_STEP, x.astype(complex), V.astype(complex), p.astype(complex)
    by_states = [slopes(states + h * one, V, p) for one in np.eye(x.shape[1])]
    by_values = [
        slopes(states, drive + h, values) if name == "V" else slopes(states, drive, values + h * one)
        for name, one in zip(model.names, np.eye(p.size), strict=True)
    ]
    return np.stack(by_states, axis=-1), np.stack(by_values, axis=-1)


def _difference(found: Array, expected: Array) -> float:
    """Return the largest difference over the largest size in its column, infinite where a number is not one."""
    if not (np.isfinite(found).all() and np.isfinite(expected).all()):
        return float("inf")
    scale = np.max(np.abs(np.atleast_2d(expected)), axis=0)
    return float(np.max(np.abs(found - expected) / np.where(scale > 0, scale, 1.0), initial=0.0))


def _to(size: float, before: str = " to", after: str = "") -> str:
    """Return how far something is off as words, none where it is not."""
    return f"{before} {size:.0e}{after}" if size else ""


# What checks of laws and of effects share: outcomes, and the numbers of formulas.

Values = Mapping[str, Any]


NUMPY: dict[Any, Callable[[Any], Any]] = {
    sympy.exp: np.exp, sympy.log: np.log, log1p: np.log1p, expm1: np.expm1, sympy.sin: np.sin, sympy.cos: np.cos,
    sympy.sinh: np.sinh, sympy.cosh: np.cosh, sympy.tanh: np.tanh, sympy.asinh: np.arcsinh, sympy.atan: np.arctan,
    sympy.LambertW: lambda x: lambertw(x) if np.iscomplexobj(x) else lambertw(x).real,
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """The outcome of one check: `verdict` is ok, FAIL or skipped, `text` says what was found or why it was skipped."""

    check: str
    verdict: str
    text: str


class Skipped(Exception):
    """A check that does not apply; the text says why."""


def worked_values(law: Law, formulas: Mapping[str, Any], parameters: Sequence[Parameter], values: Values) -> str:
    """Return how many worked values a law's formulas meet; raise `SrfError` where one is not met."""
    if not law.checks:
        raise Skipped("the law gives none; add [[checks]]")
    units = {p.name: p.unit for p in parameters}
    for number, check in enumerate(law.checks):
        if check.quantity not in formulas:
            raise SrfError(f"checks[{number}]: no formula for '{check.quantity}'", did_you_mean(check.quantity, formulas))
        formula = formulas[check.quantity]
        given = {**values, **{name: to_base(value, units.get(name, "1")) for name, value in check.at}}
        missing = sorted({s.name for s in formula.free_symbols} - set(given))
        if missing:
            raise SrfError(f"checks[{number}]: no value for '{missing[0]}'", "Add it to the table 'at'.")
        found = float(evaluate(formula, given))
        if not abs(found - check.value) <= check.rtol * abs(check.value):
            raise SrfError(f"checks[{number}]: {check.quantity} = {found!r}, expected {check.value!r}")
    return f"{len(law.checks)} met"


def run_checks(steps: Sequence[tuple[str, Callable[[], str]]]) -> list[Outcome]:
    """Return the outcome of each named check, a function that returns what it found and raises SrfError or Skipped."""
    outcomes = []
    for name, step in steps:
        try:
            with np.errstate(all="ignore"):  # a formula outside its range shows as nan, and is reported as such
                outcomes.append(Outcome(name, "ok", step()))
        except Skipped as reason:
            outcomes.append(Outcome(name, "skipped", str(reason)))
        except SrfError as error:
            text = error.message + (f". {error.hint}" if error.hint else "")
            outcomes.append(Outcome(name, "FAIL", text))
        except (ArithmeticError, ValueError, TypeError) as error:  # numbers of a formula far outside floating point
            outcomes.append(Outcome(name, "FAIL", f"the formula cannot be computed: {error}"))
    return outcomes


def evaluate(expr: sympy.Expr, values: Values) -> Any:
    """Return the number of a formula at `values`, walking its tree: independent of sympy's derivatives and printers."""
    if expr.is_Symbol:
        return values[expr.name]
    if expr.is_Rational:
        return int(expr.p) / int(expr.q)
    if isinstance(expr, sympy.NumberSymbol):
        return float(expr)
    arguments = [evaluate(a, values) for a in expr.args]
    if isinstance(expr, sympy.Add):
        return sum(arguments[1:], start=arguments[0])
    if isinstance(expr, sympy.Mul):
        return math.prod(arguments[1:], start=arguments[0])
    if isinstance(expr, sympy.Pow):
        return np.power(arguments[0], arguments[1])
    return NUMPY[expr.func](arguments[0])


def reference_values(parameters: Iterable[Parameter]) -> dict[str, float]:
    """Return the defaults of parameters in um, s, N."""
    return {p.name: to_base(p.default, p.unit) for p in parameters}
