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
from srfcli.numerics.integrate import simulate
from srfcli.numerics.load import Modulation
from srfcli.numerics.mapgrid import TileTask
from srfcli.numerics.orbit import OrbitBatch, interpolate, ordered_eigenvalues, solve_orbits, uniform_mesh
from srfcli.numerics.program import Drive
from srfcli.numerics.scan import robust_orbits

STRIDE = 8  # orbits solved without neighbours are this many rows and columns apart
NEIGHBOURS = 6  # through which a first guess is interpolated
GRAIN = 4  # meshes are multiples of this many intervals
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))  # to the points beside a point, in columns and rows
SETTLING = 1000  # periods of a simulation: just beyond a fold the motion lingers
SETTLINGS = 32  # simulations at most in a tile,
IN_VAIN = 3  # and in a row without a periodic state
GOLDEN = 0.6180339887  # a share by whose multiples a list is sampled evenly
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
    block.put(columns[0], rows[0], regular(start))
    for level in range(1, len(rows)):
        known, new = np.concatenate(rows[:level]), rows[level]
        block.fill(columns[0], new, block.along_rows(columns[0], known, new), settings.tol)
    every = np.arange(shape[1])
    for level in range(1, len(columns)):
        known, new = np.concatenate(columns[:level]), columns[level]
        block.fill(new, every, block.along_columns(known, new), settings.tol)
    block.spread(settings.tol)
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
        self.put(columns, rows, regular_orbits(self.model, p, guess, tol))

    def spread(self, tol: float) -> None:
        """Solve the orbits that were not found from those beside them, again and again until none is added.

        Steps from point to point lead round a cusp to a state that grows out of nothing else nearby. Where they lead nowhere,
        orbits are looked for anew, and the motion is simulated at a few points until it may have settled.
        """
        self._spread(self.converged.copy(), tol)
        if not self.converged.all():
            self._spread(self._robust(tol), tol)
        in_vain = 0
        for attempt in range(SETTLINGS):
            if self.converged.all() or in_vain == IN_VAIN:
                return
            fresh = self._settled(attempt * GOLDEN % 1, tol)
            in_vain = 0 if fresh.any() else in_vain + 1
            self._spread(fresh, tol)

    def _robust(self, tol: float) -> Array:
        """Look for the missing orbits without a guess, and mark those that are found."""
        found = ~self.converged
        c, r = np.nonzero(found)
        self._keep(c, r, regular(robust_orbits(self.model, self.p[:, c, r], None, self.edges, tol=tol)))
        return found & self.converged

    def _settled(self, share: float, tol: float) -> Array:
        """Mark the point, if any, at which a simulation ends in a periodic state; it begins with the state of one beside it.

        Of all such points that is tried which lies a share of the way through their list.
        """
        found = np.zeros_like(self.converged)
        brinks = [
            (c, r, c - dc, r - dr)
            for dc, dr in STEPS
            for c, r in np.argwhere(_moved(self.converged, dc, dr) & ~self.converged).tolist()
        ]
        if brinks:
            c, r, from_c, from_r = brinks[int(share * len(brinks))]
            guess = settle(self.model, self.p[:, c, r], self.x[from_c, from_r, 0], self.edges)
            if guess is not None:
                self._solve(np.array([c]), np.array([r]), guess, tol)
                found[c, r] = self.converged[c, r]
        return found

    def _spread(self, fresh: Array, tol: float) -> None:
        """Solve the points beside `fresh` ones from these, and so on."""
        while fresh.any() and not self.converged.all():
            added = np.zeros_like(fresh)
            for dc, dr in STEPS:
                to_c, to_r = np.nonzero(_moved(fresh, dc, dr) & ~self.converged)
                if not to_c.size:
                    continue
                from_c, from_r = to_c - dc, to_r - dr
                guess = Discretisation(self.x[from_c, from_r], self.stages[from_c, from_r], self.edges)
                self._solve(to_c, to_r, guess, tol)
                added[to_c, to_r] = self.converged[to_c, to_r]
            fresh = added

    def _solve(self, c: Array, r: Array, guess: Discretisation, tol: float) -> None:
        """Solve the orbits at columns `c`, rows `r` from `guess`, and keep those that are found."""
        self._keep(c, r, regular_orbits(self.model, self.p[:, c, r], guess, tol))

    def _keep(self, c: Array, r: Array, batch: OrbitBatch) -> None:
        """Store those of a batch that were found, at columns `c`, rows `r`."""
        good = np.nonzero(batch.converged)[0]
        place = c[good], r[good]
        self.x[place], self.stages[place] = batch.orbit.x[good], batch.orbit.stages[good]
        self.monodromy[place], self.converged[place] = batch.monodromy[good], True


def settle(model: GeneratedModel, p: Array, start: Array, edges: Array) -> Discretisation | None:
    """Return the last of SETTLING periods of the motion that begins in the state `start` (n,), or None where it stops early."""
    V, W0, eps, f = (float(p[model.index(name)]) for name in ("V", "W0", "eps", "f"))
    blank = np.zeros((len(edges) - 1, STAGES, len(start)))
    last = Discretisation(blank[:, 0], blank, edges)
    tau = np.concatenate([edges[:-1, None], last.phases], axis=1)
    t = np.concatenate([[0.0], (SETTLING + tau.reshape(-1)) / f])
    trace = simulate(model, p, drive=Drive.constant(V), load=Modulation(W0, eps, f), t=t, start=start, rtol=1e-6)
    if not trace.status.ok:
        return None
    x = trace.x[1:].reshape(len(edges) - 1, STAGES + 1, -1)
    return Discretisation(x[None, :, 0], x[None, :, 1:], edges)


def _moved(marks: Array, dc: int, dr: int) -> Array:
    """Return the marks (columns, rows) moved by dc columns and dr rows, those beyond the edge dropped."""
    moved = np.zeros_like(marks)
    c, r = marks.shape
    moved[max(dc, 0) : c + min(dc, 0), max(dr, 0) : r + min(dr, 0)] = marks[
        max(-dc, 0) : c + min(-dc, 0), max(-dr, 0) : r + min(-dr, 0)
    ]
    return moved


def regular_orbits(model: GeneratedModel, p: Array, guess: Discretisation, tol: float) -> OrbitBatch:
    """Return the orbits at `p` from `guess`, those beyond a fold marked as not found."""
    return regular(solve_orbits(model, p, guess, tol=tol, max_iterations=PATIENCE))


def regular(batch: OrbitBatch) -> OrbitBatch:
    """Return `batch` with the orbits beyond a fold marked as not found.

    An odd number of multipliers beyond +1, det(1 - M) < 0, is that of a state that meets the sliding state in a fold.
    """
    M = batch.monodromy[batch.converged]
    batch.converged[batch.converged] = np.linalg.det(np.eye(M.shape[-1]) - M) > 0
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
