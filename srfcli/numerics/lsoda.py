"""The same motion and sensitivities on LSODA, where there is no C compiler, and as a check on what was compiled."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from srfcli.model import GeneratedModel
from srfcli.numerics.collocation import Array
from srfcli.numerics.load import Load
from srfcli.numerics.program import Drive
from srfcli.numerics.scalar import scalar_function
from srfcli.status import Status

if TYPE_CHECKING:
    from srfcli.numerics.motion import Motion

MAX_STEPS = 200_000  # between two output times
S_SHARE = (
    100.0  # sensitivities are solved so much less closely than states; left out of the control altogether, they diverge
)
BEYOND = 1e100  # a rate where the formula overflows: the step is then rejected and cut

Rates = Callable[[float, Array], object]


def integrate_lsoda(
    model: GeneratedModel,
    p: Array,
    drive: Drive,
    load: Load,
    t: Array,
    start: Array,
    by: Sequence[int],
    S0: Array,
    rtol: float,
    atol: Array,
) -> Motion:
    """Return what `motion.integrate` returns; S is carried along as n k further unknowns."""
    from srfcli.numerics.motion import Motion, pieces, sensitivity_scale

    n, k = start.size, len(by)
    y = np.full((t.size, n * (1 + k)), np.nan)
    y[0] = state = np.concatenate([start, S0.ravel()])
    loose = S_SHARE * rtol
    tolerance = np.concatenate([atol, (S_SHARE * np.outer(atol, sensitivity_scale(p, by)[:k])).ravel()])
    relative = np.concatenate([np.full(n, rtol), np.full(n * k, loose)])
    system = _System(model, p, by)
    status, reached, steps = Status.OK, float(t[0]), 0
    for a, b in pieces(t, drive, load):
        f, df = system.on_piece(drive, load, 0.5 * (a + b))
        wanted = np.nonzero((t > a) & (t <= b))[0]
        times = np.unique([a, *t[wanted], b])
        found, good, count = _march(f, df if not k else None, state, times, relative, tolerance, load.longest_step)
        steps += count
        places = np.searchsorted(times, t[wanted])
        y[wanted[places < good]] = found[places[places < good]]
        reached, state = float(times[good - 1]), found[-1]
        if good < times.size:
            status = Status.INTEGRATION
            break
    return Motion(y[:, :n], y[:, n:].reshape(t.size, n, k), status, reached, steps)


class _System:
    """Rates of the state and of its sensitivities as functions of (t, y) on one smooth piece."""

    def __init__(self, model: GeneratedModel, p: Array, by: Sequence[int]) -> None:
        self.n, self.k = len(model.states), len(by)
        self.rates, self.jacobian = (scalar_function(model, name, p) for name in ("rates", "rates_jacobian"))
        self.by = np.array(by, dtype=int)
        self.parameters = scalar_function(model, "rates_parameters", p) if self.k else None

    def on_piece(self, drive: Drive, load: Load, within: float) -> tuple[Rates, Rates]:
        """Return the rates and the Jacobian of the state, as functions of (t, y), where the piece at `within` holds."""
        W_at = load.piece(within)
        V0, acceleration, since = drive.piece(within)
        n, k = self.n, self.k

        def inputs(t: float) -> tuple[float, float, float]:
            return (V0 + acceleration * (t - since) if acceleration else V0, *W_at(t))

        def rates(t: float, y: Array) -> object:
            try:
                return self.rates(y.tolist(), *inputs(t))
            except (ArithmeticError, ValueError):
                return np.full(n, BEYOND)

        def jacobian(t: float, y: Array) -> object:
            try:
                return self.jacobian(y.tolist(), *inputs(t))
            except (ArithmeticError, ValueError):
                return np.full((n, n), BEYOND)

        def augmented(t: float, y: Array) -> object:
            x, given = y[:n].tolist(), inputs(t)
            try:
                direct = np.array(self.parameters(x, *given))[:, self.by] * (self.by >= 0)  # type: ignore[misc]
                S_rate = np.array(self.jacobian(x, *given)) @ y[n:].reshape(n, k) + direct
                return np.concatenate([self.rates(x, *given), S_rate.ravel()])
            except (ArithmeticError, ValueError):
                return np.full(n * (1 + k), BEYOND)

        return (augmented if k else rates), jacobian


def _march(
    f: Rates, df: Rates | None, start: Array, times: Array, rtol: Array, atol: Array, longest: float
) -> tuple[Array, int, int]:
    """Return the unknowns (times, n), how many times were reached, and the number of steps."""
    from scipy.integrate import ODEintWarning, odeint

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", ODEintWarning)  # told by the status instead
        y, info = odeint(
            f, start, times, Dfun=df, tfirst=True, rtol=rtol, atol=atol, tcrit=[times[-1]],
            hmax=longest if math.isfinite(longest) else 0.0, mxstep=MAX_STEPS, full_output=True,
        )  # fmt: skip
    steps = int(info["nst"][-1])
    if info["message"] == "Integration successful.":
        finite = np.isfinite(y).all(axis=1)
        return y, times.size if finite.all() else int(np.argmin(finite)), steps
    # LSODA's own clock `tcur` stands still at the output interval it failed in; what lies beyond is not filled
    failed = np.nonzero(info["tcur"] < times[1:])[0]
    return y, int(failed[0]) + 1 if failed.size else 1, steps
