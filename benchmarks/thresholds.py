"""Fits of critical loads by the paper's procedure: recovery of its optimised parameters, evaluations, errors and their coverage.

A table is generated from the optimised set of the paper's Table I at velocities and amplitudes of its figures 2 and 4, and
fitted from the trial set: A, B, D0, Vsat, lambda and rho are free, as there. Powell's method and the least squares with exact
derivatives share the cost function, its start and its bounds.

Measured: parameters against those that made the table, chi2 and the paper's own sum of squares before and after, evaluations
of the whole cost, CPU seconds; without noise and with 3 % (seeded). Then the exact derivatives against central differences of
polished loads; the time of an evaluation that follows known crossings, of one that searches every line, and of the derivatives.

Coverage: DRAWS tables with independent 3 % noise, each fitted by the least squares from the trial set. Counted: how often
the truth lies within 1.96 standard errors; the spread of the estimates over the mean standard error (1 where the
linearisation holds); fits that end higher than one begun at the truth (a local minimum).
`--draws N` sets their number.
"""

from __future__ import annotations

import sys
import time

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from common import Report, interleaved
from threshold_tables import generated, with_noise

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.data.thresholds import Thresholds
from srfcli.inference.free_parameters import Scale, free_parameters, with_transmission
from srfcli.inference.thresholds import Matcher, MethodFit, fit_thresholds
from srfcli.laws.registry import load_registry

TRIAL = {"A": 0.012, "B": 0.023, "D0": 0.40, "Vsat": 280.0, "lambda": 0.62, "rho": 0.48}
OPTIMISED = {"A": 0.0126, "B": 0.0241, "D0": 0.402, "Vsat": 256.0, "lambda": 0.56, "rho": 0.43}
NAMES = tuple(TRIAL)
POINTS = {  # effective amplitude of the figures: velocities
    0.0: (1, 2, 5, 10, 20, 50, 100),
    0.045: (1, 2, 5, 10, 20, 50, 100),
    0.09: (1, 2, 5, 10, 20, 50, 100),
    0.13: (1, 2, 5, 10, 20, 30),
    0.18: (1, 5, 7, 25),
}
DRAWS = 50
SEED = 2003


def scale_from(model: GeneratedModel, start: dict[str, float], table: Thresholds) -> Scale:
    """Return the free parameters at `start`, between the bounds that the trial set has by default."""
    parameters = with_transmission(model.parameters)
    trial = free_parameters(parameters, NAMES, start={**model.defaults(), **TRIAL}, largest_eps=float(table.eps.max()))
    bounds = {q.name: (q.lower, q.upper) for q in trial}
    values = {**model.defaults(), **start}
    return free_parameters(parameters, NAMES, start=values, bounds=bounds, largest_eps=float(table.eps.max()))


def fitted(
    model: GeneratedModel, table: Thresholds, method: str, start: dict[str, float] = TRIAL, tol: float = 1e-6
) -> MethodFit:
    """Return the fit of `table` by one method."""
    values = {**model.defaults(), **start}
    fit = fit_thresholds(model, table, scale=scale_from(model, start, table), values=values, methods=[method], tol=tol)
    return fit.methods[0]


def compare(report: Report, title: str, fits: dict[str, MethodFit]) -> None:
    """Say what each method found, and its cost against evaluations."""
    report.say()
    report.say(title)
    rows = []
    for name, m in fits.items():
        off = np.abs(m.values / np.array([OPTIMISED[n] for n in NAMES]) - 1).max()
        ratio = [m.start_cost / m.cost, m.paper_cost[0] / m.paper_cost[1]]
        costs = [f"{m.start_cost:.4g}", f"{m.cost:.4g}", *(f"{r:.3g}" for r in ratio)]
        rows.append([name, m.status.value, *costs, m.evaluations, m.gradients, m.surveys, f"{m.cpu:.1f}", f"{off:.1e}"])
    head = ["method", "status", "chi2 start", "chi2", "lowered", "paper's cost lowered", "evaluations", "gradients"]
    report.table([*head, "surveys", "CPU s", "largest relative error"], rows)
    report.say("lowest chi2 after so many evaluations:")
    for name, m in fits.items():
        report.say(f"  {name}: " + ", ".join(f"{i + 1}: {m.trace.best[i]:.4g}" for i in m.trace.milestones()))
    report.say("values and standard errors:")
    head = ["", *NAMES]
    rows = [["truth", *(f"{OPTIMISED[n]:g}" for n in NAMES)]]
    for name, m in fits.items():
        rows.append([name, *(f"{v:.5g} +- {e:.2g}" for v, e in zip(m.values, m.uncertainty.errors, strict=True))])
    report.table(head, rows)
    for name, m in fits.items():
        for note in (f"least determined is {m.uncertainty.weakest}", *m.notes):
            report.say(f"  {name}: {note}")


def derivatives(report: Report, model: GeneratedModel, table: Thresholds) -> None:
    """Say how far exact derivatives lie from central differences, and what an evaluation costs."""
    values = {**model.defaults(), **TRIAL}
    exact = Matcher(model, table, values=values, scale=scale_from(model, TRIAL, table), tol=1e-10)
    rates = exact.jacobian(exact.match(np.zeros(len(NAMES)))) * exact.table.sigma[:, None]
    worst = []
    for j in range(len(NAMES)):
        step = 1e-4 * np.eye(len(NAMES))[j]
        difference = (exact.match(step).loads - exact.match(-step).loads) / 2e-4
        worst.append(float((np.abs(rates[:, j] - difference) / table.W0c).max()))
    report.say()
    report.say("exact d ln W0c / d ln p against central differences of polished loads, largest over the table, trial set")
    report.table(list(NAMES), [[f"{w:.1e}" for w in worst]])
    warm = Matcher(model, table, values=values, scale=scale_from(model, TRIAL, table))
    warm.match(np.zeros(len(NAMES)))
    rng = np.random.default_rng(SEED)

    def nearby() -> np.ndarray:
        return rng.normal(size=len(NAMES)) * 0.01

    match = warm.match(nearby())
    seconds = interleaved(
        {
            "follow": lambda: warm.match(nearby()),
            "survey": lambda: warm.match(nearby(), anew=True),
            "derivatives": lambda: warm.jacobian(match),
        },
        5,
    )
    report.say()
    report.say(f"one evaluation of {len(table)} loads, CPU ms, median of 5")
    names = ["following crossings", "searching every line", "all derivatives"]
    report.table(names, [[f"{1e3 * s:.0f}" for s in seconds.values()]])


def coverage(report: Report, model: GeneratedModel, table: Thresholds, draws: int) -> None:
    """Say how often the truth lies within the errors that the least squares states."""
    truth = np.array([OPTIMISED[n] for n in NAMES])
    values, errors, costs, lower, lowered, evaluations = [], [], [], 0, [], []
    begun = time.process_time()
    for draw in range(draws):
        noisy = with_noise(table, SEED + draw)
        m = fitted(model, noisy, "least-squares")
        other = fitted(model, noisy, "least-squares", OPTIMISED)
        lower += other.cost < m.cost - 0.01
        values.append(m.values)
        errors.append(m.uncertainty.errors)
        costs.append(m.cost)
        lowered.append(m.start_cost / m.cost)
        evaluations.append(m.evaluations)
    found, error = np.array(values), np.array(errors)
    inside = np.abs(found - truth) < 1.96 * error
    spread = np.log(found).std(axis=0, ddof=1) / np.sqrt(((error / found) ** 2).mean(axis=0))
    report.say()
    report.say(f"coverage over {draws} draws of 3 % noise (seeds {SEED} to {SEED + draws - 1}), least squares from the trial set")
    rows = [
        ["within 1.96 errors", *(f"{c:.0%}" for c in inside.mean(axis=0)), f"{inside.mean():.1%}"],
        ["spread / error, in ln p", *(f"{s:.2f}" for s in spread), ""],
        ["mean - truth, errors of the mean", *(f"{b:+.1f}" for b in bias(found, truth)), ""],
    ]
    report.table(["", *NAMES, "all"], rows)
    freedom = len(table) - len(NAMES)
    report.say(f"chi2: mean {np.mean(costs):.1f} on {freedom} degrees of freedom; lowered {min(lowered):.1f} to"
               f" {max(lowered):.1f} fold, at least fifteenfold in {np.mean(np.array(lowered) >= 15):.0%}")  # fmt: skip
    report.say(f"evaluations: median {np.median(evaluations):.0f}, at most {max(evaluations)}")
    report.say(f"a fit begun at the truth ended lower in {lower} of {draws}")
    report.say(f"({time.process_time() - begun:.0f} s of CPU)")


def bias(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the mean deviation in ln p (k,) over its own standard error."""
    deviation = np.log(found / truth)
    return deviation.mean(axis=0) / (deviation.std(axis=0, ddof=1) / np.sqrt(len(found)))


def main() -> None:
    draws = int(sys.argv[sys.argv.index("--draws") + 1]) if "--draws" in sys.argv else DRAWS
    report = Report("thresholds", __doc__ or "")
    model = open_model(load_registry())
    V = np.array([v for speeds in POINTS.values() for v in speeds], float)
    eps = np.array([e for e, speeds in POINTS.items() for _ in speeds]) / OPTIMISED["rho"]
    table = generated(model, V, eps, values={**model.defaults(), **OPTIMISED})
    report.say(f"{len(table)} critical loads at effective eps " + ", ".join(map(str, POINTS)))
    clean = {"powell": fitted(model, table, "powell"), "least-squares": fitted(model, table, "least-squares")}
    clean["least-squares at 1e-8"] = fitted(model, table, "least-squares", tol=1e-8)
    compare(report, "without noise", clean)
    noisy = with_noise(table, SEED)
    compare(report, "with 3 % noise", {m: fitted(model, noisy, m) for m in ("powell", "least-squares")})
    derivatives(report, model, table)
    coverage(report, model, table, draws)


if __name__ == "__main__":
    main()
