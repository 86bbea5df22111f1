"""Parameters from measured critical loads: the paper's procedure, and a least squares beside it, with errors.

Both minimise chi2 = sum ((W0c - measured)/sigma)^2 over the same coordinates from the same start, with the same
cost function: Powell's method (Powell 1964, as the paper took it from Numerical Recipes) from its values alone, the least
squares (trust region, Branch, Coleman and Li 1999) with the exact derivatives of `forced_slopes` and `hopf_slopes`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError, Status, did_you_mean
from srfcli.data.thresholds import Thresholds
from srfcli.inference.free_parameters import RHO, Scale
from srfcli.inference.profile import CHI2_95, Interval, Refits, interval_end, quadratic
from srfcli.numerics.boundary import CHUNK, BoundaryPoint, along, growth_slopes, linearise_boundary, polish
from srfcli.numerics.collocation import by_mesh, join
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import HopfPoint, by_frequency_and_load, characteristic_slopes, hopf_points, steady_is_stable

# Measured critical loads against computed ones: each is compared with the nearest odd crossing of its own line.
#
# The paper's footnote: where several critical loads exist, the one retained is the closest among the odd ones, where
# stability is lost as W0 rises. Odd here means just that: ln |leading multiplier| rises through zero.
#
# Every line is surveyed in full at the first parameters. From one parameter set to the next its odd crossings are followed: moved
# by their derivatives and polished, all lines together. A line is surveyed again where that fails, where the derivatives say that
# it has come far enough for another crossing to have appeared, and at every step while its crossing is far from the datum: there
# another one has room to come closer. Otherwise the cost would depend on the way by which a parameter set was reached.
#
# Under modulation a boundary point solves {x(1) = x(0), ln |rho| = 0}. Its total derivative along a parameter q is the
# gradient of ln |rho| that the continuation uses, with the orbit's own response put in:
#     dg/dq = g_q - g_x (M - I)^-1 x_q,   dW0c/dq = -(dg/dq) / (dg/dW0).
# Under constant load it solves P(i Omega; W0) = 0, P the characteristic polynomial, whose derivatives are complex steps.

NEAR_LOADS = 1.6  # loads within this factor of the datum are surveyed first
FAR_CROSSING = 8.0  # and within this one if that does not decide; a crossing further off counts as missing
DENSITY = 42.0  # samples of a survey per unit of ln W0, as `srf critical` has them
LEAST_SAMPLES = 10  # of a survey
SURVEY_REACH = 0.2  # of ln W0, summed over the parameters' changes since a line's survey: further on it is surveyed again
CLOSE_CROSSING = 0.1  # of the datum's load: a crossing further off than this is followed only to know how far to look
MOST_MOVED = 0.2  # in ln W0 from where a crossing was expected: it is another one then
STALE_SLOPES = 0.03  # in ln W0: derivatives from further off no longer predict
# crossings within this many times the nearest's distance, and this share of the load, are followed too
RIVAL_CROSSING_LIMITS = (2.0, 0.05)
MAX_MESH = 512


@dataclass(frozen=True)
class Crossing:
    """An odd crossing: its load (N), the point that was found, and d ln W0/dy (k,) at the coordinates `y` near it."""

    load: float
    point: BoundaryPoint | HopfPoint
    y: Array
    rates: Array | None = None

    def expected(self, y: Array) -> float:
        """Return the load by the derivatives at coordinates `y`, moved by no more than a factor e^0.2."""
        if self.rates is None:
            return self.load
        return float(self.load * np.exp(np.clip(self.rates @ (y - self.y), -SURVEY_REACH, SURVEY_REACH)))


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
class _LineState:
    """What is known of the line of one datum (N): its odd crossings, and where it was last surveyed."""

    datum: float
    odd: list[Crossing] = field(default_factory=list)
    end: float = np.nan
    surveyed: Array | None = None
    rates: Array | None = None  # |d ln W0/dy| of the nearest crossing at the survey

    @property
    def ranked(self) -> list[Crossing]:
        """Return the odd crossings, those nearest to the datum first."""
        return sorted(self.odd, key=lambda c: abs(c.load - self.datum))

    def far(self, y: Array) -> bool:
        """Return whether coordinates `y` are so far from the survey that another crossing may have appeared."""
        return self.surveyed is None or self.rates is None or float(self.rates @ np.abs(y - self.surveyed)) > SURVEY_REACH

    def reach(self, y: Array) -> float:
        """Return the factor around the datum within which a crossing nearer than the one just followed to `y` must lie.

        That of a usual survey where no crossing was followed there, or so far that such a survey costs no more.
        """
        near = [abs(c.load / self.datum - 1) for c in self.odd if c.y is y]
        return min(1.02 / (1 - min(near)), NEAR_LOADS) if near and min(near) < 0.9 else NEAR_LOADS


class Matcher:
    """Compares a table with a model at one parameter set after another; `surveys` counts lines searched in full."""

    def __init__(
        self, model: GeneratedModel, table: Thresholds, *, values: Mapping[str, float], scale: Scale, tol: float = 1e-6
    ) -> None:
        self.model, self.table, self.scale, self.tol = model, table, scale, tol
        self.surveys = 0
        self._share = float(values.get(RHO.name, 1.0))
        self._rho_is_ours = RHO.name not in model.names
        own = {name: value for name, value in values.items() if name in model.names}
        self._base = model.vector({**own, "V": table.V, "eps": table.eps, "W0": table.W0c})
        self._lines = [_LineState(datum) for datum in table.W0c]
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
            self._survey(self._lines[i], y, p[:, i], NEAR_LOADS if anew else self._lines[i].reach(y))
        for i in np.nonzero(~forced)[0].tolist():
            self._at_rest(self._lines[i], y, p[:, i])
        self._predict(np.nonzero(forced)[0].tolist())
        for line in (self._lines[i] for i in wanted):
            line.rates = np.abs(line.ranked[0].rates) if line.odd and line.ranked[0].rates is not None else None
        n = len(self.table)
        loads, rivals, chosen = np.full(n, np.nan), np.full(n, np.nan), []
        for i, line in enumerate(self._lines):
            ranked = line.ranked
            chosen.append(ranked[0] if ranked else None)
            loads[i] = ranked[0].load if ranked else line.end
            rivals[i] = ranked[1].load if len(ranked) > 1 else np.nan
        residuals = (loads - self.table.W0c) / self.table.sigma
        return Match(y, loads, residuals, rivals, np.array([c is None for c in chosen]), tuple(chosen))

    def jacobian(self, match: Match) -> Array:
        """Return d(residuals)/dy (n, k) at a match, exact; 0 for a missing crossing, whose stand-in does not move."""
        return self._load_rates(list(match.crossings), match.y) / self.table.sigma[:, None]

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

    def _at_rest(self, line: _LineState, y: Array, p: Array) -> None:
        """Set the odd crossings of a line under constant load: all of them are roots of a polynomial."""
        datum = line.datum
        points = [q for q in hopf_points(self.model, p) if q.leading and q.crossing_rate > 0]
        line.odd = [Crossing(q.W0, q, y) for q in points if datum / FAR_CROSSING <= q.W0 <= datum * FAR_CROSSING]
        if not line.odd:
            line.end = datum * FAR_CROSSING if steady_is_stable(self.model, p, datum / FAR_CROSSING) else datum / FAR_CROSSING

    def _survey(self, line: _LineState, y: Array, p: Array, first: float) -> None:
        """Set the odd crossings of a line by a search of its own: near the datum, and further where that decides nothing."""
        datum = line.datum
        for reach in dict.fromkeys((first, NEAR_LOADS, FAR_CROSSING)):
            samples = max(int(2 * np.log(reach) * DENSITY), LEAST_SAMPLES)
            found = critical_line(
                self.model, p, lo=datum / reach, hi=datum * reach, tol=self.tol, samples=samples, max_mesh=MAX_MESH
            )
            odd = [q for q in found.points if q.slope > 0 and q.status is not Status.NO_CONVERGENCE]
            line.odd = [Crossing(q.value(self.model, "W0"), q, y) for q in odd]
            nearest = min((abs(c.load - datum) for c in line.odd), default=np.inf)
            if nearest <= datum * (1 - 1 / reach):
                break  # whatever lies outside is further off
        g = found.scan.g[np.isfinite(found.scan.g)]
        line.end = datum / FAR_CROSSING if g.size and g[0] > 0 else datum * FAR_CROSSING
        line.surveyed = y
        self.surveys += 1

    def _follow(self, y: Array, p: Array, forced: Array) -> set[int]:
        """Bring the known crossings to coordinates `y`, all lines together, and return the lines that need a survey."""
        wanted: set[int] = set()
        tracked: list[tuple[int, int, float]] = []  # line, place among its crossings, expected load
        for i in np.nonzero(forced)[0].tolist():
            line = self._lines[i]
            if line.far(y) or not line.odd or isinstance(line.odd[0].point, HopfPoint):
                wanted.add(i)
                continue
            expected = [c.expected(y) for c in line.odd]
            distance = [abs(w - line.datum) for w in expected]
            most = RIVAL_CROSSING_LIMITS[0] * min(distance) + RIVAL_CROSSING_LIMITS[1] * line.datum
            tracked += [(i, j, w) for j, w in enumerate(expected) if distance[j] <= most]
        reached: dict[int, list[float]] = {}
        for (i, j, load), point in zip(tracked, self._polish(tracked, p), strict=True):
            value = point.value(self.model, "W0")
            kept = point.status is not Status.NO_CONVERGENCE and point.slope > 0 and point.others < 1
            apart = all(abs(np.log(value / other)) > 1e-5 for other in reached.get(i, []))
            if not (kept and apart and abs(np.log(value / load)) < MOST_MOVED):
                wanted.add(i)
                continue
            reached.setdefault(i, []).append(value)
            self._lines[i].odd[j] = self._moved(self._lines[i].odd[j], value, point, y)
        far = {i for i, values in reached.items() if min(abs(w / self.table.W0c[i] - 1) for w in values) > CLOSE_CROSSING}
        return wanted | far

    def _moved(self, old: Crossing, load: float, point: BoundaryPoint, y: Array) -> Crossing:
        good = old.rates is not None and abs(np.log(load / old.expected(y))) < STALE_SLOPES * STALE_SLOPES
        small = old.rates is not None and np.abs(old.rates) @ np.abs(y - old.y) < STALE_SLOPES
        return Crossing(load, point, y, old.rates if good or small else None)

    def _polish(self, tracked: list[tuple[int, int, float]], p: Array) -> list[BoundaryPoint]:
        """Return the boundary points that Newton's method reaches from the known crossings, those on one mesh together."""
        old = [q for i, j, _ in tracked if isinstance(q := self._lines[i].odd[j].point, BoundaryPoint)]
        columns = self.model.with_values(p[:, [i for i, _, _ in tracked]], W0=np.array([load for _, _, load in tracked]))
        orbits, rho = [q.orbit.part(0) for q in old], np.array([q.rho for q in old])
        return polish(self.model, columns, orbits, rho, along("W0", len(old)), tol=self.tol, max_mesh=MAX_MESH)

    def _predict(self, lines: Sequence[int]) -> None:
        """Give derivatives to every crossing of these lines, which are under modulation, that has none."""
        lacking = [(i, j, c) for i in lines for j, c in enumerate(self._lines[i].odd) if c.rates is None]
        for y in {c.y.tobytes(): c.y for _, _, c in lacking}.values():
            same = [(i, j, c) for i, j, c in lacking if np.array_equal(c.y, y)]
            rates = self._load_rates([c for _, _, c in same], y, [i for i, _, _ in same])
            for (i, j, c), rate in zip(same, rates, strict=True):
                self._lines[i].odd[j] = replace(c, rates=rate / c.load)


# How a critical load moves with any parameter: exact derivatives, by implicit differentiation of what defines the boundary.


def forced_slopes(model: GeneratedModel, points: Sequence[BoundaryPoint], names: tuple[str, ...]) -> Array:
    """Return dW0c/d(name) (len(points), k) at boundary points under modulation, all else fixed; base units.

    Exact for the discretised problem, so within the points' mesh error of the true ones; infinite at a fold of the
    crossings, where two meet.
    """
    slopes = np.full((len(points), len(names)), np.nan)
    for index in by_mesh([q.orbit for q in points], CHUNK):
        here = [points[i] for i in index]
        p, rho = np.stack([q.p for q in here], axis=1), np.array([q.rho for q in here])
        linear = linearise_boundary(model, p, join([q.orbit for q in here]), (*names, "W0"), rho)
        total = growth_slopes(linear)
        with np.errstate(divide="ignore"):
            slopes[index] = -total[:, :-1] / total[:, -1:]
    return slopes


def hopf_slopes(model: GeneratedModel, p: Array, point: HopfPoint, names: tuple[str, ...]) -> Array:
    """Return dW0c/d(name) (k,) of a Hopf point of steady sliding at `p` (n_parameters,), all else fixed; base units."""
    _, by_s, by_load = characteristic_slopes(model, p, point.W0, 1j * point.Omega)
    columns = np.array([characteristic_slopes(model, p, point.W0, 1j * point.Omega, name)[2] for name in names])
    return np.linalg.solve(by_frequency_and_load(by_s, by_load), -np.array([columns.real, columns.imag]))[1]


# Parameters from measured critical loads: the paper's procedure with Powell's method, and a least squares beside it.

FIT_METHODS = ("powell", "least-squares")
MAX_EVALUATIONS = 2000
SURVEY_ROUNDS = 3  # fits from where a survey of the solution found nearer crossings
FIRST_STEP = 0.05  # in a coordinate: with it Powell's method brackets the minimum on a line
LEAST_CHANGES = 1.0, 30.0  # times the loads' accuracy: changes of chi2 and of the coordinates that end the least squares
POWELL_SETTLED = 1e-4  # the same for a round of Powell's method through all directions
PERFECT_FIT_RATIO = 3.0  # times the accuracy of the critical loads: residuals all below it are as good as none
MAX_DETOURS = 3  # times that a least squares goes around a jump of the cost
JUMP_STEP, JUMP_SIZE = 1e-3, 0.02  # a load that changes by so much, in ln W0, over so little in a coordinate has jumped
BEYOND_BOUND = 0.05  # a coordinate this far beyond its bound doubles Powell's cost

Report = Callable[["Trace"], None]


@dataclass
class Trace:
    """Cost against work: after each evaluation of the whole cost its chi2, the best so far and the CPU seconds used."""

    method: str
    cost: list[float] = field(default_factory=list)
    best: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.cost)

    def milestones(self) -> list[int]:
        """Return the places in the trace at 1, 2, 5, 10, 20, 50, ... evaluations, and the last."""
        marks = {m * 10**e for e in range(8) for m in (1, 2, 5)}
        return [i for i in range(len(self)) if i + 1 in marks or i == len(self) - 1]


@dataclass(frozen=True)
class MethodFit:
    """Where one method ended: `values` (k,) in base units, their uncertainty, and the data matched there by a full survey.

    `evaluations` of the whole cost, `gradients` of exact derivatives used by the method, `surveys` of single lines.
    `start_cost` and `cost` are chi2; `paper_cost` is the paper's sum of squares in N^2, before and after.
    """

    method: str
    values: Array
    uncertainty: Uncertainty
    match: Match
    start_cost: float
    cost: float
    paper_cost: tuple[float, float]
    evaluations: int
    gradients: int
    surveys: int
    cpu: float
    trace: Trace
    status: Status
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ThresholdFit:
    """A table fitted by one or both methods; `status` is the worst of theirs.

    `intervals` are by the profile likelihood from the lowest chi2, where they were asked for; without them `not_quadratic`
    are the parameters at whose ends chi2 is not what their standard errors say.
    """

    table: Thresholds
    scale: Scale
    methods: tuple[MethodFit, ...]
    status: Status
    intervals: tuple[Interval, ...] = ()
    not_quadratic: tuple[str, ...] = ()

    @property
    def best(self) -> MethodFit:
        """Return the method with the lowest chi2."""
        return min(self.methods, key=lambda m: m.cost)


class _Stop(Exception):
    """Raised inside a minimiser that need not, or may not, go on, with the status that this leaves."""

    def __init__(self, status: Status) -> None:
        super().__init__(status)
        self.status = status


class _MethodRun:
    """One method's run: evaluates the cost, keeps the best match and the trace, and stops the method where it should."""

    def __init__(self, matcher: Matcher, method: str, limit: int, report: Report | None) -> None:
        self.matcher, self.limit, self.report = matcher, limit, report
        self.trace = Trace(method)
        self.best: Match | None = None
        self.last: Match | None = None
        self.begun = time.process_time()
        self.gradients = 0
        self.notes: list[str] = []
        self._seen: list[tuple[Array, Array]] = []  # coordinates and loads of each evaluation

    def at(self, y: Array) -> Match:
        """Return the match at coordinates `y`, counted as one evaluation unless it is the last one over again."""
        if self.last is not None and np.array_equal(self.last.y, y):
            return self.last
        if len(self.trace) >= self.limit:
            raise _Stop(Status.EVALUATIONS)
        match = self.matcher.match(y)
        self.last = match
        self._seen.append((match.y, match.loads))
        if self.best is None or match.cost < self.best.cost:
            self.best = match
        self.trace.cost.append(match.cost)
        self.trace.best.append(self.best.cost)
        self.trace.cpu.append(time.process_time() - self.begun)
        if self.report is not None:
            self.report(self.trace)
        if np.abs(match.loads - self.matcher.table.W0c).max() < PERFECT_FIT_RATIO * self.matcher.tol * match.loads.min():
            raise _Stop(Status.OK)
        return match

    def jumped(self) -> Array:
        """Return for each datum (n,) whether its load changed by JUMP_SIZE within JUMP_STEP of the best coordinates found."""
        jumped = np.zeros(len(self.matcher.table), dtype=bool)
        best = self.best
        if best is not None:
            for y, loads in self._seen:
                if np.abs(y - best.y).max() < JUMP_STEP:
                    jumped |= np.abs(np.log(loads / best.loads)) > JUMP_SIZE
        return jumped

    def jacobian(self, y: Array) -> Array:
        match = self.at(y)
        self.gradients += 1
        return self.matcher.jacobian(match)


def fit_thresholds(
    model: GeneratedModel,
    table: Thresholds,
    *,
    scale: Scale,
    values: Mapping[str, float],
    methods: Sequence[str] = FIT_METHODS,
    tol: float = 1e-6,
    max_evaluations: int = MAX_EVALUATIONS,
    profile: bool = False,
    report: Report | None = None,
) -> ThresholdFit:
    """Return the parameters of `scale` that bring the model's critical loads nearest to the table's.

    `values` are all parameters in base units, `tol` the relative accuracy of each critical load; `report` is called after
    each evaluation. `profile` adds intervals by the profile likelihood. An interruption (KeyboardInterrupt) ends the fit with the
    best found so far, its status says so.
    """
    for name in methods:
        if name not in FIT_METHODS:
            raise SrfError(f"unknown method {name!r}", did_you_mean(name, FIT_METHODS))
    if len(table) < len(scale):
        raise SrfError(
            f"{table.source}: {len(table)} critical loads for {len(scale)} free parameters",
            "Measure more of them, or free fewer parameters.",
        )
    fits: list[MethodFit] = []
    for name in methods:
        matcher = Matcher(model, table, values=values, scale=scale, tol=tol)
        fits.append(_run(matcher, name, max_evaluations, report))
        if fits[-1].status is Status.INTERRUPTED:
            break
    worst = next((m.status for m in fits if not m.status.ok), Status.OK)
    done = ThresholdFit(table, scale, tuple(fits), worst)
    if worst is Status.INTERRUPTED or not done.best.status.ok:
        return done
    work = _MethodRun(Matcher(model, table, values=values, scale=scale, tol=tol), "profile", sys.maxsize, report)
    try:
        if profile:
            return replace(done, intervals=_profiles(work, done.best))
        return replace(done, not_quadratic=_not_quadratic(work, done.best))
    except KeyboardInterrupt:
        return replace(done, status=Status.INTERRUPTED)


def _ridge(scale: Scale, best: MethodFit, k: int) -> tuple[float, Array]:
    """Return the standard error of coordinate k, infinite or NaN where there is none, and how all (k,) move with it."""
    errors = best.uncertainty.errors / scale.rates(best.match.y)
    moves = np.nan_to_num(best.uncertainty.correlation[k] * errors / errors[k], posinf=0.0, neginf=0.0)
    return float(errors[k]), moves


def _not_quadratic(work: _MethodRun, best: MethodFit) -> tuple[str, ...]:
    """Return the parameters at whose ends of 1.96 standard errors, the others by correlation, chi2 is not what these say."""
    scale, found = work.matcher.scale, []
    for k, name in enumerate(scale.names):
        error, along = _ridge(scale, best, k)
        if np.isfinite(error):
            reach = np.sqrt(CHI2_95) * error * along
            ends = [work.matcher.match(np.clip(best.match.y + side * reach, *scale.bounds)).cost - best.cost for side in (-1, 1)]
            found += [] if quadratic(ends) else [name]
    return tuple(found)


def _profiles(work: _MethodRun, best: MethodFit) -> tuple[Interval, ...]:
    """Return the interval of each parameter by the profile likelihood: each held on either side, the others fitted again."""
    found = []
    for k, q in enumerate(work.matcher.scale):
        before, refits = len(work.trace), Refits()
        low, high = (_end(work, best, k, side, refits) for side in (-1.0, 1.0))
        found.append(Interval(q.name, low, high, len(work.trace) - before, refits.gain, refits.likelier))
    return tuple(found)


def _end(work: _MethodRun, best: MethodFit, k: int, side: float, refits: Refits) -> float | None:
    """Return where the profile of coordinate k crosses CHI2_95 on one side."""
    scale, top = work.matcher.scale, best.match.y
    error, along = _ridge(scale, best, k)
    others, everything, last = np.arange(len(scale)) != k, np.ones(len(work.matcher.table), dtype=bool), top

    def deviance(distance: float) -> float:
        nonlocal last
        start = last + along * (top[k] + side * distance - last[k])
        start[k] = top[k] + side * distance
        work.best = None
        with suppress(_Stop):  # where nothing is left to minimise
            _trust_region(work, start, everything, others)
        assert work.best is not None
        last = work.best.y
        return refits.record(work.best.cost - best.cost, dict(zip(scale.names, scale.values(last).tolist(), strict=True)))

    bound = scale.bounds[0 if side < 0 else 1]
    distance = interval_end(deviance, error, float(abs(bound[k] - top[k])))
    return None if distance is None else list(scale)[k].value(float(top[k] + side * distance))


def _run(matcher: Matcher, method: str, limit: int, report: Report | None) -> MethodFit:
    """Run one method, survey its solution, and run it again from there where that finds nearer crossings."""
    work, status, notes = _MethodRun(matcher, method, limit, report), Status.OK, []
    minimise = {"powell": _powell, "least-squares": _least_squares}[method]
    y = np.zeros(len(matcher.scale))
    first = matcher.match(y, anew=True)  # the start has to be known, interrupted or not
    surveyed = first
    try:
        for turn in range(SURVEY_ROUNDS):
            work.best = None  # costs with other crossings do not compare
            try:
                status = minimise(work, y)
            except _Stop as stop:
                status = stop.status
            found = work.best or first
            work.last = None
            surveyed = matcher.match(found.y, anew=True)
            y = found.y
            moved = np.nonzero(np.abs(np.log(found.loads / surveyed.loads)) > 1e-3)[0]
            if surveyed.cost > found.cost - 1e-3 * (1 + found.cost) and not moved.size:
                break
            lines = ", ".join(str(matcher.table.lines[i]) for i in moved)
            end = "the fit went on from there" if turn + 1 < SURVEY_ROUNDS else "the matching did not settle"
            notes.append(f"a survey of the solution found other crossings nearer to the data of line {lines}; {end}")
            if status is Status.EVALUATIONS:
                break
    except KeyboardInterrupt:
        status, surveyed = Status.INTERRUPTED, work.best or surveyed
    table, scale = matcher.table, matcher.scale
    before, after = (float(((m.loads - table.W0c) ** 2).sum()) for m in (first, surveyed))
    known = uncertainty(scale, surveyed.y, matcher.jacobian(surveyed))
    return MethodFit(
        method, scale.values(surveyed.y), known, surveyed, start_cost=first.cost, cost=surveyed.cost, paper_cost=(before, after),
        evaluations=len(work.trace), gradients=work.gradients, surveys=matcher.surveys, cpu=time.process_time() - work.begun,
        trace=work.trace, status=status, notes=(*work.notes, *notes, *match_notes(table, surveyed)),
    )  # fmt: skip


def match_notes(table: Thresholds, match: Match) -> list[str]:
    """Return a sentence for each way in which the matching of data and crossings is not plain."""
    notes = []
    missing = np.nonzero(match.missing)[0]
    if missing.size:
        ends = ", ".join(f"{table.lines[i]} (as {match.loads[i]:.4g} N)" for i in missing)
        notes.append(
            f"no odd crossing within a factor 8 of the load of line {ends}: counted as the end that it must lie beyond,"
            " 8 times the load where sliding is stable below, an eighth of it where it is not"
        )
    near, far = np.abs(match.loads - table.W0c), np.abs(match.rivals - table.W0c)
    unclear = np.nonzero(far - near < 2 * table.sigma)[0]
    for i in unclear:
        notes.append(
            f"line {table.lines[i]} is ambiguous: odd crossings at {match.loads[i]:.6g} and {match.rivals[i]:.6g} N are"
            f" equally near to {table.W0c[i]:.6g} N within 2 sigma; the nearest counts"
        )
    return notes


def _least_squares(work: _MethodRun, y: Array) -> Status:
    """Run the least squares; where a crossing's jump stops it, once more without the data that jumped, then with all again.

    At a fold two crossings merge, and the nearest odd one is suddenly another: the cost has a cliff, before which its derivatives
    point over the edge.
    """
    everything = np.ones(len(work.matcher.table), dtype=bool)
    status, _ = _trust_region(work, y, everything)
    for _ in range(MAX_DETOURS):
        before = work.best
        jumped = work.jumped()
        if before is None or not jumped.any() or len(jumped) - jumped.sum() < len(work.matcher.scale):
            break
        lines = ", ".join(str(work.matcher.table.lines[i]) for i in np.nonzero(jumped)[0])
        begun = len(work.trace)
        _, elsewhere = _trust_region(work, before.y, ~jumped)
        work.notes.append(
            f"the nearest odd crossing of line {lines} jumps where the fit first ended, at chi2 {before.cost:.6g}; it"
            f" went on without for {len(work.trace) - begun} evaluations, then with all data again"
        )
        status, _ = _trust_region(work, elsewhere, everything)
        if work.best is before:
            break
    return status


def _trust_region(work: _MethodRun, y: Array, kept: Array, free: Array | None = None) -> tuple[Status, Array]:
    """Minimise the squares of the residuals `kept` (n,) from coordinates `y`, those `free` (k,); return where that ended."""
    from scipy.optimize import least_squares

    low, high = work.matcher.scale.bounds
    free = np.ones(y.size, dtype=bool) if free is None else free
    inner = np.clip(y, low + 1e-9 * (high - low), high - 1e-9 * (high - low))

    def whole(part: Array) -> Array:
        found = inner.copy()
        found[free] = part
        return found

    if not free.any():
        work.at(inner)
        return Status.OK, inner
    done = least_squares(
        lambda c: work.at(whole(c)).residuals[kept],
        inner[free],
        jac=lambda c: work.jacobian(whole(c))[kept][:, free],
        bounds=(low[free], high[free]),
        method="trf",
        ftol=LEAST_CHANGES[0] * work.matcher.tol,
        xtol=LEAST_CHANGES[1] * work.matcher.tol,
        gtol=1e-10,
        max_nfev=work.limit,
    )
    return Status.OK if done.status > 0 else Status.EVALUATIONS, whole(done.x)


def _powell(work: _MethodRun, y: Array) -> Status:
    """Run Powell's method in units of FIRST_STEP; beyond a bound the cost is that at the bound, raised with the distance.

    Handing the bounds to scipy instead would make it search every line from bound to bound.
    """
    from scipy.optimize import minimize

    low, high = work.matcher.scale.bounds

    def cost(steps: Array) -> float:
        wanted = FIRST_STEP * steps
        inside = np.clip(wanted, low, high)
        outside = float(np.abs(wanted - inside).sum()) / BEYOND_BOUND
        value = work.at(inside).cost
        return value * (1 + outside) + outside

    options = {"ftol": POWELL_SETTLED, "xtol": POWELL_SETTLED, "maxfev": 10 * work.limit, "maxiter": work.limit}
    minimize(cost, y / FIRST_STEP, method="Powell", options=options)
    return Status.OK


# What a fit of critical loads knows: standard errors, correlations, and the combinations that the data leave open.

AT_BOUND = 1e-6  # of the distance between the bounds, in the parameter's coordinate
MIN_EIGENVALUE_SHARE = 1e-9  # eigenvalues of the information below this share of the largest are rounding
UNDETERMINED_ERROR = 1.0  # a standard error in ln(value) from which the data say nothing of the value
LEAST_SHARE = 0.1  # a combination lists the parameters that carry at least this share


@dataclass(frozen=True)
class Uncertainty:
    """Linearised errors at a solution, from the given sigma.

    `errors` (k,) are standard errors in base units, infinite where nothing is known, NaN at a bound; `flags` say
    so in words, "" where all is well. `correlation` (k, k) has NaN rows there. `eigenvalues` (rising) and `combinations`
    (columns, over the coordinates) are those of the information matrix of the parameters that are not at a bound.
    """

    errors: Array
    flags: tuple[str, ...]
    correlation: Array
    eigenvalues: Array
    combinations: Array
    weakest: str


def uncertainty(scale: Scale, y: Array, jacobian: Array) -> Uncertainty:
    """Return the errors at coordinates `y` (k,) from d(residuals)/dy (n, k), the residuals in sigma."""
    low, high = scale.bounds
    near = AT_BOUND * (high - low)
    flags = [
        "at its lower bound" if a else "at its upper bound" if b else ""
        for a, b in zip(y - low < near, high - y < near, strict=True)
    ]
    inside = np.array([not f for f in flags])
    k = len(scale)
    errors, correlation = np.full(k, np.nan), np.full((k, k), np.nan)
    values, vectors = np.zeros(0), np.zeros((k, 0))
    if inside.any():
        part = jacobian[:, inside]
        _, singular, rows = np.linalg.svd(part, full_matrices=True)
        values = np.zeros(part.shape[1])
        values[: singular.size] = singular**2
        values, rows = values[::-1], rows[::-1]  # rising
        vectors = np.zeros((k, values.size))
        vectors[inside] = rows.T
        covariance = _covariance(values, rows.T)
        spread = np.sqrt(np.diag(covariance))
        with np.errstate(invalid="ignore"):
            correlation[np.ix_(inside, inside)] = covariance / np.outer(spread, spread)
        errors[inside] = spread
    for i, (q, error) in enumerate(zip(scale, errors, strict=True)):
        if np.isinf(error):
            flags[i] = "not identifiable: other parameters undo it exactly"
        elif error > UNDETERMINED_ERROR:
            flags[i] = "not identifiable: its error exceeds its value" if q.log else "hardly identifiable"
    return Uncertainty(errors * scale.rates(y), tuple(flags), correlation, values, vectors, _weakest(scale, values, vectors))


def _covariance(values: Array, vectors: Array) -> Array:
    """Return the inverse of the information with these eigenvalues, infinite in what its null space holds."""
    blind = values <= MIN_EIGENVALUE_SHARE * values.max(initial=0.0)
    kept = vectors[:, ~blind]
    covariance = (kept / values[~blind]) @ kept.T
    lost = (np.abs(vectors[:, blind]) > 1e-3).any(axis=1)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    return covariance


def _weakest(scale: Scale, values: Array, vectors: Array) -> str:
    """Return the least determined combination of parameters as a formula with its standard error, "" where all are at bounds."""
    if not values.size:
        return ""
    direction = vectors[:, 0] / vectors[np.argmax(np.abs(vectors[:, 0])), 0]
    terms: list[str] = []
    for q, weight in sorted(zip(scale, direction, strict=True), key=lambda t: -abs(t[1])):
        if abs(weight) >= LEAST_SHARE:
            name = f"ln {q.name}" if q.log else f"{q.name}/{q.size:.3g}"
            sign = ("- " if weight < 0 else "+ ") if terms else ""
            size = "" if abs(abs(weight) - 1) < 5e-3 else f"{abs(weight):.2f} "
            terms.append(f"{sign}{size}{name}")
    if values[0] <= MIN_EIGENVALUE_SHARE * values.max():
        return f"{' '.join(terms)}: not determined at all"
    length = np.linalg.norm(direction)  # the error is that of the formula as it is written
    return f"{' '.join(terms)}: standard error {length / np.sqrt(values[0]):.2g}"
