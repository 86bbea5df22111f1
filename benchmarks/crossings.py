"""Whether `srf critical` without a window finds every crossing that a brute scan over eight decades of load finds.

    python benchmarks/crossings.py

Every shipped friction law, ageing law and interface, each with the defaults beside it, at the amplitudes EPS and velocities V.
The brute scan looks at 100 loads a decade, from 1e-3 times the lowest to 1e3 times the highest load of the window around the
critical load without modulation, and at V up to 1 um/s, where the slider's swing is little damped and tongues are narrow, at
1000 a decade between 0.01 and 500 N; on 64 intervals. It halves where the interpolation of the growth rate could hide a pair,
and polishes what it brackets: it shares orbits and polishing with `srf critical`, and nothing of where `srf critical` looks.
A line counts as agreeing where both hold the same loads to 1e-6; what was bracketed and not located (status no-convergence)
counts for neither. What one has and the other has not is listed, and how many loads the brute scan found no forced state at.
"""

from __future__ import annotations

import time

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from common import Report, no_arguments

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.laws.registry import bundled_registry
from srfcli.numerics.critical import critical_line, load_window, locate_crossings, scan_line

EPS = (0.09, 0.3, 0.5)
V = (0.1, 1.0, 10.0, 100.0)
BEYOND = 1e3
PER_DECADE = 100
TONGUES, DENSE = (0.01, 500.0), 1000  # N, and loads a decade between them
SLOW = 1.0  # um/s: up to which tongues are narrow
SAME = 1e-6  # in ln W0


def systems() -> list[dict[str, str]]:
    """Return each shipped law, with the defaults beside it."""
    registry = bundled_registry()
    found = [{"law": e.name} for e in registry.entries("friction")]
    found += [{"ageing": e.name} for e in registry.entries("ageing") if e.name != "dieterich"]
    return found + [{"interface": e.name} for e in registry.entries("interface") if e.name != "elastic"]


def brute(model: GeneratedModel, p: np.ndarray) -> tuple[list[float], int]:
    """Return the loads (N) at which the growth rate crosses zero, and at how many loads no orbit was found."""
    lo, hi = load_window(model, [p])
    lo, hi = lo / BEYOND, hi * BEYOND
    values = np.geomspace(lo, hi, int(PER_DECADE * np.log10(hi / lo)))
    if p[model.index("V")] <= SLOW:
        fine = np.geomspace(*TONGUES, int(DENSE * np.log10(TONGUES[1] / TONGUES[0])))
        values = np.unique(np.concatenate([values, fine]))
    scan = scan_line(model, p, "W0", values, intervals=64, resolution=1e-3, tongues=False)
    points = locate_crossings(model, p, scan, tol=1e-8)
    return [q.value(model, "W0") for q in points if q.status.ok], int(scan.lost.size)


def lacking(these: list[float], those: list[float]) -> list[float]:
    """Return those of `these` that `those` lack."""
    return [a for a in these if not any(abs(np.log(a / b)) < SAME for b in those)]


def main() -> None:
    """Compare line by line and print what differs."""
    no_arguments(__doc__)
    report = Report("crossings", __doc__)
    rows, told = [], []
    agreeing = lines = crossings = 0
    for names in systems():
        model, name = open_model(bundled_registry(), **names), next(iter(names.values()))
        for eps in EPS:
            begun, count, same, statuses = time.process_time(), 0, 0, []
            spent = 0.0
            for velocity in V:
                p = model.vector({"eps": eps, "V": velocity})
                start = time.process_time()
                line = critical_line(model, p)
                spent += time.process_time() - start
                found = [q.value(model, "W0") for q in line.points if q.status.ok]
                wide, lost = brute(model, p)
                missed, more = lacking(wide, found), lacking(found, wide)
                count += len(wide)
                same += not missed and not more
                statuses.append(line.status.value)
                for what, loads in (("missed", missed), ("only critical has", more)):
                    if loads:
                        shown = ", ".join(f"{W0:.6g}" for W0 in loads)
                        told.append(
                            f"{name}, eps {eps:g}, V {velocity:g}: {what} {shown} N"
                            f" (status {line.status.value}, brute scan lost {lost} loads)"
                        )
            lines, agreeing, crossings = lines + len(V), agreeing + same, crossings + count
            total = time.process_time() - begun
            rows.append(
                (name, f"{eps:g}", count, f"{same} of {len(V)}", " ".join(statuses), f"{spent:.1f}", f"{total - spent:.1f}")
            )
            print(*rows[-1], flush=True)
    head = ("system", "eps", "crossings", "lines that agree", "status at each V", "critical CPU s", "brute CPU s")
    report.table(head, rows)
    report.say()
    report.say(f"{agreeing} of {lines} lines agree, {crossings} crossings in the brute scans")
    for line in told:
        report.say(line)


if __name__ == "__main__":
    main()
