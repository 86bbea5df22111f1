"""Law files: TOML in the format `srf-law/1` to law values, and the text that `srf law new` begins with.

The error for a file that breaks the format names the file, the key, what was found and what was expected.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import CHECK_PATH, ExpressionError, SrfError, did_you_mean, shown
from srfcli.core.files import parse_toml, read_text
from srfcli.core.settings import Parameter
from srfcli.core.toml import Node
from srfcli.core.units import find_unit
from srfcli.laws.values import AgeingLaw, AgeingModifier, Check, Effect, FrictionLaw, Interface, Law, Reader, State

if TYPE_CHECKING:
    import sympy

FORMAT = "srf-law/1"
LAW_KINDS = ("friction", "ageing", "modifier", "interface")
PLUGIN_KINDS = (*LAW_KINDS, "effect", "reader")
FORMULA = {"friction": "mu", "ageing": "rate", "modifier": "term", "interface": "kappa"}  # also the checked quantity
COMMON = ("mu0", "A", "B", "D0", "V0")  # friction parameters that an ageing law may name
AGEING_SYMBOLS = ("v", "phi", "mu", "mu_dot", "W", "W_dot", "F_dot_over_W")
RESERVED = ("V", "W0", "eps", "f", "K", "M", "angle")  # of the system, which would take a law's parameter for its own
# names that mean something in every law or system; a parameter cannot take them
VARIABLES = (*AGEING_SYMBOLS, *RESERVED, "kappa", "rate", "term", "u", "z")
LAW_CLASSES: dict[str, type[Law]] = {
    "friction": FrictionLaw,
    "ageing": AgeingLaw,
    "modifier": AgeingModifier,
    "interface": Interface,
}
LAW_NAME = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*", re.ASCII)

_COMMON_KEYS = ("format", "kind", "name", "about", "cites", "parameters", "checks")


def kind_of(law: Law | Reader) -> str:
    """Return 'friction', 'ageing', 'modifier', 'interface', 'effect' or, of what reads files, 'reader'."""
    if isinstance(law, Reader):
        return "reader"
    if isinstance(law, Effect):
        return "effect"
    return next(kind for kind, cls in LAW_CLASSES.items() if isinstance(law, cls))


def formula_of(law: Law) -> sympy.Expr | None:
    """Return the one formula of a law: mu, rate, term or kappa (None for a rigid interface)."""
    return getattr(law, FORMULA[kind_of(law)])


def known_symbols(kind: str, parameters: Iterable[str], states: Iterable[State] = (State(),)) -> tuple[str, ...]:
    """Return the names that the formula of a law of `kind` may hold."""
    match kind:
        case "friction":
            return ("v", *(state.name for state in states), *parameters)
        case "interface":
            return ("W", *parameters)
    return (*AGEING_SYMBOLS, *COMMON, *parameters)


def open_law(path: Path) -> Node:
    """Return the table in a TOML file; raises `SrfError` with the place where it is not TOML."""
    try:
        text = read_text(path, what="a law").replace("\r\n", "\n")
        return Node(path, parse_toml(text, path), (), text)
    except SrfError as error:
        raise SrfError(error.message, error.hint or 'Text goes in quotes: mu = "mu0 + A*log(v/V0)".') from None
    except OSError as error:
        raise SrfError(f"{path}: cannot be read: {error.strerror}", CHECK_PATH) from None


def read_header(path: Path) -> tuple[str, str, str]:
    """Return kind, name and about of a law file without reading its formula."""
    node = open_law(path)
    return read_kind(node), read_name(node), node.read("about", Node.text, "")


def valid_name(name: object) -> bool:
    """True for a kebab-case law name of at most 64 letters."""
    return isinstance(name, str) and len(name) <= 64 and LAW_NAME.fullmatch(name) is not None


def check_parameters(parameters: Iterable[Parameter], taken: Iterable[str]) -> None:
    """Raise `SrfError` for a name, which must be none of `taken`, a default, bound or unit that no parameter may have."""
    from srfcli.laws.expression import check_identifier

    names = {*taken}
    for p in parameters:
        check_identifier(p.name, "parameter", taken=names)
        names.add(p.name)
        if not math.isfinite(p.default):
            raise SrfError(f"parameter '{p.name}': the default is {p.default}", "Give a finite number.")
        if not p.lower <= p.default <= p.upper:
            raise SrfError(
                f"parameter '{p.name}': the default {p.default:g} is outside its bounds [{p.lower:g}, {p.upper:g}]",
                "Change the default or the bounds.",
            )
        try:
            find_unit(p.unit)
        except SrfError as error:
            raise SrfError(f"parameter '{p.name}': {error.message}", error.hint) from None


def check_law(kind: str, parameters: Sequence[Parameter], states: Sequence[State]) -> None:
    """Raise `SrfError` for parameters that no law of `kind` may have.

    And unless each state has its own name and names parameters for its length and weight.
    """
    from srfcli.laws.expression import check_identifier

    # those of the friction law that an ageing law may name come from there, and one default is enough
    common = COMMON if kind in ("ageing", "modifier") else ()
    check_parameters(parameters, (*VARIABLES, *(state.name for state in states), *common))
    names = {p.name for p in parameters}
    seen: set[str] = set()
    for state in states:
        check_identifier(state.name, "state", taken=seen | (set(VARIABLES) - {"phi"}))
        seen.add(state.name)
        for role, value in (("length", state.length), ("weight", state.weight)):
            if value not in names:
                raise SrfError(
                    f"state '{state.name}': {role} '{value}' is not a parameter of this law", did_you_mean(value, names)
                )


def check_uses(law: Law) -> None:
    """Raise `SrfError` for a friction law without v or without one of its states."""
    if not isinstance(law, FrictionLaw):
        return
    used = {s.name for s in law.mu.free_symbols}
    for name in ("v", *(state.name for state in law.states)):
        if name not in used:
            raise SrfError(f"mu does not depend on '{name}'", "A friction law depends on v and on each of its states.")


# From the table of a file to a law; a fault is told with its place.


def law_of(node: Node) -> Law:
    """Return the law that a table holds."""
    kind = read_kind(node)
    key = FORMULA[kind]
    node.keys((*_COMMON_KEYS, key, *(("states",) if kind == "friction" else ())))
    name, about = read_name(node), node.read("about", Node.text, "")
    cites, parameters = node.read("cites", read_texts, ()), read_parameters(node)
    states = node.read("states", _states, (State(),)) if kind == "friction" else ()
    with placed(node):
        check_law(kind, parameters, states)
    known = known_symbols(kind, (p.name for p in parameters), states)
    checks = read_checks(node, (key,), known)
    own: dict[str, Any] = {"states": states} if states else {}
    if key in node.value or kind != "interface":  # one without a formula is rigid
        misplaced = key in node.value.get("parameters", {})
        hint = "It stands below [parameters]; move it above the first [table]." if misplaced else ""
        own[key] = read_formula(node.require(key, hint or f'Give the formula as text: {key} = "...".'), known)
    source = str(node.file)
    law = LAW_CLASSES[kind](name=name, parameters=parameters, about=about, cites=cites, checks=checks, source=source, **own)
    with placed(node):
        check_uses(law)
    return law


@contextlib.contextmanager
def placed(node: Node) -> Iterator[None]:
    """Write the place of a node in front of an error that is raised inside; the caret of a formula stays."""
    try:
        yield
    except ExpressionError as error:
        raise ExpressionError(f"{node.where}: {error.message}", error.hint, text=error.text, column=error.column) from None
    except SrfError as error:
        node.fail(error.message, error.hint)


def read_kind(node: Node) -> str:
    """Return the kind of a law, which its table says after the format."""
    known = (*LAW_KINDS, "effect")
    found, kind = node.at("format"), node.at("kind")
    if found.value != FORMAT:
        said = "nothing" if found.value is None else shown(found.value)
        found.fail(f"found {said}, expected {FORMAT!r}", f'Start the file with format = "{FORMAT}".')
    if kind.value not in known:
        said = "nothing" if kind.value is None else shown(kind.value)
        kind.fail(f"found {said}, expected one of {', '.join(known)}", did_you_mean(str(kind.value), known))
    return kind.value


def read_name(node: Node) -> str:
    """Return the name of a law, that of its file where the table has none."""
    name = node.read("name", Node.text, node.file.stem)
    if not valid_name(name):
        replace(node.at("name"), value=name).expected("small letters, digits and single dashes", "Like my-law.")
    return name


def read_number(node: Node) -> float:
    """Return a number, which may be infinite."""
    if isinstance(node.value, bool) or not isinstance(node.value, int | float):
        node.expected("a number")
    try:
        return float(node.value)
    except OverflowError:
        node.fail(f"found {shown(node.value)}, which is too large", "Write it as in 1e300, or inf.")


def read_texts(node: Node) -> tuple[str, ...]:
    """Return a list of texts."""
    if not isinstance(node.value, list) or not all(isinstance(text, str) for text in node.value):
        node.expected("a list of texts")
    return tuple(node.value)


def read_formula(node: Node, known: Iterable[str]) -> sympy.Expr:
    """Return the formula in the text at a node, in symbols of the names `known`."""
    from srfcli.laws.expression import parse_expression

    text = node.text()
    with placed(node):
        return parse_expression(text, known)


def read_parameters(node: Node, keys: Iterable[str] = ()) -> tuple[Parameter, ...]:
    """Return the parameters in a law's table, which may have these keys besides the usual ones."""
    if (table := node.get("parameters")) is None:
        return ()
    for name, entry in table.table("[parameters].").value.items():
        if not isinstance(entry, dict) and name in (*_COMMON_KEYS, *FORMULA.values(), "states"):
            table.child(name).fail("this key stands below [parameters]", "Move it above the first [table].")
    return read_numbers(table, "default", 'default = 1.0, unit = "1"', ("unit", "lower", "upper", "bounds", "about", *keys))


def read_numbers(table: Node, key: str, example: str, others: Iterable[str]) -> tuple[Parameter, ...]:
    """Return numbers with units as parameters: each has a table with its number under `key` and, if need be, with `others`."""
    found = []
    for name in table.value:
        entry = table.child(name).table(f"{name} = {{ {example} }}.")
        entry.keys((key, *others))
        number = entry.require(key, f"Write {name} = {{ {key} = 1.0 }}.")
        unit, about = entry.read("unit", Node.text, "1"), entry.read("about", Node.text, "")
        lower, upper = _bounds(entry)
        found.append(Parameter(name, read_number(number), unit, lower, upper, about))
    return tuple(found)


def _bounds(entry: Node) -> tuple[float, float]:
    if (pair := entry.get("bounds")) is None:
        return entry.read("lower", read_number, -math.inf), entry.read("upper", read_number, math.inf)
    if entry.value.keys() & {"lower", "upper"}:
        pair.fail("given together with lower or upper", "Keep one of the two forms.")
    if not isinstance(pair.value, list) or len(pair.value) != 2:
        pair.expected("[lower, upper]", "inf and -inf are numbers.")
    lower, upper = (read_number(replace(pair, value=bound)) for bound in pair.value)
    return lower, upper


def _states(node: Node) -> tuple[State, ...]:
    entries = node.value
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        node.fail(f'found {shown(entries)}, expected [{{ name = "phi", length = "D0", weight = "B" }}]')
    for number, entry in enumerate(entries):
        node.child(number).keys(("name", "length", "weight"))
        if not all(isinstance(value, str) for value in entry.values()):
            node.child(number).expected("texts for name, length and weight")
    return tuple(State(**entry) for entry in entries)


def read_checks(node: Node, quantities: Sequence[str], names: Sequence[str]) -> tuple[Check, ...]:
    """Return the worked values of a law; a formula that is not named is the first of `quantities`."""
    if (entries := node.get("checks")) is None:
        return ()
    if not isinstance(entries.value, list) or not all(isinstance(e, dict) for e in entries.value):
        entries.expected("tables", "Write [[checks]] with two brackets.")
    if entries.value and not quantities:
        entries.fail("there is no formula to check", "Leave them out.")
    found = []
    for entry in map(entries.child, range(len(entries.value))):
        entry.keys(("quantity", "at", "value", "rtol"))
        at, value = entry.require("at"), entry.require("value")
        quantity = entry.value.get("quantity", quantities[0])
        if quantity not in quantities:
            said, wanted = shown(quantity), " or ".join(repr(q) for q in quantities)
            entry.child("quantity").fail(f"found {said}, expected {wanted}", did_you_mean(said, quantities))
        if not isinstance(at.value, dict):
            at.fail(f"found {shown(at.value)}, expected {{ v = 1.0, ... }}")
        at.keys(names)
        given = tuple((name, read_number(at.child(name))) for name in at.value)
        found.append(Check(quantity, given, read_number(value), entry.read("rtol", read_number, Check.rtol)))
    return tuple(found)


def template(kind: str, name: str, *, python: bool) -> str:
    """Return the text of a new law file: a whole, commented law that passes `srf law check` as it stands."""
    function = "law_" + name.replace("-", "_")  # a law's name may begin with a digit or be a keyword
    place = files("srfcli") / "laws" / "templates" / f"{kind}.{'py.txt' if python else 'toml'}"
    return Template(place.read_text(encoding="utf-8")).substitute(name=name, function=function)
