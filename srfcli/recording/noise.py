"""The noise of a channel: its white level from the spectrum's floor, its colour from what a smooth trend leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.recording.values import Array

SEGMENT = 256  # samples of a periodogram
TREND = 64  # samples over which a parabola is the trend


@dataclass(frozen=True)
class Noise:
    """`white` is the standard deviation that the spectrum's upper half gives white noise, `total` that about the trend.

    `lag1` is the correlation of neighbouring samples about the trend; `samples` is how many it was found from.
    """

    white: float
    total: float
    lag1: float
    samples: int


def white_level(x: Array) -> float:
    """Return the standard deviation of white noise whose floor the spectrum of x (n,) shows above half the Nyquist frequency.

    The median over frequencies and stretches: lines, events and a slow signal do not raise it. Coloured noise counts as signal.
    """
    length = min(SEGMENT, 2 ** int(np.log2(max(x.size, 1))))
    if length < 16:
        third = np.diff(x, 3) if x.size > 3 else np.zeros(1)
        return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0))
    starts = np.unique(np.linspace(0, x.size - length, min(2 * x.size // length, 400)).astype(int))
    pieces = np.stack([x[a : a + length] for a in starts.tolist()])
    place = np.linspace(-1.0, 1.0, length)
    pieces = pieces - pieces.mean(axis=1, keepdims=True)
    pieces = pieces - (pieces @ place / (place @ place))[:, None] * place
    angle = 2 * np.pi * (np.arange(length) + 0.5) / length
    window = 0.35875 - 0.48829 * np.cos(angle) + 0.14128 * np.cos(2 * angle) - 0.01168 * np.cos(3 * angle)
    power = np.abs(np.fft.rfft(pieces * window, axis=1)) ** 2 / (window @ window)
    upper = power[:, length // 4 : length // 2]
    return float(np.sqrt(np.median(np.median(upper, axis=1)) / np.log(2)))


def describe_noise(x: Array, cycles: float | None = None) -> Noise:
    """Return level and colour of the noise in x (n,), evenly sampled, about a parabola over each 64 samples.

    `cycles`, in periods per sample, is a modulation whose first three harmonics are taken out, too. Stretches in which the
    signal bends faster than that, as at stick-slip events, are left out: only the calmest quarter of the stretches counts, and
    the level is corrected for the choice.
    """
    length = min(TREND, x.size)
    if length < 32:
        return Noise(white_level(x), float("nan"), float("nan"), 0)
    count = x.size // length
    pieces = x[: count * length].reshape(count, length)
    basis = _trend(length, cycles)
    rest = pieces - (pieces @ basis) @ basis.T
    kept = max(count // 4, 1)
    calm = rest[np.argsort((rest**2).sum(axis=1))[:kept]]
    freedom = length - basis.shape[1]
    rho = _lag1(calm, basis)
    colour = (1 + rho**2) / (1 - rho**2) if np.isfinite(rho) else 1.0
    chosen = 1.0 - (
        1.27 * np.sqrt(2 * colour / freedom) if kept > 1 else 0.0
    )  # mean of a normal variate's lowest quarter
    total = np.sqrt((calm**2).sum() / (calm.shape[0] * freedom) / max(chosen, 0.3))
    return Noise(white_level(x), float(total), rho, int(calm.size))


def _trend(length: int, cycles: float | None) -> Array:
    """Return an orthonormal basis (length, k) of parabolas and, of a modulation, what of its harmonics can be seen."""
    columns = [np.linspace(-1.0, 1.0, length) ** k for k in range(3)]
    if cycles is not None and cycles * length > 1:
        for harmonic in range(1, 4):
            if harmonic * cycles < 0.45:
                angle = 2 * np.pi * harmonic * cycles * np.arange(length)
                columns += [np.cos(angle), np.sin(angle)]
    return np.asarray(np.linalg.qr(np.column_stack(columns))[0])


def _lag1(rest: Array, basis: Array) -> float:
    """Return the rho of an AR(1) noise whose residuals about the trend have the lag-1 correlation found in `rest`."""
    power = float((rest**2).sum())
    if power == 0:
        return float("nan")
    found = float((rest[:, 1:] * rest[:, :-1]).sum()) / power
    rhos = np.linspace(-0.95, 0.99, 98)
    expected = np.array([_expected(rho, basis) for rho in rhos])  # the trend takes some of the correlation away
    return float(np.interp(found, expected, rhos))


def _expected(rho: float, basis: Array) -> float:
    n = basis.shape[0]
    covariance = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    left = covariance - basis @ (basis.T @ covariance)
    left = left - (left @ basis) @ basis.T
    return float(np.trace(left, offset=1) / np.trace(left))
