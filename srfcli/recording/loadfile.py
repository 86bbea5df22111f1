"""A recorded normal load alone, without the rest of a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from srfcli.errors import SrfError
from srfcli.numerics.program import Load
from srfcli.reader import Source
from srfcli.recording.columns import LIMIT, split_heading
from srfcli.recording.description import ROLES, check_unit
from srfcli.recording.load import Place, load_from_column
from srfcli.recording.series import kept_samples
from srfcli.recording.source import open_source
from srfcli.recording.values import Array, Notice
from srfcli.registry import Registry

LOADS = ("normal_load", "normal_stress")


def read_load(
    path: Path, *, registry: Registry, format: str | None = None, limit: int = LIMIT
) -> tuple[Load, Array, tuple[Notice, ...]]:
    """Return the load in the columns `time` and `normal_load` (or `normal_stress`) of a data file, its times (n,) in s, and
    what was found in the data. Units are those of the headings, else s, N and MPa. `format` names the file's reader.

    Raises SrfError for a missing column, fewer than four samples, and more than `limit` bytes.
    """
    source = open_source(path, registry=registry, format=format)
    columns, heading = _find(path, source)
    t, W = _read(path, source, columns, limit)
    rows = np.arange(1, t.size + 1)
    keep, notices = kept_samples(path, rows, t)
    place = Place(path, heading, rows[keep], t[keep])
    load, told = load_from_column(place, W[keep])
    return load, place.t, (*notices, *told)


def _find(path: Path, source: Source) -> tuple[tuple[tuple[int, float], ...], str]:
    """Return (column, factor to base units) of the times and of the loads, and the heading of the loads."""
    parts = [split_heading(h) for h in source.headings]
    names = [name.strip().lower().replace(" ", "_") for name, _ in parts]
    role = next((r for r in LOADS if r in names), None)
    if "time" not in names or role is None:
        missing = "time" if "time" not in names else " or ".join(LOADS)
        raise SrfError(
            f"{path}: no column {missing}; found: {', '.join(source.headings)}",
            "Head the columns time [s],normal_load [N].",
        )
    found = []
    for name in ("time", role):
        column = names.index(name)
        unit = parts[column][1]
        where = f"{path}: column '{source.headings[column]}'"
        found.append((column, check_unit(ROLES[name] if unit is None else unit, name, None, where)))
    return tuple(found), source.headings[names.index(role)]


def _read(path: Path, source: Source, columns: tuple[tuple[int, float], ...], limit: int) -> tuple[Array, Array]:
    blocks: list[Array] = []
    held = 0
    for block in source.blocks(tuple(column for column, _ in columns)):
        part = np.array([np.asarray(b, float) * factor for b, (_, factor) in zip(block, columns, strict=True)])
        held += part.nbytes
        if held > limit:
            raise SrfError(
                f"{path}: more than {limit / 2**20:g} MB of loads", "Cut the file to the times that are needed."
            )
        blocks.append(part)
    t, W = np.concatenate(blocks, axis=1) if blocks else np.empty((2, 0))
    return t, W
