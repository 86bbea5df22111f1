"""Boundaries followed in a plane: all components, folds passed, edges hit, points as good as those found on lines."""

from __future__ import annotations

import numpy as np
import pytest
from brute import Slider, shoot

from srfcli.core.errors import Status
from srfcli.numerics.continuation import ContinuationSettings, crossing_numbers, find_components
from srfcli.numerics.critical import critical_line
from srfcli.numerics.plane import Axis, Plane

STEEP = 0.05  # of d ln|rho| / d ln W0: below it a fold is near


def window(model, eps, V=(1.0, 100.0), W0=(4.0, 400.0)):
    return Plane(model.vector({"eps": eps}), Axis("V", *V), Axis("W0", *W0))


@pytest.fixture(scope="module")
def boundary(model):
    """The boundary at eps = 0.18 in the window of the paper's figure 2, and more."""
    *_, last = find_components(model, window(model, 0.18))
    return last


def column(model, branch, name):
    return np.array([pt.value(model, name) for pt in branch.points])


def folds(values):
    """Return how often a sequence turns round."""
    return int(np.sum(np.diff(np.sign(np.diff(values))) != 0))


def test_two_components_at_eps_018(model, boundary):
    assert boundary.status is Status.OK
    small, large = sorted(boundary.branches, key=lambda b: column(model, b, "V").max())
    V = column(model, small, "V")
    assert (V[0], V[-1]) == (1.0, 1.0)
    assert 27.387 * (1 - 1e-3) < V.max() < 27.388  # the point next to the fold
    assert folds(V) == 1
    V = column(model, large, "V")
    assert sorted((V[0], V[-1])) == pytest.approx([1.0, 100.0], rel=1e-13)
    assert folds(V) == 10
    assert boundary.notes and "looked at" in boundary.notes[0]


def test_window_edges_are_hit_exactly(model, boundary):
    for branch in boundary.branches:
        assert branch.start is Status.LEFT_WINDOW and branch.end is Status.LEFT_WINDOW
        for point in (branch.points[0], branch.points[-1]):
            V = point.value(model, "V")
            assert min(abs(V - 1.0), abs(V / 100.0 - 1.0)) < 1e-13


def test_edge_across_the_load_is_hit_exactly(model):
    plane = window(model, 0.09, V=(1.0, 100.0), W0=(9.0, 30.0))
    *_, last = find_components(model, plane)
    [branch] = last.branches
    W0 = column(model, branch, "W0")
    assert sorted((W0[0], W0[-1])) == [pytest.approx(9.0, rel=1e-13), pytest.approx(30.0, rel=1e-13)]


def beside_folds(model, branch):
    """Return the indices of points two places beside a fold in V."""
    turns = np.nonzero(np.diff(np.sign(np.diff(column(model, branch, "V")))) != 0)[0] + 1
    return sorted({int(i) for t in turns for i in (t - 2, t + 2) if 0 <= i < len(branch.points)})


def upright(model, branch, i):
    """Return the share of a vertical distance that is normal to the curve at point i, in ln V and ln W0."""
    a, b = (branch.points[max(i - 1, 0)], branch.points[min(i + 1, len(branch.points) - 1)])
    along, up = (np.log(b.value(model, name) / a.value(model, name)) for name in ("V", "W0"))
    return abs(along) / np.hypot(along, up)


def test_points_agree_with_critical_loads_at_the_same_velocity(model, boundary):
    """A sample of points against scans of W0, which know nothing of the curve."""
    checked = 0
    for branch in boundary.branches:
        for i in [*range(0, len(branch.points), 12), len(branch.points) - 1]:
            point = branch.points[i]
            if abs(point.slope) < STEEP:
                continue  # beside a fold; see the next test
            V, W0 = (point.value(model, name) for name in ("V", "W0"))
            line = critical_line(model, model.vector({"eps": 0.18, "V": V}), lo=0.95 * W0, hi=1.05 * W0, tol=1e-9)
            assert line.points, (V, W0, point.slope)
            nearest = min(line.points, key=lambda q: abs(q.value(model, "W0") / W0 - 1))
            apart = abs(nearest.value(model, "W0") / W0 - 1)
            assert apart * upright(model, branch, i) < 3e-6, (V, W0, point.slope)
            assert nearest.theta == pytest.approx(point.theta, abs=1e-5)
            checked += 1
    assert checked > 15


def test_points_beside_folds_against_brute_force(model, boundary):
    """There two crossings lie close together; the growth must vanish to what 1e-6 in the parameters amounts to."""
    checked = 0
    for branch in boundary.branches:
        for i in beside_folds(model, branch)[::3]:
            point = branch.points[i]
            V, W0 = (point.value(model, name) for name in ("V", "W0"))
            orbit = shoot(Slider(V, W0, 0.18), point.orbit.x[0, 0])
            assert abs(orbit.growth) < 1e-6, (V, W0)
            checked += 1
    assert checked >= 6


def test_folds_are_passed(model, boundary):
    """On either side of each fold in V the direction in which stability is lost is opposite, and a point lies near it."""
    for branch in boundary.branches:
        V = column(model, branch, "V")
        slopes = np.array([pt.slope for pt in branch.points])
        turns = np.nonzero(np.diff(np.sign(np.diff(V))) != 0)[0] + 1
        for i in turns:
            assert slopes[i - 1] * slopes[i + 1] < 0
            assert np.abs(np.log(V[[i - 1, i + 1]] / V[i])).min() < 0.01
        away = np.ones(len(V), bool)
        away[np.unique(np.clip(np.concatenate([turns - 1, turns, turns + 1]), 0, len(V) - 1))] = False
        changes = np.nonzero(np.diff(np.sign(slopes)) != 0)[0]
        assert len(changes) == len(turns)


def test_parity_and_number_of_crossings(model, boundary):
    """Odd numbers are where stability is lost as W0 rises; the numbers at a V are 1, 2, 3... as critical_line gives them."""
    numbers = crossing_numbers(model, boundary)
    for branch, row in zip(boundary.branches, numbers, strict=True):
        assert len(row) == len(branch.points)
        for point, number in zip(branch.points, row, strict=True):
            assert number is None or (number % 2 == 1) == (point.slope > 0)
    checked = 0
    for branch, row in zip(boundary.branches, numbers, strict=True):
        for i in range(5, len(row), 20):
            V, W0 = (branch.points[i].value(model, name) for name in ("V", "W0"))
            line = critical_line(model, model.vector({"eps": 0.18, "V": V}), lo=4.0, hi=400.0, tol=1e-6)
            if abs(branch.points[i].slope) > STEEP:
                distance = [abs(q.value(model, "W0") / W0 - 1) for q in line.points]
                assert row[i] == line.crossings[int(np.argmin(distance))], (V, W0)
                checked += 1
    assert checked >= 8


def test_partial_iteration_gives_a_partial_boundary(model):
    """Each boundary yielded can be used as it stands; the first has one component."""
    search = find_components(model, window(model, 0.18), ContinuationSettings(lines=4))
    first = next(search)
    search.close()
    assert len(first.branches) == 1
    assert all(pt.status is Status.OK for pt in first.branches[0].points)


def test_interruption_keeps_what_was_followed(model):
    def stop(text):
        if text.endswith(" 40 points"):
            raise KeyboardInterrupt

    *_, last = find_components(model, window(model, 0.18), progress=stop)
    assert last.status is Status.INTERRUPTED
    [branch] = last.branches
    assert 20 < len(branch.points) <= 41
    assert Status.INTERRUPTED in (branch.start, branch.end)
    assert all(pt.status is Status.OK for pt in branch.points)


def test_nothing_in_the_window(model):
    *_, last = find_components(model, window(model, 0.09, V=(1.0, 2.0), W0=(4.0, 5.0)))
    assert not last.branches
    assert last.status is Status.OK
    assert last.notes


def test_nineteen_critical_loads_at_eps_04(model):
    line = critical_line(model, model.vector({"eps": 0.4, "V": 40.0}), lo=4.0, hi=500.0)
    assert len(line.points) == 19
    assert line.crossings == tuple(range(1, 20))
    assert all((pt.slope > 0) == (n % 2 == 1) for pt, n in zip(line.points, line.crossings, strict=True))
    assert all(pt.status is Status.OK for pt in line.points)


def test_continuation_in_eps_at_constant_velocity(model):
    """Any two parameters span the plane: at V = 8 the boundary in (eps, W0) starts at the Hopf load."""
    plane = Plane(model.vector({"V": 8.0}), Axis("eps", 0.0, 0.1, log=False), Axis("W0", 5.0, 30.0))
    *_, last = find_components(model, plane)
    [branch] = last.branches
    eps, W0 = column(model, branch, "eps"), column(model, branch, "W0")
    start = int(np.argmin(eps))
    assert eps[start] == 0.0
    assert W0[start] == pytest.approx(7.6915644129, rel=1e-6)
    assert eps.max() == pytest.approx(0.1, rel=1e-12)
