"""What a diagnosis said of one case: a line of a file that grows while a trial runs, and from which it resumes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from srfcli.errors import SrfError
from srfcli.output.files import write_atomic
from srfcli.reading import parse_json, read_text

LARGEST = 64 * 2**20  # bytes of all answers

FAILED = "failed"  # beside the verdicts: the diagnosis raised, ran out of time, or ended its process
VERDICTS = ("none", "identified", "ambiguous", "unknown", "inconclusive", FAILED)


@dataclass(frozen=True)
class Answer:
    """One case's answer: verdict, effects and stated confidence by hypothesis, "a+b" for two effects together.

    `fit` holds the fitted runs' rms over noise, `held` each held-out run's rms in um and over noise, by `baseline` and
    `augmented`; `parameters` are those that the effects brought, in declared units; `tried` has what was fitted, `ungated` the
    verdict without a say of held-out runs; `cpu` and `wall` are in s; `code` tells programs apart.
    """

    case: str
    verdict: str
    effects: tuple[str, ...] = ()
    confidence: Mapping[str, float] = field(default_factory=dict)
    equivalent: tuple[tuple[str, ...], ...] = ()
    not_identifiable: tuple[str, ...] = ()
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    fit: Mapping[str, float | None] = field(default_factory=dict)
    held: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    tried: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    ungated: str = ""
    cpu: float = 0.0
    wall: float = 0.0
    code: str = ""
    failure: str = ""

    @property
    def said(self) -> str:
        """Return the answer as the key under which its confidence is stated; the listed names for an ambiguous one."""
        if self.verdict in ("identified", "ambiguous"):
            return "+".join(sorted(self.effects))
        return "none" if self.verdict == "inconclusive" else self.verdict


def to_line(answer: Answer) -> str:
    """Return the answer as one line of JSON; numbers that are none are null."""
    return json.dumps(asdict(answer), sort_keys=True, allow_nan=False)


def from_line(line: str, *, where: str) -> Answer:
    """Return the answer of a line; SrfError, naming `where`, for one that is no answer."""
    try:
        found = parse_json(line, "the line")
        if not isinstance(found, dict) or set(found) != {f.name for f in fields(Answer)}:
            raise ValueError("not the keys of an answer")
        if found["verdict"] not in VERDICTS:
            raise ValueError(f"verdict {found['verdict']!r}")
    except (SrfError, ValueError) as error:
        raise SrfError(f"{where}: no answer: {error}", "Delete the line, and go on with --resume.") from None
    try:
        equivalent = tuple(tuple(names) for names in found["equivalent"])
        lists = {name: tuple(found[name]) for name in ("effects", "not_identifiable")}
    except TypeError as error:
        raise SrfError(f"{where}: no answer: {error}", "Delete the line, and go on with --resume.") from None
    return Answer(**{**found, **lists, "equivalent": equivalent})


def read_answers(path: Path) -> dict[str, Answer]:
    """Return the answers of a file by case, none where there is no file; SrfError for a damaged line or a case named twice."""
    try:
        text = read_text(path, limit=LARGEST, what="answers")
    except FileNotFoundError:
        return {}
    found: dict[str, Answer] = {}
    for number, line in enumerate(text.splitlines(), 1):
        answer = from_line(line, where=f"{path}, line {number}")
        if answer.case in found:
            raise SrfError(f"{path}, line {number}: {answer.case} was answered before", "Delete one of the two lines.")
        found[answer.case] = answer
    return found


def write_answers(path: Path, answers: Iterable[Answer]) -> None:
    """Write one line per answer, by case: the file is whole at any moment, and the same however the cases were spread."""
    lines = [to_line(a) + "\n" for a in sorted(answers, key=lambda a: a.case)]
    write_atomic(path, "".join(lines))
