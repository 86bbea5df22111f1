"""What a file may have run: nothing that the person at the keyboard has not named, installed or trusted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from srfcli.cli.main import cli
from srfcli.laws.law_file import template

CODE = "from pathlib import Path\nPath(__file__).with_name('ran').write_text('')\n"
DATA = "time [s],load_point_velocity [um/s],normal_load [N],elongation [um]\n"
DATA += "".join(f"{i / 100},10.0,5.0,{10 + 0.01 * (i % 7)}\n" for i in range(200))
EXPERIMENT = """format = "srf-experiment/1"
[apparatus]
stiffness = "0.21 N/um"
mass = "2.37 kg"
[model]
law = "{law}"
ageing = "{ageing}"
interface = "{interface}"
effects = [{effects}]
[parameters]
mu0 = {{ value = 0.33 }}
[[runs]]
name = "one"
file = "one.csv"
"""
PLAIN = {"law": "srf-vsat", "ageing": "dieterich", "interface": "elastic", "effects": ""}

pytestmark = pytest.mark.usefixtures("empty_folder")


def srf(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments, prog_name="srf")


def experiment(**changed: str) -> Path:
    """A stranger's experiment in the current folder, with a Python file beside it that says when it was run."""
    folder = Path("theirs")
    folder.mkdir()
    (folder / "experiment.toml").write_text(EXPERIMENT.format(**(PLAIN | changed)))
    (folder / "one.csv").write_text(DATA)
    (folder / "x.py").write_text(CODE)
    return folder


def refused(done: Result, said: str) -> None:
    assert done.exit_code == 2, done.output
    assert said in done.stderr and "Python code" in done.stderr and "--trust" in done.stderr
    assert not list(Path.cwd().rglob("ran"))


NAMED = [
    ("model.law", {"law": "x.py"}),
    ("model.ageing", {"ageing": "x.py"}),
    ("model.ageing", {"ageing": "dieterich+x.py"}),
    ("model.interface", {"interface": "./x.py"}),
    ("model.effects[0]", {"effects": '"../theirs/x.py"'}),
]


@pytest.mark.parametrize("command", ["check", "fit", "diagnose", "simulate"])
@pytest.mark.parametrize(("place", "changed"), NAMED)
def test_an_experiment_runs_no_python(command: str, place: str, changed: dict[str, str]) -> None:
    done = srf(command, str(experiment(**changed)))
    refused(done, place)
    assert "experiment.toml, line " in done.stderr


def test_nor_by_an_absolute_path_or_a_link() -> None:
    folder = experiment()
    (folder / "y.py").symlink_to("x.py")
    for name in (str((folder / "x.py").resolve()), "y.py"):
        (folder / "experiment.toml").write_text(EXPERIMENT.format(**(PLAIN | {"law": name})))
        refused(srf("check", str(folder)), "model.law")


COMMANDS = [
    "linear", "derive", "code", "config show", "critical --eps 0.1 --V 8", "floquet --V 8 --W0 9 --eps 0.09",
    "continue --eps 0.09", "map --eps 0.09", "response --V 8 --W0 9", "simulate --V 8 --W0 6 --for 1",
]  # fmt: skip


LAW, OTHERS = 'law = "x.py"', ['ageing = "dieterich+x.py"', 'interface = "./x.py"']


@pytest.mark.parametrize(("command", "line"), [*((c, LAW) for c in COMMANDS), *((c, o) for c in COMMANDS[:2] for o in OTHERS)])
def test_settings_run_no_python(command: str, line: str) -> None:
    Path("srf.toml").write_text(f"[defaults]\n{line}\n")
    Path("x.py").write_text(CODE)
    refused(srf(*command.split()), "srf.toml: [defaults]")


@pytest.mark.parametrize(
    ("line", "given"),
    [
        ('law = "x.py"', ("--ageing", "dieterich", "--ageing", "ruina")),
        ('ageing = "x.py"', ("--law", "srf-vsat", "--law", "log-log")),
        ('interface = "x.py"', ("--law", "srf-vsat", "--law", "log-log")),
    ],
)
def test_settings_run_no_python_in_a_comparison(line: str, given: tuple[str, ...]) -> None:
    Path("srf.toml").write_text(f"[defaults]\n{line}\n")
    Path("x.py").write_text(CODE)
    refused(srf("compare", "--eps", "0.1", *given), "srf.toml: [defaults]")


def test_settings_above_the_folder_count_no_more() -> None:
    Path(".git").mkdir()
    Path("srf.toml").write_text('[defaults]\nlaw = "x.py"\n')
    below = Path("below")
    below.mkdir()
    os.chdir(below)
    Path("x.py").write_text(CODE)
    refused(srf("linear"), "srf.toml: [defaults]")


def test_a_law_file_of_theirs_runs_no_python() -> None:
    text = template("effect", "my-effect", python=False)
    text = text.replace("[parameters", 'settings = { interface = "x.py" }\n[parameters', 1)
    Path("my-effect.toml").write_text(text)
    Path("x.py").write_text(CODE)
    done = srf("law", "check", "my-effect.toml")
    assert done.exit_code == 2 and not Path("ran").exists()


def own_law(folder: Path) -> None:
    (folder / "my-law.py").write_text(template("friction", "my-law", python=True))


def test_what_is_named_or_trusted_runs() -> None:
    own_law(Path())
    assert srf("config", "show", "--law", "./my-law.py").exit_code == 0
    assert srf("config", "show", "--law", "my-law", "--plugins", ".").exit_code == 0
    Path("srf.toml").write_text('[defaults]\nlaw = "my-law.py"\n')
    refused(srf("linear"), "srf.toml: [defaults] law: 'my-law.py'")
    assert srf("config", "show", "--trust").exit_code == srf("--trust", "config", "show").exit_code == 0
    assert srf("config", "show", "--law", "srf-vsat").exit_code == 0  # what stands in the file does not count then
    Path("srf.toml").unlink()
    assert CliRunner(env={"SRF_LAW": "my-law.py"}).invoke(cli, ["linear", "--over", "V=8"]).exit_code == 0


def test_an_experiment_with_a_trusted_law_is_read() -> None:
    folder = experiment(law="my-law.py")
    own_law(folder)
    refused(srf("check", str(folder), "--no-simulate"), "model.law")
    for given in (("--trust",), ("--plugins", str(folder))):
        done = srf("check", str(folder), "--no-simulate", *given)
        assert done.exit_code == 0, done.stderr


def process(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run srf as a process of its own, from outside the current folder, as its console script does."""
    start = "import sys; sys.path[:] = [p for p in sys.path if p]; from srfcli.cli.main import main; main(sys.argv[1:])"
    return subprocess.run(
        [sys.executable, "-P", "-c", start, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )


def test_the_current_folder_is_no_place_to_import_from() -> None:
    for module in ("multiprocessing", "pickle", "signal", "socket", "srfcli", "numpy", "sympy", "matplotlib"):
        Path(f"{module}.py").write_text(CODE)
    grid = ("--over", "V=1:100:2", "--over", "K/W0=0.002:0.03:2")
    done = process("map", "--eps", "0.09", *grid, "--workers", "2")
    assert done.returncode == 0, done.stderr
    assert not Path("ran").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no FIFOs here")
def test_a_stranger_s_matplotlibrc_is_not_read() -> None:
    pytest.importorskip("matplotlib")
    os.mkfifo("matplotlibrc")  # a read would wait for ever
    done = process("linear", "--plot", "a.svg")
    assert done.returncode == 0 and Path("a.svg").stat().st_size > 1000, done.stderr


def test_a_compiler_in_python_is_not_taken_from_the_current_folder() -> None:
    own = Path("site")
    own.mkdir()
    (own / "wrapped.py").write_text("import sys\nsys.exit('error: this one was asked')\n")
    Path("wrapped.py").write_text(CODE)
    done = process(
        "simulate", "--V", "8", "--W0", "6", "--for", "1", "--rate", "10", "--interface", "rigid", "--no-inertia",
        SRF_CC=f"{sys.executable} -m wrapped", SRF_CACHE="", PYTHONPATH=str(own.resolve()),
    )  # fmt: skip
    assert done.returncode == 2 and "this one was asked" in done.stderr
    assert not Path("ran").exists()


def test_a_law_of_the_settings_lies_beside_them() -> None:
    """A relative name is as seen from srf.toml, wherever below it one works."""
    Path("srf.toml").write_text('[defaults]\nlaw = "laws/own.toml"\nageing = "dieterich"\n')
    Path(".git").mkdir()
    Path("laws").mkdir()
    text = template("friction", "own", python=False)
    Path("laws/own.toml").write_text(text)
    below = Path("below")
    (below / "laws").mkdir(parents=True)
    (below / "laws" / "own.toml").write_text("another one, which is none")
    here = srf("linear", "--over", "V=8", "--csv")
    os.chdir(below)
    there = srf("linear", "--over", "V=8", "--csv")
    assert here.exit_code == 0 and there.stdout == here.stdout, there.stderr
    Path("../srf.toml").write_text('[defaults]\nlaw = "x.py"\n')
    Path("../x.py").write_text(CODE)
    refused(srf("linear"), "srf.toml: [defaults]")
