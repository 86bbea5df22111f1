"""The notebooks of examples/ run from beginning to end, and what they hold are the results of a run."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

import pytest

NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.ipynb"))


@pytest.fixture
def read() -> Any:
    return pytest.importorskip(
        "nbformat", reason='NOTEBOOKS NOT RUN: the extra "notebooks" is not installed: pip install -e ".[notebooks]"'
    ).read


def words(notebook: Any) -> list[str]:
    """Return what each cell of a notebook prints and shows, without the digits and the names of temporary folders."""
    found = []
    for cell in (c for c in notebook.cells if c.cell_type == "code"):
        shown = [o for o in cell.outputs if o.get("name") != "stderr"]
        texts = [o.get("text") or o["data"].get("text/html") or o["data"]["text/plain"] for o in shown]
        found.append(NUMBER.sub("#", re.sub(r"/\S*/tmp\w+", "FOLDER", "".join(texts))))
    return found


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.name)
def test_a_notebook_runs(path: Path, read: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without settings of the caller and with `srf` of this environment; an exception in a cell fails the test."""
    client = pytest.importorskip("nbclient", reason='NOTEBOOKS NOT RUN: pip install -e ".[notebooks]"')
    pytest.importorskip("ipykernel", reason='NOTEBOOKS NOT RUN: pip install -e ".[notebooks]"')
    for name in [n for n in os.environ if n.startswith("SRF_") and n != "SRF_CACHE"]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    notebook = read(path, as_version=4)
    where = {"metadata": {"path": str(tmp_path)}}
    client.NotebookClient(notebook, timeout=None, kernel_name="python3", resources=where).execute()
    shown = str(notebook)
    assert "Error:" not in shown and "Traceback" not in shown
    assert words(notebook) == words(read(path, as_version=4))  # what is stored is what it says now


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.name)
def test_a_notebook_is_stored_with_what_it_printed_and_drew(path: Path, read: Any) -> None:
    cells = [c for c in read(path, as_version=4).cells if c.cell_type == "code"]
    assert [c.execution_count for c in cells] == list(range(1, len(cells) + 1))
    figures = [o for c in cells for o in c.outputs if "image/png" in o.get("data", {})]
    assert len(figures) >= 2 and path.stat().st_size < 500_000
    assert "/work" not in path.read_text(encoding="utf-8") and "/home/" not in path.read_text(encoding="utf-8")
