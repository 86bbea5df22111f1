"""Real recordings, and the concealed ones, as `srf check` reports them; they are used where they lie and skipped without."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import srf

from srfcli.data.experiment import read_experiment
from srfcli.data.gauge import GaugeNoise
from srfcli.laws.registry import load_registry

REGISTRY = load_registry(user=False, entry_points=False)


def real(folder: Path, data_: Path, *, columns: str, run: str, stiffness: str = "1.6e-3 1/um") -> Path:
    text = f"""format = "srf-experiment/1"
[apparatus]
stiffness = "{stiffness}"
[model]
law = "dieterich-ruina"
ageing = "ruina"
interface = "rigid"
inertia = false
[parameters]
mu0 = {{ value = 0.487, lower = 0.1, upper = 0.9 }}
A = {{ value = 0.006, lower = 0.001, upper = 0.03 }}
B = {{ value = 0.005, lower = 0.0005, upper = 0.03 }}
D0 = {{ value = 15.0, lower = 1.0, upper = 100.0 }}
V0 = {{ value = 2.286, fixed = true }}
[columns]
{columns}
[[runs]]
name = "step"
file = "{data_}"
{run}
"""
    folder.mkdir(exist_ok=True)
    (folder / "experiment.toml").write_text(text, encoding="utf-8")
    return folder


REDUCED = """time = { name = "time_s", unit = "s" }
load_point_displacement = { name = "lp_disp_um", unit = "um" }
normal_stress = { name = "normal_stress_MPa", unit = "MPa" }
friction = "friction"
"""
LOOK = """time = { name = "Time", unit = "s", scale = 1e-4, integrate = true }
load_point_displacement = { name = "Vert_Disp", unit = "um", scale = 0.076472 }
normal_stress = { name = "Hor_Load.", unit = "MPa", scale = 3.31712805707e-3, offset = 104.99 }
force = { name = "Vert_Load", unit = "MPa", scale = 1.597778959e-3, offset = 49.92 }
"""
BASALT = """time = { name = "Time(s)", unit = "s" }
load_point_displacement = { name = "Displ(microns)", unit = "um" }
normal_stress = { name = "Normal_stress(MPa)", unit = "MPa" }
friction = "Friction"
"""


@pytest.mark.parametrize(("name", "columns"), [("p655_reduced.csv", REDUCED), ("p655intact100l", LOOK)])
def test_a_velocity_step_of_p655(name: str, columns: str, shared: Path, tmp_path: Path) -> None:
    """From the reduced table and from the binary original: rates, velocities, servo, and that alpha is not to be had."""
    folder = shared / "data" / "psu-p655-ghost-rocks"
    place = real(tmp_path / "p", folder / name, columns=columns, run="window = [3830.0, 3875.0]")
    done = json.loads(srf("check", str(place), "--json").stdout)
    row = done["rows"][0]
    assert (row["V_min"], row["V_max"]) == pytest.approx((2.286, 22.86), rel=2e-3)
    assert (row["rate_min"], row["rate_max"]) == pytest.approx((10, 1000), rel=1e-3)
    assert row["W_mean"] == pytest.approx(99.91, abs=0.01)
    noises = done["meta"]["runs"][0]["noise"]  # smooth at 1 and 10 ms, as the fit of this step has it
    assert [n["interval"] for n in noises] == pytest.approx([1e-3, 1e-2, 1e-1], rel=1e-2)
    smooth = noises[:2] if name == "p655intact100l" else noises[1:2]  # 0.06 s of the friction at 1 kHz show a line alone
    assert all(n["white"] < 0.3 * n["level"] and 10 < n["colours"][0]["frequency"] < 40 for n in smooth)
    assert done["meta"]["runs"][0]["drive"][1]["from"] == pytest.approx(3852.36, abs=0.1)
    text = " ".join(done["notes"])
    assert "alpha (Linker-Dieterich: a change of load changes the age) cannot be identified: no fitted run has a load" in text


def test_the_binary_and_the_reduced_recording_agree(shared: Path, tmp_path: Path) -> None:
    folder, window = shared / "data" / "psu-p655-ghost-rocks", "window = [3830.0, 3875.0]"
    both = [
        read_experiment(real(tmp_path / name, folder / name, columns=columns, run=window), registry=REGISTRY).runs[0]
        for name, columns in (("p655_reduced.csv", REDUCED), ("p655intact100l", LOOK))
    ]
    n = min(run.t.size for run in both)
    assert both[0].t[:n] == pytest.approx(both[1].t[:n], abs=2e-2)
    friction = both[1].observed / both[1].load(both[1].t)[0]
    assert np.median(np.abs(friction[:n] - both[0].observed[:n])) < 2e-3


def test_the_basalt_step(shared: Path, tmp_path: Path) -> None:
    path = shared / "data" / "basalt-b819-velocity-step" / "velstep4_BRAVA_expb819_basalt.txt"
    place = real(tmp_path / "b", path, columns=BASALT, run='corrections = ["reset"]')
    done = json.loads(srf("check", str(place), "--json").stdout)
    row, run = done["rows"][0], done["meta"]["runs"][0]
    assert row["samples"] == 5849 and row["resets"] == 1
    assert [run["drive"][k]["velocity"] for k in (0, -1)] == pytest.approx([3.0, 10.0], rel=5e-3)
    noise = run["noise"][0]
    found = GaugeNoise(noise["white"], noise["quantum"], tuple(tuple(c.values()) for c in noise["colours"]))
    own, neighbour = found.covariance(np.array([0.0, noise["interval"]]))
    assert neighbour / own == pytest.approx(0.75, abs=0.05)  # as its README says of a fit's residuals
    assert row["noise"] == pytest.approx(8.9e-4, rel=0.25)
    assert run["drive"][1]["from"] == pytest.approx(11676.4, abs=0.5)
    assert [1 / s["interval"] for s in run["sampling"]] == pytest.approx([10, 100], rel=1e-6)


@pytest.mark.slow
def test_a_velocity_step_of_p655_is_fitted_and_diagnosed(shared: Path, tmp_path: Path) -> None:
    """Three sampling rates, each with a noise of its own: published values, and a stiffness 40 % too low is named."""
    name = shared / "data" / "psu-p655-ghost-rocks" / "p655_reduced.csv"
    columns = 'time = { name = "time_s", unit = "s" }\nfriction = { name = "friction", unit = "1" }'
    run = """window = [3830.0, 3875.0]
load = "100 N"
drive = [{ duration = 3851.36, velocity = 2.286 }, { duration = 100.0, velocity = 22.86 }]"""
    place = real(tmp_path / "p", name, columns=columns, run=run)
    found = json.loads(srf("fit", str(place), "--trend", "slip", "--json").stdout)
    rows = {row["parameter"]: row for row in found["rows"]}
    for parameter, value, error in (("A", 0.006005, 5.3e-5), ("B", 0.004230, 5.1e-5), ("D0", 17.745, 0.334)):
        assert abs(rows[parameter]["value"] - value) < 2 * np.hypot(rows[parameter]["stderr"], error), parameter
    place = real(tmp_path / "q", name, columns=columns, run=run, stiffness="1.0e-3 1/um")
    answer = json.loads(srf("diagnose", str(place), "--trend", "slip", "--json").stdout)
    assert answer["verdict"] == "identified" and "stiffness-error" in answer["effects"]
    assert 1.25e-3 < answer["augmented"]["parameters"]["K"]["value"] < 1.75e-3


def test_paper_on_paper(shared: Path, tmp_path: Path) -> None:
    path = shared / "data" / "paper-on-paper-stickslip" / "k168Nm_v1100.mat"
    columns = 'time = { name = "t", unit = "s" }\nfriction = { name = "Fnorm", unit = "1" }'
    run = 'drive = [{ duration = 1000, velocity = 1100 }]\nload = "0.301 N"'
    place = real(tmp_path / "m", path, columns=columns, run=run, stiffness="5.58e-4 1/um")
    row = json.loads(srf("check", str(place), "--json", "--no-simulate").stdout)["rows"][0]
    assert row["rate_min"] == pytest.approx(2000, rel=1e-6) and row["quantum"] == pytest.approx(6e-4, rel=0.05)
    assert row["spikes"] == 0 and row["samples"] == 28_721  # the quanta of fast stick-slip are none


@pytest.mark.parametrize(
    "case", [f"open-0{k}" if k < 4 else pytest.param(f"open-0{k}", marks=pytest.mark.slow) for k in range(1, 9)]
)
def test_the_concealed_cases_are_sound(case: str, shared: Path) -> None:
    """White noise of 0.02 um, a gauge of 0.005 um, modulations as declared, and no notice."""
    done = json.loads(srf("check", str(shared / "cases" / case), "--json", "--no-simulate", "--fail-on", "notice").stdout)
    rows = {row["run"]: row for row in done["rows"]}
    assert [rows[n]["quantum"] for n in rows] == pytest.approx([0.005] * 7, rel=1e-9)
    for name, f, eps, onset in (("onset", 120, 0.09, 2.0), ("strong", 120, 0.2, 0.6), ("holdout-mod", 80, 0.13, 0.8)):
        assert (rows[name]["f"], rows[name]["eps"]) == pytest.approx((f, eps), rel=1e-3)
        assert rows[name]["onset"] == pytest.approx(onset, abs=0.02)
    calm = [rows[n] for n in ("loadstep", "holdout-shs", "strong")]
    assert [r["noise"] for r in calm] == pytest.approx([0.02] * 3, rel=0.2)
