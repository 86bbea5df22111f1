"""Runs that an apparatus could still make: drives and loads drawn around those that it has shown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from srfcli.inference.prediction import of_run, stiffness_share
from srfcli.numerics.collocation import Array
from srfcli.numerics.program import ConstantLoad, Drive, Load, SampledLoad
from srfcli.recording.values import Experiment, Run

FACTOR = 2.0  # beyond what was shown
FINEST = 8.0  # samples of a period: a load is not known from fewer
VARIES = 0.01  # of the load, from where on a run is one with load steps
MANY = 12  # velocities of a recorded drive that stand for all of them
MOST_EPS = 0.9
LEAD = 0.1  # of a run, in which it begins fast; the same of its way
UNKNOWN = 1.0  # N: what stands for a load that no recording tells
NAME = "parting"
STEPS, HOLD, LOAD, WAVE = "velocity steps", "slide-hold-slide", "load steps", "modulation"


@dataclass(frozen=True)
class Proposal:
    """A run that is not recorded yet: drive as (s, um/s), load W0 (N), its steps (s, N), a modulation with its onset (s).

    `rise` is the time scale (s) of the tanh that steps and switches on; `like` the run whose gauge and sampling it has.
    """

    kind: str
    drive: tuple[tuple[float, float], ...]
    W0: float
    like: str
    interval: float
    rise: float
    steps: tuple[tuple[float, float], ...] = ()
    eps: float = 0.0
    f: float = 0.0
    onset: float = 0.0

    @property
    def duration(self) -> float:
        """Return how long it lasts, in s."""
        return sum(d for d, _ in self.drive)

    def times(self) -> Array:
        """Return its sample times (n,) in s."""
        return np.arange(max(math.ceil(self.duration / self.interval - 1e-9), 2)) * self.interval

    def loads(self, t: Array) -> Array:
        """Return the load (n,) in N at these times."""
        W = np.full(t.size, self.W0)
        for at, jump in self.steps:
            W += 0.5 * jump * (1 + np.tanh((t - at) / self.rise))
        if self.eps:
            envelope = 0.5 * (1 + np.tanh((t - self.onset) / self.rise))
            W += self.eps * self.W0 * envelope * np.cos(2 * np.pi * self.f * t)
        return W

    def changes(self) -> list[tuple[float, str]]:
        """Return when (s) something is changed, and what, in order of time."""
        found, t = [], 0.0
        for (d, V), (_, after) in zip(self.drive, self.drive[1:], strict=False):
            t += d
            verb = "the stage stops" if after == 0 else f"the drive changes from {V:g} to {after:g} um/s"
            found.append((t, verb if V else f"the stage moves again, at {after:g} um/s"))
        W = self.W0
        for at, jump in self.steps:
            found.append((at, f"the load changes from {W:.4g} to {W + jump:.4g} N"))
            W += jump
        if self.eps:
            found.append((self.onset, "the modulation is switched on"))
        return sorted(found)

    def text(self) -> str:
        """Return what is to be done, in words: drive; load."""
        drive = ", then ".join(f"{d:g} s at {V:g} um/s" if V else f"{d:g} s at rest" for d, V in self.drive)
        load = f"{self.W0:g} N"
        for at, jump in self.steps:
            load += f", {'up' if jump > 0 else 'down'} by {abs(jump):g} N at {at:g} s"
        if self.eps:
            load += f", from {self.onset:g} s on modulated by {100 * self.eps:g} % at {self.f:g} Hz"
        return f"{drive}; load {load}"


@dataclass(frozen=True)
class Reach:
    """What an experiment's runs have shown that its apparatus can do; `travel` (um) is the longest way of one run.

    Velocities in um/s, loads in N, `eps` and `jumps` relative to the load, frequencies in Hz, time scales in s.
    """

    V: tuple[float, ...]
    W0: tuple[float, ...]
    eps: tuple[float, ...]
    f: tuple[float, ...]
    jumps: tuple[float, ...]
    onset: float
    switch: float
    rise: float
    travel: float
    plain: Run = field(repr=False)
    modulated: Run = field(repr=False)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return what can be done: a load that was never changed is not going to be."""
        return (STEPS, HOLD, *((LOAD,) if self.jumps else ()), *((WAVE,) if self.eps else ()))


def reach_of(experiment: Experiment) -> Reach:
    """Return what the runs of an experiment, held-out ones too, have shown."""
    waves = {r.name: of_run(r) for r in experiment.runs}
    modulated = [r for r in experiment.runs if waves[r.name]["modulated"]]
    plain = [r for r in experiment.runs if not waves[r.name]["modulated"]]
    jumps, rises = [], []
    for run in plain:
        W, rate = run.load(run.t)
        if np.ptp(W) > VARIES * W.mean():
            jumps.append(float(np.ptp(W) / W[0]))
            rises.append(float(np.ptp(W) / (2 * max(np.abs(rate).max(), 1e-12))))
    shown = [waves[r.name] for r in modulated]
    begun = [(w["onset0"] - r.t[0]) / np.ptp(r.t) for w, r in zip(shown, modulated, strict=True)]
    late = [b for b in begun if 0 < b < 1]
    return Reach(
        _velocities(experiment.runs),
        tuple(r.load.rest(float(r.t[0])) for r in experiment.runs),
        tuple(_digits(w["eps"]) for w in shown), tuple(_digits(w["f"]) for w in shown), tuple(map(_digits, jumps)),
        float(np.median(late)) if late else 0.25,
        _digits(float(np.median([w["rise0"] for w in shown]))) if shown else 0.02,
        _digits(float(np.median(rises))) if rises else 0.05,
        max(float(np.sum(np.abs(r.drive(r.t[:-1])) * np.diff(r.t))) for r in experiment.runs),
        _typical(plain or modulated), _typical(modulated or plain),
    )  # fmt: skip


def _velocities(runs: Sequence[Run]) -> tuple[float, ...]:
    """Return the velocities of driving that runs have shown, in um/s."""
    found: set[float] = set()
    for run in runs:
        if len(run.drive.velocities) <= MANY and not any(run.drive.accelerations):
            found |= {float(f"{V:.3g}") for V in run.drive(run.t).tolist() if V > 0}
        else:
            V = run.drive(run.t)
            V = V[V > 0]
            shares = np.linspace(0.05, 0.95, MANY)
            found |= {float(f"{x:.3g}") for x in np.quantile(V, shares).tolist()} if V.size else set()
    return tuple(sorted(found))


def _typical(runs: Sequence[Run]) -> Run:
    """Return the run of median length; a fitted one, whose noise is known, where there is one."""
    fitted = [r for r in runs if not r.holdout] or list(runs)
    return sorted(fitted, key=lambda r: float(np.ptp(r.t)))[len(fitted) // 2]


def draw(reach: Reach, number: int, rng: np.random.Generator) -> list[Proposal]:
    """Return so many runs, every kind in turn."""
    kinds = reach.kinds
    return [_drawn(reach, kinds[i % len(kinds)], rng) for i in range(number)]


def led_in(proposal: Proposal, reach: Reach) -> Proposal | None:
    """Return the run with a fast beginning, as sliding that is not stable has to begin; None where there is no room for it."""
    (length, V), *rest = proposal.drive
    fastest = max(reach.V)
    lead = _digits(LEAD * min(proposal.duration, reach.travel / fastest))
    if fastest <= V or length <= 2 * lead:
        return None
    return replace(proposal, drive=((lead, fastest), (_digits(length - lead), V), *rest))


def vary(proposal: Proposal, reach: Reach, number: int, rng: np.random.Generator) -> list[Proposal]:
    """Return so many runs near another."""
    found = []
    for _ in range(number):
        like = reach.modulated if proposal.eps else reach.plain
        load = float(np.exp(0.3 * rng.standard_normal()))
        factors = {V: float(np.exp(0.3 * rng.standard_normal())) for _, V in proposal.drive}
        V = [_within(V * factors[V], reach.V) if V else 0.0 for _, V in proposal.drive]
        W0 = _within(proposal.W0 * load, reach.W0) if set(reach.W0) != {UNKNOWN} else UNKNOWN
        jump = float(np.exp(0.3 * rng.standard_normal())) * W0 / proposal.W0
        eps, f = proposal.eps, proposal.f
        if eps:
            eps = min(_within(eps * np.exp(0.3 * rng.standard_normal()), reach.eps), MOST_EPS)
            f = _frequency(f * np.exp(0.3 * rng.standard_normal()), reach, proposal.interval)
        shares = [d / proposal.duration for d, _ in proposal.drive]
        drive = _timed(V, shares, float(np.ptp(like.t)), reach.travel)
        length = sum(d for d, _ in drive) / proposal.duration
        steps = tuple((_digits(at * length), _digits(j * jump)) for at, j in proposal.steps)
        found.append(
            replace(proposal, drive=drive, W0=W0, steps=_allowed(W0, steps, reach), eps=eps, f=f,
                    onset=_digits(proposal.onset * length))
        )  # fmt: skip
    return found


def _drawn(reach: Reach, kind: str, rng: np.random.Generator) -> Proposal:
    def near(values: Sequence[float]) -> float:
        factor = float(np.exp(rng.uniform(-1, 1) * math.log(FACTOR)))
        return _within(values[int(rng.integers(len(values)))] * factor, values)

    like = reach.modulated if kind == WAVE else reach.plain
    interval, span = _digits(float(np.median(np.diff(like.t))), 9), float(np.ptp(like.t))
    V, other, third = near(reach.V), near(reach.V), near(reach.V)
    W0 = near(reach.W0) if set(reach.W0) != {UNKNOWN} else UNKNOWN
    rise = reach.switch if kind == WAVE else reach.rise
    if kind == STEPS:
        drive = _timed([V, other, V, third], [0.25] * 4, span, reach.travel)
        return Proposal(kind, drive, W0, like.name, interval, rise)
    if kind == HOLD:
        drive = _timed([V, 0.0, V], [0.2, rng.uniform(0.3, 0.6), 0.2], span, reach.travel)
        return Proposal(kind, drive, W0, like.name, interval, rise)
    if kind == LOAD:
        drive = _timed([V], [1.0], span, reach.travel)
        jump = _digits(near(reach.jumps) * W0 * (1 if rng.uniform() < 0.6 else -1))
        length = sum(d for d, _ in drive)
        steps = ((_digits(0.3 * length), jump), (_digits(0.65 * length), -jump))
        return Proposal(kind, drive, W0, like.name, interval, rise, _allowed(W0, steps, reach))
    stepped = rng.uniform() < 0.4
    drive = _timed([V, other], [0.6, 0.4], span, reach.travel) if stepped else _timed([V], [1.0], span, reach.travel)
    onset = _digits(min(reach.onset, 0.5) * sum(d for d, _ in drive))
    eps = min(near(reach.eps), MOST_EPS)
    return Proposal(
        kind, drive, W0, like.name, interval, rise, (), eps, _frequency(near(reach.f), reach, interval), onset
    )


def _timed(V: Sequence[float], shares: Sequence[float], span: float, travel: float) -> tuple[tuple[float, float], ...]:
    """Return (duration, velocity) of pieces that last `span` s together, less where the track would be too short."""
    total, travel = sum(shares), (1 - LEAD) * travel
    lengths = [span * s / total for s in shares]
    way = sum(d * v for d, v in zip(lengths, V, strict=True))
    if way > travel:  # the fast pieces are made shorter, each to its share of the way
        lengths = [min(d, travel * s / total / v) if v else d for d, s, v in zip(lengths, shares, V, strict=True)]
    return tuple((_digits(d), v) for d, v in zip(lengths, V, strict=True))


def _allowed(W0: float, steps: tuple[tuple[float, float], ...], reach: Reach) -> tuple[tuple[float, float], ...]:
    """Return steps that keep the load within what was shown, times two."""
    low, high = min(reach.W0) / FACTOR, FACTOR * max(reach.W0)
    size = max((abs(j) for _, j in steps), default=0.0)
    if not size:
        return steps
    room = high - W0 if steps[0][1] > 0 else W0 - low
    shrunk = min(1.0, max(room, 0.1 * W0) / size)
    return tuple((at, _digits(j * shrunk)) for at, j in steps)


def _frequency(value: float, reach: Reach, interval: float) -> float:
    return _digits(min(_within(value, reach.f), 1 / (FINEST * interval)))


def _within(value: float, shown: Sequence[float]) -> float:
    """Return a value, with two digits, no further than a factor of two outside what was shown."""
    return _digits(float(np.clip(_digits(float(value), 2), min(shown) / FACTOR, max(shown) * FACTOR)))


def _digits(value: float, digits: int = 3) -> float:
    return float(f"{value:.{digits}g}")


def run_of(proposal: Proposal, experiment: Experiment) -> Run:
    """Return the run as if it had been recorded, with a gauge that reads zero; it estimates nothing of its own."""
    like = next(r for r in experiment.runs if r.name == proposal.like)
    t = proposal.times()
    begins = np.concatenate([[0.0], np.cumsum([d for d, _ in proposal.drive])[:-1]])
    drive = Drive.steps(list(zip(begins.tolist(), (V for _, V in proposal.drive), strict=True)))
    load: Load = ConstantLoad(proposal.W0)
    if proposal.steps or proposal.eps:
        load = SampledLoad(t, proposal.loads(t))
    modulation = (proposal.f, proposal.eps, proposal.onset) if proposal.eps else None
    run = Run(
        NAME, Path(f"{NAME}.csv"), True, like.start, "steady", t, np.zeros(t.size), like.observable,
        np.ones(t.size, dtype=bool), drive, load, like.stiffness, modulation, 0.0, (),
    )  # fmt: skip
    share = stiffness_share(experiment, run) / stiffness_share(experiment, like)
    return replace(run, stiffness=like.stiffness * share)
