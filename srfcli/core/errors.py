"""Errors that a user can act on, notices of what was found in data, and numerical outcomes: what, where, what instead."""

from __future__ import annotations

import difflib
import functools
import numbers
import re
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

LONGEST_MESSAGE = 2000  # characters of a message
CHECK_PATH = "Check path and permissions."
WHOLE = "Was the file copied to its end?"
# control characters but tab and newline, DEL and the second set, marks that are not seen or turn the line round, lone
# surrogates (bytes of file names that are no text): what a terminal acts on, or shows as something else than it is
_UNSEEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    "\ud800-\udfff\U000e0000-\U000e0fff]"
)


def printable(text: str, *, line: bool = False) -> str:
    """Return the text with all that a terminal would act on spelt out, ESC as \\x1b; in a `line` tabs and newlines, too."""
    if line and ("\n" in text or "\t" in text):
        text = text.replace("\n", "\\n").replace("\t", "\\t")
    if text.isascii() and text.replace("\n", "").replace("\t", "").isprintable():
        return text
    return _UNSEEN.sub(lambda found: ascii(found.group())[1:-1], text)


def shortened(text: str) -> str:
    """Return the text, without its middle where it is longer than LONGEST_MESSAGE: a key of 100 kB is told by its ends."""
    return text if len(text) <= LONGEST_MESSAGE else f"{text[: LONGEST_MESSAGE // 2]} ... {text[-LONGEST_MESSAGE // 4 :]}"


def shown(value: object) -> str:
    """Return a value as a TOML author knows it, cut where it is long."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and abs(value) >= 10**60:
        return "a number of more than 60 digits"
    try:
        text = f'"{value}"' if isinstance(value, str) else repr(value)
    except (ValueError, RecursionError):
        return "a value too long to show"
    return text if len(text) <= 60 else text[:57] + "..."


class SrfError(Exception):
    """Misuse that stops a command: `message` says what and where, `hint` what to do instead.

    `exit_code` is 2 for usage, laws and recordings; 1 for I/O. `kind` names an error that some caller treats by itself:
    "no file", "unknown name", "unit" where the hint says what unit would do.
    """

    def __init__(self, message: str, hint: str | None = None, *, exit_code: int = 2, kind: str = "") -> None:
        message, hint = printable(shortened(message)), hint and printable(shortened(hint))
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.exit_code = exit_code
        self.kind = kind


class NoContact(SrfError):
    """A load that would lift the slider; `window` is the longest time (s) in contact, None where there is none."""

    window: tuple[float, float] | None = None


class ExpressionError(SrfError):
    """An expression that cannot be a formula; `text` and `column` (0-based) place the caret."""

    def __init__(self, message: str, hint: str | None = None, *, text: str = "", column: int | None = None) -> None:
        super().__init__(message, hint)
        self.text = text
        self.column = column

    def caret(self) -> str | None:
        """Return the expression with a caret under the offending column, or None when it has no place."""
        if self.column is None:
            return None
        text = self.text.replace("\n", " ").replace("\t", " ")
        text = _UNSEEN.sub("?", text)  # one sign for one, as the caret counts
        return f"  {text}\n  {' ' * self.column}^"


@contextmanager
def damaged(what: str) -> Iterator[None]:
    """Raise SrfError, `what` and what it says, for whatever a library raises inside over a damaged file: that may be anything."""
    try:
        yield
    except Exception as error:
        told = " ".join(str(error).split())[:200]
        raise SrfError(f"{what}: {told or type(error).__name__}", WHOLE) from None


def check_choice(name: str, value: str | None, choices: Sequence[str]) -> None:
    """Raise SrfError for a value of the parameter `name` that is none of `choices`; None is left to whoever has a default."""
    if value is not None and value not in choices:
        raise SrfError(f"`{name}`: {value!r} is not one of its values", did_you_mean(str(value), choices))


def as_names(value: str | Sequence[str], what: str) -> list[str]:
    """Return names that are given as a list, or as text with commas; raises SrfError for a name that is given twice."""
    names = [part.strip() for part in value.split(",")] if isinstance(value, str) else [str(name) for name in value]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise SrfError(f"`{what}`: {name!r} is named twice", "Once is enough.")
    return names


def as_pairs(given: Any, what: str, like: str) -> list[tuple[float, float]]:
    """Return pairs of numbers; raises SrfError, which shows one like them, for anything else."""
    try:
        pairs = [(float(first), float(second)) for first, second in given]
    except (TypeError, ValueError):
        pairs = []
    if not pairs:
        raise SrfError(f"`{what}` {given!r} is no list of pairs", f"Give {like}.")
    return pairs


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return `Did you mean 'x'? Known: a, b` for a misspelt `name`; the sentence about x only if one is close."""
    names = sorted(set(known))
    lowered = {n.lower(): n for n in reversed(names)}
    close = difflib.get_close_matches(name.lower(), list(lowered), n=1, cutoff=0.5)
    squeezed = {n.lower().replace("_", "").replace("-", ""): n for n in names}
    exact = squeezed.get(name.lower().replace("_", "").replace("-", ""))
    guess = exact or (lowered[close[0]] if close else None)
    tail = f"Known: {', '.join(names)}" if names else "None are known"
    return f"Did you mean '{guess}'? {tail}" if guess else tail


@dataclass(frozen=True)
class Notice:
    """Something that was found in the data: its kind, the place, and one sentence on what it is and what was done."""

    kind: str
    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.where}: {self.what}"


# Numerical outcomes: a failure is a value whose text is advice.


class Status(Enum):
    """How a computation ended; `advice` says what to try next."""

    advice: str

    OK = "ok", "Converged."
    NO_CONVERGENCE = (
        "no-convergence",
        "Newton's method did not converge. Start nearer to the solution, raise `max_mesh`, or lower eps.",
    )
    TOLERANCE = "tolerance-not-met", "The estimated error is above the tolerance on the finest mesh allowed; raise `max_mesh`."
    MAX_STEPS = "max-steps", "The curve was cut at the step limit; raise `max_steps`."
    STEP_TOO_SMALL = "step-too-small", "The step along the curve fell below its minimum; a singular point is near."
    LEFT_WINDOW = "left-window", "The curve left the window that was asked for."
    CLOSED = "closed", "The curve returned to its start."
    NO_HOPF = "no-hopf", "Velocity strengthening: no Hopf bifurcation."
    UNSETTLED = (
        "window-not-settled",
        "Crossings may lie beyond the loads looked at; look there with another `window`, or with W0 in `over`.",
    )
    INTEGRATION = (
        "integration-stopped",
        "Time integration stopped before the end of the record; look at the motion there, or loosen rtol.",
    )
    NO_VALUE = "no-value", "A formula is undefined at these parameters, for example where one is 0; exclude that value."
    EVALUATIONS = "max-evaluations", "The fit was cut at its limit of evaluations; raise `max_evaluations`, or start nearer."
    INTERRUPTED = "interrupted", "What was finished is kept."

    def __new__(cls, value: str, advice: str = "") -> Status:
        """Return the member of this value, with its advice."""
        member = object.__new__(cls)
        member._value_ = value
        member.advice = advice
        return member

    @property
    def ok(self) -> bool:
        """True where the numbers can be used as they stand."""
        return self in (Status.OK, Status.LEFT_WINDOW, Status.CLOSED)


def worst(statuses: Iterable[Status]) -> Status:
    """Return the first status whose numbers cannot be used as they stand, else OK."""
    return next((s for s in statuses if not s.ok), Status.OK)


# Arguments of public functions: where one is not of the type it is annotated with, a Python error becomes a clear one.

Function = TypeVar("Function", bound=Callable[..., Any])

# of arguments that are no classes of srf; a truth value is a number in Python, and here it is none
ARGUMENT_TYPES: dict[str, type] = {"str": str, "Path": Path, "float": numbers.Real, "int": numbers.Integral}
UNCHECKED = ("Any", "ArrayLike", "Runner", "Said", "Values", "bool")  # names of several types, and what is asked for its truth
HINTS = {"SlidingSystem": "Make a slider first, as srfcli.system('srf-vsat')."}


def explained(function: Function) -> Function:
    """Return the function, which raises SrfError where a Python error follows from an argument of a wrong type.

    What works is not looked at. Annotations must be text, as `from __future__ import annotations` makes them.
    """

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except (TypeError, ValueError, AttributeError, LookupError):
            import ast  # the command starts without them
            import inspect

            parameters = inspect.signature(function).parameters
            for name, value in {**dict(zip(parameters, args, strict=False)), **kwargs}.items():
                annotation = parameters[name].annotation if name in parameters else "Any"
                if not _fits(value, ast.parse(annotation, mode="eval").body):
                    hint = HINTS.get(annotation.split(" | ")[0], f"It takes {annotation}.")
                    raise SrfError(f"`{name}`: {reprlib.repr(value)} is of a wrong type", hint) from None
            raise

    return call  # type: ignore[return-value]


def _fits(value: Any, annotation: Any) -> bool:
    """Return whether a value is of the type that an annotation, a node of `ast`, names; a function is not looked at."""
    import ast

    match annotation:
        case ast.BinOp(left=left, right=right):
            return _fits(value, left) or _fits(value, right)
        case ast.Constant():
            return value is None
        case ast.Subscript(value=ast.Name(id="Mapping"), slice=ast.Tuple(elts=[_, inner])):
            return isinstance(value, Mapping) and all(_fits(item, inner) for item in value.values())
        case ast.Subscript(value=ast.Name(id="Sequence" | "tuple"), slice=inner):
            if not isinstance(value, Iterable) or isinstance(value, str | bytes | Mapping):
                return False
            items = list(value)
            kinds = inner.elts if isinstance(inner, ast.Tuple) else [inner] * len(items)
            return len(items) == len(kinds) and all(map(_fits, items, kinds))
        case ast.Name(id=name) if name in ARGUMENT_TYPES:
            return isinstance(value, ARGUMENT_TYPES[name]) and not isinstance(value, bool)
        case ast.Name(id=name) if name not in UNCHECKED:
            return name in {base.__name__ for base in type(value).__mro__}
    return True
