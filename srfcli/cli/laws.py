"""`srf laws`: what laws there are."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import SrfCommand

if TYPE_CHECKING:
    from srfcli.output.tables import Table
    from srfcli.registry import Registry

KINDS = ["friction", "ageing", "modifier", "interface", "effect"]
KIND = click.Choice([*KINDS, "reader"])
LAW_KIND = click.Choice(KINDS)

plugins_option = click.option(
    "--plugins",
    "plugins",
    multiple=True,
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Folder with law files of your own; may be given several times. Also SRF_PLUGINS.",
)

EPILOG = """
srf laws                            every law, where it comes from and what it is
srf laws --kind ageing              one kind
srf laws --plugins .                also the laws in the current folder
srf laws --json | jq .rows          for a program
"""


@click.command(cls=SrfCommand, epilog=EPILOG)
@click.option("--kind", type=KIND, help="One kind of law only, or the readers of data files.")
@click.option("--json", "as_json", is_flag=True, help="JSON on stdout.")
@plugins_option
def laws(kind: str | None, as_json: bool, plugins: tuple[Path, ...]) -> None:
    """List the laws that are found; none is imported for that."""
    from srfcli.cli.options import open_registry
    from srfcli.output.records import to_json
    from srfcli.output.tables import print_terminal, to_text

    registry = open_registry(plugins)
    table = laws_table(registry, kind)
    if as_json:
        click.echo(to_json(table).rstrip("\n"))
    elif sys.stdout.isatty():
        print_terminal(table, sys.stdout)
    else:
        click.echo(to_text(table).rstrip("\n"))
    for problem in registry.problems:
        click.echo(f"Not listed ({problem.origin}): {problem.message}", err=True)


def laws_table(registry: Registry, kind: str | None = None) -> Table:
    """Return the listing as a table; a law that shares its name with another says so in the column `clash`."""
    from srfcli.output.tables import Column, Table

    columns = [Column("kind"), Column("name"), Column("origin"), Column("about"), Column("location"), Column("clash")]
    rows: list[tuple[Any, ...]] = []
    for e in registry.entries(kind):
        if kind is None and e.kind == "reader":
            continue  # not a law: listed on request
        others = ", ".join(str(other.location) for other in registry.clashes(e))
        rows.append((e.kind, e.name, e.origin, e.about, str(e.location), others or None))
    if not any(row[-1] for row in rows):
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    problems = [
        {"name": p.name, "origin": p.origin, "location": p.location, "message": p.message} for p in registry.problems
    ]
    return Table("srf.laws/1", tuple(columns), rows, meta={"problems": problems})
