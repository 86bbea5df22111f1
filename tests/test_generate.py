"""Generated modules: the same text every time, readable, of any shape, and `srf code`."""

from __future__ import annotations

import ast
import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.codegen.model import load_source

SCRIPT = """
import hashlib
from srfcli.symbolic import derivation as render
from srfcli.symbolic.derivation import derivation
from srfcli.codegen.numpy_source import generate
from srfcli.laws.registry import bundled_registry
from srfcli.symbolic.system import build_system

names = {"law": "dieterich-ruina", "ageing": "ruina", "interface": "rigid", "loading": "inclined", "inertia": False}
system = build_system(bundled_registry(), **names)
text = generate(system) + render.to_latex(system, derivation(system, ())) + render.to_python(system)
print(hashlib.sha256(text.encode()).hexdigest())
"""


def test_text_does_not_depend_on_the_hash_seed() -> None:
    """Here, and in a process of another seed."""
    here = io.StringIO()
    with contextlib.redirect_stdout(here):
        exec(SCRIPT, {})
    environment = {**os.environ, "PYTHONHASHSEED": "1" if os.environ.get("PYTHONHASHSEED") != "1" else "4711"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout == here.getvalue() != ""


def test_code_is_the_module(model: Any, tmp_path: Path) -> None:
    result = CliRunner().invoke(cli, ["code"], catch_exceptions=False)
    assert result.exit_code == 0
    assert result.output == model.source
    place = tmp_path / "module.py"
    assert CliRunner().invoke(cli, ["code", "--out", str(place)], catch_exceptions=False).exit_code == 0
    assert place.read_text(encoding="utf-8") == model.source
    assert load_source(model.source).states == model.states


def test_module_imports_numpy_alone(model: Any) -> None:
    tree = ast.parse(model.source)
    assert {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)} == {"numpy"}
    assert all(ast.get_docstring(n) for n in tree.body if isinstance(n, ast.FunctionDef))


def test_names_of_the_field_are_kept(model: Any) -> None:
    assert "lambda_ = p[12]" in model.source
    assert "Vsat = p[11]" in model.source


@pytest.mark.parametrize("kind", [float, complex])
def test_any_leading_shape(model: Any, kind: type) -> None:
    p = model.vector({"V": np.array([3.0, 8.0])})
    x = np.broadcast_to(model.steady(p), (5, 2, 4)).astype(kind)
    rates = model.rates(x, 3.0, 9.0, 0.0, p)
    assert rates.shape == (5, 2, 4)
    assert rates.dtype == np.dtype(kind)
    assert model.rates_jacobian(x, 3.0, 9.0, 0.0, p).shape == (5, 2, 4, 4)
    assert model.closed_load(p).shape == model.limit_load(p).shape == (2,)
    alone = model.vector({"V": 8.0})
    np.testing.assert_allclose(model.rates(x[0, 1], 3.0, 9.0, 0.0, alone), rates[0, 1], rtol=1e-14)


def test_functions_without_a_closed_form_are_absent(make_model: Any) -> None:
    power = make_model(interface="power")
    assert "closed_load" not in power.namespace
    assert {"closed_frequency", "limit_load", "quasistatic_load"} <= set(power.namespace)
    assert "limit_load" not in make_model(law="two-state").namespace
