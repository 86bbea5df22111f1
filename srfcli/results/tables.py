"""A result as a table for a reader, as CSV or JSON for programs, as a data frame, arrays with names or HTML for a notebook."""

from __future__ import annotations

import csv
import html
import io
import json
import math
import numbers
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, final

from srfcli.core import __version__
from srfcli.core.errors import SrfError, Status, printable
from srfcli.core.files import check_target, write_atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROWS_SHOWN = 20  # rows of a table that a notebook shows
STATUS = "ok, or what keeps the row from being used as it stands"

# HTML by small functions: all text is escaped unless it was built here.

VOID = frozenset({"br", "hr", "img", "meta", "source"})


@final
class Markup(str):
    """Text that is HTML already; any other text is escaped where it is put in."""

    __slots__ = ()


def html_text(value: Any) -> Markup:
    """Return `value` as HTML: markup as it is, a list as its parts one after the other, all else escaped."""
    if isinstance(value, Markup):
        return value
    if isinstance(value, list | tuple):
        return Markup("".join(html_text(v) for v in value))
    return Markup(html.escape(str(value), quote=True))


def tag(name: str, /, *children: Any, **attributes: Any) -> Markup:
    """Return an element; `class_` stands for class, an attribute that is None is left out."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value), quote=True)}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in VOID:
        return Markup(f"<{name}{written}>")
    return Markup(f"<{name}{written}>{html_text(list(children))}</{name}>")


# A result as a table, and its form for a reader: aligned plain text, or rich on a terminal.


@dataclass(frozen=True)
class Column:
    """A column: its bare name as programs read it, its unit, its meaning and its format on a terminal."""

    name: str
    unit: str = "1"
    about: str = ""
    format: str = ".6g"

    @property
    def heading(self) -> str:
        """Return the name with its unit, unless that is 1."""
        return printable(self.name if self.unit in ("", "1") else f"{self.name} [{self.unit}]", line=True)


@dataclass(frozen=True)
class Table:
    """A result: rows of cells under columns, with all that is needed to read it years later.

    `schema` is "srf.linear/1" or the like; `parameters` is name -> {value, unit, origin}, see `Resolved.described`;
    `status` is a `Status` value, the worst one of the rows; `notes` are sentences shown below the table.
    A cell is a number, text, a truth value, an enumeration member (its value counts) or None where there is nothing.
    """

    schema: str
    columns: tuple[Column, ...]
    rows: Sequence[Sequence[Any]]
    title: str = ""
    notes: tuple[str, ...] = ()
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    meta: Mapping[str, Any] = field(default_factory=dict)
    status: str = "ok"

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row of {len(row)} cells under {len(self.columns)} columns in {self.schema}")

    def records(self) -> list[dict[str, Any]]:
        """Return each row as column name -> cell."""
        names = [c.name for c in self.columns]
        return [dict(zip(names, row, strict=True)) for row in self.rows]

    def to_dataframe(self) -> Any:
        """Return the table as a pandas.DataFrame; `attrs` has units, title, notes and status. Raises SrfError without pandas."""
        try:
            import pandas
        except ImportError as error:
            raise SrfError("to_dataframe needs pandas, which is not installed", 'pip install "srfcli[frames]"') from error
        rows = [[plain_value(v) for v in row] for row in self.rows]
        frame = pandas.DataFrame(rows, columns=[c.name for c in self.columns])
        frame.attrs = {
            "title": self.title,
            "units": {c.name: c.unit for c in self.columns},
            "notes": list(self.notes),
            "status": self.status,
        }
        return frame

    def to_xarray(self) -> Any:
        """Return the table as an xarray.Dataset over its rows; raises SrfError where xarray or pandas is not installed."""
        _xarray()
        frame = self.to_dataframe()
        return self.dataset({name: ("row", frame[name].to_numpy()) for name in frame.columns})

    def dataset(self, fields: Mapping[str, Any], **coordinates: Any) -> Any:
        """Return an xarray.Dataset of these fields, each with its column's unit and meaning; raises SrfError without xarray."""
        made = _xarray().Dataset(fields, **coordinates)
        for column in self.columns:
            made[column.name].attrs = {"units": column.unit, "long_name": column.about}
        made.attrs = {"title": self.title, "status": self.status}
        return made

    def __str__(self) -> str:
        return to_text(self, full=False).rstrip("\n")

    def _repr_html_(self) -> str:
        """Return the table as HTML for a notebook, its first rows and its notes; all text is escaped."""
        sides = [f"text-align:{'right' if is_numeric(self, i) else 'left'}" for i in range(len(self.columns))]
        styled = list(zip(self.columns, sides, strict=True))
        head = [tag("th", c.heading, style=side, title=c.about or None) for c, side in styled]
        body = [
            tag("tr", [tag("td", cell_text(v, c.format), style=side) for v, (c, side) in zip(row, styled, strict=True)])
            for row in self.rows[:ROWS_SHOWN]
        ]
        left = len(self.rows) - len(body)
        notes = [*([f"{left} more rows"] if left else []), *self.notes]
        shown = tag("table", tag("thead", tag("tr", head)), tag("tbody", body))
        return tag("div", tag("b", self.title), shown, tag("ul", [tag("li", note) for note in notes]) if notes else "")


def _xarray() -> Any:
    """Return xarray, which needs pandas."""
    try:
        import xarray
    except ImportError as error:
        raise SrfError("to_xarray needs xarray, which is not installed", 'pip install "srfcli[frames]"') from error
    return xarray


def plain_value(value: Any) -> Any:
    """Return `value` as Python's own numbers, text, lists and dicts; NaN and infinities become None."""
    if isinstance(value, Enum):
        return plain_value(value.value)
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, numbers.Complex):
        return {"re": plain_value(complex(value).real), "im": plain_value(complex(value).imag)}
    if isinstance(value, Mapping):
        return {str(k): plain_value(v) for k, v in value.items()}
    if type(value).__module__ == "numpy":  # arrays and numpy.bool, without importing numpy to ask
        return plain_value(value.tolist())
    if isinstance(value, Sequence | set | frozenset):
        items = sorted(value) if isinstance(value, set | frozenset) else value
        return [plain_value(v) for v in items]
    return str(value)


FIXED = 1e6  # from here on a fixed number of decimals is more digits than a column of six significant ones has


def cell_text(value: Any, format: str | None = None) -> str:
    """Return one cell as text: with twelve digits, or in `format`; "-" for nothing, "inf" for an infinity."""
    if isinstance(value, float) and math.isinf(value):
        return str(float(value))
    simple = plain_value(value)
    if simple is None:
        return "-"
    if isinstance(simple, bool):
        return "yes" if simple else "no"
    if isinstance(simple, float) and not format:
        return repr(float(f"{simple:.12g}"))
    if isinstance(simple, float):
        return f"{simple:{Column.format if abs(simple) >= FIXED and str(format).endswith('f') else format}}"
    return printable(" ".join(str(simple).split()))


def to_text(table: Table, *, full: bool = True) -> str:
    """Return the table as aligned plain text, as wide as it is; `full` shows twelve digits, else the columns' formats."""
    cells = [[cell_text(v, None if full else c.format) for v, c in zip(row, table.columns, strict=True)] for row in table.rows]
    headings = [c.heading for c in table.columns]
    widths = [max(len(line[i]) for line in [headings, *cells]) for i in range(len(headings))]
    right = [is_numeric(table, i) for i in range(len(headings))]
    lines = [printable(table.title)] if table.title else []
    for line in [headings, *cells] if headings else []:
        padded = (t.rjust(w) if r else t.ljust(w) for t, w, r in zip(line, widths, right, strict=True))
        lines.append("  ".join(padded).rstrip())
    return "\n".join([*lines, *(f"Note: {printable(note, line=True)}" for note in table.notes)]) + "\n"


def is_numeric(table: Table, index: int) -> bool:
    """Return whether column `index` holds numbers, and so is set flush right."""
    values = [row[index] for row in table.rows if row[index] is not None]
    return bool(values) and all(isinstance(v, numbers.Number) and not isinstance(v, bool) for v in values)


def print_terminal(table: Table, stream: TextIO) -> None:
    """Print the table with rich; as plain text where it is wider than the terminal, so that nothing is cut."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    text = to_text(table, full=False)
    stream = getattr(stream, "unescaped", stream)  # colours must not be escaped; text is made printable before
    console = Console(file=stream, highlight=False, soft_wrap=True)
    rule = 3 * len(table.columns)
    body = text.splitlines()[: len(table.rows) + 2]
    if max(map(len, body), default=0) + rule > console.width:
        stream.write(text)
        return
    if table.title:
        console.print(Text(printable(table.title), style="bold"))
    made = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for index, column in enumerate(table.columns):
        made.add_column(Text(column.heading), justify="right" if is_numeric(table, index) else "left", no_wrap=True)
    for row in table.rows:
        # Text, not str: rich would read square brackets in a cell as markup
        made.add_row(*(Text(cell_text(v, c.format)) for v, c in zip(row, table.columns, strict=True)))
    if table.columns:
        console.print(made)
    for note in table.notes:
        console.print(Text.assemble(("Note: ", "bold"), printable(note, line=True)))


# A result as a record for programs: CSV by bare column names, and JSON in an envelope.


def to_csv(table: Table) -> str:
    """Return the rows as CSV in full precision; an empty cell stands for nothing, NaN or an infinity."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([printable(c.name) for c in table.columns])
    text, plain = cache(_csv_cell), {float, int}  # words recur in long tables; csv itself writes finite numbers in full
    for row in table.rows:
        # most cells of a long table are numbers: no function is called for them
        own = [v if type(v) in plain and -math.inf < v < math.inf else text(v) if type(v) is str else _csv_cell(v) for v in row]
        writer.writerow(own)
    return buffer.getvalue()


def _csv_cell(value: Any) -> str:
    simple = plain_value(value)
    if simple is None:
        return ""
    if isinstance(simple, bool):
        return "true" if simple else "false"
    return repr(simple) if isinstance(simple, float) else printable(str(simple))


def json_text(data: Any, *, indent: int | None = None) -> str:
    """Return plain data as JSON; control characters, on which a terminal would act, are written as \\u001b."""
    text = json.dumps(data, indent=indent, ensure_ascii=False, allow_nan=False)
    if printable(text) == text:
        return text
    return "".join(c if c == "\n" or printable(c) == c else json.dumps(c)[1:-1] for c in text)


def envelope(table: Table) -> dict[str, Any]:
    """Return the table as plain data, each row as name -> value, with its schema, parameters and status."""
    return {
        "schema": table.schema,
        "version": __version__,
        "title": table.title,
        "status": table.status,
        "parameters": plain_value(table.parameters),
        "columns": {c.name: {"unit": c.unit, "about": c.about} for c in table.columns},
        "rows": plain_value(table.records()),
        "notes": list(table.notes),
        **({"meta": plain_value(table.meta)} if table.meta else {}),
    }


def to_json(table: Table) -> str:
    """Return the envelope as JSON text, one row a line; NaN and infinities are null."""
    data = envelope(table)
    rows = data.pop("rows")
    text = json_text(data, indent=2)
    lines = ",\n".join("    " + json_text(row) for row in rows)
    block = f"[\n{lines}\n  ]" if rows else "[]"
    return f'{text[: text.rindex("}")].rstrip()},\n  "rows": {block}\n}}\n'


# What every result can do.


class Result(ABC):
    """Result of a task. `table` holds the numbers; data frames, arrays and figures are made from it."""

    @property
    @abstractmethod
    def table(self) -> Table:
        """Return the rows under their columns, with notes, parameters and status, as the command prints them."""

    @abstractmethod
    def plot(self, ax: Axes | None = None) -> Figure:
        """Return a Matplotlib figure with the default style of srf.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, or in whose place several panels are drawn; a figure of its own if left out.

        Raises
        ------
        SrfError
            Where Matplotlib is not installed, or several panels are asked for in an axes that stands in no grid.
        """

    @property
    def status(self) -> Status:
        """Return whether the numbers can be used: the worst status of the rows."""
        return Status(self.table.status)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what is to be known beside the numbers, in sentences."""
        return self.table.notes

    @property
    def parameters(self) -> Mapping[str, Mapping[str, Any]]:
        """Return name -> {value, unit, origin} of every parameter that was not swept."""
        return self.table.parameters

    @property
    def _figure_title(self) -> str:
        """Return the title, and the parameters that were not swept, as a figure shows them."""
        from srfcli.results.plots import titled

        return titled(self.table.title, self.table.parameters)

    def to_dataframe(self) -> Any:
        """Return the table as a pandas.DataFrame; `attrs` has units, title, notes and status. Raises SrfError without pandas."""
        return self.table.to_dataframe()

    def to_xarray(self) -> Any:
        """Return the table as an xarray.Dataset over its rows; every variable has its unit and meaning in `attrs`.

        Raises SrfError where xarray or pandas is not installed.
        """
        return self.table.to_xarray()

    def __str__(self) -> str:
        return str(self.table)

    def __repr__(self) -> str:
        count = len(self.table.rows)
        rows = f"{count} row{'' if count == 1 else 's'}"
        return f"<{type(self).__name__}: {self.table.title}; {rows}, {self.table.status}>"

    def _repr_html_(self) -> str:
        """Return the table for a notebook: its first rows, and the notes."""
        return self.table._repr_html_()


class TextResult(Result):
    """Result that is a text first of all: formulas, a program, a description. `table` lists what is in it."""

    @property
    @abstractmethod
    def text(self) -> str:
        """Return the text, as the command prints it."""

    def write(self, path: Path | str, *, force: bool = False) -> None:
        """Write the text to a file, whole or not at all; raises SrfError for one that exists, unless `force`."""
        check_target(Path(path), force=force, what="")
        write_atomic(Path(path), self.text)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Raise SrfError: a text has no figure."""
        raise SrfError(f"{type(self).__name__} has no figure", "Print it, or look at `table`.")

    def __str__(self) -> str:
        return self.text.rstrip("\n")
