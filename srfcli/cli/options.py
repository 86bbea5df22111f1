"""Option decorators that commands share: which system, ranges of values, workers, and where results go.

@click.command("linear", cls=SrfCommand, epilog=EXAMPLES)
@system_options
@over_option(help="Values to run over.")
@output_options
def command(system: SystemOptions, over: tuple[Range, ...], output: OutputOptions) -> None: ...
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from srfcli.cli.base import Session
from srfcli.core.errors import SrfError
from srfcli.core.files import check_target, is_special
from srfcli.core.settings import (
    DEFAULTS,
    Parameter,
    Resolved,
    Setting,
    TomlSettings,
    check_value,
    choose,
    find_toml,
    load_toml,
    parse_assignment,
    require_parameter,
    resolve,
)
from srfcli.core.units import convert, parse_quantity, split_quantity, tidy
from srfcli.results.plots import check_plot

if TYPE_CHECKING:
    from srfcli.codegen.slider import Opener, SlidingSystem
    from srfcli.laws.registry import Registry

# Ranges and lists of values on the command line: `--over V=1:100:60:log`, `--over V=1,2,5`, `--V 1,7,25`.

DEFAULT_POINTS = 60
MAX_POINTS = 1_000_000
CONFIGURED = "[default: as `srf config show` prints]"  # of a parameter's option
AXIS_FORM = "Write NAME=LOW:HIGH:POINTS[:log|lin] or NAME=a,b,c, as in V=1:100:60, V=1,2,5 or 'V=1:100 um/s:60'."


@dataclass(frozen=True)
class Range:
    """The values that a parameter runs over: `values` as listed, or `n` from `lo` to `hi`, `spacing` log or lin.

    Numbers are in `unit` if one was written, else in the parameter's declared unit; `fitted` makes it the declared one.
    """

    name: str
    values: tuple[float, ...] | None = None
    lo: float = math.nan
    hi: float = math.nan
    n: int = DEFAULT_POINTS
    spacing: str = "lin"
    unit: str = ""

    def points(self) -> list[float]:
        """Return every value, the ends exactly as given."""
        if self.values is not None:
            return list(self.values)
        steps = self.n - 1
        if self.spacing == "log":
            ratio = math.log(self.hi / self.lo)
            inner = [tidy(self.lo * math.exp(ratio * i / steps)) for i in range(1, steps)]
        else:
            inner = [tidy(self.lo + (self.hi - self.lo) * i / steps) for i in range(1, steps)]
        return [self.lo, *inner, self.hi]

    def fitted(self, parameters: Sequence[Parameter], *, where: str = "this system") -> Range:
        """Return the range in declared units; raises SrfError for an unknown name or a value out of bounds."""
        parameter = require_parameter(self.name, parameters, where=where)

        def fit(number: float) -> float:
            declared = convert(number, self.unit, parameter.unit, name=self.name) if self.unit else number
            return check_value(parameter, declared)

        if self.values is not None:
            return replace(self, values=tuple(map(fit, self.values)), unit=parameter.unit)
        return replace(self, lo=fit(self.lo), hi=fit(self.hi), unit=parameter.unit)

    def check_ends(self) -> None:
        """Raise SrfError for a list of values where an axis is asked for."""
        if self.values is not None:
            hint = f"An axis runs from a low to a high end: --over {self.name}=1:100."
            raise SrfError(f"--over {self.name} lists values", hint)


def parse_over(text: str) -> Range:
    """Return the range that NAME=LOW:HIGH[:POINTS[:log|lin]] or NAME=a,b,c describes; one unit holds for all.

    Spacing is logarithmic unless said where the ends are positive and a decade or more apart. Raises SrfError.
    """
    name, equals, body = (part.strip() for part in text.partition("="))
    parts = name.split("/")  # K/W0 is a ratio, for the commands that take one
    if not (equals and body and len(parts) <= 2 and all(part.isidentifier() for part in parts)):
        raise SrfError(f"--over {text!r} is not a range", AXIS_FORM)
    if ":" not in body:
        values, unit = _numbers(name, body.split(","), text)
        return Range(name, values=values, unit=unit)
    fields = [part.strip() for part in body.split(":")]
    if len(fields) > 4:
        raise SrfError(f"--over {text!r} has {len(fields)} fields between colons, not 2 to 4", AXIS_FORM)
    (lo, hi), unit = _numbers(name, fields[:2], text)
    if not lo < hi:
        raise SrfError(f"--over {text!r}: its low end {lo:g} is not below its high end {hi:g}", AXIS_FORM)
    spacing = fields[3] if len(fields) == 4 else "log" if lo > 0 and hi >= 10 * lo else "lin"
    if spacing not in ("log", "lin"):
        raise SrfError(f"--over {text!r}: unknown spacing {spacing!r}", "Known: lin, log")
    if spacing == "log" and lo <= 0:
        raise SrfError(f"--over {text!r}: a logarithmic range cannot reach {lo:g}", "Begin above 0, or end it in :lin.")
    digits = fields[2] if len(fields) > 2 else str(DEFAULT_POINTS)
    if not (digits.isascii() and digits.isdecimal() and len(digits) < 8 and 2 <= int(digits) <= MAX_POINTS):
        hint = f"Write a whole number from 2 to {MAX_POINTS}, as in V=1:100:60."
        raise SrfError(f"--over {text!r}: {digits!r} is not a number of points", hint)
    return Range(name, lo=lo, hi=hi, n=int(digits), spacing=spacing, unit=unit)


def _numbers(name: str, parts: Sequence[str], text: str) -> tuple[tuple[float, ...], str]:
    pairs = []
    for part in parts:
        try:
            pairs.append(split_quantity(part, name=name))
        except SrfError as error:
            raise SrfError(f"--over {text!r}: {part.strip()!r} is not a number", AXIS_FORM) from error
    units = sorted({unit for _, unit in pairs if unit})
    if len(units) > 1:
        hint = "Write the unit once, after the last number."
        raise SrfError(f"--over {text!r} mixes the units {' and '.join(units)}", hint)
    return tuple(number for number, _ in pairs), units[0] if units else ""


def parse_overs(texts: Sequence[str]) -> tuple[Range, ...]:
    """Return the ranges that several --over describe; raises SrfError if two are over the same parameter."""
    ranges = tuple(map(parse_over, texts))
    names = [made.name for made in ranges]
    if twice := [name for name in names if names.count(name) > 1]:
        raise SrfError(f"--over {twice[0]} is given twice", "Give one range for each parameter, or list values: V=1,2,5.")
    return ranges


def parse_ends(name: str, text: str) -> Range | None:
    """Return the range of a parameter that LOW:HIGH spans, with or without a unit; None where the text is none."""
    with contextlib.suppress(SrfError):
        return parse_over(f"{name}={text}") if text.count(":") == 1 else None
    return None


def names_of(kind: str) -> Callable[[click.Context, click.Parameter, str], list[Any]]:
    """Return a shell completion for the names of laws of this kind."""

    def complete(context: click.Context, parameter: click.Parameter, begun: str) -> list[Any]:
        from click.shell_completion import CompletionItem

        from srfcli.laws.registry import load_registry

        with contextlib.suppress(SrfError):  # a folder that is gone; the command itself says so
            return [CompletionItem(e.name, help=e.about) for e in load_registry().entries(kind) if e.name.startswith(begun)]
        return []

    return complete


def over_option(*, help: str, default: Sequence[str] = ()) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add --over NAME=..., repeatable; the command gets `over`, a tuple of Range, `default` parsed if none is given."""
    return click.option(
        "--over",
        multiple=True,
        default=list(default),
        show_default=", ".join(default) if default else False,
        metavar="NAME=RANGE",
        help=help,
        callback=lambda _context, _parameter, texts: parse_overs(texts),
    )


def values_option(
    parameter: Parameter, *, default: tuple[float, ...] | None = None, about: str = "", configured: bool = True
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add --NAME for a list of values, `--V 1,7,25` or repeated, with or without unit.

    The command gets `NAME`, a tuple of floats in the declared unit, checked against the bounds, or `default`. If `configured`,
    the help says that the value of `srf config show` is taken in place of None.
    """
    unit = "" if parameter.unit == "1" else f", in {parameter.unit}"
    meaning = about or parameter.about or parameter.name
    otherwise = f"  [default: {','.join(f'{x:g}' for x in default)}]" if default else f"  {CONFIGURED}" if configured else ""
    return click.option(
        f"--{parameter.name}",
        parameter.name,
        multiple=True,
        metavar="VALUES",
        help=f"{meaning[:1].upper()}{meaning[1:]}{unit}; several as a,b,c.{otherwise}",
        callback=lambda _context, _option, texts: parse_values(texts, parameter) if texts else default,
    )


def parse_values(texts: Sequence[str], parameter: Parameter) -> tuple[float, ...]:
    """Return the numbers in comma-separated `texts`, in the declared unit; the last one's unit holds for its list."""
    found = []
    for text in texts:
        parts = [part.strip() for part in text.split(",")]
        shared = split_quantity(parts[-1], name=parameter.name)[1]
        for part in parts:
            number, own = split_quantity(part, name=parameter.name)
            written = f"{number!r} {own or shared}".strip()
            found.append(check_value(parameter, parse_quantity(written, parameter.unit, name=parameter.name)))
    return tuple(found)


Values = tuple[float, ...] | None  # of a `values_option`

# Option decorators that commands share: which system, and where its results go.

F = TypeVar("F", bound=Callable[..., Any])

APPARATUS_FLAGS = {  # the flags that have their own option; every other parameter is set with --set
    "K": "Stiffness of the loading spring, in N/um.",
    "M": "Mass of the slider, in kg.",
    "f": "Frequency of the load modulation, in Hz.",
    "angle": "Inclination of an inclined spring, in deg.",
}
PATH = click.Path(path_type=Path)
POSITIVE = click.FloatRange(0, min_open=True)
LOADINGS = ("vertical", "inclined")
LAW_CHOICES = ("law", "ageing", "interface")
CHOICES = (*LAW_CHOICES, "loading", "inertia")
AMPLITUDE = Parameter("eps", 0.0, "1", 0.0, 0.999999, "relative modulation amplitudes")
TABLE_FORMATS = ("text", "json", "csv")
TABLE_SUFFIXES = ("", ".txt", ".json", ".csv")


@dataclass(frozen=True)
class SystemOptions:
    """What was chosen of CHOICES, each with its origin, and the values that flags set, still as text."""

    chosen: Mapping[str, Setting]
    flags: Mapping[str, str]
    plugins: tuple[Path, ...] = ()
    toml: TomlSettings = field(default_factory=TomlSettings)
    effects: tuple[str, ...] = ()

    def registry(self) -> Registry:
        """Return the registry of shipped and installed laws and those in --plugins."""
        named = (Setting(name, "flag") for name in self.effects)
        return open_registry(self.plugins, (*(self.chosen[key] for key in LAW_CHOICES), *named))

    def opener(self) -> Opener:
        """Return what opens the formulas and the models of the system that the options name.

        Raises SrfError for a Python file that srf.toml names, unless --trust is given: srf.toml may be a stranger's.
        """
        from srfcli.codegen.slider import Opener
        from srfcli.laws.registry import untrusted_hint

        for key in LAW_CHOICES:
            for word in map(str.strip, str(self.chosen[key].value).split("+")):
                if word.endswith(".py") and self.chosen[key].origin == self.toml.origin and not Session.current().trust:
                    said = f"{self.toml.origin}: [defaults] {key}: '{word}' is Python code, which a file may not have run"
                    raise SrfError(said, untrusted_hint(word))
        return Opener(self.registry(), {key: setting.value for key, setting in self.chosen.items()}, self.effects)

    def resolve(self, parameters: Sequence[Parameter], **given: str | float | None) -> Resolved:
        """Return every parameter's value and origin.

        `given` are the command's own flags, V=8.0, in declared units; None where one was not set.
        """
        own = {name: value for name, value in given.items() if value is not None}
        for name in own:
            if name in self.flags:
                raise SrfError(f"{name} is set twice: by --{name} and by --set", "Give each parameter one value.")
        flags = {**self.flags, **own}
        resolved = resolve(parameters, flags, toml=self.toml, where=self.chosen["law"].value)
        for sentence in resolved.unused:
            Session.current().say(f"Warning: {sentence}")
        return resolved

    def slider(self, moving: bool = False, /, **given: str | float | None) -> SlidingSystem:
        """Return the system with its parameters, the command's own flags `given` among them as in `resolve`.

        For motion in time it is `moving`: effects that critical loads do not depend on count.
        """
        from srfcli.codegen.slider import SlidingSystem, declared

        opener = self.opener()
        model = opener.motion if moving else opener.model
        return SlidingSystem(self.resolve(declared(model), **given), opener, model.title)

    def say_defaults(self, resolved: Resolved, names: Iterable[str]) -> None:
        """Say on stderr which of these parameters have the default of their law."""
        taken = [p for p in resolved.parameters if p.name in set(names) and resolved.origins[p.name] == "law default"]
        if taken:
            values = ", ".join(f"{p.name} = {p.default:g}{'' if p.unit == '1' else f' {p.unit}'}" for p in taken)
            flags = " and ".join(f"--{p.name}" for p in taken)
            Session.current().say(f"Note: {values} by default; {flags} set{'s' if len(taken) == 1 else ''} it")

    def tolerance(self, flag: float | None = None) -> Setting:
        """Return the tolerance, between 0 and 1: `flag` if given, else SRF_TOL, srf.toml or the default."""
        chosen = choose("tol", flag, toml=self.toml)
        if not 0 < chosen.value < 1:
            hint = f"Choose a small number, such as {DEFAULTS['tol'].value:g}; it was set by {chosen.origin}."
            raise SrfError(f"tol = {chosen.value:g} is not between 0 and 1", hint)
        return chosen


def open_registry(plugins: Sequence[Path], settings: Sequence[Setting] = ()) -> Registry:
    """Return the laws there are; Python files that flags or the environment name may run, those of files with --trust."""
    from srfcli.laws.registry import load_registry

    by_person = [s for s in settings if s.origin == "flag" or s.origin.startswith("environment ")]  # and by no file
    words = [word.strip() for s in by_person for word in str(s.value).split("+")]
    named = [Path(word) for word in words if word.endswith(".py")]
    return load_registry(plugins, named=named, trust=Session.current().trust)


def _about(key: str) -> str:
    default = DEFAULTS[key]
    return f"{default.about[:1].upper()}{default.about[1:]}.  [default: {default.value}]"


Options = dict[str, Callable[[Any], Any]]  # decorators by the name of the argument that each of them adds
APPARATUS_OPTIONS: Options = {
    "inertia": click.option("--inertia/--no-inertia", default=None, help="Whether the slider's mass counts.  [default: it does]"),
    **{
        f"set_{n}": click.option(f"--{n}", f"set_{n}", metavar="VALUE", help=f"{about}  {CONFIGURED}")
        for n, about in APPARATUS_FLAGS.items()
    },
}
plugins_option = click.option(
    "--plugins", multiple=True, metavar="DIR", type=PATH, help="Folder with law files of your own; repeatable. Also SRF_PLUGINS."
)
SYSTEM_OPTIONS: Options = {
    "law": click.option("--law", metavar="NAME", help=_about("law"), shell_complete=names_of("friction")),
    "ageing": click.option("--ageing", metavar="NAME", help=_about("ageing"), shell_complete=names_of("ageing")),
    "interface": click.option("--interface", metavar="NAME", help=_about("interface"), shell_complete=names_of("interface")),
    "loading": click.option("--loading", type=click.Choice(LOADINGS), help=_about("loading")),
    **APPARATUS_OPTIONS,
    "assignments": click.option(
        "--set",
        "assignments",
        multiple=True,
        metavar="NAME=VALUE",
        help="Set any parameter, with or without unit: --set Vsat=300 --set 'D0=0.5 um'.",
    ),
    "plugins": plugins_option,
}
EFFECTS_OPTION = click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="NAME",
    help="Add this effect to the laws; `srf laws --kind effect` lists all; repeatable.",
    shell_complete=names_of("effect"),
)


def add_options(options: Options) -> Callable[[F], F]:
    """Return a decorator that adds options, which the help lists in this order."""

    def decorate(function: F) -> F:
        for option in reversed(options.values()):
            function = option(function)
        return function

    return decorate


def _as_one(name: str, read: Callable[..., Any], options: Options) -> Callable[[F], F]:
    """Return a decorator that adds options of which the command gets one argument, `name`: what `read` makes of their values."""

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            taken = {key: kwargs.pop(key) for key in options}
            return function(*args, **{name: read(**taken)}, **kwargs)

        return add_options(options)(wrapper)  # type: ignore[return-value]

    return decorate


def read_system(
    *, assignments: Sequence[str], plugins: tuple[Path, ...], effects: tuple[str, ...] = (), **taken: Any
) -> SystemOptions:
    """Return what the values of SYSTEM_OPTIONS choose, those that are None by the environment, srf.toml or the default."""
    toml = load_toml(find_toml())
    chosen = {key: choose(key, taken[key], toml=toml) for key in CHOICES}
    flags: dict[str, str] = {n: taken[f"set_{n}"] for n in APPARATUS_FLAGS if taken[f"set_{n}"] is not None}
    for text in assignments:
        name, value = parse_assignment(text)
        if name in flags and flags[name] != value:
            raise SrfError(f"{name} is set twice: {flags[name]} and {value}", "Give each parameter one value.")
        flags[name] = value
    return SystemOptions(chosen, flags=flags, plugins=plugins, toml=toml, effects=effects)


# the command gets `system`, a SystemOptions
system_options = _as_one("system", read_system, SYSTEM_OPTIONS)
options_with_effects = _as_one("system", read_system, {**SYSTEM_OPTIONS, "effects": EFFECTS_OPTION})


def value_option(name: str, help: str) -> Callable[[F], F]:
    """Add --NAME for one value of a parameter, as text with or without unit."""
    return click.option(f"--{name}", name, metavar="VALUE", help=f"{help}  {CONFIGURED}")


def mesh_option(*, least: int, most: int = 8192, default: int = 512) -> Callable[[F], F]:
    """Add --max-mesh; the command gets `max_mesh`."""
    kind = click.IntRange(least, most)
    return click.option("--max-mesh", type=kind, default=default, help="Intervals of the finest mesh.")


step_option = click.option("--step", default=0.035, help="Longest step along the curve, as a share of the window.")


def check_axes(swept: Container[str], given: Mapping[str, str | None]) -> None:
    """Raise SrfError for a parameter that is swept and has a value, too."""
    for name, value in given.items():
        if value is not None and name in swept:
            raise SrfError(f"{name} is an axis and has a value too", f"Leave out --{name}, or take {name} out of --over.")


@dataclass(frozen=True)
class OutputOptions:
    """Where a result goes: `format` is text, json or csv; `out` None is stdout; `provenance` asks for sidecars."""

    format: str = "text"
    out: Path | None = None
    plot: Path | None = None
    force: bool = False
    provenance: bool = True


OUTPUT_OPTIONS: Options = {
    "as_json": click.option("--json", "as_json", is_flag=True, help="Print JSON, in full precision."),
    "as_csv": click.option("--csv", "as_csv", is_flag=True, help="Print CSV, in full precision."),
    "out": click.option("--out", metavar="FILE", help="Write to FILE; .json and .csv choose the format, - is stdout."),
    "plot": click.option("--plot", metavar="FILE", help="Draw a figure to FILE.png, .svg or .pdf."),
    "force": click.option("--force", is_flag=True, help="Overwrite existing files."),
    "provenance": click.option(
        "--provenance/--no-provenance", default=True, show_default=False, help="Write FILE.provenance.json beside each file."
    ),
}


def read_output(
    *,
    as_json: bool = False,
    as_csv: bool = False,
    out: str | None = None,
    plot: str | None = None,
    force: bool = False,
    provenance: bool = True,
) -> OutputOptions:
    """Return the output options; raises SrfError, before anything is computed, for files that could not be written."""
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
    if place is not None and place.suffix.lower() not in TABLE_SUFFIXES and not (as_json or as_csv or is_special(place)):
        raise SrfError(
            f"--out {place} ends in {place.suffix!r}",
            f"End it in .txt, .json or .csv: --out {place.with_suffix('.csv')}; or name the format, --json or --csv.",
        )
    suffix = place.suffix.lower().lstrip(".") if place is not None else ""
    format = "json" if as_json else "csv" if as_csv else suffix if suffix in TABLE_FORMATS else "text"
    return OutputOptions(format, place, figure, force, provenance)


# the command gets `output`, an OutputOptions; one without a figure has no --plot
output_options = _as_one("output", read_output, OUTPUT_OPTIONS)
record_options = _as_one("output", read_output, {k: v for k, v in OUTPUT_OPTIONS.items() if k != "plot"})


# Options that spread a long computation: --workers, --cluster and --resume, the same path for all three.


@dataclass(frozen=True)
class Spread:
    """Where tasks are done: in this process, in `workers` others, or on a `cluster`; `resume` keeps what is finished."""

    workers: int = 1
    cluster: str | None = None
    resume: Path | None = None

    def run(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Yield (index, result) of every task, in any order."""
        from srfcli.core.parallel import Store, stored

        return self._fresh(function, tasks) if self.resume is None else stored(self._fresh, Store(self.resume), function, tasks)

    def _fresh(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        from srfcli.core import parallel

        if not tasks:
            return iter(())
        if self.cluster is not None:
            return parallel.run_cluster(function, tasks, address=self.cluster)
        if self.workers > 1:
            return parallel.run_processes(function, tasks, workers=self.workers)
        return parallel.run_here(function, tasks)


WORKER_OPTIONS: Options = {
    "workers": click.option(
        "--workers", type=click.IntRange(0, 4096), help="Processes to use, 0 for all cores.  [default: this one only]"
    ),
    "cluster": click.option("--cluster", metavar="ADDRESS", help="Scheduler of a dask.distributed cluster, tcp://host:port."),
    "resume": click.option("--resume", metavar="DIR", help="Keep finished parts in DIR, and go on from those found there."),
}


def _read_spread(*, workers: int | None, cluster: str | None, resume: str | None) -> Spread:
    if workers is not None and cluster is not None:
        raise SrfError("--workers and --cluster exclude each other", "A cluster has its own number of workers.")
    count = workers if workers else os.cpu_count() or 1 if workers == 0 else 1
    return Spread(count, cluster, None if resume is None else Path(resume).expanduser())


worker_options = _as_one("spread", _read_spread, WORKER_OPTIONS)  # the command gets `spread`, a Spread


def listed(texts: Sequence[str]) -> list[str]:
    """Return the names in `A,B` and the like, given once or several times."""
    return [name.strip() for text in texts for name in text.split(",") if name.strip()]


def vary_options(function: F) -> F:
    """Add --trend, --vary and --by, which fits of recordings have in common."""
    ways = ["run", "load", "segment", "direction"]
    by = click.option("--by", type=click.Choice(ways), help="Groups of --vary; unless given, those of the experiment, else runs.")
    text = "Parameters, or noise, with a value of their own in each group of --by, else in each run; or NAME:BY, as B:load."
    vary = click.option("--vary", multiple=True, metavar="NAMES", help=text)
    text = "Let each run's observable drift with slip or time, or not; unless given, as the experiment says."
    trend = click.option("--trend", type=click.Choice(["slip", "time", "none"]), help=text)
    return trend(vary(by(function)))


reader_option = click.option("--format", "reader", metavar="READER", help="Read every data file by this reader.")
