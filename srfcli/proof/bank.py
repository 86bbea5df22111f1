"""Banks of concealed cases: every effect, pairs, none and effects outside the library, in an order that gives nothing away."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from srfcli.errors import SrfError, did_you_mean
from srfcli.parallel.pool import run_here, run_processes
from srfcli.proof.case import Truth, make_case
from srfcli.proof.draw import KINDS, SHARES
from srfcli.proof.effects import NAMES, OUTSIDE_NAMES
from srfcli.proof.seal import seal


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
