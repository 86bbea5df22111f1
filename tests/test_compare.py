"""Laws side by side: matched to the same observables, studied alike, told apart where they differ."""

from __future__ import annotations

import gc
import json
import signal
import time

import numpy as np
import pytest
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.codegen.slider import system
from srfcli.core.errors import SrfError, Status
from srfcli.numerics.compare import (
    LawPart,
    LawStudy,
    LawTask,
    Match,
    Window,
    changed_areas,
    check_adjusted,
    contrast,
    join_study,
    law_parts,
    match,
    observe,
    reentrance,
    study_part,
    turns,
)
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import critical_point
from srfcli.results.map import ComparisonResult, highest_fold

LAWS = [
    {"law": "log-log"},
    {"law": "bowden-tabor"},
    {"law": "dieterich-ruina", "ageing": "ruina"},
    {"law": "rice-regularized"},
    {"law": "two-state"},
    {"law": "dieterich-cutoff", "ageing": "nagata"},
    {"ageing": "perrin-rice-zheng"},
    {"ageing": "dieterich+linker-dieterich"},
]


@pytest.mark.parametrize("names", LAWS, ids=lambda n: "+".join(n.values()))
def test_a_matched_law_has_the_reference_s_observables(model, make_model, names):
    """Looked at apart from the matching: slope by differences of the steady friction, load and frequency from the roots."""
    goal = observe(model, model.vector(), 10.0)
    other = make_model(**names)
    found = match(other, other.vector(), goal)
    assert found.status is Status.OK and found.miss < 1e-8
    p = found.p.copy()
    p[other.index("V")], p[other.index("W0")] = 10.0, goal.W0
    roots = np.roots(np.asarray(other.characteristic(p.tolist()))[::-1])
    leading = roots[np.argmax(roots.real)]
    assert leading.real == pytest.approx(0.0, abs=1e-6 * goal.Omega)
    assert abs(leading.imag) == pytest.approx(goal.Omega, rel=1e-6)
    friction = []
    for V in (10.0 * np.exp(-1e-4), 10.0, 10.0 * np.exp(1e-4)):
        p[other.index("V")] = V
        friction.append(float(other.cycle_friction(0.0, other.steady(p), p.tolist())))
    assert friction[1] == pytest.approx(goal.friction, rel=1e-9)
    assert (friction[0] - friction[2]) / 2e-4 == pytest.approx(goal.slope, rel=1e-6)


def test_the_reference_matched_to_itself_stays(model):
    goal = observe(model, model.vector(), 10.0)
    assert match(model, model.vector(), goal).p == pytest.approx(model.vector(), rel=1e-12)
    moved = model.vector({"A": 0.02, "B": 0.035, "D0": 0.6})
    assert match(model, moved, goal).p == pytest.approx(model.vector(), rel=1e-6)


def test_a_law_that_strengthens_cannot_be_matched_from_there(model):
    goal = observe(model, model.vector(), 10.0)
    assert observe(model, model.vector({"A": 0.05}), 10.0) is None
    assert match(model, model.vector({"A": 0.05}), goal).status is Status.NO_CONVERGENCE


@pytest.mark.parametrize("names", [("A", "B"), ("A", "B", "B"), ("A", "B", "mu0"), ("A", "B", "Q")])
def test_what_cannot_be_adjusted_is_refused(model, names):
    with pytest.raises(SrfError):
        check_adjusted(model, names)


WINDOW = Window((5.0, 40.0), (7.0, 40.0), 14, 24)


def study_law(task):
    return join_study(task, {part: study_part(part) for part in law_parts(task)})


@pytest.fixture(scope="module")
def study(model):
    """The paper's law without modulation and at eps = 0.13, in a small window."""
    task = LawTask(model.source, model.key, model.vector(), (0.0, 0.13), WINDOW, onset=0.01)
    return study_law(task)


def test_crossings_are_critical_loads(model, study):
    lines = WINDOW.velocities()
    for i in (3, 44):
        base = model.vector({"V": lines[i], "eps": 0.13})
        line = critical_line(model, base, lo=7.0, hi=40.0, tol=1e-6)
        seen = study.crossings[1][i]
        expected = [q.value(model, "W0") for q in line.points]
        assert seen[np.isfinite(seen)] == pytest.approx(expected, rel=5e-3)
        hopf, _ = critical_point(model, model.vector({"V": lines[i]}))
        assert study.crossings[0][i, 0] == pytest.approx(hopf.W0, rel=1e-9)


def test_re_entrance_begins_between_one_crossing_and_three(model, study):
    low, high = study.onset
    assert 0 < high - low <= 0.01
    counts = []
    for eps in (low - 0.01, high + 0.01):
        task = LawTask(model.source, model.key, model.vector(), (eps,), WINDOW, onset=1.0)
        counts.append(np.isfinite(study_law(task).crossings[0]).sum(axis=1).max())
    assert counts[0] == 1 and counts[1] == 3


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="timers of the system")
def test_an_interrupted_study_is_none(model):
    """At whatever moment: half a study, kept by --resume, would be taken for a whole one."""
    task = LawTask(model.source, model.key, model.vector(), (0.13,), Window((5.0, 40.0), (5.0, 40.0), 5, 7), onset=1.0)
    part = LawPart(task, 0.13, mapped=True)
    study_part(part)  # compiled from here on
    begun = time.process_time()
    whole = study_part(part)
    spent = time.process_time() - begun
    before = signal.signal(signal.SIGVTALRM, signal.default_int_handler)
    ended = 0
    gc.disable()  # an interrupt that falls into a callback of its, as hypothesis has one, is told and lost
    try:
        for share in (0.1, 0.3, 0.5, 0.7, 0.9):
            signal.setitimer(signal.ITIMER_VIRTUAL, share * spent)
            try:
                found = study_part(part)
            except KeyboardInterrupt:
                ended += 1
            else:
                signal.setitimer(signal.ITIMER_VIRTUAL, 0)
                assert all(np.array_equal(found[name], whole[name], equal_nan=True) for name in whole)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)
        gc.enable()
    assert ended


def test_a_study_without_re_entrance_says_so(model):
    task = LawTask(model.source, model.key, model.vector(), (0.0, 0.03), WINDOW)
    found = study_law(task)
    assert np.isnan(found.onset).all() and found.folds == (0, 0)


@pytest.mark.parametrize(
    ("several", "there", "onset", "end"),
    [
        ((False, False), lambda eps: 0.033 < eps < 0.058, 0.033, 0.058),
        ((False, True), lambda eps: 0.033 < eps < 0.058 or eps > 0.1, 0.033, 0.058),
        ((False, True), lambda eps: eps > 0.071, 0.071, None),
        ((True, False), lambda eps: eps < 0.02, 0.0, 0.02),
        ((False, False), lambda eps: False, None, None),
    ],
)
def test_re_entrance_that_comes_and_goes_between_two_amplitudes_is_seen(model, several, there, onset, end):
    """`several` is what the maps at 0 and 0.13 say; between them each amplitude is asked for, and brackets hold the edges."""
    task = LawTask(model.source, model.key, model.vector(), (0.0, 0.13), WINDOW)
    known = {part.eps: there(part.eps) for part in law_parts(task) if not part.mapped}
    known |= dict(zip(task.amplitudes, several, strict=True))
    for (low, high), edge in zip(reentrance(known, there, within=1e-3), (onset, end), strict=True):
        if edge is None:
            assert np.isnan([low, high]).all()
        else:
            assert low <= edge <= high
            assert high - low <= 1e-3


def made(*crossings):
    """Return a study with the given crossings and nothing else."""
    count = len(crossings)
    return LawStudy(
        tuple(crossings), ((),) * count, (0,) * count, (0,) * count, (np.nan, np.nan), (np.nan, np.nan), (Status.OK,) * count
    )


def test_areas_of_rectangles():
    window = Window((1.0, 10.0), (1.0, np.e**4), 1, 1)  # five lines, 4 in ln W0
    one = np.full((5, 1), np.e**2)  # stable below 2
    later = np.full((5, 1), np.e**3)  # stable below 3
    gap = np.full((5, 3), [np.e**1, np.e**1.5, np.e**3])  # unstable from 1 to 1.5 and from 3 on
    assert changed_areas([one, later], window) == pytest.approx((0.0, 0.25))
    assert changed_areas([one, gap], window) == pytest.approx((0.125, 0.25))
    assert changed_areas([one, later, one], window) == pytest.approx((0.25, 0.0))  # stable at the middle amplitude
    assert changed_areas([np.full((5, 1), np.nan), one], window) == pytest.approx((0.5, 0.0))


def test_the_contrast_is_where_the_first_crossings_differ_most():
    window = Window((1.0, 10.0), (1.0, 100.0), 1, 1)
    a, b = np.full((5, 1), 10.0), np.full((5, 1), 10.2)
    b[3] = 13.0
    b[4] = np.nan
    best = contrast(made(a, a), made(a, b), (0.0, 0.1), window)
    assert (best.eps, best.V, best.W0) == (0.1, pytest.approx(10**0.75), (10.0, 13.0))
    assert best.difference == pytest.approx(0.3) and best.seen
    assert not contrast(made(a), made(np.full((5, 1), 10.2)), (0.0,), window).seen
    assert contrast(made(a), made(np.full((5, 1), np.nan)), (0.0,), window) is None


@pytest.mark.parametrize(("values", "count"), [([1, 2, 3], 0), ([1, 2, 1], 1), ([1, 2, 2, 1, 3], 2), ([1.0], 0)])
def test_turns(values, count):
    assert turns(np.array(values, float)) == count


def test_highest_fold():
    curve = np.array([[1.0, 5], [3, 5], [2, 5], [2.5, 5], [2.2, 5], [4, 5]])
    found = LawStudy((), ((curve,),), (3,), (0,), (0.0, 0.0), (np.nan, np.nan), (Status.OK,))
    assert highest_fold(found, 0) == 3.0
    assert highest_fold(LawStudy((), ((curve[:2],),), (0,), (0,), (0.0, 0.0), (np.nan, np.nan), (Status.OK,)), 0) is None


@pytest.mark.parametrize("matched", [True, False])
def test_a_figure_names_what_its_laws_were_given(matched):
    pytest.importorskip("matplotlib")
    slider = system()
    lines = np.full((WINDOW.velocities().size, 1), 9.0)
    curve = np.array([[5.0, 10], [9, 12]])
    study = LawStudy((lines, lines), ((), (curve,)), (0, 0), (0, 0), (np.nan, np.nan), (np.nan, np.nan), (Status.OK,) * 2)
    p = slider.vector()
    matches = (Match(p, (), 0.0, Status.OK), Match(p, ("A", "D0") if matched else (), 0.0, Status.OK))
    goal = observe(slider.model, p, 10.0)
    studies = {0: study, 1: study}
    figure = ComparisonResult(("a", "b"), (slider,) * 2, goal, matches, studies, (0.0, 0.1), (0.1,), WINDOW).plot()
    said = "matched at low velocity" if matched else "as given"
    assert figure._suptitle.get_text().startswith(f"2 laws, {said}, ε = 0.1; a with\nf = 120 Hz, K = 0.21 N/µm")
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[1:] == ["a", "b, matched with A = 0.0126, D$_0$ = 0.402 µm" if matched else "b"]


def run(*arguments):
    done = CliRunner().invoke(cli, ["compare", *arguments])
    return done.exit_code, done.stdout, done.stderr


SMALL = ("--over", "V=5:40:6", "--over", "K/W0=0.006:0.03:10", "--eps", "0.13")


def test_the_command_compares(tmp_path):
    code, out, _ = run(
        "--ageing", "dieterich", "--ageing", "dieterich+linker-dieterich", *SMALL, "--json", "--plot", str(tmp_path / "a.svg")
    )
    data = json.loads(out)
    assert code == 0 and data["schema"] == "srf.compare/2"
    first, second = data["rows"]
    assert first["law"] == "dieterich" and first["miss"] == 0 and second["miss"] < 1e-8
    assert first["reentrance_eps"] == pytest.approx(0.1, abs=0.01)
    [pair] = data["meta"]["pairs"]
    assert pair["difference"] > 0.03
    assert any("differ most at V = " in note and "times the 3%" in note for note in data["notes"])
    assert (tmp_path / "a.svg").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--law", "srf-vsat"), "one law is nothing to compare"),
        (("--law", "srf-vsat", "--law", "log-log", "--eps", "0"), "leaves nothing to compare"),
        (("--law", "srf-vsat", "--law", "log-log", "--set", "Q=3"), "unknown parameter 'Q' in all of these laws"),
        (("--law", "srf-vsat", "--law", "log-log", "--set", "A=0.05"), "no critical load at 10 um/s"),
        (("--law", "srf-vsat", "--law", "log-log", "--adjust", "A,B"), "not three parameters"),
        (("--law", "srf-vsat", "--law", "log-log", "--over", "f=1:9"), "not an axis of the comparison"),
        (("--law", "srf-vsat", "--law", "nosuch"), "nosuch"),
    ],
)
def test_misuse_is_told(arguments, said):
    code, _, err = run(*arguments)
    assert code == 2 and said in err
