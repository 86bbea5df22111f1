"""What each effect could still explain beyond the baseline's own parameters and a rough track, at first order.

Every effect has a column: the derivative of the observable by its size at the neutral value. Whitened by the noise and projected
off the columns of parameters and track, it gives the gain in log likelihood that a refit should bring (Rao's score test), the
size that is to be expected, the share of the effect that the baseline cannot absorb, and the likeness of any two effects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from srfcli.codegen.model import Array
from srfcli.data.values import Experiment
from srfcli.diagnosis.hypotheses import neutral_values
from srfcli.diagnosis.sensitivities import Column, columns_of
from srfcli.inference.noise import stretches, whiten
from srfcli.inference.random_field import LatentFit, marginal, solve_scaled
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect

INNER = 3  # values of an effect's inner parameters that are tried with another effect's, best alone first


@dataclass(frozen=True)
class Score:
    """One effect's score: `gain` in log likelihood at first order, the `size` expected, where its inner parameters fit best.

    `surviving` is the share of the effect's squared signal that parameters and track cannot absorb, `detectable` the size that
    would gain 12 in log likelihood, `direction` its projected whitened column (for likeness).
    """

    effect: Effect
    gain: float
    values: dict[str, float]
    size: float
    stderr: float
    surviving: float
    detectable: float
    direction: Array = field(repr=False, compare=False)


@dataclass(frozen=True)
class PairScore:
    """What two effects could explain together: `gain` in log likelihood at first order, and the parameters expected of each."""

    effects: tuple[Effect, Effect]
    gain: float
    values: tuple[dict[str, float], dict[str, float]]


def scores(registry: Registry, experiment: Experiment, fitted: LatentFit, effects: Sequence[Effect], *,
           present: Sequence[Effect] = ()) -> list[Score]:  # fmt: skip
    """Return the scores of `effects`, largest gain first, around a fit whose model has the effects `present`."""
    if not effects:
        return []
    columns = columns_of(registry, experiment, fitted, effects, tuple(present))
    return sorted(_judged(_Columns(fitted, columns)), key=lambda s: -s.gain)


def pair_scores(
    registry: Registry, experiment: Experiment, fitted: LatentFit, effects: Sequence[Effect]
) -> list[PairScore]:
    """Return what any two of `effects` could explain together, at first order, largest gain first."""
    if len(effects) < 2:
        return []
    around = _Columns(fitted, columns_of(registry, experiment, fitted, effects, ()))
    alone: dict[str, list[tuple[float, int]]] = {}
    for j, column in enumerate(around.columns):
        alone.setdefault(column.effect.name, []).append((around.screened(around.own(j))[0], j))
    foremost = [j for found in alone.values() for _, j in sorted(found, reverse=True)[:INNER]]
    best: dict[frozenset[str], PairScore] = {}
    for i, j in combinations(foremost, 2):
        pair = (around.columns[i], around.columns[j])
        names = frozenset(c.effect.reported for c in pair)
        if len(names) < 2 or any(c.effect.settings for c in pair):
            continue
        own = around.own(i)
        gain, size, _, _ = around.screened([*own, *around.own(j)])
        if names not in best or gain > best[names].gain:
            values = (_expected(pair[0], size[: len(own)]), _expected(pair[1], size[len(own) :]))
            best[names] = PairScore((pair[0].effect, pair[1].effect), gain, values)
    return sorted(best.values(), key=lambda p: -p.gain)


class _Columns:
    """The effects' columns beside those of parameters and tracks, whitened: normal equations around a fit."""

    def __init__(self, fitted: LatentFit, columns: Sequence[Column]) -> None:
        self.fitted, self.columns = fitted, columns
        problem, point = fitted.problem, fitted.point
        n = self.n = point.theta.size
        widths = [next(iter(c.by_run.values())).shape[1] for c in columns]
        self.edges = edges = np.cumsum([0, *widths])
        k = self.k = point.g.size
        self.N, self.g = np.zeros((k + edges[-1], k + edges[-1])), np.zeros(k + edges[-1])
        self.pieces: list[tuple[Sequence[int], Array]] = []
        scale = np.maximum(np.abs(problem.start), 1e-3 * (problem.upper - problem.lower))
        for run in problem.runs:
            p = point.predictions[run.name]
            places = (
                [*range(n), *(n + i for i in point.tracks.columns(run))]
                if run.name in point.tracks.of
                else list(range(n))
            )
            X = np.column_stack([c.by_run[run.name] for c in columns])
            difference = run.observed - p.y
            bad = ~(np.isfinite(difference) & np.isfinite(p.J).all(axis=1) & np.isfinite(X).all(axis=1))
            J = np.column_stack([p.J, X, difference])
            J[bad] = 0.0
            J[:, :n] *= scale
            white = whiten(fitted.noise[run.name], J, stretches(run.t, run.used))
            slopes, r = white[:, :-1], white[:, -1]
            places = [*places, *range(k, k + edges[-1])]
            self.N[np.ix_(places, places)] += slopes.T @ slopes
            self.g[places] += slopes.T @ r
            self.pieces.append((places, slopes))
        self.screened = _screen(fitted, self.N, self.g, n, k)

    def own(self, j: int) -> list[int]:
        """Return the places of one column of an effect, sine and cosine."""
        return list(range(self.k + self.edges[j], self.k + self.edges[j + 1]))


def _judged(around: _Columns) -> list[Score]:
    """Return the best score of each effect over its inner values."""
    fitted, N, g, n, k = around.fitted, around.N, around.g, around.n, around.k
    baseline = _marginal(fitted, N[:k, :k], g[:k], n, [])
    best: dict[str, tuple[float, int]] = {}
    for j, column in enumerate(around.columns):
        gain = around.screened(around.own(j))[0]
        if gain > best.get(column.effect.name, (-1.0, 0))[0]:
            best[column.effect.name] = (gain, j)
    out = []
    for _, j in best.values():
        own = around.own(j)
        _, size, covariance, surviving = around.screened(own)
        gain = max(_marginal(fitted, N, g, n, own) - baseline, 0.0)
        direction = _direction(fitted, around.pieces, N, n, k, own[0])
        out.append(_score(around.columns[j], gain, size, covariance, surviving, direction))
    return out


def _score(column: Column, gain: float, size: Array, covariance: Array, surviving: float, direction: Array) -> Score:
    amplitude = float(np.hypot(size[0], size[1])) if column.phases == 2 else float(size[0])
    stderr = float(np.sqrt(covariance[0, 0]))
    return Score(
        column.effect,
        gain,
        _expected(column, size),
        amplitude,
        stderr,
        surviving,
        float(stderr * np.sqrt(24.0)),
        direction,
    )


def _expected(column: Column, size: Array) -> dict[str, float]:
    """Return the effect's parameters at such sizes, where its inner ones fit best."""
    effect, values, amplitude = column.effect, dict(column.inner), float(size[0])
    if column.phases == 2:  # sine and cosine together: amplitude and phase
        amplitude = float(np.hypot(size[0], size[1]))
        values["phase"] = float(np.arctan2(size[1], size[0]))
    if effect.sizes:
        values[effect.sizes[0]] = neutral_values(effect)[effect.sizes[0]] + amplitude
    return values


def _prior(fitted: LatentFit, k: int, n: int) -> Array:
    """Return the precision that the roughness lends to the tracks' numbers."""
    point = fitted.point
    out = np.zeros((k, k))
    if point.tracks.splines:
        L = point.tracks.root(
            point.roughness if point.roughness.amplitude else replace(point.roughness, amplitude=1e-9)
        )
        inverse = np.linalg.inv(L)
        out[n:, n:] = inverse.T @ inverse
    return out


def _screen(
    fitted: LatentFit, N: Array, g: Array, n: int, k: int
) -> Callable[[Sequence[int]], tuple[float, Array, Array, float]]:
    """Return a function of columns: gain at the fit's own roughness, sizes, their covariance, and the share that survives."""
    Q = _prior(fitted, k, n)
    A = N[:k, :k] + Q
    d = np.sqrt(np.maximum(np.diag(A), 1e-300))
    inverse = np.linalg.pinv(A / np.outer(d, d), rcond=1e-13, hermitian=True) / np.outer(d, d)
    b = g[:k].copy()
    if fitted.point.tracks.splines:
        b[n:] -= Q[n:, n:] @ fitted.point.tracks.numbers
    cross = N[:k, k:]
    projected = N[k:, k:] - cross.T @ inverse @ cross
    forced = g[k:] - cross.T @ (inverse @ b)

    def screened(own: Sequence[int]) -> tuple[float, Array, Array, float]:
        i = np.array(own) - k
        G, h = projected[np.ix_(i, i)], forced[i]
        d = np.sqrt(np.maximum(np.diag(G), 1e-14 * np.diag(N)[i + k] + 1e-200))  # below is rounding
        scaled = G / np.outer(d, d)
        scaled[np.diag_indices_from(scaled)] = 1.0
        covariance = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True) / np.outer(d, d)
        size = covariance @ h
        share = float(np.trace(G) / max(np.trace(N[np.ix_(i + k, i + k)]), 1e-300))
        return 0.5 * float(h @ size), size, covariance, share

    return screened


def _direction(
    fitted: LatentFit, pieces: Sequence[tuple[Sequence[int], Array]], N: Array, n: int, k: int, column: int
) -> Array:
    A = N[:k, :k] + _prior(fitted, k, n)
    d = np.sqrt(np.maximum(np.diag(A), 1e-300))
    weights = np.linalg.pinv(A / np.outer(d, d), rcond=1e-13, hermitian=True) @ (N[:k, column] / d) / d
    out = []
    for places, slopes in pieces:
        at = {p: i for i, p in enumerate(places)}
        inside = [p for p in places if p < k]
        out.append(slopes[:, at[column]] - slopes[:, [at[p] for p in inside]] @ weights[inside])
    whole = np.concatenate(out)
    return np.asarray(whole / max(float(np.linalg.norm(whole)), 1e-300))


def _marginal(fitted: LatentFit, N: Array, g: Array, n: int, added: Sequence[int]) -> float:
    """Return the log likelihood with tracks integrated out, roughness at its best, `added` columns free."""
    point = fitted.point
    k = point.g.size
    fixed = [*range(n), *added]
    if not point.tracks.splines:
        A, b = N[np.ix_(fixed, fixed)], g[fixed]
        return point.log_likelihood + 0.5 * float(b @ solve_scaled(A, b))
    return marginal(N, g, fixed, range(n, k), point.tracks, point.log_likelihood).log_likelihood
