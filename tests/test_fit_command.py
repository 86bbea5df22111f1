"""What `srf fit` refuses of a folder of recordings: what the experiment says itself."""

from __future__ import annotations

import json
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


def test_a_parameter_that_the_recordings_do_not_show_has_no_error() -> None:
    """The response to a changing load, under a load that is constant."""
    system = "--law dieterich-ruina --ageing dieterich+linker-dieterich --interface rigid --no-inertia --K 0.03 --W0 20"
    values = "--set A=0.008 --set B=0.006 --set D0=5 --set V0=3 --drive 10:3,10:10,10:3 --rate 5"
    made = "--observe friction --noise 1e-4 --free mu0,A,B,D0,alpha --out-dir made"
    assert CliRunner().invoke(cli, ["simulate", *f"{system} {values} {made}".split()], prog_name="srf").exit_code == 0
    done = CliRunner().invoke(cli, ["fit", "made", "--json"], prog_name="srf")
    rows = {row["parameter"]: row for row in json.loads(done.stdout)["rows"]}
    assert [rows["alpha"][name] for name in ("stderr", "low", "high")] == [None] * 3
    assert rows["alpha"]["flag"] == "not identifiable: the recordings have no say in it"
    assert all(rows[name]["stderr"] and not rows[name]["flag"] for name in ("A", "B", "D0"))
