"""The scales of a recording (slips, times, velocities, load), and the bounds and sizes of effects that follow from them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from srfcli.core.settings import Parameter
from srfcli.core.units import from_base, to_base
from srfcli.data.values import CriticalLoads, FitParameter, Run
from srfcli.laws.values import REFERENCE_VELOCITY, Effect


def scales_of(runs: Sequence[Run], parameters: Sequence[FitParameter], tables: Sequence[CriticalLoads] = ()) -> dict[str, float]:
    """Return the scales that effect files may name, in um, s, N, of the runs that are fitted (of all, where none is).

    `segment` is the longest slip at one velocity and `track` in one run, `duration` that of the longest run, `interval` the
    shortest between samples, `V_low` and `V_high` the range of the drive while it moves, `load` the mean of the normal load. D0
    and V0 are the model's start values; where the model has none, D0 is missing, and V0 is 1 um/s. Without runs, V_low, V_high
    and load are those of the tables of critical loads, which have no other scale.
    """
    found = _of_runs([run for run in runs if not run.holdout] or list(runs)) if runs else _of_tables(tables)
    found |= {"V0": REFERENCE_VELOCITY.default} | {q.name: q.value for q in parameters if q.name in ("D0", "V0")}
    return {name: value for name, value in found.items() if 0 < value < math.inf}


def _of_tables(tables: Sequence[CriticalLoads]) -> dict[str, float]:
    fitted = [t.table for t in tables if not t.holdout] or [t.table for t in tables]
    if not fitted:
        return {}
    V, loads = (np.concatenate([getattr(t, name) for t in fitted]) for name in ("V", "W0c"))
    return {"V_low": float(V.min()), "V_high": float(V.max()), "load": float(loads.mean())}


def _of_runs(fitted: Sequence[Run]) -> dict[str, float]:
    slips, moving = [], []
    for run in fitted:
        edges = np.array(run.edges)
        V = np.abs(run.drive(0.5 * (edges[1:] + edges[:-1])))
        slips.append((V * np.diff(edges)).tolist())
        moving.append(V[1e-3 * V.max() < V] if V.any() else V)
    V = np.concatenate(moving)
    return {
        "segment": max(max(s) for s in slips), "track": max(sum(s) for s in slips),
        "duration": max(float(np.ptp(run.t)) for run in fitted),
        "interval": min(float(np.median(np.diff(run.t))) for run in fitted),
        "V_low": float(V.min(initial=math.inf)), "V_high": float(V.max(initial=0.0)),
        "load": float(np.mean([run.load(run.t)[0].mean() for run in fitted])),
    }  # fmt: skip


def at_scale(effect: Effect, scales: Mapping[str, float]) -> Effect:
    """Return the effect with bounds and defaults in numbers, where its file states them as formulas of a recording's scales.

    A parameter of which a scale is missing, or whose bounds would not rise, keeps the numbers of its file.
    """
    stated: dict[str, dict[str, float]] = {}
    for name, which, formula in effect.scaled:
        if {str(s) for s in formula.free_symbols} <= scales.keys():
            stated.setdefault(name, {})[which] = float(formula.subs({s: scales[str(s)] for s in formula.free_symbols}))
    return replace(effect, parameters=tuple(_moved(p, stated.get(p.name, {})) for p in effect.parameters))


def own_bounds(
    parameters: Sequence[FitParameter],
    effects: Sequence[Effect],
    runs: Sequence[Run],
    stated: Mapping[str, Collection[str]],
    tables: Sequence[CriticalLoads] = (),
) -> tuple[FitParameter, ...]:
    """Return the parameters of an experiment with the bounds that the recording gives those of its effects.

    `stated` has by name which of lower, upper and fixed the experiment says itself: these stay. Bounds make room for the start
    value. A parameter that its effect never fits is added where the experiment does not list it, and is fixed unless the
    experiment says otherwise.
    """
    scales, found, out = scales_of(runs, parameters, tables), dict[str, Parameter](), []
    held = {name for effect in effects for name in effect.fixed}
    listed = {q.name for q in parameters}
    for effect in effects:
        named = {name for name, which, _ in effect.scaled if which != "default"}
        for p in at_scale(effect, scales).parameters:
            if p.name in named:
                found[p.name] = p
            if p.name in held - listed:
                value, low, high = (to_base(x, p.unit) for x in (p.default, p.lower, p.upper))
                out.append(FitParameter(p.name, value, low, high, True, p.unit))
    for q in parameters:
        if q.name in held and "fixed" not in stated.get(q.name, ()):
            q = replace(q, fixed=True)
        if q.name not in found:
            out.append(q)
            continue
        p, own = found[q.name], stated.get(q.name, ())
        low, high = (to_base(x, p.unit) for x in (p.lower, p.upper))
        room = abs(q.value) if q.value else 0.1 * (high - low)
        low, high = min(low, q.value - room / 2), max(high, q.value + room)
        low = max(low, 0.0) if p.lower >= 0 else low
        out.append(replace(q, lower=q.lower if "lower" in own else low, upper=q.upper if "upper" in own else high))
    return tuple(out)


def _moved(p: Parameter, stated: Mapping[str, float]) -> Parameter:
    """Return a parameter with the bounds and default that are stated, in um, s, N, where these bounds rise."""
    said = {which: from_base(value, p.unit) for which, value in stated.items()}
    lower, upper = said.get("lower", p.lower), said.get("upper", p.upper)
    if not stated or not lower < upper:
        return p
    default = said.get("default", p.default)
    return replace(p, lower=lower, upper=upper, default=min(max(default, lower), upper))
