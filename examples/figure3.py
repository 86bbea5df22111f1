"""Figure 3 of the paper: spring elongation against time at V = 8 um/s, before and after the modulation is switched on.

The load must lie between the critical loads of eps = 0 and eps = 0.045 for the claim to hold, which are 7.69 N and 8.32 N with
the optimised parameters; at 9 N an amplitude of 0.045 does not suffice. W0 = 8.1 N is used here: stick-slip at eps = 0, 0.015 and
0.03, steady sliding at 0.045. Each trace starts from fully grown stick-slip. The growth rates of small disturbances,
measured on simulated traces, are printed beside ln |multiplier| from Floquet theory, which knows nothing of the simulator.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import arguments, paper_model, progress, save
from numpy.typing import NDArray

from srfcli.codegen.model import GeneratedModel
from srfcli.motion.imposed import Drive, Modulation
from srfcli.motion.simulate import Trace, simulate
from srfcli.numerics.critical import critical_line
from srfcli.numerics.orbit import solve_orbits, steady_guess, uniform_mesh
from srfcli.results.plots import COLOURS, house_style, new_figure

V, W0 = 8.0, 8.1
AMPLITUDES = (0.0, 0.015, 0.03, 0.045)
BEFORE, AFTER = 4.0, 26.0  # s, around the switch-on
OFFSET = 2.6  # um between traces
KICK = 1e-4  # in ln v


def grown_stick_slip(model: GeneratedModel) -> NDArray[np.float64]:
    """Return the state after 40 s under constant load, from a strongly disturbed start: the limit cycle."""
    p = model.vector({"V": V, "W0": W0})
    start = model.steady(p)
    start[model.states.index("ln_v")] += 1.0
    load = Modulation(W0, 0.0, model.defaults()["f"])
    return simulate(model, p, drive=Drive.constant(V), load=load, t=np.array([0.0, 40.0]), start=start).x[-1]


def record(model: GeneratedModel, eps: float, start: NDArray[np.float64]) -> Trace:
    """Return a trace in which the modulation is switched on at t = 0."""
    f = model.defaults()["f"]
    t = -BEFORE + np.arange(round((BEFORE + AFTER) * f * 16) + 1) / (16 * f)  # sixteen samples a period
    p = model.vector({"V": V, "W0": W0})
    return simulate(model, p, drive=Drive.constant(V), load=Modulation(W0, eps, f, onset=0.0), t=t, start=start)


def growth_rates(model: GeneratedModel, eps: float, *, periods: int = 360) -> tuple[float, float]:
    """Return the growth over one period (ln |rho|) measured on a disturbed trace, and by Floquet theory.

    Two traces disturbed by opposite amounts differ by 2 d_k after k periods, even terms cancelled. When the fast modes have
    gone, d_{k+2s} = a d_{k+s} + b d_k, where rho^(2s) = a rho^s + b for the leading pair, so that |rho|^(2s) = -b.
    """
    p = model.vector({"V": V, "W0": W0, "eps": eps})
    f = model.defaults()["f"]
    batch = solve_orbits(model, p[:, None], steady_guess(model, p[:, None], uniform_mesh(64)))
    theory = float(np.log(np.abs(batch.multipliers[0, 0])))
    orbit = batch.orbit.x[0, 0]
    kick = KICK * (np.array(model.states) == "ln_v")
    t, drive, load = np.arange(periods + 1) / f, Drive.constant(V), Modulation(W0, eps, f)
    up, down = (simulate(model, p, drive=drive, load=load, t=t, start=orbit + k, rtol=1e-12) for k in (kick, -kick))
    d = (up.x - down.x)[periods // 4 :] / np.array([1.0, V, 1.0, 1.0])
    step = 8  # s, in periods: the phases then differ enough for a well-conditioned fit
    earlier = np.stack([d[step:-step].ravel(), d[: -2 * step].ravel()], axis=-1)
    (_, b), *_ = np.linalg.lstsq(earlier, d[2 * step :].ravel())
    return float(np.log(-b)) / (2 * step), theory


def swing(trace: Trace) -> float:
    """Return the peak-to-peak elongation (um) over the last 2 s."""
    return float(np.ptp(trace.u[trace.t > AFTER - 2.0]))


def main() -> None:
    """Compute, print, draw."""
    args = arguments("The time traces of the paper's figure 3.")
    model = paper_model()
    print(f"V = {V:g} um/s, W0 = {W0:g} N")
    for eps in AMPLITUDES:
        critical = critical_line(model, model.vector({"V": V, "eps": eps}), lo=4.0, hi=40.0).points[0].value(model, "W0")
        measured, theory = growth_rates(model, eps)
        progress()
        print(
            f"eps = {eps:5.3f}: W0c = {critical:.8f} N, {'stick-slip' if critical < W0 else 'steady sliding'}; growth in a "
            f"period {measured:+.8f} on a trace, {theory:+.8f} by Floquet theory (difference {abs(measured - theory):.0e})"
        )
    progress("stick-slip under constant load")
    start = grown_stick_slip(model)
    traces = []
    for eps in AMPLITUDES:
        progress(f"trace at eps = {eps:g}")
        trace = record(model, eps, start)
        progress()
        print(f"eps = {eps:5.3f}: elongation swings by {swing(trace):.4f} um, {AFTER:g} s after switch-on ({trace.status.value})")
        traces.append(trace)
    draw(traces, args.out)


def draw(traces: list[Trace], out: Path) -> None:
    """Draw the traces one above the other, and the last one's end blown up."""
    with house_style():
        figure, (ax,) = new_figure(size=(7.0, 5.0))
        base = float(np.mean(traces[0].u))
        for i, (eps, trace) in enumerate(zip(AMPLITUDES, traces, strict=True)):
            ax.plot(trace.t, trace.u - base + OFFSET * i, color=COLOURS[i], linewidth=0.9)
            ax.annotate(f"ε = {eps:g}", (AFTER + 0.3, trace.u[-1000:].mean() - base + OFFSET * i), color=COLOURS[i], va="center")
        ax.axvline(0.0, color="#555555", linewidth=0.8, linestyle=(0, (4, 2)))
        ax.set_xlim(-BEFORE, AFTER + 3.6)
        ax.set_ylim(-1.8, OFFSET * 3 + 4.6)
        ax.annotate("modulation on", (0.2, OFFSET * 3 + 4.3), color="#555555", va="top")
        ax.set_xlabel("time after switch-on  [s]")
        ax.set_ylabel("elongation, offset  [µm]")
        ax.set_title(f"V = {V:g} µm/s, W$_0$ = {W0:g} N: ε = 0.045 suppresses stick-slip")
        inset = ax.inset_axes((0.54, 0.775, 0.34, 0.165))
        last = traces[-1]
        part = last.t >= AFTER - 0.05
        inset.plot(1e3 * (last.t[part] - AFTER), last.u[part] - last.u[part].mean(), color=COLOURS[3], linewidth=0.9)
        inset.set_xlabel("ms before the end of ε = 0.045", fontsize=7, labelpad=1)
        inset.set_ylabel("µm", fontsize=7, labelpad=1)
        inset.tick_params(labelsize=7, pad=1.5)
        inset.margins(x=0.0)
    save(figure, out, "figure3.png")


if __name__ == "__main__":
    main()
