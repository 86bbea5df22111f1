"""Velocity steps of two laboratories, fitted by `srf fit`, beside what was published.

    python examples/real_steps.py DATA

DATA holds the folders psu-p655-ghost-rocks and basalt-b819-velocity-step; the recordings are no part of this project. Experiments
are written to a temporary folder and fitted through the same functions as `srf fit --trend slip` uses.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from srfcli.codegen.model import open_model
from srfcli.data.experiment import read_experiment
from srfcli.inference.fit import Problem, fit, fit_problem
from srfcli.laws.registry import load_registry

EXPERIMENT = """format = "srf-experiment/1"
title = "{title}"

[apparatus]
stiffness = "{stiffness} 1/um"

[model]
law = "dieterich-ruina"
ageing = "{ageing}"
interface = "rigid"
inertia = false

[parameters]
mu0 = {{ value = {mu0}, lower = 0.4, upper = 0.8 }}
A = {{ value = 0.006, lower = 0.001, upper = 0.03 }}
B = {{ value = 0.005, lower = 0.0005, upper = 0.03 }}
D0 = {{ value = {D0}, lower = 1.0, upper = 100.0 }}
V0 = {{ value = {V0}, fixed = true }}
{K}
[columns]
time = {{ name = "{time}", unit = "s" }}
friction = {{ name = "{friction}", unit = "1" }}

[[runs]]
name = "step"
file = "{file}"
window = {window}
load = "{load} N"
drive = {drive}
"""
P655 = {
    "title": "p655, 2.3 to 23 um/s at 100 MPa", "mu0": 0.487, "V0": 2.286, "time": "time_s", "friction": "friction", "load": 100,
    "window": "[3830.0, 3875.0]", "file": "psu-p655-ghost-rocks/p655_reduced.csv",
    "drive": "[{ duration = 3851.36, velocity = 2.286 }, { duration = 100.0, velocity = 22.86 }]",
}  # fmt: skip
BASALT = {
    "title": "b819, 3 to 10 um/s at 20 MPa", "mu0": 0.6, "V0": 3.0, "time": "Time(s)", "friction": "Friction", "load": 20,
    "window": "[11650.0, 11720.0]", "file": "basalt-b819-velocity-step/velstep4_BRAVA_expb819_basalt.txt",
    "drive": "[{ duration = 68.7, velocity = 3.0 }, { duration = 100.0, velocity = 10.1 }]",
}  # fmt: skip
FREE_K = "K = {{ value = {0}, lower = 5e-4, upper = 5e-2 }}"
CASES = [
    (P655, "ruina", "1.6e-3", "", 15.0, ".006005(53) .004230(51) 17.745(334)"),
    (P655, "ruina", "1.0e-3", "", 12.0, ".005823(98) .004094(94) 12.817(442)"),
    (P655, "dieterich", "1.0e-3", "", 6.0, ".006043(113) .004279(109) 6.505(199)"),
    (P655, "ruina", "1.6e-3", "free", 15.0, "the data want 1.6e-3 above the calibrated 1.0e-3"),
    (BASALT, "ruina", "5.4e-3", "free", 10.0, ".0073 .0079 10, k 5.4e-3 (quick fit)"),
    (BASALT, "dieterich", "9.6e-3", "free", 7.0, ".0085 .0088 6.7, k 9.6e-3 (quick fit)"),
]


BEYOND = [(BASALT, "ruina", "5.4e-3", 10.0, (11685.0, 11700.0))]  # fitted up to so many seconds, predicted to the end


def problem_of(
    data: Path, case: dict[str, object], ageing: str, stiffness: str, K: str, D0: float, until: float | None = None
) -> Problem:
    """Return the fit of one recording with a slip trend, up to a time if one is given; K is "free" or empty."""
    window = str(case["window"])
    values = {
        **case,
        "file": (data / str(case["file"])).resolve(),
        "window": window if until is None else f"{window.split(',')[0]}, {until}]",
        "ageing": ageing,
        "stiffness": stiffness,
        "D0": D0,
    }
    text = EXPERIMENT.format(**values, K=FREE_K.format(stiffness) if K else "")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "experiment.toml"
        path.write_text(text, encoding="utf-8")
        registry = load_registry()
        experiment = read_experiment(path, registry=registry)
    return fit_problem(open_model(registry, **asdict(experiment.choice)), experiment, trend="slip")


def beyond(data: Path, case: dict[str, object], ageing: str, stiffness: str, D0: float, until: float) -> str:
    """Return how what comes after a time is predicted by a fit of what came before: scatter, and how far it is off on average.

    The standard error of that is of the fit's parameters, its slip trend above all, and of noise with its colour.
    """
    found = fit(problem_of(data, case, ageing, stiffness, "", D0, until))
    whole = problem_of(data, case, ageing, stiffness, "", D0)
    run, noise = whole.runs[0], found.runs[0].noise
    predicted = whole.predicted(run, np.array([found.values[n] for n in whole.names]))
    late = run.used & (run.t > until)
    left, slope = (run.observed - predicted.y)[late], predicted.J[late].mean(axis=0)
    slow = noise.innovation / (1 - sum(noise.coefficients)) / np.sqrt(left.size)
    error = float(np.sqrt(slope @ found.covariance @ slope + slow**2))
    return (
        f"to {until:g} s, then {left.size} samples: scatter {left.std() / found.runs[0].rms:.2f} times what the fit leaves, "
        f"{left.mean():+.1e}({error:.1e}) off"
    )


def main() -> None:
    """Print one line for each recording and law."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python examples/real_steps.py DATA")
    for case, ageing, stiffness, K, D0, published in CASES:
        found = fit(problem_of(Path(sys.argv[1]), case, ageing, stiffness, K, D0))
        cells = [
            f"{n} {found.values[n]:.5g} ({found.stderr[n]:.2g})" for n in found.names if n in ("A", "B", "D0", "K")
        ]
        run = found.runs[0]
        print(f"{case['title']}, {ageing}, k {stiffness}{' free' if K else ''}: {', '.join(cells)}")
        print(
            f"    published {published}; rms {run.rms:.2e}, noise of order {run.noise.order}, {found.status.value}",
            flush=True,
        )
    for case, ageing, stiffness, D0, ends in BEYOND:
        for until in ends:
            print(
                f"{case['title']}, {ageing}, {beyond(Path(sys.argv[1]), case, ageing, stiffness, D0, until)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
