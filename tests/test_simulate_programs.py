"""What `srf simulate` is told and how it is shown: programs in words, sample times, rows and drawn curves."""

from __future__ import annotations

import numpy as np
import pytest

from srfcli.core.errors import SrfError
from srfcli.motion.imposed import Drive
from srfcli.results.simulation import Rows
from srfcli.tasks.simulate import read_pieces, read_rates, sample_times, usual_rate


def test_pieces_with_units_and_ramps() -> None:
    assert read_pieces("0.5:12, 4:8", "um/s", name="drive", example="") == ((0.5, 12, 12), (4, 8, 8))
    assert read_pieces("2 s : 5 -> 7 N", "N", name="load", example="") == ((2, 5, 7),)
    assert read_pieces("2:0.001 mm/s -> 5 um/s", "um/s", name="drive", example="") == ((2, 1, 5),)
    drive = Drive.sequence(read_pieces("1:10, 2:10->20, 1:0", "um/s", name="drive", example=""), start=5.0)
    assert drive(np.array([5.0, 5.5, 7.0, 8.0, 9.0])).tolist() == [10.0, 10.0, 15.0, 0.0, 0.0]


def test_sample_times_meet_the_pieces() -> None:
    t = sample_times([1.0, 100.0, 2.0], read_rates("100, 1, 50", 3), 0.0)
    assert t.size == 100 + 100 + 101 and t[0] == 0.0 and t[-1] == 103.0
    assert (np.diff(t) > 0).all() and {1.0, 101.0} <= set(t.tolist())
    assert t[:4].tolist() == [0.0, 0.01, 0.02, 0.03]
    odd = sample_times([0.35], (100.0,), 0.0)
    assert odd[-1] == 0.35 and odd.size == 36
    with pytest.raises(SrfError, match="samples"):
        sample_times([1e5], (101.0,), 0.0)


@pytest.mark.parametrize(
    ("duration", "frequency", "rate"),
    [(5.0, None, 1000.0), (0.1, None, 10_000.0), (5.0, 120.0, 2000.0), (1e4, None, 10.0), (1e4, 120.0, 10.0), (1e12, None, 1e-7)],
)  # fmt: skip
def test_the_usual_rate(duration: float, frequency: float | None, rate: float) -> None:
    assert usual_rate(duration, frequency) == rate


def test_rows_are_a_sequence() -> None:
    rows = Rows([(("a",), [np.arange(3.0), np.arange(3.0) * 2]), (("b",), [np.ones(25_000), np.zeros(25_000)])])
    assert len(rows) == 25_003 == len(list(rows)) and rows[1] == ("a", 1.0, 2.0) and rows[-1] == ("b", 1.0, 0.0)
    assert rows[2:4] == [("a", 2.0, 4.0), ("b", 1.0, 0.0)] and list(rows)[:4] == rows[0:4]
    with pytest.raises(IndexError):
        rows[25_003]


def test_a_long_record_is_drawn_from_few_points() -> None:
    from srfcli.results.figures import envelope

    t = np.linspace(0, 1, 200_001)
    y = np.sin(2 * np.pi * 5000 * t)
    y[77_777] = 9.0
    x, few = envelope(t, y)
    assert x.size <= 2 * 1500 + 2 and few.max() == 9.0 and few.min() == pytest.approx(-1, abs=1e-3)
    assert (np.diff(x) > 0).all() and x[[0, -1]].tolist() == [0.0, 1.0]
    assert envelope(t[:100], y[:100])[0].size == 100
