"""A drafted experiment; what `srf check` found: each run's sampling, flaws, noise, drive and load, and what its load can tell."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.core.units import from_base
from srfcli.data.gauge import GaugeNoise, colour_text
from srfcli.data.values import Experiment, shown_unit
from srfcli.results import plots
from srfcli.results.figures import recordings
from srfcli.results.report_text import joined
from srfcli.results.tables import Column, Result, Table, TextResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.data.draft import Draft
    from srfcli.data.experiment import RunCheck
    from srfcli.inference.cramer_rao import CramerRaoBound, Forecast


@dataclass(frozen=True, repr=False, eq=False)
class DraftResult(TextResult):
    """A commented experiment.toml for recordings.

    Attributes
    ----------
    draft : Draft
        The text, the roles of the columns, and remarks on what was decided and why.
    folder : path
        Where the file will stand; the places of the recordings are written as seen from there.
    """

    draft: Draft = field(repr=False)
    folder: Path

    @property
    def text(self) -> str:
        """Return the text of the file."""
        return self.draft.text

    @cached_property
    def table(self) -> Table:
        """Return a row for each column that plays a role; notes are what was decided."""
        columns = (
            Column("role", "", "what the column is"),
            Column("heading", "", "as the file has it"),
            Column("unit", "", "of its numbers"),
            Column("assumed", "", "whether nobody told the unit"),
        )
        rows = [(c.role, c.heading, c.unit, c.assumed) for c in self.draft.columns]
        return Table("srf.new/1", columns, rows, "Columns of the recordings", self.draft.remarks)

    def write(self, path: Path | str | None = None, *, force: bool = False) -> None:
        """Write the text to a file, whole or not at all; experiment.toml in the folder if left out."""
        super().write(self.folder / "experiment.toml" if path is None else path, force=force)


@dataclass(frozen=True, repr=False, eq=False)
class CheckResult(Result):
    """What recordings are like, and what can be identified from them.

    Attributes
    ----------
    experiment : Experiment
        The experiment, as `srfcli.read_experiment` returns it.
    runs : tuple of RunCheck
        Sampling, notices, noise, drive and load of each run.
    forecast : Forecast or None
        What the loads of the runs can tell at best; None where nothing was simulated.
    """

    experiment: Experiment
    runs: tuple[RunCheck, ...] = field(repr=False)
    forecast: Forecast | None = field(default=None, repr=False)

    @cached_property
    def table(self) -> Table:
        """Return a row for each run; notes are the notices and what the loads can tell, in sentences."""
        experiment, forecast = self.experiment, self.forecast
        bounds: Sequence[CramerRaoBound | None] = [None] * len(self.runs) if forecast is None else forecast.runs
        found = list(zip(self.runs, bounds, strict=True))
        notes = [
            *map(str, experiment.notices),
            *(f"{check.run.name}: {notice}" for check in self.runs for notice in check.run.notices),
            *filter(None, [experiment.rescaled()]),
            NOISE,
            *([] if forecast is None else sentences(forecast)),
        ]
        together = forecast and forecast.together
        meta = {
            "experiment": str(experiment.path),
            "model": dataclasses.asdict(experiment.choice),
            "notices": list(map(dataclasses.asdict, experiment.notices)),
            "runs": [described(check, bound) for check, bound in found],
            "together": together and tells(together),
        }
        parameters = {}
        for p in experiment.parameters:
            unit, factor = experiment.shown(p.unit)
            value, low, high = (from_base(x, p.unit) * factor for x in (p.value, p.lower, p.upper))
            origin = "fixed" if p.fixed else f"start, {low:g} to {high:g}"
            parameters[p.name] = {"value": value, "unit": unit, "origin": origin}
        title = experiment.title or experiment.path.parent.name
        rows = [row(check, bound) for check, bound in found]
        columns = tuple(dataclasses.replace(c, unit=shown_unit(c.unit, stress=experiment.stress)) for c in CHECK_COLUMNS)
        return Table("srf.check/3", columns, rows, title, tuple(notes), parameters, meta)

    @cached_property
    def pages(self) -> tuple[Table, ...]:
        """Return the model's line, and tables no wider than a page, rounded: samples, readings, noise, what was imposed."""
        experiment, choice = self.experiment, self.experiment.choice
        laws = [choice.law, choice.ageing, choice.interface, f"inertia {'on' if choice.inertia else 'off'}", *choice.effects]
        mass = "" if experiment.mass is None else f", mass {experiment.mass * 1e6:.6g} kg"
        stiffness, unit = experiment.shown_stiffness
        title = f"{self.table.title}\n{', '.join(laws)}; stiffness {stiffness:.6g} {unit}{mass}"
        rows = self.table.records()
        for cells in rows:
            cells["observable"] += f" [{cells['unit']}]" if cells["unit"] != "1" else ""
        tables = []
        for heading, columns in SHOWN.items():
            headings = [name.replace("[N]", "[MPa]") if experiment.stress else name for name in columns]
            tables.append(_text_table(headings, [[_shown(cells, *of) for of in columns.values()] for cells in rows], heading))
        tables.insert(2, _noise_table(self.runs))
        if self.forecast is not None:
            tables.append(_told(self.forecast))
        tables[-1] = dataclasses.replace(tables[-1], notes=self.table.notes)
        return dataclasses.replace(self.table, columns=(), rows=(), notes=(), title=title), *tables

    @property
    def notice_kinds(self) -> set[str]:
        """Return the kinds of the notices on the files and on the runs."""
        of_runs = (n for check in self.runs for n in check.run.notices)
        return {n.kind for n in (*self.experiment.notices, *of_runs)}

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return each run's observable, drive and load over time, flagged samples marked, proposed corrections drawn."""
        return plots.in_place(ax, lambda: recordings(self.runs, title=self.experiment.title))


# The tables of `srf check`: all columns for programs, rounded ones that fit a page for readers, and everything for JSON.

CHECK_COLUMNS = (
    Column("run", "", "name"),
    Column("role", "", "fit, or held out"),
    Column("samples", about="samples with a time of their own"),
    Column("used", about="samples that are compared"),
    Column("duration", "s", "from the first sample to the last"),
    Column("rate_min", "Hz", "lowest sampling rate"),
    Column("rate_max", "Hz", "highest sampling rate"),
    Column("gaps", about="gaps in the sampling"),
    Column("spikes", about="samples of the observable flagged as spikes"),
    Column("resets", about="transducers set anew"),
    Column("observable", "", "elongation, force or friction"),
    Column("unit", "", "of the readings: um, N, MPa or 1"),
    Column("reading_min", "", "smallest reading that is compared, in the observable's unit"),
    Column("reading_max", "", "largest one"),
    Column("noise", "", "standard deviation of the gauge's noise, in the observable's unit"),
    Column("white_noise", "", "that of its white part"),
    Column("colour", "", "processes of coloured noise: standard deviation, time or frequency, quality"),
    Column("quantum", "", "quantisation step, 0 for none"),
    Column("V_min", "um/s", "lowest driving velocity"),
    Column("V_max", "um/s", "highest driving velocity"),
    Column("W_mean", "N", "mean load"),
    Column("W_min", "N", "lowest load"),
    Column("W_max", "N", "highest load"),
    Column("W_rate", "1/s", "largest |d ln W/dt|"),
    Column("f", "Hz", "frequency of a modulation that was found"),
    Column("eps", about="its amplitude over the mean load"),
    Column("onset", "s", "when it passes half its amplitude"),
    Column("alpha_error", about="smallest error of alpha from this run alone, inf where it tells nothing"),
    Column("lambda_error", about="the same of lambda, relative"),
    Column("n_error", about="the same of the exponent of the interface's stiffness"),
    Column("alpha_peak", about="the most that alpha = 0.2 changes and nothing else can, over the noise of a sample"),
    Column("lambda_peak", about="the same for a change of lambda by 10 %"),
    Column("n_peak", about="the same for a change of n by 0.1"),
)


def row(check: RunCheck, told: CramerRaoBound | None) -> tuple[Any, ...]:
    """Return the cells of one run under CHECK_COLUMNS."""
    run, load, rates = check.run, check.load, [1 / r.interval for r in check.sampling.rates]
    read, found = run.observed[run.used], load.modulation
    mean, lowest, highest = (load.mean, load.lowest, load.highest) if run.load_known else (None, None, None)
    found_out = {} if told is None else {"error": told.errors, "peak": told.peaks}
    cells = {
        "run": run.name, "role": "held out" if run.holdout else "fit", "samples": run.t.size, "used": int(run.used.sum()),
        "duration": float(np.ptp(run.t)), "rate_min": min(rates), "rate_max": max(rates),
        "gaps": int(check.sampling.gaps.size), "spikes": check.spikes, "resets": check.count("reset"),
        "observable": run.quantity, "unit": run.unit, "reading_min": float(read.min()), "reading_max": float(read.max()),
        "noise": check.noise.total, "white_noise": check.noise.white,
        "colour": "; ".join(map(colour_text, check.noise.colours)), "quantum": run.quantum,
        "V_min": check.slowest, "V_max": check.fastest,
        "W_mean": mean, "W_min": lowest, "W_max": highest, "W_rate": load.rate,
        "f": found.frequency if found else None, "eps": found.amplitude if found else None,
        "onset": found.onset if found and math.isfinite(found.onset) else None,
        **{f"{name}_{key}": found_out.get(key, {}).get(name) for name in CHANGES for key in ("error", "peak")},
    }  # fmt: skip
    return tuple(cells[column.name] for column in CHECK_COLUMNS)


def _noise_table(checks: Sequence[RunCheck]) -> Table:
    """Return what each run's noise consists of, at each of its sampling rates."""
    rows: list[list[Any]] = []
    for check in checks:
        for dt, noise in zip(check.sampling.spacings, check.noises, strict=True):
            parts = [p for p in noise.parts if p[0] != "rounding" or (p[1] / noise.total) ** 2 >= 0.005]
            for k, (part, sd, colour) in enumerate(parts):
                own = [check.run.name, rounded(1 / dt, 4)] if k == 0 else ["", None]
                time, frequency = (None, None) if not colour else (colour[0], None) if len(colour) == 2 else (None, colour[0])
                quality = colour[2] if len(colour) == 3 else None
                share = f"{100 * (sd / noise.total) ** 2:.0f} %"
                rows.append([*own, part, rounded(sd, 3), share, *(rounded(x, 3) for x in (time, frequency, quality))])
    headings = ["run", "rate [Hz]", "noise", "sd", "share", "over [s]", "about [Hz]", "quality"]
    return _text_table(headings, rows, "Noise")


# title: heading -> the column that is shown, or the two between whose values it lies, and its significant digits
SHOWN: dict[str, dict[str, tuple[str, int] | tuple[str, str, int]]] = {
    "Samples": {
        "run": ("run", 0), "role": ("role", 0), "samples": ("samples", 0), "used": ("used", 0), "duration [s]": ("duration", 6),
        "rate [Hz]": ("rate_min", "rate_max", 4), "gaps": ("gaps", 0), "spikes": ("spikes", 0), "resets": ("resets", 0),
    },
    "Readings": {
        "run": ("run", 0), "observable": ("observable", 0), "lowest": ("reading_min", 5), "highest": ("reading_max", 5),
        "noise": ("noise", 3), "quantum": ("quantum", 3),
    },
    "Imposed": {
        "run": ("run", 0), "V [um/s]": ("V_min", "V_max", 5), "W [N]": ("W_min", "W_max", 5), "mean W [N]": ("W_mean", 5),
        "W'/W [1/s]": ("W_rate", 3), "f [Hz]": ("f", 6), "eps": ("eps", 4), "onset [s]": ("onset", 4),
    },
}  # fmt: skip


def _text_table(headings: Sequence[str], rows: Sequence[Sequence[Any]], title: str) -> Table:
    return Table("srf.check.text/1", tuple(map(Column, headings)), rows, title)


def _shown(cells: dict[str, Any], *of: Any) -> Any:
    """Return a cell, or the range between two, with so many digits; `of` is as in SHOWN."""
    *names, digits = of
    ends = list(dict.fromkeys(rounded(cells[name], digits) for name in names))
    return ends[0] if len(ends) == 1 else f"{ends[0]} to {ends[1]}"


def rounded(value: Any, digits: int) -> Any:
    """Return a number with so many significant digits, as an integer where it is one; anything else as it is."""
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    short = float(f"{value:.{digits}g}")
    return int(short) if short.is_integer() and abs(short) < 1e15 else short


def _told(forecast: Forecast) -> Table:
    known = [name for name in CHANGES if any(name in r.errors for r in forecast.runs)]
    told = [*forecast.runs, *([forecast.together] if forecast.together else [])]
    cells = [[r.name, _percent(math.expm1(r.variation)), *(c for name in known for c in _errors(r, name))] for r in told]
    headings = [heading for name in known for heading in (f"{name} error", CHANGES[name])]
    title = "Smallest errors that the load allows, and the effect of a change, over the noise of a sample"
    return _text_table(["run", "load varies", *headings], cells, title)


def _errors(told: CramerRaoBound, name: str) -> tuple[str, str]:
    error = told.errors[name]
    if math.isinf(error):
        return "> 100", "-"
    return _percent(error) if name == "lambda" else f"{error:.2g}", str(rounded(told.peaks[name], 2))


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def described(check: RunCheck, told: CramerRaoBound | None) -> dict[str, Any]:
    """Return everything that was found in a run."""
    run, load = check.run, check.load
    return {
        "run": run.name,
        "file": str(run.file),
        "stiffness": run.stiffness,
        "sampling": [
            {"first": float(run.t[r.first]), "last": float(run.t[r.last]), "interval": r.interval} for r in check.sampling.rates
        ],
        "gaps": [[float(run.t[g]), float(run.t[g + 1])] for g in check.sampling.gaps.tolist()],
        "noise": [{"interval": dt, **_noise(noise)} for dt, noise in zip(check.sampling.spacings, check.noises, strict=True)],
        "friction_noise": check.friction_noise,
        "drive": [{"from": a, "velocity": v, "acceleration": s} for a, v, s in check.drive],
        "load": {"mean": load.mean, "low": load.lowest, "high": load.highest, "rate": load.rate} if run.load_known else None,
        "modulation": load.modulation and dataclasses.asdict(load.modulation),
        "declared_modulation": run.modulation,
        "tells": told and tells(told),
        "notices": list(map(dataclasses.asdict, run.notices)),
    }


def tells(told: CramerRaoBound) -> dict[str, Any]:
    """Return as plain data what one run, or all together, can identify."""
    simulation = {"status": told.status.value, "misfit": told.misfit, "believed": told.believed}
    return {"variation": told.variation, "errors": dict(told.errors), "peaks": dict(told.peaks), "simulation": simulation}


def _noise(noise: GaugeNoise) -> dict[str, Any]:
    names = ("time", "level"), ("frequency", "level", "quality")
    colours = [dict(zip(names[len(c) - 2], c, strict=True)) for c in noise.colours]
    return {
        "level": noise.total, "white": noise.white, "quantum": noise.quantum, "colours": colours,
        "samples": noise.samples, "stretch": noise.stretch,
    }  # fmt: skip


# What `srf check` says in words: what the loads of these recordings can and cannot identify, and how the noise was found.

CONSTANT = 1e-5  # relative variation of a load below which it is constant
# errors above which a parameter can hardly, and cannot, be identified
LIMITS = {"alpha": (0.05, 0.5), "lambda": (0.1, 1.0), "n": (0.1, 1.0)}
# peaks over the noise of a sample, below which a parameter can hardly, and cannot, be identified
SEEN, HIDDEN = 3.0, 0.3
CAN = "can be identified"
CHANGES = {"alpha": "alpha +0.2", "lambda": "lambda +10 %", "n": "n +0.1"}
SUBJECTS = {
    "alpha": "alpha (Linker-Dieterich: a change of load changes the age)",
    "lambda": "lambda (the interface's elastic length)",
    "n": "n (the exponent with which the interface stiffens under load)",
}
NOISE = (
    "noise: what is left of stretches of 64 to 256 samples after a parabola (and a modulation's harmonics) is subtracted; "
    "stretches with transients are left out; shares are those of its variance; a fit estimates the same parts with its parameters"
)


def sentences(forecast: Forecast) -> list[str]:
    """Return sentences on what the loads can identify: runs of constant load, each parameter, and the assumptions."""
    constant = [r.name for r in forecast.runs if r.variation < CONSTANT]
    told = [f"the load is constant in {joined(constant)}"] if constant else []
    if held := [r.name for r in forecast.runs if r.held]:
        told.append(f"the load is only held in {joined(held)}: it varies no more than its gauge does, and counts as constant")
    told += [_not_believed(r) for r in forecast.runs if not r.believed or not r.status.ok]
    judge = forecast.together or next((r for r in forecast.runs if r.believed), None)
    if judge is None:
        return [*told, "what the loads can tell is not estimated: no simulated run resembles its recording"]
    told += [_sentence(name, judge, forecast) for name in judge.errors]
    beside = f"with {', '.join(forecast.free)} unknown" if forecast.free else "with all else known"
    told.append(
        f"at best: for the model and the start values of the experiment, {beside}, and the noise as found; "
        "a random friction field, or a model that fails, costs more"
    )
    return told


def _not_believed(told: CramerRaoBound) -> str:
    if not told.status.ok:
        return f"{told.name}: the simulation ended at {told.reached:.6g} s; the rest of the run tells nothing here"
    return (
        f"{told.name}: at the start values the simulation is {told.misfit:.2g} times as far from the recording as that varies; "
        "what it could tell is left out"
    )


def _sentence(name: str, judge: CramerRaoBound, forecast: Forecast) -> str:
    error = judge.errors[name]
    varied = any(r.variation >= CONSTANT and not (r.held or r.holdout) for r in forecast.runs)
    if name == "alpha" and not varied:
        return f"{SUBJECTS[name]} cannot be identified: no fitted run has a load that changes"
    if math.isinf(error):
        return f"{SUBJECTS[name]} cannot be identified: nothing recorded depends on it"
    size = f"{100 * error:.2g} %" if name == "lambda" else f"{error:.2g}"
    source = f"{judge.name} together tell" if forecast.together else f"{judge.name} tells"
    verdict = verdict_of(name, judge)
    said = f"{SUBJECTS[name]} {verdict}: {source} it to {size} at best"
    if judge.peaks[name] < SEEN and error < LIMITS[name][1]:
        most = f"{judge.peaks[name]:.2g} of its noise"
        said += f", but {CHANGES[name]} changes no sample by more than {most}, where drift and model errors hide"
    alone = [r.name for r in forecast.runs if r.believed and verdict_of(name, r) == CAN]
    if verdict == CAN and alone and len(forecast.runs) > 1:
        said += f"; {f'each of {joined(alone)}' if len(alone) > 1 else alone[0]} does so alone"
    return said


def verdict_of(name: str, told: CramerRaoBound) -> str:
    """Return whether a parameter can, can hardly, or cannot be identified, from its error and peak."""
    clear, hardly = LIMITS[name]
    error, peak = told.errors[name], told.peaks[name]
    if error < clear and peak >= SEEN:
        return CAN
    return "can hardly be identified" if error < hardly and peak >= HIDDEN else "cannot be identified"
