"""The numerical commands as a user meets them: columns, reference values, files, errors, interruption."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from srfcli.cli.main import cli

ROOT = Path(__file__).resolve().parents[1]
BOUNDARY = ["eps", "component", "crossing", "type", "V", "K_over_W0", "W0", "theta", "status"]
LINEAR = ["V", "K_over_W0", "W0", "Omega_c"]
K = 0.21


pytestmark = pytest.mark.usefixtures("empty_folder")


def srf(*arguments: str) -> Result:
    """Run a command in this process; what it prints is in `stdout` and `stderr`."""
    return CliRunner().invoke(cli, arguments, prog_name="srf")


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def columns(text: str) -> list[str]:
    return text.splitlines()[0].split(",")


def reference(shared: Path, name: str) -> list[dict[str, float]]:
    rows = table((shared / "reference" / name).read_text(encoding="utf-8"))
    return [{k: float(v) for k, v in row.items()} for row in rows]


# what other programs rely on


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("linear", "--over", "V=1,300"), LINEAR),
        (("critical", "--eps", "0.09", "--V", "7"), BOUNDARY),
        (("continue", "--eps", "0.045", "--over", "V=5:8", "--scan-lines", "3"), BOUNDARY),
    ],
    ids=lambda a: a[0],
)
def test_columns_and_json(arguments: tuple[str, ...], expected: list[str]) -> None:
    text = srf(*arguments, "--csv")
    assert text.exit_code == 0, text.stderr
    assert columns(text.stdout)[: len(expected)] == expected
    assert "nan" not in text.stdout.lower() and "inf" not in text.stdout.lower()
    data = srf(*arguments, "--json")
    parsed = json.loads(data.stdout, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert data.exit_code == 0 and parsed["schema"] == f"srf.{arguments[0]}/1" and parsed["status"] == "ok"
    assert list(parsed["columns"])[: len(expected)] == expected
    for row, document in zip(table(text.stdout), parsed["rows"], strict=True):
        for name in expected:
            value = document[name]
            assert row[name] == ("" if value is None else str(value)), name


def test_floquet_json_is_complete() -> None:
    done = srf("floquet", "--V", "8", "--W0", "9", "--eps", "0.09", "--json")
    data = json.loads(done.stdout, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert data["schema"] == "srf.floquet/1" and len(data["rows"]) == 4 and data["meta"]["stable"] is True
    assert data["rows"][0]["error"] < 1e-6 and data["meta"]["friction_shift"] < 0
    product = math.prod(math.hypot(r["re"], r["im"]) for r in data["rows"])
    assert product == pytest.approx(math.prod(r["modulus"] for r in data["rows"]), rel=1e-12)


@pytest.mark.parametrize(("condition", "code"), [("stable", 4), ("unstable", 0)])
def test_fail_on(condition: str, code: int) -> None:
    assert srf("floquet", "--V", "8", "--W0", "9", "--eps", "0.09", "--fail-on", condition).exit_code == code


# against independent numbers


def test_linear_agrees_with_the_reference(shared: Path) -> None:
    wanted = reference(shared, "hopf_points.csv")
    listed = ",".join(f"{row['V_um_s']:g}" for row in wanted)
    found = table(srf("linear", "--over", f"V={listed}", "--csv").stdout)
    for row, one in zip(found, wanted, strict=True):
        assert float(row["K_over_W0"]) == pytest.approx(one["K_over_W0c_per_um"], abs=6e-11)
        assert float(row["W0"]) == pytest.approx(one["W0c_N"], rel=1e-9)
        assert float(row["Omega_c"]) == pytest.approx(one["Omega_rad_s"], rel=1e-8)


def test_critical_agrees_with_the_reference(shared: Path) -> None:
    wanted = [r for r in reference(shared, "boundary_points.csv") if r["V_um_s"] in (1, 5, 8, 20, 50, 100)]
    listed = ",".join(f"{v:g}" for v in sorted({r["V_um_s"] for r in wanted}))
    done = srf("critical", "--eps", "0.045,0.09", "--V", listed, "--csv")
    found = table(done.stdout)
    assert done.exit_code == 0 and len(found) == len(wanted)
    for row, one in zip(found, wanted, strict=True):
        assert (float(row["eps"]), float(row["V"])) == (one["eps"], one["V_um_s"])
        assert float(row["W0"]) == pytest.approx(one["W0c_N"], rel=2e-8)
        assert float(row["theta"]) == pytest.approx(one["theta_rad"], rel=1e-6)
        assert float(row["K_over_W0"]) == pytest.approx(K / float(row["W0"]), rel=1e-14)
        assert float(row["W0_low"]) <= one["W0c_N"] * (1 + 2e-10) and one["W0c_N"] * (1 - 2e-10) <= float(row["W0_high"])
        assert (row["type"], row["crossing"], row["component"], row["status"]) == ("ns", "1", "", "ok")


def test_continue_passes_through_the_reference(shared: Path) -> None:
    import numpy as np

    done = srf("continue", "--eps", "0.09", "--over", "V=1:100", "--step", "0.02", "--csv")
    found = table(done.stdout)
    assert done.exit_code == 0 and {row["component"] for row in found} == {"1"}
    assert {(row["type"], row["crossing"], row["status"]) for row in found} == {("ns", "1", "ok")}
    V, W0 = (np.log([float(row[name]) for row in found]) for name in ("V", "W0"))
    order = np.argsort(V)
    for one in reference(shared, "boundary_points.csv"):
        if one["eps"] == 0.09:
            got = math.exp(np.interp(math.log(one["V_um_s"]), V[order], W0[order]))
            assert got == pytest.approx(one["W0c_N"], rel=2e-3)  # straight lines between points


def test_the_boundary_at_0_18_has_two_components() -> None:
    done = srf("continue", "--eps", "0.18", "--over", "V=1:100", "--csv")
    found = table(done.stdout)
    assert done.exit_code == 0 and {row["component"] for row in found} == {"1", "2"}, done.stderr
    lower = [row for row in found if row["component"] == "1"]
    assert max(float(row["V"]) for row in lower) == pytest.approx(27.387, rel=2e-3)
    assert {int(row["crossing"]) for row in lower} == {1, 2}


def test_velocity_strengthening_is_said() -> None:
    first, second = table(srf("linear", "--over", "V=10,300", "--csv").stdout)
    assert first["status"] == "ok" and float(first["W0"]) > 0
    assert second["status"] == "velocity strengthening: no Hopf"
    assert second["K_over_W0"] == second["W0"] == second["Omega_c"] == ""
    lines = srf("critical", "--V", "300", "--eps", "0.09", "--window", "4:40", "--csv")
    assert table(lines.stdout) == [] and "stable at every load looked at" in lines.stderr


def test_an_eps_of_nothing_is_linear() -> None:
    (row,) = table(srf("critical", "--eps", "0", "--V", "10", "--csv").stdout)
    (hopf,) = table(srf("linear", "--over", "V=10", "--csv").stdout)
    assert float(row["W0"]) == pytest.approx(float(hopf["W0"]), rel=1e-8)


# files


@pytest.mark.parametrize(("suffix", "begins"), [("svg", b"<?xml"), ("png", b"\x89PNG"), ("pdf", b"%PDF")])
def test_plots(suffix: str, begins: bytes, empty_folder: Path) -> None:
    pytest.importorskip("matplotlib")
    name = f"figure.{suffix}"
    done = srf("linear", "--over", "V=1:100:8", "--plot", name, "-q")
    assert done.exit_code == 0, done.stderr
    assert (empty_folder / name).read_bytes().startswith(begins)
    assert (empty_folder / f"{name}.provenance.json").is_file() and done.stderr == ""


@pytest.mark.parametrize(
    "arguments",
    [
        ("linear", "--over", "V=1:100:5"),
        ("critical", "--eps", "0.09", "--V", "7"),
        ("continue", "--eps", "0.045", "--over", "V=5:8", "--scan-lines", "3"),
        ("floquet", "--V", "8", "--W0", "9", "--eps", "0.09"),
    ],
    ids=lambda a: a[0],
)
def test_a_sidecar_is_stable_but_for_the_timings(arguments: tuple[str, ...], empty_folder: Path) -> None:
    pytest.importorskip("matplotlib")
    contents, sidecars = [], []
    for _ in range(2):
        assert srf(*arguments, "--out", "x.json", "--plot", "x.svg", "--force").exit_code == 0
        contents.append((empty_folder / "x.json").read_bytes())
        sidecars.append((empty_folder / "x.json.provenance.json").read_text(encoding="utf-8"))
    assert contents[0] == contents[1] and "</svg>" in (empty_folder / "x.svg").read_text(encoding="utf-8")
    assert sidecars[0].partition('"timings"')[0] == sidecars[1].partition('"timings"')[0]
    data = json.loads(sidecars[0])
    assert list(data)[-1] == "timings" and data["sha256"] == hashlib.sha256(contents[0]).hexdigest()
    assert data["parameters"]["K"] == {"value": K, "unit": "N/um", "origin": "law default"}
    assert {law["name"] for law in data["laws"]} == {"srf-vsat", "dieterich", "elastic"}
    assert all(law["sha256"] for law in data["laws"])


def test_notes_go_to_stderr_beside_csv(empty_folder: Path) -> None:
    arguments = ("critical", "--eps", "0.09", "--V", "7", "--window", "4:40")
    assert "Note: looked from 4 to 40 N" in srf(*arguments, "--csv").stderr
    assert "Note: looked from 4 to 40 N" in srf(*arguments, "--out", "x.csv").stderr
    assert srf(*arguments, "--csv", "-q").stderr == ""
    assert srf(*arguments).stderr == "" and "Note:" in srf(*arguments).stdout


# bad input


WILD = """
format = "srf-law/1"
kind = "friction"
mu = "zzz + B*log(v*phi/D0)"
[parameters]
B = { default = 0.02 }
D0 = { default = 0.4, unit = "um" }
"""
BAD: list[tuple[Sequence[str], str]] = [
    (["linear", "--law", "srf-vsta"], "Did you mean 'srf-vsat'?"),
    (["critical", "--V", "7", "--ageing", "dieterich+foo"], "unknown modifier law 'foo'"),
    (["continue", "--interface", "rubber"], "Known: constant, elastic, power, rigid"),
    (["floquet", "--loading", "up"], "'up' is not one of"),
    (["linear", "--set", "v_s=3"], "Did you mean 'Vsat'?"),
    (["linear", "--set", "B"], "is not NAME=VALUE"),
    (["linear", "--set", "B=nan"], "is not a number"),
    (["linear", "--K", "3 parsec"], "measures um, not N/um"),
    (["linear", "--K", "3 s"], "measures s, not N/um"),
    (["linear", "--set", "B=-5"], "below its lower bound 0"),
    (["linear", "--set", "B=2"], "above its upper bound 1"),
    (["linear", "--over", "V=-1,2"], "V = -1 um/s is below"),
    (["linear", "--over", "V=0:10"], "V = 0 um/s is below"),
    (["critical", "--V", "0"], "V = 0 um/s is below"),
    (["floquet", "--V", "-3"], "V = -3 um/s is below"),
    (["floquet", "--V", "x"], "V = 'x' is not a number"),
    (["floquet", "--W0", "0"], "W0 = 0 N is below"),
    (["critical", "--V", "7", "--eps", "1"], "eps = 1 is above"),
    (["continue", "--eps", "1.2"], "eps = 1.2 is above"),
    (["floquet", "--eps", "1"], "eps = 1 is above"),
    (["floquet", "--eps", "-0.1"], "eps = -0.1 is below"),
    (["linear", "--over", "eps=0:1"], "eps = 1 is above"),
    (["linear", "--over", "nonsense"], "is not a range"),
    (["linear", "--over", "q=1:2"], "unknown parameter 'q'"),
    (["linear", "--over", "V=2:1"], "is not below its high end"),
    (["linear", "--over", "V=1:2:3:4:5"], "5 fields"),
    (["continue", "--over", "V=1,2"], "lists values"),
    (["continue", "--over", "W0=1:20"], "spans no plane"),
    (["continue", "--over", "V=1:2", "--over", "W0=1:2", "--over", "K=1:2"], "--over has 3 axes"),
    (["continue", "--over", "V=1:2", "--over", "V=1:2"], "given twice"),
    (["continue", "--over", "eps=0.1:0.2", "--eps", "0.1"], "eps is an axis"),
    (["continue", "--over", "V=1:2", "--V", "7"], "V is an axis"),
    (["continue", "--W0", "7"], "W0 is an axis"),
    (["continue", "--step", "nan"], "--step nan"),
    (["continue", "--tol", "0"], "tol = 0"),
    (["critical", "--V", "7", "--window", "nonsense"], "--window 'nonsense'"),
    (["critical", "--V", "7", "--window", "5:4"], "--window '5:4'"),
    (["critical", "--V", "7", "--window", "1:2:3"], "--window '1:2:3'"),
    (["critical", "--V", "7", "--window", "1:4 s"], "unit"),
    (["critical", "--V", "7", "--tol", "nan"], "--tol nan"),
    (["critical", "--V", ""], "V = '' is not a number"),
    (["linear", "--plot", "x.gif"], "ends in '.gif'"),
    (["linear", "--out", "there.csv"], "there.csv exists"),
    (["linear", "--plot", "there.svg"], "there.svg exists"),
    (["linear", "--out", "no/where.csv"], "does not exist"),
    (["linear", "--csv", "--json"], "exclude each other"),
    (["linear", "--plugins", "nowhere"], "no folder nowhere"),
    (["linear", "--plugins", ".", "--law", "bad"], "bad.toml"),
    (["linear", "--plugins", ".", "--law", "wild"], "'zzz'"),
    (["lineer"], "Did you mean 'linear'?"),
    (["linear", "--jsno"], "Did you mean '--json'?"),
    (["floquet", "--fail-on", "rain"], "'rain' is not one of"),
]


@pytest.mark.parametrize(("arguments", "said"), BAD, ids=lambda v: " ".join(v) if isinstance(v, list) else "")
def test_bad_input_is_one_line(arguments: list[str], said: str, empty_folder: Path) -> None:
    Path("there.csv").write_text("kept")
    Path("there.svg").write_text("kept")
    Path("bad.toml").write_text("x = [")
    Path("wild.toml").write_text(WILD)
    before = {p.name: p.read_bytes() for p in empty_folder.iterdir()}
    done = srf(*arguments)
    assert done.exit_code == 2, done.stdout + done.stderr
    assert done.stdout == "" and said in done.stderr and "Traceback" not in done.stderr
    lines = done.stderr.splitlines()
    assert lines[0].startswith("Error: ") and len([li for li in lines if li.startswith("Error:")]) == 1
    assert all(li.startswith(("Try: ", "  ")) for li in lines[1:])
    assert {p.name: p.read_bytes() for p in empty_folder.iterdir()} == before


def test_a_broken_plugin_stops_nobody_else(empty_folder: Path) -> None:
    Path("bad.toml").write_text("x = [")
    assert srf("linear", "--plugins", ".", "--over", "V=1,2").exit_code == 0


# what does not converge, and who does not wait


@pytest.mark.parametrize(
    "arguments",
    [
        ("critical", "--eps", "0.18", "--V", "50", "--max-mesh", "32", "--tol", "1e-11"),
        ("continue", "--eps", "0.18", "--over", "V=40:50", "--max-mesh", "64", "--tol", "1e-11", "--scan-lines", "2"),
        ("continue", "--eps", "0.09", "--over", "V=5:50", "--max-steps", "2", "--scan-lines", "2"),
        ("floquet", "--V", "50", "--W0", "15", "--eps", "0.18", "--max-mesh", "32", "--tol", "1e-12"),
    ],
    ids=["critical", "continue", "max-steps", "floquet"],
)
def test_what_does_not_converge_is_written_all_the_same(arguments: tuple[str, ...], empty_folder: Path) -> None:
    done = srf(*arguments, "--out", "x.json")
    assert done.exit_code == 3, done.stderr
    data = json.loads((empty_folder / "x.json").read_text(encoding="utf-8"))
    assert data["status"] != "ok" and data["rows"]
    assert "Not finished: " in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "moment"),
    [(("continue", "--over", "V=10:30"), " 30 points"), (("critical", "--V", "20,30,40"), "V = 30 um/s")],
    ids=["continue", "critical"],
)
def test_ctrl_c_keeps_what_is_done(arguments: tuple[str, ...], moment: str, empty_folder: Path, srf_ended_at) -> None:
    code, _, said = srf_ended_at(moment, *arguments, "--eps", "0.045,0.4", "--out", "x.csv")
    assert code == 130 and "Interrupted" in said and "Traceback" not in said, said
    text = (empty_folder / "x.csv").read_text(encoding="utf-8")
    rows: list[dict[str, Any]] = table(text)
    assert columns(text)[: len(BOUNDARY)] == BOUNDARY and text.endswith("\n")
    assert rows and all(None not in row.values() and None not in row for row in rows)  # no line is cut
    assert not [p for p in empty_folder.iterdir() if p.suffix == ".part"]
