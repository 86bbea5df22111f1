"""One recording, from its description and its file to a run that can be compared with a simulation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from srfcli.errors import SrfError
from srfcli.numerics.program import ConstantLoad, Drive, Load, Modulation
from srfcli.recording.columns import LIMIT, Columns, read_columns
from srfcli.recording.description import Apparatus, ColumnSpec, RunDescription
from srfcli.recording.drive import check_start, declared_drive, drive_differs, drive_from_column
from srfcli.recording.load import DIFFERS, Place, load_from_column, modulation_notices
from srfcli.recording.observable import clean_observable
from srfcli.recording.series import find_sampling, kept_samples, sampling_notices
from srfcli.recording.source import open_source
from srfcli.recording.values import OBSERVABLES, Array, Notice, Run
from srfcli.registry import Registry
from srfcli.units import is_stress, split_quantity

FORCES = ("force", "normal_load", "normal_stress")


def read_run(
    run: RunDescription,
    apparatus: Apparatus,
    specs: Mapping[str, ColumnSpec],
    *,
    registry: Registry,
    format: str | None = None,
    limit: int = LIMIT,
) -> Run:
    """Return the run in a description's data file; raises SrfError for what cannot be used."""
    try:
        source = open_source(run.file, registry=registry, format=format or run.format)
    except SrfError as error:
        if error.message.startswith("no file"):
            run.node.child("file").fail(error.message, error.hint)
        if error.message.startswith("unknown reader") and not format:
            run.node.child("format").fail(error.message, error.hint)
        raise
    columns = read_columns(run, source, specs, limit=limit)
    keep, notices = kept_samples(run.file, columns.rows, columns.seconds, columns.remarks.get("time"))
    t, rows = columns.seconds[keep], columns.rows[keep]
    arrays = {role: values[keep] for role, values in columns.arrays.items()}
    notices = [*columns.notices, *notices, *sampling_notices(run.file, rows, t, find_sampling(t))]
    drive, told = _drive(run, columns, t, arrays)
    load, weighed = _load(run, columns, rows, t, arrays)
    check_start(run, drive, float(t[0]))
    role = next(r for r in OBSERVABLES if r in arrays)
    at_start = load.rest(float(t[0]))
    stiffness = apparatus.stiffness * (at_start if apparatus.per_load else 1.0)
    rise = np.abs(drive(t)) * {"elongation": 1.0, "force": stiffness, "friction": stiffness / at_start}[role]
    place = Place(run.file, columns.channels[role].heading, rows, t)
    units = _units(run, columns, apparatus)
    if len(set(units.values())) > 1:
        named = ", ".join(f"{what} is a {'stress' if stress else 'force'}" for what, stress in units.items())
        notices.append(Notice("unit", run.file.name, f"{named}: a stress counts as the force on 1 mm^2"))
    observed, used, quantum, flaws = clean_observable(place, arrays[role], rise=rise, load=load)
    return Run(
        name=run.name,
        file=run.file,
        holdout=run.holdout,
        start=run.start,
        initial=run.initial,
        t=t,
        observed=observed,
        observable=role,
        used=used,
        drive=drive,
        load=load,
        stiffness=stiffness,
        modulation=run.modulation,
        quantum=quantum,
        notices=(*notices, *told, *weighed, *flaws),
        stress=any(units.values()),
    )


def _units(run: RunDescription, columns: Columns, apparatus: Apparatus) -> dict[str, bool]:
    """Return for each force of the run, by name, whether it is stated as a stress."""
    found = {f"'{c.heading}'": is_stress(c.unit) for c in columns.channels.values() if c.role in FORCES}
    if run.load is not None and isinstance(text := run.node.child("load").value, str):
        found["load"] = is_stress(split_quantity(text, name="load")[1] or "N")
    if not apparatus.per_load:
        found["the stiffness"] = is_stress(apparatus.stated)
    return found


def _drive(run: RunDescription, columns: Columns, t: Array, arrays: dict[str, Array]) -> tuple[Drive, list[Notice]]:
    role = next((r for r in ("load_point_velocity", "load_point_displacement") if r in arrays), "")
    where = f"{run.file.name}: column '{columns.channels[role].heading}'" if role else ""
    if run.drive is None:
        return drive_from_column(role, t, arrays[role], where)
    drive = declared_drive(run, columns, t)
    return drive, drive_differs(drive, t, arrays[role], where) if role else []


def _load(
    run: RunDescription, columns: Columns, rows: NDArray[np.int64], t: Array, arrays: dict[str, Array]
) -> tuple[Load, list[Notice]]:
    role = next((r for r in ("normal_load", "normal_stress") if r in arrays), None)
    if role is None:
        W0 = 1.0 if run.load is None else run.load
        if run.modulation is None:
            return ConstantLoad(W0), []
        f, eps, onset = run.modulation
        return Modulation(W0, eps, f, onset), []
    place = Place(run.file, columns.channels[role].heading, rows, t)
    load, notices = load_from_column(place, arrays[role])
    first = load.rest(float(t[0]))
    if run.load is not None and abs(run.load - first) > DIFFERS * first:
        run.node.child("load").fail(
            f"the load is {run.load:g} N, but {place.column} begins with {first:g} N", "Take one of the two away."
        )
    if run.modulation is not None:
        notices += modulation_notices(place, run.modulation, arrays[role])
    return load, notices
