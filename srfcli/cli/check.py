"""`srf check`: what is in the recordings of an experiment, what is wrong with them, and what they can tell."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from srfcli.cli.laws import plugins_option
from srfcli.cli.options import OutputOptions, SrfCommand, output_options
from srfcli.units import split_quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srfcli.inference.reach import Forecast
    from srfcli.output.tables import Table
    from srfcli.recording.checks import RunCheck
    from srfcli.recording.experiment import Experiment
    from srfcli.recording.values import Run
    from srfcli.registry import Registry

EXAMPLES = """
srf check experiment/                              sampling, flaws, noise, drive and load of every run
srf check experiment/ --plot check.svg             the runs as figures, flagged samples marked
srf check experiment/ --no-simulate                what is in the files, and nothing about what it can tell
srf check experiment/ --fail-on gap --fail-on reset && srf fit experiment/
srf check experiment/ --json | jq .meta.runs       all that was found
"""


@click.command("check", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("experiment", type=click.Path(path_type=Path))
@click.option("--run", "names", multiple=True, metavar="NAME", help="Report this run only; may be given several times.")
@click.option("--format", "format", metavar="NAME", help="Reader of all data files; srf laws --kind reader lists them.")
@click.option(
    "--fail-on",
    "fail_on",
    multiple=True,
    metavar="KIND",
    help="Exit with 4 if there is a notice of this kind; `notice` is any of them.",
)
@click.option(
    "--limit",
    type=click.FloatRange(min=0, min_open=True),
    default=512.0,
    show_default=True,
    metavar="MB",
    help="Largest recording that is held in memory.",
)
@click.option(
    "--simulate/--no-simulate",
    "simulate",
    default=True,
    show_default=True,
    help="Simulate each run to say what its load can tell.",
)
@plugins_option
@output_options
def command(
    experiment: Path,
    names: tuple[str, ...],
    format: str | None,
    fail_on: tuple[str, ...],
    limit: float,
    simulate: bool,
    plugins: tuple[Path, ...],
    output: OutputOptions,
) -> int:
    """Read and validate an experiment and report what its recordings are like.

    Every value of the description is checked against the laws and the data files. For each run: sampling, gaps, spikes, resets,
    quantisation, level and colour of the noise, drive and load as they are in the data, and what the load's variation can tell.
    """
    from srfcli.cli.base import EXIT_CONDITION, EXIT_OK
    from srfcli.cli.check_rows import report
    from srfcli.cli.emit import emit
    from srfcli.cli.options import open_registry
    from srfcli.recording.checks import check_run
    from srfcli.recording.experiment import read_experiment

    _check_kinds(fail_on)
    begun, registry = time.perf_counter(), open_registry(plugins)
    found = read_experiment(experiment, registry=registry, format=format, limit=int(limit * 2**20))
    checks = [check_run(run) for run in _chosen(found, names)]
    forecast = _forecast(found, checks, registry) if simulate else None
    table, more = _table(found, checks, forecast), []
    if output.format == "text":
        more = report(table.rows, forecast, load_unit="MPa" if found.stress else "N")
        more[-1] = dataclasses.replace(more[-1], notes=table.notes)
        title = f"{table.title}\n{_model_line(found)}"
        table = dataclasses.replace(table, columns=(), rows=(), notes=(), title=title)
    inputs = [found.path, *dict.fromkeys(check.run.file for check in checks)]
    timings = {"check": time.perf_counter() - begun}
    emit(table, output, more=more, figure=lambda: _figure(found, checks), inputs=inputs, timings=timings)
    kinds = {n.kind for check in checks for n in check.run.notices} | {n.kind for n in found.notices}
    failed = bool(kinds) if "notice" in fail_on else bool(kinds & set(fail_on))
    return EXIT_CONDITION if failed else EXIT_OK


def _check_kinds(fail_on: Sequence[str]) -> None:
    """Raise SrfError for a kind that no notice is of."""
    from srfcli.errors import SrfError, did_you_mean
    from srfcli.recording.checks import KINDS

    for kind in fail_on:
        if kind not in KINDS and kind != "notice":
            raise SrfError(f"--fail-on {kind}: no such kind of notice", did_you_mean(kind, (*KINDS, "notice")))


def _chosen(experiment: Experiment, names: Sequence[str]) -> list[Run]:
    """Return the runs of these names, all where there are none; raises SrfError for a name that no run has."""
    from srfcli.errors import SrfError, did_you_mean

    known = [run.name for run in experiment.runs]
    for name in names:
        if name not in known:
            raise SrfError(f"--run {name}: {experiment.path} has no such run", did_you_mean(name, known))
    return [run for run in experiment.runs if not names or run.name in names]


def _forecast(experiment: Experiment, checks: Sequence[RunCheck], registry: Registry) -> Forecast:
    from srfcli.cli.emit import Progress
    from srfcli.inference.reach import forecast

    with Progress("check", total=len(checks)) as progress:
        return forecast(experiment, checks, registry=registry, progress=lambda name: progress.advance(note=name))


def _model_line(experiment: Experiment) -> str:
    choice = experiment.choice
    mass = "" if experiment.mass is None else f", mass {experiment.mass * 1e6:.6g} kg"
    inertia = "on" if choice.inertia else "off"
    laws = ", ".join([choice.law, choice.ageing, choice.interface, f"inertia {inertia}", *choice.effects])
    return f"{laws}; stiffness {_stiffness(experiment)}{mass}"


def _stiffness(experiment: Experiment) -> str:
    number, base = split_quantity(experiment.stiffness_text, name="stiffness")
    unit, factor = experiment.shown(base) if base in ("N/um", "1/um") else (base, 1.0)
    return f"{number * factor:.6g} {unit}"


def _table(experiment: Experiment, checks: Sequence[RunCheck], forecast: Forecast | None) -> Table:
    from srfcli.cli.check_rows import COLUMNS, described, row, tells
    from srfcli.cli.check_sentences import NOISE, sentences
    from srfcli.output.tables import Table
    from srfcli.recording.values import shown_unit
    from srfcli.units import from_base

    told = [None] * len(checks) if forecast is None else forecast.runs
    notices = [str(n) for n in experiment.notices]
    notices += [f"{check.run.name}: {notice}" for check in checks for notice in check.run.notices]
    notes = [*notices, NOISE, *([] if forecast is None else sentences(forecast))]
    choice = experiment.choice
    together = forecast and forecast.together
    meta = {
        "experiment": str(experiment.path),
        "model": dataclasses.asdict(choice),
        "notices": [{"kind": n.kind, "where": n.where, "what": n.what} for n in experiment.notices],
        "runs": [described(check, one) for check, one in zip(checks, told, strict=True)],
        "together": together and tells(together),
    }
    parameters = {}
    for p in experiment.parameters:
        unit, factor = experiment.shown(p.unit)
        value, low, high = (from_base(x, p.unit) * factor for x in (p.value, p.lower, p.upper))
        origin = "fixed" if p.fixed else f"start, {low:g} to {high:g}"
        parameters[p.name] = {"value": value, "unit": unit, "origin": origin}
    title = experiment.title or experiment.path.parent.name
    rows = [row(check, one) for check, one in zip(checks, told, strict=True)]
    columns = tuple(dataclasses.replace(c, unit=shown_unit(c.unit, stress=experiment.stress)) for c in COLUMNS)
    return Table("srf.check/1", columns, rows, title, tuple(notes), parameters, meta)


def _figure(experiment: Experiment, checks: Sequence[RunCheck]) -> Figure:
    from srfcli.output.recordings import recordings
    from srfcli.output.report_text import unit_text

    runs = []
    for check in checks:
        run, t = check.run, check.run.t
        runs.append(
            {
                "name": run.name,
                "holdout": run.holdout,
                "t": t,
                "observed": run.observed,
                "label": run.quantity + (f"\n[{unit_text(run.unit)}]" if run.unit != "1" else ""),
                "load_unit": run.load_unit,
                "used": run.used,
                "V": run.drive(t),
                "W": run.load(t)[0],
                "gaps": [(t[g], t[g + 1]) for g in check.sampling.gaps.tolist()],
            }
        )
    return recordings(runs, title=experiment.title)
