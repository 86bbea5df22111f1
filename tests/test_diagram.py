"""The diagram at the end of a report: critical loads of both models, under constant load and under the recordings' modulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from srfcli.data.experiment import read_experiment
from srfcli.data.values import FitParameter
from srfcli.diagnosis.diagram import stability
from srfcli.laws.registry import bundled_registry
from srfcli.numerics.critical import critical_line
from srfcli.results.report_figures import diagram_figure
from srfcli.validation.cases import case_files
from srfcli.validation.slider import Physics, Plan

SHIPPED = bundled_registry()
PLANS = (
    Plan("calm", ((1, 20), (1, 60)), 5.0, 0.01),
    Plan("weak", ((2, 30),), 5.0, 0.002, eps=0.05, f=80.0),
    Plan("strong", ((2, 40),), 5.0, 0.002, eps=0.2, f=110.0, holdout=True),
)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagram")
    records = {p: np.full(p.times().size, 15.0) for p in PLANS}  # what was recorded does not matter here
    for name, text in case_files("small", Physics(), records).items():
        (folder / name).write_text(text)
    return read_experiment(folder, registry=SHIPPED)


@pytest.fixture(scope="module")
def found(experiment):
    """The diagram where half of the modulation is said to reach the asperities."""
    rho = FitParameter("rho", 0.5, 0.0, 2.0, fixed=False, unit="1")
    augmented = replace(
        experiment, choice=replace(experiment.choice, effects=("load-transmission",)), parameters=(*experiment.parameters, rho)
    )
    return stability(SHIPPED, experiment, {q.name: q.value for q in experiment.parameters}, augmented)


def crossings(found, side, V):
    """Return the loads, rising, at which a side's boundary crosses a velocity."""
    x, y = np.log(found[f"V_{side}"]), np.log(found[f"W0_{side}"])
    across = (x[:-1] - np.log(V)) * (x[1:] - np.log(V)) <= 0
    share = (np.log(V) - x[:-1])[across] / (x[1:] - x[:-1])[across]
    return np.sort(np.exp(y[:-1][across] + share * (y[1:] - y[:-1])[across]))


@pytest.mark.parametrize(("side", "eps"), [("baseline", 0.2), ("augmented", 0.1)])
def test_the_boundary_is_that_at_the_modulation_that_reaches_the_asperities(experiment, make_model, found, side, eps):
    model, V = make_model(), 37.0
    values = {q.name: q.value for q in experiment.parameters if q.name in model.names}
    K = experiment.runs[0].stiffness
    line = critical_line(model, model.vector(values | {"V": V, "eps": eps, "f": 110.0, "K": K}), lo=2.0, hi=400.0)
    loads = [q.value(model, "W0") for q in line.points]
    assert loads and crossings(found, side, V) == pytest.approx(loads, rel=0.01)  # of the line between its points


def test_constant_load_is_beside_it_and_the_note_says_what_is_shown(found):
    assert found["W0_hopf_augmented"] == pytest.approx(found["W0_hopf_baseline"], rel=1e-9)  # the effect is of the modulation
    for word in ("0.2 at 110 Hz", "constant load", "load-transmission"):
        assert word in found["note"]


def test_a_fitted_stiffness_is_the_diagram_s(experiment):
    calm = replace(experiment, runs=tuple(r for r in experiment.runs if r.modulation is None))
    values = {q.name: q.value for q in calm.parameters}
    stiffer = 1.3 * calm.runs[0].stiffness
    told = replace(calm, runs=tuple(replace(r, stiffness=stiffer) for r in calm.runs))
    found = stability(SHIPPED, calm, values | {"K": stiffer}, told)
    assert found["W0_hopf_baseline"] == pytest.approx(found["W0_hopf_augmented"])
    slow = slice(0, 20)  # where inertia does not count the critical load goes with the stiffness
    stated = stability(SHIPPED, calm, values, calm)["W0_hopf_baseline"][slow]
    assert found["W0_hopf_baseline"][slow] == pytest.approx(1.3 * stated, rel=0.01)


def test_what_acts_in_one_run_alone_is_no_part_of_either_system(experiment):
    """The experiment's own effect of one run, and one that was found: both curves are those without them."""
    calm = replace(experiment, runs=tuple(r for r in experiment.runs if r.modulation is None))
    values = {q.name: q.value for q in calm.parameters}
    plain = stability(SHIPPED, calm, values, calm)["W0_hopf_baseline"]
    drag = FitParameter("c", 1e-3, -1.0, 1.0, False, "1", ("calm",), 0.0)
    dragged = replace(calm, choice=replace(calm.choice, effects=("viscous-drag",)), parameters=(*calm.parameters, drag))
    found = stability(SHIPPED, dragged, values | {"c": 1e-3}, dragged)
    assert found["W0_hopf_baseline"] == pytest.approx(plain, rel=1e-9)
    assert found["W0_hopf_augmented"] == pytest.approx(plain, rel=1e-9)


def test_without_a_modulated_run_it_is_under_constant_load(experiment):
    calm = replace(experiment, runs=tuple(r for r in experiment.runs if r.modulation is None))
    alone = stability(SHIPPED, calm, {q.name: q.value for q in calm.parameters}, calm)
    assert "W0_baseline" not in alone and np.isfinite(alone["W0_hopf_baseline"]).all()
    assert alone["note"].startswith("Under constant load.")


def test_the_figure_shows_four_curves(found):
    (axis,) = diagram_figure(found).axes
    assert len(axis.lines) == 4 and axis.get_ylabel() == "critical load W$_0$  [N]"


def test_where_nothing_is_ever_unstable_that_is_said_and_there_is_no_figure(experiment):
    """Friction that strengthens with velocity has no critical load, of either model."""
    calm = replace(experiment, runs=tuple(r for r in experiment.runs if r.modulation is None))
    parameters = tuple(replace(q, value=0.001) if q.name == "B" else q for q in calm.parameters)
    steady = replace(calm, parameters=parameters)
    nowhere = stability(SHIPPED, steady, {q.name: q.value for q in parameters}, steady)
    assert nowhere["note"].startswith("Sliding is steady at any load")
    assert diagram_figure(nowhere) is None
