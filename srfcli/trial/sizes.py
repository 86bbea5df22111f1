"""The size of an effect as it was estimated, against the size it has in the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from srfcli.trial.answer import Answer


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
