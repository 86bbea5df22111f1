"""`floquet`: one forced periodic state in full."""

from __future__ import annotations

from typing import TYPE_CHECKING

from srfcli.numerics.floquet import solve_floquet
from srfcli.results.periodic import PeriodicResult

if TYPE_CHECKING:
    from srfcli.codegen.slider import SlidingSystem


def floquet(system: SlidingSystem, *, tol: float = 1e-6, max_mesh: int = 1024, harmonics: int = 5) -> PeriodicResult:
    """Return the forced periodic state at the system's V, W0 and eps: multipliers, mean friction, harmonics.

    Parameters
    ----------
    system : SlidingSystem
        The slider, from `srfcli.system`.
    tol : float
        Error of the multipliers; the mesh is doubled until it is met.
    max_mesh : int
        Intervals of the finest mesh.
    harmonics : int
        Harmonics of elongation and friction.

    Returns
    -------
    PeriodicResult
        Where no state was found its status says so.

    Raises
    ------
    SrfError
        For a law without a value under a load that changes.

    References
    ----------
    Ascher, Mattheij and Russell (1995), Numerical Solution of Boundary Value Problems: collocation.

    Examples
    --------
    >>> import srfcli as srf
    >>> state = srf.floquet(srf.system(V=8, W0=9, eps=0.09))
    >>> state.stable, round(state.state.mean_friction, 6)
    (True, 0.418811)
    """
    p = system.model.vector(system.resolved.values)
    system.model.check_changing_load(p)
    found = solve_floquet(system.model, p, tol=tol, max_mesh=max_mesh, harmonics=harmonics)
    return PeriodicResult(system, found)
