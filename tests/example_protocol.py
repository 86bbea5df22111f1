"""The runs of the worked examples, for tests of the generator."""

from __future__ import annotations

from srfcli.validation.slider import Plan


def example_protocol() -> tuple[Plan, ...]:
    """Return the seven runs of the worked examples."""
    return (
        Plan("steps", ((2, 5), (1.5, 20), (2, 5), (1, 50), (2, 10)), 5.0, 0.004),
        Plan("stickslip", ((0.5, 12), (5, 8)), 9.0, 0.004),
        Plan("onset", ((0.5, 12), (4, 8)), 9.0, 0.001, eps=0.09, f=120, onset=2),
        Plan("strong", ((2.5, 20),), 7.0, 0.001, eps=0.2, f=120, onset=0.6),
        Plan("loadstep", ((6, 10),), 5.0, 0.002, steps=((2, 1.5), (4, -1.5))),
        Plan("holdout-mod", ((3, 15),), 8.0, 0.001, holdout=True, eps=0.13, f=80, onset=0.8),
        Plan("holdout-shs", ((2, 10), (4, 0.1), (3, 10)), 5.0, 0.004, holdout=True),
    )
