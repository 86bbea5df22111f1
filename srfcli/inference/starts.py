"""Several starts: the file's own, and others drawn over the bounds, so that a false minimum is found out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from srfcli.inference.fit import Fit, Interrupted, Problem, fit
from srfcli.numerics.collocation import Array

SPREAD = 0.3  # of the way from the start value to each bound, at most
Fitter = Callable[[Array, Callable[[str], None]], tuple[Fit, Any]]
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


@dataclass(frozen=True)
class Several:
    """Fits from several starts: the best with what its fitter returned beside it, and for each start that ended a row.

    A row is the log likelihood, and whether that start ended in the best one's minimum. `interrupted` where not all were done.
    """

    best: Fit
    beside: Any
    rows: list[tuple[float, bool]]
    interrupted: bool


def fit_from_several(
    problem: Problem,
    *,
    fitter: Fitter | None = None,
    count: int = 1,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> Several:
    """Return the best fit over the starts, each by `fitter(start, progress)`, plain least squares if left out.

    Ctrl-C ends them where one is done, and is `Interrupted` where none is.
    """
    fits: list[tuple[Fit, Any]] = []
    interrupted = False
    for number, start in enumerate(start_points(problem, count, seed), 1):
        prefix = f"start {number} of {count}: " if count > 1 else ""

        def report(text: str, prefix: str = prefix) -> None:
            progress(prefix + text)

        try:
            fits.append((fit(problem, start=start, progress=report), None) if fitter is None else fitter(start, report))
        except (Interrupted, KeyboardInterrupt):
            if not fits:
                raise
            interrupted = True
            break
    best, beside = max(fits, key=lambda f: f[0].log_likelihood)
    away = [
        max(abs(f.values[n] - best.values[n]) / max(best.stderr[n], 1e-300) for n in problem.names) for f, _ in fits
    ]
    rows = [(f.log_likelihood, d < SAME) for (f, _), d in zip(fits, away, strict=True)]
    return Several(best, beside, rows, interrupted)
