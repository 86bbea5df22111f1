"""Names of laws to files and entry points.

A listing imports nothing: a Python plugin is read, and run when one of its laws is used. A broken plugin stops only its user.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import importlib
import importlib.metadata
import importlib.util
import os
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from srfcli.core.cache import header_key, known_headers, user_base
from srfcli.core.errors import CHECK_PATH, SrfError, did_you_mean
from srfcli.core.files import check_plain, open_plain, read_plain
from srfcli.core.settings import Parameter
from srfcli.laws.law_file import PLUGIN_KINDS, kind_of, law_of, open_law, read_header, read_parameters, valid_name
from srfcli.laws.values import AgeingLaw, AgeingModifier, Effect, Law, Reader

GROUP = "srf.laws"
BUNDLED = "bundled"
PLUGIN_SOURCES = ("--plugins", "SRF_PLUGINS")


@dataclass(frozen=True)
class Entry:
    """A law that can be loaded: what it is called, what it is and where it comes from."""

    name: str
    kind: str
    origin: str
    location: Path
    about: str = ""
    module: str | None = field(default=None, repr=False)  # how an entry point imports it


@dataclass(frozen=True)
class Problem:
    """A source that could not be listed: `name` is what its user would probably ask for."""

    name: str
    origin: str
    location: str
    message: str
    hint: str | None = None


class Registry:
    """The laws that were found, by kind and name; a law is loaded when it is first asked for, and then kept."""

    def __init__(
        self, entries: Sequence[Entry], problems: Sequence[Problem] = (), *, own: Iterable[Path] = (), trust: bool = False
    ) -> None:
        self._entries = tuple(sorted(entries, key=lambda e: (PLUGIN_KINDS.index(e.kind), e.name, str(e.location))))
        self.problems = tuple(problems)
        self._trust = trust
        self._own = frozenset(own)
        self._loaded: dict[Entry, Any] = {}

    def entries(self, kind: str | None = None) -> tuple[Entry, ...]:
        """Return all entries, or those of one kind, sorted by kind and name; clashing ones are all there."""
        if kind is not None and kind not in PLUGIN_KINDS:
            raise SrfError(f"unknown kind '{kind}'", did_you_mean(kind, PLUGIN_KINDS))
        return tuple(e for e in self._entries if kind in (None, e.kind))

    def plus(self, entries: Iterable[Entry]) -> Registry:
        """Return the registry with other entries besides, of TOML files; what may run is the same."""
        return Registry((*self._entries, *entries), self.problems, own=self._own, trust=self._trust)

    def clashes(self, entry: Entry) -> tuple[Entry, ...]:
        """Return the other entries of the same kind and name."""
        return tuple(e for e in self._entries if e != entry and (e.kind, e.name) == (entry.kind, entry.name))

    def find(self, kind: str, name: str) -> Entry:
        """Return the one entry of that kind and name; raises `SrfError` where there is none, or more than one."""
        found = [e for e in self.entries(kind) if e.name == name]
        what = _what(kind)
        if len(found) == 1:
            return found[0]
        if found:
            places = " and ".join(f"{e.location} ({e.origin})" for e in found)
            raise SrfError(f"two {what}s are called '{name}': {places}", "Rename one or take its folder away.")
        for problem in self.problems:
            if problem.name == name:
                raise SrfError(problem.message, problem.hint)
        if os.sep in name:
            raise SrfError(f"no {what} {name}", "A name has no slash, and a law's file ends in .toml or .py.")
        others = [e.kind for e in self._entries if e.name == name]
        known = did_you_mean(name, (e.name for e in self.entries(kind)))
        hint = f"'{name}' is of kind {others[0]}. Known: {known.rpartition('Known: ')[2]}" if others else known
        if kind == "ageing" and any(word in name for word in ("slip", "ageing", "aging")):
            hint = f"The slip law is ruina, the ageing law dieterich. {hint}"
        raise SrfError(f"unknown {what} '{name}'", hint, kind="unknown name")

    def get(self, kind: str, name: str) -> Law:
        """Return the law of that kind and name, or in the file of that name where it ends in .toml or .py."""
        if name.endswith((".toml", ".py")):
            self.check_trusted(name)
            path = Path(name)
            found = [law for law in read_file(path) if kind_of(law) == kind]
            if len(found) != 1:
                raise SrfError(f"{path}: holds {len(found)} laws of kind {kind}, expected one")
            return found[0]
        return self.load(self.find(kind, name))

    def check_trusted(self, name: str) -> None:
        """Raise `SrfError` for a Python file that only a file names: to read its law would be to run it.

        What a person named (`named`, `plugins`) or installed may run, and with `trust` anything may.
        """
        if name.endswith(".py") and not self._trust and _resolved(Path(name)) not in self._own:
            raise SrfError(f"'{name}' is Python code, which a file may not have run", untrusted_hint(name))

    def load(self, entry: Entry) -> Any:
        """Return the law or the reader of an entry, imported or parsed at the first call."""
        if entry.origin == BUNDLED:
            return _shipped(entry)
        if entry not in self._loaded:
            self._loaded[entry] = read_entry(entry)
        return self._loaded[entry]

    def ageing(self, spelling: str) -> tuple[AgeingLaw, tuple[AgeingModifier, ...]]:
        """Return the ageing law and the modifiers of a spelling such as `dieterich+linker-dieterich`."""
        first, *rest = _ageing_words(spelling)
        law, modifiers = self.get("ageing", first), tuple(self.get("modifier", word) for word in rest)
        assert isinstance(law, AgeingLaw)
        _joined(spelling, [(m.name, m.parameters) for m in (law, *modifiers)])
        return law, modifiers  # type: ignore[return-value]

    def ageing_parameters(self, spelling: str) -> tuple[Parameter, ...]:
        """Return the parameters of an ageing law and its modifiers; SrfError where two are called alike."""
        first, *rest = _ageing_words(spelling)
        own = [(first, self.parameters("ageing", first)), *((word, self.parameters("modifier", word)) for word in rest)]
        return _joined(spelling, own)

    def parameters(self, kind: str, name: str) -> tuple[Parameter, ...]:
        """Return the parameters of a law; of one that is shipped the formula is not read for them."""
        if not name.endswith((".toml", ".py")):
            entry = self.find(kind, name)
            if entry.origin == BUNDLED and entry.location.suffix == ".toml":
                return read_parameters(open_law(entry.location))
        return self.get(kind, name).parameters

    def fingerprint(self, entry: Entry) -> str:
        """Return the sha256 of the file that holds a law."""
        return hashlib.sha256(read_plain(entry.location)).hexdigest()


def chosen_instead(effect: Effect, model: str = "", apparatus: str = "") -> list[str]:
    """Return what is to be chosen in place of an effect that only changes what the system is, nothing for any other effect.

    `model` and `apparatus` are appended to say where.
    """
    instead = [f"{key} = {str(value).lower()}{model}" for key, value in effect.settings]
    freed = {"K": f"another stiffness{apparatus}", "M": f"a mass{apparatus}"}
    return instead + [freed.get(name, name) for name in effect.frees]


def _ageing_words(spelling: str) -> list[str]:
    """Return the names of an ageing law and its modifiers."""
    words = [word.strip() for word in spelling.split("+")]
    if not all(words):
        raise SrfError(f"ageing law '{spelling}' has an empty part", "Write dieterich+linker-dieterich.")
    if len(set(words[1:])) != len(words[1:]):
        raise SrfError(f"ageing law '{spelling}' names a modifier twice", "Change the modifier's parameter instead.")
    return words


def _joined(spelling: str, parts: Iterable[tuple[str, tuple[Parameter, ...]]]) -> tuple[Parameter, ...]:
    """Return the parameters of an ageing law and its modifiers, given with their names."""
    found: tuple[Parameter, ...] = ()
    for name, parameters in parts:
        if twice := {p.name for p in found} & {p.name for p in parameters}:
            raise SrfError(f"'{spelling}' has two parameters called '{min(twice)}'", f"Rename the one of '{name}'.")
        found += parameters
    return found


def _what(kind: str) -> str:
    return kind if kind == "reader" else f"{kind} law"


def _resolved(path: Path) -> Path:
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):  # a link to itself, a zero byte: nothing that could be run
        return path


def untrusted_hint(name: str) -> str:
    """Return what a person does who has read a Python file that a file names."""
    return f"Once you have read it, give --plugins {Path(name).parent} or --trust"


def load_registry(
    plugins: Sequence[Path] = (), *, user: bool = True, entry_points: bool = True, named: Sequence[Path] = (), trust: bool = False
) -> Registry:
    """Return the laws of the bundled folder, entry points, the user's data folder, SRF_PLUGINS and `plugins`.

    A law that an experiment names by the path of a Python file runs only where the file is one of these or in `named`, or
    with `trust`. A folder in `plugins` or SRF_PLUGINS that does not exist raises `SrfError`; every other fault becomes a
    `Problem`.
    """
    shipped, collect = _bundled(), _Collector()
    collect.entries, collect.problems, collect.seen = [*shipped.entries], [*shipped.problems], {*shipped.seen}
    if entry_points:
        for point in _entry_points(tuple(sys.path)):
            collect.entry_point(point)
    if user and user_folder().is_dir():
        collect.folder("user", user_folder())
    by_option, by_environment = PLUGIN_SOURCES
    asked = [(p, by_option) for p in plugins]
    asked += [(Path(p), by_environment) for p in os.environ.get("SRF_PLUGINS", "").split(os.pathsep) if p]
    for path, origin in asked:
        path = path.expanduser()
        if not path.exists():
            raise SrfError(f"{origin}: no folder {path}", "Give a folder that holds law files.")
        if not path.is_dir():
            if path.suffix not in (".toml", ".py"):
                raise SrfError(f"{origin}: {path} is neither a folder nor a law's file", "A law's file ends in .toml or .py.")
            check_plain(path)
        collect.folder(origin, path)
    return Registry(collect.entries, collect.problems, own={*collect.seen, *map(_resolved, named)}, trust=trust)


@functools.cache
def bundled_registry() -> Registry:
    """Return the shipped laws alone."""
    return Registry(_bundled().entries, _bundled().problems, own=_bundled().seen)


@functools.cache
def _bundled() -> _Collector:
    """Return what the folder of shipped laws holds, read once in a process."""
    collect = _Collector()
    collect.folder(BUNDLED, bundled_folder())
    return collect


@functools.cache
def _shipped(entry: Entry) -> Any:
    """Return the law or reader of a shipped file, read once in a process."""
    return read_entry(entry)


@functools.cache
def _entry_points(path: tuple[str, ...]) -> tuple[importlib.metadata.EntryPoint, ...]:
    """Return the entry points of what is installed on this path, whose every package is asked once in a process."""
    return tuple(importlib.metadata.entry_points(group=GROUP))


def bundled_folder() -> Path:
    """Return the folder of shipped laws: inside the wheel, else beside the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "plugins"
    return inside if inside.is_dir() else package.parent / "plugins"


def user_folder() -> Path:
    """Return the folder of the user's own laws, which need not exist."""
    if os.environ.get("SRF_DATA"):
        return Path(os.environ["SRF_DATA"])
    return user_base("XDG_DATA_HOME", ".local/share") / "srf" / "plugins"


def read_entry(entry: Entry) -> Any:
    """Return the law or reader of an entry: a TOML file is parsed, a Python plugin imported."""
    return read_law(entry.location) if entry.location.suffix == ".toml" else find_value(entry)


def read_law(path: Path) -> Law:
    """Return the law, or the effect, in a TOML file; its `kind` says which reader it needs."""
    node = open_law(path)
    if node.value.get("kind") == "effect":
        from srfcli.laws.effect_file import effect_of  # imports sympy

        return effect_of(node)
    return law_of(node)


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise `SrfError` where the law's file `path` cannot be opened inside."""
    try:
        yield
    except FileNotFoundError:
        raise SrfError(f"no file {path}", "Give the path of a .toml or .py file.") from None
    except OSError as error:
        raise SrfError(f"{path}: cannot be read: {error.strerror}", CHECK_PATH) from error


def read_file(path: Path) -> tuple[Law, ...]:
    """Return the laws in one file, TOML or Python; a Python file is run."""
    if path.suffix not in (".toml", ".py"):
        raise SrfError(f"{path}: neither .toml nor .py", "Laws are written as TOML or Python.")
    with reading(path):
        open_plain(path).close()
    if path.suffix == ".toml":
        return (read_law(path),)
    laws = tuple(value for value in vars(load_module(path, None)).values() if isinstance(value, Law))
    if not laws:
        raise SrfError(f"{path}: holds no law", f"Decorate a function with @friction_law(...) from {API}.")
    return laws


class _Collector:
    """Entries and problems, gathered source by source; a file that is reached twice counts once."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []
        self.problems: list[Problem] = []
        self.seen: set[Path] = set()

    def folder(self, origin: str, folder: Path) -> None:
        try:
            paths = list(_law_files(folder))
        except OSError as error:
            message = f"{folder}: cannot be read: {error.strerror}"
            self.problems.append(Problem(folder.name, origin, str(folder), message, CHECK_PATH))
            return
        if not paths and origin in PLUGIN_SOURCES:
            message = f"{folder} holds no law: no file there ends in .toml or .py"
            self.problems.append(Problem(folder.name, origin, str(folder), message, "Name the folder that holds them."))
        for path in paths:
            self.file(origin, path)

    def file(self, origin: str, path: Path, module: str | None = None, only: str | None = None) -> None:
        place = _resolved(path)
        if place in self.seen:
            return
        self.seen.add(place)
        with self.noting(path.stem, origin, path):
            found = _known(path) or ([read_header(path)] if path.suffix == ".toml" else scan_python(path))
            if only is not None:
                found = [entry for entry in found if entry[1] == only.replace("_", "-")]
            self.entries += [Entry(name, kind, origin, path, about, module) for kind, name, about in found]

    def entry_point(self, point: importlib.metadata.EntryPoint) -> None:
        origin = f"entry point {point.name}"
        with self.noting(point.name, origin, point.value):
            place = _without_import(point.module)
            source = place / "__init__.py" if place.is_dir() else place
            if place.is_dir() and (not source.is_file() or any(path.suffix == ".toml" for path in _law_files(place))):
                self.folder(origin, place)
            else:
                self.file(origin, source, point.module, point.attr or None)

    @contextlib.contextmanager
    def noting(self, name: str, origin: str, where: object) -> Iterator[None]:
        """Note what is raised inside as a problem of the source `name`."""
        try:
            yield
        except SrfError as error:
            self.problems.append(Problem(name, origin, str(where), error.message, error.hint))
        except Exception as error:  # a foreign source may fail in any way; its user is told, the others go on
            message = f"{where}: {type(error).__name__}: {error}"
            self.problems.append(Problem(name, origin, str(where), message))


def _law_files(folder: Path) -> Iterator[Path]:
    """Yield the law files of a folder and of its subfolders friction, ageing, modifier, interface and readers."""
    if not folder.is_dir():
        yield folder
        return
    for place in (folder, *(folder / kind for kind in (*PLUGIN_KINDS, "readers"))):
        if place.is_dir():
            yield from sorted(p for p in place.iterdir() if p.suffix in (".toml", ".py") and not p.name.startswith(("_", ".")))


def _known(path: Path) -> list[tuple[str, str, str]] | None:
    """Return what the package already knows of a file of this name and content, None where that is nothing."""
    try:
        return known_headers().get(header_key(path, read_plain(path)))
    except (OSError, SrfError):  # its reader says what is wrong
        return None


def _without_import(module: str) -> Path:
    """Return the file or folder of a module; only the finder of its top-level package is asked, nothing is imported."""
    top, *rest = module.split(".")
    spec = importlib.util.find_spec(top)
    if spec is None:
        raise SrfError(f"entry point names the module {module}, which is not installed")
    roots = [Path(p) for p in spec.submodule_search_locations or ()]
    if not rest:
        return roots[0] if roots else Path(str(spec.origin))
    for root in roots:
        place = root.joinpath(*rest)
        for candidate in (place, place.with_suffix(".py")):
            if candidate.is_dir() or candidate.is_file():
                return candidate
    raise SrfError(f"entry point names {module}, which is not in the package {top}")


# Python plugins: found by reading the source, imported only when one of their laws is used.

API = "srfcli.laws.api"  # what a plugin imports its decorators from
DECORATORS = {"friction_law": "friction", "ageing_law": "ageing"} | {n: n for n in ("modifier", "interface", "effect", "reader")}


def scan_python(path: Path) -> list[tuple[str, str, str]]:
    """Return (kind, name, about) of each decorated law in a Python file, which is read but not run.

    A file that imports API and shows no law, and a decorator whose name is not written out, raise `SrfError`.
    """
    try:
        tree = ast.parse(read_plain(path, what="a law"), filename=str(path))
    except SyntaxError as error:
        raise SrfError(f"{path}: not Python: {error.msg}, line {error.lineno}") from None
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        raise SrfError(f"{path}: cannot be read: {error}") from None
    aliases, imports_api = _decorator_names(tree)
    found = []
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef):
            continue
        for decorator in node.decorator_list:
            called = decorator.func if isinstance(decorator, ast.Call) else decorator
            if kind := aliases.get(ast.unparse(called)):
                found.append((kind, *_name_and_about(path, node, decorator)))
    if imports_api and not found:
        raise SrfError(f"{path}: imports {API} but no law is found", "Decorate a function at the top level.")
    return found


def load_module(location: Path, module: str | None) -> ModuleType:
    """Import a plugin, by module name where an entry point gave one, else from its file; any failure is `SrfError`."""
    try:
        if module:
            return importlib.import_module(module)
        check_plain(location)
        return _from_file(location)
    except SrfError as error:
        raise SrfError(f"{location}: {error.message}", error.hint) from error
    except (Exception, SystemExit) as error:
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(location)]
        at = f", line {lines[-1]}" if lines else ""
        raise SrfError(f"{location}{at}: {type(error).__name__}: {error}", "Mend the plugin or leave it out.") from error


def find_value(entry: Entry) -> Law | Reader:
    """Return the law or reader of an entry from its Python plugin, imported now."""
    for value in vars(load_module(entry.location, entry.module)).values():
        if isinstance(value, Law | Reader) and (kind_of(value), value.name) == (entry.kind, entry.name):
            return value
    raise SrfError(f"{entry.location}: once imported, there is no {_what(entry.kind)} '{entry.name}' in it")


def _from_file(path: Path) -> ModuleType:
    # a name of its own, so that a plugin called numpy.py shadows nothing
    name = f"srf_plugin_{path.stem}_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:12]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise SrfError(f"{path}: cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _decorator_names(tree: ast.Module) -> tuple[dict[str, str], bool]:
    """Return the local names of the decorators, dotted where all of api is imported, and whether it is imported."""
    package, _, module = API.rpartition(".")
    aliases: dict[str, str] = {}
    imports_api = False
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == API:
            imports_api = True
            for item in node.names:
                if item.name in DECORATORS:
                    aliases[item.asname or item.name] = DECORATORS[item.name]
        elif isinstance(node, ast.Import) or (isinstance(node, ast.ImportFrom) and node.module == package):
            whole = API if isinstance(node, ast.Import) else module
            prefixes = [item.asname or item.name for item in node.names if item.name == whole]
            imports_api = imports_api or bool(prefixes)
            aliases |= {f"{prefix}.{name}": kind for prefix in prefixes for name, kind in DECORATORS.items()}
    return aliases, imports_api


def _name_and_about(path: Path, node: ast.FunctionDef, decorator: ast.expr) -> tuple[str, str]:
    words = {k.arg: k.value for k in decorator.keywords} if isinstance(decorator, ast.Call) else {}
    name, about = node.name.replace("_", "-"), (ast.get_docstring(node) or "").split("\n")[0]
    if "name" in words:
        value = words["name"]
        if not isinstance(value, ast.Constant) or not valid_name(value.value):
            raise SrfError(
                f"{path}, line {value.lineno}: name={ast.unparse(value)} is not a kebab-case name in quotes",
                'The listing reads the file without running it: write name="my-law".',
            )
        name = str(value.value)
    if isinstance(words.get("about"), ast.Constant):
        about = str(words["about"].value)  # type: ignore[attr-defined]
    return name, about
