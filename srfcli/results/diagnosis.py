"""A diagnosis: its verdict, the tables that it rests on, its answer as data, and the folder with report and model."""

from __future__ import annotations

import contextlib
import math
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.core.errors import SrfError, Status
from srfcli.core.files import check_folder_place, parse_json, read_plain, unused_name, whole_folder, write_atomic
from srfcli.data.values import Run
from srfcli.diagnosis.answer import RunView, answer, load_views, parameter_rows, ranked_rows, run_views
from srfcli.diagnosis.design import DiscriminatingRun, discriminating_files
from srfcli.diagnosis.discrepancy import smoothed_friction_field
from srfcli.diagnosis.residual_scan import Location, ScanStatistic
from srfcli.diagnosis.search import Fitted
from srfcli.diagnosis.verdict import Diagnosis, added, at_bounds
from srfcli.laws.registry import Registry
from srfcli.results import plots
from srfcli.results.provenance import Provenance, write_result
from srfcli.results.report_figures import loads_figure, run_figure, trace
from srfcli.results.report_text import unit_text
from srfcli.results.tables import Column, Result, Table, json_text, plain_value, tag, to_csv

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


ANSWER = "answer.json"
LARGEST_ANSWER = 2**28  # bytes of an answer
FORM = "closed-form.toml"
SCHEMA = "srf.diagnose/"


HYPOTHESES = (
    Column("hypothesis", "", "effects added to the baseline"),
    Column("evidence", "1", "log marginal likelihood over that of the baseline", ".1f"),
    Column("rms_over_noise", "1", "of the innovations: 1 where all but noise is explained", ".4f"),
    Column("field", "1", "amplitude of its friction field", ".2g"),
    Column("confidence", "1", "stated", ".3f"),
    Column("against", "", "what speaks against it"),
)
PARAMETERS = (
    Column("parameter", "", "name"),
    Column("baseline", "", "estimate"),
    Column("baseline_stderr", "", "its standard error", ".2g"),
    Column("augmented", "", "estimate in the augmented model"),
    Column("augmented_stderr", "", "its standard error", ".2g"),
    Column("unit", "", "of the four before"),
    Column("shift_sigma", "1", "shift of the baseline's estimate, in the augmented model's standard errors", ".1f"),
)
RUNS = (
    Column("run", "", "name"),
    Column("role", "", "fit, or held out"),
    Column("baseline", "", "innovations over noise, rms", ".4f"),
    Column("augmented", "", "innovations over noise, rms", ".4f"),
    Column("share", "1", "of the baseline's excess misfit", ".2f"),
    Column("p_value", "1", "adjusted for all that was looked at", ".1g"),
    Column("where", "", "times (s) that hold most of it"),
)
LOADS = (
    Column("table", "", "of critical loads: its name"),
    Column("role", "", "fit, or held out"),
    Column("loads", "1", "critical loads in it"),
    Column("baseline", "", "chi2: sum of squared residuals in sigma", ".4g"),
    Column("augmented", "", "chi2: sum of squared residuals in sigma", ".4g"),
)
SENTENCES = {
    "none": "none: the baseline explains the recordings down to the noise",
    "identified": "identified: {}",
    "ambiguous": "ambiguous: {}: they do equally well",
    "unknown": "unknown: something is missing that no registered effect explains",
    "inconclusive": "inconclusive: nothing is needed, and effects of interesting size could not have been seen",
}
HYPOTHESES_SHOWN = 8  # hypotheses that are shown


@dataclass(frozen=True, repr=False)
class DiagnosisResult(Result):
    """What `srfcli.diagnose` found: `verdict`, `effects`, `confidence`, and the whole `answer` as `srf.diagnose/1` has it.

    Attributes
    ----------
    diagnosis : Diagnosis
        The fits of the models that were compared, their evidence, and the verdict.
    location : Location
        Where the baseline's innovations stand out: in time, velocity, load, slip and phase, in um, s, N.
    registry : Registry
        The effects that were looked for.
    missing : mapping
        What an unknown effect is like; empty for another verdict.
    discriminating : DiscriminatingRun, optional
        The run that would tell ambiguous models apart.
    stopped : bool
        Whether Ctrl-C ended the search.
    reader, seed : str or None, int
        As they were asked for.
    seconds : float
        How long it took.
    """

    diagnosis: Diagnosis = field(repr=False)
    location: Location = field(repr=False)
    registry: Registry = field(repr=False)
    missing: Mapping[str, Any] = field(default_factory=dict, repr=False)
    discriminating: DiscriminatingRun | None = field(default=None, repr=False)
    stopped: bool = False
    reader: str | None = None
    seed: int = 0
    seconds: float = 0.0

    @property
    def verdict(self) -> str:
        """Return none, identified, ambiguous, unknown or inconclusive."""
        return self.diagnosis.verdict

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the effects, or the ageing law, that the verdict names."""
        return self.diagnosis.effects

    @property
    def confidence(self) -> dict[str, float]:
        """Return the stated confidence in each model that was fitted, and in `unknown`."""
        return dict(self.diagnosis.confidence)

    @property
    def sentence(self) -> str:
        """Return the verdict in a sentence."""
        alone, stated = self.diagnosis.acts_in, self.diagnosis.experiment.choice.ageing
        laws = {f.hypothesis.ageing for f in self.diagnosis.close} - {""}
        named = [f"{name} in {alone[name]} alone" if name in alone else name for name in self.effects]
        if self.verdict == "identified":
            named = [f"the ageing law is {name}, not {stated}" if name in laws else name for name in named]
        bounds = at_bounds(self.diagnosis.best)
        beside = f"; {', '.join(bounds)} at {'its bound' if len(bounds) == 1 else 'their bounds'}" if bounds else ""
        return SENTENCES[self.verdict].format(" and ".join(named)) + beside

    @property
    def status(self) -> Status:
        """Return whether the search was done; INTERRUPTED after Ctrl-C."""
        return Status.INTERRUPTED if self.stopped else Status.OK

    @cached_property
    def answer(self) -> dict[str, Any]:
        """Return the answer as plain data."""
        found: dict[str, Any] = plain_value(answer(self.diagnosis, self.location, discriminating=self.discriminating))
        if self.missing:
            kept = {k: v for k, v in self.missing.items() if k not in ("force", "toml", "csv")}
            found["missing"] = plain_value(kept)
        if self.stopped:
            found["status"] = self.status.value
        return found

    @property
    def table(self) -> Table:
        """Return the models that were fitted, best evidence first, and what is to be known."""
        ranked = ranked_rows(self.diagnosis)
        zero = next(r["evidence"] for r in ranked if r["name"] == "none")
        rows = [
            (r["name"], r["evidence"] - zero, r["rms_over_noise"], r["field"], r["confidence"], r["against"])
            for r in ranked[:HYPOTHESES_SHOWN]
        ]
        notes = _notes(self.answer, recorded=bool(self.diagnosis.experiment.runs))
        notes += filter(None, [self.diagnosis.experiment.rescaled()])
        return Table("srf.diagnose.hypotheses/1", HYPOTHESES, rows, "hypotheses", tuple(notes), status=self.status.value)

    def __str__(self) -> str:
        return f"{self.sentence}\n\n{super().__str__()}"

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.sentence}; {self.status.value}>"

    def _repr_html_(self) -> str:
        """Return the verdict and the table for a notebook."""
        return tag("p", self.sentence) + super()._repr_html_()

    @property
    def parameter_table(self) -> Table:
        """Return each parameter under baseline and augmented model."""
        keys = ("name", "baseline", "baseline_stderr", "augmented", "augmented_stderr", "unit", "shift_sigma")
        rows = [tuple(r[k] for k in keys) for r in self._parameters]
        notes = []
        if self.answer["baseline"] != self.answer["augmented"]:
            notes.append("the baseline has the augmented model's friction field and gauge noise, to show what it lacks")
        notes += self._alternatives
        return Table("srf.diagnose.parameters/1", PARAMETERS, rows, "parameters", tuple(notes))

    @property
    def _parameters(self) -> list[dict[str, Any]]:
        """Return the rows of `parameter_rows` in the units of the recordings."""
        rows = parameter_rows(self.diagnosis)
        for row in rows:
            row["unit"], factor = self.diagnosis.experiment.shown(str(row["unit"]))
            for key in ("baseline", "baseline_stderr", "augmented", "augmented_stderr"):
                row[key] = row[key] and row[key] * factor
        return rows

    @property
    def _alternatives(self) -> list[str]:
        """Return each model of an ambiguous verdict with the parameters that it has and the baseline has not, as text."""
        close = self.diagnosis.close if self.verdict == "ambiguous" else ()
        return [f"{f.name}: {', '.join(self._added(f))}" for f in close]

    def _added(self, fitted: Fitted) -> list[str]:
        """Return the parameters that a model has and the baseline has not, as text."""
        told = []
        for name, found in added(fitted, self.diagnosis.baseline).items():
            if name != "ratio":
                unit, factor = self.diagnosis.experiment.shown(str(found["unit"]))
                shown, error = "" if unit == "1" else f" {unit}", f" +- {found['stderr'] * factor:.2g}"
                error = " at its bound" if math.isnan(found["stderr"]) else error
                told.append(f"{name} = {found['value'] * factor:.5g}{error}{shown}")
        return told or ["no parameter more"]

    @property
    def run_table(self) -> Table:
        """Return what is left of each run, its part of the misfit, and where that is."""
        places, rows = {r.name: r for r in self.location.runs}, []
        for v in run_views(self.diagnosis):
            place = places.get(v.run.name)
            where = "" if place is None else ", ".join(f"{a:.4g} to {b:.4g}" for a, b in place.windows)
            told = (None, None, where) if place is None else (place.share, place.p_value, where)
            rows.append((v.run.name, "held out" if v.run.holdout else "fit", *v.rms, *told))
        return Table("srf.diagnose.runs/1", RUNS, rows, "runs", tuple(_places(self.location)))

    @property
    def load_table(self) -> Table:
        """Return what is left of each table of critical loads."""
        rows = [(v.loads.name, "held out" if v.loads.holdout else "fit", v.size, *v.chi2) for v in load_views(self.diagnosis)]
        return Table("srf.diagnose.loads/1", LOADS, rows, "critical loads")

    @cached_property
    def _material(self) -> dict[str, Any]:
        """Return the arrays and tables of which figures and report are made, by name, in the units of the recordings."""
        diagnosis, experiment = self.diagnosis, self.diagnosis.experiment
        windows = {r.name: [list(w) for w in r.windows] for r in self.location.runs}
        friction = [smoothed_friction_field(f, with_parameters=False) for f in (diagnosis.baseline, diagnosis.best)]
        runs = []
        for v in run_views(diagnosis):
            run = v.run
            unit = f"  [{unit_text(run.unit)}]" if run.unit != "1" else ""
            runs.append({
                "name": run.name, "holdout": run.holdout, "label": f"{run.quantity}{unit}", "load_unit": run.load_unit,
                "t": run.t, "observed": run.observed, "used": run.used, "baseline": v.baseline, "augmented": v.augmented,
                "V": run.drive(run.t), "W": run.load(run.t)[0], "windows": windows.get(run.name, []),
                "rms": list(v.rms), "white": list(v.white),
                "friction": [None if run.holdout else found[run.name].force if run.name in found else np.zeros(run.t.size)
                             for found in friction],  # what a model leaves to its field
            })  # fmt: skip
        tables = [
            {"name": v.loads.name, "holdout": v.loads.holdout, "table": v.loads.table, "baseline": v.baseline,
             "augmented": v.augmented, "chi2": list(v.chi2)}
            for v in load_views(diagnosis)
        ]  # fmt: skip
        stiffness, unit = experiment.shown_stiffness
        tried = [e for ranked in diagnosis.ranked for e in ranked.hypothesis.effects]
        effects = [*tried, *diagnosis.best.hypothesis.effects]  # variants: the augmented model's
        return {
            "title": experiment.title,
            "about": {e.reported: e.about for e in effects},
            "texts": {e.reported: {"wrong": e.wrong, "remedy": e.remedy} for e in effects},
            "own": {e.reported: [*(p.name for p in e.parameters), *e.frees] for e in tried},
            "laws": sorted({ranked.hypothesis.ageing for ranked in diagnosis.ranked} - {""}),
            "stated": {"stiffness": f"{stiffness:.4g} {unit_text(unit)}", "ageing": experiment.choice.ageing},
            "runs": runs,
            "thresholds": tables,
            "residual_scan": list(map(_scan_row, self.location.rows)),
            "ranked": ranked_rows(diagnosis),
            "parameters": self._parameters,
            "alternatives": self._alternatives,
            "scores": [
                {"effect": s.effect.name}
                | {key: getattr(s, key) for key in ("gain", "size", "stderr", "tolerance", "detectable")}
                for s in diagnosis.scores
            ],
        }

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the run that the verdict rests on most: recording, both models, innovations, friction field, what was imposed.

        Without runs it is the first table of critical loads, under both models.
        """
        return plots.in_place(ax, self._panels)

    def _panels(self) -> Figure:
        made = self._material
        if not made["runs"]:
            return loads_figure(made["thresholds"][0])
        shares = {r.name: r.share for r in self.location.runs}
        runs = [r for r in made["runs"] if not r["holdout"]]
        return run_figure(trace(max(runs, key=lambda r: shares.get(r["name"], 0.0))))

    def write(
        self,
        folder: Path | str,
        *,
        force: bool = False,
        arguments: Sequence[str] = (),
        told: Callable[[str], None] = lambda text: None,
        debug: bool = False,
    ) -> str:
        """Write answer, predictions, report, figures and the augmented experiment to a folder, whole or not at all.

        Parameters
        ----------
        folder : path
            A new folder, or one with a diagnosis that `force` replaces.
        arguments : sequence of str
            Of the command, for the provenance.
        told : callable
            Told what could not be made, such as a report without Matplotlib.
        debug : bool
            Whether an error in the report is raised.

        Returns
        -------
        str
            Options by which `srf linear`, `continue`, `map` and `floquet` take the augmented model.

        Raises
        ------
        SrfError
            Where the folder holds something else, or cannot be written.
        """
        from srfcli.diagnosis.augment import augment
        from srfcli.diagnosis.diagram import as_fitted, stability

        folder, diagnosis, last, found = Path(folder), self.diagnosis, self.diagnosis.best, self.answer
        with whole_folder(folder, lambda: check_answer(folder, force=force)) as fresh:  # an hour may have passed
            text = (json_text(found, indent=2) + "\n").encode("utf-8")
            made = Provenance(
                arguments=tuple(arguments), laws=last.fit.likelihood.problem.model.laws,
                inputs=(diagnosis.experiment.path, *diagnosis.experiment.files), seed=self.seed,
                timings={"diagnose": self.seconds},
            )  # fmt: skip
            write_result(fresh / ANSWER, text, made)
            views = run_views(diagnosis)
            for name, view in zip(prediction_names([v.run.name for v in views]), views, strict=True):
                write_atomic(fresh / name, prediction_csv(view))
            augmented = augment(
                self.registry, diagnosis.experiment, last.hypothesis, last.fit, folder=folder / "augmented", reader=self.reader
            )
            (fresh / "augmented").mkdir()
            for name, content in augmented.files.items():
                write_atomic(fresh / "augmented" / name, content)
            for name, source in augmented.copies.items():
                shutil.copyfile(source, fresh / "augmented" / name)
            made_of = {**self._material, "system": augmented.options("augmented")}
            diagram = stability(
                self.registry, diagnosis.experiment, diagnosis.reported_baseline.fit.values,
                replace(as_fitted(last), runs=diagnosis.experiment.runs), augmented.left,
            )  # fmt: skip
            if diagram:
                marks = {(float(f"{V:.3g}"), float(f"{np.mean(r.load(r.t)[0]):.3g}"))
                         for r in diagnosis.experiment.runs for V, share in _velocities(r) if share > 0.1}  # fmt: skip
                load_unit = "MPa" if diagnosis.experiment.stress else "N"
                made_of["diagram"] = {**diagram, "marks": sorted(marks), "load_unit": load_unit}
            if self.missing:
                made_of["force"] = self.missing["force"]
                names = prediction_names(list(self.missing["csv"]), "missing")
                for name, content in zip(names, self.missing["csv"].values(), strict=True):
                    write_atomic(fresh / name, content)
                if self.missing["toml"] is not None:
                    write_atomic(fresh / FORM, self.missing["toml"])
            if self.discriminating is not None:
                made_of["discriminating"] = _proposed(fresh, folder, found, self)
            try:
                from srfcli.results.report import write_report

                write_report(fresh, found, made_of)
            except ModuleNotFoundError as error:
                told(f"Note: no report and no figures, as {error.name} is not installed")
            except Exception as error:  # minutes of computing are not to be lost for a figure
                if debug:
                    raise
                told(f"Warning: no report: {type(error).__name__}: {error}")
        return augmented.options(folder / "augmented")


def _scan_row(row: ScanStatistic) -> dict[str, Any]:
    """Return a place of the residual scan, v in um/s and phi in s, by whose logarithms samples were sorted."""
    found = asdict(row)
    if row.axis in ("v", "phi"):
        found |= {"low": float(np.exp(row.low)), "high": float(np.exp(row.high))}
    return found


def _notes(found: dict[str, Any], *, recorded: bool) -> list[str]:
    """Return notes on an answer; not `recorded`: it rests on critical loads alone."""
    notes = list(found["reasons"])
    for name, side in (("baseline", found["baseline"]), ("augmented model", found["augmented"])):
        held = side["holdout"]["rms_over_noise"]
        rest = "" if held is None else f", {held:.4g} in those held out"
        field = side["field"]
        track = "needs no friction field" if field is None else f"needs a friction field of amplitude {field['amplitude']:.2g}"
        like = (
            "with the augmented model's friction field and gauge noise, "
            if name == "baseline" and side != found["augmented"]
            else ""
        )
        told = f"rms over noise {side['fit']['rms_over_noise']:.4g} in"
        if recorded:
            notes.append(f"{name}: {track}; {like}{told} the runs fitted{rest}")
        else:
            notes.append(f"{name}: {told} the critical loads fitted{rest}")
    notes += [f"{a} and {b} cannot be told apart by these recordings" for a, b in found["equivalent"]]
    notes += [f"{x['effect']} is not identifiable: {x['reason']}" for x in found["not_identifiable"]]
    notes += _missing(found.get("missing") or {})
    notes += (found.get("experiment") or {}).get("sentences", [])
    for effect, size in found.get("detectable", {}).items():
        notes.append(f"{effect} could have been seen from a size of {size:.3g} on")
    return notes


def _missing(missing: dict[str, Any]) -> list[str]:
    """Return notes on a force that no registered effect explains."""
    if not missing:
        return []
    latent = missing["latent"]
    notes = [f"no effect explains a friction field of amplitude {latent['amplitude']:.2g} over {latent['length']:.2g} um of slip"]
    for name, share in list(latent["coordinates"].items())[:1]:
        notes[0] += f"; a function of {name} is {100 * share:.0f} % of it"
    if missing["form"] is None and not missing["searched"]:
        return [*notes, "the search for a closed form did not end"]
    if missing["form"] is None:
        return [*notes, "no closed form over the candidate terms is worth its parameters"]
    gain, held = missing["gain"], missing["held_gain"]
    told = "" if held is None else f", {held:+.1f} in held-out runs"
    left = "" if missing["leaves_noise_alone"] else f"; it leaves {missing['rms_over_noise']:.3g} times the noise"
    return [*notes, f"it behaves like {missing['form']}: log likelihood {gain:+.1f}{told}{left}"]


def _places(location: Location) -> list[str]:
    """Return notes on the phase, frequencies and quantity of state that the misfit goes with."""
    notes = []
    if location.forcing_phase is not None:
        notes.append("the misfit goes with the forcing: {:.2f} to {:.2f} rad after its maximum".format(*location.forcing_phase))
    if location.frequencies:
        lines = ", ".join(f"{f:.4g}" for f in location.frequencies)
        notes.append(f"the baseline's innovations have lines in their spectrum at {lines} Hz")
    if location.coordinate is not None:
        name, share = location.coordinate
        notes.append(f"a function of {name} alone explains {100 * share:.0f} % of the innovations' power")
    return notes


def check_answer(folder: Path, *, force: bool) -> None:
    """Raise SrfError where a diagnosis could not be written to `folder`."""
    if not check_folder_place(folder, what="--out") or not any(folder.iterdir()):
        return
    data: Any = None
    with contextlib.suppress(OSError, SrfError):
        data = parse_json(read_plain(folder / ANSWER, limit=LARGEST_ANSWER), folder)
    if not (isinstance(data, dict) and str(data.get("schema", "")).startswith(SCHEMA)):
        raise SrfError(f"--out {folder} holds something else than a diagnosis", "It is never replaced; name another.")
    if not force:
        raise SrfError(f"--out {folder} holds a diagnosis already", "Replace it with --force, or name another folder.")


def _velocities(run: Run) -> list[tuple[float, float]]:
    """Return the velocities at which a run was driven forward, to three digits, and the share of its time for each."""
    V, counts = np.unique([float(f"{v:.3g}") for v in run.drive(run.t[:: max(run.t.size // 2000, 1)])], return_counts=True)
    return [(float(v), float(c) / float(counts.sum())) for v, c in zip(V, counts, strict=True) if v > 0]


def _proposed(fresh: Path, folder: Path, found: Mapping[str, Any], result: DiagnosisResult) -> list[str]:
    """Write each hypothesis' prediction of the discriminating run, and return the report's sentences on it."""
    told = found["experiment"]
    assert result.discriminating is not None
    if not told["discriminates"]:
        return list(told["sentences"])
    files = discriminating_files(result.registry, result.diagnosis, result.discriminating, folder=folder, reader=result.reader)
    for place, text in files.items():
        (fresh / place).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(fresh / place, text)
    return [*told["sentences"], told["run"]]


def prediction_names(runs: list[str], word: str = "prediction") -> list[str]:
    """Return one file name per run, none twice even where case does not count; they begin with `word`."""
    names: list[str] = []
    for run in runs:
        stem = re.sub(r"[^\w .-]+", "-", run).strip(" .") or "run"
        names.append(unused_name(f"{word}-{stem}", ".csv", names))
    return names


def prediction_csv(view: RunView) -> str:
    """Return a run as recorded and as predicted by both models, in full precision; empty where there is nothing."""
    run, unit = view.run, view.run.unit
    heads = ["time [s]", f"observed [{unit}]", f"baseline [{unit}]", f"augmented [{unit}]"]
    columns = [run.t, np.where(run.used, run.observed, np.nan), view.baseline, view.augmented]
    for signal, sides in zip(run.others, view.others, strict=True):
        unit = run.unit_of(signal.observable)
        heads += [f"{signal.observable} {side} [{unit}]" for side in ("observed", "baseline", "augmented")]
        columns += [np.where(signal.used, signal.observed, np.nan), *sides]
    rows = list(zip(*(c.tolist() for c in columns), strict=True))
    return to_csv(Table("srf.prediction/1", tuple(map(Column, heads)), rows))
