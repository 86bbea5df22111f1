"""From a file to its columns: which reader opens it, and that what the reader gives is what readers promise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.errors import SrfError, did_you_mean
from srfcli.reader import Reader, Source
from srfcli.reading import open_plain
from srfcli.recording.values import Array
from srfcli.registry import Entry, Registry

SNIFFED = 4096  # bytes
SLICE = 2**18  # rows that are taken from an array at a time


def open_source(path: Path, *, registry: Registry, format: str | None = None) -> Source:
    """Return the columns of a data file, by the reader called `format`, else by the one that knows the content.

    Raises SrfError where the file is missing or empty, where no reader or more than one knows it, and for what readers refuse.
    """
    head = _head(path)
    reader = _named(registry, format) if format else _sniffed(path, head, registry)
    try:
        found = reader.read(path)
    except SrfError:
        raise
    except Exception as error:  # a reader is anybody's code, and the file anybody's bytes
        raise _refusal(reader, path, error) from error
    source = found if isinstance(found, Source) else _from_mapping(found, reader, path)
    if not source.headings or not all(isinstance(h, str) for h in source.headings):
        raise SrfError(f"{path}: the reader '{reader.name}' finds no columns", "Check the file, or name its kind.")
    return Source(
        source.headings,
        lambda columns: _guarded(source, columns, reader, path),
        source.rows,
        source.whole,
        source.remarks,
        source.about,
    )


def _head(path: Path) -> bytes:
    try:
        with open_plain(path) as stream:
            head = stream.read(SNIFFED)
    except FileNotFoundError:
        if not path.parent.is_dir():
            raise SrfError(f"no file {path}", f"There is no folder {path.parent}.") from None
        names = [p.name for p in path.parent.glob("*")]
        raise SrfError(f"no file {path}", did_you_mean(path.name, names) if names else "Its folder is empty.") from None
    except OSError as error:
        raise _unreadable(path, error) from None
    if not head:
        raise SrfError(f"{path}: the file is empty", "A recording has a line of headings and a line for each sample.")
    return head


def _named(registry: Registry, name: str) -> Reader:
    return registry.reader(registry.find("reader", name))


def _sniffed(path: Path, head: bytes, registry: Registry) -> Reader:
    """Return the reader whose test the first bytes pass; one that has no test goes by the file's ending, and comes first."""
    readers = [(entry, registry.reader(entry)) for entry in registry.entries("reader")]
    by_suffix = [(e, r) for e, r in readers if r.sniff is None and path.suffix.lower() in r.suffixes]
    found = by_suffix or [(e, r) for e, r in readers if r.sniff is not None and _passes(r, head)]
    if len(found) > 1:  # content alone does not decide: the ending does
        found = [(e, r) for e, r in found if path.suffix.lower() in r.suffixes] or found
    names = ", ".join(sorted({e.name for e, _ in readers}))
    if not found and head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise SrfError(f"{path}: UTF-16 text", "Save the file as UTF-8.")
    if not found:
        raise SrfError(f"{path}: no reader knows this kind of file", f'Name one with format = "...": {names}.')
    if len(found) > 1:
        raise SrfError(
            f"{path}: {_listed([e for e, _ in found])} would read this file",
            f'Choose with format = "{found[0][0].name}".',
        )
    return found[0][1]


def _listed(entries: Sequence[Entry]) -> str:
    return " and ".join(f"'{e.name}' ({e.origin})" for e in entries)


def _passes(reader: Reader, head: bytes) -> bool:
    assert reader.sniff is not None
    try:
        return bool(reader.sniff(head))
    except Exception:  # a test that fails on strange bytes does not know the file
        return False


def _unreadable(path: Path, error: OSError) -> SrfError:
    return SrfError(f"{path}: cannot be read: {error.strerror or error}", "Check path and permissions.", exit_code=1)


def _refusal(reader: Reader, path: Path, error: Exception) -> SrfError:
    if isinstance(error, OSError):
        return _unreadable(path, error)
    told = " ".join(str(error).split())[:200]
    return SrfError(
        f"{path}: the reader '{reader.name}' stopped: {type(error).__name__}: {told}",
        "Check the file, or name its kind with format = ... (`srf laws --kind reader`).",
    )


def _from_mapping(found: object, reader: Reader, path: Path) -> Source:
    """Return the source of a reader that gave arrays by heading."""
    if not isinstance(found, Mapping):
        raise SrfError(
            f"{path}: the reader '{reader.name}' returned {type(found).__name__}, expected columns by heading",
            'Return {"time [s]": times, ...} or a Source.',
        )
    arrays = {str(heading): np.asarray(values) for heading, values in found.items()}
    for heading, values in arrays.items():
        if values.ndim != 1:
            raise SrfError(f"{path}: column '{heading}' has the shape {values.shape}", "Give one row of numbers each.")
    lengths = {values.size for values in arrays.values()}
    if len(lengths) > 1:
        told = ", ".join(f"'{h}': {v.size}" for h, v in arrays.items())
        raise SrfError(f"{path}: the columns differ in length: {told}", "Every column needs a value for every sample.")
    rows = lengths.pop() if lengths else 0
    columns = tuple(arrays.values())

    def blocks(wanted: tuple[int, ...]) -> Iterator[Sequence[Any]]:
        for at in range(0, rows, SLICE):
            yield [columns[k][at : at + SLICE] for k in wanted]

    return Source(tuple(arrays), blocks, rows)


def _guarded(source: Source, columns: tuple[int, ...], reader: Reader, path: Path) -> Iterator[Sequence[Array]]:
    """Yield blocks of float arrays of equal length, whatever the reader does."""
    blocks = iter(source.blocks(columns))
    while True:
        try:
            block = next(blocks, None)
            if block is None:
                return
            arrays = [np.asarray(values, dtype=float) for values in block]
            if len(arrays) != len(columns) or len({a.shape for a in arrays}) != 1 or arrays[0].ndim != 1:
                raise ValueError(f"shapes {[a.shape for a in arrays]} for {len(columns)} columns")
        except SrfError:
            raise
        except Exception as error:
            raise _refusal(reader, path, error) from error
        yield arrays
