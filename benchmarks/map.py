"""What a stability map costs: against one orbit at a time, against shooting, and how cost and memory grow.

The map is V = 1 to 100 um/s, K/W0 = 0.005 to 0.03 /um at eps = 0.18, with its refinement. Its rivals are sampled at random points
of the map, in the same run. One orbit at a time from scratch: `solve_floquet`, which finds its own mesh, to a multiplier error of
1e-4; and `solve_orbits` from the linear response, to the map's own tolerance on the mesh that the map found, which is given.
Shooting with SciPy's Radau, DOP853 and LSODA (benchmarks/orbit.py) at the loosest tolerance that is as good as the map. CPU
seconds, one thread. Memory is the peak of a fresh process. Two workers: the tiles' CPU seconds as two processes share them, and
the whole command with one and with two.
"""

from __future__ import annotations

import cProfile
import pstats
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from statistics import median
from typing import Any

import common  # before NumPy: it fixes the number of threads
import numpy as np
from brute import Slider, steady
from common import Report
from orbit import shoot

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.laws.registry import load_registry
from srfcli.numerics.floquet import solve_floquet
from srfcli.numerics.map import StabilityMap, compute_map
from srfcli.numerics.map_boundaries import find_boundaries
from srfcli.numerics.orbit import forced_guess, robust_orbits, solve_orbits, uniform_mesh
from srfcli.numerics.plane import MapAxis, MapGrid, MapSettings

EPS = 0.18
SIZES = ((30, 50), (60, 100), (120, 200), (240, 400))
SAMPLES, SHOTS = 300, 12
SEED = 11
RTOLS = (1e-3, 1e-4, 1e-5, 1e-6)


def grid_of(model: GeneratedModel, columns: int, rows: int) -> MapGrid:
    """Return the window with so many points."""
    return MapGrid(model.vector({"eps": EPS}), MapAxis("V", 1.0, 100.0, columns), MapAxis("W0", 0.005, 0.03, rows, False, "K"))


def timed_map(model: GeneratedModel, columns: int, rows: int, **settings: int) -> tuple[StabilityMap, float]:
    """Return the map and its CPU seconds."""
    begun = time.process_time()
    found = compute_map(model, grid_of(model, columns, rows), MapSettings(**settings))
    return found, time.process_time() - begun


def one_at_a_time(model: GeneratedModel, found: StabilityMap, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return CPU seconds a point of `solve_floquet` and of `solve_orbits`, and their worst difference from the map."""
    p, shape = found.points(model), found.leading.shape
    whole = given = worst = 0.0
    for _ in range(SAMPLES):
        i, j = int(rng.integers(shape[0])), int(rng.integers(shape[1]))
        edges, q = uniform_mesh(int(found.mesh[i, j])), p[:, i, j][:, None]
        begun = time.process_time()
        batch = solve_orbits(model, q, forced_guess(model, q, edges), tol=found.settings.tol)
        rho = batch.multipliers[0, 0]
        middle = time.process_time()
        solve_floquet(model, p[:, i, j], tol=1e-4)
        given, whole = given + middle - begun, whole + time.process_time() - middle
        worst = max(worst, abs(float(np.log(np.abs(rho))) - float(found.growth[i, j])))
    return whole / SAMPLES, given / SAMPLES, worst


def shoot_by(slider: Slider, method: str, target: float, truth: float) -> float | None:
    """Return CPU seconds of shooting at the loosest tolerance whose growth rate is within `target` of `truth`, else None."""
    for rtol in RTOLS:
        begun = time.process_time()
        try:
            with np.errstate(all="ignore"):  # a start too far away overflows
                _, multipliers, _ = shoot(slider, steady(slider), method, rtol, 1e-3)
        except (ArithmeticError, AssertionError, ValueError, np.linalg.LinAlgError):
            continue
        if abs(float(np.log(np.abs(multipliers).max())) - truth) <= target:
            return time.process_time() - begun
    return None


def shots(model: GeneratedModel, found: StabilityMap, rng: np.random.Generator, report: Report) -> dict[str, float]:
    """Return the median CPU seconds of shooting at random points, loosest tolerance that is as good as the map, by method."""
    p, shape = found.points(model), found.leading.shape
    seen: dict[str, list[float]] = {}
    lost: dict[str, int] = {}
    for _ in range(SHOTS):
        i, j = int(rng.integers(shape[0])), int(rng.integers(shape[1]))
        q = p[:, i, j]
        fine = robust_orbits(model, q[:, None], None, uniform_mesh(96), tol=1e-11)
        truth = float(np.log(np.abs(fine.multipliers[0, 0])))
        target = max(1e-4, abs(float(found.growth[i, j]) - truth))
        slider = Slider(V=float(q[model.index("V")]), W0=float(q[model.index("W0")]), eps=EPS)
        for method in ("Radau", "DOP853", "LSODA"):
            spent = shoot_by(slider, method, target, truth)
            if spent is None:
                lost[method] = lost.get(method, 0) + 1
            else:
                seen.setdefault(method, []).append(spent)
    for method, count in lost.items():
        report.say(f"  ({method}: shooting from steady sliding did not get there at {count} of {SHOTS} points)")
    return {method: float(np.median(values)) for method, values in seen.items()}


PARTS = {
    "Newton's equations, compiled": ("newton_orbits", "linearised"),
    "generated field and Jacobian in NumPy": ("cycle", "cycle_jacobian", "steady"),
    "multipliers": ("eigvals", "multipliers", "det"),
    "first guesses": ("along_rows", "along_columns", "neighbours", "forced_guess", "put", "fill"),
}


def two_workers(report: Report) -> None:
    """Say how two workers share the tiles of 24,000 points, and what the whole command takes with one and with two."""
    model, seconds = open_model(load_registry()), []

    def timed(solve: Callable[..., Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        for task in tasks:
            begun = time.process_time()
            tile = solve(task)
            seconds.append(time.process_time() - begun)
            yield task.index, tile

    compute_map(model, grid_of(model, 120, 200), run=timed)
    loads = [0.0, 0.0]
    for spent in seconds:  # whoever is free takes the next tile
        loads[int(loads[1] < loads[0])] += spent
    report.say()
    report.say(
        f"{len(seconds)} tiles of 24,000 points: {sum(seconds):.2f} s of CPU; two workers get {loads[0]:.2f} and {loads[1]:.2f} s"
    )
    command = [sys.executable, "-m", "srfcli", "map", "--eps", str(EPS), "--over", "V=1:100:120", "--over", "K/W0=0.005:0.03:200"]
    for count in (1, 2):
        spent, wall = [], []
        for _ in range(3):
            before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
            subprocess.run([*command, "--csv", "--workers", str(count)], check=True, capture_output=True, cwd=common.ROOT)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            wall.append(time.monotonic() - begun)
            spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        report.say(
            f"srf map with its boundaries, special points and criticality, --workers {count}: {median(spent):.2f} s of CPU, "
            f"{min(wall):.2f} s by the clock at a load of {common.load():.1f}"
        )


def shares(model: GeneratedModel) -> list[tuple[str, float]]:
    """Return what share of a map's time its parts take, by the profiler, the largest first."""
    profile = cProfile.Profile()
    profile.enable()
    timed_map(model, 60, 100)
    profile.disable()
    own = [(key[2], values[2]) for key, values in pstats.Stats(profile).stats.items()]  # type: ignore[attr-defined]
    total = sum(seconds for _, seconds in own)
    found = [(what, sum(t for name, t in own if name in names) / total) for what, names in PARTS.items()]
    return sorted([*found, ("all else", 1 - sum(share for _, share in found))], key=lambda q: -q[1])


def peak(columns: int, rows: int) -> float:
    """Return the peak memory, in MiB, of a process that computes this map and nothing else."""
    done = subprocess.run(
        [sys.executable, __file__, "--peak", str(columns), str(rows)], capture_output=True, text=True, check=True
    )
    return float(done.stdout.split()[-1])


def say_peak() -> None:
    """Compute a map and print this process's peak memory in MiB."""
    model = open_model(load_registry())
    compute_map(model, grid_of(model, int(sys.argv[2]), int(sys.argv[3])))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def main() -> None:
    """Print costs by size, ratios to the rivals, and where the time goes."""
    report, model = Report("map", __doc__), open_model(load_registry())
    assert common.ROOT.exists()
    report.say()
    rows, kept = [], None
    timed_map(model, 10, 10)  # what is loaded once
    for columns, count in SIZES:
        found, spent = timed_map(model, columns, count)
        points = columns * count
        rows.append(
            [
                f"{columns} x {count}",
                f"{spent:.2f}",
                f"{1e3 * spent / points:.3f}",
                len(found.extra_at),
                f"{peak(columns, count):.0f}",
            ]
        )
        kept = (found, spent) if (columns, count) == (120, 200) else kept
    report.table(["points", "CPU s", "ms a point", "points added", "peak MiB"], rows)
    assert kept is not None
    found, spent = kept
    points, rng = found.leading.size, np.random.default_rng(SEED)
    bare = min(timed_map(model, 120, 200, depth=0)[1] for _ in range(2))
    spent = min(spent, timed_map(model, 120, 200)[1])  # the machine has other users
    begun = time.process_time()
    *_, boundary = find_boundaries(model, found)
    curves = time.process_time() - begun
    report.say()
    report.say(
        f"120 x 200: {spent:.2f} s with its refinement, {bare:.2f} s without; its {len(boundary.branches)} boundaries, polished "
        f"to 1e-6, {curves:.2f} s more"
    )
    report.say("where the time goes: " + ", ".join(f"{what} {share:.0%}" for what, share in shares(model)))
    two_workers(report)
    p = found.points(model)
    i, j = rng.integers(found.leading.shape[0], size=500), rng.integers(found.leading.shape[1], size=500)
    fine = robust_orbits(model, p[:, i, j], None, uniform_mesh(64), tol=1e-10)
    error = np.abs(found.growth[i, j] - np.log(np.abs(fine.multipliers[:, 0])))
    below = f"99 % below {np.quantile(error, 0.99):.1e}, largest {error.max():.1e}"
    report.say(f"error of ln|multiplier| at 500 points: median {np.median(error):.1e}, {below}")
    whole, given, off = one_at_a_time(model, found, rng)
    report.say()
    report.say(f"one orbit at a time, {SAMPLES} points (growth rates differ from the map's by {off:.1e} at most):")
    for name, seconds in (("its own mesh found", whole), ("the map's mesh given", given)):
        times = f"{seconds * points / spent:.1f} times the map, {seconds * points / bare:.1f} times its grid alone"
        report.say(f"  {name}: {1e3 * seconds:.2f} ms a point, {times}")
    report.say(f"  target, 20 times: {'met' if whole * points / spent >= 20 else 'MISSED'}")
    for method, seconds in shots(model, found, rng, report).items():
        report.say(
            f"shooting with solve_ivp({method}): {1e3 * seconds:.0f} ms a point, {seconds * points / spent:.0f} times the map"
        )


if __name__ == "__main__":
    say_peak() if "--peak" in sys.argv else main()
