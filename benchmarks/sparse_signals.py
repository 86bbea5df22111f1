"""What `sparse_regression.py` regresses: smoothed recordings with derivatives, and the friction that they leave unexplained.

The law's equation read backwards. From the gauge's u(t) and its derivatives follow the block's velocity, the friction force, the
interface's stretch and so the slip velocity v; the age follows from v by integrating the ageing law; what is left of friction,
r = F/W - mu(v, phi), is linear in the size of whatever is missing, to first order. Sizes of effects, and the baseline's own
parameters, are entries of one mapping by name: a column of the regression is -dr/d(size).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import make_interp_spline

from srfcli.codegen.model import GeneratedModel
from srfcli.data.values import Experiment, Run
from srfcli.inference.prediction import effect_inputs, predict

Array = np.ndarray
Sizes = Mapping[str, float]
REACH = (2, 3, 5, 8, 13, 20, 32)  # half-widths of the windows, in samples, where the load is not modulated
PERIODS = (1.5, 3.0, 5.0)  # the same in periods of the modulation, where it is
LATE = 0.06  # s before its onset to its beginning: the switch-on takes 0.02 s
HARMONICS = 2  # of the modulation, below 0.9 of the Nyquist frequency
CUBIC, BENT = 3, 2.0  # degree of the local polynomials; how many standard errors two windows may differ by
EXCESS = 2.0  # standard errors of a window's mean square by which it may exceed the noise
DERIVATIVES = 5  # u and four derivatives
CLOSE = 15.0  # times the noise: rms distance of a motion that is near
FINE = 8  # points of a motion to a sample, for its derivatives
SURE = 0.3  # largest standard error of v over v that is used
ASIDE = 2  # samples beside one that is not usable
SLOWEST = 0.02  # um/s: below it v = V - u' is noise
LONGEST = 30.0  # slip lengths in one go, when ages are integrated
SPREAD_LOAD = 7.0  # N, of the stiffness's exponent


@dataclass(frozen=True)
class Window:
    """A local basis of polynomials and harmonics over `half` samples to either side, fitted to n samples by `solve` (k, n)."""

    half: int
    step: float
    omega: float
    solve: Array
    left: Array  # (n, k) orthonormal, what the basis spans
    spread: Array  # (k, k) covariance of the coefficients

    def at(self, places: Array) -> Array:
        """Return the rows (m, 5, k) that give value and derivatives at `places`, in samples off the centre."""
        return basis(places, self.step, self.omega, self.half).transpose(1, 0, 2)


def basis(places: Array, step: float, omega: float, half: int) -> Array:
    """Return (5, n, k): value and four derivatives in s of the local functions at `places`, in samples off the centre."""
    scale = half * step
    x = places * step / scale
    polynomials = []
    for power in range(CUBIC + 1):
        rows, factor = [], 1.0
        for order in range(DERIVATIVES):
            rows.append(factor * x ** (power - order) / scale**order if order <= power else np.zeros_like(x))
            factor *= power - order
        polynomials.append(rows)
    harmonics = []
    top = min(HARMONICS, int(0.9 * np.pi / step / omega)) if omega else 0
    for multiple, swelling in [*((m, False) for m in range(1, top + 1)), *([(1, True)] if top else [])]:
        turn = 1j * multiple * omega
        wave = np.exp(turn * places * step)
        rows_ = [turn**n * wave for n in range(DERIVATIVES)]
        if swelling:  # x exp(i w t), of which the n-th derivative has two terms
            rows_ = [x * rows_[n] + (n * turn ** (n - 1) * wave / scale if n else 0.0) for n in range(DERIVATIVES)]
        harmonics += [[r.real for r in rows_], [r.imag for r in rows_]]
    return np.array([*polynomials, *harmonics]).transpose(1, 2, 0)


def window(half: int, step: float, omega: float, *, lag1: float) -> Window:
    """Return the window of a half-width, for noise of this correlation between neighbours."""
    places = np.arange(-half, half + 1.0)
    B = basis(places, step, omega, half)[0]
    left, _ = np.linalg.qr(B)
    solve = np.linalg.pinv(B)
    R = lag1 ** np.abs(places[:, None] - places[None, :]) if lag1 > 0 else np.eye(places.size)
    return Window(half, step, omega, solve, left, solve @ R @ solve.T)


def estimates(y: Array, w: Window) -> tuple[Array, Array, Array]:
    """Return derivatives (5, n), their covariance (n, 5, 5) in units of the noise's variance, and each window's mean square.

    Near an end the window stays inside, and the place looked at is off its centre.
    """
    n, size = y.size, 2 * w.half + 1
    middle = float(y.mean())
    pieces = np.lib.stride_tricks.sliding_window_view(y - middle, size)
    coefficients = pieces @ w.solve.T
    rest = np.maximum(np.sum(pieces**2, axis=1) - np.sum((pieces @ w.left) ** 2, axis=1), 0.0)
    freedom = size - w.solve.shape[0]
    centre = np.clip(np.arange(n), w.half, n - 1 - w.half)
    off = np.arange(n) - centre
    places, which = np.unique(off, return_inverse=True)
    rows = w.at(places.astype(float))
    found = np.einsum("ndk,nk->dn", rows[which], coefficients[centre - w.half])
    found[0] += middle
    shapes = rows @ w.spread @ rows.transpose(0, 2, 1)
    return found, shapes[which], rest[centre - w.half] / max(freedom, 1)


def smoothed(y: Array, windows: list[Window], *, noise: float) -> tuple[Array, Array, Array]:
    """Return derivatives (5, n) by the widest window that agrees with all narrower ones, covariance, and where none fits.

    A window agrees while its mean square is the noise's, and its first derivative lies in the intersection of the confidence
    intervals of those before (Goldenshluger and Nemirovski 1997).
    """
    best, cov, bad = (np.zeros((DERIVATIVES, y.size)), np.zeros((y.size, DERIVATIVES, DERIVATIVES)), np.ones(y.size, bool))
    low, high, going = np.full(y.size, -np.inf), np.full(y.size, np.inf), np.ones(y.size, bool)
    for w in windows:
        if 2 * w.half + 1 > y.size:
            break
        found, spread, square = estimates(y, w)
        error = BENT * noise * np.sqrt(spread[:, 1, 1])
        low, high = np.maximum(low, found[1] - error), np.minimum(high, found[1] + error)
        freedom = max(2 * w.half + 1 - w.solve.shape[0], 1)
        fits = square <= noise**2 * (1 + EXCESS * np.sqrt(2 / freedom))
        going &= (low <= high) & (fits | (w.half <= windows[0].half))
        best[:, going], cov[going] = found[:, going], spread[going]
        bad[going] = ~fits[going]
    return best, cov, bad


@dataclass(frozen=True)
class Signals:
    """One run, smoothed: u and derivatives (5, n), their covariance (n, 5, 5) in um^2, what was imposed, and what is usable."""

    name: str
    holdout: bool
    t: Array
    u: Array
    lead: Array  # (5, n): the motion that is near, else u
    covariance: Array
    usable: Array
    V: Array
    stage: Array
    W: Array
    W_rate: Array
    W_bend: Array
    second: Array  # (4, n): cosine and sine of the load's second harmonic in N, and their rates
    modulated: bool
    K: float
    begin: float


def signals(run: Run, *, noise: float, lag1: float, guide: Array | None = None) -> Signals:
    """Return what a run is when it has been smoothed; each stretch between steps of the drive for itself.

    `guide` (5, n) is u and derivatives of a motion known without noise. Where it is near, the distance from it is smoothed:
    under a modulation v is a train of pulses, and a gauge at ten samples a period does not show them.
    """
    step, t = float(np.median(np.diff(run.t))), run.t
    about = effect_inputs(run)
    modulated, omega = bool(about["modulated"]), 2 * np.pi * about["f"]
    cuts = [0, *np.searchsorted(t, np.array(run.drive.breaks) - 1e-9).tolist(), t.size]
    if modulated:
        cuts.append(int(np.searchsorted(t, about["onset0"] - LATE)))
    u, cov, bad = np.zeros((DERIVATIVES, t.size)), np.zeros((t.size, DERIVATIVES, DERIVATIVES)), np.ones(t.size, bool)
    lead = np.zeros_like(u)
    for a, b in pairwise(sorted(set(cuts))):
        turning = modulated and t[a] >= about["onset0"] - LATE - step
        halves = [round(p * 2 * np.pi / omega / step / 2) for p in PERIODS] if turning else list(REACH)
        if turning:
            halves = [max(h, 8) for h in halves]
        if not turning and step < 0.003:
            halves += [50, 80]
        windows = [window(h, step, omega if turning else 0.0, lag1=lag1) for h in halves]
        if b - a > 2 * windows[0].half:
            y, near = run.observed[a:b], np.zeros((DERIVATIVES, b - a))
            if guide is not None and np.sqrt(np.mean((y - guide[0, a:b]) ** 2)) < CLOSE * noise:
                near = guide[:, a:b]
            u[:, a:b], cov[a:b], bad[a:b] = smoothed(y - near[0], windows, noise=noise)
            u[:, a:b] += near
            lead[:, a:b] = near if near.any() else u[:, a:b]
    W, W_rate = run.load(t)
    V = run.drive(t)
    height, angle = run.load.rest(float(t[0])) * about["eps"], 2 * (omega * t + about["psi"])
    envelope = 0.5 * (1 + np.tanh((t - about["onset0"]) / about["rise0"])) if modulated else np.zeros_like(t)
    wave = [height * envelope * f(angle) for f in (np.cos, np.sin)]
    stage = np.concatenate([[0.0], np.cumsum(V[:-1] * np.diff(t))])
    return Signals(
        run.name, run.holdout, t, u, lead, cov * noise**2, run.used & ~bad, V, stage, W, W_rate, np.gradient(W_rate, t),
        np.array([*wave, -2 * omega * wave[1], 2 * omega * wave[0]]), modulated, run.stiffness, run.load.rest(float(t[0])),
    )  # fmt: skip


def guided(model: GeneratedModel, experiment: Experiment, run: Run, values: Sizes) -> Array | None:
    """Return u (5, n) in um with four derivatives of the motion that a model gives a run; None where it cannot be followed."""
    n, parts = run.t.size, []
    fine = np.interp(np.arange((n - 1) * FINE + 1) / FINE, np.arange(n), run.t)
    dense = replace(run, t=fine, observed=np.zeros(fine.size), used=np.ones(fine.size, bool))
    x = predict(model, experiment, dense, values, rtol=1e-9)
    if not np.isfinite(x.y).all() or x.y.size < fine.size:
        return None
    fast = -x.x[:, model.states.index("z")] if "z" in model.states else None
    cuts = [0, *np.searchsorted(fine, np.array(run.drive.breaks) - 1e-9).tolist(), fine.size]
    for a, b in pairwise(sorted(set(cuts))):  # V may jump between them
        rate = None if fast is None else make_interp_spline(fine[a:b], fast[a:b] + run.drive(fine[a:b]), 5)
        place = make_interp_spline(fine[a:b], x.y[a:b], 5)
        own = fine[a:b][(-a) % FINE :: FINE]
        slopes = [place(own, k) if rate is None or k == 0 else rate(own, k - 1) for k in range(DERIVATIVES)]
        parts.append(np.array(slopes))
    return np.concatenate(parts, axis=1)


@dataclass(frozen=True)
class Baseline:
    """What an experiment states of its model: mass in N s^2/um (0: none), elastic interface or rigid, a cut-off of age."""

    mass: float
    elastic: bool
    cut: bool

    @classmethod
    def of(cls, experiment: Experiment) -> Baseline:
        """Return the baseline of an experiment."""
        choice = experiment.choice
        mass = float(experiment.mass or 0.0) if choice.inertia else 0.0
        return cls(mass, choice.interface == "elastic", choice.law != "dieterich-ruina")

    @property
    def free(self) -> tuple[str, ...]:
        """Return the names of its parameters."""
        return ("mu0", "A", "B", "D0", *(("Vsat",) if self.cut else ()), *(("lambda",) if self.elastic else ()))


@dataclass(frozen=True)
class Inverse:
    """Friction read backwards: residual r (n,), its standard error, slip velocity in um/s, slip in um, what is usable."""

    r: Array
    error: Array
    v: Array
    slip: Array
    usable: Array


def inverse(s: Signals, base: Baseline, p: Sizes) -> Inverse:
    """Return what friction is left in a run, given the baseline's parameters and sizes of effects; absent ones are neutral."""
    get = p.get
    u = s.u if not get("sensor-lag") else s.u + p["sensor-lag"] * np.vstack([s.u[1:], np.zeros_like(s.t)])
    V, V_rate, V_bend = driven(s, p)
    M, K = base.mass + get("inertia", 0.0), s.K * (1 + get("stiffness-error", 0.0))
    z, z_rate, z_bend = V - u[1], V_rate - u[2], V_bend - u[3]
    aside, aside_rate = (-get("tangential-crosstalk", 0.0) * x for x in (s.W - s.begin, s.W_rate))
    F, F_rate = K * u[0] + aside - M * z_rate, K * u[1] + aside_rate - M * z_bend
    W, W_rate = felt(s, p)
    lam, n = p.get("lambda", 0.0) + get("interface-compliance", 0.0), 1 + get("stiffness-exponent", 0.0)
    yields = lam / SPREAD_LOAD * (W / SPREAD_LOAD) ** -n  # um/N
    e, e_rate = F * yields, F_rate * yields - n * F * yields * W_rate / W
    v = z - e_rate
    slip = np.concatenate([[0.0], np.cumsum(0.5 * (V[1:] + V[:-1]) * np.diff(s.t))]) - (u[0] - u[0, 0]) - (e - e[0])
    weight = W + get("adhesion-offset", 0.0)
    fast = np.maximum(v, SLOWEST)
    r = F / weight - friction(s, base, p, fast=fast, v=v, slip=slip, W=W, W_rate=W_rate)
    # how noise of u and of its derivatives enters r: directly, and through v
    steep = p["A"] / fast
    none = np.zeros_like(W)
    into_v = np.array([none, 1 + yields * K, none, yields * M, none])  # of -v; u' < 0 is faster
    into = steep * into_v + np.array([K / weight, none, M / weight, none, none])
    error, error_v = (np.sqrt(np.maximum(np.einsum("dn,nde,en->n", c, s.covariance, c), 1e-300)) for c in (into, into_v))
    sure = (v > SLOWEST) & (error_v < SURE * fast)
    lost = ~s.usable if s.modulated else ~s.usable | ~sure  # pulses of v under a modulation are a few samples long
    usable = sure & (np.convolve(lost, np.ones(2 * ASIDE + 1), "same") == 0)  # the neighbours are doubtful
    usable[:ASIDE] = usable[-ASIDE:] = False
    return Inverse(r, error, v, slip, usable)


def driven(s: Signals, p: Sizes) -> tuple[Array, Array, Array]:
    """Return the stage's velocity and two derivatives; a lead screw's ripple follows the nominal displacement."""
    a, b = p.get("drive-ripple.cos", 0.0), p.get("drive-ripple.sin", 0.0)
    if not a and not b:
        return s.V, np.zeros_like(s.V), np.zeros_like(s.V)
    k = 2 * np.pi / p["drive-ripple.pitch"]
    c, d = a * np.cos(k * s.stage) + b * np.sin(k * s.stage), b * np.cos(k * s.stage) - a * np.sin(k * s.stage)
    return s.V * (1 + c), s.V**2 * k * d, -(s.V**3) * k**2 * c


def felt(s: Signals, p: Sizes) -> tuple[Array, Array]:
    """Return the load on the asperities and its rate."""
    if not s.modulated:
        return s.W, s.W_rate
    rho = 1 + p.get("load-transmission", 0.0)
    a, b = p.get("load-distortion.cos", 0.0), p.get("load-distortion.sin", 0.0)
    return (s.begin + rho * (s.W - s.begin) + a * s.second[0] + b * s.second[1],
            rho * s.W_rate + a * s.second[2] + b * s.second[3])  # fmt: skip


def friction(s: Signals, base: Baseline, p: Sizes, *, fast: Array, v: Array, slip: Array, W: Array, W_rate: Array) -> Array:
    """Return the friction coefficient that law and effects give for a sliding that is known."""
    get, D0 = p.get, p["D0"]
    phi = age(s.t, slip, D0, v0=float(s.V[0]), shrink=get("linker-dieterich", 0.0) / p["B"] * W_rate / W,
              share=get("slip-evolution", 0.0))  # fmt: skip
    x = np.log(fast)  # V0 is 1 um/s
    grown = np.log1p(p["Vsat"] * phi / D0) if base.cut else np.log(phi / D0)
    mu = p["mu0"] + p["A"] * x + p["B"] * grown
    mu = mu + p["B"] * np.log1p(max(get("age-saturation", 0.0), -1e-2) * D0 / phi)
    mu = mu + get("log-log-coupling", 0.0) * x * grown + get("viscous-drag", 0.0) * fast
    for name in ADDED:
        more = added(s, p, name, slip=slip) if get(name) else None
        if more is not None:
            mu = mu + p[name] * more
    return np.asarray(mu)


def age(t: Array, slip: Array, D: float, *, v0: float, shrink: Array, share: float) -> Array:
    """Return the age (n,) in s from steady sliding: exact between samples, over each of which v is taken as constant.

    phi' = (1 - share) (1 - q) - share q ln q - shrink phi, q = v phi/D.
    """
    h, x = np.diff(t), np.diff(slip) / D
    decay = np.clip(x + 0.5 * (shrink[1:] + shrink[:-1]) * h, -LONGEST, LONGEST)
    grow = h * np.where(np.abs(decay) < 1e-9, 1.0, -np.expm1(-decay) / np.where(decay == 0, 1.0, decay))
    first = D / max(v0, SLOWEST)
    if not share:
        return np.maximum(_carried(first, decay, grow), 1e-6)
    phi, rate = [first], np.maximum(x / h, 1e-4)
    for keep, gained, old, w in zip(np.exp(-decay).tolist(), grow.tolist(), np.exp(-np.maximum(x, 0.0)).tolist(),
                                    rate.tolist(), strict=True):  # fmt: skip
        slid = w ** (old - 1) * phi[-1] ** old  # the slip law's ln(v phi/D) dies out as exp(-v t/D)
        phi.append(max((1 - share) * (phi[-1] * keep + gained) + share * slid, 1e-6))
    return np.array(phi)


def _carried(first: float, decay: Array, grow: Array) -> Array:
    """Return x (n + 1,) of x[k + 1] = x[k] exp(-decay[k]) + grow[k], in blocks over which exp does not overflow."""
    block = (np.maximum.accumulate(np.cumsum(decay)) / LONGEST).astype(int)
    edges = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), decay.size]
    parts = [np.array([first])]
    for a, b in pairwise(edges):
        total = np.cumsum(decay[a:b])
        parts.append(np.exp(-total) * (parts[-1][-1] + np.cumsum(grow[a:b] * np.exp(total))))
    return np.concatenate(parts)


def columns(s: Signals, base: Baseline, p: Sizes, names: Sequence[str], *, residual: bool = True) -> tuple[Inverse, Array]:
    """Return what is left in a run, and (n, k) how much of it each parameter or size would explain, -dr/d(size).

    Columns, errors and what is usable come from the motion that is near: with v's noise in both, columns would explain noise.
    Without `residual` what is left is that of this motion, too, which is all that columns need.
    """
    lead, out = replace(s, u=s.lead), []
    here = inverse(lead, base, p)
    for name in names:
        h = STEPS.get(name, 1e-4) if name not in base.free else 1e-4 * abs(p[name])
        direct = added(s, p, name, slip=here.slip)
        if direct is None:
            direct = (here.r - inverse(lead, base, {**p, name: p.get(name, 0.0) + h}).r) / h
        out.append(direct)
    if residual:
        here = replace(here, r=inverse(s, base, p).r)
    return here, np.column_stack(out) if out else np.zeros((s.t.size, 0))


def added(s: Signals, p: Sizes, name: str, *, slip: Array) -> Array | None:
    """Return what an effect adds to mu for each unit of its size (n,), where that depends on slip and time alone; else None."""
    if name.startswith("track-topography"):
        wave = np.cos if name.endswith("cos") else np.sin
        return np.asarray(wave(2 * np.pi / p["track-topography.wavelength"] * slip))
    if name.startswith("friction-drift"):
        clock = slip if name.endswith("slip") else s.t - s.t[0]
        return np.asarray(np.maximum(clock - p[f"{name}.onset"], 0.0))
    if name == "second-state":
        length = p["second-state.D2"]
        phi = age(s.t, slip, length, v0=float(s.V[0]), shrink=np.zeros_like(slip), share=0.0)
        return np.asarray(np.log(phi / length))
    return None


ADDED = ("second-state", "friction-drift", "friction-drift-slip", "track-topography.cos", "track-topography.sin")
STEPS = {"inertia": 1e-8, "viscous-drag": 1e-6, "age-saturation": 1e-5, "slip-evolution": 1e-3}  # of a difference; others 1e-4
