"""Recordings: read, checked and fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from srfcli.core.errors import SrfError, Status, as_names, check_choice
from srfcli.data import experiment as description
from srfcli.data.groups import BY
from srfcli.data.values import Experiment
from srfcli.inference import posterior as posteriors
from srfcli.inference.cramer_rao import forecast
from srfcli.inference.posterior import Posterior
from srfcli.inference.profile import Interval
from srfcli.inference.recordings import fit_recordings
from srfcli.laws.registry import Registry, load_registry
from srfcli.results.check import CheckResult
from srfcli.results.fit import FitResult


def read_experiment(
    path: str | Path,
    *,
    format: str | None = None,
    holdout: bool = True,
    plugins: Sequence[str | Path] = (),
    registry: Registry | None = None,
) -> Experiment:
    """Return an experiment: its runs, its apparatus, the model that is believed, and the parameters that are free.

    Parameters
    ----------
    path : str or path
        A folder with an experiment.toml, or that file.
    format : str, optional
        Reader of all data files; each is told from its name and content if left out.
    holdout : bool
        Whether runs that are held out are read, too.
    plugins : sequence of path
        Folders in which laws and readers are looked for, too.
    registry : Registry, optional
        An open registry of laws and readers; loaded from `plugins` and the usual places if left out.

    Returns
    -------
    Experiment
        All numbers in um, s, N.

    Raises
    ------
    SrfError
        For what is missing, contradictory or unreadable, with the file and the line or column.

    Examples
    --------
    >>> from pathlib import Path
    >>> import srfcli as srf
    >>> lines = ["time [s],load_point_velocity [um/s],friction", *(f"{0.1 * i:.1f},3,0.6" for i in range(20))]
    >>> _ = Path("run.csv").write_text("\\n".join(lines))
    >>> described = '''
    ... format = "srf-experiment/1"
    ... apparatus = { stiffness = "3e-3 1/um" }
    ... model = { law = "dieterich-ruina", ageing = "ruina", interface = "rigid", inertia = false }
    ... parameters = { D0 = { value = 10.0, lower = 1.0, upper = 100.0 } }
    ... runs = [{ name = "run", file = "run.csv", load = "10 MPa" }]
    ... '''
    >>> _ = Path("experiment.toml").write_text(described)
    >>> experiment = srf.read_experiment(".")
    >>> [(run.name, run.observed.shape) for run in experiment.runs]
    [('run', (20,))]
    """
    known = registry or load_registry([Path(p) for p in plugins])
    return description.read_experiment(Path(path), registry=known, format=format, holdout=holdout)


def check(
    experiment: Experiment | Path | str,
    *,
    runs: Sequence[str] = (),
    simulate: bool = True,
    plugins: Sequence[str | Path] = (),
    registry: Registry | None = None,
    progress: Callable[[str], None] = lambda run: None,
) -> CheckResult:
    """Return what an experiment's recordings are like, and what can be identified from them.

    Parameters
    ----------
    experiment : path or Experiment
        A folder with experiment.toml, or that file; or from `srfcli.read_experiment`, which also takes a reader.
    runs : sequence of str
        Names of runs; all if left out.
    simulate : bool
        Whether each run is simulated, to say what its load can tell.
    plugins : sequence of path
        Folders in which laws are looked for, too.
    registry : Registry, optional
        An open registry of laws; loaded from `plugins` and the usual places if left out.
    progress : callable
        Told the name of each run before it is simulated.

    Returns
    -------
    CheckResult
        A row for each run; `.runs` has all that was found in each, in um, s, N.

    Raises
    ------
    SrfError
        For what cannot be read, a run that there is not, or an experiment of critical loads alone.

    References
    ----------
    Cramer (1946), Mathematical Methods of Statistics: the bound on what a recording tells.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import srfcli as srf
    >>> mu = 0.6 + np.random.default_rng(1).normal(0, 2e-4, 200)
    >>> lines = ["time [s],load_point_velocity [um/s],friction", *(f"{0.1 * i:.1f},3,{x}" for i, x in enumerate(mu))]
    >>> _ = Path("run.csv").write_text("\\n".join(lines))
    >>> described = '''
    ... format = "srf-experiment/1"
    ... apparatus = { stiffness = "3e-3 1/um" }
    ... model = { law = "dieterich-ruina", ageing = "ruina", interface = "rigid", inertia = false }
    ... parameters = { D0 = { value = 10.0, lower = 1.0, upper = 100.0 } }
    ... runs = [{ name = "run", file = "run.csv", load = "10 MPa" }]
    ... '''
    >>> _ = Path("experiment.toml").write_text(described)
    >>> found = srf.check(".")
    >>> found.runs[0].run.t.size, round(found.runs[0].noise.total, 4)
    (200, 0.0002)
    """
    registry = registry or load_registry([Path(p) for p in plugins])
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment, registry=registry)
    experiment.check_recorded("to check")
    found = tuple(description.check_run(run) for run in experiment.named(runs))
    told = forecast(experiment, found, registry=registry, progress=progress) if simulate else None
    return CheckResult(experiment, found, told)


def fit(
    experiment: Experiment | Path | str,
    *,
    free: str | Sequence[str] | None = None,
    trend: str | None = None,
    vary: str | Sequence[str] = (),
    by: str | None = None,
    prior: bool = True,
    track: str | None = None,
    starts: int = 1,
    profile: bool = False,
    sample: int | None = None,
    seed: int = 0,
    plugins: Sequence[str | Path] = (),
    registry: Registry | None = None,
    progress: Callable[[str, str, float | None], None] = lambda stage, text, share: None,
) -> FitResult:
    """Return the maximum-likelihood fit of an experiment's model to its recordings and critical loads, all together.

    The gauge's noise, its level and colour, and a random friction field along slip are estimated with the parameters and count
    in their errors.

    Parameters
    ----------
    experiment : path or Experiment
        A folder with experiment.toml, or that file; or from `srfcli.read_experiment`, which also takes a reader.
    free : str or sequence of str, optional
        Parameters to fit; those that the experiment leaves free if left out.
    trend : {'slip', 'time', 'none'}, optional
        Let each run's observable drift, or not; as the experiment says if left out.
    vary : str or sequence of str
        Free parameters, or "noise" of the gauge, with a value of their own in each group of runs. The value of B in the group
        `up` is called `B[up]`. If left out, as the experiment says.
    by : {'run', 'load', 'segment', 'direction'}, optional
        What makes a group.
    prior : bool
        Give the values of five or more groups a Gaussian prior of estimated mean and standard deviation (empirical Bayes),
        which shrinks them towards their mean.
    track : {'smooth', 'rough', 'shared'}, optional
        Random friction field along slip: none, one for each run, one for all; the recordings decide if left out.
    starts : int
        Starting points to fit from.
    profile : bool
        Whether the intervals are those of the profile likelihood.
    sample : int, optional
        How many points of the posterior are drawn, with emcee.
    seed : int
        Of further starts and of the sampler.
    plugins : sequence of path
        Folders in which laws are looked for, too.
    registry : Registry, optional
        An open registry of laws; loaded from `plugins` and the usual places if left out.
    progress : callable
        Told the stage (fit, profile, sample), what is done, and which share of the stage where that is known.

    Returns
    -------
    FitResult
        Ctrl-C is a status: the likeliest parameters so far.

    Raises
    ------
    SrfError
        For an experiment that cannot be read or has nothing to fit, a parameter without a start value or bounds, options that
        do not go together, and for recordings without a C compiler.

    References
    ----------
    Kalman (1960), J. Basic Eng. 82, 35: the filter. Durbin and Koopman (2012), Time Series Analysis by State Space Methods: the
    likelihood. Vehtari and others (2021), Bayesian Analysis 16, 667: R-hat.

    Examples
    --------
    A velocity step, simulated with D0 = 10 um and read with noise:

    >>> from pathlib import Path
    >>> import numpy as np
    >>> import srfcli as srf
    >>> t, V = np.arange(300) * 0.2, np.repeat([1.0, 10.0], [100, 200])
    >>> laws = {"law": "dieterich-ruina", "ageing": "dieterich", "interface": "rigid", "inertia": False}
    >>> slider = srf.system(**laws, W0=10, K="30 MPa/mm", mu0=0.6, A=0.008, B=0.011, D0=10)
    >>> record = srf.simulate(slider, t=t, drive=[(0, 1), (20, 10)], observable="friction").records[0]
    >>> mu = record.observed + np.random.default_rng(1).normal(0, 2e-4, t.size)
    >>> head = "time [s],load_point_velocity [um/s],friction"
    >>> np.savetxt("run.csv", np.column_stack([t, V, mu]), delimiter=",", header=head, comments="")
    >>> described = '''
    ... format = "srf-experiment/1"
    ... apparatus = { stiffness = "3e-3 1/um" }
    ... model = { law = "dieterich-ruina", ageing = "dieterich", interface = "rigid", inertia = false }
    ... runs = [{ name = "run", file = "run.csv", load = "10 MPa" }]
    ... [parameters]
    ... mu0 = { value = 0.6, lower = 0.5, upper = 0.7 }
    ... A = { value = 0.01, lower = 0.001, upper = 0.05 }
    ... B = { value = 0.01, lower = 0.001, upper = 0.05 }
    ... D0 = { value = 5.0, lower = 1.0, upper = 100.0 }
    ... '''
    >>> _ = Path("experiment.toml").write_text(described)
    >>> found = srf.fit(".", track="smooth")
    >>> found.status.ok, round(found.values["D0"]), found.stderr["D0"] < 0.2
    (True, 10, True)
    """
    check_choice("track", track, ("smooth", "rough", "shared"))
    check_choice("trend", trend, ("slip", "time", "none"))
    check_choice("by", by, BY)
    free, vary = None if free is None else as_names(free, "free"), as_names(vary, "vary")
    if starts < 1 or (sample is not None and sample < 2):
        raise SrfError("a fit has one start or more, and a sample two points or more", "As `starts` 4, `sample` 1000.")
    if track == "shared" and (profile or sample):
        raise SrfError("`track` shared does not go with `profile` or `sample`", "Leave it out, or name rough.")
    registry = registry or load_registry([Path(p) for p in plugins])
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment, registry=registry)
    if sample:
        experiment.check_recorded("of which a posterior is drawn")
    found = fit_recordings(
        registry, experiment, free=free, trend=trend, vary=vary, by=by, prior=prior, track=track,
        ask_shared=not (profile or sample), starts=starts, seed=seed, progress=lambda text: progress("fit", text, None),
    )  # fmt: skip
    status = found.status
    intervals: list[Interval] = []
    posterior: Posterior | None = None
    try:
        if profile and found.state_space and status is not Status.INTERRUPTED:
            names = found.problem.names
            for k, name in enumerate(names):

                def told(text: str, done: float = k / len(names)) -> None:
                    progress("profile", text, done)

                intervals.append(posteriors.profile(found.state_space, name, progress=told))
        if sample and found.state_space and status is not Status.INTERRUPTED:
            posterior = posteriors.sample(
                found.state_space, sample, seed=seed, progress=lambda text, share: progress("sample", text, share)
            )
            status = Status.INTERRUPTED if posterior.interrupted else status
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    return FitResult(found, tuple(intervals), posterior, starts, status)
