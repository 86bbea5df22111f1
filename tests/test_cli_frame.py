"""The frame of `srf`: help, errors, exit codes, precedence of values, ranges and what reaches stdout."""

from __future__ import annotations

import io
import itertools
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result

import srfcli
from srfcli.cli import emit as emit_module
from srfcli.cli import options as options_module
from srfcli.cli.base import CONTEXT, SrfGroup, switches
from srfcli.cli.emit import Progress, emit, finish, remaining
from srfcli.cli.fit import FitShare
from srfcli.cli.main import cli
from srfcli.cli.options import (
    OutputOptions,
    Range,
    SystemOptions,
    output_options,
    over_option,
    parse_over,
    parse_overs,
    parse_values,
    system_options,
    values_option,
)
from srfcli.core import settings
from srfcli.core.errors import ExpressionError, SrfError, Status
from srfcli.core.settings import Parameter, TomlSettings, find_toml, load_toml, resolve
from srfcli.core.units import to_base
from srfcli.results.tables import Column, Table

ROOT = Path(srfcli.__file__).parents[1]
K = Parameter("K", 0.21, "N/um", 0.0, 10.0, "stiffness")
SPEED = Parameter("V", 10.0, "um/s", 1e-12, 1e9, "driving velocity")
PARAMETERS = (K, SPEED, Parameter("M", 2.37, "kg", 0.0), Parameter("Vsat", 256.0, "um/s", 0.0))


@pytest.fixture(autouse=True)
def no_settings_of_the_caller(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [n for n in os.environ if n.startswith("SRF_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)


def base_points(over: Range) -> list[float]:
    """Return every value of a range in um, s, N and radians."""
    fitted = over.fitted(PARAMETERS)
    return [to_base(value, fitted.unit) for value in fitted.points()]


@click.group("srf", cls=SrfGroup, context_settings=CONTEXT, params=switches())
def demo() -> None:
    """A made-up tool on the same frame."""


@demo.command("run", epilog="srf run --over V=1:100:3   # a    b")
@system_options
@values_option(SPEED)
@over_option(help="Values to run over.", default=("V=1:100:3",))
@output_options
@click.option("--fail", default="")
def run(system: SystemOptions, over: tuple[Range, ...], output: OutputOptions, V: Any, fail: str) -> None:
    """Do something."""
    failures: dict[str, Exception] = {
        "srf": SrfError("bad thing", "do it well"),
        "caret": ExpressionError("no such name 'q'", "p", text="1 + q", column=4),
        "os": FileNotFoundError(2, "No such file or directory", "x.toml"),
        "bug": TypeError("a\nb"),
    }
    if fail == "interrupt":
        raise KeyboardInterrupt
    if fail in failures:
        raise failures[fail]
    resolved = system.resolve(PARAMETERS, V=V[0] if V else None)
    rows = [(x, None, float("nan")) for x in base_points(over[0])]
    table = Table("srf.demo/1", (Column("V", "um/s"), Column("a"), Column("b")), rows, parameters=resolved.described())
    emit(table, output, figure=lambda: _figure(rows), seed=1)
    if fail:
        finish(Status(fail))


def _figure(rows: list[Any]) -> Any:
    from srfcli.results import plots

    return plots.lines([r[0] for r in rows], [[1.0 for _ in rows]], ["a"], "V", "a", True)


def invoke(*arguments: str, tool: click.Group = demo) -> Result:
    return CliRunner().invoke(tool, list(arguments))


def python(code: str, **extra: Any) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(ROOT), **extra.pop("env", {})}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, timeout=1200, **extra)


def test_every_command_has_help_with_examples_or_subcommands() -> None:
    assert "SRF_K='210 N/mm' srf config show --json" in invoke("config", "show", "--help", tool=cli).stdout
    assert "  srf run --over V=1:100:3   # a    b\n" in invoke("run", "-h").stdout
    assert invoke().stdout.startswith("Usage:") and invoke().exit_code == 0
    assert invoke("--version", tool=cli).stdout == f"srf {srfcli.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["rum"], 2, ["Error: no such command 'rum' of srf", "Try: Did you mean 'run'?"]),
        (["run", "--otu", "x"], 2, ["Error: no such option --otu of srf run", "'--out'"]),
        (["run", "--Vsat", "3"], 2, ["--set Vsat=VALUE"]),
        (["run", "--K"], 2, ["Error: option '--K' requires an argument", "Try: srf run --help"]),
        (["run", "--loading", "up"], 2, ["vertical"]),
        (["run", "--set", "v_s=3"], 2, ["unknown parameter 'v_s' in srf-vsat", "Did you mean 'Vsat'?"]),
        (["run", "--set", "Vsat"], 2, ["'Vsat' is not NAME=VALUE"]),
        (["run", "--set", "K=1", "--K", "2"], 2, ["K is set twice"]),
        (["run", "--V", "8", "--set", "V=2"], 2, ["V is set twice"]),
        (["run", "--K", "-1"], 2, ["Error: K = -1 N/um is below its lower bound 0 N/um", "from 0 to 10 N/um"]),
        (["run", "--K", "11"], 2, ["K = 11 N/um is above its upper bound 10 N/um"]),
        (["run", "--K", "3 kg"], 2, ["K = 3 kg: 'kg' measures s^2*N/um, not N/um", "Give a unit of the dimension of 'N/um'"]),
        (["run", "--K", "nan"], 2, ["K = 'nan' is not a number"]),
        (["run", "--V", "0"], 2, ["V = 0 um/s is below its lower bound"]),
        (["run", "--angle", "3"], 2, ["unknown parameter 'angle'", "--loading inclined"]),
        (["run", "--over", "v=1:2"], 2, ["unknown parameter 'v'", "Did you mean 'V'?"]),
        (["run", "--out", "no/x.csv"], 2, ["the directory no does not exist", "mkdir -p no"]),
        (["run", "--plot", "x.gif"], 2, ["ends in '.gif'", "--plot x.svg"]),
        (["run", "--json", "--csv"], 2, ["exclude each other"]),
        (["run", "--out", "x.svg", "--plot", "x.svg"], 2, ["the same file"]),
        (["run", "--fail", "srf"], 2, ["Error: bad thing\nTry: do it well\n"]),
        (["run", "--fail", "caret"], 2, ["Error: no such name 'q'\n  1 + q\n      ^\nTry: p\n"]),
        (["run", "--fail", "os"], 1, ["Error: x.toml: No such file or directory\n"]),
        (["run", "--fail", "bug"], 1, ["Error: unexpected TypeError: a b\n", "--debug"]),
        (["run", "--fail", "interrupt"], 130, ["Error: interrupted"]),
        (["run", "--fail", "no-convergence"], 3, ["Newton's method did not converge"]),
        (["run", "--fail", "interrupted"], 130, ["What was finished is kept"]),
        (["run", "--fail", "closed"], 0, []),
    ],
)
def test_exit_codes_and_errors(arguments: list[str], code: int, said: list[str]) -> None:
    done = invoke(*arguments)
    assert done.exit_code == code, done.stderr
    for text in said:
        assert text in done.stderr
    assert "Traceback" not in done.stderr and "Usage:" not in done.stderr
    assert not done.stdout or code in (0, 3, 130)


@pytest.mark.parametrize("arguments", [["--debug", "run", "--fail", "bug"], ["run", "--debug", "--fail", "bug"]])
def test_debug_shows_the_traceback(arguments: list[str]) -> None:
    assert invoke(*arguments).stderr.startswith("Traceback (most recent call last)")


def test_results_on_stdout_all_else_on_stderr(tmp_path: Path) -> None:
    done = invoke("run", "--json", "--plot", "x.svg")
    assert json.loads(done.stdout)["rows"][1] == {"V": 10.0, "a": None, "b": None}
    assert done.stderr == "Wrote x.svg\n"
    assert invoke("-q", "run", "--csv", "--out", "x.csv").stderr == ""
    assert invoke("run", "--out", "y.csv", "-v").stderr == "Wrote y.csv.provenance.json\nWrote y.csv\n"
    assert (tmp_path / "x.csv").read_text() == (tmp_path / "y.csv").read_text() == "V,a,b\n1.0,,\n10.0,,\n100.0,,\n"
    sidecar = json.loads((tmp_path / "x.svg.provenance.json").read_text())
    assert sidecar["arguments"] == ["run", "--json", "--plot", "x.svg"] and sidecar["seed"] == 1
    assert sidecar["parameters"]["K"] == {"value": 0.21, "unit": "N/um", "origin": "law default"}
    assert invoke("run", "--out", "-", "--csv").stdout == (tmp_path / "x.csv").read_text()
    assert invoke("run", "--no-provenance", "--out", "z.json").exit_code == 0
    assert not (tmp_path / "z.json.provenance.json").exists() and json.loads((tmp_path / "z.json").read_text())


def test_nothing_is_computed_for_a_file_that_would_be_refused(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("precious")
    done = invoke("run", "--out", "x.csv", "--fail", "bug")
    assert done.exit_code == 2 and "x.csv exists already" in done.stderr and "--force" in done.stderr
    assert (tmp_path / "x.csv").read_text() == "precious"
    assert invoke("run", "--out", "x.csv", "--force").exit_code == 0
    assert (tmp_path / "x.csv").read_text().startswith("V,a,b\n")


def test_equal_runs_write_equal_bytes(tmp_path: Path) -> None:
    for _ in range(2):
        kept = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
        assert invoke("run", "--force", "--out", "x.json", "--plot", "x.pdf").exit_code == 0
    assert kept == {p.name: p.read_bytes() for p in tmp_path.iterdir()} and len(kept) == 4


def test_a_closed_pipe_is_no_drama() -> None:
    code = "from srfcli.cli.main import main\nmain(['config', 'show', '--json'] * 1)"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-c", code], stdout=write, stderr=subprocess.PIPE, env=env, timeout=1200)
    os.close(write)
    assert done.stderr == b"" and done.returncode == 1


def test_a_full_disk_is_one_line() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    with Path("/dev/full").open("w") as full:
        code = "from srfcli.cli.main import main\nmain(['--version'])"
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, env=env, timeout=1200)
    assert done.returncode == 1 and done.stderr.startswith(b"Error: standard output: No space left on device")


def test_streams_that_are_closed_are_no_files(tmp_path: Path) -> None:
    """What is written to a closed stream goes nowhere, and never into the file that is opened next."""
    if os.name != "posix":
        pytest.skip("closes streams by a shell")
    code = "from srfcli.cli.main import main; main(['linear', '--over', 'V=8', '--json', '--out', 'a.json', '-v'])"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    for closed in (">&-", "2>&-", "<&- >&- 2>&-"):
        subprocess.run(["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, code], cwd=tmp_path, env=env, check=True)
        json.loads((tmp_path / "a.json").read_text())
        (tmp_path / "a.json").unlink()
        (tmp_path / "a.json.provenance.json").unlink()


def test_sigint_ends_with_130() -> None:
    code = (
        "import os, signal, time, click\nfrom srfcli.cli.main import cli, main\n"
        "@cli.command('wait')\ndef wait():\n    os.kill(os.getpid(), signal.SIGINT)\n    time.sleep(5)\n"
        "main(['wait'])"
    )
    done = python(code)
    assert done.returncode == 128 + signal.SIGINT and done.stderr.strip() == "Error: interrupted"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_is_for_terminals_only() -> None:
    shown, silent, quiet = Terminal(), io.StringIO(), Terminal()
    for stream, hush in ((shown, False), (silent, False), (quiet, True)):
        with Progress("boundary", total=3, stream=stream, quiet=hush) as progress:
            progress.advance(note="V = 1 um/s")
    assert "boundary: 1/3  V = 1 um/s" in shown.getvalue() and shown.getvalue().endswith("\r\x1b[K")
    assert silent.getvalue() == quiet.getvalue() == ""


def test_what_is_left_is_told_from_the_share_that_is_done() -> None:
    assert remaining(1.9, 0.5) == ""
    assert remaining(20.0, 0.25) == "  [about 60 s left]"
    assert remaining(20.0, None) == "  [20 s so far]"
    assert remaining(30.0, 0.5, most=True) == "  [30 s so far, at most 30 s more]"
    done = FitShare(starts=2)
    shares = [done.after(f"start {1 + k // 40} of 2: step") for k in range(80)]
    assert all(a <= b + 1e-12 for a, b in itertools.pairwise(shares))  # it never falls, and never is the whole
    assert 0 < shares[0] < 0.05 and shares[39] < 0.5 <= shares[40] and shares[-1] < 1


@pytest.mark.parametrize(("variable", "coloured"), [("", True), ("1", False)])
def test_no_color(monkeypatch: pytest.MonkeyPatch, variable: str, coloured: bool) -> None:
    from rich.console import Console

    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    if variable:
        monkeypatch.setenv("NO_COLOR", variable)
    stream = Terminal()
    monkeypatch.setattr(sys, "stdout", stream)
    emit_module.show(Table("s", (Column("x"),), [(1 / 3,)], title="t"))
    assert "0.333333" in stream.getvalue() and "0.33333333" not in stream.getvalue()
    assert not any(f"\x1b[{code}" in stream.getvalue() for code in ("3", "9"))  # emphasis may stay, colours may not
    assert Console(file=Terminal()).no_color != coloured


def test_precedence_and_origins(tmp_path: Path) -> None:
    toml = TomlSettings(tmp_path / "srf.toml", {"K": "400 N/mm", "M": 1, "V": 5, "other": 1.0})
    env = {"SRF_K": "0.3", "SRF_VSAT": "300", "SRF_SET": "V=6; K=0.35", "SRF_LAW": "x"}
    found = resolve(PARAMETERS, {"K": "0.5 N/um"}, env=env, toml=toml, where="srf-vsat")
    assert found.declared == {"K": 0.5, "V": 6.0, "M": 1.0, "Vsat": 300.0}
    assert found.values["M"] == pytest.approx(1e-6, rel=1e-15)
    assert [found.origins[n] for n in ("K", "V", "M", "Vsat")] == [
        "flag",
        "environment SRF_SET",
        str(toml.path),
        "environment SRF_VSAT",
    ]
    assert found.unused[0].endswith("other is not a parameter of srf-vsat. Known: K, M, V, Vsat")
    assert resolve(PARAMETERS, {}, env={"SRF_K": "0.3"}, toml=toml).declared["K"] == 0.3
    assert resolve(PARAMETERS, {}, env={}, toml=toml).declared["K"] == 0.4
    assert resolve(PARAMETERS, {}, env={}).origins["K"] == "law default"
    with pytest.raises(SrfError, match="is above its upper bound") as caught:
        resolve(PARAMETERS, {}, env={"SRF_K": "99"})
    assert caught.value.hint == "It was set by environment SRF_K."


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[parameter]\nK=1", "Did you mean 'parameters'?"),
        ("[defaults]\nlw='x'", "Did you mean 'law'?"),
        ("[defaults]\nplugins=['.']", "unknown setting"),  # a folder's srf.toml must not make its code run
        ("[parameters]\nK=true", "is not a number"),
        ("[parameters\nK=1", "not TOML"),
        ("parameters=1", "is not a table"),
        ("[defaults]\nlaw=3", "is not text"),
        ("[defaults]\ninertia='maybe'", "neither true nor false"),
    ],
)
def test_a_bad_settings_file_is_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "srf.toml").write_text(text)
    done = invoke("run")
    assert done.exit_code == 2 and said in done.stderr and "srf.toml" in done.stderr


def test_where_a_settings_file_is_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    deep = tmp_path / "outside" / "a" / "b"
    deep.mkdir(parents=True)
    (tmp_path / "outside" / "srf.toml").write_text("")
    assert find_toml(deep) is None  # a stranger's file above is no setting
    (tmp_path / "outside" / ".git").mkdir()
    assert find_toml(deep) == (tmp_path / "outside" / "srf.toml").resolve()
    (deep / "srf.toml").write_text("[parameters]\nK = 0.4\n")
    assert find_toml(deep) == (deep / "srf.toml").resolve() and load_toml(find_toml(deep)).parameters == {"K": 0.4}


def test_config_show_tells_every_origin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "srf.toml").write_text("[parameters]\nVsat = 300\n[defaults]\ninertia = false\n")
    monkeypatch.setenv("SRF_LAMBDA", "600 nm")
    done = invoke("config", "show", "--K", "0.3", "--json", tool=cli)
    rows = {row["name"]: row for row in json.loads(done.stdout)["rows"]}
    assert rows["K"]["value"] == 0.3 and rows["K"]["origin"] == "flag"
    assert rows["Vsat"]["value"] == 300 and rows["Vsat"]["origin"].endswith("srf.toml")
    assert rows["lambda"]["value"] == pytest.approx(0.6) and rows["lambda"]["origin"] == "environment SRF_LAMBDA"
    assert rows["inertia"]["value"] is False and "M" not in rows and rows["A"]["origin"] == "law default"
    assert rows["law"]["origin"] == "default" and rows["tol"]["value"] == settings.DEFAULTS["tol"].value


def test_options_repeat_what_the_system_says() -> None:
    from srfcli.symbolic.system import ANGLE, APPARATUS, LOADINGS, MASS

    assert options_module.LOADINGS == LOADINGS
    declared = {p.name: p for p in (*APPARATUS, MASS, ANGLE)}
    for name, text in options_module.APPARATUS_FLAGS.items():
        assert text.endswith(f", in {declared[name].unit}.")


@pytest.mark.parametrize(
    ("text", "points"),
    [
        ("V=1,2,5", [1.0, 2.0, 5.0]),
        ("V=7", [7.0]),
        ("V=1:100:3", [1.0, 10.0, 100.0]),
        ("V=1:100:3:log", [1.0, 10.0, 100.0]),
        ("V=1:101:3:lin", [1.0, 51.0, 101.0]),
        ("V=1:3:3", [1.0, 2.0, 3.0]),
        ("V=1:100 um/s:3", [1.0, 10.0, 100.0]),
        ("V=0.001:0.1 mm/s:3", [1.0, 10.0, 100.0]),
        ("V=1,2 mm/s", [1000.0, 2000.0]),
    ],
)
def test_ranges(text: str, points: list[float]) -> None:
    found = base_points(parse_over(text))
    assert found == pytest.approx(points, rel=1e-14) and len(found) == len(points)


def test_a_range_keeps_its_ends_and_has_sixty_points() -> None:
    made = parse_over("V=0.3:77")
    assert (made.points()[0], made.points()[-1], len(made.points()), made.spacing) == (0.3, 77.0, 60, "log")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("V", "is not a range"),
        ("=1:2", "is not a range"),
        ("V=1:x:3", "'x' is not a number"),
        ("V=1:nan:3", "'nan' is not a number"),
        ("V=1:2:1", "'1' is not a number of points"),
        ("V=1:2:1.5", "'1.5' is not a number of points"),
        ("V=1:2:99999999999999999999", "is not a number of points"),
        ("V=2:1:5", "low end 2 is not below"),
        ("V=0:1:5:log", "cannot reach 0"),
        ("V=1:2:5:cubic", "unknown spacing 'cubic'"),
        ("V=1:2:5:log:x", "5 fields"),
        ("V=1 mm/s:2 um/s", "mixes the units"),
        ("V=1,,2", "'' is not a number"),
    ],
)
def test_a_bad_range_is_one_sentence(text: str, said: str) -> None:
    with pytest.raises(SrfError) as caught:
        parse_over(text)
    assert said in caught.value.message and caught.value.hint


def test_lists_of_values() -> None:
    assert parse_values(["1,7,25"], SPEED) == (1.0, 7.0, 25.0)
    assert parse_values(["1,2 mm/s", "3"], SPEED) == (1000.0, 2000.0, 3.0)
    with pytest.raises(SrfError, match="V = 0 um/s is below"):
        parse_values(["1,0"], SPEED)
    with pytest.raises(SrfError, match="given twice"):
        parse_overs(["V=1,2", "V=3,4"])


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_tab_key_completes_commands_options_and_laws(shell: str) -> None:
    def completed(*words: str) -> str:
        here = words[-1] if shell == "fish" else str(len(words) - 1)
        line = " ".join(words[:-1] if shell == "fish" else words)
        asked = {"_SRF_COMPLETE": f"{shell}_complete", "COMP_WORDS": line, "COMP_CWORD": here}
        done = subprocess.run(
            [sys.executable, "-m", "srfcli"], env={**os.environ, **asked}, capture_output=True, text=True, cwd=ROOT
        )
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    assert "linear" in completed("srf", "lin")
    assert "--ageing" in completed("srf", "linear", "--ag")
    assert "dieterich-ruina" in completed("srf", "linear", "--law", "diet")
    source = subprocess.run(
        [sys.executable, "-m", "srfcli"],
        env={**os.environ, "_SRF_COMPLETE": f"{shell}_source"},
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert source.returncode == 0 and "srf" in source.stdout
