"""Files that are whole or absent: written beside their place and moved there, never over another without consent."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from srfcli.atomic import recover, write_files
from srfcli.errors import SrfError


def check_target(path: Path, *, force: bool, what: str = "--out") -> None:
    """Raise SrfError now if `path` could not be written later: before an hour of computing, not after it."""
    recover(path)
    if path.is_dir():
        raise SrfError(f"{what} {path} is a directory", f"Name a file in it: {what} {path / 'result.csv'}")
    if not path.parent.is_dir():
        raise SrfError(
            f"{what} {path}: the directory {path.parent} does not exist", f"Create it: mkdir -p {path.parent}"
        )
    if is_special(path):
        return
    if path.exists() and not force:
        raise SrfError(f"{what} {path} exists already", "Overwrite it with --force, or name another file.")
    if not os.access(Path(os.path.realpath(path)).parent, os.W_OK):
        raise SrfError(
            f"{what} {path}: the directory {path.parent} is not writable", "Name a file elsewhere.", exit_code=1
        )


def is_special(path: Path) -> bool:
    """Return whether `path` is a device or a pipe, which is written through and must never be replaced."""
    try:
        return not stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return False


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write `content` to `path` so that a reader, or a crash, finds the old file or the new one and nothing between."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    if is_special(path):
        path.write_bytes(data)
    else:
        write_files({path: data})
