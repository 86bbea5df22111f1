"""docs/columns.md lists every column that a command writes, in the unit in which it is written."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import srfcli as srf

ROOT = Path(__file__).resolve().parents[1]
LISTED = re.findall(r"^\| `(\w+)` \| ([^|]+) \| (.+) \|$", (ROOT / "docs" / "columns.md").read_text(encoding="utf-8"), re.M)
UNITS = {name: {u for n, u, _ in LISTED if n == name} for name, _, _ in LISTED}


def literal(node: ast.expr | None) -> str | None:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def columns() -> Iterator[tuple[str, str | None, str]]:
    """Yield name, unit and place of every column that the package names in so many letters."""
    for folder in ("cli", "results", "validation"):
        for path in sorted((ROOT / "srfcli" / folder).glob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Column":
                    name = literal(node.args[0])
                    if name is not None:
                        yield name, literal(node.args[1]) if len(node.args) > 1 else "1", f"{path.name}:{node.lineno}"


def test_every_column_is_listed_in_its_unit() -> None:
    found = list(columns())
    assert len(found) > 150
    assert not [f"{place}: {name}" for name, _, place in found if name not in UNITS]
    stated = [(name, unit or "-", place) for name, unit, place in found if unit is not None]
    assert not [f"{place}: {name} [{unit}]" for name, unit, place in stated if unit not in UNITS[name]]


def test_nothing_is_listed_that_is_not_written() -> None:
    written = {name for name, _, _ in columns()} | {"growth_per_slip", "growth_rate"}
    assert not [name for name in UNITS if name not in written]


@pytest.mark.parametrize("task", ["linear", "critical", "floquet", "map", "over"])
def test_tables_of_stability_keep_one_order(task: str) -> None:
    """What is looked at, in the order of the page, then other parameters, then what was found."""
    slider = srf.system(eps=0.13, V=7, W0=9)
    made = {
        "linear": lambda: srf.linear(slider, over={"V": [7], "D0": [0.4]}),
        "critical": lambda: srf.critical(slider, window=(9, 12)),
        "floquet": lambda: srf.floquet(slider),
        "map": lambda: srf.map(slider, x=("V", 7, 8, 2), y=("K/W0", 0.02, 0.03, 2), boundaries=False),
        "over": lambda: srf.map(slider, x=("D0", 0.4, 0.5, 2), y=("W0", 7, 8, 2), boundaries=False),
    }
    table = made[task]().table
    names = [c.name for c in table.columns]
    assert set(names) <= UNITS.keys() | {"D0"}
    place = ["eps", "component", "crossing", "type", "V", "K_over_W0", "W0", "D0", "Omega_c", "theta", "status"]
    order = [n for n in place if n in names]
    assert task == "floquet" or names[: len(order)] == order
    assert all(c.unit in UNITS[c.name] for c in table.columns if c.name in UNITS and c.unit not in ("", "1"))
