"""The gradient of a fit, against finite differences over `solve_ivp`: every run of an experiment, every free parameter.

    python benchmarks/gradient.py EXPERIMENT

EXPERIMENT is a folder such as `../shared/cases/open-01`: runs of the paper's slider (srf-vsat, dieterich, elastic interface, with
inertia) that record the elongation, begun in steady sliding. Compared is J, the derivatives of all predicted samples by the free
parameters at the file's start values: the gradient of any likelihood is J' times something that costs nothing.

    ours        what a fit calls: `predict(..., by=names)`, sensitivities with the compiled Radau IIA
    forward     solve_ivp(method="LSODA") on sympy's lambdified rates and Jacobian, one motion more than there are parameters
    central     the same, two motions for each parameter

The motion is restarted at each corner of drive and load, drives and loads are the recording's own in both. A step is a share of
the parameter; two pairs of tolerance and step are shown. Error: rms over samples of the difference from the exact column, over
that column's rms, the worst of all parameters and runs. Exact is ours at rtol 1e-11, itself in doubt by its distance from central
differences of ours at 1e-12, which is told. CPU seconds; ours are medians.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from brute import Slider, steady
from common import Report, interleaved
from simulate import lambdified

from srfcli.codegen.model import open_model
from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.data.values import Run
from srfcli.inference.fit import Problem, fit_problem
from srfcli.inference.prediction import predict
from srfcli.laws.registry import load_registry
from srfcli.motion.integrators import load_of_one_time, pieces

Array = np.ndarray
OURS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # a fit takes 1e-6
DIFFERENCES = ((1e-8, 1e-4), (1e-10, 1e-5))
REPEATS = 3
KNOWN = {"mu0", "A", "B", "D0", "V0", "Vsat", "lambda", "K", "M"}


def solved(run: Run, slider: Slider, functions: tuple[Callable[..., Any], Callable[..., Any]], rtol: float) -> Array:
    """Return the elongation at the run's times by solve_ivp, restarted at each corner of drive and load."""
    from scipy.integrate import solve_ivp

    rates, jacobian = functions
    constant = [getattr(slider, name) for name in ("K", "M", "mu0", "A", "B", "D0", "V0", "Vsat", "lam")]
    first = float(run.t[0])
    state = steady(replace(slider, V=run.drive.piece(first)[0], W0=run.load.rest(first)))
    u = np.full(run.t.size, state[0])
    for a, b in pieces(run.t, run.drive, run.load):
        W_at, (V, acceleration, since) = load_of_one_time(run.load, a, b), run.drive.piece(0.5 * (a + b))
        wanted = np.nonzero((run.t > a) & (run.t <= b))[0]
        times = np.unique([a, *run.t[wanted], b])
        found = solve_ivp(
            lambda t, x: rates(x, V + acceleration * (t - since), W_at(t)[0], *constant),  # noqa: B023
            (a, b), state, "LSODA", times, rtol=rtol, atol=rtol, max_step=run.load.longest_step(a, b),
            jac=lambda t, x: jacobian(x, V + acceleration * (t - since), W_at(t)[0], *constant),  # noqa: B023
        )  # fmt: skip
        if found.status:
            raise SrfError(f"solve_ivp stopped in {run.name}: {found.message}")
        u[wanted] = found.y[0, np.searchsorted(times, run.t[wanted])]
        state = found.y[:, -1]
    return u


def slider_of(problem: Problem, theta: Array, run: Run) -> Slider:
    """Return the hand-written slider with these free parameters."""
    values = {q.name: q.value for q in problem.experiment.parameters} | problem.named(theta)
    values |= {"K": run.stiffness, "M": problem.experiment.mass}
    named = {"lam" if name == "lambda" else name: float(value) for name, value in values.items() if name in KNOWN}
    return Slider(1.0, 1.0, 0.0, **named)


def differences(problem: Problem, rtol: float, step: float) -> tuple[dict[str, tuple[list[Array], float]], float]:
    """Return forward and central J of each run with the CPU seconds each took, and the seconds of one motion of all runs."""
    functions = lambdified()

    def motions(theta: Array) -> tuple[list[Array], float]:
        begun = time.process_time()
        return [solved(run, slider_of(problem, theta, run), functions, rtol) for run in problem.runs], time.process_time() - begun

    base, one = motions(problem.start)
    forward: list[list[Array]] = []
    central: list[list[Array]] = []
    up_time = down_time = 0.0
    for k, value in enumerate(problem.start):
        h = step * value
        shift = h * np.eye(problem.start.size)[k]
        (up, spent), (down, spent_too) = motions(problem.start + shift), motions(problem.start - shift)
        up_time, down_time = up_time + spent, down_time + spent_too
        forward.append([(y - y0) / h for y, y0 in zip(up, base, strict=True)])
        central.append([(y - y0) / (2 * h) for y, y0 in zip(up, down, strict=True)])
    columns = [[np.stack(runs, axis=1) for runs in zip(*J, strict=True)] for J in (forward, central)]
    return {"forward": (columns[0], one + up_time), "central": (columns[1], up_time + down_time)}, one


def ours(problem: Problem, rtol: float, theta: Array | None = None, by: bool = True) -> list[Array]:
    """Return J of each run, or the predictions themselves."""
    values = problem.named(problem.start if theta is None else theta)
    names = problem.names if by else ()
    found = [predict(problem.model, problem.experiment, run, values, by=names, rtol=rtol) for run in problem.runs]
    return [f.J if by else f.y for f in found]


def checked(problem: Problem) -> list[Array]:
    """Return central differences of our own motions at rtol 1e-12."""
    columns = []
    for k, value in enumerate(problem.start):
        shift = 1e-5 * value * np.eye(problem.start.size)[k]
        up, down = (ours(problem, 1e-12, problem.start + s * shift, by=False) for s in (1, -1))
        columns.append([(a - b) / (2e-5 * value) for a, b in zip(up, down, strict=True)])
    return [np.stack(runs, axis=1) for runs in zip(*columns, strict=True)]


def error(found: list[Array], exact: list[Array]) -> float:
    """Return the largest relative rms error of a column."""
    pairs = zip(found, exact, strict=True)
    return max(float((np.sqrt(((a - b) ** 2).mean(axis=0)) / np.sqrt((b**2).mean(axis=0))).max()) for a, b in pairs)


def load_problem(path: Path) -> Problem:
    """Return the fit that the experiment asks for; SrfError where it is not the slider written here by hand."""
    registry = load_registry()
    experiment = read_experiment(path, registry=registry)
    names = (experiment.choice.law, experiment.choice.ageing, experiment.choice.interface, experiment.choice.inertia)
    problem = fit_problem(open_model(registry, **asdict(experiment.choice)), experiment)
    if names != ("srf-vsat", "dieterich", "elastic", True) or {r.observable for r in problem.runs} != {"elongation"}:
        raise SrfError(f"{path} is not an experiment of the paper's slider that records the elongation")
    return problem


def main() -> None:
    """Print CPU seconds and errors of J by either way, and the ratios."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python benchmarks/gradient.py EXPERIMENT")
    report = Report("gradient", __doc__ or "")
    problem = load_problem(Path(sys.argv[1]))
    samples = sum(run.t.size for run in problem.runs)
    report.say(f"# {Path(sys.argv[1]).name}: {len(problem.runs)} runs, {samples} samples, {len(problem.names)} parameters")
    exact = ours(problem, 1e-11)
    report.say(f"exact J to {error(checked(problem), exact):.0e} of each column")
    report.say()
    seconds = interleaved({f"{r:g}": (lambda r=r: ours(problem, r)) for r in OURS}, REPEATS)
    mine = [(seconds[f"{r:g}"], error(ours(problem, r), exact)) for r in OURS]
    rows = [["ours", f"{r:.0e}", "", f"{s:.3f}", f"{e:.1e}", ""] for r, (s, e) in zip(OURS, mine, strict=True)]
    for rtol, step in DIFFERENCES:
        found, one = differences(problem, rtol, step)
        for name, (J, spent) in found.items():
            wrong = error(J, exact)
            equal = min((s for s, e in mine if e <= wrong), default=float("nan"))
            rows.append([name, f"{rtol:.0e}", f"{step:.0e}", f"{spent:.1f}", f"{wrong:.1e}", f"{spent / equal:.0f}"])
        report.say(f"one motion of all runs by solve_ivp at rtol {rtol:.0e}: {one:.1f} s")
    report.say()
    report.table(["method", "rtol", "step", "CPU (s)", "error of J", "times ours, at an error no larger"], rows)


if __name__ == "__main__":
    main()
