"""The state-space fit on recordings of another code: coverage of its intervals, and whether it is found from values 30 % off.

usage: state_space.py [--repeats N] [--workers N] [--without ridges|weights|faint] [--only-print]

N repeats of each kind of track are made, 50 if that is left out.

The recordings are those of the sealed trials' generator, which shares no equation and no integrator with the fit: four runs
(steps of velocity, stick-slip, a load step, slides and holds), gauge noise of 0.02 um quantised at 0.005 um. Parameters are drawn
anew in each repeat, start values are the truth times 0.7 or 1.3, each, within the bounds of the file (mu0: 0.9 or 1.1). A fit
has found its maximum where one from the true parameters is not likelier by more than 1. `--without` leaves a part of the search
out: that along ridges, the weights with which a fit begins, so that all readings count alike from the start, or what fields
too faint to be told add to the errors. Each repeat is kept in `results/state_space.jsonl` as soon as it is done: an interrupted
run goes on where it stopped. `--only-print` tells what is there and fits nothing.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import common
import numpy as np

KINDS = ((0.0, False), (1e-4, False), (1e-4, True), (3e-4, False), (3e-4, True))  # amplitude of the field; one for all runs
LENGTH = 6.0
KEPT = common.Kept("state_space", ("seed", "amplitude", "shared", "without"))
NAMES = {"mu0": "mu0", "A": "A", "B": "B", "D0": "D0", "Vsat": "Vsat", "lambda": "lam"}


def plans():
    from srfcli.validation.slider import Plan

    return (
        Plan("steps", ((2, 5), (1, 20), (1, 50), (1, 10)), 5.0, 0.004),
        Plan("stickslip", ((0.5, 12), (3.5, 8)), 9.0, 0.004),
        Plan("loadstep", ((4, 10),), 5.0, 0.004, steps=((1.5, 1.5), (3, -1.5))),
        Plan("holds", ((1, 10), (2, 0.1), (1.5, 10)), 5.0, 0.004),
    )


def one(task: tuple[int, float, bool, str]) -> dict[str, object]:
    """Return what one repeat says: errors in standard errors, log likelihoods from far and from the truth, CPU."""
    from srfcli.codegen.model import open_model
    from srfcli.data.experiment import read_experiment
    from srfcli.inference import state_space
    from srfcli.inference.fit import fit_problem
    from srfcli.inference.state_space import fit_state_space
    from srfcli.laws.registry import load_registry
    from srfcli.validation.cases import START_SCATTER, case_files
    from srfcli.validation.gauge import Gauge, read_gauge
    from srfcli.validation.slider import SMOOTH, Physics, Track, move

    seed, amplitude, shared, without = task
    rng = np.random.default_rng([seed, int(1e6 * amplitude), shared])
    usual = Physics()
    base = replace(usual, **{n: getattr(usual, n) * float(np.exp(s * rng.standard_normal())) for n, s in START_SCATTER.items()})
    tracks = [int(rng.integers(2**31))] * 4 if shared else rng.integers(2**31, size=4).tolist()
    readings = {}
    for plan, track in zip(plans(), tracks, strict=True):
        own = Track(amplitude, LENGTH, track) if amplitude else SMOOTH
        readings[plan] = read_gauge(move(replace(base, track=own), plan).u, Gauge(), rng)
    registry = load_registry()
    with tempfile.TemporaryDirectory() as folder:
        for name, text in case_files("made", base, readings).items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        experiment = read_experiment(Path(folder), registry=registry)
    truth = {name: getattr(base, field) for name, field in NAMES.items()}
    far = {n: v * (1 + (0.1 if n == "mu0" else 0.3) * rng.choice([-1, 1])) for n, v in truth.items()}
    model = open_model(registry, **asdict(experiment.choice), random_field=True)
    problem = fit_problem(model, experiment)

    def start(values: dict[str, float]) -> np.ndarray:
        return np.clip(np.array([values[n] for n in problem.names]), problem.lower, problem.upper)

    if without == "ridges":
        state_space.RIDGE_REACH = 0.0
    if without == "scans":
        state_space.PEAK = np.inf
    if without == "weights":
        state_space.WIDTHS = ()
    if without == "faint":
        state_space._with_faint_fields = lambda fitted, field_likelihood: fitted
    begun = time.process_time()
    found = fit_state_space(replace(problem, start=start(far)))
    used = time.process_time() - begun
    near = fit_state_space(replace(problem, start=start(truth)))
    errors = np.sqrt(np.diag(found.covariance))
    off = {n: (found.values[n] - truth[n]) / errors[found.likelihood.names.index(n)] for n in truth}
    return {
        "seed": seed, "amplitude": amplitude, "shared": shared, "without": without, "off": off,
        "missed": near.log_likelihood - found.log_likelihood,
        "status": found.maximum.status.value, "smooth": found.smooth, "field": found.values["field_amplitude"], "cpu": used,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--without", choices=("ridges", "scans", "weights", "faint"), default="")
    parser.add_argument("--only-print", action="store_true")
    asked = parser.parse_args()
    if not asked.only_print:
        tasks = [(seed, *kind, asked.without) for seed in range(asked.repeats) for kind in KINDS]
        KEPT.add(one, tasks, asked.workers)
    report = common.Report("state_space", __doc__ or "")
    report.say(f"# tracks correlated by (1 + d/l) exp(-d/l), l = {LENGTH:g} um")
    rows = KEPT.rows()
    for without in sorted({key[-1] for key in rows}):
        report.say("#" + (f" without {without}" if without else ""))
        report.table(
            ("field", "track", "repeats", *NAMES, "all", "sd/stderr", "maximum found", "status ok", "no field", "CPU, median"),
            [
                told(kind, own)
                for kind in KINDS
                if (own := [r for r in rows.values() if (r["amplitude"], r["shared"], r["without"]) == (*kind, without)])
            ],
        )


def told(kind: tuple[float, bool], answers: list[dict[str, Any]]) -> tuple[object, ...]:
    """Return the line of the table for one kind of track."""
    amplitude, shared = kind
    off = np.array([list(a["off"].values()) for a in answers])
    inside = [f"{100 * np.mean(np.abs(column) < 1.96):.0f}" for column in off.T]
    found = sum(a["missed"] <= 1.0 for a in answers)
    return (
        f"{amplitude:.0e}" if amplitude else "0", "one" if shared else "each its own", len(answers), *inside,
        f"{100 * np.mean(np.abs(off) < 1.96):.1f} %", f"{off.std():.2f}", f"{found} of {len(answers)}",
        sum(a["status"] == "ok" for a in answers), sum(bool(a["smooth"]) for a in answers),
        f"{np.median([a['cpu'] for a in answers]):.1f} s",
    )  # fmt: skip


if __name__ == "__main__":
    main()
