"""Without a window every crossing on a line is found, however far from the critical load at eps = 0, or the status says not."""

from __future__ import annotations

import numpy as np
import pytest
from brute import Slider, error_of_load, shoot

from srfcli.core.errors import Status
from srfcli.numerics.critical import critical_line, found_window, load_window, scan_line


def test_crossings_far_above_the_load_at_rest(model):
    """At 100 um/s the boundary lies at 47 times the load at eps = 0."""
    base = model.vector({"V": 100.0, "eps": 0.3})
    line = critical_line(model, base)
    assert line.status is Status.OK and line.crossings == (1,)
    (point,) = line.points
    load = point.value(model, "W0")
    assert load == pytest.approx(619.634311, rel=1e-8)
    assert load_window(model, [base])[1] < load
    error, _ = error_of_load(Slider(100.0, load, 0.3), point.orbit.x[0, 0])
    assert abs(error) < 1e-6


def test_islands_far_below(model):
    """Where the slider swings on spring and interface at half the forcing frequency, it does so at 0.07 N."""
    line = critical_line(model, model.vector({"V": 0.1, "eps": 0.18}), tol=1e-7)
    low = [q for q in line.points if q.value(model, "W0") < 0.1]
    assert line.status is Status.OK and [q.kind for q in low] == ["pd", "pd"]
    for point in low:
        orbit = shoot(Slider(0.1, point.value(model, "W0"), 0.18), point.orbit.x[0, 0])
        assert np.abs(orbit.multipliers + 1).min() < 1e-5
    assert line.crossings == tuple(range(1, len(line.points) + 1))


@pytest.mark.parametrize(
    ("law", "V", "eps", "loads"),
    [
        ("srf-vsat", 0.1, 0.3, (27.3093, 27.4527)),
        ("two-state", 0.1, 0.09, (0.0693416, 0.072986)),
        ("dieterich-ruina", 1.0, 0.5, (63.499, 64.1819)),
    ],
)
def test_tongues_narrower_than_the_spacing_of_loads(make_model, law, V, eps, loads):
    """The swing meets a multiple of half the forcing frequency between two loads that show nothing of it."""
    model = make_model(law=law)
    base = model.vector({"V": V, "eps": eps})
    line = critical_line(model, base, tol=1e-6)
    assert line.status is Status.OK
    found = np.array([q.value(model, "W0") for q in line.points])
    values = np.geomspace(0.98 * loads[0], 1.02 * loads[1], 80)
    scan = scan_line(model, base, "W0", values, intervals=64, tongues=False)
    assert len(scan.brackets()) == 2
    for i, load in zip(scan.brackets(), loads, strict=True):
        assert scan.values[i] < load < scan.values[i + 1]
        assert np.abs(np.log(found / load)).min() < 2e-5


def test_the_edge_of_a_narrow_tongue_is_a_boundary_point(model):
    line = critical_line(model, model.vector({"V": 0.1, "eps": 0.3}), lo=27.0, hi=28.0, samples=4)
    assert line.status is Status.OK and len(line.points) == 2
    for point in line.points:
        slider = Slider(0.1, point.value(model, "W0"), 0.3)
        error, _ = error_of_load(slider, point.orbit.x[0, 0], tol=5e-8)  # v runs over eight decades: shooting's noise is 1e-8
        assert abs(error) < 1e-6


def test_a_jump_between_branches_is_no_crossing(model):
    """Where the slider's swing is driven at its own frequency, two stable states end in folds, with unstable ones between."""
    line = critical_line(model, model.vector({"V": 0.1, "eps": 0.5}), lo=6.7242987, hi=7.0565009, samples=3)
    assert line.status is Status.NO_CONVERGENCE
    assert line.points and all(q.status is Status.NO_CONVERGENCE for q in line.points)
    assert len(line.notes) == len(line.points) and all("was not located" in note for note in line.notes)


@pytest.mark.parametrize(
    ("law", "ageing", "V", "eps"), [("bowden-tabor", "dieterich", 3.0, 0.4), ("srf-vsat", "dieterich", 150.0, 0.1)]
)
def test_nothing_is_missed_that_a_wide_scan_sees(make_model, law, ageing, V, eps):
    model = make_model(law=law, ageing=ageing)
    base = model.vector({"V": V, "eps": eps})
    line = critical_line(model, base, tol=1e-6)
    found = np.array([q.value(model, "W0") for q in line.points])
    scan = scan_line(model, base, "W0", np.geomspace(0.02, 2e4, 500), intervals=32)
    seen = np.array([(scan.values[i] * scan.values[i + 1]) ** 0.5 for i in scan.brackets()])
    assert line.status is Status.OK
    assert [np.abs(np.log(found / w)).min() < 0.02 for w in seen] == [True] * len(seen)
    assert len(found) >= len(seen)


def test_a_window_is_widened_to_what_crosses_beyond_it(model):
    lines = [model.vector({"V": V, "eps": 0.4}) for V in (30.0, 100.0)]
    usual, window = load_window(model, lines), found_window(model, lines)
    assert window.certain and usual[1] < 1194.7 < window.hi < 3 * 1194.7 and window.widening > 1
    calm = [model.vector({"V": 10.0, "eps": 0.05})]
    window = found_window(model, calm)
    assert (window.lo, window.hi) == load_window(model, calm) and window.certain


def test_what_has_not_settled_is_said(model):
    """A strong modulation of fast sliding: the growth rate has no end that could be told from samples."""
    line = critical_line(model, model.vector({"V": 400.0, "eps": 0.97}), samples=40, tol=1e-4)
    assert line.status is Status.UNSETTLED and not line.status.ok
    assert any("had not settled" in note for note in line.notes)
