"""The fit of an experiment as `srf fit` makes it: likelihood, starts, random friction field."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations

import numpy as np

from srfcli.codegen.c_source import GET_COMPILER, compiler
from srfcli.codegen.model import Array, open_model
from srfcli.core.errors import SrfError, Status
from srfcli.data.groups import grouped
from srfcli.data.values import Experiment, Run
from srfcli.inference.fit import BetweenGroups, Fit, Problem, between_groups, fit_problem
from srfcli.inference.shared_field import fit_shared
from srfcli.inference.state_space import (
    SIGNIFICANT_GAIN,
    Interrupted,
    StateSpaceFit,
    as_fit,
    fit_state_space,
    interrupted_fit,
    with_priors,
)
from srfcli.laws.registry import Registry

# The fit of an experiment's recordings as `srf fit` makes it: which likelihood, which starts, whose random friction field.


@dataclass(frozen=True)
class FittedField:
    """The random friction field that was found: its amplitude (1), correlation length (um), one for all runs or for each.

    Amplitude 0 where there is none.
    """

    amplitude: float = 0.0
    length_um: float = 0.0
    shared: bool = False

    def __str__(self) -> str:
        """Return one line on it."""
        if not self.amplitude:
            return "friction field: none is needed"
        whose = "one for all runs" if self.shared else "each run has its own"
        return f"friction field: mu0 varies by {self.amplitude:.2g} (standard deviation) over {self.length_um:.2g} um; {whose}"


@dataclass(frozen=True)
class RecordingFit:
    """A fit with what is beside it: the state-space likelihood where that was maximised, the field, how each start ended."""

    problem: Problem
    fit: Fit
    state_space: StateSpaceFit | None
    friction_field: FittedField | None
    starts: tuple[tuple[float, bool], ...]
    status: Status
    scatter: Mapping[str, BetweenGroups | None] = field(default_factory=dict)


MIN_GROUPS_FOR_PRIOR = 5  # groups from which their scatter is known well enough to be a prior: to a third of itself
MIN_SCATTER = 0.01  # of the errors: a scatter that stands for none at all


def _scatter(found: StateSpaceFit) -> dict[str, BetweenGroups | None]:
    """Return how the values of each parameter that varies scatter; None where one is at its bound, its error not known."""
    told: dict[str, BetweenGroups | None] = {}
    whole = found.covariance
    for n, names in found.likelihood.problem.groups.items():
        places = [found.likelihood.names.index(name) for name in names]
        covariance = whole[np.ix_(places, places)]
        known = bool((np.diag(covariance) > 0).all())
        told[n] = between_groups(np.array([found.values[name] for name in names]), covariance) if known else None
    return told


def _with_shrinkage(found: StateSpaceFit, scatter: Mapping[str, BetweenGroups | None]) -> StateSpaceFit:
    """Return the fit with the values of many groups drawn towards their means.

    The prior is Gaussian, of unknown mean; its standard deviation is how values scatter beyond their errors: empirical Bayes.
    """
    priors, errors = [], np.sqrt(np.diag(found.covariance))
    for n, own in scatter.items():
        names = found.likelihood.problem.groups[n]
        if own is not None and len(names) >= MIN_GROUPS_FOR_PRIOR:
            error = float(np.mean(errors[[found.likelihood.names.index(name) for name in names]]))
            priors.append((names, max(own.scatter, MIN_SCATTER * error)))
    return with_priors(found, priors) if priors else found


def fit_recordings(
    registry: Registry,
    experiment: Experiment,
    *,
    free: Sequence[str] | None = None,
    trend: str | None = None,
    vary: Sequence[str] = (),
    by: str | None = None,
    prior: bool = True,
    track: str | None = None,
    ask_shared: bool = True,
    starts: int = 1,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> RecordingFit:
    """Return the maximum-likelihood fit of all runs and tables of critical loads together.

    Parameters that `vary` have a value for each group of runs. `track` is "smooth" for no random friction field, "rough" for one
    in each run, "shared" for one that all runs share; left out, the recordings decide, whether it is shared only with
    `ask_shared` and without critical loads. With `prior` the values of five groups or more are drawn towards their mean. A fit
    stopped by Ctrl-C is a status; SrfError is raised for what cannot be fitted, and for recordings without a C compiler.
    """
    beside = next((run.name for run in experiment.runs if run.others), "")
    if experiment.runs and compiler() is None:
        raise SrfError("a fit of recordings needs a C compiler: the filter is compiled", GET_COMPILER)
    if beside and track == "shared":
        raise SrfError(
            f"to fit several observables, as run '{beside}' has, does not go with `track` shared", "Leave `observables` out."
        )
    experiment = grouped(experiment, vary, by, trend)
    if experiment.vary and track == "shared":
        raise SrfError("`vary` does not go with `track` shared", "Leave it out.")
    stability = open_model(registry, **asdict(experiment.choice), stability=True) if experiment.thresholds else None
    if not experiment.runs:
        if vary or experiment.trend or track:
            named = "vary" if vary else "trend" if experiment.trend else "track"
            raise SrfError(f"`{named}` is for recordings, and {experiment.path} has none", "Leave it out.")
        assert stability is not None
        model = stability
    else:
        model = open_model(registry, **asdict(experiment.choice), random_field=True)
    if stability is not None and track == "shared":
        raise SrfError("`track` shared does not go with critical loads", "Leave it out, or name rough.")
    problem = fit_problem(model, experiment, free=free, trend=experiment.trend, stability=stability)
    if track == "shared" and len(problem.runs) < 2:
        raise SrfError(
            f"`track` shared is for several runs, and {experiment.path} has one to fit", "Name rough, or leave it out."
        )
    smooth = None if track is None else track == "smooth"
    try:
        likeliest, rows, interrupted = fit_from_several(problem, smooth=smooth, count=starts, seed=seed, progress=progress)
    except Interrupted as error:
        found = interrupted_fit(problem, error.found)
        return RecordingFit(problem, as_fit(found), found, _track(found), (), Status.INTERRUPTED)
    scatter = _scatter(likeliest)
    found = _with_shrinkage(likeliest, scatter) if prior and not interrupted else likeliest
    best = as_fit(found)
    status = Status.INTERRUPTED if interrupted else best.status
    result = RecordingFit(found.likelihood.problem, best, found, _track(found), tuple(rows), status, scatter)
    if interrupted or len(problem.runs) < 2 or problem.tables:
        return result
    try:
        asked = ask_shared and track is None and not (experiment.vary or any(run.others for run in problem.runs))
        if not (track == "shared" or (asked and field_correlation(found) > SHARED_FIELD_CORRELATION)):
            return result
        tabled = open_model(registry, **asdict(experiment.choice), tables=(("mu", "slip"),))
        shared, field = fit_shared(replace(problem, model=tabled), best, progress=progress)
    except KeyboardInterrupt:
        return replace(result, status=Status.INTERRUPTED)
    if track is None and shared.log_likelihood < best.log_likelihood + SIGNIFICANT_GAIN:
        return result
    common = FittedField(field.amplitude, field.length, True) if field.amplitude else FittedField()
    return replace(result, fit=shared, state_space=None, friction_field=common, status=shared.status)


def _track(found: StateSpaceFit) -> FittedField | None:
    values = found.values
    if not found.likelihood.problem.runs:
        return None
    return FittedField() if found.smooth else FittedField(values["field_amplitude"], values["field_length"])


# Several starts: the file's own, and others drawn over the bounds, so that a false minimum is found out.

START_SPREAD = 0.3  # of the way from the start value to each bound, at most
SAME_MINIMUM_DISTANCE = 0.5  # standard errors between two minima that count as one


def start_points(problem: Problem, count: int, seed: int) -> list[Array]:
    """Return `count` starting points (k,): the problem's own first, then a Latin hypercube about it, within the bounds."""
    points = [problem.start]
    if count > 1:
        from scipy.stats import qmc

        cube = 2 * qmc.LatinHypercube(d=problem.start.size, rng=np.random.default_rng(seed)).random(count - 1) - 1
        reach = np.where(cube > 0, problem.upper - problem.start, problem.start - problem.lower)
        points += list(problem.start + START_SPREAD * cube * reach)
    return points


def fit_from_several(
    problem: Problem,
    *,
    smooth: bool | None = None,
    count: int = 1,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> tuple[StateSpaceFit, list[tuple[float, bool]], bool]:
    """Return the best fit over the starts, a row for each that ended, and whether it was interrupted before all were done.

    A row is the log likelihood, and whether that start ended in the best one's minimum; `smooth` is as in `fit_state_space`.
    Ctrl-C is `Interrupted` where no start is done.
    """
    fits: list[StateSpaceFit] = []
    interrupted = False
    for number, start in enumerate(start_points(problem, count, seed), 1):
        prefix = f"start {number} of {count}: " if count > 1 else ""

        def report(text: str, prefix: str = prefix) -> None:
            progress(prefix + text)

        try:
            fits.append(fit_state_space(replace(problem, start=start), smooth=smooth, progress=report))
        except (Interrupted, KeyboardInterrupt):
            if not fits:
                raise
            interrupted = True
            break
    best = max(fits, key=lambda f: f.log_likelihood)
    errors = np.maximum(np.sqrt(np.diag(best.covariance)), 1e-300)
    away = [max(abs(f.values[n] - best.values[n]) / e for n, e in zip(problem.names, errors, strict=False)) for f in fits]
    rows = [(f.log_likelihood, d < SAME_MINIMUM_DISTANCE) for f, d in zip(fits, away, strict=True)]
    return best, rows, interrupted


# Whether all runs have one and the same random friction field.

SHARED_FIELD_CORRELATION = 0.5  # mean correlation of the fields of two runs from which one field for all is fitted


def field_correlation(found: StateSpaceFit) -> float:
    """Return the mean correlation of the smoothed fields of any two runs over the slip that both have; 0 where none has any."""
    if found.smooth or len(found.likelihood.problem.runs) < 2:
        return 0.0
    fields = [(run, found.smoothed_states[run.name]) for run in found.likelihood.problem.runs]
    states = found.likelihood.problem.model.states
    length = found.values["field_length"]
    products, first, second = 0.0, 0.0, 0.0
    for (a, x), (b, y) in combinations(fields, 2):
        s, r = slip_along(a, x, states), slip_along(b, y, states)
        where = np.arange(max(s[0], r[0]), min(s[-1], r[-1]), 0.5 * length)
        if where.size < 10:
            continue
        m, n = (np.interp(where, place, z[:, states.index("field")]) for place, z in ((s, x), (r, y)))
        m, n = m - m.mean(), n - n.mean()
        products, first, second = products + float(m @ n), first + float(m @ m), second + float(n @ n)
    return products / np.sqrt(first * second) if first and second else 0.0


def slip_along(run: Run, x: Array, states: tuple[str, ...]) -> Array:
    """Return the slip (n,) in um along smoothed states, from the run's start on."""
    if "u" in states:  # what the stage moved less what the spring was stretched: exact where stick-slip is faster than samples
        u = x[:, states.index("u")]
        return np.asarray(run.start + (run.drive.displacement(run.t) - (u - u[0])))
    v = np.exp(x[:, states.index("ln_v")])
    return run.start + np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(run.t))])
