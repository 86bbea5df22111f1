"""Effect files: physics that a baseline may lack, as TOML in the format `srf-law/1` with kind = "effect"."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.settings import Parameter
from srfcli.core.units import describe, dimension, dimension_of, find_unit
from srfcli.laws.expression import check_identifier, parse_expression, symbol
from srfcli.laws.law_file import AGEING_SYMBOLS, COMMON, LawReader, check_parameters
from srfcli.laws.values import Effect, ExtraState

if TYPE_CHECKING:
    import sympy

SLOTS = ("mu", "rate", "kappa", "W", "force", "V", "K", "gauge")
PLACES = ("slip", "stage", "time", "theta", "envelope")  # unknowns and abbreviations that formulas of effects may hold
RUN_NAMES = ("W0", "eps", "f", "K", "V", "modulated")
KEYS = (
    "format", "kind", "name", "about", "cites", "parameters", "constants", *SLOTS, "states", "settings", "frees", "needs",
    "lacks", "observed", "constitutive", "answers", "on_request", "wrong", "remedy", "checks",
)  # fmt: skip
MOST_VALUES = 1000  # values of an inner parameter
SCANNED_VALUES = 8  # values at which an inner parameter is tried where its author says nothing
_TAKEN = {*PLACES, *RUN_NAMES, *COMMON, "mu", "W", "v", "phi", "u", "kappa", "force", "gauge", "start", "begin"}
_OWN = ("neutral", "scan", "within", "typical", "fixed")  # keys of a parameter that an effect has and a law has not
_PARAMETER = ("default", "unit", "lower", "upper", "bounds", "about", *_OWN)
SCALES = {  # of a recording, which bounds and sizes may be stated in, with their units
    "segment": "um", "track": "um", "duration": "s", "interval": "s", "V_low": "um/s", "V_high": "um/s", "load": "N", "D0": "um",
    "V0": "um/s",
}  # fmt: skip
_CONSTANT = ("value", "unit", "about")
_STATE = ("name", "rate", "steady", "logarithmic")


def known_names(own: Iterable[str], states: Iterable[str] = (), needs: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the names that the formulas of an effect may hold, but for that of the slot itself."""
    return tuple(dict.fromkeys([*own, *states, *needs, *PLACES, *RUN_NAMES, *COMMON, *AGEING_SYMBOLS, "u", "gauge"]))


def check_names(parameters: Sequence[Parameter], constants: Sequence[Parameter] = ()) -> None:
    """Raise `SrfError` for a name, default, bound or unit that no parameter or constant of an effect may have."""
    names: set[str] = set()
    for p in (*parameters, *constants):
        check_identifier(p.name, "parameter", taken=_TAKEN | names)
        names.add(p.name)
    for i, p in enumerate((*parameters, *constants)):
        plain = f"own{i}"  # a drift's rate is called rate, a law's is not
        try:
            check_parameters([replace(p, name=plain)], kind="effect")
        except SrfError as error:
            raise SrfError(error.message.replace(plain, p.name), error.hint) from None


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
        if not value == value or abs(value) == float("inf"):
            raise SrfError(f"the neutral value of '{name}' is {value}", "Give a finite number.")
    states = [state.name for state in effect.states]
    if effect.observed and effect.observed not in states:
        raise SrfError(f"observed = '{effect.observed}' is no state of the effect", did_you_mean(effect.observed, states))
    return _with_numbers(effect)


def _with_numbers(effect: Effect) -> Effect:
    import sympy

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
    import sympy

    long = [r for r in formula.atoms(sympy.Rational) if r.q > 10**6]
    return str(formula.xreplace({r: sympy.Float(r) for r in long}))


class EffectReader(LawReader):
    """One TOML table on its way to an effect."""

    def effect(self) -> Effect:
        """Return the effect; SrfError with file and key for anything that is not one."""
        self.keys("", self.table, KEYS)
        self.kind()
        parameters, constants = self.parameters(), self.constants()
        with self.placed():
            check_names(parameters, constants)
        known = set(known_names((p.name for p in (*parameters, *constants)), self.state_names(), self.listed("needs")))
        neutral, scans = self.sizes()
        formulas = [*(slot for slot in SLOTS if slot in self.table), *self.state_names()]
        given = sorted((known | {*SLOTS}) - {c.name for c in constants})
        effect = Effect(
            name=self.name(), parameters=parameters, about=self.text("about"), cites=self.listed("cites"), source=str(self.path),
            changes=tuple((slot, self.slot(slot, known | {slot})) for slot in SLOTS if slot in self.table),
            states=self.extra(known), settings=self.settings(), frees=self.listed("frees"), neutral=neutral, scans=scans,
            needs=self.listed("needs"), lacks=self.listed("lacks"), observed=self.text("observed"),
            constitutive=self.flag("constitutive", True), answers=self.text("answers"), constants=constants,
            scaled=tuple(self.scaled(parameters)), on_request=self.flag("on_request", False),
            fixed=tuple(n for n, e in self.table.get("parameters", {}).items() if e.get("fixed")),
            wrong=self.text("wrong"), remedy=self.text("remedy"), checks=self.checks(formulas, given),
        )  # fmt: skip
        with self.placed():
            return finished(effect)

    def sizes(self) -> tuple[tuple[tuple[str, float], ...], tuple[tuple[str, int], ...]]:
        """Return the neutral values of the sizes, and at how many values each other parameter is tried."""
        neutral: list[tuple[str, float]] = []
        scans: list[tuple[str, int]] = []
        for name, entry in self.table.get("parameters", {}).items():
            where = f"parameters.{name}"
            if "neutral" in entry:
                if "scan" in entry:
                    self.fail(f"{where}.scan", "given together with neutral", "A size is fitted; only others are tried.")
                if entry.get("fixed"):
                    self.fail(f"{where}.fixed", "given together with neutral", "A size is fitted.")
                neutral.append((name, self.number(f"{where}.neutral", entry["neutral"])))
                continue
            if entry.get("fixed"):
                if "scan" in entry:
                    self.fail(f"{where}.scan", "given together with fixed", "What is never fitted is tried at no values.")
                continue
            count = self.number(f"{where}.scan", entry.get("scan", SCANNED_VALUES))
            if not (count.is_integer() and 1 <= count <= MOST_VALUES):
                self.fail(f"{where}.scan", f"found {count:g}, expected a whole number of values to try, up to {MOST_VALUES}")
            scans.append((name, int(count)))
        return tuple(neutral), tuple(scans)

    def scaled(self, parameters: Sequence[Parameter]) -> Iterator[tuple[str, str, sympy.Expr]]:
        """Yield (parameter, lower, upper or default, formula) of what is stated in the scales of a recording."""
        for p in parameters:
            entry = self.table["parameters"][p.name]
            within, where = entry.get("within"), f"parameters.{p.name}"
            if within is not None and (not isinstance(within, list) or len(within) != 2):
                self.fail(f"{where}.within", "expected two formulas", 'Write within = ["2.5*D0", "segment/2"].')
            stated = [("lower", "within", within[0]), ("upper", "within", within[1])] if within is not None else []
            stated += [("default", "typical", entry["typical"])] if "typical" in entry else []
            for which, key, text in stated:
                if not isinstance(text, str):
                    self.fail(f"{where}.{key}", f"found {text!r}, expected a formula in quotes")
                units = {name: dimension(unit) for name, unit in SCALES.items()}
                with self.placed(f"{where}.{key}"):
                    formula = parse_expression(text, SCALES)
                    found, wanted = dimension_of(formula, units), dimension(p.unit)
                if formula.free_symbols and found != wanted:
                    self.fail(f"{where}.{key}", f"'{text}' is in {describe(found)}, {p.name} in {p.unit}")
                yield p.name, which, formula

    def parameter(self, name: str, entry: object, table: str = "parameters", value: str = "default") -> Parameter:
        """Return one parameter, or one of the constants."""
        if table == "constants":
            node = self.at(f"{table}.{name}", entry).table(f'{name} = {{ value = 7.0, unit = "N" }}.')
            self.keys(f"{table}.{name}", node.value, _CONSTANT)
        elif isinstance(entry, dict):
            self.keys(f"parameters.{name}", entry, _PARAMETER)
            self.at(f"parameters.{name}.fixed", entry.get("fixed", False)).boolean()
            entry = {k: v for k, v in entry.items() if k not in _OWN}
        return super().parameter(name, entry, table, value)

    def constants(self) -> tuple[Parameter, ...]:
        """Return the numbers with units that the formulas name."""
        table = self.at("constants", self.table.get("constants", {})).table('[constants] and Wref = { value = 7.0, unit = "N" }.')
        return tuple(self.parameter(name, entry, "constants", "value") for name, entry in table.value.items())

    def slot(self, slot: str, known: Iterable[str]) -> sympy.Expr:
        """Return the formula of a slot."""
        text = self.text(slot)
        with self.placed(slot):
            return parse_expression(text, known)

    def state_tables(self) -> list[Mapping[str, Any]]:
        """Return the tables under `states`."""
        entries = self.table.get("states", [])
        if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
            self.fail("states", "expected a list of tables", 'Write states = [{ name = "phi2", rate = "...", steady = "..." }].')
        return entries

    def state_names(self) -> list[str]:
        """Return the names under `states`."""
        return [str(entry.get("name")) for entry in self.state_tables()]

    def extra(self, known: set[str]) -> tuple[ExtraState, ...]:
        """Return the unknowns that the effect brings."""
        found: list[ExtraState] = []
        for number, entry in enumerate(self.state_tables()):
            where = f"states[{number}]"
            self.keys(where, entry, _STATE)
            for key in ("name", "rate", "steady"):
                if not isinstance(entry.get(key), str):
                    self.fail(f"{where}.{key}", "missing, or not text in quotes")
            logarithmic = self.at(f"{where}.logarithmic", entry.get("logarithmic", False)).boolean()
            taken = (known | {state.name for state in found}) - {entry["name"]}
            try:
                check_identifier(entry["name"], "state", taken=taken | _TAKEN)
                rate, steady = (parse_expression(entry[key], known) for key in ("rate", "steady"))
            except SrfError as error:
                self.fail(where, error.message, error.hint)
            found.append(ExtraState(entry["name"], rate, steady, logarithmic))
        return tuple(found)

    def settings(self) -> tuple[tuple[str, str | bool], ...]:
        """Return the choices of the model that the effect replaces."""
        table = self.at("settings", self.table.get("settings", {})).table('settings = { interface = "elastic" }.').value
        self.keys("settings", table, ("interface", "inertia"))
        for key, kind in (("interface", str), ("inertia", bool)):
            if not isinstance(table.get(key, kind()), kind):
                self.fail(f"settings.{key}", f"found {table[key]!r}", 'Write interface = "elastic" or inertia = true.')
        return tuple(sorted(table.items()))

    def flag(self, key: str, default: bool) -> bool:
        """Return true or false."""
        return self.at(key, self.table.get(key, default)).boolean()
