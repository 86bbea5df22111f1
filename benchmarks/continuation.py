"""Milliseconds a point of the stability boundary from V = 1 to 100 um/s at 1e-6: eps = 0.09, eps = 0.18 both components.

Timed: `trace` (pseudo-arclength continuation both ways from a polished starting point to the window's edges, every point with
its tangent) and `polish_curve` (each point moved along the curve's normal until its estimated error is below 1e-6), apart and
together, divided by the points they yield; then the whole of `find_components` with its default settings: ten scanned
lines, the starting points, all components and their polish. CPU seconds, one thread, median of interleaved repeats.

Not timed: imports and loading the model (benchmarks/startup.py), writing, plotting. For `trace` and `polish_curve` the
start is given, as AUTO's was.

Error: every point polished again along the same normal at 1e-10 on up to 1024 intervals; the distance in ln(V), ln(W0) that it
moves. That shares the code; so a sample away from folds is also set against brute force (shooting with DOP853 at rtol 1e-11,
tests/brute.py, a secant in W0), which shares none. Both include the mesh's error and Newton's.

AUTO-07p's figures are quoted from earlier measurements on the same problem, on another run and perhaps another machine; they
are not measured here. `--profile` prints where the time of `find_components` at eps = 0.18 goes instead.
"""

from __future__ import annotations

import cProfile
import io
import pstats
import sys
import time
from dataclasses import replace
from functools import partial

import common  # before NumPy: it fixes the number of threads
import numpy as np
from brute import Slider, error_of_load
from common import Report, interleaved

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.laws.registry import load_registry
from srfcli.numerics.continuation import (
    Branch,
    ContinuationSettings,
    Curve,
    CurvePoint,
    correct,
    find_components,
    polish_curve,
    trace,
)
from srfcli.numerics.critical import critical_line
from srfcli.numerics.plane import Axis, Plane

REPEATS = 5
TARGET = 3.0
SETTINGS = ContinuationSettings()
SAMPLE = 5  # points of each curve that brute force checks
STEEP = 0.1  # d ln|rho| / d ln(W0): below it W0 at fixed V is no measure of a point
CURVES = {  # eps, V of the line where the curve starts, number of the crossing there, AUTO-07p's ms a point
    "eps 0.09": (0.09, 10.0, 1, "9"),
    "eps 0.18 lower": (0.18, 10.0, 1, "11"),
    "eps 0.18 upper": (0.18, 100.0, 1, "14 to 28"),
}


def window(model: GeneratedModel, eps: float) -> Plane:
    """Return the plane of the paper's figure 2 and more."""
    return Plane(model.vector({"eps": eps}), Axis("V", 1.0, 100.0), Axis("W0", 4.0, 400.0))


def starting_point(model: GeneratedModel, eps: float, V: float, crossing: int) -> CurvePoint:
    """Return a corrected point on the boundary with its tangent."""
    line = critical_line(model, model.vector({"eps": eps, "V": V}), lo=4.0, hi=400.0, tol=SETTINGS.steps.mesh_error)
    found, plane = line.points[crossing - 1], window(model, eps)
    q = plane.coordinates(model, found.p)
    zero = np.zeros(found.orbit.x.shape[-1])
    point = correct(model, plane, q, found.orbit.part(np.array(0)), found.rho, np.array([1.0, 0.0]), zero)
    assert point is not None
    return point


def follow(model: GeneratedModel, plane: Plane, start: CurvePoint) -> Curve:
    """Return the whole curve through `start`."""
    return trace(model, plane, start, SETTINGS.steps)


def whole(model: GeneratedModel, plane: Plane) -> list[Branch]:
    """Return all components, as `srf continue` finds them."""
    *_, boundary = find_components(model, plane, SETTINGS)
    return boundary.branches


def moved(model: GeneratedModel, plane: Plane, curve: Curve) -> np.ndarray:
    """Return how far, in ln(V) and ln(W0), each polished point lies from the same point polished at 1e-10."""
    fine = replace(SETTINGS, tol=1e-10, max_mesh=1024)
    coarse, exact = (
        np.array(
            [[pt.value(model, name) for name in plane.names] for b in polish_curve(model, plane, curve, s) for pt in b.points]
        )
        for s in (SETTINGS, fine)
    )
    if coarse.shape != exact.shape:
        raise SystemExit("the two polishes do not return the same points")
    return np.linalg.norm(np.log(coarse / exact), axis=1)


def distance(model: GeneratedModel, plane: Plane, curve: Curve, start: CurvePoint) -> float:
    """Return how far the true curve strays from the polyline through a curve's points, as a share of the window.

    The true curve is followed in steps that are eight times shorter and turn a fifth as much.
    """
    steps = SETTINGS.steps
    careful = replace(steps, first=steps.first / 8, largest=steps.largest / 8, turn=0.05, max_steps=100_000)
    fine = trace(model, plane, start, careful)
    a, b = curve.q[:-1], curve.q[1:]
    along = b - a
    farthest = 0.0
    for point in fine.q:
        share = np.clip(((point - a) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
        farthest = max(farthest, float(np.linalg.norm(a + share[:, None] * along - point, axis=1).min()))
    return farthest


def brute_errors(model: GeneratedModel, eps: float, branches: list[Branch]) -> list[float]:
    """Return the relative error of W0 of a sample of points, none of them beside a fold, by brute force."""
    points = [pt for b in branches for pt in b.points if abs(pt.slope) > STEEP]
    chosen = points[:: max(1, len(points) // SAMPLE)][:SAMPLE]
    sliders = [Slider(pt.value(model, "V"), pt.value(model, "W0"), eps) for pt in chosen]
    return [abs(error_of_load(s, pt.orbit.x[0, 0])[0]) for s, pt in zip(sliders, chosen, strict=True)]


def profile(model: GeneratedModel) -> None:
    """Print where the time of the whole search at eps = 0.18 goes."""
    plane, recorder, text = window(model, 0.18), cProfile.Profile(), io.StringIO()
    whole(model, plane)
    recorder.runcall(whole, model, plane)
    statistics = pstats.Stats(recorder, stream=text).strip_dirs()
    statistics.sort_stats("cumulative").print_stats(30)
    statistics.sort_stats("tottime").print_stats(20)
    print(text.getvalue())


def main() -> None:
    """Time and check the curves, print three tables."""
    model = open_model(load_registry())
    if "--profile" in sys.argv:
        profile(model)
        return
    report = Report("continuation", __doc__)
    assert common.ROOT.exists()
    planes = {name: window(model, eps) for name, (eps, *_) in CURVES.items()}
    starts = {name: starting_point(model, eps, V, k) for name, (eps, V, k, _) in CURVES.items()}
    curves = {name: follow(model, planes[name], starts[name]) for name in CURVES}
    branches = {name: polish_curve(model, planes[name], curves[name], SETTINGS) for name in CURVES}
    tasks = {}
    for name in CURVES:
        tasks[f"{name} trace"] = partial(follow, model, planes[name], starts[name])
        tasks[f"{name} polish"] = partial(polish_curve, model, planes[name], curves[name], SETTINGS)
    for eps in (0.09, 0.18):
        tasks[f"whole {eps}"] = partial(whole, model, window(model, eps))
    begun = time.process_time()
    seconds = interleaved(tasks, REPEATS)
    rows, missed = [], []
    for name, (_, _, _, auto) in CURVES.items():
        count = sum(len(b.points) for b in branches[name])
        both = 1e3 * (seconds[f"{name} trace"] + seconds[f"{name} polish"]) / count
        parts = [1e3 * seconds[f"{name} {part}"] / count for part in ("trace", "polish")]
        far = f"{distance(model, planes[name], curves[name], starts[name]):.1e}"
        ends = f"{curves[name].start.name.lower()}, {curves[name].end.name.lower()}"
        rows.append([name, count, *(f"{ms:.2f}" for ms in (*parts, both)), f"{count * both / 1e3:.2f}", far, auto, ends])
        missed += [name] if both >= TARGET else []
    report.say()
    head = [
        "curve",
        "points",
        "trace ms/pt",
        "polish ms/pt",
        "both ms/pt",
        "whole curve s",
        "polyline off",
        "AUTO-07p ms/pt (quoted)",
        "ends",
    ]
    report.table(head, rows)
    report.say(f"target: under {TARGET:g} ms a point on all of them: {'MISSED on ' + ', '.join(missed) if missed else 'met'}")
    report.say()
    rows = []
    for eps in (0.09, 0.18):
        found = whole(model, window(model, eps))
        count, time_all = sum(len(b.points) for b in found), seconds[f"whole {eps}"]
        rows.append([f"eps {eps}", len(found), count, f"{time_all:.2f}", f"{1e3 * time_all / count:.2f}"])
    report.table(["find_components", "components", "points", "CPU s", "ms/pt with search and start"], rows)
    report.say()
    rows = []
    for name, (eps, *_) in CURVES.items():
        error = moved(model, planes[name], curves[name])
        brute = brute_errors(model, eps, branches[name])
        estimates = [pt.error for b in branches[name] for pt in b.points]
        bad = sum(not pt.status.ok for b in branches[name] for pt in b.points)
        quantiles = [f"{q:.1e}" for q in (np.median(error), np.quantile(error, 0.99), error.max())]
        above = int((error > 1e-6).sum())
        rows.append([name, *quantiles, above, bad, f"{max(estimates):.1e}", len(brute), f"{max(brute):.1e}"])
    head = [
        "error",
        "median",
        "99 %",
        "largest",
        "above 1e-6",
        "status not ok",
        "largest estimate",
        "brute points",
        "brute largest",
    ]
    report.table(head, rows)
    report.say(f"({time.process_time() - begun:.0f} s of CPU in all)")


if __name__ == "__main__":
    main()
