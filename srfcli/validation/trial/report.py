"""Marks as tables: rates with intervals, stated confidence, what ablations are worth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log
from typing import Any

from srfcli.diagnosis.search import CLOSE
from srfcli.results.tables import Column, Table
from srfcli.validation.trial.blind import VERDICTS, Answer
from srfcli.validation.trial.mark import CONFIDENT, INVISIBLE, KINDS, Mark

# Marks as tables: what was said for what, how often right, how sure, how well it predicts, and what it cost.

SCHEMA = "srf.prove/1"
STANDS_OUT = (0.0, INVISIBLE, 10.0, 20.0, 50.0, 200.0, float("inf"))
STRONG = (0.0, 1 / 3, 2 / 3, 1.0)
MINUTES = 300.0  # s of CPU a case should not take
WITHIN = 1.1  # of the true model's error
SHARE = (
    Column("share", "1", "of the cases", ".3f"),
    Column("low", "1", "lower end of Wilson's interval of 95 %", ".3f"),
    Column("high", "1", "its upper end", ".3f"),
)
COUNTED = (Column("hits", "1", "for how many cases it holds"), Column("cases", "1", "of how many"), *SHARE)


def tables(marks: Sequence[Mark], *, digest: str, seed: int, of: int) -> tuple[Table, list[Table]]:
    """Return the confusion table, whose `meta` holds everything, and the tables that text shows below it."""
    more = [
        rates(marks),
        by_effect(marks),
        by_outside(marks),
        by_strength(marks),
        calibrated(marks),
        held(marks),
        sizes(marks),
        cost(marks),
        ablated(marks),
    ]
    more = [t for t in more if t.rows]
    meta: dict[str, Any] = {
        "digest": digest,
        "seed": seed,
        "cases": of,
        "answered": len(marks),
        "code": sorted({m.answer.code for m in marks}),
        "calibration_error": calibration_of(marks)[1],
        **{t.schema.split("/")[0].split(".")[-1]: rows_of(t) for t in more},
        "marks": [row_of(m) for m in marks],
    }
    first = confusion(marks)
    notes = [f"{len(marks)} cases, seed {seed}; SHA-256 of the truths {digest}"]
    if len(marks) < of:
        notes.append(f"{of - len(marks)} further cases were given up without an answer")
    if len(meta["code"]) > 1:
        notes.append(f"answered by {len(meta['code'])} different states of the program: {', '.join(meta['code'])}")
    return Table(first.schema, first.columns, first.rows, first.title, tuple(notes), meta=meta), more


def rows_of(table: Table) -> list[dict[str, Any]]:
    """Return a table's rows as name -> value."""
    return [dict(zip([c.name for c in table.columns], row, strict=True)) for row in table.rows]


def _cells(found: Rate) -> tuple[Any, ...]:
    return (found.hits, found.count, found.share, *found.interval)


def confusion(marks: Sequence[Mark]) -> Table:
    """Return true kinds against verdicts; `right` counts the effects too, where they are named."""
    columns = (Column("concealed"), Column("cases"), *map(Column, VERDICTS), Column("right"), Column("class_right"))
    rows = []
    for kind, rough in [(k, r) for k in KINDS for r in (False, True)]:
        chosen = [m for m in marks if m.kind == kind and m.rough == rough]
        if chosen:
            counts = [sum(m.answer.verdict == v for m in chosen) for v in VERDICTS]
            sums = (sum(m.right for m in chosen), sum(m.class_right for m in chosen))
            rows.append((f"{kind}, rough track" if rough else kind, len(chosen), *counts, *sums))
    return Table(SCHEMA, columns, rows, "What was concealed, and the verdict on it")


def rates(marks: Sequence[Mark]) -> Table:
    """Return the rates on which a diagnosis is judged, with what it should reach."""
    none = [m for m in marks if m.kind == "none"]
    some = [m for m in marks if m.kind != "none"]
    outside = [m for m in marks if m.kind == "outside"]
    named = [m for m in marks if m.answer.verdict == "identified"]
    rows: list[tuple[Any, ...]] = []

    def add(what: str, chosen: Sequence[Mark], flag: Callable[[Mark], bool], aim: str = "") -> None:
        if chosen:
            rows.append((what, *_cells(rate(flag(m) for m in chosen)), aim or None))

    add("right", marks, lambda m: m.right, ">= 0.9")
    add("right, smooth tracks", [m for m in marks if not m.rough], lambda m: m.right)
    add("right, rough tracks", [m for m in marks if m.rough], lambda m: m.right)
    add("right, or ambiguous and listed", marks, lambda m: m.class_right)
    add("false alarm where nothing is concealed", none, lambda m: m.alarm, "< 0.05")
    add("false alarm, smooth tracks", [m for m in none if not m.rough], lambda m: m.alarm)
    add("false alarm, rough tracks", [m for m in none if m.rough], lambda m: m.alarm, "< 0.05")
    add(f"wrong name, stated above {CONFIDENT}", marks, lambda m: m.confident_wrong)
    add("wrong name, of all names", named, lambda m: m.wrong_name)
    add("unknown recognised", outside, lambda m: m.answer.verdict == "unknown", ">= 0.8")
    add("unknown recognised, where visible", [m for m in outside if m.visible], lambda m: m.answer.verdict == "unknown")
    add("something concealed is invisible", some, lambda m: not m.visible)
    add("failed", marks, lambda m: m.answer.verdict == "failed")
    columns = (Column("measure"), *COUNTED, Column("aim", about="what it should reach"))
    note = (f"invisible: fewer than {INVISIBLE:g} standard errors of its size, had one known its form; none, inconclusive and "
            "ambiguous are right there")  # fmt: skip
    return Table("srf.prove.rates/1", columns, rows, "Rates", (note,))


def by_effect(marks: Sequence[Mark]) -> Table:
    """Return, for each effect of the library, how often it was found alone, and named where it was one of two."""
    columns = (
        Column("effect"), *COUNTED, Column("class_right"), Column("invisible"), Column("in_pairs"),
        Column("named_in_pairs", about="among the names of the verdict"),
    )  # fmt: skip
    names = sorted({n for m in marks if m.kind in ("single", "pair") for n in m.hidden})
    rows = []
    for name in names:
        alone = [m for m in marks if m.kind == "single" and name in m.hidden]
        pairs = [m for m in marks if m.kind == "pair" and name in m.hidden]
        rows.append(
            (name, *_cells(rate(m.right for m in alone)), sum(m.class_right for m in alone), sum(not m.visible for m in alone),
             len(pairs), sum(name in m.answer.effects for m in pairs))
        )  # fmt: skip
    return Table("srf.prove.effects/1", columns, rows, "One effect concealed: right")


def by_outside(marks: Sequence[Mark]) -> Table:
    """Return, for each effect outside the library, how often it was called unknown, and what it was called else."""
    columns = (Column("outside"), *COUNTED, Column("invisible"), Column("called", about="verdicts other than unknown"))
    rows = []
    for name in sorted({n for m in marks if m.kind == "outside" for n in m.hidden}):
        chosen = [m for m in marks if name in m.hidden]
        called = sorted(m.answer.said or m.answer.verdict for m in chosen if m.answer.verdict != "unknown")
        found = rate(m.answer.verdict == "unknown" for m in chosen)
        rows.append((name, *_cells(found), sum(not m.visible for m in chosen), ", ".join(called) or None))
    return Table("srf.prove.outside/1", columns, rows, "Outside the library: unknown")


def by_strength(marks: Sequence[Mark]) -> Table:
    """Return the power: how often something is seen, and named rightly, against how far one effect stands out."""
    columns = (
        Column("measure"), Column("from", format=".3g"), Column("to", format=".3g"), Column("cases"),
        Column("seen", about="the verdict says that something is missing"), Column("named", about="identified, and rightly"),
        *SHARE,
    )  # fmt: skip
    single = [m for m in marks if m.kind == "single"]
    rows: list[tuple[Any, ...]] = []

    def add(measure: str, edges: Sequence[float], value: Callable[[Mark], float | None]) -> None:
        for low, high in pairwise(edges):
            chosen = [m for m in single if (v := value(m)) is not None and (low <= v < high or v == high == edges[-1])]
            if chosen:
                named = rate(m.right and m.answer.verdict == "identified" for m in chosen)
                seen = sum(m.alarm for m in chosen)
                rows.append((measure, low, high, len(chosen), seen, named.hits, named.share, *named.interval))

    add("standard errors", STANDS_OUT, lambda m: m.sigmas)
    add("drawn size", STRONG, lambda m: m.size)
    notes = ("standard errors: of its size, with the baseline free, the effect's form and a rough track known",
             "drawn size: 0 weak to 1 strong, on a logarithmic scale")  # fmt: skip
    return Table("srf.prove.power/1", columns, rows, "Power: one effect concealed", notes if rows else ())


def calibration_of(marks: Sequence[Mark]) -> tuple[tuple[Bin, ...], float | None]:
    """Return how the confidence in the likeliest hypothesis compares with how often it is the truth."""
    spoken = [m for m in marks if m.top]
    return calibration([m.stated for m in spoken], [m.hit for m in spoken])


def calibrated(marks: Sequence[Mark]) -> Table:
    """Return the stated confidence of the likeliest hypothesis against how often it was the truth."""
    bins, error = calibration_of(marks)
    columns = (
        Column("from"), Column("to"), Column("cases"), Column("stated", about="mean", format=".3f"),
        Column("found", about="how often it was the truth", format=".3f"), *SHARE[1:],
    )  # fmt: skip
    rows = [(b.low, b.high, b.rate.count, b.stated, b.rate.share, *b.rate.interval) for b in bins]
    notes = () if error is None else (f"expected calibration error {error:.3f}; it should be below 0.05",)
    return Table("srf.prove.calibration/1", columns, rows, "Stated confidence of the likeliest hypothesis", notes)


def held(marks: Sequence[Mark]) -> Table:
    """Return the held-out error over that of the model that knows the truth."""
    columns = (
        Column("answers"), Column("cases"), Column("median", format=".3f"), Column("q90", format=".3f"),
        Column("within", about=f"at most {WITHIN}", format=".3f"), Column("baseline_median", format=".3f"),
    )  # fmt: skip
    rows = []
    groups: list[tuple[str, Callable[[Mark], bool]]] = [
        ("named rightly", lambda m: m.right and m.answer.verdict == "identified"),
        ("named wrongly", lambda m: m.wrong_name),
        ("ambiguous", lambda m: m.answer.verdict == "ambiguous"),
        ("unknown", lambda m: m.answer.verdict == "unknown"),
        ("none or inconclusive", lambda m: m.answer.verdict in ("none", "inconclusive")),
    ]
    for name, chosen in groups:
        for rough in (False, True):
            errors = [
                (m.error, m.baseline_error) for m in marks if m.rough == rough and chosen(m) and m.error is not None
            ]
            if errors:
                ours, base = [e for e, _ in errors], [b for _, b in errors if b is not None]
                within = sum(e <= WITHIN for e in ours) / len(ours)
                title = f"{name}, rough tracks" if rough else name
                rows.append((title, len(ours), quantile(ours, 0.5), quantile(ours, 0.9), within, quantile(base, 0.5)))
    note = "rms of held-out runs, over that of the model that knows the truth and the track; `within` 1.1 of it"
    return Table("srf.prove.held/1", columns, rows, "Held-out error", (note,) if rows else ())


def sizes(marks: Sequence[Mark]) -> Table:
    """Return how well the sizes of rightly named effects, and their standard errors, hold."""
    columns = (
        Column("tracks"), Column("within_2", about="no more than 2 standard errors off"), Column("cases"), *SHARE,
        Column("median_off", about="median of the distance, in standard errors", format=".2f"),
        Column("median_relative", about="the same, relative to the size", format=".3f"),
    )  # fmt: skip
    rows = []
    for rough in (False, True):
        found = [m.deviation for m in marks if m.deviation is not None and m.rough == rough]
        if found:
            off = [abs(sigmas) for sigmas, _ in found]
            medians = (quantile(off, 0.5), quantile([r for _, r in found], 0.5))
            rows.append(("rough" if rough else "smooth", *_cells(rate(x <= 2 for x in off)), *medians))
    return Table("srf.prove.sizes/1", columns, rows, "Sizes of the effects that were named rightly, alone")


def cost(marks: Sequence[Mark]) -> Table:
    """Return what a case takes of CPU."""
    columns = (
        Column("cases"), Column("median", "s", format=".1f"), Column("q90", "s", format=".1f"), Column("max", "s", format=".1f"),
        Column("under_300_s", about="share of the cases", format=".3f"), Column("total", "h", format=".2f"),
    )  # fmt: skip
    times = [m.answer.cpu for m in marks]
    rows = []
    if times:
        short = sum(t < MINUTES for t in times) / len(times)
        rows = [(len(times), quantile(times, 0.5), quantile(times, 0.9), max(times), short, sum(times) / 3600)]
    return Table("srf.prove.cost/1", columns, rows, "CPU of a diagnosis")


CASES = (
    Column("case"), Column("kind"), Column("concealed"), Column("rough"), Column("invisible"), Column("sigmas", format=".3g"),
    Column("size", format=".3g"), Column("verdict"), Column("effects"), Column("stated", format=".3f"), Column("top"),
    Column("top_stated", format=".3f"), Column("right"), Column("class_right"), Column("error", format=".3f"),
    Column("baseline_error", format=".3f"), Column("cpu", "s", format=".1f"), Column("failure"),
)  # fmt: skip


def cases(marks: Sequence[Mark]) -> Table:
    """Return one row per case: what was concealed, what was said, and the mark."""
    return Table("srf.prove.cases/1", CASES, [tuple(row_of(m).values()) for m in marks], "Cases")


def row_of(m: Mark) -> Mapping[str, Any]:
    """Return a mark as name -> value, by the columns of CASES."""
    a = m.answer
    values = (
        a.case, m.kind, "+".join(m.hidden) or None, m.rough, "+".join(m.invisible) or None, m.sigmas, m.size, a.verdict,
        "+".join(a.effects) or None, a.confidence.get(a.said), m.top or None, m.stated if m.top else None, m.right,
        m.class_right, m.error, m.baseline_error, a.cpu, a.failure or None,
    )  # fmt: skip
    return dict(zip([c.name for c in CASES], values, strict=True))


# Counts as rates with intervals, and stated confidence against how often it was right.

Z = 1.959963984540054  # of a two-sided interval of 95 %
EDGES = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)


@dataclass(frozen=True)
class Rate:
    """`hits` of `count` cases, and Wilson's interval of 95 % around their share; None of no cases."""

    hits: int
    count: int

    @property
    def share(self) -> float | None:
        """Return the share of hits."""
        return self.hits / self.count if self.count else None

    @property
    def interval(self) -> tuple[float | None, float | None]:
        """Return the bounds of the interval (Wilson 1927): it holds near 0 and 1 too, where the usual one is empty."""
        if not self.count:
            return None, None
        n, p = self.count, self.hits / self.count
        middle = (p + Z**2 / (2 * n)) / (1 + Z**2 / n)
        half = Z / (1 + Z**2 / n) * (p * (1 - p) / n + Z**2 / (4 * n**2)) ** 0.5
        # the exact ends: rounding must not put 0 of n above 0
        return (0.0 if self.hits == 0 else middle - half), (1.0 if self.hits == n else middle + half)


def rate(flags: Iterable[bool]) -> Rate:
    """Return how many of `flags` are true."""
    listed = list(flags)
    return Rate(sum(listed), len(listed))


@dataclass(frozen=True)
class Bin:
    """Cases whose stated confidence lies between `low` and `high`: its mean, and how often it was right."""

    low: float
    high: float
    stated: float
    rate: Rate


def calibration(stated: Sequence[float], hits: Sequence[bool]) -> tuple[tuple[Bin, ...], float | None]:
    """Return the bins that hold cases, and the expected calibration error: the mean distance between stated and found."""
    bins = []
    for low, high in pairwise(EDGES):
        inside = [k for k, s in enumerate(stated) if low <= s < high or s == high == 1.0]
        if inside:
            mean = sum(stated[k] for k in inside) / len(inside)
            bins.append(Bin(low, high, mean, rate(hits[k] for k in inside)))
    if not bins:
        return (), None
    error = sum(b.rate.count * abs(b.stated - (b.rate.share or 0.0)) for b in bins) / len(stated)
    return tuple(bins), error


def quantile(values: Iterable[float], share: float) -> float | None:
    """Return the value that `share` of them do not exceed, by linear interpolation; None of none."""
    ordered = sorted(values)
    if not ordered:
        return None
    at = share * (len(ordered) - 1)
    k = min(int(at), len(ordered) - 2) if len(ordered) > 1 else 0
    return ordered[0] if len(ordered) == 1 else ordered[k] + (at - k) * (ordered[k + 1] - ordered[k])


# What the gates are worth: the same searches, judged without them.

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
