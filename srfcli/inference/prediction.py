"""What a model predicts for a run, with exact derivatives, and what belongs to one run alone.

Names are RUN.mu (friction at the first sample), RUN.ln_PHI (logarithm of an age there, s), RUN.trend (per um or per s), and of
what is observed besides RUN.slip (um, where its gauge stands at the first sample), RUN.area and RUN.area_growth: a contact area
is W/W(t0) area (1 + area_growth ln(phi/1 s)), the growth by the logarithm of age of Dieterich and Kilgore, Pageoph 143 (1994).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from srfcli.codegen.model import COMPLEX_STEP, Array, ComplexArray, GeneratedModel
from srfcli.codegen.splines import Spline, appended
from srfcli.core.errors import Status
from srfcli.data.imposed import find_modulation
from srfcli.data.values import AREA_GROWTH, Experiment, Run, per_elongation
from srfcli.motion.imposed import Load
from srfcli.motion.integrators import integrate

# What belongs to one run alone and is estimated with the parameters: its unobserved initial state, a trend of its observable.

GAUGES = {"slip": ("slip",), "contact_area": ("area", "area_growth")}  # of an observable: what its gauge's reading depends on
FREE_START_WIDTH = 0.1  # least distance of the bounds of a free start's friction: a run may begin without any


def run_specific_names(model: GeneratedModel, run: Run, trend: str | None) -> list[str]:
    """Return the names of what this run adds to the parameters."""
    initial = [f"{run.name}.mu", *(f"{run.name}.{s}" for s in _ages(model))] if run.initial == "free" else []
    gauges = [f"{run.name}.{n}" for s in run.others for n in GAUGES.get(s.observable, ())]
    return initial + ([f"{run.name}.trend"] if trend else []) + gauges


def run_specific_start(
    model: GeneratedModel, run: Run, p: Array, name: str, trend: str | None = None
) -> tuple[float, float, float]:
    """Return a start value and bounds for one of `run_specific_names`; a trend is proportional to `trend`, slip if left out."""
    kind = name.rpartition(".")[2]
    if kind == "trend":
        steepest = 10 * float(np.ptp(run.observed)) / max(float(np.ptp(basis(run, trend or "slip"))), 1e-9)
        return 0.0, -max(steepest, 1e-9), max(steepest, 1e-9)
    if kind == "mu":
        mu = first_friction(run)
        wide = max(0.5 * abs(mu), FREE_START_WIDTH)
        return mu, mu - wide, mu + wide
    if kind in {n for names in GAUGES.values() for n in names}:
        return _gauge_start(run, kind)
    steady = float(np.asarray(model.steady(driven(model, run, p)))[model.states.index(kind)])
    return steady, steady - 15.0, steady + 15.0


def driven(model: GeneratedModel, run: Run, p: Array) -> Array:
    """Return p; of a run that begins at rest, where nothing slides steadily, with the fastest drive that it has."""
    if run.drive.at(float(run.t[0])) > 0:
        return p
    q = p.copy()
    q[model.index("V")] = float(np.max(np.abs(run.drive(run.t))))
    return q


def first_friction(run: Run) -> float:
    """Return the friction coefficient in the first readings of a run, by the stated stiffness."""
    return float(np.median(run.observed[run.used][:5]) * run.friction_factor(run.first_load))


def first_elongation(run: Run) -> float:
    """Return the spring's elongation (um) in the first readings of a run, by the stated stiffness."""
    return first_friction(run) * run.first_load / run.stiffness


def _gauge_start(run: Run, kind: str) -> tuple[float, float, float]:
    """Return a start value and bounds for what turns slip or contact area into what their gauges show."""
    if kind == "area_growth":
        return AREA_GROWTH, 1e-2 * AREA_GROWTH, 20 * AREA_GROWTH
    signal = next(s for s in run.others if kind in GAUGES.get(s.observable, ()))
    y = signal.observed[signal.used]
    first, wide = float(np.median(y[:5])), max(float(np.ptp(y)), 1e-9)
    if kind == "slip":
        return first, first - 2 * wide, first + 2 * wide
    return first, 0.2 * first, 5.0 * first


def basis(run: Run, trend: str) -> Array:
    """Return what a trend is proportional to: the load point's displacement since the first sample (um), or time (s)."""
    return run.t - run.t[0] if trend == "time" else run.drive.displacement(run.t)


def start_state(
    model: GeneratedModel,
    run: Run,
    p: Array,
    values: Mapping[str, float],
    by: Sequence[str],
    coefficient_indices: Sequence[int] = (),
) -> tuple[Array, Array]:
    """Return the state (n,) at the first sample and its derivatives (n, k): steady sliding, or what `values` say of a free start.

    `coefficient_indices` are places in `p`, beyond the parameters, of tables' coefficients: columns after those of `by`.

    A free start is in balance: the friction law gives the slip velocity at which mu and the ages meet, z follows it.
    """
    indices = {name: model.index(name) for name in by if name in model.names}
    indices |= {f"[{place}]": place for place in coefficient_indices}
    by = [*by, *(f"[{place}]" for place in coefficient_indices)]
    if run.initial != "free":
        x0 = np.asarray(model.steady(p))
        S0 = np.zeros((x0.size, len(by)))
        for k, name in enumerate(by):
            if name in indices:
                S0[:, k] = derivative(model.steady, p, indices[name])
        return x0, S0
    return _free_start(model, run, p, values, by, indices)


def _free_start(
    model: GeneratedModel, run: Run, p: Array, values: Mapping[str, float], by: Sequence[str], indices: Mapping[str, int]
) -> tuple[Array, Array]:
    states = list(model.states)
    V, W = run.drive.at(float(run.t[0])), run.first_load
    ages, iv = _ages(model), states.index("ln_v")
    mu = values[f"{run.name}.mu"]
    x = np.asarray(model.steady(driven(model, run, p))).astype(complex)
    for age in ages:
        x[states.index(age)] = values[f"{run.name}.{age}"]
    for _ in range(60):  # Newton in ln v; friction is close to linear there
        moved = x.copy()
        moved[iv] += 1j * COMPLEX_STEP
        found = model.friction(moved, V, W, 0.0, p)
        step = (mu - found.real) / (found.imag / COMPLEX_STEP)
        x[iv] += np.clip(step, -3.0, 3.0)
        if abs(step) < 1e-13 * (1 + abs(x[iv])):
            break
    x, slope = x.real, found.imag / COMPLEX_STEP
    stiffness = model.namespace.get("stiffness") or (lambda x, V, W, W_dot, p: p[model.index("K")])

    def balanced(name: str) -> ComplexArray:
        """Return the state with a complex step of one quantity, to first order; of none where the name is not one's of here."""
        y, q, own, step = x.astype(complex), p.astype(complex), name.partition(f"{run.name}.")[2], 1j * COMPLEX_STEP
        if own in ages:
            y[states.index(own)] += step
        elif name in indices:
            q[indices[name]] += step
        friction = mu + (step if own == "mu" else 0.0)
        y[iv] += (friction - model.friction(y, V, W, 0.0, q)) / slope
        if "u" in states:
            y[states.index("u")] = W * friction / stiffness(y, V, W, 0.0, q)
        if "z" in states:
            y[states.index("z")] = np.exp(y[iv])
        return y

    columns = [balanced(name).imag / COMPLEX_STEP for name in by]
    return balanced("").real, np.array(columns).T if columns else np.zeros((x.size, 0))


def derivative(function: Callable[[ComplexArray], ComplexArray], p: Array, place: int) -> Array:
    """Return the derivative of a function of `p` (k,) or (n, k) by the number, or the column, at `place`."""
    q = p.astype(complex)
    q[..., place] += 1j * COMPLEX_STEP
    return np.asarray(np.asarray(function(q)).imag / COMPLEX_STEP)


def _ages(model: GeneratedModel) -> list[str]:
    return [s for s in model.states if s.startswith("ln_") and s != "ln_v"]


# What a model with given parameters predicts for a run, and the exact derivatives of that.

MOTION_RTOL = 1e-6  # errors of some 1e-5 um after minutes of stick-slip, a thousandth of a good gauge's noise


@dataclass(frozen=True)
class Prediction:
    """The observable `y` (n,) of a run in um, N or 1, and `J` (n, k), its derivatives by the names asked for; x (n, states)."""

    y: Array
    J: Array
    x: Array
    status: Status
    reached: float


def run_parameters(model: GeneratedModel, experiment: Experiment, run: Run, values: Mapping[str, float]) -> Array:
    """Return p for this run: the experiment's values, overridden by `values`, with the run's own stiffness, V and W0.

    What acts in other runs alone is as it is elsewhere.
    """
    base = {"K": run.stiffness}
    if experiment.mass is not None and "M" in model.names:
        base["M"] = experiment.mass
    listed = {q.name: q.value for q in experiment.parameters} | dict(values)
    listed |= experiment.elsewhere(run)
    base |= {name: value for name, value in listed.items() if name in model.names}
    if "K" in listed:
        base["K"] = listed["K"] * stiffness_share(experiment, run)
    if "begin" in model.names:
        base |= effect_inputs(run)
    return model.vector({**base, "V": run.drive.at(float(run.t[0])), "W0": run.first_load})


def effect_inputs(run: Run) -> dict[str, float]:
    """Return what effects ask of a recording: where and when it begins, and the load's modulation as it is in the data."""
    weighed = float(run.observable != "elongation")
    return {"start": run.start, "begin": float(run.t[0]), "weighed": weighed, **_modulation(run)}


def _modulation(run: Run) -> dict[str, float]:
    """Return the modulation of a run's load, that of the whole run where this is a part of one."""
    if run.load not in _MODULATIONS:
        _MODULATIONS[run.load] = modulation_of(run.load, run.t)
    return _MODULATIONS[run.load]


def modulation_of(load: Load, t: Array) -> dict[str, float]:
    """Return frequency, amplitude and phase at clock 0 of a load's modulation, onset and time scale of its switch-on.

    They are found in the load as it is at the times t.
    """
    W = load(t)[0]
    found = find_modulation(t, W)
    answer = {"f": 1.0, "eps": 0.0, "psi": 0.0, "onset0": -1e6, "rise0": 0.02, "modulated": 0.0}
    if found is None:
        return answer
    return answer | {"f": found.frequency, "modulated": 1.0} | _switched(t, W, found.frequency, found.amplitude, found.onset)


def _switched(t: Array, W: Array, f: float, eps: float, onset: float) -> dict[str, float]:
    """Return amplitude, phase, onset and time scale by least squares on the load, W0 (1 + eps (1 + tanh)/2 cos)."""
    from scipy.optimize import least_squares

    begin = float(t[0])
    on = t > (onset if np.isfinite(onset) else begin) + 10 / f
    on = on if on.any() else t > t[t.size // 2]
    mean = float(W[on].mean())
    turned = (W[on] / mean - 1) * np.exp(-2j * np.pi * f * t[on])
    psi = float(np.angle(turned.mean()))
    if not np.isfinite(onset):
        return {"eps": eps, "psi": psi}

    def rest(x: Array) -> Array:
        envelope = (1 + np.tanh((t - x[2]) / max(abs(x[3]), 1e-4))) / 2
        return np.asarray(mean * (1 + x[0] * envelope * np.cos(2 * np.pi * f * t + x[1])) - W)

    x = least_squares(rest, [eps, psi, onset, 0.02], x_scale=[eps, 0.1, 0.01, 0.01]).x
    return {"eps": float(x[0]), "psi": float(x[1]), "onset0": float(x[2]), "rise0": max(abs(float(x[3])), 1e-4)}


_MODULATIONS: WeakKeyDictionary[Load, dict[str, float]] = WeakKeyDictionary()  # it is asked for at every prediction


def stiffness_share(experiment: Experiment, run: Run) -> float:
    """Return a run's stiffness in N/um for each unit of the stated one: its first load where that is friction per um, else 1."""
    return run.first_load if experiment.per_load else 1.0


def predict(
    model: GeneratedModel,
    experiment: Experiment,
    run: Run,
    values: Mapping[str, float],
    *,
    by: Sequence[str] = (),
    rtol: float = MOTION_RTOL,
    trend: str | None = None,
    tables: Sequence[Spline] = (),
    by_tables: Sequence[int] = (),
) -> Prediction:
    """Return the observable of `run` at its sample times, with derivatives by the parameters `by`.

    Of a model with tables, J goes on with a column for each number of the tables in `by_tables`.
    It starts in steady sliding, or where `values` say (see `run_specific_names`). A trend is added to the observable:
    values["RUN.trend"] times displacement or time. Values are in um, s, N.
    """
    p = run_parameters(model, experiment, run, values)
    if tables:
        p = appended(p, tables)
    still = experiment.elsewhere(run)
    own = [k for k, n in enumerate(by) if n not in still and (n in model.names or n.startswith(f"{run.name}."))]
    moving = [k for k in own if not by[k].endswith(".trend")]
    names = [by[k] for k in moving]
    indices = [model.index(n) if n in model.names else -1 for n in names]
    coefficient_indices = [int(p[len(model.names) + 4 * i]) + j for i in by_tables for j in range(tables[i].coefficients.size)]
    share = np.array([stiffness_share(experiment, run) if n == "K" else 1.0 for n in names] + [1.0] * len(coefficient_indices))
    x0, S0 = start_state(model, run, p, values, names, coefficient_indices)
    size = np.array([max(float(np.max(np.abs(run.drive.velocities))), 1e-3) if s == "z" else 1.0 for s in model.states])
    motion = integrate(
        model, p[: len(model.names)], drive=run.drive, load=run.load, t=run.t, start=x0, by=indices, S0=S0, tables=tables,
        by_tables=by_tables, rtol=rtol, atol=rtol * size,
    )  # fmt: skip
    y, slopes = _observe(model, run, motion.x, motion.S, p, [*indices, *coefficient_indices])
    J = np.zeros((run.t.size, len(by) + len(coefficient_indices)))
    J[:, [*moving, *range(len(by), J.shape[1])]] = slopes * share
    if trend:
        y = y + values[f"{run.name}.trend"] * basis(run, trend)
        J[:, [k for k in own if k not in moving]] = basis(run, trend)[:, None]
    return Prediction(y, J, motion.x, motion.status, motion.reached)


def _observe(model: GeneratedModel, run: Run, x: Array, S: Array, p: Array, indices: Sequence[int]) -> tuple[Array, Array]:
    """Return the recorded quantity and its derivatives: elongation u, spring force K u, or friction K u/W."""
    V, (W, W_dot) = run.drive(run.t), run.load(run.t)
    K = p[model.index("K")]
    factor = np.broadcast_to(per_elongation(run.observable, K, W), W.shape)
    J = np.zeros((run.t.size, len(indices)))
    recorded = model.namespace.get("OBSERVED", "u")
    if recorded in model.states:
        i = model.states.index(recorded)
        u, J = x[:, i], S[:, i, :].copy()
    else:
        reading = model.namespace.get("reading") or model.elongation
        with np.errstate(all="ignore"):
            u = np.asarray(reading(x, V, W, W_dot, p))
            for j in range(x.shape[1] if indices else 0):
                J += derivative(lambda y: reading(y, V, W, W_dot, p), x, j)[:, None] * S[:, j, :]
            for k, i in enumerate(indices):
                if i >= 0:
                    J[:, k] += derivative(lambda q: reading(x.astype(complex), V, W, W_dot, q), p, i)
    if run.observable != "elongation" and model.index("K") in indices:
        J[:, list(indices).index(model.index("K"))] += u / K
    return factor * u, factor[:, None] * J
