"""Fits while held: what a second spring does to a motion, true slopes, and that it leads where a free fit gets lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from srfcli.codegen.c_source import compiler
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.diagnosis.nudging import (
    FIRM,
    FOLLOWED,
    PULLS,
    Follower,
    between_slips,
    calmed,
    hold_to,
    slip_length,
    smoothed,
    weaker,
)
from srfcli.inference.fit import first_level
from srfcli.inference.noise import Noise
from srfcli.laws.registry import bundled_registry
from srfcli.validation.cases import Gauge, case_files, read_gauge
from srfcli.validation.slider import Physics, Plan, move

SHIPPED = bundled_registry()
PLANS = (
    Plan("steps", ((0.6, 4), (0.4, 60), (0.6, 8)), 3.0, 0.002),
    Plan("stickslip", ((0.3, 12), (3, 8)), 9.2, 0.004),
)
pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: motion is too slow here")


@pytest.fixture(scope="module", params=["elastic with mass", "quasi-static"])
def experiment(request, tmp_path_factory):
    """A stick-slip record and velocity steps, with and without a mass in the model; the truth beside it."""
    p = Physics(massless=request.param == "quasi-static")
    folder = tmp_path_factory.mktemp("follow")
    rng = np.random.default_rng(5)
    for name, text in case_files("small", p, {q: read_gauge(move(p, q).u, Gauge(), rng) for q in PLANS}).items():
        (folder / name).write_text(text)
    return p, read_experiment(folder, registry=SHIPPED)


def rms(x):
    return float(np.sqrt(np.mean(x**2)))


def held_problem(experiment, length):
    hold = hold_to(experiment, experiment.runs, length)
    return Hypothesis().problem(SHIPPED, experiment, rough=False, hold=hold)


def test_a_stiff_hold_follows_anything_and_none_is_the_free_motion(experiment):
    """Over a hundredth of a slip length a wrong model shows the recording; over a million of them it moves freely."""
    _, ex = experiment
    free = Hypothesis().problem(SHIPPED, ex, rough=False)
    theta = free.start * 1.1
    for run in free.runs:
        noise = first_level(run)
        unbound = free.predicted(run, theta, slopes=False).y
        assert rms(unbound - run.observed) > 20 * noise
        tight = held_problem(ex, 0.004).predicted(run, theta, slopes=False).y
        assert rms(tight - run.observed) < 0.1 * rms(unbound - run.observed)
        loose = held_problem(ex, 1e6).predicted(run, theta, slopes=False).y
        assert loose == pytest.approx(unbound, abs=2e-3)


def test_slopes_while_held_are_true(experiment):
    """By every free parameter, against central differences."""
    _, ex = experiment
    problem = replace(held_problem(ex, 2.0), rtol=1e-11)
    run = problem.runs[0]
    J = problem.predicted(run, problem.start).J
    for k in range(problem.start.size):
        h = 1e-4 * problem.start[k] * np.eye(problem.start.size)[k]
        ends = [problem.predicted(run, problem.start + s * h, slopes=False).y for s in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * h[k])
        assert J[:, k] == pytest.approx(difference, abs=5e-3 * np.abs(difference).max()), problem.names[k]


def test_the_truth_needs_no_hold(experiment):
    """At the true parameters the residual between slips is noise under any hold that stick-slip does not survive, and free."""
    p, ex = experiment
    values = {"mu0": p.mu0, "A": p.A, "B": p.B, "D0": p.D0, "Vsat": p.Vsat, "lambda": p.lam}
    for length in (0.2, 0.4, 0.8, 1e6):
        problem = held_problem(ex, length)
        theta = np.array([values[n] for n in problem.names])
        for run in problem.runs:
            rest = problem.predicted(run, theta, slopes=False).y - run.observed
            rms = float(np.std(rest[between_slips(run).used]))
            assert 0.7 * 0.02 < rms < 1.4 * 0.02, (length, run.name)


def test_it_leads_from_afar(experiment):
    """From parameters at which stick-slip comes at the wrong times, the way down ends where the noise is."""
    p, ex = experiment
    follower = Follower(SHIPPED, ex, None)
    noise = {r.name: Noise(first_level(r)) for r in ex.runs}
    far = {"mu0": 0.34, "A": 0.0105, "B": 0.021, "D0": 0.55, "Vsat": 400.0, "lambda": 0.9}
    start = follower.problem(Hypothesis(), far)
    if not p.massless:  # the other finds its way from here by itself
        assert follower.descend(start, start.start, noise, 1e-4)[1] > 10 * FOLLOWED
    found = follower.follow(Hypothesis(), far, noise, PULLS)
    assert found.reduced < 1.5
    assert dict(zip(found.problem.names, found.theta, strict=True))["D0"] == pytest.approx(p.D0, rel=0.05)


def test_recordings_in_other_units_hold_alike(experiment):
    """A record of the spring's force, or of friction, holds the slider as the record of its elongation does."""
    _, ex = experiment
    problem = held_problem(ex, 1.0)
    run = problem.runs[0]
    K, W = run.stiffness, run.load(run.t)[0]
    as_force = replace(run, observable="force", observed=K * run.observed)
    as_friction = replace(run, observable="friction", observed=K * run.observed / W)
    there = problem.predicted(run, problem.start, slopes=False).y
    for other, factor in ((as_force, K), (as_friction, K / W)):
        experiment_of_it = replace(ex, runs=(other,))
        hold = hold_to(experiment_of_it, [other], 1.0)
        assert hold.table == ("force", "time")
        found = Hypothesis().problem(SHIPPED, experiment_of_it, rough=False, hold=hold)
        y = found.predicted(other, problem.start, slopes=False).y
        assert y / factor == pytest.approx(there, abs=1e-3)
    mixed = hold_to(ex, [run, replace(as_force, name="other")], 1.0)
    assert mixed.table == ("elongation", "time")
    assert mixed.records["other"].numbers == pytest.approx(mixed.records[run.name].numbers, abs=1e-9)


def test_the_spline_that_holds_bridges_what_was_not_recorded():
    """Straight over a gap, close to the samples elsewhere."""
    t = np.linspace(0, 1, 501)
    y = np.sin(6 * t)
    used = (t < 0.4) | (t > 0.5)
    y[~used] = 1e3
    found = smoothed(t, y, used, 0.004)(t)
    assert found[used] == pytest.approx(np.sin(6 * t[used]), abs=2e-3)
    assert np.abs(found[~used] - np.sin(6 * t[~used])).max() < 0.05


def test_lengths(experiment):
    """Over its length the second spring takes a share of the load."""
    _, ex = experiment
    problem = held_problem(ex, 1.0)
    assert slip_length(problem.model, ex) == pytest.approx(0.4)
    assert problem.hold is not None
    for run in problem.runs:
        load = float(np.mean(run.load(run.t)[0]))
        assert weaker(problem.hold, problem.runs, 5.0).stiffness[run.name] == pytest.approx(FIRM * load / 5.0)


def test_a_record_is_calmed_but_for_its_slips(experiment):
    """Noise is less than half of what it was between slips, where nothing is bent; a slip stays where it was."""
    _, ex = experiment
    for run in ex.runs:
        used = run.used & np.isfinite(run.observed)
        quiet = calmed(run, run.observed, used)
        assert quiet.shape == run.observed.shape
        moved = np.abs(np.diff(run.observed, prepend=run.observed[0]))
        assert np.abs(quiet - run.observed).max() < 6 * 0.02
        if moved.max() > 0.5:  # stick-slip: the largest slip is as large as before
            k = int(np.argmax(moved))
            assert quiet[k] - quiet[k - 1] == pytest.approx(run.observed[k] - run.observed[k - 1], abs=0.12)
    t = np.arange(2000) * 0.004
    rng = np.random.default_rng(0)
    smooth = 5 + np.sin(2 * t)
    run = replace(ex.runs[0], t=t, observed=smooth + 0.02 * rng.standard_normal(t.size), used=np.ones(t.size, dtype=bool),
                  modulation=None)  # fmt: skip
    assert rms(calmed(run, run.observed, run.used) - smooth) < 0.5 * 0.02


def test_nothing_is_told_by_the_slips(experiment):
    """Samples beside a jump of many times the noise are left out, others are not."""
    _, ex = experiment
    t = np.arange(1000) * 0.004
    y = 10 * t + 0.02 * np.random.default_rng(2).standard_normal(t.size)
    y[500:] -= 8.0
    run = replace(ex.runs[0], t=t, observed=y, used=np.ones(t.size, dtype=bool), modulation=None)
    left = np.flatnonzero(~between_slips(run).used)
    assert left.size < 40 and {499, 500, 501} <= set(left.tolist())
