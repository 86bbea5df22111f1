"""Law files: TOML in the format `srf-law/1` to law values, and the text that `srf law new` begins with.

The error for a file that breaks the format names the file, the key, what was found and what was expected.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any, NoReturn

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
_PARAMETER_KEYS = ("unit", "lower", "upper", "bounds", "about")
_CHECK_KEYS = ("quantity", "at", "value", "rtol")
_STATE_KEYS = ("name", "length", "weight")


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
    reader = LawReader(open_law(path))
    return reader.kind(), reader.name(), reader.text("about")


def valid_name(name: object) -> bool:
    """True for a kebab-case law name of at most 64 letters."""
    return isinstance(name, str) and len(name) <= 64 and LAW_NAME.fullmatch(name) is not None


def check_parameters(parameters: Iterable[Parameter], *, kind: str, states: Iterable[State] = ()) -> None:
    """Raise `SrfError` for a name, default, bound or unit that no law may have."""
    from srfcli.laws.expression import check_identifier

    names: set[str] = set()
    taken = {*VARIABLES, *(state.name for state in states)}
    if kind in ("ageing", "modifier"):
        taken |= set(COMMON)  # they come from the friction law, and one default is enough
    for p in parameters:
        check_identifier(p.name, "parameter", taken=taken | names)
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


def check_states(states: Iterable[State], parameters: Iterable[Parameter]) -> None:
    """Raise `SrfError` unless each state has its own name and names parameters for its length and weight."""
    from srfcli.laws.expression import check_identifier

    names = {p.name for p in parameters}
    seen: set[str] = set()
    for state in states:
        check_identifier(state.name, "state", taken=seen | (set(VARIABLES) - {"phi"}))
        seen.add(state.name)
        for role in ("length", "weight"):
            value = getattr(state, role)
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


class LawReader:
    """One TOML table on its way to a law."""

    def __init__(self, node: Node) -> None:
        self.node, self.path, self.table = node, node.file, node.value

    def at(self, key: str, value: object = None) -> Node:
        """Return the place of a key, as parameters.A.default or states[0], with a value."""
        place = tuple(int(number) if number else name for number, name in re.findall(r"\[(\d+)\]|([^.\[\]]+)", key))
        return replace(self.node, value=value, place=place)

    def fail(self, key: str, message: str, hint: str | None = None) -> NoReturn:
        self.at(key).fail(message, hint)

    @contextlib.contextmanager
    def placed(self, key: str = "") -> Iterator[None]:
        """Write the file, and the key, in front of an error that is raised inside."""
        try:
            yield
        except ExpressionError as error:
            told = f"{self.at(key).where}: {error.message}"
            raise ExpressionError(told, error.hint, text=error.text, column=error.column) from None
        except SrfError as error:
            self.fail(key, error.message, error.hint)

    def keys(self, where: str, table: Mapping[str, Any], known: Iterable[str]) -> None:
        self.at(where, table).keys(known)

    def text(self, key: str, default: str = "") -> str:
        return self.at(key, self.table.get(key, default)).text()

    def number(self, where: str, value: object) -> float:
        node = self.at(where, value)
        if isinstance(value, bool) or not isinstance(value, int | float):
            node.expected("a number")
        try:
            return float(value)
        except OverflowError:
            node.fail(f"found {shown(value)}, which is too large", "Write it as in 1e300, or inf.")

    def kind(self) -> str:
        found = self.table.get("format")
        if found != FORMAT:
            said = "nothing" if found is None else shown(found)
            self.fail("format", f"found {said}, expected {FORMAT!r}", f'Start the file with format = "{FORMAT}".')
        kind = self.table.get("kind")
        known = (*LAW_KINDS, "effect")
        if kind not in known:
            said = "nothing" if kind is None else shown(kind)
            self.fail("kind", f"found {said}, expected one of {', '.join(known)}", did_you_mean(str(kind), known))
        return kind

    def name(self) -> str:
        name = self.text("name", self.path.stem)
        if not valid_name(name):
            self.at("name", name).expected("small letters, digits and single dashes", "Like my-law.")
        return name

    def law(self) -> Law:
        kind = self.kind()
        key = FORMULA[kind]
        self.keys("", self.table, (*_COMMON_KEYS, key, *(("states",) if kind == "friction" else ())))
        common: dict[str, Any] = {
            "name": self.name(),
            "about": self.text("about"),
            "cites": self.listed("cites"),
            "parameters": self.parameters(),
            "source": str(self.path),
        }
        if kind == "friction":
            common["states"] = self.states()
        states = common.get("states", ())
        with self.placed():
            check_parameters(common["parameters"], kind=kind, states=states)
            check_states(states, common["parameters"])
        names = known_symbols(kind, (p.name for p in common["parameters"]), states)
        common["checks"] = self.checks((key,), names)
        common[key] = self.formula(key, kind, names)
        law = LAW_CLASSES[kind](**common)
        with self.placed():
            check_uses(law)
        return law

    def formula(self, key: str, kind: str, names: tuple[str, ...]) -> sympy.Expr | None:
        from srfcli.laws.expression import parse_expression

        if key not in self.table:
            if kind == "interface":
                return None  # rigid
            hint = f'Give the formula as text: {key} = "...".'
            if key in self.table.get("parameters", {}):
                hint = "It stands below [parameters]; move it above the first [table]."
            self.fail(key, "missing", hint)
        text = self.text(key)
        with self.placed(key):
            return parse_expression(text, names)

    def listed(self, key: str) -> tuple[str, ...]:
        """Return a list of texts."""
        value = self.table.get(key, [])
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            self.at(key, value).expected("a list of texts")
        return tuple(value)

    def parameters(self) -> tuple[Parameter, ...]:
        table = self.table.get("parameters", {})
        if not isinstance(table, dict):
            self.at("parameters", table).expected("a table", "Write [parameters].")
        return tuple(self.parameter(name, entry) for name, entry in table.items())

    def parameter(self, name: str, entry: object, table: str = "parameters", value: str = "default") -> Parameter:
        where = f"{table}.{name}"
        if not isinstance(entry, dict):
            if name in (*_COMMON_KEYS, *FORMULA.values(), "states"):
                self.fail(where, "this key stands below [parameters]", "Move it above the first [table].")
            self.at(where, entry).expected("a table", f'Write {name} = {{ default = 1.0, unit = "1" }}.')
        self.keys(where, entry, (value, *_PARAMETER_KEYS))
        if value not in entry:
            self.fail(f"{where}.{value}", "missing", f"Write {name} = {{ {value} = 1.0 }}.")
        for key in ("unit", "about"):
            if not isinstance(entry.get(key, ""), str):
                self.at(f"{where}.{key}", entry[key]).expected("text in quotes")
        lower, upper = self.bounds(where, entry)
        default = self.number(f"{where}.{value}", entry[value])
        return Parameter(name, default, entry.get("unit", "1"), lower, upper, entry.get("about", ""))

    def bounds(self, where: str, entry: Mapping[str, Any]) -> tuple[float, float]:
        if "bounds" not in entry:
            lower = self.number(f"{where}.lower", entry.get("lower", -math.inf))
            return lower, self.number(f"{where}.upper", entry.get("upper", math.inf))
        bounds = entry["bounds"]
        if "lower" in entry or "upper" in entry:
            self.fail(f"{where}.bounds", "given together with lower or upper", "Keep one of the two forms.")
        if not isinstance(bounds, list) or len(bounds) != 2:
            self.at(f"{where}.bounds", bounds).expected("[lower, upper]", "inf and -inf are numbers.")
        return self.number(f"{where}.bounds", bounds[0]), self.number(f"{where}.bounds", bounds[1])

    def states(self) -> tuple[State, ...]:
        entries = self.table.get("states", [{}])
        if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
            self.fail("states", f'found {shown(entries)}, expected [{{ name = "phi", length = "D0", weight = "B" }}]')
        states = []
        for number, entry in enumerate(entries):
            where = f"states[{number}]"
            self.keys(where, entry, _STATE_KEYS)
            if not all(isinstance(value, str) for value in entry.values()):
                self.at(where, entry).expected("texts for name, length and weight")
            states.append(State(**entry))
        return tuple(states)

    def checks(self, quantities: Sequence[str], names: Iterable[str]) -> tuple[Check, ...]:
        """Return the worked values; a formula that is not named is the first of `quantities`."""
        entries = self.table.get("checks", [])
        if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
            self.at("checks", entries).expected("tables", "Write [[checks]] with two brackets.")
        if entries and not quantities:
            self.fail("checks", "there is no formula to check", "Leave them out.")
        return tuple(self.check(f"checks[{i}]", entry, quantities, names) for i, entry in enumerate(entries))

    def check(self, where: str, entry: Mapping[str, Any], quantities: Sequence[str], names: Iterable[str]) -> Check:
        """Return one worked value."""
        self.keys(where, entry, _CHECK_KEYS)
        for key in ("at", "value"):
            if key not in entry:
                self.fail(f"{where}.{key}", "missing")
        quantity = entry.get("quantity", quantities[0])
        if quantity not in quantities:
            found, wanted = shown(quantity), " or ".join(repr(q) for q in quantities)
            self.fail(f"{where}.quantity", f"found {found}, expected {wanted}", did_you_mean(found, quantities))
        if not isinstance(entry["at"], dict):
            self.fail(f"{where}.at", f"found {shown(entry['at'])}, expected {{ v = 1.0, ... }}")
        self.keys(f"{where}.at", entry["at"], tuple(names))
        at = tuple((name, self.number(f"{where}.at.{name}", value)) for name, value in entry["at"].items())
        value = self.number(f"{where}.value", entry["value"])
        rtol = self.number(f"{where}.rtol", entry.get("rtol", Check.rtol))
        return Check(quantity, at, value, rtol)


def template(kind: str, name: str, *, python: bool) -> str:
    """Return the text of a new law file: a whole, commented law that passes `srf law check` as it stands."""
    function = "law_" + name.replace("-", "_")  # a law's name may begin with a digit or be a keyword
    place = files("srfcli") / "laws" / "templates" / f"{kind}.{'py.txt' if python else 'toml'}"
    return Template(place.read_text(encoding="utf-8")).substitute(name=name, function=function)
