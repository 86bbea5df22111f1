"""Bounds and sizes of effects follow the recording: slip length, slip, velocity, duration and load, not those of one slider."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.core.errors import SrfError
from srfcli.core.settings import Parameter
from srfcli.data.experiment import read_experiment
from srfcli.data.scales import at_scale, scales_of
from srfcli.data.values import Experiment
from srfcli.laws.registry import load_registry
from srfcli.laws.values import Effect

REGISTRY = load_registry(user=False, entry_points=False)
EFFECTS = [e for e in (REGISTRY.load(entry) for entry in REGISTRY.entries("effect")) if isinstance(e, Effect)]
TILL = """format = "srf-experiment/1"
[apparatus]
stiffness = "3e-3 1/um"
[model]
law = "dieterich-ruina"
ageing = "dieterich"
interface = "rigid"
effects = ["second-state", "sensor-lag"]
[parameters]
D0 = { value = 20.0, lower = 1.0, upper = 100.0 }
V0 = { value = 1.0, fixed = true }
%s
[[runs]]
name = "steps"
file = "a.csv"
"""


def till(folder: Path, parameters: str = "D2 = { value = 120.0 }", *, speed: float = 1.0) -> Experiment:
    """Read steps of 10, 30 and 10 um/s for 40 s each, at 10 Hz under 20 MPa; `speed` scales velocities."""
    t = np.arange(0, 120, 0.1)
    V = speed * np.where((t < 40) | (t >= 80), 10.0, 30.0)
    tau = 12 + np.random.default_rng(1).normal(0, 0.01, t.size)
    lines = [f"{a:.6g},{b:.6g},{c:.8g},20" for a, b, c in zip(t, V, tau, strict=True)]
    folder.mkdir(exist_ok=True)
    (folder / "a.csv").write_text("\n".join(["time,load_point_velocity,shear_stress,normal_stress", *lines]) + "\n")
    (folder / "experiment.toml").write_text(TILL % parameters)
    return read_experiment(folder, registry=REGISTRY)


def effect(name: str) -> Effect:
    return next(e for e in EFFECTS if e.name == name)


def of(effect: Effect, name: str) -> Parameter:
    return next(p for p in effect.parameters if p.name == name)


def test_the_scales_of_a_recording(tmp_path: Path) -> None:
    experiment = till(tmp_path)
    found = scales_of(experiment.runs, experiment.parameters)
    expected = {"segment": 1200.0, "track": 2000.0, "duration": 119.9, "interval": 0.1, "V_low": 10.0, "V_high": 30.0,
                "load": 20.0, "D0": 20.0, "V0": 1.0}  # fmt: skip
    assert found == pytest.approx(expected, rel=2e-3)
    out = replace(experiment, runs=(*experiment.runs, replace(experiment.runs[0], holdout=True, t=experiment.runs[0].t * 9)))
    assert scales_of(out.runs, out.parameters) == found  # what is held out has no say


@pytest.mark.parametrize("one", [e for e in EFFECTS if e.scaled], ids=lambda e: e.name)
def test_bounds_hold_on_sliders_of_any_size(one: Effect) -> None:
    """They rise, hold the default, and are those of the file, to half, for the slider that the file was made for."""
    slider = {"segment": 60.0, "track": 120.0, "duration": 8.5, "interval": 1e-3, "V_low": 5.0, "V_high": 50.0, "load": 7.0,
              "D0": 0.4, "V0": 1.0}  # fmt: skip
    for size in (1e-3, 1.0, 1e3):
        for pace in (1e-2, 1.0, 1e2):
            speed = {"V_low", "V_high", "V0"}
            lengths = {"segment", "track", "D0"}
            scales = {
                n: v * (size if n in lengths else size / pace if n in speed else pace if n != "load" else 1.0)
                for n, v in slider.items()
            }
            moved = at_scale(one, scales)
            for p, before in zip(moved.parameters, one.parameters, strict=True):
                assert p.lower < p.upper and p.lower <= p.default <= p.upper
                assert (p.lower < 0) == (before.lower < 0)
                if size == pace == 1.0 and not one.on_request:
                    assert p.upper == pytest.approx(before.upper, rel=0.5)
                    assert p.default == pytest.approx(before.default, rel=0.5, abs=1.1)
    assert at_scale(one, {}) == one  # where nothing is known the file counts


def test_a_gouge_has_room_for_its_second_slip_length(tmp_path: Path) -> None:
    found = {q.name: q for q in till(tmp_path).parameters}["D2"]
    assert (found.lower, found.upper) == pytest.approx((50.0, 600.0))
    adhesion = of(at_scale(effect("adhesion-offset"), {"load": 0.02}), "Wa")
    assert adhesion.default == pytest.approx(0.02 / 140) and adhesion.upper < 0.01  # beside 20 mN
    lag = of(at_scale(effect("sensor-lag"), {"interval": 0.1, "duration": 120.0}), "time_constant")
    assert 0.1 < lag.default < 1.0 and lag.upper > 5.0


def test_what_an_experiment_states_stays_and_what_it_does_not_makes_room(tmp_path: Path) -> None:
    own = {q.name: q for q in till(tmp_path / "a", "D2 = { value = 30.0, lower = 3.0 }").parameters}["D2"]
    assert (own.lower, own.upper) == pytest.approx((3.0, 600.0))
    far = {q.name: q for q in till(tmp_path / "b", "D2 = { value = 5.0 }").parameters}["D2"]
    assert far.lower < 5.0 < far.upper
    with pytest.raises(SrfError, match=r"-1 um is outside the bounds"):
        till(tmp_path / "c", "D2 = { value = -1.0 }")


@pytest.mark.parametrize(
    ("within", "said"),
    [
        ('["2*D0"]', "expected two formulas"),
        ('["2*D0", 3]', "found 3, expected a formula in quotes"),
        ('["2*D0", "duration"]', "'duration' is in s, D2 in um"),
        ('["2*D0", "slip"]', "slip"),
        ('["2*D0", "track + duration"]', "are added"),
    ],
)
def test_a_formula_that_is_none_is_told(within: str, said: str, tmp_path: Path) -> None:
    text = (Path(effect("second-state").source)).read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(text.replace('["2.5*D0", "segment/2"]', within).replace("second-state", "mine"))
    with pytest.raises(SrfError, match=r"mine\.toml") as caught:
        load_registry((tmp_path,), user=False, entry_points=False).get("effect", "mine")
    assert said in caught.value.message


def test_a_simulated_effect_has_no_bounds_of_a_search(empty_folder: Path) -> None:
    """A second slip length of rock, four times the bound of the file, beside the law that has one of its own."""
    common = ["--interface", "rigid", "--no-inertia", "--set", "D0=10", "--set", "D2=120", "--set", "B2=0.004", "--K", "0.02"]
    common += ["--W0", "5", "--drive", "20:1, 20:10", "--rate", "5", "--csv", "--quiet"]
    with_effect, own = (
        CliRunner().invoke(cli, ["simulate", "--law", law, *effects, *common])
        for law, effects in (("dieterich-ruina", ["--effect", "second-state"]), ("two-state", []))
    )
    assert with_effect.exit_code == own.exit_code == 0, with_effect.output
    numbers = [np.genfromtxt(StringIO(done.stdout), delimiter=",", names=True)["mu"] for done in (with_effect, own)]
    assert numbers[0] == pytest.approx(numbers[1], abs=1e-9) and np.ptp(numbers[0]) > 0.01
    refused = CliRunner().invoke(cli, ["simulate", "--effect", "second-state", "--set", "D2=-1"])
    assert refused.exit_code == 2 and "D2 = -1 um is below its lower bound" in refused.output
