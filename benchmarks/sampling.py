"""Draws of a posterior: how many independent ones an evaluation of the likelihood yields, ours against the moves of emcee.

    python benchmarks/sampling.py [--draws N]

Targets: a Gaussian of condition number 1e4; ridges bent as Rosenbrock's, x1 ~ N(0, 1), x2 ~ N(b (x1^2 - 1), 0.3^2), the others
N(0, 1), turned at random; and two fits with the recordings' own likelihood, a simulated pair of velocity steps whose mu0 and Vsat
lie on a curved ridge, and (with ../shared) a step of p655 in which A, B, D0 and the stiffness trade off. All samplers start
from the maximum and its covariance, in the same coordinates; emcee's moves are given the burn-in that ours took. `off` is the
error of the mean in standard errors, the worst parameter's; `spread` the smallest ratio of a standard deviation to the true one.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import emcee
import numpy as np
from click.testing import CliRunner
from common import ROOT, Report  # first: it fixes the number of threads
from numpy.typing import NDArray

import srfcli as srf
from srfcli.cli.main import cli
from srfcli.inference import posterior
from srfcli.inference.posterior import Posterior, draw

Array = NDArray[np.float64]
SEEDS = 3


@dataclass(frozen=True)
class Target:
    """A log posterior, its maximum with covariance and bounds, and mean and standard deviations where they are known."""

    name: str
    log_posterior: Callable[[Array], float]
    best: Array
    covariance: Array
    lower: Array
    upper: Array
    mean: Array | None = None
    sd: Array | None = None


def gaussian(k: int, condition: float) -> Target:
    turn, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((k, k)))
    sd = np.logspace(0, -np.log10(condition) / 2, k)
    precision, covariance = turn / sd**2 @ turn.T, turn * sd**2 @ turn.T
    return Target(
        f"Gaussian, k = {k}", lambda x: float(-0.5 * x @ precision @ x), np.zeros(k), covariance, np.full(k, -1e3),
        np.full(k, 1e3), np.zeros(k), np.sqrt(np.diag(covariance)),
    )  # fmt: skip


def ridge(k: int, bend: float) -> Target:
    turn, _ = np.linalg.qr(np.random.default_rng(2).standard_normal((k, k)))

    def log_posterior(y: Array) -> float:
        x = turn.T @ y
        return float(-0.5 * (x[0] ** 2 + ((x[1] - bend * (x[0] ** 2 - 1)) / 0.3) ** 2 + np.sum(x[2:] ** 2)))

    mode, near, whole = np.zeros(k), np.ones(k), np.ones(k)
    mode[1], near[1], whole[1] = -bend, 0.3**2, 2 * bend**2 + 0.3**2
    return Target(
        f"ridge, k = {k}, b = {bend}", log_posterior, turn @ mode, turn * near @ turn.T, np.full(k, -1e3), np.full(k, 1e3),
        np.zeros(k), np.sqrt(np.diag(turn * whole @ turn.T)),
    )  # fmt: skip


def of_fit(name: str, folder: Path, **options: str) -> Target:
    found = srf.fit(srf.read_experiment(folder), **options).found  # type: ignore[arg-type]
    with patch.object(posterior, "draw", lambda *given, **more: given):  # what `sample` would draw from
        log_posterior, _, best, covariance, (lower, upper), _ = posterior.sample(found.state_space, 1)
    best, covariance = posterior._inside(log_posterior, best, covariance, (lower, upper))  # as ours begins
    return Target(name, log_posterior, best, covariance, lower, upper)


def simulated(folder: Path) -> Target:
    for command in (
        "simulate --law srf-vsat --ageing dieterich --interface rigid --no-inertia --K 0.21:N/um --W0 5 "
        "--drive 20:1,20:10,10:100 --rate 10 --observe force --noise 0.02 --seed 3 --out-dir made",
        "new made/simulated.csv --stiffness 0.21:N/um --law srf-vsat",
    ):
        done = CliRunner().invoke(cli, [a.replace(":N", " N") for a in command.split()], prog_name="srf")
        assert done.exit_code == 0, done.output
    return of_fit("velocity steps, srf-vsat", folder, track="smooth")


P655 = """format = "srf-experiment/1"
apparatus = {{ stiffness = "1.6e-3 1/um" }}
model = {{ law = "dieterich-ruina", ageing = "ruina", interface = "rigid", inertia = false }}
[parameters]
mu0 = {{ value = 0.487, lower = 0.1, upper = 0.9 }}
A = {{ value = 0.006, lower = 0.001, upper = 0.03 }}
B = {{ value = 0.005, lower = 0.0005, upper = 0.03 }}
D0 = {{ value = 15.0, lower = 1.0, upper = 100.0 }}
V0 = {{ value = 2.286, fixed = true }}
K = {{ value = 1.6e-3, lower = 5e-4, upper = 5e-2 }}
[columns]
time = {{ name = "time_s", unit = "s" }}
load_point_displacement = {{ name = "lp_disp_um", unit = "um" }}
normal_stress = {{ name = "normal_stress_MPa", unit = "MPa" }}
friction = "friction"
[[runs]]
name = "step"
file = "{file}"
window = [3846.0, 3862.0]
"""


def of_emcee(target: Target, moves: list[tuple[emcee.moves.Move, float]], ours: Posterior, seed: int) -> Posterior:
    """Return as many draws as ours after as long a burn-in, in the same coordinates, by moves of emcee alone."""
    t, (steps, chains, k) = target, ours.chains.shape
    scale = posterior._straight(t.log_posterior, t.best, t.covariance, t.lower)

    def log_density(y: Array) -> float:
        theta = scale.inverse_transform(y)
        return t.log_posterior(theta) + float(np.sum(np.log(theta[scale.logarithmic])))

    over = np.where(scale.logarithmic, t.best, 1.0)
    root = np.linalg.cholesky(t.covariance / np.outer(over, over))
    start = scale.transform(t.best) + np.random.default_rng(seed).standard_normal((chains, k)) @ root.T
    sampler = emcee.EnsembleSampler(chains, k, log_density, moves=moves)
    sampler._random = np.random.RandomState(seed)
    sampler.run_mcmc(start, ours.burn_in + steps)
    found = scale.inverse_transform(sampler.get_chain(discard=ours.burn_in))
    return Posterior(ours.names, found, ours.burn_in, float(np.mean(sampler.acceptance_fraction)))


def row(target: Target, name: str, made: list[Posterior]) -> list[str]:
    """Return medians over the seeds."""
    share, worth, mixed, off, spread = [], [], [], [], []
    for p in made:
        least = float(p.effective.min())
        share.append(least / len(p.draws))
        worth.append(least / (len(p.draws) + p.burn_in * p.chains.shape[1]))
        mixed.append(float(p.r_hat.max()))
        if target.mean is not None and target.sd is not None:
            off.append(float(np.max(np.abs(p.draws.mean(axis=0) - target.mean) / target.sd * np.sqrt(p.effective))))
            spread.append(float(np.min(p.draws.std(axis=0) / target.sd)))
    cells = [f"{np.median(x):.3f}" for x in (share, worth, mixed)]
    cells += [f"{np.median(x):.2f}" if x else "" for x in (off, spread)]
    return [target.name, name, f"{np.median([p.burn_in for p in made]):.0f}", *cells]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=4000)
    count = parser.parse_args().draws
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        targets = [gaussian(6, 1e4), ridge(2, 1.0), ridge(6, 0.5), ridge(6, 1.0), simulated(Path(place))]
        file = Path(os.environ.get("SRF_SHARED", ROOT.parent / "shared")) / "data/psu-p655-ghost-rocks/p655_reduced.csv"
        if file.exists():
            folder = Path(place) / "p655"
            folder.mkdir()
            (folder / "experiment.toml").write_text(P655.format(file=file), encoding="utf-8")
            targets.append(of_fit("p655, K free", folder, trend="slip"))
        report = Report("sampling", __doc__ or "")
        report.say(f"# {count} draws, medians of {SEEDS} seeds, the worst parameter")
        rows = []
        for t in targets:
            names = tuple(f"x{i}" for i in range(t.best.size))
            ours = [draw(t.log_posterior, names, t.best, t.covariance, (t.lower, t.upper), count, seed=s) for s in range(SEEDS)]
            rows.append(row(t, "srf", ours))
            for name, moves in (
                ("stretch", [(emcee.moves.StretchMove(), 1.0)]),
                ("DE, snooker", [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]),
            ):
                rows.append(row(t, name, [of_emcee(t, moves, p, s) for s, p in enumerate(ours)]))
        report.table(["target", "sampler", "burn-in", "ESS/draw", "ESS/eval", "R-hat", "off", "spread"], rows)


if __name__ == "__main__":
    main()
