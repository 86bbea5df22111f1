"""Loads of pieces against convolution and differences; stick-slip found where it was put, and nowhere else."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from srfcli.core.errors import SrfError
from srfcli.motion.imposed import ConstantLoad, LoadSteps, ModulatedLoad, Modulation
from srfcli.motion.simulate import stick_slip

STEPS = LoadSteps.sequence([(2, 5, 5), (0.2, 5, 7), (0.01, 7, 9), (3.79, 3, 3)], start=-1.0, rise=0.05)


def value(knots: np.ndarray, coefficients: np.ndarray, t: np.ndarray) -> np.ndarray:
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(coefficients) - 1)
    return np.sum(coefficients[i] * (t - knots[i])[:, None] ** np.arange(coefficients.shape[1]), axis=1)


def kernel(x: np.ndarray) -> np.ndarray:
    """The rate of the quintic step: what the pieces are convolved with."""
    return np.where((x > 0) & (x < 1), 30 * x**2 * (1 - x) ** 2, 0.0)


def test_rounding_is_a_convolution_of_the_pieces() -> None:
    def pieces(t: np.ndarray) -> np.ndarray:
        steps = [t < 1.0, t < 1.2, t < 1.21]
        return np.select(steps, [5.0, 5 + 10 * (t - 1.0), 7 + 200 * (t - 1.2)], 3.0)

    x = (np.arange(4000) + 0.5) / 4000
    for t in (0.5, 1.01, 1.04, 1.1, 1.205, 1.22, 1.25, 1.4, 2.5):
        expected = float(np.mean(kernel(x) * pieces(t - 0.05 * x)))
        assert STEPS(np.array([t]))[0][0] == pytest.approx(expected, rel=2e-5), t
    assert STEPS.rest(-5.0) == 5.0 and STEPS.rest(50.0) == pytest.approx(3.0, rel=1e-14)


def test_the_load_is_twice_differentiable_across_its_breaks() -> None:
    for b in STEPS.breaks:
        t = b + np.array([-2e-7, -1e-9, 1e-9, 2e-7])
        W, W_dot = STEPS(t)
        assert (W[1], W_dot[1]) == pytest.approx((W[2], W_dot[2]), rel=1e-8, abs=5e-5)
        bend = (np.diff(W_dot) / np.diff(t))[::2]
        assert bend[0] == pytest.approx(bend[1], abs=2.0)  # of up to 1e4 N/s^2 between


@pytest.mark.parametrize(
    "load",
    [STEPS, ModulatedLoad(STEPS, Modulation(1.0, 0.5, 120.0, onset=0.0)), ModulatedLoad(STEPS, Modulation(1.0, 0.3, 0.7))],
    ids=["steps", "120 Hz", "0.7 Hz"],
)
def test_polynomials_are_the_load(load: Any) -> None:
    start, end = -1.3, 4.9
    t = np.sort(np.random.default_rng(0).uniform(start, end, 4000))
    knots, coefficients = load.polynomials(start, end)
    assert knots[0] == start and knots[-1] == end and (np.diff(knots) > 0).all()
    assert coefficients.shape[0] == knots.size - 1
    assert {b for b in load.breaks if start < b < end} <= set(knots.tolist())
    W, W_dot = load(t)
    assert value(knots, coefficients, t) == pytest.approx(W, rel=1e-11)
    before, after = (load(t[::40] + shift)[0] for shift in (-1e-6, 1e-6))
    assert (after - before) / 2e-6 == pytest.approx(W_dot[::40], rel=1e-5, abs=2e-4 * np.abs(W_dot).max())


def test_a_modulation_rides_on_the_load_of_the_moment() -> None:
    load = ModulatedLoad(STEPS, Modulation(1.0, 0.2, 50.0))
    t = np.linspace(-1.0, 5.0, 777)
    assert load(t)[0] == pytest.approx(STEPS(t)[0] * (1 + 0.2 * np.cos(2 * np.pi * 50.0 * t)), rel=1e-13)
    assert load.rest(3.0) == STEPS.rest(3.0) and load.longest_step(0.0, 1.0) == 0.25 / 50
    whole = ModulatedLoad(ConstantLoad(4.0), Modulation(1.0, 0.2, 50.0, onset=1.0))
    assert whole(t)[0] == pytest.approx(Modulation(4.0, 0.2, 50.0, onset=1.0)(t)[0], rel=1e-14)


pieces = st.tuples(st.floats(1e-3, 10), st.floats(0.01, 100), st.floats(0.01, 100))


@given(st.lists(pieces, min_size=1, max_size=6), st.floats(1e-3, 3.0))
@settings(max_examples=80, deadline=None)
def test_the_load_never_leaves_the_range_of_its_pieces(given_pieces: list[tuple[float, float, float]], rise: float) -> None:
    load = LoadSteps.sequence(given_pieces, rise=rise)
    ends = [W for _, first, last in given_pieces for W in (first, last)]
    t = np.linspace(-1.0, sum(p[0] for p in given_pieces) + rise + 1, 400)
    W, _ = load(t)
    assert W.min() >= min(ends) - 1e-8 * max(ends) and W.max() <= max(ends) * (1 + 1e-8)
    assert W[0] == pytest.approx(ends[0], rel=1e-12) and W[-1] == pytest.approx(ends[-1], rel=1e-8, abs=1e-8 * max(ends))


def test_a_load_of_one_level_is_constant() -> None:
    load = LoadSteps.sequence([(2, 5, 5), (1, 5, 5)], rise=0.02)
    assert load.breaks == () and load.corners == ()
    assert load(np.linspace(-1, 9, 7))[0].tolist() == [5.0] * 7
    knots, coefficients = load.polynomials(0.0, 3.0)
    assert knots.tolist() == [0.0, 3.0] and coefficients[0].tolist() == [5.0, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LoadSteps((0.0, 1.0), (5.0,), (5.0, 6.0), 0.1), "one edge more"),
        (lambda: LoadSteps((0.0, 0.0), (5.0,), (5.0,), 0.1), "must rise"),
        (lambda: LoadSteps((0.0, 1.0), (5.0,), (0.0,), 0.1), "lifts the slider off"),
        (lambda: LoadSteps((0.0, 1.0), (5.0,), (6.0,), 0.0), "positive time"),
        (lambda: ModulatedLoad(STEPS, Modulation(5.0, 0.1, 1.0)), "W0 = 1"),
    ],
)
def test_loads_refuse_what_makes_no_sense(make: Any, message: str) -> None:
    with pytest.raises(SrfError, match=message):
        make()


# stick-slip


def sawtooth(t: np.ndarray, period: float, drop: float, *, fall: float = 0.05, level: float = 18.0) -> np.ndarray:
    """Rise for most of each period and fall within `fall` of it."""
    phase = np.mod(t / period, 1.0)
    return level + drop * np.where(phase < 1 - fall, phase / (1 - fall), (1 - phase) / fall)


T = np.arange(20001) / 2000.0


def test_events_are_where_they_were_put() -> None:
    found = stick_slip(T, sawtooth(T, 0.65, 2.5))
    assert found.sustained and found.times.size == 15
    assert found.times == pytest.approx(0.65 * np.arange(1, 16) - 0.5 * 0.05 * 0.65, abs=1e-3)
    assert found.period == pytest.approx(0.65, rel=1e-3) and found.drop == pytest.approx(2.5, rel=1e-2)
    assert found.tops == pytest.approx(np.full(15, 20.5), abs=0.04)
    assert found.falls == pytest.approx(np.full(15, 0.0325), abs=1.1e-3)
    assert found.recurrence.size == 14


@pytest.mark.parametrize("ripple", [0.05, 0.5, 1.5])
def test_the_ripple_of_a_modulation_is_no_event(ripple: float) -> None:
    wave = ripple * np.cos(2 * np.pi * 120.0 * T + 0.3)
    plain, found = stick_slip(T, sawtooth(T, 0.65, 2.5)), stick_slip(T, sawtooth(T, 0.65, 2.5) + wave, ripple=120.0)
    assert found.times == pytest.approx(plain.times, abs=2e-3)
    assert found.drop == pytest.approx(plain.drop, rel=0.12)  # the average over a period rounds the tops
    assert not stick_slip(T, 18 + wave, ripple=120.0).sustained
    assert stick_slip(T, 18 + wave).sustained  # without being told, a ripple is an oscillation


@pytest.mark.parametrize("lag1", [0.0, 0.9])
@pytest.mark.parametrize("quantum", [0.0, 0.05])
def test_noise_and_rounding_are_no_events(lag1: float, quantum: float) -> None:
    from srfcli.data.noise import measured

    noisy = measured(sawtooth(T, 0.65, 2.5), noise=0.05, lag1=lag1, quantum=quantum, seed=3)
    found = stick_slip(T, noisy)
    assert found.times.size == 15 and found.period == pytest.approx(0.65, rel=0.01)
    assert found.drop == pytest.approx(2.5, rel=0.1)


def test_what_dies_out_is_not_sustained() -> None:
    for rate, lasts in ((1.0, False), (0.01, True), (-0.3, True)):
        u = 18 + np.exp(-rate * T) * np.sin(2 * np.pi * T / 0.5)
        assert stick_slip(T, u).sustained is lasts, rate
    ended = np.where(T < 4, sawtooth(T, 0.65, 2.5), 18.0)
    assert stick_slip(T, ended).times.size == 5 and not stick_slip(T, ended).sustained


@pytest.mark.parametrize(
    "u",
    [np.full(T.size, 18.0), 18 + 1e-7 * np.sin(T), 18 + T, 18 - T, 18 - np.tanh(T - 5), np.full(T.size, np.nan)],
    ids=["flat", "rounding", "rising", "falling", "one fall", "nothing"],
)
def test_steady_records_have_no_events(u: np.ndarray) -> None:
    found = stick_slip(T, u)
    assert found.times.size == 0 and not found.sustained
    assert math.isnan(found.period) and math.isnan(found.drop)


def test_gaps_and_uneven_sampling_do_no_harm() -> None:
    u = sawtooth(T, 0.65, 2.5)
    u[5000:5300] = np.nan
    keep = np.random.default_rng(1).random(T.size) < 0.3
    found = stick_slip(T[keep], u[keep])
    assert found.times.size == 15 and found.period == pytest.approx(0.65, rel=0.01)
    assert stick_slip(T[:3], u[:3]).times.size == 0


def test_smallest_drop_is_the_users() -> None:
    u = sawtooth(T, 0.65, 1e-3, level=0.0)
    assert stick_slip(T, u).sustained
    assert stick_slip(T, u, smallest=0.01).times.size == 0


@pytest.mark.parametrize(
    ("t", "u", "options", "message"),
    [(T, T[1:], {}, "as many values"), (T[::-1], T, {}, "must rise"), (T, T, {"ripple": -1.0}, "no frequency")],
)
def test_what_is_no_record_is_refused(t: np.ndarray, u: np.ndarray, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SrfError, match=message):
        stick_slip(t, u, **options)


@pytest.mark.parametrize(
    ("name", "events", "drop", "every"),
    [("k168Nm_v42", 86, 0.056, 4.3), ("k1002Nm_v42", 501, 0.082, 0.75), ("k168Nm_v1100", 63, 0.064, 0.22)],
)
def test_a_real_recording(shared: Path, name: str, events: int, drop: float, every: float) -> None:
    """Against the count that its README tells: peaks by prominence in every 20th sample of a running median.

    Tops of equal height, common in a quantised force, are each given the whole fall behind them there: 7 and 14 events twice.
    """
    from scipy.io import loadmat
    from scipy.ndimage import median_filter
    from scipy.signal import find_peaks

    path = shared / "data" / "paper-on-paper-stickslip" / f"{name}.mat"
    if not path.is_file():
        pytest.skip(f"REAL DATA ABSENT: {path}")
    data = loadmat(path)
    t, force = data["t"].ravel(), median_filter(data["Fnorm"].ravel(), 41)
    assert find_peaks(force[::20], prominence=0.04)[0].size == pytest.approx(events, abs=1)
    for sparse in (1, 20):
        found = stick_slip(t[::sparse], force[::sparse], smallest=0.04)
        tilted = force[::sparse] - 1e-9 * np.arange(t[::sparse].size)  # no two tops are equal
        assert found.times.size == pytest.approx(find_peaks(tilted, prominence=0.04)[0].size, abs=1)  # the last may be cut
        assert found.drop == pytest.approx(drop, rel=0.04)
        assert np.mean(found.recurrence) == pytest.approx(every, rel=0.12)
