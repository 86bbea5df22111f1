"""The state-space likelihood: the free-running limit, derivatives, a linear model against statsmodels, particles, recovery."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from srfcli.codegen.c_source import compiler
from srfcli.core.errors import SrfError, Status
from srfcli.data.groups import grouped
from srfcli.data.values import Experiment, FitParameter, ModelChoice, Run, Signal
from srfcli.inference.fit import Problem, fit_problem, inverse
from srfcli.inference.prediction import predict
from srfcli.inference.state_space import (
    Interrupted,
    Likelihood,
    Maximum,
    StateSpaceFit,
    as_fit,
    filter_run,
    fit_state_space,
    interrupted_fit,
    likeliest_end,
    maximise,
    with_less_colour,
)
from srfcli.motion.imposed import ConstantLoad, Drive, LoadSteps, Modulation

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: the filter is compiled")

FIELD = {"field_amplitude": 2e-3, "field_length": 4.0}


@dataclass(frozen=True)
class Rig:
    """A model, one run under it, true values and what is asked of derivatives."""

    choice: dict[str, Any]
    values: dict[str, float]
    run: Run
    stiffness: str
    mass: float | None = None
    trend: str | None = None

    @property
    def experiment(self) -> Experiment:
        listed = tuple(FitParameter(n, v, v / 2, v * 2, False, "1") for n, v in self.values.items() if "." not in n)
        choice = ModelChoice(
            self.choice["law"], self.choice["ageing"], self.choice["interface"], self.choice["inertia"],
            tuple(self.choice.get("effects", ())),
        )  # fmt: skip
        return Experiment(Path(), "rig", choice, self.mass, self.stiffness, listed, (self.run,), ())


def recording(t, observable, drive, load, **change):
    run = Run("r", Path("x"), False, 0.0, "steady", t, np.zeros(t.size), observable, np.ones(t.size, bool), drive, load, 0.21,
              None, 0.0, ())  # fmt: skip
    return replace(run, **change)


PMMA = {"law": "srf-vsat", "ageing": "dieterich", "interface": "elastic", "inertia": True}
PMMA_VALUES = {"mu0": 0.33, "A": 0.0126, "B": 0.0246, "D0": 0.395, "Vsat": 240.0, "lambda": 0.54}
ROCK = {"law": "dieterich-ruina", "ageing": "ruina", "interface": "rigid", "inertia": False}
ROCK_VALUES = {"mu0": 0.6, "A": 0.008, "B": 0.010, "D0": 10.0}
STEPS = Drive.steps([(0.0, 5.0), (0.4, 20.0)])
RIGS = {
    "paper": Rig(PMMA, PMMA_VALUES, recording(np.linspace(0, 0.8, 161), "elongation", STEPS, ConstantLoad(5.0)),
                 "0.21 N/um", 2.37e-6),
    "stick-slip, modulated": Rig(
        PMMA, PMMA_VALUES,
        recording(np.linspace(0, 1.0, 401), "elongation", Drive.steps([(0.0, 12.0), (0.2, 8.0)]),
                  Modulation(9.0, 0.09, 60.0, 0.5)),
        "0.21 N/um", 2.37e-6,
    ),
    "rock, free start and trend": Rig(
        ROCK, ROCK_VALUES | {"r.mu": 0.605, "r.ln_phi": 0.8, "r.trend": 1e-5},
        recording(np.linspace(0, 20, 101), "friction", Drive.steps([(0.0, 3.0), (8.0, 30.0)]), ConstantLoad(20.0),
                  initial="free", stiffness=0.2),
        "0.2 N/um", trend="slip",
    ),
    "rock by load, uneven": Rig(
        ROCK, ROCK_VALUES,
        recording(np.cumsum(np.r_[0.0, np.tile([0.05, 0.4, 0.15], 40)]), "friction", Drive.steps([(0.0, 3.0), (8.0, 30.0)]),
                  Modulation(20.0, 0.05, 0.3), stiffness=20 * 0.01),
        "0.01 1/um",
    ),
    "hold, force": Rig(
        ROCK | {"ageing": "dieterich", "law": "dieterich-cutoff"}, ROCK_VALUES | {"D0": 2.0},
        recording(np.linspace(0, 30, 151), "force", Drive.steps([(0.0, 10.0), (5.0, 1e-3), (20.0, 10.0)]), ConstantLoad(4.0)),
        "0.21 N/um",
    ),
    "two states, nagata, power": Rig(
        {"law": "two-state", "ageing": "nagata", "interface": "power", "inertia": True}, {},
        recording(np.linspace(0, 0.8, 121), "elongation", STEPS, ConstantLoad(5.0)), "0.21 N/um", 2.37e-6,
    ),
    "a load that a servo follows, blocks that bulge": Rig(
        ROCK | {"effects": ("load-servo", "poisson-coupling", "linker-dieterich")},
        ROCK_VALUES | {"share": 0.8, "natural": 0.4, "damping": 0.3, "shift": 0.4, "alpha": 0.2},
        recording(np.linspace(0, 30, 151), "friction", Drive.steps([(0.0, 3.0), (15.0, 9.0)]),
                  LoadSteps.sequence([(8.0, 20.0, 20.0), (12.0, 22.0, 22.0)], rise=0.5), stiffness=0.2),
        "0.2 N/um",
    ),
    "a stiffer spring, a cell that creeps": Rig(
        PMMA | {"effects": ("load-stiffening", "gauge-creep", "pore-pressure")},
        PMMA_VALUES | {"m": 0.3, "Wref": 4.0, "share": 0.1, "creep_time": 0.1, "pressure": 0.4},
        recording(np.linspace(0, 0.8, 161), "force", STEPS, Modulation(5.0, 0.1, 20.0, 0.3)), "0.21 N/um", 2.37e-6,
    ),
    "lag of the gauge": Rig(
        PMMA | {"effects": ("sensor-lag",)}, PMMA_VALUES | {"time_constant": 0.01},
        recording(np.linspace(0, 0.8, 161), "elongation", STEPS, ConstantLoad(5.0)), "0.21 N/um", 2.37e-6,
    ),
}  # fmt: skip
# a micro-tribometer, whose load is put on at 0.5 s, and which sticks and slips then
MICRO = Rig(
    {"law": "srf-vsat", "ageing": "dieterich", "interface": "rigid", "inertia": True},
    {"mu0": 0.3, "A": 0.0093, "B": 0.016, "D0": 0.09, "Vsat": 800.0},
    recording(np.linspace(0, 6, 1501), "elongation", Drive.steps([(0.0, 8.0)]),
              LoadSteps.sequence([(0.5, 0.03, 0.3)], rise=0.03), stiffness=0.004),
    "0.004 N/um", 1e-9,
)  # fmt: skip


@pytest.fixture(params=RIGS.values(), ids=RIGS.keys())
def rig(request, make_model):
    """A rig with its model, and a recording of it in which each reading is 3 sd off at random."""
    own = request.param
    model = make_model(**own.choice, random_field=True)
    values = dict(own.values)
    if "lag of the gauge" in request.node.name:
        lag = next(n for n in model.names if n in ("tau", "time_constant", "lag"))
        values[lag] = values.pop("time_constant")
        own = replace(own, values=values)
    own = replace(own, values={n: v for n, v in values.items() if n in model.names or "." in n})
    y = predict(model, own.experiment, own.run, own.values | FIELD, trend=own.trend, rtol=1e-9).y
    sd = 1e-3 * float(np.ptp(y)) + 1e-6
    rng = np.random.default_rng(3)
    return replace(own, run=replace(own.run, observed=y + 3 * sd * rng.standard_normal(y.size))), model, sd


def test_without_a_field_it_is_the_free_running_likelihood(rig):
    own, model, sd = rig
    values = own.values | {"field_amplitude": 0.0, "field_length": 4.0, "gauge_white": sd}
    found = filter_run(model, own.experiment, own.run, values, trend=own.trend, rtol=1e-9)
    free = predict(model, own.experiment, own.run, values, trend=own.trend, rtol=1e-9).y
    assert found.whole
    assert np.abs(found.found.nu - (own.run.observed - free)).max() < 2e-3 * sd
    assert np.allclose(found.found.S, sd**2, rtol=1e-12)
    residual = own.run.observed - free
    ordinary = -0.5 * np.sum((residual / sd) ** 2 + np.log(2 * np.pi * sd**2))
    assert found.log_likelihood == pytest.approx(ordinary, abs=5e-3)


def test_derivatives_are_those_of_the_likelihood(rig):
    own, model, sd = rig
    values = own.values | FIELD | {"gauge_white": 3 * sd, "gauge_colour1": 2 * sd, "gauge_time1": 0.05}
    by = [n for n in values if values[n]]
    if own.stiffness.endswith("1/um"):
        by.append("K")
        values["K"] = 0.01
    exact = filter_run(model, own.experiment, own.run, values, by=by, trend=own.trend, rtol=1e-8)
    assert exact.whole
    worst = {}
    for j, name in enumerate(by):
        step = 1e-4 * abs(values[name])
        sides = [
            filter_run(model, own.experiment, own.run, values | {name: values[name] + sign * step}, trend=own.trend, rtol=1e-8)
            for sign in (1, -1)
        ]
        nu_d = (sides[0].found.nu - sides[1].found.nu) / (2 * step)
        S_d = (sides[0].found.S - sides[1].found.S) / (2 * step)
        for ours, theirs in ((exact.found.nu_d[:, j], nu_d), (exact.found.S_d[:, j], S_d)):
            scale = np.abs(theirs).max()
            if scale * step > 1e-7 * sd:  # a difference of nothing tells nothing
                worst[name] = max(worst.get(name, 0.0), np.abs(ours - theirs).max() / scale)
    assert len(worst) >= len(by) - 2
    assert max(worst.values()) < 1e-3, worst  # stick-slip is the worst, and there the differences are


def test_a_fall_that_comes_as_a_surprise_is_followed(make_model):
    """The equations are linearised again where the reading leads: no limit is needed, and derivatives are those of the whole."""
    own, model = RIGS["paper"], make_model(**PMMA, random_field=True)
    y = predict(model, own.experiment, own.run, own.values, rtol=1e-9).y
    run, values = replace(own.run, observed=np.where(own.run.t < 0.3, y, 0.1 * y)), own.values | FIELD | {"gauge_white": 0.01}

    def filtered(changed: dict[str, float], by: tuple[str, ...] = ()) -> Any:
        return filter_run(model, own.experiment, run, values | changed, by=by, rtol=1e-8).found

    by = ("A", "B", "D0", "field_amplitude", "field_length", "gauge_white")
    exact = filtered({}, by)
    assert exact.reached == run.t.size
    for j, name in enumerate(by):
        step = 1e-6 * values[name]
        sides = [filtered({name: values[name] + sign * step}) for sign in (1, -1)]
        for ours, theirs in ((exact.nu_d, sides[0].nu - sides[1].nu), (exact.S_d, sides[0].S - sides[1].S)):
            assert np.abs(ours[:, j] - theirs / (2 * step)).max() < 1e-3 * np.abs(theirs / (2 * step)).max(), name


@pytest.mark.parametrize("higher", [0.0, 3e-4])  # of the friction that was recorded
def test_falls_within_a_sample_are_followed_under_any_field(make_model, higher):
    """They come sooner or later than expected, by a reading a thousand of its own standard deviations off."""
    choice = {"law": "dieterich-ruina", "ageing": "ruina", "interface": "rigid", "inertia": True}
    drive, sd = Drive.steps([(0.0, 4.43), (1.0, 4.61)]), 0.027
    run = recording(np.linspace(0, 9, 2251), "elongation", drive, ConstantLoad(0.651), stiffness=0.00201)
    own = Rig(choice, {"mu0": 0.499, "A": 0.00716, "B": 0.01089, "D0": 0.0325}, run, "0.00201 N/um", 1.14e-9)
    y = predict(make_model(**choice), own.experiment, run, own.values | {"mu0": own.values["mu0"] + higher}, rtol=1e-10).y
    assert np.sum(np.diff(y) < -100 * sd) >= 3
    run = replace(run, observed=y + sd * np.random.default_rng(1).standard_normal(y.size))
    noise_alone = -y.size * (np.log(sd) + 0.5 * np.log(2 * np.pi) + 0.5)
    for amplitude, length in ((1e-3, 0.3), (1e-3, 1.0), (1e-3, 5.0), (3e-4, 1.0)):
        values = own.values | {"field_amplitude": amplitude, "field_length": length, "gauge_white": sd}
        found = filter_run(make_model(**choice, random_field=True), own.experiment, run, values)
        assert noise_alone - 250 < found.log_likelihood < noise_alone + 50, (amplitude, length)


def test_a_field_that_vanishes_leaves_the_deterministic_likelihood_of_stick_slip(make_model):
    """Three falls of a few samples: what readings say of their times is not linear, and the truth stays the truth."""
    own, sd = MICRO, 0.01
    model = make_model(**own.choice, random_field=True)
    y = predict(model, own.experiment, own.run, own.values, rtol=1e-10).y
    assert np.sum(np.diff(y) < -1.0) >= 3
    run = replace(own.run, observed=y + sd * np.random.default_rng(1).standard_normal(y.size))

    def height(amplitude: float) -> float:
        values = own.values | {"field_amplitude": amplitude, "field_length": 1.0, "gauge_white": sd}
        return filter_run(model, own.experiment, run, values, rtol=1e-7).log_likelihood

    heights = [height(a) for a in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 0.0)]
    assert np.all(np.diff(heights) > -0.1) and heights[0] > heights[-1] - 30
    assert heights[-2] == pytest.approx(heights[-1], abs=1.0)


def test_a_friction_that_is_one_unknown_number_has_the_likelihood_of_its_integral_in_stick_slip(make_model):
    """A field far longer than the slip is such a number: quadrature over the deterministic model's likelihood is exact."""
    own, sd, a, shift = MICRO, 0.01, 1e-4, 2e-4
    model = make_model(**own.choice, random_field=True)
    y = predict(model, own.experiment, own.run, own.values | {"mu0": own.values["mu0"] + shift}, rtol=1e-10).y
    run = replace(own.run, observed=y + sd * np.random.default_rng(1).standard_normal(y.size))

    def height(off: float, amplitude: float) -> float:
        values = own.values | {"field_amplitude": amplitude, "field_length": 1e7, "gauge_white": sd}
        values["mu0"] += off
        return filter_run(model, own.experiment, run, values, rtol=1e-7).log_likelihood

    grid = shift + np.linspace(-6e-5, 6e-5, 121)
    heights = np.array([height(off, 0.0) for off in grid])
    assert max(heights[0], heights[-1]) < heights.max() - 15  # all of it is within
    prior = np.exp(-0.5 * (grid / a) ** 2) / (a * np.sqrt(2 * np.pi))
    exact = heights.max() + np.log(np.sum(np.exp(heights - heights.max()) * prior) * (grid[1] - grid[0]))
    assert height(0.0, a) == pytest.approx(exact, abs=1.0)


def test_derivatives_of_every_function_that_a_law_may_have(tmp_path, make_model):
    """One law with all of them, by a number that stands inside and before each."""
    x, functions = "log(v/V0)", ("exp", "log1p", "expm1", "sin", "cos", "sinh", "cosh", "tanh", "asinh", "atan")
    terms = [f"c*{f}(c*{x} + {i + 1}/10)" for i, f in enumerate(functions)]
    terms += [f"c*sqrt(1 + {x}**2)", f"c*lambertw(1 + c*{x}**2)", "c*(v/V0)**c", "c*c**(c*phi*V0/D0)", "c*(1 + phi*V0/D0)**(1/3)"]
    values = {"mu0": 0.3, "A": 0.02, "B": 0.01, "c": 0.1, "D0": 0.4}
    lines = [
        f'{n} = {{ default = {v}, unit = "{"um" if n == "D0" else "1"}", about = "of the test" }}' for n, v in values.items()
    ]
    lines.append('V0 = { default = 1.0, unit = "um/s", about = "of the test" }')
    law = tmp_path / "all.toml"
    law.write_text(
        'format = "srf-law/1"\nkind = "friction"\nname = "all"\nabout = "Every function"\n'
        f'mu = "mu0 + A*log(v/V0) + B*log(1 + phi*V0/D0) + {" + ".join(terms)}"\n[parameters]\n' + "\n".join(lines)
    )
    run = recording(np.linspace(0, 0.8, 81), "elongation", STEPS, ConstantLoad(5.0))
    own = Rig(PMMA | {"law": str(law)}, values, run, "0.21 N/um", 2.37e-6)
    model = make_model(**own.choice, random_field=True)

    def innovations(c: float) -> Any:
        known = values | FIELD | {"gauge_white": 0.01, "c": c}
        return filter_run(model, own.experiment, replace(run, observed=shown), known, by=["c"], rtol=1e-9).found

    shown = predict(model, own.experiment, run, values, rtol=1e-9).y
    difference = (innovations(0.1001).nu - innovations(0.0999).nu) / 0.0002
    assert np.abs(innovations(0.1).nu_d[:, 0] - difference).max() < 1e-5 * np.abs(difference).max()


def test_gauge_noise_has_the_density_of_its_covariance(make_model):
    """Two sampling rates with a noise each: smooth, two relaxations in one, and a line; readings are missing. Dense algebra."""
    model, own = make_model(**ROCK, random_field=True), RIGS["rock, free start and trend"]
    t = np.r_[0.1 * np.arange(80), 8.0 + 0.01 * np.arange(90)]
    run = recording(t, "friction", Drive.constant(3.0), ConstantLoad(20.0), stiffness=0.2)
    run = replace(run, used=np.r_[np.ones(40, bool), np.zeros(7, bool), np.ones(123, bool)])
    assert run.sampling.spacings == pytest.approx((0.01, 0.1))
    assert np.abs(run.sampling.at - np.repeat([1, 0], [80, 90])).sum() < 3
    values = {n: v for n, v in own.values.items() if "." not in n} | {"field_amplitude": 0.0, "field_length": 4.0}
    steady = predict(model, replace(own, run=run).experiment, run, values, rtol=1e-9).y
    rng = np.random.default_rng(4)
    run = replace(run, observed=steady + 1e-3 * rng.standard_normal(t.size))
    noises = [(2e-4, 0.03, 3e-4, 9.0, 5e-4, 0.5), (3e-4, 0.2, 2e-4, 2.3, 4e-4, 0.3), (1e-4, 1.0, 1e-4, 8.0, 5e-4, 40.0)]
    local = ("gauge_white", "gauge_time1", "gauge_colour1", "gauge_frequency2", "gauge_colour2", "gauge_quality2")
    for pair in ((0, 1), (2, 0), (1, 2)):
        gauges = [{n: f"{n}[{k}]" for n in local} for k in range(2)]
        noise = {f"{n}[{k}]": v for k, i in enumerate(pair) for n, v in zip(local, noises[i], strict=True)}
        by = list(noise)

        def whole(changed, slopes=(), gauges=gauges, run=run):
            return filter_run(model, replace(own, run=run).experiment, run, values | changed, by=slopes, gauges=gauges, rtol=1e-9)

        found = whole(noise, by)
        expected = 0.0
        for k, i in enumerate(pair):
            white, tau, s, f, a, q = noises[i]
            at = run.used & (run.sampling.at == k)
            lag, omega = np.abs(np.subtract.outer(t[at], t[at])), 2 * np.pi * f
            fast = np.sqrt(complex(0.25 / q**2 - 1))  # kernel of e'' + (omega / q) e' + omega^2 e = noise, by its two rates
            roots = omega * np.array([-0.5 / q + fast, -0.5 / q - fast]) * (1 + 1e-7 * np.array([1, -1]))
            kernel = (roots[0] * np.exp(roots[1] * lag) - roots[1] * np.exp(roots[0] * lag)) / (roots[0] - roots[1])
            C = s**2 * np.exp(-lag / tau) + a**2 * kernel.real + white**2 * np.eye(at.sum())
            expected += multivariate_normal(np.zeros(at.sum()), C).logpdf((run.observed - steady)[at])
        assert found.log_likelihood == pytest.approx(expected, abs=2e-3)
        for name, slope in zip(by, found.score, strict=True):
            step = 1e-5 * noise[name]
            up, down = (whole(noise | {name: noise[name] + e}).log_likelihood for e in (step, -step))
            assert slope == pytest.approx((up - down) / (2 * step), rel=1e-4, abs=1e-3 / noise[name]), name


@pytest.mark.parametrize("beside", [(), ("slip", "contact_area"), ("force",)], ids=" ".join)
def test_a_linear_model_agrees_with_statsmodels(make_model, beside):
    """About steady sliding at one velocity everything is linear: matrix exponentials and a filter of another library."""
    kalman = pytest.importorskip("statsmodels.tsa.statespace.kalman_smoother")
    own = RIGS["paper"]
    model = make_model(**PMMA, random_field=True)
    n, dt, sd, tau, s = 160, 0.005, 0.02, 0.03, 0.015
    run = recording(dt * np.arange(n), "elongation", Drive.constant(5.0), ConstantLoad(5.0))
    used = np.ones(n, bool)
    used[60:75] = False
    seen = [used, *(np.roll(used, 20 * k) for k in range(1, 1 + len(beside)))]
    others = [Signal(what, np.zeros(n), u, 0.0) for what, u in zip(beside, seen[1:], strict=True)]
    run = replace(run, used=used, others=tuple(others))
    noises = [(sd * f, s * f, tau * g) for f, g in ((1.0, 1.0), (2.0, 0.5), (0.3, 3.0))][: 1 + len(beside)]
    gauges = [{m: f"{m}[{k}]" for m in ("gauge_white", "gauge_colour1", "gauge_time1")} for k in range(len(noises))]
    noise = {name: v for own, row in zip(gauges, noises, strict=True) for name, v in zip(own.values(), row, strict=True)}
    values = own.values | FIELD | noise | {"r.trend": 0.0, "r.slip": 3.0, "r.area": 1.2, "r.area_growth": 0.07}
    run = replace(run, observed=predict(model, replace(own, run=run).experiment, run, values, rtol=1e-10).y)
    still = replace(run, others=tuple(replace(s, used=np.zeros(n, bool)) for s in run.others))
    steady = filter_run(model, own.experiment, still, values, gauges=gauges, rtol=1e-12)
    others = [replace(s, observed=-steady.of(k).nu) for k, s in enumerate(run.others, 1)]  # so that all stays where it is linear
    run = replace(run, others=tuple(others))
    own = replace(own, run=run)
    found = filter_run(model, own.experiment, run, values, by=["r.trend"], gauges=gauges, trend="time", rtol=1e-12, keep=True)

    p = model.vector({k: v for k, v in values.items() if k in model.names} | {"V": 5.0, "W0": 5.0, "K": 0.21, "M": 2.37e-6})
    x0 = np.asarray(model.steady(p))
    J, g = np.asarray(model.rates_jacobian(x0, 5.0, 5.0, 0.0, p)), np.asarray(model.field_gain(x0, 5.0, 5.0, 0.0, p))
    k, c = x0.size, len(noises)
    block = expm(np.block([[-J, np.outer(g, g)], [np.zeros((k, k)), J.T]]) * dt)  # Van Loan 1978
    times, sizes = np.array([tau for *_, tau in noises]), np.array([s for _, s, _ in noises])
    T = np.zeros((k + c, k + c))
    T[:k, :k], T[k:, k:] = block[k:, k:].T, np.diag(np.exp(-dt / times))
    Q = np.zeros_like(T)
    Q[:k, :k], Q[k:, k:] = T[:k, :k] @ block[:k, k:], np.diag(sizes**2 * (1 - np.exp(-2 * dt / times)))
    columns = np.zeros((k, 2))
    for j, name in enumerate(("field_start", "field_slope_start")):
        up, down = (model.steady(model.vector(dict(zip(model.names, p, strict=True)) | {name: e})) for e in (0.5, -0.5))
        columns[:, j] = np.asarray(up) - np.asarray(down)
    P0 = np.zeros_like(T)
    P0[:k, :k], P0[k:, k:] = columns @ columns.T, np.diag(sizes**2)
    shows = {"slip": (0, -1.0), "force": (0, 0.21), "contact_area": (3, 1.2 * 0.07)}  # a state, and by how much

    filt = kalman.KalmanSmoother(k_endog=c, k_states=k + c, loglikelihood_burn=0)
    design = np.hstack([np.zeros((c, k)), np.eye(c)])
    for row, (state, size) in enumerate([(0, 1.0), *(shows[what] for what in beside)]):
        design[row, state] = size
    filt["design"], filt["obs_cov"] = design, np.diag([white**2 for white, *_ in noises])
    filt["transition"], filt["selection"] = T, np.eye(k + c)
    filt["state_cov"] = 0.5 * (Q + Q.T)
    filt.initialize_known(np.zeros(k + c), P0)
    filt.tolerance = 0.0
    filt.filter_univariate = True  # one reading after the other
    data = np.column_stack([run.t, *np.zeros((c - 1, n))])
    for column, own_used in enumerate(seen):
        data[~own_used, column] = np.nan
    filt.bind(data)
    theirs = filt.smooth()
    every = np.all(seen, axis=0)  # elsewhere statsmodels puts what it has of them in another order; the likelihood counts all
    for signal in range(c):
        ours = found.of(signal)
        S, nu = theirs.forecasts_error_cov[signal, signal], theirs.forecasts_error[signal]
        assert np.abs(ours.S / S - 1)[every].max() < 1e-8
        linear = -ours.nu_d[:, 0]  # innovations that readings proportional to time would bring, as all is linear
        scale = np.abs(theirs.forecasts_error[0][used]).max() * (1.0 if signal == 0 else abs(shows[beside[signal - 1]][1]))
        assert np.abs(linear - nu)[every].max() < 1e-8 * scale
    nu, S = -found.every.nu_d[found.used, 0], found.every.S[found.used]
    assert -0.5 * np.sum(np.log(2 * np.pi * S) + nu**2 / S) == pytest.approx(float(theirs.llf), rel=1e-8)
    assert np.abs(found.smoothed().covariance[:, 0, 0] / theirs.smoothed_state_cov[0, 0] - 1).max() < 1e-6
    assert np.abs(found.smoothed().covariance[:, 4, 4] / theirs.smoothed_state_cov[4, 4] - 1).max() < 1e-6


def test_the_field_is_stationary_where_nothing_is_read(make_model):
    own, model = RIGS["stick-slip, modulated"], make_model(**PMMA, random_field=True)
    run = replace(own.run, used=np.zeros(own.run.t.size, bool))
    values = own.values | {"field_amplitude": 1e-5, "field_length": 4.0, "gauge_white": 0.02}
    kept = filter_run(model, own.experiment, run, values, keep=True).found.kept
    block = kept.covariance[:, 4:6, 4:6] / 1e-10
    assert np.abs(block - np.eye(2)).max() < 1e-3


def test_particles_find_the_same_marginal_likelihood(make_model):
    """A bootstrap particle filter knows nothing of linearisation, covariances or the integrator."""
    model = make_model(**ROCK, random_field=True)
    t = np.linspace(0, 12, 25)
    run = recording(t, "friction", Drive.steps([(0.0, 3.0), (4.0, 12.0)]), ConstantLoad(20.0), stiffness=0.2)
    own = replace(RIGS["rock by load, uneven"], run=run, stiffness="0.2 N/um", values=ROCK_VALUES)
    sd, a, l = 3e-4, 8e-4, 3.0
    values = own.values | {"field_amplitude": a, "field_length": l, "gauge_white": sd}
    rng = np.random.default_rng(8)
    p = model.vector(ROCK_VALUES | {"V": 3.0, "W0": 20.0, "K": 0.2, "field_amplitude": a, "field_length": l})
    places, noise = {name: i for i, name in enumerate(model.states)}, model.index("field_noise")

    def begin(count):
        x = np.empty((count, len(model.states)))
        for i in range(count):
            q = p.copy()
            q[model.index("field_start")], q[model.index("field_slope_start")] = rng.standard_normal(2)
            x[i] = model.steady(q)
        return x

    def move(x, t0, t1, steps=60):
        h = (t1 - t0) / steps
        for k in range(steps):
            V = 3.0 if t0 + (k + 0.5) * h < 4.0 else 12.0
            q = p.copy()
            w = rng.standard_normal(x.shape[0]) / np.sqrt(h)
            gain = np.asarray(model.field_gain(x, V, 20.0, 0.0, q))
            assert q[noise] == 0.0

            def rate(y, V=V, q=q, kick=gain * w[:, None]):
                return np.asarray(model.rates(y, V, 20.0, 0.0, q)) + kick

            k1 = rate(x)
            x = x + h * rate(x + 0.5 * h * k1)
        return x

    def reading(x):
        return np.asarray(model.friction(x, 3.0, 20.0, 0.0, p))

    truth, seen = begin(1), []
    for k in range(t.size):
        truth = truth if k == 0 else move(truth, t[k - 1], t[k])
        seen.append(float(reading(truth)[0]) + sd * rng.standard_normal())
    run = replace(run, observed=np.array(seen))
    found = filter_run(model, replace(own, run=run).experiment, run, values)
    estimates = []
    for _ in range(4):
        x, total = begin(4000), 0.0
        for k in range(t.size):
            x = x if k == 0 else move(x, t[k - 1], t[k])
            z = (seen[k] - reading(x)) / sd
            weights = np.exp(-0.5 * z**2) / (sd * np.sqrt(2 * np.pi))
            total += np.log(weights.mean())
            x = x[rng.choice(x.shape[0], x.shape[0], p=weights / weights.sum())]
        estimates.append(total)
    spread = np.std(estimates, ddof=1)
    assert spread < 0.6
    assert abs(np.mean(estimates) - found.log_likelihood) < 0.15 + 2 * spread
    assert places["field"] == 2


def made(model, seed, amplitude, *, sd=3e-4):
    """Return two runs of steps on rock, each on a field of its own that is drawn by spectral sums, not by the model's states."""
    experiment_runs, t = [], np.linspace(0, 24, 481)
    rng = np.random.default_rng(seed)
    from srfcli.motion.integrators import integrate

    for k in range(2):
        drive = Drive.steps([(0.0, 3.0), (8.0, 10.0 * (k + 1)), (16.0, 3.0)])
        run = recording(t, "friction", drive, ConstantLoad(20.0), stiffness=0.2, name=f"r{k}")
        waves = np.abs(rng.standard_t(3, 400)) / 3.0 * np.sqrt(3) / np.sqrt(3)  # spectrum of Matern 3/2, correlation length 3 um
        phases = rng.uniform(0, 2 * np.pi, 400)
        m = amplitude * np.sqrt(2 / 400)
        from srfcli.codegen.splines import Spline

        table = Spline.over(-5.0, 400.0, 0.25)
        where = table.nodes
        table = table.with_coefficients(m * np.cos(np.outer(where, waves) + phases).sum(axis=1))
        p = model.vector(ROCK_VALUES | {"V": 3.0, "W0": 20.0, "K": 0.2})
        from srfcli.codegen.splines import appended

        x0 = np.asarray(model.steady(appended(p, [table])))
        x = integrate(model, p, drive=drive, load=ConstantLoad(20.0), t=t, start=x0, tables=[table], rtol=1e-8,
                      atol=1e-8 * np.ones(x0.size)).x  # fmt: skip
        y = np.asarray(model.friction(x, 3.0, 20.0, 0.0, appended(p, [table])))
        experiment_runs.append(replace(run, observed=y + sd * rng.standard_normal(t.size)))
    listed = tuple(FitParameter(n, 1.3 * v if n != "mu0" else v, v / 4, v * 4, False, "1") for n, v in ROCK_VALUES.items())
    return Experiment(Path(), "rock", ModelChoice("dieterich-ruina", "ruina", "rigid", False), None, "0.2 N/um", listed,
                      tuple(experiment_runs), ())  # fmt: skip


@pytest.mark.parametrize("amplitude", [0.0, 1e-3])
def test_a_fit_from_values_30_percent_off_finds_parameters_and_field(make_model, amplitude):
    tabled = make_model(**ROCK, tables=(("mu", "slip"),))
    model = make_model(**ROCK, random_field=True)
    experiment = made(tabled, 5, amplitude)
    found = fit_state_space(fit_problem(model, experiment))
    assert found.maximum.status is Status.OK
    errors = np.sqrt(np.diag(found.covariance))
    for name, error in zip(found.likelihood.names, errors, strict=True):
        if name in ROCK_VALUES:
            assert abs(found.values[name] - ROCK_VALUES[name]) < 3.5 * error, name
    assert found.maximum.point.rms == pytest.approx(1.0, abs=0.05)
    assert found.values["gauge_white"] == pytest.approx(3e-4, rel=0.1)
    assert found.smooth is (amplitude == 0)
    if amplitude:
        assert found.values["field_amplitude"] == pytest.approx(amplitude, rel=0.5)


def test_a_fit_of_stick_slip_under_coloured_noise_finds_parameters_and_noise(make_model):
    """A wide field, under which a fit begins, could stand for the noise, and the parameters drift meanwhile."""
    true, off = MICRO.values, {"mu0": 0.32, "A": 0.011, "B": 0.013, "D0": 0.075, "Vsat": 600.0}
    model = make_model(**MICRO.choice, random_field=True)
    y = predict(make_model(**MICRO.choice), MICRO.experiment, MICRO.run, true, rtol=1e-9).y
    rng, lag, sd = np.random.default_rng(8), 0.8, 0.02
    e = sd * rng.standard_normal(y.size)
    for k in range(1, y.size):
        e[k] = lag * e[k - 1] + np.sqrt(1 - lag**2) * e[k]
    listed = tuple(FitParameter(n, v, v / 5, v * 5, False, "1") for n, v in off.items())
    run = replace(MICRO.run, observed=y + e)
    found = fit_state_space(fit_problem(model, replace(MICRO.experiment, parameters=listed, runs=(run,))))
    errors = dict(zip(found.likelihood.names, np.sqrt(np.diag(found.covariance)), strict=True))
    for name in ("mu0", "A", "B", "D0"):
        assert abs(found.values[name] - true[name]) < 4 * errors[name], name
    assert errors["mu0"] < 0.05 and errors["A"] < 0.2 * true["A"]
    assert found.likelihood.processes == ("relaxation",)
    assert found.values["gauge_colour1"] == pytest.approx(sd, rel=0.15)
    assert found.values["gauge_time1"] == pytest.approx(-0.004 / np.log(lag), rel=0.3)


def of_stick_slip(make_model, law: str, true: dict[str, float], samples: int) -> Problem:
    """Return the problem of three seconds of stick-slip under a law's true parameters, with noise, on a random field."""
    t = np.linspace(0, 3.0, samples)
    run = recording(t, "elongation", Drive.steps([(0.0, 13.0), (0.5, 7.6)]), ConstantLoad(9.9), stiffness=0.21)
    listed = tuple(FitParameter(n, v, v / 5, v * 5, False, "1") for n, v in true.items())
    names = {"law": law, "ageing": "dieterich", "interface": "elastic", "inertia": True}
    experiment = Experiment(Path(), "slider", ModelChoice(**names), 2.37e-6, "0.21 N/um", listed, (run,), ())
    y = predict(make_model(**names), experiment, run, true).y
    run = replace(run, observed=y + 0.05 * np.random.default_rng(3).standard_normal(t.size))
    return fit_problem(make_model(**names, random_field=True), replace(experiment, runs=(run,)))


def test_a_fit_follows_a_ridge_that_bends(make_model):
    """In stick-slip mu0, Va, Vb and lambda make up for each other along a curve, which straight steps cross to and fro."""
    true = {"mu0": 0.43, "A": 0.0128, "B": 0.0263, "D0": 0.38, "Va": 14_700.0, "Vb": 260.0, "lambda": 0.55}
    likelihood = Likelihood(of_stick_slip(make_model, "dieterich-cutoff", true, 751), smooth=True, rtol=1e-3)
    off = {"mu0": 0.418, "Va": 4000.0, "Vb": 244.0, "lambda": 0.47, "gauge_white": 0.05}
    assert maximise(likelihood, likelihood.coordinates({**true, **off}), close=0.5).away < 0.5


def test_a_maximisation_does_not_end_below_what_it_passed(make_model):
    """Weights of readings, which lead past false maxima, may lead astray: it then goes on from the likeliest point on the way."""
    true = {"mu0": 0.43, "A": 0.0128, "B": 0.0263, "D0": 0.38, "lambda": 0.55}
    likelihood = Likelihood(of_stick_slip(make_model, "dieterich-ruina", true, 601), rtol=1e-3)
    wide = {"gauge_white": 0.05, "field_amplitude": 0.01, "field_length": 1.0}
    far = {"A": (0.0128, 0.0145), "B": (0.0331, 0.0418), "D0": (0.242, 0.378), "lambda": (0.632, 0.792)}
    for k in range(2):
        said: list[str] = []
        x = likelihood.coordinates({"mu0": 0.43, **{n: v[k] for n, v in far.items()}, **wide})
        found = maximise(likelihood, x, steps=12, close=1.0, progress=said.append)
        assert found.point.log_likelihood > max(float(text.split()[2].rstrip(",")) for text in said) - 2.0


@pytest.mark.slow
def test_from_far_off_a_score_promises_no_more_than_there_is(make_model):
    """Where a narrow field follows wrong parameters badly, half the squared distance in standard errors is no gain to come."""
    true = {"mu0": 0.43, "A": 0.0128, "B": 0.0263, "D0": 0.38, "lambda": 0.55}
    likelihood = Likelihood(of_stick_slip(make_model, "dieterich-ruina", true, 601), rtol=1e-3)
    wide = {"gauge_white": 0.05, "field_amplitude": 0.01, "field_length": 1.0}
    whole = maximise(likelihood, likelihood.coordinates({**true, **wide}))
    narrow = {"gauge_white": 0.003, "field_amplitude": 3e-4, "field_length": 1.0}
    far = maximise(likelihood, likelihood.coordinates({**true, "B": 0.03, "D0": 0.35, **narrow}), steps=1, widths=())
    assert far.point.log_likelihood + far.away**2 / 2 > 100 * whole.point.log_likelihood > 100 * far.expected


@pytest.mark.slow
def test_a_compliance_is_found_by_how_the_contact_rings(make_model):
    """In stick-slip it rings at 430 Hz, read every 4 ms: one lambda in 0.5 % explains that, and nothing leads there."""
    true = {"mu0": 0.459, "A": 0.0131, "B": 0.028, "D0": 0.403, "lambda": 0.523}
    names = {"law": "dieterich-ruina", "ageing": "dieterich", "interface": "elastic", "inertia": True}
    drive, t = Drive.steps([(0.0, 12.9), (0.5, 6.94)]), np.linspace(0, 2.4, 601)
    run = recording(t, "elongation", drive, ConstantLoad(9.76), stiffness=0.21)
    start = true | {"A": 0.012, "B": 0.026, "D0": 0.43, "lambda": 0.62}
    listed = tuple(FitParameter(n, v, v / 3, v * 3, False, "1") for n, v in start.items())
    choice = ModelChoice("dieterich-ruina", "dieterich", "elastic", True)
    experiment = Experiment(Path(), "slider", choice, 2.37e-6, "0.21 N/um", listed, (run,), ())
    y = predict(make_model(**names), experiment, run, true).y
    run = replace(run, observed=y + 0.02 * np.random.default_rng(1).standard_normal(t.size))
    found = fit_state_space(fit_problem(make_model(**names, random_field=True), replace(experiment, runs=(run,))))
    errors = dict(zip(found.likelihood.names, np.sqrt(np.diag(found.covariance)), strict=True))
    assert abs(found.values["lambda"] - true["lambda"]) < 4 * errors["lambda"] < 0.01
    assert found.maximum.point.rms == pytest.approx(1.0, abs=0.08)


def test_threads_change_nothing(make_model, monkeypatch):
    model = make_model(**ROCK, random_field=True)
    experiment = made(make_model(**ROCK, tables=(("mu", "slip"),)), 6, 1e-3)
    problem = fit_problem(model, experiment)
    found = []
    for count in (1, 2):
        monkeypatch.setattr("os.cpu_count", lambda count=count: count)
        likelihood = Likelihood(problem)
        found.append(likelihood.at(likelihood.start))
    a, b = found
    assert a.log_likelihood == b.log_likelihood and np.array_equal(a.score, b.score)


def test_a_model_without_a_field_has_no_filter(make_model):
    own = RIGS["paper"]
    with pytest.raises(SrfError, match=r"has no random friction field|unknown parameter"):
        filter_run(make_model(**PMMA), own.experiment, own.run, own.values | FIELD | {"gauge_white": 0.02})


@pytest.mark.parametrize("many", [10**6, 400])
def test_ctrl_c_keeps_the_likeliest_point_and_says_so(make_model, many):
    """In the fit to a part of the readings, too, whose noise is known by other sampling intervals."""
    model, calls = make_model(**ROCK, random_field=True), []
    experiment = grouped(made(make_model(**ROCK, tables=(("mu", "slip"),)), 6, 1e-3), ["noise"], "run", None)
    problem = fit_problem(model, experiment)

    def stop(text):
        calls.append(text)
        if sum("standard errors" in c for c in calls) == 3:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as caught:
        fit_state_space(problem, many=many, progress=stop)
    assert (caught.value.found.likelihood.problem is problem) == (many > 400)
    likely = interrupted_fit(problem, caught.value.found)
    for name in ("A", "D0", "field_amplitude"):
        assert likely.values[name] == caught.value.found.values[name]
    white = [[f.values[n] for n in f.likelihood.names if "white" in n] for f in (likely, caught.value.found)]
    assert white[0] == white[1] and len(white[0]) == len(problem.runs) > 1
    kept = as_fit(likely)
    assert kept.status is Status.INTERRUPTED and np.isfinite(kept.log_likelihood)
    first = Likelihood(problem)
    if many > 400:
        assert kept.log_likelihood > first.at(first.start).log_likelihood
    assert all(np.isfinite(list(kept.stderr.values())))


def test_one_more_start_is_tried_where_a_parameter_went_to_its_bound_or_the_field_stayed_wide(make_model):
    problem = fit_problem(make_model(**ROCK, random_field=True), made(make_model(**ROCK, tables=(("mu", "slip"),)), 6, 1e-3))
    rough = Likelihood(problem)
    x = rough.start.copy()
    x[rough.names.index("field_amplitude")] = np.log(0.8e-3 * 0.6)  # of the friction
    faint = rough.at(x)
    wide = rough.at(rough.start)

    def led(bounded, height, point=faint):
        x = point.x.copy()
        x[0] = rough.lower[0] if bounded else x[0]
        return Maximum(replace(point, x=x, log_likelihood=height), 0.5, Status.OK, np.zeros((x.size, x.size)))

    for ends, count, best in (
        ([led(False, 1.0), led(False, 9.0)], 1, 1.0),
        ([led(True, 1.0), led(False, 2.0), led(False, 9.0)], 2, 2.0),
        ([led(True, 3.0), led(True, 2.0), led(False, 9.0)], 2, 3.0),
        ([led(False, 3.0, wide), led(False, 2.0), led(False, 9.0)], 2, 3.0),
        ([led(False, 1.0, wide), led(False, 2.0, wide)], 2, 2.0),
    ):
        left = iter(ends)
        found = likeliest_end(rough, left)
        assert len(list(left)) == len(ends) - count and found.point.log_likelihood == best


def test_coloured_gauge_noise_is_found(make_model):
    """Readings with noise of two times of correlation: errors allow for both, and no field takes their place."""
    model = make_model(**ROCK, random_field=True)
    experiment = made(make_model(**ROCK, tables=(("mu", "slip"),)), 7, 0.0, sd=2e-4)
    rng, spoilt = np.random.default_rng(2), []
    for run in experiment.runs:
        colour = np.zeros(run.t.size)
        keep = np.exp(-0.05 / 0.5)
        for i in range(1, run.t.size):
            colour[i] = keep * colour[i - 1] + 4e-4 * np.sqrt(1 - keep**2) * rng.standard_normal()
        spoilt.append(replace(run, observed=run.observed + colour))
    found = fit_state_space(fit_problem(model, replace(experiment, runs=tuple(spoilt))))
    assert found.likelihood.processes == ("relaxation",) and found.smooth
    assert found.values["gauge_colour1"] == pytest.approx(4e-4, rel=0.3)
    assert found.values["gauge_time1"] == pytest.approx(0.5, rel=0.5)
    errors = np.sqrt(np.diag(found.covariance))
    for name, error in zip(found.likelihood.names, errors, strict=True):
        if name in ROCK_VALUES:
            assert abs(found.values[name] - ROCK_VALUES[name]) < 3.5 * error, name
    wider = found.likelihood.beside(found.likelihood.problem, ("relaxation", "relaxation"))
    more = StateSpaceFit(wider, maximise(wider, wider.coordinates(found.values), steps=8))
    fewer = with_less_colour(more, 0.1)
    assert fewer.likelihood.processes == ("relaxation",)
    assert fewer.log_likelihood == pytest.approx(found.log_likelihood, abs=0.1)


def test_what_nothing_determines_has_an_enormous_variance():
    """A track that explains all that a parameter does leaves of its information what cancels, which may be just below zero."""
    covariance = inverse(np.array([[4.0, 0.0], [0.0, -1e-18]]))
    assert covariance[0, 0] == pytest.approx(0.25) and 1e12 < covariance[1, 1] < np.inf
