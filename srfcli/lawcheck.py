"""What `srf law check` asks of a law: units, steady state, mu_v > 0, derivatives, worked values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import sympy
from scipy.optimize import brentq

from srfcli.checking import STEP, Outcome, Skipped, Values, evaluate, reference_values, run_checks
from srfcli.dimensions import QUANTITY_UNITS, SYMBOL_UNITS, Dimension, describe, dimension_of, parse_unit
from srfcli.errors import SrfError
from srfcli.expression import symbol
from srfcli.lawfile import COMMON, FORMULA, formula_of, kind_of
from srfcli.laws import AgeingLaw, AgeingModifier, Effect, FrictionLaw, Interface, Law, Parameter, State
from srfcli.registry import Registry, bundled_registry

REFERENCE = "srf-vsat"  # the friction law whose parameters stand in where an ageing law is checked by itself
VELOCITIES = np.logspace(-3, 3, 7)  # um/s
LOADS = np.logspace(-1, 3, 9)  # N
DERIVATIVE_RTOL = 1e-9


def check_law(law: Law) -> list[Outcome]:
    """Return the outcome of every check of a law or an effect; the shipped laws are what it is combined with."""
    registry = bundled_registry()
    if isinstance(law, Effect):
        from srfcli.effectcheck import check_effect

        return check_effect(law, registry)
    steps: list[tuple[str, Callable[[Law, Registry], str]]] = [
        ("parameters", check_parameters_used),
        ("units", check_units),
        ("steady state", check_steady_state),
        ("mu_v > 0", check_direct_effect),
        ("derivatives", check_derivatives),
        ("worked values", check_worked_values),
    ]
    first = Outcome("parses", "ok", f"{kind_of(law)} law {law.name}: {FORMULA[kind_of(law)]} = {formula_of(law)}")
    return [first, *run_checks([(name, partial(step, law, registry)) for name, step in steps])]


def steady_age(rate: sympy.Expr, v: float, length: float, values: Values) -> float | None:
    """Return the attracting phi > 0 where a rate vanishes at velocity v and constant load, or None if there is none.

    Looked for between exp(-14) and exp(14) times length/v.
    """
    still = {"mu": 0.5, "mu_dot": 0.0, "W": 10.0, "W_dot": 0.0, "F_dot_over_W": 0.0}

    def at(y: Any) -> Any:
        return evaluate(rate, {**values, **still, "v": v, "phi": np.exp(y) * length / v}) + 0.0 * y

    grid = np.linspace(-14.03, 13.97, 113)  # off the round numbers, so that no zero falls on a node
    found = at(grid)
    falls = np.flatnonzero((found[:-1] > 0) & (found[1:] < 0))
    if len(falls) == 0:
        return None
    return float(np.exp(brentq(at, grid[falls[0]], grid[falls[0] + 1], xtol=1e-13)) * length / v)


def check_parameters_used(law: Law, registry: Registry) -> str:
    """Raise `SrfError` for a parameter that neither the formula nor a state uses."""
    formula = formula_of(law)
    used = {s.name for s in formula.free_symbols} if formula is not None else set()
    if isinstance(law, FrictionLaw):
        used |= {name for state in law.states for name in (state.length, state.weight)} | set(COMMON)
    idle = [p.name for p in law.parameters if p.name not in used]
    if idle:
        raise SrfError(f"declared and not used: {', '.join(idle)}", "Remove them or mend the formula.")
    return f"{len(law.parameters)}, all used"


def check_units(law: Law, registry: Registry) -> str:
    """Raise `SrfError` where a formula adds unlike things, takes log of a length or has the wrong dimension."""
    formula, quantity = formula_of(law), FORMULA[kind_of(law)]
    if formula is None:
        raise Skipped("a rigid interface has no formula")
    states = law.states if isinstance(law, FrictionLaw) else ()
    units = {name: parse_unit(unit).dimension for name, unit in SYMBOL_UNITS.items()}
    units |= {state.name: units["phi"] for state in states}
    units |= {p.name: parse_unit(p.unit).dimension for p in _parameters(law, registry)}
    for state in states:
        _expect(units[state.length], "um", f"length '{state.length}' of state '{state.name}'")
        _expect(units[state.weight], "1", f"weight '{state.weight}' of state '{state.name}'")
    unit = QUANTITY_UNITS[quantity]
    _expect(dimension_of(formula, units), unit, quantity)
    return f"{quantity} is in {unit}"


def check_steady_state(law: Law, registry: Registry) -> str:
    """Raise `SrfError` where an age has no steady value, mu is not finite there or kappa is not positive."""
    if isinstance(law, Interface):
        return _check_stiffness(law)
    if isinstance(law, FrictionLaw):
        values = reference_values(law.parameters)
        names = []
        for ageing in _ageing_laws(registry):
            for v in VELOCITIES:
                _finite(law, evaluate(law.mu, {**values, **_steady(law, ageing, v), "v": v}), v, ageing)
            names.append(ageing.name)
        return f"mu is finite from {VELOCITIES[0]:g} to {VELOCITIES[-1]:g} um/s with {', '.join(names)}"
    rate = law.rate if isinstance(law, AgeingLaw) else formula_of(law) + _ageing(registry, "dieterich").rate
    values = reference_values(_parameters(law, registry))
    found = []
    for v in VELOCITIES:
        phi = steady_age(rate, v, values["D0"], values)
        if phi is None:
            raise SrfError(
                f"phi has no attracting steady value at v = {v:g} um/s", "The rate must fall through 0 at one."
            )
        found.append(phi * v / values["D0"])
    return f"phi v/D0 = {min(found):.6g} to {max(found):.6g} from {VELOCITIES[0]:g} to {VELOCITIES[-1]:g} um/s"


def check_direct_effect(law: Law, registry: Registry) -> str:
    """Raise `SrfError` where mu does not rise with v at fixed age, at a steady state."""
    if not isinstance(law, FrictionLaw):
        raise Skipped("only a friction law has mu")
    slope = sympy.diff(law.mu, symbol("v"))
    values = reference_values(law.parameters)
    found = []
    for ageing in _ageing_laws(registry):
        for v in VELOCITIES:
            value = v * evaluate(slope, {**values, **_steady(law, ageing, v), "v": v})
            if not value > 0:
                raise SrfError(
                    f"v mu_v = {value:.6g} at v = {v:g} um/s in steady sliding with {ageing.name}",
                    "Without mu_v > 0 the slip velocity is not determined; change the formula or the defaults.",
                )
            found.append(value)
    return f"v mu_v = {min(found):.6g} to {max(found):.6g} in steady sliding"


def check_derivatives(law: Law, registry: Registry) -> str:
    """Raise `SrfError` where a first derivative by sympy differs from complex-step differentiation."""
    formula = formula_of(law)
    if formula is None:
        raise Skipped("a rigid interface has no formula")
    names = sorted(s.name for s in formula.free_symbols)
    points = _sample(law, registry)
    worst = 0.0
    for name in names:
        derivative = sympy.diff(formula, symbol(name))
        exact = np.array([evaluate(derivative, point) for point in points], dtype=float)
        stepped = np.array([_complex_step(formula, name, point) for point in points])
        scale = np.max(np.abs(exact)) or 1.0
        error = float(np.max(np.abs(exact - stepped)) / scale)
        if not error < DERIVATIVE_RTOL:
            raise SrfError(f"d/d{name} = {derivative} differs from the complex step by {error:.2g} of its size")
        worst = max(worst, error)
    return f"by {', '.join(names)}: complex step agrees to {worst:.1e} at {len(points)} points"


def check_worked_values(law: Law, registry: Registry) -> str:
    """Raise `SrfError` where a worked value is not met."""
    formula = formula_of(law)
    if not law.checks:
        raise Skipped("the law gives none; add [[checks]]")
    if formula is None:
        raise SrfError("a rigid interface has no formula to check")
    units = {p.name: parse_unit(p.unit).factor for p in _parameters(law, registry)}
    for number, check in enumerate(law.checks):
        values = reference_values(_parameters(law, registry))
        values |= {name: value * units.get(name, 1.0) for name, value in check.at}
        missing = sorted({s.name for s in formula.free_symbols} - set(values))
        if missing:
            raise SrfError(f"checks[{number}]: no value for '{missing[0]}'", "Add it to the table 'at'.")
        found = float(evaluate(formula, values))
        if not abs(found - check.value) <= check.rtol * abs(check.value):
            raise SrfError(f"checks[{number}]: {check.quantity} = {found!r}, expected {check.value!r}")
    return f"{len(law.checks)} met"


def _check_stiffness(law: Interface) -> str:
    if law.kappa is None:
        raise Skipped("a rigid interface has no stiffness")
    found = [float(evaluate(law.kappa, {**reference_values(law.parameters), "W": W})) for W in LOADS]
    for W, kappa in zip(LOADS, found, strict=True):
        if not (np.isfinite(kappa) and kappa > 0):
            raise SrfError(f"kappa = {kappa:g} N/um at W = {W:g} N", "A stiffness is positive and finite.")
    return f"kappa = {min(found):.6g} to {max(found):.6g} N/um from {LOADS[0]:g} to {LOADS[-1]:g} N"


def _parameters(law: Law, registry: Registry) -> tuple[Parameter, ...]:
    """Return a law's parameters, and for an ageing law or modifier the friction parameters that it may name."""
    if not isinstance(law, AgeingLaw | AgeingModifier):
        return law.parameters
    reference = registry.get("friction", REFERENCE).parameters
    return (*(p for p in reference if p.name in COMMON), *law.parameters)


def _ageing_laws(registry: Registry) -> list[AgeingLaw]:
    return [_ageing(registry, entry.name) for entry in registry.entries("ageing")]


def _ageing(registry: Registry, name: str) -> AgeingLaw:
    law = registry.get("ageing", name)
    assert isinstance(law, AgeingLaw)
    return law


def _steady(law: FrictionLaw, ageing: AgeingLaw, v: float) -> dict[str, float]:
    """Return each state of a friction law in steady sliding."""
    own = reference_values(law.parameters)
    return {state.name: _steady_of(state, ageing, v, own) for state in law.states}


def _steady_of(state: State, ageing: AgeingLaw, v: float, own: Mapping[str, float]) -> float:
    values = {**own, **reference_values(ageing.parameters), "D0": own[state.length], "B": own[state.weight]}
    missing = sorted({s.name for s in ageing.rate.free_symbols & {symbol(n) for n in COMMON}} - set(values))
    if missing:
        raise SrfError(f"ageing law '{ageing.name}' needs '{missing[0]}', which the friction law lacks")
    phi = steady_age(ageing.rate, v, own[state.length], values)
    if phi is None:
        raise SrfError(f"state '{state.name}' has no steady value at v = {v:g} um/s with {ageing.name}")
    return phi


def _finite(law: FrictionLaw, value: float, v: float, ageing: AgeingLaw) -> None:
    if not np.isfinite(value):
        raise SrfError(f"mu = {value} at v = {v:g} um/s in steady sliding with {ageing.name}")


def _expect(found: Dimension, unit: str, what: str) -> None:
    if found != parse_unit(unit).dimension:
        raise SrfError(f"{what} is in {describe(found)}, expected {unit}", "Look at the units under [parameters].")


def _sample(law: Law, registry: Registry) -> list[dict[str, float]]:
    """Return points off any steady state at which derivatives are compared."""
    base = reference_values(_parameters(law, registry))
    length = base.get("D0", 1.0)
    points = []
    for number, v in enumerate(VELOCITIES):
        stretch = (0.3, 1.7, 0.8)[number % 3]
        point = {**base, "v": v, "mu": 0.4, "mu_dot": 0.02, "W": 3.0 + number, "W_dot": -1.5, "F_dot_over_W": 0.03}
        states = law.states if isinstance(law, FrictionLaw) else (State(),)
        for state in states:
            point[state.name] = stretch * base.get(state.length, length) / v
        points.append(point)
    return points


def _complex_step(formula: sympy.Expr, name: str, point: Mapping[str, float]) -> float:
    size = STEP * max(1.0, abs(point[name]))
    moved = {**point, name: complex(point[name], size)}
    return float(np.imag(evaluate(formula, moved)) / size)
