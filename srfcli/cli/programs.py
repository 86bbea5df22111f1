"""What `srf simulate` is told in words: pieces of drive and load, sampling rates, the state to start from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from srfcli.errors import SrfError, did_you_mean
from srfcli.units import convert, split_quantity

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from srfcli.model import GeneratedModel
    from srfcli.numerics.program import Drive

    Array = NDArray

MOST_SAMPLES = 10_000_000
FEW_SAMPLES, MANY_SAMPLES, USUAL_RATE = 1000, 100_000, 1000.0  # what --rate is without being given
TRAVEL = 40.0  # um of driving where nothing says how long
LARGEST = 1e9  # um/s
LONGEST = 1e12  # s


@dataclass(frozen=True)
class Piece:
    """A stretch of `duration` seconds over which a quantity runs straight from `first` to `last`."""

    duration: float
    first: float
    last: float


def parse_pieces(text: str, unit: str, *, option: str, example: str) -> tuple[Piece, ...]:
    """Return the pieces of '0.5:12, 4:8' or '1:5->7', values in `unit` unless one is written.

    Raises SrfError that names the option and the piece.
    """
    parts = [part.strip() for part in text.split(",")]
    if not any(parts):
        raise SrfError(f"{option} is empty", f"Write {option} '{example}'.")
    return tuple(_parse_piece(part, i + 1, unit, option, example) for i, part in enumerate(parts))


def _parse_piece(part: str, number: int, unit: str, option: str, example: str) -> Piece:
    where = f"{option}: piece {number}, {part!r},"
    duration_text, colon, values_text = part.partition(":")
    ends = [end.strip() for end in values_text.split("->")]
    if not colon or not duration_text.strip() or not all(ends) or len(ends) > 2:
        raise SrfError(f"{where} is not DURATION:VALUE or DURATION:FROM->TO", f"Write {option} '{example}'.")
    duration = _number(duration_text, "s", f"{option}: the duration of piece {number}")
    if not 0 < duration <= LONGEST:
        raise SrfError(f"{where} lasts {duration:g} s", f"Give each piece a duration above 0, up to {LONGEST:g} s.")
    split = [split_quantity(end, name=f"{option}: the value of piece {number}", example=f"5 {unit}") for end in ends]
    written = next((u for _, u in reversed(split) if u), unit)
    values = [convert(v, u or written, unit, name=f"{option}: piece {number}") for v, u in split]
    return Piece(duration, values[0], values[-1])


def _number(text: str, unit: str, name: str) -> float:
    value, written = split_quantity(text, name=name, example=f"0.5 {unit}")
    return convert(value, written or unit, unit, name=name)


def edges_of(pieces: Sequence[Piece], start: float) -> list[float]:
    """Return the times (s) at which the pieces begin, and the time at which the last ends."""
    edges = [start]
    for piece in pieces:
        edges.append(edges[-1] + piece.duration)
    return edges


def build_drive(pieces: Sequence[Piece], start: float) -> Drive:
    """Return the driving velocity that the pieces (s, um/s) make, one after another from `start` on."""
    from srfcli.numerics.program import Drive

    for number, piece in enumerate(pieces, 1):
        if max(abs(piece.first), abs(piece.last)) > LARGEST:
            fastest = max(piece.first, piece.last, key=abs)
            raise SrfError(f"--drive: piece {number} drives at {fastest:g} um/s", f"Stay within {LARGEST:g} um/s.")
    rates = tuple((p.last - p.first) / p.duration for p in pieces)
    return Drive(tuple(edges_of(pieces, start)[:-1]), tuple(p.first for p in pieces), rates)


def parse_rates(text: str, pieces: int) -> tuple[float, ...]:
    """Return the samples per second in each of so many pieces: one for all, or one for each."""
    rates = tuple(_number(part, "Hz", "--rate") for part in text.split(","))
    if not all(0 < rate <= 1e9 for rate in rates):
        raise SrfError(f"--rate {text}: a rate lies between 0 and 1e9 Hz", "Write --rate 1000.")
    if len(rates) not in (1, pieces):
        raise SrfError(
            f"--rate {text} gives {len(rates)} rates for {pieces} piece{'s' if pieces != 1 else ''} of the drive",
            "Give one rate, or one for each piece: --rate 100,1,1000.",
        )
    return rates * pieces if len(rates) == 1 else rates


def usual_rate(duration: float, frequency: float | None) -> float:
    """Return the sampling rate where none is given: 1, 2 or 5 times a power of ten, in Hz.

    1000 Hz, more for a record below a second and to see the modulation ten times a period, less beyond 100,000 samples.
    """
    wanted = max(USUAL_RATE, FEW_SAMPLES / duration, 10 * frequency if frequency else 0.0)
    if wanted * duration > MANY_SAMPLES:
        return _round_rate(MANY_SAMPLES / duration, up=False)
    return _round_rate(wanted, up=True)


def _round_rate(rate: float, *, up: bool) -> float:
    power = math.floor(math.log10(rate))
    steps = [float(f"{m}e{power}") for m in (1, 2, 5, 10)]
    if up:
        return next((s for s in steps if s >= rate * (1 - 1e-12)), steps[-1])
    return next((s for s in reversed(steps) if s <= rate * (1 + 1e-12)), steps[0])


def sample_times(pieces: Sequence[Piece], rates: Sequence[float], start: float) -> Array:
    """Return the times (s) of the samples, the first at `start`, the last at or just before the end of the last piece.

    Raises SrfError where they are fewer than two or more than ten million.
    """
    import numpy as np

    total = sum(p.duration * rate for p, rate in zip(pieces, rates, strict=True))
    if total > MOST_SAMPLES:
        size = f"{total:.3g} samples, {total * 64 / 1e9:.2g} GB"
        raise SrfError(f"--rate asks for {size}; {MOST_SAMPLES:.0e} is the limit", "Lower --rate, or split the record.")
    if total < 1:
        raise SrfError(
            f"--rate gives only one sample in {sum(p.duration for p in pieces):g} s",
            f"Raise it: --rate {_round_rate(10 / sum(p.duration for p in pieces), up=True):g}.",
        )
    edges = edges_of(pieces, start)
    blocks = []
    for a, b, rate in zip(edges[:-1], edges[1:], rates, strict=True):
        steps = np.arange(math.floor((b - a) * rate * (1 + 1e-12)) + 1)
        times = a + steps / rate
        blocks.append(times[times < b - 1e-9 / rate] if b != edges[-1] else np.minimum(times, b))
    digits = 15 - math.ceil(math.log10(max(abs(edges[0]), abs(edges[-1]))))  # 0.507, not 0.5070000000000001
    return np.unique(np.round(np.concatenate(blocks), min(12, max(digits, 0))))


def start_state(model: GeneratedModel, p: Array, text: str, *, drive: Drive, load: float, begin: float) -> Array | None:
    """Return the state (n,) that --start names, None for steady sliding at the drive's first velocity.

    'steady', a velocity at which sliding was steady, or values such as 'v=1e-3, phi=100 s' over those of steady sliding.
    `load` (N) is the load at rest at the time `begin` (s). Raises SrfError where the drive does not move at first.
    """
    import numpy as np

    q = np.array(p, dtype=float)
    q[model.index("W0")] = load
    first = float(drive(np.array([begin]))[0])
    if text.strip().lower() == "steady":
        if first <= 0:
            moving = next((v for v in drive.velocities if v > 0), 10.0)
            raise SrfError(
                f"the drive begins at {first:g} um/s: there is no steady sliding to start from",
                f"Say what went before: --start {moving:g} for steady sliding at {moving:g} um/s, "
                "or begin --drive with a piece that moves.",
            )
        return None
    if "=" not in text:
        q[model.index("V")] = _start_velocity(text)
        return np.asarray(model.steady(q), dtype=float)
    q[model.index("V")] = next((v for v in (first, *drive.velocities) if v > 0), 10.0)
    return _with_values(model, np.array(model.steady(q), dtype=float), text)


def _start_velocity(text: str) -> float:
    try:
        V = _number(text, "um/s", "--start")
    except SrfError as error:
        raise SrfError(f"--start {text!r} is neither steady, nor a velocity, nor values", error.hint) from error
    if not 1e-12 <= V <= LARGEST:
        raise SrfError(f"--start {text}: sliding is steady from 1e-12 to {LARGEST:g} um/s", "Write --start 10.")
    return V


def _with_values(model: GeneratedModel, x: Array, text: str) -> Array:
    plain = [name.removeprefix("ln_") for name in model.states]
    for part in text.split(","):
        name, _, value = (word.strip() for word in part.partition("="))
        if name not in plain:
            raise SrfError(f"--start: {name!r} is no state of {model.title}", did_you_mean(name, plain))
        unit = {"u": "um", "z": "um/s", "v": "um/s"}.get(name, "s")
        number, i = _number(value, unit, f"--start: {name}"), plain.index(name)
        if model.logarithmic[i] and not number > 0:
            raise SrfError(f"--start: {name} = {number:g} {unit} is not above 0", f"Write --start {name}=1e-6.")
        x[i] = math.log(number) if model.logarithmic[i] else number
    return x
