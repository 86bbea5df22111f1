"""`experiment.toml` in the format `srf-experiment/1`, read and validated without opening a data file.

What breaks the format is answered with file, line and key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from srfcli.core.errors import CHECK_PATH, SrfError, did_you_mean
from srfcli.core.files import check_plain, parse_toml, read_text, recover
from srfcli.core.toml import Node
from srfcli.core.units import (
    GEOMETRY_UNITS,
    NO_GEOMETRY,
    Geometry,
    find_unit,
    is_stress,
    same_dimension,
    split_quantity,
    unit_factor,
)
from srfcli.data.values import OBSERVABLES, OTHER_OBSERVABLES, Declared
from srfcli.motion.imposed import RISE

EXPERIMENT_FORMAT = "srf-experiment/1"
DESCRIPTION = "experiment.toml"
ROLES = {  # what a column may be, and the unit of a number in it where neither heading nor [columns] say
    "time": "s",
    "load_point_velocity": "um/s",
    "load_point_displacement": "um",
    "normal_load": "N",
    "normal_stress": "MPa",
    **OBSERVABLES,
    "shear_stress": "MPa",
    **OTHER_OBSERVABLES,
}
READABLE = (*OBSERVABLES, "shear_stress", *OTHER_OBSERVABLES)  # what `observables` may list
MOST_OBSERVABLES = 3  # of a run
LARGEST_DESCRIPTION = 16 * 2**20  # bytes
TOML_FORM = 'Text goes in quotes, law = "srf-vsat", a truth value is true or false, and each run begins with [[runs]].'
CORRECTIONS = ("reset", "small-reset", "spike")  # of a run: what is proposed, and made only where it is asked for
GEOMETRY = {"radius": "25 mm", "thickness": "4 mm", "area": "25 cm^2"}  # keys of [apparatus], with an example each
_RUN = (
    "name", "file", "format", "holdout", "window", "drive", "start", "load", "modulation", "initial", "direction",
    "corrections", "observables", "segments",
)  # fmt: skip
_RUNS = '[[runs]] with name = "..." and file = "....csv" for each recording.'


@dataclass(frozen=True)
class Apparatus:
    """The loading stage: `stiffness` in N/um, or in 1/um where `per_load` (friction per micron), and the mass or None.

    `text` states it in N/um or 1/um, `stated` is the unit that the description has.
    """

    stiffness: float
    per_load: bool
    text: str
    stated: str
    mass: float | None
    geometry: Geometry = NO_GEOMETRY

    @property
    def unit(self) -> str:
        """Return the unit of `stiffness`."""
        return "1/um" if self.per_load else "N/um"


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
    """What the description says of one run; `drive` holds (duration, velocity) pairs, None where columns say it.

    `observables` are the columns that are compared with the model together; where none is listed, `read_columns` chooses one.
    """

    name: str
    file: Path
    format: str | None
    holdout: bool
    window: tuple[float, float] | None
    drive: tuple[tuple[float, float], ...] | None
    start: float
    load: float | None
    modulation: Declared | None
    initial: str
    node: Node = field(repr=False, compare=False)
    backward: bool = False
    corrections: frozenset[str] = frozenset()
    observables: tuple[str, ...] = ()
    segments: tuple[float, ...] = ()


@dataclass(frozen=True)
class ThresholdsDescription:
    """What the description says of one table of critical loads; `frequency` (Hz) of their modulation, None if left out."""

    name: str
    file: Path
    holdout: bool
    frequency: float | None
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
    thresholds: tuple[ThresholdsDescription, ...] = ()


def read_description(path: Path) -> Description:
    """Return what the experiment folder or TOML file at `path` says; raises SrfError with file and line for a breach."""
    file = find_file(path)
    root = open_node(file)
    declared = root.get("format")
    start = f'Start the file with format = "{EXPERIMENT_FORMAT}".'
    if declared is None:
        raise SrfError(f"{file}: format: missing, expected {EXPERIMENT_FORMAT!r}", start)
    if declared.value != EXPERIMENT_FORMAT:
        declared.expected(f'"{EXPERIMENT_FORMAT}"', start)
    root.keys(("format", "title", "apparatus", "model", "parameters", "columns", "runs", "thresholds"))
    apparatus = root.require("apparatus", '[apparatus] with stiffness = "0.21 N/um".').table("[apparatus].")
    machine = _apparatus(apparatus)
    if root.get("thresholds") is None:
        root.require("runs", _RUNS)
    runs = root.read("runs", lambda node: _runs(node, machine.geometry), ())
    return Description(
        path=file,
        title=root.read("title", Node.text, ""),
        apparatus=machine,
        model=root.require("model", '[model] with law = "srf-vsat" and ageing = "dieterich".').table("[model]."),
        parameters=root.read("parameters", lambda node: node.table("[parameters]."), None),
        columns=root.read("columns", lambda node: _columns(node.table("[columns]."), machine.geometry), {}),
        runs=runs,
        thresholds=root.read("thresholds", lambda node: _thresholds(node, machine, runs), ()),
    )


def open_node(path: Path) -> Node:
    """Return the table of a description; raises SrfError where it is none."""
    try:
        text = read_text(path, limit=LARGEST_DESCRIPTION).replace("\r\n", "\n")
    except OSError as error:
        raise SrfError(f"{path}: cannot be read: {error.strerror}", CHECK_PATH, exit_code=1) from None
    try:
        table = parse_toml(text, path)
    except SrfError as error:
        if path.suffix.lower() != ".toml":
            raise SrfError(
                f"{path}: a data file, not the description of an experiment",
                f"For a recording, `srf new {path}` writes an experiment.toml. A table of critical loads goes under "
                f"[[thresholds]] in an experiment.toml, or to `srf fit {path}`.",
            ) from None
        raise SrfError(error.message, error.hint or TOML_FORM) from None
    return Node(path, table, (), text)


def find_file(path: Path) -> Path:
    """Return the TOML file that `path`, an experiment's folder or file, means."""
    if not path.exists():
        recover(path)  # a process that replaced it may have been killed
    if not path.exists():
        raise SrfError(f"no experiment {path}", f"Give a folder with an {DESCRIPTION}, or the TOML file.")
    if path.is_dir():
        file = path / DESCRIPTION
        if not file.is_file():
            others = sorted(p.name for p in path.glob("*.toml"))
            hint = f"Name the file: {path / others[0]}" if others else "srf new DATA.csv writes one for recorded data."
            raise SrfError(f"{path}: holds no {DESCRIPTION}", hint)
        return file
    if not path.is_file():
        check_plain(path)  # says what it is instead
    return path


def _apparatus(node: Node) -> Apparatus:
    node.keys(("stiffness", "mass", *GEOMETRY))
    geometry = _geometry(node)
    hint = 'Write stiffness = "0.21 N/um", "1.5 MPa/mm", or "1.0e-3 1/um" for friction per micron.'
    stiffness = node.require("stiffness", hint)
    if not isinstance(stiffness.value, str):
        stiffness.expected("text with a number and its unit", hint)
    try:
        number, unit = split_quantity(stiffness.value, name="stiffness", example="0.21 N/um")
        per_load = bool(unit) and same_dimension(unit, "1/um")
        base = "1/um" if per_load else "N/um"
        value = number * unit_factor(unit, base, geometry) if unit else 0.0
    except SrfError as error:
        stiffness.fail(error.message, error.hint if error.kind == "unit" else hint)
    if not unit:
        stiffness.fail(f"'{stiffness.value}' has no unit, and two are possible", hint)
    if not value > 0:
        stiffness.expected("a positive stiffness")
    mass = node.get("mass")
    kilograms = mass.quantity("kg") if mass else 0.0
    if mass and kilograms < 0:
        mass.expected('a mass of 0 or more, as "2.37 kg"')
    if mass and kilograms and geometry.area:
        mass.fail("a mass beside an area, with which forces count as stresses", "Leave one of the two out.")
    plain = not is_stress(unit) and (per_load or find_unit(unit).powers == (-1, 0, 1, 0)) and not geometry.area
    text = stiffness.value if plain else f"{value!r} {base}"  # nothing below this knows of stresses and of geometry
    by_strain = is_stress(unit) and same_dimension(unit, "MPa")
    stated = "MPa/um" if by_strain or (geometry.area and not per_load) else unit if plain or is_stress(unit) else base
    return Apparatus(value, per_load, text, stated, kilograms * 1e-6 if kilograms else None, geometry)


def _geometry(node: Node) -> Geometry:
    """Return what turns torques, angles, strains and forces into what is compared."""
    found: dict[str, float] = {}
    for key, unit in GEOMETRY_UNITS.items():
        entry = node.get(key)
        if entry is None:
            continue
        if not isinstance(entry.value, str):
            entry.expected("text with a number and its unit", f'Write {key} = "{GEOMETRY[key]}".')
        found[key] = entry.positive(unit, f"{'an' if key == 'area' else 'a'} {key} above 0")
    return Geometry(**found)


def _columns(node: Node, geometry: Geometry) -> dict[str, ColumnSpec]:
    node.keys(ROLES)
    specs = {}
    for role in node.value:
        entry = node.child(role)
        if isinstance(entry.value, str):
            specs[role] = ColumnSpec(entry.text(), node=entry)
            continue
        entry.table(f'{role} = {{ name = "...", unit = "{ROLES[role]}" }}.')
        entry.keys(("name", "unit", "scale", "offset", "integrate"))
        name = entry.require("name", "Give the column's heading in the data file.").text()
        if (unit := entry.read("unit", Node.text, None)) is not None:
            check_unit(unit, role, entry.child("unit"), geometry=geometry)
        if not (scale := entry.read("scale", Node.number, 1.0)):
            entry.child("scale").expected("a number other than 0")
        if (integrate := entry.get("integrate")) and role != "time":
            integrate.fail("only the time may be integrated, from sample intervals", "Take `integrate` away.")
        offset = entry.read("offset", Node.number, 0.0)
        specs[role] = ColumnSpec(name, unit, scale, offset, integrate is not None and integrate.boolean(), entry)
    return specs


def check_unit(unit: str, role: str, node: Node | None = None, where: str = "", geometry: Geometry = NO_GEOMETRY) -> float:
    """Return the factor from `unit` to um, s, N for a column's role; raises SrfError at `node` or `where`."""
    base = {"um/s": "um/s", "MPa": "N"}.get(ROLES[role], ROLES[role])
    try:
        return unit_factor(unit, base, geometry)
    except SrfError as error:
        message = f"{error.message}; {role} is in {ROLES[role]} or a unit of that dimension"
        if node is not None:
            node.fail(message, error.hint)
        raise SrfError(f"{where}: {message}", error.hint) from None


def _runs(node: Node, geometry: Geometry) -> tuple[RunDescription, ...]:
    runs: list[RunDescription] = []
    for entry in node.tables(_RUNS):
        run = _run(entry, geometry)
        for other in runs:
            if other.name == run.name:
                entry.child("name").fail(
                    f"'{run.name}' is the name of another run, {other.node.where}", "Give each run its own name."
                )
        runs.append(run)
    return tuple(runs)


def _run(node: Node, geometry: Geometry) -> RunDescription:
    node.keys(_RUN)
    name = node.require("name", 'Write name = "steps".')
    if not name.text().strip():
        name.expected("a name")
    file = node.require("file", 'Write file = "steps.csv", relative to the experiment\'s folder.')
    return RunDescription(
        name=name.text(),
        file=file.beside("the name of a data file"),
        format=node.read("format", Node.text, None),
        holdout=node.read("holdout", Node.boolean, False),
        window=node.read("window", _window, None),
        drive=node.read("drive", _drive, None),
        start=node.read("start", lambda start: start.quantity("um"), 0.0),
        load=node.read("load", lambda load: load.positive("N", 'a load above 0, as "5 N"', geometry), None),
        modulation=node.read("modulation", _modulation, None),
        initial=node.read("initial", lambda initial: initial.choice(("steady", "free")), "steady"),
        node=node,
        backward=node.read("direction", lambda way: way.choice(("forward", "backward")), "forward") == "backward",
        corrections=node.read("corrections", _corrections, frozenset()),
        observables=node.read("observables", _observables, ()),
        segments=node.read("segments", _segments, ()),
    )


def _segments(node: Node) -> tuple[float, ...]:
    """Return the times at which a run may be cut, rising."""
    listed = node.items("times in s of the file's own clock", "Write segments = [120.0, 240.0].")
    times = [entry.quantity("s") for entry in listed]
    if any(b <= a for a, b in pairwise(times)):
        node.fail("the times do not rise", "Give the earlier time first.")
    return tuple(times)


def _thresholds(node: Node, machine: Apparatus, runs: tuple[RunDescription, ...]) -> tuple[ThresholdsDescription, ...]:
    entries = list(node.tables('[[thresholds]] with file = "....csv" for each table of critical loads.'))
    stress = "counts stresses" if machine.geometry.area or is_stress(machine.stated) else ""
    if machine.per_load or stress:
        which = stress or "has a stiffness in friction per micron, which leaves no load to be critical"
        entries[0].fail(f"critical loads are in N, and [apparatus] {which}", 'Write stiffness = "0.21 N/um" and no area.')
    found: list[ThresholdsDescription] = []
    for entry in entries:
        entry.keys(("name", "file", "holdout", "frequency"))
        file = entry.require("file", 'Write file = "critical-loads.csv", relative to the experiment\'s folder.')
        place, name = file.beside("the name of a table of critical loads"), entry.get("name")
        if name and not name.text().strip():
            name.expected("a name")
        frequency = entry.read("frequency", lambda node: node.positive("Hz", "a frequency above 0"), None)
        called = name.text() if name else Path(file.text()).stem
        if called in {*(run.name for run in runs), *(other.name for other in found)}:
            (name or file).fail(f"'{called}' is the name of another run or table", 'Give it one of its own: name = "...".')
        holdout = entry.read("holdout", Node.boolean, False)
        found.append(ThresholdsDescription(called, place, holdout, frequency, entry))
    return tuple(found)


def _corrections(node: Node) -> frozenset[str]:
    """Return which of the corrections that `srf check` proposes are made."""
    for entry in node.items("corrections", f"Write corrections = {list(CORRECTIONS)}, or one of them."):
        if entry.text() not in CORRECTIONS:
            entry.fail(f"unknown correction '{entry.text()}'", did_you_mean(entry.text(), CORRECTIONS))
    return frozenset(node.value)


def _observables(node: Node) -> tuple[str, ...]:
    """Return which columns of a run are compared with the model together."""
    listed = node.items("observables", 'Write observables = ["elongation", "slip"].', fewest=1)
    names = [entry.text() for entry in listed]
    for index, (entry, name) in enumerate(zip(listed, names, strict=True)):
        if name not in READABLE:
            entry.fail(f"unknown observable '{name}'", did_you_mean(name, READABLE))
        if name in names[:index] or ({"force", "shear_stress"} <= set(names)):
            entry.fail(f"'{name}' is the same observable as another one", "Name each once.")
    if len(names) > MOST_OBSERVABLES:
        node.fail(f"{len(names)} observables", f"A run has {MOST_OBSERVABLES} at most.")
    if not set(names) - OTHER_OBSERVABLES.keys():
        node.fail(f"{' and '.join(names)} without a force", "One of elongation, force, shear_stress, friction is needed besides.")
    return tuple(names)


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
        steps.append((duration.positive("s", "a duration above 0"), velocity))
    return tuple(steps)


MODULATION = ("frequency", "amplitude", "onset", "phase", "rise")  # the keys, in the order of a run's values


def _modulation(node: Node) -> Declared:
    """Return frequency (Hz), amplitude, onset (s), and, where one of them is given, phase (deg) and rise (s)."""
    node.table("modulation = { frequency = 120.0, amplitude = 0.09, onset = 2.0 }.")
    node.keys(MODULATION)
    frequency = node.require("frequency", "Give it in Hz: frequency = 120.0.")
    amplitude = node.require("amplitude", "Give it relative to the mean load: amplitude = 0.09.")
    f = frequency.positive("Hz", "a frequency above 0")
    if not 0 <= amplitude.quantity("1") < 1:
        amplitude.expected("a relative amplitude from 0 to below 1", "At 1 the slider lifts off.")
    usual = f, amplitude.quantity("1"), node.read("onset", lambda onset: onset.quantity("s"), 0.0)
    phase = node.read("phase", lambda phase: phase.quantity("deg"), None)
    rise = node.read("rise", lambda rise: rise.positive("s", "a rise above 0"), None)
    return usual if phase is None and rise is None else (*usual, phase or 0.0, rise or RISE / f)
