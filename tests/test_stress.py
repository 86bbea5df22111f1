"""Random parameters within their bounds: no traceback, no warning, no row that is ok without numbers."""

from __future__ import annotations

import json
import math
import random
import warnings

import pytest
from click.testing import CliRunner, Result

from srfcli.cli.main import cli
from srfcli.codegen.model import open_model
from srfcli.laws.registry import bundled_registry

pytestmark = pytest.mark.usefixtures("empty_folder")


def srf(*arguments: str) -> Result:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return CliRunner().invoke(cli, arguments, prog_name="srf")


@pytest.mark.parametrize("draws", [1, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("law", [e.name for e in bundled_registry().entries("friction")])
def test_any_parameters(law: str, draws: int) -> None:
    """A sample of benchmarks/stress.py."""
    chance = random.Random(law)
    for _ in range(draws):
        options = ["--law", law]
        for p in open_model(bundled_registry(), law=law).parameters:
            if p.name in ("V", "W0", "eps", "f"):
                continue
            low, high = max(p.lower, p.default / 10), min(p.upper, p.default * 10)
            value = chance.uniform(low, high) if p.lower < 0 else math.exp(chance.uniform(math.log(low), math.log(high)))
            options += ["--set", f"{p.name}={value!r}"]
        V, W0 = repr(10 ** chance.uniform(-1, 2)), repr(10 ** chance.uniform(0, 1.5))
        for command in (
            ["linear", "--over", f"V={V}"],
            ["floquet", "--V", V, "--W0", W0, "--eps", "0.1"],
            ["simulate", "--V", V, "--W0", W0, "--for", "0.2", "--rate", "50"],
        ):
            done = srf(*command, *options, "--json")
            assert done.exit_code in (0, 3) and "unexpected" not in done.stderr, (command, options, done.stderr)
            for row in json.loads(done.stdout)["rows"]:
                if row.get("status", "ok") == "ok":
                    needed = [n for n in ("W0", "Omega_c", "modulus", "mu", "v") if n in row]
                    assert needed and all(row[n] is not None for n in needed), (command, options, row)


@pytest.mark.parametrize(
    "options",
    [
        ["A=1e-6"], ["B=0"], ["Vsat=0"], ["mu0=0"], ["D0=1e-6"], ["lambda=1e-6"], ["K=1e-12"], ["K=1e12"], ["M=1e-12"],
        ["M=1e12"], ["A=1", "B=1"], ["V0=1e-12"], ["Vsat=1e30"], ["D0=1e30"], ["lambda=1e30"],
    ],
    ids=" ".join,
)  # fmt: skip
def test_parameters_at_their_bounds(options: list[str]) -> None:
    given = [word for option in options for word in ("--set", option)]
    for command in (["linear", "--over", "V=8"], ["simulate", "--V", "8", "--W0", "5", "--for", "0.01", "--rate", "300"]):
        done = srf(*command, *given)
        assert done.exit_code in (0, 2, 3) and "unexpected" not in done.stderr, (command, done.stderr)


def test_a_term_of_weight_zero_is_no_term() -> None:
    """The rate of stress that an ageing law holds is solved for: not by its weight, which may be 0 or next to it."""
    for command, weights in (
        (["linear", "--over", "V=8"], ("0", "1e-12")),
        (["floquet", "--V", "8", "--W0", "9", "--eps", "0.09"], ("0",)),
        (["simulate", "--V", "8", "--W0", "9", "--for", "0.05", "--rate", "50"], ("0",)),
    ):
        plain = json.loads(srf(*command, "--json").stdout)["rows"]
        for weight in weights:
            done = srf(*command, "--ageing", "nagata", "--set", f"c={weight}", "--json")
            assert done.exit_code == 0, done.stderr
            for row, expected in zip(json.loads(done.stdout)["rows"], plain, strict=True):
                numbers = {n: x for n, x in expected.items() if isinstance(x, float)}
                assert {n: row[n] for n in numbers} == pytest.approx(numbers, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("ageing", ["dieterich+linker-dieterich", "nagata"])
@pytest.mark.parametrize(
    "command",
    [
        ["floquet", "--V", "8", "--W0", "9", "--eps", "0.09"],
        ["critical", "--V", "8", "--eps", "0.09"],
        ["continue"],
        ["map", "--over", "V=1:9:2", "--over", "K/W0=0.002:0.03:2"],
        ["response", "--over", "f=1:9:2"],
        ["simulate", "--for", "0.1", "--rate", "50"],
    ],
    ids=lambda c: c[0],
)
def test_where_nothing_can_be_computed(command: list[str], ageing: str) -> None:
    done = srf(*command, "--ageing", ageing, "--set", "B=0")
    assert done.exit_code == 2 and "nothing can be computed at B = 0" in done.stderr and done.stdout == ""
    steady = srf("linear", "--over", "V=8", "--ageing", ageing, "--set", "B=0")
    assert steady.exit_code == 0  # under a constant load


def test_a_jacobian_that_overflows() -> None:
    words = "linear --over V=0.027 --law rice-regularized --set A=0.000366 --set B=0.00959 --set V0=163 --set mu0=0.0177"
    (row,) = json.loads(srf(*words.split(), "--set", "lambda=337", "--set", "D0=29.2", "--json").stdout)["rows"]
    assert row["W0"] > 0 and row["lyapunov"] is None and row["criticality"] is None
    assert row["status"] == "no Lyapunov coefficient: the Jacobian overflows"


def test_a_record_of_which_nothing_was_reached() -> None:
    words = "simulate --law rice-regularized --V 0.5 --W0 0.3 --eps 0.4 --f 1.3 --for 5 --rate 10"
    values = ["K=6.4", "M=0.2", "mu0=123.7", "A=3.9e-5", "B=2.7e-4", "D0=15.7", "V0=4.9", "lambda=0.015"]
    done = srf(*words.split(), *(w for v in values for w in ("--set", v)))
    assert done.exit_code == 3 and "nothing of the record was reached" in done.output, done.output


SYSTEMS = [
    *(("law", e.name) for e in bundled_registry().entries("friction")),
    *(("ageing", e.name) for e in bundled_registry().entries("ageing") if e.name != "dieterich"),
    *(("ageing", f"dieterich+{e.name}") for e in bundled_registry().entries("modifier")),
    *(("interface", e.name) for e in bundled_registry().entries("interface") if e.name != "elastic"),
]


@pytest.mark.parametrize("system", SYSTEMS, ids="-".join)
def test_over_the_ends_of_a_parameter(system: tuple[str, str]) -> None:
    """Point by point: numbers, or one reason in its row; what lies beside a point that has none is found all the same."""
    kind, name = system
    for p in open_model(bundled_registry(), **{kind: name}).parameters:
        if p.name in ("W0", "eps", "f"):
            continue
        ends = sorted({max(p.lower, -1e29), p.default or 1.0, min(p.upper, 1e29)} | ({0.0} if p.lower <= 0 else set()))
        over = f"{p.name}={','.join(map(repr, ends))}"
        done = srf("linear", "--over", over, f"--{kind}", name, "--json")
        assert done.exit_code == 0, (over, done.stderr)
        rows = json.loads(done.stdout)["rows"]
        assert [row[p.name] for row in rows] == ends
        for row in rows:
            found = row["status"] in ("ok", "no Lyapunov coefficient: the Jacobian overflows")
            assert found == (row["W0"] is not None) and (found or row["status"].startswith(REASONS)), row
        done = srf("response", "--over", over, f"--{kind}", name, "--json")
        rows = json.loads(done.stdout)["rows"]
        assert [row[p.name] for row in rows] == ends
        for row in rows:
            assert row["status"] == ("no-value" if None in row.values() else "ok"), row
        assert done.exit_code == (0 if all(row["status"] == "ok" for row in rows) else 3), done.stderr


REASONS = ("no Hopf", "velocity strengthening: ", "no value: ")


@pytest.mark.parametrize(
    ("words", "without"),
    [
        ("--over B=0,0.0241 --ageing nagata", [0]),
        ("--over B=0,0.0241,1 --ageing dieterich+linker-dieterich", [0]),
        ("--over A=1e-6,0.0126 --law rice-regularized", [0]),
        ("--over Vsat=0,256", []),
    ],
)
def test_response_where_a_formula_has_no_value(words: str, without: list[int]) -> None:
    for mean in ([], ["--mean", "--eps", "0.05"]):
        done = srf("response", "--V", "10", "--W0", "5", *mean, *words.split(), "--json")
        assert done.exit_code == (3 if without else 0), done.stderr
        rows = json.loads(done.stdout)["rows"]
        assert [i for i, row in enumerate(rows) if row["status"] == "no-value"] == without
        for i, row in enumerate(rows):
            # only steady friction, which needs no rates, may be known
            assert i in without or None not in row.values(), row


@pytest.mark.parametrize(
    "text",
    ["nan", "inf", "-inf", "1e400", "1" * 400, "abc", "", "0:1:3:log", "1:2:0", "1:nan", "1,,2", "1,nan", "1:2:3:lin:x"],
    ids=lambda text: text[:12],
)
def test_what_is_no_range_is_told(text: str) -> None:
    for p in open_model(bundled_registry()).parameters:
        done = srf("response", "--over", f"{p.name}={text}")
        assert done.exit_code == 2 and done.stdout == "" and done.stderr.count("Error: ") == 1, (p.name, done.stderr)


def test_a_map_with_an_edge_that_has_no_value() -> None:
    plane = ["--over", "B=0:0.02:3:lin", "--over", "K/W0=0.01:0.03:3", "--V", "10", "--eps", "0.1"]
    done = srf("map", *plane, "--ageing", "nagata")
    assert done.exit_code == 3 and "no-value at 3 points: A formula is undefined" in done.output


def test_what_steady_sliding_does_not_have_is_not_swept() -> None:
    for name in ("W0", "eps", "f"):
        done = srf("linear", "--over", f"{name}=0.1,0.2")
        assert done.exit_code == 2 and f"{name} is swept and" in done.stderr
