"""`fit` of many experiments: a row each, whatever becomes of the others."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.core.errors import SrfError, Status
from srfcli.core.parallel import Runner, run_here
from srfcli.core.units import from_base
from srfcli.data.values import Run
from srfcli.inference.noise import lag_one
from srfcli.laws.registry import load_registry
from srfcli.results.fit import PAIRS, CampaignResult, FitResult
from srfcli.tasks.recordings import fit, read_experiment

STEADY_TAIL = 1 / 3  # of a segment, at its end, that is checked for steady sliding
LONG_ENOUGH = 2.0  # slip lengths that this part must be long
SURE = 3.0  # standard errors from which a slope is significant
DRIFT = 0.02  # of B (A where it is larger) that friction may change by over a slip length in steady sliding
BAD_FIT = 1.3  # residual rms over noise from which the fit is flagged


@dataclass(frozen=True)
class Task:
    """One experiment and how it is fitted; `digest` is of its description and data, so that a changed one is fitted anew."""

    path: str
    options: tuple[tuple[str, Any], ...]
    reader: str | None
    plugins: tuple[str, ...]
    digest: str


def fit_campaign(
    paths: Sequence[str | Path],
    *,
    options: Mapping[str, Any] | None = None,
    reader: str | None = None,
    plugins: Sequence[str | Path] = (),
    run: Runner = run_here,
    done: Callable[[CampaignResult], None] = lambda so_far: None,
) -> CampaignResult:
    """Return the fits of many experiments, a row each in the order of `paths`.

    Parameters
    ----------
    paths : sequence of path
        Folders with an experiment.toml, or these files.
    options : mapping, optional
        Keyword arguments of `fit` for each of them: free, trend, track, starts, seed.
    reader : str, optional
        Reader of all data files.
    plugins : sequence of path
        Folders in which laws and readers are looked for, too.
    run : callable
        Spreads the work, as `srfcli.core.parallel` does; one after the other in this process if left out.
    done : callable
        Told the rows so far after each experiment.

    Returns
    -------
    CampaignResult
        An experiment that cannot be read or fitted has a row with its reason. Ctrl-C keeps the rows that are done.
    """
    tasks = [
        Task(str(p), tuple(sorted((options or {}).items())), reader, tuple(map(str, plugins)), _digest(Path(p))) for p in paths
    ]
    rows: dict[int, dict[str, Any]] = {}

    def so_far(status: Status = Status.OK) -> CampaignResult:
        worst = Status.NO_CONVERGENCE if any(r["status"] != Status.OK.value for r in rows.values()) else Status.OK
        return CampaignResult([rows[k] for k in sorted(rows)], len(tasks), worst if status is Status.OK else status)

    try:
        for index, kept in run(fit_one, tasks):
            rows[index] = json.loads(np.asarray(kept["row"]).tobytes().decode("utf-8"))
            done(so_far())
    except KeyboardInterrupt:
        return so_far(Status.INTERRUPTED)
    return so_far()


def _digest(path: Path) -> str:
    """Return a hash of the description, and of size and time of the files beside it; "" where nothing can be read."""
    file = path / "experiment.toml" if path.is_dir() else path
    try:
        parts = [file.read_bytes()]
        for other in sorted(file.parent.glob("*")):
            told = other.stat()
            parts.append(f"{other.name} {told.st_size} {told.st_mtime_ns}".encode())
    except OSError:
        return ""
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


def fit_one(task: Task) -> dict[str, Any]:
    """Return the row of one experiment as JSON in an array of bytes, as stores and workers carry it."""
    try:
        registry = load_registry([Path(p) for p in task.plugins])
        experiment = read_experiment(task.path, format=task.reader, registry=registry)
        experiment.check_recorded("for a row")
        found = fit(experiment, registry=registry, **dict(task.options))
        if found.worst is Status.INTERRUPTED:
            raise KeyboardInterrupt
        row = _row(task.path, found)
    except SrfError as error:
        row = _failed(task.path, error.message)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        row = _failed(task.path, f"nothing can be computed at these values: {' '.join(str(error).split())[:200]}")
    except Exception as error:  # one experiment must not cost the others
        row = _failed(task.path, f"unexpected {type(error).__name__}: {' '.join(str(error).split())[:200]}")
    return {"row": np.frombuffer(json.dumps(row).encode("utf-8"), dtype=np.uint8)}


def _failed(path: str, reason: str) -> dict[str, Any]:
    return {"experiment": path, "status": "failed", "reason": reason}


def _row(path: str, found: FitResult) -> dict[str, Any]:
    experiment, problem, result = found.experiment, found.found.problem, found.found.fit
    runs = [run for run in experiment.runs if not run.holdout]
    table = {row[0]: row for row in found.table.rows}
    listed = {q.name for q in experiment.parameters}
    own = [name for name in result.names if name in listed]
    parameters = {name: (table[name][1], _number(table[name][2]), table[name][5]) for name in own}
    values = found.values_with_means
    for name, mean, error, _, unit, _ in found.varied.rows if found.varied else ():  # without an error where one is at its bound
        shown = from_base(values[name], unit) if mean is None else mean
        parameters[name] = (shown, _number(error), unit)
    place = {name: k for k, name in enumerate(result.names)}
    covariance = np.asarray(result.covariance)
    unit, factor = experiment.shown("1/um" if experiment.per_load else "N/um")

    def shared(a: str, b: str) -> float | None:
        if not {a, b} <= place.keys():
            return None
        scale = math.prod([factor if name == "K" else from_base(1.0, problem.unit_of(name)) for name in (a, b)])
        return _number(float(covariance[place[a], place[b]]) * scale)

    row: dict[str, Any] = {
        "experiment": path, "status": found.worst.value, "law": f"{experiment.choice.law}, {experiment.choice.ageing}",
        "runs": len(runs), "samples": sum(int(run.used.sum()) for run in runs),
        "load": float(np.mean([run.load(run.t)[0].mean() for run in runs])), "load_unit": runs[0].load_unit,
        "parameters": parameters, "rms_over_noise": _number(result.rms_over_noise()),
        "covariances": {name: shared(*pair) for name, pair in PAIRS.items()},
    }  # fmt: skip
    row["V0"] = next((q.value for q in experiment.parameters if q.name == "V0"), None)
    V = np.concatenate([np.abs(run.drive(run.t)) for run in runs])
    row |= {"V_min": float(V.min()), "V_max": float(V.max())}
    if found.difference is not None:
        row["A_minus_B"], row["A_minus_B_stderr"] = found.difference
    own_stiffness = runs[0].stiffness / (runs[0].first_load if experiment.per_load else 1.0)
    stated = float(values.get("K", own_stiffness))
    row |= {"k": stated * factor, "k_unit": unit, "k_stderr": parameters["K"][1] if "K" in parameters else None}
    length = float(values.get("D0", 10.0))
    allowed = DRIFT * max(abs(values.get("A", 0.0)), abs(values.get("B", 0.0))) / length
    found_slopes = [s for run in runs for s in _slopes(run, length)]
    steady = [not (abs(slope) > SURE * error and abs(slope) > allowed) for slope, error in found_slopes]
    sure = [slope for slope, error in found_slopes if abs(slope) > SURE * error]
    row |= {"segments": len(steady), "steady": sum(steady), "final_slope": 1e3 * max(sure, key=abs) if sure else None}
    row["flags"] = "; ".join(_flags(row, found))
    return row


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None


def _flags(row: Mapping[str, Any], found: FitResult) -> Iterator[str]:
    if not found.worst.ok:
        yield "the maximum was not reached"
    yield from (f"{line[0]} {line[-1]}" for line in found.table.rows if line[-1])
    yield from found.against
    for name, scatter in found.found.scatter.items():
        apart = f", which scatter by {scatter.scatter / abs(scatter.mean):.0%} beyond their errors" if scatter else ""
        yield f"{name} is the mean of {len(found.found.problem.groups[name])} groups{apart}"
    if row["steady"] < row["segments"]:
        yield f"friction still changes with slip at the end of {row['segments'] - row['steady']} of {row['segments']} segments"
    if not row["segments"]:
        yield "no segment is long enough to say whether it ends in steady sliding"
    if row["rms_over_noise"] is not None and row["rms_over_noise"] > BAD_FIT:
        yield f"residual {row['rms_over_noise']:.2g} times the noise"


def _slopes(run: Run, length: float) -> Iterator[tuple[float, float]]:
    """Yield d mu/d slip (1/um) and its error for the end of each segment of constant velocity that is long enough."""
    mu = run.friction
    for begin, end in pairwise(run.edges):
        V, rate, _ = run.drive.piece(begin)
        part = (run.t >= end - STEADY_TAIL * (end - begin)) & (run.t <= end) & run.used
        if rate or V <= 0 or V * STEADY_TAIL * (end - begin) < LONG_ENOUGH * length or part.sum() < 16:
            continue
        x = V * (run.t[part] - run.t[part].mean())
        y = mu[part] - mu[part].mean()
        slope = float(x @ y / (x @ x))
        rest = y - slope * x
        rho = float(np.clip(lag_one(rest, [(0, rest.size)]), 0.0, 0.99))
        error = float(np.sqrt(rest @ rest / (rest.size - 2) / (x @ x) * (1 + rho) / (1 - rho)))
        yield slope, error
