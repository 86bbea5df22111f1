"""Integrator, filter and periodic orbits in C, compiled with a model's own rates by what C compiler there is, kept by content.

Without a compiler motion is LSODA's and orbits are NumPy's, which are slower: `compiled(model)` is then None. SRF_CC names
the compiler; an empty SRF_CC turns compilation off.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from srfcli.cache import LARGEST, cache_folder, content_key, is_sealed, seal
from srfcli.errors import SrfError
from srfcli.model import GeneratedModel
from srfcli.numerics.ctext import LAMBERTW, TABLES, c_function, dual_arithmetic
from srfcli.reading import read_plain

FLAGS = (  # no contraction: the digits are the same whatever the processor
    "-O3", "-std=c99", "-shared", "-fPIC", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off", "-Wno-psabi",
)  # fmt: skip
VECTORS = ("avx512f", "avx2")  # instruction sets that carry derivatives several at a time, the widest first
FUNCTIONS = {"rates": "srf_rates", "rates_jacobian": "srf_jacobian", "rates_parameters": "srf_parameters"}
DUAL_FUNCTIONS = {
    "rates": "srf_d_rates", "rates_jacobian": "srf_d_jacobian", "field_gain": "srf_d_gain", "elongation": "srf_d_reading",
    "elongation_gradient": "srf_d_gradient",
}  # fmt: skip
ORBIT_FUNCTIONS = {"cycle": "srf_cycle", "cycle_jacobian": "srf_cycle_jacobian", "cycle_bilinear": "srf_bilinear"}
LANES = 8  # derivatives that the filter carries along at a time
TABLE_FUNCTIONS = {"table_arguments": "srf_table_arguments", "rates_tables": "srf_rates_tables"}


def c_source(model: GeneratedModel) -> str:
    """Return the C text of the integrator for this model, and of the filter where it has a random friction field."""
    head = f"#include <math.h>\n#define NX {len(model.states)}\n#define NP {len(model.names)}\n"
    tables, functions = model.namespace.get("TABLES", ()), FUNCTIONS
    if tables:
        head += f"#define NT {len(tables)}\n"
        functions = FUNCTIONS | TABLE_FUNCTIONS
    needs = (LAMBERTW if "lambertw(" in model.source else "") + (TABLES if tables else "")
    body = "\n".join(c_function(model.source, name, label=label) for name, label in functions.items())
    own = (files("srfcli") / "data" / "radau.c").read_text(encoding="utf-8")
    return head + needs + body + own + (_filter_source(model) if "field_gain" in model.namespace else "")


def orbit_source(model: GeneratedModel, scheme: Mapping[str, NDArray[Any]], log_step: float) -> str:
    """Return the C text of Newton's equations of periodic orbits; `scheme` holds the arrays of the collocation."""
    stages = len(scheme["STEP"])
    text = f"#include <math.h>\n#define NX {len(model.states)}\n#define NP {len(model.names)}\n#define MS {stages}\n"
    text += f"#define LOG_STEP {log_step!r}\n"
    text += f"static const int LOGS[NX] = {{{', '.join(str(int(v)) for v in model.logarithmic)}}};\n"
    for name, array in scheme.items():
        sizes = "".join(f"[{n}]" for n in array.shape)
        text += f"static const double {name}{sizes} = {{{', '.join(repr(float(v)) for v in array.ravel())}}};\n"
    text += LAMBERTW if "lambertw(" in model.source else ""
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
        "CYCLE_PARAMETER": (f"static void srf_cycle_parameter({point}, double *out)", "", ""),
        "CYCLE_BILINEAR_PARAMETER": (
            f"static double srf_bilinear_parameter({point}, const double *_w, const double *_a)",
            "    double out = 0.0;\n",
            "    return out;\n",
        ),
    }
    for table, (head, before, after) in forms.items():
        text += f"{head} {{\n{before}    switch (which) {{\n{calls[table]}    }}\n{after}}}\n"
    return text + (files("srfcli") / "data" / "orbit.c").read_text(encoding="utf-8")


def _filter_source(model: GeneratedModel) -> str:
    """Return the C text of the filter, which follows that of the integrator."""
    gauge = model.namespace.get("OBSERVED")
    text = f"#define LANES {LANES}\n" + dual_arithmetic(model.source)
    text += c_function(model.source, "field_gain", label="srf_gain")
    for name, label in DUAL_FUNCTIONS.items():
        if gauge and name.startswith("elongation"):
            place = model.states.index(gauge)
            shown = f"out[{place}] = srf_plain(1.0)" if name.endswith("gradient") else f"out[0] = x[{place}]"
            arguments = "const dual *x, double V, double W, double W_dot, const dual *p, dual *out"
            text += (
                f"static void {label}({arguments}) {{ (void)x; (void)V; (void)W; (void)W_dot; (void)p; {shown}; }}\n"
            )
        else:
            text += c_function(model.source, name, label=label, dual=True)
    return text + (files("srfcli") / "data" / "filter.c").read_text(encoding="utf-8")


@cache
def compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler: SRF_CC, CC, cc, gcc, clang or the package ziglang; None where there is none."""
    named = os.environ.get("SRF_CC")
    if named is not None:
        return tuple(shlex.split(named)) or None
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
def compiled(model: GeneratedModel) -> ctypes.CDLL | None:
    """Return the compiled integrator of this model, or None where there is no compiler; SrfError where it fails on the text."""
    if compiler() is None:
        return None
    library = library_of(lambda: c_source(model), ["motion", model.source])
    library.srf_integrate.restype = ctypes.c_int
    if hasattr(library, "srf_filter"):
        library.srf_filter.restype = ctypes.c_int
    return library


@cache
def _writers() -> str:
    """Return the hash of all that C text is written with, besides what its caller names: the files beside this one."""
    places = (Path(__file__).parent, Path(__file__).parents[1] / "data")
    written = sorted(p for place in places for p in place.iterdir() if p.suffix in (".py", ".c"))
    return content_key([path.read_text(encoding="utf-8") for path in written])


def library_of(write: Callable[[], str], parts: Sequence[str]) -> ctypes.CDLL:
    """Return the C text of `write` compiled and loaded, from the cache where it was built before from the same `parts`.

    With this package's own files the parts determine the text, which is therefore written only where it must be compiled. Raises
    SrfError where the compiler fails on it.
    """
    command = compiler()
    assert command is not None
    key = content_key([*parts, _writers(), " ".join(command), " ".join(flags()), platform.platform(), platform.machine()])
    folder = cache_folder()
    if folder is not None:
        path = folder / f"{key}.so"
        with contextlib.suppress(OSError):  # a cache that cannot be written, or a disk from which nothing may be run
            return _load(path if _intact(path) else _build(command, write(), path, sealed=True))
    try:
        with tempfile.TemporaryDirectory(prefix="srf-", ignore_cleanup_errors=True) as scratch:
            return _load(_build(command, write(), Path(scratch) / f"{key}.so"))  # it stays in memory when its file is gone
    except OSError as error:
        raise SrfError(
            f"no model can be compiled in {error.filename or 'the folder of temporary files'}: {error.strerror or error}",
            "Make room there, name another folder by TMPDIR, or turn compiling off: SRF_CC=",
            exit_code=1,
        ) from error


def _build(command: tuple[str, ...], source: str, path: Path, *, sealed: bool = False) -> Path:
    """Compile to a file beside `path`, then put it in place, sealed for a later process if it is to stay."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".build-") as folder:
        text, library = Path(folder) / "model.c", Path(folder) / "model.so"
        text.write_text(source, encoding="utf-8")
        end = [] if sys.platform == "win32" else ["-lm"]
        done = subprocess.run(
            [*command, *flags(), "-o", str(library), str(text), *end],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "PYTHONSAFEPATH": "1"},  # `python -m ziglang` would look in the current folder first
        )
        if done.returncode:
            first = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip()[:200])
            raise SrfError(f"{' '.join(command)} cannot compile a model: {first}", "SRF_CC= turns compiling off")
        if sealed:
            mark = Path(folder) / "model.sum"
            mark.write_text(seal(path.name, library.read_bytes()), encoding="ascii")
            mark.replace(path.with_suffix(".sum"))
        library.replace(path)
    return path


def _intact(path: Path) -> bool:
    """Return whether a library lies there as this user built it: to load it is to run it, and half of one ends the process."""
    try:
        found = read_plain(path.with_suffix(".sum"), limit=1000).decode("ascii", errors="replace")
        return is_sealed(path.name, read_plain(path, limit=LARGEST), found)
    except (OSError, SrfError):
        return False


def _load(path: Path) -> ctypes.CDLL:
    return ctypes.CDLL(str(path))
