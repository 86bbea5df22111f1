"""srf: state-and-rate friction, from a law to its stability boundary.

    import srfcli as srf

    slider = srf.system("srf-vsat", K="0.21 N/um")
    srf.linear(slider).plot()

Each function is a command of `srf`: values in, a result out, with `.table`, `.to_dataframe()`, `.to_xarray()` and `.plot()`.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from srfcli.core.version import __version__ as __version__

if TYPE_CHECKING:
    from srfcli.codegen.slider import SlidingSystem as SlidingSystem
    from srfcli.codegen.slider import load_law as load_law
    from srfcli.codegen.slider import system as system
    from srfcli.core.errors import SrfError as SrfError
    from srfcli.core.errors import Status as Status
    from srfcli.tasks.boundary import continue_boundary as continue_boundary
    from srfcli.tasks.boundary import critical as critical
    from srfcli.tasks.compare import compare as compare
    from srfcli.tasks.diagnose import diagnose as diagnose
    from srfcli.tasks.fit import fit as fit
    from srfcli.tasks.floquet import floquet as floquet
    from srfcli.tasks.linear import linear as linear
    from srfcli.tasks.map import map as map
    from srfcli.tasks.recordings import read_experiment as read_experiment
    from srfcli.tasks.simulate import simulate as simulate


# name: the module that has it, imported when the name is first used
PUBLIC = {
    "SlidingSystem": "srfcli.codegen.slider",
    "SrfError": "srfcli.core.errors",
    "Status": "srfcli.core.errors",
    "continue_boundary": "srfcli.tasks.boundary",
    "critical": "srfcli.tasks.boundary",
    "floquet": "srfcli.tasks.floquet",
    "linear": "srfcli.tasks.linear",
    "load_law": "srfcli.codegen.slider",
    "map": "srfcli.tasks.map",
    "compare": "srfcli.tasks.compare",
    "diagnose": "srfcli.tasks.diagnose",
    "fit": "srfcli.tasks.fit",
    "read_experiment": "srfcli.tasks.recordings",
    "simulate": "srfcli.tasks.simulate",
    "system": "srfcli.codegen.slider",
}
__all__ = sorted(PUBLIC)


class _Package(ModuleType):
    """The package, in which a public function is not hidden by the module of its name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in PUBLIC and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(PUBLIC[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *PUBLIC})
