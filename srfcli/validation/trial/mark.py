"""One answer held against the truth: what there was to be seen, what would have been right, whether it was said.

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

from srfcli.core.errors import SrfError
from srfcli.core.files import read_text, write_atomic
from srfcli.data.experiment import read_experiment
from srfcli.laws.registry import load_registry
from srfcli.parallel.pool import run_processes
from srfcli.validation.generator.case import Effect, Gauge, known_gauge, known_physics, known_plans, play, variants
from srfcli.validation.generator.physics import Physics, Plan
from srfcli.validation.generator.slider import move
from srfcli.validation.trial.blind import FAILED, VERDICTS, Answer

# One answer held against the truth: what would have been right, and whether it was said.

KINDS = ("none", "single", "pair", "outside")
INVISIBLE = 5.0  # standard errors: an effect whose size even the best fit would know no better cannot be asked for
CONFIDENT = 0.9
UNNAMED = ("none", "inconclusive", "ambiguous")  # right where what is concealed cannot be seen
Accepted = frozenset[tuple[str, frozenset[str]]]


@dataclass(frozen=True)
class Mark:
    """An answer and the truth about its case. `right` is the verdict with the very set of effects, or what is as good.

    `class_right`: right, or ambiguous with the truth among what is listed or equivalent to it. `alarm`: something is said to be
    missing. `top` is the hypothesis with most confidence, `stated` that confidence, `hit` whether it is the truth; `error` the
    held-out rms of the final model over that of the true one, `baseline_error` that of the baseline; `deviation` is the
    distance of an effect's size from the true one, where it was named rightly and alone: in standard errors, and relative.
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
        """Return whether the wrong effects are named with a stated confidence above CONFIDENT."""
        return self.wrong_name and self.answer.confidence.get(self.answer.said, 0.0) > CONFIDENT


def mark(truth: Mapping[str, Any], answer: Answer, sight: Sight) -> Mark:
    """Return the mark of an answer, given the truth about its case and what there was to be seen."""
    hidden = tuple(truth["effects"])
    invisible = tuple(n for n in hidden if (s := sight.sigmas.get(n)) is not None and s < INVISIBLE)
    allowed = accepted(truth, invisible)
    said = (answer.verdict, frozenset(answer.effects) if answer.verdict == "identified" else frozenset())
    right = answer.verdict != FAILED and said in allowed
    shares = {**answer.confidence}
    top = max(shares, key=lambda name: shares[name]) if shares else ""
    known = [s for n in hidden if (s := sight.sigmas.get(n)) is not None]
    return Mark(
        answer.case,
        kind_of(truth),
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
        _key(top) in allowed,
        _ratio(answer, sight, "augmented"),
        _ratio(answer, sight, "baseline"),
        deviation(truth, answer),
        allowed,
    )


def kind_of(truth: Mapping[str, Any]) -> str:
    """Return the kind of a case: none, single, pair or outside."""
    if truth["verdict"] == "unknown":
        return "outside"
    return ("none", "single", "pair")[len(truth["effects"])]


def accepted(truth: Mapping[str, Any], invisible: tuple[str, ...]) -> Accepted:
    """Return what would be right: pairs of a verdict and, for `identified`, a set of effects.

    `accept` in the truth lists further verdicts, or effects as "a" or "a+b". Where all that is concealed is invisible, so are
    none, inconclusive and ambiguous; of two effects with one invisible, the other one alone.
    """
    found = {_key("+".join(truth["effects"]) if truth["verdict"] == "identified" else truth["verdict"])}
    found |= {(name, frozenset()) if name in VERDICTS else _key(name) for name in truth.get("accept", ())}
    left = frozenset(truth["effects"]) - frozenset(invisible)
    if invisible and left:
        found.add(("identified", left))
    elif invisible:
        found |= {(verdict, frozenset()) for verdict in UNNAMED}
    return frozenset(found)


def _key(name: str) -> tuple[str, frozenset[str]]:
    """Return the verdict and effects that a hypothesis stands for: none, unknown, or names joined by +."""
    return (name, frozenset()) if name in ("none", "unknown", "") else ("identified", frozenset(name.split("+")))


def _listed(truth: Mapping[str, Any], answer: Answer) -> bool:
    """Return whether an ambiguous answer lists the truth, or what it calls its equivalents."""
    if answer.verdict != "ambiguous" or truth["verdict"] != "identified":
        return False
    listed = set(answer.effects)
    for names in answer.equivalent:
        listed |= set(names) if listed & set(names) else set()
    return set(truth["effects"]) <= listed


def _ratio(answer: Answer, sight: Sight, model: str) -> float | None:
    """Return the rms over all held-out runs under `model`, over that under the true one; None where one has none."""
    pairs = [(run.get(model), sight.known.get(name)) for name, run in answer.held.items()]
    if not pairs or any(a is None or not b for a, b in pairs):
        return None
    ours, true = (sum(float(p[i] or 0.0) ** 2 for p in pairs) for i in (0, 1))
    return float((ours / true) ** 0.5)


# What there was to be seen in a case, from its truth: the error of a model that knows it, and how far each effect stands out.

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


# The size of an effect as it was estimated, against the size it has in the truth.


@dataclass(frozen=True)
class Size:
    """Where an effect's size stands: `field` of the truth's physics, and `parameter` of the answer, in `unit`.

    `factor` takes the field into that unit; `inverse`: it is one over the field; `unsigned`: its sign is a matter of the phase.
    """

    field: str
    parameter: str
    unit: str = "1"
    factor: float = 1.0
    inverse: bool = False
    unsigned: bool = False


SIZES: Mapping[str, tuple[Size, ...]] = {
    "linker-dieterich": (Size("alpha", "alpha"),),
    "interface-compliance": (Size("lam", "lambda", "um"),),
    "stiffness-exponent": (Size("n_kappa", "n"),),
    "age-saturation": (Size("Vsat", "cutoff", "s/um", inverse=True),),
    "log-log-coupling": (Size("C", "C"),),
    "slip-evolution": (Size("slip_share", "share"),),
    "second-state": (Size("B2", "B2"),),
    "viscous-drag": (Size("drag", "c"),),
    "adhesion-offset": (Size("Wa", "Wa", "N"),),
    "load-transmission": (Size("rho", "rho"),),
    "load-distortion": (Size("distortion", "amplitude", unsigned=True),),
    "tangential-crosstalk": (Size("cross", "share"),),
    "track-topography": (Size("topo", "amplitude", unsigned=True),),
    "friction-drift": (Size("drift_t", "rate", "1/s"), Size("drift_x", "rate", "1/um")),
    "drive-ripple": (Size("ripple", "amplitude", unsigned=True),),
    "sensor-lag": (Size("lag", "time_constant", "s"),),
    "stiffness-error": (Size("ratio", "ratio"),),
    "inertia": (Size("M", "M", "kg", factor=1e6),),
}


def deviation(truth: Mapping[str, Any], answer: Answer) -> tuple[float, float] | None:
    """Return how far the estimated size is from the true one, in its standard errors and relative to the true size.

    None unless one effect is concealed and the same is named, in the form it has, with an error.
    """
    if len(truth["effects"]) != 1 or answer.effects != tuple(truth["effects"]):
        return None
    sizes = SIZES.get(truth["effects"][0], ())
    for size in sizes:
        found = answer.parameters.get(size.parameter)
        other_form = len(sizes) > 1 and size.field not in truth["truth"]
        if found is None or found["unit"] != size.unit or other_form:
            continue
        true, value, error = truth["physics"][size.field] * size.factor, found["value"], found["stderr"]
        true = 1 / true if size.inverse else true
        if value is None or not error or not true:
            return None
        off = abs(value) - abs(true) if size.unsigned else value - true
        return off / error, abs(off / true)
    return None
