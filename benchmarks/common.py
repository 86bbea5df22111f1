"""What the benchmarks share: one thread, the checkout importable, a report that is printed and kept, interleaved timing.

Import this before NumPy: it fixes the number of threads.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from datetime import date
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
for _folder in (ROOT / "tests", ROOT):
    if str(_folder) not in sys.path:
        sys.path.insert(0, str(_folder))


def no_arguments(about: str | None) -> None:
    """Print what a script measures where `--help` is asked, and refuse any other argument."""
    argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()


class Report:
    """Lines printed and kept in `results/NAME.txt`; the first ones say when, on what and with which versions."""

    def __init__(self, name: str, about: str) -> None:
        RESULTS.mkdir(exist_ok=True)
        self._file = (RESULTS / f"{name}.txt").open("w", encoding="utf-8")
        libraries = ", ".join(f"{package} {version(package)}" for package in ("numpy", "scipy"))
        self.say(f"# {about.strip().splitlines()[0]}")
        self.say(f"# {date.today().isoformat()}, {processor()}, one thread, load {load():.2f} at the start")
        self.say(f"# Python {platform.python_version()}, {libraries}")

    def say(self, line: str = "") -> None:
        """Print a line and keep it."""
        print(line, flush=True)
        self._file.write(line + "\n")
        self._file.flush()

    def table(self, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Say a table, its columns aligned."""
        text = [[str(cell) for cell in row] for row in (head, *rows)]
        widths = [max(len(row[i]) for row in text) for i in range(len(head))]
        for number, row in enumerate(text):
            cells = zip(row, widths, strict=True)
            self.say("  ".join(cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(cells)))
            if number == 0:
                self.say("  ".join("-" * w for w in widths))


class Kept:
    """Repeats of a benchmark, one line of JSON each in `results/NAME.jsonl`, told apart by the entries named in `key`."""

    def __init__(self, name: str, key: Sequence[str]) -> None:
        self.path, self.key = RESULTS / f"{name}.jsonl", tuple(key)

    def rows(self) -> dict[tuple[Any, ...], dict[str, Any]]:
        """Return the repeats of earlier runs; a last line that was cut short counts as not done."""
        done = {}
        for line in self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else ():
            try:
                row = json.loads(line)
            except ValueError:
                continue
            done[tuple(row[name] for name in self.key)] = row
        return done

    def add(self, one: Callable[[Any], dict[str, Any]], tasks: Sequence[tuple[Any, ...]], workers: int) -> None:
        """Do the tasks that are not kept yet, in their order, and keep each as soon as it is done."""
        done = self.rows()
        tasks = [task for task in tasks if task not in done]
        self.path.parent.mkdir(exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file, ProcessPoolExecutor(workers) as pool:
            if file.tell() and not self.path.read_bytes().endswith(b"\n"):
                file.write("\n")
            waiting = [pool.submit(one, task) for task in tasks]
            try:
                for number, future in enumerate(as_completed(waiting), start=1):
                    file.write(json.dumps(future.result()) + "\n")
                    file.flush()
                    print(f"{number} of {len(tasks)}", flush=True)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def processor() -> str:
    """Return the processor's model: what `platform` says, else the first model name of /proc/cpuinfo."""
    named = platform.processor()
    info = Path("/proc/cpuinfo")
    if named in ("", platform.machine()) and info.exists():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return f"{line.partition(':')[2].strip()} ({platform.machine()})"
    return named or platform.machine()


def load() -> float:
    """Return the load average of the last minute, NaN where the system has none."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")


def interleaved(tasks: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Return the median CPU seconds of each task, the tasks run in turn `repeats` times after one run that is not counted."""
    seen: dict[str, list[float]] = {name: [] for name in tasks}
    for count in range(repeats + 1):
        for name, task in tasks.items():
            begun = time.process_time()
            task()
            if count:
                seen[name].append(time.process_time() - begun)
    return {name: median(values) for name, values in seen.items()}


def repeated(task: Callable[[], Any], count: int) -> Callable[[], None]:
    """Return a task that runs `task` `count` times: process_time is too coarse for one run of a short one."""

    def run() -> None:
        for _ in range(count):
            task()

    return run
