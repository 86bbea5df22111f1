"""`srf compare`: the stability diagrams of several laws, each brought to the same observables at one low velocity."""

from __future__ import annotations

import functools
import itertools
import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.options import (
    APPARATUS,
    LOADINGS,
    OutputOptions,
    SrfCommand,
    check_origins,
    open_registry,
    output_options,
    values_option,
)
from srfcli.cli.ranges import Range, over_option
from srfcli.cli.workers import Spread, worker_options
from srfcli.laws import Parameter
from srfcli.settings import Resolved, Setting, TomlSettings, choose, find_toml, load_toml, parse_assignment, resolve
from srfcli.status import Status

if TYPE_CHECKING:
    from srfcli.model import GeneratedModel
    from srfcli.numerics.compare import LawStudy, Window
    from srfcli.numerics.comparematch import Match, Observables

EXAMPLES = """
srf compare --law srf-vsat --law log-log --law bowden-tabor --eps 0.18 --plot laws.svg
srf compare --ageing dieterich --ageing ruina --ageing dieterich+linker-dieterich --eps 0.09,0.18
srf compare --law srf-vsat --law log-log --eps 0.18 --workers 2 --json
"""
AMPLITUDE = Parameter("eps", 0.18, "1", 0.0, 0.999999, "relative modulation amplitudes")


def _common(function: Callable[..., None]) -> Callable[..., None]:
    """Add the options that choose laws, all of them repeatable, and the apparatus, the same for all."""
    options = [
        click.option("--law", "laws", multiple=True, metavar="NAME", help="A friction law; repeat for more."),
        click.option(
            "--ageing", "ageings", multiple=True, metavar="NAME", help="An ageing law; repeat: all pairs count."
        ),
        click.option(
            "--interface", metavar="NAME", help="Tangential compliance of the interface, the same for all laws."
        ),
        click.option("--loading", type=click.Choice(LOADINGS), help="How the normal load is applied."),
        click.option(
            "--inertia/--no-inertia", default=None, help="Whether the slider's mass counts.  [default: it does]"
        ),
        *(click.option(f"--{n}", f"set_{n}", metavar="VALUE", help=about) for n, about in APPARATUS.items()),
        click.option(
            "--set",
            "assignments",
            multiple=True,
            metavar="NAME=VALUE",
            help="Set a parameter of every law that has it.",
        ),
        click.option(
            "--plugins", multiple=True, type=click.Path(exists=True, path_type=Path), help="Take laws from here, too."
        ),
    ]
    for option in reversed(options):
        function = option(function)
    return function


@click.command("compare", cls=SrfCommand, epilog=EXAMPLES)
@_common
@values_option(AMPLITUDE, default=(0.18,))
@click.option(
    "--at", default="10", show_default=True, metavar="V", help="Velocity (um/s) at which laws are brought together."
)
@click.option(
    "--adjust", default="A,B,D0", show_default=True, help="The three parameters adjusted, with mu0 where there is one."
)
@click.option(
    "--match/--no-match", "matched", default=True, show_default=True, help="Whether parameters are adjusted at all."
)
@over_option(help="The window: V=LOW:HIGH[:POINTS] and K/W0=LOW:HIGH[:POINTS], each of which may be left out.")
@worker_options
@output_options
def command(
    laws: tuple[str, ...],
    ageings: tuple[str, ...],
    eps: tuple[float, ...],
    at: str,
    adjust: str,
    matched: bool,
    over: tuple[Range, ...],
    spread: Spread,
    output: OutputOptions,
    **system: Any,
) -> None:
    """Laws side by side: where re-entrance begins, what modulation destabilises, and where an experiment tells them apart.

    The first law is the reference. Every other one is brought to its friction, slope, critical load and critical period at one
    low velocity, so that what differs is the law and not its calibration.
    """
    from srfcli.cli.compare_rows import COLUMNS, compare_figure, law_meta, law_notes, law_rows, sentences
    from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
    from srfcli.errors import SrfError
    from srfcli.numerics.compare import LawTask, read_study, study_law
    from srfcli.output.tables import Table

    largest = sorted({e for e in eps if e > 0})
    if not largest:
        raise SrfError("--eps 0 leaves nothing to compare", "Give an amplitude above 0: --eps 0.18.")
    thirds = [largest[-1] / 3, 2 * largest[-1] / 3] if len(largest) == 1 else []
    amplitudes = tuple(sorted({0.0, *thirds, *largest}))
    begun = time.perf_counter()
    names, models, resolved = _models(laws, ageings, system)
    goal, matches = _matches(names, models, resolved, _velocity(at), tuple(adjust.split(",")), matched)
    window = _window(models[0], matches[0].p, goal, over)
    warn_uncompiled("boundaries take about twice as long")
    usable = [k for k, m in enumerate(matches) if m.status.ok]
    tasks = [LawTask(models[k].source, models[k].key, matches[k].p, amplitudes, window) for k in usable]
    studies: dict[int, LawStudy] = {}
    with Progress("compare", total=len(tasks)) as progress:
        try:
            for place, arrays in spread.run(study_law, tasks):
                studies[usable[place]] = read_study(arrays)
                progress.advance(note=names[usable[place]])
        except KeyboardInterrupt:
            if not studies:
                raise
            left = [k for k in usable if k not in studies]
            matches = [replace(m, status=Status.INTERRUPTED) if k in left else m for k, m in enumerate(matches)]
    pairs, said = sentences(names, models, matches, studies, amplitudes, window)
    described = {n: v for n, v in resolved[0].described().items() if n not in ("V", "W0", "eps")}
    rows, worst = law_rows(names, matches, studies, amplitudes, largest, window)
    notes = (*law_notes(names, models, matches, goal, window), *said)
    meta = law_meta(names, models, matches, goal, pairs)
    table = Table("srf.compare/1", COLUMNS, rows, f"{len(names)} laws", notes, described, meta, worst.value)
    figure = functools.partial(
        compare_figure, names, studies, amplitudes, window, float(matches[0].p[models[0].index("K")]), matched
    )
    every = tuple(law for model in models for law in model.laws)
    emit(table, output, laws=dict.fromkeys(every), timings={"all": time.perf_counter() - begun}, figure=figure)
    finish(Status(table.status))


def _velocity(text: str) -> float:
    from srfcli.units import parse_quantity

    return parse_quantity(text, "um/s", name="--at")


def _models(
    laws: tuple[str, ...], ageings: tuple[str, ...], system: dict[str, Any]
) -> tuple[list[str], list[GeneratedModel], list[Resolved]]:
    """Return names, models and parameters of every pair of a friction and an ageing law."""
    from srfcli.errors import SrfError
    from srfcli.model import open_model

    toml = load_toml(find_toml())
    chosen = {k: choose(k, system[k], toml=toml) for k in ("interface", "loading", "inertia")}
    chosen |= {k: choose(k, None, toml=toml) for k, given in (("law", laws), ("ageing", ageings)) if not given}
    check_origins(toml, chosen)
    shared = {k: chosen[k].value for k in ("interface", "loading", "inertia")}
    named = (*chosen.values(), *(Setting(name, "flag") for name in (*laws, *ageings)))
    laws, ageings = laws or (chosen["law"].value,), ageings or (chosen["ageing"].value,)
    pairs = list(dict.fromkeys(itertools.product(laws, ageings)))
    if len(pairs) < 2:
        raise SrfError("one law is nothing to compare", "Name more: --law srf-vsat --law log-log, or several --ageing.")
    folders = [Path(p) for p in os.environ.get("SRF_PLUGINS", "").split(os.pathsep) if p]
    registry = open_registry((*system["plugins"], *folders), named)
    models = [open_model(registry, law=law, ageing=ageing, **shared) for law, ageing in pairs]
    short = len(set(ageings)) == 1, len(set(laws)) == 1
    names = [law if short[0] else ageing if short[1] else f"{law}/{ageing}" for law, ageing in pairs]
    return names, models, _resolved(models, system, toml)


def _resolved(models: list[GeneratedModel], system: dict[str, Any], toml: TomlSettings) -> list[Resolved]:
    """Return every model's parameters; an assignment counts for the models that have its parameter, and one must."""
    from srfcli.errors import SrfError, did_you_mean

    flags = {n: system[f"set_{n}"] for n in APPARATUS if system[f"set_{n}"] is not None}
    for text in system["assignments"]:
        name, value = parse_assignment(text)
        flags[name] = value
    known = {n for m in models for n in m.names}
    for name in flags:
        if name not in known:
            raise SrfError(f"unknown parameter {name!r} in all of these laws", did_you_mean(name, known))
    return [
        resolve(m.parameters, {n: v for n, v in flags.items() if n in m.names}, toml=toml, where=m.title)
        for m in models
    ]


def _matches(
    names: list[str],
    models: list[GeneratedModel],
    resolved: list[Resolved],
    at: float,
    adjust: tuple[str, ...],
    matched: bool,
) -> tuple[Observables, list[Match]]:
    """Return the reference's observables, and every law's parameters brought to them."""
    from srfcli.errors import SrfError
    from srfcli.numerics.comparematch import Match, check_adjusted, match, observe

    vectors = [m.vector(r.values) for m, r in zip(models, resolved, strict=True)]
    for model, p in zip(models, vectors, strict=True):
        model.check_changing_load(p)
    goal = observe(models[0], vectors[0], at)
    if goal is None:
        raise SrfError(
            f"{names[0]} has no critical load at {at:g} um/s: there is nothing to bring the others to",
            "Name another law first, or another velocity with --at.",
        )
    for model in models:
        check_adjusted(model, adjust)
    found = [Match(vectors[0], (), 0.0, Status.OK)]
    for model, p in zip(models[1:], vectors[1:], strict=True):
        found.append(match(model, p, goal, adjust) if matched else Match(p, (), math.nan, Status.OK))
    return goal, found


def _window(model: GeneratedModel, p: Any, goal: Observables, over: tuple[Range, ...]) -> Window:
    """Return the window that --over describes; loads from half to sixteen times the critical one where it says nothing."""
    from srfcli.cli.map_axes import read_axis
    from srfcli.cli.ranges import DEFAULT_POINTS
    from srfcli.errors import SrfError
    from srfcli.numerics.compare import Window

    K = float(p[model.index("K")])
    parts: dict[str, Any] = {"V": (1.0, 100.0), "W0": (0.5 * goal.W0, 16.0 * goal.W0)}
    for given in over:
        axis = read_axis(model, given)
        counts = {} if given.n == DEFAULT_POINTS else {"columns" if axis.name == "V" else "rows": given.n}
        if axis.name == "V":
            parts |= {"V": (axis.lo, axis.hi), **counts}
        elif axis.name == "K/W0":
            parts |= {"W0": (K / axis.hi, K / axis.lo), **counts}
        else:
            raise SrfError(f"--over {axis.name} is not an axis of the comparison", "Its plane is V against K/W0.")
    if not (parts["V"][0] > 0 and parts["W0"][0] > 0):
        raise SrfError("--over begins at 0", "The window is logarithmic: begin above 0.")
    return Window(**parts)
