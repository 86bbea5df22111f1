"""Where recording and baseline differ: local statistics of innovations over runs, times, phases, frequencies and states.

With standardised innovations r and columns X, their derivatives by the parameters, what no parameter explains is M r,
M = 1 - X (X'X)^-1 X'. For local columns B, (B'M r)' (B'M B)^-1 (B'M r) is chi-squared under noise, whatever the true parameters
are; so, nearly, is the sum of squares of M r over a set of samples, with tr(M) over the set for its degrees of freedom. The
smallest p-value of all of them is judged by its own distribution, simulated through the same projection.

A model that lacks something bends its parameters and widens its random friction field, and its misfit is everywhere. Where a
better model is known, the baseline is read with the parameters, the field and the gauge's noise of that one: then the innovations
are far off where the physics is missing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.special import gammaincc, gammaln

from srfcli.codegen.model import Array
from srfcli.data.values import Run
from srfcli.diagnosis.search import Fitted
from srfcli.inference.kalman import Innovations
from srfcli.inference.noise import stretches
from srfcli.inference.prediction import effect_inputs
from srfcli.inference.recordings import slip_along
from srfcli.motion.imposed import runs_of
from srfcli.motion.simulate import stick_slip

# Where recording and baseline part: runs and times, phases of forcing and stick-slip, frequencies, quantities of state.

SIGNIFICANT = 0.01  # p-value, adjusted for all that was looked at, from which a place stands out
DRAWS = 200
MAX_RESIDUAL = 10.0  # standard deviations of the noise beyond which a residual counts no more, where times are told
RUN_CELLS, EXCESS_SHARE = 64, 0.8  # of a run, and the share of its excess that its windows must hold
TIME_AXES = ("run", "window")  # axes along a run's time
MAX_NAMED = 5  # windows and lines that are named
# of a line: times its neighbours' median, how many neighbours, share of the strongest
MIN_PROMINENCE, NEIGHBOURS, MIN_RELATIVE_HEIGHT = (4.0, 15, 0.01)
MIN_EVENTS = 3  # stick-slip events from which there is a cycle


@dataclass(frozen=True)
class RunMisfit:
    """A run that stands out: its share of the excess misfit, and the times, on its own clock, that hold most of it."""

    name: str
    share: float
    windows: tuple[tuple[float, float], ...]
    p_value: float


@dataclass(frozen=True)
class Location:
    """Where the misfit is: `forcing_phase` in rad (of a cosine of the load), `coordinate` the name and the share it explains."""

    runs: tuple[RunMisfit, ...]
    forcing_phase: tuple[float, float] | None
    frequencies: tuple[float, ...]
    coordinate: tuple[str, float] | None
    p_value: float
    rows: tuple[ScanStatistic, ...] = field(default=(), repr=False)

    def described(self) -> dict[str, object]:
        """Return the object that `srf.diagnose/1` has under location."""
        return {
            "runs": [asdict(r) for r in self.runs],
            "forcing_phase": None if self.forcing_phase is None else list(self.forcing_phase),
            "frequencies_hz": list(self.frequencies),
            "coordinate": None if self.coordinate is None else {"name": self.coordinate[0], "r2": self.coordinate[1]},
        }


def locate(fitted: Fitted, *, last: Fitted | None = None, seed: int = 0) -> Location:
    """Return where the recordings part from a fitted model, with error control over everything that is looked at.

    DRAWS recordings with nothing but noise are simulated through the same projection. Of a model that is known to be better,
    `last`, the parameters, the field and the noise are taken, and what is uncertain of them counts as noise. Phases, lines and
    quantities are looked for as long as each run is followed: once cycles are lost, a residual says nothing of them.
    Critical loads have no place.
    """
    likelihood, values = fitted.fit.likelihood, fitted.fit.values
    if not likelihood.problem.runs:
        return Location((), None, (), None, 1.0)
    forcing = {r.name: effect_inputs(r)["f"] for r in likelihood.problem.runs if effect_inputs(r)["modulated"]}
    if last is not None:
        values = {n: last.fit.values.get(n, v) for n, v in values.items()}  # on a smooth track its field is of amplitude 0
    pieces = run_residuals(fitted, values)

    def of(some: Sequence[RunResiduals]) -> Location:
        scan = ResidualScan(some, len(likelihood.names), kept=last is not None)
        return significant_misfit(scan, scan.projected([p.white for p in some]), scan.null(DRAWS, seed=seed), forcing)

    whole = of(pieces)
    if last is None:
        return whole
    begun = of([p.followed() for p in pieces])
    rows = [r for r in whole.rows if r.axis in TIME_AXES] + [r for r in begun.rows if r.axis not in TIME_AXES]
    return replace(begun, runs=whole.runs, p_value=min(whole.p_value, begun.p_value), rows=tuple(rows))


def significant_misfit(scan: ResidualScan, M: Sequence[Array], null: Array, forcing: Mapping[str, float]) -> Location:
    """Return what stands out of projected residuals M (n,) by run; `forcing` is the modulation's frequency (Hz) by run."""
    rows = scan.rows(M, null)
    excess = {
        p.name: float(m @ m - expected_squares.sum())
        for p, m, expected_squares in zip(scan.pieces, M, scan.expected_squares, strict=True)
    }
    whole = sum(max(e, 0.0) for e in excess.values())
    runs = []
    for piece, m, expected_squares in zip(scan.pieces, M, scan.expected_squares, strict=True):
        own = [r for r in rows if r.run == piece.name and r.axis in (*TIME_AXES, "frequency")]
        best = min(own, key=lambda r: r.log_p)
        if best.p_value < SIGNIFICANT:
            share = max(excess[piece.name], 0.0) / whole if whole > 0 else 0.0
            runs.append(RunMisfit(piece.name, share, _windows(piece, m, expected_squares, own), best.p_value))
    return Location(
        tuple(sorted(runs, key=lambda r: (-r.share, r.p_value))),
        _phase([r for r in rows if r.axis == "forcing" and r.kind == "mean"]),
        _lines(rows, scan, forcing),
        _coordinate(rows, scan, M),
        min(r.p_value for r in rows),
        tuple(r for r in rows if r.kind != "line" or r.p_value < SIGNIFICANT),  # without lines of spectra in which nothing is
    )


def _windows(
    piece: RunResiduals, m: Array, expected_squares: Array, rows: Sequence[ScanStatistic]
) -> tuple[tuple[float, float], ...]:
    """Return the shortest stretches that hold most of a run's excess; the slow shapes that stand out where power does not."""
    powerful = [r for r in rows if r.kind == "power" and r.p_value < SIGNIFICANT]
    if powerful:
        return _dense(piece, m, expected_squares)
    found: list[tuple[float, float]] = []
    slow = [r for r in rows if r.axis in TIME_AXES and r.kind == "shape" and r.p_value < SIGNIFICANT]
    for row in sorted(slow, key=lambda r: r.log_p):
        if all(row.high < a or row.low > b for a, b in found):
            found.append((row.low, row.high))
    return tuple(sorted(found[:MAX_NAMED]))


def _dense(piece: RunResiduals, m: Array, expected_squares: Array) -> tuple[tuple[float, float], ...]:
    edges = np.linspace(0, m.size, min(RUN_CELLS, max(m.size // 16, 1)) + 1).astype(int)
    power = np.minimum(m**2, MAX_RESIDUAL**2)  # a lost cycle is a misfit as any other
    excess = np.array([float(np.sum(power[a:b] - expected_squares[a:b])) for a, b in pairwise(edges.tolist())])
    order = np.argsort(-excess)
    reached = np.cumsum(excess[order])
    count = int(np.searchsorted(reached, EXCESS_SHARE * reached.max())) + 1
    taken = np.zeros(excess.size, dtype=bool)
    taken[order[:count]] = True
    closed = taken.copy()
    closed[1:-1] |= taken[:-2] & taken[2:]  # a single cell between two that count is no gap
    best = sorted(runs_of(closed), key=lambda s: -float(excess[s[0] : s[1] + 1].sum()))[:MAX_NAMED]
    return tuple(sorted((float(piece.t[edges[a]]), float(piece.t[edges[b + 1] - 1])) for a, b in best))


def _phase(rows: Sequence[ScanStatistic]) -> tuple[float, float] | None:
    """Return the stretch of the forcing's period, in rad, whose bins stand out with one sign, about the strongest."""
    if not rows or min(r.p_value for r in rows) >= SIGNIFICANT:
        return None
    z = [r.z or 0.0 for r in rows]
    top = int(np.argmax(np.abs(z)))

    def alike(i: int) -> bool:
        row = rows[i % len(rows)]
        return row.p_value < SIGNIFICANT and (row.z or 0.0) * z[top] > 0 and abs(row.z or 0.0) > 0.5 * abs(z[top])

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


def _lines(rows: Sequence[ScanStatistic], scan: ResidualScan, forcing: Mapping[str, float]) -> tuple[float, ...]:
    """Return the frequencies of narrow peaks: the forcing's harmonics, where no other is nearer, then others, strongest first."""
    peaks: list[tuple[bool, float, float, float]] = []  # harmonic or not, statistic, frequency, width
    for piece in scan.pieces:
        own = [r for r in rows if r.run == piece.name and r.kind == "line"]
        S = np.array([r.statistic for r in own])
        base = forcing.get(piece.name)
        for i, row in enumerate(own):
            if i < 3 or row.p_value >= SIGNIFICANT or not _is_peak(S, i):
                continue
            f, width = 0.5 * (row.low + row.high), row.high - row.low
            order = round(f / base) if base else 0
            harmonic = bool(base and order > 0 and abs(f - base * order) <= 1.5 * width)
            peaks.append((harmonic, float(S[i]), base * order if base and harmonic else f, width))
    strongest = max((strength for _, strength, _, _ in peaks), default=0.0)
    found: list[tuple[float, float]] = []
    for harmonic, strength, f, width in sorted(peaks, reverse=True):
        seen = harmonic or strength >= MIN_RELATIVE_HEIGHT * strongest
        if seen and all(abs(f - g) > 1.5 * max(width, w) for g, w in found):
            found.append((f, width))
    return tuple(f for f, _ in found[:MAX_NAMED])


def _is_peak(S: Array, i: int) -> bool:
    """Return whether a line stands above all beside it, and clearly above what is a little further away."""
    beside = np.concatenate([S[max(i - NEIGHBOURS, 0) : max(i - 2, 0)], S[i + 3 : i + NEIGHBOURS + 1]])
    return bool(S[i] >= S[max(i - 3, 0) : i + 4].max() and S[i] >= MIN_PROMINENCE * np.median(beside))


def _coordinate(rows: Sequence[ScanStatistic], scan: ResidualScan, M: Sequence[Array]) -> tuple[str, float] | None:
    """Return the quantity a smooth function of which explains most of the excess misfit, with that share."""
    smooth = [r for r in rows if r.run == "" and r.kind == "shape" and r.p_value < SIGNIFICANT]
    left = sum(float(m @ m) for m in M) - sum(float(s.sum()) for s in scan.expected_squares)
    if not smooth or left <= 0:
        return None
    best = max(smooth, key=lambda r: r.statistic - r.freedom)
    return best.axis, float(np.clip((best.statistic - best.freedom) / left, 0.0, 1.0))


# A fit's runs as pieces of a scan: residuals and columns, whitened, with what their samples can be sorted by.

LOST_CYCLE = 30.0  # standard deviations of an innovation: a cycle is lost


def run_residuals(fitted: Fitted, values: Mapping[str, float]) -> list[RunResiduals]:
    """Return each fitted run's standardised innovations under `values`, derivatives, and what its samples can be sorted by."""
    likelihood = fitted.fit.likelihood
    found = []
    for f in likelihood.over_runs(lambda run: likelihood.filtered(run, values, slopes=True, keep=True)):
        run, got = f.run, f.found
        index = np.nonzero(run.used & np.isfinite(got.nu) & (got.S > 0))[0]
        scale = np.array([abs(values.get(n, 0.0)) for n in f.names])
        white = got.nu[index] / np.sqrt(got.S[index])
        X = -got.nu_d[index] / np.sqrt(got.S[index])[:, None] * scale
        indices = np.array([likelihood.names.index(n) for n in f.names], dtype=int)
        good = np.zeros(run.t.size, dtype=bool)
        good[index] = True
        ends = np.cumsum([0, *(b - a for a, b in stretches(run.t, good))]).tolist()
        sorted_by = {name: x[index] for name, x in _coordinates(fitted, run, got).items()}
        forcing, cycle = (None if x is None else x[index] for x in (_forcing(run), _cycle(run)))
        lost = LOST_CYCLE if cycle is not None else np.inf  # steady sliding has no cycle to lose
        known = {k: x for k, x in sorted_by.items() if np.isfinite(x).all()}
        found.append(RunResiduals(run.name, run.t[index], white, X, indices, tuple(pairwise(ends)), known, forcing, cycle, lost))
    return found


def _coordinates(fitted: Fitted, run: Run, found: Innovations) -> dict[str, Array]:
    """Return the quantities that the misfit may go with, each (n,), as the filter expects them."""
    states = fitted.fit.likelihood.problem.model.states
    assert found.kept is not None
    x, (W, W_dot) = found.kept.mean, run.load(run.t)
    known = {"W": W, "dlnW/dt": W_dot / W, "time": run.t, "position": slip_along(run, x, tuple(states))}
    for state, name in (("ln_v", "v"), ("ln_phi", "phi")):
        if state in states:
            known[name] = x[:, states.index(state)]  # their logarithms: it is the same order
    return known


def _forcing(run: Run) -> Array | None:
    """Return the phase of the load's modulation, from 0 to 1, while it is on."""
    m = effect_inputs(run)
    if not m["modulated"]:
        return None
    phase = np.mod(m["f"] * run.t + m["psi"] / (2 * np.pi), 1.0)
    return np.where(run.t > m["onset0"] + m["rise0"], phase, np.nan)


def _cycle(run: Run) -> Array | None:
    """Return the phase of stick-slip, 0 at one event and 1 at the next, between recorded events."""
    m = effect_inputs(run)
    events = stick_slip(run.t, run.observed, ripple=m["f"] if m["modulated"] else None).times
    if events.size < MIN_EVENTS:
        return None
    phase = np.interp(run.t, events, np.arange(events.size, dtype=float), left=np.nan, right=np.nan)
    return np.asarray(np.mod(phase, 1.0))


# Local statistics of a residual, all under one null: windows, bins, lines and smooth functions that may stand out.

COSINES, MIN_WINDOW, HALVINGS = 4, 24, 5  # cosines over a window, samples of the shortest, how often a run is halved
BINS = 12  # of a phase or a quantity, in which residuals or a missing force are averaged
BATCH_SIZE = 4_000_000  # numbers of simulated residuals held at a time
NOISE_LEVEL_FACTOR = 1.08  # factor by which a run's own noise level may differ from the assumed variance and count as noise
MIN_LEVERAGE = 1e-6  # standard deviations by which a parameter moves all innovations together: it has nothing to do with them
ROUNDING_SHARE = 1e-4  # share of a column's squares below which what is left of it is rounding
SPECTRUM_SAMPLES = 64  # samples from which a spectrum is looked at


@dataclass(frozen=True)
class RunResiduals:
    """One run: whitened residual (n,) and columns X (n, k) at `indices` among all, what its samples can be sorted by.

    `parts` are its evenly sampled stretches [a, b); `coordinates`, `forcing` and `cycle` (phases from 0 to 1, NaN where there is
    none) have n values each. `lost` is the residual beyond which the run is no longer followed.
    """

    name: str
    t: Array
    white: Array
    X: Array = field(repr=False)
    indices: Array
    parts: tuple[tuple[int, int], ...]
    coordinates: Mapping[str, Array] = field(default_factory=dict, repr=False)
    forcing: Array | None = field(default=None, repr=False)
    cycle: Array | None = field(default=None, repr=False)
    lost: float = np.inf

    def followed(self) -> RunResiduals:
        """Return the run up to where the residual first exceeds `lost`; at least a few samples."""
        far = np.abs(self.white) > self.lost
        n = max(int(np.argmax(far)) if far.any() else far.size, min(MIN_WINDOW, far.size))
        parts = tuple((a, min(b, n)) for a, b in self.parts if a < n)
        sorted_by = {k: x[:n] for k, x in self.coordinates.items()}
        forcing, cycle = (None if x is None else x[:n] for x in (self.forcing, self.cycle))
        return replace(
            self, t=self.t[:n], white=self.white[:n], X=self.X[:n], parts=parts, coordinates=sorted_by, forcing=forcing,
            cycle=cycle,
        )  # fmt: skip


@dataclass(frozen=True)
class ScanStatistic:
    """One place of the scan: `statistic` with its degrees of `freedom`, the signed `z` of a single column, and p-values.

    `axis` is what samples were sorted by, `run` a name or nothing for all together, [low, high] the place; `kind` is mean, power,
    shape or line. `p_value` is adjusted for all that was looked at, `log_p` is the natural logarithm of the unadjusted one.
    """

    axis: str
    run: str
    kind: str
    low: float
    high: float
    statistic: float
    freedom: float
    z: float | None
    log_p: float
    p_value: float


@dataclass(frozen=True)
class _StatisticGroup:
    """Statistics of one kind over the same samples: columns of B in `groups`, one statistic each, or sums of squares over H."""

    axis: str
    run: str
    kind: str
    spans: tuple[tuple[float, float], ...]
    parts: tuple[tuple[int, slice, Array], ...]
    groups: tuple[tuple[int, int], ...] = ()
    roots: tuple[Array, ...] = ()
    freedom: Array = field(default_factory=lambda: np.zeros(0))


def log_tail(x: Array, freedom: Array | float) -> Array:
    """Return ln P(chi-squared > x), also where the probability itself would vanish."""
    x, half = np.asarray(x, dtype=float), np.asarray(freedom, dtype=float) / 2
    with np.errstate(divide="ignore"):
        near = np.log(gammaincc(half, x / 2))
    if np.isfinite(near).all():
        return np.asarray(near)
    with np.errstate(all="ignore"):
        far = (half - 1) * np.log(x / 2) - x / 2 - gammaln(half) - np.log1p(-np.minimum((2 * half - 2) / x, 0.9))
    return np.where(np.isfinite(near), near, np.minimum(far, 0.0))


class ResidualScan:
    """All places of some runs, and the projection that goes with them."""

    def __init__(self, pieces: Sequence[RunResiduals], k: int, *, kept: bool = False) -> None:
        """Take runs whose columns are at places below k.

        Where residuals are `kept` as they are, as their parameters come from elsewhere, nothing is projected; what is then
        uncertain of the parameters counts as noise.
        """
        self.pieces, self.k, self.kept = tuple(pieces), k, kept
        self.root: Array | None = None
        A = np.zeros((k, k))
        for p in self.pieces:
            A[np.ix_(p.indices, p.indices)] += p.X.T @ p.X
        d = np.sqrt(np.diag(A))
        moving = np.nonzero(d > MIN_LEVERAGE)[0]
        d = d[moving]
        values, vectors = np.linalg.eigh(A[np.ix_(moving, moving)] / np.outer(d, d))
        good = values > 1e-13 * max(float(values.max(initial=0.0)), 1e-300)
        root = np.zeros((k, int(good.sum())))
        root[moving] = vectors[:, good] / np.sqrt(values[good]) / d[:, None]
        self.inverse = root @ root.T
        if kept:
            self.root, self.inverse = root, -self.inverse
        self.expected_squares = [1 - np.einsum("ij,jk,ik->i", p.X, self._block(p), p.X, optimize=True) for p in self.pieces]
        self.spectra = [self._spectrum(i) for i in range(len(self.pieces))]
        self.items = [*self._windows(), *self._bins()]
        self.count = sum(i.freedom.size for i in self.items) + sum(s[1].size for s in self.spectra)

    def _block(self, p: RunResiduals) -> Array:
        return np.asarray(self.inverse[np.ix_(p.indices, p.indices)])

    def projected(self, residuals: Sequence[Array]) -> list[Array]:
        """Return M r by run, r (n,) or (n, d)."""
        if self.kept:
            return [self._levelled(r) for r in residuals]
        b = np.zeros((self.k, *residuals[0].shape[1:]))
        for p, r in zip(self.pieces, residuals, strict=True):
            b[p.indices] += p.X.T @ r
        step = self.inverse @ b
        return [self._levelled(r - p.X @ step[p.indices]) for p, r in zip(self.pieces, residuals, strict=True)]

    @staticmethod
    def _levelled(r: Array) -> Array:
        """Return a residual over its own noise level, as far as that may differ from what was assumed."""
        level = np.median(r**2, axis=0) / 0.4549
        return np.asarray(r / np.sqrt(np.clip(level, 1 / NOISE_LEVEL_FACTOR, NOISE_LEVEL_FACTOR)))

    def null(self, draws: int, *, seed: int) -> Array:
        """Return the smallest ln p of each of `draws` simulated recordings (draws,), sorted."""
        rng = np.random.default_rng(seed)
        found: list[float] = []
        size = sum(p.white.size for p in self.pieces)
        at_once = int(np.clip(BATCH_SIZE // max(size, 1), 1, draws))
        while len(found) < draws:
            d = min(at_once, draws - len(found))
            noise = [rng.standard_normal((p.white.size, d)) for p in self.pieces]
            if self.root is not None:
                track = self.root @ rng.standard_normal((self.root.shape[1], d))
                noise = [e + p.X @ track[p.indices] for p, e in zip(self.pieces, noise, strict=True)]
            found += np.min([log_p.min(axis=0) for *_, log_p in self._evaluated(self.projected(noise))], axis=0).tolist()
        return np.sort(np.array(found))

    def rows(self, M: Sequence[Array], null: Array) -> list[ScanStatistic]:
        """Return every place of projected residuals M (n,) by run, with p-values adjusted by `null` for all of them."""
        found = []
        for item, statistic, z, log_p in self._evaluated([m[:, None] for m in M]):
            adjusted = self.adjusted(log_p[:, 0], null)
            for k, (low, high) in enumerate(item.spans):
                own_z = None if z is None else float(z[k, 0])
                found.append(
                    ScanStatistic(item.axis, item.run, item.kind, low, high, float(statistic[k, 0]), float(item.freedom[k]),
                                  own_z, float(log_p[k, 0]), float(adjusted[k]))
                )  # fmt: skip
        return found

    def adjusted(self, log_p: Array, null: Array) -> Array:
        """Return p-values for all places together: as often as simulations have it, beyond them by Bonferroni's bound."""
        below = np.searchsorted(null, log_p, side="right")
        simulated = (below + 1) / (null.size + 1)
        bound = np.exp(np.maximum(log_p, -690.0)) * self.count
        return np.where(below > 0, simulated, np.minimum(simulated, bound))

    def _evaluated(self, M: Sequence[Array]) -> Iterator[tuple[_StatisticGroup, Array, Array | None, Array]]:
        """Yield (item, statistic (m, d), signed z or None, ln p (m, d)) of projected residuals (n, d) by run."""
        for item in self.items:
            if item.kind == "power":
                S = np.sum([B.T @ M[i][s] ** 2 for i, s, B in item.parts], axis=0)
                yield item, S, None, log_tail(S, item.freedom[:, None])
                continue
            U = np.sum([B.T @ M[i][s] for i, s, B in item.parts], axis=0)
            rows, signs = [], []
            for (a, b), root in zip(item.groups, item.roots, strict=True):
                z = root @ U[a:b]
                rows.append((z**2).sum(axis=0))
                signs.append(z[0])
            S = np.array(rows)
            single = all(b - a == 1 for a, b in item.groups)
            yield item, S, np.array(signs) if single else None, log_tail(S, item.freedom[:, None])
        for i, (item, f, whole, (cc, cs, ss)) in enumerate(self.spectra):
            if f.size:
                F = np.fft.rfft(M[i][whole] * _taper(whole.stop - whole.start), axis=0)[1 : f.size + 1]
                c, s = F.real, -F.imag
                S = (ss[:, None] * c**2 - 2 * cs[:, None] * c * s + cc[:, None] * s**2) / (cc * ss - cs**2)[:, None]
                yield item, S, None, -0.5 * S

    def _spectrum(self, i: int) -> tuple[_StatisticGroup, Array, slice, tuple[Array, Array, Array]]:
        """Return the lines of a run's longest even stretch: frequencies (m,) and the elements of B'M B for cosine and sine."""
        p = self.pieces[i]
        a, b = max(p.parts, key=lambda q: q[1] - q[0], default=(0, 0))
        n, none = b - a, np.zeros(0)
        if n < SPECTRUM_SAMPLES:
            return _StatisticGroup("frequency", p.name, "line", (), ()), none, slice(0, 0), (none, none, none)
        step = float(np.median(np.diff(p.t[a:b])))
        m = (n - 1) // 2
        f = np.arange(1, m + 1) / (n * step)
        F = np.fft.rfft(p.X[a:b] * _taper(n), axis=0)[1 : m + 1]
        c, s, block = F.real, -F.imag, self._block(p)
        cc, cs, ss = (np.einsum("ij,ij->i", x @ block, y) for x, y in ((c, c), (c, s), (s, s)))
        half = 0.5 / (n * step)
        item = _StatisticGroup(
            "frequency", p.name, "line", tuple((x - half, x + half) for x in f.tolist()), (), freedom=np.full(m, 2.0)
        )
        floor = 1e-3 * n  # a line that parameters absorb altogether has no statistic
        return item, f, slice(a, b), (np.maximum(n / 2 - cc, floor), -cs, np.maximum(n / 2 - ss, floor))

    def _windows(self) -> list[_StatisticGroup]:
        """Return windows of each run: the whole, halves and so on, half overlapping; slow shapes in them, and power."""
        found = []
        for i, p in enumerate(self.pieces):
            n = p.white.size
            for halving in range(HALVINGS + 1):
                length = n >> halving
                if length < (MIN_WINDOW if halving else 1):
                    break
                starts = np.unique(np.linspace(0, n - length, 2 ** (halving + 1) - 1).astype(int))
                for a in starts.tolist():
                    where, span = slice(a, a + length), ((float(p.t[a]), float(p.t[a + length - 1])),)
                    waves = np.cos(np.pi * np.outer((np.arange(length) + 0.5) / length, np.arange(min(COSINES, length))))
                    axis = "window" if halving else "run"
                    found.append(self._linear(axis, p.name, "shape", span, [(i, where, waves)]))
                    found.append(self._power(axis, p.name, span, [(i, where, np.ones((length, 1)))]))
        return found

    def _bins(self) -> list[_StatisticGroup]:
        found = []
        for axis in ("forcing", "cycle"):
            have = [(i, x) for i, p in enumerate(self.pieces) if (x := getattr(p, axis)) is not None]
            sets = [have] if axis == "forcing" else [[one] for one in have]  # each run has a cycle of its own
            for chosen in sets:
                if chosen and any(np.isfinite(x).any() for _, x in chosen):
                    name = self.pieces[chosen[0][0]].name if axis == "cycle" else ""
                    found += self._binned(axis, name, chosen, np.linspace(0.0, 1.0, BINS + 1))
        names = dict.fromkeys(name for p in self.pieces for name in p.coordinates)
        for name in names:
            chosen = [(i, p.coordinates[name]) for i, p in enumerate(self.pieces) if name in p.coordinates]
            every = np.concatenate([x for _, x in chosen])
            edges = np.unique(np.quantile(every, np.linspace(0.0, 1.0, BINS + 1)))
            edges = edges[np.concatenate([[True], np.diff(edges) > 1e-9 * max(float(np.ptp(every)), 1e-300)])]
            if edges.size > 2:
                hats = np.eye(edges.size)  # any function that is linear between the edges has one statistic
                parts = [(i, slice(None), np.column_stack([np.interp(x, edges, hat) for hat in hats])) for i, x in chosen]
                found += self._binned(name, "", chosen, edges)
                span = ((float(edges[0]), float(edges[-1])),)
                found.append(self._linear(name, "", "shape", span, parts))
        return found

    def _binned(self, axis: str, run: str, chosen: Sequence[tuple[int, Array]], edges: Array) -> list[_StatisticGroup]:
        """Return mean and power in the bins between `edges`, over all chosen runs together."""
        m = edges.size - 1
        parts = []
        for i, x in chosen:
            bin_of = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, m - 1)
            parts.append((i, slice(None), (bin_of[:, None] == np.arange(m)) & np.isfinite(x)[:, None]))
        filled = np.nonzero(sum(H.sum(axis=0) for _, _, H in parts) >= 8)[0]
        spans = tuple((float(edges[k]), float(edges[k + 1])) for k in filled)
        if not spans:
            return []
        parts = [(i, s, H[:, filled].astype(float)) for i, s, H in parts]
        means = parts
        if axis in ("forcing", "cycle"):  # what is the same at every phase has nothing to do with it
            means = [(i, s, H - H.mean(axis=0) * (H.sum(axis=1, keepdims=True) > 0) * (H.shape[0] / max(H.sum(), 1.0)))
                     for i, s, H in parts]  # fmt: skip
        return [self._linear(axis, run, "mean", spans, means), self._power(axis, run, spans, parts)]

    def _linear(self, axis: str, run: str, kind: str, spans: tuple[tuple[float, float], ...],
                parts: Sequence[tuple[int, slice, Array]]) -> _StatisticGroup:  # fmt: skip
        """Return the statistic of each column of a `mean`, or that of all together, with the roots of (B'M B)^-1."""
        q, k = parts[0][2].shape[1], self.k
        groups = tuple((a, a + 1) for a in range(q)) if kind == "mean" else ((0, q),)
        C, G = np.zeros((q, k)), np.zeros((q, q))
        for i, s, B in parts:
            p = self.pieces[i]
            C[:, p.indices] += B.T @ p.X[s]
            G += B.T @ B
        scale = np.sqrt(np.maximum(np.diag(G), 1e-300))  # before parameters and track absorb what they can
        G = (G - C @ self.inverse @ C.T) / np.outer(scale, scale)
        roots = [_inverse_root(G[a:b, a:b], scale[a:b]) for a, b in groups]
        ranks = np.array([rank for _, rank in roots], dtype=float)
        return _StatisticGroup(axis, run, kind, spans, tuple(parts), groups, tuple(root for root, _ in roots), ranks)

    def _power(
        self, axis: str, run: str, spans: tuple[tuple[float, float], ...], parts: Sequence[tuple[int, slice, Array]]
    ) -> _StatisticGroup:
        freedom = sum(B.T @ self.expected_squares[i][s] for i, s, B in parts)
        return _StatisticGroup(axis, run, "power", spans, tuple(parts), freedom=np.maximum(np.asarray(freedom), 1e-6))


def _taper(n: int) -> Array:
    """Return Hann's window (n, 1), of mean square 1: a slow misfit is not to leak over the lines of the forcing."""
    return np.asarray(np.sqrt(8 / 3) * np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2)[:, None]


def _inverse_root(G: Array, scale: Array) -> tuple[Array, int]:
    """Return R with R'R the pseudo-inverse of G * scale * scale, and its rank; directions that are absorbed do not count."""
    values, vectors = np.linalg.eigh(G)
    good = values > ROUNDING_SHARE
    root = np.where(good, 1 / np.sqrt(np.maximum(values, ROUNDING_SHARE)), 0.0)[:, None] * vectors.T / scale
    return np.asarray(root * (np.sign(root[0, 0]) or 1.0) if G.shape[0] == 1 else root), max(int(good.sum()), 1)
