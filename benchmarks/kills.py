"""Commands that write, killed at random moments by SIGKILL, SIGTERM and SIGINT: what they leave, and how they go on.

    python benchmarks/kills.py --kills 300 --seed 1

Each kill falls at a random moment of a command's usual time. Then every result must be the old one or the new one, whole; a
folder that was not there is absent or whole; the next run of the command must succeed, end with the results of a run that was
never killed, and leave nothing hidden beside them.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

START = """import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the campaign runs in the background
from srfcli.cli.main import main
main(sys.argv[1:])"""
DRIVE = ("--drive", "0.3:10, 0.7:20", "--W0", "5", "--rate", "200", "--noise", "0.02", "--seed", "1")
GRID = ("--eps", "0.09", "--over", "V=1:100:4", "--over", "K/W0=0.002:0.03:4")
COMMANDS = {  # what is written, and how the command goes on
    "linear": ("linear", "--over", "V=1:100:9", "--out", "a.csv", "--plot", "a.svg", "--force"),
    "simulate": ("simulate", *DRIVE, "--out-dir", "made", "--force"),
    "map": ("map", *GRID, "--out", "map.csv", "--resume", "parts", "--force"),
    "fit": ("fit", "given", "--out", "fit.json", "--force"),
    "diagnose": ("diagnose", "given", "--effect", "inertia", "--out", "found", "--force"),
    "prove": ("prove", "--cases", "1", "--seed", "1", "--out", "trial", "--resume"),
}


def run(arguments: tuple[str, ...], folder: Path, *, after: float | None = None, number: int = 0) -> int:
    """Run srf in a folder, ended by a signal after so many seconds; return its exit code."""
    process = subprocess.Popen(
        [sys.executable, "-c", START, "-q", *arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    if after is not None:
        try:
            return process.wait(after)
        except subprocess.TimeoutExpired:
            process.send_signal(number)
    return process.wait()


def state(folder: Path) -> dict[str, bytes]:
    """All files that are not hidden, sidecars without what differs from run to run; a torn one raises."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        inside = path.relative_to(folder)
        if any(part.startswith(".") for part in inside.parts) or inside.parts[0] in ("given", "parts", "trial"):
            continue
        data = path.read_bytes()
        if path.suffix == ".json":
            told = json.loads(data)
            timed = ("timings", "arguments", "seconds", "cpu")
            data = json.dumps({k: v for k, v in told.items() if k not in timed}).encode()
        found[str(inside)] = data
    return found


def main() -> None:
    """Run the campaign and print its table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--kills", type=int, default=60)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--seconds", type=float, default=float("inf"), help="begin no new kill after so long")
    asked.add_argument("--commands", default=",".join(COMMANDS))
    given = asked.parse_args()
    chance, begun = random.Random(given.seed), time.monotonic()
    os.environ.pop("SRF_PLUGINS", None)
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    names = given.commands.split(",")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        run(("simulate", *DRIVE, "--out-dir", "given"), folder)
        usual, whole = {}, {}
        for name in names:
            at = time.monotonic()
            code = run(COMMANDS[name], folder)
            usual[name] = time.monotonic() - at
            assert code in (0, 3), f"{name} ended with {code}"
        clean = state(folder)
        for name in names:
            whole[name] = {k: v for k, v in clean.items()}
        for k in range(given.kills):
            if time.monotonic() - begun > given.seconds:
                break
            name = names[k % len(names)]
            number = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)[k // len(names) % 3]
            if chance.random() < 0.3:  # from nothing
                for path in ("made", "parts", "found", "trial"):
                    if path in COMMANDS[name]:
                        shutil.rmtree(folder / path, ignore_errors=True)
            code = run(COMMANDS[name], folder, after=chance.uniform(0.02, 1.0) * usual[name], number=number)
            found = state(folder)
            torn = [n for n in found if n in clean and found[n] != clean[n]]
            again = run(COMMANDS[name], folder)
            after = state(folder)
            hidden = [p for p in folder.rglob(".*") if "trial" not in p.parts]
            counts[name]["kills"] += 1
            counts[name]["in time" if code < 0 or code == 130 else "too late"] += 1
            counts[name]["torn"] += bool(torn)
            counts[name]["did not go on"] += again not in (0, 3)
            counts[name]["other bytes"] += after != clean
            counts[name]["left behind"] += bool(hidden)
            if torn or again not in (0, 3) or after != clean or hidden:
                differ = [n for n in {*after, *clean} if after.get(n) != clean.get(n)]
                print(f"{name} {number.name}: torn {torn}, then {again}, differ {differ}, hidden {hidden}", flush=True)
    columns = ("kills", "in time", "too late", "torn", "did not go on", "other bytes", "left behind")
    print(f"| command | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for name, count in counts.items():
        print(f"| {name} | {' | '.join(str(count[c]) for c in columns)} |")


if __name__ == "__main__":
    main()
