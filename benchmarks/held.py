"""What a second spring that holds the slider to its recording leaves at the true parameters, and how much there is to gain.

For cases of the independent generator whose truth is known: chi-squared per sample of every run, between slips, at the true
parameters, from a stiff hold to none, with knots at every and at every second sample of the record and with its noise left in;
then what one chain of holds, from the experiment's own start values, makes of the parameters, and what is free afterwards.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import Report

from srfcli.data.experiment import read_experiment
from srfcli.data.values import Experiment, Run
from srfcli.diagnosis import nudging as follow
from srfcli.diagnosis.hypotheses import Hypothesis, applicable
from srfcli.diagnosis.nudging import COARSE, LOOSE, Follower
from srfcli.inference.noise import Noise
from srfcli.inference.prediction import Hold
from srfcli.laws.registry import bundled_registry
from srfcli.validation.cases import make_case

LENGTHS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, None)  # slip lengths; None is free
CONCEALED = ("log-log-coupling", "second-state", "load-transmission")
TRULY = {"lambda": "lam", "amplitude": "distortion"}  # the generator's names of parameters that have others here


def record(experiment: Experiment, run: Run, spacing: float, *, calm: bool) -> Any:
    """Return the spline of a record with knots so many samples apart, its noise taken out or left in."""
    used = run.used & np.isfinite(run.observed)
    y = follow.calmed(run, run.observed, used) if calm else run.observed
    return follow.smoothed(run.t, y, used, spacing * float(np.median(np.diff(run.t))))


def main() -> None:
    """Print the tables for one case of each effect."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--seed", type=int, default=5)
    seed = asked.parse_args().seed
    report, registry = Report("held", __doc__ or ""), bundled_registry()
    for effect in CONCEALED:
        folder = Path(tempfile.mkdtemp()) / "case"
        truth = make_case(folder, seed, effects=(effect,), size=0.7, rough=False, strengths=False)
        experiment = read_experiment(folder, registry=registry, holdout=False)
        chosen = [e for e in applicable(registry, experiment, None)[0] if e.reported == effect]
        hypothesis, follower = Hypothesis(tuple(chosen)), Follower(registry, experiment, None)
        problem = follower.problem(hypothesis, {})
        theta = np.array([truth["physics"][TRULY.get(name, name)] for name in problem.names])
        gauge = truth["gauge"]
        report.say()
        report.say(
            f"{effect}, {truth['truth']}, noise with a correlation of {gauge['lag1']:.2f}: chi-squared per sample at the truth"
        )
        rows = []
        for spacing, calm, said in (
            (1.0, True, "as it is"),
            (2.0, True, "knots at every second sample"),
            (1.0, False, "noise left in"),
        ):
            for length in LENGTHS if said == "as it is" else LENGTHS[1:4]:
                held = follower.problem(hypothesis, {}, length)
                if length is not None and held.hold is not None:
                    records = {r.name: record(experiment, r, spacing, calm=calm) for r in experiment.runs}
                    held = replace(held, hold=Hold(held.hold.table, held.hold.stiffness, records))
                rows.append(
                    [
                        said,
                        "free" if length is None else f"{length:g}",
                        *chi_squared(held, follower.between, theta, gauge["sigma"]),
                    ]
                )
        report.table(["record", "slip lengths", *(r.name for r in follower.between)], rows)
        noise = {
            r.name: Noise(gauge["sigma"] * np.sqrt(1 - gauge["lag1"] ** 2), (gauge["lag1"],), gauge["sigma"])
            for r in experiment.runs
        }
        began = time.process_time()
        place, reduced = follower.led(hypothesis, {}, noise, (1.0, LOOSE))
        led = time.process_time() - began
        away = ", ".join(
            f"{n} {100 * (a / b - 1):+.1f} %" for n, a, b in zip(problem.names, place, theta, strict=True) if b
        )
        report.say(
            f"led over 1 and {LOOSE:g} slip lengths in {led:.1f} s: chi-squared {reduced:.2f}, off the truth by {away}"
        )
        plain, _ = follower.descend(problem, problem.start, noise, COARSE)
        free = follower.released(hypothesis, place, reduced, noise)
        report.say(f"set free: chi-squared {free.reduced:.2f}; "
                   f"descended freely from the same start values: {sum_of(problem, plain, gauge['sigma']):.1f}")  # fmt: skip


def chi_squared(problem: Any, runs: tuple[Run, ...], theta: np.ndarray, sigma: float) -> list[str]:
    """Return the mean square over the gauge's variance of each run, between its slips."""
    found = []
    for run in runs:
        rest = (problem.predicted(run, theta, slopes=False).y - run.observed)[run.used]
        found.append(f"{float(np.mean(rest**2)) / sigma**2:.2f}")
    return found


def sum_of(problem: Any, theta: np.ndarray, sigma: float) -> float:
    """Return chi-squared per sample over all runs."""
    rest = np.concatenate([(problem.predicted(r, theta, slopes=False).y - r.observed)[r.used] for r in problem.runs])
    return float(np.mean(rest**2)) / sigma**2


if __name__ == "__main__":
    main()
