"""Stability maps: points against brute force, refinement where a boundary hides, every component found, by two methods."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from brute import Slider, shoot, steady

from srfcli.core.errors import SrfError, Status
from srfcli.numerics.collocation import solved
from srfcli.numerics.continuation import ContinuationSettings, StepSettings, find_components
from srfcli.numerics.critical import critical_line
from srfcli.numerics.map import STABILITY_KINDS, compute_map, join_tiles, kinds, neighbours, per_slip, solve_tile, suspects
from srfcli.numerics.map_boundaries import find_boundaries, unexplained
from srfcli.numerics.orbit import forced_guess, robust_orbits, steady_guess, uniform_mesh
from srfcli.numerics.plane import Axis, MapAxis, MapGrid, MapSettings, Plane, tile_tasks
from srfcli.numerics.special_points import crossings_at, special_points


def window(model, eps, columns, rows, *, V=(1.0, 100.0), ratio=(0.0021, 0.03), **values):
    return MapGrid(model.vector({"eps": eps, **values}), MapAxis("V", *V, columns), MapAxis("W0", *ratio, rows, True, "K"))


def finished(model, found, settings=None):
    *_, last = find_boundaries(model, found, settings)
    return last


def extents(model, boundary):
    """Return the ranges of V and W0 of each component, in the order of its lowest load."""
    spans = []
    for branch in boundary.branches:
        V, W0 = (np.array([pt.value(model, name) for pt in branch.points]) for name in ("V", "W0"))
        spans.append((W0.min(), V.min(), V.max(), W0.max()))
    return np.array(sorted(spans))


@pytest.fixture(scope="module")
def found(model):
    """The map of the paper's system at eps = 0.18, coarser than the default."""
    return compute_map(model, window(model, 0.18, 31, 61))


@pytest.fixture(scope="module")
def boundary(model, found):
    return finished(model, found)


def test_points_are_the_multipliers_of_brute_force(model, found):
    """A sample over the whole window, orbits and multipliers by shooting from the equations as printed."""
    rng, p = np.random.default_rng(3), found.points(model)
    for i, j in zip(rng.integers(0, 31, 5), rng.integers(0, 61, 5), strict=True):
        V, W0 = p[model.index("V"), i, j], p[model.index("W0"), i, j]
        growth = brute_growth(model, V=float(V), W0=float(W0), eps=0.18)
        assert found.growth[i, j] == pytest.approx(growth, abs=3e-4)
        assert (found.kind[i, j] == STABILITY_KINDS.index("stable")) == (growth < 0)


def test_exponent_per_slip_is_that_of_the_linear_theory_without_modulation(model):
    """At eps = 0 the exponent is the real part of a root of the characteristic polynomial, whatever the frequency."""
    grid = window(model, 0.0, 3, 4)
    found = compute_map(model, grid)
    p = found.points(model)
    scaled = found.growth * per_slip(model, p)
    for i, j in np.ndindex(3, 4):
        roots = np.roots(np.asarray(model.characteristic(list(p[:, i, j])))[::-1])
        V, D0 = p[model.index("V"), i, j], p[model.index("D0"), i, j]
        # the fastest roots are not resolved by a mesh that suits the leading one
        assert scaled[i, j] == pytest.approx(float(roots.real.max()) * D0 / V, rel=1e-3, abs=1e-6)


def test_two_components_at_eps_018(model, found, boundary):
    assert boundary.status is Status.OK
    small, large = extents(model, boundary)
    assert small[1:3] == pytest.approx([1.0, 27.387], rel=1e-3)  # the point next to the fold
    assert large[1:2] == pytest.approx([1.0], rel=1e-9)
    assert all(pt.status.ok and pt.error <= 1e-6 for b in boundary.branches for pt in b.points)
    assert not len(unexplained(model, found, boundary))


def test_a_missing_component_is_noticed(model, found, boundary):
    without = dataclasses.replace(boundary, branches=boundary.branches[:1])
    assert len(unexplained(model, found, without)) > 10


def test_number_of_boundaries_on_a_line_is_that_of_a_scan_of_the_line(model, boundary):
    values = np.array([2.0, 20.0, 41.0])
    for V, heights in zip(values, crossings_at(model, boundary.plane, boundary.branches, values), strict=True):
        lo, hi = 0.21 / 0.03, 0.21 / 0.0021
        line = critical_line(model, model.vector({"eps": 0.18, "V": V}), lo=lo, hi=hi, tol=1e-6)
        assert len(heights) == len(line.points)
        assert heights == pytest.approx([pt.value(model, "W0") for pt in line.points], rel=5e-3)


def test_folds_lie_where_crossings_appear(model, boundary):
    """Two crossings just before the fold's velocity are gone just beyond it."""
    marks = [s for b in boundary.branches for s in special_points(model, boundary.plane, b) if s.axis == "V"]
    assert all(s.status is Status.OK for s in marks)
    fold = min(marks, key=lambda s: s.p[model.index("W0")])
    V, W0 = (float(fold.p[model.index(name)]) for name in ("V", "W0"))
    assert pytest.approx(27.387153754, rel=1e-6) == V  # a second mesh and step agree to this
    counts = []
    for side in (1 - 1e-5, 1 + 1e-5):
        base = model.vector({"eps": 0.18, "V": V * side})
        line = critical_line(model, base, lo=0.95 * W0, hi=1.05 * W0, tol=1e-7, samples=48, resolution=1e-4)
        counts.append(len(line.points))
    assert counts == [2, 0]


@pytest.mark.parametrize(
    ("law", "eps", "count"),
    [("srf-vsat", 0.18, 2), pytest.param("srf-vsat", 0.4, 4, marks=pytest.mark.slow), ("log-log", 0.18, None),
     ("bowden-tabor", 0.18, None)],
)  # fmt: skip
def test_a_second_method_finds_the_same_components(model, make_model, law, eps, count):
    """A map, and curves from lines on a finer mesh with other seeds and shorter steps; with folds among them."""
    model = model if law == "srf-vsat" else make_model(law=law)  # with parameters as shipped
    grid = window(model, eps, 30, 40, ratio=(0.21 / 200, 0.21 / 8))
    boundary = finished(model, compute_map(model, grid, MapSettings(depth=2)))
    other = ContinuationSettings(lines=9, samples=100, tol=1e-5, steps=StepSettings(largest=0.025, mesh_error=5e-5))
    *_, second = find_components(model, Plane(grid.base, Axis("V", 1.0, 100.0), Axis("W0", 8.0, 200.0)), other)
    assert len(boundary.branches) == len(second.branches) == (count or len(second.branches)) > 0
    assert extents(model, boundary)[:, :2] == pytest.approx(extents(model, second)[:, :2], rel=1e-3)
    if eps < 0.4:
        folds = special_folds(model, boundary)
        assert folds and folds == pytest.approx(special_folds(model, second), rel=1e-5)


def special_folds(model, boundary):
    """Return the velocities at which boundaries turn round, rising."""
    return sorted(float(s.p[0]) for b in boundary.branches for s in special_points(model, boundary.plane, b) if s.axis == "V")


def test_an_island_is_found_and_closed(model):
    """A resonance region in the plane of frequency and amplitude that touches no edge of the window."""
    base = model.vector({"V": 30.0, "W0": 13.0})
    grid = MapGrid(base, MapAxis("f", 140.0, 200.0, 13, False), MapAxis("eps", 0.12, 0.48, 15, False))
    found = compute_map(model, grid)
    boundary = finished(model, found)
    islands = [b for b in boundary.branches if b.end is Status.CLOSED]
    assert len(islands) == 1 and islands[0].start is Status.CLOSED
    f = np.array([pt.value(model, "f") for pt in islands[0].points])
    assert (f.min(), f.max()) == pytest.approx((155.966, 182.97), rel=2e-3)
    assert not len(unexplained(model, found, boundary))
    assert brute_growth(model, V=30.0, W0=13.0, eps=0.3, f=168.0) * brute_growth(model, V=30.0, W0=13.0, eps=0.15, f=168.0) < 0


def brute_growth(model, **values):
    """Return ln |leading multiplier| by shooting, which starts from the collocation's orbit."""
    p = model.vector({"eps": 0.18, **values})
    start = robust_orbits(model, p[:, None], None, uniform_mesh(32)).orbit.x[0, 0]
    return shoot(Slider(**values), start, rtol=1e-8, tol=1e-6).growth


def test_resonances_lie_where_the_multiplier_is_a_root_of_one(model):
    """At low frequency the critical multiplier turns far in a period: 1:4, 1:3, and 1:2 where it meets the real axis."""
    grid = window(model, 0.05, 11, 12, V=(5.0, 20.0), ratio=(0.022, 0.03), f=15.0)
    boundary = finished(model, compute_map(model, grid))
    marks = {s.what: s for b in boundary.branches for s in special_points(model, boundary.plane, b)}
    assert marks["1:4"].theta == pytest.approx(np.pi / 2, abs=1e-7)
    assert marks["1:3"].theta == pytest.approx(2 * np.pi / 3, abs=1e-7)
    assert marks["1:4"].error < 1e-6 and marks["1:3"].error < 1e-6
    assert marks["1:2"].error < 5e-3
    V, W0 = (float(marks["1:3"].p[model.index(n)]) for n in ("V", "W0"))
    slider = Slider(V=V, W0=W0, eps=0.05, f=15.0)
    orbit = shoot(slider, steady(slider), rtol=1e-10)
    assert abs(np.angle(orbit.multipliers[0])) == pytest.approx(2 * np.pi / 3, abs=1e-5)
    assert orbit.growth == pytest.approx(0.0, abs=1e-5)


def test_a_tongue_between_grid_points_is_found_by_refinement(model):
    """The tip of the tongue at V = 27.387 lies within one cell, all of whose corners are stable."""
    grid = window(model, 0.18, 5, 4, V=(27.2, 29.0), ratio=(0.21 / 17.5, 0.21 / 13.0))
    coarse = compute_map(model, grid, MapSettings(depth=0))
    assert (coarse.kind == STABILITY_KINDS.index("stable")).all()
    fine = compute_map(model, grid, MapSettings(depth=4))
    assert len(fine.extra_at)
    assert len(finished(model, fine).branches) == 1


@pytest.mark.parametrize("shape", [(2, 2), (17, 49), (33, 7), (5, 200)])
def test_tiles_cover_every_cell_once(model, shape):
    cells = np.zeros((shape[0] - 1, shape[1] - 1), dtype=int)
    for task in tile_tasks(model, window(model, 0.18, *shape)):
        cells[slice(*task.columns), slice(*task.rows)] += 1
    assert (cells == 1).all()


def test_the_division_into_tiles_matters_little(model):
    """Another division is another set of guesses and meshes: values agree to the mesh's error."""
    grid = window(model, 0.18, 13, 17, V=(5.0, 30.0))
    one = compute_map(model, grid, MapSettings(block=(16, 48), depth=1))
    many = compute_map(model, grid, MapSettings(block=(4, 5), depth=1))
    assert one.growth == pytest.approx(many.growth, abs=3e-4)


def test_tiles_may_come_in_any_order(model):
    grid = window(model, 0.18, 9, 9)
    settings = MapSettings(block=(4, 4), depth=1)
    tasks = tile_tasks(model, grid, settings)
    tiles = {t.index: solve_tile(t) for t in reversed(tasks)}
    late = join_tiles(model, grid, settings, [(t, tiles[t.index]) for t in tasks])
    assert late.leading.tobytes() == compute_map(model, grid, settings).leading.tobytes()


def test_an_interrupted_map_keeps_what_is_finished(model):
    def interrupted(function, tasks):
        for index in (3, 1):
            yield index, function(tasks[index])
        raise KeyboardInterrupt

    grid, settings = window(model, 0.18, 9, 9), MapSettings(block=(4, 4), depth=1)
    whole, part = compute_map(model, grid, settings), compute_map(model, grid, settings, run=interrupted)
    assert whole.finished and not part.finished
    done = np.isfinite(part.leading)
    assert 0 < done.sum() < done.size
    assert (part.leading[done] == whole.leading[done]).all()


@pytest.mark.parametrize(
    ("corners", "error", "wanted"),
    [
        ([-1.0, -1.0, -1.0, -1.0], 0.5, False),
        ([-0.1, -1.0, -1.0, -1.0], 0.5, True),  # could reach zero inside
        ([0.1, 1.0, 1.0, 1.0], 0.5, True),
        ([-1.0, 1.0, 1.0, -1.0], 0.0, True),  # a saddle: which corners are joined is not known
        ([-1.0, -1.0, 1.0, 1.0], 0.1, False),  # a boundary that is plain to see
        ([-1.0, -1.0, 1.0, 1.0], 0.9, True),
        ([-1.0, np.nan, 1.0, 1.0], 0.9, False),
    ],
)
def test_which_cells_are_halved(corners, error, wanted):
    assert suspects(np.array([corners]), np.array([error])).tolist() == [wanted]


def test_neighbours_interpolate_cubics_exactly():
    known, new = np.array([0, 8, 16, 24, 30]), np.array([4, 20, 28, 12])
    index, weights = neighbours(known, new)
    at = known[index]
    assert (weights * (at**3 - 2.0 * at**2)).sum(axis=1) == pytest.approx(new**3 - 2.0 * new**2)


def test_kinds_of_multipliers():
    rho = np.array([np.nan, 0.5, 1.1 + 0.3j, -1.2, 1.3, 1e-200 + 0j])
    assert [STABILITY_KINDS[k] for k in kinds(rho)] == ["unresolved", "stable", "ns", "pd", "fold", "stable"]


@pytest.mark.parametrize(
    ("x", "y", "said"),
    [
        (MapAxis("V", 1, 9, 5), MapAxis("V", 1, 9, 5), "both involve V"),
        (MapAxis("K", 0.1, 0.3, 5), MapAxis("W0", 0.01, 0.03, 5, True, "K"), "both involve K"),
        (MapAxis("V", 1, 9, 1), MapAxis("W0", 4, 9, 5), "has 1 point"),
        (MapAxis("V", 1, 9, 5), MapAxis("W0", 0.0, 0.03, 5, False, "K"), "begins at 0"),
        (MapAxis("Q", 1, 9, 5), MapAxis("W0", 4, 9, 5), "unknown parameter"),
    ],
)
def test_axes_that_span_no_plane_are_refused(model, x, y, said):
    with pytest.raises(SrfError, match=said):
        tile_tasks(model, MapGrid(model.vector({"eps": 0.1}), x, y))


def test_a_ratio_moves_its_second_part(model):
    axis = MapAxis("W0", 0.005, 0.03, 7, False, "K")
    base = model.vector({})
    loads = axis.parameter(model, base, axis.samples())
    assert loads[[0, -1]] == pytest.approx([0.21 / 0.005, 0.21 / 0.03])
    p = np.repeat(base[:, None], 7, axis=1)
    p[model.index("W0")] = loads
    assert axis.quantity(model, p) == pytest.approx(axis.samples())
    assert (axis.between(np.array([0.0, 6.0])) == [0.005, 0.03]).all()


def test_other_values_leave_the_rest_as_it_is(model):
    p = model.vector()
    q = model.with_values(p, V=np.array([1.0, 2.0]), eps=0.1)
    assert q.shape == (len(p), 2) and (q[model.index("V")] == [1.0, 2.0]).all() and (q[model.index("eps")] == 0.1).all()
    rest = [i for i, name in enumerate(model.names) if name not in ("V", "eps")]
    assert (q[rest] == p[rest, None]).all() and (p == model.vector()).all()


def test_orbits_on_one_mesh_are_added_and_scaled_one_by_one(model):
    p = model.vector({"V": np.array([5.0, 10.0]), "eps": 0.1})
    a, b = forced_guess(model, p, uniform_mesh(8)), steady_guess(model, p, uniform_mesh(8))
    half = np.array([0.5, 0.25]) * (a - b) + b
    for k, share in enumerate((0.5, 0.25)):
        one = share * (a.part(k) - b.part(k)) + b.part(k)
        assert (half.part(k).x == one.x).all() and (half.part(k).stages == one.stages).all()
    assert not (a + a.unchanged() - a).stages.any()


def test_a_singular_matrix_spoils_no_other():
    matrices, right = np.stack([np.eye(2), np.ones((2, 2)), 2 * np.eye(2)]), np.ones((3, 2, 1))
    found = solved(matrices, right)
    assert (found[0] == 1.0).all() and np.isnan(found[1]).all() and (found[2] == 0.5).all()
