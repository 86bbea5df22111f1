"""The discriminating design: the run that would tell apart hypotheses which explain a recording equally well.

Of many runs that the apparatus can make, each fitted model says what it would see. What counts is the part of their difference
that no refit could absorb: with d the standardised innovations of the wrong model over what the true one shows, X their
derivatives by all that is free in the wrong model, and Q what the recordings so far say of that, the log likelihood that the
wrong model loses is on average

    gain = min over z of (|d - X z|^2 + z' Q z) / 2 = d' (1 + X Q^-1 X')^-1 d / 2,

lambda (1 - rho^2) / 2 in the words of experimental design. A random friction field takes its own part of the difference, as in
any fit. The gain is taken for the worse of the two ways round, the best runs are found by it, and theirs is found again with the
motion itself in place of its derivatives.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.codegen.model import Array
from srfcli.data.values import OBSERVABLES, Experiment, Run, per_elongation, shown_unit
from srfcli.data.writing import DESCRIPTION, experiment_files, run_csv
from srfcli.diagnosis.augment import augment
from srfcli.diagnosis.search import Fitted
from srfcli.diagnosis.verdict import Diagnosis
from srfcli.inference.fit import Problem, solve_scaled
from srfcli.inference.prediction import effect_inputs, predict, run_parameters, stiffness_share
from srfcli.laws.registry import Registry
from srfcli.motion.imposed import ConstantLoad, Drive, Load, SampledLoad

# The experiment that would discriminate between hypotheses which explain a recording equally well.

DISCRIMINATING_GAIN = 12.0  # of log likelihood: hypotheses so far apart are told apart
MIN_DESIGN_GAIN = 3.0  # below which a run is not worth making
MOST_HYPOTHESES = 3  # hypotheses between which a run is to discriminate
CANDIDATE_RUNS, VARIATIONS = 60, 16  # runs that are tried, and variations of the best of them
MAX_GAINS_COMPUTED = 36  # of these, how many with derivatives, at most
MAX_REFITTED = 3  # of the best, how many with the motion itself
NEWTON_ROUNDS = 10  # of Gauss and Newton
MAX_GROWTH = 0.1  # e-foldings in a run that leave sliding as steady as it was
MAX_REPEATS = 100  # of a run that nobody will go beyond
DURATION_TRIALS = 60  # parts of a run, to find how much of it suffices


@dataclass(frozen=True)
class DiscriminatingRun:
    """The run that discriminates best between hypotheses: `proposal`, as a `run` too, and the expected `gain` in log likelihood.

    `gains` has what the others lose by the name of the true one, the gain is the least of them. `seconds` of such a recording
    gain 12, in `repeats` of the run, or None where no number of them does. The two of `pair`, which are least apart, differ most
    at `at` s, the wrong one refitted: the first is `peak` above the second, in the observable's `unit`, `peak_um` of the
    spring's elongation. `noise` is the gauge's level, `predicted` (n,) what each shows, `tried` how many runs were looked at.
    """

    names: tuple[str, ...]
    proposal: Proposal
    run: Run = field(repr=False)
    gain: float
    gains: Mapping[str, float]
    seconds: float | None
    repeats: int | None
    pair: tuple[str, str]
    at: float
    peak: float
    peak_um: float
    unit: str
    noise: float
    predicted: Mapping[str, Array] = field(repr=False)
    tried: int
    load_unit: str

    @property
    def discriminates(self) -> bool:
        """Return whether the run is worth making."""
        return self.gain >= MIN_DESIGN_GAIN


@dataclass(frozen=True)
class RivalModel:
    """A fitted hypothesis that is to predict a run: precision (k, k) of its parameters over `scale` (k,), by what is recorded."""

    fitted: Fitted
    names: tuple[str, ...]
    scale: Array
    precision: Array

    @classmethod
    def of(cls, fitted: Fitted) -> RivalModel:
        """Return the side of a hypothesis; what belongs to one recorded run alone is not free in another."""
        likelihood, point = fitted.fit.likelihood, fitted.fit.maximum.point
        kept = [i for i, n in enumerate(likelihood.names) if "." not in n]
        others = [i for i in range(len(likelihood.names)) if i not in kept]
        unit = likelihood.unit(point.x)
        scale = np.maximum(np.abs([point.values[likelihood.names[i]] for i in kept]), 1e-12)
        I = point.information / np.outer(unit, unit)
        own = I[np.ix_(kept, kept)]
        if others:
            cross = I[np.ix_(others, kept)]
            own = own - cross.T @ np.linalg.pinv(I[np.ix_(others, others)], hermitian=True) @ cross
        return cls(fitted, tuple(likelihood.names[i] for i in kept), scale, own * np.outer(scale, scale))

    @property
    def problem(self) -> Problem:
        """Return the problem that was fitted."""
        return self.fitted.fit.likelihood.problem

    def values(self, z: Array | None = None) -> dict[str, float]:
        """Return the parameters after steps z (k,) from the fit, within their bounds."""
        likelihood, found = self.fitted.fit.likelihood, dict(self.fitted.fit.values)
        if z is not None:
            moved = {n: found[n] + float(s * step) for n, s, step in zip(self.names, self.scale, z, strict=True)}
            found = likelihood.values(likelihood.coordinates({**found, **moved}))
        return found

    def steady(self, run: Run) -> bool:
        """Return whether the sliding with which a run begins is stable: no apparatus begins with any other."""
        model = self.problem.model
        p = run_parameters(model, self.problem.experiment, run, {**self.values(), "field_amplitude": 0.0})
        V, W = run.drive.at(float(run.t[0])), run.first_load
        J = np.asarray(model.rates_jacobian(np.asarray(model.steady(p)), V, W, 0.0, p), dtype=float)
        return bool(np.linalg.eigvals(J).real.max() * float(np.ptp(run.t)) < MAX_GROWTH)

    def predicted(self, run: Run) -> Array | None:
        """Return what the hypothesis predicts (n,), on a smooth track; None if it cannot be followed."""
        found = predict(self.problem.model, self.problem.experiment, run, {**self.values(), "field_amplitude": 0.0})
        return found.y if found.status.ok and np.isfinite(found.y).all() else None

    def lack_of_fit(self, run: Run, y: Array, z: Array | None = None, *, slopes: bool = True) -> LackOfFit | None:
        """Return what is lost after steps z (k,) where `y` (n,) is shown, by innovations; None if it cannot be followed."""
        f = self.fitted.fit.likelihood.filtered(replace(run, observed=y), self.values(z), slopes=slopes)
        if not f.whole:
            return None
        X, size = np.zeros((y.size, len(self.names))), np.sqrt(f.found.S)
        for j, (name, scale) in enumerate(zip(self.names, self.scale, strict=True)):
            if name in f.names:
                X[:, j] = -f.found.nu_d[:, f.names.index(name)] / size * scale
        return LackOfFit(f.white, X, self.precision, f.found.nu)


@dataclass(frozen=True)
class LackOfFit:
    """What a wrong model loses: `w` (n,) and `X` (n, k) standardised, `Q`; `difference` (n,) is the difference itself."""

    w: Array
    X: Array
    Q: Array
    difference: Array

    def gain(self, *, samples: int | None = None, times: float = 1.0) -> float:
        """Return the log likelihood lost in the first `samples`, in a run made `times` times."""
        w, X = self.w[:samples], self.X[:samples]
        b = times * (X.T @ w)
        return 0.5 * max(times * float(w @ w) - float(b @ solve_scaled(times * (X.T @ X) + self.Q, b)), 0.0)


@dataclass(frozen=True)
class PredictedRun:
    """A run as the hypotheses predict it: `y` (n,) by name; `bound` no gain exceeds, `gain` at first order where known."""

    proposal: Proposal
    run: Run
    y: dict[str, Array]
    bound: float
    gain: float = 0.0


def discriminating_run(
    registry: Registry, diagnosis: Diagnosis, *, seed: int = 0, tried: int = CANDIDATE_RUNS, varied: int = VARIATIONS
) -> DiscriminatingRun | None:
    """Return the run that would discriminate between what a diagnosis found equally good; None where that is one hypothesis.

    Looked for are runs with the apparatus' own velocities, loads and modulations, and up to twice beyond them: so many are
    `tried`, and so many of the best are `varied`.
    """
    rivals = rival_models(diagnosis)
    if diagnosis.verdict != "ambiguous" or len(rivals) < 2:
        return None
    return Design(diagnosis.experiment, rivals, seed).best(tried, varied)


def rival_models(diagnosis: Diagnosis) -> tuple[RivalModel, ...]:
    """Return the hypotheses between which a run is to discriminate, three at most."""
    return tuple(RivalModel.of(f) for f in diagnosis.close[:MOST_HYPOTHESES])


class Design:
    """The search for a run among those that an apparatus can make."""

    def __init__(self, experiment: Experiment, rivals: Sequence[RivalModel], seed: int) -> None:
        self.experiment, self.rivals = experiment, tuple(rivals)
        self.pairs = list(permutations(rivals, 2))  # of a true and a wrong hypothesis
        self.apparatus: Capabilities = capabilities_of(experiment)
        self.rng = np.random.default_rng(seed)
        self.tried = 0

    def best(self, tried: int, varied: int) -> DiscriminatingRun | None:
        """Return the best run of so many, and of variations of it; None where no model can be followed through any."""
        looked = self.first_order_gains(draw(self.apparatus, tried, self.rng), MAX_GAINS_COMPUTED)
        if not looked:
            return None
        near = vary(looked[0].proposal, self.apparatus, varied, self.rng)
        looked = sorted([*looked, *self.first_order_gains(near, varied, above=looked[0].gain)], key=lambda t: -t.gain)
        judged = [found for trial in looked[:MAX_REFITTED] if (found := self.judge(trial)) is not None]
        return max(judged, key=lambda found: found.gain, default=None)

    def first_order_gains(self, proposals: Sequence[Proposal], most: int, *, above: float = -1.0) -> list[PredictedRun]:
        """Return runs with their gains at first order, the best first; those that cannot be best are left out."""
        self.tried += len(proposals)
        trials = [t for t in map(self.predict, proposals) if t is not None]
        by_kind: dict[str, list[PredictedRun]] = {}
        for trial in sorted(trials, key=lambda t: -t.bound):
            by_kind.setdefault(trial.proposal.kind, []).append(trial)
        found: list[PredictedRun] = []
        while any(by_kind.values()) and len(found) < most:
            for queue in by_kind.values():  # stick-slip has the largest differences, and absorbs most of them
                if queue and (trial := queue.pop(0)).bound > above and len(found) < most:
                    trial = replace(trial, gain=self.gain(trial))
                    above = max(above, trial.gain)
                    found.append(trial)
        return sorted(found, key=lambda t: -t.gain)

    def predict(self, proposal: Proposal) -> PredictedRun | None:
        """Return a run as all hypotheses predict it, None where it cannot begin or one cannot be followed."""
        begun = self.stably_started(proposal)
        if begun is None:
            return None
        proposal, run = begun
        y = {}
        for rival in self.rivals:
            found = rival.predicted(run)
            if found is None:
                return None
            y[rival.fitted.name] = found
        losses = self.losses(y, lambda wrong, shown: wrong.lack_of_fit(run, shown, slopes=False))
        if losses is None:
            return None
        return PredictedRun(proposal, run, y, min(0.5 * float(lost.w @ lost.w) for lost in losses.values()))

    def losses(
        self, y: Mapping[str, Array], lack: Callable[[RivalModel, Array], LackOfFit | None]
    ) -> dict[tuple[str, str], LackOfFit] | None:
        """Return what is lost by the names of a true and a wrong hypothesis; None where a wrong one cannot be followed.

        `lack` returns what a wrong one loses where the prediction (n,) of `y` by the true one is shown.
        """
        found = {}
        for true, wrong in self.pairs:
            lost = lack(wrong, y[true.fitted.name])
            if lost is None:
                return None
            found[true.fitted.name, wrong.fitted.name] = lost
        return found

    def stably_started(self, proposal: Proposal) -> tuple[Proposal, Run] | None:
        """Return a run that begins in stable sliding, whichever hypothesis is true: as it is, or led in."""
        for tried in (proposal, with_fast_start(proposal, self.apparatus)):
            if tried is not None:
                run = run_of(tried, self.experiment)
                if all(rival.steady(run) for rival in self.rivals):
                    return tried, run
        return None

    def gain(self, trial: PredictedRun) -> float:
        """Return the gain at first order: that of the pair least apart, the worse way round."""
        losses = self.losses(trial.y, lambda wrong, shown: wrong.lack_of_fit(trial.run, shown))
        return min(lost.gain() for lost in losses.values()) if losses else 0.0

    def judge(self, trial: PredictedRun) -> DiscriminatingRun | None:
        """Return what a run is worth, every wrong model refitted by the motion itself."""
        losses = self.losses(trial.y, lambda wrong, shown: self.refitted(trial.run, wrong, shown))
        if losses is None:
            return None
        worth = {pair: lost.gain() for pair, lost in losses.items()}
        true_name, wrong_name = min(worth, key=lambda pair: worth[pair])
        seconds, repeats = _sufficient_duration(list(losses.values()), trial)
        names, run = tuple(s.fitted.name for s in self.rivals), trial.run
        wrong = self.rivals[names.index(wrong_name)]
        noise = float(wrong.values()[wrong.fitted.fit.likelihood.gauges(run)[0]["gauge_white"]])
        first, second = sorted((true_name, wrong_name), key=names.index)
        difference = losses[true_name, wrong_name].difference * (1.0 if true_name == first else -1.0)
        at = int(np.argmax(np.abs(difference)))
        factor = float(per_elongation(run.observable, run.stiffness, run.load(run.t)[0][at]))
        return DiscriminatingRun(
            names, trial.proposal, run, worth[true_name, wrong_name],
            {a: min(g for (true, _), g in worth.items() if true == a) for a in names}, seconds, repeats, (first, second),
            float(run.t[at]), float(difference[at]), abs(float(difference[at])) / factor,
            shown_unit(OBSERVABLES[run.observable], stress=self.experiment.stress),
            noise, trial.y, self.tried, shown_unit("N", stress=self.experiment.stress),
        )  # fmt: skip

    def refitted(self, run: Run, wrong: RivalModel, y: Array) -> LackOfFit | None:
        """Return what a wrong model loses once it was fitted to what the true one shows, and to all that it is known from."""
        Q = wrong.precision
        z, damping = np.zeros(Q.shape[0]), 0.0
        lost = wrong.lack_of_fit(run, y, z)
        if lost is None:
            return None
        for _ in range(NEWTON_ROUNDS):
            A, b = lost.X.T @ lost.X + Q, lost.X.T @ lost.w - Q @ z
            A[np.diag_indices_from(A)] *= 1 + damping
            step = solve_scaled(A, b)
            if float(b @ step) < 0.02 * (1 + _cost(lost, z)) and not damping:
                break
            trial = wrong.lack_of_fit(run, y, z + step)
            if trial is not None and _cost(trial, z + step) < _cost(lost, z):
                lost, z = trial, z + step
                damping = 0.0 if damping < 1e-3 else damping / 10
            elif damping > 1e4:
                break
            else:
                damping = max(10 * damping, 1e-2)
        return replace(lost, w=lost.w + lost.X @ z)


def _cost(lost: LackOfFit, z: Array) -> float:
    return float(lost.w @ lost.w + z @ lost.Q @ z)


def _sufficient_duration(losses: Sequence[LackOfFit], trial: PredictedRun) -> tuple[float | None, int | None]:
    """Return how many seconds of a run gain enough, and how many repeats of it; None where none do."""
    n = trial.run.t.size
    for k in np.unique(np.linspace(0, n, DURATION_TRIALS + 1).astype(int)[1:]).tolist():
        if min(x.gain(samples=k) for x in losses) >= DISCRIMINATING_GAIN:
            return float(trial.run.t[k - 1] - trial.run.t[0]), 1
    several = range(2, MAX_REPEATS + 1)
    repeats = 2 + bisect_left(several, True, key=lambda n: min(x.gain(times=n) for x in losses) >= DISCRIMINATING_GAIN)
    return (repeats * trial.proposal.duration, repeats) if repeats in several else (None, None)


# Runs that an apparatus could still make: drives and loads drawn around those that it has shown.

EXTRAPOLATION_FACTOR = 2.0  # beyond what was shown
SAMPLES_PER_PERIOD = 8.0  # samples of a period: a load is not known from fewer
MIN_LOAD_STEP = 0.01  # of the load, from where on a run is one with load steps
MANY_VELOCITIES = 12  # velocities of a recorded drive that stand for all of them
MOST_EPS = 0.9
FAST_START_SHARE = 0.1  # of a run, in which it begins fast; the same of its way
UNKNOWN_LOAD = 1.0  # N: what stands for a load that no recording tells
RUN_NAME = "discriminating"
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

    def changes(self, unit: str = "N") -> list[tuple[float, str]]:
        """Return when (s) something is changed, and what, in order of time; loads have this unit."""
        found, t = [], 0.0
        for (d, V), (_, after) in zip(self.drive, self.drive[1:], strict=False):
            t += d
            verb = "the stage stops" if after == 0 else f"the drive changes from {V:g} to {after:g} um/s"
            found.append((t, verb if V else f"the stage moves again, at {after:g} um/s"))
        W = self.W0
        for at, jump in self.steps:
            found.append((at, f"the load changes from {W:.4g} to {W + jump:.4g} {unit}"))
            W += jump
        if self.eps:
            found.append((self.onset, "the modulation is switched on"))
        return sorted(found)

    def text(self, unit: str = "N") -> str:
        """Return what is to be done, in words: drive; load, in this unit."""
        drive = ", then ".join(f"{d:g} s at {V:g} um/s" if V else f"{d:g} s at rest" for d, V in self.drive)
        load = f"{self.W0:g} {unit}"
        for at, jump in self.steps:
            load += f", {'up' if jump > 0 else 'down'} by {abs(jump):g} {unit} at {at:g} s"
        if self.eps:
            load += f", from {self.onset:g} s on modulated by {100 * self.eps:g} % at {self.f:g} Hz"
        return f"{drive}; load {load}"


@dataclass(frozen=True)
class Capabilities:
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


def capabilities_of(experiment: Experiment) -> Capabilities:
    """Return what the runs of an experiment, held-out ones too, have shown."""
    waves = {r.name: effect_inputs(r) for r in experiment.runs}
    modulated = [r for r in experiment.runs if waves[r.name]["modulated"]]
    plain = [r for r in experiment.runs if not waves[r.name]["modulated"]]
    jumps, rises = [], []
    for run in plain:
        W, rate = run.load(run.t)
        if np.ptp(W) > MIN_LOAD_STEP * W.mean():
            jumps.append(float(np.ptp(W) / W[0]))
            rises.append(float(np.ptp(W) / (2 * max(np.abs(rate).max(), 1e-12))))
    shown = [waves[r.name] for r in modulated]
    begun = [(w["onset0"] - r.t[0]) / np.ptp(r.t) for w, r in zip(shown, modulated, strict=True)]
    late = [b for b in begun if 0 < b < 1]
    return Capabilities(
        _velocities(experiment.runs),
        tuple(r.first_load for r in experiment.runs),
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
        V = run.drive(run.t)
        V = V[V > 0]
        if V.size and (len(run.drive.velocities) > MANY_VELOCITIES or any(run.drive.accelerations)):
            V = np.quantile(V, np.linspace(0.05, 0.95, MANY_VELOCITIES))
        found |= {_digits(x) for x in V.tolist()}
    return tuple(sorted(found))


def _typical(runs: Sequence[Run]) -> Run:
    """Return the run of median length; a fitted one, whose noise is known, where there is one."""
    fitted = [r for r in runs if not r.holdout] or list(runs)
    return sorted(fitted, key=lambda r: float(np.ptp(r.t)))[len(fitted) // 2]


def draw(apparatus: Capabilities, number: int, rng: np.random.Generator) -> list[Proposal]:
    """Return so many runs, every kind in turn."""
    kinds = apparatus.kinds
    return [_drawn(apparatus, kinds[i % len(kinds)], rng) for i in range(number)]


def with_fast_start(proposal: Proposal, apparatus: Capabilities) -> Proposal | None:
    """Return the run with a fast beginning, as sliding that is not stable has to begin; None where there is no room for it."""
    (length, V), *rest = proposal.drive
    fastest = max(apparatus.V)
    lead = _digits(FAST_START_SHARE * min(proposal.duration, apparatus.travel / fastest))
    if fastest <= V or length <= 2 * lead:
        return None
    return replace(proposal, drive=((lead, fastest), (_digits(length - lead), V), *rest))


def vary(proposal: Proposal, apparatus: Capabilities, number: int, rng: np.random.Generator) -> list[Proposal]:
    """Return so many runs near another."""
    found = []
    for _ in range(number):
        like = apparatus.modulated if proposal.eps else apparatus.plain
        load = float(np.exp(0.3 * rng.standard_normal()))
        factors = {V: float(np.exp(0.3 * rng.standard_normal())) for _, V in proposal.drive}
        V = [_within(V * factors[V], apparatus.V) if V else 0.0 for _, V in proposal.drive]
        W0 = _within(proposal.W0 * load, apparatus.W0) if set(apparatus.W0) != {UNKNOWN_LOAD} else UNKNOWN_LOAD
        jump = float(np.exp(0.3 * rng.standard_normal())) * W0 / proposal.W0
        eps, f = proposal.eps, proposal.f
        if eps:
            eps = min(_within(eps * np.exp(0.3 * rng.standard_normal()), apparatus.eps), MOST_EPS)
            f = _frequency(f * np.exp(0.3 * rng.standard_normal()), apparatus, proposal.interval)
        shares = [d / proposal.duration for d, _ in proposal.drive]
        drive = _timed(V, shares, float(np.ptp(like.t)), apparatus.travel)
        length = sum(d for d, _ in drive) / proposal.duration
        steps = tuple((_digits(at * length), _digits(j * jump)) for at, j in proposal.steps)
        found.append(
            replace(proposal, drive=drive, W0=W0, steps=_allowed(W0, steps, apparatus), eps=eps, f=f,
                    onset=_digits(proposal.onset * length))
        )  # fmt: skip
    return found


def _drawn(apparatus: Capabilities, kind: str, rng: np.random.Generator) -> Proposal:
    def near(values: Sequence[float]) -> float:
        factor = float(np.exp(rng.uniform(-1, 1) * math.log(EXTRAPOLATION_FACTOR)))
        return _within(values[int(rng.integers(len(values)))] * factor, values)

    like = apparatus.modulated if kind == WAVE else apparatus.plain
    interval, span = _digits(float(np.median(np.diff(like.t))), 9), float(np.ptp(like.t))
    V, other, third = near(apparatus.V), near(apparatus.V), near(apparatus.V)
    W0 = near(apparatus.W0) if set(apparatus.W0) != {UNKNOWN_LOAD} else UNKNOWN_LOAD
    rise = apparatus.switch if kind == WAVE else apparatus.rise
    if kind == STEPS:
        velocities, shares = [V, other, V, third], [0.25] * 4
    elif kind == HOLD:
        velocities, shares = [V, 0.0, V], [0.2, rng.uniform(0.3, 0.6), 0.2]
    elif kind == LOAD or rng.uniform() >= 0.4:
        velocities, shares = [V], [1.0]
    else:
        velocities, shares = [V, other], [0.6, 0.4]
    made = Proposal(kind, _timed(velocities, shares, span, apparatus.travel), W0, like.name, interval, rise)
    if kind == LOAD:
        jump = _digits(near(apparatus.jumps) * W0 * (1 if rng.uniform() < 0.6 else -1))
        steps = ((_digits(0.3 * made.duration), jump), (_digits(0.65 * made.duration), -jump))
        return replace(made, steps=_allowed(W0, steps, apparatus))
    if kind == WAVE:
        onset, eps = _digits(min(apparatus.onset, 0.5) * made.duration), min(near(apparatus.eps), MOST_EPS)
        return replace(made, eps=eps, f=_frequency(near(apparatus.f), apparatus, interval), onset=onset)
    return made


def _timed(V: Sequence[float], shares: Sequence[float], span: float, travel: float) -> tuple[tuple[float, float], ...]:
    """Return (duration, velocity) of pieces that last `span` s together, less where the track would be too short."""
    total, travel = sum(shares), (1 - FAST_START_SHARE) * travel
    lengths = [span * s / total for s in shares]
    way = sum(d * v for d, v in zip(lengths, V, strict=True))
    if way > travel:  # the fast pieces are made shorter, each to its share of the way
        lengths = [min(d, travel * s / total / v) if v else d for d, s, v in zip(lengths, shares, V, strict=True)]
    return tuple((_digits(d), v) for d, v in zip(lengths, V, strict=True))


def _allowed(W0: float, steps: tuple[tuple[float, float], ...], apparatus: Capabilities) -> tuple[tuple[float, float], ...]:
    """Return steps that keep the load within what was shown, times two."""
    low, high = min(apparatus.W0) / EXTRAPOLATION_FACTOR, EXTRAPOLATION_FACTOR * max(apparatus.W0)
    size = max((abs(j) for _, j in steps), default=0.0)
    if not size:
        return steps
    room = high - W0 if steps[0][1] > 0 else W0 - low
    shrunk = min(1.0, max(room, 0.1 * W0) / size)
    return tuple((at, _digits(j * shrunk)) for at, j in steps)


def _frequency(value: float, apparatus: Capabilities, interval: float) -> float:
    return _digits(min(_within(value, apparatus.f), 1 / (SAMPLES_PER_PERIOD * interval)))


def _within(value: float, shown: Sequence[float]) -> float:
    """Return a value, with two digits, no further than a factor of two outside what was shown."""
    return _digits(float(np.clip(_digits(float(value), 2), min(shown) / EXTRAPOLATION_FACTOR, max(shown) * EXTRAPOLATION_FACTOR)))


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
        RUN_NAME, Path(f"{RUN_NAME}.csv"), True, like.start, "steady", t, np.zeros(t.size), like.observable,
        np.ones(t.size, dtype=bool), drive, load, like.stiffness, modulation, 0.0, (),
    )  # fmt: skip
    share = stiffness_share(experiment, run) / stiffness_share(experiment, like)
    return replace(run, stiffness=like.stiffness * share)


# What is told of the discriminating run: sentences, plain data, and an experiment for what each hypothesis predicts.

FOLDER = "discriminating"
RUNS_HEADING, COLUMNS_HEADING = "\n[[runs]]\n", "\n[columns]\n"


def sentences(found: DiscriminatingRun) -> list[str]:
    """Return what is to be done, what it is worth, and what to look for; or that nothing discriminates between them."""
    names, run = _listed([_name(n) for n in found.names]), found.proposal
    if not found.discriminates:
        return [
            f"Nothing within this apparatus' reach discriminates between {names}: of {found.tried} runs tried, the best "
            f"gains {found.gain:.2g} in log likelihood, and {DISCRIMINATING_GAIN:g} are wanted. "
            "For this apparatus they are one class."
        ]
    return [
        f"What would discriminate between {names} is {run.kind}: {run.text(found.load_unit)}; "
        f"sampled at {1 / run.interval:.4g} Hz.",
        f"Whichever of them is true, the others then lose at least {found.gain:.3g} in log likelihood, refitted to all runs. "
        + _duration_sentence(found),
        _largest_difference(found),
    ]


def _duration_sentence(found: DiscriminatingRun) -> str:
    if found.seconds is None or found.repeats is None:
        return (
            f"No number of repeats of this run gains {DISCRIMINATING_GAIN:g}: its parameters would have to be known better first."
        )
    if found.repeats > 1:
        return f"{DISCRIMINATING_GAIN:g} are gained in {found.repeats} such runs, {found.seconds:.3g} s in all."
    return f"{DISCRIMINATING_GAIN:g} are gained in the first {found.seconds:.3g} s of it."


def _largest_difference(found: DiscriminatingRun) -> str:
    """Return where to look, and for how much."""
    first, second = map(_name, found.pair)
    before = [(t, what) for t, what in found.proposal.changes(found.load_unit) if t <= found.at]
    since = f", {found.at - before[-1][0]:.2g} s after {before[-1][1]}" if before else ""
    size = f"{abs(found.peak):.2g}{'' if found.unit == '1' else f' {found.unit}'}"
    um = "" if found.unit == "um" else f" ({found.peak_um:.2g} um of the spring's elongation)"
    word = "above" if found.peak > 0 else "below"
    faint = ", less than the noise of one sample: a fit sees it" if abs(found.peak) < found.noise else ""
    return f"They differ most {found.at:.3g} s into it{since}: {first} is then {size}{um} {word} {second}{faint}."


def _name(name: str) -> str:
    return "the baseline" if name == "none" else name


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


def described(found: DiscriminatingRun, experiment: Experiment) -> dict[str, Any]:
    """Return the value of the answer's key `experiment`."""
    return {
        "hypotheses": list(found.names),
        "discriminates": found.discriminates,
        "sentences": sentences(found),
        "gain": found.gain,
        "gains": dict(found.gains),
        "seconds": found.seconds,
        "repeats": found.repeats,
        "duration": found.proposal.duration,
        "look": {"at": found.at, "difference": found.peak, "unit": found.unit, "um": found.peak_um, "of": list(found.pair)},
        "run": run_text(found, experiment),
        "tried": found.tried,
    }


def run_text(found: DiscriminatingRun, experiment: Experiment) -> str:
    """Return the run as experiment.toml describes one; its file has times and load, and what a hypothesis predicts."""
    run = replace(found.run, holdout=False)
    description = experiment_files(replace(experiment, runs=(run,)))[DESCRIPTION]
    load = found.proposal.text(found.load_unit).partition("; load ")[2]
    return f"[[runs]]\n# load {load}, as the file has it\n{description.rpartition(RUNS_HEADING)[2]}"


def discriminating_files(
    registry: Registry, diagnosis: Diagnosis, found: DiscriminatingRun, *, folder: Path, reader: str | None = None
) -> dict[str, str]:
    """Return, by place in `folder`, an experiment for each hypothesis whose one run is the proposed one as it predicts it."""
    files: dict[str, str] = {}
    run = replace(found.run, holdout=False)
    text = run_text(found, diagnosis.experiment)
    for fitted in diagnosis.close:
        place = f"{FOLDER}/{fitted.name}"
        if fitted.name not in found.predicted or f"{place}/{DESCRIPTION}" in files:
            continue
        made = augment(registry, diagnosis.experiment, fitted.hypothesis, fitted.fit, folder=folder / place, reader=reader)
        head = made.files[DESCRIPTION].partition(RUNS_HEADING)[0].partition(COLUMNS_HEADING)[0]
        files |= {f"{place}/{name}": content for name, content in made.files.items()}
        files[f"{place}/{DESCRIPTION}"] = f"{head.rstrip()}\n\n{text}"
        files[f"{place}/{run.file.name}"] = run_csv(replace(run, observed=found.predicted[fitted.name]))
    return files
