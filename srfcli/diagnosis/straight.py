"""A model's parameters where they are not bent by what the model misses.

Least squares spreads a misfit over all that its parameters reach. Two other choices leave it where it is: the parameters that a
better model has, and those under which as many samples as possible are in order (a Cauchy likelihood, in which a sample that is
far off counts little).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from srfcli.diagnosis.pieces import pieces_of
from srfcli.diagnosis.places import Piece
from srfcli.inference.latent import Latent, LatentFit, Point
from srfcli.inference.noise import Noise
from srfcli.numerics.collocation import Array

WIDTH = 3.0  # standard deviations of the noise beyond which a sample counts less and less
ROUNDS, SHARES, SOLVES = 4, (1.0, 0.3, 0.1), 12
CELL, CALM = 64, 4.0  # samples of a cell, and standard deviations of its power up to which it is in order
CLEAN = 0.1  # share of the recordings that a better model's parameters must leave in order to be taken


def unbent(fitted: LatentFit, noise: Mapping[str, Noise], last: LatentFit | None) -> LatentFit:
    """Return a fit with straightened parameters, its track as it was; `last` is a fit of a model that has what this one misses.

    The better model's parameters are taken where they leave a tenth of the recordings in order, else the most orderly ones.
    """
    latent, theta = Latent(fitted.problem), fitted.point.theta

    def at(values: Array) -> LatentFit:
        point = fitted.point
        return replace(fitted, point=latent.at(values, point.tracks, noise, point.roughness))

    starts = [fitted]
    if last is not None:
        known = last.values
        moved = np.array([known.get(n, v) for n, v in zip(fitted.problem.names, theta.tolist(), strict=True)])
        other = at(np.clip(moved, fitted.problem.lower, fitted.problem.upper))
        if in_order(pieces_of(other, noise)) >= CLEAN:
            return other
        starts.append(other)
    return min((_orderly(latent, start, noise) for start in starts), key=lambda f: _cost(f, noise))


def in_order(pieces: Sequence[Piece]) -> float:
    """Return the share of all cells in which there is no more than noise."""
    fine = []
    for p in pieces:
        for part in np.array_split(p.white, max(p.white.size // CELL, 1)):
            fine.append(float(part @ part) < part.size + CALM * np.sqrt(2 * part.size))
    return float(np.mean(fine)) if fine else 0.0


def _cost(fitted: LatentFit, noise: Mapping[str, Noise]) -> float:
    """Return minus the log of the Cauchy likelihood; a sample that is not predicted counts as one far off."""
    total = 0.0
    sizes = {r.name: int(r.used.sum()) for r in fitted.problem.runs}
    for p in pieces_of(fitted, noise):
        total += float(np.sum(np.log1p((p.white / WIDTH) ** 2))) + (sizes[p.name] - p.white.size) * np.log1p(1e8)
    return total


def _orderly(latent: Latent, fitted: LatentFit, noise: Mapping[str, Noise]) -> LatentFit:
    """Return the fit after steps in the parameters that lower the Cauchy cost."""
    problem, best, cost = fitted.problem, fitted, _cost(fitted, noise)
    for _ in range(ROUNDS):
        step, before = _step(pieces_of(best, noise), best.point.theta.size) * latent.scale, cost
        for share in SHARES:
            theta = np.clip(best.point.theta + share * step, problem.lower, problem.upper)
            point: Point = latent.at(theta, best.point.tracks, noise, best.point.roughness)
            trial = replace(best, point=point)
            found = _cost(trial, noise)
            if found < cost:
                best, cost = trial, found
                break
        if before - cost < 1e-3 * before:
            break
    return best


def _step(pieces: Sequence[Piece], n: int) -> Array:
    """Return the change of the scaled parameters (n,) that minimises the Cauchy cost of the linearised residuals."""
    r = np.concatenate([p.white for p in pieces])
    X = np.concatenate([p.X[:, :n] for p in pieces])
    step = np.zeros(n)
    for _ in range(SOLVES):
        w = 1 / (1 + ((r - X @ step) / WIDTH) ** 2)
        A = X.T @ (X * w[:, None])
        d = np.sqrt(np.maximum(np.diag(A), 1e-300))
        step = np.linalg.lstsq(A / np.outer(d, d), (X.T @ (w * r)) / d, rcond=1e-12)[0] / d
    return np.asarray(step)
