"""Files that would hang, fill the memory or break a parser: each is refused by an error of the project's own."""

from __future__ import annotations

import io
import os
import struct
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from sound_files import EXPERIMENT, SETTINGS, THRESHOLDS, recording

from srfcli.cli.main import cli
from srfcli.cli.options import parse_over
from srfcli.core.errors import SrfError
from srfcli.core.settings import load_toml, resolve
from srfcli.core.units import dimension, parse_quantity
from srfcli.data.columns import open_source
from srfcli.data.experiment import read_experiment
from srfcli.data.thresholds import read_thresholds
from srfcli.laws.expression import parse_expression
from srfcli.laws.law_file import read_header, template
from srfcli.laws.registry import bundled_registry, read_law, scan_python
from srfcli.tasks.simulate import read_pieces
from srfcli.validation.blind import Answer, read_answers, to_line

pytestmark = pytest.mark.usefixtures("empty_folder")

DATA = recording(200)


def srf(*arguments: str) -> Result:
    done = CliRunner().invoke(cli, arguments, prog_name="srf")
    assert "unexpected" not in done.stderr and done.exit_code in (0, 1, 2), done.stderr
    return done


def experiment(text: str = EXPERIMENT, data: bytes = DATA.encode()) -> Path:
    folder = Path("theirs")
    folder.mkdir(exist_ok=True)
    (folder / "experiment.toml").write_text(text, encoding="utf-8")
    (folder / "one.csv").write_bytes(data)
    return folder


# by kind, before they are opened


def fifo(place: Path) -> None:
    os.mkfifo(place)


def link_to_fifo(place: Path) -> None:
    os.mkfifo(place.with_suffix(".pipe"))
    place.symlink_to(place.with_suffix(".pipe").name)


def device(place: Path) -> None:
    place.symlink_to("/dev/zero")


def itself(place: Path) -> None:
    place.symlink_to(place.name)


KINDS: list[Callable[[Path], None]] = [fifo, link_to_fifo, device, itself, Path.mkdir]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no FIFOs here")
@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_what_is_no_file_is_not_opened(kind: Callable[[Path], None]) -> None:
    for name in ("x.toml", "y.py", "load.csv", "thresholds.csv", "srf.toml"):
        kind(Path(name))
    for command in (
        ["laws", "--plugins", "."], ["law", "show", "srf-vsat", "--plugins", "."], ["law", "check", "x.toml"],
        ["law", "check", "y.py"], ["linear", "--law", "x.toml"], ["linear", "--law", "y.py"], ["config", "show"],
        ["linear", "--over", "V=8", "--plugins", "."], ["fit", "thresholds.csv", "--free", "A"], ["check", "x.toml"],
        ["simulate", "--V", "8", "--W0", "5", "--for", "1", "--load-file", "load.csv"],
    ):  # fmt: skip
        done = srf(*command)
        assert done.exit_code == (0 if command[-1] in (".", "show") else 2) or kind in (device, itself), done.stderr
    assert "srf-vsat" in srf("laws", "--plugins", ".").stdout
    Path("srf.toml").unlink() if not Path("srf.toml").is_dir() or Path("srf.toml").is_symlink() else None
    folder = experiment()
    (folder / "one.csv").unlink()
    kind(folder / "one.csv")
    assert srf("check", str(folder), "--no-simulate").exit_code in (1, 2)
    (folder / "experiment.toml").unlink()
    kind(folder / "experiment.toml")
    assert srf("check", str(folder), "--no-simulate").exit_code in (1, 2)
    Path("kept").mkdir()
    kind(Path("kept/srf-run.json"))
    assert srf("map", "--eps", "0.1", "--resume", "kept").exit_code in (1, 2)


FOLDER = "no file {}, but a folder"
PIPE = "no file {}, but a FIFO"
DEVICE = "no file {}, but a device"
SYSTEM = "no file {}, but a part of the running system"
LINKED = "{}: cannot be read: Too many levels of symbolic links"
ABSENT = "no file {}"
SAID = {"pipe": PIPE, "zero": DEVICE, "memory": SYSTEM, "itself": LINKED, "folder": FOLDER, "absent": ABSENT}


@pytest.mark.skipif(sys.platform != "linux", reason="what lies in /proc and /dev is told of Linux")
@pytest.mark.parametrize("kind", SAID)
def test_what_is_no_law_file_is_told_by_its_kind(kind: str) -> None:
    for name in (f"{kind}.toml", f"{kind}.py"):
        if kind == "pipe":
            os.mkfifo(name)
        elif kind == "folder":
            Path(name).mkdir()
        elif kind != "absent":
            Path(name).symlink_to({"zero": "/dev/zero", "memory": "/proc/self/mem", "itself": name}[kind])
        for command in (["linear", "--law", name], ["law", "check", name], ["law", "show", name]):
            done = srf(*command)
            told = done.stderr + done.stdout
            assert done.exit_code == 2 and SAID[kind].format(name) in told, (command, told)
            assert told.count("Try: ") == 1 and "Traceback" not in told
    if kind in ("pipe", "zero", "memory"):
        done = srf("laws", "--plugins", f"{kind}.toml")
        assert done.exit_code == 2 and done.stdout == "" and SAID[kind].format(f"{kind}.toml") in done.stderr
        Path("laws").mkdir()
        Path("laws/a.toml").symlink_to(f"../{kind}.toml")
        done = srf("laws", "--plugins", "laws")
        told = f"Not listed (--plugins): {SAID[kind].format('laws/a.toml')}"
        assert done.exit_code == 0 and told in done.stderr and "srf-vsat" in done.stdout


NOT_OF_FILES = "/dev/zero", "/dev/null", "/dev/stdin", "/proc/self/environ", "/proc/cpuinfo"


@pytest.mark.skipif(sys.platform != "linux", reason="what lies in /proc and /dev is told of Linux")
@pytest.mark.parametrize("place", [*NOT_OF_FILES, "/dev", "/proc"])
def test_parts_of_the_system_are_no_input(place: str) -> None:
    for command in ("check", "fit", "diagnose", "new", "report", "linear --law", "linear --set", "law check"):
        done = srf(*command.split(), place)
        assert done.exit_code == 2 and done.stdout == "" and done.stderr.count("Error: ") == 1, (command, done.stderr)
        assert place in done.stderr
    done = srf("laws", "--plugins", place)
    if place in NOT_OF_FILES:
        assert done.exit_code == 2 and f"{place} is neither a folder nor a law's file" in done.stderr
    else:
        assert done.exit_code == 0 and f"Not listed (--plugins): {place} holds no law" in done.stderr


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_what_may_not_be_read_is_told() -> None:
    Path("closed").mkdir()
    for name in ("x.toml", "y.py", "closed/z.toml"):
        Path(name).write_text("")
        Path(name).chmod(0)
    for name in ("x.toml", "y.py"):
        for command in (["linear", "--law", name], ["law", "check", name], ["law", "show", name]):
            done = srf(*command)
            assert done.exit_code == 2 and f"{name}: cannot be read: Permission denied" in done.stderr + done.stdout
    done = srf("laws", "--plugins", "closed")
    assert done.exit_code == 0 and "closed/z.toml: cannot be read: Permission denied" in done.stderr
    Path("closed").chmod(0)
    try:
        done = CliRunner().invoke(cli, ["laws"], env={"SRF_PLUGINS": "closed", "SRF_DATA": "closed"}, prog_name="srf")
        assert done.exit_code == 0 and "Not listed (SRF_PLUGINS): closed: cannot be read" in done.stderr
        assert "Not listed (user): closed: cannot be read" in done.stderr and "srf-vsat" in done.stdout
    finally:
        Path("closed").chmod(0o700)


@pytest.mark.skipif(sys.platform != "linux", reason="the device is one of Linux")
def test_what_is_written_to_a_device_or_a_pipe() -> None:
    command = "linear", "--over", "V=8", "--csv"
    expected = srf(*command).stdout
    os.mkfifo("pipe")
    done = srf(*command, "--out", "pipe")
    assert done.exit_code == 1 and "pipe: nobody reads this pipe" in done.stderr
    reader = os.open("pipe", os.O_RDONLY | os.O_NONBLOCK)
    assert srf(*command, "--out", "pipe").exit_code == 0
    assert os.read(reader, 2**20).decode() == expected
    os.close(reader)
    assert srf(*command, "--out", "/dev/null").exit_code == 0
    done = srf(*command, "--out", "/dev/full")
    assert done.exit_code == 1 and "/dev/full cannot be written: No space left on device" in done.stderr


# sizes and numbers


@pytest.mark.parametrize(
    "command",
    [
        "map --eps 0.1 --over V=1:100:100000 --over K/W0=0.01:0.03:100000",
        "compare --law srf-vsat --law log-log --eps 0.1 --over V=1:100:100000 --over K/W0=0.01:0.03:100000",
        "linear --over V=1:100:100000 --over A=0.01:0.02:100000",
    ],
)
def test_grids_beyond_reason(command: str) -> None:
    done = srf(*command.split())
    assert done.exit_code == 2 and done.stdout == "", done.stderr
    assert "Error: a grid of 100000 x 100000 points has 1e+10\nTry: Ask for fewer: 1e+07 is the limit." in done.stderr


LONG = "9" * 5000
TOMLS = {
    "arrays in arrays": "a = " + "[" * 900 + "]" * 900,
    "arrays without end": "a = " + "[" * 100_000,
    "tables in tables": "a = " + "{b = " * 900 + "1" + "}" * 900,
    "a key of 100 kB": f"{'k' * 100_000} = 1",
    "a key of many parts": ".".join(["a"] * 50_000) + " = 1",
    "a quoted key of many parts": ".".join(['"a"'] * 50_000) + " = 1",
    "a header of many parts": "[" + ".".join(["a"] * 50_000) + "]",
    "a long number": f"a = {LONG}",
    "a long hexadecimal": f"a = 0x{'f' * 100_000}",
    "not UTF-8": "a = '\udcff'",
    "longer than any": "#" * 17 * 2**20,
}


@pytest.mark.parametrize("name", TOMLS)
def test_tables_beyond_reason(name: str) -> None:
    data = TOMLS[name].encode("utf-8", "surrogateescape")
    for place in ("x.toml", "srf.toml"):
        Path(place).write_bytes(data)
    assert srf("law", "check", "x.toml").exit_code == 2
    done = srf("config", "show")
    assert done.exit_code == 2 and len(done.stderr) < 5000
    Path("srf.toml").unlink()
    assert srf("laws", "--plugins", ".").exit_code == 0
    folder = experiment()
    (folder / "experiment.toml").write_bytes(data)
    done = srf("check", str(folder))
    assert done.exit_code == 2 and len(done.stderr) < 5000


CELLS = [
    "value = 0.33", "lower = 0.1", "upper = 1.0", "scale = 1.0", "offset = 0.0", "[0.0, 1.5", "velocity = 10.0",
    "duration = 1.0", "frequency = 12.0", "amplitude = 0.09", "onset = 2.0",
]  # fmt: skip
NUMBERS = ["9" * 400, "1e-320", "nan", "inf", "-inf", "1e308", "0x" + "f" * 500, "-0.0", "true", "[]"]


@pytest.mark.parametrize("number", NUMBERS, ids=lambda n: n[:8])
def test_numbers_beyond_reason(number: str) -> None:
    law = template("friction", "my-law", python=False)
    effect = template("effect", "my-effect", python=False)
    old = law.partition("default = ")[2].partition(",")[0]
    Path("law.toml").write_text(law.replace(f"default = {old}", f"default = {number}", 1))
    srf("law", "check", "law.toml")
    Path("bounds.toml").write_text(law.replace("unit =", f"lower = {number}, unit =", 1))
    srf("law", "check", "bounds.toml")
    Path("effect.toml").write_text(effect.replace("neutral = ", f"scan = {number} # ", 1))
    srf("law", "check", "effect.toml")
    for key, command in (("A", "config show"), ("D0", "config show"), ("K", "linear --over V=8")):
        Path("srf.toml").write_text(f"[parameters]\n{key} = {number}\n")
        srf(*command.split())
    Path("srf.toml").write_text(f"[defaults]\ntol = {number}\n")
    srf("config", "show")
    Path("srf.toml").unlink()
    for old in CELLS:
        name, equals, value = old.rpartition("= ")
        new = name + equals + value.replace(value.strip("[").split(",")[0], number, 1)
        srf("check", str(experiment(EXPERIMENT.replace(old, new, 1))), "--no-simulate")
    for text in (f"{number} N/um", f"{number} 1/um"):
        srf("check", str(experiment(EXPERIMENT.replace("0.21 N/um", text))), "--no-simulate")
    srf("linear", "--over", "V=8", "--set", f"D0={number}")
    srf("simulate", "--V", number, "--W0", "5", "--for", "1")


SLOW = [
    "1" * 100_000 + "\n x",
    "1" + " " * 100_000 + "\nx",
    "1 " + "um*" * 50_000,
    "1 kg^9*kg^9/m^9/m^9",
    "." * 100_000,
    "1 " + "x" * 100_000,
]


@pytest.mark.parametrize("text", SLOW, ids=range(len(SLOW)))
def test_quantities_beyond_reason(text: str) -> None:
    with pytest.raises(SrfError):
        parse_quantity(text, "um", name="D0")
    with pytest.raises(SrfError):
        dimension(text[2:])


@pytest.mark.parametrize(
    "data",
    [
        ("9" * 1_000_000 + "x\n").encode(),
        (DATA + "9" * 900_000 + "x,1,1,1\n").encode(),
        ("time [s]," + " " * 500_000 + "[" * 400_000 + "\n1,2\n").encode(),
        ("a," * 200_000 + "\n" + "1," * 200_000 + "\n").encode(),
        DATA.replace("0.5,", "1e-320,", 1).encode(),
        DATA.replace("0.5,", f"{LONG},", 1).encode(),
        b"\x00" * 5000,
    ],
    ids=["one number", "a cell", "a heading", "columns", "subnormal", "digits", "zeros"],
)
def test_data_beyond_reason(data: bytes) -> None:
    srf("check", str(experiment(data=data)), "--no-simulate")
    Path("thresholds.csv").write_bytes(b"V,eps,W0c\n" + data)
    srf("fit", "thresholds.csv", "--free", "A")


def matlab(rows: int, columns: int, name: bytes = b"data") -> bytes:
    """A MATLAB 5 file whose header claims a matrix of this shape, and which ends there."""
    matrix = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, rows, columns)
    matrix += struct.pack("<II", 1, len(name)) + name.ljust(8, b"\0")[:8] + struct.pack("<II", 9, 0)
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 14, len(matrix)) + matrix


def npz(header: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("time.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    return buffer.getvalue()


CLAIMS = {
    "columns": ("one.mat", matlab(100, 2**30)),
    "rows": ("one.mat", matlab(2**30, 2)),
    "negative": ("one.mat", matlab(-5, 3)),
    "array": ("one.npz", npz(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1152921504606846976,), }\n")),
    "nested": ("one.npz", npz(b"(" * 5000)),
    "objects": ("one.npz", npz(b"{'descr': '|O', 'fortran_order': False, 'shape': (5,), }\n")),
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_headers_that_claim_too_much(claim: str) -> None:
    name, data = CLAIMS[claim]
    folder = experiment(EXPERIMENT.replace("one.csv", name))
    (folder / name).write_bytes(data)
    assert srf("check", str(folder), "--no-simulate").exit_code == 2


def test_answers_that_are_no_text() -> None:
    place = Path("answers.jsonl")
    whole = to_line(Answer("case-000", "none")).encode()
    for data in (
        whole.replace(b'"effects": []', b'"effects": 0'),
        whole.replace(b'"equivalent": []', b'"equivalent": [1]'),
        b"\xff\xfe\n",
        b"[" * 100_000 + b"\n",
        LONG.encode() + b"\n",
        b"{}\n",
        b"null\n",
    ):
        place.write_bytes(data)
        with pytest.raises(SrfError):
            read_answers(place)


# any input: a value or an error of the project's own


QUICK = settings(
    max_examples=40, deadline=None, derandomize=True, database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)  # fmt: skip
SIGNS = [b"", b"[", b"]", b'"', b"1e999", b"nan", b"-1", b"\n", b"{", b"=", LONG.encode()]
ANY = st.text(max_size=60)


@st.composite
def mutated(draw: st.DrawFn, whole: bytes) -> bytes:
    """A sound file with some stretches cut out, doubled, or replaced by anything."""
    data = whole
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(data)))
        end = min(at + draw(st.integers(0, 12)), len(data))
        new = draw(
            st.one_of(
                st.binary(max_size=8),
                st.sampled_from([b"", b"[", b"]", b'"', b"1e999", b"nan", b"-1", b"\n", b"{", b"=", LONG.encode()]),
                st.just(data[at:end] * 2),
            )
        )
        data = data[:at] + new + data[end:]
    return data


def sound(read: Callable[[Path], object], data: bytes, name: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / name
        place.write_bytes(data)
        try:
            read(place)
        except SrfError as error:
            assert error.message and len(error.message) < 5000


def whole_source(place: Path) -> None:
    source = open_source(place, registry=bundled_registry())
    for block in source.blocks(tuple(range(len(source.headings)))):
        assert block is not None


@QUICK
@given(mutated(template("friction", "my-law", python=False).encode()))
def test_any_law(data: bytes) -> None:
    sound(read_header, data, "x.toml")
    sound(read_law, data, "x.toml")


@QUICK
@given(mutated(template("effect", "my-effect", python=False).encode()))
def test_any_effect(data: bytes) -> None:
    sound(read_law, data, "x.toml")


@QUICK
@given(mutated(template("friction", "my-law", python=True).encode()))
def test_any_python_file(data: bytes) -> None:
    sound(scan_python, data, "x.py")


@QUICK
@given(mutated(EXPERIMENT.encode()))
def test_any_experiment(data: bytes) -> None:
    Path("one.csv").write_text(DATA)

    def read(place: Path) -> None:
        (place.parent / "one.csv").write_text(DATA)
        read_experiment(place, registry=bundled_registry())

    sound(read, data, "experiment.toml")


@QUICK
@given(mutated(SETTINGS.encode()))
def test_any_settings(data: bytes) -> None:
    law = bundled_registry().get("friction", "srf-vsat")
    sound(lambda place: resolve(law.parameters, {}, env={}, toml=load_toml(place)), data, "srf.toml")


@QUICK
@given(mutated(THRESHOLDS.encode()))
def test_any_thresholds(data: bytes) -> None:
    sound(read_thresholds, data, "t.csv")


def archive() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, time=np.arange(5.0), units=np.array(["s", "um"]), elongation=np.arange(5.0))
    return buffer.getvalue()


@QUICK
@given(st.one_of(mutated(DATA[:400].encode()), mutated(archive()), mutated(matlab(5, 3)), st.binary(max_size=200)))
def test_any_data_file(data: bytes) -> None:
    for name in ("a.csv", "a.mat", "a.npz", "a"):
        sound(whole_source, data, name)


@settings(QUICK, max_examples=150)
@example("1e-320").via("reported")
@given(st.one_of(ANY, st.from_regex(r"[-+]?\d{0,30}\.?\d{0,30}([eE][-+]?\d{1,5})? ?[a-zA-Z*/^0-9]{0,12}", fullmatch=True)))
def test_any_number(text: str) -> None:
    for parse in (
        lambda: parse_quantity(text, "N/um", name="K"),
        lambda: dimension(text),
        lambda: parse_over(text),
        lambda: parse_over(f"V={text}"),
        lambda: read_pieces(text, "um/s", name="drive", example="1:5"),
        lambda: read_pieces(f"1:{text}", "um/s", name="drive", example="1:5"),
    ):
        try:
            parse()
        except SrfError as error:
            assert error.message


@settings(QUICK, max_examples=150)
@given(st.one_of(ANY, st.text(alphabet="0123456789.e+-*/()^ vpexlogA", max_size=40)))
def test_any_formula(text: str) -> None:
    try:
        parse_expression(text, ("v", "phi", "A"))
    except SrfError as error:
        assert error.message
