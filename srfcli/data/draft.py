"""A first `experiment.toml` from data files: which column plays which role, what was imposed, start values, and why."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from srfcli.core.errors import NoContact, SrfError, did_you_mean
from srfcli.core.files import toml_value, unused_name
from srfcli.core.settings import Parameter
from srfcli.core.units import (
    GEOMETRY_UNITS,
    NO_GEOMETRY,
    Geometry,
    find_unit,
    parse_quantity,
    split_heading,
    split_quantity,
    unit_factor,
)
from srfcli.data.columns import DRIVES, Columns, goes_backward, open_source, read_columns
from srfcli.data.description import EXPERIMENT_FORMAT, GEOMETRY, ROLES, check_unit, read_description
from srfcli.data.experiment import read_choice, read_experiment, read_parameters
from srfcli.data.groups import levels
from srfcli.data.imposed import LOADS, StartsAtRest, Stroke, find_modulation, strokes
from srfcli.data.scales import scales_of
from srfcli.data.values import BOUND_FACTOR, Experiment, Run, told_of_runs
from srfcli.laws.registry import Registry

NAMED = {  # role -> what headings call it, in small letters without their unit; the first that a file has is taken
    "time": ("time", "t", "x_value", "elapsed_time", "elapsed", "test_time", "run_time"),
    "load_point_velocity": (
        "load_point_velocity", "lp_velocity", "lp_vel", "v_lp", "loading_velocity", "drive_velocity", "velocity", "vel", "v",
        "loading_rate", "slip_rate",
    ),
    "load_point_displacement": (
        "load_point_displacement", "lp_displacement", "lp_disp", "lpdisp", "load_point", "ram_displacement", "disp", "displ",
        "displacement", "shear_displacement", "x_lp", "slip", "stage", "stage_position",
    ),
    "normal_stress": (
        "normal_stress", "effective_normal_stress", "eff_normal_stress", "norm_stress", "sigma_n", "sigman", "sig_n", "sign",
        "sigma", "sn", "ns", "nor_stress", "nor_str",
    ),
    "normal_load": ("normal_load", "normal_force", "fn", "f_n", "norm_force", "load", "n", "w"),
    "elongation": ("elongation", "spring_elongation", "deflection", "spring_deflection", "u"),
    "force": ("force", "shear_force", "friction_force", "tangential_force", "shear_load", "spring_force", "fs", "ft", "f"),
    "shear_stress": ("shear_stress", "shear", "tau", "ss", "shr_stress", "shr_str"),
    "friction": (
        "friction", "friction_coefficient", "coefficient_of_friction", "friction_coeff", "apparent_friction", "mu", "cof",
        "fnorm",
    ),
}  # fmt: skip
HEADING_WORDS = {  # role -> words of a heading that mean it, where no heading is one of NAMED
    "time": {"time", "elapsed", "clock", "timestamp"},
    "load_point_velocity": {"velocity", "vel", "speed", "rate", "rpm", "sliding", "v", "vs", "rotation", "angular"},
    "load_point_displacement": {
        "displacement", "disp", "displ", "position", "pos", "stroke", "slip", "distance", "travel", "angle", "rotation", "theta",
        "strain", "lp", "lpd", "ram", "stage", "sliding", "x", "gamma",
    },
    "normal_stress": {
        "normal", "norm", "effective", "sn", "seff", "sigman", "sigma", "fn", "fz", "load", "axial", "weight",
    },
    "shear_stress": {
        "shear", "friction", "frictional", "tangential", "traction", "lateral", "tau", "drag", "ft", "fx", "ff", "fs", "torque",
        "moment",
    },
    "friction": {"friction", "mu", "cof", "coefficient", "coeff"},
}  # fmt: skip
UNIT_KINDS = {  # role -> kinds of units that a column called so has
    "time": {"s"}, "load_point_velocity": {"um/s", "rad/s", "1/s"}, "load_point_displacement": {"um", "rad", "1"},
    "normal_load": {"N"}, "normal_stress": {"MPa", "N"}, "force": {"N", "N*um"}, "shear_stress": {"MPa", "N", "N*um"},
    "friction": {"1"}, "elongation": {"um"},
}  # fmt: skip
NOT_EACH = {"max", "maximum", "peak", "nominal", "set"}  # of a velocity that is not that of each sample
ROLE_UNITS = {"time": {"s"}, "load_point_velocity": {"um/s", "rad/s"}, "shear_stress": {"N*um"}}  # units that tell a role alone
ASIDE = {"thickness", "gap", "height", "dilation", "dilatancy", "compaction", "depth", "pore", "confining", "temperature", "temp",
         "humidity", "std", "error", "setpoint", "target", "command", "raw", "pz", "zpos"}  # fmt: skip
UNIT_SUFFIXES = {  # units that a heading ends with: time_s, shear_stress_MPa
    "s": "s", "sec": "s", "ms": "ms", "min": "min", "um": "um", "microns": "um", "micron": "um", "mm": "mm", "m": "m",
    "um_s": "um/s", "mm_s": "mm/s", "um/s": "um/s", "mm/s": "mm/s", "mpa": "MPa", "kpa": "kPa", "gpa": "GPa", "pa": "Pa",
    "n": "N", "kn": "kN", "un": "uN", "mn": "mN", "deg": "deg", "rad": "rad", "rpm": "rpm",
}  # fmt: skip
STRESS_OF = {"normal_load": "normal_stress", "force": "shear_stress", "friction": "shear_stress"}
FORCE_OF = {"normal_stress": "normal_load", "shear_stress": "force", "friction": "force"}
OBSERVED_ROLES = ("elongation", "force", "shear_stress", "friction")
MISREAD = ("friction", "drive-smoothed")  # kinds of notices that mean that the file was misread, or is not what it seems
NO_SLIDING = 1e-3  # of the fastest velocity, below which nothing slides
HOLD_SPEED = 0.05  # of the slowest sliding, below which is a hold
UNLIKE_START = 0.02  # of the friction before the first step: first readings that are farther from it are not of steady sliding
SEVERAL = 3  # velocities of sliding from which a run with holds is one of steps; with as many steps it has many
STEP_BY_STEP = (  # what a run with many steps may need
    '# vary = ["mu0"]   # take the # away for a friction level of each step\'s own; "noise": a gauge noise of its own, too',
    '# by = "segment"   # with it: the run is cut halfway between its steps',
    '# trend = "slip"   # friction drifts slowly',
)
STROKES = 40  # of a file that are written
LETTERS = "A is a, B is b, D0 is Dc (or L), mu is tau/sigma, W is sigma, K is k; a stress in MPa counts as the force on 1 mm^2"
FRICTION_START = {"A": (0.01, 0.0005, 0.05), "B": (0.01, 0.0002, 0.05)}  # start value and bounds: rock, gouge, polymers, paper
SLIP_LENGTH = (10.0, 0.5, 500.0)  # um, of D0: rock and gouge
LENGTHS_IN_SEGMENT = 50.0  # of slip at one velocity: a slip length from there where it is ten times off that of rock
RIG = {
    "radius": "of the sliding circle: torque over it is the force, angle times it the displacement",
    "thickness": "of the sheared layer: strain times it is the displacement",
    "area": "of the sheared contact: force over it is the stress",
}
ARGUMENTS = ("stiffness", "mass", "load", "window", "drive", *RIG)  # of `new_experiment` that an experiment has under their names
NO_MASS = '# mass = "2.37 kg"   # of the slider; without it the slider is quasi-static'


@dataclass(frozen=True)
class Wish:
    """What the user says of data files: texts as experiment.toml has them, None or empty where nothing is said.

    `stiffness` has a unit. `columns` maps a role to a heading, or to `heading [unit]`; `drive` holds (duration, velocity) pairs
    or one velocity in um/s.
    """

    stiffness: str
    kind: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    drive: Sequence[tuple[float, float]] | float | None = None
    load: str | None = None
    mass: str | None = None
    window: tuple[float, float] | None = None
    law: str = "dieterich-ruina"
    ageing: str | None = None
    interface: str = "rigid"
    title: str = ""
    reader: str | None = None
    holdout: Sequence[str] = ()
    rig: Mapping[str, str] = field(default_factory=dict)  # radius, thickness and area, as [apparatus] has them

    def geometry(self) -> Geometry:
        """Return what the rig says, in um and mm^2; raises SrfError for a number without a unit."""
        for key, text in self.rig.items():
            if not split_quantity(text, name=f"`{key}`")[1]:
                unit = "cm^2" if key == "area" else "mm"
                raise SrfError(f"`{key}` '{text}' has no unit", f"Write it with one, as '25 {unit}'.")
        return Geometry(**{k: parse_quantity(v, GEOMETRY_UNITS[k], name=f"`{k}`") for k, v in self.rig.items()})


@dataclass(frozen=True)
class Named:
    """A column of a file that was taken for a role: its heading, its unit, and whether experiment.toml has to say so.

    A unit is `assumed` where nobody told it.
    """

    role: str
    heading: str
    unit: str
    said: bool
    assumed: bool


@dataclass(frozen=True)
class Draft:
    """The text of an experiment.toml, the roles of the columns, and sentences on what was decided and why."""

    text: str
    columns: tuple[Named, ...]
    remarks: tuple[str, ...]


def name_columns(
    headings: Sequence[str], wish: Mapping[str, str], *, path: Path, per_load: bool, geometry: Geometry = NO_GEOMETRY
) -> tuple[Named, ...]:
    """Return the columns of a file that play a role; `wish` names some of them, `per_load` prefers friction to a force.

    Raises SrfError for a column that the file has not, or a unit of the wrong dimension.
    """
    found: dict[str, Named] = {}
    for role, text in wish.items():
        if role not in ROLES:
            raise SrfError(f"`columns` {role}: no such role", did_you_mean(role, ROLES))
        named = _wished(role, text, headings, path, geometry)
        found[named.role] = named
    taken = {named.heading for named in found.values()}
    for role, names in NAMED.items():
        if role in found:
            continue
        known = {_spelled(h)[0]: h for h in reversed(headings) if h not in taken}
        heading = next((known[name] for name in names if name in known), None)
        if heading is None:
            continue
        name, unit = _spelled(heading)
        actual = _by_unit(role, unit)
        if actual is None or actual in found:
            continue
        said = name != actual or split_heading(heading)[1] is None
        found[actual] = Named(actual, heading, unit or ROLES[actual], said, unit is None)
        taken.add(heading)
    _by_words(headings, found)
    seen = [role for role in (OBSERVED_ROLES if not per_load else OBSERVED_ROLES[::-1]) if role in found]
    asked = [role for role in seen if role in wish]
    left = set(seen) - set((asked or seen)[:1])
    left |= {"load_point_displacement"} if "load_point_velocity" in found else set()
    left |= {"normal_stress"} if {"normal_stress", "normal_load"} <= set(found) else set()
    return tuple(replace(n, said=n.said or len(seen) > 1) for role, n in found.items() if role not in left)


def _by_words(headings: Sequence[str], found: dict[str, Named]) -> None:
    """Add to `found` what the words and the unit of a heading tell together, or a unit alone that no other column has.

    A role that two columns could play as well is left open.
    """
    taken = {named.heading for named in found.values()}
    units_of = {h: _spelled(h)[1] for h in headings if h not in taken}
    apart = {h: re.sub(r"(?<=[a-z])(?=[A-Z][a-z])", " ", h) for h in units_of}  # NormalStress
    words = {h: set(re.findall(r"[a-z]+", _spelled(text)[0])) for h, text in apart.items()}
    units_of = {h: "1" if unit is None and "strain" in words[h] else unit for h, unit in units_of.items()}
    kinds = {h: _kind_of_unit(unit) for h, unit in units_of.items()}
    free = [h for h in kinds if not words[h] & ASIDE]
    for role, known in HEADING_WORDS.items():
        if role in found or any(role in same and {*same} & found.keys() for same in (DRIVES, LOADS, OBSERVED_ROLES)):
            continue  # it, or another that makes it needless, is found already
        # a unit that is not told will do for a role that is told by a number without one
        fit = [h for h in free if kinds[h] in UNIT_KINDS[role] or (kinds[h] == "" and role == "time")]
        score = {h: len(words[h] & known) for h in fit}
        if role == "normal_stress":  # a normal displacement is told by its unit, a shear stress by its word
            score = {h: 0 if words[h] & HEADING_WORDS["shear_stress"] else n for h, n in score.items()}
        best = max(score.values(), default=0)
        named = [h for h in fit if score[h] == best > 0]
        if not best and role in ROLE_UNITS:
            named = [h for h in fit if kinds[h] in ROLE_UNITS[role]]
        if len(named) == 1:
            heading = named[0]
            actual = _as_force(role, kinds[heading])
            found[actual] = Named(actual, heading, units_of[heading] or ROLES[actual], True, units_of[heading] is None)
            free.remove(heading)


def _kind_of_unit(unit: str | None) -> str:
    """Return what a unit measures, as one unit of that kind; "" for none at all, "?" for anything else."""
    if unit is None:
        return ""
    try:
        powers = find_unit(unit).powers
    except SrfError:
        return "?"
    kinds = ("s", "um/s", "rad/s", "1/s", "um", "rad", "1", "MPa", "N", "N*um")
    return next((kind for kind in kinds if find_unit(kind).powers == powers), "?")


def _wished(role: str, text: str, headings: Sequence[str], path: Path, geometry: Geometry) -> Named:
    name, unit = (text, None) if text in headings else split_heading(text)
    heading = next((h for h in headings if name in (h, split_heading(h)[0])), None)
    if heading is None:
        raise SrfError(f"{path} has no column '{name}'", did_you_mean(name, headings))
    told = unit or _spelled(heading)[1]
    found = told or ROLES[role]
    role = _as_force(role, _kind_of_unit(found)) if role == "friction" else role
    check_unit(found, role, where=f"`columns` {role}", geometry=geometry)
    return Named(role, heading, found, True, told is None)


def _spelled(heading: str) -> tuple[str, str | None]:
    """Return a heading's name in small letters and its unit, from brackets or a suffix; None where it has none."""
    name, unit = split_heading(heading)
    latin = re.sub("[\u00b5\u03bc]", "mu", re.sub("[\u00b5\u03bc](?=[a-z])", "u", name.strip().lower()))  # um, and mu alone
    latin = latin.replace("\u03c4", "tau").replace("\u03c3", "sigma")
    plain = re.sub(r"[^a-z0-9/]+", "_", latin).strip("_")
    if unit is not None or any(plain in names for names in NAMED.values()):  # the n of sigma_n is no newton
        return plain.replace("/", "_"), unit
    for suffix in sorted(UNIT_SUFFIXES, key=len, reverse=True):
        if plain.endswith("_" + suffix):
            rest, factor = plain.removesuffix("_" + suffix), re.search(r"10\^\S+(?= )", latin)
            return rest, f"{factor[0]} {suffix}" if factor else UNIT_SUFFIXES[suffix]  # which is refused: no unit has a factor
    return plain.replace("/", "_"), None


def _by_unit(role: str, unit: str | None) -> str | None:
    """Return the role that a column with this unit plays, None where the unit fits no such role."""
    if unit is None:
        return role
    kind = _kind_of_unit(unit)
    actual = _as_force(role, kind)
    return actual if kind in UNIT_KINDS[actual] else None


def _as_force(role: str, kind: str) -> str:
    """Return the role of a column whose unit is of this kind: a stress may be called a force or friction, a force a stress."""
    return STRESS_OF.get(role, role) if kind == "MPa" else FORCE_OF.get(role, role) if kind in ("N", "N*um") else role


def missing(
    columns: Sequence[Named], path: Path, headings: Sequence[str], *, driven: bool, loaded: bool
) -> list[tuple[str, str]]:
    """Return what a recording needs and is neither in the file nor said: the argument that says it, and a sentence.

    A drive is stated where it is `driven`, a load where it is `loaded`.
    """
    roles = {named.role for named in columns}
    listed = ", ".join(f"'{h}'" for h in headings)
    kinds, lacks = {_kind_of_unit(_spelled(h)[1]) for h in headings}, []
    if "time" not in roles:
        lacks.append(("`columns` time=HEADING", f"{path}: which column is the time? It has {listed}"))
    if not roles & set(OBSERVED_ROLES):
        what = "friction, shear stress, force or elongation of the spring"
        role = "force" if "N" in kinds and "MPa" not in kinds else "shear_stress"
        lacks.append((f"`columns` {role}=HEADING", f"{path}: which column is {what}? It has {listed}"))
    if not (driven or roles.intersection(DRIVES)):
        pieces = "`drive` '60:3, 60:10' (DURATION:VELOCITY in s and um/s, 0 is a hold)"
        option = f"{pieces}, or `columns` load_point_displacement=HEADING"
        lacks.append((option, f"{path}: which column is the load point's velocity or displacement? It has {listed}"))
    if not (loaded or roles & {"normal_load", "normal_stress", "friction"}):
        in_newton = "force" in roles or ("N" in kinds and "shear_stress" not in roles)
        load, role = ("5 N", "normal_load") if in_newton else ("20 MPa", "normal_stress")
        option = f"`load` '{load}', or `columns` {role}=HEADING"
        lacks.append((option, f"{path}: which column is the normal load or stress? It has {listed}"))
    return lacks


def _another_drive(columns: Sequence[Named], aside: Sequence[str]) -> list[str]:
    """Return what to say of a velocity whose heading names a largest or a set one, where a way was left aside."""
    drive = next((c.heading for c in columns if c.role == "load_point_velocity"), "")
    words = {h: set(re.findall(r"[a-z]+", _spelled(h)[0])) for h in (drive, *aside)}
    ways = [h for h in aside if _kind_of_unit(_spelled(h)[1]) == "um" and words[h] & HEADING_WORDS["load_point_displacement"]]
    if not (ways and words[drive] & NOT_EACH):
        return []
    said = f"the drive is '{drive}', which may not be the velocity at each sample; '{ways[0]}' was left aside"
    return [f'{said}, and [columns] load_point_displacement = {{ name = "{split_heading(ways[0])[0]}" }} takes the drive from it']


def _unknown_units(headings: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield of each heading whose unit is none what is wrong with it, and a hint."""
    for heading in headings:
        try:
            find_unit(_spelled(heading)[1] or "1")
        except SrfError as error:
            yield f"'{heading}': {error.message}", error.hint or ""


def _check_rig(columns: Sequence[Named], wish: Wish, path: Path) -> None:
    """Raise SrfError for angles, torques and strains of a rig whose radius or thickness is not said."""
    needed = {"rad": "radius", "rad/s": "radius", "N*um": "radius"}
    for column in columns:
        kind = _kind_of_unit(column.unit)
        strain = column.role in DRIVES and kind in ("1", "1/s")
        key = "thickness" if strain else needed.get(kind)
        if key is not None and key not in wish.rig:
            what = "strains need the thickness of the layer" if strain else "a rotary rig needs its radius"
            raise SrfError(f"{path}: '{column.heading}' is in {column.unit}: {what}", f"Say it with `{key}` '{GEOMETRY[key]}'.")


def draft(files: Sequence[Path], folder: Path, wish: Wish, *, registry: Registry) -> Draft:
    """Return an experiment.toml for these files, to stand in `folder`; every value in it has been read once.

    Raises SrfError for what the files do not say and `wish` neither, and for all that reading an experiment refuses.
    """
    unit = split_quantity(wish.stiffness, name="`stiffness`")[1]
    per_load = find_unit(unit).powers == (-1, 0, 0, 0)
    geometry = wish.geometry()
    try:
        unit_factor(unit, "1/um" if per_load else "N/um", geometry)
    except SrfError as error:
        hint = error.hint if error.kind == "unit" else "As '0.21 N/um', '1.5 MPa/mm' or '1e-3 1/um'."
        raise SrfError(f"`stiffness` '{wish.stiffness}': {error.message}", hint) from error
    named: tuple[Named, ...] = ()
    names: list[str] = []
    remarks: list[str] = []
    for path in files:
        names.append(unused_name(path.stem, "", names))
        headings = open_source(path, registry=registry, format=wish.reader).headings
        own = name_columns(headings, wish.columns, path=path, per_load=per_load, geometry=geometry)
        lacks = missing(own, path, headings, driven=wish.drive is not None, loaded=wish.load is not None)
        if lacks:
            odd = list(_unknown_units(headings))
            said, hints = [lacks[0][1], *(what for what, _ in odd)], [f"Say it with {option}." for option, _ in lacks]
            raise SrfError("; ".join(said), " ".join([*(hint for _, hint in odd), *hints]))
        _check_rig(own, wish, path)
        if named and [(n.role, n.heading, n.unit) for n in own] != [(n.role, n.heading, n.unit) for n in named]:
            raise SrfError(f"{path}: its columns are not those of {files[0]}", "Files of one experiment have the same headings.")
        named = own
        aside = [h for h in headings if h not in {n.heading for n in own}]
        if aside and path == files[0]:
            remarks.append(f"left aside: {', '.join(aside)}")
            remarks += _another_drive(own, aside)
    sketch, told = _parted(_Sketch(tuple(files), names, folder, wish, named), registry)
    remarks += told
    for name in wish.holdout:
        if name not in sketch.names:
            raise SrfError(f"`holdout` {name}: no such run", did_you_mean(name, sketch.names))
    if set(wish.holdout) >= set(sketch.names):
        raise SrfError("`holdout`: every run is held out", "Leave one to be fitted.")
    sketch, read = _read(sketch, registry)
    runs = list(read.runs)
    remarks += [*told_of_runs(runs, MISREAD), *filter(None, [read.rescaled()])]
    modulations = _modulations(runs)
    if wish.kind == "shs" and all(np.abs(V := run.drive(run.t)).min() > HOLD_SPEED * np.abs(V).max() for run in runs):
        raise SrfError("`kind` shs: no drive stops", "State the holds: `drive` '60:10, 100:0, 60:10', in s and um/s.")
    kind, why = (wish.kind, "as it was said") if wish.kind else _kind(runs, modulations)
    remarks.append(f"kind of experiment: {kind}, {why}")
    if still := [name for name in sketch.free if name not in sketch.strokes]:
        remarks.append(f"the initial state is estimated, as the drive stands still at first in {', '.join(still)}")
    begun = _begun([run for run in runs if run.name not in sketch.strokes], modulations)
    remarks += [f"the initial state of {name} is estimated, as {reason}" for name, reason in begun.items()]
    sketch = replace(
        sketch, kind=kind, why=why, free=(*sketch.free, *begun),
        several=kind == "steps" and any(len(_slid(run)) > SEVERAL for run in runs),
        modulations=modulations if kind == "oscillation" else {},
        durations={run.name: float(math.ceil(run.t[-1] - min(run.t[0], 0.0))) for run in runs},
    )  # fmt: skip
    text = sketch.text(_parameters(sketch, runs, registry))
    with _as_file(text) as file:  # raises SrfError where the model or its parameters are none
        described = read_description(file)
        choice, known = read_choice(described.model, described.apparatus, registry)
        read_parameters(described.parameters, known, choice)
    return Draft(text, named, tuple(remarks))


def _parted(sketch: _Sketch, registry: Registry) -> tuple[_Sketch, list[str]]:
    """Return the sketch with a run for each stroke of the files whose drive turns back, and what counts with the other sign.

    And what to say of these.
    """
    with _as_file(sketch.text((), absolute=True)) as file:
        described = read_description(file)
        files: list[Path] = []
        names: list[str] = []
        parts: dict[str, Stroke] = {}
        told: list[str] = []
        signs: list[dict[str, int]] = []
        backward: list[str] = []
        for run in described.runs:
            source = open_source(run.file, registry=registry, format=run.format)
            columns = read_columns(run, source, described.columns, geometry=described.apparatus.geometry)
            rising = np.isfinite(columns.seconds) & (np.diff(columns.seconds, prepend=-np.inf) > 0)
            speed = sketch.wish.drive or 0.0  # of steps that are stated the sign is, too
            found = strokes(columns.kept(rising), abs(speed)) if isinstance(speed, float) else []
            shown = found[:STROKES]
            files += [run.file] * max(len(shown), 1)
            names += [f"{run.name}-{k + 1}" for k in range(len(shown))] or [run.name]
            parts |= {f"{run.name}-{k + 1}": stroke for k, stroke in enumerate(shown)}
            signs.append(_signs(columns, bool(found)))
            if signs[-1].get("observed", 1) < 0:
                backward.append(run.name)
                told.append(f"{run.name} is sheared with a negative sign: its observable counts with the other one")
            if found:
                some = f", of which the first {STROKES} are written" if len(found) > STROKES else ""
                told.append(f"{run.name} slides to and fro: {len(found)} strokes{some}, a run each, from half the force on")
    turned = {role for role in set().union(*signs) - {"observed"} if all(own.get(role, 1) < 0 for own in signs)}
    if turned.intersection(LOADS):
        told.append("compression is negative in the file: the load counts with the other sign")
    if turned.intersection(DRIVES):
        told.append("the drive goes backward in the file where the slider is sheared forward: it counts with the other sign")
    sketch = replace(sketch, files=tuple(files), names=names, strokes=parts, free=tuple(parts))
    return replace(sketch, turned=frozenset(turned), backward=tuple(backward)), told


def _signs(columns: Columns, turning: bool) -> dict[str, int]:
    """Return the signs of the load, of the observable and, where it alone is negative, of the drive; these two of no strokes."""
    arrays, found = columns.arrays, {}
    if (load := columns.role(*LOADS)) is not None:
        found[load] = -1 if np.nanmax(arrays[load]) < 0 else 1
    observed, drive = columns.role(*OBSERVED_ROLES), columns.role(*DRIVES)
    if observed is None or turning:
        return found
    if not np.any(arrays[observed]):
        raise SrfError(f"{columns.place(observed).column} is 0 throughout", f"Name another column: `columns` {observed}=HEADING.")
    found["observed"] = -1 if np.nanmedian(arrays[observed]) < 0 else 1
    if drive is not None and found["observed"] > 0:
        found[drive] = -1 if goes_backward(drive, arrays[drive]) else 1
    return found


@contextmanager
def _as_file(text: str) -> Iterator[Path]:
    """Give a file that holds a description, as long as it is read; what is wrong in it is told by the option that said it."""
    with tempfile.TemporaryDirectory() as home:
        file = Path(home) / "experiment.toml"
        file.write_text(text, encoding="utf-8")
        try:
            yield file
        except SrfError as error:
            plain = re.sub(rf"{re.escape(str(file))}(, line \d+)?: ", "", error.message)
            error.message = re.sub(rf"^(?:apparatus|runs\[\d+\])\.({'|'.join(ARGUMENTS)}): ", r"`\1`: ", plain)
            raise


@dataclass(frozen=True)
class _Sketch:
    """All that an experiment.toml is written from."""

    files: tuple[Path, ...]
    names: list[str]
    folder: Path
    wish: Wish
    columns: tuple[Named, ...]
    kind: str = "steps"
    why: str = ""
    free: tuple[str, ...] = ()
    modulations: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    durations: Mapping[str, float] = field(default_factory=dict)
    strokes: Mapping[str, Stroke] = field(default_factory=dict)  # by name, where a file holds several
    several: bool = False  # whether a run has many steps of the velocity
    turned: frozenset[str] = frozenset()  # roles whose columns count with the other sign
    backward: tuple[str, ...] = ()  # runs, without strokes, whose observable is negative

    @property
    def ageing(self) -> str:
        """Return the ageing law: that of the wish, else Dieterich's, with Linker's term where the load oscillates."""
        return self.wish.ageing or ("dieterich+linker-dieterich" if self.kind == "oscillation" else "dieterich")

    def text(self, parameters: Sequence[str], *, absolute: bool = False) -> str:
        """Return the whole file."""
        wish = self.wish
        lines = [
            f"format = {toml_value(EXPERIMENT_FORMAT)}",
            f"title = {toml_value(wish.title or ', '.join(self.names))}",
            *("", f"# Letters: {LETTERS}.", "", "[apparatus]"),
            f"stiffness = {toml_value(wish.stiffness)}   # of the machine: N/um, MPa/mm, or 1/um for friction per micron",
            *(f"{key} = {toml_value(value)}   # {RIG[key]}" for key, value in wish.rig.items()),
            f"mass = {toml_value(wish.mass)}" if wish.mass else NO_MASS,
            *("", "[model]   # `srf laws` lists the laws"),
            f"law = {toml_value(wish.law)}",
            f"ageing = {toml_value(self.ageing)}" + ("" if wish.ageing else '   # ageing law; "ruina" is the slip law'),
            f"interface = {toml_value(wish.interface)}",
            f"inertia = {toml_value(bool(wish.mass))}",
            *(STEP_BY_STEP if self.several else ()),
        ]
        if parameters:
            lines += ["", "[parameters]   # start values and bounds of what is fitted; a wide bound costs little", *parameters]
        turned = self.turned
        said = [n for n in self.columns if n.said or n.role in turned]
        if said:
            lines += ["", "[columns]   # what the headings of the data files mean"]
        bare = [split_heading(n.heading)[0] for n in self.columns]
        for n in said:
            name = split_heading(n.heading)[0]
            named = {"name": name if bare.count(name) == 1 else n.heading, "unit": n.unit}
            lines.append(f"{n.role} = {toml_value(named | ({'scale': -1} if n.role in turned else {}))}")
        if self.why:
            lines += ["", f"# The runs, of kind {self.kind}: {self.why}."]
        for path, name in zip(self.files, self.names, strict=True):
            lines += ["", "[[runs]]", *self._run(path, name, absolute=absolute)]
        return "\n".join(lines) + "\n"

    def _run(self, path: Path, name: str, *, absolute: bool) -> list[str]:
        wish, place = self.wish, path.resolve()
        home = self.folder.resolve()
        inside = home in place.parents and not absolute
        lines = [
            f"name = {toml_value(name)}",
            f"file = {toml_value(place.relative_to(home).as_posix() if inside else str(place))}",
        ]
        if wish.reader:
            lines.append(f"format = {toml_value(wish.reader)}")
        lines.append(f"holdout = {toml_value(name in wish.holdout)}   # true: never fitted, judges the fit")
        stroke = self.strokes.get(name)
        if stroke:
            lines.append(f"window = {toml_value([stroke.begin, stroke.end])}   # s of the file's clock: one stroke")
        elif wish.window:
            lines.append(f"window = {toml_value(wish.window)}   # s of the file's clock")
        elif not absolute:
            lines.append("# window = [0.0, 100.0]   # only this part of the recording, s of the file's clock")
        if name in self.backward or (stroke and stroke.backward):
            lines.append('direction = "backward"   # drive and observable count with the other sign')
        steps = wish.drive or ()
        if isinstance(steps, float):
            steps = [(self.durations.get(name, 1e9), steps)]
        if steps:
            lines.append(f"drive = {toml_value([{'duration': d, 'velocity': v} for d, v in steps])}   # s, um/s")
        if wish.load:
            lines.append(f"load = {toml_value(wish.load)}")
        if name in self.free:
            lines.append('initial = "free"   # the state at the first sample is estimated, not steady sliding')
        if name in self.modulations:
            wave = dict(zip(("frequency", "amplitude", "onset"), self.modulations[name], strict=True))
            told = "Hz, of the mean load, s; found in the column, which counts"
            lines.append(f"modulation = {toml_value(wave)}   # {told}")
        return lines


def _read(sketch: _Sketch, registry: Registry) -> tuple[_Sketch, Experiment]:
    """Return the sketch with the runs that have to begin from a free state, and the experiment as it is read."""
    while True:
        with _as_file(sketch.text((), absolute=True)) as file:
            try:
                return sketch, read_experiment(file, registry=registry)
            except StartsAtRest as error:
                sketch = replace(sketch, free=(*sketch.free, error.run))
            except NoContact as error:
                part = "{:.7g},{:.7g}, say, in s".format(*error.window) if error.window else "FROM,TO in seconds"
                error.hint = f"Take the part in contact: `window` {part}."
                raise


def _kind(runs: Sequence[Run], modulations: Mapping[str, tuple[float, float, float]]) -> tuple[str, str]:
    """Return what kind of experiment the runs are, and the reason."""
    if modulations:
        name, (f, eps, _) = next(iter(modulations.items()))
        return "oscillation", f"as the load of {name} oscillates by {100 * eps:.3g} % at {f:.4g} Hz"
    for run in runs:
        V = np.abs(run.drive(run.t))
        sliding = NO_SLIDING * float(V.max()) < V
        if not sliding.any():
            return "shs", f"as the drive of {run.name} does not move"
        held = HOLD_SPEED * float(V[sliding].min()) > V
        if held[int(np.argmax(sliding)) :].any() and _levels(V[sliding]) < SEVERAL:
            share = float(np.average(held[:-1], weights=np.diff(run.t)))
            return "shs", f"as the drive of {run.name} holds for {share:.0%} of the time"
    ranges = [np.abs(run.drive(run.t)) for run in runs]
    low, high = min(float(V.min()) for V in ranges), max(float(V.max()) for V in ranges)
    return ("steps", f"as the drive goes from {low:.3g} to {high:.3g} um/s" if high > 1.001 * low else f"at {low:.3g} um/s")


def _begun(runs: Sequence[Run], modulations: Mapping[str, tuple[float, float, float]]) -> dict[str, str]:
    """Return the runs that do not begin in steady sliding although the drive moves, with what tells it."""
    found = {}
    for run in runs:
        if run.initial != "steady":
            continue
        if run.name in modulations and modulations[run.name][2] <= run.t[0]:
            found[run.name] = "its load oscillates from the first sample on"
            continue
        until = run.edges[1] if len(run.edges) > 1 else run.t[-1]
        mu, before = run.friction[run.used], run.friction[run.used & (run.t <= until)]
        first, usual = float(np.median(mu[:5])), float(np.median(before if before.size > 10 else mu))
        if abs(first - usual) > UNLIKE_START * abs(usual):
            found[run.name] = f"its friction begins at {first / usual:.0%} of what it is before the first step"
    return found


def _levels(V: np.ndarray) -> int:
    """Return at how many velocities a run slides for a noticeable part of its time, those within a third of another as one."""
    _, counts = np.unique(np.round(np.log(V) / np.log(4 / 3)), return_counts=True)
    return int(np.sum(counts > 0.02 * V.size))


def _slid(run: Run) -> list[float]:
    """Return the velocities of sliding (um/s) that a run is held at, one after the other."""
    found = [V for _, V in levels(run)]
    return [V for V in found if NO_SLIDING * max(found) < V]


def _modulations(runs: Sequence[Run]) -> dict[str, tuple[float, float, float]]:
    found = {}
    for run in runs:
        W = run.load(run.t)[0]
        one = find_modulation(run.t, W) if np.ptp(W) > 0 else None
        if one is not None:
            onset = one.onset if math.isfinite(one.onset) else float(run.t[0])
            found[run.name] = (float(f"{one.frequency:.6g}"), float(f"{one.amplitude:.4g}"), float(f"{onset:.6g}"))
    return found


def _parameters(sketch: _Sketch, runs: Sequence[Run], registry: Registry) -> list[str]:
    """Return the lines of [parameters]: start values from the data where they tell, else those of rock, else the law's own."""
    wish = sketch.wish
    law = registry.get("friction", wish.law)
    base, modifiers = registry.ageing(sketch.ageing)
    surface = registry.get("interface", wish.interface)
    listed: list[Parameter] = [p for each in (law, base, *modifiers, surface) for p in each.parameters]
    V = float(np.median([next(iter(_slid(run)), 1.0) for run in runs]))
    friction = [run.friction[run.used] for run in runs]
    mu = float(np.median(np.concatenate(friction)))
    lines = []
    for p in listed:
        about = f"   # {p.about}" if p.about else ""
        if p.name == "V0":
            lines.append(f"V0 = {{ value = {_short(V)}, fixed = true }}{about}")
        elif p.name == "mu0":
            low, high = sorted((_short(0.6 * mu), _short(1.4 * mu)))
            lines.append(f"mu0 = {{ value = {_short(mu)}, lower = {low}, upper = {high} }}   # median of the recording")
        elif p.name in FRICTION_START or p.name == "D0":
            value, low, high = FRICTION_START.get(p.name) or _slip_length(runs)
            lines.append(f"{p.name} = {{ value = {value}, lower = {low}, upper = {high} }}{about}")
        else:
            low, high = max(p.lower, _short(p.default / BOUND_FACTOR)), min(p.upper, _short(p.default * BOUND_FACTOR))
            low = p.lower if any(p in each.parameters for each in modifiers) else low  # there may be nothing of it
            held = ", fixed = true" if not low < high else f", lower = {low}, upper = {high}"
            lines.append(f"{p.name} = {{ value = {p.default!r}{held} }}{about}")
    number, unit = split_quantity(wish.stiffness, name="`stiffness`")
    pair = f'lower = "{_short(number / 2)} {unit}", upper = "{_short(2 * number)} {unit}"'
    lines.append(f'# K = {{ value = "{wish.stiffness}", {pair} }}   # take the # away to fit the stiffness, too')
    return lines


def _slip_length(runs: Sequence[Run]) -> tuple[float, float, float]:
    """Return start value and bounds of D0 (um): of rock, or of slip at one velocity where that is much shorter or longer."""
    value, low, high = SLIP_LENGTH
    seen = scales_of(runs, ()).get("segment", LENGTHS_IN_SEGMENT * value) / LENGTHS_IN_SEGMENT
    if abs(math.log(seen / value)) < math.log(10):
        return SLIP_LENGTH
    return float(f"{seen:.1g}"), float(f"{seen * low / value:.1g}"), float(f"{seen * high / value:.1g}")


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def looks_like_recording(path: Path, *, registry: Registry) -> bool:
    """Return whether a file is a recording: it has a time and something that was observed."""
    try:
        headings = open_source(path, registry=registry).headings
    except SrfError:
        return False
    roles = {n.role for n in name_columns(headings, {}, path=path, per_load=False)}
    return "time" in roles and bool(roles & set(OBSERVED_ROLES))
