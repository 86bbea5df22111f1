"""The columns of effects: derivatives of the observable by the size of each, at its neutral value, along a fitted baseline."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel, open_model
from srfcli.codegen.splines import Spline
from srfcli.core.units import to_base
from srfcli.data.values import Experiment, FitParameter, Run
from srfcli.diagnosis.hypotheses import TRACK, fit_parameters, inner_grid, neutral_values, own_parameters
from srfcli.inference.prediction import predict
from srfcli.inference.random_field import LatentFit
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect

TABLES = (TRACK, ("mu", "time"), ("V", "stage"))
PROBES, STRAIGHT = (
    4,
    0.1,
)  # tries for a difference that moves no record by more than this part of its standard deviation
ARGUMENTS = {"slip": 0, "time": 1, "stage": 2}


@dataclass(frozen=True)
class Column:
    """A candidate's columns by run, (n, q): one for each phase that is fitted freely, at given inner values."""

    effect: Effect
    inner: dict[str, float]
    by_run: dict[str, Array]
    phases: int = 1


def columns_of(registry: Registry, experiment: Experiment, fitted: LatentFit, effects: Sequence[Effect],
             present: tuple[Effect, ...]) -> list[Column]:  # fmt: skip
    choice = experiment.choice
    found: list[Column] = []
    tabled = {e.name: shape for e in effects if (shape := along_table(e)) is not None}
    regular = [
        e for e in effects if e.sizes and not e.settings and not e.frees and not e.observed and e.name not in tabled
    ]
    plain = [e for e in regular if not e.scans]
    names = tuple(e.name for e in (*present, *plain))
    model = open_model(registry, **asdict(choice.plus(names)), tables=(*TABLES, *_held(fitted)))
    found += _union(model, experiment, fitted, present, plain, [e for e in effects if e.name in tabled], tabled)
    for effect in (e for e in regular if e.scans):
        own = open_model(
            registry, **asdict(choice.plus((*(e.name for e in present), effect.name))), tables=(TRACK, *_held(fitted))
        )
        found += _scanned(own, experiment, fitted, present, effect)
    for effect in (e for e in effects if e.settings or e.observed):
        found.append(_probed(registry, experiment, fitted, present, effect))
    for effect in (e for e in effects if "K" in e.frees):
        found.append(_freed(registry, experiment, fitted, present, effect))
    return found


def _values(
    model: GeneratedModel, experiment: Experiment, fitted: LatentFit, present: Sequence[Effect], added: Sequence[Effect]
) -> dict[str, float]:
    """Return the fit's parameters under the names of a larger model, the added effects at their neutral values."""
    values = {n: v for n, v in fitted.values.items() if n in model.names or "." in n}
    for effect in present:
        for long, p in own_parameters(effect, model).items():
            for short in (long, p.name):
                if short in fitted.values:
                    values[long] = fitted.values[short]
    for effect in added:
        neutral = neutral_values(effect)
        for long, p in own_parameters(effect, model).items():
            values[long] = neutral.get(p.name, to_base(p.default, p.unit))
    return values


def _union(model: GeneratedModel, experiment: Experiment, fitted: LatentFit, present: Sequence[Effect], plain: Sequence[Effect],
           tabled: Sequence[Effect], shapes: Mapping[str, Shape]) -> list[Column]:  # fmt: skip
    """Return the columns of effects without inner parameters, and of those that are functions along a table, from one motion."""
    values = _values(model, experiment, fitted, present, plain)
    sizes = [(e, long) for e in plain for long, p in own_parameters(e, model).items() if p.name in e.sizes]
    columns: list[Column] = []
    signals: dict[str, dict[str, Array]] = {}
    for run in fitted.problem.runs:
        tables = (_track(fitted, run), _time_table(run), _stage_table(run))
        wanted = [i for name, i in ARGUMENTS.items() if any(shapes[e.name].argument == name for e in tabled)]
        p = predict(
            model,
            experiment,
            run,
            values,
            by=[n for _, n in sizes],
            tables=tables,
            by_tables=wanted,
            **_as_fitted(fitted),
        )
        signals[run.name] = {n: p.J[:, k] for k, (_, n) in enumerate(sizes)}
        at = len(sizes)
        for i in wanted:
            count = tables[i].numbers.size
            signals[run.name][f"[{i}]"] = p.J[:, at : at + count]
            at += count
    for effect, long in sizes:
        columns.append(Column(effect, {}, {r.name: signals[r.name][long][:, None] for r in fitted.problem.runs}))
    for effect in tabled:
        columns += _from_table(effect, shapes[effect.name], fitted, signals)
    return columns


def _as_fitted(fitted: LatentFit) -> dict[str, Any]:
    """Return how a fit's own predictions were made: its hold and its tolerance."""
    return {"hold": fitted.problem.hold, "rtol": fitted.problem.rtol}


def _held(fitted: LatentFit) -> tuple[tuple[str, str], ...]:
    """Return the table of the recording that holds, if one does."""
    return (fitted.problem.hold.table,) if fitted.problem.hold else ()


def _track(fitted: LatentFit, run: Run) -> Spline:
    tracks = fitted.point.tracks
    return tracks.spline(run) if run.name in tracks.of else _slip_table(run)


def _length(run: Run) -> float:
    V = run.drive(run.t)
    return float(np.sum(0.5 * (V[1:] + V[:-1]) * np.diff(run.t)))


def _slip_table(run: Run) -> Spline:
    return Spline.over(run.start - 1.0, run.start + _length(run) + 2.0, max(0.8, _length(run) / 300))


def _time_table(run: Run) -> Spline:
    span = float(run.t[-1] - run.t[0])
    return Spline.over(float(run.t[0]), float(run.t[-1]), max(span / 60, 0.05))


def _stage_table(run: Run) -> Spline:
    return Spline.over(0.0, _length(run) + 1.0, max(0.5, _length(run) / 300))


@dataclass(frozen=True)
class Shape:
    """An effect of first order that is a function g of one table's argument and of inner parameters."""

    argument: str
    g: Callable[..., Array]
    inner: tuple[str, ...]


def along_table(effect: Effect) -> Shape | None:
    """Return the shape of an effect that adds size * g(slip, time or stage) to mu, or multiplies V by 1 + it; None for others."""
    import sympy as sp

    from srfcli.laws.expression import symbol

    if len(effect.changes) != 1 or len(effect.sizes) != 1 or effect.states or effect.settings:
        return None
    (slot, formula), size = effect.changes[0], effect.sizes[0]
    if slot not in ("mu", "V"):
        return None
    slope = sp.diff(formula, symbol(size)).subs(symbol(size), sp.nsimplify(neutral_values(effect)[size]))
    if slot == "V":
        slope = sp.simplify(slope / symbol("V"))
    inner = [p.name for p in effect.parameters if p.name != size]
    used = {str(s) for s in slope.free_symbols}
    arguments = used - set(inner)
    tables = {"slip", "time"} if slot == "mu" else {"stage"}
    if len(arguments) != 1 or not arguments <= tables:
        return None
    (argument,) = arguments
    return Shape(argument, sp.lambdify([symbol(argument), *map(symbol, inner)], slope, "numpy"), tuple(inner))


def _from_table(
    effect: Effect, shape: Shape, fitted: LatentFit, signals: Mapping[str, Mapping[str, Array]]
) -> list[Column]:
    """Return the columns of an effect for each of its inner values, from the columns of a table's numbers."""
    grid = inner_grid(effect)
    phased = "phase" in shape.inner
    merged: dict[tuple[float, ...], list[dict[str, float]]] = {}
    for inner in grid:
        merged.setdefault(tuple(v for n, v in inner.items() if n != "phase"), []).append(inner)
    out = []
    weights: dict[str, tuple[Array, Array]] = {}
    for run in fitted.problem.runs:
        table = {"slip": _track(fitted, run), "time": _time_table(run), "stage": _stage_table(run)}[shape.argument]
        x = np.linspace(table.first, table.last, 6 * table.numbers.size)
        design = table.design(x)
        weights[run.name] = (x, np.linalg.pinv(design.T @ design) @ design.T)
    for group in merged.values():
        by_run = {}
        for run in fitted.problem.runs:
            x, project = weights[run.name]
            wanted = np.column_stack(
                [np.broadcast_to(shape.g(x, *(inner[n] for n in shape.inner)), x.shape) for inner in group]
            )
            by_run[run.name] = signals[run.name][f"[{ARGUMENTS[shape.argument]}]"] @ (project @ wanted)
        out.append(Column(effect, group[0], by_run, phases=len(group) if phased else 1))
    return out


def _scanned(
    model: GeneratedModel, experiment: Experiment, fitted: LatentFit, present: Sequence[Effect], effect: Effect
) -> list[Column]:
    """Return the columns of an effect for each of its inner values, each from a motion of its own; phases side by side."""
    base = _values(model, experiment, fitted, present, [effect])
    longs = {p.name: long for long, p in own_parameters(effect, model).items()}
    merged: dict[tuple[float, ...], list[dict[str, float]]] = {}
    for inner in inner_grid(effect):
        merged.setdefault(tuple(v for n, v in inner.items() if n != "phase"), []).append(inner)
    out = []
    for group in merged.values():
        by_run = {}
        for run in fitted.problem.runs:
            parts = []
            for inner in group:
                values = base | {longs[n]: v for n, v in inner.items()}
                p = predict(
                    model,
                    experiment,
                    run,
                    values,
                    by=[longs[effect.sizes[0]]],
                    tables=(_track(fitted, run),),
                    **_as_fitted(fitted),
                )
                parts.append(p.J[:, 0])
            by_run[run.name] = np.column_stack(parts)
        out.append(Column(effect, group[0], by_run, phases=len(group)))
    return out


def _probed(
    registry: Registry, experiment: Experiment, fitted: LatentFit, present: Sequence[Effect], effect: Effect
) -> Column:
    """Return the column of an effect whose model has other unknowns than the baseline: a difference over a small size."""
    names = (*(e.name for e in present), effect.name)
    model = open_model(registry, **asdict(experiment.choice.plus(names)), tables=(TRACK, *_held(fitted)))
    values = _values(model, experiment, fitted, present, [effect])
    (parameter,) = [q for q in fit_parameters(effect, model, experiment)]
    size = (
        max(parameter.lower, 0.02 * parameter.value)
        if effect.frees
        else max(2 * parameter.lower, 1e-4 * parameter.upper)
    )
    for _ in range(PROBES):
        values[parameter.name] = size
        listed = _listed(experiment, [replace(parameter, value=size)])
        by_run, furthest = {}, 0.0
        for run in fitted.problem.runs:
            moved = (
                predict(model, listed, run, values, tables=(_track(fitted, run),), **_as_fitted(fitted)).y
                - fitted.point.predictions[run.name].y
            )
            by_run[run.name] = (moved / size)[:, None]
            furthest = max(furthest, float(np.max(np.abs(moved))) / max(float(np.std(run.observed)), 1e-12))
        if furthest < STRAIGHT:
            break
        size *= max(0.5 * STRAIGHT / furthest, 0.05)
    return Column(effect, {}, by_run)


def _freed(
    registry: Registry, experiment: Experiment, fitted: LatentFit, present: Sequence[Effect], effect: Effect
) -> Column:
    model = open_model(
        registry, **asdict(experiment.choice.plus(e.name for e in present)), tables=(TRACK, *_held(fitted))
    )
    values = _values(model, experiment, fitted, present, [])
    added = fit_parameters(effect, model, experiment)
    listed = _listed(experiment, added)
    by_run = {}
    for run in fitted.problem.runs:
        p = predict(model, listed, run, values, by=["K"], tables=(_track(fitted, run),), **_as_fitted(fitted))
        by_run[run.name] = p.J[:, :1] * added[0].value  # by ln K
    return Column(effect, {}, by_run)


def _listed(experiment: Experiment, added: Sequence[FitParameter]) -> Experiment:
    names = {q.name for q in added}
    return replace(experiment, parameters=(*(q for q in experiment.parameters if q.name not in names), *added))
