"""Options that spread a long computation: --workers, --cluster and --resume, the same path for all three."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from srfcli.errors import SrfError

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True)
class Spread:
    """Where tasks are done: in this process, in `workers` others, or on a `cluster`; `resume` keeps what is finished."""

    workers: int = 1
    cluster: str | None = None
    resume: Path | None = None

    def run(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Yield (index, result) of every task, in any order."""
        if self.resume is None:
            yield from self._fresh(function, tasks)
            return
        from srfcli.parallel.store import Store, stored

        yield from stored(self._fresh, Store(self.resume), function, tasks)

    def _fresh(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        if not tasks:
            return
        if self.cluster is not None:
            from srfcli.parallel.cluster import run_cluster

            yield from run_cluster(function, tasks, address=self.cluster)
        elif self.workers > 1:
            from srfcli.parallel.pool import run_processes

            yield from run_processes(function, tasks, workers=self.workers)
        else:
            from srfcli.parallel.pool import run_here

            yield from run_here(function, tasks)


def worker_options(function: F) -> F:
    """Add --workers, --cluster and --resume; the command gets them as `spread`, a Spread."""

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        workers, cluster, resume = (kwargs.pop(name) for name in ("workers", "cluster", "resume"))
        if workers is not None and cluster is not None:
            raise SrfError("--workers and --cluster exclude each other", "A cluster has its own number of workers.")
        count = workers if workers else os.cpu_count() or 1 if workers == 0 else 1
        folder = None if resume is None else Path(resume).expanduser()
        return function(*args, spread=Spread(count, cluster, folder), **kwargs)

    options = (
        click.option(
            "--workers",
            type=click.IntRange(0, 4096),
            help="Processes to use, 0 for all cores.  [default: this one only]",
        ),
        click.option("--cluster", metavar="ADDRESS", help="Scheduler of a dask.distributed cluster, tcp://host:port."),
        click.option("--resume", metavar="DIR", help="Keep finished parts in DIR, and go on from those found there."),
    )
    for option in reversed(options):
        wrapper = option(wrapper)
    return wrapper  # type: ignore[return-value]
