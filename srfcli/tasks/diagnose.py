"""`diagnose`: where recordings and their model differ, which physics is missing, and the model that has it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from srfcli.codegen.c_source import GET_COMPILER, compiler
from srfcli.core.errors import SrfError, as_names, check_choice, did_you_mean, explained
from srfcli.data.experiment import read_experiment
from srfcli.data.groups import BY, TRENDS, grouped
from srfcli.data.values import Experiment
from srfcli.diagnosis.design import discriminating_run
from srfcli.diagnosis.discrepancy import best_closed_form, explain_unknown
from srfcli.diagnosis.residual_scan import locate
from srfcli.diagnosis.search import ModelSearch
from srfcli.diagnosis.verdict import conclude
from srfcli.inference.state_space import Interrupted
from srfcli.laws.registry import Registry, load_registry
from srfcli.laws.values import Effect
from srfcli.results.diagnosis import DiagnosisResult


@explained
def diagnose(
    experiment: Experiment | Path | str,
    *,
    effects: str | Sequence[str] = (),
    trend: str | None = None,
    vary: str | Sequence[str] = (),
    by: str | None = None,
    reader: str | None = None,
    seed: int = 0,
    plugins: Sequence[str | Path] = (),
    registry: Registry | None = None,
    progress: Callable[[str, float | None], None] = lambda text, share: None,
) -> DiagnosisResult:
    """Return which physics an experiment's model lacks, as far as its recordings and critical loads tell.

    The baseline is fitted with a random friction field and the gauge's noise. Every registered effect is scored against it, the
    effects with the highest scores are fitted, and held-out runs judge the best model.

    Parameters
    ----------
    experiment : path or Experiment
        A folder with experiment.toml, or that file: its held-out recordings are opened only when the models are final.
    effects : str or sequence of str
        Effects, or ageing laws, to look for; all that are registered if left out.
    trend : {'slip', 'time', 'none'}, optional
        Let each run's observable drift, or not; as the experiment says if left out.
    vary : str or sequence of str
        Free parameters, or "noise" of the gauge, with a value of their own in each group of runs; as the experiment says if
        left out.
    by : {'run', 'load', 'segment', 'direction'}, optional
        What makes a group.
    reader : str, optional
        How every data file is read.
    seed : int
        Of the noise that is simulated for p-values, and of runs that are tried.
    plugins : sequence of path
        Folders in which laws are looked for, too.
    registry : Registry, optional
        An open registry of laws and effects; loaded from `plugins` and the usual places if left out.
    progress : callable
        Told what is done, and which share of the search's budget is used where that is known.

    Returns
    -------
    DiagnosisResult
        Ctrl-C is a status once the baseline is fitted: the verdict on what was fitted until then.

    Raises
    ------
    SrfError
        For what cannot be read, an unknown effect, or without a C compiler.
    KeyboardInterrupt
        Before the baseline is fitted.

    References
    ----------
    Durbin and Koopman (2012), Time Series Analysis by State Space Methods. Rao (1948): score tests.

    Examples
    --------
    >>> import srfcli as srf
    >>> found = srf.diagnose("experiment")  # doctest: +SKIP
    >>> found.verdict, found.effects  # doctest: +SKIP
    ('identified', ('linker-dieterich',))
    >>> srf.diagnose("experiment", effects=["linker-dietrich"])
    Traceback (most recent call last):
        ...
    srfcli.core.errors.SrfError: unknown effect 'linker-dietrich'
    """
    begun = time.perf_counter()
    check_choice("trend", trend, (*TRENDS, "none"))
    check_choice("by", by, BY)
    effects, vary = as_names(effects, "effects"), as_names(vary, "vary")
    registry = registry or load_registry([Path(p) for p in plugins])
    if effects:
        known = {e.name for e in (*registry.entries("effect"), *registry.entries("ageing"))}
        known |= {law.reported for e in registry.entries("effect") if isinstance(law := registry.load(e), Effect)}
        for name in effects:
            if name not in known:
                raise SrfError(f"unknown effect '{name}'", did_you_mean(name, sorted(known)))

    def read(*, holdout: bool) -> Experiment:
        found = experiment
        if not isinstance(found, Experiment):
            found = read_experiment(Path(found), registry=registry, format=reader, holdout=holdout)
        return grouped(found, vary, by, trend)

    fitted = read(holdout=False).fitted()
    if not (fitted.runs or fitted.thresholds):
        raise SrfError(f"{fitted.path}: every run is held out", "Set holdout = false for those that are to be fitted.")
    if not fitted.runs and (fitted.trend or vary):
        raise SrfError(f"`{'trend' if fitted.trend else 'vary'}` is for recordings, and there are none", "Leave it out.")
    if compiler() is None and fitted.runs:
        raise SrfError("srf diagnose needs a C compiler: it fits dozens of models", GET_COMPILER)
    stopped = searching = False

    def told(text: str) -> None:
        progress(text, search.share if searching else None)

    search = ModelSearch(registry, fitted, told, effects or None)
    searching = True
    try:
        search.run()
    except (KeyboardInterrupt, Interrupted):
        if not search.fitted:
            raise KeyboardInterrupt from None
        stopped = True
    searching = False
    told("held-out runs")
    diagnosis = conclude(search, read(holdout=True))
    told("location")
    last = diagnosis.best if diagnosis.best is not diagnosis.baseline and diagnosis.best.passes else None
    location = locate(diagnosis.baseline, last=last, seed=seed)
    form, missing, discriminating, ended = None, {}, None, False
    verdict = "" if stopped or fitted.thresholds else diagnosis.verdict
    try:
        if verdict == "unknown":
            told("unknown: what is missing")
            form = best_closed_form(search, diagnosis)
        elif verdict == "ambiguous":
            told("ambiguous: the run that would tell them apart")
            discriminating = discriminating_run(registry, diagnosis, seed=seed)
        ended = True
    except (KeyboardInterrupt, Interrupted):
        stopped = True
    except Exception as error:  # the verdict is not to be lost for what follows from it
        sought = "closed form of what is missing" if verdict == "unknown" else "run that would tell them apart"
        said = f"the search for a {sought} ended in an error: {type(error).__name__}: {error}"
        diagnosis = replace(diagnosis, reasons=(*diagnosis.reasons, said))
    if verdict == "unknown":
        missing = explain_unknown(diagnosis, form, searched=ended)
    return DiagnosisResult(
        diagnosis, location, registry, missing, discriminating, stopped, reader, seed, time.perf_counter() - begun
    )
