"""What moves the slider of a concealed case: every number of its laws, with the values at which each effect is absent."""

from __future__ import annotations

from dataclasses import dataclass

from srfcli.proof.track import SMOOTH, Track


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
