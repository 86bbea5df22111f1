"""Folds of the forced state and their cusps, against eps as a function of the amplitude, from equations written by hand."""

from __future__ import annotations

import numpy as np
import pytest
from brute import Slider, rates
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from srfcli.numerics.continuation import ContinuationSettings
from srfcli.numerics.map import STABILITY_KINDS, compute_map, integrate_to_periodic_state
from srfcli.numerics.map_boundaries import find_boundaries, unexplained
from srfcli.numerics.orbit import robust_orbits, solve_orbits, uniform_mesh
from srfcli.numerics.plane import MapAxis, MapGrid, MapSettings
from srfcli.numerics.special_points import special_points

V, W0 = 10.0, 7.6


@pytest.fixture(scope="module")
def found(model):
    """A map around the cusp, in several tiles."""
    base = model.vector({"V": V, "W0": W0})
    grid = MapGrid(base, MapAxis("f", 3.2, 3.7, 17), MapAxis("eps", 2e-4, 6e-3, 17))
    return compute_map(model, grid, MapSettings(block=(8, 8)))


@pytest.fixture(scope="module")
def boundary(model, found):
    *_, last = find_boundaries(model, found, ContinuationSettings(tol=1e-7))
    return last


@pytest.fixture(scope="module")
def cusp(model, boundary):
    (one,) = (s for b in boundary.branches for s in special_points(model, boundary.plane, b) if s.what == "cusp")
    return one


def response(f, amplitudes, start, eps):
    """Return eps at which a periodic state has these ln v at t = 0, by shooting outwards from `start`, the one in the middle."""
    found, middle = {}, len(amplitudes) // 2
    for half in (range(middle, len(amplitudes)), range(middle, -1, -1)):
        unknowns = np.array([start[0], start[1], start[3], eps * 1e4])
        for k in half:

            def mismatch(y, ln_v=amplitudes[k]):
                s = Slider(V=V, W0=W0, eps=y[3] * 1e-4, f=f)
                x0 = np.array([y[0], y[1], ln_v, y[2]])
                motion = solve_ivp(
                    lambda t, x: rates(s, t, *x), (0, 1 / f), x0, method="LSODA", first_step=1e-6, rtol=1e-10, atol=1e-10
                )
                return motion.y[:, -1] - x0

            unknowns, _, flag, said = fsolve(mismatch, unknowns, xtol=1e-8, epsfcn=1e-10, factor=0.1, full_output=True)
            assert flag == 1, said
            found[k] = unknowns[3] * 1e-4
    return np.array([found[k] for k in range(len(amplitudes))])


def brute_states(model, point):
    """Return a located orbit's (u, z, ln v, ln phi) at t = 0: where shooting begins."""
    assert model.states == ("u", "z", "ln_v", "ln_phi")
    return list(point.orbit.x[0, 0])


def test_one_curve_of_folds_with_one_cusp_accounts_for_the_map(model, found, boundary, cusp):
    (branch,) = boundary.branches
    assert {pt.kind for pt in branch.points} == {"fold"} and all(pt.status.ok for pt in branch.points)
    assert max(pt.others for pt in branch.points) < 1
    assert cusp.status.ok and 0 < cusp.place < len(branch.points) - 1
    assert len(unexplained(model, found, boundary)) == 0
    assert not (found.kind == STABILITY_KINDS.index("fold")).any()  # the state between the folds is not taken


def test_beyond_the_fold_the_other_state_is_found_across_tiles(model, found):
    f, eps = found.grid.x.samples(), found.grid.y.samples()
    beyond = (f[:, None] > 3.45) & (eps[None] > 2.2e-3)
    assert np.isfinite(found.leading[beyond]).all()
    assert found.lost <= 0.02 * found.leading.size


@pytest.mark.parametrize("which", [0.25, 1.4])
def test_a_fold_is_an_extremum_of_eps_along_the_response(model, boundary, cusp, which):
    (branch,) = boundary.branches
    last = len(branch.points) - 1
    place = which * cusp.place if which < 1 else cusp.place + (which - 1) * (last - cusp.place)
    point = branch.points[round(place)]
    f, eps = point.value(model, "f"), point.value(model, "eps")
    start = brute_states(model, point)
    a = start[2] + np.linspace(-0.02, 0.02, 5)
    curve = response(f, a, start, eps)
    fit = np.polynomial.Polynomial.fit(a, curve, 4)
    (turn,) = (r.real for r in fit.deriv().roots() if abs(r.imag) < 1e-9 and a[0] < r.real < a[-1])
    assert fit(turn) == pytest.approx(eps, rel=2e-6)


@pytest.mark.slow
def test_at_the_cusp_two_extrema_of_eps_along_the_response_meet(model, boundary, cusp):
    (branch,) = boundary.branches
    point = branch.points[round(cusp.place)]
    f, eps = (float(cusp.p[model.index(name)]) for name in ("f", "eps"))
    assert (f, eps) == (pytest.approx(3.578127, rel=1e-5), pytest.approx(4.6335e-4, rel=1e-3))
    counts = []
    for factor in (0.997, 1.0, 1.003):
        start = brute_states(model, point)
        a = start[2] + (0.15 if factor == 1.0 else 0.25) * np.linspace(-1, 1, 13)
        fit = np.polynomial.Polynomial.fit(a, response(factor * f, a, start, eps), 8)
        slope, inside = fit.deriv(), np.linspace(a[0], a[-1], 401)
        steepest = np.abs(slope(inside)).max()
        if factor == 1.0:  # the inflection is level there, at the cusp's eps
            level = inside[np.argmin(np.abs(slope(inside)))]
            assert np.abs(slope(level)) < 2e-3 * steepest
            assert np.abs(slope.deriv()(level)) * (a[-1] - a[0]) < 0.1 * steepest
            assert fit(level) == pytest.approx(eps, rel=1e-5)
        else:
            counts.append(int((np.diff(np.sign(slope(inside))) != 0).sum()))
    assert counts == [2, 0]


def test_a_simulation_leads_to_the_state_beyond_the_fold(model):
    p = model.vector({"V": V, "W0": W0, "f": 3.3, "eps": 0.0034})
    edges = uniform_mesh(64)
    before = robust_orbits(model, p[:, None] * 1.0, None, edges)
    below = p.copy()
    below[model.index("eps")] = 0.0028
    stable = robust_orbits(model, below[:, None], None, edges)
    assert stable.converged[0] and not before.converged[0]
    guess = integrate_to_periodic_state(model, p, stable.orbit.x[0, 0], edges)
    beyond = solve_orbits(model, p[:, None], guess)
    assert beyond.converged[0] and np.abs(beyond.multipliers[0]).max() < 1
    v = np.exp(beyond.orbit.x[0][:, model.states.index("ln_v")])
    assert (v.min(), v.max()) == (pytest.approx(1.5, rel=0.05), pytest.approx(66, rel=0.05))
