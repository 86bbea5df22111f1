"""The Hopf bifurcation of steady sliding: which way it opens, against simulated stick-slip of small amplitude."""

from __future__ import annotations

import numpy as np
import pytest

import srfcli as srf
from srfcli.core.errors import Status
from srfcli.motion.imposed import ConstantLoad, Drive
from srfcli.motion.simulate import simulate
from srfcli.numerics.hopf import critical_point, hopf_points, rest_state


def settled_swing(model, V: float, W0: float, Omega: float, swing: float) -> float:
    """Return the half swing of ln v of the oscillation that a simulation settles on, started near `swing`."""
    p = model.vector({"V": V, "W0": W0})
    x, A = rest_state(model, p)
    values, vectors = np.linalg.eig(A)
    q = vectors[:, np.argmin(np.abs(values - 1j * Omega))]
    i = model.states.index("ln_v")
    period = 2 * np.pi / Omega
    t = np.linspace(0.0, 160 * period, 160 * 40 + 1)
    start = x + (swing * q / q[i]).real
    trace = simulate(model, p, drive=Drive.constant(V), load=ConstantLoad(W0), t=t, start=start, rtol=1e-10)
    assert trace.status is Status.OK
    last = np.log(trace.v[-400:])
    return 0.5 * float(last.max() - last.min())


@pytest.mark.parametrize("V", [10.0, 60.0])
def test_the_lyapunov_coefficient_predicts_the_amplitude_of_small_stick_slip(model, V):
    """Near onset the half swing of ln v is 2 sqrt(-Re s/Re c); what higher orders add is linear in the distance."""
    point, status = critical_point(model, model.vector({"V": V}))
    assert status is Status.OK and point.supercritical
    errors = []
    for distance in (4e-3, 2e-3):
        growth = point.crossing_rate * distance * point.W0
        predicted = 2 * np.sqrt(growth / (-point.lyapunov * point.Omega))
        swing = settled_swing(model, V, point.W0 * (1 + distance), point.Omega, predicted)
        errors.append(swing / predicted - 1)
    assert abs(2 * errors[1] - errors[0]) < 0.02  # extrapolated to onset
    assert abs(errors[1]) < 0.1


def test_no_root_is_found_where_friction_strengthens(model):
    assert hopf_points(model, model.vector({"V": 300.0})) == []
    assert critical_point(model, model.vector({"V": 300.0}))[1] is Status.NO_HOPF


@pytest.mark.parametrize("law", ["two-state", "rice-regularized", "bowden-tabor"])
def test_hopf_points_are_imaginary_eigenvalues(make_model, law):
    model = make_model(law=law)
    point, _ = critical_point(model, model.vector({"V": 20.0}))
    eigenvalues = np.linalg.eigvals(rest_state(model, model.vector({"V": 20.0, "W0": point.W0}))[1])
    nearest = eigenvalues[np.argmin(np.abs(eigenvalues - 1j * point.Omega))]
    assert abs(nearest - 1j * point.Omega) < 1e-9 * point.Omega


def test_the_crossing_rate_is_the_slope_of_the_growth_rate(model):
    point, _ = critical_point(model, model.vector({"V": 20.0}))
    rates = []
    for sign in (-1, 1):
        p = model.vector({"V": 20.0, "W0": point.W0 * (1 + sign * 1e-5)})
        rates.append(np.linalg.eigvals(rest_state(model, p)[1]).real.max())
    assert (rates[1] - rates[0]) / (2e-5 * point.W0) == pytest.approx(point.crossing_rate, rel=1e-4)


@pytest.mark.parametrize("interface", ["elastic", "rigid"])
@pytest.mark.parametrize("inertia", [True, False])
def test_a_pore_pressure_adds_to_the_critical_load(interface, inertia):
    """Friction is that of the load less the pressure: W0 = pressure is a pole of the rates, and no Hopf point."""
    rig = {"interface": interface, "inertia": inertia, "V": 10.0}
    drained = srf.linear(srf.system(**rig), over={"V": [10.0]})
    wet = srf.linear(srf.system(**rig, effects=["pore-pressure"], pressure=0.8), over={"V": [10.0]})
    (one,), (other,) = drained.table.rows, wet.table.rows
    place = [c.name for c in drained.table.columns].index("W0")
    assert other[place] == pytest.approx(one[place] + 0.8, rel=1e-6)


def test_a_distorted_load_without_a_mass_is_the_limit_of_a_small_one():
    distorted = {"effects": ["load-distortion"], "amplitude": 0.2, "V": 10.0}
    loads = [srf.critical(srf.system(**distorted, inertia=False), V=10, eps=0.1)]
    loads.append(srf.critical(srf.system(**distorted, M=1e-3), V=10, eps=0.1))
    massless, light = (found.table.rows[0][[c.name for c in found.table.columns].index("W0")] for found in loads)
    assert massless == pytest.approx(light, rel=2e-5) != 8.0
