"""`srf diagnose`: which physics a model of recordings lacks, and the model that has it; `srf report`: a page on results."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from srfcli.cli.base import EXIT_INTERRUPTED, Session, SrfCommand
from srfcli.cli.emit import Progress, finish, show
from srfcli.cli.options import PATH, listed, open_registry, plugins_option, reader_option, vary_options
from srfcli.core.errors import SrfError
from srfcli.core.files import check_target, write_atomic
from srfcli.results.tables import json_text

DIAGNOSE = """
srf diagnose EXPERIMENT                              a folder with experiment.toml, or that file
srf diagnose EXPERIMENT --out found                  report, figures, predictions and the augmented model
srf diagnose EXPERIMENT --json
srf diagnose EXPERIMENT --effect linker-dieterich --effect load-transmission
srf fit found/augmented                              the augmented model is an experiment like any other
"""


@click.command("diagnose", cls=SrfCommand, epilog=DIAGNOSE)
@click.argument("source", metavar="EXPERIMENT", type=PATH)
@click.option("--effect", "effects", multiple=True, metavar="NAME", help="Look for this effect or ageing law only; repeatable.")
@vary_options
@plugins_option
@reader_option
@click.option(
    "--seed", default=0, help="Seed of the noise that is simulated for p-values, and of the discriminating runs that are drawn."
)
@click.option("--json", "as_json", is_flag=True, help="Print one object, in full precision.")
@click.option("--out", metavar="DIR", help="Write answer, report, predictions and augmented experiment to DIR.")
@click.option("--force", is_flag=True, help="Replace a diagnosis that is in DIR already.")
def diagnose(source: Path, effects: tuple[str, ...], plugins: tuple[Path, ...], **options: Any) -> None:
    """Find where recordings, or critical loads, differ from their model, and which physics the model lacks.

    The baseline of the experiment is fitted with a random friction field and coloured gauge noise. Registered effects are scored
    for what they could explain beyond these, some only if --effect names them, and those with the highest scores are fitted.
    Held-out runs are read after the search; a model that does not predict them is rejected. Verdicts are none, identified,
    ambiguous, unknown and inconclusive.
    """
    from srfcli.results.diagnosis import check_answer
    from srfcli.tasks import diagnose as tasks

    folder = None if options["out"] is None else Path(options["out"]).expanduser()
    if folder is not None:
        check_answer(folder, force=options["force"])
    registry, session = open_registry(plugins), Session.current()
    with Progress("diagnose") as progress:

        def told(text: str, share: float | None) -> None:
            progress.advance(note=text, bound=share)
            session.detail(text)

        try:
            found = tasks.diagnose(
                source, effects=effects, trend=options["trend"], vary=listed(options["vary"]), by=options["by"],
                reader=options["reader"], seed=options["seed"], registry=registry, progress=told,
            )  # fmt: skip
        except KeyboardInterrupt:
            raise SrfError(
                "interrupted before the baseline was fitted; nothing is kept",
                "`srf fit` of the same experiment keeps what it has at any time.",
                exit_code=EXIT_INTERRUPTED,
            ) from None
    if folder is not None:
        system = found.write(folder, force=options["force"], arguments=session.arguments, told=session.say, debug=session.debug)
        session.say(f"Wrote {folder}")
    if options["as_json"]:
        click.echo(json_text(found.answer, indent=2))
    else:
        click.echo(f"{found.sentence}\n")
        for table in (found.table, found.parameter_table, *(t for t in (found.run_table, found.load_table) if t.rows)):
            show(table)
            click.echo()
        if folder is not None:
            click.echo(f"The augmented model: srf fit {shlex.quote(str(folder / 'augmented'))}")
            click.echo(f"Its stability: srf linear {system}")
    fitted = ", ".join(sorted(f.name for f in found.diagnosis.ranked))
    finish(
        found.status, advice=f"the answer rests on what was fitted until then: {fitted}. Effects not among these were not tried."
    )


# `srf report`: one page on the results in a folder.

REPORT = """
srf fit EXPERIMENT --out results/fit.json --plot results/fit.svg
srf map --eps 0.18 --out results/map.json --plot results/map.svg
srf report results                                   writes results/report.html
srf report results --title 'PMMA, May' --force
"""


@click.command("report", cls=SrfCommand, epilog=REPORT)
@click.argument("folder", type=PATH)
@click.option("--title", metavar="TEXT", help="Title of the page.  [default: the folder's name]")
@click.option("--out", metavar="FILE.html", help="The page to write.  [default: report.html in the folder]")
@click.option("--force", is_flag=True, help="Overwrite an existing page.")
def report(folder: Path, title: str | None, out: str | None, force: bool) -> None:
    """Write one page on the fits, maps, comparisons and other results of a folder.

    Results are what `--out FILE.json` wrote; a figure of the same name beside one stands with it. A diagnosis has its own report,
    which `srf diagnose --out` writes.
    """
    from srfcli.results.report import read_results, results_page

    results = read_results(folder)
    place = folder / "report.html" if out is None else Path(out).expanduser()
    check_target(place, force=force)
    write_atomic(place, results_page(folder, results, title=title or folder.resolve().name))
    Session.current().say(f"{len(results)} result{'s' if len(results) != 1 else ''}")
    click.echo(str(place))
