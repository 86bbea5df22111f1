"""Several starts: the file's own, and others drawn over the bounds, so that a false minimum is found out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from srfcli.inference.fit import Fit, Interrupted, Problem, fit
from srfcli.numerics.collocation import Array

SPREAD = 0.3  # of the way from the start value to each bound, at most
SAME = 0.5  # standard errors between two minima that count as one


def start_points(problem: Problem, count: int, seed: int) -> list[Array]:
    """Return `count` starting points (k,): the problem's own first, then a Latin hypercube about it, within the bounds."""
    from scipy.stats import qmc

    points = [problem.start]
    if count > 1:
        cube = 2 * qmc.LatinHypercube(d=problem.start.size, rng=np.random.default_rng(seed)).random(count - 1) - 1
        reach = np.where(cube > 0, problem.upper - problem.start, problem.start - problem.lower)
        points += list(problem.start + SPREAD * cube * reach)
    return points


def fit_from_several(
    problem: Problem, *, count: int = 1, seed: int = 0, progress: Callable[[str], None] = lambda text: None
) -> tuple[Fit, list[tuple[float, bool]]]:
    """Return the best fit over the starts, and for each start its log-likelihood and whether it ended in that same minimum."""
    fits: list[Fit] = []
    for number, start in enumerate(start_points(problem, count, seed), 1):
        prefix = f"start {number} of {count}: " if count > 1 else ""
        try:
            fits.append(fit(problem, start=start, progress=lambda text, p=prefix: progress(p + text)))  # type: ignore[misc]
        except Interrupted:
            if not fits:
                raise
            break
    best = max(fits, key=lambda f: f.log_likelihood)
    away = [max(abs(f.values[n] - best.values[n]) / max(best.stderr[n], 1e-300) for n in problem.names) for f in fits]
    return best, [(f.log_likelihood, d < SAME) for f, d in zip(fits, away, strict=True)]
