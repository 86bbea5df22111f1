"""Local statistics of a residual, all under one null: windows, bins, lines and smooth functions that may stand out.

With whitened residuals r, columns X of parameters and track, and the track's prior precision Q, what no parameter and no track
explains is M r, M = 1 - X (X'X + Q)^-1 X'. For local columns B, (B'M r)' (B'M B)^-1 (B'M r) is chi-squared under noise, whatever
the true parameters are; so, nearly, is the sum of squares of M r over a set of samples, with tr(M) over the set for its degrees
of freedom. The smallest p-value of all of them is judged by its own distribution, simulated through the same projection.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import gammaincc, gammaln

from srfcli.inference.noise import Noise, whiten
from srfcli.numerics.collocation import Array

WAVES, SHORTEST, HALVINGS = 4, 24, 5  # cosines over a window, samples of the shortest, how often a run is halved
BINS = 12
CELLS = 4_000_000  # numbers of simulated residuals held at a time
OFF = 1.08  # factor by which a run's own noise level may differ from the assumed variance and count as noise
ABSORBED = 1e-4  # share of a column's squares below which what is left of it is rounding
LINES = 64  # samples from which a spectrum is looked at


@dataclass(frozen=True)
class Piece:
    """One run: whitened residual (n,) and columns X (n, k) at `places` among all, what its samples can be sorted by.

    `parts` are its evenly sampled stretches [a, b); `coordinates`, `forcing` and `cycle` (phases from 0 to 1, NaN where there is
    none) have n values each. `lost` is the residual beyond which the run is no longer followed.
    """

    name: str
    t: Array
    white: Array
    X: Array = field(repr=False)
    places: Array
    noise: Noise
    parts: tuple[tuple[int, int], ...]
    coordinates: Mapping[str, Array] = field(default_factory=dict, repr=False)
    forcing: Array | None = field(default=None, repr=False)
    cycle: Array | None = field(default=None, repr=False)
    lost: float = np.inf

    def followed(self) -> Piece:
        """Return the run up to where the residual first exceeds `lost`; at least a few samples."""
        far = np.abs(self.white) > self.lost
        n = max(int(np.argmax(far)) if far.any() else far.size, min(SHORTEST, far.size))
        parts = tuple((a, min(b, n)) for a, b in self.parts if a < n)
        sorted_by = {k: x[:n] for k, x in self.coordinates.items()}
        forcing, cycle = (None if x is None else x[:n] for x in (self.forcing, self.cycle))
        return replace(
            self, t=self.t[:n], white=self.white[:n], X=self.X[:n], parts=parts, coordinates=sorted_by, forcing=forcing,
            cycle=cycle,
        )  # fmt: skip

    def whitened(self, columns: Array) -> Array:
        """Return columns (n, q) filtered as the residual is."""
        return whiten(self.noise, columns, list(self.parts))


@dataclass(frozen=True)
class Row:
    """One place of the atlas: `statistic` with its degrees of `freedom`, the signed `z` of a single column, and p-values.

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

    def described(self) -> dict[str, object]:
        """Return the row as plain data."""
        return {k: getattr(self, k) for k in self.__dataclass_fields__}


@dataclass(frozen=True)
class _Item:
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


class Atlas:
    """All places of some runs, and the projection that goes with them."""

    def __init__(
        self, pieces: Sequence[Piece], precision: Array, *, root: Array | None = None, kept: bool = False
    ) -> None:
        """Take runs, the prior precision (k, k) of the columns and, of a track that is drawn in simulations, its root (k, j).

        Where residuals are `kept` as they are, as their parameters come from elsewhere, nothing is projected; what is then
        uncertain of the parameters counts as noise.
        """
        self.pieces, self.root, self.precision, self.kept = tuple(pieces), root, precision, kept
        k = precision.shape[0]
        A = precision.copy()
        for p in self.pieces:
            A[np.ix_(p.places, p.places)] += p.X.T @ p.X
        d = np.sqrt(np.maximum(np.diag(A), 1e-300))
        self.inverse = (np.linalg.pinv(A / np.outer(d, d), rcond=1e-13, hermitian=True) / np.outer(d, d)) if k else A
        if kept:
            values, vectors = np.linalg.eigh(self.inverse)
            self.root = vectors * np.sqrt(np.maximum(values, 0.0))
            self.inverse = -self.inverse
        self.spare = [1 - np.einsum("ij,jk,ik->i", p.X, self._block(p, p), p.X, optimize=True) for p in self.pieces]
        self.spectra = [self._spectrum(i) for i in range(len(self.pieces))]
        self.items = [*self._windows(), *self._bins()]
        self.count = sum(i.freedom.size for i in self.items) + sum(s[1].size for s in self.spectra)

    def _block(self, a: Piece, b: Piece) -> Array:
        return np.asarray(self.inverse[np.ix_(a.places, b.places)])

    def projected(self, residuals: Sequence[Array], *, at: Array | None = None) -> list[Array]:
        """Return M r by run, r (n,) or (n, d); `at` (k,) are the values at which the residuals' own prior is centred."""
        if self.kept:
            return [self._levelled(r) for r in residuals]
        b = -(self.precision @ at) if at is not None else np.zeros(self.precision.shape[0])
        b = np.repeat(b[:, None], residuals[0].shape[1], axis=1) if residuals[0].ndim > 1 else b
        for p, r in zip(self.pieces, residuals, strict=True):
            b[p.places] += p.X.T @ r
        step = self.inverse @ b
        return [self._levelled(r - p.X @ step[p.places]) for p, r in zip(self.pieces, residuals, strict=True)]

    @staticmethod
    def _levelled(r: Array) -> Array:
        """Return a residual over its own noise level, as far as that may differ from what was assumed."""
        level = np.median(r**2, axis=0) / 0.4549
        return np.asarray(r / np.sqrt(np.clip(level, 1 / OFF, OFF)))

    def null(self, draws: int, *, seed: int) -> Array:
        """Return the smallest ln p of each of `draws` simulated recordings (draws,), sorted."""
        rng = np.random.default_rng(seed)
        found: list[float] = []
        size = sum(p.white.size for p in self.pieces)
        at_once = int(np.clip(CELLS // max(size, 1), 1, draws))
        while len(found) < draws:
            d = min(at_once, draws - len(found))
            noise = [rng.standard_normal((p.white.size, d)) for p in self.pieces]
            if self.root is not None:
                track = self.root @ rng.standard_normal((self.root.shape[1], d))
                noise = [e + p.X @ track[p.places] for p, e in zip(self.pieces, noise, strict=True)]
            M = self.projected(noise)
            smallest = np.zeros(d)
            for _, _, _, log_p in self._evaluated(M):
                smallest = np.minimum(smallest, log_p.min(axis=0))
            found += smallest.tolist()
        return np.sort(np.array(found))

    def rows(self, M: Sequence[Array], null: Array) -> list[Row]:
        """Return every place of projected residuals M (n,) by run, with p-values adjusted by `null` for all of them."""
        found = []
        for item, statistic, z, log_p in self._evaluated([m[:, None] for m in M]):
            adjusted = self.adjusted(log_p[:, 0], null)
            for k, (low, high) in enumerate(item.spans):
                own_z = None if z is None else float(z[k, 0])
                found.append(
                    Row(item.axis, item.run, item.kind, low, high, float(statistic[k, 0]), float(item.freedom[k]), own_z,
                        float(log_p[k, 0]), float(adjusted[k]))
                )  # fmt: skip
        return found

    def adjusted(self, log_p: Array, null: Array) -> Array:
        """Return p-values for all places together: as often as simulations have it, beyond them by Bonferroni's bound."""
        below = np.searchsorted(null, log_p, side="right")
        simulated = (below + 1) / (null.size + 1)
        bound = np.exp(np.maximum(log_p, -690.0)) * self.count
        return np.where(below > 0, simulated, np.minimum(simulated, bound))

    def _evaluated(self, M: Sequence[Array]) -> Iterator[tuple[_Item, Array, Array | None, Array]]:
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

    def _spectrum(self, i: int) -> tuple[_Item, Array, slice, tuple[Array, Array, Array]]:
        """Return the lines of a run's longest even stretch: frequencies (m,) and the elements of B'M B for cosine and sine."""
        p = self.pieces[i]
        a, b = max(p.parts, key=lambda q: q[1] - q[0], default=(0, 0))
        n, none = b - a, np.zeros(0)
        if n < LINES:
            return _Item("frequency", p.name, "line", (), ()), none, slice(0, 0), (none, none, none)
        step = float(np.median(np.diff(p.t[a:b])))
        m = (n - 1) // 2
        f = np.arange(1, m + 1) / (n * step)
        F = np.fft.rfft(p.X[a:b] * _taper(n), axis=0)[1 : m + 1]
        c, s, block = F.real, -F.imag, self._block(p, p)
        cc, cs, ss = (np.einsum("ij,ij->i", x @ block, y) for x, y in ((c, c), (c, s), (s, s)))
        half = 0.5 / (n * step)
        item = _Item(
            "frequency", p.name, "line", tuple((x - half, x + half) for x in f.tolist()), (), freedom=np.full(m, 2.0)
        )
        floor = 1e-3 * n  # a line that parameters absorb altogether has no statistic
        return item, f, slice(a, b), (np.maximum(n / 2 - cc, floor), -cs, np.maximum(n / 2 - ss, floor))

    def _windows(self) -> list[_Item]:
        """Return windows of each run: the whole, halves and so on, half overlapping; slow shapes in them, and power."""
        found = []
        for i, p in enumerate(self.pieces):
            n = p.white.size
            for halving in range(HALVINGS + 1):
                length = n >> halving
                if length < (SHORTEST if halving else 1):
                    break
                starts = np.unique(np.linspace(0, n - length, 2 ** (halving + 1) - 1).astype(int))
                for a in starts.tolist():
                    where, span = slice(a, a + length), ((float(p.t[a]), float(p.t[a + length - 1])),)
                    waves = np.cos(np.pi * np.outer((np.arange(length) + 0.5) / length, np.arange(min(WAVES, length))))
                    axis = "window" if halving else "run"
                    found.append(self._linear(axis, p.name, "shape", span, [(i, where, waves)], [(0, waves.shape[1])]))
                    found.append(self._power(axis, p.name, span, [(i, where, np.ones((length, 1)))]))
        return found

    def _bins(self) -> list[_Item]:
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
                found += [*self._binned(name, "", chosen, edges), self._smooth(name, chosen, edges)]
        return found

    def _binned(self, axis: str, run: str, chosen: Sequence[tuple[int, Array]], edges: Array) -> list[_Item]:
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
        singles = [(k, k + 1) for k in range(len(spans))]
        means = parts
        if axis in ("forcing", "cycle"):  # what is the same at every phase has nothing to do with it
            means = [(i, s, H - H.mean(axis=0) * (H.sum(axis=1, keepdims=True) > 0) * (H.shape[0] / max(H.sum(), 1.0)))
                     for i, s, H in parts]  # fmt: skip
        return [self._linear(axis, run, "mean", spans, means, singles), self._power(axis, run, spans, parts)]

    def _smooth(self, axis: str, chosen: Sequence[tuple[int, Array]], knots: Array) -> _Item:
        """Return the one statistic of any function that is linear between `knots`."""
        eye = np.eye(knots.size)
        parts = [(i, slice(None), np.column_stack([np.interp(x, knots, row) for row in eye])) for i, x in chosen]
        return self._linear(axis, "", "shape", ((float(knots[0]), float(knots[-1])),), parts, [(0, knots.size)])

    def _linear(self, axis: str, run: str, kind: str, spans: tuple[tuple[float, float], ...],
                parts: Sequence[tuple[int, slice, Array]], groups: Sequence[tuple[int, int]]) -> _Item:  # fmt: skip
        """Return the statistics of groups of columns, with the roots of (B'M B)^-1."""
        q, k = parts[0][2].shape[1], self.precision.shape[0]
        white, C, G = [], np.zeros((q, k)), np.zeros((q, q))
        for i, s, B in parts:
            p = self.pieces[i]
            full = np.zeros((p.white.size, B.shape[1]))
            full[s] = B
            B = p.whitened(full)[s] if p.noise.order or p.noise.pieces else B / p.noise.innovation
            white.append((i, s, B))
            C[:, p.places] += B.T @ p.X[s]
            G += B.T @ B
        scale = np.sqrt(np.maximum(np.diag(G), 1e-300))  # before parameters and track absorb what they can
        G = (G - C @ self.inverse @ C.T) / np.outer(scale, scale)
        roots = [_inverse_root(G[a:b, a:b], scale[a:b]) for a, b in groups]
        ranks = np.array([rank for _, rank in roots], dtype=float)
        return _Item(axis, run, kind, spans, tuple(white), tuple(groups), tuple(root for root, _ in roots), ranks)

    def _power(
        self, axis: str, run: str, spans: tuple[tuple[float, float], ...], parts: Sequence[tuple[int, slice, Array]]
    ) -> _Item:
        freedom = sum(B.T @ self.spare[i][s] for i, s, B in parts)
        return _Item(axis, run, "power", spans, tuple(parts), freedom=np.maximum(np.asarray(freedom), 1e-6))


def _taper(n: int) -> Array:
    """Return Hann's window (n, 1), of mean square 1: a slow misfit is not to leak over the lines of the forcing."""
    return np.asarray(np.sqrt(8 / 3) * np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2)[:, None]


def _inverse_root(G: Array, scale: Array) -> tuple[Array, int]:
    """Return R with R'R the pseudo-inverse of G * scale * scale, and its rank; directions that are absorbed do not count."""
    values, vectors = np.linalg.eigh(G)
    good = values > ABSORBED
    root = np.where(good, 1 / np.sqrt(np.maximum(values, ABSORBED)), 0.0)[:, None] * vectors.T / scale
    return np.asarray(root * (np.sign(root[0, 0]) or 1.0) if G.shape[0] == 1 else root), max(int(good.sum()), 1)
