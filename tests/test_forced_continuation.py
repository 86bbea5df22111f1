"""A rigid interface with inertia: its forced state is found by raising eps, and agrees with equations written by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from brute import Slider, friction
from click.testing import CliRunner
from scipy.integrate import solve_ivp

from srfcli.cli.main import cli
from srfcli.numerics.collocation import mesh_error
from srfcli.numerics.critical import critical_line
from srfcli.numerics.floquet import solve_floquet
from srfcli.numerics.orbit import climbed, forced_guess, robust_orbits, solve_orbits, uniform_mesh

EPS, V = 0.18, 8.0


@pytest.fixture(scope="module")
def rigid(make_model):
    return make_model(interface="rigid")


def rates(s: Slider, t: float, x: np.ndarray) -> list[float]:
    """M dv/dt = K u - W mu, the slider at the slip's own velocity; unknowns (u, ln v, ln phi)."""
    u, ln_v, ln_phi = x
    v, phi = math.exp(ln_v), math.exp(ln_phi)
    W = s.W0 * (1 + s.eps * math.cos(2 * math.pi * s.f * t))
    return [s.V - v, (s.K * u - W * friction(s, ln_v, phi)) / (s.M * v), 1 / phi - v / s.D0]


def carried(s: Slider, start: np.ndarray) -> np.ndarray:
    """Return the unknowns a period later."""
    motion = solve_ivp(lambda t, x: rates(s, t, x), (0, 1 / s.f), start, method="LSODA", rtol=1e-10, atol=1e-12)
    return motion.y[:, -1]


def shot(model, p, orbit):
    """Return what a period does to a state that srf found, and the leading multiplier by central differences about it."""
    assert model.states == ("u", "ln_v", "ln_phi")
    s = Slider(*(float(p[model.index(n)]) for n in ("V", "W0", "eps")))
    start = orbit.x[0]
    columns = []
    for i, h in enumerate((1e-4, 1e-3, 1e-4)):
        move = np.zeros(3)
        move[i] = h
        columns.append((carried(s, start + move) - carried(s, start - move)) / (2 * h))
    return carried(s, start) - start, np.abs(np.linalg.eigvals(np.array(columns).T)).max()


def test_the_state_and_its_multiplier_are_those_of_shooting(rigid):
    p = rigid.vector({"V": V, "W0": 6.0, "eps": EPS})
    found = solve_floquet(rigid, p, tol=1e-8)
    assert found.status.ok
    moved, leading = shot(rigid, p, found.orbit)
    assert np.abs(moved).max() < 1e-7
    assert abs(found.multipliers[0]) == pytest.approx(leading, rel=1e-6)


@pytest.mark.slow
def test_at_the_critical_load_the_multiplier_by_shooting_is_one(rigid):
    (point,) = critical_line(rigid, rigid.vector({"V": V, "eps": EPS}), lo=3.0, hi=60.0).points
    assert point.status.ok
    found = solve_floquet(rigid, point.p, tol=1e-8)
    moved, leading = shot(rigid, point.p, found.orbit)
    assert np.abs(moved).max() < 1e-7
    assert leading == pytest.approx(1.0, abs=2e-6)


def test_states_are_found_that_no_first_guess_leads_to(rigid):
    speeds, loads = np.meshgrid(np.geomspace(1, 30, 8), np.geomspace(3, 300, 12), indexing="ij")
    p = np.repeat(rigid.vector({"eps": EPS})[:, None], speeds.size, axis=1)
    p[rigid.index("V")], p[rigid.index("W0")] = speeds.ravel(), loads.ravel()
    edges = uniform_mesh(64)
    assert solve_orbits(rigid, p, forced_guess(rigid, p, edges)).converged.mean() < 0.2
    assert robust_orbits(rigid, p, None, edges).converged.mean() > 0.95


def test_a_state_on_a_mesh_that_is_too_coarse_is_not_taken(rigid):
    p = np.repeat(rigid.vector({"V": 1.0, "W0": 21.0, "eps": 0.6})[:, None], 2, axis=1)
    assert not climbed(rigid, p, uniform_mesh(24)).converged.any()
    found = climbed(rigid, p, uniform_mesh(256))
    assert found.converged.all() and (mesh_error(rigid, found.orbit) < 0.1).all()


def test_climbing_leads_where_a_good_guess_does(model):
    p = np.repeat(model.vector({"V": V, "W0": 9.0})[:, None], 3, axis=1)
    p[model.index("eps")] = 0.05, 0.2, 0.6
    edges = uniform_mesh(32)
    near, far = solve_orbits(model, p, forced_guess(model, p, edges)), climbed(model, p, edges, tol=1e-9)
    assert near.converged.all() and far.converged.all() and np.array_equal(far.p, p)
    assert np.abs(near.orbit.x - far.orbit.x).max() < 1e-8


def test_a_state_that_is_not_found_is_neither_stable_nor_unstable():
    run = CliRunner().invoke(cli, ["floquet", "--interface", "rigid", "--V", "8", "--W0", "6", "--eps", "0.8", "--json"])
    assert run.exit_code == 3
    told = json.loads(run.stdout)
    assert told["meta"]["stable"] is None and "no forced periodic state was found" in told["notes"][0]
