"""Minima that are not the truth: of a mass, whose oscillation comes a cycle off, and of parameters that held-out runs refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from srfcli.codegen.c_source import compiler
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.diagnosis.staged_search import Search, resized
from srfcli.diagnosis.verdict import conclude
from srfcli.inference.random_field import fit_latent
from srfcli.laws.registry import bundled_registry
from srfcli.validation.cases import Gauge, case_files, read_gauge
from srfcli.validation.slider import Physics, Plan, move

SHIPPED = bundled_registry()
MASS = 6.2e-7  # N s^2/um
ONSET = Plan("onset", ((0.5, 10), (3, 7.3)), 9.3, 0.001, eps=0.071, f=106, onset=2.0)
STRONG = Plan("strong", ((1.5, 20),), 7.1, 0.001, eps=0.24, f=118, onset=0.62)
STEPS = Plan("steps", ((1, 4.8), (0.7, 18), (1, 4.8)), 4.7, 0.004)
LATER = Plan("later", ((0.6, 9), (0.4, 30), (0.6, 6)), 4.7, 0.004, holdout=True)
pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here")


def written(folder, real, stated, plans, *, of=None):
    """Write the record of a slider, of another one for the runs in `of`, beside the model that is stated for it."""
    rng = np.random.default_rng(7)
    movers = {q: (of or {}).get(q.name, real) for q in plans}
    records = {q: read_gauge(move(p, q).u, Gauge(), rng) for q, p in movers.items()}
    for name, text in case_files("false", stated, records).items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="module")
def ringing(tmp_path_factory):
    """A search for a mass in a record of a slider that has one, with a baseline that has none."""
    real = replace(Physics(), M=MASS)
    folder = written(tmp_path_factory.mktemp("mass"), real, replace(real, massless=True), (STEPS, ONSET, STRONG))
    found = Search(SHIPPED, read_experiment(folder, registry=SHIPPED))
    found.baseline()
    return found


def masses(search):
    effect = SHIPPED.load(next(e for e in SHIPPED.entries("effect") if e.name == "inertia"))
    return Hypothesis((effect,))


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_a_mass_that_is_a_cycle_off_is_found_from_other_sizes(ringing, factor):
    p, hypothesis = Physics(), masses(ringing)
    true = {"mu0": p.mu0, "A": p.A, "B": p.B, "D0": p.D0, "Vsat": p.Vsat, "lambda": p.lam, "M": factor * MASS}
    problem = ringing.problem(hypothesis, true)
    ringing.tried.pop((hypothesis.name, False), None)
    ringing.sized.clear()
    false = ringing.keep(hypothesis, fit_latent(problem, problem.start, ringing.noise, known_noise=True), rough=False)
    assert abs(false.fit.values["M"] / MASS - 1) > 0.03, "this start leads to the truth: the test asks nothing"
    found = resized(ringing, false)
    assert found.adequacy.rms_over_noise < 1.03
    assert found.fit.values["M"] == pytest.approx(MASS, rel=0.02)
    assert found.fit.values["lambda"] == pytest.approx(p.lam, rel=0.02)


def test_one_that_leaves_noise_alone_at_once_is_tried_at_other_sizes_only_when_all_are_asked(ringing):
    hypothesis, p = masses(ringing), Physics()
    true = {"mu0": p.mu0, "A": p.A, "B": p.B, "D0": p.D0, "Vsat": p.Vsat, "lambda": p.lam, "M": MASS}
    problem = ringing.problem(hypothesis, true)
    ringing.sized.clear()
    fine = ringing.keep(hypothesis, fit_latent(problem, problem.start, ringing.noise, known_noise=True), rough=False)
    assert fine.adequacy.fine
    before = ringing.evaluations
    assert resized(ringing, fine) is fine and ringing.evaluations == before
    assert resized(ringing, fine, thorough=True).evidence >= fine.evidence
    assert ringing.evaluations > before


def test_what_has_no_mass_is_not_tried_at_other_sizes(ringing):
    bare = ringing.tried["none", False]
    before = ringing.evaluations
    assert resized(ringing, bare) is bare
    assert ringing.evaluations == before


@pytest.mark.parametrize("other, verdict", [({}, "none"), ({"drag": 2e-5}, "unknown"), ({"drag": 2e-4}, "unknown")])
def test_held_out_runs_that_no_parameters_fit_refuse_the_model(tmp_path, other, verdict):
    """The fitted runs alone are noise to the baseline; the held-out one is another slider's."""
    real = Physics()
    folder = written(
        tmp_path, real, real, (STEPS, replace(STEPS, name="more", W0=6.0), LATER), of={"later": replace(real, **other)}
    )
    search = Search(SHIPPED, read_experiment(folder, registry=SHIPPED, holdout=False))
    search.run()
    found = conclude(search, read_experiment(folder, registry=SHIPPED))
    assert search.best().name == "none"
    assert found.verdict in ((verdict,) if other else ("none", "inconclusive")), found.reasons
    assert any("held-out runs along with the others" in r for r in found.reasons) == bool(other)
