"""A generated module, loaded: the numerical face of a system."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from types import CodeType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srfcli.core.cache import cached_source, content_key, find_built
from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.files import read_plain
from srfcli.core.settings import Parameter
from srfcli.core.units import from_base, to_base
from srfcli.laws.registry import Registry, reading
from srfcli.laws.values import Law

Array = NDArray[Any]
COMPLEX_STEP = 1e-30  # no difference is taken, and its square is nothing against 1
ComplexArray = NDArray[Any]
Function = Callable[..., NDArray[Any]]


@dataclass(frozen=True)
class GeneratedModel:
    """Functions of arrays for one system; `source` is the module's text, `key` names its content.

    Arrays: x (..., n) in the order of `states`; p a sequence in the order of `names`; units um, s, N.
    """

    key: str
    title: str
    source: str = field(repr=False)
    parameters: tuple[Parameter, ...] = field(repr=False)
    states: tuple[str, ...]
    logarithmic: tuple[bool, ...]
    laws: tuple[Law, ...] = field(repr=False, compare=False)
    namespace: Mapping[str, Any] = field(repr=False, compare=False)

    def __getattr__(self, name: str) -> Function:
        if name.startswith("_"):
            raise AttributeError(name)
        function = self.namespace.get(name)
        if not callable(function):
            raise AttributeError(f"generated model has no function '{name}'")
        return function

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the parameters' names, in order."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def index(self, name: str) -> int:
        """Return the place of parameter `name`; SrfError where there is none."""
        place = self._places.get(name)
        if place is None:
            raise SrfError(f"unknown parameter '{name}' in {self.title}", did_you_mean(name, self.names))
        return place

    def cycle_parameter(self, name: str) -> Function:
        """Return d(cycle)/d(name) as a function of (tau, x, p)."""
        return self.namespace["CYCLE_PARAMETER"][name]

    def cycle_bilinear_parameter(self, name: str) -> Function:
        """Return d/d(name) of w . (d(cycle)/dx) a as a function of (tau, x, p, w, a)."""
        return self.namespace["CYCLE_BILINEAR_PARAMETER"][name]

    def defaults(self) -> dict[str, float]:
        """Return the default of every parameter, in um, s, N."""
        return {p.name: to_base(p.default, p.unit) for p in self.parameters}

    def vector(self, values: Mapping[str, Any] | None = None) -> NDArray[np.float64]:
        """Return p as an array (n_parameters, ...) from defaults and `values` in um, s, N, broadcast together."""
        merged: dict[str, Any] = self.defaults()
        for name, value in (values or {}).items():
            self.index(name)
            merged[name] = value
        return np.array(np.broadcast_arrays(*merged.values()), dtype=float)

    def with_values(self, p: NDArray[Any], /, **values: Any) -> NDArray[Any]:
        """Return a copy of `p` (n_parameters, ...) with other values of some parameters, broadcast to their shape (...)."""
        shape = np.broadcast_shapes(p.shape[1:], *(np.shape(value) for value in values.values()))
        moved = np.empty((len(p), *shape))
        moved[...] = p.reshape(len(p), *(1,) * (len(shape) - p.ndim + 1), *p.shape[1:])
        for name, value in values.items():
            moved[self.index(name)] = value
        return moved

    def check_changing_load(self, p: NDArray[np.float64]) -> None:
        """Raise SrfError, naming the parameter, where a value of 0 leaves the rates under a changing load without a value."""
        if self.has_rates(p).all():
            return
        for i, parameter in enumerate(self.parameters):
            changed = p.copy()
            changed[i] = to_base(parameter.default, parameter.unit) or 1.0
            if p[i] == 0 and self.has_rates(changed).all():
                raise SrfError(
                    f"{self.title}: nothing can be computed at {parameter.name} = 0 where the normal load changes",
                    f"Set another value, such as {parameter.name}={parameter.default:g}, or choose another law.",
                )

    def has_rates(self, p: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether the rates at steady sliding have values as the load changes, (...,) for p (n_parameters, ...)."""
        with np.errstate(all="ignore"):
            try:
                rates = self.rates(self.steady(p), p[0], p[1], 0.1 * p[1], p)
                return np.asarray(np.isfinite(rates).all(axis=-1))
            except ArithmeticError:
                return np.zeros(p.shape[1:], dtype=bool)

    def unit(self, name: str) -> str:
        """Return the unit that a parameter is declared in."""
        return self.parameters[self.index(name)].unit

    def declared(self, name: str, value: float) -> float:
        """Return a value in um, s, N in the unit the parameter is declared in."""
        return from_base(value, self.unit(name))


def open_model(
    registry: Registry,
    *,
    law: str = "srf-vsat",
    ageing: str = "dieterich",
    interface: str = "elastic",
    loading: str = "vertical",
    inertia: bool = True,
    effects: Sequence[str] = (),
    tables: Sequence[tuple[str, str]] = (),
    random_field: bool = False,
    stability: bool | None = None,
    anew: bool = False,
) -> GeneratedModel:
    """Return the model of the system that these names describe: a shipped one, or from the cache where it was built before.

    With effects, tables or a random friction field it holds what motion in time needs, and nothing of stability, as it does where
    `stability` is not wanted of a plain system that is not shipped. With effects and `stability` it holds that of sliding under a
    constant load, or one that is modulated for ever, and leaves out the effects that critical loads do not depend on.
    With `anew` the text is derived whatever is there.
    """
    base, *modifiers = ageing.split("+")
    wanted = [("friction", law), ("ageing", base), *(("modifier", m) for m in modifiers), ("interface", interface)]
    wanted += [("effect", name) for name in effects]
    parts, laws = [_writers(), loading, str(inertia), repr(tuple(tables)), str(random_field)], []
    plain = not (effects or tables or random_field)
    stability = (not effects if stability is None else stability) and not (tables or random_field)
    parts += ["stability"] if effects and stability else []
    for kind, name in wanted:
        found, fingerprint = _source(registry, kind, name.strip())
        # a law's file says all of it, wherever it lies; a Python file may import from beside it
        parts += [kind, Path(name).name if name.endswith(".toml") else name, fingerprint]
        laws.append(found)
    key = content_key(parts)

    def build() -> str:
        from srfcli.codegen.numpy_source import generate, generate_motion
        from srfcli.symbolic.system import build_system

        system = build_system(
            registry, law=law, ageing=ageing, interface=interface, loading=loading, inertia=inertia, effects=effects,
            tables=tables, random_field=random_field, stability=stability,
        )  # fmt: skip
        return generate(system) if stability else generate_motion(system)

    if anew:
        return load_source(build(), key=key, laws=tuple(laws))
    if (shipped := find_built(key)) is not None:
        return load_source(shipped.source, key=key, laws=tuple(laws), code=shipped.code)
    if plain and not stability:
        key = content_key([*parts, "motion"])
    return load_source(cached_source(key, build), key=key, laws=tuple(laws))


WRITERS = (  # the files of this package that determine a module's text
    "core/__init__", "core/settings", "laws/values", "laws/expression", "laws/law_file", "laws/effect_file", "symbolic/system",
    "symbolic/equations", "symbolic/derive", "codegen/numpy_source",
)  # fmt: skip


@cache
def _writers() -> str:
    """Return the hash of all that modules are written with, besides the laws."""
    here = Path(__file__).resolve().parents[1]
    return content_key([(here / f"{name}.py").read_text(encoding="utf-8") for name in WRITERS])


def _source(registry: Registry, kind: str, name: str) -> tuple[Law, str]:
    """Return a law without its formula, and the hash of its source: a registered name or a file, as Registry.get takes them."""
    if name.endswith((".toml", ".py")):
        registry.check_trusted(name)
        path = Path(name)
        with reading(path):
            return Law(name, source=name), hashlib.sha256(read_plain(path, what="a law")).hexdigest()
    entry = registry.find(kind, name)
    return Law(entry.name, about=entry.about, source=str(entry.location)), registry.fingerprint(entry)


def load_source(source: str, *, key: str = "", laws: tuple[Law, ...] = (), code: CodeType | None = None) -> GeneratedModel:
    """Return the model that this generated module text describes; `code` is the text compiled, where that was done before."""
    namespace: dict[str, Any] = {"__name__": f"srf_generated_{key[:12]}"}
    exec(code or compile(source, f"<generated {key[:12]}>", "exec"), namespace)
    title = source.partition("\n")[0].removeprefix('"""Generated by srf from ').rstrip(".")
    return GeneratedModel(
        key=key,
        title=title,
        source=source,
        parameters=tuple(Parameter(*row) for row in namespace["PARAMETERS"]),
        states=namespace["STATES"],
        logarithmic=namespace["LOGARITHMIC"],
        laws=laws,
        namespace=namespace,
    )
