"""A page on the results in a folder: fits, maps, comparisons and other tables that were written as JSON, with their figures."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from srfcli import __version__
from srfcli.errors import SrfError
from srfcli.output.provenance import sidecar_path
from srfcli.output.report_page import Markup, page, picture, section, table, tag
from srfcli.output.report_text import bracketed, finite, number, unit_text

MOST_ROWS, MOST_COLUMNS = 40, 7  # of a table on the page; the file has all
KINDS = {
    "fit": "Fit of recordings",
    "thresholds": "Fit of critical loads",
    "map": "Stability map",
    "compare": "Laws compared",
    "continue": "Stability boundary",
    "critical": "Critical loads",
    "linear": "Critical load under constant load",
    "floquet": "Forced periodic state",
    "response": "Response to a modulated load",
    "check": "What is in the recordings",
    "simulate": "Simulation",
}


def read_results(folder: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Return the results in a folder, in order of name; raises SrfError where there are none."""
    if not folder.is_dir():
        raise SrfError(f"{folder}: not a folder", "Name the folder that results were written to with --out FILE.json.")
    found = []
    for path in sorted(folder.glob("*.json")):
        if path.name.endswith(".provenance.json"):
            continue
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        if isinstance(data, dict) and str(data.get("schema", "")).startswith("srf.") and "rows" in data:
            found.append((path, data))
    if found:
        return found
    if (folder / "answer.json").is_file():
        raise SrfError(f"{folder} holds a diagnosis", f"Its report is {folder / 'report.html'}.")
    raise SrfError(
        f"{folder}: no result in it", "Write some first: srf fit EXPERIMENT --out FOLDER/fit.json --plot FOLDER/fit.svg"
    )


def results_page(folder: Path, results: Sequence[tuple[Path, Mapping[str, Any]]], *, title: str) -> str:
    """Return a page with a section for each result: what was found, its picture, its table, how it was made."""
    shown = [_result(folder, path, data) for path, data in results]
    links = [tag("a", path.stem, href=f"#{_anchor(path)}") for path, _ in results]
    first = tag("h1", _headline(results[0][1])) if len(results) == 1 else tag("h1", f"{title}: {len(results)} results")
    head = tag("header", tag("p", title, class_="of"), first, tag("nav", links) if len(links) > 1 else "")
    return page(title, head, tag("main", shown), tag("p", f"srf {__version__}", class_="of"))


def _anchor(path: Path) -> str:
    return re.sub(r"[^a-z0-9]+", "-", path.stem.lower()).strip("-") or "result"


def _kind(data: Mapping[str, Any]) -> str:
    name = str(data["schema"]).removeprefix("srf.").partition("/")[0].partition(".")[0]
    return KINDS.get(name, name)


def _headline(data: Mapping[str, Any]) -> str:
    """Return what was found, in a sentence."""
    notes, rows = [str(n) for n in data.get("notes") or ()], list(data.get("rows") or ())
    if str(data["schema"]).startswith("srf.fit/"):
        told = []
        for row in rows:
            unit = unit_text(row.get("unit"))
            told.append(
                f"{row['parameter']} = {bracketed(row.get('value'), row.get('stderr'))}" + (f" {unit}" if unit else "")
            )
        ratio = ((data.get("meta") or {}).get("rms_over_noise") or {}).get("fit")
        tail = f"; residuals are {number(ratio)} times the noise" if finite(ratio) else ""
        return ", ".join(told) + tail + _state(data)
    return (
        f"{notes[0][:1].upper()}{notes[0][1:]}{_state(data)}"
        if notes
        else f"{_kind(data)}: {len(rows)} rows{_state(data)}"
    )


def _state(data: Mapping[str, Any]) -> str:
    status = str(data.get("status", "ok"))
    return "." if status == "ok" else f". Not finished: {status}."


def _result(folder: Path, path: Path, data: Mapping[str, Any]) -> Markup:
    heading = f"{_kind(data)}: {data['title']}" if data.get("title") else _kind(data)
    parts: list[Any] = [tag("p", tag("strong", _headline(data)))]
    for suffix in (".svg", ".png"):
        figure = path.with_suffix(suffix)
        if figure.is_file():
            alt = f"Figure of {path.stem}: {heading}."
            parts.append(picture(figure.read_bytes(), suffix, alt=alt, caption=f"{figure.name}"))
            break
    parts.append(_table(data))
    flagged = [r for r in data.get("rows") or () if r.get("flag")]
    if flagged:
        parts.append(
            tag(
                "p",
                "To be known before the values are used: "
                + "; ".join(f"{r['parameter']}: {r['flag']}" for r in flagged)
                + ".",
            )
        )
    runs = (data.get("meta") or {}).get("runs")
    if isinstance(runs, list) and runs and isinstance(runs[0], dict) and "rms_over_noise" in runs[0]:
        rows = [[r["run"], r["role"], r["samples"], number(r["rms_over_noise"])] for r in runs]
        parts.append(
            table(
                ["run", "role", "samples", "residual / noise"], rows, caption="How each run is fitted.", numeric=(2, 3)
            )
        )
    notes = [str(n) for n in data.get("notes") or ()]
    if notes:
        parts.append(tag("ul", [tag("li", n) for n in notes]))
    parts.append(_made(path, data))
    return section(_anchor(path), heading, parts)


def _table(data: Mapping[str, Any]) -> Markup:
    """Return the first rows and columns of a result."""
    columns, rows = dict(data.get("columns") or {}), list(data.get("rows") or ())
    if not rows:
        return Markup("")
    names = [n for n in columns if any(r.get(n) is not None for r in rows)][:MOST_COLUMNS]
    heads = [n + (f" [{unit_text(u)}]" if (u := columns[n].get("unit")) not in ("", "1", None) else "") for n in names]
    cells = [[_cell(r.get(n)) for n in names] for r in rows[:MOST_ROWS]]
    numeric = tuple(i for i, n in enumerate(names) if all(r.get(n) is None or finite(r.get(n)) for r in rows))
    left = len(rows) - len(cells)
    told = [
        f"{left} more rows" if left > 0 else "",
        f"{len(columns) - len(names)} more columns" if len(columns) > len(names) else "",
    ]
    caption = "; ".join(t for t in told if t)
    return table(heads, cells, numeric=numeric, caption=f"{caption} in the file." if caption else "")


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return number(value, 5) if isinstance(value, float) and finite(value) else str(value)  # counts are whole


def _made(path: Path, data: Mapping[str, Any]) -> Markup:
    """Return the parameters with who set them, and the command that made the result, folded."""
    parts: list[Any] = []
    parameters = dict(data.get("parameters") or {})
    if parameters:
        rows = []
        for name, p in parameters.items():
            unit = unit_text(p.get("unit"))
            rows.append([f"{name} [{unit}]" if unit else name, _cell(p.get("value")), p.get("origin", "")])
        parts.append(table(["parameter", "value", "set by"], rows, numeric=(1,)))
    try:
        sidecar = json.loads(sidecar_path(path).read_text(encoding="utf-8"))
        arguments = sidecar.get("arguments")
        if isinstance(arguments, list):
            parts.append(tag("pre", tag("code", "srf " + " ".join(map(str, arguments)))))
    except (OSError, ValueError):
        pass
    parts.append(tag("p", tag("a", path.name, href=path.name)))
    return tag("details", tag("summary", "How it was made"), parts)
