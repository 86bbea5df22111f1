"""Stick-slip in a record: where the spring lets go, by how much and how often."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.errors import SrfError
from srfcli.numerics.collocation import Array

SHARE = 0.3  # of the typical drop: what falls by less is no event
NOISE = 8.0  # standard deviations of the samples' scatter that an event must exceed
FLOOR = 1e-5  # of the largest elongation: below it lies what integration and rounding do
DECAY = 0.7  # the drops of the second half against those of the first, of an oscillation that lasts


@dataclass(frozen=True)
class StickSlip:
    """The events of a record, oldest first: arrays (n,) of times (s, at half of the drop), of the elongation from which
    it fell and of the drops (in the unit of u), and of how long each fall took (s). `span` is the record's (first, last) time.
    """

    times: Array
    tops: Array
    drops: Array
    falls: Array
    span: tuple[float, float]

    @property
    def recurrence(self) -> Array:
        """Return the times between events, (n - 1,)."""
        return np.diff(self.times)

    @property
    def period(self) -> float:
        """Return the median time between events, NaN where there are fewer than two."""
        return float(np.median(self.recurrence)) if self.times.size > 1 else float("nan")

    @property
    def drop(self) -> float:
        """Return the median drop, NaN without events."""
        return float(np.median(self.drops)) if self.times.size else float("nan")

    @property
    def sustained(self) -> bool:
        """True for three events or more that neither die out nor end two periods before the record does."""
        if self.times.size < 3 or self.span[1] - self.times[-1] > 2 * self.period:
            return False
        half = self.times.size // 2
        return bool(np.median(self.drops[-half:]) > DECAY * np.median(self.drops[:half]))


def stick_slip(t: Array, u: Array, *, ripple: float | None = None, smallest: float | None = None) -> StickSlip:
    """Return the falls of `u` (n,) over the rising times `t` (n,): stick-slip events, and what else falls and rises again.

    An event is a fall, after which u rises by as much again, of at least eight times the samples' scatter, and of `smallest`;
    without it, of 1e-5 of the largest |u| and 0.3 of the typical fall, below which half the sum of squared falls lies. `ripple`
    is the frequency (Hz) of a modulation: u is then averaged over its period first, so that the ripple is no event. Samples that
    are not finite are left out. Raises SrfError for arrays that are no record.
    """
    t, u = np.asarray(t, dtype=float), np.asarray(u, dtype=float)
    if t.ndim != 1 or t.shape != u.shape:
        raise SrfError("a record needs as many values as times", f"t has shape {t.shape}, u {u.shape}")
    good = np.isfinite(t) & np.isfinite(u)
    t, u = t[good], u[good]
    if (np.diff(t) <= 0).any():
        raise SrfError("the times of a record must rise", "drop repeated and backward times first")
    span = (float(t[0]), float(t[-1])) if t.size else (float("nan"), float("nan"))
    none = np.empty(0)
    empty = StickSlip(none, none, none, none, span)
    if ripple is not None:
        t, u = _averaged(t, u, ripple)
    if t.size < 5:
        return empty
    threshold = max(NOISE * _scatter(u), FLOOR * float(np.abs(u).max()) if smallest is None else smallest)
    found = _falls(u, threshold) if threshold > 0 else []
    if smallest is None and found:
        found = _falls(u, max(threshold, SHARE * _typical(u[[a for a, _ in found]] - u[[b for _, b in found]])))
    if not found:
        return empty
    top, bottom = np.array(found).T
    times = np.array([_crossing(t[a : b + 1], u[a : b + 1]) for a, b in found])
    return StickSlip(times, u[top], u[top] - u[bottom], t[bottom] - t[top], span)


def _typical(drops: Array) -> float:
    """Return the median of the drops, each weighted by its square: many small ones and a single large one do not move it."""
    ranked = np.sort(drops)
    shares = np.cumsum(ranked**2)
    return float(ranked[np.searchsorted(shares, 0.5 * shares[-1])])


def _scatter(u: Array) -> float:
    """Return the standard deviation of white noise that would scatter third differences as much as `u` does."""
    return float(np.median(np.abs(np.diff(u, 3))) / (0.6745 * np.sqrt(20.0)))


def _averaged(t: Array, u: Array, frequency: float) -> tuple[Array, Array]:
    """Return `u` averaged over one period about each time that has half a period on both sides."""
    from scipy.interpolate import CubicSpline

    if not (np.isfinite(frequency) and frequency > 0):
        raise SrfError(f"a ripple of {frequency:g} Hz is no frequency", "give it above 0, or leave it out")
    half = 0.5 / frequency
    inside = t[(t >= t[0] + half) & (t <= t[-1] - half)] if t.size else t
    if t.size < 4 or inside.size < 5 or np.median(np.diff(t)) > half:
        return t, u  # too short, or sampled too coarsely to see the ripple
    whole = CubicSpline(t, u).antiderivative()
    return inside, (whole(inside + half) - whole(inside - half)) * frequency


def _falls(u: Array, threshold: float) -> list[tuple[int, int]]:
    """Return (top, bottom), as indices, of each fall by `threshold` that is followed by as large a rise."""
    turns = np.nonzero(np.diff(np.sign(np.diff(u))))[0] + 1
    places = [0, *turns.tolist(), u.size - 1]
    values = u[places].tolist()
    found: list[tuple[int, int]] = []
    falling, top, bottom = False, 0, 0
    for i, value in enumerate(values):
        if not falling:
            if value > values[top]:
                top = i
            elif values[top] - value >= threshold:
                falling, bottom = True, i
        elif value < values[bottom]:
            bottom = i
        elif value - values[bottom] >= threshold:
            found.append((places[top], places[bottom]))
            falling, top = False, i
    return found


def _crossing(t: Array, u: Array) -> float:
    """Return the time at which a fall has passed half of its drop; at a flat top the maximum's own time is chance."""
    level = 0.5 * (u[0] + u[-1])
    i = int(np.argmax(u <= level))
    return float(t[i - 1] + (u[i - 1] - level) / (u[i - 1] - u[i]) * (t[i] - t[i - 1]))
