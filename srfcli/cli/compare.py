"""`srf compare`: the stability diagrams of several laws, each brought to the same observables at one low velocity."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli.base import SrfCommand
from srfcli.cli.options import (
    APPARATUS,
    LOADINGS,
    OutputOptions,
    Range,
    Spread,
    check_origins,
    open_registry,
    output_options,
    over_option,
    values_option,
    worker_options,
)
from srfcli.core.settings import (
    Parameter,
    Resolved,
    Setting,
    TomlSettings,
    choose,
    find_toml,
    load_toml,
    parse_assignment,
    resolve,
)

if TYPE_CHECKING:
    from srfcli.codegen.model import GeneratedModel
    from srfcli.codegen.slider import SlidingSystem

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
    from srfcli.cli.emit import Progress, emit, finish, warn_uncompiled
    from srfcli.tasks.map import compare

    begun = time.perf_counter()
    sliders = _sliders(laws, ageings, system)
    window = _window(next(iter(sliders.values())).model, over)
    warn_uncompiled("boundaries take about three times as long")
    with Progress("compare") as progress:
        found = compare(
            sliders, eps=eps, at=_velocity(at), adjust=adjust.split(","), matched=matched, **window, run=spread.run,
            progress=lambda name, share: progress.advance(note=name, share=share),
        )  # fmt: skip
    every = dict.fromkeys(law for slider in sliders.values() for law in slider.model.laws)
    emit(found.table, output, laws=every, timings={"all": time.perf_counter() - begun}, figure=found.plot)
    finish(found.status)


def _velocity(text: str) -> float:
    from srfcli.core.units import parse_quantity

    return parse_quantity(text, "um/s", name="--at")


def _sliders(laws: tuple[str, ...], ageings: tuple[str, ...], system: dict[str, Any]) -> dict[str, SlidingSystem]:
    """Return a system for every pair of a friction and an ageing law, by a name that tells them apart."""
    from srfcli.codegen.model import open_model
    from srfcli.codegen.slider import SlidingSystem
    from srfcli.core.errors import SrfError

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
    resolved = _resolved(models, system, toml)
    return {n: SlidingSystem(m, r) for n, m, r in zip(names, models, resolved, strict=True)}


def _resolved(models: list[GeneratedModel], system: dict[str, Any], toml: TomlSettings) -> list[Resolved]:
    """Return every model's parameters; an assignment counts for the models that have its parameter, and one must."""
    from srfcli.core.errors import SrfError, did_you_mean

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


def _window(model: GeneratedModel, over: tuple[Range, ...]) -> dict[str, Any]:
    """Return the window that --over describes, and how many points it has, as the task takes them."""
    from srfcli.cli.map import read_axis
    from srfcli.cli.options import DEFAULT_POINTS
    from srfcli.core.errors import SrfError

    parts: dict[str, Any] = {"points": {}}
    for given in over:
        axis = read_axis(model, given)
        if axis.name not in ("V", "K/W0"):
            raise SrfError(f"--over {axis.name} is not an axis of the comparison", "Its plane is V against K/W0.")
        parts["V" if axis.name == "V" else "K_over_W0"] = (axis.lo, axis.hi)
        if given.n != DEFAULT_POINTS:
            parts["points"]["columns" if axis.name == "V" else "rows"] = given.n
    return parts
