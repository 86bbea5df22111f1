"""From fits to a verdict, with fits that are made up: what counts as nothing, as one answer, and what held-out runs are worth."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from srfcli.core.settings import Parameter
from srfcli.diagnosis import verdict as module
from srfcli.diagnosis.hypotheses import Hypothesis, neutral_values
from srfcli.diagnosis.scores import Score
from srfcli.diagnosis.verdict import HELD_OUT_RMS, MISSED, UNEXPLAINED, conclude, interesting
from srfcli.laws.registry import bundled_registry

SHIPPED = bundled_registry()
SEEN, HIDDEN = 1e-9, 1e9  # sizes that could have been seen


def score(name, detectable, direction=(1.0, 0.0)):
    return Score(SHIPPED.get("effect", name), 1.0, {}, 0.0, 1.0, detectable, 0.5, np.array(direction))


def fitted(*names, evidence, passes=True, scores=(), told=0.0):
    hypothesis = Hypothesis(tuple(SHIPPED.get("effect", n) for n in names))
    return SimpleNamespace(
        hypothesis=hypothesis, name=hypothesis.name, evidence=evidence, passes=passes,
        against=() if passes else ("a stretch of steps is off",), singles=scores, told=told, fit=None, shared=None,
    )  # fmt: skip


def held(rms, gain=1.0, whole=True):
    white = rms * np.where(np.arange(400) % 2, 1.0, -1.0)
    told = SimpleNamespace(rms=rms)
    return SimpleNamespace(augmented=SimpleNamespace(white=white, whole=whole), gain=gain, predictive=told, loud="")


@pytest.fixture
def concluded(monkeypatch):
    """Return the verdict on a search that ended with some fits; `held` are the held-out runs."""

    def verdict(*fits, held=(), cut_short=False):
        monkeypatch.setattr(module, "held_out", lambda *_: tuple(held))
        monkeypatch.setattr(module, "predictive", lambda fit, whole: fit.told)
        monkeypatch.setattr(module, "on_the_track_of", lambda best, baseline: baseline)
        monkeypatch.setattr(module, "at_bounds", lambda best: [])
        monkeypatch.setattr(module, "uneven_noise", lambda fit: [])
        monkeypatch.setattr(module, "unsteady_start", lambda search, best: [])
        ranked = sorted(fits, key=lambda f: -f.evidence)
        baseline = next(f for f in fits if f.name == "none")
        monkeypatch.setattr(module, "not_the_same", lambda baseline, best: [])
        whole = SimpleNamespace(runs=(), thresholds=(), vary=())
        search = SimpleNamespace(
            ranked=lambda: ranked, baseline=baseline, excluded=[], cut_short=cut_short, budget=150.0, whole=whole, on_request=[]
        )
        return conclude(search, whole)

    return verdict


LOST = fitted(evidence=0.0, passes=False)


@pytest.mark.parametrize(
    ("evidence", "said"), [(98.0, ("identified", ("viscous-drag",))), (90.0, ("unknown", ()))], ids=["hardly", "far"]
)
def test_a_model_that_passes_is_taken_where_one_that_does_not_is_hardly_ahead_of_it(concluded, evidence, said):
    found = concluded(fitted("slip-evolution", evidence=100.0, passes=False), fitted("viscous-drag", evidence=evidence), LOST)
    assert (found.verdict, found.effects) == said
    assert found.final is (found.best if said[1] else found.ranked[0])


@pytest.mark.parametrize("cut_short", [False, True])
def test_a_search_that_its_budget_ended_says_so(concluded, cut_short):
    found = concluded(fitted("viscous-drag", evidence=100.0), LOST, cut_short=cut_short)
    assert any("budget of 150 s" in r for r in found.reasons) is cut_short


def test_nothing_is_said_to_be_missing_only_where_all_that_promised_was_fitted(concluded):
    scores = [score("viscous-drag", SEEN)]
    assert concluded(fitted(evidence=0.0, scores=scores)).verdict == "none"
    assert concluded(fitted(evidence=0.0, scores=scores), cut_short=True).verdict == "inconclusive"


def test_a_further_effect_that_gains_little_is_not_named(concluded):
    pair = fitted("viscous-drag", "slip-evolution", evidence=103.0)
    found = concluded(pair, fitted("viscous-drag", evidence=100.0), LOST)
    assert (found.verdict, found.effects) == ("identified", ("viscous-drag",))


def test_models_that_do_equally_well_are_all_named(concluded):
    found = concluded(fitted("slip-evolution", evidence=101.0), fitted("viscous-drag", evidence=99.0), LOST)
    assert (found.verdict, set(found.effects)) == ("ambiguous", {"viscous-drag", "slip-evolution"})
    assert found.confidence["slip-evolution"] / found.confidence["viscous-drag"] == pytest.approx(np.exp(2.0))
    assert sum(found.confidence.values()) == pytest.approx(1)


@pytest.mark.parametrize(
    ("sizes", "verdict"), [((SEEN, SEEN), "none"), ((SEEN, HIDDEN), "none"), ((HIDDEN, HIDDEN), "inconclusive")]
)
def test_nothing_is_missing_only_where_it_could_have_been_seen(concluded, sizes, verdict):
    scores = [score(n, size) for n, size in zip(("viscous-drag", "linker-dieterich"), sizes, strict=True)]
    found = concluded(fitted(evidence=0.0, scores=scores))
    assert found.verdict == verdict and found.final is found.baseline
    assert found.detectable == {"viscous-drag": sizes[0], "linker-dieterich": sizes[1]}


@pytest.mark.parametrize(
    ("runs", "verdict"),
    [
        ([held(1.0)], "identified"),
        ([held(1.0), held(1.5 * HELD_OUT_RMS)], "unknown"),
        ([held(1.0, gain=-5.0)], "identified"),
        ([held(1.0, gain=-7.0)], "unknown"),
        ([held(1.0, gain=-7.0), held(1.0, gain=5.0)], "identified"),
        ([held(1.0, whole=False)], "unknown"),
    ],
    ids=["predicted", "not predicted", "as well as by the baseline", "worse than by it", "well enough in all", "not followed"],
)
def test_held_out_runs_refuse(concluded, runs, verdict):
    found = concluded(fitted("viscous-drag", evidence=100.0), LOST, held=runs)
    assert (found.verdict, found.ungated) == (verdict, "identified")
    assert ("held-out" in found.reasons[-1]) is (verdict == "unknown")


def test_a_baseline_that_passes_is_refused_by_held_out_runs_too(concluded):
    assert concluded(fitted(evidence=0.0, scores=[score("viscous-drag", SEEN)]), held=[held(2.0)]).verdict == "unknown"


def test_a_model_far_off_has_no_share_of_the_confidence(concluded):
    found = concluded(fitted("viscous-drag", evidence=100.0, passes=False), LOST)
    assert found.verdict == "unknown" and found.confidence["viscous-drag"] == 0.0
    assert found.confidence["unknown"] == pytest.approx(1 - MISSED) and found.confidence["missed"] == pytest.approx(MISSED)
    sure = concluded(fitted("viscous-drag", evidence=100.0), LOST)
    assert sure.confidence["unknown"] == pytest.approx(UNEXPLAINED, rel=0.05)


def test_effects_of_one_signal_are_one_class(concluded):
    scores = [
        score("viscous-drag", SEEN), score("slip-evolution", SEEN, (0.99, 0.1411)), score("friction-drift", SEEN, (0.0, 1.0)),
    ]  # fmt: skip
    baseline = fitted(evidence=0.0, passes=False, scores=scores)
    found = concluded(fitted("viscous-drag", evidence=100.0), baseline)
    assert found.equivalent == (("viscous-drag", "slip-evolution"),)


def test_an_effect_that_parameters_absorb_is_not_identifiable(concluded):
    lost = replace(score("viscous-drag", HIDDEN), tolerance=1e-4)
    found = concluded(fitted(evidence=0.0, scores=[lost, score("friction-drift", SEEN)]))
    assert [x.effect for x in found.not_identifiable] == ["viscous-drag"]
    assert "99.99 %" in found.not_identifiable[0].reason
    baseline = fitted(evidence=0.0, passes=False, scores=[lost])
    assert not concluded(fitted("viscous-drag", evidence=100.0), baseline).not_identifiable  # it is found all the same


def test_an_interesting_size_is_in_base_units():
    """A user's lag, 3 ms by default and nothing at 1 ms, is interesting from 0.002 s on: sizes that can be seen are in s."""
    own = SHIPPED.get("effect", "sensor-lag")
    (name,) = own.sizes
    in_ms = replace(own, parameters=(Parameter(name, 3.0, "ms", 0.0, 100.0),), neutral=((name, 1.0),))
    assert interesting(replace(score("sensor-lag", 1.0), effect=in_ms)) == pytest.approx(0.002)
    assert neutral_values(in_ms) == {name: pytest.approx(0.001)}


@pytest.mark.parametrize(
    ("apart", "said"), [(1e-3, ("identified", ("ruina",))), (0.5, ("ambiguous", ("ruina", "slip-evolution")))]
)
def test_an_effect_that_became_another_ageing_law_gives_way_to_it(concluded, apart, said):
    """Where both leave the same innovations; where they do not, either may be it."""
    law, effect = fitted(evidence=100.0), fitted("slip-evolution", evidence=97.0)
    law.hypothesis = Hypothesis((), "ruina")
    law.name = law.hypothesis.name
    white = np.where(np.arange(400) % 2, 1.0, -1.0)
    for fit, off in ((law, 0.0), (effect, apart)):
        problem = SimpleNamespace(model=SimpleNamespace(parameters=[0] * (5 if fit is law else 6)))
        fit.fit = SimpleNamespace(
            maximum=SimpleNamespace(point=SimpleNamespace(runs=[SimpleNamespace(white=white + off)])),
            likelihood=SimpleNamespace(problem=problem),
        )
    found = concluded(law, effect, LOST)
    assert (found.verdict, found.effects) == said


@pytest.mark.parametrize(
    ("told", "said"), [(0.0, ("ambiguous", ("slip-evolution", "viscous-drag"))), (20.0, ("identified", ("viscous-drag",)))]
)
def test_held_out_runs_choose_between_models_that_fit_equally_well(concluded, told, said):
    found = concluded(
        fitted("slip-evolution", evidence=100.0, told=-30.0), fitted("viscous-drag", evidence=98.0, told=told - 30.0), LOST
    )
    assert (found.verdict, found.effects) == said
    assert found.confidence["viscous-drag"] > 0.99 * (1 - UNEXPLAINED) if told else found.confidence["slip-evolution"] > 0.5


def test_models_that_held_out_runs_do_not_tell_apart_where_none_is_followed_are_told_apart_by_the_rest(concluded):
    found = concluded(
        fitted("slip-evolution", evidence=100.0, told=-np.inf), fitted("viscous-drag", evidence=90.0, told=-np.inf), LOST
    )
    assert (found.verdict, found.effects) == ("identified", ("slip-evolution",))
