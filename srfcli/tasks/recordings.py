"""Recordings: described, read, checked and fitted, one experiment or many, a row each; critical loads, fitted alone."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.core.errors import SrfError, Status, as_names, as_pairs, check_choice, explained
from srfcli.core.parallel import Runner, run_here
from srfcli.core.settings import resolve
from srfcli.core.units import from_base, parse_quantity, split_quantity, to_base
from srfcli.data import experiment as description
from srfcli.data.columns import open_source
from srfcli.data.draft import Wish, draft
from srfcli.data.groups import BY, TRENDS
from srfcli.data.thresholds import Thresholds, read_thresholds
from srfcli.data.values import Experiment, Run
from srfcli.inference import posterior as posteriors
from srfcli.inference import thresholds
from srfcli.inference.cramer_rao import forecast
from srfcli.inference.free_parameters import GIVEN, RHO, free_parameters
from srfcli.inference.noise import lag_one
from srfcli.inference.posterior import Posterior
from srfcli.inference.profile import Interval
from srfcli.inference.recordings import fit_recordings
from srfcli.laws.registry import Registry, load_registry
from srfcli.results.check import CheckResult, DraftResult
from srfcli.results.fit import PAIRS, CampaignResult, FitResult, ThresholdFitResult
from srfcli.results.tables import plain_value

if TYPE_CHECKING:
    from srfcli.codegen.slider import SlidingSystem


@explained
def new_experiment(
    files: Path | str | Sequence[Path | str],
    *,
    stiffness: str | None,
    folder: Path | str = ".",
    kind: str | None = None,
    columns: Mapping[str, str] | None = None,
    drive: float | str | Sequence[tuple[float, float]] | None = None,
    load: str | None = None,
    window: tuple[float, float] | str | None = None,
    mass: str | None = None,
    radius: str | None = None,
    thickness: str | None = None,
    area: str | None = None,
    law: str = "dieterich-ruina",
    ageing: str | None = None,
    interface: str = "rigid",
    holdout: Sequence[str] = (),
    title: str = "",
    reader: str | None = None,
    plugins: Sequence[str | Path] = (),
    registry: Registry | None = None,
) -> DraftResult:
    """Return a commented experiment.toml for recordings, which `srfcli.check` and `srfcli.fit` take.

    Columns are recognised by heading and unit; time, what was imposed and what was observed are found in the data.

    Parameters
    ----------
    files : path or sequence of path
        Tables of recorded numbers, a run each.
    stiffness : str
        Stiffness of the machine with its unit: '0.21 N/um', '55 MPa/mm', or friction per micron, '5e-3 1/um'.
    folder : path
        Where experiment.toml will stand.
    kind : {'steps', 'shs', 'oscillation'}, optional
        Velocity steps, slide-hold-slide, or an oscillating load; as found in the data if left out.
    columns : mapping from role to heading, optional
        Which column plays a role, with its unit in brackets where the heading has none: {'shear_stress': 'S [kPa]'}.
    drive : number, text or sequence of (duration, velocity), optional
        What was imposed, if no column has it: in s and um/s, or text as '60:3, 60:10'.
    load : str, optional
        Constant normal load or stress, if no column has it: '5 N', '20 MPa'.
    window : (float, float) or text, optional
        Only this part of the recordings, in s of the file's clock.
    mass : str, optional
        Mass of the slider, '2.37 kg'; without it the slider is quasi-static.
    radius, thickness, area : str, optional
        Of a rotary rig, of a sheared layer, of the sliding contact: '25 mm', '4 mm', '25 cm^2'.
    law, ageing, interface : str
        Names of laws. The ageing law is dieterich, with Linker's term where the load oscillates, if left out.
    holdout : sequence of str
        Runs that no fit sees.
    title : str
        Title of the experiment.
    reader : str, optional
        Reader of all files; each is told from its name and content if left out.
    plugins : sequence of path
        Folders in which laws and readers are looked for, too.
    registry : Registry, optional
        An open registry of laws and readers; loaded from `plugins` and the usual places if left out.

    Returns
    -------
    DraftResult
        `.text` is the file, `.write()` keeps it, `.table` says which column was taken for what, `.notes` what was decided.

    Raises
    ------
    SrfError
        For a file that cannot be read, a role that no column plays and no argument states, a value without a unit.

    Examples
    --------
    >>> from pathlib import Path
    >>> import srfcli as srf
    >>> rows = [f"{0.1 * i:.1f},{3 if i < 99 else 10},{0.6 + 1e-4 * (i % 3)}" for i in range(200)]
    >>> _ = Path("run.csv").write_text("\\n".join(["time [s],lp_velocity [um/s],mu", *rows]))
    >>> made = srf.new_experiment("run.csv", stiffness="3e-3 1/um", load="10 MPa")
    >>> [(row[0], row[1]) for row in made.table.rows]
    [('time', 'time [s]'), ('load_point_velocity', 'lp_velocity [um/s]'), ('friction', 'mu')]
    >>> made.write(force=True)
    >>> srf.read_experiment(".").runs[0].name
    'run'
    """
    check_choice("kind", kind, ("steps", "shs", "oscillation"))
    registry = registry or load_registry([Path(p) for p in plugins])
    places = [Path(p) for p in ([files] if isinstance(files, str | Path) else files)]
    found = [path.resolve() for path in places]
    if not places:
        raise SrfError("there are no recordings to describe", "Name one file or more.")
    for number, path in enumerate(places):
        if found.index(found[number]) < number:
            raise SrfError(f"{path} is named twice", "Name each file once: what counts twice seems known better than it is.")
        open_source(path, registry=registry, format=reader)
    if stiffness is None:
        raise SrfError(
            "the stiffness of the machine is in no table",
            "Say it with `stiffness`: '5.4e-3 1/um' (friction per micron), '55 MPa/mm' (shear stress) or '0.21 N/um' (force).",
        )
    stated, unit = split_quantity(stiffness, name="`stiffness`", example="5e-3 1/um")
    if not unit:
        raise SrfError(
            f"`stiffness` {stiffness!r} has no unit", "'5e-3 1/um' is friction per micron, '55 MPa/mm' shear stress per length."
        )
    wish = Wish(
        stiffness=f"{stated!r} {unit}", kind=kind, columns=columns or {}, drive=_drive(drive), load=load, mass=mass,
        window=_window(window), law=law, ageing=ageing, interface=interface, title=title, reader=reader, holdout=tuple(holdout),
        rig={key: text for key, text in (("radius", radius), ("thickness", thickness), ("area", area)) if text},
    )  # fmt: skip
    return DraftResult(draft(places, Path(folder), wish, registry=registry), Path(folder))


def _drive(given: Any) -> list[tuple[float, float]] | float | None:
    """Return a drive as (duration, velocity) pairs in s and um/s, or as one velocity."""
    if given is None or isinstance(given, int | float):
        return None if given is None else float(given)
    if not isinstance(given, str):
        return as_pairs(given, "drive", "(duration, velocity) pairs, in s and um/s: [(60, 3), (60, 10)]")
    if not {":", ","} & {*given}:
        return parse_quantity(given, "um/s", name="`drive`")
    steps = []
    for part in given.split(","):
        if part.count(":") != 1:
            hint = "Write pieces with commas between them: `drive` '60:3, 60:10', in s and um/s."
            raise SrfError(f"`drive`: {part.strip()!r} is not DURATION:VELOCITY", hint)
        duration, velocity = part.split(":")
        steps.append((parse_quantity(duration, "s", name="`drive`"), parse_quantity(velocity, "um/s", name="`drive`")))
    return steps


def _window(given: tuple[float, float] | str | None) -> tuple[float, float] | None:
    if not isinstance(given, str):
        return given if given is None else as_pairs([given], "window", "two times in s of the file's clock: (100, 900)")[0]
    parts = given.replace(":", ",").split(",")
    if len(parts) != 2:
        raise SrfError(f"`window` {given!r} is not FROM,TO", "As in `window` 100,900, in s of the file's own clock.")
    begin, end = (parse_quantity(part, "s", name="`window`") for part in parts)
    return begin, end


@explained
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


@explained
def check(
    experiment: Experiment | Path | str,
    *,
    runs: Sequence[str] = (),
    simulate: bool = True,
    reader: str | None = None,
    plugins: Sequence[str | Path] = (),
    registry: Registry | None = None,
    progress: Callable[[str], None] = lambda run: None,
) -> CheckResult:
    """Return what an experiment's recordings are like, and what can be identified from them.

    Parameters
    ----------
    experiment : path or Experiment
        A folder with experiment.toml, or that file; or from `srfcli.read_experiment`.
    runs : sequence of str
        Names of runs; all if left out.
    simulate : bool
        Whether each run is simulated, to say what its load can tell.
    reader : str, optional
        Reader of all data files; each is told from its name and content if left out.
    plugins : sequence of path
        Folders in which laws and readers are looked for, too.
    registry : Registry, optional
        An open registry of laws and readers; loaded from `plugins` and the usual places if left out.
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
        experiment = description.read_experiment(Path(experiment), registry=registry, format=reader)
    experiment.check_recorded("to check")
    found = tuple(description.check_run(run) for run in experiment.named(runs))
    told = forecast(experiment, found, registry=registry, progress=progress) if simulate else None
    return CheckResult(experiment, found, told)


@explained
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
    reader: str | None = None,
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
        A folder with experiment.toml, or that file; or from `srfcli.read_experiment`.
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
    reader : str, optional
        Reader of all data files; each is told from its name and content if left out.
    plugins : sequence of path
        Folders in which laws and readers are looked for, too.
    registry : Registry, optional
        An open registry of laws and readers; loaded from `plugins` and the usual places if left out.
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
    check_choice("trend", trend, (*TRENDS, "none"))
    check_choice("by", by, BY)
    free, vary = None if free is None else as_names(free, "free"), as_names(vary, "vary")
    if starts < 1 or (sample is not None and sample < 2):
        raise SrfError("a fit has one start or more, and a sample two points or more", "As `starts` 4, `sample` 1000.")
    if track == "shared" and (profile or sample):
        raise SrfError("`track` shared does not go with `profile` or `sample`", "Leave it out, or name rough.")
    registry = registry or load_registry([Path(p) for p in plugins])
    if not isinstance(experiment, Experiment):
        experiment = description.read_experiment(Path(experiment), registry=registry, format=reader)
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


# Critical loads alone, as in the paper.


@explained
def fit_thresholds(
    table: Thresholds | Path | str,
    system: SlidingSystem,
    *,
    free: str | Sequence[str],
    rho: float | str = RHO.default,
    bounds: Mapping[str, tuple[float | str, float | str]] | None = None,
    methods: str | Sequence[str] = (),
    tol: float = 1e-6,
    max_evaluations: int | None = None,
    profile: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> ThresholdFitResult:
    """Return the parameters that minimise chi2 of measured critical loads, by the paper's method and by least squares.

    Each load is compared with the nearest of the model at which stability is lost. Both methods begin at the values of `system`
    and minimise the same cost.

    Parameters
    ----------
    table : path or Thresholds
        A CSV file with V (um/s), eps, W0c (N) and, if known, sigma (N), a line for each load.
    system : SlidingSystem
        The slider, from `srfcli.system`; the table gives V, eps and W0.
    free : str or sequence of str
        Parameters to fit, also 'rho'.
    rho : number or text
        Share of the modulation that reaches the asperities, 1 in full, or where its fit begins.
    bounds : mapping from parameter to (low, high), optional
        In declared units, or text with a unit; those of the law and a factor of ten around the start if left out.
    methods : str or sequence of str
        'powell', 'least-squares'; both if left out.
    tol : float
        Relative error of a computed load.
    max_evaluations : int, optional
        Most evaluations of the cost, for each method.
    profile : bool
        Whether the intervals are those of the profile likelihood.
    progress : callable
        Told the method, its evaluations and the lowest chi2 after each of them.

    Returns
    -------
    ThresholdFitResult
        `.values` and `.stderr` of the best method. Ctrl-C is a status: the best parameters so far.

    Raises
    ------
    SrfError
        For a table that cannot be read or has fewer loads than there are free parameters, an unknown parameter or method, and
        bounds that exclude the start.

    References
    ----------
    Cochard, Bureau and Baumberger (2003), Trans. ASME J. Appl. Mech. 70, 220: the procedure. Powell (1964), Comput. J. 7, 155.
    Branch, Coleman and Li (1999), SIAM J. Sci. Comput. 21, 1: the least squares.

    Examples
    --------
    >>> from pathlib import Path
    >>> import srfcli as srf
    >>> slider = srf.system()
    >>> true = srf.linear(slider, over={"V": [1, 5, 20, 60]}).table.records()
    >>> _ = Path("loads.csv").write_text("V,eps,W0c\\n" + "".join(f"{x['V']},0,{x['W0']}\\n" for x in true))
    >>> found = srf.fit_thresholds("loads.csv", slider.at(D0=0.5), free="D0", methods="least-squares")
    >>> round(found.values["D0"], 4)
    0.402
    """
    if max_evaluations is not None and max_evaluations < 1:
        raise SrfError(f"`max_evaluations` {max_evaluations}: a fit has one or more", "Leave it out.")
    if not isinstance(table, Thresholds):
        table = read_thresholds(Path(table))
    known = system.resolved
    if RHO.name not in known.values:
        own = {name: value for name, value in known.declared.items() if known.origins[name] != "law default"}
        known = resolve((*known.parameters, RHO), {**own, RHO.name: rho}, env={}, where=system.title)
    units = {p.name: p.unit for p in known.parameters}
    scale = free_parameters(
        known.parameters, free.split(",") if isinstance(free, str) else free, start=known.values, where=system.title,
        bounds={name: _ends(name, pair, units.get(name, "1")) for name, pair in (bounds or {}).items()},
        largest_eps=float(table.eps.max()),
    )  # fmt: skip
    chosen = [methods] if isinstance(methods, str) else methods
    found = thresholds.fit_thresholds(
        system.model, table, scale=scale, values=known.values, methods=chosen or thresholds.FIT_METHODS, tol=tol, profile=profile,
        max_evaluations=max_evaluations or thresholds.MAX_EVALUATIONS,
        report=lambda trace: progress(f"{trace.method}, evaluation {len(trace)}: chi2 {trace.best[-1]:.6g}"),
    )  # fmt: skip
    held = {name: value for name, value in known.described().items() if name not in GIVEN}
    return ThresholdFitResult(found, system.title, held)


def _ends(name: str, pair: Any, unit: str) -> tuple[float, float]:
    """Return bounds, numbers in their declared unit or text with a unit, in um, s, N."""
    try:
        low, high = (to_base(parse_quantity(x, unit, name=name) if isinstance(x, str) else float(x), unit) for x in pair)
    except (TypeError, ValueError):
        raise SrfError(f"`bounds` of {name}: {pair!r} is no pair of numbers", f"Like {{'{name}': (1, 10)}}.") from None
    return low, high


# A campaign: many experiments, a row each, whatever becomes of the others.

STEADY_TAIL = 1 / 3  # of a segment, at its end, that is checked for steady sliding
LONG_ENOUGH = 2.0  # slip lengths that this part must be long
SURE = 3.0  # standard errors from which a slope is significant
DRIFT = 0.02  # of B (A where it is larger) that friction may change by over a slip length in steady sliding
BAD_FIT = 1.3  # residual rms over noise from which the fit is flagged


@dataclass(frozen=True)
class Task:
    """One experiment and how it is fitted; `digest` is of its description and data, so that a changed one is fitted anew."""

    path: str
    options: tuple[tuple[str, Any], ...]
    reader: str | None
    plugins: tuple[str, ...]
    digest: str


@explained
def fit_campaign(
    paths: Sequence[str | Path],
    *,
    options: Mapping[str, Any] | None = None,
    reader: str | None = None,
    plugins: Sequence[str | Path] = (),
    run: Runner = run_here,
    done: Callable[[CampaignResult], None] = lambda so_far: None,
) -> CampaignResult:
    """Return the fits of many experiments, a row each in the order of `paths`.

    Parameters
    ----------
    paths : sequence of path
        Folders with an experiment.toml, or these files.
    options : mapping, optional
        Keyword arguments of `fit` for each of them: free, trend, track, starts, seed.
    reader : str, optional
        Reader of all data files.
    plugins : sequence of path
        Folders in which laws and readers are looked for, too.
    run : callable
        Spreads the work, as `srfcli.core.parallel` does; one after the other in this process if left out.
    done : callable
        Told the rows so far after each experiment.

    Returns
    -------
    CampaignResult
        An experiment that cannot be read or fitted has a row with its reason. Ctrl-C keeps the rows that are done.

    Raises
    ------
    SrfError
        For an option that `fit` does not have.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import srfcli as srf
    >>> Path("one").mkdir()
    >>> mu = 0.6 + np.random.default_rng(1).normal(0, 2e-4, 200)
    >>> lines = ["time [s],load_point_velocity [um/s],friction", *(f"{0.1 * i:.1f},3,{x}" for i, x in enumerate(mu))]
    >>> _ = Path("one/run.csv").write_text("\\n".join(lines))
    >>> srf.new_experiment("one/run.csv", stiffness="3e-2 1/um", load="10 MPa", folder="one").write()
    >>> found = srf.fit_campaign(["one", "two"], options={"track": "smooth", "free": ["mu0"]})
    >>> [(row["experiment"], row["status"]) for row in found.table.records()]
    [('one', 'ok'), ('two', 'failed')]
    """
    for name in options or {}:
        check_choice("options", name, tuple(inspect.signature(fit).parameters))
    tasks = [
        Task(str(p), tuple(sorted((options or {}).items())), reader, tuple(map(str, plugins)), _digest(Path(p))) for p in paths
    ]
    rows: dict[int, dict[str, Any]] = {}

    def so_far(status: Status = Status.OK) -> CampaignResult:
        worst = Status.NO_CONVERGENCE if any(r["status"] != Status.OK.value for r in rows.values()) else Status.OK
        return CampaignResult([rows[k] for k in sorted(rows)], len(tasks), worst if status is Status.OK else status)

    try:
        for index, kept in run(fit_one, tasks):
            rows[index] = json.loads(np.asarray(kept["row"]).tobytes().decode("utf-8"))
            done(so_far())
    except KeyboardInterrupt:
        return so_far(Status.INTERRUPTED)
    return so_far()


def _digest(path: Path) -> str:
    """Return a hash of the description, and of size and time of the files beside it; "" where nothing can be read."""
    file = path / "experiment.toml" if path.is_dir() else path
    try:
        parts = [file.read_bytes()]
        for other in sorted(file.parent.glob("*")):
            told = other.stat()
            parts.append(f"{other.name} {told.st_size} {told.st_mtime_ns}".encode())
    except OSError:
        return ""
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


def fit_one(task: Task) -> dict[str, Any]:
    """Return the row of one experiment as JSON in an array of bytes, as stores and workers carry it."""
    try:
        registry = load_registry([Path(p) for p in task.plugins])
        experiment = read_experiment(task.path, format=task.reader, registry=registry)
        experiment.check_recorded("for a row")
        found = fit(experiment, registry=registry, **dict(task.options))
        if found.worst is Status.INTERRUPTED:
            raise KeyboardInterrupt
        row = _row(task.path, found)
    except SrfError as error:
        row = _failed(task.path, error.message)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        row = _failed(task.path, f"nothing can be computed at these values: {' '.join(str(error).split())[:200]}")
    except Exception as error:  # one experiment must not cost the others
        row = _failed(task.path, f"unexpected {type(error).__name__}: {' '.join(str(error).split())[:200]}")
    return {"row": np.frombuffer(json.dumps(row).encode("utf-8"), dtype=np.uint8)}


def _failed(path: str, reason: str) -> dict[str, Any]:
    return {"experiment": path, "status": "failed", "reason": reason}


def _row(path: str, found: FitResult) -> dict[str, Any]:
    experiment, problem, result = found.experiment, found.found.problem, found.found.fit
    runs = [run for run in experiment.runs if not run.holdout]
    table = {row[0]: row for row in found.table.rows}
    listed = {q.name for q in experiment.parameters}
    own = [name for name in result.names if name in listed]
    parameters = {name: (table[name][1], plain_value(table[name][2]), table[name][5]) for name in own}
    values = found.values_with_means
    for name, mean, error, _, unit, _ in found.varied.rows if found.varied else ():  # without an error where one is at its bound
        shown = from_base(values[name], unit) if mean is None else mean
        parameters[name] = (shown, plain_value(error), unit)
    place = {name: k for k, name in enumerate(result.names)}
    covariance = np.asarray(result.covariance)
    unit, factor = experiment.shown("1/um" if experiment.per_load else "N/um")

    def shared(a: str, b: str) -> float | None:
        if not {a, b} <= place.keys() or math.inf in (result.stderr[a], result.stderr[b]):
            return None
        scale = math.prod([factor if name == "K" else from_base(1.0, problem.unit_of(name)) for name in (a, b)])
        return plain_value(float(covariance[place[a], place[b]]) * scale)

    row: dict[str, Any] = {
        "experiment": path, "status": found.worst.value, "law": f"{experiment.choice.law}, {experiment.choice.ageing}",
        "runs": len(runs), "samples": sum(int(run.used.sum()) for run in runs),
        "load": float(np.mean([run.load(run.t)[0].mean() for run in runs])) if all(run.load_known for run in runs) else None,
        "load_unit": runs[0].load_unit if runs[0].load_known else None,
        "parameters": parameters, "rms_over_noise": plain_value(result.rms_over_noise()),
        "covariances": {name: shared(*pair) for name, pair in PAIRS.items()},
    }  # fmt: skip
    row["V0"] = next((q.value for q in experiment.parameters if q.name == "V0"), None)
    V = np.concatenate([np.abs(run.drive(run.t)) for run in runs])
    row |= {"V_min": float(V.min()), "V_max": float(V.max())}
    if found.difference is not None:
        row["A_minus_B"], row["A_minus_B_stderr"] = found.difference
    own_stiffness = runs[0].stiffness / (runs[0].first_load if experiment.per_load else 1.0)
    stated = float(values.get("K", own_stiffness))
    row |= {"k": stated * factor, "k_unit": unit, "k_stderr": parameters["K"][1] if "K" in parameters else None}
    length = float(values.get("D0", 10.0))
    allowed = DRIFT * max(abs(values.get("A", 0.0)), abs(values.get("B", 0.0))) / length
    every = [s for run in runs for s in _slopes(run, length)]
    found_slopes = [s for s in every if s is not None]
    steady = [not (abs(slope) > SURE * error and abs(slope) > allowed) for slope, error in found_slopes]
    sure = [slope for slope, error in found_slopes if abs(slope) > SURE * error]
    row |= {
        "segments": len(steady),
        "short": len(every) - len(steady),
        "steady": sum(steady),
        "final_slope": 1e3 * max(sure, key=abs) if sure else None,
    }
    row["flags"] = "; ".join(_flags(row, found))
    return row


def _flags(row: Mapping[str, Any], found: FitResult) -> Iterator[str]:
    if not found.worst.ok:
        yield "the maximum was not reached"
    yield from (f"{line[0]} {line[-1]}" for line in found.table.rows if line[-1])
    yield from found.against
    yield from filter(None, [found.experiment.rescaled()])
    for name, scatter in found.found.scatter.items():
        apart = f", which scatter by {scatter.scatter / abs(scatter.mean):.0%} beyond their errors" if scatter else ""
        yield f"{name} is the mean of {len(found.found.problem.groups[name])} groups{apart}"
    if row["steady"] < row["segments"]:
        yield f"friction still changes with slip at the end of {row['segments'] - row['steady']} of {row['segments']} segments"
    if not row["segments"]:
        yield "no segment is long enough to say whether it ends in steady sliding"
    elif row["short"]:
        which = "is too short to say whether it ends" if row["short"] == 1 else "are too short to say whether they end"
        yield f"{row['short']} of {row['short'] + row['segments']} segments {which} in steady sliding"
    if row["rms_over_noise"] is not None and row["rms_over_noise"] > BAD_FIT:
        yield f"residual {row['rms_over_noise']:.2g} times the noise"


def _slopes(run: Run, length: float) -> Iterator[tuple[float, float] | None]:
    """Yield d mu/d slip (1/um) and its error for the end of each segment of constant velocity, None where it is too short."""
    mu = run.friction
    for begin, end in pairwise(run.edges):
        V, rate, _ = run.drive.piece(begin)
        part = (run.t >= end - STEADY_TAIL * (end - begin)) & (run.t <= end) & run.used
        if rate or V <= 0:
            continue
        if V * STEADY_TAIL * (end - begin) < LONG_ENOUGH * length or part.sum() < 16:
            yield None
            continue
        x = V * (run.t[part] - run.t[part].mean())
        y = mu[part] - mu[part].mean()
        slope = float(x @ y / (x @ x))
        rest = y - slope * x
        rho = float(np.clip(lag_one(rest, [(0, rest.size)]), 0.0, 0.99))
        error = float(np.sqrt(rest @ rest / (rest.size - 2) / (x @ x) * (1 + rho) / (1 - rho)))
        yield slope, error
