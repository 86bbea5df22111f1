"""What it takes to compile a model: CPU time of every C compiler there is, size of what it makes, and numba beside them.

    .venv/bin/python benchmarks/compilers.py

Compiled are the integrator and the filter of a model with a random friction field: once with the method, which all models of as
many states share, and once as for a model after the first of these. Of a compiler's very first run, in which it may still build
what it needs itself, nothing is said. numba, where it is installed, compiles the rates and their two derivatives alone.
"""

from __future__ import annotations

import importlib.util
import math
import os
import resource
import shlex
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import no_arguments

from srfcli.codegen.c_source import _build, _methods, compiler, filter_source, integrator_source
from srfcli.codegen.model import GeneratedModel, open_model
from srfcli.laws.registry import load_registry


def children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def commands() -> dict[str, tuple[str, ...]]:
    found = {name: (name,) for name in ("gcc", "clang") if shutil.which(name)}
    if importlib.util.find_spec("ziglang"):
        found["ziglang"] = (sys.executable, "-m", "ziglang", "cc")
    return found


def with_numba(model: GeneratedModel) -> float:
    """Return the CPU seconds that numba takes for the rates, their Jacobian and their parameter derivatives."""
    sys.path = [p for p in sys.path if Path(p) != Path(__file__).parent]  # numba would take coverage.py for another's
    from numba import njit

    n, count = len(model.states), len(model.names)
    sizes = {"rates": (n,), "rates_jacobian": (n, n), "rates_parameters": (n, count)}
    begun = time.process_time()
    for name, shape in sizes.items():
        body = model.source[model.source.index(f"def {name}(") :].split("\n\n\n")[0]
        body = body.replace("[..., ", "[").replace("W_dot, p)", "W_dot, p, out)").replace("out = _empty", "# ")
        space = {k: getattr(math, k) for k in ("exp", "log", "cos", "pi", "sqrt")}
        exec(body, space)
        njit(space[name])(np.ones(n), 1.0, 1.0, 1.0, np.ones(count), np.zeros(shape))
    return time.process_time() - begun


def main() -> None:
    no_arguments(__doc__)
    registry = load_registry()
    model = open_model(registry, random_field=True)
    texts = {"integrator": integrator_source(model), "filter": filter_source(model)}
    os.environ["SRF_CACHE"] = ""
    print("compiler      text         lines   CPU s, with the method and without     bytes")
    with tempfile.TemporaryDirectory() as folder:
        for name, command in commands().items():
            os.environ["SRF_CC"] = shlex.join(command)
            compiler.cache_clear()
            _build(texts["integrator"], Path(folder) / "model.so")
            for kind, text in texts.items():
                taken = []
                _methods.clear()
                for _ in range(2):
                    before = children()
                    path = _build(text, Path(folder) / "model.so")
                    taken.append(children() - before)
                lines, size = len((text.model + text.method).splitlines()), path.stat().st_size
                print(f"{name:12}  {kind:11} {lines:6}   {taken[0]:.2f} {taken[1]:.2f} {size:28}")
    if importlib.util.find_spec("numba"):
        print(f"numba         three functions      {with_numba(model):.2f}")


if __name__ == "__main__":
    main()
