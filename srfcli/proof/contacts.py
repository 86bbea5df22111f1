"""Where friction force, slip velocity and spring elongation come from: three kinds of slider."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from srfcli.proof.equations import FASTEST, log_velocity, stiffness
from srfcli.proof.physics import Physics

Sliding = tuple[float, float, float]  # slip velocity um/s, elongation of the spring um, friction force N
Slide = Callable[[list[float], float, float, float, float], Sliding]  # of states, m, a, load, force along the drive
Push = Callable[[list[float], Sliding, float, float], list[float]]  # of states, the above, stage velocity, force along


@dataclass(frozen=True)
class Contact:
    """A slider's mechanical states, what they say about its sliding, their rates, and their values in steady sliding."""

    names: tuple[str, ...]
    slide: Slide
    push: Push
    steady: Callable[[float, float, float], list[float]]  # of velocity, friction force, load


def build_contact(p: Physics) -> Contact:
    """Return the slider that `p` describes: without mass, rigid with mass, or elastic with mass."""
    return _massless(p) if p.massless else _rigid(p) if p.rigid else _elastic(p)


def _elastic(p: Physics) -> Contact:
    """The stretch e of the interface is a state: kappa e + eta (z - v) = F = (W + Wa) mu(v, phi) gives v."""
    kappa = stiffness(p)

    def slide(y: list[float], m: float, a: float, W: float, aside: float) -> Sliding:
        weight = W + p.Wa
        pull = kappa(W) * y[2] + p.eta * y[1]
        v = p.V0 * math.exp(log_velocity(pull / weight - m, a, p.drag + p.eta * p.V0 / weight))
        return v, y[0], pull - p.eta * v

    def push(y: list[float], sliding: Sliding, V: float, aside: float) -> list[float]:
        v, u, F = sliding
        return [V - y[1], (p.spring * u + aside - F) / p.M, y[1] - v]

    return Contact(("u", "z", "e"), slide, push, lambda V, F, W: [F / p.spring, V, F / kappa(W)])


def _rigid(p: Physics) -> Contact:
    """There is nothing to stretch: ln v is a state, which inertia moves."""

    def slide(y: list[float], m: float, a: float, W: float, aside: float) -> Sliding:
        x = min(y[1], FASTEST)
        v = p.V0 * math.exp(x)
        return v, y[0], (W + p.Wa) * (m + a * x + p.drag * v / p.V0)

    def push(y: list[float], sliding: Sliding, V: float, aside: float) -> list[float]:
        v, u, F = sliding
        return [V - v, (p.spring * u + aside - F) / (p.M * v)]

    return Contact(("u", "ln_v"), slide, push, lambda V, F, W: [F / p.spring, math.log(V / p.V0)])


def _massless(p: Physics) -> Contact:
    """Spring and interface in series carry the friction force; their joint stretch D is the state."""
    kappa = stiffness(p)

    def slide(y: list[float], m: float, a: float, W: float, aside: float) -> Sliding:
        yielding = 1 / p.spring + (0.0 if p.rigid else 1 / kappa(W))
        F = (y[0] + aside / p.spring) / yielding
        return p.V0 * math.exp(log_velocity(F / (W + p.Wa) - m, a, p.drag)), (F - aside) / p.spring, F

    def push(y: list[float], sliding: Sliding, V: float, aside: float) -> list[float]:
        return [V - sliding[0]]

    return Contact(("D",), slide, push, lambda V, F, W: [F / p.spring + (0.0 if p.rigid else F / kappa(W))])
