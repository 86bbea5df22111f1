"""The fit of critical loads: exact derivatives, matching by the nearest odd crossing, both minimisers, tables and the command."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from threshold_tables import generated, with_noise

from srfcli.cli.main import cli
from srfcli.core.errors import SrfError, Status
from srfcli.core.settings import Parameter
from srfcli.data.thresholds import read_thresholds, thresholds, thresholds_csv
from srfcli.inference.free_parameters import FreeParameter, Scale, free_parameters, with_transmission
from srfcli.inference.profile import interval_end
from srfcli.inference.thresholds import FAR_CROSSING, Matcher, fit_thresholds, forced_slopes, hopf_slopes, uncertainty
from srfcli.numerics.boundary import along, polish
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import hopf_points

TRIAL = {"A": 0.012, "B": 0.023, "D0": 0.40, "Vsat": 280.0, "lambda": 0.62, "rho": 0.48}  # the paper's Table I
OPTIMISED = {"A": 0.0126, "B": 0.0241, "D0": 0.402, "Vsat": 256.0, "lambda": 0.56, "rho": 0.43}
SMALL_V = np.array([1.0, 10.0, 50.0, 1.0, 10.0, 50.0, 5.0])
SMALL_EPS = np.array([0.0, 0.0, 0.0, 0.09, 0.09, 0.045, 0.13]) / 0.43


@pytest.fixture(scope="module")
def small(model: Any) -> Any:
    """Seven critical loads of the optimised set, without noise."""
    return generated(model, SMALL_V, SMALL_EPS, values={**model.defaults(), **OPTIMISED})


def scale_of(model: Any, names: tuple[str, ...], start: dict[str, float], **more: Any) -> Scale:
    return free_parameters(with_transmission(model.parameters), names, start=start, largest_eps=0.303, **more)


def start_of(model: Any, **changed: float) -> dict[str, float]:
    return {**model.defaults(), **OPTIMISED, **changed}


# derivatives


def moved_load(model: Any, point: Any, name: str, factor: float) -> float:
    """The load of the same crossing with one parameter changed, polished anew."""
    p = point.p.copy()
    p[model.index(name)] *= factor
    again = polish(model, p[:, None], point.orbit, np.array([point.rho]), along("W0", 1), tol=1e-10)[0]
    assert again.status is Status.OK
    return again.value(model, "W0")


FORCED = [
    ({}, {"V": 10.0, "eps": 0.045}, (6.0, 12.0), "ns"),
    ({}, {"V": 25.0, "eps": 0.13}, (12.0, 24.0), "ns"),  # three crossings
    ({}, {"V": 10.0, "eps": 0.18}, (9.0, 20.0), "ns"),
    ({}, {"V": 20.0, "f": 10.0, "eps": 0.2}, (2.5, 6.0), "pd"),
    ({}, {"V": 3.0, "f": 3.0, "eps": 0.4}, (2.5, 6.0), "pd"),
    ({"ageing": "ruina"}, {"V": 5.0, "eps": 0.09}, (4.0, 40.0), "ns"),
    ({"interface": "constant"}, {"V": 5.0, "eps": 0.09}, (4.0, 40.0), "ns"),
    ({"inertia": False}, {"V": 5.0, "eps": 0.09}, (4.0, 40.0), "ns"),
    ({"loading": "inclined"}, {"V": 5.0, "eps": 0.09}, (4.0, 40.0), "ns"),
]


@pytest.mark.parametrize(("system", "at", "window", "kind"), FORCED, ids=lambda v: str(v))
def test_slopes_are_those_of_the_polished_load(
    make_model: Any, system: dict[str, Any], at: dict[str, float], window: tuple[float, float], kind: str
) -> None:
    model = make_model(**system)
    lo, hi = window
    line = critical_line(model, model.vector(at), lo=lo, hi=hi, samples=60, tol=1e-10)
    points = [q for q in line.points if q.kind == kind]
    assert points
    names = tuple(n for n in model.names if n not in (("W0",) if kind == "ns" else ("W0", "mu0", "V0", "K", "Vsat")))
    slopes = forced_slopes(model, points, names)
    h = 1e-4
    for point, row in zip(points, slopes, strict=True):
        for name, slope in zip(names, row, strict=True):
            difference = (moved_load(model, point, name, 1 + h) - moved_load(model, point, name, 1 - h)) / (2 * h)
            relative = slope * point.p[model.index(name)]
            load = point.value(model, "W0")
            assert relative == pytest.approx(difference, rel=2e-5, abs=2e-6 * load), (name, load)


def test_slopes_against_brute_force(model: Any) -> None:
    from brute import Slider, error_of_load

    point = critical_line(model, model.vector({"V": 7.0, "eps": 0.13}), lo=8.0, hi=14.0, samples=30).points[0]
    slider = Slider(V=7.0, W0=point.value(model, "W0"), eps=0.13)
    slopes = forced_slopes(model, [point], ("A", "lambda"))[0]
    h = 1e-3
    for field_name, slope in (("A", slopes[0]), ("lam", slopes[1])):
        value = getattr(slider, field_name)
        over = [error_of_load(replace(slider, **{field_name: value * (1 + s)}), point.orbit.x[0, 0])[0] for s in (h, -h)]
        assert slope * value / slider.W0 == pytest.approx(-(over[0] - over[1]) / (2 * h), rel=1e-3)


@pytest.mark.parametrize("system", [{}, {"ageing": "kato-tullis"}, {"interface": "rigid"}, {"inertia": False}], ids=str)
def test_slopes_under_constant_load(make_model: Any, system: dict[str, Any]) -> None:
    model = make_model(**system)
    p = model.vector({"V": 5.0})
    point = hopf_points(model, p)[0]
    names = tuple(n for n in model.names if n != "W0")
    slopes = hopf_slopes(model, p, point, names)
    for name, slope in zip(names, slopes, strict=True):
        value, loads = p[model.index(name)], []
        for factor in (1 + 1e-5, 1 - 1e-5):
            q = p.copy()
            q[model.index(name)] *= factor
            loads.append(hopf_points(model, q)[0].W0)
        difference = (loads[0] - loads[1]) / 2e-5
        assert slope * value == pytest.approx(difference, rel=1e-6, abs=1e-7 * point.W0), name


def test_slopes_as_the_modulation_vanishes(model: Any) -> None:
    base = model.vector({"V": 10.0, "eps": 1e-5})
    point = critical_line(model, base, lo=7.0, hi=9.0, samples=10, tol=1e-9).points[0]
    rest = hopf_points(model, model.vector({"V": 10.0}))[0]
    names = ("A", "B", "D0", "Vsat", "lambda", "K", "M")
    expected = hopf_slopes(model, model.vector({"V": 10.0}), rest, names)
    assert forced_slopes(model, [point], names)[0] == pytest.approx(expected, rel=1e-4)


def test_the_jacobian_is_that_of_the_residuals(model: Any, small: Any) -> None:
    names = ("A", "Vsat", "lambda", "rho")
    scale = scale_of(model, names, start_of(model, **TRIAL))
    matcher = Matcher(model, small, values=start_of(model, **TRIAL), scale=scale, tol=1e-9)
    jacobian = matcher.jacobian(matcher.match(np.zeros(4)))
    for j in range(4):
        step = 1e-4 * np.eye(4)[j]
        difference = (matcher.match(step).residuals - matcher.match(-step).residuals) / 2e-4
        assert jacobian[:, j] == pytest.approx(difference, rel=1e-4, abs=1e-4)
    assert np.all(jacobian[:3, 2:][:, 1] == 0)  # rho does nothing where the table's eps is 0


# matching


def test_loads_are_the_references(model: Any, shared: Path) -> None:
    rows = np.genfromtxt(shared / "reference" / "boundary_points.csv", delimiter=",", names=True)[[0, 9, 22, 30, 40]]
    table = thresholds(rows["V_um_s"], rows["eps"], 1.03 * rows["W0c_N"])
    matcher = Matcher(model, table, values=model.defaults(), scale=scale_of(model, ("A",), start_of(model)), tol=1e-8)
    assert matcher.match(np.zeros(1)).loads == pytest.approx(rows["W0c_N"], rel=1e-7)


@pytest.mark.parametrize(
    ("datum", "expected", "rival"),
    [
        (15.5, 14.9418396, 20.9096245),
        (18.41, 20.9096245, 14.9418396),
        (17.8, 14.9418396, 20.9096245),
        (23.0, 20.9096245, 14.9418396),
    ],
)
def test_the_nearest_odd_crossing_counts(model: Any, datum: float, expected: float, rival: float) -> None:
    """At V = 25, eps = 0.13 there are crossings at 14.94, 18.41 (even) and 20.91 N."""
    table = thresholds([25.0], [0.13], [datum])
    matcher = Matcher(model, table, values=model.defaults(), scale=scale_of(model, ("A",), start_of(model)))
    match = matcher.match(np.zeros(1))
    assert match.loads[0] == pytest.approx(expected, rel=1e-6)
    assert match.rivals[0] == pytest.approx(rival, rel=1e-6)


def test_a_missing_crossing_counts_as_the_end_it_lies_beyond(model: Any) -> None:
    table = thresholds([10.0, 10.0, 10.0, 10.0], [0.0, 0.09, 0.0, 0.09], [8.0, 10.0, 100.0, 120.0])
    start = start_of(model, rho=1.0)
    names = ("A",)
    matcher = Matcher(model, table, values=start, scale=scale_of(model, names, start, bounds={"A": (0.001, 0.1)}))
    strengthening = np.array([np.log(0.03 / start["A"])])  # A above B: no loss of stability anywhere
    match = matcher.match(strengthening)
    assert match.missing.all() and match.loads == pytest.approx(FAR_CROSSING * table.W0c)
    assert np.isfinite(match.cost) and np.all(matcher.jacobian(match) == 0)
    back = matcher.match(np.zeros(1))
    assert back.missing.tolist() == [False, False, True, True]  # 8 and 11 N lie more than a factor 8 below 100 and 120
    assert back.loads[2:] == pytest.approx(table.W0c[2:] / FAR_CROSSING)
    assert back.loads[:2] == pytest.approx([7.8049735, 10.9852631], rel=1e-6)


def test_the_cost_does_not_depend_on_the_way(model: Any) -> None:
    """Where several crossings exist, following them to and fro ends at the same ones as a search from scratch."""
    V, eps = [50.0, 25.0, 10.0, 50.0, 7.0], [0.09, 0.13, 0.18, 0.13, 0.18]
    table = thresholds(V, eps, [23.6, 14.9, 11.1, 37.6, 10.5])
    start = start_of(model, rho=1.0)
    scale = scale_of(model, ("A", "B", "lambda"), start)
    walker = Matcher(model, table, values=start, scale=scale)
    rng = np.random.default_rng(5)
    for _ in range(4):
        y = rng.normal(size=3) * 0.05
        fresh = Matcher(model, table, values=start, scale=scale)
        assert walker.match(y).loads == pytest.approx(fresh.match(y).loads, rel=1e-4), y
    assert walker.surveys < 4 * len(V)  # it did follow


# fits


def test_the_optimised_set_is_recovered_from_the_trial_set(model: Any, small: Any) -> None:
    names = tuple(TRIAL)
    scale = scale_of(model, names, start_of(model, **TRIAL))
    fit = fit_thresholds(model, small, scale=scale, values=start_of(model, **TRIAL), methods=["least-squares"], tol=1e-8)
    found = fit.best
    assert fit.status is Status.OK and found.values == pytest.approx([OPTIMISED[n] for n in names], rel=1e-4)
    assert found.start_cost > 15 * found.cost and found.paper_cost[0] > 15 * found.paper_cost[1]
    assert found.evaluations <= 15 and found.trace.best[-1] == min(found.trace.cost)


def test_powell_finds_the_same_minimum(model: Any, small: Any) -> None:
    table = with_noise(small, 4)
    start = start_of(model, D0=0.37, **{"lambda": 0.62})
    scale = scale_of(model, ("D0", "lambda"), start)
    fit = fit_thresholds(model, table, scale=scale, values=start)
    powell, squares = fit.methods
    assert (powell.method, squares.method) == ("powell", "least-squares")
    assert powell.cost == pytest.approx(squares.cost, rel=1e-4)
    assert powell.values == pytest.approx(squares.values, rel=5e-3)
    assert squares.evaluations < powell.evaluations and powell.gradients == 0
    assert powell.cost < powell.start_cost
    assert powell.uncertainty.errors == pytest.approx(squares.uncertainty.errors, rel=0.05)


def test_errors_are_those_of_a_hand_made_information_matrix(model: Any) -> None:
    scale = Scale(tuple(FreeParameter(Parameter(n, 1.0), 2.0, 1e-3, 10.0) for n in "ab"))
    jacobian = np.array([[1.0, 2.0], [3.0, -1.0], [0.5, 0.5]])
    known = uncertainty(scale, np.zeros(2), jacobian)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    assert known.errors == pytest.approx(2.0 * np.sqrt(np.diag(covariance)))
    assert known.correlation[0, 1] == pytest.approx(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    assert known.eigenvalues == pytest.approx(np.linalg.eigvalsh(jacobian.T @ jacobian))
    fewer = uncertainty(scale, np.zeros(2), jacobian[:1])  # one datum for two parameters
    assert np.isinf(fewer.errors).all() and "not determined" in fewer.weakest


def test_what_cannot_be_told_is_said(model: Any, small: Any) -> None:
    """mu0 and V0 enter as mu0 - A ln V0; a bound that is met has no error; Vsat alone is known."""
    start = start_of(model, V0=2.0, Vsat=250.0, **{"lambda": 0.65})
    scale = scale_of(model, ("mu0", "V0", "Vsat", "lambda"), start, bounds={"lambda": (0.6, 1.0)})
    fit = fit_thresholds(model, small, scale=scale, values=start, methods=["least-squares"])
    known = fit.best.uncertainty
    assert known.flags[0].startswith("not identifiable") and known.flags[1].startswith("not identifiable")
    assert known.flags[2] == "" and np.isfinite(known.errors[2])
    assert known.flags[3] == "at its lower bound" and np.isnan(known.errors[3])
    assert "not determined at all" in known.weakest and "ln V0" in known.weakest


def test_an_interruption_keeps_the_best(model: Any, small: Any) -> None:
    start = start_of(model, **TRIAL)
    seen: list[float] = []

    def report(trace: Any) -> None:
        seen.append(trace.cost[-1])
        if len(seen) == 4:
            raise KeyboardInterrupt

    scale = scale_of(model, ("A", "lambda"), start)
    fit = fit_thresholds(model, small, scale=scale, values=start, report=report)
    assert fit.status is Status.INTERRUPTED and len(fit.methods) == 1
    assert fit.best.evaluations == 4 and fit.best.cost == min(seen) < seen[0]


def test_the_limit_of_evaluations_holds(model: Any, small: Any) -> None:
    start = start_of(model, **TRIAL)
    scale = scale_of(model, ("A", "lambda"), start)
    fit = fit_thresholds(model, small, scale=scale, values=start, max_evaluations=2)
    assert fit.status is Status.EVALUATIONS and [m.evaluations for m in fit.methods] == [2, 2]
    assert all(m.cost <= m.start_cost * (1 + 1e-6) for m in fit.methods)


def test_ambiguous_data_are_named(model: Any) -> None:
    table = thresholds([25.0, 10.0], [0.13, 0.09], [17.93, 11.0], sigma=[0.6, 0.3])
    start = start_of(model, rho=1.0)
    scale = scale_of(model, ("lambda",), start, bounds={"lambda": (0.559, 0.561)})
    fit = fit_thresholds(model, table, scale=scale, values=start, methods=["least-squares"])
    assert any("line 2 is ambiguous" in n and "20.89" in n and "14.93" in n for n in fit.best.notes)


@pytest.mark.parametrize(
    ("names", "more", "text"),
    [
        ((), {}, "no parameter is free"),
        (("A", "A"), {}, "named twice"),
        (("V",), {}, "cannot be fitted"),
        (("Vsta",), {}, "unknown parameter 'Vsta'"),
        (("A",), {"bounds": {"B": (0.01, 0.1)}}, "not free"),
        (("A",), {"bounds": {"A": (0.02, 0.1)}}, "not between its bounds 0.02 and 0.1"),
    ],
)
def test_what_cannot_be_freed(model: Any, names: tuple[str, ...], more: dict[str, Any], text: str) -> None:
    with pytest.raises(SrfError, match=text) as raised:
        scale_of(model, names, start_of(model), **more)
    assert raised.value.hint


def test_rho_keeps_eps_below_one(model: Any) -> None:
    (rho,) = scale_of(model, ("rho",), start_of(model))
    assert rho.upper * 0.303 < 1
    with pytest.raises(SrfError, match="7 critical loads for 8"):
        names = ("A", "B", "D0", "Vsat", "lambda", "rho", "K", "M")
        table = thresholds(SMALL_V, SMALL_EPS, np.full(7, 10.0))
        fit_thresholds(model, table, scale=scale_of(model, names, start_of(model)), values=start_of(model))


# tables


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "is empty"),
        ("V,eps,W0c\n", "no measurements"),
        ("V,eps\n1,0\n", "no column W0c"),
        ("V,eps,W0,sigma\n", "unknown column 'W0'"),
        ("V,V,eps,W0c\n", "two columns are called V"),
        ("V [N],eps,W0c\n1,0,8\n", "line 1: column V: 'N' is the wrong unit"),
        ("V [bogus9],eps,W0c\n1,0,8\n", "bogus9"),
        ("V,eps,W0c\n1,0,8\n\n# pause\n2,0\n", "line 5: 2 cells under 3 names"),
        ("V,eps,W0c\n1,0,eight\n", "line 2: W0c = 'eight'"),
        ("V,eps,W0c\n1,0,nan\n", "line 2: W0c = 'nan'"),
        ("V,eps,W0c\n1,0,1_0\n", "line 2: W0c = '1_0'"),
        ("V,eps,W0c\n0,0,8\n", "line 2: V = 0 um/s is not above 0"),
        ("V,eps,W0c\n1,0,-8\n", "line 2: W0c = -8"),
        ("V,eps,W0c\n1,9,8\n", "line 2: eps = 9 is not in"),
        ("V,eps,W0c,sigma\n1,0,8,0\n", "line 2: sigma = 0"),
        ('V,eps,W0c\n1,0,"8\n', "line 2: 1 cells"),
    ],
)
def test_bad_tables_are_refused_by_line(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "loads.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SrfError) as raised:
        read_thresholds(path)
    assert what in raised.value.message and raised.value.hint


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(SrfError, match="cannot be read") as raised:
        read_thresholds(tmp_path / "none.csv")
    assert raised.value.exit_code == 1
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00V")
    with pytest.raises(SrfError, match="UTF-8"):
        read_thresholds(tmp_path / "binary.csv")


def test_units_comments_and_assumed_errors(tmp_path: Path) -> None:
    path = tmp_path / "loads.csv"
    path.write_text("\ufeff# measured in June\nW0c (N);V [um/s];eps [%];sigma [%]\n8;10;9;5\n\n10;20;4.5;\n", encoding="utf-8")
    table = read_thresholds(path)
    assert table.V.tolist() == [10, 20] and table.eps == pytest.approx([0.09, 0.045]) and table.lines == (3, 5)
    assert table.sigma == pytest.approx([0.4, 0.3]) and "1 of 2 rows" in table.notes[0] and "3%" in table.notes[0]


def test_a_written_table_reads_back(tmp_path: Path, small: Any) -> None:
    path = tmp_path / "loads.csv"
    path.write_text(thresholds_csv(small), encoding="utf-8")
    again = read_thresholds(path)
    assert again.W0c.tolist() == small.W0c.tolist() and again.sigma.tolist() == small.sigma.tolist() and not again.notes


@settings(max_examples=150, deadline=None)
@given(st.one_of(st.text(max_size=80), st.text('V,epsW0c sigma[]%\n;\t"#12.e-_', max_size=60).map("V,eps,W0c\n".__add__)))
def test_no_text_crashes_the_reader(tmp_path_factory: Any, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.csv"
    path.write_text(text, encoding="utf-8", errors="replace", newline="")
    try:
        table = read_thresholds(path)
    except SrfError:
        return
    assert np.isfinite([table.V, table.eps, table.W0c, table.sigma]).all() and (table.sigma > 0).all()


# the command


@pytest.fixture
def fit_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """`srf fit` with the options that a table of critical loads takes, in an empty folder."""
    for name in [n for n in os.environ if n.startswith("SRF_") and n not in ("SRF_CACHE", "SRF_SHARED")]:
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)

    def invoke(*arguments: str) -> Any:
        return CliRunner().invoke(cli, ["fit", *arguments])

    return invoke


def test_the_command_writes_everything(fit_command: Any, small: Any, tmp_path: Path) -> None:
    Path("loads.csv").write_text(thresholds_csv(with_noise(small, 7)), encoding="utf-8")
    arguments = ["loads.csv", "--free", "D0,lambda", "--set", "rho=0.43", "--set", "lambda=0.62", "--method", "least-squares"]
    done = fit_command(*arguments, "--bounds", "D0=300:500 nm", "--plot", "cost.svg", "--out", "fit.json")
    assert done.exit_code == 0, done.output
    data = json.loads(Path("fit.json").read_text(encoding="utf-8"))
    assert data["schema"] == "srf.fit-thresholds/2" and data["status"] == "ok"
    rows = {r["parameter"]: r for r in data["rows"]}
    assert list(rows) == ["D0", "lambda"] and rows["lambda"]["start"] == 0.62
    assert (rows["D0"]["lower"], rows["D0"]["upper"]) == pytest.approx((0.3, 0.5))
    assert abs(rows["D0"]["value"] - 0.402) < 4 * rows["D0"]["stderr"]
    meta = data["meta"]
    assert len(meta["loads"]) == 7 and meta["loads"][0]["type"] == "hopf" and meta["loads"][3]["type"] == "ns"
    assert meta["methods"][0]["chi2"] < meta["methods"][0]["chi2_start"]
    best = [t["chi2"] for t in meta["trace"]]
    assert best == sorted(best, reverse=True) and best[-1] == pytest.approx(meta["methods"][0]["chi2"], rel=1e-3)
    assert "lambda" in data["parameters"] and "V" not in data["parameters"]
    assert Path("cost.svg").read_text(encoding="utf-8").count("<path") > 3
    text = fit_command(*arguments)
    for title in ("Methods", "Cost against evaluations", "Critical loads"):
        assert f"\n{title}\n" in text.stdout
    again = fit_command(*arguments)
    assert again.stdout == text.stdout  # nothing in it depends on the clock


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--free", "A", "--set", "V=3"), "V is set"),
        (("--free", "A", "--bounds", "A=3"), "not NAME=LOW:HIGH"),
        (("--free", "A", "--method", "newton"), "unknown method 'newton'"),
        ((), "no parameter is free"),
    ],
)
def test_misuse_of_the_command(fit_command: Any, arguments: tuple[str, ...], text: str) -> None:
    Path("loads.csv").write_text("V,eps,W0c\n1,0,7.2\n10,0.1,8.5\n", encoding="utf-8")
    done = fit_command("loads.csv", *arguments)
    assert done.exit_code == 2 and text in done.stderr and "\nTry: " in done.stderr


def test_exit_codes_of_unfinished_fits(fit_command: Any, small: Any, srf_ended_at: Any) -> None:
    Path("loads.csv").write_text(thresholds_csv(small), encoding="utf-8")
    arguments = ["loads.csv", "--free", "A,lambda", "--set", "rho=0.43", "--set", "A=0.0125", "--csv"]
    done = fit_command(*arguments, "--max-evaluations", "2")
    assert done.exit_code == 3 and "least-squares,lambda" in done.stdout and "raise --max-evaluations" in done.stderr
    code, out, _ = srf_ended_at("evaluation 3", "fit", *arguments)
    assert code == 130 and "powell,lambda" in out and "least-squares" not in out


# intervals


@pytest.mark.parametrize("error", [0.02, 0.3, 2.0])
def test_an_interval_ends_where_its_closed_form_does(error: float) -> None:
    """A measured exp(d): the deviance ((exp(d) - 1)/error)^2 is 3.84 at ln(1 + 1.96 error) and -ln(1 - 1.96 error)."""
    half = 1.959964 * error
    up = interval_end(lambda d: (np.expm1(d) / error) ** 2, error, 5.0)
    assert up == pytest.approx(np.log1p(half), rel=0.02)
    down = interval_end(lambda d: (np.expm1(-d) / error) ** 2, error, 5.0)
    assert down is None if half >= 1 else down == pytest.approx(-np.log1p(-half), rel=0.02)
    assert interval_end(lambda d: (np.expm1(d) / error) ** 2, error, 0.9 * np.log1p(half)) is None  # a bound comes first


def test_a_ridge_has_intervals_beyond_its_errors(fit_command: Any, model: Any) -> None:
    """A, B and D0 of five loads without modulation: ends hold by Nelder and Mead's method on the roots of the polynomial."""
    V = np.array([1.0, 5.0, 10.0, 50.0, 100.0])
    table = with_noise(generated(model, V, np.zeros(5), values=model.defaults()), 2)
    Path("loads.csv").write_text(thresholds_csv(table), encoding="utf-8")
    words = ("loads.csv", "--free", "A,B,D0", "--method", "least-squares")
    plain = json.loads(fit_command(*words, "--json").stdout)
    assert any("not quadratic within" in n and "of A, B, D0" in n and "--profile" in n for n in plain["notes"])
    done = fit_command(*words, "--profile", "--out", "fit.json")
    assert done.exit_code == 0, done.output
    data = json.loads(Path("fit.json").read_text(encoding="utf-8"))
    row = {r["parameter"]: r for r in data["rows"]}["D0"]
    assert row["high"] - row["value"] > 1.5 * 1.96 * row["stderr"] > 1.5 * (row["value"] - row["low"])
    assert any(
        "standard errors are too small" in n and "D0 2.1 times as far up" in n and "low and high" in n for n in data["notes"]
    )

    def chi2(part: Any, D0: float) -> float:
        found = [hopf_points(model, model.vector({"A": part[0], "B": part[1], "D0": D0, "V": v})) for v in V]
        loads = [q[0].W0 if q else 1e3 for q in found]
        return float((((loads - table.W0c) / table.sigma) ** 2).sum())

    best = np.array([r["value"] for r in data["rows"]])
    for end in (row["low"], row["high"]):
        start = best[:2] * (end / best[2]) ** np.array([0.5, 0.75])  # along the ridge
        refit = minimize(chi2, start, args=(end,), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-4, "maxiter": 2000})
        assert refit.fun - data["meta"]["methods"][0]["chi2"] == pytest.approx(3.84, abs=0.1)


@pytest.mark.parametrize("more", [(), ("--profile",)])
def test_intervals_are_errors_where_the_likelihood_is_quadratic(fit_command: Any, model: Any, more: tuple[str, ...]) -> None:
    table = generated(model, np.array([1.0, 10.0, 50.0, 100.0]), np.zeros(4), values=model.defaults(), relative=0.003)
    Path("loads.csv").write_text(thresholds_csv(table), encoding="utf-8")
    done = fit_command("loads.csv", "--free", "A,B", "--set", "A=0.0125", "--method", "least-squares", *more, "--json")
    data = json.loads(done.stdout)
    for row in data["rows"]:
        assert row["high"] - row["low"] == pytest.approx(2 * 1.96 * row["stderr"], rel=0.03)
    assert not any("quadratic" in n for n in data["notes"])
