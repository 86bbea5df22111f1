"""How a critical load moves with any parameter: exact derivatives, by implicit differentiation of what defines the boundary.

Under modulation a boundary point solves {x(1) = x(0), ln |rho| = 0}. Its total derivative along a parameter q is the
gradient of ln |rho| that the continuation uses, with the orbit's own response put in:
    dg/dq = g_q - g_x (M - I)^-1 x_q,   dW0c/dq = -(dg/dq) / (dg/dW0).
Under constant load it solves P(i Omega; W0) = 0, P the characteristic polynomial, whose derivatives are complex steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.boundary import linearise_boundary
from srfcli.numerics.collocation import Array, join
from srfcli.numerics.hopf import HopfPoint
from srfcli.numerics.polish import CHUNK, BoundaryPoint

STEP = 1e-30  # of a complex step: its square is nothing against 1


def forced_slopes(model: GeneratedModel, points: Sequence[BoundaryPoint], names: tuple[str, ...]) -> Array:
    """Return dW0c/d(name) (len(points), k) at boundary points under modulation, all else fixed; base units.

    Exact for the discretised problem, so within the points' mesh error of the true ones; infinite at a fold of the
    crossings, where two meet.
    """
    slopes = np.full((len(points), len(names)), np.nan)
    meshes = np.array([q.orbit.x.shape[-2] for q in points], dtype=int)
    for mesh in np.unique(meshes):
        same = np.nonzero(meshes == mesh)[0]
        for a in range(0, len(same), CHUNK):
            here = same[a : a + CHUNK]
            slopes[here] = _slopes_on_one_mesh(model, [points[i] for i in here], names)
    return slopes


def _slopes_on_one_mesh(model: GeneratedModel, points: Sequence[BoundaryPoint], names: tuple[str, ...]) -> Array:
    p = np.stack([q.p for q in points], axis=1)
    rho = np.array([q.rho for q in points])
    orbit = join([q.orbit for q in points])
    n = orbit.x.shape[-1]
    linear = linearise_boundary(model, p, orbit, (*names, "W0"), rho)
    response = np.linalg.solve(linear.periodic[..., :n], linear.periodic[..., n + 1 :])  # -dx_0/dq
    total = linear.growth[..., n + 1 :] - np.einsum("bn,bnk->bk", linear.growth[..., :n], response)
    with np.errstate(divide="ignore"):
        return -total[:, :-1] / total[:, -1:]


def hopf_slopes(model: GeneratedModel, p: Array, point: HopfPoint, names: tuple[str, ...]) -> Array:
    """Return dW0c/d(name) (k,) of a Hopf point of steady sliding at `p` (n_parameters,), all else fixed; base units."""
    q = p.copy()
    q[model.index("W0")] = point.W0
    s = 1j * point.Omega
    a = _coefficients(model, q, None)[0]
    by_s = (np.arange(1, len(a)) * a[1:]) @ s ** np.arange(len(a) - 1)
    by_load = _coefficients(model, q, "W0")[1] @ s ** np.arange(len(a))
    matrix = np.array([[(1j * by_s).real, by_load.real], [(1j * by_s).imag, by_load.imag]])
    columns = [_coefficients(model, q, name)[1] @ s ** np.arange(len(a)) for name in names]
    right = -np.array([[c.real for c in columns], [c.imag for c in columns]])
    return np.linalg.solve(matrix, right)[1]


def _coefficients(model: GeneratedModel, p: Array, name: str | None) -> tuple[Array, Array]:
    """Return the characteristic polynomial's coefficients (n+1,) and their derivatives by parameter `name`."""
    shifted: list[complex] = [complex(v) for v in p]
    h = 0.0
    if name is not None:
        h = STEP * (abs(p[model.index(name)]) or 1.0)
        shifted[model.index(name)] += 1j * h
    a = np.asarray(model.characteristic(shifted))
    return a.real, a.imag / h if h else np.zeros(a.shape)
