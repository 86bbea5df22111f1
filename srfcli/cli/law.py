"""`srf laws` and `srf law`: what laws there are; show one, write a new one, check one."""

from __future__ import annotations

import difflib
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from srfcli.cli import emit
from srfcli.cli.base import EXIT_USAGE, SrfCommand, SrfGroup
from srfcli.cli.options import open_registry, plugins_option
from srfcli.core.errors import ExpressionError, SrfError
from srfcli.core.files import recover, write_atomic
from srfcli.laws.law_file import FORMULA, PLUGIN_KINDS, formula_of, kind_of, template, valid_name
from srfcli.laws.values import Effect, Law
from srfcli.results.tables import Column, Table, plain_value

if TYPE_CHECKING:
    from srfcli.laws.registry import Registry

# `srf laws`: what laws there are.

KIND = click.Choice(PLUGIN_KINDS)
PARAMETER_KEYS = ("default", "unit", "lower", "upper", "about")  # of `srf law show --json`
LAW_KIND = click.Choice(PLUGIN_KINDS[:-1])  # a reader is no law

EPILOG = """
srf laws                            every law, where it comes from and what it is
srf laws --kind ageing              one kind
srf laws --plugins .                also the laws in the current folder
srf laws --json | jq .rows          for a program
"""


@click.command(cls=SrfCommand, epilog=EPILOG)
@click.option("--kind", type=KIND, help="One kind of law only, or the readers of data files.")
@click.option("--json", "as_json", is_flag=True, help="JSON on stdout.")
@plugins_option
def laws(kind: str | None, as_json: bool, plugins: tuple[Path, ...]) -> None:
    """List all registered laws, without importing them."""
    registry = open_registry(plugins)
    emit.show(laws_table(registry, kind), "json" if as_json else "text")
    for problem in registry.problems:
        click.echo(f"Not listed ({problem.origin}): {problem.message}", err=True)


def laws_table(registry: Registry, kind: str | None) -> Table:
    """Return the listing as a table; a law that shares its name with another says so in the column `clash`."""
    columns = [
        Column("kind", "", "friction, ageing, modifier, interface, effect or reader"), Column("name", "", "as options take it"),
        Column("origin", "", "bundled, a folder or a package"), Column("about", "", "one sentence"),
        Column("location", "", "file"), Column("clash", "", "other files of that name"),
    ]  # fmt: skip
    rows: list[tuple[Any, ...]] = []
    for e in registry.entries(kind):
        if kind is None and e.kind == "reader":
            continue  # not a law: listed on request
        others = ", ".join(str(other.location) for other in registry.clashes(e))
        rows.append((e.kind, e.name, e.origin, e.about, str(e.location), others or None))
    if not any(row[-1] for row in rows):
        columns, rows = columns[:-1], [row[:-1] for row in rows]
    problems = [{"name": p.name, "origin": p.origin, "location": p.location, "message": p.message} for p in registry.problems]
    return Table("srf.laws/1", tuple(columns), rows, meta={"problems": problems})


# `srf law`: show a law, write a new one, check one.

LAW_EPILOG = """
srf law show srf-vsat               formula, parameters, references
srf law new my-law                  write my-law.toml, ready to be changed
srf law check my-law.toml           check it
srf linear --law my-law --plugins . its critical load
"""
SHOW_EPILOG = """
srf law show srf-vsat
srf law show my-law.toml
srf law show dieterich --json
"""
NEW_EPILOG = """
srf law new my-law
srf law new my-ageing --kind ageing --python
srf law new my-effect --kind effect
"""
CHECK_EPILOG = """
srf law check my-law.toml
srf law check dieterich-cutoff
"""


@click.group(cls=SrfGroup, epilog=LAW_EPILOG)
def law() -> None:
    """Show, write and check laws."""


@law.command(cls=SrfCommand, epilog=SHOW_EPILOG)
@click.argument("name")
@click.option("--kind", type=LAW_KIND, help="Which one, where two kinds of law share a name.")
@click.option("--json", "as_json", is_flag=True, help="JSON on stdout.")
@plugins_option
def show(name: str, kind: str | None, as_json: bool, plugins: tuple[Path, ...]) -> None:
    """Show formula, parameters and references of a law; NAME may be a file."""
    found = _find(open_registry(plugins), name, kind)
    if as_json:
        documents = [_document(one) for one in found]
        click.echo(json.dumps({"schema": "srf.law/1", "laws": documents}, indent=2, allow_nan=False))
    else:
        click.echo("\n\n".join(_text(one) for one in found))


@law.command(cls=SrfCommand, epilog=NEW_EPILOG)
@click.argument("name")
@click.option("--kind", type=LAW_KIND, default="friction", help="What kind of law.")
@click.option("--python", is_flag=True, help="Write a Python file in place of TOML.")
@click.option("--force", is_flag=True, help="Overwrite a file, or take a name that a law already has.")
def new(name: str, kind: str, python: bool, force: bool) -> None:
    """Write a commented law into the current folder; it passes `srf law check` as it is."""
    from srfcli.laws.registry import bundled_registry

    if not valid_name(name):
        raise SrfError(f"{name!r} is not a law name: small letters, digits and single dashes", "srf law new my-law")
    if not force and any(entry.name == name for entry in bundled_registry().entries(kind)):
        raise SrfError(f"there is a shipped {kind} law '{name}'; two of one name cannot be used", f"srf law new my-{name}")
    path = Path(name + (".py" if python else ".toml"))
    recover(path)
    if path.exists() and not force:
        raise SrfError(f"{path} exists", "Give --force to overwrite it, or another name.")
    write_atomic(path, template(kind, name, python=python))
    click.echo(str(path))
    click.echo(f"Next: srf law check {path}" + _use(kind, name), err=True)


def _use(kind: str, name: str) -> str:
    """Return the command that shows a new law at work, after a semicolon; an effect has no stability analysis of its own."""
    use = {"friction": f"--law {name}", "ageing": f"--ageing {name}", "interface": f"--interface {name}"}
    option = use.get(kind, f"--ageing dieterich+{name}")
    return "" if kind == "effect" else f"; srf linear {option} --plugins ."


@law.command(cls=SrfCommand, epilog=CHECK_EPILOG)
@click.argument("name", metavar="FILE|NAME")
@click.option("--kind", type=LAW_KIND, help="Which one, where two kinds of law share a name.")
@plugins_option
@click.pass_context
def check(ctx: click.Context, name: str, kind: str | None, plugins: tuple[Path, ...]) -> None:
    """Check a law: parses, units, steady state, mu_v > 0, derivatives, worked values. Exit 2 if one fails.

    Of an effect: parses, units, a neutral value at which the model is the baseline, derivatives.
    """
    from srfcli.tasks.law_check import Outcome, check_law

    registry = open_registry(plugins)
    try:
        outcomes = [outcome for one in _find(registry, name, kind) for outcome in check_law(one)]
    except SrfError as error:
        if not (name.endswith((".toml", ".py")) and Path(name).is_file()):
            raise
        caret = error.caret() if isinstance(error, ExpressionError) else None
        text = "\n".join(part for part in (error.message, caret, f"Try: {error.hint}" if error.hint else None) if part)
        outcomes = [Outcome("parses", "FAIL", text)]
    for outcome in outcomes:
        click.echo(f"{outcome.verdict:7}  {outcome.check:13}  {outcome.text}")
    if any(outcome.verdict == "FAIL" for outcome in outcomes):
        ctx.exit(EXIT_USAGE)


def _find(registry: Registry, name: str, kind: str | None) -> list[Law]:
    """Return the laws in a file, or those of a name in any kind, or in one kind."""
    from srfcli.laws.registry import read_file

    if name.endswith((".toml", ".py")):
        found = [one for one in read_file(Path(name)) if kind in (None, kind_of(one))]
        if not found:
            raise SrfError(f"{name}: holds no law of kind {kind}")
        return found
    kinds = sorted({e.kind for e in registry.entries(kind) if e.name == name})
    if not kinds:
        broken = [problem for problem in registry.problems if problem.name == name]
        if broken:
            raise SrfError(broken[0].message, broken[0].hint)
        raise SrfError(f"unknown law '{name}'", _nearest(registry, name, kind))
    return [registry.get(k, name) for k in kinds]


def _nearest(registry: Registry, name: str, kind: str | None) -> str:
    """Return what the name may have meant, and all names of that one kind."""
    kinds = [kind] if kind else sorted({e.kind for e in registry.entries() if e.kind != "reader"})
    by_name = {e.name: e.kind for k in kinds for e in registry.entries(k)}
    close = difflib.get_close_matches(name, by_name, n=1, cutoff=0.5)
    if not close:
        return f"`srf laws` lists the laws of every kind: {', '.join(kinds)}."
    found = by_name[close[0]]
    listed = ", ".join(sorted(e.name for e in registry.entries(found)))
    return f"Did you mean '{close[0]}'? Known of kind {found}: {listed}"


def _document(one: Law) -> dict[str, Any]:
    """Return all that a law's or an effect's file says as plain data."""
    from srfcli.laws.effect_file import formula_text

    checks = [{"quantity": c.quantity, "at": dict(c.at), "value": c.value, "rtol": c.rtol} for c in one.checks]
    if isinstance(one, Effect):
        states = [
            {"name": s.name, "rate": formula_text(s.rate), "steady": formula_text(s.steady), "logarithmic": s.logarithmic}
            for s in one.states
        ]
        own = {
            "changes": {slot: formula_text(formula) for slot, formula in one.written or one.changes},
            "states": states,
            "neutral": dict(one.neutral),
            "constants": {c.name: {"value": c.default, "unit": c.unit, "about": c.about} for c in one.constants},
            "settings": dict(one.settings),
            "frees": list(one.frees),
            "needs": list(one.needs),
            "lacks": list(one.lacks),
            "observed": one.observed or None,
            "reported": one.reported,
        }
    else:
        formula = formula_of(one)
        states = [{"name": s.name, "length": s.length, "weight": s.weight} for s in getattr(one, "states", ())]
        own = {FORMULA[kind_of(one)]: None if formula is None else str(formula), "states": states}
    found = {
        "name": one.name, "kind": kind_of(one), "about": one.about, **own,
        "parameters": {p.name: {key: getattr(p, key) for key in PARAMETER_KEYS} for p in one.parameters},
        "cites": list(one.cites), "checks": checks, "source": one.source,
    }  # fmt: skip
    return plain_value(found)


def _text(one: Law) -> str:
    """Return the same for a reader."""
    from srfcli.laws.effect_file import formula_text, summary

    if isinstance(one, Effect):
        own = summary(one).split("; ")
        own += [f"{s.name} = {formula_text(s.steady)} in steady sliding" for s in one.states]
        own += [f"{c.name} = {c.default:g} {c.unit}" + (f", {c.about}" if c.about else "") for c in one.constants]
        own += [f"the baseline has {name} = {value:g}" for name, value in one.neutral]
        own += [f"for laws with {', '.join(one.needs)}"] if one.needs else []
        own += [f"for models without {', '.join(one.lacks)}"] if one.lacks else []
        own += [f"reported as {one.reported}"] if one.reported != one.name else []
    else:
        formula = formula_of(one)
        own = [f"{FORMULA[kind_of(one)]} = {'rigid' if formula is None else formula}"]
        own += [f"state {s.name}: length {s.length}, weight {s.weight}" for s in getattr(one, "states", ())]
    lines = [f"{one.name}  ({kind_of(one)})", one.about, "", *own]
    if one.parameters:
        lines += ["", *_parameter_lines(one)]
    if one.cites:
        lines += ["", *(f"[{number}] {cite}" for number, cite in enumerate(one.cites, 1))]
    return "\n".join([*lines, "", f"from {one.source}"])


def _parameter_lines(one: Law) -> list[str]:
    rows = []
    for p in one.parameters:
        bounds = "" if math.isinf(p.lower) and math.isinf(p.upper) else f"[{p.lower:g}, {p.upper:g}]"
        rows.append((p.name, f"{p.default:.15g}", p.unit, bounds, p.about))
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    return ["  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[-1]]).rstrip() for row in rows]
