"""The commands under other versions of Python and of what srf builds on: what ran, as rows of a table.

    python benchmarks/versions.py /path/to/lowest/bin/python /path/to/newest/bin/python

Each interpreter has srf installed, with the versions that are to be tried. Every command runs in a folder and with a cache of
its own; a failure is an exit code other than 0, a traceback, or a warning of Python that is raised in the package's own code.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

PACKAGES = ("numpy", "scipy", "sympy", "click", "rich", "tomli", "matplotlib", "pint")
ASK = f"""import importlib.metadata as m, platform
def of(name):
    try:
        return m.version(name)
    except m.PackageNotFoundError:
        return "-"
print(platform.python_version(), *(of(n) for n in {PACKAGES!r}))"""
DRIVE = ("--drive", "0.3:10, 0.7:20", "--W0", "5", "--rate", "100", "--noise", "0.02", "--seed", "1")
WINDOW = ("--eps", "0.09", "--over", "V=1:100:4", "--over", "K/W0=0.002:0.03:4")
COMMANDS = (
    ("laws",),
    ("derive",),
    ("law", "check", "srf-vsat"),
    ("linear", "--over", "V=1:100:5", "--out", "linear.csv", "--plot", "linear.svg"),
    ("critical", "--V", "7", "--eps", "0.13", "--out", "critical.json"),
    ("floquet", "--V", "50", "--W0", "15", "--eps", "0.18", "--plot", "orbit.png"),
    ("response", "--V", "10", "--W0", "6", "--over", "f=1:99:9"),
    ("continue", "--eps", "0.09", "--out", "boundary.csv"),
    ("map", *WINDOW, "--workers", "2", "--resume", "parts", "--out", "map.csv"),
    ("compare", "--law", "srf-vsat", "--law", "log-log", *WINDOW),
    ("simulate", *DRIVE, "--out-dir", "given"),
    ("new", "given/simulated.csv", "--stiffness", "210 N/mm", "--load", "5 N", "--out", "new.toml"),
    ("check", "given"),
    ("fit", "given", "--free", "A", "--out", "fit.json"),
    ("diagnose", "given", "--effect", "inertia", "--out", "found"),
    ("report", ".", "--out", "page.html"),
)


def failures(python: str) -> list[str]:
    """Run all commands with this interpreter and return those that failed, each with what it said last."""
    failed = []
    with tempfile.TemporaryDirectory() as place:
        inside = {"XDG_CACHE_HOME": f"{place}/cache", "XDG_STATE_HOME": f"{place}/state", "PYTHONWARNINGS": "default"}
        for name in inside.values():
            if name.startswith("/"):
                Path(name).mkdir(mode=0o700)
        (work := Path(place) / "work").mkdir()
        for words in COMMANDS:
            done = subprocess.run(
                [python, "-m", "srfcli.cli.main", *words], cwd=work, env={**os.environ, **inside}, capture_output=True, text=True
            )
            warned = any("srfcli" in line and "Warning:" in line for line in done.stderr.splitlines())
            if done.returncode != 0 or "Traceback" in done.stderr or warned:
                failed.append(f"{' '.join(words)}: {done.returncode}: {done.stderr.strip()[-600:]}")
    return failed


def main() -> None:
    """Print a row for each interpreter."""
    print(f"| Python | {' | '.join(PACKAGES)} | commands | failed |\n|---|{'---|' * (len(PACKAGES) + 2)}")
    told = []
    for python in sys.argv[1:]:
        versions = subprocess.run([python, "-c", ASK], capture_output=True, text=True, check=True).stdout.split()
        failed = failures(python)
        print(f"| {' | '.join(versions)} | {len(COMMANDS)} | {len(failed)} |", flush=True)
        told += [f"{versions[0]}: {text}" for text in failed]
    print("\n".join(told))


if __name__ == "__main__":
    main()
