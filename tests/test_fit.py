"""Fits of made recordings: noise models, derivatives of predictions, recovery, intervals, false minima."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import srfcli as srf
from srfcli.core.errors import SrfError, Status
from srfcli.data.values import Experiment, FitParameter, ModelChoice, Run
from srfcli.inference.fit import fit_problem
from srfcli.inference.noise import Noise, difference_level, estimate_noise, lag_one, log_determinant, stretches, whiten
from srfcli.inference.posterior import profile
from srfcli.inference.prediction import basis, predict, run_specific_names, run_specific_start
from srfcli.inference.recordings import fit_from_several
from srfcli.inference.state_space import StateSpaceFit, as_fit, fit_state_space
from srfcli.motion.imposed import ConstantLoad, Drive, Modulation
from srfcli.results.fit import said_likelier

ROCK = ModelChoice("dieterich-ruina", "ruina", "rigid", False)
ROCK_TRUE = {"mu0": 0.6, "A": 0.008, "B": 0.010, "D0": 10.0}
PMMA = ModelChoice("srf-vsat", "dieterich", "elastic", True)
PMMA_TRUE = {"mu0": 0.33, "A": 0.0126, "B": 0.0246, "D0": 0.395}


def ar_noise(seed, n, coefficients, innovation):
    rng = np.random.default_rng(seed)
    out = np.zeros(n + 500)
    for i in range(len(coefficients), n + 500):
        out[i] = sum(c * out[i - 1 - k] for k, c in enumerate(coefficients)) + innovation * rng.standard_normal()
    return out[500:]


def rock(model, *, seed=1, lag=0.0, sd=5e-4, observable="friction", start=1.2, runs=2, **change):
    """Return an experiment of velocity steps on rock, quasi-static, its start values off by a fifth."""
    made = []
    t = np.linspace(0, 60, 301)
    parameters = tuple(FitParameter(n, v * start, v / 5, v * 5, False, "1") for n, v in ROCK_TRUE.items())
    parameters = (replace(parameters[0], value=0.59, lower=0.3, upper=0.9), *parameters[1:])
    base = Experiment(Path(), "steps", ROCK, None, "0.2 N/um", parameters, (), ())
    for k in range(runs):
        drive = Drive.steps([(0.0, 3.0), (20.0, 10.0 * (k + 1))])
        run = Run(f"r{k}", Path("x"), False, 0.0, "steady", t, np.zeros(t.size), observable, np.ones(t.size, bool),
                  drive, ConstantLoad(20.0), 0.2, None, 0.0, ())  # fmt: skip
        run = replace(run, **change)
        values = ROCK_TRUE | {f"r{k}.mu": 0.61, f"r{k}.ln_phi": 0.5, f"r{k}.trend": 1e-5}
        y = predict(model, base, run, values, trend="slip" if "trend" in change else None).y
        noise = ar_noise(seed + 100 * k, t.size, (lag,) if lag else (), sd * np.sqrt(1 - lag**2))
        made.append(replace(run, observed=y + noise))
    return replace(base, runs=tuple(made))


@pytest.fixture(scope="module")
def rock_model(make_model):
    return make_model(law="dieterich-ruina", ageing="ruina", interface="rigid", inertia=False, random_field=True)


def fit(problem, smooth=True):
    return as_fit(fit_state_space(problem, smooth=smooth))


@pytest.mark.parametrize("coefficients", [(), (0.85,), (1.2, -0.5), (0.5, 0.2, 0.1)])
def test_noise_is_estimated(coefficients):
    values = ar_noise(3, 20_000, coefficients, 0.1)
    found = estimate_noise(values, [(0, values.size)])
    assert found.innovation == pytest.approx(0.1, rel=0.03)
    padded = [*coefficients, *[0.0] * 6]
    assert [*found.coefficients, *[0.0] * 6][:6] == pytest.approx(padded[:6], abs=0.04)
    assert found.order >= len(coefficients)


@pytest.mark.parametrize("coefficients", [(), (0.85,), (1.2, -0.5)])
def test_whitening_is_the_exact_likelihood(coefficients):
    n, noise = 12, Noise(0.3, coefficients)
    impulse = np.zeros(4000)
    impulse[0] = 1.0
    for i in range(1, 4000):
        impulse[i] = sum(c * impulse[i - 1 - k] for k, c in enumerate(coefficients) if i - 1 - k >= 0)
    covariance = [0.09 * float(impulse[: 4000 - k] @ impulse[k:]) for k in range(n)]
    values = np.random.default_rng(0).standard_normal(n)
    matrix = np.array([[covariance[abs(i - j)] for j in range(n)] for i in range(n)])
    white = whiten(noise, values, [(0, n)])
    ours = -0.5 * white @ white - log_determinant(noise, [(0, n)]) - 0.5 * n * np.log(2 * np.pi)
    assert ours == pytest.approx(multivariate_normal(np.zeros(n), matrix).logpdf(values), rel=1e-9)


def test_whitening_of_columns_and_of_stretches():
    noise, data = Noise(0.2, (0.7,)), np.random.default_rng(1).standard_normal((30, 3))
    parts = [(0, 10), (12, 30)]
    whole = whiten(noise, data, parts)
    assert whole.shape == (28, 3)
    assert whole[:, 1] == pytest.approx(whiten(noise, data[:, 1], parts))
    assert whole[10, 0] == pytest.approx(data[12, 0] / (0.2 / np.sqrt(1 - 0.49)))  # the second stretch begins anew


def test_stretches_end_at_gaps_and_changes_of_rate():
    t = np.concatenate([np.arange(10) * 0.1, 5 + np.arange(10) * 0.1, 6 + np.arange(10) * 0.01])
    used = np.ones(t.size, bool)
    used[3] = False
    found = stretches(t, used)
    assert found[0] == (0, 3) and found[1][0] == 4
    assert sum(b - a for a, b in found) == 29
    assert all(np.ptp(np.diff(t[a:b])) < 1e-9 for a, b in found if b - a > 2)


def test_levels_of_noise():
    t, rng = np.linspace(0, 10, 5000), np.random.default_rng(5)
    white = 0.02 * rng.standard_normal(t.size)
    assert difference_level(np.sin(t) + white, [(0, t.size)]) == pytest.approx(0.02, rel=0.05)
    assert lag_one(ar_noise(2, 20_000, (0.9,), 1.0), [(0, 20_000)]) == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("observable", ["friction", "force", "elongation"])
@pytest.mark.parametrize("initial", ["steady", "free"])
def test_prediction_slopes(rock_model, observable, initial):
    experiment = rock(rock_model, observable=observable, initial=initial)
    run = experiment.runs[1]
    by = ["mu0", "A", "D0", "K", *run_specific_names(rock_model, run, "slip")]
    values = ROCK_TRUE | {"K": 0.2, "r1.mu": 0.61, "r1.ln_phi": 0.4, "r1.trend": 2e-5}
    found = predict(rock_model, experiment, run, values, by=by, rtol=1e-9, trend="slip").J
    for k, name in enumerate(by):
        step = 1e-4 * max(abs(values[name]), 1e-3)
        sides = [
            predict(rock_model, experiment, run, values | {name: values[name] + s * step}, rtol=1e-11, trend="slip").y
            for s in (1, -1)
        ]
        expected = (sides[0] - sides[1]) / (2 * step)
        assert np.abs(found[:, k] - expected).max() < 2e-4 * np.abs(expected).max() + 1e-12, name
        assert np.abs(expected).max() > 0, name


def test_a_free_start_is_observed_where_it_should_be(rock_model):
    experiment = rock(rock_model, initial="free")
    y = predict(rock_model, experiment, experiment.runs[0], ROCK_TRUE | {"r0.mu": 0.61, "r0.ln_phi": 0.4}).y
    assert y[0] == pytest.approx(0.61, rel=1e-9)


@pytest.fixture(scope="module")
def whole(rock_model):
    """The fit to white noise."""
    return fit_state_space(fit_problem(rock_model, rock(rock_model)), smooth=True)


@pytest.fixture(scope="module")
def recovered(rock_model, whole):
    """Fits to white noise and to noise of a lag-one correlation of 0.9, by this."""
    return {0.0: as_fit(whole), 0.9: fit(fit_problem(rock_model, rock(rock_model, lag=0.9)))}


@pytest.mark.parametrize("lag", [0.0, 0.9])
def test_recovery(recovered, lag):
    found = recovered[lag]
    assert found.status is Status.OK
    for name, value in ROCK_TRUE.items():
        assert abs(found.values[name] - value) < 4 * found.stderr[name], name
        assert found.stderr[name] < 0.2 * value
    assert all(bool(f.colours) == (lag > 0) for f in found.runs)


def test_coloured_noise_widens_the_errors(recovered):
    white, coloured = recovered[0.0], recovered[0.9]
    assert coloured.stderr["mu0"] > 2.5 * white.stderr["mu0"]  # a mean of AR(1): sqrt((1 + 0.9)/(1 - 0.9)) = 4.4


@pytest.mark.slow
def test_errors_are_those_of_repeats(rock_model):
    found = [fit(fit_problem(rock_model, rock(rock_model, seed=s, lag=0.6, runs=1))) for s in range(10)]
    z = np.array([[(f.values[n] - v) / f.stderr[n] for n, v in ROCK_TRUE.items()] for f in found])
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4
    assert np.mean(np.abs(z) < 1.96) > 0.85


def test_profile_of_a_nearly_linear_parameter(whole):
    interval = profile(whole, "mu0")
    half = 1.96 * as_fit(whole).stderr["mu0"]
    assert interval.high - whole.values["mu0"] == pytest.approx(half, rel=0.05)
    assert whole.values["mu0"] - interval.low == pytest.approx(half, rel=0.05)


def test_a_profile_says_where_a_refit_is_likelier_than_the_fit(whole):
    """A fit that was broken off stands below the maximum; one at its maximum has nothing likelier beside it."""
    at_its_maximum = profile(whole, "A")
    assert at_its_maximum.likelier is None
    own, truth = whole.likelihood, whole.maximum.point.x
    far = truth + np.sqrt(np.diag(whole.maximum.covariance)) * np.where(np.arange(truth.size) == own.names.index("D0"), 3.0, 0.0)
    broken = StateSpaceFit(own, replace(whole.maximum, point=own.at(far)))
    interval = profile(broken, "A")
    assert interval.gain == pytest.approx(whole.log_likelihood - broken.log_likelihood, abs=2.0) and interval.gain > 2
    assert interval.likelier["D0"] == pytest.approx(whole.values["D0"], rel=0.1)
    (said,) = said_likelier([at_its_maximum, interval], lambda name, x: ("um" if name == "D0" else "1", [x]))
    assert "in the profile of A, is likelier by" in said and f"D0 = {interval.likelier['D0']:.5g}" in said


def test_trend_and_free_start_are_fitted(rock_model):
    experiment = rock(rock_model, initial="free", runs=1)
    run = experiment.runs[0]
    drift = 2e-5 * 3.0 * run.t
    experiment = replace(experiment, runs=(replace(run, observed=run.observed + drift),))
    found = fit(fit_problem(rock_model, experiment, trend="slip"))
    assert abs(found.values["r0.mu"] - 0.61) < 4 * found.stderr["r0.mu"]
    assert found.values["r0.trend"] > 0 and found.rms_over_noise() == pytest.approx(1.0, abs=0.1)


def test_a_trend_may_be_as_steep_by_time_as_by_slip(rock_model):
    (run,) = rock(rock_model, runs=1).runs
    p = np.zeros(len(rock_model.names))
    for trend in ("slip", "time"):
        start, lower, upper = run_specific_start(rock_model, run, p, "r0.trend", trend)
        assert start == 0.0 and lower == -upper
        assert upper * np.ptp(basis(run, trend)) == pytest.approx(10 * np.ptp(run.observed))


@pytest.mark.parametrize("first", [0.0, -5e-4, 1e-4])
def test_a_run_may_begin_without_any_friction(rock_model, first):
    (run,) = rock(rock_model, runs=1).runs
    unloaded = replace(run, observed=run.observed - run.observed[0] + first, initial="free")
    unloaded.observed[:5] = first
    mu, lower, upper = run_specific_start(rock_model, unloaded, np.zeros(len(rock_model.names)), "r0.mu")
    assert mu == first and lower < mu - 0.09 and upper > mu + 0.09


@pytest.mark.slow
def test_stick_slip_from_afar(make_model):
    """A start at which sliding is steady, whatever the recording does."""
    model = make_model(random_field=True)
    t = np.arange(900) / 300
    parameters = tuple(FitParameter(n, v, v / 3, v * 3, False, "1") for n, v in PMMA_TRUE.items())
    base = Experiment(Path(), "", PMMA, 2.37e-6, "0.21 N/um", parameters, (), ())
    runs = []
    for k, (drive, load) in enumerate(
        [(Drive.steps([(0, 12.0), (0.3, 8.0)]), ConstantLoad(9.0)), (Drive.constant(20.0), Modulation(7.0, 0.2, 30.0, 0.5))]
    ):
        run = Run(f"p{k}", Path("x"), False, 0.0, "steady", t, np.zeros(t.size), "elongation", np.ones(t.size, bool),
                  drive, load, 0.21, None, 0.0, ())  # fmt: skip
        y = predict(model, base, run, PMMA_TRUE).y + 0.02 * np.random.default_rng(k).standard_normal(t.size)
        runs.append(replace(run, observed=y))
    off = {"mu0": 1.03, "A": 1.13, "B": 0.89, "D0": 1.13}
    moved = tuple(replace(q, value=q.value * off[q.name]) for q in parameters)
    found = fit(fit_problem(model, replace(base, parameters=moved, runs=tuple(runs))), smooth=None)
    assert found.rms_over_noise() == pytest.approx(1.0, abs=0.05)
    for name, value in PMMA_TRUE.items():
        assert abs(found.values[name] - value) < 4 * found.stderr[name], name


def test_several_starts_agree_and_are_seeded(rock_model):
    problem = fit_problem(rock_model, rock(rock_model, runs=1))
    best, rows, interrupted = fit_from_several(problem, smooth=True, count=2, seed=4)
    assert len(rows) == 2 and all(same for _, same in rows) and not interrupted
    assert fit_from_several(problem, smooth=True, count=2, seed=4)[0].values == best.values


def test_starts_that_were_not_done_are_not_passed_over(rock_model):
    problem, calls = fit_problem(rock_model, rock(rock_model, runs=1)), []

    def stop(text):
        calls.append(text)
        if text.startswith("start 2 of 3"):
            raise KeyboardInterrupt

    _, rows, interrupted = fit_from_several(problem, smooth=True, count=3, seed=4, progress=stop)
    assert interrupted and len(rows) == 1


@pytest.mark.parametrize(
    ("change", "message"), [({"free": ["a"]}, "'a' has no start value"), ({"free": []}, "no parameter is free")]
)
def test_misuse(rock_model, change, message):
    with pytest.raises(SrfError, match=message):
        fit_problem(rock_model, rock(rock_model), **change)


def test_held_out_runs_are_judged_only(rock_model):
    experiment = rock(rock_model)
    spoilt = replace(experiment.runs[1], holdout=True, observed=experiment.runs[1].observed + 0.05)
    found = fit(fit_problem(rock_model, replace(experiment, runs=(experiment.runs[0], spoilt))))
    assert found.rms_over_noise() == pytest.approx(1.0, abs=0.1) and found.rms_over_noise(holdout=True) > 10


@pytest.mark.slow
def test_open_case_with_nothing_concealed(shared):
    truth = json.loads((shared / "cases" / "truth.json").read_text())["open-01"]["parameters"]
    found = srf.fit(shared / "cases" / "open-01").found.fit
    assert found.status.ok and found.rms_over_noise() == pytest.approx(1.0, abs=0.01)
    for name in found.names:
        assert abs(found.values[name] - truth["lam" if name == "lambda" else name]) < 3 * found.stderr[name], name
