"""Generated array functions as C, compiled by what C compiler there is and kept by content.

The text of the generated module is the only source, as it is for `scalar`; no formula is derived or printed twice. In dual
numbers a function carries its derivatives in several directions along (forward automatic differentiation; Griewank and Walther,
Evaluating Derivatives, 2008).

Without a compiler motion is LSODA's and orbits are NumPy's, which are slower: `compiled(model)` is then None. SRF_CC names
the compiler; an empty SRF_CC turns compilation off.
"""

from __future__ import annotations

import ast
import contextlib
import ctypes
import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from srfcli.codegen.model import GeneratedModel
from srfcli.core.cache import LARGEST_ENTRY, cache_folder, content_key, is_sealed, seal
from srfcli.core.errors import SrfError
from srfcli.core.files import read_plain, write_atomic

# Generated array functions as C: `out[..., i, j] = e` becomes one assignment to a flat array.

_FUNCTIONS = {name: name for name in ("cos", "cosh", "exp", "expm1", "log", "log1p", "sin", "sinh", "sqrt", "tan", "tanh")}
_FUNCTIONS |= {name: f"srf_{name}" for name in ("lut", "lut1", "lut2")}
_FUNCTIONS |= {"arctan": "atan", "arcsinh": "asinh", "lambertw": "srf_lambertw"}


class NoForm(SrfError):
    """A formula of a generated module that cannot be written in C."""


_POINTERS = ("x", "p", "_w", "_a")  # arguments that are vectors
_OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_PI = "3.14159265358979323846"

_SLOPES = {  # of f at {a} where f({a}) = {v}
    "cos": "-sin({a})", "cosh": "sinh({a})", "exp": "{v}", "expm1": "({v} + 1.0)", "log": "1.0 / {a}",
    "log1p": "1.0 / (1.0 + {a})", "sin": "cos({a})", "sinh": "cosh({a})", "sqrt": "0.5 / {v}", "tan": "(1.0 + {v} * {v})",
    "tanh": "(1.0 - {v} * {v})", "atan": "1.0 / (1.0 + {a} * {a})", "asinh": "1.0 / sqrt(1.0 + {a} * {a})",
    "srf_lambertw": "1.0 / (exp({v}) * (1.0 + {v}))",
}  # fmt: skip


@dataclass(frozen=True)
class Formulas:
    """A function of a generated module, for one state.

    The named `steps` follow one another; `entries` are those of the output that are not zero, by their place in it row by row.
    The `shape` of a number is ().
    """

    arguments: tuple[str, ...]
    steps: tuple[tuple[str, ast.expr], ...]
    entries: dict[int, ast.expr]
    shape: tuple[int, ...]


def formulas_of(source: str, name: str) -> Formulas:
    """Return what function `name` of a generated module computes, `x[..., i]` written as `x[i]`; SrfError where there is none."""
    function = _functions(source).get(name)
    if function is None:
        raise SrfError(f"generated module has no function '{name}'")
    steps: list[tuple[str, ast.expr]] = []
    entries: dict[int, ast.expr] = {}
    shape: tuple[int, ...] = ()
    for statement in function.body:
        match statement:
            case ast.Return(value=ast.BinOp(right=number)):  # _empty(...) + it
                entries[0] = number
            case ast.Assign(targets=[ast.Name(id="out")], value=ast.Call(args=[_, trailing])):
                shape = ast.literal_eval(trailing)
            case ast.Assign(targets=[ast.Subscript(slice=index)], value=value):
                place = ast.literal_eval(index)
                entries[place if len(shape) == 1 else place[0] * shape[1] + place[1]] = value
            case ast.Assign(targets=[ast.Name(id=step)], value=value):
                steps.append((step, value))
    return Formulas(tuple(a.arg for a in function.args.args), tuple(steps), entries, shape)


@lru_cache(maxsize=4)
def _functions(source: str) -> dict[str, ast.FunctionDef]:
    """Return the functions of a generated module, parsed once: dozens are asked for."""
    return {d.name: d for d in ast.parse(source.replace("[..., ", "[")).body if isinstance(d, ast.FunctionDef)}


def c_function(source: str, name: str, *, label: str, dual: bool = False) -> str:
    """Return function `name` of the generated module `source` as `MODEL void label(..., out)`, its arguments as they are.

    In dual numbers x, p and out are such. Entries of `out` that the formulas leave at zero are not written: the caller clears it.
    Raises SrfError for no such function.
    """
    function = formulas_of(source, name)
    slopes = _Slopes() if dual else None
    lines = []
    for step, value in function.steps:
        if slopes is None or not slopes.moves(value):
            lines.append(f"const double {_safe(step)} = {_text(value)};")
        else:
            lines += slopes.named(step, value)
    for place, value in function.entries.items():
        lines += _stored(place, value, slopes)
    unused = "".join(f" (void){_safe(a)};" for a in function.arguments)
    kinds = {a: "const dual *" if dual else "const double *" for a in _POINTERS}
    declared = ", ".join(f"{kinds.get(a, 'const double ')}{_safe(a)}" for a in function.arguments)
    body = "\n".join(f"    {line}" for line in lines)
    return f"MODEL void {label}({declared}, {'dual' if dual else 'double'} *out) {{\n   {unused}\n{body}\n}}\n"


def _stored(place: int, node: ast.AST, slopes: _Slopes | None) -> list[str]:
    """Return the lines that put an expression into an entry of `out`."""
    if slopes is None:
        return [f"out[{place}] = {_text(node)};"]
    if not slopes.moves(node):
        return [f"out[{place}] = srf_plain({_text(node)});"]
    lines, value, along = slopes.of(node)
    return [*lines, f"out[{place}].v = {value};", *_along(f"out[{place}].d", along)]


def _along(target: str, terms: Sequence[tuple[str, str]]) -> list[str]:
    """Return the calls that give `target` the sum of terms (partial derivative, what has the derivatives), three at a time."""
    lines, rest = [], list(terms)
    while rest:
        some, rest = rest[:3], rest[3:]
        lines.append(f"srf_along_{len(some)}(&{target}, {', '.join(f'{by}, &{of}' for by, of in some)});")
        rest = [("1.0", target), *rest] if rest else []
    return lines


class _Slopes:
    """Text of expressions and of their derivatives along a function's steps.

    The partial derivatives of a step by what it is computed from are plain numbers, found backwards through its formula; the
    derivatives that are carried along are combined once a step (preaccumulation; Griewank and Walther 2008). What depends on
    neither x nor p has none.
    """

    def __init__(self) -> None:
        self._moved: dict[str, str] = {}  # what has the derivatives of a name
        self._lines: list[str] = []
        self._values: dict[int, str] = {}  # of subexpressions that move, by node
        self._partials: dict[str, list[str]] = {}  # of the expression at hand, by what has the derivatives
        self._count = 0

    def moves(self, node: ast.AST) -> bool:
        """Return whether an expression has derivatives."""
        return any(isinstance(n, ast.Name) and (n.id in self._moved or n.id in ("x", "p")) for n in ast.walk(node))

    def named(self, name: str, node: ast.AST) -> list[str]:
        """Return the lines that give `name` to an expression that moves."""
        lines, value, along = self.of(node)
        lines.append(f"const double {_safe(name)} = {value};")
        if len(along) == 1 and along[0][0] == "1.0":
            self._moved[name] = along[0][1]
            return lines
        own = self._moved[name] = f"d_{name}"
        return [*lines, f"lanes {own};", *_along(own, along)]

    def of(self, node: ast.AST) -> tuple[list[str], str, list[tuple[str, str]]]:
        """Return the lines before it, the value of an expression that moves, and by which derivatives of what its own are."""
        self._lines, self._values, self._partials = [], {}, {}
        value = self._value(node)
        self._back(node, "1.0")
        return self._lines, value, [(" + ".join(by), of) for of, by in self._partials.items()]

    def _let(self, text: str) -> str:
        self._count += 1
        self._lines.append(f"const double t{self._count} = {text};")
        return f"t{self._count}"

    def _value(self, node: ast.AST) -> str:
        """Return an expression's value, that of what moves in it named, as its derivative asks for it."""
        if not self.moves(node):
            return _text(node)
        match node:
            case ast.Subscript():
                found = f"{_text(node)}.v"
            case ast.UnaryOp(op=op, operand=operand):
                found = f"(-{self._value(operand)})" if isinstance(op, ast.USub) else self._value(operand)
            case ast.BinOp(left=left, right=ast.Constant(value=2), op=ast.Pow()):
                inner = self._value(left)
                found = self._let(f"{inner} * {inner}")
            case ast.BinOp(left=left, right=right, op=ast.Pow()):
                found = self._let(f"pow({self._value(left)}, {self._value(right)})")
            case ast.BinOp(left=left, right=right, op=op):
                found = self._let(f"{self._value(left)} {_OPERATORS[type(op)]} {self._value(right)}")
            case ast.Call(func=ast.Name(id=name), args=[inner]) if _FUNCTIONS.get(name) in _SLOPES:
                found = self._let(f"{_FUNCTIONS[name]}({self._value(inner)})")
            case ast.Call(func=ast.Name(id=name)):
                raise SrfError(f"function {name} of a generated module has no derivative in C")
            case _:
                found = _text(node)
        self._values[id(node)] = found
        return found

    def _back(self, node: ast.AST, by: str) -> None:
        """Add to the partial derivatives those of an expression by which the whole has the derivative `by`."""
        if id(node) not in self._values:  # it does not move
            return
        match node:
            case ast.Subscript():
                self._partials.setdefault(f"{_text(node)}.d", []).append(by)
            case ast.Name(id=name):
                self._partials.setdefault(self._moved[name], []).append(by)
            case ast.UnaryOp(op=op, operand=operand):
                self._back(operand, f"(-{by})" if isinstance(op, ast.USub) else by)
            case ast.Call(func=ast.Name(id=name), args=[inner]):
                slope = _SLOPES[_FUNCTIONS[name]].format(a=self._plain(inner), v=self._plain(node))
                self._back(inner, self._times(by, slope))
            case ast.BinOp(left=left, right=right, op=op):
                a, b, v = self._plain(left), self._plain(right), self._plain(node)
                if isinstance(op, ast.Add | ast.Sub):
                    self._back(left, by)
                    self._back(right, by if isinstance(op, ast.Add) else f"(-{by})")
                elif isinstance(op, ast.Mult):
                    for side, other in ((left, b), (right, a)):
                        if id(side) in self._values:
                            self._back(side, self._times(by, other))
                elif isinstance(op, ast.Div):
                    over = self._let(f"{by} / {b}")
                    self._back(left, over)
                    if id(right) in self._values:
                        self._back(right, self._let(f"-{v} * {over}"))
                else:
                    if id(left) in self._values:
                        square = isinstance(right, ast.Constant) and right.value == 2
                        self._back(left, self._times(by, f"2.0 * {a}" if square else f"{b} * pow({a}, {b} - 1.0)"))
                    if id(right) in self._values:
                        self._back(right, self._times(by, f"{v} * log({a})"))

    def _plain(self, node: ast.AST) -> str:
        return self._values.get(id(node)) or _text(node)

    def _times(self, by: str, factor: str) -> str:
        return self._let(f"{by} * {factor}") if by != "1.0" else factor if factor.isidentifier() else self._let(factor)


def _safe(name: str) -> str:
    """Return a name that no keyword or macro of C shadows."""
    return name if name in _POINTERS else f"q_{name}"


def _text(node: ast.AST) -> str:
    """Return an expression of plain numbers as C."""
    match node:
        case ast.Constant(value=int() | float() as value):
            return repr(float(value))
        case ast.Name(id=name):
            return _PI if name == "pi" else _safe(name)
        case ast.Subscript(value=ast.Name(id=name), slice=ast.Constant(value=int() as index)):
            return f"{name}[{index}]"
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return f"(-{_text(operand)})"
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return _text(operand)
        case ast.BinOp(op=ast.Pow()):
            return f"pow({_text(node.left)}, {_text(node.right)})"
        case ast.BinOp():
            return f"({_text(node.left)} {_OPERATORS[type(node.op)]} {_text(node.right)})"
        case ast.Call(func=ast.Name(id=name)) if name in _FUNCTIONS:
            return f"{_FUNCTIONS[name]}({', '.join(map(_text, node.args))})"
        case ast.Call(func=ast.Name(id=name)):
            raise NoForm(f"function {name} of a generated module has no form in C")
    raise NoForm(f"{type(node).__name__} in a generated function has no form in C")


# Integrator, filter and periodic orbits in C, compiled with a model's own rates by what C compiler there is, kept by content.

# no contraction: the digits are the same whatever the processor; vectors and peeled loops are what makes -O3 fast here, in 0.6
# of the time to compile
FLAGS = (
    "-O2", "-ftree-vectorize", "-fpeel-loops",
    "-std=c99", "-fPIC", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off", "-Wno-psabi",
)  # fmt: skip
VECTORS = ("avx512f", "avx2")  # instruction sets that carry derivatives several at a time, the widest first
FUNCTIONS = {"rates": "srf_rates", "rates_jacobian": "srf_jacobian", "rates_parameters": "srf_parameters"}
DUAL_FUNCTIONS = {
    "rates": "srf_d_rates", "rates_jacobian": "srf_d_jacobian", "field_gain": "srf_d_gain", "reading": "srf_d_reading",
    "reading_gradient": "srf_d_reading_gradient", "spring": "srf_d_spring", "spring_gradient": "srf_d_spring_gradient",
}  # fmt: skip
ORBIT_FUNCTIONS = {"cycle": "srf_cycle", "cycle_jacobian": "srf_cycle_jacobian", "cycle_bilinear": "srf_bilinear"}
LANES = 16  # derivatives that the filter carries along at a time: a run has 11 to 14
GAUGE_PROCESSES = 3  # of coloured gauge noise, at most, of one state or two
SIGNALS = 3  # of a run, each with its own gauge noise, at most
LIBRARIES = () if sys.platform == "win32" else ("-lm",)
_methods: dict[str, bytes] = {}  # compiled, by their keys
_ONE = threading.Lock()  # one thread writes and compiles at a time; Python 3.11 takes parsing in two for an error
TABLE_FUNCTIONS = {"table_arguments": "srf_table_arguments", "rates_tables": "srf_rates_tables"}


def _own(name: str) -> str:
    """Return the C text that stands beside this file."""
    return (files("srfcli") / "codegen" / name).read_text(encoding="utf-8")


@dataclass(frozen=True)
class CText:
    """C text in two parts that are linked: of a model alone, and of a `method`, the same for all models of as many states."""

    model: str
    method: str


# what a model has for a method is a symbol of the library's own; a function that is not inlined takes half of the time to compile
_HEAD = """#include <math.h>
#define NOINLINE __attribute__((noinline))
#define MODEL __attribute__((visibility("hidden")))
"""


def integrator_source(model: GeneratedModel) -> CText:
    """Return the C text of the integrator for this model."""
    tables = model.namespace.get("TABLES", ())
    sizes = {"NX": len(model.states)} | ({"NT": len(tables)} if tables else {})
    method = _HEAD + _defined(sizes) + _own("lu.c") + _own("radau.c") + (_own("tables.c") if tables else "")
    own = _step_source(model, FUNCTIONS | (TABLE_FUNCTIONS if tables else {}))
    return CText(own, method + _own("integrate.c") + _own("dop853.c"))


def filter_source(model: GeneratedModel) -> CText:
    """Return the C text of the filter for a model with a random friction field."""
    sizes = _defined({"LANES": LANES, "GAUGE_PROCESSES": GAUGE_PROCESSES, "SIGNALS": SIGNALS})
    text = _step_source(model, {n: FUNCTIONS[n] for n in ("rates", "rates_jacobian")} | {"field_gain": "srf_gain"})
    text += sizes + _own("dual.c")
    for name, label in DUAL_FUNCTIONS.items():  # the spring as it is may be what the gauge shows
        known = name if name in model.namespace else name.replace("spring", "reading")
        text += c_function(model.source, known, label=label, dual=True)
    head = _HEAD + _defined({"NX": len(model.states)}) + sizes
    return CText(text, head + _own("lu.c") + _own("radau.c") + _own("dual.c") + _own("filter.c"))


def _step_source(model: GeneratedModel, functions: Mapping[str, str]) -> str:
    """Return the C text of a model's functions, by the names in its module, and of what else a step of Radau IIA asks for."""
    text = _HEAD + f"MODEL const int NP = {len(model.names)};\n"
    text += _own("lambertw.c") if "lambertw(" in model.source else ""
    text += _own("tables.c") if model.namespace.get("TABLES") else ""
    written = {name: c_function(model.source, name, label=label) for name, label in functions.items()}
    return text + "\n".join(written.values()) + _elimination(len(model.states), written["rates_jacobian"])


def _defined(sizes: Mapping[str, object]) -> str:
    return "".join(f"#define {name} {size}\n" for name, size in sizes.items())


def _elimination(states: int, jacobian: str) -> str:
    """Return where a Jacobian may differ from zero, and in which order states are eliminated: that few depend on first."""
    entries = sorted({int(k) for k in re.findall(r"^ *out\[(\d+)\] =", jacobian, re.MULTILINE)})
    columns = [k % states for k in entries]
    order = sorted(range(states), key=columns.count)
    tables = {
        "JACOBIAN": entries or [0],
        "PLACE": [order.index(r) for r in range(states)],
        "ROWS": [i * states + r for r in order for i in range(3)],
    }
    text = f"MODEL const int NJ = {len(entries)};\n"
    for name, numbers in tables.items():
        text += f"MODEL const int {name}[] = {{{', '.join(map(str, numbers))}}};\n"
    return text


def orbit_source(model: GeneratedModel, scheme: Mapping[str, NDArray[Any]], log_step: float) -> CText:
    """Return the C text of Newton's equations of periodic orbits; `scheme` holds the arrays of the collocation."""
    method = _HEAD + _defined({"NX": len(model.states), "MS": len(scheme["STEP"]), "LOG_STEP": repr(log_step)})
    for name, array in scheme.items():
        sizes = "".join(f"[{n}]" for n in array.shape)
        method += f"static const double {name}{sizes} = {{{', '.join(repr(float(v)) for v in array.ravel())}}};\n"
    text = _HEAD + f"MODEL const int NP = {len(model.names)};\n"
    text += f"MODEL const int LOGS[] = {{{', '.join(str(int(v)) for v in model.logarithmic)}}};\n"
    text += _own("lambertw.c") if "lambertw(" in model.source else ""
    text += "\n".join(c_function(model.source, name, label=label) for name, label in ORBIT_FUNCTIONS.items())
    calls = {"CYCLE_PARAMETER": "", "CYCLE_BILINEAR_PARAMETER": ""}
    for table in calls:
        for place, name in enumerate(model.names):
            own = model.namespace[table][name].__name__
            text += c_function(model.source, own, label=f"srf_{own}")
            rest = "x, p, out" if table == "CYCLE_PARAMETER" else "x, p, _w, _a, &out"
            calls[table] += f"    case {place}: srf_{own}(tau, {rest}); break;\n"
    point = "int which, double tau, const double *x, const double *p"
    forms = {
        "CYCLE_PARAMETER": (f"MODEL void srf_cycle_parameter({point}, double *out)", "", ""),
        "CYCLE_BILINEAR_PARAMETER": (
            f"MODEL double srf_bilinear_parameter({point}, const double *_w, const double *_a)",
            "    double out = 0.0;\n",
            "    return out;\n",
        ),
    }
    for table, (head, before, after) in forms.items():
        text += f"{head} {{\n{before}    switch (which) {{\n{calls[table]}    }}\n{after}}}\n"
    return CText(text, method + _own("lu.c") + _own("orbit.c"))


@cache
def compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler: SRF_CC, CC, cc, gcc, clang or the package ziglang; None where there is none.

    Raises SrfError where SRF_CC names a program that there is not.
    """
    named = os.environ.get("SRF_CC")
    if named is not None:
        command = tuple(shlex.split(named))
        if command and not shutil.which(command[0]):
            raise SrfError(f"SRF_CC: there is no program {command[0]}", "Name a C compiler, or unset SRF_CC.")
        return command or None
    for candidate in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        words = shlex.split(candidate)
        if words and shutil.which(words[0]):
            return tuple(words)
    if importlib.util.find_spec("ziglang"):
        return (sys.executable, "-m", "ziglang", "cc")
    return None


GET_COMPILER = "pip install ziglang, or install cc, gcc or clang"


def uncompiled() -> bool:
    """Return whether there is no C compiler though nobody asked for none (an empty SRF_CC does)."""
    return os.environ.get("SRF_CC") is None and compiler() is None


@cache
def flags() -> tuple[str, ...]:
    """Return the compiler's options: FLAGS, and the widest vectors that this processor says it has."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return FLAGS
    known = next((line.split() for line in lines if line.startswith("flags")), [])
    return (*FLAGS, *[f"-m{name}" for name in VECTORS if name in known][:1])


@cache
def compiled(model: GeneratedModel, part: str = "integrator") -> ctypes.CDLL | None:
    """Return a model's compiled integrator, or its filter: None without a compiler, SrfError where it fails on the text."""
    if compiler() is None:
        return None
    write, entry = {"integrator": (integrator_source, "srf_integrate"), "filter": (filter_source, "srf_filter")}[part]
    with _ONE:
        library = library_of(lambda: write(model), [part, model.source])
    getattr(library, entry).restype = ctypes.c_int
    return library


@cache
def _writers() -> str:
    """Return the hash of all that C text is written with, besides what its caller names: the files beside this one."""
    written = sorted(p for p in Path(__file__).parent.iterdir() if p.suffix in (".py", ".c"))
    return content_key([path.read_text(encoding="utf-8") for path in written])


def library_of(write: Callable[[], CText], parts: Sequence[str]) -> ctypes.CDLL:
    """Return the C text of `write` compiled, linked and loaded, from the cache where it was built before from the same `parts`.

    With this package's own files the parts determine the text, which is therefore written only where it must be compiled. Raises
    SrfError where the compiler fails on it.
    """
    key = _key([*parts, _writers()])
    folder = cache_folder()
    if folder is not None:
        path = folder / f"{key}.so"
        with contextlib.suppress(OSError):  # a cache that cannot be written, or a disk from which nothing may be run
            return ctypes.CDLL(str(path if _kept(path) else _build(write(), path, sealed=True)))
    try:
        with tempfile.TemporaryDirectory(prefix="srf-", ignore_cleanup_errors=True) as scratch:
            return ctypes.CDLL(str(_build(write(), Path(scratch) / f"{key}.so")))  # it stays in memory when its file is gone
    except OSError as error:
        raise SrfError(
            f"no model can be compiled in {error.filename or 'the folder of temporary files'}: {error.strerror or error}",
            "Make room there, name another folder by TMPDIR, or turn compiling off: SRF_CC=",
            exit_code=1,
        ) from error


def _key(parts: Sequence[str]) -> str:
    """Return the key of what is compiled from these texts here: by this compiler, for this processor."""
    return content_key([*parts, " ".join(_command()), " ".join(flags()), platform.platform(), platform.machine()])


def _command() -> tuple[str, ...]:
    command = compiler()
    assert command is not None
    return command


def _build(source: CText, path: Path, *, sealed: bool = False) -> Path:
    """Compile and link to a file beside `path`, then put it in place, sealed for a later process if it is to stay."""
    method = _method(source.method)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".build-") as scratch:
        folder = Path(scratch)
        library, known, mark = (folder / name for name in ("model.so", "method.o", "model.sum"))
        known.write_bytes(method)
        _run(folder, source.model, "-shared", "-o", str(library), str(known), end=LIBRARIES)
        if sealed:
            mark.write_text(seal(path.name, library.read_bytes()), encoding="ascii")
            mark.replace(path.with_suffix(".sum"))
        library.replace(path)
    return path


def _method(text: str) -> bytes:
    """Return the object of a method, compiled once for all models: kept in the cache, or as long as this process lasts."""
    key, folder = _key([text]), cache_folder()
    path = folder / f"{key}.o" if folder else None
    found = _methods.get(key) or (_kept(path) if path else None)
    if found is None:
        with tempfile.TemporaryDirectory(prefix="srf-", ignore_cleanup_errors=True) as scratch:
            built = Path(scratch) / "method.o"
            _run(Path(scratch), text, "-c", "-o", str(built))
            found = built.read_bytes()
        if path is not None:
            with contextlib.suppress(OSError, SrfError):
                write_atomic(path.with_suffix(".sum"), seal(path.name, found))
                write_atomic(path, found)
    _methods[key] = found
    return found


def _run(folder: Path, text: str, *arguments: str, end: Sequence[str] = ()) -> None:
    """Run the compiler on a text, which is put into `folder`, with `arguments` before it and those of the `end` behind."""
    source = folder / "text.c"
    source.write_text(text, encoding="utf-8")
    done = subprocess.run(
        [*_command(), *flags(), *arguments, str(source), *end],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONSAFEPATH": "1"},  # `python -m ziglang` would look in the current folder first
    )
    if done.returncode:
        first = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip()[:200])
        raise SrfError(f"{' '.join(_command())} cannot compile a model: {first}", "SRF_CC= turns compiling off")


def _kept(path: Path) -> bytes | None:
    """Return what lies there as this user built it: to load it is to run it, and half of one ends the process. Else None."""
    try:
        mark = read_plain(path.with_suffix(".sum"), limit=1000).decode("ascii", errors="replace")
        found = read_plain(path, limit=LARGEST_ENTRY)
        return found if is_sealed(path.name, found, mark) else None
    except (OSError, SrfError):
        return None
