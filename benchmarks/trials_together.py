"""Several sealed trials as one: the tables of `srf prove` over the cases of all of them.

    python benchmarks/trials_together.py FOLDER FOLDER ...

Each FOLDER is what `srf prove --out` left, unsealed: bank, truths.json, answers.jsonl, known.jsonl. The seals are verified again.
Trials may be of different states of the program, which is said; a case is in one trial only, so that nothing is counted twice.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import common  # noqa: F401  before NumPy: it fixes the number of threads
from common import Report
from marked import marked, tell

from srfcli.validation.blind import read_answers
from srfcli.validation.cases import unseal


def main() -> None:
    """Mark the answers of every trial, print the tables over all of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    given = parser.parse_args()
    report, marks = Report("trials_together", __doc__ or ""), []
    for folder in given.folders:
        answers = list(read_answers(folder / "answers.jsonl").values())
        found = marked(unseal(folder / "bank", folder / "truths.json"), answers, folder / "known.jsonl")
        code = ", ".join(sorted({m.answer.code for m in found}))
        report.say(f"# {len(found)} cases, {sum(m.right for m in found)} of them right, answered by {code}")
        marks += found
    tell(report, marks, f"{len(marks)} cases")


if __name__ == "__main__":
    main()
