"""The likelihood of stick-slip against an exact one: a micro-tribometer whose friction is higher by one unknown number.

A friction field far longer than the slip is a friction coefficient that is higher by a normal number of standard deviation a. Its
marginal likelihood is then an integral over that number of the deterministic model's, which quadrature has to the last digit. The
slider's load is put on at 0.5 s; it sticks, and falls three times within a few samples. `again` is the filter that linearises the
equations again about the state before a reading that moves it far, `once` the extended Kalman filter. `shift` is the
number that was drawn.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from common import Report

from srfcli.codegen.model import open_model
from srfcli.data.values import Experiment, FitParameter, ModelChoice, Run
from srfcli.inference import kalman
from srfcli.inference.prediction import predict
from srfcli.inference.state_space import filter_run
from srfcli.laws.registry import bundled_registry
from srfcli.motion.imposed import Drive, LoadSteps

VALUES = {"mu0": 0.3, "A": 0.0093, "B": 0.016, "D0": 0.09, "Vsat": 800.0}
STIFFNESS, MASS, SD = 0.004, 1e-9, 0.01  # N/um, N s^2/um, um
SHIFTS, AMPLITUDES = (0.0, 2e-4), (1e-5, 1e-4, 3e-4, 1e-3)
FAR_LONGER = 1e7  # um
LINEAR_MOVE = kalman.LINEAR_MOVE  # with it the equations are linearised again, without an end to it once
POINTS = 241  # of the quadrature
RTOL = 1e-7


def slider() -> tuple[Experiment, Run]:
    """Return the experiment, and its run without readings."""
    t = np.linspace(0, 6, 1501)
    load = LoadSteps.sequence([(0.5, 0.03, 0.3)], rise=0.03)
    run = Run("r", Path("x"), False, 0.0, "steady", t, np.zeros(t.size), "elongation", np.ones(t.size, bool),
              Drive.steps([(0.0, 8.0)]), load, STIFFNESS, None, 0.0, ())  # fmt: skip
    listed = tuple(FitParameter(n, v, v / 2, v * 2, False, "1") for n, v in VALUES.items())
    choice = ModelChoice("srf-vsat", "dieterich", "rigid", True, ())
    return Experiment(Path(), "micro-tribometer", choice, MASS, f"{STIFFNESS} N/um", listed, (run,), ()), run


def main() -> None:
    """Print log likelihoods, exact and by both filters."""
    report = Report("falls", __doc__ or "")
    model = open_model(bundled_registry(), law="srf-vsat", ageing="dieterich", interface="rigid", random_field=True)
    experiment, run = slider()
    rows = []
    for shift in SHIFTS:
        there = VALUES["mu0"] + shift
        y = predict(model, experiment, run, VALUES | {"mu0": there}, rtol=1e-10).y
        read = replace(run, observed=y + SD * np.random.default_rng(1).standard_normal(y.size))

        def height(mu0: float, a: float, read: Run = read, linear_move: float = LINEAR_MOVE) -> float:
            kalman.LINEAR_MOVE = linear_move
            values = VALUES | {"mu0": mu0, "field_amplitude": a, "field_length": FAR_LONGER, "gauge_white": SD}
            found = filter_run(model, experiment, read, values, rtol=RTOL)
            return found.log_likelihood

        width = 1e-9
        while height(there, 0.0) - height(there + width, 0.0) < 2:
            width *= 2
        grid = there + 6 * width * np.linspace(-1, 1, POINTS)
        heights = np.array([height(mu0, 0.0) for mu0 in grid])
        for a in AMPLITUDES:
            prior = np.exp(-0.5 * ((grid - VALUES["mu0"]) / a) ** 2) / (a * np.sqrt(2 * np.pi))
            exact = heights.max() + np.log(np.sum(np.exp(heights - heights.max()) * prior) * (grid[1] - grid[0]))
            again, once = height(VALUES["mu0"], a), height(VALUES["mu0"], a, linear_move=np.inf)
            rows.append((f"{shift:g}", f"{a:g}", f"{exact:.2f}", f"{again:.2f}", f"{once:.2f}"))
    report.table(("shift", "a", "exact", "again", "once"), rows)


if __name__ == "__main__":
    main()
