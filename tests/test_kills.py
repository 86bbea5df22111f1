"""A process killed at each of its steps on the file system: what was there is old or new, whole, and the next start goes on."""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from commands import srf

from srfcli.cli.main import cli
from srfcli.codegen.c_source import compiler

pytestmark = [
    pytest.mark.usefixtures("empty_folder"),
    pytest.mark.skipif(not hasattr(os, "fork") or sys.platform != "linux", reason="forks, and Linux's locks"),
]

STEPS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "tempfile.mkstemp", "tempfile.mkdtemp"}
STEPS |= {"os.truncate", "fcntl.flock", "shutil.rmtree"}


def forked(work: Callable[[], int]) -> int:
    """Do this in a copy of the process, which shares all that is imported; return its exit code, minus the signal's number."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forks beside threads
        child = os.fork()
    if child == 0:
        code = 1
        with contextlib.suppress(BaseException), contextlib.redirect_stdout(io.StringIO()):
            code = work()
        os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at(step: int, number: int, arguments: tuple[str, ...]) -> int:
    """Run a command in a copy of the process, which gets this signal at its n-th step in the current folder."""
    here = str(Path.cwd())

    def work() -> int:
        left = [step]

        def watch(event: str, given: tuple[object, ...]) -> None:
            names = [os.fsdecode(g) for g in given[:2] if isinstance(g, str | bytes)]
            inside = event == "fcntl.flock" or any(here in n for n in names)
            if event in STEPS and inside:
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), number)

        sys.addaudithook(watch)
        return CliRunner().invoke(cli, arguments, prog_name="srf").exit_code

    return forked(work)


def state(folder: Path) -> dict[str, bytes]:
    """All files below a folder, but what is hidden beside results; of sidecars what does not differ from run to run."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        if any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue
        data = path.read_bytes()
        if path.name.endswith(".provenance.json"):
            told = json.loads(data)  # never torn
            data = json.dumps({k: told[k] for k in ("file", "sha256", "parameters")}).encode()
        found[str(path.relative_to(folder))] = data
    return found


def hidden() -> list[str]:
    return sorted(p.name for p in Path.cwd().rglob(".*"))


FILE = ("linear", "--over", "V={}", "--out", "a.csv", "--force")
FOLDER = ("simulate", "--V", "8", "--W0", "{}", "--for", "0.2", "--rate", "50", "--out-dir", "made", "--force")
LAW = ("law", "new", "my-law", "--force", "--kind", "{}")
CASES = {"result and sidecar": (FILE, "8", "9"), "experiment": (FOLDER, "5", "6"), "law": (LAW, "friction", "interface")}


def command(words: tuple[str, ...], value: str) -> tuple[str, ...]:
    return tuple(word.replace("{}", value) for word in words)


@pytest.mark.parametrize(
    ("case", "number", "stride"),
    [*((case, signal.SIGKILL, 1) for case in CASES), *((case, n, 7) for case in CASES for n in (signal.SIGTERM, signal.SIGINT))],
    ids=lambda v: getattr(v, "name", str(v)),
)
def test_at_every_step(case: str, number: signal.Signals, stride: int) -> None:
    words, before, after = CASES[case]
    srf(*command(words, after))
    new = state(Path())
    shutil.rmtree("made", ignore_errors=True)
    srf(*command(words, before))
    old, kept = state(Path()), Path.cwd().parent / "kept"
    assert set(old) == set(new) and old != new
    shutil.copytree(Path.cwd(), kept)
    for step in range(1, 400, stride):
        code = killed_at(step, number, command(words, after))
        found = state(Path())
        # each file is whole at every moment, and so is a folder
        assert set(found) == set(old)
        assert all(data in (old[name], new[name]) for name, data in found.items())
        if case == "experiment" or number != signal.SIGKILL:  # a signal that can wait waits: the two go together
            assert found in (old, new)
        # the next start ends what was begun, and leaves nothing lying about, even where it then refuses to overwrite
        refused = CliRunner().invoke(cli, [w for w in command(words, before) if w != "--force"])
        assert refused.exit_code == 2 and "exists" in refused.output
        assert state(Path()) in (old, new) and hidden() == []
        if code == 0:
            break
        if state(Path()) != old:
            shutil.copytree(kept, Path.cwd(), dirs_exist_ok=True)
    assert code == 0 and state(Path()) == new and step > 6


def test_the_sidecar_of_an_older_result_goes_with_it() -> None:
    """--no-provenance: no sidecar beside what it does not describe, at no step of a kill that the next start sees."""
    srf(*command(FILE, "9"), "--no-provenance")
    new = state(Path())
    assert set(new) == {"a.csv"}
    srf(*command(FILE, "8"))
    old, kept = state(Path()), Path.cwd().parent / "kept"
    shutil.copytree(Path.cwd(), kept)
    for step in range(1, 100):
        code = killed_at(step, signal.SIGKILL, (*command(FILE, "9"), "--no-provenance"))
        CliRunner().invoke(cli, [w for w in command(FILE, "8") if w != "--force"])
        assert state(Path()) in (old, new) and hidden() == []
        if code == 0:
            break
        shutil.copytree(kept, Path.cwd(), dirs_exist_ok=True)
    assert code == 0 and state(Path()) == new and step > 6


def test_a_stranger_s_note_moves_nothing_else() -> None:
    srf(*command(FILE, "8"))
    Path("precious").write_text("kept")
    Path(".x.part").write_text("theirs")
    Path(".a.csv.12345678.part").write_text("theirs")
    moves = {".x.part": "precious", ".a.csv.12345678.part": "precious", "precious": "a.csv", "../x": "a.csv"}
    Path(".a.csv.moves").write_text(json.dumps(moves))
    srf(*command(FILE, "8"))
    assert Path("precious").read_text() == "kept" and Path(".x.part").read_text() == "theirs"


def test_parts_of_the_living_stay() -> None:
    held, go = threading.Event(), threading.Event()
    from srfcli.core.files import whole_folder

    def write() -> None:
        with whole_folder(Path("made"), lambda: None) as fresh:
            (fresh / "mine").write_text("whole")
            held.set()
            go.wait(1200)

    writer = threading.Thread(target=write)
    writer.start()
    assert held.wait(1200)
    assert forked(lambda: CliRunner().invoke(cli, command(FOLDER, "5"), prog_name="srf").exit_code) == 0
    go.set()
    writer.join()
    assert (Path("made") / "mine").read_text() == "whole"


def test_a_part_left_inside_does_not_lock_a_folder() -> None:
    srf(*command(FOLDER, "5"))
    (Path("made") / ".experiment.toml.abcdefgh.part").write_text("of a dead process")
    srf(*command(FOLDER, "6"))
    assert hidden() == []


def test_an_experiment_that_was_between_two_renames_is_found() -> None:
    srf(*command(FOLDER, "5"))
    scratch = Path(".made.abcdefgh.part")
    (scratch / "made").mkdir(parents=True)
    Path("made").rename(scratch / "replaced")  # as where two folders cannot be exchanged in one step
    srf("check", "made", "--no-simulate")
    assert hidden() == []


@pytest.mark.parametrize("size", [0, 1, 100, 400])
@pytest.mark.parametrize("case", CASES)
def test_a_full_disk(case: str, size: int) -> None:
    words, before, after = CASES[case]
    srf(*command(words, before))
    old, told = state(Path()), Path.cwd().parent / "told"

    def work() -> int:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        done = CliRunner().invoke(cli, command(words, after), prog_name="srf")
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2) if os.geteuid() == 0 else None
        with contextlib.suppress(OSError):
            told.write_text(done.stderr)
        return done.exit_code

    assert forked(work) == 1
    assert state(Path()) == old and hidden() == []
    if told.exists():
        name = {"experiment": "made", "law": "my-law.toml"}.get(case, "a.csv")
        assert "cannot be written" in told.read_text() and name in told.read_text()


WINDOW = ("--eps", "0.09", "--over", "V=1:100:3", "--over", "K/W0=0.002:0.03:3", "--no-boundaries")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("map", *WINDOW, "--out", "map.csv", "--resume", "parts"), "part-00000.npz cannot be written"),
        (("report", "."), "report.html cannot be written"),
        (("linear", "--over", "V=8", "--plot", "a.svg"), "a.svg cannot be written"),
        pytest.param(
            ("simulate", "--law", "./unseen.toml", "--for", "0.1", "--rate", "50"),
            "no model can be compiled in the folder of temporary files",
            marks=pytest.mark.skipif(compiler() is None, reason="NO COMPILER"),
        ),
    ],
    ids=["part", "page", "figure", "library"],
)
def test_a_full_disk_names_the_file(
    arguments: tuple[str, ...], said: str, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    if arguments[0] == "simulate":
        monkeypatch.setenv("SRF_CACHE", str(tmp_path_factory.mktemp("cache")))  # nothing is compiled there, nor by another test
        srf("law", "new", "unseen")
        law = Path("unseen.toml")
        law.write_text(law.read_text().replace("A*log", "1.0625*A*log"))
    elif arguments[0] == "map":
        srf("map", *WINDOW)  # what it compiles is kept
    srf("linear", "--over", "V=8", "--out", "a.json")
    before, told = state(Path()), Path.cwd().parent / "told"

    def work() -> int:
        resource.setrlimit(resource.RLIMIT_FSIZE, (600, resource.RLIM_INFINITY))
        done = CliRunner().invoke(cli, arguments, prog_name="srf")
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        told.write_text(done.stderr)
        return done.exit_code

    code = forked(work)
    assert code == 1 and said in told.read_text()
    assert {n: d for n, d in state(Path()).items() if n != "parts/srf-run.json"} == before and hidden() == []


def test_at_random_moments() -> None:
    """A sample of benchmarks/kills.py: real processes, ended from outside."""
    import random

    chance = random.Random(1)
    words, before, after = CASES["result and sidecar"]
    srf(*command(words, after))
    new = state(Path())
    srf(*command(words, before))
    old = state(Path())
    for _ in range(6):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if child == 0:
            with contextlib.suppress(BaseException):
                for _ in range(100):
                    CliRunner().invoke(cli, command(words, after))
                    CliRunner().invoke(cli, command(words, before))
            os._exit(0)
        time.sleep(chance.uniform(0.01, 0.3))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        found = state(Path())
        assert all(data in (old[name], new[name]) for name, data in found.items()) and set(found) == set(old)
        CliRunner().invoke(cli, [w for w in command(words, before) if w != "--force"])
        assert state(Path()) in (old, new)
    srf(*command(words, before))
    assert hidden() == []


AT_IMPORT = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background of a shell
class Watch:
    def find_spec(name, *other):
        if name == {module!r}:
            os.kill(os.getpid(), {number:d})
sys.meta_path.insert(0, Watch)
sys.argv = ["srf", "linear", "--over", "V=8", "--out", "a.csv"]
from srfcli.__main__ import main
main()
"""


@pytest.mark.parametrize(
    ("module", "number", "code", "said"),
    [
        ("click", signal.SIGINT, -signal.SIGINT, ""),
        ("srfcli.core.errors", signal.SIGINT, -signal.SIGINT, ""),
        ("srfcli.cli.stability", signal.SIGINT, 130, "Error: interrupted"),
        ("srfcli.tasks.stability", signal.SIGINT, 130, "Error: interrupted"),
        ("click", signal.SIGTERM, -signal.SIGTERM, ""),
        ("srfcli.tasks.stability", signal.SIGTERM, -signal.SIGTERM, ""),
        ("srfcli.tasks.stability", signal.SIGKILL, -signal.SIGKILL, ""),
    ],
)
def test_while_modules_are_imported(module: str, number: int, code: int, said: str) -> None:
    """Nothing is left, no traceback is shown, and the caller sees by what it ended."""
    done = subprocess.run([sys.executable, "-c", AT_IMPORT.format(module=module, number=number)], capture_output=True, text=True)
    assert done.returncode == code and done.stderr.strip() == said and done.stdout == ""
    assert not list(Path().iterdir())
