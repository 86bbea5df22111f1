"""Shared fixtures: models by the names of their parts, built once in a session; --runslow."""

from __future__ import annotations

import io
import itertools
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from srfcli.core import ONE_THREAD

os.environ.update(ONE_THREAD)  # as the command line does: two workers of several threads each hinder each other

# a shell that begins the suite in the background has SIGINT ignored, in all programs that it starts too
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--runslow", action="store_true", help="run the long proofs too")


# Files of long tests, by their time: what takes longest is begun first, so that no worker is left alone with it at the end.
LONG = (
    "test_readme.py", "test_model_search.py", "test_fit_recordings.py", "test_unknown.py", "test_misstated.py", "test_new.py",
    "test_threshold_experiments.py", "test_notebooks.py", "test_report.py", "test_discriminating.py", "test_prove.py",
    "test_statespace.py", "test_api.py", "test_diagnose_command.py", "test_effects.py", "test_cli_commands.py",
    "test_simulate_command.py", "test_proof_bank.py", "test_kills.py", "test_proof_generator.py", "test_effect_plugins.py",
    "test_site.py", "test_recording_flaws.py", "test_hostile_files.py", "test_thresholds.py", "test_equations.py",
    "test_compare.py", "test_stress.py", "test_campaign.py", "test_check.py", "test_brute_force.py", "test_one_run.py",
    "test_map.py", "test_packaging.py", "test_derive.py", "test_motion.py", "test_readers.py", "test_sample.py",
    "test_diagram.py", "test_paper.py", "test_parallel.py", "test_windows.py", "test_observables.py", "test_cache.py",
    "test_generate.py", "test_fit.py", "test_recording_real.py", "test_without_compiler.py", "test_locate.py",
    "test_escapes.py", "test_map_folds.py", "test_trust.py", "test_architecture.py", "test_continuation.py",
    "test_simulate_field.py", "test_cli_frame.py",
)  # fmt: skip


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))
    if not config.getoption("--runslow"):
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(pytest.mark.skip(reason="slow: run with --runslow"))


@pytest.fixture
def empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty folder to work in, without settings of the caller; only the cache of generated code is shared."""
    for name in [n for n in os.environ if n.startswith("SRF_") and n not in ("SRF_CACHE", "SRF_SHARED")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "none"))
    folder = tmp_path / "empty"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def _hide_matplotlib(patch: pytest.MonkeyPatch) -> None:
    import importlib.util

    find = importlib.util.find_spec
    patch.setattr(importlib.util, "find_spec", lambda name, *of: None if name == "matplotlib" else find(name, *of))


@pytest.fixture
def without_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without figures, which cost more to draw than all else of them; what is written depends on them in nothing else."""
    _hide_matplotlib(monkeypatch)


@pytest.fixture(scope="module")
def without_figures() -> Iterator[None]:
    """The same for all tests of a module."""
    with pytest.MonkeyPatch.context() as patch:
        _hide_matplotlib(patch)
        yield


class Terminal(io.StringIO):
    """A terminal at which something ends the program, Ctrl-C as a rule, when it shows a text."""

    def __init__(self, text: str, end: BaseException) -> None:
        super().__init__()
        self.text, self.end = text, end

    def isatty(self) -> bool:
        return True

    def write(self, shown: str) -> int:
        if self.text and self.text in shown:
            self.text = ""
            raise self.end
        return super().write(shown)


@pytest.fixture
def srf_ended_at(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """`srf_ended_at(text, *arguments)`: exit code, stdout and stderr where Ctrl-C is pressed as progress says `text`."""
    from srfcli.cli.main import cli

    def run(text: str, *arguments: object, end: BaseException | None = None) -> tuple[int, str, str]:
        terminal = Terminal(text, end or KeyboardInterrupt())
        with monkeypatch.context() as patch, pytest.raises(SystemExit) as stop:
            patch.setattr(sys, "stderr", terminal)
            patch.setattr(time, "monotonic", itertools.count(1.0).__next__)  # so slow a program shows each line
            cli.main([str(a) for a in arguments], prog_name="srf")
        assert not terminal.text, f"{text} was never shown"
        return int(stop.value.code or 0), capsys.readouterr().out, terminal.getvalue()

    return run


@pytest.fixture(scope="session")
def make_model() -> Callable[..., Any]:
    """`make_model(law=..., ageing=..., interface=..., loading=..., inertia=...)`: the model, built once in a session."""
    from srfcli.codegen.model import open_model
    from srfcli.laws.registry import load_registry

    registry = load_registry()
    built: dict[tuple[tuple[str, Any], ...], Any] = {}

    def make(**names: Any) -> Any:
        key = tuple(sorted(names.items()))
        if key not in built:
            built[key] = open_model(registry, **names)
        return built[key]

    return make


@pytest.fixture(scope="session")
def model(make_model: Callable[..., Any]) -> Any:
    """The paper's system."""
    return make_model()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data: SRF_SHARED, else `shared` beside the checkout; without it the test is skipped."""
    default = Path(__file__).resolve().parent.parent.parent / "shared"
    folder = Path(os.environ.get("SRF_SHARED", default))
    if not (folder / "reference").is_dir():
        pytest.skip(f"REFERENCE DATA ABSENT: {folder}/reference does not exist; set SRF_SHARED to check against it")
    return folder
