"""What belongs to one run alone and is estimated with the parameters: its unobserved initial state, a trend of its observable.

Names are RUN.mu (friction at the first sample), RUN.ln_PHI (logarithm of an age there, s) and RUN.trend (per um or per s).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Run

TINY = 1e-30  # imaginary step: exact to rounding, as nothing is subtracted
TRENDS = ("slip", "time")
UNLOADED = 0.1  # least distance of the bounds of a free start's friction: a run may begin without any


def own_names(model: GeneratedModel, run: Run, trend: str | None) -> list[str]:
    """Return the names of what this run adds to the parameters."""
    initial = [f"{run.name}.mu", *(f"{run.name}.{s}" for s in _ages(model))] if run.initial == "free" else []
    return initial + ([f"{run.name}.trend"] if trend else [])


def own_start(
    model: GeneratedModel, run: Run, p: Array, name: str, trend: str | None = None
) -> tuple[float, float, float]:
    """Return a start value and bounds for one of `own_names`; `trend` is what a trend is proportional to, slip if left out."""
    kind = name.rpartition(".")[2]
    if kind == "trend":
        steepest = 10 * float(np.ptp(run.observed)) / max(float(np.ptp(basis(run, trend or "slip"))), 1e-9)
        return 0.0, -max(steepest, 1e-9), max(steepest, 1e-9)
    if kind == "mu":
        first = float(np.median(run.observed[run.used][:5]))
        W = run.load.rest(float(run.t[0]))
        mu = {"elongation": first * run.stiffness / W, "force": first / W, "friction": first}[run.observable]
        wide = max(0.5 * abs(mu), UNLOADED)
        return mu, mu - wide, mu + wide
    steady = float(np.asarray(model.steady(p))[model.states.index(kind)])
    return steady, steady - 15.0, steady + 15.0


def basis(run: Run, trend: str) -> Array:
    """Return what a trend is proportional to: the load point's displacement since the first sample (um), or time (s)."""
    t = run.t - run.t[0]
    if trend == "time":
        return t
    V = run.drive(run.t)
    return np.concatenate([[0.0], np.cumsum(0.5 * (V[1:] + V[:-1]) * np.diff(run.t))])


def start_state(
    model: GeneratedModel,
    run: Run,
    p: Array,
    values: Mapping[str, float],
    by: Sequence[str],
    numbers: Sequence[int] = (),
) -> tuple[Array, Array]:
    """Return the state (n,) at the first sample and its derivatives (n, k): steady sliding, or what `values` say of a free start.

    `numbers` are places in `p`, beyond the parameters, of tables' numbers: columns after those of `by`.

    A free start is in balance: the friction law gives the slip velocity at which mu and the ages meet, z follows it.
    """
    places = {name: model.index(name) for name in by if name in model.names}
    places |= {f"[{place}]": place for place in numbers}
    by = [*by, *(f"[{place}]" for place in numbers)]
    if run.initial != "free":
        x0 = np.asarray(model.steady(p))
        S0 = np.zeros((x0.size, len(by)))
        for k, name in enumerate(by):
            if name in places:
                S0[:, k] = _slope(lambda q: np.asarray(model.steady(q)), p, places[name])
        return x0, S0
    return _balanced(model, run, p, values, by, places)


def _balanced(
    model: GeneratedModel, run: Run, p: Array, values: Mapping[str, float], by: Sequence[str], places: Mapping[str, int]
) -> tuple[Array, Array]:
    states, t0 = list(model.states), float(run.t[0])
    V, W = float(run.drive(run.t[:1])[0]), run.load.rest(t0)
    K, ages, iv = p[model.index("K")], _ages(model), states.index("ln_v")
    mu = values[f"{run.name}.mu"]
    x = np.asarray(model.steady(p)).astype(complex)
    for age in ages:
        x[states.index(age)] = values[f"{run.name}.{age}"]
    for _ in range(60):  # Newton in ln v; friction is close to linear there
        moved = x.copy()
        moved[iv] += 1j * TINY
        found = model.friction(moved, V, W, 0.0, p)
        step = (mu - found.real) / (found.imag / TINY)
        x[iv] += np.clip(step, -3.0, 3.0)
        if abs(step) < 1e-13 * (1 + abs(x[iv])):
            break
    x = x.real

    def friction_slope(place: int | None, of: int | None) -> float:
        y, q = x.astype(complex), p.astype(complex)
        if place is not None:
            q[place] += 1j * TINY
        if of is not None:
            y[of] += 1j * TINY
        return float(np.asarray(model.friction(y, V, W, 0.0, q)).imag / TINY)

    by_ln_v = friction_slope(None, iv)
    S = np.zeros((x.size, len(by)))
    for k, name in enumerate(by):
        own = name.partition(f"{run.name}.")[2]
        if own == "mu":
            S[iv, k] = 1 / by_ln_v
        elif own in ages:
            S[states.index(own), k] = 1.0
            S[iv, k] = -friction_slope(None, states.index(own)) / by_ln_v
        elif name in places:
            S[iv, k] = -friction_slope(places[name], None) / by_ln_v
    if "u" in states:
        x[states.index("u")] = W * mu / K
        S[states.index("u")] = [W / K if n == f"{run.name}.mu" else -W * mu / K**2 if n == "K" else 0.0 for n in by]
    if "z" in states:
        x[states.index("z")] = np.exp(x[iv])
        S[states.index("z")] = np.exp(x[iv]) * S[iv]
    return x, S


def _slope(function: object, p: Array, place: int) -> Array:
    q = p.astype(complex)
    q[place] += 1j * TINY
    return np.asarray(function(q).imag / TINY)  # type: ignore[operator]


def _ages(model: GeneratedModel) -> list[str]:
    return [s for s in model.states if s.startswith("ln_") and s != "ln_v"]
