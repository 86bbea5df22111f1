"""What tasks share: values of parameters that one runs over, checked; how independent parts of one are computed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from srfcli.codegen.model import GeneratedModel
from srfcli.core.errors import SrfError
from srfcli.core.settings import check_value, require_parameter

Run = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[int, Any]]]


def here(function: Callable[[Any], Any], parts: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    """Yield (number, result) of every part, one after the other."""
    yield from ((k, function(part)) for k, part in enumerate(parts))


def swept(model: GeneratedModel, over: Mapping[str, Sequence[float] | float]) -> dict[str, tuple[float, ...]]:
    """Return parameter -> values in declared units; raises SrfError for an unknown name or a value out of bounds."""
    return {name: checked(model, name, values) for name, values in over.items()}


def checked(model: GeneratedModel, name: str, values: Any) -> tuple[float, ...]:
    """Return the values of one parameter, a number or several, in its declared unit; raises SrfError as `swept` does."""
    parameter = require_parameter(name, model.parameters, where=model.title)
    listed = np.atleast_1d(np.asarray(values, float))
    if listed.ndim != 1 or not listed.size:
        raise SrfError(f"{name}: expected a number or a list of numbers", f'Like {{"{name}": [1, 2, 5]}}.')
    return tuple(check_value(parameter, float(v)) for v in listed)
