"""Reading of files that others may have made: by kind before they are opened, and no more of them than makes sense."""

from __future__ import annotations

import io
import json
import os
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

from srfcli.errors import SrfError

TEXT = 4 * 2**20  # bytes of a law, of settings or of an answer

DEPTH = 32  # keys of one name: each costs all that stand before it
_LONG_KEY = re.compile(rf"""(?<![\w."'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{DEPTH}}}""")

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
        hint = "Name a file in it." if kind == "a folder" else "Name a file; save first what comes through a pipe."
        raise SrfError(f"no file {path}, but {kind}", hint)
    return found


def open_plain(path: Path) -> io.BufferedReader:
    """Open a regular file for reading; raises as `check_plain` does."""
    check_plain(path)
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):  # another one was put there meanwhile
        os.close(handle)
        raise SrfError(f"no file {path}, but something else by now", "Name a file.")
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


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """Return the table that a TOML text holds; raises SrfError, beginning with `path`, for anything else."""
    try:
        if long := next((n for n, line in enumerate(text.splitlines(), 1) if _LONG_KEY.search(line)), None):
            raise SrfError(f"{path}, line {long}: a key of more than {DEPTH} parts", "A few levels are enough.")
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SrfError(f"{path}: not TOML: {error}") from None
    except RecursionError:
        raise SrfError(f"{path}: nested too deeply", "A few levels are enough.") from None
    except (ValueError, OverflowError) as error:  # a number of thousands of digits
        raise SrfError(f"{path}: not TOML: {error}", "Write numbers as in 1.5e-3.") from None


def parse_json(text: str | bytes, where: object) -> Any:
    """Return what a JSON text holds; raises SrfError, beginning with `where`, for anything else."""
    try:
        return json.loads(text)
    except RecursionError:
        raise SrfError(f"{where}: nested too deeply") from None
    except ValueError as error:  # also bytes that are not UTF-8, and numbers of thousands of digits
        raise SrfError(f"{where}: not JSON: {error}") from None
