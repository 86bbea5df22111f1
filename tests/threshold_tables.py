"""Tables of critical loads as a model gives them, for tests and benchmarks of their fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError
from srfcli.data.thresholds import Thresholds, thresholds
from srfcli.numerics.critical import critical_line, load_window
from srfcli.numerics.hopf import critical_point


def with_noise(table: Thresholds, seed: int, *, relative: float = 0.03) -> Thresholds:
    """Return the table with independent normal noise of `relative` times each load added, its sigma set to that."""
    sigma = relative * table.W0c
    noise = np.random.default_rng(seed).normal(size=len(table)) * sigma
    return replace(table, W0c=table.W0c + noise, sigma=sigma)


def generated(
    model: GeneratedModel, V: Array, eps: Array, *, values: Mapping[str, float], tol: float = 1e-8, relative: float = 0.03
) -> Thresholds:
    """Return the lowest odd critical load of the model at each (V, eps), (n,), with `relative` errors but no noise.

    `values` are all parameters in base units, the table's eps is that before the paper's rho. Raises SrfError where sliding
    is stable at every load looked at.
    """
    own = {k: v for k, v in values.items() if k in model.names}
    share = values.get("rho", 1.0) if "rho" not in model.names else 1.0
    loads = []
    for velocity, amplitude in zip(V, eps, strict=True):
        base = model.vector({**own, "V": float(velocity), "eps": share * float(amplitude)})
        if share * amplitude > 0:
            lo, hi = load_window(model, [base])
            odd = [q for q in critical_line(model, base, lo=lo, hi=hi, tol=tol).points if q.slope > 0]
            if not odd:  # none around that without modulation
                odd = [q for q in critical_line(model, base, tol=tol).points if q.slope > 0]
            load = odd[0].value(model, "W0") if odd else None
        else:
            point = critical_point(model, base)[0]
            load = None if point is None else point.W0
        if load is None:
            raise SrfError(
                f"sliding is stable at every load at V = {velocity:g} um/s, eps = {amplitude:g}", "Leave this point out."
            )
        loads.append(load)
    return thresholds(V, eps, loads, sigma=relative * np.array(loads), source="generated")
