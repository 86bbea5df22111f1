"""`srf code`: the NumPy module that computes everything numerical about a system."""

from __future__ import annotations

from pathlib import Path

import click

from srfcli.cli.options import SrfCommand, SystemOptions, system_options
from srfcli.cli.text_out import out_option, put

EPILOG = """
srf code                                  the paper's model
srf code --law log-log --out log_log.py   a module to import: needs NumPy alone
"""


@click.command("code", cls=SrfCommand, epilog=EPILOG)
@system_options
@out_option
def command(system: SystemOptions, out: Path | None, force: bool) -> None:
    """Print the generated NumPy module of a system: rates, Jacobians, derivatives by the parameters, characteristic polynomial.

    Its functions take arrays of any leading shape, real or complex, in um, s, N; the module's PARAMETERS gives their order.
    """
    put(system.model().source, out, force=force)
