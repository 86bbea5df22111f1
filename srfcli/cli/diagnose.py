"""`srf diagnose`: where recordings and their model differ, which physics is missing, and the model that has it."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import EXIT_INTERRUPTED, Session, SrfCommand
from srfcli.cli.law import plugins_option
from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.files import parse_json, read_plain, recover, whole_folder, write_atomic
from srfcli.core.units import split_quantity
from srfcli.results.report_text import unit_text
from srfcli.results.tables import Column, Table, print_terminal, to_text

if TYPE_CHECKING:
    from srfcli.data.values import Run
    from srfcli.diagnosis.answer import RunView
    from srfcli.diagnosis.design import Parting
    from srfcli.diagnosis.residual_scan import Location
    from srfcli.diagnosis.search import ModelSearch
    from srfcli.diagnosis.verdict import Diagnosis
    from srfcli.laws.registry import Registry

# `srf diagnose`: where recordings and their model part, which physics is missing, and the model that has it.

EXAMPLES = """
srf diagnose EXPERIMENT                              a folder with experiment.toml, or that file
srf diagnose EXPERIMENT --out found                  report, figures, predictions and the augmented model
srf diagnose EXPERIMENT --json
srf diagnose EXPERIMENT --effect linker-dieterich --effect load-transmission
srf fit found/augmented                              the augmented model is an experiment like any other
"""


@click.command("diagnose", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("source", metavar="EXPERIMENT", type=click.Path(path_type=Path))
@click.option("--effect", "effects", multiple=True, metavar="NAME", help="Look for this effect or ageing law only; repeatable.")
@click.option("--trend", type=click.Choice(["slip", "time"]), help="Let each run's observable drift with slip or time.")
@plugins_option
@click.option("--format", "reader", metavar="READER", help="Read every data file by this reader.")
@click.option(
    "--seed",
    type=int,
    default=0,
    show_default=True,
    help="Of the noise that is simulated for p-values, and of runs that are tried.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one object, in full precision.")
@click.option("--out", metavar="DIR", help="Write answer, report, predictions and augmented experiment to DIR.")
@click.option("--force", is_flag=True, help="Replace a diagnosis that is in DIR already.")
def command(source: Path, effects: tuple[str, ...], plugins: tuple[Path, ...], **options: Any) -> None:
    """Say where recordings and their model part, and which physics the model lacks.

    The baseline of the experiment is fitted with a random friction field and coloured gauge noise. Every registered effect is
    scored for what it could explain beyond these, and those that promise most are fitted. Held-out runs are opened when the
    models are final, and judge them. Verdicts are none, identified, ambiguous, unknown and inconclusive.
    """
    from srfcli.cli.options import open_registry

    folder = None if options["out"] is None else Path(options["out"]).expanduser()
    if folder is not None:
        check_answer(folder, force=options["force"])
    registry = open_registry(plugins)
    _check_effects(registry, effects)
    _diagnose(source, registry, effects, folder, options)


def _check_effects(registry: Registry, effects: tuple[str, ...]) -> None:
    """Raise for an effect that nothing is registered under, and none is reported as."""
    from srfcli.laws.values import Effect

    if not effects:
        return
    known = {e.name for e in (*registry.entries("effect"), *registry.entries("ageing"))}
    known |= {law.reported for e in registry.entries("effect") if isinstance(law := registry.load(e), Effect)}
    for name in effects:
        if name not in known:
            raise SrfError(f"unknown effect '{name}'", did_you_mean(name, sorted(known)))


def _diagnose(
    source: Path, registry: Registry, effects: tuple[str, ...], folder: Path | None, options: dict[str, Any]
) -> None:
    import time

    from srfcli.cli.emit import Progress, finish
    from srfcli.codegen.c_source import GET_COMPILER, compiler
    from srfcli.core.errors import Status
    from srfcli.data.experiment import read_experiment
    from srfcli.diagnosis.answer import answer, ranked_rows
    from srfcli.diagnosis.discrepancy import explain_unknown
    from srfcli.diagnosis.residual_scan import locate
    from srfcli.diagnosis.search import ModelSearch
    from srfcli.diagnosis.verdict import conclude
    from srfcli.results.tables import json_text, plain_value

    begun = time.perf_counter()
    experiment = read_experiment(source, registry=registry, format=options["reader"], holdout=False)
    if compiler() is None:
        raise SrfError("srf diagnose needs a C compiler: it fits dozens of models", GET_COMPILER)
    with Progress("diagnose") as progress:
        searching = False

        def report(text: str) -> None:
            progress.advance(note=text, bound=search.share if searching else None)
            Session.current().detail(text)

        search = ModelSearch(registry, experiment, report, effects or None, options["trend"])
        searching = True
        status = _searched(search)
        searching = False
        report("held-out runs")
        whole = read_experiment(source, registry=registry, format=options["reader"])
        diagnosis = conclude(search, whole)
        report("location")
        last = None if diagnosis.final is diagnosis.baseline or not diagnosis.final.fine else diagnosis.final
        location = locate(diagnosis.baseline, last=last, seed=options["seed"])
        missing: dict[str, Any] = {}
        if status is Status.OK and diagnosis.verdict == "unknown":

            def stopped() -> None:
                nonlocal status
                status = Status.INTERRUPTED

            report(SENTENCES["unknown"])
            missing = explain_unknown(search, diagnosis, stopped=stopped)
        parting = _parted(registry, diagnosis, options["seed"]) if status is Status.OK else None
    found = plain_value(answer(diagnosis, location, parting=parting))
    if missing:
        found["missing"] = plain_value({k: v for k, v in missing.items() if k not in ("force", "toml", "csv")})
    if status is not Status.OK:
        found["status"] = status.value
    if folder is not None:
        seconds = time.perf_counter() - begun
        write_answer(
            folder, found, diagnosis, location, registry, reader=options["reader"], seed=options["seed"], seconds=seconds,
            force=options["force"], missing=missing, parting=parting,
        )  # fmt: skip
    if options["as_json"]:
        click.echo(json_text(found, indent=2))
    else:
        print_answer(found, diagnosis, location, folder)
    fitted = ", ".join(sorted(str(r["name"]) for r in ranked_rows(diagnosis)))
    finish(
        status,
        advice=f"the answer rests on what was fitted until then: {fitted}. Effects not among these were not tried.",
    )


def _parted(registry: Registry, diagnosis: Diagnosis, seed: int) -> Parting | None:
    """Return the run that would part what is ambiguous; nothing for other verdicts."""
    if diagnosis.verdict != "ambiguous":
        return None
    from srfcli.diagnosis.design import parting_experiment

    return parting_experiment(registry, diagnosis, seed=seed)


def _searched(search: ModelSearch) -> Any:
    """Run the search; interrupted, it keeps what it has if the baseline is fitted."""
    from srfcli.core.errors import Status
    from srfcli.inference.fit import Interrupted

    try:
        search.run()
    except (KeyboardInterrupt, Interrupted):
        if not search.fitted:
            raise SrfError(
                "interrupted before the baseline was fitted; nothing is kept",
                "`srf fit` of the same experiment keeps what it has at any time.",
                exit_code=EXIT_INTERRUPTED,
            ) from None
        return Status.INTERRUPTED
    return Status.OK


# What `srf diagnose` prints for a reader: the verdict in a sentence, then tables of what it rests on.

HYPOTHESES = (
    Column("hypothesis", "", "effects added to the baseline"),
    Column("evidence", "", "log evidence over the baseline's", ".1f"),
    Column("rms_over_noise", "", "of the innovations: 1 where all but noise is explained", ".4f"),
    Column("field", "", "amplitude of the random friction that it needs", ".2g"),
    Column("confidence", "", "stated", ".3f"),
    Column("against", "", "what speaks against it"),
)
PARAMETERS = (
    Column("parameter", "", "name"),
    Column("baseline", "", "estimate"),
    Column("stderr", "", "its standard error", ".2g"),
    Column("augmented", "", "estimate in the final model"),
    Column("stderr ", "", "its standard error", ".2g"),
    Column("unit", "", "of the four before"),
    Column("bent_by", "", "how far the baseline was off, in the final model's standard errors", ".1f"),
)
RUNS = (
    Column("run", "", "name"),
    Column("role", "", "fit, or held out"),
    Column("baseline", "", "innovations over noise, rms", ".4f"),
    Column("augmented", "", "innovations over noise, rms", ".4f"),
    Column("share", "", "of the baseline's excess misfit", ".2f"),
    Column("p_value", "", "adjusted for all that was looked at", ".1g"),
    Column("where", "", "times (s) that hold most of it"),
)
SENTENCES = {
    "none": "none: the baseline explains the recordings down to the noise",
    "identified": "identified: {}",
    "ambiguous": "ambiguous: {}: they do equally well",
    "unknown": "unknown: something is missing that no registered effect explains",
    "inconclusive": "inconclusive: nothing is needed, and effects of interesting size could not have been seen",
}
MOST = 8  # hypotheses that are shown


def print_answer(found: dict[str, Any], diagnosis: Diagnosis, location: Location, folder: Path | None) -> None:
    """Print verdict and tables to stdout."""
    from srfcli.diagnosis.answer import parameter_rows, ranked_rows, run_views

    click.echo(SENTENCES[found["verdict"]].format(" and ".join(found["effects"])))
    click.echo()
    ranked = ranked_rows(diagnosis)
    zero = next(r["evidence"] for r in ranked if r["name"] == "none")
    rows = [
        (r["name"], r["evidence"] - zero, r["rms_over_noise"], r["field"], r["confidence"], r["against"])
        for r in ranked[:MOST]
    ]
    _print(Table("srf.diagnose.hypotheses/1", HYPOTHESES, rows, "hypotheses", tuple(_notes(found))))
    keys = ("name", "baseline", "baseline_stderr", "augmented", "augmented_stderr", "unit", "shift_sigma")
    rows = [tuple(r[k] for k in keys) for r in parameter_rows(diagnosis)]
    _print(Table("srf.diagnose.parameters/1", PARAMETERS, rows, "parameters"))
    places = {r.name: r for r in location.runs}
    rows = []
    for v in run_views(diagnosis):
        place = places.get(v.run.name)
        where = "" if place is None else ", ".join(f"{a:.4g} to {b:.4g}" for a, b in place.windows)
        told = (None, None, where) if place is None else (place.share, place.p_value, where)
        rows.append((v.run.name, "held out" if v.holdout else "fit", *v.rms, *told))
    _print(Table("srf.diagnose.runs/1", RUNS, rows, "runs", tuple(_places(location))))
    if folder is not None:
        home = folder / "augmented"
        laws = f"--law {home / 'friction.toml'} --ageing {home / 'ageing.toml'} --interface {home / 'interface.toml'}"
        click.echo(f"The augmented model: srf fit {home}")
        click.echo(f"Its laws' diagram: srf linear {laws}")


def _print(table: Table) -> None:
    if sys.stdout.isatty():
        print_terminal(table, sys.stdout)
    else:
        click.echo(to_text(table), nl=False)
    click.echo()


def _notes(found: dict[str, Any]) -> list[str]:
    notes = list(found["reasons"])
    for name, side in (("baseline", found["baseline"]), ("final model", found["augmented"])):
        held = side["holdout"]["rms_over_noise"]
        rest = "" if held is None else f", {held:.4g} in those held out"
        field = side["field"]
        track = "needs no random friction" if field is None else f"needs random friction of {field['amplitude']:.2g}"
        like = " with the final model's" if name == "baseline" and found["baseline"] != found["augmented"] else ""
        notes.append(f"{name}: {track};{like} rms over noise {side['fit']['rms_over_noise']:.4g} in the runs fitted{rest}")
    notes += [f"{a} and {b} cannot be told apart by these recordings" for a, b in found["equivalent"]]
    notes += [f"{x['effect']} is not identifiable: {x['reason']}" for x in found["not_identifiable"]]
    notes += _missing(found.get("missing") or {})
    notes += (found.get("experiment") or {}).get("sentences", [])
    for effect, size in found.get("detectable", {}).items():
        notes.append(f"{effect} could have been seen from a size of {size:.3g} on")
    return notes


def _missing(missing: dict[str, Any]) -> list[str]:
    """Return what is known of a force that no registered effect explains."""
    if not missing:
        return []
    latent = missing["latent"]
    notes = [f"friction of {latent['amplitude']:.2g} that varies within {latent['length']:.2g} um of slip is unexplained"]
    for name, share in list(latent["coordinates"].items())[:1]:
        notes[0] += f"; a function of {name} is {100 * share:.0f} % of it"
    if missing["form"] is None:
        return [*notes, "no closed form over the candidate terms is worth its parameters"]
    gain, held = missing["gain"], missing["held_gain"]
    told = "" if held is None else f", {held:+.1f} in held-out runs"
    left = "" if missing["leaves_noise_alone"] else f"; it leaves {missing['rms_over_noise']:.3g} times the noise"
    return [*notes, f"it behaves like {missing['form']}: log likelihood {gain:+.1f}{told}{left}"]


def _places(location: Location) -> list[str]:
    notes = []
    if location.forcing_phase is not None:
        notes.append(
            "the misfit goes with the forcing: {:.2f} to {:.2f} rad after its maximum".format(*location.forcing_phase)
        )
    if location.frequencies:
        notes.append(f"it has lines at {', '.join(f'{f:.4g}' for f in location.frequencies)} Hz")
    if location.coordinate is not None:
        name, share = location.coordinate
        notes.append(f"a function of {name} explains {100 * share:.0f} % of it")
    return notes


# The folder that `srf diagnose --out` writes: whole or not at all, never over anything but another diagnosis.

ANSWER = "answer.json"
LARGEST = 2**28  # bytes of an answer
FORM = "closed-form.toml"
SCHEMA = "srf.diagnose/"


def check_answer(folder: Path, *, force: bool) -> None:
    """Raise SrfError now if a diagnosis could not be written to `folder` later."""
    recover(folder)
    parent = Path(os.path.realpath(folder)).parent
    if not parent.is_dir():
        raise SrfError(f"--out {folder}: the directory {parent} does not exist", f"Create it: mkdir -p {parent}")
    if not os.access(parent, os.W_OK):
        raise SrfError(
            f"--out {folder}: the directory {parent} is not writable", "Name a folder elsewhere.", exit_code=1
        )
    if not os.path.lexists(folder):
        return
    if not folder.is_dir() or folder.is_symlink():
        raise SrfError(f"--out {folder} exists and is not a folder", "Name another folder.")
    if not any(folder.iterdir()):
        return
    if not _is_diagnosis(folder):
        raise SrfError(f"--out {folder} holds something else than a diagnosis", "It is never replaced; name another.")
    if not force:
        raise SrfError(f"--out {folder} holds a diagnosis already", "Replace it with --force, or name another folder.")


def _is_diagnosis(folder: Path) -> bool:
    try:
        data = parse_json(read_plain(folder / ANSWER, limit=LARGEST), folder)
    except (OSError, SrfError):
        return False
    return isinstance(data, dict) and str(data.get("schema", "")).startswith(SCHEMA)


def write_answer(
    folder: Path,
    found: dict[str, Any],
    diagnosis: Diagnosis,
    location: Location,
    registry: Registry,
    *,
    reader: str | None,
    seed: int,
    seconds: float,
    force: bool = False,
    missing: Mapping[str, Any] | None = None,
    parting: Parting | None = None,
) -> None:
    """Write answer, predictions, augmented experiment, report and figures; of a `missing` force its closed form, as an effect.

    Of a `parting` run an experiment for each hypothesis is written.
    """
    from srfcli.data.experiment import read_experiment
    from srfcli.diagnosis.answer import material, run_views
    from srfcli.diagnosis.augment import augment
    from srfcli.diagnosis.diagram import stability
    from srfcli.results.provenance import Provenance, write_sidecar
    from srfcli.results.tables import json_text

    last = diagnosis.final
    with whole_folder(folder, lambda: check_answer(folder, force=force)) as fresh:  # an hour may have passed
        text = (json_text(found, indent=2) + "\n").encode("utf-8")
        write_atomic(fresh / ANSWER, text)
        runs = diagnosis.experiment.runs
        inputs = (diagnosis.experiment.path, *dict.fromkeys(r.file for r in runs))
        made = Provenance(
            arguments=Session.current().arguments, laws=last.fit.likelihood.problem.model.laws, inputs=inputs, seed=seed,
            timings={"diagnose": seconds},
        )  # fmt: skip
        write_sidecar(fresh / ANSWER, text, made)
        for name, view in zip(
            prediction_names([v.run.name for v in run_views(diagnosis)]), run_views(diagnosis), strict=True
        ):
            write_atomic(fresh / name, prediction_csv(view))
        augmented = augment(
            registry, diagnosis.experiment, last.hypothesis, last.fit, folder=folder / "augmented", reader=reader
        )
        (fresh / "augmented").mkdir()
        for name, content in augmented.files.items():
            write_atomic(fresh / "augmented" / name, content)
        for name, source in augmented.copies.items():
            shutil.copyfile(source, fresh / "augmented" / name)
        made_of = material(diagnosis, location)
        made_of["diagram"] = stability(
            registry, diagnosis.experiment, diagnosis.shown.fit.values,
            read_experiment(fresh / "augmented", registry=registry, format=reader),
        )  # fmt: skip
        _in_shown_units(made_of, diagnosis)
        if missing:
            made_of["force"] = missing["force"]
            names = prediction_names(list(missing["csv"]), "missing")
            for name, text in zip(names, missing["csv"].values(), strict=True):
                write_atomic(fresh / name, text)
            if missing["toml"] is not None:
                write_atomic(fresh / FORM, missing["toml"])
        if parting is not None:
            made_of["parting"] = _proposed(fresh, folder, found, diagnosis, registry, parting, reader=reader)
        _report(fresh, found, made_of)
    Session.current().say(f"Wrote {folder}")


def _in_shown_units(made_of: dict[str, Any], diagnosis: Diagnosis) -> None:
    """Put what the report shows into the units of the recordings, and add what the user stated and where the runs were made."""
    import numpy as np

    experiment = diagnosis.experiment
    runs = {run.name: run for run in experiment.runs}
    for shown in made_of["runs"]:
        run = runs[shown["name"]]
        unit = f"  [{unit_text(run.unit)}]" if run.unit != "1" else ""
        shown |= {"label": f"{run.quantity}{unit}", "load_unit": run.load_unit}
    for row in made_of["parameters"]:
        row["unit"], factor = experiment.shown(str(row["unit"]))
        for key in ("baseline", "baseline_stderr", "augmented", "augmented_stderr"):
            row[key] = row[key] and row[key] * factor
    number, unit = split_quantity(experiment.stiffness_text, name="stiffness")
    shown_unit, factor = experiment.shown(unit) if unit in ("N/um", "1/um") else (unit, 1.0)
    made_of["stated"] = {"stiffness": f"{number * factor:.4g} {unit_text(shown_unit)}"}
    made_of["own"] = {
        effect.reported: [*(p.name for p in effect.parameters), *effect.frees]
        for ranked in diagnosis.ranked for effect in ranked.hypothesis.effects
    }  # fmt: skip
    if made_of.get("diagram"):
        marks = {(float(f"{V:.3g}"), float(f"{np.mean(r.load(r.t)[0]):.3g}"))
                 for r in experiment.runs for V, share in _velocities(r) if share > 0.1}  # fmt: skip
        made_of["diagram"] |= {"marks": sorted(marks), "load_unit": "MPa" if experiment.stress else "N"}


def _velocities(run: Run) -> list[tuple[float, float]]:
    """Return the velocities at which a run was driven forward, to three digits, and the share of its time for each."""
    import numpy as np

    V, counts = np.unique(
        [float(f"{v:.3g}") for v in run.drive(run.t[:: max(run.t.size // 2000, 1)])], return_counts=True
    )
    return [(float(v), float(c) / float(counts.sum())) for v, c in zip(V, counts, strict=True) if v > 0]


def _proposed(
    fresh: Path, folder: Path, found: Mapping[str, Any], diagnosis: Diagnosis, registry: Registry, parting: Parting, *,
    reader: str | None,
) -> list[str]:  # fmt: skip
    """Write what each hypothesis foretells of the run that would part them, and return what the report says of it."""
    from srfcli.diagnosis.design import parting_files

    told = found["experiment"]
    if not told["parts"]:
        return list(told["sentences"])
    for place, text in parting_files(registry, diagnosis, parting, folder=folder, reader=reader).items():
        (fresh / place).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(fresh / place, text)
    return [*told["sentences"], told["run"]]


def _report(folder: Path, found: dict[str, Any], made: dict[str, Any]) -> None:
    try:
        from srfcli.results.report import write_report

        write_report(folder, found, made)
    except ModuleNotFoundError as error:
        Session.current().say(f"Note: no report and no figures, as {error.name} is not installed")
    except Exception as error:  # minutes of computing are not to be lost for a figure
        if Session.current().debug:
            raise
        Session.current().say(f"Warning: no report: {type(error).__name__}: {error}")


def prediction_names(runs: list[str], word: str = "prediction") -> list[str]:
    """Return one file name per run, none twice even where case does not count; they begin with `word`."""
    names: list[str] = []
    for run in runs:
        stem = re.sub(r"[^\w .-]+", "-", run).strip(" .") or "run"
        name, number = f"{word}-{stem}.csv", 2
        while name.lower() in (other.lower() for other in names):
            name, number = f"{word}-{stem}-{number}.csv", number + 1
        names.append(name)
    return names


def prediction_csv(view: RunView) -> str:
    """Return a run as recorded and as predicted by both models, in full precision; empty where there is nothing."""
    import numpy as np

    unit = view.run.unit
    lines = [f"time [s],observed [{unit}],baseline [{unit}],augmented [{unit}]"]
    observed = np.where(view.run.used, view.run.observed, np.nan)
    columns = (view.run.t, observed, view.baseline, view.augmented)
    for row in zip(*(c.tolist() for c in columns), strict=True):
        lines.append(",".join(repr(x) if np.isfinite(x) else "" for x in row))
    return "\n".join(lines) + "\n"
