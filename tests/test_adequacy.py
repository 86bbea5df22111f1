"""Whether noise is all that a fit leaves over: p-values where the noise's colour is only estimated, and what they must see."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from srfcli.data.values import Run
from srfcli.diagnosis.goodness_of_fit import DOUBT, alike, gauge_noise, judge_residuals
from srfcli.inference.noise import Noise
from srfcli.motion.imposed import ConstantLoad, Drive

SIZES = (2125, 1375, 3000)


def runs_of(sizes, step=0.004):
    """Return runs whose residuals are made up: what was driven does not matter."""
    return [
        Run(f"r{k}", Path("x"), False, 0.0, "steady", step * np.arange(n), np.zeros(n), "elongation", np.ones(n, dtype=bool),
            Drive.steps([(0.0, 10.0)]), ConstantLoad(7.0), 0.21, None, 0.0, ())
        for k, n in enumerate(sizes)
    ]  # fmt: skip


def red(rng, n, rho, level=0.02):
    """Return noise of this level and correlation from sample to sample."""
    return level * np.sqrt(1 - rho**2) * lfilter([1.0], [1.0, -rho], rng.standard_normal(n + 300))[300:]


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_p_values_of_noise_are_what_they_say_although_its_colour_is_estimated(rho):
    """In a hundred draws a tenth, or with much colour up to a quarter, are below 0.1, and none is doubted."""
    rng, runs = np.random.default_rng(int(100 * rho)), runs_of(SIZES)
    found = []
    for _ in range(100):
        residuals = {r.name: red(rng, r.t.size, rho) for r in runs}
        found.append(judge_residuals(runs, residuals, gauge_noise(runs, residuals)))
    p = np.array([a.p_value for a in found])
    assert 0.02 <= np.mean(p < 0.1) <= 0.25
    assert 0.35 <= np.median(p) <= 0.65
    assert p.min() > DOUBT
    assert all(a.fine for a in found)


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_the_gauge_is_that_of_all_runs_which_chance_does_not_part(rho):
    """Level within 3 %, correlation within 0.02 on average: the quietest run alone would look too white and too quiet."""
    rng, runs = np.random.default_rng(7), runs_of(SIZES)
    found = [gauge_noise(runs, {r.name: red(rng, r.t.size, rho) for r in runs})["r0"] for _ in range(60)]
    assert np.mean([n.level for n in found]) == pytest.approx(0.02, rel=0.03)
    assert np.mean([sum(n.coefficients) for n in found]) == pytest.approx(rho, abs=0.02)


@pytest.mark.parametrize(("rho", "size"), [(0.0, 0.5), (0.5, 0.8), (0.8, 1.6)])
def test_what_is_slower_than_noise_is_seen(rho, size):
    """A wave of 1.5 s in one of the runs, of some half to one and a half times the noise, is not taken for noise."""
    rng, runs = np.random.default_rng(3), runs_of(SIZES)
    residuals = {r.name: red(rng, r.t.size, rho) for r in runs}
    residuals["r2"] = residuals["r2"] + size * 0.02 * np.sqrt(2) * np.sin(2 * np.pi * runs[2].t / 1.5)
    found = judge_residuals(runs, residuals, gauge_noise(runs, residuals))
    assert not found.fine
    assert found.p_values["r2"] < 1e-3 < min(found.p_values["r0"], found.p_values["r1"])


def test_a_noisier_run_is_no_gauge_of_the_others():
    """Twice the noise in one run leaves the others' level as it is."""
    rng, runs = np.random.default_rng(1), runs_of(SIZES)
    residuals = {r.name: red(rng, r.t.size, 0.3) * (2 if r.name == "r1" else 1) for r in runs}
    assert gauge_noise(runs, residuals)["r0"].level == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize(
    ("size", "unused"),
    [
        (400, [(100, 230)]),  # one stretch, over two of the pieces in which noise is looked for
        (2125, [(0, 700), (1500, 1900)]),
        (2125, [(k, k + 1) for k in range(20, 2125, 50)]),  # hardly a piece without one
        (2125, [(k, k + 5) for k in range(20, 2125, 50)]),
        (2125, [(k, k + 1) for k in np.flatnonzero(np.random.default_rng(1).random(2125) < 0.1).tolist()]),
        (2125, [(k, k + 1) for k in range(0, 2125, 2)]),  # a slower channel
        (130, [(0, 100)]),
        (2125, [(0, 2125)]),  # nothing of it is used
    ],
)
def test_what_is_not_used_is_no_calm_stretch(size, unused):
    """A line across a gap has no noise at all: that is no gauge of the rest."""
    rng, (whole, other) = np.random.default_rng(8), runs_of((size, 3000))
    residuals = {r.name: red(rng, r.t.size, 0.0) for r in (whole, other)}
    used = whole.used.copy()
    for a, b in unused:
        used[a:b] = False
        residuals["r0"][a:b] = np.nan
    found = gauge_noise([replace(whole, used=used), other], residuals)
    assert found["r1"].level == pytest.approx(0.02, rel=0.05)
    if used.sum() > 200:
        alone = gauge_noise([replace(whole, used=used)], residuals)
        assert alone["r0"].level == pytest.approx(0.02, rel=0.1)


def test_noises_are_alike_within_what_matters():
    noise = Noise(0.02, (0.5,), 0.0231)
    assert alike(noise, Noise(0.02003, (0.501,), 0.0231))
    assert not alike(noise, Noise(0.0203, (0.5,), 0.0231))
    assert not alike(noise, Noise(0.02, (0.51,), 0.0231))
    assert not alike(noise, Noise(0.02, (0.5,), 0.0231, ((0, noise), (10, noise))))
