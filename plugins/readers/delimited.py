"""Text tables: one heading line, then numbers between commas, semicolons or tabs."""

import csv as cells_of
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from srfcli.laws.api import Source, SrfError, reader

BLOCK = 4 * 2**20  # bytes that are parsed at a time
LONGEST = 2**20  # bytes of a line
SAMPLE = 2**16  # bytes by which the number of lines is estimated
NOTHING = {"", "nan", "na", "n/a", "null", "none", "-nan", "#n/a"}
NUMBER = re.compile(r"[+-]?(?:\d++(?:\.\d*+)?|\.\d++)(?:[eEdD][+-]?\d++)?")  # possessive: in the time that the cell is long
INFINITE = re.compile(r"[+-]?inf(?:inity)?", re.IGNORECASE)


def _text(head: bytes) -> bool:
    return bool(head.strip()) and b"\0" not in head


def _is_tabbed(head: bytes) -> bool:
    return _text(head) and b"\t" in _first_line(head)


def _is_separated(head: bytes) -> bool:
    line = _first_line(head)
    return _text(head) and b"\t" not in line and (b"," in line or b";" in line)


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


def _open(path: Path, delimiters: str) -> Source:
    line, number, offset = _heading(path)
    delimiter = max(delimiters, key=line.count)
    headings = tuple(cell.strip() for cell in next(cells_of.reader([line], delimiter=delimiter, skipinitialspace=True)))
    if headings and not headings[-1]:
        headings = headings[:-1]  # a delimiter at the end of each line
    if all(NUMBER.fullmatch(cell) for cell in headings):
        raise SrfError(
            f"{path}, line {number}: found numbers, expected a line of headings",
            "Begin the file with one, as in: time [s],normal_load [N],elongation [um]",
        )
    table = _Table(path, headings, delimiter, number, offset)
    return Source(headings, table.blocks, about=_about(path, offset))


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
                if comment and all(NUMBER.fullmatch(c) or c.lower() in NOTHING for c in cells) and bare:
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


class _Table:
    """The numbers below the headings, read block by block at the speed of C where every cell is a number."""

    def __init__(self, path: Path, headings: tuple[str, ...], delimiter: str, line: int, offset: int) -> None:
        self.path, self.headings, self.delimiter, self.line, self.offset = path, headings, delimiter, line, offset

    def blocks(self, columns: tuple[int, ...]) -> Iterator[Sequence[np.ndarray]]:
        """Yield the columns in blocks of rows."""
        line = self.line + 1
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
                    yield self._slow(block, columns, line) if table is None else table
                    line += block.count(b"\n")
                elif block:
                    line += max(block.count(b"\n"), block.count(b"\r"))
                if not chunk:
                    return

    def _fast(self, block: bytes, columns: tuple[int, ...]) -> Sequence[np.ndarray] | None:
        """Return the columns of a block in which each line has a number in each cell, else None."""
        if b'"' in block or b"#" in block or b"%" in block or b"_" in block:
            return None
        codes = np.frombuffer(block if block.endswith(b"\n") else block + b"\n", dtype=np.uint8)
        ends = np.flatnonzero(codes == 10)
        counts = np.diff(np.searchsorted(np.flatnonzero(codes == ord(self.delimiter)), ends), prepend=0)
        if (counts != len(self.headings) - 1).any():
            return None
        try:
            table = np.loadtxt(
                io.StringIO(block.decode("ascii")), delimiter=self.delimiter, comments=None, usecols=columns, ndmin=2
            )
        except (ValueError, UnicodeDecodeError):
            return None
        return None if table.shape[0] != ends.size else [np.ascontiguousarray(table[:, k]) for k in range(len(columns))]

    def _slow(self, block: bytes, columns: tuple[int, ...], first: int) -> Sequence[np.ndarray]:
        """Return the columns of a block cell by cell: empty ones are NaN, bad ones raise SrfError with line and column."""
        rows = []
        for number, text in enumerate(block.decode("latin-1").split("\n"), start=first):
            if not text.strip() or text.lstrip().startswith(("#", "%")):
                continue
            rows.append(self._row(text, columns, number))
        table = np.array(rows, dtype=float).reshape(-1, len(columns))
        return [np.ascontiguousarray(table[:, k]) for k in range(len(columns))]

    def _row(self, text: str, columns: tuple[int, ...], number: int) -> list[float]:
        _check(self.path, text.encode("latin-1"), number)
        try:
            cells = next(cells_of.reader([text], delimiter=self.delimiter, skipinitialspace=True, strict=True))
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
        return [self._number(cells[k].strip(), k, number) for k in columns]

    def _number(self, cell: str, column: int, line: int) -> float:
        if NUMBER.fullmatch(cell):
            return float(cell.replace("d", "e").replace("D", "e"))
        if cell.lower() in NOTHING or INFINITE.fullmatch(cell):
            return float("nan")
        where = f"{self.path}, line {line}, column '{self.headings[column]}'"
        if NUMBER.fullmatch(cell.replace(",", ".", 1)):
            raise SrfError(
                f"{where}: found {cell!r}, a decimal comma",
                f"Write a point: {cell.replace(',', '.', 1)}, in the whole file.",
            )
        short = cell if len(cell) <= 40 else cell[:37] + "..."
        raise SrfError(f"{where}: found {short!r}, expected a number", "Leave a missing value empty, or write nan.")
