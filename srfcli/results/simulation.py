"""Simulated records: rows, sentences, curves, and the experiment that they make."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import GeneratedModel
from srfcli.codegen.splines import Spline, appended
from srfcli.core.errors import SrfError, Status
from srfcli.data.noise import measured
from srfcli.data.values import AREA_GROWTH, OBSERVABLES, Declared, Experiment, Run, Signal, shown_unit
from srfcli.motion.imposed import Drive, Load
from srfcli.motion.simulate import Trace, stick_slip
from srfcli.results import plots
from srfcli.results.figures import envelope
from srfcli.results.tables import Column, Result, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    Array = NDArray

MANY_BREAKS = 50  # a recorded load has knots, not changes
OSCILLATION_SAMPLES = 20  # show no oscillation
OTHERS = (  # what a record has beside the first observable, where it is asked for
    Column("elongation", "um", "what another gauge shows"),
    Column("force", "N", "what another gauge shows"),
    Column("friction", "1", "what another gauge shows"),
    Column("slip", "um", "slip of the slider since the first sample"),
    Column("contact_area", "1", "contact area over that of contacts of 1 s"),
)
STICK = 0.1  # of the driving velocity: a cycle whose slowest slip is below it sticks


@dataclass(frozen=True)
class Job:
    """One record to simulate: the parameters `p` (n_parameters,), what is imposed, and what is compared or written.

    `run` is the recording that it repeats, None for a record of one's own; `tables` are those of the model, if it has any: the
    track.
    """

    name: str
    p: Array
    drive: Drive
    load: Load
    t: Array
    start: Array | None
    observable: str
    modulation: Declared | None = None
    run: Run | None = None
    tables: tuple[Spline, ...] = ()
    beside: tuple[str, ...] = ()  # observables besides

    @property
    def load_known(self) -> bool:
        """Return whether the load was stated or recorded."""
        return self.run is None or self.run.load_known

    def shown(self, unit: str) -> str:
        """Return a unit as it is shown: MPa for N in a recording of stresses."""
        return shown_unit(unit, stress=self.run is not None and self.run.stress)


@dataclass(frozen=True)
class Record:
    """A job done: its trace up to where it got, the clean observable and, where a gauge was asked for, its readings.

    `others` are, of each observable besides, the readings or, without a gauge, what it would show.
    """

    job: Job
    trace: Trace
    observed: Array
    measured: Array | None
    others: tuple[Array, ...] = ()

    @property
    def done(self) -> int:
        """Return the number of samples that were reached."""
        reached = np.isfinite(self.trace.x).all(axis=1)
        return int(reached.size if reached.all() else np.argmin(reached))


def observe(model: GeneratedModel, job: Job, trace: Trace, observable: str) -> Array:
    """Return what the apparatus would record: the spring's elongation (um), its force (N), that over the load, and the like.

    The job's own observable is what a gauge shows, where an effect stands between the two. The slip (um)
    is that of the slider since the first sample, the contact area grows by AREA_GROWTH by e-fold of its age in s.
    """
    if observable == "contact_area":
        return np.asarray(trace.W / trace.W[0] * (1 + AREA_GROWTH * trace.state("ln_phi")))
    if observable == "slip":
        return np.asarray(job.drive.displacement(trace.t) - (trace.u - trace.u[0]))
    K, u = np.asarray(job.p[model.index("K")]), trace.u
    shown = _along(model, job, trace, "reading" if observable == job.observable else "stiffness")
    if shown is not None:
        u, K = (shown, K) if observable == job.observable else (u, shown)
    if observable == "elongation":
        return u
    return K * u if observable == "force" else K * u / trace.W


def _along(model: GeneratedModel, job: Job, trace: Trace, name: str) -> Array | None:
    """Return a function of a model with effects along a trace, None where the model has none of that name."""
    function = model.namespace.get(name)
    if function is None:
        return None
    W0 = dict.fromkeys(["W0"], job.load.rest(float(job.t[0])))
    p = model.vector(dict(zip(model.names, job.p.tolist(), strict=True)) | W0)
    return np.asarray(function(trace.x, trace.V, trace.W, np.zeros_like(trace.W), appended(p, job.tables)))


@dataclass(frozen=True)
class Gauge:
    """What stands between the slider and the file: noise, its lag-1 correlation, a step of rounding; the seed of all chance.

    Both sizes are in the unit of the observable, 0 for none.
    """

    noise: float = 0.0
    lag1: float = 0.0
    quantum: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Work:
    """What is to be simulated, and what is needed to tell and to write it.

    `gauges` are those of the observables, by name; one that is not named reads exactly. `experiment` is what the records are
    written as, without its runs, None where they are not; `remarks` are to be made when it is written.
    """

    model: GeneratedModel
    jobs: tuple[Job, ...]
    parameters: Mapping[str, Mapping[str, Any]]
    gauges: Mapping[str, Gauge] = field(default_factory=dict)
    experiment: Experiment | None = None
    remarks: tuple[str, ...] = ()
    inputs: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    meta: Mapping[str, Any] = field(default_factory=dict)


def measure(work: Work, job: Job, trace: Trace, observed: Array, observable: str) -> Array | None:
    """Return an observable through its gauge, None where it reads exactly; each run and each observable has its own noise."""
    gauge = work.gauges.get(observable, Gauge())
    if not (gauge.noise or gauge.quantum):
        shown = _along(work.model, job, trace, "reading") if observable == job.observable else None
        return None if shown is None or np.allclose(shown, trace.u, rtol=1e-12, atol=0.0, equal_nan=True) else observed
    stream = job.name if observable == job.observable else f"{job.name} {observable}"
    return measured(observed, **asdict(gauge), stream=stream)


@dataclass(frozen=True, repr=False, eq=False)
class SimulationResult(Result):
    """Records of one slider over time.

    Attributes
    ----------
    work : Work
        What was to be simulated.
    records : tuple of Record
        What was finished: each with its trace in um, s, N and the observable.
    worst : Status
        The first status that is not ok, INTERRUPTED where the simulation was stopped.
    """

    work: Work = field(repr=False)
    records: tuple[Record, ...] = field(repr=False)
    worst: Status = Status.OK

    @property
    def experiment(self) -> Experiment:
        """Return the experiment that the records are written as; raises SrfError where nothing says what it is of."""
        if self.work.experiment is None:
            raise SrfError("the records have no experiment to be written as", "`srf simulate --out-dir DIR` writes one.")
        return replace(self.work.experiment, runs=tuple(_simulated_run(self.work, r) for r in self.records))

    @cached_property
    def table(self) -> Table:
        """Return the records one below the other, a row for each sample: what was imposed, how it slid, what was recorded."""
        model, jobs = self.work.model, self.work.jobs
        named = any(job.run is not None for job in jobs)
        gauge = any(r.measured is not None for r in self.records)
        units, force = {job.shown(OBSERVABLES[job.observable]) for job in jobs}, jobs[0].shown("N")
        unit = units.pop() if len(units) == 1 else "um, N or 1"
        named_beside = {name for job in jobs for name in job.beside}
        beside = [replace(column, unit=jobs[0].shown(column.unit)) for column in OTHERS if column.name in named_beside]
        columns = (
            *([Column("run", "", "name of the run")] if named else []),
            Column("t", "s", "time"),
            Column("V", "um/s", "driving velocity"),
            Column("W", force, "imposed normal load; empty where it is unknown"),
            Column("u", "um", "elongation of the spring"),
            Column("v", "um/s", "slip velocity"),
            *(Column(name[3:], "s", "age of the contacts") for name in _ages(model)),
            Column("mu", "1", "friction coefficient"),
            Column("tau", force, "friction force: mu times the load on the asperities; empty where it is unknown"),
            *([Column("recorded", unit, "what the run's file holds")] if named else []),
            *([Column("measured", unit, "the simulated observable through the gauge")] if gauge else []),
            *beside,
        )
        blocks = [_block(r, model, columns) for r in self.records]
        notes = (*self.work.notes, *(note for r in self.records for note in summary(r, named=named)))
        meta = {"samples": {r.job.name: r.done for r in self.records}, **self.work.meta}
        return Table("srf.simulate/1", columns, Rows(blocks), model.title, notes, self.work.parameters, meta, self.worst.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the records over time (s): one as panels above each other, several one to a row.

        A recording, or a gauge's readings, are drawn behind the simulated observable. Velocities are on a logarithmic axis; a
        drive at rest is not drawn.
        """
        return plots.in_place(ax, self._panels)

    def _panels(self) -> Figure:
        alone = len(self.records) == 1
        panels = [_observable, _velocities, *([_load] if all(r.job.load_known for r in self.records) else [])]
        if alone and self.records[0].job.observable != "friction":
            panels.insert(1, _friction)
        with plots.house_style():
            if alone:
                figure = plots.bare_figure((6.4, 1.55 * len(panels) + 0.7))
                axes = figure.subplots(len(panels), 1, sharex="col", squeeze=False).T
            else:
                figure = plots.bare_figure((11.0, 1.7 * len(self.records) + 0.8))
                axes = figure.subplots(len(self.records), len(panels), sharex="row", squeeze=False)
            for row, record in zip(axes, self.records, strict=True):
                for draw, ax in zip(panels, row, strict=True):
                    draw(ax, record)
                if not alone:
                    row[0].set_title(plots.name_text(record.job.name))
            columns = axes if alone else axes.T
            for column in columns:
                column[-1].set_xlabel("time  [s]")
                figure.align_ylabels(column)
            plots.heading(figure, self._figure_title)
            _names(figure, axes.ravel())
            return figure


class Rows(Sequence[tuple[Any, ...]]):
    """The rows of a table, made from arrays when they are asked for: ten million Python floats are kept nowhere."""

    def __init__(self, blocks: Sequence[tuple[tuple[Any, ...], Sequence[Array]]]) -> None:
        self._blocks = blocks  # (leading cells, columns of equal length)

    def __len__(self) -> int:
        return sum(len(columns[0]) for _, columns in self._blocks)

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        for lead, columns in self._blocks:
            for a in range(0, len(columns[0]), 10_000):
                for cells in zip(*(c[a : a + 10_000].tolist() for c in columns), strict=True):
                    yield (*lead, *cells)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = index + len(self) if index < 0 else index
        for lead, columns in self._blocks:
            if 0 <= i < len(columns[0]):
                return (*lead, *(c[i].item() for c in columns))
            i -= len(columns[0])
        raise IndexError(index)


def _ages(model: GeneratedModel) -> list[str]:
    """Return the states that are logarithms of ages."""
    return [name for name in model.states if name.startswith("ln_") and name != "ln_v"]


def _block(r: Record, model: GeneratedModel, columns: Sequence[Column]) -> tuple[tuple[Any, ...], Sequence[Array]]:
    """Return the cells that lead each row of a record, and the columns that follow."""
    trace, run, nothing = r.trace, r.job.run, np.full(r.trace.t.size, np.nan)
    W = trace.W if r.job.load_known else nothing
    load = _along(model, r.job, trace, "load") if r.job.load_known else None
    with np.errstate(over="ignore"):
        cells = {name[3:]: np.exp(trace.state(name)) for name in _ages(model)}
    cells |= {"t": trace.t, "V": trace.V, "W": W, "u": trace.u, "v": trace.v, "mu": trace.mu}
    cells |= {"tau": (W if load is None else load) * trace.mu, "measured": r.observed if r.measured is None else r.measured}
    cells |= {} if run is None else {"recorded": np.where(run.used, run.observed, np.nan)}
    cells |= dict(zip(r.job.beside, r.others, strict=True))
    lead = () if run is None else (run.name,)
    return lead, [cells.get(c.name, nothing)[: r.done] for c in columns[len(lead) :]]


def summary(r: Record, *, named: bool) -> list[str]:
    """Return sentences about one record: the range of v, stick-slip under each steady drive, distance from a recording."""
    n, trace, lead = r.done, r.trace, f"{r.job.name}: " if named else ""
    if n == 0:
        return [f"{lead}nothing of the record was reached: {trace.status.advice}"]
    t, v = trace.t[:n], trace.v[:n]
    low, high = int(np.argmin(v)), int(np.argmax(v))
    slip = f"slip velocity from {v[low]:.3g} um/s at t = {t[low]:.6g} s to {v[high]:.3g} um/s at t = {t[high]:.6g} s"
    sentences = [f"{lead}{slip}", *(f"{lead}{s}" for s in _oscillations(r))]
    if n < trace.t.size:
        sentences.append(f"{lead}stopped at t = {trace.reached:.6g} s of {trace.t[-1]:g} s: {trace.status.advice}")
    if r.job.run is not None and (good := r.job.run.used[:n] & np.isfinite(r.job.run.observed[:n])).any():
        rms = float(np.sqrt(np.mean((r.observed[:n] - r.job.run.observed[:n])[good] ** 2)))
        unit = r.job.run.unit
        sentences.append(f"{lead}root mean square distance from the recording {rms:.4g}{'' if unit == '1' else f' {unit}'}")
    return sentences


def _oscillations(r: Record) -> list[str]:
    """Return a sentence for each stretch of constant drive that is long enough to tell, if any oscillates."""
    n, trace = r.done, r.trace
    sentences, steady = [], 0
    for a, b, V in _stretches(r.job, trace.t[:n]):
        t, u, v = trace.t[a:b], trace.u[a:b], trace.v[a:b]
        events = stick_slip(t, u, ripple=r.job.modulation[0] if r.job.modulation else None)
        if not events.sustained:
            steady += 1
            continue
        later = t >= events.times[0]
        kind = "stick-slip" if v[later].min() < STICK * V else "oscillation without stick"
        spread = events.recurrence.std() / events.period
        sentences.append(
            f"{kind} at V = {V:g} um/s: {events.times.size} events from t = {events.times[0]:.6g} s, "
            f"every {events.period:.5g} s (+- {100 * spread:.2g} %), u falls by {events.drop:.4g} um, "
            f"v from {v[later].min():.3g} to {v[later].max():.3g} um/s"
        )
    return sentences or (["no stick-slip"] if steady else [])


def _stretches(job: Job, t: Array) -> Iterator[tuple[int, int, float]]:
    """Yield (first, end, V) of the samples between changes of drive and load where V is constant and forward."""
    changes = [*job.drive.breaks, *(job.load.breaks if len(job.load.breaks) <= MANY_BREAKS else ())]
    cuts = np.unique([0, *np.searchsorted(t, changes), t.size]).tolist()
    for a, b in pairwise(cuts):
        V, rate, _ = job.drive.piece(0.5 * float(t[a] + t[b - 1]))
        if V > 0 and not rate and b - a > OSCILLATION_SAMPLES:
            yield a, b, V


def _simulated_run(work: Work, r: Record) -> Run:
    """Return the run as a recording of the simulation; what the repeated run says beside the observable is kept."""
    observed = r.observed if r.measured is None else r.measured
    job, used = r.job, np.ones(observed.size, bool)
    quantum = {name: work.gauges.get(name, Gauge()).quantum for name in (job.observable, *job.beside)}
    others = tuple(Signal(name, y, used, quantum[name]) for name, y in zip(job.beside, r.others, strict=True))
    initial = "steady" if job.start is None else "free"  # the form has no other word for a state of one's own
    K = float(job.p[work.model.index("K")])
    if job.run is not None:
        return replace(
            job.run, observed=observed, used=used, quantum=quantum[job.observable], notices=(), stiffness=K,
            initial=initial, others=others,
        )  # fmt: skip
    return Run(
        job.name, Path(f"{job.name}.csv"), False, 0.0, initial, job.t, observed, job.observable, used, job.drive,
        job.load, K, job.modulation, quantum[job.observable], (), others=others,
    )  # fmt: skip


# Figures of records over time: friction, elongation, velocities and load, simulated and recorded.

RECORDED = "#8A8A8A"
LABELS = {"elongation": "u", "force": "force", "friction": "friction"}


def _names(figure: Figure, axes: Iterable[Axes]) -> None:
    """Name every kind of curve once, below the panels."""
    found: dict[str, Any] = {}
    for ax in axes:
        for handle, name in zip(*ax.get_legend_handles_labels(), strict=True):
            found.setdefault(name, handle)
    plots.names_below(figure, list(found.values()), list(found))


def _observable(ax: Axes, record: Record) -> None:
    run, beside = record.job.run, {}
    if run is not None:
        beside = {"recorded": np.where(run.used, run.observed, np.nan)}
    elif record.measured is not None:
        beside = {"measured": record.measured}
    for name, values in beside.items():
        _line(ax, record, values, RECORDED, label=name, width=2.2)
    _line(ax, record, record.observed, plots.QUANTITY["u"], label="simulated" if beside else None)
    what = record.job.observable
    unit = record.job.shown(OBSERVABLES[what])
    ax.set_ylabel(plots.axis_label("shear stress" if unit == "MPa" else LABELS[what], unit))


def _friction(ax: Axes, record: Record) -> None:
    _line(ax, record, record.trace.mu, plots.QUANTITY["mu"])
    ax.set_ylabel("µ")


def _velocities(ax: Axes, record: Record) -> None:
    v, V = (np.where(x > 0, x, np.nan) for x in (record.trace.v, record.trace.V))
    _line(ax, record, v, plots.QUANTITY["v"], label="slip velocity v")
    _line(ax, record, V, plots.QUANTITY["V"], label="driving velocity V", dash=plots.DASHES[1], width=1.1)
    ax.set_yscale("log")
    ax.set_ylabel("velocity  [µm/s]")
    low, high = (f(v[: record.done], initial=end) for f, end in ((np.nanmin, np.inf), (np.nanmax, -np.inf)))
    if high < 1.02 * low:
        ax.set_ylim(low / 2, high * 2)  # steady sliding is a level line, not the noise of integration
    plots.decade_ticks(ax)


def _load(ax: Axes, record: Record) -> None:
    W = record.trace.W[: record.done]
    _line(ax, record, W, plots.QUANTITY["W"])
    if np.ptp(W) < 1e-6 * W.max():
        ax.set_ylim(0.9 * W.min(), 1.1 * W.max())
    ax.set_ylabel(f"W  [{record.job.shown('N')}]")


def _line(
    ax: Axes, record: Record, values: Array, colour: str, *, label: str | None = None, dash: Any = "-", width: float = 1.4
) -> None:
    """Draw what was reached of a record."""
    t, y = envelope(record.trace.t[: record.done], values[: record.done])
    ax.plot(t, y, color=colour, label=label, linestyle=dash, linewidth=width)
    ax.margins(x=0.0, y=0.08)
    if ax.get_yscale() == "linear":
        ax.ticklabel_format(axis="y", useOffset=False)
