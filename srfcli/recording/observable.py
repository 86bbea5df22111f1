"""The recorded observable: which of its samples can be compared with a simulation, and what is wrong with the others."""

from __future__ import annotations

import numpy as np

from srfcli.errors import SrfError
from srfcli.numerics.program import Load
from srfcli.recording.flaws import observable_jumps, quantisation, rejoined, saturation, spikes
from srfcli.recording.load import Place
from srfcli.recording.noise import white_level
from srfcli.recording.series import Mask, span, spots
from srfcli.recording.values import Array, Notice

CALM = 1e-3  # relative change of the load between samples within which a jump of the observable is none of the load's
COARSE = 0.5  # quantisation step over white noise from which it is told


def clean_observable(place: Place, x: Array, *, rise: Array, load: Load) -> tuple[Array, Mask, float, list[Notice]]:
    """Return the observable (n,), which samples are to be compared, its quantisation step, and what was found.

    `rise` (n,) is the fastest rise per second that the drive allows. Level jumps of the transducer are taken out; empty cells,
    spikes, saturated samples and those beside a jump are not to be compared. Raises SrfError where nothing is left.
    """
    t, path, rows = place.t, place.path, place.rows
    known = np.isfinite(x)
    if known.sum() < 8:
        raise SrfError(
            f"{path.name}: column '{place.heading}' has {int(known.sum())} numbers in {x.size} samples",
            "A recording needs 8 or more.",
        )
    notices = spots("nan", ~known, path, rows, t, f"without a number in '{place.heading}', not compared")
    filled = np.interp(t, t[known], x[known])
    quantum = quantisation(filled[known])
    clipped = saturation(filled)
    if clipped.any():
        edge = float(filled[np.flatnonzero(clipped)[0]])
        told = f"at the extreme value {edge:.6g} of '{place.heading}': saturated, not compared"
        notices += spots("saturation", clipped, path, rows, t, told)
    steps = np.append(np.diff(t), t[-1] - t[-2])
    spiky = spikes(filled, quantum, rise * steps) & ~clipped
    notices += spots("spike", spiky, path, rows, t, f"standing out in '{place.heading}', not compared")
    calm = np.interp(t, t[~spiky], filled[~spiky])
    level, beside, told_jumps = _without_jumps(place, calm, rise, load, quantum)
    observed = np.where(spiky, filled + level - calm, level)
    white = white_level(calm)
    if quantum > COARSE * white > 0:
        what = f"steps of {quantum:.4g}, {quantum / white:.2g} times the white noise, which they add to"
        notices.append(Notice("quantisation", f"{path.name}: column '{place.heading}'", what))
    used = known & ~clipped & ~spiky & ~beside
    if used.sum() < 8:
        raise SrfError(
            f"{path.name}: column '{place.heading}': {int(used.sum())} samples can be compared", "8 are needed."
        )
    return observed, used, quantum, [*notices, *told_jumps]


def _without_jumps(place: Place, x: Array, rise: Array, load: Load, quantum: float) -> tuple[Array, Mask, list[Notice]]:
    W, _ = load(place.t)
    change = np.abs(np.diff(W, prepend=W[0])) / W
    jumps = observable_jumps(x, place.t, rise, change < CALM, quantum)
    level, beside = rejoined(x, jumps)
    notices = []
    for jump in jumps:
        where = span(place.path, place.rows, place.t, jump.at, jump.at + 1)
        done = "a transducer set anew; what follows is moved back by that much"
        if not jump.certain:
            done = "faster than the drive moves, but too little to be sure of a transducer set anew; left as it is"
        what = f"'{place.heading}' jumps by {jump.size:.4g}: {done}, and the two samples are not compared"
        notices.append(Notice("reset", where, what))
    return level, beside, notices
