"""The search's own judgement: two effects scored together, and evidence of a fit that is lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from srfcli.codegen.c_source import compiler
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.hypotheses import Hypothesis, applicable
from srfcli.diagnosis.staged_score import pair_scores, scores
from srfcli.diagnosis.staged_search import WORTH, Search, alike_on_rough_tracks, contest
from srfcli.inference.noise import stretches, whiten
from srfcli.inference.random_field import Roughness, Tracks, fit_latent, tracks_for
from srfcli.laws.registry import bundled_registry
from srfcli.validation.cases import Gauge, case_files, read_gauge
from srfcli.validation.slider import Physics, Plan, move

SHIPPED = bundled_registry()
PLANS = (
    Plan("steps", ((0.6, 4), (0.4, 60), (0.6, 8)), 3.0, 0.002),
    Plan("stickslip", ((0.3, 12), (3, 8)), 9.2, 0.004),
)
PAIR = ("sensor-lag", "viscous-drag")
pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here")


@pytest.fixture(scope="module")
def search(tmp_path_factory):
    """A search whose baseline is fitted to a record of a slider with a little drag, read by a gauge that lags a little."""
    folder, rng, base = tmp_path_factory.mktemp("pair"), np.random.default_rng(5), Physics()
    real = replace(base, drag=4e-6, lag=0.002)
    for name, text in case_files("small", base, {q: read_gauge(move(real, q).u, Gauge(), rng) for q in PLANS}).items():
        (folder / name).write_text(text)
    found = Search(SHIPPED, read_experiment(folder, registry=SHIPPED))
    found.baseline()
    return found


def effects(*names):
    return [SHIPPED.get("effect", n) for n in names]


def gain_by_differences(search, fitted, added):
    """Return the gain that least squares over the parameters and these effects' sizes promises, from differences."""
    problem = Hypothesis(tuple(added)).problem(SHIPPED, search.experiment, rough=False, at=fitted.values)
    problem = replace(problem, rtol=1e-10)
    neutral, n = problem.start, fitted.point.theta.size
    steps = np.where(np.arange(neutral.size) < n, 1e-6 * np.abs(neutral), 1e-6 * (problem.upper - problem.lower))
    rows = []
    for run in problem.runs:
        here = problem.predicted(run, neutral, slopes=False).y
        J = []
        for i, step in enumerate(steps):
            moved = neutral.copy()
            moved[i] += step
            J.append((problem.predicted(run, moved, slopes=False).y - here) / step)
        own = fitted.noise[run.name]
        rows.append(whiten(own, np.column_stack([*J, run.observed - here]), stretches(run.t, run.used)))
    table = np.concatenate(rows)
    table[:, :-1] /= np.linalg.norm(table[:, :-1], axis=0)

    def left(columns):
        X, r = table[:, columns], table[:, -1]
        return float(np.sum((r - X @ np.linalg.lstsq(X, r, rcond=None)[0]) ** 2))

    return 0.5 * (left(list(range(n))) - left(list(range(neutral.size))))


def test_a_pair_s_gain_is_that_of_least_squares_over_both_sizes(search):
    fitted, pair = search.tried["none", False].fit, effects(*PAIR)
    (found,) = pair_scores(SHIPPED, fitted.problem.experiment, fitted, pair)
    assert found.gain == pytest.approx(gain_by_differences(search, fitted, pair), rel=0.05)


def test_the_two_that_were_concealed_explain_most_together(search):
    fitted = search.tried["none", False].fit
    candidates = [e for e in applicable(SHIPPED, search.experiment)[0] if not e.scans]
    found = pair_scores(SHIPPED, fitted.problem.experiment, fitted, candidates)
    alone = {s.effect.name: s.gain for s in scores(SHIPPED, fitted.problem.experiment, fitted, candidates)}
    assert tuple(sorted(e.name for e in found[0].effects)) == PAIR
    for pair in found:
        assert pair.gain > 0.99 * max(alone[e.name] for e in pair.effects) - 1.0


def test_effects_that_are_reported_as_one_are_no_pair(search):
    fitted = search.tried["none", False].fit
    assert (
        pair_scores(SHIPPED, fitted.problem.experiment, fitted, effects("friction-drift", "friction-drift-slip")) == []
    )
    assert pair_scores(SHIPPED, fitted.problem.experiment, fitted, effects("viscous-drag")) == []


def test_both_expectations_reach_the_model(search):
    fitted, pair = search.tried["none", False].fit, effects(*PAIR)
    (found,) = pair_scores(SHIPPED, fitted.problem.experiment, fitted, pair)
    own = search.own_values(Hypothesis(found.effects), *found.values)
    assert set(own) == {"time_constant", "c"}
    assert own["time_constant"] == pytest.approx(0.002, rel=0.5)


def test_a_contest_finds_both_while_held(search):
    """Where nothing is near, the pair is fitted while held and then let go; it need not be the best minimum of a small effect."""
    base, pair = search.tried["none", False], effects(*PAIR)
    (found,) = pair_scores(SHIPPED, base.fit.problem.experiment, base.fit, pair)
    hypothesis = Hypothesis(found.effects)
    (refit,) = contest(search, base, [(hypothesis, search.own_values(hypothesis, *found.values))])
    assert refit.evidence > base.evidence + WORTH
    assert refit.fit.values["time_constant"] == pytest.approx(0.002, rel=0.5)
    assert set(refit.hypothesis.reported) == set(PAIR)
    assert contest(search, base, [(hypothesis, {})]) == []  # not twice


@pytest.mark.parametrize("length", [0.5, 1.0, 2.0])
def test_a_gauge_that_lags_is_undone_while_held(search, length):
    """At the true parameters, lag and drag among them, the residual between slips is noise however stiff the hold."""
    p = Physics()
    true = {
        "mu0": p.mu0,
        "A": p.A,
        "B": p.B,
        "D0": p.D0,
        "Vsat": p.Vsat,
        "lambda": p.lam,
        "time_constant": 0.002,
        "c": 4e-6,
    }
    problem = search.follower.problem(Hypothesis(tuple(effects(*PAIR))), {}, length)
    theta = np.array([true[n] for n in problem.names])
    for run in problem.runs:
        rest = (problem.predicted(run, theta, slopes=False).y - run.observed)[run.used]
        assert 0.7 * 0.02 < float(np.std(rest)) < 1.4 * 0.02, run.name


def test_a_lost_fit_on_a_rough_track_has_no_evidence_beyond_its_likelihood(search):
    """Far from any minimum the linearised likelihood promises what no track can keep."""
    problem = search.problem(Hypothesis(), rough=True)
    theta = np.clip(1.6 * problem.start, problem.lower, problem.upper)
    lost = fit_latent(
        problem, theta, search.noise, tracks=tracks_for(problem.runs, shared=False), roughness=Roughness(1e-3, 10.0),
        known_noise=True, steps=0,
    )  # fmt: skip
    assert lost.log_likelihood <= lost.point.log_likelihood
    smooth = search.problem(Hypothesis())
    near = fit_latent(smooth, smooth.start, search.noise, tracks=Tracks((), {}), known_noise=True)
    assert near.log_likelihood > lost.log_likelihood


@pytest.mark.parametrize(
    ("rival", "left", "asked"),
    [(880.0, 1.05, True), (790.0, 1.05, False), (880.0, 1.5, False)],
    ids=["led by less than the track gained", "led by more", "left too much"],
)
def test_what_a_rough_track_gives_one_it_may_give_its_rival(search, monkeypatch, rival, left, asked):
    """Of two effects alike on a smooth track one is not named because it alone was tried on a rough one."""
    base, (one, other) = search.tried["none", False], [Hypothesis((e,)) for e in effects(*PAIR)]
    faint = replace(base.adequacy, rms_over_noise=left, p_value=0.0)
    smooth = {
        h.name: replace(base, hypothesis=h, evidence=value, adequacy=faint)
        for h, value in ((one, 900.0), (other, rival))
    }
    rough = replace(smooth[one.name], evidence=1000.0, rough=True)
    trial = Search(SHIPPED, search.experiment)
    trial.tried = {(name, False): r for name, r in smooth.items()} | {(one.name, True): rough}
    fitted = []

    def refit(hypothesis, start, own, *, rough):
        fitted.append((hypothesis.name, start, rough, trial.shared))
        return replace(start, evidence=start.evidence + 50, rough=True)

    trial.shared = True
    monkeypatch.setattr(trial, "refit", refit)
    alike_on_rough_tracks(trial, [])
    assert fitted == ([(other.name, smooth[other.name], True, None)] if asked else [])


def test_a_leader_that_is_nearly_there_is_tried_on_a_rough_track_at_once(search, monkeypatch):
    """What a smooth track leaves of the right effect is not given to a second one before a rough track was asked.

    Nor to a rough track before other starts were: a false minimum leaves as much.
    """
    from srfcli.diagnosis import staged_search as module

    base, (one, _) = search.tried["none", False], [Hypothesis((e,)) for e in effects(*PAIR)]
    near = replace(base, hypothesis=one, evidence=base.evidence + 1e6,
                   adequacy=replace(base.adequacy, rms_over_noise=1.1, p_value=0.0))  # fmt: skip
    fine = replace(near, rough=True, adequacy=replace(near.adequacy, rms_over_noise=1.0, p_value=0.5))
    trial = Search(SHIPPED, search.experiment)
    trial.tried, trial.noise, trial.loose = {(one.name, False): near}, search.noise, {base.name: base.fit}
    monkeypatch.setattr(module, "_release", lambda *_: near)
    monkeypatch.setattr(module, "_entry", lambda s, h, at: module.Entry(h, base.fit.point.theta, {}, 1.2))
    monkeypatch.setattr(module, "_partnered", lambda *_: pytest.fail("a partner was tried first"))
    asked = []
    monkeypatch.setattr(module, "elsewhere", lambda _, refit: asked.append("elsewhere") or refit)
    monkeypatch.setattr(trial, "refit", lambda *_, **how: asked.append(how) or fine)
    assert contest(trial, base, [(one, {})], effects(*PAIR)) == [near]
    assert asked == ["elsewhere", {"rough": True}]
