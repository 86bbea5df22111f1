"""Generated array functions turned into functions of one state: Python floats and `math`, an order of magnitude faster there.

The text of the generated module is the only source: `x[..., i]` becomes `x[i]`, `out[..., i] = e` an entry of a tuple, and
whatever depends on the parameters alone is computed once, when they are bound.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from srfcli.errors import SrfError
from srfcli.model import GeneratedModel
from srfcli.splines import tables_after

_ALIASES = {"arctan": math.atan, "arcsinh": math.asinh}
_MATH = ("cos", "cosh", "exp", "expm1", "log", "log1p", "pi", "sin", "sinh", "sqrt", "tan", "tanh")

ScalarFunction = Callable[..., Any]


def scalar_function(model: GeneratedModel, name: str, p: Any) -> ScalarFunction:
    """Return generated function `name`, parameters `p` bound, as a function of one state and of what follows the state.

    The state is a sequence of floats; a vector comes back as a tuple, a matrix as a tuple of rows. Overflow and logarithms
    of nothing raise, as `math` does.
    """
    return _factory(model.source, name, len(model.names))([float(value) for value in p])


@lru_cache(maxsize=64)
def _factory(source: str, name: str, n: int) -> Callable[[list[float]], ScalarFunction]:
    namespace: dict[str, Any] = {f: getattr(math, f) for f in _MATH} | _ALIASES | {"lambertw": _lambertw}
    namespace |= dict(zip(("lut", "lut1", "lut2"), tables_after(n), strict=True))
    exec(compile(scalar_source(source, name), f"<scalar {name}>", "exec"), namespace)
    return namespace["bind"]


def _lambertw(x: float) -> float:
    from scipy.special import lambertw

    return float(lambertw(x).real)


def scalar_source(source: str, name: str) -> str:
    """Return the text of `bind(p)`, which returns the scalar form of function `name` of a generated module."""
    function = next((d for d in ast.parse(source).body if isinstance(d, ast.FunctionDef) and d.name == name), None)
    if function is None:
        raise SrfError(f"generated module has no function '{name}'")
    once: list[str] = []
    inside: list[str] = []
    cells: dict[Any, str] = {}
    shape: tuple[int, ...] = ()
    fixed = set(_MATH) | set(_ALIASES) | {"lambertw", "p"}
    result = ""
    for statement in function.body[1:]:  # the first is the docstring
        statement = _OneState().visit(statement)
        if isinstance(statement, ast.Return):
            result = _returned(statement, cells, shape)
            continue
        assert isinstance(statement, ast.Assign)
        target, value = statement.targets[0], statement.value
        if isinstance(target, ast.Subscript):
            cells[ast.literal_eval(target.slice)] = ast.unparse(value)
        elif isinstance(target, ast.Name) and target.id == "out":
            assert isinstance(value, ast.Call)
            shape = ast.literal_eval(value.args[1])
        elif isinstance(target, ast.Name):
            constant = all(n.id in fixed for n in ast.walk(value) if isinstance(n, ast.Name))
            (once if constant else inside).append(ast.unparse(statement))
            if constant:
                fixed.add(target.id)
    arguments = ", ".join(a.arg for a in function.args.args if a.arg != "p")
    lines = [
        *once,
        f"def {name}({arguments}):",
        *(f"    {line}" for line in inside),
        f"    return {result}",
        f"return {name}",
    ]
    return "def bind(p):\n" + "\n".join(f"    {line}" for line in lines) + "\n"


def _returned(statement: ast.Return, cells: dict[Any, str], shape: tuple[int, ...]) -> str:
    value = statement.value
    if isinstance(value, ast.BinOp):  # _empty(...) + expression: only arrays need the first term
        return ast.unparse(value.right)
    if len(shape) == 1:
        return _tuple([cells.get(i, "0.0") for i in range(shape[0])])
    return _tuple([_tuple([cells.get((i, j), "0.0") for j in range(shape[1])]) for i in range(shape[0])])


def _tuple(entries: list[str]) -> str:
    return f"({', '.join(entries)},)"


class _OneState(ast.NodeTransformer):
    """Removes the ellipsis from every index: a[..., i, j] becomes a[i, j]."""

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        self.generic_visit(node)
        index = node.slice
        if isinstance(index, ast.Tuple) and isinstance(index.elts[0], ast.Constant) and index.elts[0].value is Ellipsis:
            rest = index.elts[1:]
            node.slice = rest[0] if len(rest) == 1 else ast.Tuple(rest, ast.Load())
        return node
