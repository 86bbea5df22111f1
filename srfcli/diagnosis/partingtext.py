"""What is told of the run that would part hypotheses: sentences, plain data, and an experiment for what each foretells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from srfcli.diagnosis.augment import augment
from srfcli.diagnosis.parting import ENOUGH, Parting
from srfcli.diagnosis.verdict import Diagnosis
from srfcli.recording.values import Experiment
from srfcli.recording.writing import DESCRIPTION, experiment_files, run_csv
from srfcli.registry import Registry

FOLDER = "parting"
RUNS, COLUMNS = "\n[[runs]]\n", "\n[columns]\n"


def sentences(found: Parting) -> list[str]:
    """Return what is to be done, what it is worth, and what to look for; or that nothing parts these hypotheses."""
    names, run = _listed([_name(n) for n in found.names]), found.proposal
    if not found.parts:
        return [
            f"Nothing within this apparatus' reach parts {names}: of {found.tried} runs that were tried, the best would gain "
            f"{found.gain:.2g} in log likelihood, and {ENOUGH:g} are wanted. For this apparatus they are one class."
        ]
    return [
        f"What would part {names} is {run.kind}: {run.text()}; sampled at {1 / run.interval:.4g} Hz.",
        f"Whichever of them is true, the others then lose at least {found.gain:.3g} in log likelihood, refitted to all runs. "
        + _long(found),
        _look(found),
    ]


def _long(found: Parting) -> str:
    if found.seconds is None or found.repeats is None:
        return f"No number of repeats of this run gains {ENOUGH:g}: its parameters would have to be known better first."
    if found.repeats > 1:
        return f"{ENOUGH:g} are gained in {found.repeats} such runs, {found.seconds:.3g} s in all."
    return f"{ENOUGH:g} are gained in the first {found.seconds:.3g} s of it."


def _look(found: Parting) -> str:
    """Return where to look, and for how much."""
    first, second = map(_name, found.pair)
    before = [(t, what) for t, what in found.proposal.changes() if t <= found.at]
    since = f", {found.at - before[-1][0]:.2g} s after {before[-1][1]}" if before else ""
    size = f"{abs(found.peak):.2g}{'' if found.unit == '1' else f' {found.unit}'}"
    um = "" if found.unit == "um" else f" ({found.peak_um:.2g} um of the spring's elongation)"
    word = "above" if found.peak > 0 else "below"
    faint = ", less than the noise of one sample: a fit sees it" if abs(found.peak) < found.noise else ""
    return f"They differ most {found.at:.3g} s into it{since}: {first} is then {size}{um} {word} {second}{faint}."


def _name(name: str) -> str:
    return "the baseline" if name == "none" else name


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


def described(found: Parting, experiment: Experiment) -> dict[str, Any]:
    """Return the value of the answer's key `experiment`."""
    return {
        "hypotheses": list(found.names),
        "parts": found.parts,
        "sentences": sentences(found),
        "gain": found.gain,
        "gains": dict(found.gains),
        "seconds": found.seconds,
        "repeats": found.repeats,
        "duration": found.proposal.duration,
        "look": {
            "at": found.at,
            "difference": found.peak,
            "unit": found.unit,
            "um": found.peak_um,
            "of": list(found.pair),
        },
        "run": run_text(found, experiment),
        "tried": found.tried,
    }


def run_text(found: Parting, experiment: Experiment) -> str:
    """Return the run as experiment.toml describes one; its file has times and load, and what a hypothesis foretells."""
    run = replace(found.run, holdout=False)
    description = experiment_files(replace(experiment, runs=(run,)))[DESCRIPTION]
    load = found.proposal.text().partition("; load ")[2]
    return f"[[runs]]\n# load {load}, as the file has it\n{description.rpartition(RUNS)[2]}"


def parting_files(
    registry: Registry, diagnosis: Diagnosis, found: Parting, *, folder: Path, reader: str | None = None
) -> dict[str, str]:
    """Return, by place in `folder`, an experiment for each hypothesis whose one run is the proposed one as it foretells it."""
    files: dict[str, str] = {}
    run = replace(found.run, holdout=False)
    text = run_text(found, diagnosis.experiment)
    for refit in diagnosis.close:
        place = f"{FOLDER}/{refit.name}"
        if refit.name not in found.predicted or f"{place}/{DESCRIPTION}" in files:
            continue
        made = augment(
            registry, diagnosis.experiment, refit.hypothesis, refit.fit, folder=folder / place, reader=reader
        )
        head = made.files[DESCRIPTION].partition(RUNS)[0].partition(COLUMNS)[0]
        files |= {f"{place}/{name}": content for name, content in made.files.items()}
        files[f"{place}/{DESCRIPTION}"] = f"{head.rstrip()}\n\n{text}"
        files[f"{place}/{run.file.name}"] = run_csv(replace(run, observed=found.predicted[refit.name]))
    return files
