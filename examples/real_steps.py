"""Velocity steps of two laboratories, fitted by `srf fit`, beside what was published.

    python examples/real_steps.py DATA

DATA holds the folders psu-p655-ghost-rocks, basalt-b819-velocity-step and psu-p446-20MPa; the recordings are no part of this
project. Experiments are written to a temporary folder and fitted as `srf fit --trend slip` does; the last line fits eleven steps
of p446 together, as `srf fit --trend slip --vary mu0` does, and predicts two that are held out.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from srfcli.data.experiment import read_experiment
from srfcli.data.values import Experiment
from srfcli.inference.recordings import fit_recordings
from srfcli.laws.registry import load_registry

EXPERIMENT = """format = "srf-experiment/1"
title = "{title}"

[apparatus]
stiffness = "{stiffness} 1/um"

[model]
law = "dieterich-ruina"
ageing = "{ageing}"
interface = "rigid"
inertia = false

[parameters]
mu0 = {{ value = {mu0}, lower = 0.4, upper = 0.8 }}
A = {{ value = 0.006, lower = 0.001, upper = 0.03 }}
B = {{ value = 0.005, lower = 0.0005, upper = 0.03 }}
D0 = {{ value = {D0}, lower = 1.0, upper = 100.0 }}
V0 = {{ value = {V0}, fixed = true }}
{K}
[columns]
{columns}

[[runs]]
name = "step"
file = "{file}"
window = {window}
{imposed}
"""
P655 = {
    "title": "p655, 2.3 to 23 um/s at 100 MPa", "mu0": "0.487", "V0": "2.286",
    "columns": 'time = { name = "time_s", unit = "s" }\nfriction = { name = "friction", unit = "1" }',
    "window": "[3830.0, 3875.0]", "file": "psu-p655-ghost-rocks/p655_reduced.csv",
    "imposed": 'load = "100 N"\ndrive = [{ duration = 3851.36, velocity = 2.286 }, { duration = 100.0, velocity = 22.86 }]',
}  # fmt: skip
BASALT = {
    "title": "b819, 3 to 10 um/s at 20 MPa", "mu0": "0.6", "V0": "3.0",
    "columns": 'time = { name = "Time(s)", unit = "s" }\nfriction = { name = "Friction", unit = "1" }',
    "window": "[11650.0, 11720.0]", "file": "basalt-b819-velocity-step/velstep4_BRAVA_expb819_basalt.txt",
    "imposed": 'load = "20 N"\ndrive = [{ duration = 68.7, velocity = 3.0 }, { duration = 100.0, velocity = 10.1 }]',
}  # fmt: skip
TILL = {
    "title": "p446, till, 3 to 10 um/s at 20 MPa", "mu0": "0.59", "V0": "3.0", "columns": "", "window": "[640.0, 739.0]",
    "file": "psu-p446-20MPa/p446_20MPa.csv", "imposed": "",
}  # fmt: skip
FREE_K = "K = {{ value = {0}, lower = 5e-4, upper = 5e-2 }}"
CASES = [
    (P655, "ruina", "1.6e-3", "", 15.0, ".006005(53) .004230(51) 17.745(334)"),
    (P655, "ruina", "1.0e-3", "", 12.0, ".005823(98) .004094(94) 12.817(442)"),
    (P655, "dieterich", "1.0e-3", "", 6.0, ".006043(113) .004279(109) 6.505(199)"),
    (P655, "ruina", "1.6e-3", "free", 15.0, "the data want 1.6e-3 above the calibrated 1.0e-3"),
    (BASALT, "ruina", "5.4e-3", "free", 10.0, ".0073 .0079 10, k 5.4e-3 (quick fit)"),
    (BASALT, "dieterich", "9.6e-3", "free", 7.0, ".0085 .0088 6.7, k 9.6e-3 (quick fit)"),
    (TILL, "ruina", "2.6e-3", "", 20.0, ".0058(3) .0038(3) 24(3) (quick fit)"),
    (TILL | {"title": "p446, 10 to 30 um/s", "window": "[705.0, 753.0]"}, "ruina", "2.1e-3", "", 20.0,
     ".0063(5) .0041(4) 31(6) (quick fit)"),
    (TILL | {"title": "p446, 30 to 10 um/s", "window": "[772.5, 815.0]"}, "ruina", "2.6e-3", "", 20.0,
     ".0056(4) .0043(3) 25(4) (quick fit)"),
]  # fmt: skip


def experiment_of(data: Path, case: dict[str, str], ageing: str, stiffness: str, K: str, D0: float) -> Experiment:
    """Return the experiment of one recording; K is "free" or empty."""
    values = {**case, "file": (data / case["file"]).resolve(), "ageing": ageing, "stiffness": stiffness, "D0": D0}
    text = EXPERIMENT.format(**values, K=FREE_K.format(stiffness) if K else "")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "experiment.toml"
        path.write_text(text, encoding="utf-8")
        return read_experiment(path, registry=load_registry())


# The ladder of p446: what was driven, and when each step began, s; a run goes from halfway through the velocity before
LADDER = [(10, 0.2), (1, 166.9), (3, 563.6), (10, 699.4), (30, 740.0), (100, 753.8), (300, 757.9), (100, 759.2), (30, 763.2),
          (10, 776.4), (3, 816.2), (1, 949.2)]  # fmt: skip
HELD_OUT = ("3 to 10", "10 to 3")


def ladder(data: Path) -> Experiment:
    """Return the eleven steps of p446 as runs of one experiment, two of them held out; the stiffness is free."""
    case = TILL | {"title": "p446, eleven steps", "mu0": "0.59", "V0": "10.0", "file": (data / TILL["file"]).resolve()}
    values = {**case, "ageing": "ruina", "stiffness": "2.6e-3", "D0": 25.0, "K": FREE_K.format("2.6e-3")}
    head, run = EXPERIMENT.split("[[runs]]")
    text = head.format(**values)
    ends = [begin for _, begin in LADDER[1:]] + [1300.0]
    for (before, begin), (after, at), end in zip(LADDER, LADDER[1:], ends[1:], strict=False):
        name = f"{before} to {after}"
        window = f"[{60.0 if begin < 60 else 0.5 * (begin + at):.2f}, {end - 0.02 * (end - at):.2f}]"
        own = run.replace('"step"', f'"{name}"').format(**{**values, "window": window, "imposed": ""})
        text += "[[runs]]" + own + f"holdout = {str(name in HELD_OUT).lower()}\n"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "experiment.toml"
        path.write_text(text, encoding="utf-8")
        return read_experiment(path, registry=load_registry())


def main() -> None:
    """Print one line for each recording and law."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python examples/real_steps.py DATA")
    for case, ageing, stiffness, K, D0, published in CASES:
        found = fit_recordings(load_registry(), experiment_of(Path(sys.argv[1]), case, ageing, stiffness, K, D0), trend="slip")
        fit = found.fit
        cells = [f"{n} {fit.values[n]:.5g} ({fit.stderr[n]:.2g})" for n in fit.names if n in ("A", "B", "D0", "K")]
        print(f"{case['title']}, {ageing}, k {stiffness}{' free' if K else ''}: {', '.join(cells)}")
        noise = [f"{c[1]:.2g} " + (f"about {c[0]:.3g} Hz" if c[2:] else f"over {c[0]:.2g} s") for c in fit.runs[0].colours]
        print(f"    published {published}; {found.friction_field}; noise {', '.join(noise)}; {found.status.value}", flush=True)
    fit = fit_recordings(load_registry(), ladder(Path(sys.argv[1])), trend="slip", vary=["mu0"]).fit
    cells = [f"{n} {fit.values[n]:.5g} ({fit.stderr[n]:.2g})" for n in fit.names if n in ("A", "B", "D0", "K")]
    print(f"p446, all steps, mu0 and a trend for each, ruina: {', '.join(cells)}")
    print(f"    rms over noise {fit.rms_over_noise():.3f}, of the steps held out {fit.rms_over_noise(holdout=True):.3f}")


if __name__ == "__main__":
    main()
