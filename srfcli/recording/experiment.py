"""An experiment, read and validated: the public door to recordings."""

from __future__ import annotations

from pathlib import Path

from srfcli.recording.choice import read_choice, read_parameters
from srfcli.recording.columns import LIMIT
from srfcli.recording.description import RunDescription, read_description
from srfcli.recording.run import read_run
from srfcli.recording.values import Array, Experiment, FitParameter, ModelChoice, Notice, Run
from srfcli.registry import Registry

__all__ = ["Array", "Experiment", "FitParameter", "ModelChoice", "Notice", "Run", "read_experiment"]


def read_experiment(
    path: Path,
    *,
    registry: Registry,
    format: str | None = None,
    holdout: bool = True,
    limit: int = LIMIT,
) -> Experiment:
    """Return the experiment in the folder or TOML file `path`, every value checked, in um, s, N.

    `format` names the reader of all data files; `holdout=False` leaves held-out runs out and their files unopened; `limit` is
    how many bytes of needed columns one run may hold. A breach raises SrfError with file, line or column, what was found and
    what was expected; what is odd but can be handled is in the notices.
    """
    described = read_description(Path(path))
    choice, known = read_choice(described.model, described.apparatus, registry)
    parameters, notices = read_parameters(described.parameters, known, choice)

    def read(run: RunDescription) -> Run:
        return read_run(run, described.apparatus, described.columns, registry=registry, format=format, limit=limit)

    runs = tuple(read(run) for run in described.runs if holdout or not run.holdout)
    return Experiment(
        described.path,
        described.title,
        choice,
        described.apparatus.mass,
        described.apparatus.text,
        parameters,
        runs,
        notices,
        described.apparatus.stated,
    )
