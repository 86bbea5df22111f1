"""Effects that laboratories meet, each against what its physics says in a limit that can be written down."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from srfcli.codegen.c_source import compiler
from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.data.values import FitParameter
from srfcli.inference.recordings import fit_recordings
from srfcli.laws.registry import load_registry
from srfcli.motion.imposed import ConstantLoad, Drive, Load, LoadSteps, SampledLoad
from srfcli.motion.integrators import Motion, integrate
from srfcli.tasks.diagnose import diagnose
from srfcli.validation.cases import make_case
from srfcli.validation.slider import Physics, Plan, move

REGISTRY = load_registry(user=False, entry_points=False)
GOUGE = {"mu0": 0.6, "A": 0.009, "B": 0.006, "D0": 10.0, "V0": 1.0, "K": 0.1, "W0": 20.0, "V": 1.0}
STEP = Drive.steps([(0.0, 1.0), (20.0, 10.0)])


def moved(
    effect: str,
    own: dict[str, float],
    *,
    drive: Drive = STEP,
    load: Load | None = None,
    end: float = 60.0,
    ageing: str = "dieterich",
) -> tuple[GeneratedModel, np.ndarray, Motion]:
    """Return the model of a gouge with the effect, times (n,) in s and the motion from steady sliding at 1 um/s under 20 MPa."""
    model = open_model(REGISTRY, law="dieterich-ruina", ageing=ageing, interface="rigid", inertia=False, effects=(effect,))
    p = model.vector({**{k: v for k, v in GOUGE.items() if k in model.names}, **own})
    t = np.linspace(0.0, end, 601)
    motion = integrate(
        model,
        p,
        drive=drive,
        load=load or ConstantLoad(20.0),
        t=t,
        start=np.asarray(model.steady(p)),
        rtol=1e-9,
        atol=np.full(len(model.states), 1e-11),
    )
    return model, t, motion


def friction(model: GeneratedModel, own: dict[str, float], t: np.ndarray, motion: Motion, drive: Drive = STEP) -> np.ndarray:
    """Return K u/W (n,) under 20 MPa."""
    p = model.vector({**{k: v for k, v in GOUGE.items() if k in model.names}, **own})
    if "u" in model.states:
        u = motion.x[:, model.states.index("u")]
    else:
        u = np.asarray(model.elongation(motion.x, drive(t), np.full(t.size, 20.0), np.zeros(t.size), p))
    return np.asarray(GOUGE["K"] * u / 20.0)


def state(model: GeneratedModel, motion: Motion, name: str) -> np.ndarray:
    return np.asarray(motion.x[:, model.states.index(name)])


def test_slip_hardening_rises_as_it_says_and_stops() -> None:
    own, drive = {"rise": 0.02, "length": 40.0}, Drive.constant(10.0)
    model, t, motion = moved("slip-hardening", {**own, "V": 10.0}, drive=drive)
    mu = friction(model, {**own, "V": 10.0}, t, motion, drive)
    slip = 10.0 * t - (mu - mu[0]) * 20.0 / GOUGE["K"]
    # at the start sliding slows, as the spring has to be stretched, by which A and B speak
    said = 0.02 * (1 - np.exp(-slip / 40.0))
    assert mu - mu[0] == pytest.approx(said, abs=8e-4)
    assert (mu - mu[0])[t > 4] == pytest.approx(said[t > 4], abs=1e-4)
    assert mu[-1] - mu[0] == pytest.approx(0.02, rel=1e-3)


def test_heat_weakens_as_drag_strengthens_once_it_is_quick_and_comes_late_where_it_is_not() -> None:
    drop = 2e-4
    model, t, slow = moved("frictional-heating", {"drop": drop, "cooling": 4.0})
    warm = state(model, slow, "warm")

    v = np.exp(state(model, slow, "ln_v"))
    assert warm[-1] == pytest.approx(10.0, rel=1e-3)
    assert np.abs(warm - _lagged(t, v, 4.0)).max() < 0.05
    mu = friction(model, {"drop": drop, "cooling": 4.0}, t, slow)
    assert mu[-1] == pytest.approx(0.6 + (0.009 - 0.006) * np.log(10.0) - drop * 10.0, abs=2e-6)
    quick, _, fast = moved("frictional-heating", {"drop": drop, "cooling": 1e-3})
    drag, _, dragged = moved("viscous-drag", {"c": -drop})
    one, other = friction(quick, {"drop": drop, "cooling": 1e-3}, t, fast), friction(drag, {"c": -drop}, t, dragged)
    assert np.abs(one - other).max() < 2e-5 < np.abs(friction(model, {"drop": drop, "cooling": 4.0}, t, slow) - other).max()


def _lagged(t: np.ndarray, v: np.ndarray, cooling: float) -> np.ndarray:
    """Return what follows v with a first-order lag, exactly for v that is straight between samples."""
    out, h = [1.0], t[1] - t[0]
    decay = np.exp(-h / cooling)
    for a, b in pairwise(v):
        slope = (b - a) / h
        out.append(b - slope * cooling + (out[-1] - a + slope * cooling) * decay)
    return np.array(out)


@pytest.mark.parametrize("V", [0.1, 1.0, 100.0])
def test_a_cut_off_ends_the_direct_effect(V: float) -> None:
    own = {"cutoff": 0.05, "V": V}
    model, t, motion = moved("rate-cutoff", own, drive=Drive.constant(V), end=1.0)
    found = friction(model, own, t, motion, Drive.constant(V))
    # Okubo's form: A ln of V1/v + 1, against 1/V1 = cutoff
    expected = 0.6 - 0.009 * np.log(1 / (0.05 * V) + 1) + 0.009 * np.log(1 / 0.05) - 0.006 * np.log(V)
    assert found == pytest.approx(expected, abs=1e-9)


def test_a_late_load_follows_with_its_time_constant() -> None:
    t = np.linspace(0.0, 60.0, 601)
    load = SampledLoad(t, 20.0 + 2.0 * np.exp(-(((t - 15.0) / 4.0) ** 2)))
    model, t, motion = moved("load-lag", {"share": 0.4, "lag_time": 3.0}, load=load)
    fine = np.linspace(0.0, 60.0, 60001)
    W, late = load(fine)[0], np.empty(fine.size)
    late[0], decay = 20.0, np.exp(-(fine[1] - fine[0]) / 3.0)
    for k in range(1, fine.size):
        late[k] = W[k - 1] + (late[k - 1] - W[k - 1]) * decay
    assert state(model, motion, "late") == pytest.approx(np.interp(t, fine, late), abs=2e-3)
    assert late.max() < W.max() - 0.3  # it is less, and later


def test_suction_is_the_change_of_age_undrained_and_nothing_drained() -> None:
    own = {"strength": 0.01, "drainage": 1e9}
    model, t, motion = moved("dilatancy", own)
    age = state(model, motion, next(s for s in model.states if s.startswith("ln_") and s != "ln_v"))
    suction = state(model, motion, "suction")
    assert suction == pytest.approx(0.01 * (age - age[0]), abs=1e-7)
    assert suction[-1] == pytest.approx(-0.01 * np.log(10.0), rel=1e-2)  # contacts are ten times younger
    drained, _, quick = moved("dilatancy", {"strength": 0.01, "drainage": 1e-3})
    assert np.abs(state(drained, quick, "suction")).max() < 2e-4
    lasting, _, slow = moved("dilatancy", {"strength": 0.01, "drainage": 5.0})
    left = state(lasting, slow, "suction")
    late = t > 40.0
    slope = np.polyfit(t[late], np.log(np.abs(left[late])), 1)[0]
    assert slope == pytest.approx(-1 / 5.0, rel=0.05)  # drains exponentially


@pytest.mark.parametrize("ageing", ["dieterich", "ruina"])
def test_a_layer_that_thins_settles_over_less_slip_at_every_step_and_as_high(ageing: str) -> None:
    """At one velocity what is left of a step decays with the integral of slip over D0 h/h0: both laws have it in closed form."""
    thinning, drive = 1e-3, Drive.steps([(0.0, 1.0), (20.0, 10.0), (100.0, 1.0), (250.0, 10.0)])
    own = {"thinning": thinning, "K": 1e3}  # so stiff that the slider moves as the stage does
    model, t, motion = moved("layer-thinning", own, drive=drive, end=300.0, ageing=ageing)
    age = np.exp(state(model, motion, next(s for s in model.states if s.startswith("ln_") and s != "ln_v")))
    slip = state(model, motion, "slip")
    assert slip[-1] == pytest.approx(20 + 800 + 150 + 500, abs=0.1)
    for begin, end, V in ((20.0, 100.0, 10.0), (250.0, 300.0, 10.0)):
        first, last = (int(np.argmin(np.abs(t - at))) for at in (begin + 1.0, end))
        part = slice(first, last)
        left = age * V / 10.0 - 1 if ageing == "dieterich" else np.log(age * V / 10.0)
        slid = (np.exp(thinning * slip) - np.exp(thinning * slip[first])) / (thinning * 10.0)
        assert left[part] == pytest.approx((left[first] * np.exp(-slid))[part], rel=0.02, abs=2e-3)
    assert age[-1] == pytest.approx(10.0 / 10.0, rel=1e-3)


PLAY = """format = "srf-experiment/1"
[apparatus]
stiffness = "0.1 N/um"
[model]
law = "dieterich-ruina"
ageing = "dieterich"
interface = "rigid"
inertia = false
effects = ["backlash"]
[parameters]
mu0 = { value = 0.6, lower = 0.3, upper = 0.9 }
A = { value = 0.009, fixed = true }
B = { value = 0.006, fixed = true }
D0 = { value = 10.0, fixed = true }
V0 = { value = 1.0, fixed = true }
play = { value = 22.0 }
[[runs]]
name = "a"
file = "a.csv"
"""


@pytest.mark.skipif(compiler() is None, reason="no C compiler: the filter is compiled")
def test_a_drive_with_play_is_one_that_begins_late(tmp_path: Path) -> None:
    play, after = 30.0, Drive.steps([(0.0, 0.0), (3.0, 10.0)])
    own = {"play": play, "rounding": 0.1, "V": 10.0}
    model, t, motion = moved("backlash", own, drive=Drive.constant(10.0), end=30.0)
    late, _, begun = moved("backlash", {**own, "play": 0.0}, drive=after, end=30.0)
    ones, p = np.ones_like(t), late.vector({**GOUGE, "play": 0.0})
    u = np.asarray(late.elongation(begun.x, after(t), 20 * ones, 0 * ones, p))
    p = model.vector({**GOUGE, **own})
    found = np.asarray(model.elongation(motion.x, 10 * ones, 20 * ones, 0 * ones, p))
    assert found == pytest.approx(u, abs=0.1) and np.ptp(u) > 1.0
    rows = [f"{a:.2f},10,20,{0.1 * b:.6f}" for a, b in zip(t, u + np.random.default_rng(1).normal(0, 0.05, t.size), strict=True)]
    head = "time [s],load_point_velocity [um/s],normal_load [N],force [N]"
    (tmp_path / "a.csv").write_text("\n".join([head, *rows]))
    (tmp_path / "experiment.toml").write_text(PLAY)
    fit = fit_recordings(REGISTRY, read_experiment(tmp_path, registry=REGISTRY)).fit
    assert fit.values["play"] == pytest.approx(play, abs=0.4)


def test_they_are_searched_for_only_where_they_are_named() -> None:
    named = ("slip-hardening", "frictional-heating", "rate-cutoff", "load-lag", "dilatancy", "layer-thinning", "backlash")
    for name in (*named, "load-servo", "pore-pressure", "gauge-creep"):
        assert REGISTRY.get("effect", name).on_request  # type: ignore[union-attr]
    assert not REGISTRY.get("effect", "second-state").on_request  # type: ignore[union-attr]


RAMP = LoadSteps.sequence([(10.0, 20.0, 20.0), (20.0, 20.0, 24.0), (30.0, 24.0, 24.0)], rise=0.5)  # 0.2 MPa/s for 20 s


def test_a_spring_stiffer_under_more_load_is_stretched_less_and_weighs_the_same() -> None:
    """After a ramp friction is mu W whatever the spring is: the elongation says K, a load cell does not."""
    own, drive = {"m": 0.5, "Wref": 20.0}, Drive.constant(1.0)
    model, t, motion = moved("load-stiffening", own, drive=drive, load=RAMP, end=90.0)
    p = model.vector({**GOUGE, **own})
    said = 24.0 * 0.6 / (0.1 * np.sqrt(24.0 / 20.0))  # um
    args = (motion.x[-1], 1.0, 24.0, 0.0)
    assert float(model.elongation(*args, p)) == pytest.approx(said, rel=1e-4)
    assert float(model.reading(*args, p)) == pytest.approx(said, rel=1e-4)
    weighed = model.vector({**GOUGE, **own, "weighed": 1.0})
    assert float(model.reading(*args, weighed)) * 0.1 == pytest.approx(24.0 * 0.6, rel=1e-4)
    # and at every moment what the stage moves and the slider does not stretches the spring, whose stiffness rises
    W, v = RAMP(t)[0], np.exp(state(model, motion, "ln_v"))
    mu = np.array([float(model.friction(x, 1.0, w, 0.0, p)) for x, w in zip(motion.x, W, strict=True)])
    u = W * mu / (0.1 * np.sqrt(W / 20.0))
    slid = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    assert u - u[0] == pytest.approx(t - slid, abs=5e-3)


def test_blocks_that_bulge_move_the_contact_and_no_force() -> None:
    """On a ramp of the load the contact slides by shift W' more; at rest nothing is left, where a crosstalk leaves a force."""
    shift, drive = 2.0, Drive.constant(1.0)
    speeds = {}
    for size in (shift, 0.0):
        model, t, motion = moved("poisson-coupling", {"shift": size}, drive=drive, load=RAMP, end=120.0)
        speeds[size] = np.exp(state(model, motion, "ln_v"))
        u = np.asarray(model.elongation(motion.x[-1], 1.0, 24.0, 0.0, model.vector({**GOUGE, "shift": size})))
        assert float(u) == pytest.approx(24.0 * 0.6 / 0.1, rel=1e-4)
    gained = np.trapezoid(speeds[shift] - speeds[0.0], t)
    assert gained == pytest.approx(shift * 4.0, rel=0.03)  # um; mu differs by what is left of A and B
    crosstalk, _, pulled = moved("tangential-crosstalk", {"share": 0.01}, drive=drive, load=RAMP, end=120.0)
    p = crosstalk.vector({**GOUGE, "share": 0.01})
    stretched = float(crosstalk.elongation(pulled.x[-1], 1.0, 24.0, 0.0, p))
    assert stretched - 24.0 * 0.6 / 0.1 == pytest.approx(0.01 * 4.0 / 0.1, rel=1e-2)


def test_a_servo_rings_as_an_oscillator_does() -> None:
    own = {"share": 1.0, "natural": 0.2, "damping": 0.3}
    load = LoadSteps.sequence([(10.0, 20.0, 20.0), (50.0, 22.0, 22.0)], rise=0.01)
    model, t, motion = moved("load-servo", own, drive=Drive.constant(1.0), load=load)
    w, z, since = 2 * np.pi * 0.2, 0.3, np.maximum(t - 10.005, 0.0)
    ringing = w * np.sqrt(1 - z**2)
    step = 1 - np.exp(-z * w * since) * (np.cos(ringing * since) + z * w / ringing * np.sin(ringing * since))
    assert state(model, motion, "served") == pytest.approx(20.0 + 2.0 * step, abs=2e-3)
    overshoot = np.exp(-np.pi * z / np.sqrt(1 - z**2))
    assert state(model, motion, "served").max() == pytest.approx(22.0 + 2.0 * overshoot, abs=5e-3)


def test_a_pore_pressure_lowers_friction_in_the_contact_and_a_drained_one_is_a_late_load() -> None:
    model, t, motion = moved("pore-pressure", {"pressure": 2.0}, drive=Drive.constant(1.0), load=RAMP, end=120.0)
    p = model.vector({**GOUGE, "pressure": 2.0})
    assert float(model.elongation(motion.x[-1], 1.0, 24.0, 0.0, p)) == pytest.approx(22.0 * 0.6 / 0.1, rel=1e-5)
    # Skempton's B of 0.6 and a drainage in 5 s: p' = B W' - p/5, which is what `load-lag` says of W - B (W - late)
    own = {"share": 0.6, "lag_time": 5.0}
    late, t, pressed = moved("load-lag", own, drive=Drive.constant(1.0), load=RAMP)
    W, pore = RAMP(t)[0], 0.6 * 0.2 * 5.0 * (1 - np.exp(-(t - 10.25) / 5.0))
    felt = W - 0.6 * (W - state(late, pressed, "late"))
    rising = (t > 12) & (t < 29)
    assert (W - felt)[rising] == pytest.approx(pore[rising], abs=2e-3)


def test_a_cell_that_creeps_shows_a_part_at_once_and_the_rest_late() -> None:
    own = {"share": 0.2, "creep_time": 4.0}
    model, t, motion = moved("gauge-creep", own)
    p = model.vector({**GOUGE, **own})
    ones = np.ones_like(t)
    W, V = 20.0 * ones, STEP(t)
    u, shown = (np.asarray(f(motion.x, V, W, 0 * ones, p)) for f in (model.elongation, model.reading))
    late = u[0] * 1.0
    crept = [late]
    h = t[1] - t[0]
    decay = np.exp(-h / 4.0)
    for a, b in pairwise(u):
        slope = (b - a) / h
        crept.append(b - slope * 4.0 + (crept[-1] - a + slope * 4.0) * decay)
    assert shown == pytest.approx(u + 0.2 * (np.array(crept) - u), abs=1e-3)
    assert np.abs(shown - u).max() > 0.1 and shown[-1] == pytest.approx(u[-1], abs=1e-4)


def test_what_is_never_fitted_follows_the_recording(tmp_path: Path) -> None:
    """The load under which the stiffness holds is that of the recording, is no free parameter, and may be stated."""
    rows = [f"{0.1 * k},{20 + 0.02 * k},{12 + 0.01 * k}" for k in range(100)]
    (tmp_path / "a.csv").write_text("\n".join(["time [s],normal_load [N],force [N]", *rows]))
    text = """format = "srf-experiment/1"
[apparatus]
stiffness = "0.1 N/um"
[model]
law = "dieterich-ruina"
ageing = "dieterich"
interface = "rigid"
effects = ["load-stiffening"]
[parameters]
m = { value = 0.0 }
%s
[[runs]]
name = "ramp"
file = "a.csv"
drive = [{ duration = 10.0, velocity = 3.0 }]
"""

    def held(stated: str = "") -> FitParameter:
        (tmp_path / "experiment.toml").write_text(text % stated)
        experiment = read_experiment(tmp_path, registry=REGISTRY)
        assert not next(q for q in experiment.parameters if q.name == "m").fixed
        return next(q for q in experiment.parameters if q.name == "Wref")

    assert (held().value, held().fixed) == (pytest.approx(20.99, abs=0.01), True)
    assert (held('Wref = { value = "15 N" }').value, held('Wref = { value = "15 N" }').fixed) == (15.0, True)
    assert not held("Wref = { value = 15.0, fixed = false }").fixed


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("fixed = true", "fixed = 1", "expected true or false"),
        ("fixed = true", "fixed = true, scan = 3", "given together with fixed"),
        ("neutral = 0.0,", "neutral = 0.0, fixed = true,", "given together with neutral"),
        ('"K*(W/Wref)**m"', '"K*(v/V0)**m*(W/Wref)**m"', "K may not hold"),
        ('"K*(W/Wref)**m"', '"K*(gauge/u)**m*(W/Wref)**m"', "K may not hold"),
    ],
)
def test_faults_of_a_spring_s_effect_are_told(old: str, new: str, said: str, tmp_path: Path) -> None:
    text = Path(REGISTRY.find("effect", "load-stiffening").location).read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "mine.toml").write_text(text.replace(old, new).replace("load-stiffening", "mine"))
    with pytest.raises(SrfError) as caught:
        open_model(load_registry((tmp_path,), user=False, entry_points=False), effects=("mine",))
    assert said in f"{caught.value.message} {caught.value.hint}"


@pytest.mark.skipif(compiler() is None, reason="no C compiler: the filter is compiled")
@pytest.mark.slow
def test_a_fit_of_a_load_cell_under_three_loads_finds_how_the_spring_stiffens(tmp_path: Path) -> None:
    """Recorded by the generator of concealed cases, whose equations are its own: the force is that of the stiffer spring."""
    slider = Physics(
        K=6e-3, mu0=0.6, A=0.006, B=0.009, D0=8.0, V0=10.0, Vsat=50.0, rigid=True, massless=True, K_power=0.4, Wref=7.0
    )
    lines, rng = [FORCES], np.random.default_rng(1)
    for W0 in (4.0, 7.0, 10.0):
        plan = Plan(f"at{W0:g}", ((8, 10.0), (8, 30.0), (10, 10.0)), W0, 0.05, steps=((20.0, 0.1 * W0),))
        trace, W = move(slider, plan), np.array([plan.load()(t)[0] for t in plan.times().tolist()])
        force = np.array([slider.spring_under(w) for w in W.tolist()]) * trace.u + 2e-3 * rng.standard_normal(W.size)
        V = np.where((trace.t > 7.99) & (trace.t < 15.99), 30.0, 10.0)
        rows = [f"{a:.3f},{b:g},{c:.6f},{d:.6f}" for a, b, c, d in zip(trace.t, V, W, force, strict=True)]
        head = "time [s],load_point_velocity [um/s],normal_load [N],force [N]"
        (tmp_path / f"{plan.name}.csv").write_text("\n".join([head, *rows]))
        lines.append(f'[[runs]]\nname = "{plan.name}"\nfile = "{plan.name}.csv"')
    (tmp_path / "experiment.toml").write_text("\n".join(lines))
    found = fit_recordings(REGISTRY, read_experiment(tmp_path, registry=REGISTRY)).fit
    errors = dict(zip(found.names, np.sqrt(np.diag(found.covariance)), strict=True))
    for name, true in {"m": 0.4, "mu0": 0.6, "A": 0.006, "B": 0.009, "D0": 8.0}.items():
        assert abs(found.values[name] - true) < 4 * errors[name], name
    assert errors["m"] < 2e-3 and "Wref" not in found.names


FORCES = """format = "srf-experiment/1"
[apparatus]
stiffness = "0.006 N/um"
[model]
law = "srf-vsat"
ageing = "dieterich"
interface = "rigid"
inertia = false
effects = ["load-stiffening"]
[parameters]
mu0 = { value = 0.58, lower = 0.3, upper = 0.9 }
A = { value = 0.007, lower = 0.001, upper = 0.03 }
B = { value = 0.008, lower = 0.001, upper = 0.03 }
D0 = { value = 9.0, lower = 1.0, upper = 50.0 }
Vsat = { value = 50.0, fixed = true }
V0 = { value = 10.0, fixed = true }
m = { value = 0.0 }
Wref = { value = 7.0 }
"""


@pytest.mark.slow
@pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here")
def test_a_concealed_servo_is_found_where_it_is_asked_for(tmp_path: Path) -> None:
    """Of another code: near its modulations a servo is almost a smaller load-transmission, and its frequency has false maxima."""
    truth = make_case(tmp_path / "servo", 7, effects=["load-servo"], size=0.6, rough=0.0, strengths=False)["physics"]
    found = diagnose(tmp_path / "servo", effects=["load-servo", "load-transmission"], registry=REGISTRY)
    assert (found.verdict, found.effects) == ("identified", ("load-servo",))
    fitted = found.diagnosis.best.fit.values
    for name, own in (("share", "servo"), ("natural", "servo_f"), ("damping", "servo_damping")):
        assert fitted[name] == pytest.approx(truth[own], rel=0.05)


def test_an_effect_is_refused_where_what_it_calls_steady_is_not(make_model) -> None:
    """Dilatancy is drained in steady sliding at an age of D0/v, which perrin-rice-zheng has not."""
    for ageing in ("dieterich", "ruina"):
        make_model(
            law="dieterich-ruina", ageing=ageing, interface="rigid", inertia=False, effects=("dilatancy",), stability=False
        )
    with pytest.raises(SrfError, match="'suction' is not steady at 0 under the ageing law 'perrin-rice-zheng'"):
        make_model(
            law="dieterich-ruina", ageing="perrin-rice-zheng", interface="rigid", inertia=False, effects=("dilatancy",),
            stability=False,
        )  # fmt: skip
