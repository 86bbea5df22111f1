"""The discrepancy that no registered effect explains: the friction that the baseline leaves to chance, and a closed form for it.

A random friction field along slip has the baseline follow the recordings. What it took for that, smoothed over all readings of a
run, is the friction that is missing, at the resolution of the recording; a track shows no preference for velocity, age or load.

The candidates for a closed form are effects that nobody claims to be physics: powers and logarithms of slip in units of the
state's length, of velocity, age and load, places on the track, delays. The search that looks for registered effects looks for
them. What comes out is a description, offered as an effect file, unless held-out runs refuse it or it stands at a bound.
Fixed-interval smoother: de Jong, Biometrika 76 (1989).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import floor, isfinite, log10
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from srfcli.codegen.model import Array
from srfcli.core.files import toml_lines
from srfcli.core.settings import Parameter
from srfcli.core.units import from_base
from srfcli.diagnosis.hypotheses import own_parameters
from srfcli.diagnosis.residual_scan import BINS
from srfcli.diagnosis.search import BUDGET, LOG_BAYES_MARGIN, Fitted, ModelSearch
from srfcli.diagnosis.verdict import Diagnosis, HeldOutRun, at_bounds, held_out, holdout_rejection
from srfcli.inference.fit import principal_deviations
from srfcli.inference.recordings import slip_along
from srfcli.laws.effect_file import SCANNED_VALUES, formula_text
from srfcli.laws.expression import symbol
from srfcli.laws.law_file import read_header
from srfcli.laws.registry import Entry, Registry
from srfcli.laws.values import Effect
from srfcli.symbolic.system import apart

# The friction that is missing, along the recordings.

Z_95 = 1.959963984540054  # standard deviations of a 95 % band
DIFFERENCE_STEP = 0.2  # standard errors of the differences that tell what the parameters' errors do to it
COORDINATES = ("v", "phi", "W", "dlnWdt", "slip", "t")


@dataclass(frozen=True)
class SmoothedField:
    """The friction `force` (n,) that no law explains along one run, at its samples `t` (s), and its 95 % band `low`, `high`.

    Beside it what the model passes through: v (um/s), phi (s), W (N), dlnWdt (1/s), slip (um, from the run's start).
    """

    t: Array
    force: Array
    low: Array
    high: Array
    v: Array = field(repr=False)
    phi: Array = field(repr=False)
    W: Array = field(repr=False)
    dlnWdt: Array = field(repr=False)
    slip: Array = field(repr=False)

    def described(self) -> dict[str, Array]:
        """Return all arrays by name; the band also as `band` (2, n)."""
        return {**vars(self), "band": np.vstack([self.low, self.high])}

    def csv(self) -> str:
        """Return the run as a table, in full precision."""
        heads = ("time [s]", "friction", "low", "high", "v [um/s]", "phi [s]", "W [N]", "dlnWdt [1/s]", "slip [um]")
        columns = (self.t, self.force, self.low, self.high, self.v, self.phi, self.W, self.dlnWdt, self.slip)
        rows = (",".join(map(repr, row)) for row in zip(*(c.tolist() for c in columns), strict=True))
        return "\n".join([",".join(heads), *rows]) + "\n"


def smoothed_friction_field(fitted: Fitted, *, with_parameters: bool = True) -> dict[str, SmoothedField]:
    """Return the friction of each fitted run that the model leaves to its random field; nothing of a model without one.

    The band is that of the field given the recordings, and of the parameters, to first order, unless that is left out.
    """
    if fitted.fit.smooth:
        return {}
    likelihood, maximum = fitted.fit.likelihood, fitted.fit.maximum
    states = list(likelihood.problem.model.states)
    at, age = states.index("field"), next(i for i, s in enumerate(states) if s.startswith("ln_") and s != "ln_v")

    def field_of(x: Array) -> list[Array]:
        return [f.smoothed().mean[:, at] for f in likelihood.at(x, slopes=False, keep=True).runs]

    smoothed = [f.smoothed() for f in fitted.projection.runs]
    variance = [np.maximum(s.covariance[:, at, at], 0.0) for s in smoothed]
    free = np.nonzero(np.diag(maximum.covariance) > 0)[0] if with_parameters else np.zeros(0, dtype=int)
    for direction in principal_deviations(maximum.covariance[np.ix_(free, free)]).T:
        x = maximum.point.x.copy()
        x[free] += DIFFERENCE_STEP * direction
        for own, s, moved in zip(variance, smoothed, field_of(x), strict=True):
            own += np.nan_to_num((moved - s.mean[:, at]) / DIFFERENCE_STEP) ** 2
    found = {}
    for f, s, own in zip(fitted.projection.runs, smoothed, variance, strict=True):
        x, spread = s.mean, Z_95 * np.sqrt(own)
        W, W_dot = f.run.load(f.run.t)
        found[f.run.name] = SmoothedField(
            f.run.t, x[:, at], x[:, at] - spread, x[:, at] + spread, np.exp(x[:, states.index("ln_v")]),
            np.exp(x[:, age]), W, W_dot / W, slip_along(f.run, x, tuple(states)),
        )  # fmt: skip
    return found


def correlation_ratios(runs: Mapping[str, SmoothedField]) -> dict[str, float]:
    """Return the share of the force's variance within runs that averages over bins of each quantity of state account for."""
    values = np.concatenate([r.force - r.force.mean() for r in runs.values()])
    weights = np.concatenate([1 / np.maximum((r.high - r.low) ** 2, 1e-18) for r in runs.values()])
    if not np.any(values):
        return {}
    from scipy.stats import rankdata

    whole, found = float(weights @ values**2), {}
    for name in COORDINATES:
        x = np.concatenate([getattr(r, name) for r in runs.values()])
        if np.ptp(x) <= 1e-9 * max(float(np.abs(x).max()), 1e-300):
            continue
        bins = np.minimum((rankdata(x, method="average") - 1) * BINS // x.size, BINS - 1).astype(int)
        mass = np.bincount(bins, weights, BINS)
        means = np.bincount(bins, weights * values, BINS) / np.maximum(mass, 1e-300)
        found[name] = float(np.clip(mass @ means**2 / whole, 0.0, 1.0))
    return dict(sorted(found.items(), key=lambda kv: -kv[1]))


# The sparsest closed form of what is missing: candidate terms chosen one after another, each fitted in full.

TERMS_FOLDER = Path(__file__).parent / "terms"
ORIGIN = "terms"


def with_terms(registry: Registry) -> Registry:
    """Return the registry with the candidate terms besides; one whose name is taken is left out."""
    taken = {e.name for e in registry.entries("effect")}
    headers = [(path, *read_header(path)) for path in sorted(TERMS_FOLDER.glob("*.toml"))]
    return registry.plus(Entry(name, kind, ORIGIN, path, about) for path, kind, name, about in headers if name not in taken)


def best_closed_form(search: ModelSearch, diagnosis: Diagnosis) -> ClosedForm | None:
    """Return the closed form that explains most for its length; None where no term helps, or held-out runs refuse all."""
    registry = with_terms(search.registry)
    names = {e.name for e in registry.entries("effect") if e.origin == ORIGIN}
    own = ModelSearch(registry, search.experiment, search.progress, sorted(names), search.trend)
    own.budget = BUDGET / 2
    start = [diagnosis.baseline]
    if diagnosis.best is not diagnosis.baseline and not diagnosis.best.passes:
        start.append(diagnosis.best)
    own.extend(start)
    least = max(f.evidence for f in start) + LOG_BAYES_MARGIN
    for best in own.ranked():
        terms = [e for e in best.hypothesis.effects if e.name in names]
        if not terms or best.evidence < least:
            continue
        held = held_out(diagnosis.baseline, best, diagnosis.experiment)
        if at_bounds(best) or holdout_rejection([h.predicted for h in held]):
            search.progress(f"{best.name} is not offered: held-out runs refuse it, or it stands at a bound")
            continue
        beside = tuple(e for e in best.hypothesis.effects if e.name not in names)
        gain = best.fit.log_likelihood - diagnosis.baseline.fit.log_likelihood
        return ClosedForm(tuple(_fitted(e, best) for e in terms), beside, best, gain, held)
    return None


def _fitted(effect: Effect, fitted: Fitted) -> FittedTerm:
    """Return a term with its estimates, in declared units."""
    likelihood, values = fitted.fit.likelihood, {}
    errors = dict(zip(likelihood.names, np.sqrt(np.maximum(np.diag(fitted.fit.covariance), 0.0)).tolist(), strict=True))
    for name, p in own_parameters(effect, likelihood.problem.model).items():
        values[p.name] = (from_base(fitted.fit.values[name], p.unit), from_base(errors[name], p.unit))
    return FittedTerm(effect, values)


def explain_unknown(diagnosis: Diagnosis, form: ClosedForm | None, *, searched: bool = True) -> dict[str, Any]:
    """Return what there is to say where no registered effect explains a recording, as plain data and arrays.

    `force` holds, by run, the arrays of `SmoothedField.described`, and `form`, `unit`; `latent` is how that force was estimated.
    `form`, `gain`, `held_gain`, `terms` and the rest of `ClosedForm.described` are of the closed form, `form` None where no term
    helps, or where the search for it did not end, `searched`; `toml` is that form as an effect file.
    """
    baseline = diagnosis.baseline
    force = smoothed_friction_field(baseline)
    found: dict[str, Any] = {"form": None, "searched": searched, "gain": None, "held_gain": None, "terms": [], "toml": None}
    if form is not None:
        found |= {**form.described(), "toml": form.as_toml()}
    values = baseline.fit.values
    found["latent"] = {
        "amplitude": values["field_amplitude"], "length": values["field_length"],
        "rms_over_noise": baseline.fit.maximum.point.rms, "coordinates": correlation_ratios(force) if force else {},
    }  # fmt: skip
    found["csv"] = {name: run.csv() for name, run in force.items()}
    found["force"] = {**{n: run.described() for n, run in force.items()}, "form": found["form"], "unit": "1"}
    return found


# A closed form that was found for what is missing: its text, its effect file, and how well it does.

FORM_NAME = "closed-form"


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
    fitted: Fitted = field(repr=False)
    gain: float
    held: tuple[HeldOutRun, ...] = field(repr=False)

    @property
    def text(self) -> str:
        """Return the form in one line, with its coefficients and their standard errors."""
        formulas = [f"{slot} = {formula_text(formula)}" for slot, formula in self.formulas().items()]
        formulas += [f"{s.name}' = {formula_text(s.rate)}" for t in self.terms for s in t.effect.states]
        numbers = []
        for term in self.terms:
            units = {p.name: p.unit for p in term.effect.parameters}
            numbers += [f"{n} = {format_with_error(v, e)}{_unit(units[n])}" for n, (v, e) in term.values.items()]
            numbers += [f"{c.name} = {c.default:g}{_unit(c.unit)}" for c in term.effect.constants]
        beside = f" (beside {', '.join(e.name for e in self.beside)})" if self.beside else ""
        return "; ".join(formulas) + " with " + ", ".join(dict.fromkeys(numbers)) + beside

    def formulas(self) -> dict[str, sp.Expr]:
        """Return the terms together, by slot: in each the slot's own name is what was there before all of them."""
        found: dict[str, sp.Expr] = {}
        for effect in self.with_distinct_parameters():
            for slot, formula in effect.written or effect.changes:
                found[slot] = formula.xreplace({symbol(slot): found.get(slot, symbol(slot))})
        return found

    def with_distinct_parameters(self) -> tuple[Effect, ...]:
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
        sides = [[getattr(h, side).white for h in self.held] for side in ("baseline", "augmented")]
        rms = [float(np.sqrt(np.mean(np.concatenate(w) ** 2))) if w else None for w in sides]
        return {
            "form": self.text,
            "gain": self.gain,
            "held_gain": sum(h.predicted.gain for h in self.held) if self.held else None,
            "terms": [t.described() for t in self.terms],
            "beside": [e.name for e in self.beside],
            "rms_over_noise": self.fitted.fit.maximum.point.rms,
            "leaves_noise_alone": self.fitted.passes,
            "held_rms_over_noise": {"baseline": rms[0], "form": rms[1]},
        }

    def as_toml(self, *, name: str = FORM_NAME) -> str:
        """Return the terms as one effect file, fitted values as defaults."""
        named = self.with_distinct_parameters()
        head: dict[str, object] = {"format": "srf-law/1", "kind": "effect", "name": name}
        head |= {"about": "Found by search, not by theory: " + "; ".join(e.about for e in named)}
        head |= {slot: formula_text(f) for slot, f in self.formulas().items()}
        states = [{"name": s.name, "rate": str(s.rate), "steady": str(s.steady)} for e in named for s in e.states]
        needs = list(dict.fromkeys(n for e in named for n in e.needs))
        head |= {"states": states} if states else {}
        head |= {"needs": needs} if needs else {}
        head |= {} if all(e.constitutive for e in named) else {"constitutive": False}
        parameters: dict[str, object] = {}
        for term, effect in zip(self.terms, named, strict=True):
            parameters |= _parameters(effect, [v for v, _ in term.values.values()])
        lines = [*toml_lines(head), "", "[parameters]", *toml_lines(parameters)]
        constants = {c.name: {"value": c.default, "unit": c.unit} for e in named for c in e.constants}
        if constants:
            lines += ["", "[constants]", *toml_lines(constants)]
        return "\n".join(lines) + "\n"


def _parameters(effect: Effect, values: Sequence[float]) -> dict[str, object]:
    neutral, scans = dict(effect.neutral), dict(effect.scans)
    return {
        p.name: {
            "default": min(max(value, p.lower), p.upper),
            **({"neutral": neutral[p.name]} if p.name in neutral else {"scan": scans.get(p.name, SCANNED_VALUES)}),
            "unit": p.unit, "bounds": [p.lower, p.upper], "about": p.about,
        }
        for p, value in zip(effect.parameters, values, strict=True)
    }  # fmt: skip


def format_with_error(value: float, error: float) -> str:
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
