"""A measured load as piecewise polynomials; um, s, N.

Evenly sampled stretches carry a spline of degree 7: at eight samples per period of a modulation it errs by 3e-7 of the
amplitude, where a cubic errs by 4e-4 and its derivative by a percent. At jumps and corners such a spline would ring; the few
intervals there, gaps and changes of the sampling rate are bridged by monotone cubics. A load with measurement noise is smoothed,
as dW/dt enters laws.
"""

from __future__ import annotations

from bisect import bisect_right
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from srfcli.errors import SrfError
from srfcli.numerics.collocation import Array
from srfcli.numerics.load import Load, LoadPiece

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

DEGREE = 7
UNEVEN = 1.6  # ratio of an interval to its neighbours' median at which a stretch ends
SHORTEST = 16  # samples of a stretch that carries the spline
REACH = 4  # samples on each side from which a sample is foretold
ROUGH = 0.02  # share of the local range by which a sample may differ from what its neighbours foretell
FAINT = 1e-4  # share of the whole range below which nothing is a corner
MOSTLY = 0.3  # share of rough samples at which a load is coarsely sampled rather than cornered
SPACINGS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # samples between the knots of a smoothing spline
BLOCK = 32  # samples over which the smoothness may vary


class SampledLoad(Load):
    """The measured load `W` (N) at `times` (s, rising, four or more); `noise` (N) is its measurement error, 0 to interpolate.

    `knots` (k + 1,) and `coefficients` (k, 8), lowest power first in the time since the knot, are what it consists of.
    """

    def __init__(self, times: Array, W: Array, *, noise: float = 0.0) -> None:
        t, values = np.asarray(times, dtype=float), np.asarray(W, dtype=float)
        if t.ndim != 1 or t.shape != values.shape or t.size < 4:
            raise SrfError("a sampled load needs four times or more, and as many loads as times")
        if not (np.isfinite(t).all() and np.isfinite(values).all() and (np.diff(t) > 0).all()):
            raise SrfError("a sampled load needs finite loads at rising times", "drop gaps and repeated times first")
        if values.min() <= 0:
            raise SrfError(
                f"the load is {values.min():g} N at t = {t[values.argmin()]:g} s", "the slider must stay in contact"
            )
        self.times, self.W, self.noise = t, values, float(noise)
        self.knots, self.coefficients, self.breaks = _build(t, values, self.noise)
        self._check_contact()
        self.longest_step = float(4 * np.median(np.diff(self.knots)))
        self._knots, self._rows = self.knots.tolist(), self.coefficients.tolist()

    def _check_contact(self) -> None:
        """Raise SrfError where the load between two positive samples is not positive."""
        half = 0.5 * np.diff(self.knots)
        middles = (self.coefficients * half[:, None] ** np.arange(DEGREE + 1)).sum(axis=1)
        if middles.min() <= 0:
            at = self.knots[int(middles.argmin())]
            raise SrfError(
                f"the load between its samples falls to {middles.min():g} N near t = {at:g} s", "sample it finer"
            )

    def check(self, start: float, end: float) -> None:
        if start < self._knots[0] or end > self._knots[-1]:
            raise SrfError(
                f"the load is known from {self._knots[0]:g} to {self._knots[-1]:g} s, not over all of {start:g} to {end:g} s",
                "simulate within the times of the load's samples",
            )

    def piece(self, t: float) -> LoadPiece:
        knots, rows, last = self._knots, self._rows, len(self._knots) - 2

        def spline(s: float) -> tuple[float, float]:
            i = min(max(bisect_right(knots, s) - 1, 0), last)
            h, W, rate = s - knots[i], 0.0, 0.0
            for c in reversed(rows[i]):
                rate = rate * h + W
                W = W * h + c
            return W, rate

        return spline

    def rest(self, t: float) -> float:
        return self.piece(t)(t)[0]

    def __call__(self, t: Array) -> tuple[Array, Array]:
        t = np.asarray(t, dtype=float)
        i = np.clip(np.searchsorted(self.knots, t, side="right") - 1, 0, len(self._rows) - 1)
        h, W, rate = t - self.knots[i], np.zeros(t.shape), np.zeros(t.shape)
        for c in self.coefficients.T[::-1]:
            rate = rate * h + W
            W = W * h + c[i]
        return W, rate

    def polynomials(self, start: float, end: float) -> tuple[Array, Array]:
        self.check(start, end)
        if not start < end:
            raise SrfError(f"a load is asked for from {start:g} to {end:g} s", "give two times that rise")
        first = min(max(bisect_right(self._knots, start) - 1, 0), len(self._rows) - 1)
        last = int(np.searchsorted(self.knots, end, side="left"))
        knots, rows = self.knots[first : last + 1].copy(), self.coefficients[first:last].copy()
        rows[0] = shift_polynomial(rows[0], start - knots[0])
        knots[0], knots[-1] = start, end
        return knots, rows


def shift_polynomial(row: Array, by: float) -> Array:
    """Return the coefficients, lowest power first, of p(x + by)."""
    out = row.copy()
    for k in range(row.size - 1):  # Horner's scheme, once per power
        for j in range(row.size - 2, k - 1, -1):
            out[j] += by * out[j + 1]
    return out


def _build(t: Array, W: Array, noise: float) -> tuple[Array, Array, tuple[float, ...]]:
    """Return knots, coefficients and the times where the kind of piece changes."""
    stretches = _stretches(t, W, noise)
    if not stretches:
        return (*_bridge(t, W, 0, t.size - 1, None, None), ())
    fits = [_spline(t[a : b + 1], W[a : b + 1], noise) for a, b in stretches]
    knots, rows, at = [t[:1]], [], 0
    for k, ((a, b), (fit_knots, fit_rows)) in enumerate(zip(stretches, fits, strict=True)):
        if at < a:
            before = fits[k - 1] if k else None
            bridge_knots, bridge_rows = _bridge(t, W, at, a, before, fits[k])
            knots.append(bridge_knots[1:])
            rows.append(bridge_rows)
        knots.append(fit_knots[1:])
        rows.append(fit_rows)
        at = b
    if at < t.size - 1:
        bridge_knots, bridge_rows = _bridge(t, W, at, t.size - 1, fits[-1], None)
        knots.append(bridge_knots[1:])
        rows.append(bridge_rows)
    edges = {float(t[i]) for pair in stretches for i in pair if 0 < i < t.size - 1}
    return np.concatenate(knots), np.concatenate(rows), tuple(sorted(edges))


def _stretches(t: Array, W: Array, noise: float) -> list[tuple[int, int]]:
    """Return first and last sample of the stretches that carry a spline: evenly sampled, without jump or corner inside."""
    steps = np.diff(t)
    usual = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(steps, 2, mode="edge"), 5), axis=1)
    even = np.abs(np.log(steps / usual)) < np.log(UNEVEN)
    change = np.abs(np.diff(np.log(steps))) > np.log(
        UNEVEN
    )  # between two rates a sample ends one stretch, begins the next
    found = []
    for a, b in _runs(even):
        cuts = [a, *(a + 1 + np.flatnonzero(change[a:b])).tolist(), b + 1]
        found += [(c, d) for c, d in pairwise(cuts) if d - c >= SHORTEST - 1]
    total = float(np.ptp(W))
    smooth = []
    for a, b in found:
        rough = _rough(W[a : b + 1], total, noise)
        if rough.mean() > MOSTLY:
            rough[:] = False
        calm = ~(rough[1:] | rough[:-1])  # intervals between two samples that their neighbours foretell
        smooth += [(a + c, a + d + 1) for c, d in _runs(calm) if d - c >= SHORTEST - 2]
    return smooth


def _rough(W: Array, total: float, noise: float) -> NDArray[np.bool_]:
    """Return which samples of an even stretch the polynomial through their eight neighbours does not foretell."""
    from numpy.lib.stride_tricks import sliding_window_view

    weights = np.array([-1, 8, -28, 56, -70, 56, -28, 8, -1]) / 70.0  # the eighth difference, 1 at the sample itself
    windows = sliding_window_view(W, 2 * REACH + 1)
    error = np.abs(windows @ weights)
    rough = np.zeros(W.size, bool)
    rough[REACH:-REACH] = error > np.maximum(ROUGH * np.ptp(windows, axis=1), max(FAINT * total, 8 * noise))
    return rough


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
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
    edges = np.arange(0, n, BLOCK)
    spacings = [m for m in SPACINGS if m <= max(n // 4, 2)]
    squares = [(y - _least_squares(x, y, x[4 * m : n - 4 * m : m])(x)) ** 2 for m in spacings]
    overall = int(np.argmin([q.sum() / (1 - 1 / m) ** 2 for q, m in zip(squares, spacings, strict=True)]))
    padded = [np.pad(np.add.reduceat(q, edges), 1) for q in squares]
    misfit = np.array([q[:-2] + q[1:-1] + q[2:] for q in padded]) / noise**2  # of a block and its neighbours
    chosen = _spacings(misfit, np.array(spacings, float), 3.0 * BLOCK, overall)
    places: list[int] = []
    index = 0
    while True:
        ahead = min(index + BLOCK // 2, n - 1) // BLOCK
        need = spacings[min(int(chosen[index // BLOCK]), int(chosen[ahead]))]
        index += 4 * need if not places else need  # as at a not-a-knot end: more pieces there would follow the noise
        if n - 1 - index < 4 * need:
            break
        places.append(index)
    return _least_squares(x, y, x[places])


def _spacings(misfit: Array, spacings: Array, samples: float, overall: int) -> NDArray[np.int64]:
    """Return which spacing each block takes: `overall`, unless a finer one is needed there or a coarser one does."""
    chosen = np.zeros(misfit.shape[1], np.int64)
    for k in range(
        1, spacings.size
    ):  # spacing k will do where no finer one lowers the misfit by more than chance would
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
    from scipy.interpolate import PchipInterpolator

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
    h = np.diff(x)
    rows = np.zeros((h.size, DEGREE + 1))
    rows[:, 0], rows[:, 1] = y[:-1], slopes[:-1]
    rows[:, 2] = (3 * secants - 2 * slopes[:-1] - slopes[1:]) / h
    rows[:, 3] = (slopes[:-1] + slopes[1:] - 2 * secants) / h**2
    return x, rows


def _end(fit: tuple[Array, Array]) -> tuple[float, float]:
    """Return value and slope at the last knot."""
    knots, rows = fit
    h, value, slope = float(knots[-1] - knots[-2]), 0.0, 0.0
    for c in reversed(rows[-1].tolist()):
        slope = slope * h + value
        value = value * h + c
    return value, slope
