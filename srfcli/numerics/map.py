"""Stability maps: the leading Floquet multiplier over a grid of two parameters, tile by tile, refined where it matters.

Newton's method starts from the polynomial through up to six neighbours along a row or column of the grid: most orbits then need
a single linearisation, whose product of maps is the monodromy matrix that is wanted.

In a cell whose corners agree in sign a boundary can hide only where g comes within its interpolation error of zero. That error is
taken from second differences of the grid, and in a cell that was halved from how far its new points lie off the mean of the old.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from srfcli.codegen.model import Array, ComplexArray, GeneratedModel, load_source
from srfcli.core.errors import Status
from srfcli.core.parallel import run_here
from srfcli.motion.imposed import Drive, Modulation
from srfcli.motion.simulate import simulate
from srfcli.numerics.boundary import periodic_map, upper_half
from srfcli.numerics.collocation import STAGES, Discretisation, gauss, join, kernel, mesh_error
from srfcli.numerics.orbit import (
    CHUNK,
    OrbitBatch,
    combined,
    interpolate,
    levels,
    neighbours,
    robust_orbits,
    solve_orbits,
    uniform_mesh,
)
from srfcli.numerics.plane import MapGrid, MapSettings, TileTask, tile_tasks

# of a point: no orbit found; stable; unstable by a multiplier off the real axis, a negative, a positive one
STABILITY_KINDS = ("unresolved", "stable", "ns", "pd", "fold")
REAL_ANGLE = 1e-7  # a multiplier whose angle is nearer to 0 or pi is real

Tile = dict[str, Array]
Runner = Callable[[Callable[[TileTask], Tile], Sequence[TileTask]], Iterator[tuple[int, Tile]]]


@dataclass
class Seed:
    """A pair of neighbouring points between which the leading multiplier crosses the unit circle.

    `ends` (2, 2) in unit coordinates of the plane, lower one first along `axis`; `rising` where stability is lost along it.
    """

    ends: Array
    axis: int
    rising: bool
    p: Array
    rho: complex
    orbit: Discretisation


@dataclass
class Discontinuity:
    """A stable point, `ends[0]` in unit coordinates of the plane, whose state may end on the way to its neighbour `ends[1]`.

    At the neighbour no orbit was found, or quite another.
    """

    ends: Array
    axis: int
    rho: complex
    orbit: Discretisation


@dataclass(frozen=True, eq=False)
class StabilityMap:
    """A map: `leading` (nx, ny), the leading multiplier, NaN where no orbit was found; `mesh` (nx, ny) intervals.

    `extra_at` (E, 2), in grid steps, are points added in cells where a boundary could hide; `suspect`
    (S, 3) are cells (column, row, size in grid steps) in which one still could.
    """

    grid: MapGrid
    settings: MapSettings
    leading: ComplexArray
    mesh: Array
    extra_at: Array
    suspect: Array
    seeds: list[Seed]
    discontinuities: list[Discontinuity] = field(default_factory=list)
    finished: bool = True

    @property
    def growth(self) -> Array:
        """Return ln |leading multiplier| over one forcing period, (nx, ny)."""
        return np.log(np.maximum(np.abs(self.leading), 1e-300))  # one that underflowed is as small as a number can be

    @property
    def kind(self) -> Array:
        """Return the index in STABILITY_KINDS of each point, (nx, ny)."""
        return kinds(self.leading)

    @property
    def lost(self) -> int:
        """Return the number of grid points at which no orbit was found."""
        return int((~np.isfinite(self.leading)).sum())

    def points(self, model: GeneratedModel) -> Array:
        """Return the parameters of the grid points, (n_parameters, nx, ny)."""
        return self.grid.points(model, *np.meshgrid(self.grid.x.samples(), self.grid.y.samples(), indexing="ij"))

    def spacing(self) -> tuple[float, float]:
        """Return the widest spacing of the grid along x and y, relative where it is logarithmic or the values positive."""
        found = []
        for axis in (self.grid.x, self.grid.y):
            values = axis.samples()
            gaps = np.diff(np.log(values)) if values[0] > 0 else np.diff(values) / abs(values[-1])
            found.append(float(gaps.max()))
        return found[0], found[1]


def kinds(leading: ComplexArray) -> Array:
    """Return the index in STABILITY_KINDS of points with these leading multipliers."""
    with np.errstate(invalid="ignore"):
        angle = np.abs(np.angle(leading))
        unstable = np.where(angle < REAL_ANGLE, 4, np.where(angle > np.pi - REAL_ANGLE, 3, 2))
        return np.where(~np.isfinite(leading), 0, np.where(np.abs(leading) < 1, 1, unstable))


def per_slip(model: GeneratedModel, p: Array) -> Array:
    """Return what turns an exponent per forcing period into one per slip distance D0/V, (...,) for `p` (n_parameters, ...).

    Where the law has no D0 it is the forcing frequency: exponents are then per second.
    """
    rate = p[model.index("f")]
    return np.asarray(rate * p[model.index("D0")] / p[model.index("V")] if "D0" in model.names else rate)


def compute_map(
    model: GeneratedModel,
    grid: MapGrid,
    settings: MapSettings | None = None,
    *,
    run: Runner = run_here,
    progress: Callable[[int, int], Any] = lambda done, count: None,
) -> StabilityMap:
    """Return the stability map of `grid`; `run` says where the tiles are computed, which changes nothing in them.

    `progress` is told how many tiles of how many are done. Raises SrfError for axes that span no plane. A KeyboardInterrupt
    ends it: where a tile was finished the map is returned with the others empty, and `finished` false.
    """
    settings = settings or MapSettings()
    tasks = tile_tasks(model, grid, settings)
    tiles: dict[int, Tile] = {}
    kernel(model)  # compiled here, not by every worker at once
    try:
        for index, tile in run(solve_tile, tasks):
            tiles[index] = tile
            progress(len(tiles), len(tasks))
    except KeyboardInterrupt:
        if not tiles:
            raise
    return join_tiles(model, grid, settings, [(t, tiles[t.index]) for t in tasks if t.index in tiles])


def join_tiles(
    model: GeneratedModel, grid: MapGrid, settings: MapSettings, tiles: Sequence[tuple[TileTask, Tile]]
) -> StabilityMap:
    """Return the map that `tiles`, in the tasks' order, make up; it is finished where they cover the grid."""
    shape = (grid.x.count, grid.y.count)
    leading, mesh = np.full(shape, np.nan, dtype=complex), np.zeros(shape, dtype=int)
    covered = 0
    seeds: list[Seed] = []
    discontinuities: list[Discontinuity] = []
    for task, tile in tiles:
        leading[task.place], mesh[task.place] = tile["leading"], int(tile["mesh"])
        seeds += _tile_seeds(model, grid, tile)
        discontinuities += _tile_discontinuities(model, grid, tile)
        covered += (task.shape[0] - 1) * (task.shape[1] - 1)
    extra_at = np.concatenate([t["extra_at"] for _, t in tiles])
    _, first = np.unique(extra_at, axis=0, return_index=True)  # tiles that meet refine their common side alike
    return StabilityMap(
        grid,
        settings,
        leading,
        mesh,
        extra_at[first],
        np.concatenate([t["suspect"] for _, t in tiles]),
        seeds,
        discontinuities,
        covered == (shape[0] - 1) * (shape[1] - 1),
    )


def _tile_discontinuities(model: GeneratedModel, grid: MapGrid, tile: Tile) -> list[Discontinuity]:
    """Return the discontinuities of a tile, in the plane's unit coordinates."""
    unit = grid.plane(model).coordinates(model, grid.at(model, tile["discontinuity_ends"]))  # (K, 2, 2)
    orbits = Discretisation(tile["discontinuity_x"], tile["discontinuity_stages"], uniform_mesh(int(tile["mesh"])))
    places = zip(tile["discontinuity_axis"].tolist(), tile["discontinuity_rho"].tolist(), strict=True)
    return [Discontinuity(unit[k], axis, rho, orbits.part(k)) for k, (axis, rho) in enumerate(places)]


def _tile_seeds(model: GeneratedModel, grid: MapGrid, tile: Tile) -> list[Seed]:
    """Return the seeds of a tile, in the plane's unit coordinates."""
    unit = grid.plane(model).coordinates(model, grid.at(model, tile["seed_ends"]))  # (E, 2, 2)
    orbits = Discretisation(tile["seed_x"], tile["seed_stages"], uniform_mesh(int(tile["mesh"])))
    seeds = []
    for k, axis in enumerate(tile["seed_axis"].tolist()):
        order = np.argsort(unit[k, :, axis])
        g = tile["seed_g"][k][order]
        p, rho = tile["seed_p"][:, k], complex(tile["seed_rho"][k])
        seeds.append(Seed(unit[k][order], axis, bool(g[0] <= g[1]), p, rho, orbits.part(slice(k, k + 1))))
    return seeds


# One tile of a stability map: orbits on a coarse grid, the others from their neighbours, cells refined where it matters.

GRAIN = 4  # meshes are multiples of this many intervals
NEIGHBOURS = ((1, 0), (-1, 0), (0, 1), (0, -1))  # to the points beside a point, in columns and rows
SETTLING = 1000  # periods of a simulation: just beyond a fold the motion lingers
SETTLINGS = 32  # simulations at most in a tile,
IN_VAIN = 3  # and in a row without a periodic state
GOLDEN = 0.6180339887  # a share by whose multiples a list is sampled evenly
NEWTON_STEPS = 8  # Newton steps from a neighbour's guess before an orbit is looked for anew


@dataclass
class Samples:
    """Orbits at points of a tile: `at` (B, 2) in grid steps from the tile's corner, `p` (n_parameters, B), all on one mesh."""

    at: Array
    p: Array
    orbit: Discretisation
    multipliers: ComplexArray

    @property
    def g(self) -> Array:
        """Return ln |leading multiplier| (B,), NaN where no orbit was found."""
        return np.log(np.abs(self.multipliers[:, 0]))


@lru_cache(maxsize=8)
def tile_model(source: str, key: str) -> GeneratedModel:
    """Return the model that a task carries, loaded once in a process."""
    return load_source(source, key=key)


def solve_block(task: TileTask, model: GeneratedModel) -> Samples:
    """Return the orbits at all grid points of a tile, columns first."""
    grid, tol = task.grid, task.settings.tol
    xs, ys = (axis.samples()[part] for axis, part in zip((grid.x, grid.y), task.place, strict=True))
    p = grid.points(model, *np.meshgrid(xs, ys, indexing="ij"))
    columns, rows = (levels(points) for points in task.shape)
    c, r = _pairs(columns[0], rows[0])
    start = regular(_coarse(model, p[:, c, r], task))
    block = _Block(model, OrbitBatch.empty(p, start.orbit.edges, len(model.states)), tol)
    block.orbits.replace((c, r), start)
    for level in range(1, len(rows)):
        block.fill(columns[0], rows[level], np.sort(np.concatenate(rows[:level])), 1)
    for level in range(1, len(columns)):
        block.fill(columns[level], np.arange(task.shape[1]), np.sort(np.concatenate(columns[:level])), 0)
    block.spread()
    every = _pairs(*map(np.arange, task.shape))
    found = block.orbits.part(every)
    return Samples(np.stack(every, axis=-1).astype(float), found.p, found.orbit, found.multipliers)


def _pairs(columns: Array, rows: Array) -> tuple[Array, Array]:
    """Return column and row (B,) of the points at the crossings of `columns` and `rows`, columns first."""
    return np.repeat(columns, len(rows)), np.tile(rows, len(columns))


def _coarse(model: GeneratedModel, p: Array, task: TileTask) -> OrbitBatch:
    """Return the orbits that have no neighbours yet, on a mesh that suits the whole tile."""
    settings, N = task.settings, task.settings.intervals
    batch = robust_orbits(model, p, None, uniform_mesh(N), tol=settings.tol)
    for _ in range(4):
        mesh = _sufficient(model, batch, task)
        if mesh <= N:
            break
        N, edges = mesh, uniform_mesh(mesh)
        usable = batch.converged.all()
        batch = robust_orbits(model, p, interpolate(batch.orbit, edges) if usable else None, edges, tol=settings.tol)
    return batch


def _sufficient(model: GeneratedModel, batch: OrbitBatch, task: TileTask) -> int:
    """Return the intervals that keep the mesh's error below the settings', twice as many where an orbit was not found."""
    N = batch.orbit.intervals
    if not batch.converged.all():  # a finer mesh may find what this one could not
        return min(2 * N, task.settings.finest)
    ratio = float(mesh_error(model, batch.orbit).max()) / task.settings.mesh_error
    if not ratio > 1:
        return N
    return min(GRAIN * int(np.ceil(N * min(1.3 * ratio, 1e4) ** 0.125 / GRAIN)), task.settings.finest)  # error as N^-8


@dataclass
class _Block:
    """The orbits (columns, rows) of a tile while it fills."""

    model: GeneratedModel
    orbits: OrbitBatch
    tol: float

    def fill(self, columns: Array, rows: Array, known: Array, axis: int) -> None:
        """Solve the orbits at `columns` and `rows` from those at the columns (`axis` 0) or rows (1) `known`; keep all."""
        place = _pairs(columns, rows)
        index, weights = neighbours(known, place[axis])
        beside = [along[:, None] for along in place]
        beside[axis] = known[index]
        guess = combined(self.orbits.orbit.part(tuple(beside)), weights)
        self.orbits.replace(place, regular_orbits(self.model, self.orbits.p[:, *place], guess, self.tol))

    def spread(self) -> None:
        """Solve the orbits that were not found from those beside them, again and again until none is added.

        Steps from point to point lead round a cusp to a state that grows out of nothing else nearby. Where they lead nowhere,
        orbits are looked for anew, and the motion is simulated at a few points until it may have settled.
        """
        converged = self.orbits.converged
        self._spread(converged.copy())
        if not converged.all():
            self._spread(self._robust())
        in_vain = 0
        for attempt in range(SETTLINGS):
            if converged.all() or in_vain == IN_VAIN:
                return
            fresh = self._settled(attempt * GOLDEN % 1)
            in_vain = 0 if fresh.any() else in_vain + 1
            self._spread(fresh)

    def _robust(self) -> Array:
        """Look for the missing orbits without a guess, and mark those that are found."""
        missing = ~self.orbits.converged
        c, r = np.nonzero(missing)
        orbits = robust_orbits(self.model, self.orbits.p[:, c, r], None, self.orbits.orbit.edges, tol=self.tol)
        self._keep(c, r, regular(orbits))
        return missing & self.orbits.converged

    def _settled(self, share: float) -> Array:
        """Mark the point, if any, at which a simulation ends in a periodic state; it begins with the state of one beside it.

        Of all such points that is tried which lies a share of the way through their list.
        """
        orbits, converged = self.orbits, self.orbits.converged
        found = np.zeros_like(converged)
        beside = [
            (c, r, c - dc, r - dr)
            for dc, dr in NEIGHBOURS
            for c, r in np.argwhere(_moved(converged, dc, dr) & ~converged).tolist()
        ]
        if beside:
            c, r, from_c, from_r = beside[int(share * len(beside))]
            guess = integrate_to_periodic_state(
                self.model, orbits.p[:, c, r], orbits.orbit.x[from_c, from_r, 0], orbits.orbit.edges
            )
            if guess is not None:
                self._solve(np.array([c]), np.array([r]), guess)
                found[c, r] = converged[c, r]
        return found

    def _spread(self, fresh: Array) -> None:
        """Solve the points beside `fresh` ones from these, and so on."""
        converged = self.orbits.converged
        while fresh.any() and not converged.all():
            added = np.zeros_like(fresh)
            for dc, dr in NEIGHBOURS:
                to_c, to_r = np.nonzero(_moved(fresh, dc, dr) & ~converged)
                if not to_c.size:
                    continue
                self._solve(to_c, to_r, self.orbits.orbit.part((to_c - dc, to_r - dr)))
                added[to_c, to_r] = converged[to_c, to_r]
            fresh = added

    def _solve(self, c: Array, r: Array, guess: Discretisation) -> None:
        """Solve the orbits at columns `c`, rows `r` from `guess`, and keep those that are found."""
        self._keep(c, r, regular_orbits(self.model, self.orbits.p[:, c, r], guess, self.tol))

    def _keep(self, c: Array, r: Array, batch: OrbitBatch) -> None:
        """Store those of a batch that were found, at columns `c`, rows `r`."""
        good = batch.converged
        self.orbits.replace((c[good], r[good]), batch.part(good))


def integrate_to_periodic_state(model: GeneratedModel, p: Array, start: Array, edges: Array) -> Discretisation | None:
    """Return the last of SETTLING periods of the motion that begins in the state `start` (n,), or None where it stops early."""
    V, W0, eps, f = (float(p[model.index(name)]) for name in ("V", "W0", "eps", "f"))
    tau = edges[:-1, None] + np.diff(edges)[:, None] * np.append(0.0, gauss().nodes)
    t = np.concatenate([[0.0], (SETTLING + tau.reshape(-1)) / f])
    trace = simulate(model, p, drive=Drive.constant(V), load=Modulation(W0, eps, f), t=t, start=start, rtol=1e-6)
    if trace.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    if not trace.status.ok:
        return None
    x = trace.x[1:].reshape(len(edges) - 1, STAGES + 1, -1)
    return Discretisation(x[None, :, 0], x[None, :, 1:], edges)


def _moved(marks: Array, dc: int, dr: int) -> Array:
    """Return the marks (columns, rows) moved by dc columns and dr rows, one at most, those beyond the edge dropped."""
    columns, rows = marks.shape
    return np.pad(marks, 1)[1 - dc : 1 - dc + columns, 1 - dr : 1 - dr + rows]


def regular_orbits(model: GeneratedModel, p: Array, guess: Discretisation, tol: float) -> OrbitBatch:
    """Return the orbits at `p` from `guess`, those beyond a fold marked as not found."""
    return regular(solve_orbits(model, p, guess, tol=tol, max_iterations=NEWTON_STEPS))


def regular(batch: OrbitBatch) -> OrbitBatch:
    """Return `batch` with the orbits beyond a fold marked as not found.

    An odd number of multipliers beyond +1, det(1 - M) < 0, is that of a state that meets the sliding state in a fold.
    """
    M = batch.monodromy[batch.converged]
    batch.converged[batch.converged] = np.linalg.det(np.eye(M.shape[-1]) - M) > 0
    return batch


# Cells of a map tile halved where a boundary could hide in them, and every sign change that the points then show.

SAFETY = 1.5  # on an interpolation error, which is itself an estimate
REFINED_SHARE = 0.5  # of a cell's error that its quarters keep: 0.25 where g is smooth, more where multipliers meet
CROSSED = 0.5  # a cell that a boundary crosses is halved, too, where its error exceeds this share of the largest |g|
STATE_JUMP = 0.5  # of a state's logarithms between neighbours: it may be another state then,
LEFT = 0.1  # if what the tangents of the two do not explain of it exceeds this

# in units of half a cell: its middle and the middles of its sides, and the corners whose mean predicts each
MIDDLES = np.array([(1, 0), (1, 2), (0, 1), (2, 1), (1, 1)])
PARENTS = ((0, 1), (2, 3), (0, 2), (1, 3), (0, 1, 2, 3))
CORNERS = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])  # the order of a cell's corners, and of its quarters
SIDES = ((0, 1, 0), (2, 3, 0), (0, 2, 1), (1, 3, 1))  # two corners and the axis they lie along

Between = Callable[[Array, Array], Array]  # what holds between samples i (E,) and j (E,)


@dataclass
class Cells:
    """Cells of one size: lower corners `at` (C, 2) and `size` in finest steps, `error` (C,) of interpolating g in each."""

    at: Array
    size: int
    error: Array

    def corners(self) -> Array:
        """Return the corners (C, 4, 2)."""
        return self.at[:, None, :] + self.size * CORNERS


class _Points:
    """Samples found by their place; places are whole numbers of finest steps."""

    def __init__(self, samples: Samples, unit: int) -> None:
        self.samples, self.unit = samples, unit
        self.place = {key: k for k, key in enumerate(self.keys(np.rint(samples.at * unit)))}

    @staticmethod
    def keys(at: Array) -> list[int]:
        """Return one number for each of the places (B, 2)."""
        whole = at.astype(np.int64)
        return (whole[:, 0] * 2**32 + whole[:, 1]).tolist()

    def index(self, at: Array) -> Array:
        """Return the samples at places (..., 2)."""
        found = [self.place[key] for key in self.keys(at.reshape(-1, 2))]
        return np.array(found, dtype=int).reshape(at.shape[:-1])

    def add(self, task: TileTask, model: GeneratedModel, at: Array, parents: list[Array]) -> None:
        """Solve the orbits at places `at` (B, 2) that are not known yet, each from the mean of its parents' orbits."""
        fresh: dict[int, tuple[Array, Array]] = {}
        for key, place, above in zip(self.keys(at), at, parents, strict=True):
            if key not in self.place:
                fresh.setdefault(key, (place, above))
        if not fresh:
            return
        old, places = self.samples, np.array([place for place, _ in fresh.values()]) / self.unit
        sources = [above for _, above in fresh.values()]
        p = task.grid.at(model, task.corner + places)
        x = np.stack([old.orbit.x[k].mean(axis=0) for k in sources])
        stages = np.stack([old.orbit.stages[k].mean(axis=0) for k in sources])
        batch = regular_orbits(model, p, Discretisation(x, stages, old.orbit.edges), task.settings.tol)
        for k in range(4):  # where the mean leads nowhere, each of the parents
            lost = np.array([b for b in np.nonzero(~batch.converged)[0] if k < len(sources[b])], dtype=int)
            if lost.size:
                near = old.orbit.part(np.array([sources[b][k] for b in lost]))
                batch.replace(lost, regular_orbits(model, p[:, lost], near, task.settings.tol))
        for key in fresh:
            self.place[key] = len(self.place)
        self.samples = Samples(
            np.concatenate([old.at, places]),
            np.concatenate([old.p, p], axis=1),
            join([old.orbit, batch.orbit]),
            np.concatenate([old.multipliers, batch.multipliers]),
        )


def refine(task: TileTask, model: GeneratedModel, samples: Samples) -> tuple[Samples, list[Cells], Array]:
    """Return the tile's points with those added, and all leaf cells: halved where a boundary could hide, `depth` times at most.

    The cells in which one still may (S, 3) follow: lower corner and size, in grid steps.
    """
    unit = 2**task.settings.depth
    points, leaves, suspect = _Points(samples, unit), list[Cells](), np.zeros((0, 3))
    cells = _grid_cells(task, samples, unit)
    while True:
        corners = points.index(cells.corners())
        wanted = suspects(points.samples.g[corners], cells.error)
        leaves.append(Cells(cells.at[~wanted], cells.size, cells.error[~wanted]))
        halved = Cells(cells.at[wanted], cells.size, cells.error[wanted])
        if not wanted.any():
            break
        if cells.size == 1:
            leaves.append(halved)
            suspect = np.concatenate([halved.at, np.ones((len(halved.at), 1))], axis=1) / unit
            break
        cells = _halved(task, model, points, halved, corners[wanted])
    return points.samples, leaves, suspect


def _grid_cells(task: TileTask, samples: Samples, unit: int) -> Cells:
    """Return the cells of the tile's grid, with the interpolation errors that second differences show."""
    nc, nr = task.shape
    g = samples.g[: nc * nr].reshape(nc, nr)
    error = SAFETY * (_interpolation_error(g, 0) + _interpolation_error(g, 1))
    around = np.stack([error[:-1, :-1], error[1:, :-1], error[:-1, 1:], error[1:, 1:]])
    at = np.stack(np.meshgrid(np.arange(nc - 1), np.arange(nr - 1), indexing="ij"), axis=-1).reshape(-1, 2)
    return Cells(at * unit, unit, around.max(axis=0).reshape(-1))


def _interpolation_error(g: Array, axis: int) -> Array:
    """Return an eighth of the second differences of `g` along `axis`, those of the ends from their neighbours."""
    if g.shape[axis] < 3:
        return np.zeros_like(g)
    moved = np.moveaxis(g, axis, 0)
    inner = np.abs(moved[:-2] - 2 * moved[1:-1] + moved[2:]) / 8
    inner = np.nan_to_num(inner)  # beside a point without an orbit nothing is known
    return np.moveaxis(np.concatenate([inner[:1], inner, inner[-1:]]), 0, axis)


def suspects(g: Array, error: Array) -> Array:
    """Return for cells with corner values `g` (C, 4) whether more could hide in them than their corners show."""
    usable = np.isfinite(g).all(axis=1)
    positive, size = g > 0, np.abs(np.where(np.isfinite(g), g, 0.0))
    same = positive.all(axis=1) | ~positive.any(axis=1)
    saddle = (positive[:, 0] == positive[:, 3]) & (positive[:, 1] == positive[:, 2]) & ~same
    hidden = same & (size.min(axis=1) < error)
    return usable & (hidden | saddle | (~same & (error > CROSSED * size.max(axis=1))))


def _halved(task: TileTask, model: GeneratedModel, points: _Points, cells: Cells, corners: Array) -> Cells:
    """Return the quarters of `cells`, their new corners solved."""
    half = cells.size // 2
    at = cells.at[:, None, :] + half * MIDDLES  # (C, 5, 2)
    parents = [corners[c][list(PARENTS[k])] for c in range(len(corners)) for k in range(5)]
    points.add(task, model, at.reshape(-1, 2), parents)
    g = points.samples.g
    middle, old = g[points.index(at)], g[corners]
    interpolated = np.stack([old[:, list(k)].mean(axis=1) for k in PARENTS], axis=1)
    off = np.nan_to_num(np.abs(middle - interpolated))
    sides = np.maximum(off[:, 0], off[:, 1]) + np.maximum(off[:, 2], off[:, 3])
    error = SAFETY * REFINED_SHARE * np.maximum(sides, off[:, 4])
    quarters = cells.at[:, None, :] + half * CORNERS
    return Cells(quarters.reshape(-1, 2), half, np.repeat(error, 4))


def solve_tile(task: TileTask) -> dict[str, Array]:
    """Return a tile as plain arrays; it depends on nothing but `task`.

    `leading` (columns, rows) is the leading multiplier, NaN where no orbit was found; `mesh` the intervals; `extra_at`
    the points added; `suspect` (S, 3) cells in which a boundary may still hide (column, row, size in grid
    steps). Every pair of neighbours of different sign is a seed: `seed_ends` (E, 2, 2) in grid steps, `seed_axis` (E,),
    `seed_g` (E, 2), and between them `seed_p` (n_parameters, E), `seed_rho`, `seed_x`, `seed_stages`. Every stable point beside
    one without an orbit, or with quite another, is a discontinuity: `discontinuity_ends` (K, 2, 2), it and that neighbour,
    `discontinuity_axis` (K,), and at it `discontinuity_rho`, `discontinuity_x`, `discontinuity_stages`.
    """
    model = tile_model(task.source, task.key)
    samples, leaves, suspect = refine(task, model, solve_block(task, model))
    count, corner = math.prod(task.shape), task.corner
    leading = upper_half(samples.multipliers[:, 0])
    names = task.grid.x.moved, task.grid.y.moved
    crossed, apart = _crossed(samples), _apart(samples, model, names)
    sides = _sides(samples, leaves, 2**task.settings.depth, lambda i, j: crossed(i, j) | apart(i, j))
    suspect[:, :2] += corner
    return {
        "leading": leading[:count].reshape(task.shape),
        "mesh": np.array(samples.orbit.intervals),
        "extra_at": samples.at[count:] + corner,
        "suspect": suspect,
        **_seeds(task, model, samples, sides[crossed(sides[:, 0], sides[:, 1])]),
        **_discontinuities(task, samples, sides[apart(sides[:, 0], sides[:, 1])]),
    }


def _crossed(samples: Samples) -> Between:
    """Return the test whether, of two samples, one is stable and the other is not."""
    g = samples.g
    return lambda i, j: np.asarray(np.isfinite(g[i]) & np.isfinite(g[j]) & ((g[i] > 0) != (g[j] > 0)))


def _apart(samples: Samples, model: GeneratedModel, names: tuple[str, str]) -> Between:
    """Return the test whether, of two samples, one is stable and the state of the other may not be the same."""
    g, logs = samples.g, np.array(model.logarithmic)
    start = samples.orbit.x[:, 0][:, logs]
    saddle = (g > 0) & (np.abs(np.angle(samples.multipliers[:, 0])) < 1e-7)

    def apart(i: Array, j: Array) -> Array:
        one = np.fmin(g[i], g[j]) < 0
        found = one & (np.isnan(g[i]) | np.isnan(g[j]) | saddle[i] | saddle[j])
        far = np.nonzero((g[i] < 0) & (g[j] < 0) & (np.abs(start[i] - start[j]).max(axis=-1) > STATE_JUMP))[0]
        if far.size:
            found[far] = _unlike(model, samples, names, i[far], j[far])
        return np.asarray(found)

    return apart


def _unlike(model: GeneratedModel, samples: Samples, names: tuple[str, str], i: Array, j: Array) -> Array:
    """Return whether the states of samples i (E,) and j (E,) differ by more than their tangents along `names` explain.

    The change between neighbours on one branch is the mean of the tangents times the step, up to its third power.
    """
    n, logs = samples.orbit.x.shape[-1], np.array(model.logarithmic)
    every, place = np.unique(np.concatenate([i, j]), return_inverse=True)
    slopes = np.full((len(every), n, len(names)), np.nan)
    for a in range(0, len(every), CHUNK):
        part = every[a : a + CHUNK]
        end = periodic_map(model, samples.p[:, part], samples.orbit.part(part), names)
        slopes[a : a + CHUNK] = np.linalg.solve(-end[..., :n], end[..., n + 1 :])
    rows = [model.index(name) for name in names]
    step = (samples.p[rows][:, j] - samples.p[rows][:, i]).T
    told = 0.5 * ((slopes[place[: len(i)]] + slopes[place[len(i) :]]) @ step[..., None])[..., 0]
    change = samples.orbit.x[j, 0] - samples.orbit.x[i, 0]
    return np.asarray(~(np.abs(change - told)[:, logs].max(axis=-1) < LEFT))


def _seeds(task: TileTask, model: GeneratedModel, samples: Samples, sides: Array) -> dict[str, Array]:
    """Return the sign changes on `sides` (E, 3), with an orbit and a multiplier between the two ends of each."""
    g, (i, j, axis) = samples.g, sides.T
    share = g[i] / np.where(g[i] == g[j], 1.0, g[i] - g[j])
    nearer = np.where(share < 0.5, i, j)
    orbit = (1 - share) * samples.orbit.part(i) + share * samples.orbit.part(j)
    at = (1 - share)[:, None] * samples.at[i] + share[:, None] * samples.at[j]
    return {
        "seed_ends": np.stack([samples.at[i], samples.at[j]], axis=1) + task.corner,
        "seed_axis": axis,
        "seed_g": np.stack([g[i], g[j]], axis=1),
        "seed_p": task.grid.at(model, task.corner + at),
        "seed_rho": upper_half(samples.multipliers[nearer, 0]),
        "seed_x": orbit.x,
        "seed_stages": orbit.stages,
    }


def _discontinuities(task: TileTask, samples: Samples, sides: Array) -> dict[str, Array]:
    """Return the stable ends of `sides` (E, 3), whose state may end before it reaches the other end, with that end."""
    both = np.concatenate([sides, sides[:, [1, 0, 2]]])
    i, j, axis = both[samples.g[both[:, 0]] < 0].T
    return {
        "discontinuity_ends": np.stack([samples.at[i], samples.at[j]], axis=1) + task.corner,
        "discontinuity_axis": axis,
        "discontinuity_rho": upper_half(samples.multipliers[i, 0]),
        "discontinuity_x": samples.orbit.x[i],
        "discontinuity_stages": samples.orbit.stages[i],
    }


def _sides(samples: Samples, leaves: Sequence[Cells], unit: int, wanted: Between) -> Array:
    """Return the `wanted` sides of leaf cells, (E, 3) in order: the samples at their two ends, and the axis they lie along."""
    points = _Points(samples, unit)
    sides: dict[tuple[int, int], int] = {}
    for cells in leaves:
        corners = points.index(cells.corners())
        for a, b, axis in SIDES:
            i, j = corners[:, a], corners[:, b]
            here = np.nonzero(wanted(i, j))[0]
            middle = cells.corners()[here, a] + np.eye(2, dtype=int)[axis] * (cells.size // 2)
            for k, key in zip(here, points.keys(middle), strict=True):
                if cells.size == 1 or key not in points.place:  # a finer cell next to it has the two halves
                    sides[int(i[k]), int(j[k])] = axis
    return np.array([(i, j, axis) for (i, j), axis in sorted(sides.items())], dtype=int).reshape(-1, 3)
