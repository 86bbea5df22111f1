"""Effects written into laws say what the effects said; what laws cannot say stays beside them; the experiment reads back."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy as sp
import tomli
from recording_cases import write

from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.data.values import Experiment, FitParameter, ModelChoice
from srfcli.diagnosis.augment import Augmented, MergedLaws, augment, law_files, merge
from srfcli.diagnosis.hypotheses import Hypothesis
from srfcli.laws.registry import load_registry
from srfcli.laws.values import Effect
from srfcli.symbolic.equations import equations_of
from srfcli.symbolic.system import build_system

REGISTRY = load_registry(user=False, entry_points=False)
PMMA = ModelChoice("srf-vsat", "dieterich", "elastic", True)
ROCK = ModelChoice("dieterich-ruina", "dieterich", "rigid", False)


def effects(*names: str) -> list[Effect]:
    found = [REGISTRY.get("effect", name) for name in names]
    return [e for e in found if isinstance(e, Effect)]


def merged(choice: ModelChoice, names: tuple[str, ...], folder: Path, values: dict[str, float] | None = None) -> MergedLaws:
    laws = merge(REGISTRY, choice, effects(*names))
    for name, text in law_files(laws, values or {}).items():
        (folder / name).write_text(text, encoding="utf-8")
    return laws


def rates(names: dict[str, Any]) -> tuple[dict[str, sp.Expr], dict[str, float]]:
    """Return the rates by unknown, and the parameters' defaults in um, s, N."""
    system = build_system(REGISTRY, **names)
    eq = equations_of(system)
    return dict(zip(eq.names, eq.rates, strict=True)), {p.name: p.default for p in system.parameters}


@pytest.mark.parametrize(
    ("choice", "names"),
    [
        (PMMA, ("linker-dieterich",)),
        (PMMA, ("slip-evolution",)),
        (PMMA, ("stiffness-exponent",)),
        (PMMA, ("log-log-coupling",)),
        (PMMA, ("viscous-drag",)),
        (PMMA, ("second-state",)),
        (PMMA, ("linker-dieterich", "viscous-drag")),
        (replace(PMMA, ageing="dieterich+linker-dieterich"), ("slip-evolution",)),
        (ROCK, ("age-saturation",)),
        (replace(ROCK, inertia=True), ("interface-compliance", "linker-dieterich")),
    ],
    ids=lambda v: "+".join(v) if isinstance(v, tuple) else v.law,
)
def test_law_files_say_what_the_effects_said(choice: ModelChoice, names: tuple[str, ...], tmp_path: Path) -> None:
    laws = merged(choice, names, tmp_path)
    assert laws.left == ()
    settings = dict(s for e in effects(*names) for s in e.settings)
    chosen = {"law": choice.law, "ageing": choice.ageing, "interface": choice.interface, "inertia": choice.inertia}
    one, values = rates({**chosen, "effects": names})
    files = {k: str(tmp_path / f"{f}.toml") for k, f in (("law", "friction"), ("ageing", "ageing"), ("interface", "interface"))}
    two, defaults = rates({"inertia": settings.get("inertia", choice.inertia), **files})
    assert set(one) == set(two)
    own = {p.name: p.default for e in effects(*names) for p in e.parameters if p.name != "lambda"}
    assert {n: defaults[n] for n in own} == pytest.approx(own)
    rng = np.random.default_rng(4)
    symbols = sorted({s for e in (*one.values(), *two.values()) for s in e.free_symbols}, key=str)
    at = {s: values.get(str(s), 0.0) or float(rng.uniform(0.3, 3.0)) for s in symbols}
    at |= {s: float(rng.uniform(0.3, 3.0)) for s in symbols if str(s) in ("v", "phi", "phi2", "u", "z", "W", "W_dot", "V")}
    for name in one:
        a, b = (float(sp.N(e.subs(at))) for e in (one[name], two[name]))
        assert b == pytest.approx(a, rel=1e-10), name


@pytest.mark.parametrize(
    ("choice", "names", "left"),
    [
        (PMMA, ("adhesion-offset",), ("adhesion-offset",)),
        (PMMA, ("load-transmission",), ("load-transmission",)),
        (PMMA, ("track-topography", "viscous-drag"), ("track-topography",)),
        (PMMA, ("adhesion-offset", "viscous-drag"), ("adhesion-offset", "viscous-drag")),  # a product and a sum
        (PMMA, ("linker-dieterich", "second-state"), ("second-state",)),  # whose age the load does not change
        (replace(PMMA, ageing="ruina"), ("second-state",), ("second-state",)),
        (PMMA, ("sensor-lag", "linker-dieterich"), ("sensor-lag",)),
        (PMMA, ("stiffness-error",), ()),
    ],
)  # fmt: skip
def test_what_laws_cannot_say_stays_beside_them(choice: ModelChoice, names: tuple[str, ...], left: tuple[str, ...]) -> None:
    assert tuple(e.name for e in merge(REGISTRY, choice, effects(*names)).left) == left


def test_law_files_have_the_fitted_values_within_the_laws_bounds(tmp_path: Path) -> None:
    merged(PMMA, ("linker-dieterich",), tmp_path, {"A": 0.0131, "B": 1.5, "alpha": 0.02})
    law = REGISTRY.get("friction", str(tmp_path / "friction.toml"))
    defaults = {p.name: p.default for p in law.parameters}
    assert (defaults["A"], defaults["B"], defaults["D0"]) == (0.0131, 1.0, 0.402)
    assert law.name == "srf-vsat-fitted"
    assert REGISTRY.get("ageing", str(tmp_path / "ageing.toml")).name == "dieterich-augmented"


@pytest.fixture
def experiment(tmp_path: Path) -> Experiment:
    folder = tmp_path / "recorded"
    folder.mkdir()
    return read_experiment(write(folder), registry=REGISTRY)


def fitted(experiment: Experiment, **values: tuple[float, float, float, str]) -> Any:
    """Return what `augment` looks at of a fit."""
    listed = tuple(FitParameter(n, *v[:3], False, v[3]) for n, v in values.items())
    kept = tuple(q for q in experiment.parameters if q.name not in values)
    return SimpleNamespace(
        likelihood=SimpleNamespace(problem=SimpleNamespace(experiment=replace(experiment, parameters=(*kept, *listed)))),
        values={n: v[0] for n, v in values.items()},
    )


def written(experiment: Experiment, names: tuple[str, ...], fit: Any, folder: Path) -> tuple[Experiment, Any]:
    found = augment(REGISTRY, experiment, Hypothesis(tuple(effects(*names))), fit, folder=folder)
    return placed(found, folder), found


def placed(found: Augmented, folder: Path) -> Experiment:
    folder.mkdir()
    for name, text in found.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    for name, path in found.copies.items():
        (folder / name).write_bytes(path.read_bytes())
    return read_experiment(folder, registry=REGISTRY)


def test_the_recordings_are_the_same(experiment: Experiment, tmp_path: Path) -> None:
    fit = fitted(experiment, A=(0.0133, 0.006, 0.03, "1"), alpha=(0.02, -0.5, 1.0, "1"))
    again, _ = written(experiment, ("linker-dieterich",), fit, tmp_path / "new")
    for one, two in zip(experiment.runs, again.runs, strict=True):
        assert (one.name, one.holdout, one.modulation) == (two.name, two.holdout, two.modulation)
        for a, b in ((one.t, two.t), (one.observed, two.observed), (one.load(one.t)[0], two.load(two.t)[0])):
            np.testing.assert_array_equal(a, b)
    values = {q.name: (q.value, q.fixed) for q in again.parameters}
    assert values == {"A": (0.0133, False), "alpha": (0.02, False), "V0": (1.0, True)}
    assert again.choice.effects == () and again.choice.inertia


def test_what_varies_goes_along(experiment: Experiment, tmp_path: Path) -> None:
    varied = replace(experiment, vary={"A": "load", "noise": "run"}, by="load", trend="time")
    fit = fitted(varied, A=(0.0133, 0.006, 0.03, "1"))
    again, _ = written(varied, (), fit, tmp_path / "new")
    assert (again.vary, again.by, again.trend) == ({"A": "load", "noise": "run"}, "load", "time")


def test_stiffness_and_mass_go_into_the_apparatus(experiment: Experiment, tmp_path: Path) -> None:
    fit = fitted(experiment, K=(0.25, 0.04, 1.0, "N/um"), M=(3e-6, 1e-9, 1e-4, "kg"))
    again, found = written(experiment, ("stiffness-error",), fit, tmp_path / "new")
    assert again.stiffness_text == "0.25 N/um" and again.runs[0].stiffness == 0.25
    assert again.mass == pytest.approx(3e-6) and again.notices == ()
    assert found.system == ("--K", "0.25 N/um", "--M", "3 kg")


def test_effects_beside_the_laws_keep_names_that_read_back(experiment: Experiment, tmp_path: Path) -> None:
    names = ("slip-evolution", "tangential-crosstalk")  # both have a share
    fit = fitted(
        experiment, slip_evolution_share=(0.2, -0.5, 1.5, "1"), tangential_crosstalk_share=(0.01, -0.5, 0.5, "1")
    )  # fmt: skip
    again, found = written(experiment, names, fit, tmp_path / "new")
    assert found.left == again.choice.effects == ("tangential-crosstalk",)
    assert found.options("here").endswith("--K '0.21 N/um' --M '2.37 kg' --effect tangential-crosstalk --set share=0.01")
    assert {q.name: q.value for q in again.parameters if "share" in q.name} == {"slip_evolution_share": 0.2, "share": 0.01}


def test_an_effect_of_ones_own_goes_along(experiment: Experiment, tmp_path: Path) -> None:
    own = tmp_path / "plugins"
    own.mkdir()
    (own / "dust.toml").write_text(
        'format = "srf-law/1"\nkind = "effect"\nname = "dust"\nmu = "mu + d*slip"\nconstitutive = false\n\n'
        '[parameters]\nd = { default = 1e-4, neutral = 0.0, unit = "1/um", bounds = [-1.0, 1.0] }\n'
    )
    registry = load_registry([own], user=False, entry_points=False)
    effect = registry.get("effect", "dust")
    assert isinstance(effect, Effect)
    found = augment(
        registry, experiment, Hypothesis((effect,)), fitted(experiment, d=(1e-3, -1.0, 1.0, "1/um")), folder=tmp_path / "new"
    )
    (tmp_path / "new").mkdir()
    for name, text in found.files.items():
        (tmp_path / "new" / name).write_text(text)
    for name, path in found.copies.items():
        (tmp_path / "new" / name).write_bytes(path.read_bytes())
    again = read_experiment(tmp_path / "new", registry=REGISTRY)  # which has never heard of dust
    assert [Path(e).name for e in again.choice.effects] == ["effect-dust.toml"]


def test_large_recordings_are_named_where_they_are(experiment: Experiment, tmp_path: Path) -> None:
    (recording,) = tmp_path.glob("recorded/one.csv")
    size = recording.stat().st_size
    os.truncate(recording, 2**29)  # half a gigabyte of nothing, which takes no room
    found = augment(REGISTRY, experiment, Hypothesis(), fitted(experiment), folder=tmp_path / "new")
    os.truncate(recording, size)
    again = placed(found, tmp_path / "new")
    assert found.copies == {} and "../recorded/" in found.files["experiment.toml"]
    assert [r.t.size for r in again.runs] == [r.t.size for r in experiment.runs]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('effects = "linker-dieterich"', "a list of effects"),
        ('effects = ["linker-dietrich"]', "unknown effect law 'linker-dietrich'"),
        ('effects = ["viscous-drag", "viscous-drag"]', "named twice"),
        ('effects = ["stiffness-error"]', "only replaces"),
    ],
)
def test_a_breach_in_the_list_of_effects_is_told(experiment: Experiment, line: str, message: str) -> None:
    text = experiment.path.read_text().replace("inertia = true", f"inertia = true\n{line}")
    experiment.path.write_text(text)
    with pytest.raises(SrfError, match="line 1") as caught:
        read_experiment(experiment.path, registry=REGISTRY)
    assert message in caught.value.message and caught.value.hint


def test_bounds_of_a_search_are_no_bounds_of_a_law() -> None:
    """Bounds that follow a recording may be widened in [parameters] of the augmented experiment."""
    laws = merge(REGISTRY, ROCK, effects("second-state"))
    stated = tomli.loads(law_files(laws, {})["friction.toml"])["parameters"]["D2"]
    assert "upper" not in stated and 0 < stated["lower"] < 1e-3
