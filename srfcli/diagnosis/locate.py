"""Where recording and baseline part: runs and times, phases of forcing and stick-slip, frequencies, quantities of state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from srfcli.diagnosis.pieces import pieces_of
from srfcli.diagnosis.places import Atlas, Piece, Row
from srfcli.diagnosis.straight import unbent
from srfcli.inference.latent import LatentFit
from srfcli.inference.noise import Noise
from srfcli.inference.prediction import of_run
from srfcli.numerics.collocation import Array

LEVEL = 0.01  # p-value, adjusted for all that was looked at, from which a place stands out
DRAWS = 200
LARGE = 10.0  # standard deviations of the noise beyond which a residual counts no more, where times are told
CELLS, HELD = 64, 0.8  # of a run, and the share of its excess that its windows must hold
OWN = ("run", "window")  # axes along a run's time
MOST = 5  # windows and lines that are named
PROMINENT, BESIDE, FAINT = (
    4.0,
    15,
    0.01,
)  # of a line: times its neighbours' median, how many neighbours, share of the strongest
EVENTS = 3  # stick-slip events from which there is a cycle


@dataclass(frozen=True)
class RunPlace:
    """A run that stands out: its share of the excess misfit, and the times, on its own clock, that hold most of it."""

    name: str
    share: float
    windows: tuple[tuple[float, float], ...]
    p_value: float


@dataclass(frozen=True)
class Location:
    """Where the misfit is: `forcing_phase` in rad (of a cosine of the load), `coordinate` the name and the share it explains."""

    runs: tuple[RunPlace, ...]
    forcing_phase: tuple[float, float] | None
    frequencies: tuple[float, ...]
    coordinate: tuple[str, float] | None
    p_value: float
    atlas: tuple[Row, ...] = field(default=(), repr=False)

    def described(self) -> dict[str, object]:
        """Return the object that `srf.diagnose/1` has under location."""
        return {
            "runs": [
                {"name": r.name, "share": r.share, "windows": [list(w) for w in r.windows], "p_value": r.p_value}
                for r in self.runs
            ],
            "forcing_phase": None if self.forcing_phase is None else list(self.forcing_phase),
            "frequencies_hz": list(self.frequencies),
            "coordinate": None if self.coordinate is None else {"name": self.coordinate[0], "r2": self.coordinate[1]},
        }


def locate(
    fitted: LatentFit, noise: Mapping[str, Noise], *, last: LatentFit | None = None, draws: int = DRAWS, seed: int = 0
) -> Location:
    """Return where the recordings part from a fit, with error control over everything that is looked at.

    `draws` recordings with nothing but noise (and the track) are simulated through the same projection. A fit that is far off has
    bent its parameters, and its misfit is everywhere; once it is sure that there is one, the places are those of the same model
    with parameters that leave as much as possible in order (see `unbent`), `last` being the better model. Phases, lines and
    quantities are looked for as long as each run is followed: once cycles are lost, a residual says nothing of them.
    """
    forcing = {r.name: of_run(r)["f"] for r in fitted.problem.runs if of_run(r)["modulated"]}
    precision, root, at = _prior(fitted)
    pieces = pieces_of(fitted, noise)
    atlas = Atlas(pieces, precision, root=root)
    M = atlas.projected([p.white for p in pieces], at=at)
    found = read_atlas(atlas, M, atlas.null(draws, seed=seed), forcing)
    if found.p_value >= LEVEL:
        return found
    straight = unbent(fitted, noise, last)
    pieces, prior = pieces_of(straight, noise), _prior(straight)[0]
    whole, begun = (_read_kept(some, prior, forcing, draws, seed) for some in (pieces, [p.followed() for p in pieces]))
    told = begun.coordinate or found.coordinate
    rows = [r for r in whole.atlas if r.axis in OWN] + [r for r in begun.atlas if r.axis not in OWN]
    return replace(begun, runs=whole.runs, coordinate=told, p_value=found.p_value, atlas=tuple(rows))


def _read_kept(pieces: Sequence[Piece], prior: Array, forcing: Mapping[str, float], draws: int, seed: int) -> Location:
    """Return what stands out of residuals as they are."""
    atlas = Atlas(pieces, prior, kept=True)
    return read_atlas(atlas, atlas.projected([p.white for p in pieces]), atlas.null(draws, seed=seed), forcing)


def _prior(fitted: LatentFit) -> tuple[Array, Array | None, Array]:
    """Return precision (k, k) and root (k, j) of the track's prior among all columns, and the columns' own values (k,)."""
    point, n = fitted.point, fitted.point.theta.size
    k = n + point.tracks.numbers.size
    precision, at = np.zeros((k, k)), np.zeros(k)
    if not point.tracks.splines:
        return precision, None, at
    L = point.tracks.root(point.roughness if point.roughness.amplitude else replace(point.roughness, amplitude=1e-9))
    inverse = np.linalg.inv(L)
    precision[n:, n:], at[n:] = inverse.T @ inverse, point.tracks.numbers
    return precision, np.vstack([np.zeros((n, L.shape[1])), L]), at


def read_atlas(atlas: Atlas, M: Sequence[Array], null: Array, forcing: Mapping[str, float]) -> Location:
    """Return what stands out of projected residuals M (n,) by run; `forcing` is the modulation's frequency (Hz) by run."""
    rows = atlas.rows(M, null)
    excess = {p.name: float(m @ m - spare.sum()) for p, m, spare in zip(atlas.pieces, M, atlas.spare, strict=True)}
    whole = sum(max(e, 0.0) for e in excess.values())
    runs = []
    for piece, m, spare in zip(atlas.pieces, M, atlas.spare, strict=True):
        own = [r for r in rows if r.run == piece.name and r.axis in (*OWN, "frequency")]
        best = min(own, key=lambda r: r.log_p)
        if best.p_value < LEVEL:
            share = max(excess[piece.name], 0.0) / whole if whole > 0 else 0.0
            runs.append(RunPlace(piece.name, share, _windows(piece, m, spare, own), best.p_value))
    return Location(
        tuple(sorted(runs, key=lambda r: (-r.share, r.p_value))),
        _phase([r for r in rows if r.axis == "forcing" and r.kind == "mean"]),
        _lines(rows, atlas, forcing),
        _coordinate(rows, atlas, M),
        min(r.p_value for r in rows),
        _kept(rows),
    )


def _windows(piece: Piece, m: Array, spare: Array, rows: Sequence[Row]) -> tuple[tuple[float, float], ...]:
    """Return the shortest stretches that hold most of a run's excess; the slow shapes that stand out where power does not."""
    powerful = [r for r in rows if r.kind == "power" and r.p_value < LEVEL]
    if powerful:
        return _dense(piece, m, spare)
    found: list[tuple[float, float]] = []
    slow = [r for r in rows if r.axis in OWN and r.kind == "shape" and r.p_value < LEVEL]
    for row in sorted(slow, key=lambda r: r.log_p):
        if all(row.high < a or row.low > b for a, b in found):
            found.append((row.low, row.high))
    return tuple(sorted(found[:MOST]))


def _dense(piece: Piece, m: Array, spare: Array) -> tuple[tuple[float, float], ...]:
    edges = np.linspace(0, m.size, min(CELLS, max(m.size // 16, 1)) + 1).astype(int)
    power = np.minimum(m**2, LARGE**2)  # a lost cycle is a misfit as any other
    excess = np.array([float(np.sum(power[a:b] - spare[a:b])) for a, b in pairwise(edges.tolist())])
    order = np.argsort(-excess)
    reached = np.cumsum(excess[order])
    count = int(np.searchsorted(reached, HELD * reached.max())) + 1
    taken = np.zeros(excess.size, dtype=bool)
    taken[order[:count]] = True
    closed = taken.copy()
    closed[1:-1] |= taken[:-2] & taken[2:]  # a single cell between two that count is no gap
    steps = np.diff(np.concatenate([[0], closed.astype(int), [0]]))
    spans = list(zip(np.nonzero(steps > 0)[0].tolist(), np.nonzero(steps < 0)[0].tolist(), strict=True))
    best = sorted(spans, key=lambda s: -float(excess[s[0] : s[1]].sum()))[:MOST]
    return tuple(sorted((float(piece.t[edges[a]]), float(piece.t[edges[b] - 1])) for a, b in best))


def _phase(rows: Sequence[Row]) -> tuple[float, float] | None:
    """Return the stretch of the forcing's period, in rad, whose bins stand out with one sign, about the strongest."""
    if not rows or min(r.p_value for r in rows) >= LEVEL:
        return None
    z = [r.z or 0.0 for r in rows]
    top = int(np.argmax(np.abs(z)))

    def alike(i: int) -> bool:
        row = rows[i % len(rows)]
        return row.p_value < LEVEL and (row.z or 0.0) * z[top] > 0 and abs(row.z or 0.0) > 0.5 * abs(z[top])

    first = last = top
    while last - first < len(rows) - 1 and alike(first - 1):
        first -= 1
    while last - first < len(rows) - 1 and alike(last + 1):
        last += 1
    if last - first >= len(rows) - 2:
        return None  # it is everywhere
    turn = 2 * np.pi
    low = rows[first % len(rows)].low * turn
    high = rows[last % len(rows)].high * turn
    return (low, high if high > low else high + turn)


def _lines(rows: Sequence[Row], atlas: Atlas, forcing: Mapping[str, float]) -> tuple[float, ...]:
    """Return the frequencies of narrow peaks: the forcing's harmonics, where no other is nearer, then others, strongest first."""
    peaks: list[tuple[bool, float, float, float]] = []  # harmonic or not, statistic, frequency, width
    for piece in atlas.pieces:
        own = [r for r in rows if r.run == piece.name and r.kind == "line"]
        S = np.array([r.statistic for r in own])
        base = forcing.get(piece.name)
        for i, row in enumerate(own):
            if i < 3 or row.p_value >= LEVEL or not _peaked(S, i):
                continue
            f, width = 0.5 * (row.low + row.high), row.high - row.low
            order = round(f / base) if base else 0
            harmonic = bool(base and order > 0 and abs(f - base * order) <= 1.5 * width)
            peaks.append((harmonic, float(S[i]), base * order if base and harmonic else f, width))
    strongest = max((strength for _, strength, _, _ in peaks), default=0.0)
    found: list[tuple[float, float]] = []
    for harmonic, strength, f, width in sorted(peaks, reverse=True):
        seen = harmonic or strength >= FAINT * strongest
        if seen and all(abs(f - g) > 1.5 * max(width, w) for g, w in found):
            found.append((f, width))
    return tuple(f for f, _ in found[:MOST])


def _peaked(S: Array, i: int) -> bool:
    """Return whether a line stands above all beside it, and clearly above what is a little further away."""
    beside = np.concatenate([S[max(i - BESIDE, 0) : max(i - 2, 0)], S[i + 3 : i + BESIDE + 1]])
    return bool(S[i] >= S[max(i - 3, 0) : i + 4].max() and S[i] >= PROMINENT * np.median(beside))


def _coordinate(rows: Sequence[Row], atlas: Atlas, M: Sequence[Array]) -> tuple[str, float] | None:
    """Return the quantity a smooth function of which explains most of the excess misfit, with that share."""
    smooth = [r for r in rows if r.run == "" and r.kind == "shape" and r.p_value < LEVEL]
    left = sum(float(m @ m) for m in M) - sum(float(s.sum()) for s in atlas.spare)
    if not smooth or left <= 0:
        return None
    best = max(smooth, key=lambda r: r.statistic - r.freedom)
    return best.axis, float(np.clip((best.statistic - best.freedom) / left, 0.0, 1.0))


def _kept(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return the atlas without the lines of the spectra in which nothing is."""
    return tuple(r for r in rows if r.kind != "line" or r.p_value < LEVEL)
