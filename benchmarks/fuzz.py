"""Damaged files to every parser: how many are read, how many refused, and whether any does something else.

    python benchmarks/fuzz.py --inputs 1000000 --seed 1

Sound files are cut, doubled and overwritten at random places. Refused means `SrfError`; every other exception is printed with
the input that caused it, and counts as a failure. The last column is the longest time that one input took.
"""

from __future__ import annotations

import argparse
import collections
import io
import random
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import common  # noqa: F401  tests/ can be imported
import numpy as np
import sound_files
from sound_files import SETTINGS, THRESHOLDS

from srfcli.core.errors import SrfError
from srfcli.core.settings import load_toml, resolve
from srfcli.core.units import dimension, parse_quantity
from srfcli.data.columns import open_source
from srfcli.data.description import read_description
from srfcli.data.experiment import read_experiment
from srfcli.data.thresholds import read_thresholds
from srfcli.laws.expression import parse_expression
from srfcli.laws.law_file import read_header, template
from srfcli.laws.registry import bundled_registry, read_law, scan_python
from srfcli.validation.blind import Answer, read_answers, to_line

DATA = sound_files.recording(60)
EXPERIMENT = sound_files.EXPERIMENT.replace("window = [0.0, 1.5]", "window = [0.0, 0.5]")
PIECES = [b"", b"[", b"]", b'"', b"'", b"{", b"}", b"=", b",", b".", b"\n", b"\r", b"\0", b"\x1b[2J", b"\xff", b"1e999",
          b"nan", b"-inf", b"-1", b"9" * 400, b"1e-320", b"0x" + b"f" * 400, b"true", b"[" * 900, b"a." * 300, b"\\u0000",
          b"x.py", b"../x.toml", b"(" * 40, b"**9" * 9, b"PK\x03\x04"]  # fmt: skip


def archive() -> bytes:
    """A sound NumPy archive."""
    buffer = io.BytesIO()
    np.savez(buffer, time=np.arange(5.0), units=np.array(["s", "um"]), elongation=np.arange(5.0))
    return buffer.getvalue()


def matlab() -> bytes:
    """A sound MATLAB file."""
    from scipy.io import savemat

    buffer = io.BytesIO()
    savemat(buffer, {"time": np.arange(9.0), "force": np.arange(9.0), "data": np.eye(3)})
    return buffer.getvalue()


def damaged(data: bytes, chance: random.Random) -> bytes:
    """The data with one to four stretches cut out, doubled, moved or replaced."""
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(data) + 1)
        end = min(at + int(chance.expovariate(0.1)), len(data))
        how = chance.random()
        if how < 0.4:
            new = chance.choice(PIECES)
        elif how < 0.6:
            new = chance.randbytes(chance.randint(1, 6))
        elif how < 0.8:
            new = data[at:end] * chance.randint(0, 3)
        else:
            other = chance.randrange(len(data) + 1)
            new = data[other : other + end - at]
        data = data[:at] + new + data[end:]
    return data


def contents(place: Path) -> None:
    """Read all columns of a data file."""
    source = open_source(place, registry=bundled_registry())
    for block in source.blocks(tuple(range(len(source.headings)))):
        assert block is not None


def of_text(*parsers: Callable[[str], object]) -> Callable[[Path], None]:
    """A reader of a file that gives its text to parsers of text."""

    def read(place: Path) -> None:
        text = place.read_bytes().decode("utf-8", "replace")
        refused: SrfError | None = None
        for parse in parsers:
            try:
                parse(text)
            except SrfError as error:
                refused = error
        if refused is not None:
            raise refused

    return read


def settings(place: Path) -> None:
    """Read settings and give them to the paper's law."""
    resolve(bundled_registry().get("friction", "srf-vsat").parameters, {}, env={}, toml=load_toml(place))


def experiment(place: Path) -> None:
    """Read an experiment with its recording."""
    read_experiment(place, registry=bundled_registry())


def header_and_law(place: Path) -> None:
    """Read a law file as a listing does, then whole."""
    read_header(place)
    read_law(place)


def table(place: Path) -> None:
    """Recognise and read a table of critical loads."""
    read_thresholds(place)


def seeds() -> list[tuple[str, str, bytes, Callable[[Path], object], int]]:
    """What is fuzzed: name, file name, sound content, reader and its share of the inputs."""
    law, effect = (template(kind, "my-own", python=False).encode() for kind in ("friction", "effect"))
    number = of_text(lambda t: parse_quantity(t, "N/um", name="K"))
    return [
        ("law file", "x.toml", law, header_and_law, 8),
        ("effect file", "x.toml", effect, header_and_law, 4),
        ("Python law, scanned", "x.py", template("friction", "my-own", python=True).encode(), scan_python, 4),
        ("formula", "t", b"mu0 + A*log(v/V0) + B*log(1 + Vsat*phi/D0)",
         of_text(lambda t: parse_expression(t, ("v", "phi", "mu0", "A", "B", "D0", "V0", "Vsat"))), 12),
        ("number with unit", "t", b"-0.21e-3 N/um", number, 20),
        ("unit", "t", b"N*s^2/um", of_text(dimension), 10),
        ("experiment.toml", "experiment.toml", EXPERIMENT.encode(), read_description, 12),
        ("experiment, whole", "experiment.toml", EXPERIMENT.encode(), experiment, 4),
        ("srf.toml", "srf.toml", SETTINGS.encode(), settings, 12),
        ("critical loads", "t.csv", THRESHOLDS.encode(), table, 10),
        ("CSV", "a.csv", DATA.encode(), contents, 8),
        ("NumPy archive", "a.npz", archive(), contents, 4),
        ("MATLAB file", "a.mat", matlab(), contents, 4),
        ("answers.jsonl", "answers.jsonl", (to_line(Answer("case-000", "none")) + "\n").encode(), read_answers, 6),
    ]  # fmt: skip


def main() -> None:
    """Run the campaign and print its table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--inputs", type=int, default=20_000)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--seconds", type=float, default=float("inf"), help="stop after so long, with what was done")
    asked.add_argument("--parsers", help="these rows of the table only, with commas")
    given = asked.parse_args()
    chance, begun = random.Random(given.seed), time.monotonic()
    every = [seed for seed in seeds() if given.parsers is None or seed[0] in given.parsers.split(",")]
    counts = {name: collections.Counter[str]() for name, *_ in every}
    slowest = dict.fromkeys(counts, 0.0)
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        (Path(folder) / "one.csv").write_text(DATA)
        for _, file, sound, read, _ in every:  # what is damaged is sound: else nothing lies behind the first check
            (Path(folder) / file).write_bytes(sound)
            read(Path(folder) / file)
        for _ in range(given.inputs):
            if time.monotonic() - begun > given.seconds:
                break
            name, file, sound, read, _ = chance.choices(every, [share for *_, share in every])[0]
            place = Path(folder) / file
            data = damaged(sound, chance)
            place.write_bytes(data)
            at = time.process_time()
            try:
                read(place)
                counts[name]["read"] += 1
            except SrfError:
                counts[name]["refused"] += 1
            except Exception as error:
                counts[name]["failed"] += 1
                print(f"FAILED {name}: {type(error).__name__}: {str(error)[:200]}: {data!r:.300}", flush=True)
            slowest[name] = max(slowest[name], time.process_time() - at)
    print("| parser | inputs | read | refused | failed | slowest [s CPU] |\n|---|---|---|---|---|---|")
    for name, count in counts.items():
        print(f"| {name} | {count.total()} | {count['read']} | {count['refused']} | {count['failed']} | {slowest[name]:.2f} |")
    whole = sum(counts.values(), collections.Counter[str]())
    print(f"| all | {whole.total()} | {whole['read']} | {whole['refused']} | {whole['failed']} | {max(slowest.values()):.2f} |")


if __name__ == "__main__":
    main()
