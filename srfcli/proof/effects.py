"""What can be concealed: each effect, how strong it is drawn, and what the baseline is that lacks it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from srfcli.errors import SrfError, did_you_mean
from srfcli.proof.physics import Physics

TURN = (0.0, 2 * math.pi)


@dataclass(frozen=True)
class Effect:
    """One concealed piece of physics: `varies`, a field of Physics, departs from `neutral` by `weak` to `strong`.

    The sign is drawn from `signs`, and `beside` evenly between bounds; `absent` are the fields of a baseline that has none of it.
    `listed` says whether a diagnosis may name it, `resembles` which names come close where it may not.
    """

    name: str
    varies: str
    weak: float
    strong: float
    signs: tuple[int, ...] = (1,)
    neutral: float = 0.0
    beside: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    absent: Mapping[str, bool] = field(default_factory=dict)
    scale: float = 1.0  # the field is neutral + scale * sign * size
    listed: bool = True
    resembles: tuple[str, ...] = ()

    def added(self, p: Physics, rng: np.random.Generator, size: float) -> Physics:
        """Return `p` with this effect, its strength `size` of the way from weak to strong, on a logarithmic scale."""
        strength = self.weak * (self.strong / self.weak) ** size
        sign = self.signs[int(rng.integers(len(self.signs)))]
        drawn = {name: float(rng.uniform(*bounds)) for name, bounds in self.beside.items()}
        changes: dict[str, Any] = {**drawn, self.varies: self.neutral + self.scale * sign * strength}
        if self.varies == "Vsat":
            changes["Vsat"] = 1 / strength  # the cut-off is absent at 1/Vsat = 0
        return replace(p, **changes)

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
    Effect("linker-dieterich", "alpha", 0.001, 0.03),
    Effect("interface-compliance", "lam", 0.1, 0.9, absent={"rigid": True}),
    Effect("stiffness-exponent", "n_kappa", 0.08, 0.7, BOTH, neutral=1.0),
    Effect("age-saturation", "Vsat", 1 / 3000, 1 / 100, absent={"bare": True}),
    Effect("log-log-coupling", "C", 5e-5, 1.5e-3, BOTH),
    Effect("slip-evolution", "slip_share", 0.03, 1.0),
    Effect("second-state", "B2", 3e-4, 8e-3, beside={"D2": (2.0, 12.0)}),
    Effect("viscous-drag", "drag", 5e-6, 3e-4),
    Effect("adhesion-offset", "Wa", 0.02, 0.6),
    Effect("load-transmission", "rho", 0.01, 0.7, (-1,), neutral=1.0),
    Effect("load-distortion", "distortion", 0.02, 0.4, beside={"distortion_phase": TURN}),
    Effect("tangential-crosstalk", "cross", 0.001, 0.03, BOTH),
    Effect("track-topography", "topo", 2e-4, 2e-3, beside={"topo_L": (6.0, 40.0), "topo_phase": TURN}),
    Effect("friction-drift", "drift_t", 1e-4, 2.5e-3, BOTH, beside={"drift_t0": (0.0, 1.5)}),
    Effect("friction-drift", "drift_x", 1e-5, 2.5e-4, BOTH, beside={"drift_x0": (0.0, 15.0)}),
    Effect("drive-ripple", "ripple", 0.01, 0.15, beside={"ripple_p": (4.0, 25.0), "ripple_phase": TURN}),
    Effect("sensor-lag", "lag", 5e-4, 0.02),
    Effect("stiffness-error", "ratio", 0.03, 0.3, BOTH, neutral=1.0),
    Effect("inertia", "M", 0.2, 4.0, scale=1e-6, absent={"massless": True}),  # kg
)
OUTSIDE: tuple[Effect, ...] = (
    Effect("age-exponent", "p_age", 0.15, 1.0, neutral=1.0, listed=False, resembles=("slip-evolution",)),
    Effect(
        "track-bump", "bump", 8e-4, 8e-3, BOTH, beside={"bump_x": (8.0, 35.0), "bump_w": (0.5, 3.0)}, listed=False,
        resembles=("track-topography",),
    ),
    Effect(
        "load-memory", "memory", 0.1, 1.0, beside={"memory_tau": (0.001, 0.2)}, listed=False,
        resembles=("load-transmission", "linker-dieterich"),
    ),
    Effect("speed-dependent-length", "D_power", 0.04, 0.4, BOTH, listed=False, resembles=("slip-evolution",)),
    Effect("load-dependent-friction", "W_power", 0.004, 0.08, BOTH, listed=False, resembles=("adhesion-offset",)),
    Effect("age-limit", "age_rate", 0.05, 2.0, listed=False, resembles=("age-saturation",)),
    Effect("interface-damping", "eta", 5e-4, 0.02, listed=False),
    Effect("drive-lag", "drive_tau", 0.005, 0.15, listed=False, resembles=("sensor-lag",)),
    Effect("gauge-backlash", "backlash", 0.015, 0.2, listed=False, resembles=("sensor-lag",)),
)  # fmt: skip
NAMES = tuple(dict.fromkeys(e.name for e in EFFECTS))
OUTSIDE_NAMES = tuple(e.name for e in OUTSIDE)


def variants(name: str) -> tuple[Effect, ...]:
    """Return the effects of this name; SrfError for one that is not known."""
    found = tuple(e for e in (*EFFECTS, *OUTSIDE) if e.name == name)
    if not found:
        raise SrfError(f"unknown effect '{name}'", did_you_mean(name, (*NAMES, *OUTSIDE_NAMES)))
    return found
