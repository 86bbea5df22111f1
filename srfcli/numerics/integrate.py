"""Time integration of one slider under any drive and load, from discontinuity to discontinuity of what is imposed.

LSODA in the unknowns of the model, of which velocities and ages are logarithms: stick is then a large negative number, not a
singularity. It changes by itself between Adams and backward differentiation formulas.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from srfcli.errors import SrfError
from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array
from srfcli.numerics.program import Drive, Load
from srfcli.numerics.scalar import ScalarFunction, scalar_function
from srfcli.status import Status

MAX_STEPS = 200_000  # between two output times
BEYOND = 1e100  # a rate where the formula overflows: the step is then rejected and cut


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
    rtol: float = 1e-8,
    atol: Array | float | None = None,
) -> Trace:
    """Return the motion at the rising times `t` (s) of the model with parameters `p` (n_parameters,) under `drive` and `load`.

    It starts at t[0] in the state `start` (n,), else in steady sliding under the load at rest. The parameters V, W0, eps and f
    in `p` are not used: drive and load stand in their place. `atol` is per state; left out, it is rtol times 1 for logarithms
    and lengths (um) and rtol times the largest driving velocity for velocities. Errors are local, per step. Misuse raises
    SrfError; an integration that stops early is a status.
    """
    t, q = np.asarray(t, dtype=float), _parameters(model, p, drive, load, t)
    load.check(t[0], t[-1])
    n = len(model.states)
    x = np.full((t.size, n), np.nan)
    x[0] = _start(model, q, start)
    tolerances = (
        _absolute(model, drive, t, rtol) if atol is None else np.broadcast_to(np.asarray(atol, float), x[0].shape)
    )
    rates, jacobian = (scalar_function(model, name, q) for name in ("rates", "rates_jacobian"))
    status, reached, state = Status.OK, float(t[0]), x[0]
    for a, b in _pieces(t, drive, load):
        middle = 0.5 * (a + b)
        f = _frozen(rates, (n,), drive, load, middle)
        df = _frozen(jacobian, (n, n), drive, load, middle)
        wanted = np.nonzero((t > a) & (t <= b))[0]
        times = np.unique([a, *t[wanted], b])
        y, good = _lsoda(f, df, state, times, rtol, tolerances, load.longest_step)
        places = np.searchsorted(times, t[wanted])
        x[wanted[places < good]] = y[places[places < good]]
        reached, state = float(times[good - 1]), y[-1]
        if good < times.size:
            status = Status.INTEGRATION
            break
    return _trace(model, q, drive, load, t, x, status, reached)


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


def _pieces(t: Array, drive: Drive, load: Load) -> Iterator[tuple[float, float]]:
    """Yield the intervals between output's ends and the breaks of drive and load."""
    inside = (b for b in (*drive.breaks, *load.breaks) if t[0] < b < t[-1])
    edges = np.unique([t[0], *inside, t[-1]]).tolist()
    yield from pairwise(edges)


def _frozen(
    function: ScalarFunction, shape: tuple[int, ...], drive: Drive, load: Load, within: float
) -> Callable[[float, Array], object]:
    """Return `function`, whose values have this shape, of (t, x) on the smooth piece that holds at `within`."""
    W_at = load.piece(within)
    V0, acceleration, since = drive.piece(within)

    def at(t: float, x: Array) -> object:
        W, W_dot = W_at(t)
        V = V0 + acceleration * (t - since) if acceleration else V0
        try:
            return function(x.tolist(), V, W, W_dot)
        except (ArithmeticError, ValueError):
            return np.full(shape, BEYOND)

    return at


def _lsoda(
    f: Callable[[float, Array], object],
    df: Callable[[float, Array], object],
    start: Array,
    times: Array,
    rtol: float,
    atol: Array,
    longest: float,
) -> tuple[Array, int]:
    """Return the states (times, n) and how many of them were reached."""
    from scipy.integrate import ODEintWarning, odeint

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", ODEintWarning)  # told by the status instead
        y, info = odeint(
            f, start, times, Dfun=df, tfirst=True, rtol=rtol, atol=atol, tcrit=[times[-1]],
            hmax=longest if math.isfinite(longest) else 0.0, mxstep=MAX_STEPS, full_output=True,
        )  # fmt: skip
    if info["message"] == "Integration successful.":
        finite = np.isfinite(y).all(axis=1)
        return y, times.size if finite.all() else int(np.argmin(finite))
    # LSODA's own clock `tcur` stands still at the output interval it failed in; what lies beyond is not filled
    reached = info["tcur"]
    failed = np.nonzero(reached < times[1:])[0]
    return y, int(failed[0]) + 1 if failed.size else 1


def _trace(
    model: GeneratedModel, q: Array, drive: Drive, load: Load, t: Array, x: Array, status: Status, reached: float
) -> Trace:
    V, (W, W_dot) = drive(t), load(t)
    with np.errstate(all="ignore"):
        mu, u = model.friction(x, V, W, W_dot, q), model.elongation(x, V, W, W_dot, q)
        ages = [i for i, name in enumerate(model.states) if name.startswith("ln_") and name != "ln_v"]
        v, phi = np.exp(x[:, model.states.index("ln_v")]), np.exp(x[:, ages[0]])
    return Trace(tuple(model.states), t, x, u, v, phi, mu, W, V, status, reached)
