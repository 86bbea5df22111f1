"""`srf simulate --field`: the random function itself, the motion over it, what is written."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PPoly
from test_simulate_command import columns, read, simulate
from test_splines import scipy_spline

from srfcli.codegen.c_source import compiled, compiler
from srfcli.core.errors import SrfError
from srfcli.data.noise import FINEST_KNOTS, KNOTS, WIDEST_KNOTS, FrictionField
from srfcli.laws.registry import load_registry
from srfcli.validation.slider import Physics, Plan, Track, move

STEADY = ("--V", "10", "--W0", "5", "--for", "2", "--rate", "100")


def matern(d: Any, length: float) -> Any:
    r = np.sqrt(3) * np.abs(d) / length
    return (1 + r) * np.exp(-r)


# ---- the random function


@pytest.mark.parametrize("length", [0.5, 10.0, 200.0])
def test_covariance_over_many_seeds(length: float) -> None:
    """Standard deviation and correlation at every distance, at knots and between them, on both sides of 0 and across it."""
    count, size = 800, 3e-4
    knots = FrictionField(size, length).spacing
    x = np.concatenate([length * np.array([-1.5, -0.5, 0.0, 0.13, 0.5, 1.5, 2.5]), [10 * knots, 10.5 * knots]])
    low, high = float(x.min()), float(x.max())
    values = np.array([scipy_spline(FrictionField(size, length, seed).spline(low, high))(x) for seed in range(count)]) / size
    expected = matern(x[:, None] - x[None, :], length)
    assert expected[1, 4] == pytest.approx(0.4834, abs=1e-4)  # at a distance of one length
    found = values.T @ values / count
    error = np.sqrt((1 + expected**2) / count)  # of a mean of products of Gaussian numbers
    assert (np.abs(found - expected) < 4.5 * error + 0.003).all()
    assert np.abs(values.mean(axis=0)).max() < 4.5 / np.sqrt(count)
    assert np.abs(np.sqrt(np.diag(found)) - 1).max() < 0.1


def test_what_lies_between_knots_is_as_rough_as_it_should_be() -> None:
    """Variance, correlation at the length and mean square slope along one long track, at knots and halfway between them."""
    track = FrictionField(1.0, 4.0, 5)
    spline, h = scipy_spline(track.spline(0.0, 60_000.0)), track.spacing
    x = np.arange(120_000) * h
    at, halfway, lag = spline(x), spline(x + h / 2), round(4.0 / h)
    assert halfway.var() == pytest.approx(at.var(), rel=2e-3)
    for values in (at, halfway):  # some ten thousand lengths: an error of a percent
        assert values.std() == pytest.approx(1.0, abs=0.03)
        assert np.mean(values[lag:] * values[:-lag]) == pytest.approx(0.4834, abs=0.04)
    assert np.var((halfway - at) / (h / 2)) == pytest.approx(3 / 4.0**2, rel=0.1)  # -K''(0), less what h/2 smooths


@settings(max_examples=40, deadline=None)
@given(
    start=st.floats(-300, 300),
    span=st.floats(0, 200),
    more=st.floats(0, 500),
    length=st.floats(0.3, 100),
    seed=st.integers(0, 2**64),
)
def test_a_part_of_a_track_is_the_same_whatever_else_is_asked_for(
    start: float, span: float, more: float, length: float, seed: int
) -> None:
    track = FrictionField(1e-3, length, seed)
    part, whole = track.spline(start, start + span), track.spline(start - more, start + span + more)
    assert part.first <= start and part.last >= start + span and part.spacing <= min(length / 4, WIDEST_KNOTS)
    offset = round((part.first - whole.first) / part.spacing)
    assert np.array_equal(part.coefficients, whole.coefficients[offset : offset + part.coefficients.size])


def test_size_scales_and_seed_changes_a_track() -> None:
    one, two, other = (FrictionField(size, 5.0, seed).spline(-20, 80) for size, seed in ((1e-4, 3), (2e-4, 3), (1e-4, 4)))
    assert two.coefficients == pytest.approx(2 * one.coefficients, rel=1e-14)
    assert abs(np.corrcoef(one.coefficients, other.coefficients)[0, 1]) < 0.8


@pytest.mark.parametrize("size, length", [(-1e-4, 1.0), (np.nan, 1.0), (np.inf, 1.0), (1e-4, -1.0), (1e-4, np.nan),
                                          (1e-4, np.inf), (1e-4, 0.99 * FINEST_KNOTS * KNOTS)])  # fmt: skip
def test_what_is_no_track(size: float, length: float) -> None:
    with pytest.raises(SrfError):
        FrictionField(size, length)


def test_a_track_without_end_is_refused_with_its_size() -> None:
    with pytest.raises(SrfError, match="to position 1e\\+09 um"):
        FrictionField(1e-4, 1.0).spline(0.0, 1e9)
    long = FrictionField(1e-4, 1e6, 2).spline(0.0, 100.0)  # hardly a change over what is slid
    assert np.ptp(long.coefficients) < 1e-6 and np.isfinite(long.coefficients).all()


# ---- the motion


class Given(Track):
    """The proof's own track, with the values of a spline that scipy evaluates; positions beyond it stay at its ends."""

    def profile(self, longest: float) -> Any:
        spline = FrictionField(self.size, self.length, self.seed).spline(0.0, longest + 1.0)
        pieces = PPoly.from_spline(scipy_spline(spline))
        breaks, coefficients = pieces.x[3:-3], pieces.c[:, 3:-3].T.tolist()
        first, step, last = float(breaks[0]), spline.spacing, len(coefficients) - 1

        def deviation(x: float) -> float:
            i = min(max(int((x - first) / step), 0), last)
            d = x - breaks[i]
            a, b, c, e = coefficients[i]
            return float(((a * d + b) * d + c) * d + e)

        return deviation


@pytest.mark.parametrize("how", ["compiled", "lsoda"])
def test_motion_agrees_with_an_independent_generator(how: str, empty_folder: Path, monkeypatch: Any) -> None:
    """The proof's equations (elastic strain) and solver (VODE) over the same track, at a thousandth of a micron and better."""
    if how == "lsoda":
        monkeypatch.setenv("SRF_CC", "")
    elif compiler() is None:
        pytest.skip("no C compiler")
    compiled.cache_clear(), compiler.cache_clear()
    try:
        c = columns("--drive", "1:10, 1:20", "--W0", "5", "--rate", "100", "--field", "1e-3", "--field-length", "4",
                    "--seed", "7")  # fmt: skip
    finally:
        compiled.cache_clear(), compiler.cache_clear()
    plan = Plan("steady", ((1.0, 10.0), (1.0, 20.0)), 5.0, 0.01)
    rough = move(Physics(track=Given(1e-3, 4.0, 7)), plan)
    smooth = move(Physics(), plan)
    u = c["u"][: rough.t.size]
    assert np.abs(u - rough.u).max() < 1e-3
    assert np.abs(u - rough.u).max() < 0.02 * np.abs(smooth.u - rough.u).max()  # it is the track that is followed


@pytest.mark.parametrize("flags", [(), ("--no-inertia",), ("--interface", "rigid")])
def test_slow_sliding_follows_the_track(flags: tuple[str, ...], empty_folder: Path) -> None:
    """Driven slowly against a long track the friction coefficient is that of steady sliding, plus the track where it is."""
    base = ("--V", "1", "--W0", "3", "--for", "30", "--rate", "10", *flags)
    rough, smooth = columns(*base, "--field", "1e-3", "--field-length", "40", "--seed", "2"), columns(*base)
    slip = rough["t"] + rough["u"][0] - rough["u"]  # but for what the interface gives way
    track = scipy_spline(FrictionField(1e-3, 40.0, 2).spline(0.0, 60.0))
    wander = rough["mu"] - smooth["mu"]
    assert np.ptp(wander) > 3e-4
    assert wander == pytest.approx(track(slip), abs=0.1 * np.ptp(wander))


def test_what_is_recorded_where_the_elongation_follows_from_the_friction(empty_folder: Path) -> None:
    """Without inertia and with rigid contacts u is no state: the gauge shows that of the track, and so do force and friction."""
    field = ("--field", "1e-3", "--field-length", "40", "--seed", "2")
    c = columns("--interface", "rigid", "--no-inertia", "--V", "1", "--W0", "3", "--for", "20", "--rate", "10", "--K", "0.2",
                "--observe", "elongation,force,friction", "--quantum", "1e-9,1e-9,1e-9", *field)  # fmt: skip
    assert np.ptp(c["u"]) > 0.003
    assert c["measured"] == pytest.approx(c["u"], abs=1e-8)
    assert c["force"] == pytest.approx(0.2 * c["u"], abs=1e-8)
    assert c["friction"] == pytest.approx(c["mu"], abs=1e-8)


def test_runs_of_an_experiment_share_the_track_where_they_overlap(empty_folder: Path, shared: Path) -> None:
    """Two runs alike but for their noise slide alike; one that begins further on finds what the first finds there."""
    simulate("--V", "2", "--W0", "3", "--for", "20", "--rate", "50", "--out-dir", "made")
    text = Path("made/experiment.toml").read_text()
    block = text[text.index("[[runs]]") :]
    later = block.replace('"simulated"', '"later"').replace("holdout", "start = 15.0\nholdout")
    Path("made/experiment.toml").write_text(text + "\n" + block.replace('"simulated"', '"twin"') + "\n" + later)
    gauge = ("--field", "5e-4", "--field-length", "6", "--seed", "3")
    simulate("made", *gauge, "--out-dir", "rough")
    simulate("made", *gauge, "--run", "later", "--out-dir", "alone")
    first, twin, moved = read("rough").runs
    assert np.array_equal(first.observed, twin.observed) and moved.start == 15.0
    assert np.array_equal(read("alone").runs[0].observed, moved.observed)
    apart = round(7.5 * 50)  # 15 um at 2 um/s
    both = first.observed[apart:][50:], moved.observed[:-apart][50:]
    assert np.ptp(both[0]) > 0.003
    assert both[1] == pytest.approx(both[0], abs=0.03 * np.ptp(both[0]))


def test_a_track_under_any_program(empty_folder: Path) -> None:
    """A modulated and stepped load, holds, ramps and a start of one's own; the track takes part in what is steady at first."""
    rough = ("--field", "2e-3", "--field-length", "5")
    c = columns("--drive", "0.5:10, 3:0, 1:2->20", "--load", "1:5, 3:7", "--eps", "0.05", "--rate", "200", *rough)
    assert np.isfinite(c["mu"]).all()
    here = float(scipy_spline(FrictionField(2e-3, 5.0, 0).spline(0.0, 1.0))(0.0))
    smooth = columns("--V", "10", "--W0", "5", "--for", "0.1", "--start", "10")["mu"][0]
    for start in ("steady", "10", "v=10"):
        found = columns("--V", "10", "--W0", "5", "--for", "0.1", "--start", start, *rough)
        assert found["mu"][0] == pytest.approx(smooth + here, abs=1e-12)


def test_a_recorded_load_over_a_rough_track(empty_folder: Path) -> None:
    rows = "\n".join(f"{t!r},{5 + 0.2 * math.sin(t)!r}" for t in (np.arange(400) / 100).tolist())
    Path("load.csv").write_text(f"time [s],normal_load [N]\n{rows}\n")
    rough, smooth = (columns("--V", "8", "--load-file", "load.csv", "--rate", "50", *more)
                     for more in (("--field", "1e-3"), ()))  # fmt: skip
    assert np.array_equal(rough["W"], smooth["W"]) and 1e-3 < np.abs(rough["u"] - smooth["u"]).max() < 0.2


# ---- what is written


def test_a_folder_reads_back_and_says_what_made_it(empty_folder: Path) -> None:
    arguments = (*STEADY, "--field", "3e-4", "--seed", "4")
    c = columns(*arguments)
    done = simulate(*arguments, "--out-dir", "made", "--out", "t.json")
    assert "Note: track: mu0 varies by 0.0003 (standard deviation) over 10 um" in done.stderr
    run, e = read("made").runs[0], read("made")
    assert np.array_equal(run.observed, c["u"]) and not run.notices
    assert {p.name for p in e.parameters} == {"mu0", "A", "B", "D0", "V0", "Vsat", "lambda"}
    assert e.choice.effects == ()
    side = json.loads(Path("made/experiment.toml.provenance.json").read_text())
    table = json.loads(Path("t.json").read_text())
    assert side["seed"] == 4 and table["meta"]["track"] == {"amplitude": 3e-4, "length_um": 10.0}
    for told in (side["parameters"], table["parameters"]):
        assert told["field_amplitude"] == {"value": 3e-4, "unit": "1", "origin": "flag"}
        assert told["field_length"] == {"value": 10.0, "unit": "um", "origin": "default"}
        assert told["mu0"]["value"] == 0.33 and "start" not in told
    assert set(table["columns"]) == {"t", "V", "W", "u", "v", "phi", "mu", "tau"}


def test_the_seed_makes_the_track_and_units_are_understood(empty_folder: Path) -> None:
    one, same, other = (
        columns(*STEADY, "--field", "3e-4", "--field-length", length, "--seed", seed)["u"]
        for length, seed in (("2", "1"), ("2e-3 mm", "1"), ("2", "2"))
    )
    assert np.array_equal(one, same) and np.abs(one - other).max() > 1e-3


def test_no_field_changes_no_byte(empty_folder: Path) -> None:
    arguments = ("--drive", "1:10, 1:20", "--W0", "5", "--rate", "100", "--noise", "0.02", "--seed", "2")
    for folder, more in (("plain", ()), ("zero", ("--field", "0")), ("long", ("--field", "0", "--field-length", "3"))):
        simulate(*arguments, *more, "--out-dir", folder, "--out", f"{folder}.json")
        simulate("plain", *more, "--out-dir", f"{folder}-again")
    for name in ("zero", "long"):
        assert Path(f"{name}.json").read_bytes() == Path("plain.json").read_bytes()
        for file in ("experiment.toml", "simulated.csv"):
            assert (Path(name) / file).read_bytes() == (Path("plain") / file).read_bytes()
            assert (Path(f"{name}-again") / file).read_bytes() == (Path("plain-again") / file).read_bytes()


@pytest.mark.parametrize("effect, change, column", [
    ("load-transmission", "rho=0.8", "u"), ("track-topography", "amplitude=0.01", "u"),
    ("sensor-lag", "time_constant=0.05", "measured"),
])  # fmt: skip
def test_an_experiment_with_effects_is_simulated_as_it_is_fitted(
    empty_folder: Path, shared: Path, effect: str, change: str, column: str
) -> None:
    """Where a run begins and how its load is modulated reach the effects, and a gauge that lags is the one that is read."""
    from dataclasses import asdict

    from srfcli.codegen.model import open_model
    from srfcli.inference.prediction import predict

    shutil.copytree(shared / "cases" / "open-01", "case")
    path = Path("case/experiment.toml")
    text = re.sub(r'(file\s*= "strong.csv")', r"\1\nstart = 13.0", path.read_text())
    path.write_text(text.replace("[model]\n", f"[model]\neffects = ['{effect}']\n"))
    experiment = read("case")
    model = open_model(load_registry(), **asdict(experiment.choice))
    run = next(r for r in experiment.runs if r.name == "strong")
    name, value = change.split("=")
    expected = predict(model, experiment, run, {name: float(value)}, rtol=1e-8).y
    found = columns("case", "--run", "strong", "--set", change, *(("--quantum", "1e-9") if column == "measured" else ()))
    assert found[column] == pytest.approx(expected, abs=2e-5)
