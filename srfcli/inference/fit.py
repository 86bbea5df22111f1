"""Maximum likelihood over all runs of an experiment together: whitened residuals, exact gradients, growing horizons.

Stick-slip makes a least-squares surface full of false minima: a cycle too early fits as well as any. So a sample takes part only
once the parameters are known well enough for the prediction there to be linear in what is still unknown of them; the horizon of
each run grows from fit to fit until it covers the run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError, Status, did_you_mean
from srfcli.data.groups import NOISE, labels
from srfcli.data.values import CriticalLoads, Experiment, Run, Signal
from srfcli.inference.critical_loads import Matched
from srfcli.inference.noise import Noise, estimate_noise, log_determinant, stretches, white_level, whiten
from srfcli.inference.prediction import RTOL, Prediction, own_names, own_start, predict, run_parameters

# Covariances from information matrices that may be nearly singular.


def inverse(information: Array) -> Array:
    """Return the inverse, after scaling; a direction that nothing determines gets an enormous variance, not a failure."""
    d = np.maximum(np.sqrt(np.diag(information)), 1e-8)  # of scaled parameters: nothing that matters is so flat
    values, vectors = np.linalg.eigh(information / np.outer(d, d))
    inverse = (vectors / np.maximum(values, 1e-14)) @ vectors.T
    return np.asarray(inverse / np.outer(d, d))


def root(covariance: Array) -> Array:
    """Return the principal directions of a covariance, one standard deviation long each, as columns."""
    d = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(d, d))
    return np.asarray((d[:, None] * vectors) * np.sqrt(np.maximum(values, 0.0)))


# Maximum likelihood over all runs of an experiment together: whitened residuals, exact gradients, growing horizons.

LINEAR = 0.25  # of a run's amplitude: a prediction that bends by more is not used yet
STAGES = 12
GROWN = 3.0  # standard deviations of the last fit over which the next stage wants linearity
SHORTER = (1.0, 0.5, 0.25, 0.12)  # of the first horizons
POOR = 4.0  # reduced chi-squared of a first stage that is not believed before shorter ones were tried
CONVERGED = 0.1  # standard errors: how far the minimum may still be, by the gradient
BAD = 1e6  # residual, in standard deviations, of a sample that the integration did not reach
HUGE = 1e100  # a slope that is no slope any more: its square would overflow


@dataclass(frozen=True)
class RunFit:
    """How one observable of a run is fitted: residual (n,), its noise model, the part of its samples that took part.

    `colours` are the gauge's coloured noise, of a state-space fit: correlation time (s) and standard deviation of a relaxation,
    frequency (Hz), standard deviation and quality of an oscillation.
    """

    name: str
    holdout: bool
    prediction: Prediction
    residual: Array
    parts: list[tuple[int, int]]
    noise: Noise
    white: float  # standard deviation of white noise, from differences of the residual
    colours: tuple[tuple[float, ...], ...] = ()
    observable: str = ""

    @property
    def rms(self) -> float:
        """Return the root mean square of the residual over the samples that are compared."""
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
    trail: tuple[tuple[float, str], ...] = ()
    others: tuple[RunFit, ...] = ()
    tables: tuple[Matched, ...] = ()

    @property
    def stderr(self) -> dict[str, float]:
        """Return the standard errors by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def correlation(self) -> Array:
        """Return the correlation matrix of the estimates."""
        sd = np.sqrt(np.diag(self.covariance))
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


class Interrupted(Exception):
    """Carries the best parameters found before the user stopped the fit."""

    def __init__(self, values: dict[str, float]) -> None:
        super().__init__("interrupted")
        self.values = values


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
    held: Mapping[str, float] = field(default_factory=dict)
    rtol: float = RTOL
    priors: tuple[tuple[tuple[str, ...], float], ...] = ()  # names, and the scatter of their values about an unknown mean
    tables: tuple[CriticalLoads, ...] = ()
    stability: GeneratedModel | None = None

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
        return {**self.held, **dict(zip(self.names, np.asarray(theta).tolist(), strict=True))}

    @cached_property
    def varying(self) -> dict[str, dict[str, str]]:
        """Return what the parameters that vary are called in each run of the experiment."""
        return {run.name: self.varied(run) for run in self.experiment.runs}

    def varied(self, run: Run) -> dict[str, str]:
        """Return what the parameters that vary are called in a run, fitted or not."""
        return {n: f"{n}[{self.group(run)}]" for n in self.experiment.vary if n != NOISE}

    def group(self, run: Run) -> str:
        """Return the group of a run for what varies."""
        known = self._labels.get(run.name)
        return known or labels(replace(self.experiment, runs=(*self.experiment.runs, run)))[run.name]

    @cached_property
    def _labels(self) -> dict[str, str]:
        return labels(self.experiment)

    def noise_group(self, run: Run) -> str:
        """Return the group of runs whose gauge noise a run has; nothing where all share one."""
        return self.group(run) if NOISE in self.experiment.vary else ""

    def local(self, run: Run, values: Mapping[str, float]) -> dict[str, float]:
        """Return parameters by name with those that vary under their own names, at what they are in this run."""
        return {**values, **{n: values[name] for n, name in self.varied(run).items() if name in values}}

    def predicted(self, run: Run, theta: Array, *, until: float = np.inf, slopes: bool = True) -> Prediction:
        """Return the prediction of a run, with derivatives by the free parameters."""
        by = self.names if slopes else ()
        return predict(
            self.model,
            self.experiment,
            run,
            self.named(theta),
            by=by,
            until=until,
            trend=None if run.holdout else self.trend,
            rtol=self.rtol,
        )


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
    _check_varying(experiment, runs, names)
    label = labels(experiment)
    groups = {n: list(dict.fromkeys(f"{n}[{label[run.name]}]" for run in runs)) for n in experiment.vary if n != NOISE}
    rows = [(listed[n].value, listed[n].lower, listed[n].upper) for n in names for _ in groups.get(n, [n])]
    names = [own for n in names for own in groups.get(n, [n])]
    for run in runs:
        own = own_names(model, run, trend)
        p = run_parameters(model, experiment, run, {})
        rows += [own_start(model, run, p, name, trend) for name in own]
        names += own
    start, lower, upper = np.array(rows, dtype=float).T
    for name, low, high in zip(names, lower, upper, strict=True):
        if not (np.isfinite(low) and np.isfinite(high)):
            raise SrfError(f"'{name}' has no bounds", "give lower and upper in [parameters]")
    return Problem(
        model, experiment, runs, tuple(names), start, lower, upper, trend, tables=tables, stability=stability
    )


def _check_varying(experiment: Experiment, runs: Sequence[Run], names: Sequence[str]) -> None:
    """Raise SrfError where what is to vary is not free, or the runs fitted are of one group."""
    vary, by = experiment.vary, experiment.by
    for name in vary:
        if name not in (*names, NOISE):
            raise SrfError(f"'{name}' is to vary, and is not free", did_you_mean(name, [*names, NOISE]))
    label = labels(experiment)
    if vary and len({label[run.name] for run in runs}) < 2:
        raise SrfError(f"{', '.join(vary)} cannot vary by {by}: the runs fitted have only one", "Leave `vary` out.")


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
    from scipy.stats import chi2

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
    return BetweenGroups(mean, float(np.sqrt(variance)), scatter, float(chi2.sf(about(0.0)[2], k - 1)))


def scatter_of(fit: Fit, names: Sequence[str]) -> BetweenGroups | None:
    """Return how the values of one parameter in several groups scatter; None where one is at its bound, its error not known."""
    places = [fit.names.index(n) for n in names]
    covariance = np.asarray(fit.covariance)[np.ix_(places, places)]
    return between_groups(np.array([fit.values[n] for n in names]), covariance) if (np.diag(covariance) > 0).all() else None


def fit(
    problem: Problem,
    *,
    start: Array | None = None,
    noises: Mapping[str, Noise] | None = None,
    progress: Callable[[str], None] = lambda text: None,
    refinements: int = 3,
) -> Fit:
    """Return the maximum-likelihood fit from `start` (k,), the problem's own start values if left out.

    First with white noise of the level that the recordings' differences show and growing horizons, then with the noise that the
    residuals show, until the two agree. KeyboardInterrupt becomes `Interrupted`, with the best parameters so far.
    """
    search = Search(problem, progress)
    theta = np.clip(problem.start if start is None else start, problem.lower, problem.upper)
    noise = {r.name: Noise(first_level(r.t, r.signals[0])) for r in problem.runs} if noises is None else dict(noises)
    try:
        theta, status = search.grow(theta, noise)
        for _ in range(refinements if noises is None else 0):
            before = theta
            noise = search.noise(theta)
            theta, status = search.minimise(theta, noise, {})
            if np.all(np.abs(theta - before) <= 1e-2 * np.sqrt(np.diag(search.covariance))):
                break
    except KeyboardInterrupt as error:
        raise Interrupted(problem.named(search.best)) from error
    return search.result(theta, noise, status)


def first_level(t: Array, signal: Signal) -> float:
    """Return the standard deviation of white noise that the readings of a signal at the times t (n,) show themselves."""
    level = white_level(signal.observed, stretches(t, signal.used))
    return max(level, signal.quantum / np.sqrt(12), 1e-9 * float(np.ptp(signal.observed)), 1e-300)


def unreached(difference: Array, J: Array, noise: Noise) -> Array:
    """Return which samples (n,) have no residual or no slopes (n, k) to speak of: the integration did not reach them."""
    return ~((np.abs(difference) < BAD * noise.innovation) & (np.abs(J) < HUGE).all(axis=1))


class Search:
    """One minimisation: counts evaluations, keeps the best, and knows the covariance of the last."""

    def __init__(self, problem: Problem, progress: Callable[[str], None]) -> None:
        self.problem, self.progress = problem, progress
        self.evaluations = 0
        self.reduced = 1.0  # chi-squared for each degree of freedom
        self.best, self.covariance = problem.start, np.zeros((problem.start.size,) * 2)
        self.trail: list[tuple[float, str]] = []
        self.scale = np.maximum(np.abs(problem.start), 1e-3 * (problem.upper - problem.lower))

    def grow(self, theta: Array, noise: Mapping[str, Noise]) -> tuple[Array, Status]:
        """Return the minimum over all samples, reached by horizons that grow."""
        width = np.minimum((self.problem.upper - self.problem.lower) / 6, 0.15 * self.scale)
        theta, status, horizons = self.first_stage(theta, noise, np.diag(width))
        covered = self.covered(horizons)
        for stage in range(2, STAGES + 1):
            if covered >= 1.0:
                break
            directions = GROWN * root(self.covariance) * np.sqrt(max(self.reduced, 1.0))
            linear = {r.name: self.horizon(r, theta, directions) for r in self.problem.runs}
            horizons = {name: max(linear[name], horizons[name]) for name in linear}
            share = self.covered(horizons)
            if share <= covered or stage == STAGES:  # no horizon has grown: the rest is tried all the same
                horizons, share = {}, 1.0
            self.progress(f"stage {stage}: {100 * share:.0f} % of the samples")
            theta, status = self.minimise(theta, noise, horizons)
            covered = share
        return theta, status

    def first_stage(
        self, start: Array, noise: Mapping[str, Noise], directions: Array
    ) -> tuple[Array, Status, dict[str, float]]:
        """Return the first minimum and its horizons: shorter ones where they fit far better.

        Start values under which sliding is steady look linear for ever, whatever the recording does.
        """
        linear = {r.name: self.horizon(r, start, directions) for r in self.problem.runs}
        found: tuple[Array, Status, dict[str, float]] | None = None
        best = state = None
        for share in SHORTER:
            begins = {r.name: float(r.t[0]) for r in self.problem.runs}
            horizons = {n: begins[n] + share * (h - begins[n]) for n, h in linear.items()}
            self.progress(f"stage 1: {100 * self.covered(horizons):.0f} % of the samples")
            theta, status = self.minimise(start, noise, horizons)
            if best is None or self.reduced < best / 4:
                best, found, state = self.reduced, (theta, status, horizons), (self.best, self.covariance, self.reduced)
            if best < POOR:
                break
        assert found is not None and state is not None
        self.best, self.covariance, self.reduced = state
        return found

    def covered(self, horizons: Mapping[str, float]) -> float:
        """Return the share of all samples within the horizons."""
        inside = sum(int(np.sum(r.t <= horizons[r.name])) for r in self.problem.runs)
        return inside / sum(r.t.size for r in self.problem.runs)

    def horizon(self, run: Run, theta: Array, directions: Array) -> float:
        """Return the time up to which the prediction is linear over these directions (k, k), its columns."""
        problem = self.problem
        base = problem.predicted(run, theta)
        self.evaluations += 1
        amplitude = max(float(np.std(run.observed)), 10 * first_level(run.t, run.signals[0]))
        limit = float(run.t[-1])
        for d in directions.T:
            moved = np.clip(theta + d, problem.lower, problem.upper)
            bent = problem.predicted(run, moved, until=limit, slopes=False)
            n = bent.y.size
            with np.errstate(invalid="ignore"):
                bend = np.abs(bent.y - base.y[:n] - base.J[:n] @ (moved - theta))
            off = np.nonzero(~(bend <= LINEAR * amplitude))[0]
            if off.size:
                limit = float(run.t[max(off[0] - 1, 1)])
        return limit

    def minimise(self, theta: Array, noise: Mapping[str, Noise], horizons: Mapping[str, float]) -> tuple[Array, Status]:
        """Return the minimum of the whitened residuals up to the horizons, and how the minimiser ended."""
        return self.descend(theta, noise, horizons, tolerance=1e-9, most=60)

    def descend(
        self, theta: Array, noise: Mapping[str, Noise], horizons: Mapping[str, float], *, tolerance: float, most: int
    ) -> tuple[Array, Status]:
        """Return where at most so many evaluations lead, and how the minimiser ended."""
        from scipy.optimize import least_squares

        problem = self.problem
        cache: dict[bytes, tuple[Array, Array]] = {}

        def both(x: Array) -> tuple[Array, Array]:
            key = x.tobytes()
            if key not in cache:
                cache.clear()
                cache[key] = self.residuals(x * self.scale, noise, horizons)
            return cache[key]

        low, high = problem.lower / self.scale, problem.upper / self.scale
        inside = np.clip(theta / self.scale, low + 1e-9 * (high - low), high - 1e-9 * (high - low))
        found = least_squares(
            lambda x: both(x)[0], inside, jac=lambda x: both(x)[1], bounds=(low, high), x_scale="jac",
            ftol=tolerance, xtol=1e-9, gtol=1e-12, max_nfev=most,
        )  # fmt: skip
        self.best = found.x * self.scale
        information = found.jac.T @ found.jac
        self.covariance = inverse(information) * np.outer(self.scale, self.scale)
        free = found.active_mask == 0
        gradient = (found.jac.T @ found.fun)[free]
        away = float(np.sqrt(max(gradient @ inverse(information[np.ix_(free, free)]) @ gradient, 0.0)))
        self.reduced = 2 * found.cost / max(found.fun.size - theta.size, 1)
        self.trail.append(
            (2 * float(found.cost), f"{found.nfev} evaluations, {away:.1e} standard errors from the minimum")
        )
        return self.best, Status.OK if away < CONVERGED else Status.NO_CONVERGENCE

    def residuals(self, theta: Array, noise: Mapping[str, Noise], horizons: Mapping[str, float]) -> tuple[Array, Array]:
        """Return the whitened residuals and their derivatives by the scaled parameters."""
        values, slopes = [], []
        self.evaluations += 1
        for run in self.problem.runs:
            until = horizons.get(run.name, float("inf"))
            found = self.problem.predicted(run, theta, until=until)
            n = found.y.size
            used = run.used[:n]
            parts = stretches(run.t[:n], used)
            own = noise[run.name]
            difference = found.y - run.observed[:n]
            bad = unreached(difference, found.J, own)
            difference = np.where(bad, BAD * own.innovation, difference)
            J = np.where(bad[:, None], 0.0, found.J) * self.scale
            values.append(whiten(own, difference, parts))
            slopes.append(whiten(own, J, parts))
        return np.concatenate(values), np.concatenate(slopes)

    def noise(self, theta: Array) -> dict[str, Noise]:
        """Return the noise of each run's residuals."""
        return {f.name: f.noise for f in judge(self.problem, theta, self.problem.runs)}

    def result(self, theta: Array, noise: Mapping[str, Noise], status: Status) -> Fit:
        problem = self.problem
        runs = [replace(f, noise=noise[f.name]) for f in judge(problem, theta, problem.runs)]
        total = 0.0
        for f in runs:
            white = whiten(f.noise, f.residual, f.parts)
            total -= (
                0.5 * float(white @ white) + log_determinant(f.noise, f.parts) + 0.5 * white.size * np.log(2 * np.pi)
            )
        held = judge(problem, theta, [r for r in problem.experiment.runs if r.holdout])
        return Fit(
            problem.names, problem.named(theta), self.covariance, problem.lower, problem.upper, (*runs, *held), total,
            status, self.evaluations, tuple(self.trail),
        )  # fmt: skip


def judge(problem: Problem, theta: Array, runs: Sequence[Run]) -> list[RunFit]:
    """Return how these runs, fitted or held out, agree with the parameters."""
    found = []
    for run in runs:
        prediction = problem.predicted(run, theta)
        residual = run.observed - prediction.y
        parts = stretches(run.t, run.used & np.isfinite(residual))
        found.append(
            RunFit(
                run.name, run.holdout, prediction, residual, parts, estimate_noise(residual, parts),
                white_level(residual, parts),
            )
        )  # fmt: skip
    return found


def held_fit(problem: Problem, values: Mapping[str, float]) -> Fit:
    """Return the state of a fit that was stopped: its parameters, with errors as if they were the minimum."""
    theta = np.array([values[n] for n in problem.names])
    search = Search(problem, lambda text: None)
    noise = search.noise(theta)
    _, slopes = search.residuals(theta, noise, {})
    search.covariance = inverse(slopes.T @ slopes) * np.outer(search.scale, search.scale)
    return search.result(theta, noise, Status.INTERRUPTED)
