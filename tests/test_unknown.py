"""Where no registered effect explains a recording: the missing force, candidate terms, and the closed form found among them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from commands import srf

from srfcli.cli.main import cli
from srfcli.codegen.model import open_model
from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.data.scales import at_scale
from srfcli.diagnosis.discrepancy import (
    TERMS_FOLDER,
    ClosedForm,
    FittedTerm,
    best_closed_form,
    correlation_ratios,
    explain_unknown,
    format_with_error,
    smoothed_friction_field,
    with_terms,
)
from srfcli.diagnosis.search import ModelSearch
from srfcli.diagnosis.verdict import Diagnosis, conclude
from srfcli.inference.state_space import Interrupted
from srfcli.laws.effect_file import formula_text
from srfcli.laws.registry import bundled_registry, load_registry, read_law
from srfcli.tasks.law_check import check_law
from srfcli.validation.cases import case_files
from srfcli.validation.gauge import Gauge, read_gauge
from srfcli.validation.slider import Physics, Plan, move

TERMS = sorted(TERMS_FOLDER.glob("*.toml"))
SHIPPED = bundled_registry()
PLANS = (
    Plan("steps", ((0.6, 4), (0.4, 60), (0.6, 8)), 3.0, 0.002),
    Plan("down", ((0.4, 60), (0.8, 4)), 3.0, 0.002),
    Plan("seen-later", ((0.6, 10), (0.5, 50), (0.5, 12)), 3.0, 0.002, holdout=True),
)


PLAIN = Physics(rigid=True, massless=True)  # of two unknowns of motion


def recorded(folder: Path, p: Physics, *, stated: Physics | None = None, seed: int = 1) -> Path:
    """Write what a slider `p` shows under PLANS, stated as the usual one, and return the folder."""
    rng = np.random.default_rng(seed)
    readings = {plan: read_gauge(move(p, plan).u, Gauge(), rng) for plan in PLANS}
    for name, text in case_files("small", stated or Physics(), readings).items():
        (folder / name).write_text(text)
    return folder


def searched(folder: Path, effects: tuple[str, ...] = ("viscous-drag",)) -> tuple[ModelSearch, Diagnosis]:
    """Return a search among a few registered effects, and what it concludes."""
    search = ModelSearch(SHIPPED, read_experiment(folder, registry=SHIPPED, holdout=False), effects=effects)
    search.run()
    return search, conclude(search, read_experiment(folder, registry=SHIPPED))


@pytest.fixture(scope="module")
def bump(tmp_path_factory):
    """Diagnosis and explanation of a bump of 0.004 on 14 um of the track."""
    p = replace(PLAIN, bump=0.004, bump_x=14.0, bump_w=1.2)
    search, diagnosis = searched(recorded(tmp_path_factory.mktemp("bump"), p, stated=PLAIN))
    return diagnosis, explain_unknown(diagnosis, best_closed_form(search, diagnosis))


@pytest.fixture(scope="module")
def age(tmp_path_factory, without_figures):
    """The folder that `srf diagnose` writes where contacts age by another power, which no effect that is named describes."""
    folder = tmp_path_factory.mktemp("age")
    out = folder / "found"
    arguments = ["diagnose", str(recorded(folder, replace(Physics(), p_age=1.7))), "--effect", "sensor-lag"]
    result = CliRunner().invoke(cli, [*arguments, "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    return out


@pytest.fixture(scope="module")
def unsteady(tmp_path_factory):
    """A recording that begins in no steady sliding, which is not stated: no effect says so, and its search is short."""
    out = tmp_path_factory.mktemp("unsteady") / "made"
    slider = "--law dieterich-ruina --interface rigid --no-inertia --W0 10 --set mu0=0.6 --set A=0.008 --set B=0.011 --set D0=5"
    gauge = "--drive 20:4,15:12,20:4 --rate 10 --observe force --noise 0.003 --free mu0,A,B,D0 --seed 1"
    srf("simulate", *slider.split(), *gauge.split(), "--K", "0.1 N/um", "--start", "phi=0.3 s", "--out-dir", out)
    text = (out / "experiment.toml").read_text()
    assert 'initial = "free"\n' in text
    (out / "experiment.toml").write_text(text.replace('initial = "free"\n', ""))
    return out


# ---- the candidates


@pytest.mark.parametrize("path", TERMS, ids=lambda p: p.stem)
def test_a_term_is_nested_and_acts(path):
    """Neutral values give the baseline back, sizes change something, derivatives are exact, units agree."""
    outcomes = {o.check: o.verdict for o in check_law(read_law(path))}
    assert "FAIL" not in outcomes.values(), outcomes
    assert outcomes["neutral"] == outcomes["derivatives"] == "ok"


def test_terms_have_parameters_of_their_own():
    """Several are in one model: a name that two of them had would be renamed, and a fit's values with it."""
    names = [p.name for path in TERMS for p in read_law(path).parameters]
    assert len(TERMS) >= 20 and len(names) == len(set(names))


def test_terms_have_the_scales_of_a_recording():
    """Of a gouge: a hundred times a slider's slip and time, ten times its interval."""
    scales = {"track": 12e3, "segment": 6e3, "duration": 850.0, "interval": 0.01, "D0": 40.0, "load": 20.0}
    moved = {p.name: p for path in TERMS for p in at_scale(read_law(path), scales).parameters}
    assert (moved["place"].lower, moved["place"].upper) == (0.0, 12e3)
    for name, low, high in (
        ("place_width", 40, 1500),
        ("settling_time", 10, 2975),
        ("run_length", 100, 20400),
        ("age_loss", 0, 0.2),
    ):
        assert (moved[name].lower, moved[name].upper) == pytest.approx((low, high))
    assert moved["drive_delay"].upper == moved["load_delay"].upper == pytest.approx(106.25)


def test_terms_join_the_registry_and_give_way_to_a_registered_effect():
    wide = with_terms(SHIPPED)
    names = [e.name for e in wide.entries("effect")]
    assert {p.stem for p in TERMS} <= set(names) and len(names) == len(set(names))
    assert with_terms(wide).entries() == wide.entries()
    assert not {p.stem for p in TERMS} & {e.name for e in SHIPPED.entries("effect")}
    with_terms(load_registry(trust=True)).check_trusted("own.py")  # what may run there may run here


# ---- the force


@pytest.mark.slow
def test_the_force_stands_where_the_track_is_rough(bump):
    """Found in both runs at that place, though neither place nor form is assumed."""
    diagnosis, _ = bump
    found = smoothed_friction_field(diagnosis.baseline)
    assert set(found) == {"steps", "down"}
    for run in found.values():
        top = int(np.argmax(run.force))
        assert abs(run.slip[top] - 14.0) < 1.5
        assert run.low[top] > 0 and 0.0015 < run.force[top] < 0.006
        truth = 0.004 * np.exp(-0.5 * ((run.slip - 14.0) / 1.2) ** 2)
        assert np.corrcoef(run.force, truth)[0, 1] > 0.7
        assert np.mean((truth > run.low) & (truth < run.high)) > 0.8
    assert next(iter(correlation_ratios(found))) == "slip"


def test_no_force_where_nothing_is_missing(tmp_path):
    _, diagnosis = searched(recorded(tmp_path, PLAIN, stated=PLAIN))
    assert diagnosis.verdict in ("none", "inconclusive")
    found = smoothed_friction_field(diagnosis.baseline)
    outside = [float(np.mean((r.low > 0) | (r.high < 0))) for r in found.values()]
    assert max(outside, default=0.0) < 0.05


# ---- the closed form


def is_the_truth(found, name, truth):
    """One term was found, the right one, with its numbers within four standard errors; it predicts what was not fitted."""
    assert [t["name"] for t in found["terms"]] == [name]
    for parameter, value in truth.items():
        got = found["terms"][0]["parameters"][parameter]
        assert abs(got["value"] - value) < 4 * got["stderr"] < 0.5 * abs(value) + 0.2 * (name == "track-place")
    assert found["gain"] > 20 and found["held_gain"] > 5 and found["leaves_noise_alone"]
    assert abs(found["held_rms_over_noise"]["form"] - 1) < 0.06
    assert name.split("-")[1] in found["form"]


def test_the_form_is_the_generator_s(bump):
    found = bump[1]
    is_the_truth(found, "track-place", {"place_height": 0.004, "place": 14.0, "place_width": 1.2})
    assert found["force"]["form"] == found["form"]
    run = found["force"]["steps"]
    assert run["band"].shape == (2, run["t"].size) and np.all(run["low"] <= run["high"])


def test_the_command_says_it(age):
    """`unknown` comes with the force in the report and the form as an effect that the next search takes."""
    found = json.loads((age / "answer.json").read_text())
    assert found["verdict"] == "unknown"
    assert {name for name, share in found["confidence"].items() if share > 0} == {"unknown", "missed"}
    assert sum(found["confidence"].values()) == pytest.approx(1.0)
    is_the_truth(found["missing"], "age-power", {"age_power": 1.7})
    assert "latent" in found["missing"] and "age_power" in (age / "report.html").read_text()
    heads, *rows = (age / "missing-steps.csv").read_text().splitlines()
    assert heads.startswith("time [s],friction,low,high,v [um/s]") and len(rows) == 800


def test_the_form_is_offered_as_an_effect(age):
    """The file reads, keeps every check, and a model with it says what the fitted one says."""
    effect = read_law(age / "closed-form.toml")
    assert {o.check: o.verdict for o in check_law(effect) if o.verdict != "ok"} == {"worked values": "skipped"}  # it has none
    assert dict(effect.neutral) == {"age_power": 1.0} and effect.sizes == ("age_power",)
    (term,) = json.loads((age / "answer.json").read_text())["missing"]["terms"]
    assert effect.parameters[0].default == pytest.approx(term["parameters"]["age_power"]["value"])
    assert formula_text(effect.changes[0][1]) == formula_text(read_law(TERMS_FOLDER / "age-power.toml").changes[0][1])


@pytest.mark.parametrize(
    ("end", "code", "said"),
    [
        pytest.param(KeyboardInterrupt, 130, "did not end", marks=pytest.mark.slow),
        (Interrupted, 130, "did not end"),
        pytest.param(RuntimeError, 0, "RuntimeError: no", marks=pytest.mark.slow),
    ],
)
def test_a_verdict_outlives_its_explanation(unsteady, tmp_path, srf_ended_at, without_figures, end, code, said):
    """Where the search for a closed form is interrupted, or fails, verdict and missing force are written all the same."""
    arguments, out = ("diagnose", unsteady, "--effect", "second-state"), tmp_path / "found"
    found, printed, _ = srf_ended_at("unknown: what is missing", *arguments, "--out", out, end=end("no"))
    assert found == code and "unknown" in printed and said in " ".join(printed.split())
    found = json.loads((out / "answer.json").read_text())
    assert found["verdict"] == "unknown" and not found["missing"]["searched"] and found["missing"]["form"] is None
    assert (out / "missing-simulated.csv").exists()


def test_terms_together_are_one_effect(tmp_path):
    """Each formula takes the place of what was there before; constants and delays go along."""
    chosen = ["age-power", "rate-load", "load-log", "load-memory", "age-velocity"]
    effects = [read_law(TERMS_FOLDER / f"{n}.toml") for n in chosen]
    terms = tuple(FittedTerm(e, {p.name: (p.default, 0.1 * p.default) for p in e.parameters}) for e in effects)
    form = ClosedForm(terms, (), None, 0.0, ())  # type: ignore[arg-type]
    path = tmp_path / "several.toml"
    path.write_text(form.as_toml(name="several"))
    effect = read_law(path)
    assert "FAIL" not in {o.verdict for o in check_law(effect)}
    from srfcli.laws.expression import parse_expression, symbol

    rate = dict(effect.changes)["rate"]
    one = dict.fromkeys(("v", "phi", "D0"), 1.0) | {"W": 20.0, "rate": 0.5, "age_power": 1.3, "rate_load": 2.0}
    assert float(rate.subs({symbol(k): x for k, x in one.items()})) == pytest.approx(0.5 * 4)
    assert [s.name for s in effect.states] == ["late_load"] and {c.name for c in effect.constants} == {"Wref"}
    assert "rate_load = 0.200 ± 0.020" in form.text and "Wref = 10 N" in form.text and "late_load' = " in form.text
    for slot, formula in form.formulas().items():
        names = {str(x) for x in formula.free_symbols}
        assert parse_expression(formula_text(formula), names) == formula, slot


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (1.599372, 0.026682, "1.599 ± 0.027"),
        (14.1156, 0.0954, "14.116 ± 0.095"),
        (-120.3, 35.0, "-120 ± 35"),
        (1.2342e-7, 3.1e-9, "1.234e-07 ± 3.1e-09"),
        (0.5, float("inf"), "0.5"),
        (0.5, 0.0, "0.5"),
    ],
)
def test_values_carry_two_digits_of_their_error(value, error, text):
    assert format_with_error(value, error) == text


@pytest.mark.slow
def test_a_form_that_cannot_be_fitted_beside_an_effect_is_tried_without_it(tmp_path):
    """A drag takes up a part of what ages differently; from where it stands the right term does not follow the recordings."""
    search, diagnosis = searched(recorded(tmp_path, replace(Physics(), p_age=1.7)))
    found = best_closed_form(search, diagnosis)
    assert found is not None and [t.effect.name for t in found.terms] == ["age-power"] and not found.beside


def test_terms_whose_steady_age_is_a_quartic_s_root_cannot_be_joined():
    """The quadratic ageing law with a term in the root of the age: its roots have cases, which generated code cannot tell."""
    system = {"law": "dieterich-ruina", "ageing": "perrin-rice-zheng", "interface": "rigid", "inertia": False}
    with pytest.raises(SrfError, match="no closed form for the steady state"):
        open_model(with_terms(SHIPPED), **system, effects=("age-root",), random_field=True)
