"""The fit of an experiment's recordings as `srf fit` makes it: which likelihood, which starts, whose random friction field."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from srfcli.errors import SrfError
from srfcli.inference.fit import Fit, Interrupted, Problem, fit_problem, held_fit
from srfcli.inference.rough import ALIKE, SURELY, SharedFit, fit_shared, shared_field
from srfcli.inference.starts import fit_from_several
from srfcli.inference.statespace import StateSpaceFit, as_fit, fit_state_space, stopped
from srfcli.model import open_model
from srfcli.numerics.collocation import Array
from srfcli.numerics.compiled import compiler
from srfcli.recording.values import Experiment
from srfcli.registry import Registry
from srfcli.status import Status


@dataclass(frozen=True)
class Track:
    """The random friction field that was found: its amplitude (1), correlation length (um), one for all runs or for each.

    Amplitude 0 where there is none.
    """

    amplitude: float = 0.0
    length_um: float = 0.0
    shared: bool = False

    def __str__(self) -> str:
        """Return one line on it."""
        if not self.amplitude:
            return "friction field: none is needed"
        whose = "one for all runs" if self.shared else "each run has its own"
        return f"friction field: mu0 wanders by {self.amplitude:.2g} (standard deviation) over {self.length_um:.2g} um; {whose}"


@dataclass(frozen=True)
class RecordingFit:
    """A fit with what is beside it: the state-space likelihood where that was maximised, the field, how each start ended."""

    problem: Problem
    fit: Fit
    state_space: StateSpaceFit | None
    track: Track | None
    starts: tuple[tuple[float, bool], ...]
    status: Status


def fit_recordings(
    registry: Registry,
    experiment: Experiment,
    *,
    free: Sequence[str] | None = None,
    trend: str | None = None,
    track: str | None = None,
    ask_shared: bool = True,
    starts: int = 1,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> RecordingFit:
    """Return the maximum-likelihood fit of all runs together.

    `track` is "smooth" for no random friction field, "rough" for one in each run, "shared" for one that all runs share; left out,
    the recordings decide, whether it is shared only with `ask_shared`. Without a C compiler there is no field, and noise is
    autoregressive. A fit stopped by Ctrl-C is a status; SrfError is raised for what cannot be fitted.
    """
    if compiler() is None:
        return _without_compiler(registry, experiment, free, trend, track, starts, seed, progress)
    model = open_model(registry, **asdict(experiment.choice), random_field=True)
    problem = fit_problem(model, experiment, free=free, trend=trend)
    threads = min(len(problem.runs), os.cpu_count() or 1)
    smooth = None if track is None else track == "smooth"

    def one(start: Array, report: Callable[[str], None]) -> tuple[Fit, Any]:
        moved = replace(problem, start=start)
        found = fit_state_space(moved, smooth=smooth, threads=threads, progress=report)
        return as_fit(found), found

    try:
        several = fit_from_several(problem, fitter=one, count=starts, seed=seed, progress=progress)
    except Interrupted as error:
        found = stopped(problem, error.values, threads=threads)
        return RecordingFit(problem, as_fit(found), found, _track(found), (), Status.INTERRUPTED)
    found, status = several.beside, Status.INTERRUPTED if several.interrupted else several.best.status
    result = RecordingFit(problem, several.best, found, _track(found), tuple(several.rows), status)
    if several.interrupted or len(problem.runs) < 2:
        return result
    try:
        if not (track == "shared" or (ask_shared and track is None and shared_field(found) > ALIKE)):
            return result
        tabled = open_model(registry, **asdict(experiment.choice), tables=(("mu", "slip"),))
        shared = fit_shared(replace(problem, model=tabled), several.best, progress=progress)
    except KeyboardInterrupt:
        return replace(result, status=Status.INTERRUPTED)
    if track is None and shared.fit.log_likelihood < several.best.log_likelihood + SURELY:
        return result
    return replace(result, fit=shared.fit, state_space=None, track=_shared(shared), status=shared.fit.status)


def _track(found: StateSpaceFit) -> Track:
    values = found.values
    return Track() if found.smooth else Track(values["field_amplitude"], values["field_length"])


def _shared(found: SharedFit) -> Track:
    roughness = found.roughness
    return Track(roughness.amplitude, roughness.length, True) if roughness.amplitude else Track()


def _without_compiler(
    registry: Registry,
    experiment: Experiment,
    free: Sequence[str] | None,
    trend: str | None,
    track: str | None,
    starts: int,
    seed: int,
    progress: Callable[[str], None],
) -> RecordingFit:
    """Return the fit of the free-running model, with autoregressive noise."""
    if track in ("rough", "shared"):
        raise SrfError(f"--track {track} needs a C compiler", "Install one, or the package ziglang.")
    model = open_model(registry, **asdict(experiment.choice))
    problem = fit_problem(model, experiment, free=free, trend=trend)
    try:
        several = fit_from_several(problem, count=starts, seed=seed, progress=progress)
    except Interrupted as error:
        return RecordingFit(problem, held_fit(problem, error.values), None, None, (), Status.INTERRUPTED)
    status = Status.INTERRUPTED if several.interrupted else several.best.status
    return RecordingFit(problem, several.best, None, None, tuple(several.rows), status)
