"""The friction that is missing, as a function of time in each run: estimated along the recordings, of no assumed form.

A cubic spline over each run's own clock is added to mu. Its numbers have the prior of a rough track (see `latent`), in seconds;
amplitude and correlation time are those of the largest marginal likelihood, and the model's own parameters are estimated again
with it: what they can absorb is not missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from scipy.stats import rankdata

from srfcli.diagnosis.refits import NEAR, Refit
from srfcli.diagnosis.search import Search
from srfcli.inference.fit import Problem
from srfcli.inference.latent import LatentFit, fit_latent
from srfcli.inference.prediction import Hold
from srfcli.inference.tracks import Tracks
from srfcli.model import open_model
from srfcli.numerics.collocation import Array
from srfcli.recording.values import Run
from srfcli.splines import Spline

TABLE = ("mu", "time")
KNOTS, FINEST = 90, 0.01  # intervals of a run's spline, and how short the shortest may be (s)
AMPLITUDES = np.array([0.0, *np.geomspace(5e-5, 5e-2, 13)])  # of mu
TIMES = np.geomspace(0.02, 4.0, 9)  # s, correlation times that are tried
ROUNDS, STEPS = 4, 12
NORMAL = 1.959963984540054  # standard deviations of a 95 % band
BINS = 12  # in which the force is averaged along a quantity of state
COORDINATES = ("v", "phi", "W", "dlnWdt", "slip", "t")


@dataclass(frozen=True)
class RunForce:
    """The missing friction coefficient `force` (n,) along one run at its samples `t` (s), its 95 % band `low`, `high`.

    Beside it what the model passes through: v (um/s), phi (s), W (N), dlnWdt (1/s), slip (um, from the run's start).
    """

    t: Array
    force: Array
    low: Array
    high: Array
    v: Array = field(repr=False)
    phi: Array = field(repr=False)
    W: Array = field(repr=False)
    dlnWdt: Array = field(repr=False)
    slip: Array = field(repr=False)

    def described(self) -> dict[str, Array]:
        """Return all arrays by name; the band also as `band` (2, n)."""
        found = {k: getattr(self, k) for k in self.__dataclass_fields__}
        return found | {"band": np.vstack([self.low, self.high])}


@dataclass(frozen=True)
class Force:
    """The missing friction of all runs: standard deviation `amplitude`, correlation time `time` (s).

    `share` is the part of the samples that were looked at, `gain` the log likelihood over the same model on a smooth track
    without a force,
    `coordinates` the share of the force's square that is a function of one quantity of state, the same in all runs.
    """

    runs: Mapping[str, RunForce]
    amplitude: float
    time: float
    share: float
    gain: float
    rms_over_noise: float
    coordinates: Mapping[str, float]
    fit: LatentFit = field(repr=False)

    def described(self) -> dict[str, Any]:
        """Return the arrays of each run by its name, as figures take them."""
        return {name: run.described() for name, run in self.runs.items()}


def tracks_over_time(runs: Sequence[Run], *, knots: int = KNOTS) -> Tracks:
    """Return functions of each run's own clock that vanish, with `knots` intervals each."""
    spans = [(float(r.t[0]), float(r.t[-1])) for r in runs]
    splines = tuple(Spline.over(a, b, max((b - a) / knots, FINEST)) for a, b in spans)
    return Tracks(splines, {r.name: i for i, r in enumerate(runs)})


def missing_force(search: Search, refit: Refit, *, knots: int = KNOTS) -> Force:
    """Return the friction that a fitted hypothesis lacks, along the runs that it was fitted to.

    Where the hypothesis is far off, the force is found while the slider is held to the recording first, then without.
    """
    near = refit.adequacy.rms_over_noise < NEAR
    around = refit.fit if near else search.loosely(refit)
    tracks, roughness = tracks_over_time(around.problem.runs, knots=knots), None
    search.progress(f"{refit.name}: the force that is missing")
    for hold in [None] if near else [around.problem.hold, None]:
        problem = _problem(search, refit, around, hold)
        fitted = fit_latent(
            problem, problem.start, search.noise, tracks=tracks, roughness=roughness, known_noise=True, rounds=ROUNDS,
            steps=STEPS, grid=(TIMES, AMPLITUDES),
        )  # fmt: skip
        tracks, roughness, around = fitted.point.tracks, fitted.point.roughness, fitted
        search.evaluations += fitted.evaluations
    smooth = search.tried.get((refit.name, False))
    return _force(refit, smooth.fit if smooth is not None else refit.fit, fitted)


def _problem(search: Search, refit: Refit, around: LatentFit, hold: Hold | None) -> Problem:
    """Return the problem of a refit, from where `around` stands, whose model has the force instead of a track."""
    choice = search.experiment.choice.plus(e.name for e in refit.hypothesis.effects)
    model = open_model(search.registry, **asdict(choice), tables=(TABLE, hold.table) if hold else (TABLE,))
    problem = around.problem
    return replace(problem, model=model, start=np.clip(around.point.theta, problem.lower, problem.upper), hold=hold)


def _force(refit: Refit, bare: LatentFit, fitted: LatentFit) -> Force:
    """Return force, bands and states from the fit that has the force."""
    tracks, roughness = fitted.point.tracks, fitted.point.roughness
    covariance = _covariance(fitted)
    found, squares, count = {}, 0.0, 0
    for run in fitted.problem.runs:
        design = tracks.spline(run).design(run.t)
        own = list(tracks.columns(run))
        spread = NORMAL * np.sqrt(
            np.maximum(np.einsum("ij,jk,ik->i", design, covariance[np.ix_(own, own)], design), 0.0)
        )
        values = design @ tracks.spline(run).numbers
        found[run.name] = RunForce(run.t, values, values - spread, values + spread, **_states(fitted, run))
        r = (run.observed - fitted.point.predictions[run.name].y)[run.used] / fitted.noise[run.name].level
        squares, count = squares + float(r @ r), count + r.size
    whole = sum(r.t.size for r in refit.fit.problem.runs)
    share = sum(r.t.size for r in fitted.problem.runs) / whole
    return Force(
        found, roughness.amplitude, roughness.length, share, float(fitted.log_likelihood - bare.log_likelihood),
        float(np.sqrt(squares / count)), _coordinates(found), fitted,
    )  # fmt: skip


def _covariance(fitted: LatentFit) -> Array:
    """Return the covariance of the force's numbers, that of the parameters included."""
    point, n = fitted.point, fitted.point.theta.size
    if not point.roughness.amplitude:
        return np.zeros((point.tracks.numbers.size,) * 2)
    L = point.tracks.root(point.roughness)
    G, cross, own = point.N[n:, n:], point.N[:n, n:], point.N[:n, :n]
    d = np.sqrt(np.maximum(np.diag(own), 1e-300))
    kept = np.linalg.pinv(own / np.outer(d, d), rcond=1e-12, hermitian=True) / np.outer(d, d) if n else own
    core = L.T @ (G - cross.T @ kept @ cross) @ L + np.eye(L.shape[1])
    return np.asarray(L @ np.linalg.solve(core, L.T))


def _states(fitted: LatentFit, run: Run) -> dict[str, Array]:
    """Return what the model passes through along a run."""
    x, states = fitted.point.predictions[run.name].x, fitted.problem.model.states
    v = np.exp(x[:, states.index("ln_v")])
    age = next(i for i, s in enumerate(states) if s.startswith("ln_") and s != "ln_v")
    W, W_dot = run.load(run.t)
    slip = run.start + np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(run.t))])
    return {"v": v, "phi": np.exp(x[:, age]), "W": W, "dlnWdt": W_dot / W, "slip": slip}


def _coordinates(runs: Mapping[str, RunForce]) -> dict[str, float]:
    """Return the share of the force's variance within runs that averages over bins of each quantity of state account for."""
    values = np.concatenate([r.force - r.force.mean() for r in runs.values()])
    weights = np.concatenate([1 / np.maximum((r.high - r.low) ** 2, 1e-18) for r in runs.values()])
    if not np.any(values):
        return {}
    whole, found = float(weights @ values**2), {}
    for name in COORDINATES:
        x = np.concatenate([getattr(r, name) for r in runs.values()])
        if np.ptp(x) <= 1e-9 * max(float(np.abs(x).max()), 1e-300):
            continue
        bins = np.minimum((rankdata(x, method="average") - 1) * BINS // x.size, BINS - 1).astype(int)
        mass = np.bincount(bins, weights, BINS)
        means = np.bincount(bins, weights * values, BINS) / np.maximum(mass, 1e-300)
        found[name] = float(np.clip(mass @ means**2 / whole, 0.0, 1.0))
    return dict(sorted(found.items(), key=lambda kv: -kv[1]))
