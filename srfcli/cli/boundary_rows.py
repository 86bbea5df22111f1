"""What `srf critical` and `srf continue` share: columns, rows and the window that was looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from srfcli.output.tables import Column
from srfcli.status import Status

if TYPE_CHECKING:
    from srfcli.model import GeneratedModel
    from srfcli.numerics.polish import BoundaryPoint

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


def worst(statuses: list[Status]) -> Status:
    """Return the first status whose numbers cannot be used as they stand, else OK."""
    return next((s for s in statuses if not s.ok), Status.OK)
