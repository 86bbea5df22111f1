"""Generated modules kept by content, so that a second start skips sympy; the cache can be lost, broken or read-only.

An entry is `<key>.py`, its first line the SHA-256 of the rest. The key is a hash of everything the text follows from: the
sources of the laws, the choices, and the version of the generator. An entry whose hash does not match is rebuilt.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

PREFIX = "# sha256 "


def cache_folder() -> Path | None:
    """Return where generated modules are kept: $SRF_CACHE, else the user's cache folder; None where SRF_CACHE is empty."""
    named = os.environ.get("SRF_CACHE")
    if named is not None:
        return Path(named) if named else None
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "srf"
    except RuntimeError:  # no home directory
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
        return build()
    path = folder / f"{key}.py"
    found = _read(path)
    if found is not None:
        return found
    source = build()
    with contextlib.suppress(OSError):
        _write(path, source)
    return source


def _read(path: Path) -> str | None:
    """Return a stored text, or None where it is absent, cut short or changed."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None
    first, _, body = text.partition("\n")
    if first != PREFIX + hashlib.sha256(body.encode()).hexdigest():
        return None
    return body


def _write(path: Path, source: str) -> None:
    """Store a text in one step: a reader sees the whole entry or none, and of two writers the later one wins."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    text = PREFIX + hashlib.sha256(source.encode()).hexdigest() + "\n" + source
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem[:12]}-", suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
