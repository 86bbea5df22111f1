"""What parts and constants of the diagnosis are worth: cases of a sealed bank once more, with one left out or changed.

    python benchmarks/ablations.py BANK TRUTHS --beside answers.jsonl [--known known.jsonl] [--without PART]
        [--with CONSTANT=VALUE] [--quickest N] [--cases N] [--workers N] [--kept FOLDER]

BANK is a folder of cases as `srf prove` makes, TRUTHS their truths, answers.jsonl and known.jsonl those of the trial: what the
whole diagnosis said of the same cases, and what was visible. Of the first N cases, or of all, those are taken that the whole
diagnosis answered in the least CPU.

field       friction is deterministic: no model has a random friction field
colour      the gauge's noise is white in every model
projection  effects are scored by what they explain of the misfit alone: what parameters, field or gauge noise could explain as
            well is not taken off

Steps of the search, joined by commas where several are left out, are those of `srfcli.diagnosis.search.ModelSearch`:

{steps}

A constant is one of `srfcli.diagnosis` or `srfcli.inference`, which has one meaning wherever it is used.

What the held-out runs are worth, and what the Bayesian information criterion alone would choose, needs no second diagnosis:
those tables are in the trial's own report.
"""

from __future__ import annotations

import argparse
import functools
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import common  # noqa: F401  before NumPy: it fixes the number of threads
from common import Report
from marked import heading, marked, tell

import srfcli.diagnosis.verdict  # noqa: F401  with all that a diagnosis uses, for its constants
from srfcli.codegen.model import Array
from srfcli.core.parallel import run_processes
from srfcli.diagnosis.scores import ResidualProjection
from srfcli.diagnosis.search import ModelSearch
from srfcli.validation.blind import Answer, Task, answer_case, diagnose_case, failed, read_answers, write_answers
from srfcli.validation.cases import unseal
from srfcli.validation.marks import rate

LIMIT = 1800.0  # s of CPU


class WithoutField(ModelSearch):
    """The search without a random friction field."""

    options: ClassVar[Mapping[str, Any]] = {"smooth": True}


class WithoutColour(ModelSearch):
    """The search with white gauge noise."""

    options: ClassVar[Mapping[str, Any]] = {"processes": ()}


class Bare(ResidualProjection):
    """What a fit leaves, nothing of it taken off."""

    def project(self, columns: Array) -> Array:
        """Return columns as they are."""
        return columns


class WithoutProjection(ModelSearch):
    """The search whose scores take nothing off."""

    projection = Bare


STEPS = {  # a step: the method that is left out
    "another-ageing-law-near-by": "_try_ageing_laws",
    "from-the-file": "_refit_from_start_values",
    "likeliest-from-the-file": "_refit_likeliest",
    "pairs-from-the-file": "_with_a_second",
    "scores-without-field": "_expand_without_field",
    "noise-of-each-run": "_with_own_noise",
    "rivals": "_try_rivals",
    "all-runs": "_in_all_runs",
    "one-run": "_in_one_run",
    "elimination": "_eliminate",
    "further-colour": "_with_more_colour",
    "after-the-best": "_fall_back",
    "other-maxima": "_at_other_maxima",
}


PARTS: dict[str, type[ModelSearch]] = {"field": WithoutField, "colour": WithoutColour, "projection": WithoutProjection}


def without(parts: str) -> type[ModelSearch]:
    """Return the search without a part, or without several of its steps, joined by commas; KeyError if there is no such."""
    if parts in PARTS:
        return PARTS[parts]
    left = {STEPS[name]: (lambda self, *of: None) for name in parts.split(",")}
    if "noise-of-each-run" in parts.split(","):
        left[STEPS["noise-of-each-run"]] = lambda self, base: base
    return type("Without", (ModelSearch,), left)


__doc__ = (__doc__ or "").format(steps="\n".join(f"{name:34}{method}" for name, method in STEPS.items()))


def holding(name: str) -> list[ModuleType]:
    """Return the modules of the diagnosis that have a constant, which is a number."""
    own = [m for n, m in sys.modules.items() if n.startswith(("srfcli.diagnosis.", "srfcli.inference."))]
    return [m for m in own if isinstance(getattr(m, name, None), int | float)]


def diagnose_without(folder: Path, plugins: tuple[Path, ...], *, part: str) -> Answer:
    """Return what the diagnosis says without a part, or without steps."""
    return diagnose_case(folder, plugins, by=without(part))


def diagnose_with(folder: Path, plugins: tuple[Path, ...], *, constant: str) -> Answer:
    """Return what the diagnosis says where a constant has another value, given as `NAME=VALUE`."""
    name, _, value = constant.partition("=")
    places = holding(name)
    before = getattr(places[0], name)
    try:
        for module in places:
            setattr(module, name, type(before)(float(value)))
        return diagnose_case(folder, plugins)
    finally:  # the process answers other cases later
        for module in places:
            setattr(module, name, before)


def answered(bank: Path, change: str, names: Sequence[str], workers: int, kept: Path | None) -> Iterator[Answer]:
    """Yield the answers to these cases under a change; those in the folder `kept` are not sought again."""
    path = kept / f"{change.replace(' ', '-')}-{bank.name}.jsonl" if kept else None
    known = read_answers(path) if path else {}
    waiting = [name for name in names if name not in known]
    how, _, what = change.partition(" ")
    by = functools.partial(diagnose_without, part=what) if how == "without" else functools.partial(diagnose_with, constant=what)
    tasks = [Task(bank / name, (), by, LIMIT) for name in waiting]
    found = dict(known)
    for _, answer in run_processes(
        answer_case, tasks, workers=workers, lost=lambda i: failed(waiting[i], "its process was killed")
    ):
        found[answer.case] = answer
        print(change, answer.case, answer.said or answer.verdict, f"{answer.cpu:.0f} s", answer.failure, flush=True)
        if path:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_answers(path, found.values())
    yield from (found[name] for name in names)


def main() -> None:
    """Answer the cases under each change, mark the answers beside the whole diagnosis's, print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bank", type=Path)
    parser.add_argument("truths", type=Path)
    parser.add_argument("--beside", type=Path, required=True, help="answers.jsonl of the trial, marked beside")
    parser.add_argument("--known", type=Path, help="known.jsonl of the trial: what was visible")
    parser.add_argument("--without", action="append", default=[], help="part, or steps joined by commas")
    parser.add_argument(
        "--with", dest="constants", action="append", default=[], help="a constant and its value: MIN_SCORE_GAIN=24"
    )
    parser.add_argument("--cases", type=int, help="how many cases to take, from the first on")
    parser.add_argument("--quickest", type=int, help="how many of these to take, by the CPU of the whole diagnosis")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--kept", type=Path, help="folder of the answers: a later run goes on there")
    given = parser.parse_args()
    for constant in given.constants:
        name, _, value = constant.partition("=")
        if not holding(name) or not re.fullmatch(r"\d+(\.\d*)?", value):
            parser.error(
                f"--with {constant}: give a number of srfcli.diagnosis or srfcli.inference and its value, MIN_SCORE_GAIN=24"
            )
    for parts in given.without:
        if parts not in PARTS and not STEPS.keys() >= set(parts.split(",")):
            parser.error(f"--without {parts}: give one of {', '.join(PARTS)}, or steps joined by commas: {', '.join(STEPS)}")
    whole = read_answers(given.beside)
    names = sorted(whole)[: given.cases]
    names = sorted(sorted(names, key=lambda n: whole[n].cpu)[: given.quickest])
    changes = [f"without {part}" for part in given.without] + [f"with {constant}" for constant in given.constants]
    changes = changes or [f"without {part}" for part in (*PARTS, *STEPS)]
    found = {change: list(answered(given.bank, change, names, given.workers, given.kept)) for change in changes}
    truths = unseal(given.bank, given.truths)  # only now
    report = Report("ablations", __doc__ or "")
    heading(report, f"bank {given.bank.name}", len(names), given.known)
    if given.quickest:
        report.say("# those that the whole diagnosis answered in the least CPU")
    answers = {"whole": [whole[name] for name in names]} | found
    marks = {who: marked(truths, listed, given.known) for who, listed in answers.items()}
    rows = []
    for who, listed in marks.items():
        right = rate(m.right for m in listed)
        low, high = right.interval
        turned = sum(a.right and not b.right for a, b in zip(marks["whole"], listed, strict=True))
        mended = sum(b.right and not a.right for a, b in zip(marks["whole"], listed, strict=True))
        span = f"{low:.2f} to {high:.2f}" if low is not None and high is not None else "-"
        cpu = sum(a.cpu for a in answers[who])
        rows.append((who, f"{right.hits} of {right.count}", span, str(turned), str(mended), f"{cpu:.0f} s"))
    report.say("\nright, its interval (Wilson, 95 %); cases that the whole has right and this wrong, and the reverse; CPU of all")
    report.table(("diagnosis", "right", "interval", "lost", "won", "cpu"), rows)
    for who, listed in marks.items() if given.without or not given.constants else ():
        tell(report, listed, who)


if __name__ == "__main__":
    main()
