"""The gauge's noise, and whether it is all that a fit leaves over.

Noise is what changes from sample to sample; what is slower than some tens of samples is signal that somebody has to explain. A
noise model that is fitted to whole residuals would call a slow misfit red noise, and nothing would ever be missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srfcli.inference.noise import Noise, stretches, whiten
from srfcli.inference.prediction import of_run
from srfcli.numerics.collocation import Array
from srfcli.recording.noise import describe_noise
from srfcli.recording.values import Run

WINDOWS, LEAST = 8, 64  # of each run, and samples of a window
SLOW = 6  # cosines over a window: what is slower than a window's sixth
FAINT = 0.08  # a correlation from sample to sample that is taken for none
ALIKE = 1.08  # noise levels of runs, over the lowest, that are the gauge's
DOUBT = 1e-4  # p-value below which noise is not all that is left
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


def _seen(run: Run, residual: Array, a: int, b: int) -> tuple[float, float, int]:
    """Return level, correlation from sample to sample and number of samples of the noise in a stretch."""
    t, r, ok = run.t[a:b], residual[a:b], (run.used & np.isfinite(residual))[a:b]
    modulation = of_run(run)
    cycles = modulation["f"] * float(np.median(np.diff(t))) if modulation["modulated"] else None
    if not ok.any():
        return max(run.quantum / np.sqrt(12), 1e-12), 0.0, 0
    about = describe_noise(np.interp(t, t[ok], r[ok]), cycles)
    level = about.total if np.isfinite(about.total) else about.white
    return max(level, run.quantum / np.sqrt(12), 1e-12), about.lag1 if np.isfinite(about.lag1) else 0.0, b - a


def _shared(seen: Sequence[tuple[float, float, int]]) -> Noise:
    """Return the noise of stretches that share a gauge: of those that have least."""
    lowest = min(s[0] for s in seen)
    kept = [s for s in seen if s[0] <= ALIKE * lowest]
    weights = np.array([max(s[2], 1) for s in kept], dtype=float)
    level = float(np.sqrt(np.average([s[0] ** 2 for s in kept], weights=weights)))
    rho = float(np.average([s[1] for s in kept], weights=weights))
    rho = 0.0 if abs(rho) < FAINT else min(max(rho, -0.9), 0.97)
    return Noise(level * float(np.sqrt(1 - rho**2)), (rho,) if rho else (), level)


def joined(pieces: Sequence[tuple[int, int, Noise]]) -> Noise:
    """Return the noise of a run from that of its stretches, the longest of which stands for the whole."""
    longest = max(pieces, key=lambda p: p[0])[2]
    if len(pieces) == 1:
        return longest
    return replace(longest, pieces=tuple((a, noise) for _, a, noise in sorted(pieces, key=lambda p: p[1])))


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
    from scipy.stats import chi2

    slow, degrees, squares, count = 0.0, 0.0, 0.0, 0
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
        p_values[run.name] = float(chi2.sf(own, free))
        squares, count = squares + float(white @ white) * n / max(n - spent, 1.0), count + n
        excess[run.name] = max(float(white @ white) - (n - spent), 0.0)
    whole = sum(excess.values())
    shares = {name: value / whole if whole > 0 else 0.0 for name, value in excess.items()}
    far = sorted(
        (w for w in windows if w[4] > 4 * np.sqrt(2 * SLOW) or w[3] > 6 * np.sqrt(2 * LEAST)), key=lambda w: -w[3]
    )
    return Adequacy(
        float(chi2.sf(slow, max(degrees, 1.0))), float(np.sqrt(squares / max(count, 1))), shares,
        tuple(w[:4] for w in far), p_values,
    )  # fmt: skip
