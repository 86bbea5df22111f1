"""NumPy archives: one array for each column."""

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from srfcli.core.errors import WHOLE, damaged
from srfcli.laws.api import Source, SrfError, reader

ROWS = 2**18  # read at a time


@reader(name="npz", suffixes=(".npz",), sniff=lambda head: head.startswith(b"PK\x03\x04") and b".npy" in head)
def npz(path: Path) -> Source:
    """NumPy archive, an array for each column; units in the names, in an array `units`, or in [columns]"""
    with damaged(f"{path}: not a whole archive"):
        archive = zipfile.ZipFile(path)
    with archive:
        members = [m for m in archive.namelist() if m.endswith(".npy")]
        shapes = {m: _opened(path, archive, m)[1:] for m in members}
        units = _units(path, archive) if "units.npy" in shapes else None
    lengths = {m: _length(shape) for m, (shape, dtype) in shapes.items() if m != "units.npy" and dtype.kind in "fiu"}
    rows = max((n for n in lengths.values() if n is not None), default=None)
    if rows is None:
        raise SrfError(f"{path}: holds no array of numbers in one row", "Save one with np.savez(path, time=t, ...).")
    columns = [m for m, n in lengths.items() if n == rows]  # a lone number is a remark, not a column
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


def _opened(path: Path, archive: zipfile.ZipFile, member: str) -> tuple[IO[bytes], tuple[int, ...], np.dtype]:
    """Return a stream of an array's numbers, the array's shape and its type."""
    array = f"{path}: array '{member.removesuffix('.npy')}'"
    with damaged(f"{array} cannot be opened"):  # it may also be encrypted, or packed in a way of its own
        stream = archive.open(member)
    with damaged(f"{array} cannot be read"):  # the header is text, parsed
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
    if not all(isinstance(n, int) and n >= 0 for n in shape):
        raise SrfError(f"{array} has the shape {shape}", WHOLE)
    return stream, shape, dtype


def _units(path: Path, archive: zipfile.ZipFile) -> list[str]:
    stream, shape, dtype = _opened(path, archive, "units.npy")
    with stream:
        if dtype.kind not in "US" or len(shape) != 1 or shape[0] > 10_000:
            raise SrfError(f"{path}: `units` is no list of texts", 'Save np.array(["s", "um/s", "N", "um"]).')
        with damaged(f"{path}: `units` cannot be read"):
            found = np.frombuffer(stream.read(dtype.itemsize * shape[0]), dtype=dtype)
            return [u.decode("utf-8", "replace") if isinstance(u, bytes) else str(u) for u in found.tolist()]


class _Stream:
    """One array of an archive, taken from front to back without ever being held whole."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, member: str) -> None:
        self.path, self.member = path, member
        self.stream, _, self.dtype = _opened(path, archive, member)

    def take(self, count: int) -> np.ndarray:
        """Return the next `count` numbers."""
        with damaged(f"{self.path}: {self.member}"):
            data = self.stream.read(count * self.dtype.itemsize)
        if len(data) != count * self.dtype.itemsize:
            raise SrfError(f"{self.path}: {self.member}: ends early", WHOLE)
        return np.frombuffer(data, dtype=self.dtype).astype(float)
