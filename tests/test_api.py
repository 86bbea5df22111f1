"""The Python API: what the commands print is what its results hold, as table, data frame, arrays, page and figure."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import inspect
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import srfcli as srf
from srfcli.cli.main import cli
from srfcli.data.thresholds import thresholds
from srfcli.inference.prediction import run_parameters
from srfcli.results.tables import plain_value

FUNCTIONS = [name for name in srf.__all__ if inspect.isfunction(getattr(srf, name))]
TASKS = sorted({inspect.getmodule(getattr(srf, name)).__name__ for name in FUNCTIONS})


@pytest.fixture(scope="module")
def slider() -> srf.SlidingSystem:
    return srf.system()


@pytest.fixture(scope="module")
def linear(slider: srf.SlidingSystem):
    return srf.linear(slider, over={"V": [1, 10, 100]})


def rows_of(*arguments: str) -> list[list]:
    done = CliRunner().invoke(cli, [*arguments, "--json"])
    assert done.exit_code == 0, done.stderr
    return [list(row.values()) for row in json.loads(done.stdout)["rows"]]


@pytest.mark.parametrize("name", TASKS)
def test_the_examples_are_true(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(importlib.import_module(name))
    assert found.failed == 0


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_says_what_it_takes_and_returns(name: str) -> None:
    function = getattr(srf, name)
    text = inspect.getdoc(function)
    assert text.splitlines()[0].endswith(".") and "\nParameters\n-" in text and "\nReturns\n-" in text
    assert "\nRaises\n-" in text and "\nExamples\n-" in text
    told = text.partition("\nParameters\n")[2].partition("\nReturns\n")[0]
    for parameter in inspect.signature(function).parameters:
        assert parameter in told, f"srf.{name} does not say what {parameter} is"


def test_the_reference_has_every_public_name_and_every_result() -> None:
    page = (Path(__file__).parents[1] / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    returned = " ".join(str(inspect.signature(getattr(srf, name)).return_annotation) for name in FUNCTIONS)
    results = set(re.findall(r"\w+Result", returned))
    assert len(results) > 15 and all(f"heading: {name}\n" in page for name in results)
    assert all(f"heading: srf.{name}\n" in page for name in srf.__all__)


def test_nothing_heavy_is_imported_before_it_is_used() -> None:
    code = "import sys, srfcli; print(sorted({'numpy', 'sympy', 'scipy', 'click', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert set(srf.__all__) <= set(dir(srf)) and not hasattr(srf, "no_such_name")

    assert inspect.isfunction(srf.system)


def test_the_package_runs_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "srfcli", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"srf {srf.__version__}"
    assert (Path(srf.__file__).parent / "py.typed").exists()


def test_commands_print_what_the_functions_return(slider: srf.SlidingSystem, linear) -> None:
    assert [list(r) for r in linear.table.rows] == rows_of("linear", "--over", "V=1,10,100")
    point = srf.critical(slider, V=7, eps=0.13)
    assert [list(r) for r in point.table.rows] == rows_of("critical", "--V", "7", "--eps", "0.13")
    *parts, boundary = srf.continue_boundary(slider, eps=0.18, over={"V": (20, 40)})
    assert [list(r) for r in boundary.table.rows] == rows_of("continue", "--eps", "0.18", "--over", "V=20:40")
    counts = [len(part.boundaries[0].branches) for part in parts]
    assert counts == sorted(counts) and counts[0] < counts[-1] == len(boundary.boundaries[0].branches)  # it grows
    state = srf.floquet(slider.at(V=8, W0=9, eps=0.09))
    assert [list(r) for r in state.table.rows] == rows_of("floquet", "--V", "8", "--W0", "9", "--eps", "0.09")
    gains = srf.response(slider.at(V=10, W0=6), over={"f": (10, 20, 60)})
    assert [list(r) for r in gains.table.rows] == rows_of("response", "--V", "10", "--W0", "6", "--over", "f=10,20,60")
    mean = srf.response(slider.at(V=10, W0=6), over={"f": (60,)}, eps=(0.05, 0.1))
    asked = ("response", "--V", "10", "--W0", "6", "--over", "f=60", "--mean", "--eps", "0.05,0.1")
    assert [list(r) for r in mean.table.rows] == rows_of(*asked)
    for wrong in ({"f": 1, "V": 1}, {"eps": [0.1]}, {"g": [1]}):
        with pytest.raises(srf.SrfError):
            srf.response(slider, over=wrong)


def test_a_map_has_two_dimensions(slider: srf.SlidingSystem) -> None:
    found = srf.map(slider.at(eps=0.18), x=("V", 10, 40, 8), y=("K/W0", 0.01, 0.025, 12))
    options = ("--eps", "0.18", "--over", "V=10:40:8", "--over", "K/W0=0.01:0.025:12")
    assert [list(r) for r in found.table.rows] == rows_of("map", *options)
    assert len(found.components.rows) == 2 and found.status is srf.Status.OK
    pytest.importorskip("xarray")
    boundary = found.boundary.to_dataframe()
    assert set(boundary["component"]) == {1, 2} and boundary.attrs["units"]["V"] == "um/s"
    assert "<table>" in found.components._repr_html_()
    field = found.to_xarray()
    assert field["growth_per_slip"].dims == ("V", "K_over_W0") and field["V"].attrs["units"] == "um/s"
    assert (field["type"].values == "stable").sum() == sum(row[1] == "stable" for row in found.table.rows)


def test_a_simulation_under_modulation_ends_in_the_periodic_state(slider: srf.SlidingSystem) -> None:
    moving = slider.at(V=8, W0=9, eps=0.09)
    run = srf.simulate(moving, t=np.linspace(0, 6, 60_001), observable="friction")
    last = run.records[0].trace.mu[-10_000:]  # 1 s, 120 periods
    assert last.mean() == pytest.approx(srf.floquet(moving).state.mean_friction, rel=2e-4)
    with pytest.raises(srf.SrfError, match="rising"):
        srf.simulate(slider, t=[1, 0])
    with pytest.raises(srf.SrfError, match="no steady sliding"):
        srf.simulate(slider, t=[0, 1], drive=[(0, 0)])


def test_an_experiment_is_read_checked_and_fitted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made = ("--drive", "0.5:10, 1:20", "--W0", "5", "--rate", "200", "--noise", "0.02", "--out-dir", "steps")
    assert CliRunner().invoke(cli, ["simulate", *made]).exit_code == 0
    told = srf.check("steps")
    assert [plain_value(r) for r in told.table.rows] == rows_of("check", "steps")
    assert told.runs[0].noise.total == pytest.approx(0.02, rel=0.3) and told.forecast.together is None
    assert told.plot().axes[0].get_title(loc="left") == told.runs[0].run.name
    with pytest.raises(srf.SrfError, match="no run 'other'"):
        srf.check("steps", runs=["other"])
    with pytest.raises(srf.SrfError, match="unknown reader 'mat'"):
        srf.check("steps", reader="mat")
    found = srf.fit("steps", free=["mu0", "D0"], track="smooth", reader="csv")
    assert found.log_likelihood == found.table.meta["log_likelihood"]
    options = ("--free", "mu0,D0", "--track", "smooth")
    assert [list(r) for r in found.table.rows] == rows_of("fit", "steps", *options)
    assert found.values["D0"] == pytest.approx(0.402, abs=5 * found.stderr["D0"])
    figure = pytest.importorskip("matplotlib.figure").Figure()
    here, there = figure.subplots(1, 2)
    assert found.plot(ax=here) is told.plot(ax=there) is figure
    panels = [{ax.get_ylabel().split("\n")[0] for ax in part.axes} for part in figure.subfigs]
    assert panels[0] == {"elongation", "residual"} and panels[1] >= {"V"} and len(figure.axes) == sum(map(len, panels))
    with pytest.raises(srf.SrfError, match="placed by hand"):
        found.plot(ax=figure.add_axes((0, 0, 1, 1)))


def test_formulas_and_code_are_those_of_the_commands(slider: srf.SlidingSystem, tmp_path: Path) -> None:
    def printed(*arguments: str) -> str:
        done = CliRunner().invoke(
            cli, [*arguments, *["--law", "dieterich-ruina", "--ageing", "ruina", "--interface", "rigid", "--no-inertia"]]
        )
        assert done.exit_code == 0, done.stderr
        return done.stdout

    other = srf.system("dieterich-ruina", ageing="ruina", interface="rigid", inertia=False, K=0.3)  # values do not matter
    found = srf.derive(other, extras="jacobian")
    assert found.text == printed("derive", "--with", "jacobian")
    assert found.latex == printed("derive", "--with", "jacobian", "--format", "latex")
    assert found.python == printed("derive", "--format", "python")
    whole = srf.derive(other, extras=["jacobian", "parameters"])
    assert whole.document == json.loads(printed("derive", "--format", "json"))
    assert f"  mu_ss = {found.formulas['mu_ss']}\n" in found.text and "<p>$C_{0} = " in found._repr_html_()
    names = [row[1] for row in found.table.rows]
    assert names == [f.name for section in found.sections for f in section.formulas] and set(names) == set(found.formulas)
    module = srf.code(other)
    assert module.text == printed("code") and {"rates", "steady"} <= {row[0] for row in module.table.rows}
    module.write(tmp_path / "model.py")
    assert (tmp_path / "model.py").read_text(encoding="utf-8") == module.text
    for wrong in (lambda: module.write(tmp_path / "model.py"), module.plot):
        with pytest.raises(srf.SrfError):
            wrong()


def test_an_experiment_is_drafted_as_by_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    rows = [f"{0.1 * k:.1f},{60 + k % 3}" for k in range(200)]
    Path("run.csv").write_text("\n".join(["clock,S [kPa]", *rows]), encoding="utf-8")
    columns = {"time": "clock [s]", "shear_stress": "S"}
    said = {"stiffness": "55 MPa/mm", "load": "100 kPa", "title": "steps", "radius": "25 mm"}
    options = [part for name, text in said.items() for part in (f"--{name}", text)]
    options += [part for role, heading in columns.items() for part in ("--column", f"{role}={heading}")]
    done = CliRunner().invoke(cli, ["new", "run.csv", *options, "--drive", "10:3, 10:30", "--window", "1,19", "--out", "-"])
    assert done.exit_code == 0, done.stderr
    made = srf.new_experiment("run.csv", columns=columns, drive=[(10, 3), (10, 30)], window=(1, 19), **said)
    assert made.text == done.stdout and all(f"Note: {note}\n" in done.stderr for note in made.notes)
    assert [row[:3] for row in made.table.rows] == [("time", "clock", "s"), ("shear_stress", "S [kPa]", "kPa")]
    made.write()
    assert srf.read_experiment(tmp_path).runs[0].t.size == 181
    with pytest.raises(srf.SrfError, match="exists already"):
        made.write()
    Path("other").mkdir()
    srf.new_experiment("run.csv", columns=columns, drive=3, folder="other", **said).write("here.toml")
    assert Path("here.toml").is_file() and not [*Path("other").iterdir()]  # a path is seen from the working folder, as elsewhere
    for wrong, text in (
        ({"stiffness": None}, "the stiffness of the machine is in no table"),
        ({"stiffness": "55"}, "`stiffness` '55' has no unit"),
        ({"window": 3}, "no list of pairs"),
        ({"drive": None}, "which column is the load point's velocity"),
        ({"columns": {"shears": "S"}}, "no such role"),
    ):
        with pytest.raises(srf.SrfError) as found:
            srf.new_experiment("run.csv", **{"columns": columns, "drive": 3, **said, **wrong})
        assert text in str(found.value)


def test_critical_loads_are_fitted_as_by_the_command(slider: srf.SlidingSystem, tmp_path: Path) -> None:
    table = tmp_path / "loads.csv"
    table.write_text("V,eps,W0c,sigma\n1,0,7.4,0.2\n5,0,7.3,0.2\n20,0,8.7,0.2\n60,0,10.6,0.3\n10,0.2,9.4,0.3\n")
    found = srf.fit_thresholds(table, slider.at(D0="500 nm"), free="D0,rho", rho=0.5, bounds={"D0": ("0.2 um", 1)})
    options = ("--free", "D0,rho", "--set", "D0=0.5", "--set", "rho=0.5", "--bounds", "D0=0.2:1")
    assert [plain_value(row) for row in found.table.rows] == rows_of("fit", str(table), *options)
    assert found.values["D0"] == pytest.approx(0.4, abs=5 * found.stderr["D0"]) and set(found.values) == {"D0", "rho"}


def test_comparing_names_what_was_matched() -> None:
    with pytest.raises(srf.SrfError, match="one law"):
        srf.compare({"a": srf.system()})
    laws = {name: srf.system(ageing=name) for name in ("dieterich", "ruina")}
    small = {"columns": 4, "rows": 6}
    found = srf.compare(laws, eps=0.09, V=(5, 20), K_over_W0=(0.015, 0.03), points=small)
    options = ("--ageing", "dieterich", "--ageing", "ruina", "--over", "V=5:20:4", "--over", "K/W0=0.015:0.03:6")
    assert [list(r) for r in found.table.rows] == rows_of("compare", *options, "--eps", "0.09")
    pytest.importorskip("matplotlib")
    named = [text.get_text() for text in found.plot().legends[0].get_texts()]
    assert any(text.startswith("ruina, matched with") and "D$_0$ =" in text for text in named)


def test_results_are_frozen_and_have_every_form(linear) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        linear.over = {}
    *_, found = srf.continue_boundary(srf.system(), over={"V": (20, 22)})
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.boundaries[0].notes = ()
    assert isinstance(found.boundaries[0].notes, tuple) and isinstance(found.boundaries[0].branches, tuple)
    assert repr(linear) == "<LinearResult: srf-vsat, dieterich, elastic, vertical, inertia on; 3 rows, ok>"
    assert "7.28316" in str(linear) and linear.parameters["K"]["value"] == 0.21
    pandas = pytest.importorskip("pandas")
    frame = linear.to_dataframe()
    assert isinstance(frame, pandas.DataFrame) and frame.attrs["units"]["W0"] == "N"
    assert frame["W0"].tolist() == [row[2] for row in linear.table.rows]
    pytest.importorskip("xarray")
    assert linear.to_xarray()["W0"].attrs["units"] == "N"


@pytest.mark.parametrize(("form", "library"), [("to_dataframe", "pandas"), ("to_xarray", "xarray")])
def test_a_form_names_the_library_that_it_lacks(linear, form: str, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pandas", "xarray"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(srf.SrfError, match=f"{form} needs {library}") as error:
        getattr(linear, form)()
    assert "srfcli[frames]" in error.value.hint


def test_a_notebook_shows_a_table_and_escapes_what_it_shows(linear) -> None:
    from srfcli.results.tables import ROWS_SHOWN, Column, Table

    page = linear._repr_html_()
    assert page.count("<tr>") == 4 and "W0 [N]" in page
    rows = [("<script>",)] * (ROWS_SHOWN + 3)
    page = Table("x/1", (Column("a<b", "", '"'),), rows, "t&t", ("n>1",))._repr_html_()
    assert "<script" not in page and "3 more rows" in page and "t&amp;t" in page and "n&gt;1" in page


def test_figures_can_share_ones_own_axes(linear) -> None:
    figure = pytest.importorskip("matplotlib.figure").Figure()
    ax = figure.subplots()
    assert linear.plot(ax=ax) is figure and ax.get_xlabel() == "V  [µm/s]"
    assert linear.plot() is not figure
    assert linear.plot()._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]  # as a notebook shows it


def test_values_are_checked_as_on_the_command_line(slider: srf.SlidingSystem) -> None:
    for wrong, said in (
        (lambda: srf.system("srf-vast"), "srf-vsat"),
        (lambda: srf.system(Vast=1), "Vsat"),
        (lambda: srf.system(K="3 kg"), "K"),
        (lambda: srf.linear(slider, over={"V": [-1]}), "below its lower bound"),
        (lambda: srf.continue_boundary(slider, over={"W0": (1, 20)}), "spans no plane"),
        (lambda: srf.continue_boundary(slider, over={"V": (20, 1)}), "no axis"),
        (lambda: srf.map(slider, x=("V", 1, 10, 1), y=("W0", 1, 10, 5)), "no axis"),
        (lambda: srf.load_law("srf-vast"), "srf-vsat"),
    ):
        with pytest.raises(srf.SrfError) as error:
            wrong()
        assert said in f"{error.value.message} {error.value.hint}"


TIMES = [0.0, 0.5, 1.0]
WRONG = {
    "no mapping": (lambda s: srf.linear(s, over=["V"]), "no mapping from a parameter"),
    "a number as window": (lambda s: srf.critical(s, window=5), "not two rising loads"),
    "a falling window": (lambda s: srf.critical(s, window=(20, 4)), "not two rising loads"),
    "few samples": (lambda s: srf.critical(s, samples=2), "crossings would be missed"),
    "text for a number": (lambda s: srf.critical(s, eps="much"), "is not a number"),
    "harmonics": (lambda s: srf.floquet(s, harmonics=-1), "is below 0"),
    "systems without names": (lambda s: srf.compare([s, s]), "have no names"),
    "a name as axis": (lambda s: srf.map(s, x="V", y=("W0", 1, 20, 3)), "is no axis"),
    "nothing as value": (lambda s: srf.system(K=None), "is no number"),
    "several values": (lambda s: s.at(K=np.array([1, 2])), "is no number"),
    "times": (lambda s: srf.simulate(s, t="soon"), "no rising list of times"),
    "a number as drive": (lambda s: srf.simulate(s, t=TIMES, drive=8), "no list of pairs"),
    "no drive": (lambda s: srf.simulate(s, t=TIMES, drive=[]), "no list of pairs"),
    "triples as load": (lambda s: srf.simulate(s, t=TIMES, load=[(1, 5, 6)]), "no list of pairs"),
    "an onset of nothing": (lambda s: srf.simulate(s, t=TIMES, onset=0.5), "nothing is modulated"),
    "an onset before": (lambda s: srf.simulate(s.at(eps=0.1), t=TIMES, onset=-5.0), "before the record"),
    "an effect of the drive": (lambda s: srf.critical(srf.system(effects=["drive-ripple"])), "critical loads do not depend on"),
    "a track": (lambda s: srf.fit("here", track="bumpy"), "`track`: 'bumpy'"),
    "a trend": (lambda s: srf.fit("here", trend="up"), "`trend`: 'up'"),
    "a name twice": (lambda s: srf.fit("here", free="A,A"), "named twice"),
    "no start": (lambda s: srf.fit("here", starts=0), "one start or more"),
    "a law as slider": (lambda s: srf.critical("srf-vsat"), "`system`: 'srf-vsat' is of a wrong type"),
    "a number as folder": (lambda s: srf.fit(3), "`experiment`: 3 is of a wrong type"),
    "text as tolerance": (lambda s: srf.floquet(s, tol="x"), "`tol`: 'x' is of a wrong type"),
    "a number among names": (lambda s: srf.derive(s, extras=["jacobian", 3]), "`extras`: '3'"),
    "a number as law": (lambda s: srf.compare({"a": s, "b": 3}), "`systems`: {"),
    "text as an end": (lambda s: srf.compare({"a": s, "b": s}, V=(5, "20")), "`V`: (5, '20')"),
    "points of a map": (lambda s: srf.compare({"a": s, "b": s}, points={"V": 8}), "`points`: 'V'"),
    "settings": (lambda s: srf.continue_boundary(s, settings=3), "`settings` 3"),
    "a mapping as start": (lambda s: srf.simulate(s, t=TIMES, start={"v": 1}), "`start` {'v': 1} is no state"),
    "code as inertia": (lambda s: srf.system(inertia="print()"), "neither True nor False"),
    "no evaluations": (lambda s: srf.fit_thresholds("here.csv", s, free="A", max_evaluations=0), "one or more"),
    "a part": (lambda s: srf.derive(s, extras="hessian"), "`extras`: 'hessian'"),
    "an effect's formulas": (lambda s: srf.derive(srf.system(effects="viscous-drag")), "no part in a derivation"),
    "code of a gauge": (lambda s: srf.code(srf.system(effects="sensor-lag")), "critical loads do not depend on"),
    "a draft of nothing": (lambda s: srf.new_experiment("here.csv", stiffness="1 N/um"), "here.csv"),
    "a kind of experiment": (lambda s: srf.new_experiment([], stiffness="1 N/um", kind="slow"), "`kind`: 'slow'"),
    "no recordings": (lambda s: srf.new_experiment([], stiffness="1 N/um"), "no recordings"),
    "no table": (lambda s: srf.fit_thresholds("here.csv", s, free="A"), "here.csv"),
    "no trial": (lambda s: srf.prove("here", report_only=True), "no trial"),
    "no cases": (lambda s: srf.prove("here", cases=0), "one case or more"),
    "a bank": (lambda s: srf.prove("here", bank="narrow"), "`bank`: 'narrow'"),
    "what a report asks": (lambda s: srf.prove("here", report_only=True, seed=0), "`seed` has no meaning"),
    "what varies by what": (lambda s: srf.diagnose("here", by="weekday"), "`by`: 'weekday'"),
}


@pytest.mark.parametrize(("call", "message"), WRONG.values(), ids=WRONG)
def test_a_wrong_argument_is_said_in_a_line(call, message: str, slider: srf.SlidingSystem) -> None:
    with pytest.raises(srf.SrfError) as found:
        call(slider)
    assert message in str(found.value) and "\n" not in str(found.value)


def test_what_is_fitted_to_critical_loads_is_said_in_a_line(slider: srf.SlidingSystem) -> None:
    table = thresholds([1, 10], [0, 0], [7.3, 7.8])
    for options, said in (
        ({"free": "nosuch"}, "unknown parameter 'nosuch'"),
        ({"free": "V"}, "V cannot be fitted"),
        ({"free": ["A", "B", "D0"]}, "2 critical loads for 3 free parameters"),
        ({"free": "A", "methods": "newton"}, "unknown method 'newton'"),
        ({"free": "A", "bounds": {"A": 3}}, "`bounds` of A: 3 is no pair of numbers"),
        ({"free": "A", "rho": -1}, "below its lower bound"),
    ):
        with pytest.raises(srf.SrfError) as found:
            srf.fit_thresholds(table, slider, **options)
        assert said in str(found.value)


def test_values_may_be_text_with_a_unit(slider: srf.SlidingSystem) -> None:
    plain = srf.critical(slider, V=8, eps=0.1, window=(4, 20)).table.rows
    assert srf.critical(slider, V="8 um/s", eps="10 %", window=("4 N", "20 N")).table.rows == plain
    start = srf.simulate(slider, t=TIMES, start=10).records[0].trace
    assert start.v[0] == pytest.approx(10.0)


def test_a_registered_folder_is_looked_in(tmp_path: Path) -> None:
    """What `srf.read_experiment` took from a folder of plugins, `check` and `fit` take from it, too."""
    shipped = (Path(srf.__file__).parents[1] / "plugins" / "friction" / "dieterich-ruina.toml").read_text(encoding="utf-8")
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "own.toml").write_text(shipped.replace("dieterich-ruina", "own-law"), encoding="utf-8")
    lines = ["time [s],load_point_velocity [um/s],friction", *(f"{0.1 * k:.1f},3,{0.6 + 1e-4 * (k % 3):.4f}" for k in range(60))]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    (tmp_path / "experiment.toml").write_text(
        'format = "srf-experiment/1"\napparatus = { stiffness = "3e-3 1/um" }\n'
        'model = { law = "own-law", ageing = "ruina", interface = "rigid", inertia = false }\n'
        "parameters = { mu0 = { value = 0.6, lower = 0.5, upper = 0.7 } }\n"
        'runs = [{ name = "run", file = "run.csv", load = "10 MPa" }]\n'
    )
    experiment = srf.read_experiment(tmp_path, plugins=[tmp_path / "own"])
    assert srf.fit(experiment, plugins=[tmp_path / "own"], track="smooth").values["mu0"] == pytest.approx(0.6, abs=0.02)
    with pytest.raises(srf.SrfError, match="own-law"):
        srf.fit(experiment)


def test_settings_of_the_folder_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "srf.toml").write_text("[parameters]\nK = 0.5\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SRF_K", "0.7")
    assert srf.system().parameters["K"] == 0.21


def test_the_page_on_python_is_true(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pandas", "matplotlib"):
        pytest.importorskip(name)
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).resolve().parents[1] / "docs" / "python.md").read_text(encoding="utf-8")
    space: dict = {}
    exec(text.partition("```python\n")[2].partition("```")[0], space)
    assert len(space["frame"]) == 3 and space["figure"].axes
    assert all(f"srf.{name}(" in text for name in FUNCTIONS)


def test_a_stiffness_in_another_unit_of_force_is_no_friction_per_micron(tmp_path: Path) -> None:
    """A fitted stiffness in kgf/mm is the machine's under every load, as one in N/um is."""
    rows = [f"{0.1 * i:.1f},3,3.0,7.0" for i in range(60)]
    head = "time [s],load_point_velocity [um/s],force,normal_load"
    (tmp_path / "run.csv").write_text("\n".join([head, *rows]))
    (tmp_path / "experiment.toml").write_text("""
format = "srf-experiment/1"
apparatus = { stiffness = "21 kgf/mm" }
model = { law = "dieterich-ruina", ageing = "ruina", interface = "rigid", inertia = false }
parameters = { K = { value = "21 kgf/mm", lower = "10 kgf/mm", upper = "40 kgf/mm" } }
runs = [{ name = "run", file = "run.csv" }]
""")
    experiment = srf.read_experiment(tmp_path)
    model = srf.system("dieterich-ruina", ageing="ruina", interface="rigid", inertia=False).model
    p = run_parameters(model, experiment, experiment.runs[0], {})
    assert p[model.index("K")] == pytest.approx(21 * 9.80665e-3)


def test_other_errors_of_python_stay() -> None:
    with pytest.raises(TypeError, match="missing 1 required keyword-only argument: 'stiffness'"):
        srf.new_experiment("run.csv")
    with pytest.raises(TypeError, match="nosuch"):
        srf.critical(srf.system(), nosuch=3)
    assert pickle.loads(pickle.dumps(srf.fit)) is srf.fit  # as workers get it
