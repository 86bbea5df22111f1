"""Concealed cases: an experiment's folder on one side, the truth about it on the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.errors import SrfError
from srfcli.output.files import write_atomic
from srfcli.proof.draw import Gauge, Recipe, draw_recipe
from srfcli.proof.effects import Effect
from srfcli.proof.folder import case_files
from srfcli.proof.gauge import play, read_gauge
from srfcli.proof.motion import Trace, move
from srfcli.proof.physics import Physics
from srfcli.proof.protocol import Plan
from srfcli.proof.track import Track

ATTEMPTS = 8  # draws until every run of a case can be integrated
Array = np.ndarray
Truth = dict[str, Any]


def make_case(
    folder: Path,
    seed: int | Sequence[int],
    *,
    kind: str | None = None,
    effects: Sequence[str] | None = None,
    size: float | None = None,
    rough: bool | float | None = None,
    strengths: bool = True,
) -> Truth:
    """Write a concealed experiment to the new folder `folder` and return the truth about it, ready for JSON.

    `kind` is none, single, pair or outside; `effects` names them instead. With `strengths` every run is moved again without each
    effect, to know how far it moves the record. The same seed and choices give the same bytes.
    Raises SrfError for unknown names, and where the folder exists.
    """
    if folder.exists():
        raise SrfError(f"{folder} exists already", "A case is never overwritten; name another folder.")
    recipe, motions, attempt = _moving(seed, {"kind": kind, "effects": effects, "size": size, "rough": rough})
    rng = np.random.default_rng([*_whole(seed), attempt, 1])
    readings = {plan: read_gauge(u, recipe.gauge, rng, backlash=recipe.physics.backlash) for plan, u in motions.items()}
    truth = _truth(recipe, attempt, seed)
    if strengths:
        truth["strength"] = {e.name: strength_of(e, recipe, motions) for e in recipe.effects}
    folder.mkdir(parents=True)
    for name, text in case_files("PMMA on PMMA, concealed case", recipe.baseline, readings).items():
        write_atomic(folder / name, text)  # the description last: without it a folder is no experiment
    return truth


def _whole(seed: int | Sequence[int]) -> list[int]:
    return [seed] if isinstance(seed, int) else list(seed)


def _moving(seed: int | Sequence[int], asked: Mapping[str, Any]) -> tuple[Recipe, dict[Plan, Array], int]:
    """Return the first recipe of the seed whose runs all reach their ends, its motions, and how many came before it."""
    for attempt in range(ATTEMPTS):
        recipe = draw_recipe(np.random.default_rng([*_whole(seed), attempt, 0]), **asked)
        motions: dict[Plan, Array] = {}
        for plan in recipe.plans:
            trace = move(recipe.physics, plan)
            if not trace.complete:
                break
            motions[plan] = trace.u
        else:
            return recipe, motions, attempt
    raise SrfError(
        f"none of {ATTEMPTS} sliders drawn from seed {seed} could be followed to the end of its runs",
        "Take another seed.",
    )


def strength_of(effect: Effect, recipe: Recipe, motions: Mapping[Plan, Array]) -> Truth:
    """Return how far one effect moves the record: rms over noise by run, and over all samples of the fitted runs.

    `noncentrality` is the sum of squares over the noise's variance, before a fit of the baseline has absorbed its share; null
    where the slider without the effect cannot be followed.
    """
    less, backlash = effect.removed(recipe.physics), recipe.physics.backlash
    rms: dict[str, float | None] = {}
    total: float | None = 0.0
    for plan, u in motions.items():
        trace = move(less, plan)
        moved = play(trace.u, less.backlash) if less.backlash else trace.u
        change = ((play(u, backlash) if backlash else u) - moved) / recipe.gauge.sigma
        rms[plan.name] = round(float(np.sqrt(np.mean(change**2))), 6) if trace.complete else None
        if not plan.holdout:
            total = total + float(change @ change) if trace.complete and total is not None else None
    return {"rms_over_noise": rms, "noncentrality": None if total is None else round(total, 4)}


def _truth(recipe: Recipe, attempt: int, seed: int | Sequence[int]) -> Truth:
    names = [e.name for e in recipe.effects]
    listed = all(e.listed for e in recipe.effects)
    return {
        "effects": names,
        "verdict": "none" if not names else "identified" if listed else "unknown",
        "resembles": sorted({r for e in recipe.effects for r in e.resembles}),
        "sizes": dict(zip(names, recipe.sizes, strict=True)),
        "truth": {n: v for n, v in _changed(recipe.physics, recipe.baseline).items()},
        "physics": asdict(recipe.physics),
        "baseline": asdict(recipe.baseline),
        "rough": recipe.physics.track.size,
        "gauge": asdict(recipe.gauge),
        "runs": [asdict(plan) for plan in recipe.plans],
        "seed": _whole(seed),
        "attempt": attempt,
    }


def _changed(p: Physics, baseline: Physics) -> dict[str, Any]:
    """Return the fields in which the truth departs from its baseline, or from neutral values."""
    usual = baseline
    return {f.name: getattr(p, f.name) for f in fields(p) if getattr(p, f.name) != getattr(usual, f.name)}


def known_physics(truth: Mapping[str, Any], *, baseline: bool = False) -> Physics:
    """Return the slider that a truth describes, or the one that its stated model describes."""
    values = dict(truth["baseline" if baseline else "physics"])
    return Physics(**{**values, "track": Track(**values["track"])})


def known_plans(truth: Mapping[str, Any]) -> tuple[Plan, ...]:
    """Return the runs of a case from the truth about it."""
    return tuple(
        Plan(**{**r, "drive": tuple(map(tuple, r["drive"])), "steps": tuple(map(tuple, r["steps"]))})
        for r in truth["runs"]
    )


def known_traces(truth: Mapping[str, Any]) -> dict[str, Trace]:
    """Return what a model that knows the truth, the track included, predicts for every run, by the run's name."""
    p = known_physics(truth)
    traces = {plan.name: move(p, plan) for plan in known_plans(truth)}
    return {
        name: replace(trace, u=play(trace.u, p.backlash)) if p.backlash else trace for name, trace in traces.items()
    }


def known_gauge(truth: Mapping[str, Any]) -> Gauge:
    """Return the gauge of a case from the truth about it."""
    return Gauge(**truth["gauge"])
