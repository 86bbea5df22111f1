"""The rough track of `srf simulate`: what the options ask for, and the records laid on it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from srfcli.cli.programs import start_state
from srfcli.errors import SrfError
from srfcli.results.simulation import Job
from srfcli.units import parse_quantity

if TYPE_CHECKING:
    from srfcli.model import GeneratedModel
    from srfcli.recording.track import RoughTrack

TABLES = (("mu", "slip"),)  # what is added to which part of the model, and what it is a function of
LENGTH = 10.0  # um, the correlation length where only a size is given
LARGEST = 0.5  # of mu0: a rougher track has places that pull


def read_track(given: Mapping[str, Any]) -> RoughTrack | None:
    """Return the track that --roughness, --roughness-length and --seed ask for, None for a smooth one."""
    if given["roughness"] is None:
        if given["roughness_length"] is not None:
            raise SrfError("--roughness-length is given and the track is smooth", "Give the size: --roughness 3e-4.")
        return None
    from srfcli.recording.track import RoughTrack

    size = parse_quantity(given["roughness"], "1", name="--roughness")
    length = parse_quantity(given["roughness_length"] or str(LENGTH), "um", name="--roughness-length")
    track = RoughTrack(size, length, given["seed"])
    return track if track.size else None


def on_track(plain: GeneratedModel, rough: GeneratedModel, job: Job, track: RoughTrack, *, start: str) -> Job:
    """Return the job of the model `plain` as one of `rough`, the same with TABLES, on the part of the track that it covers.

    Positions are slip from where the run begins; runs that begin at the same place find the same track there. `start` is as
    --start has it. Raises SrfError for a roughness that the friction coefficient does not allow.
    """
    from srfcli.splines import appended

    begin = float(job.t[0])
    place = job.run.start if job.run is not None else 0.0
    p = rough.vector(dict(zip(plain.names, job.p.tolist(), strict=True)) | {"start": place, "begin": begin})
    load = job.load.rest(begin)
    _check_size(plain, job, track)
    table = track.spline(place, place + _reach(plain, job))
    state = start_state(rough, appended(p, [table]), start, drive=job.drive, load=load, begin=begin)
    return dataclasses.replace(job, p=p, start=state, tables=(table,))


def _check_size(model: GeneratedModel, job: Job, track: RoughTrack) -> None:
    if "mu0" not in model.names:
        return
    mu0 = float(job.p[model.index("mu0")])
    if not track.size <= LARGEST * mu0:
        raise SrfError(
            f"--roughness {track.size:g} is more than half of mu0 = {mu0:g}",
            "It is the standard deviation of mu0 along the track, such as 3e-4.",
        )


def _reach(model: GeneratedModel, job: Job) -> float:
    """Return how far (um) the slider may slip: what is driven, what the spring holds at first, and what it swings beyond."""
    import numpy as np

    begin, end = float(job.t[0]), float(job.t[-1])
    times = np.unique([*job.t.tolist(), *(b for b in job.drive.breaks if begin < b < end)])
    driven = np.cumsum(job.drive(0.5 * (times[1:] + times[:-1])) * np.diff(times))  # V is linear in between
    held = 0.0
    if job.start is not None and "u" in model.states:
        held = abs(float(job.start[model.states.index("u")]))
    # a spring that friction holds is drawn by less than 1.5 W/K, and swings back by less than it was drawn
    drawn = 3.0 * float(job.load(job.t)[0].max()) / float(job.p[model.index("K")])
    return max(float(driven.max()), 0.0) + 2 * held + drawn


def track_parameters(track: RoughTrack | None, given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the two options as parameters are described: value, unit and origin; nothing for a smooth track."""
    if track is None:
        return {}
    origin = "default" if given["roughness_length"] is None else "flag"
    return {
        "roughness": {"value": track.size, "unit": "1", "origin": "flag"},
        "roughness_length": {"value": track.length, "unit": "um", "origin": origin},
    }


def track_told(track: RoughTrack | None) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the note on a track and its entry in a result's meta, as `srf fit` has them; nothing for a smooth one."""
    if track is None:
        return (), {}
    note = f"track: mu0 wanders by {track.size:g} (standard deviation) over {track.length:g} um"
    return (note,), {"track": {"amplitude": track.size, "length_um": track.length}}
