"""The blind proof: marks by hand, rates by their formulas, trials that resume, lose workers and refuse tampering."""

from __future__ import annotations

import ast
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli
from example_protocol import SHORT
from hypothesis import given
from hypothesis import strategies as st
from in_workers import careless, deadly_at_one, peeks, remembers, says_none

from srfcli.cli import prove as command
from srfcli.cli.main import main
from srfcli.core.errors import SrfError
from srfcli.core.parallel import run_processes
from srfcli.laws.registry import load_registry
from srfcli.results.tables import to_csv, to_json
from srfcli.validation import marks as report
from srfcli.validation.apparatus import RIGS
from srfcli.validation.blind import (
    Answer,
    Task,
    answer_case,
    code_of,
    diagnose_case,
    from_line,
    read_answers,
    to_line,
    write_answers,
)
from srfcli.validation.cases import BANKS, NAMES, PAPER_KINDS, WIDE_KINDS, make_case, plan_bank, possible_pairs, variants
from srfcli.validation.gauge import Gauge
from srfcli.validation.marks import (
    MIN_VISIBLE_SIGMAS,
    Detectability,
    Rate,
    accepted,
    calibration,
    detectability_of,
    deviation,
    effect_standard_errors,
    grade,
    quantile,
)
from srfcli.validation.slider import Physics, move
from srfcli.validation.trials import Trial, answer_all, begin, open_truths, prove

ROOT = Path(__file__).resolve().parents[1]
SHORTEST = {"bank": "wide", "seed": 6}  # of cases whose runs cost little
SURE = {"none": 0.0, "unknown": 0.01}


@pytest.fixture(scope="module")
def made():
    """Trials that were made before, by their number of cases."""
    return {}


@pytest.fixture
def new_trial(made, tmp_path_factory):
    """`new_trial(folder, n)`: a trial of n cases in a new folder; its cases are made once and copied."""

    def copied(folder, n=4):
        if n not in made:
            made[n] = tmp_path_factory.mktemp("trials") / "t"
            begin(made[n], cases=n, **SHORTEST, kinds=(), resume=False, workers=1)
        shutil.copytree(made[n], folder)
        return Trial(folder)

    return copied


def every_effect():
    registry = load_registry()
    return [registry.load(entry) for entry in registry.entries("effect")]


# ---- marks


def truth_of(*effects, verdict="identified", rough=0.0, **more):
    return {"effects": list(effects), "verdict": verdict if effects else "none", "rough": rough,
            "sizes": dict.fromkeys(effects, 0.5), "truth": {}, **more}  # fmt: skip


def marked(truth, verdict, *names, sigmas=50.0, confidence=None, equivalent=(), held=0.021):
    said = "+".join(sorted(names)) if names else verdict
    answer = Answer(
        "case-000", verdict, names, {said: 0.97, "none": 0.01} if confidence is None else confidence, equivalent,
        held={"a": {"baseline": 0.04, "augmented": held}, "b": {"baseline": 0.04, "augmented": held}},
    )  # fmt: skip
    stands = sigmas if isinstance(sigmas, dict) else dict.fromkeys(truth["effects"], sigmas)
    return grade(truth, answer, Detectability("case-000", {"a": 0.02, "b": 0.02}, stands))


ALPHA, DRAG, LAG = "linker-dieterich", "viscous-drag", "sensor-lag"


@pytest.mark.parametrize(
    ("truth", "verdict", "names", "right"),
    [
        (truth_of(), "none", (), True),
        (truth_of(), "inconclusive", (), False),
        (truth_of(), "unknown", (), False),
        (truth_of(), "identified", (ALPHA,), False),
        (truth_of(ALPHA), "identified", (ALPHA,), True),
        (truth_of(ALPHA), "identified", (DRAG,), False),
        (truth_of(ALPHA), "identified", (ALPHA, DRAG), False),
        (truth_of(ALPHA), "none", (), False),
        (truth_of(ALPHA), "ambiguous", (ALPHA, DRAG), False),
        (truth_of(ALPHA, DRAG), "identified", (DRAG, ALPHA), True),
        (truth_of(ALPHA, DRAG), "identified", (ALPHA,), False),
        (truth_of("age-exponent", verdict="unknown"), "unknown", (), True),
        (truth_of("age-exponent", verdict="unknown"), "identified", ("slip-evolution",), False),
        (truth_of(ALPHA, accept=["unknown"]), "unknown", (), True),
        (truth_of(ALPHA, accept=["sensor-lag+viscous-drag"]), "identified", (DRAG, LAG), True),
        (truth_of(ALPHA), "failed", (), False),
        (truth_of("ruina", kind="ageing", accept=["slip-evolution"]), "identified", ("ruina",), True),
        (truth_of("ruina", kind="ageing", accept=["slip-evolution"]), "identified", ("slip-evolution",), True),
        (truth_of("dieterich", kind="ageing"), "unknown", (), False),
        (truth_of("dieterich", kind="ageing"), "identified", ("dieterich",), True),
        (truth_of(LAG, kind="one-run", accept=["unknown"], only="strong"), "unknown", (), True),
        (truth_of(LAG, kind="one-run", accept=["unknown"], only="strong"), "none", (), False),
    ],
)
def test_right_is_the_verdict_and_the_set(truth, verdict, names, right):
    assert marked(truth, verdict, *names).right is right


def test_ambiguous_counts_where_the_truth_is_listed_or_equivalent():
    assert marked(truth_of(ALPHA), "ambiguous", ALPHA, DRAG).class_right
    assert not marked(truth_of(ALPHA), "ambiguous", LAG, DRAG).class_right
    assert marked(truth_of(ALPHA), "ambiguous", LAG, DRAG, equivalent=((LAG, ALPHA),)).class_right
    assert not marked(truth_of(ALPHA), "identified", LAG, equivalent=((LAG, ALPHA),)).class_right
    assert not marked(truth_of(), "ambiguous", LAG, DRAG).class_right
    assert not marked(truth_of("age-exponent", verdict="unknown"), "ambiguous", "age-exponent").class_right


def test_what_cannot_be_seen_is_not_asked_for():
    weak = {"sigmas": MIN_VISIBLE_SIGMAS - 0.1}
    for verdict in ("none", "inconclusive", "ambiguous"):
        assert marked(truth_of(ALPHA), verdict, **weak).right
        assert not marked(truth_of(ALPHA), verdict, sigmas=MIN_VISIBLE_SIGMAS).right
        assert not marked(truth_of(ALPHA), verdict, sigmas={ALPHA: None}).right  # not known to be invisible
    assert marked(truth_of(ALPHA), "identified", ALPHA, **weak).right
    assert not marked(truth_of(ALPHA), "identified", DRAG, **weak).right
    assert not marked(truth_of(ALPHA), "unknown", **weak).right
    pair, one = truth_of(ALPHA, DRAG), {"sigmas": {ALPHA: 1.0, DRAG: 80.0}}
    assert marked(pair, "identified", DRAG, **one).right
    assert not marked(pair, "identified", ALPHA, **one).right
    assert not marked(pair, "none", **one).right
    assert marked(pair, "none", sigmas=1.0).right
    outside = truth_of("age-exponent", verdict="unknown")
    assert marked(outside, "none", **weak).right and marked(outside, "unknown", **weak).right
    assert accepted(truth_of(), ()) == {("none", frozenset())}


def test_confidence_alarms_and_wrong_names():
    wrong = marked(truth_of(ALPHA), "identified", DRAG, LAG)
    assert (wrong.confident_wrong, wrong.wrong_name, wrong.alarm, wrong.hit) == (True, True, True, False)
    doubtful = marked(truth_of(ALPHA), "identified", DRAG, confidence={DRAG: 0.9, ALPHA: 0.1})
    assert (doubtful.confident_wrong, doubtful.wrong_name, doubtful.top, doubtful.stated) == (False, True, DRAG, 0.9)
    right = marked(truth_of(ALPHA, DRAG), "identified", DRAG, ALPHA)
    assert (right.hit, right.top, right.confident_wrong) == (True, f"{ALPHA}+{DRAG}", False)
    assert marked(truth_of(), "none").alarm is False
    assert marked(truth_of("age-exponent", verdict="unknown"), "unknown").hit
    assert not marked(truth_of("age-exponent", verdict="unknown"), "none").hit
    undecided = {"unknown": 0.35, "missed": 0.65}  # of which the second is that something registered, or nothing, was concealed
    assert all(marked(truth, "unknown", confidence=undecided).hit for truth in (truth_of(ALPHA), truth_of()))
    assert not marked(truth_of("age-exponent", verdict="unknown"), "unknown", confidence=undecided).hit


def test_held_out_error_is_over_that_of_the_truth():
    m = marked(truth_of(ALPHA), "identified", ALPHA, held=0.022)
    assert (m.error, m.baseline_error) == (pytest.approx(1.1), pytest.approx(2.0))
    nothing = replace(m.answer, held={})
    assert grade(truth_of(ALPHA), nothing, Detectability("case-000", {"a": 0.02})).error is None


@pytest.mark.parametrize("name", NAMES)
def test_the_size_of_every_effect_is_known_on_both_sides(name):
    """Each parameter is one that the plugin declares, in that unit."""
    laws = [e for e in every_effect() if e.reported == name]
    declared = {(p.name, p.unit) for e in laws for p in e.parameters if p.name in e.sizes}
    declared |= {{"K": ("ratio", "1"), "M": ("M", "kg")}[freed] for e in laws for freed in e.frees}
    assert {(e.parameter, e.unit) for e in variants(name)} == declared


def test_deviations_by_hand():
    def off(name, value, unit="1", *, named=None, changed=None, **physics):
        (size,) = [e for e in variants(name) if e.unit == unit]
        truth = truth_of(name, physics=physics)
        truth["truth"] = changed if changed is not None else physics
        found = {size.parameter: {"value": value, "stderr": 0.5, "unit": unit}}
        return deviation(truth, Answer("c", "identified", (named or name,), parameters=found))

    assert off(ALPHA, 3.0, alpha=2.0) == (2.0, 0.5)
    assert off("age-saturation", 0.25, "s/um", Vsat=8.0) == (0.25, 1.0)
    assert off("inertia", 1.0, "kg", M=2e-6) == (-2.0, 0.5)
    assert off("inertia", 1.0, "kg", M=2e-6, changed={"massless": False}) == (-2.0, 0.5)  # the baseline lacks it all
    assert off("drive-ripple", -3.0, ripple=2.0) == (2.0, 0.5)
    assert off("friction-drift", 3.0, "1/um", drift_x=2.0) == (2.0, 0.5)
    assert off("friction-drift", 3.0, "1/um", drift_t=2.0) is None  # drift in time, found as one along the track
    assert off(ALPHA, 3.0, named=DRAG, alpha=2.0) is None
    found = replace(marked(truth_of(ALPHA), "identified", ALPHA), deviation=(-2.5, 0.1))
    (row,) = report.size_errors([found, replace(found, deviation=(1.5, 0.3))]).records()
    assert (row["within_2"], row["cases"]) == (1, 2)
    assert (row["median_off"], row["median_relative"]) == (2.0, pytest.approx(0.2))


# ---- rates


@given(st.integers(1, 500), st.data())
def test_wilson_bounds_are_where_the_score_test_just_rejects(n, data):
    hits = data.draw(st.integers(0, n))
    low, high = Rate(hits, n).interval
    share = hits / n
    assert 0 <= low <= share <= high <= 1

    def score(p):
        return (share - p) ** 2 * n - 1.959963984540054**2 * p * (1 - p)

    for bound, end in ((low, 0), (high, n)):
        assert bound == end / n if hits == end else abs(score(bound)) < 1e-9 * n and bound != share


def test_no_cases_have_no_rate():
    assert (Rate(0, 0).share, Rate(0, 0).interval, quantile([], 0.5), calibration([], [])) == (
        None,
        (None, None),
        None,
        ((), None),
    )


def test_calibration_by_hand():
    stated, hits = [0.95, 0.97, 0.6, 0.6, 1.0, 0.99], [True, False, True, False, True, True]
    bins, error = calibration(stated, hits)
    assert [(b.low, b.rate.hits, b.rate.count) for b in bins] == [(0.5, 1, 2), (0.95, 1, 2), (0.99, 2, 2)]
    assert error == pytest.approx((2 * abs(0.6 - 0.5) + 2 * abs(0.96 - 0.5) + 2 * abs(0.995 - 1.0)) / 6)


def test_honest_confidence_is_calibrated_and_boasting_is_not():
    chance = random.Random(5)
    stated = [chance.uniform(0.3, 1.0) for _ in range(20000)]
    hits = [chance.random() < s for s in stated]
    assert calibration(stated, hits)[1] < 0.01
    assert calibration([min(s + 0.2, 1.0) for s in stated], hits)[1] > 0.1


# ---- tables


def sample():
    rough = 3e-4
    return [
        marked(truth_of(), "none"),
        marked(truth_of(rough=rough), "identified", ALPHA),
        marked(truth_of(ALPHA), "identified", ALPHA),
        marked(truth_of(ALPHA), "identified", DRAG),
        marked(truth_of(DRAG, rough=rough), "ambiguous", DRAG, LAG, sigmas=8.0),
        marked(truth_of(ALPHA, DRAG), "identified", DRAG),
        marked(truth_of("age-exponent", verdict="unknown"), "unknown"),
        marked(truth_of("age-exponent", verdict="unknown"), "identified", "slip-evolution"),
    ]


def rows(table):
    return {row[table.columns[0].name]: row for row in table.records()}


def test_tables_count_what_was_marked():
    marks = sample()
    first = rows(report.confusion(marks))
    assert {k: v["cases"] for k, v in first.items()} == {
        "none": 1, "none, one field for all runs": 1, "single": 2, "single, one field for all runs": 1, "pair": 1, "outside": 2,
    }  # fmt: skip
    assert (first["single"]["identified"], first["single"]["right"]) == (2, 1)
    assert (first["single, one field for all runs"]["right"], first["single, one field for all runs"]["class_right"]) == (0, 1)
    found = {name: (row["hits"], row["cases"]) for name, row in rows(report.rates(marks)).items()}
    assert found["right"] == (3, 8)
    assert found["right, or ambiguous and listed"] == (4, 8)
    assert (found["right, without a field"], found["right, with a field"]) == ((3, 6), (0, 2))
    assert found["false alarm where nothing is concealed"] == (1, 2)
    assert (found["false alarm, without a field"], found["false alarm, with a field"]) == ((0, 1), (1, 1))
    assert (found["wrong name, stated above 0.9"], found["wrong name, of all names"]) == ((4, 8), (4, 5))
    assert found["unknown recognised"] == (1, 2)
    alone = rows(report.by_effect(marks))
    assert (alone[ALPHA]["hits"], alone[ALPHA]["cases"], alone[ALPHA]["in_pairs"], alone[ALPHA]["named_in_pairs"]) == (1, 2, 1, 0)
    assert (alone[DRAG]["cases"], alone[DRAG]["class_right"], alone[DRAG]["named_in_pairs"]) == (1, 1, 1)
    assert rows(report.by_outside(marks))["age-exponent"]["called"] == "slip-evolution"
    power = [r for r in report.by_strength(marks).records() if r["measure"] == "standard errors"]
    assert [(r["from"], r["cases"], r["seen"], r["named"]) for r in power] == [(5.0, 1, 1, 0), (50.0, 2, 2, 1)]
    errors = rows(report.held_out_errors(marks))["named rightly"]
    assert (errors["cases"], errors["median"], errors["within"], errors["baseline_median"]) == (1, pytest.approx(1.05), 1.0, 2.0)
    assert rows(report.calibrated(marks))


def test_an_effect_in_one_run_is_marked_by_its_name_and_by_its_run():
    truth = truth_of(LAG, kind="one-run", accept=["unknown"], only="strong")
    answers = [
        Answer("c", "identified", (LAG,), run="strong"), Answer("c", "identified", (LAG,), run="steps"),
        Answer("c", "unknown", run="strong"), Answer("c", "identified", (DRAG,), run="strong"),
    ]  # fmt: skip
    marks = [grade(truth, answer, Detectability("c", sigmas={LAG: 90.0})) for answer in answers]
    assert [(m.kind, m.right, m.located) for m in marks] == [
        ("one-run", True, True), ("one-run", True, False), ("one-run", True, False), ("one-run", False, False),
    ]  # fmt: skip
    found = rows(report.rates([*marks, marked(truth_of("ruina", kind="ageing"), "identified", "ruina")]))
    assert [found[f"effect in one run: named, {how}"]["hits"] for how in ("or unknown", "and the run")] == [3, 1]
    assert (found["ageing law named, where another is stated"]["hits"], len(marks)) == (1, 4)
    everywhere = grade(truth_of(LAG), Answer("c", "identified", (LAG,)), Detectability("c", sigmas={LAG: 90.0}))
    assert everywhere.right and not everywhere.located


def test_marks_are_counted_by_what_the_case_was_set_in():
    alarm = replace(marked(truth_of(), "unknown"), set_in={"apparatus": "rock-stress", "noise": "1/f"})
    right = replace(marked(truth_of(ALPHA), "identified", ALPHA), set_in={"apparatus": "paper", "noise": "1/f"})
    wrong = replace(marked(truth_of(ALPHA), "identified", DRAG), set_in={"apparatus": "paper", "noise": "white"})
    found = {(r["circumstance"], r["value"]): r for r in report.by_setting([alarm, right, wrong]).records()}
    assert list(found) == [("apparatus", "paper"), ("apparatus", "rock-stress"), ("noise", "1/f"), ("noise", "white")]
    counts = [[r[n] for n in ("hits", "cases", "false_alarms", "nothing", "named_wrongly")] for r in found.values()]
    assert counts == [[1, 2, 0, 0, 1], [0, 1, 1, 1, 0], [1, 2, 1, 1, 0], [0, 1, 0, 0, 1]]


def test_a_report_holds_everything_and_survives_json():
    from srfcli.results.tables import envelope, to_json, to_text

    table, more = report.tables(sample(), digest="ab" * 32, seed=3, of=10)
    data = json.loads(to_json(table))
    assert data["schema"] == "srf.prove/1"
    assert {"rates", "effects", "outside", "power", "calibration", "held", "cost", "marks"} <= set(data["meta"])
    assert len(data["meta"]["marks"]) == 8 and data["meta"]["calibration_error"] is not None
    assert "2 further cases were given up" in "".join(data["notes"])
    assert envelope(table)["rows"]
    assert all(to_text(t) for t in more)
    assert report.tables(sample()[:1], digest="", seed=1, of=1)[1]  # one case alone is a report too


# ---- answers as lines


def test_answers_survive_their_file(tmp_path):
    answers = [m.answer for m in sample()[:1]] + [
        Answer("case-001", "failed", failure="x"),
        Answer("case-002", "ambiguous", (ALPHA, LAG), {ALPHA: 0.5}, ((ALPHA, LAG),), (DRAG,), {"alpha": {"value": 0.01}}),
    ]
    write_answers(tmp_path / "a", reversed(answers))
    assert read_answers(tmp_path / "a") == {a.case: a for a in answers}
    older = json.loads(to_line(answers[0]))
    del older["run"]  # which answers of former states of the program lack
    assert from_line(json.dumps(older), where="a") == answers[0]
    assert len((tmp_path / "a").read_text().splitlines()) == 3
    assert read_answers(tmp_path / "nothing") == {}


@pytest.mark.parametrize("line", ["", "{}", "[]", "{", to_line(Answer("c", "none")).replace('"none"', '"perhaps"'),
                                  to_line(Answer("c", "none")).replace('"case"', '"name"')])  # fmt: skip
def test_a_damaged_line_is_named(tmp_path, line):
    with pytest.raises(SrfError, match="line 7: no answer"):
        from_line(line, where="line 7")
    (tmp_path / "a").write_text(to_line(Answer("c", "none")) + "\n" + to_line(Answer("c", "unknown")) + "\n")
    with pytest.raises(SrfError, match="line 2: c was answered before"):
        read_answers(tmp_path / "a")


# ---- what there was to be seen


def test_an_effect_stands_out_by_what_the_baseline_cannot_do():
    """The size's standard error in a linear fit, by the normal equations, of a drag beside the baseline."""
    plan, p = SHORT[1], replace(Physics(), drag=3e-5)
    gauge = Gauge(lag1=0.6)
    drag = variants("viscous-drag")[0]
    left, raw = effect_standard_errors(drag, [], {plan: p}, gauge=gauge)

    base = move(replace(p, drag=0.0), plan).u
    columns = [(move(p, plan).u - base) / p.drag]
    for name in ("mu0", "A", "B", "D0", "Vsat", "lam"):
        h = 1e-4 * getattr(p, name)
        up, down = (move(replace(p, drag=0.0, **{name: getattr(p, name) + s * h}), plan).u for s in (1, -1))
        columns.append((up - down) / (2 * h))
    J = np.column_stack(columns)
    n, level2 = len(base), 0.02**2 + 0.005**2 / 12
    C = level2 * 0.6 ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    J = J * (scale := 1 / np.linalg.norm(J, axis=0))
    error = np.sqrt(np.linalg.inv(J.T @ np.linalg.solve(C, J))[0, 0]) * scale[0]
    assert left == pytest.approx(p.drag / error, rel=0.06)  # one-sided differences there
    assert 0 < left < raw


def test_a_shift_of_a_free_parameter_does_not_stand_out():
    """Wa on a constant load is a shift of mu0, and nothing else."""
    steady = replace(SHORT[1], steps=(), drive=((1.0, 20.0), (1.0, 40.0)))
    p = replace(Physics(), Wa=0.05)
    adhesion = variants("adhesion-offset")[0]
    for plan, most in ((steady, 0.2), (SHORT[1], np.inf)):
        left, raw = effect_standard_errors(adhesion, [], {plan: p}, gauge=Gauge())
        assert left < most
        assert raw > 20
    assert left > 5  # a step of the load shows it


def test_a_wrong_stiffness_stands_out_of_elongations_by_the_mass_alone():
    """Elongations of a stiffness r times the stated one are those of mu0, A, B over r and lambda times r."""
    r, p = 1.2, replace(Physics(), massless=True)
    stiffer, scaled = replace(p, ratio=r), replace(p, mu0=p.mu0 / r, A=p.A / r, B=p.B / r, lam=p.lam * r)
    plan, wrong = SHORT[1], variants("stiffness-error")[0]
    np.testing.assert_allclose(move(stiffer, plan).u, move(scaled, plan).u, rtol=1e-6)
    left, raw = effect_standard_errors(wrong, [], {plan: stiffer}, gauge=Gauge())
    assert left < 1e-4 < 20 < raw
    for mass, low, high in ((4e-6, MIN_VISIBLE_SIGMAS, np.inf), (4e-8, 0, 0.1)):  # a mass that shows, and one that does not
        heavy = {plan: replace(stiffer, massless=False, M=mass)}
        assert low < effect_standard_errors(wrong, [], heavy, gauge=Gauge())[0] < high
        assert effect_standard_errors(wrong, list(variants("inertia")), heavy, gauge=Gauge())[0] < 1e-3
    stress = Gauge(sigma=1e-3, quantum=1e-4)
    force = effect_standard_errors(wrong, [], {plan: stiffer}, gauge=stress, rig=RIGS["rock-stress"])[0]
    assert force > MIN_VISIBLE_SIGMAS  # a force is known, and a softer spring loads more slowly


def test_the_true_model_leaves_the_noise(tmp_path):
    plans = (SHORT[1], replace(SHORT[0], holdout=True))
    truth = make_case(tmp_path / "c", 5, plans=plans, effects=[ALPHA, "friction-drift"], size=0.9, rough=2e-4)
    found = detectability_of((tmp_path / "c", truth))
    assert set(found.known) == {"wave"}  # the held-out run
    assert 0.85 < found.known["wave"] / np.hypot(0.02, 0.005 / np.sqrt(12)) < 1.15
    assert set(found.sigmas) == {ALPHA, "friction-drift"}
    assert all(0 <= found.sigmas[n] <= found.raw[n] * (1 + 1e-9) for n in found.sigmas)


# ---- trials


def test_a_case_costs_no_more_than_itself(new_trial, tmp_path):
    trial = new_trial(tmp_path / "t")
    found = {a.case: a for a in answer_all(trial, workers=2, diagnose=careless, limit=1.0)}
    assert [found[f"case-00{k}"].verdict for k in range(4)] == ["failed", "failed", "failed", "none"]
    assert found["case-000"].failure.startswith("ValueError: a matrix is singular; in_workers.py, line ")
    assert "killed" in found["case-001"].failure
    assert found["case-002"].failure == "more than 1 s of CPU" and found["case-002"].cpu > 0.8
    assert read_answers(trial.answers) == found
    assert {len(a.code) for k, a in found.items() if k != "case-001"} == {12}


def test_the_code_of_an_answer_is_that_of_the_plugins_too(tmp_path):
    def code():
        code_of.cache_clear()
        return code_of((tmp_path,))

    (tmp_path / "own.toml").write_text("one")
    first = code()
    (tmp_path / "own.toml").write_text("two")
    assert code() != first != code_of(())


def test_a_killed_worker_costs_nothing_the_first_time(new_trial, tmp_path):
    trial = new_trial(tmp_path / "t")
    assert {a.verdict for a in answer_all(trial, workers=2, diagnose=remembers)} == {"none"}
    assert len(list((tmp_path / "t" / "calls").iterdir())) == 5


def test_a_run_that_was_ended_goes_on_with_the_rest(new_trial, tmp_path):
    trial = new_trial(tmp_path / "t")
    run = answer_all(trial, diagnose=remembers)
    first = [next(run).case, next(run).case]
    run.close()
    assert sorted(read_answers(trial.answers)) == sorted(first)
    with pytest.raises(SrfError, match="2 of 4 cases have no answer"):
        open_truths(trial)
    again = begin(tmp_path / "t", cases=4, seed=None, kinds=(), resume=True, workers=1)
    assert sorted([a.case for a in answer_all(again, diagnose=says_none)] + first) == [f"case-00{k}" for k in range(4)]
    truths, answers = open_truths(again)
    assert list(truths) == sorted(answers)
    assert list(answer_all(again, diagnose=says_none)) == []  # nothing is left to do, even now


def test_a_trial_ends_where_its_truths_are_read(new_trial, tmp_path):
    trial = new_trial(tmp_path / "t")
    run = answer_all(trial, diagnose=says_none)
    next(run)
    run.close()
    truths, answers = open_truths(trial, unfinished=True)
    assert list(truths) == list(answers) and len(answers) == 1
    with pytest.raises(SrfError, match="unsealed before"):
        list(answer_all(trial, diagnose=says_none))
    assert open_truths(trial)[1] == answers  # a second look at the same answers
    write_answers(trial.answers, [*answers.values(), Answer("case-009", "none")])
    with pytest.raises(SrfError, match="changed after the truths were unsealed"):
        open_truths(trial)


def test_tampering_is_told(new_trial, tmp_path):
    trial = new_trial(tmp_path / "t", 2)
    list(answer_all(trial, diagnose=says_none))
    text = trial.apart.read_text()
    trial.apart.write_text(text.replace('"verdict": "', '"verdict": "un', 1))
    with pytest.raises(SrfError, match="sealed was"):
        open_truths(trial)
    assert not trial.opened.exists()
    trial.apart.write_text(text)
    answers = read_answers(trial.answers)
    write_answers(trial.answers, [*answers.values(), Answer("case-009", "none")])
    with pytest.raises(SrfError, match="case-009 is no case of this bank"):
        open_truths(trial)
    write_answers(trial.answers, answers.values())
    (trial.bank / "case-001" / "steps.csv").write_text("time [s]\n")
    with pytest.raises(SrfError, match="not the files that were sealed"):
        open_truths(trial)
    trial.answers.unlink()
    with pytest.raises(SrfError, match="not the files that were sealed"):
        list(answer_all(trial, diagnose=says_none))


@pytest.mark.parametrize("at", ["before the note", "before the bank's rename", "after it"])
def test_a_trial_that_was_killed_ends_as_one_that_was_not(new_trial, tmp_path, at):
    whole, cut = new_trial(tmp_path / "a", 1), Trial(tmp_path / "b")
    list(answer_all(whole, diagnose=says_none))
    shutil.copytree(whole.folder, cut.folder)
    cut.answers.unlink()
    if at == "before the note":
        shutil.rmtree(cut.folder)
        cut.folder.mkdir()
        (cut.folder / ".trial.json.abcdefgh.part").write_text('{"sch')
    elif at == "before the bank's rename":
        cut.bank.rename(cut.folder / "bank.part")
        next((cut.folder / "bank.part").glob("case-*/*.csv")).write_text("cut sh")
    before = cut.bank.stat().st_mtime_ns if cut.bank.exists() else None
    asked = {"cases": 1, **SHORTEST} if at == "before the note" else {"cases": None, "seed": None}  # else the note has them
    begin(cut.folder, **asked, kinds=(), resume=True, workers=1)
    assert before in (None, cut.bank.stat().st_mtime_ns)
    assert (cut.digest(), cut.waiting()) == (whole.digest(), ["case-000"])
    (cut.folder / ".answers.jsonl.abcdefgh.part").write_text('{"case": "case-0')  # killed while it wrote the first
    list(answer_all(cut, diagnose=says_none))
    assert sorted(p.name for p in cut.folder.iterdir()) == sorted(p.name for p in whole.folder.iterdir())
    assert list(open_truths(cut)[0].items()) == list(open_truths(whole)[0].items())


def test_answers_that_were_damaged_are_named_and_asked_for_again(new_trial, tmp_path):
    trial = new_trial(tmp_path / "t", 2)
    list(answer_all(trial, diagnose=says_none))
    first, second = trial.answers.read_text().splitlines(keepends=True)
    trial.answers.write_text(first + second[:40])
    for reads in (lambda: list(answer_all(trial, diagnose=says_none)), lambda: open_truths(trial), trial.waiting):
        with pytest.raises(SrfError, match=r"answers.jsonl, line 2: no answer"):
            reads()
    assert trial.answers.read_text() == first + second[:40] and not trial.opened.exists()
    trial.answers.write_text(first)
    assert [a.case for a in answer_all(trial, diagnose=says_none)] == ["case-001"]
    assert trial.answers.read_text().startswith(first)


def test_a_diagnosis_is_given_the_case_and_nothing_else(new_trial, tmp_path):
    trial = new_trial(tmp_path / "t", 1)
    (found,) = answer_all(trial, diagnose=peeks)
    description = tomli.loads((trial.bank / "case-000" / "experiment.toml").read_text())
    assert found.not_identifiable == tuple(sorted(["experiment.toml", *(run["file"] for run in description["runs"])]))
    tree = ast.parse((ROOT / "srfcli" / "validation" / "blind.py").read_text())
    modules = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module}
    forbidden = ("srfcli.validation.cases", "srfcli.validation.slider", "srfcli.validation.trials", "srfcli.validation.marks")
    assert not [m for m in modules if m.startswith(forbidden)]


def test_kinds_of_a_bank():
    names = {k: {len(p) for _, p in plan_bank(40, 3, kinds=[k])} for k in PAPER_KINDS}
    assert names == {"none": {0}, "single": {1}, "pair": {2}, "outside": {1}}
    mixed = plan_bank(100, 3, kinds=["none", "outside"])
    assert (len(mixed), sum(not p for _, p in mixed)) == (100, 56)
    assert plan_bank(200, 5, kinds=PAPER_KINDS) == plan_bank(200, 5)
    with pytest.raises(SrfError, match="unknown kind of case 'sngle'"):
        plan_bank(5, 1, kinds=["sngle"])
    with pytest.raises(SrfError, match="no cases of the kind 'ageing'") as caught:
        plan_bank(5, 1, kinds=["ageing"])
    assert "--bank wide" in caught.value.hint
    assert (command.CASE_KINDS, command.BANKS) == (WIDE_KINDS, BANKS)


def test_kinds_of_a_wide_bank():
    plan = plan_bank(200, 3, bank="wide")
    counts = {kind: sum(k == kind for k, _ in plan) for kind in WIDE_KINDS}
    assert counts == {"none": 50, "single": 60, "pair": 20, "outside": 26, "ageing": 28, "one-run": 16}
    assert {names for kind, names in plan if kind in ("none", "ageing")} == {()}
    singles = [names[0] for kind, names in plan if kind == "single"]
    assert set(singles) == set(NAMES) and len({singles.count(n) for n in NAMES} | {3}) <= 2
    assert {names for kind, names in plan if kind == "pair"} <= set(possible_pairs())
    assert {kind for kind, _ in plan_bank(30, 1, bank="wide", kinds=["ageing", "one-run"])} == {"ageing", "one-run"}
    assert plan_bank(40, 3, bank="wide") == plan_bank(40, 3, bank="wide") != plan_bank(40, 4, bank="wide")


def test_what_is_lost_has_its_substitute():
    assert dict(run_processes(deadly_at_one, [0, 1, 2], workers=2, lost=lambda k: -k)) == {0: 0, 1: -1, 2: 2}


# ---- the command


def srf(*arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in arguments])
    return stop.value.code


def test_the_command_from_bank_to_report(new_trial, tmp_path, capsys):
    """Of a trial that others have answered: to diagnose a case costs minutes."""
    folder = tmp_path / "t"
    trial = new_trial(folder, 2)
    assert len(list(answer_all(trial, diagnose=says_none))) == 2
    assert srf("prove", "--out", folder, "--resume") == 0
    printed = capsys.readouterr()
    digest = trial.digest()
    assert printed.err.startswith(f"SHA-256 of the sealed truths: {digest}\n")
    kept = (folder / "report.txt").read_text()
    assert [line.split("  ")[0] for line in kept.splitlines()] == [line.split("  ")[0] for line in printed.out.splitlines()]
    for title in ("What was concealed", "Rates", "Stated confidence", "Held-out error", "CPU of a diagnosis"):
        assert title in printed.out
    kept = (folder / "report.json").read_bytes()
    assert srf("prove", "--report-only", folder, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert data == json.loads(kept) == json.loads((folder / "report.json").read_bytes())
    assert sum(row["cases"] for row in data["rows"]) == 2 and data["meta"]["digest"] == digest
    assert srf("prove", "--out", folder, "--resume") == 0
    assert srf("prove", "--out", folder, "--resume", "--cases", 5) == 2
    assert "is a trial of cases 2, not 5" in capsys.readouterr().err


def test_python_has_what_the_command_prints(new_trial, tmp_path, capsys):
    folder, stages = tmp_path / "t", []
    assert len(list(answer_all(new_trial(folder, 2), diagnose=says_none))) == 2
    found = prove(folder, resume=True, progress=lambda stage, text, total: stages.append((stage, total)))
    assert set(stages) == {("sealed", None), ("diagnosed", 0), ("truth", 2)} and not (folder / "report.json").exists()
    assert srf("prove", "--report-only", folder, "--json") == 0
    assert json.loads(capsys.readouterr().out) == json.loads(to_json(found.table))
    assert srf("prove", "--report-only", folder, "--csv") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("case,kind,concealed")
    assert printed == to_csv(found.cases) and (folder / "cases.csv").read_text() == to_csv(found.cases)
    axes = pytest.importorskip("matplotlib.figure").Figure().subplots()
    found.plot(ax=axes)
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == [f"{row[0]}: {row[1]} of {row[2]}" for row in found.more[0].rows]
    assert sum(row[1] for row in found.table.rows) == len(found.cases.rows) == 2


def test_the_command_on_the_wide_bank(tmp_path, capsys):
    """From the bank to the tables by apparatus, protocol, law, noise and field; diagnoses are cut off as soon as they begin."""
    folder = tmp_path / "t"
    kinds = ("--kind", "none", "--kind", "ageing")
    assert srf("prove", "--bank", "wide", "--cases", 3, "--seed", 7, *kinds, "--limit", 1e-4, "--out", folder) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith(f"SHA-256 of the sealed truths: {Trial(folder).digest()}\n")
    assert "By apparatus, protocol, law, noise and field: right" in printed.out
    assert all("s of CPU" in answer.failure for answer in read_answers(Trial(folder).answers).values())
    data = json.loads((folder / "report.json").read_bytes())
    assert {m["kind"] for m in data["meta"]["marks"]} == {"none", "ageing"}
    assert all(m["sigmas"] > MIN_VISIBLE_SIGMAS for m in data["meta"]["marks"] if m["kind"] == "ageing")
    found = {(r["circumstance"], r["value"]): r["cases"] for r in data["meta"]["settings"]}
    names = {"apparatus", "protocol", "friction law", "ageing law", "noise", "field"}
    assert {name: sum(n for (own, _), n in found.items() if own == name) for name, _ in found} == dict.fromkeys(names, 3)
    assert srf("prove", "--out", folder, "--resume", "--bank", "paper") == 2
    assert "is a trial of bank wide, not paper" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "a", "--kind", "ageing"], "the bank of the paper has no cases of the kind 'ageing'"),
        (["--report-only", "full", "--bank", "wide"], "--bank has no meaning"),
        ([], "neither --out nor --report-only"),
        (["--out", "a", "--report-only", "b"], "exclude each other"),
        (["--out", "a", "--json", "--csv"], "--json and --csv exclude"),
        (["--report-only", "nowhere"], "no trial"),
        (["--report-only", "full"], "no trial"),
        (["--report-only", "full", "--seed", "1"], "--seed has no meaning"),
        (["--out", "full"], "exists already"),
        (["--out", "full/notes.txt"], "exists already"),
        (["--out", "full", "--resume"], "no trial to go on with"),
        (["--out", "nowhere", "--resume"], "no trial to go on with"),
        (["--out", "a", "--unfinished"], "--unfinished ends a trial"),
        (["--out", "a", "--cases", "0"], "range"),
        (["--out", "a", "--kind", "triple"], "triple"),
        (["--out", "a", "--plugins", "nowhere"], "nowhere"),
    ],
)
def test_misuse_is_one_line_and_a_way_out(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    assert srf("prove", *arguments) == 2
    error = capsys.readouterr().err.splitlines()
    assert error[0].startswith("Error: ") and said in error[0] and error[1].startswith("Try: ") and len(error) == 2
    assert [p.name for p in tmp_path.rglob("*")] == ["full", "notes.txt"]


def test_an_interrupt_keeps_what_was_answered(tmp_path):
    """Ctrl-C while the bank is made: exit code 130, one sentence, and a folder that goes on."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    run = subprocess.Popen(
        [sys.executable, "-m", "srfcli.cli.main", "prove", "--cases", "50", "--out", str(tmp_path / "t")],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        until = time.monotonic() + 1200
        while not (tmp_path / "t" / "bank.part").exists() and time.monotonic() < until:
            time.sleep(0.05)
        run.send_signal(signal.SIGINT)
        out, err = run.communicate(timeout=1200)
    finally:
        run.kill()
    assert (run.returncode, out) == (130, ""), err
    assert err.splitlines()[-1] == f"Try: srf prove --out {tmp_path / 't'} --resume"
    assert (tmp_path / "t" / "trial.json").exists()


@pytest.mark.slow
def test_one_real_case_from_bank_to_mark(tmp_path):
    """A strong drift, told by nothing but its recordings."""
    truth = make_case(tmp_path / "case-000", 21, effects=["friction-drift"], size=0.9, rough=False)
    answer = answer_case(Task(tmp_path / "case-000", (), diagnose_case, 1800.0))
    found = grade(truth, answer, detectability_of((tmp_path / "case-000", truth)))
    assert (answer.failure, answer.verdict, found.right) == ("", "identified", True)
    assert found.error < 1.1 < found.baseline_error
