"""How sure a fit is: profile likelihoods, and Markov chains from the posterior."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import Array
from srfcli.core.errors import SrfError
from srfcli.inference.fit import principal_deviations
from srfcli.inference.profile import CHI2_95, Interval, Refits, interval_end, quadratic
from srfcli.inference.state_space import INTERVAL_TOLERANCE, StateSpaceFit, maximise, point_on_ridge

# Profile likelihood: each parameter held at a value, the others refitted.


def profile(found: StateSpaceFit, name: str, *, progress: Callable[[str], None] = lambda text: None) -> Interval:
    """Return the profile-likelihood interval of one parameter, the others with field and gauge noise refitted."""
    before, ends, refits = found.likelihood.evaluations, [], Refits()
    for side in (-1.0, 1.0):
        ends.append(_end(found, name, side, refits))
        progress(f"{name}: {'upper' if side > 0 else 'lower'} end")
    return Interval(name, ends[0], ends[1], found.likelihood.evaluations - before, refits.gain, refits.likelier)


def _end(found: StateSpaceFit, name: str, side: float, refits: Refits) -> float | None:
    """Return where the profile crosses CHI2_95 on one side."""
    likelihood, best, covariance = found.likelihood, found.maximum.point.x, found.maximum.covariance
    k = likelihood.names.index(name)
    error = float(np.sqrt(covariance[k, k]))
    room = likelihood.upper[k] - best[k] if side > 0 else best[k] - likelihood.lower[k]
    x = best

    def deviance(distance: float) -> float:
        nonlocal x
        value = best[k] + side * distance
        start = np.clip(x + covariance[:, k] / covariance[k, k] * (value - x[k]), likelihood.lower, likelihood.upper)
        start[k] = value
        point = maximise(likelihood, start, fixed=(name,), close=INTERVAL_TOLERANCE).point
        x = point.x if np.isfinite(point.log_likelihood) else x
        own = {n: point.values[n] for n in likelihood.problem.names}
        return refits.record(2 * (found.log_likelihood - point.log_likelihood), own)

    distance = interval_end(deviance, error, float(room))
    if distance is None:
        return None
    value = best[k] + side * distance
    return float(np.exp(value) if likelihood.logarithmic[k] else value)


def not_quadratic(found: StateSpaceFit) -> list[str]:
    """Return the parameters at whose ends of 1.96 standard errors the likelihood is not what the covariance says.

    The others follow by the covariance and are not refitted: a ridge that bends is found, too.
    """
    likelihood, maximum, names = found.likelihood, found.maximum, []
    for j in np.flatnonzero(np.diag(maximum.covariance)[: len(likelihood.problem.names)] > 0).tolist():
        reach = np.sqrt(CHI2_95 * maximum.covariance[j, j])
        ends = [
            2 * (found.log_likelihood - point_on_ridge(likelihood, maximum, j, side * reach).log_likelihood) for side in (-1, 1)
        ]
        if not quadratic(ends):
            names.append(likelihood.names[j])
    return names


# Draws from the posterior by Markov chains, under flat priors within the bounds, and what they are worth.

ADAPTATION_DRAWS = 250  # draws for each parameter after which the burn-in makes its proposals anew
MIN_STEPS = 50  # between two of these, and of those kept: of fewer nobody could say what they are worth
DISCARDED_TIMES = 5.0  # correlation times that are left out at the beginning
BURN_IN_R_HAT = 1.03  # R-hat at which the burn-in may end
LONGEST_BURN_IN = 1000  # steps of burn-in
INDEPENDENT_PROPOSALS = 0.85  # share of proposals that do not depend on where a chain is; the others stretch the ensemble
PROPOSAL_SCALE = 1.2  # over the spread of the burn-in's draws: chains get stuck where proposals are rarer than the posterior
OPEN_END = 2.0  # of log posterior, for a standard error that ends beyond a bound
PROPOSAL_DOF = 10.0  # degrees of freedom of those proposals, so that no tail of the posterior is left out
DRAWS_PER_COEFFICIENT = 8  # draws of the burn-in for each coefficient of the ridge's bend


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
        return r_hat(self.chains)


def r_hat(chains: Array) -> Array:
    """Return the split R-hat (k,) of chains (steps, chains, k); NaN of few."""
    half = chains.shape[0] // 2
    if half < 2:
        return np.full(chains.shape[-1], np.nan)
    parts = np.concatenate([chains[:half], chains[half : 2 * half]], axis=1)
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
    found: StateSpaceFit, count: int, *, seed: int = 0, progress: Callable[[str, float], None] = lambda text, share: None
) -> Posterior:
    """Return at least `count` draws of the problem's parameters, as `draw` makes them; field and gauge noise are held."""
    problem = found.likelihood.problem
    lower, upper, k = problem.lower, problem.upper, len(problem.names)

    def log_posterior(theta: Array) -> float:
        if (theta <= lower).any() or (theta >= upper).any():
            return -np.inf
        x = found.likelihood.coordinates({**found.values, **dict(zip(problem.names, theta.tolist(), strict=True))})
        here = found.likelihood.at(x, slopes=False).log_likelihood
        return here if np.isfinite(here) else -np.inf

    best = np.array([found.values[n] for n in problem.names])
    return draw(log_posterior, problem.names, best, found.covariance[:k, :k], (lower, upper), count, seed=seed, progress=progress)


def draw(
    log_posterior: Callable[[Array], float],
    names: tuple[str, ...],
    best: Array,
    covariance: Array,
    bounds: tuple[Array, Array],
    count: int,
    *,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Posterior:
    """Return at least `count` draws of a posterior whose maximum is at `best` (k,) with `covariance` (k, k).

    Most proposals are drawn along the ridge of the posterior as the burn-in's draws show it (`_Ridge`), the others stretch the
    ensemble. The burn-in ends when it is five correlation times long. `progress` is told what is done and which share of it.
    Ctrl-C ends it with the draws so far.

    References
    ----------
    Goodman and Weare (2010), Comm. App. Math. Comp. Sci. 5, 65: stretch moves. Parno and Marzouk (2018), SIAM/ASA J. Uncertainty
    Quantification 6, 645: proposals through a triangular polynomial map.
    """
    try:
        import emcee
    except ImportError as error:
        raise SrfError("`sample` needs emcee, which is not installed", 'pip install "srfcli[sample]"') from error
    k = len(names)
    chains = 2 * k + 4
    every = max(MIN_STEPS, -(-ADAPTATION_DRAWS * k // chains))
    rng = np.random.default_rng(seed)
    best, covariance = _inside(log_posterior, best, covariance, bounds)
    scale = _straight(log_posterior, best, covariance, bounds[0])

    def log_density(y: Array) -> float:
        theta = scale.inverse_transform(y)
        return log_posterior(theta) + float(np.sum(np.log(theta[scale.logarithmic])))

    over = np.where(scale.logarithmic, best, 1.0)
    ridge = _Ridge(scale.transform(best), principal_deviations(covariance / np.outer(over, over)))
    moves = [(emcee.moves.MHMove(ridge), INDEPENDENT_PROPOSALS), (emcee.moves.StretchMove(), 1.0 - INDEPENDENT_PROPOSALS)]
    drawn = scale.inverse_transform(ridge.inverse_transform(rng.standard_normal((chains, k))))
    start = scale.transform(_within(drawn, bounds))
    sampler = emcee.EnsembleSampler(chains, k, log_density, moves=moves)
    sampler._random = np.random.RandomState(seed)
    steps, burnt, interrupted = max(-(-count // chains), MIN_STEPS), 0, False
    try:
        for number, _ in enumerate(sampler.sample(start, iterations=LONGEST_BURN_IN + steps), 1):
            if not burnt and number % every == 0:
                later = sampler.get_chain(discard=number // 3)
                ridge.learn(later.reshape(-1, k))
                independent = np.nanmin(np.maximum(effective_size(later), 1e-9))  # draws of the slowest parameter
                slowness = later.shape[0] * chains / independent  # steps after which they are
                mixed = number >= DISCARDED_TIMES * slowness and r_hat(later).max() <= BURN_IN_R_HAT
                burnt = number if mixed or number >= LONGEST_BURN_IN else 0
            progress(f"posterior: step {number}", number / (max(burnt, every) + steps))
            if burnt and number == burnt + steps:
                break
    except KeyboardInterrupt:
        interrupted = True
        if sampler.iteration < 2:
            raise
        burnt = burnt or sampler.iteration // 2
    accepted = float(np.mean(sampler.acceptance_fraction))
    return Posterior(names, scale.inverse_transform(sampler.get_chain(discard=burnt)), burnt, accepted, interrupted)


def _within(theta: Array, bounds: tuple[Array, Array]) -> Array:
    """Return parameters (..., k) between their bounds, none at one: there the posterior is 0."""
    margin = 1e-9 * (bounds[1] - bounds[0])
    return np.clip(theta, bounds[0] + margin, bounds[1] - margin)


def _inside(
    log_posterior: Callable[[Array], float], best: Array, covariance: Array, bounds: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Return the maximum inside its bounds, and the covariance with a spread where the fit left a parameter at a bound.

    So far the posterior falls by a half.
    """
    best = _within(best, bounds)
    base, full = log_posterior(best), covariance.copy()
    for k in np.flatnonzero(~(np.diag(covariance) > 0)):
        inwards = 1.0 if best[k] - bounds[0][k] < bounds[1][k] - best[k] else -1.0
        reach, theta = bounds[1][k] - bounds[0][k], best.copy()
        for _ in range(60):
            reach /= 2
            theta[k] = best[k] + inwards * reach
            if log_posterior(theta) >= base - 0.5:
                break
        full[k], full[:, k], full[k, k] = 0.0, 0.0, reach**2
    return best, full


@dataclass(frozen=True)
class _Scale:
    """Coordinates in which chains move: logarithms of what is positive, along which ridges of the posterior are straighter."""

    logarithmic: NDArray[np.bool_]

    def transform(self, theta: Array) -> Array:
        """Return the coordinates of parameters (..., k)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self.logarithmic, np.log(theta), theta)

    def inverse_transform(self, y: Array) -> Array:
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
            off[curved] = sum(abs(e) if np.isfinite(e) else OPEN_END for e in ends)
        logarithmic[k] = off[True] < off[False]
    return _Scale(logarithmic)


class _Ridge:
    """Proposals of Student's t, wherever a chain is, in coordinates z in which a bent ridge of the posterior is straight.

    Along directions in which the posterior is Gaussian with unit spread, y = centre + factor w, the coordinate w_j is z_j times a
    spread, and a quadratic function of the w before it. That map is triangular, so that densities in y and in z are
    proportional. It begins as that of the covariance at the maximum: centre (k,), factor (k, k).
    """

    def __init__(self, centre: Array, factor: Array) -> None:
        k = centre.size
        self.centre, self.factor, self.spread = centre, factor, np.ones(k)
        self.bends: list[Array | None] = [None] * k
        self._maximum = factor
        self._pairs = np.triu_indices(k)

    def _terms(self, w: Array, j: int) -> Array:
        """Return the products (n, ...) of two of the first j coordinates w (n, k), and ones."""
        first, second = (index[self._pairs[1] < j] for index in self._pairs)
        return np.column_stack([w[:, first] * w[:, second], np.ones(len(w))])

    def learn(self, draws: Array) -> None:
        """Take the map from draws (n, k), where these have a spread in every direction.

        First come the directions in which they are narrowest, in units of the spread at the maximum: a ridge that bends is wider
        there than at its maximum in the direction into which it bends.
        """
        straight = np.linalg.solve(self._maximum, (draws - draws.mean(axis=0)).T)
        values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(straight)))
        if not values[0] > 1e-12 * values[-1]:
            return
        self.centre, self.factor = draws.mean(axis=0), self._maximum @ vectors * np.sqrt(values)
        w = np.linalg.solve(self.factor, (draws - self.centre).T).T
        self.spread = np.full(self.centre.size, PROPOSAL_SCALE)
        for j in range(1, self.centre.size):
            terms = self._terms(w, j)
            self.bends[j] = None
            if len(w) >= DRAWS_PER_COEFFICIENT * terms.shape[1]:
                self.bends[j] = bend = np.linalg.lstsq(terms, w[:, j], rcond=None)[0]
                self.spread[j] = PROPOSAL_SCALE * np.std(w[:, j] - terms @ bend)

    def transform(self, y: Array) -> Array:
        """Return z at y (n, k)."""
        w = np.linalg.solve(self.factor, (y - self.centre).T).T
        bent = [0.0 if bend is None else self._terms(w, j) @ bend for j, bend in enumerate(self.bends)]
        return (w - np.column_stack(np.broadcast_arrays(*bent, w[:, 0])[:-1])) / self.spread

    def inverse_transform(self, z: Array) -> Array:
        """Return y at z (n, k)."""
        w = z * self.spread
        for j, bend in enumerate(self.bends):
            if bend is not None:
                w[:, j] += self._terms(w, j) @ bend
        return self.centre + w @ self.factor.T

    def log_density(self, y: Array) -> Array:
        """Return the logarithm of the proposals' density at y (n, k), up to a constant."""
        return np.asarray(-0.5 * (PROPOSAL_DOF + y.shape[1]) * np.log1p(np.sum(self.transform(y) ** 2, axis=1) / PROPOSAL_DOF))

    def __call__(self, x: Array, random: Any) -> tuple[Array, Array]:
        """Return where chains at x (n, k) may go, and the logarithms of the ratios of densities."""
        normal, scale = random.standard_normal(x.shape), random.chisquare(PROPOSAL_DOF, size=(x.shape[0], 1)) / PROPOSAL_DOF
        moved = self.inverse_transform(normal / np.sqrt(scale))
        return moved, self.log_density(x) - self.log_density(moved)


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
