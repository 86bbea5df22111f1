"""What would have been said without a gate, from what was tried: answers that are made up, judged by hand."""

from __future__ import annotations

import pytest

from srfcli.validation.blind import Answer
from srfcli.validation.marks import information_criterion, ungated

ALPHA, DRAG = "linker-dieterich", "viscous-drag"


def tried(evidence: float, *, fine: bool = True, parameters: int = 7, log_likelihood: float | None = None):
    lnl = evidence + 8.0 if log_likelihood is None else log_likelihood
    return {"log_likelihood": lnl, "evidence": evidence, "parameters": parameters, "samples": 10000, "fine": int(fine)}


@pytest.mark.parametrize(
    ("fits", "named"),
    [
        ({ALPHA: tried(100.0), "none": tried(0.0, fine=False)}, {ALPHA}),
        ({f"{ALPHA}+{DRAG}": tried(103.0), ALPHA: tried(100.0), "none": tried(0.0, fine=False)}, {ALPHA}),
        ({f"{ALPHA}+{DRAG}": tried(107.0), ALPHA: tried(100.0), "none": tried(0.0, fine=False)}, {ALPHA, DRAG}),
        ({DRAG: tried(102.0, fine=False), ALPHA: tried(100.0), "none": tried(0.0, fine=False)}, {ALPHA}),
        # fine in a fit that is not listed
        ({ALPHA: tried(100.0, fine=False), "none": tried(0.0, fine=False)}, {ALPHA}),
    ],
)
def test_without_held_out_runs_that_is_named_which_the_verdict_would_have_named(fits, named):
    answer = Answer("case-000", "unknown", tried=fits, ungated="identified")
    assert ungated(answer) == ("identified", frozenset(named))


def test_a_verdict_that_held_out_runs_did_not_change_is_as_it_is():
    answer = Answer("case-000", "identified", (DRAG,), tried={ALPHA: tried(100.0)}, ungated="identified")
    assert ungated(answer) == ("identified", frozenset({DRAG}))


def test_the_information_criterion_asks_for_half_a_logarithm_of_the_samples_a_parameter():
    """4.6 for each of 10000 samples' parameters; whether noise is left does not matter to it."""
    one = tried(0.0, fine=False, parameters=7, log_likelihood=50.0)
    two = {"parameters": 9, "log_likelihood": 59.0}
    assert information_criterion(Answer("c", "unknown", tried={ALPHA: one, f"{ALPHA}+{DRAG}": one | two}))[1] == {ALPHA}
    two["log_likelihood"] = 59.5
    assert len(information_criterion(Answer("c", "unknown", tried={ALPHA: one, f"{ALPHA}+{DRAG}": one | two}))[1]) == 2
