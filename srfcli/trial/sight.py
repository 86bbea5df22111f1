"""What there was to be seen in a case, from its truth: the error of a model that knows it, and how far each effect stands out.

Everything here is computed by the generator's equations, after the truths are unsealed; no answer and no fit of this project
enters.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.errors import SrfError
from srfcli.output.files import write_atomic
from srfcli.parallel.pool import run_processes
from srfcli.proof.case import known_gauge, known_physics, known_plans
from srfcli.proof.draw import Gauge
from srfcli.proof.effects import Effect, variants
from srfcli.proof.gauge import play
from srfcli.proof.motion import move
from srfcli.proof.physics import Physics
from srfcli.proof.protocol import Plan
from srfcli.reading import read_text
from srfcli.recording.experiment import read_experiment
from srfcli.registry import load_registry

STEP = 2e-4  # relative, of a parameter's difference: in stick-slip a larger one shifts the phase by more than is linear
FITTED = ("mu0", "A", "B", "D0", "Vsat", "lam")  # of the baseline, where it has them
Array = np.ndarray


@dataclass(frozen=True)
class Sight:
    """What a case's truth says: `known` is each held-out run's rms in um under the true model, the track included.

    `sigmas` is how far each concealed effect stands out of the fitted runs, in standard errors of its size in a fit in which the
    baseline's parameters are free; `raw` is the same if they were known. None where the slider cannot be followed without it.
    """

    case: str
    known: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float | None] = field(default_factory=dict)
    raw: Mapping[str, float | None] = field(default_factory=dict)


Task = tuple[Path, Mapping[str, Any]]


def see(task: Task) -> Sight:
    """Return what there was to be seen in one case: its folder, and the truth about it."""
    folder, truth = task
    plans, p, gauge = known_plans(truth), known_physics(truth), known_gauge(truth)
    experiment = read_experiment(folder, registry=load_registry())
    held = {run.name: run for run in experiment.runs if run.holdout}
    shown = {plan: _shown(p, plan) for plan in plans}
    known = {}
    for plan in plans:
        if plan.name in held:
            run = held[plan.name]
            known[plan.name] = float(np.sqrt(np.mean((run.observed - shown[plan])[run.used] ** 2)))
    fitted = {plan: u for plan, u in shown.items() if not plan.holdout}
    effects = concealed(truth)
    stands = {e.name: stands_out(e, [o for o in effects if o is not e], p, gauge=gauge, shown=fitted) for e in effects}
    return Sight(folder.name, known, {n: s for n, (s, _) in stands.items()}, {n: r for n, (_, r) in stands.items()})


def concealed(truth: Mapping[str, Any]) -> list[Effect]:
    """Return the effects of a truth; of several forms of one, the form that the truth has."""
    found = []
    for name in truth["effects"]:
        forms = variants(name)
        found.append(next((e for e in forms if len(forms) == 1 or e.varies in truth["truth"]), forms[0]))
    return found


def stands_out(effect: Effect, others: Sequence[Effect], p: Physics, *, gauge: Gauge,
               shown: Mapping[Plan, Array]) -> tuple[float | None, float | None]:  # fmt: skip
    """Return how many standard errors an effect stands out of the runs `shown` (n,) um, with the baseline free and with it known.

    The baseline's parameters and the sizes of the `others` are free to first order, from the slider without the effect. A rough
    track is taken as known: where it is not, less is seen.
    """
    less = effect.removed(p)
    free = [n for n in FITTED if not (n == "Vsat" and less.bare) and not (n == "lam" and less.rigid)]
    free += [o.varies for o in others if o.varies not in free and getattr(less, o.varies)]
    signals, tangents = [], []
    for plan, u in shown.items():
        base = _shown(less, plan)
        moved = [_shown(replace(less, **{n: getattr(less, n) * (1 + STEP)}), plan) for n in free]
        if not all(np.isfinite(x).all() for x in (base, *moved)):
            return None, None
        signals.append(_white(u - base, gauge))
        tangents.append(np.column_stack([_white((x - base) / STEP, gauge) for x in moved]))
    signal, tangent = np.concatenate(signals), np.concatenate(tangents)
    tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=0), 1e-12)
    left = signal - tangent @ np.linalg.lstsq(tangent, signal, rcond=1e-10)[0]
    return float(np.linalg.norm(left)), float(np.linalg.norm(signal))


def _shown(p: Physics, plan: Plan) -> Array:
    """Return what the gauge of a slider would show (n,) um without noise; NaN from where it cannot be followed."""
    u = move(p, plan).u
    return play(u, p.backlash) if p.backlash else u


def _white(x: Array, gauge: Gauge) -> Array:
    """Return a signal (n,) um in units of white noise of size 1, the gauge's correlation taken out."""
    level = float(np.hypot(gauge.sigma, gauge.quantum / np.sqrt(12)))
    out = x / level
    out[1:] = (x[1:] - gauge.lag1 * x[:-1]) / (level * np.sqrt(1 - gauge.lag1**2))
    return np.asarray(out)


def see_all(bank: Path, truths: Mapping[str, Mapping[str, Any]], *, workers: int, kept: Path) -> Iterator[Sight]:
    """Yield what there was to be seen in every case; what the file `kept` holds is not computed again."""
    found = _read(kept)
    yield from (sight for name, sight in found.items() if name in truths)
    names = [name for name in truths if name not in found]
    for _, sight in run_processes(see, [(bank / n, truths[n]) for n in names], workers=workers):
        found[sight.case] = sight
        write_atomic(kept, "".join(json.dumps(asdict(found[n]), sort_keys=True) + "\n" for n in sorted(found)))
        yield sight


def _read(kept: Path) -> dict[str, Sight]:
    if not kept.exists():
        return {}
    try:
        sights = [Sight(**json.loads(line)) for line in read_text(kept).splitlines()]
    except (SrfError, ValueError, TypeError, RecursionError) as error:
        raise SrfError(f"{kept}: not what was written: {error}", "Delete the file; it is computed again.") from None
    return {sight.case: sight for sight in sights}
