"""The state-space fit on recordings of another code: coverage of its intervals, and whether it is found from values 30 % off.

usage: state_space.py [--repeats N] [--workers N] [--without ridges|weights|faint]      N of each kind of track, 50 if left out

The recordings are those of the sealed trials' generator, which shares no equation and no integrator with the fit: four runs
(steps of velocity, stick-slip, a load step, slides and holds), gauge noise of 0.02 um quantised at 0.005 um. Parameters are drawn
anew in each repeat, start values are the truth times 0.7 or 1.3, each, within the bounds of the file (mu0: 0.9 or 1.1). A fit
has found its maximum where one from the true parameters is not likelier by more than 1. `--without` leaves a part of the search
out: that along ridges, the weights with which a fit begins, so that all readings count alike from the start, or what fields
too faint to be told add to the errors.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import common
import numpy as np

AMPLITUDES, LENGTH = (0.0, 1e-4, 3e-4), 6.0
NAMES = {"mu0": "mu0", "A": "A", "B": "B", "D0": "D0", "Vsat": "Vsat", "lambda": "lam"}


def plans():
    from srfcli.validation.slider import Plan

    return (
        Plan("steps", ((2, 5), (1, 20), (1, 50), (1, 10)), 5.0, 0.004),
        Plan("stickslip", ((0.5, 12), (3.5, 8)), 9.0, 0.004),
        Plan("loadstep", ((4, 10),), 5.0, 0.004, steps=((1.5, 1.5), (3, -1.5))),
        Plan("holds", ((1, 10), (2, 0.1), (1.5, 10)), 5.0, 0.004),
    )


def one(task: tuple[float, bool, int, str]) -> dict[str, object]:
    """Return what one repeat says: errors in standard errors, log likelihoods from far and from the truth, CPU."""
    from srfcli.codegen.model import open_model
    from srfcli.data.experiment import read_experiment
    from srfcli.inference import state_space
    from srfcli.inference.fit import fit_problem
    from srfcli.inference.state_space import fit_state_space
    from srfcli.laws.registry import load_registry
    from srfcli.validation.cases import SPREAD, case_files
    from srfcli.validation.gauge import Gauge, read_gauge
    from srfcli.validation.slider import SMOOTH, Physics, Track, move

    amplitude, shared, seed, without = task
    rng = np.random.default_rng([seed, int(1e6 * amplitude), shared])
    usual = Physics()
    base = replace(usual, **{n: getattr(usual, n) * float(np.exp(s * rng.standard_normal())) for n, s in SPREAD.items()})
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
        state_space.REACH = 0.0
    if without == "weights":
        state_space.WIDTHS = ()
    if without == "faint":
        state_space._with_faint_fields = lambda fitted, rough: fitted
    begun = time.process_time()
    found = fit_state_space(replace(problem, start=start(far)))
    used = time.process_time() - begun
    near = fit_state_space(replace(problem, start=start(truth)))
    errors = np.sqrt(np.diag(found.covariance))
    off = {n: (found.values[n] - truth[n]) / errors[found.likelihood.names.index(n)] for n in truth}
    return {
        "amplitude": amplitude, "shared": shared, "seed": seed, "off": off, "missed": near.log_likelihood - found.log_likelihood,
        "status": found.maximum.status.value, "smooth": found.smooth, "field": found.values["field_amplitude"], "cpu": used,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--without", choices=("ridges", "weights", "faint"), default="")
    asked = parser.parse_args()
    report = common.Report("state_space", __doc__ or "")
    kinds = [(a, shared) for a in AMPLITUDES for shared in ((False, True) if a else (False,))]
    if asked.without:
        report.say(f"# without {asked.without}")
    report.say(f"# {asked.repeats} repeats of each kind of track, correlated by (1 + d/l) exp(-d/l), l = {LENGTH:g} um")
    rows = []
    with ProcessPoolExecutor(asked.workers) as pool:
        for amplitude, shared in kinds:
            answers = list(pool.map(one, [(amplitude, shared, seed, asked.without) for seed in range(asked.repeats)]))
            off = np.array([list(a["off"].values()) for a in answers])
            inside = [f"{100 * np.mean(np.abs(column) < 1.96):.0f}" for column in off.T]
            missed = sum(a["missed"] > 1.0 for a in answers)
            rows.append(
                (f"{amplitude:.0e}" if amplitude else "0", "one" if shared else "each its own", *inside,
                 f"{100 * np.mean(np.abs(off) < 1.96):.1f} %", f"{off.std():.2f}", f"{asked.repeats - missed} of {asked.repeats}",
                 sum(a["status"] == "ok" for a in answers), sum(bool(a["smooth"]) for a in answers),
                 f"{np.median([a['cpu'] for a in answers]):.1f} s")
            )  # fmt: skip
            lost = [(a["seed"], round(a["missed"], 1)) for a in answers if a["missed"] > 1]
            print(rows[-1], lost, file=sys.stderr, flush=True)
    report.table(
        ("field", "track", *NAMES, "all", "sd/stderr", "maximum found", "status ok", "no field", "CPU, median"),
        rows,
    )


if __name__ == "__main__":
    main()
