"""What the gates are worth: the same searches, judged without them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import log

from srfcli.diagnosis.search import CLOSE
from srfcli.output.tables import Column, Table
from srfcli.trial.answer import Answer
from srfcli.trial.mark import Mark

Judge = Callable[[Answer], tuple[str, frozenset[str]]]


def as_it_is(answer: Answer) -> tuple[str, frozenset[str]]:
    """Return the verdict, and the effects that it names."""
    return answer.verdict, frozenset(answer.effects) if answer.verdict == "identified" else frozenset()


def ungated(answer: Answer) -> tuple[str, frozenset[str]]:
    """Return what would have been said had held-out runs no say."""
    if answer.ungated in ("", answer.verdict):
        return as_it_is(answer)
    return answer.ungated, _effects(_named(answer)) if answer.ungated == "identified" else frozenset()


def information_criterion(answer: Answer) -> tuple[str, frozenset[str]]:
    """Return what the smallest Bayesian information criterion says: always a model, whatever it leaves over."""
    if not answer.tried:
        return as_it_is(answer)

    def criterion(name: str) -> float:
        t = answer.tried[name]
        return t["log_likelihood"] - 0.5 * t["parameters"] * log(t["samples"])

    effects = _effects(max(sorted(answer.tried), key=criterion))
    return ("identified" if effects else "none"), effects


def _named(answer: Answer) -> str:
    """Return the hypothesis that is named where no run is held out: the best that leaves noise alone and holds no smaller one."""
    evidence = {name: t["evidence"] for name, t in answer.tried.items()}
    top = max(evidence.values())
    close = [n for n in sorted(evidence) if answer.tried[n]["fine"] and top - evidence[n] < CLOSE]
    smallest = [n for n in close if not any(_effects(other) < _effects(n) for other in close)]
    return max(smallest or sorted(evidence), key=evidence.__getitem__)


def _effects(name: str) -> frozenset[str]:
    return frozenset() if name == "none" else frozenset(name.split("+"))


JUDGES: tuple[tuple[str, Judge], ...] = (
    ("as it is", as_it_is),
    ("no held-out gate", ungated),
    ("information criterion alone", information_criterion),
)


def ablated(marks: Sequence[Mark]) -> Table:
    """Return the main rates of the verdicts, and of what would have been said without a gate."""
    columns = (
        Column("judged"), Column("cases"), Column("right", format=".3f"),
        Column("false_alarms", about="where nothing is concealed", format=".3f"),
        Column("wrong_names", about="share of all cases", format=".3f"),
        Column("unknown_recognised", format=".3f"),
    )  # fmt: skip
    chosen = [m for m in marks if m.answer.tried]
    rows = []
    for title, judge in JUDGES if chosen else ():
        said = [judge(m.answer) for m in chosen]
        right = [s in m.accepted for m, s in zip(chosen, said, strict=True)]
        none = [s for m, s in zip(chosen, said, strict=True) if m.kind == "none"]
        outside = [s for m, s in zip(chosen, said, strict=True) if m.kind == "outside"]
        wrong = sum(s[0] == "identified" and not ok for s, ok in zip(said, right, strict=True))
        alarms = sum(s[0] in ("identified", "ambiguous", "unknown") for s in none)
        recognised = sum(s[0] == "unknown" for s in outside)
        rows.append(
            (title, len(chosen), sum(right) / len(chosen), alarms / len(none) if none else None, wrong / len(chosen),
             recognised / len(outside) if outside else None)
        )  # fmt: skip
    return Table("srf.prove.ablated/1", columns, rows, "What the gates are worth")
