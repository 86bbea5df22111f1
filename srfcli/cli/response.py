"""`srf response`: how friction, position and slip velocity follow a modulated load, to first order and in the mean."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import SrfCommand
from srfcli.cli.options import (
    AMPLITUDE,
    OutputOptions,
    Range,
    SystemOptions,
    check_axes,
    output_options,
    over_option,
    stability_options,
    value_option,
    values_option,
)
from srfcli.core.errors import SrfError, Status, worst
from srfcli.results.plots import axis_label, titled
from srfcli.results.tables import STATUS, Column, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srfcli.codegen.model import GeneratedModel
    from srfcli.core.settings import Resolved

EXAMPLES = """
srf response --V 10 --W0 6 --over f=1:1000:200 --plot response.svg
srf response --V 10 --W0 6 --over f=1:1000:200 --csv
srf response --V 10 --W0 6 --mean --eps 0.05,0.1,0.2 --over f=20:400:30
"""
QUANTITIES = {  # whose response is found: unit of the gain, and what it is of
    "friction": ("1", "of the friction coefficient"),
    "force": ("1", "of the friction force over W0"),
    "position": ("um", "of the slider's position"),
    "velocity": ("1", "of the interface's slip velocity over V"),
}


@click.command("response", cls=SrfCommand, epilog=EXAMPLES)
@stability_options
@value_option("V", "Driving velocity in um/s.")
@value_option("W0", "Mean normal load in N.")
@values_option(AMPLITUDE, about="relative modulation amplitudes, for --mean")
@over_option(
    default=("f=1:1000:200",), help="The frequencies (Hz), or another parameter: NAME=LOW:HIGH[:POINTS[:log|lin]]."
)
@click.option(
    "--mean", is_flag=True, help="The drop of the mean friction at the amplitudes --eps, from the forced states."
)
@click.option("--tol", type=float, help="Relative error of the mean friction; 1e-6 unless set.")
@output_options
def command(
    system: SystemOptions,
    V: str | None,
    W0: str | None,
    eps: tuple[float, ...] | None,
    over: tuple[Range, ...],
    mean: bool,
    tol: float | None,
    output: OutputOptions,
) -> None:
    """How sliding follows a modulated normal load W0 (1 + eps cos 2 pi f t).

    To first order in eps: gain and phase of friction, position and slip velocity, and where they resonate. With --mean:
    what the modulation takes off the mean friction force, at any amplitude.
    """
    from srfcli.cli.emit import emit, finish

    if len(over) != 1:
        raise SrfError(f"--over is given {len(over)} times", "One parameter is swept: --over f=1:1000:200.")
    if mean and not eps:
        raise SrfError("--mean needs amplitudes", "Give some: --mean --eps 0.05,0.1,0.2.")
    if eps and not mean:
        raise SrfError("--eps has no part in the linear response", "Leave it out, or ask for --mean.")
    model, swept = system.model(), over[0]
    if swept.name == "eps":
        raise SrfError("eps is not swept", "Give amplitudes: --mean --eps 0.05,0.1,0.2; the linear response has none.")
    resolved = system.resolve(model.parameters, V=V, W0=W0)
    check_axes({swept.name}, {"V": V, "W0": W0})
    system.say_defaults(resolved, {"V", "W0"} - {swept.name})
    model.check_changing_load(model.vector(resolved.values))
    begun = time.perf_counter()
    tolerance, sweep = system.tolerance(tol).value, Sweep(model, resolved, swept)
    table, figure, status = _mean(sweep, eps or (), tolerance) if mean else _linear(sweep)
    emit(table, output, laws=model.laws, timings={"solve": time.perf_counter() - begun}, figure=figure)
    finish(status)


class Sweep:
    """A model over the values of one parameter: `values` in um, s, N and `shown` in its declared unit."""

    def __init__(self, model: GeneratedModel, resolved: Resolved, swept: Range) -> None:
        self.model, self.resolved, self.name = model, resolved, swept.name
        self.values = swept.base_points(model.parameters, where=model.title)
        self.shown = [model.declared(swept.name, v) for v in self.values]
        self.log = swept.values is None and swept.spacing == "log"
        self.unit = model.parameters[model.index(swept.name)].unit

    def vectors(self, eps: float) -> Any:
        """Return the parameters (n_parameters, n) at every value, for a modulation amplitude."""
        import numpy as np

        return self.model.vector({**self.resolved.values, "eps": eps, self.name: np.array(self.values)})

    @property
    def column(self) -> Column:
        """Return the column of the values."""
        return Column(self.name, self.unit, "", ".8g")

    @property
    def label(self) -> str:
        """Return the label of the axis that the values lie on."""
        return axis_label(self.name, self.unit)

    def table(self, schema: str, columns: Sequence[Column], rows: list[tuple[Any, ...]], notes: Sequence[str]) -> Table:
        """Return the table of what was found, with the parameters that are the same in all rows."""
        described = {k: v for k, v in self.resolved.described().items() if k not in (self.name, "eps")}
        return Table(schema, tuple(columns), rows, self.model.title, tuple(notes), described)


Found = tuple[Table, Callable[[], "Figure"], Status]  # what was found, its figure, and whether it can be used


def _linear(sweep: Sweep) -> Found:
    """Return the transfer functions: gain and phase of each quantity, and where it resonates."""
    import numpy as np

    from srfcli.numerics.response import linear_response, resonance

    found = linear_response(sweep.model, sweep.vectors(0.0))
    parts = {name: getattr(found, name) for name in QUANTITIES}
    cells = [f(values) for values in parts.values() for f in (np.abs, np.angle)]
    steady = [("stable" if found.stable[i] else "unstable") if s.ok else None for i, s in enumerate(found.status)]
    rows = [(x, *(float(c[i]) for c in cells), steady[i], found.status[i].value) for i, x in enumerate(sweep.shown)]
    columns = [sweep.column]
    for name, (unit, about) in QUANTITIES.items():
        columns.append(Column(f"{name}_gain", unit, f"amplitude {about} for eps = 1, to first order"))
        columns.append(Column(f"{name}_phase", "rad", "ahead of the load"))
    columns += [Column("type", "", "stable or unstable: steady sliding"), Column("status")]
    notes = ["to first order in eps: amplitudes are eps times the gains"]
    if sweep.name == "f":
        for name, values in parts.items():
            top = resonance(np.array(sweep.values), np.abs(values))
            where = "none inside the range" if top is None else f"{top[0]:.6g} Hz, gain {top[1]:.6g}"
            notes.append(f"resonance of {name}: {where}")
    if "unstable" in steady:
        notes.append("where steady sliding is unstable the response is not what would be seen")
    table = sweep.table("srf.response/2", columns, rows, notes)

    def figure() -> Figure:
        from srfcli.results.figures import gains

        labels = {"friction": "µ", "force": "µW/W$_0$", "position": "x  [µm]", "velocity": "v/V"}
        title = titled(table.title, table.parameters)
        drawn = {labels[name]: values for name, values in parts.items()}
        return gains(sweep.shown, drawn, xlabel=sweep.label, logx=sweep.log, title=title)

    return table, figure, worst(found.status)


def _mean(sweep: Sweep, amplitudes: tuple[float, ...], tol: float) -> Found:
    """Return the mean friction of the forced states at each amplitude."""
    from srfcli.numerics.response import mean_friction

    rows, statuses, curves = [], [], []
    for eps in amplitudes:
        found = mean_friction(sweep.model, sweep.vectors(eps), tol=tol)
        statuses += list(found.status)
        curves.append([float(d) for d in found.drop])
        cells = (found.steady, found.force, found.drop, found.friction, found.growth, found.error)
        rows += [(eps, x, *(float(c[i]) for c in cells), found.status[i].value) for i, x in enumerate(sweep.shown)]
    about = "ln of the leading multiplier's modulus; the forced state is stable where negative"
    columns = (
        Column("eps", "1", "modulation amplitude"),
        sweep.column,
        Column("steady_force", "1", "friction force of steady sliding over W0"),
        Column("mean_force", "1", "mean friction force over W0"),
        Column("force_drop", "1", "what modulation takes off the mean friction force, over W0"),
        Column("mean_friction", "1", "mean friction coefficient"),
        Column("growth_per_period", "1", about),
        Column("error", "1", "estimated error of the mesh", ".2g"),
        Column("status", "", STATUS),
    )
    notes = ("mean over a forcing period of the forced periodic state, stable or not",)
    table = sweep.table("srf.response.mean/2", columns, rows, notes)

    def figure() -> Figure:
        from srfcli.results import plots

        names = [f"ε = {eps:g}" for eps in amplitudes]
        ylabel = "drop of the mean friction force / W$_0$"
        title = titled(table.title, table.parameters)
        return plots.lines(sweep.shown, curves, names, sweep.label, ylabel, sweep.log, title=title)

    return table, figure, worst(statuses)
