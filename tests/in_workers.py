"""What tests give to worker processes, which import this file and not a test with all that it imports."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path

import numpy as np
import tomli

from srfcli.core.errors import SrfError
from srfcli.core.parallel import run_processes
from srfcli.validation.blind import Answer

# tasks: a number, and the path of a mark


def square(task):
    return {"value": np.array(task[0]) ** 2}


def fragile(task):
    """Die as if killed, once: the first worker to come here leaves a mark."""
    number, mark = task
    if number == 3 and not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"value": np.array(number) ** 2}


def deadly(task):
    os.kill(os.getpid(), signal.SIGKILL)


def deadly_at_one(task):
    if task == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return task


def faulty(task):
    raise SrfError("this task is wrong", "do another")


def slow(task):
    time.sleep(0.2)
    return square(task)


def endless(folder):
    """Leave the process's number in the folder, then compute until killed."""
    Path(folder, str(os.getpid())).touch()
    while True:
        pass


def all_endless(folder):
    """Start two workers that compute until they are killed."""
    list(run_processes(endless, [folder] * 2, workers=2))


# diagnoses that are not: they see a folder, as the real one does


def says_none(folder, plugins):
    runs = tomli.loads((folder / "experiment.toml").read_text())["runs"]
    held = {run["name"]: {"augmented": 0.02, "baseline": 0.02} for run in runs if run.get("holdout")}
    return Answer("", "none", confidence={"none": 0.95, "unknown": 0.05}, held=held)


def careless(folder, plugins):
    """Raise at one case, end the process at another, never end at a third."""
    number = int(folder.name[-1])
    if number == 0:
        raise ValueError("a matrix\nis singular")
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    while number == 2:
        with contextlib.suppress(Exception):  # it copes with everything
            sum(range(1000))
    return says_none(folder, plugins)


def remembers(folder, plugins):
    """Leave a mark per call, and end the process at the first call on the fourth case."""
    marks = folder.parent.parent / "calls"
    marks.mkdir(exist_ok=True)
    times = len(list(marks.glob(f"{folder.name}*")))
    (marks / f"{folder.name}.{times}").touch()
    if folder.name.endswith("3") and not times:
        os.kill(os.getpid(), signal.SIGKILL)
    return says_none(folder, plugins)


def peeks(folder, plugins):
    """Say what the folder and all above it up to the trial let one see of a truth."""
    inside = sorted(p.name for p in folder.rglob("*"))
    return Answer("", "none", not_identifiable=tuple(inside))
