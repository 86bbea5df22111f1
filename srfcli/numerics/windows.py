"""Where critical loads are looked for when the user names no window: around the critical load without modulation."""

from __future__ import annotations

from collections.abc import Sequence

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array
from srfcli.numerics.hopf import critical_point

BELOW, ABOVE = 0.4, 40.0  # times the critical load at eps = 0
STRENGTHENING = (1.0, 400.0)  # um K: where steady sliding is stable at every load


def load_window(model: GeneratedModel, points: Sequence[Array]) -> tuple[float, float]:
    """Return the loads (N) between which boundaries at these parameters (n_parameters,) are looked for."""
    loads = [q.W0 for q in (critical_point(model, p)[0] for p in points) if q is not None]
    if loads:
        return BELOW * min(loads), ABOVE * max(loads)
    K = float(points[0][model.index("K")])
    return STRENGTHENING[0] * K, STRENGTHENING[1] * K
