"""Arguments of public functions: where one is not of the type it is annotated with, a Python error becomes a clear one."""

from __future__ import annotations

import ast
import functools
import inspect
import numbers
import reprlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from srfcli.core.errors import SrfError

Function = TypeVar("Function", bound=Callable[..., Any])

# of arguments that are no classes of srf; a truth value is a number in Python, and here it is none
TYPES: dict[str, type] = {"str": str, "Path": Path, "float": numbers.Real, "int": numbers.Integral}
UNCHECKED = ("Any", "ArrayLike", "Runner", "Said", "Values", "bool")  # names of several types, and what is asked for its truth
HINTS = {"SlidingSystem": "Make a slider first, as srfcli.system('srf-vsat')."}


def explained(function: Function) -> Function:
    """Return the function, which raises SrfError where a Python error follows from an argument of a wrong type.

    What works is not looked at. Annotations must be text, as `from __future__ import annotations` makes them.
    """

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except (TypeError, ValueError, AttributeError, LookupError):
            parameters = inspect.signature(function).parameters
            for name, value in {**dict(zip(parameters, args, strict=False)), **kwargs}.items():
                annotation = parameters[name].annotation if name in parameters else "Any"
                if not _fits(value, ast.parse(annotation, mode="eval").body):
                    hint = HINTS.get(annotation.split(" | ")[0], f"It takes {annotation}.")
                    raise SrfError(f"`{name}`: {reprlib.repr(value)} is of a wrong type", hint) from None
            raise

    return call  # type: ignore[return-value]


def _fits(value: Any, annotation: ast.expr) -> bool:
    """Return whether a value is of the type that an annotation names; a function is not looked at."""
    match annotation:
        case ast.BinOp(left=left, right=right):
            return _fits(value, left) or _fits(value, right)
        case ast.Constant():
            return value is None
        case ast.Subscript(value=ast.Name(id="Mapping"), slice=ast.Tuple(elts=[_, inner])):
            return isinstance(value, Mapping) and all(_fits(item, inner) for item in value.values())
        case ast.Subscript(value=ast.Name(id="Sequence" | "tuple"), slice=inner):
            if not isinstance(value, Iterable) or isinstance(value, str | bytes | Mapping):
                return False
            items = list(value)
            kinds = inner.elts if isinstance(inner, ast.Tuple) else [inner] * len(items)
            return len(items) == len(kinds) and all(map(_fits, items, kinds))
        case ast.Name(id=name) if name in TYPES:
            return isinstance(value, TYPES[name]) and not isinstance(value, bool)
        case ast.Name(id=name) if name not in UNCHECKED:
            return name in {base.__name__ for base in type(value).__mro__}
    return True
