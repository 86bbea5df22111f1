"""Stability maps: the leading Floquet multiplier over a grid of two parameters, put together from its tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array, ComplexArray, Discretisation
from srfcli.numerics.mapgrid import MapGrid, MapSettings, TileTask, tile_tasks
from srfcli.numerics.maprefine import solve_tile
from srfcli.numerics.orbitkernel import kernel

# of a point: no orbit found; stable; unstable by a multiplier off the real axis, a negative, a positive one
KINDS = ("unresolved", "stable", "ns", "pd", "fold")
REAL = 1e-7  # a multiplier whose angle is nearer to 0 or pi is real

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
class Brink:
    """A stable point, `ends[0]` in unit coordinates of the plane, whose state may end on the way to its neighbour `ends[1]`.

    At the neighbour no orbit was found, or quite another.
    """

    ends: Array
    axis: int
    rho: complex
    orbit: Discretisation


@dataclass
class StabilityMap:
    """A map: `leading` (nx, ny), the leading multiplier, NaN where no orbit was found; `mesh` (nx, ny) intervals.

    `extra_at` (E, 2), in grid steps, and `extra_leading` (E,) are points added in cells where a boundary could hide; `suspect`
    (S, 3) are cells (column, row, size in grid steps) in which one still could.
    """

    grid: MapGrid
    settings: MapSettings
    leading: ComplexArray
    mesh: Array
    extra_at: Array
    extra_leading: ComplexArray
    suspect: Array
    seeds: list[Seed]
    brinks: list[Brink] = field(default_factory=list)
    finished: bool = True

    @property
    def growth(self) -> Array:
        """Return ln |leading multiplier| over one forcing period, (nx, ny)."""
        return log_modulus(self.leading)

    @property
    def kind(self) -> Array:
        """Return the index in KINDS of each point, (nx, ny)."""
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
    """Return the index in KINDS of points with these leading multipliers."""
    with np.errstate(invalid="ignore"):
        angle = np.abs(np.angle(leading))
        unstable = np.where(angle < REAL, 4, np.where(angle > np.pi - REAL, 3, 2))
        return np.where(~np.isfinite(leading), 0, np.where(np.abs(leading) < 1, 1, unstable))


def log_modulus(leading: ComplexArray) -> Array:
    """Return ln |rho|; a multiplier that underflowed is as small as a number can be."""
    return np.log(np.maximum(np.abs(leading), 1e-300))


def per_slip(model: GeneratedModel, p: Array) -> Array:
    """Return what turns an exponent per forcing period into one per slip distance D0/V, (...,) for `p` (n_parameters, ...).

    Where the law has no D0 it is the forcing frequency: exponents are then per second.
    """
    rate = p[model.index("f")]
    return np.asarray(rate * p[model.index("D0")] / p[model.index("V")] if "D0" in model.names else rate)


def serial(function: Callable[[TileTask], Tile], tasks: Sequence[TileTask]) -> Iterator[tuple[int, Tile]]:
    """Yield the result of every task in this process, one after the other."""
    for index, task in enumerate(tasks):
        yield index, function(task)


def compute_map(
    model: GeneratedModel,
    grid: MapGrid,
    settings: MapSettings | None = None,
    *,
    run: Runner = serial,
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
    brinks: list[Brink] = []
    for task, tile in tiles:
        place = (slice(task.columns[0], task.columns[1] + 1), slice(task.rows[0], task.rows[1] + 1))
        leading[place], mesh[place] = tile["leading"], int(tile["mesh"])
        seeds += _seeds(model, grid, tile)
        brinks += _brinks(model, grid, tile)
        covered += (task.columns[1] - task.columns[0]) * (task.rows[1] - task.rows[0])
    extra_at = np.concatenate([t["extra_at"] for _, t in tiles])
    _, first = np.unique(extra_at, axis=0, return_index=True)  # tiles that meet refine their common side alike
    return StabilityMap(
        grid,
        settings,
        leading,
        mesh,
        extra_at[first],
        np.concatenate([t["extra_leading"] for _, t in tiles])[first],
        np.concatenate([t["suspect"] for _, t in tiles]),
        seeds,
        brinks,
        covered == (shape[0] - 1) * (shape[1] - 1),
    )


def _brinks(model: GeneratedModel, grid: MapGrid, tile: Tile) -> list[Brink]:
    """Return the brinks of a tile, in the plane's unit coordinates."""
    ends = tile["brink_ends"]
    if not len(ends):
        return []
    unit = grid.plane(model).coordinates(model, grid.points(model, *_quantities(grid, ends)))
    edges = np.linspace(0.0, 1.0, int(tile["mesh"]) + 1)
    return [
        Brink(
            unit[k],
            int(axis),
            complex(tile["brink_rho"][k]),
            Discretisation(tile["brink_x"][k], tile["brink_stages"][k], edges),
        )
        for k, axis in enumerate(tile["brink_axis"])
    ]


def _quantities(grid: MapGrid, places: Array) -> tuple[Array, Array]:
    """Return the quantities along x and y at places (..., 2) in grid steps."""
    return grid.x.between(places[..., 0]), grid.y.between(places[..., 1])


def _seeds(model: GeneratedModel, grid: MapGrid, tile: Tile) -> list[Seed]:
    """Return the seeds of a tile, in the plane's unit coordinates."""
    plane, ends = grid.plane(model), tile["seed_ends"]
    if not len(ends):
        return []
    unit = plane.coordinates(model, grid.points(model, *_quantities(grid, ends)))  # (E, 2, 2)
    edges = np.linspace(0.0, 1.0, int(tile["mesh"]) + 1)
    seeds = []
    for k, axis in enumerate(tile["seed_axis"].tolist()):
        order = np.argsort(unit[k, :, axis])
        g = tile["seed_g"][k][order]
        orbit = Discretisation(tile["seed_x"][k : k + 1], tile["seed_stages"][k : k + 1], edges)
        p, rho = tile["seed_p"][:, k], complex(tile["seed_rho"][k])
        seeds.append(Seed(unit[k][order], axis, bool(g[0] <= g[1]), p, rho, orbit))
    return seeds
