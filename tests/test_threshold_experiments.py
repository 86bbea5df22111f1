"""Critical loads under effects, and experiments that hold tables of critical loads."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.integrate import solve_ivp

import srfcli as srf
from srfcli.cli.main import cli
from srfcli.core.errors import SrfError
from srfcli.inference.thresholds import forced_slopes, hopf_slopes
from srfcli.numerics.boundary import along, polish
from srfcli.numerics.critical import critical_line
from srfcli.numerics.hopf import critical_point, hopf_points

# critical loads under effects


def loads(model: Any, lo: float, hi: float, **values: float) -> np.ndarray:
    """All critical loads of a line."""
    points = critical_line(model, model.vector(values), lo=lo, hi=hi, samples=60, tol=1e-10).points
    return np.array([q.value(model, "W0") for q in points])


def with_effects(make_model: Any, *names: str, **laws: Any) -> Any:
    return make_model(effects=names, stability=True, **laws)


def lag(share: float, tau: float, f: float) -> complex:
    """What the asperities feel of a modulation of which a share comes through a lag of first order."""
    return 1 + share * (1 / (1 + 2j * math.pi * f * tau) - 1)


def servo(share: float, natural: float, damping: float, f: float) -> complex:
    """The same through a servo of second order."""
    w, s = 2 * math.pi * natural, 2j * math.pi * f
    return 1 + share * (w**2 / (s**2 + 2 * damping * w * s + w**2) - 1)


FELT = {  # effects that change the amplitude of a modulation, and its phase, which critical loads do not feel
    "load-transmission": ({"rho": 0.6}, 0.6),
    "load-lag": ({"share": 0.7, "lag_time": 2e-3}, abs(lag(0.7, 2e-3, 120.0))),
    "load-servo": ({"share": 1.0, "natural": 80.0, "damping": 0.5}, abs(servo(1.0, 80.0, 0.5, 120.0))),
}


@pytest.mark.parametrize("name", FELT)
def test_what_the_asperities_feel_of_a_modulation_is_another_amplitude(make_model: Any, model: Any, name: str) -> None:
    values, share = FELT[name]
    felt = with_effects(make_model, name)
    for V, eps, lo, hi in ((10.0, 0.09, 6.0, 20.0), (25.0, 0.13, 11.0, 24.0)):
        got = loads(felt, lo, hi, V=V, eps=eps / share, **values)
        assert got == pytest.approx(loads(model, lo, hi, V=V, eps=eps), rel=1e-8)
    assert got.size == 3


def test_a_pressure_moves_load_and_amplitude(make_model: Any, model: Any) -> None:
    pressed, p = with_effects(make_model, "pore-pressure"), 1.5
    (load,) = loads(model, 8.0, 12.0, V=8.0, eps=0.09)
    moved = loads(pressed, 9.0, 14.0, V=8.0, eps=0.09 * load / (load + p), pressure=p)
    assert moved == pytest.approx([load + p], rel=1e-8)
    still, pushed = (critical_point(m, m.vector(v))[0] for m, v in ((model, {"V": 8.0}), (pressed, {"V": 8.0, "pressure": p})))
    assert still is not None and pushed is not None
    assert abs(pushed.W0 - still.W0 - p) < 1e-11


LAWS = [  # effect, its values, the system whose law says the same, and its values
    ("linker-dieterich", {"alpha": 0.2}, {"ageing": "dieterich+linker-dieterich"}, {"alpha": 0.2}),
    ("viscous-drag", {"c": 4e-4}, {"law": "dragged"}, {"c": 4e-4}),
    ("stiffness-exponent", {"n": 0.5}, {"interface": "powered"}, {"n": 0.5}),
    ("second-state", {"B2": 0.004, "D2": 3.0}, {"law": "doubled"}, {"B2": 0.004, "D2": 3.0}),
]
DRAGGED = """
format = "srf-law/1"
kind = "friction"
name = "dragged"
mu = "mu0 + A*log(v/V0) + B*log(1 + Vsat*phi/D0){term}"
{states}
[parameters]
mu0 = {{ default = 0.33, unit = "1" }}
A = {{ default = 0.0126, unit = "1" }}
B = {{ default = 0.0241, unit = "1" }}
D0 = {{ default = 0.402, unit = "um" }}
V0 = {{ default = 1.0, unit = "um/s" }}
Vsat = {{ default = 256.0, unit = "um/s" }}
{own}
"""
POWERED = """
format = "srf-law/1"
kind = "interface"
name = "powered"
kappa = "W/lambda*(W/Wref)**(n - 1)"
[parameters]
lambda = { default = 0.56, unit = "um" }
n = { default = 1.0, unit = "1" }
Wref = { default = 7.0, unit = "N" }
"""


@pytest.fixture(scope="module")
def equivalents(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with laws that say what effects say."""
    folder = tmp_path_factory.mktemp("laws")
    drag = DRAGGED.format(term=" + c*v/V0", states="", own='c = { default = 0.0, unit = "1" }')
    (folder / "dragged.toml").write_text(drag)
    states = 'states = [{ name = "phi", length = "D0", weight = "B" }, { name = "phi2", length = "D2", weight = "B2" }]'
    own = 'B2 = { default = 0.004, unit = "1" }\nD2 = { default = 3.0, unit = "um" }'
    both = DRAGGED.format(term=" + B2*log(V0*phi2/D2)", states=states, own=own).replace('"dragged"', '"doubled"')
    (folder / "doubled.toml").write_text(both)
    (folder / "powered.toml").write_text(POWERED)
    return folder


@pytest.mark.parametrize(("effect", "values", "law", "same"), LAWS, ids=[x[0] for x in LAWS])
def test_an_effect_has_the_critical_loads_of_the_law_that_says_the_same(
    make_model: Any, equivalents: Path, effect: str, values: dict[str, float], law: dict[str, str], same: dict[str, float]
) -> None:
    one, other = with_effects(make_model, effect), srf.system(plugins=[equivalents], **law).model  # type: ignore[arg-type]
    assert loads(one, 4.0, 20.0, V=10.0, eps=0.09, **values) == pytest.approx(
        loads(other, 4.0, 20.0, V=10.0, eps=0.09, **same), rel=1e-8
    )
    a, b = (hopf_points(m, m.vector({"V": 10.0, **v}))[0] for m, v in ((one, values), (other, same)))
    assert (a.W0, a.Omega, a.crossing_rate) == pytest.approx((b.W0, b.Omega, b.crossing_rate), rel=1e-8)
    assert a.lyapunov == pytest.approx(b.lyapunov, rel=1e-6)


def test_multipliers_of_a_second_state_are_those_of_shooting(make_model: Any) -> None:
    """The equations by hand, DOP853, and a monodromy matrix by central differences."""
    at = {"V": 8.0, "W0": 9.0, "eps": 0.09, "f": 120.0, "K": 0.21, "M": 2.37e-6, "B2": 0.004, "D2": 3.0}
    mu0, A, B, D0, V0, Vsat, lam = 0.33, 0.0126, 0.0241, 0.402, 1.0, 256.0, 0.56

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        u, z, v, phi, phi2 = x[0], x[1], *np.exp(x[2:])
        share = Vsat * phi / D0 / (1 + Vsat * phi / D0)
        mu = mu0 + A * np.log(v / V0) + B * np.log1p(Vsat * phi / D0) + at["B2"] * np.log(V0 * phi2 / at["D2"])
        W = at["W0"] * (1 + at["eps"] * np.cos(2 * np.pi * at["f"] * t))
        aged, aged2 = 1 / phi - v / D0, 1 / phi2 - v / at["D2"]
        faster = ((z - v) / lam - B * share * aged - at["B2"] * aged2) / A
        return np.array([at["V"] - z, (at["K"] * u - W * mu) / at["M"], faster, aged, aged2])

    def period(x: np.ndarray) -> np.ndarray:
        return solve_ivp(rates, (0, 1 / at["f"]), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]

    def monodromy(x: np.ndarray) -> np.ndarray:
        steps = 1e-5 * np.eye(5)
        return np.stack([(period(x + s) - period(x - s)) / 2e-5 for s in steps], axis=1)

    model = with_effects(make_model, "second-state")
    x = np.asarray(model.steady(model.vector(at)))
    for _ in range(8):
        x = x - np.linalg.solve(monodromy(x) - np.eye(5), period(x) - x)
    assert np.abs(period(x) - x).max() < 1e-9
    slider = srf.system(effects=["second-state"], W0=9, V=8, eps=0.09, B2=0.004, D2=3)
    found = srf.floquet(slider, tol=1e-9).to_dataframe()
    expected = np.linalg.eigvals(monodromy(x))
    got = found["re"].to_numpy() + 1j * found["im"].to_numpy()
    assert np.sort_complex(got) == pytest.approx(np.sort_complex(expected), abs=1e-6)


SLOPES = [
    ("load-lag", {"share": 0.7, "lag_time": 2e-3}),
    ("second-state", {"B2": 0.004, "D2": 3.0}),
    ("load-distortion", {"amplitude": 0.3, "phase": 0.7}),
    ("adhesion-offset", {"Wa": 0.3}),
]


@pytest.mark.parametrize(("effect", "values"), SLOPES, ids=[x[0] for x in SLOPES])
def test_slopes_by_an_effects_parameters_are_those_of_polished_loads(
    make_model: Any, effect: str, values: dict[str, float]
) -> None:
    model, h = with_effects(make_model, effect), 1e-4
    point = critical_line(model, model.vector({"V": 10.0, "eps": 0.13, **values}), lo=6.0, hi=20.0, tol=1e-10).points[0]
    for name, slope in zip(values, forced_slopes(model, [point], tuple(values))[0], strict=True):
        moved = []
        for factor in (1 + h, 1 - h):
            p = point.p.copy()
            p[model.index(name)] *= factor
            again = polish(model, p[:, None], point.orbit, np.array([point.rho]), along("W0", 1), tol=1e-10)[0]
            moved.append(again.value(model, "W0"))
        difference = (moved[0] - moved[1]) / (2 * h * values[name])
        assert slope == pytest.approx(difference, rel=2e-5, abs=1e-5)


def test_slopes_under_constant_load_by_an_effects_parameters(make_model: Any) -> None:
    model, values = with_effects(make_model, "second-state"), {"V": 10.0, "B2": 0.004, "D2": 3.0}
    p = model.vector(values)
    slopes = hopf_slopes(model, p, hopf_points(model, p)[0], ("B2", "D2"))
    for name, slope in zip(("B2", "D2"), slopes, strict=True):
        sides = [hopf_points(model, model.vector({**values, name: values[name] * (1 + s)}))[0].W0 for s in (1e-5, -1e-5)]
        assert slope * values[name] == pytest.approx((sides[0] - sides[1]) / 2e-5, rel=1e-6)


def run(*words: str) -> Any:
    return CliRunner().invoke(cli, list(words))


def test_the_command_line_takes_effects(empty_folder: Path) -> None:
    plain = run("critical", "--eps", "0.13", "--V", "7,25", "--json")
    felt = run("critical", "--effect", "load-transmission", "--set", "rho=0.5", "--eps", "0.26", "--V", "7,25", "--json")
    one, other = ([row["W0"] for row in json.loads(r.output)["rows"]] for r in (plain, felt))
    assert other == pytest.approx(one, rel=1e-8)
    at = ("--V", "8", "--W0", "6")
    for words in (("linear", "--over", "V=10"), ("floquet", *at, "--eps", "0.1"), ("response", *at)):
        assert run(*words, "--effect", "load-lag", "--csv").exit_code == 0


REFUSED = [
    ("sensor-lag", "changes what the gauge shows, not how the slider moves"),
    ("gauge-creep", "changes what the gauge shows, not how the slider moves"),
    ("friction-drift", "changes with time, so that no sliding is steady"),
    ("track-topography", "changes with slip, so that no sliding is steady"),
    ("drive-ripple", "changes with the stage's position, so that no sliding is steady"),
]


@pytest.mark.parametrize(("effect", "reason"), REFUSED, ids=[x[0] for x in REFUSED])
def test_effects_without_a_part_in_critical_loads_are_refused(empty_folder: Path, effect: str, reason: str) -> None:
    result = run("linear", "--effect", effect)
    assert result.exit_code == 2
    assert reason in result.output
    with pytest.raises(SrfError, match=reason):
        srf.system(effects=[effect])
