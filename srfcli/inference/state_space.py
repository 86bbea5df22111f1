"""Maximum likelihood for recordings under a model with a random friction field along slip and coloured gauge noise.

Friction is m(s) more than the laws say: a stationary Gaussian process along slip s, Matern 3/2, of amplitude a and correlation
length l. A Kalman filter follows slider and field together, so that the likelihood of all readings is the product of what each is
expected to be given those before it. With a = 0 that is the likelihood of the free-running model.

The field's amplitude is a homotopy: with a wide field the filter stays with the recording whatever the parameters are, and the
likelihood has one maximum where that of the free-running model, whose cycles fall out of step, has many. So the fit begins with
a wide field, and then estimates it with everything else, by Fisher scoring on exact derivatives.
Kristensen, Madsen and Jorgensen, Automatica 40 (2004); Hartikainen and Sarkka 2010; Durbin and Koopman 2012. Log marginal
likelihoods are by Laplace's method: Kass and Raftery, JASA 90 (1995); Cauchy priors: Jeffreys, Theory of Probability, 1961, 5.2.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import product
from typing import Any, TypeAlias, TypeVar

import numpy as np
from scipy.special import erfcx

from srfcli.codegen.c_source import GAUGE_PROCESSES
from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import Status
from srfcli.data.gauge import CORRELATION_TIMES, FASTEST_OSCILLATION, PROCESSES, QUALITIES, QUALITY, SAME_RATE
from srfcli.data.noise import calm_level, carried
from srfcli.data.values import CriticalLoads, Experiment, Run, Signal
from srfcli.inference.critical_loads import Matched, TableLikelihood, apparatus, joined_slopes
from srfcli.inference.fit import Fit, Problem, RunFit, inverse
from srfcli.inference.kalman import GAUGE, SPRING, Dual, Innovations, Readings, Smoothed, SmootherInput, kalman_filter, smooth
from srfcli.inference.noise import Noise, difference_level, stretches
from srfcli.inference.prediction import (
    basis,
    derivative,
    first_elongation,
    run_parameters,
    run_specific_names,
    run_specific_start,
    start_state,
    stiffness_share,
)

T = TypeVar("T")
Kind: TypeAlias = tuple[str, float, str]  # of gauge noise: an observable, the spacing of its samples, a group of runs or ""
FILTER_RTOL = 1e-4  # each reading puts right what the integration got wrong before it: the log likelihood is 1e-3 off
FREE_RUNNING_RTOL_FACTOR = 3e-3  # times that tolerance without a field: there errors add up over a run
FIELD = ("field_amplitude", "field_length")
# Fields under which a fit begins: amplitude over friction, length over the longest slip / LENGTHS_IN_SLIP. One after the other,
# while none leads near a maximum under a faint field
WIDE_FIELDS = ((0.01, 3.0), (0.01, 10.0), (0.003, 1.0), (0.3, 1.0))
FAST_FIELDS = ((0.03, 0.3), (0.1, 3.0), (0.1, 0.3), (0.1, 0.1), (0.3, 1.0))  # before, where the first does not follow
FOLLOWED = 4.0  # rms of innovations over their standard deviations, from which on a field does not follow the recordings
FAINT_FIELD_LENGTHS = (1.0, 0.25, 0.06)  # lengths of faint fields that are tried, over the same
NOT_CONVERGED = 3.0  # standard errors from its maximum at which a fit is none
SOBOL_STARTS = 16  # starts that are tried where the file's own cannot be followed; a power of two, as Sobol's points are
LEAST_FIELD = 1e-6  # the least amplitude of a field, over the friction of the recordings
FAINT_FIELD = 1e-3  # amplitude over friction below which a fit without a field is tried: to vanish takes many steps
FAINT_FIELDS = (0.03, 0.1, 0.3, 1.0)  # amplitudes over FAINT_FIELD, that are tried beside a fit without a field
FIELD_STEPS = 6  # of the trial of a small field beside a fit without one: parameters that are off may hide it
TRIAL_STEPS = 12  # of scoring from another start, to see whether it leads to a likelier maximum
FIELD_SHRINKS = 1.0  # in ln of the amplitude, over three steps, by which a field shrinks that may vanish
# gain in log likelihood that keeps a field, or one that all runs share, and from which a maximum is another one
SIGNIFICANT_GAIN = 2.0
EARLY_STOP_DEFICIT = 50.0  # in log likelihood, by which a fit that was broken off early may be behind and still be finished
PRUNING_DEFICIT = 1000.0  # in log likelihood below what it is to replace or to extend, from where a model is not worth a fit
LENGTHS_IN_SLIP = 20.0  # correlation lengths in the longest slip, at first; 1/100 to 10 times as many at most
SCORING_STEPS = 40  # of Fisher scoring
MANY_READINGS = 20_000  # of all runs, beyond which a fit begins with a part of them: it finds the field and the first digits
MAX_WORK_RATIO = 5  # times the steps of integration of the point before, after which a trial is given up
WIDTHS = (0.1, 0.03, 0.01)  # of each parameter, within which a reading's derivatives are to hold, one after the other
WIDEST_ERRORS = 1000.0  # times that width, in standard errors: what readings tell sharply together may still be uncertain
WEIGHT_ROUNDS = 12  # of weights and standard errors, each from the other
FAR_PROBE = 50.0  # standard errors of a parameter at which innovations move by less than derivatives want, if it oscillates
PEAK = 12.0  # in log likelihood: the height of a narrow maximum from which it is looked for; of hundreds, chance makes one of 6
SCANNED = 1000  # points of such a scan, at most: what is narrower is of one reading, and chance makes as high a peak of more
SCAN_REACH = 0.36  # of a parameter, in its logarithm, to either side: start values are 30 % off
PEAKS, PEAK_STEPS = 3, 3  # of a scan that are looked at closer, and the steps of scoring that the other parameters then have
PROBE = 10.0  # standard errors along a ridge, at which the likelihood is asked for
LOST_CURVATURE = 0.5  # share of what derivatives want at a probe, below which there are other maxima
RIDGE_STRIDE, RIDGE_REACH = 0.05, 0.5  # of a parameter, where maxima beside one are looked for, and how far a probe may go
# in log likelihood, by how much less likely than without a field a faint one may be and be averaged over
FAINT_FIELD_DEFICIT = 10.0
NEIGHBOUR_STEPS = (16, 64)  # of two standard errors to either side, least and most, in which other maxima are looked for
# from one maximum to a likelier one beside it, at most: from start values 30 % off eight strides, each a hop or two
MAX_RIDGE_MOVES = 16
MIN_EIGENVALUE = 1e-8  # of the scaled information: a direction that is flatter has a score of rounding alone
MIN_SENSITIVITY = 1e-6  # twice the log likelihood that a parameter changes between its bounds, below which its score is rounding
MAX_LOG_STEP = 1.5  # in the logarithm of a parameter: derivatives say nothing of what lies beyond
# of a step: where its bend is taken; bends that are none; the largest that is followed
ACCELERATION_STEP, MIN_ACCELERATION, MAX_ACCELERATION = 0.1, 0.1, 0.75
STALLED_GAIN_SHARE = 0.1  # share of the gain expected by the score below which readings are weighted otherwise
CONVERGED = 0.1  # standard errors: how far the maximum may still be, by the gradient
# standard errors from the maximum to which a fit is moved for a run that it did not know: 2 in log likelihood
PREDICTION_TOLERANCE = 2.0
INTERVAL_TOLERANCE = 0.1 * CONVERGED  # standard errors from the maximum where an interval's end is to be told
# standard deviations of the portmanteau statistic of a stretch of innovations below which they are noise there
PORTMANTEAU_LIMIT = 2.5
LAGS = 5  # of that statistic
MAX_DEVIATION = 4.5  # standard deviations at which a test of what a fit leaves fails: a dozen tests, five runs
COLOUR_SHARES = (0.5, 0.97)  # of the noise's variance, where colour begins
PERIODOGRAM_SAMPLES = 128  # samples of a stretch whose spectrum is taken, to see where an oscillation may be
MAX_SURVEYS = 3  # of all lines of the tables of critical loads at a maximum, and fits from where that finds nearer crossings
START_DIFFERENCE = 1e-5  # relative step of the central differences by which the start's covariance is differentiated


@dataclass(frozen=True)
class Filtered:
    """One run filtered: what the innovations say of the parameters `names`.

    `every` are those of all readings, signal by signal at each sample. Where a row is a reading that is used, those of the first
    signal come first, then those of the second, and so on.
    """

    run: Run
    names: tuple[str, ...]
    every: Innovations = field(repr=False)

    def of(self, signal: int) -> Innovations:
        """Return innovations (n,), variances and derivatives of one signal, and what was kept where its readings are."""
        f, k, c = self.every, len(self.run.signals), slice(signal, None, len(self.run.signals))
        kept = f.kept and SmootherInput(*(x[c] for x in vars(f.kept).values()))
        return Innovations(f.nu[c], f.S[c], f.nu_d[c], f.S_d[c], (f.reached + k - 1 - signal) // k, f.steps, kept)

    @cached_property
    def found(self) -> Innovations:
        """Return those of the run's observable."""
        return self.of(0)

    @cached_property
    def used(self) -> Array:
        """Return the places of the readings used (m,) among all, those of the first signal first."""
        k = len(self.run.signals)
        return np.concatenate([np.nonzero(s.used)[0] * k + i for i, s in enumerate(self.run.signals)])

    @property
    def whole(self) -> bool:
        """Return whether the motion was followed to the last sample, and every variance is one."""
        f = self.every
        return f.reached == f.nu.size and bool(np.isfinite(f.nu).all() and (f.S > 0).all())

    @property
    def white(self) -> Array:
        """Return the innovations over their standard deviations (m,): white noise of variance 1 under the right model."""
        return np.asarray(self.every.nu[self.used] / np.sqrt(self.every.S[self.used]))

    @property
    def parts(self) -> list[Array]:
        """Return the same for each signal."""
        return np.split(self.white, np.cumsum([int(s.used.sum()) for s in self.run.signals])[:-1])

    @property
    def log_likelihood(self) -> float:
        """Return the log likelihood of the readings used; minus infinity where the motion could not be followed."""
        return float(np.sum(self.log_density)) if self.whole else -np.inf

    @property
    def log_density(self) -> Array:
        """Return the log density (m,) of each reading given those before it."""
        return np.asarray(-0.5 * (self.white**2 + np.log(2 * np.pi * self.every.S[self.used])))

    @property
    def slopes(self) -> tuple[Array, Array]:
        """Return the derivatives (m, k) of innovations over their standard deviations, and of the variances' logarithms.

        Not finite where the motion could not be followed.
        """
        used, f = self.used, self.every
        S = f.S[used][:, None]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return f.nu_d[used] / np.sqrt(S), f.S_d[used] / S

    @property
    def score(self) -> Array:
        """Return the gradient of the log likelihood (k,), exact."""
        a, b = self.slopes
        return np.asarray(-self.white @ a + 0.5 * (self.white**2 - 1) @ b)

    @property
    def information(self) -> Array:
        """Return Fisher's information (k, k); infinite where it overflows."""
        a, b = self.slopes
        with np.errstate(over="ignore"):
            return np.asarray(a.T @ a + 0.5 * b.T @ b)

    def smoothed(self) -> Smoothed:
        """Return states and field (n, ...) given all readings of the run; it was filtered with `keep`."""
        k, taken = len(self.run.signals), np.stack([s.used for s in self.run.signals], axis=1).ravel()
        found = smooth(self.every, taken)
        return Smoothed(found.mean[::k], found.covariance[::k])


def _readings(
    model: GeneratedModel, run: Run, K: Dual, white: Dual, values: Mapping[str, float], by: Sequence[str], trend: str | None
) -> Readings:
    """Return all readings of a run; `white` (signals * rates,) are the standard deviations of the white noise."""
    n, k, c = run.t.size, len(by), len(run.signals)
    W = run.load(run.t)[0]
    factors, offsets, shows, weighs = [], [], [], []

    def own(name: str) -> Dual:
        return Dual(np.array(values[f"{run.name}.{name}"]), np.array([float(b == f"{run.name}.{name}") for b in by]))

    for number, signal in enumerate(run.signals):
        what = signal.observable
        factor, offset = Dual.plain(np.ones(n), k), Dual.plain(np.zeros(n), k)
        if what in ("force", "friction"):
            over = np.ones(n) if what == "force" else 1 / W
            factor = Dual(over * K.v, over[:, None] * K.d)
        elif what == "slip":  # of the slider: what the spring does not take up of the drive's displacement
            factor, at = Dual.plain(-np.ones(n), k), own("slip")
            offset = Dual(run.drive.displacement(run.t) + first_elongation(run) + at.v, np.tile(at.d, (n, 1)))
        elif what == "contact_area":
            w, area, growth = W / run.load.rest(float(run.t[0])), own("area"), own("area_growth")
            factor = Dual(w * area.v * growth.v, np.outer(w, area.v * growth.d + growth.v * area.d))
            offset = Dual(w * area.v, np.outer(w, area.d))
        factors.append(factor)
        offsets.append(offset)
        weighs.append(float(what in ("force", "friction")))
        shows.append(model.states.index("ln_phi") if what == "contact_area" else SPRING if number else GAUGE)
    if trend:
        along = basis(run, trend)
        moved, slope = values.get(f"{run.name}.trend", 0.0) * along, [float(b == f"{run.name}.trend") for b in by]
        offsets[0] = Dual(offsets[0].v + moved, offsets[0].d + np.outer(along, slope))

    def woven(duals: Sequence[Dual]) -> Dual:
        return Dual(np.stack([a.v for a in duals], axis=1).ravel(), np.stack([a.d for a in duals], axis=1).reshape(n * c, k))

    observed, used = (np.stack([getattr(s, name) for s in run.signals], axis=1).ravel() for name in ("observed", "used"))
    signal_indices, rate = np.tile(np.arange(c, dtype=np.intc), n), np.repeat(run.sampling.at, c)
    rounding, level = np.array([s.quantum**2 / 12 for s in run.signals]), signal_indices * len(run.sampling.spacings) + rate
    R = Dual((white.v**2)[level] + rounding[signal_indices], (2 * white.v[:, None] * white.d)[level])
    return Readings(
        np.repeat(run.t, c), observed, used, signal_indices, rate, np.tile(np.array(shows, dtype=np.intc), n), np.tile(weighs, n),
        woven(factors), woven(offsets), R,
    )  # fmt: skip


def filter_run(
    model: GeneratedModel,
    experiment: Experiment,
    run: Run,
    values: Mapping[str, float],
    *,
    by: Sequence[str] = (),
    gauges: Sequence[Mapping[str, str]] = (),
    trend: str | None = None,
    rtol: float = FILTER_RTOL,
    keep: bool = False,
    most: int | None = None,
) -> Filtered:
    """Return `run` filtered under `values` (um, s, N), with derivatives by the parameters `by`.

    `values` hold those of the model, field_amplitude and field_length among them, `gauge_white`, the standard deviation of white
    gauge noise in the observable's unit, `gauge_colour1` of a coloured part with `gauge_time1` (s) if its correlation falls off
    exponentially or `gauge_frequency1` (Hz) and `gauge_quality1` if it is an oscillator's, and so on up to 3 of these, and what
    belongs to the run alone: RUN.mu, RUN.ln_PHI, RUN.trend. `gauges` say by which names they have those of the gauge: for each
    signal, one after the other, one for each of the run's sampling rates. After `most` steps it is given up.
    """
    k, c, rates = len(by), len(run.signals), len(run.sampling.spacings)
    p = run_parameters(model, experiment, run, values)
    d = np.zeros((p.size, k))
    share = stiffness_share(experiment, run)
    for j, name in enumerate(by):
        if name in model.names:
            d[model.index(name), j] = share if name == "K" else 1.0
    start, P0 = _initial_state_distribution(model, run, p, values, by, share)
    gauges = gauges or [{n: n for n in values if n.startswith("gauge_")}] * (rates * c)
    rows = gauge_rows(processes_in(gauges[0]))
    K = Dual(p[[model.index("K")]], d[[model.index("K")]])
    read = _readings(model, run, K, _dual([own["gauge_white"] for own in gauges], values, by), values, by, trend)
    colour = _dual([own[n] if n else "" for own in gauges for row in rows for n in (*row, "")[:3]], values, by)
    gauge = [a.reshape(c, rates, len(rows), 3, *a.shape[1:]).swapaxes(0, 1) for a in (colour.v, colour.d)]
    size = np.array([max(float(np.max(np.abs(run.drive.velocities))), 1e-3) if s == "z" else 1.0 for s in model.states])
    fine = np.array([max(values["field_amplitude"], 1e-3) if s.startswith("field") else 1.0 for s in model.states])
    found = kalman_filter(
        model, Dual(p, d), read, drive=run.drive, load=run.load, start=start, covariance=P0,
        gauge=Dual(gauge[0].reshape(rates, -1, 3), gauge[1].reshape(rates, c * len(rows), 3, k)),
        order=[len(row) - 1 for row in rows] * c, owner=np.repeat(np.arange(c), len(rows)).tolist(),
        rtol=rtol, atol=rtol * size * fine, keep=keep, most=most,
    )  # fmt: skip
    return Filtered(run, tuple(by), found)


def field_columns(likelihood: Likelihood, run: Run, values: Mapping[str, float]) -> Array:
    """Return how the state at the first sample (n,) answers to a field of 1 there."""
    problem = likelihood.problem
    model = problem.model
    p = run_parameters(model, problem.experiment, run, {**problem.local(run, values), "field_amplitude": 1.0})
    x0, _ = start_state(model, run, p, values, [])
    return _field_columns(model, run, p, x0)[:, 0]


def gauge_rows(processes: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the names of the parameters of each process of coloured gauge noise; the second is its standard deviation."""
    forms = {"relaxation": "gauge_time{0} gauge_colour{0}", "oscillation": "gauge_frequency{0} gauge_colour{0} gauge_quality{0}"}
    return [tuple(forms[kind].format(j + 1).split()) for j, kind in enumerate(processes)]


def processes_in(names: Container[str]) -> list[str]:
    """Return the processes of coloured gauge noise whose parameters are among the names."""
    every = [(kind, gauge_rows([kind] * GAUGE_PROCESSES)) for kind in PROCESSES]
    return [kind for j in range(GAUGE_PROCESSES) for kind, rows in every if rows[j][0] in names]


def _dual(names: Sequence[str], values: Mapping[str, float], by: Sequence[str]) -> Dual:
    """Return values (m,) by name, 0 for no name, with their derivatives by those in `by`."""
    d = np.array([[float(b == n) for b in by] for n in names])
    return Dual(np.array([values[n] if n else 0.0 for n in names]), d.reshape(len(names), len(by)))


def _initial_state_distribution(
    model: GeneratedModel, run: Run, p: Array, values: Mapping[str, float], by: Sequence[str], share: float
) -> tuple[Dual, Dual]:
    """Return mean (n,) and covariance (n, n) of the state at the first sample, where the field is what it is anywhere."""
    names = [b for b in by if b in model.names or b.startswith(f"{run.name}.")]
    x0, S0 = start_state(model, run, p, values, names)
    columns = _field_columns(model, run, p, x0)
    d, P_d = np.zeros((x0.size, len(by))), np.zeros((x0.size, x0.size, len(by)))
    for j, name in enumerate(names):
        unit = share if name == "K" else 1.0
        at, column = by.index(name), S0[:, j] * unit
        d[:, at] = column
        step = START_DIFFERENCE * max(
            abs(values.get(name, 0.0)), abs(float(p[model.index(name)])) if name in model.names else 1e-3, 1e-12
        )
        sides = []
        for sign in (1, -1):
            q, own = p.copy(), dict(values)
            if name in model.names:
                q[model.index(name)] += sign * step
            else:
                own[name] = own[name] + sign * step
            sides.append(_field_columns(model, run, q, start_state(model, run, q, own, [])[0]))
        C_d = (sides[0] - sides[1]) / (2 * step) * unit
        P_d[:, :, at] = C_d @ columns.T + columns @ C_d.T
    return Dual(x0, d), Dual(columns @ columns.T, P_d)


def _field_columns(model: GeneratedModel, run: Run, p: Array, x0: Array) -> Array:
    """Return how the start (n,) answers to the field's two standard normal values there, (n, 2)."""
    states, out = list(model.states), np.zeros((x0.size, 2))
    V, W = float(run.drive(run.t[:1])[0]), run.load.rest(float(run.t[0]))
    for j, name in enumerate(("field_start", "field_slope_start")):
        if run.initial != "free":
            out[:, j] = derivative(model.steady, p, model.index(name))
            continue
        place = states.index(name.removesuffix("_start"))
        out[place, j] = p[model.index("field_amplitude")]
        moved = [float(derivative(lambda x: model.friction(x, V, W, 0.0, p), x0, i)) for i in (place, states.index("ln_v"))]
        out[states.index("ln_v"), j] = -out[place, j] * moved[0] / moved[1]  # friction there is what the start says
        if "z" in states:
            out[states.index("z"), j] = x0[states.index("z")] * out[states.index("ln_v"), j]
    return out


@dataclass(frozen=True)
class Point:
    """Where a likelihood was evaluated: `x` (k,) in its own coordinates, values by name, derivatives by x, runs filtered.

    `tables` are those of critical loads, matched.
    """

    x: Array
    values: dict[str, float] = field(repr=False)
    log_likelihood: float
    score: Array = field(repr=False)
    information: Array = field(repr=False)
    runs: tuple[Filtered, ...] = field(repr=False)
    tables: tuple[Matched, ...] = field(default=(), repr=False)

    @property
    def rms(self) -> float:
        """Return the root mean square of all standardised innovations and residuals: 1 under the right model."""
        white = np.concatenate([f.white for f in self.runs] + [t.white for t in self.tables])
        return float(np.sqrt(np.mean(white**2)))


class Likelihood:
    """The log likelihood of a problem's runs, whose model has a random friction field, and of its tables of critical loads.

    Coordinates x are the problem's parameters, then field_amplitude and field_length unless the track is `smooth`, gauge_white,
    and the parameters of the gauge's coloured `processes`, each a word of PROCESSES; those with a positive lower bound by
    their logarithms, in which friction laws are nearly linear. Another observable or sampling rate has a gauge noise of its own,
    within a run too; names then end in `[kind]`. What is sampled about as often as one of the given `kinds` has its noise.
    Without runs there is neither field nor gauge.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        smooth: bool = False,
        processes: Sequence[str] = (),
        rtol: float = FILTER_RTOL,
        kinds: Sequence[Kind] = (),
    ) -> None:
        self.problem, self.smooth, self.processes = problem, smooth or not problem.runs, tuple(processes)
        self.base_rtol, self.rtol = rtol, FREE_RUNNING_RTOL_FACTOR * rtol if smooth else rtol
        self.evaluations = 0
        self.best: Point | None = None  # the likeliest with slopes so far
        self._last: dict[str, tuple[Array, Filtered]] = {}  # each run as it was filtered last, and where
        self._friction = max([typical_friction(run) for run in problem.runs], default=0.0)
        scales = _scales(problem.runs) if problem.runs else {}
        self._gauge = ["gauge_white", *(n for row in gauge_rows(processes) for n in row)]
        own = dict.fromkeys(kind for run in problem.runs for kind in self.kinds_of(run))
        self.kinds = [*kinds, *(kind for kind in own if not any(_same_noise(kind, known) for known in kinds))]
        random = [(n, *scales[n]) for n in (() if self.smooth else FIELD)]
        for kind in self.kinds:
            random += [(name, *scales[n.rstrip("123"), kind[0]]) for n, name in self.gauge_names(kind).items()]
        self.names = (*problem.names, *(row[0] for row in random))
        rows = [*zip(problem.start, problem.lower, problem.upper, strict=True), *(row[1:] for row in random)]
        self.logarithmic = np.array([low > 0 for _, low, _ in rows])
        self.start, self.lower, self.upper = (
            np.array([np.log(v) if log else v for v, log in zip(column, self.logarithmic, strict=True)])
            for column in zip(*rows, strict=True)
        )
        self._tables = [self._table(loads) for loads in problem.tables]

    def beside(self, problem: Problem, processes: Sequence[str] | None = None) -> Likelihood:
        """Return the likelihood of another problem: same track, same tolerance, same coloured noise unless that is given."""
        given = self.processes if processes is None else processes
        return Likelihood(problem, smooth=self.smooth, processes=given, rtol=self.base_rtol)

    @property
    def samples(self) -> int:
        """Return the number of readings used, and of critical loads."""
        return sum(int(run.used.sum()) for run in self.problem.runs) + sum(len(t.table) for t in self.problem.tables)

    def _table(self, loads: CriticalLoads) -> TableLikelihood:
        problem = self.problem
        assert problem.stability is not None
        place = {name: n for n, names in problem.groups.items() for name in names}
        rows = zip(problem.names, problem.start, problem.lower, problem.upper, strict=True)
        bounds = {place.get(name, name): (float(a), float(b), float(c)) for name, a, b, c in rows}
        return TableLikelihood(problem.stability, loads, apparatus(problem.experiment, loads.frequency), bounds)

    def held_out_table(self, loads: CriticalLoads, values: Mapping[str, float]) -> Matched:
        """Return a table that was not fitted, matched with what was found, with derivatives by the names here."""
        return self._matched(self._table(loads), values)

    def _matched(self, table: TableLikelihood, values: Mapping[str, float], **how: bool) -> Matched:
        found = table.at(values, **how)
        return replace(found, names=self.names, slopes=joined_slopes(found, self.names, self.problem.groups))

    def values(self, x: Array) -> dict[str, float]:
        """Return parameters by name in um, s, N."""
        plain = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, x, 0.0)), x)
        found = self.problem.named(plain[: len(self.problem.names)]) | dict(zip(self.names, plain.tolist(), strict=True))
        for n in {n for own in self.problem.varying.values() for n in own}:  # where no run is asked for, it is the mean
            found[n] = float(np.mean([value for name, value in found.items() if name.startswith(f"{n}[")]))
        return found | ({"field_amplitude": 0.0, "field_length": 1.0} if self.smooth else {})

    def unit(self, x: Array) -> Array:
        """Return the derivatives (k,) of the parameters by x."""
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, x, 0.0)), 1.0)

    def coordinates(self, values: Mapping[str, float]) -> Array:
        """Return x for values by name; those left out are the start's. Within the bounds."""
        x = self.start.copy()
        for i, name in enumerate(self.names):
            if name in values:
                x[i] = np.log(max(values[name], 1e-300)) if self.logarithmic[i] else values[name]
        return np.clip(x, self.lower, self.upper)

    def at_bounds(self, x: Array) -> list[str]:
        """Return the model's parameters that stand at a bound, those of field and gauge left out."""
        inside = (self.lower < x) & (x < self.upper)
        return [n for n, within in zip(self.names, inside, strict=True) if n in self.problem.names and not within]

    def kinds_of(self, run: Run) -> list[Kind]:
        """Return the kinds of gauge noise of a run: each signal at each of its sampling rates, in its group if noise varies."""
        group = self.problem.noise_group(run)
        return [(s.observable, dt, group) for s in run.signals for dt in _spacings(run)]

    def gauge_names(self, kind: Kind) -> dict[str, str]:
        """Return the names of the gauge noise of a kind by those that `filter_run` has."""
        told = f"{kind[0]}, {kind[1]:g} s" + (f", {kind[2]}" if kind[2] else "")
        return {n: n if len(self.kinds) == 1 else f"{n}[{told}]" for n in self._gauge}

    def gauges(self, run: Run, signal: int | None = None) -> list[dict[str, str]]:
        """Return the names of a run's gauge noise, by those that `filter_run` has for them, of each signal at each sampling rate.

        Of one `signal` alone, where its number is given. A run that was held out has those of what was sampled most alike.
        """
        found, rates = [self.gauge_names(self.nearest_kind(kind)) for kind in self.kinds_of(run)], len(run.sampling.spacings)
        return found if signal is None else found[signal * rates : (signal + 1) * rates]

    def nearest_kind(self, kind: Kind) -> Kind:
        """Return which of the kinds of gauge noise here is most like this one."""
        near = [known for known in self.kinds if known[0] == kind[0]] or self.kinds
        near = [known for known in near if known[2] == kind[2]] or near
        return min(near, key=lambda known: abs(np.log(known[1] / kind[1])))

    def filtered(
        self, run: Run, values: Mapping[str, float], *, slopes: bool = False, keep: bool = False, most: int | None = None
    ) -> Filtered:
        """Return one run filtered under values by name, with derivatives by the names that it depends on."""
        gauges, problem, by = self.gauges(run), self.problem, self._dependences(run)
        found = filter_run(
            problem.model, problem.experiment, run, problem.local(run, values), by=tuple(by.values()) if slopes else (),
            gauges=gauges, trend=None if run.holdout else problem.trend, rtol=self.rtol, keep=keep, most=most,
        )  # fmt: skip
        return replace(found, names=tuple(by) if slopes else ())

    def _dependences(self, run: Run) -> dict[str, str]:
        """Return the names that a run depends on, by those that `filter_run` has."""
        problem = self.problem
        own = {name: n for n, name in problem.varied(run).items()} | {n: n for gauge in self.gauges(run) for n in gauge.values()}
        others = {name for names in problem.varying.values() for name in names.values()} | {*problem.experiment.elsewhere(run)}
        return {
            n: own.get(n, n)
            for n in self.names
            if n in own or (n not in others and ("." not in n or n.startswith(f"{run.name}.")) and "gauge_" not in n)
        }

    @cached_property
    def _places(self) -> dict[str, list[int]]:
        """Return the places of the coordinates that each run depends on."""
        return {run.name: [self.names.index(n) for n in self._dependences(run)] for run in self.problem.runs}

    def held_out(self, run: Run, values: Mapping[str, float]) -> Filtered:
        """Return a run that was not fitted, filtered; what belongs to it alone, a free start, a trend, is estimated.

        So is what varies, if no run that was fitted is of its group.
        """
        own = run_specific_names(self.problem.model, run, self.problem.trend)
        if not own and not self.has_own_noise(run) and values.keys() >= {*self.problem.varied(run).values()}:
            return self.filtered(run, values)
        return replace(self.single_run_maximum(run, values)[1].runs[0], run=run)

    def has_own_noise(self, run: Run) -> bool:
        """Return whether no run that was fitted has this one's gauge noise: none of its group, or none sampled about as often."""
        return not all(any(_same_noise(kind, known) for known in self.kinds) for kind in self.kinds_of(run))

    def single_run_maximum(self, run: Run, values: Mapping[str, float]) -> tuple[Likelihood, Point]:
        """Return the likelihood of a run that was not fitted, by what belongs to it alone, and its maximum."""
        problem = self.problem
        own = run_specific_names(problem.model, run, problem.trend)
        varying = {name: n for n, name in problem.varied(run).items() if name not in values}
        p = run_parameters(problem.model, problem.experiment, run, values)
        rows = [run_specific_start(problem.model, run, p, n, problem.trend) for n in own]
        listed = {q.name: q for q in problem.experiment.parameters}
        for name, n in varying.items():
            others = [values[other] for other in {names[n] for names in problem.varying.values()} if other in values]
            rows.append((float(np.mean(others)), listed[n].lower, listed[n].upper))
            own.append(name)
        start, lower, upper = np.array(rows).reshape(-1, 3).T
        of_group = set(problem.varied(run).values()) - set(own)
        held = {n: values[n] for n in (*problem.fixed_values, *problem.names) if "." not in n or n in of_group}
        alone = replace(
            problem, runs=(replace(run, holdout=False),), names=tuple(own), start=start, lower=lower, upper=upper,
            fixed_values=held, priors=(), tables=(),
        )  # fmt: skip
        likelihood = self.beside(alone)
        known = {n: values[n] for n in FIELD}
        for alone_names, names in zip(likelihood.gauges(alone.runs[0]), self.gauges(run), strict=True):
            known |= {name: values[names[local]] for local, name in alone_names.items()}
        x = likelihood.coordinates(known)
        gauge = [n for n in likelihood.names if n not in (*own, *FIELD)] if self.has_own_noise(run) else []
        return likelihood, maximise(likelihood, x, fixed=[n for n in likelihood.names if n not in (*own, *gauge)]).point

    def innovations_by_kind(self, point: Point) -> Iterator[tuple[Array, Array, Kind]]:
        """Yield standardised innovations, their log densities, kinds of gauge noise, of each signal at each of its rates."""
        for f in point.runs:
            rates, at = len(f.run.sampling.spacings), f.run.sampling.at
            kind = np.concatenate([i * rates + at[s.used] for i, s in enumerate(f.run.signals)])
            white, density = f.white, f.log_density
            for k, own in enumerate(self.kinds_of(f.run)):
                yield white[kind == k], density[kind == k], self.nearest_kind(own)

    def by_kind(self, point: Point) -> list[float]:
        """Return what each kind of gauge noise has of the log likelihood."""
        if not np.isfinite(point.log_likelihood):
            return [-np.inf] * len(self.kinds)
        total = dict.fromkeys(self.kinds, 0.0)
        for _, density, kind in self.innovations_by_kind(point):
            total[kind] += float(np.sum(density))
        return list(total.values())

    def over_runs(self, work: Callable[[Run], T]) -> list[T]:
        """Return what `work` makes of each run, on as many threads as there are processors."""
        count = min(len(self.problem.runs), os.cpu_count() or 1)
        if count < 2:
            return [work(run) for run in self.problem.runs]
        with ThreadPoolExecutor(count) as pool:
            return list(pool.map(work, self.problem.runs))

    def at(self, x: Array, *, slopes: bool = True, keep: bool = False, like: Point | None = None, anew: bool = False) -> Point:
        """Return log likelihood, score and information at x (k,); -inf if a run takes MAX_WORK_RATIO times the steps of `like`.

        With `anew` every line of the tables is searched in full.
        """
        if slopes and not keep and not anew and self.best is not None and np.array_equal(x, self.best.x):
            return self.best
        values, k = self.values(x), len(self.names)
        self.evaluations += 1
        most, failed = {f.run.name: MAX_WORK_RATIO * f.found.steps for f in like.runs} if like else {}, False

        def one(run: Run) -> Filtered:
            nonlocal failed  # then the others are not needed
            own = x[self._places[run.name]]
            last = self._last.get(run.name)
            if last is not None and not keep and (last[1].names or not slopes) and np.array_equal(own, last[0]):
                return last[1]  # of what varies by group most runs do not depend
            found = self.filtered(run, values, slopes=slopes, keep=keep, most=0 if failed else most.get(run.name))
            failed = failed or not found.whole
            if found.whole:
                self._last[run.name] = own, found
            return found

        runs = tuple(self.over_runs(one))
        total = float(sum(f.log_likelihood for f in runs))
        tables: tuple[Matched, ...] = ()
        if np.isfinite(total):
            tables = tuple(self._matched(t, values, slopes=slopes, anew=anew) for t in self._tables)
            total += sum(t.log_likelihood for t in tables)
        score, information = np.zeros(k), np.zeros((k, k))
        unit = self.unit(x)
        for names, scatter in self.problem.priors:  # of values about a mean that is unknown
            indices = [self.names.index(n) for n in names]
            off = np.array([values[n] for n in names])
            off = (off - off.mean()) / scatter**2
            total -= 0.5 * scatter**2 * float(off @ off)
            score[indices] -= off * unit[indices]
            centred = np.eye(off.size) - 1 / off.size
            information[np.ix_(indices, indices)] += centred / scatter**2 * np.outer(unit[indices], unit[indices])
        if slopes and np.isfinite(total):
            for t in tables:
                score += t.score * unit
                information += t.information * np.outer(unit, unit)
            for f in runs:
                at = [self.names.index(n) for n in f.names]
                with np.errstate(over="ignore", invalid="ignore"):  # of a motion that cannot be differentiated
                    score[at] += f.score * unit[at]
                    information[np.ix_(at, at)] += f.information * np.outer(unit[at], unit[at])
            if not (np.isfinite(score).all() and np.isfinite(information).all()):
                total = -np.inf  # a motion that cannot be differentiated is none to go on from
        point = Point(x, values, total, score, information, runs, tables)
        if slopes and (anew or self.best is None or total > self.best.log_likelihood):
            self.best = point
        return point


def _same_noise(kind: Kind, known: Kind) -> bool:
    """Return whether two kinds of gauge noise are one: of an observable, of a group, sampled about as often."""
    return kind[::2] == known[::2] and abs(np.log(known[1] / kind[1])) < SAME_RATE


def _scales(runs: Sequence[Run]) -> dict[Any, tuple[float, float, float]]:
    """Return start value and bounds of the parameters of the field, and of the gauge by parameter and observable."""
    friction = max(float(np.median([typical_friction(r) for r in runs])), 1e-6)
    slid = max(float(np.sum(np.abs(r.drive(r.t[1:])) * np.diff(r.t))) for r in runs)
    spacing = min(dt for r in runs for dt in r.sampling.spacings)
    longest = max(float(r.t[-1] - r.t[0]) for r in runs)
    length = max(slid, 1e-6) / LENGTHS_IN_SLIP
    found: dict[Any, tuple[float, float, float]] = {
        "field_amplitude": (WIDE_FIELDS[0][0] * friction, LEAST_FIELD * friction, 0.3 * friction),
        "field_length": (length, length / 100, 10 * length),
    }
    for what in {s.observable for r in runs for s in r.signals}:
        own = [(r.t, s) for r in runs for s in r.signals if s.observable == what]
        level = float(np.median([white_noise_level(*each) for each in own]))
        quiet = min([level, *(max(_calm_noise_level(*each), 1e-3 * level) for each in own)])
        found |= {
            ("gauge_white", what): (level, quiet / 30, 100 * level),
            ("gauge_colour", what): (level, quiet / 100, 100 * level),
            ("gauge_time", what): (10 * spacing, spacing, longest),
            ("gauge_frequency", what): (0.1 / spacing, 1 / longest, FASTEST_OSCILLATION / spacing),
            ("gauge_quality", what): (0.5, *QUALITY),
        }
    return found


def _calm_noise_level(t: Array, signal: Signal) -> float:
    """Return the white noise of a signal at the times t (n,), however large its corners and jumps are, and its rounding."""
    a, b = max(stretches(t, signal.used), key=lambda part: part[1] - part[0])
    return float(np.hypot(calm_level(signal.observed[a:b]), signal.quantum / np.sqrt(12)))


def _spacings(run: Run) -> list[float]:
    """Return the spacings (s) at which a run was sampled, to two digits: runs that agree in them share a gauge noise."""
    return [float(f"{dt:.2g}") for dt in run.sampling.spacings]


def white_noise_level(t: Array, signal: Signal) -> float:
    """Return the standard deviation of white noise that the readings of a signal at the times t (n,) show themselves."""
    level = difference_level(signal.observed, stretches(t, signal.used))
    return max(level, signal.quantum / np.sqrt(12), 1e-9 * float(np.ptp(signal.observed)), 1e-300)


def typical_friction(run: Run) -> float:
    """Return the typical friction coefficient of a recording."""
    return float(np.median(np.abs(run.friction[run.used])))


@dataclass(frozen=True)
class Maximum:
    """Where Fisher scoring ended: the point, how far the maximum may still be in standard errors, the status, covariance by x.

    The covariance is that of this maximum; `spread` (k, k) is what others beside it that are nearly as likely add.
    """

    point: Point
    away: float
    status: Status
    covariance: Array = field(repr=False)
    spread: Array | float = field(default=0.0, repr=False)

    @property
    def expected(self) -> float:
        """Return the log likelihood expected at the maximum; that of the point where scoring had yet to weigh all alike.

        Of recordings it is expected PRUNING_DEFICIT above the point at most: from farther off the score tells nothing of the
        maximum.
        """
        gain = 0.5 * self.away**2 if np.isfinite(self.away) else 0.0
        return self.point.log_likelihood + (min(gain, PRUNING_DEFICIT) if self.point.runs else gain)


def maximise(
    likelihood: Likelihood,
    x: Array,
    *,
    fixed: Sequence[str] = (),
    steps: int = SCORING_STEPS,
    close: float = CONVERGED,
    widths: Sequence[float] | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Maximum:
    """Return the maximum from x (k,), by Fisher scoring with Levenberg's damping; parameters in `fixed` stay where they are.

    Readings and critical loads are weighted first, by how far each tells something, `widths` one after the other (WIDTHS), and
    then all count alike, from where the weights led or, if that is likelier, from a point that was passed on the way.
    It ends within `close` standard errors of the maximum, by the score, or where two steps running each gain less than a quarter
    of what that distance is worth. Parameters that a step would push out stay at their
    bounds. A likelihood that cannot be evaluated at x is a status.
    """
    free = np.array([n not in fixed for n in likelihood.names])
    point, damping = likelihood.at(np.clip(x, likelihood.lower, likelihood.upper)), 1e-3
    if not np.isfinite(point.log_likelihood):
        return Maximum(point, np.inf, Status.INTEGRATION, np.full((x.size, x.size), np.nan))
    away, sure, slow, more, left = np.inf, True, 0, np.zeros((x.size, x.size)), [*(WIDTHS if widths is None else widths), 0.0]
    best = point  # of those that were passed
    winding = False  # whether straight steps go to and fro, as along a ridge that bends
    trail: list[Array] = []  # where the last steps led
    for _ in range(steps):
        low, high = point.x <= likelihood.lower, point.x >= likelihood.upper
        while True:
            width = left[0]
            score, information = point.score, point.information
            weights: list[Array] = []
            if width:
                score, information, weights = _weighted_score(likelihood, point, width, free)
            moving = np.nonzero(free & ~(low & (score < 0)) & ~(high & (score > 0)))[0]
            g, I = score[moving], (information + more)[np.ix_(moving, moving)]
            d, size, directions = _scaled(I)
            steep = directions.T @ (g / d)
            felt = np.diag(I) * (likelihood.upper - likelihood.lower)[moving] ** 2 > MIN_SENSITIVITY
            wide, power, ways = (d, size, directions) if felt.all() else _scaled(I[np.ix_(felt, felt)])
            away = float(np.sqrt(np.sum((ways.T @ (g[felt] / wide)) ** 2 / power)))
            if not width or (away > np.sqrt(moving.size) and slow < 2):  # farther than chance would have it
                break
            left, slow, damping = left[1:], 0, 1e-3
        if not width and best.log_likelihood > point.log_likelihood + away**2 / 2 + SIGNIFICANT_GAIN:  # weights led astray
            progress(f"log likelihood {point.log_likelihood:.1f}, where {best.log_likelihood:.1f} was passed")
            point = best
            continue
        within = f" by readings that hold within {100 * width:g} %" if width else ""
        progress(f"log likelihood {point.log_likelihood:.1f}, {away:.2g} standard errors from the maximum{within}")
        if not width and (away < close or slow == 2):
            break
        bent = winding
        while damping < 1e8:
            move = directions @ (steep / (size + damping)) / d
            if winding and not width:
                bend = (
                    directions
                    @ ((directions.T @ (_acceleration_score(likelihood, point, moving, move) / d)) / (size + damping))
                    / d
                )
                turn = 2 * float(np.linalg.norm(bend * d) / np.linalg.norm(move * d))
                winding, part = turn > MIN_ACCELERATION, min(MAX_ACCELERATION / max(turn, MAX_ACCELERATION), 1.0)
                move = part * move + part**2 * bend / 2
            move = np.where(likelihood.logarithmic[moving], np.clip(move, -MAX_LOG_STEP, MAX_LOG_STEP), move)
            x = point.x.copy()
            x[moving] += move
            trial = likelihood.at(np.clip(x, likelihood.lower, likelihood.upper), slopes=sure, like=point)
            gain = _gain(trial, point, weights)
            if gain > 0 and not sure:
                trial = likelihood.at(trial.x)
                gain = _gain(trial, point, weights)
            if gain > 0:
                share = gain / max(float(g @ move - 0.5 * move @ I @ move), 1e-300)  # of what its quadratic model expects
                damping = max(damping * (0.1 if share > 0.5 else 1.0 if share > 0.25 else 2.0), 1e-9)
                last, point, sure = point, trial, share > 0.25
                more = more if width else _sr1_correction(last, point)
                winding = winding or share < 0.5
                if not width and gain < 1.0:
                    point = _pattern_move(likelihood, trial, trail)
                    gain += point.log_likelihood - trial.log_likelihood
                trail = [*trail[-1:], point.x]
                best = max(best, point, key=lambda p: p.log_likelihood)
                slow = slow + 1 if gain < (max(1.0, STALLED_GAIN_SHARE * away**2 / 2) if width else close**2 / 8) else 0
                break
            sure = False  # what may fail is tried without derivatives: a quarter of the work
            if not felt.all():  # next without what changes nothing here, whose steps may lead anywhere
                moving, g, I = moving[felt], g[felt], I[np.ix_(felt, felt)]
                d, size, directions, felt = wide, power, ways, felt[felt]
                steep = directions.T @ (g / d)
                continue
            if bent or width:
                damping = max(10 * damping, 1e-3 if width else 1e-6)
            winding = bent = True  # the step is tried bent before it is tried shorter
        else:
            if not width:
                break
            slow, damping = 2, 1e-3
    away, point = (np.inf, best) if left[0] else (away, point)
    at_bound = ((point.x <= likelihood.lower) & (point.score < 0)) | ((point.x >= likelihood.upper) & (point.score > 0))
    covariance, inner = np.zeros((point.x.size,) * 2), np.nonzero(free & ~at_bound)[0]
    covariance[np.ix_(inner, inner)] = inverse(point.information[np.ix_(inner, inner)])
    return Maximum(point, away, Status.OK if away < CONVERGED else Status.NO_CONVERGENCE, covariance)


def _scaled(information: Array) -> tuple[Array, Array, Array]:
    """Return the roots d (m,) of an information's diagonal, and its eigenvalues (p,) and directions (m, p) over these."""
    d = np.sqrt(np.maximum(np.diag(information), 1e-300))
    size, directions = np.linalg.eigh(information / np.outer(d, d))
    return d, size[size > MIN_EIGENVALUE], directions[:, size > MIN_EIGENVALUE]


def _pattern_move(likelihood: Likelihood, point: Point, trail: Sequence[Array]) -> Point:
    """Return the likeliest point on the way from the last but one of the points before, 2, 4, 8 times as far; else the point.

    Steps that go to and fro across a ridge lead along it two by two: the pattern move of Hooke and Jeeves, J. ACM 8 (1961).
    """
    if len(trail) < 2:
        return point
    best, x = point.log_likelihood, point.x
    for factor in 2.0 ** np.arange(1, 6):
        y = np.clip(trail[0] + factor * (point.x - trail[0]), likelihood.lower, likelihood.upper)
        found = likelihood.at(y, slopes=False, like=point).log_likelihood
        if not found > best:
            break
        best, x = found, y
    farthest = point if x is point.x else likelihood.at(x)
    return farthest if farthest.log_likelihood > point.log_likelihood else point


def _weighted_score(likelihood: Likelihood, point: Point, width: float, free: Array) -> tuple[Array, Array, list[Array]]:
    """Return score and information with a weight (m,) for each reading, and the weights by run: those of effective variances.

    Each parameter that is `free` (k,) is taken to be uncertain by the share `width` of itself, or by WIDEST_ERRORS times
    `width` of its standard errors if that is less, and the variance of a reading to be larger by what that makes of it. So a
    reading has no say on what it tells only next to the parameters where it was differentiated: each in the fall of a stick-
    slip cycle would give the likelihood a narrow maximum for each way in which falls meet samples. A weight rests on earlier
    readings alone, so that the weighted score is zero on average at the true parameters. Where two crossings merge and vanish
    a critical load has slopes without end, and no say, so that its jump is no barrier. Orear, Am. J. Phys. 50 (1982).
    """
    k, own = len(likelihood.names), free & np.isin(likelihood.names, likelihood.problem.names)
    whites = [f.white for f in point.runs] + [t.white for t in point.tables]
    runs = [
        (at, a, b, 0.5 * (white**2 - 1)[:, None] * b - white[:, None] * a)
        for (at, a, b), white in zip(_slopes(likelihood, point), whites, strict=True)
    ]
    widest = np.where(own, width * np.where(likelihood.logarithmic, 1.0, np.abs(point.x)), 0.0)
    uncertain = widest
    for _ in range(WEIGHT_ROUNDS):
        score, information, weights = np.zeros(k), np.zeros((k, k)), []
        for at, a, b, slope in runs:
            w = 1 / (1 + (a**2 + 0.5 * b**2) @ uncertain[at] ** 2)
            score[at] += w @ slope
            information[np.ix_(at, at)] += a.T @ (a * w[:, None]) + 0.5 * b.T @ (b * w[:, None])
            weights.append(w)
        before, errors = uncertain, 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        uncertain = np.minimum(widest, WIDEST_ERRORS * width * errors)
        if np.allclose(uncertain, before, rtol=0.1):
            break
    return score, information, weights


def _acceleration_score(likelihood: Likelihood, point: Point, moving: Array, move: Array) -> Array:
    """Return what the second derivatives of all innovations along a step (m,) do to the score (m,); zeros where it leads astray.

    By one likelihood without derivatives. Half of the step that this makes, added, follows a ridge that bends, which straight
    steps cross to and fro: geodesic acceleration, Transtrum and Sethna, arXiv:1201.5885 (2012).
    """
    total, along = np.zeros((2, len(likelihood.names)))
    along[moving] = move
    if np.any(ACCELERATION_STEP * np.abs(along[likelihood.logarithmic]) > MAX_LOG_STEP):
        return total[moving]
    probe = likelihood.at(point.x + ACCELERATION_STEP * along, slopes=False, like=point)
    if not np.isfinite(probe.log_likelihood):
        return total[moving]
    moved: list[tuple[Array, Array | float]] = []
    for f, g in zip(point.runs, probe.runs, strict=True):
        S = f.every.S[f.used]
        moved.append(((g.every.nu - f.every.nu)[f.used] / np.sqrt(S), np.log(g.every.S[f.used] / S)))
    moved += [(u.white - t.white, 0.0) for t, u in zip(point.tables, probe.tables, strict=True)]
    for (at, a, b), (first, second) in zip(_slopes(likelihood, point), moved, strict=True):
        bends = [2 / ACCELERATION_STEP * (m / ACCELERATION_STEP - slope @ along[at]) for m, slope in ((first, a), (second, b))]
        total[at] -= bends[0] @ a + 0.5 * bends[1] @ b  # weights as in the information
    return total[moving]


def _slopes(likelihood: Likelihood, point: Point) -> list[tuple[list[int], Array, Array]]:
    """Return for each run and each table the places of its parameters (k,), and derivatives (m, k) by these coordinates.

    Those of innovations over their standard deviations, or of residuals, and of the logarithms of variances.
    """
    unit, found = likelihood.unit(point.x), []
    for f in point.runs:
        at = [likelihood.names.index(n) for n in f.names]
        a, b = (slope * unit[at] for slope in f.slopes)
        found.append((at, a, b))
    for t in point.tables:
        a = t.slopes * unit
        found.append(([*range(unit.size)], a, np.zeros_like(a)))
    return found


def _gain(trial: Point, point: Point, weights: Sequence[Array]) -> float:
    """Return what a trial gains in log likelihood, that of weighted readings if there are weights."""
    if not weights or not np.isfinite(trial.log_likelihood):
        return trial.log_likelihood - point.log_likelihood
    after, before = ([f.log_density for f in x.runs] + [t.log_density for t in x.tables] for x in (trial, point))
    return float(sum(w @ (new - old) for w, new, old in zip(weights, after, before, strict=True)))


def _sr1_correction(last: Point, point: Point) -> Array:
    """Return what the curvature along the last step has beyond the information (k, k), by the change of the score (SR1).

    Scoring by the information alone overshoots there, to and fro. A smaller curvature is left alone: it makes no step too long.
    """
    step = point.x - last.x
    with np.errstate(all="ignore"):  # far from a maximum, of a run that nearly sticks
        missed = last.score - point.score - point.information @ step
        along = float(missed @ step)
        beyond = np.outer(missed, missed) / along
        curved = along > 1e-8 * float(np.linalg.norm(missed) * np.linalg.norm(step)) and bool(np.isfinite(beyond).all())
    return np.asarray(beyond) if curved else np.zeros_like(point.information)


@dataclass(frozen=True)
class Predictive:
    """Log marginal likelihood of a run under a fit to others, and the rms of its innovations with the parameters moved for it.

    What the others lose in likelihood when the parameters move is counted in `rms`. `fit` is that to the others and the run,
    which is the last.
    """

    log_likelihood: float
    rms: float
    fit: StateSpaceFit = field(repr=False, compare=False)


@dataclass(frozen=True)
class StateSpaceFit:
    """A fit of all runs together: its likelihood, the maximum there, and how many times all runs were filtered."""

    likelihood: Likelihood
    maximum: Maximum
    evaluations: int = 0  # 0 while it is being sought
    _predicted: dict[str, tuple[Run, Predictive]] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def smooth(self) -> bool:
        """Return whether no random friction field is needed."""
        return self.likelihood.smooth

    @property
    def values(self) -> dict[str, float]:
        """Return all parameters by name, those of field and gauge too, in um, s, N."""
        return self.maximum.point.values

    @property
    def covariance(self) -> Array:
        """Return the covariance (k, k) of all parameters, in um, s, N; zero for one at a bound."""
        unit = self.likelihood.unit(self.maximum.point.x)
        return np.asarray((self.maximum.covariance + self.maximum.spread) * np.outer(unit, unit))

    @property
    def log_likelihood(self) -> float:
        """Return the log likelihood at the maximum."""
        return self.maximum.point.log_likelihood

    @cached_property
    def smoothed_states(self) -> dict[str, Array]:
        """Return the states (n, n_states and those of gauge noise) of each fitted run, by name, given all its readings."""
        point = self.likelihood.at(self.maximum.point.x, slopes=False, keep=True)
        return {f.run.name: f.smoothed().mean for f in point.runs}

    def predictive(self, run: Run, sizes: Mapping[str, tuple[float, float]] | None = None) -> Predictive:
        """Return how well a run that was not fitted is predicted, with the parameters as uncertain as they are.

        By Laplace's method: p(new | old) = p(new, old) / p(old), of a fit to both and of this one. `sizes` are as in
        `log_evidence`. Each run is predicted once.
        """
        known = self._predicted.get(run.name)
        if known is None or known[0] is not run:
            known = self._predicted[run.name] = (run, self._predictive(run, sizes))
        return known[1]

    def _predictive(self, run: Run, sizes: Mapping[str, tuple[float, float]] | None) -> Predictive:
        both, start = self._joined_with(run)
        maximum = maximise(both, both.coordinates(start), close=PREDICTION_TOLERANCE)
        if both.best is not None and both.best.log_likelihood > maximum.point.log_likelihood:
            maximum = maximise(both, both.best.x, close=PREDICTION_TOLERANCE, widths=())
        point = maximum.point
        *_, last = point.runs
        fit = StateSpaceFit(both, replace(maximum, point=replace(point, runs=(last,))))
        both.best = None  # derivatives of all readings take much room
        if not np.isfinite(point.log_likelihood):
            return Predictive(-np.inf, np.inf, fit)
        moved = self.log_likelihood - (point.log_likelihood - last.log_likelihood)  # of what was fitted
        total = log_evidence(StateSpaceFit(both, maximum), sizes) - log_evidence(self, sizes)
        total += _remaining_gain(maximum) - _remaining_gain(self.maximum)
        total += min(moved, 0.0)  # that the others have a higher maximum is nothing that was predicted
        rms = float(np.sqrt((last.white @ last.white + 2 * max(moved, 0.0)) / last.white.size))
        return Predictive(total, rms, fit)

    def _joined_with(self, run: Run) -> tuple[Likelihood, dict[str, float]]:
        """Return the likelihood of the runs that were fitted and of another, which comes last, and where it is maximised from.

        What is known has the same bounds, so that priors are the same.
        """
        own, (alone, point) = self.likelihood, self.likelihood.single_run_maximum(run, self.values)
        before, after = own.problem, alone.problem
        joined = replace(
            before, runs=(*before.runs, *after.runs), names=(*before.names, *after.names),
            start=np.append(before.start, after.start), lower=np.append(before.lower, after.lower),
            upper=np.append(before.upper, after.upper),
        )  # fmt: skip
        both = Likelihood(joined, smooth=own.smooth, processes=own.processes, rtol=own.base_rtol, kinds=own.kinds)
        known = {n: n for n in own.names if n in both.names}
        for each in both.problem.runs:
            for here, there in zip(both.gauges(each), own.gauges(each), strict=True):
                known |= {name: there[n] for n, name in here.items()}
        for name, like in known.items():
            i, j = both.names.index(name), own.names.index(like)
            both.lower[i], both.upper[i] = own.lower[j], own.upper[j]
        return both, {**point.values, **{name: self.values[like] for name, like in known.items()}}

    @property
    def criterion(self) -> float:
        """Return the log likelihood less half of ln n for each parameter (Schwarz 1978)."""
        return self.log_likelihood - 0.5 * np.log(self.likelihood.samples) * len(self.likelihood.names)


def log_evidence(found: StateSpaceFit, sizes: Mapping[str, tuple[float, float]] | None = None) -> float:
    """Return the log marginal likelihood by Laplace's method; `mass_at_bounds` is a part of it.

    Priors are flat within the bounds, in the likelihood's coordinates; that of a parameter in `sizes`, by name, is a Cauchy
    distribution (centre, scale).
    """
    if not np.isfinite(found.log_likelihood):
        return found.log_likelihood
    covariance = found.maximum.covariance
    free = np.diag(covariance) > 0
    d = np.sqrt(np.diag(covariance)[free])
    _, logdet = np.linalg.slogdet(covariance[np.ix_(free, free)] / np.outer(d, d))
    occam = np.log(np.sqrt(2 * np.pi) * d) + _log_prior(found, sizes)[free]  # a prior is never narrower than the posterior
    return float(found.log_likelihood + 0.5 * logdet + np.sum(np.minimum(occam, 0.0)) + mass_at_bounds(found, sizes))


def mass_at_bounds(found: StateSpaceFit, sizes: Mapping[str, tuple[float, float]] | None = None) -> float:
    """Return what parameters at a bound add to the log evidence: each a one-sided integral, along which the others follow it."""
    likelihood, maximum, total = found.likelihood, found.maximum, 0.0
    x, score, I = maximum.point.x, maximum.point.score, maximum.point.information
    free, prior = np.diag(maximum.covariance) > 0, _log_prior(found, sizes)
    for j in np.flatnonzero(~free & ((x <= likelihood.lower) | (x >= likelihood.upper))):
        bent = float(I[j, j] - I[j, free] @ maximum.covariance[np.ix_(free, free)] @ I[free, j])
        d = 1 / np.sqrt(max(bent, (1e-3 * score[j]) ** 2, 1e-300))
        total += min(float(np.log(np.sqrt(np.pi / 2) * d * erfcx(abs(score[j]) * d / np.sqrt(2))) + prior[j]), 0.0)
    return total


def _log_prior(found: StateSpaceFit, sizes: Mapping[str, tuple[float, float]] | None) -> Array:
    """Return the log prior density (k,) of each coordinate at the maximum."""
    likelihood, density = found.likelihood, -np.log(found.likelihood.upper - found.likelihood.lower)
    for name, (centre, scale) in (sizes or {}).items():
        j = likelihood.names.index(name) if name in likelihood.names else -1  # it may be held
        if j >= 0 and not likelihood.logarithmic[j] and scale > 0:
            density[j] = -np.log(np.pi * scale * (1 + ((found.values[name] - centre) / scale) ** 2))
    return np.asarray(density)


def _remaining_gain(maximum: Maximum) -> float:
    """Return what the log likelihood still gains if scoring ended within PREDICTION_TOLERANCE of its maximum."""
    return 0.5 * maximum.away**2 if maximum.away < PREDICTION_TOLERANCE else 0.0


class Interrupted(Exception):
    """Carries the likeliest fit, perhaps to a part of the readings, before the user stopped it; None if there was none yet."""

    def __init__(self, found: StateSpaceFit | None) -> None:
        super().__init__("interrupted")
        self.found = found


def fit_state_space(
    problem: Problem,
    *,
    start: Mapping[str, float] | None = None,
    part: StateSpaceFit | None = None,
    smooth: bool | None = None,
    processes: Sequence[str] | None = None,
    cautious: bool = False,
    thorough: bool = True,
    beside: bool = True,
    least: float = -np.inf,
    close: float = CONVERGED,
    rtol: float = FILTER_RTOL,
    many: int = MANY_READINGS,
    progress: Callable[[str], None] = lambda text: None,
) -> StateSpaceFit:
    """Return the maximum-likelihood fit of parameters, random friction field and gauge noise, `close` standard errors or nearer.

    From `start`, the problem's own start values if left out; where it holds field_amplitude, the field is not looked for first.
    More than `many` readings are fitted in two steps: every so-many-th of them, then all from there; `part` is the fit of the
    first step where it is known.
    `smooth` says whether there is no field; left out, there is one where it gains 2 in log likelihood. `processes` says which
    of coloured noise the gauge has, words of PROCESSES; left out, Schwarz's criterion decides, early and, if the fit is to be
    `thorough`, again at the maximum; where it is `cautious`, more than one only if innovations are correlated all along, as those
    of a model that lacks something are not. `beside` says whether maxima next to that found are looked for
    (`likeliest_along_ridges`). What stays below `least` in log likelihood is not finished. The status is that of the last
    maximisation.
    """
    fit = _FitProcedure(problem, smooth, processes, cautious, close, rtol, progress)
    try:
        if part is None and start is None and (runs := thinned(problem.runs, many)) is not problem.runs:
            part = fit_state_space(
                replace(problem, runs=runs), smooth=smooth, processes=processes, cautious=cautious, thorough=thorough,
                beside=beside, close=close, rtol=rtol, many=many, progress=progress,
            )  # fmt: skip
        if not problem.runs:  # there is neither field nor gauge
            own = fit.likelihood(True, ())
            found = fit.maximised(own, own.coordinates(start or {}))
        elif part is not None and part.maximum.status is not Status.INTEGRATION:
            found = fit.on_all(part)
        else:
            found = fit.from_start(start or {}, thorough=thorough, beside=beside, least=least)
        found = _surveyed(found, close, progress) if problem.tables else found
        return replace(found, evaluations=sum(own.evaluations for own in fit.tried) + (part.evaluations if part else 0))
    except KeyboardInterrupt as error:
        likely = []
        for own in fit.tried:
            if (last := own.best) is not None:
                unknown = np.full_like(last.information, np.nan)
                likely.append(StateSpaceFit(own, Maximum(last, np.inf, Status.INTERRUPTED, unknown)))
        raise Interrupted(max(likely, key=lambda f: f.log_likelihood, default=None)) from error


def with_priors(found: StateSpaceFit, priors: Sequence[tuple[tuple[str, ...], float]]) -> StateSpaceFit:
    """Return the fit with the values of groups, each with the scatter of its prior, drawn towards their means."""
    own = found.likelihood
    likelihood = own.beside(replace(own.problem, priors=tuple(priors)))
    maximum = maximise(likelihood, likelihood.coordinates(found.values), widths=())
    return StateSpaceFit(likelihood, maximum, found.evaluations + likelihood.evaluations)


def _surveyed(found: StateSpaceFit, close: float, progress: Callable[[str], None]) -> StateSpaceFit:
    """Return a fit whose critical loads are the nearest of all: where a search of every line finds nearer ones, it goes on."""
    own, maximum = found.likelihood, found.maximum
    if maximum.status is Status.INTEGRATION:
        return found
    for _ in range(MAX_SURVEYS):
        point = own.at(maximum.point.x, anew=True)
        if abs(point.log_likelihood - maximum.point.log_likelihood) < close**2 / 2:
            maximum = replace(maximum, point=point)
            break
        progress(f"nearer critical loads: log likelihood {point.log_likelihood:.1f}")
        maximum = maximise(own, point.x, close=close, widths=(), progress=progress)
    return StateSpaceFit(own, maximum)


def interrupted_fit(problem: Problem, found: StateSpaceFit | None) -> StateSpaceFit:
    """Return the state of a fit that was stopped: its parameters, with errors as if they were the maximum."""
    smooth, processes = (found.smooth, found.likelihood.processes) if found else (True, ())
    likelihood = Likelihood(problem, smooth=smooth, processes=processes)
    point = likelihood.at(likelihood.coordinates(_values_for(found, likelihood) if found else {}))
    return StateSpaceFit(likelihood, Maximum(point, np.inf, Status.INTERRUPTED, inverse(point.information)), 1)


def thinned(runs: tuple[Run, ...], many: int = MANY_READINGS) -> tuple[Run, ...]:
    """Return the runs with so `many` readings at most; the same runs where they have no more."""
    if sum(run.t.size for run in runs) <= many:
        return runs
    return tuple(run.thinned(-(-run.t.size * len(runs) // many)) for run in runs)


def _values_for(found: StateSpaceFit, likelihood: Likelihood) -> dict[str, float]:
    """Return the values of a fit, by name, with those of its gauge noise under the names that another likelihood has."""
    values, own = dict(found.values), found.likelihood
    for kind in likelihood.kinds:
        known = own.gauge_names(own.nearest_kind(kind))
        values |= {name: values[known[n]] for n, name in likelihood.gauge_names(kind).items() if n in known}
    return values


@dataclass(frozen=True)
class _FitProcedure:
    """The steps of `fit_state_space`, whose arguments hold for all of them; `tried` are the likelihoods so far."""

    problem: Problem
    smooth: bool | None
    processes: Sequence[str] | None
    cautious: bool
    close: float
    rtol: float
    progress: Callable[[str], None]
    tried: list[Likelihood] = field(default_factory=list)

    def likelihood(self, smooth: bool, processes: Sequence[str]) -> Likelihood:
        """Return the likelihood without a field if `smooth`, with this coloured gauge noise."""
        self.tried.append(Likelihood(self.problem, smooth=smooth, processes=processes, rtol=self.rtol))
        return self.tried[-1]

    def maximised(self, likelihood: Likelihood, x: Array, *, steps: int = SCORING_STEPS) -> StateSpaceFit:
        """Return the fit at the maximum from x."""
        return StateSpaceFit(likelihood, maximise(likelihood, x, steps=steps, close=self.close, progress=self.progress))

    def on_all(self, part: StateSpaceFit) -> StateSpaceFit:
        """Return the fit to all readings from that to a part of them; a small field and further colours may show in all alone."""
        whole = self.likelihood(part.smooth, part.likelihood.processes)
        best = self.maximised(whole, whole.coordinates(_values_for(part, whole)))
        if self.processes is None:
            best = self.with_colour(best)
        if self.smooth is None and best.smooth:
            best = self.beside_small_field(best)
        settled = best.likelihood is whole and best.maximum.away < self.close
        return best if settled else self.with_or_without(best)

    def from_start(self, start: Mapping[str, float], *, thorough: bool, beside: bool, least: float) -> StateSpaceFit:
        """Return the fit from values by name; see `fit_state_space`."""
        smooth, processes, close, progress = self.smooth, self.processes, self.close, self.progress
        fresh = "field_amplitude" not in start
        wide = self.likelihood(False, processes or ())
        # a field that stands for the gauge's colour leads the other parameters astray
        if fresh and processes is None and (seen := noise_of_most(wide)):
            wide, start = self.likelihood(False, ("relaxation",)), {**start, **seen}
        steps = SCORING_STEPS // 2 if fresh else 12
        found = maximise_from_starts(wide, wide_starts(wide, start, progress), steps, progress)
        if found is None or (fresh and found.status is Status.INTEGRATION):
            found = maximise_from_starts(
                wide, multi_start(wide, wide.coordinates(start), progress)[: len(WIDE_FIELDS)], steps, progress
            )
        assert found is not None
        if fresh and found.away >= 1.0 and found.status is not Status.INTEGRATION:
            found = maximise(wide, found.point.x, steps=SCORING_STEPS // 2, close=1.0, progress=progress)
        if fresh and found.status is not Status.INTEGRATION:
            found = scan_narrow(wide, found.point, progress) or found
        best = StateSpaceFit(wide, found)
        if found.status is Status.INTEGRATION:
            return best
        if found.expected < least:
            found = maximise(wide, found.point.x, close=close, progress=progress) if np.isinf(found.away) else found
            best = StateSpaceFit(wide, found)
            if found.expected < least and processes is not None:
                return best
        # under a field the filter stays with whatever is slow: what is correlated then is the gauge's noise
        best = first = self.with_colour(best, least) if processes is None else best
        if best.maximum.expected < least:
            return best
        best = self.with_or_without(best)
        if wide.processes and processes is None:
            best = with_less_colour(best, close, progress)
        if thorough and processes is None:
            moved = best.smooth or best.log_likelihood > first.log_likelihood + SIGNIFICANT_GAIN
            wider = self.with_colour(best) if moved else best
            grown = len(wider.likelihood.processes) > len(best.likelihood.processes)
            best = self.with_or_without(wider) if grown else wider
            known = best.likelihood.processes
            wanted = not grown and smooth is None and not best.smooth
            if wanted and (not known or (_short_field(best) and len(known) < GAUGE_PROCESSES)):
                instead = self.likelihood(True, (*known, "relaxation"))
                other = _coloured(best, instead, progress)  # colour in place of the field?
                if fresh and _short_field(best):  # which may have led the other parameters astray
                    k = len(instead.problem.names)
                    x = np.concatenate([instead.coordinates(start)[:k], other.maximum.point.x[k:]])
                    anew = maximise(instead, x, steps=SCORING_STEPS // 2, close=1.0, progress=progress)
                    other = max(other, StateSpaceFit(instead, anew), key=lambda f: f.log_likelihood)
                if other.criterion > best.criterion - EARLY_STOP_DEFICIT:
                    other = self.maximised(instead, other.maximum.point.x)
                if other.criterion > best.criterion:  # beside the colour there may be another, smaller field
                    best = self.beside_small_field(other)
                    best = best if best.smooth else self.with_or_without(best)
        if fresh:
            best = likeliest_along_ridges(best, close, progress) if beside else best
        if fresh and smooth is None and best.smooth:
            best = _with_faint_fields(best, self.likelihood(False, best.likelihood.processes))
        return best

    def with_colour(self, best: StateSpaceFit, least: float = -np.inf) -> StateSpaceFit:
        """Return the fit with as many processes of coloured gauge noise as Schwarz's criterion wants; if `cautious`, see there.

        One whose correlation falls off exponentially is tried first, an oscillation where that leaves most stretches correlated:
        what the physics lack leaves a few. No more are tried where as many as there may be, each with the gain of the last, would
        leave the log likelihood below `least`.
        """
        while len(known := best.likelihood.processes) < GAUGE_PROCESSES and correlated(best.maximum.point) > MAX_DEVIATION:
            if self.cautious and known and not steadily_coloured(best, self.cautious):
                break
            found = best
            for kind in PROCESSES:
                wider = _coloured(best, self.likelihood(best.smooth, (*known, kind)), self.progress)
                found = max(found, wider, key=lambda f: f.criterion)
                if not steadily_coloured(wider, self.cautious):
                    break
            if found is best:
                break
            last, best = found.maximum.expected - best.maximum.expected, found
            if found.maximum.expected + max(last, 0.0) * (GAUGE_PROCESSES - len(found.likelihood.processes)) < least:
                break
        return best

    def with_or_without(self, begun: StateSpaceFit) -> StateSpaceFit:
        """Return the fit from where one begun stands, with a field or without, as `smooth` says or the likelihood."""
        field_likelihood, smooth, close, progress = begun.likelihood, self.smooth, self.close, self.progress
        if field_likelihood.smooth:
            return self.maximised(field_likelihood, begun.maximum.point.x)
        plain = self.likelihood(True, field_likelihood.processes)
        at, before, found = field_likelihood.names.index("field_amplitude"), field_likelihood.evaluations, begun.maximum
        faint = _amplitude(field_likelihood, FAINT_FIELD)

        def without_field(steps: int) -> StateSpaceFit:
            progress("without a field")
            return self.maximised(plain, plain.coordinates(found.point.values), steps=steps)

        tried: StateSpaceFit | None = None
        if not np.isfinite(found.away):
            found = maximise(field_likelihood, found.point.x, close=close, progress=progress)
        elsewhere = False  # a field finer than the samples, or one that is slow, may be a maximum of its own
        while field_likelihood.evaluations - before < SCORING_STEPS:
            last = found.point.x
            found = maximise(field_likelihood, last, steps=3, close=close, widths=(), progress=progress)
            if found.away < close or np.array_equal(found.point.x, last):
                other = None if elsewhere else _small_field(field_likelihood, found.point)
                if other is None:
                    break
                elsewhere, found = True, replace(found, point=other)
                continue
            if found.point.x[at] < last[at] - FIELD_SHRINKS:  # a field that vanishes takes many steps: how far is asked at once
                found = replace(found, point=_shrunk(field_likelihood, found.point, at))
            if last[at] > found.point.x[at] and found.point.x[at] < faint and tried is None and smooth is None:
                tried = without_field(TRIAL_STEPS)
                if tried.log_likelihood > found.point.log_likelihood and tried.maximum.away < close:
                    small = _small_field(field_likelihood, tried.maximum.point)
                    if small is None:
                        return tried
                    found = replace(found, point=small)
        if found.away >= close:  # a longer run knows the curvature of its last step, by which scoring alone goes to and fro
            found = maximise(field_likelihood, found.point.x, close=close, widths=(), progress=progress)
        best = StateSpaceFit(field_likelihood, found)
        if smooth is False:
            return best
        if tried is None:
            there = plain.at(plain.coordinates(found.point.values), slopes=False).log_likelihood
            if smooth or there > found.point.log_likelihood - PRUNING_DEFICIT:
                tried = without_field(SCORING_STEPS)
            elif found.point.x[at] < faint:  # an oscillation is integrated more closely: its narrow maximum is next to this
                tried = without_field(TRIAL_STEPS)
        if tried is None or not (smooth or tried.log_likelihood > best.log_likelihood - SIGNIFICANT_GAIN):
            return best
        if tried.maximum.away < close:
            return tried
        return self.maximised(plain, tried.maximum.point.x)

    def beside_small_field(self, fitted: StateSpaceFit) -> StateSpaceFit:
        """Return where a small field beside a fit without one leads, yet to be maximised; the fit where it gains too little."""
        field_likelihood = self.likelihood(False, fitted.likelihood.processes)
        small = _small_field(field_likelihood, fitted.maximum.point)
        return fitted if small is None else StateSpaceFit(field_likelihood, replace(fitted.maximum, point=small))


def maximise_from_starts(
    field_likelihood: Likelihood, starts: Iterable[Array], steps: int, progress: Callable[[str], None]
) -> Maximum | None:
    """Return the maximum from the first start that leads near one, or the likeliest that was reached from all."""
    return likeliest_end(
        field_likelihood, (maximise(field_likelihood, x, steps=steps, close=1.0, progress=progress) for x in starts)
    )


def likeliest_end(field_likelihood: Likelihood, ends: Iterable[Maximum]) -> Maximum | None:
    """Return the first of several ends that is near a maximum under a faint field, or the likeliest of them.

    Under a field that does not become faint the filter follows the recordings whatever the parameters are: these may have drifted
    to where no step leads back, and another start is tried. One more is, too, where a parameter is at its bound.
    """
    found: Maximum | None = None
    bounded = False
    at = field_likelihood.names.index("field_amplitude")
    faint = _amplitude(field_likelihood, FAINT_FIELD)
    for other in ends:
        if found is None or other.point.log_likelihood > found.point.log_likelihood:
            found = other
        y = other.point.x
        inside = not field_likelihood.at_bounds(y)
        if other.away < NOT_CONVERGED and y[at] < faint and (inside or bounded):
            break
        bounded = bounded or not inside
    return found


def _with_faint_fields(fitted: StateSpaceFit, field_likelihood: Likelihood) -> StateSpaceFit:
    """Return a fit without a field, with what fields that are too faint to be told add to its covariance.

    Averaged over amplitudes, the prior even in their logarithm from LEAST_FIELD on, and over lengths, each with the posterior
    of the other parameters by Laplace's method, one step of scoring from the fit (Rue, Martino and Chopin, J. R. Stat. Soc. B
    71, 2009).
    """
    plain, maximum = fitted.likelihood, fitted.maximum
    inner = np.nonzero(np.diag(maximum.covariance) > 0)[0]
    at = [field_likelihood.names.index(plain.names[i]) for i in inner]
    start, logs = field_likelihood.coordinates(fitted.values), np.log(np.array(FAINT_FIELDS) * FAINT_FIELD / LEAST_FIELD)
    # below the first it is as none
    prior = np.array([logs[0], *np.repeat(np.gradient(logs), len(FAINT_FIELD_LENGTHS)) / len(FAINT_FIELD_LENGTHS)])
    evidence, moves, covariances = [_laplace(maximum.point, inner)[0]], [np.zeros(inner.size)], []
    covariances.append(maximum.covariance[np.ix_(inner, inner)])
    for share, short in product(FAINT_FIELDS, FAINT_FIELD_LENGTHS):
        x = _under_field(field_likelihood, start, share * FAINT_FIELD, short)
        likely = field_likelihood.at(x, slopes=False).log_likelihood > fitted.log_likelihood - FAINT_FIELD_DEFICIT
        point = field_likelihood.at(x, slopes=likely)
        if not likely:
            point = replace(point, log_likelihood=-np.inf)
        height, move, covariance = _laplace(point, np.array(at))
        evidence.append(height)
        moves.append(move)
        covariances.append(covariance)
    weight = np.log(prior) + np.array(evidence)
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    whole = sum(w * (C + np.outer(d, d)) for w, C, d in zip(weight, covariances, moves, strict=True))
    spread = np.zeros_like(maximum.covariance) + maximum.spread
    spread[np.ix_(inner, inner)] += whole - covariances[0]
    return replace(fitted, maximum=replace(maximum, spread=spread))


def _laplace(point: Point, at: Array) -> tuple[float, Array, Array]:
    """Return the log marginal likelihood over coordinates `at` (m,), less a constant, the step to its maximum, the covariance."""
    if not np.isfinite(point.log_likelihood):
        return -np.inf, np.zeros(at.size), np.zeros((at.size, at.size))
    covariance = inverse(point.information[np.ix_(at, at)])
    move = covariance @ point.score[at]
    d = np.sqrt(np.diag(covariance))
    height = point.log_likelihood + 0.5 * float(point.score[at] @ move)
    return height + 0.5 * float(np.linalg.slogdet(covariance / np.outer(d, d))[1]) + float(np.sum(np.log(d))), move, covariance


def _short_field(fitted: StateSpaceFit) -> bool:
    """Return whether the field is as short as a field may be: along slip then as the gauge's noise is in time."""
    at = fitted.likelihood.names.index("field_length")
    return bool(fitted.maximum.point.x[at] < fitted.likelihood.lower[at] + 0.1)


def likeliest_along_ridges(found: StateSpaceFit, close: float, progress: Callable[[str], None]) -> StateSpaceFit:
    """Return the fit at the likeliest of the maxima next to its own along its ridges, with what these add to the covariance.

    A ridge is how the others follow one parameter, by the covariance. Where the likelihood falls off along it by less than its
    curvature wants, it has maximum beside maximum: readings of an oscillation of the contact that is faster than the sampling
    are alike for many compliances. Where none of these stands out, the parameter is as uncertain as all of them are together.
    """
    likelihood, maximum = found.likelihood, found.maximum
    for _ in range(MAX_RIDGE_MOVES):
        spread, best = np.zeros_like(maximum.covariance), maximum.point
        for j in _ridges(likelihood, maximum):
            beside, more = _scan_ridge(likelihood, maximum, j)
            spread += more
            best = max(best, beside, key=lambda p: p.log_likelihood)
        if best.log_likelihood < maximum.point.log_likelihood + SIGNIFICANT_GAIN:
            break
        other = maximise(likelihood, best.x, close=close, widths=(), progress=progress)
        progress(f"log likelihood {other.point.log_likelihood:.1f} beside {maximum.point.log_likelihood:.1f}")
        maximum = other
    return replace(found, maximum=replace(maximum, spread=spread))


def _ridges(likelihood: Likelihood, maximum: Maximum) -> list[int]:
    """Return the parameters along whose ridges the likelihood falls off by less than its curvature wants."""
    found, point, variances = [], maximum.point, np.diag(maximum.covariance)
    for j in np.nonzero(variances[: len(likelihood.problem.names)] > 0)[0].tolist():
        d = PROBE * np.sqrt(variances[j])
        if d < RIDGE_REACH * _size(likelihood, point, j):
            lost = [point.log_likelihood - point_on_ridge(likelihood, maximum, j, side * d).log_likelihood for side in (1, -1)]
            if min(lost) < LOST_CURVATURE * PROBE**2 / 2:
                found.append(j)
    return found


def _size(likelihood: Likelihood, point: Point, j: int) -> float:
    return 1.0 if likelihood.logarithmic[j] else abs(float(point.x[j]))


def point_on_ridge(likelihood: Likelihood, maximum: Maximum, j: int, d: float) -> Point:
    """Return the point at which parameter j is moved by d, and the others as the covariance has it."""
    column = maximum.covariance[:, j] / maximum.covariance[j, j]
    x = np.clip(maximum.point.x + d * column, likelihood.lower, likelihood.upper)
    return likelihood.at(x, slopes=False, like=maximum.point)


def scan_narrow(likelihood: Likelihood, begun: Point, progress: Callable[[str], None]) -> Maximum | None:
    """Return the likeliest maximum that scans of single parameters find, from a point near one; None where it is no likelier.

    Readings of an oscillation that has gone round many times since it began have a narrow maximum at the parameter that makes
    its frequency, and nothing leads there. Under a wide field it is where it is whatever the other parameters are, so that they
    stay where they are while the readings of one run are asked.
    """
    x = begun.x.copy()
    amplitude = likelihood.names.index("field_amplitude")
    x[amplitude] = max(x[amplitude], _under_field(likelihood, x, *WIDE_FIELDS[0])[amplitude])
    point, highest = likelihood.at(x), begun.log_likelihood + SIGNIFICANT_GAIN
    if not np.isfinite(point.log_likelihood):
        return None
    slopes, found = _slopes(likelihood, point), None
    for j in np.nonzero(np.diag(point.information)[: len(likelihood.problem.names)] > 0)[0].tolist():
        narrow = _narrow_maximum(likelihood, point, slopes, j)
        if narrow is None:
            continue
        run, half = narrow
        half_width, name = SCAN_REACH * _size(likelihood, point, j), likelihood.names[j]
        low, high = max(point.x[j] - half_width, likelihood.lower[j]), min(point.x[j] + half_width, likelihood.upper[j])
        if (high - low) / half > SCANNED:
            continue
        points = np.tile(point.x, (int((high - low) / half) + 2, 1))
        points[:, j] = np.linspace(low, high, len(points))
        here = likelihood.filtered(run, point.values)
        most = MAX_WORK_RATIO * here.found.steps
        told = np.array([likelihood.filtered(run, likelihood.values(y), most=most).log_likelihood for y in points])
        summit = told >= np.maximum(np.append(told[1:], -np.inf), np.append(-np.inf, told[:-1]))
        likely = np.nonzero(summit & (told > max(here.log_likelihood + SIGNIFICANT_GAIN, told.max() - PEAK / 2)))[0]
        likely = likely[np.argsort(-told[likely])][:PEAKS]
        tops = [maximise(likelihood, points[k], fixed=[name], steps=PEAK_STEPS, widths=()).point for k in likely]
        if tops:
            top = max(tops, key=lambda p: p.log_likelihood)
            other = maximise(likelihood, top.x, steps=SCORING_STEPS // 2, close=1.0, widths=(), progress=progress)
            height = other.point.log_likelihood
            progress(f"log likelihood {height:.1f} by a scan of {name}, {begun.log_likelihood:.1f} before")
            if height > highest:
                found, point, slopes, highest = other, top, _slopes(likelihood, top), height
    return found


def _narrow_maximum(
    likelihood: Likelihood, point: Point, slopes: Sequence[tuple[list[int], Array, Array]], j: int
) -> tuple[Run, float] | None:
    """Return the part of a run that shows a maximum of parameter j which no derivative leads to, and half its width.

    `slopes` are those of the point (`_slopes`); the width is that at half of the height. Innovations move by less than
    derivatives want when the parameter goes far: two oscillations that are out of step differ by no more than themselves. Half
    of how far they move, squared, is the height of the maximum; the part of the run is as long as shows four times the least one.
    """
    displacement = FAR_PROBE / np.sqrt(point.information[j, j])
    probes: list[Point] = []
    for side in (1, -1):
        y = point.x.copy()
        y[j] += side * displacement
        if likelihood.lower[j] <= y[j] <= likelihood.upper[j]:
            probes.append(likelihood.at(y, slopes=False, like=point))
    if not probes or not all(np.isfinite(probe.log_likelihood) for probe in probes):
        return None
    most, found = 2 * PEAK, None
    for at, (f, (places, a, _)) in enumerate(zip(point.runs, slopes, strict=False)):
        moves = [(probe.runs[at].every.nu - f.every.nu)[f.used] ** 2 / f.every.S[f.used] for probe in probes]
        moved = max(moves, key=lambda own: float(np.sum(own)))
        told = a[:, places.index(j)] ** 2 if j in places else np.zeros_like(moved)
        if most < np.sum(moved) < LOST_CURVATURE * np.sum(told) * displacement**2:
            most = float(np.sum(moved))
            few = min(int(np.searchsorted(np.cumsum(moved), 8 * PEAK)) + 1, moved.size)
            readings = max(int(f.used[few - 1]) // len(f.run.signals) + 1, 2)  # one alone has no interval
            found = f.run.part(slice(None, readings)), float(np.sqrt(np.sum(moved[:few]) / (2 * np.sum(told[:few]))))
    return found


def _scan_ridge(likelihood: Likelihood, maximum: Maximum, j: int) -> tuple[Point, Array]:
    """Return the likeliest point on the ridge of parameter j, and what the points there add to the covariance (k, k)."""
    column, s = maximum.covariance[:, j] / maximum.covariance[j, j], float(np.sqrt(maximum.covariance[j, j]))
    points, places = [maximum.point], [0.0]
    count = int(np.clip(RIDGE_STRIDE * _size(likelihood, maximum.point, j) / (2 * s), *NEIGHBOUR_STEPS))
    for side in (1, -1):
        for k in range(1, count + 1):
            points.append(point_on_ridge(likelihood, maximum, j, side * 2 * k * s))
            places.append(side * 2 * k * s)
    found, at = np.array([p.log_likelihood for p in points]), np.array(places)
    share = np.exp(found - found.max())
    share /= share.sum()
    beyond = max(float(share @ (at - share @ at) ** 2) - s**2, 0.0)
    return points[int(np.argmax(found))], beyond * np.outer(column, column)


def with_less_colour(found: StateSpaceFit, close: float, progress: Callable[[str], None] = lambda text: None) -> StateSpaceFit:
    """Return a fit without the fainter processes of its coloured gauge noise, as far as Schwarz's criterion prefers that.

    What a model lacks looks like colour, and the colour is not needed once the model has it.
    """
    while known := found.likelihood.processes:
        own, rows = found.likelihood, gauge_rows(known)
        levels = [max(found.values[name[row[1]]] for name in map(own.gauge_names, own.kinds)) for row in rows]
        faintest = int(np.argmin(levels))
        kept = [*range(faintest), *range(faintest + 1, len(known))]
        fewer = own.beside(own.problem, [known[j] for j in kept])
        values = dict(found.values)
        for old, new in zip((rows[j] for j in kept), gauge_rows(fewer.processes), strict=True):
            for kind in own.kinds:
                before, after = own.gauge_names(kind), fewer.gauge_names(kind)
                values |= {after[b]: found.values[before[a]] for a, b in zip(old, new, strict=True)}
        x = fewer.coordinates(values)
        if fewer.at(x, slopes=False).log_likelihood < found.log_likelihood - EARLY_STOP_DEFICIT:
            break
        progress(f"coloured gauge noise: {', '.join(fewer.processes) or 'none'}")
        fewer_found = StateSpaceFit(fewer, maximise(fewer, x, close=close, widths=(), progress=progress))
        if found.criterion > fewer_found.criterion:
            break
        found = fewer_found
    return found


def correlated(point: Point) -> float:
    """Return how far the innovations are correlated with those before, in standard deviations, at most.

    With exponential means of them, which is the score test of gauge noise with one more correlation time, over times from one
    sample to a tenth of a run; and at the first LAGS lags together, where an oscillation shows that such means miss.
    """
    worst = lag_correlations([white for f in point.runs for white in f.parts])
    longest = max((white.size for f in point.runs for white in f.parts), default=0)
    for span in np.geomspace(1.0, max(longest / 10, 2.0), 6):
        product, square = 0.0, 0.0
        for white in (np.clip(w, -5.0, 5.0) for f in point.runs for w in f.parts):
            before = carried(float(np.exp(-1.0 / span)), np.concatenate([[0.0], white[:-1]]))
            product, square = product + float(white @ before), square + float(before @ before)
        worst = max(worst, abs(product) / np.sqrt(square) if square else 0.0)
    return worst


def steadily_coloured(found: StateSpaceFit, cautious: bool = False) -> bool:
    """Return whether the innovations are correlated all along, as a gauge's noise is, and not in a few stretches.

    Most stretches are, or most have the same line in their spectra. If `cautious`, the recordings must show that line without a
    model, where they are calm: what a model lacks may leave one at the frequency of a modulation, or of stick-slip.
    """
    point = found.maximum.point
    if correlated(point) < MAX_DEVIATION:
        return False
    pieces = [piece for f in point.runs for white in f.parts for piece in segments(white)]
    judged = [(_ljung_box(piece) - LAGS) / np.sqrt(2 * LAGS) > PORTMANTEAU_LIMIT for piece in pieces]
    if 2 * sum(judged) > len(judged):
        return True
    lines = [(kind, at) for kind, (height, at) in _lines(found).items() if height > MAX_DEVIATION]
    return any(not cautious or _visible_without_model(found, kind, at) for kind, at in lines)


def relaxations_without_model(likelihood: Likelihood) -> dict[Kind, list[tuple[float, ...]]]:
    """Return the relaxation in the gauge noise of each run of each kind that shows without a model, as `srf check` has it.

    Correlation time (s), standard deviation, and that of the white noise; empty for a run that shows none.
    """
    from srfcli.data.experiment import check_run

    found: dict[Kind, list[tuple[float, ...]]] = {kind: [] for kind in likelihood.kinds}
    for run in likelihood.problem.runs:
        noises, spacings = check_run(run).noises, np.array(run.sampling.spacings)
        for kind in dict.fromkeys(map(likelihood.nearest_kind, likelihood.kinds_of(run))):
            noise = noises[int(np.argmin(np.abs(np.log(spacings / kind[1]))))]
            seen = [c for c in noise.colours if len(c) == 2 and run.signals[0].observable == kind[0]]
            found[kind].append((*seen[0], max(noise.white, 1e-3 * seen[0][1])) if seen else ())
    return found


def noise_of_most(likelihood: Likelihood) -> dict[str, float]:
    """Return the gauge noise that most runs of each kind show without a model, by name, if it has a relaxation; else nothing."""
    found = {}
    for kind, runs in relaxations_without_model(likelihood).items():
        seen = [run for run in runs if run]
        if 2 * len(seen) <= len(runs):
            return {}
        found[kind] = np.exp(np.median(np.log(np.array(seen)), axis=0)).tolist()
    coloured = likelihood.beside(likelihood.problem, ("relaxation",))
    order = (*gauge_rows(coloured.processes)[0], "gauge_white")
    return {coloured.gauge_names(kind)[n]: v for kind, own in found.items() for n, v in zip(order, own, strict=True)}


def _lines(found: StateSpaceFit) -> dict[Kind, tuple[float, float]]:
    """Return, for each kind of gauge noise, how high the spectrum of the innovations is at most, and at which frequency.

    The height is that of the median of periodograms of stretches above that of white noise, in standard deviations; the frequency
    is in Hz. A line of the gauge is at one frequency in most stretches; a drive's or a track's changes with the velocity.
    """
    pieces: dict[Kind, list[Array]] = {}
    for white, _, kind in found.likelihood.innovations_by_kind(found.maximum.point):
        count = white.size // PERIODOGRAM_SAMPLES
        pieces.setdefault(kind, []).append(
            np.clip(white[: count * PERIODOGRAM_SAMPLES], -5.0, 5.0).reshape(count, PERIODOGRAM_SAMPLES)
        )
    lines = {}
    for kind, parts in pieces.items():
        power = np.abs(np.fft.rfft(np.concatenate(parts), axis=1)[:, 1:]) ** 2
        if power.size:
            middle = np.median(power, axis=0)
            height = (float(np.max(middle) / np.mean(power)) - np.log(2)) * np.sqrt(len(power))
            lines[kind] = float(height), (1 + int(np.argmax(middle))) / (PERIODOGRAM_SAMPLES * kind[1])
    return lines


def _visible_without_model(found: StateSpaceFit, kind: Kind, frequency: float) -> bool:
    """Return whether most runs with this kind of gauge noise have an oscillation about a frequency that `srf check` finds."""
    from srfcli.data.experiment import check_run

    within = max(SAME_RATE * frequency, 1 / (PERIODOGRAM_SAMPLES * kind[1]))
    own = [f.run for f in found.maximum.point.runs if kind in found.likelihood.kinds_of(f.run)]
    seen = [[c for noise in check_run(run).noises for c in noise.colours if len(c) == 3] for run in own]
    return 2 * sum(any(abs(c[0] - frequency) < within for c in colours) for colours in seen) > len(seen)


def lag_correlations(parts: Sequence[Array]) -> float:
    """Return Ljung and Box's Q of all parts together as a normal deviate (Wilson and Hilferty 1931); of few readings aside."""
    long = [white for white in parts if white.size > 5 * LAGS]
    if not long:
        return 0.0
    spread = 2 / (9 * LAGS * len(long))
    return float((np.cbrt(sum(map(_ljung_box, long)) / (LAGS * len(long))) - (1 - spread)) / np.sqrt(spread))


def _ljung_box(white: Array) -> float:
    """Return Q: how far the correlations at the first LAGS lags are from those of white noise, LAGS on average under that."""
    n, c = white.size, np.clip(white, -5.0, 5.0)
    square = float(c @ c)
    return sum(n * (n + 2) / (n - k) * (float(c[k:] @ c[:-k]) / square) ** 2 for k in range(1, LAGS + 1)) if square else 0.0


def segments(white: Array) -> list[Array]:
    """Return innovations (m,) in stretches that are long enough to be judged each, at most 20."""
    return np.array_split(white, max(min(20, white.size // 50), 1))


def _small_field(field_likelihood: Likelihood, plain: Point) -> Point | None:
    """Return where a few steps lead from the likeliest of a few small fields beside a fit, None where that gains too little.

    The likeliest amplitude is taken at the middle length, and then the likeliest length.
    """
    x, middle = field_likelihood.coordinates(plain.values), len(FAINT_FIELD_LENGTHS) // 2

    def tried(share: float, short: float) -> tuple[float, float, float]:
        return (
            field_likelihood.at(_under_field(field_likelihood, x, share * FAINT_FIELD, short), slopes=False).log_likelihood,
            share,
            short,
        )

    likeliest = max(tried(share, FAINT_FIELD_LENGTHS[middle]) for share in FAINT_FIELDS)
    height, share, short = max(
        likeliest, *(tried(likeliest[1], s) for s in (*FAINT_FIELD_LENGTHS[:middle], *FAINT_FIELD_LENGTHS[middle + 1 :]))
    )
    if not np.isfinite(height):
        return None
    x, least = _under_field(field_likelihood, x, share * FAINT_FIELD, short), plain.log_likelihood + SIGNIFICANT_GAIN
    for _ in range(FIELD_STEPS // 2):
        found = maximise(field_likelihood, x, steps=2, widths=())
        if found.expected < least or found.away < CONVERGED or np.array_equal(found.point.x, x):
            break
        x = found.point.x
    return found.point if found.point.log_likelihood > least else None


def _shrunk(field_likelihood: Likelihood, point: Point, at: int) -> Point:
    """Return the point with the likeliest of ever smaller amplitudes of the field, the other parameters as they are."""
    best, x = (point.log_likelihood, point.x), point.x.copy()
    while x[at] > field_likelihood.lower[at]:
        x[at] = max(x[at] - FIELD_SHRINKS, field_likelihood.lower[at])
        found = field_likelihood.at(x, slopes=False).log_likelihood
        if found < best[0]:
            break
        best = found, x.copy()
    return point if best[1] is point.x else field_likelihood.at(best[1])


def _coloured(fitted: StateSpaceFit, wider: Likelihood, progress: Callable[[str], None]) -> StateSpaceFit:
    """Return the fit with one more process of gauge noise, from the likeliest of a few starts for each kind of noise."""
    kind, number = wider.processes[-1], len(wider.processes)
    row = gauge_rows(wider.processes)[-1]
    x = wider.coordinates(fitted.values)
    owns = [{n: wider.names.index(name) for n, name in wider.gauge_names(of).items()} for of in wider.kinds]
    if kind == "relaxation":
        low, high = (float(side[owns[0][row[0]]]) for side in (wider.lower, wider.upper))
        starts: list[list[tuple[float, ...]]] = [[(low + share * (high - low),) for share in CORRELATION_TIMES]] * len(owns)
    else:
        lines = _lines(fitted)  # where innovations are strongest, and two other frequencies
        peaks = [[lines[of][1] if of in lines else 0.05 / of[1], 0.03 / of[1], 0.15 / of[1]] for of in wider.kinds]
        starts = [[*product(np.log(own), np.log(QUALITIES))] for own in peaks]
    best = -np.inf
    for base in _slow_fields(wider, x):
        likeliest = [(-np.inf, base)] * len(owns)
        for place, part in product(range(len(starts[0])), COLOUR_SHARES):
            trial = base.copy()
            for own, start in zip(owns, starts, strict=True):
                levels = [own["gauge_white"], *(own[f"gauge_colour{j}"] for j in range(1, number))]
                trial[own[row[1]]] = 0.5 * np.log(part * np.sum(np.exp(2 * base[levels])))
                trial[levels] += 0.5 * np.log(1 - part)
                trial[[own[n] for n in (row[0], *row[2:])]] = start[place]
            trial = np.clip(trial, wider.lower, wider.upper)
            found = wider.by_kind(wider.at(trial, slopes=False))
            likeliest = [max(known, (own, trial), key=lambda c: c[0]) for known, own in zip(likeliest, found, strict=True)]
        total = sum(likelihood for likelihood, _ in likeliest)
        if total > best:
            best, x = total, base
            for own, (_, trial) in zip(owns, likeliest, strict=True):
                x[list(own.values())] = trial[list(own.values())]
    progress(f"coloured gauge noise: {', '.join(wider.processes)}")
    steps = 20 if best > fitted.log_likelihood - PRUNING_DEFICIT else 0
    maximum = maximise(wider, x, steps=steps, close=1.0, progress=progress)
    return StateSpaceFit(wider, maximum)


def _slow_fields(wider: Likelihood, x: Array) -> Iterator[Array]:
    """Yield x, and x with a field that is too slow to have taken up what is the gauge's."""
    yield x.copy()
    if wider.smooth:
        return
    for share in (0.1, 1.0):
        yield _under_field(wider, x, share * FAINT_FIELD, 1.0)


def _under_field(field_likelihood: Likelihood, x: Array, wide: float, short: float) -> Array:
    """Return x under a field of amplitude `wide` over the friction of the recordings, its length `short` times the start's."""
    amplitude, length = (field_likelihood.names.index(n) for n in FIELD)
    found = x.copy()
    found[amplitude], found[length] = _amplitude(field_likelihood, wide), field_likelihood.start[length] + np.log(short)
    return found


def _amplitude(field_likelihood: Likelihood, share: float) -> float:
    """Return the coordinate of a field's amplitude that is this share of the friction of the recordings."""
    return float(field_likelihood.lower[field_likelihood.names.index("field_amplitude")] + np.log(share / LEAST_FIELD))


def wide_starts(field_likelihood: Likelihood, start: Mapping[str, float], progress: Callable[[str], None]) -> Iterator[Array]:
    """Yield x at `start` under one wide field after the other; where the first does not follow, the likeliest of FAST_FIELDS."""
    x = field_likelihood.coordinates(start)
    if "field_amplitude" in start:
        yield x
        return
    amplitude, length = (field_likelihood.names.index(n) for n in FIELD)

    @cache
    def begun(wide: float, long: float) -> Point:
        point = field_likelihood.at(_under_field(field_likelihood, x, wide, long), slopes=False)
        field = f"field of {np.exp(point.x[amplitude]):.2g} over {np.exp(point.x[length]):.2g} um"
        progress(f"{field}: log likelihood {point.log_likelihood:.1f}")
        return point

    first, fields = begun(*WIDE_FIELDS[0]), list(WIDE_FIELDS)
    if not np.isfinite(first.log_likelihood) or first.rms > FOLLOWED:
        fields.insert(0, max(FAST_FIELDS, key=lambda fast: begun(*fast).log_likelihood))
    for point in (begun(*wide) for wide in dict.fromkeys(fields)):
        if np.isfinite(point.log_likelihood):
            yield point.x


def multi_start(field_likelihood: Likelihood, x: Array, progress: Callable[[str], None]) -> list[Array]:
    """Return SOBOL_STARTS starts over the bounds, mu0 that of the recordings, under wide fields in turn, the likeliest first.

    A model that slips without end at the file's start values, as one without inertia may, is followed from others.
    """
    from scipy.stats import qmc

    k = len(field_likelihood.problem.names)
    levels = [i for i, n in enumerate(field_likelihood.problem.names) if n.partition("[")[0] == "mu0"]
    seen = float(np.median([typical_friction(run) for run in field_likelihood.problem.runs]))
    trials: list[tuple[float, Array]] = []
    for number, share in enumerate(qmc.Sobol(k, seed=0).random(SOBOL_STARTS)):
        trial = x.copy()
        trial[:k] = field_likelihood.lower[:k] + share * (field_likelihood.upper - field_likelihood.lower)[:k]
        trial[levels] = np.where(field_likelihood.logarithmic[levels], np.log(seen), seen)
        trial = np.clip(trial, field_likelihood.lower, field_likelihood.upper)
        trial = _under_field(field_likelihood, trial, *WIDE_FIELDS[number % len(WIDE_FIELDS)])
        found = field_likelihood.at(trial, slopes=False).log_likelihood
        progress(f"from another start: log likelihood {found:.1f}")
        if np.isfinite(found):
            trials.append((found, trial))
    return [trial for _, trial in sorted(trials, key=lambda t: -t[0])] or [x]


def as_fit(found: StateSpaceFit) -> Fit:
    """Return a state-space fit as other fits are: predictions are those of each reading from the ones before it.

    Residuals are innovations over their own standard deviation, in units of the gauge's white noise. Runs held out are filtered
    with what was found.
    """
    likelihood, maximum = found.likelihood, found.maximum
    problem, values, k = likelihood.problem, found.values, len(likelihood.problem.names)
    held = [likelihood.held_out(run, values) for run in problem.experiment.runs if run.holdout]
    tables = [likelihood.held_out_table(t, values) for t in problem.experiment.thresholds if t.holdout and problem.stability]
    runs, others = [], []
    for f in (*maximum.point.runs, *held):
        first, *beside = [_run_fit(likelihood, f, number, values) for number in range(len(f.run.signals))]
        runs.append(first)
        others += beside
    return Fit(
        problem.names, {**problem.fixed_values, **{n: values[n] for n in problem.names}}, found.covariance[:k, :k], problem.lower,
        problem.upper,
        tuple(runs), found.log_likelihood, maximum.status, found.evaluations, others=tuple(others),
        tables=(*maximum.point.tables, *tables),
    )  # fmt: skip


def _run_fit(likelihood: Likelihood, f: Filtered, number: int, values: Mapping[str, float]) -> RunFit:
    """Return how one signal of a run is fitted."""
    run, signal, found = f.run, f.run.signals[number], f.of(number)
    gauges, rate = likelihood.gauges(run, number), run.sampling.at
    levels = np.array([np.hypot(values[own["gauge_white"]], signal.quantum / np.sqrt(12)) for own in gauges])
    level = float(np.sqrt(np.mean(levels[rate] ** 2)))
    every = (tuple(values[own[n]] for n in row) for own in gauges for row in gauge_rows(likelihood.processes))
    colours = tuple(colour for colour in every if colour[1] > 0.1 * level)
    with np.errstate(invalid="ignore"):
        residual = found.nu / np.sqrt(found.S) * levels[rate]
    parts, noise = stretches(run.t, signal.used & np.isfinite(residual)), Noise(level, (), level)
    y = signal.observed - found.nu
    return RunFit(run.name, run.holdout, y, residual, parts, noise, level, colours, signal.observable)
