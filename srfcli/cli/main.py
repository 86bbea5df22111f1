"""The entry point: `srf` and its commands, listed by module; a command module imports nothing heavy at its top."""

from __future__ import annotations

import atexit
import gc
import importlib
import os
from collections import UserDict
from collections.abc import Sequence
from typing import Any, NoReturn

import click

from srfcli.cli.base import CONTEXT, SrfGroup, switches
from srfcli.core import ONE_THREAD, __version__

# command -> file:attribute in srfcli/cli and the first sentence of its help, in the order of `srf --help`, which imports none
COMMANDS = {
    "laws": ("law:laws", "List all registered laws, without importing them."),
    "law": ("law:law", "Show, write and check laws."),
    "derive": (
        "system:derive",
        "Steady state, slopes, equations, dispersion relation and closed critical loads of a system, by algebra.",
    ),
    "code": (
        "system:code",
        "Print the generated NumPy module of a system: rates, Jacobians, derivatives by the parameters, "
        "characteristic polynomial.",
    ),
    "linear": ("stability:linear", "Critical load, K/W0 and frequency of steady sliding under constant load."),
    "critical": ("stability:critical", "Every critical load at the given velocities, numbered from low W0."),
    "continue": ("stability:continue_", "The stability boundary of the forced sliding state in a plane of two parameters."),
    "floquet": ("stability:floquet", "The forced periodic state at one V, W0 and eps: multipliers, mean friction, harmonics."),
    "map": ("map:map_", "The stability of the forced sliding state over a plane of two parameters."),
    "response": ("stability:response", "How sliding follows a modulated normal load W0 (1 + eps cos 2 pi f t)."),
    "compare": (
        "map:compare",
        "Laws side by side: where re-entrance begins, what modulation destabilises, and where an experiment discriminates "
        "between them.",
    ),
    "new": ("recordings:new", "Write a commented experiment.toml for recordings, which `srf check` and `srf fit` take."),
    "check": ("recordings:check", "Read and validate an experiment and report sampling, defects and noise of its recordings."),
    "fit": (
        "fit:command",
        "Fit the model of an experiment to its recordings and critical loads, all together, by maximum likelihood.",
    ),
    "diagnose": (
        "diagnose:diagnose",
        "Find where recordings, or critical loads, differ from their model, and which physics the model lacks.",
    ),
    "report": ("diagnose:report", "Write one page on the fits, maps, comparisons and other results of a folder."),
    "simulate": ("simulate:command", "Time traces of a slider: through steady sliding, stick-slip, holds and re-sliding."),
    "prove": ("prove:command", "Test the diagnosis on synthetic experiments whose truth is sealed until the last answer."),
    "config": ("system:config", "Show which values are used, and where each comes from."),
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
Exit codes: 0 done, 1 unexpected or I/O, 2 wrong usage, or an invalid law, experiment or data file,
3 did not converge, 4 a --fail-on condition was true, 130 interrupted.
"""


class Commands(UserDict[str, Any]):
    """The commands by name; one that is still a place, file:attribute, is imported when it is asked for."""

    def __getitem__(self, name: str) -> click.Command:
        found = self.data[name]
        if isinstance(found, str):
            module, _, attribute = found.partition(":")
            found = self.data[name] = getattr(importlib.import_module(f"srfcli.cli.{module}"), attribute)
        command: click.Command = found
        return command


class Srf(SrfGroup):
    """`srf` itself: its commands stand in COMMANDS, and only the one that runs is imported."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.commands = Commands({name: place for name, (place, _) in COMMANDS.items()})

    def summaries(self) -> list[tuple[str, str]]:
        """Return the commands' names and first sentences."""
        return [(name, sentence) for name, (_, sentence) in COMMANDS.items()]


@click.group(cls=Srf, name="srf", epilog=EPILOG, context_settings=CONTEXT, params=switches())
@click.version_option(__version__, prog_name="srf", message="%(prog)s %(version)s")
def cli() -> None:
    """State-and-rate friction: from a law to the boundary between steady sliding and stick-slip."""


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run `srf` with `argv`, or with the process's arguments, and exit."""
    os.environ.update(ONE_THREAD)
    gc.set_threshold(100_000, 10, 10)  # collecting among imported modules, and at the end, takes a sixth of a short run
    atexit.register(gc.freeze)
    cli.main(argv)


if __name__ == "__main__":
    main()
