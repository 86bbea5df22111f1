"""The cubic coefficient of Neimark-Sacker bifurcations: its limit without modulation, and simulations beside a boundary."""

from __future__ import annotations

import numpy as np
import pytest

from srfcli.core.errors import Status
from srfcli.motion.imposed import Drive, Modulation
from srfcli.motion.simulate import simulate
from srfcli.numerics.collocation import Discretisation, condense
from srfcli.numerics.continuation import ContinuationSettings, find_components
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import critical_point
from srfcli.numerics.orbit import solve_orbits
from srfcli.numerics.plane import Axis, Plane
from srfcli.numerics.special_points import branch_coefficients, criticality_points, normal_form

LAWS = [{}, {"law": "log-log"}, {"ageing": "ruina"}, {"law": "two-state"}, {"interface": "rigid"}, {"inertia": False}]


def single(point):
    """Return a boundary point's orbit without the batch axis."""
    return Discretisation(point.orbit.x[0], point.orbit.stages[0], point.orbit.edges)


def crossing(model, number, **values):
    """Return the critical load of this number at V, eps."""
    lo, hi = (7.0, 60.0)
    return critical_line(model, model.vector(values), lo=lo, hi=hi, tol=1e-9, samples=96).points[number - 1]


@pytest.mark.parametrize("names", LAWS, ids=lambda n: "+".join(map(str, n.values())) or "paper")
@pytest.mark.parametrize("V", [3.0, 30.0])
def test_without_modulation_it_is_the_lyapunov_coefficient(make_model, names, V):
    """The period map of steady sliding is the flow over 1/f: d is Re(c)/f of the Hopf normal form, in the same unit."""
    model = make_model(**names)
    hopf, _ = critical_point(model, model.vector({"V": V}))
    eps = 1e-4
    line = critical_line(model, model.vector({"V": V, "eps": eps}), lo=0.98 * hopf.W0, hi=1.02 * hopf.W0, tol=1e-9, samples=12)
    [point] = line.points
    d = normal_form(model, point.p, single(point), point.rho)[0]
    assert d == pytest.approx(hopf.lyapunov * hopf.Omega / 120.0, rel=2e-3)


class Stroboscope:
    """Simulations seen once a period, as the amplitude |z| of the critical mode about the forced state."""

    def __init__(self, model, p, orbit, rho):
        self.model, self.p, self.rest = model, p, orbit.x[0]
        self.d, self.q = normal_form(model, p, orbit, rho)
        values, vectors = np.linalg.eig(condense(model, p, orbit).monodromy)
        left = np.linalg.inv(vectors)[int(np.argmin(np.abs(values - (rho.real + 1j * abs(rho.imag)))))]
        self.left = left / (left @ self.q)

    def amplitudes(self, size, periods):
        """Return |z| over so many periods from the amplitude `size`."""
        V, W0, eps, f = (float(self.p[self.model.index(n)]) for n in ("V", "W0", "eps", "f"))
        trace = simulate(
            self.model,
            self.p,
            drive=Drive.constant(V),
            load=Modulation(W0, eps, f),
            t=np.arange(periods + 1) / f,
            start=self.rest + 2 * np.real(size * self.q),
            rtol=1e-10,
        )
        assert trace.status is Status.OK
        return np.abs((trace.x - self.rest) @ self.left)


@pytest.mark.parametrize(("V", "number", "sign"), [(8.0, 1, -1), (20.0, 3, -1), (8.0, 2, 1)])
def test_disturbances_on_the_boundary_grow_as_it_says(model, V, number, sign):
    """ln|z| gains d |z|^2 a period; from two amplitudes, so that what is left of g drops out."""
    point = crossing(model, number, V=V, eps=0.18)
    strobe = Stroboscope(model, point.p, single(point), point.rho)
    assert np.sign(strobe.d) == sign
    turn = round(2 * np.pi / point.theta)  # periods in which the mode goes round once
    rates, squares = [], []
    for size in (0.05, 0.1):
        z = strobe.amplitudes(size, 12 * turn)
        early, late = z[turn : 2 * turn], z[-turn:]
        rates.append((np.log(late).mean() - np.log(early).mean()) / (10 * turn))
        squares.append(float((z[turn:] ** 2).mean()))
    assert (rates[1] - rates[0]) / (squares[1] - squares[0]) == pytest.approx(strobe.d, rel=0.08)


def test_a_torus_of_the_predicted_amplitude_attracts_beyond_a_direct_boundary(model):
    point = crossing(model, 1, V=20.0, eps=0.18)
    p, orbit = point.p.copy(), single(point)
    p[model.index("W0")] *= 1 + 2e-3 / point.slope  # g = 2e-3 beyond
    whole = Discretisation(orbit.x[None], orbit.stages[None], orbit.edges)
    beyond = solve_orbits(model, p[:, None], whole, tol=1e-10)
    g = float(np.log(np.abs(beyond.multipliers[0, 0])))
    assert g == pytest.approx(2e-3, rel=0.05)
    here = Discretisation(beyond.orbit.x[0], beyond.orbit.stages[0], orbit.edges)
    strobe = Stroboscope(model, p, here, complex(beyond.multipliers[0, 0]))
    predicted = np.sqrt(g / -strobe.d)
    for size in (0.6, 1.4):
        z = strobe.amplitudes(size * predicted, 900)
        assert np.sqrt((z[-200:] ** 2).mean()) == pytest.approx(predicted, rel=0.08)


def test_criticality_changes_where_the_coefficient_vanishes(model):
    plane = Plane(model.vector({"eps": 0.18}), Axis("V", 5.0, 40.0), Axis("W0", 13.0, 17.0))
    *_, boundary = find_components(model, plane, ContinuationSettings(lines=5))
    found = []
    for branch in boundary.branches:
        d = branch_coefficients(model, branch)
        for mark in criticality_points(model, plane, branch, d):
            k = int(mark.place)
            assert d[k] * d[k + 1] < 0 and mark.status is Status.OK
            found.append(float(mark.p[model.index("V")]))
    assert min(abs(V - 11.634368) for V in found) < 1e-4  # a map of another grid finds it there, too


def test_a_real_multiplier_has_none(model):
    point = crossing(model, 1, V=8.0, eps=0.09)
    assert np.isnan(normal_form(model, point.p, single(point), complex(0.3))[0])
