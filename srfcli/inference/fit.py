"""What is fitted to what, and what a fit is: free parameters with their bounds, runs and critical loads; estimates and errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError, Status, did_you_mean
from srfcli.data.groups import GAUGE_NOISE, labels
from srfcli.data.values import OBSERVABLES, CriticalLoads, Experiment, Run
from srfcli.inference.critical_loads import Matched, chi2_p_value
from srfcli.inference.noise import Noise
from srfcli.inference.prediction import run_parameters, run_specific_names, run_specific_start


def inverse(information: Array) -> Array:
    """Return the inverse, after scaling; a direction that nothing determines gets an enormous variance, not a failure."""
    d = np.sqrt(np.maximum(np.diag(information), 1e-16))  # of scaled parameters: nothing that matters is so flat
    values, vectors = np.linalg.eigh(information / np.outer(d, d))
    inverse = (vectors / np.maximum(values, 1e-14)) @ vectors.T
    return np.asarray(inverse / np.outer(d, d))


NO_SAY = 1e4  # times the width of its bounds that a parameter's error is where nothing determines it


def solve_scaled(A: Array, b: Array) -> Array:
    """Return the solution of symmetric equations, scaled; directions that nothing determines do not move."""
    d = np.sqrt(np.maximum(np.diag(A), 1e-300))
    values, vectors = np.linalg.eigh(A / np.outer(d, d))
    inverse = np.where(values > 1e-12 * values[-1], 1 / np.maximum(values, 1e-300), 0.0)
    return np.asarray((((vectors * inverse) @ (vectors.T @ (b.T / d).T)).T / d).T)


def principal_deviations(covariance: Array) -> Array:
    """Return the principal directions of a covariance, one standard deviation long each, as columns."""
    d = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(d, d))
    return np.asarray((d[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0)))


@dataclass(frozen=True)
class RunFit:
    """How one observable of a run is fitted: expected readings `y` (n,), residual (n,), its noise, the samples that took part.

    `colours` are the gauge's coloured noise, of a state-space fit: correlation time (s) and standard deviation of a relaxation,
    frequency (Hz), standard deviation and quality of an oscillation.
    """

    name: str
    holdout: bool
    y: Array
    residual: Array
    parts: list[tuple[int, int]]
    noise: Noise
    white: float  # standard deviation of white noise, from differences of the residual
    colours: tuple[tuple[float, ...], ...] = ()
    observable: str = ""

    @property
    def rms(self) -> float:
        """Return the root mean square of the residual over the samples that are compared."""
        if not self.parts:  # a run that cannot be followed
            return float("nan")
        values = np.concatenate([self.residual[a:b] for a, b in self.parts])
        return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True)
class Fit:
    """Estimates in um, s, N: `values` by name for the free parameters, `covariance` in their order; `fixed` the others.

    `runs` are how their observables are fitted, `others` how what was observed besides.
    """

    names: tuple[str, ...]
    values: dict[str, float]
    covariance: Array
    lower: Array
    upper: Array
    runs: tuple[RunFit, ...]
    log_likelihood: float
    status: Status
    evaluations: int
    others: tuple[RunFit, ...] = ()
    tables: tuple[Matched, ...] = ()

    @property
    def stderr(self) -> dict[str, float]:
        """Return the standard errors by name: 0 at a bound, infinite where the recordings have no say."""
        errors = np.sqrt(np.diag(self.covariance))
        told = np.where(errors > NO_SAY * (self.upper - self.lower), np.inf, errors)
        return dict(zip(self.names, told.tolist(), strict=True))

    @property
    def correlation(self) -> Array:
        """Return the correlation matrix of the estimates; NaN with one at a bound."""
        sd = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore"):
            return np.asarray(self.covariance / np.outer(sd, sd))

    def rms_over_noise(self, *, holdout: bool = False) -> float:
        """Return the residuals' root mean square over the white noise level, all runs fitted (or held out) together.

        Critical loads count like readings, over their errors.
        """
        chosen = [r for r in self.runs if r.holdout == holdout]
        tables = [t for t in self.tables if t.loads.holdout == holdout]
        sizes = np.array([sum(b - a for a, b in r.parts) for r in chosen] + [t.white.size for t in tables], dtype=float)
        ratios = [(r.rms / r.white) ** 2 if r.white else np.nan for r in chosen] + [float(np.mean(t.white**2)) for t in tables]
        return float(np.sqrt(np.sum(sizes * np.array(ratios)) / np.sum(sizes))) if sizes.size else float("nan")


@dataclass(frozen=True)
class Problem:
    """What is fitted to what: the free parameters with their bounds, and the runs and tables of critical loads that judge them.

    `stability` is the model of critical loads. Without runs it is the `model`, too.
    """

    model: GeneratedModel
    experiment: Experiment
    runs: tuple[Run, ...]
    names: tuple[str, ...]
    start: Array
    lower: Array
    upper: Array
    trend: str | None = None
    fixed_values: Mapping[str, float] = field(default_factory=dict)
    priors: tuple[tuple[tuple[str, ...], float], ...] = ()  # names, and the scatter of their values about an unknown mean
    tables: tuple[CriticalLoads, ...] = ()
    stability: GeneratedModel | None = None

    def unit_of(self, name: str) -> str:
        """Return the unit that a parameter is declared in; K that of the stated stiffness, what belongs to a run 1, um or s."""
        listed = {q.name: q.unit for q in self.experiment.parameters}
        run = next((r for r in self.experiment.runs if name.startswith(f"{r.name}.")), None)
        if run is not None and name not in listed:
            along = {"slip": "um", "time": "s"}.get(self.trend or "", "")
            unit = OBSERVABLES[run.observable]
            return {f"{run.name}.slip": "um", f"{run.name}.trend": f"{unit}/{along}"}.get(name, "1")
        return listed.get(name, listed.get(name.partition("[")[0], "1"))

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Return the names of the values of each parameter that varies, of the runs fitted."""
        found: dict[str, dict[str, None]] = {}
        for names in self.varying.values():
            for n, name in names.items():
                if name in self.names:
                    found.setdefault(n, {})[name] = None
        return {n: tuple(names) for n, names in found.items()}

    def named(self, theta: Array) -> dict[str, float]:
        """Return parameters by name, those that are held among them."""
        return {**self.fixed_values, **dict(zip(self.names, np.asarray(theta).tolist(), strict=True))}

    @cached_property
    def varying(self) -> dict[str, dict[str, str]]:
        """Return what the parameters that vary are called in each run of the experiment."""
        return {run.name: self.varied(run) for run in self.experiment.runs}

    def varied(self, run: Run) -> dict[str, str]:
        """Return what the parameters that vary are called in a run, fitted or not."""
        return {n: f"{n}[{self.group(run, by)}]" for n, by in self.experiment.vary.items() if n != GAUGE_NOISE}

    def group(self, run: Run, by: str) -> str:
        """Return the group of a run for what varies with `by`."""
        known = self._labels[by].get(run.name)
        return known or labels(replace(self.experiment, runs=(*self.experiment.runs, run)), by)[run.name]

    @cached_property
    def _labels(self) -> dict[str, dict[str, str]]:
        return {by: labels(self.experiment, by) for by in self.experiment.vary.values()}

    def noise_group(self, run: Run) -> str:
        """Return the group of runs whose gauge noise a run has; nothing where all share one."""
        by = self.experiment.vary.get(GAUGE_NOISE)
        return self.group(run, by) if by else ""

    def local(self, run: Run, values: Mapping[str, float]) -> dict[str, float]:
        """Return parameters by name with those that vary under their own names, at what they are in this run."""
        return {**values, **{n: values[name] for n, name in self.varied(run).items() if name in values}}


def fit_problem(
    model: GeneratedModel,
    experiment: Experiment,
    *,
    free: Sequence[str] | None = None,
    trend: str | None = None,
    stability: GeneratedModel | None = None,
) -> Problem:
    """Return the problem that an experiment states; `free` replaces its own choice of parameters, `trend` is slip or time.

    Tables of critical loads take part where their model, `stability`, is given. Parameters that vary have a value for each group
    of runs; B of a run up is then called B[up].
    """
    listed = {q.name: q for q in experiment.parameters}
    names = list(free) if free is not None else [q.name for q in experiment.parameters if not q.fixed]
    for name in names:
        if name not in listed:
            raise SrfError(f"'{name}' has no start value in [parameters]", did_you_mean(name, listed))
    runs = tuple(r for r in experiment.runs if not r.holdout)
    tables = tuple(t for t in experiment.thresholds if not t.holdout) if stability is not None else ()
    if not runs and (experiment.runs or not tables):
        what = "run" if experiment.runs else "table of critical loads"
        raise SrfError(f"every {what} is held out", "set holdout = false for those that are to be fitted")
    if not names:
        raise SrfError("no parameter is free", "leave `fixed` out for those that are to be fitted")
    groups = {n: [f"{n}[{group}]" for group in own] for n, own in _varying(experiment, runs, names).items() if n != GAUGE_NOISE}
    rows = [(listed[n].value, listed[n].lower, listed[n].upper) for n in names for _ in groups.get(n, [n])]
    names = [own for n in names for own in groups.get(n, [n])]
    for run in runs:
        own = run_specific_names(model, run, trend)
        p = run_parameters(model, experiment, run, {})
        rows += [run_specific_start(model, run, p, name, trend) for name in own]
        names += own
    start, lower, upper = np.array(rows, dtype=float).T
    for name, low, high in zip(names, lower, upper, strict=True):
        if not (np.isfinite(low) and np.isfinite(high)):
            raise SrfError(f"'{name}' has no bounds", "give lower and upper in [parameters]")
    return Problem(model, experiment, runs, tuple(names), start, lower, upper, trend, tables=tables, stability=stability)


def _varying(experiment: Experiment, runs: Sequence[Run], names: Sequence[str]) -> dict[str, list[str]]:
    """Return the groups of the runs fitted, for each name that varies.

    Raises SrfError where what is to vary is not free, or the runs fitted are of one group.
    """
    found = {}
    for name, by in experiment.vary.items():
        if name not in (*names, GAUGE_NOISE):
            raise SrfError(f"'{name}' is to vary, and is not free", did_you_mean(name, [*names, GAUGE_NOISE]))
        label = labels(experiment, by)
        found[name] = list(dict.fromkeys(label[run.name] for run in runs))
        if len(found[name]) < 2:
            raise SrfError(f"{name} cannot vary by {by}: the runs fitted have only one", "Leave `vary` out.")
    return found


@dataclass(frozen=True)
class BetweenGroups:
    """Values of one parameter in several groups: their mean, its error, how they scatter beyond their errors, p of no scatter."""

    mean: float
    stderr: float
    scatter: float
    p_value: float


def between_groups(values: Array, covariance: Array) -> BetweenGroups:
    """Return the random-effects summary of a parameter's values (k,) in k groups with their covariance (k, k).

    The scatter is that of restricted maximum likelihood (Patterson and Thompson, Biometrika 58, 1971); p is that of chi-squared,
    k - 1 degrees of freedom, about the mean weighted by the covariance.
    """
    from scipy.optimize import minimize_scalar

    k = values.size
    most = 3.0 * float(np.ptp(values)) + 1e-300

    def about(scatter: float) -> tuple[float, float, float, float]:
        """Return mean, its variance, chi-squared and the restricted likelihood's cost."""
        V = covariance + scatter**2 * np.eye(k)
        weight = np.linalg.solve(V, np.ones(k))
        mean = float(weight @ values / weight.sum())
        square = float((values - mean) @ np.linalg.solve(V, values - mean))
        return mean, float(1 / weight.sum()), square, float(np.linalg.slogdet(V)[1] + np.log(weight.sum()) + square)

    found = minimize_scalar(lambda s: about(s)[3], bounds=(0.0, most), method="bounded", options={"xatol": 1e-6 * most})
    scatter = float(found.x) if found.fun < about(0.0)[3] else 0.0
    mean, variance = about(scatter)[:2]
    return BetweenGroups(mean, float(np.sqrt(variance)), scatter, chi2_p_value(about(0.0)[2], k - 1))
