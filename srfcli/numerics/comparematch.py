"""Laws brought to the same observables at one low velocity, so that what still differs is the law and not its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.errors import SrfError
from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array
from srfcli.numerics.hopf import critical_point, weakening
from srfcli.status import Status

ADJUSTED = ("A", "B", "D0")  # what is adjusted to slope, critical load and critical period
LEVEL = "mu0"  # adjusted to the level of friction, which is what a modulated load works on
STEP, LARGEST, SMALLEST, TOLERANCE = 1e-6, 0.7, 1e-4, 1e-9


@dataclass(frozen=True)
class Observables:
    """What an experiment at low velocity V knows: friction, -d mu_ss/d ln V, critical load (N) and frequency (rad/s) there."""

    V: float
    friction: float
    slope: float
    W0: float
    Omega: float


def observe(model: GeneratedModel, p: Array, V: float) -> Observables | None:
    """Return the observables at velocity `V` of the model with parameters `p` (n_parameters,), None without a Hopf point."""
    q = p.copy()
    q[model.index("V")] = V
    point, _ = critical_point(model, q)
    slope = weakening(model, q)
    if point is None or not slope > 0:
        return None
    q[model.index("W0")] = point.W0
    friction = float(model.cycle_friction(0.0, model.steady(q), [*q.tolist()]))
    return Observables(V, friction, slope, point.W0, point.Omega)


@dataclass(frozen=True)
class Match:
    """A law's parameters `p` (n_parameters,) with the names of those adjusted, and the largest relative miss that is left."""

    p: Array
    adjusted: tuple[str, ...]
    miss: float
    status: Status


def check_adjusted(model: GeneratedModel, names: Sequence[str]) -> None:
    """Raise SrfError unless `names` are three different parameters of the model, mu0 not among them."""
    if len(set(names)) != 3 or len(names) != 3 or LEVEL in names:
        raise SrfError(
            f"--adjust {','.join(names)} is not three parameters other than {LEVEL}",
            f"Three are matched to slope, critical load and period, {LEVEL} to the level: --adjust A,B,D0.",
        )
    for name in names:
        model.index(name)


def match(model: GeneratedModel, p: Array, goal: Observables, names: Sequence[str] = ADJUSTED) -> Match:
    """Return `p` with three parameters, and mu0 where there is one, adjusted until the observables are those of `goal`.

    Newton's method in the parameters' logarithms, from their values in `p`.
    """
    check_adjusted(model, names)
    adjusted = tuple(names)
    level = LEVEL in model.names
    rows = [model.index(n) for n in adjusted]
    q = _levelled(model, p, goal) if level else p.copy()
    miss = _miss(model, q, goal)
    for _ in range(60):
        if miss is None or np.abs(miss).max() < TOLERANCE:
            break
        jacobian = np.empty((3, 3))
        for k, row in enumerate(rows):
            moved = q.copy()
            moved[row] *= 1 + STEP
            there = _miss(model, moved, goal)
            if there is None:
                return Match(q, adjusted, float(np.abs(miss).max()), Status.NO_CONVERGENCE)
            jacobian[:, k] = (there - miss) / STEP
        step = np.linalg.lstsq(jacobian, -miss, rcond=None)[0]
        step *= min(1.0, LARGEST / max(float(np.abs(step).max()), 1e-300))
        shorter, here = 1.0, None
        while shorter > SMALLEST:  # a full step may leave the velocity-weakening regime
            trial = q.copy()
            trial[rows] *= np.exp(shorter * step)
            trial = _levelled(model, trial, goal) if level else trial
            here = _miss(model, trial, goal)
            if here is not None and np.linalg.norm(here) < (1 - 0.1 * shorter) * np.linalg.norm(miss):
                break
            shorter /= 2
        if here is None or shorter <= SMALLEST:
            break
        q, miss = trial, here
    left = np.inf if miss is None else float(np.abs(miss).max())
    if level and miss is not None:
        reached = observe(model, q, goal.V)
        left = max(left, abs(reached.friction / goal.friction - 1)) if reached else np.inf
    names_of_all = (*adjusted, LEVEL) if level else adjusted
    return Match(q, names_of_all, left, Status.OK if left < 1e-6 else Status.NO_CONVERGENCE)


def _miss(model: GeneratedModel, p: Array, goal: Observables) -> Array | None:
    """Return the logarithms of slope, load and frequency over their goals."""
    here = observe(model, p, goal.V)
    if here is None:
        return None
    return np.log([here.slope / goal.slope, here.W0 / goal.W0, here.Omega / goal.Omega])


def _levelled(model: GeneratedModel, p: Array, goal: Observables) -> Array:
    """Return `p` with mu0 such that friction at the goal's velocity is the goal's, by secants: mu0 may not be additive."""
    q, row = p.copy(), model.index(LEVEL)
    q[model.index("V")], q[model.index("W0")] = goal.V, goal.W0

    def off(value: float) -> float:
        q[row] = value
        return float(model.cycle_friction(0.0, model.steady(q), [*q.tolist()])) - goal.friction

    a = float(p[row])
    fa = off(a)
    for _ in range(30):
        h = 1e-6 * max(abs(a), 1e-3)
        slope = (off(a + h) - fa) / h
        if slope == 0:
            break
        a -= fa / slope
        fa = off(a)
        if abs(fa) < 1e-14:
            break
    out = p.copy()
    out[row] = a
    return out
