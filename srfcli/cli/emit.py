"""The way out of a command: a table, a text or a figure, their sidecars, progress and the exit code."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import EXIT_INTERRUPTED, EXIT_OK, EXIT_PARTIAL, Session, as_options
from srfcli.cli.options import Options, OutputOptions, add_options
from srfcli.core.errors import SrfError, Status, printable
from srfcli.core.files import check_target, write_atomic
from srfcli.laws.values import Law
from srfcli.results.plots import figure_bytes
from srfcli.results.provenance import Provenance, write_result
from srfcli.results.tables import Table, print_terminal, to_csv, to_json, to_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PATIENCE, LITTLE = 2.0, 0.01  # s before an estimate is shown; smallest share of the work from which one is made


def emit(
    table: Table,
    options: OutputOptions,
    *,
    more: Sequence[Table] = (),
    figure: Figure | Callable[[], Figure] | None = None,
    laws: Iterable[Law] = (),
    inputs: Iterable[Path] = (),
    seed: int | None = None,
    timings: Mapping[str, float] | None = None,
) -> None:
    """Write the table where the options say, then the figure if --plot asks for it, each file with its sidecar.

    `more` are tables that text shows below the first; in JSON its `meta` should hold what they say, CSV has the first only.
    `figure` may be a function that draws it, called only for --plot. `laws`, `inputs`, `seed` and `timings` go into
    the sidecar, as do the table's parameters. A terminal gets a formatted table, a pipe plain text of twelve digits;
    beside CSV and a file the notes go to stderr.
    """
    arguments = Session.current().arguments
    provenance = Provenance(arguments, table.parameters, tuple(laws), tuple(inputs), seed, timings or {})
    shown = [table, *more] if options.format == "text" else [table]
    if options.out is None:
        for index, one in enumerate(shown):
            if index:
                click.echo()
            show(one, options.format)
    else:
        content = "\n".join(render(one, options.format) for one in shown).encode("utf-8")
        _write(options.out, content, provenance, options)
    if options.format == "csv" or options.out is not None:
        for note in table.notes:  # CSV has no place for notes, and a file may not be read at once
            Session.current().say(f"Note: {note}")
    if options.plot is not None:
        if figure is None:
            raise SrfError(f"--plot {options.plot}: there is nothing to draw", "Leave --plot out.")
        drawn = figure() if callable(figure) else figure
        _write(options.plot, figure_bytes(drawn, options.plot.suffix), provenance, options)


def render(table: Table, format: str) -> str:
    """Return the table as `format`: text (twelve digits), json or csv (full precision)."""
    return {"text": to_text, "json": to_json, "csv": to_csv}[format](table)


def show(table: Table, format: str = "text") -> None:
    """Print the table on stdout, formatted where that is a terminal and text is asked for."""
    if format == "text" and sys.stdout.isatty():
        print_terminal(table, sys.stdout)
    else:
        click.echo(render(table, format), nl=False)


def _write(path: Path, content: bytes, provenance: Provenance, options: OutputOptions) -> None:
    session = Session.current()
    if (beside := write_result(path, content, provenance if options.provenance else None)) is not None:
        session.detail(f"Wrote {beside}")
    session.say(f"Wrote {path}")


def warn_uncompiled(cost: str) -> None:
    """Say in one line that no C compiler was found and what that costs; nothing where there is one or SRF_CC is empty."""
    from srfcli.codegen.c_source import GET_COMPILER, uncompiled

    if uncompiled():
        Session.current().say(f"Warning: no C compiler was found: {cost}. Try: {GET_COMPILER}")


def finish(status: Status, *, advice: str | None = None) -> None:
    """End the command with the exit code of `status`: 0 where its numbers can be used, 130 interrupted, else 3.

    Call it last, after `emit`; the status' advice is printed on stderr, or that of the command.
    """
    if status.ok:
        raise click.exceptions.Exit(EXIT_OK)
    interrupted = status is Status.INTERRUPTED
    told = as_options(advice or status.advice, click.get_current_context().command)
    click.echo(f"{'Interrupted' if interrupted else 'Not finished'}: {told}", err=True)
    raise click.exceptions.Exit(EXIT_INTERRUPTED if interrupted else EXIT_PARTIAL)


class Progress:
    """One line on stderr with the progress of a long loop and, after two seconds, an estimate of the time that is left.

    Nothing is written where stderr is no terminal, and under -q. The estimate uses the share that is done: of `total`, or as
    given to `advance`. Without either the line shows the elapsed time.
    """

    def __init__(self, label: str, total: int | None = None, *, stream: Any = None, quiet: bool | None = None) -> None:
        self.label, self.total, self.done = label, total, 0
        self._stream = sys.stderr if stream is None else stream
        self._raw = getattr(self._stream, "unescaped", self._stream)
        self._active = self._stream.isatty() and not (Session.current().quiet if quiet is None else quiet)
        self._shown_at, self._begun, self._entered = 0.0, time.monotonic(), time.perf_counter()

    @property
    def seconds(self) -> float:
        """Return how long the work has taken so far, all its stages together."""
        return time.perf_counter() - self._entered

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        self._clear()

    def _clear(self) -> None:
        """Remove the line: the loop, or a stage of it, has ended."""
        if self._active and self._shown_at:
            self._raw.write("\r\x1b[K")
            self._stream.flush()

    def stage(self, label: str, total: int | None = None) -> None:
        """Begin another stage of the work, with its own count and clock; does nothing where it is the current one."""
        if label != self.label:
            self._clear()
            self.label, self.total, self.done, self._begun = label, total, 0, time.monotonic()

    def advance(self, steps: int = 1, *, note: str = "", share: float | None = None, bound: float | None = None) -> None:
        """Count `steps` more and show it, at most ten times a second.

        `share` of the work is done, from 0 to 1; `bound` is the share of the largest possible amount of work.
        """
        self.done += steps
        now = time.monotonic()
        if not self._active or now - self._shown_at < 0.1:
            return
        self._shown_at = now
        count = f"{self.done}" if self.total is None else f"{self.done}/{self.total}"
        if share is None and self.total:
            share = self.done / self.total
        line = f"{self.label}: {count}  {note}".rstrip()
        left = remaining(now - self._begun, share if bound is None else bound, most=bound is not None)
        self._raw.write(f"\r\x1b[K{printable(line[:100], line=True)}{left}")
        self._stream.flush()


def remaining(elapsed: float, share: float | None, *, most: bool = False) -> str:
    """Return an estimate of the time that is left after `elapsed` seconds, or the elapsed time where `share` is None.

    With `most`, `share` is that of the largest possible amount of work, and the estimate is an upper bound.
    """
    if elapsed < PATIENCE or (share is not None and share >= 1.0):
        return ""
    if share is None or share < LITTLE:
        return f"  [{duration(elapsed)} so far]"
    left = duration(elapsed * (1.0 / share - 1.0))
    return f"  [{duration(elapsed)} so far, at most {left} more]" if most else f"  [about {left} left]"


def duration(seconds: float) -> str:
    """Return a time to two digits in s, min or h."""
    for size, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * size:
            return f"{float(f'{seconds / size:.2g}'):g} {unit}"
    return f"{float(f'{max(seconds, 1.0):.2g}'):.0f} s"


# The way out of a command whose result is one text: stdout or --out FILE.


def _place(context: click.Context, parameter: click.Parameter, value: str | None) -> Path | None:
    return None if value in (None, "-") else Path(str(value)).expanduser()


OUT_OPTIONS: Options = {
    "out": click.option("--out", metavar="FILE", callback=_place, help="Write to FILE; - is stdout."),
    "force": click.option("--force", is_flag=True, help="Overwrite an existing file."),
}
out_option = add_options(OUT_OPTIONS)  # the command gets `out`, None for stdout, and `force`


def put(text: str, out: Path | None, *, force: bool) -> None:
    """Write `text` to `out`, or to stdout where that is None; raises SrfError rather than overwrite without `force`."""
    if out is None:
        click.echo(text, nl=False)
        return
    check_target(out, force=force)
    write_atomic(out, text)
    Session.current().say(f"Wrote {out}")
