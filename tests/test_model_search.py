"""The best-first search over state-space fits: what it says of recordings of another code, on rough tracks of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import simpson

from srfcli.codegen.c_source import compiler
from srfcli.data.experiment import read_experiment
from srfcli.data.groups import grouped
from srfcli.data.values import FitParameter
from srfcli.diagnosis.hypotheses import Hypothesis, applicable, own_parameters
from srfcli.diagnosis.scores import ResidualProjection, Scores
from srfcli.diagnosis.search import MAX_EFFECTS, ModelSearch
from srfcli.diagnosis.verdict import conclude
from srfcli.inference.state_space import (
    MAX_DEVIATION,
    SIGNIFICANT_GAIN,
    Likelihood,
    StateSpaceFit,
    correlated,
    fit_state_space,
    log_evidence,
    mass_at_bounds,
    maximise,
)  # fmt: skip
from srfcli.laws.registry import bundled_registry
from srfcli.validation.cases import case_files, make_case
from srfcli.validation.gauge import Gauge, read_gauge
from srfcli.validation.slider import Physics, Plan, Track, move

SHIPPED = bundled_registry()
PLANS = (
    Plan("steps", ((0.6, 5), (0.5, 50), (0.8, 10)), 5.0, 0.008),
    Plan("stickslip", ((0.4, 12), (2.2, 8)), 9.2, 0.008),
    Plan("loadstep", ((3, 10),), 5.0, 0.008, steps=((1, 1.5), (2, -1.5))),
    Plan("again", ((2, 15),), 6.0, 0.008, holdout=True, steps=((0.8, 1.5),)),
)
FEW = ("linker-dieterich", "viscous-drag", "friction-drift", "slip-evolution", "sensor-lag")
pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: the filter is compiled")


def recorded(folder, physics, *, baseline=None, seed=5, shared=False, gauge=None, plans=PLANS):
    """Write an experiment whose runs each slid on a rough track of their own, or all on one, and return its folder."""
    rng, readings = np.random.default_rng(seed), {}
    for number, plan in enumerate(plans):
        own = replace(physics, track=Track(5e-4, 6.0, 100 * seed + (0 if shared else number)))
        readings[plan] = read_gauge(move(own, plan).u, gauge or Gauge(), rng)
    for name, text in case_files("small", baseline or Physics(), readings).items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="module")
def rough(tmp_path_factory):
    """The folder of an experiment on rough tracks that lacks nothing."""
    return recorded(tmp_path_factory.mktemp("rough"), Physics())


@pytest.fixture(scope="module")
def ageing(tmp_path_factory):
    """The folder of one in which a change of the load changes the age."""
    return recorded(tmp_path_factory.mktemp("ageing"), Physics(alpha=0.03))


@pytest.fixture(scope="module")
def experiment(rough):
    """Its runs that are fitted."""
    return read_experiment(rough, registry=SHIPPED, holdout=False)


@pytest.fixture(scope="module")
def fitted(experiment):
    """What is fitted to them without any effect."""
    return fit_state_space(Hypothesis().problem(SHIPPED, experiment), processes=())


@pytest.fixture(scope="module")
def begun(ageing):
    """A search of it that has its baseline as the start, fitted once: for tests of what comes after."""
    baseline = ModelSearch(SHIPPED, read_experiment(ageing, registry=SHIPPED, holdout=False), effects=FEW).fit(None)

    class Begun(ModelSearch):
        def fit(self, move):
            return super().fit(move) if move else baseline

    return Begun


def said(folder, effects=FEW, by=ModelSearch):
    search = by(SHIPPED, read_experiment(folder, registry=SHIPPED, holdout=False), effects=effects)
    search.run()
    return conclude(search, read_experiment(folder, registry=SHIPPED))


def test_a_rough_track_is_no_missing_physics(rough):
    found = said(rough)
    assert found.verdict in ("none", "inconclusive") and not found.effects
    assert found.best is found.baseline and not found.baseline.fit.smooth
    assert sum(found.confidence.values()) == pytest.approx(1.0)
    assert [h.baseline.run.name for h in found.held] == ["again"]


def test_a_friction_of_each_runs_own_is_no_missing_physics(tmp_path):
    """Runs whose mu0 differ by up to 4e-3: where it may vary, nothing is missing, held out or not."""
    rng, readings, off = np.random.default_rng(3), {}, (0.0, 2e-3, -2e-3, 1e-3)
    for number, plan in enumerate(PLANS):
        own = replace(Physics(), mu0=Physics().mu0 + off[number], track=Track(3e-4, 6.0, 40 + number))
        readings[plan] = read_gauge(move(own, plan).u, Gauge(), rng)
    for name, text in case_files("small", Physics(), readings).items():
        (tmp_path / name).write_text(text)
    search = ModelSearch(SHIPPED, grouped(read_experiment(tmp_path, registry=SHIPPED, holdout=False), ["mu0"]), effects=FEW)
    search.run()
    found = conclude(search, grouped(read_experiment(tmp_path, registry=SHIPPED), ["mu0"]))
    assert found.verdict in ("none", "inconclusive") and found.best is found.baseline
    values = found.best.fit.values
    apart = [values[f"mu0[{plan.name}]"] - values["mu0[steps]"] for plan in PLANS[1:3]]
    assert apart == pytest.approx(off[1:3], abs=1e-3)
    white = found.held[0].baseline.white
    assert 0.8 < np.sqrt(np.mean(white**2)) < 1.2


def test_what_is_missing_is_named_on_rough_tracks(ageing, begun):
    found = said(ageing, by=begun)
    assert (found.verdict, found.effects) == ("identified", ("linker-dieterich",))
    best = found.best.fit
    error = np.sqrt(np.diag(best.maximum.covariance))[best.likelihood.names.index("alpha")]
    assert abs(best.values["alpha"] - 0.03) < 3.5 * error
    assert sum(h.predicted.gain for h in found.held) > 0


def test_a_search_without_budget_ends_at_the_baseline_and_says_so(ageing, begun):
    """A fit under way is given up; scores are there all the same, and a baseline that passes is not said to lack nothing."""
    found = said(ageing, by=type("Spent", (begun,), {"spent": True}))
    assert [f.name for f in found.ranked] == ["none"] and found.verdict == "inconclusive"
    assert {s.effect.reported for s in found.scores} >= {"linker-dieterich", "viscous-drag"}
    assert any("the search ended at its budget" in reason for reason in found.reasons)


def test_a_fit_that_the_budget_ended_is_one_that_was_left(ageing, begun):
    """The baseline passes, and the first other model was being fitted: nothing is said to be missing, nor that nothing is."""

    class Ended(begun):
        others = 0

        @property
        def spent(self):
            return self.others > 0

        def fit(self, move):
            self.others += move is not None
            return super().fit(move)

    search = Ended(SHIPPED, read_experiment(ageing, registry=SHIPPED, holdout=False), effects=FEW)
    assert search.run() is search.baseline and search.cut_short and [*search.fitted] == ["none"]
    assert conclude(search, read_experiment(ageing, registry=SHIPPED)).verdict == "inconclusive"


def test_colour_that_no_effect_explains_is_the_gauges(tmp_path):
    """The noise is of one colour more than the baseline is fitted with, and no effect promises to explain that."""

    class Whiter(ModelSearch):
        def fit(self, move):
            self.options = {"processes": ()}
            try:
                return super().fit(move)
            finally:
                self.options = {}

    folder = recorded(tmp_path, Physics(), gauge=Gauge(lag1=0.3))
    search = Whiter(SHIPPED, read_experiment(folder, registry=SHIPPED, holdout=False), effects=("linker-dieterich",))
    white = search.fit(None)
    assert white.against == ("innovations are correlated",) and not white.fit.likelihood.processes
    best = search.run()
    assert best is search.baseline and best.passes and best.fit.likelihood.processes == ("relaxation",)
    assert best.evidence > white.evidence + 6
    assert conclude(search, read_experiment(folder, registry=SHIPPED)).verdict == "none"


def test_where_nothing_passes_the_models_after_the_best_are_expanded(ageing, begun):
    """Under a test that no fit passes each model of one effect is asked what it lacks."""

    class Strict(begun):
        def fit(self, move):
            return replace(super().fit(move), against=("it might be better",))

    search = Strict(SHIPPED, read_experiment(ageing, registry=SHIPPED, holdout=False), effects=FEW[:2])
    search.run()
    singles = [f for f in search.fitted.values() if len(f.hypothesis.effects) < MAX_EFFECTS]
    assert not search.best().passes and len(singles) > 2 and not search.cut_short
    assert all(f.scores for f in singles) and not search.queue


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "kind", "concealed"), [(75, "pair", "load-distortion+inertia"), (99, "single", "load-transmission")]
)
def test_the_right_model_is_left_at_no_wrong_maximum(tmp_path, number, kind, concealed, monkeypatch):
    """The contact rings faster than it is sampled: a mass that fits 229 below its maximum, a compliance 2.5 % off."""
    monkeypatch.setattr("srfcli.diagnosis.search.BUDGET", 3600.0)  # the pair is fitted after some 290 s
    names = tuple(concealed.split("+"))
    make_case(tmp_path / "case", (97310514, number), kind=kind, effects=names, bank="wide")
    found = said(tmp_path / "case", effects=None)
    assert found.verdict == "identified" and set(found.effects) == set(names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "concealed"), [(44, "load-stiffening+poisson-coupling"), (117, "sensor-lag+poisson-coupling")]
)
def test_two_effects_are_found_where_coloured_noise_hides_the_second(tmp_path, number, concealed, monkeypatch):
    """A single effect fitted with coloured noise ends 450 to 900 below the pair, where no score leads to the second."""
    monkeypatch.setattr("srfcli.diagnosis.search.BUDGET", 3600.0)  # the pair is fitted after some 200 s
    names = tuple(concealed.split("+"))
    make_case(tmp_path / "case", (9603576, number), kind="pair", effects=names, bank="wide")
    found = said(tmp_path / "case", effects=None)
    assert found.verdict == "identified" and set(found.effects) == set(names)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "law"), [(102, "nagata"), (149, "dieterich")])
def test_an_ageing_law_is_found_behind_an_effect_that_passes(tmp_path, number, law):
    """From where the effect stands a few steps of scoring leave the right law hundreds to thousands below it."""
    make_case(tmp_path / "case", (9603576, number), kind="ageing", bank="wide")
    found = said(tmp_path / "case", effects=None)
    assert found.verdict == "identified" and found.best.hypothesis.reported == (law,)


@pytest.mark.slow
def test_of_long_recordings_a_part_is_searched_and_all_is_fitted(ageing):
    """A search that takes every third reading says what one of all does; its fits are to all, at the same maximum."""
    experiment = read_experiment(ageing, registry=SHIPPED, holdout=False)
    every = fit_state_space(Hypothesis().problem(SHIPPED, experiment))
    many = every.likelihood.samples // 3
    parts = fit_state_space(Hypothesis().problem(SHIPPED, experiment), many=many)
    assert parts.likelihood.samples == every.likelihood.samples
    assert parts.log_likelihood == pytest.approx(every.log_likelihood, abs=0.1)
    search = type("InParts", (ModelSearch,), {"options": {"many": many}})
    found = said(ageing, effects=("linker-dieterich", "viscous-drag", "sensor-lag"), by=search)
    assert (found.verdict, found.effects) == ("identified", ("linker-dieterich",))
    assert {f.fit.likelihood.samples for f in found.ranked} == {every.likelihood.samples}
    assert found.best.fit.values["alpha"] == pytest.approx(0.03, abs=0.005)


def test_another_ageing_law_has_its_name(tmp_path):
    """Data of the slip law under a stated ageing law: of the law and the effect that is the same at its full size, the law."""
    folder = recorded(tmp_path, Physics(slip_share=1.0), plans=(PLANS[0], PLANS[1], PLANS[3]))
    found = said(folder, effects=("ruina", "slip-evolution"))
    assert (found.verdict, found.effects) == ("identified", ("ruina",))


def test_an_effect_that_cannot_join_a_law_is_left_out_with_the_reason(experiment):
    experiment = replace(experiment, choice=replace(experiment.choice, ageing="perrin-rice-zheng"), runs=experiment.runs[:1])
    candidates, _ = applicable(SHIPPED, experiment, FEW)
    problem = Hypothesis().problem(SHIPPED, experiment)
    begun = Likelihood(problem)
    fitted = fit_state_space(problem, start=begun.values(begun.start), processes=(), close=1e3)
    scores = Scores(SHIPPED, experiment, ResidualProjection(fitted), (), candidates)
    assert "slip-evolution" in {x.effect for x in scores.excluded}
    assert "closed form" in next(x.reason for x in scores.excluded if x.effect == "slip-evolution")
    assert {s.effect.reported for s in scores.singles} >= {"viscous-drag", "friction-drift"}


@pytest.mark.parametrize("name", ["viscous-drag", "linker-dieterich", "friction-drift", "drive-ripple"])
def test_scores_are_what_the_likelihood_gains_nearby(experiment, fitted, name):
    """The column of an effect against the likelihood of the model that has it, a little from its neutral value."""
    effect = SHIPPED.get("effect", name)
    scores = Scores(SHIPPED, experiment, ResidualProjection(fitted), (), [effect])
    column = scores.columns[len(scores.columns) // 2]
    model = Hypothesis((effect,)).model(SHIPPED, experiment)
    longs = {p.name: long for long, p in own_parameters(effect, model).items()}
    values = dict(fitted.values) | {longs[n]: v for n, v in column.inner.items()}
    size = scores.singles[0].stderr * 0.3
    wider = Hypothesis((effect,)).problem(SHIPPED, experiment, at=values)
    gained = []
    for step in (size, -size):
        likelihood = Likelihood(wider, smooth=fitted.smooth, rtol=1e-6)
        x = likelihood.coordinates(values | {longs[column.name]: step})
        x[likelihood.names.index(longs[column.name])] = step  # beyond a bound too
        gained.append(likelihood.at(x, slopes=False).log_likelihood)
    slope = (gained[0] - gained[1]) / (2 * size)
    first = float(column.columns[:, 0] @ scores.projection.residuals)
    spread = np.sqrt(column.whole / column.columns.shape[1])  # standard deviation of the slope, the others' share in it
    assert abs(slope - first) < 0.15 * spread
    along = scores.projection.shifts(column.coefficients[:, 0])
    moved = values | {n: fitted.values[n] + size * d for n, d in zip(fitted.likelihood.names, along, strict=True)}
    x = likelihood.coordinates(moved | {longs[column.name]: size})
    x[likelihood.names.index(longs[column.name])] = size
    spared = likelihood.at(x, slopes=False).log_likelihood - gained[0]  # where the other parameters go along
    if column.columns.shape[1] == 1:
        absorbed = column.whole - float(np.sum(column.columns**2))
        assert spared == pytest.approx(0.5 * size**2 * absorbed, rel=0.3, abs=0.02)


def test_a_field_that_all_runs_share_is_seen_as_one(tmp_path, fitted):
    """The gain of a shared field against a Gaussian density with its covariance written out, and its sign."""
    experiment = read_experiment(recorded(tmp_path, Physics(), shared=True), registry=SHIPPED, holdout=False)
    projection = ResidualProjection(fit_state_space(Hypothesis().problem(SHIPPED, experiment), processes=()))
    found = projection.shared
    assert found.gain > SIGNIFICANT_GAIN > ResidualProjection(fitted).shared.gain
    absorbed = (found.u * found.absorbed) @ found.u.T  # I - inverse of the covariance
    inverse = np.eye(projection.projected.size) - absorbed
    gain = 0.5 * projection.projected @ absorbed @ projection.projected + 0.5 * np.linalg.slogdet(inverse)[1]
    assert gain == pytest.approx(found.gain, rel=1e-8)


def test_a_field_that_all_runs_share_counts_alike_under_every_model(tmp_path):
    """What is known of it at first order speaks against a track's form, and decides nothing between models with none."""
    effects = ("viscous-drag", "linker-dieterich", "track-topography")
    found = said(recorded(tmp_path, Physics(alpha=0.03), shared=True), effects=effects)
    assert found.effects == ("linker-dieterich",)
    random = [f for f in found.ranked if "track-topography" not in f.name]
    assert {"none", "linker-dieterich"} <= {f.name for f in random}
    assert len({f.projection.shared.gain for f in random}) > 1  # each its own
    gain = found.best.projection.shared.gain - SIGNIFICANT_GAIN
    assert gain > 0 and [f.evidence - f.separate_field_evidence for f in random] == pytest.approx([gain] * len(random))
    assert all(f.evidence == f.separate_field_evidence for f in found.ranked if f not in random)


@pytest.mark.slow
def test_coloured_gauge_noise_is_not_taken_for_a_fine_field(tmp_path):
    """From the file's start values the fit is as likely as from the field that was drawn."""
    folder = recorded(tmp_path, Physics(), gauge=Gauge(lag1=0.7))
    experiment = read_experiment(folder, registry=SHIPPED, holdout=False)
    problem = Hypothesis().problem(SHIPPED, experiment)
    found = fit_state_space(problem)
    drawn = {"field_amplitude": 3e-4, "field_length": 6.0 * np.sqrt(3)}
    other = fit_state_space(problem, start=drawn, processes=("relaxation",), smooth=False)
    assert found.log_likelihood > other.log_likelihood - 1.0
    assert correlated(found.maximum.point) < MAX_DEVIATION


def test_evidence_charges_for_what_is_free(fitted):
    assert log_evidence(fitted) < fitted.log_likelihood - 10.0


def test_the_evidence_is_the_likelihood_averaged_over_the_priors(experiment):
    """By numerical integration: of a drag that is kept out of its maximum by some standard errors, and the level of the noise."""
    drag = FitParameter("c", 0.0, -0.01, 0.01, False, "1")
    held = tuple(replace(q, fixed=True) for q in experiment.parameters)
    choice = experiment.choice.plus(["viscous-drag"])
    problem = Hypothesis().problem(
        SHIPPED, replace(experiment, runs=experiment.runs[:1], parameters=(*held, drag), choice=choice)
    )

    def maximum(problem):
        likelihood = Likelihood(problem, smooth=True)
        return StateSpaceFit(likelihood, maximise(likelihood, likelihood.start), 0)

    free = maximum(problem)
    best, error, widths = free.maximum.point.x, np.sqrt(np.diag(free.maximum.covariance)), np.arange(-7, 6.1, 0.25)
    c, level = best[0] + widths * error[0], best[1] + np.linspace(-5, 5, 9) * error[1]
    heights = [[free.likelihood.at(np.array([a, b]), slopes=False).log_likelihood for b in level] for a in c]
    over_level = simpson(np.exp(np.array(heights) - free.log_likelihood), x=level, axis=1)
    range_of_level = free.likelihood.upper[1] - free.likelihood.lower[1]
    for beyond in (-6.0, -1.0, 0.5, 4.0):
        below = widths <= -beyond
        upper = problem.upper if beyond == -6.0 else c[below][-1:]
        found = maximum(replace(problem, upper=upper))
        for sizes in ({}, {"c": (0.0, 2e-3)}):
            prior = 1 / (np.pi * 2e-3 * (1 + (c / 2e-3) ** 2)) if sizes else np.full(c.size, 1 / (upper - problem.lower)[0])
            mass = simpson((over_level * prior)[below], x=c[below]) / range_of_level
            expected = free.log_likelihood + np.log(mass)
            assert log_evidence(found, sizes) == pytest.approx(expected, abs=0.15)  # the information is that expected of noise
            assert (mass_at_bounds(found, sizes) < 0) == (beyond > 0)
