"""Rough tracks: the prior, the marginal likelihood against brute force, and a recording of which the truth is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from srfcli.codegen.splines import Spline
from srfcli.data.experiment import read_experiment
from srfcli.inference.random_field import AMPLITUDES, LENGTHS, Roughness, Tracks, marginal
from srfcli.inference.recordings import fit_recordings
from srfcli.laws.registry import load_registry


def test_prior_is_the_matern_covariance() -> None:
    nodes = np.linspace(0.0, 12.0, 25)
    L = Roughness(3e-4, 2.0).root(nodes)
    d = np.sqrt(3) * np.abs(nodes[:, None] - nodes) / 2.0
    np.testing.assert_allclose(L @ L.T, 9e-8 * (1 + d) * np.exp(-d), rtol=1e-6, atol=1e-14)


def _linear(amplitude: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, Tracks]:
    """A linear problem r = J theta + C c + noise of variance 1 on two tracks; returns r, J, C and the tracks."""
    rng = np.random.default_rng(seed)
    tracks = Tracks((Spline.over(0.0, 15.0, 0.8), Spline.over(0.0, 20.0, 0.8)), {"a": 0, "b": 1})
    n, m = 400, tracks.numbers.size
    J, C = rng.normal(size=(n, 2)), np.zeros((n, m))
    k = tracks.splines[0].numbers.size
    C[:200, :k] = 2e4 * tracks.splines[0].design(np.linspace(0, 15, 200))
    C[200:, k:] = 2e4 * tracks.splines[1].design(np.linspace(0, 20, 200))
    c = tracks.root(Roughness(amplitude, LENGTHS[1])) @ rng.normal(size=m) if amplitude else np.zeros(m)
    return J @ [1.0, -2.0] + C @ c + rng.normal(size=n), J, C, tracks


def _whole(r: np.ndarray, J: np.ndarray, C: np.ndarray, tracks: Tracks, roughness: Roughness) -> float:
    """The log likelihood with parameters and track integrated out, from the covariance of all samples."""
    L = tracks.root(roughness) if roughness.amplitude else np.zeros((tracks.numbers.size, 1))
    S = np.eye(r.size) + C @ L @ L.T @ C.T
    W = np.linalg.solve(S, np.column_stack([J, r]))
    rest = r - J @ np.linalg.solve(J.T @ W[:, :2], J.T @ W[:, 2])
    flat = 0.5 * np.linalg.slogdet(J.T @ J)[1] - 0.5 * np.linalg.slogdet(J.T @ W[:, :2])[1]  # integrated out, too
    return flat - 0.5 * float(rest @ np.linalg.solve(S, rest)) - 0.5 * np.linalg.slogdet(S)[1]


def test_marginal_likelihood_is_that_of_the_whole_covariance() -> None:
    r, J, C, tracks = _linear(1e-4, 1)
    A = np.column_stack([J, C])
    base = -0.5 * float(r @ r)
    found = marginal(A.T @ A, A.T @ r, [0, 1], range(2, A.shape[1]), tracks, base)
    best = max(_whole(r, J, C, tracks, Roughness(a, length)) for length in LENGTHS for a in AMPLITUDES)
    assert found.log_likelihood == pytest.approx(best, abs=1e-5)
    assert 0.3e-4 < found.roughness.amplitude < 3e-4


@pytest.mark.parametrize("own", [Roughness(5e-4, 6.0), Roughness(2e-5, 0.5)], ids=["coarse", "finer than its knots"])
def test_marginal_likelihood_of_one_roughness_is_its_own_and_not_a_better_one_s(own: Roughness) -> None:
    r, J, C, tracks = _linear(1e-4, 1)
    A = np.column_stack([J, C])
    grid = np.array([own.length]), np.array([own.amplitude])
    found = marginal(A.T @ A, A.T @ r, [0, 1], range(2, A.shape[1]), tracks, -0.5 * float(r @ r), grid=grid)
    assert found.log_likelihood == pytest.approx(_whole(r, J, C, tracks, own), abs=1e-5)
    assert found.roughness == own


def test_no_roughness_is_found_where_there_is_none() -> None:
    r, J, C, tracks = _linear(0.0, 2)
    A = np.column_stack([J, C])
    found = marginal(A.T @ A, A.T @ r, [0, 1], range(2, A.shape[1]), tracks, -0.5 * float(r @ r))
    assert found.log_likelihood - found.smooth < 4.0


@pytest.mark.slow
def test_parameters_survive_a_rough_track(shared: Path) -> None:
    """Without the track they are off by up to 42 standard errors."""
    registry = load_registry()
    experiment = read_experiment(shared / "cases" / "open-07", registry=registry)
    truth = json.loads((shared / "cases" / "truth.json").read_text())["open-07"]["parameters"]
    fitted = fit_recordings(registry, experiment)
    found = fitted.fit
    assert fitted.track is not None and 2e-4 < fitted.track.amplitude < 5e-4 and not fitted.track.shared
    assert found.rms_over_noise() == pytest.approx(1.0, abs=0.03)
    for name, value in found.values.items():
        assert abs(value - truth[{"lambda": "lam"}.get(name, name)]) < 4 * found.stderr[name]
