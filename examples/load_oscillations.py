"""Recordings under a normal load that oscillates: Linker and Dieterich, Nagata and load transmission against each other.

    python examples/load_oscillations.py RECORDING... --stiffness "6e-3 MPa/um" --velocity 10
    python examples/load_oscillations.py --stand-in DIR [--alpha 0.3]

A RECORDING is a table with time, normal stress and shear stress, such as those of gouge sheared in double direct shear at 10 to
13.5 MPa with sinusoidal oscillations of 0.5 to 2 MPa and periods of 0.5 to 50 s (Zenodo 8131060, which is no part of this
project). Options name the columns. All recordings are fitted together, each model on the same readings by the same likelihood,
that of `srf fit`; the table has its log likelihood, its log evidence (flat priors within the bounds), how far that is from the
best, and the parameters.

    ageing law           phi' = 1 - v phi/D0, mu = mu0 + A ln(v/V0) + B ln(V0 phi/D0)
    linker-dieterich     phi' = ... - (alpha/B) phi W'/W                    J. Geophys. Res. 97, 4923 (1992)
    nagata               phi' = ... - (c/B) phi tau'/W                      J. Geophys. Res. 117, B02314 (2012)
    load-transmission    the gouge feels W0 + rho (W - W0)

--stand-in writes a recording of the same form, by equations and a solver of their own (srfcli.validation.slider), on a spring of
--stiffness. At the default one, alpha of 0.4 or more under amplitudes of 2 MPa and periods of 5 s or longer makes slip without
end: take 1.2e-2 MPa/um there, at which all alpha of 0.1 to 0.5, amplitudes of 0.5 to 2 MPa and periods of 0.5 to 50 s can be had.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

from srfcli.core.errors import SrfError
from srfcli.core.units import convert, same_dimension, split_quantity
from srfcli.data.experiment import read_experiment
from srfcli.data.values import Experiment
from srfcli.diagnosis.goodness_of_fit import failed_tests
from srfcli.inference.recordings import fit_recordings
from srfcli.inference.state_space import log_evidence
from srfcli.laws.registry import load_registry
from srfcli.validation.slider import Physics, Plan, Trace, move

Array = NDArray[np.float64]
SMALLEST, FEWEST = 0.005, 3  # amplitude over the mean, and periods, below which a recording shows nothing
DENSEST = 8  # samples per period, of which there must be as many
SHARE = Path(__file__).resolve().parent / "share-of-load.toml"  # load-transmission of all that the load does
FORMAT = """format = "srf-experiment/1"
title = "load oscillations"

[apparatus]
stiffness = {stiffness}

[model]
law = {law}
ageing = {ageing}
interface = "rigid"
inertia = false
effects = {effects}

[parameters]
mu0 = {{ value = {mu0:.4g}, lower = {low:.4g}, upper = {high:.4g} }}
A = {{ value = {A}, lower = 1e-4, upper = 0.1 }}
B = {{ value = {B}, lower = 1e-4, upper = 0.1 }}
D0 = {{ value = {D0}, lower = {shortest}, upper = {longest} }}
V0 = {{ value = {V0}, fixed = true }}
{cutoff}{own}
{columns}
"""
CUTOFF = "Vsat = {{ value = {0:g}, lower = {1:g}, upper = {2:g} }}\n"


@dataclass(frozen=True)
class Model:
    """One that is fitted: its ageing law, effects, the line of its own parameter, and that parameter's name."""

    name: str
    ageing: str
    effects: tuple[str, ...] = ()
    own: str = ""
    parameter: str = ""


MODELS = (
    Model("ageing law", "dieterich"),
    Model("linker-dieterich", "dieterich+linker-dieterich", (), "alpha = { value = 0.1, lower = 0.0, upper = 1.0 }", "alpha"),
    Model("nagata", "nagata", (), "c = { value = 0.5, lower = 0.0, upper = 20.0 }", "c"),
    Model("load-transmission", "dieterich", (str(SHARE),), "rho = { value = 0.9, lower = 0.0, upper = 2.0 }", "rho"),
)


@dataclass(frozen=True)
class Fitted:
    """A model's fit: log likelihood, log evidence, value and standard error by name, and what speaks against it."""

    model: Model
    log_likelihood: float
    evidence: float
    values: dict[str, tuple[float, float]]
    against: tuple[str, ...]


# ---- what a recording has to be


@dataclass(frozen=True)
class Oscillation:
    """A load's oscillation: mean and amplitude (MPa), period and onset (s), the number of its periods and samples in each."""

    mean: float
    amplitude: float
    period: float
    onset: float
    periods: float
    samples: float


def oscillation(t: Array, W: Array) -> Oscillation | None:
    """Return the sine in the normal stress W (n,), None where none has more than half of its variance once it is switched on."""
    begun = np.abs(W - np.median(W[: max(W.size // 50, 3)])) > 0.25 * np.ptp(W)
    first = int(np.argmax(begun)) if begun.any() and np.ptp(W) > 0 else W.size
    s, x = t[first:], W[first:]
    if s.size < 4 * DENSEST:
        return None
    even = np.linspace(s[0], s[-1], s.size)
    spectrum = np.abs(np.fft.rfft(signal.detrend(np.interp(even, s, x)), 8 * s.size))
    coarse = (int(np.argmax(spectrum[4:])) + 4) / (8 * s.size * (even[1] - even[0]))

    def fitted(f: float) -> tuple[float, float]:
        waves = [np.ones_like(s), s - s.mean(), np.cos(2 * np.pi * f * s), np.sin(2 * np.pi * f * s)]
        solution = np.linalg.lstsq(np.column_stack(waves), x, rcond=None)[0]
        rest = x - np.column_stack(waves) @ solution
        return float(rest @ rest), float(np.hypot(*solution[2:]))

    near = 0.5 / float(np.ptp(s))
    f = float(optimize.minimize_scalar(lambda f: fitted(f)[0], bounds=(max(coarse - near, near / 2), coarse + near)).x)
    rest, amplitude = fitted(f)
    if rest > 0.5 * float(np.sum(signal.detrend(x) ** 2)) or amplitude < SMALLEST * float(x.mean()):
        return None
    step = float(np.median(np.diff(t)))
    return Oscillation(float(x.mean()), amplitude, 1 / f, float(s[0]), f * float(np.ptp(s)), 1 / (f * step))


def check(experiment: Experiment) -> list[str]:
    """Return a line on each run's oscillation; SrfError where a run has none, too few periods or too few samples of one."""
    lines = []
    for run in experiment.runs:
        W = run.load(run.t)[0]
        found, where = oscillation(run.t, W), f"{run.file.name}: the normal stress"
        if found is None:
            raise SrfError(
                f"{where} does not oscillate: no sine has half of its variance, a scatter of {100 * np.std(W) / W.mean():.2g} %",
                "Choose the stretch that does by --window BEGIN END, and the column by --normal.",
            )
        said = f"{found.amplitude:.3g} MPa in {found.period:.4g} s"
        if found.periods < FEWEST:
            raise SrfError(
                f"{where} oscillates by {said} for {found.periods:.2g} periods; {FEWEST} are needed", "Take a longer stretch."
            )
        if found.samples < DENSEST:
            raise SrfError(
                f"{where} oscillates by {said}: {found.samples:.2g} samples a period; {DENSEST} are needed",
                "Take data that are not thinned.",
            )
        mu = float(np.median(run.observed / (1.0 if run.observable == "friction" else W)))
        if not 0.05 < mu < 1.5:
            raise SrfError(
                f"{run.file.name}: shear over normal stress is {mu:.3g}, which is no friction coefficient",
                "Are the columns of --shear and --normal the right ones, and in the right unit?",
            )
        lines.append(
            f"{run.name}: {found.mean:.4g} MPa, oscillating by {said} from {found.onset:.4g} s on for {found.periods:.1f} periods"
            f"; {run.t.size} samples, mu = {mu:.3f}"
        )
    return lines


def description(options: argparse.Namespace, model: Model, mu: float) -> str:
    """Return the text of experiment.toml for one model."""
    columns = {"time": options.time, "normal_stress": options.normal, "shear_stress": options.shear}
    if options.displacement:
        columns["load_point_displacement"] = options.displacement
    named = [f"{role} = {_column(text)}" for role, text in columns.items() if text]
    drive = "" if options.displacement else f"drive = [{{ duration = 1e9, velocity = {options.velocity!r} }}]"
    runs = []
    for number, file in enumerate(options.recordings):
        window = options.window[min(number, len(options.window) - 1)] if options.window else None
        own = {"name": f"{number + 1}-{file.stem}", "file": str(file.resolve()), "initial": options.initial}
        lines = [f"{key} = {json.dumps(value)}" for key, value in own.items()]
        lines += [f"window = {list(window)!r}"] if window else []
        runs.append("\n".join(["\n[[runs]]", *lines, drive, ""]))
    words = {"stiffness": options.stiffness, "law": options.law, "ageing": model.ageing, "effects": list(model.effects)}
    cutoff = CUTOFF.format(options.Vsat, options.Vsat / 50, options.Vsat * 50) if options.law == "srf-vsat" else ""
    text = FORMAT.format(
        **{key: json.dumps(value) for key, value in words.items()}, mu0=mu, low=mu / 2, high=2 * mu, A=options.A, B=options.B,
        D0=options.D0, shortest=options.D0 / 30, longest=options.D0 * 30, V0=options.velocity, cutoff=cutoff, own=model.own,
        columns="\n".join(["[columns]", *named]) if named else "",
    )  # fmt: skip
    return text + "".join(runs)


def _column(text: str) -> str:
    """Return a column of the description from `name` or `name [unit]`."""
    name, _, unit = text.partition("[")
    own = f", unit = {json.dumps(unit.rstrip(']').strip())}" if unit else ""
    return f"{{ name = {json.dumps(name.strip())}{own} }}"


def experiment_of(options: argparse.Namespace, model: Model, mu: float = 0.6) -> Experiment:
    """Return the recordings with one model, read as `srf fit` reads them."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "experiment.toml").write_text(description(options, model, mu), encoding="utf-8")
        return read_experiment(Path(folder), registry=load_registry())


# ---- the models against each other


def compare(options: argparse.Namespace, told: list[str] | None = None, *, models: Sequence[Model] = MODELS) -> list[Fitted]:
    """Return the fits of the models, best evidence first; what the recordings are is appended to `told`."""
    plain = experiment_of(options, MODELS[0])
    lines = check(plain)
    if told is not None:
        told += lines
    first = plain.runs[0]
    W = first.load(first.t)[0]
    mu = float(np.median(first.observed / (1.0 if first.observable == "friction" else W)))
    fits = []
    for model in models:
        print(f"{model.name} ...", file=sys.stderr, flush=True)
        found = fit_recordings(load_registry(), experiment_of(options, model, mu), track=options.track)
        if found.state_space is None:
            raise SrfError("the evidence needs a C compiler", "Install one, or the package ziglang.")
        spread = np.sqrt(np.maximum(np.diag(found.fit.covariance), 0.0))
        names = found.problem.names
        values = {n: (found.fit.values[n], float(spread[names.index(n)])) for n in names if n in found.fit.values}
        fits.append(
            Fitted(model, found.state_space.log_likelihood, log_evidence(found.state_space), values,
                   tuple(failed_tests(found.state_space)))
        )  # fmt: skip
    return sorted(fits, key=lambda f: -f.evidence)


def table(fits: Sequence[Fitted]) -> str:
    """Return the fits as text, a line each."""
    head = ("model", "log L", "log evidence", "below best", "own parameter", "mu0", "A", "B", "D0 um")
    rows = [head]
    for f in fits:
        own = f.model.parameter
        cells = [f"{own} = {shown(*f.values[own])}" if own else "-", *(shown(*f.values[n]) for n in ("mu0", "A", "B", "D0"))]
        below = fits[0].evidence - f.evidence
        rows.append((f.model.name, f"{f.log_likelihood:.1f}", f"{f.evidence:.1f}", f"{below:.1f}", *cells))
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([*lines, *(f"{f.model.name}: {f.against[0]}" for f in fits if f.against)])


def shown(value: float, error: float) -> str:
    """Return a value with its standard error in the last two digits, .0123(45)."""
    if not (np.isfinite(error) and error > 0):
        return f"{value:.4g}"
    digits = max(int(1 - np.floor(np.log10(error))), 0)
    return f"{value:.{digits}f}({round(error * 10**digits)})"


# ---- a stand-in of the same form


QUARTZ = Physics(K=6e-3, mu0=0.6, A=0.006, B=0.009, D0=8.0, V0=10.0, Vsat=50.0, rigid=True, massless=True)
NOISE = 2e-3  # MPa, of the shear stress


def stand_in(
    physics: Physics,
    *,
    normal: float = 12.0,
    amplitude: float = 0.5,
    period: float = 5.0,
    periods: int = 16,
    velocity: float = 10.0,
    steady: float = 20.0,
    seed: int = 0,
) -> tuple[Trace, Array]:
    """Return time and shear stress, and the normal stress (n,) that is imposed, MPa: steady sliding, then oscillations.

    These begin where the sine rises through 0, after `steady` s or up to a period later.
    Raises SrfError where the slider cannot be followed.
    """
    onset = (np.ceil(steady / period) + 0.75) * period
    duration = float(onset + periods * period)
    plan = Plan("oscillating", ((duration, velocity),), normal, min(period / 40, 0.05), eps=amplitude / normal, f=1 / period,
                onset=onset)  # fmt: skip
    trace = move(physics, plan)
    if not trace.complete:
        at, stiffer = float(trace.t[np.isfinite(trace.u)][-1]), 2 * physics.K
        raise SrfError(
            f"after {(at - onset) / period:.2f} periods the slider, which has no mass, slips at more than 1 m/s",
            f'Choose a stiffer spring, such as --stiffness "{stiffer:g} MPa/um", or a smaller amplitude or alpha.',
        )
    load = plan.load()
    rng = np.random.default_rng(seed)
    shear = physics.K * trace.u + NOISE * rng.standard_normal(trace.t.size)
    return replace(trace, u=shear), np.array([load(t)[0] for t in trace.t.tolist()])


def spring(text: str, *, normal: float) -> float:
    """Return a stiffness in MPa/um; one of friction over a length is multiplied by the normal stress (MPa)."""
    number, unit = split_quantity(text, name="--stiffness")
    if unit and same_dimension(unit, "1/um"):
        return convert(number, unit, "1/um", name="--stiffness") * normal
    return convert(number, unit, "N/um", name="--stiffness") if unit else number  # a stress is the force on 1 mm^2


def write_stand_in(path: Path, trace: Trace, normal: Array, velocity: float = 10.0) -> None:
    """Write the recording as a table."""
    rows = zip(trace.t.tolist(), (velocity * trace.t).tolist(), normal.tolist(), trace.u.tolist(), strict=True)
    head = "Time [s],Load point displacement [um],Normal stress [MPa],Shear stress [MPa]"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([head, *(f"{t:.4f},{x:.4f},{w:.5f},{s:.5f}" for t, x, w, s in rows)]) + "\n", encoding="utf-8")


# ---- the command line


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the parsed command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0], epilog="Columns: NAME, or NAME [unit].")
    add = parser.add_argument
    add("recordings", nargs="*", type=Path, metavar="RECORDING", help="tables of any kind that `srf` reads")
    add("--time", metavar="COLUMN", help="column of the time (default: by its heading)")
    add("--normal", metavar="COLUMN", help="column of the normal stress (default: by its heading)")
    add("--shear", metavar="COLUMN", help="column of the shear stress (default: by its heading)")
    add("--displacement", metavar="COLUMN", help="column of the load point's displacement (default: it moves at --velocity)")
    add("--velocity", type=float, default=10.0, metavar="UM/S", help="of the load point, and V0 (default: 10)")
    add("--stiffness", default="6e-3 MPa/um", help="of apparatus and layer, MPa/um, or friction per um (default: %(default)s)")
    add("--window", nargs=2, type=float, action="append", metavar=("BEGIN", "END"), help="s of the clock; for all, or each")
    add("--initial", choices=("steady", "free"), default="steady", help="whether a recording begins in steady sliding")
    add("--track", choices=("smooth", "rough"), help="friction field along slip: none, or one (default: the recording decides)")
    add("--law", choices=("dieterich-ruina", "srf-vsat"), default="srf-vsat", help="with a cut-off of age, Vsat, or without")
    for name, value, unit in (("A", 0.008, ""), ("B", 0.01, ""), ("D0", 10.0, " um"), ("Vsat", 100.0, " um/s")):
        add(f"--{name}", type=float, default=value, help=f"start value (default: {value:g}{unit})")
    add("--stand-in", type=Path, metavar="DIR", help="write a recording of the same form to DIR/oscillation.csv, and fit it")
    for name, value, what in (
        ("alpha", 0.3, "alpha"), ("c", 0.0, "Nagata's c"), ("rho", 1.0, "transmitted share"), ("amplitude", 0.5, "MPa"),
        ("period", 5.0, "s"), ("mean", 12.0, "normal stress, MPa"),
    ):  # fmt: skip
        add(f"--{name}", type=float, default=value, help=f"of the stand-in: {what} (default: {value:g})")
    options = parser.parse_args(given)
    if bool(options.recordings) == bool(options.stand_in):
        parser.error("give recordings, or --stand-in DIR")
    if options.window and len(options.window) not in (1, len(options.recordings)):
        parser.error(f"{len(options.window)} windows for {len(options.recordings)} recordings: give one for all, or one for each")
    if not options.velocity > 0:
        parser.error(f"--velocity {options.velocity:g}: the load point moves forward")
    return options


def main(given: Sequence[str] | None = None) -> int:
    """Print the table; exit code 2 for what cannot be fitted."""
    options = arguments(given)
    try:
        split_quantity(options.stiffness, name="--stiffness")
        if options.stand_in:
            K = spring(options.stiffness, normal=options.mean)
            physics = replace(QUARTZ, K=K, alpha=options.alpha, nagata=options.c, rho=options.rho)
            trace, normal = stand_in(physics, normal=options.mean, amplitude=options.amplitude, period=options.period)
            path = options.stand_in / "oscillation.csv"
            write_stand_in(path, trace, normal)
            options.recordings, options.velocity = [path], 10.0
            print(f"{path}: alpha = {options.alpha:g}, c = {options.c:g}, rho = {options.rho:g}")
        told: list[str] = []
        fits = compare(options, told)
    except SrfError as error:
        print(f"Error: {error.message}" + (f"\nTry: {error.hint}" if error.hint else ""), file=sys.stderr)
        return 2
    print("\n".join(told))
    print(table(fits))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
