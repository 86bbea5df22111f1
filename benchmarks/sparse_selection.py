"""Which columns sparse regression keeps, for `sparse_regression.py`: STLSQ and FROLS of PySINDy, cross-validation, bagging.

The rows are friction left over in all runs over its error, the columns what each effect would explain of it (sparse_signals.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import BSpline
from sparse_signals import Array, Baseline, Signals, Sizes, columns

from srfcli.codegen.splines import Spline

RIDGE, MODELS, KEPT = (0.05, 12, 0.6)  # of STLSQ (PySINDy's own); bagged fits, and the share of them that a column survives
THRESHOLDS = np.geomspace(0.03, 3.0, 15)  # of a column's rms contribution, in standard errors of a sample
FORWARD = 5  # columns that FROLS adds at most
SES = 2.0  # standard errors within which a smaller set does as well
BLOCK, CLIP = 0.25, 25.0  # s of a block of the held-out loss; a sample's largest square
EVERY = 0.003  # s between the rows that are regressed
ROUNDS, STEPS = 3, 4  # selections at refined sizes, and steps of a refinement
KNOTS = 3.0  # um between knots of a track
SCANS = {
    "track-topography": ("wavelength", np.geomspace(5.0, 45.0, 20)),
    "drive-ripple": ("pitch", np.geomspace(3.5, 28.0, 16)),
    "friction-drift": ("onset", np.array([0.0, 0.5, 1.0, 1.5])),
    "friction-drift-slip": ("onset", np.array([0.0, 5.0, 10.0, 15.0])),
    "second-state": ("D2", np.array([2.0, 3.5, 6.0, 11.0])),
}
PHASED = ("track-topography", "drive-ripple", "load-distortion")
LIMITS = {"lambda": (0.0, 3.0), "stiffness-error": (-0.6, 0.6), "load-transmission": (-1.0, 0.5), "slip-evolution": (-0.2, 1.0),
          "sensor-lag": (-0.01, 0.05), "inertia": (0.0, 2e-5), "interface-compliance": (0.0, 3.0),
          "stiffness-exponent": (-1.5, 1.5), "age-saturation": (0.0, 0.05), "adhesion-offset": (-1.0, 2.0)}  # fmt: skip


def reported(column: str) -> str:
    """Return the effect that a column stands for."""
    name = column.split(".")[0]
    return "friction-drift" if name == "friction-drift-slip" else name


@dataclass(frozen=True)
class Reading:
    """A case: its runs smoothed, the baseline and its parameters, and by how much each run's errors exceed what noise gives."""

    runs: tuple[Signals, ...]
    base: Baseline
    start: dict[str, float]
    bounds: dict[str, tuple[float, float]]
    inflation: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Rows:
    """Rows of the regression in units of their error: y (n,), columns (n, k) of `names`; held-out ones, and blocks of BLOCK s."""

    y: Array
    X: Array
    names: tuple[str, ...]
    held: Array
    block: Array
    slip: Array
    error: Array


def rows(reading: Reading, p: Sizes, names: Sequence[str], *, residual: bool = True) -> Rows:
    """Return the rows of all runs at the parameters and sizes `p`."""
    parts = []
    for number, s in enumerate(reading.runs):
        found, X = columns(s, reading.base, p, names, residual=residual)
        error = found.error * reading.inflation.get(s.name, np.ones(s.t.size))
        every = max(round(EVERY / float(np.median(np.diff(s.t)))), 1)
        keep = np.flatnonzero(found.usable)[::every]
        finite = keep[np.isfinite(found.r[keep]) & np.isfinite(X[keep]).all(axis=1)]
        scale = 1 / error[finite]
        block = 1000 * number + (s.t[finite] / BLOCK).astype(int)
        parts.append((found.r[finite] * scale, X[finite] * scale[:, None], np.full(finite.size, s.holdout), block,
                      found.slip[finite], 1 / scale))  # fmt: skip
    y, X, held, block, slip, error = (np.concatenate(c) for c in zip(*parts, strict=True))
    return Rows(y, X, tuple(names), held, block, slip, error)


def track_columns(found: Rows) -> Array:
    """Return (n, m) a spline over slip that all runs share, whitened as the rows are."""
    spline = Spline.over(float(found.slip.min()), float(found.slip.max()), KNOTS)
    knots = spline.first + spline.spacing * (np.arange(spline.coefficients.size + 4) - 3)
    T = BSpline.design_matrix(found.slip, knots, 3).toarray() / found.error[:, None]
    T = T[:, np.abs(T[~found.held]).sum(axis=0) > 0]
    return T - 0.0


def solved(J: Array, y: Array, fit: Array) -> Array:
    """Return least-squares coefficients over the rows `fit`, columns scaled alike and with a trace of ridge."""
    scale = np.maximum(np.sqrt(np.sum(J[fit] ** 2, axis=0)), 1e-300)
    A = J[fit] / scale
    G = A.T @ A
    return np.asarray(np.linalg.solve(G + 1e-8 * np.eye(G.shape[0]), A.T @ y[fit]) / scale)


def names_of(reading: Reading, loads: bool) -> list[str]:
    """Return the columns without an inner unknown, those that the baseline can have."""
    base = reading.base
    names = ["viscous-drag", "slip-evolution", "sensor-lag", "stiffness-error"]
    names += ["stiffness-exponent"] if base.elastic else ["interface-compliance"]
    names += ["log-log-coupling"] if base.cut else ["age-saturation"]
    names += [] if base.mass else ["inertia"]
    if loads:
        names += ["linker-dieterich", "adhesion-offset", "tangential-crosstalk", "load-transmission"]
        names += ["load-distortion.cos", "load-distortion.sin"]
    return names


def scanned(reading: Reading, p: Sizes, track: bool) -> tuple[dict[str, float], list[str]]:
    """Return the inner unknowns at which each scanned effect explains most in the fitted runs, and its columns."""
    inner, names = {}, []
    plain = rows(reading, p, reading.base.free)
    fit, J = ~plain.held, np.column_stack([plain.X, track_columns(plain)]) if track else plain.X
    y = plain.y - J @ solved(J, plain.y, fit)
    for effect, (unknown, values) in SCANS.items():
        best = -1.0
        own = [f"{effect}.cos", f"{effect}.sin"] if effect in PHASED else [effect]
        for value in values.tolist():
            X = rows(reading, {**p, f"{effect}.{unknown}": value}, own, residual=False).X
            X = np.column_stack([c - J @ solved(J, c, fit) for c in X.T])
            gain = float((X[fit] @ solved(X, y, fit)) @ y[fit])
            if gain > best:
                best, inner[f"{effect}.{unknown}"] = gain, value
        names += own
    return inner, names


@dataclass(frozen=True)
class Chosen:
    """Effects, sizes found with the baseline's parameters, inclusion by effect, mean squares of the remainder's blocks."""

    effects: tuple[str, ...]
    sizes: dict[str, float]
    inclusion: dict[str, float]
    blocks: Array


def choose(reading: Reading, *, track: bool) -> Chosen:
    """Return the set of effects that sparse regression keeps; `track` frees a spline over slip beside the parameters."""
    free = list(reading.base.free)
    p = refine(reading, dict(reading.start), [], track)
    loads = any(np.ptp(s.W) > 0.02 * s.begin for s in reading.runs)
    inner, more = scanned(reading, p, track)
    names = [*names_of(reading, loads), *more]
    p, kept, inclusion = {**p, **inner}, None, {}
    for _ in range(ROUNDS):
        found = rows(reading, p, [*free, *names])
        k = len(free)
        y = found.y + found.X[:, k:] @ np.array([p.get(n, 0.0) for n in names])
        own, shares = selected(replace(found, y=y), k, names, track)
        if kept is not None and set(own) == set(kept):
            break
        kept, inclusion = own, shares
        p = refine(reading, {n: v for n, v in p.items() if n not in names or n in own}, own, track)
        if not own:
            break
    effects = tuple(sorted({reported(n) for n in kept or ()}))
    return Chosen(effects, p, inclusion, remainder(reading, p, [*free, *(kept or ())], track))


def selected(found: Rows, k: int, names: list[str], track: bool) -> tuple[list[str], dict[str, float]]:
    """Return the columns that survive, both of an effect with a phase, and the share of bagged fits that hold each effect."""
    fit, J = ~found.held, found.X[:, :k]
    if track:
        J = np.column_stack([J, track_columns(found)])
    left = [c - J @ solved(J, c, fit) for c in (found.y, *found.X[:, k:].T)]
    y, X = left[0], np.column_stack(left[1:])
    X = X / np.maximum(np.sqrt(np.mean(X[fit] ** 2, axis=0)), 1e-300)
    X = np.where(np.isfinite(X), X, 0.0)
    sets = proposals(X[fit], y[fit], names)
    losses = {own: validated(found, J, k, own) for own in sets}
    best = min(losses, key=lambda own: float(losses[own].mean()))

    def alike(own: frozenset[int]) -> bool:
        worse = losses[own] - losses[best]
        return float(worse.mean()) <= SES * float(worse.std() / np.sqrt(max(worse.size, 1)))

    effects = {own: len({reported(names[i]) for i in own}) for own in sets}
    final = min((own for own in sets if alike(own)), key=lambda own: (effects[own], float(losses[own].mean())))
    if not final:
        return [], {}
    shares = bagged(X[fit], y[fit], names, sets[final])
    stays = {e for e, share in shares.items() if share >= KEPT} & {reported(names[i]) for i in final}
    own = [n for i, n in enumerate(names) if reported(n) in stays and (n in {names[j] for j in final})]
    return [n for n in names if n in own or any(n.split(".")[0] == o.split(".")[0] for o in own)], shares


def validated(found: Rows, J: Array, k: int, own: frozenset[int]) -> Array:
    """Return the mean square of each block where its run has no part in the fit: one run after another is left out."""
    A = np.column_stack([J, found.X[:, [k + i for i in sorted(own)]]])
    run, z = found.block // 1000, np.zeros(found.y.size)
    for out in np.unique(run):
        z[run == out] = found.y[run == out] - A[run == out] @ solved(A, found.y, run != out)
    return blocks(z, np.unique(found.block, return_inverse=True)[1])


def blocks(z: Array, number: Array) -> Array:
    """Return the mean square of each block, single samples cut at CLIP."""
    squares = np.minimum(z**2, CLIP)
    return np.asarray(np.bincount(number, squares) / np.maximum(np.bincount(number), 1))


def proposals(X: Array, y: Array, names: list[str]) -> dict[frozenset[int], object]:
    """Return the sets of columns that STLSQ and FROLS propose, with the optimizer of each; the empty set among them."""
    import pysindy

    sets: dict[frozenset[int], object] = {frozenset(): None}
    for threshold in THRESHOLDS.tolist():
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=RIDGE)
        optimizer.fit(X, y[:, None])
        sets.setdefault(whole(np.flatnonzero(optimizer.coef_), names), pysindy.STLSQ(threshold=threshold, alpha=RIDGE))
    forward = pysindy.FROLS(max_iter=FORWARD, alpha=RIDGE)
    forward.fit(X, y[:, None])
    for count, coefficients in enumerate(np.array(forward.history_).reshape(-1, X.shape[1])):
        own = whole(np.flatnonzero(coefficients), names)
        if own:
            sets.setdefault(own, pysindy.FROLS(max_iter=max(count, 1), alpha=RIDGE))
    return sets


def whole(found: Array, names: list[str]) -> frozenset[int]:
    """Return columns with their partners: an effect with a phase has two."""
    stems = {names[i].split(".")[0] for i in found.tolist()}
    return frozenset(i for i, n in enumerate(names) if n.split(".")[0] in stems)


def bagged(X: Array, y: Array, names: list[str], optimizer: object) -> dict[str, float]:
    """Return the share of bagged fits in which a column of each effect survives."""
    import pysindy

    np.random.seed(7)  # PySINDy draws from NumPy's global generator
    few = np.arange(0, y.size, 3)
    ensemble = pysindy.EnsembleOptimizer(optimizer, bagging=True, n_models=MODELS)
    ensemble.fit(X[few], y[few, None])
    there = np.array(ensemble.coef_list).reshape(MODELS, -1) != 0
    effects = sorted({reported(n) for n in names})
    return {e: float(there[:, [reported(n) == e for n in names]].any(axis=1).mean()) for e in effects}


def refine(reading: Reading, p: dict[str, float], own: Sequence[str], track: bool) -> dict[str, float]:
    """Return parameters and sizes after some Gauss-Newton steps on what friction leaves over in the fitted runs."""
    names = [*reading.base.free, *own]
    p = {**p, **{n: p.get(n, 0.0) for n in own}}
    now, step = stepped(reading, p, names, track)
    for _ in range(STEPS):
        for share in (1.0, 0.4, 0.1):
            moved = {n: limited(reading, n, p[n] + share * d) for n, d in step.items()}
            then, following = stepped(reading, {**p, **moved}, names, track)
            if then < now:
                break
        else:
            break
        gained, p, now, step = now - then, {**p, **moved}, then, following
        if gained < 1e-3 * now:
            break
    return p


def stepped(reading: Reading, p: Sizes, names: Sequence[str], track: bool) -> tuple[float, dict[str, float]]:
    """Return the mean square that is left in the fitted runs, and the Gauss-Newton step."""
    found = rows(reading, p, names)
    fit, J = ~found.held, np.column_stack([found.X, track_columns(found)]) if track else found.X
    step, y = solved(J, found.y, fit), found.y
    if track:
        y = y - J[:, len(names) :] @ step[len(names) :]
    return float(np.mean(np.minimum(y[fit] ** 2, CLIP))), dict(zip(names, step.tolist(), strict=False))


def limited(reading: Reading, name: str, value: float) -> float:
    """Return a parameter within its bounds, a size within what is physical."""
    low, high = reading.bounds.get(name) or LIMITS.get(name, (-np.inf, np.inf))
    return float(np.clip(value, low, high))


def remainder(reading: Reading, p: Sizes, names: Sequence[str], track: bool) -> Array:
    """Return the mean squares of all blocks, what is linear near `p` fitted to the other runs."""
    found = rows(reading, p, names)
    J = np.column_stack([found.X, track_columns(found)]) if track else found.X
    return validated(found, J, 0, frozenset())
