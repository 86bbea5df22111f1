"""The run that discriminates between what is ambiguous: within reach, worth what it promises, and where to look."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import srfcli as srf
from srfcli.cli.main import cli
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.design import (
    DISCRIMINATING_GAIN,
    EXTRAPOLATION_FACTOR,
    MIN_DESIGN_GAIN,
    Design,
    DiscriminatingRun,
    LackOfFit,
    Proposal,
    RivalModel,
    capabilities_of,
    described,
    discriminating_run,
    draw,
    rival_models,
    run_of,
    sentences,
    vary,
    with_fast_start,
)
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.diagnosis.verdict import Diagnosis
from srfcli.inference.prediction import run_parameters
from srfcli.inference.state_space import Likelihood, fit_state_space
from srfcli.laws.registry import bundled_registry
from srfcli.motion.imposed import ConstantLoad, Drive
from srfcli.motion.integrators import integrate
from srfcli.results.diagnosis import DiagnosisResult
from srfcli.results.tables import to_text
from srfcli.validation.cases import case_files
from srfcli.validation.gauge import Gauge, read_gauge
from srfcli.validation.slider import Physics, Plan, move

SHIPPED = bundled_registry()
RIVALS = ("linker-dieterich", "load-transmission")
PLANS = (
    Plan("steps", ((0.6, 6), (0.4, 40), (0.6, 10)), 4.0, 0.002),
    Plan("wave", ((1.2, 15),), 6.0, 0.001, eps=0.15, f=100, onset=0.3),
    Plan("seen-later", ((0.6, 10), (0.5, 30), (0.5, 12)), 4.0, 0.002, holdout=True),
)
FIELDS = {"lambda": "lam"}  # of the generator's slider, where its name is another
POOR = Proposal("velocity steps", ((0.6, 8.0), (0.4, 60.0), (0.6, 12.0)), 5.0, "steps", 0.002, 0.05)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A weak effect of the rate of load, in an experiment with one short modulation: its rival does as well."""
    folder = tmp_path_factory.mktemp("discriminating") / "case"
    folder.mkdir()
    rng = np.random.default_rng(1)
    readings = {plan: read_gauge(move(replace(Physics(), alpha=0.006), plan).u, Gauge(), rng) for plan in PLANS}
    for name, text in case_files("small", Physics(), readings).items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="module")
def result(folder: Path) -> DiagnosisResult:
    """What a diagnosis among the two finds."""
    return srf.diagnose(folder, effects=RIVALS)


@pytest.fixture(scope="module")
def diagnosis(result: DiagnosisResult) -> Diagnosis:
    """The models that were fitted, and the verdict."""
    return result.diagnosis


@pytest.fixture(scope="module")
def found(result: DiagnosisResult) -> DiscriminatingRun:
    """The run that discriminates between its hypotheses."""
    assert result.discriminating is not None
    return result.discriminating


def gap(diagnosis: Diagnosis, proposal: Proposal, true: str) -> float:
    """Return the log likelihood that the true hypothesis wins by a run of the generator's own motion and new noise."""
    e, run = diagnosis.experiment, run_of(proposal, diagnosis.experiment)
    fitted = next(f for f in diagnosis.close if f.name == true).fit
    values = {n: fitted.values[n] for n in fitted.likelihood.problem.names}
    slider = replace(Physics(), **{FIELDS.get(name, name): value for name, value in values.items()})
    plan = Plan("x", proposal.drive, proposal.W0, proposal.interval, eps=proposal.eps, f=proposal.f,
                onset=proposal.onset, steps=proposal.steps)  # fmt: skip
    readings = read_gauge(move(slider, plan).u, Gauge(), np.random.default_rng(100))
    runs = (*(r for r in e.runs if not r.holdout), replace(run, holdout=False, observed=readings))
    won = {}
    for f in diagnosis.close:
        problem = f.hypothesis.problem(SHIPPED, replace(e, runs=runs), at=f.fit.values)
        again = fit_state_space(problem, start=f.fit.values, smooth=f.fit.smooth, processes=f.fit.likelihood.processes)
        new = again.maximum.point.runs[-1]
        assert new.run.name == run.name
        won[f.name] = again.log_likelihood - f.fit.log_likelihood
    return won.pop(true) - max(won.values())


# ---- what it promises


def test_the_case_is_ambiguous(diagnosis: Diagnosis) -> None:
    assert diagnosis.verdict == "ambiguous" and set(diagnosis.effects) == set(RIVALS)


@pytest.mark.slow
@pytest.mark.parametrize("true", RIVALS)
def test_the_promise_is_kept(diagnosis: Diagnosis, found: DiscriminatingRun, true: str) -> None:
    """Made by the independent generator and refitted with the old runs: the gap is what was promised, within a factor of two."""
    assert found.gain > 2 * DISCRIMINATING_GAIN and found.gain == min(found.gains.values())
    assert 0.5 < gap(diagnosis, found.proposal, true) / found.gains[true] < 2


def test_a_poor_run_parts_nothing(diagnosis: Diagnosis) -> None:
    """Both effects are those of a load that changes: under a constant one nothing discriminates between them."""
    design = Design(diagnosis.experiment, rival_models(diagnosis), 0)
    trial = design.predict(POOR)
    assert trial is not None and trial.bound > 0
    judged = design.judge(trial)
    assert judged is not None and judged.gain < 0.2 and judged.seconds is None and not judged.discriminates


@pytest.mark.slow
def test_refits_do_not_part_by_a_poor_run_either(diagnosis: Diagnosis) -> None:
    assert abs(gap(diagnosis, POOR, RIVALS[0])) < 1


def test_a_part_of_the_run_is_enough(diagnosis: Diagnosis, found: DiscriminatingRun) -> None:
    """The run cut to its first `seconds` promises 12, to half of that less."""
    design = Design(diagnosis.experiment, rival_models(diagnosis), 0)
    assert found.seconds is not None and found.repeats == 1 and 0 < found.seconds < found.proposal.duration
    gains = []
    for share in (1.0, 0.5):
        left, drive = share * found.seconds + found.proposal.interval, []
        for d, V in found.proposal.drive:
            drive.append((max(min(d, left), 1e-9), V))
            left -= d
        trial = design.predict(replace(found.proposal, drive=tuple(drive)))
        assert trial is not None
        gains.append(design.gain(trial))
    assert gains[1] < DISCRIMINATING_GAIN * 0.9 and 0.8 * DISCRIMINATING_GAIN < gains[0] < 2 * DISCRIMINATING_GAIN


def test_the_difference_is_where_it_is_said_to_be(diagnosis: Diagnosis, found: DiscriminatingRun) -> None:
    """After the refit no sample differs by more, and before it the two differ by more somewhere."""
    a, b = (found.predicted[n] for n in found.pair)
    assert found.run.t[0] <= found.at <= found.run.t[-1]
    assert 0 < found.peak_um == abs(found.peak) < float(np.abs(a - b).max())
    assert found.noise == pytest.approx(0.02, rel=0.1)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_run(diagnosis: Diagnosis) -> None:
    made = [discriminating_run(SHIPPED, diagnosis, seed=seed, tried=4, varied=1) for seed in (1, 1, 2)]
    assert made[0] is not None and made[1] is not None and made[2] is not None
    assert made[0].proposal == made[1].proposal != made[2].proposal and made[0].gain == made[1].gain
    assert made[0].tried == 5


def test_one_class_is_said_to_be_one(diagnosis: Diagnosis) -> None:
    """A hypothesis beside its own double, and a third: no run discriminates between these two."""
    first, second = diagnosis.close
    (effect,) = first.hypothesis.effects
    double = replace(first, hypothesis=Hypothesis((replace(effect, name="double", answers="double"),)))
    best = discriminating_run(SHIPPED, replace(diagnosis, close=(first, double, second)), tried=4, varied=1)
    assert best is not None and best.names == (first.name, "double", second.name)
    assert best.gain < 1e-3 < MIN_DESIGN_GAIN and not best.discriminates and best.repeats is None
    assert "one class" in sentences(best)[0] and first.name in sentences(best)[0]


def test_nothing_to_part_is_no_experiment(diagnosis: Diagnosis) -> None:
    assert discriminating_run(SHIPPED, replace(diagnosis, verdict="identified")) is None
    assert discriminating_run(SHIPPED, replace(diagnosis, close=diagnosis.close[:1])) is None


# ---- what counts


@pytest.mark.parametrize("seed", range(5))
def test_the_gain_is_what_no_refit_absorbs(seed: int) -> None:
    """Against the covariance of all samples under the wrong model, written out."""
    rng = np.random.default_rng(seed)
    w, X = rng.standard_normal(40), rng.standard_normal((40, 5)) * np.geomspace(0.1, 100, 5)
    root = rng.standard_normal((5, 5))
    Q = root @ root.T + 0.1 * np.eye(5)
    lost = LackOfFit(w, X, Q, w)
    covariance = np.eye(40) + X @ np.linalg.inv(Q) @ X.T
    assert lost.gain() == pytest.approx(0.5 * w @ np.linalg.solve(covariance, w), rel=1e-9)
    twice = LackOfFit(np.tile(w, 2), np.tile(X, (2, 1)), Q, w)
    assert lost.gain(times=2) == pytest.approx(twice.gain(), rel=1e-9)
    gains = [lost.gain(samples=k) for k in range(1, 41)]
    assert np.all(np.diff(gains) > -1e-12) and gains[-1] == pytest.approx(lost.gain())
    assert lost.gain() <= 0.5 * w @ w
    assert LackOfFit(X @ rng.standard_normal(5), X, 1e-9 * Q, w).gain() < 1e-6


def test_a_random_field_takes_its_share(diagnosis: Diagnosis, found: DiscriminatingRun) -> None:
    """What a rough track could do discriminates between nothing."""
    gains = []
    for amplitude in (0.0, 3e-4, 3e-3):
        rivals = []
        for rival in rival_models(diagnosis):
            values = {**rival.fitted.fit.values, "field_amplitude": amplitude, "field_length": 6.0}
            likelihood = Likelihood(rival.problem, smooth=not amplitude, processes=rival.fitted.fit.likelihood.processes)
            point = likelihood.at(likelihood.coordinates(values))
            fit = replace(rival.fitted.fit, likelihood=likelihood, maximum=replace(rival.fitted.fit.maximum, point=point))
            rivals.append(RivalModel.of(replace(rival.fitted, fit=fit)))
        design = Design(diagnosis.experiment, rivals, 0)
        trial = design.predict(found.proposal)
        assert trial is not None
        gains.append(design.gain(trial))
    assert gains[0] > 1.02 * gains[1] > gains[2] > 0


# ---- what the apparatus can do


@pytest.mark.parametrize("seed", range(4))
def test_runs_stay_within_reach(diagnosis: Diagnosis, seed: int) -> None:
    """Velocities, loads, amplitudes and frequencies at most twice beyond what was shown; track and time no longer."""
    apparatus, rng = capabilities_of(diagnosis.experiment), np.random.default_rng(seed)
    drawn = draw(apparatus, 24, rng)
    drawn += [v for p in drawn[:4] for v in vary(p, apparatus, 3, rng)]
    drawn += [led for p in drawn[:12] if (led := with_fast_start(p, apparatus)) is not None]
    assert {p.kind for p in drawn} == set(apparatus.kinds) == {"velocity steps", "slide-hold-slide", "modulation"}
    for p in drawn:
        assert all(V == 0 or 6 / EXTRAPOLATION_FACTOR <= V <= 40 * EXTRAPOLATION_FACTOR for _, V in p.drive) and p.drive[0][1] > 0
        assert 4 / EXTRAPOLATION_FACTOR <= p.W0 <= 6 * EXTRAPOLATION_FACTOR
        assert sum(d * V for d, V in p.drive) < 1.02 * apparatus.travel and p.duration < 1.8
        if p.kind == "modulation":
            assert 0.074 <= p.eps <= 0.301 and 50 <= p.f <= 125 and 0 < p.onset < p.duration
        run = run_of(p, diagnosis.experiment)
        W, _ = run.load(run.t)
        assert np.allclose(W, p.loads(run.t), rtol=1e-9) and run.t.size == np.ceil(p.duration / p.interval - 1e-6)
        assert run.t[-1] < p.duration and np.median(np.diff(run.t)) == pytest.approx(0.001 if p.eps else 0.002)


def test_a_run_begins_in_stable_sliding(diagnosis: Diagnosis) -> None:
    """Where a nudge would grow, the run begins fast enough that none does; where none can, it is not proposed."""
    design = Design(diagnosis.experiment, rival_models(diagnosis), 0)
    calm = replace(POOR, drive=((1.0, 30.0),), W0=3.0)
    slow = replace(POOR, drive=((1.0, 3.0),), W0=9.0)
    assert design.stably_started(calm) is not None and design.stably_started(calm)[0] == calm
    led = design.stably_started(slow)
    assert led is not None and led[0].drive[0][1] == 40.0 and led[0].drive[1][1] == 3.0
    assert design.stably_started(replace(slow, W0=100.0)) is None
    for proposal, grows in ((calm, False), (slow, True), (led[0], False)):
        run, rival = run_of(proposal, diagnosis.experiment), design.rivals[0]
        model = rival.problem.model
        p = run_parameters(model, rival.problem.experiment, run, {**rival.values(), "field_amplitude": 0.0})
        x = np.asarray(model.steady(p))
        nudged = x + 1e-4 * (np.array(model.states) == "ln_phi")
        V = Drive.constant(proposal.drive[0][1])
        t = np.linspace(0.0, 8.0, 4001)
        load = ConstantLoad(proposal.W0)
        motion = integrate(model, p, drive=V, load=load, t=t, start=nudged, atol=np.full(x.size, 1e-9))
        i = model.states.index("ln_phi")
        away = np.abs(motion.x[:, i] - x[i])
        assert away[2000:].max() > 1e-3 if grows else away[2000:].max() < 1e-4


def test_steps_of_the_load_where_it_has_been_stepped(tmp_path: Path) -> None:
    """Steps no larger than twice those shown, as fast, and the load within its range."""
    plans = (*PLANS[:1], Plan("loadstep", ((2.0, 10),), 5.0, 0.002, steps=((0.7, 1.5), (1.4, -1.5))))
    readings = {plan: np.zeros(plan.times().size) + 8.0 for plan in plans}
    for name, text in case_files("load", Physics(), readings).items():
        (tmp_path / name).write_text(text)
    apparatus = capabilities_of(read_experiment(tmp_path, registry=SHIPPED))
    assert apparatus.kinds == ("velocity steps", "slide-hold-slide", "load steps") and apparatus.jumps == (0.3,)
    assert apparatus.rise == pytest.approx(0.03, rel=0.05)
    stepped = [p for p in draw(apparatus, 60, np.random.default_rng(0)) if p.steps]
    assert len(stepped) == 20 and {np.sign(p.steps[0][1]) for p in stepped} == {1.0, -1.0}
    for p in stepped:
        W = p.loads(p.times())
        assert np.ptp(W) <= 0.61 * p.W0 and W.min() >= 2.0 and W.max() <= 10.1


def test_friction_per_micron_follows_the_load(diagnosis: Diagnosis) -> None:
    """Where the stiffness is stated for each newton, a run under another load has another spring."""
    stated = replace(diagnosis.experiment, stiffness_text="0.0525 1/um")
    run = run_of(replace(POOR, W0=8.0), stated)
    assert run.stiffness == pytest.approx(2 * stated.runs[0].stiffness) and stated.runs[0].load.rest(0.0) == 4.0
    assert run_of(POOR, diagnosis.experiment).stiffness == 0.21


def test_a_load_that_nothing_tells_is_left_alone(diagnosis: Diagnosis) -> None:
    """Friction alone is recorded, under a drive read from a column: the load stays the 1 N that stands for it."""
    e = diagnosis.experiment
    ramp = Drive.sequence([(0.8, 5.0, 20.0), (0.8, 20.0, 5.0)])
    runs = [replace(r, load=ConstantLoad(1.0), observable="friction", modulation=None, drive=ramp) for r in e.runs]
    apparatus = capabilities_of(replace(e, runs=tuple(runs), stiffness_text="0.04 1/um"))
    assert apparatus.kinds == ("velocity steps", "slide-hold-slide") and 5 <= min(apparatus.V) < max(apparatus.V) <= 20
    drawn = draw(apparatus, 10, np.random.default_rng(0))
    drawn += vary(drawn[0], apparatus, 3, np.random.default_rng(1))
    assert {p.W0 for p in drawn} == {1.0} and all(2.5 <= V <= 40 for p in drawn for _, V in p.drive if V)


# ---- what is told


def test_words_and_numbers_agree(diagnosis: Diagnosis, found: DiscriminatingRun) -> None:
    told = described(found, diagnosis.experiment)
    assert json.loads(json.dumps(told)) == told
    whole = " ".join(told["sentences"])
    for name in RIVALS:
        assert name in whole
    assert f"{found.gain:.3g}" in whole and f"{found.seconds:.3g} s" in whole and f"{found.at:.3g} s" in whole
    assert ("above" in whole) == (found.peak > 0) != ("below" in whole)
    assert f"amplitude = {found.proposal.eps!r}" in told["run"] and told["run"].startswith("[[runs]]\n")
    faint = replace(found, gain=2.0 * MIN_DESIGN_GAIN, seconds=12.0, repeats=4)
    assert "in 4 such runs, 12 s in all" in sentences(faint)[1]
    assert "No number of repeats" in sentences(replace(faint, seconds=None, repeats=None))[1]
    force = sentences(replace(found, unit="N", noise=1e-9))[2]
    assert " N (" in force and "noise" not in force


@pytest.mark.usefixtures("without_matplotlib")
def test_what_is_written_says_it(folder: Path, result: DiagnosisResult, found: DiscriminatingRun) -> None:
    """The answer has the experiment; what each hypothesis predicts is an experiment that `srf simulate` repeats."""
    out = folder.parent / "found"
    result.write(out)
    answer = json.loads((out / "answer.json").read_text())
    told = answer["experiment"]
    assert answer["verdict"] == "ambiguous" and told["discriminates"]
    assert told["gain"] == pytest.approx(found.gain, rel=1e-3)
    page = re.sub(r"\s+", " ", (out / "report.html").read_text())
    shown = to_text(result.table)
    assert all(s in shown and s in page for s in told["sentences"])
    assert "[[runs]]" in page and 'href="discriminating/linker-dieterich/experiment.toml"' in page
    for name in RIVALS:
        home = out / "discriminating" / name
        assert (home / "experiment.toml").read_text().endswith(told["run"])
        done = CliRunner().invoke(cli, ["simulate", str(home), "--csv"])
        assert done.exit_code == 0, done.output
        distance = re.search(r"root mean square distance from the recording ([0-9.e-]+) um", done.stderr)
        assert distance is not None and float(distance[1]) < 1e-4


def test_the_run_that_the_verdict_rests_on_is_drawn(result: DiagnosisResult) -> None:
    pytest.importorskip("matplotlib")
    first, *_ = result.plot().axes
    assert first.get_title(loc="left") in {r.name for r in result.location.runs} and first.get_ylabel() == "elongation [µm]"
