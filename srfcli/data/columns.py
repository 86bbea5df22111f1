"""From a file to its columns, and from columns to the roles they play, in um, s, N."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.model import Array
from srfcli.core.errors import CHECK_PATH, Notice, SrfError, did_you_mean
from srfcli.core.files import open_plain
from srfcli.core.units import NO_GEOMETRY, Geometry, find_unit, split_heading
from srfcli.data.clock import Mask, Place
from srfcli.data.description import ROLES, ColumnSpec, RunDescription, check_unit
from srfcli.data.values import OBSERVABLES, OTHER_OBSERVABLES
from srfcli.laws.registry import Registry
from srfcli.laws.values import Reader, Source

# From a file to its columns: which reader opens it, and a check of what the reader returns.

SNIFFED = 4096  # bytes
SLICE = 2**18  # rows that are taken from an array at a time


def open_source(path: Path, *, registry: Registry, format: str | None = None) -> Source:
    """Return the columns of a data file, by the reader called `format`, else by the one that knows the content.

    Raises SrfError where the file is missing or empty, where no reader or more than one knows it, and for what readers refuse.
    """
    try:
        with open_plain(path) as stream:
            head = stream.read(SNIFFED)
    except FileNotFoundError:
        names = [p.name for p in path.parent.glob("*")]
        hint = did_you_mean(path.name, names) if names else "Its folder is empty."
        if not path.parent.is_dir():
            hint = f"There is no folder {path.parent}."
        raise SrfError(f"no file {path}", hint, kind="no file") from None
    except OSError as error:
        raise _unreadable(path, error) from None
    if not head:
        raise SrfError(f"{path}: the file is empty", "A recording has a line of headings and a line for each sample.")
    reader = registry.load(registry.find("reader", format)) if format else _sniffed(path, head, registry)
    with _reading(reader, path):
        found = reader.read(path)
    source = found if isinstance(found, Source) else _from_mapping(found, reader, path)
    if not source.headings or not all(isinstance(h, str) for h in source.headings):
        raise SrfError(f"{path}: the reader '{reader.name}' finds no columns", "Check the file, or name its kind.")
    return replace(source, blocks=lambda columns: _guarded(source, columns, reader, path))


def _sniffed(path: Path, head: bytes, registry: Registry) -> Reader:
    """Return the reader of a file: one that goes by its ending alone, else the one whose test the first bytes pass."""
    readers = [(entry, registry.load(entry)) for entry in registry.entries("reader")]
    by_suffix = [(e, r) for e, r in readers if r.sniff is None and path.suffix.lower() in r.suffixes]
    found = by_suffix or [(e, r) for e, r in readers if r.sniff is not None and _passes(r.sniff, head)]
    if len(found) > 1:  # content alone does not decide: the ending does
        found = [(e, r) for e, r in found if path.suffix.lower() in r.suffixes] or found
    names = ", ".join(sorted({e.name for e, _ in readers}))
    if not found and head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise SrfError(f"{path}: UTF-16 text", "Save the file as UTF-8.")
    if not found:
        raise SrfError(f"{path}: no reader knows this kind of file", f'Name one with format = "...": {names}.')
    if len(found) > 1:
        listed = " and ".join(f"'{e.name}' ({e.origin})" for e, _ in found)
        raise SrfError(f"{path}: {listed} would read this file", f'Choose with format = "{found[0][0].name}".')
    return found[0][1]


def _passes(test: Callable[[bytes], bool], head: bytes) -> bool:
    try:
        return bool(test(head))
    except Exception:  # a test that fails on strange bytes does not know the file
        return False


def _unreadable(path: Path, error: OSError) -> SrfError:
    return SrfError(f"{path}: cannot be read: {error.strerror or error}", CHECK_PATH, exit_code=1)


@contextlib.contextmanager
def _reading(reader: Reader, path: Path) -> Iterator[None]:
    """Raise SrfError for whatever goes wrong inside: a reader is anybody's code, and the file anybody's bytes."""
    try:
        yield
    except SrfError:
        raise
    except OSError as error:
        raise _unreadable(path, error) from error
    except Exception as error:
        told = " ".join(str(error).split())[:200]
        raise SrfError(
            f"{path}: the reader '{reader.name}' stopped: {type(error).__name__}: {told}",
            "Check the file, or name its kind with format = ... (`srf laws --kind reader`).",
        ) from error


def _from_mapping(found: object, reader: Reader, path: Path) -> Source:
    """Return the source of a reader that gave arrays by heading."""
    if not isinstance(found, Mapping):
        raise SrfError(
            f"{path}: the reader '{reader.name}' returned {type(found).__name__}, expected columns by heading",
            'Return {"time [s]": times, ...} or a Source.',
        )
    arrays = {str(heading): np.asarray(values) for heading, values in found.items()}
    for heading, values in arrays.items():
        if values.ndim != 1:
            raise SrfError(f"{path}: column '{heading}' has the shape {values.shape}", "Give one row of numbers each.")
    lengths = {values.size for values in arrays.values()}
    if len(lengths) > 1:
        told = ", ".join(f"'{h}': {v.size}" for h, v in arrays.items())
        raise SrfError(f"{path}: the columns differ in length: {told}", "Every column needs a value for every sample.")
    rows = lengths.pop() if lengths else 0
    columns = tuple(arrays.values())

    def blocks(wanted: tuple[int, ...]) -> Iterator[Sequence[Any]]:
        for at in range(0, rows, SLICE):
            yield [columns[k][at : at + SLICE] for k in wanted]

    return Source(tuple(arrays), blocks, rows)


def _guarded(source: Source, columns: tuple[int, ...], reader: Reader, path: Path) -> Iterator[Sequence[Array]]:
    """Yield the reader's blocks as float arrays of equal length; raises SrfError for anything else that it does."""
    blocks = iter(source.blocks(columns))
    while True:
        with _reading(reader, path):
            block = next(blocks, None)
            if block is None:
                return
            arrays = [np.asarray(values, dtype=float) for values in block]
            if len(arrays) != len(columns) or len({a.shape for a in arrays}) != 1 or arrays[0].ndim != 1:
                raise ValueError(f"shapes {[a.shape for a in arrays]} for {len(columns)} columns")
        yield arrays


# Which column plays which role, and its numbers in um, s, N, read block by block inside a window of time.

MOST_BYTES = 512 * 2**20  # bytes of needed columns that are held at a time
DRIVES = ("load_point_velocity", "load_point_displacement")
NO_MEASUREMENT = 1e30  # um, s, N: no measurement, but a gauge's word for none


@dataclass(frozen=True)
class Channel:
    """A column that plays a role: `values = (number scale + offset) factor` are in um, s, N."""

    role: str
    heading: str
    column: int
    unit: str
    factor: float
    spec: ColumnSpec


@dataclass(frozen=True)
class Columns:
    """The columns of one run inside its window: `rows` are counted from 1 at the first sample of the file.

    `first` is the time of the file's first sample, `seconds` and `arrays` are in um, s, N and may still hold NaN.
    """

    path: Path
    first: float
    rows: NDArray[np.int64] = field(repr=False)
    seconds: Array = field(repr=False)
    arrays: Mapping[str, Array] = field(repr=False)
    channels: Mapping[str, Channel]
    notices: tuple[Notice, ...]
    remarks: Mapping[str, str] = field(default_factory=dict)

    def kept(self, keep: Mask) -> Columns:
        """Return the columns with these samples (n,) alone."""
        arrays = {role: values[keep] for role, values in self.arrays.items()}
        return replace(self, rows=self.rows[keep], seconds=self.seconds[keep], arrays=arrays)

    def place(self, role: str) -> Place:
        """Return where a role's numbers stand in the file."""
        return Place(self.path, self.channels[role].heading, self.rows, self.seconds)

    def role(self, *roles: str) -> str | None:
        """Return the first of these roles that a column plays, None where none does."""
        return next((role for role in roles if role in self.arrays), None)


def read_columns(
    run: RunDescription,
    source: Source,
    specs: Mapping[str, ColumnSpec],
    *,
    limit: int = MOST_BYTES,
    geometry: Geometry = NO_GEOMETRY,
) -> Columns:
    """Return what the run needs of its file; raises SrfError for a missing column, a wrong unit or too large a recording."""
    finder = Finder(run.file, source.headings, specs, geometry)
    channels = _needed(run, finder)
    notices = list(finder.notices)
    _refuse_large(run, source, len(channels), limit)
    kept, rows, first = _collect(run, source, channels, limit)
    if not rows.size:
        if run.window is not None and np.isfinite(first):
            run.node.child("window").fail(
                f"no sample of {run.file} lies in [{run.window[0]:g}, {run.window[1]:g}] s; its clock begins at {first:.10g} s",
                "The window is in seconds of the file's own clock.",
            )
        raise SrfError(f"{run.file}: no samples", "A recording needs a line of numbers for each sample.")
    named = {channel.role: channel for channel in channels}
    arrays = {channel.role: values for channel, values in zip(channels[1:], kept[1:], strict=True)}
    if run.backward:  # a drive may be recorded without its sign
        arrays |= {role: -arrays[role] for role in DRIVES if role in arrays and goes_backward(role, arrays[role])}
    remarks = {c.role: source.remarks[c.heading] for c in channels if c.heading in source.remarks}
    return Columns(run.file, first, rows, kept[0], arrays, named, tuple(notices), remarks)


def goes_backward(role: str, moves: Array) -> bool:
    """Return whether the load point went back in all, by a column (n,) of its velocity or its displacement."""
    known = moves[np.isfinite(moves)]
    return float(np.sum(known if role == "load_point_velocity" else np.diff(known))) < 0


class Finder:
    """The headings of a file, looked up by role; `specs` are those of [columns]."""

    def __init__(
        self, path: Path, headings: tuple[str, ...], specs: Mapping[str, ColumnSpec], geometry: Geometry = NO_GEOMETRY
    ) -> None:
        self.path, self.headings, self.specs, self.geometry = path, headings, specs, geometry
        self.parts = [split_heading(h) for h in headings]
        self.notices: list[Notice] = []

    def find(self, role: str) -> Channel | None:
        """Return the channel of a role, None where neither [columns] nor a heading has it."""
        if (spec := self.specs.get(role)) is not None:
            found = self._named(spec)
        elif not (found := [i for i, (name, unit) in enumerate(self.parts) if _heads(name, unit) == role]):
            return None
        if len(found) > 1:
            full = self.headings[found[0]]
            hint = f'Name the one for {role} in full: [columns] {role} = {{ name = "{full}" }}.'
            if len({self.headings[i] for i in found}) == 1:
                hint = f"Their headings are the same, '{full}': rename one of them in the file."
            raise SrfError(f"{self.path}: {len(found)} columns are called '{self.parts[found[0]][0]}'", hint)
        return self._channel(role, spec or ColumnSpec(role), found[0])

    def _named(self, spec: ColumnSpec) -> list[int]:
        assert spec.node is not None
        names, plain = [name for name, _ in self.parts], [_plain(name) for name, _ in self.parts]
        for known, wanted in ((self.headings, spec.name), (names, spec.name), (plain, _plain(spec.name))):
            if found := [i for i, name in enumerate(known) if name == wanted]:
                return found
        spec.node.fail(f"{self.path} has no column '{spec.name}'", did_you_mean(spec.name, names))

    def _channel(self, role: str, spec: ColumnSpec, column: int) -> Channel:
        written, heading = self.parts[column][1], self.headings[column]
        where = f"{self.path}: column '{heading}'"
        unit = spec.unit if spec.unit is not None else written if written is not None else ROLES[role]
        node = spec.node if spec.unit is not None else None
        factor = check_unit(unit, role, node, where, self.geometry)
        if spec.unit is not None and written is not None:
            same = False
            with contextlib.suppress(SrfError):
                same = check_unit(written, role, geometry=self.geometry) == factor
            if not same:
                what = f"the heading says {written!r}, [columns] says {spec.unit!r}, which counts"
                self.notices.append(Notice("unit", where, what))
        return Channel(role, heading, column, unit, factor, spec)


def _heads(name: str, unit: str | None) -> str:
    """Return the role that a heading names; what is headed friction and has a unit of force or stress is a force."""
    plain = _plain(name)
    if plain == "friction" and unit is not None:
        with contextlib.suppress(SrfError):
            return "force" if find_unit(unit).powers[2] == 1 else plain
    return plain


def _plain(name: str) -> str:
    return re.sub(r"[\s_\-]+", "_", name.strip().lower())


def _needed(run: RunDescription, finder: Finder) -> list[Channel]:
    """Return the channels of a run, the time first; raises SrfError that names all that is missing."""
    lacks: list[tuple[str, str]] = []  # what, and what to do
    time = finder.find("time")
    names = [name for name, _ in finder.parts]
    if time is None:
        hint = f'Head it `time [s]`, or write [columns] time = {{ name = "...", unit = "s" }}. {_near(["time"], names)}'
        lacks.append((f"{run.file}: no column 'time'; found: {', '.join(finder.headings)}", hint))
    roles = (*OBSERVABLES, "shear_stress")
    observables = _wanted(run, finder) or [c for role in roles if (c := finder.find(role))]
    if not observables:
        found = "" if lacks else f"; found: {', '.join(finder.headings)}"
        hint = f"One of them is needed; [columns] can name it. {_near(roles, names)}"
        lacks.append((f"{run.file}: none of the columns {', '.join(roles)}{found}", hint))
    seen = observables if run.observables else ([c for c in observables if c.role in finder.specs] or observables)[:1]
    beside = [c.role for c in observables if c.column not in {one.column for one in seen}]
    if beside:
        others = ", ".join(beside)
        every = ", ".join(f'"{role}"' for role in (seen[0].role, *beside))
        what = f"{seen[0].role} is what is compared; the file also has {others}, left aside (observables = [{every}] takes all)"
        finder.notices.append(Notice("observable", str(run.file), what))
    moves = finder.find("load_point_velocity")
    if moves is None and run.drive is None:
        moves = finder.find("load_point_displacement")
        if moves is None:
            hint = f"Write drive = [{{ duration = ..., velocity = ... }}], or name the column. {_near(list(ROLES)[1:3], names)}"
            what = f"{run.node.where}: the run has no drive, and {run.file} no load_point_velocity or load_point_displacement"
            lacks.append((what, hint))
    weights = [c for role in ("normal_load", "normal_stress") if (c := finder.find(role))]
    if len({c.column for c in weights}) > 1:
        what = "normal_load is what counts; the file also has normal_stress, left aside"
        finder.notices.append(Notice("load", str(run.file), what))
    if not weights and run.load is None and any(c.role != "friction" for c in seen):
        hint = f'Write load = "5 N", or name the column. {_near(["normal_load", "normal_stress"], names)}'
        lacks.append((f"{run.node.where}: the run has no load, and {run.file} no normal_load or normal_stress", hint))
    if lacks or time is None:
        raise SrfError("; ".join(what for what, _ in lacks), " ".join(hint.strip() for _, hint in lacks))
    channels = [time, *(replace(c, role="force") if c.role == "shear_stress" else c for c in seen)]
    if run.backward:
        channels[1:] = [c if c.role == "contact_area" else replace(c, factor=-c.factor) for c in channels[1:]]
    return [*channels, *([moves] if moves else []), *weights[:1]]


def _wanted(run: RunDescription, finder: Finder) -> list[Channel]:
    """Return the channels of the observables that a run lists, one of the spring first."""
    found = []
    for number, role in enumerate(run.observables):
        channel = finder.find(role)
        if channel is None:
            names = [name for name, _ in finder.parts]
            run.node.child("observables").child(number).fail(
                f"{run.file} has no column '{role}'; found: {', '.join(finder.headings)}",
                f"[columns] can name it. {_near([role], names)}".strip(),
            )
        found.append(channel)
    return sorted(found, key=lambda c: c.role in OTHER_OBSERVABLES)


def _near(roles: Iterable[str], names: list[str]) -> str:
    """Return a question where a heading looks like a misspelt role."""
    import difflib

    for role in roles:
        close = difflib.get_close_matches(role, [_plain(n) for n in names], n=1, cutoff=0.75)
        if close:
            return f"Is '{names[[_plain(n) for n in names].index(close[0])]}' the {role}?"
    return ""


def _refuse_large(run: RunDescription, source: Source, columns: int, limit: int) -> None:
    """Raise SrfError where the file says that what is needed is too large."""
    needed = (source.rows or 0) * (columns + 1) * 8
    told = f"{source.rows} samples of {columns} needed columns are {_megabytes(needed)}"
    if needed > limit and source.whole:
        raise SrfError(
            f"{run.file}: {told}, above the limit of {_megabytes(limit)}, and this kind of file cannot be read in parts",
            "Save it as CSV or NPZ, or raise the limit.",
        )
    if needed > limit and run.window is None:
        _too_large(run, told, limit)
    guess = (source.about or 0) * (columns + 1) * 8
    if guess > 1.5 * limit and run.window is None:  # an estimate may be off; what is nearer is counted while it is read
        _too_large(run, f"some {source.about:.2g} samples of {columns} needed columns are {_megabytes(guess)}", limit)


def _too_large(run: RunDescription, what: str, limit: int) -> None:
    size = _megabytes(run.file.stat().st_size)
    raise SrfError(
        f"{run.node.where}: {run.file} ({size}) is too large to hold: {what}, above the limit of {_megabytes(limit)}",
        "Take a part with window = [from, to] in seconds, which reads only that part into memory, or raise the limit.",
    )


def _megabytes(count: float) -> str:
    return f"{count / 2**20:.4g} MB"


def _collect(
    run: RunDescription, source: Source, channels: list[Channel], limit: int
) -> tuple[list[Array], NDArray[np.int64], float]:
    """Return the columns inside the window in um, s, N, the numbers of their rows, and the first time of the file."""
    pieces: list[list[Array]] = []
    numbers: list[NDArray[np.int64]] = []
    row, held, clock, first = 1, 0, 0.0, np.nan
    low, high = run.window or (-np.inf, np.inf)
    for block in source.blocks(tuple(channel.column for channel in channels)):
        with np.errstate(over="ignore", invalid="ignore"):
            arrays = [(b * c.spec.scale + c.spec.offset) * c.factor for b, c in zip(block, channels, strict=True)]
            if channels[0].spec.integrate:
                arrays[0] = _integrated(run.file, channels[0], arrays[0], clock, row)
                clock = float(arrays[0][-1]) if arrays[0].size else clock
        for values in arrays:
            values[~(np.abs(values) < NO_MEASUREMENT)] = np.nan
        if np.isnan(first) and np.isfinite(arrays[0]).any():
            first = float(arrays[0][np.isfinite(arrays[0])][0])
        with np.errstate(invalid="ignore"):
            inside = np.isnan(arrays[0]) | ((arrays[0] >= low) & (arrays[0] <= high))
        held += int(inside.sum()) * (len(arrays) + 1) * 8
        if held > limit:
            _too_large(run, f"what is needed of it exceeds {_megabytes(held)}", limit)
        pieces.append([values[inside] for values in arrays])
        numbers.append(row + np.flatnonzero(inside))
        row += inside.size
    columns = [np.concatenate([p[k] for p in pieces]) if pieces else np.empty(0) for k in range(len(channels))]
    known = np.flatnonzero(np.isfinite(columns[0]))
    # what has no time belongs where its neighbours are
    part = slice(known[0], known[-1] + 1) if known.size else slice(0, 0)
    return [c[part] for c in columns], np.concatenate([np.empty(0, np.int64), *numbers])[part], first


def _integrated(path: Path, channel: Channel, intervals: Array, clock: float, row: int) -> Array:
    """Return times from sample intervals, the first of which ends at the first sample."""
    bad = np.flatnonzero(~np.isfinite(intervals) | (intervals < 0))
    if bad.size:
        raise SrfError(
            f"{path}, row {row + bad[0]}, column '{channel.heading}': found {intervals[bad[0]]:g} s, expected a sample interval",
            "A missing interval makes all later times unknown.",
        )
    return np.asarray(clock + np.cumsum(intervals))
