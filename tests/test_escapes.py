"""Attempts to have the reader's terminal do something: names, headings, values and paths that hold its control characters."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import unicodedata
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from srfcli.cli.main import cli
from srfcli.core.errors import SrfError, printable

# title and clipboard of the terminal, clear screen, C1 control, overwritten line, rubbed out, turned round, unseen, no text
EVIL = "\x1b]0;p\x07\x1b]52;c;cnVu\x07\x1b[2J\x9b31m\rgone\x08\x7f\u202egpj\u2066\u200b"
ESCAPED = "".join(c if c.isascii() and c.isprintable() else f"\\u{ord(c):04x}" for c in EVIL)  # as TOML may hold it

pytestmark = pytest.mark.usefixtures("empty_folder")


def acting(text: str) -> list[str]:
    """The characters of a text that a terminal acts on or does not show."""
    return [c for c in text if c not in "\n\t" and unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")]


def srf(*arguments: str, **environment: str) -> Result:
    done = CliRunner().invoke(cli, arguments, prog_name="srf", env=environment)
    assert acting(done.stdout) == acting(done.stderr) == [], ascii(done.output)
    assert not isinstance(done.exception, Exception) or isinstance(done.exception, SystemExit)
    assert "unexpected" not in done.stderr
    return done


LAW = """format = "srf-law/1"
kind = "friction"
name = "{name}"
about = "{about}"
cites = ["{about}"]
mu = "{mu}"
[parameters]
mu0 = {{ default = 0.33, about = "{about}" }}
A = {{ default = 0.0126, unit = "{unit}" }}
B = {{ default = 0.0241 }}
D0 = {{ default = 0.402, unit = "um" }}
V0 = {{ default = 1.0, unit = "um/s" }}
{more}
"""
SOUND = {"name": "their-law", "about": "", "unit": "1", "more": "", "mu": "mu0 + A*log(v/V0) + B*log(1 + V0*phi/D0)"}
DATA = "time [s],load_point_velocity [um/s],normal_load [N],elongation [um]\n"
DATA += "".join(f"{i / 100},10.0,5.0,{10 + 0.01 * (i % 7)}\n" for i in range(200))
EXPERIMENT = """format = "srf-experiment/1"
title = "{title}"
[apparatus]
stiffness = "{stiffness}"
[model]
law = "{law}"
ageing = "dieterich"
{model}
[parameters]
{parameters}
[columns]
{columns}
[[runs]]
name = "{run}"
file = "{file}"
{more}
"""
PLAIN = {
    "title": "t", "stiffness": "0.21 N/um", "law": "srf-vsat", "model": "", "parameters": "", "columns": "",
    "run": "one", "file": "one.csv", "more": "",
}  # fmt: skip


def law(**changed: str) -> str:
    Path("theirs.toml").write_text(LAW.format(**(SOUND | changed)), encoding="utf-8")
    return "theirs.toml"


def experiment(data: str = DATA, **changed: str) -> str:
    folder = Path("theirs")
    folder.mkdir(exist_ok=True)
    (folder / "experiment.toml").write_text(EXPERIMENT.format(**(PLAIN | changed)), encoding="utf-8")
    (folder / "one.csv").write_bytes(data.encode("utf-8", "surrogatepass"))
    return "theirs"


@pytest.mark.parametrize("key", ["name", "about", "unit", "mu", "more"])
def test_of_laws(key: str) -> None:
    path = law(**{key: f'"{ESCAPED}" = 1' if key == "more" else ESCAPED})
    for command in (["law", "show", path], ["law", "show", path, "--json"], ["law", "check", path]):
        srf(*command)
    for more in ([], ["--json"]):
        done = srf("laws", "--plugins", ".", *more)
        assert key != "about" or "\\x1b]0;p" in done.stdout or "\\u001b]0;p" in done.stdout
    srf("derive", "--law", path)


@pytest.mark.parametrize(
    "changed",
    [
        {"title": ESCAPED},
        {"run": ESCAPED},
        {"file": ESCAPED},
        {"law": ESCAPED},
        {"law": f"{ESCAPED}.toml"},
        {"law": f"{ESCAPED}.py"},
        {"stiffness": ESCAPED},
        {"stiffness": f"1 {ESCAPED}"},
        {"model": f'"{ESCAPED}" = 1'},
        {"model": f'effects = ["{ESCAPED}"]'},
        {"parameters": f'"{ESCAPED}" = 1'},
        {"parameters": f'mu0 = {{ value = "{ESCAPED}" }}'},
        {"columns": f'time = "{ESCAPED}"'},
        {"columns": f'time = {{ name = "time [s]", unit = "{ESCAPED}" }}'},
        {"more": f'format = "{ESCAPED}"'},
        {"more": f'initial = "{ESCAPED}"'},
        {"more": f'"{ESCAPED}" = {{}}'},
    ],
    ids=lambda c: str(next(iter(c.items()))).replace("\\", "")[:24],
)
def test_of_experiments(changed: dict[str, str]) -> None:
    folder = experiment(**changed)
    done = srf("check", folder, "--no-simulate")
    srf("check", folder, "--no-simulate", "--json")
    if done.exit_code == 0:
        srf("check", folder, "--no-simulate", "--plot", "a.svg", "--out", "a.csv")
        assert not acting(Path("a.csv").read_text(encoding="utf-8"))
        assert not acting(Path("a.svg").read_text(encoding="utf-8").replace("\r", ""))
        assert not acting(Path("a.csv.provenance.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "data",
    [
        DATA.replace("elongation", f"elongation{EVIL}"),
        DATA.replace("time", EVIL.replace("\r", "")),
        DATA.replace("[um]", f"[{EVIL}]"),
        DATA.replace("0.5,10.0", f"0.5,{EVIL}"),
        EVIL,
    ],
    ids=["heading", "first heading", "unit", "cell", "all"],
)
def test_of_data_files(data: str) -> None:
    srf("check", experiment(data), "--no-simulate")
    Path("load.csv").write_text(data, encoding="utf-8")
    srf("simulate", "--V", "8", "--load-file", "load.csv", "--for", "0.1")


def test_of_archives() -> None:
    import numpy as np
    from scipy.io import savemat

    experiment()
    np.savez("theirs/one.npz", **{EVIL.replace("\x08", ""): np.arange(3.0)})
    savemat("theirs/one.mat", {"time": np.arange(3.0)})
    raw = Path("theirs/one.mat").read_bytes()
    Path("theirs/two.mat").write_bytes(raw.replace(b"time", b"\x1b[2J").replace(b"MATLAB 5.0", b"MATLAB \x1b[m"))
    for name in ("one.npz", "one.mat", "two.mat"):
        experiment(file=name)
        assert srf("check", "theirs", "--no-simulate").exit_code == 2


@pytest.mark.parametrize(
    "key", ["[defaults]\nlaw = {}", "[defaults]\n{} = 1", "[parameters]\n{} = 1", "[parameters]\nA = {}", "{}"]
)
def test_of_settings(key: str) -> None:
    Path("srf.toml").write_text(key.format(f'"{ESCAPED}"'), encoding="utf-8")
    srf("config", "show")
    srf("linear", "--over", "V=8")


OWN = [
    ("linear", "--set", f"{EVIL}=1"), ("linear", "--set", f"A={EVIL}"), ("linear", "--set", EVIL),
    ("linear", "--over", EVIL), ("linear", "--over", f"V={EVIL}"), ("linear", "--law", EVIL), ("linear", "--K", EVIL),
    ("linear", "--law", f"{EVIL}.toml"), ("linear", f"--{EVIL}"), ("linear", "--plugins", EVIL), (EVIL,), ("law", EVIL),
    ("linear", "--out", f"{EVIL}/a.csv"), ("linear", "--plot", EVIL), ("check", EVIL), ("fit", EVIL), ("diagnose", EVIL),
    ("simulate", "--drive", EVIL), ("simulate", "--V", "8", "--load-file", EVIL), ("linear", "--debug", "--law", EVIL),
    ("critical", "--eps", EVIL, "--V", "1"), ("map", "--eps", "0.1", "--resume", f"/dev/null/{EVIL}"), ("law", "new", EVIL),
    ("simulate", "--start", EVIL), ("compare", "--law", EVIL, "--law", "a"),
]  # fmt: skip


@pytest.mark.parametrize("arguments", OWN, ids=lambda a: " ".join(a).replace(EVIL, "EVIL"))
def test_of_arguments_that_were_pasted(arguments: tuple[str, ...]) -> None:
    assert srf(*arguments).exit_code != 0


@pytest.mark.parametrize("name", ["SRF_SET", "SRF_LAW", "SRF_TOL", "SRF_A", "SRF_INERTIA", "SRF_PLUGINS", "SRF_CACHE"])
def test_of_the_environment(name: str) -> None:
    srf("linear", "--over", "V=8", **{name: EVIL.replace("\x1b]0", "/tmp/no\x1b]0") if name == "SRF_CACHE" else EVIL})


def test_of_paths_and_links() -> None:
    folder = Path(EVIL.replace("/", ""))
    folder.mkdir()
    (folder / "their-law.toml").write_text(LAW.format(**SOUND), encoding="utf-8")
    (folder / "broken.toml").write_text("x")
    (folder / f"{EVIL}.toml").symlink_to("nowhere")
    (folder / f"{EVIL}.py").write_text("from srfcli.laws.api import friction_law")
    for more in ([], ["--json"]):
        srf("laws", "--plugins", str(folder), *more)
    srf("law", "show", "their-law", "--plugins", str(folder))
    done = srf("linear", "--over", "V=8", "--out", str(folder / "a.json"))
    assert done.exit_code == 0 and "Wrote" in done.stderr
    side = (folder / "a.json.provenance.json").read_text(encoding="utf-8")
    assert not acting(side) and json.loads(side)["arguments"][-1] == str(folder / "a.json")
    srf("check", str(folder))
    srf("fit", str(folder / "a.json"))


def test_of_names_that_are_no_text() -> None:
    name = os.fsdecode(b"\xff\x9b.csv")
    assert srf("linear", "--over", "V=8", "--out", name).exit_code == 0
    assert srf("linear", "--over", "V=8", "--out", name).exit_code == 2
    assert json.loads(Path(f"{name}.provenance.json").read_text())["file"] == name


@pytest.mark.parametrize("text", [f"V,eps,{EVIL}\n1,0,8\n", f"V,eps,W0c\n1,{EVIL},8\n", f"V,eps,W0c [{EVIL}]\n1,0,8\n"])
def test_of_results_read_back(text: str) -> None:
    Path("thresholds.csv").write_text(text, encoding="utf-8", newline="")
    assert srf("fit", "thresholds.csv", "--free", "A").exit_code == 2
    Path("kept").mkdir()
    Path("kept/srf-run.json").write_text(json.dumps({"schema": EVIL}))
    assert srf("map", "--eps", "0.1", "--resume", "kept").exit_code == 2
    Path("found").mkdir()
    Path("found/answer.json").write_text(json.dumps({"schema": EVIL}))
    assert srf("diagnose", experiment(), "--out", "found").exit_code == 2


def test_a_terminal_gets_the_colours_and_nothing_else() -> None:
    pty = pytest.importorskip("pty")
    law(about=ESCAPED)
    ours, theirs = pty.openpty()
    start = "from srfcli.cli.main import main; main(['laws', '--kind', 'friction', '--plugins', '.'])"
    with subprocess.Popen(
        [sys.executable, "-c", start],
        stdout=theirs,
        stderr=theirs,
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "400"},
    ) as process:
        os.close(theirs)
        shown = b""
        while True:
            try:
                part = os.read(ours, 65536)
            except OSError:  # the end of a terminal
                break
            if not part:
                break
            shown += part
        assert process.wait() == 0
    os.close(ours)
    text = re.sub("\x1b\\[[0-9;]*m", "", shown.decode().replace("\r\n", "\n"))
    assert "\x1b[" in shown.decode() and "their-law" in text and "\\x1b]0;p" in text
    assert acting(text) == []


def test_errors_are_printable_where_they_are_made() -> None:
    error = SrfError(EVIL, EVIL)
    assert acting(str(error)) == acting(str(error.hint)) == []


@pytest.mark.parametrize("plain", ["", "µ = 1 ± 2 °, Ω", "naïve\tline\n", "日本語", "a\u00a0b"])
def test_what_is_text_stays(plain: str) -> None:
    make: Callable[[str], str] = printable
    assert make(plain) == plain
