"""Draws from the posterior by the ensemble sampler emcee, under flat priors within the bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from srfcli.errors import SrfError
from srfcli.inference.fit import Fit, Problem
from srfcli.inference.noise import whiten
from srfcli.inference.statespace import StateSpaceFit
from srfcli.numerics.collocation import Array

BURN = 20  # autocorrelation takes some ten steps where the ensemble starts from the fit's own covariance


def sample(
    problem: Problem,
    fit: Fit,
    count: int,
    *,
    rough: StateSpaceFit | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> Array:
    """Return `count` draws (count, k) in the order of problem.names, um, s, N.

    Field and gauge noise are held at what the fit found: those of the state-space likelihood `rough`, without it the residuals'.
    """
    try:
        import emcee
    except ImportError as error:
        raise SrfError("--sample needs emcee, which is not installed", 'pip install "srfcli[sample]"') from error
    k = len(problem.names)
    walkers = max(4 * k, 16)
    rng = np.random.default_rng(seed)
    best = np.array([fit.values[n] for n in problem.names])
    start = np.clip(rng.multivariate_normal(best, fit.covariance, walkers), problem.lower, problem.upper)
    noise = {f.name: f.noise for f in fit.runs}

    def log_posterior(theta: Array) -> float:
        if (theta <= problem.lower).any() or (theta >= problem.upper).any():
            return -np.inf
        if rough is not None:
            x = rough.maximum.point.x.copy()
            x[: theta.size] = theta
            return rough.likelihood.at(x, slopes=False).log_likelihood
        total = 0.0
        for run in problem.runs:
            difference = problem.predicted(run, theta, slopes=False).y - run.observed
            if not np.isfinite(difference).all():
                return -np.inf
            parts = next(f.parts for f in fit.runs if f.name == run.name)
            white = whiten(noise[run.name], difference, parts)
            total += float(white @ white)
        return -0.5 * total

    sampler = emcee.EnsembleSampler(walkers, k, log_posterior)
    sampler._random = np.random.RandomState(seed)
    steps = -(-count // walkers)
    for number, _ in enumerate(sampler.sample(start, iterations=BURN + steps), 1):
        progress(f"posterior: {number} of {BURN + steps} steps of {walkers} walkers")
    return np.asarray(sampler.get_chain(discard=BURN, flat=True)[:count])
