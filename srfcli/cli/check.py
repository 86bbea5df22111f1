"""`srf check`: what is in the recordings of an experiment, what is wrong with them, and what they can tell."""

from __future__ import annotations

import time
from pathlib import Path

import click

from srfcli.cli.base import EXIT_CONDITION, EXIT_OK, SrfCommand
from srfcli.cli.emit import Progress, emit
from srfcli.cli.options import PATH, OutputOptions, open_registry, output_options, plugins_option
from srfcli.core.errors import SrfError, did_you_mean

EXAMPLES = """
srf check experiment/                              sampling, flaws, noise, drive and load of every run
srf check experiment/ --plot check.svg             the runs as figures, flagged samples marked
srf check experiment/ --no-simulate                check the files only, without simulation
srf check experiment/ --fail-on gap --fail-on reset && srf fit experiment/
srf check experiment/ --json | jq .meta.runs       all that was found
"""


@click.command("check", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("experiment", type=PATH)
@click.option("--run", "runs", multiple=True, metavar="NAME", help="Report this run only; may be given several times.")
@click.option("--format", metavar="NAME", help="Reader of all data files; srf laws --kind reader lists them.")
@click.option(
    "--fail-on", multiple=True, metavar="KIND", help="Exit with 4 if there is a notice of this kind; `notice` is any of them."
)
@click.option(
    "--limit",
    type=click.FloatRange(0, min_open=True),
    default=512.0,
    metavar="MB",
    help="Largest recording that is held in memory.",
)
@click.option(
    "--simulate/--no-simulate", default=True, help="Simulate each run to compute the Cramer-Rao bounds of alpha, lambda and n."
)
@plugins_option
@output_options
def command(
    experiment: Path,
    runs: tuple[str, ...],
    format: str | None,
    fail_on: tuple[str, ...],
    limit: float,
    simulate: bool,
    plugins: tuple[Path, ...],
    output: OutputOptions,
) -> int:
    """Read and validate an experiment and report sampling, defects and noise of its recordings.

    Every value of the description is checked against the laws and the data files. For each run: sampling, gaps, spikes, resets,
    quantisation, level and colour of the noise, drive and load as they are in the data, and what the load's variation can tell.
    """
    from srfcli.data.experiment import NOTICE_KINDS, read_experiment
    from srfcli.tasks.recordings import check

    for kind in fail_on:
        if kind not in NOTICE_KINDS and kind != "notice":
            raise SrfError(f"--fail-on {kind}: no such kind of notice", did_you_mean(kind, (*NOTICE_KINDS, "notice")))
    begun, registry = time.perf_counter(), open_registry(plugins)
    read = read_experiment(experiment, registry=registry, format=format, limit=int(limit * 2**20))
    with Progress("check", total=len(read.named(runs))) as progress:
        found = check(read, runs=runs, simulate=simulate, registry=registry, progress=lambda name: progress.advance(note=name))
    table, *more = found.pages if output.format == "text" else (found.table,)
    inputs = [read.path, *dict.fromkeys(one.run.file for one in found.runs)]
    emit(table, output, more=more, figure=found.plot, inputs=inputs, timings={"check": time.perf_counter() - begun})
    kinds = found.notice_kinds
    failed = bool(kinds) if "notice" in fail_on else bool(kinds & set(fail_on))
    return EXIT_CONDITION if failed else EXIT_OK
