"""States over time and their derivatives: Radau IIA compiled where that is possible, else LSODA.

The sensitivities S solve S' = f_x S + f_p. The compiled integrator differentiates its own discrete solution, so that a gradient
is that of the very number which is returned. LSODA carries S along as further unknowns.

LSODA calls functions of one state in Python floats. They are made from the text of the generated module: `out[..., i] = e`
becomes an entry of a tuple, and what depends on the parameters alone is computed once, when they are bound.
"""

from __future__ import annotations

import ast
import ctypes
import math
import threading
import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srfcli.codegen.c_source import compiled, formulas_of
from srfcli.codegen.model import Array, GeneratedModel
from srfcli.codegen.splines import Spline, appended, tables_after
from srfcli.core.errors import SrfError, Status
from srfcli.motion.imposed import Drive, Load, horner

SIGNAL_INTERVAL = 0.1  # s between looks for a signal where waiting for a thread cannot be interrupted (Windows)
MAX_STEPS = 20_000_000  # of the compiled integrator, in all; a hundred times an hour of modulation
MAX_LSODA_STEPS = 200_000  # between two output times
S_SHARE = 100.0  # sensitivities are solved so much less closely than states; without any control they diverge
OVERFLOWN_RATE = 1e100  # a rate where the formula overflows: the step is then rejected and cut

Rates = Callable[[float, Array], object]


@dataclass(frozen=True)
class Motion:
    """States `x` (times, n) and `S` (times, n, k), their derivatives by the k quantities asked for; NaN after `reached` s."""

    x: Array
    S: Array
    status: Status
    reached: float
    steps: int


class Stopped(KeyboardInterrupt):
    """Ctrl-C during an integration; `motion` is what was reached."""

    def __init__(self, motion: Motion) -> None:
        super().__init__()
        self.motion = motion


def integrate(
    model: GeneratedModel,
    p: Array,
    *,
    drive: Drive,
    load: Load,
    t: Array,
    start: Array,
    by: Sequence[int] = (),
    S0: Array | None = None,
    tables: Sequence[Spline] = (),
    by_tables: Sequence[int] = (),
    rtol: float = 1e-8,
    atol: Array,
) -> Motion:
    """Return the motion from `start` (n,) at t[0] (s) to the rising times `t`, with the model's parameters `p` (n_parameters,).

    `by` are places in `p`, or -1 for a direction of the initial state alone; S0 (n, k) is the derivative of `start`, zero if left
    out. A model with tables takes them in order; S then ends with a column for each number of the tables in `by_tables`, which
    rises. `atol` (n,). Errors are local, per step; those of S are held to some tens of times the bound on x. Ctrl-C raises
    `Stopped`, where the integration is compiled.
    """
    library = compiled(model)
    count = len(by) + sum(tables[i].coefficients.size for i in by_tables)
    S0 = np.zeros((start.size, count)) if S0 is None else np.ascontiguousarray(S0, dtype=float)
    missing = len(model.namespace.get("TABLES", ())) - len(tables)
    p = appended(np.asarray(p, dtype=float), [*tables, *[Spline(0.0, 1.0, np.zeros(0))] * missing]) if tables or missing else p
    if library is None:
        if by_tables:
            raise SrfError("derivatives by a table's numbers need a C compiler", "install one, or the package ziglang")
        return integrate_lsoda(model, p, drive, load, t, start, by, S0, rtol, atol)
    own, columns = len(by), np.full(max(len(tables), 1), -1, dtype=np.intc)
    for i in by_tables:
        columns[i], own = own, own + tables[i].coefficients.size
    x, S = np.full((t.size, start.size), np.nan), np.full((t.size, *S0.shape), np.nan)
    stats, stop = np.zeros(3), ctypes.c_int(0)
    arguments = (
        *imposed_arguments(t, drive, load), doubles(p), doubles(start), count,
        len(by), integers(columns), integers(np.array(by or [-1], dtype=np.intc)), doubles(sensitivity_scale(p, by)), doubles(S0),
        ctypes.c_double(rtol_of_estimate(rtol)),
        doubles(np.asarray(atol) * rtol_of_estimate(rtol) / rtol),
        ctypes.c_long(MAX_STEPS),
        t.size, doubles(t), doubles(x), doubles(S), doubles(stats), ctypes.byref(stop),
    )  # fmt: skip
    try:
        filled = interruptible(lambda: library.srf_integrate(*arguments), stop)
    except KeyboardInterrupt:
        filled = int(np.isfinite(x).all(axis=1).sum())
        raise Stopped(Motion(x, S, Status.INTERRUPTED, float(t[max(filled - 1, 0)]), int(stats[0]))) from None
    status = Status.OK if filled == t.size else Status.INTEGRATION
    return Motion(x, S, status, float(stats[2]), int(stats[0]))


def pieces(t: Array, drive: Drive, load: Load) -> Iterator[tuple[float, float]]:
    """Yield the intervals between output's ends and the breaks of drive and load."""
    inside = (b for b in (*drive.breaks, *load.breaks) if t[0] < b < t[-1])
    yield from pairwise(np.unique([t[0], *inside, t[-1]]).tolist())


def imposed_arguments(t: Array, drive: Drive, load: Load) -> tuple[Any, ...]:
    """Return what compiled code is told of drive and load between the first and the last of the times `t`."""
    segments = list(pieces(t, drive, load))
    edges = np.array([segments[0][0], *(b for _, b in segments)])
    knots, coefficients = load.polynomials(float(edges[0]), float(edges[-1]))
    places = np.clip(np.searchsorted(knots, edges + 1e-12 * np.abs(edges).max(), side="right") - 1, 0, len(knots) - 2)
    low = places[:-1]
    high = np.clip(np.searchsorted(knots, edges[1:] - 1e-12 * np.abs(edges).max(), side="left"), low + 1, len(knots) - 1)
    ranges = np.column_stack([low, high])
    middle = np.array([drive.piece(0.5 * (a + b)) for a, b in segments], dtype=float)
    longest = np.minimum([load.longest_step(a, b) for a, b in segments], 1e300)
    return (
        len(segments), doubles(edges), doubles(middle), integers(ranges), doubles(longest),
        len(knots), coefficients.shape[1] - 1, doubles(knots), doubles(coefficients),
    )  # fmt: skip


def interruptible(call: Callable[[], int], stop: ctypes.c_int) -> int:
    """Return call(), which ends early once `stop` is set: by whatever a signal's handler raises, Ctrl-C as a rule.

    Python's handlers run in the main thread alone, and only between its own instructions: compiled code there would hold them up.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    answer: list[int] = []
    worker = threading.Thread(target=lambda: answer.append(call()), daemon=True)
    worker.start()
    try:
        while worker.is_alive():
            worker.join(SIGNAL_INTERVAL)
    except BaseException:
        stop.value = 1
        worker.join()  # the arrays it writes into are still its own
        raise
    return answer[0]


def sensitivity_scale(p: Array, by: Sequence[int]) -> Array:
    """Return, for each derivative, the unit of its absolute error: 1 over the parameter's size, 1 for an initial state."""
    return np.array([1.0 if i < 0 else 1.0 / max(abs(float(p[i])), 1e-12) for i in by] or [1.0])


def rtol_of_estimate(rtol: float) -> float:
    """Return the bound on the embedded estimate, which is of order 3 where the method is of order 5 (Hairer and Wanner, IV.8)."""
    return 0.1 * rtol ** (2 / 3)


def doubles(array: Array) -> ctypes.c_void_p:
    """Return a pointer to the array, or to a contiguous copy of doubles where it is none of these."""
    return np.ascontiguousarray(array, dtype=float).ctypes.data_as(ctypes.c_void_p)  # which keeps it alive


def integers(array: NDArray[Any]) -> ctypes.c_void_p:
    """Return a pointer to the array, or to a contiguous copy of C's ints where it is none of these."""
    return np.ascontiguousarray(array, dtype=np.intc).ctypes.data_as(ctypes.c_void_p)


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
    """Return what `integrate` returns, by LSODA; S is carried along as n k further unknowns."""
    n, k = start.size, len(by)
    y = np.full((t.size, n * (1 + k)), np.nan)
    y[0] = state = np.concatenate([start, S0.ravel()])
    loose = S_SHARE * rtol
    tolerance = np.concatenate([atol, (S_SHARE * np.outer(atol, sensitivity_scale(p, by)[:k])).ravel()])
    relative = np.concatenate([np.full(n, rtol), np.full(n * k, loose)])
    names = ("rates", "rates_jacobian", *(["rates_parameters"] if k else []))
    functions = [scalar_function(model, name, p) for name in names]
    status, reached, steps = Status.OK, float(t[0]), 0
    for a, b in pieces(t, drive, load):
        f, df = _on_piece(functions, np.array(by, dtype=int), drive, load, a, b)
        wanted = np.nonzero((t > a) & (t <= b))[0]
        times = np.unique([a, *t[wanted], b])
        found, good, count = _march(f, df if not k else None, state, times, relative, tolerance, load.longest_step(a, b))
        steps += count
        places = np.searchsorted(times, t[wanted])
        y[wanted[places < good]] = found[places[places < good]]
        reached, state = float(times[good - 1]), found[-1]
        if good < times.size:
            status = Status.INTEGRATION
            break
    return Motion(y[:, :n], y[:, n:].reshape(t.size, n, k), status, reached, steps)


def _on_piece(
    functions: Sequence[ScalarFunction], by: Array, drive: Drive, load: Load, begin: float, end: float
) -> tuple[Rates, Rates]:
    """Return the rates of state and sensitivities, and the Jacobian, as functions of (t, y) between two breaks of drive and load.

    `functions` of one state are the rates, their Jacobian and, where there are derivatives `by` parameters, these.
    """
    rates_of, jacobian_of, *by_parameters = functions
    W_at = load_of_one_time(load, begin, end)
    V0, acceleration, since = drive.piece(0.5 * (begin + end))

    def inputs(t: float) -> tuple[float, float, float]:
        return (V0 + acceleration * (t - since) if acceleration else V0, *W_at(t))

    def rates(t: float, y: Array) -> object:
        try:
            return rates_of(y.tolist(), *inputs(t))
        except (ArithmeticError, ValueError):
            return np.full(y.size, OVERFLOWN_RATE)

    def jacobian(t: float, y: Array) -> object:
        try:
            return jacobian_of(y.tolist(), *inputs(t))
        except (ArithmeticError, ValueError):
            return np.full((y.size, y.size), OVERFLOWN_RATE)

    def augmented(t: float, y: Array) -> object:
        n = y.size // (1 + by.size)
        x, given = y[:n].tolist(), inputs(t)
        try:
            direct = np.array(by_parameters[0](x, *given))[:, by] * (by >= 0)
            S_rate = np.array(jacobian_of(x, *given)) @ y[n:].reshape(n, by.size) + direct
            return np.concatenate([rates_of(x, *given), S_rate.ravel()])
        except (ArithmeticError, ValueError):
            return np.full(y.size, OVERFLOWN_RATE)

    return (augmented if by.size else rates), jacobian


def load_of_one_time(load: Load, begin: float, end: float) -> Callable[[float], tuple[float, float]]:
    """Return W and dW/dt on [begin, end] as a function of one time, in Python floats."""
    knots, coefficients = (array.tolist() for array in load.polynomials(begin, end))

    def found(t: float) -> tuple[float, float]:
        i = min(max(bisect_right(knots, t) - 1, 0), len(coefficients) - 1)
        return horner(coefficients[i], t - knots[i])

    return found


def _march(
    f: Rates, df: Rates | None, start: Array, times: Array, rtol: Array, atol: Array, longest: float
) -> tuple[Array, int, int]:
    """Return the unknowns (times, n), how many times were reached, and the number of steps."""
    from scipy.integrate import ODEintWarning, odeint

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", ODEintWarning)  # told by the status instead
        y, info = odeint(
            f, start, times, Dfun=df, tfirst=True, rtol=rtol, atol=atol, tcrit=[times[-1]],
            hmax=longest if math.isfinite(longest) else 0.0, mxstep=MAX_LSODA_STEPS, full_output=True,
        )  # fmt: skip
    steps = int(info["nst"][-1])
    if info["message"] == "Integration successful.":
        finite = np.isfinite(y).all(axis=1)
        return y, times.size if finite.all() else int(np.argmin(finite)), steps
    # LSODA's own clock `tcur` stands still at the output interval it failed in; what lies beyond is not filled
    failed = np.nonzero(info["tcur"] < times[1:])[0]
    return y, int(failed[0]) + 1 if failed.size else 1, steps


# Generated array functions turned into functions of one state: Python floats and `math`, an order of magnitude faster there.

_ALIASES = {"arctan": math.atan, "arcsinh": math.asinh}
_MATH = ("cos", "cosh", "exp", "expm1", "log", "log1p", "pi", "sin", "sinh", "sqrt", "tan", "tanh")

ScalarFunction = Callable[..., Any]


def scalar_function(model: GeneratedModel, name: str, p: Any) -> ScalarFunction:
    """Return generated function `name`, parameters `p` bound, as a function of one state and of what follows the state.

    The state is a sequence of floats; a vector comes back as a tuple, a matrix as a tuple of rows. Overflow and logarithms
    of nothing raise, as `math` does.
    """
    return _factory(model.source, name, len(model.names))([float(value) for value in p])


@lru_cache(maxsize=64)
def _factory(source: str, name: str, n: int) -> Callable[[list[float]], ScalarFunction]:
    namespace: dict[str, Any] = {f: getattr(math, f) for f in _MATH} | _ALIASES | {"lambertw": _lambertw}
    namespace |= dict(zip(("lut", "lut1", "lut2"), tables_after(n), strict=True))
    exec(compile(scalar_source(source, name), f"<scalar {name}>", "exec"), namespace)
    return namespace["bind"]


def _lambertw(x: float) -> float:
    from scipy.special import lambertw

    return float(lambertw(x).real)


def scalar_source(source: str, name: str) -> str:
    """Return the text of `bind(p)`, which returns the scalar form of function `name` of a generated module."""
    function = formulas_of(source, name)
    once: list[str] = []
    inside: list[str] = []
    fixed = {*_MATH, *_ALIASES, "lambertw", "p"}
    for step, value in function.steps:
        constant = all(n.id in fixed for n in ast.walk(value) if isinstance(n, ast.Name))
        (once if constant else inside).append(f"{step} = {ast.unparse(value)}")
        if constant:
            fixed.add(step)
    found = {place: ast.unparse(value) for place, value in function.entries.items()}
    entries = [found.get(place, "0.0") for place in range(math.prod(function.shape))]
    for width in function.shape[::-1]:  # the rows of a matrix, then the tuple of these; a number stays one
        entries = [f"({', '.join(entries[a : a + width])},)" for a in range(0, len(entries), width)]
    arguments = ", ".join(a for a in function.arguments if a != "p")
    lines = [
        *once,
        f"def {name}({arguments}):",
        *(f"    {line}" for line in inside),
        f"    return {entries[0]}",
        f"return {name}",
    ]
    return "def bind(p):\n" + "\n".join(f"    {line}" for line in lines) + "\n"
