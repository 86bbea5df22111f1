"""What a recording is like: sampling, flaws, noise, and the history of drive and load, as found in the data."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from srfcli.numerics.program import Drive, Load
from srfcli.recording.load import Found, find_modulation
from srfcli.recording.noise import Noise, describe_noise
from srfcli.recording.series import Rate, Sampling, find_sampling
from srfcli.recording.values import Array, Run

KINDS = {  # of notices, as --fail-on takes them
    "gap": "samples are missing",
    "sampling-change": "the sampling rate changes",
    "nan": "empty cells or NaN",
    "repeated-time": "two samples at one time",
    "backward-time": "time stamps that go back",
    "spike": "single samples that stand out",
    "reset": "a transducer was set anew",
    "saturation": "samples at the end of the gauge's range",
    "quantisation": "steps of the gauge that are not small against its noise",
    "load-constant": "a load that varies no more than its noise",
    "load-smoothed": "a load that was smoothed",
    "modulation-differs": "the load is not modulated as declared",
    "drive-differs": "the column of velocities is not the declared drive",
    "drive-segmented": "a drive found in noisy velocities",
    "drive-fitted": "a drive found in displacements",
    "unit": "a heading and [columns] differ in unit",
    "observable": "more than one observable in the file",
    "load": "more than one load in the file",
    "start-value": "a start value that is not the apparatus'",
}


@dataclass(frozen=True)
class LoadHistory:
    """The load over a run: mean, smallest and largest W (N), the largest |d ln W/dt| (1/s), and a modulation if there is one."""

    mean: float
    lowest: float
    highest: float
    rate: float
    modulation: Found | None


@dataclass(frozen=True)
class RunCheck:
    """What was found in one run; `noise` is that of the longest evenly sampled stretch, `noises` those of all long ones.

    `friction_noise` is the noise of a sample in units of the friction coefficient. `drive` holds (from s, um/s, um/s^2).
    """

    run: Run
    sampling: Sampling
    noise: Noise
    noises: tuple[tuple[Rate, Noise], ...]
    friction_noise: float
    drive: tuple[tuple[float, float, float], ...]
    slowest: float
    fastest: float
    load: LoadHistory

    def count(self, kind: str) -> int:
        """Return how many notices of a kind the run has."""
        return Counter(n.kind for n in self.run.notices)[kind]

    @property
    def spikes(self) -> int:
        """Return how many samples of the observable stand out and are not compared."""
        told = (n.what for n in self.run.notices if n.kind == "spike" and n.what.endswith("not compared"))
        return sum(int(what.split()[0]) for what in told)  # the notice begins with their number


def check_run(run: Run) -> RunCheck:
    """Return what can be said of a recording without simulating anything."""
    sampling = find_sampling(run.t)
    load = load_history(run.load, run.t)
    x = np.interp(run.t, run.t[run.used], run.observed[run.used])
    noises = []
    for rate in sampling.rates:
        if rate.last - rate.first >= 128:
            cycles = load.modulation.frequency * rate.interval if load.modulation else None
            noises.append((rate, describe_noise(x[rate.first : rate.last], cycles)))
    longest = _longest(sampling)
    noise = next((n for r, n in noises if r is longest), None) or describe_noise(x[longest.first : longest.last + 1])
    size = noise.total if math.isfinite(noise.total) else noise.white
    pieces, slowest, fastest = _drive_pieces(run.drive, run.t)
    factor = {"elongation": run.stiffness / load.mean, "force": 1 / load.mean, "friction": 1.0}[run.observable]
    return RunCheck(run, sampling, noise, tuple(noises), size * factor, pieces, slowest, fastest, load)


def _longest(sampling: Sampling) -> Rate:
    return max(sampling.rates, key=lambda r: r.last - r.first)


def _drive_pieces(drive: Drive, t: Array) -> tuple[tuple[tuple[float, float, float], ...], float, float]:
    """Return the pieces of the drive during the run, and its smallest and largest velocity."""
    starts = [float(t[0]), *(b for b in drive.breaks if t[0] < b < t[-1])]
    pieces, values = [], []
    for begin, end in zip(starts, [*starts[1:], float(t[-1])], strict=True):
        V, rate, since = drive.piece(begin)
        pieces.append((begin, V + rate * (begin - since), rate))
        values += [V + rate * (begin - since), V + rate * (end - since)]
    return tuple(pieces), min(values), max(values)


def load_history(load: Load, t: Array) -> LoadHistory:
    """Return mean, range, rate and modulation of a load over the times `t`."""
    W, W_dot = load(t)
    return LoadHistory(
        float(W.mean()), float(W.min()), float(W.max()), float(np.abs(W_dot / W).max()), find_modulation(t, W)
    )
