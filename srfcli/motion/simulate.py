"""Records of one slider over time, and stick-slip in them.

The unknowns are those of the model, of which velocities and ages are logarithms: stick is then a large negative number, not a
singularity. What is imposed is smooth from discontinuity to discontinuity, and no step crosses one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.codegen.splines import Spline, appended
from srfcli.core.errors import SrfError, Status
from srfcli.motion.imposed import Drive, Load
from srfcli.motion.integrators import Stopped, integrate


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
    are local, per step. Misuse raises SrfError; an integration that stops early, or is interrupted by Ctrl-C, is a status.
    """
    t, q = np.asarray(t, dtype=float), _parameters(model, p, drive, load, t)
    load.check(t[0], t[-1])
    n = len(model.states)
    tolerances = _absolute(model, drive, t, rtol) if atol is None else np.broadcast_to(np.asarray(atol, float), (n,))
    full = appended(q, tables)
    begun = _start(model, full, start)
    try:
        motion = integrate(model, q, drive=drive, load=load, t=t, start=begun, tables=tables, rtol=rtol, atol=tolerances)
    except Stopped as stop:
        motion = stop.motion
    x, V, (W, W_dot) = motion.x, drive(t), load(t)
    age = next(i for i, name in enumerate(model.states) if name.startswith("ln_") and name != "ln_v")
    with np.errstate(all="ignore"):
        mu, u = model.friction(x, V, W, W_dot, full), model.elongation(x, V, W, W_dot, full)
        v, phi = np.exp(x[:, model.states.index("ln_v")]), np.exp(x[:, age])
    return Trace(tuple(model.states), t, x, u, v, phi, mu, W, V, motion.status, motion.reached)


def _parameters(model: GeneratedModel, p: Array, drive: Drive, load: Load, t: Array) -> Array:
    t, q = np.asarray(t, dtype=float), np.array(p, dtype=float)
    if t.ndim != 1 or t.size < 2 or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise SrfError("output times must be two or more finite numbers that rise", "t = np.linspace(0, 10, 2001), say")
    if q.shape != (len(model.names),):
        raise SrfError(f"one set of {len(model.names)} parameters is needed, not an array of shape {q.shape}", "model.vector()")
    q[model.index("V")] = drive.at(float(t[0]))
    q[model.index("W0")] = load.rest(float(t[0]))
    return q


def _start(model: GeneratedModel, q: Array, start: Array | None) -> Array:
    if start is None:
        if q[model.index("V")] <= 0:
            raise SrfError("the drive does not move forward at first: there is no steady sliding to start from", "give start")
        return np.asarray(model.steady(q))
    x = np.array(start, dtype=float)
    if x.shape != (len(model.states),) or not np.isfinite(x).all():
        raise SrfError(f"start must be {len(model.states)} finite numbers: {', '.join(model.states)}", "model.steady(p) is one")
    return x


def _absolute(model: GeneratedModel, drive: Drive, t: Array, rtol: float) -> Array:
    """Return the default absolute tolerances, (n,)."""
    ends = drive(np.unique([*t[[0, -1]], *(b for b in drive.breaks if t[0] < b < t[-1])]))
    fastest = max(float(np.abs(ends).max()), 1e-3)
    return rtol * np.array([fastest if name == "z" else 1.0 for name in model.states])


# Stick-slip in a record: where the spring lets go, by how much and how often.

EVENT_DROP = 0.3  # of the typical drop: what falls by less is no event
EVENT_NOISE = 8.0  # standard deviations of the samples' scatter that an event must exceed
FLOOR = 1e-5  # of the largest elongation: below it lies what integration and rounding do
DECAY = 0.7  # the drops of the second half against those of the first, of an oscillation that lasts


@dataclass(frozen=True)
class StickSlip:
    """The events of a record, oldest first: arrays (n,) of times (s, at half of the drop), of the elongation from which
    it fell and of the drops (in the unit of u), and of how long each fall took (s). `span` is the record's (first, last) time.
    """

    times: Array
    tops: Array
    drops: Array
    falls: Array
    span: tuple[float, float]

    @property
    def recurrence(self) -> Array:
        """Return the times between events, (n - 1,)."""
        return np.diff(self.times)

    @property
    def period(self) -> float:
        """Return the median time between events, NaN where there are fewer than two."""
        return float(np.median(self.recurrence)) if self.times.size > 1 else float("nan")

    @property
    def drop(self) -> float:
        """Return the median drop, NaN without events."""
        return float(np.median(self.drops)) if self.times.size else float("nan")

    @property
    def sustained(self) -> bool:
        """True for three events or more that neither die out nor end two periods before the record does."""
        if self.times.size < 3 or self.span[1] - self.times[-1] > 2 * self.period:
            return False
        half = self.times.size // 2
        return bool(np.median(self.drops[-half:]) > DECAY * np.median(self.drops[:half]))


def stick_slip(t: Array, u: Array, *, ripple: float | None = None, smallest: float | None = None) -> StickSlip:
    """Return the falls of `u` (n,) over the rising times `t` (n,): stick-slip events, and what else falls and rises again.

    An event is a fall, after which u rises by as much again, of at least eight times the samples' scatter, and of `smallest`;
    without it, of 1e-5 of the largest |u| and 0.3 of the typical fall, below which half the sum of squared falls lies. `ripple`
    is the frequency (Hz) of a modulation: u is then averaged over its period first, so that the ripple is no event. Samples that
    are not finite are left out. Raises SrfError for arrays that are no record.
    """
    t, u = np.asarray(t, dtype=float), np.asarray(u, dtype=float)
    if t.ndim != 1 or t.shape != u.shape:
        raise SrfError("a record needs as many values as times", f"t has shape {t.shape}, u {u.shape}")
    good = np.isfinite(t) & np.isfinite(u)
    t, u = t[good], u[good]
    if (np.diff(t) <= 0).any():
        raise SrfError("the times of a record must rise", "drop repeated and backward times first")
    span = (float(t[0]), float(t[-1])) if t.size else (float("nan"), float("nan"))
    none = np.empty(0)
    empty = StickSlip(none, none, none, none, span)
    if ripple is not None:
        t, u = _averaged(t, u, ripple)
    if t.size < 5:
        return empty
    white = float(np.median(np.abs(np.diff(u, 3))) / (0.6745 * np.sqrt(20.0)))  # noise that scatters third differences as much
    threshold = max(EVENT_NOISE * white, FLOOR * float(np.abs(u).max()) if smallest is None else smallest)
    found = _falls(u, threshold) if threshold > 0 else []
    if smallest is None and found:
        found = _falls(u, max(threshold, EVENT_DROP * _typical(u[[a for a, _ in found]] - u[[b for _, b in found]])))
    if not found:
        return empty
    top, bottom = np.array(found).T
    times = np.array([_crossing(t[a : b + 1], u[a : b + 1]) for a, b in found])
    return StickSlip(times, u[top], u[top] - u[bottom], t[bottom] - t[top], span)


def _typical(drops: Array) -> float:
    """Return the median of the drops, each weighted by its square: many small ones and a single large one do not move it."""
    ranked = np.sort(drops)
    shares = np.cumsum(ranked**2)
    return float(ranked[np.searchsorted(shares, 0.5 * shares[-1])])


def _averaged(t: Array, u: Array, frequency: float) -> tuple[Array, Array]:
    """Return `u` averaged over one period about each time that has half a period on both sides."""
    from scipy.interpolate import CubicSpline

    if not (np.isfinite(frequency) and frequency > 0):
        raise SrfError(f"a ripple of {frequency:g} Hz is no frequency", "give it above 0, or leave it out")
    half = 0.5 / frequency
    inside = t[(t >= t[0] + half) & (t <= t[-1] - half)] if t.size else t
    if t.size < 4 or inside.size < 5 or np.median(np.diff(t)) > half:
        return t, u  # too short, or sampled too coarsely to see the ripple
    whole = CubicSpline(t, u).antiderivative()
    return inside, (whole(inside + half) - whole(inside - half)) * frequency


def _falls(u: Array, threshold: float) -> list[tuple[int, int]]:
    """Return (top, bottom), as indices, of each fall by `threshold` that is followed by as large a rise."""
    turns = np.nonzero(np.diff(np.sign(np.diff(u))))[0] + 1
    places = [0, *turns.tolist(), u.size - 1]
    values = u[places].tolist()
    found: list[tuple[int, int]] = []
    falling, top, bottom = False, 0, 0
    for i, value in enumerate(values):
        if not falling:
            if value > values[top]:
                top = i
            elif values[top] - value >= threshold:
                falling, bottom = True, i
        elif value < values[bottom]:
            bottom = i
        elif value - values[bottom] >= threshold:
            found.append((places[top], places[bottom]))
            falling, top = False, i
    return found


def _crossing(t: Array, u: Array) -> float:
    """Return the time at which a fall has passed half of its drop; at a flat top the maximum's own time is chance."""
    level = 0.5 * (u[0] + u[-1])
    i = int(np.argmax(u <= level))
    return float(t[i - 1] + (u[i - 1] - level) / (u[i - 1] - u[i]) * (t[i] - t[i - 1]))
