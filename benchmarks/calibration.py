"""What the stated confidence of a sealed trial should have been: its temper, its share of the unknown, and what they are worth.

    python benchmarks/calibration.py TRIAL [TRIAL ...] [--temper NUMBER] [--check TRIAL] [--numbers TEMPER UNEXPLAINED MISSED]

Each TRIAL is a folder of `srf prove`, unsealed. A confidence is exp(log evidence / temper), normalised over the models that were
fitted, times 1 - unexplained where one passes every test; where none does, 1 - missed is what `unknown` has. The three are
those under which the truths are likeliest (log score; Good, J. R. Stat. Soc. B 14, 1952), and their intervals come of cases
drawn again. Whether they hold is seen in cases that did not take part: each fifth of the cases by the others, --check, and
--numbers, which trials gave whose folders are gone.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
import numpy.typing as npt
from common import Report
from marked import marked

from srfcli.diagnosis.verdict import CALIBRATION_TEMPERATURE, PROB_REGISTERED_IF_UNKNOWN, PROB_UNREGISTERED_IF_PASSED
from srfcli.validation.blind import read_answers
from srfcli.validation.cases import unseal
from srfcli.validation.marks import GradedAnswer, calibrated, calibration, calibration_of, holds

TEMPERS = np.geomspace(0.5, 60.0, 97)
LEAST = 0.5  # cases that are added to each side of a share, so that none is 0 or 1 (Jeffreys)
FLOOR = 1e-3  # least probability that a truth is given: of a model that was never fitted
DRAWS, FOLDS = 400, 5
Three: TypeAlias = tuple[float, float, float]
Array: TypeAlias = npt.NDArray[np.float64]


def passed(m: GradedAnswer) -> bool:
    """Return whether a model passed every test, so that hypotheses have a share, and held-out runs do not refuse it."""
    return m.answer.verdict != "unknown"


def restated(m: GradedAnswer, numbers: Three) -> GradedAnswer:
    """Return the mark with the confidence that these numbers state."""
    temper, unexplained, missed = numbers
    unknown = unexplained if passed(m) else 1 - missed
    weights = {n: c for n, c in m.answer.confidence.items() if n not in ("unknown", "missed")}
    power = {n: c ** (1 / temper) for n, c in weights.items()}
    total = sum(power.values())
    found: dict[str, float] = {n: (1 - unknown) * c / total for n, c in power.items()} if total else {"missed": 1 - unknown}
    found["unknown"] = unknown
    top = max(found, key=lambda n: found[n])
    return replace(m, answer=replace(m.answer, confidence=found), top=top, stated=found[top], hit=hit(m, top))


def hit(m: GradedAnswer, name: str) -> bool:
    """Return whether a hypothesis is the truth, or as good."""
    return holds(name, m.accepted)


def score(m: GradedAnswer) -> float:
    """Return the log of the confidence in the truth."""
    share = sum(c for n, c in m.answer.confidence.items() if hit(m, n))
    return math.log(max(share, FLOOR))


def shares(marks: Sequence[GradedAnswer]) -> Array:
    """Return what the truth has of the confidence in models that were fitted (n, m), before that in `unknown`, for TEMPERS."""
    found = np.zeros((len(marks), TEMPERS.size))
    for k, m in enumerate(marks):
        models = {n: c for n, c in m.answer.confidence.items() if n not in ("unknown", "missed")}
        power = np.array(list(models.values()))[:, None] ** (1 / TEMPERS)
        true = np.array([hit(m, n) for n in models], dtype=bool)
        total = power.sum(axis=0)
        found[k] = np.divide(power[true].sum(axis=0), total, out=np.zeros_like(total), where=total > 0)
    return found


def fitted(marks: Sequence[GradedAnswer], share: Array | None = None) -> Three:
    """Return temper, unexplained and missed under which the truths are likeliest; `share` is that of these marks."""
    share = shares(marks) if share is None else share
    spoken, unknown = np.array([passed(m) for m in marks]), np.array([hit(m, "unknown") for m in marks])
    known = np.array([any(hit(m, n) for n in m.answer.confidence if n not in ("unknown", "missed")) for m in marks])
    registered = np.array([hit(m, "missed") for m in marks])
    unexplained = (np.sum(spoken & ~known) + LEAST) / (np.sum(spoken) + 2 * LEAST)
    missed = (np.sum(~spoken & registered) + LEAST) / (np.sum(~spoken) + 2 * LEAST)
    given = (1 - unexplained) * share[spoken] + unexplained * unknown[spoken, None]
    best = int(np.argmax(np.sum(np.log(np.maximum(given, FLOOR)), axis=0)))
    return float(TEMPERS[best]), float(unexplained), float(missed)


def tell(report: Report, who: str, marks: Sequence[GradedAnswer]) -> None:
    """Say mean log score, expected calibration error with what it would be by chance, and the bins of stated confidence."""
    error, stated = calibration_of(marks)[1], np.array([m.stated for m in marks])
    drawn = np.random.default_rng(0).random((DRAWS, stated.size)) < stated  # what a perfect calibration hits
    chance = float(np.mean([calibration(stated.tolist(), hits.tolist())[1] for hits in drawn]))
    mean = float(np.mean([score(m) for m in marks]))
    worth = f"expected calibration error {error:.3f}, by chance {chance:.3f}"
    report.say(f"\n{who}: {len(marks)} cases, mean log score {mean:.3f}, {worth}")
    table = calibrated(marks)
    rows = [["" if v is None else f"{v:.3g}" for v in row] for row in table.rows]
    report.table([c.name for c in table.columns], rows)


def by_others(marks: Sequence[GradedAnswer]) -> list[GradedAnswer]:
    """Return each fifth of the cases with the confidence that the others' numbers state."""
    order = np.random.default_rng(0).permutation(len(marks))
    found = []
    for k in range(FOLDS):
        inside = {int(i) for i in order[k::FOLDS]}
        numbers = fitted([m for i, m in enumerate(marks) if i not in inside])
        found += [restated(m, numbers) for i, m in enumerate(marks) if i in inside]
    return found


def read(folders: Sequence[Path]) -> list[GradedAnswer]:
    """Return the marks of the cases with an answer."""
    found: list[GradedAnswer] = []
    for folder in folders:
        truths: Mapping[str, object] = unseal(folder / "bank", folder / "truths.json")
        answers = [a for a in read_answers(folder / "answers.jsonl").values() if a.confidence]
        known = folder / "known.jsonl"
        found += marked(dict(truths), answers, known if known.exists() else None)
    return found


def main() -> None:
    """Fit the three numbers to the trials, say what they are worth, and check them on another trial."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("trials", type=Path, nargs="+")
    parser.add_argument(
        "--temper", type=float, default=CALIBRATION_TEMPERATURE, help="of their answers: 3 up to the 16th trial, 1 to the 28th"
    )
    parser.add_argument("--check", type=Path, action="append", default=[], help="trials that were answered with the same temper")
    parser.add_argument("--numbers", type=float, nargs=3, help="those of other trials, that state what these would have")
    given = parser.parse_args()

    def untempered(marks: Sequence[GradedAnswer]) -> list[GradedAnswer]:
        return [restated(m, (1 / given.temper, PROB_UNREGISTERED_IF_PASSED, PROB_REGISTERED_IF_UNKNOWN)) for m in marks]

    now = (CALIBRATION_TEMPERATURE, PROB_UNREGISTERED_IF_PASSED, PROB_REGISTERED_IF_UNKNOWN)
    report, told = Report("calibration", __doc__ or ""), read(given.trials)
    for folder in given.trials:
        trial = json.loads((folder / "trial.json").read_text(encoding="utf-8"))
        report.say(f"# {trial['bank']} bank of seed {trial['seed']}, answered with a temper of {given.temper:g}")
    marks = untempered(told)
    best, rng = fitted(marks), np.random.default_rng(0)
    share, chosen = shares(marks), rng.integers(len(marks), size=(DRAWS, len(marks)))
    drawn = np.array([fitted([marks[i] for i in own], share[own]) for own in chosen])
    low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
    numbers = zip(("temper", "unexplained", "missed"), now, best, low, high, strict=True)
    rows = [(n, f"{s:g}", f"{b:.3g}", f"{a:.3g} to {c:.3g}") for n, s, b, a, c in numbers]
    report.table(("number", "as it is", "likeliest", "95 %"), rows)
    tell(report, "as they were stated", told)
    tell(report, "as they would be stated now", [restated(m, now) for m in marks])
    if given.numbers:
        temper, unexplained, missed = given.numbers
        who = f"by the numbers {temper:g}, {unexplained:g}, {missed:g} of other trials"
        tell(report, who, [restated(m, (temper, unexplained, missed)) for m in marks])
    tell(report, "each fifth by the numbers of the others", by_others(marks))
    for folder in given.check:
        other = untempered(read([folder]))
        tell(report, f"{folder.name}, as they would be stated now", [restated(m, now) for m in other])
        tell(report, f"{folder.name}, by these numbers", [restated(m, best) for m in other])


if __name__ == "__main__":
    main()
