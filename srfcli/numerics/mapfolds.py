"""Folds of the forced state, which a map shows only by what is missing: where a stable state ends, no neighbour tells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array, Discretisation
from srfcli.numerics.continuation import CurvePoint, correct
from srfcli.numerics.map import Brink
from srfcli.numerics.orbit import scales, solve_orbits
from srfcli.numerics.plane import Plane
from srfcli.numerics.polish import bifurcation_kind

FINEST = 2.0**-12  # of the way to the neighbour: where the halving of steps ends
NEAR = 0.5  # in logarithms, or V, or um: a larger step of the state is not taken for the same state
MEETS = 0.8  # of the leading multiplier, from where the fold itself is solved for
STEPS = (3, 8)  # of equal length, in which most states reach their neighbour; those that do not in the first try the next
REACH = 0.01  # of the window: a fold farther from where the state was last found is another


def not_led_on(model: GeneratedModel, plane: Plane, brinks: Sequence[Brink], steps: Sequence[int] = STEPS) -> list[Brink]:
    """Return the brinks whose stable state is not met at their neighbour after a few equal steps; in batches, for `leads_on`.

    Each step starts from the state before with the change of steady sliding, and the change of what remained over the last step.
    """
    left: list[Brink] = []
    by_mesh: dict[int, list[Brink]] = {}
    for brink in brinks:
        by_mesh.setdefault(len(brink.orbit.edges), []).append(brink)
    for group in by_mesh.values():
        edges, ends = group[0].orbit.edges, np.stack([b.ends for b in group])
        x, stages = np.stack([b.orbit.x for b in group]), np.stack([b.orbit.stages for b in group])
        before = _points(model, plane, ends[:, 0])
        going, dx, dstages = np.ones(len(group), bool), np.zeros_like(x), np.zeros_like(stages)
        for share in np.arange(1, steps[0] + 1) / steps[0]:
            p = _points(model, plane, ends[:, 0] + share * (ends[:, 1] - ends[:, 0]))
            shift = (model.steady(p) - model.steady(before))[:, None, :]
            guess = Discretisation(x + shift + dx, stages + shift[:, None] + dstages, edges)
            found = solve_orbits(model, p, guess, tol=1e-7, max_iterations=10)
            off = (np.abs(found.orbit.x - guess.x) / scales(model, p)[:, None, :]).max(axis=(-1, -2))
            with np.errstate(invalid="ignore"):
                going &= found.converged & (off < NEAR) & (np.abs(found.multipliers[:, 0]) < 1)
            dx, dstages = found.orbit.x - x - shift, found.orbit.stages - stages - shift[:, None]
            x, stages, before = found.orbit.x, found.orbit.stages, p
        left += [brink for brink, led in zip(group, going, strict=True) if not led]
    return not_led_on(model, plane, left, steps[1:]) if left and steps[1:] else left


def _points(model: GeneratedModel, plane: Plane, q: Array) -> Array:
    """Return the parameters (n_parameters, B) at unit coordinates q (B, 2)."""
    return np.stack([plane.point(model, row) for row in q], axis=1)


def leads_on(model: GeneratedModel, plane: Plane, brink: Brink) -> Brink | None:
    """Return the brink where the stable state, followed towards the neighbour, ends; None where it is stable at the neighbour.

    The steps are halved where Newton's method fails, or finds another state or an unstable one.
    """
    here, way = brink.ends[0], brink.ends[1] - brink.ends[0]
    share, step, orbit, rho = 0.0, 0.5, brink.orbit, brink.rho
    while step > FINEST:
        ahead = min(share + step, 1.0)
        p = plane.point(model, here + ahead * way)[:, None]
        guess = Discretisation(orbit.x[None], orbit.stages[None], orbit.edges)
        found = solve_orbits(model, p, guess, max_iterations=10)
        moved = float((np.abs(found.orbit.x[0] - orbit.x) / scales(model, p[:, 0])).max())
        leading = complex(found.multipliers[0, 0])
        if not found.converged[0] or moved > NEAR or not abs(leading) < 1:
            step /= 2
            continue
        share, rho = ahead, leading
        orbit = Discretisation(found.orbit.x[0], found.orbit.stages[0], orbit.edges)
        if share == 1.0:
            return None
    return Brink(np.array([here + share * way, brink.ends[1]]), brink.axis, rho, orbit)


def fold_at(model: GeneratedModel, plane: Plane, end: Brink) -> CurvePoint | None:
    """Return the fold at which a stable state ends, ready to be followed; None where its leading multiplier is not near +1."""
    if end.rho.real < MEETS or bifurcation_kind(end.rho) != "fold":
        return None
    here, across, normal = end.ends[0], np.zeros(end.orbit.x.shape[-1]), np.eye(2)[1 - end.axis]
    start = correct(model, plane, here, end.orbit, end.rho, normal, across, max_iterations=20)
    if start is None or bifurcation_kind(start.rho) != "fold" or not start.others < 1:
        return None
    return start if np.abs(start.q - here).max() < REACH else None
