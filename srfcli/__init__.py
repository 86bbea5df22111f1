"""srf: state-and-rate friction, from a law to its stability boundary.

    import srfcli as srf

    slider = srf.system("srf-vsat", K="0.21 N/um")
    srf.linear(slider).plot()

`system`, `load_law` and `read_experiment` prepare the input, and `run_processes` spreads independent work. Every other function
does the work of one command and returns a result with `.table`, `.to_dataframe()`, `.to_xarray()` and, unless it is a text,
`.plot()`; `continue_boundary` returns an iterator of such results.
"""

from __future__ import annotations

import importlib

from srfcli.core import __version__ as __version__

TYPE_CHECKING = False  # as type checkers know it: to import `typing` takes longer than all else here
if TYPE_CHECKING:
    from typing import Any

    from srfcli.codegen.slider import SlidingSystem as SlidingSystem
    from srfcli.codegen.slider import load_law as load_law
    from srfcli.codegen.slider import system as system
    from srfcli.core.errors import SrfError as SrfError
    from srfcli.core.errors import Status as Status
    from srfcli.core.parallel import run_processes as run_processes
    from srfcli.numerics.continuation import ContinuationSettings as ContinuationSettings
    from srfcli.numerics.continuation import StepSettings as StepSettings
    from srfcli.numerics.plane import MapAxis as MapAxis
    from srfcli.numerics.plane import MapSettings as MapSettings
    from srfcli.tasks.diagnose import diagnose as diagnose
    from srfcli.tasks.map import compare as compare
    from srfcli.tasks.map import map as map
    from srfcli.tasks.recordings import check as check
    from srfcli.tasks.recordings import fit as fit
    from srfcli.tasks.recordings import fit_campaign as fit_campaign
    from srfcli.tasks.recordings import fit_thresholds as fit_thresholds
    from srfcli.tasks.recordings import new_experiment as new_experiment
    from srfcli.tasks.recordings import read_experiment as read_experiment
    from srfcli.tasks.simulate import simulate as simulate
    from srfcli.tasks.stability import code as code
    from srfcli.tasks.stability import continue_boundary as continue_boundary
    from srfcli.tasks.stability import critical as critical
    from srfcli.tasks.stability import derive as derive
    from srfcli.tasks.stability import floquet as floquet
    from srfcli.tasks.stability import linear as linear
    from srfcli.tasks.stability import response as response
    from srfcli.validation.trials import prove as prove


# name: the module that has it, imported when the name is first used
PUBLIC = {
    "ContinuationSettings": "srfcli.numerics.continuation",
    "MapAxis": "srfcli.numerics.plane",
    "MapSettings": "srfcli.numerics.plane",
    "SlidingSystem": "srfcli.codegen.slider",
    "StepSettings": "srfcli.numerics.continuation",
    "SrfError": "srfcli.core.errors",
    "Status": "srfcli.core.errors",
    "code": "srfcli.tasks.stability",
    "continue_boundary": "srfcli.tasks.stability",
    "critical": "srfcli.tasks.stability",
    "derive": "srfcli.tasks.stability",
    "floquet": "srfcli.tasks.stability",
    "linear": "srfcli.tasks.stability",
    "response": "srfcli.tasks.stability",
    "load_law": "srfcli.codegen.slider",
    "map": "srfcli.tasks.map",
    "compare": "srfcli.tasks.map",
    "diagnose": "srfcli.tasks.diagnose",
    "check": "srfcli.tasks.recordings",
    "fit": "srfcli.tasks.recordings",
    "fit_campaign": "srfcli.tasks.recordings",
    "fit_thresholds": "srfcli.tasks.recordings",
    "new_experiment": "srfcli.tasks.recordings",
    "prove": "srfcli.validation.trials",
    "read_experiment": "srfcli.tasks.recordings",
    "run_processes": "srfcli.core.parallel",
    "simulate": "srfcli.tasks.simulate",
    "system": "srfcli.codegen.slider",
}
__all__ = sorted(PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(PUBLIC[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *PUBLIC})
