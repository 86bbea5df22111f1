"""`srf simulate` as a user meets it: programs, numbers held against theory, folders that read back, errors."""

from __future__ import annotations

import _thread
import csv
import io
import json
import math
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brittle_law import END, brittle_law
from click.testing import CliRunner, Result

import srfcli
from srfcli.cli.main import cli
from srfcli.codegen.c_source import compiler
from srfcli.data.experiment import read_experiment
from srfcli.data.values import Experiment
from srfcli.laws.registry import load_registry

SHS = ("--W0", "5", "--drive", "1:10, 100:0, 3:10", "--rate", "100")


pytestmark = pytest.mark.usefixtures("empty_folder")


def simulate(*arguments: str, code: int = 0) -> Result:
    """Run the command in this process; `code` is the exit code that is expected."""
    done = CliRunner().invoke(cli, ["simulate", *arguments], prog_name="srf")
    assert done.exit_code == code, done.stderr
    return done


def columns(*arguments: str) -> dict[str, Any]:
    rows = list(csv.DictReader(io.StringIO(simulate(*arguments, "--csv").stdout)))
    return {name: np.array([float(r[name]) if r[name] else np.nan for r in rows]) for name in rows[0] if name != "run"}


def read(folder: str) -> Experiment:
    return read_experiment(Path(folder), registry=load_registry())


# what is computed


def test_steady_sliding_is_the_laws_own() -> None:
    c = columns("--V", "8", "--W0", "6", "--for", "2", "--rate", "100")
    mu = 0.33 + 0.0126 * math.log(8) + 0.0241 * math.log1p(256 / 8)
    assert c["t"].tolist() == (np.arange(201) / 100).tolist()
    assert c["mu"] == pytest.approx(np.full(201, mu), rel=1e-9)
    assert c["tau"] == pytest.approx(6 * c["mu"], rel=1e-14)
    assert c["u"] == pytest.approx(np.full(201, 6 * mu / 0.21), rel=1e-8)
    assert c["phi"] == pytest.approx(np.full(201, 0.402 / 8), rel=1e-8)


def test_columns_and_their_units() -> None:
    done = json.loads(simulate("--V", "8", "--W0", "6", "--for", "1", "--rate", "10", "--json").stdout)
    assert done["schema"] == "srf.simulate/1" and len(done["rows"]) == 11
    units = {name: c["unit"] for name, c in done["columns"].items()}
    assert units == {"t": "s", "V": "um/s", "W": "N", "u": "um", "v": "um/s", "phi": "s", "mu": "1", "tau": "N"}
    assert done["parameters"]["W0"] == {"value": 6.0, "unit": "N", "origin": "flag"}
    assert done["meta"]["samples"] == {"simulated": 11}


def test_two_states_have_two_ages() -> None:
    c = columns("--law", "two-state", "--V", "2", "--W0", "4", "--for", "1", "--rate", "10")
    assert c["phi"][0] == pytest.approx(0.201, rel=1e-9) and c["phi2"][0] == pytest.approx(2.01, rel=1e-9)


def test_stick_slip_is_reported_with_its_period() -> None:
    notes = simulate("--drive", "0.5:12, 30:8", "--W0", "9", "--no-inertia", "--rate", "200").stdout
    line = next(n for n in notes.splitlines() if "stick-slip at V = 8 um/s" in n)
    c = columns("--drive", "0.5:12, 30:8", "--W0", "9", "--no-inertia", "--rate", "200")
    late = c["t"] > 15
    u, t = c["u"][late], c["t"][late]
    tops = np.nonzero((u[1:-1] > u[:-2]) & (u[1:-1] >= u[2:]))[0] + 1
    told = float(line.split("every ")[1].split(" s")[0])
    assert told == pytest.approx(np.diff(t[tops]).mean(), rel=0.03)
    drop = float(line.split("falls by ")[1].split(" um")[0])
    assert drop == pytest.approx(np.ptp(u), rel=0.1)
    assert "no stick-slip" in simulate("--drive", "0.5:12, 8:8", "--W0", "7", "--rate", "200").stdout


def test_a_modulation_that_stabilises() -> None:
    """At W0 = 9 N sliding at 8 um/s is unstable without a modulation, and stable at eps = 0.09."""
    arguments = ("--drive", "0.5:12, 9:8", "--W0", "9", "--rate", "500")
    assert "stick-slip at V = 8" in simulate(*arguments).stdout
    told = simulate(*arguments, "--eps", "0.09", "--onset", "5").stdout
    assert "from t = " in told and "1.2" in told  # before the onset it oscillates
    c = columns(*arguments, "--eps", "0.09", "--onset", "5")
    spread = [np.ptp(c["u"][(c["t"] > a) & (c["t"] < a + 0.5)]) for a in (5.0, 9.0)]
    assert spread[1] < 0.15 * spread[0]


@pytest.mark.parametrize("ageing", ["dieterich", "ruina", "kato-tullis", "dieterich+linker-dieterich"])
def test_a_hold_of_ten_thousand_seconds_and_sliding_again(ageing: str) -> None:
    c = columns("--ageing", ageing, "--W0", "5", "--drive", "1:10, 1e4:0, 4:10", "--rate", "100,0.1,200")
    held = (c["t"] > 1) & (c["t"] <= 10001)
    assert np.isfinite(c["v"]).all() and c["v"][held].min() < (1e-8 if ageing != "ruina" else 1e-5)
    assert (np.diff(c["v"][held]) < 0).all()  # it only creeps ever more slowly
    assert c["v"][-1] == pytest.approx(10.0, rel=0.02)
    assert c["mu"].max() > c["mu"][0] + (0.03 if ageing.startswith("dieterich") else 0.0)


def test_slip_at_a_velocity_of_1e_12() -> None:
    c = columns("--W0", "5", "--drive", "1:10, 1e9:1e-12, 1:10", "--rate", "100,1e-6,1000", "--start", "steady")
    assert np.isfinite(c["mu"]).all() and c["v"].min() < 1e-12
    slow = columns("--W0", "5", "--V", "1e-12", "--for", "1e12", "--rate", "1e-10")
    assert slow["v"] == pytest.approx(np.full(101, 1e-12), rel=1e-6)


def test_interface_inertia_and_steps_of_the_load() -> None:
    for flags in ((), ("--no-inertia",), ("--interface", "rigid"), ("--interface", "rigid", "--no-inertia")):
        low = 3.0 if flags == ("--interface", "rigid") else 0.5  # below, a rigid slider with inertia recoils
        c = columns("--V", "8", "--load", f"1:5, 4:{low}", "--for", "5", "--rate", "100", *flags)
        assert c["u"][-1] / c["u"][0] == pytest.approx(low / 5, rel=1e-3), flags
        assert c["W"][[0, -1]] == pytest.approx([5.0, low], rel=1e-12)


def test_a_recorded_load_is_the_load(empty_folder: Path) -> None:
    t = np.arange(2001) / 500
    W = 5 + 0.5 * np.sin(2 * np.pi * 0.5 * t)
    rows = "\n".join(f"{a!r},{b!r}" for a, b in zip((t + 10).tolist(), (W * 1e3).tolist(), strict=True))
    (empty_folder / "load.csv").write_text(f"time [s],normal_load [mN]\n{rows}\n")
    c = columns("--V", "8", "--load-file", "load.csv", "--rate", "100")
    assert c["t"][[0, -1]].tolist() == [10.0, 14.0]
    assert c["W"] == pytest.approx(W[::5], abs=2e-6)
    for name, head in (("bare.csv", "time,force"), ("none.csv", "seconds,normal_load")):
        (empty_folder / name).write_text(f"{head}\n{rows}\n")
        assert "no column" in simulate("--load-file", name, code=2).stderr


MODULATED = ("--V", "10", "--W0", "7", "--f", "30", "--for", "2", "--rate", "500")


def test_an_effect_that_lets_half_of_a_modulation_through_is_half_of_it() -> None:
    half = columns(*MODULATED, "--eps", "0.1", "--onset", "0.5")
    felt = columns(*MODULATED, "--eps", "0.2", "--onset", "0.5", "--effect", "load-transmission", "--set", "rho=0.5")
    assert felt["W"] - 7 == pytest.approx(2 * (half["W"] - 7), abs=1e-12)  # what is imposed
    assert felt["u"] == pytest.approx(half["u"], abs=1e-7)


def test_an_effect_asks_the_load_and_not_the_samples(empty_folder: Path) -> None:
    """A measured modulation of 30 Hz is found in what was measured, also where the record has 5 samples a second."""
    t = np.arange(2101) / 1000
    W = 5 * (1 + 0.1 * np.cos(60 * np.pi * t) * np.clip(t / 0.2, 0, 1))
    rows = (f"{a!r},{b!r}" for a, b in zip(t.tolist(), W.tolist(), strict=True))
    Path("L.csv").write_text("\n".join(["time [s],normal_load [N]", *rows]))
    felt = ("--load-file", "L.csv", "--effect", "load-transmission", "--set", "rho=0.5", "--V", "10", "--for", "2")
    fine, coarse = (columns(*felt, "--rate", rate)["u"][-1] for rate in ("1000", "5"))
    assert coarse == pytest.approx(fine, abs=1e-6) != columns("--load-file", "L.csv", "--V", "10", "--for", "2")["u"][-1]


def test_an_experiment_names_an_effect_s_file_by_its_whole_path(empty_folder: Path) -> None:
    shipped = Path(srfcli.__file__).parents[1] / "plugins" / "effect" / "viscous-drag.toml"
    Path("drag.toml").write_text(shipped.read_text(encoding="utf-8").replace("viscous-drag", "drag"), encoding="utf-8")
    simulate("--V", "8", "--W0", "5", "--for", "1", "--rate", "20", "--effect", "drag.toml", "--out-dir", "made")
    assert read("made").choice.effects == (str(Path("drag.toml").resolve()),)
    assert "distance from the recording" in simulate("made", "--csv").stderr
    assert "named twice" in simulate("made", "--effect", str(Path("drag.toml").resolve()), code=2).stderr


def test_friction_force_is_that_of_the_load_on_the_asperities() -> None:
    wet = ("--effect", "pore-pressure", "--set", "pressure=1")
    c = columns("--interface", "rigid", "--V", "10", "--W0", "5", "--for", "1", "--rate", "10", *wet)
    assert c["tau"] == pytest.approx(0.21 * c["u"], rel=1e-9) == 0.8 * c["W"] * c["mu"]


def test_a_stage_whose_velocity_ripples_is_seen_at_its_pitch() -> None:
    """Critical loads do not depend on it: V changes with the stage's position, here 4 times a second."""
    asked = ("--effect", "drive-ripple", "--set", "amplitude=0.05", "--set", "pitch=2")
    u = columns("--V", "8", "--W0", "4", "--for", "4", "--rate", "100", *asked)["u"][200:400]
    spectrum = np.abs(np.fft.rfft(u - u.mean()))
    assert np.fft.rfftfreq(200, 0.01)[spectrum.argmax()] == 4.0 and np.ptp(u) > 0.01


def test_a_gauge_that_lags_reads_what_was_a_time_constant_before() -> None:
    """A drive that speeds up slowly stretches the spring at a nearly constant rate."""
    lag = ("--effect", "sensor-lag", "--set", "time_constant=0.05")
    c = columns("--drive", "1:5, 4:5->5.5, 1:5.5", "--W0", "4", "--rate", "100", *lag)
    assert c["measured"][50] == pytest.approx(c["u"][50], rel=1e-12)
    assert c["measured"][300:500] == pytest.approx(c["u"][295:495], abs=2e-5) != c["u"][300:500]
    assert "measured" not in columns("--V", "5", "--W0", "4", "--for", "1", "--rate", "10", "--effect", "viscous-drag")


@pytest.mark.parametrize("effect, size", [("load-distortion", "amplitude=0.1"), ("sensor-lag", "time_constant=0.02")])
def test_an_experiment_with_an_effect_is_repeated(effect: str, size: str) -> None:
    """What effects ask of a load is found in a recording as a new record has it."""
    simulate(*MODULATED, "--eps", "0.2", "--onset", "0.5", "--effect", effect, "--set", size, "--out-dir", "made")
    assert read("made").choice.effects == (effect,)
    told = simulate("made", "--csv").stderr
    distance = float(told.partition("distance from the recording ")[2].split()[0])
    simulate(*MODULATED, "--eps", "0.2", "--onset", "0.5", "--out-dir", "plain")
    off = read("made").runs[0].observed - read("plain").runs[0].observed
    assert distance < 0.02 * np.sqrt(np.mean(off**2))


def test_runs_of_an_experiment_at_its_true_values(shared: Path) -> None:
    """With the parameters that made them, the example's recordings differ from the simulation by their noise alone."""
    truth = json.loads((shared / "cases" / "truth.json").read_text())["open-01"]["parameters"]
    given = [
        f"--set={name}={truth[own]!r}"
        for name, own in zip(("A", "B", "D0", "Vsat", "lambda"), ("A", "B", "D0", "Vsat", "lam"), strict=True)
    ]
    done = simulate(str(shared / "cases" / "open-01"), *given, "--out", "x.csv")
    distances = [float(n.split("recording ")[1].split()[0]) for n in done.stderr.splitlines() if "distance" in n]
    assert len(distances) == 7 and distances == pytest.approx([0.02] * 7, rel=0.03)
    header, first = Path("x.csv").read_text().splitlines()[:2]
    assert header == "run,t,V,W,u,v,phi,mu,tau,recorded" and first.startswith("steps,0.0,5.0,5.0,")


# what is written


def test_a_folder_reads_back_what_was_simulated() -> None:
    arguments = ("--drive", "0.5:12, 2:8->4, 1.5:4", "--load", "1:5, 3:5->7", "--eps", "0.05", "--f", "30", "--onset", "1.5",
                 "--rate", "1000")  # fmt: skip
    simulate(*arguments, "--out-dir", "made")
    c, run = columns(*arguments), read("made").runs[0]
    assert np.array_equal(run.t, c["t"]) and np.array_equal(run.observed, c["u"]) and run.used.all()
    assert run.load(run.t)[0] == pytest.approx(c["W"], rel=1e-9)
    assert run.drive(run.t) == pytest.approx(c["V"], abs=0.01)
    assert (run.modulation, run.stiffness, run.initial) == ((30.0, 0.05, 1.5), 0.21, "steady")
    again = columns("made")
    assert again["u"] == pytest.approx(c["u"], abs=2e-4)
    assert again["recorded"].tolist() == c["u"].tolist()


def test_a_folder_names_the_truth_and_what_is_free() -> None:
    simulate(*SHS, "--set", "A=0.011", "--out-dir", "made", "--observe", "force", "--M", "3")
    e = read("made")
    values = {p.name: (p.value, p.fixed) for p in e.parameters}
    assert values["A"] == (0.011, False) and values["V0"] == (1.0, True) and values["lambda"] == (0.56, False)
    assert (e.mass, e.runs[0].observable, e.runs[0].drive.velocities) == (3e-6, "force", (10.0, 0.0, 10.0))
    assert all(p.lower < p.value < p.upper for p in e.parameters)
    simulate(*SHS, "--out-dir", "other", "--free", "A,K")
    assert [p.name for p in read("other").parameters if not p.fixed] == ["K", "A"]


def test_start_values_can_be_off(empty_folder: Path) -> None:
    for seed in ("1", "1", "2"):
        folder = f"made{len(list(empty_folder.iterdir()))}"
        simulate(*SHS, "--out-dir", folder, "--start-values", "perturb:10%", "--seed", seed)
    folders = sorted(p.name for p in empty_folder.iterdir())
    one, same, other = ({p.name: p for p in read(f).parameters} for f in folders)
    true = {"mu0": 0.33, "A": 0.0126, "B": 0.0241, "D0": 0.402, "Vsat": 256.0, "lambda": 0.56}
    assert one == same and one != other and one["V0"].value == 1.0
    for name, value in true.items():
        assert one[name].value != value and abs(one[name].value / value - 1) <= 0.1


def test_noise_rounding_and_seed() -> None:
    clean = columns(*SHS)["u"]
    gauge = ("--noise", "0.02", "--lag1", "0.8", "--quantum", "0.005", "--seed", "4")
    simulate(*SHS, *gauge, "--out-dir", "made")
    run = read("made").runs[0]
    rest = run.observed - clean
    assert rest.std() == pytest.approx(0.02, rel=0.05)
    assert np.corrcoef(rest[1:], rest[:-1])[0, 1] == pytest.approx(0.8, abs=0.03)
    assert run.observed * 200 == pytest.approx(np.round(run.observed * 200), abs=1e-9)
    again = columns(*SHS, *gauge)
    assert again["measured"].tolist() == run.observed.tolist() and np.array_equal(again["u"], clean)


def test_an_experiment_is_repeated_as_a_new_one() -> None:
    simulate(*SHS, "--noise", "0.05", "--out-dir", "made")
    simulate("made", "--set", "A=0.013", "--set", "K=0.25", "--out-dir", "again")
    old, new = read("made"), read("again")
    assert new.title.endswith("(simulated)") and new.runs[0].stiffness == 0.25
    assert {p.name: p.value for p in new.parameters}["A"] == 0.013
    assert np.array_equal(new.runs[0].t, old.runs[0].t) and new.runs[0].drive == old.runs[0].drive
    direct = columns(*SHS, "--set", "A=0.013", "--K", "0.25")
    assert new.runs[0].observed == pytest.approx(direct["u"], rel=1e-7)
    simulate("made", "--law", "dieterich-ruina", "--set", "mu0=0.46", "--interface", "rigid", "--out-dir", "third")
    third = read("third")
    assert (third.choice.law, third.choice.interface) == ("dieterich-ruina", "rigid")
    assert "Vsat" not in {p.name for p in third.parameters}


def test_one_runs_noise_does_not_hang_on_the_others(shared: Path) -> None:
    source = str(shared / "cases" / "open-01")
    gauge = ("--noise", "0.02", "--seed", "9")
    simulate(source, *gauge, "--out-dir", "all")
    simulate(source, *gauge, "--run", "loadstep", "--out-dir", "one")
    whole = {r.name: r for r in read("all").runs}
    assert list(whole) == ["steps", "stickslip", "onset", "strong", "loadstep", "holdout-mod", "holdout-shs"]
    assert whole["holdout-mod"].holdout and not whole["steps"].holdout
    assert np.array_equal(read("one").runs[0].observed, whole["loadstep"].observed)


def test_a_start_of_ones_own_is_written_as_free() -> None:
    simulate("--W0", "5", "--drive", "10:0, 2:10", "--start", "10", "--out-dir", "made")
    assert read("made").runs[0].initial == "free"
    assert "not known" in simulate("made", "--start", "10").stdout


def test_sidecars_and_figures(empty_folder: Path) -> None:
    simulate(*SHS, "--out-dir", "made", "--out", "t.csv", "--plot", "t.svg", "--seed", "3", "--noise", "0.1")
    assert sorted(p.name for p in empty_folder.iterdir()) == [
        "made", "t.csv", "t.csv.provenance.json", "t.svg", "t.svg.provenance.json",
    ]  # fmt: skip
    side = json.loads((empty_folder / "made" / "experiment.toml.provenance.json").read_text())
    assert side["seed"] == 3 and side["parameters"]["A"]["value"] == 0.0126
    assert "<svg" in (empty_folder / "t.svg").read_text()
    simulate("made", "--out", "u.json", "--no-provenance")
    assert not (empty_folder / "u.json.provenance.json").exists()


def test_nothing_is_overwritten_and_no_recording_replaced(empty_folder: Path) -> None:
    simulate(*SHS, "--out-dir", "made")
    content = (empty_folder / "made" / "simulated.csv").read_bytes()
    assert "exists already" in simulate(*SHS, "--out-dir", "made", code=2).stderr
    assert "is the experiment itself" in simulate("made", "--out-dir", "made", "--force", code=2).stderr
    assert (empty_folder / "made" / "simulated.csv").read_bytes() == content
    simulate(*SHS, "--K", "0.3", "--out-dir", "made", "--force")
    assert (empty_folder / "made" / "simulated.csv").read_bytes() != content


def test_what_stops_early_is_written_as_far_as_it_went(empty_folder: Path) -> None:
    brittle = ("--plugins", str(brittle_law(empty_folder)), "--law", "brittle", "--interface", "rigid", "--no-inertia")
    done = simulate(*brittle, "--drive", "1:8, 3:0", "--W0", "5", "--rate", "100", "--out-dir", "made", "--csv", code=3)
    rows = [[float(cell) for cell in line.split(",")] for line in done.stdout.splitlines()[1:]]
    (reached,) = re.findall(r"stopped at t = ([\d.]+) s of 4 s", done.stderr)
    assert np.isfinite(rows).all() and 1 + 0.9 * END < rows[-1][0] <= float(reached) < rows[-1][0] + 0.01
    assert "Not written: made" in done.stderr and not Path("made").exists()


RUNS = """format = "srf-experiment/1"
title = "a hold that nothing follows, and days of stick-slip"

[apparatus]
stiffness = "0.21 N/um"

[model]
law = "brittle.toml"
ageing = "dieterich"
interface = "rigid"
inertia = false
"""


def holds(folder: Path) -> None:
    """Write an experiment of two runs of steady sliding, a hold of 3 s that the law does not survive, and one of stick-slip."""
    text = RUNS
    brittle_law(folder)
    for name, (drive, W, t) in {
        "first": ([(1.0, 8.0)], 5.0, np.arange(0.0, 1.0, 0.01)),
        "hold": ([(1.0, 8.0), (3.0, 0.0)], 5.0, np.arange(0.0, 4.0, 0.01)),
        "long": ([(20_000.0, 8.0)], 9.0, np.arange(0.0, 20_000.0)),
    }.items():
        pieces = ", ".join(f"{{ duration = {d}, velocity = {V} }}" for d, V in drive)
        text += f'\n[[runs]]\nname = "{name}"\nfile = "{name}.csv"\nload = "{W} N"\ndrive = [{pieces}]\n'
        rows = np.column_stack([t, np.full(t.size, 10.0) + 1e-3 * np.sin(7 * t)])
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="time [s],elongation [um]", comments="", fmt="%.6g")
    (folder / "experiment.toml").write_text(text)


def test_ctrl_c_keeps_the_runs_that_are_done(empty_folder: Path, srf_ended_at: Any) -> None:
    """Whatever became of them."""
    holds(empty_folder)
    code, out, err = srf_ended_at("2/3  long", "simulate", ".", "--csv")
    assert code == 130 and {line.split(",")[0] for line in out.splitlines()[1:]} == {"first", "hold"}
    assert "hold: stopped at t = " in err


@pytest.mark.skipif(compiler() is None, reason="LSODA is not interrupted within a piece")
def test_ctrl_c_keeps_what_was_reached_of_a_record(empty_folder: Path) -> None:
    """And ends the command, whatever became of other records."""
    holds(empty_folder)
    with pressed_during_a_long_integration():
        done = simulate(".", "--csv", code=130)
    rows = [line.split(",") for line in done.stdout.splitlines()[1:]]
    assert {row[0] for row in rows} == {"first", "hold", "long"}
    (reached,) = re.findall(r"long: stopped at t = ([\d.]+) s of 19999 s", done.stderr)
    assert float(rows[-1][1]) == pytest.approx(float(reached), rel=1e-5) and float(reached) < 19_999
    assert all(np.isfinite(float(cell)) for row in rows for cell in row[1:])


@contextmanager
def pressed_during_a_long_integration() -> Iterator[None]:
    """Press Ctrl-C when compiled code has been at work for a second, in a thread beside the main one."""
    done, before = threading.Event(), set(threading.enumerate())

    def watch() -> None:
        begun = dict[threading.Thread, float]()
        while not done.wait(0.01):
            for thread in {*threading.enumerate()} - before - {threading.current_thread()}:
                if time.monotonic() - begun.setdefault(thread, time.monotonic()) > 1.0:
                    _thread.interrupt_main()
                    return

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


# what is asked


@pytest.mark.parametrize(
    ("arguments", "message", "hint"),
    [
        (["--drive", "10:0, 5:10"], "begins at 0 um/s", "--start 10"),
        (["--drive", "1:10, 5"], "piece 2, '5', is not DURATION:VALUE", "0.5:12, 4:8"),
        (["--drive", "1:5->"], "piece 1", "0.5:12"),
        (["--drive", ""], "--drive is empty", "0.5:12"),
        (["--drive", "0:5"], "lasts 0 s", "above 0"),
        (["--drive", "1:5 N"], "measures", "um/s"),
        (["--drive", "0,5:12"], "piece 1, '0',", "0.5:12"),
        (["--load", "1:5, 1:0"], "lifts the slider off", "above 0"),
        (["--V", "8", "--drive", "1:5"], "--V and --drive exclude", "Leave out"),
        (["--W0", "8", "--load", "1:5"], "--W0 and --load exclude", "Leave out"),
        (["--for", "8", "--drive", "1:5"], "--for and --drive exclude", "Leave out"),
        (["--for", "-1"], "not a length of time", "--for 4"),
        (["--for", "1e6", "--rate", "1000"], "1e+09 samples", "Lower --rate"),
        (["--for", "1", "--rate", "0.5"], "only one sample", "Raise it"),
        (["--drive", "1:5,1:6", "--rate", "1,2,3"], "3 rates for 2 pieces", "one for each"),
        (["--rate", "-5"], "a rate lies between", "--rate 1000"),
        (["--onset", "1"], "nothing is modulated", "--eps"),
        (["--eps", "0.1", "--onset", "-1"], "before the record", "begins with it"),
        (["--loading", "inclined", "--drive", "1:5, 1:9"], "changes its velocity", "leave out --loading"),
        (["--effect", "viscous-drag", "--effect", "viscous-drag"], "named twice", "Once is enough"),
        (["--effect", "inertia", "--no-inertia"], "only replaces", "inertia = true"),
        (["--effect", "drive-riple"], "unknown effect", "Did you mean 'drive-ripple'?"),
        (["--start", "q=3"], "'q' is no state", "Known: phi, u, v, z"),
        (["--start", "v=0"], "not above 0", "--start v"),
        (["--start", "soon"], "neither steady, nor a velocity", "--start"),
        (["--start", "0"], "from 1e-12", "--start 10"),
        (["--rtol", "1"], "out of range", "1e-8"),
        (["--run", "a"], "none is given", "--run NAME"),
        (["--noise", "-1"], "noise = -1", "0 or more"),
        (["--noise", "1 N"], "measures", "um"),
        (["--lag1", "0.5"], "noise of size 0", "standard deviation"),
        (["--start-values", "perturb:10%"], "about an experiment", "--out-dir"),
        (["--out-dir", "m", "--start-values", "wrong"], "neither true nor", "perturb:10%"),
        (["--out-dir", "m", "--free", "Q"], "'Q' is no parameter", "Known"),
        (["--out-dir", "no/where"], "does not exist", "mkdir"),
        (["--out-dir", "m", "--loading", "inclined"], "inclined", "--loading"),
        (["--load-rise", "0", "--load", "1:5,1:6"], "positive time", "20 ms"),
        (["--field", "-1e-4"], "a field of -0.0001 is not a size", "0 or more"),
        (["--field", "much"], "is not a number", "--field"),
        (["--field", "1 um"], "measures", "plain number"),
        (["--field", "0.17"], "more than half of mu0 = 0.33", "such as 3e-4"),
        (["--field", "0.11", "--set", "mu0=0.2"], "more than half of mu0 = 0.2", "standard deviation"),
        (["--field-length", "5"], "without a field", "--field 3e-4"),
        (["--field", "0", "--field-length", "-5"], "length of -5 um", "0.08 um or more"),
        (["--field", "1e-4", "--field-length", "0"], "length of 0 um", "0.08 um or more"),
        (["--field", "1e-4", "--field-length", "0.05"], "finer than knots 0.01 um apart", "0.08 um or more"),
        (["--field", "1e-4", "--field-length", "5 s"], "measures", "um"),
        (["--field", "1e-4", "--loading", "inclined"], "loaded from above", "--loading inclined"),
        (["--field", "1e-4", "--field-length", "0.08", "--drive", "1e4:10", "--rate", "10"], "more than", "longer field length"),
    ],
)  # fmt: skip
def test_errors_say_what_and_what_instead(arguments: list[str], message: str, hint: str, empty_folder: Path) -> None:
    lines = simulate(*arguments, code=2).stderr.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("Error: ") and message in lines[0]
    assert lines[1].startswith("Try: ") and hint in lines[1]
    assert not list(empty_folder.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--V", "3"], "--V does not go with an experiment"),
        (["--drive", "1:3"], "--drive does not go"),
        (["--run", "simulatd"], "no run 'simulatd'"),
        (["--set", "W0=3"], "W0 is what the runs impose"),
        (["--set", "Vast=3"], "unknown parameter 'Vast'"),
        (["--loading", "inclined"], "loaded from above"),
        (["--field", "0.2"], "more than half of mu0 = 0.33"),
        (["--field-length", "5"], "without a field"),
    ],
)
def test_errors_about_an_experiment(arguments: list[str], message: str) -> None:
    simulate("--V", "8", "--W0", "5", "--for", "1", "--rate", "50", "--out-dir", "made")
    assert message in simulate("made", *arguments, code=2).stderr
