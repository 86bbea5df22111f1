"""More than one observable of a run: what each signal shows, its derivatives, joint fits, what is written and refused."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from test_statespace import FIELD, RIGS

from srfcli.cli.main import cli
from srfcli.codegen.c_source import compiler
from srfcli.data.experiment import read_experiment
from srfcli.data.values import Signal
from srfcli.data.writing import write_experiment
from srfcli.inference.prediction import first_elongation, predict, run_parameters
from srfcli.inference.state_space import filter_run
from srfcli.laws.registry import load_registry

compiled = pytest.mark.skipif(compiler() is None, reason="no C compiler: the filter is compiled")
ROCK = (
    "--law", "dieterich-ruina", "--interface", "rigid", "--no-inertia", "--set", "mu0=0.6", "--set", "A=0.008",
    "--set", "B=0.011", "--set", "D0=10", "--K", "30 MPa/mm",
    "--W0", "10", "--drive", "20:1, 15:10, 30:1", "--rate", "10", "--seed", "1",
)  # fmt: skip


def run(*arguments: str) -> Any:
    return CliRunner().invoke(cli, list(arguments), prog_name="srf")


def made(folder: Path, observed: str, noise: str, *more: str) -> Path:
    done = run("simulate", *ROCK, *more, "--observe", observed, "--noise", noise, "--out-dir", str(folder), "--force")
    assert done.exit_code == 0, done.stderr
    return folder


def rows(text: str) -> dict[str, dict[str, str]]:
    return {row["parameter"]: row for row in csv.DictReader(io.StringIO(text))}


@compiled
@pytest.mark.parametrize(
    ("name", "beside"),
    [
        ("paper", ("second", "slip")),
        ("paper", ("slip", "contact_area")),
        ("stick-slip, modulated", ("slip", "contact_area")),
        ("hold, force", ("second", "slip")),
        ("a stiffer spring, a cell that creeps", ("second", "slip")),
    ],
)
def test_each_signal_shows_what_it_should_with_exact_derivatives(make_model: Any, name: str, beside: Sequence[str]) -> None:
    """Without a field innovations are readings less the free motion's; with one the score is that of central differences."""
    own, rng = RIGS[name], np.random.default_rng(3)
    model = make_model(**own.choice, random_field=True)
    values = {n: v for n, v in own.values.items() if n in model.names} | {"field_amplitude": 0.0, "field_length": 4.0}
    run, n = own.run, own.run.t.size
    found = predict(model, own.experiment, run, values, rtol=1e-9)
    p, (W, W_dot) = run_parameters(model, own.experiment, run, values), run.load(run.t)
    u = np.asarray(model.elongation(found.x, run.drive(run.t), W, W_dot, p))
    stiffness = np.asarray(model.stiffness(found.x, run.drive(run.t), W, W_dot, p))
    another = "elongation" if run.observable == "force" else "force"
    shown = {
        another: u if another == "elongation" else stiffness * u,
        "slip": run.drive.displacement(run.t) - (u - u[0]) + 7.0,
        "contact_area": W / W[0] * 1.3 * (1 + 0.06 * found.x[:, model.states.index("ln_phi")]),
    }
    names = [another if what == "second" else what for what in beside]
    truths = [found.y, *(shown[what] for what in names)]
    sds = [1e-3 * float(np.ptp(y)) for y in truths]
    read = [y + sd * rng.standard_normal(n) for y, sd in zip(truths, sds, strict=True)]
    others = tuple(Signal(what, y, np.ones(n, bool), 0.0) for what, y in zip(names, read[1:], strict=True))
    run = replace(run, observed=read[0], others=others)
    at = 7.0 + u[0] - first_elongation(run)
    values |= {"r.slip": at, "r.area": 1.3, "r.area_growth": 0.06} | {f"white{i}": sd for i, sd in enumerate(sds)}

    def filtered(values: dict[str, float], gauges: Any, **options: Any) -> Any:
        return filter_run(model, replace(own, run=run).experiment, run, values, gauges=gauges, rtol=1e-9, **options)

    free = filtered(values, [{"gauge_white": f"white{i}"} for i in range(3)])
    for k, (y, truth, sd) in enumerate(zip(read, truths, sds, strict=True)):
        assert np.abs(free.of(k).nu - (y - truth)).max() < 2e-3 * sd, names
    gauges = [{"gauge_white": f"white{i}", "gauge_colour1": f"colour{i}", "gauge_time1": f"time{i}"} for i in range(3)]
    values |= FIELD | {f"colour{i}": 2 * sd for i, sd in enumerate(sds)} | {f"time{i}": 0.05 for i in range(3)}
    kept = {"slip": ("r.slip",), "contact_area": ("r.area", "r.area_growth")}
    by = [n for n in values if values[n] and ("." not in n or n in {m for what in names for m in kept.get(what, ())})]
    exact = filtered(values, gauges, by=by)
    for j, changed in enumerate(by):
        step = 1e-5 * abs(values[changed])
        low, high = (filtered(values | {changed: values[changed] + s * step}, gauges).log_likelihood for s in (-1, 1))
        error = np.sqrt(exact.information[j, j]) + 1e-300
        assert abs((high - low) / (2 * step) - exact.score[j]) < 1e-3 * error, changed


@compiled
@pytest.mark.usefixtures("empty_folder")
def test_a_joint_fit_is_sharper_and_says_how_each_observable_is_fitted() -> None:
    folder = made(Path("made"), "force,slip,contact_area", "0.002,0.1,0.001")
    joint = run("fit", str(folder), "--track", "smooth", "--json")
    assert joint.exit_code == 0, joint.stderr
    found = json.loads(joint.stdout)
    by_run = [(row["run"], row["observable"], row["unit"]) for row in found["meta"]["runs"]]
    assert by_run == [("simulated", "force", "N"), ("simulated", "slip", "um"), ("simulated", "contact_area", "1")]
    assert all(abs(row["rms_over_noise"] - 1) < 0.02 for row in found["meta"]["runs"])
    text = (folder / "experiment.toml").read_text().replace('["force", "slip", "contact_area"]', '["force"]')
    (folder / "experiment.toml").write_text(text)
    alone = rows(run("fit", str(folder), "--track", "smooth", "--csv").stdout)
    both = {row["parameter"]: row for row in found["rows"]}
    truth = {"mu0": 0.6, "A": 0.008, "B": 0.011, "D0": 10.0, "simulated.area_growth": 0.05}
    for name, value in truth.items():
        assert abs(both[name]["value"] - value) < 4 * both[name]["stderr"], name
    assert both["D0"]["stderr"] < 0.9 * float(alone["D0"]["stderr"])
    assert both["simulated.slip"]["unit"] == "um" and "simulated.slip" not in alone


@compiled
@pytest.mark.usefixtures("empty_folder")
def test_a_load_cell_and_a_displacement_gauge_tell_the_stiffness() -> None:
    """The force over the elongation is the stiffness: to as much as both are read, and no other parameter has a say."""
    folder = made(Path("made"), "force,elongation", "0.002,0.2", "--free", "mu0,A,B,D0,K")
    both = rows(run("fit", str(folder), "--track", "smooth", "--csv").stdout)
    mean = 0.03 * 0.2 / 200.0 / np.sqrt(651)  # of 651 elongations of 200 um, the force taken as exact
    assert float(both["K"]["value"]) == pytest.approx(0.03, abs=4 * mean)
    assert float(both["K"]["stderr"]) == pytest.approx(mean, rel=0.2)


@compiled
@pytest.mark.slow
@pytest.mark.usefixtures("empty_folder")
def test_a_diagnosis_takes_all_observables() -> None:
    folder = made(Path("made"), "force,slip", "0.002,0.1", "--ageing", "ruina")
    text = (folder / "experiment.toml").read_text().replace('"ruina"', '"dieterich"')
    (folder / "experiment.toml").write_text(text)
    asked = ["--effect", "slip-evolution", "--effect", "drive-ripple", "--effect", "viscous-drag"]
    done = run("diagnose", str(folder), *asked, "--out", "found", "--json")
    assert done.exit_code == 0, done.stderr
    answer = json.loads(done.stdout)
    assert (answer["verdict"], answer["effects"]) == ("identified", ["slip-evolution"])
    reasons = {row["effect"]: row["reason"] for row in answer["not_identifiable"]}
    assert reasons["drive-ripple"] == "the slip that is observed is compared with the drive as it is stated"
    head = Path("found/prediction-simulated.csv").read_text().partition("\n")[0].split(",")
    assert head[4:] == ["slip observed [um]", "slip baseline [um]", "slip augmented [um]"]
    again = read_experiment(Path("found/augmented"), registry=load_registry())
    assert [s.observable for s in again.runs[0].signals] == ["force", "slip"]


@pytest.mark.usefixtures("empty_folder")
def test_what_is_written_is_read_again() -> None:
    registry = load_registry()
    first = read_experiment(made(Path("made"), "friction,contact_area,slip", "2e-4,0.01,0.1"), registry=registry)
    gap = replace(first.runs[0].others[0], used=np.arange(first.runs[0].t.size) % 7 > 0)
    changed = replace(first, runs=(replace(first.runs[0], others=(gap, first.runs[0].others[1])),))
    write_experiment(changed, Path("again"))
    second = read_experiment(Path("again"), registry=registry)
    for a, b in zip(changed.runs[0].signals, second.runs[0].signals, strict=True):
        assert a.observable == b.observable and np.array_equal(a.used, b.used)
        assert np.array_equal(a.observed[a.used], b.observed[b.used])
    thinned = second.runs[0].thinned(5)
    assert all(s.observed.size == thinned.t.size for s in thinned.signals)


@pytest.mark.usefixtures("empty_folder")
def test_a_simulated_experiment_records_the_same_observables_anew() -> None:
    made(Path("made"), "force,slip", "0.002,0.1")
    done = run("simulate", "made", "--noise", "0.001,0.02", "--seed", "5", "--out-dir", "again", "--quiet")
    assert done.exit_code == 0, done.stderr
    first, second = (np.loadtxt(f"{d}/simulated.csv", delimiter=",", skiprows=1) for d in ("made", "again"))
    off = second[:, 4] - first[:, 4]  # two noises of 0.1 and 0.02
    assert np.std(off) == pytest.approx(np.hypot(0.1, 0.02), rel=0.1)
    assert np.corrcoef(off, second[:, 3] - first[:, 3])[0, 1] == pytest.approx(0.0, abs=0.15)


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize(
    ("written", "told", "hint"),
    [
        ('["force", "slipp"]', "observables[1]: unknown observable 'slipp'", "Did you mean 'slip'?"),
        ('["slip"]', "slip without a force", "One of elongation, force, shear_stress, friction is needed besides."),
        ('["force", "force"]', "'force' is the same observable", "Name each once."),
        ('["force", "elongation"]', "has no column 'elongation'", "[columns] can name it."),
        ('"force"', 'found "force", expected a list', 'Write observables = ["elongation", "slip"].'),
        ("[]", "expected a list of observables", 'Write observables = ["elongation", "slip"].'),
        ('["force", 3]', "expected text", ""),
    ],
)
def test_a_wrong_list_is_told_with_its_place(written: str, told: str, hint: str) -> None:
    folder = made(Path("made"), "force,slip", "0.002,0.1")
    text = (folder / "experiment.toml").read_text().replace('["force", "slip"]', written)
    (folder / "experiment.toml").write_text(text)
    done = run("fit", str(folder))
    assert done.exit_code == 2 and not done.stdout
    assert "experiment.toml, line" in done.stderr and "runs[0].observables" in done.stderr
    assert told in done.stderr and hint in done.stderr


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--observe", "slip"), "slip needs an elongation, a force or a friction before it"),
        (("--observe", "force,weight"), "unknown observable 'weight'"),
        (("--observe", "force,slip", "--noise", "0.1"), "found 1, expected one for each of force, slip"),
    ],
)
def test_a_simulation_refuses_what_cannot_be_observed(options: tuple[str, ...], told: str) -> None:
    done = run("simulate", *options)
    assert done.exit_code == 2 and told in done.stderr


@pytest.mark.usefixtures("empty_folder")
def test_without_a_compiler_or_on_one_track_several_observables_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = made(Path("made"), "force,slip", "0.002,0.1")
    done = run("fit", str(folder), "--track", "shared")
    assert done.exit_code == 2 and "several observables" in done.stderr
    monkeypatch.setenv("SRF_CC", "")
    compiler.cache_clear()
    try:
        done = run("fit", str(folder))
    finally:
        monkeypatch.undo()
        compiler.cache_clear()
    assert done.exit_code == 2 and "needs a C compiler" in done.stderr
