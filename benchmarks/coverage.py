"""Do the intervals of `srf fit` cover? Seeded repeats of one experiment, with white and with coloured gauge noise.

    python benchmarks/coverage.py [--repeats 100] [--workers 2] [--only-print]

The runs are those of a slider on PMMA: velocity steps, stick-slip, the onset of a modulation, a strong modulation. Each repeat
draws new noise, starts from values that are off by up to 15 %, and asks whether each 95 % interval holds the true value.

Each fit is kept in `results/coverage.jsonl` as soon as it is done: an interrupted run goes on where it stopped, and one with more
repeats adds to what is there. `--only-print` tells what is there and fits nothing.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from common import Kept, Report

from srfcli.codegen.model import open_model
from srfcli.data.values import Experiment, FitParameter, ModelChoice, Run
from srfcli.inference.fit import fit_problem
from srfcli.inference.prediction import predict
from srfcli.inference.state_space import as_fit, fit_state_space
from srfcli.laws.registry import load_registry
from srfcli.motion.imposed import ConstantLoad, Drive, Modulation

TRUE = {"mu0": 0.33, "A": 0.0126, "B": 0.0246, "D0": 0.395, "Vsat": 235.0, "lambda": 0.54}
BOUNDS = {"mu0": (0.2, 0.5), "A": (0.006, 0.03), "B": (0.01, 0.06), "D0": (0.1, 1.5), "Vsat": (50, 2000), "lambda": (0.2, 1.5)}
NOISE, QUANTUM = 0.02, 0.005
LAGS = (0.0, 0.85)
KEPT = Kept("coverage", ("seed", "lag"))
RUNS = [
    ("steps", Drive.steps([(0, 5.0), (1, 20.0), (2, 5.0), (3.5, 50.0), (4.2, 10.0)]), ConstantLoad(5.0), 6.0, 250),
    ("stickslip", Drive.steps([(0, 12.0), (0.5, 8.0)]), ConstantLoad(9.0), 4.0, 250),
    ("onset", Drive.steps([(0, 12.0), (0.5, 8.0)]), Modulation(9.0, 0.09, 120.0, 1.5), 2.5, 1000),
    ("strong", Drive.constant(20.0), Modulation(7.0, 0.2, 120.0, 0.4), 1.2, 1000),
]


def experiment(seed: int, lag: float) -> Experiment:
    """Return the experiment with the noise of this seed, AR(1) of this lag-1 correlation, and start values that are off."""
    rng = np.random.default_rng(seed)
    model = open_model(load_registry())
    start = {n: v * (1 + rng.uniform(-0.15, 0.15)) for n, v in TRUE.items()}
    start["mu0"] = TRUE["mu0"] * (1 + rng.uniform(-0.05, 0.05))
    parameters = tuple(FitParameter(n, start[n], *BOUNDS[n], False, "1") for n in TRUE)
    runs = []
    for name, drive, load, duration, rate in RUNS:
        t = np.arange(round(duration * rate)) / rate
        run = Run(name, Path(name), False, 0.0, "steady", t, np.zeros(t.size), "elongation", np.ones(t.size, bool),
                  drive, load, 0.21, None, QUANTUM, ())  # fmt: skip
        empty = Experiment(
            Path(), "", ModelChoice("srf-vsat", "dieterich", "elastic", True), 2.37e-6, "0.21 N/um", (), (run,), ()
        )
        y = predict(model, empty, run, TRUE, rtol=1e-9).y + coloured(rng, t.size, lag)
        runs.append(Run(**{**run.__dict__, "observed": QUANTUM * np.round(y / QUANTUM)}))
    return Experiment(Path(), "", empty.choice, 2.37e-6, "0.21 N/um", parameters, tuple(runs), ())


def coloured(rng: np.random.Generator, n: int, lag: float) -> np.ndarray:
    """Return AR(1) noise of standard deviation NOISE."""
    white = rng.standard_normal(n) * NOISE * np.sqrt(1 - lag**2)
    out = np.empty(n)
    out[0] = rng.standard_normal() * NOISE
    for i in range(1, n):
        out[i] = lag * out[i - 1] + white[i]
    return out


def one(task: tuple[int, float]) -> dict[str, Any]:
    """Return what is kept of one repeat: the errors in standard errors, the CPU time, rms over noise and how it ended."""
    seed, lag = task
    problem = fit_problem(open_model(load_registry(), random_field=True), experiment(seed, lag))
    begun = time.process_time()
    found = as_fit(fit_state_space(problem))
    spent = time.process_time() - begun
    z = [float((found.values[n] - TRUE[n]) / found.stderr[n]) for n in TRUE]
    return {"seed": seed, "lag": lag, "z": z, "cpu": spent, "rms": float(found.rms_over_noise()), "status": found.status.value}


def tell(report: Report, lag: float, rows: list[dict[str, Any]]) -> None:
    """Say how well the intervals cover in the repeats with noise of this lag-1 correlation."""
    z = np.array([row["z"] for row in rows])
    seeds = sorted(row["seed"] for row in rows)
    report.say()
    report.say(
        f"gauge noise {NOISE} um, lag-1 {lag}, quantised at {QUANTUM} um: {len(rows)} repeats, seeds {seeds[0]} to {seeds[-1]}"
    )
    inside = np.abs(z) < 1.96
    table = [
        [
            name,
            f"{100 * inside[:, k].mean():.1f} %",
            f"{z[:, k].std():.3f}",
            f"{z[:, k].mean():+.3f}",
            f"{np.abs(z[:, k]).max():.2f}",
        ]
        for k, name in enumerate(TRUE)
    ]
    report.table(["parameter", "inside 95 %", "sd of z", "mean of z", "worst |z|"], table)
    rms, cpu = np.array([row["rms"] for row in rows]), np.array([row["cpu"] for row in rows])
    report.say(
        f"all: {100 * inside.mean():.1f} % inside; CPU {np.median(cpu):.1f} s a fit (median), {cpu.max():.1f} s the longest"
    )
    report.say(f"rms over noise {rms.mean():.4f} +- {rms.std():.4f}; statuses {sorted({row['status'] for row in rows})}")


def main() -> None:
    """Fit, then print coverage for white and for coloured noise."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only-print", action="store_true")
    chosen = parser.parse_args()
    if not chosen.only_print:
        KEPT.add(one, [(seed, lag) for seed in range(chosen.repeats) for lag in LAGS], chosen.workers)
    report = Report("coverage", __doc__ or "")
    for lag in LAGS:
        rows = [row for (seed, of), row in sorted(KEPT.rows().items()) if of == lag and seed < chosen.repeats]
        if rows:
            tell(report, lag, rows)


if __name__ == "__main__":
    main()
