"""No compiler anywhere, neither on PATH nor as a package: commands say in one line what that costs, and what they do is right."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

RUN = """
import sys
sys.modules["ziglang"] = None  # as where it is not installed
from srfcli.cli.main import main
main(sys.argv[1:])
"""
STEPS = ("--drive", "0.5:10, 0.5:20", "--W0", "5", "--rate", "100", "--noise", "0.02", "--seed", "1")


def srf(*arguments: str, compiler: bool, tmp_path: Path) -> subprocess.CompletedProcess[str]:
    (tmp_path / "nothing").mkdir(exist_ok=True)
    environment = {k: v for k, v in os.environ.items() if k not in ("CC", "SRF_CC")}
    if not compiler:
        environment["PATH"] = str(tmp_path / "nothing")
    script = RUN if not compiler else RUN.replace('sys.modules["ziglang"] = None', "")
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", script, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def simulated_without(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """A folder in which a recording was simulated without a compiler, and what the command said."""
    folder = tmp_path_factory.mktemp("without")
    return folder, srf("simulate", *STEPS, "--free", "A", "--out-dir", "steps", compiler=False, tmp_path=folder)


def test_simulate_says_what_it_costs(simulated_without: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    tmp_path, done = simulated_without
    warnings = [line for line in done.stderr.splitlines() if line.startswith("Warning")]
    assert done.returncode == 0 and len(warnings) == 1
    assert "no C compiler was found" in warnings[0] and "as long" in warnings[0] and "pip install ziglang" in warnings[0]
    beside = srf("simulate", *STEPS, "--out-dir", "again", compiler=True, tmp_path=tmp_path)
    assert beside.returncode == 0 and "Warning" not in beside.stderr

    def last(folder: str) -> float:
        lines = (tmp_path / folder / "simulated.csv").read_text(encoding="utf-8").split()
        return float(lines[-1].split(",")[-1])

    assert last("steps") == pytest.approx(last("again"), abs=1e-4)


def test_a_fit_and_a_diagnosis_say_it(simulated_without: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    tmp_path, _ = simulated_without
    folder = tmp_path / "steps"
    fit = srf("fit", str(folder), compiler=False, tmp_path=tmp_path)
    assert fit.returncode == 2 and "Try: pip install ziglang, or install cc, gcc or clang" in fit.stderr
    diagnosis = srf("diagnose", str(folder), compiler=False, tmp_path=tmp_path)
    assert diagnosis.returncode == 2 and "Try: pip install ziglang, or install cc, gcc or clang" in diagnosis.stderr


def test_boundaries_need_none(tmp_path: Path) -> None:
    loads = [
        srf("critical", "--eps", "0.09", "--V", "7", "--window", "8:13", "--csv", compiler=c, tmp_path=tmp_path)
        for c in (False, True)
    ]
    values = [float(done.stdout.splitlines()[1].split(",")[6]) for done in loads]
    assert values[0] == pytest.approx(10.141263156, rel=1e-7) and values[0] == pytest.approx(values[1], rel=1e-8)


def simulated(named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> subprocess.CompletedProcess[str]:
    """Return a simulation with the compiler that SRF_CC names."""
    monkeypatch.setenv("SRF_CC", named)
    words = ["simulate", "--drive", "0.1:10", "--W0", "5"]
    return subprocess.run([sys.executable, "-c", RUN, *words], cwd=tmp_path, capture_output=True, text=True, check=False)


def test_who_asks_for_none_is_told_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = simulated("", tmp_path, monkeypatch)
    assert done.returncode == 0 and "Warning" not in done.stderr


def test_a_program_that_is_none_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = simulated("/no/such/cc -O1", tmp_path, monkeypatch)
    assert done.returncode == 2 and "SRF_CC: there is no program /no/such/cc" in done.stderr
