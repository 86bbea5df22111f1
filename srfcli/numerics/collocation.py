"""Gauss collocation over one forcing period, condensed interval by interval, in C where that is possible.

Every function takes the library of `kernel(model)`; where that is None collocation, orbit and boundary do the same in NumPy.

With m Gauss points an interval's stage system is one small dense block; eliminating it leaves an affine map of the
interval's first state, and the ordered product of these maps is the monodromy matrix (Ascher, Mattheij and Russell 1995).
Leading axes are a batch of parameter points throughout.
"""

from __future__ import annotations

import contextlib
import ctypes
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from srfcli.codegen.c_source import NoForm, compiler, library_of, orbit_source
from srfcli.codegen.model import Array, ComplexArray, GeneratedModel

# The Gauss-Legendre scheme of collocation, and the bound on a Newton step: NumPy and compiled code share them.

STAGES = 4
LOG_STEP = 3.0  # a Newton step changes no velocity or age by more than a factor e^3


@dataclass(frozen=True)
class Scheme:
    """Gauss points `nodes` in [0, 1], the inverse of the collocation matrix, and x_1 = x_0 + step . (X - x_0)."""

    nodes: Array
    inverse: Array
    step: Array
    weights: Array


@cache
def gauss() -> Scheme:
    """Return the Gauss-Legendre scheme of STAGES points (order 2 STAGES at the mesh points)."""
    points, weights = np.polynomial.legendre.leggauss(STAGES)
    nodes = (points + 1) / 2
    powers = np.arange(1, STAGES + 1)
    vandermonde = nodes[:, None] ** (powers - 1)
    integral = (nodes[:, None] ** powers / powers) @ np.linalg.inv(vandermonde)
    inverse = np.linalg.inv(integral)
    return Scheme(nodes, inverse, (weights / 2) @ inverse, weights / 2)


# Newton's equations of periodic orbits in C (codegen/orbit.c), called with arrays.


@cache
def kernel(model: GeneratedModel) -> ctypes.CDLL | None:
    """Return the compiled equations of this model, or None: no compiler, or a formula that has no form in C."""
    if compiler() is None:
        return None
    scheme = gauss()
    try:
        write = partial(orbit_source, model, {"MI": scheme.inverse, "STEP": scheme.step}, LOG_STEP)
        library = library_of(write, ["orbits", model.source, repr(scheme), repr(LOG_STEP)])
    except NoForm:
        return None
    library.srf_orbits.restype = ctypes.c_int
    library.srf_boundary.restype = ctypes.c_int
    return library


def newton_orbits(
    library: ctypes.CDLL, p: Array, orbit: Discretisation, size: Array, tol: float, max_iterations: int
) -> tuple[Array, Array]:
    """Bring orbits (B, N, ...) at the points `p` (n_parameters, B) to convergence in place; return monodromy and converged.

    `size` (B, n) is that of the unknowns.
    """
    B, N, n = orbit.x.shape
    monodromy, converged = np.full((B, n, n), np.nan), np.zeros(B, dtype=np.uint8)
    parameters = np.ascontiguousarray(p.T)
    done = library.srf_orbits(
        B, N, _at(orbit.phases), _at(orbit.steps), _at(parameters), _at(orbit.x), _at(orbit.stages), _at(size),
        ctypes.c_double(tol), max_iterations, _at(monodromy), _at(converged),
    )  # fmt: skip
    if not done:
        raise MemoryError
    return monodromy, converged.astype(bool)


@dataclass
class BoundaryLinear:
    """Newton's equations of boundary points, and their solution where it was asked for.

    `periodic` (..., n, n+1+k) is the map over one period less the state, `growth` (..., n+1+k) the row of g = ln |rho|, rho the
    critical multiplier; columns: n for dx_0, one for the residual, k for the parameters. `solution` (c, B, n+d), `dx`
    (c, B, N, n) and `dstages` (c, B, N, m, n) are Newton's step and, where c = 2, the direction in which all rows but the last
    stay zero. `good` (B,) is false where nothing of it holds.
    """

    periodic: Array
    rho: ComplexArray
    growth: Array
    good: Array
    solution: Array
    dx: Array
    dstages: Array

    @classmethod
    def unsolved(cls, orbit: Discretisation, parameters: int, distances: int, columns: int) -> BoundaryLinear:
        """Return equations at orbits (B, N, ...) of which nothing holds yet."""
        B, _, n = orbit.x.shape
        shapes = (B, n + distances), orbit.x.shape, orbit.stages.shape
        solution, dx, dstages = (np.full((columns, *shape), np.nan) for shape in shapes)
        periodic, rho = np.full((B, n, n + 1 + parameters), np.nan), np.full(B, np.nan + 0j)
        return cls(periodic, rho, periodic[:, 0].copy(), np.zeros(B, bool), solution, dx, dstages)

    @property
    def g(self) -> Array:
        """Return ln |rho|, (...,)."""
        return np.asarray(np.log(np.abs(self.rho)))

    @property
    def multipliers(self) -> ComplexArray:
        """Return all multipliers, (..., n), NaN where nothing holds."""
        n = self.periodic.shape[-2]
        usable: Any = np.isfinite(self.periodic).all(axis=(-1, -2), keepdims=True)
        M = np.where(usable, self.periodic[..., :n], 0.0) + np.eye(n)
        return np.where(usable[..., 0], np.linalg.eigvals(M).astype(complex), np.nan)


def linearised(
    library: ctypes.CDLL,
    model: GeneratedModel,
    p: Array,
    orbit: Discretisation,
    names: Sequence[str],
    target: Array | None = None,
    *,
    rate: Array | None = None,
    across: Array | None = None,
    columns: int = 1,
) -> BoundaryLinear:
    """Return Newton's equations of boundary points, rho being the multiplier next to `target` (B,), solved by `rate` (B, k, d).

    `across` (B, d-1, n+d) closes them. Without a target only `periodic` is found.
    """
    which = np.array([model.index(name) for name in names], dtype=np.intc)
    B, N = orbit.x.shape[:2]
    k, d = len(which), 0 if rate is None else rate.shape[-1]
    found, good = BoundaryLinear.unsolved(orbit, k, d, columns), np.zeros(B, dtype=np.uint8)
    x, stages, parameters = (np.ascontiguousarray(a) for a in (orbit.x, orbit.stages, p.T))
    given = (None if a is None else np.ascontiguousarray(a) for a in (target, rate, across))
    done = library.srf_boundary(
        B, N, k, _at(which), d, columns, _at(orbit.phases), _at(orbit.steps), _at(parameters), _at(x), _at(stages),
        *[None if a is None else _at(a) for a in given], _at(found.periodic), _at(found.rho), _at(found.growth),
        _at(found.solution), _at(found.dx), _at(found.dstages), _at(good),
    )  # fmt: skip
    if not done:
        raise MemoryError
    found.good = good.astype(bool)
    return found


def _at(array: Array) -> ctypes.c_void_p:
    """Return a pointer that keeps its array alive."""
    assert array.flags.c_contiguous
    return array.ctypes.data_as(ctypes.c_void_p)


# Gauss collocation over one forcing period, condensed interval by interval.

COVERING = 10.0
COVERING_RIGID = 30.0  # without the interface's compliance the slip velocity follows the load without delay


@dataclass
class Discretisation:
    """An orbit on a mesh: `x` (..., N, n) at the mesh points, `stages` (..., N, m, n) between, `edges` (N+1,) in [0, 1].

    Orbits on one mesh are added, subtracted, and multiplied by a number, or by one for each orbit of a batch (B,).
    """

    x: Array
    stages: Array
    edges: Array

    __array_ufunc__ = None  # an array on the left leaves the product to __rmul__

    @property
    def intervals(self) -> int:
        """Return the number of intervals, N."""
        return len(self.edges) - 1

    @property
    def steps(self) -> Array:
        """Return the interval lengths, (N,)."""
        return np.diff(self.edges)

    @property
    def phases(self) -> Array:
        """Return tau at the Gauss points, (N, m)."""
        return self.edges[:-1, None] + self.steps[:, None] * gauss().nodes

    @property
    def weights(self) -> Array:
        """Return the weights of Gauss quadrature over the period, (N, m)."""
        return self.steps[:, None] * gauss().weights

    def part(self, index: Any) -> Discretisation:
        """Return the orbits of a batch that `index` selects.

        A whole number selects one orbit, without the batch's axis; None makes a batch of one orbit.
        """
        return Discretisation(self.x[index], self.stages[index], self.edges)

    def unchanged(self) -> Discretisation:
        """Return a change of 0 on this orbit's mesh."""
        return Discretisation(np.zeros_like(self.x), np.zeros_like(self.stages), self.edges)

    def __add__(self, other: Discretisation) -> Discretisation:
        return Discretisation(self.x + other.x, self.stages + other.stages, self.edges)

    def __sub__(self, other: Discretisation) -> Discretisation:
        return Discretisation(self.x - other.x, self.stages - other.stages, self.edges)

    def __rmul__(self, factor: Array | float) -> Discretisation:
        each = np.asarray(factor)[..., None, None]
        return Discretisation(each * self.x, each[..., None] * self.stages, self.edges)


def join(parts: Sequence[Discretisation]) -> Discretisation:
    """Return batches of orbits on one mesh as one batch."""
    return Discretisation(np.concatenate([o.x for o in parts]), np.concatenate([o.stages for o in parts]), parts[0].edges)


def stack(orbits: Sequence[Discretisation]) -> Discretisation:
    """Return orbits on one mesh as a batch."""
    return join([orbit.part(None) for orbit in orbits])


def by_mesh(orbits: Sequence[Discretisation], most: int = sys.maxsize) -> list[Array]:
    """Return the indices of the orbits on each mesh, the coarsest first, in parts of `most` or fewer."""
    meshes = np.array([orbit.intervals for orbit in orbits])
    groups = [np.nonzero(meshes == mesh)[0] for mesh in sorted(set(meshes.tolist()))]  # np.unique imports numpy.ma
    return [group[a : a + most] for group in groups for a in range(0, len(group), most)]


@dataclass
class Condensed:
    """A linearised orbit problem.

    `block` (..., N, mn, mn) is the stage matrix; `local` (..., N, m, n, n+1+k) the stages' response to the interval's first
    state, the residual and k parameters; `prefix` (..., N+1, n+1+k, n+1+k) the affine maps from tau = 0 to each mesh point.
    """

    block: Array
    local: Array
    maps: Array
    prefix: Array

    @property
    def monodromy(self) -> Array:
        """Return the monodromy matrix, (..., n, n)."""
        n = self.local.shape[-2]
        return self.prefix[..., -1, :n, :n]


def stage_parameters(p: Array) -> list[float] | Array:
    """Return parameters ready to meet arrays (..., N, m): plain floats for one point, else with two axes added."""
    return p.tolist() if p.ndim == 1 else p[..., None, None]


def condense(model: GeneratedModel, p: Array, orbit: Discretisation, names: tuple[str, ...] = ()) -> Condensed:
    """Return the linearisation of the collocation equations about `orbit`, with columns for the parameters `names`.

    `p` is (n_parameters, ...), in the model's order.
    """
    x, X = orbit.x, orbit.stages
    m, n = X.shape[-2:]
    k, size, batch = len(names), m * n, X.shape[:-2]  # batch includes the intervals
    step, inverse = gauss().step, gauss().inverse / orbit.steps[:, None, None]
    tau, ps = orbit.phases, stage_parameters(p)
    block = np.empty((*batch, m, n, m, n))
    block[...] = inverse[:, :, None, :, None] * np.eye(n)[:, None, :]
    diagonal = np.einsum("...jajb->...jab", block)
    diagonal -= model.cycle_jacobian(tau, X, ps)
    block = block.reshape(*batch, size, size)
    away = X - x[..., None, :]
    right = np.empty((*batch, size, n + 1 + k))
    right[..., :n] = (inverse.sum(axis=-1)[..., None, None] * np.eye(n)).reshape(-1, size, n)
    right[..., n] = (model.cycle(tau, X, ps) - inverse @ away).reshape(*batch, size)
    for column, name in enumerate(names):
        right[..., n + 1 + column] = model.cycle_parameter(name)(tau, X, ps).reshape(*batch, size)
    local = solved(block, right)
    maps = np.zeros((*batch, n + 1 + k, n + 1 + k))
    maps[..., :n, :] = (step @ local.reshape(*batch, m, n * (n + 1 + k))).reshape(*batch, n, n + 1 + k)
    diagonal = np.einsum("...aa->...a", maps)
    diagonal[..., :n] += 1 - step.sum()
    diagonal[..., n:] += 1
    following = np.concatenate([x[..., 1:, :], x[..., :1, :]], axis=-2)
    maps[..., :n, n] += x + step @ away - following
    return Condensed(block, local.reshape(*batch, m, n, n + 1 + k), maps, running_products(maps))


def solved(matrix: Array, right: Array) -> Array:
    """Return the solutions of the linear systems `matrix` (..., n, n), `right` (..., n, c), NaN for a singular matrix."""
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:  # one singular matrix spoils the batch: they are taken one by one
        solution = np.full(right.shape, np.nan)
        for index in np.ndindex(matrix.shape[:-2]):
            with contextlib.suppress(np.linalg.LinAlgError):
                solution[index] = np.linalg.solve(matrix[index], right[index])
        return solution


def log_determinant(condensed: Condensed, orbit: Discretisation) -> float:
    """Return ln |det M| of one orbit's monodromy matrix, also where its entries are far below rounding.

    An interval's map r I + D L^-1 B has the determinant r^n det(L + B D/r) / det L, two well-conditioned determinants.
    """
    n, step = orbit.x.shape[-1], gauss().step
    r = 1 - step.sum()
    first = gauss().inverse.sum(axis=-1) / orbit.steps[:, None]
    outer = np.stack([np.kron(np.outer(row, step), np.eye(n)) for row in first]) / r
    above = np.linalg.slogdet(condensed.block + outer)[1]
    return float((above - np.linalg.slogdet(condensed.block)[1] + n * np.log(abs(r))).sum())


def running_products(maps: Array) -> Array:
    """Return I, A_0, A_1 A_0, ... of `maps` (..., N, k, k) as (..., N+1, k, k), by blocks of about sqrt(N)."""
    N, k = maps.shape[-3], maps.shape[-1]
    out = np.empty((*maps.shape[:-3], N + 1, k, k), dtype=maps.dtype)
    out[..., 0, :, :] = np.eye(k)
    width = int(np.ceil(np.sqrt(N)))
    blocks = N // width
    inner = maps[..., : blocks * width, :, :].reshape(*maps.shape[:-3], blocks, width, k, k).copy()
    for j in range(1, width):
        inner[..., j, :, :] = inner[..., j, :, :] @ inner[..., j - 1, :, :]
    for b in range(blocks):
        start = out[..., b * width, None, :, :]
        out[..., b * width + 1 : (b + 1) * width + 1, :, :] = inner[..., b, :, :, :] @ start
    for i in range(blocks * width, N):
        out[..., i + 1, :, :] = maps[..., i, :, :] @ out[..., i, :, :]
    return out


def respond(condensed: Condensed, head: Array) -> tuple[Array, Array]:
    """Return mesh values (..., N, n, c) and stages (..., N, m, n, c) for columns `head` (..., n+1+k, c).

    A column holds the change at tau = 0, the share of the residual to be removed, and the changes of the parameters.
    """
    n, width = condensed.local.shape[-2:]
    # the last 1 + k rows of each map are those of identity
    full = condensed.prefix[..., :-1, :, :] @ head[..., None, :, :]
    local = condensed.local.reshape(*condensed.local.shape[:-3], -1, width)
    stages = local @ full
    return full[..., :n, :], stages.reshape(*condensed.local.shape[:-1], head.shape[-1])


@cache
def _top_coefficient() -> Array:
    """Return the weights that give the Legendre coefficient of degree STAGES from the values at 0 and at the Gauss points."""
    nodes = 2 * np.concatenate([[0.0], gauss().nodes]) - 1
    return np.linalg.inv(np.polynomial.legendre.legvander(nodes, STAGES))[STAGES]


def last_coefficient(model: GeneratedModel, orbit: Discretisation) -> Array:
    """Return what the polynomials still carry in their last Legendre coefficient, over the logarithmic unknowns, (..., N)."""
    weights = _top_coefficient()
    top = weights[0] * orbit.x + np.einsum("j,...jn->...n", weights[1:], orbit.stages)
    return np.linalg.norm(top[..., list(model.logarithmic)], axis=-1)


def mesh_error(model: GeneratedModel, orbit: Discretisation) -> Array:
    """Return the estimated relative error (...,) that the mesh leaves in a critical parameter.

    At the mesh points the error of Gauss collocation goes with the square of what the polynomials' last coefficient still
    carries: COVERING times its mean square over the logarithmic unknowns is above the true error of nearly all critical
    loads, of every law tried (benchmarks/mesh_error.py). It says nothing of multipliers far inside the unit circle.
    """
    factor = COVERING if model.namespace["ELASTIC"] else COVERING_RIGID
    return factor * last_coefficient(model, orbit) ** 2 @ orbit.steps


def wanted_mesh(error: Array, intervals: int, tol: float, max_mesh: int) -> Array:
    """Return for each point the intervals that would bring `error` on `intervals` below two thirds of `tol`.

    The error goes as N^-8; a multiple of 8, between the present mesh and four times it.
    """
    ratio = np.clip((1.5 * np.nan_to_num(error, nan=np.inf) / tol) ** 0.125, 1.0, 4.0)
    finer = 8 * np.ceil(intervals * ratio / 8).astype(int)
    return np.minimum(np.where(ratio > 1, np.maximum(finer, intervals + 8), intervals), max(max_mesh, intervals))
