"""What every result can do: be a table, a data frame, arrays with names, a figure, a part of a notebook's page."""

from __future__ import annotations

import html
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import SrfError, Status
from srfcli.results.tables import Table, cell_text, is_numeric, plain_value, to_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = 20  # rows of a table that a notebook shows


class Result(ABC):
    """What a task found; `table` holds its numbers, and all other forms are made of it."""

    @property
    @abstractmethod
    def table(self) -> Table:
        """Return the rows under their columns, with notes, parameters and status, as the command prints them."""

    @abstractmethod
    def plot(self, ax: Axes | None = None) -> Figure:
        """Return a Matplotlib figure in the house style.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw in; a figure of its own if left out.

        Raises
        ------
        SrfError
            Where Matplotlib is not installed, or a figure of several panels is asked for in one axes.
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

    def to_dataframe(self) -> Any:
        """Return the table as a pandas.DataFrame; `attrs` holds units, title, notes and status.

        Raises
        ------
        SrfError
            Where pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise SrfError(
                "to_dataframe needs pandas, which is not installed", 'pip install "srfcli[frames]"'
            ) from error
        table = self.table
        rows = [[plain_value(v) for v in row] for row in table.rows]
        frame = pandas.DataFrame(rows, columns=[c.name for c in table.columns])
        frame.attrs = {
            "title": table.title,
            "units": {c.name: c.unit for c in table.columns},
            "notes": list(table.notes),
            "status": table.status,
        }
        return frame

    def to_xarray(self) -> Any:
        """Return the table as an xarray.Dataset over its rows; every variable has its unit and meaning in `attrs`.

        Raises
        ------
        SrfError
            Where xarray or pandas is not installed.
        """
        xarray, frame = load_xarray(), self.to_dataframe()
        made = xarray.Dataset({name: ("row", frame[name].to_numpy()) for name in frame.columns})
        for column in self.table.columns:
            made[column.name].attrs = {"units": column.unit, "long_name": column.about}
        made.attrs = {"title": self.table.title, "status": self.table.status}
        return made

    def __str__(self) -> str:
        return to_text(self.table, full=False).rstrip("\n")

    def __repr__(self) -> str:
        count = len(self.table.rows)
        rows = f"{count} row{'' if count == 1 else 's'}"
        return f"<{type(self).__name__}: {self.table.title}; {rows}, {self.table.status}>"

    def _repr_html_(self) -> str:
        """Return the table for a notebook: its first rows, and the notes."""
        return table_html(self.table)


def table_html(table: Table) -> str:
    """Return a table as HTML, its first rows and its notes; all text is escaped."""
    right = [is_numeric(table, i) for i in range(len(table.columns))]

    def cell(tag: str, index: int, text: str, about: str = "") -> str:
        side = "right" if right[index] else "left"
        tip = f' title="{html.escape(about)}"' if about else ""
        return f'<{tag} style="text-align:{side}"{tip}>{html.escape(text)}</{tag}>'

    head = "".join(cell("th", i, c.heading, c.about) for i, c in enumerate(table.columns))
    body = [
        "<tr>" + "".join(cell("td", i, cell_text(v, table.columns[i].format)) for i, v in enumerate(row)) + "</tr>"
        for row in list(table.rows[:SHOWN])
    ]
    left = len(table.rows) - len(body)
    notes = [*([f"{left} more rows"] if left else []), *table.notes]
    told = "".join(f"<li>{html.escape(note)}</li>" for note in notes)
    return (
        f"<div><b>{html.escape(table.title)}</b><table><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table>{f'<ul>{told}</ul>' if told else ''}</div>"
    )


def load_xarray() -> Any:
    """Return the module xarray; raises SrfError where it is not installed."""
    try:
        import xarray
    except ImportError as error:
        raise SrfError("to_xarray needs xarray, which is not installed", 'pip install "srfcli[frames]"') from error
    return xarray


def own_figure(ax: Axes | None, what: str) -> None:
    """Raise SrfError where a figure of several panels is asked for in one axes."""
    if ax is not None:
        raise SrfError(f"the figure of {what} has several panels, and one axes was given", "Leave out ax.")
