"""Newton's equations of periodic orbits in C (data/orbit.c), called with arrays.

Every function takes the library of `kernel(model)`; where that is None collocation, orbit and boundary do the same in NumPy.
"""

from __future__ import annotations

import ctypes
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srfcli.model import GeneratedModel
from srfcli.numerics.compiled import compiler, library_of, orbit_source
from srfcli.numerics.ctext import NoForm
from srfcli.numerics.gauss import LOG_STEP, gauss

Array = NDArray[Any]


@cache
def kernel(model: GeneratedModel) -> ctypes.CDLL | None:
    """Return the compiled equations of this model, or None: no compiler, or a formula that has no form in C."""
    if compiler() is None:
        return None
    scheme = gauss()
    try:
        write = partial(orbit_source, model, {"MI": scheme.inverse, "STEP": scheme.step}, LOG_STEP)
        library = library_of(write, ["orbits", model.source, repr(scheme), repr(LOG_STEP)])
    except NoForm:
        return None
    library.srf_orbits.restype = ctypes.c_int
    library.srf_condense.restype = library.srf_growth.restype = None
    return library


def newton_orbits(
    library: ctypes.CDLL,
    frame: tuple[Array, Array],
    p: Array,
    x: Array,
    stages: Array,
    size: Array,
    tol: float,
    max_iterations: int,
) -> tuple[Array, Array, int]:
    """Bring the orbits `x` (B, N, n), `stages` (B, N, m, n) to convergence in place; monodromy, converged, most iterations.

    `frame` holds the Gauss points' phases (N, m) and the steps (N,), `p` is (n_parameters, B), `size` (B, n).
    """
    B, N, n = x.shape
    monodromy, converged = np.full((B, n, n), np.nan), np.zeros(B, dtype=np.uint8)
    parameters = np.ascontiguousarray(p.T)
    used = library.srf_orbits(
        B, N, *map(_at, frame), _at(parameters), _at(x), _at(stages), _at(size), ctypes.c_double(tol), max_iterations,
        _at(monodromy), _at(converged),
    )  # fmt: skip
    if used < 0:
        raise MemoryError
    return monodromy, converged.astype(bool), used


def condense_compiled(
    library: ctypes.CDLL, frame: tuple[Array, Array], p: Array, x: Array, stages: Array, which: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return factored blocks, their pivots, local, maps and prefix as `Condensed` holds them; NaN where a block is singular."""
    batch, (N, m, n), k = x.shape[:-2], stages.shape[-3:], len(which)
    B, w, size = int(np.prod(batch)), n + 1 + k, m * n
    lu, pivots = np.empty((*batch, N, size, size)), np.empty((*batch, N, size), dtype=np.intc)
    local, maps = np.empty((*batch, N, m, n, w)), np.empty((*batch, N, w, w))
    prefix, good = np.empty((*batch, N + 1, w, w)), np.empty(B, dtype=np.uint8)
    parameters = np.ascontiguousarray(p.T)
    library.srf_condense(
        B, N, k, _at(which), *map(_at, frame), _at(parameters), _at(x), _at(stages), _at(lu), _at(pivots), _at(local), _at(maps),
        _at(prefix), _at(good),
    )  # fmt: skip
    if not good.all():
        bad = ~good.astype(bool).reshape(batch)
        local[bad] = maps[bad] = prefix[bad] = np.nan
    return lu, pivots, local, maps, prefix


def growth_compiled(
    library: ctypes.CDLL,
    frame: tuple[Array, Array],
    p: Array,
    stages: Array,
    which: Array,
    condensed: tuple[Array, Array, Array, Array, Array],
    eigen: tuple[Array, Array, Array],
) -> Array:
    """Return the derivative of ln |rho| in (dx_0, residual, dq), (..., n+1+k); `eigen`: rho, its right and left vectors."""
    lu, pivots, local, maps, prefix = condensed
    N, w = stages.shape[-3], prefix.shape[-1]
    batch = stages.shape[:-3]
    row, parameters = np.empty((*batch, w)), np.ascontiguousarray(p.T)
    pairs = [np.ascontiguousarray(np.asarray(e, dtype=complex)) for e in eigen]
    library.srf_growth(
        int(np.prod(batch)), N, len(which), _at(which), _at(frame[0]), _at(parameters), _at(stages), _at(lu), _at(pivots),
        _at(local), _at(maps), _at(prefix), *map(_at, pairs), _at(row),
    )  # fmt: skip
    return row


def _at(array: Array) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)
