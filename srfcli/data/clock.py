"""The clock of a recording: which samples have a valid time, at which rates they were taken, and where samples are missing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import Array
from srfcli.core.errors import Notice, SrfError
from srfcli.motion.imposed import runs_of

Mask = NDArray[np.bool_]

PASSES = 60  # stamps in a row that may be wrong before a clock is held to have been set back
MOST_WRONG, MOST_REPEATED = 0.01, 0.2  # shares of the samples
CHANGE = 1.25  # of the sampling interval
GAP_INTERVALS = 2.5  # sampling intervals
_BRIDGED = "drive and load are bridged, nothing is compared in it"
SHORTEST_RATE = 8  # samples that make a rate
RATE_SAMPLES = 60  # samples at a rate from which its noise is estimated apart from that at others
MOST_NOTICES = 8  # of one kind before they are told together


@dataclass(frozen=True)
class Rate:
    """A stretch of even sampling: samples `first` to `last`, one every `interval` seconds."""

    first: int
    last: int
    interval: float


@dataclass(frozen=True)
class Sampling:
    """The rates of a recording in order, and the samples after which a gap begins."""

    rates: tuple[Rate, ...]
    gaps: NDArray[np.int64]

    @cached_property
    def _groups(self) -> list[list[Rate]]:
        """Groups of rates by rising interval; in a group each interval is less than CHANGE times the one before.

        Groups with too few samples to estimate a noise are left out.
        """
        groups: list[list[Rate]] = []
        for rate in sorted(self.rates, key=lambda r: r.interval):
            if groups and rate.interval < CHANGE * groups[-1][-1].interval:
                groups[-1].append(rate)
            else:
                groups.append([rate])
        size = [sum(r.last - r.first for r in group) for group in groups]
        return [g for g, n in zip(groups, size, strict=True) if n >= min(RATE_SAMPLES, max(size))]

    @cached_property
    def spacings(self) -> tuple[float, ...]:
        """Return the sampling intervals (s), rising, at each of which there are enough samples to estimate a noise."""
        return tuple(max(g, key=lambda r: r.last - r.first).interval for g in self._groups)

    @cached_property
    def at(self) -> NDArray[np.intc]:
        """Return the index in `spacings` of each sample (n,): the nearest spacing where its own has too few samples."""
        logs = np.log(self.spacings)
        near = [int(np.argmin(np.abs(np.log(r.interval) - logs))) for r in self.rates]
        count = [r.last - r.first for r in self.rates]
        count[-1] += 1
        return np.repeat(near, count).astype(np.intc)


@dataclass(frozen=True)
class Place:
    """Samples of a column, for notices and errors: file, heading, numbers of their rows (n,) and times (n,) in s."""

    path: Path
    heading: str
    rows: NDArray[np.int64]
    t: Array

    @property
    def column(self) -> str:
        """Return `steps.csv: column 'mu'`."""
        return f"{self.path.name}: column '{self.heading}'"

    def span(self, first: int, last: int) -> str:
        """Return `steps.csv: rows 120-130, t = 1.2 to 1.3 s`, for samples `first` to `last`."""
        ends, times = self.rows[[first, last]], self.t[[first, last]]
        at = f"{self.path.name}: row {ends[0]}" if first == last else f"{self.path.name}: rows {ends[0]}-{ends[1]}"
        if not np.isfinite(times).all():
            return at
        return f"{at}, t = {times[0]:.7g}" + (" s" if first == last else f" to {times[1]:.7g} s")

    def spots(self, kind: str, mask: Mask, told: str) -> list[Notice]:
        """Return a notice for each run of True in `mask` (n,), or one for all of them where they are many."""
        found = runs_of(mask)
        if len(found) <= MOST_NOTICES:
            counts = [f"{b - a + 1} sample{'s' if b > a else ''}" for a, b in found]
            return [Notice(kind, self.span(*ends), f"{n} {told}") for ends, n in zip(found, counts, strict=True)]
        first = ", ".join(str(self.rows[a]) for a, _ in found[:4])
        where = f"{self.path.name}: {len(found)} places, the first at rows {first}"
        return [Notice(kind, where, f"{int(mask.sum())} samples {told}")]


def kept_samples(place: Place, hint: str | None = None) -> tuple[Mask, list[Notice]]:
    """Return which samples have a time of their own, later than the one before, and what was wrong with the others.

    Raises SrfError, with this hint if there is one, where the clock was set back, or where too many stamps are repeated to call
    the others a recording.
    """
    missing = np.isnan(place.t)
    keep, repeated, wrong = _rising(place, ~missing, hint)
    notices = [
        *place.spots("nan", missing, "without a time, left out"),
        *place.spots("repeated-time", repeated, "with the time of the sample before, left out"),
        *place.spots("backward-time", wrong, "whose time does not fit between its neighbours', left out"),
    ]
    if keep.sum() < SHORTEST_RATE:
        raise SrfError(f"{place.path}: {keep.sum()} usable samples", f"A recording needs {SHORTEST_RATE} or more.")
    return keep, notices


def _rising(place: Place, keep: Mask, hint: str | None) -> tuple[Mask, Mask, Mask]:
    """Return the samples that stay, those with a repeated and those with a wrong time."""
    t = place.t
    repeated, wrong, keep = np.zeros(t.size, bool), np.zeros(t.size, bool), keep.copy()
    for _ in range(PASSES):
        index = np.flatnonzero(keep)
        steps = np.diff(t[index])
        bad = np.flatnonzero(steps <= 0)
        if not bad.size:
            return keep, repeated, wrong
        same = bad[steps[bad] == 0]
        repeated[index[same + 1]] = True
        back = bad[steps[bad] < 0]
        back = back[~np.isin(back - 1, back)]  # of two in a row the first is mended first
        usual = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
        for i in back:
            earlier = t[index[i - 1]] if i else np.nan
            forward = abs(t[index[i]] - earlier - usual) > abs(t[index[i + 1]] - earlier - usual)
            wrong[index[i] if i and t[index[i + 1]] > earlier and forward else index[i + 1]] = True
        keep &= ~(repeated | wrong)
        if repeated.sum() > max(3, MOST_REPEATED * t.size):
            at = int(np.flatnonzero(repeated)[0])
            raise SrfError(
                f"{place.span(at, at)}: {repeated.sum()} of {t.size} samples have the time of the one before",
                hint or "The clock is too coarse for the sampling; give the time with more digits.",
            )
        if wrong.sum() > max(3, MOST_WRONG * t.size):
            break
    index = np.flatnonzero(np.isfinite(t))
    at = int(index[1:][np.diff(t[index]) < 0][0])
    raise SrfError(
        f"{place.span(at, at)}: the time goes back, from {t[:at][np.isfinite(t[:at])][-1]:.10g} s, and stays back",
        hint or "Two recordings in one file? Part them, or choose one with window = [from, to].",
    )


def find_sampling(t: Array) -> Sampling:
    """Return the rates at which the rising times `t` (n,) were taken, and the gaps between them."""
    from scipy.ndimage import median_filter, percentile_filter

    steps = np.diff(t)
    level = np.log(median_filter(steps, size=min(2 * SHORTEST_RATE + 1, steps.size), mode="nearest"))
    jumps = np.flatnonzero(np.abs(np.diff(level)) > np.log(CHANGE)) + 1
    bounds = [0, *jumps.tolist(), steps.size]
    merged: list[list[int]] = []
    for a, b in pairwise(bounds):
        if merged and b - a < SHORTEST_RATE:  # the median passes from one rate to the next in a few samples
            merged[-1][1] = b
        else:
            merged.append([a, b])
    rates: list[Rate] = []
    for a, b in merged:
        interval = float(np.median(steps[a:b]))
        if rates and abs(np.log(interval / rates[-1].interval)) <= np.log(CHANGE):
            rates[-1] = Rate(rates[-1].first, b, float(np.median(steps[rates[-1].first : b])))
        else:
            rates.append(Rate(a, b, interval))
    edges = [_beginning(rate, before, steps) for before, rate in pairwise(rates)]
    ends = pairwise([0, *edges, steps.size])
    rates = [Rate(first, last, r.interval) for r, (first, last) in zip(rates, ends, strict=True)]
    allowed = np.repeat([r.interval for r in rates], [r.last - r.first for r in rates])
    # with the 80th percentile of the intervals nearby uneven sampling does not count as gaps
    allowed = np.maximum(allowed, percentile_filter(steps, 80, size=min(8 * SHORTEST_RATE + 1, steps.size), mode="nearest"))
    beside = np.zeros(steps.size, bool)
    for edge in edges:  # between two rates the slower one is no gap
        beside[max(edge - SHORTEST_RATE, 0) : edge + SHORTEST_RATE] = True
    slowest = max(r.interval for r in rates)
    gaps = steps > np.where(beside, np.maximum(allowed, slowest), allowed) * GAP_INTERVALS
    return Sampling(tuple(rates), np.flatnonzero(gaps))


def _beginning(rate: Rate, before: Rate, steps: Array) -> int:
    """Return the first sample of a rate, which the running median of intervals misses by a few samples."""
    middle = 0.5 * np.log(rate.interval / before.interval)
    near = np.arange(max(rate.first - SHORTEST_RATE, before.first), min(rate.first + SHORTEST_RATE, rate.last))
    new = np.abs(np.log(steps[near] / before.interval)) > abs(middle)
    # the split that puts most of the intervals on their own side
    score = np.cumsum(np.concatenate([[0], np.where(new, -1, 1)]))
    return int(near[0]) + int(np.argmax(score))


def sampling_notices(place: Place, sampling: Sampling) -> list[Notice]:
    """Return a notice for every gap and every change of the sampling rate."""
    t, name, notices = place.t, place.path.name, []
    if sampling.gaps.size > MOST_NOTICES:
        longest = float(np.diff(t)[sampling.gaps].max())
        first = ", ".join(str(r) for r in place.rows[sampling.gaps[:4]])
        where = f"{name}: {sampling.gaps.size} places, the first after rows {first}"
        notices.append(Notice("gap", where, f"gaps of up to {longest:.4g} s; {_BRIDGED}"))
    else:
        for gap in sampling.gaps.tolist():
            usual = next(r.interval for r in sampling.rates if r.first <= gap < r.last)
            what = f"{t[gap + 1] - t[gap]:.4g} s without a sample, where one comes every {usual:.4g} s; {_BRIDGED}"
            notices.append(Notice("gap", place.span(gap, gap + 1), what))
    if len(sampling.rates) - 1 > MOST_NOTICES:
        rates = [1 / r.interval for r in sampling.rates]
        what = f"the sampling changes between {min(rates):.4g} Hz and {max(rates):.4g} Hz; each sample keeps its time"
        notices.append(Notice("sampling-change", f"{name}: {len(rates) - 1} places", what))
        return notices
    for before, after in pairwise(sampling.rates):
        rates = [1 / before.interval, 1 / after.interval]
        what = f"the sampling changes from {rates[0]:.4g} Hz to {rates[1]:.4g} Hz; each sample keeps its time"
        notices.append(Notice("sampling-change", place.span(after.first, after.first), what))
    return notices
