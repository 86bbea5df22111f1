"""A fit of recordings whose tracks are rough, as an ordinary fit: the tracks are integrated out of its errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from srfcli.inference.fit import Fit, Problem, RunFit
from srfcli.inference.latent import Latent, LatentFit, fit_latent
from srfcli.inference.noise import estimate_noise, stretches, white_level
from srfcli.inference.tracks import Roughness, tracks_for
from srfcli.status import Status

SURELY = 2.0  # in log likelihood, by which one track for all runs has to be likelier than one for each


@dataclass(frozen=True)
class RoughFit:
    """A fit on rough tracks, what the tracks are like, and whether all runs slid on the same one."""

    fit: Fit
    roughness: Roughness
    shared: bool


def fit_rough(problem: Problem, plain: Fit, *, progress: Callable[[str], None] = lambda text: None) -> RoughFit:
    """Return the fit in which mu0 wanders along each run's own track, or along one that all share if that is likelier.

    The problem's model has the table ("mu", "slip"); `plain` is the fit on smooth tracks that it starts from. Held-out runs are
    judged on the track that all share, else on smooth ones: nothing is known of theirs.
    """
    progress("rough tracks, one for each run")
    theta = problem.start.copy()
    for i, name in enumerate(problem.names):
        theta[i] = plain.values[name]
    noise = {r.name: r.noise for r in plain.runs if not r.holdout}
    found = fit_latent(problem, theta, noise)
    evaluations = plain.evaluations + found.evaluations
    if len(problem.runs) > 1 and found.point.roughness.amplitude:
        progress("one rough track for all runs")
        tracks = tracks_for(problem.runs, shared=True)
        one = fit_latent(problem, found.point.theta, found.noise, tracks=tracks, roughness=found.point.roughness)
        evaluations += one.evaluations
        if one.log_likelihood > found.log_likelihood + SURELY:
            found = one
    runs = tuple(_judged(problem, found, name) for name in (r.name for r in plain.runs))
    fitted = replace(
        plain, values=problem.named(found.point.theta), covariance=found.covariance, runs=runs,
        log_likelihood=found.log_likelihood, status=Status.OK, evaluations=evaluations,
    )  # fmt: skip
    roughness = found.point.roughness
    return RoughFit(fitted, roughness, bool(roughness.amplitude) and found.point.tracks.shared)


def _judged(problem: Problem, found: LatentFit, name: str) -> RunFit:
    run, tracks = next(r for r in problem.experiment.runs if r.name == name), found.point.tracks
    if name not in tracks.of:
        tracks = replace(tracks, of={**tracks.of, name: 0}) if tracks.shared else tracks_for([run], shared=False)
    prediction = Latent(problem).predicted(run, found.point.theta, tracks, slopes=False)
    residual = run.observed - prediction.y
    parts = stretches(run.t, run.used)
    return RunFit(
        name, run.holdout, prediction, residual, parts, estimate_noise(residual, parts), white_level(residual, parts)
    )
