"""`srf report`: one page on the results in a folder."""

from __future__ import annotations

from pathlib import Path

import click

from srfcli.cli.base import Session, SrfCommand

EXAMPLES = """
srf fit EXPERIMENT --out results/fit.json --plot results/fit.svg
srf map --eps 0.18 --out results/map.json --plot results/map.svg
srf report results                                   writes results/report.html
srf report results --title 'PMMA, May' --force
"""


@click.command("report", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--title", metavar="TEXT", help="Title of the page.  [default: the folder's name]")
@click.option("--out", metavar="FILE.html", help="The page to write.  [default: report.html in the folder]")
@click.option("--force", is_flag=True, help="Overwrite an existing page.")
def command(folder: Path, title: str | None, out: str | None, force: bool) -> None:
    """Write one page on the fits, maps, comparisons and other results of a folder.

    Results are what `--out FILE.json` wrote; a figure of the same name beside one stands with it. A diagnosis has its own report,
    which `srf diagnose --out` writes.
    """
    from srfcli.core.files import check_target, write_atomic
    from srfcli.results.report import read_results, results_page

    results = read_results(folder)
    place = folder / "report.html" if out is None else Path(out).expanduser()
    check_target(place, force=force)
    write_atomic(place, results_page(folder, results, title=title or folder.resolve().name))
    Session.current().say(f"{len(results)} result{'s' if len(results) != 1 else ''}")
    click.echo(str(place))
