"""`srf config`, `srf derive` and `srf code`: a system's values, what follows from it by algebra, and its NumPy module."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from srfcli.cli.base import SrfCommand, SrfGroup
from srfcli.cli.emit import emit, out_option, put
from srfcli.cli.options import OutputOptions, SystemOptions, record_options, system_options
from srfcli.core.errors import SrfError
from srfcli.core.settings import DEFAULTS
from srfcli.results.tables import Column, Table

# `srf config`: which values a command would use, and who set them.

CONFIG_COLUMNS = (
    Column("name", "", "choice or parameter"),
    Column("value", "", "in its declared unit", format=".12g"),
    Column("unit", "", "declared unit"),
    Column("origin", "", "flag, environment variable, srf.toml or default"),
    Column("about", "", "meaning"),
)


@click.group("config", cls=SrfGroup)
def config() -> None:
    """Show which values are used, and where each comes from."""


@config.command(
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
    built = system.opener().formulas
    resolved = system.resolve(built.parameters)
    chosen = {**system.chosen, "tol": system.tolerance()}
    rows: list[tuple[object, ...]] = [(key, s.value, None, s.origin, DEFAULTS[key].about) for key, s in chosen.items()]
    for p in built.parameters:
        rows.append((p.name, resolved.declared[p.name], p.unit, resolved.origins[p.name], p.about or None))
    notes = (f"settings file: {system.toml.path}",) if system.toml.path else ()
    emit(Table("srf.config/1", CONFIG_COLUMNS, rows, built.title, notes, resolved.described()), output, laws=built.laws)


# `srf derive`: what follows from a law by algebra, and the paper's equations held against it.

DERIVE = """
srf derive                                       the paper's model
srf derive --law log-log --ageing ruina --with all
srf derive --law two-state --format latex --out two-state.tex
srf derive --format python                       C0..C4 as a NumPy function
srf derive --check-paper                         what the paper misprints
"""
FORMATS = ("text", "json", "latex", "python")
LONG_PARTS = ("jacobian", "parameters")


@click.command("derive", cls=SrfCommand, epilog=DERIVE)
@system_options
@click.option("--format", "form", type=click.Choice(FORMATS), default="text", help="What to write.")
@click.option(
    "--with", "extra", type=click.Choice((*LONG_PARTS, "all")), multiple=True, help="Add long parts; JSON has all of them."
)
@click.option("--check-paper", is_flag=True, help="Compare the paper's printed equations and claims with its own model.")
@out_option
def derive(system: SystemOptions, form: str, extra: tuple[str, ...], check_paper: bool, out: Path | None, force: bool) -> None:
    """Steady state, slopes, equations, dispersion relation and closed critical loads of a system, by algebra.

    The coefficients C0, C1, ... are in the form and normalisation of the paper's appendix. --check-paper looks at the
    paper's own model, whatever law is chosen.
    """
    from srfcli.tasks import stability as tasks

    _check_no_values(system)
    if check_paper and form not in ("text", "json"):
        raise SrfError(f"--check-paper has no format {form}", "Choose --format text or --format json.")
    extras = LONG_PARTS if form == "json" or "all" in extra else sorted(set(extra))
    found = tasks.check_paper() if check_paper else tasks.derive(system.opener(), extras=extras)
    if form == "json":
        text = json.dumps(found.document, indent=2, ensure_ascii=not check_paper, allow_nan=False) + "\n"
    else:
        shown = "pretty" if form == "text" and not check_paper and out is None and sys.stdout.isatty() else form
        text = getattr(found, shown)
    put(text, out, force=force)


# `srf code`: the NumPy module that computes everything numerical about a system.

CODE = """
srf code                                  the paper's model
srf code --law log-log --out log_log.py   a module to import: needs NumPy alone
"""


@click.command("code", cls=SrfCommand, epilog=CODE)
@system_options
@out_option
def code(system: SystemOptions, out: Path | None, force: bool) -> None:
    """Print the generated NumPy module of a system: rates, Jacobians, derivatives by the parameters, characteristic polynomial.

    Its functions take arrays of any leading shape, real or complex, in um, s, N; the module's PARAMETERS gives their order.
    """
    from srfcli.tasks import stability as tasks

    _check_no_values(system)
    put(tasks.code(system.opener()).text, out, force=force)


def _check_no_values(system: SystemOptions) -> None:
    """Raise SrfError for a value of a parameter: formulas are those of all values."""
    for name in system.flags:
        raise SrfError(f"{name} is given a value, and formulas are those of all values", "Leave it out.")
