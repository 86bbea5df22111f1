"""Flaws of a channel: spikes, level jumps of a transducer, saturation, and the step of its quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srfcli.recording.series import Mask, runs_of
from srfcli.recording.values import Array

WIDEST = 3  # samples of a spike
BESIDE = 5  # samples before and after that tell the level
FACTOR = 8.0  # robust standard deviations
FEW = 0.02  # share of samples that move: below it they are the accidents of a constant, and not its noise
SATURATED = 10  # samples in a row at the extreme value
LARGE = 0.05  # share of the level from which a jump is a transducer's for certain
MOST_RESETS = 5  # more jumps than this are what the recording is about


@dataclass(frozen=True)
class Jump:
    """A level jump of a transducer: `size` is added between samples `at` and `at` + 1; `certain` if nothing else can be."""

    at: int
    size: float
    certain: bool = True


def quantisation(x: Array) -> float:
    """Return the step of the lattice that the values x (n,) lie on, 0 where they lie on none that n samples could show."""
    values = np.unique(x)
    if values.size < 2 or values.size > 0.95 * x.size:
        return 0.0
    steps = np.diff(values)
    rounding = 4e-7 * max(abs(values[0]), abs(values[-1]))  # of numbers that once had 24 bits
    steps = steps[steps > rounding]
    if not steps.size:
        return 0.0
    smallest = float(steps.min())
    near = steps[steps < 1.5 * smallest]
    quantum = float(near.mean())
    for _ in range(3):  # the wider steps are multiples, which tell the step more exactly
        wide = steps[steps < 200 * quantum]
        counts = np.round(wide / quantum)
        quantum = float(wide.sum() / counts.sum())
    off = np.abs(steps - np.round(steps / quantum) * quantum)
    return quantum if (off <= 0.05 * quantum + 2 * rounding).all() else 0.0


def local_scale(x: Array, m: Array, width: int = 101) -> Array:
    """Return a robust standard deviation of x about its running median m near each sample."""
    from scipy.ndimage import median_filter

    rest = np.abs(x - m)
    near = median_filter(rest, size=min(width, x.size), mode="nearest")
    moving = rest[rest > 0]
    overall = float(np.median(moving)) if moving.size > FEW * x.size else 0.0
    return np.asarray(2.0 * np.maximum(near, 0.5 * overall))  # the running median follows the noise by a quarter


def spikes(x: Array, quantum: float = 0.0, rise: Array | None = None, *, least: float = 0.0) -> Mask:
    """Return which samples of x (n,) stand out from both sides for up to three samples and then are back where they were.

    A slip event or any other step is none: the level after it is another. `rise` (n,), if given, is the largest rise from
    each sample to the next that the drive allows: what goes up at that pace is reloading, and no spike. None is smaller
    than `least`.
    """
    from scipy.ndimage import median_filter

    found = np.zeros(x.size, bool)
    if x.size < 4 * BESIDE:
        return found
    m = median_filter(x, size=BESIDE, mode="nearest")
    scale = local_scale(x, m)
    for width in range(1, WIDEST + 1):
        first = np.arange(BESIDE, x.size - BESIDE - width + 1)
        before, after = m[first - 3], m[first + width + 2]
        group = np.stack([x[first + k] for k in range(width)])
        above = group.min(axis=0) - np.maximum(before, after)
        below = np.minimum(before, after) - group.max(axis=0)
        size = np.maximum(above, below)
        threshold = np.maximum(FACTOR * np.maximum(scale[first - 3], scale[first + width + 2]) + 2 * quantum, least)
        if rise is not None:  # from the median before, three samples back, to the median after
            threshold = np.maximum(threshold, 3 * (width + 5) * rise[first])
        hit = (size > threshold) & (np.abs(after - before) < 0.5 * size)
        for k in range(width):
            found[first[hit] + k] = True
    return found


def saturation(x: Array, *, fewest: int = 1) -> Mask:
    """Return which samples sit at the channel's largest or smallest value because the channel was clipped there.

    A clipped signal enters and leaves the extreme with a slope that would have taken it further, and stays for ten samples or
    more, longer than it stays at any other value; at `fewest` places or more.
    """
    found = np.zeros(x.size, bool)
    if x.size < 4 * SATURATED or np.ptp(x) == 0:
        return found
    stays = [(a - 1, b) for a, b in runs_of(np.concatenate([[False], x[1:] == x[:-1]]))]
    low, high = x.min(), x.max()
    other = max((b - a + 1 for a, b in stays if low < x[a] < high), default=1)
    for sign, extreme in ((-1.0, low), (1.0, high)):
        cut = [(a, b) for a, b in stays if x[a] == extreme and b - a + 1 >= SATURATED // 2 and _cut_off(sign * x, a, b)]
        if len(cut) >= fewest and max(b - a + 1 for a, b in cut) >= max(SATURATED, 4 * other):
            for a, b in cut:
                found[a : b + 1] = True
    return found


def _cut_off(x: Array, a: int, b: int) -> bool:
    """Return whether samples a to b, at the maximum of x, are entered and left with a slope that points beyond."""
    ends = []
    if a >= 3:
        ends.append((x[a - 1] - x[a - 3]) / 2 > 0.6 * (x[a] - x[a - 1]))
        ends.append(x[a] - x[a - 3] > 1e-3 * np.ptp(x))
    if b + 3 < x.size:
        ends.append((x[b + 1] - x[b + 3]) / 2 > 0.6 * (x[b] - x[b + 1]))
        ends.append(x[b] - x[b + 3] > 1e-3 * np.ptp(x))
    return bool(ends) and all(ends)


def observable_jumps(x: Array, t: Array, rate: Array, steady: Mask, quantum: float = 0.0) -> list[Jump]:
    """Return the level jumps of an observable that no slider can make, at most five.

    `rate` (n,) is the fastest rise that the drive allows, per second; `steady` (n,) says where the load does not change. A
    jump up is one that outruns the drive; a jump down is one after which the level goes on as flat as before, where a slip
    would be followed by reloading.
    """
    jumps = _level_jumps(x, quantum)
    found = []
    for jump in jumps:
        i = jump.at
        if not steady[max(i - 2, 0) : i + 4].all():
            continue
        allowed = float(rate[max(i - 20, 0) : i + 22].max() * (t[i + 1] - t[i]))
        certain = abs(jump.size) > max(20 * allowed, LARGE * float(np.median(np.abs(x))))
        if jump.size > 3 * allowed or (jump.size < 0 and _goes_on(x, t, i, float(rate[i]), abs(jump.size))):
            found.append(Jump(i, jump.size, certain))
    return found if len(jumps) <= MOST_RESETS else []


def _level_jumps(x: Array, quantum: float) -> list[Jump]:
    """Return the steps between two samples that exceed the noise, and all that happens nearby, by far."""
    from scipy.ndimage import median_filter

    if x.size < 8 * BESIDE:
        return []
    d = np.diff(x)
    m = median_filter(d, size=21, mode="nearest")
    rest = np.abs(d - m)
    scale = np.maximum(median_filter(rest, size=min(201, d.size), mode="nearest") / 0.6745, 0.3 * _typical(rest))
    before, after = _levels(x)
    size = after - before
    candidates = np.flatnonzero(
        (rest > 20 * scale + 4 * quantum) & (np.abs(size) > 0.7 * np.abs(d)) & (np.sign(size) == np.sign(d))
    )
    candidates = candidates[(candidates >= BESIDE) & (candidates < x.size - BESIDE - 1)]
    neighbours = np.stack([np.abs(np.roll(d, k)) for k in (-2, -1, 1, 2)]).max(axis=0)
    return [Jump(int(i), float(d[i] - m[i])) for i in candidates if neighbours[i] < 0.2 * abs(d[i])]


def _typical(rest: Array) -> float:
    moving = rest[rest > 0]
    return float(np.median(moving)) / 0.6745 if moving.size else 0.0


def _levels(x: Array) -> tuple[Array, Array]:
    """Return the medians of the five samples up to each one but the last, and of the five after it."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(x, BESIDE, mode="edge"), BESIDE)
    medians = np.median(windows, axis=1)
    return medians[1 : x.size], medians[BESIDE + 1 : x.size + BESIDE]


def _goes_on(x: Array, t: Array, i: int, rate: float, size: float) -> bool:
    """Return whether the level is as flat after the step as before it, for the twenty samples on each side."""
    left, right = slice(max(i - 19, 0), i + 1), slice(i + 1, i + 21)
    if min(x[left].size, x[right].size) < 10:
        return False
    slopes = [float(np.polyfit(t[s] - t[i], x[s], 1)[0]) for s in (left, right)]
    spread = float(t[right][-1] - t[i])
    return all(abs(s) < 0.3 * rate for s in slopes) and abs(slopes[1] - slopes[0]) * spread < 0.2 * size


def rejoined(x: Array, jumps: list[Jump]) -> tuple[Array, NDArray[np.bool_]]:
    """Return x with its certain jumps taken out, and the samples on each side of one, whose level is uncertain."""
    out, beside = x.copy(), np.zeros(x.size, bool)
    for jump in jumps:
        out[jump.at + 1 :] -= jump.size if jump.certain else 0.0
        beside[max(jump.at, 0) : jump.at + 2] = True
    return out, beside
