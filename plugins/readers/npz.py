"""NumPy archives: one array for each column."""

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from srfcli.laws.api import Source, SrfError, reader

ROWS = 2**18  # read at a time
WHOLE = "Was the file copied to its end?"


@reader(name="npz", suffixes=(".npz",), sniff=lambda head: head.startswith(b"PK\x03\x04") and b".npy" in head)
def npz(path: Path) -> Source:
    """NumPy archive, an array for each column; units in the names, in an array `units`, or in [columns]"""
    try:
        archive = zipfile.ZipFile(path)
    except Exception as error:  # a damaged archive fails in many ways
        raise SrfError(f"{path}: not a whole archive: {_told(error)}", WHOLE) from None
    with archive:
        members = [m for m in archive.namelist() if m.endswith(".npy")]
        shapes = {m: _header(path, archive, m) for m in members}
        units = _units(path, archive) if "units.npy" in shapes else None
    columns = [m for m in members if m != "units.npy" and shapes[m][1].kind in "fiu" and _length(shapes[m][0]) is not None]
    if not columns:
        raise SrfError(f"{path}: holds no array of numbers in one row", "Save one with np.savez(path, time=t, ...).")
    lengths = {m: _length(shapes[m][0]) for m in columns}
    rows = max(int(n or 0) for n in lengths.values())
    columns = [m for m in columns if lengths[m] == rows]  # a lone number is a remark, not a column
    headings = tuple(m.removesuffix(".npy") for m in columns)
    if units is not None:
        if len(units) != len(headings):
            raise SrfError(
                f"{path}: `units` has {len(units)} entries for {len(headings)} columns: {', '.join(headings)}",
                "Give one for each array, in the order in which they were saved.",
            )
        headings = tuple(f"{h} [{u}]" if "[" not in h else h for h, u in zip(headings, units, strict=True))

    def blocks(wanted: tuple[int, ...]) -> Iterator[Sequence[np.ndarray]]:
        with zipfile.ZipFile(path) as opened:
            streams = [_Stream(path, opened, columns[k]) for k in wanted]
            for at in range(0, rows, ROWS):
                yield [s.take(min(ROWS, rows - at)) for s in streams]

    return Source(headings, blocks, rows)


def _length(shape: tuple[int, ...]) -> int | None:
    """Return how many numbers a row or a column has, None for anything wider."""
    long = [n for n in shape if n != 1]
    return None if len(long) > 1 else (long[0] if long else 1)


def _header(path: Path, archive: zipfile.ZipFile, member: str) -> tuple[tuple[int, ...], np.dtype]:
    with _opened(path, archive, member) as stream:
        return _start(path, member, stream)


def _opened(path: Path, archive: zipfile.ZipFile, member: str) -> IO[bytes]:
    try:
        return archive.open(member)
    except Exception as error:  # damaged, encrypted, or packed in a way of its own
        raise SrfError(f"{path}: array '{member.removesuffix('.npy')}' cannot be opened: {_told(error)}", WHOLE) from None


def _told(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _start(path: Path, member: str, stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
    except Exception as error:  # the header is text, parsed
        raise SrfError(f"{path}: array '{member.removesuffix('.npy')}' cannot be read: {_told(error)}", WHOLE) from None
    if not all(isinstance(n, int) and n >= 0 for n in shape):
        raise SrfError(f"{path}: array '{member.removesuffix('.npy')}' has the shape {shape}", WHOLE)
    return shape, dtype


def _units(path: Path, archive: zipfile.ZipFile) -> list[str]:
    with _opened(path, archive, "units.npy") as stream:
        shape, dtype = _start(path, "units.npy", stream)
        if dtype.kind not in "US" or len(shape) != 1 or shape[0] > 10_000:
            raise SrfError(f"{path}: `units` is no list of texts", 'Save np.array(["s", "um/s", "N", "um"]).')
        try:
            found = np.frombuffer(stream.read(dtype.itemsize * shape[0]), dtype=dtype)
            return [u.decode("utf-8", "replace") if isinstance(u, bytes) else str(u) for u in found.tolist()]
        except Exception as error:
            raise SrfError(f"{path}: `units` cannot be read: {_told(error)}", WHOLE) from None


class _Stream:
    """One array of an archive, taken from front to back without ever being held whole."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, member: str) -> None:
        self.path, self.member, self.stream = path, member, _opened(path, archive, member)
        _, self.dtype = _start(path, member, self.stream)

    def take(self, count: int) -> np.ndarray:
        """Return the next `count` numbers."""
        try:
            data = self.stream.read(count * self.dtype.itemsize)
        except Exception as error:
            raise SrfError(f"{self.path}: {self.member}: {_told(error)}", WHOLE) from None
        if len(data) != count * self.dtype.itemsize:
            raise SrfError(f"{self.path}: {self.member}: ends early", WHOLE)
        return np.frombuffer(data, dtype=self.dtype).astype(float)
