"""Gauss collocation over one forcing period, condensed interval by interval, in C where that is possible.

Every function takes the library of `kernel(model)`; where that is None collocation, orbit and boundary do the same in NumPy.

With m Gauss points an interval's stage system is one small dense block; eliminating it leaves an affine map of the
interval's first state, and the ordered product of these maps is the monodromy matrix (Ascher, Mattheij and Russell 1995).
Leading axes are a batch of parameter points throughout.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.c_source import NoForm, compiler, library_of, orbit_source
from srfcli.codegen.model import Array, GeneratedModel

# The Gauss-Legendre scheme of collocation, and the bound on a Newton step: what NumPy and compiled code must share.

STAGES = 4
LOG_STEP = 3.0  # a Newton step changes no velocity or age by more than a factor e^3


@dataclass(frozen=True)
class Scheme:
    """Gauss points `nodes` in [0, 1], the inverse of the collocation matrix, and x_1 = x_0 + step . (X - x_0)."""

    nodes: Array
    inverse: Array
    step: Array
    weights: Array


@lru_cache
def gauss(m: int = STAGES) -> Scheme:
    """Return the Gauss-Legendre scheme of `m` stages (order 2m at the mesh points)."""
    points, weights = np.polynomial.legendre.leggauss(m)
    nodes = (points + 1) / 2
    powers = np.arange(1, m + 1)
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
    library.srf_condense.restype = library.srf_growth.restype = None
    return library


def newton_orbits(
    library: ctypes.CDLL,
    frame: tuple[Array, Array],
    p: Array,
    x: Array,
    stages: Array,
    size: Array,
    tol: float,
    max_iterations: int,
) -> tuple[Array, Array, int]:
    """Bring the orbits `x` (B, N, n), `stages` (B, N, m, n) to convergence in place; monodromy, converged, most iterations.

    `frame` holds the Gauss points' phases (N, m) and the steps (N,), `p` is (n_parameters, B), `size` (B, n).
    """
    B, N, n = x.shape
    monodromy, converged = np.full((B, n, n), np.nan), np.zeros(B, dtype=np.uint8)
    parameters = np.ascontiguousarray(p.T)
    used = library.srf_orbits(
        B, N, *map(_at, frame), _at(parameters), _at(x), _at(stages), _at(size), ctypes.c_double(tol), max_iterations,
        _at(monodromy), _at(converged),
    )  # fmt: skip
    if used < 0:
        raise MemoryError
    return monodromy, converged.astype(bool), used


def condense_compiled(
    library: ctypes.CDLL, frame: tuple[Array, Array], p: Array, x: Array, stages: Array, which: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return factored blocks, their pivots, local, maps and prefix as `Condensed` holds them; NaN where a block is singular."""
    batch, (N, m, n), k = x.shape[:-2], stages.shape[-3:], len(which)
    B, w, size = int(np.prod(batch)), n + 1 + k, m * n
    lu, pivots = np.empty((*batch, N, size, size)), np.empty((*batch, N, size), dtype=np.intc)
    local, maps = np.empty((*batch, N, m, n, w)), np.empty((*batch, N, w, w))
    prefix, good = np.empty((*batch, N + 1, w, w)), np.empty(B, dtype=np.uint8)
    parameters = np.ascontiguousarray(p.T)
    library.srf_condense(
        B, N, k, _at(which), *map(_at, frame), _at(parameters), _at(x), _at(stages), _at(lu), _at(pivots), _at(local), _at(maps),
        _at(prefix), _at(good),
    )  # fmt: skip
    if not good.all():
        bad = ~good.astype(bool).reshape(batch)
        local[bad] = maps[bad] = prefix[bad] = np.nan
    return lu, pivots, local, maps, prefix


def growth_compiled(
    library: ctypes.CDLL,
    frame: tuple[Array, Array],
    p: Array,
    stages: Array,
    which: Array,
    condensed: tuple[Array, Array, Array, Array, Array],
    eigen: tuple[Array, Array, Array],
) -> Array:
    """Return the derivative of ln |rho| in (dx_0, residual, dq), (..., n+1+k); `eigen`: rho, its right and left vectors."""
    lu, pivots, local, maps, prefix = condensed
    N, w = stages.shape[-3], prefix.shape[-1]
    batch = stages.shape[:-3]
    row, parameters = np.empty((*batch, w)), np.ascontiguousarray(p.T)
    pairs = [np.ascontiguousarray(np.asarray(e, dtype=complex)) for e in eigen]
    library.srf_growth(
        int(np.prod(batch)), N, len(which), _at(which), _at(frame[0]), _at(parameters), _at(stages), _at(lu), _at(pivots),
        _at(local), _at(maps), _at(prefix), *map(_at, pairs), _at(row),
    )  # fmt: skip
    return row


def _at(array: Array) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


# Gauss collocation over one forcing period, condensed interval by interval.

COVERING = 10.0
COVERING_RIGID = 30.0  # without the interface's compliance the slip velocity follows the load without delay


@dataclass
class Discretisation:
    """An orbit on a mesh: `x` (..., N, n) at the mesh points, `stages` (..., N, m, n) between, `edges` (N+1,) in [0, 1]."""

    x: Array
    stages: Array
    edges: Array

    @property
    def steps(self) -> Array:
        """Return the interval lengths, (N,)."""
        return np.diff(self.edges)

    @property
    def phases(self) -> Array:
        """Return tau at the Gauss points, (N, m)."""
        return _frame(self.edges.tobytes(), *self.stages.shape[-2:]).phases

    def part(self, index: slice | Array | NDArray[np.intp]) -> Discretisation:
        """Return the orbits of a batch that `index` selects."""
        return Discretisation(self.x[index], self.stages[index], self.edges)


def join(parts: Sequence[Discretisation]) -> Discretisation:
    """Return batches of orbits on one mesh as one batch."""
    return Discretisation(
        np.concatenate([o.x for o in parts]), np.concatenate([o.stages for o in parts]), parts[0].edges
    )


@dataclass
class Condensed:
    """A linearised orbit problem.

    `block` (..., N, mn, mn) is the stage matrix, in compiled code its factors, with their `pivots` (..., N, mn);
    `local` (..., N, m, n, n+1+k) the stages' response to the interval's first state, the residual and k parameters;
    `prefix` (..., N+1, n+1+k, n+1+k) the affine maps from tau = 0 to each mesh point.
    """

    block: Array
    local: Array
    maps: Array
    prefix: Array
    pivots: Array | None = None

    @property
    def monodromy(self) -> Array:
        """Return the monodromy matrix, (..., n, n)."""
        n = self.local.shape[-2]
        return self.prefix[..., -1, :n, :n]


def stage_parameters(p: Array) -> list[float] | Array:
    """Return parameters ready to meet arrays (..., N, m): plain floats for one point, else with two axes added."""
    return p.tolist() if p.ndim == 1 else p[..., None, None]


@dataclass(frozen=True)
class _Frame:
    """What the collocation equations on one mesh have in common at all points."""

    phases: Array  # (N, m)
    inverse: Array  # (N, m, m), the inverse collocation matrix over the step
    block: Array  # (N, m, n, m, n), the same times the identity
    first: Array  # (N, m n, n), the response's right side for the interval's first state


@lru_cache(maxsize=64)
def _frame(edges: bytes, m: int, n: int) -> _Frame:
    mesh = np.frombuffer(edges)
    h = np.diff(mesh)
    scheme = gauss(m)
    inverse = scheme.inverse / h[:, None, None]
    block = inverse[:, :, None, :, None] * np.eye(n)[:, None, :]
    first = (inverse.sum(axis=-1)[..., None, None] * np.eye(n)).reshape(len(h), m * n, n)
    return _Frame(mesh[:-1, None] + h[:, None] * scheme.nodes, inverse, block, first)


def condense(model: GeneratedModel, p: Array, orbit: Discretisation, names: tuple[str, ...] = ()) -> Condensed:
    """Return the linearisation of the collocation equations about `orbit`, with columns for the parameters `names`.

    `p` is (n_parameters, ...), in the model's order. Compiled where it can be: `block` then holds factors.
    """
    library = kernel(model) if orbit.stages.shape[-2] == STAGES else None
    if library is None:
        return condense_plainly(model, p, orbit, names)
    which = np.array([model.index(name) for name in names], dtype=np.intc)
    x, stages = np.ascontiguousarray(orbit.x), np.ascontiguousarray(orbit.stages)
    lu, pivots, local, maps, prefix = condense_compiled(library, (orbit.phases, orbit.steps), p, x, stages, which)
    return Condensed(lu, local, maps, prefix, pivots)


def condense_plainly(model: GeneratedModel, p: Array, orbit: Discretisation, names: tuple[str, ...] = ()) -> Condensed:
    """Return what `condense` does, in NumPy, the stage matrices as they are."""
    x, X = orbit.x, orbit.stages
    m, n = X.shape[-2:]
    k, size, batch = len(names), m * n, X.shape[:-2]  # batch includes the intervals
    step = gauss(m).step
    frame = _frame(orbit.edges.tobytes(), m, n)
    tau, ps = frame.phases, stage_parameters(p)
    block = np.empty((*batch, m, n, m, n))
    block[...] = frame.block
    diagonal = np.einsum("...jajb->...jab", block)
    diagonal -= model.cycle_jacobian(tau, X, ps)
    block = block.reshape(*batch, size, size)
    away = X - x[..., None, :]
    right = np.empty((*batch, size, n + 1 + k))
    right[..., :n] = frame.first
    right[..., n] = (model.cycle(tau, X, ps) - frame.inverse @ away).reshape(*batch, size)
    for column, name in enumerate(names):
        right[..., n + 1 + column] = model.cycle_parameter(name)(tau, X, ps).reshape(*batch, size)
    local = np.linalg.solve(block, right)
    maps = np.zeros((*batch, n + 1 + k, n + 1 + k))
    maps[..., :n, :] = (step @ local.reshape(*batch, m, n * (n + 1 + k))).reshape(*batch, n, n + 1 + k)
    diagonal = np.einsum("...aa->...a", maps)
    diagonal[..., :n] += 1 - step.sum()
    diagonal[..., n:] += 1
    following = np.concatenate([x[..., 1:, :], x[..., :1, :]], axis=-2)
    maps[..., :n, n] += x + step @ away - following
    return Condensed(block, local.reshape(*batch, m, n, n + 1 + k), maps, running_products(maps))


def log_determinant(condensed: Condensed, orbit: Discretisation) -> float:
    """Return ln |det M| of one orbit's monodromy matrix, also where its entries are far below rounding.

    An interval's map r I + D L^-1 B has the determinant r^n det(L + B D/r) / det L, two well-conditioned determinants.
    """
    m, n = orbit.stages.shape[-2:]
    step = gauss(m).step
    r = 1 - step.sum()
    outer = _frame(orbit.edges.tobytes(), m, n).first @ np.kron(step, np.eye(n)) / r
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


def expand(condensed: Condensed, start: Array, parameters: Array | None = None) -> tuple[Array, Array]:
    """Return the Newton corrections of mesh values and stages for a correction `start` (..., n) at tau = 0."""
    n = start.shape[-1]
    k = condensed.local.shape[-1] - n - 1
    head = np.zeros((*start.shape[:-1], n + 1 + k, 1))
    head[..., :n, 0] = start
    head[..., n, 0] = 1
    if parameters is not None:
        head[..., n + 1 :, 0] = parameters
    dx, dstages = respond(condensed, head)
    return dx[..., 0], dstages[..., 0]


def respond(condensed: Condensed, head: Array) -> tuple[Array, Array]:
    """Return mesh values (..., N, n, c) and stages (..., N, m, n, c) for columns `head` (..., n+1+k, c).

    A column holds the change at tau = 0, the share of the residual to be removed, and the changes of the parameters.
    """
    n, width = condensed.local.shape[-2:]
    full = (
        condensed.prefix[..., :-1, :, :] @ head[..., None, :, :]
    )  # the last 1 + k rows of each map are those of identity
    local = condensed.local.reshape(*condensed.local.shape[:-3], -1, width)
    stages = local @ full
    return full[..., :n, :], stages.reshape(*condensed.local.shape[:-1], head.shape[-1])


@lru_cache
def _top_coefficient(m: int) -> Array:
    """Return the weights that give the Legendre coefficient of degree m from the values at 0 and at the m Gauss points."""
    nodes = 2 * np.concatenate([[0.0], gauss(m).nodes]) - 1
    return np.linalg.inv(np.polynomial.legendre.legvander(nodes, m))[m]


def last_coefficient(model: GeneratedModel, orbit: Discretisation) -> Array:
    """Return what the polynomials still carry in their last Legendre coefficient, over the logarithmic unknowns, (..., N)."""
    weights = _top_coefficient(orbit.stages.shape[-2])
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
