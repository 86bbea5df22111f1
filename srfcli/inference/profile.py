"""Profile likelihood: each parameter held at a value, the others refitted; the interval ends where the fit is worse by 3.84."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from srfcli.inference.fit import Fit, Problem, Search
from srfcli.inference.noise import Noise
from srfcli.numerics.collocation import Array

LEVEL = 3.841458820694124  # of chi-squared with one degree of freedom, 95 %
FARTHEST = 8.0  # standard errors: an interval that has not ended there is open


@dataclass(frozen=True)
class Interval:
    """A 95 % interval of one parameter, in um, s, N; None where the likelihood does not end it before a bound."""

    name: str
    low: float | None
    high: float | None
    evaluations: int


def profile(problem: Problem, fit: Fit, name: str, *, progress: Callable[[str], None] = lambda text: None) -> Interval:
    """Return the profile-likelihood interval of one parameter, the noise held at what the fit found."""
    k = problem.names.index(name)
    noise = {r.name: r.noise for r in fit.runs}
    best = np.array([fit.values[n] for n in problem.names])
    base = _cost(problem, best, noise)
    ends, count = [], 0
    for side in (-1.0, 1.0):
        end, used = _end(problem, fit, k, side, best, base, noise)
        progress(f"{name}: {'upper' if side > 0 else 'lower'} end")
        ends.append(end)
        count += used
    return Interval(name, ends[0], ends[1], count)


def _end(
    problem: Problem, fit: Fit, k: int, side: float, best: Array, base: float, noise: Mapping[str, Noise]
) -> tuple[float | None, int]:
    """Return where the profile crosses LEVEL on one side, by secant on its root, which is nearly linear in the parameter."""
    error = fit.stderr[problem.names[k]]
    along = fit.covariance[:, k] / fit.covariance[k, k]
    limit = problem.upper[k] if side > 0 else problem.lower[k]
    used, theta = 0, best
    points = [(0.0, -np.sqrt(LEVEL))]
    step = np.sqrt(LEVEL) * error
    for _ in range(8):
        value = best[k] + side * step
        if (value - limit) * side > 0 or step > FARTHEST * error * np.sqrt(LEVEL):
            return None, used
        start = np.clip(theta + along * (value - theta[k]), problem.lower, problem.upper)
        theta, cost, n = _held(problem, k, value, start, noise)
        used += n
        height = np.sign(cost - base) * np.sqrt(abs(cost - base)) - np.sqrt(LEVEL)
        points.append((step, height))
        if abs(height) < 0.01:
            return float(value), used
        (a, fa), (b, fb) = points[-2:]
        step = max(b - fb * (b - a) / (fb - fa), 0.2 * b) if fb != fa else 1.5 * b
    return float(best[k] + side * step), used


def _held(problem: Problem, k: int, value: float, start: Array, noise: Mapping[str, Noise]) -> tuple[Array, float, int]:
    """Return the others' best values with parameter k held, the cost there, and the evaluations it took."""
    others = [i for i in range(len(problem.names)) if i != k]
    if not others:
        theta = np.array([value])
        return theta, _cost(problem, theta, noise), 1
    held = replace(
        problem,
        names=tuple(problem.names[i] for i in others),
        start=start[others],
        lower=problem.lower[others],
        upper=problem.upper[others],
        held={**problem.held, problem.names[k]: value},
    )
    search = Search(held, lambda text: None)
    found, _ = search.minimise(start[others], noise, {})
    return np.insert(found, k, value), search.trail[-1][0], search.evaluations


def _cost(problem: Problem, theta: Array, noise: Mapping[str, Noise]) -> float:
    residual, _ = Search(problem, lambda text: None).residuals(theta, noise, {})
    return float(residual @ residual)
