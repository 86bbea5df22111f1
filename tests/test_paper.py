"""The paper's printed equations against the model: what is misprinted is found, what is right is left alone."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest
from click.testing import CliRunner

from srfcli.cli.main import cli
from srfcli.symbolic.paper import EQUATIONS, Equation, Finding, check_equation, check_paper, paper_system


@pytest.fixture(scope="module")
def findings() -> list[Finding]:
    return check_paper()


def test_the_one_misprinted_formula(findings: list[Finding]) -> None:
    wrong = [f for f in findings if f.kind == "equation" and f.verdict == "misprint"]
    assert [f.label for f in wrong] == ["eq:linsystem, second line"]
    assert "M/K*x_3/V" in wrong[0].printed
    assert "M*x_3/(V*kappa)" in wrong[0].right


def test_claims(findings: list[Finding]) -> None:
    verdicts = {f.line: f.verdict for f in findings if f.kind == "claim"}
    assert verdicts == {
        481: "roughly",
        487: "holds",
        639: "holds",
        798: "fails",
        833: "roughly",
        834: "fails",
        838: "holds",
        843: "holds",
        845: "holds",
    }
    text = {f.line: f.right for f in findings}
    assert "c = 0.0088 at 100 um/s, below 1e-3 up to 33.7 um/s" in text[834]
    assert "1.6 % at 1 um/s" in text[845]


def test_words_are_listed_apart(findings: list[Finding]) -> None:
    words = [f for f in findings if f.kind == "words"]
    assert len(words) == 6
    assert all(f.note and f.right and f.line for f in words)


MUTATIONS = (("kappa", "K"), ("K", "kappa"), ("-", "+"), ("V", "D0"), ("mu_v", "mu_phi"), ("D0", "V"), ("W0", "W"), ("v", "V"))


@pytest.mark.parametrize("equation", EQUATIONS, ids=[e.label for e in EQUATIONS])
def test_a_changed_equation_is_found_out(equation: Equation) -> None:
    """Swap one symbol or sign of a printed equation: it must not pass."""
    verdict = check_equation(paper_system(), equation).verdict
    tried = 0
    for old, new in MUTATIONS:
        pattern = re.escape(old) if old == "-" else rf"\b{old}\b"
        changed = re.sub(pattern, new, equation.printed, count=1)
        if changed == equation.printed or verdict == "misprint":
            continue
        tried += 1
        assert check_equation(paper_system(), replace(equation, printed=changed)).verdict == "misprint", changed
    assert tried or verdict == "misprint" or equation.left in ("eta", "kappa")


def test_command() -> None:
    result = CliRunner().invoke(cli, ["derive", "--check-paper", "--format", "json"], catch_exceptions=False)
    assert result.exit_code == 0 and result.output.isascii()
    document = json.loads(result.output)
    assert document["schema"] == "srf.derive-paper/1"
    assert len(document["findings"]) == 41
    assert CliRunner().invoke(cli, ["derive", "--check-paper", "--format", "latex"]).exit_code != 0
