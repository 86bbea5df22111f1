"""A sidecar beside each result: what made it, from what, with which versions."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from srfcli.core import __version__
from srfcli.core.errors import SrfError
from srfcli.core.files import SIDECAR, is_special, open_plain, write_atomic, write_files
from srfcli.laws.values import Law
from srfcli.results.tables import json_text, plain_value

SCHEMA = "srf.provenance/1"
LIBRARIES = ("click", "matplotlib", "numpy", "pint", "scipy", "sympy")


@dataclass(frozen=True)
class Provenance:
    """What made a result. `timings` (seconds by name) is the only part that differs from one run to the next."""

    arguments: tuple[str, ...] = ()
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    laws: tuple[Law, ...] = ()
    inputs: tuple[Path, ...] = ()
    seed: int | None = None
    timings: Mapping[str, float] = field(default_factory=dict)


def sidecar_path(path: Path) -> Path:
    """Return the place of the sidecar of the result at `path`."""
    return path.with_name(path.name + SIDECAR)


def write_result(path: Path, content: bytes, provenance: Provenance | None) -> Path | None:
    """Write a result with its sidecar, both or neither, and return the sidecar's place.

    Without `provenance` there is no sidecar, and that of an older result goes; a device or a pipe has none.
    """
    if is_special(path):
        write_atomic(path, content)
        return None
    target = Path(os.path.realpath(path))  # a sidecar lies beside the file itself, not beside a link to it
    if provenance is None:
        older = {sidecar_path(target): None} if os.path.lexists(sidecar_path(target)) else {}
        write_files({target: content, **older})
        return None
    write_files({target: content, sidecar_path(target): sidecar(path, content, provenance).encode("utf-8")})
    return sidecar_path(path)


def sidecar(path: Path, content: bytes, provenance: Provenance) -> str:
    """Return the text of the sidecar of the result `content` at `path`; the timings are its last key."""
    data = {
        "schema": SCHEMA,
        "file": path.name,
        "sha256": hashlib.sha256(content).hexdigest(),
        "arguments": list(provenance.arguments),
        "versions": versions(),
        "laws": [
            {"name": x.name, "source": x.source, "sha256": file_hash(Path(x.source)) if x.source else None}
            for x in provenance.laws
        ],
        "parameters": provenance.parameters,
        "inputs": {str(place): file_hash(place) for place in provenance.inputs},
        "seed": provenance.seed,
        "timings": {name: round(seconds, 6) for name, seconds in provenance.timings.items()},
    }
    return json_text(plain_value(data), indent=2) + "\n"


def file_hash(path: Path) -> str | None:
    """Return the SHA-256 of a file's bytes, or None where there is no such file."""
    try:
        with open_plain(path) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, SrfError, ValueError):
        return None


def versions() -> dict[str, str]:
    """Return the versions of srf, Python and the installed libraries, without importing any."""
    from importlib import metadata  # costs a sixth of the start, and only sidecars need it

    found = {"srf": __version__, "python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
