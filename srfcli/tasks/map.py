"""`map` and `compare`: the stability of the forced sliding state over a plane of two parameters, of one law and of several."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import GeneratedModel
from srfcli.core.errors import SrfError, Status, check_choice, explained
from srfcli.core.parallel import Runner, run_here
from srfcli.core.settings import require_parameter
from srfcli.core.units import to_base
from srfcli.numerics.compare import (
    LawPart,
    LawStudy,
    LawTask,
    Match,
    Observables,
    Window,
    check_adjusted,
    join_study,
    law_parts,
    match,
    observe,
    study_part,
)
from srfcli.numerics.continuation import Boundary, ContinuationSettings
from srfcli.numerics.map import StabilityMap, compute_map
from srfcli.numerics.map_boundaries import find_boundaries
from srfcli.numerics.plane import MapAxis, MapGrid, MapSettings, check_count, check_grid
from srfcli.numerics.special_points import SpecialPoint, branch_coefficients, criticality_points, special_points
from srfcli.results.map import ComparisonResult, MapResult

if TYPE_CHECKING:
    from srfcli.codegen.slider import SlidingSystem


@explained
def map(  # the command's own name
    system: SlidingSystem,
    *,
    x: tuple[str, float, float, int] | MapAxis,
    y: tuple[str, float, float, int] | MapAxis,
    log: Sequence[str] | None = None,
    grid: MapSettings | None = None,
    curves: ContinuationSettings | None = None,
    boundaries: bool = True,
    criticality: bool = True,
    run: Runner = run_here,
    tiles: Callable[[int, int], None] = lambda done, count: None,
    progress: Callable[[str], None] = lambda text: None,
) -> MapResult:
    """Return the stability of the forced sliding state over a plane of two parameters, and every boundary in it.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    x, y : (name, low, high, points) or MapAxis
        The axes. A name is that of a parameter, its ends in its declared unit, or a ratio such as K/W0, in um, s, N, whose
        second part moves.
    log : sequence of str, optional
        Which of the axes are logarithmic; those whose ends are positive and a decade or more apart if left out.
    grid : MapSettings, optional
        The error that the map's mesh may shift a boundary by, and how often a cell is halved.
    curves : ContinuationSettings, optional
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
    model.check_changing_load(system.vector())
    axes = MapGrid(system.vector(), *(_axis(model, axis, log) for axis in (x, y)))
    check_grid(model, axes)
    found = compute_map(model, axes, grid or MapSettings(), run=run, progress=tiles)
    followed = boundaries and found.finished
    boundary, special, cubic = _boundaries(model, found, curves or ContinuationSettings(), followed, criticality, progress)
    return MapResult(system, found, boundary, tuple(special), tuple(cubic), followed)


def _axis(model: GeneratedModel, given: tuple[str, float, float, int] | MapAxis, logs: Sequence[str] | None) -> MapAxis:
    """Return the axis that a name, its ends and a number of points mean."""
    if isinstance(given, MapAxis):
        return given
    try:
        name, lo, hi, count = given
    except (TypeError, ValueError):
        raise SrfError(f"{given!r} is no axis", 'Name, low end, high end, number of points: ("V", 1, 100, 60).') from None
    log = name in logs if logs is not None else hi >= 10 * lo > 0
    if not lo < hi or count < 2:
        raise SrfError(f"{given} is no axis", 'Name, low end, high end, number of points: ("V", 1, 100, 60).')
    held, _, moved = name.rpartition("/")
    for part in filter(None, (held, moved)):
        require_parameter(part, model.parameters, where=model.title)
    if held:
        return MapAxis(moved, float(lo), float(hi), count, log, held)
    lo, hi = (to_base(float(end), model.unit(moved)) for end in (lo, hi))
    return MapAxis(moved, lo, hi, count, log)


def _boundaries(
    model: GeneratedModel,
    found: StabilityMap,
    settings: ContinuationSettings,
    followed: bool,
    criticality: bool,
    progress: Callable[[str], None],
) -> tuple[Boundary, list[list[SpecialPoint]], list[NDArray[np.float64]]]:
    """Return the components, the special points of each, and the cubic coefficient at each point (NaN unless wanted)."""
    if not followed:
        return Boundary(found.grid.plane(model)), [], []
    *_, boundary = find_boundaries(model, found, settings, progress=lambda said: progress(f"boundaries: {said}"))
    special: list[list[SpecialPoint]] = [[] for _ in boundary.branches]
    cubic = [np.full(len(b.points), np.nan) for b in boundary.branches]
    try:
        for k, branch in enumerate(boundary.branches):
            progress(f"special points of boundary {k + 1}")
            special[k] = special_points(model, boundary.plane, branch)
        for k, branch in enumerate(boundary.branches if criticality else []):
            progress(f"criticality of boundary {k + 1}")
            cubic[k] = branch_coefficients(model, branch)
            changes = criticality_points(model, boundary.plane, branch, cubic[k])
            special[k] = sorted([*special[k], *changes], key=lambda s: s.place)
    except KeyboardInterrupt:
        said = "interrupted: special points and criticality are not complete"
        boundary = replace(boundary, status=Status.INTERRUPTED, notes=(*boundary.notes, said))
    return boundary, special, cubic


# `compare`: the stability diagrams of several laws, brought to the same observables at one low velocity.


@explained
def compare(
    systems: Mapping[str, SlidingSystem],
    *,
    eps: float | Sequence[float] = 0.18,
    at: float = 10.0,
    adjust: Sequence[str] = ("A", "B", "D0"),
    matched: bool = True,
    V: tuple[float, float] = (1.0, 100.0),
    K_over_W0: tuple[float, float] | None = None,
    points: Mapping[str, int] | None = None,
    run: Runner = run_here,
    progress: Callable[[str, float], None] = lambda name, share: None,
) -> ComparisonResult:
    """Return where laws differ once each is brought to the first one's observables at one low velocity.

    Parameters
    ----------
    systems : mapping from name to SlidingSystem
        Two sliders or more, from `srfcli.system`; the first is the reference.
    eps : number or sequence
        Relative amplitudes above 0.
    at : float
        Velocity in um/s at which laws are brought to the same friction, slope, critical load and critical period.
    adjust : three names
        The parameters adjusted, with mu0 where there is one.
    matched : bool
        Whether parameters are adjusted at all.
    V, K_over_W0 : (float, float), optional
        The window, in um/s and 1/um; from half to sixteen times the reference's critical load if the second is left out.
    points : mapping, optional
        How many `columns` (of V) and `rows` (of load) each law's map has.
    run : callable
        How independent laws are computed; one after the other if left out.
    progress : callable
        Told of each part that is done the law's name, and the share of all work that is done then, from 0 to 1.

    Returns
    -------
    ComparisonResult

    Raises
    ------
    SrfError
        For one law only, no amplitude above 0, or a reference without a critical load at that velocity.

    Examples
    --------
    >>> import srfcli as srf
    >>> laws = {name: srf.system(ageing=name) for name in ("dieterich", "ruina")}
    >>> small = {"V": (5, 20), "K_over_W0": (0.015, 0.03), "points": {"columns": 4, "rows": 6}}
    >>> found = srf.compare(laws, eps=0.09, **small).to_dataframe()
    >>> found[["law", "stabilised"]].round(2).values.tolist()
    [['dieterich', 0.5], ['ruina', 0.67]]
    """
    if not isinstance(systems, Mapping):
        raise SrfError("the systems to compare have no names", "Give them in a mapping: {'ageing': one, 'slip': other}.")
    names, models = tuple(systems), [s.model for s in systems.values()]
    if len(names) < 2:
        raise SrfError("one law is nothing to compare", "Name more, such as srf-vsat and log-log, or several ageing laws.")
    wanted = sorted({float(e) for e in np.atleast_1d(np.asarray(eps, float)) if e > 0})
    if not wanted:
        raise SrfError("`eps` 0 leaves nothing to compare", "Give an amplitude above 0, such as 0.18.")
    thirds = [wanted[-1] / 3, 2 * wanted[-1] / 3] if len(wanted) == 1 else []
    amplitudes = tuple(sorted({0.0, *thirds, *wanted}))
    goal, matches = _matches(systems, at, tuple(adjust), matched)
    if K_over_W0 is None:
        loads = (0.5 * goal.W0, 16.0 * goal.W0)
    else:
        K = float(matches[0].p[models[0].index("K")])
        loads = (K / K_over_W0[1], K / K_over_W0[0]) if K_over_W0[0] > 0 else (0.0, 0.0)
    if not (V[0] > 0 and loads[0] > 0):
        raise SrfError("the window begins at 0", "The window is logarithmic: begin above 0.")
    for name in points or {}:
        check_choice("points", name, ("columns", "rows"))
    window = Window(V=V, W0=loads, **(points or {}))
    check_count(window.columns, window.rows)
    usable = [k for k, m in enumerate(matches) if m.status.ok]
    tasks = [LawTask(models[k].source, models[k].key, matches[k].p, amplitudes, window) for k in usable]
    parts = [part for task in tasks for part in law_parts(task)]
    whole, done = sum(part.weight for part in parts), 0.0
    found: list[dict[LawPart, dict[str, Any]]] = [{} for _ in tasks]
    studies: dict[int, LawStudy] = {}
    try:
        for place, arrays in run(study_part, parts):
            law = tasks.index(parts[place].task)
            found[law][parts[place]] = arrays
            if len(found[law]) == len(law_parts(tasks[law])):
                studies[usable[law]] = join_study(tasks[law], found[law])
            done += parts[place].weight
            progress(names[usable[law]], done / whole)
    except KeyboardInterrupt:
        if not studies:
            raise
        left = [k for k in usable if k not in studies]
        matches = [replace(m, status=Status.INTERRUPTED) if k in left else m for k, m in enumerate(matches)]
    return ComparisonResult(names, tuple(systems.values()), goal, tuple(matches), studies, amplitudes, tuple(wanted), window)


def _matches(
    systems: Mapping[str, SlidingSystem], at: float, adjust: tuple[str, ...], matched: bool
) -> tuple[Observables, list[Match]]:
    """Return the reference's observables, and every law's parameters brought to them."""
    models = [s.model for s in systems.values()]
    vectors = [s.vector() for s in systems.values()]
    for model, p in zip(models, vectors, strict=True):
        model.check_changing_load(p)
    goal = observe(models[0], vectors[0], at)
    if goal is None:
        raise SrfError(
            f"{next(iter(systems))} has no critical load at {at:g} um/s: there is nothing to bring the others to",
            "Name another law first, or another velocity in `at`.",
        )
    for model in models:
        check_adjusted(model, adjust)
    found = [Match(vectors[0], (), 0.0, Status.OK)]
    for model, p in zip(models[1:], vectors[1:], strict=True):
        found.append(match(model, p, goal, adjust) if matched else Match(p, (), math.nan, Status.OK))
    return goal, found
