"""The answer of steady sliding to a modulated load: linear transfer functions, and the mean friction at any amplitude.

Linear: with W = W0 (1 + eps cos wt) every quantity q follows as q_0 + Re(eps H_q exp(iwt)) to first order in eps (Perfettini,
Schmittbuhl, Rice and Cocco, J. Geophys. Res. 106, 13455, 2001). At finite amplitude the mean friction drops (Bureau, Baumberger
and Caroli, Phys. Rev. E 62, 6810, 2000); it is taken from the forced periodic states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.codegen.model import COMPLEX_STEP, Array, ComplexArray, GeneratedModel
from srfcli.core.errors import Status
from srfcli.numerics.collocation import mesh_error, stage_parameters, wanted_mesh
from srfcli.numerics.critical import INTERVALS
from srfcli.numerics.orbit import OrbitBatch, growth, interpolate, robust_orbits, uniform_mesh

NO_ORBIT = 1e9  # the error of an orbit that was not found: the mesh grows as fast as it may


@dataclass(frozen=True)
class LinearResponse:
    """Transfer functions at parameter points (n_parameters, ...), each per unit of the relative modulation eps of the load.

    `friction` is that of mu, `force` that of the friction force over W0, `position` that of the slider (um), `velocity` that of
    the interface's slip velocity over V. `stable` says whether steady sliding is stable there: elsewhere this is not seen.
    Where the rates have no value `status` is NO_VALUE, and the functions are NaN.
    """

    p: Array
    friction: ComplexArray
    force: ComplexArray
    position: ComplexArray
    velocity: ComplexArray
    stable: Array
    status: tuple[Status, ...]


def linear_response(model: GeneratedModel, p: Array) -> LinearResponse:
    """Return the response of steady sliding at `p` (n_parameters, ...), whose eps does not count."""
    p = model.with_values(p, eps=0.0)
    rest, n = model.steady(p), len(model.states)
    jacobian = model.cycle_jacobian(0.0, rest, p)
    by_eps = model.cycle_parameter("eps")
    forcing = by_eps(0.0, rest, p) - 1j * by_eps(0.25, rest, p)  # F cos + G sin is Re((F - iG) exp(2 pi i tau))
    known = np.isfinite(jacobian).all(axis=(-1, -2)) & np.isfinite(forcing).all(axis=-1)
    jacobian[~known], forcing[~known] = -np.eye(n), np.nan
    state = np.linalg.solve(2j * np.pi * np.eye(n) - jacobian, forcing[..., None])[..., 0]
    friction, load = (_observed(model, f"cycle_{name}", rest, p, state) for name in ("friction", "load"))
    pulled: ComplexArray | float = 0.0
    if "cycle_drive" in model.namespace:
        pulled = _observed(model, "cycle_drive", rest, p, state) / (2j * np.pi * p[model.index("f")])
    mu, W, W0 = model.cycle_friction(0.0, rest, p), model.cycle_load(0.0, rest, p), p[model.index("W0")]
    return LinearResponse(
        p,
        friction,
        (friction * W + mu * load) / W0,
        pulled - _observed(model, "cycle_elongation", rest, p, state),  # of the spring's other end, and u
        state[..., model.states.index("ln_v")],
        known & (np.linalg.eigvals(jacobian).real.max(axis=-1) < 0),
        tuple(Status.OK if k else Status.NO_VALUE for k in np.atleast_1d(known)),
    )


def _observed(model: GeneratedModel, name: str, rest: Array, p: Array, state: ComplexArray) -> ComplexArray:
    """Return the first-order change of the model's function `name` with the state and with eps itself."""
    function, q, step = model.namespace[name], p.astype(complex), 1j * COMPLEX_STEP
    q[model.index("eps")] += step
    along, across = (
        np.asarray(function(tau, rest + step * part, q)).imag / COMPLEX_STEP
        for tau, part in ((0.0, state.real), (0.25, -state.imag))
    )
    return np.asarray(along - 1j * across)


def resonance(frequencies: Array, amplitude: Array) -> tuple[float, float] | None:
    """Return frequency and height of the highest maximum of |H| inside the range of rising `frequencies`, else None.

    The parabola through the three highest samples in ln f gives the maximum to second order in the spacing.
    """
    inner = np.nonzero((amplitude[1:-1] > amplitude[:-2]) & (amplitude[1:-1] >= amplitude[2:]))[0] + 1
    if not inner.size:
        return None
    k = int(inner[np.argmax(amplitude[inner])])
    x, y = np.log(frequencies[k - 1 : k + 2]), amplitude[k - 1 : k + 2]
    a, b, c = np.polyfit(x - x[1], y, 2)
    top = -b / (2 * a)
    return float(np.exp(x[1] + top)), float(c + b * top / 2)


@dataclass(frozen=True)
class MeanFriction:
    """Forced periodic states at points (n_parameters, B): time means over a period.

    `friction` is the mean of mu, `force` the mean friction force over W0, `steady` that force in steady sliding;
    `drop` is steady - force. `growth` is ln |leading multiplier|, negative where the state is stable; `error` that of the mesh.
    """

    p: Array
    friction: Array
    force: Array
    steady: Array
    growth: Array
    error: Array
    status: tuple[Status, ...]

    @property
    def drop(self) -> Array:
        """Return what modulation takes off the mean friction force, over W0."""
        return self.steady - self.force


def mean_friction(model: GeneratedModel, p: Array, *, tol: float = 1e-6, max_mesh: int = 256) -> MeanFriction:
    """Return the mean friction of the forced periodic states at `p` (n_parameters, B), each on a mesh of error below `tol`."""
    count = p.shape[1]
    columns = np.full((4, count), np.nan)
    status = [Status.NO_CONVERGENCE if known else Status.NO_VALUE for known in model.has_rates(p)]
    waiting: list[tuple[Array, OrbitBatch]] = [
        (np.arange(count), robust_orbits(model, p, None, uniform_mesh(INTERVALS), tol=1e-9))
    ]
    while waiting:
        index, batch = waiting.pop()
        N = batch.orbit.intervals
        error = np.where(batch.converged, mesh_error(model, batch.orbit), NO_ORBIT)
        exponents, finished = growth(batch)[1], (error <= tol) | (max_mesh <= N)
        for j in np.nonzero(finished & batch.converged)[0]:
            columns[:, index[j]] = *_means(model, batch, int(j)), exponents[j], error[j]
            status[index[j]] = Status.OK if error[j] <= tol else Status.TOLERANCE
        wanted = wanted_mesh(error, N, tol, max_mesh)
        for mesh in np.unique(wanted[~finished]):
            here = np.nonzero(~finished & (wanted == mesh))[0]
            edges, part = uniform_mesh(int(mesh)), batch.orbit.part(here)
            guess = interpolate(part, edges) if batch.converged[here].all() else None
            waiting.append((index[here], robust_orbits(model, p[:, index[here]], guess, edges, tol=1e-9)))
    calm = model.with_values(p, eps=0.0)
    rest = model.steady(calm)
    steady = model.cycle_friction(0.0, rest, calm) * model.cycle_load(0.0, rest, calm) / p[model.index("W0")]
    return MeanFriction(p, columns[0], columns[1], steady, columns[2], columns[3], tuple(status))


def _means(model: GeneratedModel, batch: OrbitBatch, j: int) -> tuple[float, float]:
    """Return the means of mu and of mu W/W0 by Gauss quadrature over the mesh."""
    orbit, ps = batch.orbit.part(j), stage_parameters(batch.p[:, j])
    mu = model.cycle_friction(orbit.phases, orbit.stages, ps)
    load = model.cycle_load(orbit.phases, orbit.stages, ps) / batch.p[model.index("W0"), j]
    return float((mu * orbit.weights).sum()), float((mu * load * orbit.weights).sum())
