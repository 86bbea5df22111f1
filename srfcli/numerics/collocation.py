"""Gauss collocation over one forcing period, condensed interval by interval.

With m Gauss points an interval's stage system is one small dense block; eliminating it leaves an affine map of the
interval's first state, and the ordered product of these maps is the monodromy matrix (Ascher, Mattheij and Russell 1995).
Leading axes are a batch of parameter points throughout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srfcli.model import GeneratedModel

Array = NDArray[Any]  # real; shapes are in the docstrings
ComplexArray = NDArray[Any]
STAGES = 4


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
        return self.edges[:-1, None] + self.steps[:, None] * gauss(self.stages.shape[-2]).nodes

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

    `block` (..., N, mn, mn) is the stage matrix; `local` (..., N, m, n, n+1+k) the stages' response to the interval's
    first state, the residual and k parameters; `prefix` (..., N+1, n+1+k, n+1+k) the affine maps from tau = 0 to each mesh point.
    """

    block: Array
    local: Array
    maps: Array
    prefix: Array
    residual: Array

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
    x, X, h = orbit.x, orbit.stages, orbit.steps
    m, n = X.shape[-2:]
    scheme = gauss(m)
    tau, ps = orbit.phases, stage_parameters(p)
    inverse = scheme.inverse / h[:, None, None]  # (N, m, m)
    block = np.broadcast_to(
        (inverse[:, :, None, :, None] * np.eye(n)[:, None, :]), (*X.shape[:-3], len(h), m, n, m, n)
    ).copy()
    diagonal = np.einsum("...jajb->...jab", block)
    diagonal -= model.cycle_jacobian(tau, X, ps)
    away = X - x[..., None, :]
    residual = model.cycle(tau, X, ps) - inverse @ away
    k = len(names)
    right = np.zeros((*X.shape, n + 1 + k))
    right[..., :n] = inverse.sum(axis=-1)[..., None, None] * np.eye(n)
    right[..., n] = residual
    for column, name in enumerate(names):
        right[..., n + 1 + column] = model.cycle_parameter(name)(tau, X, ps)
    size = m * n
    block = block.reshape(*block.shape[:-4], size, size)
    local = np.linalg.solve(block, right.reshape(*right.shape[:-3], size, n + 1 + k)).reshape(right.shape)
    maps = np.zeros((*X.shape[:-2], n + 1 + k, n + 1 + k))
    maps[..., :n, :] = np.einsum("j,...jac->...ac", scheme.step, local)
    index = np.arange(n)
    maps[..., index, index] += 1 - scheme.step.sum()
    following = np.concatenate([x[..., 1:, :], x[..., :1, :]], axis=-2)
    gap = x + np.einsum("j,...ja->...a", scheme.step, away) - following
    maps[..., :n, n] += gap
    tail = np.arange(n, n + 1 + k)
    maps[..., tail, tail] = 1
    return Condensed(block, local, maps, running_products(maps), np.maximum(_largest(residual, 3), _largest(gap, 2)))


def _largest(values: Array, axes: int) -> Array:
    return np.abs(values).max(axis=tuple(range(-axes, 0)))


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
    tail = np.zeros((*start.shape[:-1], 1 + k))
    tail[..., 0] = 1
    if parameters is not None:
        tail[..., 1:] = parameters
    head = np.concatenate([start, tail], axis=-1)
    dx = (condensed.prefix[..., :-1, :n, :] @ head[..., None, :, None])[..., 0]
    full = np.concatenate([dx, np.broadcast_to(tail[..., None, :], (*dx.shape[:-1], 1 + k))], axis=-1)
    return dx, (condensed.local @ full[..., None, :, None])[..., 0]
