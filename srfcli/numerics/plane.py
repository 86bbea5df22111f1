"""A window in the plane of two parameters, its unit square, and the grid of a stability map on it.

A tile is a block of grid points that is computed by itself, so that neither the number of workers nor their order matters.
Tiles share their last row and column with the next one: every cell belongs to one tile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError

INSIDE = 1 - 1e-9  # of the window: its far edge as seen from within


@dataclass(frozen=True)
class Axis:
    """A parameter from `lo` to `hi` (um, s, N), on a logarithmic scale where `log`."""

    name: str
    lo: float
    hi: float
    log: bool = True

    @property
    def span(self) -> float:
        """Return the length of the axis, in ln(value) where logarithmic."""
        return float(np.log(self.hi / self.lo)) if self.log else self.hi - self.lo

    def unit(self, value: Array | Sequence[float] | float) -> Array:
        """Return `value` as a coordinate that is 0 at `lo` and 1 at `hi`."""
        value = np.asarray(value)
        return np.asarray(np.log(value / self.lo) / self.span if self.log else (value - self.lo) / self.span)

    def value(self, unit: Array | Sequence[float] | float) -> Array:
        """Return the parameter at a unit coordinate."""
        unit = np.asarray(unit)
        inside = self.lo * np.exp(unit * self.span) if self.log else self.lo + unit * self.span
        return np.where(unit == 1.0, self.hi, inside)  # the window's edge exactly

    def samples(self, count: int) -> Array:
        """Return `count` values, evenly spaced on the axis' scale, both ends among them."""
        return self.value(np.linspace(0.0, 1.0, count))


@dataclass(frozen=True)
class Plane:
    """Two axes and the fixed parameters `base` (n_parameters,); stability is followed across y along x."""

    base: Array
    x: Axis
    y: Axis

    @property
    def names(self) -> tuple[str, str]:
        """Return the names of the two parameters."""
        return self.x.name, self.y.name

    def coordinates(self, model: GeneratedModel, p: Array) -> Array:
        """Return the unit coordinates (..., 2) of parameter points `p` (n_parameters, ...)."""
        return np.stack([a.unit(p[model.index(a.name)]) for a in (self.x, self.y)], axis=-1)

    def point(self, model: GeneratedModel, q: Array) -> Array:
        """Return the parameters (n_parameters, ...) at unit coordinates q (..., 2)."""
        return model.with_values(self.base, **{self.x.name: self.x.value(q[..., 0]), self.y.name: self.y.value(q[..., 1])})

    def rates(self, model: GeneratedModel, p: Array) -> Array:
        """Return dp/dq of the two parameters at `p` (n_parameters,), as (2,)."""
        return np.array([a.span * p[model.index(a.name)] if a.log else a.span for a in (self.x, self.y)])


def passes(line: Array, x: float) -> tuple[Array, Array]:
    """Return which segments of the polyline `line` (points, 2) pass the unit coordinate `x`, and the heights at which they do."""
    a, b = line[:-1], line[1:]
    segments = np.nonzero((a[:, 0] <= x) != (b[:, 0] <= x))[0]
    a, b = a[segments], b[segments]
    return segments, a[:, 1] + (x - a[:, 0]) / (b[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])


def meets(line: Array, at: float, axis: int = 1) -> tuple[Array, Array, Array]:
    """Return which segments of the polyline `line` (points, 2) touch the line along `axis` at the other coordinate `at`.

    Their shares of the way at which they do, and the coordinates along `axis`, follow.
    """
    a, b, other = line[:-1], line[1:], 1 - axis
    low, high = np.minimum(a[:, other], b[:, other]), np.maximum(a[:, other], b[:, other])
    segments = np.nonzero((low - 1e-9 <= at) & (at <= high + 1e-9))[0]
    a, b = a[segments], b[segments]
    run = b[:, other] - a[:, other]
    share = np.clip((at - a[:, other]) / np.where(run == 0, 1.0, run), 0.0, 1.0)
    return segments, share, a[:, axis] + share * (b[:, axis] - a[:, axis])


def polyline_heights(lines: Sequence[Array], at: Array) -> list[list[float]]:
    """Return for each unit coordinate `at` the heights, rising, at which polylines (points, 2) in unit coordinates pass it."""
    inside = np.minimum(at, INSIDE)  # a curve ends on the window's edge, not beyond
    return [sorted(float(height) for line in lines for height in passes(line, x)[1]) for x in inside]


# The grid of a stability map: two axes, each a parameter or the ratio of two, and its division into tiles.


@dataclass(frozen=True)
class MapAxis:
    """`count` values of a quantity from `lo` to `hi` (um, s, N), evenly spaced in its logarithm where `log`.

    The quantity is the parameter `moved`, or the ratio `held`/`moved` at fixed `held` where that is not empty.
    """

    moved: str
    lo: float
    hi: float
    count: int
    log: bool = True
    held: str = ""

    @property
    def name(self) -> str:
        """Return the quantity's name: V, or K/W0."""
        return f"{self.held}/{self.moved}" if self.held else self.moved

    def samples(self) -> Array:
        """Return the values of the quantity, both ends exactly, (count,)."""
        return Axis(self.name, self.lo, self.hi, self.log).samples(self.count)

    def between(self, steps: Array) -> Array:
        """Return the quantity at places given in grid steps, whole or not."""
        share = np.asarray(steps) / (self.count - 1)
        inside = self.lo * (self.hi / self.lo) ** share if self.log else self.lo + share * (self.hi - self.lo)
        return np.where(share == 1.0, self.hi, inside)

    def parameter(self, model: GeneratedModel, base: Array, values: Array) -> Array:
        """Return the moved parameter at `values` of the quantity."""
        return base[model.index(self.held)] / values if self.held else values

    def quantity(self, model: GeneratedModel, p: Array) -> Array:
        """Return the quantity at parameter points `p` (n_parameters, ...)."""
        moved = p[model.index(self.moved)]
        return np.asarray(p[model.index(self.held)] / moved if self.held else moved)

    def axis(self, model: GeneratedModel, base: Array) -> Axis:
        """Return the moved parameter's own axis, on which curves are followed; a ratio's is logarithmic."""
        if not self.held:
            return Axis(self.moved, self.lo, self.hi, self.log)
        held = float(base[model.index(self.held)])
        return Axis(self.moved, held / self.hi, held / self.lo, True)


@dataclass(frozen=True)
class MapGrid:
    """A map's window: the fixed parameters `base` (n_parameters,) and its two axes."""

    base: Array
    x: MapAxis
    y: MapAxis

    def plane(self, model: GeneratedModel) -> Plane:
        """Return the plane of the two moved parameters."""
        return Plane(self.base, self.x.axis(model, self.base), self.y.axis(model, self.base))

    def points(self, model: GeneratedModel, xs: Array, ys: Array) -> Array:
        """Return the parameters (n_parameters, ...) at quantities `xs` and `ys` of one shape."""
        moved = {axis.moved: axis.parameter(model, self.base, v) for axis, v in ((self.x, xs), (self.y, ys))}
        return model.with_values(self.base, **moved)

    def at(self, model: GeneratedModel, places: Array) -> Array:
        """Return the parameters (n_parameters, ...) at `places` (..., 2) in grid steps along x and y, whole or not."""
        return self.points(model, self.x.between(places[..., 0]), self.y.between(places[..., 1]))


MOST_POINTS = 10_000_000  # of a grid: an hour and more, and a GB


def check_count(*counts: int) -> None:
    """Raise SrfError for a grid of so many points along its axes that it would neither end nor fit into memory."""
    if (total := math.prod(counts)) > MOST_POINTS:
        size = " x ".join(map(str, counts))
        raise SrfError(f"a grid of {size} points has {total:.3g}", f"Ask for fewer: {MOST_POINTS:.0e} is the limit.")


def check_grid(model: GeneratedModel, grid: MapGrid) -> None:
    """Raise SrfError where the axes do not move two different parameters, or a ratio's fixed one is not fixed."""
    check_count(grid.x.count, grid.y.count)
    for axis in (grid.x, grid.y):
        for name in filter(None, (axis.moved, axis.held)):
            model.index(name)
        if axis.count < 2:
            raise SrfError(
                f"the axis {axis.name} has {axis.count} point", f"Give it two or more: {axis.name}=...:{axis.hi:g}:40."
            )
        if axis.held and not axis.lo > 0:
            raise SrfError(f"the ratio {axis.name} begins at {axis.lo:g}", "Begin above 0: a ratio of 0 is an infinite value.")
        if axis.held and not float(grid.base[model.index(axis.held)]) > 0:
            raise SrfError(f"the ratio {axis.name} needs {axis.held} above 0", f"Set {axis.held} to a positive value.")
    involved = [{a.moved, a.held} - {""} for a in (grid.x, grid.y)]
    shared = involved[0] & involved[1]
    if shared:
        raise SrfError(
            f"the axes {grid.x.name} and {grid.y.name} both involve {', '.join(sorted(shared))}",
            "Choose axes that share no parameter; of a ratio the second parameter moves and the first is fixed.",
        )


@dataclass(frozen=True)
class MapSettings:
    """How a map is computed.

    `mesh_error` is what the mesh may shift a boundary by (relative), `finest` its most intervals, `tol` the last Newton step of
    an orbit; `depth` is how often a cell in which a boundary could hide is halved, `block` the points of a tile.
    """

    intervals: int = 12
    mesh_error: float = 3e-4
    finest: int = 64
    tol: float = 1e-3
    depth: int = 4
    block: tuple[int, int] = (16, 48)


@dataclass(frozen=True)
class TileTask:
    """All that a tile's result depends on; `index` numbers it. Columns i0..i1 and rows j0..j1 of the grid, both ends included.

    The model travels as its source text, so that a worker on another machine needs nothing but the package.
    """

    index: int
    source: str
    key: str
    grid: MapGrid
    columns: tuple[int, int]
    rows: tuple[int, int]
    settings: MapSettings

    @property
    def corner(self) -> Array:
        """Return the first column and row, (2,)."""
        return np.array([self.columns[0], self.rows[0]])

    @property
    def place(self) -> tuple[slice, slice]:
        """Return which columns and rows of the grid they are."""
        return slice(self.columns[0], self.columns[1] + 1), slice(self.rows[0], self.rows[1] + 1)

    @property
    def shape(self) -> tuple[int, int]:
        """Return the numbers of columns and rows."""
        return self.columns[1] - self.columns[0] + 1, self.rows[1] - self.rows[0] + 1


def tile_tasks(model: GeneratedModel, grid: MapGrid, settings: MapSettings | None = None) -> list[TileTask]:
    """Return the tiles that cover `grid`; raises SrfError for axes that do not span a plane."""
    check_grid(model, grid)
    settings = settings or MapSettings()
    columns, rows = (_blocks(a.count, b) for a, b in zip((grid.x, grid.y), settings.block, strict=True))
    return [
        TileTask(k, model.source, model.key, grid, c, r, settings)
        for k, (c, r) in enumerate((c, r) for c in columns for r in rows)
    ]


def _blocks(count: int, block: int) -> Sequence[tuple[int, int]]:
    """Return (first, last) of blocks of about `block` points of equal size; the last of one is the first of the next."""
    parts = max(1, round((count - 1) / block))
    edges = np.linspace(0, count - 1, parts + 1).round().astype(int)
    return [(int(a), int(b)) for a, b in pairwise(edges)]
