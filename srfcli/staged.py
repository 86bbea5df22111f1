"""Formulas in steps: named intermediate values, then outputs in them; derivatives are taken step by step.

A derivative of a long formula written out grows out of hand (a minute to derive, megabytes to print); step by step it stays
a small multiple of the steps.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import sympy as sp

LONG = 140  # operations: up to it formulas are kept whole, where common subexpressions read better

Step = tuple[sp.Symbol, sp.Expr]


@dataclass(frozen=True)
class Staged:
    """Outputs in terms of inputs and steps; each step is in terms of inputs and earlier steps."""

    outputs: tuple[sp.Expr, ...]
    steps: tuple[Step, ...] = ()
    names: Iterator[sp.Symbol] = field(default_factory=lambda: sp.numbered_symbols("_s"), compare=False, repr=False)

    def substituted(self, values: Mapping[sp.Expr, sp.Expr]) -> Staged:
        """Return the same with inputs replaced; the steps keep their names."""
        steps = tuple((s, e.subs(values)) for s, e in self.steps)
        return Staged(tuple(e.subs(values) for e in self.outputs), steps, self.names)

    def with_outputs(self, outputs: Sequence[sp.Expr]) -> Staged:
        """Return other outputs of the same steps."""
        return Staged(tuple(outputs), self.steps, self.names)

    def derivative(self, direction: Mapping[sp.Symbol, sp.Expr]) -> Staged:
        """Return the outputs' derivatives as the inputs change in `direction`: a rate for each input that does."""
        rates = dict(direction)
        added: list[Step] = []
        for step, formula in self.steps:
            rate = _total(formula, rates)
            if rate != 0:
                name = next(self.names)
                added.append((name, rate))
                rates[step] = name
        return Staged(tuple(_total(e, rates) for e in self.outputs), (*self.steps, *added), self.names)

    def needed(self) -> tuple[Step, ...]:
        """Return the steps that the outputs depend on, in order."""
        used = set().union(*(e.free_symbols for e in self.outputs))
        kept = []
        for step, formula in reversed(self.steps):
            if step in used:
                kept.append((step, formula))
                used |= formula.free_symbols
        return tuple(reversed(kept))


def staged(outputs: Sequence[sp.Expr]) -> Staged:
    """Return these formulas, whole where they are short, else cut at their common subexpressions."""
    if sum(sp.count_ops(e) for e in outputs) <= LONG:
        return Staged(tuple(outputs))
    names = sp.numbered_symbols("_s")
    steps, reduced = sp.cse(list(outputs), symbols=names, order="canonical")
    return Staged(tuple(reduced), tuple(steps), names)


def joined(parts: Sequence[Staged]) -> Staged:
    """Return the outputs of all `parts`, which have grown from one, and their steps, each once."""
    steps = dict(itertools.chain.from_iterable(p.steps for p in parts))
    return Staged(tuple(itertools.chain.from_iterable(p.outputs for p in parts)), tuple(steps.items()), parts[0].names)


def _total(formula: sp.Expr, rates: Mapping[sp.Symbol, sp.Expr]) -> sp.Expr:
    moving = sorted(formula.free_symbols & rates.keys(), key=str)
    return sp.Add(*(sp.diff(formula, s) * rates[s] for s in moving))
