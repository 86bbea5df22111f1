"""Which move of the search finds what: the cases of a trial once more, with a record of who made each model that was fitted.

    python benchmarks/moves.py TRIAL [CASE ...] [--workers N] [--log FILE.jsonl]

TRIAL is a folder of `srf prove`. A move is a method of the search that puts models into its queue or fits them itself. For each
there are the models that it had fitted, its share of the search's CPU, and the cases in which it found the model that was the
best in the end. A move that never did is one to leave out; an ablation of another need only be run on the cases in which it found
that model. Records are kept in FILE, and cases in it are not searched again.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from common import Report

from srfcli.core.parallel import run_processes
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.search import Fitted, ModelSearch
from srfcli.laws.registry import bundled_registry

MOVES = (
    "_expand", "_with_own_noise", "_try_ageing_laws", "_try_laws_afresh",
    "_expand_without_field", "_refit_noise", "_try_rivals", "_in_all_runs", "_in_one_run", "_eliminate", "_refit_elsewhere",
    "_fit_what_waits", "_fit_all",
)  # fmt: skip


class Recorded(ModelSearch):
    """The search, which records what each of its moves made and cost."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.stack: list[str] = []
        self.made: dict[int, str] = {}
        self.records: list[dict[str, Any]] = []
        self.cost: Counter[str] = Counter()
        super().__init__(*arguments, **options)

    def fit(self, move: Any) -> Fitted:
        """Return a model fitted, and keep in mind which move made it."""
        self.maker = "baseline" if move is None else self.made.get(move.number) or self.stack[-1]
        return super().fit(move)

    def _record(self, found: Fitted, *, anew: bool = False) -> Fitted:
        known = self.fitted.get(found.name)
        kept = super()._record(found, anew=anew)
        maker = self.stack[-1] if anew else self.maker
        self.records.append({
            "move": maker, "name": found.name, "evidence": found.separate, "kept": kept is not known,
            "cpu": time.process_time() - self.begun,
        })  # fmt: skip
        return kept

    def run(self) -> Fitted:
        """Return the best model."""
        begun = time.process_time()
        best = super().run()
        self.cost["all"] = time.process_time() - begun
        return best


def recorded(name: str) -> Any:
    """Return a method of the search that says it is at work."""
    own = getattr(ModelSearch, name)

    @functools.wraps(own)
    def method(self: Recorded, *arguments: Any, **options: Any) -> Any:
        before, begun = self.count, time.process_time()
        self.stack.append(name)
        try:
            return own(self, *arguments, **options)
        finally:
            self.stack.pop()
            self.made |= dict.fromkeys(range(before + 1, self.count + 1), name)
            if not self.stack:  # what another move asks for counts as that one's
                self.cost[name] += time.process_time() - begun

    return method


for _name in MOVES:
    setattr(Recorded, _name, recorded(_name))


def searched(folder: Path) -> dict[str, Any]:
    """Return the record of one case."""
    registry = bundled_registry()
    search = Recorded(registry, read_experiment(folder, registry=registry, holdout=False))
    best = search.run()
    return {
        "case": folder.name, "best": best.name, "passes": best.passes, "spent": search.cut_short,
        "records": search.records, "cost": dict(search.cost),
    }  # fmt: skip


def tables(report: Report, rows: Sequence[Mapping[str, Any]]) -> None:
    """Report the records of all cases."""
    fits: Counter[str] = Counter()
    found: Counter[str] = Counter()
    cost: Counter[str] = Counter()
    for row in rows:
        cost.update(row["cost"])
        fits.update(r["move"] for r in row["records"])
        kept = [r["move"] for r in row["records"] if r["kept"] and r["name"] == row["best"]]
        found[kept[-1] if kept else "none"] += 1
    whole = cost.pop("all")
    spent = sum(row["spent"] for row in rows)
    report.say(f"# {len(rows)} cases, {whole / len(rows):.0f} s of CPU each; the search ended at its budget in {spent}")
    report.say("# cpu: of the move itself and of what it fits at once; models that it queues are fitted by the search")
    lines = [
        (move.removeprefix("_"), fits[move], found[move], f"{cost[move] / whole:.1%}" if move in cost else "-")
        for move in ("baseline", *MOVES)
    ]
    report.table(("move", "models fitted", "best found", "cpu"), lines)
    times = [min(r["cpu"] for r in row["records"] if r["name"] == row["best"]) for row in rows if row["passes"]]
    if times:
        shares = (50, 75, 90, 95, 100)
        text = ", ".join(f"{s} %: {x:.0f}" for s, x in zip(shares, np.percentile(times, shares), strict=True))
        report.say(f"# s of CPU until the best model was first fitted, where it passes every test: {text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("trial", type=Path)
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--log", type=Path)
    asked = parser.parse_args()
    bank = asked.trial / "bank"
    names = asked.cases or sorted(p.name for p in bank.iterdir() if p.is_dir())
    lines = asked.log.read_text(encoding="utf-8").splitlines() if asked.log and asked.log.exists() else []
    rows = {row["case"]: row for row in map(json.loads, lines)}
    waiting = [name for name in names if name not in rows]
    for _, row in run_processes(searched, [bank / name for name in waiting], workers=asked.workers):
        rows[row["case"]] = row
        if asked.log:
            with asked.log.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
    report = Report("moves", __doc__ or "")
    tables(report, [rows[name] for name in names if name in rows])


if __name__ == "__main__":
    main()
