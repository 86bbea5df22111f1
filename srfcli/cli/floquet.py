"""`srf floquet`: one forced periodic state in full."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.options import OutputOptions, SrfCommand, SystemOptions, output_options, system_options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srfcli.model import GeneratedModel
    from srfcli.numerics.floquet import FloquetResult
    from srfcli.output.tables import Table

EXAMPLES = """
srf floquet --V 8 --W0 9 --eps 0.09
srf floquet --V 50 --W0 15 --eps 0.18 --plot orbit.svg
srf floquet --V 8 --W0 9 --eps 0.09 --json --tol 1e-9
"""


@click.command("floquet", cls=SrfCommand, epilog=EXAMPLES)
@system_options
@click.option("--V", "V", metavar="VALUE", help="Driving velocity, in um/s.")
@click.option("--W0", "W0", metavar="VALUE", help="Mean normal load, in N.")
@click.option("--eps", "eps", metavar="VALUE", help="Relative amplitude of the load modulation.")
@click.option("--tol", type=float, help="Error of the multipliers; 1e-6 unless set.")
@click.option(
    "--max-mesh", type=click.IntRange(32, 65536), default=1024, show_default=True, help="Intervals of the finest mesh."
)
@click.option(
    "--harmonics", type=click.IntRange(1, 200), default=5, show_default=True, help="Harmonics of u and mu to list."
)
@click.option("--fail-on", type=click.Choice(["unstable", "stable"]), help="Exit with 4 when the state is so.")
@output_options
def command(
    system: SystemOptions,
    V: str | None,
    W0: str | None,
    eps: str | None,
    tol: float | None,
    max_mesh: int,
    harmonics: int,
    fail_on: str | None,
    output: OutputOptions,
) -> int:
    """The forced periodic state at one V, W0 and eps: multipliers, mean friction, harmonics.

    The mesh is doubled until the estimated error of the multipliers is below --tol. The state is stable where all
    multipliers lie inside the unit circle; the mean friction is set beside that of steady sliding at eps = 0.
    """
    from srfcli.cli.base import EXIT_CONDITION, EXIT_OK
    from srfcli.cli.emit import emit, finish
    from srfcli.numerics.floquet import solve_floquet

    model = system.model()
    resolved = system.resolve(model.parameters, V=V, W0=W0, eps=eps)
    system.say_defaults(resolved, ("V", "W0", "eps"))
    tolerance = system.tolerance(tol).value
    begun, p = time.perf_counter(), model.vector(resolved.values)
    model.check_changing_load(p)
    result = solve_floquet(model, p, tol=tolerance, max_mesh=max_mesh, harmonics=harmonics)
    timings = {"solve": time.perf_counter() - begun}
    table = _table(model, result, resolved.described())
    emit(table, output, laws=model.laws, timings=timings, figure=lambda: _figure(model, result))
    if not result.status.ok:
        finish(result.status)
    return EXIT_CONDITION if fail_on == ("stable" if result.stable else "unstable") else EXIT_OK


def _table(model: GeneratedModel, r: FloquetResult, parameters: dict[str, Any]) -> Table:
    import numpy as np

    from srfcli.output.tables import Column, Table

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


def _checked(mismatch: float) -> str:
    return f"{mismatch:.1g}" if mismatch == mismatch else "not compared: the fastest multiplier is far below rounding"


def _figure(model: GeneratedModel, r: FloquetResult) -> Figure:
    import numpy as np

    from srfcli.numerics.floquet import waveforms
    from srfcli.output import plots

    waves = waveforms(model, r.p, r.orbit, 400)
    column = {name: waves.x[:, i] for i, name in enumerate(model.states)}
    ages = {name[3:]: np.exp(values) for name, values in column.items() if name.startswith("ln_") and name != "ln_v"}
    value = {n: r.p[model.index(n)] for n in ("V", "W0", "eps")}
    verdict = ("stable" if r.stable else "unstable") if r.found else "not converged"
    title = f"V = {value['V']:g} µm/s, W$_0$ = {value['W0']:g} N, ε = {value['eps']:g}: {verdict}"
    return plots.orbit(waves.tau, u=waves.u, v=np.exp(column["ln_v"]), states=ages, mu=waves.mu, W=waves.W, title=title)
