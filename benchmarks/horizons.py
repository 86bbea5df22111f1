"""Fits on a rough track from parameters that are off: all of the recordings at once, and by horizons that grow.

For cases of the independent generator with nothing concealed and a rough track: each parameter is put off by a random share, as
large as is said, up or down, and fitted from there in both ways, the track smooth at first and the same for all runs. A fit has
found the minimum where its log likelihood is within 5 of the best that any fit of the case has. CPU times are of one run.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import Report

from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.diagnosis.staged_search import Search, grow, whole
from srfcli.inference.fit import Problem
from srfcli.inference.random_field import LatentFit, fit_latent, tracks_for
from srfcli.laws.registry import bundled_registry
from srfcli.validation.cases import make_case

OFF = (0.02, 0.05, 0.1)
FOUND = 5.0  # in log likelihood


def ways(search: Search) -> dict[str, Callable[[Problem], LatentFit]]:
    """Return the two ways to fit a problem from its start."""

    def at_once(problem: Problem) -> LatentFit:
        tracks = tracks_for(problem.runs, shared=True)
        return fit_latent(problem, problem.start, search.noise, tracks=tracks, known_noise=True)

    def grown(problem: Problem) -> LatentFit:
        tracks = tracks_for(problem.runs, shared=True)
        return whole(problem, grow(problem, tracks, search.noise, tied=problem.names), search.noise)

    return {"at once": at_once, "by horizons": grown}


def main() -> None:
    """Print how often each way finds the minimum, and what it takes."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--cases", type=int, default=2)
    asked.add_argument("--starts", type=int, default=3)
    asked.add_argument("--seed", type=int, default=11)
    options = asked.parse_args()
    report, registry, rng = Report("horizons", __doc__ or ""), bundled_registry(), np.random.default_rng(options.seed)
    rows, best = [], dict[int, float]()
    for case in range(options.cases):
        folder = Path(tempfile.mkdtemp()) / "case"
        truth = make_case(folder, options.seed + case, effects=(), size=0.5, rough=True, strengths=False)
        search = Search(registry, read_experiment(folder, registry=registry, holdout=False))
        runs = search.experiment.runs
        problem = search.problem(Hypothesis(), rough=True)
        search.noise = search.gauged(runs, {r.name: r.observed for r in runs})
        physics = truth["physics"]
        true = np.array([physics[{"lambda": "lam"}.get(n, n)] for n in problem.names])
        track = physics["track"]
        report.say(f"case {case}: a track rough by {track['size']:.1e}, correlated over {track['length']:.0f} um")
        for off in OFF:
            for _ in range(options.starts):
                start = true * (1 + off * rng.uniform(-1, 1, true.size))
                displaced = replace(problem, start=np.clip(start, problem.lower, problem.upper))
                for way, fitted in ways(search).items():
                    begun = time.process_time()
                    found = fitted(displaced)
                    rows.append((case, off, way, found.log_likelihood, time.process_time() - begun))
                    best[case] = max(best.get(case, -np.inf), found.log_likelihood)
    head = ("off by up to", "way", "found", "of", "CPU, median (s)", "worst log likelihood below the best")
    table = []
    for off in OFF:
        for way in ("at once", "by horizons"):
            here = [r for r in rows if r[1:3] == (off, way)]
            short = [best[r[0]] - r[3] for r in here]
            table.append(
                (
                    f"{100 * off:g} %", way, sum(s < FOUND for s in short), len(here),
                    f"{np.median([r[4] for r in here]):.1f}", f"{max(short):.3g}",
                )
            )  # fmt: skip
    report.table(head, table)


if __name__ == "__main__":
    main()
