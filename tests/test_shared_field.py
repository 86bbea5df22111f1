"""Rough tracks: the prior, the marginal likelihood against brute force, and a recording of which the truth is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline
from test_splines import knots

from srfcli.codegen.splines import Spline
from srfcli.data.experiment import read_experiment
from srfcli.inference.recordings import fit_recordings
from srfcli.inference.shared_field import AMPLITUDES, LENGTHS, FieldPrior, marginal
from srfcli.laws.registry import load_registry

Grid = tuple[np.ndarray, np.ndarray]
GRID = (120 * LENGTHS, AMPLITUDES)  # on a track of 120 um


def test_prior_is_the_matern_covariance() -> None:
    nodes = np.linspace(0.0, 12.0, 25)
    L = FieldPrior(3e-4, 2.0).root(nodes)
    d = np.sqrt(3) * np.abs(nodes[:, None] - nodes) / 2.0
    np.testing.assert_allclose(L @ L.T, 9e-8 * (1 + d) * np.exp(-d), rtol=1e-6, atol=1e-14)


def _linear(amplitude: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, Spline]:
    """A linear problem r = J theta + C c + noise of variance 1 on a track; returns r, J, C and the track."""
    rng = np.random.default_rng(seed)
    track = Spline.over(0.0, 30.0, 0.8)
    n, m = 400, track.coefficients.size
    J, C = rng.normal(size=(n, 2)), 2e4 * BSpline.design_matrix(np.linspace(0, 30, n), knots(track), 3).toarray()
    c = FieldPrior(amplitude, 120 * LENGTHS[1]).root(track.nodes) @ rng.normal(size=m) if amplitude else np.zeros(m)
    return J @ [1.0, -2.0] + C @ c + rng.normal(size=n), J, C, track


def _whole(r: np.ndarray, J: np.ndarray, C: np.ndarray, track: Spline, field: FieldPrior) -> float:
    """The log likelihood with parameters and track integrated out, from the covariance of all samples."""
    L = field.root(track.nodes) if field.amplitude else np.zeros((track.coefficients.size, 1))
    S = np.eye(r.size) + C @ L @ L.T @ C.T
    W = np.linalg.solve(S, np.column_stack([J, r]))
    rest = r - J @ np.linalg.solve(J.T @ W[:, :2], J.T @ W[:, 2])
    flat = 0.5 * np.linalg.slogdet(J.T @ J)[1] - 0.5 * np.linalg.slogdet(J.T @ W[:, :2])[1]  # integrated out, too
    return flat - 0.5 * float(rest @ np.linalg.solve(S, rest)) - 0.5 * np.linalg.slogdet(S)[1]


def _marginal(r: np.ndarray, J: np.ndarray, C: np.ndarray, track: Spline, grid: Grid = GRID) -> tuple[float, FieldPrior]:
    A = np.column_stack([J, C])
    return marginal(A.T @ A, A.T @ r, 2, track, -0.5 * float(r @ r), grid)


def test_marginal_likelihood_is_that_of_the_whole_covariance() -> None:
    problem = _linear(1e-4, 1)
    found, field = _marginal(*problem)
    best = max(_whole(*problem, FieldPrior(a, length)) for length in GRID[0] for a in AMPLITUDES)
    assert found == pytest.approx(best, abs=1e-5)
    assert 0.3e-4 < field.amplitude < 3e-4


@pytest.mark.parametrize("own", [FieldPrior(5e-4, 6.0), FieldPrior(2e-5, 0.5)], ids=["coarse", "finer than its knots"])
def test_marginal_likelihood_of_one_field_is_its_own_and_not_a_better_one_s(own: FieldPrior) -> None:
    problem = _linear(1e-4, 1)
    found = _marginal(*problem, (np.array([own.length]), np.array([own.amplitude])))
    assert found == (pytest.approx(_whole(*problem, own), abs=1e-5), own)


def test_no_field_is_found_where_there_is_none() -> None:
    problem = _linear(0.0, 2)
    found, _ = _marginal(*problem)
    assert found - _whole(*problem, FieldPrior()) < 4.0


@pytest.mark.slow
def test_parameters_survive_a_rough_track(shared: Path) -> None:
    """Without the track they are off by up to 42 standard errors."""
    registry = load_registry()
    experiment = read_experiment(shared / "cases" / "open-07", registry=registry)
    truth = json.loads((shared / "cases" / "truth.json").read_text())["open-07"]["parameters"]
    fitted = fit_recordings(registry, experiment)
    found = fitted.fit
    assert (
        fitted.friction_field is not None and 2e-4 < fitted.friction_field.amplitude < 5e-4 and not fitted.friction_field.shared
    )
    assert found.rms_over_noise() == pytest.approx(1.0, abs=0.03)
    for name, value in found.values.items():
        assert abs(value - truth[{"lambda": "lam"}.get(name, name)]) < 4 * found.stderr[name]
