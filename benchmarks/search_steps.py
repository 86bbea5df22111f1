"""What each step of the diagnosis's search is worth: how often it found the model that was best in the end, and what it cost.

    python benchmarks/search_steps.py FOLDER [--cases N] [--seed SEED] [--workers N]

FOLDER becomes a sealed trial of the wide bank, as `srf prove --bank wide` makes; a later call goes on there. The search is that
of `srf diagnose`: of each model that is fitted it is kept which step asked for it. When all are answered the truths are read.

A step that never finds the best model is one that may be left out; `ablations.py --without STEP` leaves one out. CPU is that of
the step itself, without the fits that wait for their turn after it; `search` is these, and all that is no step.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
from ablations import STEPS
from common import Report
from marked import marked

from srfcli.diagnosis.search import LOG_BAYES_MARGIN, Fitted, ModelSearch
from srfcli.validation.blind import Answer, diagnose_case
from srfcli.validation.trials import answer_all, begin, open_truths

OTHER = "search"


class Traced(ModelSearch):
    """The search, which keeps which step asked for each model and how much CPU each step took."""

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self.steps, self.since = [OTHER], time.process_time()
        self.cpu, self.taken, self.fits = Counter[str](), Counter[str](), Counter[str]()
        self.asked: dict[int, str] = {}  # by which step a move was pushed, by its number
        self.found: dict[str, str] = {}  # by which step a model was found

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Count what is done inside as that of a step."""
        self._charge()
        self.steps.append(name)
        try:
            yield
        finally:
            self._charge()
            self.steps.pop()

    def _charge(self) -> None:
        now = time.process_time()
        self.cpu[self.steps[-1]] += now - self.since
        self.since = now

    def _push(self, moves: Sequence[Any]) -> None:
        self.asked |= {move.number: self.steps[-1] for move in moves}
        super()._push(moves)

    def fit(self, move: Any) -> Fitted:
        """Return a model fitted; it is that of the step which asked for it, now or before."""
        step = self.asked.get(move.number if move else 0, self.steps[-1])
        self.fits[step] += 1
        found = super().fit(move)
        if found.name not in self.fitted or found.separate_field_evidence > self.fitted[found.name].separate_field_evidence:
            self.found[found.name] = step
        return found

    def trace(self) -> dict[str, Any]:
        """Return what is kept of a search that has ended."""
        self._charge()
        close = [f for f in self.ranked() if f.evidence > self.best().evidence - LOG_BAYES_MARGIN]
        return {
            "best": self.best().name, "by": self.found.get(self.best().name, OTHER),
            "close": {f.name: self.found.get(f.name, OTHER) for f in close},
            "cpu": dict(self.cpu), "taken": dict(self.taken), "fits": dict(self.fits), "cut_short": self.cut_short,
        }  # fmt: skip


def _as_step(name: str, method: str) -> Callable[..., Any]:
    own = getattr(ModelSearch, method)

    @functools.wraps(own)
    def step(self: Traced, *of: Any) -> Any:
        self.taken[name] += 1
        with self.step(name):
            return own(self, *of)

    return step


for _name, _method in STEPS.items():
    setattr(Traced, _method, _as_step(_name, _method))


def diagnose_traced(folder: Path, plugins: tuple[Path, ...], *, traces: Path) -> Answer:
    """Return what the diagnosis says of a case; how it was found goes to the folder `traces`."""
    searches: list[Traced] = []

    class Kept(Traced):
        def __init__(self, *given: Any, **options: Any) -> None:
            super().__init__(*given, **options)
            searches.append(self)

    answer = diagnose_case(folder, plugins, by=Kept)
    (traces / f"{folder.name}.json").write_text(json.dumps(searches[0].trace()) + "\n", encoding="utf-8")
    return answer


def main() -> None:
    """Answer the cases of a new sealed bank, read the truths, print which step found what."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    asked = {"cases": given.cases, "seed": given.seed, "kinds": [], "bank": "wide"}
    trial = begin(given.folder, **asked, resume=True, workers=given.workers)
    print(f"SHA-256 of the sealed truths: {trial.digest()}", flush=True)
    traces = given.folder / "traces"
    traces.mkdir(exist_ok=True)
    by = functools.partial(diagnose_traced, traces=traces.resolve())
    for answer in answer_all(trial, workers=given.workers, diagnose=by):
        print(answer.case, answer.said or answer.verdict, f"{answer.cpu:.0f} s", answer.failure, flush=True)
    truths, answers = open_truths(trial)
    known = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(traces.glob("*.json"))}
    marks = {m.case: m for m in marked(truths, [answers[name] for name in known], None)}
    report = Report("search_steps", __doc__ or "")
    report.say(f"wide bank of seed {given.seed}, digest {trial.digest()}: {len(known)} searches, "
               f"{sum(m.right for m in marks.values())} right\n")  # fmt: skip
    cpu = sum(sum(t["cpu"].values()) for t in known.values())
    rows = []
    for step in (OTHER, *STEPS):
        best = [name for name, t in known.items() if t["by"] == step]
        rows.append((
            step, str(sum(step in t["taken"] for t in known.values()) if step != OTHER else len(known)),
            str(sum(t["fits"].get(step, 0) for t in known.values())), str(len(best)), str(sum(marks[n].right for n in best)),
            str(sum(step in t["close"].values() for t in known.values())),
            f"{100 * sum(t['cpu'].get(step, 0.0) for t in known.values()) / cpu:.1f} %",
        ))  # fmt: skip
    report.say(
        "cases in which a step was taken, fits it asked for, best models it found, of these in right answers, cases in which"
    )
    report.say("it found one that comes close to the best, CPU")
    report.table(("step", "taken", "fits", "best", "right", "close", "cpu"), rows)


if __name__ == "__main__":
    main()
