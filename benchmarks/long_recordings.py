"""Fits and diagnoses of a recording of 150,000 samples: 40 velocity steps at 1 kHz. CPU time, memory, and what comes out.

usage: long_recordings.py [--rate HZ]

A rigid slider without inertia under 10 N is driven at 10 and 30 um/s in turn, 3.75 s each, and its force is read with white noise
of 0.002 N. The file's start values are 30 % off. It is fitted and diagnosed under its own ageing law, and, where it moved under
the slip law, diagnosed under the ageing law. A stiffer one with D0 = 2 um, which slides steadily before each step, has a level of
its own about each, with a scatter of 0.003, and is fitted with `--vary mu0 --by segment`.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import common
import numpy as np

TRUTH = {"mu0": 0.6, "A": 0.008, "B": 0.011, "D0": 10.0}
START = {"mu0": 0.58, "A": 0.0104, "B": 0.0083, "D0": 13.0}
STEADY = {"D0": 2.0}
W0, PLATEAU, STEPS, SCATTER = 10.0, 3.75, 40, 0.003
DRIVE = ", ".join(f"{PLATEAU}:{V}" for V in (10, 30) * (STEPS // 2))


def srf(*words: str) -> tuple[str, float, int]:
    """Return what a command printed, its CPU seconds and its most memory in kB."""
    command = [sys.executable, "-m", "srfcli", *words]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert child.stdout is not None
    text = child.stdout.read()
    _, status, used = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"srf {' '.join(words)} ended with {os.waitstatus_to_exitcode(status)}")
    return text, used.ru_utime + used.ru_stime, used.ru_maxrss


def recorded(folder: Path, ageing: str, rate: float, K: str = "30 MPa/mm", **own: float) -> None:
    """Write the recording, under the ageing law in its description; `own` are parameters that are not those of TRUTH."""
    truth = TRUTH | own
    given = [word for name, value in truth.items() for word in ("--set", f"{name}={value}")]
    laws = ("--law", "dieterich-ruina", "--ageing", ageing, "--interface", "rigid", "--no-inertia", *given)
    rig = ("--K", K, "--W0", str(W0), "--drive", DRIVE, "--observe", "force")
    srf("simulate", *laws, *rig, "--rate", str(rate), "--noise", "0.002", "--seed", "1", "--out-dir", str(folder), "-q")
    path = folder / "experiment.toml"
    text = path.read_text().replace('ageing = "ruina"', 'ageing = "dieterich"')
    for name, value in truth.items():
        text = text.replace(f"{name} = {{ value = {value},", f"{name} = {{ value = {START[name] * value / TRUTH[name]:g},")
    path.write_text(text)


def shift_levels(path: Path) -> None:
    """Give the force of a recording a level of its own about each step, from halfway after the last to halfway to the next."""
    with path.open(newline="") as file:
        heading, *rows = csv.reader(file)
    levels = W0 * SCATTER * np.random.default_rng(1).standard_normal(STEPS - 1)
    for row in rows:
        row[-1] = repr(float(row[-1]) + float(levels[int(np.clip(float(row[0]) / PLATEAU - 0.5, 0, STEPS - 2))]))
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([heading, *rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=1000.0)
    rate = parser.parse_args().rate
    report = common.Report("long_recordings", __doc__ or "")
    with tempfile.TemporaryDirectory() as scratch:
        rows = []
        for ageing, tasks in (("dieterich", ("fit", "diagnose")), ("ruina", ("diagnose",))):
            folder = Path(scratch) / ageing
            recorded(folder, ageing, rate)
            for task in tasks:
                out = ["--out", str(folder / "out")] if task == "diagnose" else []
                text, cpu, memory = srf(task, str(folder), "--json", *out)
                found = json.loads(text)
                said = _errors(found["rows"], TRUTH) if task == "fit" else " ".join([found["verdict"], *found["effects"]])
                rows.append((f"{task}, moved under {ageing}", f"{cpu:.1f}", f"{memory / 1000:.0f}", said))
        folder = Path(scratch) / "levels"
        recorded(folder, "dieterich", rate, "200 MPa/mm", **STEADY)
        shift_levels(folder / "simulated.csv")
        text, cpu, memory = srf("fit", str(folder), "--vary", "mu0", "--by", "segment", "--json")
        said = _errors([r for r in json.loads(text)["rows"] if r["parameter"] in TRUTH], TRUTH | STEADY)
        rows.append((f"fit, {STEPS - 1} levels", f"{cpu:.1f}", f"{memory / 1000:.0f}", said))
        report.say(f"# {round(150 * rate) + 1} samples")
        report.table(("command", "CPU s", "MB", "what came out"), rows)


def _errors(found: list[dict[str, Any]], truth: dict[str, float]) -> str:
    off = ((row["parameter"], (row["value"] - truth[row["parameter"]]) / row["stderr"]) for row in found)
    return ", ".join(f"{name} {error:+.1f}" for name, error in off) + " standard errors off"


if __name__ == "__main__":
    main()
