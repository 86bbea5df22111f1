"""Calibration of `numerics.collocation.mesh_error`: estimate over true error, on random critical loads of several systems.

For random V (1 to 100 um/s) and eps (0.045 to 0.4, in one row 0.001 to 0.045), both logarithmic, one critical load is taken
from a scan along W0 and polished on a mesh of N = 16, 24, 32, 48 or 64 intervals; the estimate is `mesh_error` there. True errors
are taken from 4 N intervals, whose own error is 4^8 times smaller: the relative distance of W0 from the same load there;
and, at the coarse load, the distance of the critical multiplier from that on 4 N intervals, and the largest distance of
all multipliers.
Points whose true error is below FLOOR are left out, where rounding and Newton's own tolerance are seen and not the mesh; so
are those whose estimate is above COARSE, where the mesh says nothing yet and polishing refines it at once. 'lost': no
convergence on the coarse or the fine mesh.

The ratio estimate / true is the factor by which the estimate is safe; 'covered' is the share with a ratio of at least 1,
'factor for 99 %' the number that would have to stand in place of the 4 in mesh_error to cover 99 % of the points. With fewer
than a hundred points that quantile is about the least one. Nothing is timed.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import common  # before NumPy: it fixes the number of threads
import numpy as np
from common import Report

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.core.errors import SrfError, Status
from srfcli.laws.registry import load_registry
from srfcli.numerics.boundary import along, polish
from srfcli.numerics.collocation import mesh_error
from srfcli.numerics.critical import load_window, scan_line
from srfcli.numerics.orbit import interpolate, solve_orbits, uniform_mesh

SEED = 20
FLOOR = 3e-10
COARSE = 1e-3
NOW = 4.0  # the factor in mesh_error
KINDS = (("load", "load_error"), ("critical multiplier", "critical_error"), ("all multipliers", "multiplier_error"))
MESHES = (16, 24, 32, 48, 64)
USUAL, SMALL = (0.045, 0.4), (1e-3, 0.045)  # ranges of eps
SYSTEMS: tuple[dict[str, str], ...] = (
    {},
    {},  # at small eps
    {"law": "log-log"},
    {"law": "bowden-tabor"},
    {"law": "dieterich-ruina"},
    {"ageing": "ruina"},
    {"law": "dieterich-ruina", "ageing": "ruina"},
    {"law": "two-state"},
    {"interface": "rigid"},
)


@dataclass(frozen=True)
class Sample:
    """One critical load on one mesh."""

    V: float
    eps: float
    W0: float
    intervals: int
    estimate: float
    load_error: float
    critical_error: float
    multiplier_error: float


def samples_of(
    model: GeneratedModel, rng: np.random.Generator, seconds: float, amplitudes: tuple[float, float]
) -> tuple[list[Sample], int]:
    """Return samples gathered until `seconds` of CPU are spent, and how many points did not converge on either mesh."""
    found, lost, begun = [], 0, time.process_time()
    while time.process_time() - begun < seconds:
        V, eps = np.exp(rng.uniform(0, np.log(100))), np.exp(rng.uniform(*np.log(amplitudes)))
        base = model.vector({"V": V, "eps": eps})
        lo, hi = load_window(model, [base])
        scan = scan_line(model, base, "W0", np.geomspace(lo, hi, 24), intervals=24, resolution=0.05)
        brackets = scan.brackets()
        if not brackets:
            continue
        i = int(rng.choice(brackets))
        for N in MESHES:
            sample = one(model, scan.p[:, i : i + 1], scan, i, N)
            if sample is None:
                lost += 1
            elif sample.estimate < COARSE:
                found.append(sample)
    return found, lost


def one(model: GeneratedModel, p: np.ndarray, scan: object, i: int, N: int) -> Sample | None:
    """Return the sample of one bracket of a scan on N intervals, or None where Newton's method fails."""
    line = along("W0", 1)
    target = scan.multipliers[i : i + 1, 0]
    guess = interpolate(scan.orbit.part(slice(i, i + 1)), uniform_mesh(N))
    coarse = polish(model, p, guess, target.real + 1j * abs(target.imag), line, tol=1e-12, max_mesh=N)[0]
    if coarse.status is Status.NO_CONVERGENCE:
        return None
    fine_mesh = uniform_mesh(4 * N)
    start = interpolate(coarse.orbit, fine_mesh)
    fine = polish(model, coarse.p[:, None], start, np.array([coarse.rho]), line, tol=1e-12, max_mesh=4 * N)[0]
    batches = [solve_orbits(model, coarse.p[:, None], o, tol=1e-11) for o in (coarse.orbit, start)]
    if fine.status is Status.NO_CONVERGENCE or not all(b.converged.all() for b in batches):
        return None
    a, b = (batch.multipliers[0] for batch in batches)
    W0 = coarse.value(model, "W0")
    return Sample(
        V=float(p[model.index("V"), 0]),
        eps=float(p[model.index("eps"), 0]),
        W0=W0,
        intervals=N,
        estimate=float(mesh_error(model, coarse.orbit)[0]),
        load_error=abs(fine.value(model, "W0") / W0 - 1),
        critical_error=float(abs(a[np.abs(a - coarse.rho).argmin()] - b[np.abs(b - coarse.rho).argmin()])),
        multiplier_error=float(max(np.abs(a[:, None] - b).min(axis=1).max(), np.abs(a[:, None] - b).min(axis=0).max())),
    )


def main() -> None:
    """Calibrate each system and print one table; `--seconds S` is the CPU time spent on each (8)."""
    seconds = float(sys.argv[sys.argv.index("--seconds") + 1]) if "--seconds" in sys.argv else 8.0
    report, registry, rows, worst = Report("mesh_error", __doc__), load_registry(), [], []
    assert common.ROOT.exists()
    pool: dict[str, list[float]] = {kind: [] for kind, _ in KINDS}
    for number, names in enumerate(SYSTEMS):
        amplitudes = SMALL if number == 1 else USUAL
        title = (", ".join(names.values()) or "srf-vsat (default)") + (", small eps" if amplitudes is SMALL else "")
        try:
            model = open_model(registry, **names)
            samples, lost = samples_of(model, np.random.default_rng([SEED, number]), seconds, amplitudes)
        except (SrfError, ArithmeticError, IndexError, np.linalg.LinAlgError) as error:
            report.say(f"{title}: {type(error).__name__}: {error}")
            continue
        for kind, of in KINDS:
            kept = [s for s in samples if getattr(s, of) > FLOOR]
            if len(kept) < 5:
                rows.append([title, kind, len(kept), lost, *["-"] * 7])
                continue
            ratio = np.array([s.estimate / getattr(s, of) for s in kept])
            pool[kind] += ratio.tolist()
            low = kept[int(np.argmin(ratio))]
            if ratio.min() < 1:
                worst.append(
                    f"{title}, {kind}: V = {low.V:.6g}, eps = {low.eps:.6g}, W0 = {low.W0:.6g}, N = {low.intervals}: "
                    f"estimate {low.estimate:.1e}, true {getattr(low, of):.1e}"
                )
            quantiles = [f"{q:.2g}" for q in np.quantile(ratio, (0, 0.01, 0.1, 0.5, 0.9))]
            factor = NOW / np.quantile(ratio, 0.01)
            rows.append([title, kind, len(kept), lost, *quantiles, f"{np.mean(ratio >= 1):.1%}", f"{factor:.2g}"])
    report.say()
    head = ["system", "of", "points", "lost", "least", "1 %", "10 %", "median", "90 %", "covered", "factor for 99 %"]
    report.table(head, rows)
    report.say()
    for kind, ratios in pool.items():
        factor = NOW / np.quantile(ratios, 0.01)
        covered = np.mean(np.array(ratios) >= 1)
        report.say(f"all systems, {kind}: {len(ratios)} points, covered {covered:.1%}, factor for 99 %: {factor:.2g}")
    for line in worst:
        report.say("worst of " + line)


if __name__ == "__main__":
    main()
