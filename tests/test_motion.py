"""The compiled integrator against LSODA, its sensitivities against differences, and life without a compiler."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from srfcli.codegen.c_source import compiled, compiler
from srfcli.core.errors import SrfError, Status
from srfcli.motion.imposed import ConstantLoad, Drive, LoadSteps, Modulation
from srfcli.motion.integrators import integrate, integrate_lsoda

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler on this machine")
SYSTEMS = [
    {},
    {"interface": "rigid"},
    {"inertia": False},
    {"inertia": False, "interface": "rigid", "ageing": "ruina"},
    {"law": "log-log", "ageing": "dieterich+linker-dieterich"},
    {"law": "two-state"},
    {"ageing": "perrin-rice-zheng"},
    {"ageing": "nagata"},
]


def motion_of(model, how, *, rtol, by=(), S0=None, change=None):
    """Return the motion through a step down in velocity and the onset of a modulation."""
    p = model.vector({"V": 20.0, "W0": 6.0, **(change or {})})
    t = np.linspace(0.0, 0.4, 161)
    drive, load = Drive.steps([(0.0, 20.0), (0.1, 30.0)]), Modulation(6.0, 0.1, 120.0, 0.15)
    x0 = np.asarray(model.steady(model.vector({"V": 20.0, "W0": 6.0})))
    atol = rtol * np.array([20.0 if s == "z" else 1.0 for s in model.states])
    S0 = np.zeros((x0.size, len(by))) if S0 is None else S0
    if how == "lsoda":
        return integrate_lsoda(model, p, drive, load, t, x0, by, S0, rtol, atol)
    return integrate(model, p, drive=drive, load=load, t=t, start=x0, by=by, S0=S0, rtol=rtol, atol=atol)


@needs_compiler
@pytest.mark.parametrize("names", SYSTEMS, ids=str)
def test_compiled_motion_is_that_of_lsoda(make_model, names):
    model = make_model(**names, stability=False)
    ours, other = motion_of(model, "compiled", rtol=1e-9), motion_of(model, "lsoda", rtol=1e-11)
    assert ours.status.ok and other.status.ok
    scale = 1.0 + np.abs(other.x).max(axis=0)
    assert np.abs(ours.x - other.x).max(axis=0) == pytest.approx(0, abs=2e-6 * scale.max())
    assert np.ptp(other.x[:, -1]) > 0.01  # it moves


@needs_compiler
@pytest.mark.parametrize("names", SYSTEMS, ids=str)
@pytest.mark.parametrize("how", ["compiled", "lsoda"])
def test_sensitivities_are_those_of_differences(make_model, names, how):
    model = make_model(**names, stability=False)
    wanted = [n for n in ("mu0", "A", "D0", "lambda", "K") if n in model.names]
    by = [model.index(n) for n in wanted]
    found = motion_of(model, how, rtol=1e-8, by=by).S
    p = model.vector()
    for k, name in enumerate(wanted):
        step = 1e-4 * p[by[k]]
        sides = [motion_of(model, "compiled", rtol=1e-11, change={name: p[by[k]] + s * step}).x for s in (1, -1)]
        expected = (sides[0] - sides[1]) / (2 * step)
        assert np.abs(found[:, :, k] - expected).max() <= 2e-3 * np.abs(expected).max(), name
        assert np.abs(expected).max() > 0


@needs_compiler
def test_derivative_by_the_initial_state(model):
    p, t = model.vector({"V": 10.0, "W0": 5.0}), np.linspace(0, 0.2, 21)
    x0, atol = np.asarray(model.steady(p)), np.full(4, 1e-10)
    common = {"drive": Drive.constant(10.0), "load": ConstantLoad(5.0), "t": t, "rtol": 1e-10, "atol": atol}
    found = integrate(model, p, start=x0, by=[-1], S0=np.eye(4)[:, 3:], **common)
    moved = [integrate(model, p, start=x0 + s * 1e-5 * np.eye(4)[3], **common).x for s in (1, -1)]
    expected = (moved[0] - moved[1]) / 2e-5
    assert np.abs(found.S[:, :, 0] - expected).max(axis=0) == pytest.approx(0, abs=1e-3 * np.abs(expected).max())
    assert np.abs(found.S[:, 2, 0] - expected[:, 2]).max() < 2e-3 * np.abs(expected[:, 2]).max()


@needs_compiler
@pytest.mark.parametrize("rtol", [1e-5, 1e-7, 1e-9])
def test_error_follows_the_tolerance(model, rtol):
    exact = motion_of(model, "lsoda", rtol=1e-12).x
    found = motion_of(model, "compiled", rtol=rtol).x
    error = np.abs(found - exact)[:, 2].max()
    assert error < 300 * rtol + 1e-9


def moved(model, drive, load, t, *, rtol=1e-8, W0, how=integrate):
    """Return the motion of the model from steady sliding at 8 um/s under W0, all tolerances `rtol`."""
    p = model.vector({"V": 8.0, "W0": W0})
    x0, atol = np.asarray(model.steady(p)), np.full(len(model.states), rtol)
    if how is integrate_lsoda:
        return integrate_lsoda(model, p, drive, load, t, x0, (), np.zeros((x0.size, 0)), rtol, atol)
    return integrate(model, p, drive=drive, load=load, t=t, start=x0, rtol=rtol, atol=atol)


@needs_compiler
def test_a_smooth_modulation_takes_the_steps_of_order_eight(model):
    """Radau IIA takes 8000 steps for it, and errs by 1e-10 um."""
    p, t, load = model.vector({"V": 8.0, "W0": 9.0}), np.linspace(0.0, 0.2, 401), Modulation(9.0, 0.09, 120.0, 0.0)
    x0 = np.asarray(model.steady(p))
    by = [model.index(name) for name in ("mu0", "A", "D0")]
    found, fine = (
        integrate(model, p, drive=Drive.constant(8.0), load=load, t=t, start=x0, by=by, rtol=rtol, atol=np.full(4, rtol))
        for rtol in (1e-10, 1e-12)
    )
    assert found.steps < 3000
    assert np.abs(found.x - fine.x).max() < 1e-7
    assert np.abs(found.S - fine.S).max() < 1e-6 * np.abs(fine.S).max()
    alone = integrate(model, p, drive=Drive.constant(8.0), load=load, t=t, start=x0, rtol=1e-10, atol=np.full(4, 1e-10))
    assert np.abs(alone.x - fine.x).max() < 1e-7
    other = integrate_lsoda(model, p, Drive.constant(8.0), load, t, x0, by, np.zeros((4, 3)), 1e-10, np.full(4, 1e-10))
    assert np.abs(fine.S - other.S).max() < 1e-4 * np.abs(fine.S).max()


@needs_compiler
@pytest.mark.parametrize("rtol, error", [(1e-6, 0.05), (1e-8, 1e-3), (1e-10, 1e-4)])
def test_output_between_steps_holds_at_rest(make_model, rtol, error):
    """At 1e-9 um/s the rates are the noise of Newton's method times 1e12 / s: no slope to draw a curve by."""
    model, t, load = make_model(interface="rigid"), np.linspace(0.0, 0.12, 6001), Modulation(9.0, 0.5, 120.0, 0.0)
    expected = moved(model, Drive.constant(8.0), load, t, rtol=1e-11, W0=9.0, how=integrate_lsoda).x
    found = moved(model, Drive.constant(8.0), load, t, rtol=rtol, W0=9.0)
    assert found.status.ok
    assert expected[:, 1].min() < -18
    assert np.abs(found.x - expected)[:, 1].max() < error


@needs_compiler
def test_a_rigid_slider_pushed_back_comes_to_rest_and_slides_again(make_model):
    """v = a (t_0 - t) passes through a hundred decades in less time than t resolves; then the spring is filled."""
    model, t = make_model(interface="rigid"), np.linspace(0.0, 5.0, 5001)
    load = LoadSteps.sequence([(1, 5.0, 5.0), (4, 0.5, 0.5)], start=0.0, rise=0.01)
    found = moved(model, Drive.constant(8.0), load, t, W0=5.0)
    assert found.status.ok
    u, ln_v, ln_phi = found.x.T
    rest = ln_v < -100
    assert 0.5 < np.ptp(t[rest]) < 1.5
    # where the mass plays no part K u = W mu(v, phi): checked by the law as it stands in the paper
    p = dict(zip(model.names, model.vector({}), strict=True))
    settled = rest & (t > t[rest][0] + 0.01)
    mu = (
        p["mu0"] + p["A"] * (ln_v[settled] - np.log(p["V0"])) + p["B"] * np.log(1 + p["Vsat"] * np.exp(ln_phi[settled]) / p["D0"])
    )
    assert 0.5 * mu == pytest.approx(p["K"] * u[settled], rel=1e-6)
    assert np.diff(u[settled]) == pytest.approx(8.0 * 0.001, abs=2e-6)  # it does not move, the drive does
    assert found.x[-1] == pytest.approx(np.asarray(model.steady(model.vector({"V": 8.0, "W0": 0.5}))), abs=1e-6)


@needs_compiler
def test_no_step_of_the_clock_is_lost_in_short_steps(make_model):
    """Thousands of steps below the resolution of t must add up: the age grows by just the time that passes at rest."""
    model, t = make_model(interface="rigid"), np.linspace(0.0, 1.6, 1601)
    load = LoadSteps.sequence([(1, 5.0, 5.0), (1, 0.5, 0.5)], start=0.0, rise=0.01)
    found = moved(model, Drive.constant(8.0), load, t, W0=5.0)
    rest = found.x[:, 1] < -100
    assert rest.sum() > 300
    assert np.diff(np.exp(found.x[rest, 2])) == pytest.approx(0.001, rel=1e-5)


@needs_compiler
@pytest.mark.parametrize("names", [{}, {"inertia": False}, {"interface": "rigid"}], ids=str)
def test_age_that_collapses_after_a_long_hold(make_model, names):
    model = make_model(ageing="perrin-rice-zheng", stability=False, **names)
    t = np.concatenate([np.linspace(0.0, 1010.0, 102), np.linspace(1010.0, 1012.0, 2001)[1:], [1030.0]])
    found = moved(model, Drive.steps([(0, 8.0), (10, 0.0), (1010, 8.0)]), ConstantLoad(5.0), t, W0=5.0)
    assert found.status.ok
    assert found.x[101, -1] == pytest.approx(np.log(1000), abs=0.02)  # age in time while at rest
    assert found.x[:, -2].max() > 6  # it then slips in one event
    assert found.x[-1] == pytest.approx(np.asarray(model.steady(model.vector({"V": 8.0, "W0": 5.0}))), abs=1e-4)


@needs_compiler
@pytest.mark.parametrize("inertia", [True, False])
def test_what_the_equations_cannot_follow_is_said(make_model, inertia):
    """Friction that vanishes with v lets the slider turn, which ln v cannot; without inertia B > A runs away in finite time."""
    model, t = (
        make_model(law="rice-regularized", ageing="kato-tullis", interface="rigid", inertia=inertia, stability=False),
        np.linspace(0, 5, 501),
    )
    load = LoadSteps.sequence([(1, 9.0, 9.0), (4, 0.9, 0.9)], start=0.0, rise=0.01)
    found = moved(model, Drive.steps([(0, 8.0), (0.5, 20.0)]), load, t, W0=9.0)
    assert found.status is Status.INTEGRATION
    assert 0.5 < found.reached < 1.1 and found.steps < 20_000  # it gives up soon
    assert np.isfinite(found.x[t <= found.reached - 0.01]).all() and np.isnan(found.x[t > found.reached]).all()


LONG = """
import numpy as np
from srfcli.codegen.model import open_model
from srfcli.motion.imposed import Modulation
from srfcli.motion.integrators import integrate, integrate_lsoda
from srfcli.motion.imposed import Drive
from srfcli.laws.registry import load_registry

model = open_model(load_registry())
p = model.vector({"V": 8.0, "W0": 9.0})
def go(end):
    return integrate(model, p, drive=Drive.constant(8.0), load=Modulation(9.0, 0.1, 120.0, 0.0), t=np.array([0.0, end]),
                     start=np.asarray(model.steady(p)), rtol=1e-11, atol=np.full(4, 1e-11))
go(0.01)  # compiled from here on
try:
    print("begun", flush=True)
    go(300.0)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@needs_compiler
@pytest.mark.skipif(os.name == "nt", reason="no SIGINT for one process there")
def test_an_interruption_acts_within_compiled_code():
    process = subprocess.Popen([sys.executable, "-c", LONG], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        time.sleep(0.5)  # within the integration, which would take half a minute; on a busy machine perhaps before it
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "interrupted\n"
        assert process.wait(timeout=1200) == 0
    finally:
        process.kill()
        process.stdout.close()
        process.wait()


@needs_compiler
def test_other_threads_integrate_as_the_main_one_does(model):
    found = []
    worker = threading.Thread(target=lambda: found.append(motion_of(model, "compiled", rtol=1e-8).x))
    worker.start()
    worker.join()
    assert (found[0] == motion_of(model, "compiled", rtol=1e-8).x).all()


def test_without_a_compiler_lsoda_does_it(model, monkeypatch):
    compiled.cache_clear(), compiler.cache_clear()
    monkeypatch.setenv("SRF_CC", "")
    try:
        assert compiled(model) is None
        assert motion_of(model, "compiled", rtol=1e-8).x == pytest.approx(motion_of(model, "lsoda", rtol=1e-8).x, abs=0)
    finally:
        compiled.cache_clear(), compiler.cache_clear()


def test_a_compiler_that_fails_is_named(model, monkeypatch):
    compiled.cache_clear(), compiler.cache_clear()
    monkeypatch.setenv("SRF_CC", "false")
    try:
        with pytest.raises(SrfError, match="false cannot compile"):
            compiled(model)
    finally:
        compiled.cache_clear(), compiler.cache_clear()


@needs_compiler
def test_a_damaged_library_is_built_anew(model, monkeypatch, tmp_path):
    monkeypatch.setenv("SRF_CACHE", str(tmp_path))
    compiled.cache_clear()
    assert compiled(model) is not None
    (path,) = tmp_path.glob("*.so")
    whole, mark = path.read_bytes(), path.with_suffix(".sum").read_text()
    for damage in ("truncate", "flip", "no sum"):
        compiled.cache_clear()
        copy = tmp_path / "copy"  # the library in use is replaced, never written into
        copy.write_bytes(whole[:100] if damage == "truncate" else bytes([whole[0] ^ 1]) + whole[1:])
        if damage == "no sum":
            path.with_suffix(".sum").unlink()
        else:
            copy.replace(path)
        assert compiled(model) is not None
        # a compiler makes the same of the same text
        assert (path.read_bytes(), path.with_suffix(".sum").read_text()) == (whole, mark), damage
    compiled.cache_clear()
