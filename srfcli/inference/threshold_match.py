"""Measured critical loads against computed ones, and how a critical load moves with any parameter.

The paper's footnote: where several critical loads exist, the one retained is the closest among the odd ones, where
stability is lost as W0 rises. Odd here means just that: ln |leading multiplier| rises through zero.

Every line is surveyed in full at the first parameters. From one parameter set to the next its odd crossings are followed: moved
by their derivatives and polished, all lines together. A line is surveyed again where that fails, where the derivatives say that
it has come far enough for another crossing to have appeared, and at every step while its crossing is far from the datum: there
another one has room to come closer. Otherwise the cost would depend on the way by which a parameter set was reached.

Under modulation a boundary point solves {x(1) = x(0), ln |rho| = 0}. Its total derivative along a parameter q is the
gradient of ln |rho| that the continuation uses, with the orbit's own response put in:
    dg/dq = g_q - g_x (M - I)^-1 x_q,   dW0c/dq = -(dg/dq) / (dg/dW0).
Under constant load it solves P(i Omega; W0) = 0, P the characteristic polynomial, whose derivatives are complex steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import Status
from srfcli.inference.threshold_table import RHO, Scale, Thresholds
from srfcli.numerics.boundary import CHUNK, BoundaryPoint, along, linearise_boundary, polish
from srfcli.numerics.collocation import join
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import HopfPoint, hopf_points

# Measured critical loads against computed ones: each is compared with the nearest odd crossing of its own line.

NEAR = 1.6  # loads within this factor of the datum are surveyed first
FAR = 8.0  # and within this one if that does not decide; a crossing further off counts as missing
DENSITY = 42.0  # samples of a survey per unit of ln W0, as `srf critical` has them
LEAST = 10  # samples of a survey
REACH = 0.2  # of ln W0, summed over the parameters' changes since a line's survey: further on it is surveyed again
CLOSE = 0.1  # of the datum's load: a crossing further off than this is followed only to know how far to look
JUMP = 0.2  # in ln W0 from where a crossing was expected: it is another one then
STALE = 0.03  # in ln W0: derivatives from further off no longer predict
RIVAL = (
    2.0,
    0.05,
)  # crossings within this many times the nearest's distance, and this share of the load, are followed too
MAX_MESH = 512


@dataclass(frozen=True)
class Crossing:
    """An odd crossing: its load (N), the point that was found, and d ln W0/dy (k,) at the coordinates `y` near it."""

    load: float
    point: BoundaryPoint | HopfPoint
    y: Array
    rates: Array | None = None

    def expected(self, y: Array) -> float:
        """Return the load that the derivatives promise at coordinates `y`, moved by no more than a factor e^0.2."""
        if self.rates is None:
            return self.load
        return float(self.load * np.exp(np.clip(self.rates @ (y - self.y), -REACH, REACH)))


@dataclass(frozen=True)
class Match:
    """Data beside the crossings that they are compared with, at coordinates `y`; arrays (n,), loads in N.

    `crossings[i]` is None where `missing`: `loads[i]` is then the end of the window that the crossing must lie beyond.
    `rivals` is the load of the second nearest odd crossing, NaN where none is known. `residuals` are in sigma.
    """

    y: Array
    loads: Array
    residuals: Array
    rivals: Array
    missing: Array
    crossings: tuple[Crossing | None, ...]

    @property
    def cost(self) -> float:
        """Return chi2, the sum of the squared residuals."""
        return float(self.residuals @ self.residuals)


@dataclass
class _Line:
    """What is known of one datum's line: its odd crossings, and where it was last surveyed."""

    odd: list[Crossing] = field(default_factory=list)
    end: float = np.nan
    surveyed: Array | None = None
    rates: Array | None = None  # |d ln W0/dy| of the nearest crossing at the survey


class Matcher:
    """Compares a table with a model at one parameter set after another; `surveys` counts lines searched in full."""

    def __init__(
        self,
        model: GeneratedModel,
        table: Thresholds,
        *,
        values: Mapping[str, float],
        scale: Scale,
        tol: float = 1e-6,
    ) -> None:
        self.model, self.table, self.scale, self.tol = model, table, scale, tol
        self.surveys = 0
        self._share = float(values.get(RHO.name, 1.0))
        self._rho_is_ours = RHO.name not in model.names
        own = {name: value for name, value in values.items() if name in model.names}
        self._base = model.vector({**own, "V": table.V, "eps": table.eps, "W0": table.W0c})
        self._lines = [_Line() for _ in range(len(table))]
        self._names = tuple("eps" if self._acts_by_eps(name) else name for name in scale.names)

    def _acts_by_eps(self, name: str) -> bool:
        return name == RHO.name and self._rho_is_ours

    def parameters(self, y: Array) -> Array:
        """Return every datum's parameters (n_parameters, n) at coordinates `y`; W0 is the datum's load."""
        p, share = self._base.copy(), self._share
        for name, value in zip(self.scale.names, self.scale.values(y), strict=True):
            if self._acts_by_eps(name):
                share = float(value)
            else:
                p[self.model.index(name)] = value
        if self._rho_is_ours:
            p[self.model.index("eps")] = share * self.table.eps
        return p

    def match(self, y: Array, *, anew: bool = False) -> Match:
        """Return the data beside their crossings at coordinates `y` (k,); `anew` surveys every line again."""
        y = np.array(y, float)
        p = self.parameters(y)
        forced = p[self.model.index("eps")] > 0
        wanted = set(range(len(self.table))) if anew else self._follow(y, p, forced)
        for i in sorted(wanted & set(np.nonzero(forced)[0].tolist())):
            self._survey(i, y, p[:, i], None if anew else wanted_reach(self._lines[i], float(self.table.W0c[i]), y))
        for i in np.nonzero(~forced)[0].tolist():
            self._at_rest(i, y, p[:, i])
        self._predict([line for line, f in zip(self._lines, forced, strict=True) if f])
        for i in wanted:
            self._note_rates(i)
        return self._result(y)

    def _result(self, y: Array) -> Match:
        n = len(self.table)
        loads, rivals, chosen = np.full(n, np.nan), np.full(n, np.nan), []
        for i, line in enumerate(self._lines):
            ranked = sorted(line.odd, key=lambda c: abs(c.load - self.table.W0c[i]))
            chosen.append(ranked[0] if ranked else None)
            loads[i] = ranked[0].load if ranked else line.end
            rivals[i] = ranked[1].load if len(ranked) > 1 else np.nan
        residuals = (loads - self.table.W0c) / self.table.sigma
        return Match(y, loads, residuals, rivals, np.array([c is None for c in chosen]), tuple(chosen))

    def load_rates(self, match: Match) -> Array:
        """Return dW0c/dy (n, k) at a match, exact; 0 for a missing crossing, whose stand-in does not move."""
        return self._load_rates(list(match.crossings), match.y)

    def jacobian(self, match: Match) -> Array:
        """Return d(residuals)/dy (n, k) at a match."""
        return self.load_rates(match) / self.table.sigma[:, None]

    def _load_rates(self, crossings: list[Crossing | None], y: Array, rows: list[int] | None = None) -> Array:
        rows = list(range(len(crossings))) if rows is None else rows
        slopes, p = np.zeros((len(rows), len(self.scale))), self.parameters(y)
        forced = [k for k, c in enumerate(crossings) if c is not None and isinstance(c.point, BoundaryPoint)]
        if forced:
            points = [c.point for c in crossings if c is not None and isinstance(c.point, BoundaryPoint)]
            slopes[forced] = forced_slopes(self.model, points, self._names)
        for k, c in enumerate(crossings):
            if c is not None and isinstance(c.point, HopfPoint):
                slopes[k] = hopf_slopes(self.model, p[:, rows[k]], c.point, self._names)
        for column, name in enumerate(self.scale.names):
            if self._acts_by_eps(name):
                slopes[:, column] *= self.table.eps[rows]
        return slopes * self.scale.rates(y)

    def _at_rest(self, i: int, y: Array, p: Array) -> None:
        """Set the odd crossings of a line under constant load: all of them are roots of a polynomial."""
        datum, line = self.table.W0c[i], self._lines[i]
        points = [q for q in hopf_points(self.model, p) if q.leading and q.crossing_rate > 0]
        line.odd = [Crossing(q.W0, q, y) for q in points if datum / FAR <= q.W0 <= datum * FAR]
        if not line.odd:
            low = p.copy()
            low[self.model.index("W0")] = datum / FAR
            roots = np.roots(np.asarray(self.model.characteristic(list(low)))[::-1])
            line.end = datum * FAR if np.all(roots.real < 0) else datum / FAR

    def _survey(self, i: int, y: Array, p: Array, first: float | None) -> None:
        """Set the odd crossings of a line by a search of its own: near the datum, and further where that decides nothing."""
        datum, line = self.table.W0c[i], self._lines[i]
        for reach in (NEAR, FAR) if first is None else (first, NEAR, FAR):
            samples = max(int(2 * np.log(reach) * DENSITY), LEAST)
            found = critical_line(
                self.model, p, lo=datum / reach, hi=datum * reach, tol=self.tol, samples=samples, max_mesh=MAX_MESH
            )
            odd = [q for q in found.points if q.slope > 0 and q.status is not Status.NO_CONVERGENCE]
            line.odd = [Crossing(q.value(self.model, "W0"), q, y) for q in odd]
            nearest = min((abs(c.load - datum) for c in line.odd), default=np.inf)
            if nearest <= datum * (1 - 1 / reach):
                break  # whatever lies outside is further off
        g = found.scan.g[np.isfinite(found.scan.g)]
        line.end = datum / FAR if g.size and g[0] > 0 else datum * FAR
        line.surveyed = y
        self.surveys += 1

    def _follow(self, y: Array, p: Array, forced: Array) -> set[int]:
        """Bring the known crossings to coordinates `y`, all lines together, and return the lines that need a survey."""
        wanted: set[int] = set()
        tracked: list[tuple[int, int, float]] = []  # line, place among its crossings, expected load
        for i in np.nonzero(forced)[0].tolist():
            line = self._lines[i]
            if self._far(line, y) or not line.odd or isinstance(line.odd[0].point, HopfPoint):
                wanted.add(i)
                continue
            expected = [c.expected(y) for c in line.odd]
            distance = [abs(w - self.table.W0c[i]) for w in expected]
            most = RIVAL[0] * min(distance) + RIVAL[1] * self.table.W0c[i]
            tracked += [(i, j, w) for j, w in enumerate(expected) if distance[j] <= most]
        reached: dict[int, list[float]] = {}
        for (i, j, load), point in zip(tracked, self._polish(tracked, p), strict=True):
            value = point.value(self.model, "W0")
            kept = point.status is not Status.NO_CONVERGENCE and point.slope > 0 and point.others < 1
            apart = all(abs(np.log(value / other)) > 1e-5 for other in reached.get(i, []))
            if not (kept and apart and abs(np.log(value / load)) < JUMP):
                wanted.add(i)
                continue
            reached.setdefault(i, []).append(value)
            self._lines[i].odd[j] = self._moved(self._lines[i].odd[j], value, point, y)
        far = {i for i, values in reached.items() if min(abs(w / self.table.W0c[i] - 1) for w in values) > CLOSE}
        return wanted | far

    def _far(self, line: _Line, y: Array) -> bool:
        if line.surveyed is None or line.rates is None:
            return True
        return float(line.rates @ np.abs(y - line.surveyed)) > REACH

    def _moved(self, old: Crossing, load: float, point: BoundaryPoint, y: Array) -> Crossing:
        good = old.rates is not None and abs(np.log(load / old.expected(y))) < STALE * STALE
        small = old.rates is not None and np.abs(old.rates) @ np.abs(y - old.y) < STALE
        return Crossing(load, point, y, old.rates if good or small else None)

    def _polish(self, tracked: list[tuple[int, int, float]], p: Array) -> list[BoundaryPoint]:
        """Return the boundary points that Newton's method reaches from the known crossings, those on one mesh together."""
        starts = [self._lines[i].odd[j].point for i, j, _ in tracked]
        points: list[BoundaryPoint | None] = [None] * len(starts)
        by_mesh: dict[int, list[int]] = {}
        for k, q in enumerate(starts):
            assert isinstance(q, BoundaryPoint)
            by_mesh.setdefault(q.orbit.x.shape[-2], []).append(k)
        for places in by_mesh.values():
            columns = p[:, [tracked[k][0] for k in places]]
            columns[self.model.index("W0")] = [tracked[k][2] for k in places]
            old = [q for k in places if isinstance(q := starts[k], BoundaryPoint)]
            found = polish(
                self.model,
                columns,
                join([q.orbit for q in old]),
                np.array([q.rho for q in old]),
                along("W0", len(places)),
                tol=self.tol,
                max_mesh=MAX_MESH,
            )
            for k, reached in zip(places, found, strict=True):
                points[k] = reached
        return [q for q in points if q is not None]

    def _predict(self, lines: list[_Line]) -> None:
        """Give derivatives to every crossing under modulation that has none."""
        lacking = [(line, j) for line in lines for j, c in enumerate(line.odd) if c.rates is None]
        for y in {c.y.tobytes(): c.y for line, j in lacking for c in [line.odd[j]]}.values():
            same = [(line, j) for line, j in lacking if np.array_equal(line.odd[j].y, y)]
            rows = [next(i for i, known in enumerate(self._lines) if known is line) for line, _ in same]
            rates = self._load_rates([line.odd[j] for line, j in same], y, rows)
            for (line, j), rate in zip(same, rates, strict=True):
                c = line.odd[j]
                line.odd[j] = Crossing(c.load, c.point, c.y, rate / c.load)

    def _note_rates(self, i: int) -> None:
        line = self._lines[i]
        ranked = sorted(line.odd, key=lambda c: abs(c.load - self.table.W0c[i]))
        line.rates = np.abs(ranked[0].rates) if ranked and ranked[0].rates is not None else None


def wanted_reach(line: _Line, datum: float, y: Array) -> float | None:
    """Return the factor around `datum` within which a crossing nearer than the one just followed to `y` must lie, if it is known.

    None where no crossing was followed there, or so far that a survey of the usual width costs no more.
    """
    near = [abs(c.load / datum - 1) for c in line.odd if c.y is y]
    reach = 1.02 / (1 - min(near)) if near and min(near) < 0.9 else NEAR
    return reach if reach < NEAR else None


# How a critical load moves with any parameter: exact derivatives, by implicit differentiation of what defines the boundary.

STEP = 1e-30  # of a complex step: its square is nothing against 1


def forced_slopes(model: GeneratedModel, points: Sequence[BoundaryPoint], names: tuple[str, ...]) -> Array:
    """Return dW0c/d(name) (len(points), k) at boundary points under modulation, all else fixed; base units.

    Exact for the discretised problem, so within the points' mesh error of the true ones; infinite at a fold of the
    crossings, where two meet.
    """
    slopes = np.full((len(points), len(names)), np.nan)
    meshes = np.array([q.orbit.x.shape[-2] for q in points], dtype=int)
    for mesh in np.unique(meshes):
        same = np.nonzero(meshes == mesh)[0]
        for a in range(0, len(same), CHUNK):
            here = same[a : a + CHUNK]
            slopes[here] = _slopes_on_one_mesh(model, [points[i] for i in here], names)
    return slopes


def _slopes_on_one_mesh(model: GeneratedModel, points: Sequence[BoundaryPoint], names: tuple[str, ...]) -> Array:
    p = np.stack([q.p for q in points], axis=1)
    rho = np.array([q.rho for q in points])
    orbit = join([q.orbit for q in points])
    n = orbit.x.shape[-1]
    linear = linearise_boundary(model, p, orbit, (*names, "W0"), rho)
    response = np.linalg.solve(linear.periodic[..., :n], linear.periodic[..., n + 1 :])  # -dx_0/dq
    total = linear.growth[..., n + 1 :] - np.einsum("bn,bnk->bk", linear.growth[..., :n], response)
    with np.errstate(divide="ignore"):
        return -total[:, :-1] / total[:, -1:]


def hopf_slopes(model: GeneratedModel, p: Array, point: HopfPoint, names: tuple[str, ...]) -> Array:
    """Return dW0c/d(name) (k,) of a Hopf point of steady sliding at `p` (n_parameters,), all else fixed; base units."""
    q = p.copy()
    q[model.index("W0")] = point.W0
    s = 1j * point.Omega
    a = _coefficients(model, q, None)[0]
    by_s = (np.arange(1, len(a)) * a[1:]) @ s ** np.arange(len(a) - 1)
    by_load = _coefficients(model, q, "W0")[1] @ s ** np.arange(len(a))
    matrix = np.array([[(1j * by_s).real, by_load.real], [(1j * by_s).imag, by_load.imag]])
    columns = [_coefficients(model, q, name)[1] @ s ** np.arange(len(a)) for name in names]
    right = -np.array([[c.real for c in columns], [c.imag for c in columns]])
    return np.linalg.solve(matrix, right)[1]


def _coefficients(model: GeneratedModel, p: Array, name: str | None) -> tuple[Array, Array]:
    """Return the characteristic polynomial's coefficients (n+1,) and their derivatives by parameter `name`."""
    shifted: list[complex] = [complex(v) for v in p]
    h = 0.0
    if name is not None:
        h = STEP * (abs(p[model.index(name)]) or 1.0)
        shifted[model.index(name)] += 1j * h
    a = np.asarray(model.characteristic(shifted))
    return a.real, a.imag / h if h else np.zeros(a.shape)
