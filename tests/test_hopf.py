"""The Hopf bifurcation of steady sliding: which way it opens, against simulated stick-slip of small amplitude."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import lambertw

import srfcli as srf
from srfcli.core.errors import SrfError, Status
from srfcli.motion.imposed import ConstantLoad, Drive
from srfcli.motion.simulate import simulate
from srfcli.numerics.hopf import critical_point, hopf_points, rest_state, weakening


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
    assert status is Status.OK and point.criticality == "supercritical"
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


RATES = {  # rate in x = v phi/D0, its parameters, and the same as a function
    "1 - n*(v*phi/D0)**2": ({"n": 0.5}, lambda x: 1 - 0.5 * x**2),
    "1 - n*(v*phi/D0) - m*(v*phi/D0)**2": ({"n": 0.3, "m": 0.9}, lambda x: 1 - 0.3 * x - 0.9 * x**2),
    "(v*phi/D0 - 1)*(2 - v*phi/D0)": ({}, lambda x: (x - 1) * (2 - x)),
}


@pytest.mark.parametrize("rate", RATES)
def test_steady_sliding_is_where_the_age_is_positive_and_attracts(tmp_path, rate):
    """The critical load of a rate with several roots, against eigenvalues of equations written by hand about the right one."""
    parameters, by_hand = RATES[rate]
    text = f'format = "srf-law/1"\nkind = "ageing"\nname = "own"\nrate = "{rate}"\n[parameters]\n'
    path = tmp_path / "own.toml"
    path.write_text(text + "".join(f"{name} = {{ default = {value} }}\n" for name, value in parameters.items()))
    system = srf.system(ageing=str(path))
    found = srf.linear(system, over={"V": [10.0]}).to_dataframe().iloc[0]
    assert found["status"] == "ok"
    A, B, D0, Vsat, lam, K, M, V = 0.0126, 0.0241, 0.402, 256.0, 0.56, 0.21, 2.37e-6, 10.0
    places = np.arange(3.0)
    root = max(np.roots(np.polyfit(places, by_hand(places), 2)))  # the larger of two positive ones attracts
    slope = (by_hand(root + 1e-6) - by_hand(root - 1e-6)) / 2e-6
    W0, c = float(found["W0"]), B * Vsat * root / (V + Vsat * root)
    phi_row = np.array([0.0, 0.0, 1.0, 1.0]) * slope * V / D0  # (ln phi)' by u, z, ln v, ln phi
    slip_row = (np.array([0.0, 1.0, -V, 0.0]) / lam - c * phi_row) / A  # of d(W0 mu/kappa)/dt = z - v
    J = np.array([[0, -1, 0, 0], [K / M, 0, -W0 * A / M, -W0 * c / M], slip_row, phi_row])
    leading = max(np.linalg.eigvals(J), key=lambda s: (s.real, s.imag))
    assert abs(leading.real) < 1e-6 * leading.imag
    assert leading.imag == pytest.approx(found["Omega_c"], rel=1e-8)
    assert found["Omega_rigid"] == pytest.approx(found["Omega_c"], rel=1e-8)  # with kappa ~ W the frequency is the rigid one's


def test_what_has_no_attracting_steady_state_is_refused(tmp_path):
    text = 'format = "srf-law/1"\nkind = "ageing"\nname = "own"\nrate = "{}"\n[parameters]\nc = {{ default = 0.5 }}\n'
    for rate, said in (
        ("-(v*phi/D0)*log(v*phi/D0) - c", "no steady state that attracts"),
        ("1 - c*(mu/mu0)*v*phi/D0", "depends on mu"),
        ("exp(-c*v*phi/D0) - sinh(v*phi/D0)", "no closed form"),
    ):
        path = tmp_path / "own.toml"
        path.write_text(text.format(rate))
        with pytest.raises(SrfError, match=said):
            srf.linear(srf.system(ageing=str(path)), over={"V": [10.0]})


@pytest.mark.parametrize("V", [0.003, 0.02, 1.0])
def test_weakening_counts_that_the_steady_age_is_not_proportional_to_one_over_V(make_model, V):
    """kato-tullis: -d mu_ss/d ln V = B (1 + (V/Vc) w/(1 + w)) - A in the limit Vsat phi >> D0, w = W(exp(-V/Vc))."""
    model = make_model(law="dieterich-ruina", ageing="kato-tullis")
    p = model.vector({"V": V})
    A, B, Vc = (p[model.index(n)] for n in ("A", "B", "Vc"))
    w = lambertw(np.exp(-V / Vc)).real
    assert weakening(model, p) == pytest.approx(B * (1 + (V / Vc) * w / (1 + w)) - A, rel=1e-9)


def test_an_age_that_depends_on_the_load_is_at_rest_under_the_mean_load(tmp_path):
    """Under an inclined spring W = W0 + K (u - u_ss) tan(angle), u_ss under W0: W follows the imposed load one to one."""
    path = tmp_path / "own.toml"
    path.write_text(
        'format = "srf-law/1"\nkind = "ageing"\nname = "own"\nrate = "(W/Wref)**q - v*phi/D0"\n'
        '[parameters]\nq = { default = 0.5 }\nWref = { default = 10.0, unit = "N" }\n'
    )
    model = srf.system(ageing=str(path), loading="inclined").model
    p = model.vector({"V": 10.0, "W0": 5.0})
    x = np.asarray(model.steady(p))
    assert x[model.states.index("ln_phi")] == pytest.approx(np.log(0.402 * 0.5**0.5 / 10.0), rel=1e-12)
    assert model.load(x, 10.0, 5.5, 0.0, p) - model.load(x, 10.0, 5.0, 0.0, p) == pytest.approx(0.5, rel=1e-12)
    assert np.abs(model.rates(x, 10.0, 5.0, 0.0, p)).max() < 1e-9
    flat = srf.linear(srf.system(ageing=str(path)), over={"V": [10.0]}).to_dataframe().iloc[0]
    assert flat["W0"] == pytest.approx(7.888035439563494, rel=1e-9)


def test_a_root_has_a_value_where_a_parameter_of_the_rate_is_0(tmp_path):
    """1 - x + n (1 - x)^2 has x = 1 at n = 0, where the usual form of a quadratic's root is 0/0; so with - c phi beside."""
    path = tmp_path / "own.toml"
    path.write_text(
        'format = "srf-law/1"\nkind = "ageing"\nname = "own"\nrate = "1 - v*phi/D0 - c*phi + n*(1 - v*phi/D0)**2"\n'
        '[parameters]\nn = { default = 0.1 }\nc = { default = 0.1, unit = "1/s" }\n'
    )
    model = srf.system(ageing=str(path), interface="rigid", inertia=False).model
    at = model.states.index("ln_phi")
    for n, c in ((0.0, 0.0), (0.0, 2.0), (0.1, 2.0)):
        x = np.exp(model.steady(model.vector({"V": 10.0, "n": n, "c": c}))[at]) * 10.0 / 0.402
        assert 1 - x - c * x * 0.402 / 10.0 + n * (1 - x) ** 2 == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize(("ageing", "with_mass"), [("dieterich", "subcritical"), ("ruina", "supercritical")])
def test_without_mass_and_compliance_the_classical_laws_are_degenerate(make_model, ageing, with_mass):
    """At third order neither law tells then whether stick-slip grows from zero amplitude; what is left is rounding."""
    for inertia, said in ((False, "degenerate"), (True, with_mass)):
        model = make_model(law="dieterich-ruina", ageing=ageing, interface="rigid", inertia=inertia)
        points = [hopf_points(model, model.vector({"V": V}))[0] for V in (1.0, 3.0, 10.0, 30.0)]
        assert {q.criticality for q in points} == {said}


def test_rounding_is_no_root_under_a_stiffness_that_is_a_power_of_the_load():
    """At small loads the mass swings on its spring, and the damping by friction is below rounding.

    For srf-vsat the Hopf points have one frequency, and loads with D0/(c W0) = 1/kappa + 1/(K - M Omega^2), c = -d mu_ss/d ln V.
    """
    loads, exponents = np.geomspace(1e-9, 1e7, 200), [0.5, 1.2, 1.5, 2.0]
    found = srf.linear(srf.system(interface="power"), over={"V": [10.0, 300.0], "n": exponents}, all_roots=True).to_dataframe()
    A, B, D0, Vsat, K, M, kappa0, Wref, V = 0.0126, 0.0241, 0.402, 256.0, 0.21, 2.37e-6, 17.8571428571429, 10.0, 10.0
    c = B * Vsat / (V + Vsat) - A
    Omega = V / D0 * np.sqrt(c / A)
    for n in exponents:

        def excess(W0, n=n):
            return D0 / (c * W0) - 1 / (kappa0 * (W0 / Wref) ** n) - 1 / (K - M * Omega**2)

        wanted = [brentq(excess, a, b, xtol=1e-24) for a, b in pairwise(loads) if excess(a) * excess(b) < 0]
        rows = found[(found["V"] == V) & (found["n"] == n)]
        assert len(wanted) == (2 if n > 1 else 1)  # down to 7e-9 N: small loads that are roots stay
        np.testing.assert_allclose(rows["W0"].astype(float), wanted, rtol=1e-9)
        np.testing.assert_allclose(rows["Omega_c"].astype(float), Omega, rtol=1e-9)
        assert list(rows["crossing_rate"] > 0) == [False, True][-len(wanted) :]
    assert set(found[found["V"] == 300.0]["status"]) == {"velocity strengthening: no Hopf"}
