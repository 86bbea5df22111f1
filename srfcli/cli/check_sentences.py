"""What `srf check` says in words: what the loads of these recordings can and cannot identify, and how the noise was found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from srfcli.inference.reach import Forecast, Reach

CONSTANT = 1e-5  # relative variation of a load that is none
LIMITS = {
    "alpha": (0.05, 0.5),
    "lambda": (0.1, 1.0),
    "n": (0.1, 1.0),
}  # errors from which it can hardly, and cannot be known
SEEN, HIDDEN = 3.0, 0.3  # times the noise of a sample: what stays below is hard to tell from drift, and cannot be told
CAN = "can be identified"
CHANGES = {"alpha": "alpha = 0.2", "lambda": "a change by 10 %", "n": "a change by 0.1"}
SUBJECTS = {
    "alpha": "alpha (Linker-Dieterich: a change of load changes the age)",
    "lambda": "lambda (the interface's elastic length)",
    "n": "n (the exponent with which the interface stiffens under load)",
}
NOISE = (
    "noise: about parabolas over 64 samples (and a modulation's harmonics), in the calmest quarter of them; lag1 is its "
    "correlation from sample to sample; white is the floor of the spectrum's upper half"
)


def sentences(forecast: Forecast) -> list[str]:
    """Return what the loads tell: the runs whose load is constant, a sentence for each name asked for, and what that rests on."""
    constant = [r.name for r in forecast.runs if r.variation < CONSTANT]
    told = [f"the load is constant in {_listed(constant)}"] if constant else []
    told += [_not_believed(r) for r in forecast.runs if not r.believed or not r.status.ok]
    judge = forecast.together or next((r for r in forecast.runs if r.believed), None)
    if judge is None:
        return [*told, "what the loads can tell is not estimated: no simulated run resembles its recording"]
    told += [_sentence(name, judge, forecast) for name in judge.errors]
    beside = f"with {', '.join(forecast.free)} unknown within their bounds" if forecast.free else "with all else known"
    told.append(
        f"at best: for the model and the start values of the experiment, {beside}, and the noise as found; a rough track, or "
        "a model that fails, costs more"
    )
    return told


def _not_believed(told: Reach) -> str:
    if not told.status.ok:
        return f"{told.name}: the simulation ended at {told.reached:.6g} s; the rest of the run tells nothing here"
    return (
        f"{told.name}: at the start values the simulation is {told.misfit:.2g} times as far from the recording as that varies; "
        "what it could tell is left out"
    )


def _sentence(name: str, judge: Reach, forecast: Forecast) -> str:
    error, varied = judge.errors[name], any(r.variation >= CONSTANT and not r.holdout for r in forecast.runs)
    if name == "alpha" and not varied:
        return f"{SUBJECTS[name]} cannot be identified: no fitted run has a load that changes"
    if math.isinf(error):
        return f"{SUBJECTS[name]} cannot be identified: nothing recorded depends on it"
    size = f"{100 * error:.2g} %" if name == "lambda" else f"{error:.2g}"
    source = f"{judge.name} together tell" if forecast.together else f"{judge.name} tells"
    verdict = verdict_of(name, judge)
    said = f"{SUBJECTS[name]} {verdict}: {source} it to {size} at best"
    if judge.peaks[name] < SEEN and error < LIMITS[name][1]:
        said += f", but {CHANGES[name]} makes {judge.peaks[name]:.2g} of a sample's noise, where drift and model errors hide"
    alone = [r.name for r in forecast.runs if r.believed and verdict_of(name, r) == CAN]
    if verdict == CAN and alone and len(forecast.runs) > 1:
        said += f"; {f'each of {_listed(alone)}' if len(alone) > 1 else alone[0]} does so alone"
    return said


def verdict_of(name: str, told: Reach) -> str:
    """Return what error and peak mean: can, can hardly, or cannot be identified."""
    clear, hardly = LIMITS[name]
    error, peak = told.errors[name], told.peaks[name]
    if error < clear and peak >= SEEN:
        return CAN
    return "can hardly be identified" if error < hardly and peak >= HIDDEN else "cannot be identified"


def _listed(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
