"""Reading of files that others may have made: by kind before they are opened, and no more of them than makes sense."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from srfcli.errors import SrfError

TEXT = 4 * 2**20  # bytes of a law, of settings or of an answer

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)


def check_plain(path: Path) -> os.stat_result:
    """Return what the system says of a regular file; raises SrfError for any other kind and OSError where there is none.

    A FIFO would keep its reader waiting for ever, a device may never end: neither is opened to find out.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        kind = next((name for is_kind, name in _KINDS if is_kind(found.st_mode)), "no regular file")
        raise SrfError(f"{path}: {kind}, expected a file", "Name a file; what comes through a pipe is saved first.")
    return found


def open_plain(path: Path) -> BinaryIO:
    """Open a regular file for reading; raises as `check_plain` does."""
    check_plain(path)
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):  # another one was put there meanwhile
        os.close(handle)
        raise SrfError(f"{path}: no regular file", "Name a file.")
    return os.fdopen(handle, "rb")


def read_plain(path: Path, *, limit: int = TEXT, what: str = "a description") -> bytes:
    """Return the content of a regular file of at most `limit` bytes; raises SrfError for a longer one, else as `open_plain`."""
    with open_plain(path) as stream:
        data = stream.read(limit + 1)
    if len(data) > limit:
        raise SrfError(f"{path}: longer than {limit / 2**20:g} MB, too long for {what}", "Is it the right file?")
    return data


def read_text(path: Path, *, limit: int = TEXT, what: str = "a description") -> str:
    """Return the text of a regular file, UTF-8 with or without a mark; raises as `read_plain`, and SrfError for other bytes."""
    data = read_plain(path, limit=limit, what=what)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SrfError(f"{path}: not UTF-8 text (byte {error.start})", "Save the file as UTF-8.") from None
