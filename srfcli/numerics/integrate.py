"""Time integration of one slider under any drive and load, as an experimenter would plot it.

The unknowns are those of the model, of which velocities and ages are logarithms: stick is then a large negative number, not a
singularity. What is imposed is smooth from discontinuity to discontinuity, and no step crosses one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.errors import SrfError
from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array
from srfcli.numerics.load import Load
from srfcli.numerics.motion import integrate
from srfcli.numerics.program import Drive
from srfcli.splines import Spline, appended
from srfcli.status import Status


@dataclass(frozen=True)
class Trace:
    """A simulated record at the times `t` (s): `x` (times, n) in the model's states, and what an experimenter would plot.

    u in um, v in um/s (slip velocity of the interface), phi in s (the first age), mu, W in N (the imposed load), V in um/s.
    Where `status` is not ok, everything after the time `reached` is NaN.
    """

    states: tuple[str, ...]
    t: Array
    x: Array
    u: Array
    v: Array
    phi: Array
    mu: Array
    W: Array
    V: Array
    status: Status
    reached: float

    def state(self, name: str) -> Array:
        """Return one state over time, by its name in `states`; logarithms stay logarithms."""
        if name not in self.states:
            raise SrfError(f"unknown state '{name}'", f"known: {', '.join(self.states)}")
        return self.x[:, self.states.index(name)]


def simulate(
    model: GeneratedModel,
    p: Array,
    *,
    drive: Drive,
    load: Load,
    t: Array,
    start: Array | None = None,
    tables: Sequence[Spline] = (),
    rtol: float = 1e-8,
    atol: Array | float | None = None,
) -> Trace:
    """Return the motion at the rising times `t` (s) of the model with parameters `p` (n_parameters,) under `drive` and `load`.

    It starts at t[0] in the state `start` (n,), else in steady sliding under the load at rest. The parameters V, W0, eps and f
    in `p` are not used: drive and load stand in their place. A model with tables takes them in order. `atol` is per state; left
    out, it is rtol times 1 for logarithms and lengths (um) and rtol times the largest driving velocity for velocities. Errors
    are local, per step. Misuse raises SrfError; an integration that stops early is a status.
    """
    t, q = np.asarray(t, dtype=float), _parameters(model, p, drive, load, t)
    load.check(t[0], t[-1])
    n = len(model.states)
    tolerances = _absolute(model, drive, t, rtol) if atol is None else np.broadcast_to(np.asarray(atol, float), (n,))
    full = appended(q, tables)
    motion = integrate(
        model, q, drive=drive, load=load, t=t, start=_start(model, full, start), tables=tables, rtol=rtol, atol=tolerances
    )  # fmt: skip
    return _trace(model, full, drive, load, t, motion.x, motion.status, motion.reached)


def _parameters(model: GeneratedModel, p: Array, drive: Drive, load: Load, t: Array) -> Array:
    t, q = np.asarray(t, dtype=float), np.array(p, dtype=float)
    if t.ndim != 1 or t.size < 2 or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise SrfError("output times must be two or more finite numbers that rise", "t = np.linspace(0, 10, 2001), say")
    if q.shape != (len(model.names),):
        raise SrfError(
            f"one set of {len(model.names)} parameters is needed, not an array of shape {q.shape}", "model.vector()"
        )
    V, rate, since = drive.piece(float(t[0]))
    q[model.index("V")] = V + rate * (float(t[0]) - since) if rate else V
    q[model.index("W0")] = load.rest(float(t[0]))
    return q


def _start(model: GeneratedModel, q: Array, start: Array | None) -> Array:
    if start is None:
        if q[model.index("V")] <= 0:
            raise SrfError(
                "the drive does not move forward at first: there is no steady sliding to start from", "give start"
            )
        return np.asarray(model.steady(q))
    x = np.array(start, dtype=float)
    if x.shape != (len(model.states),) or not np.isfinite(x).all():
        raise SrfError(
            f"start must be {len(model.states)} finite numbers: {', '.join(model.states)}", "model.steady(p) is one"
        )
    return x


def _absolute(model: GeneratedModel, drive: Drive, t: Array, rtol: float) -> Array:
    """Return the default absolute tolerances, (n,)."""
    ends = drive(np.unique([*t[[0, -1]], *(b for b in drive.breaks if t[0] < b < t[-1])]))
    fastest = max(float(np.abs(ends).max()), 1e-3)
    return rtol * np.array([fastest if name == "z" else 1.0 for name in model.states])


def _trace(
    model: GeneratedModel, q: Array, drive: Drive, load: Load, t: Array, x: Array, status: Status, reached: float
) -> Trace:
    V, (W, W_dot) = drive(t), load(t)
    with np.errstate(all="ignore"):
        mu, u = model.friction(x, V, W, W_dot, q), model.elongation(x, V, W, W_dot, q)
        ages = [i for i, name in enumerate(model.states) if name.startswith("ln_") and name != "ln_v"]
        v, phi = np.exp(x[:, model.states.index("ln_v")]), np.exp(x[:, ages[0]])
    return Trace(tuple(model.states), t, x, u, v, phi, mu, W, V, status, reached)
