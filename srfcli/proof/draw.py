"""What a case is made of, drawn from its seed: laws around those of the examples, effects, protocol, track and gauge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from srfcli.errors import SrfError, did_you_mean
from srfcli.proof.effects import NAMES, OUTSIDE_NAMES, Effect, variants
from srfcli.proof.physics import Physics
from srfcli.proof.protocol import Plan
from srfcli.proof.track import SMOOTH, Track

KINDS = ("none", "single", "pair", "outside")
SHARES = (0.25, 0.4, 0.15, 0.2)  # of the kinds, where none is asked for
SPREAD = {"A": 0.05, "B": 0.05, "D0": 0.05, "lam": 0.05, "Vsat": 0.13, "mu0": 0.01}  # relative standard deviations
ODD = ("rigid", "massless", "bare")  # baselines other than the usual one
ODD_SHARE = 0.15  # of the cases where no effect decides it: else an odd baseline would give the answer away
USUAL_ONLY = {
    "stiffness-exponent",
    "log-log-coupling",
    "interface-damping",
    "interface-compliance",
    "inertia",
    "age-saturation",
}
ROUGH_SHARE, WHITE_SHARE = 0.4, 0.6
ROUGHNESS, CORRELATION = (5e-5, 4e-4), (3.0, 30.0)  # of mu0; um
SIGMA, QUANTUM, REDDEST = 0.02, 0.005, 0.85


@dataclass(frozen=True)
class Gauge:
    """The noise of a gauge: standard deviation and quantum in um, correlation of neighbouring samples."""

    sigma: float = SIGMA
    lag1: float = 0.0
    quantum: float = QUANTUM


@dataclass(frozen=True)
class Recipe:
    """A case before anything moves: the truth `physics`, the `baseline` that is stated, the plans of its runs, its gauge."""

    effects: tuple[Effect, ...]
    sizes: tuple[float, ...]
    physics: Physics
    baseline: Physics
    plans: tuple[Plan, ...]
    gauge: Gauge


def draw_recipe(
    rng: np.random.Generator,
    *,
    kind: str | None = None,
    effects: Sequence[str] | None = None,
    size: float | None = None,
    rough: bool | float | None = None,
) -> Recipe:
    """Return the case that `rng` gives; what is asked for is not drawn.

    `size` from 0 to 1 is how strong the effects are, `rough` whether the track is, or the standard deviation of its mu0.
    """
    chosen = _chosen(rng, kind, effects)
    drawn = rng.uniform(0, 1, size=len(chosen)).tolist()
    sizes = tuple(drawn if size is None else [_within(size)] * len(chosen))
    physics = _laws(rng, chosen)
    track = _track(rng, rough)
    for effect, strength in zip(chosen, sizes, strict=True):
        physics = effect.added(physics, rng, strength)
    physics = replace(physics, track=track)
    baseline = physics
    for effect in chosen:
        baseline = effect.removed(baseline)
    plans = draw_protocol(rng)
    lag1 = float(rng.uniform(0.3, REDDEST))
    gauge = Gauge(lag1=0.0 if rng.uniform() < WHITE_SHARE else lag1)
    return Recipe(chosen, sizes, physics, baseline, plans, gauge)


def _within(size: float) -> float:
    if not 0 <= size <= 1:
        raise SrfError(f"size = {size:g} of an effect", "give a number from 0, hardly there, to 1, strong")
    return size


def _chosen(rng: np.random.Generator, kind: str | None, names: Sequence[str] | None) -> tuple[Effect, ...]:
    """Return the effects by name, or as many as the kind has."""
    drawn_kind = str(rng.choice(KINDS, p=SHARES))
    order = [str(n) for n in rng.permutation(NAMES)]
    outside = str(rng.choice(OUTSIDE_NAMES))
    if names is None:
        kind = drawn_kind if kind is None else kind
        if kind not in KINDS:
            raise SrfError(f"unknown kind of case '{kind}'", did_you_mean(kind, KINDS))
        names = {"none": [], "single": order[:1], "pair": order[:2], "outside": [outside]}[kind]
    if len(set(names)) < len(names):
        raise SrfError(f"an effect is named twice: {', '.join(names)}", "name each once")
    options = [variants(name) for name in names]
    return tuple(some[int(rng.integers(len(some)))] for some in options)


def _laws(rng: np.random.Generator, chosen: Sequence[Effect]) -> Physics:
    """Return the laws' numbers, and now and then a baseline that is rigid, quasi-static or without a cut-off of age."""
    usual = Physics()
    numbers = {n: getattr(usual, n) * float(np.exp(s * rng.standard_normal())) for n, s in SPREAD.items()}
    odd, which = rng.uniform() < ODD_SHARE, str(rng.choice(ODD))
    physics = replace(usual, **numbers)
    if not odd or any(effect.name in USUAL_ONLY for effect in chosen):
        return physics
    if which == "bare":
        return replace(physics, bare=True, mu0=physics.mu0 + physics.B * float(np.log(physics.Vsat / physics.V0)))
    return replace(physics, rigid=which == "rigid", massless=which == "massless")


def _track(rng: np.random.Generator, rough: bool | float | None) -> Track:
    is_rough = rng.uniform() < ROUGH_SHARE
    size = float(np.exp(rng.uniform(*np.log(ROUGHNESS))))
    length, seed = float(np.exp(rng.uniform(*np.log(CORRELATION)))), int(rng.integers(2**32))
    if rough is not None and not isinstance(rough, bool):
        size = float(rough)
        if not 0 <= size < 0.1:
            raise SrfError(
                f"rough = {size:g} is no roughness of a track", "give the standard deviation of mu0, say 3e-4"
            )
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
