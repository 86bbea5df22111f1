"""The noise of a channel: its white level from the spectrum's floor, its colour from what a smooth trend leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.recording.values import Array

SEGMENT = 256  # samples of a periodogram
WILD, ROUNDS = 3.0, 4  # standard deviations of a stretch's mean square, and how often the calm ones are chosen anew
LEAST = 0.2  # share of the noise that a trend may leave: what is slower is signal
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
    signal bends faster than that, as at stick-slip events, are left out: what counts are the calmest quarter of the stretches,
    the level corrected for the choice, and then all that are no wilder than noise like theirs can be.
    """
    length = min(TREND, x.size)
    if length < 32:
        return Noise(white_level(x), float("nan"), float("nan"), 0)
    count = x.size // length
    pieces = x[: count * length].reshape(count, length)
    basis = _trend(length, cycles)
    rest = pieces - (pieces @ basis) @ basis.T
    lags, freedom = _lags(basis), length - basis.shape[1]
    power = (rest**2).sum(axis=1) / freedom
    calm = np.argsort(power)[: max(count // 4, 1)]
    rho = _lag1(rest[calm], lags)
    # the mean of a normal variate's lowest quarter is 1.27 below its own
    level = float(power[calm].mean()) / max(1.0 - (1.27 * _spread(rho, freedom) if count > 4 else 0.0), 0.3)
    for _ in range(ROUNDS if count > 4 else 0):
        calm = np.flatnonzero(power <= level * (1 + WILD * _spread(rho, freedom)))
        rho, level = _lag1(rest[calm], lags), float(power[calm].mean())
    return Noise(white_level(x), float(np.sqrt(level / _left(rho, lags, freedom))), rho, int(calm.size) * length)


def _spread(rho: float, freedom: int) -> float:
    """Return the relative standard deviation of the mean square of so many samples of AR(1) noise."""
    colour = (1 + rho**2) / (1 - rho**2) if np.isfinite(rho) else 1.0
    return float(np.sqrt(2 * colour / freedom))


def _trend(length: int, cycles: float | None) -> Array:
    """Return an orthonormal basis (length, k) of parabolas and, of a modulation, what of its harmonics can be seen."""
    columns = [np.linspace(-1.0, 1.0, length) ** k for k in range(3)]
    if cycles is not None and cycles * length > 1:
        for harmonic in range(1, 4):
            if harmonic * cycles < 0.45:
                angle = 2 * np.pi * harmonic * cycles * np.arange(length)
                columns += [np.cos(angle), np.sin(angle)]
    return np.asarray(np.linalg.qr(np.column_stack(columns))[0])


def _lags(basis: Array) -> tuple[Array, Array]:
    """Return a and b (n,): AR(1) noise of variance 1 and correlation rho has, about the trend, the power sum(a rho^d).

    And sum(b rho^d) is the sum of the products of its neighbouring samples.
    """
    n = basis.shape[0]
    P = np.eye(n) - basis @ basis.T
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n))).ravel()
    a, b = (np.bincount(apart, weights=M.ravel()) for M in (P, P[:-1].T @ P[1:]))
    return np.asarray(a), np.asarray(b)


def _lag1(rest: Array, lags: tuple[Array, Array]) -> float:
    """Return the rho of an AR(1) noise whose residuals about the trend have the lag-1 correlation found in `rest`."""
    power = float((rest**2).sum())
    if power == 0:
        return float("nan")
    found = float((rest[:, 1:] * rest[:, :-1]).sum()) / power
    rhos = np.linspace(-0.95, 0.99, 98)
    powers = rhos[:, None] ** np.arange(rest.shape[1])
    return float(np.interp(found, (powers @ lags[1]) / (powers @ lags[0]), rhos))  # the trend takes some of it away


def _left(rho: float, lags: tuple[Array, Array], freedom: int) -> float:
    """Return the share of AR(1) noise's variance that the trend leaves, over the share of white noise's."""
    if not np.isfinite(rho):
        return 1.0
    return max(float(rho ** np.arange(lags[0].size) @ lags[0]) / freedom, LEAST)
