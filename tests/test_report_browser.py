"""The report as a browser lays it out, at three widths: nothing overflows, overlaps, is missing, too small or too pale."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from test_report import made_answer, made_material

from srfcli.results.report import write_report

BROWSER = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
WIDTHS = (420, 800, 1280)
SMALLEST = 8.0  # px of text in a figure

pytestmark = pytest.mark.skipif(BROWSER is None, reason="BROWSER ABSENT: no headless Chromium, the report is not laid out")

# The page is measured inside a frame of each width: a frame has no smallest width, and media queries answer to it.
HARNESS = """<!DOCTYPE html><body><script>
const widths = %s, found = {};
function luminance(c) {
  const p = c.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255).map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  return 0.2126 * p[0] + 0.7152 * p[1] + 0.0722 * p[2];
}
function behind(e, view) {
  for (; e; e = e.parentElement) { const b = view.getComputedStyle(e).backgroundColor;
    if (!/rgba\\(.*, 0\\)|transparent/.test(b)) return b; }
  return "rgb(255, 255, 255)";
}
function measure(frame) {
  const doc = frame.contentDocument, view = frame.contentWindow, wide = view.innerWidth, faults = [];
  const name = e => e.tagName + " " + (e.textContent || e.alt || "").trim().slice(0, 40);
  if (doc.documentElement.scrollWidth > wide) faults.push("page wider than the screen: " + doc.documentElement.scrollWidth);
  for (const e of doc.querySelectorAll("h1, h2, h3, p, li, table, caption, th, td, figure, img, figcaption, pre")) {
    const r = e.getBoundingClientRect();
    if (r.width && (r.right > wide + 1 || r.left < -1)) faults.push("beyond the edge: " + name(e));
    if (e.scrollWidth > e.clientWidth + 2 && e.clientWidth && view.getComputedStyle(e).overflowX !== "visible")
      faults.push("cut: " + name(e));
  }
  const blocks = [...doc.querySelectorAll("h1, h2, h3, p, caption, img, figcaption, pre, li, nav a, td, tbody th")].filter(
    e => e.getBoundingClientRect().height && !e.closest("details:not([open])"));
  const boxes = blocks.map(e => e.getBoundingClientRect());
  for (let i = 0; i < blocks.length; i++) for (let j = i + 1; j < blocks.length; j++) {
    if (blocks[i].contains(blocks[j]) || blocks[j].contains(blocks[i])) continue;
    const a = boxes[i], b = boxes[j];
    const x = Math.min(a.right, b.right) - Math.max(a.left, b.left), y = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
    if (x > 2 && y > 2) faults.push("overlap: " + name(blocks[i]) + " and " + name(blocks[j]));
  }
  for (const e of doc.querySelectorAll("h1, h2, h3, p, li, th, td, caption, figcaption, a, span, summary, code")) {
    if (!e.textContent.trim() || !e.getBoundingClientRect().height) continue;
    const [a, b] = [luminance(view.getComputedStyle(e).color), luminance(behind(e, view))].sort((x, y) => y - x);
    if ((a + 0.05) / (b + 0.05) < 4.5) faults.push("pale: " + name(e));
  }
  const pictures = [...doc.querySelectorAll("img")].map(e => {
    if (!e.naturalWidth) faults.push("picture missing: " + e.alt);
    const svg = atob(e.currentSrc.split(",")[1]), box = svg.match(/viewBox="0 0 ([\\d.]+)/);
    const sizes = [...svg.matchAll(/font: ?([\\d.]+)px|font-size: ?([\\d.]+)px/g)].map(m => +(m[1] || m[2]));
    const scales = [...svg.matchAll(/scale\\(([\\d.]+) -/g)].map(m => 100 * m[1]);
    const least = Math.min(...(sizes.length ? sizes : scales));
    return { alt: e.alt, text: least * e.getBoundingClientRect().width / +box[1] };
  });
  return { faults, pictures };
}
window.onerror = (message) => { found.error = String(message); };
let left = widths.length;
for (const width of widths) {
  const frame = document.createElement("iframe");
  frame.style.cssText = `width:${width}px;height:3000px;border:0`;
  frame.onload = () => setTimeout(() => { try { found[width] = measure(frame); } catch (e) { found.error = String(e.stack); }
    if (--left === 0) { const out = document.createElement("pre"); out.id = "found"; out.textContent = JSON.stringify(found);
      document.body.replaceChildren(out); } }, 300);
  frame.srcdoc = PAGE; document.body.appendChild(frame);
}
</script></body>"""


def laid_out(folder: Path) -> dict[str, Any]:
    """Return what the browser finds in the report of `folder` at each width; the page's policy is taken out, for the frame."""
    page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", (folder / "report.html").read_text("utf-8"))
    harness = HARNESS % json.dumps(list(WIDTHS))
    text = json.dumps(page).replace("</", "<\\/")
    (folder / "harness.html").write_text(harness.replace("PAGE;", f"{text};"), encoding="utf-8")
    command = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
               "--virtual-time-budget=20000", f"--user-data-dir={folder / 'profile'}",
               "--dump-dom", (folder / "harness.html").as_uri()]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    match = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.S)
    assert match, done.stdout[-2000:] + done.stderr[-2000:]
    return dict(json.loads(html.unescape(match[1])))


@pytest.mark.parametrize("verdict", ["identified", "unknown"])
def test_the_report_reads_well_at_three_widths(verdict: str, tmp_path: Path) -> None:
    write_report(tmp_path, made_answer(verdict), made_material(verdict))
    found = laid_out(tmp_path)
    assert "error" not in found, found.get("error")
    for width in WIDTHS:
        assert not found[str(width)]["faults"], (width, found[str(width)]["faults"][:10])
        small = [p for p in found[str(width)]["pictures"] if p["text"] < SMALLEST]
        assert found[str(width)]["pictures"] and not small, (width, small)


def test_the_measure_finds_what_is_wrong(tmp_path: Path) -> None:
    """The harness itself: a page with one of each fault is told so."""
    wrong = (
        '<!DOCTYPE html><html><body style="margin:0"><p style="width:3000px">wide</p><p style="color:#ccc">pale</p>'
        '<p style="position:absolute;top:200px">one</p><p style="position:absolute;top:205px">two</p></body></html>'
    )
    (tmp_path / "report.html").write_text(wrong, encoding="utf-8")
    faults = " ".join(laid_out(tmp_path)["420"]["faults"])
    for fault in ("page wider", "beyond the edge: P wide", "pale: P pale", "overlap: P one and P two"):
        assert fault in faults
