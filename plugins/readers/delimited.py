"""Text tables: one heading line, then numbers between commas, semicolons or tabs; and what rigs export around such tables."""

import csv as cells_of
import io
import math
import re
from collections.abc import Iterator, Sequence
from datetime import date
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np

from srfcli.core.units import find_unit, split_heading
from srfcli.laws.api import Source, SrfError, reader

BLOCK = 4 * 2**20  # bytes that are parsed at a time
LONGEST = 2**20  # bytes of a line
SAMPLE = 2**16  # bytes by which the number of lines is estimated
SNIFFED = 4096  # bytes from which a reader is chosen
NOTHING = {"", "nan", "na", "n/a", "null", "none", "-nan", "#n/a"}
CLOCK = re.compile(r"\d:\d\d|\d{4}[-/.]\d{1,2}[-/.]\d|\d{1,2}[-/.]\d{1,2}[-/.]\d{4}")
DATE = r"(\d{4})[-/](\d\d)[-/](\d\d)"
STAMP = re.compile(rf"(?:{DATE}[T ])?(\d\d?):(\d\d):(\d\d(?:\.\d*)?) ?(Z|[+-]\d\d:?(?:\d\d)?)?")  # date, time of day, zone
DAY = 86400.0  # s
NUMBER = re.compile(r"[+-]?(?:\d++(?:\.\d*+)?|\.\d++)(?:[eEdD][+-]?\d++)?")  # possessive: in the time that the cell is long
BINARY = re.compile(rb"[^\0]*[\x01-\x08\x0e-\x1f]")  # as no text begins
INFINITE = re.compile(r"[+-]?inf(?:inity)?", re.IGNORECASE)


def _text(head: bytes) -> bool:
    return bool(head.strip()) and b"\0" not in head


def _is_tabbed(head: bytes) -> bool:
    return _text(head) and b"\t" in _first_line(head) and _layout(head) is None


def _is_separated(head: bytes) -> bool:
    line = _first_line(head)
    return _text(head) and b"\t" not in line and (b"," in line or b";" in line) and _layout(head) is None


def _first_line(head: bytes) -> bytes:
    lines = head.removeprefix(b"\xef\xbb\xbf").replace(b"\r", b"\n").split(b"\n")
    told = [line for line in lines if line.strip() and not line.lstrip().startswith((b"#", b"%"))]
    return told[0] if told else b"".join(lines[:1])


@reader(name="csv", suffixes=(".csv",), sniff=_is_separated)
def csv(path: Path) -> Source:
    """Text with commas or semicolons, one heading line"""
    return _open(path, ",;")


@reader(name="tsv", suffixes=(".tsv",), sniff=_is_tabbed)
def tsv(path: Path) -> Source:
    """Text with tabs, one heading line"""
    return _open(path, "\t")


@reader(name="export", suffixes=(".txt", ".dat", ".asc", ".lvm"), sniff=lambda head: _text(head) and _layout(head) is not None)
def export(path: Path) -> Source:
    """Text that rigs export: a preamble, units in a line of their own, blanks between columns, decimal commas"""
    with path.open("rb") as stream:
        head = stream.read(SAMPLE)
    layout = _layout(head) if _text(head) else None
    if layout is None:
        raise SrfError(
            f"{path}: found no table: lines of numbers, as many in each, below a line of headings",
            "Name another reader with format = ...; `srf laws --kind reader` lists them.",
        )
    table = _Table(path, layout.headings, layout.delimiter, layout.line - 1, layout.offset, decimal=layout.decimal)
    return Source(table.stamped(), table.blocks, about=_about(path, layout.offset))


class _Layout(NamedTuple):
    """Where a table begins, as line from 1 and byte, and how its numbers stand; a delimiter " " is any blanks."""

    headings: tuple[str, ...]
    delimiter: str
    decimal: str
    line: int
    offset: int


ROWS_SEEN = 3  # lines of numbers that make a table, fewer where the file ends


def _layout(head: bytes) -> _Layout | None:
    """Return how a table stands in what a rig exported, None where the text is no table or one that needs none of this."""
    text = head.removeprefix(b"\xef\xbb\xbf")
    skipped = len(head) - len(text)
    raw = text.replace(b"\r\n", b"\n ").replace(b"\r", b"\n").split(b"\n")  # a blank for the byte that was there
    if len(head) == SNIFFED or len(head) == SAMPLE:
        raw = raw[:-1]  # it may be cut
    lines = [text.strip(" \r\n") if text.strip() else "" for text in map(_decoded, raw)]  # a tab may be an empty cell
    begin = next((k for k, line in enumerate(lines) if _table_begins(lines, k)), None)
    if begin is None:
        return None
    delimiter, decimal = _how(lines[begin])
    count = len(_cells(lines[begin], delimiter))
    while begin and _is_row(_cells(lines[begin - 1], delimiter), count, decimal):  # a first row with an empty cell
        begin -= 1
    above = [k for k in range(begin) if lines[k]]
    names, units = None, None
    for k in reversed(above[-4:]):
        cells = _cells(lines[k].lstrip("#% "), delimiter, count)
        if all(re.fullmatch(r"\d+recs", cell) for cell in cells):  # of xlook: how many there are
            continue
        if len(cells) == count + 1:  # LabVIEW heads a column of comments that most lines leave out
            cells = cells[:-1]
        if len(cells) != count:
            break
        if names is None and units is None and _are_units(cells):  # degC, V, say, are none
            units = cells
        elif names is None:
            names = cells
            first = k
            break
    if names is None and units is not None:  # letters that could be units head the columns: t, N
        names, units = units, None
        first = above[-1]
    if names is None:
        return None
    plain = (
        units is None
        and decimal == "."
        and delimiter != " "
        and [k for k in above if lines[k][0] not in "#%"][:1] in ([first], [])
    )
    if plain or (delimiter != " " and lines[first][0] in "#%" and units is None and decimal == "."):
        return None
    units = units or [""] * count
    bare = [unit.strip("[]() ") for unit in units]
    headings = tuple(f"{n} [{u}]" if u and "[" not in n and "(" not in n else n for n, u in zip(names, bare, strict=True))
    if len(set(headings)) < count:
        headings = tuple(f"{h}_{k + 1}" if headings.count(h) > 1 else h for k, h in enumerate(headings))
    return _Layout(headings, delimiter, decimal, begin + 1, skipped + sum(len(line) + 1 for line in raw[:begin]))


def _table_begins(lines: Sequence[str], k: int) -> bool:
    """Return whether line k and those after it are numbers, two or more and as many in each."""
    seen = [line for line in lines[k : k + ROWS_SEEN] if line]
    if not seen or not lines[k] or len(seen) < min(ROWS_SEEN, len(lines) - k):
        return False
    delimiter, decimal = _how(seen[0])
    rows = [_cells(line, delimiter) for line in seen]
    return len(rows[0]) > 1 and all(len(row) == len(rows[0]) and all(_is_number(c, decimal) for c in row) for row in rows)


def _how(line: str) -> tuple[str, str]:
    """Return the delimiter of a line of numbers and its decimal sign."""
    for delimiter in "\t;":
        if delimiter in line:
            return delimiter, "," if "," in line else "."
    blanks = line.split()
    if len(blanks) > 1 and "," in line and all(_is_number(cell, ",") for cell in blanks):
        return " ", ","
    return ("," if "," in line else " "), "."


def _cells(line: str, delimiter: str, count: int = 0) -> list[str]:
    """Return the cells of a line; blanks inside a heading are no delimiters where two of them stand between headings."""
    if delimiter != " ":
        cells = next(cells_of.reader([line], delimiter=delimiter, skipinitialspace=True), [])
        cells = [cell.strip() for cell in cells]
        return cells[:-1] if len(cells) > 1 and not cells[-1] else cells
    apart = line.split()
    if count and len(apart) != count:
        wide = re.split(r"\t|\s{2,}", line)
        joined = re.findall(r"[^\s\[(]+(?:\s*(?:\[[^\]]*\]|\([^)]*\)))?", line)
        closed = re.findall(r"[^\[\](]*[^\[\](\s]\s*(?:\[[^\]]*\]|\([^)]*\))", line)
        apart = next((cells for cells in (wide, joined, closed) if len(cells) == count), apart)
    return [cell.strip() for cell in apart]


def _is_number(cell: str, decimal: str) -> bool:
    text = cell.replace(decimal, ".", 1)
    return bool(NUMBER.fullmatch(text) or STAMP.fullmatch(text) or re.fullmatch(DATE, cell)) or cell.lower() in NOTHING - {""}


def _is_row(cells: Sequence[str], count: int, decimal: str) -> bool:
    """Return whether these are the cells of a row of numbers, some of which may be empty."""
    filled = [cell for cell in cells if cell]
    return len(cells) == count and bool(filled) and all(_is_number(cell, decimal) for cell in filled)


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether most cells of a line state a unit and nothing else, in brackets or not, one of them a common unit."""
    bare = [cell.strip("[]() ") for cell in cells]
    told = [text for text in bare if text not in ("", "-")]
    none = len(bare) - len(told)
    return any(_is_unit(text, common=True) for text in told) and 2 * (none + sum(map(_is_unit, told))) > len(bare)


def _is_unit(text: str, *, common: bool = False) -> bool:
    try:
        find_unit(text, common=common)
    except SrfError:
        return False
    return True


def _open(path: Path, delimiters: str) -> Source:
    line, number, offset = _heading(path)
    delimiter = max(delimiters, key=line.count)
    headings = tuple(cell.strip() for cell in next(cells_of.reader([line], delimiter=delimiter, skipinitialspace=True)))
    if headings and not headings[-1]:
        headings = headings[:-1]  # a delimiter at the end of each line
    if all(NUMBER.fullmatch(cell) or STAMP.fullmatch(cell) for cell in headings):
        raise SrfError(
            f"{path}, line {number}: found numbers, expected a line of headings",
            "Begin the file with one, as in: time [s],normal_load [N],elongation [um]",
        )
    table = _Table(path, headings, delimiter, number, offset)
    return Source(table.stamped(), table.blocks, about=_about(path, offset))


def _about(path: Path, offset: int) -> int | None:
    """Return how many lines there are below the headings, going by some of them at the beginning, the middle and the end."""
    size, lines, length = path.stat().st_size - offset, 0, 0
    with path.open("rb") as stream:
        for at in sorted({0, max(size // 2 - SAMPLE, 0), max(size - SAMPLE, 0)}):
            stream.seek(offset + at)
            part = stream.read(SAMPLE).partition(b"\0")[0].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            lines += part.count(b"\n")
            length += part.rfind(b"\n") + 1
    return size * lines // length if length else None


def _heading(path: Path) -> tuple[str, int, int]:
    """Return the line of headings, its number, and the byte where the numbers begin.

    A heading may stand behind # or %, when it is the last such line and the numbers follow at once.
    """
    comment, at, number = "", 0, 0
    with path.open("rb") as stream:
        if BINARY.match(stream.read(len(b"\x89HDF\r\n\x1a"))):
            raise SrfError(f"{path}: no text, but bytes of another kind of file", "Leave the format out: the content tells it.")
        stream.seek(0)
        while raw := stream.readline(LONGEST + 1):
            _check(path, raw, number + 1)
            line = raw.removeprefix(b"\xef\xbb\xbf") if number == 0 else raw
            if b"\r" in line.rstrip(b"\r\n"):  # old line ends: the headings are the first of many lines
                line = line[: line.index(b"\r") + 1]
            number += 1
            text = _decoded(line).strip()
            if text.startswith(("#", "%")):
                comment = text
            elif text:
                cells = [cell.strip() for cell in re.split(r"[,;\t]", text)]
                bare = comment.lstrip("#% ")
                if comment and all(_is_number(c, ".") or not c for c in cells) and bare:
                    return bare, number - 1, at
                length = len(line) + (3 if number == 1 and raw.startswith(b"\xef\xbb\xbf") else 0)
                return _decoded(line).strip(" \r\n"), number, at + length
            at += len(line) + (3 if number == 1 and raw.startswith(b"\xef\xbb\xbf") else 0)
            stream.seek(at)
    raise SrfError(f"{path}: no line of headings, the file is empty", "The first line names the columns: time [s],...")


def _check(path: Path, raw: bytes, number: int) -> None:
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")) and number == 1:
        raise SrfError(f"{path}: UTF-16 text", "Save the file as UTF-8.")
    if b"\0" in raw:
        raise SrfError(f"{path}, line {number}: a zero byte: not a text table", "Name its kind with format = ...")
    if len(raw) > LONGEST:
        raise SrfError(f"{path}, line {number}: longer than {LONGEST} bytes: not a table of columns")


def _decoded(line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")  # where the micro sign is one byte


class _Clock:
    """Time stamps of a column as seconds since the first one; times of day without a date go on past midnight."""

    def __init__(self) -> None:
        self.first: tuple[int, float] | None = None
        self.midnights, self.last = 0, -math.inf

    def read(self, stamp: re.Match[str]) -> float | None:
        """Return the seconds since the first stamp, None where a clock does not show such a time."""
        year, month, day, hours, minutes, seconds, zone = stamp.groups()
        of_day = 3600 * int(hours) + 60 * int(minutes) + float(seconds)
        if int(hours) > 24 or int(minutes) > 59 or float(seconds) >= 61:
            return None
        if year:
            try:
                days = date(int(year), int(month), int(day)).toordinal()
            except ValueError:
                return None
            if zone and zone != "Z":
                of_day -= math.copysign(3600 * int(zone[1:3]) + 60 * int(zone[3:].lstrip(":") or 0), float(zone[0] + "1"))
        else:
            self.midnights += of_day < self.last - DAY / 2
            days, self.last = self.midnights, of_day
        self.first = self.first or (days, of_day)
        return (days - self.first[0]) * DAY + (of_day - self.first[1])


class _Table:
    """The numbers below the headings, read block by block at the speed of C where every cell is a number."""

    def __init__(
        self, path: Path, headings: tuple[str, ...], delimiter: str, line: int, offset: int, *, decimal: str = "."
    ) -> None:
        self.path, self.headings, self.delimiter, self.line, self.offset = path, headings, delimiter, line, offset
        self.decimal = decimal

    def stamped(self) -> tuple[str, ...]:
        """Return the headings, with the unit s where the first row has a time stamp."""
        with self.path.open("rb") as stream:
            stream.seek(self.offset)
            cells = _cells(_decoded(_first_line(stream.read(SAMPLE))), self.delimiter)
        stamps = [STAMP.fullmatch(cell.replace(self.decimal, ".")) for cell in cells]
        return tuple(
            f"{split_heading(h)[0]} [s]" if stamp else h for h, stamp in zip_longest(self.headings, stamps) if h is not None
        )

    def blocks(self, columns: tuple[int, ...]) -> Iterator[Sequence[np.ndarray]]:
        """Yield the columns in blocks of rows."""
        line, clocks = self.line + 1, [_Clock() for _ in columns]
        with self.path.open("rb") as stream:
            stream.seek(self.offset)
            rest = b""
            while True:
                chunk = stream.read(BLOCK)
                block = rest + chunk
                cut = block.rfind(b"\n") + 1 if chunk else len(block)
                if not cut and b"\r" in block[:-1]:
                    cut = block[:-1].rfind(b"\r") + 1
                if not cut and len(block) > LONGEST:
                    _check(self.path, block, line)
                block, rest = block[:cut], block[cut:]
                if block.strip():
                    block = block.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
                    table = self._fast(block, columns)
                    yield self._slow(block, columns, line, clocks) if table is None else table
                    line += block.count(b"\n")
                elif block:
                    line += max(block.count(b"\n"), block.count(b"\r"))
                if not chunk:
                    return

    def _fast(self, block: bytes, columns: tuple[int, ...]) -> Sequence[np.ndarray] | None:
        """Return the columns of a block in which each line has a number in each cell, else None."""
        if any(sign in block for sign in b'"#%_'):
            return None
        if self.decimal == ",":
            block = block.replace(b",", b".")
        blanks = self.delimiter == " "
        if blanks:
            lines = sum(bool(line.strip()) for line in block.split(b"\n"))
        else:
            codes = np.frombuffer(block if block.endswith(b"\n") else block + b"\n", dtype=np.uint8)
            ends = np.flatnonzero(codes == 10)
            counts = np.diff(np.searchsorted(np.flatnonzero(codes == ord(self.delimiter)), ends), prepend=0)
            if (counts != len(self.headings) - 1).any():
                return None
            lines = ends.size
        # between blanks all columns are read: a line may have too many
        separator, read, width = (None, None, len(self.headings)) if blanks else (self.delimiter, columns, len(columns))
        try:
            table = np.loadtxt(io.StringIO(block.decode("ascii")), delimiter=separator, comments=None, usecols=read, ndmin=2)
        except (ValueError, UnicodeDecodeError):
            return None
        if table.shape != (lines, width):
            return None
        return [np.ascontiguousarray(table[:, k]) for k in (columns if blanks else range(width))]

    def _slow(self, block: bytes, columns: tuple[int, ...], first: int, clocks: Sequence[_Clock]) -> Sequence[np.ndarray]:
        """Return the columns of a block cell by cell: empty ones are NaN, bad ones raise SrfError with line and column."""
        rows = []
        for number, text in enumerate(block.decode("latin-1").split("\n"), start=first):
            if not text.strip() or text.lstrip().startswith(("#", "%")):
                continue
            rows.append(self._row(text, columns, number, clocks))
        table = np.array(rows, dtype=float).reshape(-1, len(columns))
        return [np.ascontiguousarray(table[:, k]) for k in range(len(columns))]

    def _row(self, text: str, columns: tuple[int, ...], number: int, clocks: Sequence[_Clock]) -> list[float]:
        _check(self.path, text.encode("latin-1"), number)
        try:
            cells = text.split() if self.delimiter == " " else self._split(text)
        except cells_of.Error as error:
            raise SrfError(f"{self.path}, line {number}: {error}", "Close every quote on its own line.") from None
        if len(cells) == len(self.headings) + 1 and not cells[-1].strip():
            cells.pop()
        if len(cells) != len(self.headings):
            if self.delimiter == "," and len(cells) >= 2 * len(self.headings) - 1 and text.count(",") == len(cells) - 1:
                hint = "Are these decimal commas? Write points, or semicolons between the columns."
            else:
                hint = f"The columns are: {', '.join(self.headings)}"
            raise SrfError(f"{self.path}, line {number}: found {len(cells)} cells, expected {len(self.headings)}", hint)
        return [self._number(cells[k].strip(), k, number, clock) for k, clock in zip(columns, clocks, strict=True)]

    def _split(self, text: str) -> list[str]:
        return next(cells_of.reader([text], delimiter=self.delimiter, skipinitialspace=True, strict=True))

    def _number(self, cell: str, column: int, line: int, clock: _Clock) -> float:
        cell = cell.replace(",", ".", 1) if self.decimal == "," else cell
        if NUMBER.fullmatch(cell):
            return float(cell.replace("d", "e").replace("D", "e"))
        if cell.lower() in NOTHING or INFINITE.fullmatch(cell):
            return float("nan")
        if (stamp := STAMP.fullmatch(cell)) and (seconds := clock.read(stamp)) is not None:
            return seconds
        where = f"{self.path}, line {line}, column '{self.headings[column]}'"
        if NUMBER.fullmatch(cell.replace(",", ".", 1)):
            raise SrfError(
                f"{where}: found {cell!r}, a decimal comma", f"Write a point: {cell.replace(',', '.', 1)}, in the whole file."
            )
        short = cell if len(cell) <= 40 else cell[:37] + "..."
        hint = "Leave a missing value empty, or write nan."
        if CLOCK.search(cell):
            hint = "Time stamps are read as 2026-11-29T09:15:03.25 or 09:15:03.25; or write the seconds since the start."
        raise SrfError(f"{where}: found {short!r}, expected a number", hint)
