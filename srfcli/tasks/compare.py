"""`compare`: the stability diagrams of several laws, brought to the same observables at one low velocity."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from srfcli.core.errors import SrfError, Status
from srfcli.numerics.compare import (
    LawStudy,
    LawTask,
    Match,
    Observables,
    Window,
    check_adjusted,
    match,
    observe,
    read_study,
    study_law,
)
from srfcli.results.compare import ComparisonResult
from srfcli.tasks.values import Run, here

if TYPE_CHECKING:
    from srfcli.codegen.slider import SlidingSystem


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
    run: Run = here,
    progress: Callable[[str], None] = lambda name: None,
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
        Told the name of each law that is done.

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
    import numpy as np

    names, models = tuple(systems), [s.model for s in systems.values()]
    if len(names) < 2:
        raise SrfError("one law is nothing to compare", "Name more: --law srf-vsat --law log-log, or several --ageing.")
    wanted = sorted({float(e) for e in np.atleast_1d(np.asarray(eps, float)) if e > 0})
    if not wanted:
        raise SrfError("--eps 0 leaves nothing to compare", "Give an amplitude above 0: --eps 0.18.")
    thirds = [wanted[-1] / 3, 2 * wanted[-1] / 3] if len(wanted) == 1 else []
    amplitudes = tuple(sorted({0.0, *thirds, *wanted}))
    goal, matches = _matches(systems, at, tuple(adjust), matched)
    if K_over_W0 is None:
        loads = (0.5 * goal.W0, 16.0 * goal.W0)
    else:
        K = float(matches[0].p[models[0].index("K")])
        loads = (K / K_over_W0[1], K / K_over_W0[0]) if K_over_W0[0] > 0 else (0.0, 0.0)
    if not (V[0] > 0 and loads[0] > 0):
        raise SrfError("--over begins at 0", "The window is logarithmic: begin above 0.")
    window = Window(V=V, W0=loads, **(points or {}))
    usable = [k for k, m in enumerate(matches) if m.status.ok]
    tasks = [LawTask(models[k].source, models[k].key, matches[k].p, amplitudes, window) for k in usable]
    studies: dict[int, LawStudy] = {}
    try:
        for place, arrays in run(study_law, tasks):
            studies[usable[place]] = read_study(arrays)
            progress(names[usable[place]])
    except KeyboardInterrupt:
        if not studies:
            raise
        left = [k for k in usable if k not in studies]
        matches = [replace(m, status=Status.INTERRUPTED) if k in left else m for k, m in enumerate(matches)]
    return ComparisonResult(
        names, tuple(systems.values()), goal, tuple(matches), studies, amplitudes, tuple(wanted), window
    )


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
            "Name another law first, or another velocity with --at.",
        )
    for model in models:
        check_adjusted(model, adjust)
    found = [Match(vectors[0], (), 0.0, Status.OK)]
    for model, p in zip(models[1:], vectors[1:], strict=True):
        found.append(match(model, p, goal, adjust) if matched else Match(p, (), math.nan, Status.OK))
    return goal, found
