"""The cache of generated modules: lost, broken, shared or read-only, it changes nothing but the time taken."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from srfcli.cache import cached_source, content_key
from srfcli.model import open_model
from srfcli.registry import bundled_folder, load_registry

TEXT = "value = 1\nother = 2\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SRF_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def never() -> str:
    raise AssertionError("built again")


def test_what_was_built_is_found(folder: Path) -> None:
    assert cached_source("k", lambda: TEXT) == TEXT
    assert cached_source("k", never) == TEXT
    assert [p.name for p in folder.iterdir()] == ["k.py"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace("value = 1", "value = 3"),
        lambda text: "",
        lambda text: text.partition("\n")[2],
        lambda text: text + "import os\n",
    ],
    ids=["truncated", "tampered", "empty", "no hash", "appended"],
)
def test_a_damaged_entry_is_built_anew(folder: Path, damage) -> None:
    cached_source("k", lambda: TEXT)
    entry = folder / "k.py"
    entry.write_text(damage(entry.read_text()))
    assert cached_source("k", lambda: TEXT) == TEXT
    assert cached_source("k", never) == TEXT


def test_bytes_that_are_no_text_are_built_anew(folder: Path) -> None:
    cached_source("k", lambda: TEXT)
    (folder / "k.py").write_bytes(b"\xff\xfe\x00")
    assert cached_source("k", lambda: TEXT) == TEXT


def test_a_folder_that_cannot_be_made_or_no_cache_at_all_does_no_harm(tmp_path, monkeypatch) -> None:
    (tmp_path / "file").write_text("")
    for place in (str(tmp_path / "file"), str(tmp_path / "file" / "below"), ""):
        monkeypatch.setenv("SRF_CACHE", place)
        assert cached_source("k", lambda: TEXT) == TEXT
        assert cached_source("k", lambda: TEXT) == TEXT


def test_writers_at_once_leave_one_whole_entry(folder: Path) -> None:
    texts = [f"value = {i}\n" * 5000 for i in range(8)]
    seen: list[str] = []

    def work(text: str) -> None:
        seen.extend(cached_source("k", lambda: text) for _ in range(20))

    threads = [threading.Thread(target=work, args=(t,)) for t in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(seen) <= set(texts)
    assert cached_source("k", never) in texts
    assert [p.name for p in folder.iterdir()] == ["k.py"]


def test_keys_tell_lists_apart() -> None:
    keys = {content_key(parts) for parts in (["ab", "c"], ["a", "bc"], ["abc"], ["ab", "c", ""])}
    assert len(keys) == 4


def test_a_changed_law_is_derived_anew(folder: Path, tmp_path: Path) -> None:
    plugins = tmp_path / "plugins"
    plugins.mkdir()
    law = plugins / "mine.toml"
    source = (bundled_folder() / "friction" / "srf-vsat.toml").read_text()
    law.write_text(source.replace('name = "srf-vsat"', 'name = "mine"'))

    def friction() -> float:
        model = open_model(load_registry([plugins]), law="mine")
        return float(model.steady_friction(model.vector({"V": 10.0})))

    before = friction()
    assert friction() == before and len(list(folder.iterdir())) == 1
    law.write_text(law.read_text().replace("mu0 + A*log(v/V0)", "mu0 + 2*A*log(v/V0)"))
    assert friction() > before + 0.01
    assert len(list(folder.iterdir())) == 2


def test_a_second_start_imports_no_sympy(folder: Path) -> None:
    code = (
        "import sys; from srfcli.model import open_model; from srfcli.registry import load_registry; "
        "open_model(load_registry()); print('sympy' in sys.modules)"
    )
    environment = {**os.environ, "SRF_CACHE": str(folder)}
    runs = [
        subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert runs == ["True\n", "False\n"]
    shutil.rmtree(folder)
