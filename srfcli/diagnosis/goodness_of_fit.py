"""What speaks against a fitted model: tests of its innovations.

Under the right model the standardised innovations are white noise of variance 1 in every run and every stretch, the random
friction field has one amplitude in all runs, and one that a track may have, and the gauge is not louder than differences of its
readings. Durbin and Koopman 2012.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from srfcli.codegen.model import Array
from srfcli.inference.critical_loads import MIN_P_VALUE, chi2_p_value
from srfcli.inference.fit import fit_problem
from srfcli.inference.noise import difference_level, stretches
from srfcli.inference.state_space import (
    LAGS,
    MAX_DEVIATION,
    NOT_CONVERGED,
    Filtered,
    Likelihood,
    Point,
    StateSpaceFit,
    correlated,
    segments,
    typical_friction,
)

# amplitude of a random friction field over mu beyond which it is not the track's: ten times a polished one
MAX_FIELD_AMPLITUDE = 3e-3
STEADY_VARIATION = 2.0  # gauge's noise: a stretch whose readings are expected to vary by less is one of steady sliding
CORRELATED_INNOVATIONS = "innovations are correlated"
GAUGE_LEVELS = ("gauge_white", "gauge_colour")
MAX_NOISE_RATIO = 1.15  # gauge noise over that of differences, and held-out innovations, beyond which they hold something else
LEVEL_GAIN, LEVELS_TOLD = 5.0, 6  # in log likelihood for each level, from where it is told, and how many are
# share of readings that repeat the one before where a step is four times white noise; at six values are off
MAX_REPEATED_SHARE = 0.72
# relative variance, times n, of a level that n uncorrelated numbers tell, and third differences: (1 + 2 sum rho^2) / 2
LEVEL_VARIANCE, THIRD_DIFFERENCE_VARIANCE = 0.5, 1.16


def failed_tests(found: StateSpaceFit) -> list[str]:
    """Return what speaks against a fit: sentences, the worst first; none where it passes every test."""
    point, values = found.maximum.point, found.values
    if not np.isfinite(point.log_likelihood) or found.maximum.away > NOT_CONVERGED:
        return ["the fit did not converge"]
    tests: list[tuple[float, str]] = []
    for f in point.runs:
        for number in range(len(f.run.signals)):
            tests += _signal_tests(found, f, number)
        if not found.smooth and "field_amplitude" in f.names:
            k = f.names.index("field_amplitude")
            information = float(f.information[k, k])
            if information > 0:
                off = abs(float(f.score[k])) / np.sqrt(information)
                tests.append((off / MAX_DEVIATION, f"the field is of another amplitude in {f.run.name}"))
    tests += _critical_load_tests(found)
    tests.append((correlated(point) / MAX_DEVIATION, CORRELATED_INNOVATIONS))
    tests.append((relative_field_amplitude(found), f"the field's amplitude is {values.get('field_amplitude', 0.0):.2g}"))
    tests += gauge_noise_tests(found.likelihood, point)
    return [text for size, text in sorted(tests, reverse=True) if size > 1.0]


def uneven_noise(found: StateSpaceFit) -> list[str]:
    """Return what to try where innovations of one run are larger and those of another smaller than the noise that both share."""
    groups: dict[str, list[tuple[float, str]]] = {}
    for f in found.maximum.point.runs:
        off = (float(f.white @ f.white) - f.white.size) / np.sqrt(2 * f.white.size)
        groups.setdefault(found.likelihood.problem.noise_group(f.run), []).append((off, f.run.name))
    for (least, quiet), (most, loud) in ((min(runs), max(runs)) for runs in groups.values()):
        if least < -MAX_DEVIATION and most > MAX_DEVIATION:
            return [f"{loud} is louder and {quiet} quieter than the noise that both share: --vary noise gives each its own"]
    return []


def own_levels(found: StateSpaceFit) -> list[str]:
    """Return what to try where the random friction field stands for a level of friction that each run has of its own.

    Each run's mean field is taken for its level, and what is left for the field, as rough as before: variance over length cubed
    stays. What the likelihood is there a fit with levels reaches or exceeds.
    """
    problem, states = found.likelihood.problem, found.likelihood.problem.model.states
    if found.smooth or len(problem.runs) < 2 or "mu0" not in problem.names or "mu0" in problem.experiment.vary:
        return []
    fields = {name: smoothed[:, states.index("field")] for name, smoothed in found.smoothed_states.items()}
    levels = {name: float(field.mean()) for name, field in fields.items()}
    within, between = np.sqrt(np.mean([field.var() for field in fields.values()])), np.std(list(levels.values()))
    if not within < between:
        return []
    experiment = replace(problem.experiment, vary={**problem.experiment.vary, "mu0": "run"})
    listed = {q.name for q in problem.experiment.parameters}
    free = [name for name in dict.fromkeys(n.partition("[")[0] for n in problem.names) if name in listed]
    likelihood = found.likelihood.beside(
        fit_problem(problem.model, experiment, free=free, trend=problem.trend, stability=problem.stability)
    )
    share, values = float(within / np.hypot(within, between)), found.values
    values = values | {f"mu0[{name}]": values["mu0"] + level for name, level in levels.items()}
    values |= {"field_amplitude": share * values["field_amplitude"], "field_length": share ** (2 / 3) * values["field_length"]}
    gain = likelihood.at(likelihood.coordinates(values), slopes=False).log_likelihood - found.log_likelihood
    if not gain > LEVEL_GAIN * (len(levels) - 1):
        return []
    told = ", ".join(f"{level:+.2g} in {name}" for name, level in list(levels.items())[:LEVELS_TOLD])
    told += ", ..." if len(levels) > LEVELS_TOLD else ""
    by = "" if experiment.by == "run" else ":run"
    said = "most of the friction field is a level of each run's own"
    return [f"{said} ({told}), which gains {gain:.0f} or more in log likelihood: --vary mu0{by}"]


def coarse_readings(found: StateSpaceFit) -> list[str]:
    """Return what to say of gauges whose readings are rounded to steps that noise does not blur: rounding is no noise then."""
    runs = found.likelihood.problem.runs
    rounded = [(run.name, s) for run in runs for s in run.signals if s.quantum]
    repeats = [(name, np.mean(np.abs(np.diff(s.observed[s.used])) < 0.5 * s.quantum)) for name, s in rounded]
    coarse = list(dict.fromkeys(name for name, share in repeats if share > MAX_REPEATED_SHARE))
    if not coarse:
        return []
    steps = "are rounded to steps of more than four times the noise: values may be off by several of their errors"
    return [f"readings of {', '.join(coarse)} {steps}"]


def relative_field_amplitude(found: StateSpaceFit) -> float:
    """Return the amplitude of a fit's random friction field over the largest that a track may have; 0 without a field."""
    if found.smooth:
        return 0.0
    friction = max(float(np.median([typical_friction(f.run) for f in found.maximum.point.runs])), 1e-6)
    return found.values["field_amplitude"] / friction / MAX_FIELD_AMPLITUDE


def noise_is_implausible(found: StateSpaceFit) -> bool:
    """Return whether field or gauge noise has taken up more than either can be, or the field is as long as it may be: a trend."""
    if relative_field_amplitude(found) > 1 or any(
        size > 1 for size, _ in gauge_noise_tests(found.likelihood, found.maximum.point)
    ):
        return True
    at = -1 if found.smooth else found.likelihood.names.index("field_length")
    return not found.smooth and bool(found.maximum.point.x[at] >= found.likelihood.upper[at])


def gauge_noise_tests(likelihood: Likelihood, point: Point) -> list[tuple[float, str]]:
    """Return how loud each kind of gauge noise is, over what third differences of the recordings allow, in words."""
    levels: dict[str, list[tuple[float, float, int]]] = {}
    tests = []
    for f in point.runs:
        rate, gauges = f.run.sampling.at, iter(likelihood.gauges(f.run))
        for signal, k in product(f.run.signals, range(len(f.run.sampling.spacings))):
            here = signal.used & (rate == k)
            seen = difference_level(signal.observed, stretches(f.run.t, here))
            levels.setdefault(next(gauges)["gauge_white"], []).append((max(seen, 1e-300), signal.quantum, int(here.sum())))
    for name, shown in levels.items():
        quantum = max(q for _, q, _ in shown) / np.sqrt(12)
        for seen, _, n in shown:
            ratio = float(np.hypot(point.values[name], quantum)) / seen
            tests.append(
                (
                    noise_ratio_over_limit(ratio, n, THIRD_DIFFERENCE_VARIANCE),
                    f"the gauge's noise is {ratio:.2f} times what the recording shows",
                )
            )
    return tests


def noise_ratio_over_limit(ratio: float, n: int, variance: float = LEVEL_VARIANCE) -> float:
    """Return a level over that of noise, over its limit, MAX_NOISE_RATIO or 1 + MAX_DEVIATION standard errors, if more."""
    return ratio / max(MAX_NOISE_RATIO, 1 + MAX_DEVIATION * float(np.sqrt(variance / max(n, 1))))


def _signal_tests(found: StateSpaceFit, f: Filtered, number: int) -> list[tuple[float, str]]:
    """Return the tests of one signal of a run: how far each is from what noise would give, over what is allowed, in words."""
    signal, white = f.run.signals[number], f.parts[number]
    name = f"{signal.observable} of {f.run.name}" if number else f.run.name
    n = white.size
    off = abs(float(np.sum(white**2)) - n) / np.sqrt(2 * n)
    tests = [(off / MAX_DEVIATION, f"innovations of {name} have an rms of {np.sqrt(np.mean(white**2)):.3f}")]
    owns = found.likelihood.gauges(f.run, number)
    gauges = [[found.values[n] for local, n in own.items() if local.startswith(GAUGE_LEVELS)] for own in owns]
    level = np.linalg.norm(np.array(gauges), axis=1)[f.run.sampling.at][signal.used]
    expected = (signal.observed - f.of(number).nu)[signal.used]
    for piece, y, noise in zip(segments(white), segments(expected), segments(level), strict=True):
        m = piece.size
        loud = (float(np.sum(np.clip(piece, -6, 6) ** 2)) - m) / np.sqrt(2 * m)
        shifted = abs(float(np.sum(piece))) / np.sqrt(m)
        if np.std(y) < STEADY_VARIATION * np.mean(noise):
            loud *= _autocorrelated_share(piece)
        tests.append((max(loud, shifted) / (MAX_DEVIATION + 1.0), f"a stretch of {name} is off"))
    return tests


def _critical_load_tests(found: StateSpaceFit) -> list[tuple[float, str]]:
    """Return tests of the critical loads: chi2 of all, less what was fitted to them, and each table's largest residual."""
    tables = found.maximum.point.tables
    if not tables:
        return []
    size, fitted = sum(t.white.size for t in tables), 0.0
    for t in tables:  # the share of each parameter that the loads determine is a degree of freedom less
        unit = found.likelihood.unit(found.maximum.point.x)
        fitted += float(np.trace(t.information * np.outer(unit, unit) @ found.maximum.covariance))
    cost = sum(t.match.cost for t in tables)
    freedom = max(size - fitted, 1.0)
    tests = [(relative_surprisal(cost, freedom), f"critical loads have chi2 {cost:.1f} on {freedom:.0f} degrees of freedom")]
    for t in tables:
        worst = int(np.argmax(np.abs(t.white)))
        line, residual = t.loads.table.lines[worst], float(abs(t.white[worst]))
        tests.append(
            (residual / MAX_DEVIATION, f"the critical load of line {line} of {t.loads.name} is {residual:.1f} sigma off")
        )
    return tests


def relative_surprisal(cost: float, freedom: float) -> float:
    """Return the logarithm of the chance of a chi2 of critical loads over that of MIN_P_VALUE: above 1 it is none."""
    chance = chi2_p_value(cost, freedom)
    return float(np.log(max(chance, 1e-300)) / np.log(MIN_P_VALUE))


def _autocorrelated_share(white: Array) -> float:
    """Return how much of the variance beyond 1 in a stretch of innovations (m,) goes on from sample to sample, from 0 to 1.

    In steady sliding all of it does where the model is off; a burst of noise leaves innovations that are loud and white.
    """
    c = np.clip(white, -6, 6)
    power = float(c @ c) / c.size
    if power <= 1:
        return 0.0
    after = [float(c[k:] @ c[:-k]) / c.size for k in range(1, LAGS + 1)]
    return min(float(np.sqrt(np.mean(np.square(after)))) / (power - 1), 1.0)
