"""`srf fit A B C --table out.csv`: many experiments, a row each, whatever becomes of the others."""

from __future__ import annotations

import csv
import io
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import srf

import srfcli
from srfcli.tasks.recordings import fit_campaign

Ended = Callable[..., tuple[int, str, str]]
pytestmark = pytest.mark.usefixtures("empty_folder")
TRUE = {"A": 0.009, "B": 0.006, "D0": 6.0}
K, LOAD = 4e-3, 20.0  # 1/um, MPa


def experiment(name: str, *, seed: int, drift: float = 0.0) -> Path:
    """Write a velocity step of a spring slider, by Euler, as an experiment; `drift` is the change of friction with slip, 1/um."""
    rng, dt, rows = np.random.default_rng(seed), 1e-3, []
    mu, phi, x = 0.6, TRUE["D0"], 0.0
    for i in range(36_000):
        V = 1.0 if i * dt < 16.0 else 10.0
        v = math.exp((mu - 0.6 - TRUE["B"] * math.log(phi / TRUE["D0"])) / TRUE["A"])
        if i % 100 == 0:
            rows.append(f"{i * dt:.4g},{V},{LOAD * (mu + drift * x + rng.normal(0, 1e-4)):.8g},{LOAD}")
        mu, phi, x = mu + dt * K * (V - v), phi + dt * (1 - v * phi / TRUE["D0"]), x + dt * v
    Path(name).mkdir()
    (Path(name) / "a.csv").write_text("\n".join(["time [s],load_point_velocity,shear_stress,normal_stress", *rows]) + "\n")
    srf("new", f"{name}/a.csv", "--stiffness", f"{K * LOAD} MPa/um", "--out", f"{name}/experiment.toml")
    return Path(name)


def rows_of(path: Path) -> dict[str, dict[str, str]]:
    with path.open(encoding="utf-8") as stream:
        return {row["experiment"]: row for row in csv.DictReader(stream)}


def test_a_row_for_each_experiment_and_a_reason_for_those_without_a_fit() -> None:
    experiment("one", seed=1)
    experiment("drifts", seed=2, drift=4e-5)
    Path("broken").mkdir()
    Path("broken/experiment.toml").write_text("format = 3\n")
    done = srf("fit", "one", "broken", "drifts", "--table", "out.csv", "--track", "smooth", "--workers", "2", code=3)
    assert "1 of 3 experiments have no fit (broken); see `reason`" in done.stderr
    rows = rows_of(Path("out.csv"))
    assert list(rows) == ["one", "broken", "drifts"]
    assert rows["broken"]["status"] == "failed" and "broken/experiment.toml" in rows["broken"]["reason"]
    one = {key: float(value) for key, value in rows["one"].items() if key not in ("experiment", "flags", "reason") and _is(value)}
    for name, true in TRUE.items():
        assert abs(one[name] - true) < 4 * one[f"{name}_stderr"] < 0.4 * true
    # the error of A - B is that of two numbers that go together
    variance = one["A_stderr"] ** 2 + one["B_stderr"] ** 2 - 2 * one["cov_A_B"]
    assert one["A_minus_B"] == pytest.approx(one["A"] - one["B"]) and one["A_minus_B_stderr"] == pytest.approx(variance**0.5)
    assert one["A_minus_B_stderr"] < one["A_stderr"]
    assert (one["k"], rows["one"]["k_unit"], rows["one"]["k_stderr"]) == (pytest.approx(K * LOAD), "MPa/um", "")
    assert one["load"] == pytest.approx(LOAD) and one["rms_over_noise"] == pytest.approx(1.0, abs=0.15)
    # steady sliding at the end of a segment, and friction that goes on rising with slip
    assert one["segments"] == one["steady"] == 1
    assert rows["one"]["flags"] == "1 of 2 segments is too short to say whether it ends in steady sliding"
    assert float(rows["drifts"]["final_slope"]) == pytest.approx(0.04, rel=0.2)
    assert "friction still changes with slip at the end of 1 of 1 segments" in rows["drifts"]["flags"]


def test_a_fitted_stiffness_has_covariances_in_the_unit_of_k() -> None:
    experiment("one", seed=1)
    text = Path("one/experiment.toml").read_text(encoding="utf-8")
    Path("one/experiment.toml").write_text(text.replace("# K =", "K ="), encoding="utf-8")
    srf("fit", "one", "--table", "out.csv", "--track", "smooth")
    row = {key: float(value) for key, value in rows_of(Path("out.csv"))["one"].items() if _is(value)}
    found = srfcli.fit("one", track="smooth").found.fit
    place = [found.names.index(name) for name in ("D0", "K")]
    shared = found.covariance[place[0], place[1]] / np.sqrt(np.prod(np.diag(found.covariance)[place]))
    assert 0.3 < abs(shared) < 1
    assert row["cov_D0_k"] / (row["D0_stderr"] * row["k_stderr"]) == pytest.approx(shared, rel=1e-9)


def test_of_what_varies_a_row_has_the_mean_and_says_so() -> None:
    """Two runs whose B may differ: it is not left empty, and A - B is not that of a start value."""
    experiment("one", seed=1)
    text = Path("one/experiment.toml").read_text(encoding="utf-8").replace("inertia = false", 'inertia = false\nvary = ["B"]')
    run = text[text.index("[[runs]]") :]
    shutil.copy(experiment("two", seed=2) / "a.csv", "one/b.csv")
    Path("one/experiment.toml").write_text(text + run.replace('"a"', '"b"').replace("a.csv", "b.csv"), encoding="utf-8")
    srf("fit", "one", "--table", "out.csv", "--track", "smooth")
    row = rows_of(Path("out.csv"))["one"]
    A, B = float(row["A"]), float(row["B"])
    assert abs(B - TRUE["B"]) < 4 * float(row["B_stderr"]) < 0.4 * TRUE["B"]
    assert float(row["A_minus_B"]) == pytest.approx(A - B) and row["A_minus_B_stderr"] == ""
    assert "B is the mean of 2 groups" in row["flags"]
    Path("one/experiment.toml").write_text(Path("one/experiment.toml").read_text().replace('vary = ["B"]', ""))
    srf("fit", "one", "two", "--table", "asked.csv", "--track", "smooth", "--vary", "B", code=3)
    asked = rows_of(Path("asked.csv"))
    assert asked["one"]["B"] == row["B"] and "B cannot vary by run" in asked["two"]["reason"]


def test_a_load_that_nobody_knows_is_not_stated() -> None:
    table = experiment("one", seed=1) / "a.csv"
    rows = [line.split(",") for line in table.read_text().splitlines()[1:]]
    body = [f"{t},{V},{float(tau) / LOAD:.8g}" for t, V, tau, _ in rows]
    table.write_text("\n".join(["time [s],load_point_velocity,friction", *body]) + "\n")
    srf("new", "one/a.csv", "--stiffness", f"{K} 1/um", "--out", "one/experiment.toml", "--force")
    checked = next(csv.DictReader(io.StringIO(srf("check", "one", "--no-simulate", "--csv").stdout)))
    assert {checked[name] for name in ("W_mean", "W_min", "W_max")} == {""}
    drawn = srfcli.check("one", simulate=False).plot()
    srf("fit", "one", "--table", "out.csv", "--track", "smooth")
    row = rows_of(Path("out.csv"))["one"]
    assert (row["load"], row["load_unit"], row["k_unit"], len(drawn.axes)) == ("", "", "1/um", 2)
    assert float(row["k"]) == pytest.approx(K) and abs(float(row["B"]) - TRUE["B"]) < 4 * float(row["B_stderr"])


def _is(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def test_finished_rows_are_kept_when_it_is_interrupted_and_gone_on_from(srf_ended_at: Ended) -> None:
    for seed, name in enumerate(("one", "two", "three")):
        experiment(name, seed=seed)
    arguments = ("fit", "one", "two", "three", "--table", "out.csv", "--track", "smooth", "--resume", "parts")
    code, out, err = srf_ended_at("2 of 3 experiments", *arguments)
    assert code == 130 and "the rows that were done are kept" in err and "2 of 3 experiments were done" in out
    before, kept = rows_of(Path("out.csv")), {p: p.stat().st_mtime_ns for p in Path("parts").glob("part-*")}
    assert list(before) == ["one", "two"] and len(kept) == 2
    srf(*arguments)
    assert {p: p.stat().st_mtime_ns for p in kept} == kept and len(list(Path("parts").glob("part-*"))) == 3
    after = rows_of(Path("out.csv"))
    assert list(after) == ["one", "two", "three"] and {k: after[k] for k in before} == before


def test_from_python_and_what_is_refused() -> None:
    experiment("one", seed=1)
    found = fit_campaign(["one", "nowhere"], options={"track": "smooth", "free": ["A", "B", "D0"]})
    assert [row["status"] for row in found.rows] == ["ok", "failed"] and found.failed == 1
    frame = found.to_dataframe()
    assert frame["A"].notna().tolist() == [True, False] and "mu0" not in frame
    (panel,) = found.plot().axes
    assert panel.get_ylabel().startswith("A − B") and [label.get_text() for label in panel.get_xticklabels()] == ["one"]
    Path("out.csv").write_text("mine")
    srf("fit", "one", "--table", "out.csv", code=2)
    assert Path("out.csv").read_text() == "mine"
    assert "is no .csv file" in srf("fit", "one", "--table", "out.txt", code=2).stderr
    assert "--profile is for fits of one experiment" in srf("fit", "one", "one", "--profile", code=2).stderr
    assert "--workers is for fits of several experiments" in srf("fit", "one", "--workers", "2", code=2).stderr
