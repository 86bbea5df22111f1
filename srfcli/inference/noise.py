"""The noise of a recording: its level and colour, and the filter that makes it white.

An autoregressive model of order p, chosen by the Bayesian information criterion; a fit on coloured noise that is taken for
white has standard errors that are several times too small.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import comb, sqrt

import numpy as np

from srfcli.codegen.model import Array

ORDERS = 6
UNEVEN_SPACING = 1.5  # a spacing so much longer or shorter than its neighbours' ends an evenly sampled stretch


@dataclass(frozen=True)
class Noise:
    """Noise e_t = sum_i coefficients[i] e_(t-1-i) + innovation; `innovation` and `level` are standard deviations."""

    innovation: float
    coefficients: tuple[float, ...] = ()
    level: float = 0.0

    @property
    def order(self) -> int:
        """Return the order p; 0 is white."""
        return len(self.coefficients)


def stretches(t: Array, used: Array) -> list[tuple[int, int]]:
    """Return the evenly sampled stretches [a, b) of used samples, two or more samples each; others are stretches of one."""
    keep = np.nonzero(used)[0]
    if keep.size < 2:
        return [(int(k), int(k) + 1) for k in keep]
    gap = np.diff(t[keep])
    cut = np.diff(keep) > 1
    ratio = gap[1:] / gap[:-1]
    cut[1:] |= (ratio > UNEVEN_SPACING) | (ratio < 1 / UNEVEN_SPACING)
    edges = [0, *(np.nonzero(cut)[0] + 1).tolist(), keep.size]
    return [(int(keep[a]), int(keep[b - 1]) + 1) for a, b in pairwise(edges) if b > a]


def whiten(noise: Noise, columns: Array, parts: list[tuple[int, int]]) -> Array:
    """Return innovations over their standard deviation, of the samples in `parts` in order; `columns` is (n,) or (n, k).

    The first samples of a stretch are whitened by the lower-order predictors of the same process (Levinson and Durbin), so
    that no sample is lost and the likelihood is exact.
    """
    out, predictors = [], _predictors(noise)
    for a, b in parts:
        piece = columns[a:b]
        white = np.empty_like(piece)
        for k in range(min(noise.order, b - a)):
            phi, sd = predictors[k]
            past = sum((c * piece[k - 1 - i] for i, c in enumerate(phi)), np.zeros_like(piece[0]))
            white[k] = (piece[k] - past) / sd
        if b - a > noise.order:
            rest = piece[noise.order :].copy()
            for i, c in enumerate(noise.coefficients):
                rest -= c * piece[noise.order - 1 - i : b - a - 1 - i]
            white[noise.order :] = rest / noise.innovation
        out.append(white)
    return np.concatenate(out) if out else columns[:0]


def _predictors(noise: Noise) -> list[tuple[Array, float]]:
    """Return, for k = 0 .. p - 1, the best predictor from k samples and the standard deviation of its error."""
    phi, variance = np.array(noise.coefficients), noise.innovation**2
    found = []
    for _ in range(noise.order):
        last = phi[-1]
        variance /= 1 - last**2
        phi = (phi[:-1] + last * phi[-2::-1]) / (1 - last**2) if phi.size > 1 else phi[:0]
        found.append((phi, sqrt(variance)))
    return found[::-1]


def log_determinant(noise: Noise, parts: list[tuple[int, int]]) -> float:
    """Return the sum of the logarithms of the standard deviations that `whiten` divides by."""
    total, first = 0.0, [np.log(sd) for _, sd in _predictors(noise)]
    for a, b in parts:
        total += sum(first[: min(b - a, noise.order)]) + max(b - a - noise.order, 0) * np.log(noise.innovation)
    return float(total)


def estimate_noise(residual: Array, parts: list[tuple[int, int]]) -> Noise:
    """Return the autoregressive noise of `residual` (n,), by Burg's method; its order by the Bayesian information criterion."""
    long = [residual[a:b] for a, b in parts if b - a > 4 * ORDERS]
    n = sum(piece.size for piece in long)
    values = np.concatenate([residual[a:b] for a, b in parts]) if parts else residual
    level = float(np.sqrt(np.mean(values**2)))
    if not n or level == 0:
        return Noise(max(level, 1e-300), (), level)
    forward, backward = [p.copy() for p in long], [p.copy() for p in long]
    variance, phi = float(np.mean(np.concatenate(long) ** 2)), np.zeros(0)
    best = (n * np.log(variance), phi, variance)
    for order in range(1, ORDERS + 1):
        above = sum(float(f[1:] @ b[:-1]) for f, b in zip(forward, backward, strict=True))
        below = sum(float(f[1:] @ f[1:] + b[:-1] @ b[:-1]) for f, b in zip(forward, backward, strict=True))
        k = 2 * above / below if below else 0.0
        phi = np.concatenate([phi - k * phi[::-1], [k]])
        variance *= 1 - k * k
        stepped = [(f[1:] - k * b[:-1], b[:-1] - k * f[1:]) for f, b in zip(forward, backward, strict=True)]
        forward, backward = [s[0] for s in stepped], [s[1] for s in stepped]
        score = n * np.log(variance) + order * np.log(n)
        if score < best[0]:
            best = (score, phi.copy(), variance)
    return Noise(sqrt(best[2]), tuple(best[1].tolist()), level)


def difference_level(values: Array, parts: list[tuple[int, int]]) -> float:
    """Return the standard deviation of white noise under a smooth signal, from its third differences.

    White noise alone is measured: coloured noise is smooth at the sampling interval and counts in part as signal.
    """
    total, count = 0.0, 0
    for a, b in parts:
        if b - a > 4:
            d = np.diff(values[a:b], n=3)
            total, count = total + float(d @ d), count + d.size
    return sqrt(total / count / comb(6, 3)) if count else 0.0


def lag_one(values: Array, parts: list[tuple[int, int]]) -> float:
    """Return the correlation of neighbouring samples."""
    pairs = [(values[a : b - 1], values[a + 1 : b]) for a, b in parts if b - a > 2]
    if not pairs:
        return 0.0
    first, second = (np.concatenate(side) for side in zip(*pairs, strict=True))
    scale = float(np.sqrt((first @ first) * (second @ second)))
    return float(first @ second) / scale if scale else 0.0
