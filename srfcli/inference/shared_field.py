"""The fit with one random friction field for all runs: mu0 varies with the place on the track by the same random function.

The function is a cubic spline whose coefficients have a Gaussian prior with a Matern covariance (smoothness 3/2) of unknown
amplitude and length. Parameters and coefficients are estimated together by Gauss-Newton steps on the motion itself, so that a
stick-slip cycle that comes too early finds its cause in the field; amplitude and length by the marginal likelihood of the
linearised problem.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from srfcli.codegen.model import Array
from srfcli.codegen.splines import Spline
from srfcli.core.errors import Status
from srfcli.data.scales import scales_of
from srfcli.data.values import Run
from srfcli.inference.fit import Fit, Problem, RunFit, inverse, solve_scaled
from srfcli.inference.noise import Noise, difference_level, estimate_noise, log_determinant, stretches, whiten
from srfcli.inference.prediction import Prediction, predict

KNOTS_IN_SLIP = 150  # in the longest slip of a run: 0.8 um of a slider's 120, over half of which contacts are renewed
MAX_KNOTS = 300  # coefficients of a track: a longer one has wider knots
AMPLITUDES = np.array([0.0, *np.geomspace(2e-5, 3e-3, 12)])
LENGTHS = np.geomspace(1 / 120, 1 / 4, 6)  # of the field that are tried, over the longest slip of a run
FIELD_ROUNDS = 4  # of field, parameters and noise in turn
ROUNDS_AGREE = 0.5  # in log likelihood, between two rounds that agree
MAX_MARQUARDT_STEPS = 25
LEAST_GAIN = 0.02  # gain of twice the log likelihood below which the minimum is reached
EARLY_GAIN = 2.0  # the same while field and noise still change
FAR_GAINS = ((1.5, 1e-6), (4.0, 1e-4), (np.inf, 1e-2))  # of chi-squared, the same up to so many times the samples
# chi-squared per sample within which the field is estimated: farther off it would take up what is not its own
MAX_CHI2_PER_SAMPLE = 6.0
UNREACHED_RESIDUAL = 1e6  # residual, in standard deviations, of a sample that the integration did not reach
OVERFLOWN_SLOPE = 1e100  # a slope that is no slope any more: its square would overflow


@dataclass(frozen=True)
class FieldPrior:
    """Standard deviation of mu0 along the track and its correlation length (um); amplitude 0 is a smooth track."""

    amplitude: float = 0.0
    length: float = 5.0

    def root(self, nodes: Array) -> Array:
        """Return L with L L' the covariance of a track's coefficients."""
        d = np.abs(nodes[:, None] - nodes[None, :]) * np.sqrt(3) / self.length
        K = (1 + d) * np.exp(-d) + 1e-8 * np.eye(nodes.size)
        return self.amplitude * np.linalg.cholesky(K)


DEFAULT_PRIOR = FieldPrior(3e-4, 1 / 15)  # until its own is estimated: polished contacts wander by so much; over the longest slip


def fit_shared(problem: Problem, begun: Fit, *, progress: Callable[[str], None] = lambda text: None) -> tuple[Fit, FieldPrior]:
    """Return the fit in which mu0 varies along a track that all runs share, and what that is like, from where another fit stands.

    The problem's model has the table ("mu", "slip"). Noise, field and parameters are estimated in turn until they agree.
    Held-out runs are judged on that track.
    """
    progress("one random friction field for all runs")
    likelihood, noise = SharedLikelihood(problem), {r.name: Noise(r.noise.level) for r in begun.runs if not r.holdout}
    theta = np.array([begun.values[name] for name in problem.names])
    point, before = likelihood.at(theta, _track(problem.runs, likelihood.slip), noise, FieldPrior()), -np.inf
    for number in range(FIELD_ROUNDS):
        point = replace(point, prior=likelihood.prior(point))
        if not point.prior.amplitude:
            point = replace(point, track=point.track.with_coefficients(np.zeros(point.track.coefficients.size)))
        point = likelihood.minimise(point, noise, settled=EARLY_GAIN if number + 1 < FIELD_ROUNDS else LEAST_GAIN)
        noise = likelihood.noise(point)
        point = likelihood.at(point.theta, point.track, noise, point.prior)
        own = np.array([point.prior.length]), np.array([point.prior.amplitude])
        attained = marginal(point.N, point.g, theta.size, point.track, point.log_likelihood, own)[0]
        total = min(attained, point.log_likelihood)  # no prior adds any
        if abs(total - before) < ROUNDS_AGREE:
            break
        before = total
    runs = tuple(_judged(likelihood, point, r.name) for r in begun.runs)
    fitted = replace(
        begun, values=problem.named(point.theta), covariance=likelihood.covariance(point), runs=runs, log_likelihood=total,
        status=Status.OK, evaluations=begun.evaluations + likelihood.evaluations,
    )  # fmt: skip
    return fitted, point.prior


def _track(runs: Sequence[Run], slip: float) -> Spline:
    """Return a smooth track that covers the slip of these runs, the longest of which is `slip`."""
    low, high = min(r.start for r in runs), max(r.start + float(r.drive.displacement(r.t)[-1]) for r in runs)
    spacing = max(slip / KNOTS_IN_SLIP, (high - low) / (MAX_KNOTS - 6))
    return Spline.over(low - spacing, high + 2 * spacing, spacing)


def _judged(likelihood: SharedLikelihood, point: SharedFieldPoint, name: str) -> RunFit:
    run = next(r for r in likelihood.problem.experiment.runs if r.name == name)
    y = likelihood.predicted(run, point.theta, point.track, slopes=False).y
    residual, parts = run.observed - y, stretches(run.t, run.used)
    return RunFit(name, run.holdout, y, residual, parts, estimate_noise(residual, parts), difference_level(residual, parts))


@dataclass(frozen=True)
class SharedFieldPoint:
    """Parameters and track, what they predict, and normal equations: `N` and `g` over (theta, coefficients), theta scaled.

    `log_likelihood` is that of the whitened residuals; `chi2` their sum of squares.
    """

    theta: Array
    track: Spline
    prior: FieldPrior
    predictions: dict[str, Prediction] = field(repr=False)
    N: Array = field(repr=False)
    g: Array = field(repr=False)
    chi2: float
    log_likelihood: float

    @property
    def penalised(self) -> float:
        """Return minus twice the log posterior, but for what does not change with parameters and track."""
        if not self.prior.amplitude:
            return self.chi2
        return self.chi2 + float(np.sum(np.linalg.solve(self.prior.root(self.track.nodes), self.track.coefficients) ** 2))


class SharedLikelihood:
    """The likelihood of a problem whose model has the track as its first table."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.scale = np.maximum(np.abs(problem.start), 1e-3 * (problem.upper - problem.lower))
        self.evaluations = 0
        self.slip = max(scales_of(problem.runs, ()).get("track", 0.0), 1e-6)  # longest of a run, um
        self.grid = self.slip * LENGTHS, AMPLITUDES
        self.samples = sum(int(run.used.sum()) for run in problem.runs)

    def predicted(self, run: Run, theta: Array, track: Spline, *, slopes: bool = True) -> Prediction:
        """Return the prediction of a run, with slopes by parameters and by the coefficients of the track."""
        problem = self.problem
        return predict(
            problem.model, problem.experiment, run, problem.named(theta), by=problem.names if slopes else (),
            trend=None if run.holdout else problem.trend, tables=(track,), by_tables=(0,) if slopes else (),
        )  # fmt: skip

    def at(self, theta: Array, track: Spline, noise: Mapping[str, Noise], prior: FieldPrior) -> SharedFieldPoint:
        """Return everything at these parameters and this track."""
        n, k = theta.size, theta.size + track.coefficients.size
        N, g, chi2, total, found = np.zeros((k, k)), np.zeros(k), 0.0, 0.0, {}
        self.evaluations += 1
        for run in self.problem.runs:
            p = found[run.name] = self.predicted(run, theta, track)
            parts, own = stretches(run.t, run.used), noise[run.name]
            difference = run.observed - p.y
            bad = ~((np.abs(difference) < UNREACHED_RESIDUAL * own.innovation) & (np.abs(p.J) < OVERFLOWN_SLOPE).all(axis=1))
            difference[bad] = UNREACHED_RESIDUAL * own.innovation
            J = np.where(bad[:, None], 0.0, p.J)
            J[:, :n] *= self.scale
            white = whiten(own, np.column_stack([difference, J]), parts)
            r, slopes = white[:, 0], white[:, 1:]
            N += slopes.T @ slopes
            g += slopes.T @ r
            chi2 += float(r @ r)
            total -= 0.5 * float(r @ r) + log_determinant(own, parts) + 0.5 * r.size * np.log(2 * np.pi)
        return SharedFieldPoint(theta, track, prior, found, N, g, chi2, total)

    def minimise(self, point: SharedFieldPoint, noise: Mapping[str, Noise], *, settled: float = LEAST_GAIN) -> SharedFieldPoint:
        """Return the most probable parameters and coefficients under this noise and field, by Levenberg and Marquardt."""
        problem, damping = self.problem, 0.0
        n, low, high = point.theta.size, problem.lower, problem.upper
        point = self.at(point.theta, point.track, noise, point.prior)
        rough = point.prior.amplitude > 0
        L = point.prior.root(point.track.nodes) if rough else np.zeros((0, 0))
        for _ in range(MAX_MARQUARDT_STEPS if n or rough else 0):
            free = np.ones(n, dtype=bool)
            while True:  # parameters that a step would push out stay at their bounds
                move, gain = self._step(point, L, free, damping)
                theta = point.theta + move[:n] * self.scale
                out = free & ((theta < low) & (point.theta <= low) | (theta > high) & (point.theta >= high))
                if not out.any():
                    break
                free &= ~out
            theta = np.clip(theta, low, high)
            track = point.track.with_coefficients(point.track.coefficients + move[n:]) if rough else point.track
            trial = self.at(theta, track, noise, point.prior)
            gained = point.penalised - trial.penalised
            if gained > 0:
                point = trial
                damping = 0.0 if damping < 1e-6 else damping / 8
                if gained < self.least_gain(point, settled):
                    break
            else:
                if gain < self.least_gain(point, settled) or damping > 1e6:
                    break
                damping = max(8 * damping, 1e-4)
        return point

    def least_gain(self, point: SharedFieldPoint, settled: float) -> float:
        """Return the gain below which a further step is not worth it."""
        share = point.chi2 / max(self.samples, 1)
        return max(settled, next(far for most, far in FAR_GAINS if share < most or most == np.inf) * point.chi2)

    def prior(self, point: SharedFieldPoint) -> FieldPrior:
        """Return the field at which the marginal likelihood is largest, the one so far where that means nothing."""
        if point.chi2 > MAX_CHI2_PER_SAMPLE * self.samples:
            return point.prior if point.prior.amplitude else replace(DEFAULT_PRIOR, length=self.slip * DEFAULT_PRIOR.length)
        return marginal(point.N, point.g, point.theta.size, point.track, point.log_likelihood, self.grid)[1]

    def _step(self, point: SharedFieldPoint, L: Array, free: Array, damping: float) -> tuple[Array, float]:
        """Return the step over (scaled theta, coefficients), and what it should gain in minus twice the log posterior."""
        n = free.size
        T = np.zeros((point.g.size, int(free.sum()) + L.shape[1]))
        T[np.nonzero(free)[0], np.arange(free.sum())] = 1.0
        T[n : n + L.shape[0], free.sum() :] = L
        A, b = T.T @ point.N @ T, T.T @ point.g
        if L.size:
            A[free.sum() :, free.sum() :] += np.eye(L.shape[1])
            b[free.sum() :] -= np.linalg.solve(L, point.track.coefficients)
        if not A.size:  # every parameter stands at a bound, and there is no track
            return np.zeros(point.g.size), 0.0
        A[np.diag_indices_from(A)] *= 1 + damping
        A[np.diag_indices_from(A)] += 1e-12 * np.diag(A).max()
        x = np.linalg.solve(A, b)
        return T @ x, float(x @ b)

    def noise(self, point: SharedFieldPoint) -> dict[str, Noise]:
        """Return the noise of each run's residuals."""
        found = {}
        for run in self.problem.runs:
            residual = run.observed - point.predictions[run.name].y
            found[run.name] = estimate_noise(residual, stretches(run.t, run.used & np.isfinite(residual)))
        return found

    def covariance(self, point: SharedFieldPoint) -> Array:
        """Return the covariance of the free parameters, the track's uncertainty included."""
        n = point.theta.size
        information = point.N[:n, :n]
        if point.prior.amplitude:
            L = point.prior.root(point.track.nodes)
            core = L.T @ point.N[n:, n:] @ L + np.eye(L.shape[1])
            cross = point.N[:n, n:] @ L
            information = information - cross @ np.linalg.solve(core, cross.T)
        return np.asarray(inverse(information) * np.outer(self.scale, self.scale))


def marginal(
    N: Array, g: Array, n: int, track: Spline, log_likelihood: float, grid: tuple[Array, Array]
) -> tuple[float, FieldPrior]:
    """Return the largest marginal likelihood over a grid of lengths and amplitudes, and where, from normal equations at `track`.

    The first n columns are those of flat parameters, the others those of the track; `log_likelihood` is that of the residuals.
    """
    base, G, h = log_likelihood, N[n:, n:], g[n:]
    if n:
        solved = solve_scaled(N[:n, :n], np.column_stack([g[:n], N[:n, n:]]))
        base += 0.5 * float(g[:n] @ solved[:, 0])
        G, h = G - N[n:, :n] @ solved[:, 1:], h - N[n:, :n] @ solved[:, 0]
    now = track.coefficients
    b = h + G @ now
    smooth = base - float(h @ now) - 0.5 * float(now @ G @ now)
    lengths, amplitudes = grid
    best = (smooth if 0.0 in amplitudes else -np.inf, FieldPrior())
    wide = lengths[lengths >= 1.2 * track.spacing]
    for length in wide if wide.size else lengths[-1:]:
        unit = FieldPrior(1.0, float(length)).root(track.nodes)
        core, forced = unit.T @ G @ unit, unit.T @ b
        values, vectors = np.linalg.eigh(core)
        values, along = np.maximum(values, 0.0), vectors.T @ forced
        for amplitude in amplitudes[amplitudes > 0]:
            s2 = amplitude**2
            found = smooth + 0.5 * float(np.sum(s2 * along**2 / (1 + s2 * values)) - np.sum(np.log1p(s2 * values)))
            if found > best[0]:
                best = (found, FieldPrior(float(amplitude), float(length)))
    return best
