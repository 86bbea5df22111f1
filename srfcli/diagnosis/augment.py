"""The augmented model as an experiment that every other command accepts: laws with the effects merged into them.

An effect goes into a law where the law's language has what it names. What belongs to the apparatus, or names what laws do not
know (position, time, the load in a friction coefficient), stays an effect beside the laws.
"""

from __future__ import annotations

import math
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from srfcli.core.errors import SrfError
from srfcli.core.files import toml_lines, unused_name
from srfcli.core.settings import Parameter
from srfcli.core.units import from_base
from srfcli.data.description import GEOMETRY, open_node
from srfcli.data.values import Experiment, FitParameter, ModelChoice
from srfcli.data.writing import DESCRIPTION, KILOGRAM, as_recorded, parameter_table, shortest
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.inference.state_space import StateSpaceFit
from srfcli.laws.effect_file import formula_text
from srfcli.laws.expression import parse_expression, symbol
from srfcli.laws.law_file import FORMAT, known_symbols
from srfcli.laws.registry import Registry, bundled_folder
from srfcli.laws.values import AgeingLaw, Effect, FrictionLaw, Interface, Law, State
from srfcli.symbolic.system import apart, in_a_model, without_part

# The augmented model as an experiment that every other command accepts: fitted laws, effects, the same recordings.

COPIED_BYTES = 256 * 2**20  # bytes of recordings that are copied; larger ones stay where they are, and are named from there
LAW_OPTIONS = (("--law", "friction.toml"), ("--ageing", "ageing.toml"), ("--interface", "interface.toml"))


@dataclass(frozen=True)
class Augmented:
    """An experiment to be written: `files` (name -> text), `copies` (name -> data file), what `left` is beside the laws.

    `system` are options of `srf linear` and its like for what no file of laws has: stiffness, mass, effects beside the laws.
    """

    files: Mapping[str, str]
    copies: Mapping[str, Path]
    left: tuple[str, ...]
    system: tuple[str, ...]

    def options(self, folder: Path | str) -> str:
        """Return the options by which `srf linear` and its like take the model, its files in `folder`, quoted for a shell."""
        laws = [x for flag, file in LAW_OPTIONS for x in (flag, (Path(folder) / file).as_posix())]
        return shlex.join([*laws, *self.system])


def augment(
    registry: Registry,
    experiment: Experiment,
    hypothesis: Hypothesis,
    fitted: StateSpaceFit,
    *,
    folder: Path,
    reader: str | None = None,
) -> Augmented:
    """Return the experiment with a hypothesis' effects and a fit's values, to be written to `folder`.

    The recordings are copied, or named by their place relative to `folder` where they are large. `reader` is how every data file
    was read, if the user named one.
    """
    experiment = hypothesis.experiment(experiment)
    laws = merge(registry, experiment.choice, hypothesis.effects)
    renamed = _final_names(registry, experiment, hypothesis, laws)
    listed = [
        replace(q, name=renamed.get(q.name, q.name), value=float(np.clip(fitted.values.get(q.name, q.value), q.lower, q.upper)))
        for q in fitted.likelihood.problem.experiment.parameters
    ]
    values = {q.name: q.value for q in listed}
    base = "1/um" if experiment.per_load else "N/um"
    K = values.get("K", experiment.stiffness)
    settings = dict(s for e in hypothesis.effects for s in e.settings)
    inertia = bool(settings.get("inertia", experiment.choice.inertia))
    mass = values.get("M", experiment.mass) if inertia else experiment.mass
    effects, sources = _beside(laws.left)
    description = open_node(experiment.path).value
    recorded, loads = description.get("runs", []), description.get("thresholds", [])
    parts, copies = _parts([*recorded, *loads], experiment.path.parent, folder)
    runs = [{**run, **({"format": reader} if reader else {})} for run in parts[: len(recorded)]]
    title = experiment.title + (f" (augmented with {', '.join(hypothesis.reported)})" if hypothesis.reported else " (fitted)")
    text = experiment.stiffness_text if "K" not in values else f"{shortest(K, 1.0)!r} {base}"
    rig = {key: description["apparatus"][key] for key in GEOMETRY if key in description["apparatus"]}
    rig |= {"stiffness": as_recorded(text, experiment)} | ({"mass": f"{shortest(mass, KILOGRAM)!r} kg"} if mass else {})
    model: dict[str, object] = {"law" if kind == "friction" else kind: f"{kind}.toml" for kind in KIND_OF_SLOT.values()}
    model |= {"inertia": inertia} | ({"effects": effects} if effects else {})
    vary = [name if by == experiment.by else f"{name}:{by}" for name, by in experiment.vary.items()]
    model |= {"vary": vary, "by": experiment.by} if vary else {}
    model |= {"trend": experiment.trend} if experiment.trend else {}
    lines = toml_lines({"format": "srf-experiment/1", "title": title.strip()})
    tables = [("[apparatus]", rig), ("[model]", model)]
    tables.append(("[parameters]", {q.name: parameter_table(q, base if q.name == "K" else "") for q in listed}))
    tables += [("[columns]", description["columns"])] if "columns" in description else []
    tables += [("[[runs]]", run) for run in runs] + [("[[thresholds]]", table) for table in parts[len(recorded) :]]
    for heading, table in tables:
        lines += ["", heading, *toml_lines(table)]
    files = {DESCRIPTION: "\n".join(lines) + "\n", **law_files(laws, values)}
    files |= {name: path.read_text(encoding="utf-8") for name, path in sources.items()}
    return Augmented(
        files, copies, tuple(e.name for e in laws.left), _system(experiment, K, mass if inertia else None, laws.left, listed)
    )


def _system(
    experiment: Experiment, K: float, mass: float | None, left: Sequence[Effect], listed: Sequence[FitParameter]
) -> tuple[str, ...]:
    """Return stiffness, mass and effects beside the laws as options; a stiffness in 1/um is that under the first run's load."""
    unit, load = "MPa/um" if experiment.stress else "N/um", experiment.runs[0].first_load if experiment.per_load else 1.0
    words = ["--K", f"{K * load:.6g} {unit}", *(("--M", f"{mass / KILOGRAM:.6g} kg") if mass else ("--no-inertia",))]
    beside = [named for own, named in zip(left, apart(left), strict=True) if not without_part(own)]
    own_names = {p.name for e in beside for p in e.parameters}
    words += [word for e in beside for word in ("--effect", e.name)]
    for q in listed:
        if q.name in own_names:
            words += ["--set", f"{q.name}={from_base(q.value, q.unit):.6g}" + (f" {q.unit}" if q.unit != "1" else "")]
    return tuple(words)


def _final_names(registry: Registry, experiment: Experiment, hypothesis: Hypothesis, laws: MergedLaws) -> dict[str, str]:
    """Return the names that parameters of effects beside the laws have now that some effects are no longer among them."""
    every = _effects(registry, experiment.choice, hypothesis.effects)
    fitted = {e.name: named for e, named in zip(every, apart(every), strict=True)}
    swap = {}
    for effect, named in zip(laws.left, apart(laws.left), strict=True):
        for was, now in zip(fitted[effect.name].parameters, named.parameters, strict=True):
            swap[was.name] = now.name
    return {a: b for a, b in swap.items() if a != b}


def _beside(left: Sequence[Effect]) -> tuple[tuple[str, ...], dict[str, Path]]:
    """Return how [model] names the effects, and the files of those that are not shipped, which go along."""
    names, sources = [], {}
    for effect in left:
        path = Path(effect.source)
        if effect.source and path.is_file() and bundled_folder() not in path.resolve().parents:
            file = f"effect-{effect.name}{path.suffix}"
            sources[file] = path
            names.append(file)
        else:
            names.append(effect.name)
    return tuple(names), sources


def _parts(described: Sequence[Mapping[str, Any]], home: Path, folder: Path) -> tuple[list[dict[str, Any]], dict[str, Path]]:
    """Return what is described of runs and critical loads, files named as seen from `folder`, and what is to be copied there."""
    paths = {str(run["file"]): (home / str(run["file"])).resolve() for run in described}
    small = sum(p.stat().st_size for p in set(paths.values())) <= COPIED_BYTES
    copies: dict[str, Path] = {}
    names: dict[Path, str] = {}
    taken = {DESCRIPTION, *(f"{kind}.toml" for kind in KIND_OF_SLOT.values())}
    runs = []
    for run in described:
        path = paths[str(run["file"])]
        if not small:
            names[path] = os.path.relpath(path, folder.resolve())
        elif path not in names:
            name = unused_name(re.sub(r"[^\w.-]+", "-", path.stem) or "run", path.suffix, taken)
            taken.add(name)
            names[path], copies[name] = name, path
        runs.append({**run, "file": names[path]})
    return runs, copies


# Laws with effects written into them: friction, ageing and interface files that say what a fitted model says.

KIND_OF_SLOT = {"mu": "friction", "rate": "ageing", "kappa": "interface"}


@dataclass(frozen=True)
class MergedLaws:
    """The laws with what could be written into them; `left` are the effects that stay beside them, as they are registered."""

    friction: FrictionLaw
    ageing: AgeingLaw
    interface: Interface
    left: tuple[Effect, ...] = ()
    changed: frozenset[str] = field(default=frozenset())

    def law(self, slot: str) -> Law:
        """Return the law that has a slot."""
        law: Law = getattr(self, KIND_OF_SLOT[slot])
        return law

    def formula(self, slot: str) -> sp.Expr | None:
        """Return the formula in a slot; None for a rigid interface."""
        found: sp.Expr | None = getattr(self.law(slot), slot)
        return found


def merge(registry: Registry, choice: ModelChoice, effects: Sequence[Effect]) -> MergedLaws:
    """Return the laws of `choice` with its own effects and `effects` written into them as far as that can be done exactly."""
    chosen = {key: value for e in effects for key, value in e.settings}
    base, modifiers = registry.ageing(choice.ageing)
    rate = base.rate + sum((m.term for m in modifiers), sp.S.Zero)
    ageing = replace(base, rate=rate, parameters=(*base.parameters, *(p for m in modifiers for p in m.parameters)))
    friction = registry.get("friction", choice.law)
    interface = registry.get("interface", str(chosen.get("interface", choice.interface)))
    assert isinstance(friction, FrictionLaw) and isinstance(interface, Interface)
    found = MergedLaws(friction, ageing, interface, changed=frozenset({"ageing"} if modifiers else ()))
    every = _effects(registry, choice, effects)
    pairs = [(own, named) for own, named in zip(every, apart(every), strict=True) if named.changes or named.states]
    stays: list[Effect] = []
    for own, named in sorted(pairs, key=lambda p: all(slot != "rate" for slot, _ in p[1].changes)):
        new = None if own.name in choice.effects else _merged(found, named, stays)
        if new is None:
            stays.append(named)
            found = replace(found, left=(*found.left, own))
        else:
            found = new
    order = {e.name: i for i, e in enumerate(every)}
    return replace(found, left=tuple(sorted(found.left, key=lambda e: order[e.name])))


def _effects(registry: Registry, choice: ModelChoice, more: Sequence[Effect]) -> list[Effect]:
    """Return the effects of a choice, and `more`."""
    own = (registry.get("effect", name) for name in choice.effects)
    return [*(e for e in own if isinstance(e, Effect)), *more]


def _merged(laws: MergedLaws, effect: Effect, stays: Sequence[Effect]) -> MergedLaws | None:
    """Return the laws with an effect, whose parameters have their final names; None where their language cannot say it."""
    if not effect.constitutive or len(effect.changes) != 1 or effect.observed:
        return None
    ((slot, formula),) = effect.changes
    before = laws.formula(slot) if slot in KIND_OF_SLOT else None
    if before is None or not all(_commute(slot, formula, other) for other in stays):
        return None
    states = _states(laws, effect)
    if states is None:
        return None
    law, kind = laws.law(slot), KIND_OF_SLOT[slot]
    new = formula.xreplace({symbol(slot): before})
    parameters = (*law.parameters, *(p for p in in_a_model(effect) if p.name not in {q.name for q in law.parameters}))
    every = (*laws.friction.states, *states)
    known = known_symbols(kind, (p.name for p in parameters), every)
    if not {str(s) for s in new.free_symbols} <= set(known) or not _sayable(new, known):
        return None
    common: dict[str, Any] = {"parameters": parameters, "cites": tuple(dict.fromkeys((*law.cites, *effect.cites))), "checks": ()}
    common["about"] = f"{law.about.rstrip('.')}; {effect.about[:1].lower()}{effect.about[1:]}"
    common |= {"states": every} if slot == "mu" else {}
    written: dict[str, Any] = {kind: replace(law, **{slot: new}, **common)}
    return replace(laws, **written, changed=laws.changed | {kind})


def _commute(slot: str, formula: sp.Expr, other: Effect) -> bool:
    """Return whether a formula may act before another effect's that stays beside the laws, and so acts last."""
    s = symbol(slot)
    for where, later in other.changes:
        if where == slot and sp.expand(formula.xreplace({s: later}) - later.xreplace({s: formula})) != 0:
            return False
    return True


def _states(laws: MergedLaws, effect: Effect) -> tuple[State, ...] | None:
    """Return an effect's unknowns as states of the friction law; None unless the ageing law itself rules them."""
    found = []
    names = [p.name for p in effect.parameters]
    for extra in effect.states:
        length = next((n for n in names if sp.simplify(extra.steady - symbol(n) / symbol("v")) == 0), None)
        weight = next((n for n in effect.sizes if n != length), None)
        if length is None or weight is None or not extra.logarithmic:
            return None
        swap = {symbol("phi"): symbol(extra.name), symbol("D0"): symbol(length), symbol("B"): symbol(weight)}
        if sp.simplify(laws.ageing.rate.subs(swap, simultaneous=True) - extra.rate) != 0:
            return None
        found.append(State(extra.name, length, weight))
    return tuple(found)


def _sayable(formula: sp.Expr, known: Sequence[str]) -> bool:
    """Return whether a formula, written as text, is read as the same."""
    try:
        again = parse_expression(formula_text(formula), known)
    except SrfError:
        return False
    if again == formula:
        return True
    at = {s: sp.Float(0.3 + 0.1 * i) for i, s in enumerate(sorted(formula.free_symbols, key=str))}
    one, other = (complex(e.xreplace(at).evalf()) for e in (formula, again))
    return abs(one - other) <= 1e-12 * (1 + abs(one))


def law_files(laws: MergedLaws, values: Mapping[str, float]) -> dict[str, str]:
    """Return friction.toml, ageing.toml and interface.toml; `values`, in um, s, N, are their parameters' defaults."""
    out = {}
    for slot, kind in KIND_OF_SLOT.items():
        law, formula = laws.law(slot), laws.formula(slot)
        suffix = "augmented" if kind in laws.changed else "fitted"
        head: dict[str, object] = {"format": FORMAT, "kind": kind, "name": _name(law.name, suffix)}
        head |= {"about": law.about} if law.about else {}
        head |= {"cites": law.cites} if law.cites else {}
        head |= {slot: formula_text(formula)} if formula is not None else {}
        if slot == "mu" and laws.friction.states != (State(),):
            head["states"] = [{"name": s.name, "length": s.length, "weight": s.weight} for s in laws.friction.states]
        lines = toml_lines(head)
        if law.parameters:
            lines += ["", "[parameters]", *toml_lines({p.name: _law_parameter(p, values) for p in law.parameters})]
        out[f"{kind}.toml"] = "\n".join(lines) + "\n"
    return out


def _name(name: str, suffix: str) -> str:
    stem = name.removesuffix("-augmented").removesuffix("-fitted")
    return f"{stem[:50].rstrip('-')}-{suffix}"


def _law_parameter(p: Parameter, values: Mapping[str, float]) -> dict[str, object]:
    value = from_base(values[p.name], p.unit) if p.name in values else p.default
    bounds = {key: float(x) for key, x in (("lower", p.lower), ("upper", p.upper)) if math.isfinite(x)}
    found: dict[str, object] = {"default": float(min(max(value, p.lower), p.upper)), "unit": p.unit, **bounds}
    return found | ({"about": p.about} if p.about else {})
