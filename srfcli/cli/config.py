"""`srf config`: which values a command would use, and who set them."""

from __future__ import annotations

import click

from srfcli.cli.base import SrfGroup
from srfcli.cli.emit import emit
from srfcli.cli.options import OutputOptions, SystemOptions, record_options, system_options
from srfcli.core.settings import DEFAULTS
from srfcli.results.tables import Column, Table

SCHEMA = "srf.config/1"
COLUMNS = (
    Column("name", about="choice or parameter"),
    Column("value", about="in its declared unit", format=".12g"),
    Column("unit", about="declared unit"),
    Column("origin", about="flag, environment variable, srf.toml or default"),
    Column("about", about="meaning"),
)


@click.group("config", cls=SrfGroup)
def command() -> None:
    """Show which values are used, and who set them."""


@command.command(
    "show",
    epilog="""
    srf config show
    srf config show --law dieterich-cutoff --set B=0.03
    SRF_K='210 N/mm' srf config show --json
    """,
)
@system_options
@record_options
def show(system: SystemOptions, output: OutputOptions) -> None:
    """Print every choice and parameter with its value and origin.

    srf.toml is looked for in this directory and above it, up to the repository's root or the home directory:

    \b
        [defaults]
        law = "srf-vsat"
        [parameters]
        K = "210 N/mm"
        Vsat = 300
    """
    built = system.system()
    resolved = system.resolve(built.parameters)
    rows: list[tuple[object, ...]] = [
        (key, s.value, None, s.origin, DEFAULTS[key].about) for key, s in system.choices().items()
    ]
    for p in built.parameters:
        rows.append((p.name, resolved.declared[p.name], p.unit, resolved.origins[p.name], p.about or None))
    notes = (f"settings file: {system.toml.path}",) if system.toml.path else ()
    emit(
        Table(SCHEMA, COLUMNS, rows, title=built.title, notes=notes, parameters=resolved.described()),
        output,
        laws=built.laws,
    )
