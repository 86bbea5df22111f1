"""`srf new`: from a table of recorded numbers to an experiment.toml; `srf check`: what recordings hold and can tell."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import EXIT_CONDITION, EXIT_OK, Session, SrfCommand
from srfcli.cli.emit import Progress, emit
from srfcli.cli.options import PATH, POSITIVE, OutputOptions, open_registry, output_options, plugins_option, reader_option
from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.files import check_target, write_atomic

if TYPE_CHECKING:
    from srfcli.laws.registry import Registry

NEW = """
srf new run1.csv --stiffness '5.4e-3 1/um'             friction per micron, as rock labs state it
srf new run1.csv run2.csv --stiffness '55 MPa/mm'      one experiment, two runs
srf new shs.csv --kind shs --stiffness '1.2e-3 1/um' --window 100,900
srf new a.txt --column 'shear_stress=S [kPa]' --drive '60:3, 60:10' --load '20 MPa' --stiffness '55 MPa/mm'
srf new run1.csv --stiffness '5.4e-3 1/um' && srf check . && srf fit .
"""
CHECK = """
srf check experiment/                              sampling, flaws, noise, drive and load of every run
srf check experiment/ --plot check.svg             the runs as figures, flagged samples marked
srf check experiment/ --no-simulate                check the files only, without simulation
srf check experiment/ --fail-on gap --fail-on reset && srf fit experiment/
srf check experiment/ --json | jq .meta.runs       all that was found
"""
DRAFT_KINDS = ("steps", "shs", "oscillation")


@click.command("new", cls=SrfCommand, epilog=NEW)
@click.argument("files", metavar="DATA...", nargs=-1, required=True, type=PATH)
@click.option(
    "--stiffness", metavar="K", help="Stiffness of the machine: '0.21 N/um', '55 MPa/mm', or friction per um, '5e-3 1/um'."
)
@click.option(
    "--kind", type=click.Choice(DRAFT_KINDS), help="Velocity steps, slide-hold-slide, or an oscillating load; else as found."
)
@click.option(
    "--column", "columns", multiple=True, metavar="ROLE=HEADING", help="Which column plays a role: 'shear_stress=S [kPa]'."
)
@click.option("--drive", metavar="V|D:V,...", help="What was imposed, if no column has it: um/s, or durations in s and um/s.")
@click.option("--load", metavar="W", help="Constant normal load or stress, if no column has it: '5 N', '20 MPa'.")
@click.option("--mass", metavar="M", help="Mass of the slider, '2.37 kg'; without it the slider is quasi-static.")
@click.option("--radius", metavar="R", help="Radius of a rotary rig, '25 mm', for torques and angles.")
@click.option("--thickness", metavar="H", help="Thickness of the layer, '4 mm', where strain is recorded.")
@click.option("--area", metavar="A", help="Area of the sliding contact, '25 cm^2': forces then become stresses.")
@click.option("--window", metavar="FROM,TO", help="Only this part of the recordings, in s of the file's clock.")
@click.option("--law", metavar="NAME", default="dieterich-ruina", help="Friction law.")
@click.option("--ageing", metavar="NAME", help="Evolution law; else dieterich, with Linker's term where the load oscillates.")
@click.option("--interface", metavar="NAME", default="rigid", help="Shear stiffness of the interface, by name.")
@click.option("--holdout", multiple=True, metavar="RUN", help="Keep this run from every fit, to judge it.")
@click.option("--title", default="", show_default=False, metavar="TEXT", help="Title of the experiment.")
@reader_option
@click.option("--out", metavar="FILE", help="The file to write; - is stdout.  [default: experiment.toml in this folder]")
@click.option("--force", is_flag=True, help="Overwrite an existing file.")
@plugins_option
def new(files: tuple[Path, ...], out: str | None, force: bool, plugins: tuple[Path, ...], **options: Any) -> None:
    """Write a commented experiment.toml for recordings, which `srf check` and `srf fit` take.

    Columns are recognised by heading and unit; time, what was imposed and what was observed are found in the data. What the
    tables do not contain, the stiffness above all, is taken from the options, or asked for on a terminal.
    """
    from srfcli.laws.registry import load_registry
    from srfcli.tasks.recordings import new_experiment

    place = Path("experiment.toml" if out in (None, "") else str(out)).expanduser()
    if place.is_dir():
        place /= "experiment.toml"
    if out != "-":
        check_target(place, force=force)
    registry = load_registry(plugins)
    columns = dict(_column(text) for text in options.pop("columns"))
    if sys.stdin.isatty() and sys.stderr.isatty():
        options |= _asked(files[0], columns, options, registry)
    made = new_experiment(files, folder=place.parent, columns=columns, registry=registry, **options)
    session = Session.current()
    for column in made.draft.columns:
        assumed = ", which no heading says" if column.assumed and column.unit != "1" else ""
        session.say(f"{column.heading!r} is the {column.role.replace('_', ' ')}, in {column.unit}{assumed}")
    for remark in made.notes:
        session.say(f"Note: {remark}")
    if out == "-":
        click.echo(made.text, nl=False)
        return
    write_atomic(place, made.text)
    click.echo(str(place))
    where = "." if place.name == "experiment.toml" and place.parent == Path() else str(place)
    session.say(f"Next: srf check {where}   and then: srf fit {where}")


def _asked(path: Path, columns: dict[str, str], options: dict[str, Any], registry: Registry) -> dict[str, Any]:
    """Ask for the drive, load and stiffness that neither the first file nor the options say; columns go into `columns`."""
    from srfcli.data.columns import open_source
    from srfcli.data.draft import OBSERVED_ROLES, missing, name_columns

    drive, load, stiffness = options["drive"], options["load"], options["stiffness"]
    headings = open_source(path, registry=registry, format=options["reader"]).headings
    while True:
        named = name_columns(headings, columns, path=path, per_load=False)
        lacks = missing(named, path, headings, driven=drive is not None, loaded=load is not None)
        if not lacks:
            break
        option, sentence = lacks[0]
        if option.startswith("`columns` time"):
            columns["time"] = click.prompt(f"{sentence}. Time", err=True)
        elif option.startswith("`columns`"):
            role = click.prompt(f"{sentence}.\nWhat was observed", err=True, type=click.Choice(OBSERVED_ROLES[::-1]))
            columns[role] = click.prompt("In the column", err=True)
        elif option.startswith("`drive`"):
            drive = click.prompt(f"{sentence}. Velocity in um/s, or duration:velocity, ...", err=True)
        else:
            load = click.prompt(f"{sentence}. Normal load or stress, as 5 N or 20 MPa", err=True)
    if stiffness is None:
        stiffness = click.prompt("Stiffness of the machine, as 5.4e-3 1/um, 55 MPa/mm or 0.21 N/um", err=True)
    return {"drive": drive, "load": load, "stiffness": stiffness}


def _column(text: str) -> tuple[str, str]:
    role, equals, heading = text.partition("=")
    if not (equals and role.strip() and heading.strip()):
        raise SrfError(f"--column {text!r} is no ROLE=HEADING", "As in --column 'shear_stress=tau [MPa]'.")
    return role.strip(), heading.strip()


@click.command("check", cls=SrfCommand, epilog=CHECK)
@click.argument("experiment", type=PATH)
@click.option("--run", "runs", multiple=True, metavar="NAME", help="Report this run only; may be given several times.")
@click.option("--format", metavar="NAME", help="Reader of all data files; srf laws --kind reader lists them.")
@click.option(
    "--fail-on", multiple=True, metavar="KIND", help="Exit with 4 if there is a notice of this kind; `notice` is any of them."
)
@click.option("--limit", type=POSITIVE, default=512.0, metavar="MB", help="Largest recording that is held in memory.")
@click.option(
    "--simulate/--no-simulate", default=True, help="Simulate each run to compute the Cramer-Rao bounds of alpha, lambda and n."
)
@plugins_option
@output_options
def check(
    experiment: Path,
    runs: tuple[str, ...],
    format: str | None,
    fail_on: tuple[str, ...],
    limit: float,
    simulate: bool,
    plugins: tuple[Path, ...],
    output: OutputOptions,
) -> int:
    """Read and validate an experiment and report sampling, defects and noise of its recordings.

    Every value of the description is checked against the laws and the data files. For each run: sampling, gaps, spikes, resets,
    quantisation, level and colour of the noise, drive and load as they are in the data, and what the load's variation can tell.
    """
    from srfcli.data.experiment import NOTICE_KINDS, read_experiment
    from srfcli.tasks import recordings as tasks

    for kind in fail_on:
        if kind not in NOTICE_KINDS and kind != "notice":
            raise SrfError(f"--fail-on {kind}: no such kind of notice", did_you_mean(kind, (*NOTICE_KINDS, "notice")))
    registry = open_registry(plugins)
    read = read_experiment(experiment, registry=registry, format=format, limit=int(limit * 2**20))
    with Progress("check", total=len(read.named(runs))) as progress:
        found = tasks.check(
            read, runs=runs, simulate=simulate, registry=registry, progress=lambda name: progress.advance(note=name)
        )
    table, *more = found.pages if output.format == "text" else (found.table,)
    inputs = [read.path, *dict.fromkeys(one.run.file for one in found.runs)]
    emit(table, output, more=more, figure=found.plot, inputs=inputs, timings={"check": progress.seconds})
    kinds = found.notice_kinds
    failed = bool(kinds) if "notice" in fail_on else bool(kinds & set(fail_on))
    return EXIT_CONDITION if failed else EXIT_OK
