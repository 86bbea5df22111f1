"""One tile of a stability map: orbits on a coarse grid, the others from their neighbours, cells refined where it matters.

Newton's method starts from the polynomial through up to six neighbours along a row or column of the grid: most orbits then need
a single linearisation, whose product of maps is the monodromy matrix that is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from srfcli.model import GeneratedModel, load_source
from srfcli.numerics.collocation import STAGES, Array, ComplexArray, Discretisation, mesh_error
from srfcli.numerics.mapgrid import TileTask
from srfcli.numerics.orbit import OrbitBatch, interpolate, ordered_eigenvalues, solve_orbits, uniform_mesh
from srfcli.numerics.scan import robust_orbits

STRIDE = 8  # orbits solved without neighbours are this many rows and columns apart
NEIGHBOURS = 6  # through which a first guess is interpolated
GRAIN = 4  # meshes are multiples of this many intervals
PATIENCE = 8  # Newton steps from a neighbour's guess before an orbit is looked for anew


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


def tile_points(task: TileTask) -> tuple[GeneratedModel, Array, Array, Array]:
    """Return the model, the quantities along x and y of the tile, and its parameters (n_parameters, columns, rows)."""
    model, grid = tile_model(task.source, task.key), task.grid
    xs = grid.x.samples()[task.columns[0] : task.columns[1] + 1]
    ys = grid.y.samples()[task.rows[0] : task.rows[1] + 1]
    return model, xs, ys, grid.points(model, *np.meshgrid(xs, ys, indexing="ij"))


def solve_block(task: TileTask) -> Samples:
    """Return the orbits at all grid points of a tile, columns first."""
    model, xs, ys, p = tile_points(task)
    shape, settings = (len(xs), len(ys)), task.settings
    columns, rows = (_levels(count) for count in shape)
    first = np.ix_(columns[0], rows[0])
    start = _coarse(model, p[:, first[0], first[1]].reshape(len(p), -1), task)
    block = _Block.empty(model, p, start.orbit.edges)
    block.put(columns[0], rows[0], start)
    for level in range(1, len(rows)):
        known, new = np.concatenate(rows[:level]), rows[level]
        block.fill(columns[0], new, block.along_rows(columns[0], known, new), settings.tol)
    every = np.arange(shape[1])
    for level in range(1, len(columns)):
        known, new = np.concatenate(columns[:level]), columns[level]
        block.fill(new, every, block.along_columns(known, new), settings.tol)
    at = np.stack(np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij"), axis=-1).reshape(-1, 2)
    flat = Discretisation(
        block.x.reshape(-1, *block.x.shape[2:]), block.stages.reshape(-1, *block.stages.shape[2:]), block.edges
    )
    count = shape[0] * shape[1]
    n = len(model.states)
    multipliers = ordered_eigenvalues(block.monodromy.reshape(count, n, n), block.converged.reshape(count))
    return Samples(at.astype(float), p.reshape(len(p), -1), flat, multipliers)


def _levels(count: int) -> list[Array]:
    """Return indices 0..count-1 in the order in which they are filled: every STRIDE-th with the last, halved until all."""
    seen = np.zeros(count, bool)
    levels, stride = [], STRIDE
    while stride >= 1:
        wanted = np.zeros(count, bool)
        wanted[::stride] = wanted[-1] = True
        levels.append(np.nonzero(wanted & ~seen)[0])
        seen |= wanted
        stride //= 2
    return [level for level in levels if level.size]


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
    N = len(batch.orbit.edges) - 1
    if not batch.converged.all():  # a finer mesh may find what this one could not
        return min(2 * N, task.settings.finest)
    ratio = float(mesh_error(model, batch.orbit).max()) / task.settings.mesh_error
    if not ratio > 1:
        return N
    return min(GRAIN * int(np.ceil(N * min(1.3 * ratio, 1e4) ** 0.125 / GRAIN)), task.settings.finest)  # error as N^-8


@dataclass
class _Block:
    """The orbits of a tile while it fills: arrays with the axes columns, rows, then those of Discretisation."""

    model: GeneratedModel
    p: Array
    x: Array
    stages: Array
    monodromy: Array
    converged: Array
    edges: Array

    @staticmethod
    def empty(model: GeneratedModel, p: Array, edges: Array) -> _Block:
        """Return a block of NaN for the parameters `p` (n_parameters, columns, rows)."""
        shape, n, N = p.shape[1:], len(model.states), len(edges) - 1
        return _Block(
            model,
            p,
            np.full((*shape, N, n), np.nan),
            np.full((*shape, N, STAGES, n), np.nan),
            np.full((*shape, n, n), np.nan),
            np.zeros(shape, bool),
            edges,
        )

    def put(self, columns: Array, rows: Array, batch: OrbitBatch) -> None:
        """Store a batch at the crossings of `columns` and `rows`."""
        place, shape = np.ix_(columns, rows), (len(columns), len(rows))
        self.x[place] = batch.orbit.x.reshape(*shape, *self.x.shape[2:])
        self.stages[place] = batch.orbit.stages.reshape(*shape, *self.stages.shape[2:])
        self.monodromy[place] = batch.monodromy.reshape(*shape, *self.monodromy.shape[2:])
        self.converged[place] = batch.converged.reshape(shape)

    def along_rows(self, columns: Array, known: Array, new: Array) -> Discretisation:
        """Return guesses at rows `new` of `columns` from the rows `known`."""
        index, weights = neighbours(np.sort(known), new)
        x = np.einsum("rk,crkNn->crNn", weights, self.x[columns[:, None, None], index[None]])
        stages = np.einsum("rk,crkNmn->crNmn", weights, self.stages[columns[:, None, None], index[None]])
        return Discretisation(x.reshape(-1, *x.shape[2:]), stages.reshape(-1, *stages.shape[2:]), self.edges)

    def along_columns(self, known: Array, new: Array) -> Discretisation:
        """Return guesses at all rows of columns `new` from the columns `known`."""
        index, weights = neighbours(np.sort(known), new)
        x = np.einsum("ck,ckrNn->crNn", weights, self.x[index])
        stages = np.einsum("ck,ckrNmn->crNmn", weights, self.stages[index])
        return Discretisation(x.reshape(-1, *x.shape[2:]), stages.reshape(-1, *stages.shape[2:]), self.edges)

    def fill(self, columns: Array, rows: Array, guess: Discretisation, tol: float) -> None:
        """Solve the orbits at the crossings of `columns` and `rows` from `guess`, and store them."""
        p = self.p[:, columns[:, None], rows[None]].reshape(len(self.p), -1)
        self.put(columns, rows, guided_orbits(self.model, p, guess, tol))


def guided_orbits(model: GeneratedModel, p: Array, guess: Discretisation, tol: float) -> OrbitBatch:
    """Return the orbits at `p` from `guess`, those that it does not lead to looked for without it."""
    batch = solve_orbits(model, p, guess, tol=tol, max_iterations=PATIENCE)
    lost = np.nonzero(~batch.converged)[0]
    if lost.size:
        again = robust_orbits(model, p[:, lost], None, guess.edges, tol=tol)
        batch.orbit.x[lost], batch.orbit.stages[lost] = again.orbit.x, again.orbit.stages
        batch.monodromy[lost], batch.converged[lost] = again.monodromy, again.converged
    return batch


def neighbours(known: Array, new: Array) -> tuple[Array, Array]:
    """Return, for each position `new`, up to NEIGHBOURS of the rising positions `known` around it and their Lagrange weights."""
    width = min(NEIGHBOURS, len(known))
    first = np.clip(np.searchsorted(known, new) - width // 2, 0, len(known) - width)
    index = known[first[:, None] + np.arange(width)]  # (new, width)
    weights = np.ones(index.shape)
    for i in range(width):
        for j in range(width):
            if j != i:
                weights[:, i] *= (new - index[:, j]) / (index[:, i] - index[:, j])
    return index, weights
