"""Generated modules of shipped laws that come with the package, so that a first start needs no sympy.

`tools/prebuild.py` of a checkout writes them. Each names the key under which it was built: the content of the laws' files and of
all that writes a module. It is used only where what is asked for has that very key, so that a law that was edited, or code that
was changed, never gets an old module.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

FOLDER = Path(__file__).resolve().parent / "data" / "models"
MARK = "# built under "


@dataclass(frozen=True)
class Built:
    """The text of a generated module, and its code where Python has compiled it."""

    source: str
    code: CodeType | None = None


def find_built(key: str) -> Built | None:
    """Return the module that was built under this key, or None where none is shipped."""
    path = FOLDER / f"{key[:16]}.py"
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
        table = json.loads((FOLDER / "headers.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {key: [(kind, name, about) for kind, name, about in rows] for key, rows in table.items()}


def header_key(path: Path, data: bytes) -> str:
    """Return what a law file's header depends on: its name and its content."""
    return f"{path.name} {hashlib.sha256(data).hexdigest()}"
