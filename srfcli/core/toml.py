"""A value in a TOML file that knows where it stands: every breach is told with file, line, key, finding and expectation."""

from __future__ import annotations

import contextlib
import math
import re
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from srfcli.core.errors import SrfError, did_you_mean, printable, shown
from srfcli.core.settings import LEAST_NUMBER
from srfcli.core.units import NO_GEOMETRY, Geometry, split_quantity, unit_factor

Value = TypeVar("Value")
Other = TypeVar("Other")


@dataclass(frozen=True)
class Node:
    """One value of a TOML file, its path of keys, and the text of the file."""

    file: Path
    value: Any
    place: Place = ()
    source: str = field(default="", repr=False)

    @property
    def where(self) -> str:
        """Return `experiment.toml, line 12: runs[0].file`, as far as it is known."""
        ends, lines = range(len(self.place), 0, -1), key_lines(self.source)
        line = next((lines[self.place[:k]] for k in ends if self.place[:k] in lines), None)
        at = f"{self.file}, line {line}" if line else f"{self.file}"
        keys = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in self.place)
        return f"{at}: {keys.removeprefix('.')}" if self.place else at

    def fail(self, message: str, hint: str | None = None) -> NoReturn:
        """Raise SrfError that names this place."""
        raise SrfError(printable(f"{self.where}: {message}", line=True), hint)

    @contextlib.contextmanager
    def blamed(self) -> Iterator[None]:
        """Name this place in an SrfError that is raised meanwhile."""
        try:
            yield
        except SrfError as error:
            self.fail(error.message, error.hint)

    def expected(self, what: str, hint: str | None = None) -> NoReturn:
        """Raise SrfError that says what was found here and what was expected."""
        self.fail(f"found {shown(self.value)}, expected {what}", hint)

    def child(self, key: str | int) -> Node:
        """Return the value under a key, or the element at an index, which must be there."""
        return Node(self.file, self.value[key], (*self.place, key), self.source)

    def get(self, key: str) -> Node | None:
        """Return the value under a key, None where there is none."""
        return self.child(key) if key in self.value else None

    def read(self, key: str, how: Callable[[Node], Value], default: Other) -> Value | Other:
        """Return what `how` makes of the value under a key, the default where there is none."""
        node = self.get(key)
        return default if node is None else how(node)

    def at(self, key: str) -> Node:
        """Return the value under a key; where there is none, None at its place."""
        return Node(self.file, self.value.get(key), (*self.place, key), self.source)

    def require(self, key: str, hint: str | None = None) -> Node:
        """Return the value under a key; raises SrfError where there is none."""
        if key not in self.value:
            self.at(key).fail("missing", hint)
        return self.child(key)

    def keys(self, known: Iterable[str]) -> None:
        """Raise SrfError for a key that means nothing here."""
        for key in self.value:
            if key not in tuple(known):
                self.child(key).fail("unknown key", did_you_mean(key, known))

    def table(self, example: str) -> Node:
        """Return this value, which must be a table."""
        if not isinstance(self.value, dict):
            self.expected("a table", f"Write {example}")
        return self

    def tables(self, example: str) -> Iterator[Node]:
        """Yield the elements of this value, which must be a list of tables, at least one."""
        if not isinstance(self.value, list) or not self.value:
            self.expected("tables, at least one", f"Write {example}")
        for index in range(len(self.value)):
            yield self.child(index).table(example)

    def items(self, what: str, hint: str, *, fewest: int = 0) -> list[Node]:
        """Return the elements of this value, which must be a list of `what`."""
        if not isinstance(self.value, list) or len(self.value) < fewest:
            self.expected(f"a list of {what}", hint)
        return [self.child(index) for index in range(len(self.value))]

    def text(self) -> str:
        """Return this value, which must be text."""
        if not isinstance(self.value, str):
            self.expected("text in quotes")
        return self.value

    def choice(self, known: Sequence[str]) -> str:
        """Return this value, which must be one of these words."""
        if self.text() not in known:
            self.expected(" or ".join(f'"{word}"' for word in known), did_you_mean(self.text(), known))
        return self.text()

    def boolean(self) -> bool:
        """Return this value, which must be true or false."""
        if not isinstance(self.value, bool):
            self.expected("true or false")
        return self.value

    def number(self) -> float:
        """Return this value, which must be a finite number."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            self.expected("a number")
        try:
            number = float(self.value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            self.expected("a finite number")
        return self._sized(number)

    def quantity(self, unit: str, geometry: Geometry = NO_GEOMETRY) -> float:
        """Return this value in `unit`: a number in that unit, or text with a unit of its dimension."""
        if not isinstance(self.value, str):
            if isinstance(self.value, bool) or not isinstance(self.value, int | float):
                example = "0.5" if unit == "1" else f'0.5 or "0.5 {unit}"'
                self.expected(f"a number in {unit}" if unit != "1" else "a number", f"Write {example}.")
            return self.number()
        name = next((key for key in reversed(self.place) if isinstance(key, str)), "value")
        with self.blamed():
            number, written = split_quantity(self.value, name=name, example=f"0.5 {unit}" if unit != "1" else "0.5")
            number *= unit_factor(written, unit, geometry) if written else 1.0
        return self._sized(number, f" {unit}")

    def positive(self, unit: str, what: str, geometry: Geometry = NO_GEOMETRY) -> float:
        """Return this value in `unit`; it must be above 0, which `what` says."""
        value = self.quantity(unit, geometry)
        if not value > 0:
            self.expected(what)
        return value

    def beside(self, what: str) -> Path:
        """Return the path that this text, relative to the file's folder, names; `what` says what it is."""
        if not self.text().strip() or "\0" in self.text():
            self.expected(what)
        return self.file.parent / self.text()

    def _sized(self, number: float, unit: str = "") -> float:
        """Return a number, which must be 0 or of a size that can be computed with."""
        if number and not LEAST_NUMBER <= abs(number) <= 1 / LEAST_NUMBER:
            self.expected(f"0 or a number of a size from {LEAST_NUMBER:g} to {1 / LEAST_NUMBER:g}{unit}")
        return number


# Where in a TOML text each key and each element stands: `tomli` gives values without lines.

Place = tuple[str | int, ...]

_KEY = re.compile(r"""[A-Za-z0-9_-]+|"(?:\\.|[^"\\])*"|'[^']*'""")
_KEYS = re.compile(rf"[ \t]*(?:{_KEY.pattern})(?:[ \t]*\.[ \t]*(?:{_KEY.pattern}))*[ \t]*")
_STRING = re.compile(
    r"""\"{3}(?:\\.|[^"\\]|"{1,2}(?!"))*"{3,5}|'{3}(?:[^']|'{1,2}(?!'))*'{3,5}|"(?:\\.|[^"\\])*"|'[^']*'""", re.DOTALL
)
_SCALAR = re.compile(r"[^,\]}#\n]+")
_SPACE = re.compile(r"[ \t]*")
_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")


@lru_cache(maxsize=4)
def key_lines(text: str) -> dict[Place, int]:
    """Return the line (from 1) of every key and array element, by its path, in a text that `tomli` accepts.

    `("runs", 0, "file")` is where the first run names its file, `("runs", 0)` the line of its header.
    """
    scanner = _Scanner(text)
    with contextlib.suppress(RecursionError, IndexError):  # nested beyond reason: what was found so far has lines
        scanner.document()
    return scanner.lines


class _Scanner:
    """A cursor over TOML that is known to be well formed, so that it need not check anything."""

    def __init__(self, text: str) -> None:
        self.text, self.at = text, 0
        self.starts = [0, *(m.end() for m in re.finditer("\n", text))]
        self.lines: dict[Place, int] = {}
        self.counts: dict[Place, int] = {}  # headers seen of each array of tables

    def note(self, place: Place) -> None:
        self.lines.setdefault(place, bisect_right(self.starts, self.at))

    def skip(self, pattern: re.Pattern[str]) -> re.Match[str]:
        """Pass what stands here, which is of this pattern."""
        match = pattern.match(self.text, self.at)
        assert match is not None
        self.at = match.end()
        return match

    def document(self) -> None:
        table: Place = ()
        while True:
            self.skip(_BLANK)
            if self.at >= len(self.text):
                return
            if self.text[self.at] == "[":
                table = self.header()
            else:
                self.pair(table)

    def header(self) -> Place:
        """Pass [table] or [[table]]; return its place, with the number of the element where it is one of an array."""
        brackets = 2 if self.text.startswith("[[", self.at) else 1
        self.at += brackets
        place: Place = ()
        keys = self.keys()
        for index, key in enumerate(keys, 1):
            place = (*place, key)
            if brackets == 2 and index == len(keys):
                self.counts[place] = self.counts.get(place, 0) + 1
            self.note(place)
            if place in self.counts:
                place = (*place, self.counts[place] - 1)
                self.note(place)
        self.at += brackets
        return place

    def keys(self) -> list[str]:
        """Pass a dotted key and return its parts; escapes in them are left as they are."""
        return [key[1:-1] if key[0] in "\"'" else key for key in _KEY.findall(self.skip(_KEYS)[0])]

    def pair(self, place: Place) -> None:
        for key in self.keys():
            place = (*place, key)
            self.note(place)
        self.at += 1  # the equals sign
        self.value(place)

    def value(self, place: Place) -> None:
        self.skip(_SPACE)
        opening = self.text[self.at]
        if opening == "[":
            for index, _ in enumerate(self.members("]")):
                self.note((*place, index))
                self.value((*place, index))
        elif opening == "{":
            for _ in self.members("}"):
                self.pair(place)
        else:
            self.skip(_STRING if opening in "\"'" else _SCALAR)

    def members(self, closing: str) -> Iterator[None]:
        """Stop at each member of an array or inline table, which the caller passes, and pass the brackets and commas."""
        self.at += 1
        while True:
            self.skip(_BLANK)
            if self.text[self.at] == closing:
                self.at += 1
                return
            if self.text[self.at] == ",":
                self.at += 1
            else:
                yield
