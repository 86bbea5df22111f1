"""The entry point: `srf` and its commands, listed by module; a command module imports nothing heavy at its top."""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from typing import NoReturn

import click

from srfcli import __version__
from srfcli.cli.base import CONTEXT, SrfGroup, switches

# command -> module:attribute, in the order of `srf --help`
COMMANDS = {
    "laws": "srfcli.cli.laws:laws",
    "law": "srfcli.cli.law:law",
    "derive": "srfcli.cli.derive:command",
    "code": "srfcli.cli.code:command",
    "linear": "srfcli.cli.linear:command",
    "critical": "srfcli.cli.critical:command",
    "continue": "srfcli.cli.continue_:command",
    "floquet": "srfcli.cli.floquet:command",
    "map": "srfcli.cli.map:command",
    "response": "srfcli.cli.response:command",
    "compare": "srfcli.cli.compare:command",
    "new": "srfcli.cli.new:command",
    "check": "srfcli.cli.check:command",
    "fit": "srfcli.cli.fit:command",
    "diagnose": "srfcli.cli.diagnose:command",
    "report": "srfcli.cli.report:command",
    "simulate": "srfcli.cli.simulate:command",
    "prove": "srfcli.cli.prove:command",
    "config": "srfcli.cli.config:command",
}

EPILOG = """
srf linear --over V=1:100:60                      critical load under constant load
srf continue --eps 0.18 --plot boundary.svg       stability boundary under modulation
srf critical --eps 0.13 --V 1,7,25                every critical load at three velocities
srf linear --law dieterich-cutoff --set B=0.03    another law, another value
srf laws                                          what laws there are
srf config show                                   every parameter and where its value comes from

A value is taken from a flag, else SRF_NAME, else srf.toml, else the law's default.
Units are um, s, N and kg unless written: --K '210 N/mm'.
Exit codes: 0 done, 1 unexpected or I/O, 2 usage or a bad law, 3 did not converge,
4 a --fail-on condition was true, 130 interrupted.
"""


@click.group(cls=SrfGroup, name="srf", epilog=EPILOG, context_settings=CONTEXT, params=switches())
@click.version_option(__version__, prog_name="srf", message="%(prog)s %(version)s")
def cli() -> None:
    """State-and-rate friction: from a law to the boundary between steady sliding and stick-slip."""


def register(group: click.Group) -> None:
    """Add every command of COMMANDS to `group`."""
    for name, place in COMMANDS.items():
        module, _, attribute = place.partition(":")
        group.add_command(getattr(importlib.import_module(module), attribute), name)


register(cli)


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run `srf` with `argv`, or with the process's arguments, and exit."""
    for library in ("OPENBLAS", "MKL", "OMP"):  # all matrices here are small: threads only cost their start
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    cli.main(argv)


if __name__ == "__main__":
    main()
