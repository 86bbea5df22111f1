"""Concealed cases: drawn from a seed, simulated, written as folders of experiments; banks of them, their truths under seal."""

from __future__ import annotations

import hashlib
import hmac
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import accumulate, combinations, cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.files import parse_json, read_plain, write_atomic
from srfcli.core.parallel import run_here, run_processes
from srfcli.validation.apparatus import (
    FULL_TURN,
    NOISE_SHARES,
    ONE_RUN,
    PAPER,
    RIGS,
    SIZES,
    Rig,
    Setting,
    disturbed,
    draw_gauge,
    draw_setup,
    possible,
    recorded,
    settings,
)
from srfcli.validation.gauge import MAX_LAG1, Array, Gauge, play, read_gauge
from srfcli.validation.slider import SMOOTH, Physics, Plan, Track, move

# What can be concealed: each effect, how strong it is drawn, and what the baseline is that lacks it.


@dataclass(frozen=True)
class Effect:
    """One concealed piece of physics: `varies`, a field of Physics, departs from `neutral` by `weak` to `strong`.

    The sign is drawn from `signs`, and `beside` evenly between bounds; `absent` are the fields of a baseline that has none of it.
    A diagnosis may name one that is `listed`, and tell its size as `parameter` in `unit`; `resembles` says which names come close
    to one that it may not.
    """

    name: str
    varies: str
    weak: float
    strong: float
    signs: tuple[int, ...] = (1,)
    neutral: float = 0.0
    beside: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    absent: Mapping[str, bool | str | float] = field(default_factory=dict)
    scale: float = 1.0  # the field is neutral + scale * sign * size
    resembles: tuple[str, ...] = ()
    parameter: str = ""
    unit: str = "1"

    @property
    def listed(self) -> bool:
        """Return whether a diagnosis may name it."""
        return self.name not in OUTSIDE_NAMES

    def added(self, p: Physics, rng: np.random.Generator, size: float) -> Physics:
        """Return `p` with this effect, its strength `size` of the way from weak to strong, on a logarithmic scale."""
        strength = self.weak * (self.strong / self.weak) ** size
        sign = self.signs[int(rng.integers(len(self.signs)))]
        drawn = {name: float(rng.uniform(*bounds)) for name, bounds in self.beside.items()}
        changes: dict[str, Any] = {**drawn, self.varies: self.neutral + self.scale * sign * strength}
        if self.varies == "Vsat":
            changes["Vsat"] = 1 / strength  # the cut-off is absent at 1/Vsat = 0
        return replace(p, **changes)

    def told_size(self, p: Mapping[str, Any]) -> float:
        """Return the size that this effect has among the fields `p` of a slider, in its unit."""
        size = float(p[self.varies] * (1 / self.scale))
        return 1 / size if self.varies == "Vsat" else size

    def present(self, p: Physics, before: Physics) -> Physics:
        """Return `p` where the baseline `before` it was drawn around lacks the effect already: with what it lacks."""
        lacked: dict[str, Any] = {name: False for name in self.absent if getattr(before, name)}
        if "bare" in lacked:
            lacked["mu0"] = p.mu0 - p.B * math.log(p.Vsat / p.V0)
        return replace(p, **lacked)

    def removed(self, p: Physics) -> Physics:
        """Return `p` without this effect: the baseline's own physics."""
        if not self.absent:
            changes: dict[str, Any] = {self.varies: self.neutral}
            return replace(p, **changes)
        changes = dict(self.absent)
        if self.varies == "Vsat":
            changes["mu0"] = p.mu0 + p.B * math.log(p.Vsat / p.V0)  # B ln(1 + Vsat phi/D0) at long ages
        return replace(p, **changes)


BOTH = (1, -1)
EFFECTS: tuple[Effect, ...] = (
    Effect("linker-dieterich", "alpha", 0.001, 0.03, parameter="alpha"),
    Effect("interface-compliance", "lam", 0.1, 0.9, absent={"rigid": True}, parameter="lambda", unit="um"),
    Effect("stiffness-exponent", "n_kappa", 0.08, 0.7, BOTH, neutral=1.0, parameter="n"),
    Effect("age-saturation", "Vsat", 1 / 3000, 1 / 100, absent={"bare": True}, parameter="cutoff", unit="s/um"),
    Effect("log-log-coupling", "C", 5e-5, 1.5e-3, BOTH, parameter="C"),
    Effect("slip-evolution", "slip_share", 0.03, 1.0, parameter="share"),
    Effect("second-state", "B2", 3e-4, 8e-3, beside={"D2": (2.0, 12.0)}, parameter="B2"),
    Effect("viscous-drag", "drag", 5e-6, 3e-4, parameter="c"),
    Effect("adhesion-offset", "Wa", 0.02, 0.6, parameter="Wa", unit="N"),
    Effect("load-transmission", "rho", 0.01, 0.7, (-1,), neutral=1.0, parameter="rho"),
    Effect("load-distortion", "distortion", 0.02, 0.4, beside={"distortion_phase": FULL_TURN}, parameter="amplitude"),
    Effect("tangential-crosstalk", "cross", 0.001, 0.03, BOTH, parameter="share"),
    Effect(
        "track-topography", "topo", 2e-4, 2e-3, beside={"topo_L": (6.0, 40.0), "topo_phase": FULL_TURN}, parameter="amplitude"
    ),
    Effect("friction-drift", "drift_t", 1e-4, 2.5e-3, BOTH, beside={"drift_t0": (0.0, 1.5)}, parameter="rate", unit="1/s"),
    Effect("friction-drift", "drift_x", 1e-5, 2.5e-4, BOTH, beside={"drift_x0": (0.0, 15.0)}, parameter="rate", unit="1/um"),
    Effect(
        "drive-ripple", "ripple", 0.01, 0.15, beside={"ripple_p": (4.0, 25.0), "ripple_phase": FULL_TURN}, parameter="amplitude"
    ),
    Effect("sensor-lag", "lag", 5e-4, 0.02, parameter="time_constant", unit="s"),
    Effect("stiffness-error", "ratio", 0.03, 0.3, BOTH, neutral=1.0, parameter="ratio"),
    Effect("inertia", "M", 0.2, 4.0, scale=1e-6, absent={"massless": True}, parameter="M", unit="kg"),
    Effect("load-stiffening", "K_power", 0.05, 0.6, BOTH, parameter="m"),
    Effect("poisson-coupling", "poisson", 0.003, 0.1, BOTH, parameter="shift", unit="um/N"),
)
OUTSIDE: tuple[Effect, ...] = (
    Effect("age-exponent", "p_age", 0.15, 1.0, neutral=1.0, resembles=("slip-evolution",)),
    Effect(
        "track-bump", "bump", 8e-4, 8e-3, BOTH, beside={"bump_x": (8.0, 35.0), "bump_w": (0.5, 3.0)},
        resembles=("track-topography",),
    ),
    Effect(
        "load-memory", "memory", 0.1, 1.0, beside={"memory_tau": (0.001, 0.2)},
        resembles=("load-transmission", "linker-dieterich"),
    ),
    Effect("speed-dependent-length", "D_power", 0.04, 0.4, BOTH, resembles=("slip-evolution",)),
    Effect("load-dependent-friction", "W_power", 0.004, 0.08, BOTH, resembles=("adhesion-offset", "tangential-crosstalk")),
    Effect("age-limit", "age_rate", 0.05, 2.0, resembles=("age-saturation",)),
    Effect("interface-damping", "eta", 5e-4, 0.02),
    Effect("drive-lag", "drive_tau", 0.005, 0.15, resembles=("sensor-lag",)),
    Effect("gauge-backlash", "backlash", 0.015, 0.2, resembles=("sensor-lag",)),
    Effect(
        "load-servo", "servo", 0.1, 1.0, beside={"servo_f": (2.0, 20.0), "servo_damping": (0.2, 0.9)},
        resembles=("load-transmission", "linker-dieterich"),
    ),
    Effect("pore-pressure", "pore", 0.02, 0.6, resembles=("adhesion-offset",)),
    Effect("gauge-creep", "creep", 0.003, 0.1, beside={"creep_tau": (0.1, 3.0)}, resembles=("sensor-lag",)),
    Effect("slip-hardening", "harden", 5e-4, 8e-3, BOTH, beside={"harden_x": (5.0, 40.0)}, resembles=("friction-drift",)),
    Effect("frictional-heating", "heat", 5e-6, 2e-4, beside={"heat_tau": (0.05, 2.0)}, resembles=("viscous-drag",)),
    Effect("dilatancy", "dilate", 5e-4, 8e-3, beside={"drain": (0.05, 2.0)}, resembles=("second-state",)),
    Effect("rate-cutoff", "rate_cut", 1 / 2000, 1 / 30, resembles=("viscous-drag",)),
)  # fmt: skip
NAMES = tuple(dict.fromkeys(e.name for e in EFFECTS))
OUTSIDE_NAMES = tuple(e.name for e in OUTSIDE)
ONE_RUN_NAMES = tuple(dict.fromkeys(e.name for e in EFFECTS if e.varies in ONE_RUN))


def variants(name: str) -> tuple[Effect, ...]:
    """Return the effects of this name; SrfError for one that is not known."""
    found = tuple(e for e in (*EFFECTS, *OUTSIDE) if e.name == name)
    if not found:
        raise SrfError(f"unknown effect '{name}'", did_you_mean(name, (*NAMES, *OUTSIDE_NAMES)))
    return found


# What a case is made of, drawn from its seed: laws around those of the examples, effects, protocol, track and gauge.

PAPER_KINDS = ("none", "single", "pair", "outside")
WIDE_KINDS = (*PAPER_KINDS, "ageing", "one-run")  # another ageing law is stated; an effect acts in one run
BANKS = ("paper", "wide")
TRACKS = {"smooth": (False, False), "shared": (True, False), "rough": (True, True)}  # whether rough, and each run's own
KIND_SHARES = (0.25, 0.4, 0.15, 0.2)  # of the kinds, where none is asked for
WIDE_SHARES = (0.25, 0.3, 0.1, 0.13, 0.14, 0.08)
START_SCATTER = {"A": 0.05, "B": 0.05, "D0": 0.05, "lam": 0.05, "Vsat": 0.13, "mu0": 0.01}  # relative standard deviations
NONSTANDARD_BASELINES = ("rigid", "massless", "bare")  # baselines other than the usual one
NONSTANDARD_SHARE = 0.15  # of the cases where no effect decides it: else an odd baseline would give the answer away
STANDARD_BASELINE_ONLY = {
    "stiffness-exponent",
    "log-log-coupling",
    "interface-damping",
    "interface-compliance",
    "inertia",
    "age-saturation",
}
ROUGH_SHARE, WHITE_SHARE = 0.4, 0.6
OWN_SHARE = 0.5  # of cases with a field: each run has its own
ROUGHNESS, CORRELATION = (5e-5, 4e-4), (3.0, 30.0)  # of mu0; um
ROCK_CORRELATION = 10.0  # times as long, as are slip lengths and distances


@dataclass(frozen=True)
class Recipe:
    """A case before anything moves: the truth `physics`, the `baseline` that is stated, the plans of its runs, its gauge.

    `rig` is of RIGS, `noise` of NOISE_SHARES; `only` is the one run in which the effects act, empty for all.
    """

    effects: tuple[Effect, ...]
    sizes: tuple[float, ...]
    physics: Physics
    baseline: Physics
    plans: tuple[Plan, ...]
    gauge: Gauge
    kind: str = ""
    rig: str = "paper"
    protocol: str = "mixed"
    noise: str = "white"
    only: str = ""

    def acting(self, plan: Plan) -> Physics:
        """Return what is true in one run."""
        return self.physics if self.only in ("", plan.name) else without(self.physics, self.effects)


def without(p: Physics, effects: Sequence[Effect]) -> Physics:
    """Return `p` without these effects."""
    for effect in effects:
        p = effect.removed(p)
    return p


@dataclass(frozen=True)
class CaseRequest:
    """What a case is asked to be; what is None is drawn.

    `kind` is none, single, pair or outside, in the wide bank also ageing or one-run; `effects` are names. `size` from 0 to 1 is
    how strong they are, `rough` whether the track is, or the standard deviation of its mu0, `own` whether each run has a field of
    its own; `plans` are the runs, `setting` and `noise` those of a case of the wide bank.
    """

    kind: str | None = None
    effects: Sequence[str] | None = None
    size: float | None = None
    rough: bool | float | None = None
    own: bool | None = None
    plans: tuple[Plan, ...] | None = None
    setting: Setting | None = None
    noise: str | None = None


NO_REQUEST = CaseRequest()


def draw_recipe(rng: np.random.Generator, request: CaseRequest = NO_REQUEST) -> Recipe:
    """Return the case that `rng` gives."""
    chosen = _draw_effects(rng, request)
    sizes = _draw_sizes(rng, len(chosen), request.size)
    physics = _draw_baseline(rng, chosen)
    track = _draw_track(rng, request.rough)
    for effect, strength in zip(chosen, sizes, strict=True):
        physics = effect.added(physics, rng, strength)
    physics = replace(physics, track=track)
    baseline = without(physics, chosen)
    plans = request.plans or draw_protocol(rng)
    lag1 = float(rng.uniform(0.3, MAX_LAG1))
    gauge = Gauge(lag1=0.0 if rng.uniform() < WHITE_SHARE else lag1)
    drawn_own = rng.uniform() < OWN_SHARE
    if track.size and (drawn_own if request.own is None else request.own):
        physics, baseline = (replace(p, track=replace(track, own=True)) for p in (physics, baseline))
    noise = "ar1" if gauge.lag1 else "white"
    return Recipe(chosen, sizes, physics, baseline, plans, gauge, kind_of_effects(chosen), noise=noise)


def kind_of_effects(effects: Sequence[Effect]) -> str:
    """Return the kind of a case that conceals these effects in all of its runs."""
    return ("none", "single", "pair")[len(effects)] if all(e.listed for e in effects) else "outside"


def draw_wide(rng: np.random.Generator, request: CaseRequest = NO_REQUEST) -> Recipe:
    """Return the case of the wide bank that `rng` gives.

    Apparatus, protocol, laws and noise are among those in which the effects make sense, effects asked for those that the kind
    wants.
    """
    kind, effects = request.kind, request.effects
    if kind is None and effects is not None:
        kind = kind_of_effects([e for name in effects for e in variants(name)[:1]])
    kind = str(rng.choice(WIDE_KINDS, p=WIDE_SHARES)) if kind is None else kind
    check_kinds((kind,), "wide")
    names = draw_effect_names(rng, kind) if effects is None else tuple(effects)
    forms, setting = _forms_and_setting(
        rng, kind, names, [request.setting] if request.setting else settings(wrong_ageing=kind == "ageing")
    )
    physics, plans = draw_setup(rng, setting)
    plans = request.plans or plans or draw_protocol(rng)
    if setting.apparatus == "paper" and rng.uniform() < NONSTANDARD_SHARE and _allows_nonstandard_baseline(forms, setting):
        which = str(rng.choice(("rigid", "massless")))
        physics = replace(physics, rigid=which == "rigid", massless=which == "massless")
    sizes = _draw_sizes(rng, len(forms), request.size)
    for effect, strength in zip(forms, sizes, strict=True):
        physics = effect.present(effect.added(physics, rng, strength), physics)
    track = _draw_track(rng, request.rough)
    if track.size and setting.apparatus == "rock":
        track = replace(track, length=ROCK_CORRELATION * track.length)
    drawn_own = rng.uniform() < OWN_SHARE
    physics = replace(physics, track=replace(track, own=bool(track.size) and (drawn_own if request.own is None else request.own)))
    if kind == "ageing":
        forms, sizes = (other_ageing(setting.ageing, setting.stated),), (1.0,)
    noise = request.noise or str(rng.choice(list(NOISE_SHARES), p=list(NOISE_SHARES.values())))
    plans = disturbed(rng, plans, noise)
    rig = str(rng.choice([name for name in RIGS if name.partition("-")[0] == setting.apparatus]))
    gauge = draw_gauge(rng, rig, physics, noise)
    only = str(rng.choice(_runs_that_show(forms[0], plans))) if kind == "one-run" else ""
    return Recipe(forms, sizes, physics, without(physics, forms), plans, gauge, kind, rig, setting.protocol, noise, only)


def draw_effect_names(rng: np.random.Generator, kind: str) -> tuple[str, ...]:
    """Return the effects of a case of the wide bank, by its kind."""
    if kind == "pair":
        pairs = possible_pairs()
        return pairs[int(rng.integers(len(pairs)))]
    known = {"single": NAMES, "outside": OUTSIDE_NAMES, "one-run": ONE_RUN_NAMES}.get(kind)
    return (str(rng.choice(known)),) if known else ()


def _forms_and_setting(
    rng: np.random.Generator, kind: str, names: Sequence[str], every: Sequence[Setting]
) -> tuple[tuple[Effect, ...], Setting]:
    """Return the effects in forms and sizes of a setting in which they make sense, and the setting, one of these."""
    forms = _forms(rng, names)
    found = [s for s in every if all(possible(e.varies, s) for e in forms)]
    if kind == "one-run":
        found = [s for s in found if s.protocol != "steps"]  # which is one run
    if not found:
        raise SrfError(f"no apparatus, protocol and law go with {' and '.join(names)}", "name other effects")
    shares = np.array([s.share for s in found])
    setting = found[int(rng.choice(len(found), p=shares / shares.sum()))]
    sizes = SIZES.get(setting.apparatus, {})
    own = [sizes.get(e.varies) or (e.weak, e.strong, e.beside) for e in forms]
    return tuple(replace(e, weak=a, strong=b, beside=c) for e, (a, b, c) in zip(forms, own, strict=True)), setting


def _forms(rng: np.random.Generator, names: Sequence[str]) -> tuple[Effect, ...]:
    """Return effects by name; which form of an effect that has several is drawn."""
    if len(set(names)) < len(names):
        raise SrfError(f"an effect is named twice: {', '.join(names)}", "name each once")
    return tuple(forms[int(rng.integers(len(forms)))] for forms in [variants(name) for name in names])


def _allows_nonstandard_baseline(forms: Sequence[Effect], setting: Setting) -> bool:
    """Return whether a rigid or quasi-static baseline can be followed, and gives nothing away."""
    decided = any(e.name in STANDARD_BASELINE_ONLY for e in forms)
    return not decided and setting.protocol not in ("mixed", "stick-slip") and "nagata" not in (setting.ageing, setting.stated)


def _runs_that_show(effect: Effect, plans: Sequence[Plan]) -> list[str]:
    """Return the fitted runs in which an effect can act."""
    fitted = [p for p in plans if not p.holdout]
    if effect.varies in ("rho", "distortion"):
        fitted = [p for p in fitted if p.eps]
    elif effect.varies == "cross":
        fitted = [p for p in fitted if p.eps or p.steps]
    return [p.name for p in fitted]


def possible_pairs() -> list[tuple[str, str]]:
    """Return the pairs of effects that make sense together in some setting."""
    every = settings()
    fits = {name: {s for s in every if possible(variants(name)[0].varies, s)} for name in NAMES}
    return [(a, b) for a, b in combinations(NAMES, 2) if fits[a] & fits[b]]


def other_ageing(true: str, stated: str) -> Effect:
    """Return the true ageing law as an effect that a baseline with the stated one lacks."""
    return Effect(true, "ageing", 1.0, 1.0, absent={"ageing": stated, "nagata": 0.0})


def _draw_sizes(rng: np.random.Generator, count: int, asked: float | None) -> tuple[float, ...]:
    """Return how strong each of the effects is."""
    if asked is not None and not 0 <= asked <= 1:
        raise SrfError(f"size = {asked:g} of an effect", "give a number from 0, hardly there, to 1, strong")
    drawn = rng.uniform(0, 1, size=count).tolist()
    return tuple(drawn if asked is None else [asked] * count)


def _draw_effects(rng: np.random.Generator, request: CaseRequest) -> tuple[Effect, ...]:
    """Return the effects by name, or as many as the kind has."""
    drawn_kind = str(rng.choice(PAPER_KINDS, p=KIND_SHARES))
    order = [str(n) for n in rng.permutation(NAMES)]
    outside = str(rng.choice(OUTSIDE_NAMES))
    names = request.effects
    if names is None:
        kind = drawn_kind if request.kind is None else request.kind
        check_kinds((kind,), "paper")
        names = {"none": [], "single": order[:1], "pair": order[:2], "outside": [outside]}[kind]
    return _forms(rng, names)


def _draw_baseline(rng: np.random.Generator, chosen: Sequence[Effect]) -> Physics:
    """Return the laws' numbers, and now and then a baseline that is rigid, quasi-static or without a cut-off of age."""
    usual = Physics()
    numbers = {n: getattr(usual, n) * float(np.exp(s * rng.standard_normal())) for n, s in START_SCATTER.items()}
    odd, which = rng.uniform() < NONSTANDARD_SHARE, str(rng.choice(NONSTANDARD_BASELINES))
    physics = replace(usual, **numbers)
    if not odd or any(effect.name in STANDARD_BASELINE_ONLY for effect in chosen):
        return physics
    if which == "bare":
        return replace(physics, bare=True, mu0=physics.mu0 + physics.B * float(np.log(physics.Vsat / physics.V0)))
    return replace(physics, rigid=which == "rigid", massless=which == "massless")


def _draw_track(rng: np.random.Generator, rough: bool | float | None) -> Track:
    is_rough = rng.uniform() < ROUGH_SHARE
    size = float(np.exp(rng.uniform(*np.log(ROUGHNESS))))
    length, seed = float(np.exp(rng.uniform(*np.log(CORRELATION)))), int(rng.integers(2**32))
    if rough is not None and not isinstance(rough, bool):
        size = float(rough)
        if not 0 <= size < 0.1:
            raise SrfError(f"rough = {size:g} is no amplitude of a field", "give the standard deviation of mu0, say 3e-4")
        is_rough = size > 0
    elif rough is not None:
        is_rough = rough
    return Track(size, length, seed) if is_rough else SMOOTH


def draw_protocol(rng: np.random.Generator) -> tuple[Plan, ...]:
    """Return seven runs like those of the examples, with velocities, loads, frequencies and switching times of their own."""

    def near(value: float, spread: float, digits: int = 2) -> float:
        return float(f"{value * (1 + rng.uniform(-spread, spread)):.{digits}g}")

    slow, rise, fall = near(5, 0.2), near(2, 0.1), near(4, 0.1)
    jump, light = near(1.5, 0.3), near(5, 0.08)
    first, unstable = near(12, 0.15), near(8, 0.2)
    return (
        Plan("steps", ((2, slow), (1.5, near(20, 0.2)), (2, slow), (1, near(50, 0.2)), (2, near(10, 0.2))), light, 0.004),
        Plan("stickslip", ((0.5, first), (5, unstable)), near(9.2, 0.05), 0.004),
        Plan(
            "onset", ((0.5, first), (4, unstable)), near(9, 0.05), 0.001,
            eps=near(0.09, 0.25), f=near(108, 0.13, 3), onset=near(2, 0.12),
        ),
        Plan(
            "strong", ((2.5, near(20, 0.25)),), near(7, 0.07), 0.001,
            eps=near(0.2, 0.2), f=near(108, 0.13, 3), onset=near(0.6, 0.1),
        ),
        Plan("loadstep", ((6, near(10, 0.2)),), near(5, 0.08), 0.002, steps=((rise, jump), (fall, -jump))),
        Plan(
            "holdout-mod", ((3, near(15, 0.2)),), near(8, 0.07), 0.001, holdout=True,
            eps=near(0.13, 0.2), f=near(80, 0.15, 3), onset=near(0.8, 0.12),
        ),
        Plan("holdout-shs", ((2, near(10, 0.2)), (4, near(0.1, 0.5)), (3, near(10, 0.2))), light, 0.004, holdout=True),
    )  # fmt: skip


# A case as a folder in the format srf-experiment/1: what the one who is to diagnose it gets to see.

DESCRIPTION = "experiment.toml"


def description(baseline: Physics, plans: tuple[Plan, ...], *, title: str, rig: Rig = PAPER, spikes: bool = False) -> str:
    """Return the text of experiment.toml: apparatus and model as the baseline has them, nothing of what is concealed."""
    mass = "" if baseline.massless else f'mass = "{baseline.M * 1e6:.3g} kg"\n'
    reference = [] if baseline.law == "dieterich-cutoff" else ["V0 = { value = 1.0, fixed = true }"]
    unit = "MPa/um" if rig.unit == "MPa" else "N/um"
    lines = [
        f'format = "srf-experiment/1"\ntitle = "{title}"\n',
        f'[apparatus]\nstiffness = "{baseline.K:.6g} {unit}"\n{mass}',
        f'[model]\nlaw = "{baseline.law_name}"\nageing = "{baseline.ageing_name}"',
        f'interface = "{"rigid" if baseline.rigid else "elastic"}"\ninertia = {str(not baseline.massless).lower()}\n',
        "[parameters]   # start values and bounds of what is to be fitted; um, s, N",
        *(f"{n} = {{ value = {v!r}, lower = {a!r}, upper = {b!r} }}" for n, (v, a, b) in rig.start(baseline).items()),
        *reference,
    ]
    return "\n".join([*lines, *(_run(plan, spikes=spikes) for plan in plans)]) + "\n"


def _run(plan: Plan, *, spikes: bool) -> str:
    drive = ", ".join(f"{{ duration = {d!r}, velocity = {v!r} }}" for d, v in plan.drive)
    text = f'\n[[runs]]\nname = "{plan.name}"\nfile = "{plan.name}.csv"\nholdout = {str(plan.holdout).lower()}'
    text += f"\ndrive = [{drive}]   # s, um/s"
    if spikes:
        text += '\ncorrections = ["spike"]'
    if plan.eps and not plan.rise:  # a slow oscillation is in the column, and nowhere else
        text += f"\nmodulation = {{ frequency = {plan.f!r}, amplitude = {plan.eps!r}, onset = {plan.onset!r} }}"
        text += "   # Hz, of the mean load, s; the load itself is the column"
    return text


def table(plan: Plan, observed: Array, rig: Rig = PAPER) -> str:
    """Return the text of a run's CSV: time, nominal velocity of the load point, imposed load, readings `observed` (n,)."""
    t, load = plan.times(), plan.load()
    ends = np.array(list(accumulate(d for d, _ in plan.drive)))
    velocities = np.array([v for _, v in plan.drive])
    V = velocities[np.minimum(np.searchsorted(ends, t + 1e-9, side="right"), velocities.size - 1)]
    W = [load(s)[0] / rig.factor for s in t.tolist()]
    rows = (f"{s:.4f},{v:g},{w:.6f},{u:.{rig.digits}f}" for s, v, w, u in zip(t, V, W, observed, strict=True))
    header = f"time [s],load_point_velocity [um/s],{rig.load},{rig.heading}"
    return "\n".join([header, *rows]) + "\n"


def case_files(
    title: str, baseline: Physics, readings: Mapping[Plan, Array], *, rig: Rig = PAPER, spikes: bool = False
) -> dict[str, str]:
    """Return the files of a case, name -> text; `spikes` asks for their correction."""
    runs = {f"{plan.name}.csv": table(plan, observed, rig) for plan, observed in readings.items()}
    return {**runs, DESCRIPTION: description(baseline, tuple(readings), title=title, rig=rig, spikes=spikes)}


# Concealed cases: an experiment's folder on one side, the truth about it on the other.

REDRAWS = 8  # draws until every run of a case can be integrated
Truth = dict[str, Any]


def make_case(folder: Path, seed: int | Sequence[int], *, bank: str = "paper", **asked: Any) -> Truth:
    """Write a concealed experiment to the new folder `folder` and return the truth about it, ready for JSON.

    What is `asked` for are fields of `CaseRequest`. The same seed and choices give the same bytes. Raises SrfError for unknown
    names of effects, kinds and banks, and where the folder exists.
    """
    if folder.exists():
        raise SrfError(f"{folder} exists already", "A case is never overwritten; name another folder.")
    if bank not in BANKS:
        raise SrfError(f"unknown bank '{bank}'", did_you_mean(bank, BANKS))
    recipe, motions, attempt = _integrable_recipe(seed, draw_wide if bank == "wide" else draw_recipe, CaseRequest(**asked))
    rng, rig = np.random.default_rng([*_seed_sequence(seed), attempt, 1]), RIGS[recipe.rig]
    readings = {
        plan: read_gauge(recorded(rig, recipe.acting(plan), plan, u), recipe.gauge.louder(plan.loud), rng)
        for plan, u in motions.items()
    }
    truth = _truth(recipe, attempt, seed)
    folder.mkdir(parents=True)
    files = case_files(rig.title, recipe.baseline, readings, rig=rig, spikes=recipe.gauge.spikes > 0)
    for name, text in files.items():
        write_atomic(folder / name, text)  # the description last: without it a folder is no experiment
    return truth


def _seed_sequence(seed: int | Sequence[int]) -> list[int]:
    return [seed] if isinstance(seed, int) else list(seed)


def _integrable_recipe(
    seed: int | Sequence[int], draw: Callable[[np.random.Generator, CaseRequest], Recipe], request: CaseRequest
) -> tuple[Recipe, dict[Plan, Array], int]:
    """Return the first recipe of the seed whose runs all reach their ends, what their gauges show, and how many came before."""
    for attempt in range(REDRAWS):
        recipe = draw(np.random.default_rng([*_seed_sequence(seed), attempt, 0]), request)
        motions: dict[Plan, Array] = {}
        for plan in recipe.plans:
            u = noiseless_elongation(recipe.acting(plan), plan)
            if not np.isfinite(u).all():
                break
            motions[plan] = u
        else:
            return recipe, motions, attempt
    raise SrfError(
        f"none of {REDRAWS} sliders drawn from seed {seed} could be followed to the end of its runs", "Take another seed."
    )


def noiseless_elongation(p: Physics, plan: Plan) -> Array:
    """Return the elongations that a slider's gauge would show (n,) in um without noise; NaN from where it cannot be followed."""
    u = move(p, plan).u
    return play(u, p.backlash) if p.backlash else u


def noiseless_record(rig: Rig, p: Physics, plan: Plan) -> Array:
    """Return what a rig would record (n,) without noise; NaN from where the slider cannot be followed."""
    return recorded(rig, p, plan, noiseless_elongation(p, plan))


def _truth(recipe: Recipe, attempt: int, seed: int | Sequence[int]) -> Truth:
    names = [e.name for e in recipe.effects]
    listed = all(e.listed for e in recipe.effects)
    accept = ["unknown"] if recipe.only else []
    if recipe.kind == "ageing" and names == ["ruina"] and recipe.baseline.ageing == "dieterich":
        accept = ["slip-evolution"]  # its share of 1 is this law
    return {
        "effects": names,
        "verdict": "none" if not names else "identified" if listed else "unknown",
        "kind": recipe.kind,
        "accept": accept,
        "only": recipe.only,
        "rig": recipe.rig,
        "protocol": recipe.protocol,
        "noise": recipe.noise,
        "resembles": sorted({r for e in recipe.effects for r in e.resembles}),
        "sizes": dict(zip(names, recipe.sizes, strict=True)),
        "truth": {n: value for n, value in vars(recipe.physics).items() if value != getattr(recipe.baseline, n)},
        "physics": asdict(recipe.physics),
        "baseline": asdict(recipe.baseline),
        "rough": recipe.physics.track.size,
        "own_track": recipe.physics.track.own,
        "gauge": asdict(recipe.gauge),
        "runs": [asdict(plan) for plan in recipe.plans],
        "seed": _seed_sequence(seed),
        "attempt": attempt,
    }


def recipe_of(truth: Mapping[str, Any]) -> Recipe:
    """Return the case that a truth describes; of several forms of an effect, the form that the truth has."""
    physics, baseline = (Physics(**{**p, "track": Track(**p["track"])}) for p in (truth["physics"], truth["baseline"]))
    pairs = ("drive", "steps", "gaps")
    plans = tuple(Plan(**{**run, **{n: tuple(map(tuple, run.get(n, ()))) for n in pairs}}) for run in truth["runs"])
    if truth.get("kind") == "ageing":
        effects = [other_ageing(truth["effects"][0], baseline.ageing_name)]
    else:
        forms = [variants(name) for name in truth["effects"]]
        effects = [next((e for e in some if len(some) == 1 or e.varies in truth["truth"]), some[0]) for some in forms]
    told = {name: truth[name] for name in ("kind", "rig", "protocol", "noise", "only") if name in truth}
    gauge = Gauge(**truth["gauge"])
    return Recipe(tuple(effects), tuple(truth["sizes"].values()), physics, baseline, plans, gauge, **told)


# Truths under seal: a salted digest is published with the cases, the truths are kept apart until the answers are in.

LARGEST_FILE = 2**28  # bytes of a file of a bank

SEAL, SCHEMA = "seal.json", "srf.seal/1"
Truths = dict[str, dict[str, Any]]


def seal(bank: Path, truths: Mapping[str, Mapping[str, Any]], apart: Path, *, seed: int | Sequence[int]) -> str:
    """Write the truths, case -> truth, to the file `apart`, and the digests of them and of every case to `bank`/seal.json.

    The salt is drawn from the seed, so that a bank made twice is the same to the byte; while the seed is secret the digest
    gives nothing away. Returns the truths' digest. Raises SrfError where `apart` lies among the cases.
    """
    if bank.resolve() in apart.resolve().parents:
        raise SrfError(f"{apart} lies in the folder of the cases", "Keep the truths where the diagnosis does not look.")
    salt = hashlib.sha256(f"salt of {json.dumps(seed)}".encode()).hexdigest()
    text = _canonical({"salt": salt, "truths": truths})
    digest = hashlib.sha256(text).hexdigest()
    write_atomic(apart, text)
    cases = {name: case_digest(bank / name) for name in sorted(truths)}
    write_atomic(bank / SEAL, _canonical({"schema": SCHEMA, "truths": digest, "cases": cases}))
    return digest


def unseal(bank: Path, apart: Path) -> Truths:
    """Return the truths, case -> truth; SrfError where they, or the files of a case, are not those that were sealed."""
    public = read_seal(bank)
    if public.get("schema") != SCHEMA:
        raise SrfError(f"{bank / SEAL}: schema {public.get('schema')!r}, expected {SCHEMA!r}", "Is this a bank of cases?")
    data = _bytes(apart)
    found = hashlib.sha256(data).hexdigest()
    if not hmac.compare_digest(found, str(public.get("truths"))):
        raise SrfError(
            f"{apart}: SHA-256 {found[:16]}..., sealed was {str(public.get('truths'))[:16]}...",
            "The truths were changed after they were sealed, or belong to another bank; results on it count for nothing.",
        )
    check_cases(bank)
    truths: Truths = json.loads(data)["truths"]
    if set(truths) != set(public["cases"]):
        raise SrfError(f"{bank / SEAL}: its cases are not those of {apart.name}", "The seal was changed; make the bank anew.")
    return truths


def check_cases(bank: Path) -> tuple[str, ...]:
    """Return the names of the cases of a bank; SrfError where a file of one was changed, added or taken away since."""
    cases: dict[str, str] = read_seal(bank)["cases"]
    for name, digest in cases.items():
        if not (bank / name).is_dir() or case_digest(bank / name) != digest:
            raise SrfError(f"{bank / name}: not the files that were sealed", "Restore the case, or make the bank anew.")
    return tuple(cases)


def case_digest(folder: Path) -> str:
    """Return the SHA-256 over names and contents of all files of a case."""
    whole = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name, data = path.relative_to(folder).as_posix().encode(), read_plain(path, limit=LARGEST_FILE)
        whole.update(f"{len(name)} {len(data)} ".encode() + name + data)
    return whole.hexdigest()


def _canonical(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, sort_keys=True, indent=1, allow_nan=False) + "\n").encode()


def _bytes(path: Path) -> bytes:
    try:
        return read_plain(path, limit=LARGEST_FILE)
    except OSError as error:
        raise SrfError(f"{path}: {error.strerror}", "Name the bank, and the file of its truths.", exit_code=1) from error


def read_seal(bank: Path) -> dict[str, Any]:
    """Return what the seal of a bank says, its schema not checked; SrfError where there is none, or a damaged one."""
    path = bank / SEAL
    try:
        data = parse_json(_bytes(path), path)
    except SrfError as error:
        raise SrfError(error.message, "The seal is damaged; make the bank anew.") from None
    if not isinstance(data, dict):
        raise SrfError(f"{path}: a JSON object was expected", "The seal is damaged; make the bank anew.")
    return data


# Banks of concealed cases: every effect, pairs, none and effects outside the library, in an order that gives nothing away.


@dataclass(frozen=True)
class Bank:
    """A bank as written: its folder, the file of its truths, their digest, and the names of its cases."""

    folder: Path
    apart: Path
    digest: str
    cases: tuple[str, ...]


def make_bank(
    folder: Path,
    n: int,
    seed: int,
    *,
    apart: Path | None = None,
    workers: int = 1,
    kinds: Sequence[str] | None = None,
    track: str | None = None,
    bank: str = "paper",
    told: Callable[[int, int], None] | None = None,
) -> Bank:
    """Write `n` cases to the new folder `folder`, their truths to `apart` (default: beside it), and the seal between them.

    Does not depend on the number of workers. `kinds` are the kinds of cases, default all of the bank's, `track` one of TRACKS,
    default all, `bank` one of BANKS; `told` is called with how many are done, of how many. Raises SrfError for a folder that
    exists and for an unknown kind.
    """
    if n < 1:
        raise SrfError(f"{n} cases", "make one or more")
    if folder.exists():
        raise SrfError(f"{folder} exists already", "A bank is never overwritten; name another folder.")
    apart = folder.with_name(f"{folder.name}.truths.json") if apart is None else apart
    if apart.exists():
        raise SrfError(f"{apart} exists already", "Truths are never overwritten; name another file.")
    plan = plan_bank(n, seed, bank=bank, kinds=kinds)
    folder.mkdir(parents=True)
    rough, own = TRACKS[track] if track else (None, None)
    shared: dict[str, Any] = {"rough": rough, "own": own, "bank": bank}
    tasks = [
        {"folder": folder / f"case-{i:03d}", "seed": (seed, i), "kind": kind, "effects": names, **shared}
        for i, (kind, names) in enumerate(plan)
    ]
    truths: dict[str, Truth] = {}
    for _, (name, truth) in run_here(_make, tasks) if workers <= 1 else run_processes(_make, tasks, workers=workers):
        truths[name] = truth
        if told:
            told(len(truths), n)
    digest = seal(folder, truths, apart, seed=seed)
    return Bank(folder, apart, digest, tuple(sorted(truths)))


def plan_bank(n: int, seed: int, *, bank: str = "paper", kinds: Sequence[str] | None = None) -> list[tuple[str, tuple[str, ...]]]:
    """Return kind and effects of each case of a bank, every effect of a kind as often as any other, shuffled.

    The kinds come in their usual shares; those of `kinds` alone where they are given.
    """
    check_kinds(kinds or (), bank)
    rng, wide = np.random.default_rng([seed, 2]), bank == "wide"
    every, shares = (WIDE_KINDS, WIDE_SHARES) if wide else (PAPER_KINDS, KIND_SHARES)
    counts = dict(zip(every, _counts(n, every if kinds is None else kinds, every, shares), strict=True))
    effects: dict[str, list[tuple[str, ...]]] = {
        "single": [(name,) for name in NAMES],
        "pair": [*(possible_pairs() if wide else combinations(NAMES, 2))],
        "outside": [(name,) for name in OUTSIDE_NAMES],
        "one-run": [(name,) for name in ONE_RUN_NAMES],
    }
    plans: list[tuple[str, tuple[str, ...]]] = []
    for kind in every if wide else ("none", "single", "outside", "pair"):
        some = effects.get(kind, [()])
        drawn = [some[k] for k in rng.permutation(len(some))]
        plans += [(kind, names) for names in islice(cycle(drawn), counts[kind])]
    return [plans[i] for i in rng.permutation(n).tolist()]


def check_kinds(kinds: Sequence[str], bank: str) -> None:
    """Raise SrfError for a kind of case that a bank does not have."""
    every = WIDE_KINDS if bank == "wide" else PAPER_KINDS
    strange = [k for k in kinds if k not in every]
    if strange and strange[0] in WIDE_KINDS:
        raise SrfError(f"the bank of the paper has no cases of the kind '{strange[0]}'", "srf prove --bank wide has them.")
    if strange:
        raise SrfError(f"unknown kind of case '{strange[0]}'", did_you_mean(strange[0], every))


def _counts(n: int, kinds: Sequence[str], every: Sequence[str], usual: Sequence[float]) -> list[int]:
    """Return how many cases of each kind a bank of `n` has; what rounding leaves over is of the most frequent kind."""
    shares = np.array([s if k in kinds else 0.0 for k, s in zip(every, usual, strict=True)])
    counts = [int(c) for c in np.floor(shares / (shares.sum() if len(set(kinds)) < len(every) else 1.0) * n + 1e-9)]
    counts[int(np.argmax(shares))] += n - sum(counts)
    return counts


def _make(task: Mapping[str, Any]) -> tuple[str, Truth]:
    return task["folder"].name, make_case(**task)
