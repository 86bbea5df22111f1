"""What the discovered physics does to the stability diagram: critical loads of both models, under constant and modulated load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel, open_model
from srfcli.core.errors import SrfError
from srfcli.data.values import Experiment
from srfcli.diagnosis.search import Fitted
from srfcli.inference.critical_loads import apparatus
from srfcli.inference.prediction import run_parameters
from srfcli.laws.registry import Registry
from srfcli.laws.values import Effect
from srfcli.numerics.continuation import ContinuationSettings, find_components
from srfcli.numerics.critical import load_window
from srfcli.numerics.hopf import critical_point
from srfcli.numerics.plane import Axis, Plane
from srfcli.symbolic.system import without_part

DRAWN_VELOCITIES = 61
SCANNED_VELOCITIES = 5  # velocities at which the loads without modulation say where boundaries are looked for
VELOCITY_FACTOR = 3.0  # times the slowest and fastest drive of the recordings: how far the diagram goes
DRAWN = ContinuationSettings(tol=1e-4, max_mesh=256)  # as good as a line in a figure


def stability(
    registry: Registry, baseline: Experiment, at: Mapping[str, float], augmented: Experiment, beside: Sequence[str] | None = None
) -> dict[str, Any]:
    """Return V (um/s), the critical loads (N) of both models under constant load and under the strongest modulation, and a note.

    `at` are the baseline's fitted parameters; the augmented experiment has its own. Of its effects those `beside` the laws are
    told, or all. Loads are NaN where sliding is steady at any; boundaries under modulation have velocities of their own, NaN
    between components. Effects that critical loads do not depend on change diagrams by the parameters that they shift.
    """
    tables = [t.table for t in baseline.thresholds]
    driven = np.concatenate([*(np.abs(r.drive.velocities) for r in baseline.runs), *(t.V for t in tables)])
    driven = driven[driven > 0]
    if not driven.size:
        return {}
    V = np.geomspace(driven.min() / VELOCITY_FACTOR, driven.max() * VELOCITY_FACTOR, DRAWN_VELOCITIES)
    modulations = [r.modulation[:2] for r in baseline.runs if r.modulation]
    modulations += [(t.frequency, eps) for t in baseline.thresholds if (eps := float(t.table.eps.max())) > 0]
    strongest = max(modulations, key=lambda m: m[1], default=None)
    notes = ["Dotted: under constant load."] if strongest else ["Under constant load."]
    found: dict[str, Any] = {"V": V}
    try:
        for side, experiment, fitted in (("baseline", baseline, at), ("augmented", augmented, {})):
            model, base = _model(registry, experiment, fitted)
            found[f"W0_hopf_{side}"] = _loads(model, base, V)
            if strongest:
                found |= _boundary(model, base, V, *strongest, side, notes)
    except SrfError as error:
        return {"note": f"no stability diagram: {error.message}"}
    if not any(np.isfinite(loads).any() for key, loads in found.items() if key.startswith("W0")):
        notes = [f"Sliding is steady at any load from {V[0]:.3g} to {V[-1]:.3g} um/s, of both models: there is no boundary."]
    else:
        if strongest:
            drawn = f"under a load modulated by {strongest[1]:.3g} at {strongest[0]:g} Hz, the strongest here."
            notes.insert(1, f"Drawn through: {drawn}")
        notes.append("srf continue --eps and srf map follow the boundary at any other.")
    effects = [registry.get("effect", n) for n in augmented.choice.effects]
    effects = [e for e in effects if beside is None or e.name in beside]
    apart = [e.name for e in effects if isinstance(e, Effect) and without_part(e)]
    if joined := [e.name for e in effects if e.name not in apart]:
        notes.append(f"{', '.join(joined)}: beside the laws; these commands have that with --effect.")
    if apart:
        notes.append(f"{', '.join(apart)}: critical loads do not depend on that.")
    return found | {"note": " ".join(notes)}


def as_fitted(fitted: Fitted) -> Experiment:
    """Return the experiment of a fitted model with its values."""
    experiment, values = fitted.fit.likelihood.problem.experiment, fitted.fit.values
    parameters = [replace(q, value=values.get(q.name, q.value)) for q in experiment.parameters]
    choice = experiment.choice.plus(e.name for e in fitted.hypothesis.effects)
    return replace(experiment, choice=choice, parameters=tuple(parameters))


def critical_loads(registry: Registry, fitted: Fitted, V: Array) -> Array:
    """Return the critical load (N) of a fitted model under constant load at each velocity (um/s), NaN for none."""
    return _loads(*_model(registry, as_fitted(fitted)), V)


def _model(registry: Registry, experiment: Experiment, at: Mapping[str, float] | None = None) -> tuple[GeneratedModel, Array]:
    """Return the model of sliding at one velocity for ever, and its parameters: an experiment's values, or those in `at`.

    What acts in some runs alone is as in the others: it is no part of the system.
    """
    values = dict(at or {}) | {q.name: q.elsewhere for q in experiment.parameters if q.runs}
    model = open_model(registry, **asdict(experiment.choice), stability=True)
    if experiment.runs:
        p = run_parameters(model, experiment, experiment.runs[0], values)
    else:
        given = apparatus(experiment, 1.0) | values
        p = model.vector({n: v for n, v in given.items() if n in model.names})
    return model, model.with_values(p, W0=1.0, eps=0.0)


def _loads(model: GeneratedModel, base: Array, V: Array) -> Array:
    """Return the critical load under constant load at each velocity, NaN for none."""
    found = [critical_point(model, model.with_values(base, V=v))[0] for v in V.tolist()]
    return np.array([np.nan if point is None else point.W0 for point in found])


def _boundary(
    model: GeneratedModel, base: Array, V: Array, f: float, eps: float, side: str, notes: list[str]
) -> dict[str, Array]:
    """Return velocities and loads of the boundary under modulation, its components one after another, NaN between them."""
    corners = [model.with_values(base, V=v) for v in np.geomspace(V[0], V[-1], SCANNED_VELOCITIES)]
    low, high = load_window(model, corners)
    forced = model.with_values(base, f=f, eps=eps, V=float(V[0]))
    plane = Plane(forced, Axis("V", float(V[0]), float(V[-1])), Axis("W0", low, high))
    *_, boundary = find_components(model, plane, DRAWN)
    if not boundary.branches:
        notes.append(f"No boundary of the {side} was found under modulation.")
        return {}
    lost = sum(scan.lost.size for scan in boundary.scans)
    if lost:
        notes.append(f"At {lost} points no forced state of the {side} was found: boundaries there may be missing.")
    x, y = [], []
    for branch in boundary.branches:
        x += [*(q.value(model, "V") for q in branch.points), np.nan]
        y += [*(q.value(model, "W0") for q in branch.points), np.nan]
    return {f"V_{side}": np.array(x), f"W0_{side}": np.array(y)}
