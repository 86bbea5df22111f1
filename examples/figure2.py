"""Figure 2 of the paper: the stability diagram, K/W0 against V, for five amplitudes of the load's modulation.

All components in the window are found; the boundary at eps = 0 is the exact Hopf curve. Prints where the curves of eps = 0.18
and 0.13 cross, and the critical velocities at K/W0 = 0.026 /um without modulation and at eps = 0.09.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from common import arguments, paper_model, progress, save
from scipy.optimize import brentq

from srfcli.codegen.model import GeneratedModel
from srfcli.numerics.continuation import Boundary, find_components
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import critical_point
from srfcli.numerics.plane import Axis, Plane
from srfcli.results.plots import stability_diagram

AMPLITUDES = (0.045, 0.09, 0.13, 0.18)
V_RANGE, W0_RANGE = (1.0, 100.0), (4.0, 400.0)
STIFFNESS_PER_LOAD = 0.026  # 1/um, the paper's example


def find(model: GeneratedModel, eps: float) -> Boundary:
    """Return all components of the boundary of one eps in the window."""
    plane = Plane(model.vector({"eps": eps}), Axis("V", *V_RANGE), Axis("W0", *W0_RANGE))
    for boundary in find_components(model, plane):
        progress(f"eps = {eps:g}: {sum(len(b.points) for b in boundary.branches)} points")
    return boundary


def hopf_load(model: GeneratedModel, V: float) -> float:
    """Return the exact critical load under constant load."""
    point, _ = critical_point(model, model.vector({"V": V}))
    assert point is not None
    return point.W0


def lowest_load(model: GeneratedModel, V: float, eps: float) -> float:
    """Return the first critical load met as W0 rises, to 1e-9."""
    base = model.vector({"V": V, "eps": eps})
    return critical_line(model, base, lo=W0_RANGE[0], hi=W0_RANGE[1], tol=1e-9).points[0].value(model, "W0")


def root_in_V(function: Callable[[float], float], lo: float, hi: float) -> float:
    """Return the velocity between lo and hi at which `function` vanishes."""
    return float(np.exp(brentq(lambda s: function(float(np.exp(s))), np.log(lo), np.log(hi), xtol=1e-9)))


def print_crossing(model: GeneratedModel) -> None:
    """Print where the boundary of eps = 0.18 crosses that of 0.13: beyond it more modulation destabilises."""
    progress("crossing of eps = 0.13 and 0.18")
    V = root_in_V(lambda V: lowest_load(model, V, 0.18) / lowest_load(model, V, 0.13) - 1, 6.0, 8.0)
    K = model.defaults()["K"]
    W0 = lowest_load(model, V, 0.13)
    progress()
    print(f"eps = 0.18 and 0.13 cross at V = {V:.6f} um/s, K/W0 = {K / W0:.7f} /um (W0 = {W0:.6f} N)")


def print_critical_velocities(model: GeneratedModel) -> None:
    """Print by how much eps = 0.09 lowers the critical velocity at K/W0 = 0.026 /um."""
    progress("critical velocities")
    W0 = model.defaults()["K"] / STIFFNESS_PER_LOAD
    still = root_in_V(lambda V: hopf_load(model, V) - W0, 1.0, 30.0)
    shaken = root_in_V(lambda V: lowest_load(model, V, 0.09) - W0, 0.05, 5.0)
    progress()
    print(f"at K/W0 = {STIFFNESS_PER_LOAD:g} /um (W0 = {W0:.6f} N): sliding is stable from V = {still:.6f} um/s on at eps = 0,")
    print(f"  from V = {shaken:.6f} um/s on at eps = 0.09: {still / shaken:.4f} times lower")


def main() -> None:
    """Compute, print, draw."""
    args = arguments("The stability diagram of the paper's figure 2.")
    model = paper_model()
    K = model.defaults()["K"]
    branches = []
    for eps in AMPLITUDES:
        boundary = find(model, eps)
        progress()
        print(f"eps = {eps:g}: {len(boundary.branches)} component(s), {boundary.status.value}")
        for number, branch in enumerate(boundary.branches, 1):
            V, W0 = (np.array([q.value(model, name) for q in branch.points]) for name in ("V", "W0"))
            folds = int(np.sum(np.diff(np.sign(np.diff(V))) != 0))
            print(
                f"  {number}: {len(V)} points, V = {V.min():g} to {V.max():g} um/s, W0 = {W0.min():.4f} to {W0.max():.4f} N, "
                f"{folds} folds, {branch.start.value} / {branch.end.value}"
            )
            branches.append({"eps": eps, "V": V, "K_over_W0": K / W0, "component": number})
    V = np.geomspace(*V_RANGE, 81)
    hopf = {"V": V, "K_over_W0": [K / hopf_load(model, float(x)) for x in V]}
    print_crossing(model)
    print_critical_velocities(model)
    title = "Critical K/W$_0$ against V, optimised parameters"
    save(stability_diagram(branches, hopf=hopf, title=title), args.out, "figure2.png")


if __name__ == "__main__":
    main()
