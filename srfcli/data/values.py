"""The values that reading an experiment gives: frozen, in um, s, N."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import Array
from srfcli.core.errors import Notice, SrfError, did_you_mean
from srfcli.core.units import factor_between, find_unit, split_quantity, to_base
from srfcli.data.clock import Sampling, find_sampling
from srfcli.data.thresholds import Thresholds
from srfcli.motion.imposed import Drive, Load, UnknownLoad

OBSERVABLES = {"elongation": "um", "force": "N", "friction": "1"}
OTHER_OBSERVABLES = {"slip": "um", "contact_area": "1"}  # what may be observed besides one of these
BETWEEN_SAMPLES = ("drive-steps", "load-steps")  # kinds of notices of what was imposed between samples, unknown when
BOUND_FACTOR = 5.0  # from a value, or a law's default, to the bounds of a fit
AREA_GROWTH = 0.05  # of a contact area by e-fold of its age: 0.02 to 0.1 for rock, glass and polymers


def per_elongation(observable: str, K: float, W: Array | float) -> Array | float:
    """Return what an observable is for each um of the spring's elongation, under the stiffness K (N/um) and the load W (N)."""
    return {"elongation": 1.0, "force": K, "friction": K / W}[observable]


Declared = tuple[float, float, float] | tuple[float, float, float, float, float]  # a modulation, without or with phase and rise


@dataclass(frozen=True)
class ModelChoice:
    """The names that `open_model` takes: friction law, ageing law with modifiers, interface, whether mass counts, effects."""

    law: str
    ageing: str
    interface: str
    inertia: bool
    effects: tuple[str, ...] = ()

    def plus(self, effects: Iterable[str]) -> ModelChoice:
        """Return the choice with these effects besides."""
        return replace(self, effects=(*self.effects, *effects))


@dataclass(frozen=True)
class FitParameter:
    """A parameter's start value and bounds in um, s, N; `unit` is the one it is declared in.

    Where `runs` are named it acts in these alone, and is `elsewhere` in the others.
    """

    name: str
    value: float
    lower: float
    upper: float
    fixed: bool
    unit: str
    runs: tuple[str, ...] = ()
    elsewhere: float = 0.0


@dataclass(frozen=True)
class Signal:
    """One observable of a run: its readings (n,) in um, N or 1, which of them are used, and the step by which it is quantised."""

    observable: str
    observed: Array = field(repr=False)
    used: NDArray[np.bool_] = field(repr=False)
    quantum: float


@dataclass(frozen=True)
class Run:
    """One recording: times (n,) in s that rise strictly, the observable (n,) in um, N or 1, and what was imposed.

    `observed` is finite everywhere; where `used` is False it is a placeholder and a notice says why. `drive` and `load` hold
    on all of [t[0], t[-1]]. `start` is the place on the track in um, `initial` "steady" or "free", `stiffness` K in N/um,
    `modulation` the declared frequency (Hz), relative amplitude, onset (s), and, if given, phase (deg) and rise (s), `quantum`
    the quantisation step, or 0.
    `others` are what was observed at the same times besides.
    `proposed` is the observable as the corrections that are proposed would make it, None where there are none; `drive_resets`
    are the times (s) at which the load point's displacement jumps, where it is proposed to take that out.
    `backward` where drive and observable count with the opposite sign, `segments` are the times (s) at which it may be cut.
    `stress` where stresses were recorded: a stress counts as the force on 1 mm^2, so that what is in N is in MPa.
    """

    name: str
    file: Path
    holdout: bool
    start: float
    initial: str
    t: Array = field(repr=False)
    observed: Array = field(repr=False)
    observable: str
    used: NDArray[np.bool_] = field(repr=False)
    drive: Drive = field(repr=False)
    load: Load = field(repr=False)
    stiffness: float
    modulation: Declared | None
    quantum: float
    notices: tuple[Notice, ...]
    stress: bool = False
    proposed: Array | None = field(default=None, repr=False)
    others: tuple[Signal, ...] = ()
    backward: bool = False
    segments: tuple[float, ...] = ()
    drive_resets: tuple[float, ...] = ()

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Return all that was observed, the observable first."""
        return (Signal(self.observable, self.observed, self.used, self.quantum), *self.others)

    @property
    def unit(self) -> str:
        """Return the unit of the observable as it is shown: um, N, MPa or 1."""
        return self.unit_of(self.observable)

    def unit_of(self, observable: str) -> str:
        """Return the unit in which an observable of this run is shown: um, N, MPa or 1."""
        return shown_unit((OBSERVABLES | OTHER_OBSERVABLES)[observable], stress=self.stress)

    @cached_property
    def sampling(self) -> Sampling:
        """Return the rates at which the run was sampled."""
        return find_sampling(self.t)

    def thinned(self, every: int) -> Run:
        """Return every so-many-th reading of the run."""
        return self.part(slice(None, None, every))

    def part(self, which: slice) -> Run:
        """Return the run with these of its readings alone; drive and load are as they were."""
        own = {n: getattr(self, n)[which] for n in ("t", "observed", "used")}
        others = tuple(replace(s, observed=s.observed[which], used=s.used[which]) for s in self.others)
        return replace(self, **own, others=others, proposed=None if self.proposed is None else self.proposed[which])

    @property
    def edges(self) -> list[float]:
        """Return the times (s) at which the pieces of the drive begin within the run, and its end."""
        begin, end = float(self.t[0]), float(self.t[-1])
        return [begin, *(b for b in self.drive.breaks if begin < b < end), end]

    @property
    def first_load(self) -> float:
        """Return the load (N) at the first sample, without a modulation."""
        return self.load.rest(float(self.t[0]))

    def friction_factor(self, W: Array | float) -> Array | float:
        """Return what the observable is multiplied by to be a friction coefficient under the loads W (N)."""
        return {"elongation": self.stiffness / W, "force": 1 / W, "friction": np.ones_like(W)}[self.observable]

    @property
    def friction(self) -> Array:
        """Return the friction coefficient of each reading (n,), by the stated stiffness."""
        return np.asarray(self.observed * self.friction_factor(self.load(self.t)[0]))

    @property
    def load_known(self) -> bool:
        """Return whether the load was recorded or stated, not friction alone."""
        return not isinstance(self.load, UnknownLoad)

    @property
    def load_unit(self) -> str:
        """Return the unit of the load as it is shown: N or MPa."""
        return shown_unit("N", stress=self.stress)

    @property
    def quantity(self) -> str:
        """Return what is observed, in words: elongation, force, shear stress or friction coefficient."""
        return self.quantity_of(self.observable)

    def quantity_of(self, observable: str) -> str:
        """Return an observable of this run in words."""
        names = {"force": "shear stress" if self.stress else "force", "friction": "friction coefficient"}
        return names.get(observable, observable.replace("_", " "))


@dataclass(frozen=True)
class CriticalLoads:
    """A table of critical loads that were measured with the apparatus; `frequency` is that of their modulation in Hz."""

    name: str
    file: Path
    holdout: bool
    frequency: float
    table: Thresholds = field(repr=False)


@dataclass(frozen=True)
class Experiment:
    """Runs and critical loads under one apparatus and one model; `mass` in N s^2/um, None for a quasi-static slider.

    Parameters in `vary` have a value for each run, load, segment or direction, as that says of each; `by` is what they vary with
    unless it is said. Observables drift with slip or time where there is a `trend`.

    Attributes
    ----------
    path : path
        The folder's experiment.toml.
    choice : ModelChoice
        The laws that are believed.
    mass : float or None
        Mass of the slider in N s^2/um (1 kg is 1e-6).
    stiffness_text : str
        Stiffness of the apparatus, as the description has it.
    parameters : tuple of FitParameter
        Start values and bounds in um, s, N, and whether each is held fixed.
    runs : tuple of Run
        The recordings: times (n,) in s, observables (n,) in um, N or 1.
    notices : tuple of Notice
        What is odd in the description.
    thresholds : tuple of CriticalLoads
        Tables of critical loads.
    """

    path: Path
    title: str
    choice: ModelChoice
    mass: float | None
    stiffness_text: str
    parameters: tuple[FitParameter, ...]
    runs: tuple[Run, ...]
    notices: tuple[Notice, ...]
    stiffness_unit: str = ""
    vary: Mapping[str, str] = field(default_factory=dict)
    by: str = "run"
    trend: str | None = None
    thresholds: tuple[CriticalLoads, ...] = ()

    @property
    def files(self) -> tuple[Path, ...]:
        """Return the files of recordings and tables, each once."""
        return tuple(dict.fromkeys([*(run.file for run in self.runs), *(table.file for table in self.thresholds)]))

    def check_recorded(self, purpose: str) -> None:
        """Raise SrfError where there is no recording, only critical loads."""
        if not self.runs:
            raise SrfError(f"{self.path} holds critical loads and no recordings {purpose}", "Take `srf fit` or `srf diagnose`.")

    def named(self, names: Sequence[str]) -> tuple[Run, ...]:
        """Return the runs of these names, all where none is given; raises SrfError for a name that no run has."""
        known = [run.name for run in self.runs]
        for name in names:
            if name not in known:
                raise SrfError(f"`runs`: no run {name!r} in {self.path}", did_you_mean(name, known))
        return tuple(run for run in self.runs if not names or run.name in names)

    def elsewhere(self, run: Run) -> dict[str, float]:
        """Return the parameters that act in other runs alone, at what they are in this one."""
        return {q.name: q.elsewhere for q in self.parameters if q.runs and run.name not in q.runs}

    def fitted(self) -> Experiment:
        """Return the experiment without what is held out."""
        runs = tuple(run for run in self.runs if not run.holdout)
        return replace(self, runs=runs, thresholds=tuple(table for table in self.thresholds if not table.holdout))

    @cached_property
    def stated_stiffness(self) -> tuple[float, str]:
        """Return number and unit of the stiffness, as they are stated."""
        return split_quantity(self.stiffness_text, name="stiffness")

    @property
    def shown_stiffness(self) -> tuple[float, str]:
        """Return number and unit of the stiffness, as they are shown."""
        number, stated = self.stated_stiffness
        unit, factor = self.shown(stated) if stated in ("N/um", "1/um") else (stated, 1.0)
        return number * factor, unit

    @property
    def stiffness(self) -> float:
        """Return the stated stiffness in N/um, or in 1/um where it is friction per micron."""
        return to_base(*self.stated_stiffness)

    @cached_property
    def per_load(self) -> bool:
        """Return whether the stiffness is stated in 1/um, as friction per micron."""
        return not find_unit(self.stated_stiffness[1]).powers[2]

    @property
    def stress(self) -> bool:
        """Return whether stresses were recorded, so that forces are shown in MPa."""
        return any(run.stress for run in self.runs)

    def rescaled(self) -> str:
        """Return a sentence on what a stiffness stated in 1/um is under each run's load; "" for any other stiffness."""
        if not self.per_load:
            return ""
        number, unit = self.stated_stiffness
        under: dict[str, str] = {}
        for run in self.runs:
            W = run.first_load
            told = f"{run.stiffness:.4g} {run.load_unit}/um under {W:.4g} {run.load_unit}"
            if W != 1.0 and told not in under:
                under[told] = run.name
        if not under:
            return ""
        listed = ", ".join(f"{told} in {name}" for told, name in list(under.items())[:6])
        more = ", ..." if len(under) > 6 else ""
        apart = "; a machine's own stiffness does not grow with the load: state it in MPa/um or N/um" if len(under) > 1 else ""
        return f"the stiffness of {number:g} {unit} counts for each run's first load: {listed}{more}{apart}"

    def shown(self, unit: str) -> tuple[str, float]:
        """Return the unit that a quantity declared in `unit` is shown in, and the factor to it: a stiffness as it was stated."""
        if self.stiffness_unit and unit in ("N/um", "1/um"):
            factor = factor_between(find_unit(unit), find_unit(self.stiffness_unit))
            if factor is not None:
                return self.stiffness_unit, factor
        return shown_unit(unit, stress=self.stress), 1.0


def shown_unit(unit: str, *, stress: bool) -> str:
    """Return a unit of N as one of MPa where stresses were recorded."""
    return unit.replace("N", "MPa") if stress and unit in ("N", "N/um", "N/s") else unit


def told_of_runs(runs: Iterable[Run], kinds: Collection[str]) -> list[str]:
    """Return what notices of these kinds say, each kind once: of its first run, with the names of the others that have it."""
    told: dict[str, list[tuple[str, Notice]]] = {}
    for run in runs:
        for notice in run.notices:
            if notice.kind in kinds:
                told.setdefault(notice.kind, []).append((run.name, notice))
    lines = []
    for (first, notice), *more in told.values():
        names = list(dict.fromkeys(name for name, _ in more))
        where = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
        lines.append(f"{first}: {notice}" + (f"; {len(more)} more of this kind, in {where}" if more else ""))
    return lines
