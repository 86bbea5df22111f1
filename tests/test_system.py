"""Every kind of system: its linear stability and all its derivatives, held against each other."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest

from srfcli.core.errors import SrfError
from srfcli.laws.law_file import template
from srfcli.laws.registry import bundled_registry
from srfcli.symbolic.system import build_system

REGISTRY = bundled_registry()
LAWS = [e.name for e in REGISTRY.entries("friction")]
AGEINGS = [e.name for e in REGISTRY.entries("ageing")]
AGEINGS += [f"{AGEINGS[i % len(AGEINGS)]}+{e.name}" for i, e in enumerate(REGISTRY.entries("modifier"))]
INTERFACES = [e.name for e in REGISTRY.entries("interface")]
EVERY = list(product(LAWS, AGEINGS, INTERFACES, ("vertical", "inclined"), (True, False)))
H = 1e-30


def sample() -> list[tuple[Any, ...]]:
    """Return few systems that hold every law, ageing law and interface, and those two by two with loading and inertia."""
    found = []
    for i in range(8):
        interface, loading, inertia = INTERFACES[i % 4], ("vertical", "inclined")[i // 4], (i % 4 + i // 4) % 2 == 1
        found.append((LAWS[i % len(LAWS)], AGEINGS[i % len(AGEINGS)], interface, loading, inertia))
    return found


def names(case: tuple[Any, ...]) -> dict[str, Any]:
    return dict(zip(("law", "ageing", "interface", "loading", "inertia"), case, strict=True))


def label(case: tuple[Any, ...]) -> str:
    return "-".join(str(part) for part in case)


CASES = [pytest.param(case, id=label(case)) for case in sample()]


def test_sample_holds_everything() -> None:
    assert all(len({(case[i], case[j]) for case in sample()}) == n for i, j, n in ((2, 3, 8), (2, 4, 8), (3, 4, 4)))
    for i, kind in enumerate((LAWS, AGEINGS, INTERFACES, ("vertical", "inclined"), (True, False))):
        assert {case[i] for case in sample()} == set(kind)


def point(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return a state near, not at, steady sliding, and parameters."""
    p = model.vector({"V": 7.0, "W0": 8.0, "eps": 0.2})
    x = np.array(model.steady(p), dtype=float)
    return x + 0.05 * np.cos(np.arange(1, x.size + 1)), p


def agree(found: Any, expected: Any, *, tol: float = 1e-9, scale: float = 0.0) -> None:
    """Compare to `tol` of each entry; what cancels to rounding within the whole, or within `scale`, is let pass."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    assert np.isfinite(expected).all()
    floor = 1e-12 * max(np.abs(expected).max(), scale)
    assert np.all(np.abs(found - expected) <= tol * np.abs(expected) + floor)


def step_state(function: Callable[[Any], Any], x: np.ndarray) -> np.ndarray:
    """Return d function/dx by complex step, the derivative's axis last."""
    columns = []
    for i in range(x.size):
        y = x.astype(complex)
        y[i] += 1j * H
        columns.append(np.imag(function(y)) / H)
    return np.stack(columns, axis=-1)


def step_parameter(function: Callable[[Any], Any], p: np.ndarray, i: int) -> np.ndarray:
    q: list[Any] = list(p)
    q[i] = complex(q[i], H)
    return np.imag(function(q)) / H


@pytest.mark.parametrize("case", CASES)
def test_characteristic_roots_are_eigenvalues(case: tuple[Any, ...], make_model: Callable[..., Any]) -> None:
    model = make_model(**names(case))
    for V in (0.3, 12.0, 90.0):
        p = model.vector({"V": V, "W0": 9.0})
        jacobian = model.rates_jacobian(model.steady(p), V, 9.0, 0.0, p)
        with mpmath.workdps(30):  # the matrices are stiff: double precision would blur the small eigenvalues
            eigenvalues = mpmath.eig(mpmath.matrix(jacobian.tolist()), left=False, right=False)
            coefficients = [mpmath.mpf(float(c)) for c in model.characteristic(p)[::-1]]
            roots = mpmath.polyroots(coefficients, maxsteps=500, extraprec=100)
            assert len(roots) == len(eigenvalues) == len(model.states)
            for root in roots:
                nearest = min(eigenvalues, key=lambda e: abs(e - root))
                assert abs(root - nearest) <= 1e-10 * abs(root)


@pytest.mark.slow
def test_every_combination(make_model: Callable[..., Any]) -> None:
    """Half an hour: the two identities for each of some seven hundred systems."""
    for case in EVERY:
        test_characteristic_roots_are_eigenvalues(case, make_model)
        test_steady_is_steady(case, make_model)


@pytest.mark.parametrize("case", CASES)
def test_steady_is_steady(case: tuple[Any, ...], make_model: Callable[..., Any]) -> None:
    model = make_model(**names(case))
    p = model.vector({"V": 3.0, "W0": 9.0})
    x = model.steady(p)
    assert np.abs(model.rates(x, 3.0, 9.0, 0.0, p)).max() < 1e-8
    K = p[model.index("K")]
    assert model.elongation(x, 3.0, 9.0, 0.0, p) * K == pytest.approx(9.0 * model.steady_friction(p), rel=1e-12)
    assert model.cycle_load(0.25, x, p) == pytest.approx(9.0, rel=1e-12)  # W0 is the load in steady sliding, at any angle


@pytest.mark.parametrize("case", CASES)
def test_state_derivatives(case: tuple[Any, ...], make_model: Callable[..., Any]) -> None:
    model = make_model(**names(case))
    x, p = point(model)
    n = x.size
    w, a, b, c = (np.sin(np.arange(k, k + n)) for k in (1.0, 2.5, 4.0, 5.5))
    W0 = p[model.index("W0")]
    drive = (7.0, 8.5, 40.0)
    agree(model.rates_jacobian(x, *drive, p), step_state(lambda y: model.rates(y, *drive, p), x))
    agree(model.cycle_jacobian(0.3, x, p), step_state(lambda y: model.cycle(0.3, y, p), x))
    agree(model.cycle_bilinear(0.3, x, p, w, a), step_state(lambda y: w @ model.cycle_jacobian(0.3, y, p) @ a, x))
    calm = step_state(lambda y: model.rates_jacobian(y, 7.0, W0, 0.0, p) @ a, x)
    agree(model.second(x, p, a, b), calm @ b, scale=np.abs(calm).max())
    curved = step_state(lambda y: model.second(y, p, a, b), x)
    agree(model.third(x, p, a, b, c), curved @ c, scale=np.abs(curved).max())


@pytest.mark.parametrize("case", CASES)
def test_parameter_derivatives(case: tuple[Any, ...], make_model: Callable[..., Any]) -> None:
    model = make_model(**names(case))
    x, p = point(model)
    w, a = np.sin(np.arange(1.0, x.size + 1)), np.cos(np.arange(2.0, x.size + 2))
    y = x.astype(complex)  # the result has the type of x
    size = np.abs(model.cycle(0.3, x, p)).max(), np.abs(model.cycle_jacobian(0.3, x, p)).max()
    for i, name in enumerate(model.names):
        field, jacobian = (s / max(abs(p[i]), 1e-3) for s in size)  # what a change of the parameter by itself may do
        found = model.cycle_parameter(name)(0.3, x, p)
        agree(found, step_parameter(lambda q: model.cycle(0.3, y, q), p, i), scale=field)
        mixed = w @ step_parameter(lambda q: model.cycle_jacobian(0.3, y, q), p, i) @ a
        agree(model.cycle_bilinear_parameter(name)(0.3, x, p, w, a), mixed, scale=jacobian)


def test_cycle_is_rates_over_one_period(model: Any) -> None:
    x, p = point(model)
    f, W0, eps = (p[model.index(n)] for n in ("f", "W0", "eps"))
    angle = 2 * np.pi * 0.3
    load, rate = W0 * (1 + eps * np.cos(angle)), -2 * np.pi * f * W0 * eps * np.sin(angle)
    agree(model.cycle(0.3, x, p), model.rates(x, 7.0, load, rate, p) / f)


def test_unknown_loading_is_named() -> None:
    with pytest.raises(SrfError, match="unknown loading 'tilted'"):
        build_system(REGISTRY, loading="tilted")


@pytest.mark.parametrize(("name", "unit"), [("velocity", "um/s"), ("length", "mm")])
def test_one_name_in_two_units_is_refused(name: str, unit: str, tmp_path: Path) -> None:
    """The interface's lambda is a length: a law's lambda that is a velocity cannot have the same value."""
    text = template("friction", name, python=False).replace("Vsat*phi", "lambda*phi").replace("\nVsat =", "\nlambda =")
    file = tmp_path / f"{name}.toml"
    file.write_text(re.sub(r'(lambda = .*)"um/s"', rf'\1"{unit}"', text))
    if unit == "um/s":
        with pytest.raises(SrfError, match="'lambda' is in um/s in velocity and in um in elastic"):
            build_system(REGISTRY, law=str(file))
    assert build_system(REGISTRY, law=str(file), interface="rigid" if unit == "um/s" else "elastic").friction.name == name
