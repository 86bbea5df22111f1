"""An experiment folder: what is written is read back to the last digit, whole or not at all; what a gauge does."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli
from hypothesis import given, settings
from hypothesis import strategies as st

from srfcli.core.errors import SrfError
from srfcli.data import writing
from srfcli.data.experiment import read_experiment
from srfcli.data.noise import ar1, measured, quantised
from srfcli.data.values import Experiment, FitParameter, ModelChoice, Run
from srfcli.data.writing import drive_steps, shortest, write_experiment, write_folder
from srfcli.laws.registry import load_registry
from srfcli.motion.imposed import ConstantLoad, Drive, LoadSteps, ModulatedLoad, Modulation

T = np.arange(2001) / 500.0


def run(name: str = "one", **changes: Any) -> Run:
    """Return a run of 4 s, sampled at 500 Hz, with a noisy elongation."""
    rng = np.random.default_rng(7)
    plain: dict[str, Any] = {
        "name": name, "file": Path("x.csv"), "holdout": False, "start": 0.0, "initial": "steady", "t": T,
        "observed": 18 + rng.standard_normal(T.size), "observable": "elongation", "used": np.ones(T.size, bool),
        "drive": Drive.steps([(0.0, 12.0), (0.7, 8.0), (1.9, 0.3)]), "load": ConstantLoad(math.pi), "stiffness": 0.21,
        "modulation": None, "quantum": 0.0, "notices": (),
    }  # fmt: skip
    return Run(**{**plain, **changes})


def experiment(*runs: Run, **changes: Any) -> Experiment:
    parameters = (
        FitParameter("A", 0.012 + 1e-17, 0.006, 0.03, False, "1"),
        FitParameter("D0", 1 / 3, 0.1, 1.5, False, "um"),
        FitParameter("V0", 1.0, 0.5, 2.0, True, "um/s"),
        FitParameter("lambda", 0.1 + 0.2, 0.2, 1.5, False, "um"),
    )
    plain: dict[str, Any] = {
        "path": Path("nowhere"), "title": 'a "title" with \\ and µ',
        "choice": ModelChoice("srf-vsat", "dieterich", "elastic", True),
        "mass": 2.37e-6, "stiffness_text": "0.21 N/um", "parameters": parameters, "runs": runs or (run(),), "notices": (),
    }  # fmt: skip
    return Experiment(**{**plain, **changes})


def again(given: Experiment, folder: Path, **options: Any) -> Experiment:
    write_experiment(given, folder, **options)
    return read_experiment(folder, registry=load_registry())


def test_every_value_is_read_back_to_the_last_bit(tmp_path: Path) -> None:
    runs = (run(), run("two", holdout=True, start=125.5, drive=Drive.constant(1 / 3), observable="force"))
    wrote = experiment(*runs)
    read = again(wrote, tmp_path / "made")
    assert (read.title, read.choice, read.mass, read.stiffness_text) == (
        wrote.title, wrote.choice, wrote.mass, wrote.stiffness_text
    )  # fmt: skip
    assert read.parameters == wrote.parameters
    for a, b in zip(read.runs, wrote.runs, strict=True):
        for name in ("name", "holdout", "start", "initial", "observable", "stiffness", "modulation"):
            assert getattr(a, name) == getattr(b, name), name
        assert np.array_equal(a.t, b.t) and np.array_equal(a.observed, b.observed) and a.used.all()
        assert a.drive.velocities == b.drive.velocities
        assert np.allclose(a.drive.times, b.drive.times, rtol=1e-15, atol=0)
        assert a.load == b.load


def test_a_stiffness_is_per_load_by_its_dimension() -> None:
    stated = {"0.21 N/um": False, "1.0e-3 1/um": True, "2e5 kg/s^2": False, "3 1/mm": True}
    assert {text: experiment(stiffness_text=text).per_load for text in stated} == stated


@pytest.mark.parametrize("observable", ["elongation", "force", "friction"])
@pytest.mark.parametrize("stiffness", ["0.21 N/um", "1.0e-3 1/um"])
def test_observables_and_stiffness_per_load(tmp_path: Path, observable: str, stiffness: str) -> None:
    K = 0.21 if stiffness.endswith("N/um") else 1e-3 * math.pi
    quasi_static = ModelChoice("dieterich-ruina", "ruina", "rigid", False)
    wrote = experiment(run(observable=observable, stiffness=K), stiffness_text=stiffness, mass=None, choice=quasi_static)
    wrote = dataclasses.replace(wrote, parameters=wrote.parameters[:2])
    read = again(wrote, tmp_path / "made")
    assert read.runs[0].stiffness == pytest.approx(K, rel=1e-15)
    assert (read.runs[0].observable, read.mass, read.choice) == (observable, None, quasi_static)
    assert np.array_equal(read.runs[0].observed, wrote.runs[0].observed)


@pytest.mark.parametrize(
    "load",
    [
        Modulation(9.0, 0.09, 30.0, onset=1.0),
        LoadSteps.sequence([(1, 5, 5), (1.0, 5, 7), (2, 6, 6)], rise=0.1),
        ModulatedLoad(LoadSteps.sequence([(1, 5, 5), (3, 8, 8)], rise=0.2), Modulation(1.0, 0.1, 30.0, onset=2.0)),
    ],
    ids=["modulation", "steps", "both"],
)
def test_a_load_that_changes_is_read_back(tmp_path: Path, load: Any) -> None:
    read = again(experiment(run(load=load, modulation=(30.0, 0.09, 1.0))), tmp_path / "made").runs[0]
    W, _ = load(T)
    assert read.load(T)[0] == pytest.approx(W, rel=1e-12)
    assert read.load.rest(0.0) == pytest.approx(load.rest(0.0), rel=1e-12)
    between = T[:-1] + 0.0007
    assert read.load(between)[0] == pytest.approx(load(between)[0], rel=1e-4)
    assert read.modulation == (30.0, 0.09, 1.0)


def test_phase_and_rise_of_a_declared_modulation_make_the_load(tmp_path: Path) -> None:
    """A run without a column of the load; after the rise the load is the cosine, by hand."""
    declared = 'modulation = { frequency = 30.0, amplitude = 0.09, onset = 1.0, phase = "0.5 rad", rise = 0.1 }'
    rows = "".join(f"{t:.3f},10,18\n" for t in T)
    (tmp_path / "run.csv").write_text("time [s],load_point_velocity [um/s],elongation [um]\n" + rows)
    (tmp_path / "experiment.toml").write_text(
        'format = "srf-experiment/1"\n[apparatus]\nstiffness = "0.21 N/um"\nmass = "2.37 kg"\n'
        '[model]\nlaw = "srf-vsat"\nageing = "dieterich"\ninterface = "elastic"\ninertia = true\n'
        f'[[runs]]\nname = "run"\nfile = "run.csv"\nload = 9.0\n{declared}\n'
    )
    found = read_experiment(tmp_path, registry=load_registry())
    load, late, early = found.runs[0].load, np.linspace(1.1, 2.0, 50), np.linspace(0.0, 1.0, 5)
    assert load(late)[0] == pytest.approx(9 * (1 + 0.09 * np.cos(2 * np.pi * 30 * late + 0.5)), rel=1e-12)
    assert load(early)[0] == pytest.approx(9.0)
    assert again(found, tmp_path / "again").runs[0].modulation == pytest.approx((30.0, 0.09, 1.0, np.degrees(0.5), 0.1))


def test_a_ramp_of_the_drive_keeps_the_displacement(tmp_path: Path) -> None:
    drive = Drive((0.0, 1.0, 2.5), (5.0, 5.0, 20.0), (0.0, 10.0, 0.0))
    read = again(experiment(run(drive=drive)), tmp_path / "made").runs[0]
    fine = np.linspace(0.0, 4.0, 400001)
    at = np.searchsorted(fine, T[1:] - 1e-9)
    moved = [
        np.concatenate(([0.0], np.cumsum(0.5 * (V[1:] + V[:-1]) * np.diff(fine))))[at] for V in (drive(fine), read.drive(fine))
    ]
    assert moved[1] == pytest.approx(moved[0], abs=2e-3)
    assert read.drive(np.array([0.5, 1.75, 3.5])) == pytest.approx([5.0, 12.5, 20.0], rel=1e-3)


def test_unused_samples_become_empty_cells(tmp_path: Path) -> None:
    used = np.ones(T.size, bool)
    used[100:104] = False
    write_experiment(experiment(run(used=used)), tmp_path / "made")
    rows = (tmp_path / "made" / "one.csv").read_text().splitlines()
    assert [row.endswith(",") for row in rows[100:107]] == [False, True, True, True, True, False, False]


def test_file_names_are_plain_and_differ(tmp_path: Path) -> None:
    names = ["a/b", "a b", "A-B", "..", "µ"]
    files = write_experiment(experiment(*(run(n) for n in names)), tmp_path / "made")
    assert [f.name for f in files[1:]] == ["a-b.csv", "a-b-2.csv", "A-B-3.csv", "run.csv", "run-2.csv"]
    assert [r.name for r in read_experiment(tmp_path / "made", registry=load_registry()).runs] == names


@given(st.text(max_size=40))
@settings(max_examples=60, deadline=None)
def test_any_title_survives(title: str) -> None:
    wrote = writing.experiment_files(experiment(title=title.encode("utf-8", "ignore").decode()))
    assert tomli.loads(wrote["experiment.toml"])["title"] == title.encode("utf-8", "ignore").decode()


@given(st.floats(1e-12, 1e12), st.sampled_from([1.0, 1e-6, 1e3, math.pi / 180]))
def test_the_shortest_number_is_the_number(value: float, factor: float) -> None:
    assert shortest(value, factor) * factor == pytest.approx(value, rel=3e-16)
    assert shortest(float(f"{value:.6g}") * 1e-6, 1e-6) == float(f"{value:.6g}")


@given(st.lists(st.floats(1e-3, 1e4), min_size=1, max_size=8), st.floats(-1e3, 1e3))
def test_durations_cover_the_record(durations: list[float], start: float) -> None:
    edges = start + np.concatenate(([0.0], np.cumsum(durations)))
    if (np.diff(edges) <= 0).any():
        return
    drive = Drive.steps([(float(t), float(i)) for i, t in enumerate(edges[:-1])])
    steps = drive_steps(drive, edges)
    assert [V for _, V in steps] == list(range(len(durations)))
    reached = start
    for duration, _ in steps:
        reached += duration
    assert edges[-1] <= reached <= edges[-1] + 1e-9
    assert np.cumsum([d for d, _ in steps]) == pytest.approx(edges[1:] - start, rel=1e-12, abs=1e-9)


def test_nothing_is_overwritten_without_consent(tmp_path: Path) -> None:
    place = tmp_path / "made"
    write_experiment(experiment(), place)
    before = {p.name: p.read_bytes() for p in place.iterdir()}
    with pytest.raises(SrfError, match="exists already"):
        write_experiment(experiment(run("other")), place)
    assert {p.name: p.read_bytes() for p in place.iterdir()} == before
    write_experiment(experiment(run("other")), place, force=True)
    assert sorted(p.name for p in place.iterdir()) == ["experiment.toml", "other.csv"]
    (place / "notes.txt").write_text("mine")
    with pytest.raises(SrfError, match=r"notes\.txt"):
        write_experiment(experiment(), place, force=True)
    assert (place / "notes.txt").read_text() == "mine" and (place / "other.csv").exists()


def test_a_folder_that_is_no_experiment_is_never_replaced(tmp_path: Path) -> None:
    place = tmp_path / "made"
    place.mkdir()
    (place / "one.csv").write_text("data")
    (place / "experiment.toml").write_text('format = "other/1"\n[[runs]]\nfile = "one.csv"\n')
    with pytest.raises(SrfError, match="no part of an experiment"):
        write_experiment(experiment(), place, force=True)
    (tmp_path / "link").symlink_to(place)
    with pytest.raises(SrfError, match="not a folder"):
        write_experiment(experiment(), tmp_path / "link", force=True)
    with pytest.raises(SrfError, match="does not exist"):
        write_experiment(experiment(), tmp_path / "no" / "where")


def test_a_failure_leaves_the_old_folder_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "made"
    write_experiment(experiment(), place)
    before = (place / "one.csv").read_bytes()
    real, calls = Path.open, []

    def breaks(self: Path, *args: Any, **options: Any) -> Any:
        if ".part" in str(self):  # in the scratch folder, not what is read
            calls.append(self)
            if len(calls) == 2:
                raise OSError(28, "No space left on device", str(self))
        return real(self, *args, **options)

    monkeypatch.setattr(Path, "open", breaks)
    with pytest.raises(SrfError, match="made cannot be written: No space"):
        write_experiment(experiment(run("one"), run("two")), place, force=True)
    monkeypatch.undo()
    assert (place / "one.csv").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["made"] and not (place / "two.csv").exists()


def test_the_folder_has_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    write_folder({"experiment.toml": "x"}, tmp_path / "made")
    assert (tmp_path / "made").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_an_experiment_without_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SrfError, match="without runs"):
        write_experiment(experiment(runs=()), tmp_path / "made")
    with pytest.raises(SrfError, match="records 'torque'"):
        write_experiment(experiment(run(observable="torque")), tmp_path / "made")


# the gauge


@pytest.mark.parametrize("lag1", [0.0, 0.5, 0.95, -0.6])
def test_noise_has_the_size_and_colour_asked_for(lag1: float) -> None:
    n = 200_000
    noise = measured(np.full(n, 3.0), noise=0.02, lag1=lag1, seed=5) - 3.0
    effective = n * (1 - lag1**2) / (1 + lag1**2)  # independent samples in the estimate of a variance
    assert noise.std() == pytest.approx(0.02, rel=5 * math.sqrt(0.5 / effective))
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(lag1, abs=5 * math.sqrt((1 - lag1**2) / n) + 1e-5)
    third = np.corrcoef(noise[3:], noise[:-3])[0, 1]
    assert third == pytest.approx(lag1**3, abs=0.03)


def test_noise_is_stationary_from_the_first_sample() -> None:
    firsts = np.array([ar1(3, 0.9, rng=np.random.default_rng(s)) for s in range(4000)])
    assert firsts.std(axis=0) == pytest.approx([1.0, 1.0, 1.0], rel=0.06)
    assert np.corrcoef(firsts[:, 0], firsts[:, 1])[0, 1] == pytest.approx(0.9, abs=0.02)


def test_noise_depends_on_seed_and_name_alone() -> None:
    flat = np.zeros(50)
    one = measured(flat, noise=1.0, lag1=0.5, seed=1, stream="a")
    assert np.array_equal(one, measured(flat + 0.0, noise=1.0, lag1=0.5, seed=1, stream="a"))
    assert not np.array_equal(one, measured(flat, noise=1.0, lag1=0.5, seed=1, stream="b"))
    assert not np.array_equal(one, measured(flat, noise=1.0, lag1=0.5, seed=2, stream="a"))
    assert np.array_equal(measured(flat + 1, quantum=0.0), flat + 1)


@pytest.mark.parametrize("quantum", [0.005, 0.25, 1.0, 3e-7, 20.0])
def test_readings_are_the_nearest_steps_with_few_digits(quantum: float) -> None:
    values = np.random.default_rng(0).uniform(-1e3, 1e3, 500) * quantum
    rounded = quantised(values, quantum)
    assert np.abs(rounded - values).max() <= 0.5000001 * quantum
    assert rounded / quantum == pytest.approx(np.round(rounded / quantum), abs=1e-9)
    assert max(len(repr(v)) for v in rounded.tolist()) <= 12
    assert quantised(np.array([18.6649]), 0.005).tolist() == [18.665]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": -1.0}, "noise = -1"),
        ({"noise": math.nan}, "noise = nan"),
        ({"quantum": -0.1}, "quantum"),
        ({"noise": 1.0, "lag1": 1.0}, "lag1 = 1"),
        ({"lag1": 0.5}, "noise of size 0"),
        ({"seed": -1}, "seed = -1"),
    ],
)
def test_what_no_gauge_does_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(SrfError, match=message):
        measured(np.zeros(3), **options)
