"""Cells of a map tile halved where a boundary could hide in them, and every sign change that the points then show.

In a cell whose corners agree in sign a boundary can hide only where g comes within its interpolation error of zero. That error is
taken from second differences of the grid, and in a cell that was halved from how far its new points lie off the mean of the old.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array, Discretisation, join
from srfcli.numerics.mapgrid import TileTask
from srfcli.numerics.maptile import Samples, regular_orbits, solve_block, tile_points

SAFETY = 1.5  # on an interpolation error, which is itself an estimate
SHRINKS = 0.5  # of a cell's error that its quarters keep: 0.25 where g is smooth, more where multipliers meet
CROSSED = 0.5  # a cell that a boundary crosses is halved, too, where its error exceeds this share of the largest |g|
JUMP = 0.5  # of a state's logarithms between neighbours: it may be another state then

# in units of half a cell: its middle and the middles of its sides, and the corners whose mean foretells each
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


@dataclass
class Refined:
    """The points of a tile with those added, all leaf cells, and the cells in which a boundary may still hide."""

    samples: Samples
    leaves: list[Cells] = field(default_factory=list)
    suspect: Array = field(default_factory=lambda: np.zeros((0, 3)))  # lower corner and size, in grid steps


class _Points:
    """Samples found by their place; places are whole numbers of finest steps."""

    def __init__(self, samples: Samples, unit: int) -> None:
        self.samples, self.unit = samples, unit
        self.place = {(int(a), int(b)): k for k, (a, b) in enumerate(np.rint(samples.at * unit))}

    def index(self, at: Array) -> Array:
        """Return the samples at places (..., 2)."""
        flat = [self.place[int(a), int(b)] for a, b in at.reshape(-1, 2)]
        return np.array(flat, dtype=int).reshape(at.shape[:-1])

    def add(self, task: TileTask, model: GeneratedModel, at: Array, parents: list[Array]) -> None:
        """Solve the orbits at places `at` (B, 2) that are not known yet, each from the mean of its parents' orbits."""
        fresh: dict[tuple[int, int], Array] = {}
        for (a, b), above in zip(at.tolist(), parents, strict=True):
            if (a, b) not in self.place:
                fresh.setdefault((a, b), above)
        if not fresh:
            return
        old, places = self.samples, np.array(list(fresh)) / self.unit
        xs, ys = _quantities(task, places)
        p = task.grid.points(model, xs, ys)
        x = np.stack([old.orbit.x[k].mean(axis=0) for k in fresh.values()])
        stages = np.stack([old.orbit.stages[k].mean(axis=0) for k in fresh.values()])
        batch = regular_orbits(model, p, Discretisation(x, stages, old.orbit.edges), task.settings.tol)
        sources = list(fresh.values())
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


def _quantities(task: TileTask, at: Array) -> tuple[Array, Array]:
    """Return the quantities along x and y at places (B, 2), in grid steps from the tile's corner."""
    grid = task.grid
    return grid.x.between(task.columns[0] + at[:, 0]), grid.y.between(task.rows[0] + at[:, 1])


def refine(task: TileTask, samples: Samples) -> Refined:
    """Return the tile with its cells halved, up to the settings' depth, where a boundary could hide in them."""
    model = tile_points(task)[0]
    unit = 2**task.settings.depth
    points, result = _Points(samples, unit), Refined(samples)
    cells = _grid_cells(task, samples, unit)
    while True:
        corners = points.index(cells.corners())
        wanted = _suspects(points.samples.g[corners], cells.error)
        result.leaves.append(Cells(cells.at[~wanted], cells.size, cells.error[~wanted]))
        if not wanted.any():
            break
        if cells.size == 1:
            last = cells.at[wanted]
            result.leaves.append(Cells(last, 1, cells.error[wanted]))
            result.suspect = np.concatenate([last, np.ones((len(last), 1))], axis=1) / unit
            break
        cells = _halved(task, model, points, Cells(cells.at[wanted], cells.size, cells.error[wanted]), corners[wanted])
    result.samples = points.samples
    return result


def _grid_cells(task: TileTask, samples: Samples, unit: int) -> Cells:
    """Return the cells of the tile's grid, with the interpolation errors that second differences show."""
    nc, nr = task.columns[1] - task.columns[0] + 1, task.rows[1] - task.rows[0] + 1
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


def _suspects(g: Array, error: Array) -> Array:
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
    foretold = np.stack([old[:, list(k)].mean(axis=1) for k in PARENTS], axis=1)
    off = np.nan_to_num(np.abs(middle - foretold))
    sides = np.maximum(off[:, 0], off[:, 1]) + np.maximum(off[:, 2], off[:, 3])
    error = SAFETY * SHRINKS * np.maximum(sides, off[:, 4])
    quarters = cells.at[:, None, :] + half * CORNERS
    return Cells(quarters.reshape(-1, 2), half, np.repeat(error, 4))


def solve_tile(task: TileTask) -> dict[str, Array]:
    """Return a tile as plain arrays; it depends on nothing but `task`.

    `leading` (columns, rows) is the leading multiplier, NaN where no orbit was found; `mesh` the intervals; `extra_p` and
    `extra_leading` the points added; `suspect` (S, 3) cells in which a boundary may still hide (column, row, size in grid
    steps). Every pair of neighbours of different sign is a seed: `seed_ends` (E, 2, 2) in grid steps, `seed_axis` (E,),
    `seed_g` (E, 2), and between them `seed_p` (n_parameters, E), `seed_rho`, `seed_x`, `seed_stages`. Every stable point beside
    one without an orbit, or with quite another, is a brink: `brink_ends` (K, 2, 2), it and that neighbour, `brink_axis` (K,), and
    at it `brink_rho`, `brink_x`, `brink_stages`.
    """
    done = refine(task, solve_block(task))
    samples = done.samples
    nc, nr = task.columns[1] - task.columns[0] + 1, task.rows[1] - task.rows[0] + 1
    count, corner = nc * nr, np.array([task.columns[0], task.rows[0]])
    leading = _upper(samples.multipliers[:, 0])
    crossed, apart = _crossed(samples), _apart(samples, tile_points(task)[0].logarithmic)
    sides = _sides(done, 2**task.settings.depth, lambda i, j: crossed(i, j) | apart(i, j))
    suspect = done.suspect.copy()
    suspect[:, :2] += corner
    return {
        "leading": leading[:count].reshape(nc, nr),
        "mesh": np.array(len(samples.orbit.edges) - 1),
        "extra_at": samples.at[count:] + corner,
        "extra_leading": leading[count:],
        "suspect": suspect,
        **_seeds(task, samples, sides[crossed(sides[:, 0], sides[:, 1])], corner),
        **_brinks(samples, sides[apart(sides[:, 0], sides[:, 1])], corner),
    }


def _crossed(samples: Samples) -> Between:
    """Return the test whether, of two samples, one is stable and the other is not."""
    g = samples.g
    return lambda i, j: np.asarray(np.isfinite(g[i]) & np.isfinite(g[j]) & ((g[i] > 0) != (g[j] > 0)))


def _apart(samples: Samples, logarithmic: Sequence[bool]) -> Between:
    """Return the test whether, of two samples, one is stable and the state of the other may not be the same."""
    g, start = samples.g, samples.orbit.x[:, 0][:, np.array(logarithmic)]
    saddle = (g > 0) & (np.abs(np.angle(samples.multipliers[:, 0])) < 1e-7)

    def apart(i: Array, j: Array) -> Array:
        far = np.abs(start[i] - start[j]).max(axis=-1) > JUMP
        stable, one = (g[i] < 0) & (g[j] < 0), np.fmin(g[i], g[j]) < 0
        return np.asarray((stable & far) | (one & (np.isnan(g[i]) | np.isnan(g[j]) | saddle[i] | saddle[j])))

    return apart


def _upper(rho: Array) -> Array:
    """Return multipliers with those below the real axis replaced by their conjugates."""
    return rho.real + 1j * np.abs(rho.imag)


def _seeds(task: TileTask, samples: Samples, sides: Array, corner: Array) -> dict[str, Array]:
    """Return the sign changes on `sides` (E, 3), with an orbit and a multiplier between the two ends of each."""
    g, (i, j, axis) = samples.g, sides.T
    share = g[i] / np.where(g[i] == g[j], 1.0, g[i] - g[j])
    nearer = np.where(share < 0.5, i, j)
    blend, orbit = share[:, None, None], samples.orbit
    at = (1 - share)[:, None] * samples.at[i] + share[:, None] * samples.at[j]
    model = tile_points(task)[0]
    return {
        "seed_ends": np.stack([samples.at[i], samples.at[j]], axis=1) + corner,
        "seed_axis": axis,
        "seed_g": np.stack([g[i], g[j]], axis=1),
        "seed_p": task.grid.points(model, *_quantities(task, at)),
        "seed_rho": _upper(samples.multipliers[nearer, 0]),
        "seed_x": (1 - blend) * orbit.x[i] + blend * orbit.x[j],
        "seed_stages": (1 - blend[..., None]) * orbit.stages[i] + blend[..., None] * orbit.stages[j],
    }


def _brinks(samples: Samples, sides: Array, corner: Array) -> dict[str, Array]:
    """Return the stable ends of `sides` (E, 3), whose state may end before it reaches the other end, with that end."""
    both = np.concatenate([sides, sides[:, [1, 0, 2]]])
    i, j, axis = both[samples.g[both[:, 0]] < 0].T
    return {
        "brink_ends": np.stack([samples.at[i], samples.at[j]], axis=1) + corner,
        "brink_axis": axis,
        "brink_rho": _upper(samples.multipliers[i, 0]),
        "brink_x": samples.orbit.x[i],
        "brink_stages": samples.orbit.stages[i],
    }


def _sides(done: Refined, unit: int, wanted: Between) -> Array:
    """Return the `wanted` sides of leaf cells, (E, 3) in order: the samples at their two ends, and the axis they lie along."""
    points = _Points(done.samples, unit)
    sides: dict[tuple[int, int], int] = {}
    for cells in done.leaves:
        corners = points.index(cells.corners())
        for a, b, axis in SIDES:
            i, j = corners[:, a], corners[:, b]
            middle = cells.corners()[:, a] + np.eye(2, dtype=int)[axis] * (cells.size // 2)
            for k in np.nonzero(wanted(i, j))[0]:
                split = cells.size > 1 and (int(middle[k, 0]), int(middle[k, 1])) in points.place
                if not split:  # a finer cell next to it has the two halves
                    sides[int(i[k]), int(j[k])] = axis
    return np.array([(i, j, axis) for (i, j), axis in sorted(sides.items())], dtype=int).reshape(-1, 3)
