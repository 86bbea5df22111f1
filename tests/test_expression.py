"""The law language: what it reads, what it refuses and where it puts the caret."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from hypothesis import example, given, settings
from hypothesis import strategies as st

from srfcli.core.errors import ExpressionError, SrfError
from srfcli.laws.expression import RESERVED, check_identifier, expm1, log1p, parse_expression, symbol
from srfcli.tasks.law_check import evaluate

KNOWN = ["v", "phi", "A", "B", "V0", "Vsat", "D0", "lambda", "is", "beta", "gamma", "N", "S", "I", "E", "mu0"]
s = symbol

READ = [
    ("mu0 + A*log(v/V0)", s("mu0") + s("A") * sympy.log(s("v") / s("V0"))),
    ("v/lambda - is", s("v") / s("lambda") - s("is")),
    ("beta*gamma + N*S*I*E", s("beta") * s("gamma") + s("N") * s("S") * s("I") * s("E")),
    ("0.6*v + 1e-3 + .5 + 2.", sympy.Rational(3, 5) * s("v") + sympy.Rational(2501, 1000)),
    ("-v**2", -(s("v") ** 2)),
    ("2**-1**2", sympy.Rational(1, 2)),
    ("v**A**B", s("v") ** (s("A") ** s("B"))),
    ("v - A - B", s("v") - s("A") - s("B")),
    ("v/A/B", s("v") / (s("A") * s("B"))),
    ("\n  v +\n\tA ", s("v") + s("A")),
    ("ln (v)", sympy.log(s("v"))),
    ("log1p(v) + expm1(A)", log1p(s("v")) + expm1(s("A"))),
    ("atan(v) + lambertw(v) + LambertW(A)", sympy.atan(s("v")) + sympy.LambertW(s("v")) + sympy.LambertW(s("A"))),
    ("sinh(v)*cosh(v)*tanh(v)*asinh(v)*sqrt(v)*exp(v)", None),
    ("007.50", sympy.Rational(15, 2)),
]


@pytest.mark.parametrize(("text", "expected"), READ, ids=[text for text, _ in READ])
def test_reads(text: str, expected: sympy.Expr | None) -> None:
    found = parse_expression(text, KNOWN)
    if expected is not None:
        assert found == expected
    assert all(symbol.is_real for symbol in found.free_symbols)


def test_log_of_one_plus_x_stays_as_written() -> None:
    found = parse_expression("log(1 + Vsat*phi/D0)", KNOWN)
    assert found == sympy.log(1 + s("Vsat") * s("phi") / s("D0"))
    assert found.func is sympy.log


REFUSED = [
    ("v^2", 1, "Use '**'"),
    ("2 A", 2, "Write products with"),
    ("2(A)", 1, "Write products with"),
    ("(A)(v)", 3, "Write products with"),
    ("2v", 1, "Write products with"),
    ("A(v)", 0, "A*(...)"),
    ("Vsta*v", 0, "Did you mean 'Vsat'?"),
    ("v + vsat", 4, "Did you mean 'Vsat'?"),
    ("lg(v)", 0, "Did you mean 'log'?"),
    ("A*log10(v)", 2, "Write log(x)/log(10)."),
    ("abs(v)", 0, "derivatives everywhere"),
    ("log", 0, "Write log(...)"),
    ("log(v, A)", 0, ""),
    ("log()", 0, ""),
    ("v +", 3, ""),
    ("*v", 0, ""),
    ("(v", 0, ""),
    ("v)", 1, ""),
    ("v, A", 0, ""),
    ("", 0, ""),
    ("   ", 0, ""),
    ("v.real", 1, ""),
    ("v[0]", 1, "round brackets"),
    ("mu = v", 3, "right-hand side"),
    ("v // A", 2, "Use '/'"),
    ("__import__('os')", 11, ""),
    ("_", 0, ""),
    ("v if A else B", 2, ""),
    ("lambda v", 7, ""),
    ("é*v", 0, ""),
    ("v\x00", 1, ""),
    ("1/0", 2, ""),
    ("v*0**-1", 2, ""),
    ("sqrt(-1)*v", 0, ""),
    ("log(0)", 0, ""),
    ("sqrt(v**2)", None, ""),
    ("1e101", 0, ""),
    ("9" * 41, 0, ""),
]


@pytest.mark.parametrize(("text", "column", "hint"), REFUSED, ids=[text for text, _, _ in REFUSED])
def test_refuses_with_a_caret(text: str, column: int | None, hint: str) -> None:
    with pytest.raises(ExpressionError) as caught:
        parse_expression(text, KNOWN)
    assert caught.value.column == column
    assert hint in (caught.value.hint or "")
    assert len((caught.value.caret() or "\n").split("\n")) == 2


BOMBS = [
    "(((9**64)**64)**64)**64",
    "9**9**9**9",
    "2**100000000",
    "(2*v)**100000000",
    "((2*v)**300)**300",
    "exp(100000000*log(9))",
    "exp(100000000*log(9) - 219722457)",
    "exp(100000000*log(2*v))",
    "exp(300*log(9)*v)*9**500",
    "exp(exp(exp(exp(9))))",
    "sinh(1e90)",
    "log1p(asinh(atan(atan(asinh(2)))**(log1p(9)**0) - cosh(1e-9)))",
    "(1e-9)**(1e-9) + v",
    "500**log1p(0.1) - (1e9 - 500)**(-1e-9)",
    "cosh(lambda**(-(expm1(0.6) + 1e9)))",
    "sinh(lambda**(3 - 1e-9))",
    "tanh(500) - 500*exp(9)**(v*cosh(sinh(-v/0)))",
    "(" * 500 + "v" + ")" * 500,
    "-" * 400 + "v",
    "v**" * 200 + "v",
    "log(" * 100 + "v" + ")" * 100,
    "v+" * 900 + "v",
    "v" * 3000,
]


@pytest.mark.parametrize("text", BOMBS, ids=[text[:30] for text in BOMBS])
def test_bombs_are_refused(text: str) -> None:
    """One that goes off keeps the tests from ever ending."""
    with pytest.raises(ExpressionError):
        parse_expression(text, KNOWN)


_ATOMS = st.sampled_from(["v", "phi", "A", "lambda", "0", "1", "2", "0.6", "9", "64", "1e9", "-1", "zz", "log", "v("])


def _grow(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    function = st.sampled_from(["exp", "log", "log1p", "expm1", "sqrt", "sinh", "cosh", "tanh", "asinh", "atan", "lambertw"])
    return st.one_of(
        st.builds("({}){}({})".format, inner, st.sampled_from(["+", "-", "*", "/", "**", " "]), inner),
        st.builds("{}{}{}".format, inner, st.sampled_from(["+", "-", "*", "/", "**"]), inner),
        st.builds("{}({})".format, function, inner),
        st.builds("-({})".format, inner),
    )


def _read_or_refuse(text: str) -> None:
    try:
        found = parse_expression(text, KNOWN)
    except ExpressionError as error:
        assert error.message
    else:
        assert {x.name for x in found.free_symbols} <= set(KNOWN)


@settings(max_examples=600, deadline=None, derandomize=True)
@given(st.recursive(_ATOMS, _grow, max_leaves=8))
@example("lambertw(-9)")
@example("log(log(1))")
@example("0**0.6")
@example("tanh(64)**64")
def test_any_formula_is_read_or_refused(text: str) -> None:
    _read_or_refuse(text)


@settings(max_examples=600, deadline=None, derandomize=True)
@given(st.text(max_size=40) | st.text("vA0123456789.eE+-*/()^ ,_lambdog\n", max_size=60))
def test_any_text_is_read_or_refused(text: str) -> None:
    _read_or_refuse(text)


@pytest.mark.parametrize("function", [log1p, expm1])
def test_own_functions_differentiate_and_evaluate(function: type) -> None:
    x = s("v")
    plain = {log1p: sympy.log(1 + x), expm1: sympy.exp(x) - 1}[function]
    at = sympy.Rational(3, 10)
    own = function(x)
    assert float(own.subs(x, at).evalf()) == pytest.approx(float(plain.subs(x, at)), rel=1e-15)
    assert sympy.simplify(own.diff(x) - plain.diff(x)) == 0
    assert evaluate(own, {"v": 1e-18}) == 1e-18  # the plain form gives 0
    assert sympy.simplify(own.rewrite(sympy.log).rewrite(sympy.exp) - plain) == 0
    assert sympy.lambdify(x, own, "numpy")(np.float64(1e-18)) == 1e-18


@pytest.mark.parametrize("name", ["", "1a", "a-b", "a.b", "_a", "a__b", "a_", "é", "a" * 33, *sorted(RESERVED)])
def test_identifiers_that_could_harm_generated_code(name: str) -> None:
    with pytest.raises(SrfError):
        check_identifier(name)


@pytest.mark.parametrize("name", ["lambda", "beta", "gamma", "N", "S", "I", "E", "mu0", "a_b", "D2"])
def test_identifiers_that_are_fine(name: str) -> None:
    assert check_identifier(name) == name
    with pytest.raises(SrfError, match="already"):
        check_identifier(name, taken=[name])
