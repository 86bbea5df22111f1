"""A closed form that was found for what is missing: its text, its effect file, and how well it does."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import floor, isfinite, log10
from typing import Any

import sympy as sp

from srfcli.diagnosis.refits import Refit
from srfcli.diagnosis.verdict import Held
from srfcli.effectfile import formula_text
from srfcli.expression import symbol
from srfcli.laws import Effect, Parameter
from srfcli.system import apart

NAME = "closed-form"
SCAN = 8  # values at which a later search tries the parameters that are seen only where the form's size is not neutral


@dataclass(frozen=True)
class FittedTerm:
    """A term with (value, standard error) of each parameter, in declared units."""

    effect: Effect
    values: Mapping[str, tuple[float, float]]

    def described(self) -> dict[str, Any]:
        """Return it as plain data."""
        units = {p.name: p.unit for p in self.effect.parameters}
        parameters = {n: {"value": v, "stderr": e, "unit": units[n]} for n, (v, e) in self.values.items()}
        return {"name": self.effect.name, "about": self.effect.about, "parameters": parameters}


@dataclass(frozen=True)
class ClosedForm:
    """Terms, chosen and fitted; `beside` are the registered effects in the same model.

    `gain` is in log likelihood over the baseline, in the fitted runs; `held` are the held-out runs under both.
    """

    terms: tuple[FittedTerm, ...]
    beside: tuple[Effect, ...]
    refit: Refit = field(repr=False)
    gain: float
    held: tuple[Held, ...] = field(repr=False)

    @property
    def held_gain(self) -> float | None:
        """Return the gain in log likelihood over the baseline in held-out runs; None without any."""
        return sum(h.gain for h in self.held) if self.held else None

    @property
    def text(self) -> str:
        """Return the form in one line, with its coefficients and their standard errors."""
        formulas = [f"{slot} = {formula_text(formula)}" for slot, formula in self.formulas().items()]
        formulas += [f"{s.name}' = {formula_text(s.rate)}" for t in self.terms for s in t.effect.states]
        numbers = []
        for term in self.terms:
            units = {p.name: p.unit for p in term.effect.parameters}
            numbers += [f"{n} = {with_error(v, e)}{_unit(units[n])}" for n, (v, e) in term.values.items()]
            numbers += [f"{c.name} = {c.default:g}{_unit(c.unit)}" for c in term.effect.constants]
        beside = f" (beside {', '.join(e.name for e in self.beside)})" if self.beside else ""
        return "; ".join(formulas) + " with " + ", ".join(dict.fromkeys(numbers)) + beside

    def formulas(self) -> dict[str, sp.Expr]:
        """Return the terms together, by slot: in each the slot's own name is what was there before all of them."""
        found: dict[str, sp.Expr] = {}
        for effect in self.named():
            for slot, formula in effect.written or effect.changes:
                found[slot] = formula.xreplace({symbol(slot): found.get(slot, symbol(slot))})
        return found

    def named(self) -> tuple[Effect, ...]:
        """Return the terms with parameters that no two of them share; their constants as numbers where names would clash."""
        effects = [t.effect for t in self.terms]
        constants: dict[str, Parameter] = {}
        out = []
        for own, named in zip(effects, apart(effects), strict=True):
            clash = any(constants.get(c.name, c) != c for c in own.constants)
            if clash or [p.name for p in own.parameters] != [p.name for p in named.parameters]:
                named = replace(named, written=(), constants=())
            constants |= {c.name: c for c in named.constants}
            out.append(named)
        return tuple(out)

    def described(self) -> dict[str, Any]:
        """Return it as plain data: form, gains, terms, and what is left."""
        squares = [(h.run.used.sum(), h.rms_baseline**2, h.rms_augmented**2) for h in self.held]
        count = sum(int(n) for n, _, _ in squares)
        rms = [(sum(float(s[0] * s[k]) for s in squares) / count) ** 0.5 if count else None for k in (1, 2)]
        return {
            "form": self.text,
            "gain": self.gain,
            "held_gain": self.held_gain,
            "terms": [t.described() for t in self.terms],
            "beside": [e.name for e in self.beside],
            "rms_over_noise": self.refit.adequacy.rms_over_noise,
            "leaves_noise_alone": self.refit.adequacy.fine,
            "held_rms_over_noise": {"baseline": rms[0], "form": rms[1]},
        }

    def as_toml(self, *, name: str = NAME) -> str:
        """Return the terms as one effect file, fitted values as defaults."""
        named = self.named()
        lines = ['format = "srf-law/1"', 'kind = "effect"', f"name = {_text(name)}"]
        lines.append(f"about = {_text('Found by search, not by theory: ' + '; '.join(e.about for e in named))}")
        lines += [f"{slot} = {_text(formula_text(f))}" for slot, f in self.formulas().items()]
        states = [s for e in named for s in e.states]
        if states:
            rows = [
                f"name = {_text(s.name)}, rate = {_text(str(s.rate))}, steady = {_text(str(s.steady))}" for s in states
            ]
            lines.append("states = [" + ", ".join("{ " + row + " }" for row in rows) + "]")
        needs = list(dict.fromkeys(n for e in named for n in e.needs))
        if needs:
            lines.append(f"needs = [{', '.join(map(_text, needs))}]")
        if not all(e.constitutive for e in named):
            lines.append("constitutive = false")
        lines += ["", "[parameters]"]
        for term, effect in zip(self.terms, named, strict=True):
            lines += _parameters(effect, [v for v, _ in term.values.values()])
        constants = list(dict.fromkeys(c for e in named for c in e.constants))
        if constants:
            lines += ["", "[constants]"]
            lines += [f"{c.name} = {{ value = {c.default!r}, unit = {_text(c.unit)} }}" for c in constants]
        return "\n".join(lines) + "\n"


def _parameters(effect: Effect, values: Sequence[float]) -> list[str]:
    neutral, scans, lines = dict(effect.neutral), dict(effect.scans), []
    for p, value in zip(effect.parameters, values, strict=True):
        cells = [f"default = {min(max(value, p.lower), p.upper)!r}"]
        cells.append(f"neutral = {neutral[p.name]!r}" if p.name in neutral else f"scan = {scans.get(p.name, SCAN)}")
        cells += [f"unit = {_text(p.unit)}", f"bounds = [{p.lower!r}, {p.upper!r}]", f"about = {_text(p.about)}"]
        lines.append(f"{p.name} = {{ {', '.join(cells)} }}")
    return lines


def with_error(value: float, error: float) -> str:
    """Return a value with its standard error, to two digits of that."""
    if not (isfinite(error) and error > 0):
        return f"{value:.6g}"
    places = 1 - floor(log10(error))
    if 0 <= places <= 6:
        return f"{value:.{places}f} ± {error:.{places}f}"
    digits = max(floor(log10(max(abs(value), error))) - floor(log10(error)) + 1, 1)
    return f"{value:.{digits}e} ± {error:.1e}"


def _unit(unit: str) -> str:
    return "" if unit in ("", "1") else f" {unit}"


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)
