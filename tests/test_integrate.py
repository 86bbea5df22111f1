"""The simulator: against the arrays' own rates, another integrator, Floquet theory, and what cannot be asked of it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from brittle_law import END, brittle_law
from brute import Slider, rates, steady
from scipy.integrate import solve_ivp

from srfcli.codegen.model import open_model
from srfcli.core.errors import SrfError, Status
from srfcli.data.noise import white_level
from srfcli.laws.registry import load_registry
from srfcli.motion.imposed import ConstantLoad, Drive, Modulation, SampledLoad
from srfcli.motion.integrators import scalar_function, scalar_source
from srfcli.motion.simulate import simulate
from srfcli.numerics.orbit import solve_orbits, steady_guess, uniform_mesh


def combinations():
    """Every kind of system with the paper's laws; the slow ones, which take long to derive, with others."""
    for law, ageing in (("srf-vsat", "dieterich"), ("two-state", "ruina+linker-dieterich"), ("rice-regularized", "kato-tullis")):
        for interface, loading, inertia in itertools.product(("elastic", "rigid"), ("vertical", "inclined"), (True, False)):
            names = {"law": law, "ageing": ageing, "interface": interface, "loading": loading, "inertia": inertia}
            marks = [pytest.mark.slow] if law != "srf-vsat" else []
            yield pytest.param(names, marks=marks, id="-".join(str(v) for v in names.values()))


@pytest.mark.parametrize("names", list(combinations()))
def test_scalar_functions_equal_the_array_functions(make_model, names):
    model = make_model(**names, stability=False)  # what motion needs
    p = model.vector({"V": 7.0, "W0": 6.0})
    x = model.steady(p) + 0.1 * np.cos(np.arange(len(model.states)))
    for name in ("rates", "rates_jacobian", "friction", "elongation"):
        scalar = np.array(scalar_function(model, name, p)(x.tolist(), 6.5, 5.5, 3.0))
        assert scalar == pytest.approx(getattr(model, name)(x, 6.5, 5.5, 3.0, p), rel=1e-12, abs=1e-12), name


def test_scalar_text_hoists_what_depends_on_parameters_alone(model):
    text = scalar_source(model.source, "rates")
    before, inner = text.split("    def rates(")
    assert "p[" in before and "p[" not in inner
    assert "..." not in text
    with pytest.raises(SrfError, match="no function 'rates_of_change'"):
        scalar_source(model.source, "rates_of_change")


def test_steady_sliding_stays(model):
    t = np.linspace(0.0, 2.0, 21)
    trace = simulate(model, model.vector(), drive=Drive.constant(8.0), load=ConstantLoad(6.0), t=t)
    assert trace.status is Status.OK and trace.reached == 2.0
    assert trace.v == pytest.approx(np.full(21, 8.0), rel=1e-6)
    assert trace.u == pytest.approx(6.0 * trace.mu / 0.21, rel=1e-7)
    assert trace.phi == pytest.approx(np.full(21, 0.402 / 8.0), rel=1e-6)


def test_a_modulated_record_agrees_with_another_integrator(model):
    s = Slider(8.0, 8.1, 0.18)
    start = steady(s) + np.array((0.0, 0.0, 0.5, 0.0))
    t = np.linspace(0.0, 0.5, 101)
    drive, load = Drive.constant(s.V), Modulation(s.W0, s.eps, s.f)
    trace = simulate(model, model.vector(), drive=drive, load=load, t=t, start=start, rtol=1e-11)
    other = solve_ivp(lambda t, x: rates(s, t, *x), (0.0, 0.5), start, method="DOP853", rtol=1e-11, atol=1e-11, t_eval=t)
    assert trace.x == pytest.approx(other.y.T, rel=1e-6, abs=1e-6)
    assert pytest.approx(s.W0 * (1 + s.eps * np.cos(2 * np.pi * s.f * t)), rel=1e-13) == trace.W
    assert trace.mu == pytest.approx(s.mu0 + s.A * np.log(trace.v) + s.B * np.log1p(s.Vsat * trace.phi / s.D0), rel=1e-12)


@pytest.mark.parametrize("eps", [0.03, 0.045])
def test_growth_on_a_trace_is_the_floquet_multiplier(model, eps):
    """Two traces disturbed by opposite amounts: their difference, once a period, grows by |rho|."""
    p = model.vector({"V": 8.0, "W0": 8.1, "eps": eps})
    batch = solve_orbits(model, p[:, None], steady_guess(model, p[:, None], uniform_mesh(64)))
    orbit, rho = batch.orbit.x[0, 0], batch.multipliers[0, 0]
    t = np.arange(201) / 120.0
    kick = np.array([0.0, 0.0, 1e-4, 0.0])
    up, down = (
        simulate(model, p, drive=Drive.constant(8.0), load=Modulation(8.1, eps, 120.0), t=t, start=orbit + k, rtol=1e-12)
        for k in (kick, -kick)
    )
    d = (up.x - down.x)[60:]
    _, b = np.linalg.lstsq(np.stack([d[8:-8].ravel(), d[:-16].ravel()], axis=-1), d[16:].ravel())[0]
    assert np.log(-b) / 16 == pytest.approx(np.log(abs(rho)), abs=2e-6)


def test_slide_hold_slide(model):
    """Contacts strengthen with ln(hold time) while slip creeps to next to nothing."""
    hold = Drive.steps([(0.0, 10.0), (1.0, 0.0), (101.0, 10.0)])
    t = np.linspace(0.0, 103.0, 10301)
    trace = simulate(model, model.vector(), drive=hold, load=ConstantLoad(5.0), t=t)
    assert trace.status is Status.OK
    assert trace.v.min() < 1e-4 and np.isfinite(trace.x).all()
    assert trace.phi.max() == pytest.approx(100.0, rel=0.01)
    assert trace.mu[-1] == pytest.approx(trace.mu[0], abs=2e-4)
    assert trace.mu.max() > trace.mu[0] + 0.02
    assert trace.V[100] == 0.0 and trace.V[99] == 10.0


def test_output_times_do_not_change_the_motion(model):
    drive, load = Drive.sequence([(0.4, 5.0, 20.0), (1.0, 20.0, 20.0)]), Modulation(6.0, 0.1, 120.0, onset=0.15)
    fine = simulate(model, model.vector(), drive=drive, load=load, t=np.linspace(0.0, 1.0, 1001), rtol=1e-10)
    coarse = simulate(model, model.vector(), drive=drive, load=load, t=np.array([0.0, 0.3, 1.0]), rtol=1e-10)
    assert coarse.x == pytest.approx(fine.x[[0, 300, 1000]], rel=1e-6, abs=1e-6)
    assert fine.V[[0, 200, 400, 1000]] == pytest.approx([5.0, 12.5, 20.0, 20.0])


def test_a_sampled_load_is_the_load_it_was_sampled_from(model):
    whole = Modulation(6.0, 0.05, 20.0)
    times = np.linspace(-0.1, 1.1, 6001)
    sampled = SampledLoad(times, whole(times)[0])
    t = np.linspace(0.0, 1.0, 201)
    assert sampled(t)[0] == pytest.approx(whole(t)[0], rel=1e-8)
    assert sampled(t)[1] == pytest.approx(whole(t)[1], abs=1e-3)
    p, drive, start = model.vector(), Drive.constant(8.0), model.steady(model.vector({"V": 8.0, "W0": 6.0}))
    a, b = (simulate(model, p, drive=drive, load=load, t=t, start=start, rtol=1e-10) for load in (whole, sampled))
    assert a.x == pytest.approx(b.x, rel=1e-5, abs=1e-5)


def test_a_load_that_was_sampled_fast_in_a_part_holds_the_steps_short_there_alone(model):
    """A slow oscillation of the load, read at 20 Hz for 100 s and at 2 kHz for 20 s: motion as under the load itself."""
    whole = Modulation(6.0, 0.05, 0.5)
    slow, fast = np.arange(-100, 2000) * 0.05, 100.0 + np.arange(40100) * 5e-4
    sampled = SampledLoad(np.concatenate([slow, fast]), whole(np.concatenate([slow, fast]))[0])
    assert sampled.longest_step(0.0, 90.0) > 50 * sampled.longest_step(101.0, 119.0)
    t = np.linspace(0.0, 119.0, 201)
    p, drive, start = model.vector(), Drive.constant(8.0), model.steady(model.vector({"V": 8.0, "W0": 6.0}))
    a, b = (simulate(model, p, drive=drive, load=load, t=t, start=start, rtol=1e-10) for load in (whole, sampled))
    assert a.x == pytest.approx(b.x, rel=1e-5, abs=1e-5)


def test_a_load_read_at_uneven_times_is_the_load_it_was_sampled_from():
    """Nine samples a period, each up to 0.4 of an interval off its place: no short interval is bridged, and nothing is noise."""
    rng, whole = np.random.default_rng(4), Modulation(6.0, 0.19, 110.0)
    times = np.sort(np.arange(3000) * 1e-3 + np.clip(rng.normal(0, 0.16e-3, 3000), -0.4e-3, 0.4e-3))
    read = np.round(whole(times)[0], 6)
    assert white_level(read, times) < 1e-6
    t = np.linspace(times[20], times[-20], 20001)
    W, W_dot = SampledLoad(times, read)(t)
    assert np.abs(W - whole(t)[0]).max() < 1e-3 and np.std(W_dot - whole(t)[1]) < 1e-3 * np.std(whole(t)[1])
    noisy = read + rng.normal(0, 0.02, read.size)
    assert white_level(noisy, times) == pytest.approx(0.02, rel=0.1)


def test_switch_on_is_smooth():
    load = Modulation(6.0, 0.2, 120.0, onset=0.1)
    assert load.breaks == (0.1, pytest.approx(0.1 + 5 / 120))
    t = np.linspace(0.09, 0.16, 70001)
    W, W_dot = load(t)
    assert np.gradient(W, t) == pytest.approx(W_dot, abs=0.1 + 2e-3 * np.abs(W_dot).max())
    assert W[t < 0.1] == pytest.approx(6.0, rel=1e-15)


def test_an_integration_that_stops_is_a_status(tmp_path):
    model = open_model(load_registry([brittle_law(tmp_path)]), law="brittle", interface="rigid", inertia=False)
    t, drive = np.array([0.0, 0.5, 1.0, 4.0, 5.0]), Drive.steps([(0.0, 8.0), (1.0, 0.0)])
    trace = simulate(model, model.vector(), drive=drive, load=ConstantLoad(8.0), t=t)
    assert trace.status is Status.INTEGRATION and not trace.status.ok
    assert np.isfinite(trace.x[:2]).all() and np.isnan(trace.x[-1]).all() and np.isnan(trace.mu[-1])
    assert trace.reached == pytest.approx(1.0 + END, rel=0.05)
    assert np.isfinite(trace.x).all(axis=1).sum() == np.sum(t <= trace.reached)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": np.array([0.0, 0.0])}, "rise"),
        ({"t": np.array([0.0, np.nan])}, "rise"),
        ({"drive": Drive.constant(0.0)}, "does not move forward"),
        ({"start": np.zeros(3)}, "start must be 4"),
        ({"load": SampledLoad(np.linspace(0, 0.5, 9), np.full(9, 5.0))}, "known from 0 to 0.5 s"),
    ],
)
def test_misuse_raises(model, change, message):
    given = {"drive": Drive.constant(8.0), "load": ConstantLoad(5.0), "t": np.linspace(0.0, 1.0, 3), **change}
    with pytest.raises(SrfError, match=message):
        simulate(model, model.vector(), **given)


@pytest.mark.parametrize(
    "make",
    [
        lambda: ConstantLoad(0.0),
        lambda: Modulation(5.0, 1.0, 120.0),
        lambda: Modulation(5.0, 0.1, -1.0),
        lambda: Modulation(5.0, 0.1, 120.0, onset=0.0, rise=0.0),
        lambda: SampledLoad(np.arange(5.0), np.array([1.0, 1.0, -1.0, 1.0, 1.0])),
        lambda: SampledLoad(np.arange(3.0), np.ones(3)),
        lambda: Drive((0.0, 0.0), (1.0, 2.0), (0.0, 0.0)),
        lambda: Drive.constant(float("nan")),
    ],
)
def test_programs_refuse_what_makes_no_sense(make):
    with pytest.raises(SrfError):
        make()


@pytest.mark.parametrize("f", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("on, off", [(2.0, 999.0), (20.0, 999.0), (30.0, 100.0), (60.0, 75.0)])
def test_a_noisy_load_keeps_the_onset_and_the_end_of_an_oscillation(f: float, on: float, off: float) -> None:
    t = np.arange(0.0, 150.0, 0.05)
    envelope = 1 / (1 + np.exp(-(t - on) / 0.4)) / (1 + np.exp(np.clip((t - off) / 0.4, -50, 50)))
    true = 10 * (1 + 0.05 * envelope * np.sin(2 * np.pi * f * t))
    noisy = true + np.random.default_rng(1).normal(0.0, 0.002, t.size)
    found = SampledLoad(t, noisy, noise=0.002)(t)[0]
    assert np.abs(found - true).max() < 0.01
