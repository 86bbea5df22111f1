"""HTML by small functions: all text is escaped unless it was built here; one page with its style and its pictures inside."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from typing import Any, final

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
