"""A diagnosis as plain data: the object that `srf diagnose --json` prints, and what tables and figures are made of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from srfcli.codegen.model import Array
from srfcli.core.units import find_unit, from_base, split_quantity
from srfcli.data.values import Run
from srfcli.diagnosis.design import Parting, described
from srfcli.diagnosis.hypotheses import Refit
from srfcli.diagnosis.residual_scan import Location, Row
from srfcli.diagnosis.verdict import NOTHING, Diagnosis
from srfcli.inference.noise import stretches, whiten
from srfcli.inference.prediction import of_run
from srfcli.inference.random_field import LatentFit

SCHEMA = "srf.diagnose/1"


@dataclass(frozen=True)
class RunView:
    """One run under both models: observed and predictions (n,) in the observable's unit, the place `slip` (n,) in um.

    `rms` holds the residuals' root mean square over the noise, by baseline and by the final model; `noise` is the gauge's level.
    """

    run: Run
    holdout: bool
    baseline: Array
    augmented: Array
    rms: tuple[float, float]
    noise: float
    slip: Array


def final(diagnosis: Diagnosis) -> Refit:
    """Return the model that the answer calls augmented: the baseline itself where nothing is to be added."""
    return diagnosis.baseline if diagnosis.verdict in NOTHING else diagnosis.best


def run_views(diagnosis: Diagnosis) -> tuple[RunView, ...]:
    """Return every run under baseline and final model, fitted ones first."""
    before, after = diagnosis.baseline.fit, final(diagnosis).fit
    same = final(diagnosis) is diagnosis.baseline
    found = []
    for run in before.problem.runs:
        y0, y1 = before.point.predictions[run.name].y, after.point.predictions[run.name].y
        noise = diagnosis.noise[run.name]
        parts = stretches(run.t, run.used)
        rms = [float(np.sqrt(np.mean(whiten(noise, run.observed - y, parts) ** 2))) for y in (y0, y1)]
        found.append(RunView(run, False, y0, y1, (rms[0], rms[1]), noise.level, slip_of(run, y0)))
    for held in diagnosis.held:
        run = replace(held.run, holdout=True)
        y1, rms1 = (held.baseline, held.rms_baseline) if same else (held.augmented, held.rms_augmented)
        found.append(
            RunView(run, True, held.baseline, y1, (held.rms_baseline, rms1), held.level, slip_of(run, held.baseline))
        )
    return tuple(found)


def slip_of(run: Run, predicted: Array) -> Array:
    """Return the slider's place on the track (n,) in um: what the stage moved less what the spring was stretched."""
    V = run.drive(run.t)
    moved = np.concatenate([[0.0], np.cumsum(0.5 * (V[1:] + V[:-1]) * np.diff(run.t))])
    u = (
        predicted
        * {"elongation": 1.0, "force": 1 / run.stiffness, "friction": run.load(run.t)[0] / run.stiffness}[
            run.observable
        ]
    )
    return np.asarray(run.start + moved - (u - u[0]))


def parameters_of(fitted: LatentFit) -> dict[str, dict[str, Any]]:
    """Return the free parameters in their declared units with standard errors; a stiffness also as a ratio to the stated one."""
    units = {q.name: q.unit for q in fitted.problem.experiment.parameters}
    errors = np.sqrt(np.maximum(np.diag(fitted.covariance), 0.0))
    found: dict[str, dict[str, Any]] = {}
    for name, value, error in zip(fitted.problem.names, fitted.point.theta.tolist(), errors.tolist(), strict=True):
        unit = units.get(name, "1")
        found[name] = {"value": from_base(value, unit), "stderr": from_base(error, unit), "unit": unit}
    if "K" in found:
        number, unit = split_quantity(fitted.problem.experiment.stiffness_text, name="stiffness")
        stated = from_base(number * find_unit(unit).factor, found["K"]["unit"])
        found["ratio"] = {"value": found["K"]["value"] / stated, "stderr": found["K"]["stderr"] / stated, "unit": "1"}
    return found


def answer(
    diagnosis: Diagnosis,
    location: Location,
    *,
    model: str = "augmented/experiment.toml",
    parting: Parting | None = None,
) -> dict[str, Any]:
    """Return the object of the format `srf.diagnose/1`; `model` is where the augmented experiment is, relative to it.

    `parting` is the run that would part what is ambiguous.
    """
    views, last = run_views(diagnosis), final(diagnosis)
    sides = {}
    for place, (name, refit) in enumerate((("baseline", diagnosis.baseline), ("augmented", last))):
        sides[name] = {
            "parameters": parameters_of(refit.fit),
            "fit": {"rms_over_noise": refit.adequacy.rms_over_noise},
            "holdout": {"rms_over_noise": together([v for v in views if v.holdout], place)},
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
        "model": model,
        "reasons": list(diagnosis.reasons),
    }
    if diagnosis.verdict == "inconclusive":
        found["detectable"] = dict(diagnosis.detectable)
    if diagnosis.verdict == "ambiguous" and parting is not None:
        found["experiment"] = described(parting, diagnosis.experiment)
    return found


def together(views: list[RunView], place: int) -> float | None:
    """Return the root mean square over the noise of several runs together; None of none."""
    if not views:
        return None
    sizes = np.array([int(v.run.used.sum()) for v in views], dtype=float)
    squares = np.array([v.rms[place] ** 2 for v in views])
    return float(np.sqrt(sizes @ squares / sizes.sum()))


def material(diagnosis: Diagnosis, location: Location) -> dict[str, Any]:
    """Return the arrays and tables of which figures and report are made, by name."""
    windows = {r.name: [list(w) for w in r.windows] for r in location.runs}
    runs = []
    for v in run_views(diagnosis):
        W, _ = v.run.load(v.run.t)
        run = {"name": v.run.name, "holdout": v.holdout, "t": v.run.t, "observed": v.run.observed, "used": v.run.used}
        run |= {
            "baseline": v.baseline,
            "augmented": v.augmented,
            "noise_level": v.noise,
            "V": v.run.drive(v.run.t),
            "W": W,
        }
        run |= {
            "slip": v.slip,
            "windows": windows.get(v.run.name, []),
            "observable": v.run.observable,
            "rms": list(v.rms),
        }
        runs.append(run | {"modulation": of_run(v.run)})
    about = {e.reported: e.about for r in diagnosis.ranked for e in r.hypothesis.effects}
    return {
        "title": diagnosis.experiment.title,
        "about": about,
        "runs": runs,
        "atlas": [atlas_row(row) for row in location.atlas],
        "ranked": ranked_rows(diagnosis),
        "parameters": parameter_rows(diagnosis),
        "scores": score_rows(diagnosis),
    }


def atlas_row(row: Row) -> dict[str, Any]:
    """Return a place of the atlas, v in um/s and phi in s, by whose logarithms samples were sorted."""
    found: dict[str, Any] = row.described()
    if row.axis in ("v", "phi"):
        found |= {"low": float(np.exp(row.low)), "high": float(np.exp(row.high))}
    return found


def ranked_rows(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return what was fitted, best evidence first."""
    return [
        {"name": r.name, "evidence": r.evidence, "rms_over_noise": r.adequacy.rms_over_noise, "p_value": r.adequacy.p_value,
         "rough": r.rough, "confidence": diagnosis.confidence.get("+".join(sorted(r.hypothesis.reported)) or "none", 0.0)}
        for r in diagnosis.ranked
    ]  # fmt: skip


def parameter_rows(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return each parameter under both models, and how far the baseline had bent it, in the final model's standard errors."""
    before, after = parameters_of(diagnosis.baseline.fit), parameters_of(final(diagnosis).fit)
    rows = []
    for name in dict.fromkeys([*before, *after]):
        a, b = before.get(name), after.get(name)
        row: dict[str, Any] = {"name": name, "unit": (b or a or {})["unit"]}
        row |= {"baseline": a and a["value"], "baseline_stderr": a and a["stderr"]}
        row |= {"augmented": b and b["value"], "augmented_stderr": b and b["stderr"]}
        row["shift_sigma"] = (a["value"] - b["value"]) / b["stderr"] if a and b and b["stderr"] > 0 else None
        rows.append(row)
    return rows


def score_rows(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return what each effect could still explain, at first order."""
    return [
        {"effect": s.effect.name, "gain": s.gain, "size": s.size, "stderr": s.stderr, "surviving": s.surviving,
         "detectable": s.detectable}
        for s in diagnosis.scores
    ]  # fmt: skip
