"""The example on oscillating loads: it names and measures what an independent generator put into a recording of that form."""

from __future__ import annotations

import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from srfcli.codegen.c_source import compiler
from srfcli.core.errors import SrfError

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: the filter is compiled")


@pytest.fixture(scope="module")
def example() -> ModuleType:
    path = Path(__file__).resolve().parents[1] / "examples" / "load_oscillations.py"
    spec = importlib.util.spec_from_file_location("load_oscillations", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["load_oscillations"] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


def written(example: ModuleType, folder: Path, **truth: float) -> Path:
    """Write twelve periods of 5 s and 0.5 MPa at 12 MPa, checked for stick-slip."""
    physics = replace(example.QUARTZ, **truth)
    trace, normal = example.stand_in(physics, periods=12, steady=8.0)
    late = trace.t > 30.0
    velocity = 10.0 - np.gradient(trace.u, trace.t)[late] / physics.K
    assert velocity.max() > 60.0 and np.median(velocity) < 6.0  # um/s, driven at 10: it sticks, and slips
    path = folder / "oscillation.csv"
    example.write_stand_in(path, trace, normal)
    return path


@pytest.mark.parametrize(
    ("truth", "name", "parameter", "value"),
    [
        pytest.param({"alpha": 0.1}, "linker-dieterich", "alpha", 0.1, marks=pytest.mark.slow),
        pytest.param({"alpha": 0.3}, "linker-dieterich", "alpha", 0.3, marks=pytest.mark.slow),
        pytest.param({"alpha": 0.5}, "linker-dieterich", "alpha", 0.5, marks=pytest.mark.slow),
        ({"nagata": 1.0}, "nagata", "c", 1.0),
        pytest.param({"rho": 0.8}, "load-transmission", "rho", 0.8, marks=pytest.mark.slow),
    ],
    ids=["alpha 0.1", "alpha 0.3", "alpha 0.5", "nagata", "transmission"],
)
def test_what_was_concealed_has_the_best_evidence(example, tmp_path, truth, name, parameter, value):
    path = written(example, tmp_path, **truth)
    everything = truth == {"alpha": 0.1}  # the rest of the models are built for it alone
    models = [m for m in example.MODELS if everything or m.name in (name, "linker-dieterich")]
    fits = example.compare(example.arguments([str(path)]), models=models)
    best = fits[0]
    assert best.model.name == name and best.against == ()
    assert all(best.evidence - other.evidence > 6 for other in fits[1:])
    found = {parameter: value, "mu0": 0.6, "A": 0.006, "B": 0.009, "D0": 8.0, "Vsat": 50.0}
    for n, true in found.items():
        estimate, error = best.values[n]
        assert abs(estimate - true) < 4 * error and error < 0.25 * true, n


def table(path: Path, *, normal: np.ndarray, shear: np.ndarray, t: np.ndarray) -> Path:
    rows = [f"{a:.4f},{b:.5f},{c:.5f}" for a, b, c in zip(t, normal, shear, strict=True)]
    path.write_text("\n".join(["Time [s],Normal stress [MPa],Shear stress [MPa]", *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("change", "options", "said"),
    [
        ({"amplitude": 0.0}, [], "does not oscillate"),
        ({"end": 12.0}, [], "for 2.3 periods; 3 are needed"),
        ({"every": 0.9}, [], "samples a period; 8 are needed"),
        ({}, ["--normal", "Shear stress", "--shear", "Normal stress"], "no friction coefficient"),
        ({}, ["--normal", "sigma_n"], "no column 'sigma_n'"),
        ({}, ["--normal", "Normal stress [um]"], "um"),
        ({}, ["--stiffness", "6e-3 MPa"], "MPa"),
        ({}, ["--window", "500", "900"], "window"),
    ],
    ids=["constant", "short", "coarse", "swapped", "missing", "unit", "stiffness", "window"],
)
def test_what_is_no_such_recording_is_refused(example, tmp_path, capsys, change, options, said):
    t = np.arange(0.0, change.get("end", 100.0), change.get("every", 0.05))
    normal = 12.0 + change.get("amplitude", 1.0) * np.sin(2 * np.pi * t / 5.0)
    path = table(tmp_path / "one.csv", normal=normal, shear=0.6 * 12.0 + 0.2 * (normal - 12.0), t=t)
    assert example.main([str(path), *options]) == 2
    told = capsys.readouterr().err
    assert said in told and told.startswith("Error: ") and len(told.splitlines()) <= 2


def test_columns_of_any_name_and_unit_are_those_that_options_name(example, tmp_path):
    path = written(example, tmp_path, alpha=0.1)
    read = np.genfromtxt(path, delimiter=",", skip_header=1)
    other = tmp_path / "other.csv"
    rows = [f"{t * 1e3:.3f},{w * 10:.6f},{s * 10:.6f},{x * 1e-3:.7f}" for t, x, w, s in read]
    other.write_text("\n".join(["ms,sn,tau,lp", *rows]) + "\n")
    names = ["--time", "ms [ms]", "--normal", "sn [bar]", "--shear", "tau [bar]", "--displacement", "lp [mm]"]
    one = example.experiment_of(example.arguments([str(path)]), example.MODELS[1]).runs[0]
    two = example.experiment_of(example.arguments([str(other), *names]), example.MODELS[1]).runs[0]
    assert two.t == pytest.approx(one.t) and two.observed == pytest.approx(one.observed, abs=2e-5)
    assert two.drive(two.t[5:-5]) == pytest.approx(10.0, rel=1e-3)
    assert example.check(example.experiment_of(example.arguments([str(other), *names]), example.MODELS[0]))


def test_a_stand_in_that_runs_away_names_a_spring_on_which_it_does_not(example):
    """Without a mass a slip that the spring does not end becomes faster than any apparatus."""
    fast = {"alpha": 0.5, "nagata": 0.0, "rho": 1.0}
    with pytest.raises(SrfError, match="no mass, slips at more than 1 m/s") as caught:
        example.stand_in(replace(example.QUARTZ, **fast), amplitude=2.0, period=20.0, periods=2)
    told = re.search(r'--stiffness "([^"]*)"', caught.value.hint)
    K = example.spring(told[1], normal=12.0)
    trace, _ = example.stand_in(replace(example.QUARTZ, K=K, **fast), amplitude=2.0, period=20.0, periods=2)
    assert trace.complete and K == 0.012 == pytest.approx(example.spring("1e-3 1/um", normal=12.0))
