"""Generated and compiled modules, kept by content or shipped: a second start needs neither sympy nor a compiler.

The cache holds code that is run when it is read back, and must therefore not let foreign code in. Its folder must be the user's
own and closed to others. Every entry carries a seal: an HMAC of its name and content under a secret of the user's that lies
elsewhere. An entry without the right seal is never run; it is built anew. Where the cache is lost, broken, read-only or refused,
its content is kept in memory.

Modules of shipped laws come with the package; `tools/prebuild.py` of a checkout writes them. Each states the key under which it
was built, a hash of the laws' files and of all code that writes a module. It is used only for that key, so that an edited law or
changed code never gets an old module.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json
import logging
import os
import stat
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

from srfcli.core.errors import SrfError
from srfcli.core.files import read_plain

PREFIX = "# seal "
SECRET = 32  # bytes
LARGEST_ENTRY = 2**28  # bytes of an entry

_log = logging.getLogger("srfcli.core.cache")
_memory: dict[str, str] = {}


class _RefusedError(OSError):
    """A folder or a secret that must not be used; the text says why and what to do."""


def cache_folder() -> Path | None:
    """Return the folder in which entries are kept: $SRF_CACHE, else the user's cache folder.

    None where SRF_CACHE is empty, and, told once as a warning, where the folder or the secret is not the user's alone.
    """
    named = os.environ.get("SRF_CACHE")
    if named == "":
        return None
    try:
        folder = Path(named) if named else user_base("XDG_CACHE_HOME", ".cache") / "srf"
        _secret()
        return _own_folder(folder)
    except _RefusedError as error:
        _warn(f"nothing is cached: {error}")
    except (OSError, RuntimeError) as error:  # read-only, a file in the way, no home
        _log.info("nothing is cached: %s", error)
    return None


def content_key(parts: Sequence[str]) -> str:
    """Return a hexadecimal key of these texts, each with its length, so that no two lists share one."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode()
        digest.update(f"{len(data)}:".encode() + data)
    return digest.hexdigest()


def cached_source(key: str, build: Callable[[], str]) -> str:
    """Return the text stored under `key`, or build and store it; a cache that cannot be read or written is passed over."""
    folder = cache_folder()
    if folder is None:
        if key not in _memory:
            _memory[key] = build()
        return _memory[key]
    path = folder / f"{key}.py"
    found = _read(path)
    if found is not None:
        return found
    source = build()
    with contextlib.suppress(OSError):
        _write(path, source)
    return source


def seal(name: str, data: bytes) -> str:
    """Return the seal of an entry of that name and content, which nobody without the user's secret can make."""
    return hmac.new(_secret(), name.encode() + b"\0" + data, hashlib.sha256).hexdigest()


def is_sealed(name: str, data: bytes, found: str) -> bool:
    """Return whether `found` is the seal of that entry."""
    return hmac.compare_digest(seal(name, data).encode(), found.encode())


def _read(path: Path) -> str | None:
    """Return a stored text, or None where it is absent, cut short, changed or another's."""
    try:
        text = read_plain(path, limit=LARGEST_ENTRY).decode("utf-8")
    except (OSError, SrfError, UnicodeDecodeError):
        return None
    first, _, body = text.partition("\n")
    if not first.startswith(PREFIX) or not is_sealed(path.name, body.encode(), first.removeprefix(PREFIX)):
        return None
    return body


def _write(path: Path, source: str) -> None:
    """Store a text in one step, without a lock: a reader sees the whole entry or none, and of two writers the later one wins."""
    data = source.encode()
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem[:12]}-", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(f"{PREFIX}{seal(path.name, data)}\n".encode() + data)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def user_base(variable: str, below: str) -> Path:
    """Return a folder of the user's as the XDG specification places it: a relative one does not count."""
    named = Path(os.environ.get(variable, ""))
    return named if named.is_absolute() else Path.home() / below


def _own_folder(folder: Path) -> Path:
    """Return the folder, made where it is missing; raises _RefusedError unless it is the user's own and others cannot write."""
    for missing in reversed([p for p in (folder, *folder.parents) if not p.exists()]):
        missing.mkdir(exist_ok=True, mode=0o700)  # not parents=True, which leaves those above to the umask
    place = folder.resolve()
    if not hasattr(os, "geteuid"):
        return place
    found = place.stat()
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(f"{folder} is a file")
    if found.st_uid != os.geteuid():
        raise _RefusedError(f"{folder} belongs to another user; set SRF_CACHE to a folder of your own")
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise _RefusedError(f"others may write to {folder}; empty it, then: chmod go-w {folder}")
    for above in place.parents:
        mode = above.stat().st_mode
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            raise _RefusedError(f"others may replace {folder}, as {above} is open to all; set SRF_CACHE to another")
    return place


def _secret() -> bytes:
    """Return the user's secret, made at the first call; raises _RefusedError for one that others can read or have made."""
    folder = user_base("XDG_STATE_HOME", ".local/state") / "srf"
    path = _own_folder(folder) / "cache.key"
    if not os.path.lexists(path):
        _make_secret(path)
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        raise _RefusedError(f"{path} cannot be read: {error.strerror}; remove it, and a new one is made") from None
    try:
        found = os.fstat(handle)
        private = not hasattr(os, "geteuid") or (found.st_uid == os.geteuid() and not found.st_mode & 0o077)
        data = os.read(handle, SECRET + 1) if stat.S_ISREG(found.st_mode) else b""
    finally:
        os.close(handle)
    if not private or len(data) != SECRET:
        raise _RefusedError(f"{path} is damaged or open to others; remove it, and a new one is made")
    return data


def _make_secret(path: Path) -> None:
    """Put a new secret in place, readable by its owner alone; of several makers at once the first one wins."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".cache.key-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(os.urandom(SECRET))
        try:
            os.link(name, path)
        except FileExistsError:
            pass
        except OSError:  # a file system without links
            Path(name).replace(path)
    finally:
        Path(name).unlink(missing_ok=True)


@cache
def _warn(text: str) -> None:
    """Say this once, and not in every worker process."""
    module = sys.modules.get("multiprocessing")
    if module is None or module.parent_process() is None:
        _log.warning(text)


# Generated modules that are shipped.

SHIPPED_MODELS = Path(__file__).resolve().parents[1] / "codegen" / "models"
MARK = "# built under "


@dataclass(frozen=True)
class Built:
    """The text of a generated module, and its code where Python has compiled it."""

    source: str
    code: CodeType | None = None


def find_built(key: str, folder: Path = SHIPPED_MODELS) -> Built | None:
    """Return the module that was built under this key, or None where none is shipped."""
    path = folder / f"{key[:16]}.py"
    try:
        first, _, body = path.read_text(encoding="utf-8").partition("\n")
    except (OSError, ValueError):
        return None
    if first != f"{MARK}{key}":
        return None
    return Built(body, SourceFileLoader(path.stem, str(path)).get_code(path.stem))


@cache
def known_headers() -> dict[str, list[tuple[str, str, str]]]:
    """Return (kind, name, about) of what the shipped law files hold, by `header_key`."""
    try:
        table = json.loads((SHIPPED_MODELS / "headers.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {key: [(kind, name, about) for kind, name, about in rows] for key, rows in table.items()}


def header_key(path: Path, data: bytes) -> str:
    """Return what a law file's header depends on: its name and its content."""
    return f"{path.name} {hashlib.sha256(data).hexdigest()}"
