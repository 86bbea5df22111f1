"""An experiment as a folder: `experiment.toml` and one CSV file per run, written whole or not at all."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from srfcli.core.errors import SrfError
from srfcli.core.files import SIDECAR, check_folder_place, clear, parse_toml, read_text, toml_lines, unused_name, whole_folder
from srfcli.core.units import find_unit
from srfcli.data.description import DESCRIPTION, LARGEST_DESCRIPTION, MODULATION
from srfcli.data.thresholds import thresholds_csv
from srfcli.data.values import OBSERVABLES, OTHER_OBSERVABLES, Experiment, FitParameter, Run
from srfcli.motion.imposed import Drive

KILOGRAM = 1e-6  # N s^2/um


def write_experiment(
    experiment: Experiment, folder: Path, *, force: bool = False, sidecar: Callable[[bytes], str] | None = None
) -> tuple[Path, ...]:
    """Write `experiment` to `folder`, so that `read_experiment` finds its values again, and return the files.

    Times, loads and observables keep every digit. A drive of steps is written as a list, any other as the mean velocity from
    each sample to the next, which keeps the displacement at every sample. With `force` an experiment that is there already is
    replaced, but nothing else is.
    `sidecar` makes that of the description from its content. Raises SrfError for what cannot be written; the folder is whole or
    absent.
    """
    files = experiment_files(experiment)
    beside = {} if sidecar is None else {DESCRIPTION + SIDECAR: sidecar(files[DESCRIPTION].encode("utf-8"))}
    return write_folder(files | beside, folder, force=force)[: len(files)]


def experiment_files(experiment: Experiment) -> dict[str, str]:
    """Return the files of an experiment folder, name -> text."""
    if not (experiment.runs or experiment.thresholds):
        raise SrfError("an experiment without runs cannot be written", "give it one run or more")
    texts = [*map(run_csv, experiment.runs), *(thresholds_csv(t.table) for t in experiment.thresholds)]
    names: list[str] = []
    for name in (*(run.name for run in experiment.runs), *(table.name for table in experiment.thresholds)):
        stem = re.sub(r"[^\w.-]+", "-", name, flags=re.ASCII).strip("-.") or "run"
        names.append(unused_name(stem, ".csv", names))  # none twice even where case does not count
    return {DESCRIPTION: _description(experiment, names), **dict(zip(names, texts, strict=True))}


def check_folder(folder: Path, *, force: bool) -> None:
    """Raise SrfError now if an experiment could not be written to `folder` later."""
    if not check_folder_place(folder):
        return
    clear(folder)
    strangers = sorted(p.name for p in folder.iterdir() if p.name not in _own_files(folder))
    if strangers:
        raise SrfError(
            f"{folder} holds {strangers[0]!r}, which is no part of an experiment", "It is never replaced; name another."
        )
    if not force and any(folder.iterdir()):
        raise SrfError(f"{folder} exists already", "Replace the experiment with --force, or name another folder.")


def _own_files(folder: Path) -> set[str]:
    """Return the names that belong to the experiment in `folder`: the description, the files of its runs, sidecars."""
    try:
        data = parse_toml(read_text(folder / DESCRIPTION, limit=LARGEST_DESCRIPTION), folder)
    except (OSError, SrfError):
        return set()
    if not str(data.get("format", "")).startswith("srf-experiment/"):
        return set()
    parts = [part for key in ("runs", "thresholds") if isinstance(listed := data.get(key), list) for part in listed]
    listed = [part.get("file") for part in parts if isinstance(part, dict)]
    names = {DESCRIPTION, *(name for name in listed if isinstance(name, str))}
    return names | {name + SIDECAR for name in names}


def write_folder(files: Mapping[str, str], folder: Path, *, force: bool = False) -> tuple[Path, ...]:
    """Write text files, name -> text, as the whole content of `folder`: beside its place first, then moved there."""
    check_folder(folder, force=force)
    with whole_folder(folder, lambda: check_folder(folder, force=force)) as fresh:
        for name, text in files.items():
            with (fresh / name).open("w", encoding="utf-8", newline="\n") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
    return tuple(folder / name for name in files)


def run_csv(run: Run) -> str:
    """Return the recording of one run as CSV: time, load-point velocity, normal load and all observables, in full precision.

    A sample that is not to be compared becomes an empty cell.
    """
    V, (W, _) = run.drive(run.t), run.load(run.t)
    if any(run.drive.accelerations):
        V[:-1] = np.diff(run.drive.displacement(run.t)) / np.diff(run.t)
    columns = [run.t, V, W]
    texts: list[Iterable[str]] = [map(repr, column.tolist()) for column in columns]
    header = ["time [s]", "load_point_velocity [um/s]", "normal_stress [MPa]" if run.stress else "normal_load [N]"]
    for signal, name in zip(run.signals, observables(run), strict=True):
        header.append(f"{name} [{run.unit_of(signal.observable)}]")
        texts.append(repr(y) if used else "" for y, used in zip(signal.observed.tolist(), signal.used.tolist(), strict=True))
    return "\n".join([",".join(header), *map(",".join, zip(*texts, strict=True))]) + "\n"


def observables(run: Run) -> list[str]:
    """Return the names of a run's columns of observables."""
    for signal in run.signals:
        if signal.observable not in OBSERVABLES | OTHER_OBSERVABLES:
            known = ", ".join(OBSERVABLES | OTHER_OBSERVABLES)
            raise SrfError(f"run {run.name!r} records {signal.observable!r}", f"known: {known}")
    return ["shear_stress" if run.stress and s.observable == "force" else s.observable for s in run.signals]


def _description(experiment: Experiment, files: list[str]) -> str:
    choice = experiment.choice
    head = {"format": "srf-experiment/1", "title": experiment.title}
    apparatus = {"stiffness": as_recorded(experiment.stiffness_text, experiment)}
    if experiment.mass:
        apparatus["mass"] = f"{shortest(experiment.mass, KILOGRAM)!r} kg"
    model = {"law": choice.law, "ageing": choice.ageing, "interface": choice.interface, "inertia": choice.inertia}
    if choice.effects:
        model["effects"] = choice.effects
    lines = [*toml_lines(head), "", "[apparatus]", *toml_lines(apparatus), "", "[model]", *toml_lines(model)]
    if experiment.parameters:
        lines += ["", "[parameters]", *toml_lines({p.name: parameter_table(p) for p in experiment.parameters})]
    for run, file in zip(experiment.runs, files, strict=False):
        lines += ["", "[[runs]]", *toml_lines(_run(run, file))]
    for table, file in zip(experiment.thresholds, files[len(experiment.runs) :], strict=True):
        own = {"name": table.name, "file": file, "holdout": table.holdout, "frequency": float(table.frequency)}
        lines += ["", "[[thresholds]]", *toml_lines(own)]
    return "\n".join(lines) + "\n"


def parameter_table(p: FitParameter, unit: str = "") -> dict[str, object]:
    """Return a parameter as [parameters] has it, in `unit` if that is not the one it is declared in."""
    factor = find_unit(unit or p.unit).factor
    cells = {"value": p.value, "lower": p.lower, "upper": p.upper}
    stated: dict[str, object] = {name: shortest(value, factor) for name, value in cells.items() if np.isfinite(value)}
    stated |= {"fixed": True} if p.fixed else {}
    return stated | ({"runs": p.runs, "elsewhere": shortest(p.elsewhere, factor)} if p.runs else {})


def _run(run: Run, file: str) -> dict[str, object]:
    table: dict[str, object] = {"name": run.name, "file": file, "holdout": run.holdout}
    if run.start:
        table["start"] = float(run.start)
    if run.initial != "steady":
        table["initial"] = run.initial
    if not any(run.drive.accelerations):
        table["drive"] = [{"duration": d, "velocity": V} for d, V in drive_steps(run.drive, run.t)]
    if run.others:
        table["observables"] = observables(run)
    if run.modulation is not None:
        table["modulation"] = dict(zip(MODULATION, map(float, run.modulation), strict=False))
    return table


def drive_steps(drive: Drive, t: np.ndarray) -> list[tuple[float, float]]:
    """Return a drive of constant pieces over [t[0], t[-1]] as (duration, velocity), the form of experiment.toml."""
    start, end = float(t[0]), float(t[-1])
    edges = [start, *(b for b in drive.breaks if start < b < end), end]
    steps, reached = [], start
    for a, b in pairwise(edges):
        duration = shortest(b - reached, 1.0, slack=1e-13)  # without the digits that subtraction rounded
        if b == end:
            while reached + duration < end:  # rounding must not leave the last sample without a drive
                duration = float(np.nextafter(duration, np.inf))
        steps.append((duration, float(drive.piece(0.5 * (a + b))[0])))
        reached += duration
    return steps


def stiffness_text(K: float) -> str:
    """Return a stiffness in N/um as experiment.toml says it."""
    return f"{shortest(K, 1.0)!r} N/um"


def as_recorded(text: str, experiment: Experiment) -> str:
    """Return a stiffness in N/um as one in MPa/um where stresses are recorded, beside which a force would be refused."""
    return text.replace(" N/um", " MPa/um") if experiment.stress else text


def shortest(value: float, factor: float, *, slack: float = 0.0) -> float:
    """Return the number of fewest digits that times `factor` is `value`, to the last bit or to `slack` relative."""
    for digits in range(12, 18):
        number = float(f"{value / factor:.{digits}g}")
        if abs(number * factor - value) <= slack * abs(value):
            return number
    return value / factor
