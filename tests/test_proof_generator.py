"""The generator of concealed cases: against the recordings of the examples, against the fitter's own prediction, and its seal."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, replace
from functools import cache

import numpy as np
import pytest
from example_protocol import NOISE, example_protocol, rms
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import srfcli as srf
from srfcli.data.experiment import read_experiment
from srfcli.inference.prediction import predict
from srfcli.laws.registry import load_registry
from srfcli.validation.apparatus import LAW_FIELDS, LAW_NAMES, RIGS, Setting, recorded, with_laws
from srfcli.validation.cases import EFFECTS, NAMES, OUTSIDE, OUTSIDE_NAMES, case_files, draw_protocol
from srfcli.validation.gauge import Gauge, autocovariance, play, read_gauge, white
from srfcli.validation.slider import (
    AGEING_LAWS,
    LAWS,
    SMOOTH,
    Physics,
    Plan,
    Track,
    ageing,
    at_unit_velocity,
    critical_load,
    friction,
    log_velocity,
    move,
    steady_age,
    steady_friction,
)

GENERATOR = ("slider", "gauge", "apparatus", "cases")
OPEN = [f"open-{n:02d}" for n in range(1, 9)]
BRIEFLY = ("open-08",)  # without --runslow: two effects on a track; all are held against the fitter in test_effects.py
EXAMPLES = {plan.name: plan for plan in example_protocol()}
# of runs under a modulation, which cost most to integrate, the first half; sampled as the whole is
BRIEF = {"onset": ((0.5, 12), (2.5, 8)), "strong": ((1.2, 20),), "holdout-mod": ((1.6, 15),)}
PROTOCOL = [replace(plan, drive=BRIEF.get(plan.name, plan.drive)) for plan in example_protocol()]
# rms over noise that a truth without its track may leave: the track alone moves stick-slip, and what comes near it
ROUGH = {("open-07", "stickslip"): 20, ("open-07", "onset"): 6, ("open-07", None): 1.5, ("open-08", None): 1.3}
# short runs in which effects show: a modulation, steps of velocity, a step of load
SHORT = (
    Plan("wave", ((0.4, 20.0),), 7.0, 0.001, eps=0.2, f=110.0, onset=0.25),
    Plan("steps", ((0.5, 20.0), (0.5, 40.0), (0.6, 5.0)), 5.0, 0.004, steps=((0.75, 1.5),)),
)


# ---- against recordings and predictions made by others


@pytest.mark.parametrize("case", [c if c in BRIEFLY else pytest.param(c, marks=pytest.mark.slow) for c in OPEN])
def test_known_truth_explains_the_example_down_to_its_noise(shared, case):
    """The effects mean what the examples' truth means by them: the recordings were made by neither side here."""
    told = json.loads((shared / "cases" / "truth.json").read_text())[case]
    known = {f.name for f in fields(Physics)}
    values = {n: v for n, v in {**told["parameters"], **told["truth"]}.items() if n in known}
    assert set(told["truth"]) <= known
    for plan in PROTOCOL:
        trace = move(Physics(**values), plan)
        file = shared / "cases" / case / f"{plan.name}.csv"
        recorded = np.loadtxt(file, delimiter=",", skiprows=1, max_rows=trace.t.size)
        assert np.allclose(recorded[:, 0], trace.t, atol=1e-9)
        W = np.array([plan.load()(t)[0] for t in trace.t.tolist()])
        assert np.abs(W - recorded[:, 2]).max() < 6e-7  # six decimals
        left = rms(recorded[:, 3] - trace.u) / NOISE
        most = ROUGH.get((case, plan.name), ROUGH.get((case, None), 1 + 3.5 / np.sqrt(2 * trace.t.size)))
        assert 1 - 3.5 / np.sqrt(2 * trace.t.size) < left < most, (plan.name, left)


@pytest.mark.parametrize(
    "change",
    [{}, {"rigid": True}, {"massless": True}, {"bare": True, "mu0": 0.46}, {"rigid": True, "massless": True}],
    ids=["usual", "rigid", "massless", "bare", "rigid-massless"],
)
def test_without_effects_it_agrees_with_the_fitter(make_model, tmp_path, change):
    """Strain form and BDF here, slip form and Radau there, and the format in between: they meet within 1e-3 um in every run."""
    p = replace(Physics(), **change)
    plans = [plan for plan in PROTOCOL if not change or plan.name in ("steps", "onset", "loadstep")]
    traces = {plan: move(p, plan) for plan in plans}
    assert all(trace.complete for trace in traces.values())
    for name, text in case_files("neutral", p, {plan: trace.u for plan, trace in traces.items()}).items():
        (tmp_path / name).write_text(text)
    experiment = read_experiment(tmp_path, registry=load_registry())
    model = make_model(**asdict(experiment.choice))
    assert ("Vsat" in model.names, "lambda" in model.names) == (not p.bare, not p.rigid)
    values = {"mu0": p.mu0, "A": p.A, "B": p.B, "D0": p.D0, "V0": p.V0, "Vsat": p.Vsat, "lambda": p.lam}
    for run, (plan, trace) in zip(experiment.runs, traces.items(), strict=True):
        assert (run.name, run.holdout) == (plan.name, plan.holdout)
        made = predict(model, experiment, run, values, rtol=1e-8)
        assert made.status.ok
        assert np.abs(made.y - trace.u).max() < 1e-3, run.name


# rock between rigid blocks: steps of velocity, a hold, steps of the load
ROCK = Physics(K=0.05, M=0.0, A=0.009, B=0.010, D0=20.0, Vsat=800.0, rigid=True, massless=True)
ROCK_RUN = Plan(
    "steps", ((60.0, 3.0), (20.0, 20.0), (20.0, 0.0), (20.0, 3.0)), 20.0, 0.1, steps=((30.0, 3.0), (90.0, -3.0)), rise=0.5
)
QUICK = {(law, "dieterich") for law in LAWS} | {("dieterich-ruina", ageing) for ageing in AGEING_LAWS} | {("two-state", "nagata")}


def slow_unless_quick(law, ageing):
    return pytest.param(law, ageing, marks=() if (law, ageing) in QUICK else pytest.mark.slow)


def predicted(make_model, folder, p, plan, rig, u, effects=(), **own):
    """Return what the fitter predicts for a case whose parameters are those of the generator's slider."""
    for name, text in case_files("neutral", p, {plan: u}, rig=rig).items():
        (folder / name).write_text(text)
    experiment = read_experiment(folder, registry=load_registry())
    model = make_model(**asdict(experiment.choice.plus(effects)), stability=False)
    values = {LAW_NAMES.get(n, n): getattr(p, n) for n in (*LAW_FIELDS[p.law_name], "lam", "nagata", "V0")}
    values = {n: v for n, v in {**values, "Vb": p.Vsat, **own}.items() if n in model.names}
    made = predict(model, experiment, experiment.runs[0], values, rtol=1e-9)
    assert made.status.ok
    return made.y


@pytest.mark.parametrize(("law", "ageing"), [slow_unless_quick(law, ageing) for law in LAWS for ageing in AGEING_LAWS])
def test_every_law_and_ageing_law_agrees_with_the_fitter_on_rock(make_model, tmp_path, law, ageing):
    """The friction coefficient of a press, quasi-static and rigid, through steps of velocity and load, and a hold at rest."""
    p = with_laws(ROCK, 0.65, np.random.default_rng(1), Setting("rock", "steps", law, ageing, ageing))
    assert (p.law_name, p.ageing_name) == (law, ageing)
    u = recorded(RIGS["rock-friction"], p, ROCK_RUN, move(p, ROCK_RUN).u)
    assert np.ptp(u) > 0.05
    made = predicted(make_model, tmp_path, p, ROCK_RUN, RIGS["rock-friction"], u)
    assert np.abs(made - u).max() < 5e-7  # of friction; good recordings have noise of 1e-4


NO_V0 = with_laws(ROCK, 0.65, np.random.default_rng(1), Setting("rock", "steps", "dieterich-cutoff", "dieterich", "dieterich"))


@pytest.mark.parametrize(
    ("effect", "base", "fields", "own"),
    [
        ("slip-hardening", ROCK, ("harden", "harden_x"), {"rise": 4e-3, "length": 90.0}),
        ("frictional-heating", ROCK, ("heat", "heat_tau"), {"drop": 2e-4, "cooling": 5.0}),
        ("dilatancy", ROCK, ("dilate", "drain"), {"strength": 4e-3, "drainage": 8.0}),
        ("rate-cutoff", ROCK, ("rate_cut",), {"cutoff": 0.02}),
        ("load-lag", ROCK, ("memory", "memory_tau"), {"share": 0.4, "lag_time": 2.0}),
        ("second-state", NO_V0, ("B2", "D2"), {"B2": 0.004, "D2": 90.0}),
        ("viscous-drag", NO_V0, ("drag",), {"c": 5e-4}),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_effects_of_laboratories_agree_with_the_fitter(make_model, tmp_path, effect, base, fields, own):
    """Effects with a reference velocity of their own also beside a law that has none."""
    p, rig = replace(base, **dict(zip(fields, own.values(), strict=True))), RIGS["rock-friction"]
    with_it, without = (recorded(rig, q, ROCK_RUN, move(q, ROCK_RUN).u) for q in (p, base))
    made = predicted(make_model, tmp_path, p, ROCK_RUN, rig, with_it, (effect,), **own)
    assert np.abs(made - with_it).max() < 5e-7 and np.abs(with_it - without).max() > 1e-3


@pytest.mark.parametrize(("law", "ageing"), [slow_unless_quick(law, ageing) for law in LAWS for ageing in AGEING_LAWS])
def test_every_law_and_ageing_law_agrees_with_the_fitter_on_the_papers_slider(make_model, tmp_path, law, ageing):
    """With an elastic interface and a mass, where the rate of the friction force and the inverse of each law are others."""
    p = with_laws(Physics(), 0.464, np.random.default_rng(1), Setting("paper", "steps", law, ageing, ageing))
    u = move(p, SHORT[1]).u
    assert np.abs(predicted(make_model, tmp_path, p, SHORT[1], RIGS["paper"], u) - u).max() < 2e-3 * NOISE


@pytest.mark.parametrize("rig", ["micro-force", "micro-elongation"])
def test_a_micro_tribometer_agrees_with_the_fitter(make_model, tmp_path, rig):
    """A rigid slider with a small mass under 0.2 N on a soft spring: forces in mN, or elongations, of stick-slip."""
    slider = Physics(K=3e-3, M=1e-9, A=0.01, B=0.017, D0=0.06, rigid=True)
    setting = Setting("micro", "stick-slip", "dieterich-ruina", "dieterich", "dieterich")
    p = with_laws(slider, 0.4, np.random.default_rng(1), setting)
    plan = Plan("first", ((1.0, 5.0), (2.0, 4.0)), 0.2, 0.004)
    u = recorded(RIGS[rig], p, plan, move(p, plan).u)
    unit = RIGS[rig].factor if rig == "micro-force" else 1.0  # the fitter has N
    made = predicted(make_model, tmp_path, p, plan, RIGS[rig], u) / unit
    assert np.ptp(u) > 50 * (level := 0.02 * (1.0 if unit == 1.0 else 1e3 * p.K))
    assert rms(made - u) < 0.05 * level  # of stick-slip: a shift of 1e-6 in phase


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("V", [0.1, 300.0])
def test_steady_friction_is_the_closed_form(law, V):
    """mu(V) with the age D0/V, and the a - b of its slope."""
    p = with_laws(ROCK, 0.65, np.random.default_rng(1), Setting("rock", "steps", law, "dieterich", "dieterich"))
    g, l = np.log1p(p.Vsat / V), np.log(V)
    closed = {
        "srf-vsat": p.mu0 + p.A * l + p.B * g,
        "dieterich-ruina": p.mu0 + (p.A - p.B) * l,
        "dieterich-cutoff": p.mu0 - p.A * np.log1p(p.Va / V) + p.B * g,
        "rice-regularized": p.A * np.arcsinh(V / 2 * np.exp((p.mu0 - p.B * l) / p.A)),
        "log-log": p.mu0 + p.A * l + p.B * g + p.C * l * g,
        "bowden-tabor": (p.mu0 + p.A * l) * (1 + p.B / p.mu0 * g),
        "two-state": p.mu0 + (p.A - p.B - p.B2) * l,
    }[law]
    assert steady_friction(p, V, 20.0) == pytest.approx(closed, rel=1e-10)
    plan = Plan("rest", ((5.0, V),), 20.0, 0.1)
    assert np.allclose(recorded(RIGS["rock-stress"], p, plan, move(p, plan).u), 20.0 * closed, rtol=1e-6)


@pytest.mark.parametrize(("ageing", "q"), [("ruina", 1.0), ("perrin-rice-zheng", 2.0), ("kato-tullis", 1.0)])
def test_steady_ages_are_the_closed_form(ageing, q):
    p = Physics(ageing=ageing)
    assert np.exp(steady_age(p, 3.0)) == pytest.approx(q * p.D0 / 3.0, rel=1e-12)
    slow = Physics(ageing="kato-tullis", Vc=1e3)  # heals at 3 um/s as at rest: q ln q = 1
    assert 3.0 / slow.D0 * np.exp(steady_age(slow, 3.0)) == pytest.approx(1.763, rel=2e-3)


@pytest.mark.parametrize("law", ["dieterich-cutoff", "rice-regularized", "srf-vsat"])
@pytest.mark.parametrize("drag", [0.0, 1e-5])
@pytest.mark.parametrize("x", [-25.0, -3.0, 0.0, 4.0])
def test_friction_and_its_inverse(law, drag, x):
    resistance, velocity = friction(Physics(law="" if law == "srf-vsat" else law, Va=3000.0))
    assert velocity(resistance(x, 0.5, 0.0126, drag), 0.5, 0.0126, drag) == pytest.approx(x, abs=1e-9)


def test_a_second_age_follows_the_ageing_law_under_two_states():
    p = with_laws(ROCK, 0.65, np.random.default_rng(1), Setting("rock", "steps", "two-state", "ruina", "ruina"))
    other = replace(p, ageing="dieterich")
    assert rms(move(p, ROCK_RUN).u - move(other, ROCK_RUN).u) > 0.05


def test_strain_form_is_the_slip_relation():
    """The same slider with v as the unknown, d(W mu/kappa)/dt = z - v differentiated by hand, and an explicit solver."""
    p, plan = Physics(alpha=0.01), SHORT[0]
    load = plan.load()

    def rates(t, y):
        u, z, lv, lp = y
        (W, W_dot), v, phi = load(t), np.exp(lv), np.exp(lp)
        lp_dot = (1 - v * phi / p.D0) / phi - p.alpha / p.B * W_dot / W
        mu = p.mu0 + p.A * lv + p.B * np.log1p(p.Vsat * phi / p.D0)
        mu_dot = (z - v) / p.lam
        grows = p.B * p.Vsat * phi / (p.D0 + p.Vsat * phi)
        return [20.0 - z, (p.K * u - W * mu) / p.M, (mu_dot - grows * lp_dot) / p.A, lp_dot]

    V = 20.0
    mu = p.mu0 + p.A * np.log(V) + p.B * np.log1p(p.Vsat / V)
    trace = move(p, plan)
    first = [7.0 * mu / p.K, V, np.log(V), np.log(p.D0 / V)]
    made = solve_ivp(rates, (0, trace.t[-1]), first, "DOP853", trace.t, rtol=1e-10, atol=1e-12, max_step=5e-4)
    assert np.abs(made.y[0] - trace.u).max() < 2e-6


# ---- effects


moved_before = cache(move)  # without its effect the slider is the same for most


@pytest.mark.parametrize("effect", (*EFFECTS, *OUTSIDE), ids=lambda e: f"{e.name}-{e.varies}")
def test_each_effect_changes_the_record_and_vanishes(effect):
    strong = effect.added(Physics(), np.random.default_rng(5), 1.0)
    without = effect.removed(strong)
    weakest = effect.added(Physics(), np.random.default_rng(5), 0.0)

    def changed(p, plan):
        with_it, none = play(move(p, plan, rtol=1e-6).u, p.backlash), moved_before(without, plan, rtol=1e-6).u
        assert np.isfinite([with_it, none]).all()
        return rms(with_it - none)

    far, plan = max((changed(strong, plan), plan) for plan in SHORT)  # where it shows best
    assert far > 0.01  # half the gauge's noise in runs this short
    near = changed(weakest, plan)
    if not effect.absent:  # 0 is then as near to absent as this goes
        assert far > 1.5 * near
        assert getattr(without, effect.varies) == effect.neutral == getattr(Physics(), effect.varies)
    assert {n: getattr(without, n) for n in effect.absent} == dict(effect.absent)


def test_every_name_of_the_table_and_more_can_be_concealed(shared):
    table = (shared / "diagnosis.md").read_text().partition("## The answer")[0]
    names = [line.split("`")[1] for line in table.splitlines() if line.startswith("| `")]
    assert sorted(NAMES) == sorted([*names, "load-stiffening", "poisson-coupling"])
    assert not set(NAMES) & set(OUTSIDE_NAMES)
    assert {r for e in OUTSIDE for r in e.resembles} <= set(NAMES)


def steady(p, V=10.0, W=7.0, *, at=None):
    """Return the elongation of steady sliding from the first sample of an undisturbed run."""
    trace = move(p, at or Plan("rest", ((0.4, V),), W, 0.004))
    return trace.u


USUAL_MU = 0.33 + 0.0126 * np.log(10) + 0.0241 * np.log1p(25.6)


@pytest.mark.parametrize(
    ("change", "force"),
    [
        ({}, 7 * USUAL_MU),
        ({"Wa": 0.3}, 7.3 * USUAL_MU),
        ({"drag": 1e-4}, 7 * (USUAL_MU + 1e-3)),
        ({"C": 1e-3}, 7 * (USUAL_MU + 1e-3 * np.log(10) * np.log1p(25.6))),
        ({"B2": 5e-3, "D2": 4.0}, 7 * (USUAL_MU - 5e-3 * np.log(10))),
        ({"slip_share": 1.0}, 7 * USUAL_MU),
        ({"p_age": 1.7}, 7 * USUAL_MU),
        ({"D_power": 0.2, "V_D": 10.0}, 7 * USUAL_MU),
        ({"W_power": 0.1, "Wref": 3.5}, 7 * (USUAL_MU + 0.33 * (2**0.1 - 1))),
        ({"age_rate": 10.0}, 7 * (0.33 + 0.0126 * np.log(10) + 0.0241 * np.log1p(256 / 0.402 / (10 / 0.402 + 10)))),
        ({"n_kappa": 0.4}, 7 * USUAL_MU),
        ({"eta": 0.01}, 7 * USUAL_MU),
        ({"rigid": True}, 7 * USUAL_MU),
        ({"massless": True}, 7 * USUAL_MU),
    ],
    ids=lambda v: ",".join(v) or "usual" if isinstance(v, dict) else "",
)
def test_steady_sliding_is_the_closed_form_and_stays(change, force):
    u = steady(Physics(**change))
    assert np.allclose(u, force / 0.21, rtol=1e-7)


def test_stiffness_error_and_crosstalk_and_rho_in_closed_form():
    """The steady elongation under a load that has stepped by 1 N says what each force balance is."""
    plan = Plan("step", ((5.0, 10.0),), 3.0, 0.01, steps=((1.0, 1.0),))
    assert steady(Physics(ratio=1.2))[0] == pytest.approx(7 * USUAL_MU / (0.21 * 1.2), rel=1e-9)
    assert steady(Physics(cross=0.02), at=plan)[-1] == pytest.approx((4 * USUAL_MU + 0.02) / 0.21, abs=1e-5)
    assert steady(Physics(rho=0.5), at=plan)[-1] == pytest.approx(4 * USUAL_MU / 0.21, abs=1e-5)


@pytest.mark.parametrize(
    ("change", "shift"),
    [
        ({"drift_t": 1e-3, "drift_t0": 0.5}, lambda t: 1e-3 * np.maximum(t - 0.5, 0)),
        ({"drift_x": 1e-4, "drift_x0": 6.0}, lambda t: 1e-4 * np.maximum(10 * t - 6, 0)),
        ({"topo": 1e-3, "topo_L": 40.0, "topo_phase": 1.0}, lambda t: 1e-3 * np.cos(2 * np.pi * 10 * t / 40 + 1.0)),
        ({"bump": 1e-3, "bump_x": 9.0, "bump_w": 3.0}, lambda t: 1e-3 * np.exp(-(((10 * t - 9) / 3) ** 2) / 2)),
    ],
    ids=["time", "slip", "topography", "bump"],
)
def test_slow_changes_of_mu0_show_in_the_elongation(change, shift):
    """Under slow changes the spring follows friction: K u = W (mu + shift), to the little by which v is not V."""
    trace = move(Physics(**change), Plan("slow", ((3.0, 10.0),), 7.0, 0.01))
    expected = (USUAL_MU + shift(trace.t)) * 7 / 0.21
    assert np.abs(trace.u - expected).max() < 0.15 * np.ptp(expected)


def test_drive_effects_move_the_load_point():
    """With a weak spring nothing slips at first: u' is the stage's velocity less the slider's."""
    plan = Plan("pull", ((0.5, 10.0), (1.0, 20.0)), 7.0, 0.002)
    plain = move(Physics(), plan).u
    late = move(Physics(drive_tau=0.1), plan).u
    first = slice(250, 260)  # the 20 ms after the step: the lagging stage has hardly begun to go faster
    assert np.allclose(late[:250], plain[:250], atol=1e-7)
    assert 0.02 < (plain - late)[first].max() < 0.2
    pitch = move(Physics(ripple=0.1, ripple_p=10.0), plan).u - plain
    assert np.ptp(pitch[125:250]) > 5e-3
    assert np.array_equal(move(Physics(ripple=0.0, ripple_p=3.0), plan).u, plain)


def test_a_lagging_gauge_is_a_first_order_filter():
    plan = replace(SHORT[1], interval=0.0005)
    lag, u, shown = 0.01, move(Physics(), plan).u, move(Physics(lag=0.01), plan).u
    t = plan.times()
    fine = np.linspace(0, t[-1], 20 * t.size)
    follow = np.exp(-(fine[1] - fine[0]) / lag)
    smooth, at = np.empty_like(fine), u[0]
    for k, value in enumerate(np.interp(fine, t, u).tolist()):
        at = value + (at - value) * follow
        smooth[k] = at
    assert np.abs(np.interp(t, fine, smooth) - shown).max() < 2e-3
    assert rms(shown - u) > 0.02


def test_play_drags_the_pointer():
    u = np.array([0.0, 0.05, 0.2, 0.15, -0.1, -0.05])
    assert np.allclose(play(u, 0.1), [0.0, 0.0, 0.1, 0.1, 0.0, 0.0])


def test_distortion_is_a_second_harmonic_that_the_record_does_not_show(tmp_path):
    plan = Plan("wave", ((1.0, 20.0),), 7.0, 0.001, eps=0.2, f=100.0, onset=0.1)
    W = [plan.load()(t)[0] for t in plan.times().tolist()]
    tail = np.abs(np.fft.rfft(np.array(W)[-500:] - 7.0)) / 250
    assert tail[50] == pytest.approx(1.4, rel=1e-6)
    assert tail[100] < 1e-6
    moved = move(Physics(distortion=0.3), plan).u - move(Physics(), plan).u
    assert rms(moved[-500:]) > 0.02


# ---- parts


@given(st.floats(-2, 2), st.floats(1e-3, 0.05), st.one_of(st.just(0.0), st.floats(1e-9, 0.1)))
@settings(max_examples=300, deadline=None)
def test_inverting_friction(R, a, c):
    x = log_velocity(R, a, c)
    if c == 0 or x < 60:
        assert a * min(x, 60) + c * np.exp(min(x, 60)) == pytest.approx(min(R, a * 60) if c == 0 else R, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("change", [{}, {"p_age": 2.0}, {"slip_share": 0.5}, {"age_rate": 3.0}, {"D_power": 0.3}])
@pytest.mark.parametrize("V", [0.05, 10.0, 80.0])
def test_steady_age_does_not_change(change, V):
    p = Physics(**change)
    assert abs(ageing(p)(V, steady_age(p, V), 5.0, 0.0)) < 1e-8 * V / p.D0


def test_slip_that_nothing_ends_is_no_case():
    """After a hold a slider without inertia or cut-off slips without end; with a mass it stops in time."""
    p = Physics(massless=True, bare=True, ageing="kato-tullis", A=0.01247, B=0.02686, D0=0.4524, lam=0.5664, mu0=0.4673)
    plan = Plan("holds", ((1.7, 7.05), (2.47, 0.0), (1.7, 7.05)), 5.0, 0.006)
    assert not move(p, plan).complete
    trace = move(replace(p, massless=False), plan)
    assert trace.complete and trace.u.min() > 0


def test_slip_that_a_solver_stepped_over_is_no_case():
    """Without inertia slip after a hold becomes infinitely fast in the end, and the spring would still pull beyond."""
    rock = Physics(K=0.0191, M=0.0, mu0=0.651, A=0.007226, B=0.010457, D0=31.8, rigid=True, massless=True, bare=True)
    p = replace(rock, ageing="perrin-rice-zheng")
    plan = Plan("holds", ((5.5, 29.2), (94.8, 0.0), (5.5, 29.2)), 19.7, 0.07)
    trace = move(p, plan)
    reached = trace.t[np.isfinite(trace.u)][-1]
    assert not trace.complete and 100.3 < reached < 105.8


def test_terms_add_up():
    terms = at_unit_velocity(Physics(C=1e-3, topo=1e-3, topo_L=8.0), 100.0)
    m, a = terms(0.0, 4.0, np.log(0.0402), 0.0, 7.0)
    grown = np.log1p(25.6)
    assert (m, a) == pytest.approx((0.33 + 0.0241 * grown - 1e-3, 0.0126 + 1e-3 * grown), rel=1e-13)


def test_load_and_its_rate_agree():
    for plan in draw_protocol(np.random.default_rng(3)):
        load, t, h = plan.load(), np.linspace(0.5, 4.2, 400), 1e-6
        for s in t.tolist():
            slope = (load(s + h)[0] - load(s - h)[0]) / (2 * h)
            assert load(s)[1] == pytest.approx(slope, abs=2e-5 * (1 + abs(slope)))


def test_a_track_is_each_runs_own_or_one_for_all():
    for own in (False, True):
        first, second = (Track(3e-4, 10.0, 5, own).under(name).profile(100.0)(50.0) for name in ("steps", "strong"))
        assert (first == second) is not own


def test_tracks_have_the_size_and_the_length_they_say():
    x = np.arange(0, 3000, 1.0)
    heights, products = [], []
    for seed in range(12):
        track = Track(3e-4, 10.0, seed)
        f = track.profile(3000.0)
        h = np.array([f(s) for s in x.tolist()])
        heights.append(h.std())
        products.append(np.mean(h[:-10] * h[10:]) / np.mean(h**2))
        again = track.profile(500.0)
        assert np.array_equal([again(s) for s in x[:500].tolist()], h[:500])
    assert np.mean(heights) == pytest.approx(3e-4, rel=0.1)
    assert np.mean(products) == pytest.approx(2 * np.exp(-1), abs=0.07)  # (1 + r) exp(-r) at r = 1
    fine = np.array([f(s) for s in np.linspace(100, 103, 301).tolist()])
    assert np.abs(np.diff(fine, 2)).max() < 1e-8  # no corners
    assert SMOOTH.profile(10.0)(3.0) == 0.0


@pytest.mark.parametrize("lag1", [0.0, 0.85])
def test_gauge_noise_is_what_it_says(lag1):
    read = read_gauge(np.full(40000, 18.001), Gauge(lag1=lag1, quantum=0.0005), np.random.default_rng(1))
    noise = read - 18.001
    assert noise.std() == pytest.approx(0.02, rel=0.05)
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(lag1, abs=0.02)
    coarse = read_gauge(np.linspace(1, 2, 50), Gauge(), np.random.default_rng(1))
    assert np.allclose(coarse / 0.005, np.round(coarse / 0.005), atol=1e-9)


def test_noise_of_1_over_f_has_its_slope_and_its_variance():
    gauge = Gauge(sigma=0.02, pink=0.9, quantum=1e-4)
    made = np.array([read_gauge(np.zeros(4096), gauge, np.random.default_rng(seed)) for seed in range(30)])
    assert np.sqrt(np.mean(made**2)) == pytest.approx(0.02, rel=0.1)
    window = np.hanning(4096)
    power = np.mean(np.abs(np.fft.rfft(made * window)) ** 2, axis=0)
    f, low = np.arange(power.size), slice(8, 100)  # below that the window leaks, above it the white tenth shows
    assert np.polyfit(np.log(f[low]), np.log(power[low]), 1)[0] == pytest.approx(-1.0, abs=0.12)
    covariance = autocovariance(gauge, 4096)
    assert covariance[0] == pytest.approx(0.02**2, rel=1e-4)
    for lag in (1, 100):
        assert np.mean(made[:, lag:] * made[:, :-lag]) == pytest.approx(covariance[lag], abs=0.07 * covariance[0])


@pytest.mark.parametrize("gauge", [Gauge(pink=0.8), Gauge(pink=0.4, sigma=0.1)])
def test_whitening_is_the_cholesky_factors(gauge):
    n = 200
    signal = np.random.default_rng(3).standard_normal((n, 2))
    found = white(signal, gauge)
    covariance = autocovariance(gauge, n)
    C = covariance[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]
    assert np.allclose(found, np.linalg.solve(np.linalg.cholesky(C), signal), rtol=1e-8, atol=1e-8)


def test_spikes_are_few_and_large():
    u = np.full(1000, 10.0)
    off = np.abs(read_gauge(u, Gauge(spikes=3), np.random.default_rng(2)) - u)
    assert sum(off > 1.0) == 3 and np.sort(off)[-4] < 0.1


def test_gaps_and_uneven_sampling():
    plan = Plan("a", ((4.0, 5.0), (4.0, 10.0)), 5.0, 0.01)
    every = plan.times()
    gap = replace(plan, gaps=((1.0, 1.5),)).times()
    assert every.size - gap.size == 51 and set(gap) <= set(every) and not ((gap >= 1.0) & (gap <= 1.5)).any()
    dense = replace(plan, dense=1.0).times()
    assert set(dense) <= set(every) and (np.diff(dense[(dense > 4.0) & (dense < 5.0)]) < 0.011).all()
    assert np.allclose(np.diff(dense[(dense > 5.1) & (dense < 7.9)]), 0.05)
    wander = replace(plan, wander=0.2).times()
    assert wander.size == every.size and np.diff(wander).min() > 0
    assert np.std((wander - every)[1:]) == pytest.approx(0.002, rel=0.1)
    trace = move(Physics(), replace(plan, wander=0.2, gaps=((1.0, 1.5),)))
    assert trace.complete and trace.u.size == trace.t.size
    assert np.allclose(trace.u, np.interp(trace.t, every, move(Physics(), plan).u), atol=5e-3)


@pytest.mark.parametrize(
    ("change", "laws"),
    [
        ({}, {}),
        ({"rigid": True, "massless": True}, {"interface": "rigid", "inertia": False}),
        ({"ageing": "ruina", "bare": True}, {"ageing": "ruina", "law": "dieterich-ruina"}),
        ({"Wa": 0.4}, {"effects": ["adhesion-offset"], "Wa": 0.4}),
    ],
    ids=["usual", "rigid-massless", "ruina", "adhesion"],
)
def test_critical_loads_are_those_of_the_characteristic_polynomial(change, laws):
    """Eigenvalues of differences of the generator's rates, against the polynomial that the tool derives."""
    p = Physics(**change)
    own = {"mu0": p.mu0, "A": p.A, "B": p.B, "D0": p.D0, "K": p.K}
    own |= {} if p.bare else {"Vsat": p.Vsat}
    own |= {} if p.rigid else {"lambda": p.lam}
    own |= {} if p.massless else {"M": p.M * 1e6}
    rows = srf.linear(srf.system(**laws, **own), over={"V": [1.0, 30.0]}).table.records()
    found = [row["W0"] for row in rows]
    assert [critical_load(p, V, 0.1, 100.0) for V in (1.0, 30.0)] == pytest.approx(found, rel=1e-4)
