"""The compiled integrator against LSODA, its sensitivities against differences, and life without a compiler."""

from __future__ import annotations

import numpy as np
import pytest

from srfcli.errors import SrfError
from srfcli.numerics import compiled as compiled_module
from srfcli.numerics.compiled import compiled, compiler
from srfcli.numerics.load import ConstantLoad, Modulation
from srfcli.numerics.lsoda import integrate_lsoda
from srfcli.numerics.motion import integrate
from srfcli.numerics.program import Drive

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
    model = make_model(**names)
    ours, other = motion_of(model, "compiled", rtol=1e-9), motion_of(model, "lsoda", rtol=1e-11)
    assert ours.status.ok and other.status.ok
    scale = 1.0 + np.abs(other.x).max(axis=0)
    assert np.abs(ours.x - other.x).max(axis=0) == pytest.approx(0, abs=2e-6 * scale.max())
    assert np.ptp(other.x[:, -1]) > 0.01  # it moves


@needs_compiler
@pytest.mark.parametrize("names", SYSTEMS, ids=str)
@pytest.mark.parametrize("how", ["compiled", "lsoda"])
def test_sensitivities_are_those_of_differences(make_model, names, how):
    model = make_model(**names)
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
@pytest.mark.parametrize("damage", ["truncate", "flip", "no sum"])
def test_a_damaged_library_is_built_anew(model, monkeypatch, tmp_path, damage):
    monkeypatch.setenv("SRF_CACHE", str(tmp_path))
    compiled.cache_clear()
    assert compiled(model) is not None
    (path,) = tmp_path.glob("*.so")
    content = path.read_bytes()
    compiled.cache_clear()
    copy = tmp_path / "copy"  # the library in use is replaced, never written into
    copy.write_bytes(content[:100] if damage == "truncate" else bytes([content[0] ^ 1]) + content[1:])
    if damage == "no sum":
        path.with_suffix(".sum").unlink()
    else:
        copy.replace(path)
    assert compiled(model) is not None
    assert compiled_module._intact(path)
    compiled.cache_clear()
