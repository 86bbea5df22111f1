"""`srf response`: how friction, position and slip velocity follow a modulated load, to first order and in the mean."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import SrfCommand
from srfcli.cli.options import (
    AMPLITUDE,
    OutputOptions,
    Range,
    SystemOptions,
    output_options,
    over_option,
    stability_options,
    value_option,
    values_option,
)
from srfcli.core.errors import Status, worst
from srfcli.results.plots import titled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srfcli.codegen.model import GeneratedModel
    from srfcli.core.settings import Resolved
    from srfcli.numerics.response import LinearResponse
    from srfcli.results.tables import Column, Table

EXAMPLES = """
srf response --V 10 --W0 6 --over f=1:1000:200 --plot response.svg
srf response --V 10 --W0 6 --over f=1:1000:200 --csv
srf response --V 10 --W0 6 --mean --eps 0.05,0.1,0.2 --over f=20:400:30
"""
QUANTITIES = ("friction", "force", "position", "velocity")


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
    from srfcli.core.errors import SrfError

    if len(over) != 1:
        raise SrfError(f"--over is given {len(over)} times", "One parameter is swept: --over f=1:1000:200.")
    if mean and not eps:
        raise SrfError("--mean needs amplitudes", "Give some: --mean --eps 0.05,0.1,0.2.")
    if eps and not mean:
        raise SrfError("--eps has no part in the linear response", "Leave it out, or ask for --mean.")
    model = system.model()
    swept = over[0]
    if swept.name == "eps":
        raise SrfError("eps is not swept", "Give amplitudes: --mean --eps 0.05,0.1,0.2; the linear response has none.")
    resolved = system.resolve(model.parameters, V=V, W0=W0)
    for name, value in (("V", V), ("W0", W0)):
        if value is not None and name == swept.name:
            raise SrfError(f"{name} is swept and has a value too", f"Leave out --{name}, or sweep another parameter.")
    system.say_defaults(resolved, {"V", "W0"} - {swept.name})
    model.check_changing_load(model.vector(resolved.values))
    begun = time.perf_counter()
    tolerance = system.tolerance(tol).value
    if mean:
        table, figure, status = _mean(model, resolved, swept, eps or (), tolerance)
    else:
        table, figure, status = _linear(model, resolved, swept)
    emit(table, output, laws=model.laws, timings={"solve": time.perf_counter() - begun}, figure=figure)
    finish(status)


def _described(resolved: Resolved, *swept: str) -> dict[str, Any]:
    return {k: v for k, v in resolved.described().items() if k not in swept}


def _linear(model: GeneratedModel, resolved: Resolved, swept: Range) -> tuple[Table, Any, Status]:
    """Return the table of the transfer functions, its figure and its status."""
    import numpy as np

    from srfcli.numerics.response import linear_response, resonance
    from srfcli.results.tables import Table

    values = np.array(swept.base_points(model.parameters, where=model.title))
    shown = [model.declared(swept.name, v) for v in values]
    found = linear_response(model, model.vector({**resolved.values, swept.name: values, "eps": 0.0}))
    parts = {name: getattr(found, name) for name in QUANTITIES}
    cells = [f(parts[name]) for name in QUANTITIES for f in (np.abs, np.angle)]
    rows = [(x, *(float(c[i]) for c in cells), _steady(found, i), found.status[i].value) for i, x in enumerate(shown)]
    unit = model.parameters[model.index(swept.name)].unit
    columns = _linear_columns(swept.name, unit)
    notes = ["to first order in eps: amplitudes are eps times the gains"]
    if swept.name == "f":
        for name in QUANTITIES:
            top = resonance(values, np.abs(parts[name]))
            where = "none inside the range" if top is None else f"{top[0]:.6g} Hz, gain {top[1]:.6g}"
            notes.append(f"resonance of {name}: {where}")
    if any(_steady(found, i) == "unstable" for i in range(len(shown))):
        notes.append("where steady sliding is unstable the response is not what would be seen")
    table = Table("srf.response/2", columns, rows, model.title, tuple(notes), _described(resolved, swept.name, "eps"))
    status = worst(found.status)
    log = swept.values is None and swept.spacing == "log"
    return (
        table,
        lambda: _bode(shown, parts, f"{swept.name}  [{unit}]", log, titled(model.title, table.parameters)),
        status,
    )


def _steady(found: LinearResponse, i: int) -> str | None:
    """Return whether steady sliding is stable at a point, None where it has no rates."""
    return None if not found.status[i].ok else "stable" if found.stable[i] else "unstable"


def _bode(x: list[float], parts: dict[str, Any], xlabel: str, log: bool, title: str) -> Figure:
    from srfcli.results.figures import gains

    labels = {"friction": "µ", "force": "µW/W$_0$", "position": "x  [µm]", "velocity": "v/V"}
    return gains(x, {labels[k]: v for k, v in parts.items()}, xlabel=xlabel.replace("um", "µm"), logx=log, title=title)


def _mean(
    model: GeneratedModel, resolved: Resolved, swept: Range, amplitudes: tuple[float, ...], tol: float
) -> tuple[Table, Any, Status]:
    """Return the table of mean frictions, its figure and its status."""
    import numpy as np

    from srfcli.numerics.response import mean_friction
    from srfcli.results.tables import Table

    values = np.array(swept.base_points(model.parameters, where=model.title))
    rows, statuses, curves = [], [], []
    shown = [model.declared(swept.name, v) for v in values]
    for eps in amplitudes:
        found = mean_friction(model, model.vector({**resolved.values, "eps": eps, swept.name: values}), tol=tol)
        statuses += list(found.status)
        curves.append([float(d) for d in found.drop])
        rows += [
            (
                eps,
                x,
                *(
                    float(c[i])
                    for c in (found.steady, found.force, found.drop, found.friction, found.growth, found.error)
                ),
                found.status[i].value,
            )
            for i, x in enumerate(shown)
        ]
    unit = model.parameters[model.index(swept.name)].unit
    columns = _mean_columns(swept.name, unit)
    notes = ("mean over a forcing period of the forced periodic state, stable or not",)
    table = Table("srf.response.mean/2", columns, rows, model.title, notes, _described(resolved, swept.name, "eps"))
    log = swept.values is None and swept.spacing == "log"

    def figure() -> Figure:
        from srfcli.results import plots

        label = f"{swept.name}  [{unit.replace('um', 'µm')}]"
        names = [f"ε = {eps:g}" for eps in amplitudes]
        return plots.lines(
            shown,
            curves,
            names,
            label,
            "drop of the mean friction force / W$_0$",
            log,
            title=titled(model.title, table.parameters),
        )

    return table, figure, worst(statuses)


def _mean_columns(name: str, unit: str) -> tuple[Column, ...]:
    """Return the columns of --mean."""
    from srfcli.results.tables import STATUS, Column

    return (
        Column("eps", "1", "modulation amplitude"),
        Column(name, unit, "", ".8g"),
        Column("steady_force", "1", "friction force of steady sliding over W0"),
        Column("mean_force", "1", "mean friction force over W0"),
        Column("force_drop", "1", "what modulation takes off the mean friction force, over W0"),
        Column("mean_friction", "1", "mean friction coefficient"),
        Column(
            "growth_per_period",
            "1",
            "ln of the leading multiplier's modulus; the forced state is stable where negative",
        ),
        Column("error", "1", "estimated error of the mesh", ".2g"),
        Column("status", "", STATUS),
    )


def _linear_columns(name: str, unit: str) -> tuple[Column, ...]:
    """Return the columns of the transfer functions."""
    from srfcli.results.tables import Column

    about = {
        "friction": ("1", "of the friction coefficient"),
        "force": ("1", "of the friction force over W0"),
        "position": ("um", "of the slider's position"),
        "velocity": ("1", "of the interface's slip velocity over V"),
    }
    return (
        Column(name, unit, "", ".8g"),
        *(
            column
            for part in QUANTITIES
            for column in (
                Column(f"{part}_gain", about[part][0], f"amplitude {about[part][1]} for eps = 1, to first order"),
                Column(f"{part}_phase", "rad", "ahead of the load"),
            )
        ),
        Column("type", "", "stable or unstable: steady sliding"),
        Column("status"),
    )
