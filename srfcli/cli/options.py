"""Option decorators that commands share: which system, and where its results go.

@click.command("linear", cls=SrfCommand, epilog=EXAMPLES)
@system_options
@over_option(default=("V=1:100:60",))
@output_options
def command(system: SystemOptions, over: tuple[Range, ...], output: OutputOptions) -> None: ...
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from srfcli.cli.base import Session, SrfCommand, SrfGroup
from srfcli.cli.ranges import Range, over_option, parse_over, parse_overs, parse_values, values_option
from srfcli.errors import SrfError
from srfcli.laws import Parameter
from srfcli.output.files import check_target, is_special
from srfcli.output.plots import check_plot
from srfcli.settings import (
    DEFAULTS,
    Resolved,
    Setting,
    TomlSettings,
    choose,
    find_toml,
    load_toml,
    parse_assignment,
    resolve,
)

if TYPE_CHECKING:
    from srfcli.model import GeneratedModel
    from srfcli.registry import Registry
    from srfcli.system import System
    from srfcli.tasks.system import SlidingSystem

__all__ = [
    "OutputOptions",
    "Range",
    "Session",
    "SrfCommand",
    "SrfGroup",
    "SystemOptions",
    "output_options",
    "over_option",
    "parse_over",
    "parse_overs",
    "parse_values",
    "record_options",
    "system_options",
    "values_option",
]

F = TypeVar("F", bound=Callable[..., Any])

APPARATUS = {  # the flags that have their own option; every other parameter is set with --set
    "K": "Stiffness of the loading spring, in N/um.",
    "M": "Mass of the slider, in kg.",
    "f": "Frequency of the load modulation, in Hz.",
    "angle": "Inclination of an inclined spring, in deg.",
}
LOADINGS = ("vertical", "inclined")
FORMATS = ("text", "json", "csv")
SUFFIXES = ("", ".txt", ".json", ".csv")


@dataclass(frozen=True)
class SystemOptions:
    """The laws that were chosen, each with its origin, and the values that flags set, still as text."""

    law: Setting
    ageing: Setting
    interface: Setting
    loading: Setting
    inertia: Setting
    flags: Mapping[str, str]
    plugins: tuple[Path, ...] = ()
    toml: TomlSettings = field(default_factory=TomlSettings)

    def registry(self) -> Registry:
        """Return the registry of shipped and installed laws and those in --plugins."""
        return open_registry(self.plugins, (self.law, self.ageing, self.interface))

    def _chosen(self) -> dict[str, Any]:
        check_origins(self.toml, {"law": self.law, "ageing": self.ageing, "interface": self.interface})
        return {key: getattr(self, key).value for key in ("law", "ageing", "interface", "loading", "inertia")}

    def system(self) -> System:
        """Return the system that the options name."""
        from srfcli.system import build_system

        return build_system(self.registry(), **self._chosen())

    def model(self, *, tables: Sequence[tuple[str, str]] = ()) -> GeneratedModel:
        """Return the numerical model of that system, with tables if asked for; sympy runs only where the cache has none."""
        from srfcli.model import open_model

        return open_model(self.registry(), **self._chosen(), tables=tables)

    def resolve(self, parameters: Sequence[Parameter], **given: str | float | None) -> Resolved:
        """Return every parameter's value and origin.

        `given` are the command's own flags, V=8.0, in declared units; None where one was not set.
        """
        own = {name: value for name, value in given.items() if value is not None}
        for name in own:
            if name in self.flags:
                raise SrfError(f"{name} is set twice: by --{name} and by --set", "Give each parameter one value.")
        flags = {**self.flags, **own}
        resolved = resolve(parameters, flags, toml=self.toml, where=self.law.value)
        for sentence in resolved.unused:
            Session.current().say(f"Warning: {sentence}")
        return resolved

    def slider(self, **given: str | float | None) -> SlidingSystem:
        """Return the system with its parameters, the command's own flags `given` among them as in `resolve`."""
        from srfcli.tasks.system import SlidingSystem

        model = self.model()
        return SlidingSystem(model, self.resolve(model.parameters, **given))

    def say_defaults(self, resolved: Resolved, names: Iterable[str]) -> None:
        """Say on stderr which of these parameters have a value that nobody chose."""
        taken = [p for p in resolved.parameters if p.name in set(names) and resolved.origins[p.name] == "law default"]
        if taken:
            values = ", ".join(f"{p.name} = {p.default:g}{'' if p.unit == '1' else f' {p.unit}'}" for p in taken)
            flags = " and ".join(f"--{p.name}" for p in taken)
            Session.current().say(f"Note: {values} by default; {flags} set{'s' if len(taken) == 1 else ''} it")

    def choices(self) -> dict[str, Setting]:
        """Return every setting of DEFAULTS by name, for listing."""
        names = ("law", "ageing", "interface", "loading", "inertia", "tol")
        settings = (self.law, self.ageing, self.interface, self.loading, self.inertia, self.tolerance())
        return dict(zip(names, settings, strict=True))

    def tolerance(self, flag: float | None = None) -> Setting:
        """Return the tolerance, between 0 and 1: `flag` if given, else SRF_TOL, srf.toml or the default."""
        chosen = choose("tol", flag, toml=self.toml)
        if not 0 < chosen.value < 1:
            hint = f"Choose a small number, such as {DEFAULTS['tol'].value:g}; it was set by {chosen.origin}."
            raise SrfError(f"tol = {chosen.value:g} is not between 0 and 1", hint)
        return chosen


def open_registry(plugins: Sequence[Path], settings: Sequence[Setting] = ()) -> Registry:
    """Return the laws there are; Python files that flags or the environment name may run, those of files with --trust."""
    from srfcli.registry import load_registry

    words = [word.strip() for s in settings if _by_person(s) for word in str(s.value).split("+")]
    named = [Path(word) for word in words if word.endswith(".py")]
    return load_registry(plugins, named=named, trust=Session.current().trust)


def _by_person(setting: Setting) -> bool:
    return setting.origin == "flag" or setting.origin.startswith("environment ")


def check_origins(toml: TomlSettings, settings: Mapping[str, Setting]) -> None:
    """Raise SrfError for a Python file that srf.toml names, unless --trust is given: srf.toml may be a stranger's."""
    from srfcli.registry import untrusted_hint

    for key, setting in settings.items():
        for word in str(setting.value).split("+"):
            if word.strip().endswith(".py") and setting.origin == toml.origin and not Session.current().trust:
                raise SrfError(
                    f"{toml.origin}: [defaults] {key}: '{word.strip()}' is Python code, which a file may not have run",
                    untrusted_hint(word.strip()),
                )


def system_options(function: F) -> F:
    """Add the options that choose a system; the command gets them as `system`, a SystemOptions."""
    names = ("law", "ageing", "interface", "loading", "inertia", "plugins", "assignments", *_apparatus_keys().values())

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        taken = {name: kwargs.pop(name) for name in names}
        return function(*args, system=_read_system(taken), **kwargs)

    for option in reversed(_system_click_options()):
        wrapper = option(wrapper)
    return wrapper  # type: ignore[return-value]


def _apparatus_keys() -> dict[str, str]:
    return {name: f"set_{name}" for name in APPARATUS}


def _about(key: str) -> str:
    default = DEFAULTS[key]
    return f"{default.about[:1].upper()}{default.about[1:]}.  [default: {default.value}]"


def _system_click_options() -> list[Callable[[Any], Any]]:
    chosen = [
        click.option("--law", metavar="NAME", help=_about("law")),
        click.option("--ageing", metavar="NAME", help=_about("ageing")),
        click.option("--interface", metavar="NAME", help=_about("interface")),
        click.option("--loading", type=click.Choice(LOADINGS), help=_about("loading")),
        click.option(
            "--inertia/--no-inertia", default=None, help="Whether the slider's mass counts.  [default: it does]"
        ),
    ]
    apparatus = [
        click.option(f"--{name}", key, metavar="VALUE", help=APPARATUS[name]) for name, key in _apparatus_keys().items()
    ]
    text = "Set any parameter, with or without unit: --set Vsat=300 --set 'D0=0.5 um'."
    return [
        *chosen,
        *apparatus,
        click.option("--set", "assignments", multiple=True, metavar="NAME=VALUE", help=text),
        click.option(
            "--plugins",
            multiple=True,
            metavar="DIR",
            type=click.Path(exists=True, path_type=Path),
            help="Take laws from this folder, too.",
        ),
    ]


def _read_system(taken: Mapping[str, Any]) -> SystemOptions:
    toml = load_toml(find_toml())
    chosen = {key: choose(key, taken[key], toml=toml) for key in ("law", "ageing", "interface", "loading", "inertia")}
    flags: dict[str, str] = {n: taken[key] for n, key in _apparatus_keys().items() if taken[key] is not None}
    for text in taken["assignments"]:
        name, value = parse_assignment(text)
        if name in flags and flags[name] != value:
            raise SrfError(f"{name} is set twice: {flags[name]} and {value}", "Give each parameter one value.")
        flags[name] = value
    folders = [Path(p) for p in os.environ.get("SRF_PLUGINS", "").split(os.pathsep) if p]
    return SystemOptions(**chosen, flags=flags, plugins=(*taken["plugins"], *folders), toml=toml)


@dataclass(frozen=True)
class OutputOptions:
    """Where a result goes: `format` is text, json or csv; `out` None is stdout; `provenance` asks for sidecars."""

    format: str = "text"
    out: Path | None = None
    plot: Path | None = None
    force: bool = False
    provenance: bool = True


def output_options(function: F) -> F:
    """Add --json, --csv, --out, --plot, --force and --no-provenance; the command gets `output`, already checked."""
    return _add_output(function, plot=True)


def record_options(function: F) -> F:
    """Add what `output_options` adds but --plot, for a command that has no figure."""
    return _add_output(function, plot=False)


def _add_output(function: F, *, plot: bool) -> F:
    names = ("as_json", "as_csv", "out", "force", "provenance", *(["plot"] if plot else []))

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        taken = {name: kwargs.pop(name) for name in names}
        return function(*args, output=read_output(**taken), **kwargs)

    for option in reversed(_output_click_options(plot)):
        wrapper = option(wrapper)
    return wrapper  # type: ignore[return-value]


def _output_click_options(plot: bool) -> list[Callable[[Any], Any]]:
    figure = click.option("--plot", metavar="FILE", help="Draw a figure to FILE.png, .svg or .pdf.")
    return [
        click.option("--json", "as_json", is_flag=True, help="Print JSON, in full precision."),
        click.option("--csv", "as_csv", is_flag=True, help="Print CSV, in full precision."),
        click.option("--out", metavar="FILE", help="Write to FILE; .json and .csv choose the format, - is stdout."),
        *([figure] if plot else []),
        click.option("--force", is_flag=True, help="Overwrite existing files."),
        click.option("--provenance/--no-provenance", default=True, help="Write FILE.provenance.json beside each file."),
    ]


def read_output(
    *,
    as_json: bool = False,
    as_csv: bool = False,
    out: str | None = None,
    plot: str | None = None,
    force: bool = False,
    provenance: bool = True,
) -> OutputOptions:
    """Return the output options; raises SrfError now for what could not be written once all is computed."""
    if as_json and as_csv:
        raise SrfError("--json and --csv exclude each other", "Choose one; a second run with the other costs little.")
    if out == "" or plot == "":
        raise SrfError(f"{'--out' if out == '' else '--plot'} is empty", "Name a file, or leave the option out.")
    place = None if out in (None, "-") else Path(str(out)).expanduser()
    figure = None if plot is None else Path(plot).expanduser()
    if place is not None:
        check_target(place, force=force)
    if figure is not None:
        check_plot(figure, force=force)
    if place is not None and figure is not None and place.resolve() == figure.resolve() and not is_special(place):
        raise SrfError(f"--out and --plot are the same file, {place}", "Give them different names.")
    if place is not None and place.suffix.lower() not in SUFFIXES and not (as_json or as_csv or is_special(place)):
        raise SrfError(
            f"--out {place} ends in {place.suffix!r}",
            f"End it in .txt, .json or .csv: --out {place.with_suffix('.csv')}; or name the format, --json or --csv.",
        )
    suffix = place.suffix.lower().lstrip(".") if place is not None else ""
    format = "json" if as_json else "csv" if as_csv else suffix if suffix in FORMATS else "text"
    return OutputOptions(format, place, figure, force, provenance)
