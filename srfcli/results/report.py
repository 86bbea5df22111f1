"""Reports: one HTML page of a diagnosis, or on all results in a folder."""

from __future__ import annotations

import base64
import contextlib
import html
import importlib.util
import json
import logging
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from srfcli.core import __version__
from srfcli.core.errors import SrfError
from srfcli.core.files import unused_name, write_atomic
from srfcli.results import report_figures
from srfcli.results.plots import figure_bytes
from srfcli.results.provenance import sidecar_path
from srfcli.results.report_text import (
    NO_BREAK,
    bracketed,
    definitions,
    finite,
    format_with_error,
    gain_sentence,
    joined,
    number,
    percent,
    probability,
    remedy,
    rms,
    rms_of,
    spans,
    unit_text,
    verdict_sentence,
    with_unit,
)
from srfcli.results.tables import Markup, plain_value, tag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What stands in the report of a diagnosis, section by section, from the answer, its material and finished pictures.

RUNS_SHOWN = 12  # runs whose figures are on the page; all are in the folder
SHIFTED = 3.0  # standard errors from which a parameter is said to be shifted
WIDTH = 0.05  # of a span: windows that are less apart are one in words
SHADED = (
    "Shaded are the times at which the baseline differs from the recording, the darker the more; that its parameters may have "
    "been shifted to follow elsewhere is allowed for, so an innovation may also be large outside."
)
FILES = ("answer.json", "prediction-*.csv", "missing-*.csv", "augmented/**/*", "discriminating/**/*", "figures/*.svg")


@dataclass(frozen=True)
class Matter:
    """All that a section may need: answer as plain data, material, runs, folder; pictures (SVG) by name, wide and narrow."""

    answer: Mapping[str, Any]
    material: Mapping[str, Any] = field(repr=False)
    traces: tuple[report_figures.Trace, ...]
    folder: Path
    pictures: dict[str, tuple[bytes, bytes | None]] = field(default_factory=dict, repr=False)

    def rows(self, name: str) -> Sequence[Mapping[str, Any]]:
        """Return a table of the material, empty where there is none."""
        return self.material.get(name) or ()

    @property
    def load_unit(self) -> str:
        """Return the unit of the runs' loads, N or MPa."""
        return self.traces[0].load_unit if self.traces else "N"

    @property
    def fitted(self) -> list[report_figures.Trace]:
        """Return the fitted runs, those with the largest part of the misfit first."""
        shares = {r["name"]: r.get("share") or 0.0 for r in self.located}
        return sorted((t for t in self.traces if not t.holdout), key=lambda t: -shares.get(t.name, 0.0))

    @property
    def held(self) -> list[report_figures.Trace]:
        """Return the held-out runs."""
        return [t for t in self.traces if t.holdout]

    @property
    def located(self) -> list[Mapping[str, Any]]:
        """Return the runs of the answer's location."""
        return list((self.answer.get("location") or {}).get("runs") or ())

    @property
    def same(self) -> bool:
        """True where nothing was added: one model, drawn once."""
        loads = [t["chi2"] for t in self.rows("thresholds")]
        return all(t.same for t in self.traces) and all(a == b or not (finite(a) or finite(b)) for a, b in loads)

    def sides(self, baseline: Any = "baseline", augmented: Any = "augmented model", *more: Any) -> list[Any]:
        """Return what a table has of both models, or of the baseline alone where they are the same."""
        return [baseline] if self.same else [baseline, augmented, *more]

    def figure(self, name: str, alt: str, caption: Any = "", *, small: bool = False) -> Markup:
        """Return a figure, or nothing where it was not drawn."""
        if name not in self.pictures:
            return Markup("")
        wide, narrow = self.pictures[name]
        return picture(wide, ".svg", alt=alt, caption=caption, small=small, narrow=narrow)


CONFIDENCE_IN = {"unknown": "something not registered", "missed": "a registered cause that was missed, or none"}


def numbers(matter: Matter) -> Markup:
    """Return the few numbers that the verdict rests on."""
    rows = []
    for part, label in (("fit", "fitted runs"), ("holdout", "held-out runs")):
        values = [rms_of(matter.answer, m, part) for m in matter.sides("baseline", "augmented")]
        if any(v is not None for v in values):
            rows.append([label, *map(rms, values)])
    head = "innovations / noise" if matter.traces else "residuals / error"
    parts = [table([head, *matter.sides()], rows, numeric=(1, 2))] if rows else []
    confidence = sorted((matter.answer.get("confidence") or {}).items(), key=lambda kv: -(kv[1] or 0.0))
    shown = [[CONFIDENCE_IN.get(name, name), [percent(p), bar(p)]] for name, p in confidence if finite(p) and p >= 0.005][:5]
    if shown:
        parts.append(table(["confidence in", ""], shown))
    return tag("div", parts, class_="numbers")


def places(matter: Matter) -> Markup:
    """Return where the model differs from the recording, and computed and measured critical loads."""
    if matter.rows("thresholds") and not matter.traces:
        return section("where", "Critical loads, measured and computed", critical_loads(matter))
    caption = "Every run on its own clock; light is noise, dark is what the model does not explain."
    if any(t.windows for t in matter.traces):
        caption += " A black line marks the times that are shaded darkest in the figures of the runs."
    alt = "All runs as strips over time, dark where innovations exceed the noise."
    parts: list[Any] = [
        tag("p", " ".join(_location_sentences(matter))),
        matter.figure("overview", alt, caption),
        _run_table(matter),
    ]
    if any(t.windows for t in matter.fitted):
        parts.append(tag("p", SHADED))
    if matter.fitted:
        parts.append(tag("p", f"“{matter.fitted[0].name}”, the run with the largest part, is drawn at the top of this page."))
    parts += [_run(matter, one) for one in matter.fitted[1:RUNS_SHOWN]]
    if len(matter.fitted) > RUNS_SHOWN:
        parts.append(tag("p", f"The other {len(matter.fitted) - RUNS_SHOWN} runs are drawn in the folder figures."))
    return section("where", "Where the model differs from the recording", parts, critical_loads(matter), residual_scan(matter))


def critical_loads(matter: Matter) -> list[Any]:
    """Return each table's chi2 under both models, and its figure."""
    loads = matter.rows("thresholds")
    if not loads:
        return []
    rows = [
        [one["name"] + (" (held out)" if one["holdout"] else ""), str(len(one["table"])),
         *(number(chi2, 3) for chi2 in matter.sides(*one["chi2"]))]
        for one in loads
    ]  # fmt: skip
    heads = ["critical loads", "number", *matter.sides()]
    caption = "chi2: the sum of squared residuals over their errors; about the number of loads where a model has them."
    alt = "Measured and computed critical loads over velocity."
    below = "Circles: measured, with their errors. Lines: those of the model, thin: of the baseline."
    figures = [matter.figure(f"loads {one['name']}", alt, below) for one in loads]
    return [table(heads, rows, caption=caption, numeric=tuple(range(1, len(heads)))), *figures]


def _run_table(matter: Matter) -> Markup:
    """Return the fitted runs with their innovations and, where any stands out, their parts of the misfit."""
    located, rows = {r["name"]: r for r in matter.located}, []
    heads, caption = ["run", *matter.sides()], "Innovations over noise (rms) of each fitted run"
    last = len(heads)
    if located:
        heads += ["share of the excess", "p of noise", "stands out at"]
        caption += ", its part of what noise does not explain, and where that is"
        last += 2
    for one in matter.fitted:
        place, row = located.get(one.name, {}), [one.name, *map(rms, matter.sides(*one.rms))]
        if located:
            where = spans(merged(place.get("windows") or one.windows)) or "nowhere in particular"
            row += [percent(place.get("share")), probability(place.get("p_value")), where]
        rows.append(row)
    return table(heads, rows, caption=f"{caption}.", numeric=tuple(range(1, last)))


def _location_sentences(matter: Matter) -> list[str]:
    location, found = matter.answer.get("location") or {}, []
    standing = [r for r in matter.located if (r.get("p_value") or 0.0) < report_figures.SIGNIFICANT]
    if not standing:
        return ["No place stands out beyond what noise does."]
    worst = max(standing, key=lambda r: r.get("share") or 0.0)
    if (worst.get("share") or 0.0) > 0:
        darkest = next((one.worst for one in matter.fitted if one.name == worst["name"]), None)
        where = spans(merged(worst.get("windows") or ()), 2)
        tail = f", most from {spans([darkest])}" if darkest else f", from {where}" if where else ""
        found.append(f"{percent(worst['share'])} of the excess misfit is in the run “{worst['name']}”{tail}.")
    coordinate = location.get("coordinate")
    if coordinate and finite(coordinate.get("r2")):
        name = report_figures.axis_text(str(coordinate.get("name")))
        found.append(
            f"It goes with the {name}: a function of it alone explains {percent(coordinate['r2'])} of the misfit's power."
        )
    found += _frequencies(matter, [float(f) for f in location.get("frequencies_hz") or ()])
    phase = location.get("forcing_phase")
    if isinstance(phase, list | tuple) and len(phase) == 2:
        stretch = f"{number(phase[0])} and {number(phase[1])} rad"
        found.append(f"In the forcing's period it is between {stretch}, 0 being the maximum of the load.")
    return found


def _frequencies(matter: Matter, narrow: Sequence[float]) -> list[str]:
    """Return where in frequency the misfit is, the strongest place of the table and the figure first."""
    seen = [
        s for s in report_figures.scan_rows(matter.rows("residual_scan"), matter.load_unit) if s.axis == "frequency" and s.sure
    ]
    if not seen:
        return []
    low, high = seen[0].low, seen[0].high
    others = [f for f in narrow if not low - (high - low) <= f <= high + (high - low)]
    also = f", with narrow lines at {joined([f'{f:.4g}' for f in others])}{NO_BREAK}Hz besides" if others else ""
    return [f"In frequency it is strongest at {seen[0].place}{also}."]


def merged(windows: Sequence[Sequence[float]]) -> list[tuple[float, float]]:
    """Return windows in order of time, those that adjoin or overlap as one."""
    ordered = sorted((float(a), float(b)) for a, b in windows)
    if not ordered:
        return []
    slack = WIDTH * (max(b for _, b in ordered) - ordered[0][0])
    found = [ordered[0]]
    for a, b in ordered[1:]:
        if a <= found[-1][1] + slack:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return found


def _run(matter: Matter, one: report_figures.Trace) -> Markup:
    before, after = one.rms
    fell = f"{rms(before)}" if matter.same else f"{rms(before)} before, {rms(after)} after"
    where = f"; they differ at the shaded times, furthest from {spans([one.worst])}" if one.worst else ""
    alt = f"Run {one.name}: recording, predictions and innovations over time{where}."
    caption = f"{one.name}: innovations over noise (rms) {fell}{where}. Dotted lines: two standard deviations of the noise."
    if one.friction_field is not None:
        caption += " The friction field is that of each model fitted by itself, as the smoother estimates it."
    return matter.figure(f"run {one.name}", alt, caption)


def residual_scan(matter: Matter) -> Markup:
    """Return the residual scan: phases, frequencies and quantities of state that the misfit goes with."""
    found = report_figures.scan_rows(matter.rows("residual_scan"), matter.load_unit)
    if not found:
        return Markup("")
    rows = [
        [report_figures.axis_text(s.axis), s.place, s.run or "all", number(s.height), probability(s.p_value)]
        for s in report_figures.foremost(found)
    ]
    heads = ["looked at by", "place", "run", "−log10 p", "p, adjusted"]
    caption = "What stands out most; the last column allows for all that was looked at."
    figure = matter.figure(
        "residual-scan",
        "How far the misfit stands out in bins of phase, frequency and state.",
        "How improbable each place is under noise alone; grey is what noise may do.",
    )
    return tag("div", tag("h3", "What the misfit goes with"), figure, table(heads, rows, caption=caption, numeric=(3, 4)))


def left_out(matter: Matter) -> Markup:
    """Return the hypotheses, what each effect could explain, and what cannot be known."""
    parts: list[Any] = [hypotheses(matter), scores(matter)]
    unseen = matter.answer.get("not_identifiable") or ()
    if unseen:
        parts.append(tag("h3", "What these recordings cannot tell"))
        parts.append(tag("ul", [tag("li", tag("code", x["effect"]), ": ", x["reason"]) for x in unseen]))
    for names in matter.answer.get("equivalent") or ():
        parts.append(tag("p", f"{joined(list(names))} leave the same trace in these runs: nothing here tells them apart."))
    discriminating = matter.material.get("discriminating")
    if discriminating:
        parts.append(tag("h3", "The experiment that discriminates between them"))
        parts += [commands([p.rstrip()]) if p.startswith("[[runs]]") else tag("p", p) for p in discriminating]
    return section("left-out", "What was left out", parts)


def hypotheses(matter: Matter) -> Markup:
    """Return the table of everything that was fitted in full."""
    ranked = [r for r in matter.rows("ranked") if finite(r.get("evidence"))]
    if not ranked:
        return Markup("")
    top = max(r["evidence"] for r in ranked)
    rows, chosen = [], [k for k, r in enumerate(ranked) if r.get("told")]
    for r in ranked:
        label = "the baseline alone" if r["name"] == "none" else r["name"]
        evidence, field = number(r["evidence"] - top), number(r.get("field") or 0.0, 2)
        sure = percent(r.get("confidence"))
        rows.append([label, evidence, rms(r["rms_over_noise"]), field, sure, r.get("against") or ""])
    caption = (
        "Everything that was fitted in full, best first: log evidence against the best, innovations over noise (rms), the "
        "amplitude of the friction field, and what speaks against it."
    )
    heads = ["hypothesis", "log evidence", "innovations / noise", "friction field", "confidence", "against it"]
    return table(heads, rows, caption=caption, numeric=(1, 2, 3, 4), chosen=chosen)


def scores(matter: Matter) -> Markup:
    """Return what each effect could still explain beyond the baseline's own parameters, and what could have been seen."""
    found = matter.rows("scores")
    if not found:
        return Markup("")
    rows = []
    for s in found:
        size, least = format_with_error(s.get("size"), s.get("stderr")), number(s.get("detectable"), 2)
        rows.append([s["effect"], number(s.get("gain")), size, percent(s.get("tolerance")), least])
    caption = (
        "At first order: the gain in log likelihood expected of each effect, the size it would have from its neutral value, "
        "the share of its signal that the baseline's own parameters cannot absorb (tolerance), and the smallest size that this "
        "experiment could have seen (in um, s and N, or MPa)."
    )
    heads = ["effect", "gain", "expected size", "tolerance", "could be seen from"]
    return tag("div", tag("h3", "What each effect could explain"), table(heads, rows, caption=caption, numeric=(1, 2, 3, 4)))


def parameters(matter: Matter) -> Markup:
    """Return the parameters before and after, and how far they are shifted."""
    found = matter.rows("parameters")
    rows, shifted = [], []
    for p in found:
        unit = unit_text(p.get("unit"))
        before, after = (format_with_error(p.get(k), p.get(f"{k}_stderr")) for k in ("baseline", "augmented"))
        shift = p.get("shift_sigma")
        if finite(shift) and abs(shift) > SHIFTED:
            shifted.append((abs(shift), p["name"]))
        shown = matter.sides(before, after, number(shift, 2))
        rows.append([f"{p['name']}" + (f"  [{unit}]" if unit else ""), *shown])
    heads = ["parameter", *matter.sides("baseline", "augmented model", "shift / standard error")]
    parts: list[Any] = []
    if shifted and not matter.same:
        told = joined([f"{name} by {number(size, 2)}" for size, name in sorted(shifted, reverse=True)])
        parts.append(tag("p", f"To make up for what it lacks, the baseline had shifted {told} standard errors."))
    parts.append(table(heads, rows, numeric=(1, 2, 3)))
    if matter.material.get("alternatives"):
        parts.append(tag("p", "The augmented model of the table is the first of those that do equally well:"))
        parts.append(tag("ul", [tag("li", model) for model in matter.material["alternatives"]]))
    if not matter.same:
        parts.append(matter.figure("parameters", "Shift of each parameter between the two fits, in standard errors.",
                                   "Grey: two standard errors, what noise does.", small=True))  # fmt: skip
    return section("parameters", "Parameters" + ("" if matter.same else ", before and after"), parts)


def held_out(matter: Matter) -> Markup:
    """Return how runs are predicted that no fit has seen."""
    if not matter.held and any(one["holdout"] for one in matter.rows("thresholds")):
        return Markup("")  # tables of critical loads that were held out stand with the others
    if not matter.held:
        text = "No run was held out, so nothing shows that the model predicts what it has not seen; mark one with holdout = true."
        return section("held-out", "Runs that the fit never saw", tag("p", text))
    rows = []
    for one in matter.held:
        before, after = one.rms
        word = "better" if after < 0.99 * before else "worse" if after > 1.01 * before else "alike"
        word = word if min(before, after) < float("inf") else "not at all"
        rows.append([one.name, *matter.sides(rms(before), rms(after), word)])
    heads = ["run", *matter.sides("baseline", "augmented model", "predicted")]
    text = "These were opened only after the model was final."
    shown = [_run(matter, one) for one in matter.held[:RUNS_SHOWN]]
    found = table(heads, rows, caption="Innovations over noise (rms).", numeric=(1, 2))
    return section("held-out", "Runs that the fit never saw", tag("p", text), found, shown)


def missing_force(matter: Matter) -> Markup:
    """Return the missing force against time and state, and its closed form; nothing where it was not estimated."""
    force = matter.material.get("force") or {}
    if not force:
        return Markup("")
    form = force.get("form")
    parts: list[Any] = [tag("p", "Estimated along the recording without assuming its form, under the baseline.")]
    if form:
        parts.append(tag("p", "The best closed form found for it: ", tag("code", str(form))))
    drawn = [name for name in matter.pictures if name.startswith("force ")]
    parts += [matter.figure(name, f"The {name} over time with its band.") for name in drawn]
    parts.append(matter.figure("force-by-state", "The missing force against slip velocity, age and load.",
                               "Samples and their averages: a curve that all runs share is a law."))  # fmt: skip
    return section("force", "The missing force", parts)


def diagram(matter: Matter) -> Markup:
    """Return what the model does to the stability diagram; nothing where that was not computed."""
    found = matter.material.get("diagram") or {}
    note, drawn = found.get("note"), "diagram" in matter.pictures
    if not (note or drawn):
        return Markup("")
    caption = "Critical load against driving velocity" + ("." if matter.same else ", baseline and augmented model.")
    if found.get("marks"):
        caption += " Crosses: the velocities and loads of your runs."
    figure = matter.figure("diagram", caption, caption, small=True) if drawn else ""
    title = "Your runs in the stability diagram" if matter.same else "What it does to the stability diagram"
    return section("diagram", title, tag("p", str(note)) if note else "", figure)


def onward(matter: Matter) -> Markup:
    """Return the files, and the command lines to go on with."""
    files = [p for pattern in FILES for p in sorted(matter.folder.glob(pattern)) if p.is_file()]
    names = [p.relative_to(matter.folder).as_posix() for p in files]
    items = [tag("li", tag("a", name, href=quote(name))) for name in names]
    lines = command_lines(matter.answer, str(matter.material.get("system") or ""))
    parts = [tag("p", "Typed in the folder of this report:"), commands(lines)] if lines else []
    return section("onward", "The model, and how to go on", parts, tag("ul", items) if items else "")


def command_lines(answer: Mapping[str, Any], system: str) -> list[str]:
    """Return commands that take the augmented model; `system` are the options by which commands of stability take it."""
    model = answer.get("model")
    if not model:
        return []
    place = shlex.quote(Path(str(model)).parent.as_posix())
    found = [f"srf check {place}", f"srf fit {place}", f"srf simulate {place}"]
    return found + ([f"srf linear {system}", f"srf continue {system} --eps 0.18 --plot diagram.svg"] if system else [])


# Parts of a page: tables, pictures, sections; the page has its style and its pictures inside.

SMALL_SCREENS = "(max-width: 640px)"  # screens on which tables are read row by row, and figures are drawn narrow
MIME = {".svg": "image/svg+xml", ".png": "image/png"}

# No script, and nothing may be fetched, whatever a title or a name in a recording says.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def table(
    heads: Sequence[str], rows: Sequence[list[Any]], *, caption: str = "", numeric: Sequence[int] = (), chosen: Sequence[int] = ()
) -> Markup:
    """Return a table whose first column names the rows; `numeric` columns are set flush right, `chosen` rows stand out."""
    side = {i: "n" for i in numeric}
    head = tag("thead", tag("tr", [tag("th", c, scope="col", class_=side.get(i)) for i, c in enumerate(heads)]))
    body = []
    for k, row in enumerate(rows):
        cells = [tag("th", row[0], scope="row", class_=side.get(0))]
        cells += [tag("td", cell, class_=side.get(i), data_label=heads[i]) for i, cell in enumerate(row[1:], 1)]
        body.append(tag("tr", cells, class_="chosen" if k in chosen else None))
    parts = [tag("caption", caption)] if caption else []
    return tag("div", tag("table", parts, head, tag("tbody", body)), class_="wide")


def bar(share: float) -> Markup:
    """Return a small bar for a share from 0 to 1; the number itself stands beside it."""
    width = 100.0 * min(max(share, 0.0), 1.0)
    return tag("span", tag("span", style=f"width:{width:.0f}%"), class_="bar", aria_hidden="true")


def picture(
    content: bytes, suffix: str, *, alt: str, caption: Any = "", small: bool = False, narrow: bytes | None = None
) -> Markup:
    """Return a figure with its picture inside the page; `alt` says in words what it shows, `narrow` is for small screens."""

    def source(data: bytes) -> str:
        return f"data:{MIME[suffix]};base64,{base64.b64encode(data).decode('ascii')}"

    shown = tag("img", src=source(content), alt=alt)
    if narrow is not None:
        shown = tag("picture", tag("source", media=SMALL_SCREENS, srcset=source(narrow)), shown)
    parts = [shown] + ([tag("figcaption", caption)] if caption else [])
    return tag("figure", parts, class_="small" if small else None)


def section(anchor: str, title: str, *children: Any) -> Markup:
    """Return a section under a heading that the contents can point to."""
    return tag("section", tag("h2", title), "\n", list(children), id=anchor)


def commands(lines: Sequence[str]) -> Markup:
    """Return command lines as they are typed."""
    return tag("pre", tag("code", "\n".join(lines)))


def page(title: str, *body: Any) -> str:
    """Return the whole document."""
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        Markup(f'<meta http-equiv="Content-Security-Policy" content="{html.escape(POLICY, quote=True)}">'),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", title),
        tag("style", Markup("\n" + Path(__file__).with_name("report.css").read_text(encoding="utf-8"))),
    )
    return f'<!DOCTYPE html>\n<html lang="en">\n{head}\n{tag("body", list(body))}\n</html>\n'


# The report of a diagnosis: one HTML page that needs nothing else, and its figures as SVG and PNG files beside it.

PAGE = "report.html"
FIGURES = "figures"


def write_report(folder: Path, answer: Mapping[str, Any], material: Mapping[str, Any]) -> tuple[Path, ...]:
    """Write report.html and figures/*.svg, *.png into `folder`, each whole or not at all, and return their places.

    `answer` is the object of the format srf.diagnose/1. `material` is that of a `DiagnosisResult`, and where there are any
    discriminating: paragraphs on that run; force {run: {t, force, band (2, n), v, phi, W}, "form": text}; diagram, as
    `diagram_figure` takes it.
    Without matplotlib the page has all but the figures, and says so.
    """
    folder.mkdir(parents=True, exist_ok=True)
    traces = tuple(t for t in map(report_figures.trace, material.get("runs", ())) if t.t.size > 1)
    matter = Matter(plain_value(answer), material, traces, folder)
    written: list[Path] = []
    if importlib.util.find_spec("matplotlib") is not None:
        (folder / FIGURES).mkdir(exist_ok=True)
        for name, draw in _drawings(matter):
            if (figure := draw()) is None:
                continue
            content = {suffix: figure_bytes(figure, suffix) for suffix in (".svg", ".png")}
            stem = (re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "figure")[:80]
            for suffix, data in content.items():
                written.append(folder / FIGURES / unused_name(stem, suffix, [p.name for p in written]))
                write_atomic(written[-1], data)
            small = draw(narrow=True)
            matter.pictures[name] = content[".svg"], None if small is None else figure_bytes(small, ".svg")
    write_atomic(folder / PAGE, _page(matter))
    return (*written, folder / PAGE)


def _drawings(matter: Matter) -> Iterator[tuple[str, Callable[..., Figure | None]]]:
    """Yield the name of each figure and what draws it."""
    if matter.traces:
        yield "overview", partial(report_figures.overview, matter.traces)
    for one in matter.traces:
        yield f"run {one.name}", partial(report_figures.run_figure, one)
    for loads in matter.rows("thresholds"):
        yield f"loads {loads['name']}", partial(report_figures.loads_figure, loads)
    yield "residual-scan", partial(report_figures.scan_figure, matter.rows("residual_scan"), matter.load_unit)
    if not matter.same:
        yield "parameters", partial(report_figures.parameters_figure, matter.rows("parameters"))
    force = matter.material.get("force") or {}
    runs = {str(k): v for k, v in force.items() if isinstance(v, Mapping) and "t" in v}
    for name, one_force in runs.items():
        yield f"force {name}", partial(report_figures.force_figure, name, one_force, matter.load_unit)
    if runs:
        yield "force-by-state", partial(report_figures.force_by_state, runs, matter.load_unit)
    if matter.material.get("diagram"):
        yield "diagram", partial(report_figures.diagram_figure, matter.material["diagram"])


def _page(matter: Matter) -> str:
    sentence = verdict_sentence(matter.answer, matter.material)
    verdict = str(matter.answer.get("verdict"))
    title = str(matter.material.get("title") or "Diagnosis")
    sections = (places, left_out, missing_force, parameters, held_out, diagram, onward)
    shown = [made for made in (one(matter) for one in sections) if made]
    links = [
        tag("a", Markup(m[2]), href=f"#{m[1]}") for p in shown if (m := re.match(r'<section id="([a-z-]+)"><h2>(.*?)</h2>', p))
    ]
    head = [
        tag("p", title, class_="of"),
        tag("h1", tag("span", verdict, class_=f"verdict {verdict}"), sentence),
        tag("p", tag("strong", "What to do. "), remedy(matter.answer, matter.material), class_="lead"),
        tag("p", gain_sentence(matter.answer, matter.material), class_="lead"),
        tag("p", text) if (text := definitions(matter.material)) else "",
        _run(matter, matter.fitted[0]) if matter.fitted else "",
        numbers(matter),
    ]
    if not matter.pictures:
        head.append(tag("p", 'The figures need matplotlib, which is not installed: pip install "srfcli[plot]"'))
    text = json.dumps(matter.answer, indent=2, ensure_ascii=False, allow_nan=False)
    whole = tag("details", tag("summary", "The answer as data"), commands([text]))
    foot = tag("p", f"srf {__version__}", class_="of")
    body = [tag("header", head, tag("nav", links)), tag("main", shown), whole, foot]
    return page(f"{title}: {verdict}", *body)


# A page on the results in a folder: fits, maps, comparisons and other tables that were written as JSON, with their figures.

MOST_ROWS, MOST_COLUMNS = 40, 7  # of a table on the page; the file has all
KIND_TEXTS = {
    "fit": "Fit of recordings",
    "fit-thresholds": "Fit of critical loads",
    "campaign": "Campaign of fits",
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
        except (OSError, ValueError) as error:
            logging.getLogger(__name__).warning("%s is left out: it cannot be read: %s", path, error)
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
    return KIND_TEXTS.get(name, name)


def _headline(data: Mapping[str, Any]) -> str:
    """Return what was found, in a sentence."""
    notes, rows = [str(n) for n in data.get("notes") or ()], list(data.get("rows") or ())
    if _kind(data) in (KIND_TEXTS["fit"], KIND_TEXTS["fit-thresholds"]):
        # the methods are those of critical loads
        best = min((data.get("meta") or {}).get("methods") or [{}], key=lambda m: m.get("chi2", 0.0))
        told = []
        for row in rows:
            if row.get("method") == best.get("method"):
                value = with_unit(bracketed(row.get("value"), row.get("stderr")), row.get("unit"))
                told.append(f"{row['parameter']} = {value}")
        ratio = ((data.get("meta") or {}).get("rms_over_noise") or {}).get("fit")
        tail = f"; innovations are {number(ratio)} times the noise" if finite(ratio) else ""
        if finite(best.get("chi2")):
            tail = f"; χ² is {number(best['chi2'])} on {best.get('freedom')} degrees of freedom"
        if (data.get("meta") or {}).get("against"):
            tail += "; but the model does not explain the recordings"
        return ", ".join(told) + tail + _state(data)
    found = f"{notes[0][:1].upper()}{notes[0][1:]}" if notes else f"{_kind(data)}: {len(rows)} rows"
    return found + _state(data)


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
    flagged = [r for r in data.get("rows") or () if r.get("flag") not in (None, "", "ok")]
    if flagged:
        told = "; ".join(f"{r['parameter']}: {r['flag']}" for r in flagged)
        parts.append(tag("p", f"To be known before the values are used: {told}."))
    runs = (data.get("meta") or {}).get("runs")
    if isinstance(runs, list) and runs and isinstance(runs[0], dict) and "rms_over_noise" in runs[0]:
        rows = [[r["run"], r["role"], r.get("used", r.get("samples")), number(r["rms_over_noise"])] for r in runs]
        heads = ["run", "role", "samples", "innovations / noise"]
        parts.append(table(heads, rows, caption="How each run is fitted.", numeric=(2, 3)))
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
    with contextlib.suppress(OSError, ValueError):
        arguments = json.loads(sidecar_path(path).read_text(encoding="utf-8")).get("arguments")
        if isinstance(arguments, list):
            parts.append(commands(["srf " + " ".join(map(str, arguments))]))
    parts.append(tag("p", tag("a", path.name, href=path.name)))
    return tag("details", tag("summary", "How it was made"), parts)
