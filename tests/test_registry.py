"""Where laws are found, and what broken, duplicate and foreign sources may do."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from srfcli.core.errors import SrfError
from srfcli.laws.registry import Registry, bundled_folder, load_registry

AGEING = """format = "srf-law/1"
kind = "ageing"
about = "{about}"
rate = "1 - v*phi/D0"
"""
PYTHON = """\
from srfcli.laws.api import Parameter, ageing_law
from pathlib import Path
Path({marker!r}).write_text("imported")

@ageing_law(name="{name}", parameters=[Parameter("n", 1.0)], about="from Python")
def whatever(v, phi, p):
    return 1 - (v * phi / p.D0) ** p.n
"""


@pytest.fixture(autouse=True)
def no_user_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SRF_DATA", str(tmp_path / "absent"))
    monkeypatch.delenv("SRF_PLUGINS", raising=False)


def folder(tmp_path: Path, name: str, **files: str) -> Path:
    """Make a folder of files; a double underscore in a key is a slash, a final _py or _toml the suffix."""
    place = tmp_path / name
    for key, text in files.items():
        stem, _, suffix = key.rpartition("_")
        path = place / (stem.replace("__", "/").replace("_", "-") + "." + suffix)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return place


def names(registry: Registry, origin: str) -> list[str]:
    return [e.name for e in registry.entries() if e.origin == origin]


def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str, **files: str) -> None:
    """Make an installed distribution with an entry point in the group srf.laws, importable in this process."""
    site = folder(tmp_path, "site", **files)
    info = site / "stranger-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[srf.laws]\nstranger = {value}\n")
    monkeypatch.syspath_prepend(str(site))


def test_listing_imports_neither_sympy_nor_a_plugin(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    place = folder(tmp_path, "mine", slow_py=PYTHON.format(marker=str(marker), name="slow"))
    code = (
        "import sys; from pathlib import Path; from srfcli.laws.registry import load_registry; "
        f"r = load_registry([Path({str(place)!r})]); assert any(e.name == 'slow' for e in r.entries('ageing')); "
        "assert all(r.fingerprint(e) for e in r.entries()); "
        "print([m for m in ('sympy', 'numpy', 'scipy', 'srfcli.laws.api') if m in sys.modules])"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.stdout.strip() == "[]", done.stderr
    assert not marker.exists()


def test_every_source_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    user = folder(tmp_path, "user", ageing__from_user_toml=AGEING)
    environment = folder(tmp_path, "env", from_env_toml=AGEING)
    asked = folder(tmp_path, "asked", from_flag_toml=AGEING, _hidden_toml="not TOML")
    monkeypatch.setenv("SRF_DATA", str(user))
    monkeypatch.setenv("SRF_PLUGINS", str(environment))
    registry = load_registry([asked])
    assert names(registry, "user") == ["from-user"]
    assert names(registry, "SRF_PLUGINS") == ["from-env"]
    assert names(registry, "--plugins") == ["from-flag"]
    assert not names(load_registry(user=False), "user")
    assert all(e.location.is_relative_to(bundled_folder()) for e in registry.entries() if e.origin == "bundled")


def test_xdg_folder_is_the_user_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SRF_DATA")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    folder(tmp_path, "srf/plugins", mine_toml=AGEING)
    assert names(load_registry(), "user") == ["mine"]


def test_the_current_folder_is_not_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marker = tmp_path / "marker"
    place = folder(tmp_path, "here", local_py=PYTHON.format(marker=str(marker), name="local"), other_toml=AGEING)
    monkeypatch.chdir(place)
    assert not {"local", "other"} & {e.name for e in load_registry().entries()}
    registry = load_registry([Path()])
    assert registry.get("ageing", "local").about == "from Python"
    assert marker.exists()
    assert load_registry().get("ageing", "other.toml").name == "other"


def test_a_broken_plugin_stops_only_its_user(tmp_path: Path) -> None:
    place = folder(
        tmp_path,
        "broken",
        syntax_toml="kind = ",
        formula_toml=AGEING.replace("v*phi", "v*pih"),
        unnamed_py="from srfcli.laws.api import ageing_law\nN = 'x'\n@ageing_law(name=N)\ndef f(v): return v\n",
        nolaw_py="from srfcli.laws.api import log\n",
        python_py="def f(:\n",
        crash_py="from srfcli.laws.api import ageing_law\n1/0\n@ageing_law(name='crash')\ndef f(v): return v\n",
        exits_py="from srfcli.laws.api import ageing_law\nraise SystemExit\n@ageing_law(name='exits')\ndef f(v): ...\n",
        liar_py="from srfcli.laws.api import ageing_law\n@ageing_law(name='liar')\ndef f(v): return v\ndel f\n",
        wrong_py="from srfcli.laws.api import ageing_law\n@ageing_law(name='wrong')\ndef f(v, p): return p.DO\n",
        helper_py="x = 1\n",
        good_toml=AGEING,
    )
    registry = load_registry([place])
    assert {p.name for p in registry.problems} == {"syntax", "unnamed", "nolaw", "python"}
    assert registry.get("ageing", "good").name == "good"
    assert registry.get("ageing", "dieterich").name == "dieterich"
    expected = {
        "syntax": "not TOML",
        "unnamed": "line 3",
        "nolaw": "no law is found",
        "python": "not Python",
        "formula": "unknown name 'pih'",
        "crash": "line 2: ZeroDivisionError",
        "exits": "SystemExit",
        "liar": "no ageing law 'liar'",
        "wrong": "unknown parameter 'DO'",
    }
    for name, message in expected.items():
        with pytest.raises(SrfError) as caught:
            registry.get("ageing", name)
        assert message in caught.value.message, name
        assert str(place) in caught.value.message, name


def test_two_of_one_name_are_an_error_that_names_both(tmp_path: Path) -> None:
    place = folder(tmp_path, "mine", dieterich_toml=AGEING.replace("{about}", "mine"))
    registry = load_registry([place])
    assert len([e for e in registry.entries("ageing") if e.name == "dieterich"]) == 2
    with pytest.raises(SrfError, match="two ageing laws") as caught:
        registry.get("ageing", "dieterich")
    assert str(place) in caught.value.message and str(bundled_folder()) in caught.value.message
    with pytest.raises(SrfError, match="two ageing laws"):
        registry.ageing("dieterich+linker-dieterich")
    assert registry.get("ageing", "ruina").name == "ruina"


def test_one_name_in_two_kinds_and_one_file_twice_are_fine(tmp_path: Path) -> None:
    text = AGEING.replace('"ageing"', '"modifier"').replace("rate = ", "term = ")
    place = folder(tmp_path, "mine", dieterich_toml=text)
    registry = load_registry([place, place / ".." / "mine", bundled_folder()])
    assert registry.get("modifier", "dieterich").name == "dieterich"
    assert registry.get("ageing", "dieterich").name == "dieterich"


def test_unknown_names_are_answered(tmp_path: Path) -> None:
    registry = load_registry()
    with pytest.raises(SrfError, match="unknown friction law 'srf_vsat'") as caught:
        registry.get("friction", "srf_vsat")
    assert "Did you mean 'srf-vsat'?" in (caught.value.hint or "")
    with pytest.raises(SrfError, match="unknown kind"):
        registry.entries("fraction")
    with pytest.raises(SrfError, match="no folder"):
        load_registry([tmp_path / "absent"])
    with pytest.raises(SrfError, match="no file"):
        registry.get("friction", str(tmp_path / "absent.toml"))
    with pytest.raises(SrfError, match="holds 0 laws of kind friction"):
        registry.get("friction", str(bundled_folder() / "ageing" / "ruina.toml"))


def test_modifiers_are_spelled_with_a_plus() -> None:
    registry = load_registry()
    law, modifiers = registry.ageing("dieterich + linker-dieterich")
    assert (law.name, [m.name for m in modifiers]) == ("dieterich", ["linker-dieterich"])
    assert registry.ageing("ruina") == (registry.get("ageing", "ruina"), ())
    for spelling in ("dieterich+", "+linker-dieterich", "dieterich+linker-dieterich+linker-dieterich", "dieterich+ruina"):
        with pytest.raises(SrfError):
            registry.ageing(spelling)


def test_fingerprint_is_that_of_the_source(tmp_path: Path) -> None:
    place = folder(tmp_path, "mine", one_toml=AGEING)
    registry = load_registry([place])
    entry = registry.find("ageing", "one")
    assert registry.fingerprint(entry) == hashlib.sha256(AGEING.encode()).hexdigest()
    (place / "one.toml").write_text(AGEING + "\n")
    assert registry.fingerprint(entry) != hashlib.sha256(AGEING.encode()).hexdigest()


def test_an_entry_point_module_loads_on_demand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    marker = tmp_path / "marker"
    module = "from .more import *\n" + PYTHON.format(marker=str(marker), name="strange")
    package(tmp_path, monkeypatch, "lawpack.laws", lawpack____init___py="1/0 if False else 0\n", lawpack__laws_py=module)
    (tmp_path / "site" / "lawpack" / "more.py").write_text("")
    registry = load_registry()
    assert names(registry, "entry point stranger") == ["strange"]
    assert not marker.exists() and "lawpack" not in sys.modules
    assert registry.get("ageing", "strange").about == "from Python"
    assert marker.exists()
    assert not names(load_registry(entry_points=False), "entry point stranger")


def test_an_entry_point_may_be_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package(tmp_path, monkeypatch, "folderpack.data", folderpack____init___py="", folderpack__data__ageing__told_toml=AGEING)
    assert names(load_registry(), "entry point stranger") == ["told"]


@pytest.mark.parametrize("value", ["nothere.laws", "brokenpack.absent", "brokenpack.bad", "..", "brokenpack:what"])
def test_a_broken_entry_point_is_a_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    init = "from srfcli.laws.api import log\nraise RuntimeError\n"
    package(tmp_path, monkeypatch, value, brokenpack____init___py=init, brokenpack__bad_py="def")
    registry = load_registry()
    assert [p.origin for p in registry.problems] == ["entry point stranger"]
    assert registry.get("friction", "srf-vsat").name == "srf-vsat"
