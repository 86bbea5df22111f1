"""What a start of `srf` costs, in CPU seconds of the child process, and what `srf --help` imports.

Timed: user plus system time of a new Python process from its start to its exit (os.wait4), for `srf --help`, `srf laws`,
`srf linear` of the default system, whose generated module is shipped, and of one whose module is not (no inertia, an inclined
spring), each with a filled cache and with an empty one, where sympy derives what is not shipped.
The commands run in turn; the median and the largest of the repeats are shown. A bare `python -c pass` and `import numpy` stand
beside them: nothing that uses NumPy can be faster than the latter.

Not timed: compiling .pyc files (a first run of each is not counted), reading from a cold disk, and the console script's own
wrapper, which differs from `python -c "from srfcli.cli.main import main; main()"` by a few lines of Python.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from common import ROOT, Report, no_arguments

REPEATS = 9
PYC = Path(tempfile.mkdtemp())  # compiled once by the runs that are not counted, as an installation does
OTHER = ("--no-inertia", "--loading", "inclined")
START = "from srfcli.cli.main import main; main()"
HEAVY = ("sympy", "scipy", "numpy", "matplotlib", "rich", "pint", "numba")


def child_seconds(code: str, *arguments: str, cache: Path) -> float:
    """Return user + system seconds of a Python process that runs `code`; its exit status must be 0."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "SRF_CACHE": str(cache), "PYTHONPYCACHEPREFIX": str(PYC)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        cwd=tempfile.gettempdir(),
    )
    errors = process.stderr.read() if process.stderr else b""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"srf {' '.join(arguments)} ended with {process.returncode}: {errors.decode()}")
    return usage.ru_utime + usage.ru_stime


def modules_of_help() -> list[str]:
    """Return the modules loaded when `srf --help` has run."""
    code = (
        "import sys\nfrom srfcli.cli.main import cli\n"
        "try: cli.main(['--help'], prog_name='srf')\nexcept SystemExit: pass\n"
        "print('\\n'.join(sorted(sys.modules)), file=sys.stderr)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return done.stderr.split()


def main() -> None:
    """Time the starts in turn and print two tables."""
    no_arguments(__doc__)
    report = Report("startup", __doc__)
    folder = Path(tempfile.mkdtemp())
    warm = folder / "warm"
    cases = {
        "python -c pass": ("pass", (), warm),
        "python -c 'import numpy'": ("import numpy", (), warm),
        "srf --help": (START, ("--help",), warm),
        "srf laws": (START, ("laws",), warm),
        "srf linear, warm": (START, ("linear",), warm),
        "srf linear, first start": (START, ("linear",), None),
        "srf linear of a system not shipped, warm": (START, ("linear", *OTHER), warm),
        "srf linear of a system not shipped, first": (START, ("linear", *OTHER), None),
    }
    seen: dict[str, list[float]] = {name: [] for name in cases}
    for count in range(REPEATS + 1):
        for name, (code, arguments, cache) in cases.items():
            seconds = child_seconds(code, *arguments, cache=cache or folder / f"cold{count}")
            if count:
                seen[name].append(seconds)
    shutil.rmtree(folder)
    shutil.rmtree(PYC)
    report.say()
    rows = [(name, f"{median(s):.3f}", f"{min(s):.3f}", f"{max(s):.3f}") for name, s in seen.items()]
    report.table(("command", "CPU s, median", "least", "most"), rows)
    report.say()
    for name, aim in (("srf --help", 0.08), ("srf linear, warm", 0.2), ("srf linear, first start", 0.2)):
        found = median(seen[name])
        report.say(f"aim: {name} within {aim} s of CPU: {'met' if found <= aim else 'MISSED'} ({found:.3f} s)")
    modules = modules_of_help()
    packages = sorted({m.partition(".")[0] for m in modules} - set(sys.stdlib_module_names) - {"__main__"})
    report.say(f"srf --help loads {len(modules)} modules; packages outside the standard library: {', '.join(packages)}")
    heavy = [m for m in HEAVY if m in packages]
    report.say(f"of the heavy ones ({', '.join(HEAVY)}): {', '.join(heavy) or 'none'}")
    report.say("its srfcli modules: " + " ".join(m for m in modules if m.partition(".")[0] == "srfcli"))


if __name__ == "__main__":
    main()
