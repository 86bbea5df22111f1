"""Points of a stability boundary: a forced periodic state one of whose multipliers lies on the unit circle.

The unknowns are the state at tau = 0 and the parameters `names`; the test function is g = ln |rho| of one multiplier, so that
Neimark-Sacker, period-doubling and fold boundaries obey one equation. The gradient of g is exact for the discretised
problem: with right and left eigenvectors carried along the orbit, d rho = sum w . dJ v over the Gauss points, and the
generated bilinear forms supply d(w . J v). The bordered system is regular at folds of the curve and of the orbit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import (
    Array,
    ComplexArray,
    Condensed,
    Discretisation,
    condense,
    gauss,
    running_products,
    stage_parameters,
)
from srfcli.numerics.orbitkernel import growth_compiled, kernel

Names = tuple[str, ...]


@dataclass
class BoundaryLinear:
    """Newton's equations of a batch of boundary points in (dx_0, dq): `periodic` (..., n, n+1+k) and `growth` (..., n+1+k).

    Columns: n for dx_0, one for the residual, k for the parameters. `rho` is the multiplier, g = ln |rho| its growth.
    """

    condensed: Condensed
    periodic: Array
    growth: Array
    rho: ComplexArray
    g: Array
    multipliers: ComplexArray


def pick_multiplier(multipliers: Array, target: Array) -> Array:
    """Return the index (...,) of the multiplier nearest to `target`, of a conjugate pair the one above the real axis."""
    distance = np.abs(multipliers - target[..., None]) + 1e-9 * (multipliers.imag < 0)
    return np.argmin(distance, axis=-1)


def linearise_boundary(
    model: GeneratedModel, p: Array, orbit: Discretisation, names: Names, target: Array, growth: Array | None = None
) -> BoundaryLinear:
    """Return the linearisation of {periodicity, ln |rho| = 0}; rho is the multiplier nearest to `target` (...,).

    A `growth` row from a nearby point, where given, is used in place of a new one: the step is then a chord step.
    """
    n = orbit.x.shape[-1]
    condensed = condense(model, p, orbit, names)
    M = condensed.monodromy
    values, right_vectors = np.linalg.eig(M)
    values, right_vectors = values.astype(complex), right_vectors.astype(complex)
    chosen = pick_multiplier(values, target)
    rho = np.take_along_axis(values, chosen[..., None], -1)[..., 0]
    if growth is None:
        r = np.take_along_axis(right_vectors, chosen[..., None, None], -1)[..., 0]
        left = _left_vector(M, rho, r)
        library = kernel(model)
        if condensed.pivots is None or library is None:
            growth = _growth_row(model, p, orbit, condensed, names, rho, r, left)
        else:
            which = np.array([model.index(name) for name in names], dtype=np.intc)
            factored = condensed.block, condensed.pivots, condensed.local, condensed.maps, condensed.prefix
            stages, frame = np.ascontiguousarray(orbit.stages), (orbit.phases, orbit.steps)
            growth = growth_compiled(library, frame, p, stages, which, factored, (rho, r, left))
    end = condensed.prefix[..., -1, :n, :].copy()
    index = np.arange(n)
    end[..., index, index] -= 1
    return BoundaryLinear(condensed, end, growth, rho, np.log(np.abs(rho)), values)


def _left_vector(M: Array, rho: Array, r: Array) -> ComplexArray:
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


def _growth_row(
    model: GeneratedModel, p: Array, orbit: Discretisation, c: Condensed, names: Names, rho: Array, r: Array, l: Array
) -> Array:
    """Return the derivative of ln |rho| in (dx_0, residual, dq) as a row (..., n+1+k)."""
    n, k = orbit.x.shape[-1], len(names)
    m = orbit.stages.shape[-2]
    scheme = gauss(m)
    tau, ps = orbit.phases, stage_parameters(p)
    v_mesh = (c.prefix[..., :-1, :n, :n] @ r[..., None, :, None])[..., 0]  # (..., N, n)
    v = (c.local[..., :n] @ v_mesh[..., None, :, None])[..., 0]  # (..., N, m, n)
    # l carried backwards: l_{i+1} = (l G_{N-1} ... G_{i+1}); G_i is the n x n corner of the interval's map
    backwards = running_products(np.swapaxes(c.maps[..., ::-1, :n, :n], -1, -2))  # transposes, from the end
    l_mesh = (backwards[..., -2::-1, :, :] @ l[..., None, :, None])[..., 0]
    seed = (scheme.step[:, None] * l_mesh[..., None, :]).reshape(*l_mesh.shape[:-1], m * n)
    both = np.stack([seed.real, seed.imag], axis=-1)
    w = np.linalg.solve(np.swapaxes(c.block, -1, -2), both)
    w = (w[..., 0] + 1j * w[..., 1]).reshape(v.shape)
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


def slope_in_last(linear: BoundaryLinear) -> Array:
    """Return d ln|rho| / d(last parameter) along the branch of orbits, the other parameters fixed, (...,); NaN at its fold."""
    n = linear.periodic.shape[-2]
    inner, last = linear.periodic[..., :n], linear.periodic[..., -1:]
    try:
        response = np.linalg.solve(inner, last)[..., 0]
    except np.linalg.LinAlgError:  # one singular point spoils the batch
        usable = np.abs(np.linalg.det(np.nan_to_num(inner))) > 1e-300
        response = np.linalg.solve(np.where(usable[..., None, None], inner, np.eye(n)), last)[..., 0]
        response = np.where(usable[..., None], response, np.nan)
    return linear.growth[..., -1] - np.einsum("...n,...n->...", linear.growth[..., :n], response)
