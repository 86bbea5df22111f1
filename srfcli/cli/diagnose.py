"""`srf diagnose`: where recordings and their model differ, which physics is missing, and the model that has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from srfcli.cli.base import EXIT_INTERRUPTED, Session, SrfCommand
from srfcli.cli.options import listed, open_registry, plugins_option, reader_option, vary_options
from srfcli.core.errors import SrfError

EXAMPLES = """
srf diagnose EXPERIMENT                              a folder with experiment.toml, or that file
srf diagnose EXPERIMENT --out found                  report, figures, predictions and the augmented model
srf diagnose EXPERIMENT --json
srf diagnose EXPERIMENT --effect linker-dieterich --effect load-transmission
srf fit found/augmented                              the augmented model is an experiment like any other
"""


@click.command("diagnose", cls=SrfCommand, epilog=EXAMPLES)
@click.argument("source", metavar="EXPERIMENT", type=click.Path(path_type=Path))
@click.option(
    "--effect", "effects", multiple=True, metavar="NAME", help="Look for this effect or ageing law only; repeatable."
)
@vary_options
@plugins_option
@reader_option
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
    """Say where recordings, or critical loads, and their model part, and which physics the model lacks.

    The baseline of the experiment is fitted with a random friction field and coloured gauge noise. Every registered effect is
    scored for what it could explain beyond these, and those that promise most are fitted. Held-out runs are opened when the
    models are final, and judge them. Verdicts are none, identified, ambiguous, unknown and inconclusive.
    """
    from srfcli.cli.emit import Progress, finish, show
    from srfcli.results.diagnosis import check_answer
    from srfcli.results.tables import json_text
    from srfcli.tasks.diagnose import diagnose

    folder = None if options["out"] is None else Path(options["out"]).expanduser()
    if folder is not None:
        check_answer(folder, force=options["force"])
    registry, session = open_registry(plugins), Session.current()
    with Progress("diagnose") as progress:

        def told(text: str, share: float | None) -> None:
            progress.advance(note=text, bound=share)
            session.detail(text)

        try:
            found = diagnose(
                source, effects=effects, trend=options["trend"], vary=listed(options["vary"]), by=options["by"],
                reader=options["reader"], seed=options["seed"], registry=registry, progress=told,
            )  # fmt: skip
        except KeyboardInterrupt:
            raise SrfError(
                "interrupted before the baseline was fitted; nothing is kept",
                "`srf fit` of the same experiment keeps what it has at any time.",
                exit_code=EXIT_INTERRUPTED,
            ) from None
    if folder is not None:
        found.write(folder, force=options["force"], arguments=session.arguments, told=session.say, debug=session.debug)
        session.say(f"Wrote {folder}")
    if options["as_json"]:
        click.echo(json_text(found.answer, indent=2))
    else:
        click.echo(f"{found.sentence}\n")
        for table in (found.table, found.parameter_table, *(t for t in (found.run_table, found.load_table) if t.rows)):
            show(table)
            click.echo()
        if folder is not None:
            home = folder / "augmented"
            laws = (
                f"--law {home / 'friction.toml'} --ageing {home / 'ageing.toml'} --interface {home / 'interface.toml'}"
            )
            click.echo(f"The augmented model: srf fit {home}")
            click.echo(f"Its laws' diagram: srf linear {laws}")
    fitted = ", ".join(sorted(f.name for f in found.diagnosis.ranked))
    finish(
        found.status,
        advice=f"the answer rests on what was fitted until then: {fitted}. Effects not among these were not tried.",
    )
