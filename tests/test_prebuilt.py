"""The generated modules that the package brings along: current, the very text that is derived, and never used for another law."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import sympy

from srfcli.codegen.model import open_model
from srfcli.core.cache import SHIPPED_MODELS, find_built
from srfcli.laws.registry import Registry, bundled_registry

ROOT = Path(__file__).resolve().parents[1]
REPAIR = "run `python tools/prebuild.py` and commit what it writes"


def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("prebuild", ROOT / "tools" / "prebuild.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_shipped_system_is_there_under_its_present_key() -> None:
    keys = {open_model(bundled_registry(), **asked).key[:16] for asked in tool().shipped_systems()}
    assert {path.stem for path in SHIPPED_MODELS.glob("*.py")} == keys, REPAIR
    assert (SHIPPED_MODELS / "headers.json").read_text(encoding="utf-8") == tool().headers_text(), REPAIR


@pytest.mark.parametrize(
    "asked",
    [
        {},
        {"law": "dieterich-ruina"},
        {"interface": "rigid"},
        {"random_field": True},
        *[pytest.param(a, marks=pytest.mark.slow) for a in tool().shipped_systems()],
    ],
    ids=str,
)
def test_the_text_is_what_is_derived(asked: dict[str, Any]) -> None:
    writer = (SHIPPED_MODELS / "sympy.txt").read_text(encoding="utf-8").strip()
    if writer != sympy.__version__:
        pytest.skip(f"the shipped modules were written with sympy {writer}, here is {sympy.__version__}")
    name, text = tool().module_file(**asked)
    assert (SHIPPED_MODELS / name).read_text(encoding="utf-8") == text, REPAIR


def test_an_edited_law_of_a_shipped_name_is_derived_anew(tmp_path: Path) -> None:
    registry = bundled_registry()
    shipped = registry.find("friction", "srf-vsat")
    place = tmp_path / "srf-vsat.toml"
    text = shipped.location.read_text(encoding="utf-8")
    assert "A*log(v/V0)" in text
    place.write_text(text.replace("A*log(v/V0)", "2*A*log(v/V0)"), encoding="utf-8")
    edited = Registry([replace(e, location=place) if e == shipped else e for e in registry.entries()])
    one, other = (open_model(r) for r in (registry, edited))
    p = one.vector({"V": 10.0, "V0": 1.0})
    gained = other.steady_friction(p) - one.steady_friction(p)
    assert gained == pytest.approx(p[one.index("A")] * np.log(10.0), rel=1e-12)
    assert find_built(one.key) is not None and find_built(other.key) is None


def test_a_module_of_another_key_or_a_damaged_one_is_passed_over(tmp_path: Path) -> None:
    key = open_model(bundled_registry()).key
    place = tmp_path / f"{key[:16]}.py"
    shutil.copy(SHIPPED_MODELS / place.name, place)
    assert find_built(key, tmp_path) is not None
    assert find_built(key[:16] + "0" * 48, tmp_path) is None
    place.write_bytes(b"\xff\xfe")
    assert find_built(key, tmp_path) is None
    place.unlink()
    assert find_built(key, tmp_path) is None


def test_a_first_start_derives_nothing(tmp_path: Path) -> None:
    script = "import sys; from srfcli.cli.main import main\ntry: main(['linear'])\nfinally: print('sympy' in sys.modules)"
    environment = {**os.environ, "SRF_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "False"), done.stderr
