"""What moves the slider of a concealed case, the track it slides on, and what is done to it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

# Rough tracks: a friction coefficient that wanders with position, the same for all runs of a case.

SPACING = 0.1  # correlation lengths between knots


@dataclass(frozen=True)
class Track:
    """The deviation of mu0 along a track: a Gaussian process of standard deviation `size` and correlation length `length` (um).

    `seed` fixes it; its correlation is (1 + r) exp(-r), r = distance/length, that of a rough but differentiable profile.
    """

    size: float = 0.0
    length: float = 10.0
    seed: int = 0

    def profile(self, longest: float) -> Callable[[float], float]:
        """Return mu0's deviation as a function of position (um) from 0 to `longest`; beyond it stays at its last value."""
        if not self.size:
            return lambda x: 0.0
        step = SPACING * self.length
        heights, slopes = self._knots(int(np.ceil(longest / step)) + 2)
        last = len(heights) - 2

        def deviation(x: float) -> float:
            at = x / step
            i = min(max(int(at), 0), last)
            r = min(max(at - i, 0.0), 1.0)
            s = 1.0 - r
            return s * s * ((1 + 2 * r) * heights[i] + r * slopes[i]) + r * r * (
                (3 - 2 * r) * heights[i + 1] - s * slopes[i + 1]
            )

        return deviation

    def _knots(self, count: int) -> tuple[list[float], list[float]]:
        """Return heights and slopes (per step) at the knots, drawn from the process's exact transition (Matern, 3/2).

        Each knot takes the next two numbers of the stream, so that a longer profile begins with the shorter one.
        """
        draws = np.random.default_rng(self.seed).standard_normal((count, 2))
        h = SPACING
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


@dataclass(frozen=True)
class Physics:
    """The truth of a case in um, s, N (mass in N s^2/um). Every field after `rigid` and `massless` is neutral by default.

    mu = mu0 + A ln(v/V0) + B ln(1 + Vsat phi/D0), phi' = 1 - v phi/D0, kappa = W/lam, unless an effect says otherwise.
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
    # the track itself, which is no effect
    track: Track = SMOOTH

    @property
    def spring(self) -> float:
        """Return the stiffness in N/um that the spring really has."""
        return self.K * self.ratio


# What is done to the slider: seven runs, two of them held out, with drives and loads drawn around those of the examples.

MODULATION_RISE = 0.02  # s, of the tanh that switches a modulation on
STEP_RISE = 0.03  # s, of the tanh of a load step


@dataclass(frozen=True)
class Plan:
    """One run: drive as (s, um/s), mean load W0 (N), sampling interval (s), modulation from `onset` (s), load steps as (s, N)."""

    name: str
    drive: tuple[tuple[float, float], ...]
    W0: float
    interval: float
    holdout: bool = False
    eps: float = 0.0
    f: float = 0.0
    onset: float = 0.0
    steps: tuple[tuple[float, float], ...] = field(default=())

    @property
    def duration(self) -> float:
        return sum(d for d, _ in self.drive)

    @property
    def distance(self) -> float:
        """Return the nominal displacement of the stage in um."""
        return sum(d * v for d, v in self.drive)

    def times(self) -> np.ndarray:
        """Return the sample times in s, without the very end of the drive."""
        return np.arange(round(self.duration / self.interval)) * self.interval

    def load(self) -> Callable[[float], tuple[float, float]]:
        """Return the imposed load and its rate, N and N/s, as a function of time."""
        W0, jumps = self.W0, self.steps
        share, omega, height = self.switched(), 2 * math.pi * self.f, self.eps * self.W0

        def load(t: float) -> tuple[float, float]:
            W, rate = W0, 0.0
            if height:
                s, s_dot = share(t)
                c = math.cos(omega * t)
                W += height * s * c
                rate += height * (s_dot * c - s * omega * math.sin(omega * t))
            for at, jump in jumps:
                h = math.tanh((t - at) / STEP_RISE)
                W += 0.5 * jump * (1 + h)
                rate += 0.5 * jump * (1 - h * h) / STEP_RISE
            return W, rate

        return load

    def switched(self) -> Callable[[float], tuple[float, float]]:
        """Return how much of the modulation is on, 0 to 1, and the rate of that."""
        onset = self.onset

        def share(t: float) -> tuple[float, float]:
            h = math.tanh((t - onset) / MODULATION_RISE)
            return 0.5 * (1 + h), 0.5 * (1 - h * h) / MODULATION_RISE

        return share


def example_protocol() -> tuple[Plan, ...]:
    """Return the seven runs of the worked examples."""
    return (
        Plan("steps", ((2, 5), (1.5, 20), (2, 5), (1, 50), (2, 10)), 5.0, 0.004),
        Plan("stickslip", ((0.5, 12), (5, 8)), 9.0, 0.004),
        Plan("onset", ((0.5, 12), (4, 8)), 9.0, 0.001, eps=0.09, f=120, onset=2),
        Plan("strong", ((2.5, 20),), 7.0, 0.001, eps=0.2, f=120, onset=0.6),
        Plan("loadstep", ((6, 10),), 5.0, 0.002, steps=((2, 1.5), (4, -1.5))),
        Plan("holdout-mod", ((3, 15),), 8.0, 0.001, holdout=True, eps=0.13, f=80, onset=0.8),
        Plan("holdout-shs", ((2, 10), (4, 0.1), (3, 10)), 5.0, 0.004, holdout=True),
    )
