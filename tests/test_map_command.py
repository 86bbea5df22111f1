"""`srf map` on the command line: what it prints and writes, its axes, what it refuses."""

from __future__ import annotations

import csv
import json

import pytest
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.core.units import describe

SMALL = ("map", "--eps", "0.18", "--over", "V=10:40:8", "--over", "K/W0=0.01:0.025:12")


def run(*arguments):
    """Return the exit code, stdout and stderr of `srf` with `arguments`."""
    runner = CliRunner()
    done = runner.invoke(cli, list(arguments))
    return done.exit_code, done.stdout, done.stderr


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_text_lists_components_and_special_points(tmp_path):
    code, out, _ = run(*SMALL)
    assert code == 0
    assert "Note: 2 components" in out
    assert "Note: the curves account for the stability of all 96 points" in out
    assert "nothing is claimed" in out
    [fold] = [line for line in out.splitlines() if "fold in V" in line]
    assert float(fold.split()[4]) == pytest.approx(27.387153754, rel=1e-6)


def test_files_hold_the_grid_the_boundary_and_the_figure(tmp_path):
    code, out, _ = run(*SMALL, "--out", "map.csv", "--boundary", "edge.csv", "--plot", "map.svg")
    assert (code, out) == (0, "")
    with (tmp_path / "map.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 96
    assert {r["type"] for r in rows} == {"stable", "ns"}
    for row in rows:
        assert (float(row["growth_per_slip"]) < 0) == (row["type"] == "stable")
    with (tmp_path / "edge.csv").open(encoding="utf-8") as stream:
        edge = list(csv.DictReader(stream))
    assert {r["component"] for r in edge} == {"1", "2"}
    assert all(float(r["error"]) <= 1e-6 and r["status"] == "ok" for r in edge)
    assert {float(r["cubic"]) > 0 for r in edge} == {False, True}  # super- and subcritical both
    assert (tmp_path / "map.svg").read_text(encoding="utf-8").count("K/W") >= 1
    assert (tmp_path / "map.csv.provenance.json").exists() and (tmp_path / "edge.csv.provenance.json").exists()


def test_criticality_can_be_left_out():
    code, out, _ = run(*SMALL, "--no-criticality")
    assert code == 0 and "criticality" not in out
    assert "criticality" in run(*SMALL)[1]


def test_json_holds_everything():
    code, out, _ = run(*SMALL, "--json")
    data = json.loads(out)
    assert code == 0 and data["schema"] == "srf.map/2" and len(data["rows"]) == 96
    assert len(data["meta"]["components"]) == 2
    assert data["meta"]["unexplained_points"] == 0
    assert data["meta"]["crossings"] == [3, 3, 3, 3, 2, 0, 0, 0]  # the lower curve leaves through the bottom
    assert sum(data["meta"]["share"].values()) == pytest.approx(1.0)


def test_equal_runs_give_equal_figures(tmp_path):
    for name in ("a.svg", "b.svg"):
        assert run(*SMALL, "--no-boundaries", "--plot", name)[0] == 0
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_points_without_an_orbit_end_with_exit_code_3():
    code, out, err = run(
        *("map", "--interface", "rigid", "--eps", "0.9", "--over", "V=1:2:2", "--over", "K/W0=0.01:0.011:2"), "--csv"
    )
    assert code == 3
    assert "unresolved" in out and "no forced periodic state was found" in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--over", "V=1:9:5", "--over", "W0=4:9:5", "--over", "f=9:99:5"), "given 3 times"),
        (("--over", "V=1:9:5", "--V", "3"), "V is an axis and has a value too"),
        (("--over", "V=1:9:5", "--over", "K/W0=0.01:0.02:5", "--W0", "3"), "W0 is an axis and has a value too"),
        (("--over", "V=1,2,3"), "lists values"),
        (("--over", "K/W0=0.01:0.02:5"), "alone spans no plane"),
        (("--over", "V=1:9:5", "--over", "K/W0=0.01:0.02 N:5"), "wrong unit"),
        (("--over", "V=1:9:5", "--over", "K/Wo=0.01:0.02:5"), "unknown parameter"),
        (("--boundary", "edge.txt"), "neither .csv nor .json"),
        (("--boundary", "edge.csv", "--no-boundaries"), "--no-boundaries"),
        (("--boundary", "a.csv", "--out", "a.csv"), "same file"),
        (("--step", "2"), "out of range"),
        (("--workers", "2", "--cluster", "tcp://localhost:1"), "exclude each other"),
    ],
)
def test_misuse_is_told_before_anything_is_computed(arguments, said):
    code, _, err = run("map", "--eps", "0.1", *arguments)
    assert code == 2
    assert said in err and "Try: " in err


def test_a_ratio_takes_a_unit():
    code, out, _ = run("map", "--eps", "0.1", "--over", "V=8:9:2", "--over", "K/W0=0.02:0.03 1/um:3", "--no-boundaries", "--csv")
    assert code == 0
    assert [line.split(",")[3] for line in out.splitlines()[1:4]] == ["0.02", "0.025", "0.03"]


@pytest.mark.parametrize(
    ("powers", "text"), [((-1, 0, 0, 0), "1/um"), ((0, 0, 0, 0), "1"), ((1, -1, 0, 0), "um/s"), ((-2, 2, 1, 0), "s^2*N/um^2")]
)
def test_units_of_ratios(powers, text):
    assert describe(powers) == text
