"""The binary 'look' files of the Penn State rock mechanics laboratory (xlook, pylook)."""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from srfcli.core.errors import WHOLE
from srfcli.laws.api import Source, SrfError, reader

FILE_HEADER, CHANNEL_HEADER = 36, 84  # bytes
CHANNELS = (32, 16)  # channel headers that a file has, whether they are used or not; older ones have sixteen
LEAST = FILE_HEADER + min(CHANNELS) * CHANNEL_HEADER
CODE = (
    "In look files Time often is a code for the interval between samples, in 1e-4 s, and neither time nor rate: "
    '[columns] time = { name = "Time", scale = 1e-4, unit = "s", integrate = true }.'
)


def _is_look(head: bytes) -> bool:
    if len(head) < LEAST:
        return False
    records, channels = struct.unpack(">ii", head[20:28])
    name, unit = (_text(head[FILE_HEADER + a : FILE_HEADER + b]) for a, b in ((0, 13), (13, 26)))
    return 0 < channels <= max(CHANNELS) and records > 0 and name.isprintable() and unit.isprintable() and bool(name)


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("latin-1").strip()


@reader(name="look", sniff=_is_look)
def look(path: Path) -> Source:
    """Penn State look file: big-endian numbers, channel after channel; units and scales in [columns]"""
    with path.open("rb") as stream:
        head = stream.read(FILE_HEADER + max(CHANNELS) * CHANNEL_HEADER)
    if not _is_look(head):
        raise SrfError(f"{path}: not a look file: its header does not name 1 to 32 channels and their records")
    records, count = struct.unpack(">ii", head[20:28])
    whole = path.stat().st_size
    # how many headers there are is not written down: what is left over by the numbers tells
    own = (n for n in CHANNELS for width in (4, 8) if whole == FILE_HEADER + n * CHANNEL_HEADER + width * records * count)
    channels = next(own, max(CHANNELS))
    begin = FILE_HEADER + channels * CHANNEL_HEADER
    headings, lengths, names = [], [], set()
    for k in range(channels):
        entry = head[FILE_HEADER + k * CHANNEL_HEADER : FILE_HEADER + (k + 1) * CHANNEL_HEADER]
        name, unit = _text(entry[:13]), _text(entry[13:26])
        if len(entry) < CHANNEL_HEADER:
            break
        (elements,) = struct.unpack(">i", entry[80:84])
        if len(headings) < count and name != "no_val" and elements > 0:
            name = name if name not in names else f"{name}_{k + 1}"
            names.add(name)
            known = unit and unit.lower() not in ("bits", "none", "no_val")  # counts of a converter have no unit
            headings.append(f"{name} [{unit}]" if known else name)
            lengths.append(elements)
    if not headings or len(set(lengths)) != 1:
        raise SrfError(f"{path}: the channels have {lengths} records", "A run needs channels of one length.")
    rows, size = lengths[0], whole - begin
    width = size // (rows * len(headings)) if rows else 0
    if width not in (4, 8) or size != width * rows * len(headings):
        raise SrfError(
            f"{path}: {size} bytes of numbers for {len(headings)} channels of {rows} records, expected 4 or 8 bytes each", WHOLE
        )
    data = np.memmap(path, dtype=f">f{width}", mode="r", offset=begin, shape=(len(headings), rows))

    def blocks(wanted: tuple[int, ...]) -> Iterator[Sequence[np.ndarray]]:
        for at in range(0, rows, 2**18):
            yield [data[k, at : at + 2**18].astype(float) for k in wanted]

    remarks = {heading: CODE for heading in headings if heading.startswith("Time")}
    return Source(tuple(headings), blocks, rows, remarks=remarks)
