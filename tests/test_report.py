"""The report of a diagnosis: one page that needs nothing else, whatever the verdict and whatever the names in the recordings."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srfcli.core.errors import SrfError
from srfcli.laws.registry import bundled_registry
from srfcli.laws.values import Effect
from srfcli.results import report_text
from srfcli.results.plots import figure_bytes
from srfcli.results.report import command_lines, merged, write_report
from srfcli.results.report_figures import close_up, foremost, local_rms, run_figure, scan_rows, trace
from srfcli.results.report_text import format_with_error, number, percent, probability, spans
from srfcli.results.tables import VOID, Markup, tag

VERDICTS = ("none", "identified", "ambiguous", "unknown", "inconclusive")
NOISE = 0.02
HOSTILE = '<script>alert("1")</script> & $\\frac{a$ "><img src=x onerror=y>'


class Page(HTMLParser):
    """A page read strictly: every element is closed in its turn."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len(dict(attrs)) == len(attrs), f"<{tag}> has an attribute twice"
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> out of turn"

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def all(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.elements if tag == name]


def made_run(name: str, *, holdout: bool = False, n: int = 900, seed: int = 0, windows: Any = ((1.0, 1.5),)) -> dict[str, Any]:
    """A run whose baseline fails from 1 to 1.5 s by a wave of ten times the noise; the augmented model leaves noise."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 3.0, n)
    true = 10.0 + np.sin(2 * np.pi * t)
    missing = np.where((t > 1.0) & (t < 1.5), 10 * NOISE * np.sin(40 * np.pi * t), 0.0)
    used = np.ones(n, dtype=bool)
    used[100:110] = False
    observed = true + NOISE * rng.normal(size=n)
    observed[100:110] = 1e9  # a placeholder that must not be drawn
    return whole(
        {"name": name, "holdout": holdout, "label": "elongation  [µm]", "load_unit": "N", "t": t, "observed": observed,
         "used": used, "baseline": true - missing, "augmented": true, "V": np.where(t < 2, 5.0, 50.0),
         "W": 7 * (1 + 0.1 * np.sin(30 * t)), "friction": [None, None], "windows": [list(w) for w in windows]}
    )  # fmt: skip


def whole(run: dict[str, Any]) -> dict[str, Any]:
    """A run with the innovations of its models, in units of the noise."""
    white = [(run["observed"] - run[model]) / NOISE for model in ("baseline", "augmented")]
    return run | {"white": white, "rms": [float(np.sqrt(np.mean(z[run["used"]] ** 2))) for z in white]}


def made_answer(verdict: str, name: str = "onset") -> dict[str, Any]:
    effects = {"identified": ["linker-dieterich"], "ambiguous": ["linker-dieterich", "second-state"]}.get(verdict, [])
    answer = {
        "schema": "srf.diagnose/1", "verdict": verdict, "effects": effects, "equivalent": [],
        "not_identifiable": [{"effect": "inertia", "reason": "the mass is <known>"}],
        "confidence": {"linker-dieterich": 0.98, "none": 1e-30, "unknown": 0.01},
        "baseline": {"parameters": {}, "fit": {"rms_over_noise": 3.19}, "holdout": {"rms_over_noise": 4.75}},
        "augmented": {"parameters": {}, "fit": {"rms_over_noise": 0.9912}, "holdout": {"rms_over_noise": 1.02}},
        "location": {"runs": [{"name": name, "share": 0.61, "windows": [[1.0, 1.5]], "p_value": 1e-9}],
                     "forcing_phase": [0.5, 1.5], "frequencies_hz": [120.0], "coordinate": {"name": "dlnW/dt", "r2": 0.7}},
        "model": "augmented/experiment.toml",
    }  # fmt: skip
    if verdict == "ambiguous":
        answer["equivalent"] = [["linker-dieterich", "second-state"]]
    if verdict in ("none", "inconclusive"):
        answer["augmented"] = answer["baseline"]
        answer["location"] = {"runs": [], "forcing_phase": None, "frequencies_hz": [], "coordinate": None}
    return answer


def made_material(verdict: str, name: str = "onset") -> dict[str, Any]:
    runs = [made_run(name, seed=1)]
    if verdict == "identified":
        runs = [made_run("quiet", windows=()), *runs, made_run("later", holdout=True, seed=2, windows=())]
    if verdict in ("none", "inconclusive"):
        runs = [whole(run | {"augmented": run["baseline"]}) for run in runs]
    rows = [{"axis": "v", "run": "", "kind": "mean", "low": 10.0**k, "high": 10.0 ** (k + 1), "statistic": 3.0 * k, "z": 1.0,
             "freedom": 1.0, "log_p": -5.0 * k, "p_value": 10.0 ** (-2 * k)} for k in range(5)]  # fmt: skip
    told = {"identified": ("linker-dieterich",), "ambiguous": ("linker-dieterich", "second-state"), "unknown": ()}.get(
        verdict, ("none",)
    )
    material: dict[str, Any] = {
        "title": "PMMA <on> PMMA", "runs": runs, "residual_scan": rows,
        "ranked": [{"name": n, "evidence": e, "rms_over_noise": r, "confidence": c, "told": n in told}
                   for n, e, r, c in (("linker-dieterich", -10.0, 0.99, 0.98), ("second-state", -11.5, 0.993, 0.01),
                                      ("none", -900.0, 3.19, 0.0))],
        "parameters": [{"name": "B", "unit": "1", "baseline": 0.0259135, "baseline_stderr": 1.1e-4, "augmented": 0.0242,
                        "augmented_stderr": 1.3e-4, "shift_sigma": 10.06},
                       {"name": "alpha", "unit": "1", "baseline": None, "baseline_stderr": None, "augmented": 0.012,
                        "augmented_stderr": 0.0004, "shift_sigma": None}],
        "scores": [{"effect": "linker-dieterich", "gain": 812.0, "size": 0.011, "stderr": 0.0003, "tolerance": 0.12,
                    "detectable": 0.0011}],
    }  # fmt: skip
    if verdict == "unknown":
        t = runs[0]["t"]
        wave = 0.01 * np.sin(t)
        force = {"t": t, "force": wave, "band": [wave - 0.002, wave + 0.002], "v": 5 + 40 * np.sin(t) ** 2, "phi": 0.1 + t,
                 "W": runs[0]["W"]}  # fmt: skip
        material["force"] = {"quiet": force, "form": "0.3*log(v/V0) < 1", "unit": "1"}
    if verdict == "identified":
        V = np.geomspace(1, 100, 30)
        material["diagram"] = {"V": V, "W0_baseline": 7 + np.log(V), "W0_augmented": 8 + np.log(V), "note": "at eps = 0.18"}
    if verdict == "ambiguous":
        material["discriminating"] = ["Step the load from 5 to 9 N."]
        material["alternatives"] = ["linker-dieterich: alpha = 0.012 +- 0.0004", "second-state: B2 = 0.004 +- 0.0002"]
    return material


def report(folder: Path, verdict: str) -> tuple[Path, ...]:
    """Write a report with all its figures, beside an augmented experiment."""
    (folder / "augmented").mkdir(parents=True)
    for name in ("experiment.toml", "friction.toml", "on set.csv"):
        (folder / "augmented" / name).write_text("")
    return write_report(folder, made_answer(verdict), made_material(verdict))


@pytest.fixture(scope="module", params=["identified", "unknown"])
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Such a report of each verdict, written once."""
    folder = tmp_path_factory.mktemp("report") / "out"
    report(folder, request.param)
    return request.param, folder


def read(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_the_page_is_well_formed_and_needs_nothing_else(written: tuple[str, Path]) -> None:
    _, folder = written
    page = read(folder)
    names = [tag for tag, _ in page.elements]
    assert names[:2] == ["html", "head"] and names.count("h1") == 1 and names.count("title") == 1
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(names)
    ids = [a["id"] for _, a in page.elements if "id" in a]
    assert len(ids) == len(set(ids))
    for _, attributes in page.elements:
        assert not [a for a in attributes if a.startswith("on")]
        assert str(attributes.get("srcset", "data:image/svg+xml;base64,")).startswith("data:image/svg+xml;base64,")
        source, link = attributes.get("src"), attributes.get("href")
        assert source is None or source.startswith("data:image/svg+xml;base64,")
        if link is not None and link.startswith("#"):
            assert link[1:] in ids
        elif link is not None:
            assert (folder / link.replace("%20", " ")).is_file()
    style = (folder / "report.html").read_text(encoding="utf-8").partition("<style>")[2].partition("</style>")[0]
    assert style and not re.search(r"url\(|@import|expression\(|//", style)
    assert "default-src 'none'" in str(page.all("meta"))


def test_pictures_are_those_of_the_folder_and_say_what_they_show(written: tuple[str, Path]) -> None:
    verdict, folder = written
    page = read(folder)
    inside = [base64.b64decode(str(a["src"]).partition(",")[2]) for a in page.all("img")]
    files = {p.read_bytes() for p in (folder / "figures").glob("*.svg")}
    assert set(inside) == files and len(inside) == len(files)
    assert all(len(str(a["alt"])) > 20 for a in page.all("img"))
    for content in files:
        root = ET.fromstring(content)
        fetched = [v for e in root.iter() for k, v in e.attrib.items() if k.endswith("href")]
        assert all(v.startswith(("#", "data:")) for v in fetched)
    names = {p.name for p in (folder / "figures").iterdir()}
    assert {p.replace(".svg", ".png") for p in names if p.endswith(".svg")} == {p for p in names if p.endswith(".png")}
    assert {"overview.svg", "residual-scan.svg", "run-onset.svg"} <= names
    assert ({"run-quiet.svg", "run-later.svg"} <= names) == (verdict == "identified")
    assert "parameters.svg" in names
    assert ({"force-quiet.svg", "force-by-state.svg"} <= names) == (verdict == "unknown")
    assert ("diagram.svg" in names) == (verdict == "identified")
    for png in (folder / "figures").glob("*.png"):
        assert png.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("written", ["unknown"], indirect=True)
def test_equal_answers_give_equal_bytes(written: tuple[str, Path], tmp_path: Path) -> None:
    verdict, folder = written
    made = report(tmp_path / "again", verdict)
    assert made[-1] == tmp_path / "again" / "report.html" and len(made) > 7
    assert {p.name for p in made[:-1]} == {p.name for p in (folder / "figures").iterdir()}
    for path in made:
        assert path.read_bytes() == (folder / path.relative_to(tmp_path / "again")).read_bytes(), path.name


SENTENCES: dict[str, list[str]] = {  # in their order: what is wrong, what to do, what is gained
    "none": [
        "Nothing is missing: the model explains the recordings down to the noise.",
        "What to do. Continue with the parameters below;",
        "innovations are 3.19 times the noise in the fitted runs, 4.75 times in the held-out ones.",
    ],
    "identified": [
        "A change of the load changes the age of contacts: alpha = 0.0120(4).",
        'What to do. Add "+linker-dieterich" to the name of the ageing law, with alpha = 0.01200; continue with the augmented',
        "Innovations fall from 3.19 to 0.99 times the noise in the fitted runs, and fall from 4.75 to 1.02 times in runs that",
        "It rests on 2 fitted runs, most on “onset” (61",
    ],
    "ambiguous": [
        "Something is missing, and these recordings cannot tell which of linker-dieterich or second-state it is.",
        "What to do. Make the experiment described below: the candidates predict different records of it.",
    ],
    "unknown": [
        "Something is missing that no registered effect explains.",
        "What to do. Look at the missing force below, against time and against the state, for what it goes with.",
        "With the best that was tried, innovations fall from",
    ],
    "inconclusive": [
        "Nothing has to be added, but this experiment could not have seen most effects of a size that matters.",
        "What to do. Vary the load, or record more or with less noise",
    ],
}


def texts_of(name: str) -> dict[str, dict[str, str]]:
    effect = bundled_registry().get("effect", name)
    assert isinstance(effect, Effect)
    return {name: {"wrong": effect.wrong, "remedy": effect.remedy}}


def test_a_wrong_stiffness_is_told_with_what_was_stated_and_what_to_set(tmp_path: Path) -> None:
    answer, material = made_answer("identified"), made_material("identified")
    answer["effects"] = ["stiffness-error"]
    wanted = {"name": "K", "unit": "1/um", "baseline": None, "augmented": 0.006531, "augmented_stderr": 5e-5}
    material["parameters"] = [*material["parameters"], wanted]
    material |= {"stated": {"stiffness": "0.0050 1/µm"}, "own": {"stiffness-error": ["K"]}, "texts": texts_of("stiffness-error")}
    text = report_text.verdict_sentence(answer, material)
    assert text == "Stated stiffness 0.0050 1/µm; the recordings want 0.00653(5)\u00a01/µm."
    assert report_text.remedy(answer, material).startswith('Set stiffness = "0.006531\u00a01/µm" in [apparatus], and calibrate')


def test_another_ageing_law_is_no_missing_effect() -> None:
    answer = {"verdict": "identified", "effects": ["ruina", "inertia"]}
    material = {"laws": ["ruina"], "stated": {"ageing": "dieterich"}}
    text = report_text.verdict_sentence(answer, material)
    assert text.startswith("The ageing law is ruina, not dieterich. The model lacks inertia")


def test_every_shipped_effect_has_a_remedy() -> None:
    registry = bundled_registry()
    for entry in registry.entries("effect"):
        effect = registry.get("effect", entry.name)
        assert isinstance(effect, Effect) and effect.wrong and effect.remedy, entry.name


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [(0.006534, 5e-5, "0.00653(5)"), (0.5549, 5e-4, "0.5549(5)"), (19.04, 1.23, "19.0(12)"), (-0.012, 4e-4, "−0.0120(4)"),
     (280.0, 33.0, "280(30)"), (1.23e-5, 2e-7, "1.230(20)·10⁻⁵"), (3.0, 0.0, "3.000"), (None, 1.0, "–"),
     (1.23456789e37, 2e10, "1.23457·10³⁷"), (0.0126, 1e-38, "0.0126000")],
)  # fmt: skip
def test_errors_in_brackets(value: float | None, error: float, text: str) -> None:
    assert report_text.bracketed(value, error) == text


@pytest.mark.usefixtures("without_matplotlib")
@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_opens_the_page_in_plain_words(verdict: str, tmp_path: Path) -> None:
    material = made_material(verdict)
    material |= {"about": {"linker-dieterich": "Contacts lose age when the load rises"}, "texts": texts_of("linker-dieterich")}
    write_report(tmp_path, made_answer(verdict), material)
    page = read(tmp_path)
    first = page.text.partition("PMMA <on> PMMA: " + verdict)[2]
    places = [first.find(sentence) for sentence in SENTENCES[verdict]]
    assert -1 not in places and places == sorted(places), places
    assert places[-1] < first.index("innovations / noise") < first.index("What was left out")
    nothing = verdict in ("none", "inconclusive")
    assert ("No place stands out beyond what noise does." in page.text) == nothing
    place = "61 % of the excess misfit is in the run “onset”, most from 1.00 to 1.50 s."
    assert (place in page.text) != nothing
    assert ("shifted B by 10 standard errors" in page.text) != nothing
    assert ("leave the same trace" in page.text) == (verdict == "ambiguous")
    assert ("Step the load from 5 to 9 N." in page.text) == (verdict == "ambiguous")
    assert ("second-state: B2 = 0.004 +- 0.0002" in page.text) == (verdict == "ambiguous")
    assert ("0.3*log(v/V0) < 1" in page.text) == (verdict == "unknown")
    assert "the mass is <known>" in page.text
    assert 'matplotlib, which is not installed: pip install "srfcli[plot]"' in page.text
    assert not (tmp_path / "figures").exists()


@pytest.mark.usefixtures("without_matplotlib")
def test_the_run_with_most_of_the_misfit_comes_first(tmp_path: Path) -> None:
    write_report(tmp_path, made_answer("identified"), made_material("identified"))
    text = read(tmp_path).text.partition("p of noise stands out at")[2]
    assert text.index("onset") < text.index("quiet") < text.index("later")


@pytest.mark.usefixtures("without_matplotlib")
def test_the_confidence_that_is_told_is_that_of_the_model_in_the_table(tmp_path: Path) -> None:
    """Also of an effect in one run alone, whose model has the run in its name, and where a likelier one was refused."""
    material = made_material("identified")
    first = {"name": "viscous-drag", "evidence": -9.0, "rms_over_noise": 0.99, "confidence": 0.29, "told": False}
    material["ranked"][0] |= {"name": "linker-dieterich[onset]", "confidence": 0.56}
    material["ranked"].insert(0, first)
    write_report(tmp_path, made_answer("identified"), material)
    page = read(tmp_path)
    assert "confidence 56 %" in page.text and "the log evidence rises by 890" in page.text
    chosen = page.text.partition("against it")[2]
    assert chosen.index("viscous-drag") < chosen.index("linker-dieterich[onset]")


def test_no_name_breaks_out_of_the_page(tmp_path: Path) -> None:
    answer, material = made_answer("ambiguous", HOSTILE), made_material("ambiguous", HOSTILE)
    material |= {"title": HOSTILE, "discriminating": [HOSTILE], "about": {HOSTILE: HOSTILE}}
    answer |= {"effects": [HOSTILE], "model": HOSTILE, "confidence": {HOSTILE: 1.0}}
    answer["not_identifiable"] = [{"effect": HOSTILE, "reason": HOSTILE}]
    material["ranked"][0]["name"] = material["scores"][0]["effect"] = material["parameters"][0]["name"] = HOSTILE
    row = {"axis": HOSTILE, "run": HOSTILE, "kind": "mean", "log_p": -3.0, "p_value": 0.1}
    material["residual_scan"] += [row | {"low": float(k), "high": k + 1.0} for k in range(4)]
    material["runs"][0]["name"] = answer["location"]["runs"][0]["name"] = "../../" + HOSTILE
    empty = made_run("empty") | {"used": np.zeros(900, dtype=bool)}  # nothing to draw
    material["runs"] += [made_run("../../" + HOSTILE.upper(), n=200, windows=()), empty]  # a name that makes the same file's
    write_report(tmp_path / "out", answer, material)
    page = read(tmp_path / "out")
    names = {tag for tag, _ in page.elements}
    assert "script" not in names
    assert all(str(a["src"]).startswith("data:") and "onerror" not in a for a in page.all("img"))
    assert page.text.count(" ".join(HOSTILE.split())) >= 10
    assert {p.name for p in tmp_path.iterdir()} == {"out"}
    files = [p.name for p in (tmp_path / "out" / "figures").iterdir()]
    assert files and all(re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*\.(svg|png)", n) for n in files)
    second, first = sorted(n.lower() for n in files if n.startswith("run-") and n.endswith(".svg"))
    assert second == first.replace(".svg", "-2.svg")  # each run has its own figure


@pytest.mark.usefixtures("without_matplotlib")
def test_a_page_that_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "report.html").write_text("old")

    def full(self: Path, target: Path) -> Path:
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(SrfError, match="no space"):
        write_report(tmp_path, made_answer("none"), made_material("none"))
    assert (tmp_path / "report.html").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.usefixtures("without_matplotlib")
def test_what_is_absent_is_left_out(tmp_path: Path) -> None:
    answer = {"schema": "srf.diagnose/1", "verdict": "inconclusive", "effects": [], "location": None, "model": None}
    write_report(tmp_path, answer, {"runs": []})
    text = read(tmp_path).text
    assert "No run was held out" in text and "No place stands out" in text
    assert "stability diagram" not in text and "missing force" not in text.lower()


def test_a_long_record_is_drawn_by_extremes() -> None:
    short, long = (len(figure_bytes(run_figure(trace(made_run("long", n=n))), ".svg")) for n in (3_000, 200_000))
    assert long < 1_000_000 and long < 4 * short


def test_a_slower_sampling_rate_is_no_gap() -> None:
    """The first second has a tenth of the samples: it is drawn all the same, and half a second without any is not."""
    run = made_run("two rates", n=3001)
    t = run["t"]
    kept = (np.arange(t.size) % 10 == 0) | (t > 1.0)
    kept &= (t < 2.0) | (t > 2.5)
    thin = whole({k: v[kept] if isinstance(v, np.ndarray) and v.size == t.size else v for k, v in run.items()})
    (line,) = [q for q in run_figure(trace(thin)).axes[0].lines if q.get_label() == "recorded"][:1]
    x, y = (np.asarray(a, float) for a in (line.get_xdata(), line.get_ydata()))
    drawn = x[np.isfinite(y)]
    assert (drawn < 0.9).sum() > 50 and not ((drawn > 2.01) & (drawn < 2.49)).any()
    borders = np.flatnonzero(~np.isfinite(y))
    assert ((x[borders[:-1]] if borders.size > 1 else x[borders]) > 1.5).all()


def test_a_trace_has_only_what_is_compared() -> None:
    one = trace(made_run("a"))
    assert one.t.size == 890 and float(np.abs(one.observed).max()) < 12
    assert not one.same and np.std(one.after) == pytest.approx(1.0, abs=0.1) and np.abs(one.before).max() > 8
    assert trace(made_run("a", windows=((0.2, 0.4), (1.1, 1.4), (2.0, 2.2)))).worst == (1.1, 1.4)
    borders, values = local_rms(one.t, one.before)
    assert borders.size == values.size + 1
    middle = 0.5 * (borders[1:] + borders[:-1])
    inside = (middle > 1.05) & (middle < 1.45)
    assert values[inside].min() > 4 > 2 > values[~inside & ((middle < 0.9) | (middle > 1.6))].max()


def test_a_close_up_shows_where_and_how_fast_it_fails() -> None:
    burst = made_run("a", n=6000)
    seen = close_up(trace(burst))
    assert seen is None or seen.stop - seen.start < 0.6 * 6000
    t = burst["t"]
    spike = whole(burst | {"baseline": burst["augmented"] - 3.0 * np.exp(-(((t - 2.2) / 0.02) ** 2))})
    part = close_up(trace(spike))
    assert part is not None
    shown = trace(spike).t[part]
    assert shown[0] < 2.18 and shown[-1] > 2.22 and shown[-1] - shown[0] < 0.5
    fast = whole(burst | {"baseline": burst["augmented"] - 0.2 * np.sin(2 * np.pi * 120 * t), "windows": [[0.0, 3.0]]})
    part = close_up(trace(fast))
    assert part is not None
    shown = trace(fast).t[part]
    assert 4 / 120 < shown[-1] - shown[0] < 12 / 120
    assert close_up(trace(whole(burst | {"baseline": burst["augmented"]}))) is None  # noise alone
    assert close_up(trace(whole(burst | {"baseline": burst["augmented"] + 0.2}))) is None  # the same everywhere


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.0129, 0.0001, "0.01290 ± 0.00010"),
        (290.379, 0.105, "290.38 ± 0.10"),
        (285.158, 0.2301, "285.16 ± 0.23"),
        (-0.02083, 0.00134, "−0.0208 ± 0.0013"),
        (9.3243e-5, 1.007e-6, "(9.32 ± 0.10)·10⁻⁵"),
        (2.5e7, 3.1e5, "(2.500 ± 0.031)·10⁷"),
        (1234.0, 99.6, "1230 ± 100"),
        (0.5, None, "0.5000"),
        (0.5, 0.0, "0.5000"),
        (None, 1.0, "–"),
        (float("nan"), 1.0, "–"),
    ],
)
def test_values_have_the_digits_that_their_errors_allow(value: Any, error: Any, text: str) -> None:
    assert format_with_error(value, error) == text


def test_numbers_have_sensible_digits() -> None:
    assert [number(x) for x in (0, 0.5, 62100.0, 1.5e-7, -3.0, 999.9, None)] == [
        "0", "0.500", "62100", "1.50·10⁻⁷", "−3.00", "1000", "–"]  # fmt: skip
    assert [probability(p) for p in (0.4, 0.00012, 0.0, None)] == ["0.400", "0.0001", "< 10⁻²⁹⁰", "–"]
    assert [percent(p).replace("\u00a0", " ") for p in (0.0, 1e-9, 0.005, 0.123, 0.999, 1.0)] == [
        "0 %", "< 0.01 %", "0.5 %", "12 %", "99.9 %", "100 %"]  # fmt: skip
    assert spans([(0, 1)] * 6, 2).replace("\u00a0", " ") == "0 to 1.00 s, 0 to 1.00 s and 4 more"


def test_windows_that_adjoin_are_one_in_words() -> None:
    assert merged([(2.0, 3.0), (0.0, 1.0), (1.001, 2.0), (8.0, 9.0)]) == [(0.0, 3.0), (8.0, 9.0)]
    assert merged([]) == []


def test_the_residual_scan_is_read_in_the_order_of_its_p_values() -> None:
    rows = [{"axis": axis, "run": "", "kind": "mean", "low": low, "high": high, "log_p": log_p, "p_value": p}
            for axis, low, high, log_p, p in (("v", 1.0, 2.0, -230.2585, 1e-90), ("v", 2.0, 3.0, -23.0, 1e-3),
                                              ("v", 3.0, 4.0, -1.0, 0.9), ("frequency", 119.5, 120.5, -50.0, 0.5))]  # fmt: skip
    found = scan_rows(rows, "MPa")
    assert [round(s.height, 2) for s in found] == [100.0, 21.71, 9.99, 0.43]
    assert [s.place.replace("\u00a0", " ") for s in found[:2]] == ["1.00 to 2.00 µm/s", "120 Hz"]
    assert [s.sure for s in found] == [True, False, True, False]
    assert [s.axis for s in foremost(found, each=1)] == ["v", "frequency"]
    (edge,) = scan_rows([rows[0] | {"axis": "dlnW/dt", "low": -4.5e-15, "high": 35.8}], "MPa")
    assert edge.place.startswith("0 to 35.8")  # an end that rounding alone keeps from zero
    (load,) = scan_rows([rows[0] | {"axis": "W", "low": 58.0, "high": 72.0}], "MPa")
    assert load.place.replace("\u00a0", " ") == "58.0 to 72.0 MPa"


def test_command_lines_are_quoted_and_take_the_whole_model() -> None:
    lines = command_lines({"model": "my model/experiment.toml"}, "--law 'my model/friction.toml' --K '0.2 N/um'")
    assert lines[0] == "srf check 'my model'"
    assert [x for x in lines if x.startswith("srf linear")] == ["srf linear --law 'my model/friction.toml' --K '0.2 N/um'"]
    assert not any(x.startswith("srf linear") for x in command_lines({"model": "my model/experiment.toml"}, ""))
    assert command_lines({"model": None}, "") == []


def test_text_is_escaped_unless_it_is_markup() -> None:
    assert tag("p", "<b>", Markup("<i>x</i>"), ["&"], title='"') == '<p title="&quot;">&lt;b&gt;<i>x</i>&amp;</p>'
    assert tag("br") == "<br>" and tag("span", class_="n", aria_hidden="true") == '<span class="n" aria-hidden="true"></span>'


@pytest.mark.usefixtures("without_matplotlib")
def test_residuals_that_read_alike_do_not_fall(tmp_path: Path) -> None:
    answer = made_answer("unknown")
    answer["baseline"]["fit"]["rms_over_noise"], answer["augmented"]["fit"]["rms_over_noise"] = 1.004, 1.001
    write_report(tmp_path, answer, made_material("unknown"))
    assert "innovations stay at 1.00 times the noise in the fitted runs" in read(tmp_path).text


def test_a_boundary_is_drawn_once_where_nothing_was_added() -> None:
    from srfcli.results.report_figures import diagram_figure

    same = {"V": [1.0, 10.0, 100.0], "W0_hopf_baseline": [7.0, 8.0, 13.0], "W0_hopf_augmented": [7.0, 8.0, 13.0]}
    for augmented, curves in (([7.0, 8.0, 13.0], 1), ([7.0, 9.0, 13.0], 2)):
        figure = diagram_figure({**same, "W0_hopf_augmented": augmented})
        assert figure is not None and len(figure.axes[0].get_lines()) == curves


# The report as a browser lays it out, at three widths: nothing overflows, overlaps, is missing, too small or too pale.

BROWSER = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
WIDTHS = (420, 800, 1280)
SMALLEST = 8.0  # px of text in a figure

in_browser = pytest.mark.skipif(BROWSER is None, reason="BROWSER ABSENT: no headless Chromium, the report is not laid out")

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


@in_browser
def test_the_report_reads_well_at_three_widths(written: tuple[str, Path]) -> None:
    found = laid_out(written[1])
    assert "error" not in found, found.get("error")
    for width in WIDTHS:
        assert not found[str(width)]["faults"], (width, found[str(width)]["faults"][:10])
        small = [p for p in found[str(width)]["pictures"] if p["text"] < SMALLEST]
        assert found[str(width)]["pictures"] and not small, (width, small)


@in_browser
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
