"""Effects that laboratories meet, each against what its physics says in a limit that can be written down."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.laws.registry import load_registry
from srfcli.motion.imposed import ConstantLoad, Drive, Load, SampledLoad
from srfcli.motion.integrators import Motion, integrate

REGISTRY = load_registry(user=False, entry_points=False)
GOUGE = {"mu0": 0.6, "A": 0.009, "B": 0.006, "D0": 10.0, "V0": 1.0, "K": 0.1, "W0": 20.0, "V": 1.0}
STEP = Drive.steps([(0.0, 1.0), (20.0, 10.0)])


def moved(
    effect: str, own: dict[str, float], *, drive: Drive = STEP, load: Load | None = None, end: float = 60.0
) -> tuple[GeneratedModel, np.ndarray, Motion]:
    """Return the model of a gouge with the effect, times (n,) in s and the motion from steady sliding at 1 um/s under 20 MPa."""
    model = open_model(
        REGISTRY, law="dieterich-ruina", ageing="dieterich", interface="rigid", inertia=False, effects=(effect,)
    )
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


def friction(
    model: GeneratedModel, own: dict[str, float], t: np.ndarray, motion: Motion, drive: Drive = STEP
) -> np.ndarray:
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
    assert (
        np.abs(one - other).max()
        < 2e-5
        < np.abs(friction(model, {"drop": drop, "cooling": 4.0}, t, slow) - other).max()
    )


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


def test_they_are_searched_for_only_where_they_are_named() -> None:
    for name in ("slip-hardening", "frictional-heating", "rate-cutoff", "load-lag", "dilatancy"):
        assert REGISTRY.get("effect", name).on_request  # type: ignore[union-attr]
    assert not REGISTRY.get("effect", "second-state").on_request  # type: ignore[union-attr]
