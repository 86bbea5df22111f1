"""A small experiment on disk, and every way to break it: what is changed, and what must be answered."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

TOML = """format = "srf-experiment/1"
title = "three steps"

[apparatus]
stiffness = "0.21 N/um"
mass = "2.37 kg"

[model]
law = "srf-vsat"
ageing = "dieterich"
interface = "elastic"
inertia = true

[parameters]
A = { value = 0.012, lower = 0.006, upper = 0.03 }
V0 = { value = 1.0, fixed = true }

[columns]
elongation = { name = "spring", unit = "um" }

[[runs]]
name = "one"
file = "one.csv"
holdout = false
window = [0.0, 10.0]
drive = [{ duration = 0.5, velocity = 8.0 }, { duration = 1.0, velocity = 12.0 }]
start = 0.0
initial = "steady"
modulation = { frequency = 10.0, amplitude = 0.0, onset = 0.0 }

[[runs]]
name = "two"
file = "two.csv"
load = "5 N"
"""
HEADING = "time [s],load_point_velocity [um/s],normal_load [N],spring"


def data(rows: int = 120, *, heading: str = HEADING) -> list[str]:
    """Return the lines of a data file: steps from 8 to 12 um/s at 0.5 s under 5 N, 100 samples a second."""
    random = np.random.default_rng(7)
    t = np.arange(rows) / 100
    V, W = np.where(t < 0.5, 8.0, 12.0), np.full(rows, 5.0)
    u = 10.46 - 0.276 * np.log(V / 8) + random.normal(0.0, 0.01, rows)
    return [heading, *(",".join(f"{x:.6g}" for x in row) for row in zip(t, V, W, u, strict=True))]


def write(folder: Path, *, toml: str = TOML, one: list[str] | bytes | None = None, two: list[str] | None = None) -> Path:
    """Write the experiment into `folder` and return it; lines or bytes given replace a data file."""
    (folder / "experiment.toml").write_text(toml, encoding="utf-8")
    for name, lines in (("one.csv", one), ("two.csv", two)):
        content = lines if isinstance(lines, bytes) else "\n".join(lines or data()).encode() + b"\n"
        (folder / name).write_bytes(content)
    return folder


@dataclass(frozen=True)
class Breach:
    """A breach: `old` becomes `new` in the description; the answer says `where`, what was `found`, and what to `try_`."""

    old: str
    new: str
    where: str
    found: str
    try_: str
    code: int = 2


def line_of(text: str) -> int:
    """Return the line of the base description in which `text` stands first."""
    return TOML[: TOML.index(text)].count("\n") + 1
