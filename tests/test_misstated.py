"""Recordings of one right law whose start, drive, stiffness or ageing law is stated otherwise: what `srf` says of them."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from commands import srf

import srfcli
from srfcli.diagnosis.search import ModelSearch
from srfcli.diagnosis.verdict import Diagnosis, conclude
from srfcli.laws.registry import load_registry
from srfcli.results.diagnosis import DiagnosisResult

RIG = ("--law", "dieterich-ruina", "--interface", "rigid", "--no-inertia", "--K", "0.1 N/um", "--W0", "10")
LAW = ("--set", "mu0=0.6", "--set", "A=0.008", "--set", "B=0.011", "--set", "D0=5")
GAUGE = ("--observe", "force", "--noise", "0.003", "--free", "mu0,A,B,D0", "--seed", "1")


def record(out: Path, *more: object, law: Sequence[str] = LAW, drive: str = "20:4,15:12,20:4") -> Path:
    srf("simulate", *RIG, *law, "--drive", drive, "--rate", 10, *GAUGE, *more, "--out-dir", out)
    return out / "experiment.toml"


def restated(description: Path, *changes: tuple[str, str]) -> Path:
    text = description.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    description.write_text(text)
    return description


def joined(out: Path, **recordings: Sequence[object]) -> Path:
    """An experiment of several recordings, with the model of the first."""
    parts, model = [], ""
    for seed, (name, more) in enumerate(recordings.items(), 1):
        set_here = {str(a).partition("=")[0] for a in more}
        law = [part for value in LAW[1::2] if value.partition("=")[0] not in set_here for part in ("--set", value)]
        drive = "30:3,20:10,30:3" if seed == 1 else "30:5,20:15,30:5"
        record(out / name, *more, "--seed", seed, law=law, drive=drive)
        head, run = (out / name / "experiment.toml").read_text().split("[[runs]]")
        parts.append(re.sub('name = ".*"', f'name = "{name}"', run).replace("simulated.csv", f"{name}/simulated.csv"))
        model = model or head
    (out / "experiment.toml").write_text("[[runs]]".join([model, *parts]))
    return out / "experiment.toml"


def concluded(description: Path, *effects: str) -> Diagnosis:
    """What a diagnosis concludes, without the closed form that would follow."""
    experiment = srfcli.read_experiment(description)
    search = ModelSearch(load_registry(()), experiment, effects=effects)
    search.run()
    return conclude(search, experiment)


def test_runs_whose_gauges_are_not_alike_have_a_noise_each(tmp_path: Path) -> None:
    description = joined(tmp_path, quiet=(), loud=("--noise", "0.012"), second=())
    found = srfcli.diagnose(description, effects=["second-state", "stiffness-error"])
    assert found.verdict in ("none", "inconclusive")
    assert "each run was given a gauge noise of its own, as no one noise is that of all" in found.diagnosis.reasons
    levels = {n: v for n, v in found.diagnosis.best.fit.values.items() if n.startswith("gauge_white")}
    assert sorted(levels.values()) == pytest.approx([0.003, 0.003, 0.012], rel=0.1), levels


def test_a_parameter_that_is_another_in_one_run_is_told(tmp_path: Path) -> None:
    description = joined(tmp_path, one=(), two=(), three=("--set", "D0=8"))
    found = concluded(description, "stiffness-error")
    told = [r for r in found.reasons if "--vary D0" in r]
    assert found.verdict == "unknown" and told, found.reasons
    assert re.match(r"D0 of three alone, about [\d.]+ um where the baseline has [\d.]+ um, would gain \d+ ", told[0]), told


def test_a_free_start_is_diagnosed_where_an_effect_brings_an_age_of_its_own(tmp_path: Path) -> None:
    record(tmp_path / "run", "--start", "phi=0.3 s")
    assert 'initial = "free"' in (tmp_path / "run" / "experiment.toml").read_text()
    found = srfcli.diagnose(tmp_path / "run", effects=["second-state", "stiffness-error"])
    assert found.verdict in ("none", "inconclusive") and "second-state" in found.diagnosis.detectable


def test_a_start_that_is_not_steady_is_told(tmp_path: Path) -> None:
    found = concluded(restated(record(tmp_path / "run", "--start", "phi=0.3 s"), ('initial = "free"\n', "")), "second-state")
    told = [r for r in found.reasons if 'with initial = "free"' in r]
    assert found.verdict == "unknown" and told and "every test is passed" in told[0]


def test_a_record_that_begins_with_a_hold_is_fitted(tmp_path: Path) -> None:
    """The displacement's noise makes no sliding of a hold, and a run that begins at rest has an age to begin with."""
    record(tmp_path / "run", drive="20:4,60:0,20:4,15:12,20:4")
    rows = np.loadtxt(tmp_path / "run" / "simulated.csv", delimiter=",", skiprows=1)
    heading = (tmp_path / "run" / "simulated.csv").read_text().splitlines()[0].split(",")
    t, force = rows[:, 0], rows[:, next(i for i, name in enumerate(heading) if name.startswith("force"))]
    V = np.select([t < 20, t < 80, t < 100, t < 115], [4.0, 0.0, 4.0, 12.0], 4.0)
    moved = np.concatenate([[0.0], np.cumsum(V[:-1] * np.diff(t))]) + np.random.default_rng(2).normal(0, 0.02, t.size)
    part = t > 30.05
    lines = ["time [s],displacement [um],force [N],normal force [N]"]
    lines += [f"{a:.4f},{b:.6g},{c:.7g},10" for a, b, c in zip(t[part], moved[part], force[part], strict=True)]
    (tmp_path / "held").mkdir()
    (tmp_path / "held" / "held.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path / "held" / "experiment.toml"
    done = srf("new", tmp_path / "held" / "held.csv", "--stiffness", "0.1 N/um", "--out", out)
    assert "the initial state is estimated, as the drive stands still at first" in done.stderr
    fitted = json.loads(srf("fit", out, "--track", "smooth", "--json").stdout)
    assert fitted["status"] == "ok"
    values = {row["parameter"]: (row["value"], row["stderr"]) for row in fitted["rows"]}
    for name, true in {"A": 0.008, "B": 0.011, "D0": 5.0}.items():
        assert abs(values[name][0] - true) < 4 * values[name][1] < 0.2 * true, name


def test_a_line_that_coloured_noise_hides_at_one_lag_is_found(tmp_path: Path) -> None:
    """The correlation at one sample is that of white noise, as noise over 0.2 s and a line of 3.1 Hz undo each other there."""
    description = record(tmp_path / "run", drive="40:4,40:12,40:4")
    heading, *lines = (tmp_path / "run" / "simulated.csv").read_text().splitlines()
    column = next(i for i, name in enumerate(heading.split(",")) if name.startswith("force"))
    rows, rng = np.array([line.split(",") for line in lines], dtype=float), np.random.default_rng(4)
    slow = np.zeros(len(rows))
    for i in range(1, slow.size):
        slow[i] = 0.6 * slow[i - 1] + 0.8 * 0.01 * rng.standard_normal()
    noise = slow + 0.014 * np.sqrt(2) * np.sin(2 * np.pi * 3.1 * rows[:, 0])
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.1
    rows[:, column] += noise
    (tmp_path / "run" / "simulated.csv").write_text("\n".join([heading, *(",".join(map(repr, r)) for r in rows.tolist())]) + "\n")
    fitted = json.loads(srf("fit", description, "--json").stdout)
    ((_, found),) = fitted["meta"]["noise"].items()
    colours = found["colours"]
    frequency, size, _ = next(c for c in colours if len(c) == 3)
    assert frequency == pytest.approx(3.1, rel=0.03) and 0.004 < size < 0.03


def of_a_rippling_drive(out: Path, amplitude: float, drive: str) -> DiagnosisResult:
    """A diagnosis of a recording whose drive ripples every 11.5 um, which is not stated."""
    ripple = ("--effect", "drive-ripple", "--set", f"amplitude={amplitude}", "--set", "pitch=11.5")
    description = record(out, *ripple, drive=drive)
    text = re.sub(r"^(effects|amplitude|pitch|phase) = .*\n", "", description.read_text(), flags=re.MULTILINE)
    description.write_text(text)
    return srfcli.diagnose(out, effects=["drive-ripple", "track-topography", "friction-drift"])


def test_the_pitch_of_a_screw_is_found_along_many_turns_of_it(tmp_path: Path) -> None:
    """Thirty-one turns at one velocity, thirty-eight in the run; neither the pitch nor that anything ripples is stated."""
    found = of_a_rippling_drive(tmp_path / "run", amplitude=0.2, drive="90:4,20:1,5:12")
    assert (found.verdict, found.effects) == ("identified", ("drive-ripple",))
    pitch = found.answer["augmented"]["parameters"]["pitch"]
    assert pitch["value"] == pytest.approx(11.5, abs=4 * pitch["stderr"]) and pitch["stderr"] < 0.1


def test_a_rival_that_resembles_what_promises_most_is_fitted(tmp_path: Path) -> None:
    """A ripple of the stage is much like a topography of the track, which promises more at first order, and less likely."""
    found = of_a_rippling_drive(tmp_path / "run", amplitude=0.1, drive="60:4,15:12")
    assert "drive-ripple" in found.effects and found.verdict in ("identified", "ambiguous")


@pytest.mark.slow
def test_friction_that_drifts_with_slip_is_no_slow_field(tmp_path: Path) -> None:
    """Of two variants of one effect both are fitted, and from no wider field than promised them."""
    made = ("--effect", "friction-drift-slip", "--set", "rate=2e-5", "--set", "onset=0")
    description = record(tmp_path / "run", *made, drive="60:4,25:12,30:4")
    text = re.sub(r"^(rate|onset|effects) = .*\n", "", description.read_text(), flags=re.MULTILINE)
    description.write_text(text)
    found = srfcli.diagnose(tmp_path / "run", effects=["friction-drift", "track-topography"])
    assert (found.verdict, found.effects) == ("identified", ("friction-drift",))
    rate = next(v for name, v in found.answer["augmented"]["parameters"].items() if name.startswith("rate"))
    assert rate["value"] == pytest.approx(2e-5, abs=4 * rate["stderr"])


@pytest.mark.slow
def test_a_compliance_that_is_a_wrong_stiffness_under_one_load_is_not_all_that_is_named(tmp_path: Path) -> None:
    """1/K + lambda/W is all that either does: what is found first must not hide the other."""
    restated(record(tmp_path / "run"), ('stiffness = "0.1 N/um"', 'stiffness = "0.13 N/um"'))
    found = srfcli.diagnose(tmp_path / "run")
    assert found.verdict == "ambiguous" and set(found.effects) == {"interface-compliance", "stiffness-error"}


@pytest.mark.slow
def test_what_another_ageing_law_has_of_its_own_is_fitted(tmp_path: Path) -> None:
    law = ("--ageing", "nagata", "--set", "mu0=0.6", "--set", "A=0.03", "--set", "B=0.034", "--set", "D0=3", "--set", "c=1.5")
    description = record(tmp_path / "run", law=law, drive="30:3,10:30,20:3,30:0,30:3,14:9")
    text = re.sub(r"^c = .*\n", "", description.read_text(), flags=re.MULTILINE)
    description.write_text(text.replace('ageing = "nagata"', 'ageing = "dieterich"'))
    found = srfcli.diagnose(tmp_path / "run", effects=["nagata", "ruina", "slip-evolution"])
    assert (found.verdict, found.effects) == ("identified", ("nagata",))
    c = found.answer["augmented"]["parameters"]["c"]
    assert c["value"] == pytest.approx(1.5, abs=4 * c["stderr"]) and c["stderr"] < 0.1


def test_a_declared_modulation_counts_between_samples_that_are_too_few_for_it(tmp_path: Path) -> None:
    """At 200 Hz a load of 120 Hz looks like one of 80 Hz: the column agrees with both, and the spline through it with none."""
    rig = ("--law", "srf-vsat", "--K", "0.21 N/um", "--W0", 7, "--eps", 0.15, "--onset", 0.2, "--drive", "0.8:8,0.4:16")
    srf("simulate", *rig, "--rate", 200, "--noise", 0.05, "--seed", 3, "--free", "A,B,D0", "--out-dir", tmp_path / "run")
    fitted = json.loads(srf("fit", tmp_path / "run", "--track", "smooth", "--json").stdout)
    assert fitted["status"] == "ok"
    for row in fitted["rows"]:
        true = {"A": 0.0126, "B": 0.0241, "D0": 0.402}[row["parameter"]]
        assert abs(row["value"] - true) < 4 * row["stderr"] < 0.1 * true, row
    restated(tmp_path / "run" / "experiment.toml", ("frequency = 120.0", "frequency = 117.0"))
    assert "fewer than 8 samples a period of 117 Hz do not show the load between them" in srf("check", tmp_path / "run").output


STEPPING = ("--law", "dieterich-ruina", "--interface", "rigid", "--no-inertia", "--K", "0.025 N/um", "--drive", "60:8",
            "--load", "15:22,15:27,15:22,15:31", "--load-rise", 2)  # fmt: skip
STATED = {"mu0": (0.58, 0.3, 0.9), "A": (0.008, 0.002, 0.03), "B": (0.009, 0.001, 0.04), "D0": (22.0, 2.0, 200.0)}


@pytest.fixture(scope="module")
def contacts_that_a_load_renews(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A slider under steps of load to which the contacts' age answers, as it is not stated; start values are far off."""
    out = tmp_path_factory.mktemp("renewed") / "recording"
    true = [part for value in ("mu0=0.67", "A=0.0055", "B=0.0026", "D0=16", "alpha=0.155") for part in ("--set", value)]
    srf("simulate", *STEPPING, "--effect", "linker-dieterich", *true, "--rate", 10, *GAUGE, "--out-dir", out)
    description = out / "experiment.toml"
    text = re.sub(r"(?m)^(effects|alpha) = .*\n", "", description.read_text())
    for name, (value, low, high) in STATED.items():
        text = re.sub(rf"(?m)^{name} = .*$", f"{name} = {{ value = {value}, lower = {low}, upper = {high} }}", text)
    description.write_text(text)
    return description


def test_a_fit_does_not_end_where_a_wide_field_stands_for_what_load_steps_do(contacts_that_a_load_renews: Path) -> None:
    description = contacts_that_a_load_renews.with_name("right.toml")
    description.write_text(contacts_that_a_load_renews.read_text())
    listed = ("[parameters]", "[parameters]\nalpha = {}")
    restated(description, ("inertia = false", 'inertia = false\neffects = ["linker-dieterich"]'), listed)
    found = srfcli.fit(description).found.fit
    assert found.values["alpha"] == pytest.approx(0.155, abs=0.004), found.values
    assert found.values["D0"] == pytest.approx(16.0, rel=0.1), found.values


def test_an_effect_is_found_from_the_files_own_values_where_a_field_has_taken_it_up(contacts_that_a_load_renews: Path) -> None:
    found = srfcli.diagnose(contacts_that_a_load_renews, effects=["linker-dieterich", "sensor-lag", "stiffness-error"])
    assert (found.verdict, found.diagnosis.best.name) == ("identified", "linker-dieterich"), found.diagnosis.reasons
    assert found.diagnosis.best.fit.values["alpha"] == pytest.approx(0.155, abs=0.004)
    assert "linker-dieterich" not in {excluded.effect for excluded in found.diagnosis.not_identifiable}
