"""What MkDocs asks for while it builds the site: the help of every command, from the commands themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import click

from srfcli.cli.base import CONTEXT
from srfcli.cli.main import cli

WIDTH = 84  # characters that a page shows without scrolling
PLACE = "<!-- commands -->"


def commands(command: click.Command, context: click.Context) -> Iterator[tuple[click.Command, click.Context]]:
    """Yield a command and those below it, in reading order, each with the context that has its name."""
    yield command, context
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            below = command.get_command(context, name)
            assert below is not None
            yield from commands(below, click.Context(below, parent=context, info_name=name))


def section(command: click.Command, context: click.Context) -> str:
    """Return a heading and what `--help` prints."""
    return f"## `{context.command_path}`\n\n```text\n{command.get_help(context)}\n```\n"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page with the commands in their place."""
    if PLACE not in markdown:
        return markdown
    top = click.Context(cli, info_name="srf", terminal_width=WIDTH, help_option_names=CONTEXT["help_option_names"])
    return markdown.replace(PLACE, "\n".join(section(*found) for found in commands(cli, top)))
