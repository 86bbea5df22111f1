"""What stands in the report of a diagnosis, section by section, as HTML."""

from __future__ import annotations

import base64
import html
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final
from urllib.parse import quote

from srfcli.results.report_figures import LEVEL, Trace, axis_text, foremost, rms_over_noise, spots
from srfcli.results.report_text import (
    NO_BREAK,
    finite,
    joined,
    number,
    percent,
    probability,
    rms,
    rms_of,
    spans,
    unit_text,
    with_error,
)

# What stands in the report of a diagnosis, section by section, from the answer, its material and finished pictures.

SHOWN = 12  # runs whose figures are on the page; all are in the folder
BENT = 3.0  # standard errors from which a parameter is said to have been bent
WIDTH = 0.05  # of a span: windows that are less apart are one in words
SHADED = (
    "Shaded are the times at which the baseline parts from the recording, the darker the more; that its parameters may have been "
    "bent to follow elsewhere is allowed for, so a residual may also be large outside."
)
FILES = ("answer.json", "prediction-*.csv", "missing-*.csv", "augmented/**/*", "parting/**/*", "figures/*.svg")


@dataclass(frozen=True)
class Matter:
    """All that a section may need: answer and tables as plain data, the runs, pictures by name (SVG), the folder."""

    answer: Mapping[str, Any]
    tables: Mapping[str, Any]
    traces: tuple[Trace, ...]
    pictures: Mapping[str, bytes] = field(repr=False)
    folder: Path

    @property
    def fitted(self) -> list[Trace]:
        """Return the fitted runs, those with the largest part of the misfit first."""
        shares = {r["name"]: r.get("share") or 0.0 for r in self.located}
        return sorted((t for t in self.traces if not t.holdout), key=lambda t: -shares.get(t.name, 0.0))

    @property
    def held(self) -> list[Trace]:
        """Return the held-out runs."""
        return [t for t in self.traces if t.holdout]

    @property
    def located(self) -> list[Mapping[str, Any]]:
        """Return the runs of the answer's location."""
        return list((self.answer.get("location") or {}).get("runs") or ())

    @property
    def same(self) -> bool:
        """True where nothing was added: one model, drawn once."""
        return all(t.same for t in self.traces)

    def rms(self, one: Trace) -> tuple[float, float]:
        """Return a run's residual over noise, whitened where the material has it so, before and after."""
        given = next((r.get("rms") for r in self.tables["runs"] if r["name"] == one.name), None)
        return (given[0], given[1]) if given else (rms_over_noise(one.before), rms_over_noise(one.after))

    def figure(self, name: str, alt: str, caption: Any = "", *, small: bool = False) -> Markup:
        """Return a figure, or nothing where it was not drawn."""
        if name not in self.pictures:
            return Markup("")
        near = self.pictures.get(narrow_name(name))
        return picture(self.pictures[name], ".svg", alt=alt, caption=caption, small=small, narrow=near)


def narrow_name(name: str) -> str:
    """Return the name of a figure's form for small screens."""
    return f"narrow {name}"


def first_picture(matter: Matter) -> Markup:
    """Return the run that the verdict rests on most, as the page's first picture."""
    return _run(matter, matter.fitted[0]) if matter.fitted else Markup("")


def numbers(matter: Matter) -> Markup:
    """Return the few numbers that the verdict rests on."""
    models = ("baseline",) if matter.same else ("baseline", "augmented")
    rows = []
    for part, label in (("fit", "fitted runs"), ("holdout", "held-out runs")):
        values = [rms_of(matter.answer, m, part) for m in models]
        if any(v is not None for v in values):
            rows.append([label, *(rms(v) for v in values)])
    heads = ["residual / noise", *("baseline" if m == "baseline" else "augmented model" for m in models)]
    parts = [table(heads, rows, numeric=(1, 2))] if rows else []
    confidence = sorted((matter.answer.get("confidence") or {}).items(), key=lambda kv: -(kv[1] or 0.0))
    shown = [[name, [percent(p), bar(p)]] for name, p in confidence if finite(p) and p >= 0.005][:5]
    if shown:
        parts.append(table(["confidence in", ""], shown))
    return tag("div", parts, class_="numbers")


def places(matter: Matter) -> Markup:
    """Return where simulation and recording part."""
    parts: list[Any] = [tag("p", " ".join(_location_sentences(matter)))]
    parts.append(
        matter.figure(
            "overview",
            "All runs as strips over time, dark where the residual exceeds the noise.",
            "Every run on its own clock; light is noise, dark is what the model does not explain."
            + (
                " A black line marks the times that are shaded darkest in the figures of the runs."
                if any(t.windows for t in matter.traces)
                else ""
            ),
        )
    )
    parts.append(_run_table(matter))
    if any(t.windows for t in matter.fitted):
        parts.append(tag("p", SHADED))
    if matter.fitted:
        parts.append(
            tag("p", f"“{matter.fitted[0].name}”, the run with the largest part, is drawn at the top of this page.")
        )
    parts += [_run(matter, one) for one in matter.fitted[1:SHOWN]]
    if len(matter.fitted) > SHOWN:
        parts.append(tag("p", f"The other {len(matter.fitted) - SHOWN} runs are drawn in the folder figures."))
    return section("where", "Where simulation and recording part", parts, atlas(matter))


def _run_table(matter: Matter) -> Markup:
    """Return the fitted runs with their residuals and, where any stands out, their parts of the misfit."""
    located, rows = {r["name"]: r for r in matter.located}, []
    for one in matter.fitted:
        place, both = located.get(one.name, {}), matter.rms(one)
        row = [one.name, rms(both[0])] + ([] if matter.same else [rms(both[1])])
        if located:
            where = spans(merged(place.get("windows") or one.windows)) or "nowhere in particular"
            row += [percent(place.get("share")), probability(place.get("p_value")), where]
        rows.append(row)
    heads = ["run", "baseline"] + ([] if matter.same else ["augmented model"])
    caption = "Residual over noise of each fitted run"
    if located:
        heads += ["share of the excess", "p of noise", "stands out at"]
        caption += ", its part of what noise does not explain, and where that is"
    last = len(heads) - 1 if located else len(heads)
    return table(heads, rows, caption=f"{caption}.", numeric=tuple(range(1, last)))


def _location_sentences(matter: Matter) -> list[str]:
    location, found = matter.answer.get("location") or {}, []
    standing = [r for r in matter.located if (r.get("p_value") or 0.0) < LEVEL]
    if not standing:
        return ["No place stands out beyond what noise does."]
    worst = max(standing, key=lambda r: r.get("share") or 0.0)
    if (worst.get("share") or 0.0) > 0:
        where = spans(merged(worst.get("windows") or ()), 2)
        tail = f", from {where}" if where else ""
        found.append(f"{percent(worst['share'])} of the excess misfit is in the run “{worst['name']}”{tail}.")
    coordinate = location.get("coordinate")
    if coordinate and finite(coordinate.get("r2")):
        name = axis_text(str(coordinate.get("name")))
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
    seen = [s for s in spots(matter.tables.get("atlas") or ()) if s.axis == "frequency" and s.sure]
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


def _run(matter: Matter, one: Trace) -> Markup:
    before, after = matter.rms(one)
    fell = f"{rms(before)}" if matter.same else f"{rms(before)} before, {rms(after)} after"
    where = f"; they part at the shaded times, furthest from {spans([one.worst])}" if one.worst else ""
    alt = f"Run {one.name}: recording, simulations and residuals over time{where}."
    caption = f"{one.name}: residual over noise {fell}{where}. Dotted lines: two standard deviations of the noise."
    if one.unexplained is not None:
        caption += " Random friction is what each model, left to itself, takes for the track's."
    return matter.figure(f"run {one.name}", alt, caption)


def atlas(matter: Matter) -> Markup:
    """Return with which phase, frequency and quantity of state the misfit goes."""
    found = spots(matter.tables.get("atlas") or ())
    if not found:
        return Markup("")
    rows = [
        [axis_text(s.axis), s.place, s.run or "all", number(s.height), probability(s.p_value)] for s in foremost(found)
    ]
    known = any(finite(r.get("log_p")) for r in matter.tables["atlas"])
    heads = ["looked at by", "place", "run", "−log10 p" if known else "|statistic|", "p, adjusted"]
    caption = "What stands out most; the last column allows for all that was looked at."
    figure = matter.figure(
        "atlas",
        "How far the misfit stands out in bins of phase, frequency and state.",
        "How improbable each place is under noise alone; grey is what noise may do.",
    )
    return tag(
        "div", tag("h3", "What the misfit goes with"), figure, table(heads, rows, caption=caption, numeric=(3, 4))
    )


def left_out(matter: Matter) -> Markup:
    """Return the hypotheses, what each effect could explain, and what cannot be known."""
    parts: list[Any] = [hypotheses(matter), scores(matter)]
    unseen = matter.answer.get("not_identifiable") or ()
    if unseen:
        parts.append(tag("h3", "What these recordings cannot tell"))
        parts.append(tag("ul", [tag("li", tag("code", x["effect"]), ": ", x["reason"]) for x in unseen]))
    for names in matter.answer.get("equivalent") or ():
        parts.append(
            tag("p", f"{joined(list(names))} leave the same trace in these runs: nothing here tells them apart.")
        )
    parting = matter.tables.get("parting")
    if parting:
        parts.append(tag("h3", "The experiment that would part them"))
        told = [parting] if isinstance(parting, str) else [str(p) for p in parting]
        parts += [commands([p.rstrip()]) if p.startswith("[[runs]]") else tag("p", p) for p in told]
    return section("left-out", "What was left out", parts)


def hypotheses(matter: Matter) -> Markup:
    """Return the table of everything that was fitted in full."""
    ranked = [r for r in matter.tables.get("ranked") or () if finite(r.get("evidence"))]
    if not ranked:
        return Markup("")
    top, verdict = max(r["evidence"] for r in ranked), matter.answer.get("verdict")
    told = set(matter.answer.get("effects") or ())
    confidence = matter.answer.get("confidence") or {}
    rows, chosen = [], []
    for k, r in enumerate(ranked):
        names = set(str(r["name"]).split("+"))
        if (verdict == "identified" and k == 0) or (verdict == "ambiguous" and names <= told):
            chosen.append(k)
        if verdict in ("none", "inconclusive") and r["name"] == "none":
            chosen.append(k)
        label = "the baseline alone" if r["name"] == "none" else r["name"]
        sure = confidence.get("+".join(sorted(names)), r.get("confidence"))
        rows.append(
            [label, number(r["evidence"] - top), rms(r["rms_over_noise"]), number(r.get("field") or 0.0, 2), percent(sure),
             r.get("against") or ""]
        )
    caption = (
        "Everything that was fitted in full, best first: log evidence against the best, innovations over noise, the amplitude of "
        "the random friction that it needs besides, and what speaks against it."
    )
    heads = ["hypothesis", "log evidence", "innovations / noise", "random friction", "confidence", "against it"]
    return table(heads, rows, caption=caption, numeric=(1, 2, 3, 4), chosen=chosen)


def scores(matter: Matter) -> Markup:
    """Return what each effect could still explain beyond the baseline's own parameters, and what could have been seen."""
    found = matter.tables.get("scores") or ()
    if not found:
        return Markup("")
    rows = []
    for s in found:
        unit = unit_text(s.get("unit"))
        tail = f" {unit}" if unit else ""
        size, least = with_error(s.get("size"), s.get("stderr")), number(s.get("detectable"), 2)
        rows.append([s["effect"], number(s.get("gain")), size + tail, percent(s.get("surviving")), least + tail])
    caption = (
        "At first order: the gain in log likelihood that each effect promises, the size it would have from its neutral value, "
        "the share of its signal that the baseline's own parameters cannot absorb, and the smallest size that this experiment "
        "could have seen (in um, s and N, or MPa)."
    )
    heads = ["effect", "gain", "expected size", "survives", "could be seen from"]
    return tag(
        "div", tag("h3", "What each effect could explain"), table(heads, rows, caption=caption, numeric=(1, 2, 3, 4))
    )


def parameters(matter: Matter) -> Markup:
    """Return the parameters before and after, and how far they had been bent."""
    found = matter.tables.get("parameters") or ()
    rows, bent = [], []
    for p in found:
        unit = unit_text(p.get("unit"))
        before, after = (with_error(p.get(k), p.get(f"{k}_stderr")) for k in ("baseline", "augmented"))
        shift = p.get("shift_sigma")
        if finite(shift) and abs(shift) > BENT:
            bent.append((abs(shift), p["name"]))
        shown = [before] if matter.same else [before, after, number(shift, 2)]
        rows.append([f"{p['name']}" + (f"  [{unit}]" if unit else ""), *shown])
    heads = ["parameter", "baseline"] + ([] if matter.same else ["augmented model", "shift / standard error"])
    parts: list[Any] = []
    if bent and not matter.same:
        told = joined([f"{name} by {number(size, 2)}" for size, name in sorted(bent, reverse=True)])
        parts.append(tag("p", f"To make up for what it lacks, the baseline had bent {told} standard errors."))
    parts.append(table(heads, rows, numeric=(1, 2, 3)))
    if not matter.same:
        parts.append(matter.figure("parameters", "Shift of each parameter between the two fits, in standard errors.",
                                   "Grey: two standard errors, what noise does.", small=True))  # fmt: skip
    return section("parameters", "Parameters" + ("" if matter.same else ", before and after"), parts)


def held_out(matter: Matter) -> Markup:
    """Return how runs are predicted that no fit has seen."""
    if not matter.held:
        text = "No run was held out, so nothing shows that the model predicts what it has not seen; mark one with holdout = true."
        return section("held-out", "Runs that the fit never saw", tag("p", text))
    rows = []
    for one in matter.held:
        before, after = matter.rms(one)
        word = "better" if after < 0.99 * before else "worse" if after > 1.01 * before else "alike"
        rows.append([one.name, rms(before)] + ([] if matter.same else [rms(after), word]))
    heads = ["run", "baseline"] + ([] if matter.same else ["augmented model", "predicted"])
    text = "These were opened only after the model was final."
    shown = [_run(matter, one) for one in matter.held[:SHOWN]]
    caption = "Residual over noise."
    return section(
        "held-out",
        "Runs that the fit never saw",
        tag("p", text),
        table(heads, rows, caption=caption, numeric=(1, 2)),
        shown,
    )


def missing_force(matter: Matter) -> Markup:
    """Return the force that is missing, against time and state, and its closed form; nothing where it was not estimated."""
    force = matter.tables.get("force") or {}
    if not force:
        return Markup("")
    form = force.get("form")
    parts: list[Any] = [tag("p", "Estimated along the recording without assuming its form.")]
    if form:
        parts.append(tag("p", "The best closed form found for it: ", tag("code", str(form))))
    parts += [
        matter.figure(name, f"The {name} over time with its band.")
        for name in matter.pictures
        if name.startswith("force ")  # those for small screens begin otherwise
    ]
    parts.append(matter.figure("force-by-state", "The missing force against slip velocity, age and load.",
                               "Samples and their averages: a curve that all runs share is a law."))  # fmt: skip
    return section("force", "The missing force", parts)


def diagram(matter: Matter) -> Markup:
    """Return what the model does to the stability diagram; nothing where that was not computed."""
    note, drawn = (matter.tables.get("diagram") or {}).get("note"), "diagram" in matter.pictures
    if not (note or drawn):
        return Markup("")
    caption = "Critical load against driving velocity, baseline and augmented model."
    marks = (matter.tables.get("diagram") or {}).get("marks") or ()
    if marks:
        caption += " Crosses: the velocities and loads of your runs."
    figure = matter.figure("diagram", caption, caption, small=True) if drawn else ""
    return section("diagram", "What it does to the stability diagram", tag("p", str(note)) if note else "", figure)


def onward(matter: Matter) -> Markup:
    """Return the files, and the command lines to go on with."""
    files = [p for pattern in FILES for p in sorted(matter.folder.glob(pattern)) if p.is_file()]
    names = [p.relative_to(matter.folder).as_posix() for p in files]
    items = [tag("li", tag("a", name, href=quote(name))) for name in names]
    lines = matter.tables.get("commands") or command_lines(matter.answer, names)
    parts = [tag("p", "Typed in the folder of this report:"), commands(lines)] if lines else []
    return section("onward", "The model, and how to go on", parts, tag("ul", items) if items else "")


def command_lines(answer: Mapping[str, Any], files: Sequence[str]) -> list[str]:
    """Return commands that take the augmented model, which is complete: its experiment and, where there are any, its laws."""
    model = answer.get("model")
    if not model:
        return []
    folder = Path(str(model)).parent
    place = shlex.quote(folder.as_posix())
    found = [f"srf check {place}", f"srf fit {place}", f"srf simulate {place}"]
    options = [("--law", "friction.toml"), ("--ageing", "ageing.toml"), ("--interface", "interface.toml")]
    laws = [f"{o} {shlex.quote((folder / f).as_posix())}" for o, f in options if (folder / f).as_posix() in files]
    if laws:
        found += [f"srf linear {' '.join(laws)}", f"srf continue {' '.join(laws)} --eps 0.18 --plot diagram.svg"]
    return found


def whole_answer(matter: Matter) -> Markup:
    """Return the answer as it stands in answer.json, folded."""
    text = json.dumps(matter.answer, indent=2, ensure_ascii=False, allow_nan=False)
    return tag("details", tag("summary", "The answer as data"), tag("pre", tag("code", text)))


# HTML by small functions: all text is escaped unless it was built here; one page with its style and its pictures inside.

VOID = frozenset({"br", "hr", "img", "meta", "source"})
SMALL = "(max-width: 640px)"  # screens on which tables are read row by row, and figures are drawn narrow
MIME = {".svg": "image/svg+xml", ".png": "image/png"}

# No script, and nothing may be fetched, whatever a title or a name in a recording says.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

CSS = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { font: 16px/1.55 "DejaVu Sans", "Segoe UI", Helvetica, Arial, sans-serif; color: #1c1c1c; background: #fff;
  max-width: 68rem; margin: 0 auto; padding: 2rem 1.5rem 4rem; }
h1 { font-size: 1.3rem; line-height: 1.45; font-weight: 600; margin: 0.6rem 0 1.2rem; max-width: 52rem; }
h2 { font-size: 1.2rem; margin: 2.8rem 0 0.6rem; padding-top: 0.9rem; border-top: 1px solid #d8d8d8; }
h3 { font-size: 1rem; margin: 1.8rem 0 0.4rem; }
p, ul, ol { max-width: 48rem; margin: 0.5rem 0; }
.of { color: #555; margin: 0; }
.verdict { display: inline-block; border: 2px solid currentColor; border-radius: 4px; padding: 0 0.55rem;
  font-weight: 600; font-size: 0.9rem; letter-spacing: 0.03em; margin-right: 0.6rem; }
.none { color: #00664b; } .identified { color: #00548a; } .ambiguous { color: #8a5a00; }
.unknown { color: #a34700; } .inconclusive { color: #555; }
nav { font-size: 0.9rem; margin: 1.2rem 0 0; } nav a { margin-right: 0.8rem; display: inline-block; }
a { color: #00548a; }
table { border-collapse: collapse; margin: 0.7rem 0 1.1rem; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: #555; padding-bottom: 0.35rem; max-width: 48rem; }
th, td { padding: 0.22rem 0.9rem 0.22rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid #e6e6e6; }
thead th { border-bottom: 1.5px solid #777; font-weight: 600; vertical-align: bottom; }
tbody th { font-weight: 400; }
.n { text-align: right; white-space: nowrap; } td.n:last-child, th.n:last-child { padding-right: 0; }
tr.chosen th, tr.chosen td { background: #eaf2f9; font-weight: 600; }
.bar { display: inline-block; width: 6rem; height: 0.62rem; background: #eee; margin-left: 0.6rem; vertical-align: baseline; }
.bar span { display: block; height: 100%; background: #0072b2; }
figure { margin: 0.8rem 0 1.6rem; break-inside: avoid; }
figure img { width: 100%; height: auto; display: block; }
figure.small img { width: 72%; }
figcaption { color: #555; font-size: 0.88rem; max-width: 48rem; margin-top: 0.3rem; }
pre { background: #f5f5f3; padding: 0.7rem 0.9rem; overflow-x: auto; font-size: 0.86rem; line-height: 1.5; max-width: 100%; }
code { font-family: "DejaVu Sans Mono", Menlo, Consolas, monospace; font-size: 0.92em; }
pre code { font-size: 1em; }
details summary { cursor: pointer; color: #00548a; }
thead th, thead th.n { white-space: normal; overflow-wrap: anywhere; }
.wide { overflow-x: auto; } .numbers { display: flex; flex-wrap: wrap; gap: 0 4rem; align-items: flex-start; }
.lead { max-width: 52rem; }
@media screen and (max-width: 640px) {
  body { padding: 1rem 0.8rem 3rem; } h1 { font-size: 1.15rem; } figure.small img { width: 100%; }
  table, tbody, tr, th, td, caption { display: block; } thead { display: none; }
  tbody tr { padding: 0.5rem 0; border-bottom: 1px solid #bbb; } th, td { border: 0; padding: 0.1rem 0; }
  tbody th { font-weight: 600; overflow-wrap: anywhere; }
  td { display: grid; grid-template-columns: 45% 1fr; gap: 0.6rem; overflow-wrap: anywhere; text-align: left; }
  td::before { content: attr(data-label); color: #555; } td[data-label=""] { display: block; }
  .n { text-align: left; white-space: normal; } .wide { overflow-x: visible; }
  pre { white-space: pre-wrap; overflow-wrap: anywhere; } code, li, p { overflow-wrap: anywhere; }
  .numbers { gap: 0; flex-direction: column; } .numbers > div { width: 100%; }
}
@media print {
  body { font-size: 10pt; max-width: none; padding: 0; } nav, details { display: none; }
  h2, h3 { break-after: avoid; } tr, figure { break-inside: avoid; } a { color: inherit; text-decoration: none; }
  pre { white-space: pre-wrap; overflow-wrap: anywhere; } .wide { overflow: visible; } table { font-size: 8.5pt; }
  th, td { padding-right: 0.5rem; overflow-wrap: anywhere; } .n { white-space: normal; }
}
"""


@final
class Markup(str):
    """Text that is HTML already; any other text is escaped where it is put in."""

    __slots__ = ()


def text(value: Any) -> Markup:
    """Return `value` as HTML: markup as it is, a list as its parts one after the other, all else escaped."""
    if isinstance(value, Markup):
        return value
    if isinstance(value, list | tuple):
        return Markup("".join(text(v) for v in value))
    return Markup(html.escape(str(value), quote=True))


def tag(name: str, /, *children: Any, **attributes: Any) -> Markup:
    """Return an element; `class_` stands for class, an attribute that is None is left out."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value), quote=True)}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in VOID:
        return Markup(f"<{name}{written}>")
    return Markup(f"<{name}{written}>{text(list(children))}</{name}>")


def table(
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    *,
    caption: str = "",
    numeric: Sequence[int] = (),
    chosen: Sequence[int] = (),
) -> Markup:
    """Return a table whose first column names the rows; `numeric` columns are set flush right, `chosen` rows stand out."""
    side = {i: "n" for i in numeric}
    head = tag("thead", tag("tr", [tag("th", c, scope="col", class_=side.get(i)) for i, c in enumerate(columns)]))
    body = []
    for k, row in enumerate(rows):
        cells = [tag("th", row[0], scope="row", class_=side.get(0))]
        cells += [tag("td", cell, class_=side.get(i), data_label=columns[i]) for i, cell in enumerate(row[1:], 1)]
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
        shown = tag("picture", tag("source", media=SMALL, srcset=source(narrow)), shown)
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
        tag("style", Markup(CSS)),
    )
    return f'<!DOCTYPE html>\n<html lang="en">\n{head}\n{tag("body", list(body))}\n</html>\n'
