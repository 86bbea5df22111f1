"""The slider's equations written for the interface's elastic strain: friction is a stress that is known, v what flows under it.

The stretch e of the interface is a state, the friction force is kappa e, and the slip velocity follows by inverting
mu(v, phi) = F/W. Plain scalar functions; nothing here is shared with the equations that are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from srfcli.proof.physics import Physics
from srfcli.proof.protocol import Plan

FASTEST = 60.0  # of ln(v/V0): what a solver's trial step may ask for is kept finite


@dataclass(frozen=True)
class Felt:
    """The load at the asperities and its rate, N and N/s, beside W - W0 of the imposed one."""

    W: float
    rate: float
    excess: float


def felt_load(p: Physics, plan: Plan) -> Callable[[float], Felt]:
    """Return the load that reaches the asperities, before any delay, as a function of time."""
    imposed, switched, W0 = plan.load(), plan.switched(), plan.W0
    height, omega = p.distortion * plan.eps * W0, 4 * math.pi * plan.f

    def felt(t: float) -> Felt:
        W, rate = imposed(t)
        if not plan.eps:
            return Felt(W, rate, W - W0)  # a slow step of the load is no modulation: it arrives in full
        s, s_dot = switched(t)
        angle = omega * t + p.distortion_phase
        here = W0 + p.rho * (W - W0) + height * s * math.cos(angle)
        slope = p.rho * rate + height * (s_dot * math.cos(angle) - s * omega * math.sin(angle))
        return Felt(here, slope, W - W0)

    return felt


def at_unit_velocity(p: Physics, longest: float) -> Callable[[float, float, float, float, float], tuple[float, float]]:
    """Return f(t, slip, ln phi, ln phi2, W) -> (m, a): mu = m + a x + drag e^x, x = ln(v/V0)."""
    profile = p.track.profile(longest)
    local = p.topo != 0 or p.bump != 0 or p.track.size != 0
    drifting = p.drift_t != 0 or p.drift_x != 0
    wave = 2 * math.pi / p.topo_L
    first_age, second_age = math.log(p.V0 / p.D0), math.log(p.V0 / p.D2)

    def terms(t: float, s: float, ln_phi: float, ln_phi2: float, W: float) -> tuple[float, float]:
        grown = ln_phi + first_age if p.bare else math.log1p(p.Vsat / p.D0 * math.exp(ln_phi))
        m = p.mu0 + p.B * grown
        if p.W_power:
            m += p.mu0 * ((W / p.Wref) ** p.W_power - 1)
        if p.B2:
            m += p.B2 * (ln_phi2 + second_age)
        if local:
            m += p.topo * math.cos(wave * s + p.topo_phase) + profile(s)
            m += p.bump * math.exp(-0.5 * ((s - p.bump_x) / p.bump_w) ** 2)
        if drifting:
            m += p.drift_t * max(t - p.drift_t0, 0.0) + p.drift_x * max(s - p.drift_x0, 0.0)
        return m, p.A + p.C * grown

    return terms


def log_velocity(R: float, a: float, c: float) -> float:
    """Return the x with a x + c e^x = R for a > 0 and c >= 0, by Newton's method from the side where it cannot overshoot."""
    x = R / a
    if c <= 0.0:
        return min(x, FASTEST)
    if R > 0:
        x = min(x, math.log1p(R / c))  # both bounds lie above the root: a convex function, approached from above
    x = min(x, FASTEST)
    for _ in range(60):
        flow = c * math.exp(x)
        step = (a * x + flow - R) / (a + flow)
        x -= step
        if abs(step) < 1e-14 * (1 + abs(x)):
            break
    return x


def ageing(p: Physics) -> Callable[[float, float, float, float], float]:
    """Return f(v, ln phi, W, W') -> d(ln phi)/dt."""

    def rate(v: float, ln_phi: float, W: float, W_dot: float) -> float:
        phi = math.exp(ln_phi)
        D = p.D0 * (v / p.V_D) ** p.D_power if p.D_power else p.D0
        q = max(v * phi / D, 1e-300)
        worn = q if p.p_age == 1.0 else q**p.p_age
        grown = (1 - p.slip_share) * (1 - worn) - (p.slip_share * q * math.log(q) if p.slip_share else 0.0)
        return grown / phi - p.alpha / p.B * W_dot / W - p.age_rate

    return rate


def steady_age(p: Physics, V: float) -> float:
    """Return ln phi in steady sliding at V um/s: where the ageing rate vanishes."""
    from scipy.optimize import brentq

    rate = ageing(p)
    middle = math.log(p.D0 / V)
    return float(brentq(lambda x: rate(V, x, 1.0, 0.0) * math.exp(x), middle - 20, middle + 20, xtol=1e-14))


def stiffness(p: Physics) -> Callable[[float], float]:
    """Return the interface's stiffness in N/um as a function of the load at the asperities."""
    if p.n_kappa == 1.0:
        return lambda W: W / p.lam
    return lambda W: p.Wref / p.lam * (W / p.Wref) ** p.n_kappa
