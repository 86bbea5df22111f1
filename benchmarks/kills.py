"""Commands that write, killed at random moments by SIGKILL, SIGTERM and SIGINT: what they leave, and how they go on.

    python benchmarks/kills.py --kills 300 --seed 1

A command has two variants, A and B, whose results differ. Where the results of one stand, the other is run with --force and
killed at a random moment of its usual time, or, with --at-writes, as soon as a part of a result is seen. Then each file must be
that of A or that of B, whole, and so must each folder that is written as one; one that was not there may be absent. A command
that was interrupted may write what it had, with a sidecar whose digest is right. The command must then succeed without help,
end with the results of a run that was never killed, and leave nothing hidden beside them.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import hashlib
import importlib
import json
import os
import pkgutil
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import srfcli
from srfcli.cli.main import main as main_of_srf

DRIVE = ("--drive", "0.3:10, 0.7:20", "--W0", "5", "--rate", "100", "--noise", "0.02")
WINDOW = ("--eps", "0.09", "--over", "V=1:100:4", "--over", "K/W0=0.002:0.03:{5|4}")
TRACE = ("--V", "8", "--W0", "{5|6}", "--for", "0.5", "--rate", "200")
COMMANDS = {  # {a|b} is a in variant A and b in B
    "linear": ("linear", "--over", "V={1|2}:100:9", "--out", "a.csv", "--plot", "a.svg"),
    "critical": ("critical", "--V", "{7|8}", "--eps", "0.13", "--out", "critical.json"),
    "floquet": ("floquet", "--V", "50", "--W0", "{15|16}", "--eps", "0.18", "--out", "f.csv", "--plot", "f.svg"),
    "response": ("response", "--V", "{10|11}", "--W0", "6", "--over", "f=1:99:20", "--out", "r.csv", "--plot", "r.svg"),
    "continue": ("continue", "--eps", "{0.09|0.1}", "--out", "boundary.csv", "--plot", "boundary.png"),
    "map --resume": ("map", *WINDOW, "--out", "map.csv", "--boundary", "edge.csv", "--resume", "parts-{a|b}"),
    "map --workers": ("map", *WINDOW, "--out", "map.csv", "--resume", "parts-{a|b}", "--workers", "2"),
    "compare --resume": (
        *("compare", "--law", "srf-vsat", "--law", "log-log", *WINDOW),
        *("--out", "compare.json", "--resume", "parts-{a|b}"),
    ),
    "simulate": ("simulate", *TRACE, "--out", "trace.csv", "--plot", "trace.svg"),
    "simulate --out-dir": ("simulate", *DRIVE, "--seed", "{1|2}", "--out-dir", "made"),
    "new": ("new", "data.csv", "--stiffness", "{0.2|0.3} N/um", "--load", "5 N", "--out", "new.toml"),
    "law new": ("law", "new", "my-law", "--kind", "{friction|interface}"),
    "fit": ("fit", "given-{a|b}", "--free", "A", "--out", "fit.json", "--plot", "fit.svg"),
    "report": ("report", "results", "--title", "{one|two}", "--out", "page.html"),
    "diagnose": ("diagnose", "given-{a|b}", "--effect", "inertia", "--out", "found"),
    "prove --resume": ("prove", "--cases", "1", "--seed", "{1|2}", "--limit", "0.03", "--out", "trial-{a|b}", "--resume"),
}
FOLDERS = ("made", "found")  # whole at every moment
PROGRESS = ("parts-a", "parts-b", "trial-a", "trial-b")  # which grow, and from which the command goes on
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
TIMED = {"timings", "arguments", "seconds", "cpu", "wall"}
ENDED = (0, 3)
SIDECAR = ".provenance.json"


def variant(name: str, which: int) -> tuple[str, ...]:
    """The words of a command, with --force where it has that."""
    words = tuple(re.sub(r"\{(.*)\|(.*)\}", lambda m: m[which + 1], word) for word in COMMANDS[name])
    return words if words[0] == "prove" else (*words, "--force")


class Process:
    """A process of srf in a folder: a copy of this one, which has imported all that a command may need."""

    def __init__(self, arguments: tuple[str, ...], folder: Path) -> None:
        sys.stdout.flush()
        self.number = os.fork()
        if self.number:
            return
        code = 1
        try:
            for number in SIGNALS[1:]:
                signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
            os.chdir(folder)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            sys.argv = ["srf", "-q", *arguments]
            main_of_srf()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0
        finally:
            os._exit(code)

    def wait(self, seconds: float = float("inf")) -> int | None:
        """Return the exit code, minus the signal's number; None where it runs on after so many seconds."""
        end = time.monotonic() + seconds
        while True:
            done, status = os.waitpid(self.number, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            if time.monotonic() >= end:
                return None
            time.sleep(1e-3)


def finished(arguments: tuple[str, ...], folder: Path) -> int:
    """Run srf in a folder; return its exit code."""
    code = Process(arguments, folder).wait()
    assert code is not None
    return code


def killed(arguments: tuple[str, ...], folder: Path, after: float, number: int, at_writes: bool) -> int:
    """Run srf, ended by a signal after so many seconds, or so long after a part of a result was seen; return its exit code."""
    process = Process(arguments, folder)
    code = None
    while at_writes and code is None and not any(p.suffix in (".part", ".moves") for p in folder.glob(".*")):
        code = process.wait(1e-4)
    code = process.wait(after) if code is None else code
    if code is None:
        os.kill(process.number, number)
        code = process.wait()
    assert code is not None
    return code


def import_all() -> None:
    """Import the package and what it imports, so that copies of this process begin at once."""
    for module in pkgutil.walk_packages(srfcli.__path__, "srfcli."):
        with contextlib.suppress(ImportError):
            importlib.import_module(module.name)
    for name in ("matplotlib.figure", "matplotlib.backends.backend_svg", "matplotlib.backends.backend_agg", "sympy"):
        importlib.import_module(name)


def plain(path: Path) -> bytes:
    """The content of a file without what differs from run to run; a torn one raises."""
    data = path.read_bytes()
    if path.suffix in (".json", ".jsonl"):
        told = [json.loads(part) for part in (data.splitlines() if path.suffix == ".jsonl" else [data])]
        if path.name.endswith(SIDECAR):
            told = [{k: t[k] for k in ("schema", "file", "laws", "parameters")} for t in told]
        data = json.dumps([{k: v for k, v in t.items() if k not in TIMED} for t in told]).encode()
    return data


def state(folder: Path) -> dict[str, bytes]:
    """All results in a folder."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        inside = path.relative_to(folder)
        progress = inside.parts[0] in PROGRESS and inside.parts[1] != "bank"
        if not (progress or any(part.startswith(".") for part in inside.parts)):
            found[str(inside)] = plain(path)
    return found


def torn(found: dict[str, bytes], variants: list[dict[str, bytes]]) -> list[str]:
    """The files, and the folders that are written as one, that are those of neither variant."""
    wrong = [n for n, data in found.items() if n.split("/")[0] not in FOLDERS and data not in (v.get(n) for v in variants)]
    for folder in FOLDERS:
        whole = [{n: d for n, d in some.items() if n.startswith(f"{folder}/")} for some in (found, *variants, {})]
        wrong += [folder] * (whole[0] not in whole[1:])
    return wrong


def partial(folder: Path, name: str) -> bool:
    """Whether a file is what its sidecar says, or is the sidecar of such a file."""
    place = folder / name.removesuffix(SIDECAR)
    told = json.loads((folder / f"{place.name}{SIDECAR}").read_bytes())
    return told["sha256"] == hashlib.sha256(place.read_bytes()).hexdigest()


def clear(folder: Path, given: set[str]) -> None:
    """Remove all results."""
    for path in folder.iterdir():
        if path.name not in given:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def main() -> None:
    """Run the campaign and print its table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--kills", type=int, default=60)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--seconds", type=float, default=float("inf"), help="begin no new kill after so long")
    asked.add_argument("--commands", default=",".join(COMMANDS))
    asked.add_argument("--at-writes", action="store_true")
    given = asked.parse_args()
    chance, begun = random.Random(given.seed), time.monotonic()
    os.environ.pop("SRF_PLUGINS", None)
    import_all()
    counts: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    names = given.commands.split(",")
    rounds = -(-given.kills // len(names))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for letter, seed in (("a", "1"), ("b", "2")):
            assert finished(("simulate", *DRIVE, "--seed", seed, "--out-dir", f"given-{letter}"), folder) == 0
        words = ("simulate", *DRIVE, "--seed", "1", "--out", "data.csv", "--plot", "results/trace.svg")
        (folder / "results").mkdir()
        assert finished(words, folder) == 0
        assert finished(("critical", "--V", "7", "--out", "results/critical.json"), folder) == 0
        inputs = {p.name for p in folder.iterdir()}
        for place_of, name in enumerate(names):
            variants, usual = [], float("inf")
            for which in (0, 1):
                clear(folder, inputs)
                at = time.monotonic()
                code = finished(variant(name, which), folder)
                usual = min(usual, time.monotonic() - at)
                assert code in ENDED, f"{name} ended with {code}"
                variants.append(state(folder))
            assert variants[0] != variants[1], name
            standing = 1
            for k in range(min(rounds, given.kills - place_of * rounds)):
                if time.monotonic() - begun > given.seconds:
                    break
                number, which = SIGNALS[k % 3], 1 - standing
                for part in PROGRESS:
                    if "trial" not in part or k % 2:  # a trial is also gone on with when it had ended
                        shutil.rmtree(folder / part, ignore_errors=True)
                if chance.random() < 0.3:
                    clear(folder, inputs)
                late = chance.uniform(0, 0.01) if given.at_writes else chance.uniform(0.02, 1.0) * usual
                code = killed(variant(name, which), folder, late, number, given.at_writes)
                wrong = torn(state(folder), variants)
                if code == 130 and wrong and all("/" not in n and partial(folder, n) for n in wrong):
                    counts[name]["partial"] += 1
                    wrong = []
                again = finished(variant(name, which), folder)
                ended = {n: d for n, d in state(folder).items() if not n.startswith(f"trial-{'ab'[1 - which]}")}
                differ = [n for n in {*ended, *variants[which]} if ended.get(n) != variants[which].get(n)]
                hidden = [str(p.relative_to(folder)) for p in folder.rglob(".*")]
                count, standing = counts[name], which
                count["kills"] += 1
                count["SIG in time" if code < 0 else "130 in time" if code == 130 else "too late"] += 1
                count["torn"] += bool(wrong)
                count["did not go on"] += again not in ENDED
                count["other bytes"] += bool(differ)
                count["left behind"] += bool(hidden)
                if wrong or again not in ENDED or differ or hidden:
                    print(f"{name} {number.name}: torn {wrong}, then {again}, differ {differ}, hidden {hidden}", flush=True)
            print(f"{name}: {dict(counts[name])}, {usual:.1f} s a run", file=sys.stderr, flush=True)
    columns = ("kills", "SIG in time", "130 in time", "too late", "partial", "torn", "did not go on", "other bytes")
    columns += ("left behind",)
    print(f"| command | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for name, count in [*counts.items(), ("all", sum(counts.values(), collections.Counter()))]:
        print(f"| {name} | {' | '.join(str(count[c]) for c in columns)} |")


if __name__ == "__main__":
    main()
