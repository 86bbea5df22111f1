"""The augmented model as an experiment that every other command accepts: fitted laws, effects, the same recordings."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from srfcli.diagnosis.candidates import Hypothesis
from srfcli.diagnosis.foldlaws import Folded, fold, law_files
from srfcli.inference.latent import LatentFit
from srfcli.laws import Effect
from srfcli.recording.node import open_node
from srfcli.recording.values import Experiment, FitParameter
from srfcli.recording.writing import DESCRIPTION, KILOGRAM, shortest
from srfcli.registry import Registry, bundled_folder
from srfcli.system import apart
from srfcli.units import find_unit, split_quantity

LARGEST = 256 * 2**20  # bytes of recordings that are copied; larger ones stay where they are, and are named from there
LAWS = ("friction", "ageing", "interface")


@dataclass(frozen=True)
class Augmented:
    """An experiment to be written: `files` (name -> text), `copies` (name -> data file), what `left` is beside the laws.

    `apparatus` is K in N/um (1/um where the stated one is) and M in kg, None without a mass.
    """

    files: Mapping[str, str]
    copies: Mapping[str, Path]
    left: tuple[str, ...]
    apparatus: tuple[float, float | None]


def augment(
    registry: Registry,
    experiment: Experiment,
    hypothesis: Hypothesis,
    fitted: LatentFit,
    *,
    folder: Path,
    reader: str | None = None,
) -> Augmented:
    """Return the experiment with a hypothesis' effects and a fit's values, to be written to `folder`.

    The recordings are copied, or named by their place relative to `folder` where they are large. `reader` is how every data file
    was read, if the user named one.
    """
    laws = fold(registry, experiment.choice, hypothesis.effects)
    renamed = _final_names(registry, experiment, hypothesis, laws)
    listed = [
        replace(
            q,
            name=renamed.get(q.name, q.name),
            value=float(np.clip(fitted.values.get(q.name, q.value), q.lower, q.upper)),
        )
        for q in fitted.problem.experiment.parameters
    ]
    values = {q.name: q.value for q in listed}
    stiffness, unit = split_quantity(experiment.stiffness_text, name="stiffness")
    base = "1/um" if "N" not in unit else "N/um"
    K = values.get("K", stiffness * find_unit(unit).factor)
    settings = dict(s for e in hypothesis.effects for s in e.settings)
    inertia = bool(settings.get("inertia", experiment.choice.inertia))
    mass = values.get("M", experiment.mass) if inertia else experiment.mass
    effects, sources = _beside(laws.left)
    description = open_node(experiment.path).value
    runs, copies = _runs(description["runs"], experiment.path.parent, folder, reader)
    title = experiment.title + (
        f" (augmented with {', '.join(hypothesis.reported)})" if hypothesis.effects else " (fitted)"
    )
    lines = ['format = "srf-experiment/1"', f"title = {_value(title.strip())}", "", "[apparatus]"]
    text = experiment.stiffness_text if "K" not in values else f"{shortest(K, 1.0)!r} {base}"
    lines += [f"stiffness = {_value(text)}"] + ([f'mass = "{shortest(mass, KILOGRAM)!r} kg"'] if mass else [])
    lines += ["", "[model]", *(f'{"law" if kind == "friction" else kind} = "{kind}.toml"' for kind in LAWS)]
    lines += [f"inertia = {_value(inertia)}"] + ([f"effects = {_value(list(effects))}"] if effects else [])
    lines += ["", "[parameters]", *(_parameter(q, base) for q in listed)]
    if "columns" in description:
        lines += ["", "[columns]", *(f"{_key(k)} = {_value(v)}" for k, v in description["columns"].items())]
    for run in runs:
        lines += ["", "[[runs]]", *(f"{_key(k)} = {_value(v)}" for k, v in run.items())]
    files = {DESCRIPTION: "\n".join(lines) + "\n", **law_files(laws, values)}
    files |= {name: path.read_text(encoding="utf-8") for name, path in sources.items()}
    return Augmented(files, copies, tuple(e.name for e in laws.left), (K, mass / KILOGRAM if mass else None))


def _final_names(registry: Registry, experiment: Experiment, hypothesis: Hypothesis, laws: Folded) -> dict[str, str]:
    """Return the names that parameters of effects beside the laws have now that some effects are no longer among them."""
    own = [registry.get("effect", name) for name in experiment.choice.effects]
    every = [e for e in (*own, *hypothesis.effects) if isinstance(e, Effect)]
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


def _runs(
    described: Sequence[Mapping[str, Any]], home: Path, folder: Path, reader: str | None
) -> tuple[list[dict[str, Any]], dict[str, Path]]:
    """Return the runs' tables with their files named as seen from `folder`, and what is to be copied there."""
    paths = {str(run["file"]): (home / str(run["file"])).resolve() for run in described}
    small = sum(p.stat().st_size for p in set(paths.values())) <= LARGEST
    copies: dict[str, Path] = {}
    names: dict[Path, str] = {}
    taken = {DESCRIPTION, *(f"{kind}.toml" for kind in LAWS)}
    runs = []
    for run in described:
        path = paths[str(run["file"])]
        if not small:
            names[path] = os.path.relpath(path, folder.resolve())
        elif path not in names:
            stem, suffix, number = re.sub(r"[^\w.-]+", "-", path.stem) or "run", path.suffix, 1
            name = f"{stem}{suffix}"
            while name.lower() in taken:
                number += 1
                name = f"{stem}-{number}{suffix}"
            taken.add(name.lower())
            names[path], copies[name] = name, path
        runs.append({**run, "file": names[path], **({"format": reader} if reader else {})})
    return runs, copies


def _parameter(q: FitParameter, stiffness_unit: str) -> str:
    factor = find_unit(stiffness_unit if q.name == "K" else q.unit).factor
    cells = {"value": q.value, "lower": q.lower, "upper": q.upper}
    parts = [f"{name} = {shortest(value, factor)!r}" for name, value in cells.items() if np.isfinite(value)]
    return f"{_key(q.name)} = {{ {', '.join([*parts, *(['fixed = true'] if q.fixed else [])])} }}"


def _value(value: Any) -> str:
    """Return a value as TOML, tables inline."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _value(name)
