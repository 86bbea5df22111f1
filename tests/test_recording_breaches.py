"""Every breach of srf-experiment/1 ends with exit code 2, one line that names the place and what was found, and a way out."""

from __future__ import annotations

import io
import os
import re
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tomli
from click.testing import CliRunner
from recording_cases import TOML, data, write

from srfcli.cli.main import cli
from srfcli.core.errors import SrfError
from srfcli.data.description import ROLES
from srfcli.data.experiment import read_experiment
from srfcli.laws.registry import Registry, load_registry

TABLE = Path(__file__).with_name("recording_breaches.toml")
BREACHES = [row for rows in tomli.loads(TABLE.read_text(encoding="utf-8")).values() for row in rows]


@pytest.fixture(scope="module")
def registry() -> Registry:
    return load_registry(user=False)


def answer(folder: Path, registry: Registry) -> tuple[str, str]:
    """Return message and hint of the error that reading a broken experiment raises, without the folder's name."""
    with pytest.raises(SrfError) as caught:
        read_experiment(folder, registry=registry)
    assert caught.value.exit_code == 2 and "\n" not in caught.value.message
    return tuple(text.replace(f"{folder}/", "") for text in (caught.value.message, caught.value.hint or ""))


def printed(folder: Path, *options: str, code: int = 2) -> tuple[str, str]:
    """Return message and hint as `srf check` prints them, in a line each, without the folder's name."""
    done = CliRunner().invoke(cli, ["check", str(folder), *options], prog_name="srf")
    assert done.exit_code == code, done.output
    assert "Traceback" not in done.stderr and done.stdout == ""
    message, *rest = done.stderr.replace(f"{folder}/", "").splitlines()
    assert message.startswith("Error: ") and len(rest) <= 1, done.stderr
    return message.removeprefix("Error: "), rest[0].removeprefix("Try: ") if rest else ""


@pytest.mark.parametrize(("old", "new", "where", "found", "way_out"), BREACHES, ids=range(len(BREACHES)))
def test_a_breach_of_the_description(
    old: str, new: str, where: str, found: str, way_out: str, tmp_path: Path, registry: Registry
) -> None:
    assert TOML.count(old) >= 1
    message, hint = answer(write(tmp_path, toml=TOML.replace(old, new, 1)), registry)
    assert message.startswith(f"{where}: {found}"), message
    assert hint.startswith(way_out), hint
    assert way_out or "expected" in found  # what instead


def test_every_key_of_the_format_has_a_breach() -> None:
    """Of the keys in docs/recordings.md's example each is answered for a wrong value, and each table for an unknown key."""
    places = {row[2].rpartition(": ")[2].rpartition(".")[2].split("[")[0] for row in BREACHES}
    keys = {"format", "title", "stiffness", "mass", "law", "ageing", "interface", "inertia", "value", "lower", "upper"}
    keys |= {"fixed", "name", "unit", "scale", "offset", "integrate", "file", "holdout", "window", "drive", "duration"}
    keys |= {"velocity", "start", "load", "modulation", "frequency", "amplitude", "onset", "phase", "rise", "initial"}
    assert keys <= places, keys - places
    strange = [re.split(r"[.\[]", row[2].rpartition(": ")[2]) for row in BREACHES if row[3] == "unknown key"]
    tables = {parts[0] if len(parts) > 1 else "" for parts in strange}
    assert tables == {"", "apparatus", "model", "parameters", "columns", "runs"}


def test_the_description_as_it_stands_is_read(tmp_path: Path, registry: Registry) -> None:
    """What the breaches break is whole: none of them is answered for another reason."""
    found = read_experiment(write(tmp_path), registry=registry)
    assert [run.name for run in found.runs] == ["one", "two"] and not any(run.notices for run in found.runs)


# the data files

Lines = list[str]


def cell(row: int, column: int, text: str) -> Lines:
    lines = data()
    cells = lines[row].split(",")
    cells[column] = text
    lines[row] = ",".join(cells)
    return lines


def column(k: int, text: str) -> Lines:
    """Return the data with all cells of a column replaced."""
    return [data()[0], *(",".join([*c[:k], text, *c[k + 1 :]]) for c in (line.split(",") for line in data()[1:]))]


def without(k: int) -> Lines:
    return [",".join(c[:k] + c[k + 1 :]) for c in (line.split(",") for line in data())]


def headed(old: str, new: str) -> Lines:
    return [data()[0].replace(old, new), *data()[1:]]


def clock(of: Callable[[int], float]) -> Lines:
    return [data()[0], *(f"{of(i):g},{line.partition(',')[2]}" for i, line in enumerate(data()[1:]))]


DATA = {
    "text": (cell(50, 3, "abc"), "one.csv, line 51, column 'spring': found 'abc', expected a number", "Leave a missing"),
    "decimal comma": (cell(50, 3, '"9,5"'), "one.csv, line 51, column 'spring': found '9,5', a decimal comma", "Write a"),
    "decimal commas": ([line.replace(".", ",") for line in data()], "one.csv, line 2: found 5 cells, expected 4", "The c"),
    "a cell less": ([*data()[:50], "1,2,3"], "one.csv, line 51: found 3 cells, expected 4", "The columns are: time [s],"),
    "a cell more": ([*data()[:50], "1,2,3,4,5"], "one.csv, line 51: found 5 cells, expected 4", "The columns are: time"),
    "open quote": (cell(50, 3, '"9.5'), "one.csv, line 51: unexpected end of data", "Close every quote on its own line."),
    "empty": (b"", "one.csv: the file is empty", "A recording has a line of headings and a line for each sample."),
    "blank lines": (b"\n \n\n", "one.csv: no reader knows this kind of file", 'Name one with format = "...": csv, '),
    "bytes": (bytes(range(256)) * 20, "one.csv: no reader knows this kind of file", 'Name one with format = "...": csv'),
    "UTF-16": ("\n".join(data()).encode("utf-16"), "one.csv: UTF-16 text", "Save the file as UTF-8."),
    "one long line": ([data()[0], "1" * (2**20 + 9)], "one.csv, line 2: longer than 1048576 bytes: not a table of col", ""),
    "headings alone": (data()[:1], "one.csv: no samples", "A recording needs a line of numbers for each sample."),
    "no headings": (data()[1:], "one.csv, line 1: found numbers, expected a line of headings", "Begin the file with one"),
    "seven samples": (data(7), "one.csv: 7 usable samples", "A recording needs 8 or more."),
    "no time": (without(0), "one.csv: no column 'time'; found: load_point_velocity [um/s], normal_load [N], spring", "Head"),
    "misspelt time": (headed("time", "tine"), "one.csv: no column 'time'; found: tine [s], load", "Head it `time [s]`, or"),
    "no spring": (without(3), "experiment.toml, line 19: columns.elongation: one.csv has no column 'spring'", "Known: load"),
    "time in um": (headed("[s]", "[um]"), "one.csv: column 'time [um]': 'um' measures um, not s; time is in s or", "Give a"),
    "load in m": (headed("[N]", "[m]"), "one.csv: column 'normal_load [m]': 'm' measures um, not N; normal_load is in", "G"),
    "no such unit": (headed("[N]", "[smoot]"), "one.csv: column 'normal_load [smoot]': unknown unit 'smoot'", "Known: %, "),
    "two times": (headed("load_point_velocity [um/s]", "time [ms]"), "one.csv: 2 columns are called 'time'", "Name the on"),
    "no reading": (column(3, ""), "one.csv: column 'spring' has 0 numbers in 120 samples", "A recording needs 8 or more."),
    "no load": (column(2, ""), "one.csv: column 'normal_load [N]': no number in it", 'Give the run load = "5 N", or the c'),
    "load of 0": (column(2, "0"), "one.csv: row 1, t = 0 s, column 'normal_load [N]': the load is 0 N", "The slider must st"),
    "no velocity": (column(1, "nan"), "one.csv: column 'load_point_velocity [um/s]': no velocity in it", "Give the run a dr"),
    "clock set back": (clock(lambda i: i % 60), "one.csv: row 61, t = 0 s: the time goes back, from 59 s, and stays", "Two r"),
    "coarse clock": (clock(lambda i: i // 9), "one.csv: row 2, t = 0 s: 106 of 120 samples have the time of the one", "The"),
    "stopped clock": (clock(lambda i: 1.0), "one.csv: row 2, t = 1 s: 119 of 120 samples have the time of the one be", "T"),
}  # fmt: skip
NO_DRIVE = TOML.replace(next(line for line in TOML.splitlines() if line.startswith("drive")) + "\n", "").replace(
    "window = [0.0, 10.0]\n", ""
)


@pytest.mark.parametrize("name", DATA)
def test_a_breach_in_a_data_file(name: str, tmp_path: Path, registry: Registry) -> None:
    content, message, way_out = DATA[name]
    found, hint = answer(write(tmp_path, toml=NO_DRIVE, one=content), registry)
    assert found.startswith(message), found
    assert hint.startswith(way_out), hint


MISSING = {
    "elongation": (3, 'elongation = { name = "spring", unit = "um" }', "", "one.csv: none of the columns elongation, force"),
    "drive": (1, "", "", "experiment.toml, line 21: runs[0]: the run has no drive, and one.csv no load_point_velocity or"),
    "load": (2, "", "", "experiment.toml, line 21: runs[0]: the run has no load, and one.csv no normal_load or normal_stress"),
}  # fmt: skip


@pytest.mark.parametrize("what", MISSING)
def test_what_no_column_and_no_key_gives(what: str, tmp_path: Path, registry: Registry) -> None:
    k, old, new, message = MISSING[what]
    found, hint = answer(write(tmp_path, toml=NO_DRIVE.replace(old, new), one=without(k)), registry)
    assert found.startswith(message) and hint


def test_all_that_is_missing_is_named_at_once(tmp_path: Path, registry: Registry) -> None:
    found, hint = answer(write(tmp_path, toml=NO_DRIVE, one=["a,b,c,spring", *data()[1:]]), registry)
    for lack in ("no column 'time'; found: a, b, c, spring", "the run has no drive", "the run has no load"):
        assert lack in found
    assert "Head it `time [s]`" in hint and "Write drive" in hint and 'Write load = "5 N"' in hint


def test_a_saturated_load_is_refused(tmp_path: Path, registry: Registry) -> None:
    lines, W = data(400), np.minimum(5 + np.sin(np.arange(400) / 9), 5.8)
    lines = [lines[0], *(",".join([*c[:2], f"{w:.4f}", c[3]]) for w, c in zip(W, (x.split(",") for x in lines[1:]), strict=True))]
    found, hint = answer(write(tmp_path, toml=TOML.replace("duration = 1.0", "duration = 9.0"), one=lines), registry)
    assert "samples sit at the extreme value 5.8 N: the gauge is saturated" in found and "window" in hint


@pytest.mark.parametrize("role", ROLES)
def test_every_role_refuses_a_unit_of_another_dimension(role: str, tmp_path: Path, registry: Registry) -> None:
    unit = "kg" if role != "friction" else "um"
    toml = TOML.replace('elongation = { name = "spring", unit = "um" }', f'{role} = {{ name = "x", unit = "{unit}" }}')
    found, hint = answer(write(tmp_path, toml=toml), registry)
    assert found.startswith(f"experiment.toml, line 19: columns.{role}.unit: '{unit}' measures ") and hint.startswith("Give")


# the experiment itself


def test_no_experiment(tmp_path: Path, registry: Registry) -> None:
    assert answer(tmp_path / "none", registry)[0].startswith("no experiment ")
    assert answer(tmp_path, registry) == (
        f"{tmp_path}: holds no experiment.toml",
        "srf new DATA.csv writes one for recorded data.",
    )
    (tmp_path / "mine.toml").write_text(TOML, encoding="utf-8")
    assert answer(tmp_path, registry)[1] == "Name the file: mine.toml"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe\x00", "experiment.toml: not UTF-8 text (byte 0)"),
        (b"format = ", "experiment.toml: not TOML: Invalid value (at end of document)"),
        (b"", "experiment.toml: format: missing, expected 'srf-experiment/1'"),
        (b"a = " + b"[" * 5000 + b"]" * 5000, "experiment.toml: nested too deeply"),
        (b"a = " + b"1" * 5000, "experiment.toml: not TOML: Exceeds the limit"),
        (b"#" * (16 * 2**20 + 1), "experiment.toml: longer than 16 MB, too long for a description"),
    ],
)
def test_a_description_that_is_none(content: bytes, message: str, tmp_path: Path, registry: Registry) -> None:
    (write(tmp_path) / "experiment.toml").write_bytes(content)
    found, hint = answer(tmp_path, registry)
    assert found.startswith(message) and hint


def test_a_data_file_is_no_description(tmp_path: Path, registry: Registry) -> None:
    place = write(tmp_path) / "one.csv"
    found, hint = answer(place, registry)
    assert found == f"{place}: a data file, not the description of an experiment"
    assert f"`srf new {place}`" in hint and "[[thresholds]]" in hint and f"`srf fit {place}`" in hint


def test_a_file_that_may_not_be_read_is_exit_code_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path)
    opened = Path.open

    def refuse(self: Path, *args: object, **kwargs: object) -> object:
        if self.name == "one.csv":
            raise PermissionError(13, "Permission denied")
        return opened(self, *args, **kwargs)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", refuse)
    assert printed(tmp_path, code=1) == ("one.csv: cannot be read: Permission denied", "Check path and permissions.")


@pytest.mark.parametrize("k", range(0, len(BREACHES), 12))
def test_a_breach_as_it_is_printed(k: int, tmp_path: Path) -> None:
    old, new, where, found, way_out = BREACHES[k]
    message, hint = printed(write(tmp_path, toml=TOML.replace(old, new, 1)))
    assert message.startswith(f"{where}: {found}") and hint.startswith(way_out)


# the size limit


def sparse(path: Path, start: bytes, size: int) -> None:
    """Write a file of `size` bytes that begins with `start` and takes no room."""
    with path.open("wb") as stream:
        stream.write(start)
        stream.truncate(size)


def csv_of_2_gb(folder: Path) -> Path:
    sparse(folder / "one.csv", "\n".join(data(5000)).encode() + b"\n", 2**31)
    return folder / "one.csv"


def npz_of_2_gb(folder: Path) -> Path:
    """An archive whose arrays say that they are long; the numbers would follow."""
    with zipfile.ZipFile(folder / "one.npz", "w") as archive:
        for name in ("time", "load_point_velocity", "normal_load", "spring"):
            stream = io.BytesIO()
            np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (2**26,)})
            archive.writestr(f"{name}.npy", stream.getvalue())
    return folder / "one.npz"


def mat_of_2_gb(folder: Path) -> Path:
    """A MATLAB 5 file with four vectors of 512 MB, as the format lays them out."""
    with (folder / "one.mat").open("wb") as stream:
        stream.write(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM"))
        for name in (b"time", b"load_point_velocity", b"normal_load", b"spring"):
            padded = name.ljust(-(-len(name) // 8) * 8, b"\0")
            head = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, 1, 2**26)
            head += struct.pack("<II", 1, len(name)) + padded + struct.pack("<II", 9, 2**29)
            stream.write(struct.pack("<II", 14, len(head) + 2**29) + head)
            stream.seek(2**29, os.SEEK_CUR)
        stream.truncate()
    return folder / "one.mat"


def look_of_2_gb(folder: Path) -> Path:
    channels = (b"time", b"load_point_velocity", b"normal_load", b"spring")
    head = b"\0" * 20 + struct.pack(">iii", 2**27, 4, 4) + b"\0" * 4
    for name in channels:
        head += name[:12].ljust(13, b"\0") + b"none".ljust(13, b"\0") + b"\0" * 54 + struct.pack(">i", 2**27)
    head = head.ljust(36 + 32 * 84, b"\0")
    sparse(folder / "one.look", head, len(head) + 4 * 4 * 2**27)
    return folder / "one.look"


LARGE = [csv_of_2_gb, npz_of_2_gb, mat_of_2_gb, look_of_2_gb]


@pytest.mark.parametrize("make", LARGE, ids=lambda f: f.__name__)
def test_a_recording_of_2_gb_is_refused_unread(make: Callable[[Path], Path], tmp_path: Path, registry: Registry) -> None:
    """Its size is told, and the way out, and little memory is touched."""
    write(tmp_path)
    toml = TOML.replace("one.csv", make(tmp_path).name).replace("window = [0.0, 10.0]\n", "")
    if make is look_of_2_gb:  # its names have 12 letters
        toml = toml.replace("[columns]\n", '[columns]\nload_point_velocity = "load_point_v"\n')
    (tmp_path / "experiment.toml").write_text(toml, encoding="utf-8")
    tracemalloc.start()
    try:
        with pytest.raises(SrfError) as caught:
            read_experiment(tmp_path, registry=registry)
        assert tracemalloc.get_traced_memory()[1] < 64 * 2**20
    finally:
        tracemalloc.stop()
    assert "MB" in caught.value.message and "above the limit of 512 MB" in caught.value.message
    assert "window" in caught.value.hint or "Save it as CSV or NPZ" in caught.value.hint


def test_a_window_of_a_large_recording_is_read(tmp_path: Path, registry: Registry) -> None:
    """With 10 kB allowed, 5000 samples are too many and a hundred are not."""
    lines = data(5000)
    toml = TOML.replace(
        "[{ duration = 0.5, velocity = 8.0 }, { duration = 1.0, velocity = 12.0 }]", "[{ duration = 99, velocity = 8.0 }]"
    )
    folder = write(tmp_path, toml=toml.replace("window = [0.0, 10.0]", "window = [20.0, 20.99]"), one=lines)
    run = read_experiment(folder, registry=registry, limit=10_000).runs[0]
    assert (run.t[0], run.t[-1], run.t.size) == (20.0, 20.99, 100)
    with pytest.raises(SrfError, match=r"too large to hold: what is needed of it exceeds .* above the limit of 0\.009537 MB"):
        read_experiment(write(tmp_path, toml=toml, one=lines), registry=registry, limit=10_000)


def test_the_limit_of_the_command(tmp_path: Path) -> None:
    found, hint = printed(write(tmp_path, one=data(400), toml=NO_DRIVE), "--limit", "0.001")
    assert found.startswith("experiment.toml, line 21: runs[0]: one.csv (") and "is too large to hold" in found
    assert hint.startswith("Take a part with window")
