"""A fit of recordings whose tracks are rough, as an ordinary fit: the tracks are integrated out of its errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from srfcli.inference.fit import Fit, Problem, RunFit
from srfcli.inference.latent import Latent, LatentFit, fit_latent
from srfcli.inference.noise import estimate_noise, stretches, white_level
from srfcli.inference.tracks import Roughness, tracks_for
from srfcli.status import Status


def fit_rough(
    problem: Problem, plain: Fit, *, progress: Callable[[str], None] = lambda text: None
) -> tuple[Fit, Roughness]:
    """Return the fit in which mu0 wanders along each run's own track, and the roughness that was found.

    The problem's model has the table ("mu", "slip"); `plain` is the fit on smooth tracks that it starts from. Held-out runs are
    judged on smooth tracks: nothing is known of theirs.
    """
    progress("rough tracks")
    theta = problem.start.copy()
    for i, name in enumerate(problem.names):
        theta[i] = plain.values[name]
    noise = {r.name: r.noise for r in plain.runs if not r.holdout}
    found = fit_latent(problem, theta, noise)
    runs = tuple(_judged(problem, found, name) for name in (r.name for r in plain.runs))
    fitted = replace(
        plain, values=problem.named(found.point.theta), covariance=found.covariance, runs=runs,
        log_likelihood=found.log_likelihood, status=Status.OK, evaluations=plain.evaluations + found.evaluations,
    )  # fmt: skip
    return fitted, found.point.roughness


def _judged(problem: Problem, found: LatentFit, name: str) -> RunFit:
    run = next(r for r in problem.experiment.runs if r.name == name)
    tracks = found.point.tracks if name in found.point.tracks.of else tracks_for([run], shared=False)
    prediction = Latent(problem).predicted(run, found.point.theta, tracks, slopes=False)
    residual = run.observed - prediction.y
    parts = stretches(run.t, run.used)
    return RunFit(
        name, run.holdout, prediction, residual, parts, estimate_noise(residual, parts), white_level(residual, parts)
    )
