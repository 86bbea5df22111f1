"""Bumps of a track: a place where mu0 is off by more than the roughness of all the rest explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.inference.latent import Point
from srfcli.inference.tracks import Roughness
from srfcli.numerics.collocation import Array

WIDTHS = (0.7, 1.4, 2.8)  # um, of a Gaussian bump
APART = 0.5  # um between places that are looked at
AMPLITUDES = np.geomspace(1e-5, 5e-3, 40)  # of the roughness, chosen anew beside each bump


@dataclass(frozen=True)
class Bump:
    """mu0 gains height exp(-((x - place)/width)^2/2); `p_value` is that of no bump anywhere on a track of one roughness."""

    place: float
    width: float
    height: float
    p_value: float


def likeliest_bump(point: Point) -> Bump | None:
    """Return the bump that explains most of the one track that all runs share; None where each run has a track of its own.

    By the likelihood ratio of the linearised problem, the free parameters and the track integrated out, the roughness's
    amplitude at its best with and without; its p-value is Bonferroni's over numbers and widths. Track and bump are small.
    """
    from scipy.stats import chi2

    if len(point.tracks.splines) != 1 or not point.roughness.amplitude:
        return None
    nodes = point.tracks.splines[0].nodes
    G, h = _of_the_track(point)
    unit = Roughness(1.0, point.roughness.length).root(nodes)
    values, vectors = np.linalg.eigh(unit.T @ G @ unit)
    turned = vectors.T @ unit.T
    values, along, s2 = np.maximum(values, 0.0), turned @ h, AMPLITUDES[:, None] ** 2
    even = 0.5 * np.sum(s2 * along**2 / (1 + s2 * values) - np.log1p(s2 * values), axis=1)
    best, found, most = 0.0, None, float(np.diag(G).max())
    for place in np.arange(nodes[0], nodes[-1], APART):
        for width in WIDTHS:
            shape = np.exp(-0.5 * ((nodes - place) / width) ** 2)
            seen = G @ shape
            whole, own = float(shape @ seen), turned @ seen
            score = float(shape @ h) - np.sum(s2 * own * along / (1 + s2 * values), axis=1)
            weight = whole - np.sum(s2 * own**2 / (1 + s2 * values), axis=1)
            seen_at = weight > 1e-9 * max(whole, most)  # nothing is known where nothing slid
            total = even + np.divide(0.5 * score**2, weight, out=np.zeros_like(weight), where=seen_at)
            k = int(np.argmax(total))
            gain = 2 * float(total[k] - even.max())
            if gain > best:
                p_value = min(len(WIDTHS) * nodes.size * float(chi2.sf(gain, 1)), 1.0)
                best, found = gain, Bump(float(place), width, float(score[k] / weight[k]), p_value)
    return found


def _of_the_track(point: Point) -> tuple[Array, Array]:
    """Return the information G (k, k) on a track's numbers and G times their estimate, the free parameters projected out."""
    n = point.theta.size
    scale = np.sqrt(np.maximum(np.diag(point.N)[:n], 1e-300))
    cross = point.N[:n, n:] / scale[:, None]
    inverse = np.linalg.pinv(point.N[:n, :n] / np.outer(scale, scale), rcond=1e-12)
    G = point.N[n:, n:] - cross.T @ inverse @ cross
    return G, point.g[n:] - cross.T @ inverse @ (point.g[:n] / scale) + G @ point.tracks.numbers
