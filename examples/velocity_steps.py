"""Writes two recordings of velocity steps in the units of a rock friction laboratory: s, mm, MPa.

They are simulated with a = 0.008, b = 0.011, Dc = 10 um, the slip law, a machine of 30 MPa/mm and gauge noise of 2 kPa. None of
that stands in the files; finding it is the tutorial `docs/tutorials/velocity-steps.md`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import srfcli as srf

NORMAL_STRESS, NOISE, RATE = 10.0, 2e-3, 10.0  # MPa, MPa, Hz
RUNS = {  # run: (time [s], velocity [um/s]) of each step, and the end [s]
    "p1": ([(0, 1), (40, 10), (70, 1), (130, 10)], 160.0),
    "p2": ([(0, 3), (30, 30), (45, 3)], 75.0),
}
HEADINGS = "time (s),load_point_displacement (mm),shear_stress (MPa),normal_stress (MPa)"


def main() -> None:
    """Simulate both runs and write p1.csv and p2.csv."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder for the files (default: here)")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(1)
    values = {"mu0": 0.6, "A": 0.008, "B": 0.011, "D0": 10.0, "V0": 1.0, "K": "30 MPa/mm", "W0": NORMAL_STRESS}
    slider = srf.system("dieterich-ruina", ageing="ruina", interface="rigid", inertia=False, parameters=values)
    for name, (steps, end) in RUNS.items():
        t = np.arange(0, end, 1 / RATE)
        record = srf.simulate(slider, t=t, drive=steps, observable="force").records[0]
        shear_stress = record.observed + random.normal(0, NOISE, t.size)  # 1 MPa counts as 1 N on 1 mm^2
        begin, velocity = np.array(steps).T
        for_each = np.clip(t[:, None] - begin, 0, np.diff(begin, append=end))  # seconds at each velocity
        displacement = for_each @ velocity / 1000  # mm
        table = np.column_stack([t, displacement, shear_stress, np.full_like(t, NORMAL_STRESS)])
        form = ["%.1f", "%.5f", "%.4f", "%.1f"]
        np.savetxt(out / f"{name}.csv", table, fmt=form, delimiter=",", header=HEADINGS, comments="")
        print(out / f"{name}.csv")


if __name__ == "__main__":
    main()
