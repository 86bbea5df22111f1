"""Rough tracks in a search: when roughness is estimated, and when the baseline alone is put on a rough track."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from srfcli.codegen.c_source import compiler
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis import staged_search as horizons
from srfcli.diagnosis import staged_search as module
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.diagnosis.staged_search import SHARES, Entrant, Search, grow, whole
from srfcli.inference import random_field as latent
from srfcli.inference.random_field import GRID, ROUGHLY, USUAL, Latent, Point, Roughness, Tracks, fit_latent, tracks_for
from srfcli.laws.registry import bundled_registry
from srfcli.validation.cases import Gauge, case_files, read_gauge
from srfcli.validation.slider import Physics, Plan, Track, move

SHIPPED = bundled_registry()
PLANS = (
    Plan("steps", ((0.6, 4), (0.4, 60), (0.6, 8)), 3.0, 0.002),
    Plan("stickslip", ((0.3, 12), (3, 8)), 9.2, 0.004),
)
pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here")


def searching(folder, **concealed):
    """A search whose baseline is fitted to a record of a slider on a rough track, with something concealed or not."""
    rng, base = np.random.default_rng(5), Physics()
    real = replace(base, track=Track(2.5e-4, 12.0, 3), **concealed)
    for name, text in case_files("small", base, {q: read_gauge(move(real, q).u, Gauge(), rng) for q in PLANS}).items():
        (folder / name).write_text(text)
    found = Search(SHIPPED, read_experiment(folder, registry=SHIPPED))
    found.baseline()
    return found


@pytest.fixture(scope="module")
def search(tmp_path_factory):
    return searching(tmp_path_factory.mktemp("rough"))


def effect(name):
    return SHIPPED.get("effect", name)


def effects(*names):
    return [effect(name) for name in names]


@pytest.mark.parametrize(("given", "expected"), [(Roughness(), USUAL), (Roughness(5e-5, 3.0), Roughness(5e-5, 3.0))])
def test_roughness_is_not_estimated_far_off_where_what_is_left_is_not_the_track_s(search, given, expected):
    problem = search.problem(Hypothesis(), rough=True)
    likelihood = Latent(problem)
    tracks = tracks_for(problem.runs, shared=True)
    point = Point(problem.start, tracks, given, {}, np.eye(1), np.zeros(1), 2 * ROUGHLY * likelihood.samples, 0.0)
    assert likelihood.roughness(point, GRID) == expected


def test_a_fit_whose_every_parameter_stands_at_a_bound_stays_there(search):
    values = dict(search.tried["none", False].fit.values)
    problem, bound = search.problem(Hypothesis(), values), np.array([1.02 * values.pop("mu0")])
    pinned = replace(problem, names=("mu0",), start=bound, lower=bound, upper=1.1 * bound, held=values)
    likelihood = Latent(pinned)
    point = likelihood.at(bound, Tracks((), {}), search.noise, Roughness())
    assert likelihood.minimise(point, search.noise).theta == bound


def test_evidence_on_a_rough_track_is_of_a_roughness_that_was_fitted(search, monkeypatch):
    """Slopes may promise to do without the track, along parameters that hardly anything determines; a fit does not keep that."""
    problem = search.problem(Hypothesis(), search.tried["none", False].fit.values, rough=True)

    def fitted():
        tracks = tracks_for(problem.runs, shared=True)
        return fit_latent(problem, problem.start, search.noise, tracks=tracks, known_noise=True)

    honest, estimate, looked = fitted(), latent._marginal_at, []

    def promising(point, n, grid):
        found = estimate(point, n, grid)
        looked.append(grid is GRID)
        return (
            replace(found, log_likelihood=1e9, roughness=Roughness())
            if looked.count(True) > 1 and grid is GRID
            else found
        )

    monkeypatch.setattr(latent, "_marginal_at", promising)
    found = fitted()
    assert looked.count(True) > 1
    assert found.point.roughness.amplitude > 0
    assert found.log_likelihood == pytest.approx(honest.log_likelihood, abs=1.0)
    assert found.log_likelihood > search.tried["none", False].fit.log_likelihood + 20


def displaced(search, share, names):
    """The baseline on a rough track, these parameters off by a share at the start."""
    problem = search.problem(Hypothesis(), rough=True)
    at = np.array([share if n in names else 1.0 for n in problem.names])
    return replace(problem, start=np.clip(at * problem.start, problem.lower, problem.upper))


@pytest.mark.parametrize(
    ("share", "names"), [(1.03, ("B",)), (1.06, ("mu0", "D0")), (0.92, ("A", "B"))], ids=["B", "mu0 and D0", "A and B"]
)
def test_horizons_that_grow_find_what_all_of_the_recordings_at_once_do_not(search, share, names):
    problem = displaced(search, share, names)
    tracks = tracks_for(problem.runs, shared=True)
    direct = fit_latent(problem, problem.start, search.noise, tracks=tracks, known_noise=True)
    grown = grow(problem, tracks, search.noise, tied=problem.names)
    found = whole(problem, grown, search.noise)
    assert grown.share == SHARES[-1]
    assert found.log_likelihood > direct.log_likelihood + 1000
    truth = Physics()
    for name, value in found.values.items():
        error = float(np.sqrt(found.covariance[problem.names.index(name), problem.names.index(name)]))
        assert abs(value - getattr(truth, {"lambda": "lam"}.get(name, name))) < 4 * error, name


def test_a_horizon_grows_as_far_as_the_model_follows(tmp_path):
    """Without the slip law, by which this slider ages, the recordings are followed for a part only; with it to their end."""
    search = searching(tmp_path, slip_share=1.0)
    found = []
    for hypothesis in (Hypothesis(), Hypothesis((effect("slip-evolution"),))):
        problem = search.problem(hypothesis, rough=True)
        tied = search.base_names()
        found.append(grow(problem, tracks_for(problem.runs, shared=True), search.noise, tied=tied))
    without, grown = found
    assert without.share < grown.share == SHARES[-1]
    assert grown.rank < without.rank
    longest = [max(r.t.size for r in g.fit.problem.runs) for g in found]
    assert longest[0] < longest[1]
    assert grown.fit.values["share"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("leader", "left", "asked"),
    [("viscous-drag", 1.5, False), ("track-topography", 1.5, True), ("viscous-drag", 9.0, True)],
    ids=["an effect leads", "a wave leads", "nothing leads"],
)
def test_a_baseline_that_is_far_off_is_put_on_a_rough_track_where_nothing_leads(
    search, monkeypatch, leader, left, asked
):
    base, trial = search.tried["none", False], Search(SHIPPED, search.experiment)
    adequacy = replace(base.adequacy, rms_over_noise=left, p_value=0.0)
    first = replace(base, hypothesis=Hypothesis((effect(leader),)), evidence=base.evidence + 1e6, adequacy=adequacy)
    trial.tried = {(first.name, False): first}
    monkeypatch.setattr(module, "by_horizons", lambda *_: True)
    assert trial.bared(base, []) is asked
    trial.tried["none", True] = replace(base, rough=True)
    assert trial.bared(base, []) is False


def standing(hypothesis, share, rank):
    fit = SimpleNamespace(
        problem=SimpleNamespace(runs=(SimpleNamespace(used=np.ones(1000, dtype=bool)),), experiment=None), values={}
    )
    return Entrant(hypothesis, None, SimpleNamespace(fit=fit, share=share, rank=rank))


@pytest.mark.parametrize(
    ("ranks", "shares", "freed"),
    [
        ((16.5, 16.0), (0.85, 0.85), ["b"]),
        ((16.03, 16.0), (0.85, 0.85), ["b", "a"]),
        ((16.0, 61.0), (0.85, 0.4), ["a"]),
    ],
    ids=["one leads clearly", "two are close", "one does not follow"],
)
def test_what_follows_best_is_set_free(search, monkeypatch, ranks, shares, freed):
    """Of hypotheses that were grown the best is fitted to all of the recordings, another one only where it is close."""
    trial, base, kept, smooth = Search(SHIPPED, search.experiment), search.tried["none", False], [], []
    trial.tried, trial.noise, trial.loose = {("none", False): base}, search.noise, {"none": base.fit}
    added = dict(zip("ab", effects("viscous-drag", "adhesion-offset"), strict=True))
    names = {e.name: k for k, e in added.items()}
    grown = {k: standing(Hypothesis((added[k],)), s, r) for k, s, r in zip("ab", shares, ranks, strict=True)}

    def entrant(_, hypothesis, at, *, shared, followed=None):
        return grown[names[hypothesis.effects[0].name]] if hypothesis.effects else standing(hypothesis, 0.4, 61.0)

    def keep(hypothesis, fitted, *, rough):
        (kept if rough else smooth).append(names[hypothesis.effects[0].name])
        fine = replace(base.adequacy, rms_over_noise=1.0, p_value=0.5)
        found = replace(base, hypothesis=hypothesis, rough=rough, adequacy=fine, evidence=base.evidence + 1e6 + rough)
        trial.tried[found.name, rough] = found
        return found

    scored = [SimpleNamespace(effect=e, values={}, gain=9.0) for e in added.values()]
    monkeypatch.setattr(horizons, "entrant", entrant)
    monkeypatch.setattr(horizons, "scores", lambda *_, **__: scored)
    monkeypatch.setattr(horizons, "whole", lambda *_: None)
    monkeypatch.setattr(horizons, "fit_latent", lambda *_, **__: None)
    monkeypatch.setattr(trial, "problem", lambda *_, **__: SimpleNamespace(start=None))
    monkeypatch.setattr(trial, "keep", keep)
    monkeypatch.setattr(trial, "settled", lambda _: True)
    assert horizons.by_horizons(trial, base, list(added.values()))
    assert kept == smooth == freed  # the track may not be rough after all
    assert trial.shared is True
    assert horizons.by_horizons(trial, base, list(added.values())) is False  # asked once


@pytest.mark.parametrize(("follows", "asked"), [("a", "a"), ("c", "abc")], ids=["the first follows", "the last does"])
def test_where_none_that_promises_follows_the_others_are_asked(search, monkeypatch, follows, asked):
    """Over a short horizon scores tell little: of three effects two promise, and the third is what lets horizons grow."""
    trial, base, grown = Search(SHIPPED, search.experiment), search.tried["none", False], []
    trial.tried = {("none", False): base}
    added = dict(zip("abc", effects("viscous-drag", "adhesion-offset", "linker-dieterich"), strict=True))
    names = {e.name: k for k, e in added.items()}

    def entrant(_, hypothesis, at, *, shared, followed=None):
        grown.append(names[hypothesis.effects[0].name])
        return standing(hypothesis, 0.85 if grown[-1] == follows else 0.1, 16.0 if grown[-1] == follows else 91.0)

    scored = [SimpleNamespace(effect=e, values={}, gain=9.0 if k == "a" else 0.1) for k, e in added.items()]
    monkeypatch.setattr(horizons, "entrant", entrant)
    monkeypatch.setattr(horizons, "scores", lambda *_, **__: scored)
    found = horizons._beside(trial, Hypothesis(), base.fit, list(added.values()), {})
    assert "".join(grown) == asked
    assert names[found[0].hypothesis.effects[0].name] == follows


def test_nothing_is_fitted_twice_from_one_place(search):
    base, wider = search.tried["none", False], Hypothesis((effect("viscous-drag"),))
    trial = Search(SHIPPED, search.experiment)
    assert trial.anew(wider, base, rough=True)
    assert not trial.anew(wider, base, rough=True)
    assert trial.anew(wider, base, rough=False)
    moved = replace(base, fit=replace(base.fit, point=replace(base.fit.point, theta=1.01 * base.fit.point.theta)))
    assert trial.anew(wider, moved, rough=True)
