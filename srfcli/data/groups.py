"""What parameters may vary with: runs, loads, segments of runs about each step of the velocity, the direction of these steps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from srfcli.core.errors import SrfError, did_you_mean
from srfcli.data.values import Experiment, Run

BY = ("run", "load", "segment", "direction")
TRENDS = ("slip", "time")  # along which an observable drifts
GAUGE_NOISE = "noise"  # what may vary besides parameters: the gauge noise of a group of runs
CUT = ("segment", "direction")  # for which runs are cut
VELOCITY_STEP = 1.5  # factor of a step of the velocity: what is fitted through noisy displacements wavers by less
HELD_DRIVE = 1e-6  # um/s, below which the drive is held: no piece of a run can begin there in steady sliding
FEWEST_OF_RUN = 8  # samples of a run


def grouped(experiment: Experiment, vary: Sequence[str] = (), by: str | None = None, trend: str | None = None) -> Experiment:
    """Return the experiment with what varies, by what, and along what its observables drift; left out, as it says itself.

    What varies is NAME or NAME:BY, where `by` is not what that one varies with. A trend of "none" takes that of the experiment
    back. By segment or direction, its runs are cut between the steps of their velocities; a stroke of a reciprocating drive is
    not.
    """
    drift, usual = None if trend == "none" else trend or experiment.trend, by or experiment.by
    own = {name: by or way for name, way in experiment.vary.items()}
    own = {name: way or usual for name, _, way in (entry.partition(":") for entry in vary)} or own
    for name, way in own.items():
        if way not in BY:
            raise SrfError(f"`vary`: {name} cannot vary by '{way}'", did_you_mean(way, BY))
    chosen = replace(experiment, vary=own, by=usual, trend=drift)
    strokes = any(run.backward for run in experiment.runs)
    cut, before = ({way for way in (*e.vary.values(), e.by) if way in CUT} for e in (chosen, experiment))
    if not cut or before or (strokes and cut == {"direction"}):  # what is cut already stays as it is
        return chosen
    runs = tuple(piece for run in experiment.runs for piece in segments(run))
    name, count = Counter(run.name for run in runs).most_common(1)[0]
    if count > 1:
        raise SrfError(f"{name} would be the name of a run and of a segment", "Rename the run.")
    return replace(chosen, runs=runs)


def labels(experiment: Experiment, by: str) -> dict[str, str]:
    """Return the group of each run, by its name."""
    if by == "load":
        return {run.name: f"{run.first_load:.3g} {run.load_unit}" for run in experiment.runs}
    if by == "direction" and any(run.backward for run in experiment.runs):  # strokes of a reciprocating drive
        return {run.name: "backward" if run.backward else "forward" for run in experiment.runs}
    if by == "direction":
        return {run.name: step(run) for run in experiment.runs}
    return {run.name: run.name for run in experiment.runs}


def step(run: Run) -> str:
    """Return whether the first step of a run's velocity is up or down; steady where it has none."""
    found = levels(run)
    return "steady" if len(found) < 2 else "up" if found[1][1] > found[0][1] else "down"


def levels(run: Run) -> list[tuple[float, float]]:
    """Return when each velocity of a run begins (s), and what it is (um/s); ramps lie between them."""
    found: list[tuple[float, float]] = []
    for begin, end in pairwise(run.edges):
        V, rate, since = run.drive.piece(begin)
        ends = np.maximum([V + rate * (begin - since), V + rate * (end - since)], HELD_DRIVE)
        if np.ptp(np.log(ends)) > np.log(VELOCITY_STEP):
            continue
        own = float(np.sqrt(ends.prod()))
        if not found or abs(np.log(own / found[-1][1])) > np.log(VELOCITY_STEP):
            found.append((begin, own))
    return found


def segments(run: Run) -> list[Run]:
    """Return a run cut where it says so, or halfway between the steps of its velocity: runs of their own, named in order.

    Each piece begins as the run does, in steady sliding or free, and no reading is in two of them.
    """
    found = levels(run)
    halfway = [0.5 * (a[0] + b[0]) for a, b in pairwise(found[1:]) if a[1] > HELD_DRIVE]
    edges = [0]
    for cut in run.segments or halfway:
        at = int(np.searchsorted(run.t, cut))
        if min(run.used[edges[-1] : at].sum(), run.used[at:].sum()) >= FEWEST_OF_RUN:
            edges.append(at)
    if len(edges) == 1:
        return [run]
    slid, pieces = run.drive.displacement(run.t), []
    for k, (a, b) in enumerate(pairwise([*edges, run.t.size])):
        piece, notices = run.part(slice(a, b)), run.notices if a == 0 else ()
        start = run.start + float(slid[a])
        pieces.append(replace(piece, name=f"{run.name}-{k + 1}", start=start, notices=notices, segments=()))
    return pieces
