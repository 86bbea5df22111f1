"""Python plugins: found by reading the source, imported only when one of their laws is used."""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from srfcli.errors import SrfError
from srfcli.lawfile import kind_of, valid_name
from srfcli.laws import Law
from srfcli.reader import Reader
from srfcli.reading import check_plain, read_plain

API = "srfcli.api"  # what a plugin imports its decorators from
DECORATORS = {
    "friction_law": "friction",
    "ageing_law": "ageing",
    "modifier": "modifier",
    "interface": "interface",
    "effect": "effect",
    "reader": "reader",
}


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
            kind = aliases.get(_called(decorator))
            if kind:
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
        raise SrfError(
            f"{location}{at}: {type(error).__name__}: {error}", "Mend the plugin or leave it out."
        ) from error


def laws_in(module: ModuleType) -> Iterator[Law]:
    """Yield the law values among a module's attributes."""
    return (value for value in vars(module).values() if isinstance(value, Law))


def find_law(location: Path, module: str | None, kind: str, name: str) -> Law:
    """Return the law of that kind and name from a plugin, imported now."""
    for law in laws_in(load_module(location, module)):
        if kind_of(law) == kind and law.name == name:
            return law
    raise SrfError(f"{location}: once imported, there is no {kind} law '{name}' in it")


def find_reader(location: Path, module: str | None, name: str) -> Reader:
    """Return the reader of that name from a plugin, imported now."""
    for value in vars(load_module(location, module)).values():
        if isinstance(value, Reader) and value.name == name:
            return value
    raise SrfError(f"{location}: once imported, there is no reader '{name}' in it")


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
        elif isinstance(node, ast.ImportFrom) and node.module == package:
            prefixes = [item.asname or item.name for item in node.names if item.name == module]
            imports_api = imports_api or bool(prefixes)
            aliases |= {f"{prefix}.{name}": kind for prefix in prefixes for name, kind in DECORATORS.items()}
        elif isinstance(node, ast.Import):
            prefixes = [item.asname or item.name for item in node.names if item.name == API]
            imports_api = imports_api or bool(prefixes)
            aliases |= {f"{prefix}.{name}": kind for prefix in prefixes for name, kind in DECORATORS.items()}
    return aliases, imports_api


def _called(decorator: ast.expr) -> str:
    return ast.unparse(decorator.func if isinstance(decorator, ast.Call) else decorator)


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
