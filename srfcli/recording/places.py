"""Where in a TOML text each key and each element stands: `tomllib` gives values without lines."""

from __future__ import annotations

import contextlib
import re
from bisect import bisect_right

Place = tuple[str | int, ...]

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_SCALAR = re.compile(r"[^,\]}#\n]+")
_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")


def key_lines(text: str) -> dict[Place, int]:
    """Return the line (from 1) of every key and array element, by its path, in a text that `tomllib` accepts.

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

    def blank(self) -> None:
        match = _BLANK.match(self.text, self.at)
        assert match is not None
        self.at = match.end()

    def spaces(self) -> None:
        while self.text[self.at : self.at + 1] in (" ", "\t"):
            self.at += 1

    def document(self) -> None:
        table: Place = ()
        while True:
            self.blank()
            if self.at >= len(self.text):
                return
            if self.text[self.at] == "[":
                table = self.header()
            else:
                self.pair(table)

    def header(self) -> Place:
        double = self.text.startswith("[[", self.at)
        self.at += 2 if double else 1
        keys = self.keys()
        place: Place = ()
        for index, key in enumerate(keys):
            place = (*place, key)
            last = index == len(keys) - 1
            if double and last:
                self.counts[place] = self.counts.get(place, 0) + 1
            self.note(place)
            if place in self.counts:
                place = (*place, self.counts[place] - 1)
                self.note(place)
        self.at += 2 if double else 1
        return place

    def keys(self) -> tuple[str, ...]:
        found = []
        while True:
            self.spaces()
            if self.text[self.at] in "\"'":
                found.append(self.string())
            else:
                match = _BARE.match(self.text, self.at)
                assert match is not None
                found.append(match[0])
                self.at = match.end()
            self.spaces()
            if self.text[self.at] != ".":
                return tuple(found)
            self.at += 1

    def pair(self, table: Place) -> None:
        start, place = self.at, table
        keys = self.keys()
        after, self.at = self.at, start
        for key in keys:
            place = (*place, key)
            self.note(place)
        self.at = after + 1  # the equals sign
        self.value(place)

    def value(self, place: Place) -> None:
        self.spaces()
        opening = self.text[self.at]
        if opening in "\"'":
            self.string()
        elif opening == "[":
            self.array(place)
        elif opening == "{":
            self.inline(place)
        else:
            match = _SCALAR.match(self.text, self.at)
            assert match is not None
            self.at = match.end()

    def array(self, place: Place) -> None:
        self.at += 1
        index = 0
        while True:
            self.blank()
            if self.text[self.at] == "]":
                self.at += 1
                return
            if self.text[self.at] == ",":
                self.at += 1
                continue
            self.note((*place, index))
            self.value((*place, index))
            index += 1

    def inline(self, place: Place) -> None:
        self.at += 1
        while True:
            self.blank()
            if self.text[self.at] == "}":
                self.at += 1
                return
            if self.text[self.at] == ",":
                self.at += 1
                continue
            self.pair(place)

    def string(self) -> str:
        """Pass a string and return what stands between its quotes; escapes in a key are left as they are."""
        quote = self.text[self.at]
        if self.text.startswith(3 * quote, self.at):
            return self.long_string(quote)
        start = self.at = self.at + 1
        while self.text[self.at] != quote:
            self.at += 2 if quote == '"' and self.text[self.at] == "\\" else 1
        self.at += 1
        return self.text[start : self.at - 1]

    def long_string(self, quote: str) -> str:
        start = self.at = self.at + 3
        while not self.text.startswith(3 * quote, self.at):
            self.at += 2 if quote == '"' and self.text[self.at] == "\\" else 1
        while self.text[self.at + 3 : self.at + 4] == quote:  # up to two quotes may stand before the closing three
            self.at += 1
        self.at += 3
        return self.text[start : self.at - 3]
