"""The report of a diagnosis: one HTML page that needs nothing else, and its figures as SVG and PNG files beside it."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli import __version__
from srfcli.output import report_sections as sections
from srfcli.output.files import write_atomic
from srfcli.output.plots import figure_bytes
from srfcli.output.report_atlas import atlas_figure
from srfcli.output.report_figures import diagram_figure, force_by_state, force_figure, parameters_figure
from srfcli.output.report_page import Markup, page, tag
from srfcli.output.report_runs import Trace, overview, run_figure, trace
from srfcli.output.report_text import gain_sentence, remedy, verdict_sentence
from srfcli.output.tables import plain_value

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
