"""From which random field a fit from the file's start values reaches the likeliest maximum of the right model.

    python benchmarks/start_fields.py TRIAL [TRIAL ...]

TRIAL is a folder of `srf prove`, unsealed. Of each case whose physics is registered the right model is fitted with white noise,
as `fit_state_space` begins: half of the scoring steps under each field, then as many again where that is no maximum yet. Ending
within NEAR of the likeliest counts as reached. `the likeliest of these` begins under the field that is likeliest at the start
values; `the first few in turn` is what a fit does: one field of WIDE_FIELDS after the other, until one leads near a maximum under
a field that is narrower than at the start.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from at_the_truth import right_problem
from common import Report

from srfcli.core.errors import SrfError
from srfcli.inference.state_space import FIELD, NOT_CONVERGED, SCORING_STEPS, WIDE_FIELDS, Likelihood, maximise
from srfcli.validation.cases import unseal

FIELDS = (*WIDE_FIELDS, (0.03, 1.0), (0.03, 3.0), (0.02, 10.0), (0.01, 1.0), (0.003, 3.0), (0.003, 0.25))
NEAR = 3.0  # in log likelihood
RTOL = 1e-3  # of the integration, as in a search
Found = dict[tuple[float, float], tuple[float, float, float, bool]]


def tried(case: tuple[Path, dict[str, Any]]) -> Found | str:
    """Return by field: log likelihood at the start and where it ends, CPU, whether its field has shrunk; a reason for none."""
    folder, concealed = case
    try:
        likelihood = Likelihood(right_problem(folder, concealed)[2], rtol=RTOL)
    except SrfError as error:
        return str(error)
    at = [likelihood.names.index(n) for n in FIELD]
    found = {}
    for wide, long in FIELDS:
        x, since = likelihood.start.copy(), time.process_time()
        x[at] += np.log([wide / WIDE_FIELDS[0][0], long])
        height, reached, shrunk = likelihood.at(x, slopes=False).log_likelihood, -np.inf, False
        if np.isfinite(height):
            best = maximise(likelihood, x, steps=SCORING_STEPS // 2, close=1.0)
            if best.away >= 1.0 and np.isfinite(best.point.log_likelihood):
                best = maximise(likelihood, best.point.x, steps=SCORING_STEPS // 2, close=1.0)
            reached = best.point.log_likelihood
            shrunk = best.away < NOT_CONVERGED and bool(best.point.x[at[0]] < x[at[0]])
        found[wide, long] = height, reached, time.process_time() - since, shrunk
    return found


def chosen(found: Found) -> dict[str, list[tuple[float, float]]]:
    """Return the fields under which each way of beginning a fit goes on."""
    tries = [f for f in WIDE_FIELDS if np.isfinite(found[f][0])]
    few = next((tries[: i + 1] for i, f in enumerate(tries) if found[f][3]), tries)
    ways = {"the likeliest of these": [max(found, key=lambda f: found[f][0])], "the first few in turn, as a fit": few}
    return ways | {f"{wide:g} over {long:g}": [(wide, long)] for wide, long in FIELDS}


def main() -> None:
    """Print how many right models each field leads to the likeliest maximum of."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trials", nargs="+", type=Path)
    parser.add_argument("--rig", default="", help="those cases alone whose apparatus has a name that begins so")
    parser.add_argument("--workers", type=int, default=1)
    asked = parser.parse_args()
    cases = [
        (trial / "bank" / case, concealed)
        for trial in asked.trials
        for case, concealed in sorted(unseal(trial / "bank", trial / "truths.json").items())
        if concealed["kind"] != "outside" and concealed["rig"].startswith(asked.rig)
    ]
    report = Report("start_fields", __doc__ or "")
    reached, cpu, fitted = Counter[str](), Counter[str](), 0
    with ProcessPoolExecutor(asked.workers) as pool:
        for (folder, concealed), found in zip(cases, pool.map(tried, cases), strict=True):
            if isinstance(found, str):
                continue
            highest, missed = max(f[1] for f in found.values()), []
            fitted += 1
            for name, fields in chosen(found).items():
                own = max((found[f][1] for f in fields), default=-np.inf) > highest - NEAR
                reached[name] += own
                cpu[name] += sum(found[f][2] for f in fields)
                missed += [] if own else [name]
            what = "+".join(concealed["effects"]) or "none"
            print(
                f"{folder}: {concealed['rig']}, {concealed['protocol']}, {what}; missed by {', '.join(missed) or 'none'}",
                flush=True,
            )
    report.say(f"{fitted} right models; amplitude over friction, length over a twentieth of the longest slip\n")
    rows = [(name, str(n), f"{100 * n / fitted:.0f} %", f"{cpu[name] / fitted:.1f} s") for name, n in reached.items()]
    report.table(("begun under a field of", "reached", "share", "CPU a fit"), rows)


if __name__ == "__main__":
    main()
