"""`simulate`: records of one slider over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from srfcli.core.errors import SrfError, Status, did_you_mean, worst
from srfcli.data.description import MOST_OBSERVABLES
from srfcli.data.values import BESIDE, OBSERVABLES
from srfcli.motion import simulate as integrate
from srfcli.motion.imposed import ConstantLoad, Drive, Load, LoadSteps, ModulatedLoad, Modulation
from srfcli.results.simulation import RISE, Gauge, Job, Record, SimulationResult, Work, measure, observe

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from srfcli.codegen.slider import SlidingSystem
    from srfcli.data.values import Experiment



def simulate(
    system: SlidingSystem,
    *,
    t: ArrayLike,
    drive: Drive | Sequence[tuple[float, float]] | None = None,
    load: Load | Sequence[tuple[float, float]] | None = None,
    onset: float | None = None,
    start: ArrayLike | None = None,
    observable: str | Sequence[str] = "elongation",
    rtol: float = 1e-8,
) -> SimulationResult:
    """Return what a slider does under a program of driving velocity and load.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`; with eps above 0 the load is modulated at f.
    t : array (n,)
        Times of the samples in s, rising.
    drive : Drive or sequence of (time, velocity), optional
        Driving velocity in um/s, from each time (s) on; the system's V if left out. 0 is a hold.
    load : Load or sequence of (duration, load), optional
        Normal load in N for each duration (s), steps rounded over 0.02 s; the system's W0 if left out.
    onset : float, optional
        When the modulation begins to rise, in s; at the first sample if left out.
    start : array (n_states,), optional
        State at the first sample, as the model orders it; steady sliding at the first velocity if left out.
    observable : {'elongation', 'force', 'friction'} or sequence of str
        What the apparatus records, in um, N or 1; of several, others or 'slip' (um) and 'contact_area' (1) after the first.
    rtol : float
        Local relative error of integration, from 1e-13 to 1e-2.

    Returns
    -------
    SimulationResult
        Where integration stopped early its status says so, and what was reached is kept.

    Raises
    ------
    SrfError
        For times that do not rise, a drive that begins at rest without `start`, or a load that is not above 0.

    References
    ----------
    Hairer and Wanner (1996), Solving Ordinary Differential Equations II: Radau IIA of order 5.

    Examples
    --------
    >>> import numpy as np
    >>> import srfcli as srf
    >>> run = srf.simulate(srf.system(W0=5), t=np.linspace(0, 2, 201), drive=[(0, 10), (1, 20)])
    >>> float(run.records[0].trace.mu[-1].round(3))
    0.431
    """
    times = np.asarray(t, float)
    if times.ndim != 1 or times.size < 2 or not (np.diff(times) > 0).all():
        raise SrfError("t is no rising list of times", "Like numpy.linspace(0, 4, 4001), in s.")
    first, *beside = check_observables([observable] if isinstance(observable, str) else list(observable))
    if not 1e-13 <= rtol <= 1e-2:
        raise SrfError(f"rtol = {rtol:g} is out of range", "Choose it between 1e-13 and 1e-2, as 1e-8.")
    system.model.check_changing_load(system.vector())
    values, begin, end = system.resolved.values, float(times[0]), float(times[-1])
    moved = Drive.constant(values["V"]) if drive is None else drive if isinstance(drive, Drive) else Drive.steps(drive)
    if start is None and not float(moved(times[:1])[0]) > 0:
        raise SrfError(
            "the drive begins at rest: there is no steady sliding to start from", "Give start, or move first."
        )
    pressed: Load
    if isinstance(load, Load):
        pressed = load
    elif load is None:
        pressed = ConstantLoad(values["W0"])
    else:
        pressed = LoadSteps.sequence([(length, W, W) for length, W in load], start=begin, rise=RISE)
    f, eps = (values["f"] if values["eps"] else None), values["eps"]
    since = begin if onset is None else onset
    if f is not None:
        plain = isinstance(pressed, ConstantLoad)
        wave = Modulation(pressed.W0 if isinstance(pressed, ConstantLoad) else 1.0, eps, f, onset=since)
        pressed = wave if plain else ModulatedLoad(pressed, wave)
    pressed.check(begin, end)
    model = system.model
    job = Job(
        "simulated", model.vector(values), moved, pressed, times, None if start is None else np.asarray(start, float),
        first, f, None if f is None else (f, eps, since), beside=tuple(beside),
    )  # fmt: skip
    replaced = [*(["V"] if drive is not None else []), *(["W0"] if load is not None else [])]
    return simulate_work(Work(model, (job,), Gauge(), system.described(without=replaced), _none), rtol=rtol)


def check_observables(names: Sequence[str]) -> list[str]:
    """Return the names of observables, which must be known; the first is one of the spring."""
    for number, name in enumerate(names):
        if name not in OBSERVABLES | BESIDE:
            raise SrfError(f"unknown observable {name!r}", did_you_mean(name, OBSERVABLES | BESIDE))
        if number == 0 and name in BESIDE:
            raise SrfError(f"{name} needs an elongation, a force or a friction before it", f"As force,{name}.")
        if name in names[:number]:
            raise SrfError(f"the observable {name!r} is named twice", "Name each once.")
    if not 1 <= len(names) <= MOST_OBSERVABLES:
        raise SrfError(f"{len(names)} observables", f"Name one to {MOST_OBSERVABLES}.")
    return list(names)


def _none(records: Sequence[Record]) -> Experiment:
    raise SrfError(
        "a simulation from Python is not written as an experiment", "`srf simulate --out-dir DIR` writes one."
    )


def simulate_work(
    work: Work, *, rtol: float = 1e-8, progress: Callable[[str, bool], None] = lambda name, done: None
) -> SimulationResult:
    """Return the records of prepared work; `progress` is told the name of each, before and after it was simulated."""
    records: list[Record] = []
    try:
        for job in work.jobs:
            progress(job.name, False)
            trace = integrate.simulate(
                work.model,
                job.p,
                drive=job.drive,
                load=job.load,
                t=job.t,
                start=job.start,
                tables=job.tables,
                rtol=rtol,
            )
            observed = observe(work.model, job, trace, job.observable)
            others = []
            for name in job.beside:
                shown = observe(work.model, job, trace, name)
                read = measure(work.others[name], job, shown, name) if name in work.others else None
                others.append(shown if read is None else read)
            records.append(Record(job, trace, observed, measure(work.gauge, job, observed), tuple(others)))
            progress(job.name, True)
    except KeyboardInterrupt:
        return SimulationResult(work, tuple(records), Status.INTERRUPTED)
    return SimulationResult(work, tuple(records), worst([r.trace.status for r in records]))
