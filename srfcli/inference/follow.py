"""Fits that cannot lose their way: a second spring holds the slider to where it was recorded, ever more softly, until it is free.

Stick-slip makes a least-squares surface full of false minima: a cycle too early fits as well as any. A slider that a second
spring holds, too stiff together with the first for stick-slip, keeps its cycles in step whatever the parameters are, and what
its friction lacks shows as an elongation in proportion. A right model needs no second spring, and its minimum stays where it is
while that is taken away. To draw the stage instead takes stiffness away: at a force that is imposed, weakening friction does not
slide steadily at all.
Abarbanel, Creveling, Farsian and Kostuk, SIAM J. Appl. Dyn. Syst. 8, 1341 (2009); Rice and Ruina, J. Appl. Mech. 50, 343 (1983).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from srfcli.inference.noise import stretches
from srfcli.inference.prediction import Hold, of_run, stiffness_share
from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array
from srfcli.recording.noise import describe_noise
from srfcli.recording.values import Experiment, Run
from srfcli.splines import Spline
from srfcli.units import split_quantity, to_base

DENSE = 1.0  # samples from knot to knot: a slip between two samples leaves its mark for the whole of the next cycle
FIRM = 0.03  # of the load: the force of the second spring over one length
WIDEST, AGREE = 33, 2.0  # samples of the longest parabola, and standard deviations within which two of them agree
FAST, BESIDE = 8.0, 4  # noise levels from one sample to the next that are a slip, samples beside it that tell nothing
STIFF = 1e-4  # weight of second differences, against a sample's 1: they bridge what was not recorded


def hold_to(experiment: Experiment, runs: Sequence[Run], length: float) -> Hold:
    """Return the spring that holds the slider of these runs to the recording, by 3 % of the load over `length` um."""
    forces = all(run.observable != "elongation" for run in runs)
    records = {run.name: _record(experiment, run, forces) for run in runs}
    return weaker(Hold(("force" if forces else "elongation", "time"), {}, records), runs, length)


def weaker(hold: Hold, runs: Sequence[Run], length: float) -> Hold:
    """Return the same spring over another length."""
    return Hold(hold.table, {run.name: FIRM * _load(run) / length for run in runs}, hold.records)


def between_slips(run: Run) -> Run:
    """Return a run without its slips, as nothing tells when between two samples the held slider was to slip."""
    from scipy.ndimage import binary_dilation

    level = describe_noise(run.observed[run.used & np.isfinite(run.observed)]).total
    moved = np.abs(np.diff(run.observed, prepend=run.observed[0]))
    slips = binary_dilation(moved > FAST * level, iterations=BESIDE)
    return replace(run, used=run.used & ~slips) if slips.mean() < 0.5 else run


def slip_length(model: GeneratedModel, experiment: Experiment) -> float:
    """Return the length over which contacts are renewed, as the experiment has it: D0, else the shortest length of the laws."""
    values = model.defaults() | {q.name: q.value for q in experiment.parameters}
    lengths = {p.name: values[p.name] for p in model.parameters if p.unit == "um" and p.name != "start"}
    return lengths.get("D0") or min((v for v in lengths.values() if v > 0), default=1.0)


def _load(run: Run) -> float:
    return float(np.mean(run.load(run.t)[0]))


def _record(experiment: Experiment, run: Run, forces: bool) -> Spline:
    """Return a recording as a spline over time: the spring's elongation, or its force where all runs record that."""
    y = run.observed * (run.load(run.t)[0] if run.observable == "friction" else 1.0)
    if not forces and run.observable != "elongation":
        size, unit = split_quantity(experiment.stiffness_text, name="stiffness")
        y = y / (to_base(size, unit) * stiffness_share(experiment, run))
    step = float(np.median(np.diff(run.t)))
    used = run.used & np.isfinite(y)
    return smoothed(run.t, calmed(run, y, used), used, DENSE * step)


def calmed(run: Run, y: Array, used: Array) -> Array:
    """Return a record y (n,) without its noise, by parabolas over the longest stretches that agree with all shorter ones.

    Noise that a second spring carries into the motion would make every spring look softer than it is.
    Goldenshluger and Nemirovski, Math. Methods Stat. 6, 135 (1997).
    """
    from scipy.signal import savgol_coeffs, savgol_filter

    out, modulation = y.copy(), of_run(run)
    for a, b in stretches(run.t, used):
        if b - a < 2 * WIDEST:
            continue
        cycles = modulation["f"] * float(np.median(np.diff(run.t[a:b]))) if modulation["modulated"] else None
        about = describe_noise(y[a:b], cycles)
        level, rho = (x if np.isfinite(x) else 0.0 for x in (about.total, about.lag1))
        low, high = y[a:b] - 1.5 * AGREE * level, y[a:b] + 1.5 * AGREE * level
        agree = np.ones(b - a, dtype=bool)
        for size in (5, 9, 17, WIDEST):
            weights = savgol_coeffs(size, 2)
            apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
            error = AGREE * level * float(np.sqrt(weights @ np.clip(rho, 0.0, 0.9) ** apart @ weights))
            found = savgol_filter(y[a:b], size, 2)
            low, high = np.maximum(low, found - error), np.minimum(high, found + error)
            agree &= low <= high
            out[a:b] = np.where(agree, found, out[a:b])
    return out


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
