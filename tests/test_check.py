"""`srf check` as a user meets it, and what it says a load can tell: held against fits, differences and real recordings."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commands import srf
from recording_cases import TOML, data, write
from scipy.linalg import cho_factor, cho_solve

from srfcli.codegen.model import open_model
from srfcli.data.experiment import check_run, read_experiment
from srfcli.data.gauge import GaugeNoise, of_one_gauge
from srfcli.data.noise import ar1
from srfcli.data.values import Experiment, FitParameter
from srfcli.inference.cramer_rao import CramerRaoBound, Forecast, forecast
from srfcli.inference.fit import fit_problem
from srfcli.inference.prediction import predict
from srfcli.inference.state_space import Likelihood, StateSpaceFit, as_fit, fit_state_space, maximise
from srfcli.laws.registry import load_registry
from srfcli.results.check import CAN, verdict_of

REGISTRY = load_registry(user=False, entry_points=False)


pytestmark = pytest.mark.usefixtures("empty_folder")


def told(experiment: Experiment, *, apparatus: bool = False, **more: int) -> Forecast:
    return forecast(experiment, [check_run(run) for run in experiment.runs], registry=REGISTRY, apparatus=apparatus, **more)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    folder = tmp_path / "small"
    folder.mkdir()
    return write(folder)


# the report


def test_the_tables_fit_a_page(small: Path) -> None:
    text = srf("check", str(small)).stdout
    tables = [line for line in text.splitlines() if not line.startswith("Note: ")]
    assert max(map(len, tables)) <= 100
    assert tables[:2] == ["three steps", "srf-vsat, dieterich, elastic, inertia on; stiffness 0.21 N/um, mass 2.37 kg"]
    for title in ("Samples", "Readings", "Noise", "Imposed", "Smallest errors that the load allows"):
        assert any(line.startswith(title) for line in tables)
    assert next(line.split() for line in tables if line.startswith("one "))[:5] == ["one", "fit", "120", "120", "1.19"]


def test_csv_has_a_row_for_each_run_in_full_precision(small: Path) -> None:
    rows = list(csv.DictReader(io.StringIO(srf("check", str(small), "--csv").stdout)))
    assert [r["run"] for r in rows] == ["one", "two"]
    one = rows[0]
    assert (one["samples"], one["used"], one["gaps"], one["resets"]) == ("120", "120", "0", "0")
    assert (float(one["duration"]), float(one["rate_min"])) == pytest.approx((1.19, 100.0), rel=1e-9)
    assert (float(one["V_min"]), float(one["V_max"]), float(one["W_mean"])) == (8.0, 12.0, 5.0)
    u = [float(line.split(",")[3]) for line in data()[1:]]
    assert (float(one["reading_min"]), float(one["reading_max"])) == (min(u), max(u))
    assert one["alpha_error"] == "" and float(one["lambda_error"]) > 0.1


def test_json_has_everything(small: Path) -> None:
    done = json.loads(srf("check", str(small), "--json").stdout)
    assert done["schema"] == "srf.check/3" and len(done["rows"]) == 2
    run = done["meta"]["runs"][0]
    assert run["drive"] == [
        {"from": 0.0, "velocity": 8.0, "acceleration": 0.0},
        {"from": 0.5, "velocity": 12.0, "acceleration": 0.0},
    ]
    assert run["sampling"][0]["interval"] == pytest.approx(0.01) and run["gaps"] == [] and run["modulation"] is None
    assert run["tells"]["errors"]["alpha"] is None  # infinite
    assert run["tells"]["simulation"]["status"] == "ok" and done["meta"]["together"]["variation"] == 0
    assert done["parameters"]["A"]["value"] == pytest.approx(0.012)


def test_one_run_without_simulation(small: Path) -> None:
    text = srf("check", str(small), "--run", "two", "--no-simulate").stdout
    assert "two " in text and "one " not in text and "alpha" not in text
    assert json.loads(srf("check", str(small), "--no-simulate", "--json").stdout)["meta"]["runs"][0]["tells"] is None


@pytest.mark.parametrize(
    ("options", "message", "hint"),
    [
        (("--run", "tow"), "--run: no run 'tow'", "Did you mean 'two'?"),
        (("--fail-on", "gaps"), "--fail-on gaps: no such kind of notice", "Did you mean 'gap'?"),
        (("--format", "cvs"), "unknown reader 'cvs'", "Did you mean 'csv'?"),
    ],
)
def test_wrong_usage(options: tuple[str, ...], message: str, hint: str, small: Path) -> None:
    stderr = srf("check", str(small), *options, code=2).stderr
    assert message in stderr and hint in stderr


def test_a_figure_with_what_is_not_compared(small: Path) -> None:
    lines = data()
    lines[30:60] = [line.rpartition(",")[0] + "," for line in lines[30:60]]  # a band
    lines[80] = lines[80].rpartition(",")[0] + ","  # a cross
    write(small, one=lines)
    srf("check", str(small), "--no-simulate", "--plot", "c.svg")
    content = Path("c.svg").read_bytes()
    assert len(content) > 5000 and Path("c.svg.provenance.json").exists()
    assert b"one: 31 samples not compared" in content and b"elongation" in content
    srf("check", str(small), "--no-simulate", "--plot", "again.svg")
    assert Path("again.svg").read_bytes() == content


def test_the_axes_of_what_is_imposed() -> None:
    from srfcli.results.figures import recordings

    t, W = np.arange(200.0), np.full(200, 5.0)
    run = {"name": "a", "t": t, "observed": t, "quantity": "x", "unit": "1", "used": t < 150, "load": lambda t: (W,)}
    run |= {"load_unit": "N", "load_known": True, "proposed": None, "drive_resets": (), "holdout": False}
    scales = {}
    for name, V in (("log", np.where(t < 9, 0.1, 10)), ("symlog", np.where(t < 9, -900.0, 2)), ("linear", t + 1e3)):
        recorded = SimpleNamespace(**run, drive=lambda t, V=V: V)
        axes = recordings([SimpleNamespace(run=recorded, sampling=SimpleNamespace(gaps=np.array([20])))]).axes
        scales[name] = axes[1].get_yscale()
        low, high = axes[2].get_ylim()
        assert low < 4 and high > 6  # a constant is not drawn as its rounding
    assert scales == {name: name for name in scales}


# what the load can tell


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Modulated and stepped loads, simulated with alpha = 0 and coloured noise; the start values are the true ones."""
    folder = tmp_path_factory.mktemp("made")
    system = ("--ageing", "dieterich+linker-dieterich", "--set", "alpha=0", "--free", "mu0,A,B,D0,lambda,alpha")
    noise = ("--noise", "0.02", "--lag1", "0.6", "--rate", "1000")
    programs = {
        "modulated": ("--drive", "0.5:15, 1.5:20", "--W0", "7", "--eps", "0.15", "--onset", "0.6"),
        "stepped": ("--drive", "4:10", "--load", "1:5, 2:6.5, 1:5"),
    }
    for seed, (name, program) in enumerate(programs.items()):
        srf("simulate", *program, *system, *noise, "--seed", str(seed), "--out-dir", str(folder / name))
    text = (folder / "modulated" / "experiment.toml").read_text(encoding="utf-8")
    second = (folder / "stepped" / "experiment.toml").read_text(encoding="utf-8")
    runs = "[[runs]]" + second.partition("[[runs]]")[2]
    text = text.replace('name = "simulated"', 'name = "modulated"').replace('"simulated.csv"', '"modulated/simulated.csv"')
    runs = runs.replace('name = "simulated"', 'name = "stepped"').replace('"simulated.csv"', '"stepped/simulated.csv"')
    (folder / "experiment.toml").write_text(f"{text}\n{runs}", encoding="utf-8")
    return folder


def test_errors_are_those_of_a_fit(made: Path) -> None:
    """The standard errors of a fit that starts from the true values are what was forecast, alpha and lambda among them."""
    experiment = read_experiment(made, registry=REGISTRY)
    found = told(experiment)
    problem = fit_problem(open_model(REGISTRY, **asdict(experiment.choice), random_field=True), experiment)
    likelihood = Likelihood(problem, smooth=True, processes=("relaxation",))
    maximum = maximise(likelihood, likelihood.coordinates(problem.named(problem.start)))
    errors = as_fit(StateSpaceFit(likelihood, maximum)).stderr
    lam = next(p.value for p in experiment.parameters if p.name == "lambda")
    assert found.together is not None and len(found.runs) == 2
    assert found.together.errors["alpha"] == pytest.approx(errors["alpha"], rel=0.15)
    assert found.together.errors["lambda"] == pytest.approx(errors["lambda"] / lam, rel=0.15)
    for name in ("alpha", "lambda", "n"):  # more runs know more
        assert found.together.errors[name] < min(r.errors[name] for r in found.runs)


@pytest.mark.slow
def test_stiffness_and_trends_are_unknown_too_and_cost_what_they_cost_a_fit(made: Path) -> None:
    """What is said of alpha is what a fit finds that knows neither the machine's stiffness nor a run's trend."""
    experiment = read_experiment(made, registry=REGISTRY)
    known, found = told(experiment), told(experiment, apparatus=True)
    assert found.free[-2:] == ("K", "a trend of each run") and "K" not in known.free
    stated = experiment.runs[0].stiffness
    free = replace(
        experiment, parameters=(*experiment.parameters, FitParameter("K", stated, stated / 2, 2 * stated, False, "N/um"))
    )
    problem = fit_problem(open_model(REGISTRY, **asdict(experiment.choice), random_field=True), free, trend="slip")
    errors = as_fit(fit_state_space(problem, smooth=True)).stderr
    lam = next(p.value for p in experiment.parameters if p.name == "lambda")
    assert found.together is not None and known.together is not None
    assert found.together.errors["alpha"] == pytest.approx(errors["alpha"], rel=0.15)
    assert found.together.errors["lambda"] == pytest.approx(errors["lambda"] / lam, rel=0.15)
    for name in ("alpha", "lambda"):
        assert found.together.errors[name] > known.together.errors[name]
    assert "K, a trend of each run unknown" in srf("check", str(made)).stdout


@pytest.mark.parametrize("name", ["strong", "loadstep"])
def test_errors_from_differences(name: str, shared: Path) -> None:
    """alpha and lambda with all else known, from simulations at two values each: within a factor of 1.1, where a linear
    response of the contact is wrong by ten."""
    experiment = read_experiment(shared / "cases" / "open-01", registry=REGISTRY)
    fixed = replace(experiment, parameters=tuple(replace(p, fixed=True) for p in experiment.parameters))
    run = next(r for r in experiment.runs if r.name == name)
    check = check_run(run)
    found = forecast(fixed, [check], registry=REGISTRY, apparatus=False).runs[0]
    choice = replace(experiment.choice, ageing="dieterich+linker-dieterich")
    model = open_model(REGISTRY, **asdict(choice))
    lam = next(p.value for p in experiment.parameters if p.name == "lambda")
    used = np.flatnonzero(run.used)
    lag = np.abs(np.subtract.outer(run.t[used], run.t[used]))
    covariance = cho_factor(check.noise.covariance(lag))
    for asked, low, high, unit in (("alpha", 0.0, 2e-5, 1.0), ("lambda", lam * (1 - 1e-5), lam * (1 + 1e-5), lam)):
        y = [predict(model, experiment, run, {"alpha": 0.0, asked: x}, rtol=1e-9).y for x in (low, high)]
        slope = ((y[1] - y[0]) / (high - low) * unit)[used]
        assert found.errors[asked] == pytest.approx(float(slope @ cho_solve(covariance, slope)) ** -0.5, rel=0.1)


def test_a_constant_load_cannot_tell_alpha(shared: Path) -> None:
    experiment = read_experiment(shared / "cases" / "open-01", registry=REGISTRY)
    constant = ("steps", "stickslip", "holdout-shs")
    found = {r.name: r for r in told(experiment).runs}
    for name in constant:
        assert found[name].variation == 0 and math.isinf(found[name].errors["alpha"])
        assert verdict_of("alpha", found[name]) == "cannot be identified"
        assert found[name].errors["n"] > 1  # from one load no exponent
    for name in set(found) - set(constant):
        assert verdict_of("alpha", found[name]) == CAN
    text = srf("check", str(shared / "cases" / "open-01"), "--run", "steps", "--run", "stickslip").stdout
    assert "the load is constant in steps and stickslip" in text
    assert "changes the age) cannot be identified: no fitted run has a load that changes" in text


HELD = """format = "srf-experiment/1"
[apparatus]
stiffness = "3e-3 1/um"
[model]
law = "dieterich-ruina"
ageing = "ruina"
interface = "rigid"
inertia = false
[parameters]
mu0 = { value = 0.6, lower = 0.3, upper = 0.9 }
D0 = { value = 20.0, lower = 1.0, upper = 100.0 }
V0 = { value = 10.0, fixed = true }
[[runs]]
name = "steps"
file = "steps.csv"
"""


@pytest.mark.parametrize("eps", [0.0, 0.01], ids=["held", "modulated"])
def test_noise_of_a_load_cell_tells_nothing_of_alpha(eps: float, tmp_path: Path) -> None:
    """Coloured, it stays in the spline through the load, and its slopes look like changes of the load."""
    rng, t = np.random.default_rng(1), np.arange(0.0, 20.0, 0.01)
    W = 20 * (1 + eps * np.sin(np.pi * t)) + 0.02 * ar1(t.size, 0.9, rng=rng) + rng.normal(0, 0.005, t.size)
    tau = 12 + rng.normal(0, 0.002, t.size)
    rows = [f"{a:.2f},{10 if a < 10 else 30},{b:.5f},{c:.5f}" for a, b, c in zip(t, tau, W, strict=True)]
    (tmp_path / "steps.csv").write_text("\n".join(["time,load_point_velocity,shear_stress,normal_stress", *rows]) + "\n")
    (tmp_path / "experiment.toml").write_text(HELD)
    done = json.loads(srf("check", str(tmp_path), "--json").stdout)
    found = done["meta"]["runs"][0]["tells"]
    assert found["variation"] > 2e-3
    held = any("the load is only held in steps" in note for note in done["notes"])
    assert held is not bool(eps) and (found["errors"]["alpha"] is None) is held


def test_a_short_part_has_the_noise_of_its_recording() -> None:
    """Of 64 samples at a step one line is a signal; what is usual at the rate, and at a slower one, holds there, too."""
    line = GaugeNoise(0.002, colours=((4.7, 0.04, 3.0),), samples=2000, stretch=2.5)
    short, fast = GaugeNoise(0.0016, samples=64, stretch=0.6), GaugeNoise(0.001, samples=6000, stretch=0.25)
    recorded = [(0.01, line), (0.01, line), (0.0101, short), (0.001, fast)]
    assert of_one_gauge({0.01: short, 0.001: fast}, recorded) == (line, replace(fast, colours=line.colours))
    assert of_one_gauge({0.01: short}, [(0.01, line), (0.01, short)]) == (short,)  # two do not say what is usual


def test_bounds_and_free_starts_cost_what_they_must(made: Path) -> None:
    experiment = read_experiment(made, registry=REGISTRY)
    experiment = replace(experiment, runs=experiment.runs[:1])
    base = told(experiment).runs[0].errors
    known = replace(experiment, parameters=tuple(replace(p, fixed=True) for p in experiment.parameters))
    narrow = tuple(
        replace(p, lower=p.value * (1 - 1e-9) - 1e-9, upper=p.value * (1 + 1e-9) + 1e-9) for p in experiment.parameters
    )
    free = replace(experiment, runs=tuple(replace(r, initial="free") for r in experiment.runs))
    least, most = told(known).runs[0].errors, told(free).runs[0].errors
    bounded = told(replace(experiment, parameters=narrow)).runs[0].errors
    for name in base:
        assert least[name] < base[name] < most[name] * 1.01
        assert bounded[name] == pytest.approx(least[name], rel=1e-3)


def test_a_long_run_is_thinned_without_another_answer(made: Path) -> None:
    experiment = read_experiment(made, registry=REGISTRY)
    experiment = replace(experiment, runs=experiment.runs[1:])
    whole = told(experiment).runs[0].errors
    thin = told(experiment, most=900).runs[0].errors
    assert thin != whole
    for name in whole:  # what a step of the load makes takes a few samples, of which blocks have more or fewer
        assert thin[name] == pytest.approx(whole[name], rel=0.3)


def test_a_simulation_unlike_the_recording_is_not_believed(small: Path) -> None:
    """Start values that put friction elsewhere say nothing about this recording."""
    toml = TOML.replace("[parameters]\n", "[parameters]\nmu0 = { value = 0.9, lower = 0.8, upper = 1.0 }\n")
    write(small, toml=toml)
    text = srf("check", str(small)).stdout
    assert "one: at the start values the simulation is " in text and "what it could tell is left out" in text
    assert "not estimated: no simulated run resembles its recording" in text


@pytest.mark.parametrize(
    ("error", "peak", "verdict"),
    [(0.01, 9.0, CAN), (0.01, 2.0, "can hardly be identified"), (0.01, 0.1, "cannot be identified"),
     (0.2, 9.0, "can hardly be identified"), (2.0, 9.0, "cannot be identified"), (math.inf, 0.0, "cannot be identified")],
)  # fmt: skip
def test_verdicts(error: float, peak: float, verdict: str) -> None:
    assert verdict_of("alpha", CramerRaoBound("a", False, 0.1, {"alpha": error}, {"alpha": peak})) == verdict


@pytest.mark.parametrize(
    ("law", "ageing", "interface", "asked"),
    [
        ("srf-vsat", "ruina", "rigid", {"alpha"}),
        ("dieterich-ruina", "dieterich+linker-dieterich", "power", {"alpha", "lambda", "n"}),
    ],
)
def test_other_laws_are_asked_what_they_have(law: str, ageing: str, interface: str, asked: set[str], small: Path) -> None:
    toml = TOML.replace("srf-vsat", law).replace('"dieterich"', f'"{ageing}"').replace('"elastic"', f'"{interface}"')
    experiment = read_experiment(write(small, toml=toml), registry=REGISTRY)
    assert set(told(experiment).runs[0].errors) == asked


# simulate reads by name, too


def test_a_load_file_is_read_by_a_named_reader(make_file: Callable[[str], Path]) -> None:
    path = make_file("load.dat")
    rows = [
        srf("simulate", "--V", "8", "--load-file", str(path), *more, "--rate", "50", "--csv").stdout
        for more in ((), ("--format", "csv"))
    ]
    assert rows[0] == rows[1] and len(rows[0].splitlines()) > 50
    stderr = srf("simulate", "--V", "8", "--load-file", str(path), "--format", "npz", code=2).stderr
    assert "load.dat: not a whole archive" in stderr
    assert "unknown reader 'cvs'" in srf("simulate", "--V", "8", "--load-file", str(path), "--format", "cvs", code=2).stderr
    assert "--format names the reader of a file" in srf("simulate", "--V", "8", "--format", "csv", code=2).stderr


def test_an_experiment_is_repeated_by_a_named_reader(small: Path) -> None:
    assert srf("simulate", str(small), "--format", "csv", "--csv").stdout.startswith("run,t,V,W")
    assert "not a whole archive" in srf("simulate", str(small), "--format", "npz", code=2).stderr


@pytest.fixture
def make_file(tmp_path: Path) -> Callable[[str], Path]:
    def make(name: str) -> Path:
        t = np.linspace(0, 2, 101)
        text = "\n".join(["time [s],normal_load [N]", *(f"{x:.4f},{5 + math.sin(x):.9f}" for x in t)])
        (tmp_path / name).write_text(text + "\n", encoding="utf-8")
        return tmp_path / name

    return make


def test_a_fast_stretch_has_the_slow_noise_that_another_rate_shows() -> None:
    """A quarter of a second at 1 kHz tells a line at 4.6 Hz from no trend, and the gauge has it all the same."""
    fast = GaugeNoise(1e-3, colours=((60.0, 2e-3, 3.0),), samples=9000, stretch=0.25)
    slow = GaugeNoise(1e-3, colours=((4.6, 0.04, 3.0), (20.0, 3e-3, 2.0), (0.5, 0.01), (0.1, 0.02)), samples=900, stretch=2.5)
    few = GaugeNoise(1e-3, colours=((1.0, 9.0),), samples=90, stretch=6.4)
    own = {0.001: fast, 0.01: slow}
    assert [n.colours for n in of_one_gauge(own, [*own.items()])] == [
        (*fast.colours, slow.colours[0], slow.colours[2]),
        slow.colours,
    ]
    assert of_one_gauge(own, [*own.items(), (0.1, few)])[1].colours == slow.colours
    assert of_one_gauge({0.01: slow}, [(0.01, slow)]) == (slow,)
