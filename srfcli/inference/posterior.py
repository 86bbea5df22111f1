"""How sure a fit is: profile likelihoods, and Markov chains from the posterior."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import Array
from srfcli.core.errors import SrfError
from srfcli.inference.fit import Fit, Problem, Search
from srfcli.inference.noise import whiten
from srfcli.inference.state_space import CLOSER, StateSpaceFit, maximise

# Profile likelihood: each parameter held at a value, the others refitted; the interval ends where the fit is worse by 3.84.

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
    return _Valley(
        best, cost(best), fit.covariance, problem.lower, problem.upper, held, np.zeros(best.size, dtype=bool)
    )


# Draws from the posterior by Markov chains, under flat priors within the bounds, and what they are worth.

FEWEST, EARLY = 50, 40  # steps of burn-in, and draws in it for each parameter, from whose spread the proposals are made
TIMES = 5.0  # correlation times that are left out at the beginning
LONGEST = 400  # steps of burn-in
INDEPENDENT = 0.6  # share of proposals that do not depend on where a chain is; the others stretch the ensemble
WIDER = 1.2  # than the burn-in's draws: chains get stuck where proposals are rarer than the posterior
MISSED = 2.0  # of log posterior, for a standard error that ends beyond a bound
HEAVY = 5.0  # degrees of freedom of those proposals, so that no tail of the posterior is left out


@dataclass(frozen=True)
class Posterior:
    """Draws (steps, chains, k) in the order of `names`, um, s, N, after `burn_in` steps that are left out.

    `effective` (k,) is how many independent draws they are worth, `r_hat` (k,) the ratio of spreads over all chains and within
    them, 1 where all agree; `accepted` the share of proposals that were taken. `interrupted` where Ctrl-C ended it early.
    """

    names: tuple[str, ...]
    chains: Array = field(repr=False)
    burn_in: int
    accepted: float
    interrupted: bool = False

    @property
    def draws(self) -> Array:
        """Return all draws (steps * chains, k), step after step."""
        return np.asarray(self.chains.reshape(-1, self.chains.shape[-1]))

    @property
    def effective(self) -> Array:
        """Return the effective sample size of each parameter."""
        return effective_size(self.chains)

    @property
    def r_hat(self) -> Array:
        """Return the split R-hat of each parameter, halves of chains against each other (Gelman and others 2013); NaN of few."""
        half = self.chains.shape[0] // 2
        if half < 2:
            return np.full(len(self.names), np.nan)
        parts = np.concatenate([self.chains[:half], self.chains[half : 2 * half]], axis=1)
        within = parts.var(axis=0, ddof=1).mean(axis=0)
        between = parts.mean(axis=0).var(axis=0, ddof=1)
        return np.asarray(np.sqrt((half - 1) / half + between / within))


def effective_size(chains: Array) -> Array:
    """Return the effective sample size (k,) of chains (steps, chains, k), halves of chains against each other.

    Autocorrelations are summed over pairs of lags as long as these are positive and fall (Geyer 1992; Vehtari and others 2021).
    """
    half = chains.shape[0] // 2
    if half < 4:
        return np.full(chains.shape[-1], np.nan)
    parts = np.concatenate([chains[:half], chains[half : 2 * half]], axis=1)
    centred = parts - parts.mean(axis=0)
    spectrum = np.fft.rfft(centred, n=2 * half, axis=0)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2, axis=0)[:half].mean(axis=1) / half
    within = covariance[0] * half / (half - 1)
    total = within * (half - 1) / half + parts.mean(axis=0).var(axis=0, ddof=1)
    with np.errstate(invalid="ignore", divide="ignore"):  # chains that have not moved yet
        rho = 1.0 - (within - covariance) / total
    pairs = rho[: half // 2 * 2].reshape(half // 2, 2, -1).sum(axis=1)
    pairs[1:] = np.where(np.cumprod(pairs > 0, axis=0)[1:].astype(bool), np.minimum.accumulate(pairs, axis=0)[1:], 0.0)
    tau = 2.0 * pairs.sum(axis=0) - 1.0
    size = parts.shape[0] * parts.shape[1]
    return np.where(np.isfinite(tau), np.minimum(size / np.maximum(tau, 1e-300), size), 1.0)


def sample(
    problem: Problem,
    fit: Fit,
    count: int,
    *,
    rough: StateSpaceFit | None = None,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Posterior:
    """Return at least `count` draws of the parameters in problem.names.

    Field and gauge noise are held at what the fit found: those of the state-space likelihood `rough`, without it the residuals'.
    Proposals are drawn about the maximum with the fit's covariance and heavy tails, mixed with stretch moves of the ensemble;
    the burn-in ends when it is five correlation times long, and then centre and covariance are those of its later draws.
    `progress` is told what is done and which share of it. Ctrl-C ends it with the draws so far.
    """
    try:
        import emcee
    except ImportError as error:
        raise SrfError("`sample` needs emcee, which is not installed", 'pip install "srfcli[sample]"') from error
    k = len(problem.names)
    chains = 2 * k + 4
    rng = np.random.default_rng(seed)
    best = np.array([fit.values[n] for n in problem.names])
    log_posterior = _log_posterior(problem, fit, rough)
    scale = _straight(log_posterior, best, fit.covariance, problem.lower)

    def log_density(y: Array) -> float:
        theta = scale.back(y)
        return log_posterior(theta) + float(np.sum(np.log(theta[scale.logarithmic])))

    over = np.where(scale.logarithmic, best, 1.0)
    covariance = fit.covariance / np.outer(over, over)
    factor = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
    independent = _Independent(scale.there(best), factor)
    moves = [
        (emcee.moves.MHMove(independent), INDEPENDENT),
        (emcee.moves.StretchMove(), 1.0 - INDEPENDENT),
    ]
    width = problem.upper - problem.lower
    drawn = scale.back(scale.there(best) + rng.standard_normal((chains, k)) @ factor.T)
    start = scale.there(np.clip(drawn, problem.lower + 1e-9 * width, problem.upper - 1e-9 * width))
    sampler = emcee.EnsembleSampler(chains, k, log_density, moves=moves)
    sampler._random = np.random.RandomState(seed)
    steps, burnt, interrupted = -(-count // chains), 0, False
    try:
        for number, _ in enumerate(sampler.sample(start, iterations=LONGEST + steps), 1):
            if not burnt:
                fewest = max(FEWEST, -(-EARLY * k // chains))
                done = number >= fewest and number >= TIMES * _slowness(sampler.get_chain(discard=number // 3))
                burnt = number if done or number == LONGEST else 0
                if burnt:
                    independent.learn(sampler.get_chain(discard=burnt // 3, flat=True))
            progress(f"posterior: step {number}", number / (max(burnt, FEWEST) + steps))
            if burnt and number == burnt + steps:
                break
    except KeyboardInterrupt:
        interrupted = True
        if sampler.iteration < 2:
            raise
        burnt = burnt or sampler.iteration // 2
    accepted = float(np.mean(sampler.acceptance_fraction))
    return Posterior(problem.names, scale.back(sampler.get_chain(discard=burnt)), burnt, accepted, interrupted)


def _slowness(chains: Array) -> float:
    """Return after how many steps the slowest parameter's draws are independent."""
    steps, count, _ = chains.shape
    return float(steps * count / np.nanmin(np.maximum(effective_size(chains), 1e-9)))


@dataclass(frozen=True)
class _Scale:
    """Coordinates in which chains move: logarithms of what is positive, along which ridges of the posterior are straighter."""

    logarithmic: NDArray[np.bool_]

    def there(self, theta: Array) -> Array:
        """Return the coordinates of parameters (..., k)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self.logarithmic, np.log(theta), theta)

    def back(self, y: Array) -> Array:
        """Return the parameters at coordinates (..., k)."""
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, y, 0.0)), y)


def _straight(log_posterior: Callable[[Array], float], best: Array, covariance: Array, lower: Array) -> _Scale:
    """Return for each positive parameter the coordinate, itself or its logarithm, along which the posterior is nearer a Gaussian.

    Along each parameter with the others at their regression on it the logarithm falls by a half at one standard error.
    """
    base, logarithmic = log_posterior(best), np.zeros(best.size, dtype=bool)
    for k in np.flatnonzero(lower > 0):
        error, off = float(np.sqrt(covariance[k, k])), {}
        for curved in (False, True):
            ends = []
            for side in (-1.0, 1.0):
                theta = best + side * covariance[:, k] / error
                theta[k] = best[k] * np.exp(side * error / best[k]) if curved else theta[k]
                ends.append(log_posterior(theta) - base + 0.5)
            off[curved] = sum(abs(e) if np.isfinite(e) else MISSED for e in ends)
        logarithmic[k] = off[True] < off[False]
    return _Scale(logarithmic)


class _Independent:
    """A proposal of Student's t about `centre` with the scale `factor` (k, k), wherever a chain is."""

    def __init__(self, centre: Array, factor: Array) -> None:
        self.centre, self.factor = centre, factor

    def learn(self, draws: Array) -> None:
        """Take centre and scale from draws (n, k), where these have a spread in every direction."""
        covariance = np.atleast_2d(np.cov(draws.T))
        try:
            self.factor = WIDER * np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            return
        self.centre = draws.mean(axis=0)

    def log_density(self, x: Array) -> Array:
        """Return the logarithm of the proposal's density at x (n, k), up to a constant."""
        z = np.linalg.solve(self.factor, (x - self.centre).T)
        return np.asarray(-0.5 * (HEAVY + self.centre.size) * np.log1p(np.sum(z**2, axis=0) / HEAVY))

    def __call__(self, x: Array, random: Any) -> tuple[Array, Array]:
        """Return where chains at x (n, k) may go, and the logarithms of the ratios of densities."""
        normal, scale = random.standard_normal(x.shape), random.chisquare(HEAVY, size=(x.shape[0], 1)) / HEAVY
        moved = self.centre + (normal / np.sqrt(scale)) @ self.factor.T
        return moved, self.log_density(x) - self.log_density(moved)


def _log_posterior(problem: Problem, fit: Fit, rough: StateSpaceFit | None) -> Callable[[Array], float]:
    """Return the logarithm of the posterior density, up to a constant."""
    noise = {f.name: f.noise for f in fit.runs}
    parts = {f.name: f.parts for f in fit.runs}

    def log_posterior(theta: Array) -> float:
        if (theta <= problem.lower).any() or (theta >= problem.upper).any():
            return -np.inf
        if rough is not None:
            x = rough.likelihood.coordinates({**rough.values, **dict(zip(problem.names, theta.tolist(), strict=True))})
            found = rough.likelihood.at(x, slopes=False).log_likelihood
            return found if np.isfinite(found) else -np.inf
        total = 0.0
        for run in problem.runs:
            difference = problem.predicted(run, theta, slopes=False).y - run.observed
            if not np.isfinite(difference).all():
                return -np.inf
            white = whiten(noise[run.name], difference, parts[run.name])
            total += float(white @ white)
        return -0.5 * total

    return log_posterior


def to_arviz(posterior: Posterior) -> Any:
    """Return the draws as ArviZ's InferenceData, (chain, draw) for each parameter; raises SrfError without ArviZ."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what its next version will rename
            import arviz
    except ImportError as error:
        raise SrfError("this needs arviz, which is not installed", 'pip install "srfcli[arviz]"') from error
    columns: dict[str, Any] = {name: posterior.chains[:, :, k].T for k, name in enumerate(posterior.names)}
    return arviz.from_dict(posterior=columns)
