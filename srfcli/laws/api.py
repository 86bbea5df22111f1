"""What the author of a Python plugin imports: decorators that turn a function of symbols into a law value.

    from srfcli.laws.api import Parameter, friction_law, log

    @friction_law(name="my-law", parameters=[Parameter("mu0", 0.33), ...], about="...", cites=["..."])
    def my_law(v, phi, p):
        return p.mu0 + p.A * log(v / p.V0) + p.B * log(1 + p.Vsat * phi / p.D0)

    @effect(name="my-effect", parameters=[Parameter("c", 0.01)], neutral={"c": 0.0})
    def my_effect(mu, v, p):
        return {"mu": mu + p.c * v / p.V0}

    @reader(name="my-logger", suffixes=(".dat",))
    def my_logger(path):
        return {"time [s]": times, "elongation [um]": elongations}

A law's function is called once, with symbols; its arguments are the variables of the law by name, and `p`, the parameters.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import SrfError, did_you_mean
from srfcli.core.settings import Parameter
from srfcli.laws.law_file import (
    AGEING_SYMBOLS,
    COMMON,
    FORMULA,
    LAW_CLASSES,
    check_law,
    check_parameters,
    check_uses,
    known_symbols,
    valid_name,
)
from srfcli.laws.values import AgeingLaw, AgeingModifier, Check, Effect, ExtraState, FrictionLaw, Interface, Reader, Source, State

if TYPE_CHECKING:
    import sympy
    from sympy import LambertW as lambertw
    from sympy import asinh, atan, cos, cosh, exp, log, sin, sinh, sqrt, tanh

    from srfcli.laws.expression import expm1, log1p

__all__ = [
    "AgeingLaw", "AgeingModifier", "Check", "Effect", "ExtraState", "FrictionLaw", "Interface", "Parameter", "Reader", "Source",
    "SrfError", "State", "ageing_law", "asinh", "atan", "cos", "cosh", "effect", "exp", "expm1", "friction_law", "interface",
    "lambertw", "log", "log1p", "modifier", "reader", "sin", "sinh", "sqrt", "tanh",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Return a function of formulas, from sympy, which a reader of data files has no use for."""
    if name in __all__:
        from srfcli.laws.expression import FUNCTIONS

        return FUNCTIONS[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


Parameters = Iterable[Parameter] | Mapping[str, Parameter]


class Symbols:
    """The parameters of a law as symbols: `p.mu0`, or `p["lambda"]` for a name that is a Python keyword."""

    def __init__(self, names: Iterable[str]) -> None:
        self._names = tuple(names)

    def __getitem__(self, name: str) -> sympy.Symbol:
        from srfcli.laws.expression import symbol

        if name not in self._names:
            raise SrfError(f"unknown parameter '{name}'", did_you_mean(name, self._names))
        return symbol(name)

    def __getattr__(self, name: str) -> sympy.Symbol:
        if name.startswith("__"):  # copy and pickle probe for these
            raise AttributeError(name)
        return self[name]


def friction_law(
    *,
    name: str | None = None,
    parameters: Parameters = (),
    about: str = "",
    cites: Iterable[str] = (),
    states: Iterable[State] = (State(),),
    checks: Iterable[Check] = (),
) -> Callable[[Callable[..., Any]], FrictionLaw]:
    """Turn a function of v, the states and p into a `FrictionLaw`."""
    return _decorator("friction", name, parameters, about, cites, checks, states=tuple(states))


def ageing_law(
    *,
    name: str | None = None,
    parameters: Parameters = (),
    about: str = "",
    cites: Iterable[str] = (),
    checks: Iterable[Check] = (),
) -> Callable[[Callable[..., Any]], AgeingLaw]:
    """Turn a function of v, phi, mu, mu_dot, W, W_dot, F_dot_over_W (those it names) and p into an `AgeingLaw`."""
    return _decorator("ageing", name, parameters, about, cites, checks)


def modifier(
    *,
    name: str | None = None,
    parameters: Parameters = (),
    about: str = "",
    cites: Iterable[str] = (),
    checks: Iterable[Check] = (),
) -> Callable[[Callable[..., Any]], AgeingModifier]:
    """Turn a function of the same variables as an ageing law into an `AgeingModifier`."""
    return _decorator("modifier", name, parameters, about, cites, checks)


def interface(
    *,
    name: str | None = None,
    parameters: Parameters = (),
    about: str = "",
    cites: Iterable[str] = (),
    checks: Iterable[Check] = (),
) -> Callable[[Callable[..., Any]], Interface]:
    """Turn a function of W and p into an `Interface`."""
    return _decorator("interface", name, parameters, about, cites, checks)


def effect(
    *,
    name: str | None = None,
    parameters: Parameters = (),
    neutral: Mapping[str, float] | None = None,
    about: str = "",
    cites: Iterable[str] = (),
    states: Iterable[str] = (),
    needs: Iterable[str] = (),
    lacks: Iterable[str] = (),
    observed: str = "",
    constitutive: bool = True,
    wrong: str = "",
    remedy: str = "",
    checks: Iterable[Check] = (),
) -> Callable[[Callable[..., Any]], Effect]:
    """Turn a function into an `Effect`: it returns a mapping from slots (mu, rate, kappa, W, force, V) to formulas.

    Its arguments are the slots' names for what was there before, and any other name that a formula of an effect may hold;
    `neutral` are the values at which the model is the baseline, `states` the unknowns that the effect adds: the mapping then
    holds, under the name of each, an `ExtraState`. `wrong` and `remedy` are what a report says where it is found.
    """

    from srfcli.laws.effect_file import SCANNED_VALUES, SLOTS, TAKEN, finished, known_names

    def decorate(function: Callable[..., Any]) -> Effect:
        own = _name(function, name, "effect", "my-effect")
        listed, brought, needed = _parameter_list(parameters), tuple(states), tuple(needs)
        check_parameters(listed, TAKEN)
        sizes = dict(neutral or {})
        known = (*known_names([p.name for p in listed], brought, needed), *SLOTS)
        changes, extra = _changes(function, [*(p.name for p in listed), *COMMON, *needed], known, brought)
        return finished(
            Effect(
                name=own, parameters=listed, cites=tuple(cites), **_told(function, about),
                changes=changes, states=extra, neutral=tuple((n, float(v)) for n, v in sizes.items()),
                scans=tuple((p.name, SCANNED_VALUES) for p in listed if p.name not in sizes), needs=needed, lacks=tuple(lacks),
                observed=observed, constitutive=constitutive, wrong=wrong, remedy=remedy, checks=tuple(checks),
            )
        )  # fmt: skip

    return decorate


def reader(
    *, name: str | None = None, suffixes: Iterable[str] = (), sniff: Callable[[bytes], bool] | None = None, about: str = ""
) -> Callable[[Callable[[Path], Source | Mapping[str, Any]]], Reader]:
    """Turn a function of a path, which returns a `Source` or a mapping from headings to arrays, into a `Reader`."""

    def decorate(function: Callable[[Path], Source | Mapping[str, Any]]) -> Reader:
        own = _name(function, name, "reader", "my-logger")
        endings = tuple(suffixes)
        if not all(isinstance(s, str) and s.startswith(".") for s in endings):
            raise SrfError(f"reader '{own}': suffixes are {endings!r}", 'Write them with their dot: suffixes=(".dat",).')
        return Reader(own, function, endings, sniff, **_told(function, about))

    return decorate


def _decorator(
    kind: str, name: str | None, parameters: Parameters, about: str, cites: Iterable[str], checks: Iterable[Check], **more: Any
) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        law_name = _name(function, name, "law", "my-law")
        listed = _parameter_list(parameters)
        states = more.get("states", ())
        check_law(kind, listed, states)
        known = known_symbols(kind, (p.name for p in listed), states)
        own = (*(COMMON if kind in ("ageing", "modifier") else ()), *(p.name for p in listed))
        variables = [n for n in known if n not in own] if kind != "ageing" else list(AGEING_SYMBOLS)
        formula = _called(function, variables, own)
        if formula is not None or kind != "interface":  # None is a rigid interface
            formula = _exact(function.__name__, formula, known)
        told = {**_told(function, about), **more, FORMULA[kind]: formula}
        law = LAW_CLASSES[kind](name=law_name, parameters=listed, cites=tuple(cites), checks=tuple(checks), **told)
        check_uses(law)
        return law

    return decorate


def _name(function: Callable[..., Any], name: str | None, what: str, example: str) -> str:
    """Return the name that an author gave, else that of the function; SrfError where it is no name."""
    own = name or function.__name__.replace("_", "-")
    if not valid_name(own):
        raise SrfError(f"{what} name {own!r}: expected small letters, digits and single dashes", f"Like {example}.")
    return own


def _told(function: Callable[..., Any], about: str) -> dict[str, Any]:
    """Return the description of a function's law, which is the first line of its docstring by default, and its source file."""
    first_line = (inspect.getdoc(function) or "").split("\n")[0]
    return {"about": about or first_line, "source": inspect.getsourcefile(function) or ""}


def _called(function: Callable[..., Any], variables: list[str], parameters: tuple[str, ...]) -> Any:
    """Return the result of a function called with symbols: some of `variables` by name, and p, the `parameters`."""
    from srfcli.laws.expression import symbol

    arguments: dict[str, Any] = {}
    for argument in inspect.signature(function).parameters:
        if argument != "p" and argument not in variables:
            raise SrfError(f"{function.__name__}: unknown argument '{argument}'", did_you_mean(argument, [*variables, "p"]))
        arguments[argument] = Symbols(parameters) if argument == "p" else symbol(argument)
    return function(**arguments)


def _parameter_list(parameters: Parameters) -> tuple[Parameter, ...]:
    if not isinstance(parameters, Mapping):
        return tuple(parameters)
    for key, value in parameters.items():
        if key != value.name:
            raise SrfError(f"parameter '{value.name}' stands under the key '{key}'", "Use one name for both.")
    return tuple(parameters.values())


def _changes(
    function: Callable[..., Any], parameters: Iterable[str], known: tuple[str, ...], states: tuple[str, ...]
) -> tuple[tuple[tuple[str, sympy.Expr], ...], tuple[ExtraState, ...]]:
    """Return the formula that an effect's function gives for each slot, and the unknowns that it adds."""
    from srfcli.laws.effect_file import SLOTS

    where, own, variables = function.__name__, tuple(parameters), [n for n in known if n not in tuple(parameters)]
    result = _called(function, variables, own)
    if not isinstance(result, Mapping):
        raise SrfError(f"{where}: returned {type(result).__name__}, expected a mapping", 'Like {"mu": mu + ...}.')
    for key, value in result.items():
        if key not in (*SLOTS, *states):
            raise SrfError(f"{where}: '{key}' is no slot", did_you_mean(str(key), (*SLOTS, *states)))
        if isinstance(value, ExtraState) != (key in states):
            raise SrfError(
                f"{where}: found {type(value).__name__} under '{key}'", "A formula for a slot, an ExtraState for a state."
            )
    lacking = [n for n in states if n not in result]
    if lacking:
        raise SrfError(f"{where}: nothing is returned for the state '{lacking[0]}'", "Return an ExtraState for it.")
    changes = tuple((s, _exact(where, result[s], (*known, s))) for s in SLOTS if s in result)
    extra = tuple(
        ExtraState(n, _exact(where, result[n].rate, known), _exact(where, result[n].steady, known), result[n].logarithmic)
        for n in states
    )
    return changes, extra


def _exact(where: str, result: Any, known: tuple[str, ...]) -> sympy.Expr:
    """Return a formula with its floats as exact decimals, after the same whitelist as the text form's."""
    import sympy

    from srfcli.laws.expression import FUNCTIONS, symbol

    if not isinstance(result, sympy.Expr | int | float):
        raise SrfError(f"{where}: returned {type(result).__name__}, expected a formula", "Return one expression.")
    expr = sympy.sympify(result)  # an expression or a number already: no text gets here
    expr = expr.xreplace({f: sympy.Rational(repr(float(f))) for f in expr.atoms(sympy.Float)})
    allowed = tuple({f for f in FUNCTIONS.values() if isinstance(f, type)})
    for node in sympy.preorder_traversal(expr):
        if node.is_Symbol:
            if node.name not in known or node != symbol(node.name):
                raise SrfError(f"{where}: unknown symbol '{node}'", did_you_mean(node.name, known))
        elif not isinstance(node, (sympy.Add, sympy.Mul, sympy.Pow, sympy.Rational, sympy.NumberSymbol, *allowed)):
            raise SrfError(
                f"{where}: '{node.func.__name__}' is not part of a formula", f"Functions: {', '.join(sorted(FUNCTIONS))}."
            )
    return expr
