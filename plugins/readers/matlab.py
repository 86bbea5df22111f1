"""MATLAB files of version 5: one vector for each column, in variables of their own or in the fields of structs."""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from srfcli.core.errors import WHOLE
from srfcli.laws.api import Source, SrfError, reader

# Read here and not by scipy.io.loadmat, whose compiled code ends the process on some damaged files.
MOST = 10_000  # columns of a matrix, and variables of a file
HEAD = 4096  # bytes in which the header of a variable must lie
TEXT, MATRIX, COMPRESSED = 128, 14, 15
STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
NUMERIC = range(6, 16)  # classes: double, single, and integers
STRUCT, DEEPEST = 2, 4  # the class of a struct, and how many may stand in each other
COMPLEX = 0x0800
LARGEST_STRUCT = 2**27  # bytes of a struct, which is unpacked as a whole; a larger one is passed over
Buffer = bytes | memoryview


@dataclass(frozen=True)
class _Variable:
    """A matrix of numbers: where its element lies in the file, and where in the element its numbers begin."""

    name: str
    shape: tuple[int, int]
    at: int
    size: int
    packed: bool
    begin: int
    is_complex: bool


@reader(
    name="matlab",
    suffixes=(".mat",),
    sniff=lambda head: head.startswith(b"MATLAB ") and not head.startswith(b"MATLAB 7.3") and head[126:128] in (b"IM", b"MI"),
)
def matlab(path: Path) -> Source:
    """MATLAB 5 file: each vector or field of a struct a column, a matrix `data` as data_1, data_2, ...; units in [columns]"""
    with path.open("rb") as stream:
        head = stream.read(TEXT)
        if head.startswith(b"MATLAB 7.3"):
            raise SrfError(f"{path}: MATLAB 7.3 is another format (HDF5)", "Leave the reader out, or save with -v7.")
        order = "<" if head[126:128] == b"IM" else ">"
        try:
            variables = list(_variables(stream, order))
        except (ValueError, struct.error, zlib.error, UnicodeDecodeError) as error:
            raise SrfError(f"{path}: not a whole MATLAB 5 file: {error}", WHOLE) from None
    places: dict[str, tuple[_Variable, int]] = {}
    lengths: dict[str, int] = {}
    fields = [v.name.rpartition(".")[2] for v in variables]
    known = Counter(fields)
    short = {v.name: f if known[f] == 1 else v.name for v, f in zip(variables, fields, strict=True)}
    for variable in variables:
        rows, columns = (max(variable.shape), 1) if 1 in variable.shape else variable.shape
        if columns > MOST:
            raise SrfError(f"{path}: variable '{variable.name}' has {columns} columns", f"At most {MOST} are read.")
        for k in range(columns):
            heading, full = (n if columns == 1 else f"{n}_{k + 1}" for n in (short[variable.name], variable.name))
            heading = full if heading in places else heading
            places[heading], lengths[heading] = (variable, k), rows
    if not places:
        raise SrfError(f"{path}: holds no vector of numbers", "Save one variable for each column, as time, force.")
    outside = [n for h, n in lengths.items() if "." not in places[h][0].name]  # of structs, which may hold more than a recording
    rows = max(outside) if outside.count(max(outside, default=0)) > 1 else max(lengths.values())
    headings = tuple(h for h in places if lengths[h] == rows)  # a lone number is a remark, not a column

    def blocks(wanted: tuple[int, ...]) -> Iterator[Sequence[np.ndarray]]:
        chosen = [places[headings[k]] for k in wanted]
        arrays: dict[str, np.ndarray] = {}
        with path.open("rb") as stream:
            for variable, _ in chosen:
                if variable.is_complex:
                    raise SrfError(f"{path}: variable '{variable.name}' is complex", "Save its real part.")
                if variable.name not in arrays:
                    try:
                        arrays[variable.name] = _numbers(stream, order, variable)
                    except (ValueError, struct.error, zlib.error) as error:
                        raise SrfError(f"{path}: variable '{variable.name}': {error}", WHOLE) from None
        yield [a.ravel() if 1 in (a := arrays[v.name]).shape else a[:, k] for v, k in chosen]

    return Source(headings, blocks, rows, whole=True)


def _variables(stream: BinaryIO, order: str) -> Iterator[_Variable]:
    """Yield the matrices of numbers in a file and in its structs; other variables are passed over."""
    end, at, count, left = os.fstat(stream.fileno()).st_size, TEXT, 0, [MOST]
    while at + 8 <= end:
        stream.seek(at)
        kind, size = struct.unpack(f"{order}II", stream.read(8))
        if kind not in (MATRIX, COMPRESSED) or at + 8 + size > end:
            raise ValueError(f"an element of type {kind} and {size} bytes at byte {at}")
        count += 1
        if count > MOST:
            raise ValueError(f"more than {MOST} variables")
        data = stream.read(min(size, HEAD))
        if kind == COMPRESSED:
            data = zlib.decompressobj().decompress(data, HEAD)
            if struct.unpack_from(f"{order}I", data)[0] != MATRIX:
                raise ValueError(f"no matrix in the element at byte {at}")
            data = data[8:]
        packed = kind == COMPRESSED
        if size and _class(data, order) == STRUCT:
            stream.seek(at + 8)
            found = [*_fields(_struct(stream, size, packed), order, left)]
        else:
            found = [f for f in [_header(data, order) if size else None] if f is not None]
        for name, shape, begin, is_complex in found:
            yield _Variable(name, shape, at + 8, size, packed, begin + (8 if packed else 0), is_complex)
        at += 8 + size


def _struct(stream: BinaryIO, size: int, packed: bool) -> memoryview:
    """Return the matrix of a struct, whose element has `size` bytes from here on; nothing of one that is too large."""
    data, rest = stream.read(size) if size <= LARGEST_STRUCT else b"", b""
    if packed:
        unpacked = zlib.decompressobj()
        data, rest = unpacked.decompress(data, LARGEST_STRUCT)[8:], unpacked.unconsumed_tail
    return memoryview(b"" if rest else data)


def _fields(
    data: memoryview, order: str, left: list[int], at: int = 0, depth: int = DEEPEST, prefix: str = ""
) -> Iterator[tuple[str, tuple[int, int], int, bool]]:
    """Yield what `_header` returns of the numbers in a struct (`data` is its matrix), named STRUCT.FIELD; it begins at `at`.

    At most as many fields as are `left` in the file.
    """
    if not data:
        return
    _, _, place = _part(data, 0, order)
    _, sizes, place = _part(data, place, order)
    _, name, place = _part(data, place, order)
    if bytes(sizes) != struct.pack(f"{order}ii", 1, 1) or not depth:
        return  # an array of structs is no table
    _, width, place = _part(data, place, order)
    _, names, place = _part(data, place, order)
    (length,) = struct.unpack(f"{order}i", width)
    if length < 1 and len(names):
        raise ValueError(f"field names of {length} bytes")
    own = prefix or f"{bytes(name).decode('latin-1')}."
    for k in range(0, len(names), max(length, 1)):
        left[0] -= 1
        if left[0] < 0:
            raise ValueError(f"more than {MOST} fields")
        kind, content, after = _part(data, place, order)
        if kind != MATRIX:
            raise ValueError(f"a field of type {kind}")
        field = own + bytes(names[k : k + length]).split(b"\0")[0].decode("latin-1")
        if len(content) and _class(content, order) == STRUCT:
            yield from _fields(content, order, left, at + place + 8, depth - 1, f"{field}.")
        elif len(content) and (found := _header(content, order)) is not None:
            yield field, found[1], at + place + 8 + found[2], found[3]
        place = after


def _part(data: Buffer, at: int, order: str) -> tuple[int, Buffer, int]:
    """Return type and content of the part that begins at `at`, and where the next one does."""
    kind, size = struct.unpack_from(f"{order}II", data, at)
    if kind >> 16:  # a small part: its size and its content share the tag
        kind, size, begin, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if size > 4:
            raise ValueError(f"a small part of {size} bytes")
    else:
        begin, after = at + 8, at + 8 + -(-size // 8) * 8
    if begin + size > len(data):
        raise ValueError("the header of a variable breaks off")
    return kind, data[begin : begin + size], after


def _class(data: Buffer, order: str) -> int:
    return int(struct.unpack_from(f"{order}I", _part(data, 0, order)[1])[0]) & 0xFF


def _header(data: Buffer, order: str) -> tuple[str, tuple[int, int], int, bool] | None:
    """Return name, shape, where the numbers begin and whether they are complex; None for what is no matrix of numbers."""
    _, flags, at = _part(data, 0, order)
    flag = struct.unpack_from(f"{order}I", flags)[0]
    if flag & 0xFF not in NUMERIC:
        return None
    _, sizes, at = _part(data, at, order)
    shape = struct.unpack(f"{order}{len(sizes) // 4}i", sizes[: len(sizes) // 4 * 4])
    _, name, at = _part(data, at, order)
    if min(shape, default=-1) < 0:
        raise ValueError(f"a matrix of shape {shape}")
    if len(shape) != 2 or 0 in shape:
        return None
    return bytes(name).decode("latin-1"), (shape[0], shape[1]), at, bool(flag & COMPLEX)


def _numbers(stream: BinaryIO, order: str, variable: _Variable) -> np.ndarray:
    """Return the numbers of a variable, in its shape; ValueError where they are not all there."""
    count = variable.shape[0] * variable.shape[1]
    most = variable.begin + 8 + 8 * count
    stream.seek(variable.at)
    data = stream.read(variable.size if variable.packed else min(variable.size, most))
    if variable.packed:
        data = zlib.decompressobj().decompress(data, most)
    kind, size = struct.unpack_from(f"{order}II", data, variable.begin)
    begin = variable.begin + 8
    if kind >> 16:
        kind, size, begin = kind & 0xFFFF, kind >> 16, variable.begin + 4
    if kind not in STORED:
        raise ValueError(f"numbers of type {kind}")
    dtype = np.dtype(STORED[kind]).newbyteorder(order)
    if size != count * dtype.itemsize or begin + size > len(data):
        raise ValueError(f"{size} bytes for {count} numbers of {dtype.itemsize}, {max(len(data) - begin, 0)} are there")
    return np.frombuffer(data, dtype, count, begin).astype(float).reshape(variable.shape, order="F")
