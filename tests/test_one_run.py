"""A parameter that acts in some runs alone: in experiments, in simulations, in fits, and as what a diagnosis names."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner, Result

from srfcli.cli.main import cli
from srfcli.codegen.c_source import compiler
from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.goodness_of_fit import failed_tests
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.diagnosis.scores import ResidualProjection
from srfcli.diagnosis.search import SEARCH_RTOL, ModelSearch
from srfcli.inference.state_space import Likelihood, StateSpaceFit, log_evidence, mass_at_bounds, maximise
from srfcli.laws.registry import bundled_registry
from srfcli.validation.cases import case_files
from srfcli.validation.gauge import Gauge, read_gauge
from srfcli.validation.slider import Physics, Plan, move

SHIPPED = bundled_registry()
PLANS = (
    Plan("up", ((0.5, 10), (0.7, 40)), 3.0, 0.004, steps=((0.3, 1.0), (0.7, -0.5))),
    Plan("down", ((0.7, 40), (0.6, 15)), 3.0, 0.004, steps=((0.3, 1.0), (0.9, -0.5))),
    Plan("again", ((0.4, 15), (0.4, 30)), 3.0, 0.004, steps=((0.2, 1.0),), holdout=True),
)
SHARE, NAME = 0.05, "tangential-crosstalk"
needs_compiler = pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here")


def srf(*arguments) -> Result:
    return CliRunner().invoke(cli, [str(a) for a in arguments], prog_name="srf")


def written(folder, only, plans=PLANS):
    """Write the recordings of the independent generator: the load pushes along the track in the runs `only`."""
    rng, calm = np.random.default_rng(5), Physics(rigid=True, massless=True)
    pushed = replace(calm, cross=SHARE)
    readings = {p: read_gauge(move(pushed if p.name in only else calm, p).u, Gauge(), rng) for p in plans}
    for name, text in case_files("one run", calm, readings).items():
        (folder / name).write_text(text)
    return folder


BLIND = (replace(PLANS[0], steps=()), *PLANS[1:])  # under a constant load nothing pushes


@needs_compiler
@pytest.mark.parametrize(
    ("only", "plans"),
    [
        pytest.param(("down",), BLIND, id="one, and the others fitted cannot see it"),
        pytest.param(("down",), PLANS, id="one", marks=pytest.mark.slow),
        pytest.param(("up", "down", "again"), PLANS, id="all", marks=pytest.mark.slow),
    ],
)
def test_a_diagnosis_names_the_run_in_which_alone_an_effect_acts(only, plans, tmp_path, without_matplotlib):
    """Where a run that is fitted cannot tell whether it has the effect, the one that was held out does."""
    folder = written(tmp_path, only, plans)
    done = srf("diagnose", str(folder), "--effect", NAME, "--json", "--out", str(tmp_path / "found"))
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert (told["verdict"], told["effects"]) == ("identified", [NAME])
    share = told["augmented"]["parameters"]["share"]
    assert abs(share["value"] - SHARE) < 4 * share["stderr"] < 0.2 * SHARE
    if len(only) > 1:
        assert "acts_in" not in told
        return
    assert told["acts_in"] == {NAME: "down"}
    augmented = read_experiment(tmp_path / "found" / "augmented", registry=SHIPPED)
    (q,) = (q for q in augmented.parameters if q.name == "share")
    assert (q.runs, q.elsewhere) == (("down",), 0.0)
    assert [q.name in augmented.elsewhere(run) for run in augmented.runs] == [True, False, True]


@needs_compiler
@pytest.mark.parametrize("name", [NAME, "sensor-lag"])
def test_in_the_other_runs_an_effect_of_one_run_changes_nothing(name, tmp_path):
    """Innovations of the others are the baseline's: a time constant that cannot be zero is too small there to be seen."""
    experiment = read_experiment(written(tmp_path, ()), registry=SHIPPED).fitted()
    search = ModelSearch(SHIPPED, experiment, effects=[name])
    innovations = []
    for effects in ((), (replace(search.candidates[0], run="up"),)):
        problem = Hypothesis(effects).problem(SHIPPED, experiment)
        likelihood = Likelihood(problem)
        values = likelihood.values(likelihood.start)
        added = {n: p.default for p in search.candidates[0].parameters if (n := p.name) in problem.names}
        found = likelihood.at(likelihood.coordinates({**values, **added}), slopes=False)
        innovations.append({f.run.name: f.white for f in found.runs})
    apart = {run: float(np.abs(white - innovations[1][run]).max()) for run, white in innovations[0].items()}
    assert apart["up"] > 0.1 and apart["down"] < 0.01


STATED = """
effects = ["tangential-crosstalk"]
[parameters]
share = { value = 0.05, runs = ["down"], elsewhere = 0.0 }
"""


def stated(folder, text=STATED):
    """Write the experiment with the effect in its description."""
    written(folder, ())
    path = folder / "experiment.toml"
    before, after = path.read_text().split("\n[parameters]", 1)
    path.write_text(before + text + after.split("\n", 1)[1])
    return path


@needs_compiler
def test_a_simulation_and_a_fit_have_it_in_that_run_alone(tmp_path):
    """Against the same simulation without the effect: in the other runs nothing differs, in that one the load pushes."""
    stated(tmp_path)
    for name, share in (("with", SHARE), ("without", 0)):
        noise = ("--noise", "0.01", "--seed", "1")
        done = srf("simulate", str(tmp_path), "--set", f"share={share}", *noise, "--out-dir", str(tmp_path / name))
        assert done.exit_code == 0, done.output
    one, other = (read_experiment(tmp_path / name, registry=SHIPPED) for name in ("with", "without"))
    apart = {a.name: np.abs(a.observed - b.observed) for a, b in zip(one.runs, other.runs, strict=True)}
    assert not apart["up"].any() and not apart["again"].any()
    steady = (one.runs[1].t > 0.55) & (one.runs[1].t < 0.7)  # after the load's step by 1 N, before that of the velocity
    assert np.mean(apart["down"][steady]) == pytest.approx(SHARE * 1.0 / 0.21, rel=0.02)  # share (W - W0)/K, in um
    done = srf("fit", str(tmp_path / "with"), "--track", "smooth", "--json")
    assert done.exit_code == 0, done.output
    rows = {row["parameter"]: row for row in json.loads(done.stdout)["rows"]}
    assert abs(rows["share"]["value"] - SHARE) < 4 * rows["share"]["stderr"] < 0.02 * SHARE


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ('runs = ["dwon"], elsewhere = 0.0', "no run 'dwon'"),
        ('runs = ["down"]', "nothing says what share is in the other runs"),
        ("runs = [], elsewhere = 0.0", "expected a list of runs"),
        ("elsewhere = 0.0", "it acts in all runs"),
    ],
)
def test_what_is_wrong_with_it_is_said(entry, said, tmp_path):
    path = stated(tmp_path, STATED.replace('runs = ["down"], elsewhere = 0.0', entry))
    with pytest.raises(SrfError, match=said) as found:
        read_experiment(path, registry=SHIPPED)
    assert "experiment.toml" in str(found.value)


class Stuck(ModelSearch):
    """A search whose first fit of the baseline ends elsewhere: with another D0, beside a field that takes up the rest."""

    def fit(self, move):
        found = super().fit(move)
        if move is not None:
            return found
        self.right = found.evidence
        likelihood = Likelihood(
            Hypothesis().problem(SHIPPED, self.experiment), processes=found.fit.likelihood.processes, rtol=SEARCH_RTOL
        )
        x = likelihood.coordinates({**found.fit.values, "D0": 0.25, "field_amplitude": 2e-3, "field_length": 0.3})
        stuck = StateSpaceFit(likelihood, maximise(likelihood, x, fixed=["D0"], steps=8), 1)
        judged = {"separate_field_evidence": log_evidence(stuck), "mass_at_bounds": mass_at_bounds(stuck)}
        return replace(found, fit=stuck, against=tuple(failed_tests(stuck)), projection=ResidualProjection(stuck), **judged)


@needs_compiler
@pytest.mark.slow
def test_a_baseline_in_a_false_maximum_is_fitted_again_from_a_better_model(tmp_path):
    """Else what is nothing would have the name of the effect whose fit found the way out."""
    experiment = read_experiment(written(tmp_path, ()), registry=SHIPPED)
    search = Stuck(SHIPPED, experiment.fitted(), effects=["slip-evolution", "viscous-drag", "second-state"])
    best = search.run()
    assert best.name == "none" and best.passes
    assert best.evidence == pytest.approx(search.right, abs=1.0)
    assert len(search.fitted) > 1
