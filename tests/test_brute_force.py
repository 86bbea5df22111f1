"""Collocation, Floquet theory and critical loads against brute force and published points."""

from __future__ import annotations

import csv
import itertools
from dataclasses import replace

import numpy as np
import pytest
from brute import Slider, error_of_load, hopf_load, jacobian, rates, shoot, steady
from scipy.integrate import solve_ivp

from srfcli.core.errors import Status
from srfcli.numerics.boundary import linearise_boundary
from srfcli.numerics.collocation import Discretisation, gauss
from srfcli.numerics.critical import critical_line
from srfcli.numerics.floquet import solve_floquet
from srfcli.numerics.hopf import critical_point
from srfcli.numerics.orbit import interpolate, solve_orbits, steady_guess, uniform_mesh


def loads(model, V, eps, *, lo=4.0, hi=400.0, tol=1e-9):
    return critical_line(model, model.vector({"V": V, "eps": eps}), lo=lo, hi=hi, tol=tol).points


def one_orbit(model, N=64, **values):
    p = model.vector(values)[:, None]
    batch = solve_orbits(model, p, steady_guess(model, p, uniform_mesh(N)), tol=1e-12)
    assert batch.converged.all()
    return p, batch


def same_pairs(a, b, tol):
    """Whether two sets of multipliers agree, whatever the order within a conjugate pair."""
    key = [sorted(np.asarray(m).tolist(), key=lambda r: (round(-abs(r), 9), r.imag)) for m in (a, b)]
    return np.allclose(key[0], key[1], rtol=0, atol=tol)


def test_rates_agree_with_the_paper_written_by_hand(model):
    s = Slider(8.0, 9.0, 0.18)
    p = model.vector({"V": s.V, "W0": s.W0, "eps": s.eps})
    x = steady(s) + np.array((0.3, -2.0, 0.7, -0.4))
    assert steady(s) == pytest.approx(model.steady(p), rel=1e-14)
    assert rates(s, 0.3 / s.f, *x) == pytest.approx(model.cycle(0.3, x, p) * s.f, rel=1e-12)
    assert jacobian(s, 0.3 / s.f, x[2], x[3]) == pytest.approx(model.cycle_jacobian(0.3, x, p) * s.f, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(("V", "f", "eps"), [(20.0, 10.0, 0.2), (3.0, 3.0, 0.4)])
def test_a_period_doubling_against_brute_force(model, V, f, eps):
    """At low forcing frequency stability is lost through a multiplier at -1."""
    values = model.vector({"V": V, "f": f, "eps": eps})
    (point,) = critical_line(model, values, lo=2.5, hi=6.0, tol=1e-9).points
    assert point.kind == "pd" and point.theta == pytest.approx(np.pi, abs=1e-12)
    orbit = shoot(replace(Slider(V, point.value(model, "W0"), eps), f=f), point.orbit.x[0, 0])
    nearest = orbit.multipliers[np.argmin(np.abs(orbit.multipliers + 1))]
    assert abs(nearest + 1) < 1e-6 * max(1.0, abs(point.slope))


RESOLVED = -22.0  # ln of the smallest product of multipliers that rounding in the monodromy matrix leaves six digits of
FAST = [(8.0, 0.045, 1), (28.0, 0.13, 3), (7.0, 0.18, 3)]
SLOW = [(1.0, 0.045, 1), (100.0, 0.045, 1), (2.0, 0.09, 1), (60.0, 0.09, 1), (25.0, 0.13, 3), (60.0, 0.13, 1),
        (2.0, 0.18, 3), (20.0, 0.18, 3), (50.0, 0.18, 3), (90.0, 0.18, 1)]  # fmt: skip


@pytest.mark.parametrize(("V", "eps", "count"), [*FAST, *(pytest.param(*row, marks=pytest.mark.slow) for row in SLOW)])
def test_critical_loads_against_brute_force(model, V, eps, count):
    """Every critical load at this V, to 1e-6, with theta and all multipliers."""
    points = loads(model, V, eps)
    assert len(points) == count
    for number, point in enumerate(points, 1):
        error, orbit = error_of_load(Slider(V, point.value(model, "W0"), eps), point.orbit.x[0, 0])
        assert abs(error) < 1e-6
        assert point.status is Status.OK
        assert (point.slope > 0) == (number % 2 == 1)
        assert point.theta == pytest.approx(abs(np.angle(orbit.multipliers[0])), abs=1e-6)
        assert point.orbit.x[0, 0] == pytest.approx(orbit.start, rel=1e-5, abs=1e-5)
        assert orbit.multipliers.size == 4 and max(np.abs(orbit.multipliers[2:])) == pytest.approx(point.others, abs=1e-6)


@pytest.mark.parametrize(("lo", "hi"), [(4.0, 400.0), (14.0, 16.0), (14.3, 15.8)])
def test_a_pair_of_crossings_just_before_a_fold(model, lo, hi):
    """Two loads 0.8 % apart, eight times the stated resolution, beside the fold of the small component at eps = 0.18."""
    V = 27.366627
    points = [q for q in loads(model, V, 0.18, lo=lo, hi=hi) if q.value(model, "W0") < 20.0]
    assert [round(q.value(model, "W0"), 3) for q in points] == [15.040, 15.162]
    for point in points:
        error, _ = error_of_load(Slider(V, point.value(model, "W0"), 0.18), point.orbit.x[0, 0], apart=1e-5)
        assert abs(error) < 1e-6


@pytest.mark.parametrize(("V", "W0", "eps"), [(8.0, 9.0, 0.09), (30.0, 20.0, 0.18)])
def test_multipliers_and_orbit_against_brute_force(model, V, W0, eps):
    _p, batch = one_orbit(model, V=V, W0=W0, eps=eps)
    orbit = shoot(Slider(V, W0, eps), batch.orbit.x[0, 0])
    assert batch.orbit.x[0, 0] == pytest.approx(orbit.start, rel=1e-7, abs=1e-7)
    assert same_pairs(batch.multipliers[0], orbit.multipliers, 2e-7)


@pytest.mark.parametrize(("V", "W0", "eps"), [(1.0, 7.0, 0.0), (8.0, 9.0, 0.09), (15.0, 10.0, 0.18), (12.0, 9.0, 0.13)])
def test_product_of_multipliers_is_the_integrated_trace(model, V, W0, eps):
    """Liouville: the determinant of the monodromy matrix is exp of the integral of the trace of the Jacobian."""
    p, batch = one_orbit(model, V=V, W0=W0, eps=eps)
    o = batch.orbit
    trace = np.trace(model.cycle_jacobian(o.phases, o.stages[0], p[:, 0]), axis1=-2, axis2=-1)
    integral = float(np.sum(trace * gauss().weights * o.steps[:, None]))
    assert integral > RESOLVED
    sign, log_determinant = np.linalg.slogdet(batch.monodromy[0])
    assert sign > 0
    assert log_determinant == pytest.approx(integral, abs=1e-6)
    orbit = shoot(Slider(V, W0, eps), o.x[0, 0])
    assert np.log(abs(np.prod(orbit.multipliers))) == pytest.approx(orbit.trace, abs=1e-6)
    assert orbit.trace == pytest.approx(integral, abs=1e-6)


@pytest.mark.parametrize("V", [1.0, 5.0, 8.0, 30.0, 100.0])
def test_small_modulation_leads_to_the_exact_hopf_load(model, V):
    """As eps goes to 0 the Floquet boundary tends to the Hopf load of eigenvalues, and so does the exact polynomial."""
    W0, Omega = hopf_load(Slider(V, 8.0, 0.0))
    hopf, status = critical_point(model, model.vector({"V": V}))
    assert status is Status.OK
    assert pytest.approx(W0, rel=1e-10) == hopf.W0
    assert hopf.Omega == pytest.approx(Omega, rel=1e-9)
    [point] = loads(model, V, 1e-6, hi=40.0, tol=1e-10)
    assert point.value(model, "W0") == pytest.approx(W0, rel=1e-8)
    assert point.theta == pytest.approx(Omega / 120.0, rel=1e-7)


def test_boundary_points_of_reference(model, shared):
    """Every published point to 1e-8, whichever of the crossings at its V it is."""
    with (shared / "reference" / "boundary_points.csv").open() as file:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]
    assert len(rows) > 40
    for row in rows:
        W0 = row["W0c_N"]
        points = loads(model, row["V_um_s"], row["eps"], lo=0.93 * W0, hi=1.07 * W0)
        nearest = min(points, key=lambda q: abs(q.value(model, "W0") / W0 - 1))
        assert nearest.value(model, "W0") == pytest.approx(W0, rel=1e-8), row
        assert nearest.theta == pytest.approx(row["theta_rad"], abs=1e-8), row


@pytest.mark.parametrize("how", ["compiled", "plain"])
def test_gradient_of_the_growth_against_finite_differences(model, how):
    """The growth row of a boundary: by the state at tau = 0, by V and by W0, against central differences at fixed stages.

    With the stages slaved to (x_0, q) the derivative along the orbit's own response is that of solved orbits.
    """
    names = ("V", "W0")
    p, batch = one_orbit(model, N=48, V=30.0, W0=16.0, eps=0.18)
    target = batch.multipliers[0, 0]
    target = target.real + 1j * abs(target.imag)
    single = Discretisation(batch.orbit.x[0], batch.orbit.stages[0], batch.orbit.edges)
    if how == "compiled":  # a batch, where there is a compiler
        linear = linearise_boundary(model, p, batch.orbit, names, np.array([target]))
        periodic, row = linear.periodic[0], linear.growth[0]
    else:
        linear = linearise_boundary(model, p[:, 0], single, names, np.asarray(target))
        periodic, row = linear.periodic, linear.growth
    n = len(model.states)
    response = np.linalg.solve(periodic[:, :n], -periodic[:, n + 1 :])
    predicted = row[:n] @ response + row[n + 1 :]
    for column, name in enumerate(names):
        h = 1e-5 * p[model.index(name), 0]
        values = []
        for sign in (1, -1):
            q = p.copy()
            q[model.index(name)] += sign * h
            moved = solve_orbits(model, q, batch.orbit, tol=1e-13)
            values.append(np.log(np.abs(moved.multipliers[0, 0])))
        assert predicted[column] == pytest.approx((values[0] - values[1]) / (2 * h), rel=2e-6)


def test_order_of_the_collocation(model):
    """Errors at mesh points and of the leading multiplier fall as N^-8."""
    _, fine = one_orbit(model, N=256, V=8.0, W0=9.0, eps=0.09)
    errors, spectral = [], []
    for N in (8, 16, 32):
        _, batch = one_orbit(model, N=N, V=8.0, W0=9.0, eps=0.09)
        errors.append(np.abs(batch.orbit.x[0] - fine.orbit.x[0, :: 256 // N])[:, 2:].max())
        spectral.append(abs(abs(batch.multipliers[0, 0]) - abs(fine.multipliers[0, 0])))
    rate = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert rate[-1] == pytest.approx(8.0, abs=1.0)
    assert np.log2(spectral[0] / spectral[1]) > 6.5


def test_interpolation_of_an_orbit(model):
    """On its own mesh an orbit is unchanged; on another it agrees with the orbit solved there."""
    _p, coarse = one_orbit(model, N=32, V=8.0, W0=9.0, eps=0.09)
    _, fine = one_orbit(model, N=48, V=8.0, W0=9.0, eps=0.09)
    same = interpolate(coarse.orbit, uniform_mesh(32))
    assert same.x == pytest.approx(coarse.orbit.x, abs=1e-12)
    assert same.stages == pytest.approx(coarse.orbit.stages, abs=1e-10)
    other = interpolate(coarse.orbit, uniform_mesh(48))
    assert other.x[..., 2:] == pytest.approx(fine.orbit.x[..., 2:], abs=1e-5)
    assert other.stages[..., 2:] == pytest.approx(fine.orbit.stages[..., 2:], abs=1e-5)
    assert np.allclose(other.x[:, 0], fine.orbit.x[:, 0], atol=1e-6)


def test_brute_force_finds_an_error_that_is_there():
    """The check itself: a load wrong by 1e-3 is reported as wrong by 1e-3."""
    s = Slider(8.0, 8.318175557644711 * 1.001, 0.045)
    error, _ = error_of_load(s, steady(replace(s, eps=0.0)))
    assert error == pytest.approx(1e-3, rel=0.05)


@pytest.mark.parametrize("eps", [0.8, pytest.param(0.95, marks=pytest.mark.slow)])
def test_a_state_of_slip_events_returns_by_integration(model, eps):
    """eps up to which velocities run over sixteen decades within a period: no uniform mesh leads there; Radau goes along."""
    s = Slider(V=10.0, W0=20.0, eps=eps, f=3.0)
    found = solve_floquet(model, model.vector({"V": s.V, "W0": s.W0, "eps": eps, "f": s.f}), max_mesh=4096)
    assert found.status is Status.OK and np.ptp(found.orbit.x[:, model.states.index("ln_v")]) > 37
    start = np.array([found.orbit.x[0, model.states.index(n)] for n in ("u", "z", "ln_v", "ln_phi")])
    period = solve_ivp(
        lambda t, y: rates(s, t, *y), (0.0, 1 / s.f), start, method="Radau", jac=lambda t, y: jacobian(s, t, y[2], y[3]),
        rtol=1e-6, atol=1e-8, dense_output=True,
    )  # fmt: skip
    assert period.success
    assert period.y[:, -1] == pytest.approx(start, rel=1e-4, abs=1e-4)
    t = np.concatenate([np.linspace(a, b, 20, endpoint=False) for a, b in itertools.pairwise(period.t)] + [period.t[-1:]])
    u, _, ln_v, ln_phi = period.sol(t)
    mu = s.mu0 + s.A * (ln_v - np.log(s.V0)) + s.B * np.log1p(s.Vsat * np.exp(ln_phi) / s.D0)
    assert found.mean_friction == pytest.approx(np.trapezoid(mu, t) * s.f, rel=1e-5)
    assert abs(found.u_harmonics[0]) == pytest.approx(np.trapezoid(u, t) * s.f, rel=1e-5)
