"""Recordings, as every task on them takes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from srfcli.data import experiment as description
from srfcli.data.values import Experiment
from srfcli.laws.registry import Registry, load_registry


def read_experiment(
    path: str | Path,
    *,
    format: str | None = None,
    holdout: bool = True,
    plugins: Sequence[str | Path] = (),
    registry: Registry | None = None,
) -> Experiment:
    """Return an experiment: its runs, its apparatus, the model that is believed, and the parameters that are free.

    Parameters
    ----------
    path : str or path
        A folder with an experiment.toml, or that file.
    format : str, optional
        Reader of all data files; each is told from its name and content if left out.
    holdout : bool
        Whether runs that are held out are read, too.
    plugins : sequence of path
        Folders in which laws and readers are looked for, too.
    registry : Registry, optional
        Laws and readers, where they are at hand already.

    Returns
    -------
    Experiment
        All numbers in um, s, N.

    Raises
    ------
    SrfError
        For what is missing, contradictory or unreadable, with the file and the line or column.

    Examples
    --------
    >>> from pathlib import Path
    >>> import srfcli as srf
    >>> lines = ["time [s],load_point_velocity [um/s],friction", *(f"{0.1 * i:.1f},3,0.6" for i in range(20))]
    >>> _ = Path("run.csv").write_text("\\n".join(lines))
    >>> described = '''
    ... format = "srf-experiment/1"
    ... apparatus = { stiffness = "3e-3 1/um" }
    ... model = { law = "dieterich-ruina", ageing = "ruina", interface = "rigid", inertia = false }
    ... parameters = { D0 = { value = 10.0, lower = 1.0, upper = 100.0 } }
    ... runs = [{ name = "run", file = "run.csv", load = "10 MPa" }]
    ... '''
    >>> _ = Path("experiment.toml").write_text(described)
    >>> experiment = srf.read_experiment(".")
    >>> [(run.name, run.observed.shape) for run in experiment.runs]
    [('run', (20,))]
    """
    known = registry or load_registry([Path(p) for p in plugins])
    return description.read_experiment(Path(path), registry=known, format=format, holdout=holdout)
