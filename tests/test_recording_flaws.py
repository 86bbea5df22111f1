"""What real files bring: each flaw is named where it is, of its own kind, and handled as the notice says."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from recording_cases import HEADING, TOML, write
from scipy.linalg import expm

import srfcli
from srfcli.cli.main import cli
from srfcli.core.errors import SrfError
from srfcli.data.clock import Place
from srfcli.data.experiment import NOTICE_KINDS, check_run, read_experiment
from srfcli.data.gauge import GaugeNoise, find_noise, whiten
from srfcli.data.imposed import drive_from_displacement, drive_from_velocity, find_modulation, load_from_column
from srfcli.data.noise import measured, spikes
from srfcli.data.values import Run
from srfcli.laws.registry import load_registry
from srfcli.motion.imposed import ConstantLoad

REGISTRY = load_registry(user=False, entry_points=False)
N = 1200
DRIVE = "drive = [{ duration = 6.0, velocity = 8.0 }, { duration = 99.0, velocity = 12.0 }]"
PLAIN = "\n".join(
    DRIVE if line.startswith("drive") else line
    for line in TOML.splitlines()
    if not line.startswith(("window", "modulation", "title"))
).partition('[[runs]]\nname = "two"')[0]
NO_DRIVE = PLAIN.replace(DRIVE + "\n", "")


class Columns:
    """The numbers of a sound recording: t, V, W and u, (n,) each, as a flaw may change them."""

    def __init__(self, n: int = N) -> None:
        self.random = np.random.default_rng(11)
        self.t = np.arange(n) / 100
        self.V = np.where(self.t < 6, 8.0, 12.0)
        self.W = np.full(n, 5.0)
        self.u = 9.5 - 0.2 * np.log(self.V / 8) + self.random.normal(0, 0.01, n)
        self.heading, self.toml = HEADING, PLAIN

    def keep(self, mask: np.ndarray) -> None:
        self.t, self.V, self.W, self.u = (x[mask] for x in (self.t, self.V, self.W, self.u))

    def written(self, folder: Path) -> Path:
        rows = zip(self.t, self.V, self.W, self.u, strict=True)
        lines = [self.heading, *(",".join("" if np.isnan(x) else f"{x:.9g}" for x in row) for row in rows)]
        return write(folder, toml=self.toml, one=lines)

    def read(self, folder: Path) -> Run:
        return read_experiment(self.written(folder), registry=REGISTRY).runs[0]


def gap(c: Columns) -> None:
    c.keep((c.t < 3) | (c.t > 3.5))


def sampling_change(c: Columns) -> None:
    c.keep((c.t < 4) | (np.arange(N) % 10 == 0))


def nan(c: Columns) -> None:
    c.u[300:304] = np.nan


def repeated(c: Columns) -> None:
    c.t[500] = c.t[499]


def backward(c: Columns) -> None:
    c.t[500] = c.t[400]


def spike(c: Columns) -> None:
    c.u[[200, 700, 701]] += 3.0


def reset(c: Columns) -> None:
    c.u[900:] += 3.0


def saturation(c: Columns) -> None:
    c.u = np.minimum(c.u + 0.5 * np.sin(c.t), 9.7)


def constant(c: Columns) -> None:
    c.u[:] = 9.0


def quantisation(c: Columns) -> None:
    c.u = np.round(c.u / 0.05) * 0.05


def load_constant(c: Columns) -> None:
    c.W += c.random.normal(0, 0.01, N)


def load_smoothed(c: Columns) -> None:
    c.W += 0.5 * np.sin(c.t) + c.random.normal(0, 0.01, N)


def load_steps(c: Columns) -> None:
    c.W = np.where(c.t < 6, 5.0, 5.5)


def modulation_differs(c: Columns) -> None:
    c.W *= 1 + 0.08 * np.cos(2 * np.pi * 5 * c.t)
    c.toml += "modulation = { frequency = 5.0, amplitude = 0.16 }\n"


def drive_differs(c: Columns) -> None:
    c.V[:] = 8.0


def drive_segmented(c: Columns) -> None:
    c.V += c.random.normal(0, 0.2, N)
    c.toml = NO_DRIVE


def drive_fitted(c: Columns) -> None:
    c.V = np.cumsum(c.V) / 100 + c.random.normal(0, 0.02, N)
    c.heading, c.toml = HEADING.replace("velocity [um/s]", "displacement [um]"), NO_DRIVE


def drive_steps(c: Columns) -> None:
    c.V, c.toml = np.where(c.t < 6, 8.0, 80.0), NO_DRIVE


def drive_smoothed(c: Columns) -> None:
    c.V = np.cumsum(8.0 * (1 + 0.008 * np.sin(2 * np.pi * c.t / 3.0))) / 100
    c.heading, c.toml = HEADING.replace("velocity [um/s]", "displacement [um]"), NO_DRIVE


def friction(c: Columns) -> None:
    c.u *= 100


def unit(c: Columns) -> None:
    c.heading = HEADING.replace("spring", "spring [nm]")


def observable(c: Columns) -> None:
    c.heading, c.V = HEADING.replace("load_point_velocity [um/s]", "force [N]"), 0.21 * c.u


def load(c: Columns) -> None:
    c.heading, c.V = HEADING.replace("load_point_velocity [um/s]", "normal_stress [MPa]"), c.W.copy()


def start_value(c: Columns) -> None:
    c.toml = c.toml.replace("V0 =", "K = { value = 0.3, lower = 0.1, upper = 1.0 }\nV0 =")


FLAWS: dict[str, tuple[Callable[[Columns], None], str]] = {
    "gap": (gap, "one.csv: rows 300-301, t = 2.99 to 3.51 s: 0.52 s without a sample"),
    "sampling-change": (sampling_change, "changes from 100 Hz to 10 Hz"),
    "nan": (nan, "one.csv: rows 301-304, t = 3 to 3.03 s: 4 samples without a number in 'spring', not compared"),
    "repeated-time": (repeated, "one.csv: row 501, t = 4.99 s: 1 sample with the time of the sample before, left out"),
    "backward-time": (backward, "one.csv: row 501, t = 4 s: 1 sample whose time does not fit"),
    "spike": (spike, "one.csv: rows 701-702, t = 7 to 7.01 s: 2 samples standing out in 'spring', compared as they are; "),
    "reset": (reset, "one.csv: rows 900-901, t = 8.99 to 9 s: 'spring' jumps by "),
    "saturation": (saturation, "at the extreme value 9.7 of 'spring': saturated, not compared"),
    "constant": (constant, "one.csv: column 'spring': all readings are 9"),
    "quantisation": (quantisation, "one.csv: column 'spring': steps of 0.05, "),
    "load-constant": (load_constant, "constant to its noise of 0.0021 of 5.0"),
    "load-smoothed": (load_smoothed, "which dW/dt would amplify: smoothed by a spline"),
    "load-steps": (load_steps, "from 5 to 5.5 N after t = 5.99 s, the load point moves by 0.08 um, "),
    "modulation-differs": (modulation_differs, "relative amplitude declared 0.16, found 0.08; the column counts"),
    "drive-differs": (drive_differs, "600 of 1200 velocities differ from the declared drive by more than 5 %, the first 8"),
    "drive-segmented": (drive_segmented, "2 constant or straight pieces describe them"),
    "drive-fitted": (drive_fitted, "a continuous line of 2 straight pieces"),
    "drive-steps": (drive_steps, "the one at t = 6 s may be 0.01 s earlier, 0.72 um of the load point and "),
    "drive-smoothed": (drive_smoothed, "um (rms), 0.0216 from 1 straight piece; if the stage went evenly, look at the column"),
    "friction": (friction, "are the units of what is observed, of load and stiffness right?"),
    "unit": (unit, "the heading says 'nm', [columns] says 'um', which counts"),
    "observable": (observable, "elongation is what is compared; the file also has force, left aside"),
    "load": (load, "normal_load is what counts; the file also has normal_stress, left aside"),
    "start-value": (start_value, "K starts from another value than [apparatus] gives"),
}


def test_every_kind_of_notice_has_a_case() -> None:
    """NOTICE_KINDS is what --fail-on takes; the package makes no notice of another kind."""
    assert set(FLAWS) | {"sigma"} == set(NOTICE_KINDS)  # that of critical loads is tested with them
    made = set()
    for path in Path(srfcli.__file__).parent.glob("data/*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            called = isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", ""))
            if called in ("Notice", "spots"):
                made |= {a.value for a in node.args[:1] if isinstance(a, ast.Constant)}
    assert made <= set(NOTICE_KINDS) and len(made) > 15
    text = (Path(__file__).resolve().parents[1] / "docs" / "recordings.md").read_text(encoding="utf-8")
    assert {f"`{kind}`" for kind in NOTICE_KINDS} <= set(re.findall(r"`[a-z-]+`", text.partition("### Notices")[2]))


@pytest.mark.parametrize("kind", FLAWS)
def test_a_flaw_is_told_of_its_own_kind_alone(kind: str, tmp_path: Path) -> None:
    make, told = FLAWS[kind]
    columns = Columns()
    make(columns)
    experiment = read_experiment(columns.written(tmp_path), registry=REGISTRY)
    notices = [*experiment.notices, *experiment.runs[0].notices]
    assert {n.kind for n in notices} == {kind}, [str(n) for n in notices]
    assert any(told in f"{n.where}: {n.what}" for n in notices), [str(n) for n in notices]
    assert np.isfinite(experiment.runs[0].observed).all()


@pytest.mark.parametrize("kind", ["gap", "modulation-differs", "start-value"])
def test_fail_on_a_kind(kind: str, tmp_path: Path) -> None:
    """Exit code 4 for the kind that is there; for all others together 0."""
    make, _ = FLAWS[kind]
    columns = Columns()
    make(columns)
    folder = columns.written(tmp_path)
    others = [word for k in NOTICE_KINDS if k != kind for word in ("--fail-on", k)]
    for asked, code in ((["--fail-on", kind], 4), (others, 0)):
        done = CliRunner().invoke(cli, ["check", str(folder), "--no-simulate", *asked], prog_name="srf")
        assert done.exit_code == code, done.stderr
        assert f"{kind}: " in done.stdout


def test_a_sound_recording_has_no_notices(tmp_path: Path) -> None:
    run = Columns().read(tmp_path)
    assert run.notices == () and run.used.all() and isinstance(run.load, ConstantLoad)


# what is done about them


def test_samples_are_left_out_where_the_notice_says(tmp_path: Path) -> None:
    c = Columns()
    nan(c), spike(c), repeated(c)
    c.toml += 'corrections = ["spike"]\n'
    run = c.read(tmp_path)
    assert run.t.size == N - 1 and np.all(np.diff(run.t) > 0)
    out = set(np.flatnonzero(~run.used).tolist())
    assert out == {200, 300, 301, 302, 303, 699, 700}  # the repeated sample 500 is gone
    assert check_run(run).spikes == 3


def test_a_reset_is_taken_out(tmp_path: Path) -> None:
    c = Columns()
    sound = c.u.copy()
    reset(c)
    c.toml += 'corrections = ["reset"]\n'
    run = c.read(tmp_path)
    assert run.observed[run.used] == pytest.approx(sound[run.used], abs=0.08)
    assert np.flatnonzero(~run.used).tolist() == [899, 900]


@pytest.mark.parametrize(("asked", "moved"), [("reset", False), ("small-reset", True)])
def test_a_jump_that_may_be_something_else_is_taken_out_by_its_own_name(asked: str, moved: bool, tmp_path: Path) -> None:
    """Less than a twentieth of the level, and far beyond the noise."""
    c = Columns()
    sound = c.u.copy()
    c.u[900:] += 0.045 * np.median(c.u)
    c.toml += f'corrections = ["{asked}"]\n'
    run = c.read(tmp_path)
    (told,) = [n.what for n in run.notices if n.kind == "reset"]
    assert ("is moved back by that much" in told) is moved and ('["small-reset"]' in told) is not moved
    assert (run.observed[run.used] == pytest.approx(sound[run.used], abs=0.08)) is moved
    assert np.flatnonzero(~run.used).tolist() == ([899, 900] if moved else [])


def test_a_correction_is_proposed_and_drawn_and_made_only_where_it_is_asked_for(tmp_path: Path) -> None:
    c = Columns()
    sound = c.u.copy()
    spike(c), reset(c)
    run = c.read(tmp_path)
    assert run.used.all() and np.array_equal(run.observed, np.asarray([float(f"{x:.9g}") for x in c.u]))
    assert run.proposed is not None and run.proposed == pytest.approx(sound, abs=0.1)
    said = [n.what for n in run.notices]
    assert all("left as it is" in w or "compared as they are" in w or "compared as it is" in w for w in said), said
    figure = CliRunner().invoke(cli, ["check", str(tmp_path), "--no-simulate", "--plot", str(tmp_path / "a.svg")])
    assert figure.exit_code == 0
    drawn = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert "spike, proposed" in drawn and "level moved back, proposed" in drawn
    c.toml += 'corrections = ["resets"]\n'
    with pytest.raises(SrfError, match="unknown correction 'resets'") as caught:
        c.read(tmp_path)
    assert "Did you mean 'reset'?" in str(caught.value.hint)


@pytest.mark.parametrize("seed", range(3))
def test_no_flaw_is_found_in_the_noise_of_a_laboratory(seed: int, tmp_path: Path) -> None:
    """A line at 5 Hz with half of the variance, colour, tails, steps of the gauge, and a displacement that wanders."""
    random = np.random.default_rng(seed)
    c = Columns()
    line = np.sin(2 * np.pi * 5.3 * c.t + seed)
    colour = measured(np.zeros(N), noise=1.0, lag1=0.9, seed=seed)
    c.u = np.round((c.u + 0.03 * (line + colour + random.standard_t(3, N))) / 0.01) * 0.01
    wander = measured(np.zeros(N), noise=0.8, lag1=0.95, seed=seed + 7)
    c.V = np.cumsum(c.V) / 100 + wander + random.normal(0, 0.2, N)
    c.heading, c.toml = HEADING.replace("velocity [um/s]", "displacement [um]"), NO_DRIVE
    kinds = {n.kind for n in c.read(tmp_path).notices}
    assert not kinds & {"spike", "reset", "saturation"}, kinds


@pytest.mark.parametrize("place", [499, 501, 502, 503])  # 500 is the slip itself
def test_a_spike_beside_a_slip_is_found_and_the_slip_is_none(place: int) -> None:
    x = np.tile(np.linspace(0.0, 2.0, 100), 10) + 0.02 * np.random.default_rng(3).standard_normal(1000)
    assert not spikes(x).any()
    x[place] += 5.0
    assert np.flatnonzero(spikes(x)).tolist() == [place]


@pytest.mark.parametrize("place", [1, 2, 4, 395, 397, 398])
def test_a_spike_among_the_first_or_last_samples_is_found(place: int) -> None:
    noise = 1e-3 * np.random.default_rng(6).standard_normal(400)
    for smooth in (
        0.002 * np.arange(400),
        np.exp(-np.arange(400) / 3),
        np.exp(-np.arange(400)[::-1] / 3),
        np.cos(0.05 * np.arange(400)),
    ):
        x = smooth + noise
        assert not spikes(x).any()
        x[place] -= 3.0
        assert np.flatnonzero(spikes(x)).tolist() == [place]


@pytest.mark.parametrize("after", [1, 2, 3, 397, 398, 399])
def test_a_slip_or_a_step_beside_the_ends_of_a_recording_is_no_spike(after: int) -> None:
    noise = 1e-3 * np.random.default_rng(6).standard_normal(400)
    for x in (0.01 * np.arange(400.0), np.zeros(400)):
        x[after:] -= 1.0
        assert not spikes(x + noise).any() and not spikes(noise - x).any()


def test_a_sudden_spike_is_found_where_samples_are_few() -> None:
    """From one sample to the next the drive may raise friction by a twentieth of the spike; five samples away by more than it."""
    x = 0.6 + 1e-4 * np.random.default_rng(3).standard_normal(400)
    rise = np.full(x.size, 0.02)
    x[205] += 0.3
    x[300] -= 0.3
    assert np.flatnonzero(spikes(x, rise=rise)).tolist() == [205, 300]
    ramp = np.interp(np.arange(400.0), [0, 200, 204, 399], [0.6, 0.6, 0.68, 0.6])  # reloading at that pace, and a slip
    assert not spikes(ramp + 1e-4 * np.random.default_rng(4).standard_normal(400), rise=rise).any()


def test_dips_under_a_modulated_load_are_no_spikes(tmp_path: Path) -> None:
    """Friction follows the load at once: what the load brings about in a sample outruns the drive."""
    c = Columns()
    c.W = 5.0 * (1 + 0.15 * np.cos(2 * np.pi * 12.1 * c.t))
    c.u[np.flatnonzero((np.roll(c.W, 1) > c.W) & (np.roll(c.W, -1) >= c.W))[5:50:20]] -= 1.2
    c.toml += 'corrections = ["spike"]\n'
    assert c.read(tmp_path).used.all()


def test_a_lone_spike_on_a_constant_load_is_bridged(tmp_path: Path) -> None:
    """Also where it is negative: a transducer's accident is no loss of contact."""
    for value in (6.0, -5.0):
        c = Columns()
        c.W[400] = value
        run = c.read(tmp_path)
        assert [n.kind for n in run.notices] == ["spike"]
        assert isinstance(run.load, ConstantLoad) and run.load.W0 == 5.0


def test_the_tail_of_a_load_s_noise_is_no_spike() -> None:
    """A servo's noise has heavy tails: what stands out as others do is kept, a transducer's accident among it is bridged."""
    t = np.arange(20_000) / 1000
    place = Place(Path("x.csv"), "normal_stress", np.arange(1, t.size + 1), t)
    noise = np.random.default_rng(3).standard_t(4, size=t.size)
    W = 20 + 0.01 * noise
    assert not [n for n in load_from_column(place, W)[1] if n.kind == "spike"]
    W[7000] += 2.0
    (told,) = [n for n in load_from_column(place, W)[1] if n.kind == "spike"]
    assert told.what.startswith("1 sample ") and "row 7001," in told.where


@pytest.mark.parametrize("per_period", [8, 12, 25])
@pytest.mark.parametrize("amplitude", [0.045, 0.5])
def test_a_modulation_that_begins_in_mid_record_is_no_row_of_spikes(per_period: int, amplitude: float) -> None:
    t = np.arange(4000) / (10.0 * per_period)
    begin = 0.6 * t[-1]
    rise = np.clip((t - begin) / 0.2, 0, 1)
    W = 5 * (1 + amplitude * rise * np.cos(2 * np.pi * 10 * t))
    place = Place(Path("x.csv"), "normal_load", np.arange(1, t.size + 1), t)
    found, notices = load_from_column(place, W)
    assert not [n for n in notices if n.kind == "spike"]
    assert found(t)[0] == pytest.approx(W, rel=2e-3)
    line = find_modulation(t, W)
    assert line is not None
    assert (line.frequency, line.amplitude) == pytest.approx((10.0, amplitude), rel=2e-3)
    assert line.onset == pytest.approx(begin + 0.1, abs=0.11)


def test_more_spikes_than_accidents_are_what_was_imposed() -> None:
    """Five lone peaks and one in 500 samples are bridged; more are kept as the load that they are."""
    t = np.arange(1000) / 100
    place = Place(Path("x.csv"), "normal_load", np.arange(1, 1001), t)
    for count in (7, 8):
        W = 5 + 1e-4 * np.sin(t)
        W[np.arange(count) * 100 + 50] += 1
        _, notices = load_from_column(place, W)
        assert sum(n.kind == "spike" for n in notices) == (7 if count == 7 else 0)


@pytest.mark.parametrize("amplitude", [0.0, 1e-4])
def test_a_wobbling_servo_is_no_modulation(amplitude: float) -> None:
    t = np.arange(3000) / 100
    assert find_modulation(t, 5 * (1 + amplitude * np.cos(2 * np.pi * 0.7 * t))) is None


def oscillating(n: int, cycles: float, quality: float, random: np.random.Generator) -> np.ndarray:
    """Return a noise-driven oscillator of unit variance, exact at each sample: e'' + (w/q) e' + w^2 e = noise."""
    w = 2 * np.pi * cycles
    F = expm(np.array([[0.0, w], [-w, -w / quality]]))  # of e and e'/w, which have one variance
    noise = random.standard_normal((n, 2)) @ np.linalg.cholesky(np.eye(2) - F @ F.T).T
    x, out = random.standard_normal(2), np.empty(n)
    for i in range(n):
        x = F @ x + noise[i]
        out[i] = x[0]
    return out


def slow(n: int) -> np.ndarray:
    return np.asarray(10 + 0.5 * np.sin(np.arange(n) / 3000))


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
def test_level_and_colour_of_the_noise(rho: float) -> None:
    """AR(1) noise about a slow curve comes out with its level and the correlation of neighbours."""
    n = 20_000
    found = find_noise([slow(n) + measured(np.zeros(n), noise=0.02, lag1=rho, seed=3)], 1e-3)
    own, neighbour = found.covariance(np.array([0.0, 1e-3]))
    assert neighbour / own == pytest.approx(rho, abs=0.03)
    assert found.total == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_the_parts_of_the_noise_are_told_apart(seed: int) -> None:
    """White noise, and with it a relaxation, or a line of half of the variance at 5 Hz, or noise behind a filter."""
    random, n, dt = np.random.default_rng(seed), 10_000, 0.01
    white = 0.03 * random.standard_normal(n)
    found = find_noise([slow(n) + white], dt)
    assert found.colours == () and found.white == pytest.approx(0.03, rel=0.03)
    relaxing = measured(np.zeros(n), noise=0.03, lag1=float(np.exp(-dt / 0.08)), seed=seed + 50)
    found = find_noise([slow(n) + white + relaxing], dt)
    time, level = found.colours[0]
    assert len(found.colours) == 1 and (time, level) == pytest.approx((0.08, 0.03), rel=0.3)
    assert found.white == pytest.approx(0.03, rel=0.05)
    found = find_noise([slow(n) + white + 0.03 * oscillating(n, 5 * dt, 20.0, random)], dt)
    frequency, level, quality = found.colours[0]
    assert (frequency, level, quality) == (pytest.approx(5, rel=0.01), pytest.approx(0.03, rel=0.15), pytest.approx(20, rel=0.4))
    assert found.white == pytest.approx(0.03, rel=0.05) and len(found.colours) == 1
    found = find_noise([slow(n) + 0.03 * oscillating(n, 0.05, 0.5, random)], dt)
    assert found.white < 0.003 and found.colours[0] == pytest.approx((5, 0.03, 0.5), rel=0.2)


def test_each_rate_has_a_noise_of_its_own_and_rounding_its_part(tmp_path: Path) -> None:
    """10 Hz with a slow part, then 100 Hz with a line, steps of the gauge in both; the parts add up to what there is."""
    random, n = np.random.default_rng(1), 4000
    c = Columns(2 * n)
    c.t = np.r_[0.1 * np.arange(n), 0.1 * n + 0.01 * np.arange(n)]
    first = measured(np.zeros(n), noise=0.03, lag1=float(np.exp(-0.1 / 0.5)), seed=2) + 0.02 * random.standard_normal(n)
    second = 0.03 * oscillating(n, 0.05, 10.0, random) + 0.01 * random.standard_normal(n)
    c.u = np.round((12 + np.r_[first, second]) / 0.02) * 0.02
    c.V[:], c.toml = 8.0, c.toml.replace("velocity = 12.0", "velocity = 8.0").replace("99.0", "999.0")
    check = check_run(c.read(tmp_path))
    assert check.sampling.spacings == pytest.approx((0.01, 0.1))
    fast, slow_ = check.noises
    assert fast.colours[0] == (pytest.approx(5, rel=0.02), pytest.approx(0.03, rel=0.15), pytest.approx(10, rel=0.4))
    assert slow_.colours[0] == pytest.approx((0.5, 0.03), rel=0.35)
    assert (fast.quantum, slow_.quantum) == pytest.approx((0.02, 0.02))
    assert fast.total == pytest.approx(np.std(c.u[n:]), rel=0.07) and slow_.total == pytest.approx(np.std(c.u[:n]), rel=0.07)
    assert fast.white == pytest.approx(0.01, rel=0.15) and slow_.white == pytest.approx(0.02, rel=0.2)


def test_ringing_after_steps_is_no_line() -> None:
    """What rings at 30 Hz for a while after each step is signal: a gauge's line is there all along."""
    random, dt = np.random.default_rng(4), 1e-3
    t = dt * np.arange(12_000)
    since = t % 4.0
    ringing = 0.3 * np.exp(-since / 0.15) * np.cos(2 * np.pi * 30 * since)
    found = find_noise([ringing + measured(np.zeros(t.size), noise=0.02, lag1=0.5, seed=4)], dt)
    assert found.total == pytest.approx(0.02, rel=0.1)
    line = 0.02 * oscillating(t.size, 0.03, 50.0, random)
    found = find_noise([line + measured(np.zeros(t.size), noise=0.02, lag1=0.5, seed=4)], dt)
    assert any(len(colour) == 3 and abs(colour[0] - 30) < 1 for colour in found.colours)


def test_whitening_is_that_of_the_covariance_matrix() -> None:
    """The filter's innovations have the products of columns over the dense covariance, at two rates, with readings left out."""
    random = np.random.default_rng(5)
    noises = (GaugeNoise(0.5, 0.4, ((0.3, 1.0), (2.0, 0.7, 5.0))), GaugeNoise(0.2, 0.0, ((3.0, 0.5, 0.4),)))
    t = np.sort(random.uniform(0, 10, 120))
    t[60:] = 12 + 0.05 * np.arange(60)
    rate, begins = np.repeat([0, 1], 60).astype(np.intc), np.arange(120) == 60
    columns = random.standard_normal((120, 3))
    C = np.zeros((120, 120))
    for k, part in enumerate((slice(0, 60), slice(60, 120))):
        C[part, part] = noises[k].covariance(np.abs(np.subtract.outer(t[part], t[part])))
    white = whiten(noises, rate, begins, t, columns)
    assert white.T @ white == pytest.approx(columns.T @ np.linalg.solve(C, columns), rel=1e-8, abs=1e-8)


def test_noise_under_a_modulation(tmp_path: Path) -> None:
    """A response at the modulation's frequency and twice that is no noise."""
    c = Columns(4000)
    c.W *= 1 + 0.1 * np.cos(2 * np.pi * 7 * c.t)
    c.u += 0.2 * np.cos(2 * np.pi * 7 * c.t + 1) + 0.05 * np.cos(4 * np.pi * 7 * c.t)
    check = check_run(c.read(tmp_path))
    assert check.load.modulation is not None and check.load.modulation.frequency == pytest.approx(7, rel=1e-6)
    assert check.noise.total == pytest.approx(0.01, rel=0.15)
    assert (check.slowest, check.fastest) == (8.0, 12.0)
    assert check.load.rate == pytest.approx(0.1 * 2 * np.pi * 7 / np.sqrt(1 - 0.01), rel=0.01)


def test_stress_counts_as_force_on_a_square_millimetre(tmp_path: Path) -> None:
    c = Columns()
    c.heading = HEADING.replace("normal_load [N]", "normal_stress [kPa]")
    c.W *= 1000
    with pytest.raises(SrfError, match="the stiffness is in N/um, and 'normal_stress"):
        c.read(tmp_path)
    c.toml = c.toml.replace("0.21 N/um", "210 MPa/mm")
    assert c.read(tmp_path).load(np.array([1.0]))[0] == pytest.approx([5.0], rel=1e-12)


def test_a_stiffness_of_stress_alone_says_that_stresses_were_recorded(tmp_path: Path) -> None:
    """Friction under a load that has no unit of its own: nothing but the stiffness tells."""
    c = Columns()
    c.heading = HEADING.replace("normal_load [N]", "aside").replace("spring", "friction [1]")
    c.u = 0.6 + 0.001 * c.u
    c.toml = (
        c.toml.replace("0.21 N/um", "210 MPa/mm").replace('elongation = { name = "spring", unit = "um" }', "") + "load = 5.0\n"
    )
    assert c.read(tmp_path).stress


def test_scale_offset_and_intervals(tmp_path: Path) -> None:
    """[columns] turns counts of a converter and a code of sample intervals into quantities."""
    c = Columns()
    expected = c.u.copy()
    c.u, c.t = (c.u - 3) / 0.002, np.full(N, 100.0)
    c.toml = c.toml.replace(
        'elongation = { name = "spring", unit = "um" }',
        'elongation = { name = "spring", unit = "um", scale = 0.002, offset = 3.0 }\n'
        'time = { name = "time", unit = "s", scale = 1e-4, integrate = true }',
    )
    run = c.read(tmp_path)
    assert run.t == pytest.approx(0.01 * np.arange(1, N + 1), rel=1e-9)
    assert run.observed == pytest.approx(expected, rel=1e-6)
    c.t[7] = -1
    with pytest.raises(SrfError, match=r"one\.csv, row 8, column 'time \[s\]': found -0.0001 s, expected a sample interval"):
        c.read(tmp_path)


def test_steps_of_the_drive_from_displacements(tmp_path: Path) -> None:
    c = Columns()
    drive_fitted(c)
    drive = c.read(tmp_path).drive
    assert list(drive.velocities) == pytest.approx([8.0, 12.0], rel=2e-3)
    assert drive.breaks[0] == pytest.approx(6.0, abs=0.02)


@pytest.mark.parametrize("jump", [0.0, 0.02])
def test_a_step_of_the_written_figures_is_no_reset(jump: float, tmp_path: Path) -> None:
    """An angle of six figures, 1145.9 steps below a degree from sample to sample: each twelfth is a step less. A jump is told."""
    t = np.arange(1000) / 20
    angle = np.degrees(np.interp(t, [0, 20, 50], [0, 60, 360]) / 25e3)
    angle[700:] += jump
    torque = 15.0 + np.random.default_rng(1).normal(0.0, 0.01, t.size)
    rows = [f"{row[0]:g},{row[1]:.6g},10,{row[2]:.6g}" for row in zip(t, angle, torque, strict=True)]
    file, toml = tmp_path / "rot.csv", str(tmp_path / "r.toml")
    file.write_text("\n".join(["Time (s),Angle (deg),Normal stress (MPa),Torque (N m)", *rows]) + "\n")
    apparatus = ["--stiffness", "30 MPa/mm", "--radius", "25 mm", "--area", "1 cm^2"]
    assert CliRunner().invoke(cli, ["new", str(file), *apparatus, "--out", toml]).exit_code == 0
    told = CliRunner().invoke(cli, ["check", toml, "--no-simulate", "--plot", str(tmp_path / "a.svg")]).output
    assert told.count("the displacement jumps by") == bool(jump)
    assert ("displacement moved back, proposed" in (tmp_path / "a.svg").read_text(encoding="utf-8")) == bool(jump)


@pytest.mark.parametrize(("noise", "count"), [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)], ids=["clean", "noise", "encoder"])
@pytest.mark.parametrize(
    "steps",
    [
        [(100, 1), (50, 3), (20, 10), (10, 30), (20, 10), (50, 3)],
        [(60, 1), (6, 10), (60, 1), (6, 10), (60, 1)],
        [(40, 1), (15, 3), (40, 1), (15, 3), (40, 1), (5, 10), (40, 1)],
    ],
    ids=["up and down", "short", "with a last one"],
)
def test_steps_that_are_many_or_short_beside_the_record(steps: list[tuple[float, float]], noise: float, count: float) -> None:
    """In a record of few stretches corners are in many of them: they are no noise of the displacements."""
    ends = np.cumsum([0.0, *(duration for duration, _ in steps)])
    way = np.cumsum([0.0, *(duration * V for duration, V in steps)])
    t = np.arange(0.0, ends[-1], 0.1)
    displacements = np.interp(t, ends, way) + noise * np.random.default_rng(3).standard_normal(t.size)
    displacements = np.round(displacements / count) * count if count else displacements
    drive, *_ = drive_from_displacement(t, displacements, "stage")
    assert drive.velocities == pytest.approx([V for _, V in steps], rel=2e-3)
    assert drive.breaks == pytest.approx(ends[1:-1], abs=0.1)


@pytest.mark.parametrize("interval", [0.1, 0.5, 30.0])
@pytest.mark.parametrize("count", [1e-3, 1.0])
def test_holds_of_a_column_without_noise_are_its_drive(interval: float, count: float) -> None:
    """A command, or an encoder whose counts divide the way; a hold may be logged by its two ends alone."""
    t, x, at, way = [], [], 0.0, 0.0
    for V, duration in ((10.0, 30.0), (0.0, 30.0), (10.0, 25.0), (0.0, 120.0), (10.0, 25.0), (0.0, 300.0), (10.0, 25.0)):
        own = np.arange(0.0, duration - 1e-9, 0.1 if V else interval)
        t, x = [*t, *(at + own)], [*x, *(way + V * own)]
        at, way = at + duration, way + V * duration
    drive, *_ = drive_from_displacement(np.array(t), count * np.round(np.array(x) / count), "stage")
    assert np.allclose(drive.velocities, [10, 0, 10, 0, 10, 0, 10], atol=1e-3)
    assert np.allclose(drive.times, [0, 30, 60, 85, 205, 230, 530], atol=0.02)


def test_holds_of_a_noisy_column_of_velocities_stand_still() -> None:
    t = np.arange(0.0, 120.0, 0.05)
    V = np.where((t > 40) & (t < 80), 0.0, 10.0) + np.random.default_rng(3).normal(0.0, 0.2, t.size)
    drive, _ = drive_from_velocity(t, V, "ram")
    assert drive.velocities[1] == 0.0 and np.allclose(drive.velocities, [10, 0, 10], atol=0.05)


def test_counts_of_an_encoder_are_no_steps_of_the_drive() -> None:
    """A hundred samples to a count: each jump is the encoder's, and the misfit its rounding."""
    t = np.arange(0.0, 600.0, 0.1)
    drive, told, _ = drive_from_displacement(t, np.round(np.interp(t, [0, 300, 600], [0, 30, 120])), "stage")
    assert drive.velocities == pytest.approx([0.1, 0.3], rel=1e-3)
    assert "times their noise" not in told[-1].what


def test_a_motor_that_takes_half_a_second_to_its_next_velocity_ramps() -> None:
    """A ramp has two corners near each other: neither is noise, and the pieces between them are not thrown away one by one."""
    rng = np.random.default_rng(505)
    near = [np.arange(at - 1.0, at + 2.0, 0.05) for at in (30.0, 40.5, 81.0)]
    t = np.unique(np.concatenate([np.arange(0.0, 95.0, 0.5), *near]).round(4))
    fine = np.arange(0.0, 96.0, 1e-3)
    velocity = np.interp(fine, [0, 30, 30.5, 40.5, 41, 81, 81.5, 96], [3, 3, 30, 30, 3, 3, 9, 9])
    x = np.interp(t, fine, np.cumsum(velocity) * 1e-3) + rng.normal(0.0, 0.02, t.size)
    drive, *_ = drive_from_displacement(t, x, "stage")
    told = x[0] + drive.displacement(t)
    assert np.abs(told - told.mean() - (x - x.mean())).max() < 0.5


@pytest.mark.parametrize("seed", range(6))
def test_any_column_has_a_drive(seed: int) -> None:
    """Knots stay apart while they are moved: velocities are finite, whatever the counts and bursts."""
    rng = np.random.default_rng(seed)
    lasts, V = rng.uniform(0.3, 4.0, 6), np.exp(rng.uniform(-1.0, 4.0, 6))
    ends = np.concatenate([[0.0], np.cumsum(lasts)])
    t = np.arange(0.0, ends[-1], 0.01)
    x = np.round(np.interp(t, ends, np.concatenate([[0.0], np.cumsum(lasts * V)])) / 1.7) * 1.7
    drive, *_ = drive_from_displacement(t, x, "stage")
    assert np.isfinite(drive.velocities).all()


@pytest.mark.parametrize(("rate", "noise"), [(20, 0.0), (20, 0.1), (200, 0.01), (500, 0.001)])
def test_the_drive_of_a_crank_has_its_velocity(rate: int, noise: float) -> None:
    """A stroke of 100 um sin(wt), of which straight pieces make velocities that are 2 to 13 % of the largest off."""
    t, w = np.arange(0.2, 4.8, 1 / rate), 2 * np.pi / 10
    x = -100 * np.cos(w * t) + noise * np.random.default_rng(5).standard_normal(t.size)
    drive, (notice,), _ = drive_from_displacement(t, x, "x")
    assert notice.kind == "drive-smoothed"
    assert np.std(drive(t) - 100 * w * np.sin(w * t)) < 0.005 * 100 * w
    moved = drive.displacement(t) + 100 * np.cos(w * t)
    assert np.std(moved) < max(0.4 * noise, 1e-4)
    assert len(drive.times) < 100


def test_steps_under_coloured_noise_stay_steps() -> None:
    """A servo that hunts: displacements leave the line by three times their white noise, but no curve of few numbers has that."""
    rng, t = np.random.default_rng(6), np.arange(2000) / 100
    colour = np.zeros(t.size)
    for i in range(1, t.size):
        colour[i] = 0.97 * colour[i - 1] + 0.1 * rng.standard_normal()
    x = np.where(t < 10, 3 * t, 30 + 10 * (t - 10)) + colour
    drive, notices, _ = drive_from_displacement(t, x, "x")
    assert [n.kind for n in notices] == ["drive-fitted"]
    assert drive(np.array([2.0, 18.0])) == pytest.approx([3, 10], abs=0.2)
