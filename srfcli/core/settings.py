"""Parameters, and where a value comes from: a flag, over an SRF_* variable, over srf.toml, over the law's default."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from srfcli.core.errors import CHECK_PATH, SrfError, did_you_mean, shown
from srfcli.core.files import parse_toml, read_text
from srfcli.core.units import parse_quantity, to_base


@dataclass(frozen=True)
class Parameter:
    """A number that a law or a system depends on, in the unit it is declared in; bounds are inclusive."""

    name: str
    default: float
    unit: str = "1"
    lower: float = -math.inf
    upper: float = math.inf
    about: str = ""


FILE_NAME = "srf.toml"
LEAST_NUMBER = 1e-30  # of a number that is not zero, in its own unit: powers and products of it are numbers, too


@dataclass(frozen=True)
class Setting:
    """A value and where it was set."""

    value: Any
    origin: str


@dataclass(frozen=True)
class Default:
    """The built-in value of a choice and what the choice is about; its type is the type that it takes."""

    value: str | bool | float
    about: str


DEFAULTS = {
    "law": Default("srf-vsat", "friction law"),
    "ageing": Default(
        "dieterich", "evolution law: dieterich (the ageing law), ruina (the slip law), ...; modifiers after a plus sign"
    ),
    "interface": Default("elastic", "shear stiffness of the interface, by name"),
    "loading": Default("vertical", "vertical: the load is imposed; inclined: it follows a spring at --angle"),
    "inertia": Default(True, "whether the slider's mass counts"),
    "tol": Default(1e-6, "relative tolerance of numerical results"),
}


@dataclass(frozen=True)
class TomlSettings:
    """What an srf.toml says: parameters in declared units or as text with a unit, and choices."""

    path: Path | None = None
    parameters: Mapping[str, str | float] = field(default_factory=dict)
    defaults: Mapping[str, Any] = field(default_factory=dict)

    @property
    def origin(self) -> str:
        """Return the name under which its values are listed."""
        return FILE_NAME if self.path is None else str(self.path)


@dataclass(frozen=True)
class Resolved:
    """Every parameter's value: `values` in um, s, N, rad; `declared` in its own unit; `origins` says who set it.

    `unused` is a sentence for each parameter in srf.toml that this system does not have.
    """

    parameters: tuple[Parameter, ...]
    values: dict[str, float]
    declared: dict[str, float]
    origins: dict[str, str]
    unused: tuple[str, ...] = ()

    def described(self) -> dict[str, dict[str, Any]]:
        """Return name -> {value, unit, origin}, in declared units, as results and sidecars carry it."""
        return {p.name: {"value": self.declared[p.name], "unit": p.unit, "origin": self.origins[p.name]} for p in self.parameters}


def find_toml(start: Path | None = None) -> Path | None:
    """Return the nearest srf.toml in `start` or above it, no higher than the repository's root or the home directory.

    Outside both only `start` itself counts: a file that a stranger left in /tmp is not a setting.
    """
    start = (start or Path.cwd()).resolve()
    home = Path(os.path.expanduser("~")).resolve()  # noqa: PTH111  Path.home() raises where there is none
    above = [start, *start.parents]
    stop = next((i for i, d in enumerate(above) if d == home or (d / ".git").exists()), 0)
    return next((d / FILE_NAME for d in above[: stop + 1] if (d / FILE_NAME).is_file()), None)


def load_toml(path: Path | None) -> TomlSettings:
    """Return the settings in the file at `path`; none for None. Raises SrfError for what is not a setting."""
    if path is None:
        return TomlSettings()
    try:
        data = parse_toml(read_text(path, what="settings"), path)
    except SrfError as error:
        raise SrfError(error.message, error.hint or 'A setting looks like K = "0.21 N/um" below [parameters].') from error
    except OSError as error:
        raise SrfError(f"{path} cannot be read: {error.strerror}", CHECK_PATH, exit_code=1) from error
    _refuse_unknown(data, {"parameters", "defaults"}, f"table in {path}")
    tables = {name: data.get(name, {}) for name in ("parameters", "defaults")}
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise SrfError(f"{path}: {name!r} is not a table", f"Write [{name}] on a line of its own.")
    _refuse_unknown(tables["defaults"], DEFAULTS, f"setting in [defaults] of {path}")
    for name in tables["defaults"].keys() & {"law", "ageing", "interface"}:
        tables["defaults"][name] = _from_here(tables["defaults"][name], path.parent)
    for name, value in tables["parameters"].items():
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise SrfError(f"{path}: {name} is not a number", f'Write {name} = 0.21 or, with its unit, {name} = "0.21 N/um".')
    return TomlSettings(path, tables["parameters"], tables["defaults"])


def _from_here(names: Any, folder: Path) -> Any:
    """Return names of laws, those of files as seen from the folder of the settings in which they stand."""
    if not isinstance(names, str) or folder.absolute() == Path.cwd():
        return names
    words = [word.strip() for word in names.split("+")]
    return "+".join(str(folder / word) if word.endswith((".toml", ".py")) else word for word in words)


def _refuse_unknown(given: Mapping[str, Any], known: Mapping[str, Any] | set[str], what: str) -> None:
    for name in given:
        if name not in known:
            raise SrfError(f"unknown {what}: {name!r}", did_you_mean(name, known))


def choose(key: str, flag: Any, *, toml: TomlSettings | None = None) -> Setting:
    """Return the setting `key` of DEFAULTS: `flag` unless it is None, then SRF_KEY, then srf.toml, then the default."""
    variable = f"SRF_{key.upper()}"
    if flag is not None:
        return Setting(flag, "flag")
    if text := os.environ.get(variable):
        return Setting(_typed(key, text, variable), f"environment {variable}")
    if toml is not None and key in toml.defaults:
        return Setting(_typed(key, toml.defaults[key], toml.origin), toml.origin)
    return Setting(DEFAULTS[key].value, "default")


def _typed(key: str, value: Any, where: str) -> Any:
    """Return a value, as text or as TOML has it, in the type of the setting's default."""
    default = DEFAULTS[key].value
    if isinstance(default, bool):
        yes, no = ("1", "true", "yes", "on"), ("0", "false", "no", "off")
        if str(value).lower() not in (*yes, *no):
            raise SrfError(f"{where}: {key} = {value!r} is neither true nor false", f"Known: {', '.join((*yes, *no))}")
        return str(value).lower() in yes
    if isinstance(default, float):
        return parse_quantity(value if isinstance(value, str) else shown(value), "1", name=f"{where}: {key}")
    if not isinstance(value, str):
        raise SrfError(f"{where}: {key} = {value!r} is not text", f'Write {key} = "{default}".')
    return value


def resolve(
    parameters: Sequence[Parameter],
    flags: Mapping[str, str | float],
    *,
    env: Mapping[str, str] | None = None,
    toml: TomlSettings | None = None,
    where: str = "this system",
) -> Resolved:
    """Return every parameter's value and origin; `where` is the law or system that an unknown name is missing from.

    Text is parsed with its unit, a number is in the declared unit. A name that a flag or SRF_SET sets must exist; other
    variables and srf.toml may serve several laws, so what they set in vain is only listed as `unused`.
    """
    env = os.environ if env is None else env
    toml = toml or TomlSettings()
    known = {p.name: p for p in parameters}
    layers: dict[str, list[Setting]] = {name: [] for name in known}
    stated = filter(str.strip, env.get("SRF_SET", "").replace(";", ",").split(","))
    assigned = dict(parse_assignment(part, where="SRF_SET") for part in stated)
    listed: list[tuple[str, Mapping[str, Any]]] = [("flag", flags), ("environment SRF_SET", assigned)]
    for origin, given in listed:
        for name, value in given.items():
            require_parameter(name, parameters, where=where)
            layers[name].append(Setting(value, origin))
    unused = []
    for variable, value in sorted(env.items()):
        if (owner := _owner(variable, known)) is not None and value != "":
            layers[owner].append(Setting(value, f"environment {variable}"))
    for name, toml_value in toml.parameters.items():
        if name in known:
            layers[name].append(Setting(toml_value, toml.origin))
        else:
            unused.append(f"{toml.origin}: {name} is not a parameter of {where}. {did_you_mean(name, known)}")
    declared, origins = {}, {}
    for name, parameter in known.items():
        chosen = (layers[name] or [Setting(parameter.default, "law default")])[0]
        declared[name], origins[name] = check_value(parameter, chosen.value, origin=chosen.origin), chosen.origin
    values = {name: to_base(declared[name], p.unit) for name, p in known.items()}
    return Resolved(tuple(parameters), values, declared, origins, tuple(unused))


def require_parameter(name: str, parameters: Sequence[Parameter], *, where: str = "this system") -> Parameter:
    """Return the parameter called `name`; raises SrfError with the nearest names if there is none."""
    for parameter in parameters:
        if parameter.name == name:
            return parameter
    hint = {"angle": "Only an inclined spring has an angle: `loading` inclined.", "M": "The mass counts only with `inertia`."}
    raise SrfError(f"unknown parameter {name!r} in {where}", hint.get(name) or did_you_mean(name, [p.name for p in parameters]))


def check_value(parameter: Parameter, value: str | float, *, origin: str = "flag") -> float:
    """Return `value` in the parameter's declared unit; raises SrfError unless it is finite and within bounds."""
    name = parameter.name
    try:
        number = parse_quantity(value, parameter.unit, name=name) if isinstance(value, str) else float(value)
    except OverflowError:  # an integer of more than 308 digits
        number = math.inf
    except (TypeError, ValueError):
        raise SrfError(f"{name} = {value!r} is no number", f"Like {parameter.default:g}, or text with a unit.") from None
    source = None if origin == "flag" else f"It was set by {origin}."
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    if not math.isfinite(number):
        raise SrfError(f"{name} = {number}{unit} is not a finite number", source)
    if number and not LEAST_NUMBER <= abs(number) <= 1 / LEAST_NUMBER:
        raise SrfError(
            f"{name} = {number:g}{unit} is beyond what can be computed with",
            source or f"Choose a size from {LEAST_NUMBER:g} to {1 / LEAST_NUMBER:g}{unit}.",
        )
    for bound, side, outside in (
        (parameter.lower, "below its lower", number < parameter.lower),
        (parameter.upper, "above its upper", number > parameter.upper),
    ):
        if outside:
            hint = source or f"Choose {name} from {parameter.lower:.12g} to {parameter.upper:.12g}{unit}."
            raise SrfError(f"{name} = {number:.12g}{unit} is {side} bound {bound:.12g}{unit}", hint)
    return number


def _owner(variable: str, known: Mapping[str, Parameter]) -> str | None:
    """Return the parameter that SRF_VSAT or SRF_Vsat names; case is ignored where only one name fits."""
    if not variable.startswith("SRF_") or variable[4:].lower() in {*DEFAULTS, "set", "plugins"}:
        return None
    wanted = variable[4:]
    fitting = [wanted] if wanted in known else [n for n in known if n.upper() == wanted]
    return fitting[0] if len(fitting) == 1 else None


def parse_assignment(text: str, *, where: str = "--set") -> tuple[str, str]:
    """Return name and value of NAME=VALUE; raises SrfError for anything else."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (name and equals and value):
        raise SrfError(f"{where}: {text.strip()!r} is not NAME=VALUE", f"Write {where} Vsat=300 or {where} 'D0=0.5 um'.")
    return name, value
