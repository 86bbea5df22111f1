"""The drive in a column of displacements: how far the velocities found are from those driven, by the kind of the column's noise.

    python benchmarks/drives.py [--columns N]

Columns are drawn with 2 to 8 pieces of 0.3 to 100 um/s, two of five with velocities that alternate, 60 to 900 samples a piece at
5 to 300 Hz, and a noise of 1 nm to 2 um: white, with a correlation of 0.5 to 0.97 from sample to sample, in bursts, or that of
an encoder's counts. A column is wrong where a velocity is off by more than 5 % and by more than thirty times what its noise
allows, or the line has more than one piece too many. A second table has the same columns with another value of NEARER, by which
a curve is chosen over straight pieces.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from common import Report
from scipy.signal import lfilter

from srfcli.codegen.model import Array
from srfcli.data import imposed

KINDS = ("white", "coloured", "bursts", "counts")
OFF, TIMES, PIECES = 0.05, 30.0, 1  # when a column is wrong


def drawn(columns: int) -> Iterator[tuple[str, Array, Array, Array, Array, float]]:
    """Yield noise, t, x, the velocities driven, how long each lasts, and the relative error that the noise allows."""
    rng = np.random.default_rng(5)
    for number in range(columns):
        kind, n = KINDS[number % len(KINDS)], int(rng.integers(2, 9))
        V = np.exp(rng.uniform(np.log(0.3), np.log(100.0), n))
        if rng.random() < 0.4:
            V = np.where(np.arange(n) % 2 == 0, V[0], V[1])
        rate = 10 ** rng.uniform(0.7, 2.5)
        lasts = rng.uniform(60, 900, n) / rate
        size = 10 ** rng.uniform(-3, 0.3)
        if np.any(np.abs(np.diff(np.log(V))) < 0.1):
            continue  # no step
        ends = np.concatenate([[0.0], np.cumsum(lasts)])
        t = np.arange(0.0, ends[-1], 1 / rate)
        x = np.interp(t, ends, np.concatenate([[0.0], np.cumsum(lasts * V)]))
        noise = rng.standard_normal(t.size)
        if kind == "coloured":
            rho = rng.uniform(0.5, 0.97)
            noise = lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], noise)
        elif kind == "bursts":
            noise *= 1 + 9 * (rng.random() < 0.5) * ((t % (ends[-1] / 3)) < ends[-1] / 20)
        x = np.round(x / size) * size if kind == "counts" else x + size * noise
        yield kind, t, x, V, lasts, float(np.max(size * np.sqrt(12 / (lasts * rate)) / (lasts * V)))


def found(columns: int, nearer: float) -> tuple[dict[str, list[float]], dict[str, int]]:
    """Return the error of each column by its noise, and how many are wrong."""
    imposed.NEARER = nearer
    errors: dict[str, list[float]] = defaultdict(list)
    wrong: dict[str, int] = defaultdict(int)
    for kind, t, x, V, lasts, seen in drawn(columns):
        drive, *_ = imposed.drive_from_displacement(t, x, "column")
        ends = np.cumsum(lasts)
        at = np.array([drive.at(middle) for middle in ends - lasts / 2])
        error = float(np.max(np.abs(at / V - 1)))
        errors[kind].append(error)
        wrong[kind] += error > max(OFF, TIMES * seen) or len(drive.velocities) - V.size > PIECES
    return errors, wrong


def main() -> None:
    """Draw columns, find their drives, print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--columns", type=int, default=400)
    asked = parser.parse_args()
    usual = imposed.NEARER
    errors, wrong = found(asked.columns, usual)
    report = Report("drives", __doc__ or "")
    rows = [
        (
            kind,
            len(errors[kind]),
            wrong[kind],
            f"{np.median(errors[kind]):.1e}",
            f"{np.quantile(errors[kind], 0.95):.1e}",
            f"{max(errors[kind]):.1e}",
        )
        for kind in KINDS
    ]
    report.say("# error: of the worst velocity of a column, relative")
    report.table(("noise", "columns", "wrong", "error, median", "19 of 20 below", "largest"), rows)
    report.say()
    own = {times: found(asked.columns, times * usual)[1] for times in (0.2, 0.4, 2.0, 5.0)} | {1.0: wrong}
    report.table(("wrong at NEARER", *KINDS), [(f"{t * usual:g}", *(own[t][kind] for kind in KINDS)) for t in sorted(own)])


if __name__ == "__main__":
    main()
