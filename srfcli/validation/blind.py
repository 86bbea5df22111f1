"""Blind diagnosis of one case: it is given the case's folder and nothing else, and returns an answer."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srfcli.core.errors import SrfError
from srfcli.core.files import parse_json, read_text, write_atomic

if TYPE_CHECKING:
    from srfcli.diagnosis.answer import RunView
    from srfcli.diagnosis.search import Fitted, ModelSearch
    from srfcli.diagnosis.verdict import Diagnosis
    from srfcli.laws.registry import Registry

# Answers: one line each of a file that grows while a trial runs, and from which it resumes.

LARGEST_ANSWERS = 64 * 2**20  # bytes of all answers

FAILED = "failed"  # beside the verdicts: the diagnosis raised, ran out of time, or ended its process
VERDICTS = ("none", "identified", "ambiguous", "unknown", "inconclusive", FAILED)


@dataclass(frozen=True)
class Answer:
    """One case's answer: verdict, effects and stated confidence by hypothesis, "a+b" for two effects together.

    `fit` holds the fitted runs' rms over noise, `held` each held-out run's rms in um and over noise, by `baseline` and
    `augmented`; `parameters` are those that the effects brought, in declared units; `tried` has what was fitted, `ungated` the
    verdict without a say of held-out runs; `run` is the one in which alone an effect acts; `loads` are the critical loads of both
    models at velocities `V` (um/s) beyond those of the recordings; `cpu` and `wall` are in s; `code` tells programs apart.
    """

    case: str
    verdict: str
    effects: tuple[str, ...] = ()
    confidence: Mapping[str, float] = field(default_factory=dict)
    equivalent: tuple[tuple[str, ...], ...] = ()
    not_identifiable: tuple[str, ...] = ()
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    fit: Mapping[str, float | None] = field(default_factory=dict)
    held: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    tried: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    ungated: str = ""
    cpu: float = 0.0
    wall: float = 0.0
    code: str = ""
    failure: str = ""
    run: str = ""
    loads: Mapping[str, Sequence[float | None]] = field(default_factory=dict)

    @property
    def said(self) -> str:
        """Return the answer as the key under which its confidence is stated; the listed names for an ambiguous one."""
        if self.verdict in ("identified", "ambiguous"):
            return "+".join(sorted(self.effects))
        return "none" if self.verdict == "inconclusive" else self.verdict


def to_line(answer: Answer) -> str:
    """Return the answer as one line of JSON; numbers that are none are null."""
    return json.dumps(asdict(answer), sort_keys=True, allow_nan=False)


def from_line(line: str, *, where: str) -> Answer:
    """Return the answer of a line; SrfError, naming `where`, for one that is no answer."""
    try:
        found = parse_json(line, "the line")
        if not isinstance(found, dict) or {"run", "loads", *found} != {f.name for f in fields(Answer)}:  # older ones lack these
            raise ValueError("not the keys of an answer")
        if found["verdict"] not in VERDICTS:
            raise ValueError(f"verdict {found['verdict']!r}")
        equivalent = tuple(tuple(names) for names in found["equivalent"])
        lists = {name: tuple(found[name]) for name in ("effects", "not_identifiable")}
    except (SrfError, ValueError, TypeError) as error:
        raise SrfError(f"{where}: no answer: {error}", "Delete the line, and go on with --resume.") from None
    return Answer(**{**found, **lists, "equivalent": equivalent})


def read_answers(path: Path) -> dict[str, Answer]:
    """Return the answers of a file by case, none where there is no file; SrfError for a damaged line or a case named twice."""
    try:
        text = read_text(path, limit=LARGEST_ANSWERS, what="answers")
    except FileNotFoundError:
        return {}
    found: dict[str, Answer] = {}
    for number, line in enumerate(text.splitlines(), 1):
        answer = from_line(line, where=f"{path}, line {number}")
        if answer.case in found:
            raise SrfError(f"{path}, line {number}: {answer.case} was answered before", "Delete one of the two lines.")
        found[answer.case] = answer
    return found


def write_answers(path: Path, answers: Iterable[Answer]) -> None:
    """Write one line per answer, by case: the file is whole at any moment, and the same however the cases were spread."""
    lines = [to_line(a) + "\n" for a in sorted(answers, key=lambda a: a.case)]
    write_atomic(path, "".join(lines))


# The diagnosis of one case. Nothing here can reach a truth.

Diagnose = Callable[[Path, tuple[Path, ...]], Answer]  # folder of a case, folders of plugins
IRRELEVANT_FOLDERS = ("cli", "results", "validation")  # parts of the package that no answer depends on


@dataclass(frozen=True)
class Task:
    """One case to diagnose: its folder, the plugins' folders, by what, and how many seconds of CPU it may take."""

    folder: Path
    plugins: tuple[Path, ...]
    diagnose: Diagnose
    limit: float


class _TimeLimitExceeded(BaseException):  # not an Exception, so that no handler inside the diagnosis catches it
    pass


def answer_case(task: Task) -> Answer:
    """Return the answer to one case; a diagnosis that raises, or takes too long, has failed, and says how."""
    begun, used = time.perf_counter(), _cpu()
    try:
        with warnings.catch_warnings(), _limited(task.limit):
            warnings.simplefilter("ignore")  # of optimisers under way: the verdict counts
            found = task.diagnose(task.folder, task.plugins)
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(last.filename).name}, line {last.lineno}"
        found = failed(task.folder.name, f"{type(error).__name__}: {error}; {place}")
    except _TimeLimitExceeded:
        found = failed(task.folder.name, f"more than {task.limit:g} s of CPU")
    cpu, wall = round(_cpu() - used, 3), round(time.perf_counter() - begun, 3)
    return replace(found, case=task.folder.name, code=code_of(task.plugins), cpu=cpu, wall=wall)


def failed(case: str, why: str) -> Answer:
    """Return the answer of a diagnosis that gave none."""
    return Answer(case, FAILED, failure=" ".join(why.split()))


def diagnose_case(folder: Path, plugins: tuple[Path, ...], *, by: type[ModelSearch] | None = None) -> Answer:
    """Return what the tool's own diagnosis, or one `by` another search, says of the experiment in `folder`.

    Held-out runs are read when it is done.
    """
    from srfcli.data.experiment import read_experiment
    from srfcli.diagnosis.search import ModelSearch
    from srfcli.diagnosis.verdict import conclude

    registry = _registry(plugins)
    search = (by or ModelSearch)(registry, read_experiment(folder, registry=registry, holdout=False))
    search.run()
    return answer_of(conclude(search, read_experiment(folder, registry=registry)), registry, case=folder.name)


EXTRAPOLATION_FACTORS = (0.1, 1 / 3, 3.0, 10.0)  # times the slowest, the fastest drive: where critical loads are asked for


def answer_of(diagnosis: Diagnosis, registry: Registry, *, case: str) -> Answer:
    """Return a diagnosis as an answer."""
    from srfcli.diagnosis.answer import run_views
    from srfcli.diagnosis.verdict import added

    views, confidence = run_views(diagnosis), dict[str, float]()
    for name, share in diagnosis.confidence.items():
        confidence[_plain(name)] = confidence.get(_plain(name), 0.0) + float(share)
    return Answer(
        case,
        diagnosis.verdict,
        tuple(diagnosis.effects),
        confidence,
        tuple(tuple(names) for names in diagnosis.equivalent),
        tuple(dict.fromkeys(x.effect for x in diagnosis.not_identifiable)),
        {name: {k: _finite(v) for k, v in value.items()} for name, value in added(diagnosis.best, diagnosis.baseline).items()},
        {
            "baseline": _finite(diagnosis.reported_baseline.fit.maximum.point.rms),
            "augmented": _finite(diagnosis.best.fit.maximum.point.rms),
        },
        {view.run.name: _errors(view) for view in views if view.run.holdout},
        {_plain(f.name): _evidence(f) for f in reversed(diagnosis.ranked)},
        diagnosis.ungated,
        run=next(iter(diagnosis.acts_in.values()), ""),
        loads=_critical_loads(diagnosis, registry),
    )


def _critical_loads(diagnosis: Diagnosis, registry: Registry) -> Mapping[str, Sequence[float | None]]:
    """Return the critical loads of both models beyond the recordings' velocities; nothing where a model has no such loads."""
    from srfcli.diagnosis.diagram import critical_loads

    driven = np.concatenate([np.abs(run.drive.velocities) for run in diagnosis.experiment.runs])
    slowest, fastest = driven[driven > 0].min(), driven.max()
    V = np.array([x * (slowest if x < 1 else fastest) for x in EXTRAPOLATION_FACTORS])
    try:
        found = {name: critical_loads(registry, f, V) for name, f in
                 (("baseline", diagnosis.baseline), ("augmented", diagnosis.best))}  # fmt: skip
    except SrfError:
        return {}
    return {name: [_finite(x) for x in values.tolist()] for name, values in {"V": V, **found}.items()}


def _plain(name: str) -> str:
    """Return a hypothesis' name without the runs in which its effects act."""
    return re.sub(r"\[[^]]*\]", "", name)


def _evidence(fitted: Fitted) -> Mapping[str, float]:
    """Return what ranks a model: log likelihood, counts of parameters and samples, evidence, whether it passes its tests."""
    likelihood = fitted.fit.likelihood
    return {
        "log_likelihood": round(float(fitted.fit.log_likelihood), 3),
        "parameters": len(likelihood.names),
        "samples": likelihood.samples,
        "evidence": round(float(fitted.evidence), 3),
        "fine": int(fitted.passes),
    }


def _errors(view: RunView) -> Mapping[str, float | None]:
    """Return a held-out run's rms in um under baseline and final model."""
    run = view.run

    def rms(predicted: np.ndarray) -> float | None:
        return _finite(float(np.sqrt(np.mean((run.observed - predicted)[run.used] ** 2))))

    return {"baseline": rms(view.baseline), "augmented": rms(view.augmented)}


def _finite(value: Any) -> Any:
    if isinstance(value, str):
        return value
    return float(value) if value is not None and np.isfinite(value) else None


@functools.cache
def _registry(plugins: tuple[Path, ...]) -> Registry:
    from srfcli.laws.registry import load_registry

    return load_registry(plugins)


@functools.cache
def code_of(plugins: tuple[Path, ...]) -> str:
    """Return twelve digits that change with any file of the package, or of `plugins`, on which an answer depends."""
    package = Path(__file__).resolve().parents[1]
    parts = [p for p in sorted(package.iterdir()) if p.name not in IRRELEVANT_FOLDERS]
    whole = hashlib.sha256()
    for place in (*parts, package.parent / "plugins", *plugins):
        for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if path.suffix in (".py", ".toml", ".c") and path.is_file():
                whole.update(path.name.encode() + path.read_bytes())
    return whole.hexdigest()[:12]


def _cpu() -> float:
    """Return the seconds of CPU that this process and the compilers it called have used."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise _TimeLimitExceeded in what is done inside once this process has used `seconds` of CPU for it."""
    if sys.platform == "win32":  # it has no such clock
        yield
        return

    def stop(number: int, frame: Any) -> None:
        raise _TimeLimitExceeded

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
