"""A case as a folder in the format srf-experiment/1: what the one who is to diagnose it gets to see."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate

import numpy as np

from srfcli.proof.physics import Physics
from srfcli.proof.protocol import Plan

DESCRIPTION = "experiment.toml"
HEADER = "time [s],load_point_velocity [um/s],normal_load [N],elongation [um]"
STARTS = {  # name -> value, lower, upper: the same for every case, as in the examples
    "mu0": (0.33, 0.2, 0.5),
    "A": (0.012, 0.006, 0.03),
    "B": (0.023, 0.01, 0.06),
    "D0": (0.4, 0.1, 1.5),
    "Vsat": (280.0, 50.0, 2000.0),
    "lambda": (0.62, 0.2, 1.5),
}
BARE_START = (0.46, 0.3, 0.7)  # of mu0, where it is the steady friction at V0


def description(title: str, baseline: Physics, plans: tuple[Plan, ...]) -> str:
    """Return the text of experiment.toml: apparatus and model as the baseline has them, nothing of what is concealed."""
    starts = dict(STARTS)
    if baseline.bare:
        starts["mu0"] = BARE_START
        del starts["Vsat"]
    if baseline.rigid:
        del starts["lambda"]
    mass = "" if baseline.massless else f'mass = "{baseline.M * 1e6:.3g} kg"\n'
    lines = [
        f'format = "srf-experiment/1"\ntitle = "{title}"\n',
        f'[apparatus]\nstiffness = "{baseline.K:.6g} N/um"\n{mass}',
        f'[model]\nlaw = "{"dieterich-ruina" if baseline.bare else "srf-vsat"}"\nageing = "dieterich"',
        f'interface = "{"rigid" if baseline.rigid else "elastic"}"\ninertia = {_truth(not baseline.massless)}\n',
        "[parameters]   # start values and bounds of what is to be fitted; um, s, N",
        *(f"{n} = {{ value = {v!r}, lower = {a!r}, upper = {b!r} }}" for n, (v, a, b) in starts.items()),
        "V0 = { value = 1.0, fixed = true }",
    ]
    return "\n".join([*lines, *map(_run, plans)]) + "\n"


def _run(plan: Plan) -> str:
    drive = ", ".join(f"{{ duration = {d!r}, velocity = {v!r} }}" for d, v in plan.drive)
    text = f'\n[[runs]]\nname = "{plan.name}"\nfile = "{plan.name}.csv"\nholdout = {_truth(plan.holdout)}'
    text += f"\ndrive = [{drive}]   # s, um/s"
    if plan.eps:
        text += f"\nmodulation = {{ frequency = {plan.f!r}, amplitude = {plan.eps!r}, onset = {plan.onset!r} }}"
        text += "   # Hz, of the mean load, s; the load itself is the column"
    return text


def table(plan: Plan, observed: np.ndarray) -> str:
    """Return the text of a run's CSV: time, nominal velocity of the load point, imposed load, readings `observed` (n,)."""
    t, load = plan.times(), plan.load()
    ends = np.array(list(accumulate(d for d, _ in plan.drive)))
    velocities = np.array([v for _, v in plan.drive])
    V = velocities[np.minimum(np.searchsorted(ends, t + 1e-9, side="right"), velocities.size - 1)]
    W = [load(s)[0] for s in t.tolist()]
    rows = (f"{s:.4f},{v:g},{w:.6f},{u:.3f}" for s, v, w, u in zip(t, V, W, observed, strict=True))
    return "\n".join([HEADER, *rows]) + "\n"


def case_files(title: str, baseline: Physics, readings: Mapping[Plan, np.ndarray]) -> dict[str, str]:
    """Return the files of a case, name -> text."""
    runs = {f"{plan.name}.csv": table(plan, observed) for plan, observed in readings.items()}
    return {**runs, DESCRIPTION: description(title, baseline, tuple(readings))}


def _truth(value: bool) -> str:
    return "true" if value else "false"
