"""The rules of docs/architecture.md, one test each; light imports, docstrings of files, and commands that are documented."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import click
import pytest

from srfcli.cli import options
from srfcli.cli import prove as cli_prove
from srfcli.cli import system as cli_system
from srfcli.cli.main import COMMANDS, cli
from srfcli.core.errors import SrfError
from srfcli.symbolic import derivation, system
from srfcli.validation import cases

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "srfcli"
MAP = ROOT / "docs" / "architecture.md"

# a folder imports from folders before it alone
ORDER = (
    "core", "laws", "symbolic", "codegen", "motion", "numerics", "data", "inference", "diagnosis",
    "results", "tasks", "validation", "cli",
)  # fmt: skip
# folders that keep to fewer than stand before them
NOTHING_BUT = {"numerics": {"core", "codegen", "motion"}, "motion": {"core", "codegen"}}
HEAVY = {"sympy", "scipy", "numpy", "matplotlib", "pint", "numba"}
# libraries that a folder or a file leaves to others, also inside functions
WITHOUT = {
    "motion": {"sympy", "click", "rich"},
    "numerics": {"sympy", "click", "rich"},
    "results": {"sympy", "scipy", "click"},
    "validation/slider.py": {"sympy", "click", "rich"},
    "validation/cases.py": {"sympy", "click", "rich"},
    "codegen/model.py": {"sympy"},
    "core/settings.py": HEAVY,
    "laws/registry.py": HEAVY,
}
# the generator of concealed cases, and the one folder that it may share with the rest
GENERATOR = {f"srfcli.validation.{name}" for name in ("slider", "gauge", "apparatus", "cases")}
BEHIND_THE_WALL = "core"


def is_typing(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


@cache
def parsed(path: Path) -> ast.Module:
    """Return what stands in a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path, *, top_only: bool = False, typing: bool = True) -> Iterator[str]:
    """Yield the dotted names that a file imports; those inside functions and those for types alone, too, unless told."""
    tree = parsed(path)
    typed = {id(n) for block in ast.walk(tree) if is_typing(block) for n in ast.walk(block)}
    for node in tree.body if top_only else ast.walk(tree):
        if id(node) in typed and not typing:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@cache
def files() -> dict[str, Path]:
    """Return every file of the package by its dotted name."""
    own = [p for p in sorted(PACKAGE.rglob("*.py")) if (p.parent / "__init__.py").is_file()]  # other folders hold data
    named = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in own}
    return {name.removesuffix(".__init__"): path for name, path in named.items()}


@cache
def arrows(*, typing: bool = True) -> dict[str, set[str]]:
    """Return the files that each file imports, whether at its top, inside a function or for types alone."""
    known = files()
    found: dict[str, set[str]] = {}
    for name, path in known.items():
        wanted = {n if n in known else n.rpartition(".")[0] for n in imports(path, typing=typing)}
        found[name] = (wanted & set(known)) - {name}
    return found


def folder(name: str) -> str:
    """Return the folder below srfcli/ that a file stands in, '' for those at the top."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and (PACKAGE / parts[1]).is_dir() else ""


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of files that reach each other."""
    left = {name: set(to) for name, to in graph.items()}
    while free := [name for name, to in left.items() if not to & left.keys()]:  # what imports nothing that is left
        for name in free:
            del left[name]
    while free := [name for name in left if not any(name in to for to in left.values())]:  # what nothing imports
        for name in free:
            del left[name]
    return [sorted(left)] if left else []


def test_no_files_import_each_other_in_a_circle() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [["b", "c"]]
    assert not circles(arrows())


def test_folders_depend_one_way() -> None:
    wrong = []
    for name, to in arrows().items():
        own = folder(name)
        if not own:
            continue
        may = NOTHING_BUT.get(own, set(ORDER[: ORDER.index(own)])) | {own, ""}
        wrong += [f"{name} imports {other}" for other in sorted(to) if folder(other) not in may]
    assert not wrong


def test_every_folder_has_its_place() -> None:
    found = {p.name for p in PACKAGE.iterdir() if p.is_dir() and any(p.rglob("*.py")) and p.name != "plugins"}
    assert found <= set(ORDER)


def test_no_module_stands_loose_at_the_top() -> None:
    assert {p.name for p in PACKAGE.glob("*.py")} <= {"__init__.py", "__main__.py"}


def test_the_generator_imports_nothing_of_the_solver() -> None:
    """Concealed cases prove nothing if they share an equation or an integrator with what is to find them."""
    assert set(files()) >= GENERATOR
    wrong = [
        f"{name} imports {other}"
        for name, to in arrows().items()
        if name in GENERATOR
        for other in sorted(to)
        if folder(other) != BEHIND_THE_WALL and other not in GENERATOR
    ]
    assert not wrong


def test_only_validation_sees_what_is_concealed() -> None:
    for name, to in arrows().items():
        if folder(name) not in ("", "validation", "cli"):  # the top names `prove`, and imports it when it is asked for
            assert not [n for n in to if n.startswith("srfcli.validation")], name


def test_libraries_are_left_to_those_that_need_them() -> None:
    wrong = []
    for place, names in WITHOUT.items():
        where = PACKAGE / place
        assert where.exists(), f"srfcli/{place} is gone: mend WITHOUT"
        for path in [where] if where.is_file() else sorted(where.rglob("*.py")):
            found = {n.split(".")[0] for n in imports(path, typing=False)} & names
            wrong += [f"{path.relative_to(ROOT)} imports {name}" for name in sorted(found)]
    assert not wrong


def test_files_say_what_they_are() -> None:
    assert not [n for n, p in files().items() if not ast.get_docstring(parsed(p))]


def numbers(path: Path) -> Iterator[tuple[str, object]]:
    """Yield the constants of a file that are numbers, or tuples of numbers, by their names."""
    for node in parsed(path).body:
        if not isinstance(node, ast.Assign):
            continue
        (target,) = node.targets
        names = target.elts if isinstance(target, ast.Tuple) else [target]
        try:
            value = ast.literal_eval(node.value)
        except ValueError:
            continue
        for name, own in zip(names, value if isinstance(target, ast.Tuple) else [value], strict=True):
            parts = own if isinstance(own, tuple) else (own,)
            if isinstance(name, ast.Name) and all(isinstance(x, int | float) for x in parts):
                yield name.id, own


def test_a_constant_means_the_same_everywhere() -> None:
    """A number has one name in one file, from which others import it."""
    found: dict[str, list[str]] = {}
    for module, path in files().items():
        for name, _ in numbers(path):
            found.setdefault(name, []).append(module)
    assert len(found) > 300 and not {name: places for name, places in found.items() if len(places) > 1}


def test_choices_of_light_commands_are_those_of_what_they_import_late() -> None:
    assert options.LOADINGS == system.LOADINGS
    assert cli_system.LONG_PARTS == derivation.EXTRAS
    assert (cli_prove.CASE_KINDS, cli_prove.BANKS) == (cases.WIDE_KINDS, cases.BANKS)
    assert set(cli_prove.TRACK_KINDS) == set(cases.TRACKS)


def test_constants_in_the_docs_are_those_of_the_code() -> None:
    known = {name: value for path in files().values() for name, value in numbers(path)}
    for path in PACKAGE.rglob("*.c"):
        defined = re.findall(r"(?m)^#define ([A-Z][A-Z_]+) ([\d.e-]*\d)", path.read_text(encoding="utf-8"))
        known |= {name: float(value) for name, value in defined}
    quoted = {
        (page.name, name, float(value))
        for page in (ROOT / "docs").rglob("*.md")
        for name, value in re.findall(r"`([A-Z][A-Z_]+)` = ([\d.e-]*\d)", page.read_text(encoding="utf-8"))
    }
    assert len(quoted) > 20 and not [q for q in sorted(quoted) if known.get(q[1]) != q[2]]


def test_command_modules_are_light() -> None:
    for path in [*(PACKAGE / "cli").glob("*.py"), PACKAGE / "laws" / "law_file.py"]:
        roots = {name.split(".")[0] for name in imports(path, top_only=True)}
        assert not roots & HEAVY, path


def test_importing_the_package_does_no_work(tmp_path: Path) -> None:
    names = [n for n in files() if not n.endswith("__main__")]
    script = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
import importlib
for name in {names!r}:
    importlib.import_module(name)
late = sorted({{"matplotlib", "pint", "numba", "IPython"}} & set(sys.modules))
print(late)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (done.stdout.strip(), done.stderr) == ("[]", "")  # nothing is printed, nothing heavy comes along
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [["--help"], ["linear", "--help"], ["continue", "--help"], ["--version"]])
def test_help_is_light(arguments: list[str], tmp_path: Path) -> None:
    script = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from srfcli.cli.main import main
try:
    main({arguments!r})
finally:
    print(sorted({HEAVY!r} & set(sys.modules)), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr.strip()) == (0, "[]")


def commands(group: click.Group = cli, path: str = "srf") -> Iterator[tuple[str, click.Command]]:
    """Yield the full name of every command, and the command."""
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, f"{path} {name}")
        else:
            yield f"{path} {name}", command


@pytest.mark.parametrize(("name", "command"), list(commands()), ids=lambda v: v if isinstance(v, str) else "")
def test_every_command_is_documented(name: str, command: click.Command) -> None:
    assert command.help and command.help.strip()
    assert name in (command.epilog or ""), f"{name} --help shows no example of it"
    for option in command.params:
        assert not isinstance(option, click.Option) or option.help, f"{name} {option.name}"
    assert f"`{name}`" in (ROOT / "README.md").read_text(encoding="utf-8")
    section = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8").partition(f"\n## `{name}`\n")[2].partition("\n## ")[0]
    assert re.search(rf"^(\$ )?{name} | {name} ", section, re.M), f"docs/cli.md has no section with an example of {name}"


@pytest.mark.parametrize(("name", "command"), list(commands()), ids=lambda v: v if isinstance(v, str) else "")
def test_documented_options_exist(name: str, command: click.Command) -> None:
    text = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    section = text.partition(f"\n## `{name}`\n")[2].partition("\n## ")[0]
    known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help"}
    prose = re.sub(r"```.*?```", "", section, flags=re.S)
    assert set(re.findall(r"`(--[\w-]+)", prose)) <= known


def shown_commands() -> list[tuple[str, list[str]]]:
    """Return the commands in the documents' blocks that no test runs, each with its page."""
    found = []
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for block in re.findall(r"^```sh\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S):
            for line in block.replace("\\\n", " ").splitlines():
                for part in re.split(r" \| | && ", line):
                    words = shlex.split(part, comments=True)
                    if words[:1] == ["srf"] and words[1:] != ["--version"]:
                        found.append((path.name, words[1:]))
    return found


def test_commands_that_are_shown_but_not_run_are_read() -> None:
    """Names of commands and options exist, and values are of their kind; files need not be there."""
    shown = shown_commands()
    assert len(shown) > 10
    for page, words in shown:
        command: click.Command = cli
        while isinstance(command, click.Group):
            found = command.get_command(click.Context(command), words[0])
            assert found is not None, f"{page}: srf {words[0]}"
            command, words = found, words[1:]
        try:
            command.make_context(command.name, list(words))
        except click.UsageError as error:
            pytest.fail(f"{page}: srf {shlex.join(words)}: {error.message}")
        except SrfError as error:
            assert "no such" not in error.message, f"{page}: {error.message}"


def test_the_list_of_commands_says_what_they_say() -> None:
    for name, (place, sentence) in COMMANDS.items():
        module, _, attribute = place.partition(":")
        command = getattr(importlib.import_module(f"srfcli.cli.{module}"), attribute)
        assert isinstance(command, click.Command)
        assert sentence == command.get_short_help_str(limit=1000), name


def test_a_command_imports_no_other(tmp_path: Path) -> None:
    script = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from srfcli.cli.main import COMMANDS, main
try:
    main(["linear", "--help"])
finally:
    own = {{f"srfcli.cli.{{place.partition(':')[0]}}" for place, _ in COMMANDS.values()}}
    print(sorted(own & set(sys.modules)), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr.strip()) == (0, "['srfcli.cli.stability']")


def test_the_map_names_every_folder_and_only_files_that_are() -> None:
    text = MAP.read_text(encoding="utf-8")
    folders = {folder(name) for name in files()} - {""}
    assert not [f for f in folders if f"`{f}/`" not in text]
    named = set(re.findall(r"`([a-z_]+(?:/[a-z_]+)+\.(?:py|c|toml))", text))
    assert named and not [n for n in sorted(named) if not ((PACKAGE / n).is_file() or (ROOT / n).is_file())]


def test_the_ways_through_the_code_are_ways() -> None:
    """Each hop of a way on the map is a function of the file that it names, and there are ten or fewer."""
    ways = re.findall(r"^## The way of .*?(?=^## |\Z)", MAP.read_text(encoding="utf-8"), re.M | re.S)
    assert len(ways) == 2
    for way in ways:
        hops = re.findall(r"^\d+\. `([\w/]+\.py)` `(\w+)`", way, re.M)
        assert 3 < len(hops) <= 10 and len(hops) == len(re.findall(r"^\d+\. ", way, re.M))
        for file, name in hops:
            defined = (n for n in ast.walk(parsed(PACKAGE / file)) if isinstance(n, ast.FunctionDef | ast.ClassDef))
            assert name in {n.name for n in defined}, (file, name)
