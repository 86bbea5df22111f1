"""What MkDocs asks for while it builds the site: the help of every command, and titles for pages that are linked by file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from srfcli.cli.base import CONTEXT
from srfcli.cli.main import cli

WIDTH = 84  # characters that a page shows without scrolling
PLACE = "<!-- commands -->"
FILE_LINK = re.compile(r"\[[\w/-]+\.md\]\(([\w./-]+\.md)")


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


def title(page: Path) -> str:
    """Return the heading of a document."""
    return page.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ") if page.is_file() else page.name


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return a page with the commands in their place, and `[fit.md](fit.md)` as a link to *Fitting recordings*."""
    folder = Path(page.file.abs_src_path).parent
    markdown = FILE_LINK.sub(lambda found: f"[{title(folder / found[1])}]({found[1]}", markdown)
    if PLACE not in markdown:
        return markdown
    top = click.Context(cli, info_name="srf", terminal_width=WIDTH, **CONTEXT)
    return markdown.replace(PLACE, "\n".join(section(*found) for found in commands(cli, top)))
