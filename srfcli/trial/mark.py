"""One answer held against the truth: what would have been right, and whether it was said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from srfcli.trial.answer import FAILED, VERDICTS, Answer
from srfcli.trial.sight import Sight
from srfcli.trial.sizes import deviation

KINDS = ("none", "single", "pair", "outside")
INVISIBLE = 5.0  # standard errors: an effect whose size even the best fit would know no better cannot be asked for
CONFIDENT = 0.9
UNNAMED = ("none", "inconclusive", "ambiguous")  # right where what is concealed cannot be seen
Accepted = frozenset[tuple[str, frozenset[str]]]


@dataclass(frozen=True)
class Mark:
    """An answer and the truth about its case. `right` is the verdict with the very set of effects, or what is as good.

    `class_right`: right, or ambiguous with the truth among what is listed or equivalent to it. `alarm`: something is said to be
    missing. `top` is the hypothesis with most confidence, `stated` that confidence, `hit` whether it is the truth; `error` the
    held-out rms of the final model over that of the true one, `baseline_error` that of the baseline; `deviation` is the
    distance of an effect's size from the true one, where it was named rightly and alone: in standard errors, and relative.
    """

    case: str
    kind: str
    hidden: tuple[str, ...]
    rough: bool
    invisible: tuple[str, ...]
    sigmas: float | None
    size: float | None
    answer: Answer
    right: bool
    class_right: bool
    top: str
    stated: float
    hit: bool
    error: float | None
    baseline_error: float | None
    deviation: tuple[float, float] | None = None
    accepted: Accepted = frozenset()

    @property
    def visible(self) -> bool:
        """Return whether all that is concealed could be seen."""
        return not self.invisible

    @property
    def alarm(self) -> bool:
        """Return whether the answer says that something is missing."""
        return self.answer.verdict in ("identified", "ambiguous", "unknown")

    @property
    def wrong_name(self) -> bool:
        """Return whether effects are named, and are not the concealed ones."""
        return self.answer.verdict == "identified" and not self.right

    @property
    def confident_wrong(self) -> bool:
        """Return whether the wrong effects are named with a stated confidence above CONFIDENT."""
        return self.wrong_name and self.answer.confidence.get(self.answer.said, 0.0) > CONFIDENT


def mark(truth: Mapping[str, Any], answer: Answer, sight: Sight) -> Mark:
    """Return the mark of an answer, given the truth about its case and what there was to be seen."""
    hidden = tuple(truth["effects"])
    invisible = tuple(n for n in hidden if (s := sight.sigmas.get(n)) is not None and s < INVISIBLE)
    allowed = accepted(truth, invisible)
    said = (answer.verdict, frozenset(answer.effects) if answer.verdict == "identified" else frozenset())
    right = answer.verdict != FAILED and said in allowed
    shares = {**answer.confidence}
    top = max(shares, key=lambda name: shares[name]) if shares else ""
    known = [s for n in hidden if (s := sight.sigmas.get(n)) is not None]
    return Mark(
        answer.case,
        kind_of(truth),
        hidden,
        truth["rough"] > 0,
        invisible,
        min(known) if known and len(known) == len(hidden) else None,
        min(truth["sizes"].values(), default=None),
        answer,
        right,
        right or _listed(truth, answer),
        top,
        shares.get(top, 0.0),
        _key(top) in allowed,
        _ratio(answer, sight, "augmented"),
        _ratio(answer, sight, "baseline"),
        deviation(truth, answer),
        allowed,
    )


def kind_of(truth: Mapping[str, Any]) -> str:
    """Return the kind of a case: none, single, pair or outside."""
    if truth["verdict"] == "unknown":
        return "outside"
    return ("none", "single", "pair")[len(truth["effects"])]


def accepted(truth: Mapping[str, Any], invisible: tuple[str, ...]) -> Accepted:
    """Return what would be right: pairs of a verdict and, for `identified`, a set of effects.

    `accept` in the truth lists further verdicts, or effects as "a" or "a+b". Where all that is concealed is invisible, so are
    none, inconclusive and ambiguous; of two effects with one invisible, the other one alone.
    """
    found = {_key("+".join(truth["effects"]) if truth["verdict"] == "identified" else truth["verdict"])}
    found |= {(name, frozenset()) if name in VERDICTS else _key(name) for name in truth.get("accept", ())}
    left = frozenset(truth["effects"]) - frozenset(invisible)
    if invisible and left:
        found.add(("identified", left))
    elif invisible:
        found |= {(verdict, frozenset()) for verdict in UNNAMED}
    return frozenset(found)


def _key(name: str) -> tuple[str, frozenset[str]]:
    """Return the verdict and effects that a hypothesis stands for: none, unknown, or names joined by +."""
    return (name, frozenset()) if name in ("none", "unknown", "") else ("identified", frozenset(name.split("+")))


def _listed(truth: Mapping[str, Any], answer: Answer) -> bool:
    """Return whether an ambiguous answer lists the truth, or what it calls its equivalents."""
    if answer.verdict != "ambiguous" or truth["verdict"] != "identified":
        return False
    listed = set(answer.effects)
    for names in answer.equivalent:
        listed |= set(names) if listed & set(names) else set()
    return set(truth["effects"]) <= listed


def _ratio(answer: Answer, sight: Sight, model: str) -> float | None:
    """Return the rms over all held-out runs under `model`, over that under the true one; None where one has none."""
    pairs = [(run.get(model), sight.known.get(name)) for name, run in answer.held.items()]
    if not pairs or any(a is None or not b for a, b in pairs):
        return None
    ours, true = (sum(float(p[i] or 0.0) ** 2 for p in pairs) for i in (0, 1))
    return float((ours / true) ** 0.5)
