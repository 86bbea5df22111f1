"""Banks of concealed cases, and their truths under seal."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.files import parse_json, read_plain, write_atomic
from srfcli.parallel.pool import run_here, run_processes
from srfcli.validation.generator.case import KINDS, NAMES, OUTSIDE_NAMES, SHARES, Truth, make_case

# Truths under seal: a salted digest is published with the cases, the truths are kept apart until the answers are in.

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


# Banks of concealed cases: every effect, pairs, none and effects outside the library, in an order that gives nothing away.


@dataclass(frozen=True)
class Bank:
    """A bank as written: its folder, the file of its truths, their digest, and the names of its cases."""

    folder: Path
    apart: Path
    digest: str
    cases: tuple[str, ...]


def make_bank(
    folder: Path,
    n: int,
    seed: int,
    *,
    apart: Path | None = None,
    workers: int = 1,
    strengths: bool = True,
    kinds: Sequence[str] | None = None,
    told: Callable[[int, int], None] | None = None,
) -> Bank:
    """Write `n` cases to the new folder `folder`, their truths to `apart` (default: beside it), and the seal between them.

    Does not depend on the number of workers. `kinds` are the kinds of cases, default all of KINDS; `told` is called with how many
    are done, of how many. Raises SrfError for a folder that exists and for an unknown kind.
    """
    if n < 1:
        raise SrfError(f"{n} cases", "make one or more")
    if folder.exists():
        raise SrfError(f"{folder} exists already", "A bank is never overwritten; name another folder.")
    apart = folder.with_name(f"{folder.name}.truths.json") if apart is None else apart
    if apart.exists():
        raise SrfError(f"{apart} exists already", "Truths are never overwritten; name another file.")
    folder.mkdir(parents=True)
    tasks = [
        (folder / f"case-{i:03d}", (seed, i), names, strengths)
        for i, names in enumerate(plan_bank(n, seed, kinds=kinds))
    ]
    truths: dict[str, Truth] = {}
    for _, (name, truth) in run_here(_make, tasks) if workers <= 1 else run_processes(_make, tasks, workers=workers):
        truths[name] = truth
        if told:
            told(len(truths), n)
    digest = seal(folder, truths, apart, seed=seed)
    return Bank(folder, apart, digest, tuple(sorted(truths)))


def plan_bank(n: int, seed: int, *, kinds: Sequence[str] | None = None) -> list[tuple[str, ...]]:
    """Return what each case of a bank conceals: the kinds in their usual shares, every effect as often as any other, shuffled."""
    rng = np.random.default_rng([seed, 2])
    counts = _counts(n, KINDS if kinds is None else kinds)
    none, single, pair, outside = counts
    one = cycle(rng.permutation(NAMES).tolist())
    other = cycle(rng.permutation(OUTSIDE_NAMES).tolist())
    pairs = [(a, b) for i, a in enumerate(NAMES) for b in NAMES[i + 1 :]]
    chosen = rng.permutation(len(pairs))
    plans: list[tuple[str, ...]] = [()] * none
    plans += [(name,) for name in islice(one, single)] + [(name,) for name in islice(other, outside)]
    plans += [pairs[k] for k in islice(cycle(chosen.tolist()), pair)]
    return [plans[i] for i in rng.permutation(n).tolist()]


def _counts(n: int, kinds: Sequence[str]) -> list[int]:
    """Return how many cases of each of KINDS a bank of `n` has; what rounding leaves over is of the most frequent kind."""
    strange = [k for k in kinds if k not in KINDS]
    if strange:
        raise SrfError(f"unknown kind of case '{strange[0]}'", did_you_mean(strange[0], KINDS))
    shares = np.array([s if k in kinds else 0.0 for k, s in zip(KINDS, SHARES, strict=True)])
    counts = [int(c) for c in np.floor(shares / (shares.sum() if len(set(kinds)) < len(KINDS) else 1.0) * n + 1e-9)]
    counts[int(np.argmax(shares))] += n - sum(counts)
    return counts


Task = tuple[Path, tuple[int, int], tuple[str, ...], bool]


def _make(task: Task) -> tuple[str, Truth]:
    folder, seed, names, strengths = task
    return folder.name, make_case(folder, seed, effects=names, strengths=strengths)
