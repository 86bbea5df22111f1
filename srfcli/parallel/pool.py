"""Tasks on processes of this machine, or on a dask.distributed cluster.

`concurrent.futures` gives up the whole pool when one of its processes is killed; here every worker has its own pipe, so that
the others never notice.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, TypeVar

from srfcli.core.errors import SrfError
from srfcli.parallel import ONE_THREAD

# Tasks on processes of this machine. A worker that dies costs the task it was at, which another one does again.

Task = TypeVar("Task")
Result = TypeVar("Result")

ATTEMPTS = 3  # a task that took this many workers with it is at fault itself
_ENVIRONMENT = {
    **ONE_THREAD,
    "PYTHONSAFEPATH": "1",  # a worker is started by `python -c`, which would import from the current folder first
}


@dataclass
class _Worker:
    process: SpawnProcess
    pipe: Connection
    index: int | None = None  # of the task it is at


def run_here(function: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
    """Yield (index, result) of every task, done in this process one after the other."""
    for index, task in enumerate(tasks):
        yield index, function(task)


def run_processes(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int,
    lost: Callable[[int], Result] | None = None,
) -> Iterator[tuple[int, Result]]:
    """Yield (index, result) of every task as it is finished by one of `workers` processes.

    `function` must be importable and tasks and results must pickle. A task whose worker died is done again; where it takes
    ATTEMPTS workers with it, `lost` gives what stands in place of its result, and without `lost` SrfError is raised. Raises
    what `function` itself raised.
    """
    waiting, attempts = deque(range(len(tasks))), [0] * len(tasks)
    crew = [_started() for _ in range(min(workers, len(tasks)))]
    try:
        done = 0
        while done < len(tasks):
            for worker in crew:
                if worker.index is None and waiting:
                    _give(worker, function, tasks, waiting.popleft())
            ready = wait([end for w in crew if w.index is not None for end in (w.pipe, w.process.sentinel)])
            for place, worker in enumerate(crew):
                if worker.index is None or not {worker.pipe, worker.process.sentinel} & set(ready):
                    continue
                answer = _answer(worker)
                if answer is None:
                    index, crew[place] = worker.index, _started()
                    attempts[index] += 1
                    if lost is not None and attempts[index] >= ATTEMPTS:
                        done += 1
                        yield index, lost(index)
                        continue
                    _check_attempts(attempts[index], worker)
                    waiting.appendleft(index)
                    continue
                index, worker.index = worker.index, None
                if isinstance(answer, _Failure):
                    raise answer.error
                done += 1
                yield index, answer
    finally:
        for worker in crew:
            worker.process.terminate()
            worker.pipe.close()
        for worker in crew:
            worker.process.join()


@dataclass
class _Failure:
    """What a task raised, sent back in place of its result."""

    error: BaseException


def _check_attempts(count: int, worker: _Worker) -> None:
    if count >= ATTEMPTS:
        raise SrfError(
            f"task {worker.index} ended {count} worker processes, the last with exit code {worker.process.exitcode}",
            "Look whether memory is short; --workers 1 runs it in this process and shows what happens.",
        )


def _started() -> _Worker:
    """Return a new worker, its linear algebra on one thread: matrices here are small, and the workers share the cores."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)  # read when the worker starts, and when it loads NumPy
    try:
        process = context.Process(target=_work, args=(theirs,), daemon=True)
        process.start()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    theirs.close()
    return _Worker(process, ours)


def _give(worker: _Worker, function: Callable[[Any], Any], tasks: Sequence[Any], index: int) -> None:
    worker.index = index
    with contextlib.suppress(OSError):  # it died while idle: its sentinel says so
        worker.pipe.send((function, tasks[index]))


def _answer(worker: _Worker) -> Any:
    """Return what a worker sent, or None where it died first."""
    try:
        return worker.pipe.recv() if worker.pipe.poll() else _gone(worker)
    except (EOFError, OSError):
        return _gone(worker)


def _gone(worker: _Worker) -> None:
    worker.process.join()
    worker.pipe.close()


def _work(pipe: Connection) -> None:
    """Do what comes through the pipe until it closes; the parent decides what an interrupt means."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    warnings.simplefilter("ignore", RuntimeWarning)  # as in the parent: rows and statuses tell
    while True:
        try:
            function, task = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            answer = function(task)
        except Exception as error:
            error.add_note(traceback.format_exc())  # where in the worker it happened, for --debug
            answer = _Failure(error)
        try:
            pipe.send(answer)
        except OSError:
            return


def _end_with_parent() -> None:
    """End this worker in the middle of its task once its parent is gone: nobody is left to take the answer."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


# Tasks on a dask.distributed cluster; the scheduler gives the task of a worker that died to another one.

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
