"""What a gauge would make of a simulated record: noise of a given size and colour, and steps of a given height."""

from __future__ import annotations

import math
import zlib
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from srfcli.errors import SrfError

Array = NDArray[np.float64]


def measured(
    values: Array, *, noise: float = 0.0, lag1: float = 0.0, quantum: float = 0.0, seed: int = 0, stream: str = ""
) -> Array:
    """Return `values` (n,) with stationary noise of standard deviation `noise` and lag-1 correlation `lag1`, then rounded to
    multiples of `quantum`; both in the unit of the values, 0 for none.

    The noise depends on `seed` and `stream` alone: a run's own name as stream keeps it the same whatever else is simulated.
    Raises SrfError for a negative size, |lag1| >= 1, a lag without noise or a negative seed.
    """
    check_gauge(noise=noise, lag1=lag1, quantum=quantum, seed=seed)
    out = np.array(values, dtype=float)
    if noise:
        out += noise * ar1(out.size, lag1, rng=generator(seed, stream))
    return quantised(out, quantum) if quantum else out


def check_gauge(*, noise: float, lag1: float, quantum: float, seed: int) -> None:
    """Raise SrfError for what no gauge does."""
    for name, value in (("noise", noise), ("quantum", quantum)):
        if not (math.isfinite(value) and value >= 0):
            raise SrfError(f"{name} = {value:g} is not a size", f"give {name} as 0 or more")
    if not abs(lag1) < 1:
        raise SrfError(f"lag1 = {lag1:g} is not the correlation of a stationary noise", "give -1 < lag1 < 1, as 0.8")
    if lag1 and not noise:
        raise SrfError(f"lag1 = {lag1:g} colours a noise of size 0", "give noise its standard deviation, too")
    if seed < 0:
        raise SrfError(f"seed = {seed} is negative", "give a whole number from 0 on")


def generator(seed: int, stream: str) -> np.random.Generator:
    """Return the random numbers that belong to a seed and a name."""
    return np.random.default_rng([seed, zlib.crc32(stream.encode("utf-8"))])


def ar1(n: int, lag1: float, *, rng: np.random.Generator) -> Array:
    """Return `n` samples of unit variance, each correlated with its predecessor by `lag1`, from the stationary state on."""
    from scipy.signal import lfilter

    white = rng.standard_normal(n)
    if not lag1:
        return white
    innovation = math.sqrt(1 - lag1 * lag1)
    if n:
        white[0] /= innovation  # the first sample has no predecessor and the same variance
    return np.asarray(lfilter([innovation], [1.0, -lag1], white), dtype=float)


def quantised(values: Array, quantum: float) -> Array:
    """Return the nearest multiples of `quantum`, with no more digits than it has: 18.665, not 18.665000000000003."""
    exponent = Decimal(repr(float(quantum))).normalize().as_tuple().exponent
    assert isinstance(exponent, int)  # a finite number has one
    return np.asarray(np.round(np.round(values / quantum) * quantum, max(-exponent, 0)), dtype=float)
