"""The normal load of a run: from its column, made as smooth as its noise demands, or the constant of its description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srfcli.errors import SrfError
from srfcli.numerics.program import ConstantLoad, Load, SampledLoad
from srfcli.recording.flaws import quantisation, saturation, spikes
from srfcli.recording.noise import white_level
from srfcli.recording.series import span, spots
from srfcli.recording.values import Array, Notice

NEGLIGIBLE = 1e-5  # of the range: noise that an interpolation may keep
BLOCKS = 16  # in which a constant load has one mean
ACCIDENTS = 5  # spikes that a load may have, and one more in 500 samples; so many more are what was imposed
NOTHING = 1e-15  # N: no contact
SMALLEST = 5e-4  # relative amplitude of a modulation: a servo wobbles by less
DIFFERS = 0.05  # relative difference between a declared and a found modulation that is told


@dataclass(frozen=True)
class Place:
    """The column of loads in its file, for notices and errors."""

    path: Path
    heading: str
    rows: NDArray[np.int64]
    t: Array

    @property
    def column(self) -> str:
        return f"{self.path.name}: column '{self.heading}'"


def load_from_column(place: Place, W: Array) -> tuple[Load, list[Notice]]:
    """Return the load in a column W (n,) in N, and what was done to it.

    Empty cells and spikes are bridged. A load that varies no more than its noise is constant; noise that would show in dW/dt is
    smoothed away. Raises SrfError for a load that is missing, not positive or saturated.
    """
    t, path, rows = place.t, place.path, place.rows
    known = np.isfinite(W)
    if not known.any():
        raise SrfError(f"{place.column}: no number in it", 'Give the run load = "5 N", or the column its numbers.')
    notices = spots("nan", ~known, path, rows, t, f"without a number in '{place.heading}'; the load is bridged")
    filled = np.interp(t, t[known], W[known])
    clipped = saturation(filled, fewest=4)  # one such plateau may be the load that was set
    if clipped.any():
        first, last = np.flatnonzero(clipped)[[0, -1]]
        raise SrfError(
            f"{span(path, rows, t, first, last)}, column '{place.heading}': {int(clipped.sum())} samples sit at the extreme "
            f"value {filled[first]:.6g} N: the gauge is saturated, the load unknown",
            "Take a window without this part.",
        )
    least = 2e-3 * float(np.median(np.abs(filled)))
    bad = spikes(filled, min(quantisation(filled), least), least=least)  # a spike on a constant is a lattice of its own
    if bad.sum() > ACCIDENTS + W.size // 500:  # a modulation that begins in mid-record looks like this
        bad[:] = False
    notices += spots("spike", bad, path, rows, t, f"standing out in '{place.heading}'; the load is bridged")
    good = known & ~bad
    filled = np.interp(t, t[good], filled[good])
    if filled.min() < NOTHING:
        at = int(filled.argmin())
        raise SrfError(
            f"{span(path, rows, t, at, at)}, column '{place.heading}': the load is {filled[at]:.6g} N",
            "The slider must stay in contact: zero the gauge ([columns] offset), or take a window without this part.",
        )
    load, told = _smooth(place, filled)
    return load, [*notices, *told]


def _smooth(place: Place, W: Array) -> tuple[Load, list[Notice]]:
    if np.ptp(W) == 0 or W.size < 4:
        return ConstantLoad(float(W[0])), []
    noise = white_level(W)
    mean = float(W.mean())
    if noise and is_constant(W, noise):
        what = f"constant to its noise of {noise / mean:.2g} of {mean:.6g} N: taken as constant"
        return ConstantLoad(mean), [Notice("load-constant", place.column, what)]
    if noise <= NEGLIGIBLE * float(np.ptp(W)):
        return SampledLoad(place.t, W), []
    load = SampledLoad(place.t, W, noise=noise)
    steps = np.diff(load.knots)
    what = (
        f"noise of {noise:.3g} N ({noise / mean:.2g} of the load), which dW/dt would amplify: smoothed by a spline with knots "
        f"{steps.min():.3g} to {steps.max():.3g} s apart"
    )
    return load, [Notice("load-smoothed", place.column, what)]


def is_constant(W: Array, noise: float) -> bool:
    """Return whether the loads W (n,) spread about one mean as white noise of this size does, in all and in blocks."""
    if W.std() > 1.5 * noise:
        return False
    count = min(BLOCKS, W.size // 8)
    if count < 2:
        return True
    blocks = np.array_split(W, count)
    scores = np.array([(b.mean() - W.mean()) * np.sqrt(b.size) / noise for b in blocks])
    return bool((scores**2).sum() < count + 4 * np.sqrt(2 * count))


@dataclass(frozen=True)
class Found:
    """A modulation found in a load: frequency (Hz), amplitude over the mean load, and when half of it is reached (s), or -inf."""

    frequency: float
    amplitude: float
    onset: float


def find_modulation(t: Array, W: Array) -> Found | None:
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
    if amplitude < SMALLEST * mean:
        return None
    return Found(frequency, amplitude / mean, _onset(even, values, frequency, amplitude))


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


def modulation_notices(place: Place, declared: tuple[float, float, float], W: Array) -> list[Notice]:
    """Return a notice where the declared frequency or amplitude is not what the column has."""
    found = find_modulation(place.t, W)
    f, eps, _ = declared
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
