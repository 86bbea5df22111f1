"""Flaws of a channel and its white noise: found in a recording, or made for a simulated one."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import Array
from srfcli.codegen.splines import Spline
from srfcli.core.errors import SrfError
from srfcli.data.clock import Mask
from srfcli.motion.imposed import interpolation_error, lagrange, runs_of

SEGMENT = 256  # samples of a periodogram
INTERPOLATED_FROM = 16  # from which a sample is interpolated: to 1e-4 for sines of five samples a period or more
JITTER = 1e-3  # sampling intervals by which times may be off and still count as even


def white_level(x: Array, t: Array | None = None) -> float:
    """Return the standard deviation of the white noise in x (n,): the floor of its spectrum above half the Nyquist frequency.

    The floor is the median over frequencies and stretches, so that lines, events and a slow signal do not raise it. Coloured
    noise counts as signal. Where the times t (n,) are given and uneven, at which a signal looks like noise, it is the median
    error of interpolation from neighbouring samples.
    """
    if t is not None and x.size > 4 * INTERPOLATED_FROM and np.median(np.abs(np.diff(t, 2))) > JITTER * np.median(np.diff(t)):
        missed, unit = interpolation_error(t, x, INTERPOLATED_FROM // 2)
        return float(np.median(missed / unit) / 0.6745)
    length = min(SEGMENT, 2 ** int(np.log2(max(x.size, 1))))
    if length < 16:
        return calm_level(x)
    starts = np.unique(np.linspace(0, x.size - length, min(2 * x.size // length, 400)).astype(int))
    pieces = np.stack([x[a : a + length] for a in starts.tolist()])
    place = np.linspace(-1.0, 1.0, length)
    pieces = pieces - pieces.mean(axis=1, keepdims=True)
    pieces = pieces - (pieces @ place / (place @ place))[:, None] * place
    angle = 2 * np.pi * (np.arange(length) + 0.5) / length
    window = 0.35875 - 0.48829 * np.cos(angle) + 0.14128 * np.cos(2 * angle) - 0.01168 * np.cos(3 * angle)
    power = np.abs(np.fft.rfft(pieces * window, axis=1)) ** 2 / (window @ window)
    upper = power[:, length // 4 : length // 2]
    return float(np.sqrt(np.median(np.median(upper, axis=1)) / np.log(2)))


def calm_level(x: Array) -> float:
    """Return the standard deviation of white noise that the median of third differences of x (n,) shows.

    Corners and jumps count as so many samples each, however large they are; coloured noise counts in part.
    """
    third = np.diff(x, 3) if x.size > 3 else np.zeros(1)
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0))


# Flaws of a channel: spikes, level jumps of a transducer, saturation, and the step of its quantisation.

WIDEST_SPIKE = 3  # samples of a spike
SIDE = 5  # samples before and after that tell the level
SPIKE_FACTOR = 8.0  # robust standard deviations
SUDDEN = 4.0  # times as far off as noise is: from there on one step that outruns the drive makes a spike
CREST = 0.5  # share of a spike's size by which it is off a cubic through its neighbours, at least
END_SPIKE = 4.0  # steps by which a spike among the first or last samples is off its neighbours: of those there, the third largest
NOISE_SAMPLES = 101  # samples that share a level of noise
FEW = 0.02  # share of samples off their running median, below which the channel counts as constant and without noise
SATURATED = 10  # samples in a row at the extreme value
CERTAIN_JUMP = 0.05  # share of the level from which a jump is certain
MOST_RESETS = 5  # of a transducer in a recording; if there are more jumps, they are a signal


@dataclass(frozen=True)
class Jump:
    """A level jump: `size` is added between samples `at` and `at` + 1; `certain` where only a transducer can make it."""

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


def local_scale(x: Array, m: Array) -> Array:
    """Return a robust standard deviation of x about its running median m near each sample."""
    from scipy.ndimage import median_filter

    rest = np.abs(x - m)
    near = median_filter(rest, size=min(NOISE_SAMPLES, x.size), mode="nearest")
    moving = rest[rest > 0]
    overall = float(np.median(moving)) if moving.size > FEW * x.size else 0.0
    return np.asarray(2.0 * np.maximum(near, 0.5 * overall))  # the running median follows the noise by a quarter


def deviations(x: Array) -> Array:
    """Return how far each sample of x (n,) is off its running median, in robust standard deviations near it."""
    from scipy.ndimage import median_filter

    level = median_filter(x, size=SIDE, mode="nearest")
    return np.abs(x - level) / np.maximum(local_scale(x, level), np.spacing(np.abs(x).max()))


def spikes(x: Array, quantum: float = 0.0, rise: Array | None = None, *, least: float = 0.0) -> Mask:
    """Return which samples of x (n,) are spikes: up to three that stand out from both sides, with the same level after them.

    That is the level of a few samples, or of the next one beside a slip event. A slip or any other step is no spike, as both are
    others. `rise` (n,), if given, is the largest rise from each sample to the next that drive and load allow: a rise at
    that pace is reloading, and no spike. No spike is smaller than `least`.
    """
    from scipy.ndimage import median_filter

    if x.size < 4 * SIDE:
        return np.zeros(x.size, bool)
    scale = np.pad(local_scale(x, median_filter(x, size=SIDE, mode="nearest")), SIDE, mode="edge")
    rise = None if rise is None else np.pad(rise, SIDE, mode="edge")
    x = np.concatenate([_before(x[: 2 * SIDE]), x, _before(x[: -2 * SIDE - 1 : -1])[::-1]])
    found, m = np.zeros(x.size, bool), median_filter(x, size=SIDE, mode="nearest")
    steps = [np.sort(np.abs(np.diff(part)))[-3] for part in (x[SIDE : 3 * SIDE], x[-3 * SIDE : -SIDE])]
    ends = [END_SPIKE * step for step in steps]  # the end of a wave or of a decay is no spike
    for width in range(1, WIDEST_SPIKE + 1):
        first = np.arange(SIDE, x.size - SIDE - width + 1)
        before, after = m[first - 3], m[first + width + 2]
        group = np.stack([x[first + k] for k in range(width)])
        above = group.min(axis=0) - np.maximum(before, after)
        below = np.minimum(before, after) - group.max(axis=0)
        size = np.maximum(above, below)
        threshold = np.maximum(SPIKE_FACTOR * np.maximum(scale[first - 3], scale[first + width + 2]) + 2 * quantum, least)
        if rise is not None:  # from the median before, three samples back, to the median after, or far and in one sample
            step = np.where(above > below, group.min(axis=0) - x[first - 1], x[first + width] - group.max(axis=0))
            pace = 3 * np.max([rise[first + k] for k in range(-1, width)], axis=0)
            sudden = (step > pace) & (size > SUDDEN * threshold)
            size = np.where(sudden | (size > (width + 5) * pace), size, 0.0)
        off, apart = _off_neighbours(x, first, width), np.abs(after - before)
        hit = (size > threshold) & (apart < 0.5 * size) & (off > CREST * size)
        if width == 1:  # beside a slip, which is at most three samples away, the next ones tell the level
            last, following = x[first - 1], x[first + width]
            near = np.maximum(group[0] - np.maximum(last, following), np.minimum(last, following) - group[0])
            alone = near > np.maximum(threshold, 4 * np.abs(following - last))
            hit |= (size > threshold) & (apart > threshold) & alone & (off > CREST * near)
        sign = np.where(above > below, 1.0, -1.0)
        beside = [sign * (x[first + k] - x[first + j]) for k, j in ((0, -1), (width - 1, width))]
        at_ends = [first < 2 * SIDE, first + width > x.size - 2 * SIDE]
        hit &= np.min(beside, axis=0) > np.select(at_ends, ends, -np.inf)
        hit &= (first > SIDE) & (first + width < x.size - SIDE)  # a level at the very end may be that before a slip
        for k in range(width):
            found[first[hit] + k] = True
    return found[SIDE:-SIDE]


def _before(x: Array) -> Array:
    """Return SIDE samples before the first ones x (n,), on the straight line that most of these follow."""
    at = np.arange(-SIDE, x.size)
    slope = np.median(np.diff(x))
    return np.asarray(np.median(x - slope * at[SIDE:]) + slope * at[:SIDE])


def _off_neighbours(x: Array, first: NDArray[np.intp], width: int) -> Array:
    """Return by how much groups of samples that begin at `first` are off the cubics through two samples on each side, at least.

    These cubics predict the crest of a wave of eight samples or more, but no spike.
    """
    at = np.array([-2.0, -1.0, width, width + 1.0])
    sides = np.stack([x[first - 2], x[first - 1], x[first + width], x[first + width + 1]])
    group = np.stack([x[first + k] for k in range(width)])
    return np.asarray(np.abs(group - lagrange(at, np.arange(width)) @ sides).min(axis=0))


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
        certain = abs(jump.size) > max(20 * allowed, CERTAIN_JUMP * float(np.median(np.abs(x))))
        before, after = (slice(max(i - 19, 0), i + 1), slice(i + 1, i + 21))  # twenty samples on each side
        slopes = [float(np.polyfit(t[s] - t[i], x[s], 1)[0]) for s in (before, after)]
        bend = abs(slopes[1] - slopes[0]) * float(t[after][-1] - t[i])  # of the level: none if no reloading begins
        outruns = jump.size > 3 * allowed and bend < 0.5 * jump.size
        flat = min(x[before].size, x[after].size) >= 10 and all(abs(s) < 0.3 * float(rate[i]) for s in slopes)
        if outruns or (jump.size < 0 and flat and bend < 0.2 * abs(jump.size)):
            found.append(Jump(i, jump.size, certain))
    return found if len(jumps) <= MOST_RESETS else []


def _level_jumps(x: Array, quantum: float) -> list[Jump]:
    """Return the steps between two samples that are far larger than the noise and than all changes nearby."""
    from scipy.ndimage import median_filter

    if x.size < 8 * SIDE:
        return []
    d = np.diff(x)
    m = median_filter(d, size=21, mode="nearest")
    rest = np.abs(d - m)
    moving = rest[rest > 0]
    typical = float(np.median(moving)) / 0.6745 if moving.size else 0.0
    scale = np.maximum(median_filter(rest, size=min(201, d.size), mode="nearest") / 0.6745, 0.3 * typical)
    medians = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(x, SIDE, mode="edge"), SIDE), axis=1)
    size = medians[SIDE + 1 : x.size + SIDE] - medians[1 : x.size]  # of the five samples after each one and up to it
    candidates = np.flatnonzero(
        (rest > 20 * scale + 4 * quantum) & (np.abs(size) > 0.7 * np.abs(d)) & (np.sign(size) == np.sign(d))
    )
    candidates = candidates[(candidates >= SIDE) & (candidates < x.size - SIDE - 1)]
    neighbours = np.stack([np.abs(np.roll(d, k)) for k in (-2, -1, 1, 2)]).max(axis=0)
    return [Jump(int(i), float(d[i] - m[i])) for i in candidates if neighbours[i] < 0.2 * abs(d[i])]


# The reading of a gauge in a simulation: noise of a given size and correlation, and rounding to steps.


def measured(
    values: Array, *, noise: float = 0.0, lag1: float = 0.0, quantum: float = 0.0, seed: int = 0, stream: str = ""
) -> Array:
    """Return `values` (n,) with stationary noise of standard deviation `noise` and lag-1 correlation `lag1`, then rounded to
    multiples of `quantum`; both in the unit of the values, 0 for none.

    The noise depends on `seed` and `stream` alone: a run's own name as stream keeps it the same whatever else is simulated.
    Raises SrfError for a negative size, |lag1| >= 1, a lag without noise or a negative seed.
    """
    check_gauge(noise=noise, lag1=lag1, quantum=quantum, seed=seed)
    out = np.array(values, dtype=float)
    if noise:
        out += noise * ar1(out.size, lag1, rng=generator(seed, stream))
    return quantised(out, quantum) if quantum else out


def check_gauge(*, noise: float, lag1: float, quantum: float, seed: int) -> None:
    """Raise SrfError for sizes, a correlation or a seed that a gauge cannot have."""
    for name, value in (("noise", noise), ("quantum", quantum)):
        if not (math.isfinite(value) and value >= 0):
            raise SrfError(f"{name} = {value:g} is not a size", f"give {name} as 0 or more")
    if not abs(lag1) < 1:
        raise SrfError(f"lag1 = {lag1:g} is not the correlation of a stationary noise", "give -1 < lag1 < 1, as 0.8")
    if lag1 and not noise:
        raise SrfError(f"lag1 = {lag1:g} colours a noise of size 0", "give noise its standard deviation, too")
    if seed < 0:
        raise SrfError(f"seed = {seed} is negative", "give a whole number from 0 on")


def generator(seed: int, stream: str) -> np.random.Generator:
    """Return the random numbers that belong to a seed and a name."""
    return np.random.default_rng([seed, zlib.crc32(stream.encode("utf-8"))])


def ar1(n: int, lag1: float, *, rng: np.random.Generator) -> Array:
    """Return `n` samples of unit variance, each correlated with its predecessor by `lag1`, from the stationary state on."""
    white = rng.standard_normal(n)
    if not lag1 or not n:
        return white
    white[1:] *= math.sqrt(1 - lag1 * lag1)  # the first sample has no predecessor and the same variance
    return carried(lag1, white)


def carried(carry: float, added: Array, before: float = 0.0) -> Array:
    """Return y (n,) with y[k] = carry y[k-1] + added[k], where y[-1] = before, for n > 0."""
    from scipy.linalg.lapack import dtbtrs  # lfilter does the same, and scipy.signal takes longer to import than all else here

    band = np.array([[1.0], [-carry]]) * np.ones(added.size)
    start = np.concatenate([[added[0] + carry * before], added[1:]])
    return np.asarray(dtbtrs(band, start[:, None], uplo="L")[0][:, 0])


def quantised(values: Array, quantum: float) -> Array:
    """Return the nearest multiples of `quantum`, with no more digits than it has: 18.665, not 18.665000000000003."""
    exponent = Decimal(repr(float(quantum))).normalize().as_tuple().exponent
    assert isinstance(exponent, int)  # a finite number has one
    return np.asarray(np.round(np.round(values / quantum) * quantum, max(-exponent, 0)), dtype=float)


# A random friction field along slip, to simulate with: mu0 varies with slip position by a Gaussian process that a seed fixes.

KNOTS = 8  # to a correlation length: halfway between two of them the variance falls short by 4e-4
WIDEST_KNOTS, FINEST_KNOTS = 0.8, 0.01  # um between knots: as wide as a fit's; contacts are 0.1 um or more
MOST_FIELD_KNOTS = 2_000_000  # knots between position 0 and the far end of a record
ECHO = 32  # knots over which a value acts on a spline's coefficients: sqrt(3) - 2 to this power is below the last bit


@dataclass(frozen=True)
class FrictionField:
    """mu0's deviation at slip position x (um): Gaussian, of standard deviation `amplitude` and correlation length `length` (um).

    Values at a distance d are correlated by (1 + r) exp(-r), r = sqrt(3) d/length (Matern, 3/2), as `srf fit --track rough` has
    it. `seed` fixes the function on the whole line: it does not depend on which part of it is asked for.
    """

    amplitude: float
    length: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.amplitude) and self.amplitude >= 0):
            raise SrfError(f"a field of {self.amplitude:g} is not a size", "give it as 0 or more, as 3e-4")
        shortest = KNOTS * FINEST_KNOTS
        if not (math.isfinite(self.length) and self.length >= shortest * (1 - 1e-12)):
            raise SrfError(
                f"a field length of {self.length:g} um is finer than knots {FINEST_KNOTS:g} um apart can show",
                f"give {shortest:g} um or more",
            )

    @property
    def spacing(self) -> float:
        """Return the distance between knots in um; one of them lies at position 0."""
        return min(self.length / KNOTS, WIDEST_KNOTS)

    def spline(self, low: float, high: float) -> Spline:
        """Return the function on [low, high] (um) as a cubic spline through its values at the knots.

        Raises SrfError where that takes more knots than there is room for.
        """
        h, most = self.spacing, MOST_FIELD_KNOTS - 2 * ECHO
        if not max(abs(low), abs(high)) < most * h:
            raise SrfError(
                f"a track to position {max(abs(low), abs(high)):g} um, in steps of {h:g} um, has more than {most} knots",
                "shorten the record, or give a longer field length",
            )
        first, last = math.floor(low / h), math.ceil(high / h)
        first -= first * h > low  # as the quotient is rounded, and the spline's end
        last = max(last, first + 1)
        last += first * h + h * (last - first) < high
        values = self._values(first - 1 - ECHO, last + 1 + ECHO)
        count = last - first + 3
        # the coefficients whose weighted means 1/6, 4/6, 1/6 are the values; summed so that no bit depends on the window
        pole, numbers = math.sqrt(3) - 2, np.zeros(count)
        for j in range(-ECHO, ECHO + 1):
            numbers += math.sqrt(3) * pole ** abs(j) * values[ECHO + j : ECHO + j + count]
        return Spline(first * h, h, self.amplitude * numbers)

    def _values(self, first: int, last: int) -> Array:
        """Return the function of unit size at the knots first, ..., last, where first <= last."""
        root, onwards, backwards = generator(self.seed, "rough track").spawn(3)
        value, slope = root.standard_normal(2)
        right = self._walk(value, value + slope, max(last, 0), onwards)
        left = self._walk(value, value - slope, max(-first, 0), backwards)
        line = np.concatenate([left[::-1], [value], right])
        return np.asarray(line[first + left.size : last + left.size + 1])

    def _walk(self, value: float, state: float, count: int, rng: np.random.Generator) -> Array:
        """Return the next `count` values beside `value`, exactly distributed; `state` is value + length/sqrt(3) slope.

        That sum is a Markov process by itself, of first order, and drives the value as another: two recursions.
        """
        from scipy.special import gammainc

        if not count:
            return np.zeros(0)
        a = math.sqrt(3) * self.spacing / self.length
        carry = math.exp(-a)
        # covariance of what a step adds to state and value; incomplete gamma functions, as 1 - exp(-2a)(1 + ...) cancels
        one, two, three = (float(gammainc(k, 2 * a)) for k in (1, 2, 3))
        spread = math.sqrt(2 * one)
        shared, own = two / spread, math.sqrt(three - two * two / (2 * one))
        draws = rng.standard_normal((count, 2))
        states = carried(carry, spread * draws[:, 0], state)
        pushed = carry * a * np.concatenate([[state], states[:-1]]) + shared * draws[:, 0] + own * draws[:, 1]
        return carried(carry, pushed, value)
