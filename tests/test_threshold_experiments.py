"""Critical loads under effects, and experiments that hold tables of critical loads."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.integrate import solve_ivp
from threshold_tables import generated, with_noise

import srfcli as srf
from srfcli.cli.main import cli
from srfcli.codegen.model import open_model
from srfcli.core.errors import SrfError
from srfcli.data.thresholds import Thresholds, thresholds_csv
from srfcli.data.writing import write_experiment
from srfcli.diagnosis.hypotheses import applicable
from srfcli.diagnosis.verdict import held_out_loads, holdout_rejection
from srfcli.inference.fit import fit_problem
from srfcli.inference.free_parameters import free_parameters, with_transmission
from srfcli.inference.state_space import Likelihood
from srfcli.inference.thresholds import Matcher, fit_thresholds, forced_slopes, hopf_slopes
from srfcli.laws.registry import load_registry
from srfcli.numerics.boundary import along, polish
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import critical_point, hopf_points

# critical loads under effects


def loads(model: Any, lo: float, hi: float, **values: float) -> np.ndarray:
    """All critical loads of a line."""
    points = critical_line(model, model.vector(values), lo=lo, hi=hi, samples=60, tol=1e-10).points
    return np.array([q.value(model, "W0") for q in points])


def with_effects(make_model: Any, *names: str, **laws: Any) -> Any:
    return make_model(effects=names, stability=True, **laws)


def lag(share: float, tau: float, f: float) -> complex:
    """What the asperities feel of a modulation of which a share comes through a lag of first order."""
    return 1 + share * (1 / (1 + 2j * math.pi * f * tau) - 1)


def servo(share: float, natural: float, damping: float, f: float) -> complex:
    """The same through a servo of second order."""
    w, s = 2 * math.pi * natural, 2j * math.pi * f
    return 1 + share * (w**2 / (s**2 + 2 * damping * w * s + w**2) - 1)


FELT = {  # effects that change the amplitude of a modulation, and its phase, which critical loads do not feel
    "load-transmission": ({"rho": 0.6}, 0.6),
    "load-lag": ({"share": 0.7, "lag_time": 2e-3}, abs(lag(0.7, 2e-3, 120.0))),
    "load-servo": ({"share": 1.0, "natural": 80.0, "damping": 0.5}, abs(servo(1.0, 80.0, 0.5, 120.0))),
}


@pytest.mark.parametrize("name", FELT)
def test_what_the_asperities_feel_of_a_modulation_is_another_amplitude(make_model: Any, model: Any, name: str) -> None:
    values, share = FELT[name]
    felt = with_effects(make_model, name)
    for V, eps, lo, hi in ((10.0, 0.09, 6.0, 20.0), (25.0, 0.13, 11.0, 24.0)):
        got = loads(felt, lo, hi, V=V, eps=eps / share, **values)
        assert got == pytest.approx(loads(model, lo, hi, V=V, eps=eps), rel=1e-8)
    assert got.size == 3


def test_a_pressure_moves_load_and_amplitude(make_model: Any, model: Any) -> None:
    pressed, p = with_effects(make_model, "pore-pressure"), 1.5
    (load,) = loads(model, 8.0, 12.0, V=8.0, eps=0.09)
    moved = loads(pressed, 9.0, 14.0, V=8.0, eps=0.09 * load / (load + p), pressure=p)
    assert moved == pytest.approx([load + p], rel=1e-8)
    still, pushed = (critical_point(m, m.vector(v))[0] for m, v in ((model, {"V": 8.0}), (pressed, {"V": 8.0, "pressure": p})))
    assert still is not None and pushed is not None
    assert abs(pushed.W0 - still.W0 - p) < 1e-11


LAWS = [  # effect, its values, the system whose law says the same, and its values
    ("linker-dieterich", {"alpha": 0.2}, {"ageing": "dieterich+linker-dieterich"}, {"alpha": 0.2}),
    ("viscous-drag", {"c": 4e-4}, {"law": "dragged"}, {"c": 4e-4}),
    ("stiffness-exponent", {"n": 0.5}, {"interface": "powered"}, {"n": 0.5}),
    ("second-state", {"B2": 0.004, "D2": 3.0}, {"law": "doubled"}, {"B2": 0.004, "D2": 3.0}),
]
DRAGGED = """
format = "srf-law/1"
kind = "friction"
name = "dragged"
mu = "mu0 + A*log(v/V0) + B*log(1 + Vsat*phi/D0){term}"
{states}
[parameters]
mu0 = {{ default = 0.33, unit = "1" }}
A = {{ default = 0.0126, unit = "1" }}
B = {{ default = 0.0241, unit = "1" }}
D0 = {{ default = 0.402, unit = "um" }}
V0 = {{ default = 1.0, unit = "um/s" }}
Vsat = {{ default = 256.0, unit = "um/s" }}
{own}
"""
POWERED = """
format = "srf-law/1"
kind = "interface"
name = "powered"
kappa = "W/lambda*(W/Wref)**(n - 1)"
[parameters]
lambda = { default = 0.56, unit = "um" }
n = { default = 1.0, unit = "1" }
Wref = { default = 7.0, unit = "N" }
"""


@pytest.fixture(scope="module")
def equivalents(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with laws that say what effects say."""
    folder = tmp_path_factory.mktemp("laws")
    drag = DRAGGED.format(term=" + c*v/V0", states="", own='c = { default = 0.0, unit = "1" }')
    (folder / "dragged.toml").write_text(drag)
    states = 'states = [{ name = "phi", length = "D0", weight = "B" }, { name = "phi2", length = "D2", weight = "B2" }]'
    own = 'B2 = { default = 0.004, unit = "1" }\nD2 = { default = 3.0, unit = "um" }'
    both = DRAGGED.format(term=" + B2*log(V0*phi2/D2)", states=states, own=own).replace('"dragged"', '"doubled"')
    (folder / "doubled.toml").write_text(both)
    (folder / "powered.toml").write_text(POWERED)
    return folder


@pytest.mark.parametrize(("effect", "values", "law", "same"), LAWS, ids=[x[0] for x in LAWS])
def test_an_effect_has_the_critical_loads_of_the_law_that_says_the_same(
    make_model: Any, equivalents: Path, effect: str, values: dict[str, float], law: dict[str, str], same: dict[str, float]
) -> None:
    one, other = with_effects(make_model, effect), srf.system(plugins=[equivalents], **law).model  # type: ignore[arg-type]
    assert loads(one, 4.0, 20.0, V=10.0, eps=0.09, **values) == pytest.approx(
        loads(other, 4.0, 20.0, V=10.0, eps=0.09, **same), rel=1e-8
    )
    a, b = (hopf_points(m, m.vector({"V": 10.0, **v}))[0] for m, v in ((one, values), (other, same)))
    assert (a.W0, a.Omega, a.crossing_rate) == pytest.approx((b.W0, b.Omega, b.crossing_rate), rel=1e-8)
    assert a.lyapunov == pytest.approx(b.lyapunov, rel=1e-6)


def test_multipliers_of_a_second_state_are_those_of_shooting(make_model: Any) -> None:
    """The equations by hand, DOP853, and a monodromy matrix by central differences."""
    at = {"V": 8.0, "W0": 9.0, "eps": 0.09, "f": 120.0, "K": 0.21, "M": 2.37e-6, "B2": 0.004, "D2": 3.0}
    mu0, A, B, D0, V0, Vsat, lam = 0.33, 0.0126, 0.0241, 0.402, 1.0, 256.0, 0.56

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        u, z, v, phi, phi2 = x[0], x[1], *np.exp(x[2:])
        share = Vsat * phi / D0 / (1 + Vsat * phi / D0)
        mu = mu0 + A * np.log(v / V0) + B * np.log1p(Vsat * phi / D0) + at["B2"] * np.log(V0 * phi2 / at["D2"])
        W = at["W0"] * (1 + at["eps"] * np.cos(2 * np.pi * at["f"] * t))
        aged, aged2 = 1 / phi - v / D0, 1 / phi2 - v / at["D2"]
        faster = ((z - v) / lam - B * share * aged - at["B2"] * aged2) / A
        return np.array([at["V"] - z, (at["K"] * u - W * mu) / at["M"], faster, aged, aged2])

    def period(x: np.ndarray) -> np.ndarray:
        return solve_ivp(rates, (0, 1 / at["f"]), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]

    def monodromy(x: np.ndarray) -> np.ndarray:
        steps = 1e-5 * np.eye(5)
        return np.stack([(period(x + s) - period(x - s)) / 2e-5 for s in steps], axis=1)

    model = with_effects(make_model, "second-state")
    x = np.asarray(model.steady(model.vector(at)))
    for _ in range(3):  # with the slopes of its start each: 3 monodromy matrices rather than one for every step
        slopes = monodromy(x) - np.eye(5)
        for _ in range(4):
            x = x - np.linalg.solve(slopes, period(x) - x)
    assert np.abs(period(x) - x).max() < 1e-9
    slider = srf.system(effects=["second-state"], W0=9, V=8, eps=0.09, B2=0.004, D2=3)
    found = srf.floquet(slider, tol=1e-9).to_dataframe()
    expected = np.linalg.eigvals(monodromy(x))
    got = found["re"].to_numpy() + 1j * found["im"].to_numpy()
    assert np.sort_complex(got) == pytest.approx(np.sort_complex(expected), abs=1e-6)


SLOPES = [
    ("load-lag", {"share": 0.7, "lag_time": 2e-3}),
    ("second-state", {"B2": 0.004, "D2": 3.0}),
    ("load-distortion", {"amplitude": 0.3, "phase": 0.7}),
    ("adhesion-offset", {"Wa": 0.3}),
]


@pytest.mark.parametrize(("effect", "values"), SLOPES, ids=[x[0] for x in SLOPES])
def test_slopes_by_an_effects_parameters_are_those_of_polished_loads(
    make_model: Any, effect: str, values: dict[str, float]
) -> None:
    model, h = with_effects(make_model, effect), 1e-4
    point = critical_line(model, model.vector({"V": 10.0, "eps": 0.13, **values}), lo=6.0, hi=20.0, tol=1e-10).points[0]
    for name, slope in zip(values, forced_slopes(model, [point], tuple(values))[0], strict=True):
        moved = []
        for factor in (1 + h, 1 - h):
            p = point.p.copy()
            p[model.index(name)] *= factor
            again = polish(model, p[:, None], point.orbit, np.array([point.rho]), along("W0", 1), tol=1e-10)[0]
            moved.append(again.value(model, "W0"))
        difference = (moved[0] - moved[1]) / (2 * h * values[name])
        assert slope == pytest.approx(difference, rel=2e-5, abs=1e-5)


def test_slopes_under_constant_load_by_an_effects_parameters(make_model: Any) -> None:
    model, values = with_effects(make_model, "second-state"), {"V": 10.0, "B2": 0.004, "D2": 3.0}
    p = model.vector(values)
    slopes = hopf_slopes(model, p, hopf_points(model, p)[0], ("B2", "D2"))
    for name, slope in zip(("B2", "D2"), slopes, strict=True):
        sides = [hopf_points(model, model.vector({**values, name: values[name] * (1 + s)}))[0].W0 for s in (1e-5, -1e-5)]
        assert slope * values[name] == pytest.approx((sides[0] - sides[1]) / 2e-5, rel=1e-6)


def run(*words: str) -> Any:
    return CliRunner().invoke(cli, list(words))


def test_the_command_line_takes_effects(empty_folder: Path) -> None:
    plain = run("critical", "--eps", "0.13", "--V", "7,25", "--json")
    felt = run("critical", "--effect", "load-transmission", "--set", "rho=0.5", "--eps", "0.26", "--V", "7,25", "--json")
    one, other = ([row["W0"] for row in json.loads(r.output)["rows"]] for r in (plain, felt))
    assert other == pytest.approx(one, rel=1e-8)
    at = ("--V", "8", "--W0", "6")
    for words in (("linear", "--over", "V=10"), ("floquet", *at, "--eps", "0.1"), ("response", *at)):
        assert run(*words, "--effect", "load-lag", "--csv").exit_code == 0


REFUSED = [
    ("sensor-lag", "changes what the gauge shows, not how the slider moves"),
    ("gauge-creep", "changes what the gauge shows, not how the slider moves"),
    ("friction-drift", "changes with time, so that no sliding is steady"),
    ("track-topography", "changes with slip, so that no sliding is steady"),
    ("drive-ripple", "changes with the stage's position, so that no sliding is steady"),
]


@pytest.mark.parametrize(("effect", "reason"), REFUSED, ids=[x[0] for x in REFUSED])
def test_effects_without_a_part_in_critical_loads_are_refused(empty_folder: Path, effect: str, reason: str) -> None:
    result = run("linear", "--effect", effect)
    assert result.exit_code == 2
    assert reason in result.output
    with pytest.raises(SrfError, match=reason):
        srf.linear(srf.system(effects=[effect]))


# experiments that hold tables


V = np.array([1.0, 10.0, 50.0, 1.0, 10.0, 50.0, 5.0, 20.0])
FELT_EPS = np.array([0.0, 0.0, 0.0, 0.09, 0.09, 0.045, 0.13, 0.09])
RHO = 0.48
HEAD = """
format = "srf-experiment/1"
title = "critical loads"
[apparatus]
stiffness = "0.21 N/um"
mass = "2.37 kg"
[model]
law = "srf-vsat"
ageing = "dieterich"
{model}
[parameters]
A = {{ value = 0.012, lower = 0.004, upper = 0.04 }}
D0 = {{ value = 0.38, lower = 0.1, upper = 1.5 }}
lambda = {{ value = 0.62, lower = 0.1, upper = 3.0 }}
{parameters}
"""
TABLE = '[[thresholds]]\nfile = "loads.csv"\nfrequency = 120.0\n'
RUN = '[[runs]]\nname = "run"\nfile = "run.csv"\n'


@pytest.fixture(scope="module")
def measured(model: Any) -> Thresholds:
    """Eight critical loads of the default parameters, with 3 % noise."""
    return with_noise(generated(model, V, FELT_EPS, values=model.defaults()), 3)


def folder_of(place: Path, text: str, **tables: Thresholds) -> Path:
    """An experiment's folder, with tables by the names of their files."""
    place.mkdir(exist_ok=True)
    (place / "experiment.toml").write_text(text)
    for name, table in tables.items():
        (place / f"{name}.csv").write_text(thresholds_csv(table))
    return place


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, measured: Thresholds) -> Path:
    """An experiment with one table and no run."""
    return folder_of(tmp_path_factory.mktemp("alone"), HEAD.format(model="", parameters="") + TABLE, loads=measured)


@pytest.fixture(scope="module")
def by_loads(alone: Path) -> Any:
    """The fit of the table alone."""
    return srf.fit(alone)


def test_a_table_alone_is_fitted_as_least_squares_fits_it(by_loads: Any, model: Any, measured: Thresholds) -> None:
    """The same loads by another minimiser, which shares the matching of crossings alone."""
    found = by_loads
    assert found.status.ok and found.runs is None
    start = {**model.defaults(), "A": 0.012, "D0": 0.38, "lambda": 0.62}
    scale = free_parameters(with_transmission(model.parameters), ("A", "D0", "lambda"), start=start)
    other = fit_thresholds(model, measured, scale=scale, values=start, methods=["least-squares"]).best
    for name, value, error in zip(scale.names, other.values, other.uncertainty.errors, strict=True):
        assert found.values[name] == pytest.approx(value, abs=0.1 * error)
        assert found.stderr[name] == pytest.approx(error, rel=0.03)
    assert found.found.fit.tables[0].match.cost == pytest.approx(other.cost, abs=0.02)


def test_the_score_of_critical_loads_is_the_slope_of_their_log_density(alone: Path) -> None:
    experiment = srf.read_experiment(alone)
    stable = open_model(load_registry(), **asdict(experiment.choice), stability=True)
    likelihood = Likelihood(fit_problem(stable, experiment, stability=stable))
    point, h = likelihood.at(likelihood.start), 1e-4
    for j, slope in enumerate(point.score):
        sides = [likelihood.at(likelihood.start + s * np.eye(3)[j], slopes=False).log_likelihood for s in (h, -h)]
        assert slope == pytest.approx((sides[0] - sides[1]) / (2 * h), rel=1e-3)
    r = point.tables[0].match.residuals
    expected = -0.5 * np.sum(r**2 + np.log(2 * np.pi * point.tables[0].loads.table.sigma ** 2))
    assert point.log_likelihood == pytest.approx(expected, rel=1e-12)


def test_the_share_of_a_modulation_is_found_from_the_loads(tmp_path: Path, measured: Thresholds) -> None:
    text = HEAD.format(model='effects = ["load-transmission"]', parameters="rho = { value = 0.6, lower = 0.2, upper = 1.5 }")
    folder = folder_of(tmp_path, text + TABLE, loads=replace(measured, eps=measured.eps / RHO))
    found = srf.fit(folder)
    assert found.status.ok
    for name, truth in (("rho", RHO), ("A", 0.0126), ("D0", 0.402), ("lambda", 0.56)):
        assert abs(found.values[name] - truth) < 3 * found.stderr[name]
    assert found.stderr["rho"] < 0.05


@pytest.mark.parametrize(("free", "wrong"), [(("A", "B"), False), (("A", "B", "D0"), True)])
def test_errors_that_a_ridge_makes_too_small_are_told(tmp_path: Path, model: Any, free: tuple[str, ...], wrong: bool) -> None:
    """Of loads without modulation: 95 % intervals of A, B and D0 hold the truth in 70 % of 30 draws, those of A and B in 93 %."""
    base = model.defaults()
    table = with_noise(generated(model, np.array([1.0, 5.0, 10.0, 50.0, 100.0]), np.zeros(5), values=base), 2)
    rows = "".join(f"{n} = {{ value = {base[n]}, lower = {base[n] / 10}, upper = {base[n] * 10} }}\n" for n in free)
    head = HEAD.format(model="", parameters="").partition("[parameters]")[0]
    folder = folder_of(tmp_path, f"{head}[parameters]\n{rows}{TABLE}", loads=table)
    told = [n for n in srf.fit(folder).table.notes if "not quadratic" in n]
    assert len(told) == wrong
    if wrong:
        assert "A, B, D0" in told[0] and "--profile" in told[0]
        profiled = srf.fit(folder, profile=True)
        row = {r["parameter"]: r for r in profiled.table.records()}["D0"]
        assert row["high"] - row["value"] > 1.5 * 1.96 * row["stderr"]
        assert any("low and high" in n and "D0" in n for n in profiled.table.notes)


def recording(seed: int) -> str:
    """A velocity step as CSV, of the default parameters, with noise."""
    t = np.arange(0, 1.2, 0.005)
    slider = srf.system(W0=5, V=5)
    record = srf.simulate(slider, t=t, drive=[(0, 5), (0.6, 20)], observable="force").records[0]
    force = record.observed + np.random.default_rng(seed).normal(0, 2e-3, t.size)
    rows = zip(t, np.where(t < 0.6, 5, 20), force, strict=True)
    lines = [f"{a:.3f},{b:g},5,{c:.6f}" for a, b, c in rows]
    return "\n".join(["time [s],load_point_velocity [um/s],normal_load [N],force [N]", *lines])


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory, measured: Thresholds) -> Path:
    """An experiment with a run, a table, and a table that is held out."""
    held = '[[thresholds]]\nname = "held"\nfile = "held.csv"\nholdout = true\n'
    text = HEAD.format(model="", parameters="mu0 = { value = 0.34, lower = 0.2, upper = 0.5 }")
    still = Thresholds("held.csv", *(x[:3] for x in (measured.V, measured.eps, measured.W0c, measured.sigma)), lines=(2, 3, 4))
    place = folder_of(tmp_path_factory.mktemp("both"), text + RUN + TABLE + held, loads=measured, held=still)
    (place / "run.csv").write_text(recording(5))
    return place


def test_runs_and_tables_are_fitted_together(both: Path, by_loads: Any) -> None:
    """Their log likelihoods and their information add."""
    found = srf.fit(both, track="smooth")
    assert found.status.ok
    assert [t.loads.name for t in found.found.fit.tables] == ["loads", "held"]
    fitted, held = found.found.fit.tables
    state = found.found.state_space
    assert state is not None
    (run,), (table,) = state.maximum.point.runs, state.maximum.point.tables
    assert state.log_likelihood == pytest.approx(run.log_likelihood + table.log_likelihood, rel=1e-12)
    assert held.loads.holdout and held.match.cost == pytest.approx(fitted.match.cost - np.sum(fitted.white[3:] ** 2), rel=1e-6)
    assert np.allclose(state.maximum.point.information, informed(run, state) + informed(table, state), rtol=1e-9)
    by_tables = by_loads.found.state_space
    assert by_tables is not None
    for name, truth in (("A", 0.0126), ("D0", 0.402), ("lambda", 0.56)):
        places = [s.likelihood.names.index(name) for s in (state, by_tables)]
        one, other = (s.maximum.covariance[k, k] for s, k in zip((state, by_tables), places, strict=True))
        assert one < other
        assert abs(found.values[name] - truth) < 4 * found.stderr[name]


def informed(part: Any, state: Any) -> np.ndarray:
    """A run's or a table's information in the coordinates of a likelihood."""
    names, unit = state.likelihood.names, state.likelihood.unit(state.maximum.point.x)
    out, at = np.zeros((len(names), len(names))), [names.index(n) for n in part.names]
    out[np.ix_(at, at)] = part.information * np.outer(unit[at], unit[at])
    return out


def test_the_command_shows_tables_and_loads(alone: Path, empty_folder: Path) -> None:
    shown = run("fit", str(alone), "--json", "--plot", "loads.svg")
    assert shown.exit_code == 0 and Path("loads.svg").stat().st_size > 1000
    found = json.loads(shown.stdout)
    (table,) = found["meta"]["tables"]
    assert (table["table"], table["role"], table["loads"], table["missing"]) == ("loads", "fit", 8, 0)
    assert len(found["meta"]["loads"]) == 8 and {r["type"] for r in found["meta"]["loads"]} == {"hopf", "ns"}
    assert table["chi2"] == pytest.approx(sum(r["residual"] ** 2 for r in found["meta"]["loads"]), rel=1e-9)
    assert "track" not in found["meta"] and not any("field" in note for note in found["notes"])
    for words, told in (
        (("check", str(alone)), "no recordings to check"),
        (("simulate", str(alone)), "no recordings to simulate"),
        (("fit", str(alone), "--track", "rough"), "--track is for recordings"),
        (("fit", str(alone), "--sample", "100"), "no recordings of which a posterior is drawn"),
        (("fit", str(alone), "--effect", "load-lag"), "--effect is given"),
    ):
        result = run(*words)
        assert result.exit_code == 2 and told in result.output


BREACHES = [
    ("thresholds = []", "thresholds: found [], expected tables, at least one"),
    ("", "runs: missing"),
    ("thresholds = 3", "thresholds: found 3, expected tables, at least one"),
    ('[[thresholds]]\nname = "a"', "thresholds[0].file: missing"),
    ('[[thresholds]]\nfile = "none.csv"', "no file"),
    ('[[thresholds]]\nfile = ""', "expected the name of a table"),
    ('[[thresholds]]\nfile = "loads.csv"', "line 5 of loads.csv has a modulated load, and its frequency is not said"),
    (TABLE.replace("120.0", "-1"), "found -1, expected a frequency above 0"),
    (TABLE + "load = 3", "thresholds[0].load: unknown key"),
    (TABLE + TABLE, "'loads' is the name of another run or table"),
    (TABLE + 'name = " "', "expected a name"),
    (TABLE + "holdout = 1", "expected true or false"),
]


@pytest.mark.parametrize(("text", "told"), BREACHES, ids=range(len(BREACHES)))
def test_a_breach_names_file_line_and_key(tmp_path: Path, measured: Thresholds, text: str, told: str) -> None:
    head = HEAD.format(model="", parameters="")
    if text.startswith("thresholds"):
        head, text = text + head, ""
    folder = folder_of(tmp_path, head + text, loads=measured)
    with pytest.raises(SrfError, match=re.escape(told)) as caught:
        srf.read_experiment(folder)
    assert "experiment.toml" in caught.value.message


@pytest.mark.parametrize("stiffness", ["1e-3 1/um", "3 MPa/mm"])
def test_loads_in_newton_need_a_stiffness_that_goes_with_them(tmp_path: Path, measured: Thresholds, stiffness: str) -> None:
    head = HEAD.format(model="", parameters="").replace("0.21 N/um", stiffness).replace('mass = "2.37 kg"\n', "")
    with pytest.raises(SrfError, match="critical loads are in N"):
        srf.read_experiment(folder_of(tmp_path, head + TABLE, loads=measured))


def test_what_is_held_out_is_not_opened_and_something_must_be_left(tmp_path: Path, measured: Thresholds) -> None:
    folder = folder_of(tmp_path, HEAD.format(model="", parameters="") + TABLE + "holdout = true\n", loads=measured)
    with pytest.raises(SrfError, match="every table of critical loads is held out"):
        srf.fit(folder)
    (folder / "loads.csv").unlink()
    assert srf.read_experiment(folder, holdout=False).thresholds == ()


def test_loads_without_an_error_are_told_to_have_the_usual_one(tmp_path: Path, measured: Thresholds) -> None:
    folder = folder_of(tmp_path, HEAD.format(model="", parameters="") + TABLE, loads=measured)
    rows = (f"{v},{e},{w}" for v, e, w in zip(measured.V, measured.eps, measured.W0c, strict=True))
    (folder / "loads.csv").write_text("\n".join(["V [um/s],eps,W0c [N]", *rows]))
    experiment = srf.read_experiment(folder)
    assert [n.kind for n in experiment.notices] == ["sigma"] and "3%" in experiment.notices[0].what
    assert experiment.thresholds[0].table.sigma == pytest.approx(0.03 * measured.W0c)


def test_an_experiment_with_tables_is_written_and_read_back(both: Path, tmp_path: Path) -> None:
    experiment = srf.read_experiment(both)
    write_experiment(experiment, tmp_path / "again")
    again = srf.read_experiment(tmp_path / "again")
    assert [run.name for run in again.runs] == ["run"]
    for one, other in zip(experiment.thresholds, again.thresholds, strict=True):
        assert (one.name, one.holdout, one.frequency) == (other.name, other.holdout, other.frequency)
        for column in ("V", "eps", "W0c", "sigma"):
            assert np.array_equal(getattr(one.table, column), getattr(other.table, column))


# a diagnosis of critical loads


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory: pytest.TempPathFactory, model: Any) -> tuple[Any, Path]:
    """The diagnosis of a baseline with a rigid interface, a table of loads held out, and the folder that it is written to."""
    exact = generated(model, V, FELT_EPS, values=model.defaults())
    loads, held = (with_noise(exact, seed, relative=0.015) for seed in (3, 4))
    text = HEAD.format(model='interface = "rigid"', parameters="").replace("lambda =", "# lambda =")
    text += TABLE + TABLE.replace("loads.csv", "held.csv") + "holdout = true\n"
    place = folder_of(tmp_path_factory.mktemp("diagnosed"), text, loads=loads, held=held)
    rivals = ["interface-compliance", "load-transmission", "linker-dieterich"]
    found = srf.diagnose(place, effects=[*rivals, "sensor-lag", "track-topography", "drive-ripple"])
    found.write(place / "found")
    return found, place / "found"


def test_a_diagnosis_of_loads_alone_names_what_the_baseline_lacks(diagnosed: tuple[Any, Path]) -> None:
    found, _ = diagnosed
    assert (found.verdict, found.effects) == ("identified", ("interface-compliance",))
    size = found.answer["augmented"]["parameters"]["lambda"]
    assert abs(size["value"] - 0.56) < 3 * size["stderr"] < 0.1
    tables = {t["name"]: t for t in found.answer["thresholds"]}
    assert not tables["loads"]["holdout"] and tables["held"]["holdout"]
    for name in tables:  # the held-out loads were not fitted, and are predicted better all the same
        assert tables[name]["chi2"]["augmented"] < 20 < 40 < tables[name]["chi2"]["baseline"]
    assert "critical loads have chi2" in found.diagnosis.baseline.against[0]
    reasons = {x["effect"]: x["reason"] for x in found.answer["not_identifiable"]}
    for effect in ("sensor-lag", "track-topography", "drive-ripple"):
        assert reasons[effect].startswith("critical loads do not depend on it")
    assert not found.run_table.rows and len(found.load_table.rows) == 2
    assert len(found.plot().axes) == 1


def test_scores_are_the_slopes_of_critical_loads(diagnosed: tuple[Any, Path], make_model: Any) -> None:
    """What an effect promises is by the derivatives of the loads at its neutral size: differences give the same columns."""
    base = diagnosed[0].diagnosis.baseline
    (column,) = [c for c in base.scores.columns if c.effect.name == "linker-dieterich"]
    stable = with_effects(make_model, "linker-dieterich", interface="rigid")
    table = base.fit.maximum.point.tables[0].loads.table
    values = {n: v for n, v in base.fit.values.items() if n in stable.names}
    sides = []
    for alpha in (1e-4, -1e-4):
        given = {**values, "alpha": alpha, "M": 2.37e-6}
        scale = free_parameters(with_transmission(stable.parameters), ("A",), start={**stable.defaults(), **given})
        sides.append(Matcher(stable, table, values=given, scale=scale, tol=1e-9).match(np.zeros(1)).loads)
    raw = (sides[0] - sides[1]) / 2e-4 / table.sigma
    assert column.columns[:, 0] == pytest.approx(base.projection.project(raw), abs=1e-3 * float(np.abs(raw).max()))


def test_what_is_written_of_loads_alone_is_whole(diagnosed: tuple[Any, Path], empty_folder: Path) -> None:
    found, folder = diagnosed
    assert json.loads((folder / "answer.json").read_text())["verdict"] == "identified"
    page = (folder / "report.html").read_text()
    assert "Critical loads, measured and computed" in page and "held (held out)" in page
    assert (folder / "figures" / "loads-loads.svg").stat().st_size > 1000
    again = srf.fit(folder / "augmented")
    assert again.values["lambda"] == pytest.approx(found.answer["augmented"]["parameters"]["lambda"]["value"], rel=2e-3)
    assert [t.loads.name for t in again.found.fit.tables] == ["loads", "held"]


def test_held_out_loads_refuse_a_model_that_does_not_predict_them(diagnosed: tuple[Any, Path]) -> None:
    diagnosis = diagnosed[0].diagnosis
    best, baseline, whole = diagnosis.best, diagnosis.baseline, diagnosis.experiment
    assert holdout_rejection((), [t.predicted for t in held_out_loads(baseline, best, whole)]) == ""
    loads = next(t for t in whole.thresholds if t.holdout)
    moved = replace(loads, table=replace(loads.table, W0c=1.15 * loads.table.W0c))
    wrong = held_out_loads(baseline, best, replace(whole, thresholds=(moved,)))
    assert "held-out critical loads are not predicted: held has chi2" in holdout_rejection((), [t.predicted for t in wrong])


def test_where_no_load_is_modulated_effects_on_modulation_cannot_be_seen(tmp_path: Path, measured: Thresholds) -> None:
    still = replace(measured, eps=np.zeros(8))
    experiment = srf.read_experiment(folder_of(tmp_path, HEAD.format(model="", parameters="") + TABLE, loads=still))
    candidates, excluded = applicable(load_registry(), experiment)
    reasons = {x.effect: x.reason for x in excluded}
    assert reasons["load-transmission"] == reasons["linker-dieterich"] == "the load is constant"
    assert "viscous-drag" in {e.name for e in candidates}
