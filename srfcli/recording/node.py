"""A value in a TOML file that knows where it stands: every breach is told with file, line, key, finding and expectation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from srfcli.errors import SrfError, did_you_mean, printable, shown
from srfcli.reading import parse_toml, read_text
from srfcli.recording.places import Place, key_lines
from srfcli.recording.quantities import parse_quantity

SMALLEST = 1e-30  # of a number that is not zero: powers and products of it are numbers, too
LARGEST = 16 * 2**20  # bytes of a description


@dataclass(frozen=True)
class Node:
    """One value of a TOML file, its path of keys, and the lines of all keys of the file."""

    file: Path
    value: Any
    place: Place = ()
    lines: dict[Place, int] = field(default_factory=dict, repr=False)

    @property
    def where(self) -> str:
        """Return `experiment.toml, line 12: runs[0].file`, as far as it is known."""
        return self._where(self.place)

    def _where(self, place: Place) -> str:
        line = next((self.lines[place[:k]] for k in range(len(place), 0, -1) if place[:k] in self.lines), None)
        at = f"{self.file}, line {line}" if line else f"{self.file}"
        return f"{at}: {_spelled(place)}" if place else at

    def fail(self, message: str, hint: str | None = None) -> NoReturn:
        """Raise SrfError that names this place."""
        raise SrfError(printable(f"{self.where}: {message}", line=True), hint)

    def expected(self, what: str, hint: str | None = None) -> NoReturn:
        """Raise SrfError that says what was found here and what was expected."""
        self.fail(f"found {shown(self.value)}, expected {what}", hint)

    def child(self, key: str | int) -> Node:
        """Return the value under a key, or the element at an index, which must be there."""
        return Node(self.file, self.value[key], (*self.place, key), self.lines)

    def get(self, key: str) -> Node | None:
        """Return the value under a key, None where there is none."""
        return self.child(key) if key in self.value else None

    def require(self, key: str, hint: str) -> Node:
        """Return the value under a key; raises SrfError where there is none."""
        if key not in self.value:
            raise SrfError(printable(f"{self._where((*self.place, key))}: missing", line=True), hint)
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

    def text(self) -> str:
        """Return this value, which must be text."""
        if not isinstance(self.value, str):
            self.expected("text in quotes")
        return self.value

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
        if number and not SMALLEST <= abs(number) <= 1 / SMALLEST:
            self.expected(f"0 or a number of a size from {SMALLEST:g} to {1 / SMALLEST:g}")
        return number

    def quantity(self, unit: str) -> float:
        """Return this value in `unit`: a number in that unit, or text with a unit of its dimension."""
        if not isinstance(self.value, str):
            if isinstance(self.value, bool) or not isinstance(self.value, int | float):
                example = "0.5" if unit == "1" else f'0.5 or "0.5 {unit}"'
                self.expected(f"a number in {unit}" if unit != "1" else "a number", f"Write {example}.")
            return self.number()
        try:
            name = next((key for key in reversed(self.place) if isinstance(key, str)), "value")
            number = parse_quantity(self.value, unit, name=name)
            if number and not SMALLEST <= abs(number) <= 1 / SMALLEST:
                self.expected(f"0 or a number of a size from {SMALLEST:g} to {1 / SMALLEST:g} {unit}")
            return number
        except SrfError as error:
            self.fail(error.message, error.hint)


def open_node(path: Path) -> Node:
    """Return the table of a TOML file with the lines of its keys; raises SrfError where it is none."""
    try:
        text = read_text(path, limit=LARGEST).replace("\r\n", "\n")
    except OSError as error:
        raise SrfError(
            f"{path}: cannot be read: {error.strerror}", "Check path and permissions.", exit_code=1
        ) from None
    try:
        table = parse_toml(text, path)
    except SrfError as error:
        if path.suffix.lower() != ".toml":
            raise SrfError(
                f"{path}: a data file, not the description of an experiment",
                f"`srf new {path}` writes an experiment.toml for it.",
            ) from None
        raise SrfError(error.message, error.hint or 'Text goes in quotes: law = "srf-vsat".') from None
    return Node(path, table, (), key_lines(text))


def _spelled(place: Place) -> str:
    out = ""
    for key in place:
        out += f"[{key}]" if isinstance(key, int) else f".{key}" if out else key
    return out
