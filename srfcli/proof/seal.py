"""Truths under seal: a salted digest is published with the cases, the truths are kept apart until the answers are in."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from srfcli.errors import SrfError
from srfcli.output.files import write_atomic
from srfcli.reading import parse_json, read_plain

LARGEST = 2**28  # bytes of a file of a bank

SEAL, SCHEMA = "seal.json", "srf.seal/1"
Truths = dict[str, dict[str, Any]]


def seal(bank: Path, truths: Mapping[str, Mapping[str, Any]], apart: Path, *, seed: int | Sequence[int]) -> str:
    """Write the truths, case -> truth, to the file `apart`, and the digests of them and of every case to `bank`/seal.json.

    The salt is drawn from the seed, so that a bank made twice is the same to the byte; while the seed is secret the digest
    gives nothing away. Returns the truths' digest. Raises SrfError where `apart` lies among the cases.
    """
    if bank.resolve() in apart.resolve().parents:
        raise SrfError(f"{apart} lies in the folder of the cases", "Keep the truths where the diagnosis does not look.")
    salt = hashlib.sha256(f"salt of {json.dumps(seed)}".encode()).hexdigest()
    text = _canonical({"salt": salt, "truths": truths})
    digest = hashlib.sha256(text).hexdigest()
    write_atomic(apart, text)
    cases = {name: case_digest(bank / name) for name in sorted(truths)}
    write_atomic(bank / SEAL, _canonical({"schema": SCHEMA, "truths": digest, "cases": cases}))
    return digest


def unseal(bank: Path, apart: Path) -> Truths:
    """Return the truths, case -> truth; SrfError where they, or the files of a case, are not those that were sealed."""
    public = _read(bank / SEAL)
    if public.get("schema") != SCHEMA:
        raise SrfError(
            f"{bank / SEAL}: schema {public.get('schema')!r}, expected {SCHEMA!r}", "Is this a bank of cases?"
        )
    data = _bytes(apart)
    found = hashlib.sha256(data).hexdigest()
    if not hmac.compare_digest(found, str(public.get("truths"))):
        raise SrfError(
            f"{apart}: SHA-256 {found[:16]}..., sealed was {str(public.get('truths'))[:16]}...",
            "The truths were changed after they were sealed, or belong to another bank; results on it count for nothing.",
        )
    check_cases(bank)
    truths: Truths = json.loads(data)["truths"]
    if set(truths) != set(public["cases"]):
        raise SrfError(
            f"{bank / SEAL}: its cases are not those of {apart.name}", "The seal was changed; make the bank anew."
        )
    return truths


def check_cases(bank: Path) -> tuple[str, ...]:
    """Return the names of the cases of a bank; SrfError where a file of one was changed, added or taken away since."""
    cases: dict[str, str] = _read(bank / SEAL)["cases"]
    for name, digest in cases.items():
        if not (bank / name).is_dir() or case_digest(bank / name) != digest:
            raise SrfError(f"{bank / name}: not the files that were sealed", "Restore the case, or make the bank anew.")
    return tuple(cases)


def case_digest(folder: Path) -> str:
    """Return the SHA-256 over names and contents of all files of a case."""
    whole = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name, data = path.relative_to(folder).as_posix().encode(), read_plain(path, limit=LARGEST)
        whole.update(f"{len(name)} {len(data)} ".encode() + name + data)
    return whole.hexdigest()


def _canonical(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, sort_keys=True, indent=1, allow_nan=False) + "\n").encode()


def _bytes(path: Path) -> bytes:
    try:
        return read_plain(path, limit=LARGEST)
    except OSError as error:
        raise SrfError(
            f"{path}: {error.strerror}", "Name the bank, and the file of its truths.", exit_code=1
        ) from error


def _read(path: Path) -> dict[str, Any]:
    try:
        data = parse_json(_bytes(path), path)
    except SrfError as error:
        raise SrfError(error.message, "The seal is damaged; make the bank anew.") from None
    if not isinstance(data, dict):
        raise SrfError(f"{path}: a JSON object was expected", "The seal is damaged; make the bank anew.")
    return data
