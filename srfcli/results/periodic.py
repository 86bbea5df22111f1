"""One forced periodic state: its Floquet multipliers, mean friction and harmonics."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from srfcli.results.base import Result, own_figure
from srfcli.results.tables import Column, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srfcli.codegen.slider import SlidingSystem
    from srfcli.numerics.floquet import FloquetResult


@dataclass(frozen=True, repr=False, eq=False)
class PeriodicResult(Result):
    """The forced periodic state at one point.

    Attributes
    ----------
    system : SlidingSystem
        Laws and parameters.
    state : FloquetResult
        The orbit on its mesh, the multipliers (complex, n), mean friction and harmonics.
    """

    system: SlidingSystem
    state: FloquetResult = field(repr=False)

    @property
    def stable(self) -> bool:
        """Return whether all multipliers lie inside the unit circle."""
        return bool(self.state.stable)

    @cached_property
    def table(self) -> Table:
        """Return a row for each multiplier, largest modulus first; `meta` has friction and harmonics."""
        import numpy as np

        r, model, parameters = self.state, self.system.model, self.system.described()
        f = float(r.p[model.index("f")])
        columns = (
            Column("multiplier", "1", "number, largest modulus first"),
            Column("re", "1", "real part", ".9g"),
            Column("im", "1", "imaginary part", ".9g"),
            Column("modulus", "1", "", ".9g"),
            Column("theta", "rad", "angle over one forcing period", ".9g"),
            Column("growth_rate", "1/s", "ln|multiplier| times the forcing frequency"),
            Column("error", "1", "estimated error of the multipliers", ".2g"),
        )
        rows = []
        for i, m in enumerate(r.multipliers):
            modulus = abs(m)
            growth = float(np.log(modulus) * f) if modulus > 0 else None
            rows.append((i + 1, m.real, m.imag, modulus, float(np.angle(m)), growth, r.error))
        intervals = len(r.orbit.edges) - 1
        if not r.found:
            notes: tuple[str, ...] = (f"no forced periodic state was found, on up to {intervals} intervals",)
            meta: dict[str, Any] = {"stable": None, "intervals": intervals}
            return Table("srf.floquet/1", columns, rows, model.title, notes, parameters, meta, r.status.value)
        meta = {
            "stable": r.stable,
            "mean_friction": r.mean_friction,
            "friction_shift": r.friction_shift,
            "u_harmonics": [
                {"k": k, "amplitude_um": abs(c), "phase": float(np.angle(c))} for k, c in enumerate(r.u_harmonics)
            ],
            "mu_harmonics": [
                {"k": k, "amplitude": abs(c), "phase": float(np.angle(c))} for k, c in enumerate(r.mu_harmonics)
            ],
            "intervals": intervals,
            "liouville": r.liouville,
        }
        notes = (
            f"{'stable' if r.stable else 'unstable'}; error of the multipliers {r.error:.1g} on {intervals} intervals, "
            f"product of the multipliers against exp(integrated trace) {_checked(r.liouville)}",
            f"mean friction {r.mean_friction:.8f}, shift from eps = 0 {r.friction_shift:+.8f}",
            "harmonics of u [um]: " + ", ".join(f"{k}: {abs(c):.4g}" for k, c in enumerate(r.u_harmonics)),
            "harmonics of mu: " + ", ".join(f"{k}: {abs(c):.4g}" for k, c in enumerate(r.mu_harmonics)),
        )
        return Table("srf.floquet/1", columns, rows, model.title, notes, parameters, meta, r.status.value)

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return one period of elongation, slip velocity, ages, friction and load, a panel for each."""
        import numpy as np

        from srfcli.numerics.floquet import waveforms
        from srfcli.results import plots

        own_figure(ax, "a periodic state")
        r, model = self.state, self.system.model
        waves = waveforms(model, r.p, r.orbit, 400)
        # the period closes: its end is its beginning
        tau, closed = np.append(waves.tau, 1.0), lambda values: np.append(values, values[0])
        column = {name: closed(waves.x[:, i]) for i, name in enumerate(model.states)}
        ages = {n[3:]: np.exp(values) for n, values in column.items() if n.startswith("ln_") and n != "ln_v"}
        verdict = ("stable" if r.stable else "unstable") if r.found else "not converged"
        title = plots.titled(f"{model.title}, {verdict}", self.table.parameters)
        return plots.orbit(
            tau, u=closed(waves.u), v=np.exp(column["ln_v"]), states=ages, mu=closed(waves.mu), W=closed(waves.W),
            title=title,
        )  # fmt: skip


def _checked(mismatch: float) -> str:
    return f"{mismatch:.1g}" if mismatch == mismatch else "not compared: the fastest multiplier is far below rounding"
