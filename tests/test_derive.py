"""Derivation: the paper's coefficients, closed limits, inclined loading, and `srf derive`."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.laws.expression import symbol
from srfcli.laws.registry import bundled_registry
from srfcli.numerics.hopf import hopf_points, weakening
from srfcli.symbolic.derivation import dispersion_coefficients
from srfcli.symbolic.derive import (
    characteristic_polynomial,
    closed_limits,
    common_ageing,
    hurwitz_determinant,
    paper_coefficients,
)
from srfcli.symbolic.system import build_system

REGISTRY = bundled_registry()
K, M, W0, D0, V, kappa, mu_v, mu_phi, mu_ss = map(symbol, ["K", "M", "W0", "D0", "V", "kappa", "mu_v", "mu_phi", "mu_ss"])
DMU = mu_phi - mu_v


def same(first: sp.Expr, second: sp.Expr) -> bool:
    return sp.simplify(first - second) == 0


@pytest.mark.parametrize("law", ["srf-vsat", "log-log", "bowden-tabor", "rice-regularized", "dieterich-cutoff"])
@pytest.mark.parametrize("ageing", ["dieterich", "ruina", "perrin-rice-zheng", "dieterich+linker-dieterich"])
def test_coefficients_are_the_papers(law: str, ageing: str) -> None:
    system = build_system(REGISTRY, law=law, ageing=ageing)
    eta = 1 + K / kappa
    printed = (
        K * V / D0,
        sp.I * W0 / D0 * (K * D0 / W0 - eta * DMU),
        -(M * V / D0 + eta * mu_v * W0 / V),
        -sp.I * M * W0 / (kappa * D0) * (kappa * D0 / W0 - DMU),
        M * mu_v * W0 / (kappa * V),
    )
    found = paper_coefficients(characteristic_polynomial(system))
    shown = dispersion_coefficients(system)
    assert len(found) == 5
    for c, d, expected in zip(found, shown, printed, strict=True):
        assert same(c, expected)
        assert same(d.subs(symbol("eta"), eta), expected)


def test_more_states_give_more_coefficients() -> None:
    assert len(characteristic_polynomial(build_system(REGISTRY, law="two-state"))) == 6
    assert len(characteristic_polynomial(build_system(REGISTRY, interface="rigid", inertia=False))) == 3


def test_hurwitz_determinant_of_an_imaginary_pair() -> None:
    s, w, r = sp.symbols("s w r")
    a = tuple(sp.Poly((s**2 + w**2) * (s + 1) * (s + r), s).all_coeffs()[::-1])
    assert sp.expand(hurwitz_determinant(a)) == 0


@pytest.mark.parametrize(
    ("ageing", "expected"),
    [("dieterich", True), ("ruina", True), ("perrin-rice-zheng", True), ("kato-tullis", False), ("nagata", False)],
)
def test_ageing_laws_of_the_papers_linear_form(ageing: str, expected: bool) -> None:
    assert common_ageing(build_system(REGISTRY, ageing=ageing)) is expected


def test_every_registered_ageing_law_is_told_apart() -> None:
    tested = {"dieterich", "ruina", "perrin-rice-zheng", "kato-tullis", "nagata"}
    assert {e.name for e in REGISTRY.entries("ageing")} == tested


def test_closed_critical_load_of_the_papers_model() -> None:
    found = closed_limits(build_system(REGISTRY))
    assert found is not None
    Omega, length = symbol("Omega_c"), symbol("lambda")
    assert same(found.load, (K - M * Omega**2) * (D0 - length * DMU) / DMU)
    assert same(found.omega_squared, V**2 * DMU / (D0**2 * mu_v))


def test_closed_critical_load_of_a_constant_stiffness() -> None:
    """K - M Omega_c^2 in series with kappa0 takes the place of K."""
    found = closed_limits(build_system(REGISTRY, interface="constant"))
    assert found is not None
    dynamic, kappa0 = K - M * symbol("Omega_c") ** 2, symbol("kappa0")
    assert same(found.load, dynamic * kappa0 / (dynamic + kappa0) * D0 / DMU)


def test_closed_load_solves_the_dispersion_relation() -> None:
    system = build_system(REGISTRY)
    found = closed_limits(system)
    assert found is not None
    Omega = symbol("Omega_c")
    a = [c.subs(kappa, W0 / symbol("lambda")) for c in characteristic_polynomial(system)]
    value = sum(c * (sp.I * Omega) ** k for k, c in enumerate(a)).subs(W0, found.load)
    square = {Omega: sp.sqrt(V**2 * DMU / (D0**2 * mu_v))}
    assert sp.simplify(value.subs(square)) == 0


def test_limits_are_the_papers() -> None:
    limits = closed_limits(build_system(REGISTRY))
    assert limits is not None
    assert limits.omega_squared is not None
    assert limits.limit_load is not None
    load = limits.limit_load.subs(symbol("Omega_c") ** 2, limits.omega_squared)
    equation = K * D0 / W0 - DMU * (1 + M * V**2 / (W0 * D0 * mu_v))  # the paper's, which has W0 on both sides
    assert same(equation.subs(W0, load), sp.S.Zero)
    assert limits.quasistatic_load is not None
    assert same(limits.quasistatic_load, K * D0 / DMU)


def test_no_closed_form_for_two_states() -> None:
    assert closed_limits(build_system(REGISTRY, law="two-state")) is None


@pytest.mark.parametrize(
    ("interface", "ageing"),
    [
        *(("elastic", ageing) for ageing in ("dieterich", "kato-tullis", "nagata")),
        ("constant", "dieterich"),
        ("rigid", "kato-tullis"),
    ],
)
@pytest.mark.parametrize("V", [1.0, 30.0])
def test_closed_load_is_the_hopf_point(make_model: Callable[..., Any], interface: str, ageing: str, V: float) -> None:
    model = make_model(interface=interface, ageing=ageing)
    p = model.vector({"V": V})
    (found,) = hopf_points(model, p)
    assert model.closed_load(p) == pytest.approx(found.W0, rel=1e-10)
    assert model.closed_frequency(p) == pytest.approx(found.Omega, rel=1e-10)


def test_limit_of_a_stiff_interface(make_model: Callable[..., Any]) -> None:
    model = make_model()
    for V in (1.0, 10.0, 100.0):
        p = model.vector({"V": V, "lambda": 1e-11})
        (found,) = hopf_points(model, p)
        value = {n: p[model.index(n)] for n in ("K", "M", "D0", "A")}  # of this law mu_v = A
        dmu = weakening(model, p)
        right = dmu * (1 + value["M"] * V**2 / (found.W0 * value["D0"] * value["A"]))
        assert value["K"] * value["D0"] / found.W0 == pytest.approx(right, rel=1e-10)
        assert value["D0"] * found.Omega / V == pytest.approx(math.sqrt(dmu / value["A"]), rel=1e-10)
        assert model.limit_load(p) == pytest.approx(found.W0, rel=1e-10)
        light = model.vector({"V": V, "lambda": 1e-11, "M": 1e-18})
        (point,) = hopf_points(model, light)
        assert model.quasistatic_load(light) == pytest.approx(point.W0, rel=1e-10)


def test_reference_points(make_model: Callable[..., Any], shared: Path) -> None:
    model = make_model()
    with (shared / "reference" / "hopf_points.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) > 20
    for row in rows:
        p = model.vector({"V": float(row["V_um_s"])})
        load = float(model.closed_load(p))
        assert load == pytest.approx(float(row["W0c_N"]), abs=0.5e-10 * 1.1)
        assert 0.21 / load == pytest.approx(float(row["K_over_W0c_per_um"]), abs=0.5e-10 * 1.1)
        assert float(model.closed_frequency(p)) == pytest.approx(float(row["Omega_rad_s"]), rel=1e-8)


def test_papers_limit_is_off_by_its_neglected_length(make_model: Callable[..., Any]) -> None:
    model = make_model()
    p = model.vector({"V": 1.0})
    assert model.limit_load(p) / model.closed_load(p) - 1 == pytest.approx(0.016146, abs=1e-6)


def test_no_critical_load_where_friction_strengthens(make_model: Callable[..., Any]) -> None:
    model = make_model()
    p = model.vector({"V": np.array([100.0, 400.0]), "B": np.array([0.0241, 0.0241])})
    assert np.isfinite(model.closed_load(p)).tolist() == [True, False]
    assert np.isfinite(model.closed_frequency(p)).tolist() == [True, False]
    neutral = make_model(law="dieterich-ruina")
    assert math.isnan(neutral.closed_load(neutral.vector({"A": 0.02, "B": 0.02})))


# Under an inclined spring W follows u, so that a term in dW/dt in the ageing law enters the linear problem.


def test_linker_dieterich_is_silent_under_constant_load() -> None:
    plain = characteristic_polynomial(build_system(REGISTRY))
    with_term = characteristic_polynomial(build_system(REGISTRY, ageing="dieterich+linker-dieterich"))
    assert all(same(a, b) for a, b in zip(plain, with_term, strict=True))


def test_linker_dieterich_speaks_under_an_inclined_spring(make_model: Callable[..., Any]) -> None:
    names = {"loading": "inclined", "ageing": "dieterich+linker-dieterich"}
    plain, with_term = (
        characteristic_polynomial(build_system(REGISTRY, loading="inclined", ageing=a)) for a in ("dieterich", names["ageing"])
    )
    differing = [k for k, (a, b) in enumerate(zip(plain, with_term, strict=True)) if not same(a, b)]
    assert differing
    alpha = symbol("alpha")
    assert all(same(a, b.subs(alpha, 0)) for a, b in zip(plain, with_term, strict=True))
    loads = {}
    for loading in ("vertical", "inclined"):
        for a in ("dieterich", "dieterich+linker-dieterich"):
            model = make_model(loading=loading, ageing=a)
            loads[loading, a] = hopf_points(model, model.vector({"V": 10.0}))[0].W0
    assert loads["vertical", "dieterich"] == pytest.approx(loads["vertical", "dieterich+linker-dieterich"], rel=1e-12)
    assert abs(loads["inclined", "dieterich"] / loads["inclined", "dieterich+linker-dieterich"] - 1) > 0.01


def test_critical_stiffness_of_dupont_and_bapna(make_model: Callable[..., Any]) -> None:
    """Quasi-static rigid slider, spring at an angle, W = W1 + K tan(angle) u: K_c = W0 (B - A)/(D0 (1 - (mu - alpha) tan)).

    Dupont and Bapna (1994) with the stiffness k of the spring along its axis, K = k cos^2: k_c cos (cos - (mu - alpha) sin).
    """
    names = {"law": "dieterich-ruina", "interface": "rigid", "loading": "inclined", "inertia": False}
    limits = closed_limits(build_system(REGISTRY, ageing="dieterich+linker-dieterich", **names))
    assert limits is not None
    assert limits.quasistatic_load is not None
    A, B, alpha, tangent = symbol("A"), symbol("B"), symbol("alpha"), sp.tan(symbol("angle"))
    load = limits.quasistatic_load.subs({mu_phi: B, mu_v: A})
    assert same(load, K * D0 * (1 - (mu_ss - alpha) * tangent) / (B - A))
    model = make_model(ageing="dieterich+linker-dieterich", **names)
    p = model.vector({"V": 10.0, "angle": math.radians(20.0), "alpha": 0.2})
    critical = float(model.quasistatic_load(p))
    growth = []
    for factor in (1 - 1e-7, 1 + 1e-7):
        q = p.copy()
        q[model.index("W0")] = factor * critical
        jacobian = model.rates_jacobian(model.steady(q), 10.0, factor * critical, 0.0, q)
        growth.append(np.linalg.eigvals(jacobian).real.max())
    assert growth[0] < 0 < growth[1]


# `srf derive`


def run(*arguments: str) -> Any:
    return CliRunner().invoke(cli, ["derive", *arguments], catch_exceptions=False)


def test_text_is_plain_in_a_pipe() -> None:
    result = run()
    assert result.exit_code == 0
    assert result.output.isascii()
    assert "  C1 = i*W0*(D0*K/W0 - eta*(mu_phi - mu_v))/D0\n" in result.output
    assert "W0c = (D0 - lambda*(mu_phi - mu_v))*(K - M*Omega_c**2)/(mu_phi - mu_v)" in result.output
    assert "Jacobian" not in result.output
    assert "Jacobian" in run("--with", "jacobian").output


def test_json_holds_every_section() -> None:
    document = json.loads(run("--format", "json", "--ageing", "ruina", "--loading", "inclined").output)
    assert document["schema"] == "srf.derive/1"
    keys = [s["key"] for s in document["sections"]]
    assert keys == ["laws", "steady", "slopes", "equations", "jacobian", "parameters", "dispersion", "limits"]
    assert all(f["text"] and f["latex"] for s in document["sections"] for f in s["formulas"])


@pytest.mark.parametrize("law", ["srf-vsat", "two-state", "rice-regularized"])
def test_latex_is_balanced(law: str) -> None:
    output = run("--format", "latex", "--law", law, "--with", "all").output
    assert output.count(r"\begin{align*}") == output.count(r"\end{align*}") > 3
    assert output.count(r"\left") - output.count(r"\leftarrow") == output.count(r"\right")
    depth = 0
    for a in output.replace(r"\{", "").replace(r"\}", ""):
        depth += (a == "{") - (a == "}")
        assert depth >= 0
    assert depth == 0
    assert r"\mu_\phi" in output
    assert law != "srf-vsat" or "V_{sat}" in output


@pytest.mark.parametrize(
    "names",
    [{}, {"ageing": "kato-tullis"}, {"law": "two-state", "interface": "power", "loading": "inclined"}],
    ids=["paper", "kato-tullis", "two-state"],
)
def test_python_stands_alone(names: dict[str, str], make_model: Callable[..., Any]) -> None:
    arguments = [part for k, v in names.items() for part in (f"--{k}", v)]
    namespace: dict[str, Any] = {}
    exec(run("--format", "python", *arguments).output, namespace)
    model = make_model(**names)
    p = model.vector({"V": 12.0, "W0": 6.0})
    wanted = namespace["dispersion"].__code__.co_varnames[: namespace["dispersion"].__code__.co_argcount]
    values = {n: p[model.index(n.rstrip("_"))] for n in wanted}
    found = namespace["dispersion"](**values)
    expected = model.characteristic(p) * 1j ** np.arange(len(found))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_unknown_law_is_one_line() -> None:
    result = CliRunner().invoke(cli, ["derive", "--law", "srf-vsta"])
    assert result.exit_code != 0


@pytest.mark.parametrize("command", ["derive", "code"])
def test_a_value_is_no_part_of_formulas(command: str) -> None:
    result = CliRunner().invoke(cli, [command, "--K", "3"])
    assert result.exit_code == 2 and "K is given a value" in result.stderr


def test_out_does_not_overwrite(tmp_path: Path) -> None:
    place = tmp_path / "derivation.tex"
    assert run("--format", "latex", "--out", str(place)).exit_code == 0
    first = place.read_text(encoding="utf-8")
    assert first.startswith(r"\documentclass")
    assert CliRunner().invoke(cli, ["derive", "--out", str(place)]).exit_code != 0
    assert place.read_text(encoding="utf-8") == first
