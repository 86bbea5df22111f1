"""`linear`: stability of steady sliding under constant load."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.numerics.hopf import HopfPoint, closed_forms, hopf_points, weakening
from srfcli.results.linear import LinearResult
from srfcli.tasks.values import swept

if TYPE_CHECKING:
    from srfcli.codegen.slider import SlidingSystem

VELOCITIES = tuple(np.geomspace(1.0, 100.0, 60).tolist())  # um/s


def linear(
    system: SlidingSystem, *, over: Mapping[str, Sequence[float] | float] | None = None, all_roots: bool = False
) -> LinearResult:
    """Return the critical load, K/W0 and frequency of steady sliding, from the exact characteristic polynomial.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    over : mapping from parameter to values, optional
        Values in declared units; a grid of their products. V from 1 to 100 um/s if left out.
    all_roots : bool
        Whether every Hopf point is listed, also where stability returns or other roots are unstable.

    Returns
    -------
    LinearResult
        One row for each point of the grid; where there is no Hopf point its status says so.

    Raises
    ------
    SrfError
        For a parameter that the system does not have, or a value out of bounds.

    References
    ----------
    Cochard, Bureau and Baumberger (2003), Trans. ASME J. Appl. Mech. 70, 220: the appendix.
    Rice and Ruina (1983), Trans. ASME J. Appl. Mech. 50, 343.

    Examples
    --------
    >>> import srfcli as srf
    >>> found = srf.linear(srf.system(), over={"V": [1, 10, 100]})
    >>> [round(W0, 4) for W0 in found.to_dataframe()["W0"]]
    [7.2832, 7.805, 13.0808]
    """
    grid = swept(system.model, over or {"V": VELOCITIES})
    points: list[dict[str, Any]] = []
    for values in itertools.product(*grid.values()):
        points += _rows(system, dict(zip(grid, values, strict=True)), all_roots)
    return LinearResult(system, grid, tuple(points))


def _rows(system: SlidingSystem, at: dict[str, float], all_roots: bool) -> list[dict[str, Any]]:
    """Return the rows of one parameter point: its critical load, or every Hopf point, or one row that says there is none."""
    model, p = system.model, system.vector(**at)
    value = {name: float(p[model.index(name)]) for name in model.names}
    common: dict[str, Any] = {n: model.declared(n, value[n]) for n in at} | {"V": value["V"], "K": value["K"]}
    common |= closed_forms(model, p)
    points = hopf_points(model, p)
    if not all_roots:
        points = [q for q in points if q.leading and q.crossing_rate > 0][:1]
    if not points:
        falling = float(np.asarray(weakening(model, p))) > 0
        return [common | {"status": "no Hopf" if falling else "velocity strengthening: no Hopf"}]
    return [common | _point_cells(q, value) for q in points]


def _point_cells(point: HopfPoint, value: dict[str, float]) -> dict[str, Any]:
    cells: dict[str, Any] = {"W0": point.W0, "K_over_W0": value["K"] / point.W0, "Omega_c": point.Omega}
    cells["crossing_rate"], cells["lyapunov"], cells["leading"] = point.crossing_rate, point.lyapunov, point.leading
    known = math.isfinite(point.lyapunov)
    cells["criticality"] = ("direct" if point.direct else "inverted") if known else None
    if "D0" in value:
        cells["Omega_reduced"] = value["D0"] * point.Omega / value["V"]
    return cells | {"status": "ok" if known else "no Lyapunov coefficient: the Jacobian overflows"}
