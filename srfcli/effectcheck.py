"""What `srf law check` asks of an effect: units, a neutral value at which the model is its baseline, derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from srfcli.checking import STEP, Outcome, Skipped, run_checks
from srfcli.dimensions import SYMBOL_UNITS, Dimension, describe, dimension_of, parse_unit
from srfcli.effectfile import summary
from srfcli.errors import SrfError
from srfcli.generate_motion import generate_motion
from srfcli.laws import Effect, Interface
from srfcli.model import GeneratedModel, load_source
from srfcli.registry import Registry
from srfcli.system import System, build_system, with_effects

Array = NDArray[np.float64]
SLOT_UNITS = {"mu": "1", "rate": "1", "kappa": "N/um", "W": "N", "force": "N", "V": "um/s"}
PLACE_UNITS = {"slip": "um", "stage": "um", "time": "s", "theta": "1", "envelope": "1", "u": "um"}
MOVING = {"slip", "stage", "time", "theta", "envelope"}  # an effect of these is steady nowhere
POINTS = 24
RTOL = 1e-9


def check_effect(effect: Effect, registry: Registry) -> list[Outcome]:
    """Return the outcome of every check of an effect; the shipped laws are the baseline that it is nested in."""
    check = _Check(effect, registry)
    steps = [
        ("parameters", check.parameters_used),
        ("units", check.units),
        ("baseline", check.baseline_found),
        ("neutral", check.neutral),
        ("acts", check.acts),
        ("steady start", check.steady_start),
        ("derivatives", check.derivatives),
    ]
    return [Outcome("parses", "ok", f"effect {effect.name}: {summary(effect)}"), *run_checks(steps)]


@dataclass(frozen=True)
class _Points:
    """Random states x (POINTS, n) and what is imposed on them; the same for a model with an effect and for one without."""

    x: Array
    V: Array
    W: Array
    W_dot: Array

    def rates(self, model: GeneratedModel, p: Array) -> Array:
        return np.asarray(model.rates(self.x[:, : len(model.states)], self.V, self.W, self.W_dot, p))


class _Check:
    """One effect with a baseline that it can be added to."""

    def __init__(self, effect: Effect, registry: Registry) -> None:
        self.effect, self.registry = effect, registry

    # ---- formulas alone

    def parameters_used(self) -> str:
        formulas = [*(f for _, f in self.effect.written or self.effect.changes)]
        formulas += [f for s in self.effect.states for f in (s.rate, s.steady)]
        used = {str(s) for f in formulas for s in f.free_symbols}
        if self.effect.settings:
            used |= {p.name for name in self._own_interface() for p in name.parameters}
        constants = {c.name for c in self.effect.constants}
        idle = [n for n in (*(p.name for p in self.effect.parameters), *constants) if n not in used]
        if idle:
            raise SrfError(f"declared and not used: {', '.join(idle)}", "Remove them or mend the formula.")
        sizes = ", ".join(f"{name} = {value:g}" for name, value in self.effect.neutral)
        return f"{len(self.effect.parameters)}, all used" + (f"; the baseline has {sizes}" if sizes else "")

    def _own_interface(self) -> list[Interface]:
        name = dict(self.effect.settings).get("interface")
        law = self.registry.get("interface", name) if isinstance(name, str) else None
        return [law] if isinstance(law, Interface) else []

    def units(self) -> str:
        formulas = self.effect.written or self.effect.changes
        if not (formulas or self.effect.states):
            raise Skipped("there is no formula")
        units = self._symbol_units()
        for state in self.effect.states:
            units[state.name] = dimension_of(state.steady, units)
        for state in self.effect.states:
            found = dimension_of(state.rate, units)
            own = units[state.name]
            _expect(found, (own[0], own[1] - 1, own[2]), f"rate of {state.name}")
        for slot, formula in formulas:
            _expect(dimension_of(formula, units), parse_unit(SLOT_UNITS[slot]).dimension, slot)
        if self.effect.observed:
            _expect(units[self.effect.observed], parse_unit("um").dimension, f"observed '{self.effect.observed}'")
        return ", ".join([*(f"{slot} is in {SLOT_UNITS[slot]}" for slot, _ in formulas),
                          *(f"{s.name} in {describe(units[s.name])}" for s in self.effect.states)])  # fmt: skip

    def _symbol_units(self) -> dict[str, Dimension]:
        """Return the dimension of every name, those of the baseline's parameters among them."""
        units = {n: parse_unit(u).dimension for n, u in {**SYMBOL_UNITS, **SLOT_UNITS, **PLACE_UNITS}.items()}
        declared = (*self.base.parameters, *self.system.parameters, *self.effect.parameters, *self.effect.constants)
        return units | {p.name: parse_unit(p.unit).dimension for p in declared}

    # ---- with a baseline

    @cached_property
    def base(self) -> System:
        """The first of the shipped systems that has what the effect needs and lacks what it lacks."""
        effect, names = self.effect, self.registry
        own = {p.name for p in effect.parameters}
        laws = sorted(
            (e.name for e in names.entries("friction")), key=lambda n: (n != "srf-vsat", n != "dieterich-ruina")
        )
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
            raise SrfError(
                f"frees '{missing[0]}', which the model does not have", f"It has {', '.join(self.model.names)}."
            )
        added = self.model.states[len(self.plain.states) :] if not self.effect.settings else ()
        return self.base.title + (f"; unknowns added: {', '.join(added)}" if added else "")

    def neutral(self) -> str:
        if self.effect.settings:
            raise Skipped(f"the baseline is another system: {self.base.title}")
        points, values = self._points(), self._neutral_values()
        ours = points.rates(self.model, self._vector(values))[:, : len(self.plain.states)]
        theirs = points.rates(self.plain, self.plain.vector(self._values(self.plain)))
        worst = _difference(ours, theirs)
        steady = np.asarray(self.model.steady(self._vector(values)))[: len(self.plain.states)]
        start = _difference(steady, np.asarray(self.plain.steady(self.plain.vector(self._values(self.plain)))))
        told = ", ".join(f"{n} = {v:g}" for n, v in self.effect.neutral) or "any value"
        if not max(worst, start) < RTOL:
            where, size = ("the rates", worst) if not worst < RTOL else ("steady sliding", start)
            raise SrfError(
                f"at {told} {where} differ from the baseline's by {size:.2g} of their size",
                "The effect must vanish there.",
            )
        return f"at {told} rates and steady sliding are the baseline's{_to(max(worst, start))}"

    def acts(self) -> str:
        """Raise SrfError where nothing changes at the default values."""
        if self.effect.settings or self.effect.frees or self.effect.observed:
            raise Skipped("it is what is fitted or observed that changes")
        points, own = self._points(), len(self.plain.states)
        away = points.rates(self.model, self._vector())[:, :own]
        at = points.rates(self.model, self._vector(self._neutral_values()))[:, :own]
        moved = np.max(np.abs(away - at) / np.maximum(np.max(np.abs(at), axis=0), 1e-300))
        if not np.isfinite(away).all():
            raise SrfError("the rates are not finite at the default values", "Look at the formula and the defaults.")
        if moved < 1e-12:
            raise SrfError(
                "at the default values the effect changes nothing", "Give the size a default off its neutral value."
            )
        return f"at the default values a rate moves by up to {moved:.2g} of the largest"

    def steady_start(self) -> str:
        formulas = [*(f for _, f in self.effect.changes), *(f for s in self.effect.states for f in (s.rate, s.steady))]
        used = {str(s) for f in formulas for s in f.free_symbols} & MOVING
        if used:
            raise Skipped(f"with {', '.join(sorted(used))} in the formula nothing is steady")
        values = self._values(self.model)
        x = np.asarray(self.model.steady(self._vector()))
        rates = np.asarray(self.model.rates(x, values["V"], values["W0"], 0.0, self._vector()))
        scale = np.max(np.abs(self._points().rates(self.model, self._vector())), axis=0)
        worst = float(np.max(np.abs(rates) / np.maximum(scale, 1e-300)))
        if not worst < 1e-8:
            name = self.model.states[int(np.argmax(np.abs(rates) / np.maximum(scale, 1e-300)))]
            raise SrfError(
                f"in steady sliding under W0 {name} moves, by {worst:.2g} of its usual rate",
                "A formula of an effect must not lean on W_dot or mu_dot at rest; look at `steady` of its states.",
            )
        return f"nothing moves at V under W0{_to(worst, ' but for', ' of the usual rates')}"

    def derivatives(self) -> str:
        points, model, p = self._points(), self.model, self._vector()
        x = points.x[:, : len(model.states)]
        given = (points.V, points.W, points.W_dot)
        exact = (model.rates_jacobian(x, *given, p), model.rates_parameters(x, *given, p))
        stepped = (_stepped_states(model, points, p), _stepped_parameters(model, points, p))
        worst = 0.0
        for found, expected, names in zip(exact, stepped, (model.states, model.names), strict=True):
            for j, name in enumerate(names):
                error = _difference(np.asarray(found)[:, :, j], expected[:, :, j])
                if not error < RTOL:
                    raise SrfError(f"d(rates)/d({name}) differs from the complex step by {error:.2g} of its size")
                worst = max(worst, error)
        counted = f"{len(model.states)} unknowns and {len(model.names)} parameters"
        return f"by {counted}: complex step agrees{_to(worst)}"

    # ---- numbers

    def _values(self, model: GeneratedModel) -> dict[str, float]:
        run = {"V": 9.0, "W0": 6.0, "eps": 0.1, "f": 110.0, "psi": 0.4, "onset0": 0.5, "rise0": 0.3, "modulated": 1.0}
        return {n: v for n, v in run.items() if n in model.names}

    def _neutral_values(self) -> dict[str, float]:
        units = {p.name: parse_unit(p.unit).factor for p in self.effect.parameters}
        return {n: v * units[n] for n, v in self.effect.neutral}

    def _vector(self, values: Mapping[str, float] | None = None) -> Array:
        """Return p with the effect's defaults, the sizes' at the values given; a default that is neutral moves off."""
        return self.model.vector({**self._values(self.model), **(values or {})})

    def _points(self) -> _Points:
        """Return states around steady sliding, in which places and clock are anywhere in a run."""
        rng = np.random.default_rng(20)
        x = np.asarray(self.model.steady(self._vector()))
        spread = {"slip": 40.0, "stage": 40.0, "time": 1.5}
        columns = []
        for name, log, at in zip(self.model.states, self.model.logarithmic, x, strict=True):
            r = rng.standard_normal(POINTS)
            at = at if np.isfinite(at) else 1.0
            columns.append(
                spread[name] * rng.uniform(size=POINTS)
                if name in spread
                else at + 0.5 * r
                if log
                else at * (1 + 0.1 * r)
            )
        V, W = 9.0 * np.exp(0.3 * rng.standard_normal(POINTS)), 6.0 * (1 + 0.1 * rng.standard_normal(POINTS))
        return _Points(np.column_stack(columns), V, W, 300.0 * rng.standard_normal(POINTS))


def _stepped_states(model: GeneratedModel, points: _Points, p: Array) -> Array:
    """Return d(rates)/dx (POINTS, n, n) by complex steps."""
    x = points.x[:, : len(model.states)].astype(complex)
    columns = []
    for j in range(x.shape[1]):
        moved = x.copy()
        moved[:, j] += 1j * STEP
        columns.append(np.asarray(model.rates(moved, points.V, points.W, points.W_dot, p)).imag / STEP)
    return np.stack(columns, axis=-1)


def _stepped_parameters(model: GeneratedModel, points: _Points, p: Array) -> Array:
    """Return d(rates)/dp (POINTS, n, parameters) by complex steps; V is what is imposed, not what p says."""
    x = points.x[:, : len(model.states)].astype(complex)
    columns = []
    for j, name in enumerate(model.names):
        q, V = p.astype(complex), points.V.astype(complex)
        if name == "V":
            V += 1j * STEP
        else:
            q[j] += 1j * STEP
        columns.append(np.asarray(model.rates(x, V, points.W, points.W_dot, q)).imag / STEP)
    return np.stack(columns, axis=-1)


def _difference(found: Array, expected: Array) -> float:
    """Return the largest difference over the largest size in its column, infinite where a number is not one."""
    if not (np.isfinite(found).all() and np.isfinite(expected).all()):
        return float("inf")
    scale = np.max(np.abs(np.atleast_2d(expected)), axis=0)
    return float(np.max(np.abs(found - expected) / np.where(scale > 0, scale, 1.0), initial=0.0))


def _to(size: float, before: str = " to", after: str = "") -> str:
    """Return how far something is off as words, none where it is not."""
    return f"{before} {size:.0e}{after}" if size else ""


def _expect(found: Dimension, wanted: Dimension, what: str) -> None:
    if found != wanted:
        raise SrfError(
            f"{what} is in {describe(found)}, expected {describe(wanted)}", "Look at the units under [parameters]."
        )
