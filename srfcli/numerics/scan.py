"""The growth rate of a forced periodic state along a line of one parameter, refined where a sign change could hide.

g = ln |leading multiplier| over one forcing period. Between two samples a pair of crossings can hide only where |g| is small
against the error of interpolating it; there the line is halved, down to a stated resolution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array, ComplexArray, Discretisation, join, mesh_error, wanted_mesh
from srfcli.numerics.orbit import OrbitBatch, forced_guess, interpolate, solve_orbits, steady_guess, uniform_mesh

MESH_ERROR = 1e-5  # a hump of g lower than this cannot be told from none
FINEST = 64
FIRST_CLIMB, SMALLEST_CLIMB = 0.25, 2e-3  # steps in which eps is raised to its value, as shares of it
CLIMBING = 12  # Newton steps at each
ALMOST = 1 - 1e-12  # of eps
ROUGHEST = 0.1  # estimated error of a climbed state's multipliers on its mesh; the true one is a hundredth of that


@dataclass
class LineScan:
    """Samples along `name` (rising `values`): multipliers (B, n), `g` (B,), the orbits, and the resolution reached."""

    name: str
    p: Array
    values: Array
    multipliers: ComplexArray
    g: Array
    orbit: Discretisation
    resolution: float

    @property
    def lost(self) -> Array:
        """Return the values at which no orbit was found."""
        return self.values[~np.isfinite(self.g)]

    def brackets(self) -> list[int]:
        """Return the indices i for which g changes sign between values[i] and values[i+1]."""
        g = self.g
        return [
            int(i)
            for i in np.nonzero(np.isfinite(g[:-1]) & np.isfinite(g[1:]) & (g[:-1] * g[1:] <= 0) & (g[:-1] != 0))[0]
        ]


def growth(batch: OrbitBatch) -> tuple[ComplexArray, Array]:
    """Return the multipliers and ln |leading multiplier| of a batch, NaN where the orbit was not found."""
    multipliers = batch.multipliers
    return multipliers, np.log(np.abs(multipliers[:, 0]))


def robust_orbits(
    model: GeneratedModel, p: Array, guess: Discretisation | None, edges: Array, *, tol: float = 1e-7
) -> OrbitBatch:
    """Return orbits at `p`, from `guess`, else from the linear response, else by raising eps in steps."""
    batch = solve_orbits(model, p, guess or forced_guess(model, p, edges), tol=tol, max_iterations=14 if guess else 40)
    if guess is not None and not batch.converged.all():
        bad = np.nonzero(~batch.converged)[0]
        batch.replace(bad, solve_orbits(model, p[:, bad], forced_guess(model, p[:, bad], edges), tol=tol))
    if not batch.converged.all():
        bad = np.nonzero(~batch.converged)[0]
        batch.replace(bad, climbed(model, p[:, bad], edges, tol=tol))
    return batch


def climbed(model: GeneratedModel, p: Array, edges: Array, *, tol: float = 1e-7) -> OrbitBatch:
    """Return orbits at `p` (n_parameters, B) by raising eps from 0, each in steps of its own that are halved where one fails.

    One that the mesh is too coarse for has not converged: a finer one may be climbed to.
    """
    eps, B = model.index("eps"), p.shape[1]
    calm = p.copy()
    calm[eps] = 0.0
    batch = solve_orbits(model, calm, steady_guess(model, calm, edges), tol=tol)
    slope_x, slope_stages = np.zeros_like(batch.orbit.x), np.zeros_like(batch.orbit.stages)
    reached, step = np.zeros(B), np.full(B, FIRST_CLIMB)
    going = batch.converged.copy()
    while going.any():
        at = np.nonzero(going)[0]
        step[at] = np.minimum(step[at], 1.0 - reached[at])
        q, ahead = p[:, at].copy(), step[at][:, None, None]
        q[eps] *= reached[at] + step[at]
        before = batch.orbit.part(at)
        guess = Discretisation(
            before.x + ahead * slope_x[at], before.stages + ahead[..., None] * slope_stages[at], edges
        )
        found = solve_orbits(model, q, guess, tol=tol, max_iterations=CLIMBING)
        new, got, lost = np.nonzero(found.converged)[0], at[found.converged], at[~found.converged]
        slope_x[got] = (found.orbit.x[new] - before.x[new]) / ahead[new]
        slope_stages[got] = (found.orbit.stages[new] - before.stages[new]) / ahead[new][..., None]
        batch.replace(got, found.part(new))
        reached[got] += step[got]
        step[got] *= 1.5
        step[lost] /= 2
        going = batch.converged & (reached < ALMOST) & (step > SMALLEST_CLIMB)
    batch.p[:] = p
    batch.converged &= reached >= ALMOST
    batch.converged[batch.converged] = mesh_error(model, batch.orbit)[batch.converged] < ROUGHEST
    return batch


def scan_line(
    model: GeneratedModel,
    base: Array,
    name: str,
    values: Array,
    *,
    intervals: int = 24,
    guess: Discretisation | None = None,
    resolution: float = 1e-3,
    log: bool = True,
) -> LineScan:
    """Return the growth rate along parameter `name` through `values` (rising), at the other parameters of `base` (n_parameters,).

    `resolution` is the smallest spacing, in ln(value) where `log`, that halving reaches.
    """
    p = np.repeat(base[:, None], len(values), axis=1)
    p[model.index(name)] = values
    batch = _on_sufficient_mesh(
        model, robust_orbits(model, p, guess, uniform_mesh(intervals) if guess is None else guess.edges)
    )
    multipliers, g = growth(batch)
    scan = LineScan(name, p, np.asarray(values, float), multipliers, g, batch.orbit, np.inf)
    coordinate = np.log if log else np.asarray
    while True:
        position = coordinate(scan.values)
        wanted = np.nonzero(_suspects(position, scan.g, resolution))[0]
        if not wanted.size:
            break
        scan = halve(model, base, scan, wanted, log=log)
    suspects = _suspects(coordinate(scan.values), scan.g, 0.0)
    gaps = np.diff(coordinate(scan.values))
    scan.resolution = float(gaps[suspects].max()) if suspects.any() else float(resolution)
    return scan


def _on_sufficient_mesh(model: GeneratedModel, batch: OrbitBatch) -> OrbitBatch:
    """Return the batch on a mesh that shows a growth rate as small as MESH_ERROR, up to FINEST intervals."""
    N = len(batch.orbit.edges) - 1
    if batch.converged.all():
        worst = mesh_error(model, batch.orbit).max(keepdims=True)
        mesh = int(wanted_mesh(worst, N, MESH_ERROR, FINEST)[0])
    else:  # a finer mesh may find what this one could not
        mesh = FINEST
    if mesh <= N:
        return batch
    edges = uniform_mesh(mesh)
    return robust_orbits(model, batch.p, interpolate(batch.orbit, edges), edges)


def _suspects(position: Array, g: Array, resolution: float) -> Array:
    """Return for each interval whether a pair of crossings could hide in it and it is wider than twice `resolution`.

    It could where the cubic through the interval's ends and their neighbours comes within its error of zero.
    """
    usable = np.isfinite(g)
    error = interpolation_error(position, g)
    worst = np.maximum(error[:-1], error[1:])
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        nearest = np.minimum(np.minimum(np.abs(g[:-1]), np.abs(g[1:])), _closest_inside(position, g))
        steepness = np.abs(np.diff(g) / np.diff(position))
        around = np.maximum(
            np.maximum(steepness, np.r_[steepness[:1], steepness[:-1]]), np.r_[steepness[1:], steepness[-1:]]
        )
        close = ~(nearest > worst + MESH_ERROR * around)  # the mesh shifts g by about its slope times that
    same_side = np.sign(g[:-1]) == np.sign(g[1:])
    return usable[:-1] & usable[1:] & close & (np.diff(position) > 2 * resolution) & (same_side | (worst > 0.1))


def _closest_inside(position: Array, g: Array) -> Array:
    """Return how near to zero, on its ends' side, the cubic through four samples comes in each interval; below 0 if across."""
    count = len(g) - 1
    first = np.clip(np.arange(count) - 1, 0, max(count - 3, 0))
    window = first[:, None] + np.arange(min(4, len(g)))
    xs, ys = position[window], g[window]  # (intervals, 4)
    at = position[:-1, None] + np.diff(position)[:, None] * np.linspace(0.1, 0.9, 9)
    value = np.zeros_like(at)
    for i in range(xs.shape[1]):
        basis = np.ones_like(at)
        for j in range(xs.shape[1]):
            if j != i:
                basis *= (at - xs[:, j, None]) / (xs[:, i, None] - xs[:, j, None])
        value += ys[:, i, None] * basis
    return (value * np.sign(g[:-1])[:, None]).min(axis=1)


def interpolation_error(position: Array, g: Array) -> Array:
    """Return for each sample how far it lies from the cubic through its two neighbours on either side, 0 where those lack."""
    error = np.zeros_like(g)
    if len(g) < 5:
        return error
    middle = position[2:-2]
    around = [position[:-4], position[1:-3], position[3:-1], position[4:]]
    values = [g[:-4], g[1:-3], g[3:-1], g[4:]]
    estimate = np.zeros_like(middle)
    for i, (xi, gi) in enumerate(zip(around, values, strict=True)):
        basis = np.ones_like(middle)
        for j, xj in enumerate(around):
            if j != i:
                basis *= (middle - xj) / (xi - xj)
        estimate += gi * basis
    error[2:-2] = np.nan_to_num(np.abs(g[2:-2] - estimate))
    error[:2], error[-2:] = error[2], error[-3]
    return error


def halve(model: GeneratedModel, base: Array, scan: LineScan, wanted: Array, *, log: bool) -> LineScan:
    """Return `scan` with the intervals `wanted` halved."""
    a, b = scan.values[wanted], scan.values[wanted + 1]
    middle = np.sqrt(a * b) if log else 0.5 * (a + b)
    left, right = scan.orbit.part(wanted), scan.orbit.part(wanted + 1)
    guess = Discretisation(0.5 * (left.x + right.x), 0.5 * (left.stages + right.stages), scan.orbit.edges)
    p = np.repeat(base[:, None], len(middle), axis=1)
    p[model.index(scan.name)] = middle
    batch = robust_orbits(model, p, guess, scan.orbit.edges)
    multipliers, g = growth(batch)
    values = np.concatenate([scan.values, middle])
    order = np.argsort(values)
    return LineScan(
        scan.name,
        np.concatenate([scan.p, p], axis=1)[:, order],
        values[order],
        np.concatenate([scan.multipliers, multipliers])[order],
        np.concatenate([scan.g, g])[order],
        join([scan.orbit, batch.orbit]).part(order),
        scan.resolution,
    )
