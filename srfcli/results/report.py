"""Reports: one HTML page of a diagnosis, or on all results in a folder."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import SrfError
from srfcli.core.files import write_atomic
from srfcli.core.version import __version__
from srfcli.results import report_sections as sections
from srfcli.results.plots import figure_bytes
from srfcli.results.provenance import sidecar_path
from srfcli.results.report_figures import (
    Trace,
    atlas_figure,
    diagram_figure,
    force_by_state,
    force_figure,
    overview,
    parameters_figure,
    run_figure,
    trace,
)
from srfcli.results.report_sections import Markup, page, picture, section, table, tag
from srfcli.results.report_text import bracketed, finite, gain_sentence, number, remedy, unit_text, verdict_sentence
from srfcli.results.tables import plain_value

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The report of a diagnosis: one HTML page that needs nothing else, and its figures as SVG and PNG files beside it.

PAGE = "report.html"
FIGURES = "figures"
ARRAYS = ("force", "diagram")  # parts of the material that figures take as they are
VERDICTS = ("none", "identified", "ambiguous", "unknown", "inconclusive")

Drawing = tuple[str, Callable[..., "Figure | None"]]


def write_report(folder: Path, answer: Mapping[str, Any], material: Mapping[str, Any]) -> tuple[Path, ...]:
    """Write report.html and figures/*.svg, *.png into `folder`, each whole or not at all, and return their places.

    `answer` is the object of the format srf.diagnose/1. `material` has
    runs: {name, holdout, t, observed, used, baseline, augmented, noise_level, V, W, windows} with arrays (n,), t in s, V in um/s,
    W in N; optional: observable or label, rms (before, after);
    atlas: {axis, run, statistic, p_value, log_p, and low, high or bin};
    ranked: {name, evidence, rms_over_noise, p_value}; scores: {effect, gain, size, stderr, surviving, detectable, unit};
    parameters: {name, unit, baseline, baseline_stderr, augmented, augmented_stderr, shift_sigma}.
    Optional: title; about {effect: a phrase}; parting, paragraphs on a run that parts what is ambiguous; commands, lines to go
    on with; force {run: {t, force, band, v, phi, W}, "form": text, "unit": text}; diagram {V, W0_baseline, W0_augmented, note}.
    Without matplotlib the page has all but the figures, and says so.
    """
    folder.mkdir(parents=True, exist_ok=True)
    traces = tuple(t for t in map(trace, material.get("runs", ())) if t.t.size > 1)
    tables = _tables(material)
    written: list[Path] = []
    pictures: dict[str, bytes] = {}
    if importlib.util.find_spec("matplotlib") is not None:
        for name, content in _drawn(folder / FIGURES, traces, material, written):
            pictures[name] = content
    matter = sections.Matter(plain_value(answer), tables, traces, pictures, folder)
    write_atomic(folder / PAGE, _page(matter))
    return (*written, folder / PAGE)


def _tables(material: Mapping[str, Any]) -> dict[str, Any]:
    """Return the material as plain data, without the long arrays."""
    found = {k: plain_value(v) for k, v in material.items() if k not in ("runs", *ARRAYS)}
    found["runs"] = [
        {"name": str(r["name"]), "rms": plain_value(r.get("rms")), "holdout": bool(r.get("holdout"))}
        for r in material.get("runs", ())
    ]
    force, diagram = material.get("force") or {}, material.get("diagram") or {}
    found["force"] = {k: force[k] for k in ("form", "unit") if force.get(k)} | ({"runs": True} if force else {})
    found["diagram"] = {"note": diagram.get("note"), "marks": plain_value(diagram.get("marks") or ())}
    return found


def _drawn(
    folder: Path, traces: tuple[Trace, ...], material: Mapping[str, Any], written: list[Path]
) -> Iterator[tuple[str, bytes]]:
    """Draw and write the figures one after the other, and yield each one's name and SVG, and that for small screens."""
    folder.mkdir(exist_ok=True)
    for name, draw in _drawings(traces, material):
        figure = draw()
        if figure is None:
            continue
        content = {suffix: figure_bytes(figure, suffix) for suffix in (".svg", ".png")}
        for suffix, data in content.items():
            place = _free(folder, name, suffix, written)
            write_atomic(place, data)
            written.append(place)
        yield name, content[".svg"]
        small = draw(narrow=True)
        if small is not None:
            yield sections.narrow_name(name), figure_bytes(small, ".svg")


def _free(folder: Path, name: str, suffix: str, written: list[Path]) -> Path:
    """Return a file name made of a figure's: letters, digits, dots and dashes, told apart from those that there are."""
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "figure"
    stem = stem[:80]
    place, k = folder / f"{stem}{suffix}", 2
    taken = {p.name.lower() for p in written}  # some file systems do not tell capitals apart
    while place.name.lower() in taken:
        place, k = folder / f"{stem}-{k}{suffix}", k + 1
    return place


def _drawings(traces: tuple[Trace, ...], material: Mapping[str, Any]) -> Iterator[Drawing]:
    """Yield the name of each figure and what draws it."""
    if traces:
        yield "overview", partial(overview, traces)
    for one in traces:
        yield f"run {one.name}", partial(run_figure, one)
    yield "atlas", partial(atlas_figure, plain_value(material.get("atlas") or ()))
    if not all(one.same for one in traces):
        yield "parameters", partial(parameters_figure, plain_value(material.get("parameters") or ()))
    force = material.get("force") or {}
    unit, runs = (
        str(force.get("unit", "N")),
        {str(k): v for k, v in force.items() if isinstance(v, Mapping) and "t" in v},
    )
    for name, one_force in runs.items():
        yield f"force {name}", partial(force_figure, name, one_force, unit=unit)
    if runs:
        yield "force-by-state", partial(force_by_state, runs, unit=unit)
    if material.get("diagram"):
        yield "diagram", partial(diagram_figure, material["diagram"])


def _page(matter: sections.Matter) -> str:
    sentence = verdict_sentence(matter.answer, matter.tables)
    verdict = str(matter.answer.get("verdict"))
    title = str(matter.tables.get("title") or "Diagnosis")
    parts = [
        sections.places(matter),
        sections.left_out(matter),
        sections.missing_force(matter),
        sections.parameters(matter),
        sections.held_out(matter),
        sections.diagram(matter),
        sections.onward(matter),
    ]
    shown = [p for p in parts if p]
    links = [
        tag("a", Markup(m[2]), href=f"#{m[1]}")
        for p in shown
        if (m := re.match(r'<section id="([a-z-]+)"><h2>(.*?)</h2>', p))
    ]
    head = [
        tag("p", title, class_="of"),
        tag("h1", tag("span", verdict, class_=f"verdict {verdict if verdict in VERDICTS else 'unknown'}"), sentence),
        tag("p", tag("strong", "What to do. "), remedy(matter.answer, matter.tables), class_="lead"),
        tag("p", gain_sentence(matter.answer, matter.tables), class_="lead"),
        sections.first_picture(matter),
        sections.numbers(matter),
    ]
    if not matter.pictures:
        head.append(tag("p", 'The figures need matplotlib, which is not installed: pip install "srfcli[plot]"'))
    foot = tag("p", f"srf {__version__}", class_="of")
    body = [tag("header", head, tag("nav", links)), tag("main", shown), sections.whole_answer(matter), foot]
    return page(f"{title}: {verdict}", *body)


# A page on the results in a folder: fits, maps, comparisons and other tables that were written as JSON, with their figures.

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
