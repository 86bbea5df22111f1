"""The response to a modulated load: transfer functions and the mean friction, against simulation and forced states."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.core.errors import Status
from srfcli.motion.imposed import Drive, Modulation
from srfcli.motion.simulate import simulate
from srfcli.numerics.response import linear_response, mean_friction, resonance

SYSTEMS = [
    {},
    {"interface": "rigid"},
    {"inertia": False},
    {"interface": "rigid", "inertia": False},
    {"ageing": "dieterich+linker-dieterich"},
    {"loading": "inclined"},
    {"law": "two-state", "ageing": "ruina"},
]


def first_harmonic(values):
    """Return the complex amplitude at one cycle in the record."""
    return 2 * np.fft.fft(values)[1] / len(values)


@pytest.mark.parametrize("names", SYSTEMS, ids=lambda n: "+".join(map(str, n.values())) or "paper")
def test_the_linear_response_is_that_of_small_forced_states(make_model, names):
    """First harmonics of converged orbits at eps = 1e-4, which know nothing of linear theory."""
    from srfcli.numerics.floquet import solve_floquet, waveforms

    model = make_model(**names)
    for f in (7.0, 120.0):
        p = model.vector({"V": 10.0, "W0": 5.0, "f": f, "eps": 1e-4})
        found = linear_response(model, p)
        orbit = solve_floquet(model, p, tol=1e-10).orbit
        wave = waveforms(model, p, orbit, 64)
        ln_v = wave.x[:, model.states.index("ln_v")]
        for H, values in (
            (found.friction, wave.mu),
            (found.force, wave.mu * wave.W / 5.0),
            (found.position, -wave.u),
            (found.velocity, ln_v),
        ):
            assert first_harmonic(values) / 1e-4 == pytest.approx(complex(H), rel=2e-3, abs=2e-5)


def settled(model, f, eps, *, V=10.0, W0=6.0, periods=400, samples=64):
    """Return the last period of a simulation under a modulated load."""
    t = np.concatenate([[0.0], (periods - 1 + np.arange(samples) / samples) / f])
    load = Modulation(W0, eps, f)
    trace = simulate(model, model.vector(), drive=Drive.constant(V), load=load, t=t, rtol=1e-9)
    assert trace.status is Status.OK
    return trace


def test_a_load_point_that_moves_with_the_load_carries_the_slider(make_model):
    """The slider's position under `poisson-coupling` is its velocity, an unknown of its own, over i omega."""
    model = make_model(effects=("poisson-coupling",), stability=True)
    p = model.vector({"V": 10.0, "W0": 5.0, "f": 100.0, "shift": 0.05, "eps": 0.0})
    rest, n, by_eps = model.steady(p), len(model.states), model.cycle_parameter("eps")
    forcing = by_eps(0.0, rest, p) - 1j * by_eps(0.25, rest, p)
    z = np.linalg.solve(2j * np.pi * np.eye(n) - model.cycle_jacobian(0.0, rest, p), forcing)[model.states.index("z")]
    found = linear_response(model, p).position
    assert found == pytest.approx(z / (2j * np.pi * 100.0), rel=1e-9)
    assert abs(found) == pytest.approx(0.605103, rel=1e-5)  # of another's equations and solver


def test_the_linear_response_is_that_of_a_simulation(model):
    trace = settled(model, 120.0, 1e-3)
    found = linear_response(model, model.vector({"V": 10.0, "W0": 6.0, "f": 120.0}))
    position = 10.0 * trace.t - trace.u
    position = position - 10.0 * trace.t
    for H, values in ((found.friction, trace.mu), (found.position, position), (found.velocity, np.log(trace.v))):
        assert first_harmonic(values[1:]) / 1e-3 == pytest.approx(complex(H), rel=5e-3)


@pytest.mark.parametrize(("f", "eps"), [(120.0, 0.1), (120.0, 0.2), (40.0, 0.15)])
def test_the_mean_friction_is_that_of_a_simulation(model, f, eps):
    trace = settled(model, f, eps, samples=512)
    found = mean_friction(model, model.vector({"V": 10.0, "W0": 6.0, "f": np.array([f]), "eps": eps}))
    assert found.growth[0] < 0
    assert found.force[0] == pytest.approx(float((trace.mu * trace.W)[1:].mean()) / 6.0, rel=2e-6)
    assert found.friction[0] == pytest.approx(float(trace.mu[1:].mean()), rel=2e-6)


def test_the_drop_begins_with_the_square_of_the_amplitude(model):
    eps = np.array([1e-3, 2e-3, 4e-3])
    found = mean_friction(model, model.vector({"V": 10.0, "W0": 6.0, "eps": eps}), tol=1e-10)
    assert all(s is Status.OK for s in found.status)
    assert found.drop[1:] / found.drop[:-1] == pytest.approx(4.0, rel=2e-2)


def test_no_modulation_no_drop(model):
    found = mean_friction(model, model.vector({"V": np.array([2.0, 20.0]), "W0": 6.0, "eps": 0.0}))
    assert np.abs(found.drop).max() < 1e-9


def test_stability_of_steady_sliding_is_that_of_the_critical_load(model):
    from srfcli.numerics.hopf import critical_point

    point, _ = critical_point(model, model.vector({"V": 10.0}))
    loads = point.W0 * np.array([0.999, 1.001])
    assert linear_response(model, model.vector({"V": 10.0, "W0": loads})).stable.tolist() == [True, False]


def test_the_response_resonates_at_the_critical_frequency(model):
    """Just below the critical load the pair of roots is nearly imaginary: gain peaks at Omega_c/2 pi."""
    from srfcli.numerics.hopf import critical_point

    point, _ = critical_point(model, model.vector({"V": 10.0}))
    f = np.geomspace(1.0, 20.0, 4001)
    found = linear_response(model, model.vector({"V": 10.0, "W0": 0.9999 * point.W0, "f": f}))
    top = resonance(f, np.abs(found.velocity))
    assert top is not None and top[0] == pytest.approx(point.Omega / (2 * np.pi), rel=1e-3)


def test_a_maximum_on_the_edge_is_no_resonance():
    f = np.geomspace(1, 10, 20)
    assert resonance(f, f) is None
    peak = resonance(f, 3 - np.log(f / 3.3) ** 2)
    assert peak == pytest.approx((3.3, 3.0), rel=1e-9)


def run(*arguments):
    done = CliRunner().invoke(cli, ["response", *arguments])
    return done.exit_code, done.stdout, done.stderr


def test_the_command_prints_gains_phases_and_resonances():
    code, out, err = run("--V", "10", "--W0", "6", "--over", "f=1:400:90", "--csv")
    rows = list(csv.DictReader(io.StringIO(out)))
    assert code == 0 and len(rows) == 90
    assert {r["type"] for r in rows} == {"stable"}
    assert "resonance of velocity: " in err
    assert all(float(r["velocity_gain"]) > 0 and abs(float(r["force_phase"])) <= np.pi for r in rows)


def test_the_command_prints_mean_friction():
    code, out, _ = run("--V", "10", "--W0", "6", "--mean", "--eps", "0.05,0.1", "--over", "f=60,120", "--csv")
    rows = list(csv.DictReader(io.StringIO(out)))
    assert code == 0 and [r["eps"] for r in rows] == ["0.05", "0.05", "0.1", "0.1"]
    assert all(float(r["force_drop"]) > 0 for r in rows)
    assert all(float(r["force_drop"]) == pytest.approx(float(r["steady_force"]) - float(r["mean_force"])) for r in rows)


@pytest.mark.parametrize("mode", [(), ("--mean", "--eps", "0.05,0.1")])
def test_figures(tmp_path, mode):
    code, _, _ = run("--V", "10", "--W0", "6", "--over", "f=20:200:12", *mode, "--plot", str(tmp_path / "a.svg"))
    assert code == 0 and (tmp_path / "a.svg").stat().st_size > 5000


def test_every_axis_of_a_narrow_response_has_ticks_in_plain_numbers():
    from srfcli.results.figures import gains

    x = np.linspace(1.0, 1.4, 5)
    figure = gains(x, {"mu": 0.5 * np.exp(2.3j) * x**0.1, "x  [µm]": np.exp(2.2j) * x**0.05}, xlabel="f  [Hz]", logx=True)
    figure.canvas.draw()
    for axes in figure.axes:
        low, high = axes.get_ylim()
        ticks = zip(axes.get_yticks(), axes.get_yticklabels(), strict=True)
        seen = [label.get_text() for place, label in ticks if low <= place <= high]
        assert len(seen) > 1 and not any("10^" in text for text in seen)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--mean",), "--mean needs amplitudes"),
        (("--eps", "0.1"), "no part in the linear response"),
        (("--over", "V=1:10", "--V", "3"), "V is an axis and has a value"),
        (("--over", "V=1:10", "--over", "f=1:10"), "--over has 2 parameters"),
        (("--over", "eps=0,0.1"), "eps is not swept"),
        (("--over", "eps=0,0.1", "--mean", "--eps", "0.1"), "eps is not swept"),
    ],
)
def test_misuse_is_told(arguments, said):
    code, _, err = run(*arguments)
    assert code == 2 and said in err
