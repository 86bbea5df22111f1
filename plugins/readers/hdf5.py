"""HDF5 files, MATLAB 7.3 among them: one dataset for each column."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.core.errors import damaged
from srfcli.laws.api import Source, SrfError, reader

SIGNATURE = b"\x89HDF\r\n\x1a\n"
BEHIND_MATLAB = 512  # bytes of text before it in a MATLAB file
ROWS = 2**18  # read at a time
MOST = 10_000  # datasets of a file, and columns of one
UNITS = ("units", "unit", "Units", "Unit")  # attributes that state them
HEADINGS = ("columns", "column_names", "Columns", "names")  # attributes that head a matrix's columns
TEXT = ("char", "string", "cell", "function_handle", "logical")  # MATLAB classes that are no numbers


def _is_hdf5(head: bytes) -> bool:
    return head.startswith(SIGNATURE) or head[BEHIND_MATLAB : BEHIND_MATLAB + 8] == SIGNATURE


@reader(name="hdf5", suffixes=(".h5", ".hdf5", ".hdf", ".nc"), sniff=_is_hdf5)
def hdf5(path: Path) -> Source:
    """HDF5 and MATLAB 7.3, a dataset for each column, or those of a matrix; units in attributes or [columns]"""
    h5py = _library(path)
    with path.open("rb") as stream:
        matlab = stream.read(11).startswith(b"MATLAB 7.3")
    with _opened(h5py, path) as file:
        found = _columns(h5py, file, path, matlab)
        if not found:
            raise SrfError(f"{path}: holds no dataset of numbers", "Save one for each column, as time, force.")
        rows = max(length for _, _, length in found.values())
    found = {heading: place for heading, place in found.items() if place[2] == rows}  # a lone number is a remark
    headings = tuple(found)

    def blocks(wanted: tuple[int, ...]) -> Iterator[Sequence[np.ndarray]]:
        with _opened(h5py, path) as opened:
            for at in range(0, rows, ROWS):
                yield [_part(opened, path, *found[headings[k]][:2], slice(at, at + ROWS)) for k in wanted]

    return Source(headings, blocks, rows)


def _library(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise SrfError(
            f"{path}: an HDF5 file (MATLAB 7.3 is one), which h5py reads, and h5py is not installed",
            'pip install "srfcli[hdf5]", or save the file from MATLAB with -v7, or as CSV.',
        ) from None
    return h5py


def _opened(h5py: Any, path: Path) -> Any:
    with damaged(f"{path}: not a whole HDF5 file"):
        return h5py.File(path, "r")


def _columns(h5py: Any, file: Any, path: Path, matlab: bool) -> dict[str, tuple[str, Any, int]]:
    """Return by heading the dataset, which part of it the column is (a field, or axis and index), and its length."""
    places: list[tuple[str, str, Any, int, str]] = []  # name, dataset, part, length, unit

    def visit(name: str, item: Any) -> bool | None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return None
        units = _attribute(item, UNITS)
        unit = units[0] if units else ""
        short = name.rpartition("/")[2]
        if item.dtype.names and item.ndim == 1:
            kinds = {field: item.dtype[field].kind for field in item.dtype.names}
            places.extend((f, name, f, item.shape[0], unit) for f, kind in kinds.items() if kind in "fiu")
        elif item.dtype.kind in "fiu" and _text(item.attrs.get("MATLAB_class", "")) not in TEXT:
            long = [n for n in item.shape if n != 1]
            if len(long) <= 1 and item.ndim:
                axis = item.shape.index(long[0]) if long else 0
                places.append((short, name, (axis, None), long[0] if long else 1, unit))
            elif len(long) == 2 == item.ndim:
                axis = 1 if matlab else 0  # MATLAB's matrices are stored column by column
                count = min(item.shape[1 - axis], MOST)
                heads = _attribute(item, HEADINGS)
                heads = heads if len(heads) == count else [f"{short}_{k + 1}" for k in range(count)]
                own = units if len(units) == count else [unit] * count
                places.extend((heads[k], name, (axis, k), item.shape[axis], own[k]) for k in range(count))
        return True if len(places) > MOST else None

    with damaged(f"{path}: not a whole HDF5 file"):
        file.visititems(visit)
    names = [place[0] for place in places]
    found = {}
    for short, name, part, length, unit in places[:MOST]:
        own = isinstance(part, str) or part[1] is not None
        alone = short if names.count(short) == 1 else f"{name}/{short}" if own else name
        found[f"{alone} [{unit}]" if unit and "[" not in alone else alone] = (name, part, length)
    return found


def _attribute(item: Any, keys: Sequence[str]) -> list[str]:
    """Return the texts of the first of these attributes that a dataset has: one, one for each column, or between commas."""
    value = next((item.attrs[key] for key in keys if key in item.attrs), "")
    if isinstance(value, np.ndarray) and value.ndim:
        return [_text(part) for part in value.ravel()]
    return [part.strip() for part in _text(value).split(",")]


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        value = value.ravel()[0] if value.size else ""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _part(file: Any, path: Path, name: str, part: Any, rows: slice) -> np.ndarray:
    with damaged(f"{path}: dataset '{name}' cannot be read"):
        data = file[name]
        if isinstance(part, str):
            return np.asarray(data[rows][part], dtype=float)
        axis, index = part
        place = [index if index is not None else 0] * data.ndim
        return np.asarray(data[tuple(rows if k == axis else place[k] for k in range(data.ndim))], dtype=float)
