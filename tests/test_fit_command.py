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


@pytest.mark.parametrize("offset", [0.0, 0.02])
def test_levels_of_runs_that_differ_are_told(offset: float) -> None:
    """The random field would be taken for them; without an offset its mean in a run is what a field of its length has."""
    system = "--law dieterich-ruina --interface rigid --no-inertia --K 0.03 --W0 20 --set A=0.008 --set B=0.006 --set D0=5"
    program = "--set V0=3 --drive 10:3,10:10,10:3 --rate 5 --observe friction --noise 1e-4 --free mu0,A,B,D0"
    for seed, name in enumerate(("one", "two")):
        own = f"--set mu0={0.6 + seed * offset} --seed {seed + 1} --field 4e-4 --field-length 8 --out-dir {name}"
        assert CliRunner().invoke(cli, ["simulate", *f"{system} {program} {own}".split()], prog_name="srf").exit_code == 0
    Path("two/simulated.csv").rename("one/two.csv")
    text = Path("one/experiment.toml").read_text()
    block = text[text.index("[[runs]]") :].replace('"simulated"', '"two"').replace("simulated.csv", "two.csv")
    Path("one/experiment.toml").write_text(f"{text}\n{block}")
    done = CliRunner().invoke(cli, ["fit", "one"], prog_name="srf")
    assert done.exit_code == 0, done.stderr
    assert ("--vary mu0" in done.stdout) == bool(offset), done.stdout
