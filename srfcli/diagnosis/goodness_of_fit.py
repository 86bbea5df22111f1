"""The gauge's noise, and whether it is all that a fit leaves over.

Noise is what changes from sample to sample; what is slower than some tens of samples is signal that somebody has to explain. A
noise model that is fitted to whole residuals would call a slow misfit red noise, and nothing would ever be missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srfcli.codegen.model import Array
from srfcli.data.noise import TREND, describe_noise
from srfcli.data.values import Run
from srfcli.inference.noise import Noise, stretches, whiten
from srfcli.inference.prediction import of_run

WINDOWS, LEAST = 8, 64  # of each run, and samples of a window
SLOW = 6  # cosines over a window: what is slower than a window's sixth
FAINT = 0.08  # a correlation from sample to sample that is taken for none
ALIKE = 1.08  # noise levels of runs, over the lowest, that are the gauge's; beside what chance makes of them
CHANCE = 2.5  # standard deviations by which chance parts two levels
LOSS = 1.5  # times its spread that a level has for the trend that was taken out of every stretch
DOUBT = 1e-4  # p-value below which noise is not all that is left
STEADY = 0.003  # relative change of an innovation, and change of a correlation, that leave noise as it was
SURE = 1.04  # residual over noise that its level's own uncertainty explains


def gauge_noise(runs: Sequence[Run], residuals: Mapping[str, Array]) -> dict[str, Noise]:
    """Return the noise of each run: level and colour of the runs that have least, which share a gauge with the others.

    Noise is white or has one correlation from sample to sample; what is sampled at other intervals is apart, within a run too.
    """
    groups: dict[tuple[float, str], list[tuple[Run, int, int]]] = {}
    for run in runs:
        for step, a, b in sampled(run):
            groups.setdefault((step, run.observable), []).append((run, a, b))
    found: dict[str, list[tuple[int, int, Noise]]] = {run.name: [] for run in runs}
    for members in groups.values():
        noise = _shared([_seen(run, residuals[run.name], a, b) for run, a, b in members])
        for run, a, b in members:
            found[run.name].append((b - a, a, noise))
    return {name: joined(pieces) for name, pieces in found.items()}


def sampled(run: Run) -> list[tuple[float, int, int]]:
    """Return the stretches [a, b) of a run by sampling interval (s), of two digits; short ones join their neighbours."""
    pieces: list[list[float]] = []
    for a, b in stretches(run.t, np.ones(run.t.size, dtype=bool)):
        step = float(f"{float(np.median(np.diff(run.t[a:b]))) if b - a > 1 else 0.0:.2g}")
        if pieces and (pieces[-1][0] == step or b - a < LEAST or pieces[-1][2] - pieces[-1][1] < LEAST):
            if pieces[-1][2] - pieces[-1][1] < LEAST and b - a >= LEAST:
                pieces[-1][0] = step
            pieces[-1][2] = b
        else:
            pieces.append([step, a, b])
    return [(step, int(a), int(b)) for step, a, b in pieces]


@dataclass(frozen=True)
class _Seen:
    """Level, correlation from sample to sample, and number of samples of the noise in a stretch; `used` of them are calm."""

    level: float
    rho: float
    samples: int
    used: int

    @property
    def spread(self) -> float:
        """Return the relative standard deviation of the level."""
        return LOSS * float(np.sqrt((1 + self.rho**2) / (1 - self.rho**2) / 2 / max(self.used, 1)))


def _seen(run: Run, residual: Array, a: int, b: int) -> _Seen:
    """Return the noise in a stretch."""
    t, r, ok = run.t[a:b], residual[a:b], (run.used & np.isfinite(residual))[a:b]
    modulation = of_run(run)
    cycles = modulation["f"] * float(np.median(np.diff(t))) if modulation["modulated"] else None
    if not ok.any():
        return _Seen(1.0, 0.0, 0, 0)
    about = describe_noise(_only_used(r, ok), cycles)
    level = about.total if np.isfinite(about.total) else about.white
    rho = min(max(about.lag1, -0.9), 0.97) if np.isfinite(about.lag1) else 0.0
    return _Seen(max(level, run.quantum / np.sqrt(12), 1e-12), rho, int(ok.sum()), about.samples)


def _only_used(x: Array, ok: Array) -> Array:
    """Return the pieces of x (n,) that are used throughout, or where they are few what is used of it, closed up.

    A line across a gap would be calmer than any noise; a place where it was closed is one of the wilder.
    """
    if ok.all():
        return x
    count = x.size // TREND
    pieces, whole = x[: count * TREND].reshape(count, TREND), ok[: count * TREND].reshape(count, TREND).all(axis=1)
    return np.asarray(pieces[whole].ravel() if 4 * whole.sum() >= max(count, 4) else x[ok])


def _telling(seen: Sequence[_Seen]) -> Sequence[_Seen]:
    """Return those stretches that are long enough to tell a level, all where none is."""
    return [s for s in seen if s.samples >= LEAST // 2] or seen


def quietest(run: Run, residual: Array) -> float:
    """Return the lowest level of noise in a stretch of a residual (n,), infinite for one that is not finite."""
    if not np.isfinite(residual[run.used]).all():
        return np.inf
    return min(s.level for s in _telling([_seen(run, residual, a, b) for _, a, b in sampled(run)]))


def _shared(seen: Sequence[_Seen]) -> Noise:
    """Return the noise of stretches that share a gauge: of those that have least."""
    seen = _telling(seen)
    least = min(seen, key=lambda s: s.level)
    kept = [
        s for s in seen if s.level <= least.level * max(ALIKE, 1 + CHANCE * float(np.hypot(s.spread, least.spread)))
    ]
    weights = np.array([max(s.samples, 1) for s in kept], dtype=float)
    level = float(np.sqrt(np.average([s.level**2 for s in kept], weights=weights)))
    rho = float(np.average([s.rho for s in kept], weights=weights))
    rho = 0.0 if abs(rho) < FAINT else rho
    used = max(sum(s.used for s in kept), 1)
    slack = 2 * LOSS * float(np.sqrt((1 + rho) / (1 - rho) / used)) if rho else 0.0
    return Noise(level * float(np.sqrt(1 - rho**2)), (rho,) if rho else (), level, slack=slack)


def joined(pieces: Sequence[tuple[int, int, Noise]]) -> Noise:
    """Return the noise of a run from that of its stretches, the longest of which stands for the whole."""
    longest = max(pieces, key=lambda p: p[0])[2]
    if len(pieces) == 1:
        return longest
    return replace(longest, pieces=tuple((a, noise) for _, a, noise in sorted(pieces, key=lambda p: p[1])))


def alike(a: Noise, b: Noise) -> bool:
    """Return whether two noises of a run are, but for less than anything rests on, the same."""
    pieces = zip(_pieces(a), _pieces(b), strict=False)
    return len(a.pieces) == len(b.pieces) and all(
        abs(x.innovation / y.innovation - 1) < STEADY and abs(sum(x.coefficients) - sum(y.coefficients)) < STEADY
        for x, y in pieces
    )


def _pieces(noise: Noise) -> list[Noise]:
    return [own for _, own in noise.pieces] or [noise]


@dataclass(frozen=True)
class Adequacy:
    """`p_value` of noise alone in what is slow, over all windows; `rms_over_noise` of whitened residuals.

    `shares` is each run's part of the excess, `windows` (run, start s, end s, excess) those that stand out, worst first.
    `p_tracks` is the p-value of one roughness for all runs: what a track takes up in some runs only is not the track.
    """

    p_value: float
    rms_over_noise: float
    shares: dict[str, float]
    windows: tuple[tuple[str, float, float, float], ...]
    p_values: dict[str, float]
    p_tracks: float = 1.0

    @property
    def fine(self) -> bool:
        """True where noise may be all that is left, and the tracks what tracks are: as rough in one run as in another."""
        return min(self.p_value, self.p_tracks) > DOUBT and self.rms_over_noise < SURE


def judge_residuals(runs: Sequence[Run], residuals: Mapping[str, Array], noise: Mapping[str, Noise], *,
                    freedom: Mapping[str, float] | None = None) -> Adequacy:  # fmt: skip
    """Return the adequacy of residuals (n,) by run; `freedom` is how many parameters' worth a fit has taken from each run."""
    from scipy.fft import dct

    slow, degrees, squares, count = 0.0, 0.0, 0.0, 0
    slack: dict[Noise, float] = {}
    windows, excess, p_values = [], {}, {}
    for run in runs:
        r = residuals[run.name]
        parts = stretches(run.t, run.used & np.isfinite(r))
        white = whiten(noise[run.name], r, parts)
        times = np.concatenate([run.t[a:b] for a, b in parts]) if parts else run.t[:0]
        n = white.size
        spent = min((freedom or {}).get(run.name, 0.0), 0.4 * n)
        own, pieces = 0.0, np.array_split(np.arange(n), max(min(WINDOWS, n // LEAST), 1))
        level = float(np.median(white**2)) / 0.4549  # of its own noise: the level is not what is asked here
        level = min(max(level, 1 / SURE**2), SURE**2)
        for piece in pieces:
            low = dct(white[piece], norm="ortho")[:SLOW] if piece.size > SLOW else white[piece]
            stands = float(low @ low) / level - low.size
            windows.append(
                (
                    run.name,
                    float(times[piece[0]]),
                    float(times[piece[-1]]),
                    float(np.sum(white[piece] ** 2)) / level - piece.size,
                    stands,
                )
            )
            own += float(low @ low) / level
        free = max(SLOW * len(pieces) - 0.5 * spent, 0.25 * SLOW * len(pieces))
        slow, degrees = slow + own, degrees + free
        slack[noise[run.name]] = slack.get(noise[run.name], 0.0) + free * noise[run.name].slack
        p_values[run.name] = _tail(own, free, noise[run.name].slack)
        squares, count = squares + float(white @ white) * n / max(n - spent, 1.0), count + n
        excess[run.name] = max(float(white @ white) - (n - spent), 0.0)
    whole = sum(excess.values())
    shares = {name: value / whole if whole > 0 else 0.0 for name, value in excess.items()}
    far = sorted(
        (w for w in windows if w[4] > 4 * np.sqrt(2 * SLOW) or w[3] > 6 * np.sqrt(2 * LEAST)), key=lambda w: -w[3]
    )
    loose = float(np.hypot.reduce(list(slack.values()))) / max(degrees, 1.0)
    return Adequacy(
        _tail(slow, max(degrees, 1.0), loose), float(np.sqrt(squares / max(count, 1))), shares,
        tuple(w[:4] for w in far), p_values,
    )  # fmt: skip


def _tail(squares: float, degrees: float, slack: float) -> float:
    """Return the p-value of a sum of squares over noise whose power has been estimated: of Fisher's F, or of chi-squared."""
    from scipy.stats import chi2, f

    return float(f.sf(squares / degrees, degrees, 2 / slack**2) if slack else chi2.sf(squares, degrees))
