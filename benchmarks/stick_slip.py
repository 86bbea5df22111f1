"""Stick-slip alone: a sealed trial of it, and from how far its fits converge.

    python benchmarks/stick_slip.py FOLDER [--cases N] [--seed SEED] [--fits] [--workers N]

FOLDER becomes a sealed trial of the wide bank in which each run sticks and slips, about one case in thirty of that bank. Effects
that act by a load that changes have none there; their cases are drawn anew. `search_steps.py FOLDER` with the same numbers
answers it, and `srf prove --report-only FOLDER` marks it.

With `--fits` the truths are read, and the right model of each case is fitted from the file's start values and from others, A,
B and D0 off by a quarter at random: the first steps of a fit, under one wide field after the other, as a fit chooses them.
Reached is what ends within NEAR of the likeliest maximum that any of these finds.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from at_the_truth import right_problem
from common import Report

from srfcli.core.errors import SrfError
from srfcli.diagnosis.search import SEARCH_RTOL
from srfcli.inference.state_space import SCORING_STEPS, Likelihood, maximise_from_starts, wide_starts
from srfcli.validation import apparatus, cases
from srfcli.validation.cases import CaseRequest, Recipe, unseal
from srfcli.validation.trials import Trial, begin

OFF = 0.25  # standard deviation of the logarithms of A, B and D0 in other starts
STARTS = 2  # of each case, the file's among them
NEAR = 10.0  # in log likelihood, as another field may stand beside white noise alone
Reached = list[tuple[float, float]]


def drawn(trial: Path, n: int, seed: int) -> Trial:
    """Return the sealed trial of that folder, made of stick-slip alone if it is not there."""
    any_protocol, shares = cases.draw_wide, dict(apparatus.PROTOCOLS)

    def draw_stick_slip(rng: np.random.Generator, asked: CaseRequest) -> Recipe:
        for number in range(2000):
            recipe = any_protocol(rng, asked if number < 100 else CaseRequest())
            if recipe.protocol == "stick-slip":
                return recipe
        raise AssertionError("no stick-slip is drawn")

    setattr(cases, "draw_wide", draw_stick_slip)  # noqa: B010
    apparatus.PROTOCOLS.update({name: 0.01 for name in shares if name != "stick-slip"})
    try:
        return begin(trial, cases=n, seed=seed, kinds=(), bank="wide", resume=True, workers=1)
    finally:
        setattr(cases, "draw_wide", any_protocol)  # noqa: B010
        apparatus.PROTOCOLS.update(shares)


def fitted(case: tuple[Path, dict[str, Any]]) -> Reached | str:
    """Return what each start reaches in log likelihood, and its CPU; a reason where the right model cannot be made."""
    folder, concealed = case
    try:
        likelihood = Likelihood(right_problem(folder, concealed)[2], rtol=SEARCH_RTOL)
    except SrfError as error:
        return str(error)
    file, rng = likelihood.values(likelihood.start), np.random.default_rng(concealed["seed"])
    starts = [{n: file[n] for n in likelihood.problem.names}]
    for _ in range(STARTS - 1):
        off = {n: float(np.exp(OFF * rng.standard_normal())) for n in ("A", "B", "D0") if n in file}
        starts.append(starts[0] | {n: file[n] * factor for n, factor in off.items()})
    return [_reached(likelihood, start) for start in starts]


def _reached(likelihood: Likelihood, start: dict[str, float]) -> tuple[float, float]:
    def quiet(text: str) -> None: ...

    since = time.process_time()
    found = maximise_from_starts(likelihood, wide_starts(likelihood, start, quiet), SCORING_STEPS // 2, quiet)
    return found.point.log_likelihood if found else -np.inf, time.process_time() - since


def main() -> None:
    """Draw the trial; with fits, print how many starts of the right models reach the likeliest maximum."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fits", action="store_true")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    trial = drawn(given.folder, given.cases, given.seed)
    print(f"SHA-256 of the sealed truths: {trial.digest()}", flush=True)
    if not given.fits:
        return
    report = Report("stick_slip", __doc__ or "")
    known = [
        (trial.bank / case, told) for case, told in sorted(unseal(trial.bank, trial.apart).items()) if told["kind"] != "outside"
    ]
    rows, every = [], []
    with ProcessPoolExecutor(given.workers) as pool:
        for (folder, concealed), found in zip(known, pool.map(fitted, known), strict=True):
            if isinstance(found, str):
                continue
            every.append(found)
            heights = [f"{height:.1f}" for height, _ in found]
            cpu = "  ".join(f"{cpu:.0f}" for _, cpu in found)
            rows.append((folder.name, concealed["rig"], "+".join(concealed["effects"]) or "none", *heights, cpu))
            print(*rows[-1], flush=True)
    near = [[height > max(found)[0] - NEAR for height, _ in found] for found in every]
    mean = np.mean([cpu for found in every for _, cpu in found])
    report.say(f"stick-slip of seed {given.seed}, digest {trial.digest()}: {len(every)} right models, {STARTS} starts of each;")
    report.say(f"{sum(n[0] for n in near)} reached from the file, {100 * np.mean(near):.0f} % of all, in {mean:.1f} s of CPU\n")
    report.table(("case", "rig", "model", "from the file", "from others", "CPU (s)"), rows)


if __name__ == "__main__":
    main()
