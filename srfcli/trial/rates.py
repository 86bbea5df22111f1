"""Counts as rates with intervals, and stated confidence against how often it was right."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

Z = 1.959963984540054  # of a two-sided interval of 95 %
EDGES = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)


@dataclass(frozen=True)
class Rate:
    """`hits` of `count` cases, and Wilson's interval of 95 % around their share; None of no cases."""

    hits: int
    count: int

    @property
    def share(self) -> float | None:
        """Return the share of hits."""
        return self.hits / self.count if self.count else None

    @property
    def interval(self) -> tuple[float | None, float | None]:
        """Return the bounds of the interval (Wilson 1927): it holds near 0 and 1 too, where the usual one is empty."""
        if not self.count:
            return None, None
        n, p = self.count, self.hits / self.count
        middle = (p + Z**2 / (2 * n)) / (1 + Z**2 / n)
        half = Z / (1 + Z**2 / n) * (p * (1 - p) / n + Z**2 / (4 * n**2)) ** 0.5
        # the exact ends: rounding must not put 0 of n above 0
        return (0.0 if self.hits == 0 else middle - half), (1.0 if self.hits == n else middle + half)


def rate(flags: Iterable[bool]) -> Rate:
    """Return how many of `flags` are true."""
    listed = list(flags)
    return Rate(sum(listed), len(listed))


@dataclass(frozen=True)
class Bin:
    """Cases whose stated confidence lies between `low` and `high`: its mean, and how often it was right."""

    low: float
    high: float
    stated: float
    rate: Rate


def calibration(stated: Sequence[float], hits: Sequence[bool]) -> tuple[tuple[Bin, ...], float | None]:
    """Return the bins that hold cases, and the expected calibration error: the mean distance between stated and found."""
    bins = []
    for low, high in pairwise(EDGES):
        inside = [k for k, s in enumerate(stated) if low <= s < high or s == high == 1.0]
        if inside:
            mean = sum(stated[k] for k in inside) / len(inside)
            bins.append(Bin(low, high, mean, rate(hits[k] for k in inside)))
    if not bins:
        return (), None
    error = sum(b.rate.count * abs(b.stated - (b.rate.share or 0.0)) for b in bins) / len(stated)
    return tuple(bins), error


def quantile(values: Iterable[float], share: float) -> float | None:
    """Return the value that `share` of them do not exceed, by linear interpolation; None of none."""
    ordered = sorted(values)
    if not ordered:
        return None
    at = share * (len(ordered) - 1)
    k = min(int(at), len(ordered) - 2) if len(ordered) > 1 else 0
    return ordered[0] if len(ordered) == 1 else ordered[k] + (at - k) * (ordered[k + 1] - ordered[k])
