"""MATLAB files of version 5: one vector for each column."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from srfcli.api import Source, SrfError, reader

MOST = 10_000  # columns of a matrix
NUMERIC = {"double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"}


@reader(
    name="matlab",
    suffixes=(".mat",),
    sniff=lambda head: head.startswith(b"MATLAB ") and head[126:128] in (b"IM", b"MI"),
)
def matlab(path: Path) -> Source:
    """MATLAB 5 file, a vector for each column, or a matrix `data` as data_1, data_2, ...; units in [columns]"""
    from scipy.io import loadmat, whosmat

    with path.open("rb") as stream:
        head = stream.read(512)
    if head.startswith(b"MATLAB 7.3"):
        raise SrfError(f"{path}: MATLAB 7.3 is another format (HDF5)", "Save it with save(..., '-v7') or as CSV.")
    try:
        found = whosmat(path)
    except Exception as error:
        raise SrfError(f"{path}: not a whole MATLAB 5 file: {error}", "Was the file copied to its end?") from None
    places: dict[str, tuple[str, int]] = {}
    lengths: dict[str, int] = {}
    for name, shape, kind in found:
        if kind not in NUMERIC or len(shape) != 2 or 0 in shape:
            continue
        rows, columns = (max(shape), 1) if 1 in shape else shape
        if columns > MOST:
            raise SrfError(f"{path}: variable '{name}' has {columns} columns", f"A recording has up to {MOST} of them.")
        for k in range(columns):
            heading = name if columns == 1 else f"{name}_{k + 1}"
            places[heading], lengths[heading] = (name, k), rows
    if not places:
        raise SrfError(f"{path}: holds no vector of numbers", "Save one variable for each column, as time, force.")
    rows = max(lengths.values())
    headings = tuple(h for h in places if lengths[h] == rows)  # a lone number is a remark, not a column

    def blocks(wanted: tuple[int, ...]) -> Iterator[Sequence[np.ndarray]]:
        chosen = [places[headings[k]] for k in wanted]
        try:
            values = loadmat(path, variable_names=sorted({name for name, _ in chosen}))
        except Exception as error:
            raise SrfError(f"{path}: cannot be read: {error}", "Was the file copied to its end?") from None
        arrays = {name: np.asarray(values[name]) for name, _ in chosen}
        for name, array in arrays.items():
            if np.iscomplexobj(array):
                raise SrfError(f"{path}: variable '{name}' is complex", "Save its real part.")
        yield [a.ravel() if 1 in (a := arrays[name]).shape else a[:, k] for name, k in chosen]

    return Source(headings, blocks, rows, whole=True)
