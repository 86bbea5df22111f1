"""Which effects a search may find in an experiment, and why others cannot be seen in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from srfcli.codegen.c_source import compiler
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.hypotheses import Hypothesis, applicable
from srfcli.diagnosis.search import ModelSearch
from srfcli.diagnosis.verdict import held_out
from srfcli.laws.registry import bundled_registry, load_registry
from srfcli.validation.cases import case_files
from srfcli.validation.gauge import Gauge, read_gauge
from srfcli.validation.slider import Physics, Plan, move

SHIPPED = bundled_registry()
OF_THE_MODULATION = {"load-transmission", "load-distortion"}


def experiment_of(folder, *plans, readings=None, base=None):
    readings = readings or {p: np.full(p.times().size, 15.0) for p in plans}  # what was recorded need not matter
    for name, text in case_files("small", base or Physics(), readings).items():
        (folder / name).write_text(text)
    return read_experiment(folder, registry=SHIPPED)


@pytest.mark.parametrize(
    ("plan", "reason"),
    [
        (Plan("held", ((1, 20), (1, 60)), 5.0, 0.002), "the load is constant"),
        (Plan("steps", ((2, 20),), 5.0, 0.002, steps=((0.7, 1.0),)), "no run has a modulated load"),
        (Plan("strong", ((2, 20),), 5.0, 0.002, eps=0.1, f=80.0), None),
    ],
    ids=lambda x: x.name if isinstance(x, Plan) else "",
)
def test_effects_of_the_modulation_need_one(plan, reason, tmp_path):
    found, excluded = applicable(SHIPPED, experiment_of(tmp_path, plan))
    said = {e.effect: e.reason for e in excluded}
    for name in OF_THE_MODULATION:
        assert said.get(name) == reason
        assert (name in {e.name for e in found}) is (reason is None)


def test_an_effect_whose_parameter_has_the_name_of_another_s_is_not_dropped_without_a_word(tmp_path):
    experiment = experiment_of(tmp_path, Plan("strong", ((2, 20),), 5.0, 0.002, eps=0.1, f=80.0))
    choice = replace(experiment.choice, effects=("load-distortion",))
    found, excluded = applicable(SHIPPED, replace(experiment, choice=choice))
    said = {e.effect: e.reason for e in excluded}
    for name in ("track-topography", "drive-ripple"):
        assert said[name] == "its parameter amplitude has the name of one of load-distortion"
    assert "load-distortion" not in said and "load-distortion" not in {e.name for e in found}


OWN = """format = "srf-law/1"
kind = "effect"
name = "felt"
about = "A share of the load's change is felt twice, and another of its modulation"
W = "W + a*(W - W0)*{of}"
constitutive = false

[parameters]
a = {{ default = 0.1, neutral = 0.0, unit = "1", bounds = [-1.0, 1.0], about = "share" }}
"""


@pytest.mark.parametrize(("of", "seen"), [("(1 + modulated)", True), ("(1 - eps)", True), ("modulated", False)])
def test_an_effect_that_a_modulation_only_adds_to_is_seen_without_one(of, seen, tmp_path):
    experiment = experiment_of(tmp_path, Plan("steps", ((2, 20),), 5.0, 0.002, steps=((0.7, 1.0),)))
    (tmp_path / "felt.toml").write_text(OWN.format(of=of))
    registry = load_registry((tmp_path,), user=False, entry_points=False)
    found, _ = applicable(registry, experiment, ["felt"])
    assert bool(found) is seen
    choice = replace(experiment.choice, effects=(str(tmp_path / "felt.toml"),))
    assert applicable(registry, replace(experiment, choice=choice), ["felt"]) == ([], [])  # the baseline has it


@pytest.mark.parametrize("rigid", [True, False])
def test_what_one_effect_brings_another_may_need(rigid, tmp_path):
    """An interface may stiffen otherwise than with the load where it is elastic, or where that is what is missing."""
    plan = Plan("strong", ((2, 20),), 5.0, 0.002, eps=0.1, f=80.0)
    experiment = experiment_of(tmp_path, plan, base=Physics(rigid=rigid))
    candidates, _ = applicable(SHIPPED, experiment)
    known = {e.name: e for e in candidates}
    assert "stiffness-exponent" in known and ("interface-compliance" in known) is rigid
    names = Hypothesis().model(SHIPPED, experiment).names
    assert set(known["stiffness-exponent"].needs).issubset(names) is not rigid
    if rigid:
        both = Hypothesis((known["interface-compliance"], known["stiffness-exponent"]))
        assert {"lambda", "n"} <= set(both.model(SHIPPED, experiment).names)


@pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here")
def test_a_held_out_run_has_a_trend_of_its_own(tmp_path):
    """Where drifts are fitted, that of a held-out run is: it says nothing against a model."""
    rng, drift = np.random.default_rng(3), 0.08  # um/s: four times the noise each second
    plans = (Plan("up", ((0.6, 10), (0.6, 40)), 3.0, 0.002), Plan("down", ((0.6, 40), (0.8, 15)), 3.0, 0.002, holdout=True))
    readings = {p: read_gauge(move(Physics(), p).u + drift * p.times(), Gauge(), rng) for p in plans}
    whole = experiment_of(tmp_path, *plans, readings=readings)
    search = ModelSearch(SHIPPED, replace(whole, runs=tuple(r for r in whole.runs if not r.holdout)), trend="time")
    baseline = search.fit(None)
    (held,) = held_out(baseline, baseline, whole)
    assert np.sqrt(np.mean(held.augmented.white**2)) < 1.1
