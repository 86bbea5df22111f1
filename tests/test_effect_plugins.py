"""Effects of one's own: as a file, as a Python function, the faults of either, and what `srf law check` has to say."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from srfcli.cli.law import law as law_group
from srfcli.cli.law import laws as laws_command
from srfcli.codegen.model import open_model
from srfcli.core.errors import ExpressionError, SrfError
from srfcli.laws.api import ExtraState, Parameter, effect
from srfcli.laws.expression import parse_expression
from srfcli.laws.law_file import template
from srfcli.laws.registry import bundled_registry, load_registry, read_law
from srfcli.laws.values import Effect
from srfcli.tasks.law_check import check_law

SHIPPED = bundled_registry()
NAMES = [e.name for e in SHIPPED.entries("effect")]
OWN = Path(__file__).resolve().parent / "effects"  # written as a user writes them
AGE_EXPONENT = (OWN / "age-exponent.toml").read_text(encoding="utf-8")
DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "effects.md"


def written(folder: Path, text: str, name: str = "mine.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def formula(text: str):
    return parse_expression(text, ["rate", "v", "phi", "D0", "n"])


def test_an_effect_of_one_s_own_works_from_a_folder(tmp_path):
    """As a user has it: a file in a folder that SRF_PLUGINS names."""
    written(tmp_path, AGE_EXPONENT, "age-exponent.toml")
    script = """
import numpy as np
from srfcli.codegen.model import open_model
from srfcli.laws.registry import load_registry
registry = load_registry()
model, plain = open_model(registry, effects=("age-exponent",)), open_model(registry)
x = np.asarray(plain.steady(plain.vector())) + 0.1
for n in (1.0, 1.5):
    change = np.asarray(model.rates(x, 9.0, 6.0, 0.0, model.vector({"n": n}))) - plain.rates(x, 9.0, 6.0, 0.0, plain.vector())
    print(n, float(np.abs(change).max()) > 1e-3)
"""
    environment = {**os.environ, "SRF_PLUGINS": str(tmp_path), "SRF_CACHE": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=1200)
    assert (done.stderr, done.stdout.split()) == ("", ["1.0", "False", "1.5", "True"])
    told = CliRunner().invoke(laws_command, ["--kind", "effect"], env={"SRF_PLUGINS": str(tmp_path)})
    assert "age-exponent" in told.output and "SRF_PLUGINS" in told.output and "viscous-drag" in told.output
    shown = CliRunner().invoke(law_group, ["show", "age-exponent"], env={"SRF_PLUGINS": str(tmp_path)})
    assert "the baseline has n = 1" in shown.output and "(phi*v/D0)**n" in shown.output
    checked = CliRunner().invoke(law_group, ["check", "age-exponent", "--plugins", str(tmp_path)])
    assert (checked.exit_code, checked.output.count("ok  ")) == (0, 8)


@pytest.mark.parametrize("python", [False, True], ids=["toml", "python"])
def test_a_new_effect_passes_as_it_is(tmp_path, python):
    text = template("effect", "my-own", python=python)
    path = written(tmp_path, text, "my-own" + (".py" if python else ".toml"))
    registry = load_registry([tmp_path])
    (entry,) = [e for e in registry.entries("effect") if e.name == "my-own"]
    assert entry.location == path and entry.about == "One line for `srf laws`"
    assert {o.verdict for o in check_law(registry.load(entry))} == {"ok"}
    toml = read_law(written(tmp_path, AGE_EXPONENT))
    assert isinstance(toml, Effect)
    assert registry.get("effect", "my-own").changes == toml.changes
    by_file = open_model(registry, effects=(str(path),))
    assert by_file.names[-1] == "n"


def test_a_python_effect_may_bring_an_unknown():
    @effect(name="late-gauge", parameters=[Parameter("tau_g", 0.01, "s", 1e-4, 1.0)], neutral={"tau_g": 0.0},
            states=["reading"], observed="reading")  # fmt: skip
    def late(gauge, reading, p):
        """The gauge lags"""
        return {"reading": ExtraState("reading", (gauge - reading) / p.tau_g, gauge)}

    assert late.about == "The gauge lags" and late.sizes == ("tau_g",)
    assert {o.check: o.verdict for o in check_law(late)}["derivatives"] == "ok"
    shipped = SHIPPED.get("effect", "sensor-lag")
    assert str(late.states[0].rate).replace("reading", "lag").replace("tau_g", "time_constant") == str(shipped.states[0].rate)


@pytest.mark.parametrize(
    ("returned", "states", "message"),
    [
        (lambda mu: mu, (), "returned Symbol, expected a mapping"),
        (lambda mu: {"nu": mu}, (), "'nu' is no slot"),
        (lambda velocity: {"mu": velocity}, (), "unknown argument 'velocity'"),
        (lambda mu, p: {"mu": mu + p.c2}, (), "unknown parameter 'c2'"),
        (lambda mu: {"mu": mu}, ("late",), "nothing is returned for the state 'late'"),
        (lambda mu: {"mu": ExtraState("mu", mu, mu)}, (), "found ExtraState under 'mu'"),
        (lambda mu: {}, (), "changes nothing"),
    ],
)
def test_faults_of_python_effects_are_told(returned, states, message):
    with pytest.raises(SrfError, match=message):
        effect(name="bad", parameters=[Parameter("c", 0.1)], neutral={"c": 0.0}, states=states)(returned)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"rate + v*phi/D0 - (v*phi/D0)**n"', '"rate + v*phi/D0 - (v*phi/D1)**n"', "rate: unknown name 'D1'"),
        ('rate = "rate', 'friction = "rate', "friction: unknown key"),
        ("neutral = 1.0, ", "", "no parameter has a neutral value"),
        ("neutral = 1.0", "neutral = nan", "the neutral value of 'n' is nan"),
        ("neutral = 1.0", 'neutral = "1"', "parameters.n.neutral"),
        ("neutral = 1.0", "neutral = 1.0, scan = 2", "given together with neutral"),
        ("[parameters]", "[parameters]\nq = { default = 1.0, scan = 2.5 }", "parameters.q.scan: found 2.5"),
        ("n = {", "slip = {", "'slip' already has a meaning"),
        ("n = {", "modulated = {", "'modulated' already has a meaning"),
        ("default = 1.2", "default = 5.0", "outside its bounds"),
        ("[parameters]", 'settings = { loading = "inclined" }\n[parameters]', "settings.loading: unknown key"),
        ("[parameters]", "settings = { inertia = 1 }\n[parameters]", "settings.inertia: found 1"),
        ("[parameters]", 'states = [{ name = "q", rate = "1" }]\n[parameters]', "states.0..steady: missing"),
        ("[parameters]", 'states = [{ name = "phi", rate = "1", steady = "1" }]\n[parameters]', "'phi' already has a meaning"),
        ("[parameters]", 'observed = "q"\n[parameters]', "observed = 'q' is no state"),
        ("[parameters]", 'needs = "Vsat"\n[parameters]', 'needs: found "Vsat", expected a list'),
        ("[parameters]", "constitutive = 1\n[parameters]", "constitutive: found 1, expected true or false"),
        ("[parameters]", "[constants]\nk = 7\n[parameters]", "constants.k: found 7, expected a table"),
        ("[parameters]", '[constants]\nn = { value = 7, unit = "N" }\n[parameters]', "'n' already has a meaning"),
        ("[parameters]", '[constants]\nk = { value = 7, unit = "X" }\n[parameters]', "unknown unit 'X'"),
        ("[parameters]", '[constants]\nk = { value = "x" }\n[parameters]', 'constants.k.value: found "x", expected a number'),
        ("[parameters]", '[constants]\nk = { unit = "N" }\n[parameters]', "constants.k.value: missing"),
        ('kind = "effect"', 'kind = "effect"\nname = "Age"', 'name: found "Age"'),
        ("[parameters]", '[[checks]]\nquantity = "mu"\nat = { v = 1.0 }\nvalue = 1.0\n[parameters]', "expected 'rate'"),
        (
            "[parameters]",
            "[constants]\nk = { value = 7 }\n[[checks]]\nat = { k = 1.0 }\nvalue = 1.0\n[parameters]",
            "at.k: unknown key",
        ),
        ("[parameters]", "[[checks]]\nat = { vv = 1.0 }\nvalue = 1.0\n[parameters]", "checks.0..at.vv: unknown key"),
    ],
)
def test_breaches_of_the_text_form_are_told(tmp_path, old, new, message):
    text = AGE_EXPONENT.replace(old, new)
    assert text != AGE_EXPONENT
    path = written(tmp_path, text)
    with pytest.raises((SrfError, ExpressionError), match=message) as caught:
        read_law(path)
    assert str(path) in caught.value.message


def reasons(changed: Effect) -> dict[str, str]:
    return {o.check: o.text for o in check_law(changed) if o.verdict == "FAIL"}


@pytest.mark.parametrize("name", NAMES)
def test_shipped_effects_meet_worked_values_of_every_formula(name):
    effect = SHIPPED.get("effect", name)
    formulas = {*dict(effect.changes), *(s.name for s in effect.states)}
    assert {c.quantity for c in effect.checks} == formulas
    (found,) = (o for o in check_law(effect) if o.check == "worked values")
    assert found.verdict == ("ok" if formulas else "skipped")
    wrong = replace(effect, checks=tuple(replace(c, value=1.01 * c.value) for c in effect.checks))
    assert not formulas or "expected" in reasons(wrong)["worked values"]


def test_a_worked_value_of_no_formula_is_told():
    effect = SHIPPED.get("effect", "stiffness-exponent")
    strange = replace(effect, checks=(replace(effect.checks[0], quantity="kapa"),))
    assert "no formula for 'kapa'" in reasons(strange)["worked values"]
    idle = replace(SHIPPED.get("effect", "inertia"), checks=effect.checks)
    assert "no formula for 'kappa'" in reasons(idle)["worked values"]


def test_checks_that_fail_say_why(tmp_path):
    good = read_law(written(tmp_path, AGE_EXPONENT))
    assert isinstance(good, Effect) and reasons(good) == {}

    def with_rate(text: str, **more) -> Effect:
        return replace(good, changes=(("rate", formula(text)),), written=(), **more)

    assert "differ from the baseline's" in reasons(with_rate("rate + v*phi/D0 - 2*(v*phi/D0)**n"))["neutral"]
    assert "differ from the baseline's" in reasons(replace(good, neutral=(("n", 2.0),)))["neutral"]
    assert "rate is in" not in reasons(good)
    assert "are added" in reasons(with_rate("rate + n*v"))["units"]
    assert "rate is in s, expected 1" in reasons(with_rate("n*phi"))["units"]
    idle = replace(good, parameters=(*good.parameters, Parameter("idle", 1.0)))
    assert reasons(idle)["parameters"].startswith("declared and not used: idle")
    still = replace(good, parameters=(replace(good.parameters[0], default=1.0),))
    assert "changes nothing" in reasons(still)["acts"]
    assert "no shipped model has nonsense" in reasons(replace(good, needs=("nonsense",)))["baseline"]
    assert "frees 'Q'" in reasons(replace(good, frees=("Q",)))["baseline"]
    lag = SHIPPED.get("effect", "sensor-lag")
    assert isinstance(lag, Effect)
    moving = replace(lag, states=(replace(lag.states[0], steady=2 * lag.states[0].steady),))
    assert "lag moves" in reasons(moving)["steady start"]


def test_constants_stand_in_formulas_in_um_s_N(tmp_path):
    text = AGE_EXPONENT.replace('rate = "rate + v*phi/D0 - (v*phi/D0)**n"', 'mu = "mu*(W/Wref)**(n - 1)"')
    found = read_law(written(tmp_path, text + '[constants]\nWref = { value = 7000.0, unit = "mN" }\n'))
    assert isinstance(found, Effect)
    assert str(found.changes[0][1]) == "mu*(W/7)**(n - 1)" and "Wref" in str(found.written[0][1])
    assert reasons(found) == {}
    unlike = read_law(written(tmp_path, text + '[constants]\nWref = { value = 7.0, unit = "um" }\n'))
    assert isinstance(unlike, Effect) and "not 1" in reasons(unlike)["units"]


def test_show_gives_every_part_as_json():
    told = CliRunner().invoke(law_group, ["show", "second-state", "--json"])
    (document,) = json.loads(told.output)["laws"]
    assert document["kind"] == "effect" and document["neutral"] == {"B2": 0.0} and document["reported"] == "second-state"
    assert document["states"] == [{"name": "phi2", "rate": "1 - phi2*v/D2", "steady": "D2/v", "logarithmic": True}]
    for name in NAMES:
        shown = CliRunner().invoke(law_group, ["show", name, "--kind", "effect"])
        assert shown.exit_code == 0 and f"{name}  (effect)" in shown.output


def test_the_example_of_the_docs_runs(tmp_path, monkeypatch, capsys):
    text = DOCUMENT.read_text(encoding="utf-8")
    blocks = [part.partition("```")[0] for part in text.split("```python\n")[1:]]
    (first,) = (block for block in blocks if "srf.simulate(" in block)
    (second,) = (block for block in blocks if "@effect(" in block)
    toml = text.partition("```toml\n")[2].partition("```")[0]
    written(tmp_path, toml, "age-exponent.toml")
    told = first.rpartition("um: ")[2].strip().split(", then ")
    monkeypatch.chdir(tmp_path)
    exec(first, {})
    assert capsys.readouterr().out.split() == ["1.0", told[0], "1.6", told[1]]
    (tmp_path / "age-exponent.toml").rename(tmp_path / "unused")
    mine = load_registry([written(tmp_path, second, "mine.py")]).get("effect", "age-exponent")
    ours = read_law(written(tmp_path, toml, "again.toml"))
    assert isinstance(mine, Effect) and isinstance(ours, Effect)
    assert (mine.changes, mine.parameters, mine.neutral) == (ours.changes, ours.parameters, ours.neutral)
