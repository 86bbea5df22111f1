"""The sparsest closed form of what is missing: candidate terms chosen one after another, each fitted in full.

The candidates are effects that nobody claims to be physics: powers and logarithms of slip in units of the state's length, of
velocity, age and load, places on the track, delays. They are scored as registered effects are, refitted where they promise most,
and the best is kept while its evidence pays for its parameters. What comes out is a description, offered as an effect file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

import srfcli
from srfcli.diagnosis.candidates import Hypothesis, applicable, own_parameters
from srfcli.diagnosis.closedform import ClosedForm, FittedTerm
from srfcli.diagnosis.contest import contest
from srfcli.diagnosis.force import missing_force
from srfcli.diagnosis.refits import NEAR, Refit
from srfcli.diagnosis.score import Score, scores
from srfcli.diagnosis.search import WORTH, Search
from srfcli.diagnosis.verdict import Diagnosis, judge_held
from srfcli.errors import SrfError
from srfcli.expression import symbol
from srfcli.inference.latent import LatentFit
from srfcli.lawfile import read_header
from srfcli.laws import Effect
from srfcli.registry import Entry, Registry
from srfcli.units import from_base

FOLDER = Path(srfcli.__file__).parent / "data" / "terms"
ORIGIN = "terms"
MOST_TERMS = 3
TRIED = 4  # refitted at each step, those that promise most
TWINS, ALIKE = 3, 0.98  # of so many signals that are so alike
PAYS = 3.0  # gain in log evidence below which a further term is not worth its words
MOST_EVALUATIONS = 700  # of the recordings by a model with slopes


def with_terms(registry: Registry) -> Registry:
    """Return the registry with the candidate terms besides; one whose name is taken is left out."""
    taken = {e.name for e in registry.entries("effect")}
    return Registry((*registry.entries(), *(e for e in _entries() if e.name not in taken)), registry.problems)


@lru_cache(maxsize=1)
def _entries() -> tuple[Entry, ...]:
    found = []
    for path in sorted(FOLDER.glob("*.toml")):
        kind, name, about = read_header(path)
        found.append(Entry(name, kind, ORIGIN, path, about))
    return tuple(found)


def best_form(search: Search, diagnosis: Diagnosis) -> ClosedForm | None:
    """Return the closed form that explains most for its length, judged on held-out runs; None where no term helps."""
    own = _with_own_terms(search)
    names = [e.name for e in own.registry.entries("effect") if e.origin == ORIGIN]
    candidates, _ = applicable(own.registry, own.experiment, names)
    best = _Selection(own, candidates).run(diagnosis)
    best = _smoothed(own, best)
    search.evaluations += own.evaluations
    best = _as_judged(own, best) if best is not None else None
    terms = [e for e in best.hypothesis.effects if e.name in names] if best is not None else []
    if best is None or not terms:
        return None
    held = judge_held(own, best, diagnosis.baseline, diagnosis.experiment)
    fitted = tuple(_fitted(e, best) for e in terms)
    beside = tuple(e for e in best.hypothesis.effects if e.name not in names)
    gain = best.fit.log_likelihood - _as_judged(own, diagnosis.baseline).fit.log_likelihood
    return ClosedForm(fitted, beside, best, gain, held)


def _as_judged(search: Search, refit: Refit) -> Refit:
    """Return a refit under the noise as it is known now: better fits that came later may have told it better."""
    return search.tried.get((refit.name, refit.rough), refit)


def _smoothed(search: Search, best: Refit | None) -> Refit | None:
    """Return the refit on a smooth track instead where the term leaves nothing for a rough one to do."""
    if best is None or not best.rough:
        return best
    smooth = search.refit(best.hypothesis, best, {}, rough=False)
    return max((_as_judged(search, best), smooth), key=lambda r: r.evidence)


def _with_own_terms(search: Search) -> Search:
    """Return a search that knows the terms, and all that the one before has fitted."""
    return replace(
        search, registry=with_terms(search.registry), effects=None, tried=dict(search.tried), scored={}, excluded=[],
        followed=dict(search.followed), held=dict(search.held), loose=dict(search.loose), noise=dict(search.noise),
        stale=set(), evaluations=0,
    )  # fmt: skip


@dataclass
class _Selection:
    """Forward selection over candidate terms, from the baseline and from the best that registered effects could do."""

    search: Search
    candidates: Sequence[Effect]
    done: set[frozenset[str]] = field(default_factory=set)

    def run(self, diagnosis: Diagnosis) -> Refit | None:
        """Return the refit with the best evidence that has a term; None where no term was worth it."""
        start = diagnosis.baseline
        best = self.step(start)
        if diagnosis.best.hypothesis.effects and not (best is not None and best.adequacy.fine):
            other = self.step(diagnosis.best)
            found = [_as_judged(self.search, r) for r in (best, other) if r is not None]
            best = max(found, key=lambda r: r.evidence, default=None)
        for _ in range(MOST_TERMS - 1):
            if best is None or best.adequacy.fine:
                break
            longer = self.step(best)
            best = _as_judged(self.search, longer or best)
            if longer is None:
                break
        return best

    def step(self, start: Refit) -> Refit | None:
        """Return the best refit with one term more than `start`; None where none has evidence enough."""
        search = self.search
        if start.rough or start.adequacy.rms_over_noise < NEAR:
            found = []
            for hypothesis, own in search.widened(start, _foremost(self.scored(start, start.fit))):
                if self.new(hypothesis):
                    found.append(search.refit(hypothesis, start, own, rough=start.rough))
        else:
            candidates = _foremost(self.scored(start, search.loosely(start)))
            entrants = [(h, own) for h, own in search.widened(start, candidates) if self.new(h)]
            found = contest(search, start, entrants)
        best = max((_as_judged(search, r) for r in found), key=lambda r: r.evidence, default=None)
        return best if best is not None and best.evidence > _as_judged(search, start).evidence + PAYS else None

    def new(self, hypothesis: Hypothesis) -> bool:
        """Return whether a hypothesis was not tried before and there is something left to try it with."""
        key = frozenset(e.name for e in hypothesis.effects)
        if key in self.done:
            return False
        if self.search.evaluations > MOST_EVALUATIONS:
            self.search.progress(f"{hypothesis.name} is not tried: the budget is spent")
            return False
        self.done.add(key)
        return True

    def scored(self, start: Refit, around: LatentFit) -> list[Score]:
        """Return the scores of all terms that a refit lacks and can be joined with, largest gain first, by slopes `around`."""
        search, present = self.search, start.hypothesis.effects
        left = search.joining(self.candidates, present)
        found: list[Score] = []
        for group in _groups(left, present):
            search.progress(f"{start.name}: {len(group)} terms scored")
            try:
                found += scores(search.registry, around.problem.experiment, around, group, present=present)
            except SrfError as error:  # such as two terms that leave no steady state in closed form
                search.progress(f"{', '.join(e.name for e in group)}: {error.message}")
        return sorted((s for s in found if s.gain > WORTH), key=lambda s: -s.gain)


def _groups(left: Sequence[Effect], present: Sequence[Effect]) -> Iterator[list[Effect]]:
    """Yield terms that one model can have together, with those present: one that moves the steady state goes without others."""
    rests = [_rest(e) for e in present]
    if "moves" not in rests:
        yield [e for e in left if _rest(e) != "moves"]
        if "keeps" not in rests:
            yield from ([e] for e in left if _rest(e) == "moves")
    else:
        yield [e for e in left if _rest(e) == "silent"]


def _rest(effect: Effect) -> str:
    """Return what an effect does to the age's rate at rest: nothing (silent), something that keeps v phi = D0, or it moves it."""
    rate = dict(effect.changes).get("rate")
    if rate is None:
        return "silent"
    still = rate.subs(symbol("W_dot"), 0)
    if sp.simplify(still - symbol("rate")) == 0:
        return "silent"
    steady = still.subs({symbol("rate"): 0, symbol("phi"): symbol("D0") / symbol("v")})
    return "keeps" if sp.simplify(steady) == 0 else "moves"


def _foremost(listed: Sequence[Score]) -> list[Score]:
    """Return the scores that promise most, of twins no more than two."""
    found: list[Score] = []
    for score in listed:
        twins = sum(abs(float(score.direction @ other.direction)) > ALIKE for other in found)
        if twins < TWINS:
            found.append(score)
        if len(found) == TRIED:
            break
    return found


def _fitted(effect: Effect, refit: Refit) -> FittedTerm:
    """Return a term with its estimates, in declared units."""
    fitted = refit.fit
    errors = dict(zip(fitted.problem.names, np.sqrt(np.maximum(np.diag(fitted.covariance), 0.0)).tolist(), strict=True))
    values = {}
    for name, p in own_parameters(effect, fitted.problem.model).items():
        values[p.name] = (from_base(fitted.values[name], p.unit), from_base(errors[name], p.unit))
    return FittedTerm(effect, values)


def explain_unknown(search: Search, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return what there is to say where no registered effect explains a recording, as plain data and arrays.

    `force` holds, by run, the arrays of `RunForce.described`, and `form`, `unit`; `latent` is how that force was estimated.
    `form`, `gain`, `held_gain`, `terms` and the rest of `ClosedForm.described` are of the closed form, `form` None where no term
    helps; `toml` is that form as an effect file.
    """
    force = missing_force(search, diagnosis.baseline)
    form = best_form(search, diagnosis)
    found: dict[str, Any] = {"form": None, "gain": None, "held_gain": None, "terms": [], "toml": None}
    if form is not None:
        found |= {**form.described(), "toml": form.as_toml()}
    about = {"amplitude": force.amplitude, "time": force.time, "share": force.share, "gain": force.gain}
    found["latent"] = about | {"rms_over_noise": force.rms_over_noise, "coordinates": dict(force.coordinates)}
    found["force"] = {**force.described(), "form": found["form"], "unit": "1"}
    return found
