"""Marks and tables of `srf prove`, for benchmarks that answer the cases of its banks in other ways."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import Report

from srfcli.results.tables import cell_text
from srfcli.validation.blind import Answer
from srfcli.validation.marks import (
    Detectability,
    GradedAnswer,
    ablated,
    by_effect,
    by_outside,
    by_strength,
    calibrated,
    confusion,
    cost,
    grade,
    held_out_errors,
    rates,
    size_errors,
)


def marked(truths: dict[str, Any], answers: Sequence[Answer], known: Path | None) -> list[GradedAnswer]:
    """Return the marks; without what was visible everything that is concealed counts as visible."""
    detectabilities = {}
    if known is not None:
        for line in known.read_text(encoding="utf-8").splitlines():
            detectabilities[json.loads(line)["case"]] = Detectability(**json.loads(line))
    return [grade(truths[a.case], a, detectabilities.get(a.case, Detectability(a.case))) for a in answers]


def heading(report: Report, bank: str, cases: int, known: Path | None) -> None:
    """Say which cases were marked, and what counts as visible in them."""
    report.say(f"# {bank}, {cases} cases")
    asked = "visible as the trial found it" if known else "what is invisible was not asked: all counts as visible"
    report.say(f"# {asked}")


def tell(report: Report, marks: Sequence[GradedAnswer], who: str) -> None:
    """Say the tables of `srf prove` for these marks."""
    made = (confusion, rates, by_effect, by_outside, by_strength, calibrated, held_out_errors, size_errors, cost, ablated)
    for table in (make(marks) for make in made):
        if table.rows:
            report.say(f"\n{who}: {table.title}")
            formats = [c.format for c in table.columns]
            cells = [[cell_text(v, f) for v, f in zip(row, formats, strict=True)] for row in table.rows]
            report.table([c.name for c in table.columns], cells)
            for note in table.notes:
                report.say(f"# {note}")
