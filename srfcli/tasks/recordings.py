"""Recordings: read, and fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from srfcli.core.errors import SrfError, Status
from srfcli.data import experiment as description
from srfcli.data.values import Experiment
from srfcli.inference import posterior as posteriors
from srfcli.inference.recordings import fit_recordings
from srfcli.laws.registry import Registry, load_registry
from srfcli.results.fit import FitResult

if TYPE_CHECKING:
    from srfcli.inference.posterior import Interval, Posterior


def read_experiment(
    path: str | Path,
    *,
    format: str | None = None,
    holdout: bool = True,
    plugins: Sequence[str | Path] = (),
    registry: Registry | None = None,
) -> Experiment:
    """Return an experiment: its runs, its apparatus, the model that is believed, and the parameters that are free.

    Parameters
    ----------
    path : str or path
        A folder with an experiment.toml, or that file.
    format : str, optional
        Reader of all data files; each is told from its name and content if left out.
    holdout : bool
        Whether runs that are held out are read, too.
    plugins : sequence of path
        Folders in which laws and readers are looked for, too.
    registry : Registry, optional
        Laws and readers, where they are at hand already.

    Returns
    -------
    Experiment
        All numbers in um, s, N.

    Raises
    ------
    SrfError
        For what is missing, contradictory or unreadable, with the file and the line or column.
    """
    known = registry or load_registry([Path(p) for p in plugins])
    return description.read_experiment(Path(path), registry=known, format=format, holdout=holdout)


def fit(
    experiment: Experiment,
    *,
    free: Sequence[str] | None = None,
    trend: str | None = None,
    track: str | None = None,
    starts: int = 1,
    profile: bool = False,
    sample: int | None = None,
    seed: int = 0,
    registry: Registry | None = None,
    progress: Callable[[str, str, float | None], None] = lambda stage, text, share: None,
) -> FitResult:
    """Return the maximum-likelihood fit of an experiment's model to its recordings, all runs together.

    The gauge's noise, its level and colour, and a random friction field along slip are estimated with the parameters and count
    in their errors.

    Parameters
    ----------
    experiment : Experiment
        From `srfcli.read_experiment`.
    free : sequence of str, optional
        Parameters to fit; those that the experiment leaves free if left out.
    trend : {'slip', 'time'}, optional
        Let each run's observable drift.
    track : {'smooth', 'rough', 'shared'}, optional
        Random friction field along slip: none, one for each run, one for all; the recordings decide if left out.
    starts : int
        Starting points to fit from.
    profile : bool
        Whether the intervals are those of the profile likelihood.
    sample : int, optional
        How many points of the posterior are drawn, with emcee.
    seed : int
        Of further starts and of the sampler.
    registry : Registry, optional
        Laws, where they are at hand already.
    progress : callable
        Told the stage (fit, profile, sample), what is done, and which share of the stage where that is known.

    Returns
    -------
    FitResult
        Ctrl-C is a status: the likeliest parameters so far.

    Raises
    ------
    SrfError
        For what cannot be fitted.
    """
    if track == "shared" and (profile or sample):
        raise SrfError("`track` shared does not go with `profile` or `sample`", "Leave it out, or name rough.")
    found = fit_recordings(
        registry or load_registry(), experiment, free=free, trend=trend, track=track,
        ask_shared=not (profile or sample), starts=starts, seed=seed, progress=lambda text: progress("fit", text, None),
    )  # fmt: skip
    status = found.status
    intervals: list[Interval] = []
    posterior: Posterior | None = None
    try:
        if profile and status is not Status.INTERRUPTED:
            names = found.problem.names
            for k, name in enumerate(names):

                def told(text: str, done: float = k / len(names)) -> None:
                    progress("profile", text, done)

                intervals.append(
                    posteriors.profile(found.problem, found.fit, name, rough=found.state_space, progress=told)
                )
        if sample and status is not Status.INTERRUPTED:
            posterior = posteriors.sample(
                found.problem, found.fit, sample, rough=found.state_space, seed=seed,
                progress=lambda text, share: progress("sample", text, share),
            )  # fmt: skip
            status = Status.INTERRUPTED if posterior.interrupted else status
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    return FitResult(found, tuple(intervals), posterior, starts, status)
