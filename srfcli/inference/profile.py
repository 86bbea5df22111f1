"""Profile likelihood: each parameter held at a value, the others refitted; the interval ends where the fit is worse by 3.84."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from srfcli.inference.fit import Fit, Problem, Search
from srfcli.inference.statespace import CLOSER, StateSpaceFit, maximise
from srfcli.numerics.collocation import Array

LEVEL = 3.841458820694124  # of chi-squared with one degree of freedom, 95 %
FARTHEST = 8.0  # standard errors: an interval that has not ended there is open

Held = Callable[[int, float, Array], tuple[Array, float, int]]


@dataclass(frozen=True)
class Interval:
    """A 95 % interval of one parameter, in um, s, N; None where the likelihood does not end it before a bound."""

    name: str
    low: float | None
    high: float | None
    evaluations: int


@dataclass(frozen=True)
class _Valley:
    """Where a likelihood is largest: `best` (k,), its covariance and bounds, and what it costs to hold one coordinate.

    `held(k, value, start)` returns the others' best values, minus twice the log likelihood there, and how often it was asked.
    Coordinates that are `logarithmic` are those of a parameter's logarithm.
    """

    best: Array
    base: float
    covariance: Array
    lower: Array
    upper: Array
    held: Held
    logarithmic: NDArray[np.bool_]


def profile(
    problem: Problem,
    fit: Fit,
    name: str,
    *,
    rough: StateSpaceFit | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Interval:
    """Return the profile-likelihood interval of one parameter.

    Of the state-space likelihood `rough`, field and gauge noise refitted too; without it the noise is held at what the fit
    found.
    """
    k = problem.names.index(name)
    valley = _of_residuals(problem, fit) if rough is None else _of_state_space(rough)
    ends, count = [], 0
    for side in (-1.0, 1.0):
        end, used = _end(valley, k, side)
        progress(f"{name}: {'upper' if side > 0 else 'lower'} end")
        ends.append(float(np.exp(end)) if end is not None and valley.logarithmic[k] else end)
        count += used
    return Interval(name, ends[0], ends[1], count)


def _end(valley: _Valley, k: int, side: float) -> tuple[float | None, int]:
    """Return where the profile crosses LEVEL on one side, by secant on its root, which is nearly linear in the parameter."""
    best, covariance = valley.best, valley.covariance
    error = float(np.sqrt(covariance[k, k]))
    if not error > 0:
        return None, 0
    along = covariance[:, k] / covariance[k, k]
    limit = valley.upper[k] if side > 0 else valley.lower[k]
    used, theta = 0, best
    points = [(0.0, -np.sqrt(LEVEL))]
    step = np.sqrt(LEVEL) * error
    for _ in range(8):
        value = best[k] + side * step
        if (value - limit) * side > 0 or step > FARTHEST * error * np.sqrt(LEVEL):
            return None, used
        start = np.clip(theta + along * (value - theta[k]), valley.lower, valley.upper)
        start[k] = value
        theta, cost, n = valley.held(k, value, start)
        used += n
        height = np.sign(cost - valley.base) * np.sqrt(abs(cost - valley.base)) - np.sqrt(LEVEL)
        points.append((step, height))
        if abs(height) < 0.01:
            return float(value), used
        (a, fa), (b, fb) = points[-2:]
        step = max(b - fb * (b - a) / (fb - fa), 0.2 * b) if fb != fa else 1.5 * b
    return float(best[k] + side * step), used


def _of_state_space(found: StateSpaceFit) -> _Valley:
    likelihood, maximum = found.likelihood, found.maximum

    def held(k: int, value: float, start: Array) -> tuple[Array, float, int]:
        before = likelihood.evaluations
        others = maximise(likelihood, start, held=(likelihood.names[k],), close=CLOSER)
        return others.point.x, -2 * others.point.log_likelihood, likelihood.evaluations - before

    return _Valley(
        maximum.point.x, -2 * found.log_likelihood, maximum.covariance, likelihood.lower, likelihood.upper, held,
        likelihood.logarithmic,
    )  # fmt: skip


def _of_residuals(problem: Problem, fit: Fit) -> _Valley:
    noise = {r.name: r.noise for r in fit.runs}

    def cost(theta: Array) -> float:
        residual, _ = Search(problem, lambda text: None).residuals(theta, noise, {})
        return float(residual @ residual)

    def held(k: int, value: float, start: Array) -> tuple[Array, float, int]:
        others = [i for i in range(len(problem.names)) if i != k]
        if not others:
            theta = np.array([value])
            return theta, cost(theta), 1
        fewer = replace(
            problem,
            names=tuple(problem.names[i] for i in others),
            start=start[others],
            lower=problem.lower[others],
            upper=problem.upper[others],
            held={**problem.held, problem.names[k]: value},
        )
        search = Search(fewer, lambda text: None)
        found, _ = search.minimise(start[others], noise, {})
        return np.insert(found, k, value), search.trail[-1][0], search.evaluations

    best = np.array([fit.values[n] for n in problem.names])
    return _Valley(best, cost(best), fit.covariance, problem.lower, problem.upper, held, np.zeros(best.size, dtype=bool))
