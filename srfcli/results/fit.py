"""Fits: of an experiment, of critical loads alone, and of a campaign of experiments, a row each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.core.errors import SrfError, Status
from srfcli.core.units import from_base
from srfcli.data.gauge import colour_text
from srfcli.data.thresholds import Thresholds
from srfcli.data.values import BETWEEN_SAMPLES, Experiment, Run, told_of_runs
from srfcli.inference.critical_loads import MIN_P_VALUE, chi2_p_value
from srfcli.inference.fit import Fit, RunFit
from srfcli.inference.noise import lag_one
from srfcli.inference.posterior import Posterior, not_quadratic
from srfcli.inference.profile import MAX_INTERVAL_RATIO, Interval
from srfcli.inference.state_space import WIDE_FIELDS, typical_friction
from srfcli.inference.thresholds import Match, ThresholdFit, match_notes
from srfcli.results import plots
from srfcli.results.figures import draw_loads, stacked
from srfcli.results.report_text import bracketed, joined, unit_text, with_unit
from srfcli.results.tables import STATUS, Column, Result, Table, cell_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.inference.recordings import RecordingFit
PARAMETERS = (
    Column("parameter", "", "name"),
    Column("value", "", "estimate, in the unit beside it"),
    Column("stderr", "", "standard error; coloured noise allowed for; none at a bound, or where nothing determines it", ".3g"),
    Column("low", "", "lower end of the 95 % interval"),
    Column("high", "", "upper end of the 95 % interval"),
    Column("unit", "", "unit of all the columns before"),
    Column("start", "", "where the fit began"),
    Column("flag", "", "what is to be known before the value is used"),
)
RUNS = (
    Column("run", "", "name"),
    Column("observable", "", "elongation, force, friction, slip or contact_area"),
    Column("role", "", "fit, or held out"),
    Column("used", "1", "samples that are compared"),
    Column("rms", "", "of the residual, in the unit beside it"),
    Column("white_noise", "", "standard deviation of the gauge's white noise"),
    Column("unit", "", "of the two columns before"),
    Column("rms_over_noise", "1", "1 where the model explains all but the noise", ".4g"),
    Column("lag1", "1", "correlation of neighbouring residuals", ".3g"),
    Column("order", "1", "how many times of correlation the gauge's noise has"),
)
TABLES = (
    Column("table", "", "name"),
    Column("role", "", "fit, or held out"),
    Column("loads", "1", "critical loads in it"),
    Column("chi2", "1", "sum of squared residuals in sigma", ".4g"),
    Column("largest", "1", "residual, in sigma", ".3g"),
    Column("missing", "1", "lines on which the model has no such crossing"),
)
LOADS = (
    Column("line", "1", "of the table"),
    Column("V", "um/s", "driving velocity"),
    Column("eps", "1", "as the table has it"),
    Column("measured", "N", "critical load of the table"),
    Column("sigma", "N", "its standard error"),
    Column("W0c", "N", "nearest odd crossing of the model; where it is missing, the end that it lies beyond", ".7g"),
    Column("residual", "1", "(W0c - measured)/sigma", ".3g"),
    Column("next_odd", "N", "second nearest odd crossing among those looked at"),
    Column("type", "", "hopf, ns, pd or fold; missing where the model has no such crossing"),
)
POSTERIOR = (
    Column("parameter", "", "name"),
    Column("mean", "", "of the draws, in the unit beside them"),
    Column("sd", "", "their standard deviation", ".3g"),
    Column("low", "", "2.5 % of the draws are below"),
    Column("median", "", "of the draws"),
    Column("high", "", "97.5 % of the draws are below"),
    Column("unit", "", "of all the columns before"),
    Column("effective", "1", "independent draws that these are worth", ".0f"),
    Column("r_hat", "1", "spread over all chains to that within them; 1 where they agree", ".4f"),
)
VARIED = (
    Column("parameter", "", "name"),
    Column("value", "", "mean over runs or loads, in the unit beside it"),
    Column("stderr", "", "of that mean", ".3g"),
    Column("scatter", "", "standard deviation between runs or loads beyond their errors", ".3g"),
    Column("unit", "", "of the three columns before"),
    Column("p_equal", "1", "that all share one value", ".3g"),
)
POSTERIOR_PARTS = ("names", "draws", "burn_in", "accepted", "effective", "r_hat")  # that JSON has
ENOUGH, MIXED = 400.0, 1.01  # independent draws and R-hat that intervals should rest on (Vehtari and others 2021)
ADVICE = {
    Status.NO_CONVERGENCE: "the likelihood's maximum was not reached. Try --starts 5, other start values or bounds, or hold a "
    "parameter that is tied to another (--free).",
    Status.INTERRUPTED: "the likeliest parameters so far are above.",
}
LINEAR = "intervals: 1.96 standard errors; --profile refits, 95 %"
NEAR_BOUND, UNDETERMINED_WIDTH, TIED = 1e-3, 1.0, 0.99
TESTS_TOLD = 3  # tests that a fit fails, of which its notes tell, the worst first


@dataclass(frozen=True, repr=False, eq=False)
class FitResult(Result):
    """The maximum-likelihood fit of a model to all recordings and critical loads of an experiment.

    Attributes
    ----------
    found : RecordingFit
        The problem, the fit with its covariance, the random friction field, and how each start ended.
    intervals : tuple of Interval
        Profile-likelihood intervals of the parameters for which they were asked.
    posterior : Posterior, optional
        Draws of the posterior, where they were asked for.
    asked : int
        The number of starts that were asked for.
    worst : Status
        Whether the maximum was reached, INTERRUPTED where the fit was stopped.
    """

    found: RecordingFit = field(repr=False)
    intervals: tuple[Interval, ...] = ()
    posterior: Posterior | None = None
    asked: int = 1
    worst: Status = Status.OK

    @property
    def experiment(self) -> Experiment:
        """Return the experiment whose recordings were fitted."""
        return self.found.problem.experiment

    @property
    def values(self) -> dict[str, float]:
        """Return name -> estimate of the parameters, in um, s, N."""
        return dict(self.found.fit.values)

    @property
    def stderr(self) -> dict[str, float]:
        """Return name -> standard error, in um, s, N."""
        return dict(self.found.fit.stderr)

    @property
    def log_likelihood(self) -> float:
        """Return the natural log likelihood of the estimates; it compares models fitted to the same data."""
        return self.found.fit.log_likelihood

    def _shown(self, name: str, *values: float | None) -> tuple[str, list[Any]]:
        """Return the unit in which a parameter is shown, and its values (um, s, N) in that unit."""
        declared = self.found.problem.unit_of(name)
        unit, factor = self.experiment.shown(declared)
        return unit, [None if x is None else from_base(x, declared) * factor for x in values]

    @property
    def _observables(self) -> list[tuple[RunFit, Run, str]]:
        """Return how each observable is fitted, run by run, with its run and its name."""
        fit, runs = self.found.fit, {run.name: run for run in self.experiment.runs}
        fitted = [f for first in fit.runs for f in (first, *(g for g in fit.others if g.name == first.name))]
        return [(f, runs[f.name], f.observable or runs[f.name].observable) for f in fitted]

    @cached_property
    def runs(self) -> Table | None:
        """Return a row for each run, fitted or held out: residual, noise, and what is left of them; None without runs."""
        rows = [
            (f.name, observable, "held out" if f.holdout else "fit", sum(b - a for a, b in f.parts), f.rms, f.white,
             run.unit_of(observable), f.rms / f.white if f.white else None, lag_one(f.residual, f.parts),
             len(f.colours) or f.noise.order)
            for f, run, observable in self._observables
        ]  # fmt: skip
        return Table("srf.fit.runs/1", RUNS, rows, "runs") if self.experiment.runs else None

    @cached_property
    def tables(self) -> Table | None:
        """Return a row for each table of critical loads, fitted or held out; None where there is none."""
        rows = [
            (t.loads.name, "held out" if t.loads.holdout else "fit", t.white.size, t.match.cost,
             float(abs(t.white).max()), int(t.match.missing.sum()))
            for t in self.found.fit.tables
        ]  # fmt: skip
        return Table("srf.fit.tables/1", TABLES, rows, "tables of critical loads") if rows else None

    @cached_property
    def loads(self) -> Table | None:
        """Return a row for each critical load, measured and computed; None where there is none."""
        rows = [(t.loads.name, *row) for t in self.found.fit.tables for row in load_rows(t.loads.table, t.match)]
        columns = (Column("table", "", "name"), *LOADS)
        return Table("srf.fit.loads/1", columns, rows, "critical loads") if rows else None

    @cached_property
    def varied(self) -> Table | None:
        """Return mean and scatter of each parameter that varies between runs or loads; None where none does."""
        rows: list[tuple[Any, ...]] = []
        for name, scatter in self.found.scatter.items():
            if scatter is None:
                # one is at its bound: its error is not known
                rows.append((name, None, None, None, self._shown(name)[0], None))
                continue
            unit, shown = self._shown(name, scatter.mean, scatter.stderr, scatter.scatter)
            rows.append((name, *shown, unit, scatter.p_value))
        return Table("srf.fit.varied/1", VARIED, rows, "what varies") if rows else None

    @cached_property
    def draws(self) -> Table | None:
        """Return mean, spread and quantiles of the posterior draws, and what they are worth; None where none were asked for."""
        if self.posterior is None:
            return None
        rows = []
        for k, name in enumerate(self.posterior.names):
            draws = self.posterior.draws[:, k]
            numbers = (draws.mean(), draws.std(ddof=1), *np.quantile(draws, (0.025, 0.5, 0.975)))
            unit, shown = self._shown(name, *map(float, numbers))
            rows.append((name, *shown, unit, float(self.posterior.effective[k]), float(self.posterior.r_hat[k])))
        return Table("srf.fit.posterior/1", POSTERIOR, rows, "posterior")

    @cached_property
    def table(self) -> Table:
        """Return a row for each parameter: estimate, standard error, interval, unit, and what is to be known of it.

        `meta` has the runs, the correlations and all that has no column.
        """
        found, fit = self.found, self.found.fit
        profiled = {i.name: i for i in self.intervals}
        rows = []
        for k, name in enumerate(fit.names):
            value, interval = fit.values[name], profiled.get(name)
            error = fit.stderr[name] if 0 < fit.stderr[name] < math.inf else math.nan  # none at a bound, or of what is not seen
            ends = (value - 1.96 * error, value + 1.96 * error) if interval is None else (interval.low, interval.high)
            unit, (*shown, start) = self._shown(name, value, error, *ends, float(found.problem.start[k]))
            rows.append((name, *shown, unit, start, flag(fit, k)))
        meta: dict[str, Any] = {
            "runs": [] if self.runs is None else self.runs.records(),
            "against": self.against,
            "correlation": fit.correlation,
            "log_likelihood": self.log_likelihood,
            "rms_over_noise": {"fit": fit.rms_over_noise(), "holdout": fit.rms_over_noise(holdout=True)},
            "evaluations": fit.evaluations,
            "noise": {
                f.name: {"innovation": f.noise.innovation, "coefficients": f.noise.coefficients, "colours": f.colours}
                for f in fit.runs
            },
            "starts": [{"log_likelihood": ll, "same_minimum": same} for ll, same in found.starts],
            "posterior": self.posterior and {name: getattr(self.posterior, name) for name in POSTERIOR_PARTS},
        }
        if self.tables is not None and self.loads is not None:
            meta |= {"tables": self.tables.records(), "loads": self.loads.records()}
        if found.friction_field is not None:
            meta["track"] = asdict(found.friction_field)
        title = self.experiment.title
        return Table("srf.fit/2", PARAMETERS, rows, title, tuple(self._notes()), {}, meta, status=self.worst.value)

    @cached_property
    def _field_share(self) -> float:
        """Return the amplitude of the random friction field over the friction of the recordings; 0 without one."""
        own = self.found.friction_field
        return own.amplitude / max(min(map(typical_friction, self.found.problem.runs)), 1e-6) if own is not None else 0.0

    @cached_property
    def against(self) -> list[str]:
        """Return what speaks against the model, in sentences: random friction that no track has, tests that the fit fails."""
        from srfcli.diagnosis.goodness_of_fit import MAX_FIELD_AMPLITUDE, failed_tests

        found, told = self.found, []
        if (share := self._field_share) > MAX_FIELD_AMPLITUDE:
            told.append(f"the friction field is {float(f'{100 * share:.1g}'):g} % of the friction, more than a track has")
        if found.state_space is not None and found.status.ok:
            failed = [text for text in failed_tests(found.state_space) if not text.startswith("the field's amplitude")]
            told += [f"the fit fails a test: {text}" for text in dict.fromkeys(failed[:TESTS_TOLD])]
        return told

    @cached_property
    def values_with_means(self) -> dict[str, float]:
        """Return every parameter's value in um, s, N, fitted or stated; of one that varies between groups the mean, too."""
        found = self.found
        known = {q.name: q.value for q in self.experiment.parameters} | found.fit.values
        for name, each in found.problem.groups.items():
            scatter = found.scatter.get(name)
            known[name] = scatter.mean if scatter else float(np.mean([known[n] for n in each]))
        return known

    @cached_property
    def difference(self) -> tuple[float, float | None] | None:
        """Return A - B and its standard error with the covariance of the two, None without both; of what varies, of the means.

        The error is None where one varies, stands at a bound or is not seen in the recordings.
        """
        found, names, known = self.found, ("A", "B"), self.values_with_means
        if not {*names} <= known.keys():
            return None
        free = [found.fit.names.index(n) for n in names if n in found.fit.names]
        own = np.asarray(found.fit.covariance)[np.ix_(free, free)]
        known_errors = all(0 < found.fit.stderr[found.fit.names[k]] < math.inf for k in free)
        if not free or {*names} & found.problem.groups.keys() or not known_errors:
            return known["A"] - known["B"], None
        signs = np.array([1.0 if found.fit.names[k] == "A" else -1.0 for k in free])
        return known["A"] - known["B"], float(np.sqrt(max(float(signs @ own @ signs), 0.0)))

    def _colours(self) -> list[str]:
        """Return what coloured gauge noise was found, of which observable and in which runs unless in all."""
        fitted = [each for each in self._observables if not each[0].holdout]
        kinds: dict[tuple[tuple[float, ...], str, str], list[str]] = {}
        for f, run, observable in fitted:
            unit = run.unit_of(observable)
            for colour in f.colours:
                kinds.setdefault((colour, observable, "" if unit == "1" else unit), []).append(f.name)
        several, notes = len({f.observable for f, _, _ in fitted}) > 1, []
        for (colour, observable, unit), names in kinds.items():
            of = f" of {observable}" if several else ""
            of += f" in {', '.join(names)}" if len(set(names)) < len({f.name for f, _, _ in fitted}) else ""
            comma = "," if len(colour) == 3 else ""
            notes.append(f"gauge noise{of}: {colour_text(colour, unit)}{comma} besides white noise, or physics that is missing")
        return notes

    def _notes(self) -> list[str]:
        """Return what is to be known beside the numbers, in sentences."""
        found, fit = self.found, self.found.fit
        of = "runs" if fit.runs else "critical loads"
        notes = [f"rms over noise {cell_text(fit.rms_over_noise(), '.3f')} in the {of} fitted"]
        if any(f.holdout for f in fit.runs) or any(t.loads.holdout for t in fit.tables):
            notes[0] += f", {cell_text(fit.rms_over_noise(holdout=True), '.3f')} in those held out"
        if self.difference is not None and self.difference[1]:
            difference, error = self.difference
            notes.append(f"A - B = {difference:.6g} +- {error:.2g}, the covariance of the two allowed for")
        done = [i.name for i in self.intervals]
        whose = "profile likelihood" + (f" of {', '.join(done)}, else 1.96 standard errors" if len(done) < len(fit.names) else "")
        notes.append(f"intervals: {whose}, 95 %" if self.intervals else LINEAR)
        notes += self._beyond_errors()
        if len(found.starts) > 1:
            notes.append(f"{sum(same for _, same in found.starts)} of {len(found.starts)} starts ended in this minimum")
        notes += self._colours()
        coloured = [f.name for f in fit.runs if f.noise.order and not f.holdout]
        if coloured:
            notes.append(f"residuals are coloured in {', '.join(coloured)}: noise of that colour, or physics that is missing")
        notes += filter(None, [self.experiment.rescaled()])
        notes += [str(n) for n in self.experiment.notices if n.kind == "start-value"]
        field = found.state_space is not None and not found.state_space.smooth
        unexplained = self.against or field or any(f.colours for f in fit.runs)  # else each step was where it was taken to be
        told = ("reset", "drive-smoothed", *(BETWEEN_SAMPLES if unexplained else ()))
        notes += told_of_runs(self.experiment.runs, told)
        notes += [] if self.posterior is None else posterior_notes(self.posterior)
        notes += load_notes(found.fit) if found.fit.tables else []
        if found.friction_field is not None:
            notes.append(str(found.friction_field))
        notes += self.against
        own, uneven, coarse = list[str](), list[str](), list[str]()
        if found.state_space is not None and found.status is not Status.INTERRUPTED:
            from srfcli.diagnosis.goodness_of_fit import coarse_readings, own_levels, uneven_noise

            own, uneven, coarse = (told_of(found.state_space) for told_of in (own_levels, uneven_noise, coarse_readings))
        notes += own
        if self._field_share > WIDE_FIELDS[0][0] and not own:
            notes.append(
                "under so wide a field a recording is followed whatever the parameters are, and the maximum may be a wrong one: "
                "try --starts 5, or start values nearer to what is known"
            )
        notes += [*uneven, *coarse]
        if self.against and not (coarse and fit.rms_over_noise() < 1):  # such a fit leaves less than the rounding it allows for
            notes.append(
                "the model does not explain the recordings: the values may be wrong by more than their errors. "
                "Try another ageing law or friction law, or `srf diagnose`."
            )
        if self.worst is Status.INTERRUPTED and found.status is Status.INTERRUPTED and self.asked > 1:
            notes.append(f"interrupted: {len(found.starts)} of {self.asked} starts were done")
        return notes

    def _beyond_errors(self) -> list[str]:
        """Return which standard errors are too small by the intervals; without any, whether those of critical loads may be."""
        found, fit = self.found, self.found.fit
        if self.intervals:
            bounds = list(zip(fit.lower, fit.upper, strict=True))
            told = farther(self.intervals, [fit.values[n] for n in fit.names], list(fit.stderr.values()), bounds)
            return said_likelier(self.intervals, self._shown) + told
        if not (found.problem.tables and found.state_space and found.status.ok):
            return []
        return said_not_quadratic(not_quadratic(found.state_space))

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return each run's recording and prediction above its residual, and each table's measured and computed loads."""
        return plots.in_place(ax, self._panels)

    def _panels(self) -> Figure:
        fit = self.found.fit
        count = len(self._observables) + len(fit.tables)
        columns = min(count, 2)
        lines = math.ceil(count / columns)
        with plots.house_style():
            figure = plots.bare_figure((6.0 if columns == 1 else 5.2 * columns, 2.9 * lines + 0.9))
            grid = figure.add_gridspec(lines, columns)
            cells = [grid[place // columns, place % columns] for place in range(count)]
            handles: list[Any] = []
            for cell, (one, run, what) in zip(cells, self._observables, strict=False):
                unit, noise = run.unit_of(what), one.white
                recorded = next(s for s in run.signals if s.observable == what).observed
                above, below = stacked(figure, cell, (2, 1), hspace=0.05)
                dots = above.plot(run.t, recorded, ".", color="#999999", markersize=3.0, label="recorded", rasterized=True)
                line = above.plot(run.t, one.y, color=plots.COLOURS[0], linewidth=0.9, label="model")
                handles = handles or [*dots, *line]
                above.set_title(plots.name_text(one.name) + (" (held out)" if one.holdout else ""))
                above.set_ylabel(run.quantity_of(what) + ("" if unit == "1" else f"\n[{unit_text(unit)}]"))
                above.ticklabel_format(axis="y", useOffset=False)
                above.tick_params(labelbottom=False)
                off = (recorded - one.y) / (noise or 1.0)
                below.plot(run.t, off, ".", color=plots.COLOURS[1], markersize=2.0, rasterized=True)
                for level in (-2.0, 2.0) if noise else ():
                    below.axhline(level, color="#000000", linewidth=0.7, linestyle=(0, (1, 1.5)))
                below.set_ylabel("residual\n/ noise" if noise else "residual")
                below.set_xlabel("time  [s]")
                above.margins(x=0.01)
                figure.align_ylabels([above, below])
            for cell, table in zip(cells[len(self._observables) :], fit.tables, strict=True):
                panel = figure.add_subplot(cell)
                draw_loads(panel, table.loads.table, {"fit": np.where(table.match.missing, np.nan, table.match.loads)})
                panel.set_title(plots.name_text(table.loads.name) + (" (held out)" if table.loads.holdout else ""))
            plots.names_below(figure, handles, [h.get_label() for h in handles], markerscale=3)
            plots.heading(figure, self._figure_title)
            return figure

    @property
    def _figure_title(self) -> str:
        """Return the laws, and the parameters with their errors."""
        fit, choice = self.found.fit, self.experiment.choice
        laws = ", ".join([choice.law, choice.ageing, choice.interface, *choice.effects])
        told = []
        for name in fit.names:
            unit, (value, error) = self._shown(name, fit.values[name], fit.stderr[name])
            told.append(f"{plots.symbol_text(name)} = {with_unit(bracketed(value, error), unit)}")
        return "\n".join([laws, ", ".join(told)] if told else [laws])


def load_rows(table: Thresholds, match: Match) -> list[tuple[Any, ...]]:
    """Return a row under LOADS for each critical load."""
    kinds = ["missing" if c is None else getattr(c.point, "kind", "hopf") for c in match.crossings]
    cells = (table.lines, table.V, table.eps, table.W0c, table.sigma, match.loads, match.residuals, match.rivals, kinds)
    return [tuple(v.item() if hasattr(v, "item") else v for v in row) for row in zip(*cells, strict=True)]


def said_not_quadratic(names: Sequence[str]) -> list[str]:
    """Return a sentence on parameters whose standard errors do not say how the likelihood falls off, if there are any."""
    told = f"the likelihood is not quadratic within 1.96 standard errors of {', '.join(names)}"
    return [f"{told}, which may be far too small: --profile gives intervals that hold"] if names else []


def farther(
    intervals: Sequence[Interval], values: Sequence[float], errors: Sequence[float], bounds: Sequence[tuple[float, float]]
) -> list[str]:
    """Return a sentence where intervals, of the first parameters or all, are longer than MAX_INTERVAL_RATIO allows."""
    told = []
    for interval, value, error, (lower, upper) in zip(intervals, values, errors, bounds, strict=False):
        if not (np.isfinite(error) and error > 0):
            continue
        for way, end, bound in (("down", interval.low, lower), ("up", interval.high, upper)):
            if end is None and abs(bound - value) > 1.96 * error:
                told.append(f"{interval.name} without end {way}")
            elif end is not None and abs(end - value) > MAX_INTERVAL_RATIO * 1.96 * error:
                told.append(f"{interval.name} {abs(end - value) / (1.96 * error):.1f} times as far {way}")
    said = "the likelihood is not quadratic, and standard errors are too small. 95 % intervals reach, over 1.96 standard errors, "
    return [f"{said}{', '.join(told)}: take low and high. Fewer free parameters or other data narrow them"] if told else []


def said_likelier(intervals: Sequence[Interval], shown: Callable[[str, float], tuple[str, list[Any]]]) -> list[str]:
    """Return a sentence where a refit of a profile is likelier than the fit; `shown` gives a parameter's unit and value in it."""
    best = max(intervals, key=lambda i: i.gain)
    if best.likelier is None:
        return []
    units, numbers = zip(*(shown(name, value) for name, value in best.likelier.items()), strict=True)
    values = ", ".join(with_unit(f"{n} = {x:.5g}", u) for n, (x,), u in zip(best.likelier, numbers, units, strict=True))
    where = f"a refit beside the fit, in the profile of {best.name}, is likelier by {best.gain:.2g} in log likelihood: {values}"
    return [f"{where}. The fit has not ended at the highest maximum, and intervals are about its own: begin at these values"]


def chi2_notes(of: str, cost: float, freedom: int) -> list[str]:
    """Return a note where a chi2 of critical loads is larger than chance has it."""
    if (chance := chi2_p_value(cost, freedom)) >= MIN_P_VALUE:
        return []
    said = f"{of}: chi2 {cost:.4g} on {freedom} degrees of freedom, chance {chance:.1g}"
    return [f"{said}; the model does not describe the loads within sigma, and the errors do not allow for that"]


def load_notes(fit: Fit) -> list[str]:
    """Return what a reader of a fit has to know of its critical loads: whether they are described, and how they were matched."""
    notes, fitted = [], [t for t in fit.tables if not t.loads.holdout]
    alone = not any(not r.holdout for r in fit.runs)
    size, cost = sum(t.white.size for t in fitted), sum(t.match.cost for t in fitted)
    freedom = size - len(fit.names) if alone else size  # beside recordings they have little say in the parameters
    notes += chi2_notes("critical loads", cost, freedom) if fit.status.ok else []
    for t in fit.tables:
        notes += [f"{t.loads.name}: {text}" for text in (*t.loads.table.notes, *match_notes(t.loads.table, t.match))]
    return notes


def posterior_notes(posterior: Posterior) -> list[str]:
    """Return what a reader of draws has to know: what they are worth, and whether they were cut short."""
    worth, worst = float(posterior.effective.min()), float(posterior.r_hat.max())
    count, chains = posterior.draws.shape[0], posterior.chains.shape[1]
    made = f"posterior: {count} draws of {chains} chains after {posterior.burn_in} steps of burn-in"
    known = math.isfinite(worth) and math.isfinite(worst)
    quality = (
        f"worth {worth:.0f} independent ones or more; R-hat up to {worst:.3f}; {posterior.accepted:.0%} of the proposals taken"
    )
    notes = [f"{made}, {quality if known else 'too few steps to tell what they are worth'}"]
    notes += ["posterior: interrupted; the draws so far are kept"] if posterior.interrupted else []
    if known and not (worth >= ENOUGH and worst <= MIXED):
        more = max(math.ceil(1.2 * count * ENOUGH / max(worth, 1.0) / 100) * 100, 2 * count if worst > MIXED else 0)
        notes.append(
            f"posterior: intervals should rest on {ENOUGH:.0f} independent draws with R-hat up to {MIXED}: --sample {more}"
        )
    return notes


def flag(fit: Fit, k: int) -> str:
    """Return what stands against an estimate: at a bound, sought no further, not determined, tied to another, others at bounds.

    With a parameter at a bound the errors of the others are those with that parameter known.
    """
    name = fit.names[k]
    width = fit.upper[k] - fit.lower[k]
    if math.isinf(fit.stderr[name]):
        return "not identifiable: the recordings have no say in it"
    if _at_bound(fit, k):
        return "at its lower bound" if fit.values[name] - fit.lower[k] < NEAR_BOUND * width else "at its upper bound"
    if fit.status is Status.INTERRUPTED:
        return "not at the maximum: the fit was interrupted"
    if fit.stderr[name] > UNDETERMINED_WIDTH * width / 4:
        return "not identifiable: its error is as wide as its bounds"
    tied = np.nan_to_num(np.abs(fit.correlation[k]))  # NaN with one at a bound
    tied[k] = 0
    other = int(np.argmax(tied)) if tied.size > 1 else k
    if tied[other] > TIED:
        return f"tied to {fit.names[other]}: correlation {fit.correlation[k][other]:.3f}"
    bound = [other for i, other in enumerate(fit.names) if _at_bound(fit, i) and not math.isinf(fit.stderr[other])]
    return f"error with {joined(bound)} held at {'a bound' if len(bound) == 1 else 'bounds'}" if bound else ""


def _at_bound(fit: Fit, k: int) -> bool:
    value, low, high = fit.values[fit.names[k]], fit.lower[k], fit.upper[k]
    return min(value - low, high - value) < NEAR_BOUND * (high - low)


# A fit of critical loads alone, as in the paper: each method beside the others, with its cost against evaluations.

METHOD = Column("method", "", "powell, or least-squares with exact derivatives")
ESTIMATES = (
    METHOD,
    Column("parameter", "", "name"),
    Column("value", "", "estimate, in the unit beside it", ".7g"),
    Column("stderr", "", "standard error from the given sigma, linearised", ".3g"),
    Column("low", "", "lower end of the 95 % interval"),
    Column("high", "", "upper end of the 95 % interval"),
    Column("lower", "", "bound of the search"),
    Column("upper", "", "bound of the search"),
    Column("unit", "", "unit of all the columns before"),
    Column("start", "", "where the fit began"),
    Column("flag", "", "why an error is missing or means nothing"),
)
METHOD_COLUMNS = (
    METHOD,
    Column("status", "", STATUS),
    Column("chi2_start", "1", "sum of squared residuals in sigma at the start"),
    Column("chi2", "1", "the same at the end"),
    Column("freedom", "1", "critical loads less free parameters"),
    Column("paper_cost_start", "N^2", "the paper's sum of squares at the start"),
    Column("paper_cost", "N^2", "the same at the end"),
    Column("evaluations", "1", "of the whole cost"),
    Column("gradients", "1", "sets of exact derivatives that the method used"),
    Column("surveys", "1", "lines searched in full"),
)
TRACE = (METHOD, Column("evaluation", "1", "of the whole cost, counted from 1"), Column("chi2", "1", "lowest so far"))


@dataclass(frozen=True, repr=False, eq=False)
class ThresholdFitResult(Result):
    """The fit of a model to a table of critical loads, by each method.

    Attributes
    ----------
    found : ThresholdFit
        The table, the free parameters, and what each method found.
    laws : str
        The title of the model.
    held : mapping
        The parameters and their origin, as a table describes them.
    """

    found: ThresholdFit = field(repr=False)
    laws: str
    held: Mapping[str, Mapping[str, Any]] = field(repr=False)

    @property
    def values(self) -> dict[str, float]:
        """Return name -> estimate of the method with the lowest chi2, in um, s, N."""
        return dict(zip(self.found.scale.names, self.found.best.values.tolist(), strict=True))

    @property
    def stderr(self) -> dict[str, float]:
        """Return name -> standard error of that estimate, in um, s, N; NaN at a bound, infinite where nothing is known."""
        return dict(zip(self.found.scale.names, self.found.best.uncertainty.errors.tolist(), strict=True))

    @property
    def _freedom(self) -> int:
        return len(self.found.table) - len(self.found.scale)

    @cached_property
    def table(self) -> Table:
        """Return the estimates of each method; `meta` has the methods, the traces, the loads and the information matrices."""
        fit, rows = self.found, []
        profiled = {i.name: (i.low, i.high) for i in fit.intervals}
        for m in fit.methods:
            for i, q in enumerate(fit.scale):
                value, error = m.values[i], m.uncertainty.errors[i]
                ends = profiled.get(q.name, (value - 1.96 * error, value + 1.96 * error))
                numbers = (value, error, *ends, q.lower, q.upper)
                shown = [None if x is None else q.declared(float(x)) for x in numbers]
                start, said = q.declared(float(q.start)), m.uncertainty.flags[i] or "ok"
                rows.append((m.method, q.name, *shown, q.parameter.unit, start, said))
        meta: dict[str, Any] = {
            "methods": self.methods.records(),
            "trace": self.trace.records(),
            "loads": self.loads.records(),
            "information": {  # in the coordinates ln(value), or value/size
                m.method: {
                    "parameters": fit.scale.names, "coordinates": ["ln" if q.log else "linear" for q in fit.scale],
                    "correlation": m.uncertainty.correlation, "eigenvalues": m.uncertainty.eigenvalues,
                    "eigenvectors": m.uncertainty.combinations.T,
                }
                for m in fit.methods
            },
        }  # fmt: skip
        notes = (*fit.table.notes, *self._remarks())
        title = f"{fit.table.source}, {len(fit.table)} critical loads; {self.laws}"
        return Table("srf.fit-thresholds/2", ESTIMATES, rows, title, notes, self.held, meta, fit.status.value)

    def _remarks(self) -> list[str]:
        """Return notes: the least determined combination, whether the model describes the data, how data were matched."""
        notes = ["intervals: profile likelihood, 95 %" if self.found.intervals else LINEAR]
        for m in self.found.methods:
            if m.uncertainty.weakest:
                notes.append(f"{m.method}: least determined is {m.uncertainty.weakest}")
            notes += chi2_notes(m.method, m.cost, self._freedom) if m.status.ok else []
            notes += [f"{m.method}: {note}" for note in m.notes]
        return notes + self._beyond_errors()

    def _beyond_errors(self) -> list[str]:
        """Return which standard errors are too small by the intervals; without any, whether they may be."""
        fit, best = self.found, self.found.best
        if not fit.intervals:
            return said_not_quadratic(fit.not_quadratic)
        bounds = [(q.lower, q.upper) for q in fit.scale]
        told = farther(fit.intervals, best.values.tolist(), best.uncertainty.errors.tolist(), bounds)
        declared = {q.name: q for q in fit.scale}
        return said_likelier(fit.intervals, lambda n, x: (declared[n].parameter.unit, [declared[n].declared(x)])) + told

    @cached_property
    def methods(self) -> Table:
        """Return how each method ended, and what it took."""
        rows = [
            (m.method, m.status.value, m.start_cost, m.cost, self._freedom, *m.paper_cost, m.evaluations, m.gradients, m.surveys)
            for m in self.found.methods
        ]
        return Table("srf.fit-thresholds.methods/1", METHOD_COLUMNS, rows, "Methods")

    @cached_property
    def trace(self) -> Table:
        """Return the lowest cost of each method against its evaluations."""
        rows = [(m.method, i + 1, m.trace.best[i]) for m in self.found.methods for i in m.trace.milestones()]
        return Table("srf.fit-thresholds.trace/1", TRACE, rows, "Cost against evaluations")

    @cached_property
    def loads(self) -> Table:
        """Return each critical load, measured and computed, under the estimates of each method."""
        rows = [(m.method, *row) for m in self.found.methods for row in load_rows(self.found.table, m.match)]
        return Table("srf.fit-thresholds.loads/1", (METHOD, *LOADS), rows, "Critical loads")

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the measured critical loads beside those of the best fit over V, and the lowest chi2 against evaluations."""
        return plots.in_place(ax, self._panels)

    def _panels(self) -> Figure:
        table, best = self.found.table, min(self.found.methods, key=lambda m: m.cost)
        loads = np.where(best.match.missing, np.nan, best.match.loads)
        with plots.house_style():
            figure = plots.bare_figure((6.0, 7.2))
            above, below = figure.subplots(2, 1, height_ratios=(3, 2))
            draw_loads(above, table, {"fit": loads})
            for index, m in enumerate(self.found.methods):
                look = {"color": ("#000000", "#777777")[index], "linestyle": plots.DASHES[index]}
                count = range(1, len(m.trace) + 1)
                below.step(count, m.trace.best, where="post", label=m.method, **look)
                below.plot(count[-1:], m.trace.best[-1:], "o", color=look["color"])
            if self._freedom:
                below.axhline(self._freedom, color="#555555", linestyle=plots.DOTTED, label="degrees of freedom")
            below.set(xscale="log", yscale="log", xlabel="evaluations of the whole cost", ylabel="lowest χ² so far")
            found = ", ".join(
                plots.valued(q.name, q.declared(float(best.values[i])), q.parameter.unit) for i, q in enumerate(self.found.scale)
            )
            plots.heading(figure, f"{plots.name_text(str(table.source))}: {self.laws}\nfit: {found}")
            plots.decade_ticks(below)
            below.legend(loc="best", fontsize=plots.NAME_OFFSET, handlelength=2.8)
            figure.align_ylabels([above, below])
            return figure


# A campaign: many experiments, a row each, as the table that a laboratory publishes.

ROOM = 60  # letters of the experiments' names that stand upright below the figure
QUOTED = ("A", "B", "D0", "K")  # whose covariances a fit of a velocity step is quoted with
PAIRS = {f"cov_{a}_{b}".replace("K", "k"): (a, b) for a, b in combinations(QUOTED, 2)}
LEADING = (
    Column("experiment", "", "folder or file"),
    Column("status", "", "of the fit; failed where there is none"),
    Column("law", "", "friction and ageing law"),
    Column("runs", "1", "that were fitted"),
    Column("samples", "1", "compared in them"),
    Column("V_min", "um/s", "lowest velocity of the drive"),
    Column("V_max", "um/s", "highest velocity of the drive"),
    Column("load", "", "mean of the fitted runs, in the unit beside it; empty where friction alone is known"),
    Column("load_unit", "", "N or MPa"),
    Column("segments", "1", "of constant velocity, six slip lengths D0 or longer"),
    Column("steady", "1", "of them, those that end in steady sliding"),
    Column("final_slope", "1/mm", "largest change of friction with slip at the end of a segment, over its error 3 or more"),
    Column("rms_over_noise", "1", "1 where the model explains all but the noise"),
)
DERIVED = (
    Column("A_minus_B", "1", "A - B: above 0, friction rises with velocity"),
    Column("A_minus_B_stderr", "1", "with the covariance of the two"),
)
STATED = (
    Column("k", "", "stiffness, stated or fitted, in the unit beside it"),
    Column("k_stderr", "", "empty where the stiffness is the stated one"),
    Column("k_unit", "", "as the experiment states it"),
    Column("V0", "um/s", "reference velocity, of which mu0 is the friction"),
)
TRAILING = (Column("flags", "", "what is to be known before the row is used"), Column("reason", "", "why there is no fit"))


@dataclass(frozen=True, repr=False, eq=False)
class CampaignResult(Result):
    """The fits of many experiments.

    Attributes
    ----------
    rows : sequence of dict
        What each experiment's fit gave, by the name of its column, and `parameters`, name -> [value, standard error, unit].
    worst : Status
        INTERRUPTED where not all were done.
    """

    rows: Sequence[Mapping[str, Any]]
    asked: int
    worst: Status = Status.OK

    @property
    def failed(self) -> int:
        """Return how many experiments have no fit."""
        return sum(row["status"] == "failed" for row in self.rows)

    @property
    def table(self) -> Table:
        """Return a row for each experiment; a parameter that an experiment does not fit is empty in its row."""
        fitted = dict.fromkeys(name for row in self.rows for name in row.get("parameters", {}))
        names = [name for name in fitted if name != "K"]
        columns = [*LEADING]
        for name in names:
            units = dict.fromkeys(row["parameters"][name][2] for row in self.rows if name in row.get("parameters", {}))
            unit = next(iter(units)) if len(units) == 1 else ""
            columns += [Column(name, unit, "estimate"), Column(f"{name}_stderr", unit, "standard error", ".3g")]
        both = {"A", "B"} <= set(names)
        covariances = [Column(name, "", "covariance") for name, pair in PAIRS.items() if {*pair} <= fitted.keys()]
        columns += [*(DERIVED if both else ()), *(c for c in STATED if c.name not in names), *covariances, *TRAILING]
        cells = []
        for row in self.rows:
            found = {**row, **row.get("covariances", {})}
            for name, (value, error, _) in row.get("parameters", {}).items():
                found |= {name: value, f"{name}_stderr": error}
            cells.append([found.get(column.name) for column in columns])
        notes = []
        if self.failed:
            notes.append(f"{self.failed} of {len(self.rows)} experiments have no fit: their rows say why")
        if len(self.rows) < self.asked:
            notes.append(f"interrupted: {len(self.rows)} of {self.asked} experiments were done")
        title = f"{len(self.rows)} experiment" + ("s" if len(self.rows) != 1 else "")
        worst = Status.INTERRUPTED if len(self.rows) < self.asked else self.worst
        return Table("srf.campaign/1", tuple(columns), cells, title, tuple(notes), status=worst.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return A - B with its error over the velocity of each experiment, those that have no fit left out."""
        known = [row for row in self.rows if row.get("A_minus_B") is not None]
        if not known:
            raise SrfError("no experiment of the campaign has A and B: there is nothing to draw", "Leave --plot out.")
        laws = list(dict.fromkeys(str(row["law"]) for row in known))
        title = plots.name_text("; ".join(laws), wide=True)
        with plots.one_panel(ax, title=title, size=(max(6.0, 1.0 + 0.3 * len(known)), 4.2)) as (figure, axes):
            place = range(len(known))
            values, errors = ([row[key] for row in known] for key in ("A_minus_B", "A_minus_B_stderr"))
            errors = [e if e is not None and math.isfinite(e) else math.nan for e in errors]
            axes.errorbar(place, values, yerr=[1.96 * e for e in errors], fmt="o", capsize=3, color=plots.COLOURS[0])
            axes.axhline(0.0, color="#555555", linestyle=plots.DOTTED)
            axes.set(xticks=list(place), ylabel="A − B, and 95 % intervals", xlabel="experiment")
            names = _short_names([str(row["experiment"]) for row in known])
            turn: dict[str, Any] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}
            upright = sum(map(len, names)) <= ROOM and len(known) < 10
            axes.set_xticklabels([plots.name_text(name) for name in names], **({} if upright else turn))
            axes.margins(x=0.5 / len(known) if len(known) > 1 else 0.5)
        return figure


def _short_names(places: Sequence[str]) -> list[str]:
    """Return the names of folders or files, those of their folders where all are called alike, whole where two are the same."""
    named = [Path(place).parent.name or place if Path(place).name == "experiment.toml" else Path(place).name for place in places]
    return [name if named.count(name) == 1 else place for name, place in zip(named, places, strict=True)]
