"""README and docs hold: every ```console command runs in an empty folder, and prints what is shown below it.

Commands see the extras that README installs and no others; a page that needs more says so: `<!-- extras: sample -->`.
`srf` starts anew for each command of README; for those of docs/ a process that holds its modules forks (srf_server.py).
Before a block, `<!-- digits: 2 -->` says how far its numbers are compared, `<!-- slow -->` that it runs with --runslow alone.
"""

from __future__ import annotations

import math
import os
import re
import shlex
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import tomli

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
NUMBER = re.compile(r"[-+]?(?:\d+\.\d*|\.\d+|\d+)(?:[eE][-+]?\d+)?")
RTOL, ROUNDING = 3e-6, 1e-6  # six digits; below 1e-6 stand estimated errors and residuals, whose digits are chance


@dataclass
class Example:
    """A command and the lines that are shown below it; the line `...` stands for any lines."""

    command: str
    shown: list[str] = field(default_factory=list)
    rtol: float = RTOL
    slow: bool = False


def examples(path: Path) -> list[Example]:
    """Return the examples of a document in their order, from its ```console blocks."""
    found: list[Example] = []
    blocks = re.findall(r"((?:^<!-- [^\n]* -->\n)*)^ *```console\n(.*?)^ *```", path.read_text(encoding="utf-8"), re.M | re.S)
    for marks, block in blocks:
        begun = False
        digits = re.search(r"<!-- digits: (\d+) -->", marks)
        rtol = 10.0 ** -int(digits[1]) if digits else RTOL
        for line in textwrap.dedent(block).splitlines():
            if line.startswith("$ "):
                found.append(Example(line[2:], rtol=rtol, slow="<!-- slow -->" in marks))
                begun = True
            else:
                assert begun, f"{path.name}: {line!r} stands before any command"
                found[-1].shown.append(line)
    return found


def same(shown: str, printed: str, rtol: float = RTOL) -> bool:
    """Whether a printed line is the shown one: equal words, numbers to `rtol`, `...` at the end for any rest."""
    left, right = shown.split(), printed.split()
    if left and left[-1] == "...":
        left = left[:-1]
        right = right[: len(left)]
    return len(left) == len(right) and all(same_word(a, b, rtol) for a, b in zip(left, right, strict=True))


def same_word(shown: str, printed: str, rtol: float) -> bool:
    if NUMBER.sub("#", shown) != NUMBER.sub("#", printed):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(same_number(float(a), float(b), rtol) for a, b in pairs)


def same_number(a: float, b: float, rtol: float) -> bool:
    return math.isclose(a, b, rel_tol=rtol) or (rtol == RTOL and max(abs(a), abs(b)) < ROUNDING)


def missing(shown: list[str], printed: list[str], rtol: float = RTOL) -> str | None:
    """Return the first shown line that is not printed where it should be, or None."""
    place, skipping = 0, False
    for line in shown:
        if line.strip() == "...":
            skipping = True
            continue
        if skipping:
            place = next((i for i in range(place, len(printed)) if same(line, printed[i], rtol)), len(printed))
        if place >= len(printed) or not same(line, printed[place], rtol):
            return f"shown:   {line}\nprinted: {printed[place] if place < len(printed) else '(nothing more)'}"
        place, skipping = place + 1, False
    if shown and not skipping and place < len(printed):
        return f"printed, not shown: {printed[place]}"
    return None


def packages(extras: set[str]) -> set[str]:
    """Return the libraries that some extras of pyproject.toml bring."""
    table = tomli.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    found: set[str] = set()
    for requirement in (r for extra in extras for r in table[extra]):
        inner = re.match(r"srfcli\[(.*)\]", requirement)
        found |= packages(set(inner[1].split(","))) if inner else {re.split(r"[\[<>=]", requirement)[0]}
    return found


def hidden(text: str) -> set[str]:
    """Return the libraries of extras that neither README installs nor a page says it needs."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    said = ",".join(re.findall(r'pip install -q "\.\[(.*?)\]"', readme) + re.findall(r"<!-- extras: (.*?) -->", text))
    known = packages(set(re.findall(r"\w+", said)))
    return {name.replace("-", "_") for name in packages({"all", "arviz", "cluster", "frames", "hdf5", "tdms"}) - known}


HIDE = """
import importlib.machinery, sys

class Installed(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in {hidden!r} else super().find_spec(name, path, target)

sys.meta_path = [Installed if finder is importlib.machinery.PathFinder else finder for finder in sys.meta_path]
"""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """An environment with `srf` on PATH, no settings of the caller and folders of its own."""
    shim = tmp_path / "bin" / "srf"
    shim.parent.mkdir()
    shim.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m srfcli.cli.main "$@"\n', encoding="utf-8")
    shim.chmod(0o755)
    kept = {k: v for k, v in os.environ.items() if not k.startswith("SRF_") or k == "SRF_CACHE"}
    paths = os.pathsep.join([str(tmp_path / "bin"), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    path = os.pathsep.join([str(shim.parent), str(Path(sys.executable).parent), os.environ["PATH"]])
    return {**kept, "PATH": path, "PYTHONPATH": paths, "XDG_DATA_HOME": str(tmp_path / "data"), "COLUMNS": "100"}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[set[str]], str]]:
    """Return the shim of an `srf` that sees some libraries as absent; its server runs until the last test has ended."""
    shims: dict[frozenset[str], str] = {}

    def shim(names: set[str]) -> str:
        key = frozenset(names)
        if key not in shims:
            folder = tmp_path_factory.mktemp("srf")
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
            hide(names, environment)
            server, place = str(ROOT / "tests" / "srf_server.py"), str(folder / "s")
            process = subprocess.Popen(
                [sys.executable, server, place], env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
            running.callback(process.communicate)  # its standard input ends
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            shims[key] = f'#!/bin/sh\nexec {shlex.join([sys.executable, "-IS", server, place])} "$@"\n'
        return shims[key]

    with ExitStack() as running:
        yield shim


def hide(names: set[str], environment: Mapping[str, str]) -> None:
    """Make libraries look as if they were not installed to every Python of this environment."""
    folder = Path(environment["PYTHONPATH"].partition(os.pathsep)[0])
    (folder / "sitecustomize.py").write_text(HIDE.format(hidden=names), encoding="utf-8")


@pytest.mark.parametrize("path", [p for p in DOCUMENTS if examples(p)], ids=lambda p: p.name)
def test_commands_print_what_is_shown(
    path: Path, environment: dict[str, str], served: Callable[[set[str]], str], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    (folder / "examples").symlink_to(ROOT / "examples")
    names = hidden(path.read_text(encoding="utf-8"))
    hide(names, environment)
    if path.name != "README.md":
        (tmp_path / "bin" / "srf").write_text(served(names), encoding="utf-8")
    for example in examples(path):
        if example.slow and not request.config.getoption("--runslow"):
            continue
        done = subprocess.run(
            ["bash", "-c", f"set -o pipefail; {example.command}"],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"$ {example.command}\n{done.stderr}"
        assert "Traceback" not in done.stderr
        fault = missing(example.shown, done.stdout.splitlines(), example.rtol)
        assert fault is None, f"{path.name}: $ {example.command}\n{fault}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.name)
def test_every_prompt_is_an_example(path: Path) -> None:
    """What stands behind a prompt is run, whatever block it stands in."""
    text = path.read_text(encoding="utf-8")
    assert [e.command for e in examples(path)] == re.findall(r"^ *\$ (.*)$", text, re.M)


def test_commands_see_no_library_that_readme_does_not_install(environment: dict[str, str]) -> None:
    names = hidden("")
    assert {"pint", "emcee", "pandas"} <= names and "matplotlib" not in names
    assert "pint" not in hidden("<!-- extras: units -->")
    hide(names, environment)
    code = "import importlib.util as u; print(u.find_spec('pint'), u.find_spec('click') is None)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["None", "False"]


def test_a_law_of_ones_own_takes_three_commands() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    story = text.partition("### From nothing to your own law")[2].partition("\n## ")[0]
    commands = [line[2:] for line in story.splitlines() if line.startswith("$ ")]
    assert [c.split()[:3] for c in commands] == [["srf", "law", "new"], ["srf", "law", "check"], ["srf", "continue", "--plugins"]]


@pytest.mark.parametrize("marker", ["diagram-command", "test-command"])
def test_each_installation_is_one_line(marker: str) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.findall(rf"<!-- {marker} -->\n```sh\n([^\n]+)\n```\n<!-- /{marker} -->", text)
    assert len(found) == 1 and found[0].startswith("python3 -m venv .venv && ")


def test_readme_is_one_page_with_a_picture() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    (picture,) = re.findall(r"!\[[^]]+\]\((.*?)\)", text)
    assert 0 < (ROOT / picture).stat().st_size < 100_000


def test_ci_runs_the_line_in_readme() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "<!-- test-command -->" in script and "pip install" not in script and "pytest" not in script


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: p.name)
def test_links_lead_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8")):
        assert "://" in target or (path.parent / target).exists(), target


def test_commands_shown_in_other_blocks_exist() -> None:
    from srfcli.cli.main import COMMANDS

    for path in DOCUMENTS:
        for name in re.findall(r"`srf ([a-z]+)", path.read_text(encoding="utf-8")):
            assert name in COMMANDS, f"{path.name}: srf {name}"


@pytest.mark.parametrize(
    ("shown", "printed", "equal"),
    [
        ("a  1.00000001 b", "a 1.0 b", True),
        ("1.0001,x", "1.0,x", False),
        ("error 9e-09", "error 2e-12", True),
        ("one ...", "one two three", True),
        ("one two", "one two three", False),
    ],
)
def test_the_comparison(shown: str, printed: str, equal: bool) -> None:
    assert same(shown, printed) is equal
