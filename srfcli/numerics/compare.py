"""Laws adjusted to the same observables at one low velocity, so that they differ in form, not in calibration; their boundaries.

A law is studied in a window of V and W0: its boundary components at each amplitude, from maps; where they cross lines of constant
V; and the smallest amplitude at which a line meets more than one boundary (re-entrance).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError, Status
from srfcli.numerics.continuation import Branch, ContinuationSettings, find_components
from srfcli.numerics.hopf import critical_point, hopf_points, weakening
from srfcli.numerics.map import compute_map, tile_model
from srfcli.numerics.map_boundaries import find_boundaries, unexplained
from srfcli.numerics.plane import Axis, MapAxis, MapGrid, MapSettings, Plane, polyline_heights

ADJUSTED = ("A", "B", "D0")  # what is adjusted to slope, critical load and critical period
FRICTION_LEVEL = "mu0"  # adjusted to the level of friction, which is what a modulated load works on
TOLERANCE = 1e-10  # of the search for the adjusted parameters
OUTSIDE = 1e3  # the miss where there is no critical load


@dataclass(frozen=True)
class Observables:
    """What an experiment at a low velocity V measures: friction, -d mu_ss/d ln V, critical load (N) and frequency (rad/s)."""

    V: float
    friction: float
    slope: float
    W0: float
    Omega: float


def observe(model: GeneratedModel, p: Array, V: float) -> Observables | None:
    """Return the observables at velocity `V` of the model with parameters `p` (n_parameters,), None without a Hopf point."""
    q = model.with_values(p, V=V)
    point, _ = critical_point(model, q)
    slope = weakening(model, q)
    if point is None or not slope > 0:
        return None
    friction = _friction(model, model.with_values(q, W0=point.W0))
    return Observables(V, friction, slope, point.W0, point.Omega)


def _friction(model: GeneratedModel, p: Array) -> float:
    """Return the friction coefficient in steady sliding at `p` (n_parameters,)."""
    return float(model.cycle_friction(0.0, model.steady(p), p.tolist()))


@dataclass(frozen=True)
class Match:
    """A law's parameters `p` (n_parameters,) with the names of those adjusted, and the largest relative miss that is left."""

    p: Array
    adjusted: tuple[str, ...]
    miss: float
    status: Status


def check_adjusted(model: GeneratedModel, names: Sequence[str]) -> None:
    """Raise SrfError unless `names` are three different parameters of the model, mu0 not among them."""
    if len(set(names)) != 3 or len(names) != 3 or FRICTION_LEVEL in names:
        raise SrfError(
            f"`adjust` {','.join(names)} is not three parameters other than {FRICTION_LEVEL}",
            f"Three are matched to slope, critical load and period, {FRICTION_LEVEL} to the level: A,B,D0.",
        )
    for name in names:
        model.index(name)


def match(model: GeneratedModel, p: Array, goal: Observables, names: Sequence[str] = ADJUSTED) -> Match:
    """Return `p` with three parameters, and mu0 where there is one, adjusted until the observables are those of `goal`.

    The search is in the parameters' logarithms, from their values in `p`.
    """
    from scipy.optimize import root

    check_adjusted(model, names)
    rows = [model.index(n) for n in names]

    def adjusted(steps: Array) -> Array:
        q = p.copy()
        q[rows] *= np.exp(steps)
        return _levelled(model, q, goal)

    def misses(steps: Array) -> Array:
        """Return the logarithms of slope, load and frequency over their goals."""
        here = observe(model, adjusted(steps), goal.V)
        if here is None:  # outside of the velocity-weakening regime
            return np.full(3, OUTSIDE)
        return np.log([here.slope / goal.slope, here.W0 / goal.W0, here.Omega / goal.Omega])

    with np.errstate(all="ignore"):  # a trial far off may overflow
        q = adjusted(root(misses, np.zeros(3), tol=TOLERANCE).x)
    reached, left = observe(model, q, goal.V), np.inf
    if reached is not None:
        own = ("slope", "W0", "Omega", "friction") if FRICTION_LEVEL in model.names else ("slope", "W0", "Omega")
        left = max(abs(getattr(reached, name) / getattr(goal, name) - 1) for name in own)
    every = (*names, FRICTION_LEVEL) if FRICTION_LEVEL in model.names else tuple(names)
    return Match(q, every, left, Status.OK if left < 1e-6 else Status.NO_CONVERGENCE)


def _levelled(model: GeneratedModel, p: Array, goal: Observables) -> Array:
    """Return `p` with mu0, if there is one, such that friction at the goal's velocity is the goal's: mu0 may not be additive."""
    from scipy.optimize import newton

    if FRICTION_LEVEL not in model.names:
        return p
    q = model.with_values(p, V=goal.V, W0=goal.W0)

    def off(value: float) -> float:
        return _friction(model, model.with_values(q, **{FRICTION_LEVEL: value})) - goal.friction

    level = newton(off, float(p[model.index(FRICTION_LEVEL)]), tol=1e-15, disp=False)
    return model.with_values(p, **{FRICTION_LEVEL: float(level)})


# One law's boundaries at several amplitudes, and what two laws' boundaries say of each other.

MAPPED = 4.0  # times as long as a search on lines a map takes
EXPERIMENT = 0.03  # relative error of the paper's critical loads


@dataclass(frozen=True)
class Window:
    """Where laws are compared: velocities and loads, from low to high, with the numbers of columns and rows of the maps."""

    V: tuple[float, float]
    W0: tuple[float, float]
    columns: int = 40
    rows: int = 60

    def velocities(self) -> Array:
        """Return the lines of constant V on which boundaries are counted."""
        return np.geomspace(*self.V, 4 * self.columns + 1)


@dataclass(frozen=True, eq=False)  # parts are found by their task itself: its parameters are an array
class LawTask:
    """All that the study of a law depends on: its model's source, parameters, rising amplitudes, window, and tolerances."""

    source: str
    key: str
    p: Array
    amplitudes: tuple[float, ...]
    window: Window
    tol: float = 1e-5
    onset: float = 2e-3  # how closely the amplitudes at which re-entrance begins and ends are bracketed
    stride: float = 0.01  # between amplitudes that are looked at: re-entrance that comes and goes in less may be missed


@dataclass(frozen=True)
class LawStudy:
    """A law's boundaries, for each of the task's amplitudes: `crossings` (lines, most) rising loads, NaN where there are no more.

    `curves` are its components as (points, 2) arrays of V and W0, `folds` how often V turns round on them all, `unexplained` the
    number of map points that the curves do not account for. `onset` brackets the amplitude at which re-entrance begins:
    (nan, nan) where it does not up to the largest amplitude, (0, 0) where it is there without modulation; `end` that at which it
    is gone again, (nan, nan) where it stays up to the largest.
    """

    crossings: tuple[Array, ...]
    curves: tuple[tuple[Array, ...], ...]
    folds: tuple[int, ...]
    unexplained: tuple[int, ...]
    onset: tuple[float, float]
    end: tuple[float, float]
    status: tuple[Status, ...]


@dataclass(frozen=True)
class LawPart:
    """What is studied of a law at one amplitude: its boundaries from a map, or only whether they are re-entrant."""

    task: LawTask
    eps: float
    mapped: bool

    @property
    def weight(self) -> float:
        """Return about how long this takes, relative to other parts."""
        return MAPPED if self.mapped and self.eps > 0 else 1.0


def law_parts(task: LawTask) -> list[LawPart]:
    """Return the parts of a law's study that do not depend on each other, those that take longest first."""
    largest = max(task.amplitudes)
    between = np.linspace(0, largest, max(1, math.ceil(largest / task.stride)) + 1).tolist()
    looked = [eps for eps in between if min(abs(eps - k) for k in task.amplitudes) > 0.4 * task.stride]
    return [LawPart(task, eps, True) for eps in task.amplitudes[::-1]] + [LawPart(task, eps, False) for eps in looked[::-1]]


def study_part(part: LawPart) -> dict[str, Array]:
    """Return a part of a law's study as plain arrays, which `join_study` puts together; it depends on nothing but `part`.

    A KeyboardInterrupt ends it: half a search is no study, and must not be kept as one.
    """
    task, eps = part.task, part.eps
    model = tile_model(task.source, task.key)
    if not part.mapped:
        return {"several": np.array(_there(model, task, eps))}
    curves, odd, status = _boundaries(model, task, eps) if eps > 0 else (_without(model, task), 0, Status.OK)
    return {
        "several": np.array(_reentrant(curves, task.window)),
        "crossings": _padded(curves, task.window),
        "folds": np.array(sum(turns(c[:, 0]) for c in curves)),
        "odd": np.array(odd),
        "status": np.array(list(Status).index(status)),
        "sizes": np.array([len(c) for c in curves], dtype=int),
        "curves": np.concatenate([np.zeros((0, 2)), *curves]),
    }


def join_study(task: LawTask, found: Mapping[LawPart, dict[str, Array]]) -> LawStudy:
    """Return the study whose parts, all of `law_parts`, were found; the ends of re-entrance are bracketed here."""
    mapped = {part.eps: arrays for part, arrays in found.items() if part.mapped}
    rows = [mapped[eps] for eps in task.amplitudes]
    several = {part.eps: bool(arrays["several"]) for part, arrays in found.items()}
    model = tile_model(task.source, task.key)
    onset, end = reentrance(several, lambda eps: _there(model, task, eps), within=task.onset)
    return LawStudy(
        tuple(row["crossings"] for row in rows),
        tuple(tuple(np.split(row["curves"], np.cumsum(row["sizes"])[:-1])) if row["sizes"].size else () for row in rows),
        tuple(int(row["folds"]) for row in rows),
        tuple(int(row["odd"]) for row in rows),
        onset,
        end,
        tuple(list(Status)[int(row["status"])] for row in rows),
    )


def _boundaries(model: GeneratedModel, task: LawTask, eps: float) -> tuple[list[Array], int, Status]:
    """Return components, unexplained map points and the status at one amplitude, from a map."""
    window = task.window
    base = model.with_values(task.p, eps=eps)
    grid = MapGrid(base, MapAxis("V", *window.V, window.columns), MapAxis("W0", *window.W0, window.rows))
    found = compute_map(model, grid, MapSettings(depth=3))
    *_, boundary = find_boundaries(model, found, ContinuationSettings(tol=task.tol))
    if not found.finished or boundary.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    odd = len(unexplained(model, found, boundary))
    status = Status.NO_CONVERGENCE if odd or found.lost else boundary.status
    return [_curve(model, b) for b in boundary.branches], odd, status


def _curve(model: GeneratedModel, branch: Branch) -> Array:
    """Return V and W0 of a branch, (points, 2)."""
    return branch.p[[model.index("V"), model.index("W0")]].T


def _without(model: GeneratedModel, task: LawTask) -> list[Array]:
    """Return the boundary without modulation: the leading Hopf points at the window's lines, one curve for each number."""
    low, high = task.window.W0
    by_number: dict[int, list[tuple[float, float]]] = {}
    for V in task.window.velocities():
        loads = [q.W0 for q in hopf_points(model, model.with_values(task.p, V=V)) if q.leading and low <= q.W0 <= high]
        for number, load in enumerate(loads):
            by_number.setdefault(number, []).append((float(V), load))
    return [np.array(points) for points in by_number.values()]


def turns(values: Array) -> int:
    """Return how often a sequence turns round."""
    steps = np.sign(np.diff(values))
    steps = steps[steps != 0]
    return int((steps[:-1] != steps[1:]).sum())


def _heights(curves: Sequence[Array], window: Window) -> list[list[float]]:
    """Return for each line of the window the loads, rising, at which the curves cross it."""
    x, y = Axis("V", *window.V), Axis("W0", *window.W0)
    lines = [np.stack([x.unit(c[:, 0]), y.unit(c[:, 1])], axis=1) for c in curves]
    return [y.value(heights).tolist() for heights in polyline_heights(lines, x.unit(window.velocities()))]


def _padded(curves: Sequence[Array], window: Window) -> Array:
    """Return the crossings of the window's lines as an array (lines, most), NaN where a line has fewer."""
    found = _heights(curves, window)
    out = np.full((len(found), max(1, *map(len, found))), np.nan)
    for row, loads in zip(out, found, strict=True):
        row[: len(loads)] = loads
    return out


def _reentrant(curves: Sequence[Array], window: Window) -> bool:
    """Return whether some line of constant V meets more than one boundary: a fold in V, or several crossings of a line."""
    return any(turns(c[:, 0]) for c in curves) or any(len(h) > 1 for h in _heights(curves, window))


def _there(model: GeneratedModel, task: LawTask, eps: float) -> bool:
    """Return whether boundaries are re-entrant at one amplitude."""
    found = _followed(model, task, eps) if eps > 0 else iter([_without(model, task)])
    return any(_reentrant(curves, task.window) for curves in found)


def reentrance(
    known: Mapping[float, bool], there: Callable[[float], bool], *, within: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the brackets, no wider than `within`, of the amplitudes at which re-entrance begins, and is gone again.

    `known` says of amplitudes, from which they are sought, whether it is there, and `there` says so of any. See LawStudy.
    """

    def halved(low: float, high: float) -> tuple[float, float]:
        after = known[high]
        while high - low > within:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if there(middle) == after else (middle, high)
        return low, high

    brackets: list[tuple[float, float]] = []
    rising = sorted(known)
    for before, eps in zip([0.0, *rising], rising, strict=False):
        if len(brackets) < 2 and known[eps] == (not brackets):
            brackets.append(halved(before, eps))
    onset, end = (*brackets, *((np.nan, np.nan),) * (2 - len(brackets)))
    return onset, end


def _followed(model: GeneratedModel, task: LawTask, eps: float) -> Iterator[list[Array]]:
    """Yield the components at one amplitude, as they are found by a search on lines, which is quicker than a map."""
    base = model.with_values(task.p, eps=eps)
    plane = Plane(base, Axis("V", *task.window.V), Axis("W0", *task.window.W0))
    for boundary in find_components(model, plane, ContinuationSettings(lines=8, tol=1e-4)):
        if boundary.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        yield [_curve(model, b) for b in boundary.branches]


def changed_areas(crossings: Sequence[Array], window: Window) -> tuple[float, float]:
    """Return the shares of the window in (ln V, ln K/W0) that the last amplitude destabilises and stabilises.

    `crossings` are those of rising amplitudes. Destabilised: stable at one of the smaller amplitudes, unstable at the last;
    stabilised: unstable at the first, stable at the last. Sliding is stable below the first crossing of a line, unstable beyond
    it, and so on in turn.
    """
    lost = gained = 0.0
    low, high = np.log(window.W0)
    for line in zip(*crossings, strict=True):
        edges = [np.sort(np.log(np.clip(q[np.isfinite(q)], *window.W0))) for q in line]
        cuts = np.unique(np.concatenate([[low, high], *edges]))
        middle, width = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts)
        unstable = np.array([np.searchsorted(e, middle) % 2 == 1 for e in edges])
        lost += float(width[~unstable[:-1].all(axis=0) & unstable[-1]].sum())
        gained += float(width[unstable[0] & ~unstable[-1]].sum())
    lines = len(crossings[0])
    return lost / lines / (high - low), gained / lines / (high - low)


@dataclass(frozen=True)
class Contrast:
    """Where two laws' critical loads differ most: V and eps, with both loads (N)."""

    eps: float
    V: float
    W0: tuple[float, float]

    @property
    def difference(self) -> float:
        """Return the larger load over the smaller, less one."""
        return max(self.W0) / min(self.W0) - 1

    @property
    def seen(self) -> bool:
        """True where the difference exceeds twice the relative error of an experiment."""
        return self.difference > 2 * EXPERIMENT


def contrast(a: LawStudy, b: LawStudy, amplitudes: Sequence[float], window: Window) -> Contrast | None:
    """Return the first crossing (the lowest critical load) in which two laws differ most, None where none is shared."""
    found, velocities = [], window.velocities()
    for eps, one, other in zip(amplitudes, a.crossings, b.crossings, strict=True):
        pairs = np.stack([one[:, 0], other[:, 0]])
        with np.errstate(invalid="ignore"):
            apart = np.abs(np.log(pairs[0] / pairs[1]))
        if np.isfinite(apart).any():
            i = int(np.nanargmax(apart))
            found.append(Contrast(eps, float(velocities[i]), (float(pairs[0, i]), float(pairs[1, i]))))
    return max(found, key=lambda here: here.difference, default=None)
