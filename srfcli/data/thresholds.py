"""Tables of measured critical loads, `V, eps, W0c, sigma`: read, checked line by line, in um, s, N."""

from __future__ import annotations

import contextlib
import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from srfcli.codegen.model import Array
from srfcli.core.errors import CHECK_PATH, SrfError, did_you_mean
from srfcli.core.files import read_text
from srfcli.core.units import find_unit, split_heading, tidy

UNITS = {"V": "um/s", "eps": "1", "W0c": "N", "sigma": "N"}
REQUIRED = ("V", "eps", "W0c")
RELATIVE_ERROR = 0.03  # of the critical load, where the table gives none: the paper's "typically 3 %"
PERCENT = ("eps", "sigma")  # columns that may be given in %
LARGEST_TABLE = 64 * 2**20  # bytes of a table


@dataclass(frozen=True)
class Thresholds:
    """Measured critical loads: velocities `V` (um/s), amplitudes `eps`, loads `W0c` and their errors `sigma` (N), each (n,).

    `lines` are the rows' line numbers in `source`; `notes` say what was assumed.
    """

    source: str
    V: Array
    eps: Array
    W0c: Array
    sigma: Array
    lines: tuple[int, ...]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.V)


def thresholds(
    V: Sequence[float] | Array,
    eps: Sequence[float] | Array,
    W0c: Sequence[float] | Array,
    *,
    sigma: Sequence[float] | Array | None = None,
    source: str = "data",
) -> Thresholds:
    """Return a table of these values (n,), in um/s and N; without `sigma` the paper's 3 % of each load."""
    loads = np.asarray(W0c, float)
    error = RELATIVE_ERROR * loads if sigma is None else np.asarray(sigma, float)
    lines = tuple(range(2, len(loads) + 2))
    return Thresholds(source, np.asarray(V, float), np.asarray(eps, float), loads, error, lines)


def read_thresholds(path: Path) -> Thresholds:
    """Return the table in the CSV file at `path`: comma, semicolon or tab, `#` begins a comment, units in brackets.

    Raises SrfError that names the line for anything that is not a measurement; 1 is the exit code of a file that cannot
    be read.
    """
    try:
        text = read_text(path, limit=LARGEST_TABLE, what="a table of critical loads")
    except OSError as error:
        raise SrfError(f"{path} cannot be read: {error.strerror}", CHECK_PATH, exit_code=1) from error
    numbered = enumerate(text.splitlines(), start=1)
    lines = [(number, line) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise SrfError(f"{path} is empty", "Begin it with a line of names: V [um/s],eps,W0c [N],sigma [N]")
    number, header = lines[0]
    delimiter = "\t" if "\t" in header else ";" if ";" in header else ","
    columns = _columns(_split(header, delimiter), f"{path.name} line {number}")
    rows = [_row(_split(line, delimiter), columns, f"{path.name} line {number}") for number, line in lines[1:]]
    if not rows:
        raise SrfError(f"{path} has names but no measurements", "Add a line for each: 10,0.09,11.0,0.33")
    V, eps, W0c, sigma = np.array(rows).T
    notes: tuple[str, ...] = ()
    if unknown := int(np.isnan(sigma).sum()):
        which = "all rows" if unknown == len(rows) else f"{unknown} of {len(rows)} rows"
        notes = (f"{path.name}: no sigma in {which}; taken as {RELATIVE_ERROR:.0%} of the load, the paper's error",)
    sigma = np.where(np.isnan(sigma), RELATIVE_ERROR * W0c, sigma)
    return Thresholds(path.name, V, eps, W0c, sigma, tuple(number for number, _ in lines[1:]), notes)


def _split(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line; one that quotes cannot be parsed comes back in one cell, which no column takes."""
    try:
        return next(csv.reader([line], delimiter=delimiter, strict=True), [])
    except csv.Error:
        return [line]


def _columns(header: Sequence[str], where: str) -> list[tuple[str, float]]:
    """Return name and factor to base units of each column; the factor of a relative sigma is negative."""
    found: list[tuple[str, float]] = []
    for cell in header:
        name, unit = split_heading(cell)
        if name not in UNITS:
            hint = f"{did_you_mean(name, UNITS)}; other columns have no place in a table of critical loads."
            raise SrfError(f"{where}: unknown column {name!r}", hint)
        if name in dict(found):
            raise SrfError(f"{where}: two columns are called {name}", "Keep one of them.")
        found.append((name, _factor(name, unit, where)))
    missing = [name for name in REQUIRED if name not in dict(found)]
    if missing:
        raise SrfError(
            f"{where}: there is no column {' and no column '.join(missing)}",
            "A table has V, eps and W0c and, if known, sigma: V [um/s],eps,W0c [N],sigma [N]",
        )
    return found


def _factor(name: str, unit: str | None, where: str) -> float:
    wanted = UNITS[name]
    if unit == "%" and name in PERCENT:
        return 0.01 if name == "eps" else -0.01
    if not unit:
        return 1.0
    place = f"{where}: column {name}"
    source, target = find_unit(unit, where=place), find_unit(wanted)
    if source.powers != target.powers:
        also = " or %" if name in PERCENT else ""
        raise SrfError(f"{place}: {unit!r} is the wrong unit", f"Write {name} [{wanted}]{also}, or the like.")
    return tidy(source.factor / target.factor)


def _row(cells: list[str], columns: list[tuple[str, float]], where: str) -> list[float]:
    """Return V, eps, W0c, sigma of one line in base units; sigma is NaN where the line does not say it."""
    if len(cells) != len(columns):
        raise SrfError(
            f"{where}: {len(cells)} cells under {len(columns)} names",
            "Give every line one cell for each name; decimals take a point, not a comma.",
        )
    values = {"sigma": math.nan}
    for (name, factor), cell in zip(columns, cells, strict=True):
        if name != "sigma" or cell.strip():
            values[name] = factor * _number(name, cell, where)
    for name in ("V", "W0c"):
        if not values[name] > 0:
            raise SrfError(f"{where}: {name} = {values[name]:g} {UNITS[name]} is not above 0", "Correct or remove it.")
    if not 0 <= values["eps"] < 1:
        raise SrfError(f"{where}: eps = {values['eps']:g} is not in [0, 1)", "eps is relative to W0; in percent head it eps [%].")
    sigma = values["sigma"]
    if dict(columns).get("sigma", 1.0) < 0:
        sigma = -sigma * values["W0c"]
    if sigma <= 0:
        raise SrfError(f"{where}: sigma = {sigma:g} N is not above 0", "Leave the cell empty where it is not known.")
    return [values["V"], values["eps"], values["W0c"], sigma]


def _number(name: str, cell: str, where: str) -> float:
    with contextlib.suppress(ValueError):
        value = float(cell.strip().replace("_", "x"))  # float would take 1_0 for ten
        if math.isfinite(value):
            return value
    raise SrfError(
        f"{where}: {name} = {cell.strip()!r} is not a finite number", "Write a number as in 11.25, units in the header."
    )


def thresholds_csv(table: Thresholds) -> str:
    """Return the table as CSV that `read_thresholds` reads back to the same numbers."""
    rows = zip(table.V, table.eps, table.W0c, table.sigma, strict=True)
    body = "".join(",".join(repr(float(v)) for v in row) + "\n" for row in rows)
    return f"V [um/s],eps,W0c [N],sigma [N]\n{body}"
