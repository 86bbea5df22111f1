"""`srf new`: tables as laboratories write them become experiments that `srf check` accepts and `srf fit` fits."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tomli
from click.testing import CliRunner
from commands import srf

import srfcli
from srfcli.cli.main import cli
from srfcli.data.noise import ar1

SHARED = Path(os.environ.get("SRF_SHARED", Path(__file__).resolve().parents[2] / "shared"))
B819 = SHARED / "data" / "basalt-b819-velocity-step" / "velstep4_BRAVA_expb819_basalt.txt"
P446 = SHARED / "data" / "psu-p446-20MPa" / "p446_20MPa.csv"
TRUE = {"mu0": 0.6, "A": 0.009, "B": 0.006, "D0": 12.0, "V0": 1.0}
k = 2e-3  # 1/um
SIGMA = 20.0  # MPa

pytestmark = pytest.mark.usefixtures("empty_folder")


def steps() -> dict[str, np.ndarray]:
    """Return a velocity step as a spring slider without mass makes it: d mu/dt = k (V - v), v from the friction law, by Euler."""
    dt, rng = 2e-4, np.random.default_rng(5)
    t = np.arange(0.0, 60.0, dt)
    V = np.where(t < 20.0, 1.0, 10.0)
    mu, theta = TRUE["mu0"], TRUE["D0"] / 1.0
    seen = np.empty(t.size)
    for i in range(t.size):
        v = TRUE["V0"] * math.exp((mu - TRUE["mu0"] - TRUE["B"] * math.log(TRUE["V0"] * theta / TRUE["D0"])) / TRUE["A"])
        seen[i] = mu
        mu += dt * k * (V[i].item() - v)
        theta += dt * (1 - v * theta / TRUE["D0"])
    part = slice(None, None, 500)  # 10 Hz
    friction = seen[part] + rng.normal(0.0, 1e-4, seen[part].size)
    x = np.cumsum(V) * dt
    return {"t": t[part], "V": V[part], "x": x[part], "mu": friction, "sigma": np.full(friction.size, SIGMA)}


@pytest.fixture(scope="module")
def step() -> dict[str, np.ndarray]:
    return steps()


def table(headings: Sequence[str], columns: Sequence[np.ndarray], name: str = "run1.csv", by: str = ",") -> Path:
    rows = [by.join(f"{x:.8g}" for x in row) for row in zip(*columns, strict=True)]
    path = Path(name)
    path.write_text("\n".join([by.join(headings), *rows]) + "\n", encoding="utf-8")
    return path


DEGREES = 180 / np.pi / 25e3  # of a circle of 25 mm, to a um
FORMS = {
    "brackets": (["Time(s)", "Displ(microns)", "Friction", "Normal_stress(MPa)"], (1, 1, 1, 1), "txmS", "5e-3 1/um"),
    "suffixes": (
        ["time_s", "lp_disp_mm", "shear_stress_MPa", "normal_stress_MPa"],
        (1, 1e-3, SIGMA, 1),
        "txmS",
        "40 MPa/mm",
    ),
    "kilopascal": (
        ["t", "velocity [mm/s]", "tau [kPa]", "sigma_n [kPa]"],
        (1, 1e-3, 1e3 * SIGMA, 1e3),
        "tVmS",
        "40 MPa/mm",
    ),
    "letters": (["t (min)", "v_lp (um/s)", "mu", "sigma (MPa)"], (1 / 60, 1, 1, 1), "tVmS", "2e-3 1/um"),
    "forces": (["Elapsed time", "LP Disp", "Fs [kN]", "Fn [kN]"], (1, 1, SIGMA / 1e3, 1e-3), "txmS", "40 N/mm"),
    "spring": (["time [s]", "stage_um", "u [mm]", "load [N]"], (1, 1, 0.5, 1), "txmS", "40 N/mm"),
    "words": (["Elapsed (s)", "Stroke (mm)", "Friction [uN]", "Fz [mN]"], (1, 1e-3, SIGMA * 1e6, 1e3), "txmS", "40 N/mm"),
    "rotary": (["time [s]", "Angle [deg]", "Torque [N m]", "Axial load [N]"], (1, DEGREES, SIGMA * 0.025, 1), "txmS", "40 N/mm"),
    "strain": (["time [s]", "Shear strain", "Shear traction [MPa]", "eff. normal stress [MPa]"], (1, 1 / 4000, SIGMA, 1), "txmS",
               "160 MPa"),
    "compression": (["X_Value", "lp_disp_um", "Shr_stress_MPa", "nor_stress_MPa"], (1, 1, SIGMA, -1), "txmS", "40 MPa/mm"),
    "area": (["time [s]", "Angular speed [rpm]", "Torque [mN m]", "Fn [N]"], (1, DEGREES / 6, SIGMA * 50 * 25, 50), "tVmS",
             "1250 N m/rad"),
}  # fmt: skip
SIGNS = ("+++", "-++", "++-", "-+-", "+-+", "---")  # of drive, load and force in a file


@pytest.mark.parametrize("drive", ["x", "V"])
@pytest.mark.parametrize("signs", SIGNS)
def test_what_a_rig_counts_negative_is_turned(signs: str, drive: str, step: dict[str, np.ndarray]) -> None:
    """The runs that are read are those of the same rig with all counted positive."""
    heading = {"x": "load_point_displacement [um]", "V": "load_point_velocity [um/s]"}[drive]
    read = []
    for name, some in (("plain", "+++"), ("turned", signs)):
        V, W, F = (float(f"{sign}1") for sign in some)
        Path(name).mkdir()
        columns = [step["t"], V * step[drive], W * step["sigma"], F * step["mu"] * step["sigma"]]
        table(["time [s]", heading, "normal_load [N]", "force [N]"], columns, f"{name}/a.csv")
        done = srf("new", f"{name}/a.csv", "--stiffness", "40 N/mm", "--out", name)
        assert ("the other" in done.stderr) == (some != "+++") and "stands still" not in done.stderr
        experiment = srfcli.read_experiment(name)
        assert {n.kind for n in experiment.runs[0].notices}.isdisjoint({"friction"})
        read.append((experiment.runs[0], experiment.parameters))
    (plain, values), (turned, same) = read
    assert np.allclose(turned.friction, plain.friction) and [q.value for q in same] == [q.value for q in values]
    assert np.allclose(turned.drive(plain.t), plain.drive(plain.t)) and turned.initial == plain.initial


def test_a_force_that_is_nothing_is_no_recording(step: dict[str, np.ndarray]) -> None:
    table(["time [s]", "V [um/s]", "normal_load [N]", "force [N]"], [step["t"], step["V"], step["sigma"], 0 * step["mu"]])
    done = srf("new", "run1.csv", "--stiffness", "40 N/mm", code=2)
    assert "run1.csv: column 'force [N]' is 0 throughout" in done.stderr


def test_a_drive_that_never_moves_is_a_hold(step: dict[str, np.ndarray]) -> None:
    table(["time [s]", "V [um/s]", "normal_load [N]", "force [N]"], [step["t"], 0 * step["V"], step["sigma"], step["mu"] * 20])
    done = srf("new", "run1.csv", "--stiffness", "40 N/mm")
    assert "kind of experiment: shs, as the drive of run1 does not move" in done.stderr
    assert "Smallest errors that the load allows" in srf("check", ".").stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--stiffness", "-3 N/mm"], "--stiffness: found"),
        (["--stiffness", "30 N"], "'N' measures N, not N/um"),
        (["--stiffness", "30 N/mm", "--mass", "-1"], "--mass: found"),
        (["--stiffness", "30 N/mm", "--window", "200,300"], "--window: no sample of"),
        (["--stiffness", "30 N/mm", "--radius", "25"], "--radius '25' has no unit"),
        (["--stiffness", "30 N/mm", "run1.csv"], "run1.csv is named twice"),
    ],
)
def test_a_wrong_option_is_named(options: list[str], message: str, step: dict[str, np.ndarray]) -> None:
    table(["time [s]", "V [um/s]", "normal_load [N]", "force [N]"], [step["t"], step["V"], step["sigma"], step["mu"] * 20])
    done = srf("new", "run1.csv", *options, code=2)
    assert message in done.stderr and "experiment.toml" not in done.stderr and not Path("experiment.toml").exists()


RIGS = {"rotary": ["--radius", "25 mm"], "strain": ["--thickness", "4 mm"], "area": ["--radius", "25 mm", "--area", "50 mm^2"]}


@pytest.mark.parametrize("form", FORMS)
def test_a_laboratory_s_table_becomes_an_experiment(form: str, step: dict[str, np.ndarray]) -> None:
    headings, factors, which, stiffness = FORMS[form]
    keys = {"t": "t", "x": "x", "V": "V", "m": "mu", "S": "sigma"}
    table(headings, [step[keys[c]] * f for c, f in zip(which, factors, strict=True)])
    done = srf("new", "run1.csv", "--stiffness", stiffness, *RIGS.get(form, ()))
    assert done.stdout.strip() == "experiment.toml"
    assert "steps, as the drive goes from 1 to 10 um/s" in done.stderr
    checked = srf("check", ".", "--no-simulate").stdout
    assert "1 to 10" in checked and "20" in checked
    stress = form not in ("forces", "spring", "words", "rotary")
    assert ("W [MPa]" in checked) is stress and ("W [N]" in checked) is not stress
    mu0 = tomli.loads(Path("experiment.toml").read_text())["parameters"]["mu0"]["value"]
    stiff = json.loads(srf("check", ".", "--no-simulate", "--json").stdout)["meta"]["runs"][0]["stiffness"]
    assert stiff == pytest.approx(k * SIGMA * {"brackets": 2.5}.get(form, 1.0)), form
    assert {"suffixes": "shear stress [MPa]", "forces": "force [N]", "spring": "elongation [um]"}.get(form, "run1") in checked
    assert mu0 == pytest.approx(0.605, abs=0.01)


def test_a_unit_that_no_heading_says_is_told(step: dict[str, np.ndarray]) -> None:
    """The n of sigma_n is no newton: a stress, in MPa, and that this is assumed."""
    table(["time", "lp_disp [um]", "tau", "sigma_n"], [step["t"], step["x"], step["mu"] * step["sigma"], step["sigma"]])
    done = srf("new", "run1.csv", "--stiffness", "0.06 MPa/um")
    assert "'sigma_n' is the normal stress, in MPa, which no heading says" in done.stderr
    assert "'lp_disp [um]' is the load point displacement, in um\n" in done.stderr


@pytest.mark.parametrize(
    ("headings", "options", "said", "hint"),
    [
        (["t [s]", "v [um/s]", "Torque [N m]", "Fn [N]"], (), "'Torque [N m]' is in N m: a rotary rig", "--radius '25 mm'"),
        (["t [s]", "Angle [deg]", "Fs [N]", "Fn [N]"], (), "'Angle [deg]' is in deg: a rotary rig", "--radius '25 mm'"),
        (["t [s]", "Shear strain", "Fs [N]", "Fn [N]"], (), "strains need the thickness", "--thickness"),
        (["t [s]", "v [um/s]", "Fs [N]", "Fn [N]"], ("--area", "0 mm^2"), "expected an area above 0", ""),
        (["t [s]", "v [um/s]", "Fs [N]", "Fn [N]"], ("--area", "3 mm^2", "--mass", "1 kg"), "a mass beside an area", ""),
        (["t [s]", "v [um/s]", "Upper stress [MPa]", "Lower stress [MPa]"], (), "which column is", "shear_stress=HEADING"),
        (["t [s]", "v [um/s]", "shear one [N]", "shear two [N]", "Fn [N]"], (), "which column is", "force=HEADING"),
    ],
)  # fmt: skip
def test_what_a_rig_has_to_say(headings: list[str], options: tuple[str, ...], said: str, hint: str) -> None:
    t = np.arange(0.0, 10.0, 0.1)
    table(headings, [t, 1 + t, 0.6 + 0 * t, 1 + 0 * t, 1 + 0 * t][: len(headings)])
    done = srf("new", "run1.csv", "--stiffness", "1 N/um", *options, code=2)
    assert said in done.stderr and hint in done.stderr, done.stderr


def test_a_stiffness_per_load_is_never_rescaled_in_silence(step: dict[str, np.ndarray]) -> None:
    for name, load in (("one.csv", SIGMA), ("two.csv", 2 * SIGMA)):
        table(["time_s", "v", "tau_MPa", "sigma_n_MPa"], [step["t"], step["V"], load * step["mu"], load + 0 * step["t"]], name)
    drafted = srf("new", "one.csv", "two.csv", "--stiffness", "2e-3 1/um").stderr
    said = srf("check", ".", "--no-simulate").stdout
    assert "0.04 MPa/um under 20 MPa in one" in drafted
    assert "0.04 MPa/um under 20 MPa in one, 0.08 MPa/um under 40 MPa in two; a machine's own stiffness does not grow" in said
    assert "0.04 MPa/um under 20 MPa in one" in srf("simulate", ".", "--run", "one").stdout
    row = srfcli.fit_campaign(["."], options={"track": "smooth", "free": ["mu0"]}).rows[0]
    assert "0.04 MPa/um under 20 MPa in one" in row["flags"]
    text = Path("experiment.toml").read_text().replace("# K =", "K =")
    Path("experiment.toml").write_text(text.replace('upper = "0.004 1/um"', 'upper = "0.08 MPa/um"'))
    assert "a stiffness in MPa/um beside that of [apparatus], which is in 1/um" in srf("check", ".", code=2).stderr
    Path("experiment.toml").write_text(
        text.replace('stiffness = "0.002 1/um"', 'stiffness = "0.04 MPa/um"').replace("K =", "# K =")
    )
    assert "counts for each run" not in srf("check", ".", "--no-simulate").stdout


@cache
def to_and_fro(
    *, strokes: int, K: float = 4e-4, W: float = 0.02, D0: float = 4.0, V: float = 5.0, play: float = 0.0, rate: int = 20
) -> np.ndarray:
    """Return t, x and F (3, n) of a slider on a spring that turns back every 40 s, with the law regularised.

    The spring is slack while the drive crosses its `play` (um). There are `rate` samples a second.
    """
    A, B, mu0, dt, rng = 0.012, 0.008, 0.5, 5e-4, np.random.default_rng(1)
    F, u, phi, x, out = 0.0, 0.0, D0 / V, 0.0, []
    for i in range(int(40 * strokes / dt)):
        s = 1 - 2 * (int(i * dt // 40) % 2)
        if i % (2000 // rate) == 0:
            out.append((i * dt, x, F + rng.normal(0.0, 4e-6)))
        v = 2 * V * math.exp(-(mu0 + B * math.log(V * phi / D0)) / A) * math.sinh(F / W / A)
        u, phi, x = u + dt * (s * V - v), phi + dt * (1 - abs(v) * phi / D0), x + dt * s * V
        F = K * (u - min(max(u, -play), 0.0))
    return np.array(out).T


@pytest.mark.parametrize("drive", ["Position [um]", "Distance [um]", "Speed [um/s]", ""])
def test_a_reciprocating_tribometer_becomes_a_run_for_each_stroke(drive: str) -> None:
    """The way gone and the speed are recorded without the direction, or the speed is stated: the force then tells it."""
    t, x, F = to_and_fro(strokes=2)
    moved = {"Position [um]": [x], "Distance [um]": [5.0 * t], "Speed [um/s]": [5.0 + 0 * t], "": []}[drive]
    table(["time [s]", *filter(None, [drive]), "Friction [uN]", "Normal [mN]"], [t, *moved, 1e6 * F, 20 + 0 * t])
    done = srf("new", "run1.csv", "--stiffness", "400 uN/um", *(() if drive else ("--drive", "5")))
    assert "run1 slides to and fro: 2 strokes, a run each" in done.stderr
    runs = tomli.loads(Path("experiment.toml").read_text())["runs"]
    assert [(r["name"], r.get("direction"), r["holdout"]) for r in runs] == [
        ("run1-1", None, False), ("run1-2", "backward", False),
    ]  # fmt: skip
    assert runs[0]["window"][1] == pytest.approx(40, abs=0.5)
    assert 40 < runs[1]["window"][0] < 50 and runs[1]["window"][1] == pytest.approx(80, abs=0.1)
    for run in srfcli.read_experiment(Path.cwd()).runs:
        assert run.drive(run.t) == pytest.approx(5.0, rel=1e-6) and np.median(run.observed) == pytest.approx(
            np.median(np.abs(F)), rel=0.05
        )
    # as one run it is refused, with a window and a direction that would do
    whole = Path("experiment.toml").read_text().split("[[runs]]")[0] + '[[runs]]\nname = "all"\nfile = "run1.csv"\n'
    if not drive:
        Path("experiment.toml").write_text(whole + "drive = [{ duration = 80.0, velocity = 5.0 }]\n")
        assert "the observable has both signs" in srf("check", ".", "--no-simulate").stdout
        return
    Path("experiment.toml").write_text(whole)
    said = srf("check", ".", code=2).stderr
    assert "the drive turns back before t = 47" in said and 'direction = "backward"' in said


def test_a_stroke_may_have_less_force_than_the_others() -> None:
    """A gauge with an offset reads 0.3 N one way and -0.5 N the other."""
    t = np.arange(0, 60, 0.05)
    F = np.where(t % 20 < 10, 0.3, -0.5) + np.random.default_rng(1).normal(0, 0.01, t.size)
    table(["time [s]", "Speed [um/s]", "force [N]", "load [N]"], [t, 20 + 0 * t, F, 1 + 0 * t])
    assert "run1 slides to and fro: 6 strokes" in srf("new", "run1.csv", "--stiffness", "0.1 N/um").stderr
    runs = tomli.loads(Path("experiment.toml").read_text())["runs"]
    assert [r["window"][1] for r in runs] == pytest.approx([10, 20, 30, 40, 50, 60], abs=0.5)


@pytest.mark.parametrize("play", [0.0, 40.0])
def test_the_strokes_of_a_reciprocating_tribometer_are_fitted(play: float) -> None:
    """Play of the drive is crossed before a stroke begins, whatever its size."""
    t, x, F = to_and_fro(strokes=2, play=play, rate=5)
    assert (np.abs(F) < 2e-5).sum() == pytest.approx(play / 5.0 * 5, abs=3)  # readings of a slack spring
    table(["time [s]", "Position [um]", "Friction [uN]", "Normal [mN]"], [t, x, 1e6 * F, 20 + 0 * t])
    srf("new", "run1.csv", "--stiffness", "400 uN/um")
    rows = {line.split(",")[0]: line.split(",") for line in srf("fit", ".", "--track", "smooth", "--csv").stdout.splitlines()}
    for name, true in (("A", 0.012), ("B", 0.008), ("D0", 4.0)):
        value, error = float(rows[name][1]), float(rows[name][2])
        assert abs(value - true) < 4 * error < 0.5 * true, name


def test_a_ram_that_unloads_at_the_end_slides_in_one_direction(step: dict[str, np.ndarray]) -> None:
    n = step["t"].size // 4
    x, mu = step["x"].copy(), step["mu"].copy()
    x[-n:], mu[-n:] = x[-n] - np.arange(n), np.maximum(mu[-n] - 0.02 * np.arange(n), 0.0)
    table(["time_s", "x_lp [um]", "mu"], [step["t"], x, mu])
    assert "to and fro" not in srf("new", "run1.csv", "--stiffness", "2e-3 1/um").stderr


def test_friction_alone_does_not_go_with_a_stiffness_of_stress(step: dict[str, np.ndarray]) -> None:
    table(["time_s", "v", "mu"], [step["t"], step["V"], step["mu"]])
    said = srf("new", "run1.csv", "--stiffness", "12 MPa/um", code=2).stderr
    assert "friction is recorded without a load, and the stiffness is in MPa/um" in said
    srf("new", "run1.csv", "--stiffness", "12 MPa/um", "--load", "20 MPa")


def test_the_first_fit_is_two_commands_away_and_in_the_units_of_the_recording(step: dict[str, np.ndarray]) -> None:
    table(["time_s", "velocity_um_s", "tau_MPa", "sigma_n_MPa"], [step["t"], step["V"], SIGMA * step["mu"], step["sigma"]])
    srf("new", "run1.csv", "--stiffness", f"{k * SIGMA * 1e3:g} MPa/mm")
    lines = Path("experiment.toml").read_text().replace("# K =", "K =")
    Path("experiment.toml").write_text(lines)
    done = CliRunner().invoke(cli, ["fit", ".", "--track", "smooth", "--csv", "--plot", "fit.svg"], prog_name="srf")
    rows = {line.split(",")[0]: line.split(",") for line in done.stdout.splitlines()}
    for name in ("A", "B", "D0"):
        value, error = float(rows[name][1]), float(rows[name][2])
        assert abs(value - TRUE[name]) < 4 * error, (name, value, error)
        assert error < 0.2 * TRUE[name]
    assert rows["K"][5] == "MPa/mm" and float(rows["K"][1]) == pytest.approx(k * SIGMA * 1e3, rel=0.2)
    assert "shear stress" in Path("fit.svg").read_text()  # labels are text


def test_the_draft_says_what_it_is_and_can_be_piped(step: dict[str, np.ndarray]) -> None:
    table(["t", "V", "mu", "layer thickness"], [step["t"], step["V"], step["mu"], step["x"]])
    done = srf("new", "run1.csv", "--stiffness", "2e-3 1/um", "--out", "-")
    assert "A is a, B is b, D0 is Dc" in done.stdout and not Path("experiment.toml").exists()
    assert "left aside: layer thickness" in done.stderr
    assert tomli.loads(done.stdout)["columns"]["friction"] == {"name": "mu", "unit": "1"}


def test_a_unit_that_nobody_knows_keeps_the_names_of_columns(step: dict[str, np.ndarray]) -> None:
    heat = np.full(step["t"].size, 21.5)
    path = table(["Time", "Stage", "Shear", "Normal", "Heat"], [step[c] for c in ("t", "x", "mu", "sigma")] + [heat], by="\t")
    first, rest = path.read_text().split("\n", 1)
    path.write_text(f"{first}\ns\tum\t1\tMPa\tdegC\n{rest}")
    done = srf("new", "run1.csv", "--stiffness", "2e-3 1/um", "--column", "friction=Shear")
    assert "left aside: Heat [degC]" in done.stderr and "from 1 to 10 um/s" in done.stderr


def with_noise(step: dict[str, np.ndarray], noise: np.ndarray, name: str) -> Path:
    columns = [step["t"], step["V"], SIGMA * (step["mu"] + noise), step["sigma"]]
    return table(["time_s", "velocity_um_s", "tau_MPa", "sigma_n_MPa"], columns, name)


def test_a_line_in_the_noise_is_found_and_not_taken_for_a_short_correlation(step: dict[str, np.ndarray]) -> None:
    """A line at 0.52 Hz of quality 25 with most of the variance, as a damped oscillator that white noise drives."""
    rng, dt, about = np.random.default_rng(3), step["t"][1] - step["t"][0], 2 * np.pi * 0.52
    damped = np.exp((-about / 50 + 1j * about) * dt)
    z = np.zeros(step["t"].size, complex)
    drive = np.sqrt(1 - abs(damped) ** 2) * (rng.standard_normal(z.size) + 1j * rng.standard_normal(z.size))
    for i in range(1, z.size):
        z[i] = damped * z[i - 1] + drive[i]
    with_noise(step, 2e-4 * z.real, "run1.csv")
    srf("new", "run1.csv", "--stiffness", f"{k * SIGMA * 1e3:g} MPa/mm")
    said = srf("fit", ".", "--track", "smooth").stdout
    found = re.search(r"gauge noise: (\S+) MPa about (\S+) Hz, of quality", said)
    assert found, said
    assert float(found[2]) == pytest.approx(0.52, rel=0.03) and float(found[1]) == pytest.approx(2e-4 * SIGMA, rel=0.35)
    assert "fails a test" not in said


def test_a_fit_says_what_speaks_against_it(step: dict[str, np.ndarray]) -> None:
    """One run four times as loud as the other, and readings that are rounded to steps of ten times the noise."""
    loud = np.random.default_rng(4).normal(0.0, 4e-4, step["t"].size)
    with_noise(step, np.zeros(loud.size), "one.csv")
    with_noise(step, loud, "two.csv")
    srf("new", "one.csv", "two.csv", "--stiffness", f"{k * SIGMA * 1e3:g} MPa/mm")
    said = srf("fit", ".", "--track", "smooth").stdout
    assert "fails a test: innovations of two have an rms of 1.3" in said and "--vary noise gives each its own" in said
    coarse = np.round(step["mu"] / 1e-3) * 1e-3 - step["mu"]
    with_noise(step, coarse, "three.csv")
    srf("new", "three.csv", "--stiffness", f"{k * SIGMA * 1e3:g} MPa/mm", "--out", "three.toml")
    said = srf("fit", "three.toml", "--track", "smooth").stdout
    assert "readings of three are rounded to steps of more than four times the noise" in said


def test_holds_and_oscillations_are_told_from_steps() -> None:
    t = np.arange(0.0, 60.0, 0.05)
    V = np.where((t > 20) & (t < 40), 0.0, 5.0)
    table(["time_s", "v", "mu", "sigma_MPa"], [t, V, 0.6 + 0 * t, 10 + 0 * t], "shs.csv")
    assert "shs, as the drive of shs holds for 33%" in srf("new", "shs.csv", "--stiffness", "2e-3 1/um").stderr
    sigma = 10 * (1 + 0.1 * np.sin(2 * np.pi * 0.5 * t))
    table(["time_s", "v", "mu", "sigma_MPa"], [t, 5 + 0 * t, 0.6 + 0 * t, sigma], "osc.csv")
    done = srf("new", "osc.csv", "--stiffness", "2e-3 1/um", "--force")
    assert "oscillates by 10 % at 0.5 Hz" in done.stderr
    made = tomli.loads(Path("experiment.toml").read_text())
    assert made["model"]["ageing"] == "dieterich+linker-dieterich" and made["parameters"]["alpha"]["lower"] == 0.0
    assert made["runs"][0]["modulation"]["frequency"] == pytest.approx(0.5)
    assert srf("check", ".", "--no-simulate").exit_code == 0
    srf("new", "osc.csv", "--kind", "steps", "--stiffness", "2e-3 1/um", "--force")
    assert "modulation" not in tomli.loads(Path("experiment.toml").read_text())["runs"][0]


@pytest.mark.parametrize(("V", "law"), [(1.0, "dieterich-ruina"), (1.0, "rice-regularized"), (0.02, "rice-regularized")])
def test_bounds_of_the_slip_length_are_the_recording_s(V: float, law: str) -> None:
    """Whatever the law: those of rock, or where the slider moves a few um at a velocity, of that."""
    t = np.arange(0.0, 600.0, 0.5)
    table(["time_s", "v", "mu", "sigma_MPa"], [t, np.where(t < 300, V, 2 * V), 0.6 + 0 * t, 10 + 0 * t], "steps.csv")
    srf("new", "steps.csv", "--law", law, "--stiffness", "2e-3 1/um")
    D0 = tomli.loads(Path("experiment.toml").read_text())["parameters"]["D0"]
    value, low, high = (10.0, 0.5, 500.0) if V == 1.0 else (0.2, 0.01, 10.0)
    assert (D0["value"], D0["lower"], D0["upper"]) == (value, low, high)


@pytest.mark.parametrize(
    ("arguments", "said", "hint"),
    [
        (["run1.csv"], "the stiffness of the machine is in no table", "--stiffness: '5.4e-3 1/um'"),
        (["run1.csv", "--stiffness", "5"], "'5' has no unit", "friction per micron"),
        (["run1.csv", "--stiffness", "5 s"], "'s' measures s", "1.5 MPa/mm"),
        (["run2.csv", "--stiffness", "5 N/m"], "no file run2.csv", "Did you mean 'run1.csv'?"),
        (["run2.csv"], "no file run2.csv", "Did you mean 'run1.csv'?"),
        (["bare.csv", "--stiffness", "1 1/um"], "which column is the time? It has 'a', 'b'", "--column time=HEADING"),
        (
            ["run1.csv", "--stiffness", "1 1/um", "--column", "tau=mu"],
            "--column tau: no such role",
            "Known: contact_area, elongation",
        ),
        (["run1.csv", "--stiffness", "1 1/um", "--column", "friction=nu"], "no column 'nu'", "Did you mean 'mu'?"),
        (["run1.csv", "--stiffness", "1 1/um", "--column", "friction"], "is no ROLE=HEADING", "As in"),
        (["run1.csv", "--stiffness", "1 1/um", "--window", "3"], "is not FROM,TO", "--window 100,900"),
        (["run1.csv", "--stiffness", "1 1/um", "--window", "900,999"], "no sample of", "file's own clock"),
        (["run1.csv", "--stiffness", "1 1/um", "--law", "dietrich-ruina"], "dietrich-ruina", "Did you mean 'dieterich-ruina'?"),
        (["run1.csv", "--stiffness", "1 1/um", "--holdout", "run7"], "no such run", "Did you mean 'run1'?"),
        (["still.csv", "--stiffness", "1 1/um"], "which column is the load point's velocity", "--drive '60:3, 60:10'"),
        (["still.csv", "--stiffness", "1 1/um"], "velocity or displacement? It has", "--column load_point_displacement=HEADING"),
        (["dated.csv", "--stiffness", "1 1/um", "--drive", "1"], "'01/02/2024 00:00:01'", "the seconds since the start"),
        (["twice.csv", "--stiffness", "1 1/um", "--drive", "1", "--load", "5 N"], "2 columns are called", "rename one"),
        (["lift.csv", "--stiffness", "1 1/um"], "the load is -1 MPa", "--window 3,9.9"),
    ],
)
def test_what_is_missing_or_wrong_is_said_in_a_line_and_nothing_is_written(arguments: list[str], said: str, hint: str) -> None:
    t = np.arange(0.0, 10.0, 0.1)
    table(["t", "v", "mu", "sigma_MPa"], [t, 1 + t, 0.6 + 0 * t, 5 + 0 * t])
    table(["t", "mu"], [t, t], "still.csv")
    table(["a", "b"], [t, t], "bare.csv")
    table(["t", "force [N]", "force [N]"], [t, t, t], "twice.csv")
    dated = [f"01/02/2024 00:00:{i:02d},0.6" for i in range(1, 50)]
    Path("dated.csv").write_text("\n".join(["timestamp,mu", *dated]), encoding="utf-8")
    table(["t", "v", "mu", "sigma_MPa"], [t, 1 + t, t, t - 1], "lift.csv")
    done = srf("new", *arguments, code=2)
    error, way_out = done.stderr.strip().splitlines()
    assert error.startswith("Error: ") and said in error, error
    assert way_out.startswith("Try: ") and hint in way_out, way_out
    assert not Path("experiment.toml").exists()


def test_an_existing_file_is_kept() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    table(["t", "v", "mu"], [t, 1 + t, 0.6 + 0 * t])
    Path("experiment.toml").write_text("mine")
    srf("new", "run1.csv", "--stiffness", "1 1/um", code=2)
    assert Path("experiment.toml").read_text() == "mine"


def test_a_recording_that_begins_at_rest_has_the_velocity_of_its_sliding_as_reference() -> None:
    """The stage stands for 20 s, and goes on at 2 um/s: V0 is that, and `srf check` can simulate it.

    Friction is coloured, and has no number for 30 s: no gauge sits at the end of its range there.
    """
    t = np.arange(0.0, 120.0, 0.1)
    x = 2.0 * np.clip(t - 20.0, 0.0, None) - 1e-7 * t
    mu = 0.6 * (1 - np.exp(-np.clip(t - 20.0, 0.0, None) / 5.0)) + 1e-3 * ar1(t.size, 0.8, rng=np.random.default_rng(1))
    table(["time [s]", "lp_disp [um]", "mu", "sigma_n [MPa]"], [t, x, np.where(t < 30, np.nan, mu), 20.0 + 0.01 * np.sin(t / 9)])
    srf("new", "run1.csv", "--stiffness", "1e-3 1/um")
    assert tomli.loads(Path("experiment.toml").read_text())["parameters"]["V0"]["value"] == pytest.approx(2.0, rel=0.02)
    done = srf("check", ".")
    assert "the simulation ended at" not in done.stdout and "saturation" not in done.stdout
    assert json.loads(srf("check", ".", "--no-simulate", "--json").stdout)["rows"][0]["noise"] == pytest.approx(1e-3, rel=0.2)


def test_the_noise_of_a_channel_that_is_slower_than_its_file() -> None:
    """One cell in ten has a number: what is between is bridged, as pieces of one sample tell nothing."""
    t, rng = np.arange(0.0, 300.0, 0.1), np.random.default_rng(1)
    mu = np.where(np.arange(t.size) % 10, np.nan, 0.6 + rng.normal(0, 1e-3, t.size))
    table(["time [s]", "lp_disp [um]", "mu", "sigma_n [MPa]"], [t, 2 * t, mu, 20.0 + 0.01 * np.sin(t / 9)])
    srf("new", "run1.csv", "--stiffness", "1e-3 1/um")
    assert json.loads(srf("check", ".", "--no-simulate", "--json").stdout)["rows"][0]["noise"] > 1e-4


@pytest.mark.parametrize("command", ["fit", "check", "diagnose"])
@pytest.mark.parametrize("name", ["run1.csv", "run1.txt"])
def test_other_commands_given_a_recording_name_this_one(command: str, name: str) -> None:
    t = np.arange(0.0, 10.0, 0.1)
    table(["t", "v", "mu"], [t, 1 + t, 0.6 + 0 * t], name)
    done = srf(command, name, code=2)
    assert f"srf new {name}" in done.stderr.splitlines()[1]


@pytest.mark.parametrize(("path", "stiffness", "unit"), [
    (B819, "5.4e-3 1/um", "MPa"), pytest.param(P446, "55 MPa/mm", "MPa", marks=pytest.mark.slow),
])  # fmt: skip
def test_real_recordings(path: Path, stiffness: str, unit: str) -> None:
    if not path.is_file():
        pytest.skip(f"REFERENCE DATA ABSENT: {path} does not exist; set SRF_SHARED to check against it")
    srf("new", str(path), "--stiffness", stiffness)
    assert f"W [{unit}]" in srf("check", ".", "--no-simulate").stdout


@pytest.mark.parametrize("names", [("\u03c4 (MPa)", "\u03c3n (MPa)"), ("Shr_str [MPa]", "Nor_str [MPa]")])
def test_greek_letters_and_abbreviations_name_stresses(names: tuple[str, str], step: dict[str, np.ndarray]) -> None:
    table(["time (s)", "disp (um)", *names], [step["t"], step["x"], SIGMA * step["mu"], step["sigma"]])
    said = srf("new", "run1.csv", "--stiffness", "40 MPa/mm").stderr
    assert f"{names[0]!r} is the shear stress" in said and f"{names[1]!r} is the normal stress" in said


@pytest.mark.parametrize("heading", ["Load point \u00b5m", "Load point_\u03bcm", "Load point (\u00b5m)"])
def test_a_micro_sign_is_read(heading: str, step: dict[str, np.ndarray]) -> None:
    table(
        ["time [s]", heading, "Shear stress [MPa]", "Normal stress [MPa]"],
        [step["t"], step["x"], SIGMA * step["mu"], step["sigma"]],
    )
    done = srf("new", "run1.csv", "--stiffness", "40 MPa/mm")
    assert "the drive goes from 1 to 10 um/s" in done.stderr


def test_a_power_of_ten_in_a_heading_is_not_dropped(step: dict[str, np.ndarray]) -> None:
    headings = ["time [s]", "Disp 10^-3 mm", "Shear stress [MPa]", "Normal stress [MPa]"]
    table(headings, [step["t"], step["x"], SIGMA * step["mu"], step["sigma"]])
    done = srf("new", "run1.csv", "--stiffness", "40 MPa/mm", code=2)
    assert "10^-3 mm" in done.stderr


def test_a_record_that_begins_before_sliding_is_steady_begins_free(step: dict[str, np.ndarray]) -> None:
    mu = step["mu"] * (1 - 0.8 * np.exp(-step["t"] / 3.0))
    table(["time [s]", "x [um]", "Shear stress [MPa]", "Normal stress [MPa]"], [step["t"], step["x"], SIGMA * mu, step["sigma"]])
    done = srf("new", "run1.csv", "--stiffness", "40 MPa/mm", "--column", "load_point_displacement=x [um]")
    assert "the initial state of run1 is estimated, as its friction begins at 2" in done.stderr
    assert 'initial = "free"' in Path("experiment.toml").read_text()


@pytest.mark.parametrize("stress, stiffness", [(True, "40 kN/mm"), (False, "40 MPa/mm")])
def test_a_stiffness_per_stress_beside_forces_needs_the_area(stress: bool, stiffness: str, step: dict[str, np.ndarray]) -> None:
    units = ("Shear stress [MPa]", "Normal stress [MPa]") if stress else ("Shear force [kN]", "Normal force [kN]")
    table(["time [s]", "LP Disp [um]", *units], [step["t"], step["x"], SIGMA * step["mu"], step["sigma"]])
    done = srf("new", "run1.csv", "--stiffness", stiffness, code=2)
    assert "the stiffness is in" in done.stderr and "area" in done.stderr
    assert not Path("experiment.toml").exists()


@pytest.mark.parametrize(
    "stiffness",
    [("40 MPa/mm",), ("40 MPa/mm", "--area", "25 cm^2"), ("100 kN/mm", "--area", "25 cm^2"), ("2e-3 1/um",)],
    ids=" ".join,
)
def test_what_is_written_of_stresses_is_read_again(stiffness: tuple[str, ...], step: dict[str, np.ndarray]) -> None:
    """A simulated and an augmented experiment state the stiffness as a stress per length, where stresses are recorded."""
    headings = ["time [s]", "LP Disp [um]", "Shear stress [MPa]", "Normal stress [MPa]"]
    table(headings, [step["t"], step["x"], SIGMA * step["mu"], step["sigma"]])
    srf("new", "run1.csv", "--stiffness", *stiffness)
    srf("simulate", ".", "--out-dir", "simulated")
    written = ["simulated"]
    if stiffness == ("2e-3 1/um",):  # a diagnosis takes seconds
        srf("diagnose", ".", "--effect", "viscous-drag", "--out", "found")
        written.append("found/augmented")
    stated = srfcli.read_experiment(".").stiffness
    for folder in written:
        srf("check", "--no-simulate", folder)
        assert srfcli.read_experiment(folder).stiffness == pytest.approx(stated, rel=1e-12)


def test_times_rounded_in_minutes_leave_the_drive_even(step: dict[str, np.ndarray]) -> None:
    """Seven digits of minutes and of millimetres: the rounding grows, and no curve follows it better than a line."""
    rows = zip(step["t"] / 60, step["x"] / 1000, SIGMA * step["mu"], step["sigma"], strict=True)
    heading = "Elapsed Time (min),Displacement (mm),Shear stress (MPa),Normal stress (MPa)"
    Path("run1.csv").write_text("\n".join([heading, *(",".join(f"{x:.7g}" for x in row) for row in rows)]) + "\n")
    srf("new", "run1.csv", "--stiffness", "40 MPa/mm")
    said = srf("check", "--no-simulate", ".").stdout
    assert "2 straight pieces, 1, 10 um/s" in said and "drive-smoothed" not in said and "reset:" not in said
    assert "upper = 500" in next(x for x in Path("experiment.toml").read_text().splitlines() if x.startswith("D0 ="))


@pytest.mark.parametrize(
    ("text", "options", "said"),
    [
        ("time [s],v [um/s],a [kN],b [kN]\n0,1,2,3\n1,1,2,3\n", (), "--column force=HEADING"),
        ("time [s],strain,normal stress [MPa],shear stress [MPa]\n0,0,2,3\n1,1,2,3\n", (), "--thickness '4 mm'"),
        ("time [s],v [um/s],tau [MPa],sigma [MPa]\n0,1,2,3\n", ("--stiffness", "12 MPa"), "'30 MPa/mm', '0.21 N/um' or, of"),
        ("\x89HDF\r\n\x1a\n\0\0\0,,\n", ("--format", "csv"), "no text, but bytes of another kind of file"),
    ],
    ids=["kN", "strain", "stiffness", "binary"],
)
def test_a_hint_names_what_would_do(text: str, options: tuple[str, ...], said: str) -> None:
    Path("run1.csv").write_bytes(text.encode("latin-1"))
    given = options if "--stiffness" in options else ("--stiffness", "30 N/mm", *options)
    assert said in " ".join(srf("new", "run1.csv", *given, code=2).stderr.split())


def test_an_unloading_at_the_end_is_refused_with_the_window_before_it(step: dict[str, np.ndarray]) -> None:
    sigma = np.where(step["t"] < step["t"][-20], SIGMA, -0.05)
    table(["time_s", "v", "tau_MPa", "sigma_n_MPa"], [step["t"], step["V"], SIGMA * step["mu"], sigma])
    done = srf("new", "run1.csv", "--stiffness", "2e-3 1/um", code=2)
    first, last = re.findall(r"--window (\S+),(\S+), say", done.stderr)[0]
    assert (float(first), float(last)) == pytest.approx((step["t"][0], step["t"][-21]))
    srf("new", "run1.csv", "--stiffness", "2e-3 1/um", "--window", f"{first},{last}")


def test_a_largest_speed_beside_a_distance_is_told(step: dict[str, np.ndarray]) -> None:
    numbers = [step["t"], np.cumsum(step["V"]), step["V"], SIGMA * step["mu"], SIGMA + 0 * step["t"]]
    table(["Time [s]", "Distance [um]", "Max linear speed [um/s]", "Friction Force [N]", "Normal Force [N]"], numbers)
    assert "[columns] load_point_displacement" in srf("new", "run1.csv", "--stiffness", "0.04 N/um").stderr
