"""Files: checked before they are read, written whole or not at all.

A file is written beside its place, under a name that begins with a dot and ends in `.part`, and moved there when it is complete.
The writer holds a lock on this part for as long as it lives, so that a part without a lock belongs to a dead process. The next
writer to the same place removes such a part or, where its writer died between two moves, makes the moves that are missing.
"""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import re
import secrets
import shutil
import signal
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import tomli

from srfcli.core.errors import SrfError

# Reading files that others may have made: their kind is checked before they are opened, and their size while they are read.

TEXT = 4 * 2**20  # bytes of a law, of settings or of an answer

DEEPEST_KEYS = 32  # keys of one name: each costs all that stand before it
_LONG_KEY = re.compile(rf"""(?<![\w."'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{DEEPEST_KEYS}}}""")

_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a FIFO", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}  # fmt: skip


def check_plain(path: Path) -> os.stat_result:
    """Return what the system says of a regular file; raises SrfError for any other kind and OSError where there is none.

    A FIFO would keep its reader waiting for ever, a device may never end: neither is opened to find out.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "no regular file")
        hint = "Name a file in it." if kind == "a folder" else "Name a file; save first what comes through a pipe."
        raise SrfError(f"no file {path}, but {kind}", hint, kind="no file")
    # said to be files, of no block of a disk; reading may wait or fail
    if os.name == "posix" and not found.st_blocks and path.resolve().parts[1:2] in (("proc",), ("sys",)):
        raise SrfError(
            f"no file {path}, but a part of the running system", "Name a file; copy what is meant to one first.", kind="no file"
        )
    return found


def open_plain(path: Path) -> io.BufferedReader:
    """Open a regular file for reading; raises as `check_plain` does."""
    check_plain(path)
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):  # another one was put there meanwhile
        os.close(handle)
        raise SrfError(f"no file {path}, but something else by now", "Name a file.", kind="no file")
    return os.fdopen(handle, "rb")


def read_plain(path: Path, *, limit: int = TEXT, what: str = "a description") -> bytes:
    """Return the content of a regular file of at most `limit` bytes; raises SrfError for a longer one, else as `open_plain`."""
    with open_plain(path) as stream:
        data = stream.read(limit + 1) or b""  # nothing where it would wait
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
            raise SrfError(f"{path}, line {long}: a key of more than {DEEPEST_KEYS} parts", "A few levels are enough.")
        return tomli.loads(text)
    except tomli.TOMLDecodeError as error:
        raise SrfError(f"{path}: not TOML: {error}") from None
    except RecursionError:
        raise SrfError(f"{path}: nested too deeply", "A few levels are enough.") from None
    except (ValueError, OverflowError) as error:  # a number of thousands of digits
        raise SrfError(f"{path}: not TOML: {error}", "Write numbers as in 1.5e-3.") from None


def toml_lines(table: Mapping[str, Any]) -> list[str]:
    """Return a table as lines of TOML, one `key = value` for each entry."""
    keys = [key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key) for key in table]
    return [f"{key} = {toml_value(value)}" for key, value in zip(keys, table.values(), strict=True)]


def toml_value(value: object) -> str:
    """Return text, a truth value, a number, a list or a table as TOML; tables are inline, numbers keep every digit."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):  # TOML's basic strings are JSON's, but for DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return f"{{ {', '.join(toml_lines(value))} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)


def parse_json(text: str | bytes, where: object) -> Any:
    """Return what a JSON text holds; raises SrfError, beginning with `where`, for anything else."""
    try:
        return json.loads(text)
    except RecursionError:
        raise SrfError(f"{where}: nested too deeply") from None
    except ValueError as error:  # also bytes that are not UTF-8, and numbers of thousands of digits
        raise SrfError(f"{where}: not JSON: {error}") from None


# Writing files, a result with its sidecar, and folders, whole even if the process is killed; removing what a killed one left.

try:
    import fcntl
except ImportError:  # a system without locks of this kind: there parts of dead processes stay
    fcntl = None  # type: ignore[assignment]

SIDECAR = ".provenance.json"
OLD = "replaced"


def write_files(contents: Mapping[Path, bytes | None]) -> None:
    """Write these files of one folder so that a crash leaves all old or, at the latest after `recover`, all new.

    None removes a file, and is not for the first. The moves of several files are noted in a file beside the first before any is
    made. Raises SrfError with exit code 1 where something cannot be written; nothing has changed then.
    """
    targets = [Path(os.path.realpath(path)) for path in contents]  # through a link, so that the link survives
    recover(targets[0])
    with contextlib.ExitStack() as held:
        parts: list[tuple[Path | None, Path]] = []
        for target, data in zip(targets, contents.values(), strict=True):
            with _told(target):
                part = held.enter_context(_part(target)) if data is not None else None
                if part is not None and data is not None:
                    _fill(part, data)
                    if target.exists():
                        part.chmod(stat.S_IMODE(target.stat().st_mode))
                parts.append((part, target))
        moves = {(part or target).name: target.name if part else None for part, target in parts}
        with _told(targets[0]), _uninterrupted():
            if len(moves) == 1 and (only := parts[0][0]) is not None:
                only.replace(targets[0])
                return
            note = held.enter_context(_part(targets[0]))
            _fill(note, json.dumps(moves).encode())
            note.replace(_note(targets[0]))
            for part, target in parts:
                target.unlink(missing_ok=True) if part is None else part.replace(target)
            _note(targets[0]).unlink()


@contextmanager
def whole_folder(folder: Path, check: Callable[[], None]) -> Iterator[Path]:
    """Give a folder to write to, which takes the place of `folder` when all went well and vanishes otherwise.

    `check` is called before it does, and raises where `folder` must not be replaced. Where the system can exchange two folders
    in one step, `folder` is there at every moment.
    """
    target = Path(os.path.realpath(folder))
    recover(target)
    with _told(target), _part(target, folder=True) as scratch:
        fresh, old = scratch / target.name, scratch / OLD
        fresh.mkdir()  # with the usual permissions, which the scratch folder does not have
        yield fresh
        check()
        with _uninterrupted():
            if not target.exists():
                fresh.rename(target)
            elif not _exchange(fresh, target):
                target.rename(old)
                try:
                    fresh.rename(target)
                except BaseException:
                    old.rename(target)
                    raise


def recover(target: Path) -> None:
    """End what a process that died had begun to write to `target`, and remove what it left beside it.

    A link is followed, one to itself to nowhere.
    """
    if fcntl is None:
        return
    target = Path(os.path.realpath(target))  # Path.resolve raises for a link to itself
    note = _note(target)
    with contextlib.suppress(OSError, SrfError):
        if (lock := _locked(note)) is not None:
            with lock:
                moves = parse_json(read_plain(note), note)
                _move_on(target, moves if isinstance(moves, dict) else {})
                note.unlink()
    if not target.parent.is_dir() or os.path.lexists(note):  # another process is at it
        return
    for part in _parts(target):
        _remove_abandoned(part, target)


def clear(folder: Path) -> None:
    """Remove from a folder the parts of files that dead processes were writing into it, whatever their names."""
    for part in folder.glob(".*.part") if fcntl is not None else ():
        _remove_abandoned(part)


def _remove_abandoned(part: Path, target: Path | None = None) -> None:
    """Remove a part unless a living process has locked it; the old folder in it returns to `target` if that is gone."""
    with contextlib.suppress(OSError):
        if (lock := _locked(part)) is None:
            return
        with lock:
            if target is not None and (part / OLD).is_dir() and not os.path.lexists(target):
                (part / OLD).rename(target)  # its writer died between the two moves of a folder
            shutil.rmtree(part) if part.is_dir() else part.unlink()


def _note(target: Path) -> Path:
    return target.with_name(f".{target.name}.moves")


def _parts(target: Path) -> list[Path]:
    """Return the parts of `target` and of its sidecar."""
    part = re.compile(rf"\.{re.escape(target.name)}(?:{re.escape(SIDECAR)})?\.[^.]*\.part")
    with contextlib.suppress(OSError):
        return [p for p in target.parent.iterdir() if part.fullmatch(p.name)]
    return []


def _move_on(target: Path, moves: Mapping[Any, Any]) -> None:
    """Make the noted moves that were not made; a note that names anything but parts of this result is none of ours."""
    known = {part.name for part in _parts(target)}
    for part, name in moves.items():
        if name is None and part == f"{target.name}{SIDECAR}":
            target.with_name(part).unlink(missing_ok=True)
        elif part in known and name in (target.name, f"{target.name}{SIDECAR}"):
            target.with_name(part).replace(target.with_name(name))


@contextmanager
def _part(target: Path, *, folder: bool = False) -> Iterator[Path]:
    """Give a locked part beside `target`, and remove what is left of it in the end."""
    while True:
        part = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
        if folder:
            part.mkdir(0o700)
        else:
            part.touch(0o600 if target.exists() else 0o666, exist_ok=False)  # a new file is readable as the umask says
        lock = _locked(part)
        if lock is not None:  # else another process took it for that of a dead one before it was locked
            break
    with lock:
        try:
            yield part
        finally:
            with contextlib.suppress(OSError):
                shutil.rmtree(part) if folder else part.unlink()


def _locked(place: Path) -> contextlib.ExitStack | None:
    """Return a lock on a file or folder until it is closed, None where it is gone, no plain one, or another's."""
    held = contextlib.ExitStack()
    if fcntl is None:
        return held
    try:
        handle = os.open(place, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    held.callback(os.close, handle)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        there, mine = place.lstat(), os.fstat(handle)
    except OSError:
        held.close()
        return None
    plain = stat.S_ISREG(mine.st_mode) or stat.S_ISDIR(mine.st_mode)
    if (there.st_dev, there.st_ino) != (mine.st_dev, mine.st_ino) or not plain:
        held.close()
        return None
    return held


def _fill(part: Path, data: bytes) -> None:
    with part.open("r+b") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


@contextmanager
def _told(target: Path) -> Iterator[None]:
    """Turn an error of the system into one that names the place that could not be written."""
    try:
        yield
    except OSError as error:
        raise SrfError(
            f"{target} cannot be written: {error.strerror or error}",
            "What was there is unchanged. Make room or look at the permissions, or name another place.",
            exit_code=1,
        ) from error


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Put off signals that could be put off: between two moves is no time to end."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; return whether the system could."""
    import ctypes

    first, second = os.fsencode(one), os.fsencode(other)
    with contextlib.suppress(AttributeError, OSError):
        library = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "linux":
            return library.renameat2(-100, first, -100, second, 2) == 0  # AT_FDCWD, RENAME_EXCHANGE
        if sys.platform == "darwin":
            return library.renamex_np(first, second, 2) == 0  # RENAME_SWAP
    return False


# Files that are whole or absent: written beside their place and moved there, never over another without consent.


def check_target(path: Path, *, force: bool, what: str = "--out") -> None:
    """Raise SrfError now if `path` could not be written later: before an hour of computing, not after it."""
    recover(path)
    shown = f"{what} {path}".strip()
    if path.is_dir():
        raise SrfError(f"{shown} is a directory", "Name a file in it: " + f"{what} {path / 'result.csv'}".strip())
    if not path.parent.is_dir():
        raise SrfError(f"{shown}: the directory {path.parent} does not exist", f"Create it: mkdir -p {path.parent}")
    if is_special(path):
        return
    if path.exists() and not force:
        raise SrfError(f"{shown} exists already", "Overwrite it with `force`, or name another file.")
    if not os.access(Path(os.path.realpath(path)).parent, os.W_OK):
        raise SrfError(f"{shown}: the directory {path.parent} is not writable", "Name a file elsewhere.", exit_code=1)


def check_folder_place(folder: Path, *, what: str = "") -> bool:
    """Return whether there is a folder already; raises SrfError now if none could be written there later."""
    recover(folder)
    shown, parent = f"{what} {folder}".strip(), Path(os.path.realpath(folder)).parent
    if not parent.is_dir():
        raise SrfError(f"{shown}: the directory {parent} does not exist", f"Create it: mkdir -p {parent}")
    if not os.access(parent, os.W_OK):
        raise SrfError(f"{shown}: the directory {parent} is not writable", "Name a folder elsewhere.", exit_code=1)
    if os.path.lexists(folder) and (not folder.is_dir() or folder.is_symlink()):
        raise SrfError(f"{shown} exists and is not a folder", "Name another folder.")
    return folder.is_dir()


def is_special(path: Path) -> bool:
    """Return whether `path` is a device or a pipe, which is written through and must never be replaced."""
    try:
        return not stat.S_ISREG(path.stat().st_mode)
    except OSError:
        return False


def unused_name(stem: str, suffix: str, taken: Iterable[str]) -> str:
    """Return a file name that is not taken: stem and suffix, and if need be a number from 2 on in between.

    Names that differ in capitals alone are the same, as some file systems do not tell them apart.
    """
    lowered = {other.lower() for other in taken}
    name, number = f"{stem}{suffix}", 2
    while name.lower() in lowered:
        name, number = f"{stem}-{number}{suffix}", number + 1
    return name


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write `content` to `path` so that a reader, or a crash, finds the old file or the new one and nothing between."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    if is_special(path):
        with _told(path), _open_special(path) as stream:
            stream.write(data)
    else:
        write_files({path: data})


def _open_special(path: Path) -> BinaryIO:
    """Open a device or a pipe for writing; raises SrfError for a pipe that nobody reads, which would keep its writer waiting."""
    try:
        handle = os.open(path, os.O_WRONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise SrfError(f"{path}: nobody reads this pipe", "Start its reader first.", exit_code=1) from None
        raise
    if hasattr(os, "O_NONBLOCK"):
        os.set_blocking(handle, True)
    return os.fdopen(handle, "wb")
