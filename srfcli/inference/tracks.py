"""Tracks whose friction wanders: splines over slip, of each run or one for all, and the prior of their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from srfcli.numerics.collocation import Array
from srfcli.recording.values import Run
from srfcli.splines import Spline

SPACING = 0.8  # um between knots: contacts are renewed over half of it, and a finer track fits no better
MOST = 300  # numbers of a track: a longer one has wider knots


@dataclass(frozen=True)
class Roughness:
    """Standard deviation of mu0 along the track and its correlation length (um); amplitude 0 is a smooth track."""

    amplitude: float = 0.0
    length: float = 5.0

    def root(self, nodes: Array) -> Array:
        """Return L with L L' the covariance of a track's numbers."""
        d = np.abs(nodes[:, None] - nodes[None, :]) * np.sqrt(3) / self.length
        K = (1 + d) * np.exp(-d) + 1e-8 * np.eye(nodes.size)
        return self.amplitude * np.linalg.cholesky(K)


USUAL = Roughness(3e-4, 8.0)  # of a track until its own is estimated: polished contacts wander by so much


@dataclass(frozen=True)
class Tracks:
    """The splines of all runs: `of` tells, for each run's name, which of `splines` it slid on."""

    splines: tuple[Spline, ...]
    of: Mapping[str, int]

    @property
    def numbers(self) -> Array:
        """Return the numbers of all splines, one after another."""
        return np.concatenate([s.numbers for s in self.splines]) if self.splines else np.zeros(0)

    def with_numbers(self, numbers: Array) -> Tracks:
        """Return the same knots with other numbers."""
        edges = np.cumsum([0, *(s.numbers.size for s in self.splines)])
        return Tracks(
            tuple(s.with_numbers(numbers[a:b]) for s, a, b in zip(self.splines, edges, edges[1:], strict=False)),
            self.of,
        )

    @property
    def shared(self) -> bool:
        """Return whether several runs slid on one track."""
        return len(self.splines) == 1 < len(self.of)

    def columns(self, run: Run) -> range:
        """Return the places of a run's numbers among all."""
        before = sum(s.numbers.size for s in self.splines[: self.of[run.name]])
        return range(before, before + self.spline(run).numbers.size)

    def spline(self, run: Run) -> Spline:
        """Return the track of a run; a smooth one where none is known."""
        return self.splines[self.of[run.name]] if run.name in self.of else Spline.over(-1.0, 1.0, 1.0)

    def root(self, roughness: Roughness) -> Array:
        """Return L with L L' the prior covariance of all numbers."""
        return block_diag(*(roughness.root(s.nodes) for s in self.splines)) if self.splines else np.zeros((0, 0))


def tracks_for(runs: Sequence[Run], *, shared: bool) -> Tracks:
    """Return smooth tracks that cover the slip of these runs: one for all, or one for each."""
    ends = {}
    for run in runs:
        V = run.drive(run.t)
        ends[run.name] = run.start + float(np.sum(0.5 * (V[1:] + V[:-1]) * np.diff(run.t)))
    if shared:
        return Tracks((_cover(min(r.start for r in runs), max(ends.values())),), {r.name: 0 for r in runs})
    return Tracks(tuple(_cover(r.start, ends[r.name]) for r in runs), {r.name: i for i, r in enumerate(runs)})


def _cover(low: float, high: float) -> Spline:
    return Spline.over(low - 1.0, high + 2.0, max(SPACING, (high - low) / (MOST - 3)))
