"""The noise of a gauge, white and coloured by relaxations and oscillations; found without a model of the slider.

A recording is cut into stretches, a parabola is taken out of each, and the mean of their periodograms is compared with its
expectation: the debiased Whittle likelihood (Sykulski, Olhede, Guillaumin, Lilly and Early, Biometrika 106, 2019). The
expectation is exact for stretches of any length, with the parabola and the window, so that neither trend, leakage nor aliasing
bias the result. One evaluation is a product with a matrix, however long the recording is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.c_source import GAUGE_PROCESSES
from srfcli.codegen.model import Array
from srfcli.data.clock import Mask
from srfcli.data.noise import white_level

PROCESSES = ("relaxation", "oscillation")  # of coloured noise: e' = -e/tau + w, or e'' + (omega/q) e' + omega^2 e = w
# start values: shares of the way, in logarithms, from the shortest correlation time to the longest
CORRELATION_TIMES = (0.02, 0.3, 0.6, 0.9)
QUALITIES = (0.5, 3.0, 30.0)  # start values of an oscillation: smooth noise, a broad line and a narrow one
QUALITY = (0.2, 1000.0)  # of an oscillation: one of a smaller quality is a relaxation
FASTEST_OSCILLATION = 1.0  # frequency of an oscillation times the spacing: smooth noise may end beyond half of the sampling rate

STRETCHES = (64, 128, 256)  # samples over which a parabola is the trend: the longest that holds no signal is taken
SLOW = 3  # lowest frequencies of stretches, which those half as long do not resolve
SPECTRUM_RISE = 1.5  # power at these frequencies over that predicted from shorter stretches, at most; more is signal
SLOWEST = 2.0  # periods of an oscillation in a stretch, at least
SLOW_SHARE = 0.9  # of the longest time that a stretch bounds: a process beyond it is at its bound, not told from a signal
COLOUR_SAMPLES = 32  # samples from which coloured noise is estimated
ENOUGH_STRETCHES = 4  # stretches; if there are more, some may be rejected
REJECTED_SHARE = 1e-3  # share of stretches of pure noise that are rejected
CALM_ROUNDS = 4  # in which the calm stretches are chosen anew
INDEPENDENT_POWERS = 1.94  # powers over independent ones: Hann's window correlates neighbours by 4/9, the next by 1/36
SAME_RATE = 0.25  # in the logarithm of the sampling interval, within which a gauge's noise is the same
FEWEST_PARTS = 3  # of a recording at one rate, that say what noise is usual there
QUIET = 3.0  # times less than the usual noise, from where on a part tells nothing of it
WHITE = 1e-3  # standard deviation of each part over that of the whole noise, at least
LEAST_DEVIATION = 1e-150  # standard deviation whose square is still a number


def covariance(colour: tuple[float, ...], lag: Array) -> Array:
    """Return the covariance at lags >= 0 (s) of a relaxation (time, sd) or an oscillation (frequency, sd, quality)."""
    if len(colour) == 2:
        return np.asarray(colour[1] ** 2 * np.exp(-lag / colour[0]))
    a, _, c, s, _ = _swing(colour, lag)
    return np.asarray(colour[1] ** 2 * (c + a * s))


def covariance_slopes(colour: tuple[float, ...], lag: Array) -> list[Array]:
    """Return the derivatives of `covariance` by the logarithms of time, or of frequency and quality."""
    if len(colour) == 2:
        return [covariance(colour, lag) * lag / colour[0]]
    a, b, c, s, square = _swing(colour, lag)
    near = np.abs(square) < 1e-4
    curved = np.where(near, np.exp(-a) * (1 / 3 + square / 30), (c - s) / np.where(near, 1.0, square))
    return [-(colour[1] ** 2) * b**2 * s, -(colour[1] ** 2) * a * b**2 * curved]


def transition(colour: tuple[float, ...], lag: Array) -> Array:
    """Return what a process does over the lags (s), (..., w, w): of one state, or of two of one variance, e and e'/omega."""
    lag = np.asarray(lag, dtype=float)
    if len(colour) == 2:
        return np.exp(-lag / colour[0])[..., None, None]
    a, b, c, s, _ = _swing(colour, lag)
    return np.stack([np.stack([c + a * s, b * s], -1), np.stack([-b * s, c - a * s], -1)], -2)


def _swing(colour: tuple[float, ...], lag: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return a = omega lag/(2 q), b = omega lag, exp(-a) times cosh(r) and sinh(r)/r, and r^2 = a^2 - b^2."""
    b = 2 * np.pi * colour[0] * lag
    a = b / (2 * colour[2])
    root = np.sqrt((a**2 - b**2).astype(complex))
    small = np.abs(root) < 1e-6
    grown, fallen = np.exp(root - a), np.exp(-root - a)
    s = np.where(small, np.exp(-a), ((grown - fallen) / (2 * np.where(small, 1, root))).real)
    return a, b, ((grown + fallen) / 2).real, s, a**2 - b**2


def colour_text(colour: tuple[float, ...], unit: str = "") -> str:
    """Return a process in words; an oscillation is smooth noise at a quality of a half, a spectral line at a large one."""
    size = f"{colour[1]:.3g} {unit}".rstrip()
    told = f"{size} correlated over {colour[0]:.3g} s"
    return told if len(colour) == 2 else f"{size} about {colour[0]:.3g} Hz, of quality {colour[2]:.2g}"


@dataclass(frozen=True)
class GaugeNoise:
    """White noise of standard deviation `white`, the rounding to multiples of `quantum`, and processes `colours`.

    Those are (correlation time in s, standard deviation) of a relaxation, (frequency in Hz, standard deviation, quality) of an
    oscillation. `samples` is how many it was found from, `stretch` how long (s) a parabola was the trend: the slower is signal.
    """

    white: float
    quantum: float = 0.0
    colours: tuple[tuple[float, ...], ...] = ()
    samples: int = 0
    stretch: float = 0.0

    @property
    def floor(self) -> float:
        """Return the variance of what is white: noise and rounding."""
        return self.white**2 + self.quantum**2 / 12

    @property
    def total(self) -> float:
        """Return the standard deviation of all of it."""
        return float(np.sqrt(self.floor + sum(c[1] ** 2 for c in self.colours)))

    @property
    def parts(self) -> list[tuple[str, float, tuple[float, ...]]]:
        """Return name, standard deviation and the process of each part: white noise, rounding, relaxations, oscillations."""
        named = [(PROCESSES[len(c) - 2], c[1], c) for c in self.colours]
        rounding = [("rounding", self.quantum / np.sqrt(12), ())] if self.quantum else []
        return [("white", self.white, ()), *rounding, *named]

    def covariance(self, lag: Array) -> Array:
        """Return the covariance at lags >= 0 (s), of which 0 is a sample with itself."""
        return np.where(lag == 0, self.floor, 0.0) + sum((covariance(c, lag) for c in self.colours), np.zeros(np.shape(lag)))


def whiten(noises: Sequence[GaugeNoise], rate: NDArray[np.intc], begins: Mask, t: Array, columns: Array) -> Array:
    """Return the innovations over their standard deviations of columns (n, k) at the rising times t (n,), by a Kalman filter.

    `rate` (n,) says which of the noises holds at a sample; `begins` (n,) where one begins that owes nothing to the one before.
    """
    from scipy.linalg import block_diag

    floor = np.array([noise.floor for noise in noises])[rate]
    if not any(noise.colours for noise in noises):
        return np.asarray(columns / np.sqrt(floor)[:, None])
    out, known = np.empty_like(columns), {}
    steps = np.diff(t, prepend=t[:1])
    key, P, V, x = None, np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, columns.shape[1]))
    h, gain, S, settled = np.zeros(0), np.zeros(0), 0.0, False
    for k in range(t.size):
        noise = noises[rate[k]]
        if k == 0 or begins[k]:
            V = np.diag([c[1] ** 2 for c in noise.colours for _ in c[1:]])
            h = np.array([float(i == 0) for c in noise.colours for i in range(len(c) - 1)])
            P, x, key, settled = V, np.zeros((h.size, columns.shape[1])), None, False
        else:
            now = (int(rate[k]), float(f"{steps[k]:.9g}"))
            if now not in known:
                steps_of = [transition(c, np.array(now[1])) for c in noise.colours]
                known[now] = block_diag(np.zeros((0, 0)), *steps_of)  # (0, 0) where there is none
            F, settled, key = known[now], settled and now == key, now
            x = F @ x
            P = P if settled else V + F @ (P - V) @ F.T
        if not settled:
            before, S = S, float(h @ P @ h + floor[k])
            gain = P @ h / S
            settled = key is not None and abs(S - before) < 1e-12 * S  # the gain of an even sampling is soon one
            P = P - np.outer(gain, P @ h) if not settled else P
        missed = columns[k] - h @ x
        out[k] = missed / np.sqrt(S)
        x = x + np.outer(gain, missed)
    return out


def of_one_gauge(own: Mapping[float, GaugeNoise], recorded: Sequence[tuple[float, GaugeNoise]]) -> tuple[GaugeNoise, ...]:
    """Return the noises of a part of a recording, by spacing (s), with what all parts, `recorded`, show of their one gauge.

    A part far quieter than is usual at its rate is short: what it holds of the noise was taken for signal. Slower processes are
    those that another rate or part shows over longer stretches; in shorter ones they are not told from a trend.
    """
    found = []
    for spacing, noise in own.items():
        alike = sorted((n for dt, n in recorded if abs(np.log(dt / spacing)) < SAME_RATE), key=lambda n: n.total)
        if len(alike) >= FEWEST_PARTS and noise.total < alike[len(alike) // 2].total / QUIET:
            noise = alike[len(alike) // 2]
        longer = [other for _, other in recorded if other.stretch > noise.stretch]
        seen = max(longer, key=lambda other: other.samples, default=noise)
        slow = [c for c in seen.colours if not _resolved(c, noise.stretch)]
        found.append(replace(noise, colours=(*noise.colours, *slow)))
    return tuple(found)


def _resolved(colour: tuple[float, ...], stretch: float) -> bool:
    """Return whether stretches of so many seconds tell a process from a signal that bends."""
    return (colour[0] if len(colour) == 2 else SLOWEST / colour[0]) <= SLOW_SHARE * stretch


# How it is found.


def find_noise(pieces: Sequence[Array], spacing: float, *, quantum: float = 0.0, cycles: float | None = None) -> GaugeNoise:
    """Return the noise in evenly sampled pieces of a recording, `spacing` s between samples, about a parabola over each stretch.

    `cycles`, in periods per sample, is a modulation whose first three harmonics are taken out, too.

    Stretches in which the signal bends faster, as at stick-slip events, are left out. The calmest quarter gives a first level,
    corrected for the choice; then all stretches count whose power, in all and at each frequency, is within that of such noise.
    Longer stretches are taken as long as the noise found in shorter ones predicts their lowest frequencies, and at least half as
    many samples are calm; otherwise they hold signal.
    """
    longest = max(piece.size for piece in pieces)
    lengths = [n for n in STRETCHES if n <= longest] or [longest]
    # the rounding of numbers, where there is no noise
    least = max(1e-9 * max(float(np.ptp(piece)) for piece in pieces), LEAST_DEVIATION)
    if lengths[0] < COLOUR_SAMPLES:
        return GaugeNoise(max(white_level(max(pieces, key=len)), least), quantum)
    found: GaugeNoise | None = None
    for n in lengths:
        calm = _calm(pieces, _Window.of(n, cycles))
        whittle = _Whittle(calm, spacing, quantum, least)
        if found is not None:
            slow = calm.mean[:SLOW] / whittle.expected(found)[:SLOW]
            if whittle.samples < found.samples / 2 or slow.mean() > SPECTRUM_RISE * (
                1 + 2 * np.sqrt(INDEPENDENT_POWERS / (SLOW * calm.count))
            ):
                break
        found = whittle.noise()
    assert found is not None
    return replace(found, colours=tuple(c for c in found.colours if _resolved(c, found.stretch)))


@dataclass(frozen=True)
class _Window:
    """Stretches of n samples: an orthonormal basis of the trend, Hann's window, and the matrix of expected periodograms.

    `expected` (f, n) times a covariance at the lags 0 to n - 1 is the expected periodogram at the `bins` that the trend leaves.
    """

    n: int
    basis: Array
    window: Array
    bins: NDArray[np.intp]
    expected: Array

    @classmethod
    @lru_cache(maxsize=8)
    def of(cls, n: int, cycles: float | None) -> _Window:
        columns = [np.linspace(-1.0, 1.0, n) ** k for k in range(3)]
        if cycles is not None and cycles * n > 1:
            for harmonic in range(1, 4):
                if harmonic * cycles < 0.45:
                    angle = 2 * np.pi * harmonic * cycles * np.arange(n)
                    columns += [np.cos(angle), np.sin(angle)]
        basis = np.asarray(np.linalg.qr(np.column_stack(columns))[0])
        window = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2
        wave = window * np.exp(-2j * np.pi * np.outer(np.arange(1, (n + 1) // 2), np.arange(n)) / n)
        seen = wave - (wave @ basis) @ basis.T  # what the power at a frequency takes of each sample
        lags = np.fft.ifft(np.abs(np.fft.fft(seen, 2 * n, axis=1)) ** 2, axis=1)[:, :n].real
        lags[:, 1:] *= 2
        left = np.flatnonzero(lags[:, 0] > 0.1 * lags[:, 0].max())
        return cls(n, basis, window, 1 + left, lags[left])

    def powers(self, piece: Array) -> Array:
        """Return the periodograms (m, f) of a piece's stretches, each half over the next, without their trends."""
        starts = np.arange(0, piece.size - self.n + 1, self.n // 2)
        stretches = np.lib.stride_tricks.sliding_window_view(piece, self.n)[starts]
        rest = stretches - (stretches @ self.basis) @ self.basis.T
        return np.asarray(np.abs(np.fft.rfft(rest * self.window, axis=1)[:, self.bins]) ** 2)


@dataclass(frozen=True)
class _Calm:
    """The mean periodogram (f,) of the stretches that are calm, how many they are, the relative spread of a stretch's power."""

    window: _Window
    mean: Array
    count: int
    spread: float

    @property
    def level(self) -> float:
        """Return the variance that white noise of that power has."""
        return float(self.mean.sum() / self.window.expected[:, 0].sum())


def _calm(pieces: Sequence[Array], window: _Window) -> _Calm:
    from scipy.special import gammainc, gammainccinv, gammaincinv

    powers = np.concatenate([window.powers(piece) for piece in pieces if piece.size >= window.n])
    total = powers.sum(axis=1)

    def of(chosen: NDArray[np.intp]) -> _Calm:
        mean = powers[chosen].mean(axis=0)
        spread = np.sqrt(INDEPENDENT_POWERS * float(mean @ mean)) / max(float(mean.sum()), 1e-300)
        return _Calm(window, mean, chosen.size, spread)

    if total.size <= ENOUGH_STRETCHES:
        return of(np.arange(total.size))
    found = of(np.argsort(total)[: max(total.size // 4, 1)])
    # a stretch's power is a gamma variate, of which the lowest quarter has this mean
    shape = 1 / max(found.spread, 1e-6) ** 2
    level = float(found.mean.sum()) / max(float(gammainc(shape + 1, gammaincinv(shape, 0.25))) / 0.25, 0.1)
    for _ in range(CALM_ROUNDS):
        shape = 1 / max(found.spread, 1e-6) ** 2
        calm = np.flatnonzero(total <= level * float(gammainccinv(shape, REJECTED_SHARE)) / shape)
        found = of(calm)
        level = float(found.mean.sum())
    # what rings after a step is strong at one frequency in a few stretches: powers there are exponential variates about ln 2
    ratio = powers[calm] / (np.median(powers[calm], axis=0) / np.log(2) + 1e-300)
    quiet = ratio.max(axis=1) <= np.log(window.bins.size / REJECTED_SHARE)
    return of(calm[quiet]) if 2 * quiet.sum() > calm.size else found


class _Whittle:
    """The debiased Whittle likelihood of white noise and processes, whose parameters x are logarithms."""

    def __init__(self, calm: _Calm, spacing: float, quantum: float, least: float) -> None:
        self.calm, self.spacing, self.quantum = calm, spacing, quantum
        self.lag = spacing * np.arange(calm.window.n)
        self.samples = max(calm.count * calm.window.n // 2, calm.window.n)  # each stretch is half over the next
        self.weight = calm.count / INDEPENDENT_POWERS  # Hann's windows, half over each other, tell together what the samples do
        self.level = max(np.sqrt(calm.level), quantum / np.sqrt(12), least)

    def noise(self) -> GaugeNoise:
        """Return the noise with as many processes as Schwarz's criterion wants."""
        best = self.climb((), [[np.array([np.log(self.level)])]])
        kinds: tuple[str, ...] = ()
        while len(kinds) < GAUGE_PROCESSES:
            wider = [(self.climb((*kinds, kind), self.starts(best[1], kinds, kind)), kind) for kind in PROCESSES]
            found, kind = max(wider, key=lambda w: self.criterion(*w[0]))
            if self.criterion(*found) <= self.criterion(*best):
                break
            best, kinds = found, (*kinds, kind)
        white, colours = self.split(best[1], kinds)
        colours.sort(key=lambda c: -c[1])
        return GaugeNoise(white, self.quantum, tuple(colours), self.samples, float(self.lag[-1]))

    def expected(self, noise: GaugeNoise) -> Array:
        """Return the expected periodogram (f,) of a noise."""
        return np.asarray(self.calm.window.expected @ noise.covariance(self.lag))

    def criterion(self, likelihood: float, x: Array) -> float:
        return likelihood - 0.5 * x.size * float(np.log(self.samples))

    def split(self, x: Array, kinds: Sequence[str]) -> tuple[float, list[tuple[float, ...]]]:
        """Return the white level and the processes that x stands for."""
        values, at, colours = np.exp(x).tolist(), 1, []
        for kind in kinds:
            size = 2 + PROCESSES.index(kind)
            colours.append(tuple(values[at : at + size]))
            at += size
        return values[0], colours

    def cost(self, x: Array, kinds: Sequence[str]) -> tuple[float, Array]:
        """Return minus the log likelihood and its gradient."""
        white, colours = self.split(x, kinds)
        own = GaugeNoise(white, self.quantum)
        total, slopes = own.covariance(self.lag), [2 * GaugeNoise(white).covariance(self.lag)]
        for colour in colours:
            C = covariance(colour, self.lag)
            total = total + C
            by = covariance_slopes(colour, self.lag)
            slopes += [by[0], 2 * C, *by[1:]]
        columns = self.calm.window.expected @ np.column_stack([total, *slopes])
        E, E_x = columns[:, 0], columns[:, 1:]
        if not (E > 0).all():
            return np.inf, np.zeros(x.size)
        ratio = self.calm.mean / E
        return self.weight * float(np.sum(np.log(E) + ratio)), self.weight * ((1 - ratio) / E) @ E_x

    def climb(self, kinds: Sequence[str], starts: Sequence[Sequence[Array]]) -> tuple[float, Array]:
        """Return the log likelihood and x of the likeliest maximum, from the likeliest of each group of starts."""
        from scipy.optimize import minimize

        bounds = [*self.bounds(kinds)]
        low, high = np.array(bounds).T
        every = []
        for some in starts:
            begun = min((np.clip(x, low, high) for x in some), key=lambda x: self.cost(x, kinds)[0])
            every.append(minimize(self.cost, begun, (kinds,), jac=True, method="L-BFGS-B", bounds=bounds))
        found = min(every, key=lambda f: float(f.fun))
        return -float(found.fun), found.x

    def bounds(self, kinds: Sequence[str]) -> Iterator[tuple[float, float]]:
        level = np.log(self.level)
        spacing, longest = np.log(self.spacing), np.log(self.lag[-1])
        yield level + np.log(WHITE), level + np.log(10)
        for kind in kinds:
            yield (
                (spacing, longest) if kind == "relaxation" else (np.log(SLOWEST) - longest, np.log(FASTEST_OSCILLATION) - spacing)
            )
            yield level + np.log(WHITE), level + np.log(100)
            if kind == "oscillation":
                yield np.log(QUALITY[0]), np.log(QUALITY[1])

    def starts(self, x: Array, kinds: Sequence[str], kind: str) -> list[list[Array]]:
        """Return x with one more process that takes half of the variance; first, where a line stands out, then elsewhere."""
        places: list[tuple[float, ...]]
        if kind == "relaxation":
            places = [(np.log(self.spacing) + share * np.log(self.calm.window.n),) for share in CORRELATION_TIMES]
        else:
            white, colours = self.split(x, kinds)
            over = self.calm.mean / self.expected(GaugeNoise(white, self.quantum, tuple(colours)))
            peaks = np.array([self.calm.window.bins[int(np.argmax(over))] / self.calm.window.n, 0.03, 0.15]) / self.spacing
            places = [*product(np.log(peaks), np.log(QUALITIES))]
        sizes = [2 + PROCESSES.index(kind) for kind in kinds]
        levels = [0, *(2 + sum(sizes[:k]) for k in range(len(sizes)))]
        variance = float(np.sum(np.exp(2 * x[levels])))
        own = x.copy()
        own[levels] += 0.5 * np.log(0.5)
        begun = [np.concatenate([own, [place[0], 0.5 * np.log(0.5 * variance), *place[1:]]]) for place in places]
        return [begun] if kind == "relaxation" else [begun[: len(QUALITIES)], begun[len(QUALITIES) :]]
