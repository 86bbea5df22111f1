"""Brute force, written by hand from the paper's equations: nothing of srfcli's numerics or generated code is used here.

Unknowns (u, z, ln v, ln phi), units um, s, N. The variational equations are integrated with the orbit by DOP853; a periodic
state is found by shooting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.integrate import solve_ivp


@dataclass(frozen=True)
class Slider:
    """The paper's Table I, optimised column, at one point (V, W0, eps)."""

    V: float
    W0: float
    eps: float
    f: float = 120.0
    K: float = 0.21
    M: float = 2.37e-6  # N s^2/um
    mu0: float = 0.33
    A: float = 0.0126
    B: float = 0.0241
    D0: float = 0.402
    V0: float = 1.0
    Vsat: float = 256.0
    lam: float = 0.56


def friction(s: Slider, ln_v: float, phi: float) -> float:
    """The paper's equation 1."""
    return s.mu0 + s.A * (ln_v - math.log(s.V0)) + s.B * math.log1p(s.Vsat * phi / s.D0)


def steady(s: Slider) -> np.ndarray:
    """Steady sliding under W0."""
    mu = friction(s, math.log(s.V), s.D0 / s.V)
    return np.array([s.W0 * mu / s.K, s.V, math.log(s.V), math.log(s.D0 / s.V)])


def rates(s: Slider, t: float, u: float, z: float, ln_v: float, ln_phi: float) -> tuple[float, float, float, float]:
    """The paper's four equations of motion, the last two divided by v and phi."""
    v, phi = math.exp(ln_v), math.exp(ln_phi)
    W = s.W0 * (1 + s.eps * math.cos(2 * math.pi * s.f * t))
    ageing = 1 - v * phi / s.D0
    z_dot = (s.K * u - W * friction(s, ln_v, phi)) / s.M
    slip = (z - v - s.lam * s.B * s.Vsat * ageing / (s.D0 * (1 + s.Vsat * phi / s.D0))) / (s.lam * s.A)
    return s.V - z, z_dot, slip, ageing / phi


def jacobian(s: Slider, t: float, ln_v: float, ln_phi: float) -> np.ndarray:
    """Derivatives of the rates, by hand."""
    v, phi = math.exp(ln_v), math.exp(ln_phi)
    W = s.W0 * (1 + s.eps * math.cos(2 * math.pi * s.f * t))
    x = s.Vsat * phi / s.D0
    share = x / (1 + x)  # d log(1 + x) / d ln phi
    J = np.zeros((4, 4))
    J[0, 1] = -1
    J[1] = s.K / s.M, 0, -W * s.A / s.M, -W * s.B * share / s.M
    # (z - v)/(lam A) - (B/A) share (1/phi - v/D0); d share/d ln phi = share (1 - share)
    ageing = 1 / phi - v / s.D0
    J[2, 1] = 1 / (s.lam * s.A)
    J[2, 2] = -v / (s.lam * s.A) + s.B / s.A * share * v / s.D0
    J[2, 3] = -s.B / s.A * (share * (1 - share) * ageing - share / phi)
    J[3, 2], J[3, 3] = -v / s.D0, -1 / phi
    return J


@dataclass
class Orbit:
    """A periodic state: where it starts, its monodromy matrix, and the integral of the Jacobian's trace."""

    start: np.ndarray
    monodromy: np.ndarray
    trace: float
    gap: float
    multipliers: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        values = np.linalg.eigvals(self.monodromy).astype(complex)
        self.multipliers = values[np.argsort(-np.abs(values), kind="stable")]

    @property
    def growth(self) -> float:
        """ln of the largest modulus."""
        return float(np.log(np.abs(self.multipliers[0])))


def one_period(s: Slider, start: np.ndarray, *, rtol: float = 1e-11) -> tuple[np.ndarray, np.ndarray, float]:
    """The state after one period, the derivative by the first state, and the integrated trace."""

    def field(t: float, y: np.ndarray) -> np.ndarray:
        u, z, ln_v, ln_phi = y[:4].tolist()
        J = jacobian(s, t, ln_v, ln_phi)
        out = np.empty(21)
        out[:4] = rates(s, t, u, z, ln_v, ln_phi)
        out[4:20] = (J @ y[4:20].reshape(4, 4)).ravel()
        out[20] = J[0, 0] + J[1, 1] + J[2, 2] + J[3, 3]
        return out

    # columns of the derivative are taken per unit of size: z in units of V, so that one tolerance suits all
    size = np.array([1.0, s.V, 1.0, 1.0])
    y = np.concatenate([start, np.diag(size).ravel(), [0.0]])
    atol = np.concatenate([size, np.outer(size, np.ones(4)).ravel(), [1.0]]) * rtol
    solution = solve_ivp(field, (0.0, 1 / s.f), y, method="DOP853", rtol=rtol, atol=atol)
    assert solution.success, solution.message
    end = solution.y[:, -1]
    return end[:4], end[4:20].reshape(4, 4) / size, float(end[20])


def shoot(s: Slider, start: np.ndarray, *, rtol: float = 1e-11, tol: float = 1e-9) -> Orbit:
    """The periodic state next to `start`, by Newton's method on the return map."""
    size = np.array([1.0, s.V, 1.0, 1.0])
    x = np.array(start, dtype=float)
    for _ in range(25):
        end, monodromy, trace = one_period(s, x, rtol=rtol)
        step = np.linalg.solve(np.eye(4) - monodromy, end - x)
        gap = float(np.abs(step / size).max())
        if gap < tol:
            return Orbit(x, monodromy, trace, gap)
        x = x + step * min(1.0, 1.0 / float(np.abs(step[2:]).max()))
    raise AssertionError(f"shooting did not converge at V = {s.V}, W0 = {s.W0}, eps = {s.eps}: {gap:.1e}")


def error_of_load(s: Slider, start: np.ndarray, *, apart: float = 1e-4, tol: float = 1e-9) -> tuple[float, Orbit]:
    """How far, relatively, s.W0 lies from a load at which |rho| = 1 (a secant through s.W0 and its neighbour), and the orbit."""
    here = shoot(s, start, tol=tol)
    there = shoot(replace(s, W0=s.W0 * (1 + apart)), here.start, tol=tol)
    slope = (there.growth - here.growth) / apart
    return here.growth / slope, here


def hopf_load(s: Slider) -> tuple[float, float]:
    """The load and frequency at which a pair of roots is imaginary under constant load, by the eigenvalues of the Jacobian."""
    from scipy.optimize import brentq

    def pair(W0: float) -> complex:
        at = replace(s, W0=W0, eps=0.0)
        x = steady(at)
        values = np.linalg.eigvals(jacobian(at, 0.0, x[2], x[3]))
        return max((complex(v) for v in values if abs(v.imag) > 0), key=lambda v: v.real, default=complex(values.real.max()))

    W0 = float(brentq(lambda w: pair(w).real, 4.0, 40.0, xtol=1e-14, rtol=1e-14))
    return W0, abs(pair(W0).imag)
