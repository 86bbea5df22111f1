"""From fits to a verdict, with fits that are made up: who is asked, what counts as nothing, and what held-out runs are worth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from srfcli.core.settings import Parameter
from srfcli.data.values import Run
from srfcli.diagnosis import verdict as module
from srfcli.diagnosis.hypotheses import neutral_values
from srfcli.diagnosis.staged_score import Score
from srfcli.diagnosis.verdict import _noise_for, conclude, interesting, undetermined
from srfcli.inference.noise import Noise
from srfcli.laws.registry import bundled_registry
from srfcli.motion.imposed import ConstantLoad, Drive

SHIPPED = bundled_registry()


def effect(name):
    return SHIPPED.get("effect", name)


def refit(*names, evidence, fine=True, rough=False):
    effects = tuple(effect(n) for n in names)
    return SimpleNamespace(
        name="+".join(names) or "none", evidence=evidence, rough=rough, fit=SimpleNamespace(point=None),
        hypothesis=SimpleNamespace(effects=effects, reported=tuple(e.reported for e in effects)),
        adequacy=SimpleNamespace(fine=fine, rms_over_noise=1.0 if fine else 1.05, p_value=0.5 if fine else 1e-9),
    )  # fmt: skip


def score(name, detectable):
    return Score(effect(name), 1.0, {}, 0.0, 1.0, 0.5, detectable, np.array([1.0, 0.0]))


def search(*refits, scored=None, late=()):
    """A search that has ended; `late` are the scores that it finds when it is asked for those that it has not."""
    found = SimpleNamespace(
        ranked=lambda: sorted(refits, key=lambda r: -r.evidence), tried={(r.name, r.rough): r for r in refits},
        scored=dict(scored or {}), experiment=SimpleNamespace(runs=()), registry=SHIPPED, effects=None, excluded=[],
        noise={}, trend=None, asked=[],
    )  # fmt: skip
    found.score = lambda baseline, candidates: found.asked.append(baseline.name) or list(late)
    return found


@pytest.fixture(autouse=True)
def no_recording(monkeypatch):
    monkeypatch.setattr(module, "applicable", lambda *_: ([], []))
    monkeypatch.setattr(module, "likeliest_bump", lambda point: None)


def concluded(found):
    return conclude(found, SimpleNamespace(runs=()))


SEEN = {("none", False): [score("viscous-drag", 1e-9)]}
HIDDEN = [score("viscous-drag", 1e9), score("linker-dieterich", 1e9)]


@pytest.mark.parametrize(
    ("evidence", "said"), [(98.0, ("identified", ("viscous-drag",))), (90.0, ("unknown", ()))], ids=["hardly", "far"]
)
def test_one_hypothesis_that_is_fine_is_taken_where_one_that_is_not_is_hardly_ahead_of_it(evidence, said):
    found = concluded(
        search(
            refit("slip-evolution", evidence=100.0, fine=False),
            refit("viscous-drag", evidence=evidence),
            refit(evidence=0.0, fine=False),
            scored=SEEN,
        )
    )
    assert (found.verdict, found.effects) == said


def test_a_further_effect_that_gains_little_is_not_named():
    pair = refit("viscous-drag", "slip-evolution", evidence=103.0)
    found = concluded(search(pair, refit("viscous-drag", evidence=100.0), refit(evidence=0.0, fine=False), scored=SEEN))
    assert (found.verdict, found.effects) == ("identified", ("viscous-drag",))


@pytest.mark.parametrize(("late", "verdict"), [(HIDDEN, "inconclusive"), (SEEN["none", False], "none")])
def test_nothing_is_said_to_be_missing_only_after_asking_what_could_have_been_seen(late, verdict):
    """The baseline that is left over stands on a rough track, around which nothing was scored yet."""
    found = search(
        refit(evidence=99.0, rough=True), refit("viscous-drag", evidence=100.0), refit(evidence=0.0, fine=False),
        scored={("none", False): []}, late=late,
    )  # fmt: skip
    answer = concluded(found)
    assert (found.asked, answer.verdict, len(answer.scores)) == (["none"], verdict, len(late))


@pytest.mark.parametrize("late", [HIDDEN, SEEN["none", False]], ids=["inconclusive", "none"])
def test_a_bump_is_something_and_no_merit_of_held_out_runs(late, monkeypatch):
    bump = SimpleNamespace(p_value=1e-9, place=12.0, width=0.8, height=1e-3)
    monkeypatch.setattr(module, "likeliest_bump", lambda point: bump)
    answer = concluded(search(refit(evidence=99.0, rough=True), late=late))
    assert (answer.verdict, answer.ungated) == ("unknown", "unknown")
    assert "bump at 12.0 um" in answer.reasons[-1]


def run(name, observable):
    t = 0.004 * np.arange(200)
    return Run(name, Path("x"), False, 0.0, "steady", t, np.zeros(t.size), observable, np.ones(t.size, bool),
               Drive.steps([(0.0, 10.0)]), ConstantLoad(7.0), 0.21, None, 0.0, ())  # fmt: skip


@pytest.mark.parametrize(("observable", "level"), [("elongation", 0.02), ("force", 0.004), ("friction", 0.02)])
def test_the_noise_of_a_held_out_run_is_that_of_the_same_observable(observable, level):
    """Where there is none, that of any."""
    fitted = [run("a", "elongation"), run("b", "force")]
    found = SimpleNamespace(
        experiment=SimpleNamespace(runs=fitted), noise={"a": Noise(0.02, (), 0.02), "b": Noise(0.004, (), 0.004)}
    )
    assert _noise_for(found, run("c", observable)).level == level


def test_the_scores_of_what_was_found_are_not_asked_for_anew():
    found = search(refit("viscous-drag", evidence=100.0, rough=True), refit(evidence=0.0, fine=False), scored=SEEN)
    found.tried["none", True] = refit(evidence=-5.0, fine=False, rough=True)
    answer = concluded(found)
    assert (found.asked, answer.verdict, answer.scores) == ([], "identified", tuple(SEEN["none", False]))


def test_an_interesting_size_is_in_base_units():
    """A user's lag, 3 ms by default and nothing at 1 ms, is interesting from 0.002 s on: sizes that can be seen are in s."""
    own = effect("sensor-lag")
    (name,) = own.sizes
    in_ms = replace(own, parameters=(Parameter(name, 3.0, "ms", 0.0, 100.0),), neutral=((name, 1.0),))
    assert interesting(replace(score("sensor-lag", 1.0), effect=in_ms)) == pytest.approx(0.002)
    assert neutral_values(in_ms) == {name: pytest.approx(0.001)}


@pytest.mark.parametrize(("error", "nothing"), [(1e-9, False), (3e-7, True)])
@pytest.mark.parametrize(("name", "size"), [("inertia", "M"), ("interface-compliance", "lambda")])
def test_what_is_built_in_has_to_stand_out_from_nothing(name, size, error, nothing):
    """A mass of 4 kg with an error of 1200 was named beside a stiffness: it came with another roughness of the track."""
    found = refit(name, "viscous-drag", evidence=0.0)
    names = ("A", size, "c")
    found.fit = SimpleNamespace(
        problem=SimpleNamespace(names=names, model=SimpleNamespace(names=names)), covariance=np.diag([1.0, error**2, 1.0]),
        values={"A": 0.01, size: 4e-7, "c": 1e-5},
    )  # fmt: skip
    assert undetermined(found) is nothing
    assert undetermined(refit("viscous-drag", evidence=0.0)) is False  # a drag's error says nothing here
