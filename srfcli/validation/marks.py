"""Answers held against the truths, and the marks as tables: rates with intervals, stated confidence, what ablations are worth.

Marks are computed by the generator's equations, after the truths are unsealed; no answer and no fit of this project
enters.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise, product
from math import log
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from srfcli.core.errors import SrfError
from srfcli.core.files import read_text, write_atomic
from srfcli.core.parallel import run_processes
from srfcli.data.experiment import read_experiment
from srfcli.diagnosis.search import LOG_BAYES_MARGIN
from srfcli.laws.registry import load_registry
from srfcli.results.tables import Column, Table
from srfcli.validation.apparatus import PAPER, RIGS, Rig, free_fields
from srfcli.validation.blind import FAILED, VERDICTS, Answer
from srfcli.validation.cases import EFFECTS, WIDE_KINDS, Effect, noiseless_record, recipe_of, without
from srfcli.validation.gauge import Gauge, white
from srfcli.validation.slider import Physics, Plan, critical_load

# The mark of one answer: which answers are accepted, and whether it is one of them.

# standard errors: an effect whose size is smaller, in units of its error in the best fit, counts as invisible
MIN_VISIBLE_SIGMAS = 5.0
HIGH_CONFIDENCE = 0.9
VERDICTS_IF_INVISIBLE = ("none", "inconclusive", "ambiguous")  # right where what is concealed cannot be seen
Accepted = frozenset[tuple[str, frozenset[str]]]


@dataclass(frozen=True)
class GradedAnswer:
    """An answer and the truth about its case. `right` is the verdict with the very set of effects, or what is as good.

    `class_right`: right, or ambiguous with the truth among what is listed or equivalent to it. `alarm`: something is said to be
    missing. `top` is the hypothesis with most confidence, `stated` that confidence, `hit` whether it is the truth; `error` the
    held-out rms of the augmented model over that of the true one, `baseline_error` that of the baseline, `loads` how far the
    critical loads of both are off (rms of the logarithm), beyond the recordings' velocities; `deviation` is the
    distance of an effect's size from the true one, where it was named rightly and alone: in standard errors, and relative.
    `own_track`: each run has a friction field of its own. `set_in` says in which apparatus, protocol, law, noise and field it was
    concealed. `located`: of an effect in one run, whether it is named and most of the misfit is placed in that run.
    """

    case: str
    kind: str
    hidden: tuple[str, ...]
    rough: bool
    invisible: tuple[str, ...]
    sigmas: float | None
    size: float | None
    answer: Answer
    right: bool
    class_right: bool
    top: str
    stated: float
    hit: bool
    error: float | None
    baseline_error: float | None
    deviation: tuple[float, float] | None = None
    accepted: Accepted = frozenset()
    own_track: bool = False
    set_in: Mapping[str, str] = field(default_factory=dict)
    located: bool = False
    loads: tuple[float, float] | None = None

    @property
    def visible(self) -> bool:
        """Return whether all that is concealed could be seen."""
        return not self.invisible

    @property
    def alarm(self) -> bool:
        """Return whether the answer says that something is missing."""
        return self.answer.verdict in ("identified", "ambiguous", "unknown")

    @property
    def wrong_name(self) -> bool:
        """Return whether effects are named, and are not the concealed ones."""
        return self.answer.verdict == "identified" and not self.right

    @property
    def confident_wrong(self) -> bool:
        """Return whether the wrong effects are named with a stated confidence above HIGH_CONFIDENCE."""
        return self.wrong_name and self.answer.confidence.get(self.answer.said, 0.0) > HIGH_CONFIDENCE


def grade(truth: Mapping[str, Any], answer: Answer, detectability: Detectability) -> GradedAnswer:
    """Return the mark of an answer, given the truth about its case and what there was to be seen."""
    hidden = tuple(truth["effects"])
    invisible = tuple(n for n in hidden if (s := detectability.sigmas.get(n)) is not None and s < MIN_VISIBLE_SIGMAS)
    allowed = accepted(truth, invisible)
    right = answer.verdict != FAILED and as_answered(answer) in allowed
    shares = answer.confidence
    top = max(shares, key=lambda name: shares[name], default="")
    known = [s for n in hidden if (s := detectability.sigmas.get(n)) is not None]
    return GradedAnswer(
        answer.case,
        kind_of_case(truth),
        hidden,
        truth["rough"] > 0,
        invisible,
        min(known) if known and len(known) == len(hidden) else None,
        min(truth["sizes"].values(), default=None),
        answer,
        right,
        right or _listed(truth, answer),
        top,
        shares.get(top, 0.0),
        holds(top, allowed),
        _ratio(answer, detectability, "augmented"),
        _ratio(answer, detectability, "baseline"),
        deviation(truth, answer),
        allowed,
        truth.get("own_track", False),
        setting_of(truth),
        answer.verdict == "identified" and answer.effects == hidden and answer.run == truth.get("only", "") != "",
        load_errors(truth, answer),
    )


def setting_of(truth: Mapping[str, Any]) -> Mapping[str, str]:
    """Return what a case was set in, by kind of circumstance; nothing for a truth that does not say."""
    if "rig" not in truth:
        return {}
    recipe = recipe_of(truth)
    return {
        "apparatus": truth["rig"],
        "protocol": truth["protocol"],
        "friction law": recipe.baseline.law_name,
        "ageing law": recipe.physics.ageing_name,
        "noise": truth["noise"],
        "field": "none" if not truth["rough"] else "one per run" if truth.get("own_track") else "one for all runs",
    }


def kind_of_case(truth: Mapping[str, Any]) -> str:
    """Return the kind of a case, of WIDE_KINDS."""
    if truth.get("kind"):
        return str(truth["kind"])
    if truth["verdict"] == "unknown":
        return "outside"
    return ("none", "single", "pair")[len(truth["effects"])]


def accepted(truth: Mapping[str, Any], invisible: tuple[str, ...]) -> Accepted:
    """Return what would be right: pairs of a verdict and, for `identified`, a set of effects.

    `accept` in the truth lists further verdicts, or effects as "a" or "a+b". Where all that is concealed is invisible, so are
    none, inconclusive and ambiguous; of two effects with one invisible, the other one alone.
    """
    found = {hypothesis("+".join(truth["effects"]) if truth["verdict"] == "identified" else truth["verdict"])}
    found |= {(name, frozenset()) if name in VERDICTS else hypothesis(name) for name in truth.get("accept", ())}
    left = frozenset(truth["effects"]) - frozenset(invisible)
    if invisible and left:
        found.add(("identified", left))
    elif invisible:
        found |= {(verdict, frozenset()) for verdict in VERDICTS_IF_INVISIBLE}
    return frozenset(found)


def hypothesis(name: str) -> tuple[str, frozenset[str]]:
    """Return the verdict and effects that a hypothesis stands for: none, unknown, or names joined by +."""
    return (name, frozenset()) if name in ("none", "unknown", "") else ("identified", frozenset(name.split("+")))


def holds(name: str, allowed: Accepted) -> bool:
    """Return whether what a confidence is in is right: a hypothesis, or that a registered one, or none, was `missed`."""
    return hypothesis(name) in allowed or (name == "missed" and bool(allowed - {hypothesis("unknown")}))


def _listed(truth: Mapping[str, Any], answer: Answer) -> bool:
    """Return whether an ambiguous answer lists the truth or its equivalents, or an inconclusive one is about nothing."""
    if truth["verdict"] == "none":
        return answer.verdict == "inconclusive"
    if answer.verdict != "ambiguous" or truth["verdict"] != "identified":
        return False
    listed = set(answer.effects)
    for names in answer.equivalent:
        listed |= set(names) if listed & set(names) else set()
    return set(truth["effects"]) <= listed


def _ratio(answer: Answer, detectability: Detectability, model: str) -> float | None:
    """Return the rms over all held-out runs under `model`, over that under the true one; None where one has none."""
    pairs = [(run.get(model), detectability.known.get(name)) for name, run in answer.held.items()]
    if not pairs or any(a is None or not b for a, b in pairs):
        return None
    ours, true = (sum(float(p[i] or 0.0) ** 2 for p in pairs) for i in (0, 1))
    return float((ours / true) ** 0.5)


# Visibility, from the truth of a case: the error of the true model, and the size of each effect in standard errors.

PARAMETER_STEP = 2e-4  # relative, of a parameter's difference: in stick-slip a larger one shifts the phase by more than is linear
COEFFICIENTS = ("mu0", "A", "B", "B2", "C", "M")  # what goes with the stiffness in a recording of elongations


@dataclass(frozen=True)
class Detectability:
    """What a case's truth says: `known` is each held-out run's rms in um under the true model, the track included.

    `sigmas` is how far each concealed effect stands out of the fitted runs, in standard errors of its size in a fit in which the
    baseline's parameters are free; `raw` is the same if they were known. None where the slider cannot be followed without it.
    """

    case: str
    known: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float | None] = field(default_factory=dict)
    raw: Mapping[str, float | None] = field(default_factory=dict)


Task = tuple[Path, Mapping[str, Any]]


def detectability_of(task: Task) -> Detectability:
    """Return what there was to be seen in one case: its folder, and the truth about it."""
    folder, truth = task
    recipe = recipe_of(truth)
    rig, effects = RIGS[recipe.rig], recipe.effects
    experiment = read_experiment(folder, registry=load_registry())
    held = {run.name: run for run in experiment.runs if run.holdout}
    sliders = {plan: recipe.acting(plan) for plan in recipe.plans}
    known = {}
    for plan, p in sliders.items():
        if plan.name in held:
            run = held[plan.name]
            made = noiseless_record(rig, p, plan) * (rig.factor if rig.observes == "force" else 1.0)
            known[plan.name] = float(np.sqrt(np.mean((run.observed - made)[run.used] ** 2)))
    fitted = {plan: p for plan, p in sliders.items() if not plan.holdout}
    stands = {
        e.name: effect_standard_errors(e, [o for o in effects if o is not e], fitted, gauge=recipe.gauge, rig=rig)
        for e in effects
    }
    return Detectability(folder.name, known, {n: s for n, (s, _) in stands.items()}, {n: r for n, (_, r) in stands.items()})


def effect_standard_errors(effect: Effect, others: Sequence[Effect], sliders: Mapping[Plan, Physics], *, gauge: Gauge,
               rig: Rig = PAPER) -> tuple[float | None, float | None]:  # fmt: skip
    """Return how many standard errors an effect stands out of runs, with the baseline free and with it known.

    `sliders` are the runs and what is true in each. The baseline's parameters and the sizes of the `others` are free to first
    order, from the slider without the effect. A random friction field is taken as known: where it is not, less is
    seen. Elongations of a wrong stiffness are held against those of lambda times its ratio and of the friction coefficients,
    and a mass that is free, over it: without inertia they are the same.
    """
    signals, tangents, raw = [], [], 0.0
    bare = {plan: effect.removed(p) for plan, p in sliders.items()}
    free = free_fields(next(iter(bare.values())))
    free += [o.varies for o in others if o.varies not in free and any(getattr(p, o.varies) for p in bare.values())]
    for plan, p in sliders.items():
        less, shows = bare[plan], noiseless_record(rig, p, plan)
        base = noiseless_record(rig, less, plan)
        raw = float(np.hypot(raw, np.linalg.norm(white(shows - base, gauge.louder(plan.loud)))))
        if effect.varies == "ratio" and rig.observes == "elongation":
            scaled = [n for n in COEFFICIENTS if n != "M" or any(o.varies == n for o in others)]
            less = replace(less, lam=less.lam * p.ratio, **{n: getattr(less, n) / p.ratio for n in scaled})
            base = noiseless_record(rig, less, plan)
        moved = [noiseless_record(rig, replace(less, **{n: getattr(less, n) * (1 + PARAMETER_STEP)}), plan) for n in free]
        signal = shows - base
        tangent = np.column_stack([(x - base) / PARAMETER_STEP for x in moved])
        if not (np.isfinite(signal).all() and np.isfinite(tangent).all()):
            return None, None
        whitened = white(np.column_stack([signal, tangent]), gauge.louder(plan.loud))
        signals.append(whitened[:, 0])
        tangents.append(whitened[:, 1:])
    signal, tangent = np.concatenate(signals), np.concatenate(tangents)
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=0), 1e-12)
    left = signal - tangent @ np.linalg.lstsq(tangent, signal, rcond=1e-10)[0]
    return float(np.linalg.norm(left)), raw


def detectabilities_of(
    bank: Path, truths: Mapping[str, Mapping[str, Any]], *, workers: int, kept: Path
) -> Iterator[Detectability]:
    """Yield what there was to be seen in every case; what the file `kept` holds is not computed again."""
    found = _read(kept)
    yield from (detectability for name, detectability in found.items() if name in truths)
    names = [name for name in truths if name not in found]
    for _, detectability in run_processes(detectability_of, [(bank / n, truths[n]) for n in names], workers=workers):
        found[detectability.case] = detectability
        write_atomic(kept, "".join(json.dumps(asdict(found[n]), sort_keys=True) + "\n" for n in sorted(found)))
        yield detectability


def _read(kept: Path) -> dict[str, Detectability]:
    if not kept.exists():
        return {}
    try:
        detectabilities = [Detectability(**json.loads(line)) for line in read_text(kept).splitlines()]
    except (SrfError, ValueError, TypeError, RecursionError) as error:
        raise SrfError(f"{kept}: not what was written: {error}", "Delete the file; it is computed again.") from None
    return {detectability.case: detectability for detectability in detectabilities}


# The size of an effect as it was estimated, against the size it has in the truth.


def deviation(truth: Mapping[str, Any], answer: Answer) -> tuple[float, float] | None:
    """Return how far the estimated size is from the true one, in its standard errors and relative to the true size.

    None unless one effect is concealed and the same is named, in the form it has, with an error.
    """
    if len(truth["effects"]) != 1 or answer.effects != tuple(truth["effects"]):
        return None
    forms = [e for e in EFFECTS if e.name == truth["effects"][0]]
    effect = next((e for e in forms if len(forms) == 1 or e.varies in truth["truth"]), None)
    found = answer.parameters.get(effect.parameter) if effect else None
    if effect is None or found is None or found["unit"] != effect.unit:
        return None
    true, value, error = effect.told_size(truth["physics"]), found["value"], found["stderr"]
    if value is None or not error or not true:
        return None
    unsigned = any(name.endswith("_phase") for name in effect.beside)  # its sign is a matter of the phase
    off = abs(value) - abs(true) if unsigned else value - true
    return off / error, abs(off / true)


def load_errors(truth: Mapping[str, Any], answer: Answer) -> tuple[float, float] | None:
    """Return how far critical loads are off those of the true equations, augmented model and baseline: rms of ln W0c/W0c.

    At the velocities at which all three have one; None where there are none.
    """
    if not answer.loads:
        return None
    recipe = recipe_of(truth)
    p, W0 = recipe.physics, recipe.plans[0].W0
    p = without(p, recipe.effects) if recipe.only else p  # elsewhere it is no part of the system
    V, ours, base = (np.array(answer.loads[name], dtype=float) for name in ("V", "augmented", "baseline"))
    true = np.array([critical_load(p, v, 1e-3 * W0, 1e3 * W0) for v in V.tolist()])
    there = np.isfinite(true) & np.isfinite(ours) & np.isfinite(base)
    if not there.any():
        return None
    off, before = (float(np.sqrt(np.mean(np.log(x[there] / true[there]) ** 2))) for x in (ours, base))
    return off, before


# Marks as tables: confusion, rates, power, calibration, held-out errors, sizes and cost.

SCHEMA = "srf.prove/1"
STANDS_OUT = (0.0, MIN_VISIBLE_SIGMAS, 10.0, 20.0, 50.0, 200.0, float("inf"))
STRENGTHS = (0.0, 1 / 3, 2 / 3, 1.0)
LONGEST_CPU = 300.0  # s of CPU: a case should take less
WITHIN = 1.1  # of the true model's error
SHARE_COLUMNS = (
    Column("share", "1", "of the cases", ".3f"),
    Column("low", "1", "lower end of Wilson's interval of 95 %", ".3f"),
    Column("high", "1", "its upper end", ".3f"),
)
COUNTED = (Column("hits", "1", "for how many cases it holds"), Column("cases", "1", "of how many"), *SHARE_COLUMNS)


def tables(marks: Sequence[GradedAnswer], *, digest: str, seed: int, of: int) -> tuple[Table, list[Table]]:
    """Return the confusion table, whose `meta` holds everything, and the tables that text shows below it."""
    made = (
        rates,
        by_effect,
        by_outside,
        by_setting,
        by_strength,
        calibrated,
        held_out_errors,
        critical_load_errors,
        size_errors,
        cost,
        ablated,
    )
    more = [t for t in (make(marks) for make in made) if t.rows]
    meta: dict[str, Any] = {
        "digest": digest,
        "seed": seed,
        "cases": of,
        "answered": len(marks),
        "code": sorted({m.answer.code for m in marks}),
        "calibration_error": calibration_of(marks)[1],
        **{t.schema.split("/")[0].split(".")[-1]: t.records() for t in more},
        "marks": [row_of(m) for m in marks],
    }
    first = confusion(marks)
    notes = [f"{len(marks)} cases, seed {seed}; SHA-256 of the truths {digest}"]
    if len(marks) < of:
        notes.append(f"{of - len(marks)} further cases were given up without an answer")
    if len(meta["code"]) > 1:
        notes.append(f"answered by {len(meta['code'])} different states of the program: {', '.join(meta['code'])}")
    return replace(first, notes=tuple(notes), meta=meta), more


def _cells(found: Rate) -> tuple[Any, ...]:
    return (found.hits, found.count, found.share, *found.interval)


FIELDS = ((False, False, "smooth"), (True, False, "one field for all runs"), (True, True, "a field of each run's own"))


def confusion(marks: Sequence[GradedAnswer]) -> Table:
    """Return true kinds against verdicts; `right` counts the effects too, where they are named."""
    columns = (Column("concealed", ""), Column("cases"), *map(Column, VERDICTS), Column("right"), Column("class_right"))
    rows = []
    for kind, (rough, own, told) in product(WIDE_KINDS, FIELDS):
        chosen = [m for m in marks if m.kind == kind and m.rough == rough and m.own_track == own]
        if chosen:
            counts = [sum(m.answer.verdict == v for m in chosen) for v in VERDICTS]
            sums = (sum(m.right for m in chosen), sum(m.class_right for m in chosen))
            rows.append((f"{kind}, {told}" if rough else kind, len(chosen), *counts, *sums))
    return Table(SCHEMA, columns, rows, "What was concealed, and the verdict on it")


def rates(marks: Sequence[GradedAnswer]) -> Table:
    """Return the rates on which a diagnosis is judged, with what it should reach."""
    none = [m for m in marks if m.kind == "none"]
    some = [m for m in marks if m.kind != "none"]
    outside = [m for m in marks if m.kind == "outside"]
    named = [m for m in marks if m.answer.verdict == "identified"]
    rows: list[tuple[Any, ...]] = []

    def add(what: str, chosen: Sequence[GradedAnswer], flag: Callable[[GradedAnswer], bool], aim: str = "") -> None:
        if chosen:
            rows.append((what, *_cells(rate(flag(m) for m in chosen)), aim or None))

    add("right", marks, lambda m: m.right, ">= 0.9")
    add("right, without a field", [m for m in marks if not m.rough], lambda m: m.right)
    add("right, with a field", [m for m in marks if m.rough], lambda m: m.right)
    add("right, a track of each run's own", [m for m in marks if m.own_track], lambda m: m.right)
    add("right, or ambiguous and listed", marks, lambda m: m.class_right)
    add("false alarm where nothing is concealed", none, lambda m: m.alarm, "< 0.05")
    add("false alarm, without a field", [m for m in none if not m.rough], lambda m: m.alarm)
    add("false alarm, with a field", [m for m in none if m.rough], lambda m: m.alarm, "< 0.05")
    add(f"wrong name, stated above {HIGH_CONFIDENCE}", marks, lambda m: m.confident_wrong)
    add("wrong name, of all names", named, lambda m: m.wrong_name)
    ageing = [m for m in marks if m.kind == "ageing"]
    alone = [m for m in marks if m.kind == "one-run"]
    add("ageing law named, where another is stated", ageing, lambda m: m.right)
    add("effect in one run: named, or unknown", alone, lambda m: m.right)
    add("effect in one run: named, and the run", alone, lambda m: m.located)
    add("unknown recognised", outside, lambda m: m.answer.verdict == "unknown", ">= 0.8")
    add("unknown recognised, where visible", [m for m in outside if m.visible], lambda m: m.answer.verdict == "unknown")
    add("something concealed is invisible", some, lambda m: not m.visible)
    add("failed", marks, lambda m: m.answer.verdict == "failed")
    columns = (Column("measure", ""), *COUNTED, Column("aim", "", "what it should reach"))
    note = (f"invisible: fewer than {MIN_VISIBLE_SIGMAS:g} standard errors of its size, had one known its form; none, "
            "inconclusive and ambiguous are right there")  # fmt: skip
    return Table("srf.prove.rates/1", columns, rows, "Rates", (note,))


def by_effect(marks: Sequence[GradedAnswer]) -> Table:
    """Return, for each effect of the library, how often it was found alone, and named where it was one of two."""
    columns = (
        Column("effect", ""), *COUNTED, Column("class_right"), Column("invisible"), Column("in_pairs"),
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


def by_outside(marks: Sequence[GradedAnswer]) -> Table:
    """Return, for each effect outside the library, how often it was called unknown, and what it was called else."""
    columns = (Column("outside", ""), *COUNTED, Column("invisible"), Column("called", "", "verdicts other than unknown"))
    rows = []
    for name in sorted({n for m in marks if m.kind == "outside" for n in m.hidden}):
        chosen = [m for m in marks if name in m.hidden]
        called = sorted(m.answer.said or m.answer.verdict for m in chosen if m.answer.verdict != "unknown")
        found = rate(m.answer.verdict == "unknown" for m in chosen)
        rows.append((name, *_cells(found), sum(not m.visible for m in chosen), ", ".join(called) or None))
    return Table("srf.prove.outside/1", columns, rows, "Outside the library: unknown")


def by_setting(marks: Sequence[GradedAnswer]) -> Table:
    """Return how often the answer was right by each circumstance in which something, or nothing, was concealed."""
    columns = (
        Column("circumstance", ""), Column("value", ""), *COUNTED, Column("false_alarms", about="where nothing is concealed"),
        Column("nothing", about="cases that conceal nothing"), Column("named_wrongly", about="cases named wrongly"),
    )  # fmt: skip
    rows = []
    for name, value in dict.fromkeys(pair for m in marks for pair in m.set_in.items()):
        chosen = [m for m in marks if m.set_in.get(name) == value]
        nothing = [m for m in chosen if m.kind == "none"]
        counts = (sum(m.alarm for m in nothing), len(nothing), sum(m.wrong_name for m in chosen))
        rows.append((name, value, *_cells(rate(m.right for m in chosen)), *counts))
    order = list(dict.fromkeys(name for m in marks for name in m.set_in))
    rows.sort(key=lambda row: (order.index(row[0]), row[1]))
    return Table("srf.prove.settings/1", columns, rows, "By apparatus, protocol, law, noise and field: right")


def by_strength(marks: Sequence[GradedAnswer]) -> Table:
    """Return the power: how often something is seen, and named rightly, against how far one effect stands out."""
    columns = (
        Column("measure", ""), Column("from", format=".3g"), Column("to", format=".3g"), Column("cases"),
        Column("seen", about="the verdict says that something is missing"), Column("named", about="identified, and rightly"),
        *SHARE_COLUMNS,
    )  # fmt: skip
    single = [m for m in marks if m.kind == "single"]
    rows: list[tuple[Any, ...]] = []

    def add(measure: str, edges: Sequence[float], value: Callable[[GradedAnswer], float | None]) -> None:
        for low, high in pairwise(edges):
            chosen = [m for m in single if (v := value(m)) is not None and (low <= v < high or v == high == edges[-1])]
            if chosen:
                named = rate(m.right and m.answer.verdict == "identified" for m in chosen)
                seen = sum(m.alarm for m in chosen)
                rows.append((measure, low, high, len(chosen), seen, named.hits, named.share, *named.interval))

    add("standard errors", STANDS_OUT, lambda m: m.sigmas)
    add("drawn size", STRENGTHS, lambda m: m.size)
    notes = ("standard errors: of its size, with the baseline free, the effect's form and a random friction field known",
             "drawn size: 0 weak to 1 strong, on a logarithmic scale")  # fmt: skip
    return Table("srf.prove.power/1", columns, rows, "Power: one effect concealed", notes if rows else ())


def calibration_of(marks: Sequence[GradedAnswer]) -> tuple[tuple[Bin, ...], float | None]:
    """Return how the confidence in the likeliest hypothesis compares with how often it is the truth."""
    spoken = [m for m in marks if m.top]
    return calibration([m.stated for m in spoken], [m.hit for m in spoken])


def calibrated(marks: Sequence[GradedAnswer]) -> Table:
    """Return the stated confidence of the likeliest hypothesis against how often it was the truth."""
    bins, error = calibration_of(marks)
    columns = (
        Column("from"), Column("to"), Column("cases"), Column("stated", about="mean", format=".3f"),
        Column("found", about="how often it was the truth", format=".3f"), *SHARE_COLUMNS[1:],
    )  # fmt: skip
    rows = [(b.low, b.high, b.rate.count, b.stated, b.rate.share, *b.rate.interval) for b in bins]
    notes = () if error is None else (f"expected calibration error {error:.3f}; it should be below 0.05",)
    return Table("srf.prove.calibration/1", columns, rows, "Stated confidence of the likeliest hypothesis", notes)


GROUPS: tuple[tuple[str, Callable[[GradedAnswer], bool]], ...] = (
    ("named rightly", lambda m: m.right and m.answer.verdict == "identified"),
    ("named wrongly", lambda m: m.wrong_name),
    ("ambiguous", lambda m: m.answer.verdict == "ambiguous"),
    ("unknown", lambda m: m.answer.verdict == "unknown"),
    ("none or inconclusive", lambda m: m.answer.verdict in ("none", "inconclusive")),
)


def held_out_errors(marks: Sequence[GradedAnswer]) -> Table:
    """Return the held-out error over that of the model that knows the truth."""
    columns = (
        Column("answers", ""), Column("cases"), Column("median", format=".3f"), Column("q90", format=".3f"),
        Column("within", about=f"at most {WITHIN}", format=".3f"), Column("baseline_median", format=".3f"),
    )  # fmt: skip
    rows = []
    for (name, chosen), rough in product(GROUPS, (False, True)):
        errors = [(m.error, m.baseline_error) for m in marks if m.rough == rough and chosen(m) and m.error is not None]
        if errors:
            ours, base = [e for e, _ in errors], [b for _, b in errors if b is not None]
            within = sum(e <= WITHIN for e in ours) / len(ours)
            title = f"{name}, with a field" if rough else name
            rows.append((title, len(ours), quantile(ours, 0.5), quantile(ours, 0.9), within, quantile(base, 0.5)))
    note = "rms of held-out runs, over that of the model that knows the truth and the track; `within` 1.1 of it"
    return Table("srf.prove.held/1", columns, rows, "Held-out error", (note,) if rows else ())


def critical_load_errors(marks: Sequence[GradedAnswer]) -> Table:
    """Return how far the critical loads of the models are off those of the truth, beyond the velocities of the recordings."""
    columns = (
        Column("answers", ""), Column("cases"), Column("median", format=".3g"), Column("q90", format=".3g"),
        Column("baseline_median", format=".3g"), Column("baseline_q90", format=".3g"), Column("nearer", format=".3f"),
    )  # fmt: skip
    rows = []
    for name, chosen in GROUPS:
        errors = [m.loads for m in marks if chosen(m) and m.loads is not None]
        if errors:
            ours, base = ([e[k] for e in errors] for k in (0, 1))
            nearer = sum(a <= b for a, b in errors) / len(errors)
            spread = [quantile(x, q) for x in (ours, base) for q in (0.5, 0.9)]
            rows.append((name, len(errors), *spread, nearer))
    note = ("relative error of critical loads at a tenth, a third, 3 and 10 times the velocities driven, by the truth's "
            "equations; nearer: as the baseline's, or less")  # fmt: skip
    return Table("srf.prove.loads/1", columns, rows, "Critical loads off the recordings", (note,) if rows else ())


def size_errors(marks: Sequence[GradedAnswer]) -> Table:
    """Return how well the sizes of rightly named effects, and their standard errors, hold."""
    columns = (
        Column("tracks", ""), Column("within_2", about="no more than 2 standard errors off"), Column("cases"), *SHARE_COLUMNS,
        Column("median_off", about="median of the distance, in standard errors", format=".2f"),
        Column("median_relative", about="the same, relative to the size", format=".3f"),
    )  # fmt: skip
    rows = []
    for rough in (False, True):
        found = [m.deviation for m in marks if m.deviation is not None and m.rough == rough]
        if found:
            off = [abs(sigmas) for sigmas, _ in found]
            medians = (quantile(off, 0.5), quantile([r for _, r in found], 0.5))
            rows.append(("one" if rough else "none", *_cells(rate(x <= 2 for x in off)), *medians))
    return Table("srf.prove.sizes/1", columns, rows, "Sizes of the effects that were named rightly, alone")


def cost(marks: Sequence[GradedAnswer]) -> Table:
    """Return what a case takes of CPU."""
    columns = (
        Column("cases"), Column("median", "s", format=".1f"), Column("q90", "s", format=".1f"), Column("max", "s", format=".1f"),
        Column("under_300_s", about="share of the cases", format=".3f"), Column("total", "h", format=".2f"),
    )  # fmt: skip
    times = [m.answer.cpu for m in marks]
    rows = []
    if times:
        short = sum(t < LONGEST_CPU for t in times) / len(times)
        rows = [(len(times), quantile(times, 0.5), quantile(times, 0.9), max(times), short, sum(times) / 3600)]
    return Table("srf.prove.cost/1", columns, rows, "CPU of a diagnosis")


CASES = (
    Column("case", ""), Column("kind", ""), Column("concealed", ""), Column("field", ""), Column("invisible"),
    Column("sigmas", format=".3g"), Column("size", format=".3g"), Column("verdict", ""), Column("effects", ""),
    Column("stated", format=".3f"), Column("top", ""), Column("top_stated", format=".3f"), Column("right"),
    Column("class_right"), Column("error", format=".3f"), Column("baseline_error", format=".3f"),
    Column("cpu", "s", format=".1f"), Column("failure", ""),
)  # fmt: skip


def cases(marks: Sequence[GradedAnswer]) -> Table:
    """Return one row per case: what was concealed, what was said, and the mark."""
    return Table("srf.prove.cases/1", CASES, [tuple(row_of(m).values()) for m in marks], "Cases")


def row_of(m: GradedAnswer) -> Mapping[str, Any]:
    """Return a mark as name -> value, by the columns of CASES."""
    a = m.answer
    values = (
        a.case, m.kind, "+".join(m.hidden) or None, m.rough, "+".join(m.invisible) or None, m.sigmas, m.size, a.verdict,
        "+".join(a.effects) or None, a.confidence.get(a.said), m.top or None, m.stated if m.top else None, m.right,
        m.class_right, m.error, m.baseline_error, a.cpu, a.failure or None,
    )  # fmt: skip
    return dict(zip([c.name for c in CASES], values, strict=True))


# Counts as rates with intervals, and stated confidence against how often it was right.

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
        found = binomtest(self.hits, self.count).proportion_ci(method="wilson")
        return float(found.low), float(found.high)


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


def quantile(values: Sequence[float], share: float) -> float | None:
    """Return the value that `share` of them do not exceed, by linear interpolation; None of none."""
    return float(np.quantile(values, share)) if values else None


# Ablations: the same searches, judged without some of the tests.

VerdictRule = Callable[[Answer], tuple[str, frozenset[str]]]


def as_answered(answer: Answer) -> tuple[str, frozenset[str]]:
    """Return the verdict, and the effects that it names."""
    return answer.verdict, frozenset(answer.effects) if answer.verdict == "identified" else frozenset()


def ungated(answer: Answer) -> tuple[str, frozenset[str]]:
    """Return what would have been said had held-out runs no say."""
    if answer.ungated in ("", answer.verdict):
        return as_answered(answer)
    return answer.ungated, hypothesis(_named(answer))[1] if answer.ungated == "identified" else frozenset()


def information_criterion(answer: Answer) -> tuple[str, frozenset[str]]:
    """Return what the smallest Bayesian information criterion says: always a model, whatever it leaves over."""
    if not answer.tried:
        return as_answered(answer)

    def criterion(name: str) -> float:
        t = answer.tried[name]
        return t["log_likelihood"] - 0.5 * t["parameters"] * log(t["samples"])

    return hypothesis(max(sorted(answer.tried), key=criterion))


def _named(answer: Answer) -> str:
    """Return the hypothesis that is named where no run is held out: the best that leaves noise alone and holds no smaller one."""
    evidence = {name: t["evidence"] for name, t in answer.tried.items()}
    top = max(evidence.values())
    close = [n for n in sorted(evidence) if answer.tried[n]["fine"] and top - evidence[n] < LOG_BAYES_MARGIN]
    smallest = [n for n in close if not any(hypothesis(other)[1] < hypothesis(n)[1] for other in close)]
    return max(smallest or sorted(evidence), key=evidence.__getitem__)


VERDICT_RULES: tuple[tuple[str, VerdictRule], ...] = (
    ("as it is", as_answered),
    ("no held-out gate", ungated),
    ("information criterion alone", information_criterion),
)


def ablated(marks: Sequence[GradedAnswer]) -> Table:
    """Return the main rates of the verdicts, and of what would have been said without a gate."""
    columns = (
        Column("judged", ""), Column("cases"), Column("right", format=".3f"),
        Column("false_alarms", about="where nothing is concealed", format=".3f"),
        Column("wrong_names", about="share of all cases", format=".3f"),
        Column("unknown_recognised", format=".3f"),
    )  # fmt: skip
    chosen = [m for m in marks if m.answer.tried]
    rows = []
    for title, judge in VERDICT_RULES if chosen else ():
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
