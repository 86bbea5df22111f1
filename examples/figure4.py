"""Figure 4 of the paper: the reduced critical load W0c(eps)/W0c(0) against eps for five velocities, through the folds.

The boundary is followed in the plane (eps, W0) at constant V, so that several critical loads at one eps are all found.
"""

from __future__ import annotations

import numpy as np
from common import arguments, paper_model, progress, save

from srfcli.codegen.model import GeneratedModel
from srfcli.numerics.continuation import Boundary, find_components
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import critical_point
from srfcli.numerics.plane import Axis, Plane
from srfcli.results.plots import COLOURS, DASHES, house_style, new_figure

VELOCITIES = (1.0, 5.0, 10.0, 30.0, 50.0)
EPS_MAX = 0.2
REDUCED = (0.8, 8.0)  # window of W0 over the load at eps = 0
PRINTED = (0.045, 0.09, 0.13, 0.18)


def find(model: GeneratedModel, V: float, still: float) -> Boundary:
    """Return all components of the boundary in (eps, W0) at one velocity; `still` is the critical load at eps = 0."""
    W0 = Axis("W0", REDUCED[0] * still, REDUCED[1] * still)
    plane = Plane(model.vector({"V": V}), Axis("eps", 0.0, EPS_MAX, log=False), W0)
    for boundary in find_components(model, plane):
        progress(f"V = {V:g} um/s: {sum(len(b.points) for b in boundary.branches)} points")
    return boundary


def main() -> None:
    """Compute, print, draw."""
    args = arguments("The reduced critical loads of the paper's figure 4.")
    model = paper_model()
    with house_style():
        figure, (ax,) = new_figure(size=(6.4, 4.8))
        for index, V in enumerate(VELOCITIES):
            hopf, _ = critical_point(model, model.vector({"V": V}))
            assert hopf is not None
            boundary = find(model, V, hopf.W0)
            progress()
            print(f"V = {V:g} um/s: W0c(0) = {hopf.W0:.6f} N, {len(boundary.branches)} component(s), {boundary.status.value}")
            for eps in PRINTED:
                line = critical_line(model, model.vector({"V": V, "eps": eps}), lo=REDUCED[0] * hopf.W0, hi=REDUCED[1] * hopf.W0)
                loads = ", ".join(f"{q.value(model, 'W0') / hopf.W0:.6f}" for q in line.points)
                print(f"  eps = {eps:g}: W0c/W0c(0) = {loads}")
            style = {"color": COLOURS[index], "linestyle": DASHES[index]}
            for number, branch in enumerate(boundary.branches):
                eps, W0 = (np.array([q.value(model, name) for q in branch.points]) for name in ("eps", "W0"))
                ax.plot(eps, W0 / hopf.W0, label=None if number else f"V = {V:g} µm/s", **style)
        ax.set_xlabel("effective amplitude of modulation  ε")
        ax.set_ylabel("W$_{0c}$(ε) / W$_{0c}$(0)")
        ax.set_yscale("log")
        ticks = (1, 1.5, 2, 3, 4, 6, 8)
        ax.set_yticks(ticks, [f"{y:g}" for y in ticks])
        ax.minorticks_off()
        ax.set_title("Stable below each curve that starts at ε = 0, and within each tongue")
        ax.margins(x=0.0)
        handles = ax.get_legend_handles_labels()
        ax.legend(*(list(reversed(h)) for h in handles), loc="upper left", handlelength=2.8)
    save(figure, args.out, "figure4.png")


if __name__ == "__main__":
    main()
