"""Sparse regression (PySINDy) on the cases of a sealed bank: which registered effect, if any, is missing?

    pip install pysindy        # nothing else in this project needs it
    python benchmarks/sparse_regression.py BANK TRUTHS [--known known.jsonl] [--beside answers.jsonl] [--kept FOLDER]

BANK is a folder of cases as `srf prove` makes, TRUTHS their truths; known.jsonl and answers.jsonl are those of the trial:
what was visible, and what the diagnosis said, which is then marked beside it. TRUTHS is opened when every case is answered.

Given are the baseline as this project fits it while held, its simulated motion, the noise's level and colour, and the
true form of every registered effect. Recordings are smoothed by local cubics, under a modulation with its harmonics, in the
widest window that agrees with all narrower ones; where the baseline's motion is near, the distance from it is smoothed.
Slip velocity, age and friction follow by reading the equations backwards (sparse_signals.py). The friction left over,
weighted by its error, is regressed on one column for each effect, its derivative by the effect's size; two where there is a
phase, at the best of scanned wavelengths, onsets and lengths. The baseline's parameters are free beside. STLSQ at fifteen
thresholds and FROLS propose sets; of these the smallest is kept that does as well as the best, within two standard errors,
when one run after another is left out, and of it what at least 0.6 of twelve bagged fits hold. Sizes are refined on the
nonlinear equations, and the selection is repeated there until it stays (sparse_selection.py). Held-out runs thus take part
in the choice, which the diagnosis denies itself.

An empty set means none. A remainder, of runs left out, above that of a simulated recording of the baseline, read in the
same way, means unknown: by 4 %, and by more than chance gives once in 10^4, which are the diagnosis's margins. Before that,
a track is allowed for: a spline over slip that all runs share. A second set of tables leaves out the question of what
remains. CPU seconds are one thread's, the baseline's fit among them.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from common import Report
from marked import heading, marked, tell
from sparse_selection import Reading, choose, remainder
from sparse_signals import Array, Baseline, Inverse, Signals, columns, guided, signals

from srfcli.codegen.model import open_model
from srfcli.data.experiment import read_experiment
from srfcli.data.gauge import find_noise
from srfcli.data.values import Run
from srfcli.diagnosis.search import ModelSearch
from srfcli.laws.registry import Registry, load_registry
from srfcli.validation.blind import FAILED, Answer, failed, read_answers, write_answers
from srfcli.validation.cases import unseal
from srfcli.validation.marks import GradedAnswer

MARGIN, CHANCE = 1.04, 3.72  # of the remainder over that of a simulated baseline; standard errors of one in 10^4
LEAST_NOISE = 0.005  # um


def fitted_baseline(registry: Registry, folder: Path, kept: Path | None) -> tuple[dict[str, float], float]:
    """Return the baseline's parameters as the diagnosis fits them, on a random friction field, and CPU s."""
    path = kept / f"{folder.parent.name}-{folder.name}.json" if kept else None
    if path is not None and path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
    else:
        begun = time.process_time()
        experiment = read_experiment(folder, registry=registry, holdout=False)
        fitted = ModelSearch(registry, experiment).fit(None)
        names = fitted.fit.likelihood.problem.names
        found = {"values": {n: fitted.fit.values[n] for n in names}, "cpu": [time.process_time() - begun]}
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(found), encoding="utf-8")
    return found["values"], sum(found["cpu"])


def noise_of(run: Run) -> tuple[float, float]:
    """Return level in um and lag-1 correlation of a run's noise."""
    spacing = float(np.median(np.diff(run.t)))
    about = find_noise([run.observed], spacing, cycles=run.modulation[0] * spacing if run.modulation else None)
    own, next_ = about.covariance(np.array([0.0, spacing]))
    return max(about.total, LEAST_NOISE), min(max(next_ / own, 0.0), 0.95)


def read(registry: Registry, folder: Path, start: dict[str, float]) -> tuple[Reading, Reading]:
    """Return the reading of a case, and that of a simulated recording of its baseline, with errors calibrated on the latter."""
    experiment = read_experiment(folder, registry=registry)
    model = open_model(registry, **asdict(experiment.choice))
    base, rng = Baseline.of(experiment), np.random.default_rng(1)
    seen = np.array([noise_of(run) for run in experiment.runs])
    level, lag1 = float(np.median(seen[:, 0])), float(np.median(seen[:, 1]))
    bounds = {q.name: (q.lower, q.upper) for q in experiment.parameters if not q.fixed}
    ours, theirs = [], []
    for run in experiment.runs:
        guide = guided(model, experiment, run, start)
        ours.append(signals(run, noise=level, lag1=lag1, guide=guide))
        if guide is not None:
            theirs.append(signals(simulated(run, guide[0], level, lag1, rng), noise=level, lag1=lag1, guide=guide))
    null = Reading(tuple(theirs), base, start, bounds)
    inflation = {s.name: inflated(s, columns(s, base, start, ())[0]) for s in null.runs}
    return Reading(tuple(ours), base, start, bounds, inflation), replace(null, inflation=inflation)


def simulated(run: Run, u: Array, level: float, lag1: float, rng: np.random.Generator) -> Run:
    """Return a run in which the gauge shows u (n,) with noise of this level and correlation, in the run's own quanta."""
    from scipy.signal import lfilter

    draws = rng.standard_normal(u.size)
    draws[1:] *= np.sqrt(1 - lag1**2)
    noisy = u + level * lfilter([1.0], [1.0, -lag1], draws)
    return replace(run, observed=np.round(noisy / run.quantum) * run.quantum if run.quantum else noisy)


def inflated(s: Signals, found: Inverse) -> Array:
    """Return (n,) by how much the residual of a simulated baseline exceeds its standard error, eight stretches of a run apart."""
    out = np.ones(s.t.size)
    for piece in np.array_split(np.arange(s.t.size), 8):
        z = (found.r / found.error)[piece][found.usable[piece]]
        out[piece] = max(float(np.sqrt(np.mean(z**2))), 1.0) if z.size > 5 else 1.0
    return out


def unexplained(ours: Array, null: Array) -> bool:
    """Return whether a remainder, runs left out in turn, is above a simulated baseline's by the margins of the diagnosis."""
    error = np.hypot(ours.std() / np.sqrt(ours.size), null.std() / np.sqrt(null.size))
    return bool(ours.mean() > MARGIN**2 * null.mean() and ours.mean() - null.mean() > CHANCE * error)


def answer_case(registry: Registry, folder: Path, kept: Path | None) -> Answer:
    """Return what sparse regression says of a case."""
    start, fitting = fitted_baseline(registry, folder, kept)
    begun = time.process_time()
    reading, null = read(registry, folder, start)
    for track in (False, True):
        chosen = choose(reading, track=track)
        usual = remainder(null, null.start, null.base.free, track)
        lost = unexplained(chosen.blocks, usual)
        if not lost:
            break
    verdict = "unknown" if lost else "identified" if chosen.effects else "none"
    said = verdict if verdict != "identified" else "+".join(chosen.effects)
    stated = min((chosen.inclusion.get(e, 0.0) for e in chosen.effects), default=1.0) if verdict == "identified" else 1.0
    note = f"remainder {np.sqrt(chosen.blocks.mean()):.3f}, of noise {np.sqrt(usual.mean()):.3f}; " + (
        f"{'with' if track else 'without'} a track; set {'+'.join(chosen.effects) or 'empty'}; baseline {fitting:.1f} s"
    )
    return Answer(
        folder.name,
        verdict,
        chosen.effects if verdict == "identified" else (),
        {said: stated},
        parameters={name: {} for name in chosen.effects},
        cpu=fitting + time.process_time() - begun,
        failure=note,
    )


def ungated(answer: Answer) -> Answer:
    """Return what the set of effects says, whatever remains."""
    effects = tuple(answer.parameters)
    verdict = answer.verdict if answer.verdict == FAILED else "identified" if effects else "none"
    return replace(answer, verdict=verdict, effects=effects, confidence={})


def answered(bank: Path, kept: Path | None) -> list[Answer]:
    """Return the answers to all cases of a bank; those in the folder `kept` are not sought again."""
    registry, path = load_registry(), kept / f"answers-{bank.name}.jsonl" if kept else None
    answers = read_answers(path) if path else {}
    for folder in sorted(p for p in bank.iterdir() if p.is_dir()):
        if folder.name not in answers:
            try:
                answers[folder.name] = answer_case(registry, folder, kept)
            except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
                answers[folder.name] = failed(folder.name, f"{type(error).__name__}: {error}")
            found = answers[folder.name]
            print(folder.name, found.said, f"{found.cpu:.1f} s", found.failure, flush=True)
        if path:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_answers(path, answers.values())
    return [answers[name] for name in sorted(answers)]


def main() -> None:
    """Answer every case of a bank, mark the answers, print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bank", type=Path)
    parser.add_argument("truths", type=Path)
    parser.add_argument("--known", type=Path, help="known.jsonl of the trial: what was visible")
    parser.add_argument("--beside", type=Path, help="answers.jsonl of the trial: the diagnosis's answers, marked beside")
    parser.add_argument("--kept", type=Path, help="folder of the baseline's fits and the answers: a later run goes on there")
    parser.add_argument("--note", help="what to say of the bank at the head of the results")
    given = parser.parse_args()
    warnings.simplefilter("ignore")  # PySINDy warns of every empty set
    answers = answered(given.bank, given.kept)
    truths = unseal(given.bank, given.truths)  # only now
    report = Report("sparse_regression", __doc__ or "")
    heading(report, f"pysindy {version('pysindy')}; bank {given.bank.name}", len(answers), given.known)
    if given.note:
        report.say(f"# {given.note}")
    tell(report, marked(truths, answers, given.known), "sparse regression")
    tell(report, marked(truths, list(map(ungated, answers)), given.known), "sparse regression, whatever remains")
    if given.beside:
        theirs = read_answers(given.beside)
        tell(report, marked(truths, [theirs[n] for n in sorted(theirs) if n in truths], given.known), "srf diagnose")
    report.say("\ncases; set: what the regression kept")
    head = ("case", "concealed", "track", "said", "set", "right", "remainder, rms over its error")
    report.table(head, [row_of(m) for m in marked(truths, answers, given.known)])


def row_of(m: GradedAnswer) -> tuple[str, ...]:
    """Return what is told of one case."""
    note, track = m.answer.failure.partition("; set")[0], "rough" if m.rough else "smooth"
    hidden, kept = ("+".join(names) for names in (m.hidden, m.answer.parameters))
    said, right = m.answer.said or m.answer.verdict, "yes" if m.right else "no"
    return m.case, hidden or "nothing", track, said, kept or "-", right, note


if __name__ == "__main__":
    main()
