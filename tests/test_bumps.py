"""Bumps of a track: found where they are, and not in what is merely rough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from srfcli.codegen.splines import Spline
from srfcli.inference.random_field import Point, Roughness, Tracks, likeliest_bump

LENGTH, NOISE = 40.0, 2e-4  # um, and what mu0 is known to by each of three samples per um


def point(rng, *, amplitude=2e-4, length=6.0, bump=0.0, runs=1, slid=LENGTH - 0.5):
    """Return a linear problem: mu0 along the track is seen with noise, and with a level and a slope that nobody knows."""
    spline = Spline.over(0.0, LENGTH, 0.8)
    rough = Roughness(amplitude, length)
    truth = rough.root(spline.nodes) @ rng.standard_normal(spline.numbers.size)
    truth = truth + bump * np.exp(-0.5 * ((spline.nodes - 21.3) / 1.4) ** 2)
    x = np.linspace(0.5, slid, 120)
    B = np.zeros((x.size, spline.numbers.size))
    for k in range(spline.numbers.size):
        B[:, k] = spline.with_numbers(np.eye(spline.numbers.size)[k])(x)
    J = np.hstack([np.ones((x.size, 1)), (x[:, None] - 20) / 20, B]) / NOISE
    y = J @ np.concatenate([[3e-3, -1e-3], truth]) + rng.standard_normal(x.size)
    tracks = Tracks((spline.with_numbers(np.zeros(spline.numbers.size)),) * runs, {})
    return Point(np.zeros(2), tracks, Roughness(amplitude, length), {}, J.T @ J, J.T @ y, float(y @ y), 0.0)


def test_a_bump_is_found_where_it_is():
    """Place to half a micrometre, height to a quarter, at any slope and level."""
    found = [
        likeliest_bump(point(np.random.default_rng(seed), bump=sign * 2e-3)) for seed in range(8) for sign in (-1, 1)
    ]
    for k, bump in enumerate(found):
        assert bump is not None and bump.p_value < 1e-4
        assert bump.place == pytest.approx(21.3, abs=1.0)
        assert bump.height == pytest.approx((-1, 1)[k % 2] * 2e-3, rel=0.4)


@pytest.mark.parametrize("length", [2.5, 6.0, 15.0])
def test_a_rough_track_has_none(length):
    """Of sixty tracks none is doubted at 1e-4, and one in ten or fewer is at 0.05."""
    p = []
    for seed in range(60):
        bump = likeliest_bump(point(np.random.default_rng(seed), length=length))
        p.append(bump.p_value if bump is not None else 1.0)
    assert min(p) > 1e-4
    assert np.mean(np.array(p) < 0.05) <= 0.1


def test_where_nothing_slid_there_is_no_bump():
    """What rounding leaves of the information there would make one of any height."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        seen = point(rng, slid=20.0)
        wrong = 1e-13 * seen.N.max() * rng.standard_normal(seen.N.shape)
        off = 1e-12 * np.abs(seen.g).max() * rng.standard_normal(seen.g.shape)
        bump = likeliest_bump(replace(seen, N=seen.N + wrong + wrong.T, g=seen.g + off))
        assert bump is None or (abs(bump.height) < 1e-2 and bump.place < 25.0)


def test_tracks_of_their_own_are_not_asked():
    assert likeliest_bump(point(np.random.default_rng(0), bump=2e-3, runs=2)) is None
