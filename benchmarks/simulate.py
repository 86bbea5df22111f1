"""`srf simulate`'s integrator against LSODA, with a compiled right-hand side and with a lambdified one, at equal accuracy.

    python benchmarks/simulate.py

The paper's slider, four records: stick-slip under constant load, the onset of a modulation at 120 Hz, steps of the velocity,
and a hold of 100 s. Every method restarts where drive or load has a corner, and writes the same times.

    ours        srfcli.motion.integrators.integrate: Radau IIA compiled with the model's generated rates
    numbalsoda  LSODA in C++ with the paper's equations compiled by numba: nothing of Python runs between two output times
    odeint      SciPy's LSODA with the same function through Python, once a call; Jacobian compiled, too
    lambdified  solve_ivp(method="LSODA") on sympy's lambdified rates and Jacobian (modules="math": faster here than NumPy's)

The equations of all but ours are written by hand. Error: the largest of |u - u_exact| over the record's times, um; u_exact is
what `numbalsoda` gives at rtol 1e-13, and is itself in doubt by its distance from `ours` at 1e-11, which is told. CPU seconds
without compilation, methods in turn, medians. Each method runs at several tolerances; the time at a given error lies on the
straight line between two of them in log time over log error. Without numbalsoda (its installation needs a Fortran compiler) that
row is left out, and the exact solution is LSODA's own through odeint.
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from brute import Slider, steady
from common import Report, interleaved, no_arguments

from srfcli.codegen.model import open_model
from srfcli.laws.registry import load_registry
from srfcli.motion.imposed import ConstantLoad, Drive, Load, Modulation
from srfcli.motion.integrators import integrate, pieces

Array = np.ndarray
TOLERANCES = {
    "ours": (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10),
    "numbalsoda": (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11),
    "odeint": (1e-5, 1e-7, 1e-9, 1e-11),
    "lambdified": (1e-5, 1e-7, 1e-9, 1e-11),
}
ERRORS = (1e-5, 1e-6, 1e-7)
REPEATS = 5
NAMES = ("K", "M", "mu0", "A", "B", "D0", "V0", "Vsat", "lam")


@dataclass(frozen=True)
class Record:
    """What is imposed, and at which times the motion is wanted; it begins in steady sliding at the first velocity under W0."""

    name: str
    drive: Drive
    load: Load
    t: Array
    W0: float

    def start(self) -> Array:
        """Return the state at t[0]."""
        return steady(Slider(self.drive.piece(0.0)[0], self.W0, 0.0))


RECORDS = (
    Record("stick-slip", Drive.steps([(0, 12.0), (0.5, 8.0)]), ConstantLoad(9.0), np.linspace(0, 4, 1001), 9.0),
    Record("onset of 120 Hz", Drive.constant(8.0), Modulation(9.0, 0.09, 120.0, 0.5), np.linspace(0, 2, 2001), 9.0),
    Record("steps", Drive.steps([(0, 5.0), (1, 20.0), (2, 5.0), (3.5, 50.0)]), ConstantLoad(5.0), np.linspace(0, 6, 1501), 5.0),
    Record("hold of 100 s", Drive.steps([(0, 10.0), (1, 0.0), (101, 10.0)]), ConstantLoad(5.0), np.linspace(0, 105, 1051), 5.0),
)  # fmt: skip


def constants() -> Array:
    """Return the slider's parameters in the order of NAMES."""
    slider = Slider(1.0, 1.0, 0.0)
    return np.array([getattr(slider, name) for name in NAMES])


def piece_data(record: Record, a: float, b: float) -> Array:
    """Return what the rates need on the smooth piece [a, b]: parameters, V, W0, amplitude, f, onset, length of the rise."""
    load, middle = record.load, 0.5 * (a + b)
    wave = [record.W0, 0.0, 1.0, 0.0, 0.0]
    if isinstance(load, Modulation) and middle > load.onset:
        wave = [load.W0, load.eps, load.f, load.onset, load.full - load.onset if middle < load.full else 0.0]
    return np.concatenate([constants(), [record.drive.piece(middle)[0]], wave])


def load_at(t: float, d: Array) -> float:
    """Return the normal load; the rise has two continuous derivatives."""
    share = 1.0
    if d[14] > 0.0:
        r = (t - d[13]) / d[14]
        share = r * r * r * (10.0 - 15.0 * r + 6.0 * r * r)
    return d[10] * (1.0 + share * d[11] * math.cos(2.0 * math.pi * d[12] * t))


def symbolic() -> tuple[list[Any], list[Any]]:
    """Return (arguments, rates) of the paper's equations in sympy: u, z, ln v, ln phi, V, W and the constants."""
    import sympy as sp

    u, z, q, s, V, W = sp.symbols("u z q s V W")
    K, M, mu0, A, B, D0, V0, Vsat, lam = constant = sp.symbols(" ".join(NAMES))
    v, phi = sp.exp(q), sp.exp(s)
    mu = mu0 + A * (q - sp.log(V0)) + B * sp.log(1 + Vsat * phi / D0)
    ageing = 1 - v * phi / D0
    slip = (z - v - lam * B * Vsat * ageing / (D0 * (1 + Vsat * phi / D0))) / (lam * A)
    return [(u, z, q, s), V, W, *constant], [V - z, (K * u - W * mu) / M, slip, ageing / phi]


def lambdified() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the rates and their Jacobian as sympy writes them for Python's math."""
    import sympy as sp

    arguments, rates = symbolic()
    jacobian = tuple(tuple(row) for row in sp.Matrix(rates).jacobian(arguments[0]).tolist())
    return sp.lambdify(arguments, tuple(rates), "math", cse=True), sp.lambdify(arguments, jacobian, "math", cse=True)


def _numba() -> Any:
    """Return numba, imported with this folder out of the way: it would take `coverage.py` here for the package of that name."""
    path, sys.path = sys.path, [p for p in sys.path if Path(p or ".").resolve() != Path(__file__).resolve().parent]
    try:
        return importlib.import_module("numba")
    finally:
        sys.path = path


class Methods:
    """The four ways to the motion of a record, everything compiled once."""

    def __init__(self) -> None:
        numba = _numba()
        self.model = open_model(load_registry())
        self.rates, self.jacobian = lambdified()
        f, df, W_at = numba.njit(self.rates), numba.njit(self.jacobian), numba.njit(load_at)
        self.compiled, self.compiled_jacobian = (numba.njit(as_array(g, W_at, n)) for g, n in ((f, 1), (df, 4)))
        self.lsoda, self.address = self._numbalsoda(f, W_at, numba)

    @staticmethod
    def _numbalsoda(f: Any, W_at: Any, numba: Any) -> tuple[Any, int]:
        try:
            from numbalsoda import lsoda, lsoda_sig
        except (ImportError, OSError):
            return None, 0

        @numba.cfunc(lsoda_sig)
        def rhs(t, x, dx, data):  # type: ignore[no-untyped-def]
            d = numba.carray(data, (15,))
            y = (x[0], x[1], x[2], x[3])
            rate = f(y, d[9], W_at(t, d), d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7], d[8])
            for i in range(4):
                dx[i] = rate[i]

        Methods._kept = rhs  # its address must not outlive it
        return lsoda, rhs.address

    def run(self, method: str, record: Record, rtol: float) -> Array:
        """Return the states (times, 4) by a method at this relative tolerance; NaN from where it failed."""
        if method == "ours":
            p = self.model.vector({"V": record.drive.piece(0.0)[0], "W0": record.W0})
            atol = rtol * np.ones(4)
            return integrate(
                self.model, p, drive=record.drive, load=record.load, t=record.t, start=record.start(), rtol=rtol, atol=atol
            ).x
        x = np.full((record.t.size, 4), np.nan)
        x[0] = state = record.start()
        for a, b in pieces(record.t, record.drive, record.load):
            wanted = np.nonzero((record.t > a) & (record.t <= b))[0]
            times = np.unique([a, *record.t[wanted], b])
            found = self._piece(method, state, times, piece_data(record, a, b), rtol)
            x[wanted] = found[np.searchsorted(times, record.t[wanted])]
            state = found[-1]
        return x

    def _piece(self, method: str, start: Array, times: Array, d: Array, rtol: float) -> Array:
        if method == "numbalsoda":
            found, good = self.lsoda(self.address, start, times, d, rtol, rtol, 10_000_000)
            return found if good else np.full_like(found, np.nan)
        if method == "odeint":
            from scipy.integrate import odeint

            return odeint(self.compiled, start, times, (d,), Dfun=self.compiled_jacobian, tfirst=True, rtol=rtol, atol=rtol,
                          hmax=0.25 / d[12] if d[11] else 0.0, mxstep=10_000_000)  # fmt: skip
        from scipy.integrate import solve_ivp

        rates, jacobian, V, constant = self.rates, self.jacobian, d[9], d[:9].tolist()
        return solve_ivp(
            lambda t, x: rates(x, V, load_at(t, d), *constant), (times[0], times[-1]), start, "LSODA", times,
            jac=lambda t, x: jacobian(x, V, load_at(t, d), *constant), rtol=rtol, atol=rtol,
            max_step=0.25 / d[12] if d[11] else np.inf,
        ).y.T  # fmt: skip


def as_array(g: Any, W_at: Any, columns: int) -> Any:
    """Return (t, x, d) -> g's tuple as an array, as text in which every index is a number: numba types a tuple no other way."""
    constant = ", ".join(f"d[{i}]" for i in range(len(NAMES)))
    lines = ["def of(t, x, d):", f"    r = g((x[0], x[1], x[2], x[3]), d[9], W_at(t, d), {constant})"]
    lines.append(f"    out = np.empty({'4' if columns == 1 else '(4, 4)'})")
    for i in range(4):
        lines += [f"    out[{i}, {j}] = r[{i}][{j}]" for j in range(4)] if columns > 1 else [f"    out[{i}] = r[{i}]"]
    space: dict[str, Any] = {"g": g, "W_at": W_at, "np": np}
    exec("\n".join([*lines, "    return out"]), space)
    return space["of"]


def at_error(times: Array, errors: Array, wanted: float) -> float:
    """Return the time at which the error is as wanted, between two measured ones in logarithms; NaN beyond what was measured."""
    order = np.argsort(errors)
    if not errors.min() <= wanted <= errors.max():
        return math.nan
    return float(np.exp(np.interp(np.log(wanted), np.log(errors[order]), np.log(times[order]))))


def measure(report: Report, methods: Methods, record: Record) -> dict[str, tuple[Array, Array]]:
    """Say errors and times of every method on one record; return them as method -> (times, errors)."""
    names = [name for name in TOLERANCES if name != "numbalsoda" or methods.lsoda is not None]
    best = "numbalsoda" if methods.lsoda is not None else "odeint"
    exact = methods.run(best, record, 1e-13)[:, 0]
    doubt = np.abs(methods.run("ours", record, 1e-11)[:, 0] - exact).max()
    report.say()
    report.say(f"{record.name}: {record.t[-1]:g} s, {record.t.size} times; exact to {doubt:.0e} um")
    rows, found = [], {}
    tasks = {(name, rtol): partial(methods.run, name, record, rtol) for name in names for rtol in TOLERANCES[name]}
    quick = {f"{n} {r:g}": task for (n, r), task in tasks.items() if n in ("ours", "numbalsoda")}
    slow = {f"{n} {r:g}": task for (n, r), task in tasks.items() if n not in ("ours", "numbalsoda")}
    seconds = interleaved(quick, REPEATS) | interleaved(slow, 1)
    for name in names:
        times = np.array([seconds[f"{name} {rtol:g}"] for rtol in TOLERANCES[name]])
        errors = np.array([np.abs(tasks[name, rtol]()[:, 0] - exact).max() for rtol in TOLERANCES[name]])
        found[name] = times, errors
        rows += [
            [name, f"{rtol:.0e}", f"{1e3 * s:.1f}", f"{e:.1e}"]
            for rtol, s, e in zip(TOLERANCES[name], times, errors, strict=True)
        ]
    report.table(["method", "rtol", "CPU (ms)", "error of u (um)"], rows)
    return found


def main() -> None:
    """Print times and errors, then the ratios at equal error."""
    no_arguments(__doc__)
    report = Report("simulate", __doc__ or "")
    methods = Methods()
    if methods.lsoda is None:
        report.say("# numbalsoda is not installed: no row for LSODA without Python")
    ratios = []
    for record in RECORDS:
        found = measure(report, methods, record)
        for error in ERRORS:
            ours = at_error(*found["ours"], error)
            others = [f"{at_error(*found[name], error) / ours:.2f}" if name in found else "-" for name in list(TOLERANCES)[1:]]
            ratios.append([record.name, f"{error:.0e}", f"{1e3 * ours:.1f}", *others])
    report.say()
    report.say("At equal error: milliseconds of ours, and how many times as long the others take (nan: an error not measured)")
    report.table(["record", "error (um)", "ours (ms)", *list(TOLERANCES)[1:]], ratios)


if __name__ == "__main__":
    main()
