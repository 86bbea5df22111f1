"""What a fit of critical loads knows: standard errors, correlations, and the combinations that the data leave open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srfcli.inference.threshold_scale import Scale
from srfcli.numerics.collocation import Array

AT_BOUND = 1e-6  # of the distance between the bounds, in the parameter's coordinate
BLIND = 1e-9  # eigenvalues of the information below this share of the largest are rounding
LOOSE = 1.0  # a standard error in ln(value) from which the data say nothing of the value
LEAST = 0.1  # a combination lists the parameters that carry at least this share


@dataclass(frozen=True)
class Uncertainty:
    """Linearised errors at a solution, from the given sigma.

    `errors` (k,) are standard errors in base units, infinite where nothing is known, NaN at a bound; `flags` say
    so in words, "" where all is well. `correlation` (k, k) has NaN rows there. `eigenvalues` (rising) and `combinations`
    (columns, over the coordinates) are those of the information matrix of the parameters that are not at a bound.
    """

    errors: Array
    flags: tuple[str, ...]
    correlation: Array
    eigenvalues: Array
    combinations: Array
    weakest: str


def uncertainty(scale: Scale, y: Array, jacobian: Array) -> Uncertainty:
    """Return the errors at coordinates `y` (k,) from d(residuals)/dy (n, k), the residuals in sigma."""
    low, high = scale.bounds
    near = AT_BOUND * (high - low)
    flags = [
        "at its lower bound" if a else "at its upper bound" if b else ""
        for a, b in zip(y - low < near, high - y < near, strict=True)
    ]
    inside = np.array([not f for f in flags])
    k = len(scale)
    errors, correlation = np.full(k, np.nan), np.full((k, k), np.nan)
    values, vectors = np.zeros(0), np.zeros((k, 0))
    if inside.any():
        part = jacobian[:, inside]
        _, singular, rows = np.linalg.svd(part, full_matrices=True)
        values = np.zeros(part.shape[1])
        values[: singular.size] = singular**2
        values, rows = values[::-1], rows[::-1]  # rising
        vectors = np.zeros((k, values.size))
        vectors[inside] = rows.T
        covariance = _covariance(values, rows.T)
        spread = np.sqrt(np.diag(covariance))
        with np.errstate(invalid="ignore"):
            correlation[np.ix_(inside, inside)] = covariance / np.outer(spread, spread)
        errors[inside] = spread
    for i, (q, error) in enumerate(zip(scale, errors, strict=True)):
        if np.isinf(error):
            flags[i] = "not identifiable: other parameters undo it exactly"
        elif error > LOOSE:
            flags[i] = "not identifiable: its error exceeds its value" if q.log else "hardly identifiable"
    return Uncertainty(
        errors * scale.rates(y), tuple(flags), correlation, values, vectors, _weakest(scale, values, vectors)
    )


def _covariance(values: Array, vectors: Array) -> Array:
    """Return the inverse of the information with these eigenvalues, infinite in what its null space holds."""
    blind = values <= BLIND * values.max(initial=0.0)
    kept = vectors[:, ~blind]
    covariance = (kept / values[~blind]) @ kept.T
    lost = (np.abs(vectors[:, blind]) > 1e-3).any(axis=1)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    return covariance


def _weakest(scale: Scale, values: Array, vectors: Array) -> str:
    """Return the least determined combination of parameters as a formula with its standard error, "" where all are at bounds."""
    if not values.size:
        return ""
    direction = vectors[:, 0] / vectors[np.argmax(np.abs(vectors[:, 0])), 0]
    terms: list[str] = []
    for q, weight in sorted(zip(scale, direction, strict=True), key=lambda t: -abs(t[1])):
        if abs(weight) >= LEAST:
            name = f"ln {q.name}" if q.log else f"{q.name}/{q.size:.3g}"
            sign = ("- " if weight < 0 else "+ ") if terms else ""
            size = "" if abs(abs(weight) - 1) < 5e-3 else f"{abs(weight):.2f} "
            terms.append(f"{sign}{size}{name}")
    if values[0] <= BLIND * values.max():
        return f"{' '.join(terms)}: not determined at all"
    length = np.linalg.norm(direction)  # the error is that of the formula as it is written
    return f"{' '.join(terms)}: standard error {length / np.sqrt(values[0]):.2g}"
