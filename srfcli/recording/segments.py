"""Straight pieces in a noisy record, as many as the record supports and no more (Bayesian information criterion)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from srfcli.recording.values import Array

FEWEST = 5  # samples of a piece
ROUNDS = 40  # of the search for the places of the corners
STRETCH = 128  # samples over which noise has its colour
BURST = 100  # samples for which a gauge may go astray
AROUND = 15  # stretches that share their colour
NEAR = 200  # samples on each side by which a jump is told from a corner
EVEN = 1e-5  # of the largest noise: what is quieter would be lost in the rounding of the running sums
LEAST = 1e-100  # um or um/s: what is squared must not vanish
WOBBLE = 0.02  # relative change of slope that is none


@dataclass(frozen=True)
class Line:
    """A continuous line: `heights` at the rising `knots` (k,), its rms misfit, and the (sample before, size) of level jumps."""

    knots: Array
    heights: Array
    misfit: float
    jumps: tuple[tuple[int, float], ...]


def local_noise(x: Array, width: int = 101) -> Array:
    """Return the standard deviation of white noise near each sample of x (n,), from its third differences."""
    from scipy.ndimage import median_filter

    if x.size < 8:
        return np.full(x.size, max(float(np.std(x)), LEAST) if np.ptp(x) else 1.0)
    third = np.abs(np.diff(x, 3)) / np.sqrt(20.0)  # the sum of the squared weights 1, 3, 3, 1
    level = median_filter(third, size=min(width, third.size), mode="reflect") / 0.6745  # the end is not its last sample
    padded = np.concatenate([[level[0]], level, [level[-1]] * 2])
    overall = float(np.median(third)) / 0.6745
    span = float(np.ptp(x)) or 1.0
    return np.maximum(padded, max(0.05 * overall, 1e-9 * span, LEAST))


def split(t: Array, x: Array, sigma: Array, *, straight: bool, penalty: float) -> list[int]:
    """Return the indices at which pieces of x begin, other than the first: lines where `straight`, else constants.

    A piece is split where that lowers the weighted sum of squares by more than `penalty`.
    """
    sums = _Sums(t - t[0], x - x[0], sigma, straight)
    found: list[int] = []
    waiting = [(0, t.size)]
    while waiting:
        a, b = waiting.pop()
        place, gain = sums.best(a, b)
        if place and gain > penalty:
            found.append(place)
            waiting += [(a, place), (place, b)]
    return sorted(found)


class _Sums:
    """Running weighted sums, from which the misfit of any piece follows at once."""

    def __init__(self, t: Array, x: Array, sigma: Array, straight: bool) -> None:
        w = 1.0 / np.maximum(sigma, EVEN * float(sigma.max())) ** 2
        self.straight = straight
        columns = [w, w * t, w * t * t, w * x, w * t * x, w * x * x]
        self.sums = [np.concatenate([[0.0], np.cumsum(c)]) for c in columns]

    def misfit(self, a: NDArray[np.int64] | int, b: NDArray[np.int64] | int) -> Array:
        """Return the weighted sum of squares about the best line or constant through samples a to b - 1."""
        w, wt, wtt, wx, wtx, wxx = (s[b] - s[a] for s in self.sums)
        total = wxx - wx * wx / w
        if self.straight:
            spread = wtt - wt * wt / w
            cross = wtx - wt * wx / w
            total = total - np.divide(cross * cross, spread, out=np.zeros_like(total), where=spread > 0)
        return np.asarray(np.maximum(total, 0.0))

    def best(self, a: int, b: int) -> tuple[int, float]:
        """Return where samples a to b - 1 are best split, and by how much that lowers the misfit; 0 for nowhere."""
        if b - a < 2 * FEWEST:
            return 0, 0.0
        places = np.arange(a + FEWEST, b - FEWEST + 1)
        left = self.misfit(np.full(places.size, a), places)
        right = self.misfit(places, np.full(places.size, b))
        gain = self.misfit(np.array([a]), np.array([b]))[0] - left - right
        at = int(np.argmax(gain))
        return int(places[at]), float(gain[at])


def coloured_noise(t: Array, x: Array) -> Array:
    """Return the standard deviation near each sample of the white noise that misfits a line by as much as the noise in x (n,).

    The noise is what parabolas over 128 samples leave, in the upper quartile of fifteen stretches: bursts of a gauge count, and
    corners are in few of them.
    """
    from scipy.ndimage import percentile_filter

    sigma = local_noise(x)
    length = min(STRETCH, x.size)
    starts = np.arange(0, x.size - length + 1, length)
    found = np.empty(starts.size)
    for k, at in enumerate(starts.tolist()):
        part = slice(at, at + length)
        place = (t[part] - t[part].mean()) / max(float(np.ptp(t[part])), 1e-300)
        basis = np.linalg.qr(np.vander(place, 3))[0]
        rest = x[part] - x[part].mean()
        z = (rest - basis @ (basis.T @ rest)) / sigma[part]
        power = float(z @ z)
        rho = min(max(float(z[1:] @ z[:-1]) / power, 0.0), 0.98) if power > 0 else 0.0
        found[k] = power / max(length - 3, 1) * (1 + rho) / (1 - rho)
    if found.size >= AROUND:
        near = percentile_filter(found, 75, size=AROUND, mode="reflect")
    else:
        near = np.full(found.size, np.median(found))
    stretch = np.minimum(np.arange(x.size) // length, near.size - 1)
    return np.asarray(sigma * np.sqrt(np.maximum(near[stretch], 1.0)))


def corners(t: Array, x: Array) -> Line:
    """Return the continuous line of straight pieces that x (n,) over t supports, once the level jumps are taken out of x.

    The number of pieces follows from BIC, in which the noise counts with the colour that it has over 128 samples; their places
    follow from least squares. A change of slope by less than 2 % is the wobble of a servo, and is not followed.
    """
    sigma = coloured_noise(t, x)
    penalty, jumps = 3 * np.log(t.size), []
    for _ in range(4):
        breaks = split(t, x, sigma, straight=True, penalty=penalty)
        found = _jumps(t, x, sigma, breaks, penalty)
        for at, size in found:
            x[at + 1 :] -= size
        jumps += found
        if not found:
            break
    knots = np.concatenate([t[:1], _places(t, x, breaks), t[-1:]])
    for _ in range(3):
        knots = _pruned(t, x, sigma, knots, penalty)
        knots, heights = _polished(t, x, sigma, knots)
        calm = _without_bursts(t, sigma, knots, heights)
        if calm.size == knots.size:
            break
        knots, heights = _polished(t, x, sigma, calm)
    knots = _pruned(t, x, sigma, knots, penalty)
    knots, heights = _polished(t, x, sigma, knots)
    misfit = float(np.sqrt(np.mean((x - np.interp(t, knots, heights)) ** 2)))
    return Line(knots, heights, misfit, tuple(sorted(jumps)))


def _without_bursts(t: Array, sigma: Array, knots: Array, heights: Array) -> Array:
    """Return the knots without those of pieces, a hundred samples or fewer in all, after which the line goes on as before.

    A hold is none of them: after it the line is late.
    """
    slopes = np.diff(heights) / np.diff(knots)
    places = np.searchsorted(t, knots)
    keep = np.ones(knots.size, bool)
    for i in range(1, knots.size - 2):
        for j in range(i + 1, min(i + 6, knots.size - 1)):
            before, after = slopes[i - 1], slopes[j]
            if places[j] - places[i] > BURST or abs(after - before) > 0.1 * max(abs(before), abs(after)):
                continue
            late = heights[j] - heights[i] - 0.5 * (before + after) * (knots[j] - knots[i])
            if abs(late) < 6 * sigma[min(places[i], sigma.size - 1)]:
                keep[i : j + 1] = False
    return knots[keep]


def _jumps(t: Array, x: Array, sigma: Array, breaks: list[int], penalty: float) -> list[tuple[int, float]]:
    """Return (sample before, size) of the breaks where two lines fit so much better than a bent one that the level jumps.

    Breaks a few samples apart are one jump, with samples on its way.
    """
    groups: list[list[int]] = []
    for at in breaks:
        if groups and at - groups[-1][-1] < 2 * FEWEST:
            groups[-1].append(at)
        else:
            groups.append([at])
    found = []
    for k, group in enumerate(groups):
        first, last = group[0], group[-1]
        a = max(groups[k - 1][-1] if k else 0, first - NEAR)
        b = min(groups[k + 1][0] if k + 1 < len(groups) else t.size, last + NEAR)
        if min(first - a, b - last) < 2 * FEWEST:
            continue
        at = first - 1 + int(np.argmax(np.abs(np.diff(x[first - 1 : last + 1]))))
        middle = 0.5 * (t[at] + t[at + 1])
        near = np.r_[a:first, last:b]
        lines = [np.polyfit(t[i:j] - middle, x[i:j], 1, w=1 / sigma[i:j]) for i, j in ((a, first), (last, b))]
        fits = np.concatenate([np.polyval(lines[0], t[a:first] - middle), np.polyval(lines[1], t[last:b] - middle)])
        apart = float((((x[near] - fits) / sigma[near]) ** 2).sum())
        bent = _polished(t[near], x[near], sigma[near], np.array([t[a], middle, t[b - 1]]))
        together = float((((x[near] - np.interp(t[near], *bent)) / sigma[near]) ** 2).sum())
        alike = abs(lines[1][0] - lines[0][0]) < 0.2 * max(abs(lines[0][0]), abs(lines[1][0]))
        if together - apart > penalty and alike:  # the motion goes on as before
            found.append((at, float(lines[1][1] - lines[0][1])))
    return found


def _places(t: Array, x: Array, breaks: list[int]) -> Array:
    """Return where neighbouring lines meet, or the break itself where they meet elsewhere."""
    edges = [0, *breaks, t.size]
    lines = [np.polyfit(t[a:b] - t[a], x[a:b], 1) for a, b in pairwise(edges)]
    found: list[float] = []
    for k, at in enumerate(breaks):
        (s0, c0), (s1, c1) = lines[k], lines[k + 1]
        level = c0 + s0 * (t[edges[k + 1]] - t[edges[k]])
        meet = t[at] + ((level - c1) / (s1 - s0) if s1 != s0 else 0.0)
        low, high = (found[-1] if found else t[0]), t[edges[k + 2] - 1]
        found.append(float(meet if low < meet < high else t[at]))
    return np.unique(found)


def _pruned(t: Array, x: Array, sigma: Array, knots: Array, penalty: float) -> Array:
    """Return the knots that the line needs: what a split into independent pieces found may be none."""
    costs = [_cost_without(t, x, sigma, knots, k) for k in range(1, knots.size - 1)]
    while costs:
        weakest = int(np.argmin(costs))
        if costs[weakest] > penalty * 2 / 3:
            break
        knots = np.delete(knots, weakest + 1)
        del costs[weakest]
        for k in range(max(weakest - 2, 0), min(weakest + 2, len(costs))):
            costs[k] = _cost_without(t, x, sigma, knots, k + 1)
    return knots


def _cost_without(t: Array, x: Array, sigma: Array, knots: Array, k: int) -> float:
    """Return by how much the misfit rises without knot k, judged by the samples of the two pieces on each side of it.

    It is 0 where the slope hardly changes at the knot, or a piece beside it holds fewer than five samples.
    """
    low, high = max(k - 2, 0), min(k + 2, knots.size - 1)
    a, b = np.searchsorted(t, [knots[low], knots[high]])
    near = slice(int(a), max(int(b) + 1, int(a) + 2))
    kept = knots[low : high + 1]
    inside = np.diff(np.searchsorted(t, knots[k - 1 : k + 2]))
    if inside.min() < FEWEST:
        return 0.0
    slopes = np.diff(_heights(t[near], x[near], sigma[near], kept)) / np.diff(kept)
    before, after = slopes[k - low - 1], slopes[k - low]
    if abs(after - before) < WOBBLE * max(abs(before), abs(after)):
        return 0.0
    return _misfit(t[near], x[near], sigma[near], np.delete(kept, k - low)) - _misfit(
        t[near], x[near], sigma[near], kept
    )


def _misfit(t: Array, x: Array, sigma: Array, knots: Array) -> float:
    heights = _heights(t, x, sigma, knots)
    return float((((x - np.interp(t, knots, heights)) / sigma) ** 2).sum())


def _heights(t: Array, x: Array, sigma: Array, knots: Array) -> Array:
    """Return the least-squares heights of a continuous line over these knots: a tridiagonal system."""
    j = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, knots.size - 2)
    share = (t - knots[j]) / np.diff(knots)[j]
    weight = 1 / sigma**2

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(j, weights=values * weight, minlength=knots.size - 1), dtype=float)

    band = np.zeros((2, knots.size))
    band[1, :-1] += total((1 - share) ** 2)
    band[1, 1:] += total(share**2)
    band[0, 1:] = total(share * (1 - share))
    band[1] += 1e-9 * max(float(band[1].max()), 1e-300)  # a piece may lie between two samples
    level = float(x.mean())
    right = np.zeros(knots.size)
    right[:-1] += total((1 - share) * (x - level))
    right[1:] += total(share * (x - level))
    return np.asarray(level + solveh_banded(band, right))


def _polished(t: Array, x: Array, sigma: Array, knots: Array) -> tuple[Array, Array]:
    """Return the knots moved to their least-squares places, and the heights there: damped Gauss-Newton on both."""
    heights = _heights(t, x, sigma, knots)
    misfit, damping = _misfit(t, x, sigma, knots), 1e-3
    for _ in range(ROUNDS if knots.size > 2 else 0):
        move = _step(t, x, sigma, knots, heights, damping)
        gaps = np.diff(knots)
        room = 0.4 * np.minimum(gaps[:-1], gaps[1:])
        trial = knots.copy()
        trial[1:-1] += np.clip(move[1:-1], -room, room)
        found = _misfit(t, x, sigma, trial)
        if found < misfit:
            done = misfit - found < 1e-7 * misfit
            knots, heights, misfit, damping = trial, _heights(t, x, sigma, trial), found, damping / 4
            if done:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 8
    return knots, heights


def _step(t: Array, x: Array, sigma: Array, knots: Array, heights: Array, damping: float) -> Array:
    """Return by how much the knots are to be moved: normal equations in (place, height) of each knot, four diagonals wide."""
    j = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, knots.size - 2)
    gaps = np.diff(knots)
    slope = (np.diff(heights) / gaps)[j]
    share = (t - knots[j]) / gaps[j]
    rest = (x - np.interp(t, knots, heights)) / sigma
    columns = [-slope * (1 - share) / sigma, (1 - share) / sigma, -slope * share / sigma, share / sigma]
    n = 2 * knots.size
    band, right = np.zeros((4, n)), np.zeros(n)
    for p in range(4):
        right[p : p + n - 2 : 2] += np.bincount(j, weights=columns[p] * rest, minlength=knots.size - 1)
        for q in range(p, 4):
            both = np.bincount(j, weights=columns[p] * columns[q], minlength=knots.size - 1)
            band[3 - (q - p), q : q + n - 2 : 2] += both
    scale = np.sqrt(np.maximum(band[3], 1e-300))  # places and heights differ in size by orders
    for d in range(4):
        band[3 - d, d:] /= scale[d:] * scale[: n - d]
    right /= scale
    band[3] = 1 + damping + 1e-12
    for fixed in (0, n - 2):  # the ends stay
        right[fixed] = 0.0
        band[3, fixed] = 1e12
    return np.asarray((solveh_banded(band, right) / scale)[::2])
