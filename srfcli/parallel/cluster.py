"""Tasks on a dask.distributed cluster; the scheduler gives the task of a worker that died to another one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from srfcli.errors import SrfError

Task = TypeVar("Task")
Result = TypeVar("Result")

PATIENCE = "10s"  # for the scheduler's first answer


def run_cluster(
    function: Callable[[Task], Result], tasks: Sequence[Task], *, address: str
) -> Iterator[tuple[int, Result]]:
    """Yield (index, result) of every task as the cluster at `address` finishes it.

    The workers need this package in the same version. Raises SrfError where dask.distributed is not installed, where no scheduler
    answers or has no workers, and where the workers at a task keep dying.
    """
    try:
        from distributed import as_completed
    except ImportError as error:
        raise SrfError(
            "--cluster needs dask.distributed, which is not installed", 'pip install "srfcli[cluster]"'
        ) from error
    client = _connected(address)
    try:
        futures = {
            client.submit(function, task, pure=False, retries=0, key=f"srf-{client.id}-{index}"): index
            for index, task in enumerate(tasks)
        }
        for future in as_completed(list(futures), loop=client.loop):
            yield futures[future], _result(future, futures[future])
            future.release()
    finally:
        client.close(timeout=5)


def _connected(address: str) -> Any:
    """Return a client of the scheduler at `address`, which has at least one worker."""
    from distributed import Client

    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SrfError(
            f"--cluster {address}: no scheduler answers",
            "Start one with 'dask scheduler', and give the address it prints.",
        ) from error
    if not client.scheduler_info()["workers"]:
        client.close(timeout=5)
        raise SrfError(f"--cluster {address}: the scheduler has no workers", f"Start some: dask worker {address}")
    return client


def _result(future: Any, index: int) -> Any:
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        raise SrfError(
            f"task {index} ended one worker of the cluster after another", "Look at the workers' logs and their memory."
        ) from error
