"""`srf continue`: stability boundaries under modulation, followed through folds, all components in a window."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.boundary_rows import COLUMNS, boundary_row, worst
from srfcli.cli.options import (
    OutputOptions,
    Range,
    SrfCommand,
    SystemOptions,
    output_options,
    over_option,
    parse_over,
    system_options,
    values_option,
)
from srfcli.laws import Parameter
from srfcli.output.plots import titled
from srfcli.status import Status

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.figure import Figure

    from srfcli.model import GeneratedModel
    from srfcli.numerics.atlas import Atlas
    from srfcli.numerics.plane import Axis, Plane
    from srfcli.numerics.windows import LoadWindow
    from srfcli.settings import Resolved

EXAMPLES = """
srf continue --eps 0.18 --plot boundary.svg
srf continue --eps 0.18 --eps 0.13 --over V=1:100 --csv
srf continue --V 7 --over eps=0.01:0.4 --over W0=4:100
srf continue --eps 0.09 --law log-log --ageing dieterich+linker-dieterich
"""
AMPLITUDE = Parameter("eps", 0.0, "1", 0.0, 0.999999, "relative modulation amplitudes, a boundary for each")
LINES = 5  # that are followed outwards to find the loads to look between


@click.command("continue", cls=SrfCommand, epilog=EXAMPLES)
@system_options
@values_option(AMPLITUDE)
@click.option("--V", "V", metavar="VALUE", help="Driving velocity in um/s, where it is not an axis.")
@click.option("--W0", "W0", metavar="VALUE", help="Mean normal load in N, where it is not an axis.")
@over_option(help="The plane: NAME=LOW:HIGH once (against W0) or twice; V=1:100 unless given.")
@click.option(
    "--scan-lines",
    type=click.IntRange(2, 10_000),
    default=10,
    show_default=True,
    help="Lines on which components are looked for.",
)
@click.option(
    "--samples",
    type=click.IntRange(8, 100_000),
    default=64,
    show_default=True,
    help="Points looked at first, on each line.",
)
@click.option("--step", type=float, default=0.035, show_default=True, help="Longest step, as a share of the window.")
@click.option(
    "--max-steps", type=click.IntRange(1, 1_000_000), default=3000, show_default=True, help="Longest curve, each way."
)
@click.option("--tol", type=float, help="Relative error of each point; 1e-6 unless set.")
@click.option(
    "--max-mesh", type=click.IntRange(64, 8192), default=512, show_default=True, help="Intervals of the finest mesh."
)
@output_options
def command(
    system: SystemOptions,
    eps: tuple[float, ...] | None,
    V: str | None,
    W0: str | None,
    over: tuple[Range, ...],
    scan_lines: int,
    samples: int,
    step: float,
    max_steps: int,
    tol: float | None,
    max_mesh: int,
    output: OutputOptions,
) -> None:
    """The stability boundary of the forced sliding state in a plane of two parameters.

    Components are looked for on lines across the window, each is followed by pseudo-arclength continuation through its
    folds, and every point is polished until its error is met. Ctrl-C keeps what is done.
    """
    from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
    from srfcli.errors import SrfError
    from srfcli.numerics.atlas import AtlasSettings, find_components
    from srfcli.numerics.continuation import StepSettings
    from srfcli.output.tables import Column, Table

    if not 1e-4 <= step <= 0.5:
        raise SrfError(
            f"--step {step:g} is not a share of the window", "Choose it between 0.0001 and 0.5; 0.035 is usual."
        )
    spanned = {r.name for r in over} or {"V"}
    if len(spanned) < 2:
        spanned.add("W0")
    for name, value in (("V", V), ("W0", W0)):
        if value is not None and name in spanned:
            raise SrfError(
                f"{name} is an axis and has a value too", f"Leave out --{name}, or take {name} out of --over."
            )
    model = system.model()
    resolved = system.resolve(model.parameters, V=V, W0=W0)
    model.check_changing_load(model.vector(resolved.values))
    tolerance = system.tolerance(tol).value
    settings = AtlasSettings(
        scan_lines, samples, tol=tolerance, max_mesh=max_mesh, steps=StepSettings(largest=step, max_steps=max_steps)
    )
    axes = _axes(model, over, eps)
    warn_uncompiled("boundaries take about twice as long")
    system.say_defaults(resolved, {"V", "W0"} - spanned - {part for r in over for part in r.name.split("/")})
    swept = {"W0", *(a.name for a in axes)} if len(axes) == 1 else {a.name for a in axes}
    extra = tuple(a.name for a in axes if a.name not in ("V", "W0", "eps"))
    begun, atlases, status = time.perf_counter(), [], Status.OK
    with Progress("continue") as progress:
        try:
            for plane, window in _planes(model, resolved, axes, eps):
                atlas: Atlas | None = None
                dense = settings if window is None else replace(settings, samples=math.ceil(samples * window.widening))
                for found in find_components(model, plane, dense, progress=lambda said: progress.advance(0, note=said)):
                    atlas = found
                assert atlas is not None
                if window is not None:
                    _judge_window(model, atlas, window)
                atlases.append(atlas)
                if atlas.status is Status.INTERRUPTED:
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
    status = status if status is Status.INTERRUPTED else worst([a.status for a in atlases])
    rows, notes = _rows(model, atlases, extra)
    units = {q.name: q for q in model.parameters}
    columns = (*COLUMNS, *(Column(n, units[n].unit, units[n].about) for n in extra))
    described = {k: v for k, v in resolved.described().items() if k not in {*swept, "eps"}}
    table = Table("srf.continue/1", columns, rows, model.title, tuple(notes), described, status=status.value)
    timings = {"solve": time.perf_counter() - begun}
    emit(
        table,
        output,
        laws=model.laws,
        timings=timings,
        figure=lambda: _figure(model, atlases, titled(model.title, described)),
    )
    finish(status)


def _axes(model: GeneratedModel, over: tuple[Range, ...], eps: tuple[float, ...] | None) -> list[Axis]:
    """Return the axes that --over names, one or two, x first; V from 1 to 100 um/s where it names none."""
    from srfcli.errors import SrfError

    if len(over) > 2:
        raise SrfError(f"--over is given {len(over)} times", "A plane has two axes: --over V=1:100 --over W0=4:400.")
    axes = [_axis(model, r) for r in over or (parse_over("V=1:100"),)]
    if "eps" in [a.name for a in axes] and eps:
        raise SrfError("eps is an axis and has values too", "Leave out --eps, or take eps out of --over.")
    if axes[0].name == "W0":
        if len(axes) == 1:
            raise SrfError("--over W0 alone spans no plane", "Add the other axis: --over V=1:100.")
        axes = axes[::-1]  # stability is followed across the load
    return axes


def _planes(
    model: GeneratedModel, resolved: Resolved, axes: list[Axis], eps: tuple[float, ...] | None
) -> Iterator[tuple[Plane, LoadWindow | None]]:
    """Yield one plane for each amplitude, and the loads that were found for it, if any were; eps itself may be an axis."""
    from srfcli.numerics.plane import Axis, Plane
    from srfcli.numerics.windows import found_window

    x = axes[0]
    amplitudes = eps if eps else (None,) if "eps" in [a.name for a in axes] else (resolved.values["eps"],)
    for amplitude in amplitudes:
        base = model.vector(resolved.values | ({} if amplitude is None else {"eps": amplitude}))
        if len(axes) == 2:
            yield Plane(base, x, axes[1]), None
            continue
        lines = [base.copy() for _ in range(LINES)]
        for line, value in zip(lines, x.samples(LINES), strict=True):
            line[model.index(x.name)] = value
        window = found_window(model, lines)
        yield Plane(base, x, Axis("W0", window.lo, window.hi)), window


def _judge_window(model: GeneratedModel, atlas: Atlas, window: LoadWindow) -> None:
    """Say in `atlas` where its curves leave the loads that were found, and what of those loads is not certain."""
    x = atlas.plane.x.name
    for number, branch in enumerate(atlas.branches, 1):
        for point in (branch.points[0], branch.points[-1]):
            W0 = point.value(model, "W0")
            side = "above" if 0.999 * window.hi < W0 else "below" if 1.001 * window.lo > W0 else ""
            if side:
                at = f"{x} = {model.declared(x, point.value(model, x)):.4g}"
                atlas.notes.append(f"component {number} goes on {side} W0 = {W0:.4g} N at {at} (--over W0=LOW:HIGH for more)")
    if not window.certain:
        atlas.notes.append(f"crossings below {window.lo:.4g} or above {window.hi:.4g} N are not ruled out")
        if atlas.status is Status.OK:
            atlas.status = Status.UNSETTLED


def _axis(model: GeneratedModel, given: Range) -> Axis:
    from srfcli.errors import SrfError
    from srfcli.numerics.plane import Axis
    from srfcli.units import to_base

    fitted = given.fitted(model.parameters, where=model.title)
    if fitted.values:
        raise SrfError(
            f"--over {given.name} lists values", f"An axis runs from a low to a high end: --over {given.name}=1:100."
        )
    return Axis(fitted.name, to_base(fitted.lo, fitted.unit), to_base(fitted.hi, fitted.unit), fitted.spacing == "log")


def _rows(
    model: GeneratedModel, atlases: list[Atlas], extra: tuple[str, ...]
) -> tuple[list[tuple[Any, ...]], list[str]]:
    from srfcli.numerics.atlas import crossing_numbers

    rows, notes = [], []
    for atlas in atlases:
        numbers = crossing_numbers(model, atlas)
        for component, (branch, crossings) in enumerate(zip(atlas.branches, numbers, strict=True), 1):
            rows += [boundary_row(model, q, component, k, extra) for q, k in zip(branch.points, crossings, strict=True)]
        named = (
            ""
            if "eps" in (atlas.plane.x.name, atlas.plane.y.name)
            else f"eps = {atlas.plane.base[model.index('eps')]:g}: "
        )
        count = len(atlas.branches)
        ends = "; ".join(f"{i}: {b.start.value}, {b.end.value}" for i, b in enumerate(atlas.branches, 1))
        notes.append(f"{named}{count} component{'' if count == 1 else 's'}" + (f" (ends {ends})" if count else ""))
        notes += [named + note for note in atlas.notes]
    return rows, notes


def _figure(model: GeneratedModel, atlases: list[Atlas], title: str) -> Figure:
    import numpy as np

    from srfcli.numerics.hopf import critical_point
    from srfcli.output import plots

    if not atlases:
        return plots.stability_diagram([], title=model.title)
    plane = atlases[0].plane
    usual = (plane.x.name, plane.y.name) == ("V", "W0")
    branches = []
    for atlas in atlases:
        for branch in atlas.branches:
            x = [model.declared(plane.x.name, q.value(model, plane.x.name)) for q in branch.points]
            y = [
                q.value(model, "K") / q.value(model, "W0")
                if usual
                else model.declared(plane.y.name, q.value(model, plane.y.name))
                for q in branch.points
            ]
            label = None if "eps" not in (plane.x.name, plane.y.name) else "boundary"
            branches.append(
                {"eps": float(atlas.plane.base[model.index("eps")]), "V": x, "K_over_W0": y, "label": label}
            )
    if usual:
        velocities = np.geomspace(plane.x.lo, plane.x.hi, 80)
        hopf = []
        for velocity in velocities:
            p = plane.base.copy()
            p[model.index("V")] = velocity
            point = critical_point(model, p)[0]
            hopf.append(None if point is None else float(p[model.index("K")]) / point.W0)
        return plots.stability_diagram(branches, hopf={"V": velocities, "K_over_W0": hopf}, title=title)
    unit = {q.name: q.unit for q in model.parameters}
    return plots.boundaries(
        branches,
        xlabel=_label(plane.x.name, unit),
        ylabel=_label(plane.y.name, unit),
        logx=plane.x.log,
        logy=plane.y.log,
        title=title,
    )


def _label(name: str, unit: dict[str, str]) -> str:
    return name if unit[name] in ("", "1") else f"{name}  [{unit[name].replace('um', 'µm')}]"
