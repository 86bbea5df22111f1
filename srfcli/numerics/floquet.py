"""One forced periodic state in full: multipliers with their error, mean friction, harmonics, on a mesh that refines itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.codegen.model import Array, ComplexArray, GeneratedModel
from srfcli.core.errors import Status
from srfcli.numerics.collocation import (
    Discretisation,
    condense_plainly,
    gauss,
    log_determinant,
    mesh_error,
    stage_parameters,
)
from srfcli.numerics.critical import robust_orbits
from srfcli.numerics.orbit import interpolate, solve_orbits, uniform_mesh

FIRST_MESH = 16
PATIENT = 256  # intervals up to which a state that was not found is looked for on a finer mesh
STIFF = 3.0
RELIED_ON = 31.0  # an interval halved gains 2^8 in theory, 2^5 is relied on


@dataclass(frozen=True)
class FloquetResult:
    """A forced periodic state. Multipliers (n,) over one forcing period, largest first, with their estimated error.

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

    The error is the larger of two estimates: what the last doubling changed, and what the orbit's polynomials still carry.
    """
    column = p[:, None]
    batch = robust_orbits(model, column, None, uniform_mesh(FIRST_MESH), tol=1e-10)
    while not batch.converged[0] and 2 * (len(batch.orbit.edges) - 1) <= min(max_mesh, PATIENT):
        edges = uniform_mesh(2 * (len(batch.orbit.edges) - 1))
        batch = robust_orbits(model, column, None, edges, tol=1e-10)
    error = np.inf
    while batch.converged[0] and error > tol and 2 * (len(batch.orbit.edges) - 1) <= max_mesh:
        finer = interpolate(batch.orbit, uniform_mesh(2 * (len(batch.orbit.edges) - 1)))
        fine = solve_orbits(model, column, finer, tol=1e-10)
        shift = np.abs(np.sort_complex(fine.multipliers[0]) - np.sort_complex(batch.multipliers[0])).max()
        error = max(float(shift) / RELIED_ON, float(mesh_error(model, fine.orbit)[0])) + 1e-12
        batch = fine
    status = Status.NO_CONVERGENCE if not batch.converged[0] else Status.OK if error <= tol else Status.TOLERANCE
    orbit = Discretisation(batch.orbit.x[0], batch.orbit.stages[0], batch.orbit.edges)
    waves = waveforms(model, p, orbit, max(256, 8 * harmonics))
    rest = float(model.steady_friction(p))
    u_k, mu_k = harmonic_amplitudes(waves.u, harmonics), harmonic_amplitudes(waves.mu, harmonics)
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


def waveforms(model: GeneratedModel, p: Array, orbit: Discretisation, samples: int) -> Waveforms:
    """Return the orbit at `samples` equal phases of one period, by its own collocation polynomials."""
    tau = np.arange(samples) / samples
    x = interpolate(orbit, np.concatenate([tau, [1.0]])).x
    return Waveforms(
        tau,
        x,
        model.cycle_friction(tau, x, p.tolist()),
        model.cycle_load(tau, x, p.tolist()),
        model.cycle_elongation(tau, x, p.tolist()),
    )


def harmonic_amplitudes(values: Array, count: int) -> ComplexArray:
    """Return c_0..c_count of equally spaced samples: the mean, then amplitudes with their phases at tau = 0."""
    spectrum = np.fft.rfft(values) / len(values)
    spectrum[1:] *= 2
    return spectrum[: count + 1]


def _liouville(model: GeneratedModel, p: Array, orbit: Discretisation) -> float:
    """Return |det M / exp(integrated trace) - 1|, the exponents summed over the intervals, so that nothing underflows.

    NaN where volume shrinks by more than e^STIFF within an interval: the polynomials then damp the fastest multiplier, which
    is far below rounding against 1, but not by its right factor.
    """
    trace = np.trace(model.cycle_jacobian(orbit.phases, orbit.stages, stage_parameters(p)), axis1=-2, axis2=-1)
    exponents = (trace @ gauss(orbit.stages.shape[-2]).weights) * orbit.steps
    if np.abs(exponents).max() > STIFF:
        return float("nan")
    return float(abs(np.expm1(log_determinant(condense_plainly(model, p, orbit), orbit) - exponents.sum())))
