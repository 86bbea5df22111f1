"""A concealed slider: what moves it, the track it slides on, and its run by equations and a solver of its own.

The stretch e of the interface is a state, the friction force is kappa e, and the slip velocity follows by inverting
mu(v, phi) = F/W. Plain scalar functions; nothing here is shared with the equations that are fitted.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from scipy.integrate import ode
from scipy.optimize import brentq

# Rough tracks: a friction coefficient that wanders with position, the same for all runs of a case.

KNOTS_APART = 0.1  # correlation lengths between knots


@dataclass(frozen=True)
class Track:
    """The deviation of mu0 along a track: a Gaussian process of standard deviation `size` and correlation length `length` (um).

    `seed` fixes it; its correlation is (1 + r) exp(-r), r = distance/length, that of a rough but differentiable profile.
    Where it is each run's `own`, the slider is set down anew before each.
    """

    size: float = 0.0
    length: float = 10.0
    seed: int = 0
    own: bool = False

    def under(self, run: str) -> Track:
        """Return the track that is under the slider in a run."""
        return replace(self, seed=self.seed ^ crc32(run.encode())) if self.own else self

    def profile(self, longest: float) -> Callable[[float], float]:
        """Return mu0's deviation as a function of position (um) from 0 to `longest`; beyond it stays at its last value."""
        if not self.size:
            return lambda x: 0.0
        step = KNOTS_APART * self.length
        heights, slopes = self._knots(int(np.ceil(longest / step)) + 2)
        last = len(heights) - 2

        def deviation(x: float) -> float:
            at = x / step
            i = min(max(int(at), 0), last)
            r = min(max(at - i, 0.0), 1.0)
            s = 1.0 - r
            return s * s * ((1 + 2 * r) * heights[i] + r * slopes[i]) + r * r * ((3 - 2 * r) * heights[i + 1] - s * slopes[i + 1])

        return deviation

    def _knots(self, count: int) -> tuple[list[float], list[float]]:
        """Return heights and slopes (per step) at the knots, drawn from the process's exact transition (Matern, 3/2).

        Each knot takes the next two numbers of the stream, so that a longer profile begins with the shorter one.
        """
        draws = np.random.default_rng(self.seed).standard_normal((count, 2))
        h = KNOTS_APART
        carry = np.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])  # of height and slope, by correlation lengths
        spread = np.linalg.cholesky(np.eye(2) - carry @ carry.T)
        state = draws[0]
        path = [state]
        for pair in draws[1:]:
            state = carry @ state + spread @ pair
            path.append(state)
        values = self.size * np.array(path)
        return values[:, 0].tolist(), (values[:, 1] * h).tolist()


SMOOTH = Track()


# What moves the slider of a concealed case: every number of its laws, with the values at which each effect is absent.

LAWS = ("srf-vsat", "dieterich-ruina", "dieterich-cutoff", "rice-regularized", "log-log", "bowden-tabor", "two-state")
BARE = ("dieterich-ruina", "rice-regularized", "two-state")  # without a cut-off of age
AGEING_LAWS = ("dieterich", "ruina", "perrin-rice-zheng", "kato-tullis", "nagata")


@dataclass(frozen=True)
class Physics:
    """The truth of a case in um, s, N (mass in N s^2/um). Every field after `rigid` and `massless` is neutral by default.

    mu = mu0 + A ln(v/V0) + B ln(1 + Vsat phi/D0), phi' = 1 - v phi/D0, kappa = W/lam, unless `law`, `ageing` or an effect says
    otherwise. `law` is empty for this one, and for the one without cut-off of age that `bare` stands for.
    """

    K: float = 0.21
    M: float = 2.37e-6
    mu0: float = 0.33
    A: float = 0.0126
    B: float = 0.0241
    D0: float = 0.402
    V0: float = 1.0
    Vsat: float = 256.0
    lam: float = 0.56
    rigid: bool = False  # no interfacial compliance
    massless: bool = False  # quasi-static
    bare: bool = False  # B ln(V0 phi/D0): no cut-off at short ages
    law: str = ""  # of LAWS, where it is neither srf-vsat nor dieterich-ruina
    ageing: str = "dieterich"  # of AGEING_LAWS; that of nagata is the ageing law with `nagata` above 0
    Va: float = 1e4  # dieterich-cutoff: -A ln(1 + Va/v) in place of A ln(v/V0)
    Vc: float = 0.01  # kato-tullis: exp(-v/Vc) - q ln q
    # what diagnosis may name
    alpha: float = 0.0  # phi' gains -(alpha/B) phi W'/W
    n_kappa: float = 1.0  # kappa = (Wref/lam) (W/Wref)^n
    Wref: float = 7.0
    C: float = 0.0  # C ln(v/V0) ln(1 + Vsat phi/D0) in mu
    slip_share: float = 0.0  # phi' = (1 - share) (1 - q) - share q ln q, q = v phi/D0
    B2: float = 0.0  # B2 ln(V0 phi2/D2) in mu
    D2: float = 5.0
    drag: float = 0.0  # drag v/V0 in mu
    Wa: float = 0.0  # friction force mu (W + Wa)
    rho: float = 1.0  # asperities feel W0 + rho (W - W0) of a modulation; steps of the load arrive in full
    distortion: float = 0.0  # second harmonic over first, at the asperities only
    distortion_phase: float = 0.0
    cross: float = 0.0  # force cross (W - W0) on the slider against the drive
    topo: float = 0.0  # topo cos(2 pi x/topo_L + topo_phase) in mu
    topo_L: float = 100.0
    topo_phase: float = 0.0
    drift_t: float = 0.0  # per second since drift_t0
    drift_t0: float = 0.0
    drift_x: float = 0.0  # per um of slip since drift_x0
    drift_x0: float = 0.0
    ripple: float = 0.0  # V (1 + ripple cos(2 pi X/ripple_p + ripple_phase)), X the nominal displacement
    ripple_p: float = 10.0
    ripple_phase: float = 0.0
    lag: float = 0.0  # s, of the gauge
    poisson: float = 0.0  # um/N: the load point is carried along by poisson (W - W0)
    K_power: float = 0.0  # spring K ratio (W/Wref)^K_power
    ratio: float = 1.0  # the spring's stiffness over K, which is what is stated
    # what is in no table
    p_age: float = 1.0  # phi' = 1 - q^p
    bump: float = 0.0  # bump exp(-((x - bump_x)/bump_w)^2/2) in mu
    bump_x: float = 0.0
    bump_w: float = 1.0
    memory: float = 0.0  # share of the load that reaches the asperities through a first-order delay
    memory_tau: float = 0.1
    D_power: float = 0.0  # phi is renewed over D0 (v/V_D)^D_power
    V_D: float = 10.0
    W_power: float = 0.0  # mu0 (W/Wref)^W_power
    age_rate: float = 0.0  # 1/s, phi' loses age_rate phi: contacts stop growing
    eta: float = 0.0  # N s/um, a dashpot beside kappa
    drive_tau: float = 0.0  # s, the stage follows its nominal velocity with this lag
    backlash: float = 0.0  # um, half the gauge's dead band
    # share of the load that a servo of second order controls, W'' = w^2 (command - W) - 2 damping w W'
    servo: float = 0.0
    servo_f: float = 5.0  # Hz, w/(2 pi)
    servo_damping: float = 0.5
    pore: float = 0.0  # N, carried by a fluid: the asperities feel W - pore
    creep: float = 0.0  # share of the elongation that the gauge shows late
    creep_tau: float = 1.0
    harden: float = 0.0  # harden (1 - exp(-x/harden_x)) in mu
    harden_x: float = 30.0
    heat: float = 0.0  # mu loses heat T, T' = (v W/(V0 W0) - T)/heat_tau
    heat_tau: float = 1.0
    dilate: float = 0.0  # mu gains a share -p W0/W, p' = dilate (1/phi - v/D0) - p/drain
    drain: float = 1.0
    rate_cut: float = 0.0  # s/um: A ln(v/V0) becomes A ln(v/V0) - A ln(1 + rate_cut v)
    nagata: float = 0.0  # phi' loses (nagata/B) phi F'/W, F the friction force
    # the track itself, which is no effect
    track: Track = SMOOTH

    @property
    def law_name(self) -> str:
        """Return the name of the friction law."""
        return self.law or ("dieterich-ruina" if self.bare else "srf-vsat")

    @property
    def ageing_name(self) -> str:
        """Return the name of the ageing law."""
        return "nagata" if self.nagata and self.ageing == "dieterich" else self.ageing

    @property
    def spring(self) -> float:
        """Return the stiffness in N/um that the spring really has, under the load Wref where it depends on that."""
        return self.K * self.ratio

    def spring_under(self, W: float) -> float:
        """Return the stiffness in N/um of the spring under an imposed load in N."""
        return self.spring * (W / self.Wref) ** self.K_power if self.K_power else self.spring


# What is done to the slider: seven runs, two of them held out, with drives and loads drawn around those of the examples.

MODULATION_RISE = 0.02  # s, of the tanh that switches a modulation on
LOAD_STEP_RISE = 0.03  # s, of the tanh of a load step
SPARSE = 5  # one sample in so many is kept where a recorder is slowed down
WIDEST_JITTER = 0.4  # of the interval: how far from its place an uneven sample may be


@dataclass(frozen=True)
class Plan:
    """One run: drive as (s, um/s), mean load W0 (N), sampling interval (s), modulation from `onset` (s), load steps as (s, N).

    `rise` is the time in s of a switched modulation's tanh, or a load step's; 0 for the usual ones. Samples within `gaps` (s, s)
    are missing. After a step of the drive all are kept for `dense` s, then one in SPARSE; 0 keeps all. Of samples that come
    unevenly, `wander` is the standard deviation of their times over the interval. The gauge has `loud` times its usual noise.
    """

    name: str
    drive: tuple[tuple[float, float], ...]
    W0: float
    interval: float
    holdout: bool = False
    eps: float = 0.0
    f: float = 0.0
    onset: float = 0.0
    steps: tuple[tuple[float, float], ...] = field(default=())
    rise: float = 0.0
    gaps: tuple[tuple[float, float], ...] = field(default=())
    dense: float = 0.0
    wander: float = 0.0
    loud: float = 1.0

    @property
    def duration(self) -> float:
        return sum(d for d, _ in self.drive)

    @property
    def distance(self) -> float:
        """Return the nominal displacement of the stage in um."""
        return sum(d * v for d, v in self.drive)

    def times(self) -> np.ndarray:
        """Return the sample times in s, without the very end of the drive."""
        t = np.arange(round(self.duration / self.interval)) * self.interval
        if self.wander:  # never as far as the next sample; the times are known as they are written
            late = np.random.default_rng(crc32(self.name.encode())).standard_normal(t.size)
            t[1:] += self.interval * np.clip(self.wander * late[1:], -WIDEST_JITTER, WIDEST_JITTER)
            t = np.round(t, 4)
        keep = np.ones(t.size, dtype=bool)
        for begin, end in self.gaps:
            keep &= (t < begin) | (t > end)
        if self.dense:
            edges = np.array([0.0, *accumulate(d for d, _ in self.drive)])
            since = t - edges[np.searchsorted(edges, t + 1e-9, side="right") - 1]
            keep &= (since <= self.dense) | (np.arange(t.size) % SPARSE == 0)
        return t[keep]

    def load(self) -> Callable[[float], tuple[float, float]]:
        """Return the imposed load and its rate, N and N/s, as a function of time."""
        W0, jumps, step_rise = self.W0, self.steps, self.rise or LOAD_STEP_RISE
        share, omega, height = self.switched(), 2 * math.pi * self.f, self.eps * self.W0

        def load(t: float) -> tuple[float, float]:
            W, rate = W0, 0.0
            if height:
                s, s_dot = share(t)
                c = math.cos(omega * t)
                W += height * s * c
                rate += height * (s_dot * c - s * omega * math.sin(omega * t))
            for at, jump in jumps:
                h = math.tanh((t - at) / step_rise)
                W += 0.5 * jump * (1 + h)
                rate += 0.5 * jump * (1 - h * h) / step_rise
            return W, rate

        return load

    def switched(self) -> Callable[[float], tuple[float, float]]:
        """Return how much of the modulation is on, 0 to 1, and the rate of that."""
        onset, rise = self.onset, self.rise or MODULATION_RISE

        def share(t: float) -> tuple[float, float]:
            h = math.tanh((t - onset) / rise)
            return 0.5 * (1 + h), 0.5 * (1 - h * h) / rise

        return share


# The slider's equations written for the interface's elastic strain: friction is a stress that is known, v what flows under it.

FASTEST_SLIP = 60.0  # of ln(v/V0): what a solver's trial step may ask for is kept finite


class ContactLoad(NamedTuple):  # a run makes a hundred thousand of them
    """The load at the asperities and its rate, N and N/s, beside the imposed one, its W - W0 and its rate."""

    W: float
    rate: float
    excess: float
    imposed: float
    imposed_rate: float


def contact_load(p: Physics, plan: Plan) -> Callable[[float], ContactLoad]:
    """Return the load that reaches the asperities, before any delay, as a function of time."""
    imposed, switched, W0 = plan.load(), plan.switched(), plan.W0
    height, omega = p.distortion * plan.eps * W0, 4 * math.pi * plan.f

    def contact_load_at(t: float) -> ContactLoad:
        W, rate = imposed(t)
        if not plan.eps:
            # a slow step of the load is no modulation: it arrives in full
            return ContactLoad(W - p.pore, rate, W - W0, W, rate)
        s, s_dot = switched(t)
        angle = omega * t + p.distortion_phase
        here = W0 + p.rho * (W - W0) + height * s * math.cos(angle)
        slope = p.rho * rate + height * (s_dot * math.cos(angle) - s * omega * math.sin(angle))
        return ContactLoad(here - p.pore, slope, W - W0, W, rate)

    return contact_load_at


def at_unit_velocity(p: Physics, longest: float) -> Callable[[float, float, float, float, float], tuple[float, float]]:
    """Return f(t, slip, ln phi, ln phi2, W) -> (m, a): mu = m + a h(x) + drag e^x, x = ln(v/V0); h is x in most laws."""
    profile = p.track.profile(longest)
    local = p.topo != 0 or p.bump != 0 or p.track.size != 0
    drifting = p.drift_t != 0 or p.drift_x != 0
    wave = 2 * math.pi / p.topo_L
    first_age, second_age = math.log(p.V0 / p.D0), math.log(p.V0 / p.D2)

    def terms(t: float, s: float, ln_phi: float, ln_phi2: float, W: float) -> tuple[float, float]:
        grown = ln_phi + first_age if p.bare else math.log1p(p.Vsat / p.D0 * math.exp(ln_phi))
        m = p.mu0 + p.B * grown
        if p.W_power:
            m += p.mu0 * ((W / p.Wref) ** p.W_power - 1)
        if p.B2:
            m += p.B2 * (ln_phi2 + second_age)
        if local:
            m += p.topo * math.cos(wave * s + p.topo_phase) + profile(s)
            m += p.bump * math.exp(-0.5 * ((s - p.bump_x) / p.bump_w) ** 2)
        if p.harden:
            m += p.harden * (1 - math.exp(-s / p.harden_x))
        if drifting:
            m += p.drift_t * max(t - p.drift_t0, 0.0) + p.drift_x * max(s - p.drift_x0, 0.0)
        return m, p.A * (1 + p.B / p.mu0 * grown) if p.law == "bowden-tabor" else p.A + p.C * grown

    return terms


def log_velocity(R: float, a: float, c: float) -> float:
    """Return the x with a x + c e^x = R for a > 0 and c >= 0, by Newton's method from the side where it cannot overshoot."""
    x = R / a
    if c <= 0.0:
        return min(x, FASTEST_SLIP)
    if R > 0:
        x = min(x, math.log1p(R / c))  # both bounds lie above the root: a convex function, approached from above
    x = min(x, FASTEST_SLIP)
    for _ in range(60):
        flow = c * math.exp(x)
        step = (a * x + flow - R) / (a + flow)
        x -= step
        if abs(step) < 1e-14 * (1 + abs(x)):
            break
    return x


Solve = Callable[[float, float, float, float], float]
"""Of mu or x, m, a and the drag: x or mu."""


def friction(p: Physics) -> tuple[Solve, Solve]:
    """Return mu(x, m, a, c) = m + a h(x) + c e^x, x = ln(v/V0), of the law of `p`, and its inverse x(mu, m, a, c).

    h(x) is x, -ln(1 + Va/v) under dieterich-cutoff, and asinh(exp(x + m/a)/2) - m/a under rice-regularized. A cut-off of the
    rate is that of dieterich-cutoff, with ln(Va/V0) beside it.
    """
    if p.law not in ("dieterich-cutoff", "rice-regularized") and not p.rate_cut:

        def straight(x: float, m: float, a: float, c: float) -> float:
            return m + a * x + c * math.exp(x)

        return straight, lambda mu, m, a, c: log_velocity(mu - m, a, c)
    end = -math.log(p.rate_cut * p.V0) if p.rate_cut else math.log(p.Va / p.V0)
    cut, above = p.law == "dieterich-cutoff" or p.rate_cut > 0, end if p.rate_cut else 0.0

    def bent(x: float, m: float, a: float, c: float) -> float:
        flow = c * math.exp(min(x, FASTEST_SLIP)) if c else 0.0
        if cut:
            return m + a * (above - math.log1p(math.exp(min(end - x, 700.0)))) + flow
        return a * math.asinh(0.5 * math.exp(min(x + m / a, 700.0))) + flow

    def plain(mu: float, m: float, a: float) -> float:
        """Return x without drag: a closed form."""
        if cut:
            R = (m - mu) / a + above  # ln(1 + Va/v); 0 and below at no velocity
            return min(end - R - math.log(-math.expm1(-R)), FASTEST_SLIP) if R > 0 else FASTEST_SLIP
        y = max(mu / a, 1e-12)
        return min(y + math.log(-math.expm1(-2 * y)) - m / a, FASTEST_SLIP)

    def solve(mu: float, m: float, a: float, c: float) -> float:
        high = plain(mu, m, a)
        if c <= 0.0:
            return high
        low = high - 1.0
        while bent(low, m, a, c) > mu:
            low = high - 2 * (high - low)
        for _ in range(100):  # bisection, from a bracket that regula falsi would close from one side
            middle = 0.5 * (low + high)
            low, high = (low, middle) if bent(middle, m, a, c) > mu else (middle, high)
            if high - low < 1e-14 * (1 + abs(high)):
                break
        return 0.5 * (low + high)

    return bent, solve


def ageing(p: Physics) -> Callable[..., float]:
    """Return f(v, ln phi, W, W', F' = 0) -> d(ln phi)/dt, F the friction force."""
    law = p.ageing

    def rate(v: float, ln_phi: float, W: float, W_dot: float, F_dot: float = 0.0) -> float:
        phi = math.exp(ln_phi)
        D = p.D0 * (v / p.V_D) ** p.D_power if p.D_power else p.D0
        q = max(v * phi / D, 1e-300)
        worn = q if p.p_age == 1.0 else q**p.p_age
        if law == "dieterich":
            base = 1 - worn
        elif law == "perrin-rice-zheng":
            base = 1 - 0.25 * worn * worn
        else:
            base = (math.exp(-v / p.Vc) if law == "kato-tullis" else 0.0) - q * math.log(q)
        grown = (1 - p.slip_share) * base - (p.slip_share * q * math.log(q) if p.slip_share else 0.0)
        return grown / phi - p.alpha / p.B * W_dot / W - p.nagata / p.B * F_dot / W - p.age_rate

    return rate


def second_ageing(p: Physics) -> Callable[..., float]:
    """Return the same for the second age: by the first one's law under two-state, else an age that slip of D2 renews."""
    if p.law == "two-state":
        return ageing(replace(p, D0=p.D2, B=p.B2))

    def rate(v: float, ln_phi: float, W: float, W_dot: float, F_dot: float = 0.0) -> float:
        return math.exp(-ln_phi) - v / p.D2

    return rate


def steady_age(p: Physics, V: float) -> float:
    """Return ln phi in steady sliding at V um/s: where the ageing rate vanishes."""
    rate = ageing(p)
    middle = math.log(p.D0 / V)
    return float(brentq(lambda x: rate(V, x, 1.0, 0.0) * math.exp(x), middle - 20, middle + 20, xtol=1e-14))


def steady_ages(p: Physics, V: float) -> tuple[float, float]:
    """Return ln phi and ln phi2 in steady sliding at V um/s."""
    second = steady_age(replace(p, D0=p.D2, B=p.B2), V) if p.law == "two-state" else math.log(p.D2 / V)
    return steady_age(p, V), second


def steady_friction(p: Physics, V: float, W: float) -> float:
    """Return the friction coefficient in steady sliding at V um/s under a load of W N."""
    m, a = at_unit_velocity(p, 0.0)(0.0, 0.0, *steady_ages(p, V), W)
    return friction(p)[0](math.log(V / p.V0), m, a, p.drag)


def stiffness(p: Physics) -> Callable[[float], float]:
    """Return the interface's stiffness in N/um as a function of the load at the asperities."""
    if p.n_kappa == 1.0:
        return lambda W: W / p.lam
    return lambda W: p.Wref / p.lam * (W / p.Wref) ** p.n_kappa


# Where friction force, slip velocity and spring elongation come from: three kinds of slider.

Sliding = tuple[float, float, float]  # slip velocity um/s, elongation of the spring um, friction force N
# of states, m, a, load, force along, spring's K
SlidingFunction = Callable[[list[float], float, float, float, float, float], Sliding]
# of states, the above, stage velocity, force, K
MechanicalRates = Callable[[list[float], Sliding, float, float, float], list[float]]
ForceRate = Callable[[list[float], list[float], float, float], float]  # of states, their rates, load and its rate: F'


@dataclass(frozen=True)
class Contact:
    """A slider's mechanical states, what they say about its sliding, their rates, and their values in steady sliding."""

    names: tuple[str, ...]
    sliding_at: SlidingFunction
    mechanical_rates: MechanicalRates
    steady: Callable[[float, float, float, float], list[float]]  # of velocity, friction force, load, spring's K
    force_rate: ForceRate | None = None  # the rate of the friction force, where it follows from the states


def _elastic(p: Physics) -> Contact:
    """The stretch e of the interface is a state: kappa e + eta (z - v) = F = (W + Wa) mu(v, phi) gives v."""
    kappa, (_, velocity) = stiffness(p), friction(p)

    def sliding_at(y: list[float], m: float, a: float, W: float, aside: float, K: float) -> Sliding:
        weight = W + p.Wa
        pull = kappa(W) * y[2] + p.eta * y[1]
        v = p.V0 * math.exp(velocity(pull / weight, m, a, p.drag + p.eta * p.V0 / weight))
        return v, y[0], pull - p.eta * v

    def mechanical_rates(y: list[float], sliding: Sliding, V: float, aside: float, K: float) -> list[float]:
        v, u, F = sliding
        return [V - y[1], (K * u + aside - F) / p.M, y[1] - v]

    def rate(y: list[float], rates: list[float], W: float, W_dot: float) -> float:
        return (W * rates[2] + W_dot * y[2]) / p.lam

    known = None if p.eta or p.n_kappa != 1.0 else rate
    return Contact(("u", "z", "e"), sliding_at, mechanical_rates, lambda V, F, W, K: [F / K, V, F / kappa(W)], known)


def _rigid(p: Physics) -> Contact:
    """There is nothing to stretch: ln v is a state, which inertia moves."""
    resistance, _ = friction(p)

    def sliding_at(y: list[float], m: float, a: float, W: float, aside: float, K: float) -> Sliding:
        x = min(y[1], FASTEST_SLIP)
        v = p.V0 * math.exp(x)
        return v, y[0], (W + p.Wa) * resistance(x, m, a, p.drag)

    def mechanical_rates(y: list[float], sliding: Sliding, V: float, aside: float, K: float) -> list[float]:
        v, u, F = sliding
        return [V - v, (K * u + aside - F) / (p.M * v)]

    return Contact(("u", "ln_v"), sliding_at, mechanical_rates, lambda V, F, W, K: [F / K, math.log(V / p.V0)])


def _massless(p: Physics) -> Contact:
    """Spring and interface in series carry the friction force; their joint stretch D is the state."""
    kappa, (_, velocity) = stiffness(p), friction(p)

    def sliding_at(y: list[float], m: float, a: float, W: float, aside: float, K: float) -> Sliding:
        yielding = 1 / K + (0.0 if p.rigid else 1 / kappa(W))
        F = (y[0] + aside / K) / yielding
        return p.V0 * math.exp(velocity(F / (W + p.Wa), m, a, p.drag)), (F - aside) / K, F

    def mechanical_rates(y: list[float], sliding: Sliding, V: float, aside: float, K: float) -> list[float]:
        return [V - sliding[0]]

    def rate(y: list[float], rates: list[float], W: float, W_dot: float) -> float:
        """Return F' of F (1/K + lam/W) = D."""
        if p.rigid:
            return p.spring * rates[0]
        yielding = 1 / p.spring + p.lam / W
        return (rates[0] + y[0] / yielding * p.lam * W_dot / W**2) / yielding

    known = None if p.cross or p.K_power or p.n_kappa != 1.0 else rate
    return Contact(("D",), sliding_at, mechanical_rates, lambda V, F, W, K: [F / K + (0.0 if p.rigid else F / kappa(W))], known)


# The run of a slider from steady sliding: states joined, integrated by backward differentiation formulas, read by a gauge.

SOLVER_RTOL = 1e-8
TOLERANCES = {"u": 1e-8, "z": 1e-6, "e": 1e-10, "D": 1e-9, "s": 1e-7}  # absolute tolerances, um and um/s; others 1e-8
LONGEST_STEP = 0.01  # s: no step jumps over the beginning of a load step
FASTEST_WITHOUT_MASS = 1e6  # um/s: unstable slip without inertia becomes infinitely fast, and a solver may step over that
OVERSHOOT = 60.0  # um, of slip beyond the stage's displacement
STEPS_BETWEEN = 200_000  # from one sample to the next
Array = np.ndarray


class Slider:
    """The first-order system of one run. States: the contact's, ln phi, slip, then only what the effects at work need."""

    def __init__(self, p: Physics, plan: Plan) -> None:
        self.p, self.plan = p, plan
        self.contact = _massless(p) if p.massless else _rigid(p) if p.rigid else _elastic(p)
        if p.nagata and (self.contact.force_rate is None or p.Wa):
            raise ValueError("nagata: the rate of the friction force does not follow from the states")
        self._felt = contact_load(p, plan)
        self._terms = at_unit_velocity(replace(p, track=p.track.under(plan.name)), plan.distance + OVERSHOOT)
        self._aged, self._aged2, (self._resistance, _) = ageing(p), second_ageing(p), friction(p)
        extra = {
            "ln_phi2": p.B2, "Wm": p.memory, "gauge": p.lag, "stage": p.drive_tau, "X": p.ripple, "Ws": p.servo,
            "Ws_dot": p.servo, "late": p.creep, "T": p.heat, "p": p.dilate,
        }  # fmt: skip
        self.names = (*self.contact.names, "ln_phi", "s", *(name for name, size in extra.items() if size))
        self._age = len(self.contact.names)
        where = [self.names.index(name) if name in self.names else 0 for name in extra]  # 0 is always mechanical
        self._age2, self._delay, self._gauge, self._stage, self._X, self._servo, _, self._late, self._heat, self._pore = where

    def sliding(self, t: float, y: list[float]) -> tuple[Sliding, ContactLoad]:
        """Return slip velocity, elongation and friction force, and the load at the asperities, at time t in s."""
        felt, p = self._felt(t), self.p
        if self._delay:
            late = y[self._delay]
            rate = (felt.W - late) / p.memory_tau
            W = felt.W + p.memory * (late - felt.W)
            felt = felt._replace(W=W, rate=felt.rate + p.memory * (rate - felt.rate))
        if self._servo:
            W, rate = y[self._servo], y[self._servo + 1]
            felt = felt._replace(W=felt.W + p.servo * (W - felt.W), rate=felt.rate + p.servo * (rate - felt.rate))
        m, a = self._terms(t, y[self._age + 1], y[self._age], y[self._age2] if self._age2 else 0.0, felt.W)
        if self._heat:
            m -= p.heat * y[self._heat]
        if self._pore:
            share = 1 - y[self._pore] * self.plan.W0 / felt.W
            m, a = share * m, share * a
        K = p.spring_under(felt.imposed)
        return self.contact.sliding_at(y, m, a, felt.W, -p.cross * felt.excess, K), felt

    def rates(self, t: float, states: Array, V: float) -> list[float]:
        """Return the rates of the states at time t in s, where the stage's nominal velocity is V um/s.

        NaN of states that ran away: the solver's compiled code would lose an exception, and go on.
        """
        try:
            return self._rates(t, states, V)
        except (ArithmeticError, ValueError):
            return [math.nan] * len(self.names)

    def _rates(self, t: float, states: Array, V: float) -> list[float]:
        y, p, nominal = states.tolist(), self.p, V
        sliding, felt = self.sliding(t, y)
        v, u, _ = sliding
        if p.massless and v > FASTEST_WITHOUT_MASS:
            raise ArithmeticError("slip that nothing ends")
        if self._stage:
            V = y[self._stage]
        if self._X:
            V *= 1 + p.ripple * math.cos(2 * math.pi * y[self._X] / p.ripple_p + p.ripple_phase)
        V += p.poisson * felt.imposed_rate
        out = self.contact.mechanical_rates(y, sliding, V, -p.cross * felt.excess, p.spring_under(felt.imposed))
        F_dot = self.contact.force_rate(y, out, felt.W, felt.rate) if p.nagata and self.contact.force_rate else 0.0
        out += (self._aged(v, y[self._age], felt.W, felt.rate, F_dot), v)
        if self._age2:
            out.append(self._aged2(v, y[self._age2], felt.W, felt.rate, F_dot))
        if self._delay:
            out.append((self._felt(t).W - y[self._delay]) / p.memory_tau)
        if self._gauge:
            out.append((u - y[self._gauge]) / p.lag)
        if self._stage:
            out.append((nominal - y[self._stage]) / p.drive_tau)
        if self._X:
            out.append(nominal)
        if self._servo:
            w = 2 * math.pi * p.servo_f
            W, rate = y[self._servo], y[self._servo + 1]
            out += (rate, w * (w * (self._felt(t).W - W) - 2 * p.servo_damping * rate))
        if self._late:
            out.append((u - y[self._late]) / p.creep_tau)
        if self._heat:
            out.append((v * felt.W / (p.V0 * self.plan.W0) - y[self._heat]) / p.heat_tau)
        if self._pore:
            out.append(p.dilate * (math.exp(-y[self._age]) - v / p.D0) - y[self._pore] / p.drain)
        return out

    def shown(self, t: float, y: list[float]) -> float:
        """Return the elongation in um that the gauge shows."""
        u = y[self._gauge] if self._gauge else self.sliding(t, y)[0][1]
        return u + self.p.creep * (y[self._late] - u) if self._late else u

    def steady(self) -> list[float]:
        """Return the states of steady sliding at the run's first velocity and load."""
        p, V, felt = self.p, self.plan.drive[0][1], self._felt(0.0)
        W, K = felt.W, self.p.spring_under(felt.imposed)
        ln_phi, ln_phi2 = steady_ages(p, V)
        m, a = self._terms(0.0, 0.0, ln_phi, ln_phi2, W)
        warm = V * W / (p.V0 * self.plan.W0)
        m -= p.heat * warm
        F = (W + p.Wa) * self._resistance(math.log(V / p.V0), m, a, p.drag)
        extra = {
            "ln_phi2": ln_phi2, "Wm": W, "gauge": F / K, "stage": V, "X": 0.0, "Ws": W, "Ws_dot": 0.0, "late": F / K, "T": warm,
            "p": 0.0,  # at an age of D0/V
        }  # fmt: skip
        mechanical = self.contact.steady(V, F, W, K)
        return [*mechanical, ln_phi, 0.0, *(extra[name] for name in self.names[len(mechanical) + 2 :])]


@dataclass(frozen=True)
class Trace:
    """What happened in a run: times (n,), gauge reading u (n,) without noise; NaN from where the solver gave up."""

    t: Array
    u: Array

    @property
    def complete(self) -> bool:
        return bool(np.isfinite(self.u).all())


def move(p: Physics, plan: Plan, *, rtol: float = SOLVER_RTOL) -> Trace:
    """Return the motion of one run at its sample times, integrated anew from every step of the drive.

    VODE gives up now and then in the last digits, where it goes on from a tolerance hardly another: a piece has two attempts.
    """
    slider = Slider(p, plan)
    t = plan.times()
    trace = Trace(t, np.full(t.size, np.nan))
    edges = [0.0, *accumulate(d for d, _ in plan.drive)]
    y: Array | None = np.array(slider.steady())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # what the solver has to say is that it gave up: the NaN say so
        for (_, V), begin, end in zip(plan.drive, edges, edges[1:], strict=False):
            solvers = (_solver(slider, own).set_f_params(V).set_initial_value(y, begin) for own in (rtol, rtol / 2))
            y = next((found for solver in solvers if (found := _through(slider, solver, trace, end)) is not None), None)
            if y is None:
                break
    return trace


def _solver(slider: Slider, rtol: float) -> ode:
    tolerance = [TOLERANCES.get(name, 1e-8) * rtol / SOLVER_RTOL for name in slider.names]
    longest = slider.plan.rise / 3 if slider.plan.rise else LONGEST_STEP
    if slider.plan.eps:
        longest = min(longest, 0.25 / slider.plan.f)
    options = {"rtol": rtol, "atol": tolerance, "nsteps": STEPS_BETWEEN, "max_step": longest}
    # with_jacobian: Newton's method with differences; without it VODE iterates the stiff equations as they stand
    return ode(slider.rates).set_integrator("vode", method="bdf", with_jacobian=True, **options)


def _through(slider: Slider, solver: ode, trace: Trace, end: float) -> Array | None:
    """Follow one piece of the drive to its end, reading the gauge, and return the states there; None where it was not reached."""
    t = trace.t
    try:
        for k in np.flatnonzero((t >= solver.t - 1e-9) & (t < end - 1e-9)).tolist():
            if t[k] > solver.t + 1e-9:  # a solver fails that is asked for a step of the last digits
                solver.integrate(t[k])
            if not (solver.successful() and np.isfinite(solver.y).all()):
                return None
            trace.u[k] = slider.shown(float(t[k]), solver.y.tolist())
        y: Array = solver.integrate(end)
    except OverflowError:  # a state ran away
        return None
    return y if solver.successful() and np.isfinite(y).all() else None


# Stability of steady sliding by the slider's own equations: differences of its rates, and their eigenvalues.

UNSTEADY: dict[str, Any] = {
    "track": Track(), "topo": 0.0, "bump": 0.0, "drift_t": 0.0, "drift_x": 0.0, "ripple": 0.0, "drive_tau": 0.0, "harden": 0.0,
}  # fmt: skip
UNFELT_DELAYS: dict[str, Any] = {"lag": 0.0, "creep": 0.0, "servo": 0.0}  # of gauge and servo: steady sliding does not feel them
LOAD_TRIALS = 60  # that are tried, evenly in their logarithm
STATE_DIFFERENCE = 1e-4  # relative, of a state: a critical load is 2e-5 off; the friction law is inverted to some 1e-10


def critical_load(p: Physics, V: float, low: float, high: float) -> float:
    """Return the least load from `low` to `high` above which steady sliding at V (um/s) is unstable; NaN if there is none.

    What depends on place or time has no steady sliding, and is left out.
    """
    p = replace(p, **UNSTEADY, **UNFELT_DELAYS)

    def growth(ln_W: float) -> float:
        slider = Slider(p, Plan("steady", ((1.0, V),), math.exp(ln_W), 0.1))
        y, kept = np.array(slider.steady()), [i for i, name in enumerate(slider.names) if name != "s"]
        J = np.empty((len(kept), len(kept)))
        for column, i in enumerate(kept):
            step = np.zeros(y.size)
            step[i] = STATE_DIFFERENCE * max(abs(y[i]), STATE_DIFFERENCE)
            above, below = (np.array(slider.rates(0.5, y + side * step, V))[kept] for side in (1, -1))
            J[:, column] = (above - below) / (2 * step[i])
        return float(np.linalg.eigvals(J).real.max()) if np.isfinite(J).all() else math.nan

    grid = np.linspace(math.log(low), math.log(high), LOAD_TRIALS)
    found = np.array([growth(x) for x in grid])
    lost = np.flatnonzero((found[:-1] < 0) & (found[1:] >= 0))
    return math.exp(brentq(growth, grid[lost[0]], grid[lost[0] + 1], xtol=1e-9)) if lost.size else math.nan
