"""`srf diagnose` as a user meets it: verdict, folder, the augmented model in other commands, and held-out runs unopened."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli
from commands import srf

import srfcli
from srfcli.core.errors import SrfError
from srfcli.diagnosis.verdict import PROB_UNREGISTERED_IF_PASSED
from srfcli.results.diagnosis import prediction_names

Ended = Callable[..., tuple[int, str, str]]
ALPHA = 0.03
TOML = """format = "srf-experiment/1"
title = "made"

[apparatus]
stiffness = "1.0 N/um"

[model]
law = "srf-vsat"
ageing = "dieterich"
interface = "elastic"
effects = ["linker-dieterich"]

[parameters]
mu0 = { value = 0.33, lower = 0.2, upper = 0.5 }
A = { value = 0.0126, lower = 0.006, upper = 0.03 }
B = { value = 0.0241, lower = 0.01, upper = 0.06 }
D0 = { value = 0.402, lower = 0.1, upper = 1.5 }
alpha = { value = 0.03, fixed = true }
"""
RUNS = {
    "steps": ([(1.0, 5.0), (1.0, 20.0), (1.0, 10.0)], 5.0, 5.0, False),
    "loadstep": ([(3.0, 10.0)], 5.0, 6.5, False),
    "held out": ([(1.0, 15.0), (2.0, 8.0)], 7.0, 5.5, True),
}
EFFECTS = ("--effect", "linker-dieterich", "--effect", "tangential-crosstalk")
KEYS = {
    "schema", "verdict", "effects", "equivalent", "not_identifiable", "confidence", "baseline", "augmented", "location",
    "model",
}  # fmt: skip


def make(folder: Path) -> Path:
    """Write a simulated experiment in which a change of load changes the age, and whose model says nothing of it."""
    base = folder / "base"
    base.mkdir()
    text, t = TOML, np.arange(0, 3.0, 0.01)
    for name, (drive, before, after, holdout) in RUNS.items():
        steps = ", ".join(f"{{ duration = {d}, velocity = {V} }}" for d, V in drive)
        text += f'\n[[runs]]\nname = "{name}"\nfile = "{name}.csv"\nholdout = {str(holdout).lower()}\ndrive = [{steps}]\n'
        W = before + (after - before) * (1 + np.tanh((t - 1.5) / 0.05)) / 2
        rows = [f"{a!r},{b!r},{float(0.45 * b + 1e-3 * np.sin(7 * a))!r}" for a, b in zip(t.tolist(), W.tolist(), strict=True)]
        (base / f"{name}.csv").write_text("\n".join(["time [s],normal_load [N],elongation [um]", *rows]) + "\n")
    (base / "experiment.toml").write_text(text)
    srf("simulate", base, "--out-dir", folder / "made", "--noise", 0.003, "--quantum", 0.001, "--seed", 3)
    description = folder / "made" / "experiment.toml"
    lines = [x for x in description.read_text().splitlines() if not x.startswith(("effects", "alpha"))]
    description.write_text("\n".join(lines).replace("value = 0.0126,", "value = 0.0135,") + "\n")
    return folder / "made"


@pytest.fixture(scope="module")
def clean() -> Iterator[pytest.MonkeyPatch]:
    """No settings of the caller; only the cache of generated code is shared."""
    with pytest.MonkeyPatch.context() as patch:
        for name in [n for n in os.environ if n.startswith("SRF_") and n not in ("SRF_CACHE", "SRF_SHARED")]:
            patch.delenv(name)
        patch.setenv("XDG_DATA_HOME", "/nonexistent")
        yield patch


@pytest.fixture(scope="module")
def experiment(clean: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The experiment."""
    return make(tmp_path_factory.mktemp("diagnose"))


@pytest.fixture(scope="module")
def printed(experiment: Path, without_figures: None) -> str:
    """What is printed by a run that also writes the folder `found` beside the experiment."""
    return srf("diagnose", experiment, *EFFECTS, "--seed", 0, "--out", experiment.parent / "found").stdout


@pytest.fixture(scope="module")
def found(experiment: Path, printed: str) -> dict[str, Any]:
    """The answer of that run."""
    answer: dict[str, Any] = json.loads((experiment.parent / "found" / "answer.json").read_text())
    return answer


@pytest.fixture
def folder(experiment: Path, found: dict[str, Any]) -> Path:
    """The folder that was written."""
    return experiment.parent / "found"


def test_the_concealed_effect_is_named_with_its_size(found: dict[str, Any]) -> None:
    assert (found["verdict"], found["effects"]) == ("identified", ["linker-dieterich"])
    alpha = found["augmented"]["parameters"]["alpha"]
    assert abs(alpha["value"] - ALPHA) < 4 * alpha["stderr"] < 0.3 * ALPHA
    assert found["confidence"]["linker-dieterich"] == pytest.approx(1 - PROB_UNREGISTERED_IF_PASSED, abs=0.01)
    # something else may look like it
    assert found["confidence"]["unknown"] == pytest.approx(PROB_UNREGISTERED_IF_PASSED, rel=0.05)
    assert sum(found["confidence"].values()) == pytest.approx(1)


def test_the_answer_has_the_form_of_the_format(found: dict[str, Any]) -> None:
    assert found["schema"] == "srf.diagnose/1"
    assert set(found) >= KEYS and set(found) - KEYS <= {"reasons"}
    for side in ("baseline", "augmented"):
        assert set(found[side]) == {"parameters", "fit", "holdout", "field"}
        assert all({"value", "stderr"} <= set(p) and p["stderr"] > 0 for p in found[side]["parameters"].values())
    assert set(found["location"]) == {"runs", "forcing_phase", "frequencies_hz", "coordinate"}
    assert "alpha" not in found["baseline"]["parameters"]


@pytest.mark.parametrize("runs", ["fit", "holdout"])
def test_the_misfit_is_gone_in_the_augmented_model(found: dict[str, Any], runs: str) -> None:
    assert found["baseline"][runs]["rms_over_noise"] > 1.1
    assert found["augmented"][runs]["rms_over_noise"] == pytest.approx(1.0, abs=0.08)


def test_the_misfit_is_where_the_load_changes(found: dict[str, Any]) -> None:
    (first, *_) = found["location"]["runs"]
    assert first["name"] == "loadstep" and first["share"] > 0.7 and first["p_value"] < 1e-6
    assert all(a < 2.2 and b > 1.2 for a, b in first["windows"])


def test_the_same_is_in_the_folder(found: dict[str, Any], folder: Path) -> None:
    sidecar = json.loads((folder / "answer.json.provenance.json").read_text())
    assert len(sidecar["inputs"]) == 4 and all(sidecar["inputs"].values())
    assert (folder / found["model"]).is_file() and not list(folder.parent.glob(".*.part"))


@pytest.mark.parametrize("run", list(RUNS))
def test_predictions_are_written_for_every_run(found: dict[str, Any], folder: Path, run: str) -> None:
    file = folder / f"prediction-{run}.csv"
    assert file.read_text().splitlines()[0] == "time [s],observed [um],baseline [um],augmented [um]"
    t, observed, baseline, augmented = np.genfromtxt(file, delimiter=",", skip_header=1).T
    assert t.size == 300 and np.isfinite(baseline).all()
    better, worse = np.nanstd(observed - augmented), np.nanstd(observed - baseline)
    assert better == pytest.approx(0.003, rel=0.12)
    assert worse > better * (1.0 if run == "steps" else 1.05)


def test_the_augmented_experiment_has_laws_that_say_it(folder: Path) -> None:
    described = tomli.loads((folder / "augmented" / "experiment.toml").read_text())
    assert described["model"]["ageing"] == "ageing.toml" and "effects" not in described["model"]
    assert described["parameters"]["alpha"]["value"] == pytest.approx(ALPHA, rel=0.1)
    law = tomli.loads((folder / "augmented" / "ageing.toml").read_text())
    assert "W_dot" in law["rate"] and law["parameters"]["alpha"]["default"] == described["parameters"]["alpha"]["value"]
    assert [r["holdout"] for r in described["runs"]] == [False, False, True]


def test_other_commands_accept_the_augmented_experiment(found: dict[str, Any], folder: Path) -> None:
    shown = json.loads(srf("fit", folder / "augmented", "--json").stdout)
    rows = {r["parameter"]: r for r in shown["rows"]}
    for name, value in found["augmented"]["parameters"].items():
        assert abs(rows[name]["value"] - value["value"]) < 0.5 * value["stderr"], name
    assert srf("check", folder / "augmented", "--no-simulate", "--csv").stdout.count("\n") == 4
    assert srf("simulate", folder / "augmented", "--run", "loadstep", "--csv").stdout.count("\n") == 301


def test_a_reader_gets_a_sentence_tables_and_what_to_type_next(folder: Path, found: dict[str, Any], printed: str) -> None:
    text = printed
    assert text.startswith("identified: linker-dieterich\n")
    for word in ("hypotheses", "parameters", "runs", "held out", "alpha", "rms over noise"):
        assert word in text
    for parameter in found["augmented"]["parameters"].values():
        assert f"{parameter['value']:.12g}" in text
    (command,) = re.findall(r"^Its stability: srf (linear --law .*)$", text, re.M)
    words = shlex.split(command)
    assert words[words.index("--K") + 1] == f"{srfcli.read_experiment(folder / 'augmented').stiffness:.6g} N/um"
    rows = json.loads(srf(*words, "--over", "V=5:20:2", "--json").stdout)["rows"]
    assert all(r["status"] == "ok" for r in rows)
    plain = json.loads(srf("linear", "--K", 1.0, "--over", "V=5:20:2", "--json").stdout)["rows"]
    assert rows[0]["W0"] == pytest.approx(plain[0]["W0"], rel=0.1)  # the same physics under constant load, fitted numbers


def test_a_diagnosis_is_replaced_on_demand_only_and_nothing_else_ever(folder: Path, experiment: Path, tmp_path: Path) -> None:
    assert "--force" in srf("diagnose", experiment, "--out", folder, code=2).stderr
    strange = tmp_path / "mine"
    strange.mkdir()
    (strange / "thesis.tex").write_text("x")
    for force in ([], ["--force"]):
        assert "something else" in srf("diagnose", experiment, "--out", strange, *force, code=2).stderr
    assert "not exist" in srf("diagnose", experiment, "--out", tmp_path / "a" / "b", code=2).stderr
    assert (strange / "thesis.tex").read_text() == "x"


def test_an_unknown_effect_is_told_before_anything_is_fitted(experiment: Path) -> None:
    done = srf("diagnose", experiment, "--effect", "linker-dietrich", code=2)
    assert "unknown effect 'linker-dietrich'" in done.stderr and "linker-dieterich" in done.stderr


def test_where_every_run_is_held_out_there_is_nothing_to_fit(experiment: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(experiment, copy)
    text = (copy / "experiment.toml").read_text()
    (copy / "experiment.toml").write_text(text.replace("holdout = false", "holdout = true"))
    assert "every run is held out" in srf("diagnose", copy, code=2).stderr


def test_held_out_files_are_opened_when_the_models_are_final(experiment: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(experiment, copy)
    description = tomli.loads((copy / "experiment.toml").read_text())
    (held,) = (r["file"] for r in description["runs"] if r["holdout"])
    (copy / held).unlink()
    told: list[str] = []
    with pytest.raises(SrfError, match=held):
        srfcli.diagnose(copy, effects=EFFECTS[1::2], progress=lambda text, share: told.append(text))
    fitted = [text.partition(": log evidence")[0] for text in told if ": log evidence" in text]
    assert told[-1] == "held-out runs" and {"none", "linker-dieterich"} <= set(fitted)


@pytest.mark.usefixtures("without_matplotlib")
def test_interrupted_it_keeps_what_it_has(experiment: Path, srf_ended_at: Ended, tmp_path: Path) -> None:
    code, out, _ = srf_ended_at("linker-dieterich", "diagnose", experiment, *EFFECTS, "--json", "--out", tmp_path / "out")
    found = json.loads(out)
    assert code == 130 and found["status"] == "interrupted" and found["effects"] == []
    assert (tmp_path / "out" / "augmented" / "experiment.toml").is_file()


def test_interrupted_before_there_is_anything_it_writes_nothing(experiment: Path, srf_ended_at: Ended, tmp_path: Path) -> None:
    code, out, err = srf_ended_at("baseline", "diagnose", experiment, "--json", "--out", tmp_path / "out")
    assert (code, out) == (130, "") and "before the baseline was fitted" in err and not (tmp_path / "out").exists()


@pytest.mark.usefixtures("without_matplotlib")
def test_where_nothing_is_missing_the_augmented_model_is_the_baseline(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    found = json.loads(srf("diagnose", folder / "augmented", "--effect", "tangential-crosstalk", "--json", "--out", out).stdout)
    assert json.loads((out / "answer.json").read_text()) == found  # as it is printed
    assert found["verdict"] in ("none", "inconclusive") and found["effects"] == []
    assert found["augmented"] == found["baseline"] and found["location"]["runs"] == []
    described = tomli.loads((out / "augmented" / "experiment.toml").read_text())
    free = {name for name, entry in described["parameters"].items() if not entry.get("fixed")}
    assert free == set(found["baseline"]["parameters"])


def test_names_of_prediction_files_do_not_clash() -> None:
    assert prediction_names(["a/b", "a-b", "A-B", "..", "run 1"]) == [
        "prediction-a-b.csv", "prediction-a-b-2.csv", "prediction-A-B-3.csv", "prediction-run.csv", "prediction-run 1.csv",
    ]  # fmt: skip


def test_a_law_that_became_another_leaves_it_the_confidence(tmp_path: Path) -> None:
    """`kato-tullis` far above its cut-off velocity is `ruina`; and a result says its verdict first wherever it is shown."""
    rock = ("--law", "dieterich-ruina", "--interface", "rigid", "--no-inertia", "--K", "30 MPa/mm", "--W0", 10)
    rock += ("--set", "mu0=0.6", "--set", "A=0.008", "--set", "B=0.011", "--set", "D0=10")
    made = ("--drive", "30:3,15:30,30:3", "--rate", 10, "--noise", 0.002, "--seed", 1, "--free", "mu0,A,B,D0")
    srf("simulate", *rock, "--ageing", "ruina", *made, "--observe", "force", "--out-dir", tmp_path / "made")
    description = tmp_path / "made" / "experiment.toml"
    description.write_text(description.read_text().replace('ageing = "ruina"', 'ageing = "dieterich"'))
    found = srfcli.diagnose(tmp_path / "made", effects=["ruina", "kato-tullis"])
    assert (found.verdict, found.effects) == ("identified", ("ruina",))
    assert found.confidence["kato-tullis"] == 0.0 and found.confidence["ruina"] > 0.8
    assert sum(found.confidence.values()) == pytest.approx(1.0)
    assert [row[0] for row in found.table.rows] == ["ruina", "kato-tullis", "none"]
    assert str(found).startswith("identified: the ageing law is ruina, not dieterich\n")
    assert repr(found) == "<DiagnosisResult: identified: the ageing law is ruina, not dieterich; ok>"
    assert found._repr_html_().startswith("<p>identified: the ageing law is ruina, not dieterich</p>")
