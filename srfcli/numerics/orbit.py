"""Forced periodic states: first guesses, Newton's method on the condensed collocation equations, and a robust search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from srfcli.codegen.model import Array, ComplexArray, GeneratedModel
from srfcli.motion.imposed import lagrange
from srfcli.numerics.collocation import (
    LOG_STEP,
    STAGES,
    Discretisation,
    condense,
    gauss,
    kernel,
    mesh_error,
    newton_orbits,
    respond,
    solved,
)

CHUNK = 48  # parameter points solved together: their blocks fit the cache
LARGEST_SWING = 2.0  # of a logarithm in the linear response that is a first guess
STRIDE = 8  # of points in order, orbits solved without neighbours are this many apart
GUESSED_FROM = 6  # through which a first guess is interpolated


@dataclass
class OrbitBatch:
    """Orbits at the points `p` (n_parameters, ...); `converged` marks those whose last Newton step was below the tolerance."""

    p: Array
    orbit: Discretisation
    monodromy: Array
    converged: Array

    @classmethod
    def empty(cls, p: Array, edges: Array, n: int) -> OrbitBatch:
        """Return a batch for the points `p`, with `n` unknowns, in which no orbit is known yet."""
        shape, N = p.shape[1:], len(edges) - 1
        x, stages = np.full((*shape, N, n), np.nan), np.full((*shape, N, STAGES, n), np.nan)
        return cls(p, Discretisation(x, stages, edges), np.full((*shape, n, n), np.nan), np.zeros(shape, bool))

    @property
    def multipliers(self) -> ComplexArray:
        """Return the Floquet multipliers (..., n), largest modulus first; NaN where the orbit did not converge."""
        usable: Any = self.converged & np.isfinite(self.monodromy).all(axis=(-1, -2))
        matrix = np.where(usable[..., None, None], self.monodromy, np.eye(self.monodromy.shape[-1]))
        values = np.linalg.eigvals(matrix).astype(complex)
        values = np.take_along_axis(values, np.argsort(-np.abs(values), axis=-1, kind="stable"), axis=-1)
        values[~usable] = np.nan
        return values

    def part(self, index: Any) -> OrbitBatch:
        """Return the orbits that `index` selects."""
        p = self.p[:, *index] if isinstance(index, tuple) else self.p[:, index]
        return OrbitBatch(p, self.orbit.part(index), self.monodromy[index], self.converged[index])

    def replace(self, index: Array | tuple[Array, ...], other: OrbitBatch) -> None:
        """Put the orbits of `other` in the place of those at `index`, whatever became of them."""
        self.orbit.x[index], self.orbit.stages[index] = other.orbit.x, other.orbit.stages
        self.monodromy[index], self.converged[index] = other.monodromy, other.converged


def scales(model: GeneratedModel, p: Array) -> Array:
    """Return the size of each unknown, (..., n): logarithms 1, velocities V, lengths 1 um."""
    size = np.ones((*p.shape[1:], len(model.states)))
    if "z" in model.states:
        size[..., model.states.index("z")] = p[model.index("V")]
    return size


def uniform_mesh(intervals: int) -> Array:
    """Return the edges of `intervals` equal intervals of one period."""
    return np.linspace(0.0, 1.0, intervals + 1)


def steady_guess(model: GeneratedModel, p: Array, edges: Array) -> Discretisation:
    """Return steady sliding under the mean load as a first guess of the orbit."""
    rest = model.steady(p)
    N, n = len(edges) - 1, rest.shape[-1]
    x = np.broadcast_to(rest[..., None, :], (*rest.shape[:-1], N, n)).copy()
    stages = np.broadcast_to(rest[..., None, None, :], (*rest.shape[:-1], N, STAGES, n)).copy()
    return Discretisation(x, stages, edges)


def forced_guess(model: GeneratedModel, p: Array, edges: Array) -> Discretisation:
    """Return steady sliding with its linear response to the modulation as a first guess of the orbits at `p` (n_parameters, B).

    The response is scaled down where a logarithm would swing by more than LARGEST_SWING either way.
    """
    guess = steady_guess(model, p, edges)
    rest, n = model.steady(p), len(model.states)
    calm = model.with_values(p, eps=0.0)
    tau = np.arange(16) / 16
    field = model.cycle(tau, np.broadcast_to(rest[..., None, :], (*rest.shape[:-1], 16, n)), p[..., None])
    forcing = np.fft.fft(field, axis=-2)[..., 1, :] / 8
    matrix = 2j * np.pi * np.eye(n) - model.cycle_jacobian(0.0, rest, calm)
    response = np.linalg.solve(matrix, forcing[..., None])[..., 0]
    swing = np.abs(response[..., np.array(model.logarithmic)]).max(axis=-1)
    response *= np.minimum(1.0, LARGEST_SWING / np.maximum(swing, 1e-300))[..., None]
    guess.x += (np.exp(2j * np.pi * edges[:-1])[:, None] * response[..., None, :]).real
    guess.stages += (np.exp(2j * np.pi * guess.phases)[..., None] * response[..., None, None, :]).real
    return guess


def interpolate(orbit: Discretisation, edges: Array) -> Discretisation:
    """Return `orbit` evaluated on another mesh by its own collocation polynomials."""
    nodes = np.concatenate([[0.0], gauss().nodes])
    phases = edges[:-1, None] + np.diff(edges)[:, None] * gauss().nodes

    def at(tau: Array) -> Array:
        cell = np.clip(np.searchsorted(orbit.edges, tau, side="right") - 1, 0, len(orbit.edges) - 2)
        s = (tau - orbit.edges[cell]) / orbit.steps[cell]
        values = np.concatenate([orbit.x[..., None, :], orbit.stages], axis=-2)[..., cell, :, :]
        return np.einsum("...k,...kn->...n", lagrange(nodes, s), values)

    return Discretisation(at(edges[:-1]), at(phases), edges)


def levels(count: int, stride: int = STRIDE) -> list[Array]:
    """Return indices 0..count-1 in the order in which they are filled: every `stride`-th with the last, halved until all."""
    seen = np.zeros(count, bool)
    found = []
    while stride >= 1:
        wanted = np.zeros(count, bool)
        wanted[::stride] = wanted[-1] = True
        found.append(np.nonzero(wanted & ~seen)[0])
        seen |= wanted
        stride //= 2
    return [level for level in found if level.size]


def neighbours(known: Array, new: Array, most: int = GUESSED_FROM) -> tuple[Array, Array]:
    """Return the indices of the `most` rising positions `known` around each position `new`, and their Lagrange weights."""
    width = min(most, len(known))
    first = np.clip(np.searchsorted(known, new) - width // 2, 0, len(known) - width)
    index = first[:, None] + np.arange(width)  # (new, width)
    return index, lagrange(known[index], new)


def combined(orbits: Discretisation, weights: Array) -> Discretisation:
    """Return the sums over k of orbits (B, k, N, ...) times their weights (B, k)."""
    return Discretisation(
        np.einsum("bk,bkNn->bNn", weights, orbits.x), np.einsum("bk,bkNmn->bNmn", weights, orbits.stages), orbits.edges
    )


def between(orbit: Discretisation, known: Array, new: Array, most: int = GUESSED_FROM) -> Discretisation:
    """Return guesses at positions `new` through the orbits (B, N, ...) at the rising positions `known` (B,)."""
    index, weights = neighbours(known, new, most)
    return combined(orbit.part(index), weights)


def step_limit(model: GeneratedModel, dx: Array, stages: Array) -> Array:
    """Return the factor (...,) that keeps every logarithm's change within LOG_STEP."""
    logs = np.array(model.logarithmic)
    largest = np.maximum(np.abs(dx[..., logs]).max(axis=(-1, -2)), np.abs(stages[..., logs]).max(axis=(-1, -2, -3)))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.minimum(1.0, LOG_STEP / largest)


def solve_orbits(
    model: GeneratedModel, p: Array, guess: Discretisation, *, tol: float = 1e-9, max_iterations: int = 40
) -> OrbitBatch:
    """Return the periodic orbits at the parameter points `p` (n_parameters, B) from `guess`; finished ones leave the batch.

    A point that does not converge in `max_iterations` keeps its last iterate and is marked so.
    """
    library, size = kernel(model), np.ascontiguousarray(scales(model, p))
    found = OrbitBatch.empty(p, guess.edges, len(model.states))
    found.orbit.x[:], found.orbit.stages[:] = guess.x, guess.stages
    for a in range(0, p.shape[1], CHUNK):
        cut = slice(a, a + CHUNK)
        if library is None:
            _newton(model, found, np.arange(len(size))[cut], size, tol, max_iterations)
            continue
        found.monodromy[cut], found.converged[cut] = newton_orbits(
            library, p[:, cut], found.orbit.part(cut), size[cut], tol, max_iterations
        )
    return found


def _newton(model: GeneratedModel, batch: OrbitBatch, active: Array, size: Array, tol: float, max_iterations: int) -> None:
    """Bring the orbits `active` of a batch to convergence in place, as the compiled equations do."""
    for _ in range(max_iterations):
        with np.errstate(all="ignore"):  # a diverging point overflows; it is dropped below
            linear = condense(model, batch.p[:, active], batch.orbit.part(active))
            M, n = linear.monodromy, size.shape[-1]
            start = solved(np.eye(n) - M, linear.prefix[..., -1, :n, n:])
            head = np.concatenate([start, np.ones_like(start[..., :1, :])], axis=-2)
            dx, dstages = (change[..., 0] for change in respond(linear, head))
            finite: Any = np.isfinite(M).all(axis=(-1, -2)) & np.isfinite(dx).all(axis=(-1, -2))
            finite &= np.isfinite(dstages).all(axis=(-1, -2, -3))
            limit = step_limit(model, dx, dstages)
            change = (np.abs(dx) / size[active][:, None, :]).max(axis=(-1, -2))
        limit = np.where(finite, limit, 0.0)
        batch.orbit.x[active] += limit[:, None, None] * np.where(finite[:, None, None], dx, 0.0)
        batch.orbit.stages[active] += limit[:, None, None, None] * np.where(finite[:, None, None, None], dstages, 0.0)
        batch.monodromy[active] = M
        done = finite & (change < tol)
        batch.converged[active[done]] = True
        active = active[finite & ~done]
        if not active.size:
            break


# Orbits wherever they can be found: from guesses, from each other, or by raising eps from 0.

FIRST_CLIMB, SMALLEST_CLIMB = 0.25, 2e-3  # steps in which eps is raised to its value, as shares of it
CLIMBING = 12  # Newton steps at each
ALMOST = 1 - 1e-12  # of eps
ROUGHEST = 0.1  # estimated error of a climbed state's multipliers on its mesh; the true one is a hundredth of that


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


def line_orbits(model: GeneratedModel, p: Array, position: Array, guess: Discretisation | None, edges: Array) -> OrbitBatch:
    """Return what `robust_orbits` does at points in order, at rising `position` (B,) along a line.

    A few that are spread over the line come first; the others start from what was found around them.
    """
    count, stride = p.shape[1], STRIDE
    while stride > 1 and count < stride * GUESSED_FROM:  # fewer to start from would predict little
        stride //= 2
    first, *later = levels(count, stride)
    orbits = OrbitBatch.empty(p, edges, len(model.states))
    orbits.replace(first, robust_orbits(model, p[:, first], None if guess is None else guess.part(first), edges))
    for level in later:
        known = np.nonzero(orbits.converged)[0]
        near = between(orbits.orbit.part(known), position[known], position[level]) if known.size else None
        orbits.replace(level, robust_orbits(model, p[:, level], near, edges))
    return orbits


def climbed(model: GeneratedModel, p: Array, edges: Array, *, tol: float = 1e-7) -> OrbitBatch:
    """Return orbits at `p` (n_parameters, B) by raising eps from 0, each in steps of its own that are halved where one fails.

    One that the mesh is too coarse for has not converged: a finer one may be climbed to.
    """
    eps, calm = p[model.index("eps")], model.with_values(p, eps=0.0)
    batch = solve_orbits(model, calm, steady_guess(model, calm, edges), tol=tol)
    slope = batch.orbit.unchanged()
    reached, step = np.zeros(p.shape[1]), np.full(p.shape[1], FIRST_CLIMB)
    going = batch.converged.copy()
    while going.any():
        at = np.nonzero(going)[0]
        step[at] = np.minimum(step[at], 1.0 - reached[at])
        q = model.with_values(p[:, at], eps=eps[at] * (reached[at] + step[at]))
        before = batch.orbit.part(at)
        found = solve_orbits(model, q, before + step[at] * slope.part(at), tol=tol, max_iterations=CLIMBING)
        new, got, lost = np.nonzero(found.converged)[0], at[found.converged], at[~found.converged]
        change = (1 / step[got]) * (found.orbit.part(new) - before.part(new))
        slope.x[got], slope.stages[got] = change.x, change.stages
        batch.replace(got, found.part(new))
        reached[got] += step[got]
        step[got] *= 1.5
        step[lost] /= 2
        going = batch.converged & (reached < ALMOST) & (step > SMALLEST_CLIMB)
    batch.p[:] = p
    batch.converged &= reached >= ALMOST
    batch.converged[batch.converged] = mesh_error(model, batch.orbit)[batch.converged] < ROUGHEST
    return batch
