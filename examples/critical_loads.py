"""Which physics critical loads lack: the region of the paper's figures 2 and 4, diagnosed from its thresholds alone.

    python examples/critical_loads.py --out DIR

Two experiments are written to DIR, each a folder with one table of critical loads and no recording, and diagnosed:

    rigid      the loads against the amplitude that reaches the asperities; the baseline has a rigid interface
    cushion    the same loads against the amplitude that is applied, of which the air cushion lets rho = 0.48 through, the paper's
               trial value; the baseline takes the modulation for what it is said to be

The paper prints its figures and no table, so the loads are made: from its optimised set (Table I) at 31 velocities and amplitudes
of these figures, with the 3 % of noise that it states (seed 2003). Start values are its trial set.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from common import paper_model, progress

import srfcli as srf
from srfcli.codegen.model import GeneratedModel
from srfcli.core.files import write_atomic
from srfcli.data.thresholds import Thresholds, thresholds, thresholds_csv
from srfcli.numerics.critical import critical_line, load_window
from srfcli.numerics.hopf import critical_point

POINTS = {  # effective amplitude of the figures: velocities in um/s
    0.0: (1, 2, 5, 10, 20, 50, 100),
    0.045: (1, 2, 5, 10, 20, 50, 100),
    0.09: (1, 2, 5, 10, 20, 50, 100),
    0.13: (1, 2, 5, 10, 20, 30),
    0.18: (1, 5, 7, 25),
}
RHO, NOISE, SEED = 0.48, 0.03, 2003
DESCRIPTION = """format = "srf-experiment/1"
title = "{title}"

[apparatus]
stiffness = "0.21 N/um"
mass = "2.37 kg"

[model]
law = "srf-vsat"
ageing = "dieterich"
interface = "{interface}"

[parameters]
A = {{ value = 0.012, lower = 0.004, upper = 0.04 }}
B = {{ value = 0.023, lower = 0.008, upper = 0.08 }}
D0 = {{ value = 0.40, lower = 0.1, upper = 1.5 }}
Vsat = {{ value = 280.0, lower = 50.0, upper = 1500.0 }}
{more}
[[thresholds]]
file = "critical-loads.csv"
frequency = 120.0
"""
ELASTIC = "lambda = { value = 0.62, lower = 0.1, upper = 3.0 }\n"


def lowest(model: GeneratedModel, V: float, eps: float) -> float:
    """Return the lowest load (N) at which stability is lost as W0 rises."""
    p = model.vector({"V": V, "eps": eps})
    if eps == 0:
        point, _ = critical_point(model, p)
        assert point is not None
        return point.W0
    low, high = load_window(model, [p])
    return next(q.value(model, "W0") for q in critical_line(model, p, lo=low, hi=high).points if q.slope > 0)


def made(share: float) -> Thresholds:
    """Return the table, its amplitudes those that are applied where `share` of them reaches the asperities."""
    model, rows = paper_model(), [(float(V), eps) for eps, speeds in POINTS.items() for V in speeds]
    loads = np.array([lowest(model, V, eps) for V, eps in rows])
    noise = np.random.default_rng(SEED).normal(size=loads.size) * NOISE * loads
    V, eps = np.array(rows).T
    return thresholds(V, eps / share, loads + noise, sigma=NOISE * loads)


def main() -> None:
    """Write both experiments, diagnose them, and print what was found."""
    parser = argparse.ArgumentParser(description="What the paper's critical loads lack under two baselines.")
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder for the experiments (default: here)")
    place = parser.parse_args().out
    for name, interface, share, more in (("rigid", "rigid", 1.0, ""), ("cushion", "elastic", RHO, ELASTIC)):
        folder = place / name
        folder.mkdir(parents=True, exist_ok=True)
        title = f"critical loads of figures 2 and 4, {name}"
        description = DESCRIPTION.format(title=title, interface=interface, more=more)
        write_atomic(folder / "experiment.toml", description.encode("utf-8"))
        write_atomic(folder / "critical-loads.csv", thresholds_csv(made(share)).encode("utf-8"))
        begun = time.process_time()
        found = srf.diagnose(folder, progress=lambda text, share: progress(text))
        progress()
        print(f"{name}: {found.sentence}  ({time.process_time() - begun:.0f} s of CPU)")
        for row in found.table.rows:
            print(f"  {row[0]:24s} log evidence {row[1]:+8.1f}  rms {row[2]:.3f}  {row[5]}")
        for row in found.parameter_table.rows:
            told = [f"{v:.4g} +- {e:.2g}" if v is not None else "-" for v, e in ((row[1], row[2]), (row[3], row[4]))]
            print(f"  {row[0]:8s} baseline {told[0]:22s} augmented model {told[1]:22s} {row[5]}")


if __name__ == "__main__":
    main()
