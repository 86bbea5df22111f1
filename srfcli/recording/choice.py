"""The model of an experiment and its parameters, judged by the laws themselves."""

from __future__ import annotations

import math
from pathlib import Path

from srfcli.errors import SrfError, did_you_mean
from srfcli.laws import Effect, Parameter
from srfcli.recording.description import Apparatus
from srfcli.recording.node import Node
from srfcli.recording.values import FitParameter, ModelChoice, Notice
from srfcli.registry import Registry
from srfcli.units import to_base

_ENTRY = ("value", "lower", "upper", "fixed")
_IMPOSED = {
    "V": "The drive of each run says it.",
    "W0": "The load of each run says it.",
    "eps": "The load of each run says it.",
    "f": "The load of each run says it.",
    "angle": "Experiments have the load imposed vertically.",
}


def read_choice(node: Node, apparatus: Apparatus, registry: Registry) -> tuple[ModelChoice, tuple[Parameter, ...]]:
    """Return the chosen model and all parameters that its laws and the apparatus have, in declared units."""
    node.keys(("law", "ageing", "interface", "inertia", "effects"))
    law = node.require("law", 'Name a friction law: law = "srf-vsat"; `srf laws` lists them.')
    ageing = node.require("ageing", 'Name an ageing law: ageing = "dieterich"; `srf laws` lists them.')
    interface, inertia = node.get("interface"), node.get("inertia")
    names = [_place(law.text(), node), "+".join(_place(word, node) for word in ageing.text().split("+"))]
    surface = _place(interface.text(), node) if interface else "elastic"
    parameters: list[Parameter] = []
    try:
        parameters += registry.get("friction", names[0]).parameters
    except SrfError as error:
        law.fail(error.message, error.hint)
    try:
        base, modifiers = registry.ageing(names[1])
        parameters += [p for each in (base, *modifiers) for p in each.parameters]
    except SrfError as error:
        ageing.fail(error.message, error.hint)
    try:
        parameters += registry.get("interface", surface).parameters
    except SrfError as error:
        (interface or node).fail(error.message, error.hint)
    moving = apparatus.mass is not None
    if inertia and inertia.boolean() and not moving:
        inertia.fail("inertia without a mass", 'Give [apparatus] mass = "2.37 kg", or inertia = false.')
    heavy = inertia.boolean() if inertia else moving
    parameters.append(Parameter("K", apparatus.stiffness, apparatus.unit, 0.0, math.inf, "stiffness"))
    if heavy and apparatus.mass is not None:
        parameters.append(Parameter("M", apparatus.mass * 1e6, "kg", 0.0, math.inf, "mass"))
    effects = node.get("effects")
    added, own = read_effects(effects, registry) if effects else ((), ())
    return ModelChoice(names[0], names[1], surface, heavy, added), (*parameters, *own)


def read_effects(node: Node, registry: Registry) -> tuple[tuple[str, ...], tuple[Parameter, ...]]:
    """Return the effects that a model has besides its laws, as `open_model` names them, and their parameters."""
    from srfcli.system import apart  # only for a description that has effects

    if not isinstance(node.value, list):
        node.expected(
            "a list of effects", 'Write effects = ["load-transmission"]; `srf laws --kind effect` lists them.'
        )
    names, found = [], []
    for index in range(len(node.value)):
        entry = node.child(index)
        name = _place(entry.text(), node)
        if name in names:
            entry.fail(f"'{name}' is named twice", "Once is enough.")
        try:
            effect = registry.get("effect", name)
        except SrfError as error:
            entry.fail(error.message, error.hint)
        assert isinstance(effect, Effect)
        if effect.settings or effect.frees:
            instead = [f"{key} = {str(value).lower()} in [model]" for key, value in effect.settings]
            instead += [
                {"K": "another stiffness in [apparatus]", "M": "a mass in [apparatus]"}.get(n, n) for n in effect.frees
            ]
            entry.fail(
                f"'{effect.name}' only replaces what the description says itself", f"Write {', '.join(instead)}."
            )
        names.append(name)
        found.append(effect)
    return tuple(names), tuple(p for effect in apart(found) for p in effect.parameters)


def _place(name: str, node: Node) -> str:
    """Return a law's name; that of a file is relative to the description."""
    word = name.strip()
    if not word.endswith((".toml", ".py")) or Path(word).is_absolute():
        return word
    return str(node.file.parent / word)


def read_parameters(
    node: Node | None, known: tuple[Parameter, ...], choice: ModelChoice
) -> tuple[tuple[FitParameter, ...], tuple[Notice, ...]]:
    """Return the listed parameters in um, s, N, and what is odd about them."""
    if node is None:
        return (), ()
    declared = {p.name: p for p in known}
    found, notices = [], []
    for name in node.value:
        entry = node.child(name)
        if name not in declared:
            _unknown(entry, name, declared, choice)
        parameter = _parameter(entry, declared[name])
        own = to_base(declared[name].default, declared[name].unit)
        if name in ("K", "M") and not math.isclose(parameter.value, own, rel_tol=1e-9):
            what = f"{name} starts from another value than [apparatus] gives; a simulation uses the apparatus"
            notices.append(Notice("start-value", entry.where, what))
        found.append(parameter)
    return tuple(found), tuple(notices)


def _unknown(entry: Node, name: str, declared: dict[str, Parameter], choice: ModelChoice) -> None:
    laws = f"{choice.law}, {choice.ageing}, {choice.interface}"
    if name == "M":
        entry.fail("there is no mass to fit", "Give [apparatus] a mass, and inertia = true.")
    entry.fail(f"unknown parameter '{name}' of {laws}", _IMPOSED.get(name) or did_you_mean(name, declared))


def _parameter(entry: Node, parameter: Parameter) -> FitParameter:
    entry.table(f"{parameter.name} = {{ value = {parameter.default:g}, lower = ..., upper = ... }}.").keys(_ENTRY)
    fixed = entry.get("fixed")
    held = fixed.boolean() if fixed else False
    numbers = {
        key: entry.child(key).quantity(parameter.unit) if key in entry.value else default
        for key, default in (("value", parameter.default), ("lower", parameter.lower), ("upper", parameter.upper))
    }
    value, lower, upper = numbers["value"], numbers["lower"], numbers["upper"]
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    for key in ("lower", "upper", "value"):
        if key in entry.value and not parameter.lower <= numbers[key] <= parameter.upper:
            entry.child(key).fail(
                f"{numbers[key]:g}{unit} is outside the bounds of the law's own parameter {parameter.name}",
                f"Choose it from {parameter.lower:g} to {parameter.upper:g}{unit}.",
            )
    if not lower < upper:
        key = "lower" if "lower" in entry.value else "upper"
        entry.child(key).fail(
            f"lower = {lower:g}{unit} is not below upper = {upper:g}{unit}", "Give two bounds that rise."
        )
    if not lower <= value <= upper:
        (entry.child("value") if "value" in entry.value else entry).fail(
            f"value = {value:g}{unit} is outside its bounds [{lower:g}, {upper:g}]{unit}", "Change it or the bounds."
        )
    factor = to_base(1.0, parameter.unit)
    return FitParameter(parameter.name, value * factor, lower * factor, upper * factor, held, parameter.unit)
