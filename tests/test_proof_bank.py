"""Concealed cases and banks of them: folders that read back and give nothing away, seals that show tampering."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from example_protocol import NOISE, SHORT, rms

from srfcli.core.errors import SrfError
from srfcli.data.experiment import read_experiment
from srfcli.laws.registry import load_registry
from srfcli.validation.apparatus import (
    AGEING_SHARES,
    LAW_SHARES,
    NOISE_SHARES,
    PAPER,
    PROTOCOLS,
    RIG_SHARES,
    RIGS,
    WRONG_AGEING,
    Setting,
    critical_spring,
    draw_setup,
    settings,
)
from srfcli.validation.cases import (
    NAMES,
    OUTSIDE_NAMES,
    PAPER_KINDS,
    SEAL,
    WIDE_KINDS,
    check_cases,
    draw_recipe,
    draw_wide,
    make_bank,
    make_case,
    noiseless_record,
    plan_bank,
    recipe_of,
    seal,
    unseal,
)
from srfcli.validation.slider import Physics, Plan, move

LAWS = {"srf-vsat", "dieterich-ruina"}


QUICK = {"plans": (SHORT[1], replace(SHORT[0], holdout=True))}  # two short runs, one held out
SHORTEST = 2  # seed of three cases of the wide bank whose runs cost least


def contents(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# without --runslow every third, none among them
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if i % 3 else ()) for i, n in enumerate((None, *NAMES, *OUTSIDE_NAMES))]
)
def test_every_case_reads_back_and_gives_nothing_away(tmp_path, name):
    truth = make_case(tmp_path / "c", 7, **QUICK, effects=[name] if name else [], size=0.8, rough=False)
    recipe = recipe_of(truth)
    experiment = read_experiment(tmp_path / "c", registry=load_registry())
    p, baseline = recipe.physics, recipe.baseline
    assert truth["verdict"] == ("none" if not name else "identified" if name in NAMES else "unknown")
    assert (p == baseline) == (name is None)
    assert experiment.choice.law in LAWS
    assert (experiment.choice.interface == "rigid", not experiment.choice.inertia, experiment.choice.law != "srf-vsat") == (
        baseline.rigid, baseline.massless, baseline.bare,
    )  # fmt: skip
    fitted = {q.name for q in experiment.parameters if not q.fixed}
    lacking = ({"lambda"} if baseline.rigid else set()) | ({"Vsat"} if baseline.bare else set())
    assert fitted == set(PAPER.start(Physics())) - lacking
    for run, plan in zip(experiment.runs, recipe.plans, strict=True):
        assert run.used.all()
        assert {n.kind for n in run.notices} <= ({"quantisation"} if truth["gauge"]["lag1"] else set())
        assert np.allclose(run.load.rest(0.0), plan.W0)
        left = rms(run.observed - noiseless_record(RIGS[recipe.rig], recipe.acting(plan), plan)) / NOISE
        assert 0.75 < left < 1.25
    text = b" ".join(contents(tmp_path / "c").values()).decode()
    assert not [n for n in (*NAMES, *OUTSIDE_NAMES, "effect", "rough", "seed") if n != "inertia" and n in text]


def test_same_seed_same_bytes(tmp_path):
    truths = [make_case(tmp_path / n, s, kind="pair", **QUICK) for n, s in (("a", 3), ("b", 3), ("c", 4))]
    a, b, c = (contents(tmp_path / n) for n in "abc")
    assert (a, json.dumps(truths[0])) == (b, json.dumps(truths[1]))
    assert a["steps.csv"] != c["steps.csv"]


def test_recipes_draw_what_is_asked_for():
    kinds, odd = {k: 0 for k in PAPER_KINDS}, 0
    for seed in range(400):
        recipe = draw_recipe(np.random.default_rng(seed))
        count = len(recipe.effects)
        listed = all(e.listed for e in recipe.effects)
        kinds[("none", "single", "pair")[count] if listed else "outside"] += 1
        usual = not (recipe.baseline.rigid or recipe.baseline.massless or recipe.baseline.bare)
        odd += count == 0 and not usual
        assert all(0 <= s <= 1 for s in recipe.sizes)
        assert all(plan.f * plan.interval <= 1 / 8 for plan in recipe.plans)  # eight samples a period or more
    assert all(
        0.6 * share < kinds[k] / 400 < 1.5 * share
        for k, share in {"none": 0.25, "single": 0.4, "pair": 0.15, "outside": 0.2}.items()
    )
    assert odd > 4  # a rigid baseline is no proof that compliance is concealed


def test_a_slider_that_cannot_be_followed_is_drawn_again_and_in_the_end_told(tmp_path):
    lifted = Plan("lifted", ((0.6, 20.0),), 5.0, 0.004, steps=((0.2, -20.0),))  # no slider goes on where nothing presses
    assert not move(Physics(), lifted).complete
    with pytest.raises(SrfError, match="none of 8 sliders"):
        make_case(tmp_path / "c", 1, plans=(lifted,))
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"effects": ["linker"]}, "unknown effect 'linker'"),
        ({"kind": "nothing"}, "unknown kind"),
        ({"effects": ["inertia", "inertia"]}, "named twice"),
        ({"effects": ["inertia"], "size": 1.5}, "size = 1.5"),
        ({"rough": 3.0}, "rough = 3"),
    ],
)
def test_misuse_is_told(tmp_path, asked, message):
    with pytest.raises(SrfError, match=message) as caught:
        make_case(tmp_path / "c", 1, **asked)
    assert caught.value.hint
    assert not (tmp_path / "c").exists()


def test_a_plan_covers_every_effect():
    plan = [names for _, names in plan_bank(200, 5)]
    assert len(plan) == 200
    singles = [names[0] for names in plan if len(names) == 1]
    assert set(singles) == {*NAMES, *OUTSIDE_NAMES}
    counts = [singles.count(n) for n in NAMES]
    assert max(counts) - min(counts) <= 1
    assert (sum(not names for names in plan), sum(len(names) == 2 for names in plan)) == (50, 30)
    assert plan_bank(200, 5) == plan_bank(200, 5) != plan_bank(200, 6)
    assert any(a != b for a, b in pairwise(map(len, plan[:40])))  # shuffled


# ---- the wide bank


SETTINGS = (
    Setting("rock", "steps", "dieterich-ruina", "ruina", "ruina"),
    Setting("rock", "holds", "dieterich-cutoff", "kato-tullis", "kato-tullis"),
    Setting("rock", "load-steps", "two-state", "nagata", "nagata"),
    Setting("rock", "oscillation", "log-log", "dieterich", "dieterich"),
    Setting("micro", "stick-slip", "bowden-tabor", "dieterich", "dieterich"),
    Setting("micro", "load-steps", "rice-regularized", "perrin-rice-zheng", "perrin-rice-zheng"),
    Setting("paper", "steps", "srf-vsat", "ruina", "dieterich"),
)


@pytest.mark.parametrize(
    ("setting", "noise"), list(zip(SETTINGS, ("ar1", "spikes", "one run louder", "1/f", "white", "gaps", "uneven"), strict=True))
)
def test_a_case_of_the_wide_bank_reads_back(tmp_path, setting, noise):
    """The reader finds the stated laws, and what it reads is what the truth predicts, to the gauge's noise."""
    kind = "none" if setting.ageing == setting.stated else "ageing"
    choice = {"setting": setting, "noise": noise, "kind": kind, "rough": False}
    truth = make_case(tmp_path / "c", 12, **choice, bank="wide")
    recipe = recipe_of(truth)
    experiment = read_experiment(tmp_path / "c", registry=load_registry())
    choice, rig, gauge = experiment.choice, RIGS[recipe.rig], recipe.gauge
    assert (choice.law, choice.ageing, truth["protocol"], truth["noise"]) == (
        setting.law, setting.stated, setting.protocol, noise,
    )  # fmt: skip
    assert truth["effects"] == ([] if kind == "none" else ["ruina"]) and truth["kind"] == kind
    assert truth["accept"] == ([] if kind == "none" else ["slip-evolution"])
    for run, plan in zip(experiment.runs, recipe.plans, strict=True):
        made = noiseless_record(rig, recipe.acting(plan), plan) * (rig.factor if rig.observes == "force" else 1.0)
        unit = gauge.louder(plan.loud).sigma * (rig.factor if rig.observes == "force" else 1.0)
        assert run.observable == rig.observes and np.allclose(run.t, plan.times(), atol=1e-6)
        assert 0.6 < rms((run.observed - made)[run.used]) / unit < 1.5  # 1/f noise of a short run wanders
        assert rms(run.load(run.t)[0] - [plan.load()(t)[0] for t in run.t.tolist()]) < 2e-3 * plan.W0
    louder = [plan.loud for plan in recipe.plans if plan.loud > 1 and not plan.holdout]
    assert len(louder) == (noise == "one run louder")
    text = b" ".join(contents(tmp_path / "c").values()).decode()
    assert not [n for n in (*NAMES, *OUTSIDE_NAMES, "effect", "rough", "seed", "truth") if n != "inertia" and n in text]


def test_every_setting_has_a_slider_that_slides_as_its_protocol_asks():
    every = settings()
    assert {s.apparatus for s in every} == set(RIG_SHARES) and {s.protocol for s in every} == set(PROTOCOLS)
    assert {s.law for s in every} == set(LAW_SHARES) and {s.ageing for s in every} == set(AGEING_SHARES)
    assert {(s.ageing, s.stated) for s in settings(wrong_ageing=True)} == set(WRONG_AGEING)
    for k, setting in enumerate(every[::5]):
        p, plans = draw_setup(np.random.default_rng(k), setting)
        assert (p.law_name, p.ageing_name) == (setting.law, setting.ageing)
        assert all(plan.interval * plan.f <= 1 / 8 and 200 < plan.times().size < 12000 for plan in plans)
        springs = [critical_spring(p, plan) for plan in plans]
        if setting.protocol == "stick-slip":
            assert max(springs) > p.K
            if setting.apparatus == "micro":  # else rounding decides when it leaves steady sliding
                assert max(critical_spring(p, replace(plan, steps=())) for plan in plans) < p.K
        elif plans:
            assert max(springs) < p.K and sum(plan.holdout for plan in plans) == (len(plans) > 1)
        if setting.apparatus == "rock":
            assert p.massless and p.rigid and 10 <= p.D0 <= 50 and 5 <= p.Wref <= 100
            assert all(0.1 <= v <= 300 or v == 0 for plan in plans for _, v in plan.drive)
        if setting.apparatus == "micro":
            assert all(0.02 <= plan.W0 + sum(jump for _, jump in plan.steps) <= 1.4 for plan in plans)


def test_the_wide_bank_draws_what_it_says():
    recipes = [draw_wide(np.random.default_rng(seed)) for seed in range(150)]
    kinds = [r.kind for r in recipes]
    assert set(kinds) == set(WIDE_KINDS)
    assert {r.noise for r in recipes} == set(NOISE_SHARES) and {r.protocol for r in recipes} == set(PROTOCOLS)
    assert len({r.rig for r in recipes}) == 5 and len({r.baseline.law_name for r in recipes}) == len(LAW_SHARES)
    for recipe in recipes:
        names = [e.name for e in recipe.effects]
        wanted = {"none": 0, "pair": 2}.get(recipe.kind, 1)
        assert len(names) == wanted and all(e.listed for e in recipe.effects) is (recipe.kind != "outside")
        stated, true = recipe.baseline.ageing_name, recipe.physics.ageing_name
        assert ((true, stated) in WRONG_AGEING) is (recipe.kind == "ageing") and (stated == true or names == [true])
        assert bool(recipe.only) is (recipe.kind == "one-run")
        assert (recipe.physics == recipe.baseline) is (recipe.kind == "none")
    alphas = [r.physics.alpha for r in recipes if r.rig.startswith("rock") and r.physics.alpha]
    assert all(0.1 <= a <= 0.5 for a in alphas)


def test_an_effect_in_one_run_leaves_the_others_alone(tmp_path):
    setting = Setting("rock", "load-steps", "dieterich-ruina", "dieterich", "dieterich")
    choice = {"setting": setting, "noise": "white", "kind": "one-run", "effects": ["tangential-crosstalk"], "size": 1.0}
    truth = make_case(tmp_path / "c", 4, **choice, rough=False, bank="wide")
    recipe = recipe_of(truth)
    assert truth["verdict"] == "identified" and truth["accept"] == ["unknown"]
    rig, without = RIGS[recipe.rig], recipe.baseline
    moved = {
        plan.name: rms(noiseless_record(rig, recipe.acting(plan), plan) - noiseless_record(rig, without, plan))
        for plan in recipe.plans
    }
    assert truth["only"] in ("first", "second") and moved[truth["only"]] > recipe.gauge.sigma
    assert {name for name, change in moved.items() if change} == {truth["only"]}
    acts = {plan.name: recipe.acting(plan) != recipe.baseline for plan in recipe.plans}
    assert [name for name, acting_there in acts.items() if acting_there] == [truth["only"]]


def test_the_same_seed_makes_the_same_case_of_the_wide_bank(tmp_path):
    choice = {"setting": Setting("rock", "oscillation", "two-state", "ruina", "ruina"), "noise": "1/f", "kind": "single"}
    made = [make_case(tmp_path / name, 3, **choice, effects=["drive-ripple"], bank="wide") for name in "ab"]
    assert contents(tmp_path / "a") == contents(tmp_path / "b") and json.dumps(made[0]) == json.dumps(made[1])
    again = json.loads(json.dumps(made[0], allow_nan=False))
    assert recipe_of(again) == recipe_of(made[0])


def test_effects_that_go_together_nowhere_are_told(tmp_path):
    with pytest.raises(SrfError, match="no apparatus, protocol and law go with age-saturation and log-log-coupling"):
        make_case(tmp_path / "c", 1, effects=["age-saturation", "log-log-coupling"], bank="wide")
    with pytest.raises(SrfError, match="unknown bank 'wid'"):
        make_case(tmp_path / "c", 1, bank="wid")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A bank that is copied and left as it is."""
    return make_bank(tmp_path_factory.mktemp("made") / "bank", 3, SHORTEST, bank="wide")


@pytest.fixture
def bank(made, tmp_path):
    """A bank to do anything to."""
    shutil.copytree(made.folder.parent, tmp_path, dirs_exist_ok=True)
    return replace(made, folder=tmp_path / made.folder.name, apart=tmp_path / made.apart.name)


def test_a_bank_is_sealed_and_opens(bank, tmp_path):
    assert check_cases(bank.folder) == bank.cases == ("case-000", "case-001", "case-002")
    assert set(unseal(bank.folder, bank.apart)) == set(bank.cases)
    assert bank.digest in (bank.folder / SEAL).read_text()
    assert bank.apart.parent == tmp_path  # beside the cases, not among them
    public = b" ".join(contents(bank.folder).values()).decode()
    assert not [n for n in ("alpha", "physics", 'truth"', "salt", "seed") if n in public]
    again = make_bank(tmp_path / "again", 3, SHORTEST, bank="wide")
    assert contents(again.folder) == contents(bank.folder)
    assert again.apart.read_bytes() == bank.apart.read_bytes()


@pytest.mark.parametrize(("track", "rough", "own"), [("smooth", False, False), ("shared", True, False), ("rough", True, True)])
def test_a_bank_is_on_the_tracks_that_are_asked_for(tmp_path, track, rough, own):
    made = make_bank(tmp_path / "bank", 3, SHORTEST, bank="wide", track=track)
    truths = unseal(made.folder, made.apart).values()
    assert {(truth["rough"] > 0, truth["own_track"]) for truth in truths} == {(rough, own)}


@pytest.mark.slow
def test_a_bank_does_not_depend_on_its_workers(tmp_path):
    one, two = (make_bank(tmp_path / str(n), 2, 1, workers=n) for n in (1, 2))
    assert contents(one.folder) == contents(two.folder)


def _truths(bank):
    data = json.loads(bank.apart.read_text())
    data["truths"]["case-001"]["effects"] = ["inertia"]
    bank.apart.write_text(json.dumps(data))


def _salt(bank):
    data = json.loads(bank.apart.read_text())
    data["salt"] = "0" * 64
    bank.apart.write_text(json.dumps(data))


def _reading(bank):
    path = next((bank.folder / "case-001").glob("*.csv"))
    *before, digit = path.read_text().rstrip()
    path.write_text("".join(before) + ("1" if digit == "2" else "2") + "\n")


def _extra(bank):
    (bank.folder / "case-000" / "hint.txt").write_text("inertia")


def _swapped(bank):
    a, b = (bank.folder / n for n in ("case-000", "case-001"))
    a.rename(bank.folder / "x")
    b.rename(a)
    (bank.folder / "x").rename(b)


def _gone(bank):
    shutil.rmtree(bank.folder / "case-002")


def _unlisted(bank):
    data = json.loads((bank.folder / SEAL).read_text())
    del data["cases"]["case-002"]
    (bank.folder / SEAL).write_text(json.dumps(data))


def _garbled(bank):
    (bank.folder / SEAL).write_text("{")


def _foreign(bank):
    (bank.folder / SEAL).write_text("{}")


def _lost(bank):
    bank.apart.unlink()


@pytest.mark.parametrize("tamper", [_truths, _salt, _reading, _extra, _swapped, _gone, _unlisted, _garbled, _foreign, _lost])
def test_tampering_is_found(bank, tamper):
    tamper(bank)
    with pytest.raises(SrfError) as caught:
        unseal(bank.folder, bank.apart)
    assert caught.value.hint


def test_banks_are_never_overwritten_and_truths_never_among_cases(bank, tmp_path):
    with pytest.raises(SrfError, match="exists already"):
        make_bank(bank.folder, 3, 1)
    with pytest.raises(SrfError, match="exists already"):
        make_bank(tmp_path / "other", 3, 1, apart=bank.apart)
    with pytest.raises(SrfError, match="lies in the folder"):
        seal(bank.folder, {}, bank.folder / "truths.json", seed=1)
    with pytest.raises(SrfError, match="exists already"):
        make_case(bank.folder / "case-000", 1)
    with pytest.raises(SrfError, match="0 cases"):
        make_bank(tmp_path / "none", 0, 1)
