"""The run of a slider from steady sliding: states joined, integrated by backward differentiation formulas, read by a gauge."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from scipy.integrate import ode

from srfcli.proof.contacts import Contact, Sliding, build_contact
from srfcli.proof.equations import Felt, ageing, at_unit_velocity, felt_load, steady_age
from srfcli.proof.physics import Physics
from srfcli.proof.protocol import Plan

RTOL = 1e-8
SMALLEST = {"u": 1e-8, "z": 1e-6, "e": 1e-10, "D": 1e-9, "s": 1e-7}  # absolute tolerances, um and um/s; others 1e-8
LONGEST_STEP = 0.01  # s: no step jumps over the beginning of a load step
OVERSHOOT = 60.0  # um, of slip beyond the stage's displacement
MOST_STEPS = 200_000  # from one sample to the next
Array = np.ndarray


class Slider:
    """The first-order system of one run. States: the contact's, ln phi, slip, then only what the effects at work need."""

    def __init__(self, p: Physics, plan: Plan) -> None:
        self.p, self.plan = p, plan
        self.contact: Contact = build_contact(p)
        self._felt = felt_load(p, plan)
        self._terms = at_unit_velocity(p, plan.distance + OVERSHOOT)
        self._aged = ageing(p)
        extra = {"ln_phi2": p.B2, "Wm": p.memory, "gauge": p.lag, "stage": p.drive_tau, "X": p.ripple}
        self.names = (*self.contact.names, "ln_phi", "s", *(name for name, size in extra.items() if size))
        self._age = len(self.contact.names)
        where = [self.names.index(name) if name in self.names else 0 for name in extra]  # 0 is always mechanical
        self._age2, self._delay, self._gauge, self._stage, self._X = where

    def sliding(self, t: float, y: list[float]) -> tuple[Sliding, Felt]:
        """Return slip velocity, elongation and friction force, and the load at the asperities, at time t in s."""
        felt, p = self._felt(t), self.p
        if self._delay:
            late = y[self._delay]
            rate = (felt.W - late) / p.memory_tau
            W = felt.W + p.memory * (late - felt.W)
            felt = Felt(W, felt.rate + p.memory * (rate - felt.rate), felt.excess)
        m, a = self._terms(t, y[self._age + 1], y[self._age], y[self._age2] if self._age2 else 0.0, felt.W)
        return self.contact.slide(y, m, a, felt.W, -p.cross * felt.excess), felt

    def rates(self, t: float, states: Array, V: float) -> list[float]:
        """Return the rates of the states at time t in s, where the stage's nominal velocity is V um/s."""
        y, p, nominal = states.tolist(), self.p, V
        sliding, felt = self.sliding(t, y)
        v, u, _ = sliding
        if self._stage:
            V = y[self._stage]
        if self._X:
            V *= 1 + p.ripple * math.cos(2 * math.pi * y[self._X] / p.ripple_p + p.ripple_phase)
        out = self.contact.push(y, sliding, V, -p.cross * felt.excess)
        out += (self._aged(v, y[self._age], felt.W, felt.rate), v)
        if self._age2:
            out.append(math.exp(-y[self._age2]) - v / p.D2)
        if self._delay:
            out.append((self._felt(t).W - y[self._delay]) / p.memory_tau)
        if self._gauge:
            out.append((u - y[self._gauge]) / p.lag)
        if self._stage:
            out.append((nominal - y[self._stage]) / p.drive_tau)
        if self._X:
            out.append(nominal)
        return out

    def shown(self, t: float, y: list[float]) -> float:
        """Return the elongation in um that the gauge shows."""
        return y[self._gauge] if self._gauge else self.sliding(t, y)[0][1]

    def steady(self) -> list[float]:
        """Return the states of steady sliding at the run's first velocity and load."""
        p, V, W = self.p, self.plan.drive[0][1], self._felt(0.0).W
        ln_phi, ln_phi2 = steady_age(p, V), math.log(p.D2 / V)
        m, a = self._terms(0.0, 0.0, ln_phi, ln_phi2, W)
        F = (W + p.Wa) * (m + a * math.log(V / p.V0) + p.drag * V / p.V0)
        extra = {"ln_phi2": ln_phi2, "Wm": W, "gauge": F / p.spring, "stage": V, "X": 0.0}
        mechanical = self.contact.steady(V, F, W)
        return [*mechanical, ln_phi, 0.0, *(extra[name] for name in self.names[len(mechanical) + 2 :])]


@dataclass(frozen=True)
class Trace:
    """What happened in a run: times (n,), gauge reading u (n,) without noise; NaN from where the solver gave up."""

    t: Array
    u: Array

    @property
    def complete(self) -> bool:
        return bool(np.isfinite(self.u).all())


def move(p: Physics, plan: Plan, *, rtol: float = RTOL) -> Trace:
    """Return the motion of one run at its sample times, integrated anew from every step of the drive."""
    slider = Slider(p, plan)
    t = plan.times()
    trace = Trace(t, np.full(t.size, np.nan))
    edges = [0.0, *accumulate(d for d, _ in plan.drive)]
    y: Array | None = np.array(slider.steady())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # what the solver has to say is that it gave up: the NaN say so
        for (_, V), begin, end in zip(plan.drive, edges, edges[1:], strict=False):
            solver = _solver(slider, rtol).set_f_params(V).set_initial_value(y, begin)
            y = _through(slider, solver, trace, end)
            if y is None:
                break
    return trace


def _solver(slider: Slider, rtol: float) -> ode:
    tolerance = [SMALLEST.get(name, 1e-8) * rtol / RTOL for name in slider.names]
    longest = min(LONGEST_STEP, 0.25 / slider.plan.f) if slider.plan.eps else LONGEST_STEP
    options = {"rtol": rtol, "atol": tolerance, "nsteps": MOST_STEPS, "max_step": longest}
    # with_jacobian: Newton's method with differences; without it VODE iterates the stiff equations as they stand
    return ode(slider.rates).set_integrator("vode", method="bdf", with_jacobian=True, **options)


def _through(slider: Slider, solver: ode, trace: Trace, end: float) -> Array | None:
    """Follow one piece of the drive to its end, reading the gauge, and return the states there; None where it was not reached."""
    t = trace.t
    try:
        for k in np.flatnonzero((t >= solver.t - 1e-9) & (t < end - 1e-9)).tolist():
            if t[k] > solver.t:
                solver.integrate(t[k])
            if not solver.successful():
                return None
            trace.u[k] = slider.shown(float(t[k]), solver.y.tolist())
        y: Array = solver.integrate(end)
    except OverflowError:  # a state ran away
        return None
    return y if solver.successful() else None
