"""`experiment.toml` in the format `srf-experiment/1`, read and validated without opening any data file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from srfcli.atomic import recover
from srfcli.errors import SrfError, did_you_mean
from srfcli.recording.node import Node, open_node
from srfcli.recording.quantities import same_dimension, unit_factor
from srfcli.units import is_stress, split_quantity

FORMAT = "srf-experiment/1"
FILE_NAME = "experiment.toml"
ROLES = {  # what a column may be, and the unit of a number in it where neither heading nor [columns] say
    "time": "s",
    "load_point_velocity": "um/s",
    "load_point_displacement": "um",
    "normal_load": "N",
    "normal_stress": "MPa",
    "elongation": "um",
    "force": "N",
    "shear_stress": "MPa",
    "friction": "1",
}
_TOP = ("format", "title", "apparatus", "model", "parameters", "columns", "runs")
_COLUMN = ("name", "unit", "scale", "offset", "integrate")
_RUN = ("name", "file", "format", "holdout", "window", "drive", "start", "load", "modulation", "initial")
_RUNS = '[[runs]] with name = "..." and file = "....csv" for each recording.'


@dataclass(frozen=True)
class Apparatus:
    """The loading stage: `stiffness` in N/um, or in 1/um where `per_load` (friction per micron), and the mass or None.

    `text` states it in N/um or 1/um, `unit` is which of the two, `stated` the unit that the description has.
    """

    stiffness: float
    per_load: bool
    text: str
    unit: str
    stated: str
    mass: float | None


@dataclass(frozen=True)
class ColumnSpec:
    """Which column of a file plays a role, and how its numbers become quantities: (number scale + offset) in `unit`."""

    name: str
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    integrate: bool = False
    node: Node | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class RunDescription:
    """What the description says of one run; `drive` holds (duration, velocity) pairs, None where columns say it."""

    name: str
    file: Path
    format: str | None
    holdout: bool
    window: tuple[float, float] | None
    drive: tuple[tuple[float, float], ...] | None
    start: float
    load: float | None
    modulation: tuple[float, float, float] | None
    initial: str
    node: Node = field(repr=False, compare=False)


@dataclass(frozen=True)
class Description:
    """A whole `experiment.toml`; `model` and `parameters` are still nodes, as only the laws can judge them."""

    path: Path
    title: str
    apparatus: Apparatus
    model: Node
    parameters: Node | None
    columns: Mapping[str, ColumnSpec]
    runs: tuple[RunDescription, ...]


def read_description(path: Path) -> Description:
    """Return what the experiment folder or TOML file at `path` says; raises SrfError with file and line for a breach."""
    file = find_file(path)
    root = open_node(file)
    declared = root.get("format")
    start = f'Start the file with format = "{FORMAT}".'
    if declared is None:
        raise SrfError(f"{file}: format: missing, expected {FORMAT!r}", start)
    if declared.value != FORMAT:
        declared.expected(f'"{FORMAT}"', start)
    root.keys(_TOP)
    title = root.get("title")
    apparatus = root.require("apparatus", '[apparatus] with stiffness = "0.21 N/um".').table("[apparatus].")
    parameters, columns = root.get("parameters"), root.get("columns")
    return Description(
        path=file,
        title=title.text() if title else "",
        apparatus=_apparatus(apparatus),
        model=root.require("model", '[model] with law = "srf-vsat" and ageing = "dieterich".').table("[model]."),
        parameters=parameters.table("[parameters].") if parameters else None,
        columns=_columns(columns.table("[columns].")) if columns else {},
        runs=_runs(root.require("runs", _RUNS)),
    )


def find_file(path: Path) -> Path:
    """Return the TOML file that `path`, an experiment's folder or file, means."""
    if not path.exists():
        recover(path)  # a process that replaced it may have been killed
    if not path.exists():
        raise SrfError(f"no experiment {path}", f"Give a folder with an {FILE_NAME}, or the TOML file.")
    if path.is_dir():
        file = path / FILE_NAME
        if not file.is_file():
            others = sorted(p.name for p in path.glob("*.toml"))
            hint = f"Name the file: {path / others[0]}" if others else "srf new DATA.csv writes one for recorded data."
            raise SrfError(f"{path}: holds no {FILE_NAME}", hint)
        return file
    if not path.is_file():
        raise SrfError(f"{path}: neither a folder nor a file", f"Give a folder with an {FILE_NAME}, or the TOML file.")
    return path


def _apparatus(node: Node) -> Apparatus:
    node.keys(("stiffness", "mass"))
    hint = 'Write stiffness = "0.21 N/um", "1.5 MPa/mm", or "1.0e-3 1/um" for friction per micron.'
    stiffness = node.require("stiffness", hint)
    if not isinstance(stiffness.value, str):
        stiffness.expected("text with a number and its unit", hint)
    try:
        number, unit = split_quantity(stiffness.value, name="stiffness", example="0.21 N/um")
        if not unit:
            stiffness.fail(f"'{stiffness.value}' has no unit, and two are possible", hint)
        per_load = same_dimension(unit, "1/um")
        value = number * unit_factor(unit, "1/um" if per_load else "N/um")
    except SrfError as error:
        if error.message.startswith(str(node.file)):
            raise
        stiffness.fail(error.message, error.hint if "unknown unit" in error.message else hint)
    if not value > 0:
        stiffness.expected("a positive stiffness")
    mass = node.get("mass")
    kilograms = mass.quantity("kg") if mass else 0.0
    if mass and kilograms < 0:
        mass.expected('a mass of 0 or more, as "2.37 kg"')
    base = "1/um" if per_load else "N/um"
    text = f"{value!r} {base}" if is_stress(unit) else stiffness.value  # nothing below this knows of stresses
    return Apparatus(value, per_load, text, base, unit, kilograms * 1e-6 if kilograms else None)


def _columns(node: Node) -> dict[str, ColumnSpec]:
    node.keys(ROLES)
    specs = {}
    for role in node.value:
        entry = node.child(role)
        if isinstance(entry.value, str):
            specs[role] = ColumnSpec(entry.text(), node=entry)
            continue
        entry.table(f'{role} = {{ name = "...", unit = "{ROLES[role]}" }}.').keys(_COLUMN)
        name = entry.require("name", "Give the column's heading in the data file.").text()
        unit, scale, offset, integrate = (entry.get(key) for key in _COLUMN[1:])
        if unit:
            check_unit(unit.text(), role, unit)
        if scale and scale.number() == 0:
            scale.expected("a number other than 0")
        if integrate and role != "time":
            integrate.fail("only the time may be integrated, from sample intervals", "Take `integrate` away.")
        specs[role] = ColumnSpec(
            name,
            unit.text() if unit else None,
            scale.number() if scale else 1.0,
            offset.number() if offset else 0.0,
            integrate.boolean() if integrate else False,
            entry,
        )
    return specs


def check_unit(unit: str, role: str, node: Node | None = None, where: str = "") -> float:
    """Return the factor from `unit` to um, s, N for a column's role; raises SrfError at `node` or `where`."""
    base = {"um/s": "um/s", "MPa": "N"}.get(ROLES[role], ROLES[role])
    try:
        return unit_factor(unit, base)
    except SrfError as error:
        message = f"{error.message}; {role} is in {ROLES[role]} or a unit of that dimension"
        if node is not None:
            node.fail(message, error.hint)
        raise SrfError(f"{where}: {message}", error.hint) from None


def _runs(node: Node) -> tuple[RunDescription, ...]:
    runs: list[RunDescription] = []
    for entry in node.tables(_RUNS):
        run = _run(entry)
        for other in runs:
            if other.name == run.name:
                entry.child("name").fail(
                    f"'{run.name}' is the name of another run, {other.node.where}", "Give each run its own name."
                )
        runs.append(run)
    return tuple(runs)


def _run(node: Node) -> RunDescription:
    node.keys(_RUN)
    name = node.require("name", 'Write name = "steps".')
    if not name.text().strip():
        name.expected("a name")
    file = node.require("file", 'Write file = "steps.csv", relative to the experiment\'s folder.')
    if not file.text().strip() or "\0" in file.text():
        file.expected("the name of a data file")
    holdout, format, start, initial = (node.get(key) for key in ("holdout", "format", "start", "initial"))
    drive, load, window = node.get("drive"), node.get("load"), node.get("window")
    if initial and initial.text() not in ("steady", "free"):
        initial.expected('"steady" or "free"', did_you_mean(initial.text(), ("steady", "free")))
    weight = load.quantity("N") if load else None
    if load and weight is not None and not weight > 0:
        load.expected('a load above 0, as "5 N"')
    modulation = node.get("modulation")
    return RunDescription(
        name=name.text(),
        file=node.file.parent / file.text(),
        format=format.text() if format else None,
        holdout=holdout.boolean() if holdout else False,
        window=_window(window) if window else None,
        drive=_drive(drive) if drive else None,
        start=start.quantity("um") if start else 0.0,
        load=weight,
        modulation=_modulation(modulation) if modulation else None,
        initial=initial.text() if initial else "steady",
        node=node,
    )


def _window(node: Node) -> tuple[float, float]:
    if not isinstance(node.value, list) or len(node.value) != 2:
        node.expected("[from, to], in seconds of the file's own clock", "Write window = [0.0, 4.5].")
    begin, end = (node.child(i).quantity("s") for i in range(2))
    if not begin < end:
        node.fail(f"the window [{begin:g}, {end:g}] s is empty", "Give the earlier time first.")
    return begin, end


def _drive(node: Node) -> tuple[tuple[float, float], ...]:
    example = "drive = [{ duration = 2.0, velocity = 5.0 }, ...], in s and um/s."
    steps = []
    for step in node.tables(example):
        step.keys(("duration", "velocity"))
        duration = step.require("duration", "Every step of a drive has a duration in s.")
        velocity = step.require("velocity", "Every step of a drive has a velocity in um/s.").quantity("um/s")
        if not duration.quantity("s") > 0:
            duration.expected("a duration above 0")
        steps.append((duration.quantity("s"), velocity))
    return tuple(steps)


def _modulation(node: Node) -> tuple[float, float, float]:
    node.table("modulation = { frequency = 120.0, amplitude = 0.09, onset = 2.0 }.")
    node.keys(("frequency", "amplitude", "onset"))
    frequency = node.require("frequency", "Give it in Hz: frequency = 120.0.")
    amplitude = node.require("amplitude", "Give it relative to the mean load: amplitude = 0.09.")
    onset = node.get("onset")
    if not frequency.quantity("Hz") > 0:
        frequency.expected("a frequency above 0")
    if not 0 <= amplitude.quantity("1") < 1:
        amplitude.expected("a relative amplitude from 0 to below 1", "At 1 the slider lifts off.")
    return frequency.quantity("Hz"), amplitude.quantity("1"), onset.quantity("s") if onset else 0.0
