"""Finished tasks kept in a folder, so that a run that was killed goes on where it stopped, to the same bytes.

Every part ends in a seal over its run, its number and its content, under the user's secret. A part that was damaged, changed,
moved from another place or run, or made by somebody else fails it, and its task is done again.
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli.core.cache import is_sealed, seal
from srfcli.core.errors import SrfError
from srfcli.core.files import clear, parse_json, read_plain, write_atomic
from srfcli.core.version import __version__

if TYPE_CHECKING:
    from numpy.typing import NDArray

NOTE = "srf-run.json"
LARGEST = 2**30  # bytes of a finished task
SEAL = 64  # hexadecimal digits at the end of a part
Arrays = Mapping[str, "NDArray[Any]"]
Run = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[int, Any]]]


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
                f"--resume {self.folder}: parts cannot be sealed: {error}",
                "Set XDG_STATE_HOME to a folder of your own.",
            ) from error
        note = self.folder / NOTE
        if self.folder.is_dir():
            clear(self.folder)
        if note.exists():
            try:
                before = parse_json(read_plain(note), note)
            except (OSError, SrfError) as error:
                raise SrfError(
                    f"--resume {note} cannot be read: {error}", "Name another folder, or a new one."
                ) from error
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
            whole = read_plain(self._place(index), limit=LARGEST)
            content, found = whole[:-SEAL], whole[-SEAL:].decode("ascii", "replace")
            if not is_sealed(self._name(index), content, found):
                return None
            with np.load(io.BytesIO(content), allow_pickle=False) as data:
                return {name: data[name] for name in data.files}
        except (
            OSError,
            SrfError,
            ValueError,
            EOFError,
            KeyError,
            SyntaxError,
            MemoryError,
            zipfile.BadZipFile,
            zlib.error,
        ):
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


def stored(
    run: Run, store: Store, function: Callable[[Any], Arrays], tasks: Sequence[Any]
) -> Iterator[tuple[int, Arrays]]:
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
