"""What the discovered physics does to the stability diagram: critical loads of both models under constant load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from srfcli.errors import SrfError
from srfcli.model import open_model
from srfcli.numerics.collocation import Array
from srfcli.numerics.hopf import critical_point
from srfcli.recording.values import Experiment
from srfcli.registry import Registry

VELOCITIES = 61
BEYOND = 3.0  # times the slowest and fastest drive of the recordings: how far the diagram goes


def stability(
    registry: Registry, baseline: Experiment, at: Mapping[str, float], augmented: Experiment
) -> dict[str, Any]:
    """Return V (um/s) and the critical loads (N, NaN where sliding is steady at any) of both models, and a note.

    `at` are the baseline's fitted parameters; the augmented experiment has its own. Effects of the apparatus change no critical
    load under constant load but through the parameters that they had bent.
    """
    driven = np.concatenate([np.abs(r.drive.velocities) for r in baseline.runs])
    driven = driven[driven > 0]
    if not driven.size:
        return {}
    V = np.geomspace(driven.min() / BEYOND, driven.max() * BEYOND, VELOCITIES)
    try:
        before = _loads(registry, baseline, at, V)
        after = _loads(registry, augmented, {q.name: q.value for q in augmented.parameters}, V)
    except SrfError as error:
        return {"note": f"no stability diagram: {error.message}"}
    left = augmented.choice.effects
    note = "Under constant load. `srf critical` and `srf continue --eps` follow the boundary under modulation."
    if left:
        note += f" {', '.join(left)}: of the apparatus, not in the laws."
    return {"V": V, "W0_hopf_baseline": before, "W0_hopf_augmented": after, "note": note}


def _loads(registry: Registry, experiment: Experiment, values: Mapping[str, float], V: Array) -> Array:
    """Return the critical load at each velocity, NaN for none."""
    model = open_model(registry, **asdict(replace(experiment.choice, effects=())))
    own = {n: v for n, v in values.items() if n in model.names and n not in ("V", "W0", "K")}
    own["K"] = experiment.runs[0].stiffness
    if experiment.mass is not None and "M" in model.names:
        own["M"] = experiment.mass
    found = [critical_point(model, model.vector({**own, "V": v, "W0": 1.0}))[0] for v in V.tolist()]
    return np.array([np.nan if point is None else point.W0 for point in found])
