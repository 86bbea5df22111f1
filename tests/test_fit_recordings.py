"""`srf fit` on recordings of another code: whether runs share a track, and what that tells of held-out ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import srfcli as srf
from srfcli.cli.main import cli
from srfcli.codegen.c_source import compiler
from srfcli.data.groups import grouped, labels
from srfcli.diagnosis.goodness_of_fit import uneven_noise
from srfcli.inference.fit import between_groups
from srfcli.inference.recordings import FittedField
from srfcli.validation.cases import case_files
from srfcli.validation.gauge import Gauge, read_gauge
from srfcli.validation.slider import Physics, Plan, Track, move

PLAIN = Physics(rigid=True, massless=True)  # of two unknowns of motion
PLANS = (
    Plan("up", ((0.6, 20), (0.6, 60)), 3.0, 0.002),
    Plan("down", ((0.8, 50), (0.4, 15)), 3.0, 0.002),
    Plan("again", ((0.5, 30), (0.7, 45)), 3.0, 0.002, holdout=True),
)
pytestmark = [
    pytest.mark.usefixtures("empty_folder"),
    pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here"),
]


@pytest.mark.slow
def test_mass_and_compliance_are_found_from_twice_their_values(tmp_path):
    """An oscillation that a modulation begins, at the noise of a good gauge; the truth is that of the simulation."""
    drive, gauge = ["--drive", "0.6:10", "--W0", "7", "--eps", "0.1", "--onset", "0.1"], ["--rate", "1000", "--noise", "0.002"]
    words = [*drive, *gauge, "--K", "0.21", "--seed", "6", "--free", "mu0,A,B,D0,lambda,M", "--out-dir", str(tmp_path / "made")]
    assert CliRunner().invoke(cli, ["simulate", *words]).exit_code == 0
    experiment = srf.read_experiment(tmp_path / "made")
    truth = {q.name: q.value for q in experiment.parameters}
    off = {"M": 1.8, "lambda": 2.0}
    found = srf.fit(
        replace(experiment, parameters=tuple(replace(q, value=q.value * off.get(q.name, 1.0)) for q in experiment.parameters))
    )
    assert found.status.ok
    for name in ("M", "lambda", "A", "B", "D0"):
        assert abs(found.values[name] - truth[name]) < 4 * found.stderr[name] < 0.04 * truth[name], name
    for amplitude, told in ((0.02, True), (0.005, True), (0.002, False)):  # of a friction of a third
        own = replace(found, found=replace(found.found, friction_field=FittedField(amplitude, 1.0)))
        assert any("--starts 5" in note for note in own.table.notes) is told


def test_sudden_falls_are_fitted_from_a_slider_that_would_not_stick(tmp_path):
    """A light slider on a soft spring falls between two samples; the start values have A = B, and slide steadily."""
    slider = (
        "--law dieterich-ruina --ageing ruina --interface rigid --W0 0.6 --K 0.00744 --set A=0.0127 --set B=0.0184 --set D0=0.07"
    )
    run = "--set mu0=0.317 --drive 0.5:3.3,2:1.5,0.8:4 --rate 250 --noise 0.013 --seed 6"
    words = [*slider.split(), "--M", "3.36e-3 kg", *run.split(), "--free", "mu0,A,B,D0", "--out-dir", str(tmp_path / "made")]
    assert CliRunner().invoke(cli, ["simulate", *words]).exit_code == 0
    experiment = srf.read_experiment(tmp_path / "made")
    truth = {q.name: q.value for q in experiment.parameters}
    start = truth | {"mu0": 0.38, "A": 0.01, "B": 0.01}
    found = srf.fit(replace(experiment, parameters=tuple(replace(q, value=start[q.name]) for q in experiment.parameters)))
    assert found.status.ok
    for name in ("mu0", "A", "B", "D0"):
        assert abs(found.values[name] - truth[name]) < 4 * found.stderr[name] < 0.05 * truth[name], name


@pytest.fixture(scope="module", params=[(3, 3, 3), (3, 4, 5)], ids=["one track", "own tracks"])
def fitted(request, tmp_path_factory):
    folder, rng, base = tmp_path_factory.mktemp("rough"), np.random.default_rng(5), PLAIN
    tracks = [Track(2e-3, 6.0, seed) for seed in request.param]
    readings = {
        q: read_gauge(move(replace(base, track=track), q).u, Gauge(), rng) for q, track in zip(PLANS, tracks, strict=True)
    }
    for name, text in case_files("small", base, readings).items():
        (folder / name).write_text(text)
    done = CliRunner().invoke(cli, ["fit", str(folder), "--free", "mu0,A,B", "--json"])
    assert done.exit_code == 0, done.stderr
    return len(set(request.param)) == 1, json.loads(done.stdout)


def test_runs_share_a_track_where_they_do(fitted):
    shared, found = fitted
    assert found["meta"]["track"]["shared"] is shared
    note = next(n for n in found["notes"] if n.startswith("friction field: "))
    assert ("one for all runs" in note) is shared and ("each run has its own" in note) is not shared


def test_a_run_that_was_held_out_is_predicted(fitted):
    """On the track that all share; where each has its own, by the filter, each reading from those before it."""
    _, found = fitted
    over = found["meta"]["rms_over_noise"]
    assert over["fit"] < 1.15 and over["holdout"] < 1.15


def test_parameters_are_those_concealed_within_their_errors(fitted):
    _, found = fitted
    truth = PLAIN
    for row in found["rows"]:
        assert abs(row["value"] - getattr(truth, row["parameter"])) < 3.5 * row["stderr"], row


def test_the_field_of_a_gouge_is_as_long_as_its_slip_wants(tmp_path):
    """Twenty times as long as a slider's in all that is a length: slip, D0, noise of the gauge and the field itself."""
    gouge = replace(PLAIN, D0=20 * PLAIN.D0, V0=20.0, Vsat=20 * PLAIN.Vsat, K=PLAIN.K / 20)
    track, rng = Track(2e-3, 120.0, 3), np.random.default_rng(5)
    plans = [replace(q, drive=tuple((t, 20 * V) for t, V in q.drive)) for q in PLANS]
    readings = {q: read_gauge(move(replace(gouge, track=track), q).u, Gauge(sigma=0.4, quantum=0.1), rng) for q in plans}
    for name, text in case_files("gouge", gouge, readings).items():
        text = text.replace("0.4, lower = 0.1, upper = 1.5", "8.0, lower = 2.0, upper = 30.0")
        text = text.replace("V0 = { value = 1.0", "V0 = { value = 20.0").replace(
            "280.0, lower = 50.0, upper = 2000.0", "5600.0, lower = 1e3, upper = 4e4"
        )
        (tmp_path / name).write_text(text)
    done = CliRunner().invoke(cli, ["fit", str(tmp_path), "--free", "mu0,A,B", "--track", "shared", "--json"])
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)["meta"]
    assert found["track"]["shared"] and 40.0 < found["track"]["length_um"] < 300.0
    assert 1e-3 < found["track"]["amplitude"] < 4e-3
    assert found["rms_over_noise"]["fit"] < 1.15 and found["rms_over_noise"]["holdout"] < 1.15


@pytest.fixture(scope="module")
def offset(tmp_path_factory):
    """Three runs under two loads whose mu0 are apart by 2e-3 and -1e-3, one more held out; everything else is alike."""
    folder, rng, base = tmp_path_factory.mktemp("offset"), np.random.default_rng(5), PLAIN
    plans = [Plan(f"up{k}", ((0.6, 20), (0.6, 60)), 4.0 if k == 1 else 3.0, 0.006, holdout=k == 3) for k in range(4)]
    moved = zip(plans, (0.0, 2e-3, -1e-3, 1e-3), strict=True)
    readings = {q: read_gauge(move(replace(base, mu0=base.mu0 + off), q).u, Gauge(), rng) for q, off in moved}
    for name, text in case_files("small", base, readings).items():
        (folder / name).write_text(text)
    return folder


def vary(folder, *words):
    done = CliRunner().invoke(cli, ["fit", str(folder), "--free", "mu0,A,D0", *words, "--json"])
    return done, json.loads(done.stdout) if done.exit_code == 0 else {}


def test_what_varies_between_runs_is_told(offset):
    result = srf.fit(srf.read_experiment(offset), free=["mu0", "A", "D0"], vary=["mu0", "D0"])
    rows = {row["parameter"]: row for row in result.table.records()}
    assert {f"mu0[up{k}]" for k in range(3)} | {f"D0[up{k}]" for k in range(3)} | {"A"} == set(rows)
    apart = [rows[f"mu0[up{k}]"]["value"] - rows["mu0[up0]"]["value"] for k in (1, 2)]
    assert apart == pytest.approx([2e-3, -1e-3], abs=3e-4)
    names = [column.name for column in result.varied.columns]
    varied = {row[0]: dict(zip(names, row, strict=True)) for row in result.varied.rows}
    assert varied["mu0"]["p_equal"] < 1e-6 and varied["mu0"]["scatter"] == pytest.approx(1.5e-3, rel=0.3)
    assert varied["D0"]["p_equal"] > 1e-3 and varied["D0"]["unit"] == "um"
    held = next(row for row in result.table.meta["runs"] if row["role"] == "held out")
    assert 0.8 < held["rms_over_noise"] < 1.2


def test_each_parameter_may_vary_with_something_of_its_own(offset):
    """mu0 by run, D0 by load: the held-out run has a mu0 of its own, and the D0 of its load."""
    result = srf.fit(srf.read_experiment(offset), free=["mu0", "A", "D0"], vary="mu0,D0:load", track="smooth")
    names = {row["parameter"] for row in result.table.records()}
    assert names == {*(f"mu0[up{k}]" for k in range(3)), "A", "D0[3 N]", "D0[4 N]"}
    held = next(row for row in result.table.meta["runs"] if row["role"] == "held out")
    assert 0.8 < held["rms_over_noise"] < 1.2
    with pytest.raises(srf.SrfError, match="D0 cannot vary by 'lode'"):
        srf.fit(srf.read_experiment(offset), free=["mu0", "D0"], vary="D0:lode")


def test_what_varies_with_the_load_is_one_value_a_load(offset):
    found = vary(offset, "--vary", "mu0,D0", "--by", "load", "--track", "smooth")[1]
    assert {f"{name}[{load} N]" for name in ("mu0", "D0") for load in (3, 4)} < {row["parameter"] for row in found["rows"]}
    assert vary(offset, "--vary", "B")[0].exit_code == 2  # not free
    assert vary(offset, "--vary", "mu0", "--track", "shared")[0].exit_code == 2


LADDER = "6:10, 4:30, 6:10, 4:30, 6:10, 4:30, 6:10"


@pytest.fixture(scope="module")
def ladder(tmp_path_factory):
    """One run of six steps of the velocity, up and down in turn, in steady sliding between them."""
    folder = tmp_path_factory.mktemp("ladder") / "made"
    system = ["--law", "dieterich-ruina", "--interface", "rigid", "--no-inertia", "--set", "mu0=0.6", "--set", "A=0.008"]
    system += ["--set", "B=0.011", "--set", "D0=10", "--K", "30 MPa/mm", "--W0", "10", "--observe", "force"]
    words = ["simulate", *system, "--drive", LADDER, "--rate", "20", "--noise", "0.002", "--seed", "1"]
    done = CliRunner().invoke(cli, [*words, "--out-dir", str(folder)])
    assert done.exit_code == 0, done.stderr
    return folder


def with_model(folder, place, *lines, run=""):
    """Return a copy of an experiment with more keys in [model], and in its run."""
    text = (folder / "experiment.toml").read_text(encoding="utf-8").replace("[model]", "\n".join(("[model]", *lines)))
    place.mkdir()
    (place / "experiment.toml").write_text(text + run, encoding="utf-8")
    (place / "simulated.csv").write_bytes((folder / "simulated.csv").read_bytes())
    return place


def test_a_run_is_cut_between_its_steps(ladder, tmp_path):
    """Halfway between the steps, or where it says so; no reading is lost or used twice, and every command sees the pieces."""
    whole = srf.read_experiment(ladder).runs[0]
    pieces = grouped(srf.read_experiment(ladder), by="segment").runs
    assert [run.name for run in pieces] == [f"simulated-{k}" for k in range(1, 7)]
    assert np.array_equal(np.concatenate([run.t for run in pieces]), whole.t)
    assert [run.t[0] for run in pieces] == pytest.approx([0, 8, 13, 18, 23, 28], abs=0.06)
    driven = [10 * 6 + 30 * 2, 10 * 3 + 30 * 2, 10 * 3 + 30 * 2]  # um between the cuts
    assert np.diff([run.start for run in pieces])[:3] == pytest.approx(driven, abs=2)
    own = with_model(ladder, tmp_path / "own", 'by = "segment"', 'vary = ["mu0"]', run="segments = [8.0, 23.0]\n")
    read = srf.read_experiment(own)
    assert read.vary == {"mu0": "segment"} and [run.t[0] for run in read.runs] == pytest.approx([0, 8, 23])
    done = CliRunner().invoke(cli, ["check", str(own), "--no-simulate", "--csv"])
    assert [line.split(",")[0] for line in done.stdout.splitlines()[1:]] == [f"simulated-{k}" for k in (1, 2, 3)]
    done = CliRunner().invoke(cli, ["fit", str(own), "--track", "smooth", "--csv"])
    assert "mu0[simulated-3]" in done.stdout
    done = CliRunner().invoke(cli, ["fit", str(ladder), "--track", "shared"])
    assert done.exit_code == 2 and "for several runs" in done.stderr


def test_steps_up_and_down_and_strokes_are_groups(ladder, tmp_path):
    """By direction a run's steps up have one value, its steps down another; of a reciprocating drive it is the stroke's."""
    done = CliRunner().invoke(cli, ["fit", str(ladder), "--vary", "D0", "--by", "direction", "--track", "smooth", "--json"])
    rows = {row["parameter"]: row for row in json.loads(done.stdout)["rows"]}
    for name in ("D0[up]", "D0[down]"):
        assert abs(rows[name]["value"] - 10) < 3.5 * rows[name]["stderr"] < 0.5
    text = with_model(ladder, tmp_path / "strokes").joinpath("experiment.toml").read_text(encoding="utf-8")
    head, run = text.split("[[runs]]")
    halves = [run.replace('"simulated"', f'"{n}"') + f"window = {w}\n{more}" for n, w, more in (
        ("out", "[0.0, 17.9]", ""), ("back", "[0.0, 17.9]", 'direction = "backward"\n'))]  # fmt: skip
    rows = (tmp_path / "strokes" / "simulated.csv").read_text(encoding="utf-8")
    backward = tmp_path / "strokes" / "back.csv"
    lines = [line.split(",") for line in rows.splitlines()]
    at = next(k for k, name in enumerate(lines[0]) if name.startswith("force"))
    negative = [lines[0], *([*c[:at], str(-float(c[at])), *c[at + 1 :]] for c in lines[1:])]
    backward.write_text("\n".join(",".join(c) for c in negative), encoding="utf-8")
    halves[1] = halves[1].replace("simulated.csv", "back.csv")
    (tmp_path / "strokes" / "experiment.toml").write_text("[[runs]]".join((head, *halves)), encoding="utf-8")
    both = grouped(srf.read_experiment(tmp_path / "strokes"), ["mu0"], "direction")
    assert labels(both, "direction") == {"out": "forward", "back": "backward"}


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ('by = "sement"', "segment"),
        ('trend = "slop"', "slip"),
        ('vary = "mu0"', 'vary = ["mu0"]'),
        ('vary = ["E"]', "model.vary[0]: 'E' is to vary, and is not in [parameters]"),
        ('vary = ["mu0:lode"]', "model.vary[0]: 'lode' is nothing that mu0 may vary with"),
    ],
)
def test_what_varies_is_checked_where_it_is_written(line, what, ladder, tmp_path):
    done = CliRunner().invoke(cli, ["fit", str(with_model(ladder, tmp_path / "bad", line))])
    assert done.exit_code == 2 and what in done.stderr


@pytest.mark.slow
def test_an_experiment_says_itself_what_a_fit_of_many_steps_needs(ladder, tmp_path, monkeypatch):
    """`srf new` writes what varies, by what, and the trend; with the # taken away the fit is that of the options."""
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(cli, ["new", str(ladder / "simulated.csv"), "--stiffness", "30 N/mm"])
    text = Path("experiment.toml").read_text(encoding="utf-8")
    assert done.exit_code == 0 and '# vary = ["mu0"]' in text and '# by = "segment"' in text and '# trend = "slip"' in text
    options = ("--vary", "mu0", "--by", "segment", "--trend", "slip")
    told = [CliRunner().invoke(cli, ["fit", ".", "--track", "smooth", "--csv", *options]).stdout]
    for line in ("vary = ", "by = ", "trend = "):
        text = text.replace(f"# {line}", line)
    Path("experiment.toml").write_text(text, encoding="utf-8")
    told.append(CliRunner().invoke(cli, ["fit", ".", "--track", "smooth", "--csv"]).stdout)
    assert told[0] == told[1] and "simulated-6.trend" in told[0] and "mu0[simulated-6]" in told[0]
    done = CliRunner().invoke(cli, ["fit", ".", "--track", "smooth", "--csv", "--trend", "none"])
    assert done.exit_code == 0 and "simulated-6.trend" not in done.stdout and "mu0[simulated-6]" in done.stdout


def test_segments_that_do_not_rise_are_refused(ladder, tmp_path):
    place = with_model(ladder, tmp_path / "bad", run="segments = [8.0, 2.0]\n")
    done = CliRunner().invoke(cli, ["check", str(place)])
    assert done.exit_code == 2 and "segments: the times do not rise" in done.stderr


@pytest.mark.slow
def test_values_of_many_groups_are_drawn_to_their_mean(ladder):
    """Where D0 scatters by chance, its six values come together; the maximum is that of likelihood times prior."""
    pieces = grouped(srf.read_experiment(ladder), ["mu0", "D0"], "segment")
    off = np.array([3, -2, 1, 0, -1, 2]) * 1e-3  # of mu0, times the load of 10 N
    runs = tuple(replace(run, observed=run.observed + 10 * o) for run, o in zip(pieces.runs, off, strict=True))
    choice = {"free": ["mu0", "A", "D0"], "track": "smooth"}
    apart, drawn = (srf.fit(replace(pieces, runs=runs), prior=prior, **choice).found for prior in (False, True))
    D0 = apart.problem.groups["D0"]
    raw, shrunk = (np.array([found.fit.values[n] for n in D0]) for found in (apart, drawn))
    assert apart.scatter == drawn.scatter and np.std(shrunk) < 0.5 * np.std(raw)
    assert np.mean([drawn.fit.stderr[n] for n in D0]) < 0.8 * np.mean([apart.fit.stderr[n] for n in D0])
    mu0 = np.array([drawn.fit.values[n] for n in drawn.problem.groups["mu0"]])
    assert mu0 - mu0.mean() == pytest.approx(off - off.mean(), abs=4e-4)  # what truly varies stays
    # near its maximum the likelihood is a Gaussian: its product with the prior is another
    x, C = np.array([apart.fit.values[n] for n in apart.fit.names]), apart.fit.covariance
    P = np.zeros_like(C)
    for names, scatter in drawn.problem.priors:
        at = [apart.fit.names.index(n) for n in names]
        P[np.ix_(at, at)] = (np.eye(6) - 1 / 6) / scatter**2
    expected = np.linalg.solve(np.linalg.inv(C) + P, np.linalg.solve(C, x))
    errors = np.sqrt(np.diag(C))
    assert (np.abs(np.array([drawn.fit.values[n] for n in apart.fit.names]) - expected) < 0.3 * errors).all()


def test_values_of_groups_are_summed_up_as_random_effects():
    """Independent values of one error: the scatter's square is their variance less the error's, where that is above 0."""
    values, error = np.array([1.0, 1.4, 0.7, 1.1, 0.9]), 0.1
    found = between_groups(values, error**2 * np.eye(5))
    assert found.mean == pytest.approx(values.mean())
    assert found.scatter == pytest.approx(np.sqrt(values.var(ddof=1) - error**2), rel=1e-3)
    assert found.stderr == pytest.approx(np.sqrt(values.var(ddof=1) / 5), rel=1e-3)
    together = between_groups(values, np.eye(5) + 0.5)  # an error that all share moves the mean alone
    assert together.scatter == 0.0 and together.stderr == pytest.approx(np.sqrt(0.5 + 1 / 5)) and together.p_value > 0.9


@pytest.mark.slow
def test_the_likeliest_of_many_maxima_is_found(tmp_path):
    """The contact rings faster than it is sampled: next to the start values is a maximum 54 less likely, 229 errors off."""
    rng = np.random.default_rng([13, 100, False])
    spread = {"A": 0.05, "B": 0.05, "D0": 0.05, "lam": 0.05, "Vsat": 0.13, "mu0": 0.01}
    usual = Physics()
    base = replace(usual, **{n: getattr(usual, n) * float(np.exp(s * rng.standard_normal())) for n, s in spread.items()})
    plans = (
        Plan("steps", ((2, 5), (1, 20), (1, 50), (1, 10)), 5.0, 0.004),
        Plan("stickslip", ((0.5, 12), (3.5, 8)), 9.0, 0.004),
        Plan("loadstep", ((4, 10),), 5.0, 0.004, steps=((1.5, 1.5), (3, -1.5))),
        Plan("holds", ((1, 10), (2, 0.1), (1.5, 10)), 5.0, 0.004),
    )
    tracks = rng.integers(2**31, size=4).tolist()
    readings = {
        q: read_gauge(move(replace(base, track=Track(1e-4, 6.0, track)), q).u, Gauge(), rng)
        for q, track in zip(plans, tracks, strict=True)
    }
    for name, text in case_files("ringing", base, readings).items():
        (tmp_path / name).write_text(text)
    found = srf.fit(tmp_path)
    true = {"mu0": base.mu0, "A": base.A, "B": base.B, "D0": base.D0, "Vsat": base.Vsat, "lambda": base.lam}
    for name, value in true.items():
        assert abs(found.values[name] - value) < 4 * found.stderr[name] < 0.04 * value, name


@pytest.fixture(scope="module")
def loud(tmp_path_factory):
    """Three runs whose gauges have noise of 0.02, 0.06 and, held out, 0.12 um; slider and track are alike."""
    folder, rng = tmp_path_factory.mktemp("loud"), np.random.default_rng(8)
    plans = [Plan(f"up{k}", ((0.6, 20), (0.6, 60)), 3.0, 0.006, holdout=k == 2) for k in range(3)]
    noise = zip(plans, (0.02, 0.06, 0.12), strict=True)
    readings = {q: read_gauge(move(Physics(), q).u, Gauge(sigma=level), rng) for q, level in noise}
    for name, text in case_files("small", Physics(), readings).items():
        (folder / name).write_text(text)
    return folder


def test_gauge_noise_may_be_a_run_s_own(loud):
    """Each run then has its own level, a held-out one too; where one is for all, innovations are too loud or too quiet."""
    free, experiment = ["mu0", "A", "D0"], srf.read_experiment(loud)
    one, own = (srf.fit(experiment, free=free, vary=vary, track="smooth").found for vary in ([], ["noise"]))
    for level, run in ((0.02, "up0"), (0.06, "up1")):
        (name,) = [n for n in own.state_space.values if n.startswith("gauge_white[") and n.endswith(f"{run}]")]
        assert own.state_space.values[name] == pytest.approx(level, rel=0.1)
    rms = {f.run.name: np.sqrt(np.mean(f.white**2)) for f in own.state_space.maximum.point.runs}
    assert rms == pytest.approx({"up0": 1.0, "up1": 1.0}, abs=0.05)
    (held,) = [run for run in experiment.runs if run.holdout]
    seen = [found.state_space.likelihood.held_out(held, found.state_space.values).white for found in (own, one)]
    assert np.std(seen[0]) == pytest.approx(1.0, abs=0.06) and np.std(seen[1]) > 2
    shared = {f.run.name: np.std(f.white) for f in one.state_space.maximum.point.runs}
    assert shared["up0"] < 0.6 and shared["up1"] > 1.2
    (advice,) = uneven_noise(one.state_space)
    assert advice.startswith("up1 is louder and up0 quieter") and not uneven_noise(own.state_space)


def test_noise_alone_may_be_asked_for(loud):
    done = CliRunner().invoke(cli, ["fit", str(loud), "--free", "mu0,A", "--vary", "noise", "--track", "smooth", "--json"])
    assert done.exit_code == 0 and {row["parameter"] for row in json.loads(done.stdout)["rows"]} == {"mu0", "A"}
    wrong = CliRunner().invoke(cli, ["fit", str(loud), "--free", "mu0,A", "--vary", "nois"])
    assert wrong.exit_code == 2 and "noise" in wrong.stderr


def test_what_a_held_out_run_adds_to_the_evidence_is_what_is_predicted_of_it(loud):
    """By Laplace's method p(second | first) = p(both) / p(first), where the priors are flat."""
    whole = srf.read_experiment(loud)
    first, second, _ = whole.runs

    def evidence(runs):
        found = srf.fit(replace(whole, runs=runs), free=["mu0", "A", "D0"], vary=[], track="smooth").found.state_space
        return found, found.log_likelihood + 0.5 * np.linalg.slogdet(found.maximum.covariance)[1]

    quiet = replace(second, observed=0.7 * first.observed + 0.3 * second.observed)  # of noise near the first's
    fit, alone = evidence((first,))
    both = evidence((first, quiet))[1]
    told = fit.predictive(quiet)
    assert told.log_likelihood == pytest.approx(both - alone, abs=0.3)
    plain = fit.likelihood.held_out(quiet, fit.values)
    assert told.rms <= np.sqrt(np.mean(plain.white**2)) + 1e-9


def test_a_held_out_run_moves_what_the_fitted_ones_left_undetermined(tmp_path):
    """Steady sliding tells neither D0 nor B apart from A: with the file's values a step is not predicted, with the law it is."""
    plans = (Plan("slide", ((1, 20),), 3.0, 0.004), Plan("step", ((0.5, 20), (0.8, 60)), 3.0, 0.004, holdout=True))
    rng = np.random.default_rng(2)
    readings = {q: read_gauge(move(Physics(), q).u, Gauge(), rng) for q in plans}
    for name, text in case_files("small", Physics(), readings).items():
        (tmp_path / name).write_text(text)
    whole = srf.read_experiment(tmp_path)
    off = {"A": 0.02, "B": 0.04}  # from where another point of the ridge is reached than where the law is
    whole = replace(whole, parameters=tuple(replace(q, value=off.get(q.name, q.value)) for q in whole.parameters))
    found = srf.fit(whole, free=["mu0", "A", "B", "D0"], track="smooth").found.state_space
    (step,) = (run for run in whole.runs if run.holdout)
    plain, told = found.likelihood.held_out(step, found.values), found.predictive(step)
    assert np.sqrt(np.mean(plain.white**2)) > 1.5 and told.rms == pytest.approx(1.0, abs=0.1)
    alone = srf.fit(replace(whole, runs=(replace(step, holdout=False),)), free=["mu0", "A", "B", "D0"], track="smooth")
    assert told.log_likelihood < alone.found.fit.log_likelihood  # what was not known costs


def test_a_held_out_run_that_is_sampled_about_as_often_has_no_noise_of_its_own(tmp_path):
    """At 4.4 ms where the fitted runs have 4 ms: what is louder there is not explained by another noise."""
    plans = [Plan(f"up{k}", ((0.6, 20), (0.6, 60)), 3.0, 0.0044 if k == 2 else 0.004, holdout=k == 2) for k in range(3)]
    rng = np.random.default_rng(8)
    readings = {q: read_gauge(move(Physics(), q).u, Gauge(sigma=0.04 if q.holdout else 0.02), rng) for q in plans}
    for name, text in case_files("small", Physics(), readings).items():
        (tmp_path / name).write_text(text)
    whole = srf.read_experiment(tmp_path)
    found = srf.fit(whole, free=["mu0", "A"], track="smooth").found.state_space
    (louder,) = (run for run in whole.runs if run.holdout)
    told = found.predictive(louder)
    assert told.rms > 1.25 and set(told.fit.likelihood.names) == set(found.likelihood.names)
    assert told.fit.log_likelihood <= told.fit.likelihood.at(told.fit.maximum.point.x).log_likelihood + 1e-6


def test_noise_that_is_far_below_the_corners_of_a_recording_is_found(tmp_path):
    """Sampled coarsely, the drive's starts and stops look like loud white noise; the gauge's is coloured and faint."""
    plan, base, rng = Plan("holds", ((1.5, 20), (1.5, 0.2)) * 2, 5.0, 0.05), Physics(), np.random.default_rng(3)
    readings = {plan: read_gauge(move(base, plan).u, Gauge(sigma=0.004, quantum=0.0005, lag1=0.8), rng)}
    for name, text in case_files("holds", base, readings).items():
        (tmp_path / name).write_text(text)
    done = CliRunner().invoke(cli, ["fit", str(tmp_path), "--free", "mu0,A,B", "--json"])
    assert done.exit_code == 0, done.stderr
    over = json.loads(done.stdout)["meta"]["rms_over_noise"]["fit"]
    assert abs(over - 1) < 0.05, over
