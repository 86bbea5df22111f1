"""From what was found to a verdict: what counts as nothing, as one answer, and what held-out runs are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from srfcli.core.settings import Parameter
from srfcli.diagnosis.hypotheses import Excluded, Hypothesis, neutral_values
from srfcli.diagnosis.scores import Score
from srfcli.diagnosis.verdict import (
    CALIBRATION_TEMPERATURE,
    PROB_REGISTERED_IF_UNKNOWN,
    PROB_UNREGISTERED_IF_PASSED,
    Conclusion,
    Model,
    PredictiveScore,
    judge,
    relevant_effect_size,
)
from srfcli.laws.registry import bundled_registry

SHIPPED = bundled_registry()
SEEN, HIDDEN = 1e-9, 1e9  # sizes that could have been seen


def score(name: str, detectable: float, direction: Sequence[float] = (1.0, 0.0)) -> Score:
    return Score(SHIPPED.get("effect", name), 1.0, {}, 0.0, 1.0, detectable, 0.5, np.array(direction))


def model(*names: str, evidence: float, passes: bool = True, run: str = "", **known: Any) -> Model:
    effects = tuple(replace(SHIPPED.get("effect", n), run=run) for n in names)
    return Model(Hypothesis(effects), evidence, () if passes else ("a stretch of steps is off",), **known)


def held(rms: float, gain: float = 1.0, size: int = 400, **known: Any) -> PredictiveScore:
    return PredictiveScore("again", gain, rms, size, **known)


def concluded(*models: Model, **found: Any) -> Conclusion:
    return judge(sorted(models, key=lambda m: -m.evidence), **found)


LOST = model(evidence=0.0, passes=False)
DRAG = model("viscous-drag", evidence=100.0)


@pytest.mark.parametrize(
    ("evidence", "said"), [(98.0, ("identified", ("viscous-drag",))), (90.0, ("unknown", ()))], ids=["hardly", "far"]
)
def test_a_model_that_passes_is_taken_where_one_that_does_not_is_hardly_ahead_of_it(evidence, said):
    found = concluded(model("slip-evolution", evidence=100.0, passes=False), model("viscous-drag", evidence=evidence), LOST)
    assert (found.verdict, found.effects) == said
    best = "viscous-drag passes every test" if said[1] else "slip-evolution: a stretch of steps is off"
    assert found.reasons[0] == best
    assert (found.confidence["viscous-drag"] > 0.9) is bool(said[1])


@pytest.mark.parametrize("ended", [None, 150.0])
def test_a_search_that_its_budget_ended_says_so(ended):
    found = concluded(DRAG, LOST, ended=ended)
    assert any("budget of 150 s" in r for r in found.reasons) is (ended is not None)


def test_nothing_is_said_to_be_missing_only_where_all_that_promised_was_fitted():
    scores = [score("viscous-drag", SEEN)]
    assert concluded(model(evidence=0.0), scores=scores).verdict == "none"
    assert concluded(model(evidence=0.0), scores=scores, ended=150.0).verdict == "inconclusive"


def test_a_further_effect_that_gains_little_is_not_named():
    found = concluded(model("viscous-drag", "slip-evolution", evidence=103.0), DRAG, LOST)
    assert (found.verdict, found.effects) == ("identified", ("viscous-drag",))


def test_models_that_do_equally_well_are_all_named():
    found = concluded(model("slip-evolution", evidence=101.0), model("viscous-drag", evidence=99.0), LOST)
    assert (found.verdict, set(found.effects)) == ("ambiguous", {"viscous-drag", "slip-evolution"})
    assert found.confidence["slip-evolution"] / found.confidence["viscous-drag"] == pytest.approx(
        np.exp(2.0 / CALIBRATION_TEMPERATURE)
    )
    assert sum(found.confidence.values()) == pytest.approx(1)


@pytest.mark.parametrize(
    ("sizes", "verdict"), [((SEEN, SEEN), "none"), ((SEEN, HIDDEN), "none"), ((HIDDEN, HIDDEN), "inconclusive")]
)
def test_nothing_is_missing_only_where_it_could_have_been_seen(sizes, verdict):
    scores = [score(n, size) for n, size in zip(("viscous-drag", "linker-dieterich"), sizes, strict=True)]
    found = concluded(model(evidence=0.0), scores=scores)
    assert found.verdict == verdict and not found.effects and found.reasons[0] == "the baseline passes every test"
    assert found.detectable == {"viscous-drag": sizes[0], "linker-dieterich": sizes[1]}


@pytest.mark.parametrize(
    ("runs", "verdict"),
    [
        ([held(1.0)], "identified"),
        ([held(1.3)], "unknown"),
        ([held(1.0, size=4000), held(1.2)], "unknown"),
        ([held(1.3, size=50)], "identified"),
        ([held(1.0, gain=-5.0)], "identified"),
        ([held(1.0, gain=-7.0)], "unknown"),
        ([held(1.0, gain=-7.0), held(1.0, gain=5.0)], "identified"),
        ([held(1.0, followed=False)], "unknown"),
        ([held(1.0, loud="the gauge's noise is 2.00 times what the recording shows")], "unknown"),
    ],
    ids=[
        "predicted",
        "not predicted",
        "not predicted in one",
        "too short to tell",
        "as well as by the baseline",
        "worse",
        "well enough in all",
        "not followed",
        "loud",
    ],
)
def test_held_out_runs_refuse(runs, verdict):
    found = concluded(DRAG, LOST, held=runs)
    assert (found.verdict, found.ungated) == (verdict, "identified")
    assert ("held-out" in found.reasons[-1]) is (verdict == "unknown")


@pytest.mark.parametrize(
    ("gains", "excess", "said"),
    [((1.0, 1.0), 0.9, ""), ((1.0, 1.0), 1.1, "table has chi2 90.0"), ((-4.0, -3.0), 0.9, "worse than by the baseline")],
)
def test_held_out_critical_loads_refuse(gains, excess, said):
    loads = [PredictiveScore("table", gains[1], 3.0, 10, excess=excess)]
    found = concluded(DRAG, LOST, held=[held(1.0, gain=gains[0])], loads=loads)
    assert (found.verdict, found.ungated) == ("unknown" if said else "identified", "identified")
    assert said in found.reasons[-1]


def test_a_baseline_that_passes_is_refused_by_held_out_runs_too():
    assert concluded(model(evidence=0.0), scores=[score("viscous-drag", SEEN)], held=[held(2.0)]).verdict == "unknown"


def test_a_model_far_off_has_no_share_of_the_confidence():
    found = concluded(replace(DRAG, against=("innovations are correlated",)), LOST)
    assert found.verdict == "unknown" and found.confidence["viscous-drag"] == 0.0
    assert found.confidence["unknown"] == pytest.approx(1 - PROB_REGISTERED_IF_UNKNOWN) and found.confidence[
        "missed"
    ] == pytest.approx(PROB_REGISTERED_IF_UNKNOWN)
    sure = concluded(DRAG, LOST)
    assert sure.confidence["unknown"] == pytest.approx(PROB_UNREGISTERED_IF_PASSED, rel=0.05)


def test_effects_of_one_signal_are_one_class():
    scores = [
        score("viscous-drag", SEEN), score("slip-evolution", SEEN, (0.99, 0.1411)), score("friction-drift", SEEN, (0.0, 1.0)),
    ]  # fmt: skip
    assert concluded(DRAG, LOST, scores=scores).equivalent == (("viscous-drag", "slip-evolution"),)
    also = [*scores, score("sensor-lag", SEEN, (0.0, 1.0))]  # like a drift, of which nothing is said
    assert concluded(DRAG, LOST, scores=also).equivalent == (("viscous-drag", "slip-evolution"),)
    apart = concluded(DRAG, model("slip-evolution", evidence=90.0), LOST, scores=scores)  # both were fitted
    assert not apart.equivalent


def test_an_effect_that_parameters_absorb_is_not_identifiable():
    lost = replace(score("viscous-drag", HIDDEN), tolerance=1e-4)
    found = concluded(model(evidence=0.0), scores=[lost, score("friction-drift", SEEN), score("sensor-lag", HIDDEN)])
    assert [x.effect for x in found.not_identifiable] == ["viscous-drag"]
    assert "99.99 %" in found.not_identifiable[0].reason
    assert not concluded(DRAG, LOST, scores=[lost]).not_identifiable  # it is found all the same


def test_what_could_not_be_fitted_at_all_is_not_identifiable():
    """One attempt may fail and another not."""
    failed = [Excluded("viscous-drag", "it cannot be followed"), Excluded("sensor-lag", "it cannot be followed")]
    assert concluded(DRAG, LOST, excluded=failed).not_identifiable == (failed[1],)


def test_a_remark_is_told_under_its_verdicts():
    remarks = [("under unknown", ("unknown",)), ("in one run", ("unknown", "in one run")), ("identified", ("identified",))]
    unknown, whole, alone = (
        concluded(m, LOST, remarks=remarks).reasons
        for m in (replace(DRAG, against=("loud",)), DRAG, model("viscous-drag", evidence=100.0, run="steps"))
    )
    assert unknown == ("viscous-drag: loud", "under unknown", "in one run")
    assert whole[1:] == ("identified",) and alone[1:] == ("in one run", "identified")


def test_an_interesting_size_is_in_base_units():
    """A user's lag, 3 ms by default and nothing at 1 ms, is interesting from 0.002 s on: sizes that can be seen are in s."""
    own = SHIPPED.get("effect", "sensor-lag")
    (name,) = own.sizes
    in_ms = replace(own, parameters=(Parameter(name, 3.0, "ms", 0.0, 100.0),), neutral=((name, 1.0),))
    assert relevant_effect_size(replace(score("sensor-lag", 1.0), effect=in_ms)) == pytest.approx(0.002)
    assert neutral_values(in_ms) == {name: pytest.approx(0.001)}


@pytest.mark.parametrize(
    ("apart", "evidence", "said"),
    [
        (1e-3, 97.0, ("identified", ("ruina",))),
        (0.5, 97.0, ("ambiguous", ("ruina", "slip-evolution"))),
        (1e-3, 104.0, ("ambiguous", ("slip-evolution", "ruina"))),
    ],
)
def test_an_effect_that_became_another_ageing_law_gives_way_to_it(apart, evidence, said):
    """Where both leave the same innovations; where they do not, or more is to be said for the effect, either may be it."""
    white = np.where(np.arange(400) % 2, 1.0, -1.0)
    law = Model(Hypothesis((), "ruina"), 100.0, innovations=(white,), parameters=5)
    found = concluded(law, model("slip-evolution", evidence=evidence, innovations=(white + apart,), parameters=6), LOST)
    assert (found.verdict, found.effects) == said
    assert sum(found.confidence.values()) == pytest.approx(1)
    assert found.became == ({"slip-evolution": "ruina"} if len(said[1]) == 1 else {})


@pytest.mark.parametrize(
    ("told", "said"), [(0.0, ("ambiguous", ("slip-evolution", "viscous-drag"))), (20.0, ("identified", ("viscous-drag",)))]
)
def test_held_out_runs_choose_between_models_that_fit_equally_well(told, said):
    found = concluded(
        model("slip-evolution", evidence=100.0, held_out=-30.0), model("viscous-drag", evidence=98.0, held_out=told - 30.0), LOST
    )
    assert (found.verdict, found.effects) == said
    assert (
        found.confidence["viscous-drag"] > 0.99 * (1 - PROB_UNREGISTERED_IF_PASSED)
        if told
        else found.confidence["slip-evolution"] > 0.5
    )


def test_models_that_held_out_runs_do_not_tell_apart_where_none_is_followed_are_told_apart_by_the_rest():
    found = concluded(
        model("slip-evolution", evidence=100.0, held_out=-np.inf), model("viscous-drag", evidence=90.0, held_out=-np.inf), LOST
    )
    assert (found.verdict, found.effects) == ("identified", ("slip-evolution",))
    assert found.confidence["slip-evolution"] == pytest.approx(
        (1 - PROB_UNREGISTERED_IF_PASSED) / (1 + np.exp(-10.0 / CALIBRATION_TEMPERATURE)), rel=1e-3
    )


def test_held_out_runs_may_choose_a_model_that_fits_worse():
    found = concluded(model("slip-evolution", evidence=100.0, held_out=-40.0), model("viscous-drag", evidence=80.0), LOST)
    assert (found.verdict, found.effects) == ("identified", ("viscous-drag",))
