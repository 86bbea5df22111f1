"""What was imposed in a run: driving velocity and normal load, from columns or from the description."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from srfcli.codegen.model import Array
from srfcli.core.errors import NoContact, Notice, SrfError
from srfcli.core.units import is_stress
from srfcli.data.clock import Place, kept_samples
from srfcli.data.columns import DRIVES, MOST_BYTES, Columns, Finder, open_source
from srfcli.data.description import RunDescription
from srfcli.data.noise import NOISE_SAMPLES, deviations, quantisation, saturation, spikes, white_level
from srfcli.data.values import OBSERVABLES, Declared
from srfcli.laws.registry import Registry
from srfcli.motion.imposed import ConstantLoad, Drive, Load, Modulation, SampledLoad, UnknownLoad, runs_of

# The driving velocity of a run: from its description, from a column of velocities, or from one of displacements.

DIFFERS = 0.05  # relative difference from a column that is told


def drive_of(run: RunDescription, columns: Columns) -> tuple[Drive, list[Notice], tuple[float, ...]]:
    """Return the drive that a run declares, else that of its column, what is to be told of it, and when it may have been reset.

    Raises SrfError for a run that slides in both directions.
    """
    t, role = columns.seconds, columns.role(*DRIVES)
    if run.drive is not None:
        declared = declared_drive(run, columns, run.drive)
        told = [] if role is None else drive_differs(declared, t, columns.arrays[role], columns.place(role).column)
        return declared, told, ()
    assert role is not None  # `read_columns` asks for one of the two
    values, where = columns.arrays[role], columns.place(role).column
    if found := strokes(columns):
        turn = found[1] if len(found) > 1 else found[0]
        raise SrfError(
            f"{run.node.where}: the drive turns back before t = {turn.begin:.6g} s and slides there; "
            "a run slides in one direction",
            f"Make a run of each stroke: window = [{turn.begin:.6g}, {turn.end:.6g}] and, of a backward one, "
            f'direction = "backward"; `srf new {run.file.name}` writes them.',
        )
    if role == "load_point_velocity":
        return *drive_from_velocity(t, values, where), ()
    channel = columns.channels[role]
    unit = channel.factor * channel.spec.scale
    steps = abs(unit) * written_steps(values / unit - channel.spec.offset / channel.spec.scale)
    return drive_from_displacement(t, values, where, correct="reset" in run.corrections, steps=steps)


def declared_drive(run: RunDescription, columns: Columns, pieces: Sequence[tuple[float, float]]) -> Drive:
    """Return the drive that the description lists, which begins at the first sample of the file."""
    t = columns.seconds
    ends = columns.first + np.cumsum([duration for duration, _ in pieces])
    interval = float(np.median(np.diff(t)))
    if ends[-1] < t[-1] - 1.5 * interval:
        run.node.child("drive").fail(
            f"the drive lasts {ends[-1] - columns.first:.7g} s, the recording {t[-1] - columns.first:.7g} s",
            "Let the durations add up to the recording, or end it with window = [from, to].",
        )
    starts = [columns.first, *ends[:-1].tolist()]
    return Drive.steps(list(zip(starts, (v for _, v in pieces), strict=True)))


class StartsAtRest(SrfError):
    """A run that is to begin in steady sliding is not driven forward at first; `run` is its name."""

    run = ""


def check_start(run: RunDescription, drive: Drive, begin: float) -> None:
    """Raise StartsAtRest where a run that is to begin in steady sliding is not driven forward at first."""
    V = drive.at(begin)
    if run.initial == "steady" and not V > 0:
        where = run.node.child("drive").where if run.drive is not None else run.node.where
        error = StartsAtRest(
            f"{where}: the drive begins with {V:g} um/s, so that there is no steady sliding to begin with",
            'Write initial = "free": the initial state is then estimated. Or take a window that begins in sliding.',
        )
        error.run = run.name
        raise error


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
    pieces: list[tuple[float, float, float]] = []
    i, n = 0, V.size
    while i < n:
        j = i + 1
        while j < n - 1 and abs(slopes[j] - slopes[i]) * (t[j + 1] - t[i]) <= 4 * rounding:
            j += 1
        if j < n and j - i >= 3:
            rate = float((V[j] - V[i]) / (t[j] - t[i]))
            half = rate * (t[i + 1] - t[i]) / 2  # the mean over an interval is that of its middle
            pieces.append((float(t[i]), float(V[i] - half), rate))
            i = j
        else:
            pieces.append((float(t[i]), float(V[i]), 0.0))
            i += 1
    return Drive(*zip(*pieces, strict=True))


def _segmented(t: Array, V: Array) -> tuple[Drive, int]:
    """Return straight pieces of a noisy velocity, constant where a slope is not needed, and their number."""
    sigma = coloured_noise(t, V, local_noise(V), quantisation(V))
    penalty = 3 * np.log(V.size)
    breaks = split(t, V, sigma, penalty)
    pieces = [_piece(t[a:b], V[a:b], sigma[a:b], penalty) for a, b in pairwise([0, *breaks, V.size])]
    times = [t[0], *(t[b] for b in breaks)]
    return Drive(tuple(map(float, times)), tuple(v for v, _ in pieces), tuple(s for _, s in pieces)), len(pieces)


def _piece(t: Array, V: Array, sigma: Array, penalty: float) -> tuple[float, float]:
    w = 1 / sigma**2
    mean, middle = float(np.average(V, weights=w)), float(np.average(t, weights=w))
    spread = float((w * (t - middle) ** 2).sum())
    slope = float((w * (t - middle) * (V - mean)).sum()) / spread
    if slope**2 * spread < penalty / 3:
        return (mean if mean**2 * float(w.sum()) > penalty / 3 else 0.0), 0.0  # a hold
    return mean + slope * (float(t[0]) - middle), slope


MOST_FIGURES = 12  # of a number that was written: more are those of arithmetic


def written_steps(x: Array) -> Array:
    """Return the step of the last figure (n,) with which each number of x (n,) was written, 0 where they show no decimals.

    They have as many decimals each, or as many significant figures: those of the number that has most.
    """
    size = np.abs(x)
    seen = np.isfinite(x) & (size > 0)
    if not seen.any():
        return np.zeros(x.shape)
    decade = np.floor(np.log10(size[seen]))
    figures = np.full(decade.size, MOST_FIGURES + 1.0)
    for n in range(MOST_FIGURES, 0, -1):
        unit = 10.0 ** (decade + 1 - n)
        figures[np.abs(size[seen] - np.round(size[seen] / unit) * unit) < 8 * np.spacing(size[seen])] = n
    if figures.max() > MOST_FIGURES:
        return np.zeros(x.shape)
    least = float((10.0 ** (decade + 1 - figures)).min())
    steps = np.full(x.shape, least)
    steps[seen] = np.maximum(least, 10.0 ** (decade + 1 - figures.max()))
    return steps


def drive_from_displacement(
    t: Array, X: Array, where: str, *, correct: bool = False, steps: Array | float = 0.0
) -> tuple[Drive, list[Notice], tuple[float, ...]]:
    """Return the drive in a column of displacements: the slopes of a continuous line of straight pieces through it.

    With `correct` level jumps of the transducer are taken out; else they are told, and the times (s) at which they begin
    returned. `steps` (n,) are those with which the numbers were written.
    """
    known = np.isfinite(X)
    if known.sum() < 8:
        raise SrfError(f"{where}: {int(known.sum())} displacements in it", "Give the run a drive.")
    notices = []
    if not known.all():
        notices.append(Notice("nan", where, f"{int((~known).sum())} samples without a displacement; a line bridges them"))
    line = corners(t[known], X[known], correct=correct, steps=np.broadcast_to(steps, X.shape)[known])
    for at, size in line.jumps:
        done = "taken out as a transducer's" if correct else 'left as it is; corrections = ["reset"] takes it out'
        what = f"the displacement jumps by {size:.4g} um after t = {t[known][at]:.7g} s: {done}"
        notices.append(Notice("reset", where, what))
    way = np.diff(line.heights)
    readings = np.maximum(np.histogram(t[known], line.knots)[0], 1)
    way[np.abs(way) < line.misfit * np.sqrt(12 * np.log(known.sum()) / readings)] = 0.0  # a hold: as in `_piece`
    slopes = way / np.diff(line.knots)
    drive = Drive.steps(list(zip([float(t[0]), *line.knots[1:-1].tolist()], slopes.tolist(), strict=True)))
    pieces = "straight piece" if slopes.size == 1 else "straight pieces"
    told = ", ".join(f"{v:.5g}" for v in slopes[:12]) + (", ..." if slopes.size > 12 else "")
    what = (
        f"a continuous line of {slopes.size} {pieces}, {told} um/s, fitted through the displacements, "
        f"from which they differ by {line.misfit:.3g} um (rms)"
    )
    kind = "drive-fitted"
    moved = X[known]
    for at, size in line.jumps if correct else ():
        moved[at + 1 :] -= size
    bends = line.misfit > 2 * line.noise and _bends(t[known], moved, line)
    if bends or line.misfit > OFF_THE_LINE * line.noise:
        curve = _smooth_drive(t[known], moved)
        left = float(np.std(moved - curve.displacement(t[known])))
        if left < line.misfit / (2 if bends else NEARER):  # else the line leaves noise, of rounded times, say
            drive, kind = curve, "drive-smoothed"
            what = (
                f"a smooth curve, {drive(t).min():.5g} to {drive(t).max():.5g} um/s, goes through the displacements, from which "
                f"they differ by {left:.3g} um (rms), {line.misfit:.3g} from {slopes.size} {pieces}; if the stage went evenly, "
                "look at the column, or state the run's drive"
            )
    back = int(np.argmin(way))
    if -way[back] > line.misfit:
        told = f"{-way[back]:.3g} um at t = {line.knots[back]:.7g} s"
        what += f"; it goes back by {told}: state the run's drive if the stage did not"
    resets = () if correct else tuple(float(t[known][at]) for at, _ in line.jumps)
    return drive, [*notices, Notice(kind, where, what)], resets


def _bends(t: Array, X: Array, line: Line) -> bool:
    """Return whether a spline of as many numbers as the line leaves less than half of what the line leaves of X (n,)."""
    from scipy.interpolate import make_lsq_spline

    inner = np.linspace(t[0], t[-1], 2 * line.knots.size)[1:-1]
    try:
        spline = make_lsq_spline(t, X, np.concatenate([[t[0]] * 4, inner, [t[-1]] * 4]), k=3)
    except ValueError:  # no reading between two of its knots
        return False
    return bool(np.std(X - spline(t)) < line.misfit / 2)


def _smooth_drive(t: Array, X: Array) -> Drive:
    """Return a drive whose velocity changes evenly between many times, by a smooth curve through displacements X (n,).

    The curve is the one that a load has: with noise a smoothing spline, else it goes through the displacements.
    """
    noise, size = max(white_level(X, t), quantisation(X)), float(np.ptp(X))
    noise = noise if noise > LEAST_NOISE * size else 0.0
    curve = SampledLoad(t, X - X.min() + size, noise=noise)  # of positive numbers
    allowed = max(noise / 10, SMOOTHEST * size)
    pieces: list[tuple[float, float, float]] = []
    for begin, h, row in zip(curve.knots[:-1], np.diff(curve.knots), curve.coefficients, strict=True):
        way = np.polynomial.Polynomial(row)
        bend = float(np.abs(way.deriv(3)(np.linspace(0.0, h, 5))).max())
        # a cubic leaves the ramp that has its ends and its mean slope by bend h^3 / (72 sqrt 3) at most
        count = int(np.clip(np.ceil(h * np.cbrt(bend / (72 * np.sqrt(3.0) * allowed))), 1, MOST_RAMPS))
        ends = np.linspace(0.0, h, count + 1)
        rates = way.deriv(2)(0.5 * (ends[:-1] + ends[1:]))
        V = np.diff(way(ends)) / np.diff(ends) - 0.5 * rates * np.diff(ends)  # displacements at the ends are those of the curve
        pieces += zip((begin + ends[:-1]).tolist(), V.tolist(), rates.tolist(), strict=True)
    return Drive(*zip(*pieces, strict=True))


# A drive that turns back: the laws hold for sliding in one direction, so that each stroke is a run of its own.

STROKE_TURN = 0.2  # of the range of displacements: a turn by less begins no stroke
OPPOSED = 0.5  # of the median observable: above it the slider slides, or is about to


@dataclass(frozen=True)
class Stroke:
    """Sliding in one direction from `begin` to `end` s; after a turn it begins where the force reaches half its usual size."""

    begin: float
    end: float
    backward: bool


def strokes(columns: Columns, speed: float = 0.0) -> list[Stroke]:
    """Return the strokes of a recording whose drive turns back and slides there; none where it only goes on or unloads.

    Without a column of the load point's displacement or velocity it moves at `speed` um/s, and the sign of the observable tells
    where it turns. After a turn the slider sticks while the spring is unloaded, so that what comes before the change of sign of
    the observable is left out.
    """
    t, arrays = columns.seconds, columns.arrays
    observed = arrays[next(role for role in OBSERVABLES if role in arrays)]
    if "load_point_displacement" in arrays:
        moved = arrays["load_point_displacement"]
    else:
        V = arrays.get("load_point_velocity", np.full(t.size, speed))
        moved = np.concatenate([[0.0], np.cumsum(np.where(np.isfinite(V[:-1]), V[:-1], 0.0) * np.diff(t))])
    known = np.isfinite(moved) & np.isfinite(observed)
    t, x, y = t[known], moved[known], observed[known]
    if t.size < 2 * FEWEST_OF_PIECE or not np.ptp(x) > 0:
        return []
    turns = _turns(x, STROKE_TURN * float(np.ptp(x)))
    usual = float(np.median(np.abs(y)))
    signed = bool(turns)  # a drive may be recorded without its sign: then the observable has it
    turns = turns or _turned(y, usual)
    found, slid = [], [False, False]
    for first, last in pairwise([0, *turns, t.size - 1]):
        backward = bool(x[last] < x[first] if signed else np.median(y[first : last + 1]) < 0)
        shear = -y[first : last + 1] if backward else y[first : last + 1]
        slid[backward] |= bool(np.median(shear[shear.size // 2 :]) > OPPOSED * usual)
        opposed = np.flatnonzero(shear <= OPPOSED * usual)
        opposed = opposed[opposed < shear.size // 2]  # after that, what falls short is stick-slip
        begin = first + (int(opposed[-1]) + 1 if first and opposed.size else 0)
        if last - begin >= 4 * FEWEST_OF_PIECE:
            found.append(Stroke(float(f"{t[begin]:.10g}"), float(f"{t[last - 1]:.10g}"), backward))
    return found if all(slid) and turns else []


def _turned(y: Array, usual: float) -> list[int]:
    """Return the last samples at which y (n,) is what it usually is in a stroke, before each change of its sign."""
    from scipy.ndimage import median_filter

    calm = median_filter(y, size=2 * FEWEST_OF_PIECE + 1, mode="nearest")
    far = np.flatnonzero(np.abs(calm) > OPPOSED * usual)
    turns, begin = [], 0
    for i in far[:-1][calm[far[1:]] * calm[far[:-1]] < 0].tolist():
        shear = y[begin : i + 1] * np.sign(calm[i])
        turns.append(begin + int(np.flatnonzero(shear >= np.median(shear[shear > OPPOSED * usual]))[-1]))
        begin = i + 1
    return turns


def _turns(x: Array, least: float) -> list[int]:
    """Return the indices of the extremes between which x (n,) moves by more than `least`, without the two ends."""
    turns, extreme, rising = [], 0, 0  # one pass: an extreme counts once x has come back from it by `least`
    for i, value in enumerate(x.tolist()):
        if rising == 0 and abs(value - x[0]) > least:
            rising, extreme = (1 if value > x[0] else -1), i
        elif rising and rising * (value - x[extreme]) > 0:
            extreme = i
        elif rising and rising * (x[extreme] - value) > least:
            turns.append(extreme)
            rising, extreme = -rising, i
    return turns


# Straight pieces in a noisy record, as many as the record supports and no more (Bayesian information criterion).

FEWEST_OF_PIECE = 5  # samples of a piece, or as many usual sampling intervals where samples are rare
CORNER_ROUNDS = 40  # of the search for the places of the corners
NOISE_STRETCH = 128  # samples over which noise has its colour
BURST = NOISE_STRETCH  # samples of a burst of noise, at most
CORNER = 4.0  # factor by which a corner lowers the squares of a stretch's residual, and the colour of noise does not
MOST_CORNERS = 4  # of a stretch
AROUND = 15  # neighbouring stretches from which the noise of one is estimated
CLEAR = 8.0  # standard deviations about the lines beside it that a level jump exceeds
SAMPLES_BESIDE = 200  # samples on each side by which a jump is told from a corner
EVEN = 1e-5  # of the largest noise, at least: with smaller ones the rest would be lost in rounding
LEAST_NOISE = 1e-100  # um or um/s: a noise whose square is still a number
OFF_THE_LINE = 30.0  # times its noise that a displacement differs from the line, from where a smooth curve takes its place
NEARER = 5.0  # times less that a smooth curve leaves than the line, from where it takes its place
MOST_RAMPS = 64  # of velocity, to one piece of that curve
SMOOTHEST = 1e-6  # of the displacement's range, by which they may differ from the curve
WOBBLE = 0.02  # relative change of slope below which there is no corner


@dataclass(frozen=True)
class Line:
    """A continuous line: `heights` at the rising `knots` (k,), its rms misfit, and the (sample before, size) of level jumps."""

    knots: Array
    heights: Array
    misfit: float
    noise: float  # white, rounding included
    jumps: tuple[tuple[int, float], ...]


def local_noise(x: Array) -> Array:
    """Return the standard deviation of white noise near each sample of x (n,), from its third differences."""
    from scipy.ndimage import median_filter

    if x.size < 8:
        return np.full(x.size, max(float(np.std(x)), LEAST_NOISE) if np.ptp(x) else 1.0)
    third = np.abs(np.diff(x, 3)) / np.sqrt(20.0)  # the sum of the squared weights 1, 3, 3, 1
    # the level at an end is not that of its last sample
    level = median_filter(third, size=min(NOISE_SAMPLES, third.size), mode="reflect") / 0.6745
    padded = np.concatenate([[level[0]], level, [level[-1]] * 2])
    overall = float(np.median(third)) / 0.6745
    span = float(np.ptp(x)) or 1.0
    return np.maximum(padded, max(0.05 * overall, 1e-9 * span, LEAST_NOISE))


def split(t: Array, x: Array, sigma: Array, penalty: float) -> list[int]:
    """Return the indices at which straight pieces of x (n,) over t begin, other than the first.

    A piece is split where that lowers the weighted sum of squares by more than `penalty`.
    """
    interval = float(np.median(np.diff(t)))
    ends = np.append(t, t[-1] + interval)
    found: list[int] = []
    waiting = [(0, t.size)]
    while waiting:
        a, b = waiting.pop()
        places = np.arange(a + 2, b - 1)
        least = (FEWEST_OF_PIECE - 0.01) * interval
        places = places[(t[places] - t[a] > least) & (ends[b] - t[places] > least)]
        if places.size == 0:
            continue
        gain = _split_gain(t[a:b], x[a:b], sigma[a:b], places - a)
        if gain.max() > penalty:
            place = int(places[np.argmax(gain)])
            found.append(place)
            waiting += [(a, place), (place, b)]
    return sorted(found)


def _split_gain(t: Array, x: Array, sigma: Array, places: NDArray[np.int64]) -> Array:
    """Return by how much the weighted sum of squares about a line falls where another line begins at each of the `places`."""
    w = 1.0 / sigma**2
    s = t - np.average(t, weights=w)
    rest = x - np.average(x, weights=w)
    rest = rest - s * (np.sum(w * s * rest) / np.sum(w * s * s))  # of what is left, running sums lose no figures
    sums = [np.concatenate([[0.0], np.cumsum(c)]) for c in (w, w * s, w * s * s, w * rest, w * s * rest)]

    def explained(part: Sequence[Array]) -> Array:
        """Return what the best line through a part takes off its sum of squares."""
        w, ws, wss, wx, wsx = part
        spread, cross = wss - ws * ws / w, wsx - ws * wx / w
        return np.asarray(wx * wx / w + np.divide(cross * cross, spread, out=np.zeros_like(cross), where=spread > 0))

    return explained([c[places] for c in sums]) + explained([c[-1] - c[places] for c in sums])


def coloured_noise(t: Array, x: Array, sigma: Array, step: float) -> Array:
    """Return for each sample the standard deviation of white noise that misfits a line as much as the noise in x (n,) does.

    `sigma` (n,) is the white noise near each sample, `step` that of an encoder.

    The noise is the residual of parabolas over 128 samples, in the upper quartile of fifteen stretches: a gauge's bursts count.
    Corners and level jumps do not: what lowers a stretch's residual by a factor of CORNER is no noise.
    """
    from scipy.ndimage import percentile_filter

    length = min(NOISE_STRETCH, x.size)
    starts = np.arange(0, x.size - length + 1, length)
    found = np.empty(starts.size)
    for k, at in enumerate(starts.tolist()):
        part = slice(at, at + length)
        z = _without_corners(t[part], x[part], step) / sigma[part]
        power = float(z @ z)
        rho = min(max(float(z[1:] @ z[:-1]) / power, 0.0), 0.98) if power > 0 else 0.0
        found[k] = power / max(length - 3, 1) * (1 + rho) / (1 - rho)
    if found.size >= AROUND:
        near = percentile_filter(found, 75, size=AROUND, mode="reflect")
    else:
        near = np.full(found.size, np.median(found))
    stretch = np.minimum(np.arange(x.size) // length, near.size - 1)
    whole = sigma * np.sqrt(np.maximum(near[stretch], 1.0))
    return np.asarray(np.maximum(whole, EVEN * float(whole.max())))


def _without_corners(t: Array, x: Array, step: float) -> Array:
    """Return the residual (n,) of a parabola through x over t, less the corners and level jumps that explain most of it.

    A jump by the `step` of an encoder is none.
    """
    place = (t - t.mean()) / max(float(np.ptp(t)), 1e-300)
    edges = 0.5 * (place[1:] + place[:-1])[1 : 1 - FEWEST_OF_PIECE // 2]
    after = place[:, None] > edges
    columns = np.concatenate([np.where(after, place[:, None] - edges, 0.0), after.astype(float)], axis=1)
    basis, rest = np.linalg.qr(np.vander(place, 3))[0], x - x.mean()
    rest = rest - basis @ (basis.T @ rest)
    columns -= basis @ (basis.T @ columns)
    kept, power = rest, float(rest @ rest)
    for number in range(1, MOST_CORNERS + 1):
        sizes = np.maximum(np.sum(columns**2, axis=0), 1e-300)
        gains = (columns.T @ rest) ** 2 / sizes
        best = int(np.argmax(gains))
        direction = columns[:, best] / np.sqrt(sizes[best])
        along = float(direction @ rest)
        if best >= edges.size and abs(along) / np.sqrt(sizes[best]) < 1.5 * step:
            break
        rest = rest - direction * along
        if float(rest @ rest) < power / CORNER**number:  # two that are a ramp may do so together
            kept = rest
        columns -= np.outer(direction, direction @ columns)
    return kept


def corners(t: Array, x: Array, *, correct: bool = True, steps: Array | float = 0.0) -> Line:
    """Return the continuous line of straight pieces that x (n,) over t supports, and the level jumps in x.

    A level jump is more than four steps of an encoder, and of the `steps` (n,) with which the numbers near it were written.
    With `correct` the jumps are taken out of x first, in place. The Bayesian information criterion chooses the number of pieces;
    the noise enters it with its correlation over 128 samples. Least squares place the knots. A change of slope by less than 2 %
    comes from the servo and is not followed.
    """
    white, step = local_noise(x), quantisation(x)
    sigma = coloured_noise(t, x, white, step)
    penalty, jumps = 3 * np.log(t.size), []
    least = 4 * np.maximum(step, np.broadcast_to(steps, x.shape))
    for _ in range(4):
        breaks = split(t, x, sigma, penalty)
        found = [jump for jump in _jumps(t, x, sigma, breaks, penalty) if abs(jump[1]) > least[jump[0]]]
        jumps += found
        if not found or not correct:
            break
        for at, size in found:
            x[at + 1 :] -= size
    knots = np.concatenate([t[:1], _places(t, x, breaks), t[-1:]])
    for _ in range(3):
        knots = _pruned(t, x, sigma, knots, penalty)
        knots, heights = _polished(t, x, sigma, knots)
        calm = _without_bursts(t, sigma, knots, heights)
        if calm.size == knots.size:
            break
        knots, heights = _polished(t, x, sigma, calm)
    knots = _pruned(t, x, sigma, knots, penalty)
    knots, heights = _polished(t, x, sigma, knots)
    misfit = float(np.sqrt(np.mean((x - np.interp(t, knots, heights)) ** 2)))
    return Line(knots, heights, misfit, max(float(np.median(white)), step / np.sqrt(12.0)), tuple(sorted(jumps)))


def _without_bursts(t: Array, sigma: Array, knots: Array, heights: Array) -> Array:
    """Return the knots without those of bursts: of BURST samples or fewer, after which the line continues as before.

    A hold is no burst: after it the line continues later.
    """
    slopes = np.diff(heights) / np.diff(knots)
    places = np.searchsorted(t, knots)
    keep = np.ones(knots.size, bool)
    for i in range(1, knots.size - 2):
        for j in range(i + 1, int(np.searchsorted(places[: knots.size - 1], places[i] + BURST, side="right"))):
            before, after = slopes[i - 1], slopes[j]
            if abs(after - before) > 0.1 * max(abs(before), abs(after)):
                continue
            late = heights[j] - heights[i] - 0.5 * (before + after) * (knots[j] - knots[i])
            if abs(late) < 6 * sigma[min(places[i], sigma.size - 1)]:
                keep[i : j + 1] = False
    return knots[keep]


def _jumps(t: Array, x: Array, sigma: Array, breaks: list[int], penalty: float) -> list[tuple[int, float]]:
    """Return (sample before, size) of the breaks where two lines fit so much better than a bent one that the level jumps.

    Breaks a few samples apart are one jump, with samples on its way.
    """
    groups: list[list[int]] = []
    for at in breaks:
        if groups and at - groups[-1][-1] < 2 * FEWEST_OF_PIECE:
            groups[-1].append(at)
        else:
            groups.append([at])
    found = []
    for k, group in enumerate(groups):
        first, last = group[0], group[-1]
        a = max(groups[k - 1][-1] if k else 0, first - SAMPLES_BESIDE)
        b = min(groups[k + 1][0] if k + 1 < len(groups) else t.size, last + SAMPLES_BESIDE)
        if min(first - a, b - last) < 2 * FEWEST_OF_PIECE:
            continue
        at = first - 1 + int(np.argmax(np.abs(np.diff(x[first - 1 : last + 1]))))
        middle = 0.5 * (t[at] + t[at + 1])
        near = np.r_[a:first, last:b]
        lines = [np.polyfit(t[i:j] - middle, x[i:j], 1, w=1 / sigma[i:j]) for i, j in ((a, first), (last, b))]
        fits = np.concatenate([np.polyval(lines[0], t[a:first] - middle), np.polyval(lines[1], t[last:b] - middle)])
        apart = float((((x[near] - fits) / sigma[near]) ** 2).sum())
        bent = _polished(t[near], x[near], sigma[near], np.array([t[a], middle, t[b - 1]]))
        together = float((((x[near] - np.interp(t[near], *bent)) / sigma[near]) ** 2).sum())
        alike = abs(lines[1][0] - lines[0][0]) < 0.2 * max(abs(lines[0][0]), abs(lines[1][0]))
        size = float(lines[1][1] - lines[0][1])
        # the motion goes on as before, and the jump stands out of the scatter and happens at once
        clear = abs(size) > CLEAR * float(np.std(x[near] - fits)) and abs(x[at + 1] - x[at]) > 0.5 * abs(size)
        if together - apart > penalty and alike and clear:
            found.append((at, size))
    return found


def _places(t: Array, x: Array, breaks: list[int]) -> Array:
    """Return where neighbouring lines meet, or the break itself where they meet elsewhere.

    Both ends of a gap in which they do not meet: a hold may be logged by its ends alone.
    """
    edges, usual = [0, *breaks, t.size], float(np.median(np.diff(t)))
    lines = [np.polyfit(t[a:b] - t[a], x[a:b], 1) for a, b in pairwise(edges)]
    found: list[float] = []
    for k, at in enumerate(breaks):
        (s0, c0), (s1, c1) = lines[k], lines[k + 1]
        level = c0 + s0 * (t[edges[k + 1]] - t[edges[k]])
        meet = t[at] + ((level - c1) / (s1 - s0) if s1 != s0 else 0.0)
        low, high = (found[-1] if found else t[0]), t[edges[k + 2] - 1]
        if t[at] - t[at - 1] > FEWEST_OF_PIECE * usual and not t[at - 1] <= meet <= t[at]:
            found += [float(t[at - 1]), float(t[at])]
            continue
        found.append(float(meet if low < meet < high else t[at]))
    return np.unique(found)


def _pruned(t: Array, x: Array, sigma: Array, knots: Array, penalty: float) -> Array:
    """Return the knots that the line needs: those without which its misfit grows by more than the penalty allows."""
    costs = [_cost_without(t, x, sigma, knots, k) for k in range(1, knots.size - 1)]
    while costs:
        weakest = int(np.argmin(costs))
        if costs[weakest] > penalty * 2 / 3:
            break
        knots = np.delete(knots, weakest + 1)
        if costs[weakest] == 0.0:  # two knots of a ramp that stood too close to another move apart
            low, high = max(weakest - 1, 0), min(weakest + 3, knots.size)
            a, b = np.searchsorted(t, knots[[low, high - 1]])
            near = slice(int(a), int(b) + 1)
            if high - low > 2 and int(b) + 1 - int(a) > 4 * (high - low):
                knots = knots.copy()
                knots[low:high] = _polished(t[near], x[near], sigma[near], knots[low:high])[0]
        del costs[weakest]
        for k in range(max(weakest - 3, 0), min(weakest + 3, len(costs))):
            costs[k] = _cost_without(t, x, sigma, knots, k + 1)
    return knots


def _cost_without(t: Array, x: Array, sigma: Array, knots: Array, k: int) -> float:
    """Return by how much the misfit rises without knot k, judged by the samples of the two pieces on each side of it.

    It is 0 where the slope hardly changes at the knot, or a piece beside it is shorter than five usual sampling intervals.
    """
    low, high = max(k - 2, 0), min(k + 2, knots.size - 1)
    a, b = np.searchsorted(t, [knots[low], knots[high]])
    near = slice(int(a), max(int(b) + 1, int(a) + 2))
    kept = knots[low : high + 1]
    few = np.diff(np.searchsorted(t, knots[k - 1 : k + 2])) < FEWEST_OF_PIECE
    if few.any() and np.any(few & (np.diff(knots[k - 1 : k + 2]) < FEWEST_OF_PIECE * np.median(np.diff(t)))):
        return 0.0
    heights, misfit = _heights(t[near], x[near], sigma[near], kept)
    slopes = np.diff(heights) / np.diff(kept)
    before, after = slopes[k - low - 1], slopes[k - low]
    if abs(after - before) < WOBBLE * max(abs(before), abs(after)):
        return 0.0
    return _heights(t[near], x[near], sigma[near], np.delete(kept, k - low))[1] - misfit


def _heights(t: Array, x: Array, sigma: Array, knots: Array) -> tuple[Array, float]:
    """Return the least-squares heights of a continuous line over these knots, and its misfit: a tridiagonal system."""
    j = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, knots.size - 2)
    share = (t - knots[j]) / np.diff(knots)[j]
    weight = 1 / sigma**2

    def total(values: Array) -> Array:
        return np.asarray(np.bincount(j, weights=values * weight, minlength=knots.size - 1), dtype=float)

    band = np.zeros((2, knots.size))
    band[1, :-1] += total((1 - share) ** 2)
    band[1, 1:] += total(share**2)
    band[0, 1:] = total(share * (1 - share))
    level = float(x.mean())
    right = np.zeros(knots.size)
    right[:-1] += total((1 - share) * (x - level))
    right[1:] += total(share * (x - level))
    scale = np.sqrt(np.where(band[1] > 0, band[1], 1.0))  # a piece may lie between two samples, and weights differ by orders
    band[0, 1:] /= scale[1:] * scale[:-1]
    band[1] = 1 + 1e-12
    heights = np.asarray(level + solveh_banded(band, right / scale) / scale)
    return heights, float((((x - np.interp(t, knots, heights)) / sigma) ** 2).sum())


def _polished(t: Array, x: Array, sigma: Array, knots: Array) -> tuple[Array, Array]:
    """Return the knots moved to their least-squares places, and the heights there: damped Gauss-Newton on both."""
    heights, misfit = _heights(t, x, sigma, knots)
    damping, closest = 1e-3, 0.5 * float(np.diff(t).min())
    for _ in range(CORNER_ROUNDS if knots.size > 2 else 0):
        move = _step(t, x, sigma, knots, heights, damping)
        gaps = np.diff(knots)
        least = np.minimum(gaps[:-1], gaps[1:])
        room = np.clip(0.5 * (least - closest), 0.0, 0.4 * least)  # knots stay apart
        trial = knots.copy()
        trial[1:-1] += np.clip(move[1:-1], -room, room)
        raised, found = _heights(t, x, sigma, trial)
        if found < misfit:
            done = misfit - found < 1e-7 * misfit
            knots, heights, misfit, damping = trial, raised, found, damping / 4
            if done:
                break
        elif damping > 1e6:
            break
        else:
            damping *= 8
    return knots, heights


def _step(t: Array, x: Array, sigma: Array, knots: Array, heights: Array, damping: float) -> Array:
    """Return by how much the knots are to be moved: normal equations in (place, height) of each knot, four diagonals wide."""
    j = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, knots.size - 2)
    gaps = np.diff(knots)
    slope = (np.diff(heights) / gaps)[j]
    share = (t - knots[j]) / gaps[j]
    rest = (x - np.interp(t, knots, heights)) / sigma
    columns = [-slope * (1 - share) / sigma, (1 - share) / sigma, -slope * share / sigma, share / sigma]
    n = 2 * knots.size
    band, right = np.zeros((4, n)), np.zeros(n)
    for p in range(4):
        right[p : p + n - 2 : 2] += np.bincount(j, weights=columns[p] * rest, minlength=knots.size - 1)
        for q in range(p, 4):
            both = np.bincount(j, weights=columns[p] * columns[q], minlength=knots.size - 1)
            band[3 - (q - p), q : q + n - 2 : 2] += both
    scale = np.sqrt(np.maximum(band[3], 1e-300))  # places and heights differ in size by orders
    for d in range(4):
        band[3 - d, d:] /= scale[d:] * scale[: n - d]
    right /= scale
    band[3] = 1 + damping + 1e-12
    for fixed in (0, n - 2):  # the ends stay
        right[fixed] = 0.0
        band[3, fixed] = 1e12
    return np.asarray((solveh_banded(band, right) / scale)[::2])


# The normal load of a run: from its column, made as smooth as its noise demands, or that of its description.

LOADS = ("normal_load", "normal_stress")
NEGLIGIBLE = 1e-5  # of the load's range: noise below it is interpolated and not smoothed
SELDOM = 100  # samples to each that differs from the one before, from which a load was set, and what is between has no noise
LOAD_BLOCKS = 16  # whose means are compared to see whether a load is constant
ACCIDENTS = 5  # spikes that a channel may have, and one more in 500 samples; if there are more, they are a signal
SPIKE_RATIO = 2.0  # times as far from its level as the next sample: a spike; the tail of a noise of 4 degrees of freedom has 7 %
NO_CONTACT = 1e-15  # N: no contact
PRESSED = 0.5  # of the median load: above it the slider is pressed on
SAMPLES_A_PERIOD = 8  # of a modulation, from which a column shows it to 1e-3 of its amplitude
SMALLEST_MODULATION = 5e-4  # relative amplitude of a modulation, at least: a servo varies the load by less


def load_of(run: RunDescription, columns: Columns, unit: str) -> tuple[Load, list[Notice]]:
    """Return the load in a run's column, else the one that it states, and what is to be told of it in N or MPa."""
    role = columns.role(*LOADS)
    if role is None:
        if run.modulation is not None:
            return declared_load(1.0 if run.load is None else run.load, run.modulation), []
        return UnknownLoad() if run.load is None else ConstantLoad(run.load), []
    place, values = columns.place(role), columns.arrays[role]
    load, notices = load_from_column(place, values, unit)
    first = load.rest(float(place.t[0]))
    if run.load is not None and abs(run.load - first) > DIFFERS * first:
        run.node.child("load").fail(
            f"the load is {run.load:g} {unit}, but {place.column} begins with {first:g} {unit}", "Take one of the two away."
        )
    if run.modulation is not None:
        f, told = run.modulation[0], modulation_notices(place, run.modulation, values)
        if f * float(np.median(np.diff(place.t))) > 1 / SAMPLES_A_PERIOD:
            stated = declared_load(first, run.modulation)
            if np.nanstd(values - stated(place.t)[0]) < DIFFERS * np.nanstd(values):
                return stated, notices
            what = f"fewer than {SAMPLES_A_PERIOD} samples a period of {f:.6g} Hz do not show the load between them"
            told = [Notice("modulation-differs", place.column, f"{what}, and it is not as declared; the column counts")]
        notices += told
    return load, notices


def declared_load(W0: float, modulation: Declared) -> Modulation:
    """Return the load of a declared modulation: frequency (Hz), amplitude, onset (s), and, if given, phase (deg) and rise (s)."""
    f, eps, onset, *more = modulation
    phase, rise = more or (0.0, None)
    return Modulation(W0, eps, f, onset, rise, math.radians(phase))


def load_from_column(place: Place, W: Array, unit: str = "N") -> tuple[Load, list[Notice]]:
    """Return the load in a column W (n,) in N or MPa, as `unit` says, and what was done to it.

    Empty cells and spikes are bridged. A load that varies no more than its noise is constant; noise that would show in dW/dt is
    smoothed away. Raises SrfError for a load that is missing, not positive or saturated.
    """
    t, known = place.t, np.isfinite(W)
    if not known.any():
        raise SrfError(f"{place.column}: no number in it", 'Give the run load = "5 N", or the column its numbers.')
    notices = place.spots("nan", ~known, f"without a number in '{place.heading}'; the load is bridged")
    filled = np.interp(t, t[known], W[known])
    clipped = saturation(filled, fewest=4)  # one such plateau may be the load that was set
    if clipped.any():
        first, last = np.flatnonzero(clipped)[[0, -1]]
        raise SrfError(
            f"{place.span(first, last)}, column '{place.heading}': {int(clipped.sum())} samples sit at the extreme "
            f"value {filled[first]:.6g} {unit}: the gauge is saturated, the load unknown",
            "Take a window without this part.",
        )
    least = 2e-3 * float(np.median(np.abs(filled)))
    bad = spikes(filled, min(quantisation(filled), least), least=least)  # a spike on a constant is a lattice of its own
    if bad.sum() > ACCIDENTS + W.size // 500:  # a modulation that begins in mid-record looks like this
        bad[:] = False
    if bad.any():  # less is the tail of a noise: those that stand out, each no more than twice as far as the next
        off = deviations(filled)
        ranked = np.sort(off)[::-1]
        count = np.flatnonzero((ranked[:-1] >= SPIKE_RATIO * ranked[1:]) & (np.arange(1, off.size) <= bad.sum()))
        bad &= off >= ranked[count[-1]] if count.size else False
    notices += place.spots("spike", bad, f"standing out in '{place.heading}'; the load is bridged")
    good = known & ~bad
    filled = np.interp(t, t[good], filled[good])
    if filled.min() < NO_CONTACT:
        at, window = int(filled.argmin()), _pressed(t, filled)
        part = f", such as [{window[0]:.7g}, {window[1]:.7g}] s" if window else ""
        error = NoContact(
            f"{place.span(at, at)}, column '{place.heading}': the load is {filled[at]:.6g} {unit}",
            f"The slider must stay in contact: zero the gauge ([columns] offset), or take a window without this part{part}.",
        )
        error.window = window
        raise error
    load, told = _smooth(place, filled, unit)
    return load, [*notices, *told]


def _pressed(t: Array, W: Array) -> tuple[float, float] | None:
    """Return the longest time (s) in which the loads W (n,) are those of a contact, None where there is none."""
    low = PRESSED * float(np.median(W))  # less is loading and unloading
    length, first, last = max(((t[b] - t[a], a, b) for a, b in runs_of(max(low, NO_CONTACT) < W)), default=(0.0, 0, 0))
    return (float(t[first]), float(t[last])) if length > 0 else None


def _smooth(place: Place, W: Array, unit: str) -> tuple[Load, list[Notice]]:
    if np.ptp(W) == 0 or W.size < 4:
        return ConstantLoad(float(W[0])), []
    noise = white_level(W, place.t)
    mean = float(W.mean())
    if noise and is_constant(W, noise):
        what = f"constant to its noise of {noise / mean:.2g} of {mean:.6g} {unit}: taken as constant"
        return ConstantLoad(mean), [Notice("load-constant", place.column, what)]
    if noise <= NEGLIGIBLE * float(np.ptp(W)) or SELDOM * np.count_nonzero(np.diff(W)) < W.size:
        return SampledLoad(place.t, W), []
    load = SampledLoad(place.t, W, noise=noise)
    steps = np.diff(load.knots)
    what = (
        f"noise of {noise:.3g} {unit} ({noise / mean:.2g} of the load), which dW/dt would amplify: smoothed by a spline with "
        f"knots {steps.min():.3g} to {steps.max():.3g} s apart"
    )
    return load, [Notice("load-smoothed", place.column, what)]


def is_constant(W: Array, noise: float) -> bool:
    """Return whether the loads W (n,) spread about one mean as white noise of this size does, in all and in blocks."""
    if W.std() > 1.5 * noise:
        return False
    count = min(LOAD_BLOCKS, W.size // 8)
    if count < 2:
        return True
    blocks = np.array_split(W, count)
    scores = np.array([(b.mean() - W.mean()) * np.sqrt(b.size) / noise for b in blocks])
    return bool((scores**2).sum() < count + 4 * np.sqrt(2 * count))


@dataclass(frozen=True)
class FoundModulation:
    """A modulation found in a load: frequency (Hz), amplitude over the mean load, and when half of it is reached (s), or -inf."""

    frequency: float
    amplitude: float
    onset: float


def find_modulation(t: Array, W: Array) -> FoundModulation | None:
    """Return the modulation in the loads W (n,) at evenly spaced times, None where no line stands out of the spectrum.

    Frequency and amplitude are a least-squares fit of three harmonics to the later half of where it is on; the onset is where
    the envelope, the mean over a period, passes half its height.
    """
    n = W.size
    if n < 64 or np.ptp(W) == 0:
        return None
    dt = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1], dt)
    if even.size > 4 * n:
        return None
    values = np.interp(even, t, W)
    tail = values[-max(even.size // 3, 64) :]  # whatever the onset, it is on at the end
    tail_times = even[-tail.size :]
    line = _line(tail - tail.mean(), dt)
    if line is None:
        return None
    frequency, amplitude = _refined(tail_times, tail, line)
    mean = float(tail.mean())
    if amplitude < SMALLEST_MODULATION * mean:
        return None
    return FoundModulation(frequency, amplitude / mean, _onset(even, values, frequency, amplitude))


def _line(x: Array, dt: float) -> float | None:
    """Return the frequency of the strongest line, None where it holds less than half of what moves about a parabola."""
    place = np.linspace(-1, 1, x.size)
    basis = np.linalg.qr(np.vander(place, 3))[0]
    x = x - basis @ (basis.T @ x)
    power = np.abs(np.fft.rfft(x * np.hanning(x.size))) ** 2
    at = int(np.argmax(power[3:])) + 3 if power.size > 4 else 0
    if at < 4 or power[max(at - 2, 0) : at + 3].sum() < 0.5 * power[1:].sum():
        return None
    return at / (x.size * dt)


def _refined(t: Array, x: Array, frequency: float) -> tuple[float, float]:
    """Return frequency and amplitude by Gauss-Newton on a cosine with two overtones."""
    s = t - 0.5 * (t[0] + t[-1])
    amplitude = 0.0
    for _ in range(8):
        angle = 2 * np.pi * frequency * s
        waves = [f(k * angle) for k in (1, 2, 3) for f in (np.cos, np.sin)]
        design = np.column_stack([np.ones_like(s), s / s[-1], *waves])
        solution = np.linalg.lstsq(design, x, rcond=None)[0]
        c, d = solution[2], solution[3]
        amplitude = float(np.hypot(c, d))
        if amplitude == 0:
            break
        slope = 2 * np.pi * s * (d * np.cos(angle) - c * np.sin(angle))
        rest = x - design @ solution
        wide = np.column_stack([design, slope])
        step = float(np.linalg.lstsq(wide, rest, rcond=None)[0][-1])
        step = float(np.clip(step, -0.3 / np.ptp(s), 0.3 / np.ptp(s)))
        frequency += step
        if abs(step) < 1e-9 * frequency:
            break
    return frequency, amplitude


def _onset(t: Array, x: Array, frequency: float, amplitude: float) -> float:
    period = max(round(1 / (frequency * (t[1] - t[0]))), 1)
    turned = (x - x.mean()) * np.exp(-2j * np.pi * frequency * t)
    envelope = 2 * np.abs(np.convolve(turned, np.ones(period) / period, mode="same")) / amplitude
    above = envelope[period:-period] if envelope.size > 4 * period else envelope
    times = t[period:-period] if envelope.size > 4 * period else t
    if above[: max(period, 2)].min() > 0.5:
        return -np.inf
    return float(times[int(np.argmax(above > 0.5))])


def modulation_notices(place: Place, declared: Declared, W: Array) -> list[Notice]:
    """Return a notice where the declared frequency or amplitude is not what the column has."""
    found = find_modulation(place.t, W)
    f, eps = declared[:2]
    if found is None:
        what = f"a modulation of {eps:.4g} at {f:.6g} Hz is declared, but the column shows none; the column counts"
        return [] if eps == 0 else [Notice("modulation-differs", place.column, what)]
    told = []
    if abs(found.frequency - f) > DIFFERS * f:
        told.append(f"frequency declared {f:.6g} Hz, found {found.frequency:.6g} Hz")
    if abs(found.amplitude - eps) > DIFFERS * eps:
        told.append(f"relative amplitude declared {eps:.4g}, found {found.amplitude:.4g}")
    if not told:
        return []
    return [Notice("modulation-differs", place.column, "; ".join(told) + "; the column counts")]


# A recorded normal load alone, without the rest of a recording.


def read_load(path: Path, *, registry: Registry, format: str | None = None) -> tuple[Load, Array, tuple[Notice, ...]]:
    """Return the load in the columns `time` and `normal_load` (or `normal_stress`) of a data file, its times (n,) in s, and
    what was found in the data. Units are those of the headings, else s, N and MPa. `format` names the file's reader.

    Raises SrfError for a missing column, fewer than eight samples, and a file too large to hold.
    """
    source = open_source(path, registry=registry, format=format)
    finder = Finder(path, source.headings, {})
    time, loads = finder.find("time"), next((c for role in LOADS if (c := finder.find(role))), None)
    if time is None or loads is None:
        missing = "time" if time is None else " or ".join(LOADS)
        raise SrfError(
            f"{path}: no column {missing}; found: {', '.join(source.headings)}", "Head the columns time [s],normal_load [N]."
        )
    blocks, held = [np.empty((2, 0))], 0
    for block in source.blocks((time.column, loads.column)):
        blocks.append(np.array([block[0] * time.factor, block[1] * loads.factor]))
        held += blocks[-1].nbytes
        if held > MOST_BYTES:
            raise SrfError(f"{path}: more than {MOST_BYTES / 2**20:g} MB of loads", "Cut the file to the times that are needed.")
    t, W = np.concatenate(blocks, axis=1)
    rows = np.arange(1, t.size + 1)
    keep, notices = kept_samples(Place(path, time.heading, rows, t))
    place = Place(path, loads.heading, rows[keep], t[keep])
    load, told = load_from_column(place, W[keep], "MPa" if is_stress(loads.unit) else "N")
    return load, place.t, (*notices, *told)
