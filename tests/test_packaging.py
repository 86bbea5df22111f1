"""The wheel: built, installed without the checkout, and run from an empty folder."""

from __future__ import annotations

import csv
import importlib.util
import io
import os
import site
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
import tomli

import srfcli

ROOT = Path(__file__).resolve().parents[1]


def call(*arguments: str | Path, folder: Path, env: dict[str, str] | None = None) -> str:
    """Return what a command prints; an exit code other than 0 fails the test with its stderr."""
    done = subprocess.run(
        [str(a) for a in arguments], cwd=folder, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, f"{arguments}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def clean_environment(**more: str) -> dict[str, str]:
    """Return the environment without settings, and without any path to the checkout."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("SRF_", "PYTHON", "PIP_")) and k != "VIRTUAL_ENV"}
    pip = {k: v for k, v in os.environ.items() if k in ("PIP_INDEX_URL", "PIP_CERT")}
    return {**kept, **pip, **more}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built without the network from a copy of the sources."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "srfcli", "plugins"):
        (source / name).symlink_to(ROOT / name)
    python = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    call(*python, "-w", folder, source, folder=folder, env=clean_environment())
    (made,) = folder.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of an environment that has the wheel, and this environment's libraries but not its checkout."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    venv.create(folder, with_pip=False)
    target = next(folder.glob("lib/python*/site-packages"))
    scripts = folder / "bin"
    install = [sys.executable, "-m", "pip", "--python", scripts / "python", "--disable-pip-version-check", "install"]
    call(*install, "--no-deps", "--no-index", wheel, folder=folder, env=clean_environment())
    libraries = [p for p in (*site.getsitepackages(), site.getusersitepackages()) if Path(p).is_dir()]
    # sys.path alone: addsitedir would follow the .pth file of an editable install back to the checkout
    (target / "libraries.pth").write_text("".join(f"{p}\n" for p in libraries), encoding="utf-8")
    return scripts


@pytest.fixture
def run(installed: Path, tmp_path: Path):  # type: ignore[no-untyped-def]
    """`run("laws")`: what the installed `srf` prints in an empty folder."""
    empty = tmp_path / "empty"
    empty.mkdir()
    env = clean_environment(SRF_CACHE=str(tmp_path / "cache"), XDG_DATA_HOME=str(tmp_path / "data"))
    return lambda *arguments: call(installed / "srf", *arguments, folder=empty, env=env)


def in_tree(*arguments: str, folder: Path) -> str:
    """Return what the checkout's `srf` prints."""
    env = clean_environment(PYTHONPATH=str(ROOT))
    return call(sys.executable, "-m", "srfcli.cli.main", *arguments, folder=folder, env=env)


def test_the_wheel_holds_plugins_and_data(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    plugins = {f"srfcli/plugins/{p.relative_to(ROOT / 'plugins')}" for p in (ROOT / "plugins").rglob("*.toml")}
    data = {f"srfcli/{p.relative_to(ROOT / 'srfcli')}" for p in (ROOT / "srfcli").rglob("*.toml")}
    assert plugins and data and plugins | data <= names
    strangers = {n.split("/")[0] for n in names} - {"srfcli"}
    assert all(n.endswith(".dist-info") for n in strangers), strangers
    assert not [n for n in names if "__pycache__" in n]


def test_nothing_comes_from_the_checkout(installed: Path, tmp_path: Path) -> None:
    where = call(installed / "python", "-c", "import srfcli; print(srfcli.__file__)", folder=tmp_path, env=clean_environment())
    assert Path(where.strip()).is_relative_to(installed.parent)


def test_laws_are_found_in_site_packages(run, installed: Path) -> None:  # type: ignore[no-untyped-def]
    lines = run("laws").splitlines()[1:]
    assert len(lines) == len(list((ROOT / "plugins").rglob("*.toml")))
    for line in lines:
        assert Path(line.split()[-1]).is_relative_to(installed.parent), line


@pytest.mark.parametrize(
    "arguments",
    [("linear", "--over", "V=10,20", "--csv"), ("critical", "--eps", "0.09", "--V", "7", "--csv")],
    ids=lambda a: a[0],
)
def test_numbers_are_those_of_the_checkout(run, arguments: tuple[str, ...], tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    names = ("V", "K_over_W0", "W0")
    here, there = (list(csv.DictReader(io.StringIO(text))) for text in (run(*arguments), in_tree(*arguments, folder=tmp_path)))
    assert len(here) == len(there) > 0
    for one, other in zip(here, there, strict=True):
        assert [float(one[n]) for n in names] == pytest.approx([float(other[n]) for n in names], rel=1e-10)


def test_a_new_law_and_the_paper(run) -> None:  # type: ignore[no-untyped-def]
    assert run("law", "new", "x").strip() == "x.toml"
    assert all(line.startswith("ok") for line in run("law", "check", "x.toml").splitlines())
    assert "agree" in run("derive", "--check-paper").splitlines()[0]


def test_what_is_required_is_written_down() -> None:
    project = tomli.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
    extras = [r for name in project["optional-dependencies"] for r in project["optional-dependencies"][name]]
    for requirement in (*project["dependencies"], *extras):
        name = requirement.split(">")[0].split("[")[0]
        assert name == "srfcli" or f"| {name} |" in text, name


def test_the_citation_names_this_version_and_the_paper() -> None:
    """CITATION.cff has what version 1.2.0 of its format asks for; cffconvert, where it is installed, validates all of it."""
    yaml = pytest.importorskip("yaml", reason="CITATION NOT READ: PyYAML is not installed; it comes with the extra docs")
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["cff-version"] == "1.2.0" and {"message", "title", "authors"} <= set(cited)
    assert cited["version"] == srfcli.__version__ and cited["license"] == "MIT"
    paper = cited["preferred-citation"]
    assert {"type", "title", "authors"} <= set(paper) and (paper["volume"], paper["start"], paper["year"]) == (70, 220, 2003)
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert paper["title"] in readme and paper["journal"] in readme
    if importlib.util.find_spec("cffconvert"):
        code = "import cffconvert, sys; cffconvert.Citation(sys.stdin.read()).validate()"
        subprocess.run([sys.executable, "-c", code], input=(ROOT / "CITATION.cff").read_text(), text=True, check=True)


def test_classifiers_exist() -> None:
    known = pytest.importorskip("trove_classifiers")  # comes with hatchling
    project = tomli.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(project["classifiers"]) <= known.classifiers
