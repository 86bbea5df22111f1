"""Hypotheses fitted under nudging: the slider is held to the recording first, then less and less.

Stick-slip makes a least-squares surface full of false minima: a cycle too early fits as well as any. A slider that a second
spring holds, too stiff together with the first for stick-slip, keeps its cycles in step whatever the parameters are, and what
its friction lacks shows as an elongation in proportion. A right model needs no second spring, and its minimum stays where it is
while that is taken away. To draw the stage instead takes stiffness away: at a force that is imposed, weakening friction does not
slide steadily at all.
Abarbanel, Creveling, Farsian and Kostuk, SIAM J. Appl. Dyn. Syst. 8, 1341 (2009); Rice and Ruina, J. Appl. Mech. 50, 343 (1983).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srfcli.codegen.model import Array, GeneratedModel
from srfcli.codegen.splines import Spline
from srfcli.core.units import split_quantity, to_base
from srfcli.data.noise import describe_noise
from srfcli.data.values import Experiment, Run
from srfcli.diagnosis.goodness_of_fit import quietest
from srfcli.diagnosis.hypotheses import Hypothesis, neutral_values, own_parameters
from srfcli.inference import fit as fitting
from srfcli.inference.fit import Problem, first_level
from srfcli.inference.noise import Noise, stretches
from srfcli.inference.prediction import RTOL, Hold, of_run, stiffness_share
from srfcli.inference.random_field import LatentFit, Tracks, fit_latent
from srfcli.laws.registry import Registry

# Fits that cannot lose their way: a second spring holds the slider to where it was recorded, ever more softly, until it is free.

DENSE = 1.0  # samples from knot to knot: a slip between two samples leaves its mark for the whole of the next cycle
FIRM = 0.03  # of the load: the force of the second spring over one length
WIDEST, AGREE = 33, 2.0  # samples of the longest parabola, and standard deviations within which two of them agree
FAST, BESIDE = 8.0, 4  # noise levels from one sample to the next that are a slip, samples beside it that tell nothing
STIFF = 1e-4  # weight of second differences, against a sample's 1: they bridge what was not recorded


def hold_to(experiment: Experiment, runs: Sequence[Run], length: float) -> Hold:
    """Return the spring that holds the slider of these runs to the recording, by 3 % of the load over `length` um."""
    forces = all(run.observable != "elongation" for run in runs)
    records = {run.name: _record(experiment, run, forces) for run in runs}
    return weaker(Hold(("force" if forces else "elongation", "time"), {}, records), runs, length)


def weaker(hold: Hold, runs: Sequence[Run], length: float) -> Hold:
    """Return the same spring over another length."""
    return Hold(hold.table, {run.name: FIRM * _load(run) / length for run in runs}, hold.records)


def between_slips(run: Run) -> Run:
    """Return a run without its slips, as nothing tells when between two samples the held slider was to slip."""
    from scipy.ndimage import binary_dilation

    level = describe_noise(run.observed[run.used & np.isfinite(run.observed)]).total
    moved = np.abs(np.diff(run.observed, prepend=run.observed[0]))
    slips = binary_dilation(moved > FAST * level, iterations=BESIDE)
    return replace(run, used=run.used & ~slips) if slips.mean() < 0.5 else run


def slip_length(model: GeneratedModel, experiment: Experiment) -> float:
    """Return the length over which contacts are renewed, as the experiment has it: D0, else the shortest length of the laws."""
    values = model.defaults() | {q.name: q.value for q in experiment.parameters}
    lengths = {p.name: values[p.name] for p in model.parameters if p.unit == "um" and p.name != "start"}
    return lengths.get("D0") or min((v for v in lengths.values() if v > 0), default=1.0)


def _load(run: Run) -> float:
    return float(np.mean(run.load(run.t)[0]))


def _record(experiment: Experiment, run: Run, forces: bool) -> Spline:
    """Return a recording as a spline over time: the spring's elongation, or its force where all runs record that."""
    y = run.observed * (run.load(run.t)[0] if run.observable == "friction" else 1.0)
    if not forces and run.observable != "elongation":
        size, unit = split_quantity(experiment.stiffness_text, name="stiffness")
        y = y / (to_base(size, unit) * stiffness_share(experiment, run))
    step = float(np.median(np.diff(run.t)))
    used = run.used & np.isfinite(y)
    return smoothed(run.t, calmed(run, y, used), used, DENSE * step)


def calmed(run: Run, y: Array, used: Array) -> Array:
    """Return a record y (n,) without its noise, by parabolas over the longest stretches that agree with all shorter ones.

    Noise that a second spring carries into the motion would make every spring look softer than it is.
    Goldenshluger and Nemirovski, Math. Methods Stat. 6, 135 (1997).
    """
    from scipy.signal import savgol_coeffs, savgol_filter

    out, modulation = y.copy(), of_run(run)
    for a, b in stretches(run.t, used):
        if b - a < 2 * WIDEST:
            continue
        cycles = modulation["f"] * float(np.median(np.diff(run.t[a:b]))) if modulation["modulated"] else None
        about = describe_noise(y[a:b], cycles)
        level, rho = (x if np.isfinite(x) else 0.0 for x in (about.total, about.lag1))
        low, high = y[a:b] - 1.5 * AGREE * level, y[a:b] + 1.5 * AGREE * level
        agree = np.ones(b - a, dtype=bool)
        for size in (5, 9, 17, WIDEST):
            weights = savgol_coeffs(size, 2)
            apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
            error = AGREE * level * float(np.sqrt(weights @ np.clip(rho, 0.0, 0.9) ** apart @ weights))
            found = savgol_filter(y[a:b], size, 2)
            low, high = np.maximum(low, found - error), np.minimum(high, found + error)
            agree &= low <= high
            out[a:b] = np.where(agree, found, out[a:b])
    return out


def smoothed(t: Array, y: Array, used: Array, spacing: float) -> Spline:
    """Return the cubic spline over t (n,) nearest to the used samples of y, straight where there are none."""
    from scipy.sparse import csr_matrix, diags
    from scipy.sparse.linalg import spsolve

    spline = Spline.over(float(t[0]), float(t[-1]), spacing)
    n = spline.numbers.size
    cell, weights = spline.weights(t[used])
    rows = np.repeat(np.arange(cell.size), 4)
    A = csr_matrix((weights.ravel(), (rows, (cell[:, None] + np.arange(4)).ravel())), shape=(cell.size, n))
    bends = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(n - 2, n))
    return spline.with_numbers(spsolve((A.T @ A + STIFF * bends.T @ bends).tocsc(), A.T @ y[used]))


# Hypotheses fitted while the slider is held to the recording first, then free: where they start from hardly matters.

LOOSE = 2.0  # slip lengths over which a second spring holds that leaves most of a misfit to be seen
PULLS = (
    (LOOSE,),
    (1.0, LOOSE),
    (0.5, 1.0, LOOSE),
)  # the same, and ever softer ones; the next way is tried where one leads nowhere
CLEAR = 1.05  # chi-squared per degree of freedom under a hold that is noise
NEARLY = 1.6  # the same of a model that may be right: what is lost when it is set free is worth finding
LOOSE_ONLY = (LOOSE,)  # the one that a refit starts under
COARSE, FEW = 1e-2, 12  # tolerance of chi-squared while held, and evaluations
ROUND = 1e-4  # relative tolerance of the integrator while held
FAIR = 1e-5  # the same of a free fit, where the noise asks for no more
QUIET = 1e-3  # noise over a record's standard deviation beyond which it asks for no more
SAME = 0.01  # relative difference of chi-squared within which two ways led to the same minimum
FOLLOWED = 4.0  # chi-squared per degree of freedom of a model that follows the recording when free
HOPELESS = 30.0  # the same of one that does not: its minimum need not be known exactly


@dataclass(frozen=True)
class Followed:
    """Parameters (k,) with their `reduced` chi-squared when the spring is free, and those under the last hold with theirs."""

    problem: Problem
    theta: Array
    reduced: float
    place: Array
    held: float

    @property
    def lost(self) -> bool:
        """Return whether the model does not follow the recording at all."""
        return not self.reduced < HOPELESS


class Follower:
    """Fits hypotheses to one experiment under a hold that grows softer."""

    def __init__(self, registry: Registry, experiment: Experiment, trend: str | None) -> None:
        self.registry, self.experiment, self.trend, self.rtol = registry, experiment, trend, RTOL
        problem = self.problem(Hypothesis(), {})
        self.unit = slip_length(problem.model, experiment)
        self.strong = hold_to(experiment, problem.runs, self.unit)
        self.evaluations = 0
        self.between = tuple(between_slips(run) for run in problem.runs)
        still = min(first_level(r) / max(float(np.std(r.observed)), 1e-300) for r in problem.runs)
        self.rtol = FAIR if still > QUIET else RTOL

    def problem(self, hypothesis: Hypothesis, at: Mapping[str, float], length: float | None = None) -> Problem:
        """Return the fit of a hypothesis held over so many slip lengths, or free."""
        held = self.hold(length) if length is not None else None
        found = hypothesis.problem(
            self.registry, self.experiment, rough=False, at=dict(at), trend=self.trend, hold=held
        )
        return replace(found, rtol=self.rtol) if held is None else replace(found, rtol=ROUND, runs=self.between)

    def hold(self, length: float) -> Hold:
        """Return the second spring over so many slip lengths."""
        return weaker(self.strong, self.experiment.runs, length * self.unit)

    def follow(
        self, hypothesis: Hypothesis, at: Mapping[str, float], noise: Mapping[str, Noise],
        ways: Sequence[Sequence[float]] = PULLS,
    ) -> Followed:  # fmt: skip
        """Return the free fit from where the best of the ways of softening the hold leads, from the values in `at`."""
        theta, reduced = self.led(hypothesis, at, noise, ways[0])
        for way in ways[1:]:
            if reduced < CLEAR:
                break
            found = self.led(hypothesis, at, noise, way)
            agreed = same(found[1], reduced)
            theta, reduced = min((theta, reduced), found, key=lambda f: f[1])
            if agreed:
                break
        return self.released(hypothesis, theta, reduced, noise)

    def led(
        self, hypothesis: Hypothesis, at: Mapping[str, float], noise: Mapping[str, Noise], way: Sequence[float]
    ) -> tuple[Array, float]:
        """Return the parameters that a hold over ever more slip lengths leads to, and chi-squared per degree of freedom."""
        theta, reduced = self.problem(hypothesis, at).start, np.inf
        for length in way:
            theta, reduced = self.descend(self.problem(hypothesis, at, length), theta, noise, COARSE)
        return theta, reduced

    def released(self, hypothesis: Hypothesis, place: Array, held: float, noise: Mapping[str, Noise]) -> Followed:
        """Return the free fit from parameters while held, and their chi-squared there."""
        free = self.problem(hypothesis, {})
        theta, reduced = self.descend(free, place, noise, 1e-4)
        if not reduced < FOLLOWED and held < NEARLY:
            theta, reduced = min((theta, reduced), self.grow(free, place, noise), key=lambda f: f[1])
        return Followed(free, theta, reduced, place, held)

    def descend(
        self, problem: Problem, theta: Array, noise: Mapping[str, Noise], tolerance: float
    ) -> tuple[Array, float]:
        """Return where some steps downhill lead, and chi-squared per degree of freedom there."""
        search = fitting.Search(problem, lambda text: None)
        theta, _ = search.descend(
            np.clip(theta, problem.lower, problem.upper), noise, {}, tolerance=tolerance, most=FEW
        )
        self.evaluations += search.evaluations
        return theta, search.reduced

    def grow(self, problem: Problem, theta: Array, noise: Mapping[str, Noise]) -> tuple[Array, float]:
        """Return where horizons that grow lead, and chi-squared per degree of freedom there."""
        search = fitting.Search(problem, lambda text: None)
        theta, _ = search.grow(np.clip(theta, problem.lower, problem.upper), noise)
        self.evaluations += search.evaluations
        return theta, search.reduced

    def smallest(self, found: Followed) -> dict[str, Array]:
        """Return what a free fit leaves (n,) by run, or the recording itself, whichever has less noise about a slow trend."""
        out = {}
        for run in found.problem.runs:
            residual = run.observed - found.problem.predicted(run, found.theta, slopes=False).y
            out[run.name] = min(residual, run.observed, key=lambda r: quietest(run, r))
        return out

    def around(self, hypothesis: Hypothesis, values: Mapping[str, float], noise: Mapping[str, Noise]) -> LatentFit:
        """Return the fit of a hypothesis under a loose hold, around which everything is nearly linear."""
        problem = self.problem(hypothesis, values, LOOSE)
        return fit_latent(problem, problem.start, noise, tracks=Tracks((), {}), known_noise=True, steps=FEW)


def same(one: float, other: float) -> bool:
    """Return whether two values of chi-squared are those of one minimum."""
    return abs(one - other) < SAME * min(one, other)


def shortened(hypothesis: Hypothesis, problem: Problem, noise: Mapping[str, Noise]) -> tuple[Array, float]:
    """Return the problem's start, the last effect's size cut where the whole of it leads astray, and chi-squared there."""
    if not hypothesis.effects or not hypothesis.effects[-1].sizes:
        return problem.start, 0.0
    effect = hypothesis.effects[-1]
    neutral = neutral_values(effect)
    places = [(problem.names.index(long), neutral[p.name]) for long, p in own_parameters(effect, problem.model).items()
              if p.name in neutral and long in problem.names]  # fmt: skip
    best = (problem.start, np.inf)
    for share in (1.0, 0.3, 0.0):
        theta = problem.start.copy()
        for i, value in places:
            theta[i] = value + share * (theta[i] - value)
        theta = np.clip(theta, problem.lower, problem.upper)
        squares = 0.0
        for run in problem.runs:
            r = (run.observed - problem.predicted(run, theta, slopes=False).y)[run.used] / noise[run.name].level
            squares += float(np.sum(np.clip(np.nan_to_num(r, nan=1e6), -1e6, 1e6) ** 2))
        if squares < best[1]:
            best = (theta, squares)
    return best
