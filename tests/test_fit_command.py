"""What `srf fit` refuses of a folder of recordings: what the experiment says itself."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner
from recording_cases import write

from srfcli.cli.main import cli

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.parametrize(
    ("options", "message", "hint"),
    [
        (("--K", "0.3"), "K is set, and an experiment has its own values", "Change it in experiment.toml."),
        (("--set", "M=1 kg"), "M is set, and", "Change it"),
        (("--set", "Vsat=300"), "Vsat is set, and", "Change it in experiment.toml."),
        (("--law", "log-log"), "--law is given, and an experiment names its own", "Change [model]"),
        (("--tol", "1e-6"), "--tol is for fits of critical loads", "Leave it out"),
    ],
)
def test_what_an_experiment_says_itself_is_refused(options: tuple[str, ...], message: str, hint: str, tmp_path: Path) -> None:
    folder = tmp_path / "small"
    folder.mkdir()
    done = CliRunner().invoke(cli, ["fit", str(write(folder)), *options], prog_name="srf")
    assert done.exit_code == 2 and not done.stdout
    assert message in done.stderr and hint in done.stderr
