"""Tables: against scipy's splines, in NumPy and in C, and as part of a motion with derivatives by their numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from srfcli.codegen.c_source import compiled, compiler
from srfcli.codegen.splines import Spline, appended, tables_after
from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.inference.prediction import predict
from srfcli.laws.registry import load_registry
from srfcli.motion.imposed import Drive, Modulation
from srfcli.motion.integrators import integrate, integrate_lsoda

needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler on this machine")
TABLES = (("mu", "slip"), ("mu", "time"), ("V", "stage"))


def knots(s: Spline) -> np.ndarray:
    return s.first + s.spacing * (np.arange(s.coefficients.size + 4) - 3)


def scipy_spline(s: Spline) -> BSpline:
    return BSpline(knots(s), s.coefficients, 3)


def some(seed: int = 1, *, first: float = -1.5, spacing: float = 0.7, n: int = 12) -> Spline:
    return Spline(first, spacing, np.random.default_rng(seed).standard_normal(n))


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_look_up_behind_parameters(order, which):
    """Tables behind three parameters: each is found, and its derivatives are scipy's."""
    tables = (some(2), some(3, first=10.0, spacing=2.0, n=7), some(4, n=4))
    p = appended(np.array([7.0, 8.0, 9.0]), tables)
    s, expected = tables[which], scipy_spline(tables[which])
    lut = tables_after(3)[order]
    x = np.linspace(s.first, s.last, 57)[1:-1]
    assert lut(p, which, x) == pytest.approx(expected(x, nu=order), abs=1e-12)
    assert [lut(p, which, v) for v in x.tolist()] == pytest.approx(expected(x, nu=order).tolist(), abs=1e-12)
    assert np.shape(lut(p, which, x.reshape(5, 11))) == (5, 11)


def test_beyond_its_knots_a_table_is_constant():
    s = some(4)
    lut, lut1, lut2 = tables_after(0)
    p = appended(np.zeros(0), (s,))
    beyond = np.array([s.first - 5.0, s.first - 1e-9, s.last + 1e-9, s.last + 100.0])
    ends = scipy_spline(s)(np.array([s.first, s.first, s.last, s.last]))
    assert lut(p, 0, beyond) == pytest.approx(ends, abs=1e-8)
    assert (lut1(p, 0, beyond) == 0).all() and (lut2(p, 0, beyond) == 0).all()


def test_at_no_number_a_table_is_none_and_its_neighbours_are_unharmed():
    s = some()
    p = appended(np.array([1.0, 2.0]), [s])
    for order, value in enumerate(tables_after(2)):
        one, other = value(p, 0, np.array([np.nan, 2.5]))
        assert np.isnan(one) and np.isnan(value(p, 0, np.nan))
        assert other == pytest.approx(scipy_spline(s).derivative(order)(2.5) if order else scipy_spline(s)(2.5))


def test_complex_steps_see_argument_and_numbers():
    s = some(5)
    p, step = appended(np.array([1.0]), (s,)), 1e-30
    lut, lut1, _ = tables_after(1)
    x = np.linspace(s.first + 0.1, s.last - 0.1, 31)
    assert np.imag(lut(p, 0, x + 1j * step)) / step == pytest.approx(lut1(p, 0, x), abs=1e-12)
    design = BSpline.design_matrix(x, knots(s), 3).toarray()
    for k in range(s.coefficients.size):
        q = p.astype(complex)
        q[int(p[1]) + k] += 1j * step
        assert np.imag(lut(q, 0, x)) / step == pytest.approx(design[:, k], abs=1e-14)


def test_no_numbers_no_table():
    for lut in tables_after(2):
        assert lut(np.array([1.0, 2.0]), 0, 0.3) == 0.0
        assert (lut(np.array([1.0, 2.0]), 0, np.arange(3.0)) == 0).all()


@settings(max_examples=60, deadline=None)
@given(st.floats(-50, 50), st.floats(1e-3, 40), st.floats(1e-2, 5))
def test_knots_cover_what_is_asked_for(low, width, spacing):
    s = Spline.over(low, low + width, spacing)
    assert s.first == low and s.last == pytest.approx(low + width, rel=1e-12, abs=1e-12)
    assert s.spacing <= spacing * (1 + 1e-12)
    assert s.coefficients.size == round((s.last - s.first) / s.spacing) + 3 and not s.coefficients.any()
    peak = s.nodes[1]  # where its own bump is highest, at the first knot
    assert peak == pytest.approx(s.first)
    assert BSpline.design_matrix(np.array([peak]), knots(s), 3).toarray()[0].argmax() == 1
    line = s.with_coefficients(2.0 + 3.0 * s.nodes)  # a spline whose numbers lie on a line is that line
    x = np.linspace(s.first, s.last, 17)[1:-1]
    assert scipy_spline(line)(x) == pytest.approx(2 + 3 * x, rel=1e-9, abs=1e-9)


# ---- in a motion


def motion(make_model, tables, *, how="compiled", by_tables=(), by=(), rtol=1e-9, end=0.5):
    model = make_model(tables=TABLES)
    p = model.vector({"V": 20.0, "W0": 6.0})
    t = np.linspace(0.0, end, 101)
    drive, load = Drive.steps([(0.0, 20.0), (0.2, 30.0)]), Modulation(6.0, 0.1, 120.0, 0.25)
    start = np.asarray(model.steady(appended(p, tables)))
    count = len(by) + sum(tables[i].coefficients.size for i in by_tables)
    S0 = np.zeros((start.size, count))
    columns = [
        *by,
        *(int(appended(p, tables)[len(p) + 4 * i]) + j for i in by_tables for j in range(tables[i].coefficients.size)),
    ]
    for k, place in enumerate(columns):
        q = appended(p, tables).astype(complex)
        q[place] += 1e-30j
        S0[:, k] = np.asarray(model.steady(q)).imag / 1e-30
    atol = rtol * np.array([20.0 if s == "z" else 1.0 for s in model.states])
    if how == "lsoda":
        return integrate_lsoda(model, appended(p, tables), drive, load, t, start, by, S0[:, : len(by)], rtol, atol)
    return integrate(
        model, p, drive=drive, load=load, t=t, start=start, by=by, S0=S0, tables=tables, by_tables=by_tables, rtol=rtol, atol=atol
    )  # fmt: skip


def tables_for(size: float = 1.0) -> tuple[Spline, ...]:
    """A rough track, a drift and a stage that ripples: each over a part of what the run covers."""
    shapes = (Spline.over(0.0, 8.0, 1.0), Spline.over(0.1, 0.4, 0.05), Spline.over(-1.0, 15.0, 2.0))
    rng = np.random.default_rng(6)
    return tuple(
        s.with_coefficients(size * w * rng.standard_normal(s.coefficients.size))
        for s, w in zip(shapes, (2e-3, 2e-3, 0.05), strict=True)
    )


@needs_compiler
def test_compiled_tables_are_those_of_lsoda(make_model):
    tables = tables_for()
    common = {"by": (2, 6), "end": 0.15}
    ours, other = motion(make_model, tables, **common), motion(make_model, tables, how="lsoda", **common)
    assert ours.status.ok and other.status.ok
    assert np.abs(ours.x - other.x).max() < 1e-5
    assert np.abs(ours.S - other.S).max(axis=(0, 1)) == pytest.approx(0.0, abs=2e-3 * np.abs(other.S).max())
    flat = motion(make_model, tables_for(0.0), end=0.3)
    assert np.abs(ours.x - flat.x)[:, 0].max() > 0.02  # they show


@needs_compiler
def test_flat_tables_and_none_are_the_plain_model(make_model):
    plain = make_model()
    p = plain.vector({"V": 20.0, "W0": 6.0})
    t, atol = np.linspace(0.0, 0.5, 101), np.array([1e-9, 2e-8, 1e-9, 1e-9])
    drive, load = Drive.steps([(0.0, 20.0), (0.2, 30.0)]), Modulation(6.0, 0.1, 120.0, 0.25)
    expected = integrate(plain, p, drive=drive, load=load, t=t, start=np.asarray(plain.steady(p)), rtol=1e-9, atol=atol).x
    none = tuple(Spline(0.0, 1.0, np.zeros(0)) for _ in TABLES)
    for tables in (tables_for(0.0), none):
        assert np.abs(motion(make_model, tables).x[:, :4] - expected).max() < 1e-6


@needs_compiler
@pytest.mark.parametrize("table", range(3), ids=["track", "drift", "stage"])
def test_derivatives_by_a_table_s_numbers(make_model, table):
    tables = tables_for()
    found = motion(make_model, tables, by=(2,), by_tables=(table,), rtol=1e-8).S
    count = tables[table].coefficients.size
    assert found.shape[2] == 1 + count
    step, largest = (1e-4, 1e-4, 1e-3)[table], 0.0
    for k in range(count):
        sides = []
        for sign in (1, -1):
            numbers = tables[table].coefficients.copy()
            numbers[k] += sign * step
            moved = [s.with_coefficients(numbers) if i == table else s for i, s in enumerate(tables)]
            sides.append(motion(make_model, moved, rtol=1e-11).x)
        expected = (sides[0] - sides[1]) / (2 * step)
        scale = np.abs(expected[:, 0]).max()
        largest = max(largest, scale)
        assert np.abs(found[:, 0, 1 + k] - expected[:, 0]).max() <= 5e-3 * scale + 1e-6, k
    assert largest > 0.1


@needs_compiler
def test_derivatives_by_all_tables_stand_in_order(make_model):
    tables = tables_for()
    whole = motion(make_model, tables, by_tables=(0, 1, 2)).S
    at = 0
    for i, s in enumerate(tables):
        own = motion(make_model, tables, by_tables=(i,)).S
        n = s.coefficients.size
        assert np.abs(whole[:, :, at : at + n] - own).max() <= 1e-3 * np.abs(own).max()
        at += n
    assert at == whole.shape[2]


def test_without_a_compiler_lsoda_has_tables_too(make_model, monkeypatch):
    tables = tables_for()
    compiled.cache_clear(), compiler.cache_clear()
    monkeypatch.setenv("SRF_CC", "")
    try:
        rough = {"rtol": 1e-6, "end": 0.3}
        found = motion(make_model, tables, **rough).x
        assert found == pytest.approx(motion(make_model, tables, how="lsoda", **rough).x, abs=0)
        with pytest.raises(SrfError, match="need a C compiler"):
            motion(make_model, tables, by_tables=(0,))
    finally:
        compiled.cache_clear(), compiler.cache_clear()


@needs_compiler
def test_a_prediction_has_columns_for_numbers_after_those_of_parameters(shared, make_model):
    experiment = read_experiment(shared / "cases" / "open-01", registry=load_registry())
    model = make_model(tables=(("mu", "slip"),))
    run = next(r for r in experiment.runs if r.name == "strong")
    run = run.part(slice(None, int(np.sum(run.t <= 0.9))))
    track = Spline.over(-1.0, 50.0, 5.0)
    track = track.with_coefficients(1e-3 * np.random.default_rng(2).standard_normal(track.coefficients.size))
    found = predict(model, experiment, run, {}, by=("mu0", "A"), tables=(track,), by_tables=(0,))
    assert found.J.shape == (found.y.size, 2 + track.coefficients.size)
    assert found.J[:, 2:].sum(axis=1) == pytest.approx(found.J[:, 0], rel=1e-3, abs=1e-3)  # all numbers together are mu0
