"""Points of a stability boundary: a multiplier on the unit circle, found to full precision.

The unknowns are the state at tau = 0 and the parameters `names`; the test function is g = ln |rho| of one multiplier, so that
Neimark-Sacker, period-doubling and fold boundaries obey one equation. The gradient of g is exact for the discretised
problem: with right and left eigenvectors carried along the orbit, d rho = sum w . dJ v over the Gauss points, and the
generated bilinear forms supply d(w . J v). The bordered system is regular at folds of the curve and of the orbit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from srfcli.codegen.model import Array, ComplexArray, GeneratedModel
from srfcli.core.errors import Status
from srfcli.numerics.collocation import (
    BoundaryLinear,
    Condensed,
    Discretisation,
    by_mesh,
    condense,
    gauss,
    kernel,
    linearised,
    mesh_error,
    respond,
    running_products,
    solved,
    stack,
    stage_parameters,
    wanted_mesh,
)
from srfcli.numerics.orbit import CHUNK, interpolate, scales, step_limit, uniform_mesh

Names = tuple[str, ...]


def pick_multiplier(multipliers: Array, target: Array) -> Array:
    """Return the index (...,) of the multiplier nearest to `target`, of a conjugate pair the one above the real axis."""
    distance = np.abs(multipliers - target[..., None]) + 1e-9 * (multipliers.imag < 0)
    return np.argmin(distance, axis=-1)


def upper_half(rho: ComplexArray) -> ComplexArray:
    """Return multipliers with those below the real axis replaced by their conjugates."""
    return rho.real + 1j * np.abs(rho.imag)


def linearise_boundary(model: GeneratedModel, p: Array, orbit: Discretisation, names: Names, target: Array) -> BoundaryLinear:
    """Return the linearisation of {periodicity, ln |rho| = 0}; rho is the multiplier nearest to `target` (...,)."""
    library = kernel(model)
    if library is None or orbit.x.ndim == 2:  # one orbit without the batch's axis
        return _linearise(model, p, orbit, names, target)[1]
    found = linearised(library, model, p, orbit, names, np.asarray(target, complex))
    if not found.good.all():
        raise np.linalg.LinAlgError("Singular matrix")
    return found


def periodic_map(model: GeneratedModel, p: Array, orbit: Discretisation, names: Names) -> Array:
    """Return the linearised map over one period less the state, (B, n, n+1+k), of orbits (B, N, ...)."""
    library = kernel(model)
    if library is None:
        return _less_state(condense(model, p, orbit, names))
    return linearised(library, model, p, orbit, names).periodic


def _less_state(condensed: Condensed) -> Array:
    n = condensed.local.shape[-2]
    end = condensed.prefix[..., -1, :n, :].copy()
    end[..., range(n), range(n)] -= 1
    return end


def _linearise(
    model: GeneratedModel, p: Array, orbit: Discretisation, names: Names, target: Array
) -> tuple[Condensed, BoundaryLinear]:
    """Return the condensed collocation equations and, in NumPy, the linearisation that the compiled equations give."""
    condensed = condense(model, p, orbit, names)
    values, right_vectors = np.linalg.eig(condensed.monodromy)
    values, right_vectors = values.astype(complex), right_vectors.astype(complex)
    chosen = pick_multiplier(values, target)
    rho = np.take_along_axis(values, chosen[..., None], -1)[..., 0]
    r = np.take_along_axis(right_vectors, chosen[..., None, None], -1)[..., 0]
    left = left_vector(condensed.monodromy, rho, r)
    growth = _growth_row(model, p, orbit, condensed, names, rho, r, left)
    periodic, nothing = _less_state(condensed), np.empty(0)
    good = np.isfinite(periodic).all(axis=(-1, -2)) & np.isfinite(growth).all(axis=-1)
    return condensed, BoundaryLinear(periodic, rho, growth, np.asarray(good), nothing, nothing, nothing)


def solve_boundary(
    model: GeneratedModel,
    p: Array,
    orbit: Discretisation,
    names: Names,
    target: Array,
    rate: Array,
    across: Array | None,
    *,
    columns: int = 1,
) -> BoundaryLinear:
    """Return Newton's equations of boundary points (B, ...), solved for the state at tau = 0 and distances by `rate` (B, k, d).

    The rows `across` (B, d-1, n+d) close them. A second column is the direction along the curve.
    """
    library = kernel(model)
    if library is not None:
        return linearised(library, model, p, orbit, names, target, rate=rate, across=across, columns=columns)
    with np.errstate(all="ignore"):
        (B, n), d = (len(orbit.x), orbit.x.shape[-1]), rate.shape[-1]
        try:
            condensed, linear = _linearise(model, p, orbit, names, target)
            matrix, right = np.empty((B, n + d, n + d)), np.zeros((B, n + d, columns))
            for row, full in ((np.s_[:, :n], linear.periodic), (np.s_[:, n : n + 1], linear.growth[:, None])):
                matrix[row] = np.concatenate([full[..., :n], full[..., n + 1 :] @ rate], axis=-1)
            if across is not None:
                matrix[:, n + 1 :] = across
            right[:, :n, 0] = -linear.periodic[..., n]
            right[:, n, 0] = -(linear.g + linear.growth[:, n])
            right[:, -1, 1:] = 1.0
            linear.good &= np.isfinite(matrix).all(axis=(-1, -2)) & np.isfinite(right).all(axis=(-1, -2))
            matrix[~linear.good] = np.eye(n + d)
            solution = np.linalg.solve(matrix, right)
        except np.linalg.LinAlgError:  # one singular point spoils the batch
            return BoundaryLinear.unsolved(orbit, len(names), d, columns)
        first = np.broadcast_to(np.eye(columns)[0], (B, 1, columns))
        dx, dstages = respond(condensed, np.concatenate([solution[:, :n], first, rate @ solution[:, n:]], axis=1))
        linear.solution, linear.dx, linear.dstages = (np.moveaxis(a, -1, 0) for a in (solution, dx, dstages))
        return linear


def left_vector(M: Array, rho: Array, r: Array) -> ComplexArray:
    """Return the left eigenvector l (..., n) of M (..., n, n) for its simple eigenvalue rho with right eigenvector r; l . r = 1.

    The bordered system needs nothing of the other eigenvectors, which may coincide where multipliers underflow.
    """
    n = r.shape[-1]
    matrix = np.zeros((*r.shape[:-1], n + 1, n + 1), dtype=complex)
    matrix[..., :n, :n] = np.swapaxes(M, -1, -2)
    index = np.arange(n)
    matrix[..., index, index] -= rho[..., None]
    matrix[..., :n, n], matrix[..., n, :n] = r.conj(), r
    right = np.zeros((*r.shape[:-1], n + 1, 1), dtype=complex)
    right[..., n, 0] = 1.0
    return np.linalg.solve(matrix, right)[..., :n, 0]


def weights_backwards(c: Condensed, l: Array) -> ComplexArray:
    """Return w (..., N, m, n): sum(w * source) is l (..., n) times what y' = J y + source, y(0) = 0, has come to at tau = 1."""
    m, n = c.local.shape[-3:-1]
    # l carried backwards: l_{i+1} = (l G_{N-1} ... G_{i+1}); G_i is the n x n corner of the interval's map
    backwards = running_products(np.swapaxes(c.maps[..., ::-1, :n, :n], -1, -2))  # transposes, from the end
    l_mesh = (backwards[..., -2::-1, :, :] @ l[..., None, :, None])[..., 0]
    seed = (gauss().step[:, None] * l_mesh[..., None, :]).reshape(*l_mesh.shape[:-1], m * n)
    w = np.linalg.solve(np.swapaxes(c.block, -1, -2), np.stack([seed.real, seed.imag], axis=-1))
    return np.asarray((w[..., 0] + 1j * w[..., 1]).reshape(*l_mesh.shape[:-1], m, n))


def _growth_row(
    model: GeneratedModel, p: Array, orbit: Discretisation, c: Condensed, names: Names, rho: Array, r: Array, l: Array
) -> Array:
    """Return the derivative of ln |rho| in (dx_0, residual, dq) as a row (..., n+1+k)."""
    n, k = orbit.x.shape[-1], len(names)
    tau, ps = orbit.phases, stage_parameters(p)
    v_mesh = (c.prefix[..., :-1, :n, :n] @ r[..., None, :, None])[..., 0]  # (..., N, n)
    v = (c.local[..., :n] @ v_mesh[..., None, :, None])[..., 0]  # (..., N, m, n)
    w = weights_backwards(c, l)
    gradient = model.cycle_bilinear(tau, orbit.stages, ps, w, v)  # (..., N, m, n)
    scale = 1 / rho
    weight = (scale[..., None, None, None] * gradient).real
    local = np.einsum("...ja,...jac->...c", weight, c.local)  # (..., N, n+1+k)
    row_total = (local[..., None, :n] @ c.prefix[..., :-1, :n, :])[..., 0, :].sum(axis=-2)
    row_total[..., n:] += local[..., n:].sum(axis=-2)
    for column, name in enumerate(names):
        mixed = model.cycle_bilinear_parameter(name)(tau, orbit.stages, ps, w, v)
        row_total[..., n + 1 + column] += (scale * np.sum(mixed, axis=(-1, -2))).real
    assert row_total.shape[-1] == n + 1 + k
    return row_total


def growth_slopes(linear: BoundaryLinear) -> Array:
    """Return d ln|rho| / d(parameters) (..., k) along the branch of orbits, each with the others fixed; NaN at its fold."""
    n = linear.periodic.shape[-2]
    response = solved(linear.periodic[..., :n], linear.periodic[..., n + 1 :])  # -dx_0/dq
    return linear.growth[..., n + 1 :] - np.einsum("...n,...nk->...k", linear.growth[..., :n], response)


# Boundary points to full precision: Newton's method in one parameter, then meshes doubled until the error is met.

MOST_ITERATIONS = 14
LARGEST_STEP = 0.2  # in ln(parameter): more would leave the bracket's neighbourhood
FINE_TOLERANCE = 3e-8  # a tolerance below this wants the multipliers of the last iterate too
SHALLOW = 0.02  # slopes in ln|rho| per ln(parameter) below this are computed anew


@dataclass(frozen=True)
class Direction:
    """How points may move over the parameters `names`: `vectors` (B, k, d), in the logarithm of those marked `log`.

    With d > 1 the rows `across` (B, d - 1, n + d) close the system: their products with the changes of the state at tau = 0
    and of the d distances are zero.
    """

    names: tuple[str, ...]
    vectors: Array
    log: tuple[bool, ...]
    across: Array | None = None

    def part(self, index: slice | Array) -> Direction:
        """Return the directions of a part of the batch."""
        return Direction(self.names, self.vectors[index], self.log, None if self.across is None else self.across[index])

    def rates(self, values: Array) -> Array:
        """Return dp/d(distances) (B, k, d) at parameter `values` (k, B)."""
        return self.vectors * np.where(np.array(self.log)[:, None], values, 1.0).T[..., None]

    def moved(self, values: Array, distances: Array) -> Array:
        """Return `values` (k, B) moved by `distances` (B, d)."""
        shift = np.einsum("bkd,bd->kb", self.vectors, distances)
        log = np.array(self.log)[:, None]
        return np.where(log, values * np.exp(np.where(log, shift, 0)), values + shift)


def along(name: str, count: int, *, log: bool = True, unit: float = 1.0) -> Direction:
    """Return the direction of ln(name), or of the parameter `name` itself over `unit`, for `count` points."""
    return Direction((name,), np.full((count, 1, 1), unit), (log,))


@dataclass(frozen=True)
class BoundaryPoint:
    """A located point of a stability boundary; `p` in the model's order, `rho` the critical multiplier.

    `error` is the estimated relative error of the parameter that was moved there, `residual` the square of the last step of
    Newton's method, or ln |rho| where it did not converge, `others` the largest modulus among the other multipliers, `slope` is
    d ln|rho| by the logarithm of that parameter, the others fixed: where positive, stability is lost as it rises.
    """

    p: Array
    rho: complex
    error: float
    residual: float
    others: float
    slope: float
    status: Status
    orbit: Discretisation

    @property
    def kind(self) -> str:
        """Return `ns`, `pd` or `fold`: the critical multiplier off the real axis, at -1, at +1."""
        return bifurcation_kind(self.rho)

    @property
    def theta(self) -> float:
        """Return the angle of the critical multiplier over one forcing period, in [0, pi]."""
        return float(abs(np.angle(self.rho)))

    def value(self, model: GeneratedModel, name: str) -> float:
        """Return parameter `name` at this point, in um, s, N."""
        return float(self.p[model.index(name)])


def bifurcation_kind(rho: complex) -> str:
    """Return `ns`, `pd` or `fold` for a multiplier off the real axis, negative, positive."""
    if abs(rho.imag) > 1e-7 * abs(rho):
        return "ns"
    return "pd" if rho.real < 0 else "fold"


@dataclass
class _Polished:
    """Points (B,) on one mesh on their way to the boundary, with what is known of each after its last Newton step."""

    p: Array
    orbit: Discretisation
    rho: ComplexArray
    residual: Array
    others: Array
    slope: Array
    converged: Array


def polish(
    model: GeneratedModel,
    p: Array,
    orbit: Discretisation | Sequence[Discretisation],
    target: ComplexArray,
    direction: Direction,
    *,
    tol: float = 1e-8,
    max_mesh: int = 512,
) -> list[BoundaryPoint]:
    """Return boundary points near `p` (n_parameters, B), moved along `direction`, each on a mesh whose error is below `tol`.

    `orbit` (B, N, ...), or B of them on meshes of their own, and the multipliers `target` (B,) are the first guess. A point that
    does not converge, or whose estimated error stays above `tol` on `max_mesh` intervals, says so in its status.
    """
    points: list[BoundaryPoint | None] = [None] * p.shape[1]
    if isinstance(orbit, Discretisation):
        waiting = [(np.arange(p.shape[1]), p, orbit, target)]
    else:
        waiting = [(index, p[:, index], stack([orbit[i] for i in index]), target[index]) for index in by_mesh(orbit)]
    while waiting:
        index, p, orbit, target = waiting.pop()
        N = orbit.x.shape[-2]
        wanted = wanted_mesh(mesh_error(model, orbit), N, tol, max_mesh)
        for mesh in sorted(set(wanted.tolist())):  # np.unique imports numpy.ma
            here = np.nonzero(wanted == mesh)[0]
            start = orbit.part(here) if mesh == N else interpolate(orbit.part(here), uniform_mesh(int(mesh)))
            lines = direction.part(index[here])
            fine = _newton(model, p[:, here], start, target[here], lines, tol)
            error = mesh_error(model, fine.orbit) + np.where(fine.converged, fine.residual, 0.0)
            _renew(model, fine, lines, tol)
            done = (error <= tol) | ~fine.converged | (mesh >= max_mesh)
            for j in np.nonzero(done)[0]:
                end = int(index[here[j]])
                points[end] = _point(fine, int(j), float(error[j]), tol)
            again = np.nonzero(~done)[0]
            if again.size:
                waiting.append((index[here[again]], fine.p[:, again], fine.orbit.part(again), fine.rho[again]))
    return [q for q in points if q is not None]


def _point(r: _Polished, j: int, error: float, tol: float) -> BoundaryPoint:
    status = Status.OK if error <= tol else Status.TOLERANCE
    return BoundaryPoint(
        p=r.p[:, j].copy(),
        rho=complex(r.rho[j]),
        error=error,
        residual=float(r.residual[j]),
        others=float(r.others[j]),
        slope=float(r.slope[j]),
        status=status if r.converged[j] else Status.NO_CONVERGENCE,
        orbit=r.orbit.part(slice(j, j + 1)),
    )


def _newton(
    model: GeneratedModel, p: Array, orbit: Discretisation, target: ComplexArray, direction: Direction, tol: float
) -> _Polished:
    """Return the solutions of {periodicity, ln |rho| = 0} in (orbit, distance along `direction`) on one mesh."""
    count = p.shape[1]
    start = Discretisation(orbit.x.copy(), orbit.stages.copy(), orbit.edges)
    residual, others, slope = np.full((3, count), np.nan)
    found = _Polished(p.copy(), start, target.astype(complex), residual, others, slope, np.zeros(count, bool))
    for a in range(0, count, CHUNK):
        active = np.arange(a, min(a + CHUNK, count))
        for _ in range(MOST_ITERATIONS):
            active = _step(model, found, active, direction.part(active), tol)
            if not active.size:
                break
    return found


def _step(model: GeneratedModel, r: _Polished, index: Array, direction: Direction, tol: float) -> Array:
    """Make one Newton step of the points `index` of `r`, in place, and return those that are not finished."""
    rows = [model.index(name) for name in direction.names]
    n, part, q = r.orbit.x.shape[-1], r.orbit.part(index), r.p[:, index]
    linear = solve_boundary(model, q, part, direction.names, r.rho[index], direction.rates(q[rows]), direction.across)
    dq, dx, dstages = linear.solution[0, :, n:], linear.dx[0], linear.dstages[0]
    usable: Any = linear.good & np.isfinite(dx).all(axis=(-1, -2)) & np.isfinite(dstages).all(axis=(-1, -2, -3))
    dq, dx, dstages = (np.where(usable[(slice(None), *[None] * (a.ndim - 1))], a, 0.0) for a in (dq, dx, dstages))
    limit = np.minimum(step_limit(model, dx, dstages), LARGEST_STEP / np.maximum(np.abs(dq).max(axis=1), 1e-300))
    dq = limit[:, None] * dq
    size = np.maximum(0.1 * np.abs(dx / scales(model, q)[:, None, :]).max(axis=(-1, -2)), np.abs(dq).max(axis=1))
    r.rho[index] = linear.rho
    r.others[index] = largest_other(linear.multipliers, linear.rho)
    r.p[np.asarray(rows)[:, None], index] = direction.moved(q[rows], dq)
    r.orbit.x[index] += limit[:, None, None] * dx
    r.orbit.stages[index] += limit[:, None, None, None] * dstages
    left = np.minimum(size, 1.0) ** 2  # what the step just made leaves behind; a nearly singular one has no bound
    enough = np.maximum(0.1 * tol, 0.1 * mesh_error(model, part))  # a tenth of the mesh's own error
    done = usable & (left < enough) & (size < 1e-3)
    r.residual[index] = np.where(done, left, np.abs(linear.g))
    r.slope[index] = growth_slopes(linear)[..., -1] * q[rows[-1]]
    r.converged[index[done]] = True
    return index[usable & ~done]


def _renew(model: GeneratedModel, r: _Polished, direction: Direction, tol: float) -> None:
    """Compute multipliers and slopes anew, in place, where those from before the last Newton step are not accurate enough.

    That is everywhere at a tight tolerance, and beside folds, where the slope may have the wrong sign.
    """
    index = np.nonzero(r.converged & ((tol < FINE_TOLERANCE) | ~(np.abs(r.slope) > SHALLOW)))[0]
    for a in range(0, len(index), CHUNK):
        here = index[a : a + CHUNK]
        q = r.p[:, here]
        linear = linearise_boundary(model, q, r.orbit.part(here), direction.names, r.rho[here])
        r.rho[here] = linear.rho
        r.others[here] = largest_other(linear.multipliers, linear.rho)
        r.slope[here] = growth_slopes(linear)[..., -1] * q[model.index(direction.names[-1])]


def largest_other(multipliers: ComplexArray, rho: ComplexArray) -> Array:
    """Return the largest modulus among the multipliers other than `rho` and its conjugate."""
    pair = np.minimum(np.abs(multipliers - rho[:, None]), np.abs(multipliers - rho.conj()[:, None]))
    return np.where(pair < 1e-9 * np.abs(rho)[:, None], 0.0, np.abs(multipliers)).max(axis=-1)
