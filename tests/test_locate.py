"""Where a misfit is found: at the place where it was put, and nowhere where there is only noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from srfcli.diagnosis.residual_scan import Location, ResidualScan, RunResiduals, log_tail, significant_misfit

N, STEP, FORCING = 1024, 0.002, 40.0
RUNS = ("one", "two", "three")


def design(n: int = N, seed: int = 5) -> list[RunResiduals]:
    """Return three runs of white residuals 0 with columns that are smooth and shared, v falling and phi wandering."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(n)
    found = []
    for k, name in enumerate(RUNS):
        V = np.where(t > 0.7 + 0.2 * k, 5.0, 20.0)
        phi = np.cumsum(rng.standard_normal(n)) / np.sqrt(n)
        W = 5.0 + k + (0.3 if k else 0.0) * np.cos(2 * np.pi * FORCING * t)
        X = np.column_stack([np.ones(n), V, t, np.sin(2 * np.pi * t)])
        coordinates = {"v": np.log(V) + 0.3 * np.sin(7 * t), "phi": phi, "W": W, "time": t}
        forcing = np.mod(FORCING * t, 1.0) if k else None
        found.append(RunResiduals(name, t, np.zeros(n), X, np.arange(4), ((0, n),), coordinates, forcing))
    return found


def located(pieces: list[RunResiduals], signals: dict[str, np.ndarray], *, seed: int = 3, draws: int = 100) -> Location:
    """Return what is found in noise with signals, given in units of the noise's standard deviation."""
    rng, scan = np.random.default_rng(seed), ResidualScan(pieces, 4)
    residuals = []
    for p in pieces:
        e = rng.standard_normal(p.white.size)
        residuals.append(e + np.asarray(signals.get(p.name, np.zeros(p.white.size))))
    return significant_misfit(scan, scan.projected(residuals), scan.null(draws, seed=1), {"two": FORCING, "three": FORCING})


def test_noise_alone_is_nowhere() -> None:
    found = located(design(), {})
    assert found.runs == () and found.p_value > 0.01
    assert (found.forcing_phase, found.frequencies, found.coordinate) == (None, (), None)


def test_false_alarms_come_as_often_as_they_should() -> None:
    pieces = design(n=128)
    scan = ResidualScan(pieces, 4)
    null, rng = scan.null(400, seed=7), np.random.default_rng(11)
    smallest = []
    for _ in range(200):
        M = scan.projected([rng.standard_normal(p.white.size) for p in pieces])
        smallest.append(min(r.p_value for r in scan.rows(M, null)))
    alarms = np.mean(np.array(smallest) < 0.05)
    assert 0.01 <= alarms <= 0.095, alarms  # 5 %, three standard errors of 200 trials
    assert abs(np.mean(np.array(smallest) < 0.5) - 0.5) < 0.12


def test_parameters_that_are_off_raise_no_alarm() -> None:
    pieces = design()
    scan = ResidualScan(pieces, 4)
    shifted = [p.X @ np.array([30.0, -2.0, 8.0, 5.0]) for p in pieces]
    assert max(np.abs(m).max() for m in scan.projected(shifted)) < 1e-8


def test_a_window_is_found() -> None:
    pieces = design()
    t = pieces[1].t
    bump = 4.0 * ((t > 1.2) & (t < 1.4)) * np.sin(2 * np.pi * 20 * t)
    found = located(pieces, {"two": bump})
    assert [r.name for r in found.runs] == ["two"]
    assert found.runs[0].share > 0.6 and found.runs[0].p_value < 1e-6
    low, high = found.runs[0].windows[0][0], found.runs[0].windows[-1][1]
    assert 1.1 < low < 1.3 and 1.3 < high < 1.5


def test_a_slow_window_is_found_by_its_shape() -> None:
    pieces = design()
    t = pieces[2].t
    found = located(pieces, {"three": 1.0 * np.exp(-(((t - 1.0) / 0.1) ** 2))})
    assert [r.name for r in found.runs] == ["three"]
    assert all(a < 1.2 and b > 0.8 for a, b in found.runs[0].windows) and found.runs[0].windows


def test_a_phase_of_the_forcing_is_found() -> None:
    pieces = design()
    inside = {p.name: (p.forcing > 0.30) & (p.forcing < 0.45) for p in pieces if p.forcing is not None}
    signals = {name: 2.0 * (x - x.mean()) for name, x in inside.items()}  # a mean would be the parameters'
    found = located(pieces, signals)
    assert {r.name for r in found.runs} == {"two", "three"}
    assert found.forcing_phase is not None
    low, high = (x / (2 * np.pi) for x in found.forcing_phase)
    assert low == pytest.approx(0.30, abs=0.09) and high == pytest.approx(0.45, abs=0.09)


def test_a_phase_of_stick_slip_is_found() -> None:
    t = design()[0].t
    cycle = np.where(t > 0.3, np.mod(3.1 * t, 1.0), np.nan)
    pieces = [replace(p, cycle=cycle) if p.name == "one" else p for p in design()]
    found = located(pieces, {"one": 1.5 * np.nan_to_num((cycle > 0.84) & (cycle < 0.91))})
    rows = [r for r in found.rows if r.axis == "cycle" and r.kind == "mean" and r.run == "one"]
    best = min(rows, key=lambda r: r.log_p)
    assert (best.low, best.high) == (pytest.approx(10 / 12), pytest.approx(11 / 12))
    assert best.p_value < 0.01 and sum(r.p_value < 0.01 for r in rows) <= 2


@pytest.mark.parametrize("harmonic", [1, 2, 3])
def test_a_harmonic_is_found_under_its_exact_frequency(harmonic: int) -> None:
    pieces = design()
    t = pieces[1].t
    found = located(pieces, {"two": 0.6 * np.cos(2 * np.pi * harmonic * FORCING * t + 0.4)})
    assert found.frequencies == (harmonic * FORCING,)


def test_a_line_is_no_harmonic_because_it_is_near_one() -> None:
    pieces = design()
    found = located(pieces, {"two": 0.6 * np.cos(2 * np.pi * 47.3 * pieces[1].t)})
    assert len(found.frequencies) == 1 and found.frequencies[0] == pytest.approx(47.3, abs=0.3)


@pytest.mark.parametrize(
    ("name", "function"), [("v", lambda x: 3 * np.sin(6 * x)), ("phi", lambda x: 2 * x**2), ("W", lambda x: 2 * np.cos(4 * x))]
)
def test_the_quantity_that_the_misfit_goes_with_is_named(name: str, function: Callable) -> None:
    pieces = design()
    found = located(pieces, {p.name: function(p.coordinates[name]) for p in pieces})
    assert found.coordinate is not None
    assert found.coordinate[0] == name and found.coordinate[1] > 0.7


def test_a_line_in_one_run_is_no_function_of_phi() -> None:
    pieces = design()
    found = located(pieces, {"one": np.cos(2 * np.pi * 91.0 * pieces[0].t)})
    assert found.coordinate is None or found.coordinate[1] < 0.1


def test_a_p_value_beyond_the_simulations_is_bonferronis() -> None:
    pieces = design()
    scan = ResidualScan(pieces, 4)
    null = scan.null(50, seed=2)
    tail = float(log_tail(np.array([140.0]), 1.0)[0])
    assert scan.adjusted(np.array([tail]), null)[0] == pytest.approx(scan.count * np.exp(tail))
    assert scan.adjusted(np.array([0.0]), null)[0] == 1.0


def test_tails_go_on_where_probabilities_vanish() -> None:
    x = np.array([600.0, 1200.0, 1e4, 1e6])
    found = log_tail(x, 4.0)
    exact = -x / 2 + np.log1p(x / 2)  # of four degrees of freedom
    assert found == pytest.approx(exact, rel=1e-3)


def test_a_parameter_that_moves_nothing_is_none() -> None:
    """Such as the length of a field that is not there: its error is infinite, and no recording is drawn with it."""
    pieces, rng = design(n=256), np.random.default_rng(3)
    wider = [replace(p, X=np.column_stack([p.X, 1e-17 * rng.standard_normal(256)]), indices=np.arange(5)) for p in pieces]
    nulls = [ResidualScan(some, k, kept=True).null(40, seed=1) for some, k in ((pieces, 4), (wider, 5))]
    assert nulls[0] == pytest.approx(nulls[1], rel=1e-9)


def test_residuals_that_are_kept_are_judged_with_their_parameters_errors() -> None:
    pieces, rng = design(n=256), np.random.default_rng(3)
    scan = ResidualScan(pieces, 4, kept=True)
    null = scan.null(200, seed=1)
    values, vectors = np.linalg.eigh(-scan.inverse)
    assert values.min() > -1e-9 * values.max()  # a covariance, singular to rounding
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    low = []
    for _ in range(60):
        off = root @ rng.standard_normal(4)
        M = scan.projected([rng.standard_normal(p.white.size) + p.X @ off for p in pieces])
        low.append(min(r.p_value for r in scan.rows(M, null)) < 0.05)
    assert np.mean(low) < 0.15
    assert scan.projected([p.X[:, 0] * 5 for p in pieces])[0].std() >= 0  # nothing is projected
    assert np.abs(scan.projected([p.X @ np.ones(4) for p in pieces])[0]).max() > 1


def test_a_run_that_is_lost_is_followed_until_then() -> None:
    piece = design()[1]
    white = np.zeros(N)
    white[600:] = 50.0
    cut = replace(piece, white=white, lost=30.0).followed()
    assert cut.t.size == 600 and cut.parts == ((0, 600),) and cut.X.shape == (600, 4)
    assert all(x.size == 600 for x in cut.coordinates.values())
    assert replace(piece, lost=30.0).followed().t.size == N
