"""What draws of a posterior are worth: against chains whose correlation is known, against ArviZ, and as `srf fit` prints it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from recording_cases import TOML, write

from srfcli.cli.main import cli
from srfcli.inference.posterior import Posterior, draw, effective_size

pytestmark = pytest.mark.usefixtures("empty_folder")


def ar1(phi: float, steps: int = 4000, chains: int = 8, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = np.empty((steps, chains, 1))
    x[0] = rng.standard_normal((chains, 1))
    for i in range(1, steps):
        x[i] = phi * x[i - 1] + np.sqrt(1 - phi**2) * rng.standard_normal((chains, 1))
    return x


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_the_effective_size_of_a_chain_with_known_correlation(phi: float) -> None:
    chains = ar1(phi)
    exact = chains.size * (1 - phi) / (1 + phi)
    assert effective_size(chains)[0] == pytest.approx(exact, rel=0.12)
    assert Posterior(("x",), chains, 0, 0.5).r_hat[0] == pytest.approx(1.0, abs=0.01)


def test_chains_that_disagree_are_told() -> None:
    chains = ar1(0.5, steps=400) + np.linspace(-2, 2, 8)[None, :, None]
    found = Posterior(("x",), chains, 0, 0.5)
    assert found.r_hat[0] > 1.3
    assert found.effective[0] < 40


def test_it_agrees_with_arviz() -> None:
    arviz = pytest.importorskip("arviz", reason="ARVIZ ABSENT: its effective sample sizes are not compared")
    chains = ar1(0.8, steps=600)
    found = Posterior(("x",), chains, 0, 0.5)
    data = arviz.from_dict(posterior={"x": chains[:, :, 0].T})
    assert found.effective[0] == pytest.approx(float(arviz.ess(data, method="mean")["x"]), rel=0.05)
    assert found.r_hat[0] == pytest.approx(float(arviz.rhat(data, method="split")["x"]), rel=0.01)


def test_a_curved_ridge_is_sampled() -> None:
    """x1 ~ N(0, 1), x2 ~ N((x1^2 - 1)/2, 0.3^2), four others: stretch moves with Gaussian proposals yield 0.04 a draw."""
    pytest.importorskip("emcee", reason="EMCEE ABSENT: nothing can be drawn")
    k = 6
    turn, _ = np.linalg.qr(np.random.default_rng(2).standard_normal((k, k)))

    def log_posterior(y: np.ndarray) -> float:
        x = turn.T @ y
        return float(-0.5 * (x[0] ** 2 + ((x[1] - (x[0] ** 2 - 1) / 2) / 0.3) ** 2 + np.sum(x[2:] ** 2)))

    mode, near, whole = np.zeros(k), np.ones(k), np.ones(k)
    mode[1], near[1], whole[1] = -0.5, 0.3**2, 0.5 + 0.3**2
    wide, names = np.full(k, 1e3), tuple("abcdef")
    sd, worth = np.sqrt(np.diag(turn * whole @ turn.T)), []
    for seed in range(3):
        found = draw(log_posterior, names, turn @ mode, turn * near @ turn.T, (-wide, wide), 4000, seed=seed)
        worth.append(found.effective.min() / len(found.draws))
        assert found.draws.std(axis=0) == pytest.approx(sd, rel=0.25)
        assert np.all(np.abs(found.draws.mean(axis=0)) < 4 * sd / np.sqrt(found.effective))
    assert np.median(worth) > 0.08


def test_a_parameter_at_its_bound_is_sampled() -> None:
    """The fit leaves it without a standard error; its posterior falls from the bound as exp(-x / 0.02)."""
    pytest.importorskip("emcee", reason="EMCEE ABSENT: nothing can be drawn")
    covariance, bounds = np.diag([0.0, 1.0]), (np.array([0.0, -50.0]), np.array([1.0, 50.0]))

    def log_posterior(x: np.ndarray) -> float:
        inside = np.all((x > bounds[0]) & (x < bounds[1]))
        return float(-x[0] / 0.02 - 0.5 * x[1] ** 2) if inside else -np.inf

    found = draw(log_posterior, ("at", "free"), np.zeros(2), covariance, bounds, 8000)
    assert found.draws.mean(axis=0) == pytest.approx([0.02, 0.0], abs=0.1)
    assert found.draws[:, 0].mean() == pytest.approx(0.02, rel=0.15)


def test_fit_prints_what_its_draws_are_worth(tmp_path: Path) -> None:
    pytest.importorskip("emcee", reason="EMCEE ABSENT: nothing can be drawn")
    folder = tmp_path / "small"
    folder.mkdir()
    write(folder, toml=TOML.partition('[[runs]]\nname = "two"')[0])  # only A is fitted
    done = CliRunner().invoke(cli, ["fit", str(folder), "--track", "smooth", "--sample", "300", "--json"], prog_name="srf")
    assert done.exit_code in (0, 3), done.stderr
    found = json.loads(done.stdout)
    draws = found["meta"]["posterior"]
    assert len(draws["draws"]) >= 300 and draws["burn_in"] >= 50
    note = next(n for n in found["notes"] if n.startswith("posterior: "))
    assert "steps of burn-in, worth" in note and "R-hat up to" in note
    assert any("intervals should rest on 400 independent draws" in n for n in found["notes"])
    row = found["rows"][0]
    value, error = row["value"], row["stderr"]
    assert abs(np.mean(draws["draws"]) - value) < 4 * error


def test_draws_are_kept_only_where_some_are_made(tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["fit", str(tmp_path), "--draws", "x.nc"], prog_name="srf")
    assert done.exit_code == 2


def test_too_few_steps_are_told() -> None:
    from srfcli.results.fit import posterior_notes

    few = Posterior(("x",), ar1(0.5, steps=5), 2, 0.5, interrupted=True)
    assert "too few steps to tell" in posterior_notes(few)[0]
    assert "interrupted" in posterior_notes(few)[1]
