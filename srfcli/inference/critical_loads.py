"""What an experiment's tables of critical loads say of its parameters: log density, score and information, exact.

Each load is Gaussian about the nearest odd crossing of its line, with the error that the table has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.settings import Parameter
from srfcli.data.values import CriticalLoads, Experiment
from srfcli.inference.free_parameters import FreeParameter, Scale
from srfcli.inference.thresholds import Match, Matcher

MIN_P_VALUE = 1e-3  # chance of a chi2 of critical loads below which the model is said not to describe them


@dataclass(frozen=True)
class Matched:
    """A table beside a model's critical loads, and what it says of the parameters `names`.

    `slopes` (n, k) are the derivatives of `white` by them.
    """

    loads: CriticalLoads
    match: Match = field(repr=False)
    names: tuple[str, ...]
    slopes: Array = field(repr=False)

    @property
    def white(self) -> Array:
        """Return measured less computed loads over their errors (n,): of mean 0 and variance 1 under the right model."""
        return -self.match.residuals

    @property
    def log_density(self) -> Array:
        """Return the log density (n,) of each load."""
        return np.asarray(-0.5 * self.white**2 - np.log(np.sqrt(2 * np.pi) * self.loads.table.sigma))

    @property
    def log_likelihood(self) -> float:
        """Return the log density of all loads together."""
        return float(np.sum(self.log_density))

    @property
    def score(self) -> Array:
        """Return the gradient of the log likelihood (k,)."""
        return np.asarray(-self.slopes.T @ self.white)

    @property
    def information(self) -> Array:
        """Return Fisher's information (k, k)."""
        return np.asarray(self.slopes.T @ self.slopes)


class TableLikelihood:
    """One table under one model at one set of parameters after another; derivatives are by the parameters in `bounds`.

    `bounds` holds name -> (start, lower, upper) in um, s, N, of those that the model has; the others stay as they are `given`.
    """

    def __init__(
        self,
        model: GeneratedModel,
        loads: CriticalLoads,
        given: Mapping[str, float],
        bounds: Mapping[str, tuple[float, float, float]],
    ) -> None:
        self.loads = loads
        self.scale = Scale(tuple(FreeParameter(Parameter(n, row[0]), *row) for n, row in bounds.items() if n in model.names))
        self.matcher = Matcher(model, loads.table, values=given, scale=self.scale)

    def at(self, values: Mapping[str, float], *, slopes: bool = True, anew: bool = False) -> Matched:
        """Return the table matched at parameters by name; `anew` searches every line in full."""
        y = np.array([q.coordinate(values[q.name]) for q in self.scale])
        match = self.matcher.match(y, anew=anew)
        by_value = np.zeros((len(self.loads.table), len(self.scale)))
        if slopes and len(self.scale):
            by_value = -self.matcher.jacobian(match) / self.scale.rates(y)
        return Matched(self.loads, match, self.scale.names, np.where(np.isfinite(by_value), by_value, 0.0))


def apparatus(experiment: Experiment, frequency: float) -> dict[str, float]:
    """Return the values that an experiment gives a model of its critical loads, in um, s, N."""
    given = {"f": frequency, "K": experiment.stiffness}
    if experiment.mass is not None:
        given["M"] = experiment.mass
    return given | {q.name: q.value for q in experiment.parameters}


def joined_slopes(matched: Matched, names: Sequence[str], varying: Mapping[str, Sequence[str]]) -> Array:
    """Return the derivatives (n, k) by `names`; a parameter that varies between runs is the mean of its `varying` names."""
    out = np.zeros((len(matched.white), len(names)))
    for j, name in enumerate(matched.names):
        parts = varying.get(name, [name])
        for part in parts:
            out[:, names.index(part)] = matched.slopes[:, j] / len(parts)
    return out


def chi2_p_value(cost: float, freedom: float) -> float:
    """Return how likely a chi2 is to be as large by chance, 1 without degrees of freedom."""
    from scipy.special import chdtrc

    return float(chdtrc(freedom, cost)) if freedom > 0 else 1.0
