"""Fits with a random friction field along slip, of each run or one for all.

The function is a cubic spline whose numbers have a Gaussian prior with a Matern covariance (smoothness 3/2) of unknown amplitude
and length. Parameters and numbers are estimated together by Gauss-Newton steps on the motion itself, so that a stick-slip cycle
that comes too early finds its cause in the track; amplitude and length by the marginal likelihood of the linearised problem.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from srfcli.codegen.model import Array
from srfcli.codegen.splines import Spline
from srfcli.data.values import Run
from srfcli.inference.fit import Problem
from srfcli.inference.noise import Noise, estimate_noise, log_determinant, stretches, whiten
from srfcli.inference.prediction import Prediction, predict

# Tracks whose friction wanders: splines over slip, of each run or one for all, and the prior of their numbers.

SPACING = 0.8  # um between knots: contacts are renewed over half of it, and a finer track fits no better
MOST = 300  # numbers of a track: a longer one has wider knots


@dataclass(frozen=True)
class Roughness:
    """Standard deviation of mu0 along the track and its correlation length (um); amplitude 0 is a smooth track."""

    amplitude: float = 0.0
    length: float = 5.0

    def root(self, nodes: Array) -> Array:
        """Return L with L L' the covariance of a track's numbers."""
        d = np.abs(nodes[:, None] - nodes[None, :]) * np.sqrt(3) / self.length
        K = (1 + d) * np.exp(-d) + 1e-8 * np.eye(nodes.size)
        return self.amplitude * np.linalg.cholesky(K)


USUAL = Roughness(3e-4, 8.0)  # of a track until its own is estimated: polished contacts wander by so much


@dataclass(frozen=True)
class Tracks:
    """The splines of all runs: `of` tells, for each run's name, which of `splines` it slid on."""

    splines: tuple[Spline, ...]
    of: Mapping[str, int]

    @property
    def numbers(self) -> Array:
        """Return the numbers of all splines, one after another."""
        return np.concatenate([s.numbers for s in self.splines]) if self.splines else np.zeros(0)

    def with_numbers(self, numbers: Array) -> Tracks:
        """Return the same knots with other numbers."""
        edges = np.cumsum([0, *(s.numbers.size for s in self.splines)])
        return Tracks(
            tuple(s.with_numbers(numbers[a:b]) for s, a, b in zip(self.splines, edges, edges[1:], strict=False)),
            self.of,
        )

    @property
    def shared(self) -> bool:
        """Return whether several runs slid on one track."""
        return len(self.splines) == 1 < len(self.of)

    def columns(self, run: Run) -> range:
        """Return the places of a run's numbers among all."""
        before = sum(s.numbers.size for s in self.splines[: self.of[run.name]])
        return range(before, before + self.spline(run).numbers.size)

    def spline(self, run: Run) -> Spline:
        """Return the track of a run; a smooth one where none is known."""
        return self.splines[self.of[run.name]] if run.name in self.of else Spline.over(-1.0, 1.0, 1.0)

    def root(self, roughness: Roughness) -> Array:
        """Return L with L L' the prior covariance of all numbers."""
        return block_diag(*(roughness.root(s.nodes) for s in self.splines)) if self.splines else np.zeros((0, 0))


def tracks_for(runs: Sequence[Run], *, shared: bool) -> Tracks:
    """Return smooth tracks that cover the slip of these runs: one for all, or one for each."""
    ends = {}
    for run in runs:
        V = run.drive(run.t)
        ends[run.name] = run.start + float(np.sum(0.5 * (V[1:] + V[:-1]) * np.diff(run.t)))
    if shared:
        return Tracks((_cover(min(r.start for r in runs), max(ends.values())),), {r.name: 0 for r in runs})
    return Tracks(tuple(_cover(r.start, ends[r.name]) for r in runs), {r.name: i for i, r in enumerate(runs)})


def _cover(low: float, high: float) -> Spline:
    return Spline.over(low - 1.0, high + 2.0, max(SPACING, (high - low) / (MOST - 3)))


# Fits with a rough track: mu0 wanders along the track by a random function of slip position, of each run or the same for all.

AMPLITUDES = np.array([0.0, *np.geomspace(2e-5, 3e-3, 12)])
LENGTHS = np.geomspace(1.0, 30.0, 6)
GRID = (LENGTHS, AMPLITUDES)  # lengths and amplitudes of the roughness that are tried
LATENT_STEPS = 25
SETTLED = 0.02  # gain of twice the log likelihood below which the minimum is reached
EARLY = 2.0  # the same while roughness and noise still change
FAR = (
    (1.5, 1e-6),
    (4.0, 1e-4),
    (np.inf, 1e-2),
)  # of chi-squared, the same up to so many times the samples: no minimum there matters
LOST = 30.0  # chi-squared per sample of a fit that is given up after one round
ROUGHLY = 6.0  # the same within which roughness is estimated: farther off it would take up what is not its own


@dataclass(frozen=True)
class Point:
    """Parameters and tracks, what they predict, and the normal equations there: `N` and `g` over (theta, numbers), theta scaled.

    `log_likelihood` is that of the whitened residuals; `chi2` their sum of squares.
    """

    theta: Array
    tracks: Tracks
    roughness: Roughness
    predictions: dict[str, Prediction] = field(repr=False)
    N: Array = field(repr=False)
    g: Array = field(repr=False)
    chi2: float
    log_likelihood: float

    @property
    def penalised(self) -> float:
        """Return minus twice the log posterior, but for what does not change with parameters and tracks."""
        if not self.roughness.amplitude:
            return self.chi2
        return self.chi2 + sum(
            float(np.sum(np.linalg.solve(self.roughness.root(s.nodes), s.numbers) ** 2)) for s in self.tracks.splines
        )


BAD = 1e6  # residual, in standard deviations, of a sample that the integration did not reach
HUGE = 1e100  # a slope that is no slope any more: its square would overflow


def unreached(difference: Array, J: Array, noise: Noise) -> Array:
    """Return which samples (n,) have no residual or no slopes (n, k) to speak of: the integration did not reach them."""
    return ~((np.abs(difference) < BAD * noise.innovation) & (np.abs(J) < HUGE).all(axis=1))


class Latent:
    """The likelihood of a problem whose model has the track as its first table, or none."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.rough = any(slot == "mu" for slot, _ in problem.model.namespace.get("TABLES", ()))
        self.scale = np.maximum(np.abs(problem.start), 1e-3 * (problem.upper - problem.lower))
        self.evaluations = 0
        self.samples = sum(int(run.used.sum()) for run in problem.runs)

    def predicted(self, run: Run, theta: Array, tracks: Tracks, *, slopes: bool = True) -> Prediction:
        """Return the prediction of a run, with slopes by parameters and by the numbers of its track."""
        problem = self.problem
        return predict(
            problem.model, problem.experiment, run, problem.named(theta), by=problem.names if slopes else (),
            trend=None if run.holdout else problem.trend, tables=(tracks.spline(run),) if self.rough else (),
            by_tables=(0,) if slopes and self.rough and run.name in tracks.of else (),
        )  # fmt: skip

    def at(self, theta: Array, tracks: Tracks, noise: Mapping[str, Noise], roughness: Roughness) -> Point:
        """Return everything at these parameters and these tracks."""
        n = theta.size
        k = n + tracks.numbers.size
        N, g, chi2, total, found = np.zeros((k, k)), np.zeros(k), 0.0, 0.0, {}
        self.evaluations += 1
        for run in self.problem.runs:
            p = self.predicted(run, theta, tracks)
            found[run.name] = p
            places = [*range(n), *(n + i for i in tracks.columns(run))] if run.name in tracks.of else list(range(n))
            parts, own = stretches(run.t, run.used), noise[run.name]
            difference = run.observed - p.y
            bad = unreached(difference, p.J, own)
            difference[bad] = BAD * own.innovation
            J = np.where(bad[:, None], 0.0, p.J)
            J[:, :n] *= self.scale
            white = whiten(own, np.column_stack([difference, J]), parts)
            r, slopes = white[:, 0], white[:, 1:]
            N[np.ix_(places, places)] += slopes.T @ slopes
            g[places] += slopes.T @ r
            chi2 += float(r @ r)
            total -= 0.5 * float(r @ r) + log_determinant(own, parts) + 0.5 * r.size * np.log(2 * np.pi)
        return Point(theta, tracks, roughness, found, N, g, chi2, total)

    def minimise(
        self, point: Point, noise: Mapping[str, Noise], *, steps: int = LATENT_STEPS, settled: float = SETTLED
    ) -> Point:
        """Return the most probable parameters and numbers under this noise and roughness, by Levenberg and Marquardt."""
        problem, damping = self.problem, 0.0
        n = point.theta.size
        low, high = problem.lower, problem.upper
        point = self.at(point.theta, point.tracks, noise, point.roughness)
        rough = bool(point.tracks.splines) and point.roughness.amplitude > 0
        L = point.tracks.root(point.roughness) if rough else np.zeros((0, 0))
        for _ in range(steps if n or rough else 0):
            free = np.ones(n, dtype=bool)
            while True:  # parameters that a step would push out stay at their bounds
                move, gain = self._step(point, L, free, damping)
                theta = point.theta + move[:n] * self.scale
                out = free & ((theta < low) & (point.theta <= low) | (theta > high) & (point.theta >= high))
                if not out.any():
                    break
                free &= ~out
            theta = np.clip(theta, low, high)
            tracks = point.tracks.with_numbers(point.tracks.numbers + move[n:]) if rough else point.tracks
            trial = self.at(theta, tracks, noise, point.roughness)
            gained = point.penalised - trial.penalised
            if gained > 0:
                point = trial
                damping = 0.0 if damping < 1e-6 else damping / 8
                if gained < self.worth(point, settled):
                    break
            else:
                if gain < self.worth(point, settled) or damping > 1e6:
                    break
                damping = max(8 * damping, 1e-4)
        return point

    def worth(self, point: Point, settled: float) -> float:
        """Return the gain below which a further step is not worth it."""
        share = point.chi2 / max(self.samples, 1)
        return max(settled, next(far for most, far in FAR if share < most or most == np.inf) * point.chi2)

    def roughness(self, point: Point, grid: tuple[Array, Array]) -> Roughness:
        """Return the roughness at which the marginal likelihood is largest, the one so far where that means nothing."""
        if point.chi2 > ROUGHLY * self.samples:
            return point.roughness if point.roughness.amplitude else USUAL
        return _marginal_at(point, point.theta.size, grid).roughness

    def _step(self, point: Point, L: Array, free: Array, damping: float) -> tuple[Array, float]:
        """Return the step over (scaled theta, numbers), and what it should gain in minus twice the log posterior."""
        n = free.size
        T = np.zeros((point.g.size, int(free.sum()) + L.shape[1]))
        T[np.nonzero(free)[0], np.arange(free.sum())] = 1.0
        T[n : n + L.shape[0], free.sum() :] = L
        A, b = T.T @ point.N @ T, T.T @ point.g
        if L.size:
            z = np.linalg.solve(L, point.tracks.numbers)
            A[free.sum() :, free.sum() :] += np.eye(L.shape[1])
            b[free.sum() :] -= z
        if not A.size:  # every parameter stands at a bound, and there is no track
            return np.zeros(point.g.size), 0.0
        A[np.diag_indices_from(A)] *= 1 + damping
        A[np.diag_indices_from(A)] += 1e-12 * np.diag(A).max()
        x = np.linalg.solve(A, b)
        return T @ x, float(x @ b)

    def noise(self, point: Point) -> dict[str, Noise]:
        """Return the noise of each run's residuals."""
        found = {}
        for run in self.problem.runs:
            residual = run.observed - point.predictions[run.name].y
            found[run.name] = estimate_noise(residual, stretches(run.t, run.used & np.isfinite(residual)))
        return found


@dataclass(frozen=True)
class Marginal:
    """The linearised likelihood with the track integrated out: log likelihood, and the roughness at which it is largest."""

    log_likelihood: float
    roughness: Roughness
    smooth: float  # the same for a smooth track


def marginal(
    N: Array, g: Array, fixed: Sequence[int], numbers: Sequence[int], tracks: Tracks, log_likelihood: float, *,
    grid: tuple[Array, Array] = GRID,
) -> Marginal:  # fmt: skip
    """Return the largest marginal likelihood over amplitude and length, given normal equations at `tracks`.

    `fixed` are the columns of flat parameters, `numbers` those of the tracks; `log_likelihood` is that of the residuals there.
    """
    f, c = np.asarray(fixed, dtype=int), np.asarray(numbers, dtype=int)
    base, G, h = log_likelihood, N[np.ix_(c, c)], g[c]
    if f.size:
        solved = solve_scaled(N[np.ix_(f, f)], np.column_stack([g[f], N[np.ix_(f, c)]]))
        base += 0.5 * float(g[f] @ solved[:, 0])
        G, h = G - N[np.ix_(c, f)] @ solved[:, 1:], h - N[np.ix_(c, f)] @ solved[:, 0]
    now = tracks.numbers
    b = h + G @ now
    smooth = base - float(h @ now) - 0.5 * float(now @ G @ now)
    lengths, amplitudes = grid
    best = (smooth if 0.0 in amplitudes else -np.inf, Roughness())
    wide = lengths[lengths >= 1.2 * max(s.spacing for s in tracks.splines)]
    for length in wide if wide.size else lengths[-1:]:
        unit = tracks.root(Roughness(1.0, float(length)))
        core, forced = unit.T @ G @ unit, unit.T @ b
        values, vectors = np.linalg.eigh(core)
        values, along = np.maximum(values, 0.0), vectors.T @ forced
        for amplitude in amplitudes[amplitudes > 0]:
            s2 = amplitude**2
            found = smooth + 0.5 * float(np.sum(s2 * along**2 / (1 + s2 * values)) - np.sum(np.log1p(s2 * values)))
            if found > best[0]:
                best = (found, Roughness(float(amplitude), float(length)))
    return Marginal(best[0], best[1], smooth)


def solve_scaled(A: Array, b: Array) -> Array:
    """Return the solution of symmetric equations, scaled; directions that nothing determines do not move."""
    d = np.sqrt(np.maximum(np.diag(A), 1e-300))
    values, vectors = np.linalg.eigh(A / np.outer(d, d))
    inverse = np.where(values > 1e-12 * values[-1], 1 / np.maximum(values, 1e-300), 0.0)
    return np.asarray(((vectors * inverse) @ (vectors.T @ (b.T / d).T)).T / d).T if b.ndim > 1 else (
        (vectors * inverse) @ (vectors.T @ (b / d)) / d)  # fmt: skip


@dataclass(frozen=True)
class LatentFit:
    """A fit with its track: the point, its noise, and the log likelihood with the track integrated out."""

    problem: Problem
    point: Point
    noise: dict[str, Noise]
    log_likelihood: float
    evaluations: int

    @property
    def values(self) -> dict[str, float]:
        """Return the parameters by name, in um, s, N."""
        return self.problem.named(self.point.theta)

    @property
    def covariance(self) -> Array:
        """Return the covariance of the free parameters, the track's uncertainty included."""
        n, scale = self.point.theta.size, np.maximum(
            np.abs(self.problem.start), 1e-3 * (self.problem.upper - self.problem.lower)
        )  # fmt: skip
        N = self.point.N.copy()
        if self.point.tracks.splines and self.point.roughness.amplitude:
            L = self.point.tracks.root(self.point.roughness)
            core = L.T @ N[n:, n:] @ L + np.eye(L.shape[1])
            cross = N[:n, n:] @ L
            info = N[:n, :n] - cross @ np.linalg.solve(core, cross.T)
        else:
            info = N[:n, :n]
        d = np.maximum(np.sqrt(np.maximum(np.diag(info), 0.0)), 1e-8)
        values, vectors = np.linalg.eigh(info / np.outer(d, d))
        inverse = (vectors / np.maximum(values, 1e-14)) @ vectors.T / np.outer(d, d)
        return np.asarray(inverse * np.outer(scale, scale))


def fit_latent(problem: Problem, theta: Array, noise: Mapping[str, Noise], *, tracks: Tracks | None = None,
               roughness: Roughness | None = None, rounds: int = 4, known_noise: bool = False,
               steps: int = LATENT_STEPS, grid: tuple[Array, Array] = GRID) -> LatentFit:  # fmt: skip
    """Return the fit from `theta` with noise, roughness and parameters estimated in turn until they agree.

    Noise that is known stays as it is.
    `tracks` say where to start, a smooth one for each run if left out; a model without tables is fitted without any.
    """
    latent = Latent(problem)
    if not latent.rough:
        tracks = Tracks((), {})
    elif tracks is None:
        tracks = tracks_for(problem.runs, shared=False)
    noise = dict(noise)
    point = latent.at(theta, tracks, noise, roughness or Roughness())
    before = -np.inf
    for number in range(rounds):
        last = point
        if point.tracks.splines:
            point = replace(point, roughness=latent.roughness(point, grid))
            if not point.roughness.amplitude:
                point = replace(point, tracks=point.tracks.with_numbers(np.zeros(point.tracks.numbers.size)))
        early = bool(point.tracks.splines) and number + 1 < rounds
        point = latent.minimise(point, noise, steps=steps, settled=EARLY if early else SETTLED)
        if not known_noise:
            noise = latent.noise(point)
            point = latent.at(point.theta, point.tracks, noise, point.roughness)
        total = attained(point)
        if known_noise and total < before:  # the likelihood is not as linear as it took to promise more
            point, total = last, before
            break
        settled = known_noise and (not point.tracks.splines or point.chi2 > LOST * latent.samples)
        if abs(total - before) < 0.5 or settled:
            break
        before = total
    return LatentFit(problem, point, noise, total, latent.evaluations)


def attained(point: Point) -> float:
    """Return the log likelihood with the track integrated out, at the roughness under which it was found."""
    if not point.tracks.splines:
        return point.log_likelihood
    own = np.array([point.roughness.length]), np.array([point.roughness.amplitude])
    return min(_marginal_at(point, point.theta.size, own).log_likelihood, point.log_likelihood)  # no prior adds any


def _marginal_at(point: Point, n: int, grid: tuple[Array, Array]) -> Marginal:
    flat, numbers = range(n), range(n, point.g.size)
    return marginal(point.N, point.g, flat, numbers, point.tracks, point.log_likelihood, grid=grid)
