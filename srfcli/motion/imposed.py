"""What the experimenter imposes: the driving velocity V(t) and the normal load W(t), piece by smooth piece; um, s, N.

Evenly sampled stretches carry a spline of degree 7: at eight samples per period of a modulation it errs by 3e-7 of the
amplitude, where a cubic errs by 4e-4 and its derivative by a percent. At jumps and corners such a spline would ring; the few
intervals there, gaps and changes of the sampling rate are bridged by monotone cubics. A load with measurement noise is smoothed,
as dW/dt enters laws.
"""

from __future__ import annotations

import abc
import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import Array
from srfcli.core.errors import NoContact, SrfError

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

Number = TypeVar("Number", float, Array)

# The imposed normal load: constant, modulated, or any other; um, s, N.

RISE = 5.0  # periods over which a modulation rises where nothing else is said, as the format has it
PIECES_PER_PERIOD = 16  # polynomials per period of a modulation: degree 7 then errs by 4e-13 of its amplitude
DEGREE = 7


class Load(abc.ABC):
    """The imposed normal load and its rate, smooth between `breaks`."""

    breaks: tuple[float, ...] = ()

    def longest_step(self, start: float, end: float) -> float:
        """Return the longest step (s) that jumps over nothing between two breaks."""
        return math.inf

    def rest(self, t: float) -> float:
        """Return the load under which sliding at time `t` is steady when nothing is modulated: W itself where nothing is."""
        return float(self(np.array([t]))[0][0])

    def check(self, start: float, end: float) -> None:  # noqa: B027
        """Raise SrfError where the load is not known on all of [start, end]."""

    @abc.abstractmethod
    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        """Return W on [start, end] as polynomials, to 1e-11 of W: knots (k + 1,) and coefficients (k, degree + 1).

        On [knots[i], knots[i + 1]] W is the sum of coefficients[i, j] (t - knots[i])^j; every break inside is a knot.
        """

    @abc.abstractmethod
    def __call__(self, t: Array) -> tuple[Array, Array]:
        """Return W and dW/dt at the times `t`, as arrays."""


@dataclass(frozen=True)
class ConstantLoad(Load):
    """A load that does not change."""

    W0: float

    def __post_init__(self) -> None:
        _check_positive("W0", self.W0)

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        return np.array([start, end]), np.array([[self.W0]])

    def __call__(self, t: Array) -> tuple[Array, Array]:
        return np.full(np.size(t), self.W0), np.zeros(np.size(t))


class UnknownLoad(ConstantLoad):
    """The load of a run of which friction alone is known: a constant of 1 N, by which no result depends on it."""

    def __init__(self) -> None:
        super().__init__(1.0)


@dataclass(frozen=True)
class Modulation(Load):
    """W = W0 (1 + eps s(t) cos(2 pi f t + phase)), where s rises smoothly from 0 to 1 over `rise` seconds from `onset` on.

    Without `onset` the modulation has always been there. The switch-on has two continuous derivatives: a jump of the load
    would move the slider across an interface whose stiffness does not follow the load.
    """

    W0: float
    eps: float
    f: float
    onset: float = -math.inf
    rise: float | None = None  # RISE periods
    phase: float = 0.0

    def __post_init__(self) -> None:
        _check_positive("W0", self.W0)
        _check_positive("f", self.f)
        if not 0 <= self.eps < 1:
            raise SrfError(f"eps = {self.eps:g} lifts the slider off", "give 0 <= eps < 1")
        if self.rise is not None:
            _check_positive("rise", self.rise)

    @property
    def full(self) -> float:
        """Return the time from which the modulation has its full amplitude."""
        return self.onset + (RISE / self.f if self.rise is None else self.rise)

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        return (self.onset, self.full) if math.isfinite(self.onset) else ()

    def longest_step(self, start: float, end: float) -> float:
        return 0.25 / self.f if self.eps else math.inf  # a longer one could jump over whole periods of a quiet start

    def rest(self, t: float) -> float:
        return self.W0

    def __call__(self, t: Array) -> tuple[Array, Array]:
        t = np.asarray(t, dtype=float)
        share, rate = np.ones(t.shape), np.zeros(t.shape)
        if self.breaks:
            length = self.full - self.onset
            r = np.clip((t - self.onset) / length, 0.0, 1.0)
            share, rate = r * r * r * (10 - 15 * r + 6 * r * r), 30 * r * r * (1 - r) * (1 - r) / length
        amplitude, omega = self.eps * self.W0, 2 * math.pi * self.f
        wave, slope = amplitude * np.cos(omega * t + self.phase), -amplitude * omega * np.sin(omega * t + self.phase)
        return self.W0 + share * wave, share * slope + rate * wave

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        knots = [np.array([start])]
        for a, b in pairwise([start, *(t for t in self.breaks if start < t < end), end]):
            length = 1 / self.f if a >= self.full else min(1 / self.f, self.full - self.onset)
            count = math.ceil((b - a) * PIECES_PER_PERIOD / length) if self.eps and b > self.onset else 1
            knots.append(np.linspace(a, b, count + 1)[1:])
        edges = np.concatenate(knots)
        return edges, fit_polynomials(lambda t: self(t)[0], edges)


def fit_polynomials(function: Callable[[Array], Array], edges: Array) -> Array:
    """Return the polynomials of degree 7 through W at the Chebyshev-Lobatto points of each interval, (k, 8), lowest first.

    They meet at the edges, and are written in the time since the interval's start.
    """
    shares, to_powers = _interpolation()
    widths = np.diff(edges)
    times = edges[:-1, None] + widths[:, None] * shares
    times[:, -1] = edges[1:]
    values = function(times)
    offset = values[:, :1]
    powers = (values - offset) @ to_powers
    powers[:, 0] += offset[:, 0]
    return powers / widths[:, None] ** np.arange(DEGREE + 1)


@cache
def _interpolation() -> tuple[Array, Array]:
    """Return the points in [0, 1], rising, and the matrix that turns values there into coefficients of powers."""
    shares = 0.5 - 0.5 * np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)
    others = [np.delete(shares, j) for j in range(DEGREE + 1)]
    return shares, np.array([np.poly(x)[::-1] / np.prod(at - x) for at, x in zip(shares, others, strict=True)])


def _check_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise SrfError(f"{name} = {value:g} is not a positive number")


class PolynomialLoad(Load):
    """A load that consists of `coefficients` (k, degree + 1), lowest power first in the time since the knot, at `knots` (k + 1,).

    The first polynomial and the last hold beyond the knots.
    """

    knots: Array
    coefficients: Array

    def __call__(self, t: Array) -> tuple[Array, Array]:
        t = np.asarray(t, dtype=float)
        i = np.clip(np.searchsorted(self.knots, t, side="right") - 1, 0, len(self.coefficients) - 1)
        return horner([c[i] for c in self.coefficients.T], t - self.knots[i])

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        self.check(start, end)
        count = len(self.coefficients)
        first = int(np.clip(np.searchsorted(self.knots, start, side="right") - 1, 0, count - 1))
        last = int(np.clip(np.searchsorted(self.knots, end, side="left"), first + 1, count))
        knots, rows = self.knots[first : last + 1].copy(), self.coefficients[first:last].copy()
        rows[0] = _shifted(rows[0], start - knots[0])
        knots[0], knots[-1] = start, end
        return knots, rows


# A measured load as piecewise polynomials; um, s, N.

UNEVEN_INTERVAL = 1.6  # ratio of an interval to its neighbours' median at which a stretch ends
WANDER = 10.0  # times the median of the logarithms of these ratios, if that is more: of times that are all uneven
SHORTEST_STRETCH = 16  # samples of a stretch that carries the spline
INTERPOLATION_SAMPLES = 4  # samples on each side from which a sample is interpolated
ROUGH = 0.02  # share of the local range by which a sample may differ from what its neighbours predict
LEAST_CORNER = 1e-4  # share of the whole range below which nothing is a corner
MOSTLY = 0.3  # share of rough samples at which a load is coarsely sampled rather than cornered
SPACINGS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # samples between the knots of a smoothing spline
SMOOTHING_BLOCK = 32  # samples over which the smoothness may vary


class SampledLoad(PolynomialLoad):
    """The measured load `W` (N) at `times` (s, rising, four or more); `noise` (N) is its measurement error, 0 to interpolate."""

    def __init__(self, times: Array, W: Array, *, noise: float = 0.0) -> None:
        t, values = np.asarray(times, dtype=float), np.asarray(W, dtype=float)
        if t.ndim != 1 or t.shape != values.shape or t.size < 4:
            raise SrfError("a sampled load needs four times or more, and as many loads as times")
        if not (np.isfinite(t).all() and np.isfinite(values).all() and (np.diff(t) > 0).all()):
            raise SrfError("a sampled load needs finite loads at rising times", "drop gaps and repeated times first")
        if values.min() <= 0:
            raise NoContact(f"the load is {values.min():g} N at t = {t[values.argmin()]:g} s", "the slider must stay in contact")
        self.times, self.W, self.noise = t, values, float(noise)
        self.knots, self.coefficients, self.breaks = _build(t, values, self.noise)
        self._check_contact()
        self._longest: dict[tuple[float, float], float] = {}

    def _check_contact(self) -> None:
        """Raise SrfError where the load between two positive samples is not positive."""
        half = 0.5 * np.diff(self.knots)
        middles = (self.coefficients * half[:, None] ** np.arange(DEGREE + 1)).sum(axis=1)
        if middles.min() <= 0:
            at = self.knots[int(middles.argmin())]
            raise SrfError(f"the load between its samples falls below zero near t = {at:g} s", "sample it finer")

    def longest_step(self, start: float, end: float) -> float:
        if (start, end) not in self._longest:  # asked for at each evaluation of a likelihood
            first, last = np.searchsorted(self.knots, start, side="right") - 1, np.searchsorted(self.knots, end, side="left")
            inside = self.knots[first : last + 1]
            self._longest[start, end] = float(4 * np.median(np.diff(inside))) if inside.size > 1 else math.inf
        return self._longest[start, end]

    def check(self, start: float, end: float) -> None:
        if start < self.knots[0] or end > self.knots[-1]:
            raise SrfError(
                f"the load is known from {self.knots[0]:g} to {self.knots[-1]:g} s, not over all of {start:g} to {end:g} s",
                "simulate within the times of the load's samples",
            )


def _build(t: Array, W: Array, noise: float) -> tuple[Array, Array, tuple[float, ...]]:
    """Return knots, coefficients and the times where the kind of piece changes."""
    stretches = _stretches(t, W, noise)
    if not stretches:
        return (*_bridge(t, W, 0, t.size - 1, None, None), ())
    fits = [_spline(t[a : b + 1], W[a : b + 1], noise) for a, b in stretches]
    pieces, before, at = [], None, 0
    for (a, b), fit in zip(stretches, fits, strict=True):
        pieces += [_bridge(t, W, at, a, before, fit)] if at < a else []
        pieces.append(fit)
        before, at = fit, b
    pieces += [_bridge(t, W, at, t.size - 1, before, None)] if at < t.size - 1 else []
    knots, rows = np.concatenate([t[:1], *(k[1:] for k, _ in pieces)]), np.concatenate([r for _, r in pieces])
    edges = {float(t[i]) for pair in stretches for i in pair if 0 < i < t.size - 1}
    return knots, rows, tuple(sorted(edges))


def _stretches(t: Array, W: Array, noise: float) -> list[tuple[int, int]]:
    """Return first and last sample of the stretches that carry a spline: as evenly sampled as all is, without jump or corner."""
    steps = np.diff(t)
    usual = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(steps, 2, mode="edge"), 5), axis=1)
    longer, allowed = np.log(steps / usual), float(np.log(UNEVEN_INTERVAL))
    wander = WANDER * float(np.median(np.abs(longer)))
    if wander > allowed:  # of times that wander, a spline goes through what they are: a short interval is none to bridge
        even, change = longer < wander, np.abs(np.diff(np.log(usual))) > wander
    else:
        even, change = np.abs(longer) < allowed, np.abs(np.diff(np.log(steps))) > allowed  # between two rates
    found = []
    for a, b in runs_of(even):
        cuts = [a, *(a + 1 + np.flatnonzero(change[a:b])).tolist(), b + 1]
        found += [(c, d) for c, d in pairwise(cuts) if d - c >= SHORTEST_STRETCH - 1]
    total = float(np.ptp(W))
    smooth = []
    for a, b in found:
        rough = _rough(t[a : b + 1], W[a : b + 1], total, noise)
        if rough.mean() > MOSTLY:
            rough[:] = False
        calm = ~(rough[1:] | rough[:-1])  # intervals between two samples that their neighbours predict
        smooth += [(a + c, a + d + 1) for c, d in runs_of(calm) if d - c >= SHORTEST_STRETCH - 2]
    return smooth


def interpolation_error(t: Array, x: Array, reach: int) -> tuple[Array, Array]:
    """Return by how much the polynomial through `reach` samples on both sides misses each of x (n,) at times t, but for the ends.

    And what it is (n - 2 reach,) for white noise of standard deviation 1.
    """
    times, values = (np.lib.stride_tricks.sliding_window_view(a, 2 * reach + 1) for a in (t, x))
    near, beside = (np.delete(a, reach, axis=1) for a in (times, values))
    weights = lagrange(near, times[:, reach])
    return np.abs(values[:, reach] - np.sum(beside * weights, axis=1)), np.sqrt(1 + np.sum(weights**2, axis=1))


def lagrange(nodes: Array, at: Array) -> Array:
    """Return the Lagrange polynomials on `nodes` (..., k) at the places `at` (...), (..., k)."""
    weights = np.empty((*at.shape, nodes.shape[-1]))
    for j in range(nodes.shape[-1]):
        others = np.delete(nodes, j, axis=-1)
        weights[..., j] = np.prod((at[..., None] - others) / (nodes[..., j, None] - others), axis=-1)
    return weights


def _rough(t: Array, W: Array, total: float, noise: float) -> NDArray[np.bool_]:
    """Return which samples of a stretch the polynomial through their eight neighbours does not predict."""
    error, unit = interpolation_error(t, W, INTERPOLATION_SAMPLES)
    ranges = np.ptp(np.lib.stride_tricks.sliding_window_view(W, 2 * INTERPOLATION_SAMPLES + 1), axis=1)
    rough = np.zeros(W.size, bool)
    rough[INTERPOLATION_SAMPLES:-INTERPOLATION_SAMPLES] = error > np.maximum(
        ROUGH * ranges, np.maximum(LEAST_CORNER * total, 5 * noise * unit)
    )
    return rough


def runs_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and last index of every unbroken run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _spline(t: Array, W: Array, noise: float) -> tuple[Array, Array]:
    """Return knots and coefficients of the spline through, or with noise along, an even stretch."""
    from scipy.interpolate import PPoly, make_interp_spline

    unit = (t[-1] - t[0]) / (t.size - 1)
    x, level = (t - t[0]) / unit, float(W.mean())
    spline = _smoothing(x, W - level, noise) if noise else make_interp_spline(x, W - level, k=DEGREE)
    pieces = PPoly.from_spline(spline)
    inside = np.diff(pieces.x) > 0
    rows = pieces.c.T[inside][:, ::-1] / unit ** np.arange(DEGREE + 1)
    rows[:, 0] += level
    knots = t[0] + unit * np.append(pieces.x[:-1][inside], pieces.x[-1])
    knots[0], knots[-1] = t[0], t[-1]
    return knots, np.ascontiguousarray(rows)


def _smoothing(x: Array, y: Array, noise: float) -> BSpline:
    """Return the least-squares spline with as many knots as generalised cross-validation wants, more or fewer where need be."""
    n = x.size
    edges = np.arange(0, n, SMOOTHING_BLOCK)
    spacings = [m for m in SPACINGS if m <= max(n // 4, 2)]
    squares = [(y - _least_squares(x, y, x[4 * m : n - 4 * m : m])(x)) ** 2 for m in spacings]
    overall = int(np.argmin([q.sum() / (1 - 1 / m) ** 2 for q, m in zip(squares, spacings, strict=True)]))
    padded = [np.pad(np.add.reduceat(q, edges), 1) for q in squares]
    misfit = np.array([q[:-2] + q[1:-1] + q[2:] for q in padded]) / noise**2  # of a block and its neighbours
    chosen = _spacings(misfit, np.array(spacings, float), 3.0 * SMOOTHING_BLOCK, overall)
    places: list[int] = []
    index = 0
    while True:
        k, pieces = int(chosen[index // SMOOTHING_BLOCK]), 1 if places else 4  # at an end, as of a not-a-knot spline: no fewer
        while k and chosen[index // SMOOTHING_BLOCK : _block(index + pieces * spacings[k], n) + 1].min() < k:
            k -= 1  # every block on the way to the next knot must allow it
        need = spacings[k]
        index += pieces * need
        if n - 1 - index < 4 * need:
            break
        places.append(index)
    return _least_squares(x, y, x[places])


def _block(index: int, n: int) -> int:
    """Return the block of the samples half a block beyond a sample of n."""
    return min(index + SMOOTHING_BLOCK // 2, n - 1) // SMOOTHING_BLOCK


def _spacings(misfit: Array, spacings: Array, samples: float, overall: int) -> NDArray[np.int64]:
    """Return which spacing each block takes: `overall`, unless a finer one is needed there or a coarser one does."""
    chosen = np.zeros(misfit.shape[1], np.int64)
    for k in range(1, spacings.size):  # spacing k will do where no finer one lowers the misfit by more than chance would
        freedom = samples * (1 / spacings[:k] - 1 / spacings[k])
        excess = (misfit[k] - misfit[:k] - freedom[:, None]) / np.sqrt(2 * freedom)[:, None]
        chosen[(excess < (3.0 if k <= overall else 1.0)).all(axis=0)] = k
    return chosen


def _least_squares(x: Array, y: Array, inner: Array) -> BSpline:
    """Return the least-squares spline with these inner knots, by its banded normal equations."""
    from scipy.interpolate import BSpline
    from scipy.linalg import solveh_banded

    knots = np.concatenate([np.full(DEGREE + 1, x[0]), inner, np.full(DEGREE + 1, x[-1])])
    design = BSpline.design_matrix(x, knots, DEGREE)
    squares = (design.T @ design).todia()
    band = np.zeros((DEGREE + 1, knots.size - DEGREE - 1))
    for offset, values in zip(squares.offsets, squares.data, strict=True):
        if offset >= 0:
            band[DEGREE - offset, offset : values.size] = values[offset:]
    return BSpline(knots, solveh_banded(band, design.T @ y), DEGREE)


def _bridge(
    t: Array, W: Array, first: int, last: int, before: tuple[Array, Array] | None, after: tuple[Array, Array] | None
) -> tuple[Array, Array]:
    """Return monotone cubics through samples `first` to `last` that continue the splines before and after."""
    from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

    low, high = max(first - 1, 0), min(last + 2, t.size)  # a sample more on each side tells the slope at the ends
    x, y = t[first : last + 1], W[first : last + 1].copy()
    wide = W[low:high].copy()
    if before is not None:
        y[0] = wide[first - low] = _end(before)[0]
    if after is not None:
        y[-1] = wide[last - low] = after[1][0, 0]
    slopes = PchipInterpolator(t[low:high], wide).derivative()(x) if high - low > 1 else np.zeros(x.size)
    secants = np.diff(y) / np.diff(x)
    for place, fit in ((0, before), (-1, after)):
        if fit is not None:
            slope = _end(fit)[1] if place == 0 else fit[1][0, 1]
            if slope * secants[place] >= 0 and abs(slope) <= 3 * abs(secants[place]):  # stays monotone
                slopes[place] = slope
    rows = np.zeros((x.size - 1, DEGREE + 1))
    rows[:, :4] = CubicHermiteSpline(x, y, slopes).c[::-1].T
    return x, rows


def _end(fit: tuple[Array, Array]) -> tuple[float, float]:
    """Return value and slope at the last knot."""
    knots, rows = fit
    return horner(rows[-1].tolist(), float(knots[-1] - knots[-2]))


def horner(coefficients: Sequence[Number], h: Number) -> tuple[Number, Number]:
    """Return value and slope at `h` of a polynomial, its lowest power first."""
    value, slope = 0.0 * h, 0.0 * h
    for c in reversed(coefficients):
        slope = slope * h + value
        value = value * h + c
    return value, slope


# Normal loads composed of pieces: steps, holds and ramps with rounded corners, and a modulation on top of any load.

RAMP_DEGREE = 6  # of a rounded ramp: the integral of the fifth-degree step
ONE_CORNER = 1e-4  # corners closer than this share of the rise are one: W is then off by 1e-11 of the step


@dataclass(frozen=True)
class LoadSteps(PolynomialLoad):
    """Straight pieces of load, joined smoothly: piece i runs from `first[i]` to `last[i]` (N) over edges[i] to edges[i + 1] (s).

    Jumps and corners are rounded over the `rise` seconds after each edge by the same quintic step, so that W has two
    continuous derivatives and never leaves the range of the pieces: an elastic interface cannot follow a jump of the load.
    Before the first edge and after the last the load is constant. A ramp is thereby late by half the rise.
    """

    edges: tuple[float, ...]
    first: tuple[float, ...]
    last: tuple[float, ...]
    rise: float

    def __post_init__(self) -> None:
        if not len(self.edges) - 1 == len(self.first) == len(self.last) >= 1:
            raise SrfError("a load of pieces needs a first and a last value for each, and one edge more")
        if not all(map(math.isfinite, self.edges)) or any(b <= a for a, b in pairwise(self.edges)):
            raise SrfError("the edges of a load of pieces must rise", "give each piece a duration above 0")
        if not all(math.isfinite(W) and W > 0 for W in (*self.first, *self.last)):
            low = min((*self.first, *self.last))
            raise SrfError(f"a load of {low:g} N lifts the slider off", "give loads above 0")
        if not (math.isfinite(self.rise) and self.rise > 0):
            raise SrfError(f"a rise of {self.rise:g} s is not a positive time", "20 ms is long beside the slider's bounce")

    @classmethod
    def sequence(cls, pieces: Sequence[tuple[float, float, float]], *, start: float = 0.0, rise: float) -> LoadSteps:
        """Return the load of pieces (duration in s, first and last load in N), one after another from `start` on."""
        durations, first, last = (tuple(map(float, column)) for column in zip(*pieces, strict=True))
        edges = start + np.concatenate(([0.0], np.cumsum(durations)))
        return cls(tuple(edges.tolist()), first, last, float(rise))

    @cached_property
    def corners(self) -> tuple[tuple[float, float, float], ...]:
        """Return (time, jump of W, jump of dW/dt) for each edge where there is one."""
        rates = [(b - a) / (t1 - t0) for a, b, (t0, t1) in zip(self.first, self.last, pairwise(self.edges), strict=True)]
        before = zip((self.first[0], *self.last), (0.0, *rates), strict=True)
        after = zip((*self.first, self.last[-1]), (*rates, 0.0), strict=True)
        found = [(t, W1 - W0, s1 - s0) for t, (W0, s0), (W1, s1) in zip(self.edges, before, after, strict=True)]
        return tuple(corner for corner in found if corner[1] or corner[2])

    @cached_property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        times = sorted({t + shift for t, _, _ in self.corners for shift in (0.0, self.rise)})
        kept: list[float] = []
        for t in times:
            if not kept or t - kept[-1] > ONE_CORNER * self.rise:
                kept.append(t)
        return tuple(kept)

    @cached_property
    def knots(self) -> Array:  # type: ignore[override]
        ends = (self.breaks[0] - 1.0, self.breaks[-1] + 1.0) if self.breaks else (0.0, 1.0)
        return np.array([ends[0], *self.breaks, ends[1]])

    @cached_property
    def coefficients(self) -> Array:  # type: ignore[override]
        return np.array([self._expanded(a, 0.5 * (a + b)) for a, b in pairwise(self.knots.tolist())])

    def _expanded(self, knot: float, inside: float) -> Array:
        """Return the coefficients about `knot` of the polynomial that holds at `inside`, (7,)."""
        powers = self.rise ** -np.arange(RAMP_DEGREE + 1.0)
        total = np.zeros(RAMP_DEGREE + 1)
        total[0] = self.first[0]
        for t, jump, bend in self.corners:
            share, x = (inside - t) / self.rise, (knot - t) / self.rise
            if share <= 0:
                continue
            if share < 1:
                total += (jump * _shifted(_STEP, x) + bend * self.rise * _shifted(_RAMP, x)) * powers
            else:
                total[0] += jump + bend * (knot - t - 0.5 * self.rise)
                total[1] += bend
        return total


_STEP = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0, 0.0])  # from 0 to 1 on [0, 1], two derivatives vanish at both ends
_RAMP = np.array([0.0, 0.0, 0.0, 0.0, 2.5, -3.0, 1.0])  # its integral, which ends at 1/2


@dataclass(frozen=True)
class ModulatedLoad(Load):
    """A load times 1 + eps s(t) cos(2 pi f t + phase): `shape` is a Modulation of unit load, relative to `base` at each time."""

    base: Load
    shape: Modulation

    def __post_init__(self) -> None:
        if self.shape.W0 != 1.0:
            raise SrfError(f"the shape of a modulation has W0 = 1, not {self.shape.W0:g}", "Modulation(1.0, eps, f)")

    @property
    def breaks(self) -> tuple[float, ...]:  # type: ignore[override]
        return tuple(sorted({*self.base.breaks, *self.shape.breaks}))

    def longest_step(self, start: float, end: float) -> float:
        return min(self.base.longest_step(start, end), self.shape.longest_step(start, end))

    def check(self, start: float, end: float) -> None:
        self.base.check(start, end)

    def __call__(self, t: Array) -> tuple[Array, Array]:
        (W, W_dot), (m, m_dot) = self.base(t), self.shape(t)
        return W * m, W_dot * m + W * m_dot

    def rest(self, t: float) -> float:
        return self.base.rest(t)

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        """Return knots (k + 1,) and coefficients (k, degree + 1) of the product of both factors' polynomials."""
        factors = (self.base.polynomials(start, end), self.shape.polynomials(start, end))
        knots = np.unique(np.concatenate([factors[0][0], factors[1][0]]))
        left, right = (_about(knots[:-1], 0.5 * (knots[:-1] + knots[1:]), *factor) for factor in factors)
        product = np.zeros((left.shape[0], left.shape[1] + right.shape[1] - 1))
        for j in range(right.shape[1]):
            product[:, j : j + left.shape[1]] += left * right[:, j : j + 1]
        return knots, product


def _about(places: Array, inside: Array, knots: Array, coefficients: Array) -> Array:
    """Return, about each of `places`, the coefficients of the piece that holds at `inside`; (places, degree + 1)."""
    i = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(coefficients) - 1)
    return _shifted(coefficients[i], places - knots[i])


def _shifted(coefficients: Array, by: Array | float) -> Array:
    """Return the coefficients, lowest power first along the last axis, of p(x + by)."""
    out = coefficients.copy()
    n = out.shape[-1]
    for k in range(n - 1):  # Horner's scheme, once per power
        for j in range(n - 2, k - 1, -1):
            out[..., j] += by * out[..., j + 1]
    return out


# The imposed driving velocity; um, s.


@dataclass(frozen=True)
class Drive:
    """Velocity of the spring's far end: from `times[i]` on it is velocities[i] + accelerations[i] (t - times[i]).

    The first piece also holds before times[0]. Jumps of V are allowed, V may be zero or negative.
    """

    times: tuple[float, ...]
    velocities: tuple[float, ...]
    accelerations: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.times) == len(self.velocities) == len(self.accelerations) >= 1:
            raise SrfError("a drive needs as many times as velocities and accelerations, and at least one")
        if not all(map(math.isfinite, (*self.times, *self.velocities, *self.accelerations))):
            raise SrfError("a drive's times, velocities and accelerations must be finite")
        if any(b <= a for a, b in zip(self.times, self.times[1:], strict=False)):
            raise SrfError("the times of a drive must rise", "give each change of velocity its own, later time")

    @classmethod
    def constant(cls, V: float) -> Drive:
        """Return one velocity for all times."""
        return cls((0.0,), (float(V),), (0.0,))

    @classmethod
    def steps(cls, changes: Sequence[tuple[float, float]]) -> Drive:
        """Return a velocity that jumps to V at t, for each (t, V); the first holds before its time too."""
        times, velocities = zip(*changes, strict=True)
        return cls(tuple(map(float, times)), tuple(map(float, velocities)), (0.0,) * len(times))

    @classmethod
    def sequence(cls, pieces: Sequence[tuple[float, float, float]], *, start: float = 0.0) -> Drive:
        """Return the drive of pieces (duration in s, first and last velocity in um/s), one after another from `start` on."""
        times = tuple(accumulate((duration for duration, _, _ in pieces[:-1]), initial=start))
        rates = tuple((last - first) / duration for duration, first, last in pieces)
        return cls(times, tuple(first for _, first, _ in pieces), rates)

    @property
    def breaks(self) -> tuple[float, ...]:
        """Return the times at which V or its slope may jump."""
        return self.times[1:]

    def piece(self, t: float) -> tuple[float, float, float]:
        """Return (V, acceleration, reference time) of the piece that holds at `t`."""
        i = max(bisect_right(self.times, t) - 1, 0)
        return self.velocities[i], self.accelerations[i], self.times[i]

    def at(self, t: float) -> float:
        """Return V at one time (s)."""
        V, rate, since = self.piece(t)
        return V + rate * (t - since) if rate else V

    def displacement(self, t: Array) -> Array:
        """Return the displacement since t[0] at the rising times `t` (n,), exactly: V is linear between the breaks."""
        inside = [b for b in self.breaks if t[0] < b < t[-1]]
        edges = np.array([t[0], *inside, t[-1]])
        V = np.array([self.at(a) for a in edges[:-1].tolist()])
        rates = np.array([self.piece(a)[1] for a in edges[:-1].tolist()])
        widths = np.diff(edges)
        reached = np.concatenate(([0.0], np.cumsum(V * widths + 0.5 * rates * widths**2)))
        i = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(V) - 1)
        h = t - edges[i]
        return np.asarray(reached[i] + h * (V[i] + 0.5 * rates[i] * h))

    def __call__(self, t: Array) -> Array:
        """Return V at the times `t`."""
        i = np.maximum(np.searchsorted(self.times, t, side="right") - 1, 0)
        times, V, rate = (np.array(a) for a in (self.times, self.velocities, self.accelerations))
        return np.where(rate[i] == 0.0, V[i], V[i] + rate[i] * (np.asarray(t) - times[i]))
