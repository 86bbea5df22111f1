"""Critical loads under modulation: points at given velocities, and the boundary as curves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import Status
from srfcli.results.base import Result
from srfcli.results.tables import Column, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.codegen.model import GeneratedModel
    from srfcli.codegen.slider import SlidingSystem
    from srfcli.numerics.boundary import BoundaryPoint
    from srfcli.numerics.continuation import Atlas

COLUMNS = (
    Column("eps", "1", "modulation amplitude"),
    Column("component", "1", "number of the connected curve, none where points are found one by one"),
    Column("crossing", "1", "number among the crossings at this V, from low W0; odd: stability is lost as W0 rises"),
    Column("type", "", "ns, pd or fold: a multiplier off the real axis, at -1, at +1"),
    Column("V", "um/s", "driving velocity"),
    Column("K_over_W0", "1/um", "critical K/W0", ".10g"),
    Column("W0", "N", "critical load", ".10g"),
    Column("theta", "rad", "angle of the critical multiplier over one forcing period"),
    Column("status", "", ""),
    Column("W0_low", "N", "bracket of W0, from the estimated error", ".10g"),
    Column("W0_high", "N", "bracket of W0, from the estimated error", ".10g"),
    Column("error", "1", "estimated relative error", ".2g"),
    Column("residual", "1", "what Newton's method left of the correction, relative", ".2g"),
    Column("slope", "1", "d ln|multiplier| / d ln W0 at fixed V", ".4g"),
    Column("others", "1", "largest modulus among the other multipliers", ".3g"),
    Column("intervals", "1", "of the mesh"),
)


def boundary_row(
    model: GeneratedModel,
    point: BoundaryPoint,
    component: int | None,
    crossing: int | None,
    extra: tuple[str, ...] = (),
) -> tuple[Any, ...]:
    """Return one boundary point under COLUMNS, then the parameters `extra` in their declared units."""
    value = {n: point.value(model, n) for n in ("eps", "V", "K", "W0")}
    width = point.error * value["W0"]
    return (
        value["eps"],
        component,
        crossing,
        point.kind,
        value["V"],
        value["K"] / value["W0"],
        value["W0"],
        point.theta,
        point.status.value,
        value["W0"] - width,
        value["W0"] + width,
        point.error,
        point.residual,
        point.slope,
        point.others,
        point.orbit.x.shape[-2],
        *(model.declared(n, point.value(model, n)) for n in extra),
    )


def worst(statuses: Iterable[Status]) -> Status:
    """Return the first status whose numbers cannot be used as they stand, else OK."""
    return next((s for s in statuses if not s.ok), Status.OK)


@dataclass(frozen=True, repr=False, eq=False)
class CriticalResult(Result):
    """Every critical load at some velocities and amplitudes, numbered from low W0.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    points : tuple of BoundaryPoint
        The polished crossings, each with its bracket, error and status.
    crossings : tuple of int
        The number of each at its velocity; stability is lost at odd ones as W0 rises, regained at even ones.
    said : tuple of str
        Where was looked, and what was not found.
    worst : Status
        The worst status of lines and points.
    """

    system: SlidingSystem
    points: tuple[BoundaryPoint, ...] = field(repr=False)
    crossings: tuple[int, ...] = field(repr=False)
    said: tuple[str, ...] = field(repr=False)
    worst: Status = Status.OK

    @cached_property
    def table(self) -> Table:
        """Return a row for each critical load, with its bracket and error."""
        model = self.system.model
        rows = [boundary_row(model, q, None, k) for q, k in zip(self.points, self.crossings, strict=True)]
        described = self.system.described(without=("W0", "V", "eps"))
        return Table("srf.critical/1", COLUMNS, rows, model.title, self.said, described, status=self.worst.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the critical K/W0 (1/um) against V (um/s), a mark for each crossing."""
        from srfcli.results import plots

        names = [c.name for c in COLUMNS]
        points = [dict(zip(names, row, strict=True)) for row in self.table.rows]
        return plots.critical_points(points, title=plots.titled(self.table.title, self.table.parameters), ax=ax)


@dataclass(frozen=True, repr=False, eq=False)
class BoundaryResult(Result):
    """The stability boundary in a plane of two parameters: all components in a window, a set for each amplitude.

    Attributes
    ----------
    system : SlidingSystem
        The laws and the parameters that were not swept.
    atlases : tuple of Atlas
        The components in the plane of each amplitude: polished points, how each curve ends, notes and status.
    worst : Status
        The worst status, INTERRUPTED where the search was stopped.
    """

    system: SlidingSystem
    atlases: tuple[Atlas, ...] = field(repr=False)
    worst: Status = Status.OK

    @property
    def _axes(self) -> tuple[str, str]:
        plane = self.atlases[0].plane if self.atlases else None
        return (plane.x.name, plane.y.name) if plane else ("V", "W0")

    @cached_property
    def table(self) -> Table:
        """Return a row for each point, component after component."""
        from srfcli.numerics.continuation import crossing_numbers

        model, rows, notes = self.system.model, [], []
        extra = tuple(n for n in self._axes if n not in ("V", "W0", "eps"))
        for atlas in self.atlases:
            numbers = crossing_numbers(model, atlas)
            for component, (branch, crossings) in enumerate(zip(atlas.branches, numbers, strict=True), 1):
                pairs = zip(branch.points, crossings, strict=True)
                rows += [boundary_row(model, q, component, k, extra) for q, k in pairs]
            named = "" if "eps" in self._axes else f"eps = {atlas.plane.base[model.index('eps')]:g}: "
            count = len(atlas.branches)
            ends = "; ".join(f"{i}: {b.start.value}, {b.end.value}" for i, b in enumerate(atlas.branches, 1))
            notes.append(f"{named}{count} component{'' if count == 1 else 's'}" + (f" (ends {ends})" if count else ""))
            notes += [named + note for note in atlas.notes]
        units = {q.name: q for q in model.parameters}
        columns = (*COLUMNS, *(Column(n, units[n].unit, units[n].about) for n in extra))
        described = self.system.described(without=(*self._axes, "eps"))
        return Table("srf.continue/1", columns, rows, model.title, tuple(notes), described, status=self.worst.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the boundary in its plane; against V and K/W0 with that under constant load, and stable sliding shaded."""
        import numpy as np

        from srfcli.numerics.hopf import critical_point
        from srfcli.results import plots

        model, title = self.system.model, plots.titled(self.table.title, self.table.parameters)
        if not self.atlases:
            return plots.stability_diagram([], title=title, ax=ax)
        plane, usual = self.atlases[0].plane, self._axes == ("V", "W0")
        branches = [
            {
                "eps": float(atlas.plane.base[model.index("eps")]),
                "V": [model.declared(plane.x.name, q.value(model, plane.x.name)) for q in branch.points],
                "K_over_W0": [
                    q.value(model, "K") / q.value(model, "W0")
                    if usual
                    else model.declared(plane.y.name, q.value(model, plane.y.name))
                    for q in branch.points
                ],
                "label": "boundary" if "eps" in self._axes else None,
            }
            for atlas in self.atlases
            for branch in atlas.branches
        ]
        if not usual:
            unit = {q.name: q.unit for q in model.parameters}
            xlabel, ylabel = (plots.axis_label(a, unit[a]) for a in self._axes)
            return plots.boundaries(
                branches, xlabel=xlabel, ylabel=ylabel, logx=plane.x.log, logy=plane.y.log, title=title, ax=ax
            )
        velocities = np.geomspace(plane.x.lo, plane.x.hi, 80)
        hopf = []
        for velocity in velocities:
            p = plane.base.copy()
            p[model.index("V")] = velocity
            point = critical_point(model, p)[0]
            hopf.append(None if point is None else float(p[model.index("K")]) / point.W0)
        return plots.stability_diagram(branches, hopf={"V": velocities, "K_over_W0": hopf}, title=title, ax=ax)
