"""`srf diagnose`: where recordings and their model part, which physics is missing, and the model that has it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import EXIT_INTERRUPTED
from srfcli.cli.laws import plugins_option
from srfcli.cli.options import Session, SrfCommand
from srfcli.errors import SrfError, did_you_mean

if TYPE_CHECKING:
    from srfcli.diagnosis.parting import Parting
    from srfcli.diagnosis.search import Search
    from srfcli.diagnosis.verdict import Diagnosis
    from srfcli.registry import Registry

EXAMPLES = """
srf diagnose EXPERIMENT                              a folder with experiment.toml, or that file
srf diagnose EXPERIMENT --out found                  report, figures, predictions and the augmented model
srf diagnose EXPERIMENT --json
srf diagnose EXPERIMENT --effect linker-dieterich --effect load-transmission
srf fit found/augmented                              the augmented model is an experiment like any other
"""


@click.command("diagnose", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("source", metavar="EXPERIMENT", type=click.Path(path_type=Path))
@click.option("--effect", "effects", multiple=True, metavar="NAME", help="Look for this effect only; may be repeated.")
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

    The baseline of the experiment is fitted; where it leaves more than noise, every registered effect is tried for what it could
    explain beyond the baseline's own parameters and a rough track. Held-out runs are opened when the models are final, and judge
    them. Verdicts are none, identified, ambiguous, unknown and inconclusive.
    """
    from srfcli.cli.options import open_registry

    folder = None if options["out"] is None else Path(options["out"]).expanduser()
    if folder is not None:
        from srfcli.cli.diagnose_out import check_answer

        check_answer(folder, force=options["force"])
    registry = open_registry(plugins)
    _check_effects(registry, effects)
    _diagnose(source, registry, effects, folder, options)


def _check_effects(registry: Registry, effects: tuple[str, ...]) -> None:
    """Raise for an effect that nothing is registered under, and none is reported as."""
    from srfcli.laws import Effect

    if not effects:
        return
    known = {e.name for e in registry.entries("effect")}
    known |= {law.reported for e in registry.entries("effect") if isinstance(law := registry.load(e), Effect)}
    for name in effects:
        if name not in known:
            raise SrfError(f"unknown effect '{name}'", did_you_mean(name, sorted(known)))


def _diagnose(
    source: Path, registry: Registry, effects: tuple[str, ...], folder: Path | None, options: dict[str, Any]
) -> None:
    import time

    from srfcli.cli.diagnose_text import print_answer
    from srfcli.cli.emit import Progress, finish
    from srfcli.diagnosis.answer import answer, final, ranked_rows
    from srfcli.diagnosis.locate import locate
    from srfcli.diagnosis.search import Search
    from srfcli.diagnosis.verdict import conclude
    from srfcli.numerics.compiled import GET_COMPILER, compiler
    from srfcli.output.records import json_text
    from srfcli.output.tables import plain_value
    from srfcli.recording.experiment import read_experiment
    from srfcli.status import Status

    begun = time.perf_counter()
    experiment = read_experiment(source, registry=registry, format=options["reader"], holdout=False)
    if compiler() is None:
        raise SrfError("srf diagnose needs a C compiler: it fits dozens of models", GET_COMPILER)
    with Progress("diagnose") as progress:
        searching = False

        def report(text: str) -> None:
            progress.advance(note=text, bound=search.share if searching else None)
            Session.current().detail(text)

        search = Search(registry, experiment, report, effects or None, options["trend"])
        searching = True
        status = _searched(search)
        searching = False
        report("held-out runs")
        whole = read_experiment(source, registry=registry, format=options["reader"])
        diagnosis = conclude(search, whole)
        report("location")
        last = None if final(diagnosis) is diagnosis.baseline else final(diagnosis).fit
        location = locate(diagnosis.baseline.fit, diagnosis.noise, last=last, seed=options["seed"])
        missing = _explained(search, diagnosis) if status is Status.OK else {}
        parting = _parted(registry, diagnosis, options["seed"]) if status is Status.OK else None
    found = plain_value(answer(diagnosis, location, parting=parting))
    if missing:
        found["missing"] = plain_value({k: v for k, v in missing.items() if k not in ("force", "toml")})
    if status is not Status.OK:
        found["status"] = status.value
    if folder is not None:
        from srfcli.cli.diagnose_out import write_answer

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


def _explained(search: Search, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return what there is to say of a force that no registered effect explains; nothing for other verdicts."""
    from srfcli.diagnosis.terms import explain_unknown

    return explain_unknown(search, diagnosis) if diagnosis.verdict == "unknown" else {}


def _parted(registry: Registry, diagnosis: Diagnosis, seed: int) -> Parting | None:
    """Return the run that would part what is ambiguous; nothing for other verdicts."""
    if diagnosis.verdict != "ambiguous":
        return None
    from srfcli.diagnosis.parting import parting_experiment

    return parting_experiment(registry, diagnosis, seed=seed)


def _searched(search: Search) -> Any:
    """Run the search; interrupted, it keeps what it has if the baseline is fitted."""
    from srfcli.status import Status

    try:
        search.run()
    except KeyboardInterrupt:
        if not any(not r.hypothesis.effects for r in search.tried.values()):
            raise SrfError(
                "interrupted before the baseline was fitted; nothing is kept",
                "`srf fit` of the same experiment keeps what it has at any time.",
                exit_code=EXIT_INTERRUPTED,
            ) from None
        return Status.INTERRUPTED
    return Status.OK
