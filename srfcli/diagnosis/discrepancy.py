"""The discrepancy that no registered effect explains: a friction of no assumed form, then the sparsest closed form for it.

A cubic spline over each run's own clock is added to mu. Its numbers have the prior of a rough track (see `latent`), in seconds;
amplitude and correlation time are those of the largest marginal likelihood, and the model's own parameters are estimated again
with it: what they can absorb is not missing.

The candidates are effects that nobody claims to be physics: powers and logarithms of slip in units of the state's length, of
velocity, age and load, places on the track, delays. They are scored as registered effects are, refitted where they promise most,
and the best is kept while its evidence pays for its parameters. What comes out is a description, offered as an effect file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from math import floor, isfinite, log10
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp
from scipy.stats import rankdata

from srfcli.codegen.model import Array, open_model
from srfcli.codegen.splines import Spline
from srfcli.core.errors import SrfError
from srfcli.core.settings import Parameter
from srfcli.core.units import from_base
from srfcli.data.values import Run
from srfcli.diagnosis.hypotheses import NEAR, Hypothesis, Refit, applicable, own_parameters
from srfcli.diagnosis.staged_score import Score, scores
from srfcli.diagnosis.staged_search import WORTH, Search, contest
from srfcli.diagnosis.verdict import Diagnosis, Held, judge_held
from srfcli.inference.fit import Problem
from srfcli.inference.prediction import Hold
from srfcli.inference.random_field import LatentFit, Tracks, fit_latent
from srfcli.laws.effect_file import formula_text
from srfcli.laws.expression import symbol
from srfcli.laws.law_file import read_header
from srfcli.laws.registry import Entry, Registry
from srfcli.laws.values import Effect
from srfcli.symbolic.system import apart

# The friction that is missing, as a function of time in each run: estimated along the recordings, of no assumed form.

TABLE = ("mu", "time")
KNOTS, FINEST = 90, 0.01  # intervals of a run's spline, and how short the shortest may be (s)
AMPLITUDES = np.array([0.0, *np.geomspace(5e-5, 5e-2, 13)])  # of mu
TIMES = np.geomspace(0.02, 4.0, 9)  # s, correlation times that are tried
ROUNDS, STEPS = 4, 12
NORMAL = 1.959963984540054  # standard deviations of a 95 % band
BINS = 12  # in which the force is averaged along a quantity of state
COORDINATES = ("v", "phi", "W", "dlnWdt", "slip", "t")


@dataclass(frozen=True)
class RunForce:
    """The missing friction coefficient `force` (n,) along one run at its samples `t` (s), its 95 % band `low`, `high`.

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
        found = {k: getattr(self, k) for k in self.__dataclass_fields__}
        return found | {"band": np.vstack([self.low, self.high])}


@dataclass(frozen=True)
class Force:
    """The missing friction of all runs: standard deviation `amplitude`, correlation time `time` (s).

    `share` is the part of the samples that were looked at, `gain` the log likelihood over the same model on a smooth track
    without a force,
    `coordinates` the share of the force's square that is a function of one quantity of state, the same in all runs.
    """

    runs: Mapping[str, RunForce]
    amplitude: float
    time: float
    share: float
    gain: float
    rms_over_noise: float
    coordinates: Mapping[str, float]
    fit: LatentFit = field(repr=False)

    def described(self) -> dict[str, Any]:
        """Return the arrays of each run by its name, as figures take them."""
        return {name: run.described() for name, run in self.runs.items()}


def tracks_over_time(runs: Sequence[Run], *, knots: int = KNOTS) -> Tracks:
    """Return functions of each run's own clock that vanish, with `knots` intervals each."""
    spans = [(float(r.t[0]), float(r.t[-1])) for r in runs]
    splines = tuple(Spline.over(a, b, max((b - a) / knots, FINEST)) for a, b in spans)
    return Tracks(splines, {r.name: i for i, r in enumerate(runs)})


def missing_force(search: Search, refit: Refit, *, knots: int = KNOTS) -> Force:
    """Return the friction that a fitted hypothesis lacks, along the runs that it was fitted to.

    Where the hypothesis is far off, the force is found while the slider is held to the recording first, then without.
    """
    near = refit.adequacy.rms_over_noise < NEAR
    around = refit.fit if near else search.loosely(refit)
    tracks, roughness = tracks_over_time(around.problem.runs, knots=knots), None
    search.progress(f"{refit.name}: the force that is missing")
    for hold in [None] if near else [around.problem.hold, None]:
        problem = _problem(search, refit, around, hold)
        fitted = fit_latent(
            problem, problem.start, search.noise, tracks=tracks, roughness=roughness, known_noise=True, rounds=ROUNDS,
            steps=STEPS, grid=(TIMES, AMPLITUDES),
        )  # fmt: skip
        tracks, roughness, around = fitted.point.tracks, fitted.point.roughness, fitted
        search.evaluations += fitted.evaluations
    smooth = search.tried.get((refit.name, False))
    return _force(refit, smooth.fit if smooth is not None else refit.fit, fitted)


def _problem(search: Search, refit: Refit, around: LatentFit, hold: Hold | None) -> Problem:
    """Return the problem of a refit, from where `around` stands, whose model has the force instead of a track."""
    choice = search.experiment.choice.plus(e.name for e in refit.hypothesis.effects)
    model = open_model(search.registry, **asdict(choice), tables=(TABLE, hold.table) if hold else (TABLE,))
    problem = around.problem
    return replace(problem, model=model, start=np.clip(around.point.theta, problem.lower, problem.upper), hold=hold)


def _force(refit: Refit, bare: LatentFit, fitted: LatentFit) -> Force:
    """Return force, bands and states from the fit that has the force."""
    tracks, roughness = fitted.point.tracks, fitted.point.roughness
    covariance = _covariance(fitted)
    found, squares, count = {}, 0.0, 0
    for run in fitted.problem.runs:
        design = tracks.spline(run).design(run.t)
        own = list(tracks.columns(run))
        spread = NORMAL * np.sqrt(
            np.maximum(np.einsum("ij,jk,ik->i", design, covariance[np.ix_(own, own)], design), 0.0)
        )
        values = design @ tracks.spline(run).numbers
        found[run.name] = RunForce(run.t, values, values - spread, values + spread, **_states(fitted, run))
        r = (run.observed - fitted.point.predictions[run.name].y)[run.used] / fitted.noise[run.name].level
        squares, count = squares + float(r @ r), count + r.size
    whole = sum(r.t.size for r in refit.fit.problem.runs)
    share = sum(r.t.size for r in fitted.problem.runs) / whole
    return Force(
        found, roughness.amplitude, roughness.length, share, float(fitted.log_likelihood - bare.log_likelihood),
        float(np.sqrt(squares / count)), _coordinates(found), fitted,
    )  # fmt: skip


def _covariance(fitted: LatentFit) -> Array:
    """Return the covariance of the force's numbers, that of the parameters included."""
    point, n = fitted.point, fitted.point.theta.size
    if not point.roughness.amplitude:
        return np.zeros((point.tracks.numbers.size,) * 2)
    L = point.tracks.root(point.roughness)
    G, cross, own = point.N[n:, n:], point.N[:n, n:], point.N[:n, :n]
    d = np.sqrt(np.maximum(np.diag(own), 1e-300))
    kept = np.linalg.pinv(own / np.outer(d, d), rcond=1e-12, hermitian=True) / np.outer(d, d) if n else own
    core = L.T @ (G - cross.T @ kept @ cross) @ L + np.eye(L.shape[1])
    return np.asarray(L @ np.linalg.solve(core, L.T))


def _states(fitted: LatentFit, run: Run) -> dict[str, Array]:
    """Return what the model passes through along a run."""
    x, states = fitted.point.predictions[run.name].x, fitted.problem.model.states
    v = np.exp(x[:, states.index("ln_v")])
    age = next(i for i, s in enumerate(states) if s.startswith("ln_") and s != "ln_v")
    W, W_dot = run.load(run.t)
    slip = run.start + np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(run.t))])
    return {"v": v, "phi": np.exp(x[:, age]), "W": W, "dlnWdt": W_dot / W, "slip": slip}


def _coordinates(runs: Mapping[str, RunForce]) -> dict[str, float]:
    """Return the share of the force's variance within runs that averages over bins of each quantity of state account for."""
    values = np.concatenate([r.force - r.force.mean() for r in runs.values()])
    weights = np.concatenate([1 / np.maximum((r.high - r.low) ** 2, 1e-18) for r in runs.values()])
    if not np.any(values):
        return {}
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

FOLDER = Path(__file__).parent / "terms"
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


# A closed form that was found for what is missing: its text, its effect file, and how well it does.

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
