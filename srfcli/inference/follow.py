"""Fits that cannot lose their way: the spring is drawn to what was recorded, ever more weakly, until it is free.

Stick-slip makes a least-squares surface full of false minima: a cycle too early fits as well as any. A model whose elongation is
pulled towards the recording keeps its cycles in step whatever its parameters are, so that its residual is nearly linear in them;
a right model needs no pull, and its minimum stays where it is while the pull is taken away.
Abarbanel, Creveling, Farsian and Kostuk, SIAM J. Appl. Dyn. Syst. 8, 1341 (2009).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from srfcli.inference.prediction import Pull, stiffness_share
from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Experiment, Run
from srfcli.splines import Spline
from srfcli.units import split_quantity, to_base

DENSE = 2.0  # samples from knot to knot: noise is halved, slips are kept
STIFF = 1e-4  # weight of second differences, against a sample's 1: they bridge what was not recorded


def pull_towards(experiment: Experiment, runs: Sequence[Run], length: float) -> Pull:
    """Return what draws these runs' springs to their recordings over `length` um of driving."""
    forces = all(run.observable != "elongation" for run in runs)
    records = {run.name: _record(experiment, run, forces) for run in runs}
    return Pull(
        ("force" if forces else "elongation", "time"), {run.name: _speed(run) / length for run in runs}, records
    )


def weaker(pull: Pull, runs: Sequence[Run], length: float) -> Pull:
    """Return the same pull over another length."""
    return Pull(pull.table, {run.name: _speed(run) / length for run in runs}, pull.records)


def slip_length(model: GeneratedModel, experiment: Experiment) -> float:
    """Return the length over which contacts are renewed, as the experiment has it: D0, else the shortest length of the laws."""
    values = model.defaults() | {q.name: q.value for q in experiment.parameters}
    lengths = {p.name: values[p.name] for p in model.parameters if p.unit == "um" and p.name != "start"}
    return lengths.get("D0") or min((v for v in lengths.values() if v > 0), default=1.0)


def _speed(run: Run) -> float:
    return float(np.mean(np.abs(run.drive(run.t))))


def _record(experiment: Experiment, run: Run, forces: bool) -> Spline:
    """Return a recording as a spline over time: the spring's elongation, or its force where all runs record that."""
    y = run.observed * (run.load(run.t)[0] if run.observable == "friction" else 1.0)
    if not forces and run.observable != "elongation":
        size, unit = split_quantity(experiment.stiffness_text, name="stiffness")
        y = y / (to_base(size, unit) * stiffness_share(experiment, run))
    step = float(np.median(np.diff(run.t)))
    return smoothed(run.t, y, run.used & np.isfinite(y), DENSE * step)


def smoothed(t: Array, y: Array, used: Array, spacing: float) -> Spline:
    """Return the cubic spline over t (n,) nearest to the used samples of y, straight where there are none."""
    from scipy.sparse import csr_matrix, diags
    from scipy.sparse.linalg import spsolve

    spline = Spline.over(float(t[0]), float(t[-1]), spacing)
    n = spline.numbers.size
    cell, weights = spline.weights(t[used])
    rows = np.repeat(np.arange(cell.size), 4)
    A = csr_matrix((weights.ravel(), (rows, (cell[:, None] + np.arange(4)).ravel())), shape=(cell.size, n))
    bends = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(n - 2, n))
    return spline.with_numbers(spsolve((A.T @ A + STIFF * bends.T @ bends).tocsc(), A.T @ y[used]))
