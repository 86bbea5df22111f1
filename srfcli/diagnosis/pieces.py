"""A fit's runs as pieces of an atlas: residuals and columns, whitened, with what their samples can be sorted by."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from srfcli.diagnosis.places import Piece
from srfcli.inference.latent import LatentFit
from srfcli.inference.noise import Noise, stretches, whiten
from srfcli.inference.prediction import Prediction, of_run
from srfcli.numerics.collocation import Array
from srfcli.numerics.events import stick_slip
from srfcli.recording.values import Run

LOST, LEAST = 0.3, 30.0  # of the record's standard deviation, and at least so many of the noise's: a cycle is lost
EVENTS = 3  # stick-slip events from which there is a cycle


def pieces_of(fitted: LatentFit, noise: Mapping[str, Noise]) -> list[Piece]:
    """Return each fitted run's residual and columns, whitened, with what its samples can be sorted by."""
    problem, point = fitted.problem, fitted.point
    n = point.theta.size
    scale = np.maximum(np.abs(problem.start), 1e-3 * (problem.upper - problem.lower))
    found = []
    for run in problem.runs:
        p = point.predictions[run.name]
        difference = run.observed - p.y
        good = run.used & np.isfinite(difference) & np.isfinite(p.J).all(axis=1)
        spans = stretches(run.t, good)
        index = np.concatenate([np.arange(a, b) for a, b in spans]) if spans else np.zeros(0, dtype=int)
        ends = np.cumsum([0, *(b - a for a, b in spans)]).tolist()
        J = p.J.copy()
        J[:, :n] *= scale
        white = whiten(noise[run.name], np.column_stack([difference, J]), spans)
        track = point.tracks.columns(run) if run.name in point.tracks.of else range(0)
        places = np.array([*range(n), *(n + i for i in track)], dtype=int)
        sorted_by = {name: x[index] for name, x in _coordinates(fitted, run, p).items()}
        forcing, cycle = _forcing(run), _cycle(run)
        parts = tuple(pairwise(ends))
        columns = (white[:, 0], white[:, 1:], places, noise[run.name], parts)
        known = {k: x for k, x in sorted_by.items() if np.isfinite(x).all()}
        forcing, cycle = (None if x is None else x[index] for x in (forcing, cycle))
        slips = LOST * float(np.std(run.observed[run.used])) / noise[run.name].innovation
        lost = np.inf if cycle is None else max(slips, LEAST)  # steady sliding has no cycle to lose
        found.append(Piece(run.name, run.t[index], *columns, known, forcing, cycle, lost))
    return found


def _coordinates(fitted: LatentFit, run: Run, p: Prediction) -> dict[str, Array]:
    """Return the quantities that the misfit may go with, each (n,), as the fit has them."""
    model = fitted.problem.model
    W, W_dot = run.load(run.t)
    found = {"W": W, "dlnW/dt": W_dot / W, "time": run.t}
    for state, name in (("ln_v", "v"), ("ln_phi", "phi")):
        if state in model.states:
            found[name] = p.x[:, model.states.index(state)]  # their logarithms: it is the same order
    V = run.drive(run.t)
    moved = np.concatenate([[0.0], np.cumsum(0.5 * (V[1:] + V[:-1]) * np.diff(run.t))])
    u = p.y * {"elongation": 1.0, "force": 1 / run.stiffness, "friction": W / run.stiffness}[run.observable]
    found["position"] = run.start + moved - (u - u[0])
    return found


def _forcing(run: Run) -> Array | None:
    """Return the phase of the load's modulation, from 0 to 1, while it is on."""
    m = of_run(run)
    if not m["modulated"]:
        return None
    phase = np.mod(m["f"] * run.t + m["psi"] / (2 * np.pi), 1.0)
    return np.where(run.t > m["onset0"] + m["rise0"], phase, np.nan)


def _cycle(run: Run) -> Array | None:
    """Return the phase of stick-slip, 0 at one event and 1 at the next, between recorded events."""
    m = of_run(run)
    events = stick_slip(run.t, run.observed, ripple=m["f"] if m["modulated"] else None).times
    if events.size < EVENTS:
        return None
    phase = np.interp(run.t, events, np.arange(events.size, dtype=float), left=np.nan, right=np.nan)
    return np.asarray(np.mod(phase, 1.0))
