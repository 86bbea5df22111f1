"""The experiment that would part hypotheses which explain a recording equally well.

Of many runs that the apparatus can make, each fitted model says what it would see. What counts is the part of their difference
that no refit could absorb: with d the whitened difference, X the whitened derivatives by all that is free in the wrong model and
Q what the recordings so far say of that, the log likelihood that the wrong model loses is on average

    gain = min over z of (|d - X z|^2 + z' Q z) / 2 = d' (1 + X Q^-1 X')^-1 d / 2,

lambda (1 - rho^2) / 2 in the words of experimental design. It is taken for the worse of the two ways round, the best runs are
found by it, and theirs is found again with the motion itself in place of its derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations

import numpy as np
from scipy.linalg import block_diag

from srfcli.diagnosis.proposals import Proposal, Reach, draw, led_in, reach_of, run_of, vary
from srfcli.diagnosis.refits import Refit
from srfcli.diagnosis.verdict import Diagnosis
from srfcli.inference.latent import Latent, solve_scaled
from srfcli.inference.noise import Noise, stretches, whiten
from srfcli.inference.nuisance import basis
from srfcli.inference.prediction import run_parameters
from srfcli.inference.tracks import Tracks, tracks_for
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Experiment, Run
from srfcli.registry import Registry

ENOUGH = 12.0  # of log likelihood: hypotheses so far apart are told apart
LEAST = 3.0  # below which a run is not worth making
MOST = 3  # hypotheses that are to be parted
DRAWN, VARIED = 60, 16  # runs that are tried, and variations of the best of them
LOOKED, ROUGH_LOOKED = 36, 12  # of these, how many with derivatives, at most
CONFIRMED = 3  # of the best, how many with the motion itself
ROUNDS = 10  # of Gauss and Newton
GROWS = 0.1  # e-foldings in a run that leave sliding as steady as it was
REPEATS = 100  # of a run that nobody will go beyond
UNITS = {"elongation": "um", "force": "N", "friction": "1"}
PARTS = 60  # of a run, in which it is found how much of it suffices


@dataclass(frozen=True)
class Parting:
    """The run that parts hypotheses best: `proposal`, the same as a `run`, and the `gain` in log likelihood to be expected.

    `gains` has what the others lose by the name of the true one, the gain is the least of them. `seconds` of such a recording
    gain 12, in `repeats` of the run, or None where no number of them does. The two of `pair`, which are parted least, differ
    most at `at` s, the wrong one refitted: the first is `peak` above the second, in the observable's `unit`, `peak_um` of the
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
    tried: int = 0

    @property
    def parts(self) -> bool:
        """Return whether the run is worth making."""
        return self.gain >= LEAST


@dataclass(frozen=True)
class Side:
    """A fitted hypothesis that is to predict a run: with `prior` precision (k, k) over its scaled parameters.

    Where all runs slid on one track, the prior goes on with the track's numbers and `shared` holds; on a track of its own a run
    adds numbers that nothing is known of but their roughness.
    """

    refit: Refit
    latent: Latent
    prior: Array
    shared: bool

    @classmethod
    def of(cls, refit: Refit) -> Side:
        """Return the side of a hypothesis."""
        problem, point = refit.fit.problem, refit.fit.point
        latent, n = Latent(problem), point.theta.size
        rough = bool(point.tracks.splines) and point.roughness.amplitude > 0
        if not rough:
            return cls(refit, latent, point.N[:n, :n], False)
        inverse = np.linalg.inv(point.tracks.root(point.roughness))
        whole = point.N.copy()
        whole[n:, n:] += inverse.T @ inverse
        if point.tracks.shared:
            return cls(refit, latent, whole, True)
        own = whole[:n, :n] - whole[:n, n:] @ np.linalg.solve(whole[n:, n:], whole[n:, :n])
        return cls(refit, latent, own, False)

    @property
    def name(self) -> str:
        """Return the hypothesis' name."""
        return self.refit.name

    @property
    def rough(self) -> bool:
        """Return whether a track's numbers are estimated with the parameters."""
        return self.refit.fit.point.roughness.amplitude > 0 and bool(self.refit.fit.point.tracks.splines)

    def track(self, run: Run) -> Tracks:
        """Return the track on which a run would slide: the known one, a new one, or none."""
        if not self.rough:
            return Tracks((), {})
        if self.shared:
            return replace(self.refit.fit.point.tracks, of={run.name: 0})
        return tracks_for([run], shared=False)

    def precision(self, run: Run) -> Array:
        """Return what is known beforehand of all that is free in a run (k, k): parameters, track, trend."""
        Q = self.prior
        if self.rough and not self.shared:
            inverse = np.linalg.inv(self.track(run).root(self.refit.fit.point.roughness))
            Q = block_diag(Q, inverse.T @ inverse)
        return block_diag(Q, [[0.0]]) if self.latent.problem.trend else Q

    def steady(self, run: Run) -> bool:
        """Return whether the sliding with which a run begins is stable: no apparatus begins with any other."""
        problem = self.latent.problem
        p = run_parameters(problem.model, problem.experiment, run, self.refit.fit.values)
        V, W = float(run.drive(run.t[:1])[0]), run.load.rest(float(run.t[0]))
        J = np.asarray(problem.model.rates_jacobian(np.asarray(problem.model.steady(p)), V, W, 0.0, p), dtype=float)
        return bool(np.linalg.eigvals(J).real.max() * float(np.ptp(run.t)) < GROWS)

    def predicted(self, run: Run, z: Array | None = None, *, slopes: bool = False) -> tuple[Array, Array] | None:
        """Return what the hypothesis foretells, (n,) and its derivatives (n, k) by `z`, steps from the fit; None if it fails."""
        problem, theta = self.latent.problem, self.refit.fit.point.theta
        tracks, trend, n = self.track(run), problem.trend, theta.size
        if z is not None:
            theta = np.clip(theta + z[:n] * self.latent.scale, problem.lower, problem.upper)
            if tracks.splines:
                tracks = tracks.with_numbers(tracks.numbers + z[n : n + tracks.numbers.size])
        found = self.latent.predicted(run, theta, tracks, slopes=slopes)
        y, J = found.y, found.J.copy()
        if not (found.status.ok and np.isfinite(y).all() and np.isfinite(J).all()):
            return None
        if slopes:
            J[:, :n] *= self.latent.scale
        if trend:
            line = basis(run, trend)
            y = y + (line * z[-1] if z is not None else 0.0)
            J = np.column_stack([J, line]) if slopes else J
        return y, J


@dataclass(frozen=True)
class Loss:
    """What a wrong model loses: `w` (n,) and `X` (n, k) whitened, `Q`; `left` (n,) what is left of the difference, unwhitened."""

    w: Array
    X: Array
    Q: Array
    left: Array

    def gain(self, *, samples: int | None = None, times: float = 1.0) -> float:
        """Return the log likelihood lost in the first `samples`, in a run made `times` times."""
        w, X = self.w[:samples], self.X[:samples]
        b = times * (X.T @ w)
        return 0.5 * max(times * float(w @ w) - float(b @ solve_scaled(times * (X.T @ X) + self.Q, b)), 0.0)


@dataclass(frozen=True)
class Trial:
    """A run as the hypotheses foretell it: `y` (n,) by name; `bound` no gain exceeds, `gain` at first order where known."""

    proposal: Proposal
    run: Run
    y: dict[str, Array]
    bound: float
    gain: float = 0.0


def parting_experiment(registry: Registry, diagnosis: Diagnosis, *, seed: int = 0) -> Parting | None:
    """Return the run that would part what a diagnosis found equally good; None where there is nothing to part.

    Looked for are runs with the apparatus' own velocities, loads and modulations, and up to twice beyond them.
    """
    sides = foremost(diagnosis)
    if diagnosis.verdict != "ambiguous" or len(sides) < 2:
        return None
    return Design(diagnosis.experiment, diagnosis.noise, sides, seed).best()


def foremost(diagnosis: Diagnosis) -> tuple[Side, ...]:
    """Return the hypotheses that are to be parted: the best of each name, three at most."""
    best: dict[frozenset[str], Refit] = {}
    for refit in diagnosis.close:
        best.setdefault(frozenset(refit.hypothesis.reported), refit)
    return tuple(Side.of(r) for r in list(best.values())[:MOST])


class Design:
    """The search for a run among those that an apparatus can make."""

    def __init__(self, experiment: Experiment, noise: Mapping[str, Noise], sides: Sequence[Side], seed: int) -> None:
        self.experiment, self.noise, self.sides = experiment, noise, tuple(sides)
        self.reach: Reach = reach_of(experiment)
        self.rng = np.random.default_rng(seed)
        self.tried = 0

    def best(self) -> Parting | None:
        """Return the best run, None where no model can be followed through any."""
        looked = self.look(draw(self.reach, DRAWN, self.rng), LOOKED)
        if not looked:
            return None
        near = vary(looked[0].proposal, self.reach, VARIED, self.rng)
        looked = sorted([*looked, *self.look(near, VARIED, above=looked[0].gain)], key=lambda t: -t.gain)
        best: Parting | None = None
        for trial in looked[:CONFIRMED]:
            found = self.judge(trial)
            if found is not None and (best is None or found.gain > best.gain):
                best = found
        return best and replace(best, tried=self.tried)

    def look(self, proposals: Sequence[Proposal], most: int, *, above: float = -1.0) -> list[Trial]:
        """Return runs with their gains at first order, the best first; those that cannot be best are left out."""
        self.tried += len(proposals)
        trials = [t for t in map(self.foretell, proposals) if t is not None]
        by_kind: dict[str, list[Trial]] = {}
        for trial in sorted(trials, key=lambda t: -t.bound):
            by_kind.setdefault(trial.proposal.kind, []).append(trial)
        if any(s.rough for s in self.sides):
            most = min(most, ROUGH_LOOKED)
        found: list[Trial] = []
        while any(by_kind.values()) and len(found) < most:
            for queue in by_kind.values():  # stick-slip has the largest differences, and absorbs most of them
                if queue and (trial := queue.pop(0)).bound > above and len(found) < most:
                    trial = replace(trial, gain=self.gain(trial))
                    above = max(above, trial.gain)
                    found.append(trial)
        return sorted(found, key=lambda t: -t.gain)

    def foretell(self, proposal: Proposal) -> Trial | None:
        """Return a run as all hypotheses foretell it, None where it cannot begin or one cannot be followed."""
        begun = self.begun(proposal)
        if begun is None:
            return None
        proposal, run = begun
        y = {}
        for side in self.sides:
            found = side.predicted(run)
            if found is None:
                return None
            y[side.name] = found[0]
        parted = [0.5 * float(np.sum(self.whitened(run, y[a.name] - y[b.name]) ** 2)) for a, b in self.pairs()]
        return Trial(proposal, run, y, min(parted))

    def begun(self, proposal: Proposal) -> tuple[Proposal, Run] | None:
        """Return a run that begins in stable sliding, whichever hypothesis is true: as it is, or led in."""
        for tried in (proposal, led_in(proposal, self.reach)):
            if tried is not None:
                run = run_of(tried, self.experiment)
                if all(side.steady(run) for side in self.sides):
                    return tried, run
        return None

    def pairs(self) -> list[tuple[Side, Side]]:
        """Return every pair of a true and a wrong hypothesis."""
        return list(permutations(self.sides, 2))

    def whitened(self, run: Run, columns: Array) -> Array:
        """Return columns over a run's samples (n,) or (n, k) as its gauge's noise weighs them."""
        return whiten(self.noise[self.like(run)], columns, stretches(run.t, run.used))

    def like(self, run: Run) -> str:
        """Return the name of the recorded run that has a run's gauge and sampling; of any, if its own was not fitted."""
        name = (self.reach.modulated if run.modulation else self.reach.plain).name
        return name if name in self.noise else next(iter(self.noise))

    def gain(self, trial: Trial) -> float:
        """Return the gain at first order: that of the least parted pair, the worse way round."""
        slopes = {}
        for side in self.sides:
            found = side.predicted(trial.run, slopes=True)
            if found is None:
                return 0.0
            slopes[side.name] = (self.whitened(trial.run, found[1]), side.precision(trial.run))
        least = np.inf
        for true, wrong in self.pairs():
            difference = trial.y[true.name] - trial.y[wrong.name]
            w = self.whitened(trial.run, difference)
            least = min(least, Loss(w, *slopes[wrong.name], difference).gain())
        return least

    def judge(self, trial: Trial) -> Parting | None:
        """Return what a run is worth, every wrong model refitted by the motion itself."""
        losses: dict[tuple[str, str], Loss] = {}
        for true, wrong in self.pairs():
            lost = self.refitted(trial.run, wrong, trial.y[true.name])
            if lost is None:
                return None
            losses[true.name, wrong.name] = lost
        worth = {pair: lost.gain() for pair, lost in losses.items()}
        true_name, wrong_name = min(worth, key=lambda pair: worth[pair])
        seconds, repeats = _enough(list(losses.values()), trial)
        names, run = tuple(s.name for s in self.sides), trial.run
        first, second = sorted((true_name, wrong_name), key=names.index)
        left = losses[true_name, wrong_name].left * (1.0 if true_name == first else -1.0)
        at = int(np.argmax(np.abs(left)))
        scale = {"elongation": 1.0, "force": 1 / run.stiffness, "friction": run.load(run.t)[0][at] / run.stiffness}
        return Parting(
            names, trial.proposal, run, worth[true_name, wrong_name],
            {a: min(g for (true, _), g in worth.items() if true == a) for a in names}, seconds, repeats, (first, second),
            float(run.t[at]), float(left[at]), abs(float(left[at] * scale[run.observable])), UNITS[run.observable],
            self.noise[self.like(run)].level, trial.y,
        )  # fmt: skip

    def refitted(self, run: Run, wrong: Side, y: Array) -> Loss | None:
        """Return what a wrong model loses once it was fitted to what the true one shows, and to all that it is known from."""
        Q = wrong.precision(run)
        z, damping = np.zeros(Q.shape[0]), 0.0
        current = self.at(run, wrong, y, z)
        if current is None:
            return None
        r, X = current
        for _ in range(ROUNDS):
            A, b = X.T @ X + Q, X.T @ r[0] - Q @ z
            A[np.diag_indices_from(A)] *= 1 + damping
            step = solve_scaled(A, b)
            if float(b @ step) < 0.02 * (1 + float(r[0] @ r[0] + z @ Q @ z)) and not damping:
                break
            trial = self.at(run, wrong, y, z + step)
            if trial is not None and _cost(trial[0][0], z + step, Q) < _cost(r[0], z, Q):
                (r, X), z = trial, z + step
                damping = 0.0 if damping < 1e-3 else damping / 10
            elif damping > 1e4:
                break
            else:
                damping = max(10 * damping, 1e-2)
        return Loss(r[0] + X @ z, X, Q, r[1])

    def at(self, run: Run, wrong: Side, y: Array, z: Array) -> tuple[tuple[Array, Array], Array] | None:
        """Return the difference left at `z`, whitened and not (n,), and the whitened derivatives there (n, k)."""
        found = wrong.predicted(run, z, slopes=True)
        if found is None:
            return None
        return (self.whitened(run, y - found[0]), y - found[0]), self.whitened(run, found[1])


def _cost(r: Array, z: Array, Q: Array) -> float:
    return float(r @ r + z @ Q @ z)


def _enough(losses: Sequence[Loss], trial: Trial) -> tuple[float | None, int | None]:
    """Return how many seconds of a run gain enough, and how many repeats of it; None where none do."""
    n = trial.run.t.size
    if min(x.gain() for x in losses) >= ENOUGH:
        for k in np.unique(np.linspace(0, n, PARTS + 1).astype(int)[1:]).tolist():
            if min(x.gain(samples=k) for x in losses) >= ENOUGH:
                return float(trial.run.t[k - 1] - trial.run.t[0]), 1
    low, high = 1, REPEATS
    if min(x.gain(times=high) for x in losses) < ENOUGH:
        return None, None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if min(x.gain(times=middle) for x in losses) >= ENOUGH else (middle, high)
    return high * trial.proposal.duration, high
