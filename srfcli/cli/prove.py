"""`srf prove`: sealed cases are diagnosed blind, then the seal is broken and the answers are marked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from srfcli.cli.base import EXIT_INTERRUPTED, Session, SrfCommand
from srfcli.cli.emit import Progress, emit
from srfcli.cli.options import PATH, POSITIVE, OutputOptions, plugins_option
from srfcli.core.errors import SrfError

EXAMPLES = """
srf prove --out proof                                      ten cases: a first look, some twenty minutes
srf prove --cases 200 --seed 4 --workers 0 --out proof     two hundred cases on all cores
srf prove --out proof --resume                             go on with what was interrupted
srf prove --cases 40 --kind none --out nulls               false alarms alone
srf prove --cases 40 --track rough --out rough             a random friction field of each run's own
srf prove --bank wide --cases 60 --workers 0 --out wide    rock, micro-tribometers, other laws, protocols and noise, too
srf prove --report-only proof --json | jq .meta.rates      the tables again
"""
CASE_KINDS = ("none", "single", "pair", "outside", "ageing", "one-run")
BANKS = ("paper", "wide")
TRACK_KINDS = ("smooth", "rough", "shared")


@click.command("prove", cls=SrfCommand, epilog=EXAMPLES)
@click.option("--cases", type=click.IntRange(1, 100_000), help="How many cases to make.  [default: 10]")
@click.option("--seed", type=click.IntRange(0), help="Seed of the cases. Who knows it can compute the truths.  [default: 1]")
@click.option(
    "--kind",
    "kinds",
    multiple=True,
    type=click.Choice(CASE_KINDS),
    help="Make cases of this kind only; may be given several times. ageing and one-run are in the wide bank.",
)
@click.option(
    "--bank",
    type=click.Choice(BANKS),
    help="What cases are like: the paper's apparatus, protocol and law, or a wide choice of each.  [default: paper]",
)
@click.option(
    "--track",
    type=click.Choice(TRACK_KINDS),
    help="Random friction field of the cases: none, one that all runs share, or one of each run's own.",
)
@click.option("--workers", type=click.IntRange(0, 4096), default=1, help="Processes, 0 for all cores.")
@click.option("--out", metavar="DIR", type=PATH, help="New folder for bank, answers and report.")
@click.option("--resume", is_flag=True, help="Go on with the trial in --out.")
@click.option("--report-only", metavar="DIR", type=PATH, help="Diagnose nothing; mark the answers in DIR again.")
@click.option("--unfinished", is_flag=True, help="Give up the cases without an answer: the trial ends here.")
@click.option("--limit", type=POSITIVE, default=30.0, metavar="MINUTES", help="CPU time after which a case has failed.")
@plugins_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON, in full precision.")
@click.option("--csv", "as_csv", is_flag=True, help="Print the marks as CSV, one case a line.")
def command(out: Path | None, report_only: Path | None, as_json: bool, as_csv: bool, **asked: Any) -> None:
    """Test the diagnosis on synthetic experiments whose truth is sealed until the last answer.

    Makes a bank of concealed cases by equations and a solver of its own, prints the digest of the truths, and diagnoses
    every case from its folder alone. When all are answered it verifies the seal, reads the truths, and prints what was
    right, with intervals. Each answer is kept as it comes.
    """
    from srfcli.validation.trials import prove

    if as_json and as_csv:
        raise SrfError("--json and --csv exclude each other", "--report-only prints the other at no cost.")
    folder = report_only if out is None else out
    if folder is None or (out is not None and report_only is not None):
        said = "neither --out nor --report-only is given" if out is None else "--out and --report-only exclude each other"
        raise SrfError(said, "srf prove --out DIR makes a trial, srf prove --report-only DIR reads one.")
    session = Session.current()
    with Progress("prove") as progress:

        def told(stage: str, text: str, total: int | None) -> None:
            progress.stage(stage, total)
            if stage == "sealed":
                session.say(text)
            elif text:
                progress.advance(note=text)

        try:
            found = prove(folder, **asked, report_only=out is None, progress=told)
        except KeyboardInterrupt:
            if out is None:
                raise
            click.echo(f"Interrupted: the answers so far are kept.\nTry: srf prove --out {out} --resume", err=True)
            raise click.exceptions.Exit(EXIT_INTERRUPTED) from None
    found.write(arguments=session.arguments, told=session.say)
    format = "json" if as_json else "csv" if as_csv else "text"
    emit(found.cases if as_csv else found.table, OutputOptions(format), more=found.more)
