"""The folder that `srf diagnose --out` writes: whole or not at all, never over anything but another diagnosis."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli.atomic import recover, whole_folder
from srfcli.cli.base import Session
from srfcli.errors import SrfError
from srfcli.output.files import write_atomic
from srfcli.output.report_text import unit_text
from srfcli.reading import parse_json, read_plain
from srfcli.units import split_quantity

if TYPE_CHECKING:
    from srfcli.diagnosis.answer import RunView
    from srfcli.diagnosis.locate import Location
    from srfcli.diagnosis.parting import Parting
    from srfcli.diagnosis.verdict import Diagnosis
    from srfcli.recording.values import Run
    from srfcli.registry import Registry

ANSWER = "answer.json"
LARGEST = 2**28  # bytes of an answer
FORM = "closed-form.toml"
SCHEMA = "srf.diagnose/"


def check_answer(folder: Path, *, force: bool) -> None:
    """Raise SrfError now if a diagnosis could not be written to `folder` later."""
    recover(folder)
    parent = Path(os.path.realpath(folder)).parent
    if not parent.is_dir():
        raise SrfError(f"--out {folder}: the directory {parent} does not exist", f"Create it: mkdir -p {parent}")
    if not os.access(parent, os.W_OK):
        raise SrfError(
            f"--out {folder}: the directory {parent} is not writable", "Name a folder elsewhere.", exit_code=1
        )
    if not os.path.lexists(folder):
        return
    if not folder.is_dir() or folder.is_symlink():
        raise SrfError(f"--out {folder} exists and is not a folder", "Name another folder.")
    if not any(folder.iterdir()):
        return
    if not _is_diagnosis(folder):
        raise SrfError(f"--out {folder} holds something else than a diagnosis", "It is never replaced; name another.")
    if not force:
        raise SrfError(f"--out {folder} holds a diagnosis already", "Replace it with --force, or name another folder.")


def _is_diagnosis(folder: Path) -> bool:
    try:
        data = parse_json(read_plain(folder / ANSWER, limit=LARGEST), folder)
    except (OSError, SrfError):
        return False
    return isinstance(data, dict) and str(data.get("schema", "")).startswith(SCHEMA)


def write_answer(
    folder: Path,
    found: dict[str, Any],
    diagnosis: Diagnosis,
    location: Location,
    registry: Registry,
    *,
    reader: str | None,
    seed: int,
    seconds: float,
    force: bool = False,
    missing: Mapping[str, Any] | None = None,
    parting: Parting | None = None,
) -> None:
    """Write answer, predictions, augmented experiment, report and figures; of a `missing` force its closed form, as an effect.

    Of a `parting` run an experiment for each hypothesis is written.
    """
    from srfcli.diagnosis.answer import final, material, run_views
    from srfcli.diagnosis.augment import augment
    from srfcli.diagnosis.diagram import stability
    from srfcli.output.provenance import Provenance, write_sidecar
    from srfcli.output.records import json_text
    from srfcli.recording.experiment import read_experiment

    last = final(diagnosis)
    with whole_folder(folder, lambda: check_answer(folder, force=force)) as fresh:  # an hour may have passed
        text = (json_text(found, indent=2) + "\n").encode("utf-8")
        write_atomic(fresh / ANSWER, text)
        runs = diagnosis.experiment.runs
        inputs = (diagnosis.experiment.path, *dict.fromkeys(r.file for r in runs))
        made = Provenance(
            arguments=Session.current().arguments, laws=last.fit.problem.model.laws, inputs=inputs, seed=seed,
            timings={"diagnose": seconds},
        )  # fmt: skip
        write_sidecar(fresh / ANSWER, text, made)
        for name, view in zip(
            prediction_names([v.run.name for v in run_views(diagnosis)]), run_views(diagnosis), strict=True
        ):
            write_atomic(fresh / name, prediction_csv(view))
        augmented = augment(
            registry, diagnosis.experiment, last.hypothesis, last.fit, folder=folder / "augmented", reader=reader
        )
        (fresh / "augmented").mkdir()
        for name, content in augmented.files.items():
            write_atomic(fresh / "augmented" / name, content)
        for name, source in augmented.copies.items():
            shutil.copyfile(source, fresh / "augmented" / name)
        made_of = material(diagnosis, location)
        made_of["diagram"] = stability(
            registry, diagnosis.experiment, diagnosis.baseline.fit.values,
            read_experiment(fresh / "augmented", registry=registry, format=reader),
        )  # fmt: skip
        _in_shown_units(made_of, diagnosis)
        if missing:
            made_of["force"] = missing["force"]
            if missing["toml"] is not None:
                write_atomic(fresh / FORM, missing["toml"])
        if parting is not None:
            made_of["parting"] = _proposed(fresh, folder, found, diagnosis, registry, parting, reader=reader)
        _report(fresh, found, made_of)
    Session.current().say(f"Wrote {folder}")


def _in_shown_units(made_of: dict[str, Any], diagnosis: Diagnosis) -> None:
    """Put what the report shows into the units of the recordings, and add what the user stated and where the runs were made."""
    import numpy as np

    experiment = diagnosis.experiment
    runs = {run.name: run for run in experiment.runs}
    for shown in made_of["runs"]:
        run = runs[shown["name"]]
        unit = f"  [{unit_text(run.unit)}]" if run.unit != "1" else ""
        shown |= {"label": f"{run.quantity}{unit}", "load_unit": run.load_unit}
    for row in made_of["parameters"]:
        row["unit"], factor = experiment.shown(str(row["unit"]))
        for key in ("baseline", "baseline_stderr", "augmented", "augmented_stderr"):
            row[key] = row[key] and row[key] * factor
    number, unit = split_quantity(experiment.stiffness_text, name="stiffness")
    shown_unit, factor = experiment.shown(unit) if unit in ("N/um", "1/um") else (unit, 1.0)
    made_of["stated"] = {"stiffness": f"{number * factor:.4g} {unit_text(shown_unit)}"}
    made_of["own"] = {
        effect.reported: [*(p.name for p in effect.parameters), *effect.frees]
        for ranked in diagnosis.ranked for effect in ranked.hypothesis.effects
    }  # fmt: skip
    if made_of.get("diagram"):
        marks = {(float(f"{V:.3g}"), float(f"{np.mean(r.load(r.t)[0]):.3g}"))
                 for r in experiment.runs for V, share in _velocities(r) if share > 0.1}  # fmt: skip
        made_of["diagram"] |= {"marks": sorted(marks), "load_unit": "MPa" if experiment.stress else "N"}


def _velocities(run: Run) -> list[tuple[float, float]]:
    """Return the velocities at which a run was driven forward, to three digits, and the share of its time for each."""
    import numpy as np

    V, counts = np.unique(
        [float(f"{v:.3g}") for v in run.drive(run.t[:: max(run.t.size // 2000, 1)])], return_counts=True
    )
    return [(float(v), float(c) / float(counts.sum())) for v, c in zip(V, counts, strict=True) if v > 0]


def _proposed(
    fresh: Path, folder: Path, found: Mapping[str, Any], diagnosis: Diagnosis, registry: Registry, parting: Parting, *,
    reader: str | None,
) -> list[str]:  # fmt: skip
    """Write what each hypothesis foretells of the run that would part them, and return what the report says of it."""
    from srfcli.diagnosis.partingtext import parting_files

    told = found["experiment"]
    if not told["parts"]:
        return list(told["sentences"])
    for place, text in parting_files(registry, diagnosis, parting, folder=folder, reader=reader).items():
        (fresh / place).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(fresh / place, text)
    return [*told["sentences"], told["run"]]


def _report(folder: Path, found: dict[str, Any], made: dict[str, Any]) -> None:
    try:
        from srfcli.output.report import write_report

        write_report(folder, found, made)
    except ModuleNotFoundError as error:
        Session.current().say(f"Note: no report and no figures, as {error.name} is not installed")
    except Exception as error:  # minutes of computing are not to be lost for a figure
        if Session.current().debug:
            raise
        Session.current().say(f"Warning: no report: {type(error).__name__}: {error}")


def prediction_names(runs: list[str]) -> list[str]:
    """Return one file name per run, none twice even where case does not count."""
    names: list[str] = []
    for run in runs:
        stem = re.sub(r"[^\w .-]+", "-", run).strip(" .") or "run"
        name, number = f"prediction-{stem}.csv", 2
        while name.lower() in (other.lower() for other in names):
            name, number = f"prediction-{stem}-{number}.csv", number + 1
        names.append(name)
    return names


def prediction_csv(view: RunView) -> str:
    """Return a run as recorded and as predicted by both models, in full precision; empty where there is nothing."""
    import numpy as np

    unit = view.run.unit
    lines = [f"time [s],observed [{unit}],baseline [{unit}],augmented [{unit}]"]
    observed = np.where(view.run.used, view.run.observed, np.nan)
    columns = (view.run.t, observed, view.baseline, view.augmented)
    for row in zip(*(c.tolist() for c in columns), strict=True):
        lines.append(",".join(repr(x) if np.isfinite(x) else "" for x in row))
    return "\n".join(lines) + "\n"
