"""Effect files: physics that a baseline may lack, as TOML in the format `srf-law/1` with kind = "effect"."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import sympy

from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.settings import Parameter
from srfcli.core.toml import Node
from srfcli.core.units import describe, dimension, dimension_of, find_unit
from srfcli.laws.expression import check_identifier, parse_expression, symbol
from srfcli.laws.law_file import (
    AGEING_SYMBOLS,
    COMMON,
    check_parameters,
    placed,
    read_checks,
    read_formula,
    read_kind,
    read_name,
    read_number,
    read_numbers,
    read_parameters,
    read_texts,
)
from srfcli.laws.values import Effect, ExtraState

SLOTS = ("mu", "rate", "kappa", "W", "force", "V", "K", "gauge")
PLACES = ("slip", "stage", "time", "theta", "envelope")  # unknowns and abbreviations that formulas of effects may hold
RUN_NAMES = ("W0", "eps", "f", "K", "V", "modulated")
KEYS = (
    "format", "kind", "name", "about", "cites", "parameters", "constants", *SLOTS, "states", "settings", "frees", "needs",
    "lacks", "observed", "constitutive", "answers", "on_request", "wrong", "remedy", "checks",
)  # fmt: skip
MOST_VALUES = 1000  # values of an inner parameter
SCANNED_VALUES = 8  # values at which an inner parameter is tried where its author says nothing
TAKEN = {*PLACES, *RUN_NAMES, *COMMON, "mu", "W", "v", "phi", "u", "kappa", "force", "gauge", "start", "begin"}
_OWN = ("neutral", "scan", "within", "typical", "fixed")  # keys of a parameter that an effect has and a law has not
SCALES = {  # of a recording, which bounds and sizes may be stated in, with their units
    "segment": "um", "track": "um", "duration": "s", "interval": "s", "V_low": "um/s", "V_high": "um/s", "load": "N", "D0": "um",
    "V0": "um/s",
}  # fmt: skip


def known_names(own: Iterable[str], states: Iterable[str] = (), needs: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the names that the formulas of an effect may hold, but for that of the slot itself."""
    return tuple(dict.fromkeys([*own, *states, *needs, *PLACES, *RUN_NAMES, *COMMON, *AGEING_SYMBOLS, "u", "gauge"]))


def finished(effect: Effect) -> Effect:
    """Return the effect with the values of its constants in its formulas; SrfError for one that could not be nested.

    It must change something, and one of its parameters must vanish in the baseline unless it replaces a choice of the model.
    """
    if not (effect.changes or effect.states or effect.settings or effect.frees):
        raise SrfError(f"effect '{effect.name}' changes nothing", f"Give a formula for one of {', '.join(SLOTS)}.")
    if not (effect.neutral or effect.settings or effect.frees):
        raise SrfError(
            f"effect '{effect.name}': no parameter has a neutral value", "Write neutral = 0.0 for the one that is absent."
        )
    declared = {p.name: p for p in effect.parameters}
    for name, value in effect.neutral:
        if name not in declared:
            raise SrfError(f"neutral value of '{name}', which is no parameter", did_you_mean(name, declared))
        if not math.isfinite(value):
            raise SrfError(f"the neutral value of '{name}' is {value}", "Give a finite number.")
    states = [state.name for state in effect.states]
    if effect.observed and effect.observed not in states:
        raise SrfError(f"observed = '{effect.observed}' is no state of the effect", did_you_mean(effect.observed, states))
    return _with_numbers(effect)


def _with_numbers(effect: Effect) -> Effect:
    numbers = {symbol(c.name): sympy.Rational(repr(c.default * find_unit(c.unit).factor)) for c in effect.constants}
    return replace(
        effect,
        written=effect.changes,
        changes=tuple((slot, formula.xreplace(numbers)) for slot, formula in effect.changes),
        states=tuple(replace(s, rate=s.rate.xreplace(numbers), steady=s.steady.xreplace(numbers)) for s in effect.states),
    )


def summary(effect: Effect) -> str:
    """Return one line on what an effect changes."""
    parts = [f"{slot} = {formula_text(formula)}" for slot, formula in effect.written or effect.changes]
    parts += [f"{s.name}' = {formula_text(s.rate)}" for s in effect.states]
    parts += [f"{name} = {str(value).lower()}" for name, value in effect.settings]
    parts += [f"{name} is fitted" for name in effect.frees]
    return "; ".join(parts + ([f"the gauge shows {effect.observed}"] if effect.observed else []))


def formula_text(formula: sympy.Expr) -> str:
    """Return a formula as text, with long decimals as decimals."""
    long = [r for r in formula.atoms(sympy.Rational) if r.q > 10**6]
    return str(formula.xreplace({r: sympy.Float(r) for r in long}))


# From the table of a file to an effect.


def effect_of(node: Node) -> Effect:
    """Return the effect that a table holds."""
    node.keys(KEYS)
    read_kind(node)
    parameters, constants = read_parameters(node, _OWN), node.read("constants", _constants, ())
    entries = [node.child("parameters").child(p.name) for p in parameters]
    for entry in entries:
        entry.read("fixed", Node.boolean, False)
    with placed(node):
        check_parameters((*parameters, *constants), TAKEN)
    states = node.read("states", _state_tables, [])
    names = [str(state.value.get("name")) for state in states]
    needs = node.read("needs", read_texts, ())
    known = set(known_names((p.name for p in (*parameters, *constants)), names, needs))
    neutral, scans = _sizes(entries)
    changes = tuple((slot, read_formula(node.child(slot), known | {slot})) for slot in SLOTS if slot in node.value)
    given = sorted((known | {*SLOTS}) - {c.name for c in constants})
    told: dict[str, Any] = {key: node.read(key, Node.text, "") for key in ("about", "observed", "answers", "wrong", "remedy")}
    told |= {key: node.read(key, read_texts, ()) for key in ("cites", "frees", "lacks")}
    effect = Effect(
        name=read_name(node), parameters=parameters, source=str(node.file), changes=changes, states=_extra_states(states, known),
        settings=node.read("settings", _settings, ()), neutral=neutral, scans=scans, needs=needs,
        constitutive=node.read("constitutive", Node.boolean, True), constants=constants,
        scaled=tuple(found for p, entry in zip(parameters, entries, strict=True) for found in _scaled(p, entry)),
        on_request=node.read("on_request", Node.boolean, False),
        fixed=tuple(p.name for p, entry in zip(parameters, entries, strict=True) if entry.value.get("fixed")),
        checks=read_checks(node, [*(slot for slot, _ in changes), *names], given), **told,
    )  # fmt: skip
    with placed(node):
        return finished(effect)


def _constants(node: Node) -> tuple[Parameter, ...]:
    """Return the numbers with units that the formulas name."""
    example = 'value = 7.0, unit = "N"'
    return read_numbers(node.table(f"[constants] and Wref = {{ {example} }}."), "value", example, ("unit", "about"))


def _sizes(entries: Iterable[Node]) -> tuple[tuple[tuple[str, float], ...], tuple[tuple[str, int], ...]]:
    """Return the neutral values of the sizes, and at how many values each other parameter is tried."""
    neutral: list[tuple[str, float]] = []
    scans: list[tuple[str, int]] = []
    for entry in entries:
        name, size, scan = str(entry.place[-1]), entry.get("neutral"), entry.get("scan")
        fixed = entry.value.get("fixed", False)
        if scan and (size or fixed):
            why = "A size is fitted; only others are tried." if size else "What is never fitted is tried at no values."
            scan.fail(f"given together with {'neutral' if size else 'fixed'}", why)
        if size:
            if fixed:
                entry.child("fixed").fail("given together with neutral", "A size is fitted.")
            neutral.append((name, read_number(size)))
        elif not fixed:
            count = read_number(scan) if scan else float(SCANNED_VALUES)
            if not (count.is_integer() and 1 <= count <= MOST_VALUES):
                entry.at("scan").fail(f"found {count:g}, expected a whole number of values to try, up to {MOST_VALUES}")
            scans.append((name, int(count)))
    return tuple(neutral), tuple(scans)


def _scaled(p: Parameter, entry: Node) -> Iterator[tuple[str, str, sympy.Expr]]:
    """Yield (parameter, lower, upper or default, formula) of what is stated in the scales of a recording."""
    stated = []
    if within := entry.get("within"):
        if not isinstance(within.value, list) or len(within.value) != 2:
            within.fail("expected two formulas", 'Write within = ["2.5*D0", "segment/2"].')
        stated = [(which, replace(within, value=text)) for which, text in zip(("lower", "upper"), within.value, strict=True)]
    if typical := entry.get("typical"):
        stated.append(("default", typical))
    for which, node in stated:
        if not isinstance(node.value, str):
            node.fail(f"found {node.value!r}, expected a formula in quotes")
        with placed(node):
            formula = parse_expression(node.value, SCALES)
            found = dimension_of(formula, {name: dimension(unit) for name, unit in SCALES.items()})
        if formula.free_symbols and found != dimension(p.unit):
            node.fail(f"'{node.value}' is in {describe(found)}, {p.name} in {p.unit}")
        yield p.name, which, formula


def _state_tables(node: Node) -> list[Node]:
    if not isinstance(node.value, list) or not all(isinstance(e, dict) for e in node.value):
        node.fail("expected a list of tables", 'Write states = [{ name = "phi2", rate = "...", steady = "..." }].')
    return [node.child(number) for number in range(len(node.value))]


def _extra_states(entries: Iterable[Node], known: set[str]) -> tuple[ExtraState, ...]:
    """Return the unknowns that an effect brings."""
    found: list[ExtraState] = []
    for entry in entries:
        entry.keys(("name", "rate", "steady", "logarithmic"))
        for key in ("name", "rate", "steady"):
            if not isinstance(entry.value.get(key), str):
                entry.at(key).fail("missing, or not text in quotes")
        logarithmic = entry.read("logarithmic", Node.boolean, False)
        name = entry.value["name"]
        with entry.blamed():
            check_identifier(name, "state", taken=((known | {state.name for state in found}) - {name}) | TAKEN)
            rate, steady = (parse_expression(entry.value[key], known) for key in ("rate", "steady"))
        found.append(ExtraState(name, rate, steady, logarithmic))
    return tuple(found)


def _settings(node: Node) -> tuple[tuple[str, str | bool], ...]:
    """Return the choices of the model that an effect replaces."""
    table = node.table('settings = { interface = "elastic" }.').value
    node.keys(("interface", "inertia"))
    for key, kind in (("interface", str), ("inertia", bool)):
        if not isinstance(table.get(key, kind()), kind):
            node.child(key).fail(f"found {table[key]!r}", 'Write interface = "elastic" or inertia = true.')
    return tuple(sorted(table.items()))
