"""What a user types, to um, s, N: worked conversions, refusals, and the table without pint."""

from __future__ import annotations

import builtins
import math
from collections.abc import Callable
from typing import Any

import pytest

from srfcli.core import units
from srfcli.core.errors import SrfError
from srfcli.core.units import convert, find_unit, from_base, parse_quantity, to_base
from srfcli.laws.registry import bundled_registry


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("0.21", "N/um", 0.21),
        ("0.21 N/um", "N/um", 0.21),
        ("210 N/mm", "N/um", 0.21),
        ("210000 N/m", "N/um", 0.21),
        ("2.37kg", "kg", 2.37),
        ("2370 g", "kg", 2.37),
        ("1e-3 1/um", "1/um", 1e-3),
        ("  -7.5e+1  ", "1", -75.0),
        ("0.4 µm", "um", 0.4),
        ("0.4 μm", "um", 0.4),
        ("400 nm", "um", 0.4),
        ("1 mm/s", "um/s", 1000.0),
        ("30 deg", "rad", math.pi / 6),
        ("0.5 turn", "deg", 180.0),
        ("120 1/s", "Hz", 120.0),
        ("18 %", "1", 0.18),
        ("1 kg*m/s^2", "N", 1.0),
        (".5 kN", "N", 500.0),
        ("1.5 MPa/mm", "N/um", 1.5e-3),
        ("20 MPa", "N", 20.0),
        ("200 bar", "MPa", 20.0),
        ("5 N", "MPa", 5.0),
        ("3 microns", "um", 3.0),
        ("2 inch/s", "um/s", 50800.0),
    ],
)
def test_a_quantity_is_read_in_the_declared_unit(text: str, unit: str, value: float) -> None:
    assert parse_quantity(text, unit, name="x") == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "unit", "said"),
    [
        ("", "N", "is not a number"),
        ("nan", "N", "is not a number"),
        ("inf", "N", "is not a number"),
        ("1e999", "N", "too large"),
        ("one", "N", "is not a number"),
        ("0,21", "N/um", "decimal comma"),
        ("3 kg", "N/um", "'kg' measures s^2"),
        ("3 deg", "1", "'deg' measures rad, not 1"),
        ("3 turn", "1", "'turn' measures rad, not 1"),
        ("3 parsnips", "N", "unknown unit 'parsnips'"),
        ("3 K", "N", "not a mechanical unit"),
        ("3 degC", "N", "'degC'"),
        ("3 9**9**9**9", "N", "is not a unit"),
        ("3 N; import os", "N", "is not a unit"),
        ("3 m^0.5", "N", "is not a unit"),
        ("1_0", "N", "unit"),
    ],
)
def test_a_bad_quantity_is_one_sentence_with_a_way_out(text: str, unit: str, said: str) -> None:
    with pytest.raises(SrfError) as caught:
        parse_quantity(text, unit, name="x")
    assert said in caught.value.message
    assert caught.value.message.startswith("x = ")
    assert "\n" not in caught.value.message
    assert caught.value.hint and caught.value.exit_code == 2


def test_base_units() -> None:
    assert to_base(2.37, "kg") == pytest.approx(2.37e-6, rel=1e-15)
    assert to_base(180, "deg") == pytest.approx(math.pi, rel=1e-15)
    assert to_base(1, "MPa") == pytest.approx(1e-6, rel=1e-14)  # N/um^2


@pytest.mark.parametrize("unit", ["1", "um", "s", "N", "N/um", "um/s", "1/um", "1/s", "Hz", "kg", "rad", "deg", "N*s/m", "g"])
def test_to_base_and_back(unit: str) -> None:
    assert from_base(to_base(0.37, unit), unit) == pytest.approx(0.37, rel=4e-16)


@pytest.mark.parametrize("unit", [u for u in units._TABLE if u != "1"])
def test_the_table_agrees_with_pint(unit: str) -> None:
    found = units._from_pint({"rev": "turn", "rpm": "turn/min"}.get(unit, unit.replace("Nm", "N*m")), "", unit)
    assert found.powers == find_unit(unit).powers or unit in ("Hz", "kHz")
    # pint counts a hertz as 2 pi rad/s or as 1/s, by version; here it is 1/s, as the modulation frequency f is
    if unit not in ("Hz", "kHz"):
        assert found.factor == pytest.approx(find_unit(unit).factor, rel=1e-14)


def test_conversion_keeps_round_numbers() -> None:
    assert convert(210.0, "N/mm", "N/um", name="K") == 0.21


def _refuse_pint(real: Callable[..., Any]) -> Callable[..., Any]:
    def fake(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "pint":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    return fake


def test_without_pint_the_table_works_and_the_rest_says_how(monkeypatch: pytest.MonkeyPatch) -> None:
    units._pint_registry.cache_clear()
    monkeypatch.setattr(builtins, "__import__", _refuse_pint(builtins.__import__))
    assert parse_quantity("210 N/mm", "N/um", name="K") == 0.21
    assert parse_quantity("1 kg*m/s^2", "N", name="W0") == pytest.approx(1.0, rel=1e-14)
    with pytest.raises(SrfError) as caught:
        parse_quantity("210 lbf/inch", "N/um", name="K")
    assert 'pip install "srfcli[units]"' in str(caught.value.hint)


def test_every_shipped_law_and_effect_is_read_without_pint(monkeypatch: pytest.MonkeyPatch) -> None:
    registry = bundled_registry()
    shipped = [registry.load(e) for kind in ("friction", "ageing", "effect") for e in registry.entries(kind)]
    asked = {p.unit for law in shipped for p in law.parameters}
    assert len(asked) > 5
    monkeypatch.setattr(builtins, "__import__", _refuse_pint(builtins.__import__))
    for unit in asked:
        find_unit(unit)
