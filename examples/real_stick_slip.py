"""Stick-slip of paper on paper: period and amplitude from the recordings, beside a count by another method.

    python examples/real_stick_slip.py DATA

DATA holds the folder paper-on-paper-stickslip; the recordings (Colas, Pustelnik, Oliver, Abry, Geminard and Vidal, Phys. Rev. E,
2019) are no part of this project. A slider of 30.7 g is pulled through springs of 168, 1002 and 2254 N/m at 42, 1100 and
4300 um/s; the gauge's impulses are removed by a running median over 20 ms. An event is a fall of the spring force by 0.04 of
the weight at least, before it rises as much again.

The other count, told with the recordings, takes peaks by prominence. Where neighbouring tops are equal, as they are wherever the
force is quantised, prominence gives each of them the whole fall behind both: of every 20th sample of the same median it finds 86,
501 and 325 events at 42 um/s, of which 7, 14 and 134 are a second top of the same event. `equal tops` is that number here.
"""

from __future__ import annotations

import math
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srfcli.data.experiment import read_experiment
from srfcli.data.values import Run
from srfcli.laws.registry import load_registry
from srfcli.motion.simulate import StickSlip, stick_slip

Array = NDArray[np.float64]
MASS, GRAVITY = 0.0307, 9.81  # kg, m/s^2
WEIGHT = MASS * GRAVITY  # N
MEDIAN = 41  # samples at 2 kHz
SMALLEST = 0.04  # of the weight
SPARSE = 20  # of whose samples the other count was made
EXPERIMENT = f"""format = "srf-experiment/1"
title = "paper on paper, {{stiffness}} N/m at {{V}} um/s"

[apparatus]
stiffness = "{{stiffness}}e-6 N/um"
mass = "{MASS} kg"

[model]
law = "srf-vsat"
ageing = "dieterich"
interface = "rigid"
inertia = true

[columns]
time = {{{{ name = "t", unit = "s" }}}}
friction = {{{{ name = "Fnorm", unit = "1" }}}}

[[runs]]
name = "pull"
file = "{{file}}"
load = "{WEIGHT:.4f} N"
drive = [{{{{ duration = {{duration}}, velocity = {{V}} }}}}]
"""
CASES = (  # N/m, um/s, s, and the other count: events, median drop, s between them
    (168, 42, 376, (86, 0.056, 4.3)),
    (1002, 42, 376, (501, 0.082, 0.75)),
    (2254, 42, 376, (325, None, None)),
    (168, 1100, 15, (63, 0.064, 0.22)),
    (1002, 1100, 15, None),
    (168, 4300, 4, None),
)
HEAD = (
    "N/m", "um/s", "events", "equal tops", "other count", "drop", "um", "other drop", "period s", "mean s", "other s",
    "slipped", "fall s", "half swing s",
)  # fmt: skip


def recorded(data: Path, stiffness: int, V: int, duration: float) -> Run:
    """Return the recording as `srf fit` would read it, the spring force as a share of the weight."""
    file = data / "paper-on-paper-stickslip" / f"k{stiffness}Nm_v{V}.mat"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "experiment.toml"
        text = EXPERIMENT.format(stiffness=stiffness, V=V, duration=duration, file=file.resolve())
        path.write_text(text, encoding="utf-8")
        return read_experiment(path, registry=load_registry()).runs[0]


def events(run: Run) -> tuple[StickSlip, Array]:
    """Return the stick-slip events of a recording, and the spring force without impulses that they were found in."""
    from scipy.ndimage import median_filter

    force = median_filter(run.observed, MEDIAN)
    return stick_slip(run.t, force, smallest=SMALLEST), force


def by_prominence(force: Array) -> tuple[int, int]:
    """Return how many peaks have the prominence of an event, and how many of them only repeat a top of the same height."""
    from scipy.signal import find_peaks

    tilted = force - 1e-9 * np.arange(force.size)  # no two tops are equal any more, no fall is changed that counts
    counts = [find_peaks(f, prominence=SMALLEST)[0].size for f in (force, tilted)]
    return counts[0], counts[0] - counts[1]


def row(data: Path, stiffness: int, V: int, duration: float, other: tuple[int, float | None, float | None] | None) -> list[str]:
    """Return one line of the table; `slipped` is the drop over what the drive moves in a mean period."""
    found, force = events(recorded(data, stiffness, V, duration))
    _, repeated = by_prominence(force[::SPARSE])
    drop = found.drop * WEIGHT / (stiffness * 1e-6)  # um of elongation
    mean = float(np.mean(found.recurrence))
    told = ["-" if value is None else f"{value:g}" for value in other or (None, None, None)]
    return [
        str(stiffness), str(V), str(found.times.size), str(repeated), told[0], f"{found.drop:.3f}", f"{drop:.3g}", told[1],
        f"{found.period:.3g}", f"{mean:.3g}", told[2], f"{drop / (V * mean):.2f}", f"{np.median(found.falls):.3f}",
        f"{math.pi * math.sqrt(MASS / stiffness):.3f}",
    ]  # fmt: skip


def main() -> None:
    """Print one line for each recording."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python examples/real_stick_slip.py DATA")
    print("  ".join(HEAD))
    for case in CASES:
        print(
            "  ".join(cell.rjust(len(head)) for cell, head in zip(row(Path(sys.argv[1]), *case), HEAD, strict=True)), flush=True
        )


if __name__ == "__main__":
    main()
