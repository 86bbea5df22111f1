"""A diagnosis as plain data: the object that `srf diagnose --json` prints, and what tables and figures are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from srfcli.codegen.model import Array
from srfcli.data.values import CriticalLoads, Run
from srfcli.diagnosis.design import DiscriminatingRun, described
from srfcli.diagnosis.residual_scan import Location
from srfcli.diagnosis.verdict import Diagnosis, parameters_of
from srfcli.inference.state_space import Filtered

SCHEMA = "srf.diagnose/1"


@dataclass(frozen=True)
class RunView:
    """One run under both models: what each expects of a reading (n,), given those before it, in the observable's unit.

    `white` are the innovations over their standard deviations (n,), by baseline and by the augmented model, `rms` their root mean
    squares.
    """

    run: Run
    baseline: Array
    augmented: Array
    rms: tuple[float, float]
    white: tuple[Array, Array] = field(repr=False)
    others: tuple[tuple[Array, Array], ...] = field(repr=False, default=())

    @property
    def size(self) -> int:
        """Return how many readings count."""
        return int(self.run.used.sum())


def run_views(diagnosis: Diagnosis) -> tuple[RunView, ...]:
    """Return every run under baseline and augmented model, fitted ones first."""
    before, after = diagnosis.reported_baseline.fit.maximum.point.runs, diagnosis.best.fit.maximum.point.runs
    same = diagnosis.best is diagnosis.baseline
    held = ((h.reported_baseline, h.reported_baseline if same else h.augmented) for h in diagnosis.held)
    return tuple(_view(b, a) for b, a in (*zip(before, after, strict=True), *held))


def _view(before: Filtered, after: Filtered) -> RunView:
    run, sides = before.run, (before, after)
    y = [run.observed - f.found.nu for f in sides]
    white = [f.found.nu / np.sqrt(f.found.S) for f in sides]
    rms = [float(np.sqrt(np.mean(w[run.used] ** 2))) for w in white]
    others = tuple((s.observed - before.of(i).nu, s.observed - after.of(i).nu) for i, s in enumerate(run.others, 1))
    return RunView(run, y[0], y[1], (rms[0], rms[1]), (white[0], white[1]), others)


def answer(diagnosis: Diagnosis, location: Location, *, discriminating: DiscriminatingRun | None = None) -> dict[str, Any]:
    """Return the object of the format `srf.diagnose/1`; `discriminating` is the run that tells apart what is ambiguous."""
    views, loads, last = run_views(diagnosis), load_views(diagnosis), diagnosis.best
    held: list[RunView | LoadView] = [*(v for v in views if v.run.holdout), *(v for v in loads if v.loads.holdout)]
    sides = {}
    for place, (name, fitted, own) in enumerate(
        (("baseline", diagnosis.reported_baseline, diagnosis.baseline), ("augmented", last, last))
    ):
        values = own.fit.values
        sides[name] = {
            "parameters": parameters_of(fitted),
            "fit": {"rms_over_noise": fitted.fit.maximum.point.rms},
            "holdout": {"rms_over_noise": pooled_rms(held, place)},
            "field": None if own.fit.smooth else {"amplitude": values["field_amplitude"], "length_um": values["field_length"]},
        }
    found = {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict,
        "effects": list(diagnosis.effects),
        "equivalent": [list(pair) for pair in diagnosis.equivalent],
        "not_identifiable": [{"effect": x.effect, "reason": x.reason} for x in diagnosis.not_identifiable],
        "confidence": dict(diagnosis.confidence),
        **sides,
        "location": location.described(),
        "model": "augmented/experiment.toml",
        "reasons": list(diagnosis.reasons),
    }
    if diagnosis.acts_in:
        found["acts_in"] = diagnosis.acts_in
    if loads:
        found["thresholds"] = [
            {"name": v.loads.name, "holdout": v.loads.holdout, "loads": v.size, "chi2": dict(zip(sides, v.chi2, strict=True))}
            for v in loads
        ]
    if diagnosis.verdict == "inconclusive":
        found["detectable"] = dict(diagnosis.detectable)
    if diagnosis.verdict == "ambiguous" and discriminating is not None:
        found["experiment"] = described(discriminating, diagnosis.experiment)
    return found


@dataclass(frozen=True)
class LoadView:
    """One table of critical loads under both models: arrays (n,) of computed loads, NaN where there is none, and chi2."""

    loads: CriticalLoads
    baseline: Array
    augmented: Array
    chi2: tuple[float, float]

    @property
    def size(self) -> int:
        """Return how many loads there are."""
        return len(self.loads.table)

    @property
    def rms(self) -> tuple[float, float]:
        """Return the root mean squares of the residuals over their errors."""
        return float(np.sqrt(self.chi2[0] / self.size)), float(np.sqrt(self.chi2[1] / self.size))


def load_views(diagnosis: Diagnosis) -> tuple[LoadView, ...]:
    """Return every table of critical loads under baseline and augmented model, fitted ones first."""
    fitted = zip(*(f.fit.maximum.point.tables for f in (diagnosis.reported_baseline, diagnosis.best)), strict=True)
    same = diagnosis.best is diagnosis.baseline
    held = ((h.baseline, h.baseline if same else h.augmented) for h in diagnosis.held_loads)
    views = []
    for sides in (*fitted, *held):
        before, after = (np.where(t.match.missing, np.nan, t.match.loads) for t in sides)
        views.append(LoadView(sides[0].loads, before, after, (sides[0].match.cost, sides[1].match.cost)))
    return tuple(views)


def pooled_rms(views: Sequence[RunView | LoadView], place: int) -> float | None:
    """Return the root mean square over the noise of several runs and tables together; None of none."""
    if not views:
        return None
    sizes = np.array([v.size for v in views], dtype=float)
    squares = np.array([v.rms[place] ** 2 for v in views])
    return float(np.sqrt(sizes @ squares / sizes.sum()))


def ranked_rows(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return what was fitted, best evidence first; of models that are equal to the digit shown, the final one."""
    became = {name: f"it has become {law}" for name, law in diagnosis.became.items()}
    ranked = sorted(diagnosis.ranked, key=lambda f: (-round(f.evidence, 1), f is not diagnosis.best))
    told = {f.name for f in diagnosis.close} if diagnosis.verdict == "ambiguous" else {diagnosis.best.name}
    return [
        {"name": f.name, "evidence": f.evidence, "rms_over_noise": f.fit.maximum.point.rms,
         "field": 0.0 if f.fit.smooth else f.fit.values["field_amplitude"], "confidence": diagnosis.confidence.get(f.name, 0.0),
         "against": f.against[0] if f.against else became.get(f.name, ""),
         "told": diagnosis.verdict != "unknown" and f.name in told}
        for f in ranked
    ]  # fmt: skip


def parameter_rows(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return each parameter under both models, and the shift of the baseline's, in the augmented model's standard errors."""
    before, after = parameters_of(diagnosis.reported_baseline), parameters_of(diagnosis.best)
    rows = []
    for name in dict.fromkeys([*before, *after]):
        a, b = before.get(name), after.get(name)
        row: dict[str, Any] = {"name": name, "unit": (b or a or {})["unit"]}
        row |= {"baseline": a and a["value"], "baseline_stderr": a and a["stderr"]}
        row |= {"augmented": b and b["value"], "augmented_stderr": b and b["stderr"]}
        row["shift_sigma"] = (a["value"] - b["value"]) / b["stderr"] if a and b and b["stderr"] > 0 else None
        rows.append(row)
    return rows
