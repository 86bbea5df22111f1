"""Whether the truth was likelier than what a sealed trial answered: the search missed it, or the recordings do not tell it.

    python benchmarks/at_the_truth.py TRIAL [CASE ...]

TRIAL is a folder of `srf prove`, unsealed. The model that holds what is concealed is fitted from the truth's own parameters, with
the gauge noise and the field that were drawn as start values, to the recordings that the search sees. Its log evidence stands
beside that of the likeliest model that the trial tried: by more than LOG_BAYES_MARGIN above it, the search failed; by more than
LOG_BAYES_MARGIN below, another model explains the recordings better; else they do not tell. Without cases those are taken that
were not answered rightly and whose effects are all registered. `white` is the mean square of the innovations at the truth: far
from 1 the fitter's equations would not be the generator's.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import common  # noqa: F401  before NumPy: it fixes the number of threads
import numpy as np
from common import Report

from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.data.groups import GAUGE_NOISE
from srfcli.diagnosis.hypotheses import Hypothesis, own_parameters
from srfcli.diagnosis.search import LOG_BAYES_MARGIN, SEARCH_TOLERANCE, ModelSearch
from srfcli.inference.fit import Problem
from srfcli.inference.state_space import Likelihood, StateSpaceFit, maximise
from srfcli.laws.registry import bundled_registry
from srfcli.laws.values import Effect
from srfcli.validation.blind import Answer, read_answers
from srfcli.validation.cases import EFFECTS, recipe_of, unseal

RTOL = 1e-4  # tolerance of the integration
LAWS = {  # a law's parameter: the field of the truth
    "mu0": "mu0", "A": "A", "B": "B", "D0": "D0", "Vsat": "Vsat", "Va": "Va", "Vb": "Vsat", "lambda": "lam", "c": "nagata",
    "B2": "B2", "D2": "D2",
}  # fmt: skip
INNER = {"D2": "D2", "wavelength": "topo_L", "pitch": "ripple_p"}  # the same of an effect's inner parameters
WAVES = {  # phases: the field, and by how much a sine leads the truth's cosine
    "load-distortion": ("distortion_phase", 0.0), "track-topography": ("topo_phase", math.pi / 2),
    "drive-ripple": ("ripple_phase", math.pi / 2),
}  # fmt: skip
MISSED, LESS, UNTOLD = "missed by the search", "less likely than another", "not told by the recordings"
PROCESSES = {"white": (), "one run louder": (), "uneven": (), "gaps": (), "spikes": (), "1/f": ("relaxation", "relaxation")}
WHITE_SHARE = 0.5  # of the noise's variance, where processes of coloured noise begin beside it


def of_an_effect(effect: Effect, truth: Any) -> dict[str, float]:
    """Return the values of an effect's own parameters that the truth knows."""
    drawn = [e for e in EFFECTS if e.name == effect.reported]
    if effect.reported == "friction-drift":
        varies = "drift_x" if effect.name.endswith("slip") else "drift_t"
        return {"rate": getattr(truth, varies), "onset": getattr(truth, f"{varies}0")}
    if effect.name == "age-saturation":
        return {"cutoff": 1 / truth.Vsat}
    found = {name: getattr(truth, drawn[0].varies) for name in effect.sizes}
    found |= {p.name: getattr(truth, INNER[p.name]) for p in effect.parameters if p.name in INNER}
    if effect.name in WAVES:
        field, lead = WAVES[effect.name]
        found["phase"] = math.remainder(getattr(truth, field) + lead, 2 * math.pi)
    return found | ({"K": truth.K * truth.ratio} if "K" in effect.frees else {}) | ({"M": truth.M} if "M" in effect.frees else {})


def candidate(search: ModelSearch, name: str, truth: Any, run: str) -> Effect:
    """Return the registered effect that is concealed; SrfError for none."""
    found = [e for e in search.candidates if e.reported == name]
    if name == "friction-drift":
        found = [e for e in found if e.name.endswith("slip") == bool(truth.drift_x)]
    if not found:
        raise SrfError(f"{name} is no candidate")
    return replace(found[0], run=run)


def right_hypothesis(search: ModelSearch, concealed: dict[str, Any]) -> Hypothesis:
    """Return the hypothesis that holds what is concealed; SrfError where it is not registered."""
    laws, truth = [n for n in concealed["effects"] if n in search.laws], recipe_of(concealed).physics
    run = concealed.get("only") or ""
    return Hypothesis(tuple(candidate(search, n, truth, run) for n in concealed["effects"] if n not in laws), "".join(laws))


def right_problem(folder: Path, concealed: dict[str, Any]) -> tuple[ModelSearch, Hypothesis, Problem]:
    """Return a search of a case, the hypothesis that holds what is concealed, and its problem; SrfError where there is none."""
    registry = bundled_registry()
    search = ModelSearch(registry, read_experiment(folder, registry=registry, holdout=False))
    hypothesis, experiment = right_hypothesis(search, concealed), search.experiment
    if concealed["noise"] == "one run louder" and len(experiment.runs) > 1:
        experiment = replace(experiment, vary={GAUGE_NOISE: "run"})
    return search, hypothesis, hypothesis.problem(registry, experiment)


def fitted(folder: Path, concealed: dict[str, Any]) -> tuple[str, float, float, float, bool]:
    """Return the model that holds what is concealed, its log evidence and likelihood, `white`, whether it saw all readings."""
    truth, (search, hypothesis, problem) = recipe_of(concealed).physics, right_problem(folder, concealed)
    likelihood = Likelihood(problem, processes=PROCESSES.get(concealed["noise"], ("relaxation",)), rtol=RTOL)
    values, stated = likelihood.values(likelihood.start), recipe_of(concealed).baseline
    values |= {n: float(getattr(stated, LAWS[n])) for n in problem.names if n in LAWS and getattr(stated, LAWS[n])}
    for effect in hypothesis.effects:
        longs = {p.name: long for long, p in own_parameters(effect, problem.model).items()}
        values |= {longs.get(name, name): float(value) for name, value in of_an_effect(effect, truth).items()}
    values |= {"field_amplitude": concealed["rough"], "field_length": truth.track.length}
    sigma = concealed["gauge"]["sigma"] * (1e-3 if concealed["rig"] == "micro-force" else 1.0)  # mN there
    for name in likelihood.names:
        if name.startswith("gauge_white"):
            values[name] = sigma * math.sqrt(WHITE_SHARE if likelihood.processes else 1.0)
        elif name.startswith("gauge_colour"):
            values[name] = sigma * math.sqrt((1 - WHITE_SHARE) / len(likelihood.processes))
    beside = maximise(likelihood, likelihood.coordinates(values), fixed=problem.names, close=SEARCH_TOLERANCE)  # noise and field
    white = float(np.mean(np.concatenate([f.white for f in beside.point.runs]) ** 2))
    fit = StateSpaceFit(likelihood, maximise(likelihood, beside.point.x, close=SEARCH_TOLERANCE))
    judged = search._assessed(hypothesis, fit)
    evidence = judged.separate_field_evidence + (judged.shared or 0.0)
    return hypothesis.name, evidence, fit.log_likelihood, white, search.experiment.runs is search.whole.runs


def wrong(answer: Answer, concealed: dict[str, Any]) -> bool:
    """Return whether registered effects are concealed that the answer does not name, with their run."""
    if concealed["kind"] in ("none", "outside"):
        return False
    right = answer.verdict == "identified" and set(answer.effects) == set(concealed["effects"])
    return not (right and answer.run == (concealed.get("only") or ""))


def main() -> None:
    """Print a line for each case, and how many of each outcome there are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trial", type=Path)
    parser.add_argument("cases", nargs="*")
    asked = parser.parse_args()
    truths = unseal(asked.trial / "bank", asked.trial / "truths.json")
    answers = read_answers(asked.trial / "answers.jsonl")
    cases = asked.cases or [case for case, a in sorted(answers.items()) if wrong(a, truths[case])]
    report = Report(f"at_the_truth_{truths[cases[0]]['seed'][0]}", __doc__ or "")
    rows: list[tuple[str, ...]] = []
    counted: Counter[str] = Counter()
    for case in cases:
        answer = answers[case]
        try:
            name, evidence, height, white, whole = fitted(asked.trial / "bank" / case, truths[case])
        except SrfError as error:
            rows.append((case, "+".join(truths[case]["effects"]), answer.verdict, "", "", "", error.message))
            continue
        best = max(answer.tried.values(), key=lambda t: t["evidence"])
        more, higher = evidence - best["evidence"], height - best["log_likelihood"]
        outcome = MISSED if more > LOG_BAYES_MARGIN else LESS if more < -LOG_BAYES_MARGIN else UNTOLD
        counted[outcome] += whole
        told = (f"{higher:.1f}", f"{more:.1f}", outcome) if whole else ("", "", "the search saw a part of the readings")
        rows.append((case, name, answer.verdict, f"{white:.2f}", *told))
    report.table(("case", "model of the truth", "answered", "white", "likelihood", "evidence", "outcome"), rows)
    report.say("# " + ", ".join(f"{number} {outcome}" for outcome, number in sorted(counted.items())))


if __name__ == "__main__":
    main()
