"""One converged orbit with its multipliers at eps = 0.18: collocation against shooting with SciPy's integrators.

Timed, ours: `solve_orbits` from the linear response to the modulation (its cost included) to the converged periodic
state, and the eigenvalues of the monodromy matrix, on the smallest mesh (a multiple of 4 intervals) whose multipliers
are right to 1e-6, then 1e-8. Also `solve_floquet`, which finds its own mesh and estimates its own error.

Timed, the baseline: Newton's method on the period map from the state at tau = 0 of the same response, with the same
limit on the step and the same tolerance on the last one; each evaluation of the map integrates the orbit and its 16
variational equations in one system of 20 by `solve_ivp`, from the start of the period to its end, without dense
output. The rates, the Jacobian and the second derivatives are written by hand with scalar arithmetic (`math`, not
NumPy, where numbers are scalars), the variational part is one matrix product; Radau and LSODA are given the exact
Jacobian of all 20 equations. Variables, scaling and the scaled time are those of the collocation.

Equal accuracy: the error is the largest difference between the multipliers and those of a shot by DOP853 at rtol
3e-13. Each integrator gets the loosest of a ladder of tolerances (four to a decade) whose error is at most three
times ours: a looser one than equality asks for. Where the integrator's noise exceeds it, the tolerance on the last
Newton step is loosened for the baseline. Shooting needs more Newton steps than collocation from the same start; their
number is shown.

Not timed: loading the model, the choice of mesh and tolerance, the reference. Times are CPU seconds, one thread,
median of interleaved repeats; a point is taken on every branch of the boundary, just below its critical load.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import common  # before NumPy: it fixes the number of threads
import numpy as np
from brute import Slider, steady
from common import Report, interleaved, no_arguments, repeated
from scipy.integrate import solve_ivp

from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.laws.registry import load_registry
from srfcli.numerics.critical import critical_line
from srfcli.numerics.floquet import solve_floquet
from srfcli.numerics.orbit import forced_guess, solve_orbits, uniform_mesh

EPS = 0.18
VELOCITIES = (2.0, 7.0, 20.0, 60.0)
BRANCHES = (1, 3)  # the lower and the upper one, where there are two
BELOW = 0.99  # of the critical load
GOALS = (1e-6, 1e-8)  # error of the multipliers; the last Newton step of either method is below a tenth of it
LADDER = 10.0 ** -np.arange(2.0, 12.01, 0.25)
METHODS = ("Radau", "DOP853", "LSODA")
TARGET = 200.0
Matrix = np.ndarray


@dataclass(frozen=True)
class Equations:
    """The orbit and its variational equations, time in periods: y = (x, vec of the 4 x 4 derivative by the first state)."""

    s: Slider

    def rates(self, tau: float, y: Matrix) -> Matrix:
        """The 20 rates."""
        out = np.empty(20)
        rates, J, _ = self._local(tau, y)
        out[:4] = rates
        np.matmul(J, y[4:].reshape(4, 4), out=out[4:].reshape(4, 4))
        return out

    def jacobian(self, tau: float, y: Matrix) -> Matrix:
        """Their exact 20 x 20 Jacobian: J in every diagonal block, the second derivatives below the first."""
        _, J, (h11, h22, h23, h33, g23, g33) = self._local(tau, y)
        a, b = y[4:].reshape(4, 4)[2], y[4:].reshape(4, 4)[3]  # the derivatives of ln v and ln phi
        full = np.zeros((20, 20))
        full[:4, :4] = J
        full[4:, 4:] = np.kron(J, np.eye(4))
        full[8:12, 3] = h11 * b  # row z
        full[12:16, 2] = h22 * a + h23 * b  # row ln v
        full[12:16, 3] = h23 * a + h33 * b
        full[16:20, 2] = g23 * a  # row ln phi
        full[16:20, 3] = g33 * b
        return full

    def _local(self, tau: float, y: Matrix) -> tuple[tuple[float, ...], Matrix, tuple[float, ...]]:
        """Rates, Jacobian and the second derivatives that are not zero, per period."""
        s, T = self.s, 1 / self.s.f
        u, z, ln_v, ln_phi = y[:4].tolist()
        v, phi = math.exp(min(ln_v, 200.0)), math.exp(max(min(ln_phi, 200.0), -200.0))  # a trial step may be wild
        W = s.W0 * (1 + s.eps * math.cos(2 * math.pi * tau))
        r = s.Vsat * phi / s.D0
        mu = s.mu0 + s.A * (ln_v - math.log(s.V0)) + s.B * math.log1p(r)
        share = r / (1 + r)
        d1 = share * (1 - share)
        d2 = d1 * (1 - 2 * share)
        q, w, c = 1 / phi, v / s.D0, s.B / s.A
        ageing = q - w
        slip = (z - v) / (s.lam * s.A)
        rates = (T * (s.V - z), T * (s.K * u - W * mu) / s.M, T * (slip - c * share * ageing), T * ageing)
        m = T / s.M
        J = np.array(
            (
                (0.0, -T, 0.0, 0.0),
                (m * s.K, 0.0, -m * W * s.A, -m * W * s.B * share),
                (0.0, T / (s.lam * s.A), T * (c * share * w - v / (s.lam * s.A)), -T * c * (d1 * ageing - share * q)),
                (0.0, 0.0, -T * w, -T * q),
            )
        )
        second = (
            -m * W * s.B * d1,
            T * (c * share * w - v / (s.lam * s.A)),
            T * c * d1 * w,
            -T * c * (d2 * ageing - 2 * d1 * q + share * q),
            -T * w,
            T * q,
        )
        return rates, J, second


def one_period(equations: Equations, x: Matrix, method: str, rtol: float) -> tuple[Matrix, Matrix]:
    """Return the state after one period and its derivative by the first state."""
    size = np.array([1.0, equations.s.V, 1.0, 1.0])
    y = np.concatenate([x, np.diag(size).ravel()])
    atol = rtol * np.concatenate([size, np.repeat(size, 4)])
    extra = {} if method == "DOP853" else {"jac": equations.jacobian}
    end = solve_ivp(equations.rates, (0.0, 1.0), y, method=method, rtol=rtol, atol=atol, t_eval=(1.0,), **extra)
    if not end.success:
        raise ArithmeticError(end.message)
    y = end.y[:, -1]
    return y[:4], y[4:].reshape(4, 4) / size


def shoot(s: Slider, start: Matrix, method: str, rtol: float, tol: float) -> tuple[Matrix, Matrix, int]:
    """Return the periodic state, its multipliers and the number of Newton steps; the log variables' step is limited to 2."""
    equations, size = Equations(s), np.array([1.0, s.V, 1.0, 1.0])
    x, best = start.copy(), np.inf
    for count in range(1, 31):
        end, M = one_period(equations, x, method, rtol)
        step = np.linalg.solve(np.eye(4) - M, end - x)
        change = float(np.abs(step / size).max())
        x = x + step * min(1.0, 2.0 / float(np.abs(step[2:]).max() + 1e-300))
        if change < max(tol, 3 * rtol) or (change < 1e-4 and change > 0.5 * best):  # the integrator's noise is reached
            return x, np.linalg.eigvals(M), count
        best = min(best, change)
    raise ArithmeticError(f"no convergence, last step {change:.1e}")


def difference(a: Matrix, b: Matrix) -> float:
    """Return the largest distance between two sets of multipliers, the best order taken."""
    left, worst = list(b), 0.0
    for value in sorted(a, key=lambda q: -abs(q)):
        gaps = [abs(value - other) for other in left]
        worst = max(worst, min(gaps))
        left.pop(int(np.argmin(gaps)))
    return float(worst)


def ours(model: GeneratedModel, p: Matrix, intervals: int, goal: float) -> Matrix:
    """Return the multipliers by collocation from the linear response."""
    batch = solve_orbits(model, p, forced_guess(model, p, uniform_mesh(intervals)), tol=0.1 * goal)
    if not batch.converged.all():
        raise ArithmeticError("no convergence")
    return batch.multipliers[0]


def own_mesh(model: GeneratedModel, p: Matrix, reference: Matrix, goal: float) -> tuple[int, float]:
    """Return the smallest number of intervals that meets `goal`, and its error."""
    for intervals in range(12, 257, 4):
        try:
            error = difference(ours(model, p, intervals, goal), reference)
        except ArithmeticError:
            continue
        if error <= goal:
            return intervals, error
    raise SystemExit(f"no mesh of up to 256 intervals meets {goal:g}")


def loosest(s: Slider, start: Matrix, method: str, reference: Matrix, allowed: float, goal: float) -> tuple[float, float]:
    """Return the loosest rtol of the ladder whose error, from the converged orbit on, is at most `allowed`."""
    for rtol in LADDER[1.001e4 * goal >= LADDER]:
        try:
            error = difference(shoot(s, start, method, float(rtol), 0.1 * goal)[1], reference)
        except ArithmeticError:
            continue
        if error <= allowed:
            return float(rtol), error
    raise SystemExit(f"{method} does not reach {allowed:.1e}")


def compare(model: GeneratedModel, V: float, W0: float, crossing: int, goal: float, repeats: int) -> list[list[str]]:
    """Time one point; return the rows of the table."""
    s, p = Slider(V, W0, EPS), model.vector({"V": V, "W0": W0, "eps": EPS})[:, None]
    state, reference, _ = shoot(s, steady(s), "DOP853", 3e-13, tol=1e-9)
    intervals, error = own_mesh(model, p, reference, goal)
    rest = forced_guess(model, p, uniform_mesh(16)).x[0, 0]
    tasks: dict[str, Callable[[], object]] = {
        "ours": repeated(partial(ours, model, p, intervals, goal), 20),
        "floquet": repeated(partial(solve_floquet, model, p[:, 0], tol=goal), 20),
    }
    errors, notes = {"ours": error}, {"ours": f"N = {intervals}"}
    floquet = solve_floquet(model, p[:, 0], tol=goal)
    errors["floquet"], notes["floquet"] = (difference(floquet.multipliers, reference), f"N = {len(floquet.orbit.edges) - 1}")
    for method in METHODS:
        rtol, _ = loosest(s, state, method, reference, 3 * error, goal)
        while True:  # from the distant start the error may differ from that beside the orbit
            _, found, steps = shoot(s, rest, method, rtol, 0.1 * goal)
            errors[method] = difference(found, reference)
            if errors[method] <= 3 * error:
                break
            rtol *= 10**-0.25
        notes[method] = f"rtol {rtol:.1e}, {steps} Newton steps"
        tasks[method] = partial(shoot, s, rest, method, rtol, 0.1 * goal)
    seconds = interleaved(tasks, repeats)
    for name in ("ours", "floquet"):
        seconds[name] /= 20
    place = f"V = {V:g}, W0 = {W0:.3f} (below crossing {crossing})"
    return [
        [place, name, f"{1e3 * seconds[name]:.2f}", f"{errors[name]:.1e}", f"{seconds[name] / seconds['ours']:.0f}", notes[name]]
        for name in tasks
    ]


def main() -> None:
    """Compare on the branches of VELOCITIES and print one table for each goal."""
    no_arguments(__doc__)
    report = Report("orbit", __doc__)
    assert common.ROOT.exists()
    model = open_model(load_registry())
    places = []
    for V in VELOCITIES:
        points = critical_line(model, model.vector({"V": V, "eps": EPS}), lo=4.0, hi=400.0, tol=1e-6).points
        places += [(V, BELOW * points[k - 1].value(model, "W0"), k) for k in BRANCHES if k <= len(points)]
    for goal in GOALS:
        chosen = places if goal == GOALS[0] else places[3::3]  # the tighter one takes minutes a point
        rows = [row for place in chosen for row in compare(model, *place, goal, repeats=2)]
        report.say()
        report.say(f"multipliers to {goal:g}")
        report.table(("point (um/s, N)", "method", "CPU ms", "error of multipliers", "times ours", "with"), rows)
        for name in METHODS:
            values = [float(row[4]) for row in rows if row[1] == name]
            report.say(f"{name}: {min(values):.0f} to {max(values):.0f} times ours, median {np.median(values):.0f}")
        least = min(float(row[4]) for row in rows if row[1] == "Radau")
        verdict = "met" if least >= TARGET else f"MISSED, {least:.0f}"
        report.say(f"target: at least {TARGET:.0f} times faster than Radau at every point: {verdict}")


if __name__ == "__main__":
    main()
