"""`srf prove`: sealed cases are diagnosed blind, then the seal is broken and the answers are marked."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import EXIT_INTERRUPTED, Session, SrfCommand
from srfcli.cli.emit import Progress, emit
from srfcli.cli.options import PATH, OutputOptions, plugins_option
from srfcli.core.errors import SrfError
from srfcli.results.provenance import Provenance, write_result
from srfcli.results.tables import Table, to_csv, to_json, to_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from srfcli.validation.trials import Trial

EXAMPLES = """
srf prove --out proof                                      ten cases: a first look, some twenty minutes
srf prove --cases 200 --seed 4 --workers 0 --out proof     two hundred cases on all cores
srf prove --out proof --resume                             go on with what was interrupted
srf prove --cases 40 --kind none --out nulls               false alarms alone
srf prove --cases 40 --track rough --out rough             a random friction field of each run's own
srf prove --bank wide --cases 60 --workers 0 --out wide    rock, micro-tribometers, other laws, protocols and noise, too
srf prove --report-only proof --json | jq .meta.rates      the tables again
"""
KINDS = ("none", "single", "pair", "outside", "ageing", "one-run")
BANKS = ("paper", "wide")
TRACKS = ("smooth", "rough", "shared")


@click.command("prove", cls=SrfCommand, epilog=EXAMPLES)
@click.option("--cases", type=click.IntRange(1, 100_000), help="How many cases to make.  [default: 10]")
@click.option("--seed", type=click.IntRange(0), help="Seed of the cases. Who knows it can compute the truths.  [default: 1]")
@click.option(
    "--kind",
    "kinds",
    multiple=True,
    type=click.Choice(KINDS),
    help="Make cases of this kind only; may be given several times. ageing and one-run are in the wide bank.",
)
@click.option(
    "--bank",
    type=click.Choice(BANKS),
    help="What cases are like: the paper's apparatus, protocol and law, or a wide choice of each.  [default: paper]",
)
@click.option(
    "--track",
    type=click.Choice(TRACKS),
    help="Random friction field of the cases: none, one that all runs share, or one of each run's own.",
)
@click.option("--workers", type=click.IntRange(0, 4096), default=1, help="Processes, 0 for all cores.")
@click.option("--out", metavar="DIR", type=PATH, help="New folder for bank, answers and report.")
@click.option("--resume", is_flag=True, help="Go on with the trial in --out.")
@click.option("--report-only", "report", metavar="DIR", type=PATH, help="Diagnose nothing; mark the answers in DIR again.")
@click.option("--unfinished", is_flag=True, help="Give up the cases without an answer: the trial ends here.")
@click.option(
    "--limit",
    type=click.FloatRange(0, min_open=True),
    default=30.0,
    metavar="MINUTES",
    help="CPU time after which a case has failed.",
)
@plugins_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON, in full precision.")
@click.option("--csv", "as_csv", is_flag=True, help="Print the marks as CSV, one case a line.")
def command(
    workers: int,
    out: Path | None,
    report: Path | None,
    unfinished: bool,
    limit: float,
    plugins: tuple[Path, ...],
    as_json: bool,
    as_csv: bool,
    **asked: Any,
) -> None:
    """Test the diagnosis on synthetic experiments whose truth is sealed until the last answer.

    Makes a bank of concealed cases by equations and a solver of its own, prints the digest of the truths, and diagnoses
    every case from its folder alone. When all are answered it verifies the seal, reads the truths, and prints what was
    right, with intervals. Each answer is kept as it comes.
    """
    from srfcli.validation.trials import Trial

    if as_json and as_csv:
        raise SrfError("--json and --csv exclude each other", "--report-only prints the other at no cost.")
    if (out is None) == (report is None):
        said = "neither --out nor --report-only is given" if out is None else "--out and --report-only exclude each other"
        raise SrfError(said, "srf prove --out DIR makes a trial, srf prove --report-only DIR reads one.")
    count = workers or os.cpu_count() or 1
    if out is not None:
        if unfinished:
            raise SrfError("--unfinished ends a trial that was begun", f"srf prove --report-only {out} --unfinished")
        trial = _answered(out, asked, count, limit, plugins)
    else:
        assert report is not None
        for name in ("cases", "seed", "kinds", "bank", "track", "resume"):
            if asked[name] not in (None, ()) and asked[name] is not False:
                raise SrfError(f"--{name.replace('kinds', 'kind')} has no meaning with --report-only", "Leave it out.")
        trial = Trial(report)
        trial.asked()
    _report(trial, count, unfinished, "json" if as_json else "csv" if as_csv else "text")


def _answered(folder: Path, asked: dict[str, Any], workers: int, limit: float, plugins: tuple[Path, ...]) -> Trial:
    """Return the trial with an answer to every case; Ctrl-C ends the command, and what was answered is kept."""
    from srfcli.laws.registry import load_registry
    from srfcli.validation.trials import Trial, answer_all, begin

    if asked["resume"] and not Trial(folder).note.exists():
        raise SrfError(f"{folder}: there is no trial to go on with", "Leave --resume out to begin one.")
    load_registry(plugins)  # a folder that is none must stop the command, not fail every case
    session = Session.current()
    try:
        with Progress("bank") as progress:
            trial = begin(folder, **asked, workers=workers, told=lambda k, n: progress.advance())
        waiting = trial.waiting()
        session.say(f"SHA-256 of the sealed truths: {trial.digest()}")
        with Progress("diagnosed", total=len(waiting)) as progress:
            for answer in answer_all(trial, workers=workers, plugins=plugins, limit=60 * limit):
                progress.advance(note=f"{answer.case} in {answer.cpu:.0f} s of CPU")
    except KeyboardInterrupt:
        click.echo(f"Interrupted: the answers so far are kept.\nTry: srf prove --out {folder} --resume", err=True)
        raise click.exceptions.Exit(EXIT_INTERRUPTED) from None
    return trial


def _report(trial: Trial, workers: int, unfinished: bool, format: str) -> None:
    """Unseal, mark every answer, print the tables and keep them beside the answers."""
    from srfcli.validation.marks import cases, mark, see_all, tables
    from srfcli.validation.trials import open_truths

    truths, answers = open_truths(trial, unfinished=unfinished)
    sights = {}
    with Progress("truth", total=len(truths)) as progress:
        for sight in see_all(trial.bank, truths, workers=workers, kept=trial.folder / "known.jsonl"):
            sights[sight.case] = sight
            progress.advance(note=sight.case)
    marks = [mark(truths[name], answers[name], sights[name]) for name in truths]
    asked = trial.asked()
    table, more = tables(marks, digest=trial.digest(), seed=asked["seed"], of=asked["cases"])
    listed = cases(marks)
    _keep(trial, asked["seed"], table, more, listed)
    emit(listed if format == "csv" else table, OutputOptions(format), more=more)


def _keep(trial: Trial, seed: int, table: Table, more: Sequence[Table], listed: Table) -> None:
    """Write the report beside the answers: for a reader in few digits, for a program in all, and one line per case."""
    text = "\n".join(to_text(t, full=False) for t in [table, *more])
    provenance = Provenance(Session.current().arguments, inputs=(trial.answers, trial.apart), seed=seed)
    for name, content in (("report.txt", text), ("report.json", to_json(table)), ("cases.csv", to_csv(listed))):
        write_result(trial.folder / name, content.encode("utf-8"), provenance)
        Session.current().say(f"Wrote {trial.folder / name}")
