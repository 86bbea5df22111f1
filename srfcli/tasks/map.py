"""`map`: the stability of the forced sliding state over a plane of two parameters, with every boundary on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from srfcli.core.errors import SrfError, Status
from srfcli.core.settings import require_parameter
from srfcli.core.units import to_base
from srfcli.numerics.continuation import Atlas, AtlasSettings
from srfcli.numerics.map import StabilityMap, compute_map
from srfcli.numerics.map_boundaries import find_boundaries
from srfcli.numerics.normal_form import branch_coefficients, criticality_points
from srfcli.numerics.plane import MapAxis, MapGrid, MapSettings, check_grid
from srfcli.numerics.special_points import SpecialPoint, special_points
from srfcli.results.map import MapResult
from srfcli.tasks.values import Run, here

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from srfcli.codegen.model import GeneratedModel
    from srfcli.codegen.slider import SlidingSystem


def map(  # the command's own name
    system: SlidingSystem,
    *,
    x: tuple[str, float, float, int],
    y: tuple[str, float, float, int],
    log: Sequence[str] | None = None,
    grid: MapSettings | None = None,
    curves: AtlasSettings | None = None,
    boundaries: bool = True,
    criticality: bool = True,
    run: Run = here,
    tiles: Callable[[int, int], None] = lambda done, count: None,
    progress: Callable[[str], None] = lambda text: None,
) -> MapResult:
    """Return the stability of the forced sliding state over a plane of two parameters, and every boundary in it.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    x, y : (name, low, high, points)
        The axes. A name is that of a parameter, its ends in its declared unit, or a ratio such as K/W0, in um, s, N, whose
        second part moves.
    log : sequence of str, optional
        Which of the axes are logarithmic; those whose ends are positive and a decade or more apart if left out.
    grid : MapSettings, optional
        The error that the map's mesh may shift a boundary by, and how often a cell is halved.
    curves : AtlasSettings, optional
        Steps, tolerance and meshes of the boundaries.
    boundaries, criticality : bool
        Whether boundaries are followed, and whether the normal form tells sub- from supercritical on them.
    run : callable
        How independent tiles are computed; one after the other if left out.
    tiles, progress : callable
        Told how many tiles are done of how many, and what is done then.

    Returns
    -------
    MapResult
        Ctrl-C is a status: what was reached is kept.

    Raises
    ------
    SrfError
        For axes that the system does not have, or that span no plane.

    References
    ----------
    Kuznetsov (2004), Elements of Applied Bifurcation Theory: normal forms and resonances.

    Examples
    --------
    >>> import srfcli as srf
    >>> found = srf.map(srf.system(eps=0.18), x=("V", 10, 40, 5), y=("K/W0", 0.01, 0.025, 8), boundaries=False)
    >>> found.to_xarray()["growth_per_slip"].shape
    (5, 8)
    """
    model = system.model
    system.model.check_changing_load(system.vector())
    ends = MapGrid(system.vector(), *(_axis(model, axis, log) for axis in (x, y)))
    check_grid(model, ends)
    return map_grid(system, ends, grid=grid, curves=curves, boundaries=boundaries, criticality=criticality, run=run,
                    tiles=tiles, progress=progress)  # fmt: skip


def map_grid(
    system: SlidingSystem,
    axes: MapGrid,
    *,
    grid: MapSettings | None = None,
    curves: AtlasSettings | None = None,
    boundaries: bool = True,
    criticality: bool = True,
    run: Run = here,
    tiles: Callable[[int, int], None] = lambda done, count: None,
    progress: Callable[[str], None] = lambda text: None,
) -> MapResult:
    """Return what `map` does, on a grid that is made already."""
    found = compute_map(system.model, axes, grid or MapSettings(), run=run, progress=tiles)
    followed = boundaries and found.finished
    atlas, special, cubic = _boundaries(system.model, found, curves or AtlasSettings(), followed, criticality, progress)
    return MapResult(system, found, atlas, tuple(special), tuple(cubic), followed)


def _axis(model: GeneratedModel, given: tuple[str, float, float, int], logs: Sequence[str] | None) -> MapAxis:
    name, lo, hi, count = given
    log = name in logs if logs is not None else hi >= 10 * lo > 0
    if not lo < hi or count < 2:
        raise SrfError(f"{given} is no axis", 'Name, low end, high end, number of points: ("V", 1, 100, 60).')
    held, _, moved = name.rpartition("/")
    for part in filter(None, (held, moved)):
        require_parameter(part, model.parameters, where=model.title)
    if held:
        return MapAxis(moved, float(lo), float(hi), count, log, held)
    unit = model.parameters[model.index(moved)].unit
    return MapAxis(moved, to_base(float(lo), unit), to_base(float(hi), unit), count, log)


def _boundaries(
    model: GeneratedModel,
    found: StabilityMap,
    settings: AtlasSettings,
    followed: bool,
    criticality: bool,
    progress: Callable[[str], None],
) -> tuple[Atlas, list[list[SpecialPoint]], list[NDArray[np.float64]]]:
    """Return the components, the special points of each, and the cubic coefficient at each point (NaN unless wanted)."""
    if not followed:
        return Atlas(found.grid.plane(model), [], [], []), [], []
    *_, atlas = find_boundaries(model, found, settings, progress=lambda said: progress(f"boundaries: {said}"))
    special: list[list[SpecialPoint]] = [[] for _ in atlas.branches]
    cubic = [np.full(len(b.points), np.nan) for b in atlas.branches]
    try:
        for k, branch in enumerate(atlas.branches):
            progress(f"special points of boundary {k + 1}")
            special[k] = special_points(model, atlas.plane, branch)
        for k, branch in enumerate(atlas.branches if criticality else []):
            progress(f"criticality of boundary {k + 1}")
            cubic[k] = branch_coefficients(model, branch)
            changes = criticality_points(model, atlas.plane, branch, cubic[k])
            special[k] = sorted([*special[k], *changes], key=lambda s: s.place)
    except KeyboardInterrupt:
        atlas.status = Status.INTERRUPTED
        atlas.notes.append("interrupted: special points and criticality are not complete")
    return atlas, special, cubic
