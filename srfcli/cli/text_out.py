"""The way out of a command whose result is one text: stdout or --out FILE."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from srfcli.cli.base import Session
from srfcli.output.files import check_target, write_atomic

F = TypeVar("F", bound=Callable[..., Any])


def out_option(function: F) -> F:
    """Add --out and --force; the command gets `out`, None for stdout, and `force`."""
    function = click.option("--force", is_flag=True, help="Overwrite an existing file.")(function)
    return click.option("--out", metavar="FILE", callback=_place, help="Write to FILE; - is stdout.")(function)


def _place(context: click.Context, parameter: click.Parameter, value: str | None) -> Path | None:
    return None if value in (None, "-") else Path(str(value)).expanduser()


def put(text: str, out: Path | None, *, force: bool) -> None:
    """Write `text` to `out`, or to stdout where that is None; raises SrfError rather than overwrite without `force`."""
    if out is None:
        click.echo(text, nl=False)
        return
    check_target(out, force=force)
    write_atomic(out, text)
    Session.current().say(f"Wrote {out}")
