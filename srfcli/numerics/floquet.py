"""One forced periodic state in full: multipliers with their error, mean friction, harmonics, on a mesh that refines itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.codegen.model import Array, ComplexArray, GeneratedModel
from srfcli.core.errors import Status
from srfcli.numerics.collocation import (
    STAGES,
    Discretisation,
    condense,
    last_coefficient,
    log_determinant,
    mesh_error,
    stage_parameters,
)
from srfcli.numerics.orbit import (
    CLIMBING,
    FIRST_CLIMB,
    OrbitBatch,
    interpolate,
    robust_orbits,
    solve_orbits,
    steady_guess,
    uniform_mesh,
)

FIRST_MESH = 16
PATIENT = 256  # intervals up to which a state that was not found is looked for on a finer mesh
STIFF = 3.0  # e-foldings of volume within an interval, beyond which Liouville's identity is not checked
NEWTON = 1e-10  # last step of Newton's method
# the same where a multiplier next to 1 lets rounding grow beyond that; the error of the multipliers tells
ROUNDED = 1e-7
CLIMBED_ON = 64  # intervals of the first mesh that is laid where the state needs it
EVEN_SHARE = 0.2  # share of the intervals that are spread evenly
FINEST_CLIMB, MOST_CLIMBS = 1e-4, 200  # shares of eps
WHILE_CLIMBING = 1e-4  # estimated error from which on the mesh is made finer on the way
RELIED_ON = 31.0  # an interval halved gains 2^8 in theory, 2^5 is relied on


@dataclass(frozen=True)
class FloquetResult:
    """A forced periodic state. Multipliers (n,) over one forcing period, largest first, with their estimated error.

    The error is that of the worst multiplier, relative for those beyond 1.
    `mean_friction` is the mean of mu over the period, `friction_shift` what modulation adds to steady sliding's mu.
    `u_harmonics`, `mu_harmonics` (H+1,) are complex amplitudes: q = c_0 + sum |c_k| cos(2 pi k tau + arg c_k).
    `liouville` is |product of the multipliers / exp(integrated trace) - 1|: Liouville's identity, apart from the estimate.
    """

    p: Array
    orbit: Discretisation
    multipliers: ComplexArray
    error: float
    liouville: float
    mean_friction: float
    friction_shift: float
    u_harmonics: ComplexArray
    mu_harmonics: ComplexArray
    status: Status

    @property
    def found(self) -> bool:
        """Return whether there is a state at all: Newton's method converged."""
        return self.status is not Status.NO_CONVERGENCE

    @property
    def stable(self) -> bool:
        """True where every multiplier lies inside the unit circle."""
        return bool(np.all(np.abs(self.multipliers) < 1))


@dataclass(frozen=True)
class Waveforms:
    """The state over one period: phases tau (T,), unknowns (T, n), and the friction, load and elongation that follow."""

    tau: Array
    x: Array
    mu: Array
    W: Array
    u: Array


def solve_floquet(
    model: GeneratedModel, p: Array, *, tol: float = 1e-6, max_mesh: int = 1024, harmonics: int = 8
) -> FloquetResult:
    """Return the forced periodic state at `p` (n_parameters,), its mesh doubled until the multipliers' error is below `tol`.

    The error is the larger of two estimates: what the last doubling changed, and what the orbit's polynomials still carry. Meshes
    are uniform. Where they lead to no state, or to none of this error, the mesh is laid where the state needs it.
    """
    column = p[:, None]
    batch = robust_orbits(model, column, None, uniform_mesh(FIRST_MESH), tol=NEWTON)
    for newton in (NEWTON, ROUNDED):
        intervals = FIRST_MESH
        while not batch.converged[0] and 2 * intervals <= min(max_mesh, PATIENT):
            intervals *= 2
            batch = robust_orbits(model, column, None, uniform_mesh(intervals), tol=newton)
    batch, error = _refined(model, batch, tol, max_mesh)
    if error > tol and max_mesh >= 2 * CLIMBED_ON:
        if batch.converged[0]:
            start = _solved(model, column, interpolate(batch.orbit, _laid(model, batch.orbit, CLIMBED_ON)))
        else:
            start = climbed(model, column, max_mesh // 2)[0]
        laid, smaller = _refined(model, start, tol, max_mesh)
        if smaller < error:
            batch, error = laid, smaller
    status = Status.NO_CONVERGENCE if not batch.converged[0] else Status.OK if error <= tol else Status.TOLERANCE
    orbit = batch.orbit.part(0)
    rest = float(model.steady_friction(p))
    finer = interpolate(orbit, _split(orbit.edges, 8 * (harmonics + 8)))
    at = finer.phases, finer.stages, stage_parameters(p)
    u_k, mu_k = (_harmonics(finer, q(*at), harmonics) for q in (model.cycle_elongation, model.cycle_friction))
    return FloquetResult(
        p=p,
        orbit=orbit,
        multipliers=batch.multipliers[0],
        error=error,
        liouville=_liouville(model, p, orbit),
        mean_friction=float(mu_k[0].real),
        friction_shift=float(mu_k[0].real) - rest,
        u_harmonics=u_k,
        mu_harmonics=mu_k,
        status=status,
    )


def _split(edges: Array, intervals: int) -> Array:
    """Return the edges with each interval split evenly, so that there are at least so many."""
    parts = -(-intervals // (len(edges) - 1))
    return np.interp(np.arange(parts * (len(edges) - 1) + 1) / parts, np.arange(len(edges)), edges)


def _solved(model: GeneratedModel, p: Array, guess: Discretisation) -> OrbitBatch:
    """Return one orbit from a guess near it, to NEWTON or, where rounding stops that, to ROUNDED."""
    batch = solve_orbits(model, p, guess, tol=NEWTON, max_iterations=CLIMBING)
    return batch if batch.converged[0] else solve_orbits(model, p, guess, tol=ROUNDED)


def _refined(model: GeneratedModel, batch: OrbitBatch, tol: float, max_mesh: int) -> tuple[OrbitBatch, float]:
    """Return one orbit on its mesh halved until the error is below `tol`, and that error; infinite where there is no orbit."""
    error = np.inf
    while batch.converged[0] and error > tol and 2 * batch.orbit.intervals <= max_mesh:
        fine = _solved(model, batch.p, interpolate(batch.orbit, _split(batch.orbit.edges, 2 * batch.orbit.intervals)))
        after, before = (np.sort_complex(b.multipliers[0]) for b in (fine, batch))
        shift = (np.abs(after - before) / np.maximum(1.0, np.abs(after))).max()
        error = max(float(shift) / RELIED_ON, float(mesh_error(model, fine.orbit)[0])) + 1e-12
        batch = fine
    return batch, error if batch.converged[0] else np.inf


def _laid(model: GeneratedModel, orbit: Discretisation, intervals: int) -> Array:
    """Return a mesh on which each interval's polynomials of a batch of one carry about as much in their last coefficient.

    An interval of width h carries h^STAGES, so that its share of the intervals goes with the root of that; a share for all keeps
    the mesh from leaving the calm part of the period to a few.
    """
    density = last_coefficient(model, orbit)[0] ** (1 / STAGES) / orbit.steps
    density = np.maximum(density, np.maximum(np.roll(density, 1), np.roll(density, -1)))
    density += EVEN_SHARE * float((density * orbit.steps).sum())
    reached = np.concatenate([[0.0], np.cumsum(density * orbit.steps)])
    edges = np.interp(np.linspace(0.0, 1.0, intervals + 1), reached / reached[-1], orbit.edges)
    edges[0], edges[-1] = 0.0, 1.0
    return edges


def climbed(model: GeneratedModel, p: Array, finest: int) -> tuple[OrbitBatch, float]:
    """Return the orbit at `p` (n_parameters, 1) by raising eps from 0 on a mesh that is laid anew at each step.

    The number says which share of eps was reached: below 1 a step of FINEST_CLIMB of eps failed, as where the branch of states
    turns back or velocities leave the range of numbers, and the orbit, of the last eps that went, is marked as not converged.
    """
    eps, edges, calm = p[model.index("eps")], uniform_mesh(CLIMBED_ON), model.with_values(p, eps=0.0)
    batch = solve_orbits(model, calm, steady_guess(model, calm, edges), tol=ROUNDED)
    reached, step, tries = 0.0, FIRST_CLIMB, 0
    slope = batch.orbit.unchanged()
    while batch.converged[0] and reached < 1 and step > FINEST_CLIMB and tries < MOST_CLIMBS:
        tries += 1
        target = 1.0 if reached + step > 1 - FINEST_CLIMB else reached + step
        q, before, ahead = model.with_values(p, eps=target * eps), batch.orbit, target - reached
        found = solve_orbits(model, q, before + ahead * slope, tol=ROUNDED, max_iterations=CLIMBING)
        if not found.converged[0]:
            step /= 2
            continue
        finer = 2 if mesh_error(model, found.orbit)[0] > WHILE_CLIMBING and 2 * found.orbit.intervals <= finest else 1
        moved = interpolate(found.orbit, _laid(model, found.orbit, finer * found.orbit.intervals))
        again = solve_orbits(model, q, moved, tol=ROUNDED, max_iterations=CLIMBING)
        if again.converged[0]:
            found, before = again, interpolate(before, again.orbit.edges)
        slope = (1 / ahead) * (found.orbit - before)
        batch, reached, step = found, target, 1.5 * step
    batch.converged &= reached >= 1
    batch.p[:] = p
    return batch, reached


def waveforms(model: GeneratedModel, p: Array, orbit: Discretisation, samples: int) -> Waveforms:
    """Return the orbit at `samples` equal phases of one period, by its own collocation polynomials."""
    tau = np.arange(samples) / samples
    x = interpolate(orbit, np.concatenate([tau, [1.0]])).x
    mu, W, u = (q(tau, x, p.tolist()) for q in (model.cycle_friction, model.cycle_load, model.cycle_elongation))
    return Waveforms(tau, x, mu, W, u)


def _harmonics(orbit: Discretisation, values: Array, count: int) -> ComplexArray:
    """Return c_0..c_count of values (N, m) at the Gauss points, by their quadrature: the mean, then amplitudes with phases."""
    waves = np.exp(-2j * np.pi * np.arange(count + 1)[:, None, None] * orbit.phases)
    amplitudes = (waves * (values * orbit.weights)).sum(axis=(-1, -2))
    amplitudes[1:] *= 2
    return amplitudes


def _liouville(model: GeneratedModel, p: Array, orbit: Discretisation) -> float:
    """Return |det M / exp(integrated trace) - 1|, the exponents summed over the intervals, so that nothing underflows.

    NaN where volume shrinks by more than e^STIFF within an interval: the polynomials then damp the fastest multiplier, which
    is far below rounding against 1, but not by its right factor.
    """
    trace = np.trace(model.cycle_jacobian(orbit.phases, orbit.stages, stage_parameters(p)), axis1=-2, axis2=-1)
    exponents = (trace * orbit.weights).sum(axis=-1)
    if np.abs(exponents).max() > STIFF:
        return float("nan")
    return float(abs(np.expm1(log_determinant(condense(model, p, orbit), orbit) - exponents.sum())))
