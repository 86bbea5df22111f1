"""A fit of recordings whose runs slid on one and the same rough track, which is integrated out of its errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from srfcli.inference.fit import Fit, Problem, RunFit
from srfcli.inference.latent import Latent, LatentFit, fit_latent
from srfcli.inference.noise import Noise, estimate_noise, stretches, white_level
from srfcli.inference.statespace import StateSpaceFit
from srfcli.inference.tracks import Roughness, tracks_for
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Run
from srfcli.status import Status

SURELY = 2.0  # in log likelihood, by which one track for all runs has to be likelier than one for each
ALIKE = 0.5  # mean correlation of the fields of two runs from which one field for all is fitted


@dataclass(frozen=True)
class SharedFit:
    """A fit in which all runs slid on one track, and what that is like."""

    fit: Fit
    roughness: Roughness


def fit_shared(problem: Problem, begun: Fit, *, progress: Callable[[str], None] = lambda text: None) -> SharedFit:
    """Return the fit in which mu0 wanders along one track that all runs share, from where another fit stands.

    The problem's model has the table ("mu", "slip"). Held-out runs are judged on that track.
    """
    progress("one rough track for all runs")
    theta = np.array([begun.values[name] for name in problem.names])
    noise = {r.name: Noise(r.noise.level) for r in begun.runs if not r.holdout}
    found = fit_latent(problem, theta, noise, tracks=tracks_for(problem.runs, shared=True))
    runs = tuple(_judged(problem, found, name) for name in (r.name for r in begun.runs))
    fitted = replace(
        begun, values=problem.named(found.point.theta), covariance=found.covariance, runs=runs,
        log_likelihood=found.log_likelihood, status=Status.OK, evaluations=begun.evaluations + found.evaluations,
    )  # fmt: skip
    return SharedFit(fitted, found.point.roughness)


def shared_field(found: StateSpaceFit) -> float:
    """Return the mean correlation of the smoothed fields of any two runs over the slip that both have; 0 where none has any."""
    if found.smooth or len(found.likelihood.problem.runs) < 2:
        return 0.0
    point = found.likelihood.at(found.maximum.point.x, slopes=False, keep=True)
    fields = {f.run.name: (f.run, f.smoothed().mean) for f in point.runs}
    states = found.likelihood.problem.model.states
    length = found.values["field_length"]
    products, first, second = 0.0, 0.0, 0.0
    for (a, x), (b, y) in combinations(fields.values(), 2):
        s, r = slip_along(a, x, states), slip_along(b, y, states)
        where = np.arange(max(s[0], r[0]), min(s[-1], r[-1]), 0.5 * length)
        if where.size < 10:
            continue
        m, n = (np.interp(where, place, z[:, states.index("field")]) for place, z in ((s, x), (r, y)))
        m, n = m - m.mean(), n - n.mean()
        products, first, second = products + float(m @ n), first + float(m @ m), second + float(n @ n)
    return products / np.sqrt(first * second) if first and second else 0.0


def slip_along(run: Run, x: Array, states: tuple[str, ...]) -> Array:
    """Return the slip (n,) in um along smoothed states, from the run's start on."""
    v = np.exp(x[:, states.index("ln_v")])
    moved = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(run.t))])
    if "u" in states:  # exact, where stick-slip is faster than the samples
        V, u = run.drive(run.t), x[:, states.index("u")]
        moved = np.concatenate([[0.0], np.cumsum(0.5 * (V[1:] + V[:-1]) * np.diff(run.t))]) - (u - u[0])
    return np.asarray(run.start + moved)


def _judged(problem: Problem, found: LatentFit, name: str) -> RunFit:
    run, tracks = next(r for r in problem.experiment.runs if r.name == name), found.point.tracks
    if name not in tracks.of:
        tracks = replace(tracks, of={**tracks.of, name: 0})
    prediction = Latent(problem).predicted(run, found.point.theta, tracks, slopes=False)
    residual = run.observed - prediction.y
    parts = stretches(run.t, run.used)
    return RunFit(
        name, run.holdout, prediction, residual, parts, estimate_noise(residual, parts), white_level(residual, parts)
    )
