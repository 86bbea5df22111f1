"""The axes of a map from the command line: parameters, or ratios of two such as K/W0."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from srfcli.cli.ranges import Range, parse_over
from srfcli.errors import SrfError
from srfcli.results.map import ratio_powers, unit_text

if TYPE_CHECKING:
    from srfcli.model import GeneratedModel
    from srfcli.numerics.collocation import Array
    from srfcli.numerics.mapgrid import MapAxis, MapGrid

COLUMNS, ROWS = 80, 120  # points of an axis for which none were given


def read_grid(model: GeneratedModel, base: Array, over: tuple[Range, ...]) -> MapGrid:
    """Return the grid that `over` spans; V from 1 to 100 um/s and a window of K/W0 stand in for an axis not given.

    Raises SrfError for more than two axes, for lists of values, and for what is no parameter of the model.
    """
    from srfcli.numerics.mapgrid import MapGrid, check_grid

    if len(over) > 2:
        raise SrfError(
            f"--over is given {len(over)} times", "A map has two axes: --over V=1:100:120 --over K/W0=0.005:0.03:200."
        )
    ranges = over or (replace(parse_over("V=1:100"), n=COLUMNS),)
    axes = [read_axis(model, r) for r in ranges]
    if len(axes) == 1:
        axes.append(_load_axis(model, base, axes[0]))
    grid = MapGrid(base, axes[0], axes[1])
    check_grid(model, grid)
    return grid


def read_axis(model: GeneratedModel, given: Range) -> MapAxis:
    """Return the axis that a range describes, in um, s, N."""
    from srfcli.numerics.mapgrid import MapAxis
    from srfcli.units import to_base

    if given.values is not None:
        hint = f"An axis runs from a low to a high end: --over {given.name}=1:100:60."
        raise SrfError(f"--over {given.name} lists values", hint)
    log = given.spacing == "log"
    if "/" not in given.name:
        fitted = given.fitted(model.parameters, where=model.title)
        lo, hi = to_base(fitted.lo, fitted.unit), to_base(fitted.hi, fitted.unit)
        return MapAxis(given.name, lo, hi, given.n, log)
    held, moved = given.name.split("/")
    factor = _ratio_factor(model, given, held, moved)
    return MapAxis(moved, given.lo * factor, given.hi * factor, given.n, log, held)


def _ratio_factor(model: GeneratedModel, given: Range, held: str, moved: str) -> float:
    """Return what a ratio's numbers are multiplied with: they are in um, s, N unless a unit is written."""
    from srfcli.units import find_unit

    powers = ratio_powers(model, held, moved)
    if not given.unit:
        return 1.0
    unit = find_unit(given.unit, where=f"--over {given.name}")
    if unit.powers != powers:
        raise SrfError(
            f"--over {given.name}: {given.unit!r} is the wrong unit",
            f"Write it in {unit_text(powers)}, or leave it out.",
        )
    return unit.factor


def _load_axis(model: GeneratedModel, base: Array, x: MapAxis) -> MapAxis:
    """Return K/W0 over the loads at which boundaries are expected along `x`."""
    from srfcli.numerics.mapgrid import MapAxis
    from srfcli.numerics.windows import found_window

    if "W0" in (x.moved, x.held):
        raise SrfError(f"--over {x.name} alone spans no plane", "Add the other axis: --over V=1:100:80.")
    corners = []
    for value in x.samples()[:: max(1, (x.count - 1) // 4)]:
        corner = base.copy()
        corner[model.index(x.moved)] = x.parameter(model, base, value)
        corners.append(corner)
    window = found_window(model, corners)
    lo, hi = window.lo, window.hi
    if "K" in (x.moved, x.held):
        return MapAxis("W0", lo, hi, ROWS)
    K = float(base[model.index("K")])
    return MapAxis("W0", K / hi, K / lo, ROWS, True, "K")
