"""What a reader of data files is: a frozen value that turns a file into named columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Blocks = Callable[[tuple[int, ...]], Iterator[Sequence[Any]]]


@dataclass(frozen=True)
class Source:
    """The columns of one file: headings such as `time [s]`, and a function that reads some of them block by block.

    `blocks((2, 0))` yields pairs of equally long arrays, of columns 2 and 0. `rows` is their number where the file says it.
    `whole` is True where a column cannot be read in parts. `remarks` is what the user of a column should know, by heading.
    `about` is an estimate of their number, by which a file that is far too large is refused unread.
    """

    headings: tuple[str, ...]
    blocks: Blocks = field(repr=False)
    rows: int | None = None
    whole: bool = False
    remarks: Mapping[str, str] = field(default_factory=dict)
    about: int | None = None


@dataclass(frozen=True)
class Reader:
    """A kind of data file: how it is recognised and how it is read.

    `read(path)` returns a `Source`, or a mapping from headings to equally long arrays. `sniff(head)` tells the kind from the
    first 4096 bytes; without it the `suffixes` do.
    """

    name: str
    read: Callable[[Path], Source | Mapping[str, Any]] = field(repr=False)
    suffixes: tuple[str, ...] = ()
    sniff: Callable[[bytes], bool] | None = field(default=None, repr=False)
    about: str = ""
    source: str = field(default="", compare=False)
