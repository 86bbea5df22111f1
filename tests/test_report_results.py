"""`srf report`: one page on what was written to a folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import srf
from test_report import BROWSER, WIDTHS, Page, laid_out

pytestmark = pytest.mark.usefixtures("empty_folder")
HOSTILE = '<script>alert("1")</script>'


@pytest.fixture
def results() -> Path:
    folder = Path("results")
    folder.mkdir()
    srf("linear", "--over", "V=1:100:5", "--out", "results/linear.json", "--plot", "results/linear.svg")
    rows = [
        {"parameter": "A", "value": 0.00881, "stderr": 3.4e-4, "unit": "1", "flag": ""},
        {"parameter": "D0", "value": 5.8, "stderr": 0.33, "unit": "um", "flag": f"tied to {HOSTILE}"},
    ]
    columns = {name: {"unit": "", "about": ""} for name in rows[0]}
    fit = {"schema": "srf.fit/1", "title": HOSTILE, "status": "interrupted", "columns": columns, "rows": rows, "notes": ["n"]}
    (folder / "fit.json").write_text(json.dumps(fit), encoding="utf-8")
    (folder / "other.json").write_text("{}", encoding="utf-8")
    return folder


def test_a_folder_of_results_becomes_one_page(results: Path) -> None:
    done = srf("report", "results")
    assert done.stdout.strip() == "results/report.html"
    text = (results / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert "A = 0.0088(3), D0 = 5.8(3) µm. Not finished: interrupted." in page.text
    assert "Critical load under constant load" in page.text and "set by" in page.text
    assert "srf linear --over V=1:100:5" in page.text  # how it was made
    assert len(page.all("img")) == 1 and "<script>" not in text
    srf("report", "results", code=2)
    assert srf("report", "results", "--force", "--title", "May").exit_code == 0


def test_a_fit_of_critical_loads_is_headed_by_the_better_method() -> None:
    rows = [
        {"method": method, "parameter": "D0", "value": value, "stderr": 0.008, "unit": "um", "flag": "ok"}
        for method, value in (("powell", 0.41), ("least-squares", 0.4))
    ]
    methods = [{"method": "powell", "chi2": 30.0, "freedom": 15}, {"method": "least-squares", "chi2": 28.5, "freedom": 15}]
    columns = {name: {"unit": "", "about": ""} for name in rows[0]}
    told = {"schema": "srf.fit-thresholds/2", "title": "loads.csv", "status": "ok", "columns": columns, "rows": rows}
    Path("loads").mkdir()
    Path("loads/fit.json").write_text(json.dumps({**told, "meta": {"methods": methods}, "notes": ["a note"]}), encoding="utf-8")
    srf("report", "loads")
    page = Page(Path("loads/report.html").read_text(encoding="utf-8"))
    assert "D0 = 0.400(8) µm; χ² is 28.5 on 15 degrees of freedom." in page.text
    assert "Fit of critical loads: loads.csv" in page.text and "To be known" not in page.text


def test_it_reads_well_at_three_widths(results: Path) -> None:
    if BROWSER is None:
        pytest.skip("BROWSER ABSENT: no headless Chromium, the page is not laid out")
    srf("report", "results")
    found = laid_out(results.resolve())
    assert "error" not in found
    for width in WIDTHS:
        assert not found[str(width)]["faults"], (width, found[str(width)]["faults"][:10])


def test_a_folder_without_results_says_what_to_do() -> None:
    Path("empty").mkdir()
    assert "srf fit EXPERIMENT --out" in srf("report", "empty", code=2).stderr
    assert "not a folder" in srf("report", "nowhere", code=2).stderr
    Path("empty/answer.json").write_text("{}")
    assert "Its report is empty/report.html" in srf("report", "empty", code=2).stderr
