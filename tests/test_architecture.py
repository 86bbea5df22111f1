"""The arrows of docs/architecture.md, light imports, docstrings of files, and commands that are documented."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from srfcli.cli.main import cli

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "srfcli"
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if "data" not in p.parts)  # there lies generated text

# each module and what it may import of the package, also inside functions; a folder stands for all that is in it
BASE = {"errors", "status", "reading", "atomic"}
LAWS = BASE | {"laws", "reader"}
LAW_FILES = LAWS | {"expression", "dimensions", "lawfile", "effectfile", "pylaw"}
SYMBOLS = LAW_FILES | {"registry", "system", "equations", "derive", "closed_limits"}
MAY: dict[str, set[str]] = {
    "errors": set(),
    "status": set(),
    "reading": {"errors"},
    "atomic": {"errors", "reading"},
    "units": BASE,
    "expression": BASE,
    "laws": BASE | {"expression"},
    "reader": set(),
    "dimensions": BASE,
    "lawfile": LAWS | {"expression", "dimensions"},
    "effectfile": LAWS | {"expression", "dimensions", "lawfile"},
    "lawtemplate": BASE,
    "pylaw": LAW_FILES,
    "prebuilt": set(),
    "registry": LAW_FILES | {"prebuilt"},
    "api": LAW_FILES,
    "checking": LAW_FILES,
    "lawcheck": LAW_FILES | {"registry", "checking", "effectcheck"},
    "effectcheck": SYMBOLS | {"checking", "generate_motion", "model"},
    "notation": {"expression"},
    "staged": set(),
    "system": LAWS | {"expression", "registry"},
    "equations": LAWS | {"expression", "system"},
    "derive": LAWS | {"expression", "system", "equations"},
    "closed_limits": LAWS | {"expression", "system", "derive"},
    "numpytext": {"expression"},
    "generate": SYMBOLS | {"numpytext", "staged"},
    "generate_motion": SYMBOLS | {"generate", "numpytext", "staged"},
    "splines": set(),
    "cache": {"errors", "reading"},
    "model": SYMBOLS | {"generate", "generate_motion", "cache", "prebuilt", "units"},
    "derivation": SYMBOLS | {"notation", "units"},
    "paper_forms": SYMBOLS,
    "paper": SYMBOLS | {"paper_forms", "units"},
    "render": SYMBOLS | {"derivation", "notation", "numpytext", "paper"},
    "settings": LAWS | {"units"},
    "recording": LAW_FILES | {"registry", "units", "numerics", "splines", "system"},
    "numerics": BASE | {"cache", "model", "numerics", "splines"},
    "inference": LAW_FILES | {"registry", "recording", "system", "model", "numerics", "settings", "splines", "units"},
    "diagnosis": LAW_FILES | {"registry", "recording", "system", "model", "numerics", "inference", "splines", "units"},
    "output": LAWS | {"output"},
    "results": BASE | {"model", "numerics", "output", "recording", "inference", "units", "tasks", "settings"},
    "tasks": LAWS
    | {
        "registry",
        "model",
        "numerics",
        "recording",
        "inference",
        "diagnosis",
        "results",
        "settings",
        "splines",
        "units",
    },
    "parallel": BASE | {"cache", "output"},
    "trial": BASE | {"registry", "recording", "diagnosis", "model", "output", "parallel", "proof"},
    # shares no equation and no integrator with what it is to prove
    "proof": {"errors", "output", "parallel", "reading", "atomic"},
}
HEAVY = {"sympy", "scipy", "numpy", "matplotlib", "pint", "numba"}
FORBIDDEN = {
    "numerics": {"sympy", "click", "rich"},
    "output": {"sympy", "scipy", "click"},
    "proof": {"sympy", "click", "rich"},
    "model": {"sympy"},
    "settings": HEAVY,
    "registry": HEAVY,
}


def unit_of(path: Path) -> str:
    """Return the name in MAY that a module goes by: its own, or that of its folder."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return parts[0]


def imports(path: Path, *, top_only: bool = False) -> Iterator[str]:
    """Yield the dotted names that a module imports; those inside functions, too, unless `top_only`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = tree.body if top_only else list(ast.walk(tree))
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            module = node.module or ""
            yield module
            if module == "srfcli":
                yield from (f"srfcli.{alias.name}" for alias in node.names)


def typing_only(path: Path) -> set[str]:
    """Return what a module imports under TYPE_CHECKING: no arrow at run time."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            found |= {n.module for n in ast.walk(node) if isinstance(n, ast.ImportFrom) and n.module}
    return found


def inside(path: Path) -> set[str]:
    """Return the parts of the package that a module imports."""
    return {name.split(".")[1] for name in set(imports(path)) - typing_only(path) if name.startswith("srfcli.")}


def test_arrows() -> None:
    known, wrong = {unit_of(p) for p in MODULES}, []
    for path in MODULES:
        unit = unit_of(path)
        if unit in ("cli", "__init__", "__main__"):
            continue
        assert unit in MAY, f"srfcli/{unit} has no line in MAY: say what it may import"
        roots = {name.split(".")[0] for name in set(imports(path)) - typing_only(path)}
        against = (inside(path) & known) - MAY[unit] - {unit} | roots & FORBIDDEN.get(unit, set())
        wrong += [f"{path.relative_to(ROOT)} imports {name}" for name in sorted(against)]
    assert not wrong


def test_nobody_imports_the_command_line() -> None:
    for path in MODULES:
        if unit_of(path) not in ("cli", "__main__"):
            assert not [n for n in imports(path) if n.startswith("srfcli.cli")], path


def test_laws_import_nothing_above_them() -> None:
    above = {"system", "derive", "generate", "model", "numerics", "output", "cli"}
    for name in ("errors", "status", "expression", "laws", "lawfile", "dimensions", "pylaw", "registry", "api"):
        assert not MAY[name] & above
        assert not inside(PACKAGE / f"{name}.py") & above


def test_files_say_what_they_are() -> None:
    silent = [p for p in MODULES if not ast.get_docstring(ast.parse(p.read_text(encoding="utf-8")))]
    assert not silent


def test_command_modules_are_light() -> None:
    for path in [*(PACKAGE / "cli").glob("*.py"), PACKAGE / "lawfile.py"]:
        roots = {name.split(".")[0] for name in imports(path, top_only=True)}
        assert not roots & HEAVY, path


def test_importing_the_package_does_no_work(tmp_path: Path) -> None:
    modules = [".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for p in MODULES]
    script = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
import importlib
for name in {modules!r}:
    importlib.import_module(name)
late = sorted({{"matplotlib", "pint", "numba", "IPython"}} & set(sys.modules))
print(late)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
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
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
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
    section = (
        (ROOT / "docs" / "cli.md").read_text(encoding="utf-8").partition(f"\n## `{name}`\n")[2].partition("\n## ")[0]
    )
    assert f"\n$ {name}" in section or f" {name} " in section, f"docs/cli.md has no section with an example of {name}"


@pytest.mark.parametrize(("name", "command"), list(commands()), ids=lambda v: v if isinstance(v, str) else "")
def test_documented_options_exist(name: str, command: click.Command) -> None:
    import re

    text = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    section = text.partition(f"\n## `{name}`\n")[2].partition("\n## ")[0]
    known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help"}
    prose = re.sub(r"```.*?```", "", section, flags=re.S)
    assert set(re.findall(r"`(--[\w-]+)", prose)) <= known


def test_the_list_of_commands_says_what_they_say() -> None:
    from srfcli.cli.main import COMMANDS

    for name, (place, sentence) in COMMANDS.items():
        module, _, attribute = place.partition(":")
        command = getattr(importlib.import_module(module), attribute)
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
    own = {{place.partition(":")[0] for place, _ in COMMANDS.values()}}
    print(sorted(own & set(sys.modules)), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr.strip()) == (0, "['srfcli.cli.linear']")


def test_the_map_names_every_module() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    for name in ("errors", "status", "expression", "laws", "registry", "system", "derive", "generate", "model"):
        assert f"`{name}.py`" in text
