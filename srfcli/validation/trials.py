"""`prove`: a trial is a folder with a sealed bank of cases, the answers so far and, when all are answered, the truths."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srfcli.core.errors import SrfError, check_choice
from srfcli.core.files import clear, parse_json, read_plain, write_atomic
from srfcli.core.parallel import run_processes
from srfcli.laws.registry import load_registry
from srfcli.results import plots
from srfcli.results.provenance import Provenance, write_result
from srfcli.results.tables import Result, Table, to_csv, to_json, to_text
from srfcli.validation import marks as marking
from srfcli.validation.blind import Answer, Diagnose, Task, answer_case, diagnose_case, failed, read_answers, write_answers
from srfcli.validation.cases import BANKS, SEAL, TRACKS, Truths, check_cases, check_kinds, make_bank, read_seal, unseal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCHEMA = "srf.trial/1"
CPU_LIMIT = 1800.0  # s of CPU a case may take: six times what it should


class Trial:
    """The folder of a trial: in `bank` lie the cases and their seal, all that a diagnosis is given; the rest are files.

    `apart` has the truths, `answers` the answers, one a line, `note` what was asked for, `opened` which answers there were when
    the truths were unsealed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.bank, self.apart = folder, folder / "bank", folder / "truths.json"
        self.answers, self.note, self.opened = folder / "answers.jsonl", folder / "trial.json", folder / "unsealed.json"

    def asked(self) -> dict[str, Any]:
        """Return what was asked for: cases, seed, kinds, track and bank; SrfError where the folder is none of a trial."""
        try:
            found = parse_json(read_plain(self.note), self.note)
        except (OSError, SrfError) as error:
            raise SrfError(f"{self.folder}: no trial: {self.note.name} cannot be read: {error}",
                           "Name the folder that --out of srf prove has made.") from None  # fmt: skip
        if not isinstance(found, dict) or found.get("schema") != SCHEMA:
            raise SrfError(f"{self.note}: expected schema {SCHEMA!r}", "Name the folder that srf prove has made.")
        asked = {name: found.get(name) for name in ("cases", "seed", "kinds", "track")}
        return {**asked, "bank": found.get("bank", "paper")}

    def digest(self) -> str:
        """Return the digest of the truths, as it was published with the cases."""
        return str(read_seal(self.bank)["truths"])

    def waiting(self) -> list[str]:
        """Return the cases that have no answer yet."""
        answered = read_answers(self.answers)
        return [name for name in sorted(read_seal(self.bank)["cases"]) if name not in answered]


def begin(folder: Path, *, cases: int | None, seed: int | None, kinds: Sequence[str], track: str | None = None,
          bank: str | None = None, resume: bool, workers: int,
          told: Callable[[int, int], None] | None = None) -> Trial:  # fmt: skip
    """Return the trial in `folder`, its bank made and sealed; with `resume` one that is there goes on.

    Raises SrfError for a folder that exists where nothing is resumed, and for a trial of other cases.
    """
    trial = Trial(folder)
    if folder.is_dir():
        clear(folder)
    if trial.note.exists() and resume:
        asked = trial.asked()
        given = {"cases": cases, "seed": seed, "kinds": sorted(kinds) or None, "track": track, "bank": bank}
        other = [n for n, v in given.items() if v is not None and v != asked[n]]
        if other:
            raise SrfError(f"{folder} is a trial of {other[0]} {asked[other[0]]}, not {given[other[0]]}",
                           "Leave the option out, or name another folder.")  # fmt: skip
    else:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise SrfError(f"{folder} exists already", "Go on with it by --resume, or name another folder.")
        asked = {
            "cases": 10 if cases is None else cases,
            "seed": 1 if seed is None else seed,
            "kinds": sorted(kinds),
            "track": track,
            "bank": "paper" if bank is None else bank,
        }
        check_kinds(kinds, asked["bank"])
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(trial.note, json.dumps({"schema": SCHEMA, **asked}, indent=1) + "\n")
    if not trial.bank.exists():
        _make(trial, asked, workers=workers, told=told)
    return trial


def _make(trial: Trial, asked: dict[str, Any], *, workers: int, told: Callable[[int, int], None] | None) -> None:
    """Make and seal the bank in a folder of another name: under its own it is complete."""
    part = trial.folder / "bank.part"
    if part.exists():
        shutil.rmtree(part)  # of a run that was killed while it made the bank: nobody has answered it
    trial.apart.unlink(missing_ok=True)
    with _interruptible():
        drawn = {"kinds": asked["kinds"] or None, "track": asked["track"], "bank": asked["bank"]}
        make_bank(part, asked["cases"], asked["seed"], **drawn, apart=trial.apart, workers=workers, told=told)
    part.rename(trial.bank)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Let Ctrl-C end what is done inside: a solver's compiled code loses it, and tells of a fault of its own instead."""
    pressed: list[int] = []

    def note(number: int, frame: Any) -> None:
        pressed.append(number)
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGINT, note)
    except ValueError:  # not in the main thread: there is no Ctrl-C here
        yield
        return
    try:
        yield
    except Exception:
        if pressed:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, before)


def answer_all(trial: Trial, *, workers: int = 1, plugins: tuple[Path, ...] = (), limit: float = CPU_LIMIT,
               diagnose: Diagnose = diagnose_case) -> Iterator[Answer]:  # fmt: skip
    """Yield the answer to every case that has none yet, when it has been written.

    Cases are diagnosed in processes of their own, `workers` at once, that are told the case's folder and nothing else. A case
    that ends three of them has failed, as has one that takes more than `limit` seconds of CPU.
    Raises SrfError where a case is not as it was sealed, and where the truths have been unsealed before.
    """
    check_cases(trial.bank)
    answers, names = read_answers(trial.answers), trial.waiting()
    if names and trial.opened.exists():
        raise SrfError(f"{trial.folder}: its truths were unsealed before {names[0]} was answered",
                       "Answers from now on would not be blind; make another trial.")  # fmt: skip
    tasks = [Task(trial.bank / name, plugins, diagnose, limit) for name in names]

    def lost(index: int) -> Answer:
        return failed(names[index], "its process was killed, three times")

    for _, answer in run_processes(answer_case, tasks, workers=workers, lost=lost):
        answers[answer.case] = answer
        write_answers(trial.answers, answers.values())
        yield answer


def open_truths(trial: Trial, *, unfinished: bool = False) -> tuple[Truths, dict[str, Answer]]:
    """Return truths and answers by case, now that all are answered; `unfinished` gives up those that are not.

    From here on no answer counts that was not there: a later call refuses other answers. Raises SrfError for unanswered
    cases, for truths, cases or answers that were changed.
    """
    if not (trial.bank / SEAL).exists():
        raise SrfError(f"{trial.folder}: its bank was never sealed", "Go on with --resume.")
    answers, waiting = read_answers(trial.answers), trial.waiting()
    if waiting and not (unfinished or trial.opened.exists()):
        raise SrfError(f"{trial.folder}: {len(waiting)} of {len(waiting) + len(answers)} cases have no answer",
                       "Go on with --resume, or give them up with --unfinished: the trial ends there.")  # fmt: skip
    if not answers:
        raise SrfError(f"{trial.folder}: no case has an answer", "Go on with --resume.")
    digest = hashlib.sha256(trial.answers.read_bytes()).hexdigest()
    if trial.opened.exists() and json.loads(trial.opened.read_text(encoding="utf-8"))["answers"] != digest:
        raise SrfError(f"{trial.answers} was changed after the truths were unsealed",
                       "Restore it; answers given with the truth at hand prove nothing.")  # fmt: skip
    truths = unseal(trial.bank, trial.apart)
    strange = sorted(set(answers) - set(truths))
    if strange:
        raise SrfError(f"{trial.answers}: {strange[0]} is no case of this bank", "Delete its line.")
    if not trial.opened.exists():
        text = {"answers": digest, "answered": len(answers), "of": len(truths)}
        write_atomic(trial.opened, json.dumps(text, indent=1) + "\n")
    return {name: truths[name] for name in sorted(answers)}, answers


# The task: a trial from its bank to its marks.


@dataclass(frozen=True, repr=False, eq=False)
class ProofResult(Result):
    """The answers of a trial, marked by its truths.

    Attributes
    ----------
    trial : Trial
        The folder of the trial.
    asked : mapping
        Cases, seed, kinds, track and bank.
    digest : str
        SHA-256 of the truths, as it was published with the cases.
    marks : tuple of GradedAnswer
        Each answer with what was concealed, and whether it is right.
    """

    trial: Trial
    asked: Mapping[str, Any]
    digest: str
    marks: tuple[marking.GradedAnswer, ...] = field(repr=False)

    @cached_property
    def _tables(self) -> tuple[Table, list[Table]]:
        return marking.tables(self.marks, digest=self.digest, seed=self.asked["seed"], of=self.asked["cases"])

    @property
    def table(self) -> Table:
        """Return what was concealed against the verdicts on it; `meta` has the marks and all other tables."""
        return self._tables[0]

    @property
    def more(self) -> list[Table]:
        """Return rates with intervals, and tables by effect, circumstance and strength, of confidence, errors and cost."""
        return self._tables[1]

    @cached_property
    def cases(self) -> Table:
        """Return a row for each case: what was concealed, what was said, and the mark."""
        return marking.cases(self.marks)

    def write(self, *, arguments: Sequence[str] = (), told: Callable[[str], None] = lambda text: None) -> None:
        """Write the report beside the answers: for a reader in few digits, for a program in all, and one line per case."""
        text = "\n".join(to_text(t, full=False) for t in [self.table, *self.more])
        provenance = Provenance(tuple(arguments), inputs=(self.trial.answers, self.trial.apart), seed=self.asked["seed"])
        for name, content in (("report.txt", text), ("report.json", to_json(self.table)), ("cases.csv", to_csv(self.cases))):
            write_result(self.trial.folder / name, content.encode("utf-8"), provenance)
            told(f"Wrote {self.trial.folder / name}")

    def plot(self, ax: Axes | None = None) -> Figure:
        """Return the rates of right and of wrong answers with their intervals of 95 %."""
        rates = marking.rates(self.marks).records()
        title = f"{len(self.marks)} cases of seed {self.asked['seed']}"
        with plots.one_panel(ax, title=title, size=(7.0, 1.0 + 0.3 * len(rates))) as (figure, axes):
            share, low, high = ([rate[name] for rate in rates] for name in ("share", "low", "high"))
            widths = [[s - a for s, a in zip(share, low, strict=True)], [b - s for s, b in zip(share, high, strict=True)]]
            axes.errorbar(share, range(len(rates)), xerr=widths, fmt="o", capsize=3, color=plots.COLOURS[0])
            named = [f"{rate['measure']}: {rate['hits']} of {rate['cases']}" for rate in rates]
            axes.set_yticks(range(len(rates)), named)
            axes.set(xlim=(-0.02, 1.02), xlabel="share of the cases, and 95 % intervals")
            axes.invert_yaxis()
        return figure


def prove(
    folder: Path | str,
    *,
    cases: int | None = None,
    seed: int | None = None,
    kinds: str | Sequence[str] = (),
    bank: str | None = None,
    track: str | None = None,
    resume: bool = False,
    report_only: bool = False,
    unfinished: bool = False,
    workers: int = 1,
    limit: float = CPU_LIMIT / 60,
    plugins: Sequence[str | Path] = (),
    progress: Callable[[str, str, int | None], None] = lambda stage, text, total: None,
) -> ProofResult:
    """Return how often the diagnosis is right on synthetic experiments whose truth is sealed until the last answer.

    The cases are made by equations and a solver of their own, and each is diagnosed from its folder alone. Each answer is kept
    as it comes, and `resume` goes on with a trial that was interrupted.

    Parameters
    ----------
    folder : path
        Of the trial: a new one, or with `resume` or `report_only` one that is there.
    cases, seed : int, optional
        How many cases are made, and from which seed; 10 and 1 if left out.
    kinds : str or sequence of str
        'none', 'single', 'pair', 'outside', in the wide bank 'ageing' and 'one-run', too; all of the bank if left out.
    bank : {'paper', 'wide'}, optional
        The paper's apparatus, protocol and law, which is usual, or a wide choice of each.
    track : {'smooth', 'rough', 'shared'}, optional
        Random friction field of the cases: none, one of each run's own, one that all runs share; mixed if left out.
    resume : bool
        Whether a trial in the folder goes on.
    report_only : bool
        Whether nothing is diagnosed, and the answers in the folder are marked again.
    unfinished : bool
        With `report_only`: give up the cases without an answer. The trial ends with it.
    workers : int
        Processes, 0 for all cores.
    limit : float
        Minutes of CPU after which a case has failed.
    plugins : sequence of path
        Folders in which laws and effects are looked for, too.
    progress : callable
        Told the stage (bank, sealed, diagnosed, truth), what is done, nothing where the stage begins, and of how many cases. At
        `sealed` it is told the digest of the truths.

    Returns
    -------
    ProofResult
        `.table` has what was concealed against the verdicts, `.more` the rates, `.cases` each case; `.write()` keeps a report.

    Raises
    ------
    SrfError
        For a folder that is no trial, or one of other cases; for cases, truths or answers that were changed.
    KeyboardInterrupt
        When it is stopped; the answers so far are kept.

    References
    ----------
    Wilson (1927), J. Am. Stat. Assoc. 22, 209: the intervals.

    Examples
    --------
    >>> import srfcli as srf
    >>> found = srf.prove("trial", cases=20, workers=0)  # doctest: +SKIP
    >>> srf.prove("no-trial", resume=True)
    Traceback (most recent call last):
        ...
    srfcli.core.errors.SrfError: no-trial: there is no trial to go on with
    """
    trial, places = Trial(Path(folder)), tuple(Path(p) for p in plugins)
    kinds = [kinds] if isinstance(kinds, str) else kinds
    check_choice("bank", bank, BANKS)
    check_choice("track", track, tuple(TRACKS))
    if (cases is not None and cases < 1) or (seed is not None and seed < 0) or workers < 0 or not limit > 0:
        raise SrfError("a trial has one case or more, a seed and workers of 0 or more, and a limit above 0")
    workers = workers or os.cpu_count() or 1
    if report_only:
        given = {"cases": cases, "seed": seed, "kinds": kinds or None, "bank": bank, "track": track, "resume": resume or None}
        for name in (name for name, value in given.items() if value is not None):
            raise SrfError(f"`{name}` has no meaning with `report_only`", "Leave it out.")
        trial.asked()
    else:
        if unfinished:
            raise SrfError("`unfinished` ends a trial that was begun", f"srf prove --report-only {folder} --unfinished")
        if resume and not trial.note.exists():
            raise SrfError(f"{folder}: there is no trial to go on with", "Leave `resume` out to begin one.")
        load_registry(places)  # a folder that is none must stop the trial, not fail every case
        begin(
            trial.folder, cases=cases, seed=seed, kinds=kinds, track=track, bank=bank, resume=resume, workers=workers,
            told=lambda k, n: progress("bank", f"case {k}", n),
        )  # fmt: skip
        waiting = trial.waiting()
        progress("sealed", f"SHA-256 of the sealed truths: {trial.digest()}", None)
        progress("diagnosed", "", len(waiting))
        for answer in answer_all(trial, workers=workers, plugins=places, limit=60 * limit):
            progress("diagnosed", f"{answer.case} in {answer.cpu:.0f} s of CPU", len(waiting))
    truths, answers = open_truths(trial, unfinished=unfinished)
    detectabilities = {}
    progress("truth", "", len(truths))
    for detectability in marking.detectabilities_of(trial.bank, truths, workers=workers, kept=trial.folder / "known.jsonl"):
        detectabilities[detectability.case] = detectability
        progress("truth", detectability.case, len(truths))
    marks = tuple(marking.grade(truths[name], answers[name], detectabilities[name]) for name in truths)
    return ProofResult(trial, trial.asked(), trial.digest(), marks)
