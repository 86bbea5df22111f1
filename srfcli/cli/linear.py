"""`srf linear`: stability of steady sliding under constant load."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.options import (
    OutputOptions,
    Range,
    SrfCommand,
    SystemOptions,
    output_options,
    over_option,
    parse_over,
    system_options,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srfcli.model import GeneratedModel
    from srfcli.numerics.hopf import HopfPoint
    from srfcli.output.tables import Table

EXAMPLES = """
srf linear                                             V from 1 to 100 um/s
srf linear --over V=1:300:40 --plot hopf.svg
srf linear --law log-log --over D0=0.2:2:20 --set V=10
srf linear --over V=1,10,100 --csv
srf linear --loading inclined --ageing dieterich+linker-dieterich --over angle=-30:30:13:lin
"""


@click.command("linear", cls=SrfCommand, epilog=EXAMPLES)
@system_options
@over_option(help="Values to run over, V=1:100:60 unless given; repeat for a grid of two parameters.")
@click.option(
    "--all-roots", is_flag=True, help="List every Hopf point, also where stability returns or other roots are unstable."
)
@output_options
def command(system: SystemOptions, over: tuple[Range, ...], all_roots: bool, output: OutputOptions) -> None:
    """Critical load, K/W0 and frequency of steady sliding under constant load.

    From the exact characteristic polynomial: all its Hopf points, with the direction of crossing checked and the first
    Lyapunov coefficient (direct: stick-slip grows from nothing; inverted: it starts with a jump). Beside them stand the
    closed forms for a rigid interface, and for a rigid interface without inertia.
    """
    from srfcli.cli.emit import emit

    model = system.model()
    ranges = over or (parse_over("V=1:100:60"),)
    resolved = system.resolve(model.parameters)
    fitted = [r.fitted(model.parameters, where=model.title) for r in ranges]
    axes = [r.base_points(model.parameters, where=model.title) for r in ranges]
    rows = []
    for values in itertools.product(*axes):
        p = model.vector({**resolved.values, **{r.name: v for r, v in zip(fitted, values, strict=True)}})
        rows += _rows(model, p, [r.name for r in fitted], all_roots)
    table = _table(
        model,
        rows,
        [r.name for r in fitted if r.name not in ("V", "W0")],
        resolved.described(),
        {r.name for r in fitted},
    )
    emit(table, output, laws=model.laws, figure=lambda: _figure(model, fitted, rows))


def _rows(model: GeneratedModel, p: Any, names: Sequence[str], all_roots: bool) -> list[dict[str, Any]]:
    """Return the rows of one parameter point: its critical load, or every Hopf point, or one row that says there is none."""
    import numpy as np

    from srfcli.numerics.hopf import closed_forms, hopf_points, weakening

    value = {name: float(p[model.index(name)]) for name in model.names}
    common: dict[str, Any] = {n: model.declared(n, value[n]) for n in names} | {"V": value["V"], "K": value["K"]}
    common |= closed_forms(model, p)
    points = hopf_points(model, p)
    if not all_roots:
        points = [q for q in points if q.leading and q.crossing_rate > 0][:1]
    if not points:
        falling = float(np.asarray(weakening(model, p))) > 0
        return [common | {"status": "no Hopf" if falling else "velocity strengthening: no Hopf"}]
    return [common | _point_cells(model, q, value) for q in points]


def _point_cells(model: GeneratedModel, point: HopfPoint, value: dict[str, float]) -> dict[str, Any]:
    cells: dict[str, Any] = {"W0": point.W0, "K_over_W0": value["K"] / point.W0, "Omega_c": point.Omega}
    cells["crossing_rate"], cells["lyapunov"], cells["leading"] = point.crossing_rate, point.lyapunov, point.leading
    known = math.isfinite(point.lyapunov)
    cells["criticality"] = ("direct" if point.direct else "inverted") if known else None
    if "D0" in value:
        cells["Omega_reduced"] = value["D0"] * point.Omega / value["V"]
    return cells | {"status": "ok" if known else "no Lyapunov coefficient: the Jacobian overflows"}


def _table(
    model: GeneratedModel,
    rows: Sequence[dict[str, Any]],
    names: Sequence[str],
    parameters: dict[str, Any],
    swept: set[str],
) -> Table:
    from srfcli.output.tables import Column, Table

    units = {q.name: q for q in model.parameters}
    columns = [
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
    ]
    cells = [tuple(row.get(c.name) for c in columns) for row in rows]
    kept = {k: v for k, v in parameters.items() if k not in swept and k not in ("W0", "eps", "f")}
    return Table("srf.linear/1", tuple(columns), cells, title=model.title, parameters=kept)


def _figure(model: GeneratedModel, ranges: Sequence[Range], rows: Sequence[dict[str, Any]]) -> Figure:
    from srfcli.output import plots

    x = ranges[0].name
    if len(ranges) == 1 and x == "V":
        curve = {k: [row.get(k) for row in rows] for k in ("V", "K_over_W0")}
        return plots.stability_diagram([], hopf=curve, title=model.title)
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(", ".join(f"{r.name} = {row[r.name]:.4g} {r.unit}" for r in ranges[1:]), []).append(row)
    first = next(iter(groups.values()))
    unit = ranges[0].unit
    return plots.lines(
        [row[x] for row in first],
        [[row.get("K_over_W0") for row in group] for group in groups.values()],
        list(groups),
        f"{x}  [{unit.replace('um', 'µm')}]" if unit not in ("", "1") else x,
        "critical K/W$_0$  [1/µm]",
        logx=ranges[0].spacing == "log",
        title=model.title,
    )
