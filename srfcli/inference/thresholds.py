"""Parameters from measured critical loads: the paper's procedure, and a least squares beside it, with errors.

Both minimise chi2 = sum ((W0c - measured)/sigma)^2 over the same coordinates from the same start, with the same
cost function: Powell's method (Powell 1964, as the paper took it from Numerical Recipes) from its values alone, the least
squares (trust region, Branch, Coleman and Li 1999) with the exact derivatives of threshold_slopes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError, Status, did_you_mean
from srfcli.inference.threshold_match import Match, Matcher
from srfcli.inference.threshold_table import Scale, Thresholds

# Parameters from measured critical loads: the paper's procedure with Powell's method, and a least squares beside it.

METHODS = ("powell", "least-squares")
MAX_EVALUATIONS = 2000
ROUNDS = 3  # fits from where a survey of the solution found nearer crossings
FIRST_STEP = 0.05  # in a coordinate: with it Powell's method brackets the minimum on a line
SETTLED = 1.0, 30.0  # times the loads' accuracy: changes of chi2 and of the coordinates that end the least squares
POWELL_SETTLED = 1e-4  # the same for a round of Powell's method through all directions
PERFECT = 3.0  # times the accuracy of the critical loads: residuals all below it are as good as none
DETOURS = 3  # times that a least squares goes around a jump of the cost
CLIFF, JUMP = 1e-3, 0.02  # a load that changes by so much, in ln W0, over so little in a coordinate has jumped
OUTSIDE = 0.05  # a coordinate this far beyond its bound doubles Powell's cost

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
    """A table fitted by one or both methods; `status` is the worst of theirs."""

    table: Thresholds
    scale: Scale
    methods: tuple[MethodFit, ...]
    status: Status

    @property
    def best(self) -> MethodFit:
        """Return the method with the lowest chi2."""
        return min(self.methods, key=lambda m: m.cost)


class _Stop(Exception):
    """Raised inside a minimiser that need not, or may not, go on."""


class _Work:
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
            raise _Stop("limit")
        match = self.matcher.match(y)
        self.last = match
        self._seen.append((match.y, match.loads))
        if self.best is None or match.cost < self.best.cost:
            self.best = match
        for values, value in (
            (self.trace.cost, match.cost),
            (self.trace.best, self.best.cost),
            (self.trace.cpu, time.process_time() - self.begun),
        ):
            values.append(value)
        if self.report is not None:
            self.report(self.trace)
        if np.abs(match.loads - self.matcher.table.W0c).max() < PERFECT * self.matcher.tol * match.loads.min():
            raise _Stop("perfect")
        return match

    def jumped(self) -> Array:
        """Return for each datum (n,) whether its load changed by JUMP within CLIFF of the best coordinates found."""
        jumped = np.zeros(len(self.matcher.table), dtype=bool)
        best = self.best
        if best is not None:
            for y, loads in self._seen:
                if np.abs(y - best.y).max() < CLIFF:
                    jumped |= np.abs(np.log(loads / best.loads)) > JUMP
        return jumped

    def residuals(self, y: Array) -> Array:
        return self.at(y).residuals

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
    methods: Sequence[str] = METHODS,
    tol: float = 1e-6,
    max_evaluations: int = MAX_EVALUATIONS,
    report: Report | None = None,
) -> ThresholdFit:
    """Return the parameters of `scale` that bring the model's critical loads nearest to the table's.

    `values` are all parameters in base units, `tol` the relative accuracy of each critical load; `report` is called after
    each evaluation. An interruption (KeyboardInterrupt) ends the fit with the best found so far, its status says so.
    """
    for name in methods:
        if name not in METHODS:
            raise SrfError(f"unknown method {name!r}", did_you_mean(name, METHODS))
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
    return ThresholdFit(table, scale, tuple(fits), worst)


def _run(matcher: Matcher, method: str, limit: int, report: Report | None) -> MethodFit:
    """Run one method, survey its solution, and run it again from there where that finds nearer crossings."""
    work, status, notes = _Work(matcher, method, limit, report), Status.OK, []
    minimise = {"powell": _powell, "least-squares": _least_squares}[method]
    y = np.zeros(len(matcher.scale))
    first = matcher.match(y, anew=True)  # the start has to be known, interrupted or not
    surveyed = first
    try:
        for turn in range(ROUNDS):
            work.best = None  # costs with other crossings do not compare
            status = minimise(work, y)
            found = work.best or first
            work.last = None
            surveyed = matcher.match(found.y, anew=True)
            y = found.y
            if surveyed.cost > found.cost - 1e-3 * (1 + found.cost) and not _changed(found, surveyed):
                break
            notes.append(_rematched(turn, found, surveyed, matcher.table))
            if status is Status.EVALUATIONS:
                break
    except KeyboardInterrupt:
        status, surveyed = Status.INTERRUPTED, work.best or surveyed
    return _finished(matcher, work, first, surveyed, status, notes)


def _changed(a: Match, b: Match) -> bool:
    return bool((np.abs(np.log(a.loads / b.loads)) > 1e-3).any())


def _rematched(turn: int, found: Match, surveyed: Match, table: Thresholds) -> str:
    moved = np.nonzero(np.abs(np.log(found.loads / surveyed.loads)) > 1e-3)[0]
    lines = ", ".join(str(table.lines[i]) for i in moved)
    end = "the fit went on from there" if turn + 1 < ROUNDS else "the matching did not settle"
    return f"a survey of the solution found other crossings nearer to the data of line {lines}; {end}"


def _finished(matcher: Matcher, work: _Work, first: Match, end: Match, status: Status, notes: list[str]) -> MethodFit:
    table, scale = matcher.table, matcher.scale
    known = uncertainty(scale, end.y, matcher.jacobian(end))
    return MethodFit(
        method=work.trace.method,
        values=scale.values(end.y),
        uncertainty=known,
        match=end,
        start_cost=first.cost,
        cost=end.cost,
        paper_cost=tuple(float(((m.loads - table.W0c) ** 2).sum()) for m in (first, end)),  # type: ignore[arg-type]
        evaluations=len(work.trace),
        gradients=work.gradients,
        surveys=matcher.surveys,
        cpu=time.process_time() - work.begun,
        trace=work.trace,
        status=status,
        notes=(*work.notes, *notes, *match_notes(table, end)),
    )


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


def _least_squares(work: _Work, y: Array) -> Status:
    """Run the least squares; where a crossing's jump stops it, once more without the data that jumped, then with all again.

    At a fold two crossings merge, and the nearest odd one is suddenly another: the cost has a cliff, before which its derivatives
    point over the edge.
    """
    everything = np.ones(len(work.matcher.table), dtype=bool)
    try:
        status, _ = _trust_region(work, y, everything)
        for _ in range(DETOURS):
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
    except _Stop as stop:
        return Status.EVALUATIONS if str(stop) == "limit" else Status.OK
    return status


def _trust_region(work: _Work, y: Array, kept: Array) -> tuple[Status, Array]:
    """Minimise the squares of the residuals `kept` (n,) from coordinates `y`, and return where that ended."""
    from scipy.optimize import least_squares

    low, high = work.matcher.scale.bounds
    inner = np.clip(y, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
    done = least_squares(
        lambda c: work.residuals(c)[kept],
        inner,
        jac=lambda c: work.jacobian(c)[kept],
        bounds=(low, high),
        method="trf",
        ftol=SETTLED[0] * work.matcher.tol,
        xtol=SETTLED[1] * work.matcher.tol,
        gtol=1e-10,
        max_nfev=work.limit,
    )
    return Status.OK if done.status > 0 else Status.EVALUATIONS, done.x


def _powell(work: _Work, y: Array) -> Status:
    """Run Powell's method in units of FIRST_STEP; beyond a bound the cost is that at the bound, raised with the distance.

    Handing the bounds to scipy instead would make it search every line from bound to bound.
    """
    from scipy.optimize import minimize

    low, high = work.matcher.scale.bounds

    def cost(steps: Array) -> float:
        wanted = FIRST_STEP * steps
        inside = np.clip(wanted, low, high)
        outside = float(np.abs(wanted - inside).sum()) / OUTSIDE
        value = work.at(inside).cost
        return value * (1 + outside) + outside

    options = {"ftol": POWELL_SETTLED, "xtol": POWELL_SETTLED, "maxfev": 10 * work.limit, "maxiter": work.limit}
    try:
        minimize(cost, y / FIRST_STEP, method="Powell", options=options)
    except _Stop as stop:
        return Status.EVALUATIONS if str(stop) == "limit" else Status.OK
    return Status.OK


def with_noise(table: Thresholds, seed: int, *, relative: float = 0.03) -> Thresholds:
    """Return the table with independent normal noise of `relative` times each load added, its sigma set to that."""
    sigma = relative * table.W0c
    noise = np.random.default_rng(seed).normal(size=len(table)) * sigma
    return replace(table, W0c=table.W0c + noise, sigma=sigma)


def generated(
    model: GeneratedModel,
    V: Array,
    eps: Array,
    *,
    values: Mapping[str, float],
    tol: float = 1e-8,
    relative: float = 0.03,
) -> Thresholds:
    """Return the lowest odd critical load of the model at each (V, eps), (n,), with `relative` errors but no noise.

    `values` are all parameters in base units, the table's eps is that before the paper's rho. Raises SrfError where sliding
    is stable at every load looked at.
    """
    from srfcli.inference.threshold_table import thresholds
    from srfcli.numerics.critical import critical_line, load_window
    from srfcli.numerics.hopf import critical_point

    own = {k: v for k, v in values.items() if k in model.names}
    share = values.get("rho", 1.0) if "rho" not in model.names else 1.0
    loads = []
    for velocity, amplitude in zip(V, eps, strict=True):
        base = model.vector({**own, "V": float(velocity), "eps": share * float(amplitude)})
        if share * amplitude > 0:
            lo, hi = load_window(model, [base])
            odd = [q for q in critical_line(model, base, lo=lo, hi=hi, tol=tol).points if q.slope > 0]
            if not odd:  # none around that without modulation
                odd = [q for q in critical_line(model, base, tol=tol).points if q.slope > 0]
            load = odd[0].value(model, "W0") if odd else None
        else:
            point = critical_point(model, base)[0]
            load = None if point is None else point.W0
        if load is None:
            raise SrfError(
                f"sliding is stable at every load at V = {velocity:g} um/s, eps = {amplitude:g}",
                "Leave this point out.",
            )
        loads.append(load)
    return thresholds(V, eps, loads, sigma=relative * np.array(loads), source="generated")


# What a fit of critical loads knows: standard errors, correlations, and the combinations that the data leave open.

AT_BOUND = 1e-6  # of the distance between the bounds, in the parameter's coordinate
BLIND = 1e-9  # eigenvalues of the information below this share of the largest are rounding
LOOSE = 1.0  # a standard error in ln(value) from which the data say nothing of the value
LEAST = 0.1  # a combination lists the parameters that carry at least this share


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
        elif error > LOOSE:
            flags[i] = "not identifiable: its error exceeds its value" if q.log else "hardly identifiable"
    return Uncertainty(
        errors * scale.rates(y), tuple(flags), correlation, values, vectors, _weakest(scale, values, vectors)
    )


def _covariance(values: Array, vectors: Array) -> Array:
    """Return the inverse of the information with these eigenvalues, infinite in what its null space holds."""
    blind = values <= BLIND * values.max(initial=0.0)
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
        if abs(weight) >= LEAST:
            name = f"ln {q.name}" if q.log else f"{q.name}/{q.size:.3g}"
            sign = ("- " if weight < 0 else "+ ") if terms else ""
            size = "" if abs(abs(weight) - 1) < 5e-3 else f"{abs(weight):.2f} "
            terms.append(f"{sign}{size}{name}")
    if values[0] <= BLIND * values.max():
        return f"{' '.join(terms)}: not determined at all"
    length = np.linalg.norm(direction)  # the error is that of the formula as it is written
    return f"{' '.join(terms)}: standard error {length / np.sqrt(values[0]):.2g}"
