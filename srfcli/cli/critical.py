"""`srf critical`: every critical load at given velocities and modulation amplitudes."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.boundary_rows import COLUMNS, boundary_row, worst
from srfcli.cli.options import (
    OutputOptions,
    Range,
    SrfCommand,
    SystemOptions,
    output_options,
    parse_over,
    system_options,
    values_option,
)
from srfcli.laws import Parameter
from srfcli.output.plots import titled
from srfcli.status import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXAMPLES = """
srf critical --eps 0.13 --V 1,7,25
srf critical --eps 0,0.045,0.09 --V 1,2,5,10,20,50 --csv
srf critical --eps 0.4 --V 40 --window 4:500
"""
VELOCITY = Parameter("V", 10.0, "um/s", 1e-12, 1e9, "driving velocities")
AMPLITUDE = Parameter("eps", 0.0, "1", 0.0, 0.999999, "relative modulation amplitudes")


@click.command("critical", cls=SrfCommand, epilog=EXAMPLES)
@system_options
@values_option(VELOCITY)
@values_option(AMPLITUDE)
@click.option(
    "--window",
    metavar="LOW:HIGH",
    help="Loads to look between, in N; else all at which a crossing can be.",
)
@click.option("--tol", type=float, help="Relative error of a critical load.", default=1e-8, show_default=True)
@click.option(
    "--samples",
    type=click.IntRange(8, 100_000),
    default=192,
    show_default=True,
    help="Loads looked at first, on each line.",
)
@click.option(
    "--resolution",
    type=float,
    default=1e-3,
    show_default=True,
    help="Finest spacing in ln W0 where a pair of crossings could hide.",
)
@click.option(
    "--max-mesh", type=click.IntRange(32, 8192), default=512, show_default=True, help="Intervals of the finest mesh."
)
@output_options
def command(
    system: SystemOptions,
    V: tuple[float, ...] | None,
    eps: tuple[float, ...] | None,
    window: str | None,
    tol: float,
    samples: int,
    resolution: float,
    max_mesh: int,
    output: OutputOptions,
) -> None:
    """Every critical load at the given velocities, numbered from low W0.

    The growth rate is sampled along W0, refined where a pair of crossings could hide, and each sign change is polished on
    meshes that are doubled until the error is met. Odd crossings lose stability as W0 rises, even ones regain it.
    """
    from srfcli.cli.emit import Progress, emit, finish
    from srfcli.errors import SrfError
    from srfcli.numerics.critical import critical_line
    from srfcli.output.tables import Table

    if not 1e-12 < tol < 0.1 or not 1e-8 < resolution < 1:
        raise SrfError(f"--tol {tol:g} or --resolution {resolution:g} is out of range", "--tol 1e-8 --resolution 1e-3")
    model = system.model()
    resolved = system.resolve(model.parameters)
    model.check_changing_load(model.vector(resolved.values))
    velocities = V or (resolved.values["V"],)
    amplitudes = eps or (resolved.values["eps"],)
    limits = None if window is None else _window(window).fitted(model.parameters, where=model.title)
    lo, hi = (limits.lo, limits.hi) if limits else (None, None)
    begun, rows, notes, statuses = time.perf_counter(), [], [], []
    low, high = [], []
    interrupted = False
    with Progress("critical", total=len(velocities) * len(amplitudes)) as progress:
        try:
            for amplitude in amplitudes:
                for velocity in velocities:
                    base = model.vector({**resolved.values, "V": velocity, "eps": amplitude})
                    line = critical_line(
                        model, base, lo=lo, hi=hi, tol=tol, samples=samples, resolution=resolution, max_mesh=max_mesh
                    )
                    rows += [boundary_row(model, q, None, k) for q, k in zip(line.points, line.crossings, strict=True)]
                    statuses += [line.status, *(q.status for q in line.points)]
                    first, last = float(line.scans[0].values[0]), float(line.scans[-1].values[-1])
                    low.append(first)
                    high.append(last)
                    place = f"eps = {amplitude:g}, V = {velocity:g} um/s"
                    notes += [f"{place}: {note}" for note in line.notes]
                    if not line.points:
                        side = _side([g for scan in line.scans for g in scan.g.tolist()])
                        notes.append(f"{place}: no crossing between W0 = {first:.4g} and {last:.4g} N; {side}")
                    progress.advance(note=place)
        except KeyboardInterrupt:
            interrupted = True
    if low:
        span = f"{min(low):.4g} to {max(high):.4g} N" + ("" if limits else ", to where the growth rate settles")
        notes.append(f"looked from {span}; pairs of crossings closer than {resolution:g} in ln W0 are not looked for")
    status = Status.INTERRUPTED if interrupted else worst(statuses)
    described = {k: v for k, v in resolved.described().items() if k not in ("W0", "V", "eps")}
    table = Table("srf.critical/1", COLUMNS, rows, model.title, tuple(notes), described, status=status.value)
    emit(
        table,
        output,
        laws=model.laws,
        timings={"solve": time.perf_counter() - begun},
        figure=lambda: _figure(rows, titled(model.title, described)),
    )
    finish(status)


def _window(text: str) -> Range:
    """Return the loads that LOW:HIGH spans, with or without a unit; raises SrfError that shows the form."""
    from srfcli.errors import SrfError

    try:
        found = parse_over(f"W0={text}") if text.count(":") == 1 else None
    except SrfError:
        found = None
    if found is None or not found.lo > 0:
        raise SrfError(f"--window {text!r} is not LOW:HIGH, two rising loads above 0", "Write --window 4:500.")
    return found


def _side(g: object) -> str:
    import numpy as np

    values = np.asarray(g)
    if not np.isfinite(values).all():
        return "no sign change among the samples that were found"
    return (
        "stable at every load looked at"
        if values.size and (values < 0).all()
        else "unstable at every load looked at"
        if values.size
        else "no periodic state found"
    )


def _figure(rows: list[tuple[Any, ...]], title: str) -> Figure:
    """Return the critical points as a diagram, the crossings of one number and amplitude joined."""
    from srfcli.output import plots

    names = [c.name for c in COLUMNS]
    cells = [dict(zip(names, row, strict=False)) for row in rows]
    branches = []
    for eps, crossing in sorted({(c["eps"], c["crossing"]) for c in cells}):
        mine = sorted((c for c in cells if (c["eps"], c["crossing"]) == (eps, crossing)), key=lambda c: c["V"])
        branches.append({"eps": eps, "V": [c["V"] for c in mine], "K_over_W0": [c["K_over_W0"] for c in mine]})
    return plots.stability_diagram(branches, title=title)
