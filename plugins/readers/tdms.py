"""TDMS files of LabVIEW: one channel for each column."""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.core.errors import WHOLE, damaged
from srfcli.laws.api import Source, SrfError, reader

ROWS = 2**18  # read at a time
UNITS = ("unit_string", "NI_UnitDescription", "units", "unit")  # properties of a channel that state one


@reader(name="tdms", suffixes=(".tdms",), sniff=lambda head: head.startswith(b"TDSm"))
def tdms(path: Path) -> Source:
    """LabVIEW TDMS, a channel for each column; units in its properties or [columns], the time from wf_increment"""
    library = _library(path)
    with _opened(library, path) as file:
        with damaged(f"{path}: not a whole TDMS file"):
            channels = [c for group in file.groups() for c in group.channels() if _numeric(c)]
            cut = file.file_status.incomplete_final_segment
        if cut:
            raise SrfError(f"{path}: not a whole TDMS file: its last segment breaks off", WHOLE)
        rows = max((len(c) for c in channels), default=0)
        if not rows:
            raise SrfError(f"{path}: holds no channel of numbers", "A recording has a channel for each quantity.")
        channels = [c for c in channels if len(c) == rows]  # a lone number is a remark, not a column
        names = [c.name for c in channels]
        places: dict[str, tuple[str, str] | tuple[float, float]] = {}
        for channel in channels:
            name = channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}"
            unit = next((str(channel.properties[key]) for key in UNITS if channel.properties.get(key)), "")
            places[f"{name} [{unit}]" if unit and "[" not in name else name] = (channel.group_name, channel.name)
        clock = channels[0].properties
        step, begin = clock.get("wf_increment"), clock.get("wf_start_offset", 0.0)
        if not any("time" in heading.lower() for heading in places) and isinstance(step, float) and step > 0:
            places = {"time [s]": (float(begin), step), **places}
    headings = tuple(places)

    def blocks(wanted: tuple[int, ...]) -> Iterator[Sequence[np.ndarray]]:
        with _opened(library, path) as opened:
            for at in range(0, rows, ROWS):
                yield [_part(opened, path, places[headings[k]], at, min(ROWS, rows - at)) for k in wanted]

    return Source(headings, blocks, rows)


def _library(path: Path) -> Any:
    try:
        import nptdms
        from nptdms.log import log_manager
    except ImportError:
        raise SrfError(
            f"{path}: a TDMS file, which npTDMS reads, and npTDMS is not installed",
            'pip install "srfcli[tdms]", or export the file as text.',
        ) from None
    log_manager.set_level(logging.ERROR)  # of a file that breaks off it warns, and is refused below
    return nptdms


def _opened(library: Any, path: Path) -> Any:
    with damaged(f"{path}: not a whole TDMS file"):
        return library.TdmsFile.open(path)


def _numeric(channel: Any) -> bool:
    return channel.dtype is not None and np.dtype(channel.dtype).kind in "fiu"


def _part(file: Any, path: Path, place: Any, at: int, count: int) -> np.ndarray:
    if isinstance(place[0], float):
        return np.asarray(place[0] + place[1] * np.arange(at, at + count))
    with damaged(f"{path}: channel '{place[1]}' cannot be read"):
        found = np.asarray(file[place[0]][place[1]].read_data(offset=at, length=count), dtype=float)
    if found.size != count:
        raise SrfError(f"{path}: channel '{place[1]}' ends early", WHOLE)
    return found
