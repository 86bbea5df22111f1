"""The solved equations against the balance they were solved from, along the flow: d/dt of each quantity by complex steps.

Nothing of what builds the equations is used here but the laws' own formulas: with the rates r of a generated model, a function
h(x, t) changes at the rate Im h(x + i s r, t + i s)/s, and the slip relation, the force balance and the ageing laws either hold
with it or they do not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

from srfcli.codegen.c_source import compiler
from srfcli.codegen.model import COMPLEX_STEP, load_source
from srfcli.core.errors import SrfError
from srfcli.laws.expression import symbol
from srfcli.laws.registry import bundled_registry
from srfcli.laws.values import Effect
from srfcli.motion.imposed import Drive, Modulation
from srfcli.motion.integrators import integrate, integrate_lsoda, scalar_function
from srfcli.symbolic.equations import equations_of, lut, partial_derivative, steady_states
from srfcli.symbolic.system import System, build_system
from srfcli.tasks.law_check import evaluate

REGISTRY = bundled_registry()
POINTS = 12
PLAIN = [
    {},
    {"interface": "rigid"},
    {"interface": "power"},
    {"inertia": False},
    {"inertia": False, "interface": "rigid", "ageing": "ruina"},
    {"law": "two-state"},
    {"law": "two-state", "inertia": False, "ageing": "ruina"},
    {"law": "log-log", "ageing": "dieterich+linker-dieterich"},
    {"ageing": "nagata"},
    {"ageing": "nagata", "inertia": False},
    {"loading": "inclined"},
    {"loading": "inclined", "interface": "rigid"},
    {"loading": "inclined", "inertia": False, "ageing": "dieterich+linker-dieterich"},
]
SINGLE = [{"effects": (e.name,)} for e in REGISTRY.entries("effect")]
OTHER = [
    {"effects": ("age-saturation",), "law": "dieterich-ruina"},
    {"effects": ("inertia",), "inertia": False},
    {"effects": ("interface-compliance",), "interface": "rigid"},
    {"effects": ("adhesion-offset",), "inertia": False},
    {"effects": ("tangential-crosstalk",), "inertia": False},
    {"effects": ("load-transmission",), "interface": "rigid"},
    {"effects": ("load-distortion",), "inertia": False, "interface": "rigid"},
    {"effects": ("second-state", "friction-drift-slip"), "law": "dieterich-ruina"},
    {"effects": ("viscous-drag",), "law": "two-state"},
    {"effects": ("load-stiffening",), "inertia": False},
    {"effects": ("poisson-coupling",), "inertia": False},
]
PAIRS = [
    {"effects": ("linker-dieterich", "tangential-crosstalk")},
    {"effects": ("load-distortion", "stiffness-exponent"), "ageing": "ruina"},
    {"effects": ("drive-ripple", "track-topography")},
    {"effects": ("adhesion-offset", "sensor-lag", "slip-evolution"), "inertia": False},
    {"effects": ("load-stiffening", "gauge-creep", "tangential-crosstalk"), "inertia": False, "interface": "rigid"},
    {"effects": ("load-servo", "load-stiffening", "poisson-coupling", "linker-dieterich")},
]
OWN = Path(__file__).resolve().parent / "effects"
HEARD = str(OWN / "hearsay.toml")  # friction, stiffness, force and ageing hear of an unknown, of u, slip and the clock
OF_ONES_OWN = [{"effects": (str(path),)} for path in sorted(OWN.glob("*.toml")) if str(path) != HEARD]
OF_ONES_OWN += [
    {"effects": (HEARD,)},
    {"effects": (HEARD, "adhesion-offset"), "interface": "power"},
    {"effects": (str(OWN / "load-memory.toml"), "stiffness-exponent"), "inertia": False},
    {"effects": (str(OWN / "load-memory.toml"), "linker-dieterich"), "interface": "rigid"},
]
WITH = [c for c in SINGLE if c["effects"][0] != "age-saturation"] + OTHER + PAIRS + OF_ONES_OWN


def formulas() -> list[sp.Expr]:
    """Return the formulas of all shipped laws and effects, and some that none of them has."""
    found = []
    for kind, get in (("friction", "mu"), ("ageing", "rate"), ("modifier", "rate"), ("interface", "kappa")):
        found += [getattr(REGISTRY.get(kind, e.name), get, None) for e in REGISTRY.entries(kind)]
    found += [f for e in REGISTRY.entries("effect") for _, f in REGISTRY.get("effect", e.name).changes]
    x, y = symbol("v"), symbol("phi")
    found += [x**y, sp.LambertW(x * y), lut(sp.Integer(2), x * y) * sp.exp(-x / y), sp.Max(x, y), sp.sqrt(x) / (x + y) ** 2]
    return [sp.sympify(f) for f in found if f is not None]


def test_partial_derivatives_are_those_of_sympy() -> None:
    seen = 0
    for formula in formulas():
        for name in formula.free_symbols | {symbol("v")}:
            assert partial_derivative(formula, name) == sp.diff(formula, name), (formula, name)
            seen += 1
    assert seen > 150


def name_of(names: dict[str, Any]) -> str:
    return (
        "+".join([*(Path(e).stem for e in names.get("effects", ())), *(f"{k}={v}" for k, v in names.items() if k != "effects")])
        or "default"
    )


class Balance:
    """Every quantity of a slider as a function of (x, t) alone, from the laws' formulas; t counts from the point looked at."""

    def __init__(self, system: System, model: Any, point: dict[str, float], p: np.ndarray) -> None:
        self.system, self.model, self.point = system, model, point
        self.p = dict(zip(model.names, p.tolist(), strict=True))
        self.vector = p

    def named(self, x: np.ndarray) -> dict[str, Any]:
        """Return the unknowns by name, v and phi for their logarithms."""
        logs = self.model.logarithmic
        return {
            n.removeprefix("ln_") if log else n: np.exp(s) if log else s
            for n, log, s in zip(self.model.states, logs, x, strict=True)
        }

    def changed(self, slot: str, value: Any, values: dict[str, Any]) -> Any:
        """Return what the effects make of a slot's value, one after the other."""
        for effect in self.system.effects:
            for name, formula in effect.changes:
                if name == slot:
                    value = evaluate(formula, {**values, slot: value})
        return value

    def at(self, x: np.ndarray, t: complex) -> dict[str, Any]:
        """Return every quantity at states x, time t after the point."""
        system, given = self.system, self.point
        known: dict[str, Any] = {**self.p, **self.named(x), "V": given["V"]}
        imposed = given["W"] + given["W_dot"] * t
        if "time" in known:
            known["theta"] = 2 * np.pi * known["f"] * known["time"] + known["psi"]
            known["envelope"] = (1 + np.tanh((known["time"] - known["onset0"]) / known["rise0"])) / 2
        known["imposed"] = imposed
        load = self.changed("W", imposed, {**known, "W": imposed})
        force = self.changed("force", 0.0, {**known, "W": imposed})
        mu = lambda W: self.changed("mu", evaluate(system.friction.mu, {**known, "W": W}), {**known, "W": W})  # noqa: E731
        u = known.get("u")
        if system.loading == "inclined":
            tangent = np.tan(self.p["angle"])
            p = self.vector.copy()
            p[self.model.index("V")] = given["V"]  # the load is W where sliding at this V is steady
            rest = np.asarray(self.model.elongation(self.model.steady(p), given["V"], self.p["W0"], 0.0, p))
            if u is None:  # K u = W mu and W = imposed + tan K (u - u_ss) together
                u = (imposed - tangent * self.p["K"] * rest) * mu(load) / self.p["K"] / (1 - tangent * mu(load))
            load = imposed + tangent * self.p["K"] * (u - rest)
        friction = mu(load)
        K = self.changed("K", self.p["K"], {**known, "W": imposed})
        if u is None:
            u = (load * friction - force) / K
        gauge = u * K / self.p["K"] if self.p.get("weighed") else u
        kappa = None
        if system.interface.kappa is not None:
            kappa = self.changed("kappa", evaluate(system.interface.kappa, {**known, "W": load}), {**known, "W": load})
        return {
            **known,
            "W": load,
            "mu": friction,
            "force": force,
            "u": u,
            "F": load * friction,
            "V": self.changed("V", given["V"], {**known, "W_dot": given["W_dot"]}),
            "spring": K,
            "gauge": gauge,
            "S": 0.0 if kappa is None else load * friction / kappa,
        }


def random_points(model: Any, p: np.ndarray) -> list[tuple[np.ndarray, dict[str, float]]]:
    rng = np.random.default_rng(3)
    rest = np.asarray(model.steady(p))
    found = []
    for _ in range(POINTS):
        r = rng.standard_normal(rest.size)
        x = np.where(model.logarithmic, rest + 0.4 * r, rest * (1 + 0.05 * r))
        for name, scale in (("slip", 30.0), ("stage", 30.0), ("time", 1.5)):
            if name in model.states:
                x[model.states.index(name)] = scale * rng.uniform()
        found.append((x, {"V": 9 * rng.uniform(0.7, 1.3), "W": 6 * rng.uniform(0.8, 1.2), "W_dot": 300 * rng.standard_normal()}))
    return found


def prepared(make_model: Any, names: dict[str, Any]) -> tuple[System, Any, np.ndarray]:
    system, model = build_system(REGISTRY, **names), make_model(**names, stability=False)
    run = {
        "V": 9.0,
        "W0": 6.0,
        "eps": 0.15,
        "f": 110.0,
        "psi": 0.4,
        "onset0": 0.6,
        "rise0": 0.2,
        "modulated": 1.0,
        "start": 2.0,
        "weighed": 1.0,
    }
    return system, model, model.vector({n: v for n, v in run.items() if n in model.names})


@pytest.mark.parametrize("names", PLAIN + WITH, ids=name_of)
def test_the_rates_fulfil_the_balance(make_model, names):
    system, model, p = prepared(make_model, names)
    names_of = list(model.states)
    for x, point in random_points(model, p):
        balance = Balance(system, model, point, p)
        r = np.asarray(model.rates(x, point["V"], point["W"], point["W_dot"], p))
        assert np.isfinite(r).all()
        now, later = balance.at(x, 0.0), balance.at(x + 1j * COMPLEX_STEP * r, 1j * COMPLEX_STEP)
        rate = {
            n: np.imag(later[n]) / COMPLEX_STEP
            for n in ("W", "mu", "F", "S", "u", "force", *(s.name for s in system.friction.states))
        }
        slip = now["z"] if "z" in now else now["v"] + rate["S"] if not system.inertia else now["v"]
        if system.inertia and system.elastic:
            assert now["z"] - now["v"] == pytest.approx(rate["S"], rel=1e-8, abs=1e-8 * now["v"])
        assert rate["u"] == pytest.approx(now["V"] - slip, rel=1e-8, abs=1e-8 * now["v"])
        if system.inertia:
            moved = r[names_of.index("z")] if system.elastic else now["v"] * r[names_of.index("ln_v")]
            pull = now["spring"] * now["u"] - now["F"] + now["force"]
            assert p[model.index("M")] * moved == pytest.approx(pull, abs=1e-9 * now["F"])
        for state in system.friction.states:
            own = {"phi": now[state.name], "D0": now[state.length], "B": now[state.weight]}
            values = {**now, **own, "mu_dot": rate["mu"], "W_dot": rate["W"], "F_dot_over_W": rate["F"] / now["W"]}
            wanted = evaluate(system.ageing.rate, values) + sum(evaluate(m.term, values) for m in system.modifiers)
            wanted = balance.changed("rate", wanted, values)
            assert rate[state.name] == pytest.approx(wanted, rel=1e-8, abs=1e-8)
        for extra in system.extra_states:
            at = list(map(lambda n: n.removeprefix("ln_"), names_of)).index(extra.name)
            grown = r[at] * (now[extra.name] if extra.logarithmic else 1.0)
            assert grown == pytest.approx(evaluate(extra.rate, {**now, "W": point["W"], "V": point["V"]}), rel=1e-9, abs=1e-9)
        shown = now["gauge"]
        for effect in system.effects:
            shown = now[effect.observed] if effect.observed else shown
            for slot, formula in effect.changes:
                shown = evaluate(formula, {**now, "gauge": shown}) if slot == "gauge" else shown
        given = (point["V"], point["W"], point["W_dot"])
        if system.effects:
            assert float(model.reading(x, *given, p)) == pytest.approx(shown, rel=1e-10)
        for auxiliary, expected in (("slip", now["v"]), ("stage", point["V"]), ("time", 1.0)):
            if auxiliary in names_of:
                assert r[names_of.index(auxiliary)] == expected


@pytest.mark.parametrize("names", WITH, ids=name_of)
def test_a_run_begins_in_steady_sliding(make_model, names):
    """Friction at V under W0, in which the force along the track is none yet; the clock and the places are the run's."""
    system, model, p = prepared(make_model, names)
    x = np.asarray(model.steady(p))
    balance = Balance(system, model, {"V": 9.0, "W": 6.0, "W_dot": 0.0}, p)
    now = balance.at(x, 0.0)
    assert now["v"] == pytest.approx(9.0)
    assert now.get("z", 9.0) == pytest.approx(9.0)
    aged = {**now, "mu_dot": 0.0, "W_dot": 0.0, "F_dot_over_W": 0.0}
    assert balance.changed("rate", evaluate(system.ageing.rate, aged), aged) == pytest.approx(0.0, abs=1e-12)
    assert now["spring"] * now["u"] == pytest.approx(now["F"] - now["force"], rel=1e-12)
    assert [now[n] for n in ("slip", "stage", "time") if n in now] == [
        {"slip": 2.0, "stage": 0.0, "time": 0.0}[n] for n in ("slip", "stage", "time") if n in now
    ]
    for extra in system.extra_states:
        assert now[extra.name] == pytest.approx(evaluate(extra.steady, now))


@pytest.mark.parametrize("names", WITH, ids=name_of)
def test_scalar_text_is_the_array_text(make_model, names):
    _, model, p = prepared(make_model, names)
    scalar = {n: scalar_function(model, n, p) for n in ("rates", "rates_jacobian", "rates_parameters")}
    for x, point in random_points(model, p)[:3]:
        given = (point["V"], point["W"], point["W_dot"])
        for name, function in scalar.items():
            expected = np.asarray(getattr(model, name)(x, *given, p))
            scale = np.abs(expected).max()
            assert np.array(function(x.tolist(), *given)) == pytest.approx(expected, rel=1e-9, abs=1e-12 * scale)


@pytest.mark.skipif(compiler() is None, reason="no C compiler on this machine")
@pytest.mark.parametrize(  # effects in pairs: their rates and scalar text are held against the equations above
    "names", [*OTHER, *(pytest.param(n, marks=pytest.mark.slow) for n in PAIRS), OF_ONES_OWN[-4]], ids=name_of
)
def test_compiled_motion_is_that_of_lsoda(make_model, names):
    _, model, p = prepared(make_model, names)
    t = np.linspace(0.0, 0.4, 81)
    drive, load = Drive.steps([(0.0, 9.0), (0.1, 20.0)]), Modulation(6.0, 0.1, 110.0, 0.15)
    by = [model.index(n) for n in ("mu0", "A", "K")] + [
        model.index(q.name) for e in build_system(REGISTRY, **names).effects for q in e.parameters
    ]
    start, S0 = np.asarray(model.steady(p)), np.zeros((len(model.states), len(by)))
    atol = 1e-9 * np.array([20.0 if s == "z" else 1.0 for s in model.states])
    ours = integrate(model, p, drive=drive, load=load, t=t, start=start, by=by, S0=S0, rtol=1e-9, atol=atol)
    other = integrate_lsoda(model, p, drive, load, t, start, by, S0, 1e-10, 0.1 * atol)
    assert ours.status.ok and other.status.ok
    assert np.abs(ours.x - other.x).max(axis=0) == pytest.approx(0.0, abs=2e-6 * (1 + np.abs(other.x).max()))
    size = np.abs(other.S).max(axis=(0, 1))
    assert (np.abs(ours.S - other.S).max(axis=(0, 1)) <= 2e-3 * size + 1e-9).all()
    assert np.ptp(other.x[:, 0]) > 0.01 and (size > 0).sum() >= 3


def test_parameters_of_one_name_are_told_apart(make_model):
    model = make_model(effects=("drive-ripple", "track-topography"))
    assert {"drive_ripple_amplitude", "track_topography_amplitude", "drive_ripple_phase", "pitch", "wavelength"} <= {*model.names}
    assert "amplitude" not in model.names
    single = make_model(effects=("drive-ripple",))
    both = {"drive_ripple_amplitude": 0.05, "drive_ripple_phase": 0.3, "track_topography_amplitude": 0.0}
    given = (9.0, 6.0, 100.0)
    x = np.asarray(single.steady(single.vector()))
    one = single.rates(x, *given, single.vector({"amplitude": 0.05, "phase": 0.3}))
    wide = np.concatenate([x[:4], [0.0], x[4:]])
    two = model.rates(wide, *given, model.vector(both))
    kept = [model.states.index(s) for s in single.states]
    assert two[kept] == pytest.approx(np.asarray(one), rel=1e-12)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"effects": ("stiffness-exponent",), "interface": "rigid"}, "changes kappa, which .* does not have"),
        ({"effects": ("log-log-coupling",), "law": "dieterich-ruina"}, "uses 'Vsat'"),
        ({"effects": ("adhesion-offset",), "loading": "inclined"}, "vertical loading"),
        ({"effects": ("second-state",), "law": "two-state"}, "brings 'B2', which a law of two-state"),
        ({"effects": ("linker-dieterich",), "ageing": "dieterich+linker-dieterich"}, "brings 'alpha'"),
        ({"effects": ("second-state", "second-state")}, "brings 'phi2'"),
        ({"effects": ("no-such",)}, "unknown effect"),
    ],
    ids=lambda v: name_of(v) if isinstance(v, dict) else "",
)
def test_effects_that_do_not_apply_are_told(names, message):
    with pytest.raises(SrfError, match=message):
        equations_of(build_system(REGISTRY, **names))


@pytest.mark.parametrize(
    ("formulas", "names", "message"),
    [
        ('W = "W*(1 + a*v)"', {}, "W of .* depends on v"),
        ('W = "W*(1 + a*phi)"', {}, "W of .* depends on phi"),
        ('kappa = "kappa*(1 + a*mu)"', {}, "kappa of .* depends on mu"),
        ('mu = "mu + a*V"', {}, "mu of .* depends on V"),
        ('force = "force - a*v"', {"inertia": False}, "force of .* depends on v"),
        ('mu = "mu + a*mu_dot"', {}, "'mu_dot' has no value"),
        ('mu = "mu + a*u"', {"inertia": False}, "'u' has no value"),
        ('rate = "rate + a*mu_dot**2"', {}, "not linear in mu_dot"),
    ],
)
def test_what_cannot_be_followed_is_told(tmp_path, formulas, names, message):
    text = f'format = "srf-law/1"\nkind = "effect"\n{formulas}\n[parameters]\na = {{ default = 0.1, neutral = 0.0 }}\n'
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(SrfError, match=message):
        equations_of(build_system(REGISTRY, effects=(str(tmp_path / "mine.toml"),), **names))


def test_a_motion_module_of_a_plain_system_is_the_whole_one_s(make_model):
    from srfcli.codegen.numpy_source import generate_motion

    for names in PLAIN[:7]:
        whole, motion = make_model(**names), load_source(generate_motion(build_system(REGISTRY, **names)))
        p = whole.vector({"V": 9.0, "W0": 6.0})
        for x, point in random_points(whole, p)[:2]:
            given = (point["V"], point["W"], point["W_dot"], p)
            assert np.asarray(motion.rates(x, *given)) == pytest.approx(np.asarray(whole.rates(x, *given)), rel=1e-9)


def test_every_shipped_effect_is_here():
    assert {n for c in WITH for n in c["effects"] if not n.endswith(".toml")} == {e.name for e in REGISTRY.entries("effect")}
    assert all(isinstance(REGISTRY.get("effect", n), Effect) for c in WITH for n in c["effects"])


@pytest.mark.parametrize(
    "rate",
    [
        "1 - 0.5*v*phi/D0 - 0.25*(v*phi/D0)**3",  # a polynomial
        "2 - sqrt(v*phi/D0) - v*phi/D0",
        "6 - sqrt(v*phi/D0) - v*phi/D0",  # at 4; its square has the root 9, too
        "2 - log(v*phi/D0) - 0.3*log(v*phi/D0)**2",
        "2 - v*phi/D0 - 0.3*log(v*phi/D0)",  # a Lambert function
        "2 - (v*phi/D0)**q - 0.3*(v*phi/D0)**(2*q)",
        None,
    ],
)
def test_a_law_of_one_s_own_has_its_steady_state(rate: str | None, tmp_path: Path) -> None:
    """The rate vanishes there; a law without a closed form is told so."""
    law = tmp_path / "own.toml"
    head = 'format = "srf-law/1"\nkind = "ageing"\nname = "own"\nabout = "made up"\n'
    end = '\n[parameters]\nq = { default = 0.7, unit = "1", bounds = [0.1, 3], about = "x" }\n'
    law.write_text(f'{head}rate = "{rate or "1 - 0.7*v*phi/D0 - 0.2*(v*phi/D0)**q - 0.3*log(v*phi/D0)**2"}"{end}')
    system = build_system(REGISTRY, ageing=str(law))
    if rate is None:
        with pytest.raises(SrfError, match="no closed form for the steady state"):
            steady_states(system)
        return
    (phi,) = steady_states(system)
    at = {"v": 3.0, "D0": 0.4, "q": 0.7}
    y = float(phi.subs({symbol(n): value for n, value in at.items()})) * at["v"] / at["D0"]
    names = {"sqrt": np.sqrt, "log": np.log, "phi": y * at["D0"] / at["v"], **at}
    assert y > 0 and abs(eval(rate, {"__builtins__": {}}, names)) < 1e-12
