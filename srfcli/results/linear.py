"""Stability of steady sliding under constant load: critical loads from the characteristic polynomial."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from srfcli.results.base import Result
from srfcli.results.tables import Column, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.codegen.slider import SlidingSystem


@dataclass(frozen=True, repr=False, eq=False)
class LinearResult(Result):
    """Critical loads of steady sliding at every point of a grid.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    over : Mapping[str, tuple of float]
        The values of each parameter that was swept, in its declared unit.
    points : tuple of Mapping[str, Any]
        One mapping for each row of the table, from column to value.
    """

    system: SlidingSystem
    over: Mapping[str, tuple[float, ...]]
    points: tuple[Mapping[str, Any], ...] = field(repr=False)

    @cached_property
    def table(self) -> Table:
        """Return critical load, K/W0 and frequency with the closed forms beside them, a row for each point."""
        units = {q.name: q for q in self.system.model.parameters}
        names = [n for n in self.over if n not in ("V", "W0")]
        columns = (
            Column("V", "um/s", "driving velocity"),
            Column("K_over_W0", "1/um", "critical K/W0"),
            Column("W0", "N", "critical load: stability is lost above it"),
            Column("Omega_c", "rad/s", "frequency at the bifurcation"),
            *(Column(n, units[n].unit, units[n].about) for n in names),
            Column("Omega_reduced", "1", "D0 Omega_c / V"),
            Column("K_over_W0_rigid", "1/um", "the same for kappa to infinity (closed form)"),
            Column("K_over_W0_quasistatic", "1/um", "the same for kappa to infinity and M to 0 (closed form)"),
            Column("Omega_rigid", "rad/s", "Omega_c for kappa to infinity (closed form)"),
            Column("crossing_rate", "1/(N s)", "d Re(s)/dW0 at the root", ".4g"),
            Column("lyapunov", "1", "Re c/Omega of z' = i Omega z + c z |z|^2, delta ln v = 2 Re z", ".4g"),
            Column("criticality", "", "direct or inverted Hopf bifurcation"),
            Column("leading", "", "all other roots are stable"),
            Column("status", "", ""),
        )
        cells = [tuple(row.get(c.name) for c in columns) for row in self.points]
        kept = self.system.described(without=(*self.over, "W0", "eps", "f"))
        return Table("srf.linear/1", columns, cells, title=self.system.model.title, parameters=kept)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the critical K/W0 (1/um) over the first parameter that was swept, a curve for each value of the others."""
        from srfcli.results import plots

        (x, values), *others = self.over.items()
        unit = {q.name: q.unit for q in self.system.model.parameters}
        title = plots.titled(self.table.title, self.table.parameters)
        if x == "V" and not others:
            curve = {k: [row.get(k) for row in self.points] for k in ("V", "K_over_W0")}
            return plots.stability_diagram([], hopf=curve, title=title, ax=ax)
        groups: dict[str, list[Mapping[str, Any]]] = {}
        for row in self.points:
            name = ", ".join(plots.valued(n, row[n], unit[n]) for n, _ in others)
            groups.setdefault(name, []).append(row)
        return plots.lines(
            [row[x] for row in next(iter(groups.values()))],
            [[row.get("K_over_W0") for row in group] for group in groups.values()],
            list(groups),
            plots.axis_label(x, unit[x]),
            "critical K/W$_0$  [1/µm]",
            logx=spread(values),
            title=title,
            ax=ax,
        )


def spread(values: tuple[float, ...]) -> bool:
    """Return whether rising values are spaced logarithmically: by one ratio, or over a decade where they are two."""
    if len(values) < 3:
        return len(values) == 2 and 0 < 10 * values[0] <= values[1]
    if values[0] <= 0:
        return False
    ratio = (values[-1] / values[0]) ** (1 / (len(values) - 1))
    return all(abs(b / a / ratio - 1) < 1e-6 for a, b in itertools.pairwise(values))
