"""The wide bank's apparatus, laws, protocols and noise: what cases beside those of the paper are drawn from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from srfcli.validation.gauge import MAX_LAG1, QUANTUM, SIGMA, Gauge
from srfcli.validation.slider import AGEING_LAWS, BARE, LAWS, Physics, Plan, steady_friction

# How an apparatus records, and what its experimenter writes into a description: the same for every case of it.

Start = tuple[float, float, float]  # value, lower, upper
LAW_NAMES = {"Vsat": "Vsat", "lam": "lambda", "nagata": "c"}  # field of Physics -> name in a law's file, where they differ
LAW_FIELDS = {  # the fields of Physics that each friction law has
    "srf-vsat": ("mu0", "A", "B", "D0", "Vsat"),
    "dieterich-ruina": ("mu0", "A", "B", "D0"),
    "dieterich-cutoff": ("mu0", "A", "B", "D0", "Va", "Vsat"),
    "rice-regularized": ("mu0", "A", "B", "D0"),
    "log-log": ("mu0", "A", "B", "C", "D0", "Vsat"),
    "bowden-tabor": ("mu0", "A", "B", "D0", "Vsat"),
    "two-state": ("mu0", "A", "B", "B2", "D0", "D2"),
}


def free_fields(baseline: Physics) -> list[str]:
    """Return the fields of a baseline that its fit has free."""
    more = [] if baseline.rigid else ["lam"]
    return [*LAW_FIELDS[baseline.law_name], *more, *(["nagata"] if baseline.nagata else [])]


@dataclass(frozen=True)
class Rig:
    """What an apparatus records, in which columns, and where its fits start.

    `observes` is elongation, force or friction; `unit` that of force in the file, `factor` of it to N. `starts` are by field of
    Physics; `mu0` where the law has no cut-off of age is `bare`, and `cut` where the direct effect has one.
    """

    title: str
    starts: Mapping[str, Start]
    bare: Start
    cut: Start
    observes: str = "elongation"
    heading: str = "elongation [um]"
    load: str = "normal_load [N]"
    unit: str = "N"
    factor: float = 1.0
    digits: int = 3  # of what is observed

    def start(self, baseline: Physics) -> dict[str, Start]:
        """Return the start values of a baseline's parameters, by the names that its laws' files have."""
        found: dict[str, Start] = {}
        for name in free_fields(baseline):
            start = self.starts[name]
            if name == "mu0" and baseline.bare:
                start = self.bare
            elif name == "mu0" and baseline.law == "dieterich-cutoff":
                start = self.cut
            written = "Vb" if name == "Vsat" and baseline.law == "dieterich-cutoff" else LAW_NAMES.get(name, name)
            found[written] = start
        return found


COMMON: Mapping[str, Start] = {"Va": (8000.0, 300.0, 1e6), "C": (5e-4, -5e-3, 5e-3), "nagata": (1.5, 0.0, 6.0)}
PAPER = Rig(
    "PMMA on PMMA, concealed case",
    {
        "mu0": (0.33, 0.2, 0.5), "A": (0.012, 0.006, 0.03), "B": (0.023, 0.01, 0.06), "D0": (0.4, 0.1, 1.5),
        "Vsat": (280.0, 50.0, 2000.0), "lam": (0.62, 0.2, 1.5), "B2": (0.005, 0.0, 0.03), "D2": (3.0, 0.6, 30.0), **COMMON,
    },
    bare=(0.46, 0.3, 0.7), cut=(0.45, 0.3, 0.7),
)  # fmt: skip
ROCK_PRESS = Rig(
    "rock on rock, concealed case",
    {
        "mu0": (0.58, 0.3, 0.9), "A": (0.008, 0.002, 0.03), "B": (0.009, 0.001, 0.04), "D0": (22.0, 2.0, 200.0),
        "Vsat": (1200.0, 100.0, 20000.0), "lam": (80.0, 5.0, 1000.0), "B2": (0.002, 0.0, 0.02), "D2": (180.0, 20.0, 1500.0),
        **COMMON,
    },
    bare=(0.65, 0.4, 0.9), cut=(0.65, 0.4, 0.9), observes="force", heading="shear_stress [MPa]", load="normal_stress [MPa]",
    unit="MPa", digits=6,
)  # fmt: skip
MICRO = Rig(
    "micro-tribometer, concealed case",
    {
        "mu0": (0.33, 0.1, 0.6), "A": (0.01, 0.002, 0.04), "B": (0.01, 0.001, 0.05), "D0": (0.07, 0.01, 0.6),
        "Vsat": (280.0, 20.0, 5000.0), "lam": (0.5, 0.05, 5.0), "B2": (0.003, 0.0, 0.03), "D2": (0.5, 0.08, 5.0), **COMMON,
    },
    bare=(0.38, 0.15, 0.7), cut=(0.41, 0.15, 0.8), load="normal_load [mN]", factor=1e-3,
)  # fmt: skip
RIGS: Mapping[str, Rig] = {
    "paper": PAPER,
    "rock-stress": ROCK_PRESS,
    "rock-friction": replace(ROCK_PRESS, observes="friction", heading="friction [1]"),
    "micro-elongation": MICRO,
    "micro-force": replace(MICRO, observes="force", heading="force [mN]"),
}


def recorded(rig: Rig, p: Physics, plan: Plan, u: np.ndarray) -> np.ndarray:
    """Return what a rig records (n,) where its gauge shows elongations u (n,) um: these, the spring's force, or friction."""
    if rig.observes == "elongation":
        return u
    load = plan.load()
    W = np.array([load(t)[0] for t in plan.times().tolist()])
    force = u * np.array([p.spring_under(w) for w in W.tolist()])
    return np.asarray(force / W if rig.observes == "friction" else force / rig.factor)


# What a case is set in: apparatus, protocol, laws. Every combination that makes sense, by its share.

RIG_SHARES = {"paper": 0.25, "rock": 0.5, "micro": 0.25}  # some effects make sense in the first alone
PROTOCOLS = {"mixed": 0.3, "steps": 0.2, "holds": 0.12, "load-steps": 0.14, "oscillation": 0.14, "stick-slip": 0.1}
LAW_SHARES = {law: 0.25 if law in ("srf-vsat", "dieterich-ruina") else 0.1 for law in LAWS}
AGEING_SHARES = dict(zip(AGEING_LAWS, (0.4, 0.3, 0.1, 0.1, 0.1), strict=True))
NOISE_SHARES = {"white": 0.2, "ar1": 0.15, "1/f": 0.2, "spikes": 0.1, "gaps": 0.1, "uneven": 0.15, "one run louder": 0.1}
LOUDER = (1.5, 5.0)  # times the others' noise, in one run
# (true, stated) and how often: the two that laboratories take for each other, and two that nothing but their name tells of
WRONG_AGEING = {
    ("ruina", "dieterich"): 0.35,
    ("dieterich", "ruina"): 0.35,
    ("perrin-rice-zheng", "dieterich"): 0.15,
    ("nagata", "dieterich"): 0.15,
}
CHANGING_LOAD_PROTOCOLS = ("mixed", "load-steps", "oscillation")  # protocols in which the load changes


@dataclass(frozen=True)
class Setting:
    """What a case is set in: apparatus, protocol, friction law, true ageing law, and the `stated` one."""

    apparatus: str
    protocol: str
    law: str
    ageing: str
    stated: str

    @property
    def share(self) -> float:
        """Return how often it is drawn, in proportion to others."""
        ageing = AGEING_SHARES[self.ageing] if self.ageing == self.stated else WRONG_AGEING[self.ageing, self.stated]
        return RIG_SHARES[self.apparatus] * PROTOCOLS[self.protocol] * LAW_SHARES[self.law] * ageing


def settings(*, wrong_ageing: bool = False) -> list[Setting]:
    """Return every setting, with the right ageing law stated or with another one.

    A quasi-static slider has no stick-slip. Nagata's law needs the rate of the friction force, which no state of a rigid slider
    with mass has.
    """
    ageing = list(WRONG_AGEING) if wrong_ageing else [(name, name) for name in AGEING_LAWS]
    made = [Setting(a, p, law, true, stated) for a, p, law, (true, stated) in product(RIG_SHARES, PROTOCOLS, LAWS, ageing)]
    return [
        s
        for s in made
        if not (s.apparatus == "rock" and s.protocol == "stick-slip")
        and not (s.apparatus == "micro" and "nagata" in (s.ageing, s.stated))
    ]


# Which effects make sense where, and how strong: by field of Physics, weak, strong, and bounds of what stands beside.

Sizes = tuple[float, float, Mapping[str, tuple[float, float]]]
FULL_TURN = (0.0, 2 * math.pi)
# None: as the effect itself has it, that is as for the apparatus of paper; who changes those changes these.
SAME_FOR_ALL_RIGS = ("Vsat", "C", "slip_share", "cross", "ratio", "p_age", "D_power", "W_power", "rate_cut")
SIZES: Mapping[str, Mapping[str, Sizes | None]] = {
    "rock": {
        **dict.fromkeys(SAME_FOR_ALL_RIGS),
        "alpha": (0.1, 0.5, {}),
        "lam": (20.0, 300.0, {}),
        "B2": (3e-4, 4e-3, {"D2": (60.0, 300.0)}),
        "drag": (5e-7, 2e-5, {}),
        "Wa": (0.1, 2.0, {}),
        "topo": (2e-4, 2e-3, {"topo_L": (60.0, 500.0), "topo_phase": FULL_TURN}),
        "drift_t": (2e-6, 1e-4, {"drift_t0": (0.0, 20.0)}),
        "drift_x": (2e-7, 1e-5, {"drift_x0": (0.0, 150.0)}),
        "ripple": (0.01, 0.15, {"ripple_p": (40.0, 300.0), "ripple_phase": FULL_TURN}),
        "lag": (0.02, 0.5, {}),
        "poisson": (0.05, 2.0, {}),
        "bump": (8e-4, 8e-3, {"bump_x": (80.0, 350.0), "bump_w": (8.0, 60.0)}),
        "memory": (0.1, 1.0, {"memory_tau": (0.3, 5.0)}),
        "age_rate": (1e-3, 0.05, {}),
        "drive_tau": (0.05, 2.0, {}),
        "servo": (0.1, 1.0, {"servo_f": (0.05, 0.5), "servo_damping": (0.2, 0.9)}),
        "pore": (0.1, 2.0, {}),
        "creep": (3e-3, 0.1, {"creep_tau": (3.0, 60.0)}),
        "harden": (2e-4, 4e-3, {"harden_x": (50.0, 400.0)}),
        "heat": (5e-6, 2e-4, {"heat_tau": (0.5, 20.0)}),
        "dilate": (2e-4, 4e-3, {"drain": (1.0, 30.0)}),
    },
    "micro": {
        **dict.fromkeys((*SAME_FOR_ALL_RIGS, "drag", "topo", "ripple", "bump", "age_rate", "harden")),
        "alpha": (0.005, 0.1, {}),
        "B2": (3e-4, 8e-3, {"D2": (0.4, 2.0)}),
        "Wa": (5e-4, 0.02, {}),
        "drift_t": (2e-5, 1e-3, {"drift_t0": (0.0, 2.0)}),
        "drift_x": (5e-6, 1e-4, {"drift_x0": (0.0, 15.0)}),
        "lag": (2e-3, 0.05, {}),
        "poisson": (0.3, 10.0, {}),
        "memory": (0.1, 1.0, {"memory_tau": (0.03, 0.5)}),
        "drive_tau": (0.01, 0.2, {}),
        "servo": (0.1, 1.0, {"servo_f": (1.0, 10.0), "servo_damping": (0.2, 0.9)}),
        "pore": (5e-4, 0.02, {}),
        "creep": (3e-3, 0.1, {"creep_tau": (0.5, 10.0)}),
        "heat": (5e-6, 2e-4, {"heat_tau": (0.1, 5.0)}),
        "dilate": (5e-4, 8e-3, {"drain": (0.1, 5.0)}),
    },
}
NEEDS_CHANGING_LOAD = {  # nothing happens without a load that changes, or what does is a change of the baseline's parameters
    "alpha", "n_kappa", "Wa", "cross", "K_power", "poisson", "memory", "servo", "pore", "W_power",
}  # fmt: skip
NEEDS_MODULATION = {"rho", "distortion"}
NEEDS_SINGLE_AGE = {"alpha", "slip_share", "p_age", "D_power", "age_rate"}  # of the one age; two have none of their own
EXCLUDED_WITH_NAGATA = {"Wa", "cross", "K_power", "n_kappa", "eta", "lam"}  # the rate of the friction force does not follow then
ONE_RUN = ("rho", "distortion", "cross", "drift_t", "drift_x", "ripple", "lag", "topo")  # what may befall one run alone


def possible(varies: str, setting: Setting) -> bool:
    """Return whether the effect that varies a field of Physics makes sense in a setting."""
    apparatus, protocol, law, ageing, _ = setting.apparatus, setting.protocol, setting.law, setting.ageing, setting.stated
    rules = (
        apparatus == "paper" or varies in SIZES[apparatus],
        varies not in NEEDS_CHANGING_LOAD or protocol in CHANGING_LOAD_PROTOCOLS,
        varies != "lam" or apparatus == "paper" or protocol in CHANGING_LOAD_PROTOCOLS,
        varies not in NEEDS_MODULATION or (apparatus, protocol) == ("paper", "mixed"),
        varies != "Vsat" or law == "dieterich-ruina",
        varies != "C" or law == "srf-vsat",
        varies not in {"B2", *NEEDS_SINGLE_AGE} or law != "two-state",
        varies != "slip_share" or ageing in ("dieterich", "perrin-rice-zheng"),
        varies != "p_age" or ageing == "dieterich",
        varies != "dilate" or (ageing in ("dieterich", "ruina") and law != "two-state"),  # an age of D0/V
        varies != "rate_cut" or law not in ("dieterich-cutoff", "rice-regularized"),
        varies != "M" or protocol != "stick-slip",  # which a quasi-static baseline does not have
        varies not in EXCLUDED_WITH_NAGATA or ageing != "nagata",
    )
    return all(rules)


# A slider and its runs, drawn together: whether it sticks depends on both.

RIG_DRAWS = 400
STABLE = {"paper": 1.2, "rock": 2.5, "micro": 1.5}  # spring over the critical one: a quasi-static slider must be far from it
UNSTABLE = 0.8
LIGHT = 0.1  # share of the load under which a small slider that is to stick and slip begins


def draw_setup(rng: np.random.Generator, setting: Setting) -> tuple[Physics, tuple[Plan, ...]]:
    """Return a slider and its runs in a setting; beside stick-slip, those that slide steadily in steady driving.

    No runs for the paper's mixed protocol, in which it does both.
    """
    for _ in range(RIG_DRAWS):
        p, load = _slider(rng, setting)
        if (setting.apparatus, setting.protocol) == ("paper", "mixed"):
            return p, ()
        plans = _runs(rng, setting, load)
        margin = min(p.K / max(critical_spring(p, plan), 1e-12) for plan in plans)
        if setting.protocol == "stick-slip":  # nothing slides steadily where that is unstable, to begin with
            begun = min(p.K / max(critical_spring(p, replace(plan, steps=())), 1e-12) for plan in plans)
            wanted = margin < UNSTABLE and (setting.apparatus == "paper" or begun > 1 / UNSTABLE)
        else:
            wanted = margin > STABLE[setting.apparatus]
        if wanted:
            return p, plans
    raise RuntimeError(f"no slider for {setting}")


def critical_spring(p: Physics, plan: Plan) -> float:
    """Return the spring in N/um below which a rigid quasi-static slider of one age sticks, at its worst in a run."""
    largest = plan.W0 * (1 + plan.eps) + sum(max(jump, 0.0) for _, jump in plan.steps)
    found = 0.0
    for V in {v for _, v in plan.drive if v > 0}:
        slope = (steady_friction(p, V * 1.01, plan.W0) - steady_friction(p, V / 1.01, plan.W0)) / (2 * math.log(1.01))
        found = max(found, -slope * largest / p.D0)
    return found


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(f"{math.exp(rng.uniform(math.log(low), math.log(high))):.3g}")


def _slider(rng: np.random.Generator, setting: Setting) -> tuple[Physics, float]:
    """Return a slider without effects, and the load under which it is used."""
    if setting.apparatus == "paper":
        usual = Physics()
        around = {n: getattr(usual, n) * float(np.exp(0.05 * rng.standard_normal())) for n in ("A", "B", "D0", "lam", "Vsat")}
        mu, load = 0.464 * float(np.exp(0.01 * rng.standard_normal())), 7.0 if setting.protocol == "mixed" else 5.0
        p = replace(usual, **around)
    elif setting.apparatus == "rock":
        A = float(rng.uniform(0.005, 0.012))
        mu, load = float(rng.uniform(0.58, 0.72)), _log_uniform(rng, 5, 100)
        p = Physics(
            K=_log_uniform(rng, 0.01, 0.08), M=0.0, A=A, B=A + float(rng.uniform(-0.004, 0.004)), D0=_log_uniform(rng, 10, 50),
            Vsat=_log_uniform(rng, 500, 3000), rigid=True, massless=True,
        )  # fmt: skip
    else:
        A = float(rng.uniform(0.006, 0.014))
        mu, load = float(rng.uniform(0.28, 0.5)), _log_uniform(rng, 0.04, 0.6)
        more = rng.uniform(0.003, 0.01) if setting.protocol == "stick-slip" else rng.uniform(-0.005, 0.002)
        p = Physics(
            K=_log_uniform(rng, 2e-3, 1e-2), M=_log_uniform(rng, 0.5, 5) * 1e-9, A=A, B=A + float(more),
            D0=_log_uniform(rng, 0.03, 0.15), Vsat=_log_uniform(rng, 150, 1500), rigid=True,
        )  # fmt: skip
    return replace(with_laws(p, mu, rng, setting), Wref=load), load


def with_laws(p: Physics, mu: float, rng: np.random.Generator, setting: Setting) -> Physics:
    """Return a slider under a setting's laws whose friction is about `mu` in steady sliding at V0."""
    law, bare = setting.law, setting.law in BARE
    short = "" if law in ("srf-vsat", "dieterich-ruina") else law
    p = replace(p, law=short, bare=bare, mu0=mu if bare else mu - p.B * math.log1p(p.Vsat / p.V0))
    if law == "dieterich-cutoff":
        Va = _log_uniform(rng, 2e3, 3e4)
        p = replace(p, Va=Va, mu0=p.mu0 + p.A * math.log(Va / p.V0))
    elif law == "log-log":
        p = replace(p, C=float(rng.uniform(0.02, 0.07)) * p.A)
    elif law == "two-state":
        B2 = float(rng.uniform(0.15, 0.35)) * p.B
        p = replace(p, B=p.B - B2, B2=B2, D2=p.D0 * float(rng.uniform(5, 12)))
    if setting.ageing == "nagata":
        return replace(p, nagata=2.0 if setting.stated != "nagata" else float(rng.uniform(0.5, 3.0)))
    return replace(p, ageing=setting.ageing)


@dataclass(frozen=True)
class _DriveSettings:
    """How a rig is driven and read."""

    slow: tuple[float, float]  # um/s, the velocities from which steps go up
    distance: float  # um, slid at each velocity
    interval: tuple[float, float]  # s, the least and the largest between samples
    rise: float  # s, of a step of the load
    holds: tuple[float, ...]  # s
    length: float  # um, a typical slip length: there is a reading for each tenth of it, if the rig can
    steps: tuple[float, ...] = (10.0, 1.0, 3.0)  # velocities over the first
    least: float = 1.0  # s, of a piece of the drive
    jump: tuple[float, float] = (0.1, 0.3)  # of the load, relative


DRIVE_SETTINGS: Mapping[str, _DriveSettings] = {
    "paper": _DriveSettings((4.0, 8.0), 12.0, (0.002, 0.02), 0.03, (3.0, 10.0), 0.4, (4.0, 1.0, 8.0)),
    "rock": _DriveSettings((0.8, 30.0), 160.0, (0.01, 0.1), 0.5, (10.0, 30.0, 100.0), 20.0, least=4.0),
    "micro": _DriveSettings((2.0, 10.0), 12.0, (0.002, 0.02), 0.05, (5.0, 20.0), 0.08),
}
LONGEST_RUN = 6000  # samples, unless the largest interval is too short for that


def _runs(rng: np.random.Generator, setting: Setting, load: float) -> tuple[Plan, ...]:
    """Return the runs of a protocol, two to fit and one held out, but for a single run of steps and the five of a mixed one."""
    pace, protocol = DRIVE_SETTINGS[setting.apparatus], setting.protocol
    made: tuple[Plan, ...]
    if protocol == "steps":
        return (_steps("steps", pace, rng, load),)
    if protocol == "mixed":
        made = (
            _steps("steps", pace, rng, load),
            _holds("holds", pace, rng, load),
            _load_steps("loadstep", pace, rng, load),
            _oscillation("oscillation", pace, rng, load),
            _steps("holdout-steps", pace, rng, load),
        )
    elif protocol == "stick-slip":
        made = tuple(_stick_slip(name, setting, rng, load) for name in ("first", "second", "holdout"))
    else:
        draw = {"holds": _holds, "load-steps": _load_steps, "oscillation": _oscillation}[protocol]
        made = tuple(draw(name, pace, rng, load) for name in ("first", "second", "holdout"))
    return (*made[:-1], replace(made[-1], holdout=True))


def _sampled(plan: Plan, pace: _DriveSettings, fastest: float) -> Plan:
    """Return a run sampled as its velocities and its length ask for."""
    wanted = max(pace.length / (10 * fastest), plan.duration / LONGEST_RUN)
    if plan.eps:
        wanted = min(wanted, 1 / (40 * plan.f))
    interval = float(f"{min(max(wanted, pace.interval[0]), pace.interval[1]):.1g}")
    return replace(plan, interval=interval, rise=pace.rise)


def _drive_piece(pace: _DriveSettings, V: float) -> tuple[float, float]:
    """Return a piece of the drive, (s, um/s), that slides the usual distance."""
    return float(f"{max(pace.distance / V, pace.least):.2g}"), V


def _perturbed(rng: np.random.Generator, value: float, spread: float) -> float:
    return float(f"{value * (1 + rng.uniform(-spread, spread)):.3g}")


def _steps(name: str, pace: _DriveSettings, rng: np.random.Generator, load: float) -> Plan:
    """Three steps of velocity."""
    V = _log_uniform(rng, *pace.slow)
    velocities = [V, *(float(f"{V * factor:.3g}") for factor in pace.steps)]
    plan = Plan(name, tuple(_drive_piece(pace, v) for v in velocities), load, 1.0)
    return _sampled(plan, pace, max(velocities))


def _holds(name: str, pace: _DriveSettings, rng: np.random.Generator, load: float) -> Plan:
    """Slide, hold, slide: the drive stands still for ever longer."""
    V = _log_uniform(rng, max(pace.slow[0], 0.3 * pace.slow[1]), pace.slow[1])
    drive = [_drive_piece(pace, V)]
    for hold in pace.holds:
        drive += [(_perturbed(rng, hold, 0.2), 0.0), _drive_piece(pace, V)]
    return _sampled(Plan(name, tuple(drive), load, 1.0), pace, V)


def _load_steps(name: str, pace: _DriveSettings, rng: np.random.Generator, load: float) -> Plan:
    """The load goes up, back, up by more and back."""
    V = _log_uniform(rng, max(pace.slow[0], 0.2 * pace.slow[1]), pace.slow[1])
    base = _perturbed(rng, load, 0.2)
    wait = max(_drive_piece(pace, V)[0], 8 * pace.rise)
    sizes = [float(f"{base * rng.uniform(*pace.jump) * more:.3g}") for more in (1.0, 1.5)]
    jumps = (sizes[0], -sizes[0], sizes[1], -sizes[1])
    at = [float(f"{wait * (k + 1) * (1 + rng.uniform(-0.05, 0.05)):.3g}") for k in range(4)]
    plan = Plan(name, ((float(f"{5 * wait:.2g}"), V),), base, 1.0, steps=tuple(zip(at, jumps, strict=True)))
    return _sampled(plan, pace, V)


def _oscillation(name: str, pace: _DriveSettings, rng: np.random.Generator, load: float) -> Plan:
    """The load oscillates slowly, with a period of 0.5 to 50 s, from some time on."""
    V = _log_uniform(rng, max(pace.slow[0], 0.3 * pace.slow[1]), pace.slow[1])
    period = _log_uniform(rng, 0.5, 50)
    rest = max(_drive_piece(pace, V)[0], 0.3 * period)
    duration = rest + max((8 if period < 10 else 3) * period, pace.distance / V)
    eps, onset = float(f"{rng.uniform(0.05, 0.2):.2g}"), float(f"{rest:.2g}")
    plan = Plan(name, ((float(f"{duration:.2g}"), V),), _perturbed(rng, load, 0.1), 1.0, eps=eps, f=1 / period, onset=onset)
    return replace(_sampled(plan, pace, V), rise=float(f"{max(0.1 * period, pace.rise):.2g}"))


def _stick_slip(name: str, setting: Setting, rng: np.random.Generator, load: float) -> Plan:
    """A drive slow enough, under a load large enough, that the slider sticks and slips; a small one's load is put on at first."""
    if setting.apparatus == "paper":
        drive = ((0.5, _perturbed(rng, 12, 0.15)), (5.0, _perturbed(rng, 8, 0.3)))
        return Plan(name, drive, _perturbed(rng, 9.5, 0.06), 0.004)
    drive = ((1.0, _log_uniform(rng, 3, 6)), (8.0, _log_uniform(rng, 1, 5)))
    whole = _perturbed(rng, load, 0.2)
    light = float(f"{LIGHT * whole:.3g}")
    return Plan(name, drive, light, 0.004, steps=((0.5, round(whole - light, 6)),))


# The gauge of a rig, and the kind of noise that it has.


def draw_gauge(rng: np.random.Generator, rig: str, p: Physics, noise: str) -> Gauge:
    """Return a gauge of a rig, by a kind of noise of NOISE_SHARES."""
    if rig == "paper":
        sigma = SIGMA
    elif rig.startswith("rock"):  # of friction; good recordings to poor ones
        sigma = float(np.exp(rng.uniform(*np.log((1e-4, 6e-4))))) * (p.Wref if rig == "rock-stress" else 1.0)
    else:
        sigma = float(np.exp(rng.uniform(*np.log((0.008, 0.03))))) * (p.K * 1e3 if rig == "micro-force" else 1.0)
    quantum = QUANTUM if rig == "paper" else 10.0 ** math.floor(math.log10(sigma / 2))
    lag1, pink = float(rng.uniform(0.3, MAX_LAG1)), float(rng.uniform(0.3, 0.9))
    spikes = int(rng.integers(1, 4))
    return Gauge(
        float(f"{sigma:.3g}"), lag1 if noise == "ar1" else 0.0, quantum, pink if noise == "1/f" else 0.0,
        spikes if noise == "spikes" else 0,
    )  # fmt: skip


def disturbed(rng: np.random.Generator, plans: Sequence[Plan], noise: str) -> tuple[Plan, ...]:
    """Return runs with the gaps, the uneven sampling, or the one louder run of a kind of noise.

    No gap falls where the load changes, as nobody would know how; a recorder is slowed down where the load is constant.
    """
    fitted, out = [plan.name for plan in plans if not plan.holdout], []
    loud = str(rng.choice(fitted)) if noise == "one run louder" and len(fitted) > 1 else ""
    for plan in plans:
        if plan.name == loud:
            plan = replace(plan, loud=float(f"{np.exp(rng.uniform(*np.log(LOUDER))):.3g}"))
        elif noise == "gaps" and not plan.eps:
            begin = float(f"{plan.duration * rng.uniform(0.15, 0.85):.3g}")
            gap = (begin, float(f"{begin + plan.duration * rng.uniform(0.01, 0.05):.4g}"))
            near = 4 * (plan.rise or 0.03)
            if all(at < gap[0] - near or at > gap[1] + near for at, _ in plan.steps):
                plan = replace(plan, gaps=(gap,))
        elif noise == "uneven":
            wander = float(rng.uniform(0.05, 0.2))
            if plan.eps or plan.steps or rng.uniform() < 0.5:
                plan = replace(plan, wander=wander)
            else:
                shortest = min(duration for duration, _ in plan.drive)
                plan = replace(plan, dense=float(f"{0.4 * shortest:.2g}"))
        out.append(plan)
    return tuple(out)
