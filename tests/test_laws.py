"""Every shipped law, the checks themselves, and one law in three forms."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from click.testing import CliRunner

from srfcli.cli.law import law as law_group
from srfcli.cli.law import laws as laws_command
from srfcli.core.errors import ExpressionError, SrfError
from srfcli.core.units import dimension, dimension_of
from srfcli.laws.api import Check, FrictionLaw, Parameter, State, ageing_law, exp, friction_law, interface, log
from srfcli.laws.expression import log1p, parse_expression, symbol
from srfcli.laws.law_file import LAW_KINDS, RESERVED, formula_of
from srfcli.laws.registry import Entry, bundled_registry, read_law
from srfcli.laws.values import Interface
from srfcli.tasks import law_check as checking
from srfcli.tasks.law_check import check_law, evaluate, reference_values, steady_age

SHIPPED = bundled_registry()
FRICTION = {"srf-vsat", "dieterich-ruina", "dieterich-cutoff", "rice-regularized", "log-log", "bowden-tabor", "two-state"}
MINIMAL = """format = "srf-law/1"
kind = "friction"
mu = "mu0 + A*log(v/V0) + B*log(1 + phi*V0/D0)"
[parameters]
mu0 = { default = 0.3 }
A = { default = 0.01 }
B = { default = 0.02 }
D0 = { default = 0.4, unit = "um" }
V0 = { default = 1.0, unit = "um/s" }
"""


def mu_at(law: Any, **at: float) -> float:
    return float(evaluate(formula_of(law), {**reference_values(law.parameters), **at}))


def verdicts(law: Any) -> dict[str, str]:
    return {outcome.check: outcome.verdict for outcome in check_law(law)}


def reason(law: Any, check: str) -> str:
    return next(o.text for o in check_law(law) if o.check == check)


def write(tmp_path: Path, text: str, name: str = "mine.toml") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_the_shipped_laws_are_there() -> None:
    assert {e.name for e in SHIPPED.entries("friction")} == FRICTION
    assert {e.name for e in SHIPPED.entries("ageing")} == {"dieterich", "ruina", "perrin-rice-zheng", "kato-tullis", "nagata"}
    assert {e.name for e in SHIPPED.entries("modifier")} == {"linker-dieterich"}
    assert {e.name for e in SHIPPED.entries("interface")} == {"elastic", "constant", "power", "rigid"}
    assert not SHIPPED.problems


@pytest.mark.parametrize("entry", [e for k in LAW_KINDS for e in SHIPPED.entries(k)], ids=lambda e: e.name)
def test_every_shipped_law_passes_its_checks(entry: Entry) -> None:
    law = SHIPPED.load(entry)
    outcomes = check_law(law)
    assert [o for o in outcomes if o.verdict == "FAIL"] == []
    skipped = {o.check for o in outcomes if o.verdict == "skipped"}
    if entry.name != "rigid":
        assert skipped <= {"mu_v > 0"}
        assert law.checks
        assert all(p.about for p in law.parameters)
    assert law.about and law.name == entry.name and law.about == entry.about


def test_defaults_are_the_paper_s() -> None:
    values = {p.name: p.default for p in SHIPPED.get("friction", "srf-vsat").parameters}
    assert values == {"mu0": 0.33, "A": 0.0126, "B": 0.0241, "D0": 0.402, "Vsat": 256.0, "V0": 1.0}
    assert [p.default for p in SHIPPED.get("interface", "elastic").parameters] == [0.56]


@pytest.mark.parametrize("phi", [1e-3, 0.05, 3.0])
@pytest.mark.parametrize("v", [1.0, 10.0, 100.0])
def test_relations_between_shipped_laws(v: float, phi: float) -> None:
    mu = {name: mu_at(SHIPPED.get("friction", name), v=v, phi=phi, phi2=4.02) for name in FRICTION}
    assert mu["log-log"] == pytest.approx(mu["bowden-tabor"], rel=1e-14)
    assert mu["rice-regularized"] == pytest.approx(mu["dieterich-ruina"], abs=1e-12)  # equal while exp(mu/A) is large
    assert mu["dieterich-cutoff"] == pytest.approx(mu["srf-vsat"], abs=3e-4)
    assert mu["two-state"] == pytest.approx(mu["dieterich-ruina"] + 0.004 * math.log(1.0), abs=1e-12)
    if phi > 0.04:
        assert mu["dieterich-ruina"] == pytest.approx(mu["srf-vsat"], abs=1e-3)


def test_power_with_exponent_one_is_elastic() -> None:
    power, elastic = SHIPPED.get("interface", "power"), SHIPPED.get("interface", "elastic")
    for W in (0.5, 7.0, 23.0):
        assert mu_at(power, W=W) == pytest.approx(mu_at(elastic, W=W), rel=1e-13)
    assert mu_at(SHIPPED.get("interface", "constant")) == pytest.approx(mu_at(elastic, W=10.0), rel=1e-13)
    assert SHIPPED.get("interface", "rigid").kappa is None


@pytest.mark.parametrize(("name", "y"), [("dieterich", 1.0), ("ruina", 1.0), ("perrin-rice-zheng", 2.0), ("nagata", 1.0)])
def test_steady_age(name: str, y: float) -> None:
    law = SHIPPED.get("ageing", name)
    values = {"D0": 0.402, "B": 0.0241, **reference_values(law.parameters)}
    for v in (1e-3, 1.0, 300.0):
        assert steady_age(law.rate, v, 0.402, values) == pytest.approx(y * 0.402 / v, rel=1e-10)


def test_apparatus_names_are_those_of_the_system() -> None:
    system = pytest.importorskip("srfcli.symbolic.system")
    assert set(RESERVED) == {p.name for p in (*system.APPARATUS, system.MASS, system.ANGLE)}


# --- one law in three forms


def test_toml_python_and_rewritten_algebra_agree(tmp_path: Path) -> None:
    from_toml = read_law(write(tmp_path, MINIMAL))
    listed = [Parameter("mu0", 0.3), Parameter("A", 0.01), Parameter("B", 0.02)]
    listed += [Parameter("D0", 0.4, "um"), Parameter("V0", 1.0, "um/s")]

    @friction_law(name="mine", parameters=listed)
    def from_python(v: Any, phi: Any, p: Any) -> Any:
        return p.mu0 + p.A * log(v / p.V0) + p.B * log(1 + phi * p.V0 / p.D0)

    @friction_law(name="mine", parameters={p.name: p for p in listed})
    def rewritten(v: Any, phi: Any, p: Any) -> Any:
        return p.A * log(v * exp(p.mu0 / p.A) / p.V0) + p.B * log1p(phi * p.V0 / p.D0)

    assert from_toml == from_python
    assert from_toml != rewritten
    for v, phi in [(0.01, 50.0), (1.0, 0.4), (90.0, 1e-4)]:
        assert mu_at(rewritten, v=v, phi=phi) == pytest.approx(mu_at(from_toml, v=v, phi=phi), rel=1e-13)
    for law in (from_toml, from_python, rewritten):
        assert "FAIL" not in verdicts(law).values()


def test_python_floats_become_exact() -> None:
    @interface(parameters=[Parameter("kappa0", 1.0, "N/um")])
    def my_interface(p: Any) -> Any:
        return 0.6 * p.kappa0

    assert my_interface.kappa == parse_expression("0.6*kappa0", ["kappa0"])
    assert my_interface.name == "my-interface"


def test_python_faults_are_told() -> None:
    make = friction_law(name="mine", parameters=[Parameter("D0", 1.0, "um"), Parameter("B", 1.0)])
    with pytest.raises(SrfError, match="unknown parameter 'DO'") as caught:
        make(lambda v, phi, p: p.DO * v)
    assert "Did you mean 'D0'?" in (caught.value.hint or "")
    with pytest.raises(SrfError, match="unknown argument 'velocity'"):
        make(lambda velocity, phi, p: velocity)
    with pytest.raises(SrfError, match="'erf' is not part of a formula"):
        make(lambda v, phi, p: sympy.erf(v) * phi)
    with pytest.raises(SrfError, match="unknown symbol 'q'"):
        make(lambda v, phi, p: v * phi * sympy.Symbol("q"))
    with pytest.raises(SrfError, match="unknown symbol 'B'"):  # same name, other assumptions
        make(lambda v, phi, p: v * phi * sympy.Symbol("B"))
    with pytest.raises(SrfError, match="returned str"):
        make(lambda v, phi, p: "v*phi")
    with pytest.raises(SrfError, match="does not depend on 'phi'"):
        make(lambda v, p: v)
    with pytest.raises(SrfError, match="already has a meaning"):
        ageing_law(name="mine", parameters=[Parameter("D0", 1.0)])(lambda v, p: v)
    with pytest.raises(SrfError, match="length 'D2' is not a parameter"):
        friction_law(name="mine", states=[State("phi", "D2", "B")], parameters=[Parameter("B", 1.0)])(lambda v: v)


# --- checks that must be able to fail


def failing(**changes: Any) -> FrictionLaw:
    return replace(SHIPPED.get("friction", "dieterich-ruina"), **changes)


def formula(text: str) -> sympy.Expr:
    return parse_expression(text, ["mu0", "A", "B", "D0", "V0", "v", "phi"])


@pytest.mark.parametrize(
    ("mu", "check", "expected"),
    [
        ("mu0 + A*log(v) + B*log(V0*phi/D0)", "units", "log is taken of v"),
        ("mu0 + A*v + B*log(V0*phi/D0)", "units", "are added"),
        ("v*phi", "units", "mu is in um, expected 1"),
        ("mu0 + A*exp(phi)*v/V0", "units", "exp is taken of phi"),
        ("mu0 + A*(v/V0)**phi", "units", "a power is taken of phi"),
        ("mu0 - A*log(v/V0) + B*log(V0*phi/D0)", "mu_v > 0", "v mu_v = -0.0126"),
        ("mu0 + A*log(v/V0) + B*log(-phi*V0/D0)", "steady state", "mu = nan"),
    ],
)
def test_a_bad_formula_fails_its_check(mu: str, check: str, expected: str) -> None:
    law = failing(mu=formula(mu))
    assert verdicts(law)[check] == "FAIL"
    assert expected in reason(law, check)


def test_other_checks_fail_too() -> None:
    idle = failing(parameters=(*failing().parameters, Parameter("C", 1.0)))
    assert "declared and not used: C" in reason(idle, "parameters")
    wrong = failing(checks=(Check("mu", (("v", 1.0), ("phi", 0.402)), 0.4640001),))
    assert verdicts(wrong)["worked values"] == "FAIL"
    assert verdicts(failing(checks=(Check("mu", (("v", 1.0), ("phi", 0.402)), 0.464),)))["worked values"] == "ok"
    lacking = failing(checks=(Check("mu", (("v", 1.0),), 0.4),))
    assert "no value for 'phi'" in reason(lacking, "worked values")
    ageing = replace(SHIPPED.get("ageing", "dieterich"), rate=formula("1 + v*phi/D0"))
    assert "no attracting steady value" in reason(ageing, "steady state")
    assert "kappa = -" in reason(Interface("bad", kappa=-symbol("W")), "steady state")


def test_a_wrong_derivative_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    class Misled(sympy.Function):
        def fdiff(self, argindex: int = 1) -> Any:
            return 1 / (2 + self.args[0])

    monkeypatch.setitem(checking.NUMPY, Misled, np.log1p)
    right = formula("mu0 + A*log(v/V0) + B*log1p(V0*phi/D0)")
    assert verdicts(failing(mu=right))["derivatives"] == "ok"
    assert "differs from the complex step" in reason(failing(mu=right.replace(log1p, Misled)), "derivatives")


def test_units_of_formulas() -> None:
    assert dimension("kg*um/s^2") == dimension("N")
    assert dimension("1/um") == dimension("um**-1")
    assert dimension("deg") == dimension("1")
    units = {"a": dimension("um^2")}
    assert dimension_of(parse_expression("sqrt(a)", ["a"]), units) == dimension("um")


# --- breaches of the TOML form


@pytest.mark.parametrize(
    ("old", "new", "message", "hint"),
    [
        ('"srf-law/1"', '"srf-law/2"', "line 1: format: found \"srf-law/2\", expected 'srf-law/1'", ""),
        ('kind = "friction"', 'kind = "fricton"', 'line 2: kind: found "fricton"', "Did you mean 'friction'?"),
        ("mu = ", "mü = ", "not TOML", ""),
        ('mu = "', 'nu = "', "nu: unknown key", "Did you mean 'mu'?"),
        ("log(v/V0)", "log(v/Vo)", "mu: unknown name 'Vo'", "V0"),
        ("+ B*log", "+ B^log", "mu: '^' is not part", "**"),
        ("A*log(v/V0)", "A", "mu does not depend on 'v'", ""),
        ("log(1 + phi*V0/D0)", "log(V0/V0+1)", "mu does not depend on 'phi'", ""),
        ("default = 0.01", "defualt = 0.01", "parameters.A.defualt: unknown key", "Did you mean 'default'?"),
        ("default = 0.01", 'default = "0.01"', 'parameters.A.default: found "0.01", expected a number', ""),
        ("default = 0.01", "default = true", "parameters.A.default: found true", ""),
        ("default = 0.01", "default = nan", "parameter 'A': the default is nan", ""),
        ("default = 0.01", "default = 0.01, bounds = [0.1, 1]", "outside its bounds [0.1, 1]", ""),
        ("default = 0.01", "default = 0.01, bounds = [0.1]", "expected [lower, upper]", ""),
        ("default = 0.01", "default = 0.01, bounds = [0, 1], lower = 0", "given together", ""),
        ("default = 0.01", "lower = 0.01", "parameters.A.default: missing", ""),
        ('unit = "um/s"', 'unit = "parsnip"', "parameter 'V0': unknown unit 'parsnip'", "Known"),
        ("A = { default = 0.01 }", "A = 0.01", "parameters.A: found 0.01, expected a table", "A = { default"),
        ("A = { default = 0.01 }", "A = { default = 0.01 }\nnp = { default = 1 }", "'np' is reserved", ""),
        ("A = { default = 0.01 }", "A = { default = 0.01 }\nK = { default = 1 }", "'K' already has a meaning", ""),
        ("A = { default = 0.01 }", 'A = { default = 0.01 }\nabout = "x"', "stands below [parameters]", ""),
        ("[parameters]", "[parameter]", "parameter: unknown key", "Did you mean 'parameters'?"),
        ("[parameters]", "states = [{ length = 'D9' }]\n[parameters]", "length 'D9' is not a parameter", ""),
        ("[parameters]", "states = []\n[parameters]", "states: found []", ""),
        ("[parameters]", "cites = 'x'\n[parameters]", 'cites: found "x", expected a list', ""),
        ("[parameters]", "about = 3\n[parameters]", "about: found 3, expected text", ""),
        ("[parameters]", "name = 'My Law'\n[parameters]", 'name: found "My Law"', ""),
        ("[parameters]", "checks = [{ value = 1 }]\n[parameters]", "checks[0].at: missing", ""),
        ("[parameters]", "checks = [{ value = 1, at = { q = 1 } }]\n[parameters]", "checks[0].at.q: unknown key", ""),
        ("[parameters]", "checks = [{ value = 1, at = {}, quantity = 'rate' }]\n[parameters]", "expected 'mu'", ""),
    ],
)
def test_every_breach_names_file_key_and_remedy(tmp_path: Path, old: str, new: str, message: str, hint: str) -> None:
    assert old in MINIMAL
    path = write(tmp_path, MINIMAL.replace(old, new))
    with pytest.raises(SrfError) as caught:
        read_law(path)
    assert str(path) in caught.value.message
    assert message in caught.value.message
    assert hint in (caught.value.hint or "")
    if isinstance(caught.value, ExpressionError):
        assert caught.value.caret()


def test_a_formula_below_the_parameters_is_explained(tmp_path: Path) -> None:
    lines = MINIMAL.splitlines()
    path = write(tmp_path, "\n".join([*lines[:2], *lines[3:], lines[2]]))
    with pytest.raises(SrfError) as caught:
        read_law(path)
    assert "[parameters]" in caught.value.message + (caught.value.hint or "")


# --- the commands


@pytest.mark.parametrize("python", [False, True], ids=["toml", "python"])
@pytest.mark.parametrize("kind", LAW_KINDS)
def test_a_new_law_passes_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, python: bool) -> None:
    monkeypatch.chdir(tmp_path)
    run = CliRunner()
    made = run.invoke(law_group, ["new", "my-law", "--kind", kind, *(["--python"] if python else [])])
    assert made.exit_code == 0, made.output
    name = "my-law.py" if python else "my-law.toml"
    assert made.stdout.strip() == name
    checked = run.invoke(law_group, ["check", name])
    assert checked.exit_code == 0, checked.output
    assert "FAIL" not in checked.output and "worked values  1 met" in checked.output
    by_name = run.invoke(law_group, ["check", "my-law", "--plugins", "."])
    assert by_name.output == checked.output
    again = run.invoke(law_group, ["new", "my-law", "--kind", kind, *(["--python"] if python else [])])
    assert again.exit_code == 2 and "exists" in again.stderr


def test_check_says_what_fails_and_exits_2(tmp_path: Path) -> None:
    path = write(tmp_path, MINIMAL.replace("log(v/V0)", "log(v)"))
    result = CliRunner().invoke(law_group, ["check", str(path)])
    assert result.exit_code == 2
    assert "FAIL     units" in result.output and "ok       parses" in result.output
    path = write(tmp_path, MINIMAL.replace("log(v/V0)", "log(v/Vo)"))
    result = CliRunner().invoke(law_group, ["check", str(path)])
    assert result.exit_code == 2
    assert "FAIL     parses" in result.output and "log(v/Vo)" in result.output and "\n" + " " * 16 + "^" in result.output


def test_listing_and_showing() -> None:
    import json

    run = CliRunner()
    listed = json.loads(run.invoke(laws_command, ["--kind", "ageing", "--json"]).output)
    assert listed["schema"] == "srf.laws/1"
    assert len(listed["rows"]) == 5
    shown = json.loads(run.invoke(law_group, ["show", "elastic", "--json"]).output)["laws"][0]
    assert shown["kappa"] == "W/lambda"
    assert shown["parameters"]["lambda"]["upper"] is None
    text = run.invoke(law_group, ["show", "srf-vsat"]).output
    assert "A*log(v/V0)" in text and "0.0126" in text
    missing = run.invoke(law_group, ["show", "srf-vsatt"])
    assert missing.exit_code == 2 and "Did you mean 'srf-vsat'?" in missing.stderr
