"""Tables, records, files, figures and sidecars: full precision, no NaN, whole files, equal bytes."""

from __future__ import annotations

import csv
import io
import json
import os
import stat
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srfcli.core.errors import SrfError, Status
from srfcli.core.files import check_target, write_atomic
from srfcli.laws.values import Law
from srfcli.results import plots
from srfcli.results.provenance import Provenance, sidecar
from srfcli.results.tables import Column, Table, print_terminal, to_csv, to_json, to_text

COLUMNS = (Column("V", "um/s", "driving velocity", ".4g"), Column("W0", "N"), Column("type"), Column("status"))
ROWS = [
    (0.1 + 0.2, np.float64(9.123456789012344), "ns", Status.OK),
    (np.int64(7), float("nan"), None, Status.NO_CONVERGENCE),
    (1e300, np.inf, "a, [b]", Status.OK),
]
TABLE = Table("srf.test/1", COLUMNS, ROWS, title="a title", notes=("one", "two"), parameters={"K": {"value": np.nan}})


def test_csv_has_bare_names_and_full_precision() -> None:
    rows = list(csv.reader(io.StringIO(to_csv(TABLE))))
    assert rows[0] == ["V", "W0", "type", "status"]
    assert rows[1] == ["0.30000000000000004", "9.123456789012344", "ns", "ok"]
    assert rows[2] == ["7", "", "", "no-convergence"]
    assert rows[3] == ["1e+300", "", "a, [b]", "ok"]


def test_json_has_no_nan_and_is_an_envelope() -> None:
    def refuse(word: str) -> None:
        raise AssertionError(word)

    data = json.loads(to_json(TABLE), parse_constant=refuse)
    assert list(data)[:4] == ["schema", "version", "title", "status"]
    assert data["rows"][0] == {"V": 0.1 + 0.2, "W0": 9.123456789012344, "type": "ns", "status": "ok"}
    assert data["rows"][1]["W0"] is None and data["rows"][2]["W0"] is None
    assert data["columns"]["V"] == {"unit": "um/s", "about": "driving velocity"}
    assert data["parameters"] == {"K": {"value": None}} and data["notes"] == ["one", "two"]
    assert json.loads(to_json(Table("s", COLUMNS, [])))["rows"] == []
    assert to_json(TABLE) == to_json(TABLE)


def test_json_of_arrays_and_complex_meta() -> None:
    meta = {"a": np.array([1.0, np.nan]), "b": np.bool_(True), "c": 1 + 2j, "p": Path("x"), "s": {"b", "a"}}
    data = json.loads(to_json(Table("s", (), [], meta=meta)))
    assert data["meta"] == {"a": [1.0, None], "b": True, "c": {"re": 1.0, "im": 2.0}, "p": "x", "s": ["a", "b"]}


def test_plain_text_is_never_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    wide = Table("s", (Column("x"), Column("long")), [(1 / 3, "w" * 300)])
    assert "w" * 300 in to_text(wide) and " 0.333333333333 " in f" {to_text(wide).splitlines()[1]}"
    lines = to_text(TABLE).splitlines()
    assert lines[0] == "a title" and lines[1].split() == ["V", "[um/s]", "W0", "[N]", "type", "status"]
    assert "inf" in lines[4] and lines[-1] == "Note: two"


@pytest.mark.parametrize(("columns", "drawn"), [("120", True), ("20", False)])
def test_a_terminal_gets_rich_only_where_it_fits(monkeypatch: pytest.MonkeyPatch, columns: str, drawn: bool) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setenv("TERM", "xterm")
    stream = io.StringIO()
    print_terminal(TABLE, stream)
    assert ("─" in stream.getvalue()) == drawn
    assert "a, [b]" in stream.getvalue() and "no-convergence" in stream.getvalue() and "…" not in stream.getvalue()


def test_a_number_that_ran_away_is_short_in_text_and_whole_in_files() -> None:
    value = 1.23456789012345678e37
    table = Table("x/1", (Column("rms", "", "r", ".4f"), Column("effective", "", "e", ".0f")), [(value, -value), (0.9987, 412.0)])
    assert to_text(table, full=False).split() == ["rms", "effective", "1.23457e+37", "-1.23457e+37", "0.9987", "412"]
    assert repr(value) in to_csv(table) and repr(value) in to_json(table)


def test_a_row_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match="a row of 1 cells under 4 columns"):
        Table("s", COLUMNS, [(1,)])


def test_an_atomic_write_leaves_the_old_file_on_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = tmp_path / "x.csv"
    write_atomic(place, "old")
    monkeypatch.setattr(os, "fsync", lambda _fd: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_atomic(place, "new")
    assert place.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["x.csv"]


def test_a_reader_never_sees_half_a_file(tmp_path: Path) -> None:
    place, seen, done = tmp_path / "x", set(), threading.Event()
    texts = {letter * 200_000 for letter in "ab"}
    write_atomic(place, "a" * 200_000)

    def read() -> None:
        while not done.is_set():
            seen.add(place.read_text())

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(10):
        for text in texts:
            write_atomic(place, text)
    done.set()
    reader.join()
    assert seen <= texts


def test_modes_links_and_devices(tmp_path: Path) -> None:
    place, link = tmp_path / "x", tmp_path / "link"
    mask = os.umask(0o027)
    try:
        write_atomic(place, "1")
    finally:
        os.umask(mask)
    assert stat.S_IMODE(place.stat().st_mode) == 0o640
    link.symlink_to(place)
    write_atomic(link, "2")
    assert link.is_symlink() and place.read_text() == "2" and stat.S_IMODE(place.stat().st_mode) == 0o640
    write_atomic(Path(os.devnull), "3")
    check_target(Path(os.devnull), force=False)
    assert stat.S_ISCHR(Path(os.devnull).stat().st_mode)


def test_targets_are_refused_with_a_way_out(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("")
    for path, said in ((tmp_path / "x", "exists already"), (tmp_path, "is a directory"), (tmp_path / "n" / "x", "mkdir -p")):
        with pytest.raises(SrfError) as caught:
            check_target(path, force=False)
        assert said in f"{caught.value.message} {caught.value.hint}"
    check_target(tmp_path / "x", force=True)


def test_a_sidecar_is_stable_but_for_its_timings(tmp_path: Path) -> None:
    source, place = tmp_path / "law.toml", tmp_path / "x.csv"
    source.write_text("mu = 'mu0'")
    kept: dict[str, Any] = {"arguments": ("linear",), "laws": (Law("l", source=str(source)),), "inputs": (source,), "seed": 3}
    first, second = (Provenance(**kept, timings={"solve": t}) for t in (0.1, 0.2))
    texts = [sidecar(place, b"abc", p) for p in (first, second)]
    assert texts[0] != texts[1]
    assert texts[0].split('"timings"')[0] == texts[1].split('"timings"')[0]
    data = json.loads(texts[1])
    assert list(data)[-1] == "timings" and data["seed"] == 3 and data["arguments"] == ["linear"]
    assert data["laws"][0]["sha256"] == data["inputs"][str(source)] is not None
    assert data["sha256"].startswith("ba7816bf") and {"srf", "python", "numpy"} <= set(data["versions"])


V = np.geomspace(1, 100, 30)
HOPF = {"V": V, "K_over_W0": [None, *(0.06 * V[1:] ** -0.25)]}
BRANCHES = [{"eps": e, "V": V, "K_over_W0": 0.05 * V**-0.25 * (1 - e), "component": 1} for e in (0.09, 0.18)]


@pytest.mark.parametrize("suffix", [".svg", ".pdf", ".png"])
def test_equal_figures_have_equal_bytes(suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    first = plots.figure_bytes(plots.stability_diagram(BRANCHES, hopf=HOPF, title="t"), suffix)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    second = plots.figure_bytes(plots.stability_diagram(BRANCHES, hopf=HOPF, title="t"), suffix)
    assert first == second


def test_the_users_matplotlibrc_does_not_leak_in_or_out() -> None:
    matplotlib = pytest.importorskip("matplotlib")
    with matplotlib.rc_context({"lines.linewidth": 9.0}):
        figure = plots.lines(V, [V], ["v"], "x", "y", True)
        assert figure.axes[0].lines[0].get_linewidth() == plots.STYLE["lines.linewidth"]
        assert matplotlib.rcParams["lines.linewidth"] == 9.0


def shaded(figure: Any, x: float, y: float) -> bool:
    """Return whether a point of the plane lies in the shading."""
    ax = figure.axes[0]
    return any(path.contains_point((x, y)) for patch in ax.collections for path in patch.get_paths())


def test_the_curves_of_one_amplitude_are_shaded_where_sliding_is_stable() -> None:
    pytest.importorskip("matplotlib")
    angle = np.linspace(0, 2 * np.pi, 400)
    island = {"eps": 0.1, "V": 10 * np.exp(0.3 * np.cos(angle)), "K_over_W0": 0.02 + 0.005 * np.sin(angle)}
    floor = {"eps": 0.1, "V": [1.0, 100.0], "K_over_W0": [0.01, 0.008]}
    figure = plots.stability_diagram([island, floor])
    for V, y, stable in ((10, 0.026, True), (10, 0.02, False), (10, 0.012, True), (10, 0.005, False), (3, 0.02, True)):
        assert shaded(figure, V, y) == stable
    alone = plots.stability_diagram([], hopf=HOPF)
    middle = len(HOPF["V"]) // 2
    assert shaded(alone, HOPF["V"][middle], HOPF["K_over_W0"][middle] * 1.02)
    assert not shaded(alone, HOPF["V"][middle], HOPF["K_over_W0"][middle] * 0.9)


@pytest.mark.parametrize("count", [2, 5, 9])
def test_many_names_stand_below_the_axes_and_cover_nothing(count: int) -> None:
    pytest.importorskip("matplotlib")
    curves = [{"eps": k, "label": f"law-{k}/dieterich", "V": [1, 10], "K_over_W0": [0.01 + k / 1e3] * 2} for k in range(count)]
    figure = plots.stability_diagram(curves)
    figure.canvas.draw()
    (axes,) = figure.axes
    (below,) = figure.legends
    assert axes.get_legend() is None
    assert [t.get_text() for t in below.get_texts()] == [c["label"] for c in curves]
    assert below.get_window_extent().y1 < axes.get_window_extent().y0
    assert below.get_window_extent().x1 <= figure.bbox.x1


def test_a_title_is_broken_between_parameters_and_stays_in_the_figure() -> None:
    pytest.importorskip("matplotlib")
    described = {n: {"value": 0.123456, "unit": "um"} for n in ("D0", "W0", "lambda", *"abcdefghij")}
    figure = plots.stability_diagram(BRANCHES, title=plots.titled("law, ageing", described))
    figure.canvas.draw()
    text = figure._suptitle.get_text()  # type: ignore[attr-defined]
    assert text.startswith("law, ageing\nW$_0$ = 0.1235 µm, f = 0.1235 µm\nD$_0$ = 0.1235 µm, λ = 0.1235 µm, a = ")
    extent = figure._suptitle.get_window_extent()  # type: ignore[attr-defined]
    assert extent.x1 <= figure.bbox.x1 and extent.y0 >= figure.axes[0].get_window_extent().y1


def test_curves_can_be_drawn_in_axes_of_ones_own() -> None:
    pyplot = pytest.importorskip("matplotlib.figure")
    figure = pyplot.Figure()
    left, right = figure.subplots(1, 2)
    assert plots.stability_diagram(BRANCHES, hopf=HOPF, title="t\nmore", ax=left) is figure
    assert plots.lines(V, [V, V], ["a", "b"], "x", "y", True, ax=right) is figure
    assert left.get_title(loc="left") == "t" and len(left.get_legend().get_texts()) == 3 and not figure.legends


def test_several_amplitudes_are_told_apart_without_colour() -> None:
    pytest.importorskip("matplotlib")
    axes = plots.stability_diagram(BRANCHES).axes[0]
    assert not axes.collections
    assert len({line.get_linestyle() for line in axes.lines}) == 2


def test_an_orbit_has_a_panel_for_each_variable() -> None:
    pytest.importorskip("matplotlib")
    t = np.linspace(0, 1, 20)
    figure = plots.orbit(t, u=t, v=t + 0.1, states={"phi": t + 0.1, "phi_2": t + 1}, mu=t, W=t)
    assert [ax.get_yscale() for ax in figure.axes] == ["linear", "log", "log", "linear", "linear", "linear"]
    assert all("[" in ax.get_ylabel() for ax in figure.axes if ax.get_ylabel() != "µ")


def test_a_plot_is_refused_before_anything_is_computed(tmp_path: Path) -> None:
    for name, said in (("x.jpg", "ends in '.jpg'"), ("x", "has no ending")):
        with pytest.raises(SrfError, match=said):
            plots.check_plot(tmp_path / name, force=False)
    (tmp_path / "x.svg").write_text("")
    with pytest.raises(SrfError, match="exists already"):
        plots.check_plot(tmp_path / "x.svg", force=False)
