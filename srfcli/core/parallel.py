"""Independent tasks on processes of this machine or on a dask.distributed cluster, the finished ones kept in a folder.

`concurrent.futures` gives up the whole pool when one of its processes is killed. Here every worker has its own pipe, so that
the death of one does not affect the others.

A run that was killed continues from the finished tasks in the folder, to the same bytes. The file of each finished task (a part)
ends in a seal over its run, its number and its content, under the user's secret. Where the seal does not fit, because the part
was damaged, changed, moved from another place or run, or made by somebody else, the task is done again.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
import warnings
import zipfile
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from srfcli.core import ONE_THREAD, __version__
from srfcli.core.cache import is_sealed, seal
from srfcli.core.errors import SrfError
from srfcli.core.files import clear, parse_json, read_plain, write_atomic

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Tasks on processes of this machine. The task of a worker that died is done again by another one.

Task = TypeVar("Task")
Result = TypeVar("Result")

MOST_CRASHES = 3  # a task that took this many workers with it is at fault itself
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
    function: Callable[[Task], Result], tasks: Sequence[Task], *, workers: int, lost: Callable[[int], Result] | None = None
) -> Iterator[tuple[int, Result]]:
    """Return an iterator of (index, result) of every task as it is finished by one of `workers` processes.

    With a number of workers it is what `srfcli.map`, `srfcli.compare` and `srfcli.fit_campaign` take as `run`.

    Parameters
    ----------
    function : callable
        What is done with each task; it must be importable.
    tasks : sequence
        Independent tasks; they and their results must pickle.
    workers : int
        How many processes work at the same time.
    lost : callable, optional
        Gives, for the index of a task that takes MOST_CRASHES workers with it, what stands in place of its result.

    Returns
    -------
    iterator of (int, result)
        A task whose worker died is done again.

    Raises
    ------
    SrfError
        For a task that takes MOST_CRASHES workers with it, without `lost`; and what `function` itself raises.

    Examples
    --------
    >>> import functools
    >>> import srfcli as srf
    >>> two = functools.partial(srf.run_processes, workers=2)
    >>> found = srf.map(srf.system(eps=0.18), x=("V", 10, 40, 3), y=("W0", 8, 20, 3), boundaries=False, run=two)
    >>> found.status.ok
    True
    """
    waiting, attempts = deque(range(len(tasks))), [0] * len(tasks)
    crew = [_started() for _ in range(min(workers, len(tasks)))]
    try:
        done = 0
        while done < len(tasks):
            for worker in crew:
                if worker.index is None and waiting:
                    worker.index = waiting.popleft()
                    with contextlib.suppress(OSError):  # it died while idle: its sentinel says so
                        worker.pipe.send((function, tasks[worker.index]))
            ready = wait([end for w in crew if w.index is not None for end in (w.pipe, w.process.sentinel)])
            for place, worker in enumerate(crew):
                if worker.index is None or not {worker.pipe, worker.process.sentinel} & set(ready):
                    continue
                answer = _answer(worker)
                if answer is None:
                    index, crew[place] = worker.index, _started()
                    attempts[index] += 1
                    if attempts[index] < MOST_CRASHES:
                        waiting.appendleft(index)
                    elif lost is not None:
                        done += 1
                        yield index, lost(index)
                    else:
                        raise SrfError(
                            f"task {index} ended {MOST_CRASHES} worker processes, the last with code {worker.process.exitcode}",
                            "Look whether memory is short; --workers 1 runs it in this process and shows what happens.",
                        )
                    continue
                index, worker.index = worker.index, None
                result, error = answer
                if error is not None:
                    raise error
                done += 1
                yield index, result
    finally:
        for worker in crew:
            worker.process.terminate()
            worker.pipe.close()
        for worker in crew:
            worker.process.join()


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


def _answer(worker: _Worker) -> Any:
    """Return the result that a worker sent, or None, and what its task raised, or None; None alone where it died first."""
    with contextlib.suppress(EOFError, OSError):
        if worker.pipe.poll():
            return worker.pipe.recv()
    worker.process.join()
    worker.pipe.close()
    return None


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
        answer: tuple[Any, Exception | None]
        try:
            answer = function(task), None
        except Exception as error:
            error.add_note(traceback.format_exc())  # where in the worker it happened, for --debug
            answer = None, error
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

SCHEDULER_TIMEOUT = "10s"  # for the scheduler's first answer


def run_cluster(
    function: Callable[[Task], Result], tasks: Sequence[Task], *, address: str, timeout: str = SCHEDULER_TIMEOUT
) -> Iterator[tuple[int, Result]]:
    """Yield (index, result) of every task as the cluster at `address` finishes it; its first answer is awaited for `timeout`.

    The workers need this package in the same version. Raises SrfError where dask.distributed is not installed, where no scheduler
    answers or has no workers, and where the workers at a task keep dying.
    """
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError as error:
        raise SrfError("--cluster needs dask.distributed, which is not installed", 'pip install "srfcli[cluster]"') from error
    try:
        client = Client(address, timeout=timeout, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SrfError(
            f"--cluster {address}: no scheduler answers", "Start one with 'dask scheduler', and give the address it prints."
        ) from error
    try:
        if not client.scheduler_info()["workers"]:
            raise SrfError(f"--cluster {address}: the scheduler has no workers", f"Start some: dask worker {address}")
        futures = {
            client.submit(function, task, pure=False, retries=0, key=f"srf-{client.id}-{index}"): index
            for index, task in enumerate(tasks)
        }
        for future in as_completed(list(futures), loop=client.loop):
            yield futures[future], future.result()
            future.release()
    except KilledWorker as error:
        raise SrfError(
            f"task {futures[future]} ended one worker of the cluster after another", "Look at the workers' logs and their memory."
        ) from error
    finally:
        client.close(timeout=5)


# Finished tasks kept in a folder.

NOTE = "srf-run.json"
LARGEST_RESULT = 2**30  # bytes of a finished task
SEAL_DIGITS = 64  # hexadecimal digits at the end of a part
_DAMAGED = (  # what reading a file of arrays raises that is not one
    OSError, SrfError, ValueError, EOFError, KeyError, SyntaxError, MemoryError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
Arrays = Mapping[str, "NDArray[Any]"]
Runner = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[int, Any]]]


@dataclass
class Store:
    """A folder of finished tasks, each a mapping of names to arrays, of one run and no other."""

    folder: Path
    run: str = ""  # hash of the tasks, known when it is open

    def open(self, tasks: Sequence[Any]) -> None:
        """Make the folder, or check that what it holds is of these very tasks; SrfError where it is not."""
        self.run = fingerprint(tasks)
        said = {"schema": "srf.run/1", "version": __version__, "tasks": len(tasks), "sha256": self.run}
        try:
            seal(self.run, b"")
        except (OSError, RuntimeError) as error:
            raise SrfError(
                f"--resume {self.folder}: parts cannot be sealed: {error}", "Set XDG_STATE_HOME to a folder of your own."
            ) from error
        note = self.folder / NOTE
        if self.folder.is_dir():
            clear(self.folder)
        if note.exists():
            try:
                before = parse_json(read_plain(note), note)
            except (OSError, SrfError) as error:
                raise SrfError(f"--resume {note} cannot be read: {error}", "Name another folder, or a new one.") from error
            if before != said:
                raise SrfError(
                    f"--resume {self.folder} holds the parts of another run",
                    "Give the arguments of that run, or name another folder.",
                )
            return
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise SrfError(f"--resume {self.folder} is not a folder of a run", "Name a new folder, or an empty one.")
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomic(note, json.dumps(said, indent=2) + "\n")

    def read(self, index: int) -> dict[str, NDArray[Any]] | None:
        """Return a finished task, or None where there is none or its file fails its seal: it is then done again."""
        import numpy as np

        try:
            whole = read_plain(self._place(index), limit=LARGEST_RESULT)
            content, found = whole[:-SEAL_DIGITS], whole[-SEAL_DIGITS:].decode("ascii", "replace")
            if not is_sealed(self._name(index), content, found):
                return None
            with np.load(io.BytesIO(content), allow_pickle=False) as data:
                return {name: data[name] for name in data.files}
        except _DAMAGED:
            return None

    def write(self, index: int, result: Arrays) -> None:
        """Keep a finished task, whole or not at all."""
        import numpy as np

        buffer = io.BytesIO()
        np.savez(buffer, **result)  # type: ignore[arg-type]
        content = buffer.getvalue()
        write_atomic(self._place(index), content + seal(self._name(index), content).encode())

    def _name(self, index: int) -> str:
        return f"{self.run}/{index}"

    def _place(self, index: int) -> Path:
        return self.folder / f"part-{index:05d}.npz"


def fingerprint(tasks: Sequence[Any]) -> str:
    """Return a hash of all that the tasks hold."""
    # a fixed protocol, and no memory of shared objects: equal tasks then give equal bytes
    whole = hashlib.sha256()
    for task in tasks:
        buffer = io.BytesIO()
        pickler = pickle.Pickler(buffer, protocol=4)
        pickler.fast = True
        pickler.dump(task)
        whole.update(buffer.getvalue())
    return whole.hexdigest()


def stored(run: Runner, store: Store, function: Callable[[Any], Arrays], tasks: Sequence[Any]) -> Iterator[tuple[int, Arrays]]:
    """Yield every task's result: those in the store as they were kept, the others by `run`, kept as they come."""
    store.open(tasks)
    missing = []
    for index in range(len(tasks)):
        kept = store.read(index)
        if kept is None:
            missing.append(index)
        else:
            yield index, kept
    for place, result in run(function, [tasks[i] for i in missing]):
        store.write(missing[place], result)
        yield missing[place], result
