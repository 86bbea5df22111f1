"""The tables of `srf check`: all columns for programs, rounded ones that fit a page for readers, and everything for JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from srfcli.output.tables import Column, Table

if TYPE_CHECKING:
    from srfcli.inference.reach import Forecast, Reach
    from srfcli.recording.checks import RunCheck
    from srfcli.recording.noise import Noise

COLUMNS = (
    Column("run"),
    Column("holdout", about="never touches a fit"),
    Column("samples", about="samples with a time of their own"),
    Column("used", about="samples that are compared"),
    Column("duration", "s"),
    Column("rate_low", "Hz", "lowest sampling rate"),
    Column("rate_high", "Hz", "highest sampling rate"),
    Column("gaps"),
    Column("spikes", about="samples of the observable flagged as spikes"),
    Column("resets", about="transducers set anew"),
    Column("observable"),
    Column("unit", about="of the readings: um, N, MPa or 1"),
    Column("lowest", about="smallest reading that is compared, in the observable's unit"),
    Column("highest", about="largest one"),
    Column("noise", about="standard deviation about the trend, in the observable's unit"),
    Column("lag1", about="correlation from sample to sample"),
    Column("white", about="white level, in the observable's unit"),
    Column("quantum", about="quantisation step, 0 for none"),
    Column("V_low", "um/s"),
    Column("V_high", "um/s"),
    Column("W_mean", "N"),
    Column("W_low", "N"),
    Column("W_high", "N"),
    Column("W_rate", "1/s", "largest |d ln W/dt|"),
    Column("f", "Hz", "frequency of a modulation that was found"),
    Column("eps", about="its amplitude over the mean load"),
    Column("onset", "s", "when it passes half its amplitude"),
    Column("alpha_error", about="smallest error of alpha from this run alone, inf where it tells nothing"),
    Column("lambda_error", about="the same of lambda, relative"),
    Column("n_error", about="the same of the exponent of the interface's stiffness"),
    Column("alpha_peak", about="the most that alpha = 0.2 changes and nothing else can, over the noise of a sample"),
    Column("lambda_peak", about="the same for a change of lambda by 10 %"),
    Column("n_peak", about="the same for a change of n by 0.1"),
)
Cells = Mapping[str, Any]
CHANGES = {"alpha": "0.2 makes", "lambda": "10 % makes", "n": "0.1 makes"}


def row(check: RunCheck, told: Reach | None) -> tuple[Any, ...]:
    """Return the cells of one run under COLUMNS."""
    import numpy as np

    run, load, rates = check.run, check.load, [1 / r.interval for r in check.sampling.rates]
    read, found = run.observed[run.used], load.modulation
    found_out = {} if told is None else {"error": told.errors, "peak": told.peaks}
    cells = {
        "run": run.name, "holdout": run.holdout, "samples": run.t.size, "used": int(run.used.sum()),
        "duration": float(np.ptp(run.t)), "rate_low": min(rates), "rate_high": max(rates),
        "gaps": int(check.sampling.gaps.size), "spikes": check.spikes, "resets": check.count("reset"),
        "observable": run.quantity, "unit": run.unit, "lowest": float(read.min()), "highest": float(read.max()),
        "noise": check.noise.total, "lag1": check.noise.lag1, "white": check.noise.white, "quantum": run.quantum,
        "V_low": check.slowest, "V_high": check.fastest,
        "W_mean": load.mean, "W_low": load.lowest, "W_high": load.highest, "W_rate": load.rate,
        "f": found.frequency if found else None, "eps": found.amplitude if found else None,
        "onset": found.onset if found and math.isfinite(found.onset) else None,
        **{f"{name}_{key}": found_out.get(key, {}).get(name) for name in CHANGES for key in ("error", "peak")},
    }  # fmt: skip
    return tuple(cells[column.name] for column in COLUMNS)


def report(rows: Sequence[Sequence[Any]], forecast: Forecast | None, *, load_unit: str = "N") -> list[Table]:
    """Return the rows as tables no wider than a page, rounded: samples, readings, what was imposed, what the load can tell."""
    cells = [{c.name: cell for c, cell in zip(COLUMNS, r, strict=True)} for r in rows]
    shown = {
        title: {heading.replace("[N]", f"[{load_unit}]"): of for heading, of in columns.items()}
        for title, columns in SHOWN.items()
    }
    tables = [_shown(title, columns, cells) for title, columns in shown.items()]
    return tables if forecast is None else [*tables, _told(forecast)]


def _shown(title: str, columns: Mapping[str, Callable[[Cells], Any]], rows: Sequence[Cells]) -> Table:
    return Table(
        "srf.check.text/1", tuple(map(Column, columns)), [[of(r) for of in columns.values()] for r in rows], title
    )


def _digits(name: str, digits: int) -> Callable[[Cells], Any]:
    return lambda r: rounded(r[name], digits)


def rounded(value: Any, digits: int) -> Any:
    """Return a number with so many significant digits, as an integer where it is one; anything else as it is."""
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    short = float(f"{value:.{digits}g}")
    return int(short) if short.is_integer() and abs(short) < 1e15 else short


def _range(low: float, high: float, digits: int) -> Any:
    ends = [rounded(x, digits) for x in (low, high)]
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"


SHOWN: dict[str, dict[str, Callable[[Cells], Any]]] = {
    "Samples": {
        "run": lambda r: r["run"],
        "held out": lambda r: r["holdout"],
        "samples": lambda r: r["samples"],
        "used": lambda r: r["used"],
        "duration [s]": _digits("duration", 6),
        "rate [Hz]": lambda r: _range(r["rate_low"], r["rate_high"], 4),
        "gaps": lambda r: r["gaps"],
        "spikes": lambda r: r["spikes"],
        "resets": lambda r: r["resets"],
    },
    "Readings": {
        "run": lambda r: r["run"],
        "observable": lambda r: r["observable"] + (f" [{r['unit']}]" if r["unit"] != "1" else ""),
        "lowest": _digits("lowest", 5),
        "highest": _digits("highest", 5),
        "noise": _digits("noise", 3),
        "lag1": lambda r: None if r["lag1"] is None else round(r["lag1"], 2) + 0.0,
        "white": _digits("white", 3),
        "quantum": _digits("quantum", 3),
    },
    "Imposed": {
        "run": lambda r: r["run"],
        "V [um/s]": lambda r: _range(r["V_low"], r["V_high"], 5),
        "W [N]": lambda r: _range(r["W_low"], r["W_high"], 5),
        "mean W [N]": _digits("W_mean", 5),
        "W'/W [1/s]": _digits("W_rate", 3),
        "f [Hz]": _digits("f", 6),
        "eps": _digits("eps", 4),
        "onset [s]": _digits("onset", 4),
    },
}


def _told(forecast: Forecast) -> Table:
    known = [name for name in CHANGES if any(name in r.errors for r in forecast.runs)]
    told = [*forecast.runs, *([forecast.together] if forecast.together else [])]
    cells = [
        [r.name, _percent(math.expm1(r.variation)), *(c for name in known for c in _errors(r, name))] for r in told
    ]
    headings = [heading for name in known for heading in (f"{name} error", CHANGES[name])]
    title = "What the load can tell at best: errors, and what a change makes, over the noise of a sample"
    return Table("srf.check.text/1", tuple(map(Column, ["run", "load varies", *headings])), cells, title)


def _errors(told: Reach, name: str) -> tuple[str, str]:
    error = told.errors[name]
    if math.isinf(error):
        return "untold", "-"
    return _percent(error) if name == "lambda" else f"{error:.2g}", str(rounded(told.peaks[name], 2))


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def described(check: RunCheck, told: Reach | None) -> dict[str, Any]:
    """Return everything that was found in a run."""
    run, load = check.run, check.load
    return {
        "run": run.name,
        "file": str(run.file),
        "stiffness": run.stiffness,
        "sampling": [
            {"first": float(run.t[r.first]), "last": float(run.t[r.last]), "interval": r.interval}
            for r in check.sampling.rates
        ],
        "gaps": [[float(run.t[g]), float(run.t[g + 1])] for g in check.sampling.gaps.tolist()],
        "noise": [{"interval": r.interval, "first": float(run.t[r.first]), **_noise(n)} for r, n in check.noises]
        or [_noise(check.noise)],
        "friction_noise": check.friction_noise,
        "drive": [{"from": a, "velocity": v, "acceleration": s} for a, v, s in check.drive],
        "load": {"mean": load.mean, "low": load.lowest, "high": load.highest, "rate": load.rate},
        "modulation": None
        if load.modulation is None
        else {
            "frequency": load.modulation.frequency,
            "amplitude": load.modulation.amplitude,
            "onset": load.modulation.onset,
        },
        "declared_modulation": run.modulation,
        "tells": None if told is None else tells(told),
        "notices": [{"kind": n.kind, "where": n.where, "what": n.what} for n in run.notices],
    }


def tells(told: Reach) -> dict[str, Any]:
    """Return what one run or several can tell: errors that are infinite are null."""
    simulation = {"status": told.status.value, "misfit": told.misfit, "believed": told.believed}
    return {
        "variation": told.variation,
        "errors": dict(told.errors),
        "peaks": dict(told.peaks),
        "simulation": simulation,
    }


def _noise(noise: Noise) -> dict[str, Any]:
    return {"level": noise.total, "lag1": noise.lag1, "white": noise.white, "samples": noise.samples}
