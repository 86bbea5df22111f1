"""A trial: a folder with a sealed bank of cases, the answers so far and, when all are answered, the truths."""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from srfcli.core.errors import SrfError
from srfcli.core.files import clear, parse_json, read_plain, write_atomic
from srfcli.core.parallel import run_processes
from srfcli.validation.blind import Answer, Diagnose, Task, answer_case, diagnose_case, failed, read_answers, write_answers
from srfcli.validation.cases import SEAL, Truths, check_cases, check_kinds, make_bank, unseal

SCHEMA = "srf.trial/1"
CPU_LIMIT = 1800.0  # s of CPU a case may take: six times what it should


@dataclass(frozen=True)
class Trial:
    """The folder of a trial, and what lies where in it."""

    folder: Path

    @property
    def bank(self) -> Path:
        """Return the folder of the cases and their seal: all that a diagnosis is given."""
        return self.folder / "bank"

    @property
    def apart(self) -> Path:
        """Return the file of the truths."""
        return self.folder / "truths.json"

    @property
    def answers(self) -> Path:
        """Return the file of the answers, one a line."""
        return self.folder / "answers.jsonl"

    @property
    def note(self) -> Path:
        """Return the file that says what was asked for."""
        return self.folder / "trial.json"

    @property
    def opened(self) -> Path:
        """Return the file that says which answers there were when the truths were unsealed."""
        return self.folder / "unsealed.json"

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
        return str(json.loads((self.bank / SEAL).read_text(encoding="utf-8"))["truths"])

    def waiting(self) -> list[str]:
        """Return the cases that have no answer yet."""
        answered = read_answers(self.answers)
        return [name for name in sorted(json.loads((self.bank / SEAL).read_text(encoding="utf-8"))["cases"])
                if name not in answered]  # fmt: skip


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
        make_bank(part, asked["cases"], asked["seed"], **drawn, apart=trial.apart, workers=workers, told=told, strengths=False)
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
