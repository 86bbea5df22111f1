"""The driving velocity of a run: from its description, from a column of velocities, or from one of displacements."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from srfcli.errors import SrfError
from srfcli.numerics.program import Drive
from srfcli.recording.columns import Columns
from srfcli.recording.description import RunDescription
from srfcli.recording.segments import coloured_noise, corners, local_noise, split
from srfcli.recording.values import Array, Notice

DIFFERS = 0.05  # relative difference from a column that is told


def declared_drive(run: RunDescription, columns: Columns, t: Array) -> Drive:
    """Return the drive that the description lists, which begins at the first sample of the file."""
    assert run.drive is not None
    ends = columns.first + np.cumsum([duration for duration, _ in run.drive])
    interval = float(np.median(np.diff(t)))
    if ends[-1] < t[-1] - 1.5 * interval:
        run.node.child("drive").fail(
            f"the drive lasts {ends[-1] - columns.first:.7g} s, the recording {t[-1] - columns.first:.7g} s",
            "Let the durations add up to the recording, or end it with window = [from, to].",
        )
    starts = [columns.first, *ends[:-1].tolist()]
    return Drive.steps(list(zip(starts, (v for _, v in run.drive), strict=True)))


def check_start(run: RunDescription, drive: Drive, begin: float) -> None:
    """Raise SrfError where a run that is to begin in steady sliding is not driven forward at first."""
    V, rate, since = drive.piece(begin)
    if run.initial == "steady" and not V + rate * (begin - since) > 0:
        where = run.node.child("drive").where if run.drive is not None else run.node.where
        raise SrfError(
            f"{where}: the drive begins with {V:g} um/s, so that there is no steady sliding to begin with",
            'Write initial = "free": the initial state is then estimated. Or take a window that begins in sliding.',
        )


def drive_differs(drive: Drive, t: Array, V: Array, where: str) -> list[Notice]:
    """Return a notice where a column of velocities is not what the declared drive says, beyond the moments of its steps."""
    known = np.isfinite(V)
    told = drive(t)
    scale = max(float(np.abs(told).max()), 1e-12)
    off = known & (np.abs(V - told) > DIFFERS * np.maximum(np.abs(told), 1e-3 * scale))
    if off.sum() <= max(2 * len(drive.times), 0.02 * t.size):
        return []
    at = int(np.argmax(off))
    what = (
        f"{int(off.sum())} of {t.size} velocities differ from the declared drive by more than 5 %, the first {V[at]:.5g} "
        f"against {told[at]:.5g} um/s at t = {t[at]:.6g} s; the declared drive counts"
    )
    return [Notice("drive-differs", where, what)]


def drive_from_column(role: str, t: Array, values: Array, where: str) -> tuple[Drive, list[Notice]]:
    """Return the drive in the column of that role, and how it was found."""
    return (drive_from_velocity if role == "load_point_velocity" else drive_from_displacement)(t, values, where)


def drive_from_velocity(t: Array, V: Array, where: str) -> tuple[Drive, list[Notice]]:
    """Return the drive in a column of velocities: steps where it is constant between changes, else straight pieces.

    A sample's velocity holds from its time to the next, so that a column written from displacements keeps them.
    """
    known = np.isfinite(V)
    if not known.any():
        raise SrfError(f"{where}: no velocity in it", "Give the run a drive, or the column its numbers.")
    notices = []
    if not known.all():
        what = f"{int((~known).sum())} samples without a velocity; the one before holds on"
        notices.append(Notice("nan", where, what))
    t, V = t[known], V[known]
    changes = np.flatnonzero(np.diff(V) != 0) + 1
    if changes.size <= max(20, V.size // 20):
        return Drive.steps([(t[0], V[0]), *((t[i], V[i]) for i in changes)]), notices
    noise = float(np.median(local_noise(V)))
    span = float(np.ptp(V))
    if noise < 1e-5 * span:
        return _straight_velocities(t, V, 1e-5 * span), notices
    drive, number = _segmented(t, V)
    what = f"the velocities are noisy (standard deviation {noise:.3g} um/s); {number} constant or straight pieces describe them"
    return drive, [*notices, Notice("drive-segmented", where, what)]


def _straight_velocities(t: Array, V: Array, rounding: float) -> Drive:
    """Return mean velocities from sample to sample as ramps where they change evenly, else one by one."""
    slopes = np.diff(V) / np.diff(t)
    times, velocities, rates = [], [], []
    i, n = 0, V.size
    while i < n:
        j = i + 1
        while j < n - 1 and abs(slopes[j] - slopes[i]) * (t[j + 1] - t[i]) <= 4 * rounding:
            j += 1
        if j < n and j - i >= 3:
            rate = float((V[j] - V[i]) / (t[j] - t[i]))
            times.append(t[i])
            velocities.append(V[i] - rate * (t[i + 1] - t[i]) / 2)  # the mean over an interval is that of its middle
            rates.append(rate)
            i = j
        else:
            times.append(t[i])
            velocities.append(V[i])
            rates.append(0.0)
            i += 1
    return Drive(tuple(map(float, times)), tuple(map(float, velocities)), tuple(rates))


def _segmented(t: Array, V: Array) -> tuple[Drive, int]:
    """Return straight pieces of a noisy velocity, constant where a slope is not needed, and their number."""
    sigma = coloured_noise(t, V)
    penalty = 3 * np.log(V.size)
    breaks = split(t, V, sigma, straight=True, penalty=penalty)
    pieces = [_piece(t[a:b], V[a:b], sigma[a:b], penalty) for a, b in pairwise([0, *breaks, V.size])]
    times = [t[0], *(t[b] for b in breaks)]
    return Drive(tuple(map(float, times)), tuple(v for v, _ in pieces), tuple(s for _, s in pieces)), len(pieces)


def _piece(t: Array, V: Array, sigma: Array, penalty: float) -> tuple[float, float]:
    w = 1 / sigma**2
    mean, middle = float(np.average(V, weights=w)), float(np.average(t, weights=w))
    spread = float((w * (t - middle) ** 2).sum())
    slope = float((w * (t - middle) * (V - mean)).sum()) / spread
    if slope**2 * spread < penalty / 3:
        return mean, 0.0
    return mean + slope * (float(t[0]) - middle), slope


def drive_from_displacement(t: Array, X: Array, where: str) -> tuple[Drive, list[Notice]]:
    """Return the drive in a column of displacements: the slopes of a continuous line of straight pieces through it."""
    known = np.isfinite(X)
    if known.sum() < 8:
        raise SrfError(f"{where}: {int(known.sum())} displacements in it", "Give the run a drive.")
    notices = []
    if not known.all():
        notices.append(
            Notice("nan", where, f"{int((~known).sum())} samples without a displacement; a line bridges them")
        )
    line = corners(t[known], X[known])
    for at, size in line.jumps:
        what = (
            f"the displacement jumps by {size:.4g} um after t = {t[known][at]:.7g} s: its transducer's doing, taken out"
        )
        notices.append(Notice("reset", where, what))
    slopes = np.diff(line.heights) / np.diff(line.knots)
    drive = Drive.steps(list(zip([float(t[0]), *line.knots[1:-1].tolist()], slopes.tolist(), strict=True)))
    told = ", ".join(f"{v:.5g}" for v in slopes[:12]) + (", ..." if slopes.size > 12 else "")
    what = (
        f"a continuous line of {_count(slopes.size)}, {told} um/s, fitted through the displacements, "
        f"from which they differ by {line.misfit:.3g} um (rms)"
    )
    return drive, [*notices, Notice("drive-fitted", where, what)]


def _count(number: int) -> str:
    return f"{number} straight piece" + ("s" if number != 1 else "")
