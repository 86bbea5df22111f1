"""Numbers and sentences of the diagnosis' report: sensible digits, declared units, the verdict in plain words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

UNITS = {"um": "µm", "um/s": "µm/s", "1/um": "1/µm", "N/um": "N/µm", "1": ""}
SMALLEST_P = 1e-290
NARROW = "\u00a0"  # between a number and its unit no line breaks
PLAIN = (1e-4, 1e6)  # between these a number is written without a power of ten
SUPERSCRIPT = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def finite(value: Any) -> TypeGuard[float]:
    """Return whether `value` is a number that is neither infinite nor NaN."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number(value: Any, digits: int = 3) -> str:
    """Return a number with so many significant digits, or a dash where there is none."""
    if not finite(value):
        return "–"
    if value == 0:
        return "0"
    rounded = float(f"{value:.{digits}g}")
    power = math.floor(math.log10(abs(rounded)))
    if not PLAIN[0] <= abs(rounded) < PLAIN[1]:
        return _minus(f"{rounded / 10.0**power:.{digits - 1}f}" + f"·10{str(power).translate(SUPERSCRIPT)}")
    return _minus(f"{rounded:.{max(digits - 1 - power, 0)}f}")


def with_error(value: Any, error: Any) -> str:
    """Return `value ± error` with two digits of the error, the value to the same place."""
    if not finite(value):
        return "–"
    if not finite(error) or error <= 0:
        return number(value, 4)
    place = math.floor(math.log10(float(f"{error:.1e}"))) - 1  # of the error's second digit
    size = max(abs(value), error)
    if PLAIN[0] <= size < PLAIN[1] or (abs(value) < error and error >= 1e-6):
        decimals = max(-place, 0)
        return _minus(f"{round(value, -place):.{decimals}f} ± {round(error, -place):.{decimals}f}")
    power = math.floor(math.log10(size))
    decimals = max(power - place, 0)
    scaled = f"({value / 10.0**power:.{decimals}f} ± {error / 10.0**power:.{decimals}f})"
    return _minus(f"{scaled}·10{str(power).translate(SUPERSCRIPT)}")


def probability(value: Any) -> str:
    """Return a p-value: three decimals where it is large, one digit and a power of ten where it is not."""
    if not finite(value):
        return "–"
    if value < SMALLEST_P:
        return "< 10⁻²⁹⁰"
    return f"{value:.3f}" if value >= 0.001 else number(value, 1)


def percent(share: Any) -> str:
    """Return a share as a percentage, with more digits near 0 and 100 %."""
    if not finite(share):
        return "–"
    value = 100.0 * share
    if 0 < value < 0.01:
        return f"< 0.01{NARROW}%"
    if value == 0 or abs(value) >= 10:
        return f"{_minus(f'{value:.0f}' if value <= 99.5 or value == 100 else f'{value:.1f}')}{NARROW}%"
    return f"{number(value, 2 if abs(value) >= 1 else 1)}{NARROW}%"


def rms(value: Any) -> str:
    """Return a residual in units of the noise: two decimals, fewer where it is large."""
    if not finite(value):
        return "–"
    return f"{value:.2f}" if value < 9.995 else number(value, 3)


def unit_text(unit: Any) -> str:
    """Return a unit as it is printed, nothing for 1."""
    return UNITS.get(str(unit), str(unit)) if unit else ""


def spans(windows: Sequence[Sequence[float]], most: int = 4) -> str:
    """Return intervals of time in words, the first `most` of them."""
    shown = [f"{number(a)} to {number(b)}{NARROW}s" for a, b in windows[:most]]
    more = len(windows) - len(shown)
    return joined([*shown, f"{more} more"] if more > 0 else shown)


def joined(words: Sequence[str], last: str = "and") -> str:
    """Return words as a list in a sentence."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}" if words else ""


def verdict_sentence(answer: Mapping[str, Any], material: Mapping[str, Any]) -> str:
    """Return the verdict in one sentence that needs no other."""
    effects = [str(e) for e in answer.get("effects", ())]
    fell = _fell(answer)
    verdict = answer.get("verdict")
    if verdict == "none":
        return (
            f"Nothing is missing: the baseline explains the recordings down to the noise{_level(answer, 'baseline')}."
        )
    if verdict == "identified":
        about = [_about(e, material) for e in effects]
        what = joined([f"{e}{f' ({a})' if a else ''}" for e, a in zip(effects, about, strict=True)])
        return f"The baseline lacks {what}: with {'it' if len(effects) == 1 else 'them'}, {fell}."
    if verdict == "ambiguous":
        return (
            f"Something is missing, and these recordings cannot tell which of {joined(effects)} it is: "
            f"each explains them as well; with the best of them, {fell}."
        )
    if verdict == "unknown":
        best = next((str(r["name"]) for r in material.get("ranked", ()) if r.get("name") != "none"), "")
        tried = f"even with the best of those tried, {best}, {fell}" if best else fell
        return f"Something is missing that no registered effect explains: {tried}."
    if verdict == "inconclusive":
        return (
            "Nothing has to be added to the baseline, but this experiment could not have seen most effects even if they "
            "were of a size that matters; the sizes that it could have seen are listed below."
        )
    return f"The verdict is {verdict}."


def _about(effect: str, material: Mapping[str, Any]) -> str:
    text = str(material.get("about", {}).get(effect, "")).rstrip(".")
    return text[:1].lower() + text[1:] if text[1:2].islower() else text


def _level(answer: Mapping[str, Any], key: str) -> str:
    fit, held = (rms_of(answer, key, part) for part in ("fit", "holdout"))
    if fit is None:
        return ""
    held_out = f", {rms(held)} times in the held-out ones" if held is not None else ""
    return f" (residuals are {rms(fit)} times the noise in the fitted runs{held_out})"


def _fell(answer: Mapping[str, Any]) -> str:
    before, after = rms_of(answer, "baseline", "fit"), rms_of(answer, "augmented", "fit")
    if before is None or after is None:
        return "the residuals change as shown below"
    text = f"residuals fall from {rms(before)} to {rms(after)} times the noise in the fitted runs"
    held = rms_of(answer, "baseline", "holdout"), rms_of(answer, "augmented", "holdout")
    if held[0] is None or held[1] is None:
        return text
    verb = "from" if held[1] <= held[0] else "rise from"
    return f"{text}, and {verb} {rms(held[0])} to {rms(held[1])} times in runs that the fit never saw"


def rms_of(answer: Mapping[str, Any], model: str, part: str) -> float | None:
    """Return rms over noise of "baseline" or "augmented" in "fit" or "holdout", None where the answer has none."""
    value = ((answer.get(model) or {}).get(part) or {}).get("rms_over_noise")
    return float(value) if finite(value) else None


def _minus(text: str) -> str:
    return text.replace("-", "−")
