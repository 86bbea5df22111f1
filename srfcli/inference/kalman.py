"""The Kalman filter of one run on a random friction field, and its smoother; exact derivatives of all that the filter returns.

The extended filter in continuous time with samples (Jazwinski 1970): the mean follows the model's own integrator, the covariance
the exact derivative of each of its steps. Where a reading moves the state too far for that, in a fall, the equations are
linearised again about the state before, as the reading corrects it (Wishner, Tabaczynski and Athans, Automatica 5, 1969). The
smoother runs backward over what the filter kept (de Jong, Biometrika 76, 1989).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.c_source import GAUGE_PROCESSES, LANES, SIGNALS, compiled
from srfcli.codegen.model import Array, GeneratedModel
from srfcli.core.errors import SrfError
from srfcli.motion.imposed import Drive, Load
from srfcli.motion.integrators import doubles, imposed_arguments, integers, interruptible, rtol_of_estimate

LINEAR_MOVE = 0.05  # of a logarithm, by a reading, up to which the equations are linear
NONLINEARITY = 0.02  # difference of a reading from its tangent, over its white noise, that is none
STEPS_A_SAMPLE = 50  # and as many as a thousand samples may take besides: parameters that are far off are given up

GAUGE, SPRING = -1, -2  # what a reading shows: the elongation as the gauge has it, or as it is; from 0 on a state


@dataclass(frozen=True)
class Dual:
    """Numbers `v` (...) with their derivatives `d` (..., k) in k directions."""

    v: Array
    d: Array

    @classmethod
    def plain(cls, v: Array, k: int) -> Dual:
        """Return numbers that depend on nothing."""
        v = np.asarray(v, dtype=float)
        return cls(v, np.zeros((*v.shape, k)))

    def packed(self, first: int) -> Array:
        """Return (..., 1 + LANES): the numbers and as many derivatives as the filter takes at a time, from the first on."""
        out = np.zeros((*self.v.shape, 1 + LANES))
        out[..., 0] = self.v
        some = self.d[..., first : first + LANES]
        out[..., 1 : 1 + some.shape[-1]] = some
        return out


@dataclass(frozen=True)
class Readings:
    """All readings (n,) of a run, signal by signal at each sample: times (s), which do not fall, values, which are taken up.

    `number` says of which signal each is, `rate` which row of the gauge noise holds. It shows what `shows` says, GAUGE, SPRING,
    or the place of a state; of the SPRING, `weighs` is 1 where its force over the stated stiffness is shown, 0 for elongation.
    A reading is `factor` times that plus `offset` plus gauge noise, of which the white part has the variance `R`.
    """

    t: Array
    observed: Array
    used: NDArray[np.bool_]
    number: NDArray[np.intc]
    rate: NDArray[np.intc]
    shows: NDArray[np.intc]
    weighs: Array
    factor: Dual
    offset: Dual
    R: Dual


@dataclass(frozen=True)
class SmootherInput:
    """What the smoother needs, before each reading is used: mean (n, a), covariance, transition since the one before (n, a, a).

    a is the number of states with those of the gauge noise after them; `gradient` (n, a) is that of the reading, `gain` (n, a)
    by how much the states follow its innovation, zero where it is not used.
    """

    mean: Array
    covariance: Array
    transition: Array
    gradient: Array
    gain: Array


@dataclass(frozen=True)
class Innovations:
    """Innovations `nu` (n,), their variances `S` (n,), and the derivatives of both (n, k); NaN after `reached` readings."""

    nu: Array
    S: Array
    nu_d: Array
    S_d: Array
    reached: int
    steps: int
    kept: SmootherInput | None


def kalman_filter(
    model: GeneratedModel,
    p: Dual,
    read: Readings,
    *,
    drive: Drive,
    load: Load,
    start: Dual,
    covariance: Dual,
    gauge: Dual,
    order: Sequence[int],
    owner: Sequence[int],
    rtol: float,
    atol: Array,
    keep: bool,
    most: int | None,
) -> Innovations:
    """Return the innovations of the readings.

    Beside white noise a gauge has processes of as many states as `order` (g,) says, of the signals `owner` (g,), 3 each at most.
    `gauge` (rates, g, 3) has their parameters: of one state, e' = -e/tau + s sqrt(2/tau) w, (tau, s, -); of two, an oscillator of
    frequency f (Hz), quality q and standard deviation s, (f, s, q). Where a reading has another row, a new noise begins.
    `p` are the model's parameters, `start` (n_states,) and `covariance` (n_states, n_states) the belief at t[0]. All are dual
    numbers in the same k directions. Where a reading moves ln v or ln PHI by more
    than LINEAR_MOVE, and what it then shows is not on its tangent, the equations are linearised again.
    After `most` steps, 50 a sample if that is None, the rest is NaN. Raises SrfError without a compiler, or for a model without a
    random friction field.
    """
    if "field_gain" not in model.namespace:
        raise SrfError(f"{model.title} has no random friction field", "open_model(..., random_field=True)")
    library = compiled(model, "filter")
    if library is None:
        raise SrfError("the Kalman filter needs a C compiler", "Install one, or the package ziglang.")
    n, k, states = read.t.size, p.d.shape[-1], len(model.states)
    if len(order) > GAUGE_PROCESSES * SIGNALS or read.number.max() >= SIGNALS:
        raise SrfError(f"more than {GAUGE_PROCESSES} processes of gauge noise a signal, or more than {SIGNALS} signals")
    wide, orders, owners = states + sum(order), integers(np.array([*order, 0])), integers(np.array([*owner, 0]))
    weighed = model.index("weighed") if "weighed" in model.names else -1
    rates, number, shows = integers(read.rate), integers(read.number), integers(read.shows)
    nu, S = np.full(n, np.nan), np.full(n, np.nan)
    nu_d, S_d = np.full((n, k), np.nan), np.full((n, k), np.nan)
    shapes = ((n, wide), (n, wide, wide), (n, wide, wide), (n, wide), (n, wide)) if keep else ((1,),) * 5
    arrays = [np.full(shape, np.nan) for shape in shapes]
    logarithm, linear = integers(np.char.startswith(model.states, "ln_")), doubles(np.array([LINEAR_MOVE, NONLINEARITY]))
    steps, stop, reached = np.zeros(1), ctypes.c_int(0), n
    imposed, use = imposed_arguments(read.t, drive, load), np.ascontiguousarray(read.used, dtype=np.uint8)
    size, most = rtol_of_estimate(rtol), STEPS_A_SAMPLE * (n + 1000) if most is None else most
    allowed = np.asarray(atol) * size / rtol
    for first in range(0, max(k, 1), LANES):
        own_nu, own_S = np.full((n, LANES), np.nan), np.full((n, LANES), np.nan)
        keeping = keep and first == 0
        arguments = (
            *imposed, doubles(p.packed(first)), doubles(start.packed(first)), doubles(covariance.packed(first)),
            len(order), orders, owners, doubles(gauge.packed(first)), rates, number, shows, doubles(read.weighs), weighed,
            int(k > 0), ctypes.c_double(size), doubles(allowed), ctypes.c_long(most), n, doubles(read.t), doubles(read.observed),
            ctypes.c_void_p(use.ctypes.data), doubles(read.factor.packed(first)), doubles(read.offset.packed(first)),
            doubles(read.R.packed(first)), logarithm, linear, int(keeping), doubles(nu),
            doubles(S), doubles(own_nu), doubles(own_S), *(doubles(a) for a in arrays), doubles(steps), ctypes.byref(stop),
        )  # fmt: skip
        reached = min(reached, interruptible(lambda arguments=arguments: library.srf_filter(*arguments), stop))  # type: ignore[misc]
        count = min(LANES, k - first)
        nu_d[:, first : first + count], S_d[:, first : first + count] = own_nu[:, :count], own_S[:, :count]
    kept = SmootherInput(*arrays) if keep else None
    return Innovations(nu, S, nu_d, S_d, reached, int(steps[0]), kept)


@dataclass(frozen=True)
class Smoothed:
    """Mean (n, a) and covariance (n, a, a) of states and gauge noise at each reading, given all readings of the run."""

    mean: Array
    covariance: Array


def smooth(found: Innovations, used: NDArray[np.bool_]) -> Smoothed:
    """Return the fixed-interval smoother of what the filter kept."""
    kept = found.kept
    if kept is None:
        raise SrfError("the filter kept nothing to smooth", "kalman_filter(..., keep=True)")
    n, a = kept.mean.shape
    r, N = np.zeros(a), np.zeros((a, a))  # the score of the log likelihood by a shift of the state here, and its variance
    mean, P = kept.mean.copy(), kept.covariance.copy()
    for k in range(n - 1, -1, -1):
        if used[k] and k < found.reached:
            H, S = kept.gradient[k], found.S[k]
            through = np.eye(a) - np.outer(kept.gain[k], H)
            r = H * (found.nu[k] / S) + through.T @ r
            N = np.outer(H, H) / S + through.T @ N @ through
        mean[k] += kept.covariance[k] @ r
        P[k] -= kept.covariance[k] @ N @ kept.covariance[k]
        r, N = kept.transition[k].T @ r, kept.transition[k].T @ N @ kept.transition[k]
    return Smoothed(mean, P)
