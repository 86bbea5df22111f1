"""Does the search find everything? Components of the boundary, and critical loads on lines, against much denser searches.

Components: `find_components` with its default settings against DENSE (60 lines of 200 samples down to 2e-4 in ln W0, scanned on
48 intervals, shorter steps, a finer mesh on the way) in V = 1 to 100 um/s, W0 = 4 to 400 N. Lengths are in the window's unit
square. 'not covered' is the length of the dense boundary farther than REACH from the default one, 'not in dense' the
reverse; a dense component is missed if more than half of it is not covered.

Critical loads: `critical_line` with its default settings at random V against sign changes among 4000 loads (even in ln W0,
1.15e-3 apart), each orbit solved on 96 intervals. A dense crossing is missed if no default one lies within one and a half
spacings of it. Missed ones are counted by their distance in ln W0 from the nearest other crossing of the dense scan. What is
closer than the dense spacing is not seen here: 'only in default' counts what the default search has beyond the dense one.

CPU seconds, one thread, one run of each: they say what a denser search costs, no more.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field

import common  # before NumPy: it fixes the number of threads
import numpy as np
from common import Report

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.laws.registry import load_registry
from srfcli.numerics import continuation as module
from srfcli.numerics.collocation import Discretisation
from srfcli.numerics.continuation import Boundary, ContinuationSettings, StepSettings, find_components
from srfcli.numerics.critical import critical_line
from srfcli.numerics.orbit import growth, interpolate, robust_orbits, uniform_mesh
from srfcli.numerics.plane import Axis, Plane

AMPLITUDES = (0.13, 0.18, 0.25, 0.4)
LO, HI = 4.0, 400.0
REACH = 0.004
DENSE = ContinuationSettings(
    lines=60, samples=200, resolution=2e-4, tol=1e-5, steps=StepSettings(largest=0.02, correction=1e-3, mesh_error=2e-5)
)
DENSE_INTERVALS = 48
SEED = 7
LINES = 2  # random velocities for each eps
LOADS, INTERVALS = 4000, 96
BINS = (0.0, 2e-3, 5e-3, 1e-2, 3e-2, np.inf)


def search(model: GeneratedModel, plane: Plane, settings: ContinuationSettings, intervals: int) -> tuple[Boundary, float]:
    """Return the finished boundary and its CPU seconds; `intervals` are those of the scans."""
    usual, begun = module.INTERVALS, time.process_time()
    module.INTERVALS = intervals  # the settings do not have it
    try:
        *_, last = find_components(model, plane, settings)
    finally:
        module.INTERVALS = usual
    return last, time.process_time() - begun


def polylines(model: GeneratedModel, found: Boundary) -> list[np.ndarray]:
    """Return the components in unit coordinates."""
    return [found.plane.coordinates(model, np.stack([pt.p for pt in b.points], axis=1)) for b in found.branches]


def length(line: np.ndarray) -> float:
    """Return the length of a polyline."""
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def uncovered(line: np.ndarray, others: list[np.ndarray]) -> float:
    """Return the length of `line` whose middle lies farther than REACH from every segment of `others`."""
    middle = 0.5 * (line[1:] + line[:-1])
    nearest = np.full(len(middle), np.inf)
    for other in others:
        a, d = other[:-1], np.diff(other, axis=0)
        away = middle[:, None] - a
        share = np.clip((away * d).sum(-1) / np.maximum((d * d).sum(-1), 1e-300), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(away - share[..., None] * d, axis=-1).min(axis=1))
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1)[nearest > REACH].sum())


def describe(model: GeneratedModel, found: Boundary, k: int) -> str:
    """Say where component k lies."""
    V, W0 = (np.array([pt.value(model, name) for pt in found.branches[k].points]) for name in ("V", "W0"))
    ends = f"{found.branches[k].start.name.lower()}/{found.branches[k].end.name.lower()}"
    return f"V {V.min():.4g} to {V.max():.4g}, W0 {W0.min():.5g} to {W0.max():.5g}, {len(V)} points, {ends}"


def compare_components(report: Report, model: GeneratedModel) -> None:
    """Print one row per eps, and the components that only one of the searches found."""
    rows, said = [], []
    for eps in AMPLITUDES:
        plane = Plane(model.vector({"eps": eps}), Axis("V", 1.0, 100.0), Axis("W0", LO, HI))
        usual, cheap = search(model, plane, ContinuationSettings(), module.INTERVALS)
        dense, dear = search(model, plane, DENSE, DENSE_INTERVALS)
        a, b = polylines(model, usual), polylines(model, dense)
        gaps, extra = [uncovered(q, a) for q in b], [uncovered(q, b) for q in a]
        missed = [k for k, gap in enumerate(gaps) if gap > 0.5 * length(b[k])]
        only = [k for k, gap in enumerate(extra) if gap > 0.5 * length(a[k])]
        said += [f"eps {eps}, missed by the default: {describe(model, dense, k)}" for k in missed]
        said += [f"eps {eps}, missed by the dense one: {describe(model, usual, k)}" for k in only]
        said += [f"eps {eps}, default ended {s.status.name}: {' '.join(s.notes[1:])}" for s in (usual,) if not s.status.ok]
        said += [f"eps {eps}, dense ended {s.status.name}: {' '.join(s.notes[1:])}" for s in (dense,) if not s.status.ok]
        lengths = [f"{q:.3f}" for q in (sum(map(length, a)), sum(map(length, b)), sum(gaps), sum(extra))]
        rows.append([eps, len(a), len(b), len(missed), *lengths, f"{cheap:.1f}", f"{dear:.1f}"])
        report.say(f"  (eps {eps} done)")
    report.say()
    head = ["eps", "components", "dense", "missed", "length", "dense", "not covered", "not in dense", "CPU s", "dense"]
    report.table(head, rows)
    for line in said:
        report.say(line)


@dataclass
class Count:
    """Crossings of the dense scans by distance to the nearest other one, and how many of them were missed."""

    all: np.ndarray = field(default_factory=lambda: np.zeros(len(BINS) - 1, int))
    missed: np.ndarray = field(default_factory=lambda: np.zeros(len(BINS) - 1, int))
    only: int = 0
    lost: int = 0
    cheap: float = 0.0
    dear: float = 0.0


def dense_crossings(model: GeneratedModel, base: np.ndarray) -> tuple[np.ndarray, int]:
    """Return ln W0 of every sign change among LOADS loads, and the number of loads without an orbit."""
    coarse, fine = np.linspace(np.log(LO), np.log(HI), 251), np.linspace(np.log(LO), np.log(HI), LOADS)
    p = np.repeat(base[:, None], len(coarse), axis=1)
    p[model.index("W0")] = np.exp(coarse)
    first = interpolate(robust_orbits(model, p, None, uniform_mesh(32)).orbit, uniform_mesh(INTERVALS))
    g = np.empty(LOADS)
    for begin in range(0, LOADS, 200):  # blocks: the memory of one is enough
        at = fine[begin : begin + 200]
        left = np.clip(np.searchsorted(coarse, at, side="right") - 1, 0, len(coarse) - 2)
        share = ((at - coarse[left]) / (coarse[left + 1] - coarse[left]))[:, None, None]
        x = (1 - share) * first.x[left] + share * first.x[left + 1]
        stages = (1 - share[..., None]) * first.stages[left] + share[..., None] * first.stages[left + 1]
        p = np.repeat(base[:, None], len(at), axis=1)
        p[model.index("W0")] = np.exp(at)
        batch = robust_orbits(model, p, Discretisation(x, stages, first.edges), first.edges)
        g[begin : begin + 200] = growth(batch)[1]
    change = np.nonzero(g[:-1] * g[1:] < 0)[0]
    share = g[change] / (g[change] - g[change + 1])
    return fine[change] + share * (fine[change + 1] - fine[change]), int((~np.isfinite(g)).sum())


def compare_lines(report: Report, model: GeneratedModel, eps: float, rng: np.random.Generator, said: list[str]) -> Count:
    """Return what the default search misses at LINES random velocities."""
    count, spacing = Count(), np.log(HI / LO) / (LOADS - 1)
    for V in np.exp(rng.uniform(0, np.log(100), LINES)):
        base, begun = model.vector({"V": V, "eps": eps}), time.process_time()
        line = critical_line(model, base, lo=LO, hi=HI)
        count.cheap, begun = count.cheap + time.process_time() - begun, time.process_time()
        found = np.log([pt.value(model, "W0") for pt in line.points])
        dense, lost = dense_crossings(model, base)
        count.dear, count.lost = count.dear + time.process_time() - begun, count.lost + lost
        gaps = np.full(len(dense), np.inf)
        if len(dense) > 1:
            steps = np.diff(dense)
            gaps = np.minimum(np.r_[np.inf, steps], np.r_[steps, np.inf])
        place = np.digitize(gaps, BINS) - 1
        place[np.isinf(gaps)] = len(BINS) - 2
        for q, gap, k in zip(dense, gaps, place, strict=True):
            count.all[k] += 1
            if not len(found) or np.abs(found - q).min() > 1.5 * spacing:
                count.missed[k] += 1
                said.append(f"missed: eps = {eps}, V = {V:.8g}, W0 = {np.exp(q):.6g}, nearest other {gap:.2g} in ln W0")
        for q in found:
            if not len(dense) or np.abs(dense - q).min() > 1.5 * spacing:
                count.only += 1
                said.append(f"only in default: eps = {eps}, V = {V:.8g}, W0 = {np.exp(q):.6g}")
    return count


def main() -> None:
    """Print both comparisons; `--lines-only` or `--components-only` for one of them."""
    name = "components_lines" if "--lines-only" in sys.argv else "components"
    report, model = Report(name, __doc__), open_model(load_registry())
    assert common.ROOT.exists()
    if "--lines-only" not in sys.argv:
        report.say()
        compare_components(report, model)
    if "--components-only" in sys.argv:
        return
    report.say()
    rng, rows, said, total = np.random.default_rng(SEED), [], [], Count()
    for eps in AMPLITUDES:
        c = compare_lines(report, model, eps, rng, said)
        cells = [f"{m}/{n}" for m, n in zip(c.missed, c.all, strict=True)]
        rows.append([eps, LINES, *cells, c.only, c.lost, f"{c.cheap / LINES:.2f}", f"{c.dear / LINES:.1f}"])
        report.say(f"  (eps {eps}: missed/all {' '.join(cells)}, only in default {c.only}, no orbit {c.lost})")
        total.all, total.missed = total.all + c.all, total.missed + c.missed
    head = [f"< {b:g}" if b < np.inf else "farther" for b in BINS[1:]]
    report.say("critical loads: missed/all, by distance in ln W0 to the nearest other one")
    report.table(["eps", "lines", *head, "only in default", "no orbit", "CPU s a line", "dense"], rows)
    report.say(f"missed in all: {total.missed.sum()} of {total.all.sum()} ({total.missed.sum() / max(1, total.all.sum()):.2%})")
    for line in said:
        report.say(line)


if __name__ == "__main__":
    main()
