"""Do the intervals of `srf fit` cover? Seeded repeats of one experiment, with white and with coloured gauge noise.

    python benchmarks/coverage.py [--repeats 100] [--workers 2]

The runs are those of a slider on PMMA: velocity steps, stick-slip, the onset of a modulation, a strong modulation. Each repeat
draws new noise, starts from values that are off by up to 15 %, and asks whether each 95 % interval holds the true value.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from srfcli.inference.fit import fit, fit_problem
from srfcli.inference.prediction import predict
from srfcli.model import open_model
from srfcli.numerics.load import ConstantLoad, Modulation
from srfcli.numerics.program import Drive
from srfcli.recording.values import Experiment, FitParameter, ModelChoice, Run
from srfcli.registry import load_registry

TRUE = {"mu0": 0.33, "A": 0.0126, "B": 0.0246, "D0": 0.395, "Vsat": 235.0, "lambda": 0.54}
BOUNDS = {
    "mu0": (0.2, 0.5),
    "A": (0.006, 0.03),
    "B": (0.01, 0.06),
    "D0": (0.1, 1.5),
    "Vsat": (50, 2000),
    "lambda": (0.2, 1.5),
}
NOISE, QUANTUM = 0.02, 0.005
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


def one(task: tuple[int, float]) -> tuple[list[float], float, float, str]:
    """Return the errors of one repeat in standard errors, the CPU time, rms over noise and how it ended."""
    seed, lag = task
    problem = fit_problem(open_model(load_registry()), experiment(seed, lag))
    begun = time.process_time()
    found = fit(problem)
    z = [(found.values[n] - TRUE[n]) / found.stderr[n] for n in TRUE]
    return z, time.process_time() - begun, found.rms_over_noise(), found.status.value


def main() -> None:
    """Print coverage for white and for coloured noise."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    for lag in (0.0, 0.85):
        with ProcessPoolExecutor(chosen.workers) as pool:
            found = list(pool.map(one, [(seed, lag) for seed in range(chosen.repeats)]))
        z = np.array([f[0] for f in found])
        print(f"gauge noise {NOISE} um, lag-1 {lag}, quantised at {QUANTUM} um, {chosen.repeats} repeats, seeds 0..")
        print("parameter   inside 95 %   sd of z   mean of z   worst |z|")
        for k, name in enumerate(TRUE):
            c = z[:, k]
            print(
                f"{name:9s}   {100 * np.mean(np.abs(c) < 1.96):9.1f} %   {c.std():7.3f}   "
                f"{c.mean():+9.3f}   {np.abs(c).max():9.2f}"
            )
        print(
            f"all: {100 * np.mean(np.abs(z) < 1.96):.1f} % inside; CPU {np.median([f[1] for f in found]):.1f} s a fit (median)"
        )
        ratio = np.array([f[2] for f in found])
        print(
            f"rms over noise {ratio.mean():.4f} +- {ratio.std():.4f}; statuses {sorted({f[3] for f in found})}\n",
            flush=True,
        )


if __name__ == "__main__":
    main()
